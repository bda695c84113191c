//! A lander that handles one event after the other: which reports of ground, mode and position it accepts, and how it climbs in searches,
//! retries, aborts and disputes of detectors, below the fence.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use geometry::{Body, Marker, Ned, Pixel, Point, Rotation, Transform, Vector};
use landing::{
    Action, Alarm, Config, Decision, Event, FrameObservation, GuidanceConfig, Landed, Lander,
    MarkerInFrame, MetricConfig, Mode, OnAbort, OperatorCommand, Phase, Reason, Rejection,
    ThesisConfig, Timestamp, VehicleState, VehicleStatus,
};
use nalgebra::Matrix3;

const FLYING: VehicleStatus =
    VehicleStatus { mode: Mode::Guided, armed: true, landed: Landed::InAir };
const STEP_S: f64 = 0.025;

/// A lander that receives the reports of a vehicle 40 times a second.
struct Harness {
    lander: Lander,
    seconds: f64,
    status: VehicleStatus,
    position: Point<Ned>,
    velocity: Vector<Ned>,
    /// The pad that the camera sees, at 20 Hz.
    pad: Option<Point<Ned>>,
    decisions: Vec<(f64, Decision)>,
}

impl Harness {
    fn new(config: Config, height_m: f64) -> Self {
        Self {
            lander: Lander::new(config).unwrap(),
            seconds: 1.0,
            status: FLYING,
            position: Point::new(0.0, 0.0, -height_m),
            velocity: Vector::zero(),
            pad: None,
            decisions: Vec::new(),
        }
    }

    fn started(config: Config, height_m: f64) -> Self {
        let mut harness = Self::new(config, height_m);
        harness.run(0.5, true);
        harness.step(Event::Operator(OperatorCommand::Start));
        harness
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_seconds(self.seconds)
    }

    fn step(&mut self, event: Event) -> Decision {
        let decision = self.lander.step(self.now(), event);
        self.decisions.push((self.seconds, decision));
        decision
    }

    fn state(&self) -> VehicleState {
        let VehicleStatus { mode, armed, landed } = self.status;
        VehicleState {
            stamp: self.now(),
            ned_from_body: Rotation::identity(),
            position: self.position,
            velocity: self.velocity,
            mode,
            armed,
            landed,
        }
    }

    fn frame(&self, pad: Point<Ned>) -> FrameObservation {
        let offset = pad - self.position;
        let position = Point::new(offset.x(), offset.y(), offset.z());
        FrameObservation {
            stamp: self.now(),
            image_size: (1296, 972),
            focal_px: Some(1818.0),
            body_from_camera: None,
            marker: Some(MarkerInFrame {
                centre: Pixel::new(648.0, 486.0),
                body_from_marker: Some(Transform::<Body, Marker>::new(
                    Rotation::from_euler(std::f64::consts::PI, 0.0, 0.0),
                    position,
                )),
                alternative: None,
                covariance_m2: Some(Matrix3::identity() * 1e-6),
                size_px: Some(100.0),
                confidence: 1.0,
            }),
        }
    }

    /// Lets time pass; without positions where `is_known` is false.
    fn run(&mut self, seconds: f64, is_known: bool) {
        for i in 0..(seconds / STEP_S).round() as u32 {
            self.seconds += STEP_S;
            if is_known {
                self.step(Event::Vehicle(self.state()));
            } else {
                self.step(Event::Status(self.status));
            }
            if let Some(pad) = self.pad.filter(|_| i.is_multiple_of(2)) {
                self.step(Event::Frame(self.frame(pad)));
            }
            self.step(Event::Tick);
        }
    }

    /// The vehicle takes off.
    fn rise(&mut self, metres: f64) {
        self.velocity = Vector::new(0.0, 0.0, -1.0);
        for _ in 0..(metres / STEP_S).round() as u32 {
            self.position = self.position + self.velocity * STEP_S;
            self.run(STEP_S, true);
        }
        self.velocity = Vector::zero();
        self.run(0.5, true);
    }

    /// The vehicle flies the velocity that the lander commands.
    fn fly(&mut self, seconds: f64) {
        for _ in 0..(seconds / STEP_S).round() as u32 {
            self.run(STEP_S, true);
            let last = self.decisions.last().unwrap().1;
            if let Action::Velocity { velocity, .. } = last.action {
                self.velocity = velocity;
            }
            self.position = self.position + self.velocity * STEP_S;
        }
    }

    fn phase(&self) -> Phase {
        self.lander.phase()
    }

    fn has_asked_for_land(&self) -> bool {
        self.decisions.iter().any(|(_, decision)| decision.action == Action::Land)
    }
}

#[test]
fn a_climb_after_markers_that_the_estimate_refuses_goes_straight_up() {
    // Two positions in turn: neither is seen often enough to be taken for the pad.
    let mut harness = Harness::started(Config::default(), 6.0);
    harness.pad = Some(Point::new(1.0, 0.0, 0.0));
    harness.fly(1.0);
    assert!(matches!(harness.phase(), Phase::Approach | Phase::Descend), "{:?}", harness.phase());
    let mut climbs = Vec::new();
    for i in 0..40 {
        harness.pad = Some(Point::new(1.0, if i % 2 == 0 { 0.8 } else { -0.8 }, 0.0));
        let before = harness.decisions.len();
        harness.fly(2.0 * STEP_S);
        let new = harness.decisions.iter().skip(before).map(|(_, decision)| *decision);
        climbs.extend(new.filter(|decision| decision.why == Reason::RetryingRefused));
    }
    assert!(climbs.len() > 10, "{} decisions", climbs.len());
    for decision in climbs {
        let Action::Velocity { velocity, .. } = decision.action else { panic!("{decision:?}") };
        assert!(velocity.horizontal_norm() < 1e-9, "{velocity:?}");
        assert!(velocity.z() <= 0.0, "{velocity:?}");
    }
}

#[test]
fn the_pilot_is_seen_without_a_position_and_keeps_the_vehicle() {
    for mode in [Mode::Other, Mode::Land] {
        let mut harness = Harness::started(Config::default(), 5.0);
        harness.run(1.0, true);
        harness.run(1.0, false);
        assert_eq!(harness.phase(), Phase::Hold);
        harness.status.mode = mode;
        harness.run(0.1, false);
        assert_eq!(harness.phase(), Phase::PilotInCommand, "{mode:?}");
        harness.step(Event::Alarm(Alarm::BatteryCritical));
        harness.run(5.0, false);
        assert!(!harness.has_asked_for_land());
        harness.status.mode = Mode::Guided;
        harness.run(5.0, true);
        assert_eq!(harness.phase(), Phase::PilotInCommand);
        let after = harness.decisions.iter().filter(|(seconds, _)| *seconds > 3.6);
        assert!(after.clone().count() > 100);
        assert!(after.clone().all(|(_, decision)| decision.action == Action::None));
    }
}

#[test]
fn land_is_not_asked_for_while_the_mode_is_unknown() {
    let mut harness = Harness::started(Config::default(), 5.0);
    harness.run(1.0, true);
    harness.status.mode = Mode::Unknown;
    harness.run(0.5, true);
    assert_eq!(harness.decisions.last().unwrap().1.why, Reason::ModeUnknown);
    harness.step(Event::Alarm(Alarm::BatteryCritical));
    harness.run(10.0, true);
    assert!(!harness.has_asked_for_land());
    assert_eq!(harness.decisions.last().unwrap().1.action, Action::hover());
    harness.status.mode = Mode::Guided;
    harness.run(0.5, true);
    assert!(harness.has_asked_for_land(), "the heartbeat is back");
}

#[test]
fn a_report_of_the_ground_is_not_accepted_high_over_the_pad_or_in_motion() {
    let on_ground = VehicleStatus { landed: Landed::OnGround, ..FLYING };
    // High over the pad.
    let mut harness = Harness::started(Config::default(), 6.0);
    harness.pad = Some(Point::origin());
    harness.run(3.0, true);
    harness.step(Event::Status(on_ground));
    harness.status = on_ground;
    harness.run(6.0, true);
    assert!(!harness.has_asked_for_land());
    // High over the ground that it took off from.
    let mut harness = Harness::new(Config::default(), 0.0);
    harness.status = on_ground;
    harness.run(1.0, true);
    harness.status = FLYING;
    harness.rise(6.0);
    harness.step(Event::Operator(OperatorCommand::Start));
    harness.status = on_ground;
    harness.run(3.0, true);
    assert!(!harness.has_asked_for_land() && harness.phase() == Phase::Search);
    // In motion, with no height known.
    let mut harness = Harness::started(Config::default(), 6.0);
    harness.velocity = Vector::new(0.0, 0.0, 1.0);
    harness.status = on_ground;
    harness.run(0.5, true);
    assert!(!harness.has_asked_for_land());
    // Right over the pad it is.
    let mut harness = Harness::started(Config::default(), 0.1);
    harness.pad = Some(Point::origin());
    harness.status = on_ground;
    harness.run(0.5, true);
    assert!(harness.has_asked_for_land());
}

#[test]
fn a_vehicle_that_hovers_because_no_detector_is_left_does_not_stand() {
    let mut harness = Harness::started(Config::default(), 3.0);
    harness.pad = Some(Point::origin());
    harness.fly(2.0);
    for _ in 0..400 {
        if harness.position.z() > -0.35 {
            break;
        }
        harness.fly(STEP_S);
    }
    assert!(
        harness.phase() == Phase::Descend && harness.position.z() < -0.1,
        "{:?}",
        harness.position
    );
    harness.pad = None;
    harness.step(Event::DetectorsAlive(false));
    let from_s = harness.seconds;
    harness.velocity = Vector::zero();
    harness.run(5.0, true);
    for (_, decision) in harness.decisions.iter().filter(|(seconds, _)| *seconds > from_s) {
        assert_ne!(decision.phase, Phase::Final, "{decision:?}");
        if let Action::Velocity { velocity, .. } = decision.action {
            assert!(velocity.z() <= 0.0, "{decision:?}");
        }
    }
    let why = harness.decisions.iter().find(|(seconds, _)| *seconds > from_s).unwrap().1.why;
    assert_eq!(why, Reason::NoDetector);
}

#[test]
fn a_search_climbs_over_the_ground_and_not_over_the_origin() {
    let config = Config::default();
    let climbed_m = |took_off: bool, ground_z_m: f64, height_m: f64| {
        let mut harness = Harness::new(config, height_m - ground_z_m);
        if took_off {
            harness.position = Point::new(0.0, 0.0, ground_z_m);
            harness.status.landed = Landed::OnGround;
            harness.run(0.5, true);
            harness.status = FLYING;
            harness.rise(height_m);
        }
        harness.run(0.5, true);
        harness.step(Event::Operator(OperatorCommand::Start));
        harness.fly(25.0);
        ground_z_m - harness.position.z() - height_m
    };
    for ground_z_m in [-20.0, 0.0, 20.0] {
        let known_m = climbed_m(true, ground_z_m, 2.0);
        assert!((known_m - 3.0).abs() < 0.2, "{ground_z_m}: {known_m} m");
    }
    // A lander that begins in the air has no height of the ground.
    assert!((climbed_m(false, 0.0, 2.0) - 3.0).abs() < 0.2);
    assert!(climbed_m(false, -20.0, 2.0).abs() < 0.2);
    assert!((climbed_m(false, 20.0, 2.0) - 5.0).abs() < 0.2, "at most that far over the start");
}

#[test]
fn an_abort_climbs_over_the_pad() {
    let mut config = Config::default();
    config.phases.on_abort = OnAbort::Climb;
    config.phases.abort_height_m = 8.0;
    let mut harness = Harness::started(config, 9.0);
    // The pad lies 5 m over the origin.
    harness.pad = Some(Point::new(0.0, 0.0, -5.0));
    harness.run(2.0, true);
    harness.step(Event::Operator(OperatorCommand::Abort));
    harness.fly(20.0);
    assert!((harness.position.z() + 13.0).abs() < 0.2, "{:?}", harness.position);
    config.phases.fence_height_m = 10.0;
    let mut harness = Harness::started(config, 9.0);
    harness.pad = Some(Point::new(0.0, 0.0, -5.0));
    harness.run(2.0, true);
    harness.step(Event::Operator(OperatorCommand::Abort));
    harness.fly(20.0);
    assert!(harness.position.z() > -10.2, "{:?}", harness.position);
}

#[test]
fn an_aborted_vehicle_without_a_link_does_the_configured_action_once_it_has_one() {
    let mut config = Config::default();
    config.phases.on_abort = OnAbort::Land;
    let mut harness = Harness::started(config, 9.0);
    harness.pad = Some(Point::origin());
    harness.run(2.0, true);
    // The link is lost until long after the hold has ended in an abort.
    harness.pad = None;
    for _ in 0..75 {
        harness.seconds += 1.0;
        harness.step(Event::Tick);
    }
    assert_eq!(harness.phase(), Phase::Aborted);
    assert!(!harness.has_asked_for_land());
    harness.run(0.5, true);
    assert!(harness.has_asked_for_land());
    // By default it climbs, where it is low.
    let mut harness = Harness::new(Config::default(), 0.0);
    harness.status.landed = Landed::OnGround;
    harness.run(0.5, true);
    harness.status = FLYING;
    harness.rise(6.0);
    harness.step(Event::Operator(OperatorCommand::Start));
    harness.pad = Some(Point::origin());
    while harness.position.z() < -1.0 {
        harness.fly(STEP_S);
    }
    harness.pad = None;
    harness.velocity = Vector::zero();
    for _ in 0..75 {
        harness.seconds += 1.0;
        harness.step(Event::Tick);
    }
    assert_eq!(harness.phase(), Phase::Aborted);
    harness.fly(5.0);
    assert!((harness.position.z() + 2.5).abs() < 0.2, "{:?}", harness.position);
}

#[test]
fn an_abort_that_climbs_does_not_lift_a_vehicle_that_may_stand() {
    let mut config = Config::default();
    config.phases.on_abort = OnAbort::Climb;
    let mut harness = Harness::started(config, 2.0);
    harness.pad = Some(Point::origin());
    while harness.position.z() < -0.1 {
        harness.fly(STEP_S);
    }
    harness.velocity = Vector::zero();
    harness.run(0.1, true);
    harness.step(Event::Operator(OperatorCommand::Abort));
    let from_s = harness.seconds;
    harness.run(2.0, true);
    let climbs = |decision: &Decision| matches!(decision.action, Action::Velocity { velocity, .. } if velocity.z() < 0.0);
    assert_eq!(harness.phase(), Phase::Aborted);
    assert!(!harness.decisions.iter().any(|(seconds, it)| *seconds > from_s && climbs(it)));
    // It flies after all.
    harness.velocity = Vector::new(0.0, 0.0, -0.5);
    harness.run(0.1, true);
    assert!(climbs(&harness.decisions.last().unwrap().1));
}

/// The height over the ground drifts in a flight in which no marker is seen, by more than the height that distinguishes a standing from a
/// flying vehicle.
#[test]
fn the_ground_is_where_the_vehicle_stands_with_its_motors_off() {
    let on_ground = VehicleStatus { landed: Landed::OnGround, ..FLYING };
    let mut harness = Harness::new(Config::default(), 0.0);
    harness.status = on_ground;
    harness.run(1.0, true);
    harness.status = FLYING;
    harness.rise(4.0);
    // The pilot lands; the height reads 1.5 m.
    harness.position = Point::new(0.0, 0.0, -1.5);
    harness.status = VehicleStatus { armed: false, mode: Mode::Other, ..on_ground };
    harness.run(1.0, true);
    harness.status = FLYING;
    harness.rise(2.0);
    harness.step(Event::Operator(OperatorCommand::Start));
    harness.fly(25.0);
    let height_m = -1.5 - harness.position.z();
    assert!((height_m - 5.0).abs() < 0.2, "searched from {height_m} m over the ground");
}

#[test]
fn a_landing_aborted_low_hovers_where_a_drift_does_not_touch_the_ground() {
    let hovers_m = |config, started_m, aborted_m: f64| {
        let mut harness = Harness::started(config, started_m);
        harness.pad = Some(Point::origin());
        while harness.position.z() < -aborted_m {
            harness.fly(STEP_S);
        }
        harness.step(Event::Operator(OperatorCommand::Abort));
        harness.fly(4.5);
        -harness.position.z()
    };
    let config = Config::default();
    assert!((hovers_m(config, 6.0, 0.8) - 2.5).abs() < 0.2);
    let high_m = hovers_m(config, 6.0, 4.0);
    assert!((3.5..=4.0).contains(&high_m), "{high_m} m");
    assert!((hovers_m(config, 1.8, 0.8) - 1.8).abs() < 0.2, "it was not higher before");
    let mut never = config;
    never.phases.abort_hover_m = 0.0;
    assert!(hovers_m(never, 6.0, 0.8) < 0.9);

    // A long climb is flown to its end, hovers as long as configured, and ends with a setpoint that stops.
    let mut high = config;
    high.phases.abort_hover_m = 7.0;
    let mut harness = Harness::started(high, 9.0);
    harness.pad = Some(Point::origin());
    while harness.position.z() < -0.8 {
        harness.fly(STEP_S);
    }
    harness.step(Event::Operator(OperatorCommand::Abort));
    harness.fly(9.0);
    assert!((harness.position.z() + 7.0).abs() < 0.2, "{:?}", harness.position);
    harness.fly(8.0);
    assert!((harness.position.z() + 7.0).abs() < 0.2, "{:?}", harness.position);
    assert_eq!(harness.decisions.last().unwrap().1.action, Action::None);
}

/// A vehicle that sinks at 1.7 m/s loses more than a metre while it brakes.
#[test]
fn a_landing_aborted_in_a_quick_descent_climbs_back_over_the_height_at_which_it_hovers() {
    for aborted_m in [2.9, 2.6, 3.8] {
        let mut harness = Harness::started(Config::default(), 8.0);
        harness.pad = Some(Point::origin());
        while harness.position.z() < -aborted_m {
            harness.fly(STEP_S);
        }
        harness.velocity = Vector::new(0.0, 0.0, 1.7);
        harness.run(STEP_S, true);
        harness.step(Event::Operator(OperatorCommand::Abort));
        let mut lowest_m = f64::MAX;
        for _ in 0..480 {
            harness.run(STEP_S, true);
            let last = harness.decisions.last().unwrap().1;
            let commanded_m_s = match last.action {
                Action::Velocity { velocity, .. } => velocity.z(),
                _ => 0.0,
            };
            let change_m_s =
                (commanded_m_s - harness.velocity.z()).clamp(-1.25 * STEP_S, 1.25 * STEP_S);
            harness.velocity = Vector::new(0.0, 0.0, harness.velocity.z() + change_m_s);
            harness.position = harness.position + harness.velocity * STEP_S;
            lowest_m = lowest_m.min(-harness.position.z());
        }
        let height_m = -harness.position.z();
        assert!(lowest_m < aborted_m - 0.8, "{aborted_m} m: {lowest_m} m");
        assert!(height_m > 2.3 && height_m < aborted_m, "{aborted_m} m: {height_m} m");
        assert_eq!(harness.decisions.last().unwrap().1.action, Action::None, "{aborted_m} m");
    }
}

#[test]
fn a_vehicle_that_may_stand_is_not_lifted_by_an_abort() {
    for height_m in [0.0, 0.2, 0.45] {
        let mut harness = Harness::started(Config::default(), 5.0);
        harness.pad = Some(Point::origin());
        harness.fly(2.0);
        while harness.position.z() < -height_m {
            harness.fly(STEP_S);
        }
        // It stands on the pad, though its autopilot does not report it.
        harness.velocity = Vector::zero();
        harness.run(1.0, true);
        harness.step(Event::Operator(OperatorCommand::Abort));
        harness.fly(4.5);
        assert!(
            (harness.position.z() + height_m).abs() < 0.1,
            "{height_m}: {:?}",
            harness.position
        );
    }
    // One that sinks when it is aborted is lifted, though it is still for a moment when it turns.
    let mut harness = Harness::started(Config::default(), 5.0);
    harness.pad = Some(Point::origin());
    harness.fly(2.0);
    while harness.position.z() < -0.52 {
        harness.fly(STEP_S);
    }
    harness.velocity = Vector::new(0.0, 0.0, 0.3);
    harness.run(STEP_S, true);
    harness.step(Event::Operator(OperatorCommand::Abort));
    harness.position = Point::new(0.0, 0.0, -0.47);
    harness.velocity = Vector::zero();
    harness.run(STEP_S, true);
    harness.fly(4.5);
    assert!((harness.position.z() + 2.5).abs() < 0.2, "{:?}", harness.position);
}

/// Where the standing height is configured and the autopilot reports a flight, an aborted vehicle is lifted from lower heights.
#[test]
fn an_abort_in_a_low_hold_climbs_only_where_the_vehicle_certainly_flies() {
    let aborted = |standing_height_m: f64, landed: Landed, height_m: f64| {
        let metric = MetricConfig { standing_height_m, ..MetricConfig::default() };
        let config = Config { guidance: GuidanceConfig::Metric(metric), ..Config::default() };
        let mut flight = Harness::started(config, 5.0);
        flight.pad = Some(Point::origin());
        while flight.position.z() < -height_m {
            flight.fly(STEP_S);
        }
        flight.step(Event::Operator(OperatorCommand::Hold));
        flight.velocity = Vector::zero();
        flight.status.landed = landed;
        flight.run(2.0, true);
        flight.step(Event::Operator(OperatorCommand::Abort));
        let is_left_low = flight.lander.is_left_low();
        flight.fly(7.0);
        assert_eq!(flight.lander.is_left_low(), is_left_low, "after the last setpoint");
        (-flight.position.z() > 2.3, is_left_low)
    };
    assert_eq!(aborted(0.1, Landed::InAir, 0.47), (true, false));
    for (standing_height_m, landed, height_m) in [
        (0.1, Landed::InAir, 0.35),
        (0.1, Landed::Unknown, 0.45),
        (0.0, Landed::InAir, 0.45),
        (0.25, Landed::InAir, 0.45),
    ] {
        let low = aborted(standing_height_m, landed, height_m);
        assert_eq!(low, (false, true), "{standing_height_m} m, {landed:?}, {height_m} m");
    }
    // Pilot and ground end the warning.
    let mut flight = Harness::started(Config::default(), 5.0);
    flight.pad = Some(Point::origin());
    while flight.position.z() < -0.3 {
        flight.fly(STEP_S);
    }
    flight.velocity = Vector::zero();
    flight.run(0.1, true);
    flight.step(Event::Operator(OperatorCommand::Abort));
    assert!(flight.lander.is_left_low());
    flight.status.mode = Mode::Other;
    flight.run(1.0, true);
    assert!(flight.lander.is_left_low(), "a PX4 in HOLD");
    flight.velocity = Vector::new(0.0, 0.0, -0.5);
    flight.run(0.1, true);
    flight.velocity = Vector::zero();
    flight.run(0.1, true);
    assert!(!flight.lander.is_left_low());
}

#[test]
fn a_search_that_is_interrupted_again_and_again_stays_about_the_position_where_it_began() {
    let config = Config::default();
    let max_m = config.phases.search_radius_m * std::f64::consts::SQRT_2 + 2.0;
    let mut harness = Harness::started(config, 8.0);
    let mut farthest_m: f64 = 0.0;
    for _ in 0..12 {
        for _ in 0..6 {
            harness.fly(1.0);
            farthest_m = farthest_m.max((harness.position - Point::origin()).horizontal_norm());
        }
        assert_eq!(harness.phase(), Phase::Search);
        harness.velocity = Vector::zero();
        harness.run(1.0, false);
        assert_eq!(harness.phase(), Phase::Hold);
    }
    assert!(farthest_m <= max_m && farthest_m > 0.5 * max_m, "{farthest_m} m");
}

#[test]
fn motors_that_are_stopped_in_the_air_end_no_landing_as_a_touchdown() {
    for (mode, height_m) in
        [(Mode::Guided, 0.43), (Mode::Guided, 3.0), (Mode::Land, 0.43), (Mode::Land, 2.0)]
    {
        let mut flight = Harness::started(Config::default(), 5.0);
        flight.pad = Some(Point::origin());
        while flight.position.z() < -height_m {
            flight.fly(STEP_S);
        }
        if mode == Mode::Land {
            flight.step(Event::Operator(OperatorCommand::LandHere));
            flight.velocity = Vector::new(0.0, 0.0, 0.3);
            flight.status.mode = mode;
            flight.run(STEP_S, true);
            assert_eq!(flight.phase(), Phase::Final);
        } else {
            flight.velocity = Vector::zero();
        }
        flight.status.armed = false;
        flight.step(Event::Status(flight.status));
        while flight.position.z() < 0.0 {
            flight.velocity = flight.velocity + Vector::new(0.0, 0.0, 9.8 * STEP_S);
            flight.position = flight.position + flight.velocity * STEP_S;
            flight.run(STEP_S, true);
        }
        flight.velocity = Vector::zero();
        flight.status.landed = Landed::OnGround;
        flight.run(1.0, true);
        let decision = flight.decisions.last().unwrap().1;
        let end = (decision.phase, decision.why);
        assert_eq!(end, (Phase::Aborted, Reason::StoppedInAir), "{mode:?}, {height_m} m");
    }
    // The report of the ground may come after the motors have stopped.
    let mut flight = Harness::started(Config::default(), 1.0);
    flight.pad = Some(Point::origin());
    flight.run(1.0, true);
    flight.step(Event::Operator(OperatorCommand::LandHere));
    (flight.velocity, flight.status.mode) = (Vector::new(0.0, 0.0, 0.3), Mode::Land);
    flight.run(1.0, true);
    flight.position = Point::origin();
    flight.velocity = Vector::zero();
    flight.run(1.0, true);
    flight.status.armed = false;
    flight.run(0.1, true);
    assert_eq!(flight.phase(), Phase::Landed);
}

/// The heartbeat that reports the motors is sent once a second, so the vehicle may lie still on the ground when it is received.
#[test]
fn a_fall_is_recognised_when_the_heartbeat_with_the_motors_off_comes_late() {
    for (mode, height_m) in [
        (Mode::Guided, 0.43),
        (Mode::Guided, 1.0),
        (Mode::Guided, 3.0),
        (Mode::Land, 0.43),
        (Mode::Land, 2.0),
    ] {
        for late_s in [0.0, 0.05, 0.3, 0.6, 0.9, 1.1, 2.0] {
            let mut flight = Harness::started(Config::default(), 5.0);
            flight.pad = Some(Point::origin());
            while flight.position.z() < -height_m {
                flight.fly(STEP_S);
            }
            if mode == Mode::Land {
                flight.step(Event::Operator(OperatorCommand::LandHere));
                flight.velocity = Vector::new(0.0, 0.0, 0.3);
                flight.status.mode = mode;
                flight.run(STEP_S, true);
            } else {
                flight.velocity = Vector::zero();
            }
            let mut seconds = 0.0;
            let mut fall = |flight: &mut Harness| {
                seconds += STEP_S;
                // A PX4 reports the ground soon after its motors are off.
                if seconds > 0.1 {
                    flight.status.landed = Landed::OnGround;
                }
                if flight.position.z() < 0.0 {
                    flight.velocity = flight.velocity + Vector::new(0.0, 0.0, 9.8 * STEP_S);
                    flight.position = flight.position + flight.velocity * STEP_S;
                } else {
                    flight.velocity = Vector::zero();
                }
                flight.run(STEP_S, true);
            };
            for _ in 0..(late_s / STEP_S).round() as u32 {
                fall(&mut flight);
            }
            flight.status.armed = false;
            let before = flight.decisions.len();
            for _ in 0..40 {
                fall(&mut flight);
            }
            let decision = flight.decisions.last().unwrap().1;
            let end = (decision.phase, decision.why);
            let expected = (Phase::Aborted, Reason::StoppedInAir);
            assert_eq!(end, expected, "{mode:?}, {height_m} m, {late_s} s");
            for (_, decision) in &flight.decisions[before..] {
                assert_eq!(decision.action, Action::None, "{mode:?}, {height_m} m, {late_s} s");
                let is_new = decision.why == Reason::Aligning || decision.why == Reason::MayStand;
                assert!(!is_new, "{mode:?}, {height_m} m, {late_s} s: {decision:?}");
            }
        }
    }
}

/// A vehicle that descends or is in LAND at 5 m; its motors stop, and it falls on the pad. Its states arrive 100 times a second,
/// except for this time from the stop on, in seconds.
fn falls(mode: Mode, height_m: f64, silent_s: f64) -> Harness {
    const PERIOD_S: f64 = 0.01;
    let mut flight = Harness::started(Config::default(), height_m + 1.0);
    flight.pad = Some(Point::origin());
    while flight.position.z() < -height_m {
        flight.fly(STEP_S);
    }
    flight.velocity = Vector::zero();
    if mode == Mode::Land {
        flight.step(Event::Operator(OperatorCommand::LandHere));
        flight.status.mode = mode;
        flight.run(STEP_S, true);
        assert_eq!(flight.phase(), Phase::Final);
    }
    let mut seconds = 0.0;
    while flight.position.z() < 0.0 || seconds < silent_s {
        seconds += PERIOD_S;
        flight.seconds += PERIOD_S;
        flight.velocity = flight.velocity + Vector::new(0.0, 0.0, 9.8 * PERIOD_S);
        let z_m = (flight.position.z() + flight.velocity.z() * PERIOD_S).min(0.0);
        flight.position = Point::new(flight.position.x(), flight.position.y(), z_m);
        if z_m == 0.0 {
            flight.velocity = Vector::zero();
        }
        if seconds > silent_s {
            flight.step(Event::Vehicle(flight.state()));
        }
        flight.step(Event::Tick);
    }
    flight.velocity = Vector::zero();
    flight.status.landed = Landed::OnGround;
    flight
}

/// It stands 100 times a second for so long, and is disarmed; the end.
fn end_disarmed(flight: &mut Harness, late_s: f64) -> (Phase, Reason) {
    for i in 0..((late_s + 1.0) / 0.01).round() as u32 {
        flight.seconds += 0.01;
        flight.status.armed = f64::from(i) * 0.01 < late_s;
        flight.step(Event::Vehicle(flight.state()));
        // The autopilot obeys.
        if flight.step(Event::Tick).action == Action::Land {
            flight.status.mode = Mode::Land;
        }
    }
    let decision = flight.decisions.last().unwrap().1;
    (decision.phase, decision.why)
}

/// PX4's kill switch stops the motors and disarms 5 s later, ArduPilot's crash check 2 s after the rest.
#[test]
fn a_fall_is_recognised_when_the_vehicle_is_disarmed_seconds_after_the_impact() {
    let stopped = (Phase::Aborted, Reason::StoppedInAir);
    for mode in [Mode::Guided, Mode::Land] {
        for late_s in [0.5, 2.5, 5.0, 6.0] {
            for height_m in [5.0, 1.2, 0.6] {
                let end = end_disarmed(&mut falls(mode, height_m, 0.0), late_s);
                assert_eq!(end, stopped, "{mode:?}, {height_m} m, {late_s} s");
            }
        }
        // So low it falls for less time than a free fall takes to show, and a report of it comes soon.
        assert_eq!(end_disarmed(&mut falls(mode, 0.43, 0.0), 2.0), stopped, "{mode:?}");
        // The states of the fall are missing.
        assert_eq!(end_disarmed(&mut falls(mode, 3.0, 0.8), 5.0), stopped, "{mode:?}");
    }
}

/// A gap in the states, in which a vehicle in LAND sinks as fast as LAND does, or its autopilot's position jumps.
#[test]
fn neither_a_gap_nor_a_jump_of_the_position_makes_a_landing_a_fall() {
    for (down_m_s, gap_s, jump_m) in [
        (0.5, 0.8, 0.0),
        (1.5, 1.4, 0.0),
        (0.5, STEP_S, 4.0),
        (0.5, 0.2, 4.0),
        (0.5, 0.4, 4.0),
        (0.5, 0.8, 8.0),
        (0.5, 2.0, 12.0),
    ] {
        let mut flight = in_land(4.0);
        flight.velocity = Vector::new(0.0, 0.0, down_m_s);
        flight.run(0.5, true);
        flight.run(gap_s - STEP_S, false);
        let to_m = flight.position.z() + down_m_s * (0.5 + gap_s) + jump_m;
        flight.position = Point::new(flight.position.x(), flight.position.y(), to_m);
        flight.velocity = Vector::new(0.0, 0.0, 0.5);
        for _ in 0..80 {
            flight.run(STEP_S, true);
            flight.position = flight.position + flight.velocity * STEP_S;
        }
        flight.velocity = Vector::zero();
        flight.status.landed = Landed::OnGround;
        let end = end_disarmed(&mut flight, 2.5);
        assert_eq!(end, (Phase::Landed, Reason::TouchedDown), "{down_m_s} {gap_s} {jump_m}");
    }
}

/// A vehicle stands still for a second before its autopilot stops the motors, also on a deck that heaves.
#[test]
fn a_landing_is_one_whenever_the_heartbeat_with_the_motors_off_comes() {
    for (down_m_s, heave_m_s) in [(0.3, 0.0), (0.8, 0.0), (1.3, 0.0), (0.8, 0.5)] {
        for late_s in [0.0, 0.5, 1.1, 2.0] {
            let mut config = Config::default();
            config.estimator.pad_heave_m_s = heave_m_s;
            let mut flight = Harness::started(config, 1.5);
            flight.pad = Some(Point::origin());
            flight.run(1.0, true);
            flight.step(Event::Operator(OperatorCommand::LandHere));
            (flight.velocity, flight.status.mode) = (Vector::new(0.0, 0.0, down_m_s), Mode::Land);
            while flight.position.z() < 0.0 {
                flight.position = flight.position + flight.velocity * STEP_S;
                flight.run(STEP_S, true);
            }
            flight.velocity = Vector::new(0.0, 0.0, heave_m_s);
            flight.status.landed = Landed::OnGround;
            flight.run(1.0 + late_s, true);
            flight.status.armed = false;
            flight.run(0.1, true);
            let phase = flight.phase();
            assert_eq!(phase, Phase::Landed, "{down_m_s} m/s, {heave_m_s} m/s, {late_s} s");
        }
    }
}

/// A vehicle in LAND at this height, which sinks; its state is reported for the last time.
fn in_land(height_m: f64) -> Harness {
    let mut flight = Harness::started(Config::default(), 6.0);
    flight.pad = Some(Point::origin());
    while flight.position.z() < -height_m {
        flight.fly(STEP_S);
    }
    flight.step(Event::Operator(OperatorCommand::LandHere));
    flight.velocity = Vector::new(0.0, 0.0, 0.5);
    flight.status.mode = Mode::Land;
    flight.run(STEP_S, true);
    flight.pad = None;
    flight
}

/// An autopilot reports the ground as soon as the motors are off.
#[test]
fn motors_that_stop_while_the_state_is_old_end_no_landing_as_a_touchdown_in_the_air() {
    let stopped = |height_m: f64, silent_s: f64| {
        let mut flight = in_land(height_m);
        flight.run(silent_s, false);
        (flight.status.armed, flight.status.landed) = (false, Landed::OnGround);
        flight.run(0.3, false);
        flight
    };
    let end = |flight: &Harness| {
        let decision = flight.decisions.last().unwrap().1;
        (decision.phase, decision.why)
    };
    // So high that it cannot have come down.
    assert_eq!(end(&stopped(5.0, 0.7)), (Phase::Aborted, Reason::StoppedInAir));
    // The next state shows that it falls, or that it stands.
    let mut falls = stopped(2.0, 0.7);
    assert_eq!(falls.phase(), Phase::Final);
    falls.velocity = Vector::new(0.0, 0.0, 4.0);
    falls.run(0.1, true);
    assert_eq!(end(&falls), (Phase::Aborted, Reason::StoppedInAir));
    let mut stands = stopped(2.0, 5.0);
    assert_eq!(stands.phase(), Phase::Final);
    (stands.position, stands.velocity) = (Point::origin(), Vector::zero());
    stands.run(0.1, true);
    assert_eq!(end(&stands), (Phase::Landed, Reason::TouchedDown));
    // The wait is bounded.
    let mut silent = stopped(2.0, 5.0);
    silent.run(1.6, false);
    assert_eq!(silent.phase(), Phase::Final);
    silent.run(0.2, false);
    assert_eq!(end(&silent), (Phase::Landed, Reason::TouchedDown));
}

#[test]
fn a_retry_stays_below_the_fence() {
    let mut config = Config::default();
    config.phases.fence_height_m = 4.0;
    let mut harness = Harness::started(config, 6.0);
    harness.pad = Some(Point::origin());
    harness.fly(2.0);
    for _ in 0..800 {
        if harness.position.z() > -3.5 {
            break;
        }
        harness.fly(STEP_S);
    }
    harness.pad = None;
    let mut highest_m = 0.0f64;
    let mut has_retried = false;
    for _ in 0..400 {
        harness.fly(STEP_S);
        has_retried |= harness.phase() == Phase::Retry;
        highest_m = highest_m.max(-harness.position.z());
    }
    assert!(has_retried && highest_m < 4.3, "{has_retried} {highest_m}");
}

/// The height to which a vehicle climbs that is 1 m over the pad when two detectors begin to differ, in metres.
fn climbed_in_a_dispute_m(config: Config, started_m: f64) -> f64 {
    let mut harness = Harness::started(config, started_m);
    harness.pad = Some(Point::origin());
    for _ in 0..1200 {
        if harness.position.z() > -1.0 {
            break;
        }
        harness.fly(STEP_S);
    }
    assert!(
        harness.position.z() > -1.0 && harness.phase() == Phase::Descend,
        "{:?}",
        harness.position
    );
    harness.step(Event::Dispute(true));
    let mut highest_m = 0.0f64;
    for _ in 0..400 {
        harness.fly(STEP_S);
        highest_m = highest_m.max(-harness.position.z());
    }
    highest_m
}

#[test]
fn the_climb_of_a_dispute_stays_below_the_fence_and_the_start() {
    let config = Config::default();
    let free_m = climbed_in_a_dispute_m(config, 6.0);
    assert!((free_m - 2.5).abs() < 0.1, "{free_m} m");
    let low_m = climbed_in_a_dispute_m(config, 1.6);
    assert!((low_m - 1.6).abs() < 0.1, "{low_m} m");
    let mut fenced = config;
    fenced.phases.fence_height_m = 2.0;
    let fenced_m = climbed_in_a_dispute_m(fenced, 6.0);
    assert!(fenced_m < 2.0, "{fenced_m} m");
}

#[test]
fn a_dispute_over_a_pad_that_is_higher_than_the_start_lets_nothing_descend() {
    let mut harness = Harness::started(Config::default(), 1.0);
    harness.rise(8.0);
    harness.step(Event::Dispute(true));
    harness.pad = Some(Point::new(0.0, 0.0, -3.0));
    harness.fly(14.0);
    let height_m = -harness.position.z() - 3.0;
    assert!((height_m - 2.5).abs() < 0.2, "{height_m} m");
}

#[test]
fn land_is_not_asked_for_above_the_height_of_a_dispute_while_detectors_disagree() {
    let metric = MetricConfig { land_height_m: 3.0, ..MetricConfig::default() };
    let thesis = ThesisConfig { land_altitude_m: 3.0, ..ThesisConfig::default() };
    for guidance in [GuidanceConfig::Metric(metric), GuidanceConfig::Thesis(thesis)] {
        let config = Config { guidance, ..Config::default() };
        let mut harness = Harness::started(config, 6.0);
        harness.pad = Some(Point::origin());
        harness.fly(1.0);
        harness.step(Event::Dispute(true));
        harness.fly(14.0);
        assert!(!harness.has_asked_for_land() && harness.phase() != Phase::Final);
        assert!(harness.position.z() < -2.3, "{:?}", harness.position);
        harness.fly(16.0);
        assert_eq!((harness.phase(), harness.has_asked_for_land()), (Phase::Hold, false));
        harness.step(Event::Dispute(false));
        harness.fly(8.0);
        assert!(harness.has_asked_for_land(), "{:?} {:?}", harness.phase(), harness.position);
    }
}

#[test]
fn a_retry_that_cannot_rise_has_the_time_of_the_first_try() {
    // The landing began so low that no retry rises above the height of waiting, and the pad stays to one side.
    let mut harness = Harness::started(Config::default(), 0.45);
    harness.pad = Some(Point::new(0.4, 0.0, 0.0));
    harness.run(60.0, true);
    let mut retries = Vec::new();
    for pair in harness.decisions.windows(2) {
        if pair[0].1.phase != Phase::Retry && pair[1].1.phase == Phase::Retry {
            retries.push(pair[1].0);
        }
    }
    assert!(retries.len() > 2, "{retries:?}");
    for pair in retries.windows(2) {
        assert!(pair[1] - pair[0] > 8.0, "{retries:?}");
    }
}

#[test]
fn a_search_that_may_not_climb_flies_its_legs() {
    let mut config = Config::default();
    config.envelope.climb_m_s = 0.0;
    let mut harness = Harness::started(config, 2.0);
    let mut farthest_m = 0.0f64;
    for _ in 0..400 {
        harness.fly(STEP_S);
        farthest_m = farthest_m.max(harness.position.x().hypot(harness.position.y()));
    }
    assert!(farthest_m > 2.0, "{farthest_m} m");
    assert!((harness.position.z() + 2.0).abs() < 1e-9, "{:?}", harness.position);
}

#[test]
fn numbers_of_a_detector_that_make_no_sense_are_refused() {
    let mut harness = Harness::started(Config::default(), 5.0);
    let mut refused = |change: fn(&mut MarkerInFrame)| {
        harness.run(0.1, true);
        let mut frame = harness.frame(Point::origin());
        frame.marker.iter_mut().for_each(change);
        harness.step(Event::Frame(frame)).rejected
    };
    assert_eq!(refused(|_| {}), None);
    assert_eq!(
        refused(|marker| marker.covariance_m2 = Some(Matrix3::identity() * -1e-4)),
        Some(Rejection::BadCovariance)
    );
    assert_eq!(
        refused(|marker| marker.covariance_m2 = Some(Matrix3::identity() * 1e200)),
        Some(Rejection::BadCovariance)
    );
    assert_eq!(
        refused(|marker| {
            let position = Point::new(0.0, 1e160, 5.0);
            marker.alternative = Some(Transform::new(Rotation::identity(), position));
        }),
        Some(Rejection::Implausible)
    );
    assert_eq!(refused(|_| {}), None, "the next one is looked at");
}
