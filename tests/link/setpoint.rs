//! One host: from a frame's stamp to the setpoint, without the time a detector needs.
//!
//! A whole flight runs, its camera and detector as well. Beside them this program films with a camera of its own whose
//! stamp is the moment before it writes the pixels, and a process in the detector's place answers each of its frames at
//! once with what the real detector saw last. The controller flies by these answers, and measures.

use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::Context;
use messages::{ControllerStatus, Detection, Detections, topic};
use node::{Identity, Network, Node};
use tokio::time::{Instant, interval, timeout};

use crate::onehost::{self, LEN};
use crate::site::{Radio, Site};

/// 15 frames a second.
const PERIOD: Duration = Duration::from_micros(66_667);
/// Longest flight.
const PATIENCE: Duration = Duration::from_secs(90);
/// What the controller lands on here: the real detector's answers are of another marker, and never used.
const MARKER: &str = "aruco-4x4-50";

/// What was measured.
pub(crate) struct Setpoint {
    status: ControllerStatus,
}

impl std::fmt::Display for Setpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [p50, p99] = self.status.latency_ms.unwrap_or([f64::NAN; 2]);
        let ControllerStatus { phase, why, detections_used, .. } = &self.status;
        write!(
            f,
            "median {p50:.2} ms, p99 {p99:.2} ms of {detections_used} frames; ended in {phase}: {why}"
        )
    }
}

/// Flies and measures.
pub(crate) async fn run(radio: Radio) -> anyhow::Result<Option<Setpoint>> {
    let Some(mut site) = Site::new(radio).await? else { return Ok(None) };
    let mut answering = Command::new(std::env::current_exe()?);
    answering.args(["answerer", &site.meet().to_string()]).stdin(Stdio::null());
    let mut answering = answering.spawn().context("starting the one that answers")?;
    let result = measure(&mut site).await;
    answering.kill()?;
    answering.wait()?;
    result.map(Some)
}

async fn measure(site: &mut Site) -> anyhow::Result<Setpoint> {
    let node = site.node.clone();
    let frames = node.frame_publisher(topic::FRAME, &["probe"], LEN).await?;
    let infos = node.subscriber(topic::CAMERA_INFO, &["down"]).await?;
    let info = node.publisher(topic::CAMERA_INFO, &["probe"]).await?;
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    site.drone("detector", &["--set", "id=onboard"])?;
    site.flight_by(1, &[], &["--set", &format!("marker=\"{MARKER}\"")])?;
    // The same mount and lens as the real camera's.
    let real = timeout(PATIENCE, infos.next()).await?.context("no camera")?;
    info.publish(&messages::CameraInfo { camera: "probe".into(), ..real }).await;
    let mut ticks = interval(PERIOD);
    let mut sequence = 0;
    let mut last = None;
    let end = Instant::now() + PATIENCE;
    while Instant::now() < end {
        tokio::select! {
            _ = ticks.tick() => {
                onehost::take(&frames, sequence).await;
                sequence += 1;
            }
            Some(status) = statuses.next() => {
                let is_done = status.finished;
                last = Some(status);
                if is_done {
                    break;
                }
            }
        }
    }
    site.all_run()?;
    Ok(Setpoint { status: last.context("the controller says nothing")? })
}

/// The process in the detector's place.
pub(crate) async fn answerer(meet: &str) -> anyhow::Result<()> {
    let network = Network { meet: Some(meet.parse()?), ..Network::default() };
    let identity = Identity { service: "detector", instance: "answerer".into() };
    let node = Node::open(identity, &network.source("detector")?).await?;
    let frames = node.frame_subscriber(topic::FRAME, &["probe"]).await?;
    let answers = node.publisher(topic::DETECTIONS, &["answerer"]).await?;
    let real = node.subscriber(topic::DETECTIONS, &["onboard"]).await?;
    node.announce().await?;
    let seen = Arc::new(Mutex::new(Vec::<Detection>::new()));
    let newest = Arc::clone(&seen);
    tokio::spawn(async move {
        while let Some(message) = real.next().await {
            *newest.lock().unwrap_or_else(PoisonError::into_inner) = message.detections;
        }
    });
    while let Some(frame) = frames.next().await {
        let mut detections = seen.lock().unwrap_or_else(PoisonError::into_inner).clone();
        for detection in &mut detections {
            detection.family = MARKER.into();
            detection.id = Some(0);
        }
        let (detector, header, stages) = ("answerer".into(), frame.header, Vec::new());
        answers.publish(&Detections { detector, header, detections, stages }).await;
    }
    Ok(())
}
