//! Implements the simulated autopilot's decisions: flight modes, arming and disarming, take-off, velocity setpoints and
//! their timeout, LAND, contact with the ground.

use rand_chacha::ChaCha8Rng;

use super::estimate::Estimate;
use super::parameters::{Parameter, Parameters};
use super::precision::Precision;
use super::shaping::norm;
use super::steering::{
    Envelope, HeadingCommand, MotionCommand, Steering, SteeringConfig, VerticalCommand,
};
use crate::drift::{random_stream, uniform};
use crate::laws::square_root_law;
use crate::vehicle::{Demand, HeadingDemand, VehicleTruth};

/// A flight mode, with ArduPilot Copter's number.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Mode {
    /// A pilot's mode; the sticks are centred, so the vehicle stays where it is.
    Stabilize = 0,
    /// As above.
    AltHold = 2,
    /// Setpoints of a companion computer.
    Guided = 4,
    /// As above: stays where it is.
    Loiter = 5,
    /// Straight down, motors off.
    Land = 9,
    /// As above: stays where it is.
    PosHold = 16,
    /// As above: stays where it is.
    Brake = 17,
}

impl Mode {
    /// The mode with this number, of those that the simulated autopilot has.
    pub fn from_number(number: u32) -> Option<Self> {
        [
            Self::Stabilize,
            Self::AltHold,
            Self::Guided,
            Self::Loiter,
            Self::Land,
            Self::PosHold,
            Self::Brake,
        ]
        .into_iter()
        .find(|mode| *mode as u32 == number)
    }
}

/// Where the vehicle is between ground and air, with the numbers of MAV_LANDED_STATE.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Landed {
    /// Motors idle or off.
    OnGround = 1,
    /// Flying.
    InAir = 2,
    /// Climbing after a takeoff.
    TakingOff = 3,
    /// In LAND.
    Landing = 4,
}

/// A velocity setpoint, in local north, east, down.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct Setpoint {
    /// In m/s.
    pub(super) velocity: [f64; 3],
    pub(super) nose: HeadingCommand,
}

impl Setpoint {
    /// Stop.
    pub(super) const STOP: Self = Self { velocity: [0.0; 3], nose: HeadingCommand::Rate(0.0) };

    /// Stops moving and turning; an ordered heading stays.
    fn stop(&mut self) {
        self.velocity = [0.0; 3];
        if let HeadingCommand::Rate(rate) = &mut self.nose {
            *rate = 0.0;
        }
    }
}

/// An event that is reported as text.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) enum FlightEvent {
    /// The motors were switched off.
    Disarmed,
    /// The vehicle touched the ground at this speed, in m/s.
    Hit(f64),
}

#[derive(Copy, Clone, Debug, PartialEq)]
enum Guided {
    /// Follows a setpoint that came at this time, in seconds.
    Velocity(Setpoint, f64),
    /// Waits for the motors, until this time, to rise to this z.
    Spooling { until_s: f64, z: f64 },
    /// Rises.
    Climbing { z: f64 },
    /// Stays at the end of the climb.
    Holding { z: f64 },
}

/// Motors are held after arming for this time, in seconds, and need this long from takeoff to lift.
const ARMING_DELAY_S: f64 = 2.0;
const SPOOL_S: f64 = 1.36;
/// Time from touchdown to its detection, in seconds: in LAND and in GUIDED, and its random spread.
const CONFIRM_IN_LAND_S: f64 = 1.6;
const CONFIRM_IN_GUIDED_S: f64 = 2.0;
const CONFIRM_SPREAD_S: f64 = 0.1;
/// Time from the detection of the touchdown to stopped motors, in seconds, and its random spread.
const STILL_S: f64 = 0.35;
const STILL_SPREAD_S: f64 = 0.15;
/// A climb ends below this part of the climb speed.
const CLIMB_END: f64 = 0.1;

/// The autopilot's decisions.
#[derive(Clone, Debug)]
pub(super) struct Flight {
    steering_config: SteeringConfig,
    random: ChaCha8Rng,
    mode: Mode,
    armed_s: Option<f64>,
    on_ground: bool,
    guided: Guided,
    steering: Option<Steering>,
    touched_s: Option<f64>,
    confirm_after_s: f64,
    idle_since_s: f64,
    was_down: bool,
    /// The target of a precision landing.
    pub(super) precision: Precision,
    events: Vec<FlightEvent>,
}

impl Flight {
    pub(super) fn new(steering_config: SteeringConfig, seed: u64) -> Self {
        Self {
            steering_config,
            random: random_stream(seed, 4),
            mode: Mode::Stabilize,
            armed_s: None,
            on_ground: true,
            guided: Guided::Velocity(Setpoint::STOP, 0.0),
            steering: None,
            touched_s: None,
            confirm_after_s: 0.0,
            idle_since_s: 0.0,
            was_down: true,
            precision: Precision::default(),
            events: Vec::new(),
        }
    }

    pub(super) fn mode(&self) -> Mode {
        self.mode
    }

    pub(super) fn armed(&self) -> bool {
        self.armed_s.is_some()
    }

    pub(super) fn landed(&self) -> Landed {
        match (self.on_ground, self.mode, self.guided) {
            (true, ..) => Landed::OnGround,
            (_, Mode::Land, _) => Landed::Landing,
            (_, Mode::Guided, Guided::Spooling { .. } | Guided::Climbing { .. }) => {
                Landed::TakingOff
            }
            _ => Landed::InAir,
        }
    }

    /// The velocity that is followed in GUIDED, in m/s.
    pub(super) fn target_velocity(&self) -> Option<[f64; 3]> {
        match (self.mode, self.guided) {
            (Mode::Guided, Guided::Velocity(setpoint, _)) => Some(setpoint.velocity),
            _ => None,
        }
    }

    pub(super) fn take_events(&mut self) -> Vec<FlightEvent> {
        std::mem::take(&mut self.events)
    }

    pub(super) fn set_mode(&mut self, now_s: f64, mode: Mode, now: &Estimate) {
        if mode == self.mode {
            return;
        }
        self.mode = mode;
        self.guided = Guided::Velocity(Setpoint::STOP, now_s);
        if let Some(steering) = &mut self.steering {
            steering.restart(now);
        }
    }

    /// Switches the motors on; the reason why not.
    pub(super) fn arm(&mut self, now_s: f64) -> Result<(), &'static str> {
        if self.armed() {
            return Ok(());
        }
        if self.mode == Mode::Land {
            return Err("Mode not armable");
        }
        self.armed_s = Some(now_s);
        self.idle_since_s = now_s;
        self.guided = Guided::Velocity(Setpoint::STOP, now_s);
        Ok(())
    }

    /// Switches the motors off; false in the air, unless forced.
    pub(super) fn disarm(&mut self, forced: bool) -> bool {
        if !self.on_ground && !forced {
            return false;
        }
        self.stop();
        true
    }

    /// In the air, armed and in GUIDED, as after a takeoff.
    pub(super) fn start_in_air(&mut self, now_s: f64) {
        self.mode = Mode::Guided;
        self.armed_s = Some(now_s);
        self.on_ground = false;
        self.was_down = false;
        self.guided = Guided::Velocity(Setpoint::STOP, now_s);
    }

    /// Moves the path that is flown along with a vehicle that is put elsewhere.
    pub(super) fn carry(&mut self, by: [f64; 3]) {
        if let Some(steering) = &mut self.steering {
            steering.carry(by);
        }
    }

    fn stop(&mut self) {
        if self.armed_s.take().is_some() {
            self.events.push(FlightEvent::Disarmed);
        }
        self.on_ground = true;
        self.steering = None;
        self.touched_s = None;
    }

    /// Begins a takeoff to this height over the origin, in metres; false when that is not possible now.
    pub(super) fn take_off(&mut self, now_s: f64, height_m: f64, now: &Estimate) -> bool {
        let Some(armed_s) = self.armed_s else { return false };
        let rises = height_m.is_finite() && -height_m < now.position[2];
        if self.mode != Mode::Guided || !self.on_ground || !rises {
            return false;
        }
        let until_s = now_s.max(armed_s + ARMING_DELAY_S) + SPOOL_S;
        self.guided = Guided::Spooling { until_s, z: -height_m };
        true
    }

    /// Stops and follows setpoints from now on, after any other flight.
    pub(super) fn follow_setpoints(&mut self, now_s: f64, now: &Estimate) {
        self.set_mode(now_s, Mode::Guided, now);
        self.guided = Guided::Velocity(Setpoint::STOP, now_s);
    }

    /// Takes a setpoint, which also ends a takeoff; ignored in all modes but GUIDED.
    pub(super) fn follow(&mut self, now_s: f64, setpoint: Setpoint) {
        if self.mode == Mode::Guided {
            self.guided = Guided::Velocity(setpoint, now_s);
        }
    }

    /// Decides for the next `dt_s`.
    pub(super) fn step(
        &mut self,
        now_s: f64,
        dt_s: f64,
        now: &Estimate,
        truth: &VehicleTruth,
        parameters: &Parameters,
    ) -> Demand {
        self.detect_ground(now_s, truth, parameters);
        if !self.armed() {
            return Demand::IDLE;
        }
        self.advance_takeoff(now_s, now, parameters);
        if self.on_ground {
            self.steering = None;
            return Demand::IDLE;
        }
        let motion = self.motion(now_s, now, parameters);
        let config = &self.steering_config;
        let steering = self.steering.get_or_insert_with(|| Steering::start(config.clone(), now));
        if let Some(by) = now.reset {
            steering.shift(by);
        }
        let mut demand = steering.steer(dt_s, now, &motion, &Envelope::new(parameters));
        // The loops use the estimated attitude, so its errors become errors of the true one.
        demand.roll_rad -= now.roll_error;
        demand.pitch_rad -= now.pitch_error;
        if let HeadingDemand::Angle(angle, _) = &mut demand.heading {
            *angle -= now.yaw_error;
        }
        demand
    }

    /// Notices the ground, and switches off.
    fn detect_ground(&mut self, now_s: f64, truth: &VehicleTruth, parameters: &Parameters) {
        if truth.on_ground && !self.was_down {
            self.events.push(FlightEvent::Hit(truth.impact_m_s.unwrap_or(0.0)));
        }
        self.was_down = truth.on_ground;
        if !self.armed() {
            return;
        }
        if self.on_ground {
            self.switch_off_when_idle(now_s, parameters);
        } else if !truth.on_ground || !self.pushes_down() {
            self.touched_s = None;
        } else {
            let touched_s = *self.touched_s.get_or_insert_with(|| {
                let spread = CONFIRM_SPREAD_S * uniform(&mut self.random);
                let guided = self.mode != Mode::Land;
                self.confirm_after_s =
                    if guided { CONFIRM_IN_GUIDED_S } else { CONFIRM_IN_LAND_S + spread };
                now_s
            });
            if now_s - touched_s >= self.confirm_after_s {
                self.on_ground = true;
                self.touched_s = None;
                self.idle_since_s = now_s + STILL_S + STILL_SPREAD_S * uniform(&mut self.random);
            }
        }
    }

    fn switch_off_when_idle(&mut self, now_s: f64, parameters: &Parameters) {
        let taking_off =
            matches!(self.guided, Guided::Spooling { .. }) && self.mode == Mode::Guided;
        if taking_off {
            self.idle_since_s = now_s;
        }
        let delay_s = parameters.get(Parameter::DisarmDelay);
        let patience_s = if self.mode == Mode::Land { 0.0 } else { delay_s };
        let never = self.mode != Mode::Land && delay_s == 0.0;
        if !never && !taking_off && now_s - self.idle_since_s >= patience_s {
            self.stop();
        }
    }

    fn pushes_down(&self) -> bool {
        match (self.mode, self.guided) {
            (Mode::Land, _) => true,
            (Mode::Guided, Guided::Velocity(setpoint, _)) => setpoint.velocity[2] > 0.0,
            _ => false,
        }
    }

    fn advance_takeoff(&mut self, now_s: f64, now: &Estimate, parameters: &Parameters) {
        if self.mode != Mode::Guided {
            return;
        }
        match self.guided {
            Guided::Spooling { until_s, z } if now_s >= until_s => {
                self.on_ground = false;
                self.guided = Guided::Climbing { z };
            }
            Guided::Climbing { z } => {
                let slow = CLIMB_END * parameters.get(Parameter::SpeedUp) / 100.0;
                let near = 0.5 * slow * slow / (parameters.get(Parameter::AccelerationZ) / 100.0);
                let climbs = self.steering.as_ref().map_or([now.position[2], 0.0], Steering::depth);
                if climbs[0] <= z + near && -climbs[1] < slow {
                    self.guided = Guided::Holding { z };
                }
            }
            _ => {}
        }
    }

    fn motion(&mut self, now_s: f64, now: &Estimate, parameters: &Parameters) -> MotionCommand {
        let stay = MotionCommand {
            velocity: [0.0; 2],
            vertical: VerticalCommand::Velocity(0.0),
            nose: HeadingCommand::Rate(0.0),
        };
        match (self.mode, &mut self.guided) {
            (Mode::Land, _) => {
                let down = descent(-now.position[2], parameters);
                match self.precision.target(now_s) {
                    None => MotionCommand { vertical: VerticalCommand::Velocity(down), ..stay },
                    Some([north, east]) => {
                        let way = [north - now.position[0], east - now.position[1]];
                        precision_command(way, -now.position[2], down, stay)
                    }
                }
            }
            (Mode::Guided, Guided::Velocity(setpoint, came_s)) => {
                if now_s - *came_s > parameters.get(Parameter::GuidedTimeout) {
                    setpoint.stop();
                }
                let [north, east, down] = setpoint.velocity;
                MotionCommand {
                    velocity: [north, east],
                    vertical: VerticalCommand::Velocity(down),
                    nose: setpoint.nose,
                }
            }
            (
                Mode::Guided,
                Guided::Spooling { z, .. } | Guided::Climbing { z } | Guided::Holding { z },
            ) => {
                let climb = parameters.get(Parameter::SpeedUp) / 100.0;
                MotionCommand { vertical: VerticalCommand::Position(*z, climb), ..stay }
            }
            _ => stay,
        }
    }
}

/// Over the target first, and slowly through the last metres, as the real one was measured to do.
fn precision_command(
    way: [f64; 2],
    height_m: f64,
    down: f64,
    stay: MotionCommand,
) -> MotionCommand {
    let size = norm(way);
    let speed = square_root_law(size, 1.0, 0.5).min(2.0);
    let slow = (0.35..2.0).contains(&height_m);
    MotionCommand {
        velocity: way.map(|metres| if size > 0.0 { metres * speed / size } else { 0.0 }),
        vertical: VerticalCommand::Velocity(if slow { down.min(0.2) } else { down }),
        ..stay
    }
}

/// Speed of LAND downwards, in m/s, at a height: fast to LAND_ALT_LOW, then LAND_SPEED.
fn descent(height_m: f64, parameters: &Parameters) -> f64 {
    let slow = parameters.get(Parameter::LandSpeed) / 100.0;
    let high = parameters.get(Parameter::LandSpeedHigh) / 100.0;
    let down = parameters.get(Parameter::SpeedDown) / 100.0;
    let fast = if high > 0.0 { high } else { down }.max(slow);
    let above = height_m - parameters.get(Parameter::LandAltLow) / 100.0;
    square_root_law(above, 1.0, parameters.get(Parameter::AccelerationZ) / 100.0).clamp(slow, fast)
}
