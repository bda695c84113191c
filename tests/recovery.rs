//! Tests that each killed process starts again automatically, and that the flight stays safe meanwhile. `measure.rs` kills each process more often.

use testing::with_second_try;

use crate::kills;

#[tokio::test(flavor = "multi_thread")]
async fn each_killed_process_starts_again_and_it_lands() -> anyhow::Result<()> {
    with_second_try(|| kills::kill_each(1)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_that_an_operator_holds_is_not_resumed_by_the_next_controller()
-> anyhow::Result<()> {
    with_second_try(kills::kill_while_held).await
}
