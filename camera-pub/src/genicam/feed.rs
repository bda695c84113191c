//! Delivers the frames of a GenICam camera; opens it again after it was unplugged or has stalled.

use std::time::Duration;

use node::now_ns;

use super::camera::{Counts, OpenCamera, Taken, genicam_cameras};
use crate::config::GenicamConfig;
use crate::control::Configured;

/// Time between attempts to open the camera.
const RETRY_NS: i64 = 500_000_000;
/// Maximum time to wait for a frame at once, so that a shutdown is noticed.
const POLL: Duration = Duration::from_millis(50);
/// Time without a frame, complete or torn, after which the camera has stalled, in addition to three periods.
const STALL_NS: i64 = 1_000_000_000;

/// A camera, open or lost.
pub(crate) struct Feed {
    config: GenicamConfig,
    camera: Option<OpenCamera>,
    last_frame_ns: i64,
    retry_ns: i64,
    /// The counts of frames that were not delivered, also of a camera that is lost.
    counts: Counts,
    /// Since when there are no frames, and why.
    outage: Option<(i64, String)>,
}

/// The next event.
pub(crate) enum Next {
    /// A frame, to be given back.
    Frame(Taken),
    /// Nothing yet.
    Nothing,
    /// Nothing for so long: the camera is lost.
    Wait(Duration),
    /// The camera has just been lost, for a reason that is counted.
    Lost(&'static str),
}

impl Feed {
    /// Opens the camera.
    ///
    /// # Errors
    /// It does not answer, or does not support the configuration.
    pub(crate) fn start(config: &GenicamConfig) -> anyhow::Result<Self> {
        let mut config = config.clone();
        // The same one after a loss: another one has another calibration.
        if config.name == "any"
            && let Some(first) = genicam_cameras().into_iter().next()
        {
            config.name = first.name;
        }
        let camera = OpenCamera::start(&config)?;
        let now_ns = now_ns();
        Ok(Self {
            config,
            camera: Some(camera),
            last_frame_ns: now_ns,
            retry_ns: now_ns,
            counts: Counts::default(),
            outage: None,
        })
    }

    /// The next frame, or the event instead of one. It waits briefly; while a lost camera is queried, for up to a few
    /// seconds.
    pub(crate) fn next(&mut self) -> Next {
        let Some(camera) = &mut self.camera else {
            return if now_ns() < self.retry_ns { Next::Wait(POLL) } else { self.reopen() };
        };
        let taken = camera.take(POLL);
        let counts = camera.take_counts();
        self.counts.torn += counts.torn;
        self.counts.other += counts.other;
        self.counts.queued += counts.queued;
        // To open a camera again whose packets are lost on the way brings none of them back.
        if counts.torn > 0 {
            self.last_frame_ns = now_ns();
        }
        if let Some(taken) = taken {
            self.last_frame_ns = now_ns();
            if let Some((since_ns, _)) = self.outage.take() {
                let lost_s = (self.last_frame_ns - since_ns) as f64 * 1e-9;
                tracing::info!(lost_s, "The camera is back");
            }
            return Next::Frame(taken);
        }
        let silent_ns = now_ns() - self.last_frame_ns;
        let period_ns = (1e9 / self.config.rate_hz.max(1e-3)) as i64;
        if camera.is_gone() {
            self.lose("camera unplugged", "it does not answer any more")
        } else if silent_ns > STALL_NS.max(3 * period_ns) {
            self.lose("camera stalled", "it has sent no frame for a second or more")
        } else {
            Next::Nothing
        }
    }

    /// Gives a frame back, to be filled again.
    pub(crate) fn give_back(&mut self, taken: Taken) {
        if let Some(camera) = &mut self.camera {
            camera.give_back(taken);
        }
    }

    /// The counts of frames that were not delivered since the last call.
    pub(crate) fn take_counts(&mut self) -> Counts {
        std::mem::take(&mut self.counts)
    }

    fn lose(&mut self, reason: &'static str, problem: &str) -> Next {
        self.camera = None;
        let now_ns = now_ns();
        self.retry_ns = now_ns + RETRY_NS;
        let since_ns = self.outage.as_ref().map_or(now_ns, |(since_ns, _)| *since_ns);
        // A repeated error is logged once.
        if self.outage.as_ref().is_none_or(|(_, before)| before != problem) {
            tracing::warn!(problem, "The camera is lost; it is opened again until it is back");
        }
        self.outage = Some((since_ns, problem.to_owned()));
        Next::Lost(reason)
    }

    /// How the camera is exposed; `None` while it is lost, and where it does not report that.
    pub(crate) fn configured(&self) -> Option<Configured> {
        self.camera.as_ref()?.configured()
    }

    fn reopen(&mut self) -> Next {
        match OpenCamera::start(&self.config) {
            Ok(camera) => {
                self.camera = Some(camera);
                self.last_frame_ns = now_ns();
                Next::Nothing
            }
            Err(problem) => {
                self.lose("camera unplugged", &format!("{problem:#}"));
                Next::Wait(POLL)
            }
        }
    }
}
