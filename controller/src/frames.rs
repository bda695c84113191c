//! Takes the detections of all detectors, refuses those of another clock, from the future or in another's
//! name, and gives the lander the newest frame of the active detector.

use std::collections::BTreeMap;

use autopilot::{MIN_STANDSTILL_NS, without_standstill};
use landing::{FrameObservation, Timestamp};
use messages::{CameraInfo, Detections, DetectorInfo, Place};

use crate::agreement::Sight;
use crate::announced::Announced;
use crate::camera_watch::CameraWatch;
use crate::cameras::{Cameras, Reception};
use crate::config::{Config, PreferredPlace};
use crate::lateness::Lateness;
use crate::namesakes::Namesakes;
use crate::refusals::{Refusals, Warning};
use crate::reprojection::Reprojections;
use crate::selection::{Limits, MAX_DETECTORS, Preference, Selection};
use crate::stamps::Stamps;
use crate::wire;

/// Time without detections that can be used after which a refusal is taken for their absence, in
/// nanoseconds.
const UNUSABLE_NS: i64 = 1_000_000_000;

/// The name of a refusal by the lander: the picture is an old one.
const REPEATED: &str = "repeated-picture";

/// Distance of a stamp from now beyond which it is of another clock, in seconds: no delay and no drift of a clock is as long.
const OTHER_CLOCK_S: f64 = 60.0;

/// Time for which a detector must give no pose before it is reported, in seconds: at a start its first frames come before the calibration,
/// which camera-pub repeats each second.
const NO_POSE_AFTER_S: f64 = 2.0;

/// The newest frame of each detector, and the choice among them.
#[derive(Debug)]
pub struct Frames {
    marker: String,
    /// The clock whose frames are used.
    clock: String,
    max_future_s: f64,
    /// The detectors and the active one.
    pub selection: Selection,
    /// The cameras whose detectors get no frames.
    pub camera_watch: CameraWatch,
    /// The markers that detectors look for, and see instead of the landing's marker.
    announced: Announced,
    /// The stamps that they pass on.
    stamps: Stamps,
    /// Their latencies.
    lateness: Lateness,
    /// Whether their poses agree with the pixels of their markers.
    reprojections: Reprojections,
    /// The programs that publish as one detector.
    namesakes: Namesakes,
    /// The newest frame of each detector, to be used when it becomes the active one.
    newest: BTreeMap<String, FrameObservation>,
    cameras: Cameras,
    refusals: Refusals,
    /// When detections were last kept.
    kept_ns: i64,
    known_changes: u64,
    /// Stamp of the newest frame that was used, with a marker in it or without.
    used_stamp_ns: i64,
    /// Time of the last tick, message or command.
    followed_ns: Option<i64>,
    /// Late frames of the active detector are used only if they are newer than the last one of its
    /// predecessor.
    handover_stamp_ns: i64,
}

/// The result of the arrival of detections.
#[derive(Debug)]
#[expect(clippy::large_enum_variant, reason = "returned and matched at once, never stored")]
pub enum Arrival {
    /// They are kept until they are used.
    Kept,
    /// They are older than the frame that was used last, but the estimator can still fuse them at their own
    /// time.
    Late(FrameObservation),
    /// They are refused for this reason.
    Refused(&'static str),
}

/// The frame to be used now.
#[derive(Debug)]
pub struct Next {
    /// The frame, if there is a new one.
    pub frame: Option<FrameObservation>,
    /// Another detector has become the active one.
    pub is_handover: bool,
}

impl Frames {
    /// No detector and no camera is known yet.
    pub fn new(config: &Config) -> Self {
        Self {
            marker: config.marker.clone(),
            clock: config.clock().to_owned(),
            max_future_s: config.target.max_future_s,
            selection: selection(config),
            announced: Announced::default(),
            stamps: Stamps::default(),
            lateness: Lateness::new(config.target.max_latency_s),
            reprojections: Reprojections::default(),
            namesakes: Namesakes::default(),
            newest: BTreeMap::new(),
            cameras: Cameras::default(),
            refusals: Refusals::default(),
            kept_ns: i64::MIN,
            known_changes: 0,
            used_stamp_ns: i64::MIN,
            followed_ns: None,
            handover_stamp_ns: i64::MIN,
            camera_watch: CameraWatch::default(),
        }
    }

    /// A detector came or went.
    pub fn presence(&mut self, now_ns: i64, detector: &str, alive: bool) {
        self.selection.presence(now_ns, detector, alive);
        if !alive {
            self.camera_watch.ended(detector);
            self.stamps.ended(detector);
            self.lateness.ended(detector);
            self.reprojections.ended(detector);
        }
    }

    /// The information that a detector published on its own key.
    pub fn on_detector_info(&mut self, now_ns: i64, detector: &str, info: &DetectorInfo) {
        self.camera_watch.announced(now_ns, detector, &info.camera);
        self.namesakes.announced(now_ns, detector, info);
        self.selection.set_place(now_ns, detector, info.place);
        self.announced.add(detector, &info.markers);
    }

    /// Adds a camera's calibration and mount, or refuses them; `is_flying`: a landing is active.
    pub fn add_camera(&mut self, now_ns: i64, info: CameraInfo, is_flying: bool) -> Reception {
        self.follow(now_ns);
        let reception = self.cameras.add(now_ns, info, is_flying);
        match &reception {
            Reception::Known => {}
            Reception::Replaced(_) => self.reprojections.clear(),
            Reception::Refused(reason, text) => {
                self.refusals.add(now_ns, reason, || text.clone());
            }
        }
        reception
    }

    /// Adds the detections that were published on the key of the detector `publisher`.
    pub fn add(&mut self, now_ns: i64, publisher: &str, message: &Detections) -> Arrival {
        self.follow(now_ns);
        let header = &message.header;
        // Also where they are refused, the camera has frames.
        self.camera_watch.searched(now_ns, publisher, &header.camera);
        // The key decides which detector may publish; the name in the message is only a claim.
        if message.detector != publisher {
            return self.refuse(now_ns, "another-detectors-name", || {
                format!(
                    "detections are refused: `{publisher}` gives them the name of `{}`; the detector that publishes them must give its own id as `detector` (docs/wire-format.md)",
                    message.detector
                )
            });
        }
        if header.clock != self.clock {
            let ours = self.clock.clone();
            return self.refuse(now_ns, "another-clock", || {
                format!(
                    "detections of `{publisher}` are refused: camera `{}` stamps its frames with the clock `{}`, the controller has `{}`; run both on one machine, or correct the clock's name",
                    header.camera, header.clock, ours
                )
            });
        }
        // Refused here, because later stamps are compared with the newest: one from the future would block
        // them all.
        let ahead_s = header.stamp_ns.saturating_sub(now_ns) as f64 * 1e-9;
        let max_s = self.max_future_s;
        if ahead_s > max_s {
            return self.refuse(now_ns, "from-the-future", || {
                let camera = &header.camera;
                if ahead_s > OTHER_CLOCK_S {
                    let ahead = match ahead_s {
                        days if days > 2.0 * 86_400.0 => format!("{:.0} days", days / 86_400.0),
                        seconds => format!("{seconds:.0} s"),
                    };
                    return format!(
                        "detections of `{publisher}` are refused: the stamps of camera `{camera}` lie {ahead} in the future, as those of another clock, for example the time of day; stamp frames with this host's monotonic clock (`time.monotonic_ns()` in Python), or copy the frame's header unchanged"
                    );
                }
                format!(
                    "detections of `{publisher}` are refused: the stamps of camera `{camera}` lie {ahead_s:.2} s in the future, and {max_s} s are allowed; stamp frames with this host's monotonic clock, or set `target.max_future_s` higher"
                )
            });
        }
        self.announced.searched(now_ns, publisher, message, &self.marker);
        self.stamps.searched(now_ns, publisher, header);
        self.lateness.searched(now_ns, publisher, header.stamp_ns);
        let wanted = message.first_of(&self.marker);
        let published = self.cameras.others(&header.camera);
        let camera = self.cameras.of_frame(now_ns, &header.camera);
        let reprojections = &mut self.reprojections;
        let why = wire::impossible_frame_because(header)
            .or_else(|| wanted.and_then(wire::impossible_because))
            .or_else(|| reprojections.disagreement(publisher, wanted?, header, camera));
        if let Some(why) = why {
            self.refusals.add_of(now_ns, "impossible-marker", publisher, || {
                format!("detections of `{publisher}` are refused: {why}")
            });
            return Arrival::Refused("impossible-marker");
        }
        let mount = camera.and_then(wire::body_from_camera);
        if mount.is_none() && message.detections.iter().any(|detection| detection.pose.is_some()) {
            self.refusals.add(now_ns, "unknown-camera", || {
                if let Some(published) = published {
                    return format!(
                        "markers seen by `{publisher}` have no place: `{publisher}` names camera `{}`, which publishes no camera info; {published} does: copy the \
                         frame's header unchanged",
                        header.camera
                    );
                }
                format!(
                    "markers seen by `{publisher}` have no place: nothing is known of the mount of camera `{}`; set `mount` in its camera-pub, or publish its camera info with one (`camera/{}/info`)",
                    header.camera, header.camera
                )
            });
        } else {
            self.kept_ns = now_ns;
        }
        let marker = wanted.map(|detection| wire::marker_in_frame(detection, mount));
        let sight = wanted.zip(marker.as_ref()).map(|(detection, marker)| {
            Sight::new(detection.pose.is_some(), marker.body_from_marker)
        });
        let focal_px = camera.and_then(|info| {
            let scale = f64::from(header.width) / f64::from(info.width.max(1));
            info.focal_px.map(|[fx, fy]| 0.5 * (fx + fy) * scale)
        });
        let frame = FrameObservation {
            stamp: Timestamp::from_nanos(header.stamp_ns),
            image_size: (header.width, header.height),
            focal_px,
            body_from_camera: mount.map(|mount| mount.rotation()),
            marker,
        };
        if self.selection.received(now_ns, publisher, header.stamp_ns, sight) {
            // A better name may have taken the place of one that was known.
            if self.newest.len() >= MAX_DETECTORS {
                self.newest.retain(|name, _| self.selection.knows(name));
            }
            self.newest.insert(publisher.to_owned(), frame);
            debug_assert!(self.newest.len() <= MAX_DETECTORS);
        } else if self.selection.active() == Some(publisher)
            && (self.handover_stamp_ns..self.used_stamp_ns).contains(&header.stamp_ns)
            && frame.marker.is_some()
        {
            return Arrival::Late(frame);
        }
        Arrival::Kept
    }

    fn refuse(
        &mut self,
        now_ns: i64,
        reason: &'static str,
        text: impl FnOnce() -> String,
    ) -> Arrival {
        self.refusals.add(now_ns, reason, text);
        Arrival::Refused(reason)
    }

    /// The marker of the active detector's newest frame is that of an old picture.
    pub fn repeats_picture(&mut self, now_ns: i64) {
        let Some(name) = self.selection.active() else { return };
        self.refusals.add_of(now_ns, REPEATED, name, || {
            format!(
                "the marker that detector `{name}` sees stays in its place while the vehicle moves: the camera repeats an old picture, or the detector publishes old \
                 detections with the headers of new frames; check the camera, and that the detections of a frame are of its own pixels"
            )
        });
    }

    /// Messages of another version were refused.
    pub fn refused_version(&mut self, now_ns: i64) {
        self.follow(now_ns);
        self.refusals.add(now_ns, "another-version", || {
            "messages of another version are refused; run the same version of alight everywhere (`alight doctor`)".to_owned()
        });
    }

    /// The warnings for the operator.
    pub fn warnings(&self, now_ns: i64) -> Vec<Warning> {
        let mut warnings: Vec<_> = self.refusals.lasting(now_ns).collect();
        warnings.extend(self.selection.warnings(now_ns));
        warnings.extend(self.announced.warnings(now_ns, &self.marker, &self.selection));
        warnings.extend(self.stamps.warnings(now_ns));
        warnings.extend(self.lateness.warnings(now_ns));
        warnings.extend(self.namesakes.warnings(now_ns));
        warnings.extend(self.camera_watch.warnings(now_ns));
        warnings
    }

    /// Why a landing would see no marker, or see it at a wrong position: all detections are refused, or two programs give one camera
    /// different calibrations.
    pub fn obstacle(&self, now_ns: i64) -> Option<String> {
        let is_other = |warning: &Warning| warning.matter == "another-camera-info";
        let other = || self.refusals.lasting(now_ns).find(is_other).map(|warning| warning.text);
        self.refused_because(now_ns).or_else(other)
    }

    /// Why detections are refused, where none can be used.
    fn refused_because(&self, now_ns: i64) -> Option<String> {
        let has_none = now_ns.saturating_sub(self.kept_ns) > UNUSABLE_NS;
        self.refusals.lasting(now_ns).find(|_| has_none).map(|warning| warning.text)
    }

    /// Moves times on over a standstill of this process: what was refused before is not over by that, and frames of that time were not
    /// missing. Messages show a standstill before the tick after it.
    pub fn follow(&mut self, now_ns: i64) {
        let before_ns = self.followed_ns.replace(now_ns).unwrap_or(now_ns);
        let stood_ns = now_ns.saturating_sub(before_ns);
        if stood_ns <= MIN_STANDSTILL_NS {
            return;
        }
        self.camera_watch.stood_still(now_ns, stood_ns);
        self.refusals.stood_still(now_ns, stood_ns);
        self.kept_ns = without_standstill(self.kept_ns, now_ns, stood_ns);
    }

    /// Why a landing that an operator starts would not be led to the marker.
    pub fn start_obstacle(&self, now_ns: i64) -> Option<String> {
        let others = self.obstacle(now_ns).or_else(|| self.selection.no_pose(now_ns));
        others.or_else(|| self.no_detector_looks_for_marker())
    }

    /// The warning that no present detector looks for the landing's marker, if that is so.
    pub fn no_detector_looks_for_marker(&self) -> Option<String> {
        self.announced.no_detector_looks_for(&self.marker, &self.selection)
    }

    /// Why the detector in use leads no landing to the marker although it searches frames.
    pub fn unseen_because(&self, now_ns: i64) -> Option<String> {
        let instead = || {
            let active = self.selection.active()?;
            self.announced.seen_instead(now_ns, active, &self.marker)
        };
        let too_late = || self.lateness.too_late(now_ns, self.selection.active()?);
        let repeats = || {
            let is_it = |warning: &Warning| warning.matter.starts_with(REPEATED);
            self.refusals.lasting(now_ns).find(is_it).map(|warning| warning.text)
        };
        self.refused_because(now_ns)
            .or_else(too_late)
            .or_else(repeats)
            .or_else(|| self.selection.no_pose(now_ns))
            .or_else(|| self.no_detector_looks_for_marker())
            .or_else(instead)
    }

    /// The frame to be used now: the active detector's newest, if it is newer than all that were used.
    pub fn take_next(&mut self) -> Next {
        let next = self.selection.next_frame();
        let frame = next.and_then(|(name, _stamp)| self.newest.get(&name).copied());
        let is_handover = self.selection.changes() != self.known_changes;
        if is_handover {
            self.handover_stamp_ns = self.used_stamp_ns;
            self.known_changes = self.selection.changes();
        }
        if let Some(frame) = &frame {
            self.used_stamp_ns = frame.stamp.nanos();
        }
        Next { frame, is_handover }
    }

    /// Lets time pass, and forgets detectors that have gone.
    pub fn tick(&mut self, now_ns: i64) {
        self.selection.tick(now_ns);
        self.newest.retain(|name, _| self.selection.knows(name));
        self.reprojections.make_room(|name| self.selection.knows(name));
        self.announced.forget(&self.selection);
    }

    /// Age of the newest frame that was used, in seconds.
    pub fn age_s(&self, now_ns: i64) -> f64 {
        now_ns.saturating_sub(self.used_stamp_ns) as f64 * 1e-9
    }
}

/// The choice of the detector, as configured.
fn selection(config: &Config) -> Selection {
    let settings = &config.detectors;
    let limits = Limits {
        max_age_s: settings.max_age_s,
        max_latency_s: config.target.max_latency_s,
        min_rate_hz: settings.min_rate_hz,
        return_after_s: settings.return_after_s,
        tolerance: config.tolerance(),
        needs_pose: config.needs_pose(),
        no_pose_after_s: NO_POSE_AFTER_S,
    };
    let detector = Some(settings.preferred.clone()).filter(|name| !name.is_empty());
    let place = match settings.place {
        PreferredPlace::Any => None,
        PreferredPlace::Onboard => Some(Place::Onboard),
        PreferredPlace::Ground => Some(Place::Ground),
    };
    Selection::new(limits, Preference { detector, place })
}
