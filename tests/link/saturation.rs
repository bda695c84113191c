//! Measures small messages while a camera that does not adapt offers frames at twice the link's rate.

use std::time::Duration;

use anyhow::Context;
use messages::{FrameHeader, PixelFormat, topic};
use node::{FramePublisher, Loan, now_ns};
use serde_json::Value;
use tokio::time::interval;

use super::probe;
use super::site::{Radio, Site};

/// Kinds of small messages, as the probe names them.
pub(crate) const CLASSES: [&str; 4] = ["state", "mavlink", "commands", "detections back"];
/// Bytes of a frame.
const FRAME_BYTES: usize = 125_000;

/// The measurements of the probes: on the idle link, and on the saturated one.
pub(crate) struct Saturation {
    phases: [Value; 2],
    offered_hz: f64,
}

impl Saturation {
    pub(crate) fn p99_ms(&self, name: &str, phase: usize) -> f64 {
        self.phases.get(phase).and_then(|p| p[name]["p99_ms"].as_f64()).unwrap_or(f64::NAN)
    }

    pub(crate) fn lost(&self, name: &str) -> u64 {
        self.phases.iter().filter_map(|phase| phase[name]["lost"].as_u64()).sum()
    }
}

impl std::fmt::Display for Saturation {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [_, busy] = &self.phases;
        write!(f, "frames {:.0} Hz offered, {} arrived", self.offered_hz, busy["frames"]["count"])?;
        for name in CLASSES {
            let [idle, busy] = [0, 1].map(|phase| self.p99_ms(name, phase));
            let lost = self.lost(name);
            write!(f, "; {name} p99 {busy:.0} ms, idle {idle:.0} ms, {lost} lost")?;
        }
        Ok(())
    }
}

/// Measures for some seconds with the link idle, and again with it saturated.
pub(crate) async fn run(radio: Radio, seconds: f64) -> anyhow::Result<Option<Saturation>> {
    let Some(mut site) = Site::new(radio).await? else { return Ok(None) };
    site.relay()?;
    probe::controller(&site.node).await?;
    let back = probe::beacon(&site.node).await?;
    // Both ends meet first.
    phase(&mut site, &back, 3.0).await?;
    let idle = phase(&mut site, &back, seconds).await?;
    let offered_hz = 2.0 * radio.rate_mbit * 1e6 / 8.0 / FRAME_BYTES as f64;
    let frames = site.node.frame_publisher(topic::JPEG, &["probe"], 0).await?;
    let offering = tokio::spawn(offer(frames, offered_hz));
    let busy = phase(&mut site, &back, seconds).await?;
    offering.abort();
    Ok(Some(Saturation { phases: [idle, busy], offered_hz }))
}

async fn phase(site: &mut Site, back: &probe::Shared, seconds: f64) -> anyhow::Result<Value> {
    back.lock().map_err(|_| anyhow::anyhow!("a task ended"))?.clear();
    let probe = site.probe(seconds, true)?;
    let output = tokio::task::spawn_blocking(move || probe.wait_with_output()).await??;
    site.all_run()?;
    let text = String::from_utf8(output.stdout)?;
    let mut report: Value = serde_json::from_str(text.lines().last().context("the probe failed")?)?;
    report["detections back"] = probe::taken(back).report();
    Ok(report)
}

/// Publishes frames of noise only, without waiting for their delivery.
async fn offer(frames: FramePublisher, rate_hz: f64) {
    let mut ticks = interval(Duration::from_secs_f64(1.0 / rate_hz));
    let mut noise = vec![0_u8; FRAME_BYTES];
    let mut state = 1_u32;
    for byte in &mut noise {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        *byte = (state >> 24) as u8;
    }
    for sequence in 0.. {
        ticks.tick().await;
        let header = FrameHeader {
            camera: "probe".into(),
            sequence,
            stamp_ns: now_ns(),
            format: PixelFormat::Jpeg,
            ..FrameHeader::sample()
        };
        frames.publish(&header, Loan::Private(noise.clone())).await;
    }
}
