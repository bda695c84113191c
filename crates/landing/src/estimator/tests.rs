//! The estimator on a modelled descent with a noisy detector: innovations and errors against the covariance, late frames, outliers,
//! moving pads, an autopilot whose position wanders or jumps.

use super::*;
use crate::event::{Landed, Mode, VehicleState};
use geometry::Body;
use geometry::Pixel;
use nalgebra::Matrix3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

/// A vehicle that descends towards a pad on a curve, and a detector with the noise of its covariance.
struct Scene {
    random: ChaCha8Rng,
    history: History,
    estimator: Estimator,
    seconds: f64,
    pad: Point<Ned>,
    pad_velocity: Vector<Ned>,
    drift: Vector<Ned>,
    tilt_error: [f64; 2],
    late_s: f64,
    noise_m: [f64; 3],
    focal_px: Option<f64>,
}

impl Scene {
    fn new(config: EstimatorConfig, seed: u64) -> Self {
        Self {
            random: ChaCha8Rng::seed_from_u64(seed),
            history: History::new(0.1),
            estimator: Estimator::new(config),
            seconds: 0.0,
            pad: Point::new(1.5, -1.5, 0.0),
            pad_velocity: Vector::zero(),
            drift: Vector::zero(),
            tilt_error: [0.0; 2],
            late_s: 0.0,
            noise_m: [0.004, 0.004, 0.03],
            focal_px: None,
        }
    }

    fn normal(&mut self) -> f64 {
        StandardNormal.sample(&mut self.random)
    }

    /// Position, velocity and attitude at a time.
    fn motion(&self, s: f64) -> (Point<Ned>, Vector<Ned>, Rotation<Ned, Body>) {
        let position =
            Point::new(1.5 + (0.9 * s).sin(), -1.5 + 0.8 * (0.7 * s).cos(), -9.0 + 0.4 * s);
        let velocity = Vector::new(0.9 * (0.9 * s).cos(), -0.56 * (0.7 * s).sin(), 0.4);
        let attitude =
            Rotation::from_euler(0.12 * (1.7 * s).sin(), 0.15 * (1.3 * s).cos(), 0.6 + 0.1 * s);
        (position, velocity, attitude)
    }

    /// Pushes the autopilot's reports of the next `dt_s`.
    fn advance(&mut self, dt_s: f64) {
        let steps = (dt_s / 0.01).round() as u32;
        for _ in 0..steps {
            self.seconds += 0.01;
            let (position, velocity, ned_from_body) = self.motion(self.seconds);
            self.history.push(VehicleState {
                stamp: Timestamp::from_seconds(self.seconds),
                ned_from_body,
                position: position + self.drift * self.seconds,
                velocity: velocity + self.drift,
                mode: Mode::Guided,
                armed: true,
                landed: Landed::InAir,
            });
        }
    }

    /// A frame taken `ago_s` ago.
    fn frame(&mut self, ago_s: f64) -> (FrameObservation, MarkerInFrame) {
        let stamp_s = self.seconds - ago_s;
        let exposed_s = stamp_s + self.late_s;
        let (position, _, ned_from_body) = self.motion(exposed_s);
        let pad = self.pad + self.pad_velocity * exposed_s;
        let in_body = ned_from_body.inverse() * (pad - position);
        let [roll, pitch] = self.tilt_error;
        let seen: Vector<Body> = Rotation::<Body, Body>::from_euler(roll, pitch, 0.0) * in_body;
        let noise = self.noise_m;
        let [x, y, z] = noise.map(|sigma| sigma * self.normal());
        let position = Point::new(seen.x() + x, seen.y() + y, seen.z() + z);
        let heading = Rotation::<Ned, Marker>::from_euler(
            std::f64::consts::PI,
            0.0,
            std::f64::consts::FRAC_PI_2 + 0.3,
        );
        let marker = MarkerInFrame {
            centre: Pixel::new(0.0, 0.0),
            body_from_marker: Some(Transform::new(ned_from_body.inverse() * heading, position)),
            alternative: None,
            covariance_m2: Some(Matrix3::from_diagonal(&noise.map(|s| s * s).into())),
            size_px: None,
            confidence: 1.0,
        };
        let stamp = Timestamp::from_seconds(stamp_s);
        (
            FrameObservation {
                stamp,
                image_size: (1296, 972),
                focal_px: self.focal_px,
                body_from_camera: None,
                marker: None,
            },
            marker,
        )
    }

    fn see(&mut self, ago_s: f64) -> Result<(), Rejection> {
        let (frame, marker) = self.frame(ago_s);
        self.estimator.observe(&frame, &marker, &self.history)
    }

    /// Error of the estimated position.
    fn error(&self) -> Vector<Ned> {
        let estimate = self.estimate();
        let (position, _, _) = self.motion(self.seconds);
        let pad = self.pad + self.pad_velocity * self.seconds;
        estimate.position - (position + self.drift * self.seconds) - (pad - position)
    }

    fn estimate(&self) -> TargetEstimate {
        let newest = self.history.newest().unwrap();
        let origin = self.history.ned_from_odometry();
        self.estimator.estimate(newest.position, origin, newest.stamp).unwrap()
    }
}

/// A detector that states this part of its deviation.
fn overconfident(share: f64, seed: u64) -> (Scene, usize) {
    let mut scene = Scene::new(EstimatorConfig::default(), seed);
    scene.noise_m = [0.05; 3];
    scene.pad_velocity = Vector::new(0.5, -0.3, 0.0);
    let mut refused = 0;
    for _ in 0..150 {
        scene.advance(0.07);
        let (frame, mut marker) = scene.frame(0.0);
        marker.covariance_m2 = marker.covariance_m2.map(|it| it * (share * share));
        refused += usize::from(scene.estimator.observe(&frame, &marker, &scene.history).is_err());
    }
    (scene, refused)
}

#[test]
fn a_covariance_that_is_far_too_small_is_raised_to_the_scatter_and_reported() {
    let mut errors_m = [0.0; 2];
    for seed in 0..20 {
        let (scene, refused) = overconfident(1.0, seed);
        assert_eq!(scene.estimator.scatter(), None, "{seed}");
        assert!(refused <= 3, "{seed}: {refused}");
        errors_m[0] += scene.error().horizontal_norm() / 20.0;
        let (scene, refused) = overconfident(1e-3, seed);
        let excess = scene.estimator.scatter().unwrap();
        assert!((0.03..0.08).contains(&excess.measured_m), "{seed}: {excess:?}");
        assert!(excess.stated_m < 0.02, "{seed}: {excess:?}");
        assert!(refused <= 40, "{seed}: {refused} of 150 refused");
        errors_m[1] += scene.error().horizontal_norm() / 20.0;
        // Raising the covariance restarts nothing.
        let lag_m_s = (scene.estimate().velocity - scene.pad_velocity).horizontal_norm();
        assert!(lag_m_s < 0.15, "{seed}: {lag_m_s} m/s");
    }
    assert!(errors_m[1] < 1.3 * errors_m[0], "{errors_m:?}");
}

/// No noise but the detector's.
fn exact() -> EstimatorConfig {
    EstimatorConfig {
        attitude_noise_rad: 1e-5,
        position_noise_m: 1e-4,
        odometry_noise_m: 0.0005,
        drift_change: 0.0005,
        height_drift_change: 0.0005,
        tilt_change: 1e-5,
        range_floor_ratio: 0.0,
        ..EstimatorConfig::default()
    }
}

#[test]
fn normalised_innovations_are_chi_square() {
    let (mut sum, mut count, mut beyond) = (0.0, 0u32, 0u32);
    for seed in 0..40 {
        let mut scene = Scene::new(exact(), seed);
        let [roll, pitch] = [(); 2].map(|()| 0.005 * scene.normal());
        let [north, east] = [(); 2].map(|()| 0.03 * scene.normal());
        scene.tilt_error = [roll, pitch];
        scene.late_s = 0.015 * scene.normal();
        scene.drift = Vector::new(north, east, 0.0);
        for _ in 0..150 {
            scene.advance(0.07);
            let _ = scene.see(0.03);
            if let Some(nis) = scene.estimator.nis {
                sum += nis;
                count += 1;
                beyond += u32::from(nis > 7.81);
            }
        }
    }
    // Of 6000 values with 3 degrees of freedom the mean is 3 within 0.03, and one in twenty is above 7.81.
    let (mean, part) = (sum / f64::from(count), f64::from(beyond) / f64::from(count));
    assert!((2.85..3.15).contains(&mean), "{mean}");
    assert!((0.04..0.06).contains(&part), "{part}");
}

#[test]
fn errors_are_as_large_as_the_covariance_states() {
    let mut squares = 0.0;
    let n = 60;
    for seed in 0..n {
        let mut scene = Scene::new(exact(), seed);
        scene.tilt_error = [0.005 * scene.normal(), 0.005 * scene.normal()];
        for _ in 0..100 {
            scene.advance(0.07);
            let _ = scene.see(0.03);
        }
        let error = scene.error();
        let state = &scene.estimator.past.back().unwrap().state;
        squares += state.normalised_error(error.coords);
    }
    let mean = squares / n as f64;
    assert!((2.0..4.2).contains(&mean), "normalised squared error {mean}, expected 3");
}

#[test]
fn late_and_mixed_up_detections_give_the_same_as_those_in_order() {
    let order = |late: bool| {
        let mut scene = Scene::new(EstimatorConfig::default(), 5);
        for i in 0..40 {
            scene.advance(0.1);
            let mut frames = [scene.frame(0.08), scene.frame(0.05), scene.frame(0.02)];
            if late && i > 0 {
                frames.rotate_left(i % 3);
                frames.swap(0, 1);
            }
            for (frame, marker) in frames {
                scene.estimator.observe(&frame, &marker, &scene.history).unwrap();
            }
        }
        scene.estimate()
    };
    let (straight, mixed) = (order(false), order(true));
    assert!((straight.position - mixed.position).norm() < 1e-9);
    assert!((straight.deviation_m - mixed.deviation_m).abs() < 1e-9);
}

#[test]
fn duplicates_and_detections_before_the_memory_are_refused() {
    let mut scene = Scene::new(EstimatorConfig::default(), 1);
    scene.advance(0.5);
    let (frame, marker) = scene.frame(0.2);
    scene.estimator.observe(&frame, &marker, &scene.history).unwrap();
    let again = scene.estimator.observe(&frame, &marker, &scene.history);
    assert_eq!(again, Err(Rejection::Duplicate));
    assert_eq!(scene.see(0.3), Err(Rejection::Stale), "before the oldest kept detection");
    for _ in 0..2 * MEMORY {
        scene.advance(0.05);
        scene.see(0.0).unwrap();
    }
    assert_eq!(scene.estimator.past.len(), MEMORY);
    assert_eq!(
        scene.estimator.past.capacity(),
        Estimator::new(EstimatorConfig::default()).past.capacity()
    );
}

#[test]
fn a_moving_pad_is_followed_and_a_wrong_stamp_found() {
    let config = EstimatorConfig {
        pad_speed_m_s: 4.0,
        pad_acceleration: 0.05,
        ..EstimatorConfig::default()
    };
    let mut scene = Scene::new(config, 3);
    scene.pad_velocity = Vector::new(2.0, -1.0, 0.0);
    scene.pad = Point::new(-14.0, 6.0, 0.0);
    let mut scene = Scene { pad: scene.motion(0.0).0 + Vector::new(0.5, 0.5, 9.0), ..scene };
    for _ in 0..60 {
        scene.advance(0.05);
        scene.see(0.02).unwrap();
    }
    let estimate = scene.estimate();
    assert!((estimate.velocity - scene.pad_velocity).horizontal_norm() < 0.1, "{estimate:?}");
    let mut scene = Scene::new(EstimatorConfig::default(), 4);
    scene.late_s = 0.04;
    for _ in 0..120 {
        scene.advance(0.07);
        let _ = scene.see(0.05);
    }
    let found_s = scene.estimate().time_offset_s;
    assert!((found_s - 0.04).abs() < 0.006, "{found_s} s");
}

#[test]
fn the_autopilots_drift_is_followed_like_a_moving_pad() {
    let mut scene = Scene::new(EstimatorConfig::default(), 2);
    scene.drift = Vector::new(0.05, -0.03, 0.0);
    for _ in 0..150 {
        scene.advance(0.07);
        scene.see(0.03).unwrap();
    }
    assert!(scene.error().horizontal_norm() < 0.01, "{:?}", scene.error());
    // In the drifting frame of the autopilot, the pad moves with the drift.
    assert!((scene.estimate().velocity - scene.drift).horizontal_norm() < 0.015);
}

#[test]
fn the_process_noise_grows_only_for_an_autopilot_that_wanders() {
    let fly = |max_drift_change: f64, wander_m_s: f64| {
        let config = EstimatorConfig { max_drift_change, ..EstimatorConfig::default() };
        let mut scene = Scene::new(config, 12);
        let home = scene.pad;
        let (mut refused, mut worst_m) = (0, 0.0f64);
        for i in 0..300 {
            // The reported position moves away and returns, and the reported attitude tilts as that
            // velocity changes.
            let (sin, cos) = (1.2 * scene.seconds).sin_cos();
            scene.pad = home + Vector::new(wander_m_s / 1.2 * sin, 0.0, 0.0);
            scene.tilt_error = [0.0, 0.1 * wander_m_s * cos];
            scene.advance(0.07);
            refused += u32::from(scene.see(0.03).is_err());
            if i > 30 {
                worst_m = worst_m.max(scene.error().horizontal_norm());
            }
        }
        let log_noise_scale = scene.estimator.past.back().unwrap().state.log_noise_scale();
        (refused, worst_m, log_noise_scale)
    };
    let (trusting, adjusted) = (fly(0.0, 0.15), fly(0.15, 0.15));
    assert!(
        adjusted.0 < 5 && adjusted.0 <= trusting.0,
        "refused of 300: {trusting:?}, {adjusted:?}"
    );
    assert!(adjusted.1 < 0.16 && adjusted.1 < trusting.1, "{trusting:?}, {adjusted:?}");
    assert!(adjusted.2 > 1.0, "{adjusted:?}");
    let steady = fly(0.15, 0.0);
    assert!(steady.0 == 0 && steady.2 < 0.5, "{steady:?}");
}

#[test]
fn a_position_that_wanders_low_over_the_pad_is_followed() {
    // Each frame the reported position is 2 cm further off, as that of an autopilot whose velocity errs by 0.3 m/s; detections of a
    // pad that is near are good to a millimetre.
    let fly = |step_m: f64| {
        let mut scene = Scene::new(EstimatorConfig::default(), 5);
        scene.noise_m = [0.001; 3];
        let (mut refused, mut max_nis) = (0, 0.0f64);
        for i in 0..310 {
            scene.advance(0.07);
            if i >= 290 {
                scene.pad = scene.pad + Vector::new(0.0, step_m, 0.0);
            }
            let is_refused = scene.see(0.03).is_err();
            refused += u32::from(is_refused);
            if !is_refused {
                max_nis = max_nis.max(scene.estimate().nis.unwrap_or(0.0));
            }
        }
        (refused, scene.error().horizontal_norm(), max_nis)
    };
    let (refused, error_m, nis) = fly(0.02);
    assert!(refused <= 2 && error_m < 0.02, "{refused} refused, {error_m} m off");
    // A marker that is followed is reported with the NIS that it had.
    assert!(nis > 1.5 * EstimatorConfig::default().gate, "{nis}");
    // No autopilot's position is as quick as this.
    assert!(fly(0.2).0 > 10, "{:?}", fly(0.2));
}

#[test]
fn a_height_that_jumps_is_no_pad_that_sinks() {
    // As of a descending vehicle's frames whose stamps are too old by several hundredths of a second.
    let mut scene = Scene::new(EstimatorConfig::default(), 5);
    scene.noise_m = [0.001; 3];
    let home = scene.pad;
    for _ in 0..290 {
        scene.advance(0.07);
        assert_eq!(scene.see(0.03), Ok(()));
    }
    for wrong_m in [0.06, 0.12] {
        scene.advance(0.07);
        scene.pad = home + Vector::new(0.0, 0.0, wrong_m);
        assert_eq!(scene.see(0.03), Err(Rejection::Outlier), "{wrong_m} m");
    }
    let down_m_s = scene.estimate().velocity.z();
    assert!(down_m_s.abs() < 0.05, "{down_m_s} m/s");
}

#[test]
fn a_pad_far_below_is_followed_while_the_tilt_wanders() {
    // As of an autopilot whose velocity errs by 0.3 m/s; far up the detector finds the marker now and then only.
    let fly = |tilt_rad: f64, decoy_m: f64| {
        let mut scene = Scene::new(EstimatorConfig::default(), 11);
        scene.pad = Point::new(1.5, -1.5, 19.0);
        scene.noise_m = [0.03, 0.03, 0.3];
        let mut refused = 0;
        for i in 0..60 {
            scene.advance(if i % 3 == 0 { 0.9 } else { 0.07 });
            scene.tilt_error = [tilt_rad * (0.8 * scene.seconds).sin(); 2];
            if i == 50 {
                scene.pad = scene.pad + Vector::new(decoy_m, 0.0, 0.0);
            }
            refused += u32::from(scene.see(0.03).is_err());
        }
        refused
    };
    assert!(fly(0.008, 0.0) <= 5, "{} refused", fly(0.008, 0.0));
    assert_eq!(fly(0.0, 0.0), 0);
    // From now on another marker is seen, until it is the one that is there.
    assert!(fly(0.0, 1.0) >= 5, "{} refused", fly(0.0, 1.0));
}

#[test]
fn only_a_steady_majority_becomes_the_target() {
    let home = Point::new(1.5, -1.5, 0.0);
    let away = Point::new(1.5, -0.5, 0.0);
    let fly = |first: Point<Ned>, wrong: fn(u32) -> bool| {
        let mut scene = Scene::new(EstimatorConfig::default(), 6);
        for i in 0..150 {
            scene.advance(0.07);
            scene.pad = if i < 3 {
                first
            } else if wrong(i) {
                away
            } else {
                home
            };
            let _ = scene.see(0.03);
        }
        scene.pad = home;
        scene.error().horizontal_norm()
    };
    assert!(fly(home, |i| i % 3 == 0) < 0.02, "a third of the detections is wrong");
    assert!(fly(away, |i| i % 3 == 0) < 0.02, "it started with the wrong one");
    assert!(fly(home, |i| (60..74).contains(&i)) < 0.02, "a second of outliers");
    assert!((fly(home, |i| i > 60) - 1.0).abs() < 0.02, "the marker is elsewhere now");
}

#[test]
fn a_pad_that_blinks_does_not_lose_to_a_position_out_of_view() {
    let mut scene = Scene::new(EstimatorConfig::default(), 10);
    scene.focal_px = Some(1818.0);
    let home = scene.pad;
    let mut after_blinking_m = 0.0;
    for i in 0..130 {
        scene.advance(0.07);
        // Four detections where the image ends, long ago, and 3 s without the pad, which is there before and
        // after.
        let is_away = (20..24).contains(&i);
        scene.pad = if is_away { home + Vector::new(4.5, 0.0, 0.0) } else { home };
        if (40..82).contains(&i) {
            let (frame, _) = scene.frame(0.03);
            scene.estimator.miss(&frame, &scene.history);
            after_blinking_m = scene.error().horizontal_norm();
        } else {
            let _ = scene.see(0.03);
        }
    }
    assert!(after_blinking_m < 0.1, "{after_blinking_m} m");
    assert!(scene.error().horizontal_norm() < 0.02 && !scene.estimate().ambiguous);
}

#[test]
fn of_two_poses_the_upright_one_is_used() {
    let mut scene = Scene::new(EstimatorConfig::default(), 8);
    for i in 0..60 {
        scene.advance(0.07);
        let (frame, marker) = scene.frame(0.03);
        let pose = marker.body_from_marker.unwrap();
        let tilted = Rotation::<Body, Body>::from_euler(0.5, 0.2, 0.0) * pose.rotation();
        let shifted = pose.origin() + Vector::new(0.1, 0.0, 0.0);
        let other = Transform::new(tilted, shifted);
        let (first, second) = if i % 2 == 0 { (pose, other) } else { (other, pose) };
        let marker =
            MarkerInFrame { body_from_marker: Some(first), alternative: Some(second), ..marker };
        scene.estimator.observe(&frame, &marker, &scene.history).unwrap();
    }
    assert!(scene.error().horizontal_norm() < 0.02, "{:?}", scene.error());
}

#[test]
fn the_heading_of_the_pad_is_that_of_the_markers_upper_edge() {
    let mut scene = Scene::new(EstimatorConfig::default(), 9);
    for _ in 0..60 {
        scene.advance(0.07);
        scene.see(0.03).unwrap();
    }
    assert!((scene.estimate().heading_rad.unwrap() - 0.3).abs() < 0.02);
}

#[test]
fn a_jump_of_the_autopilots_position_moves_the_pad_along() {
    let mut scene = Scene::new(EstimatorConfig::default(), 7);
    for _ in 0..40 {
        scene.advance(0.07);
        scene.see(0.03).unwrap();
    }
    let before = scene.estimate();
    // From one report to the next everything is a metre further north.
    scene.seconds += 0.01;
    let (position, velocity, ned_from_body) = scene.motion(scene.seconds);
    scene.history.push(VehicleState {
        stamp: Timestamp::from_seconds(scene.seconds),
        ned_from_body,
        position: position + Vector::new(1.0, 0.0, 0.0),
        velocity,
        mode: Mode::Guided,
        armed: true,
        landed: Landed::InAir,
    });
    let after = scene.estimate();
    assert!((after.position.x() - before.position.x() - 1.0).abs() < 0.02);
    assert!((after.lateral_error_m - before.lateral_error_m).abs() < 0.02);
}

#[test]
fn a_marker_above_the_vehicle_is_implausible() {
    let mut scene = Scene::new(EstimatorConfig::default(), 1);
    scene.advance(0.5);
    scene.pad = Point::new(1.5, -1.5, -30.0);
    assert_eq!(scene.see(0.0), Err(Rejection::Implausible));
}
