//! Tests a detector with wrong poses: the controller reports it at once, and never follows it to the ground.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use messages::{CameraInfo, ControllerCommand, Detections, topic};
use node::{Identity, Node, ZenohSource};
use testing::with_second_try;
use tokio::time::timeout;

use crate::flight::{Landing, beside_another};

/// Publishes the detections of `main` under its own name, and 1 m to the side once it is wrong.
async fn publish(faulty: Node, is_wrong: Arc<AtomicBool>) -> anyhow::Result<()> {
    let camera = faulty.subscriber(topic::CAMERA_INFO, &["down"]).await?;
    let camera = camera.next().await.context("the camera's information")?;
    let seen = faulty.subscriber(topic::DETECTIONS, &["main"]).await?;
    let publisher = faulty.publisher(topic::DETECTIONS, &["faulty"]).await?;
    faulty.announce().await?;
    while let Some(mut message) = seen.next().await {
        message.detector = "faulty".into();
        if is_wrong.load(Ordering::Relaxed) {
            shift(&mut message, &camera);
        }
        publisher.publish(&message).await;
    }
    Ok(())
}

/// Pose and centre agree, as those of a detector that takes something else for the marker.
fn shift(message: &mut Detections, camera: &CameraInfo) {
    for seen in &mut message.detections {
        let Some(pose) = &mut seen.pose else { continue };
        let place_m = &mut pose.camera_from_marker.translation_m;
        place_m[0] += 1.0;
        seen.centre_px = camera.pixel_of(*place_m).unwrap_or(seen.centre_px);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_preferred_detector_with_wrong_poses_is_reported_and_not_followed_down()
-> anyhow::Result<()> {
    with_second_try(a_faulty_detector_is_preferred).await
}

async fn a_faulty_detector_is_preferred() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let landing = Landing::start(&["--seed", "5"]).await?;
    landing.status("it begins", |s| s.active_detector.as_deref() == Some("main")).await?;
    let identity = Identity { service: "detector", instance: "faulty".into() };
    let faulty = Node::open(identity, &ZenohSource::File(landing.zenoh.clone())).await?;
    let is_wrong = Arc::new(AtomicBool::new(false));
    let publishing = tokio::spawn(publish(faulty.clone(), Arc::clone(&is_wrong)));
    // On a busy machine either of the two may be the active one, with which the other is compared.
    let known = |s: &messages::ControllerStatus| s.candidates.iter().any(|c| c.agreed > 8);
    landing.status("the faulty detector is believed", known).await?;
    let command = ControllerCommand::UseDetector("faulty".into());
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{reply:?}");
    landing.descends_below(6.0).await?;
    is_wrong.store(true, Ordering::Relaxed);
    let began = Instant::now();
    let status = landing.status("a warning is reported", |s| !s.warnings.is_empty()).await?;
    let took = began.elapsed();
    println!("reported after {took:?}: {:?}", status.warnings);
    ensure!(took < Duration::from_secs(1), "{took:?}");
    ensure!(status.warnings.iter().any(|text| text.contains("`faulty`")), "{:?}", status.warnings);
    let lowest_m = landing
        .motion(Duration::from_secs(8))
        .await
        .iter()
        .map(|truth| -truth.position_ned_m[2])
        .fold(f64::INFINITY, f64::min);
    println!("lowest height in 8 s of wrong poses: {lowest_m:.2} m");
    ensure!(lowest_m > 2.0, "{lowest_m} m");
    let waits = landing.status("it waits", |_| true).await?;
    println!("{}: {}", waits.phase, waits.why);
    // The operator ends it.
    publishing.abort();
    timeout(Duration::from_secs(5), faulty.close())
        .await
        .context("closing the faulty detector's session")?;
    landing.lands().await.map(drop)
}
