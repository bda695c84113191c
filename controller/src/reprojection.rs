//! Checks that a marker's pose and the pixel of its centre agree: the camera must show the pose's translation near that pixel.
//!
//! An inverse transform (marker from camera), swapped axes or a y axis that points up are plausible poses, with a marker in front of the camera and a
//! face towards it. Only its pixel shows that it is elsewhere. In the image's middle all of these agree, so a detector whose poses have
//! disagreed is refused there, too, until they agree away from the middle.

use std::collections::BTreeMap;

use geometry::{Camera, CameraModel, Distortion, Pixel, Point};
use libm::{fmax, fmin, hypot};
use messages::{CameraInfo, Detection, FrameHeader};

use crate::selection::MAX_DETECTORS;

/// The allowed distance between the two pixels: a fixed part, for other conventions of a pixel's origin and coarse searches, in pixels.
const MIN_ALLOWED_PX: f64 = 5.0;
/// A part of the marker's largest extent, which is at most the image's diagonal: the mean of a square's corners is up to a quarter of it
/// from the projection of the square's centre.
const ALLOWED_PER_SIZE: f64 = 0.5;
/// A part of the distance from the principal point: a detector may have a calibration of its own, and give the pixel of a picture that it
/// has undistorted or rectified with another camera matrix. An inverse or mirrored pose is off by up to twice that distance.
const ALLOWED_PER_DISTANCE: f64 = 0.5;
/// Extent of a marker up to which it is unknown, in pixels.
const MIN_SIZE_PX: f64 = 1.0;

/// Excess of detections that disagree over those that agree away from the middle, from which all of a detector's are refused, and its
/// largest value.
const REFUSED_FROM: u32 = 5;
const MAX_EXCESS: u32 = 10;
/// How many times the allowed distance a centre must be away from the principal point for its agreement to count.
const AWAY: f64 = 2.0;

/// What was seen of each detector's poses and centres.
#[derive(Debug, Default)]
pub struct Reprojections {
    /// At most [`MAX_DETECTORS`].
    known: BTreeMap<String, Known>,
}

#[derive(Debug, Default)]
struct Known {
    excess: u32,
    why: String,
}

/// A pose's place in the image.
#[derive(Copy, Clone, Debug)]
struct Reprojection {
    seen: Pixel,
    apart_px: f64,
    allowed_px: f64,
    is_away: bool,
}

impl Reprojections {
    /// Why a detector's pose of a marker is refused, as the end of a sentence on the detector; `None` for one that agrees with its pixel, and
    /// without a pose or a calibration for frames of this size.
    pub fn disagreement(
        &mut self,
        detector: &str,
        detection: &Detection,
        header: &FrameHeader,
        camera: Option<&CameraInfo>,
    ) -> Option<String> {
        let reprojection = camera.and_then(|camera| Reprojection::new(detection, header, camera));
        let disagrees = reprojection.is_some_and(|it| it.apart_px > it.allowed_px);
        if !self.known.contains_key(detector) {
            if !disagrees || self.known.len() >= MAX_DETECTORS {
                return reprojection.filter(|_| disagrees).map(|it| it.text(detection, header));
            }
            self.known.insert(detector.to_owned(), Known::default());
        }
        let known = self.known.get_mut(detector)?;
        if let Some(reprojection) = reprojection.filter(|_| disagrees) {
            known.excess = (known.excess + 1).min(MAX_EXCESS);
            known.why = reprojection.text(detection, header);
            return Some(known.why.clone());
        }
        if reprojection.is_some_and(|it| it.is_away) {
            known.excess = known.excess.saturating_sub(1);
        }
        let is_refused = detection.pose.is_some() && known.excess >= REFUSED_FROM;
        is_refused.then(|| known.why.clone())
    }

    /// Forgets a detector that has ended.
    pub fn ended(&mut self, detector: &str) {
        self.known.remove(detector);
    }

    /// Forgets the detectors that are not known otherwise, once there is no room for another. One of which all detections are refused is known
    /// nowhere else.
    pub fn make_room(&mut self, is_known: impl Fn(&str) -> bool) {
        if self.known.len() >= MAX_DETECTORS {
            self.known.retain(|name, _| is_known(name));
        }
    }

    /// Forgets all of them, as after a change of the calibration by which they were judged.
    pub fn clear(&mut self) {
        self.known.clear();
    }
}

impl Reprojection {
    /// `None` without a pose or an extent, for a camera that is not calibrated for frames of this size, and for a place that its lens model
    /// does not describe.
    fn new(detection: &Detection, header: &FrameHeader, camera: &CameraInfo) -> Option<Self> {
        let [x, y, z] = detection.pose.as_ref()?.camera_from_marker.translation_m;
        let model = camera
            .model()
            .filter(|model| (model.width, model.height) == (header.width, header.height))?;
        let [u, v] = detection.centre_px;
        let centre = Pixel::new(u, v);
        let pinhole = CameraModel { distortion: Distortion::None, ..model };
        let place = Point::<Camera>::new(x, y, z);
        let seen = model.project(place)?;
        let undistorted_px =
            pinhole.project(place).map_or(f64::INFINITY, |it| it.distance(&centre));
        let diagonal_px = hypot(f64::from(header.width), f64::from(header.height));
        let size_px = fmin(extent_px(detection)?, diagonal_px);
        let distance_px = centre.distance(&Pixel::new(model.cx, model.cy));
        let within_px = MIN_ALLOWED_PX + ALLOWED_PER_SIZE * size_px;
        Some(Self {
            seen,
            apart_px: fmin(seen.distance(&centre), undistorted_px),
            allowed_px: within_px + ALLOWED_PER_DISTANCE * distance_px,
            is_away: distance_px > AWAY * within_px,
        })
    }

    fn text(&self, detection: &Detection, header: &FrameHeader) -> String {
        let [x, y, z] =
            detection.pose.as_ref().map_or([0.0; 3], |it| it.camera_from_marker.translation_m);
        let ([u, v], Pixel { x: seen_x, y: seen_y }) = (detection.centre_px, self.seen);
        format!(
            "the marker's pose and its centre disagree: camera `{}` shows the translation ({x:.3}, {y:.3}, {z:.3}) m at pixel ({seen_x:.0}, {seen_y:.0}), `centre_px` is \
             ({u:.0}, {v:.0}), {:.0} px apart, and {:.0} px are allowed; publish the pose of the marker in the camera's frame, not its inverse, in metres to the right, down and forward, and \
             the centre in pixels of the frame",
            header.camera, self.apart_px, self.allowed_px
        )
    }
}

/// The marker's largest extent, in pixels, as stated or by its corners; `None` for an unknown one.
fn extent_px(detection: &Detection) -> Option<f64> {
    let of_corners = |corners: [[f64; 2]; 4]| {
        let diagonal = |a: usize, b: usize| {
            hypot(corners[a][0] - corners[b][0], corners[a][1] - corners[b][1])
        };
        fmax(diagonal(0, 2), diagonal(1, 3))
    };
    let size_px = fmax(detection.size_px, detection.corners_px.map_or(0.0, of_corners));
    (size_px > MIN_SIZE_PX).then_some(size_px)
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Marker;
    use messages::Transform3;

    /// What a check says of a detection of a marker of 0.3 m at this place, where the camera shows it.
    fn found(camera: &CameraInfo, place_m: [f64; 3]) -> Detection {
        let mut detection = Detection::sample();
        let [fx, _] = camera.focal_px.unwrap();
        detection.pose.as_mut().unwrap().camera_from_marker.translation_m = place_m;
        detection.centre_px = camera.pixel_of(place_m).unwrap();
        detection.size_px = 0.3 * std::f64::consts::SQRT_2 * fx / place_m[2];
        detection
    }

    fn check(detection: &Detection, camera: &CameraInfo) -> Option<String> {
        let (width, height) = (camera.width, camera.height);
        let header = FrameHeader { width, height, ..FrameHeader::sample() };
        Reprojections::default().disagreement("mine", detection, &header, Some(camera))
    }

    fn with_place(detection: &Detection, place_m: [f64; 3]) -> Detection {
        let mut detection = detection.clone();
        detection.pose.as_mut().unwrap().camera_from_marker.translation_m = place_m;
        detection
    }

    const FISHEYE: messages::LensModel =
        messages::LensModel::KannalaBrandt([-0.01, 0.03, -0.02, 0.004]);

    #[test]
    fn inverse_swapped_and_mirrored_poses_are_refused_away_from_the_middle() {
        let camera = CameraInfo::sample();
        for place_m @ [x, y, z] in [[1.0, 0.4, 6.0], [-0.9, 0.5, 5.0], [0.5, -1.1, 8.0]] {
            let right = found(&camera, place_m);
            assert_eq!(check(&right, &camera), None, "{place_m:?}");
            let pose = right.pose.unwrap().camera_from_marker;
            let inverse = pose.transform::<Camera, Marker>().unwrap().inverse();
            for wrong in [
                Transform3::from(&inverse).translation_m,
                [y, x, z],
                [x, -y, z],
                [-x, -y, z],
                [-y, x, z],
            ] {
                let why = check(&with_place(&right, wrong), &camera).unwrap_or_default();
                assert!(why.contains("its centre disagree") && why.contains("not its inverse"));
                assert!(why.contains("px are allowed"), "{why}");
            }
        }
    }

    #[test]
    fn the_centre_of_an_honest_detector_agrees() {
        let fisheye =
            CameraInfo { focal_px: Some([500.0; 2]), lens: FISHEYE, ..CameraInfo::sample() };
        for (camera, place_m) in [
            (CameraInfo::sample(), [1.5, 1.1, 6.0]),
            (CameraInfo::sample(), [0.05, 0.05, 0.3]),
            (fisheye.clone(), [5.0, 3.0, 4.0]),
            (fisheye.clone(), [0.4, 0.2, 0.3]),
        ] {
            let right = found(&camera, place_m);
            assert_eq!(check(&right, &camera), None);
            // Of an undistorted picture.
            let pinhole = CameraInfo { lens: messages::LensModel::Pinhole, ..camera.clone() };
            let centre_px = pinhole.pixel_of(place_m).unwrap();
            assert_eq!(check(&Detection { centre_px, ..right.clone() }, &camera), None);
            // With a focal length of its own, and the mean of the corners of a tilted marker.
            let [x, y, z] = place_m;
            assert_eq!(check(&with_place(&right, [1.1 * x, 1.1 * y, z]), &camera), None);
            // Of a picture that shows the whole of a wide lens, with pixels of another width.
            let centre_px = camera.pixel_of([0.7 * x, 0.7 * y, z]).unwrap();
            assert_eq!(check(&Detection { centre_px, ..right.clone() }, &camera), None);
            let [u, v] = right.centre_px;
            let centre_px = [u + 0.25 * right.size_px, v];
            assert_eq!(check(&Detection { centre_px, ..right.clone() }, &camera), None);
            // Nothing is known of a camera of another image size or without a calibration.
            let far = Detection { centre_px: [0.0; 2], ..right };
            let other = CameraInfo { width: 640, ..camera.clone() };
            let uncalibrated = CameraInfo { focal_px: None, ..camera.clone() };
            let header = FrameHeader::sample();
            for camera in [None, Some(&other), Some(&uncalibrated)] {
                let seen = Reprojections::default().disagreement("mine", &far, &header, camera);
                assert_eq!(seen, None);
            }
            assert!(check(&far, &camera).is_some());
            let unknown = Detection { size_px: 0.0, corners_px: None, ..far.clone() };
            assert_eq!(check(&unknown, &camera), None, "a marker of unknown extent");
            assert_eq!(check(&Detection { pose: None, ..far }, &camera), None);
        }
    }

    #[test]
    fn a_detector_that_disagrees_is_refused_in_the_middle_until_it_agrees_away_from_it() {
        let (camera, header) = (CameraInfo::sample(), FrameHeader::sample());
        let mut checks = Reprojections::default();
        let mut is_refused = |detector: &str, place_m: [f64; 3], sign: f64| {
            let [x, y, z] = place_m;
            let mirrored = with_place(&found(&camera, place_m), [sign * x, y, z]);
            checks.disagreement(detector, &mirrored, &header, Some(&camera)).is_some()
        };
        let (away, middle) = ([1.0, 0.2, 6.0], [0.03, 0.0, 6.0]);
        assert!(!is_refused("mine", middle, -1.0), "nothing shows there");
        for _ in 0..20 {
            assert!(is_refused("mine", away, -1.0) && !is_refused("main", away, 1.0));
        }
        assert!(is_refused("mine", middle, -1.0) && !is_refused("main", middle, 1.0));
        let refused = (0..20).filter(|_| is_refused("mine", away, 1.0)).count();
        assert_eq!(refused, (MAX_EXCESS - REFUSED_FROM) as usize, "it is mended");
        assert!(!is_refused("mine", middle, 1.0));
    }

    #[test]
    fn one_wrong_detection_costs_one_and_the_memory_is_bounded() {
        let (camera, header) = (CameraInfo::sample(), FrameHeader::sample());
        let mut checks = Reprojections::default();
        let right = found(&camera, [1.0, 0.2, 6.0]);
        let wrong = with_place(&right, [-1.0, 0.2, 6.0]);
        for i in 0..200 {
            let name = format!("{i}");
            assert!(checks.disagreement(&name, &wrong, &header, Some(&camera)).is_some());
            assert!(checks.disagreement(&name, &right, &header, Some(&camera)).is_none());
        }
        assert_eq!(checks.known.len(), MAX_DETECTORS);
        checks.ended("0");
        assert_eq!(checks.known.len(), MAX_DETECTORS - 1);
        checks.make_room(|_| false);
        assert_eq!(checks.known.len(), MAX_DETECTORS - 1, "there is room");
        assert!(checks.disagreement("0", &wrong, &header, Some(&camera)).is_some());
        checks.make_room(|name| name == "1");
        assert_eq!(checks.known.len(), 1);
        checks.clear();
        assert!(checks.known.is_empty());
    }
}
