//! Runs the simulated world: vehicle, wind, pad and autopilot together in steps of one fixed length, the same for the same seed
//! and packets.

use std::collections::VecDeque;

use autopilot::Packet;
use geometry::{Ned, Point, Vector};

use crate::ardupilot::{AutopilotConfig, SimulatedAutopilot};
use crate::pad::{PadConfig, PadState};
use crate::vehicle::{Demand, Support, Vehicle, VehicleConfig, VehicleTruth};
use crate::wind::{Wind, WindConfig};

/// Length of a step, in seconds: the rate of ArduPilot's main loop.
pub const STEP_S: f64 = 1.0 / 400.0;

/// Time a vehicle that starts in the air hovers before its first report, in seconds: its loops learn the
/// wind.
const WARM_UP_S: f64 = 8.0;

/// The parts of the world.
#[derive(Clone, Debug, PartialEq)]
pub struct WorldConfig {
    /// The vehicle.
    pub vehicle: VehicleConfig,
    /// The wind.
    pub wind: WindConfig,
    /// The autopilot.
    pub autopilot: AutopilotConfig,
    /// The pad.
    pub pad: PadConfig,
    /// Interruption of the link to the autopilot: start after the world's begin, and duration, in seconds.
    pub link_lost_s: Option<(f64, f64)>,
    /// Height of the vehicle at which the world begins, and with it the pad's motion, gusts, drifts and
    /// faults, in metres.
    pub begin_height_m: f64,
}

impl Default for WorldConfig {
    fn default() -> Self {
        Self {
            vehicle: VehicleConfig::default(),
            wind: WindConfig::default(),
            autopilot: AutopilotConfig::default(),
            pad: PadConfig::default(),
            link_lost_s: None,
            begin_height_m: f64::INFINITY,
        }
    }
}

/// Number of past states stored for cameras with a long exposure, in steps: one second.
const MAX_PAST: usize = 400;

/// Vehicle, wind and autopilot. The same seed and the same packets at the same times give the same flight.
#[derive(Clone, Debug)]
pub struct World {
    config: WorldConfig,
    vehicle: Vehicle,
    wind: Wind,
    autopilot: SimulatedAutopilot,
    demand: Demand,
    air: Vector<Ned>,
    steps: u64,
    begun_s: Option<f64>,
    past: VecDeque<VehicleTruth>,
}

impl World {
    /// A world at time 0. A vehicle that starts in the air has hovered for a while, armed and in GUIDED.
    pub fn new(config: &WorldConfig, seed: u64) -> Self {
        let vehicle = Vehicle::new(config.vehicle.clone(), seed);
        let past = VecDeque::from([vehicle.truth()]);
        let mut world = Self {
            vehicle,
            wind: Wind::new(config.wind.clone(), seed),
            autopilot: SimulatedAutopilot::new(config.autopilot.clone(), seed),
            demand: Demand::IDLE,
            air: Vector::zero(),
            steps: 0,
            begun_s: None,
            past,
            config: config.clone(),
        };
        if config.vehicle.start_height_m > 0.0 {
            world.warm_up();
        }
        world
    }

    /// Hovers until the loops have learnt the wind, and goes back to the start.
    fn warm_up(&mut self) {
        let start = self.vehicle.truth();
        self.autopilot.start_in_air(0.0, &start);
        // Events of this height begin with the first step after it.
        let begin_height_m = std::mem::replace(&mut self.config.begin_height_m, f64::INFINITY);
        self.advance_to(WARM_UP_S);
        self.config.begin_height_m = begin_height_m;
        self.autopilot.carry(start.position - self.vehicle.truth().position);
        self.vehicle.put(start.position);
        self.past.clear();
        self.outgoing().for_each(drop);
    }

    /// Begins the pad's motion, gusts, drifts and faults, once.
    pub fn begin(&mut self) {
        if self.begun_s.is_none() {
            self.begun_s = Some(self.now_s());
            self.autopilot.begin();
        }
    }

    /// Time from the begin to `time_s`, in seconds; `None` before it.
    pub fn since_begin_s(&self, time_s: f64) -> Option<f64> {
        self.begun_s.map(|begun_s| time_s - begun_s).filter(|s| *s >= 0.0)
    }

    /// The pad at a time, in seconds.
    pub fn pad_at(&self, time_s: f64) -> PadState {
        self.config.pad.at(self.since_begin_s(time_s))
    }

    /// Time since the start, in seconds.
    pub fn now_s(&self) -> f64 {
        self.steps as f64 * STEP_S
    }

    /// Lets time pass until the last whole step before `time_s`.
    pub fn advance_to(&mut self, time_s: f64) {
        while self.now_s() + STEP_S <= time_s + 1e-9 {
            self.step();
        }
    }

    /// Takes a packet for the autopilot, now.
    pub fn handle(&mut self, packet: &Packet) {
        self.handle_at(self.now_s(), packet);
    }

    /// Takes a packet for the autopilot at `time_s`, which is before the next step. An answer with the time has this one: that of
    /// the last step would be half a step too early on average, and so would the offset of the clocks that is learnt from it.
    pub fn handle_at(&mut self, time_s: f64, packet: &Packet) {
        if !self.link_is_lost() {
            self.autopilot.handle(time_s, packet);
        }
    }

    /// True while the link to the autopilot is interrupted.
    pub fn link_is_lost(&self) -> bool {
        let lost = self.config.link_lost_s.zip(self.since_begin_s(self.now_s()));
        lost.is_some_and(|((from_s, for_s), now_s)| (from_s..from_s + for_s).contains(&now_s))
    }

    /// Packets from the autopilot.
    pub fn outgoing(&mut self) -> impl Iterator<Item = Vec<u8>> + '_ {
        let is_lost = self.link_is_lost();
        self.autopilot.outgoing().filter(move |_| !is_lost)
    }

    /// How the vehicle moves now.
    pub fn truth(&self) -> VehicleTruth {
        self.vehicle.truth()
    }

    /// How the vehicle moved at `time_s`, within the last second; the nearest known state outside of it.
    pub fn truth_at(&self, time_s: f64) -> VehicleTruth {
        let after = self.past.partition_point(|truth| truth.time_s <= time_s);
        let before = after.checked_sub(1).and_then(|index| self.past.get(index));
        match (before, self.past.get(after)) {
            (Some(before), Some(next)) => before.interpolate(next, time_s),
            (Some(only), None) | (None, Some(only)) => *only,
            (None, None) => self.vehicle.truth(),
        }
    }

    /// Velocity of the air at the vehicle now, in m/s.
    pub fn wind(&self) -> Vector<Ned> {
        self.air
    }

    /// The autopilot.
    pub fn autopilot(&self) -> &SimulatedAutopilot {
        &self.autopilot
    }

    /// The autopilot, for commands without packets.
    pub fn autopilot_mut(&mut self) -> &mut SimulatedAutopilot {
        &mut self.autopilot
    }

    fn step(&mut self) {
        self.steps += 1;
        let now_s = self.now_s();
        let before = self.vehicle.truth();
        if before.height_m >= self.config.begin_height_m {
            self.begin();
        }
        let height_m = self.config.vehicle.start.z() - before.position.z();
        self.air = self.wind.step(STEP_S, height_m, self.since_begin_s(now_s));
        let below = self.below(now_s, before.position);
        self.vehicle.step_over(STEP_S, self.air, &self.demand, below);
        let truth = VehicleTruth { time_s: now_s, ..self.vehicle.truth() };
        self.demand = self.autopilot.step(now_s, &truth);
        if self.past.len() >= MAX_PAST {
            self.past.pop_front();
        }
        self.past.push_back(truth);
    }

    /// The support of a vehicle at this place: the deck about the pad, or the ground.
    fn below(&self, now_s: f64, position: Point<Ned>) -> Support {
        let pad = self.pad_at(now_s);
        let from_pad = position - pad.position;
        if from_pad.horizontal_norm() > self.config.pad.deck_m {
            return Support::ground(self.config.vehicle.start.z());
        }
        // The deck turns about the pad's middle.
        let turning = Vector::new(-from_pad.y(), from_pad.x(), 0.0) * pad.turn_rad_s;
        Support {
            z_m: pad.position.z(),
            velocity: pad.velocity + turning,
            turn_rad_s: pad.turn_rad_s,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scenario_begins_with_the_first_step_of_a_vehicle_that_starts_above_its_height() {
        for (start_height_m, has_begun) in [(10.0, true), (8.0, false), (0.0, false)] {
            let vehicle = VehicleConfig { start_height_m, ..VehicleConfig::default() };
            let config = WorldConfig { vehicle, begin_height_m: 9.0, ..WorldConfig::default() };
            let mut world = World::new(&config, 1);
            assert_eq!(world.since_begin_s(world.now_s()), None, "before the first step");
            world.advance_to(world.now_s() + 1.0);
            let since_s = world.since_begin_s(world.now_s());
            assert_eq!(
                since_s.is_some_and(|s| s > 0.9),
                has_begun,
                "{start_height_m} m: {since_s:?}"
            );
        }
    }
}
