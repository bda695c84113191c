//! The thesis' guidance is a reference: its decisions stay the same to the bit.

use geometry::{Body, Ned, Pixel, Point, Rotation, Transform, Vector};
use landing::{
    Action, Config, Decision, Event, FrameObservation, GuidanceConfig, Landed, Lander,
    MarkerInFrame, Mode, OperatorCommand, ThesisConfig, Timestamp, VehicleState,
};

/// FNV-1a over a decision.
fn mix(hash: u64, decision: &Decision) -> u64 {
    let numbers = match decision.action {
        Action::None => [1, 0, 0, 0, 0],
        Action::Land => [2, 0, 0, 0, 0],
        Action::Guided => [4, 0, 0, 0, 0],
        Action::Disarm => [5, 0, 0, 0, 0],
        Action::Velocity { velocity, yaw_rate } => [
            3,
            velocity.x().to_bits(),
            velocity.y().to_bits(),
            velocity.z().to_bits(),
            yaw_rate.to_bits(),
        ],
    };
    let words = numbers.into_iter().flat_map(u64::to_le_bytes);
    let names = decision.phase.name().bytes().chain(decision.why.name().bytes());
    let rejected = decision.rejected.map_or("", |rejection| rejection.name()).bytes();
    words
        .chain(names)
        .chain(rejected)
        .fold(hash, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

/// A flight that happens whatever is decided: a swaying descent over the pad, with gaps and an outlier.
fn events(i: u32) -> (Timestamp, Vec<Event>) {
    let seconds = f64::from(i) * 0.02;
    let now = Timestamp::from_seconds(100.0 + seconds);
    let height_m = (10.0 - 0.25 * seconds).max(0.3);
    let sway = height_m / 10.0;
    let (north, east) = (0.4 + sway * (0.7 * seconds).sin(), sway * (0.4 * seconds).cos() - 0.3);
    let position = Point::<Ned>::new(north, east, -height_m);
    let ned_from_body = Rotation::<Ned, Body>::from_euler(
        0.05 * (2.0 * seconds).sin(),
        0.04 * (1.3 * seconds).cos(),
        0.6,
    );
    let mut events = vec![Event::Vehicle(VehicleState {
        stamp: now.plus_seconds(-0.01),
        ned_from_body,
        position,
        velocity: Vector::new(0.7 * (0.7 * seconds).cos(), -0.2 * (0.4 * seconds).sin(), 0.25),
        mode: if seconds > 39.5 { Mode::Land } else { Mode::Guided },
        armed: seconds < 48.0,
        landed: if seconds > 46.0 { Landed::OnGround } else { Landed::InAir },
    })];
    if i == 5 {
        events.push(Event::Operator(OperatorCommand::Start));
    }
    if i.is_multiple_of(3) {
        let offset = if i == 600 { 1.0 } else { 0.0 };
        let in_body = ned_from_body.inverse()
            * Vector::new(0.4 + offset - position.x(), -0.3 - position.y(), height_m);
        let seen = !i.is_multiple_of(30) && !(900..960).contains(&i);
        let marker = seen.then(|| MarkerInFrame {
            centre: Pixel::new(
                648.0 + 1818.0 * in_body.y() / in_body.z(),
                486.0 - 1818.0 * in_body.x() / in_body.z(),
            ),
            body_from_marker: Some(Transform::new(
                Rotation::identity(),
                Point::new(in_body.x(), in_body.y(), in_body.z()),
            )),
            alternative: None,
            covariance_m2: None,
            size_px: None,
            confidence: 0.9,
        });
        events.push(Event::Frame(FrameObservation {
            stamp: now.plus_seconds(-0.08),
            image_size: (1296, 972),
            focal_px: None,
            body_from_camera: None,
            marker,
        }));
    }
    events.push(Event::Tick);
    (now, events)
}

#[test]
fn the_thesis_decisions_are_unchanged() {
    let guidance = GuidanceConfig::Thesis(ThesisConfig { seed: 5, ..ThesisConfig::default() });
    let mut lander = Lander::new(Config { guidance, ..Config::default() }).unwrap();
    let mut hash = 0xcbf2_9ce4_8422_2325;
    let mut phases = Vec::new();
    for i in 0..2600 {
        let (now, events) = events(i);
        for event in events {
            let decision = lander.step(now, event);
            hash = mix(hash, &decision);
            if phases.last() != Some(&decision.phase.name()) {
                phases.push(decision.phase.name());
            }
        }
    }
    println!("{phases:?} {hash:#x}");
    assert_eq!(hash, 0xdacc_b3ed_f334_e234, "{phases:?}");
}
