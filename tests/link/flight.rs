//! Flies landings with the detector onboard, on the ground behind an emulated radio link, or with both while the link is
//! cut: errors, ages of the frames used, and effects of the cut.

use std::time::Duration;

use anyhow::{Context, ensure};
use messages::{
    ControllerCommand, ControllerStatus, Detections, Health, Phase, Touchdown, Truth, topic,
};
use node::{Subscriber, now_ns};
use tokio::time::{Instant, timeout, timeout_at};

use super::probe::{self, Times};
use super::site::{Radio, Site};

/// Longest flight.
const PATIENCE: Duration = Duration::from_secs(110);
/// A probe on the ground runs this long next to a landing.
const PROBE_S: f64 = 14.0;

/// The outcome of a landing.
#[derive(Default)]
pub(crate) struct Flight {
    pub(crate) landed: bool,
    pub(crate) error_m: f64,
    seconds: f64,
    /// Phase and reason at the end.
    why: String,
    /// Frames that the detector on the ground has taken.
    pub(crate) frames_received: u64,
    frame_age_ms: Option<[f64; 2]>,
    round_trip_ms: Option<[f64; 2]>,
    back: Times,
    cut: Option<Cut>,
}

/// The effects of a cut of the link.
#[derive(Default)]
struct Cut {
    /// From the cut to the onboard detector's being used.
    failover_s: f64,
    /// From the cut's end to the first detections from the ground.
    back_s: Option<f64>,
    /// From the cut's end until it is used again, as it is preferred.
    preferred_s: Option<f64>,
    /// Changes of the detector from the cut on.
    changes: u64,
    /// Detections of the onboard detector arrived on the drone: the longest pause and the oldest, from the cut on.
    longest_pause_ms: f64,
    /// The state of the vehicle was at most so old when it arrived on the drone.
    oldest_state_ms: f64,
    /// Before the cut.
    oldest_state_before_ms: f64,
    longest_pause_before_ms: f64,
}

impl std::fmt::Display for Flight {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let verdict = if self.landed { "landed" } else { "NOT LANDED" };
        write!(f, "{verdict}, {:.3} m off, {:.1} s", self.error_m, self.seconds)?;
        if !self.landed {
            write!(f, " ({})", self.why)?;
        }
        if let Some([p50, p99]) = self.frame_age_ms {
            write!(f, "; {} frames, age p50 {p50:.0} p99 {p99:.0} ms", self.frames_received)?;
        }
        if let Some([p50, p99]) = self.round_trip_ms {
            write!(f, "; to ack p50 {p50:.0} p99 {p99:.0} ms")?;
        }
        let [p50, p99] = [0.5, 0.99].map(|part| self.back.at(part));
        if p50.is_finite() {
            write!(f, "; detections back p50 {p50:.0} p99 {p99:.0} ms")?;
        }
        if let Some(cut) = &self.cut {
            write!(
                f,
                "; failover {:.2} s; ground back after {}, used after {}, {} changes; on the drone: pause {:.0} ms ({:.0} before), state at most {:.0} ms old ({:.0} before)",
                cut.failover_s,
                seconds(cut.back_s),
                seconds(cut.preferred_s),
                cut.changes,
                cut.longest_pause_ms,
                cut.longest_pause_before_ms,
                cut.oldest_state_ms,
                cut.oldest_state_before_ms,
            )?;
        }
        Ok(())
    }
}

fn seconds(seconds: Option<f64>) -> String {
    seconds.map_or("-".to_owned(), |s| format!("{s:.1} s"))
}

/// Everything on the drone, and no link.
pub(crate) async fn onboard(seed: u64) -> anyhow::Result<Option<Flight>> {
    let any = super::GOOD;
    let Some(mut site) = Site::new(any).await? else { return Ok(None) };
    site.drone("detector", &["--set", "id=onboard"])?;
    let watch = Watch::new(&site).await?;
    site.flight(seed, &[])?;
    watch.landing(&mut site).await.map(Some)
}

/// The only detector is on the ground.
pub(crate) async fn ground(
    radio: Radio,
    seed: u64,
    camera: &[&str],
) -> anyhow::Result<Option<Flight>> {
    let Some(mut site) = Site::new(radio).await? else { return Ok(None) };
    site.relay()?;
    site.ground("detector", &["--set", "id=ground", "--set", "input=jpeg"])?;
    let back = probe::beacon(&site.node).await?;
    let watch = Watch::new(&site).await?;
    site.flight(seed, camera)?;
    let probe = site.probe(PROBE_S, false)?;
    let mut flight = watch.landing(&mut site).await?;
    tokio::task::spawn_blocking(move || probe.wait_with_output()).await??;
    flight.back = probe::taken(&back);
    Ok(Some(flight))
}

/// The detector on the ground is used and one onboard is its shadow; the link is cut on the way down.
pub(crate) async fn cut(radio: Radio, seed: u64, seconds: f64) -> anyhow::Result<Option<Flight>> {
    let Some(mut site) = Site::new(radio).await? else { return Ok(None) };
    site.relay()?;
    site.ground("detector", &["--set", "id=ground", "--set", "input=jpeg"])?;
    site.drone("detector", &["--set", "id=onboard"])?;
    let watch = Watch::new(&site).await?;
    site.flight(seed, &[])?;
    let statuses = site.node.subscriber(topic::STATUS, &[]).await?;
    until(&statuses, "both detectors are there, on the way down", |s| {
        s.candidates.len() == 2 && s.phase == Phase::Descend
    })
    .await?;
    // It waits up there, however long the ground takes to keep up on a busy machine.
    for command in [ControllerCommand::Hold, ControllerCommand::UseDetector("ground".into())] {
        site.node.command(topic::COMMAND, &[], &command).await?;
    }
    until(&statuses, "the one on the ground is used", |s| {
        s.active_detector.as_deref() == Some("ground") && s.phase == Phase::Hold
    })
    .await?;
    site.node.command(topic::COMMAND, &[], &ControllerCommand::Resume).await?;
    until(&statuses, "it descends by the one on the ground", |s| {
        s.active_detector.as_deref() == Some("ground")
            && s.phase == Phase::Descend
            && s.height_m.is_some_and(|height_m| height_m < 8.0)
    })
    .await?;
    let mut local = Local::new(&site).await?;
    local.listen(Duration::from_secs(1)).await;
    let before = local.take();
    let changes = |status: &ControllerStatus| status.detector_changes;
    let changed = statuses.next().await.as_ref().map_or(0, changes);
    site.air.cut(true)?;
    let cut = Instant::now();
    let found = tokio::join!(
        until(&statuses, "the onboard one is used", |s| {
            s.active_detector.as_deref() == Some("onboard")
        }),
        local.listen(Duration::from_secs_f64(seconds)),
    );
    let (_, at) = found.0?;
    let during = local.take();
    site.air.cut(false)?;
    let joined = Instant::now();
    let detections = site.node.subscriber(topic::DETECTIONS, &["ground"]).await?;
    let again = timeout(Duration::from_secs(15), detections.next()).await.is_ok();
    let back_s = again.then(|| joined.elapsed().as_secs_f64());
    let is_used = |s: &ControllerStatus| s.active_detector.as_deref() == Some("ground");
    let used = until(&statuses, "the one on the ground is used again", is_used);
    let used = timeout(Duration::from_secs(10), used).await.ok().and_then(Result::ok);
    let preferred_s = used.as_ref().map(|(_, at)| (*at - joined).as_secs_f64());
    // Long enough to see a further change of the detector.
    let end = Instant::now() + Duration::from_secs(3);
    let mut last = used.map(|(status, _)| status);
    while let Ok(Some(status)) = timeout_at(end, statuses.next()).await {
        last = Some(status);
    }
    let changes = last.as_ref().map_or(0, changes).saturating_sub(changed);
    let mut flight = watch.landing(&mut site).await?;
    flight.cut = Some(Cut {
        failover_s: (at - cut).as_secs_f64(),
        back_s,
        preferred_s,
        changes,
        longest_pause_ms: during.0,
        oldest_state_ms: during.1,
        longest_pause_before_ms: before.0,
        oldest_state_before_ms: before.1,
    });
    Ok(Some(flight))
}

/// Waits for a status; when it came.
async fn until(
    statuses: &Subscriber<ControllerStatus>,
    what: &str,
    mut holds: impl FnMut(&ControllerStatus) -> bool,
) -> anyhow::Result<(ControllerStatus, Instant)> {
    let mut last = None;
    let found = timeout(PATIENCE, async {
        while let Some(status) = statuses.next().await {
            if holds(&status) {
                return Some((status, Instant::now()));
            }
            last = Some(status);
        }
        None
    });
    found.await.ok().flatten().with_context(|| format!("waiting until {what}; last: {last:?}"))
}

/// The messages on the drone that come from the drone.
struct Local {
    detections: Subscriber<Detections>,
    states: Subscriber<messages::VehicleState>,
    last: Option<Instant>,
    longest_pause_ms: f64,
    oldest_state_ms: f64,
}

impl Local {
    async fn new(site: &Site) -> anyhow::Result<Self> {
        Ok(Self {
            detections: site.node.subscriber(topic::DETECTIONS, &["onboard"]).await?,
            states: site.node.subscriber(topic::VEHICLE_STATE, &[]).await?,
            last: None,
            longest_pause_ms: 0.0,
            oldest_state_ms: 0.0,
        })
    }

    async fn listen(&mut self, duration: Duration) {
        let end = Instant::now() + duration;
        loop {
            tokio::select! {
                () = tokio::time::sleep_until(end) => return,
                Some(_) = self.detections.next() => {
                    let now = Instant::now();
                    if let Some(last) = self.last.replace(now) {
                        let pause_ms = (now - last).as_secs_f64() * 1e3;
                        self.longest_pause_ms = self.longest_pause_ms.max(pause_ms);
                    }
                }
                Some(state) = self.states.next() => {
                    let age_ms = (now_ns() - state.stamp_ns) as f64 * 1e-6;
                    self.oldest_state_ms = self.oldest_state_ms.max(age_ms);
                }
            }
        }
    }

    /// The longest pause and the oldest state since the last time.
    fn take(&mut self) -> (f64, f64) {
        (std::mem::take(&mut self.longest_pause_ms), std::mem::take(&mut self.oldest_state_ms))
    }
}

/// Watches a landing from its start.
struct Watch {
    truths: Subscriber<Truth>,
    healths: Subscriber<Health>,
    statuses: Subscriber<ControllerStatus>,
}

impl Watch {
    async fn new(site: &Site) -> anyhow::Result<Self> {
        Ok(Self {
            truths: site.node.subscriber(topic::TRUTH, &[]).await?,
            healths: site.node.subscriber(topic::HEALTH, &[]).await?,
            statuses: site.node.subscriber(topic::STATUS, &[]).await?,
        })
    }

    /// Waits until the vehicle has landed and the controller is done.
    async fn landing(self, site: &mut Site) -> anyhow::Result<Flight> {
        let mut flight = Flight::default();
        let mut touchdown: Option<Touchdown> = None;
        let mut done: Option<Instant> = None;
        let mut disarmed = false;
        let deadline = Instant::now() + PATIENCE;
        loop {
            let end = done.unwrap_or(deadline);
            tokio::select! {
                () = tokio::time::sleep_until(end) => break,
                Some(truth) = self.truths.next() => touchdown = truth.touchdown,
                Some(health) = self.healths.next() => flight.take_health(&health),
                Some(status) = self.statuses.next() => {
                    flight.why = format!("{}: {}", status.phase, status.why);
                    if status.finished && done.is_none() {
                        disarmed = status.disarmed_ns.is_some();
                        if let (Some(from), Some(to)) = (status.started_ns, status.disarmed_ns) {
                            flight.seconds = (to - from) as f64 * 1e-9;
                        }
                        done = Some(Instant::now() + Duration::from_millis(1200));
                    }
                }
            }
        }
        site.all_run()?;
        ensure!(done.is_some(), "no end of the flight: {flight}");
        // The truth may be received after the status.
        flight.landed = disarmed && touchdown.is_some();
        flight.error_m = touchdown.map_or(f64::NAN, |touchdown| touchdown.error_m);
        Ok(flight)
    }
}

impl Flight {
    fn take_health(&mut self, health: &Health) {
        let latency = |name: &str| {
            let found = health.latencies.iter().find(|latency| latency.name == name);
            found.map(|latency| [latency.p50_ms, latency.p99_ms])
        };
        match (health.service.as_str(), health.instance.as_str()) {
            ("detector", "ground") => {
                self.frame_age_ms = latency("stamp to frame").or(self.frame_age_ms);
                let frames = health.rates.iter().find(|rate| rate.name == "frames");
                self.frames_received = frames.map_or(self.frames_received, |rate| rate.count);
            }
            ("simulator", _) => {
                self.round_trip_ms = latency("frame sent to ack").or(self.round_trip_ms);
            }
            _ => {}
        }
    }
}
