//! Random events in random order: setpoints stay inside the envelope, nothing descends on a stale target,
//! nothing is sent after the pilot took over, and every landing ends.

use geometry::{Body, Ned, Pixel, Point, Rotation, Transform, Vector};
use landing::{
    Action, Alarm, Config, Event, FrameObservation, GuidanceConfig, Landed, Lander, MarkerInFrame,
    Mode, OperatorCommand, Phase, Reason, ThesisConfig, Timestamp, VehicleState, VehicleStatus,
};
use nalgebra::Matrix3;
use proptest::prelude::*;

/// An event and the seconds that pass before it.
#[derive(Clone, Debug)]
struct Happening {
    after_s: f64,
    event: Kind,
}

/// An event whose stamp is an age, because its time is known only when it happens.
#[derive(Clone, Debug)]
enum Kind {
    Vehicle {
        age_s: f64,
        position: [f64; 3],
        velocity: [f64; 3],
        mode: Mode,
        armed: bool,
        landed: Landed,
    },
    Frame {
        age_s: f64,
        centre: Option<[f64; 2]>,
        origin: Option<[f64; 3]>,
        alternative: Option<[f64; 3]>,
        covariance_m2: Option<[f64; 9]>,
        width: u32,
    },
    Status(VehicleStatus),
    DetectorsAlive(bool),
    LinkDelay(f64),
    Operator(OperatorCommand),
    Alarm(Alarm),
    Tick,
    /// The vehicle is near the pad, and the camera sees it.
    Usual {
        north: f64,
        height_m: f64,
    },
}

/// Mostly a sensible number, sometimes any at all.
fn number(around: f64, width: f64) -> impl Strategy<Value = f64> {
    prop_oneof![30 => around - width..around + width, 1 => prop::num::f64::ANY]
}

fn age() -> impl Strategy<Value = f64> {
    prop_oneof![20 => 0.0..0.15f64, 2 => -1.0..1.0f64, 1 => -1e12..1e12f64]
}

fn mode() -> impl Strategy<Value = Mode> {
    prop_oneof![
        90 => Just(Mode::Guided), 2 => Just(Mode::Land), 1 => Just(Mode::Other), 2 => Just(Mode::Unknown)
    ]
}

fn landed() -> impl Strategy<Value = Landed> {
    prop_oneof![
        90 => Just(Landed::InAir), 2 => Just(Landed::Unknown), 1 => Just(Landed::OnGround),
        1 => Just(Landed::TakingOff), 1 => Just(Landed::Landing)
    ]
}

fn vehicle() -> impl Strategy<Value = Kind> {
    let position =
        (number(0.0, 1.0), number(0.0, 1.0), number(-1.5, 1.4)).prop_map(|(x, y, z)| [x, y, z]);
    let speed =
        (number(0.0, 0.2), number(0.0, 0.2), number(0.0, 0.5)).prop_map(|(x, y, z)| [x, y, z]);
    (age(), position, speed, mode(), prop::bool::weighted(0.995), landed()).prop_map(
        |(age_s, position, velocity, mode, armed, landed)| Kind::Vehicle {
            age_s,
            position,
            velocity,
            mode,
            armed,
            landed,
        },
    )
}

fn frame() -> impl Strategy<Value = Kind> {
    let centre = (number(648.0, 400.0), number(486.0, 300.0)).prop_map(|(x, y)| [x, y]);
    let origin =
        (number(0.0, 0.3), number(0.0, 0.3), number(1.5, 1.0)).prop_map(|(x, y, z)| [x, y, z]);
    let width = prop_oneof![20 => Just(1296u32), 1 => Just(0), 1 => any::<u32>()];
    let marker = (
        prop::option::weighted(0.8, centre),
        prop::option::weighted(0.95, origin),
        prop::option::weighted(0.3, alternative()),
        prop::option::weighted(0.5, covariance()),
    );
    (age(), marker, width).prop_map(|(age_s, marker, width)| {
        let (centre, origin, alternative, covariance_m2) = marker;
        Kind::Frame { age_s, centre, origin, alternative, covariance_m2, width }
    })
}

/// Another pose, near or anywhere.
fn alternative() -> impl Strategy<Value = [f64; 3]> {
    let near =
        (number(0.0, 0.3), number(0.0, 0.3), number(1.5, 1.0)).prop_map(|(x, y, z)| [x, y, z]);
    let any = prop::array::uniform3(prop::num::f64::ANY);
    prop_oneof![5 => near, 1 => any, 1 => Just([1e160; 3])]
}

/// A covariance as detectors report it, or nine numbers that are no covariance: negative, not a number, huge, denormal.
fn covariance() -> impl Strategy<Value = [f64; 9]> {
    let diagonal = |x: f64, y: f64, z: f64| [x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, z];
    let usual = (1e-8..1e-2f64, 1e-8..1e-2f64, 1e-8..1e-1f64);
    let usual = usual.prop_map(move |(x, y, z)| diagonal(x, y, z));
    let strange = prop_oneof![
        Just(f64::NAN),
        Just(f64::MAX),
        Just(f64::MIN),
        Just(f64::MIN_POSITIVE / 8.0),
        Just(0.0),
        -1.0..1.0f64
    ];
    let one = strange.prop_map(move |v| diagonal(v, v, v));
    let any = prop::array::uniform9(prop::num::f64::ANY);
    prop_oneof![6 => usual, 2 => one, 1 => any]
}

fn status() -> impl Strategy<Value = Kind> {
    (mode(), prop::bool::weighted(0.99), landed())
        .prop_map(|(mode, armed, landed)| Kind::Status(VehicleStatus { mode, armed, landed }))
}

fn operator() -> impl Strategy<Value = Kind> {
    prop_oneof![
        6 => Just(OperatorCommand::Start), 1 => Just(OperatorCommand::Hold), 2 => Just(OperatorCommand::Resume),
        1 => Just(OperatorCommand::Abort), 1 => Just(OperatorCommand::LandHere)
    ]
    .prop_map(Kind::Operator)
}

fn alarm() -> impl Strategy<Value = Kind> {
    prop_oneof![
        Just(Alarm::BatteryLow),
        Just(Alarm::BatteryCritical),
        Just(Alarm::OperatorLost),
        Just(Alarm::AutopilotLost)
    ]
    .prop_map(Kind::Alarm)
}

fn happening() -> impl Strategy<Value = Happening> {
    let after_s = prop_oneof![200 => 0.0..0.08f64, 3 => 0.0..2.0f64, 1 => -1.0..200.0f64];
    let usual =
        (-0.3..0.3f64, 0.3..6.0f64).prop_map(|(north, height_m)| Kind::Usual { north, height_m });
    let event = prop_oneof![
        200 => usual, 15 => vehicle(), 10 => frame(), 1 => operator(), 1 => alarm(), 20 => Just(Kind::Tick),
        10 => status(), 2 => prop::bool::weighted(0.7).prop_map(Kind::DetectorsAlive),
        2 => number(0.3, 0.3).prop_map(Kind::LinkDelay)
    ];
    (after_s, event).prop_map(|(after_s, event)| Happening { after_s, event })
}

fn events(kind: &Kind, now: Timestamp) -> [Event; 2] {
    let Kind::Usual { north, height_m } = *kind else { return [event(kind, now), Event::Tick] };
    let attitude = Rotation::from_euler(0.02, -0.03, 1.0);
    let in_body = Rotation::<Ned, Body>::inverse(&attitude) * Vector::new(-north, 0.0, height_m);
    let vehicle = Kind::Vehicle {
        age_s: 0.0,
        position: [north, 0.0, -height_m],
        velocity: [0.01, 0.0, 0.1],
        mode: Mode::Guided,
        armed: true,
        landed: Landed::InAir,
    };
    let origin = Some([in_body.x(), in_body.y(), in_body.z()]);
    let frame = Kind::Frame {
        age_s: 0.0,
        centre: Some([650.0, 500.0]),
        origin,
        alternative: None,
        covariance_m2: None,
        width: 1296,
    };
    [event(&vehicle, now), event(&frame, now)]
}

fn event(kind: &Kind, now: Timestamp) -> Event {
    match *kind {
        Kind::Tick | Kind::Usual { .. } => Event::Tick,
        Kind::Operator(command) => Event::Operator(command),
        Kind::Alarm(alarm) => Event::Alarm(alarm),
        Kind::Status(status) => Event::Status(status),
        Kind::DetectorsAlive(alive) => Event::DetectorsAlive(alive),
        Kind::LinkDelay(seconds) => Event::LinkDelay(seconds),
        Kind::Vehicle { age_s, position: p, velocity: v, mode, armed, landed } => {
            Event::Vehicle(VehicleState {
                stamp: now.plus_seconds(-age_s),
                ned_from_body: Rotation::from_euler(0.02, -0.03, 1.0),
                position: Point::new(p[0], p[1], p[2]),
                velocity: Vector::new(v[0], v[1], v[2]),
                mode,
                armed,
                landed,
            })
        }
        Kind::Frame { age_s, centre, origin, alternative, covariance_m2, width } => {
            Event::Frame(FrameObservation {
                stamp: now.plus_seconds(-age_s),
                image_size: (width, 972),
                focal_px: Some(1818.0),
                body_from_camera: None,
                marker: centre.map(|c| MarkerInFrame {
                    centre: Pixel::new(c[0], c[1]),
                    body_from_marker: origin.map(|o| {
                        Transform::new(Rotation::identity(), Point::new(o[0], o[1], o[2]))
                    }),
                    alternative: alternative.map(|o| {
                        Transform::new(Rotation::identity(), Point::new(o[0], o[1], o[2]))
                    }),
                    covariance_m2: covariance_m2.map(|m| Matrix3::from_row_slice(&m)),
                    size_px: None,
                    confidence: 0.8,
                }),
            })
        }
    }
}

/// The knowledge of an outside observer.
#[derive(Default)]
struct Watcher {
    newest_marker: Option<Timestamp>,
    pilot_flies: bool,
    /// The mode that was reported last is ours.
    is_ours: bool,
    no_detector: bool,
}

impl Watcher {
    fn check(
        &mut self,
        config: &Config,
        lander: &mut Lander,
        now: Timestamp,
        event: Event,
    ) -> Result<(), TestCaseError> {
        let before = lander.phase();
        let decision = lander.step(now, event);
        prop_assert_eq!(decision.phase, lander.phase());
        if decision.rejected.is_none() {
            match event {
                Event::Frame(frame) if frame.marker.is_some() => {
                    // A late frame is used as well, and is not the newest.
                    self.newest_marker = self.newest_marker.max(Some(frame.stamp));
                }
                Event::Vehicle(state) => self.observe_mode(before, state.mode),
                Event::Status(status) => self.observe_mode(before, status.mode),
                Event::DetectorsAlive(alive) => self.no_detector = !alive,
                Event::Operator(OperatorCommand::Start | OperatorCommand::LandHere) => {
                    self.pilot_flies = false;
                }
                _ => {}
            }
        }
        prop_assert!(!self.pilot_flies || decision.action == Action::None);
        match decision.action {
            Action::None => {}
            Action::Land | Action::Disarm => {
                prop_assert!(self.is_ours, "asked for against the pilot");
                prop_assert_eq!(decision.phase, Phase::Final);
            }
            Action::Guided => {
                prop_assert!(self.is_ours, "asked for against the pilot");
                prop_assert_eq!(decision.phase, Phase::Aborted);
            }
            Action::Velocity { velocity, yaw_rate } => {
                prop_assert!(velocity.is_finite() && yaw_rate == 0.0);
                prop_assert!(velocity.horizontal_norm() <= config.envelope.horizontal_m_s + 1e-9);
                prop_assert!(velocity.z() >= -config.envelope.climb_m_s);
                prop_assert!(velocity.z() <= config.envelope.descend_m_s);
                if velocity.z() > 0.0 {
                    // Our own guidance flies on while LAND is awaited.
                    prop_assert!(matches!(
                        decision.phase,
                        Phase::Approach | Phase::Descend | Phase::Final
                    ));
                    // The autopilot refuses LAND, and the vehicle is too low to stay.
                    if decision.why == Reason::LandingBySetpoints {
                        prop_assert!(velocity.z() <= config.phases.refused_descend_m_s);
                        return Ok(());
                    }
                    prop_assert!(!self.no_detector, "descends without a detector");
                    self.may_descend(config, now, decision.target.map(|t| t.height_m))?;
                }
            }
        }
        Ok(())
    }

    fn observe_mode(&mut self, before: Phase, mode: Mode) {
        self.is_ours = matches!(mode, Mode::Guided | Mode::Land);
        if mode == Mode::Other {
            self.pilot_flies |= !before.is_terminal();
        }
    }

    fn may_descend(
        &self,
        config: &Config,
        now: Timestamp,
        height_m: Option<f64>,
    ) -> Result<(), TestCaseError> {
        let age_s = self.newest_marker.map_or(f64::INFINITY, |stamp| now.seconds_since(stamp));
        let (low_m, grace_s, stale_s) = match config.guidance {
            GuidanceConfig::Thesis(thesis) => {
                (thesis.low_height_m, thesis.low_grace_s, thesis.stale_target_s)
            }
            GuidanceConfig::Metric(metric) => {
                (metric.blind_height_m, metric.blind_s, metric.stale_target_s)
            }
        };
        prop_assert!(age_s <= stale_s + grace_s + 1e-6, "descends at age {}", age_s);
        if height_m.is_some_and(|height_m| height_m > low_m) {
            prop_assert!(age_s <= stale_s + 1e-6, "descends at age {}", age_s);
        }
        Ok(())
    }
}

fn good_state(now: Timestamp) -> Event {
    event(
        &Kind::Vehicle {
            age_s: 0.0,
            position: [0.0, 0.0, -3.0],
            velocity: [0.0; 3],
            mode: Mode::Guided,
            armed: true,
            landed: Landed::InAir,
        },
        now,
    )
}

fn survives(config: Config, start: f64, happenings: &[Happening]) -> Result<(), TestCaseError> {
    let mut lander = Lander::new(config).map_err(|error| TestCaseError::fail(error.to_string()))?;
    let mut watcher = Watcher::default();
    let mut clock = Timestamp::from_seconds(start);
    let mut latest = clock;
    watcher.check(&config, &mut lander, latest, good_state(latest))?;
    watcher.check(&config, &mut lander, latest, Event::Operator(OperatorCommand::Start))?;
    prop_assert_eq!(lander.phase(), Phase::Search);
    for happening in happenings {
        clock = clock.plus_seconds(happening.after_s);
        latest = latest.max(clock);
        for event in events(&happening.event, latest) {
            watcher.check(&config, &mut lander, latest, event)?;
        }
    }
    // Without further events every state ends, with a vehicle that hovers.
    for i in 0..16_000u32 {
        latest = latest.plus_seconds(0.1);
        let event = if i.is_multiple_of(2) { good_state(latest) } else { Event::Tick };
        watcher.check(&config, &mut lander, latest, event)?;
        if lander.phase().is_terminal() {
            return Ok(());
        }
    }
    Err(TestCaseError::fail(format!("still in {} after 1600 s", lander.phase())))
}

proptest! {
    #[test]
    fn the_metric_guidance_survives_anything(
        start in -1e9..1e9f64, happenings in prop::collection::vec(happening(), 0..400),
    ) {
        survives(Config::default(), start, &happenings)?;
    }

    #[test]
    fn the_thesis_guidance_survives_anything(
        seed: u64, happenings in prop::collection::vec(happening(), 0..400),
    ) {
        let guidance = GuidanceConfig::Thesis(ThesisConfig { seed, ..ThesisConfig::default() });
        survives(Config { guidance, ..Config::default() }, 0.0, &happenings)?;
    }
}

#[test]
fn stamps_at_the_ends_of_time_are_refused() {
    let mut lander = Lander::new(Config::default()).unwrap();
    let now = Timestamp::from_seconds(10.0);
    for nanos in [i64::MIN, i64::MAX] {
        let mut event = good_state(now);
        if let Event::Vehicle(state) = &mut event {
            state.stamp = Timestamp::from_nanos(nanos);
        }
        assert!(lander.step(now, event).rejected.is_some());
    }
    lander.step(Timestamp::from_nanos(i64::MAX), Event::Tick);
    lander.step(Timestamp::from_nanos(i64::MIN), Event::Operator(OperatorCommand::Start));
    assert_eq!(lander.phase(), Phase::Idle);
}
