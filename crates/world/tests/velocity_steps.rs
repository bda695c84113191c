//! Compares the response to steps of the velocity setpoint with the one measured on a real autopilot.

#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "a test prints its measurements, and where it fails"
)]

mod bench;

use bench::{Bench, steady};

const STEP_S: f64 = 0.02;
const TOLERANCE: f64 = 0.15;

/// Axis (0 north, 2 down), speed in m/s, times to 10, 50 and 90 % in seconds, as the summary of the
/// measurements gives them.
const MEASURED: [(usize, f64, [f64; 3]); 8] = [
    (0, 0.1, [0.20, 0.46, 1.12]),
    (0, 0.25, [0.20, 0.46, 1.06]),
    (0, 0.5, [0.24, 0.52, 1.16]),
    (0, 1.0, [0.30, 0.60, 1.24]),
    (0, 2.0, [0.38, 0.74, 1.40]),
    (2, 0.25, [0.18, 0.34, 0.60]),
    (2, 0.5, [0.22, 0.44, 0.70]),
    (2, 1.0, [0.28, 0.68, 1.04]),
];

/// Velocity along an axis, in steps of 20 ms from the order to move on.
fn respond(axis: usize, speed: f64) -> Vec<f64> {
    let mut bench = Bench::flying(&steady(), 1, 10.0);
    bench.fly(5.0, [0.0; 3]);
    let mut velocity = [0.0; 3];
    velocity[axis] = speed as f32;
    let mut curve = Vec::new();
    for step in 0..200 {
        if step % 5 == 0 {
            bench.velocity(local(), bench::HOLD_HEADING, velocity, [0.0; 2]);
        }
        curve.push(bench.world.truth().velocity.coords[axis]);
        bench.run(STEP_S);
    }
    curve
}

fn local() -> autopilot::dialect::MavFrame {
    autopilot::dialect::MavFrame::MAV_FRAME_LOCAL_NED
}

/// First times, in seconds, at which the curve has reached 10, 50 and 90 % of the speed.
fn rise(curve: &[f64], speed: f64) -> [f64; 3] {
    [0.1, 0.5, 0.9].map(|part| {
        let index = curve.iter().position(|v| *v >= part * speed).unwrap();
        let (before, after) = (curve[index.saturating_sub(1)], curve[index]);
        let missing = if after > before { (after - part * speed) / (after - before) } else { 0.0 };
        (index as f64 - missing) * STEP_S
    })
}

fn compare(axis: usize, speed: f64, simulated: [f64; 3], measured: [f64; 3]) {
    println!("axis {axis} speed {speed}: simulated {simulated:.3?} measured {measured:.3?}");
    for (simulated, measured) in simulated.into_iter().zip(measured) {
        let error = simulated / measured - 1.0;
        assert!(
            error.abs() <= TOLERANCE,
            "axis {axis}, {speed} m/s: {simulated:.3} s for {measured:.3} s"
        );
    }
}

#[test]
fn rise_times_are_those_of_the_summary() {
    for (axis, speed, measured) in MEASURED {
        let curve = respond(axis, speed);
        compare(axis, speed, rise(&curve, speed), measured);
        let max = curve.iter().copied().fold(0.0, f64::max) / speed;
        let allowed = if axis == 2 { 1.05..1.13 } else { 0.99..1.03 };
        assert!(allowed.contains(&max), "axis {axis}, {speed} m/s: overshoot {max}");
    }
}

#[test]
fn rise_times_are_those_of_the_measured_curves() {
    let Some(file) = testing::recording("ardupilot/velocity_steps_truth.json") else { return };
    let text = std::fs::read_to_string(file).unwrap();
    let curves: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&text).unwrap();
    assert!(!curves.is_empty());
    for (key, points) in curves {
        let (axis, speed) = key.split_once('_').unwrap();
        let (axis, speed): (usize, f64) = (axis.parse().unwrap(), speed.parse().unwrap());
        let measured: Vec<f64> =
            points.as_array().unwrap().iter().map(|point| point[1].as_f64().unwrap()).collect();
        let simulated = respond(axis, speed);
        compare(axis, speed, rise(&simulated, speed), rise(&measured, speed));
        let squares: f64 = simulated.iter().zip(&measured).map(|(s, m)| (s - m).powi(2)).sum();
        let distance = (squares / measured.len() as f64).sqrt() / speed;
        assert!(distance < 0.04, "{key}: {distance} of the step between the curves");
    }
}
