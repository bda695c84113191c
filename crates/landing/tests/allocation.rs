//! Counts memory allocations of a lander's steps (states, frames on time and late, ticks): none once a
//! landing has begun. `examples/step_time.rs` measures its computing time.

use std::hint::black_box;

use geometry::{Body, Ned, Pixel, Point, Rotation, Transform, Vector};
use landing::{
    Config, Event, FrameObservation, Landed, Lander, MarkerInFrame, Mode, OperatorCommand, Phase,
    Timestamp, VehicleState,
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

fn frame(now: Timestamp, ago_s: f64) -> Event {
    let stamp = now.plus_seconds(-ago_s);
    let attitude = Rotation::<Ned, Body>::from_euler(0.01, 0.02, 0.3);
    let from_vehicle = Vector::new(0.5 - 0.05 * stamp.seconds().sin(), 0.3, 5.0);
    let in_body = attitude.inverse() * from_vehicle;
    let position = Point::new(in_body.x(), in_body.y(), in_body.z());
    Event::Frame(FrameObservation {
        stamp,
        image_size: (1296, 972),
        focal_px: Some(1818.0),
        body_from_camera: None,
        marker: Some(MarkerInFrame {
            centre: Pixel::new(650.0, 480.0),
            body_from_marker: Some(Transform::new(Rotation::identity(), position)),
            alternative: None,
            covariance_m2: None,
            size_px: Some(50.0),
            confidence: 1.0,
        }),
    })
}

/// States at 50 Hz, frames at 15 Hz, some of them late, and ticks.
fn event(i: u32) -> (Timestamp, Event) {
    let now = Timestamp::from_seconds(10.0 + f64::from(i) * 0.005);
    let event = match i % 20 {
        0 | 4 | 8 | 12 | 16 => vehicle(now),
        6 => frame(now, 0.08),
        7 if i % 40 == 7 => frame(now, 0.45),
        10 if i == 30 => Event::Operator(OperatorCommand::Start),
        _ => Event::Tick,
    };
    (now, event)
}

#[test]
fn nothing_is_allocated_in_flight() {
    let mut lander = Lander::new(Config::default()).unwrap();
    let mut run = |from: u32, to: u32| {
        for i in from..to {
            let (now, event) = event(i);
            black_box(lander.step(now, event));
        }
        lander.phase()
    };
    // From the very start of the landing on.
    run(0, 40);
    let mut phase = Phase::Idle;
    let counted = allocation_counter::measure(|| phase = run(40, 20_000));
    assert!(!phase.is_terminal() && phase != Phase::Hold, "{phase}");
    assert_eq!(counted.count_total, 0, "{} bytes", counted.bytes_total);
}
