//! Measures on one host the time from a frame to the setpoint, without the time of the detector, while the simulator flies.
//!
//! This process receives the frames as the detector does, and the clock starts there: the time before is the simulator's
//! drawing, in the place of a camera's exposure. The detector states the durations of its stages with its detections, and
//! the controller publishes its target right after it has sent the setpoint. The trial `onehost` measures how long a frame
//! is under way in shared memory.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::time::Duration;

use messages::{Detections, TargetEstimate, topic};
use node::now_ns;
use tokio::time::{Instant, sleep_until};

use crate::link::probe::Times;
use crate::link::site::{Radio, Site};

/// Longest flight.
const PATIENCE: Duration = Duration::from_secs(90);
/// The age of a detection is published in milliseconds: a frame's stamp is found again within this time.
const ROUNDING_NS: i64 = 2_000;

/// The measurements.
pub(crate) struct Setpoint {
    times: Times,
    frames: usize,
    without_marker: usize,
    landed: bool,
}

impl std::fmt::Display for Setpoint {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [p50, p99] = [0.5, 0.99].map(|part| self.times.at(part));
        let end = if self.landed { "landed" } else { "NOT LANDED" };
        write!(
            f,
            "median {p50:.2} ms, p99 {p99:.2} ms, most {:.2} ms of {} frames, {} more without a marker; {end}",
            self.times.at(1.0),
            self.frames,
            self.without_marker
        )
    }
}

/// The times of events of the frame with a stamp, in nanoseconds.
#[derive(Default)]
struct Journal {
    arrived: BTreeMap<i64, i64>,
    searched: BTreeMap<i64, i64>,
    sent: BTreeMap<i64, i64>,
    /// Setpoints for a frame that has one already.
    without_marker: usize,
}

impl Journal {
    fn detections(&mut self, message: &Detections) {
        let micros: u64 = message.stages.iter().map(|stage| u64::from(stage.micros)).sum();
        self.searched.insert(message.header.stamp_ns, micros as i64 * 1000);
    }

    fn target(&mut self, target: &TargetEstimate) {
        if let Some(age_ms) = target.age_ms.filter(|_| target.velocity_ned_m_s.is_some()) {
            let stamp_ns = target.stamp_ns - (age_ms * 1e6) as i64;
            // A frame without a marker has a setpoint as well, and its target still belongs to the last frame with one.
            if self.sent.range(around(stamp_ns)).next().is_none() {
                self.sent.insert(stamp_ns, target.stamp_ns);
            } else {
                self.without_marker += 1;
            }
        }
    }

    /// From each frame's arrival to its setpoint, without the search.
    fn times_ms(&self) -> Vec<f64> {
        let time_ms = |(stamp_ns, sent_ns): (&i64, &i64)| {
            let (stamp_ns, arrived_ns) = self.arrived.range(around(*stamp_ns)).next()?;
            let searched_ns = self.searched.get(stamp_ns)?;
            Some((sent_ns - arrived_ns - searched_ns) as f64 * 1e-6)
        };
        self.sent.iter().filter_map(time_ms).collect()
    }
}

/// Where the stamp of a frame is found.
fn around(stamp_ns: i64) -> RangeInclusive<i64> {
    stamp_ns - ROUNDING_NS..=stamp_ns + ROUNDING_NS
}

/// Flies and measures.
pub(crate) async fn run(radio: Radio, seed: u64) -> anyhow::Result<Option<Setpoint>> {
    let Some(mut site) = Site::new(radio).await? else { return Ok(None) };
    let node = site.node.clone();
    let frames = node.frame_subscriber(topic::FRAME, &[]).await?;
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let targets = node.subscriber(topic::TARGET, &[]).await?;
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    site.drone("detector", &["--set", "id=onboard"])?;
    site.flight(seed, &[])?;
    let mut journal = Journal::default();
    let mut landed = false;
    let end = Instant::now() + PATIENCE;
    while !landed {
        tokio::select! {
            () = sleep_until(end) => break,
            Some(frame) = frames.next() => {
                journal.arrived.insert(frame.header.stamp_ns, now_ns());
            }
            Some(message) = detections.next() => journal.detections(&message),
            Some(target) = targets.next() => journal.target(&target),
            Some(status) = statuses.next() => landed = status.disarmed_ns.is_some(),
        }
    }
    site.all_run()?;
    let mut times = Times::default();
    let found = journal.times_ms();
    let frames = found.len();
    found.into_iter().for_each(|ms| times.add(ms));
    let without_marker = journal.without_marker;
    Ok(Some(Setpoint { times, frames, without_marker, landed }))
}
