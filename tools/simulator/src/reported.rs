//! A vehicle flown by a real autopilot: its true motion from what the autopilot reports.
//!
//! ArduPilot in simulation tells the truth in SIM_STATE, PX4 in HIL_STATE_QUATERNION, both with the position in steps of
//! about a centimetre and the velocity exactly or nearly so; the two together give a smooth motion. Any other autopilot's
//! own estimate has to do.

use std::collections::VecDeque;

use autopilot::Frame;
use autopilot::dialect::{
    ATTITUDE_DATA, HIL_STATE_QUATERNION_DATA, LOCAL_POSITION_NED_DATA, MavMessage, SIM_STATE_DATA,
};
use geometry::{Body, Ned, Point, Rotation, Vector};

use world::vehicle::VehicleTruth;

/// The past that is kept: a second at 200 Hz.
const MOST_PAST: usize = 200;
/// A degree of latitude in metres (mean radius of the earth, 6371 km), per 1e-7 degree.
const M_PER_E7: f64 = 6_371_000.0 * std::f64::consts::PI / 180.0 * 1e-7;
/// Part of the difference between the told and the predicted position that is taken over at each report.
const CORRECTION: f64 = 0.05;
/// A larger difference is a jump, in metres.
const JUMP_M: f64 = 0.5;
/// Motion is predicted at most so far, in seconds.
const LONGEST_PREDICTION_S: f64 = 0.2;
/// Without the truth for so long the autopilot's own estimate is used, in seconds.
const TRUTH_PATIENCE_S: f64 = 1.0;
/// Who is heard for the first time higher than this over the autopilot's origin has started elsewhere, in metres.
const STARTED_BELOW_M: f64 = 1.0;
/// Over the ground by less than this and slower than that is on it, in metres and m/s.
const ON_GROUND: (f64, f64) = (0.03, 0.05);

/// The vehicle that an autopilot reports.
#[derive(Debug, Default)]
pub struct Reported {
    /// Latitude and longitude in 1e-7 degrees, and altitude in metres, where it was heard first; the autopilot's origin
    /// if that was in the air.
    home: Option<(i32, i32, f64)>,
    /// True once `home` was compared with the autopilot's own origin.
    is_settled: bool,
    past: VecDeque<VehicleTruth>,
    /// When the simulation's truth was told last.
    told_s: Option<f64>,
    attitude: Option<(Rotation<Ned, Body>, Vector<Body>)>,
    fastest_fall: VecDeque<(f64, f64)>,
}

impl Reported {
    /// Takes a packet that arrived at `now_s`.
    pub fn handle(&mut self, now_s: f64, frame: &Frame) {
        if frame.sender.component != 1 {
            return;
        }
        match &frame.message {
            Some(MavMessage::SIM_STATE(state)) => self.sim_state(now_s, state),
            Some(MavMessage::HIL_STATE_QUATERNION(state)) => self.hil_state(now_s, state),
            Some(MavMessage::ATTITUDE(attitude)) => self.attitude(attitude),
            Some(MavMessage::LOCAL_POSITION_NED(position)) => self.local(now_s, position),
            _ => {}
        }
    }

    /// True once the autopilot tells where the vehicle is.
    pub fn is_known(&self) -> bool {
        !self.past.is_empty()
    }

    /// True while the simulation's truth is told, not only the autopilot's estimate.
    pub fn is_true(&self, now_s: f64) -> bool {
        self.told_s.is_some_and(|told| now_s - told < TRUTH_PATIENCE_S)
    }

    /// The latest motion.
    pub fn truth(&self) -> Option<VehicleTruth> {
        self.past.back().copied()
    }

    /// The motion at `time_s`, between reports or a little beyond the latest.
    pub fn truth_at(&self, time_s: f64) -> Option<VehicleTruth> {
        let after = self.past.partition_point(|truth| truth.time_s <= time_s);
        let before = after.checked_sub(1).and_then(|index| self.past.get(index));
        match (before, self.past.get(after)) {
            (Some(before), Some(next)) => Some(before.interpolate(next, time_s)),
            (Some(last), None) => Some(predicted(last, time_s)),
            (None, first) => first.copied(),
        }
    }

    fn sim_state(&mut self, now_s: f64, state: &SIM_STATE_DATA) {
        let numbers = [state.roll, state.pitch, state.yaw, state.alt, state.vn, state.ve, state.vd];
        let rates = [state.xgyro, state.ygyro, state.zgyro];
        if !numbers.iter().chain(&rates).all(|n| n.is_finite()) {
            return;
        }
        let here = (state.lat_int, state.lon_int, f64::from(state.alt));
        let velocity = Vector::new(f64::from(state.vn), f64::from(state.ve), f64::from(state.vd));
        let [roll, pitch, yaw] = [state.roll, state.pitch, state.yaw].map(f64::from);
        let [p, q, r] = rates.map(f64::from);
        let attitude = (Rotation::from_euler(roll, pitch, yaw), Vector::new(p, q, r));
        self.told(now_s, here, velocity, attitude);
    }

    fn hil_state(&mut self, now_s: f64, state: &HIL_STATE_QUATERNION_DATA) {
        let wxyz = state.attitude_quaternion.map(f64::from);
        let rates = [state.rollspeed, state.pitchspeed, state.yawspeed].map(f64::from);
        let Some(attitude) = Rotation::from_wxyz(wxyz) else { return };
        if !rates.iter().all(|n| n.is_finite()) {
            return;
        }
        let here = (state.lat, state.lon, f64::from(state.alt) * 1e-3);
        let [north, east, down] = [state.vx, state.vy, state.vz].map(|n| f64::from(n) * 0.01);
        let [p, q, r] = rates;
        let velocity = Vector::new(north, east, down);
        self.told(now_s, here, velocity, (attitude, Vector::new(p, q, r)));
    }

    /// Joins a coarse position with the velocity.
    fn told(
        &mut self,
        now_s: f64,
        here: (i32, i32, f64),
        velocity: Vector<Ned>,
        attitude: (Rotation<Ned, Body>, Vector<Body>),
    ) {
        let airborne = self.past.back().filter(|last| last.height_m > STARTED_BELOW_M);
        let origin = || airborne.map_or(here, |last| origin_of(here, last.position));
        let home = *self.home.get_or_insert_with(origin);
        let (lat_e7, lon_e7, altitude_m) = here;
        let told = position_from(home, lat_e7, lon_e7, altitude_m);
        let position = match self.past.back() {
            Some(last) => {
                let dt_s = (now_s - last.time_s).clamp(0.0, LONGEST_PREDICTION_S);
                let expected = last.position + (last.velocity + velocity) * (0.5 * dt_s);
                let difference = told - expected;
                if difference.norm() > JUMP_M { told } else { expected + difference * CORRECTION }
            }
            None => told,
        };
        self.told_s = Some(now_s);
        self.push(now_s, position, velocity, attitude);
    }

    fn attitude(&mut self, message: &ATTITUDE_DATA) {
        let angles = [message.roll, message.pitch, message.yaw].map(f64::from);
        let rates = [message.rollspeed, message.pitchspeed, message.yawspeed].map(f64::from);
        if angles.iter().chain(&rates).all(|n| n.is_finite()) {
            let [roll, pitch, yaw] = angles;
            let [p, q, r] = rates;
            self.attitude = Some((Rotation::from_euler(roll, pitch, yaw), Vector::new(p, q, r)));
        }
    }

    fn local(&mut self, now_s: f64, message: &LOCAL_POSITION_NED_DATA) {
        let [x, y, z] = [message.x, message.y, message.z].map(f64::from);
        let [vx, vy, vz] = [message.vx, message.vy, message.vz].map(f64::from);
        let (position, velocity) = (Point::new(x, y, z), Vector::new(vx, vy, vz));
        if self.is_true(now_s) {
            self.settle(position);
            return;
        }
        if let Some(attitude) = self.attitude
            && position.is_finite()
            && velocity.is_finite()
        {
            self.push(now_s, position, velocity, attitude);
        }
    }

    /// Moves the home to the autopilot's origin when it was taken from a vehicle in the air.
    fn settle(&mut self, position: Point<Ned>) {
        if std::mem::replace(&mut self.is_settled, true) || !position.is_finite() {
            return;
        }
        let is_airborne = -position.z() > STARTED_BELOW_M;
        if let (Some(home), Some(last), true) = (self.home, self.past.back(), is_airborne) {
            self.home = Some(origin_of(home, Point::origin() + (position - last.position)));
            self.past.clear();
        }
    }

    fn push(
        &mut self,
        now_s: f64,
        position: Point<Ned>,
        velocity: Vector<Ned>,
        (ned_from_body, angular_rate): (Rotation<Ned, Body>, Vector<Body>),
    ) {
        let last = self.past.back().copied();
        if last.is_some_and(|last| now_s <= last.time_s) {
            return;
        }
        let dt_s = last.map_or(f64::INFINITY, |last| now_s - last.time_s);
        let before = last.map_or(velocity, |last| last.velocity);
        let height_m = -position.z();
        self.fastest_fall.push_back((now_s, velocity.z()));
        while self.fastest_fall.front().is_some_and(|(time_s, _)| now_s - time_s > 0.3) {
            self.fastest_fall.pop_front();
        }
        let on_ground = height_m < ON_GROUND.0 && velocity.z().abs() < ON_GROUND.1;
        let impact = self.fastest_fall.iter().map(|(_, fall)| *fall).fold(0.0, f64::max);
        self.past.push_back(VehicleTruth {
            time_s: now_s,
            position,
            velocity,
            acceleration: (velocity - before) * (1.0 / dt_s),
            ned_from_body,
            angular_rate,
            on_ground,
            height_m,
            impact_m_s: on_ground.then_some(impact),
        });
        if self.past.len() > MOST_PAST {
            self.past.pop_front();
        }
    }
}

/// The place from which another one, `here`, lies at `position`.
fn origin_of(here: (i32, i32, f64), position: Point<Ned>) -> (i32, i32, f64) {
    let (lat, lon, altitude_m) = here;
    let shrink = (f64::from(lat) * 1e-7).to_radians().cos();
    let north_e7 = (position.x() / M_PER_E7).round() as i32;
    let east_e7 = (position.y() / (M_PER_E7 * shrink)).round() as i32;
    (lat.saturating_sub(north_e7), lon.saturating_sub(east_e7), altitude_m + position.z())
}

fn position_from(home: (i32, i32, f64), lat_e7: i32, lon_e7: i32, altitude_m: f64) -> Point<Ned> {
    let (home_lat, home_lon, home_altitude_m) = home;
    let north_m = (f64::from(lat_e7) - f64::from(home_lat)) * M_PER_E7;
    let shrink = (f64::from(home_lat) * 1e-7).to_radians().cos();
    let east_m = (f64::from(lon_e7) - f64::from(home_lon)) * M_PER_E7 * shrink;
    Point::new(north_m, east_m, home_altitude_m - altitude_m)
}

fn predicted(last: &VehicleTruth, time_s: f64) -> VehicleTruth {
    let dt_s = (time_s - last.time_s).clamp(0.0, LONGEST_PREDICTION_S);
    VehicleTruth {
        time_s,
        position: last.position + last.velocity * dt_s,
        ned_from_body: last.ned_from_body
            * Rotation::from_rotation_vector(last.angular_rate * dt_s),
        ..*last
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Sender;

    fn frame(message: MavMessage) -> Frame {
        let sender = Sender { system: 1, component: 1 };
        let mut parser = autopilot::Parser::new();
        let mut frames = parser.push(&autopilot::frame::encode(sender, 0, &message));
        frames.extend(parser.finish());
        frames.remove(0)
    }

    fn sim_state(north_e7: i32, altitude_m: f32, velocity: [f32; 3]) -> Frame {
        let [vn, ve, vd] = velocity;
        frame(MavMessage::SIM_STATE(SIM_STATE_DATA {
            lat_int: -353_632_620 + north_e7,
            lon_int: 1_491_652_370,
            alt: altitude_m,
            vn,
            ve,
            vd,
            ..SIM_STATE_DATA::default()
        }))
    }

    #[test]
    fn a_simulated_px4_tells_the_truth_too() {
        let state = |north_e7: i32| {
            frame(MavMessage::HIL_STATE_QUATERNION(HIL_STATE_QUATERNION_DATA {
                attitude_quaternion: [0.0, 0.0, 0.0, 1.0],
                lat: 473_977_420 + north_e7,
                lon: 85_455_940,
                alt: 488_000 + north_e7 * 10,
                vx: 100,
                vz: -50,
                ..Default::default()
            }))
        };
        let mut reported = Reported::default();
        // 1 m/s northwards and 0.5 m/s up.
        for tick in 0..400 {
            let seconds = f64::from(tick) * 0.01;
            reported.handle(seconds, &state((seconds / M_PER_E7) as i32));
        }
        let truth = reported.truth().unwrap();
        assert!(reported.is_true(4.0));
        assert!((truth.position.x() - 3.99).abs() < 0.03, "{:?}", truth.position);
        let east = truth.ned_from_body * Vector::<Body>::new(0.0, 1.0, 0.0);
        assert!((east.y() + 1.0).abs() < 1e-6 && (truth.velocity.z() + 0.5).abs() < 1e-9);
    }

    #[test]
    fn whoever_is_heard_in_the_air_first_has_started_at_the_autopilots_origin() {
        let attitude = || frame(MavMessage::ATTITUDE(ATTITUDE_DATA::default()));
        let local = |x: f32, z: f32| {
            frame(MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                x,
                z,
                ..LOCAL_POSITION_NED_DATA::default()
            }))
        };
        let told = sim_state(0, 590.0, [0.0; 3]);
        for order in [
            [attitude(), local(3.0, -6.0), told.clone()],
            [told.clone(), attitude(), local(3.0, -6.0)],
        ] {
            let mut reported = Reported::default();
            for (i, packet) in order.iter().chain([&told]).enumerate() {
                reported.handle(i as f64 * 0.02, packet);
            }
            let truth = reported.truth().unwrap();
            assert!(reported.is_true(0.1), "told by SIM_STATE");
            assert!((truth.position.x() - 3.0).abs() < 0.02 && (truth.height_m - 6.0).abs() < 0.02);
        }
    }

    #[test]
    fn positions_in_centimetres_become_a_smooth_motion() {
        let mut reported = Reported::default();
        let mut worst_m: f64 = 0.0;
        for i in 0..200 {
            let time_s = f64::from(i) * 0.02;
            // 0.5 m/s northwards; the grid of SIM_STATE is 1e-7 degrees.
            let grid = (0.5 * time_s / M_PER_E7) as i32;
            reported.handle(time_s, &sim_state(grid, 594.0, [0.5, 0.0, 0.0]));
            let truth = reported.truth().unwrap();
            if time_s > 1.0 {
                worst_m = worst_m.max((truth.position.x() - 0.5 * time_s).abs());
            }
        }
        assert!(worst_m < 0.012, "{worst_m} m off");
        let ahead = reported.truth_at(3.98 + 0.05).unwrap().position.x();
        assert!((ahead - 0.5 * 4.03).abs() < 0.013);
    }

    #[test]
    fn the_ground_is_where_it_was_first_heard_and_the_impact_is_remembered() {
        let mut reported = Reported::default();
        reported.handle(0.0, &sim_state(0, 584.09, [0.0; 3]));
        assert!(reported.truth().unwrap().on_ground);
        reported.handle(0.1, &sim_state(0, 586.09, [0.0, 0.0, 0.5]));
        let flying = reported.truth().unwrap();
        assert!(!flying.on_ground && (flying.height_m - 2.0).abs() < 1e-3);
        for i in 0..60 {
            let fallen_s = f64::from(i) * 0.02;
            let height_m = (0.24 - 0.48 * fallen_s).max(0.0);
            let fall = if height_m > 0.0 { 0.48 } else { 0.0 };
            reported
                .handle(10.0 + fallen_s, &sim_state(0, 584.09 + height_m as f32, [0.0, 0.0, fall]));
            if reported.truth().unwrap().on_ground {
                break;
            }
        }
        let landed = reported.truth().unwrap();
        assert!(landed.on_ground && (landed.impact_m_s.unwrap() - 0.48).abs() < 1e-6);
    }

    #[test]
    fn without_a_simulation_the_autopilots_estimate_is_used() {
        let mut reported = Reported::default();
        let position = LOCAL_POSITION_NED_DATA { x: 1.0, y: 2.0, z: -3.0, ..Default::default() };
        reported.handle(0.0, &frame(MavMessage::LOCAL_POSITION_NED(position.clone())));
        assert!(!reported.is_known(), "no attitude yet");
        reported.handle(0.01, &frame(MavMessage::ATTITUDE(ATTITUDE_DATA::default())));
        reported.handle(0.02, &frame(MavMessage::LOCAL_POSITION_NED(position)));
        assert!((reported.truth().unwrap().height_m - 3.0).abs() < 1e-6 && !reported.is_true(0.02));
    }
}
