//! Computes the target of the thesis' guidance: a mean of detections, each joined with the vehicle's motion at its
//! exposure.
//!
//! The mean forgets: high up, where a degree of tilt is 20 cm on the ground, it averages over more detections
//! than close to the ground, where each one is good to millimetres and the vehicle's own position drifts by
//! more. A detection far from the mean is an outlier; several consecutive outliers in agreement start a new
//! mean.

use geometry::{Ned, Point, Vector, squared};
use libm::{fmax, fmin};

use crate::config::TargetConfig;
use crate::decision::{Rejection, TargetEstimate};
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::{History, Motion};
use crate::measurement::check_plausible;
use crate::time::Timestamp;

/// The estimate of the landing point.
#[derive(Clone, Debug)]
pub struct MeanTarget {
    config: TargetConfig,
    mean: Option<Mean>,
    /// Outliers that agree with each other.
    candidate: Option<Mean>,
}

/// An exponentially weighted mean of positions.
#[derive(Copy, Clone, Debug)]
struct Mean {
    position: Point<Ned>,
    stamp: Timestamp,
    detections: u32,
    /// Mean square horizontal distance of the detections from the mean, in m^2.
    spread_m2: f64,
}

impl MeanTarget {
    /// A target without a detection.
    pub fn new(config: TargetConfig) -> Self {
        Self { config, mean: None, candidate: None }
    }

    /// Fuses one marker of a frame, or returns why not.
    pub fn observe(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        history: &History,
    ) -> Result<(), Rejection> {
        let body_from_marker = marker.body_from_marker.ok_or(Rejection::NoPose)?;
        let motion = history.at(frame.stamp).ok_or(Rejection::NoAttitude)?;
        let marker_in_body = body_from_marker.origin() - Point::origin();
        let marker_from_vehicle = motion.ned_from_body * marker_in_body;
        check_plausible(marker_from_vehicle, self.config.max_range_m)?;
        self.fuse(frame.stamp, &motion, marker_from_vehicle)
    }

    /// The estimate relative to a vehicle at `vehicle`, at `now`.
    pub fn estimate(&self, vehicle: Point<Ned>, now: Timestamp) -> Option<TargetEstimate> {
        self.mean.map(|mean| {
            let offset = mean.position - vehicle;
            TargetEstimate {
                position: mean.position,
                velocity: Vector::zero(),
                lateral_error_m: offset.horizontal_norm(),
                height_m: offset.z(),
                age_s: now.seconds_since(mean.stamp),
                deviation_m: mean.spread_m2.sqrt(),
                detections: mean.detections,
                heading_rad: None,
                time_offset_s: 0.0,
                nis: None,
                ambiguous: false,
            }
        })
    }

    fn fuse(
        &mut self,
        stamp: Timestamp,
        motion: &Motion,
        offset: Vector<Ned>,
    ) -> Result<(), Rejection> {
        let position = motion.position + offset;
        let height_m = offset.z();
        let gate_m = self.config.gate_m + self.config.gate_per_height * height_m;
        let smoothing_s = self.config.smoothing_s + self.config.smoothing_s_per_height * height_m;
        let forget_after_s = self.config.forget_after_s;
        let recent =
            self.mean.as_mut().filter(|mean| stamp.seconds_since(mean.stamp) <= forget_after_s);
        let Some(estimate) = recent else {
            self.mean = Some(Mean::new(position, stamp));
            return Ok(());
        };
        if estimate.accepts(position, gate_m) {
            estimate.add(position, stamp, smoothing_s);
            self.candidate = None;
            return Ok(());
        }
        let candidate = match self.candidate {
            Some(mut candidate) if candidate.accepts(position, gate_m) => {
                candidate.add(position, stamp, smoothing_s);
                candidate
            }
            _ => Mean::new(position, stamp),
        };
        if candidate.detections < self.config.restart_after {
            self.candidate = Some(candidate);
            return Err(Rejection::Outlier);
        }
        self.mean = Some(candidate);
        self.candidate = None;
        Ok(())
    }
}

impl Mean {
    fn new(position: Point<Ned>, stamp: Timestamp) -> Self {
        Self { position, stamp, detections: 1, spread_m2: 0.0 }
    }

    fn accepts(&self, position: Point<Ned>, gate_m: f64) -> bool {
        let distance = position - self.position;
        // Range is measured less well than direction.
        distance.horizontal_norm() <= gate_m && distance.z().abs() <= 2.0 * gate_m
    }

    fn add(&mut self, position: Point<Ned>, stamp: Timestamp, smoothing_s: f64) {
        let interval_s = fmax(stamp.seconds_since(self.stamp), 0.0);
        self.detections = self.detections.saturating_add(1);
        let forgetting = interval_s / fmax(smoothing_s + interval_s, 1e-6);
        let weight = fmin(fmax(forgetting, 1.0 / f64::from(self.detections)), 1.0);
        let distance = position - self.position;
        self.position = self.position + distance * weight;
        self.spread_m2 += (squared(distance.horizontal_norm()) - self.spread_m2) * weight;
        self.stamp = stamp;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::{Landed, Mode, VehicleState};
    use geometry::{Pixel, Rotation, Transform};

    /// A vehicle at 5 m that nods, and a detector that sees a marker at `target`.
    struct Scene {
        history: History,
        target: MeanTarget,
        seconds: f64,
    }

    impl Scene {
        fn new() -> Self {
            Self {
                history: History::new(0.1),
                target: MeanTarget::new(TargetConfig::default()),
                seconds: 0.0,
            }
        }

        fn see(&mut self, marker: Point<Ned>) -> Result<(), Rejection> {
            self.seconds += 0.066;
            let stamp = Timestamp::from_seconds(self.seconds);
            let ned_from_body = Rotation::from_euler(
                0.1 * self.seconds.sin(),
                0.2 * (3.0 * self.seconds).cos(),
                2.0,
            );
            let position = Point::new(0.3 * self.seconds, 1.0, -5.0);
            self.history.push(VehicleState {
                stamp,
                ned_from_body,
                position,
                velocity: Vector::new(0.3, 0.0, 0.0),
                mode: Mode::Guided,
                armed: true,
                landed: Landed::InAir,
            });
            let in_body = ned_from_body.inverse() * (marker - position);
            let marker = MarkerInFrame {
                centre: Pixel::new(0.0, 0.0),
                body_from_marker: Some(Transform::new(
                    Rotation::identity(),
                    Point::new(in_body.x(), in_body.y(), in_body.z()),
                )),
                alternative: None,
                covariance_m2: None,
                size_px: None,
                confidence: 1.0,
            };
            let frame = FrameObservation {
                stamp,
                image_size: (1296, 972),
                focal_px: None,
                body_from_camera: None,
                marker: Some(marker),
            };
            self.target.observe(&frame, &marker, &self.history)
        }

        fn estimate(&self) -> TargetEstimate {
            self.target
                .estimate(Point::new(0.0, 0.0, -5.0), Timestamp::from_seconds(self.seconds))
                .unwrap()
        }
    }

    #[test]
    fn tilt_and_motion_do_not_move_the_target() {
        let mut scene = Scene::new();
        for _ in 0..100 {
            scene.see(Point::new(1.5, -1.5, 0.0)).unwrap();
        }
        let estimate = scene.estimate();
        assert!((estimate.position - Point::new(1.5, -1.5, 0.0)).norm() < 1e-9);
        assert!((estimate.lateral_error_m - 1.5f64.hypot(1.5)).abs() < 1e-9);
        assert!((estimate.height_m - 5.0).abs() < 1e-9);
        assert_eq!((estimate.detections, estimate.age_s), (100, 0.0));
    }

    #[test]
    fn an_outlier_is_refused_and_a_steady_new_position_accepted() {
        let mut scene = Scene::new();
        for _ in 0..10 {
            scene.see(Point::new(1.0, 0.0, 0.0)).unwrap();
        }
        assert_eq!(scene.see(Point::new(2.0, 0.0, 0.0)), Err(Rejection::Outlier));
        assert!((scene.estimate().position.x() - 1.0).abs() < 1e-9);
        scene.see(Point::new(1.0, 0.0, 0.0)).unwrap();
        let refused = (0..20).take_while(|_| scene.see(Point::new(2.0, 0.0, 0.0)).is_err()).count();
        assert_eq!(refused, 5);
        assert!((scene.estimate().position.x() - 2.0).abs() < 1e-9);
    }

    #[test]
    fn outliers_that_disagree_never_become_the_target() {
        let mut scene = Scene::new();
        scene.see(Point::new(0.0, 0.0, 0.0)).unwrap();
        for i in 0..50 {
            let side = if i % 2 == 0 { 3.0 } else { -3.0 };
            assert_eq!(scene.see(Point::new(side, 0.0, 0.0)), Err(Rejection::Outlier));
        }
    }

    #[test]
    fn a_marker_above_the_vehicle_is_implausible() {
        assert_eq!(Scene::new().see(Point::new(0.0, 0.0, -6.0)), Err(Rejection::Implausible));
        assert_eq!(Scene::new().see(Point::new(300.0, 0.0, 200.0)), Err(Rejection::Implausible));
    }
}
