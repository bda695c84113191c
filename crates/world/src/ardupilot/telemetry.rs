//! Composes the simulated autopilot's MAVLink messages (attitude, positions, battery, estimator status, true state), each
//! composed when it is due at its requested interval.

use autopilot::dialect::{
    ATTITUDE_DATA, ATTITUDE_QUATERNION_DATA, AUTOPILOT_VERSION_DATA, BATTERY_STATUS_DATA,
    DISTANCE_SENSOR_DATA, EKF_STATUS_REPORT_DATA, EXTENDED_SYS_STATE_DATA, EkfStatusFlags,
    GLOBAL_POSITION_INT_DATA, GPS_GLOBAL_ORIGIN_DATA, GPS_RAW_INT_DATA, GpsFixType, HEARTBEAT_DATA,
    HIL_STATE_QUATERNION_DATA, HOME_POSITION_DATA, LOCAL_POSITION_NED_DATA, MavAutopilot,
    MavDistanceSensor, MavFrame, MavLandedState, MavMessage, MavModeFlag, MavSensorOrientation,
    MavState, MavSysStatusSensor, MavType, MavVtolState, POSITION_TARGET_LOCAL_NED_DATA,
    PositionTargetTypemask, RANGEFINDER_DATA, SIM_STATE_DATA, SIMSTATE_DATA, SYS_STATUS_DATA,
    SYSTEM_TIME_DATA, VFR_HUD_DATA,
};
use geometry::{Body, Ned, Vector};

use super::estimate::Estimate;
use super::flight::{Landed, Mode};
use super::px4::{CURRENT_MODE, Reported};
use crate::vehicle::{GRAVITY_M_S2, VehicleTruth};

/// Message numbers that can be requested, by the stream of REQUEST_DATA_STREAM they belong to (0: none).
const MESSAGES: [(u32, u8); 21] = [
    (1, 2),
    (2, 12),
    (24, 2),
    (30, 10),
    (31, 0),
    (32, 6),
    (33, 6),
    (49, 0),
    (74, 11),
    (85, 2),
    (108, 0),
    (115, 0),
    (132, 12),
    (147, 12),
    (164, 10),
    (173, 12),
    (193, 12),
    (230, 0),
    (242, 0),
    (245, 0),
    (CURRENT_MODE, 0),
];

/// When each message is due.
#[derive(Clone, Debug, Default)]
pub(super) struct Schedule {
    entries: Vec<Entry>,
}

#[derive(Copy, Clone, Debug)]
struct Entry {
    id: u32,
    interval_s: f64,
    due_s: f64,
}

/// Two steps of the simulation are the shortest interval.
const MIN_INTERVAL_S: f64 = 0.0025;

impl Schedule {
    /// Sends message `id` every `interval_s` from now on, never when `None`; false when there is no such
    /// message.
    pub(super) fn set(&mut self, now_s: f64, id: u32, interval_s: Option<f64>) -> bool {
        if !MESSAGES.iter().any(|(known, _)| *known == id) {
            return false;
        }
        self.entries.retain(|entry| entry.id != id);
        if let Some(interval_s) = interval_s.filter(|interval_s| interval_s.is_finite()) {
            self.entries.push(Entry {
                id,
                interval_s: interval_s.max(MIN_INTERVAL_S),
                due_s: now_s,
            });
        }
        true
    }

    /// True when message `id` is sent.
    pub(super) fn has(&self, id: u32) -> bool {
        self.entries.iter().any(|entry| entry.id == id)
    }

    /// Sets all messages of a stream (all streams when 0) to one rate.
    pub(super) fn set_stream(&mut self, now_s: f64, stream: u8, interval_s: Option<f64>) {
        for (id, of) in MESSAGES {
            if of != 0 && (stream == 0 || of == stream) {
                self.set(now_s, id, interval_s);
            }
        }
    }

    /// Messages that are due now; the next ones are due whole intervals later, so rates are exact.
    pub(super) fn due(&mut self, now_s: f64) -> Vec<u32> {
        let mut due = Vec::new();
        for entry in &mut self.entries {
            // Half a microsecond allows for the rounding of added intervals.
            if now_s + 5e-7 >= entry.due_s {
                due.push(entry.id);
                entry.due_s += entry.interval_s;
                if entry.due_s < now_s {
                    entry.due_s = now_s + entry.interval_s;
                }
            }
        }
        due
    }
}

/// Where the local origin is on the globe.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Origin {
    /// Degrees to the north.
    pub latitude_deg: f64,
    /// Degrees to the east.
    pub longitude_deg: f64,
    /// Metres over the sea.
    pub altitude_m: f64,
}

impl Default for Origin {
    /// The field at Canberra, the default position of ArduPilot's simulation.
    fn default() -> Self {
        Self { latitude_deg: -35.363_262_0, longitude_deg: 149.165_237_0, altitude_m: 584.09 }
    }
}

impl Origin {
    /// Latitude and longitude in 1e-7 degrees of a point in metres to the north and east.
    fn global(&self, north_m: f64, east_m: f64) -> (i32, i32) {
        // ArduPilot's metres per degree of latitude.
        const METRES_PER_DEGREE: f64 = 111_318.845;
        let latitude = self.latitude_deg + north_m / METRES_PER_DEGREE;
        let shrink = self.latitude_deg.to_radians().cos().max(0.01);
        let longitude = self.longitude_deg + east_m / (METRES_PER_DEGREE * shrink);
        ((latitude * 1e7).round() as i32, (longitude * 1e7).round() as i32)
    }
}

/// How far the start-up is.
#[derive(Copy, Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Readiness {
    Booting,
    Aligned,
    OriginSet,
    Ready,
}

/// The contents of all messages.
#[derive(Copy, Clone, Debug)]
pub(super) struct Telemetry<'a> {
    pub(super) now_s: f64,
    pub(super) estimate: &'a Estimate,
    pub(super) truth: &'a VehicleTruth,
    pub(super) origin: &'a Origin,
    pub(super) readiness: Readiness,
    pub(super) mode: Mode,
    pub(super) armed: bool,
    pub(super) landed: Landed,
    pub(super) target_velocity: Option<[f64; 3]>,
    pub(super) rangefinder: bool,
    pub(super) says_simulated: bool,
    /// The mode in PX4's terms, if it is one.
    pub(super) px4: Option<Reported>,
}

impl Telemetry<'_> {
    /// Whole milliseconds that have passed, as the autopilots count them. A step ends on a half one at least, so that a little
    /// more is no other one.
    fn time_boot_ms(&self) -> u32 {
        (self.now_s * 1000.0 + 1e-3).max(0.0) as u32
    }

    fn time_usec(&self) -> u64 {
        (self.now_s * 1e6) as u64
    }

    pub(super) fn heartbeat(&self) -> MavMessage {
        let mut base_mode = MavModeFlag::MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            | MavModeFlag::MAV_MODE_FLAG_STABILIZE_ENABLED
            | MavModeFlag::MAV_MODE_FLAG_MANUAL_INPUT_ENABLED;
        base_mode.set(MavModeFlag::MAV_MODE_FLAG_GUIDED_ENABLED, self.mode == Mode::Guided);
        base_mode.set(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED, self.armed);
        let flying = self.landed != Landed::OnGround;
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: self.px4.map_or(self.mode as u32, |it| it.mode.custom_mode()),
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: match self.px4 {
                Some(_) => MavAutopilot::MAV_AUTOPILOT_PX4,
                None => MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            },
            base_mode,
            system_status: match self.px4 {
                Some(px4) if self.armed && px4.is_failsafe => MavState::MAV_STATE_CRITICAL,
                _ if flying => MavState::MAV_STATE_ACTIVE,
                _ => MavState::MAV_STATE_STANDBY,
            },
            mavlink_version: 3,
        })
    }

    /// The message with this number; `None` when it is not available yet.
    pub(super) fn message(&self, id: u32) -> Option<MavMessage> {
        let message = match id {
            0 => self.heartbeat(),
            1 => self.sys_status(),
            2 => MavMessage::SYSTEM_TIME(SYSTEM_TIME_DATA {
                time_unix_usec: 0,
                time_boot_ms: self.time_boot_ms(),
            }),
            24 => self.gps_raw_int(),
            30 => self.attitude(),
            31 => self.attitude_quaternion(),
            32 if self.readiness >= Readiness::OriginSet => self.local_position_ned(),
            33 => self.global_position_int(),
            49 if self.readiness >= Readiness::OriginSet => self.gps_global_origin(),
            74 => self.vfr_hud(),
            85 => self.position_target_local_ned()?,
            108 if self.says_simulated && self.px4.is_none() => self.sim_state(),
            115 if self.says_simulated && self.px4.is_some() => self.hil_state_quaternion(),
            132 if self.rangefinder => self.distance_sensor(),
            147 => battery_status(),
            148 => autopilot_version(),
            164 if self.says_simulated && self.px4.is_none() => self.simstate(),
            173 if self.rangefinder => MavMessage::RANGEFINDER(RANGEFINDER_DATA {
                distance: self.range_m() as f32,
                voltage: 0.0,
            }),
            193 if self.px4.is_none() => self.ekf_status_report(),
            230 if self.px4.is_some() => {
                super::px4::estimator_status(self.readiness == Readiness::Ready)
            }
            242 if self.readiness >= Readiness::OriginSet => self.home_position(),
            245 => self.extended_sys_state(),
            CURRENT_MODE => super::px4::current_mode(self.px4?),
            _ => return None,
        };
        Some(message)
    }

    fn sys_status(&self) -> MavMessage {
        // As the real one reports its sensors; bit 28 of the health is the pre-arm check.
        let health = if self.readiness == Readiness::Ready { 1_467_063_599 } else { 1_198_628_143 };
        MavMessage::SYS_STATUS(SYS_STATUS_DATA {
            onboard_control_sensors_present: MavSysStatusSensor::from_bits_truncate(1_399_979_311),
            onboard_control_sensors_enabled: MavSysStatusSensor::from_bits_truncate(1_382_128_943),
            onboard_control_sensors_health: MavSysStatusSensor::from_bits_truncate(health),
            voltage_battery: 12_600,
            battery_remaining: 100,
            ..SYS_STATUS_DATA::default()
        })
    }

    fn gps_raw_int(&self) -> MavMessage {
        let fixed = self.readiness >= Readiness::OriginSet;
        let (lat, lon) = self.global();
        let [_, _, down] = self.estimate.position;
        MavMessage::GPS_RAW_INT(GPS_RAW_INT_DATA {
            time_usec: self.time_usec(),
            lat,
            lon,
            alt: millimetres(self.origin.altitude_m - down),
            eph: 121,
            epv: 200,
            vel: 0,
            cog: 0,
            fix_type: if fixed {
                GpsFixType::GPS_FIX_TYPE_RTK_FIXED
            } else {
                GpsFixType::GPS_FIX_TYPE_NO_FIX
            },
            satellites_visible: if fixed { 10 } else { 0 },
            ..GPS_RAW_INT_DATA::default()
        })
    }

    fn attitude(&self) -> MavMessage {
        let e = self.estimate;
        MavMessage::ATTITUDE(ATTITUDE_DATA {
            time_boot_ms: self.time_boot_ms(),
            roll: e.roll as f32,
            pitch: e.pitch as f32,
            yaw: e.yaw as f32,
            rollspeed: e.rates[0] as f32,
            pitchspeed: e.rates[1] as f32,
            yawspeed: e.rates[2] as f32,
        })
    }

    fn attitude_quaternion(&self) -> MavMessage {
        let e = self.estimate;
        let [w, x, y, z] =
            geometry::Rotation::<Ned, Body>::from_euler(e.roll, e.pitch, e.yaw).wxyz();
        MavMessage::ATTITUDE_QUATERNION(ATTITUDE_QUATERNION_DATA {
            time_boot_ms: self.time_boot_ms(),
            q1: w as f32,
            q2: x as f32,
            q3: y as f32,
            q4: z as f32,
            rollspeed: e.rates[0] as f32,
            pitchspeed: e.rates[1] as f32,
            yawspeed: e.rates[2] as f32,
            ..ATTITUDE_QUATERNION_DATA::default()
        })
    }

    fn local_position_ned(&self) -> MavMessage {
        let (p, v) = (self.estimate.position, self.estimate.velocity);
        MavMessage::LOCAL_POSITION_NED(LOCAL_POSITION_NED_DATA {
            time_boot_ms: self.time_boot_ms(),
            x: p[0] as f32,
            y: p[1] as f32,
            z: p[2] as f32,
            vx: v[0] as f32,
            vy: v[1] as f32,
            vz: v[2] as f32,
        })
    }

    fn global(&self) -> (i32, i32) {
        let [north, east, _] = self.estimate.position;
        self.origin.global(north, east)
    }

    fn global_position_int(&self) -> MavMessage {
        let (lat, lon) =
            if self.readiness >= Readiness::OriginSet { self.global() } else { (0, 0) };
        let [north, east, down] = self.estimate.velocity.map(|v| (v * 100.0).round() as i16);
        let height_m = -self.estimate.position[2];
        MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
            time_boot_ms: self.time_boot_ms(),
            lat,
            lon,
            alt: millimetres(self.origin.altitude_m + height_m),
            relative_alt: millimetres(height_m),
            vx: north,
            vy: east,
            vz: down,
            hdg: (self.heading_deg() * 100.0) as u16,
        })
    }

    fn heading_deg(&self) -> f64 {
        self.estimate.yaw.to_degrees().rem_euclid(360.0)
    }

    pub(super) fn gps_global_origin(&self) -> MavMessage {
        let (latitude, longitude) = self.origin.global(0.0, 0.0);
        let altitude = millimetres(self.origin.altitude_m);
        MavMessage::GPS_GLOBAL_ORIGIN(GPS_GLOBAL_ORIGIN_DATA {
            latitude,
            longitude,
            altitude,
            time_usec: self.time_usec(),
        })
    }

    pub(super) fn home_position(&self) -> MavMessage {
        let (latitude, longitude) = self.origin.global(0.0, 0.0);
        MavMessage::HOME_POSITION(HOME_POSITION_DATA {
            latitude,
            longitude,
            altitude: millimetres(self.origin.altitude_m),
            q: [f32::NAN; 4],
            time_usec: self.time_usec(),
            ..HOME_POSITION_DATA::default()
        })
    }

    fn vfr_hud(&self) -> MavMessage {
        let e = self.estimate;
        let speed = e.velocity[0].hypot(e.velocity[1]) as f32;
        MavMessage::VFR_HUD(VFR_HUD_DATA {
            airspeed: speed,
            groundspeed: speed,
            alt: (self.origin.altitude_m - e.position[2]) as f32,
            climb: -e.velocity[2] as f32,
            heading: self.heading_deg() as i16,
            throttle: if self.landed == Landed::OnGround { 0 } else { 34 },
        })
    }

    fn position_target_local_ned(&self) -> Option<MavMessage> {
        let [north, east, down] = self.target_velocity?;
        Some(MavMessage::POSITION_TARGET_LOCAL_NED(POSITION_TARGET_LOCAL_NED_DATA {
            time_boot_ms: self.time_boot_ms(),
            vx: north as f32,
            vy: east as f32,
            vz: down as f32,
            type_mask: PositionTargetTypemask::from_bits_truncate(0xDC7),
            coordinate_frame: MavFrame::MAV_FRAME_LOCAL_NED,
            ..POSITION_TARGET_LOCAL_NED_DATA::default()
        }))
    }

    /// Distance along the body's down axis to the ground, as a sensor of 40 m would measure it; 0 beyond.
    fn range_m(&self) -> f64 {
        let range = self.truth.height_m / self.truth.tilt_rad().cos().max(0.1);
        if range <= 40.0 { range.max(0.0) } else { 0.0 }
    }

    fn distance_sensor(&self) -> MavMessage {
        MavMessage::DISTANCE_SENSOR(DISTANCE_SENSOR_DATA {
            time_boot_ms: self.time_boot_ms(),
            min_distance: 5,
            max_distance: 4000,
            current_distance: (self.range_m() * 100.0).round() as u16,
            mavtype: MavDistanceSensor::MAV_DISTANCE_SENSOR_UNKNOWN,
            id: 0,
            orientation: MavSensorOrientation::MAV_SENSOR_ROTATION_PITCH_270,
            ..DISTANCE_SENSOR_DATA::default()
        })
    }

    fn ekf_status_report(&self) -> MavMessage {
        let bits = match self.readiness {
            Readiness::Booting => 1024,
            Readiness::Aligned | Readiness::OriginSet => 167,
            Readiness::Ready if self.landed == Landed::OnGround => 831,
            Readiness::Ready => 895,
        };
        MavMessage::EKF_STATUS_REPORT(EKF_STATUS_REPORT_DATA {
            pos_horiz_variance: 0.01,
            compass_variance: 0.03,
            flags: EkfStatusFlags::from_bits_truncate(bits),
            ..EKF_STATUS_REPORT_DATA::default()
        })
    }

    fn extended_sys_state(&self) -> MavMessage {
        MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA {
            vtol_state: MavVtolState::MAV_VTOL_STATE_MC,
            landed_state: match self.landed {
                Landed::OnGround => MavLandedState::MAV_LANDED_STATE_ON_GROUND,
                Landed::InAir => MavLandedState::MAV_LANDED_STATE_IN_AIR,
                Landed::TakingOff => MavLandedState::MAV_LANDED_STATE_TAKEOFF,
                Landed::Landing => MavLandedState::MAV_LANDED_STATE_LANDING,
            },
        })
    }

    /// True acceleration less gravity and true turn rates, in the body.
    fn inertial(&self) -> [Vector<Body>; 2] {
        let free = self.truth.acceleration - Vector::new(0.0, 0.0, GRAVITY_M_S2);
        [self.truth.ned_from_body.inverse() * free, self.truth.angular_rate]
    }

    fn simstate(&self) -> MavMessage {
        let (roll, pitch, yaw) = self.truth.ned_from_body.euler();
        let [force, rate] = self.inertial();
        let p = self.truth.position;
        let (lat, lng) = self.origin.global(p.x(), p.y());
        MavMessage::SIMSTATE(SIMSTATE_DATA {
            roll: roll as f32,
            pitch: pitch as f32,
            yaw: yaw as f32,
            xacc: force.x() as f32,
            yacc: force.y() as f32,
            zacc: force.z() as f32,
            xgyro: rate.x() as f32,
            ygyro: rate.y() as f32,
            zgyro: rate.z() as f32,
            lat,
            lng,
        })
    }

    /// The truth in PX4's message: position in 1e-7 degrees, velocity in cm/s.
    fn hil_state_quaternion(&self) -> MavMessage {
        let (p, v, rate) = (self.truth.position, self.truth.velocity, self.truth.angular_rate);
        let (lat, lon) = self.origin.global(p.x(), p.y());
        let centimetres = |metres: f64| (metres * 100.0).round() as i16;
        MavMessage::HIL_STATE_QUATERNION(HIL_STATE_QUATERNION_DATA {
            time_usec: self.time_usec(),
            attitude_quaternion: self.truth.ned_from_body.wxyz().map(|part| part as f32),
            rollspeed: rate.x() as f32,
            pitchspeed: rate.y() as f32,
            yawspeed: rate.z() as f32,
            lat,
            lon,
            alt: millimetres(self.origin.altitude_m - p.z()),
            vx: centimetres(v.x()),
            vy: centimetres(v.y()),
            vz: centimetres(v.z()),
            ..HIL_STATE_QUATERNION_DATA::default()
        })
    }

    /// The truth.
    fn sim_state(&self) -> MavMessage {
        let [w, x, y, z] = self.truth.ned_from_body.wxyz();
        let (roll, pitch, yaw) = self.truth.ned_from_body.euler();
        let [force, rate] = self.inertial();
        let (p, v) = (self.truth.position, self.truth.velocity);
        let (lat, lon) = self.origin.global(p.x(), p.y());
        MavMessage::SIM_STATE(SIM_STATE_DATA {
            q1: w as f32,
            q2: x as f32,
            q3: y as f32,
            q4: z as f32,
            roll: roll as f32,
            pitch: pitch as f32,
            yaw: yaw as f32,
            xacc: force.x() as f32,
            yacc: force.y() as f32,
            zacc: force.z() as f32,
            xgyro: rate.x() as f32,
            ygyro: rate.y() as f32,
            zgyro: rate.z() as f32,
            // ArduPilot puts 1e-7 degrees here; they are exact only in the integers.
            lat: lat as f32,
            lon: lon as f32,
            alt: (self.origin.altitude_m - p.z()) as f32,
            vn: v.x() as f32,
            ve: v.y() as f32,
            vd: v.z() as f32,
            lat_int: lat,
            lon_int: lon,
            ..SIM_STATE_DATA::default()
        })
    }
}

fn battery_status() -> MavMessage {
    let mut voltages = [u16::MAX; 10];
    voltages[0] = 12_600;
    MavMessage::BATTERY_STATUS(BATTERY_STATUS_DATA {
        voltages,
        temperature: i16::MAX,
        current_battery: 0,
        battery_remaining: 100,
        ..BATTERY_STATUS_DATA::default()
    })
}

/// Version 4.5.4, an official release.
fn autopilot_version() -> MavMessage {
    MavMessage::AUTOPILOT_VERSION(AUTOPILOT_VERSION_DATA {
        flight_sw_version: 0x0405_04FF,
        ..AUTOPILOT_VERSION_DATA::default()
    })
}

fn millimetres(metres: f64) -> i32 {
    (metres * 1000.0).round() as i32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_exact() {
        let mut schedule = Schedule::default();
        assert!(schedule.set(0.0, 30, Some(0.005)));
        assert!(!schedule.set(0.0, 999, Some(0.1)));
        let sent: usize = (0..4000).map(|step| schedule.due(f64::from(step) * 0.0025).len()).sum();
        assert_eq!(sent, 2000);
    }

    #[test]
    fn a_stream_overrides_earlier_requests() {
        let mut schedule = Schedule::default();
        schedule.set(0.0, 30, Some(0.02));
        schedule.set_stream(0.0, 10, None);
        assert!(schedule.due(1.0).is_empty());
    }

    #[test]
    fn the_globe_is_as_large_as_it_should() {
        let origin = Origin::default();
        let (lat0, lon0) = origin.global(0.0, 0.0);
        let (lat, lon) = origin.global(100.0, 100.0);
        assert_eq!((lat0, lon0), (-353_632_620, 1_491_652_370));
        assert!((f64::from(lat - lat0) * 0.011_131_884_5 - 100.0).abs() < 0.02);
        assert!((f64::from(lon - lon0) * 0.011_131_884_5 * 0.815_5 - 100.0).abs() < 0.1);
    }
}
