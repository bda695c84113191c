//! Tests that a process that is frozen for a while (SIGSTOP) works again within 2 s after it continues. `measure.rs` freezes each for
//! longer.

use testing::with_second_try;

use crate::freezes;

/// For how long each is frozen, in seconds: less than Zenoh's lease is on the air link, about as long, longer.
const FREEZES_S: [f64; 3] = [0.5, 2.0, 5.0];

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_detector_detects_again_and_it_lands() -> anyhow::Result<()> {
    with_second_try(|| freezes::of_a_landing("detector", &FREEZES_S)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn packets_of_a_frozen_bridge_arrive_again_and_it_lands() -> anyhow::Result<()> {
    with_second_try(|| freezes::of_a_landing("gcs-bridge", &FREEZES_S[1..])).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_simulation_continues_and_lands() -> anyhow::Result<()> {
    with_second_try(|| freezes::of_a_landing("simulator", &FREEZES_S[1..])).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_controller_continues_and_lands() -> anyhow::Result<()> {
    with_second_try(|| freezes::of_a_landing("controller", &FREEZES_S[1..2])).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_command_to_a_frozen_controller_is_not_carried_out_late() -> anyhow::Result<()> {
    with_second_try(freezes::of_a_commanded_controller).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_camera_publishes_again() -> anyhow::Result<()> {
    with_second_try(|| freezes::of_a_camera(&FREEZES_S)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_detector_that_starts_while_a_camera_is_frozen_gets_its_frames() -> anyhow::Result<()> {
    freezes::of_a_camera_while_another_starts(2.0).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frozen_relay_relays_again() -> anyhow::Result<()> {
    with_second_try(|| freezes::of_a_relay(&[0.5, 1.5, 2.0, 5.0, 30.0])).await
}
