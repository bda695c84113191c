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
                mode: Mode::Guided,
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
