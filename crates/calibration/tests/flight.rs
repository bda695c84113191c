//! Tests the calibration from simulated flights, telemetry and markers of cameras whose truth is known: time offset, mount,
//! focal length and k1 with honest deviations, and flights that are refused.

use calibration::flight::{MIN_MARKERS, QUANTITIES, calibrate_flight};
use calibration::{
    ConfiguredCamera, FlightCalibration, FlightRefusal, MarkerSample, Quantity, VehicleSample,
};
use geometry::{Body, Camera, CameraModel, Ned, Point, Rotation, Transform, Vector};
use nalgebra::Matrix3;
use proptest::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

/// A camera's true parameters, relative to its configuration.
#[derive(Copy, Clone, Debug, Default)]
struct Truth {
    offset_s: f64,
    mount_rad: [f64; 3],
    focal: f64,
}

/// How a flight is flown.
#[derive(Copy, Clone, Debug)]
struct Flown {
    seed: u64,
    seconds: f64,
    /// Horizontal excursions, in metres, and the part of the descent that is flown.
    sway_m: f64,
    descent: f64,
    turn_rad: f64,
    /// Errors of the autopilot's estimate, relative to those that logs show.
    errors: f64,
}

impl Flown {
    fn landing(seed: u64) -> Self {
        Self { seed, seconds: 60.0, sway_m: 0.6, descent: 1.0, turn_rad: 1.5, errors: 1.0 }
    }

    fn hover(seed: u64) -> Self {
        Self { sway_m: 0.0, descent: 0.0, turn_rad: 0.0, ..Self::landing(seed) }
    }
}

const GRAVITY_M_S2: f64 = 9.81;
const CAMERA_HZ: f64 = 15.0;
const AUTOPILOT_HZ: f64 = 40.0;

/// True motion: a descent with swings and turns; the vehicle leans as it accelerates.
struct Path {
    flown: Flown,
    waves: [[f64; 2]; 6],
}

impl Path {
    fn new(flown: Flown, random: &mut ChaCha8Rng) -> Self {
        let mut wave = |slow: f64| [slow * (1.0 + 0.1 * normal(random)), 3.0 * normal(random)];
        Self { flown, waves: [wave(1.3), wave(1.1), wave(0.55), wave(0.6), wave(0.25), wave(0.4)] }
    }

    fn position(&self, t: f64) -> Vector<Ned> {
        let [a, b, c, d, ..] = self.waves;
        let swing = |[rate, phase]: [f64; 2]| (rate * t + phase).sin();
        let sway = self.flown.sway_m;
        let height = 10.0 - self.flown.descent * 9.2 * t / self.flown.seconds;
        Vector::new(sway * (swing(a) + 1.5 * swing(c)), sway * (swing(b) + 1.5 * swing(d)), -height)
    }

    fn velocity(&self, t: f64) -> Vector<Ned> {
        (self.position(t + 1e-3) - self.position(t - 1e-3)) * 500.0
    }

    fn attitude(&self, t: f64) -> Rotation<Ned, Body> {
        let pull = (self.velocity(t + 1e-3) - self.velocity(t - 1e-3)) * (500.0 / GRAVITY_M_S2);
        let [rate, phase] = self.waves[4];
        let yaw = self.flown.turn_rad * (rate * t + phase).sin();
        let (sin, cos) = yaw.sin_cos();
        let (ahead, aside) = (pull.x() * cos + pull.y() * sin, pull.y() * cos - pull.x() * sin);
        Rotation::from_euler(aside, -ahead, yaw)
    }
}

/// A first-order Gauss-Markov process.
struct Slow {
    deviation: f64,
    time_constant_s: f64,
    value: f64,
}

impl Slow {
    fn new(deviation: f64, time_constant_s: f64, random: &mut ChaCha8Rng) -> Self {
        Self { deviation, time_constant_s, value: deviation * normal(random) }
    }

    fn step(&mut self, dt_s: f64, random: &mut ChaCha8Rng) -> f64 {
        let kept = (-dt_s / self.time_constant_s).exp();
        self.value =
            kept * self.value + self.deviation * (1.0 - kept * kept).sqrt() * normal(random);
        self.value
    }
}

fn normal(random: &mut ChaCha8Rng) -> f64 {
    StandardNormal.sample(random)
}

fn configured() -> ConfiguredCamera {
    let rotation = Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    ConfiguredCamera {
        model: CameraModel::pinhole(1296, 972, 1818.0),
        body_from_camera: Transform::new(rotation, Point::new(0.05, 0.0, -0.1)),
    }
}

fn telemetry(path: &Path, random: &mut ChaCha8Rng) -> Vec<VehicleSample> {
    let errors = path.flown.errors;
    let dt_s = 1.0 / AUTOPILOT_HZ;
    let mut position = [0.012, 0.012, 0.02].map(|m| Slow::new(errors * m, 10.0, random));
    let mut velocity = [0.006; 2].map(|m_s| Slow::new(errors * m_s, 10.0, random));
    let bias = [(); 2].map(|()| errors * 0.015 * normal(random));
    let mut lean = [0.05f64.to_radians(); 2].map(|rad| Slow::new(errors * rad, 5.0, random));
    let heading = errors * 0.7f64.to_radians() * normal(random);
    let count = (path.flown.seconds * AUTOPILOT_HZ) as usize;
    let mut height_error = path.position(0.0).z() * 0.042 * errors;
    (0..count)
        .map(|i| {
            let t = dt_s * i as f64;
            let (p, v) = (path.position(t), path.velocity(t));
            let [north, east, down] = position.each_mut().map(|it| it.step(dt_s, random));
            let [v_north, v_east] = velocity.each_mut().map(|it| it.step(dt_s, random));
            let [roll, pitch] = lean.each_mut().map(|it| it.step(dt_s, random));
            height_error += (p.z() * 0.042 * errors - height_error) * dt_s / 4.0;
            let turned = Rotation::<Ned, Ned>::from_rotation_vector(Vector::new(0.0, 0.0, heading));
            let leaned =
                Rotation::<Body, Body>::from_rotation_vector(Vector::new(roll, pitch, 0.0));
            VehicleSample {
                stamp_s: t,
                ned_from_body: turned * path.attitude(t) * leaned,
                position: Point::new(
                    p.x() + north + 3.0,
                    p.y() + east - 7.0,
                    p.z() + down + height_error,
                ),
                velocity: Vector::new(
                    v.x() + v_north + bias[0],
                    v.y() + v_east + bias[1],
                    v.z() * (1.0 + 0.022 * errors),
                ),
            }
        })
        .collect()
}

fn markers(path: &Path, truth: &Truth, random: &mut ChaCha8Rng) -> Vec<MarkerSample> {
    let configured = configured();
    let turn = Vector::<Body>::new(truth.mount_rad[0], truth.mount_rad[1], truth.mount_rad[2]);
    let turned =
        Rotation::<Body, Body>::from_rotation_vector(turn) * configured.body_from_camera.rotation();
    let body_from_camera =
        Transform::<Body, Camera>::new(turned, configured.body_from_camera.origin());
    let (pixel_px, size_px, marker_m) = (0.05, 0.05, 0.3);
    let count = (path.flown.seconds * CAMERA_HZ) as usize;
    let mut samples = Vec::new();
    for i in 2..count {
        let stamp_s = (i as f64 + 0.3) / CAMERA_HZ;
        let t = stamp_s + truth.offset_s;
        let ned_from_body =
            Transform::new(path.attitude(t), Point::<Ned>::origin() + path.position(t));
        let place = (ned_from_body * body_from_camera).inverse() * Point::<Ned>::origin();
        let [x, y, z] = [place.x(), place.y(), place.z()];
        let focal = configured.model.fx * (1.0 + truth.focal);
        let (u, v) =
            (focal * x / z + pixel_px * normal(random), focal * y / z + pixel_px * normal(random));
        let seen_px = focal * marker_m / z;
        let noisy_px = seen_px + size_px * normal(random);
        if (u.abs() > 640.0) || (v.abs() > 480.0) {
            continue;
        }
        // The result of a detector with the configured focal length.
        let focal = configured.model.fx;
        let z = focal * marker_m / noisy_px;
        let ray = Vector::<Camera>::new(u / focal, v / focal, 1.0);
        let sideways = pixel_px * z / focal;
        let along = z * size_px / noisy_px;
        let covariance_m2 =
            Matrix3::from_diagonal(&[sideways.powi(2), sideways.powi(2), 0.0].into())
                + ray.coords * ray.coords.transpose() * along.powi(2);
        samples.push(MarkerSample { stamp_s, place: Point::origin() + ray * z, covariance_m2 });
    }
    samples
}

fn flown(flown: Flown, truth: &Truth) -> (Vec<VehicleSample>, Vec<MarkerSample>) {
    let mut random = ChaCha8Rng::seed_from_u64(flown.seed);
    let path = Path::new(flown, &mut random);
    let vehicle = telemetry(&path, &mut random);
    (vehicle, markers(&path, truth, &mut random))
}

fn solved(how: Flown, truth: &Truth) -> Result<FlightCalibration, FlightRefusal> {
    let (vehicle, markers) = flown(how, truth);
    calibrate_flight(&configured(), &vehicle, &markers)
}

fn true_value(truth: &Truth, quantity: Quantity) -> f64 {
    match quantity {
        Quantity::TimeOffset => truth.offset_s,
        Quantity::MountRoll => truth.mount_rad[0],
        Quantity::MountPitch => truth.mount_rad[1],
        Quantity::MountYaw => truth.mount_rad[2],
        Quantity::FocalScale => truth.focal,
        Quantity::K1 => 0.0,
    }
}

const WRONG: Truth = Truth { offset_s: 0.04, mount_rad: [0.024, -0.02, 0.015], focal: 0.012 };

#[test]
fn deviations_are_honest_over_many_landings() {
    let mut squares = [0.0; 6];
    let count = 20;
    for seed in 0..count {
        let result = solved(Flown::landing(5000 + seed), &WRONG).unwrap();
        for (square, estimate) in squares.iter_mut().zip(result.estimates) {
            let error = estimate.value - true_value(&WRONG, estimate.quantity);
            assert!(estimate.is_observable(), "seed {seed}: {estimate:?}");
            assert!(error.abs() < 4.0 * estimate.deviation, "seed {seed}: {error} {estimate:?}");
            *square += (error / estimate.deviation).powi(2) / count as f64;
        }
    }
    // 20 squares of a normal error have a mean from 0.4 to 1.9 in 199 of 200 cases. Errors that no flight averages
    // out are in the deviations, and not in these flights.
    for (square, quantity) in squares.into_iter().zip(QUANTITIES) {
        println!("{quantity:?}: mean square of error over deviation {square:.2}");
        assert!((0.25..1.9).contains(&square), "{quantity:?}: {square}");
    }
}

#[test]
fn the_corrected_camera_is_the_true_one() {
    let result = solved(Flown::landing(71), &WRONG).unwrap();
    let truth = configured().body_from_camera.rotation();
    let [roll, pitch, yaw] = WRONG.mount_rad;
    let truth = Rotation::<Body, Body>::from_rotation_vector(Vector::new(roll, pitch, yaw)) * truth;
    let apart = (result.camera.body_from_camera.rotation().inverse() * truth).angle();
    assert!(apart < 0.4f64.to_radians(), "{apart}");
    let focal = result.camera.model.fx / configured().model.fx;
    assert!((focal - 1.012).abs() < 0.004, "{focal}");
}

#[test]
fn a_focal_length_that_is_off_by_a_tenth_is_found() {
    for (seed, focal) in [(301, 0.1), (302, -0.1), (303, 0.1)] {
        let truth = Truth { focal, ..WRONG };
        let result = solved(Flown::landing(seed), &truth).unwrap();
        let estimate = result.estimates[4];
        assert_eq!(estimate.quantity, Quantity::FocalScale);
        let error = estimate.value - focal;
        println!("{focal}: {error:+.5} +- {:.5}", estimate.deviation);
        assert!(error.abs() < 3.0 * estimate.deviation && error.abs() < 0.003, "{estimate:?}");
    }
}

#[test]
fn a_hover_shows_nothing_and_changes_nothing() {
    for seed in 0..2 {
        let result = solved(Flown::hover(seed), &WRONG).unwrap();
        for estimate in result.estimates {
            assert!(!estimate.is_observable() && estimate.correction() == 0.0, "{estimate:?}");
        }
        assert_eq!(result.camera, configured());
    }
}

#[test]
fn a_descent_without_turns_shows_roll_and_pitch_of_the_mount_alone() {
    let straight = Flown { sway_m: 0.0, turn_rad: 0.0, ..Flown::landing(8) };
    let result = solved(straight, &WRONG).unwrap();
    for estimate in result.estimates {
        let is_tilt = matches!(estimate.quantity, Quantity::MountRoll | Quantity::MountPitch);
        assert_eq!(estimate.is_observable(), is_tilt, "{estimate:?}");
        if is_tilt {
            let error = estimate.value - true_value(&WRONG, estimate.quantity);
            assert!(error.abs() < 3.0 * estimate.deviation, "{error} {estimate:?}");
        }
    }
}

#[test]
fn tilts_that_are_hardly_larger_than_the_attitudes_errors_correct_no_scale() {
    let (mut smallest, mut largest, mut shown) = (f64::INFINITY, 0.0, 0);
    for sway_m in [0.07, 0.1, 0.15, 0.25, 0.35] {
        for seed in 0..5 {
            let flown = Flown { sway_m, turn_rad: 0.0, ..Flown::landing(7000 + seed) };
            let result = solved(flown, &Truth::default()).unwrap();
            let tilt_deg = result.excitation.tilt_rad.to_degrees();
            (smallest, largest) = (f64::min(smallest, tilt_deg), f64::max(largest, tilt_deg));
            for estimate in &result.estimates[4..] {
                assert_eq!(estimate.correction(), 0.0, "{tilt_deg} deg, {seed}: {estimate:?}");
                let is_honest = estimate.value.abs() < 4.0 * estimate.deviation;
                assert!(is_honest, "{tilt_deg} deg, {seed}: {estimate:?}");
                shown += u32::from(estimate.is_observable());
            }
        }
    }
    println!("tilts of {smallest:.2} to {largest:.2} deg, {shown} of 50 shown");
    assert!(smallest < 0.6 && largest > 2.0 && shown > 5, "{smallest} {largest} {shown}");
}

#[test]
fn a_focal_length_that_small_tilts_do_not_show_does_not_disturb_other_quantities() {
    for (seed, focal) in [(7100, 0.08), (7101, -0.08), (7102, 0.05)] {
        let truth = Truth { focal, ..WRONG };
        let flown = Flown { sway_m: 0.12, ..Flown::landing(seed) };
        let result = solved(flown, &truth).unwrap();
        assert!(!result.estimates[4].is_observable(), "{seed}: {:?}", result.estimates[4]);
        for estimate in &result.estimates[..4] {
            let error = estimate.value - true_value(&truth, estimate.quantity);
            println!("{seed} {:?} {error:+.5} +- {:.5}", estimate.quantity, estimate.deviation);
            assert!(error.abs() < 4.0 * estimate.deviation, "{seed}: {error} {estimate:?}");
        }
        assert!(result.covariance.iter().all(|value| value.is_finite()), "{:?}", result.covariance);
    }
}

#[test]
fn stamps_of_another_clock_are_refused() {
    for offset_s in [7.0, -2.5] {
        let (vehicle, markers) = flown(Flown::landing(4), &Truth { offset_s, ..WRONG });
        match calibrate_flight(&configured(), &vehicle, &markers) {
            Err(FlightRefusal::Offset { offset_s: reported_s }) => {
                assert!((reported_s - offset_s).abs() < 0.2, "{reported_s}");
            }
            other => panic!("{offset_s} s: {other:?}"),
        }
    }
}

#[test]
fn a_short_flight_is_refused() {
    let (vehicle, markers) = flown(Flown::landing(4), &WRONG);
    let few = &markers[..MIN_MARKERS - 1];
    let refusal = calibrate_flight(&configured(), &vehicle, few).unwrap_err();
    assert_eq!(refusal, FlightRefusal::TooFew { found: MIN_MARKERS - 1 });
    let refusal = calibrate_flight(&configured(), &[], &markers).unwrap_err();
    assert_eq!(refusal, FlightRefusal::TooFew { found: 0 });
}

/// The same markers, this fraction of them of another pad, two metres away.
fn with_another_pad(markers: &mut [MarkerSample], share: f64) {
    let mut random = ChaCha8Rng::seed_from_u64(9);
    for marker in markers {
        if random.random_bool(share) {
            marker.place = marker.place + Vector::new(2.0, 0.5, 0.0);
        }
    }
}

#[test]
fn a_few_detections_of_another_pad_have_little_effect() {
    let (vehicle, mut markers) = flown(Flown::landing(15), &WRONG);
    with_another_pad(&mut markers, 0.03);
    let result = calibrate_flight(&configured(), &vehicle, &markers).unwrap();
    for estimate in result.estimates {
        let error = estimate.value - true_value(&WRONG, estimate.quantity);
        assert!(error.abs() < 4.0 * estimate.deviation, "{error} {estimate:?}");
    }
}

#[test]
fn two_pads_are_refused() {
    let (vehicle, mut markers) = flown(Flown::landing(15), &WRONG);
    with_another_pad(&mut markers, 0.5);
    let refusal = calibrate_flight(&configured(), &vehicle, &markers).unwrap_err();
    assert!(matches!(refusal, FlightRefusal::Contradiction { .. }), "{refusal}");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 8, ..ProptestConfig::default() })]

    #[test]
    fn any_usual_error_is_found(
        seed in 0..1_000_000_u64,
        offset_s in -0.1..0.15,
        mount_rad in prop::array::uniform3(-0.07..0.07),
        focal in -0.03..0.03,
    ) {
        let truth = Truth { offset_s, mount_rad, focal };
        let result = solved(Flown::landing(seed), &truth).unwrap();
        for estimate in result.estimates {
            let error = estimate.value - true_value(&truth, estimate.quantity);
            prop_assert!(error.abs() < 5.0 * estimate.deviation, "{} {:?}", error, estimate);
        }
    }

    #[test]
    fn numbers_without_sense_are_no_panic(
        numbers in prop::collection::vec(
            prop_oneof![Just(f64::NAN), Just(f64::INFINITY), Just(0.0), -1e300..1e300, -9.0..9.0],
            9 * 80,
        ),
    ) {
        let (mut vehicle, mut markers) = (Vec::new(), Vec::new());
        for (i, n) in numbers.chunks_exact(9).enumerate() {
            vehicle.push(VehicleSample {
                stamp_s: 0.1 * i as f64,
                ned_from_body: Rotation::from_wxyz([n[0], n[1], n[2], n[3]])
                    .unwrap_or(Rotation::identity()),
                position: Point::new(n[4], n[5], n[6]),
                velocity: Vector::new(n[6], n[5], n[4]),
            });
            markers.push(MarkerSample {
                stamp_s: 0.1 * i as f64 + 0.03,
                place: Point::new(n[6], n[7], n[8]),
                covariance_m2: Matrix3::from_diagonal(&[n[7], n[8], n[4]].into()),
            });
        }
        if let Ok(result) = calibrate_flight(&configured(), &vehicle, &markers) {
            prop_assert!(result.estimates.iter().all(|estimate| estimate.value.is_finite()));
        }
    }
}
