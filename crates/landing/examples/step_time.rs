//! Measures the time of a lander's step, median and 99 %, for a vehicle state, a frame, a late frame and a
//! tick: `cargo run --release -p landing --example step_time`.

#![allow(clippy::print_stdout, reason = "a program's output")]

use std::time::Instant;

use geometry::{Body, Pixel, Point, Rotation, Transform, Vector};
use landing::{
    Config, ConfigError, Event, FrameObservation, Landed, Lander, MarkerInFrame, Mode,
    OperatorCommand, Timestamp, VehicleState,
};

fn vehicle(now: Timestamp) -> Event {
    Event::Vehicle(VehicleState {
        stamp: now,
        ned_from_body: Rotation::from_euler(0.01, 0.02, 0.3),
        position: Point::new(0.05 * now.seconds().sin(), 0.0, -5.0),
        velocity: Vector::new(0.05 * now.seconds().cos(), 0.0, 0.0),
        mode: Mode::Guided,
        armed: true,
        landed: Landed::InAir,
    })
}

/// A frame taken `ago_s` ago.
fn frame(now: Timestamp, ago_s: f64) -> Event {
    let stamp = now.plus_seconds(-ago_s);
    let attitude = Rotation::<geometry::Ned, Body>::from_euler(0.01, 0.02, 0.3);
    let from_vehicle = Vector::new(0.5 - 0.05 * stamp.seconds().sin(), 0.3, 5.0);
    let in_body = attitude.inverse() * from_vehicle;
    let marker = MarkerInFrame {
        centre: Pixel::new(650.0, 480.0),
        body_from_marker: Some(Transform::new(
            Rotation::identity(),
            Point::new(in_body.x(), in_body.y(), in_body.z()),
        )),
        alternative: None,
        covariance_m2: None,
        size_px: Some(50.0),
        confidence: 1.0,
    };
    Event::Frame(FrameObservation {
        stamp,
        image_size: (1296, 972),
        focal_px: Some(1818.0),
        body_from_camera: None,
        marker: Some(marker),
    })
}

fn main() -> Result<(), ConfigError> {
    let mut lander = Lander::new(Config::default())?;
    let mut times: [Vec<f64>; 4] = Default::default();
    for i in 0..20_000u32 {
        let now = Timestamp::from_seconds(10.0 + f64::from(i) * 0.005);
        let (kind, event) = match i % 20 {
            0 | 4 | 8 | 12 | 16 => (0, vehicle(now)),
            6 => (1, frame(now, 0.08)),
            // So late that the detections of 0.4 s are fused again.
            7 if i % 40 == 7 => (2, frame(now, 0.45)),
            10 if i == 30 => (3, Event::Operator(OperatorCommand::Start)),
            _ => (3, Event::Tick),
        };
        let start = Instant::now();
        std::hint::black_box(lander.step(now, event));
        if let Some(kind) = times.get_mut(kind) {
            kind.push(start.elapsed().as_secs_f64() * 1e6);
        }
    }
    println!("phase `{}`", lander.phase());
    for (name, mut times) in ["vehicle state", "frame", "late frame", "tick"].into_iter().zip(times)
    {
        times.sort_by(f64::total_cmp);
        let at = |part: f64| {
            let index = (times.len().saturating_sub(1)) as f64 * part;
            times.get(index as usize).copied().unwrap_or(f64::NAN)
        };
        println!("{name}: median {:.2} us, 99 % {:.2} us", at(0.5), at(0.99));
    }
    Ok(())
}
