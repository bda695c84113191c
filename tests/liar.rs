//! A detector that lies: told at once, and never followed to the ground.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use messages::{ControllerCommand, Detections, topic};
use node::{Identity, Node, ZenohSource};
use testing::with_second_try;
use tokio::time::timeout;

use crate::flight::{Landing, beside_another};

/// Publishes what `main` finds under its own name, and 1 m to the side once it lies.
async fn tell(liar: Node, lies: Arc<AtomicBool>) -> anyhow::Result<()> {
    let seen = liar.subscriber(topic::DETECTIONS, &["main"]).await?;
    let told = liar.publisher(topic::DETECTIONS, &["liar"]).await?;
    liar.announce().await?;
    while let Some(mut message) = seen.next().await {
        message.detector = "liar".into();
        if lies.load(Ordering::Relaxed) {
            shift(&mut message);
        }
        told.publish(&message).await;
    }
    Ok(())
}

fn shift(message: &mut Detections) {
    for pose in message.detections.iter_mut().filter_map(|seen| seen.pose.as_mut()) {
        let [right_m, _, _] = &mut pose.camera_from_marker.translation_m;
        *right_m += 1.0;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_preferred_liar_beside_an_honest_detector_is_told_and_not_followed_down()
-> anyhow::Result<()> {
    with_second_try(a_liar_is_preferred).await
}

async fn a_liar_is_preferred() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let landing = Landing::start(&["--seed", "5"]).await?;
    landing.status("it begins", |s| s.active_detector.as_deref() == Some("main")).await?;
    let identity = Identity { service: "detector", instance: "liar".into() };
    let liar = Node::open(identity, &ZenohSource::File(landing.zenoh.clone())).await?;
    let lies = Arc::new(AtomicBool::new(false));
    let telling = tokio::spawn(tell(liar.clone(), Arc::clone(&lies)));
    // On a busy machine either of the two may be the active one, with which the other is compared.
    let known = |s: &messages::ControllerStatus| s.candidates.iter().any(|c| c.agreed > 8);
    landing.status("the liar is believed", known).await?;
    let command = ControllerCommand::UseDetector("liar".into());
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{reply:?}");
    landing.descends_below(6.0).await?;
    lies.store(true, Ordering::Relaxed);
    let began = Instant::now();
    let told = landing.status("it is told", |s| !s.warnings.is_empty()).await?;
    let took = began.elapsed();
    println!("told after {took:?}: {:?}", told.warnings);
    ensure!(took < Duration::from_secs(1), "{took:?}");
    ensure!(told.warnings.iter().any(|text| text.contains("`liar`")), "{:?}", told.warnings);
    let lowest_m = landing
        .motion(Duration::from_secs(8))
        .await
        .iter()
        .map(|truth| -truth.position_ned_m[2])
        .fold(f64::INFINITY, f64::min);
    println!("lowest height in 8 s of lies: {lowest_m:.2} m");
    ensure!(lowest_m > 2.0, "{lowest_m} m");
    let waits = landing.status("it waits", |_| true).await?;
    println!("{}: {}", waits.phase, waits.why);
    // The operator ends it.
    telling.abort();
    timeout(Duration::from_secs(5), liar.close()).await.context("closing the liar's session")?;
    landing.lands().await.map(drop)
}
