//! The information (calibration, mount) of up to 16 cameras: added, replaced or refused, and looked up for
//! a frame.
//!
//! The permission to publish is not known here, so a camera's calibration is not replaced by another one while it is
//! being repeated, and never in flight; and unused cameras give way.

use messages::CameraInfo;

/// Maximum number of cameras; of more, those whose frames are used are kept.
const MAX_CAMERAS: usize = 16;
/// Silence after which a camera's calibration may be replaced on the ground, in nanoseconds: cameras repeat
/// it every second.
const SILENT_NS: i64 = 3_500_000_000;
/// Time for which a camera counts as used after the last frame, in nanoseconds.
const USED_NS: i64 = 10_000_000_000;

/// The known cameras.
#[derive(Debug, Default)]
pub struct Cameras {
    known: Vec<Known>,
}

#[derive(Debug)]
struct Known {
    info: CameraInfo,
    /// When it was last repeated.
    repeated_ns: i64,
    /// When a frame was last used with it.
    used_ns: i64,
}

/// The result of the arrival of a camera's information.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Reception {
    /// It is known.
    Known,
    /// It replaces that of a camera which has stopped: with the difference.
    Replaced(String),
    /// It is refused for this reason, which a sentence explains.
    Refused(&'static str, String),
}

impl Cameras {
    /// Adds a camera's information, or refuses it; `is_flying`: a landing is active.
    pub fn add(&mut self, now_ns: i64, info: CameraInfo, is_flying: bool) -> Reception {
        if let Some(problem) = info.problem() {
            let text = format!("the information of camera `{}` is refused: {problem}", info.camera);
            return Reception::Refused("camera-info-impossible", text);
        }
        if let Some(known) = self.known.iter_mut().find(|known| known.info.camera == info.camera) {
            return known.update(now_ns, info, is_flying);
        }
        if self.known.len() >= MAX_CAMERAS {
            let unused = self.known.iter().enumerate().filter(|(_, it)| !it.is_used(now_ns));
            match unused.min_by_key(|(_, known)| known.last_ns()) {
                Some((index, _)) => drop(self.known.swap_remove(index)),
                None => {
                    let text = format!(
                        "camera `{}` is refused: {MAX_CAMERAS} others are used already",
                        info.camera
                    );
                    return Reception::Refused("too-many-cameras", text);
                }
            }
        }
        self.known.push(Known { info, repeated_ns: now_ns, used_ns: i64::MIN });
        Reception::Known
    }

    /// The names of the known cameras, as a list, where this one is not among them.
    pub fn others(&self, camera: &str) -> Option<String> {
        if self.known.iter().any(|known| known.info.camera == camera) {
            return None;
        }
        let names: Vec<_> =
            self.known.iter().map(|known| format!("`{}`", known.info.camera)).collect();
        (!names.is_empty()).then(|| names.join(", "))
    }

    /// The information of a camera of which a frame has arrived.
    pub fn of_frame(&mut self, now_ns: i64, camera: &str) -> Option<&CameraInfo> {
        let known = self.known.iter_mut().find(|known| known.info.camera == camera)?;
        known.used_ns = now_ns;
        Some(&known.info)
    }
}

impl Known {
    fn update(&mut self, now_ns: i64, info: CameraInfo, is_flying: bool) -> Reception {
        let Some(difference) = self.info.difference(&info) else {
            self.repeated_ns = now_ns;
            return Reception::Known;
        };
        let camera = &info.camera;
        if is_flying {
            let text = format!(
                "camera `{camera}` gives another calibration in flight and keeps the one it has: {difference}"
            );
            return Reception::Refused("another-camera-info", text);
        }
        if now_ns.saturating_sub(self.repeated_ns) < SILENT_NS {
            let text = format!(
                "two programs give camera `{camera}` different calibrations: {difference}; stop one of them"
            );
            return Reception::Refused("another-camera-info", text);
        }
        (self.info, self.repeated_ns) = (info, now_ns);
        Reception::Replaced(difference)
    }

    fn last_ns(&self) -> i64 {
        self.repeated_ns.max(self.used_ns)
    }

    fn is_used(&self, now_ns: i64) -> bool {
        self.used_ns != i64::MIN && now_ns.saturating_sub(self.used_ns) < USED_NS
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: i64 = 1_000_000_000;

    fn camera(name: &str, focal_px: f64) -> CameraInfo {
        CameraInfo {
            camera: name.into(),
            focal_px: Some([focal_px, focal_px]),
            ..CameraInfo::sample()
        }
    }

    fn focal(cameras: &mut Cameras, now_ns: i64) -> f64 {
        cameras.of_frame(now_ns, "down").and_then(|info| info.focal_px).map_or(0.0, |[fx, _]| fx)
    }

    #[test]
    fn another_calibration_is_refused_while_the_first_goes_on_and_in_flight() {
        let mut cameras = Cameras::default();
        assert_eq!(cameras.add(0, camera("down", 800.0), false), Reception::Known);
        for (now_ns, is_flying) in [(S, false), (2 * S, true), (30 * S, true)] {
            let refused = cameras.add(now_ns, camera("down", 400.0), is_flying);
            let Reception::Refused("another-camera-info", text) = refused else {
                panic!("{refused:?}")
            };
            assert!(text.contains("800") && text.contains("400"), "{text}");
        }
        assert!((focal(&mut cameras, 30 * S) - 800.0).abs() < 1e-9);
        // The camera was started again with another calibration, on the ground.
        let replaced = cameras.add(31 * S, camera("down", 400.0), false);
        assert!(matches!(replaced, Reception::Replaced(_)), "{replaced:?}");
        assert!((focal(&mut cameras, 31 * S) - 400.0).abs() < 1e-9);
    }

    #[test]
    fn an_impossible_calibration_is_refused() {
        let mut cameras = Cameras::default();
        let broken = camera("down", f64::NAN);
        let refused = cameras.add(0, broken, false);
        assert!(matches!(refused, Reception::Refused("camera-info-impossible", _)), "{refused:?}");
        assert!(cameras.of_frame(0, "down").is_none());
    }

    #[test]
    fn a_used_camera_has_room_among_any_number_of_invented_ones() {
        let mut cameras = Cameras::default();
        for i in 0..MAX_CAMERAS {
            cameras.add(0, camera(&format!("invented{i}"), 800.0), false);
        }
        assert_eq!(cameras.add(1, camera("down", 800.0), false), Reception::Known);
        for i in 0..1000 {
            assert!(cameras.of_frame(i, "down").is_some());
            cameras.add(i, camera(&format!("more{i}"), 800.0), false);
        }
        assert!(cameras.of_frame(2000, "down").is_some());
    }

    #[test]
    fn a_used_camera_that_fell_silent_keeps_its_place_and_takes_no_other_s() {
        let mut cameras = Cameras::default();
        cameras.add(0, camera("down", 800.0), false);
        assert!(cameras.of_frame(0, "down").is_some());
        for i in 1..MAX_CAMERAS {
            cameras.add(S, camera(&format!("invented{i}"), 800.0), false);
        }
        assert_eq!(cameras.add(2 * S, camera("front", 800.0), false), Reception::Known);
        assert!(
            cameras.of_frame(2 * S, "down").is_some() && cameras.of_frame(2 * S, "front").is_some()
        );
    }
}
