//! Whatever is killed comes back by itself, and nothing unsafe happens meanwhile. `measure.rs` kills each process more often.

use testing::with_second_try;

use crate::kills;

#[tokio::test(flavor = "multi_thread")]
async fn whatever_is_killed_comes_back_and_it_lands() -> anyhow::Result<()> {
    with_second_try(|| kills::kill_each(1)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_that_an_operator_holds_is_not_taken_up_by_the_next_controller()
-> anyhow::Result<()> {
    with_second_try(kills::kill_while_held).await
}
