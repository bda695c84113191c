//! Compares a new detector with the one in use in the frames that both have searched: the marker's position by axes, and its heading if the
//! vehicle turns to it, against the controller's tolerances.

use std::collections::VecDeque;

use controller::agreement::{angle_between, distance, heading_rad, range};
use geometry::Camera;
use messages::{Configuration, Detections, Transform3};

use crate::staleness::Limits;

/// Latest frames of each of the two that are kept: the later one may be half a second behind.
const MAX_FRAMES: usize = 32;
/// Share of the distance that lies along the view, above which the two differ in range.
const IN_RANGE: f64 = 0.8;

/// The marker's poses by two detectors in the same frames.
#[derive(Default)]
pub(super) struct Comparison {
    controller: Option<controller::Config>,
    used: Seen,
    new: Seen,
    latest: Option<Difference>,
    /// Whether the new one gave no pose of the marker when it last saw it.
    lacks_pose: bool,
}

/// A detector's poses of the marker in the camera frame, by the stamp of the frame.
#[derive(Default)]
struct Seen {
    detector: String,
    at: VecDeque<(i64, Transform3)>,
}

/// The positions in one frame, in metres, and the angle between the headings, in radians.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Difference {
    used_m: [f64; 3],
    new_m: [f64; 3],
    turned_rad: Option<f64>,
}

impl Comparison {
    /// Begins with a detector in use and a new one.
    pub(super) fn of(&mut self, used: Option<&str>, new: &str) {
        for (seen, name) in [(&mut self.used, used.unwrap_or_default()), (&mut self.new, new)] {
            if seen.detector != name {
                *seen = Seen { detector: name.to_owned(), at: VecDeque::new() };
                self.latest = None;
            }
        }
    }

    /// Takes the controller's configuration, which contains the marker and the tolerance between two positions.
    pub(super) fn configured(&mut self, configuration: &Configuration) {
        if configuration.service == "controller"
            && let Ok(read) = node::from_toml("the controller's", &configuration.toml, &[])
        {
            self.controller = Some(read.settings);
        }
    }

    /// True once the controller's configuration is known.
    pub(super) fn is_configured(&self) -> bool {
        self.controller.is_some()
    }

    /// The controller's limits for detectors, by default those of the built-in configuration.
    pub(super) fn limits(&self) -> Option<Limits> {
        self.controller.as_ref().map(Limits::of).or_else(Limits::by_default)
    }

    /// Takes the detections of a frame.
    pub(super) fn found(&mut self, message: &Detections) {
        let detection = match &self.controller {
            Some(controller) => message.first_of(&controller.marker),
            None => message.detections.first(),
        };
        if let Some(detection) = detection
            && message.detector == self.new.detector
        {
            self.lacks_pose = detection.pose.is_none();
        }
        let Some(pose) = detection.and_then(|detection| detection.pose.as_ref()) else { return };
        let seen = match &message.detector {
            name if *name == self.used.detector => &mut self.used,
            name if *name == self.new.detector => &mut self.new,
            _ => return,
        };
        let stamp_ns = message.header.stamp_ns;
        if seen.at.len() == MAX_FRAMES {
            seen.at.pop_front();
        }
        seen.at.push_back((stamp_ns, pose.camera_from_marker));
        let at = |seen: &Seen| seen.at.iter().rev().find(|(at, _)| *at == stamp_ns).map(|it| it.1);
        if let (Some(used), Some(new)) = (at(&self.used), at(&self.new)) {
            let heading = |pose: &Transform3| heading_rad::<Camera>(pose.transform()?.rotation());
            let turned_rad = heading(&used).zip(heading(&new)).map(|(a, b)| angle_between(a, b));
            let (used_m, new_m) = (used.translation_m, new.translation_m);
            self.latest = Some(Difference { used_m, new_m, turned_rad });
        }
    }

    /// Whether the new one saw the marker, and gave no pose of it.
    pub(super) fn lacks_pose(&self) -> bool {
        self.lacks_pose
    }

    /// The latest difference by its axes and the limit, for a person; `None` before there is one.
    pub(super) fn text(&self) -> Option<String> {
        let Difference { used_m, new_m, turned_rad } = self.latest?;
        let apart_m = distance(used_m, new_m);
        // The controller judges by the farther of both, and a size by the one in use.
        let range_m = range(used_m, new_m);
        let used_range_m = distance(used_m, [0.0; 3]);
        let axis = |index: usize, words: [&str; 2]| {
            let by_m =
                new_m.get(index).zip(used_m.get(index)).map_or(0.0, |(new, used)| new - used);
            format!("{:.3} m {}", by_m.abs(), words[usize::from(by_m < 0.0)])
        };
        let tolerance = self.controller.as_ref().map(controller::Config::tolerance);
        let limit = tolerance.map_or_else(
            || "more than `detectors.tolerance_m` and `tolerance_per_m` of the controller let them differ".to_owned(),
            |tolerance| {
                format!(
                    "at this range of {range_m:.2} m they agree up to {:.3} m (`detectors.tolerance_m` of the controller, {}, and \
                     `tolerance_per_m`, {} of the range)",
                    tolerance.at(range_m),
                    tolerance.base_m,
                    tolerance.per_m
                )
            },
        );
        let farther = distance(new_m, [0.0; 3]) / used_range_m - 1.0;
        let hint = if (farther * used_range_m).abs() > IN_RANGE * apart_m && used_range_m > 0.0 {
            let percent = 100.0 * farther.abs();
            let size = if farther > 0.0 { "larger" } else { "smaller" };
            format!(
                ". The direction is the same and the range differs by {percent:.0} %, as where the marker's size or the focal length is given \
                 {percent:.0} % {size}"
            )
        } else {
            String::new()
        };
        let max_rad = tolerance.and_then(|tolerance| tolerance.heading_rad);
        let turned = turned_rad.zip(max_rad).filter(|(rad, max_rad)| rad > max_rad);
        let turned = turned.map_or_else(String::new, |(rad, max_rad)| {
            format!(
                ". It sees the marker turned by {:.0} degrees, and they agree up to {:.0}: as where it begins with another corner",
                rad.to_degrees(),
                max_rad.to_degrees()
            )
        });
        Some(format!(
            "in the latest frame it sees the marker {apart_m:.3} m from where `{}` does ({}, {}, {}, in the camera's view), and {limit}{hint}{turned}",
            self.used.detector,
            axis(0, ["to the right", "to the left"]),
            axis(1, ["down", "up"]),
            axis(2, ["farther", "nearer"]),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::{Detection, FrameHeader, MarkerPose, Transform3};

    fn found(detector: &str, stamp_ns: i64, position_m: [f64; 3]) -> Detections {
        let pose = MarkerPose {
            camera_from_marker: Transform3 {
                translation_m: position_m,
                rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
            },
            reprojection_rms_px: 0.1,
            covariance: [0.0; 21],
            alternative: None,
        };
        let detection = Detection {
            family: "rings".into(),
            id: None,
            centre_px: [0.0; 2],
            centre_covariance_px2: [1.0, 0.0, 1.0],
            corners_px: None,
            size_px: 50.0,
            wrong_bits: 0,
            confidence: 1.0,
            pose: Some(pose),
        };
        Detections {
            detector: detector.into(),
            header: FrameHeader { stamp_ns, ..FrameHeader::sample() },
            detections: vec![detection],
            stages: Vec::new(),
        }
    }

    #[test]
    fn the_difference_is_reported_by_axes_and_against_its_limit() {
        let mut comparison = Comparison::default();
        comparison.of(Some("main"), "new");
        comparison.found(&found("main", 1, [0.0, 0.0, 5.0]));
        comparison.found(&found("new", 2, [0.0, 0.0, 9.0]));
        comparison.found(&found("other", 1, [0.0, 0.0, 9.0]));
        assert_eq!(comparison.text(), None, "no frame of both");
        comparison.found(&found("new", 1, [0.3, -0.1, 5.02]));
        let text = comparison.text().unwrap();
        let axes = "0.317 m from where `main` does (0.300 m to the right, 0.100 m up, 0.020 m farther, in the camera's view)";
        assert!(text.contains(axes), "{text}");
        assert!(text.contains("more than `detectors.tolerance_m`"), "{text}");
        comparison.configured(&Configuration {
            service: "controller".into(),
            instance: "main".into(),
            host: String::new(),
            version: String::new(),
            toml: "[detectors]\ntolerance_m = 0.2".into(),
        });
        assert!(comparison.is_configured() && !comparison.lacks_pose());
        let mut centre = found("new", 3, [0.0; 3]);
        centre.detections[0].pose = None;
        comparison.found(&Detections { detector: "main".into(), ..centre.clone() });
        assert!(!comparison.lacks_pose());
        comparison.found(&centre);
        assert!(comparison.lacks_pose());
        let text = comparison.text().unwrap();
        let limit = "at this range of 5.03 m they agree up to 0.351 m (`detectors.tolerance_m` of the controller, 0.2, and `tolerance_per_m`, 0.03 of the range)";
        assert!(text.ends_with(limit), "{text}");
    }

    #[test]
    fn a_turned_marker_is_reported_where_the_vehicle_turns_to_it() {
        for (turn_rad_s, is_reported) in [(0.0, false), (0.3, true)] {
            let mut comparison = Comparison::default();
            comparison.of(Some("main"), "new");
            comparison.configured(&Configuration {
                service: "controller".into(),
                instance: "main".into(),
                host: String::new(),
                version: String::new(),
                toml: format!(
                    "marker = \"aruco-4x4-50:7\"\n[metric]\nturn_rad_s = {turn_rad_s:.1}"
                ),
            });
            let half = std::f64::consts::FRAC_1_SQRT_2;
            for (name, rotation_wxyz) in
                [("main", [0.0, 1.0, 0.0, 0.0]), ("new", [0.0, half, half, 0.0])]
            {
                let mut message = found(name, 1, [0.0, 0.0, 5.0]);
                let detection = &mut message.detections[0];
                (detection.family, detection.id) = ("aruco-4x4-50".into(), Some(7));
                let pose = detection.pose.as_mut().unwrap();
                pose.camera_from_marker.rotation_wxyz = rotation_wxyz;
                comparison.found(&message);
            }
            let text = comparison.text().unwrap();
            assert_eq!(text.contains("turned by 90 degrees"), is_reported, "{text}");
        }
    }

    #[test]
    fn a_wrong_size_is_recognised_by_the_range() {
        let mut comparison = Comparison::default();
        comparison.of(Some("main"), "new");
        comparison.found(&found("main", 1, [0.5, 0.0, 5.0]));
        comparison.found(&found("new", 1, [0.6, 0.0, 6.0]));
        let text = comparison.text().unwrap();
        assert!(text.contains("1.000 m farther"), "{text}");
        assert!(text.ends_with("is given 20 % larger"), "{text}");
        comparison.found(&found("new", 2, [0.4, 0.0, 4.0]));
        comparison.found(&found("main", 2, [0.5, 0.0, 5.0]));
        let text = comparison.text().unwrap();
        assert!(text.ends_with("is given 20 % smaller"), "{text}");
    }
}
