//! Vehicle, wind and autopilot together, in steps of one fixed length.

use std::collections::VecDeque;

use autopilot::Frame;
use geometry::{Ned, Vector};

use crate::ardupilot::{AutopilotConfig, SimulatedAutopilot};
use crate::vehicle::{Demand, Vehicle, VehicleConfig, VehicleTruth};
use crate::wind::{Wind, WindConfig};

/// Length of a step, in seconds: the rate of ArduPilot's main loop.
pub const STEP_S: f64 = 1.0 / 400.0;

/// What is in the world.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WorldConfig {
    /// The vehicle.
    pub vehicle: VehicleConfig,
    /// The wind.
    pub wind: WindConfig,
    /// The autopilot.
    pub autopilot: AutopilotConfig,
}

/// How long the past is kept for cameras with a long exposure, in steps: one second.
const MOST_PAST: usize = 400;

/// Vehicle, wind and autopilot. The same seed and the same packets at the same times give the same flight.
#[derive(Clone, Debug)]
pub struct World {
    vehicle: Vehicle,
    wind: Wind,
    autopilot: SimulatedAutopilot,
    demand: Demand,
    air: Vector<Ned>,
    steps: u64,
    past: VecDeque<VehicleTruth>,
}

impl World {
    /// A world at time 0, the vehicle on the ground.
    pub fn new(config: &WorldConfig, seed: u64) -> Self {
        let vehicle = Vehicle::new(config.vehicle.clone(), seed);
        let past = VecDeque::from([vehicle.truth()]);
        Self {
            vehicle,
            wind: Wind::new(config.wind.clone(), seed),
            autopilot: SimulatedAutopilot::new(config.autopilot.clone(), seed),
            demand: Demand::IDLE,
            air: Vector::zero(),
            steps: 0,
            past,
        }
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
    pub fn handle(&mut self, frame: &Frame) {
        let now_s = self.now_s();
        self.autopilot.handle(now_s, frame);
    }

    /// Packets from the autopilot.
    pub fn outgoing(&mut self) -> impl Iterator<Item = Vec<u8>> + '_ {
        self.autopilot.outgoing()
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

    fn step(&mut self) {
        self.steps += 1;
        let now_s = self.now_s();
        self.air = self.wind.step(STEP_S, self.vehicle.truth().height_m);
        self.vehicle.step(STEP_S, self.air, &self.demand);
        let truth = VehicleTruth { time_s: now_s, ..self.vehicle.truth() };
        self.demand = self.autopilot.step(now_s, &truth);
        if self.past.len() >= MOST_PAST {
            self.past.pop_front();
        }
        self.past.push_back(truth);
    }
}
