//! Follows a vehicle flown by a real autopilot: its motion from the autopilot's messages.
//!
//! A simulated ArduPilot sends the truth in SIM_STATE, a simulated PX4 in HIL_STATE_QUATERNION, with the
//! position in steps of about a centimetre and an accurate velocity; combined they give a smooth motion. Of
//! other autopilots, and of an ArduPilot whose SIM_STATE lacks that position, the estimate is used.

use std::collections::VecDeque;

use autopilot::Packet;
use autopilot::dialect::{
    ATTITUDE_DATA, HIL_STATE_QUATERNION_DATA, LOCAL_POSITION_NED_DATA, MavMessage, SIM_STATE_DATA,
};
use geometry::{Body, Ned, Point, Rotation, Vector};

use world::vehicle::VehicleTruth;

/// Maximum number of states in the history: a second at 200 Hz.
const MAX_HISTORY: usize = 200;
/// A degree of latitude in metres (mean radius of the earth, 6371 km), per 1e-7 degree.
const M_PER_E7: f64 = 6_371_000.0 * std::f64::consts::PI / 180.0 * 1e-7;
/// Gain of the position correction at each report.
const POSITION_GAIN: f64 = 0.05;
/// Difference between reported and predicted position above which it is a jump, in metres.
const JUMP_M: f64 = 0.5;
/// Maximum prediction time, in seconds.
const MAX_PREDICTION_S: f64 = 0.2;
/// Time without the truth after which the autopilot's estimate is used, in seconds.
const TRUTH_TIMEOUT_S: f64 = 1.0;
/// Height above the autopilot's origin from which a vehicle was already airborne when first reported, in
/// metres.
const AIRBORNE_M: f64 = 1.0;
/// Maximum height of a vehicle on the ground, in metres.
const MAX_GROUND_HEIGHT_M: f64 = 0.03;
/// Maximum vertical speed of a vehicle on the ground, in m/s.
const MAX_GROUND_SPEED_M_S: f64 = 0.05;
/// Time over which the maximum speed of descent is the speed of impact, in seconds.
const IMPACT_WINDOW_S: f64 = 0.3;

/// A global position.
#[derive(Copy, Clone, Debug)]
struct GlobalPosition {
    lat_e7: i32,
    lon_e7: i32,
    altitude_m: f64,
}

#[derive(Copy, Clone, Debug)]
struct Attitude {
    ned_from_body: Rotation<Ned, Body>,
    angular_rate: Vector<Body>,
}

/// The vehicle that an autopilot reports.
#[derive(Debug, Default)]
pub struct ReportedVehicle {
    /// Where it was first reported; the autopilot's origin if that was in the air.
    home: Option<GlobalPosition>,
    /// True once `home` was compared with the autopilot's own origin.
    is_settled: bool,
    history: VecDeque<VehicleTruth>,
    /// Time of the last message with the truth.
    last_truth_s: Option<f64>,
    attitude: Option<Attitude>,
    /// Times and speeds of descent in the last [`IMPACT_WINDOW_S`].
    descent: VecDeque<(f64, f64)>,
}

impl ReportedVehicle {
    /// Handles a packet that arrived at `now_s`.
    pub fn handle(&mut self, now_s: f64, packet: &Packet) {
        if packet.sender.component != 1 {
            return;
        }
        match &packet.message {
            Some(MavMessage::SIM_STATE(state)) => self.sim_state(now_s, state),
            Some(MavMessage::HIL_STATE_QUATERNION(state)) => self.hil_state(now_s, state),
            Some(MavMessage::ATTITUDE(attitude)) => self.attitude(attitude),
            Some(MavMessage::LOCAL_POSITION_NED(position)) => self.local(now_s, position),
            _ => {}
        }
    }

    /// True once the autopilot has reported the vehicle's state.
    pub fn is_known(&self) -> bool {
        !self.history.is_empty()
    }

    /// True while the truth arrives, and not only the autopilot's estimate.
    pub fn is_true(&self, now_s: f64) -> bool {
        self.last_truth_s.is_some_and(|last_s| now_s - last_s < TRUTH_TIMEOUT_S)
    }

    /// The latest state.
    pub fn truth(&self) -> Option<VehicleTruth> {
        self.history.back().copied()
    }

    /// The state at `time_s`, interpolated, or predicted a little beyond the latest.
    pub fn truth_at(&self, time_s: f64) -> Option<VehicleTruth> {
        let after = self.history.partition_point(|truth| truth.time_s <= time_s);
        let before = after.checked_sub(1).and_then(|index| self.history.get(index));
        match (before, self.history.get(after)) {
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
        // Both are extension fields, which older autopilots leave out; the others give the position to half a metre only.
        if state.lat_int == 0 && state.lon_int == 0 {
            return;
        }
        let here = GlobalPosition {
            lat_e7: state.lat_int,
            lon_e7: state.lon_int,
            altitude_m: f64::from(state.alt),
        };
        let velocity = Vector::new(f64::from(state.vn), f64::from(state.ve), f64::from(state.vd));
        let [roll, pitch, yaw] = [state.roll, state.pitch, state.yaw].map(f64::from);
        let [p, q, r] = rates.map(f64::from);
        let ned_from_body = Rotation::from_euler(roll, pitch, yaw);
        let attitude = Attitude { ned_from_body, angular_rate: Vector::new(p, q, r) };
        self.update(now_s, here, velocity, attitude);
    }

    fn hil_state(&mut self, now_s: f64, state: &HIL_STATE_QUATERNION_DATA) {
        let wxyz = state.attitude_quaternion.map(f64::from);
        let rates = [state.rollspeed, state.pitchspeed, state.yawspeed].map(f64::from);
        let Some(ned_from_body) = Rotation::from_wxyz(wxyz) else { return };
        if !rates.iter().all(|n| n.is_finite()) {
            return;
        }
        let altitude_m = f64::from(state.alt) * 1e-3;
        let here = GlobalPosition { lat_e7: state.lat, lon_e7: state.lon, altitude_m };
        let [north, east, down] = [state.vx, state.vy, state.vz].map(|n| f64::from(n) * 0.01);
        let [p, q, r] = rates;
        let velocity = Vector::new(north, east, down);
        let attitude = Attitude { ned_from_body, angular_rate: Vector::new(p, q, r) };
        self.update(now_s, here, velocity, attitude);
    }

    /// Updates the state from the truth: the coarse position corrects the integrated velocity.
    fn update(
        &mut self,
        now_s: f64,
        here: GlobalPosition,
        velocity: Vector<Ned>,
        attitude: Attitude,
    ) {
        let airborne = self.history.back().filter(|last| last.height_m > AIRBORNE_M);
        let origin = || airborne.map_or(here, |last| origin_of(here, last.position));
        let home = *self.home.get_or_insert_with(origin);
        let reported = position_from(home, here);
        let position = match self.history.back() {
            Some(last) => {
                let dt_s = (now_s - last.time_s).clamp(0.0, MAX_PREDICTION_S);
                let predicted = last.position + (last.velocity + velocity) * (0.5 * dt_s);
                let difference = reported - predicted;
                if difference.norm() > JUMP_M {
                    reported
                } else {
                    predicted + difference * POSITION_GAIN
                }
            }
            None => reported,
        };
        self.last_truth_s = Some(now_s);
        self.push(now_s, position, velocity, attitude);
    }

    fn attitude(&mut self, message: &ATTITUDE_DATA) {
        let angles = [message.roll, message.pitch, message.yaw].map(f64::from);
        let rates = [message.rollspeed, message.pitchspeed, message.yawspeed].map(f64::from);
        if angles.iter().chain(&rates).all(|n| n.is_finite()) {
            let [roll, pitch, yaw] = angles;
            let [p, q, r] = rates;
            self.attitude = Some(Attitude {
                ned_from_body: Rotation::from_euler(roll, pitch, yaw),
                angular_rate: Vector::new(p, q, r),
            });
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

    /// Moves the home to the autopilot's origin if the vehicle was first reported in the air.
    fn settle(&mut self, position: Point<Ned>) {
        if std::mem::replace(&mut self.is_settled, true) || !position.is_finite() {
            return;
        }
        let is_airborne = -position.z() > AIRBORNE_M;
        if let (Some(home), Some(last), true) = (self.home, self.history.back(), is_airborne) {
            self.home = Some(origin_of(home, Point::origin() + (position - last.position)));
            self.history.clear();
        }
    }

    fn push(
        &mut self,
        now_s: f64,
        position: Point<Ned>,
        velocity: Vector<Ned>,
        Attitude { ned_from_body, angular_rate }: Attitude,
    ) {
        let last = self.history.back().copied();
        if last.is_some_and(|last| now_s <= last.time_s) {
            return;
        }
        let dt_s = last.map_or(f64::INFINITY, |last| now_s - last.time_s);
        let before = last.map_or(velocity, |last| last.velocity);
        let height_m = -position.z();
        self.descent.push_back((now_s, velocity.z()));
        while self.descent.front().is_some_and(|(time_s, _)| now_s - time_s > IMPACT_WINDOW_S) {
            self.descent.pop_front();
        }
        let on_ground = height_m < MAX_GROUND_HEIGHT_M && velocity.z().abs() < MAX_GROUND_SPEED_M_S;
        let impact = self.descent.iter().map(|(_, speed)| *speed).fold(0.0, f64::max);
        self.history.push_back(VehicleTruth {
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
        if self.history.len() > MAX_HISTORY {
            self.history.pop_front();
        }
    }
}

/// The origin of the local frame in which `here` has the coordinates `position`.
fn origin_of(here: GlobalPosition, position: Point<Ned>) -> GlobalPosition {
    let north_e7 = (position.x() / M_PER_E7).round() as i32;
    let east_e7 = (position.y() / (M_PER_E7 * here.cos_latitude())).round() as i32;
    GlobalPosition {
        lat_e7: here.lat_e7.saturating_sub(north_e7),
        lon_e7: here.lon_e7.saturating_sub(east_e7),
        altitude_m: here.altitude_m + position.z(),
    }
}

/// The coordinates of `here` in the local frame at `home`.
fn position_from(home: GlobalPosition, here: GlobalPosition) -> Point<Ned> {
    let north_m = (f64::from(here.lat_e7) - f64::from(home.lat_e7)) * M_PER_E7;
    let east_m = (f64::from(here.lon_e7) - f64::from(home.lon_e7)) * M_PER_E7 * home.cos_latitude();
    Point::new(north_m, east_m, home.altitude_m - here.altitude_m)
}

impl GlobalPosition {
    fn cos_latitude(self) -> f64 {
        (f64::from(self.lat_e7) * 1e-7).to_radians().cos()
    }
}

fn predicted(last: &VehicleTruth, time_s: f64) -> VehicleTruth {
    let dt_s = (time_s - last.time_s).clamp(0.0, MAX_PREDICTION_S);
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

    fn packet(message: MavMessage) -> Packet {
        let sender = Sender { system: 1, component: 1 };
        let mut parser = autopilot::Parser::new();
        let mut packets = parser.push(&autopilot::packet::encode(sender, 0, &message));
        packets.extend(parser.finish());
        packets.remove(0)
    }

    fn sim_state(north_e7: i32, altitude_m: f32, velocity: [f32; 3]) -> Packet {
        let [vn, ve, vd] = velocity;
        packet(MavMessage::SIM_STATE(SIM_STATE_DATA {
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
    fn the_truth_of_a_simulated_px4_is_used() {
        let state = |north_e7: i32| {
            packet(MavMessage::HIL_STATE_QUATERNION(HIL_STATE_QUATERNION_DATA {
                attitude_quaternion: [0.0, 0.0, 0.0, 1.0],
                lat: 473_977_420 + north_e7,
                lon: 85_455_940,
                alt: 488_000 + north_e7 * 10,
                vx: 100,
                vz: -50,
                ..Default::default()
            }))
        };
        let mut reported = ReportedVehicle::default();
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
    fn a_vehicle_first_reported_in_the_air_started_at_the_autopilots_origin() {
        let attitude = || packet(MavMessage::ATTITUDE(ATTITUDE_DATA::default()));
        let local = |x: f32, z: f32| {
            packet(MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
                x,
                z,
                ..LOCAL_POSITION_NED_DATA::default()
            }))
        };
        let truth_message = sim_state(0, 590.0, [0.0; 3]);
        for order in [
            [attitude(), local(3.0, -6.0), truth_message.clone()],
            [truth_message.clone(), attitude(), local(3.0, -6.0)],
        ] {
            let mut reported = ReportedVehicle::default();
            for (i, packet) in order.iter().chain([&truth_message]).enumerate() {
                reported.handle(i as f64 * 0.02, packet);
            }
            let truth = reported.truth().unwrap();
            assert!(reported.is_true(0.1), "from SIM_STATE");
            assert!((truth.position.x() - 3.0).abs() < 0.02 && (truth.height_m - 6.0).abs() < 0.02);
        }
    }

    #[test]
    fn positions_in_steps_of_a_centimetre_become_a_smooth_motion() {
        let mut reported = ReportedVehicle::default();
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
    fn the_ground_is_at_the_first_reported_height_and_the_impact_is_measured() {
        let mut reported = ReportedVehicle::default();
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
        let mut reported = ReportedVehicle::default();
        let position = LOCAL_POSITION_NED_DATA { x: 1.0, y: 2.0, z: -3.0, ..Default::default() };
        reported.handle(0.0, &packet(MavMessage::LOCAL_POSITION_NED(position.clone())));
        assert!(!reported.is_known(), "no attitude yet");
        reported.handle(0.01, &packet(MavMessage::ATTITUDE(ATTITUDE_DATA::default())));
        reported.handle(0.02, &packet(MavMessage::LOCAL_POSITION_NED(position)));
        assert!((reported.truth().unwrap().height_m - 3.0).abs() < 1e-6 && !reported.is_true(0.02));
    }

    #[test]
    fn a_truth_without_its_accurate_position_is_none() {
        let mut reported = ReportedVehicle::default();
        for tick in 0..50 {
            let time_s = f64::from(tick) * 0.02;
            let coarse = SIM_STATE_DATA { lat: -35.36, lon: 149.16, ..Default::default() };
            reported.handle(time_s, &packet(MavMessage::SIM_STATE(coarse)));
            reported.handle(time_s, &packet(MavMessage::ATTITUDE(ATTITUDE_DATA::default())));
            let local =
                LOCAL_POSITION_NED_DATA { x: tick as f32 * 0.02, vx: 1.0, ..Default::default() };
            reported.handle(time_s, &packet(MavMessage::LOCAL_POSITION_NED(local)));
        }
        assert!(!reported.is_true(0.98));
        assert!((reported.truth().unwrap().position.x() - 0.98).abs() < 1e-6);
    }
}
