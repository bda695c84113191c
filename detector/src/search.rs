//! Searches one frame for the configured markers: the same for frames that come over the network and for those of a recording.

use std::time::{Duration, Instant};

use fiducial::{Detector, Observation, ResponseMemory, StageObserver, Trace, Tracker};
use geometry::CameraModel;
use imaging::{GrayImage, GrayView};
use markers::Pad;
use messages::{Detection, FrameHeader, FramePart, StageTime};

use crate::config::Config;
use crate::{parts, wire};

/// A detector with the markers that it tracks from frame to frame.
pub struct Search {
    detector: Detector,
    pads: Vec<Pad>,
    tracker: Tracker,
    min_confidence: f64,
    searched: Searched,
    /// Of a frame in parts: all of them, in the whole frame's pixels.
    parts_trace: Trace,
}

/// How the last frame was searched: at once, or part by part.
#[derive(Copy, Clone, Debug)]
enum Searched {
    Whole,
    Parts,
}

impl Search {
    /// As configured.
    ///
    /// # Errors
    /// States which marker or pad is wrong and why.
    pub fn new(config: &Config) -> Result<Self, String> {
        Ok(Self {
            detector: config.detector()?,
            pads: config.parsed_pads()?,
            tracker: Tracker::new(config.tracking()),
            min_confidence: config.min_confidence,
            searched: Searched::Whole,
            parts_trace: Trace::default(),
        })
    }

    /// The markers in a whole frame. Without `camera`, its model, they have no pose.
    pub fn whole(
        &mut self,
        view: GrayView<'_>,
        header: &FrameHeader,
        camera: Option<&CameraModel>,
        clock: &mut StageClock,
    ) -> Vec<Detection> {
        self.searched = Searched::Whole;
        let time_s = header.stamp_ns as f64 * 1e-9;
        let found = self.tracker.detect(&mut self.detector, view, camera, time_s, clock);
        published(found, &self.pads, camera, self.min_confidence)
    }

    /// The markers in parts of a frame, in the whole one's pixels; `camera` is that of the whole frame.
    pub fn parts(
        &mut self,
        parts: &[(FramePart, &GrayImage)],
        header: &FrameHeader,
        camera: Option<&CameraModel>,
        clock: &mut StageClock,
    ) -> Vec<Detection> {
        if header.parts.is_empty()
            && let Some(view) = parts.first().and_then(|(_, image)| image.view())
        {
            return self.whole(view, header, camera, clock);
        }
        self.searched = Searched::Parts;
        self.parts_trace.clear();
        let mut found = Vec::new();
        for (part, image) in parts.iter().rev() {
            let Some(view) = image.view() else { continue };
            let roi = parts::roi(part);
            let camera_of_part = camera.map(|camera| roi.camera(camera));
            let seen = self.detector.detect(view, camera_of_part.as_ref(), clock);
            parts::add_finer(&mut found, seen.iter().map(|seen| seen.mapped(&roi)));
            self.parts_trace.add_roi(self.detector.trace(), &roi);
        }
        found.sort_by(|a, b| b.confidence.total_cmp(&a.confidence));
        published(&found, &self.pads, camera, self.min_confidence)
    }

    /// The candidates of the last frame, in the whole frame's pixels.
    pub fn trace(&self) -> &Trace {
        match self.searched {
            Searched::Whole => self.tracker.trace(),
            Searched::Parts => &self.parts_trace,
        }
    }

    /// The candidates of the image that was searched last, in its own pixels: the whole frame, or its finest part.
    pub fn trace_of_image(&self) -> &Trace {
        match self.searched {
            Searched::Whole => self.tracker.trace(),
            Searched::Parts => self.detector.trace(),
        }
    }

    /// The stored estimates of the camera's response to light.
    pub fn response(&self) -> &ResponseMemory {
        self.tracker.response()
    }
}

/// The detections to publish, in the whole frame's pixels: markers with a sufficient confidence, and the
/// pads of which these are parts.
fn published(
    found: &[Observation],
    pads: &[Pad],
    camera: Option<&CameraModel>,
    min_confidence: f64,
) -> Vec<Detection> {
    let sure = found.iter().filter(|seen| seen.confidence >= min_confidence);
    let pads = pads.iter().filter_map(|pad| {
        let seen = fiducial::observe_pad(pad, sure.clone(), camera?)?;
        Some(wire::pad_detection(pad, &seen))
    });
    sure.clone().map(wire::detection).chain(pads).collect()
}

/// Times the stages of a search.
pub struct StageClock {
    started: Instant,
    last: Instant,
    stages: Vec<StageTime>,
}

impl StageClock {
    /// The first stage begins.
    pub fn start() -> Self {
        let now = Instant::now();
        Self { started: now, last: now, stages: Vec::with_capacity(8) }
    }

    /// Time since the start.
    pub fn elapsed(&self) -> Duration {
        self.started.elapsed()
    }

    /// The stages in the order in which they ran.
    pub fn into_stages(self) -> Vec<StageTime> {
        self.stages
    }
}

impl StageObserver for StageClock {
    fn ended(&mut self, stage: &'static str) {
        let now = Instant::now();
        let micros = u32::try_from(now.duration_since(self.last).as_micros()).unwrap_or(u32::MAX);
        // Several parts of a frame may be searched one after the other.
        match self.stages.iter_mut().find(|it| it.stage == stage) {
            Some(again) => again.micros = again.micros.saturating_add(micros),
            None => self.stages.push(StageTime { stage: stage.to_owned(), micros }),
        }
        self.last = now;
    }
}
