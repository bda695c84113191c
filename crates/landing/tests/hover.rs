//! Hovers of the lander with an autopilot whose velocity errs: they stay where they began, but after motion, a silence or a jump of the
//! position where it is right; and a vehicle that may stand is not led anywhere.

use geometry::{Ned, Point, Rotation, Vector};
use landing::{
    Action, Config, Decision, Event, Landed, Lander, Mode, OperatorCommand, Phase, Timestamp,
    VehicleState,
};

const DT_S: f64 = 0.02;

/// A vehicle that sees no marker, takes half a second to fly as commanded, and drifts in addition.
struct Drifter {
    lander: Lander,
    steps: u32,
    position: Point<Ned>,
    flown: Vector<Ned>,
    drift: Vector<Ned>,
    /// By how much the reported position is off.
    jump: Vector<Ned>,
    landed: Landed,
    mode: Mode,
    has_states: bool,
}

impl Drifter {
    /// In a search that has been flown for so long.
    fn searching(drift: Vector<Ned>, seconds: f64) -> Option<Self> {
        let mut drifter = Self {
            lander: Lander::new(Config::default()).ok()?,
            steps: 0,
            position: Point::new(0.0, 0.0, -8.0),
            flown: Vector::zero(),
            drift,
            jump: Vector::zero(),
            landed: Landed::InAir,
            mode: Mode::Guided,
            has_states: true,
        };
        drifter.fly(DT_S);
        drifter.command(OperatorCommand::Start);
        assert_eq!(drifter.lander.phase(), Phase::Search);
        drifter.fly(seconds);
        Some(drifter)
    }

    fn now(&self) -> Timestamp {
        Timestamp::from_seconds(10.0 + f64::from(self.steps) * DT_S)
    }

    fn command(&mut self, command: OperatorCommand) -> Decision {
        self.lander.step(self.now(), Event::Operator(command))
    }

    /// A search from this position that has just ended without a result; the vehicle is elsewhere.
    fn searched(drift: Vector<Ned>) -> Option<(Self, Point<Ned>)> {
        let mut drifter = Self::searching(drift, 0.2)?;
        let began = drifter.position;
        while drifter.lander.phase() == Phase::Search {
            drifter.fly(DT_S);
        }
        assert_eq!(drifter.lander.phase(), Phase::Hold);
        let away_m = (drifter.position - began).horizontal_norm();
        assert!(away_m > 4.0, "{away_m} m");
        Some((drifter, began))
    }

    /// Flies on; the last velocity that was commanded.
    fn fly(&mut self, seconds: f64) -> Vector<Ned> {
        let mut desired = Vector::zero();
        for _ in 0..(seconds / DT_S).round() as u32 {
            self.steps += 1;
            let state = VehicleState {
                stamp: self.now(),
                ned_from_body: Rotation::identity(),
                position: self.position + self.jump,
                velocity: self.flown,
                mode: self.mode,
                armed: true,
                landed: self.landed,
            };
            let event = if self.has_states { Event::Vehicle(state) } else { Event::Tick };
            desired = match self.lander.step(self.now(), event).action {
                Action::Velocity { velocity, .. } => velocity,
                Action::None | Action::Guided | Action::Disarm | Action::Land => Vector::zero(),
            };
            self.flown = self.flown + (desired - self.flown) * (DT_S / 0.5);
            self.position = self.position + (self.flown + self.drift) * DT_S;
        }
        desired
    }
}

#[test]
fn a_hold_stays_at_its_position_whatever_the_autopilot_takes_for_its_velocity() {
    for drift_m_s in [0.3, 0.5, 0.8] {
        for (north, east) in [(1.0, 0.0), (-0.6, 0.8), (0.0, -1.0)] {
            let mut drifter =
                Drifter::searching(Vector::new(north, east, 0.0) * drift_m_s, 0.2).unwrap();
            let began = drifter.position;
            drifter.command(OperatorCommand::Hold);
            drifter.fly(60.0);
            let away_m = (drifter.position - began).horizontal_norm();
            assert!(away_m < 2.1 * drift_m_s, "{drift_m_s} m/s: {away_m} m");
            assert!((drifter.position.z() - began.z()).abs() < 0.1, "{:?}", drifter.position);
        }
    }
}

#[test]
fn each_hover_has_the_position_where_its_vehicle_stopped() {
    let mut drifter = Drifter::searching(Vector::zero(), 6.0).unwrap();
    for _ in 0..3 {
        let began = drifter.position;
        let flown = drifter.flown;
        assert!(flown.horizontal_norm() > 0.5, "{flown:?}");
        drifter.command(OperatorCommand::Hold);
        drifter.fly(20.0);
        let moved = drifter.position - began;
        assert!((0.1..0.8).contains(&moved.horizontal_norm()), "{moved:?}");
        assert!(moved.x() * flown.x() + moved.y() * flown.y() > 0.0, "it swung back: {moved:?}");
        drifter.command(OperatorCommand::Resume);
        drifter.fly(4.0);
    }
}

#[test]
fn after_a_search_without_a_result_it_holds_where_the_search_began() {
    for drift_m_s in [0.0, 0.5, 0.8] {
        for (north, east) in [(1.0, 0.0), (-0.6, 0.8)] {
            let drift = Vector::new(north, east, 0.0) * drift_m_s;
            let (mut drifter, began) = Drifter::searched(drift).unwrap();
            let limit_m = 2.1 * drift_m_s + 0.2;
            drifter.fly(30.0);
            assert_eq!(drifter.lander.phase(), Phase::Hold);
            let away_m = (drifter.position - began).horizontal_norm();
            assert!(away_m < limit_m, "{drift_m_s} m/s: {away_m} m");
            // The abort leaves it there as well.
            drifter.fly(32.0);
            assert_eq!(drifter.lander.phase(), Phase::Aborted);
            let away_m = (drifter.position - began).horizontal_norm();
            assert!(away_m < limit_m, "{drift_m_s} m/s: {away_m} m after the abort");
        }
    }
}

#[test]
fn the_search_after_one_without_a_result_is_about_the_same_position() {
    let (mut drifter, began) = Drifter::searched(Vector::zero()).unwrap();
    for wait_s in [3.0, 30.0] {
        drifter.fly(wait_s);
        drifter.command(OperatorCommand::Resume);
        let mut farthest_m: f64 = 0.0;
        while drifter.lander.phase() == Phase::Search {
            drifter.fly(DT_S);
            farthest_m = farthest_m.max((drifter.position - began).horizontal_norm());
        }
        assert!((4.0..9.1).contains(&farthest_m), "{farthest_m} m");
    }
}

#[test]
fn the_way_back_from_a_search_ends_with_a_command_the_pilot_the_last_detector_or_the_state() {
    type Change = fn(&mut Drifter);
    let changes: [(&str, Change); 4] = [
        ("hold", |drifter| {
            drifter.command(OperatorCommand::Hold);
        }),
        ("abort", |drifter| {
            drifter.command(OperatorCommand::Abort);
        }),
        ("detectors", |drifter| {
            drifter.lander.step(drifter.now(), Event::DetectorsAlive(false));
        }),
        ("an unknown mode", |drifter| drifter.mode = Mode::Unknown),
    ];
    for (case, change) in changes {
        let (mut drifter, began) = Drifter::searched(Vector::zero()).unwrap();
        assert!(drifter.fly(2.0).horizontal_norm() > 0.9, "{case}: it is on its way");
        change(&mut drifter);
        let from = drifter.position;
        let desired = drifter.fly(4.0);
        let moved_m = (drifter.position - from).horizontal_norm();
        assert!(moved_m < 0.8 && desired.horizontal_norm() < 0.05, "{case}: {moved_m} m");
        assert!((drifter.position - began).horizontal_norm() > 2.0, "{case}");
    }
    let (mut drifter, _) = Drifter::searched(Vector::zero()).unwrap();
    drifter.fly(2.0);
    drifter.mode = Mode::Other;
    assert_eq!((drifter.fly(1.0), drifter.lander.phase()), (Vector::zero(), Phase::PilotInCommand));
    let (mut drifter, _) = Drifter::searched(Vector::zero()).unwrap();
    drifter.fly(2.0);
    drifter.has_states = false;
    assert_eq!(drifter.fly(1.0), Vector::zero());
}

#[test]
fn a_jump_of_the_position_moves_no_vehicle() {
    let mut drifter = Drifter::searching(Vector::zero(), 0.2).unwrap();
    drifter.command(OperatorCommand::Hold);
    drifter.fly(5.0);
    let before = drifter.position;
    drifter.jump = Vector::new(3.0, -4.0, 0.0);
    drifter.fly(20.0);
    assert!((drifter.position - before).norm() < 0.05, "{:?}", drifter.position - before);
}

#[test]
fn without_a_state_it_stops_and_afterwards_it_stays_where_it_is() {
    let mut drifter = Drifter::searching(Vector::new(0.5, 0.0, 0.0), 0.2).unwrap();
    drifter.command(OperatorCommand::Hold);
    drifter.fly(20.0);
    drifter.has_states = false;
    assert_eq!(drifter.fly(3.0), Vector::zero());
    drifter.has_states = true;
    let after = drifter.position;
    drifter.fly(20.0);
    let away = drifter.position - after;
    assert!((0.5..1.1).contains(&away.x()), "{away:?}");
}

#[test]
fn a_vehicle_that_may_stand_is_led_nowhere() {
    let mut drifter = Drifter::searching(Vector::zero(), 0.2).unwrap();
    drifter.command(OperatorCommand::Hold);
    drifter.fly(2.0);
    drifter.landed = Landed::OnGround;
    drifter.drift = Vector::new(0.2, 0.1, 0.0);
    for _ in 0..50 {
        assert_eq!(drifter.fly(0.1).horizontal_norm(), 0.0);
    }
}
