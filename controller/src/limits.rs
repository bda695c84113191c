//! How the autopilot follows setpoints: its parameters are read, and its setpoint timeout is shortened for the
//! landing.
//!
//! An autopilot follows the last velocity for a while when setpoints stop, 3 s by ArduPilot's default, also
//! downwards. The shorter this timeout is, the faster a vehicle may descend that must not hit the ground should its
//! controller die. So it is set for the landing and put back afterwards; after a crash by the controller that is
//! started next, from a [`Note`].

use autopilot::{Autopilot, Firmware, LandedState, Parameter};
use landing::AutopilotLimits;
use serde::{Deserialize, Serialize};

/// ArduPilot's setpoint timeout, in s.
const GUID_TIMEOUT: &str = "GUID_TIMEOUT";
/// ArduPilot's vertical and horizontal acceleration and horizontal jerk, by their names up to 4.6 (the accelerations in
/// cm/s^2) and from 4.7 on, with their scale to m/s^2 and m/s^3.
const VERTICAL_ACCELERATION: [Scaled; 2] = [scaled("WPNAV_ACCEL_Z", 0.01), scaled("WP_ACC_Z", 1.0)];
const ACCELERATION: [Scaled; 2] = [scaled("WPNAV_ACCEL", 0.01), scaled("WP_ACC", 1.0)];
const JERK: [Scaled; 2] = [scaled("PSC_JERK_XY", 1.0), scaled("PSC_JERK_NE", 1.0)];
/// ArduPilot's speed of LAND near the ground, and high up (0: the one at which it descends anyway), by their names up to 4.6
/// (in cm/s) and from 4.7 on, with their scale to m/s.
const LAND_SPEED: [Scaled; 2] = [scaled("LAND_SPEED", 0.01), scaled("LAND_SPD_MS", 1.0)];
const LAND_SPEED_HIGH: [Scaled; 2] =
    [scaled("LAND_SPEED_HIGH", 0.01), scaled("LAND_SPD_HIGH_MS", 1.0)];
/// PX4's speed of LAND near the ground, in m/s.
const MPC_LAND_SPEED: [Scaled; 1] = [scaled("MPC_LAND_SPEED", 1.0)];
/// PX4's time without setpoints until it holds its place, in s.
const COM_OF_LOSS_T: &str = "COM_OF_LOSS_T";

/// PX4's reaction when setpoints stop, and its value for holding the place. By the default, position mode, a vehicle without a remote
/// control descends and drifts.
const COM_OBL_RC_ACT: &str = "COM_OBL_RC_ACT";
const HOLDS: f64 = 5.0;

/// Difference of two timeouts that count as the same, in seconds.
const SAME_S: f64 = 1e-3;
/// Longest timeout that is put back from a note: PX4 takes up to 60 s, ArduPilot 5 s.
const MAX_ORIGINAL_S: f64 = 60.0;
/// Time for which no landing was active before the timeout of a vehicle is put back that does not stand on the ground
/// with its motors off, in nanoseconds: a controller that is started again needs as long to see that it has one to
/// resume, and a vehicle that flies on with the last setpoint must have stopped.
const QUIET_NS: i64 = 2_000_000_000;

/// Steps in which late packets lengthen the setpoint timeout, in seconds.
const BEHIND_STEP_S: f64 = 0.1;

/// A parameter and the factor to SI units.
#[derive(Copy, Clone, Debug)]
struct Scaled {
    name: &'static str,
    scale: f64,
}

const fn scaled(name: &'static str, scale: f64) -> Scaled {
    Scaled { name, scale }
}

/// A parameter to restore, stored outside of the process for the time after a crash.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Note {
    /// The link's address, which distinguishes vehicles with the same system id.
    pub address: String,
    /// The vehicle's MAVLink system id.
    pub system: u8,
    /// Name of the parameter.
    pub parameter: String,
    /// Its value before the landing, in seconds.
    pub original_s: f64,
    /// Its value for the landing, in seconds.
    pub set_s: f64,
}

/// The limits of one autopilot.
#[derive(Debug)]
pub struct Limits {
    address: String,
    /// The setpoint timeout for a landing, in seconds; 0 leaves the autopilot's.
    wanted_s: f64,
    /// The note of an earlier controller.
    left: Option<Note>,
    note: Option<Note>,
    /// The autopilot did not take the timeout in this landing.
    is_refused: bool,
    /// The timeout is being put back.
    is_restoring: bool,
    active_ns: Option<i64>,
    known: Option<AutopilotLimits>,
    /// The warning of PX4's reaction to a silent controller is in the log.
    is_silence_logged: bool,
}

impl Limits {
    /// Nothing is known of the autopilot at this address.
    pub fn new(address: String, wanted_s: f64) -> Self {
        Self {
            address,
            wanted_s,
            left: None,
            note: None,
            is_refused: false,
            is_restoring: false,
            active_ns: None,
            known: None,
            is_silence_logged: false,
        }
    }

    /// Takes over the note of an earlier controller, for a vehicle that still has its value.
    pub fn take_over(&mut self, note: Note) {
        self.left = Some(note);
    }

    /// The autopilot was found: its parameters are requested.
    pub fn found(&self, autopilot: &mut Autopilot) {
        match autopilot.firmware() {
            Some(Firmware::Copter) => {
                autopilot.read_parameters(&[GUID_TIMEOUT]);
                for [old, new] in
                    [VERTICAL_ACCELERATION, ACCELERATION, JERK, LAND_SPEED, LAND_SPEED_HIGH]
                {
                    autopilot.read_parameters(&[old.name, new.name]);
                }
            }
            Some(Firmware::Px4) => {
                autopilot.read_parameters(&[COM_OF_LOSS_T, COM_OBL_RC_ACT, MPC_LAND_SPEED[0].name]);
            }
            _ => {}
        }
    }

    /// Sets the timeout while a landing is active, and puts it back afterwards; returns the limits when they
    /// have changed.
    pub fn step(
        &mut self,
        now_ns: i64,
        is_landing: bool,
        autopilot: &mut Autopilot,
    ) -> Option<AutopilotLimits> {
        if let (Some(name), Some(timeout_s)) = (name(autopilot), timeout_s(autopilot)) {
            self.check_left(name, timeout_s, autopilot);
            if is_landing {
                self.active_ns = Some(now_ns);
                self.shorten(name, timeout_s, autopilot);
            } else if !autopilot.has_listened(now_ns) {
                // A landing that is to be resumed begins only then, and this may be another vehicle.
                self.active_ns = Some(now_ns);
            } else {
                self.is_refused = false;
                let since_ns = *self.active_ns.get_or_insert(now_ns);
                // Motors that are said to be off in the air may run: then it still flies our last setpoint.
                let is_down = autopilot
                    .state()
                    .is_some_and(|state| !state.armed && state.landed == LandedState::OnGround);
                if is_down || now_ns.saturating_sub(since_ns) >= QUIET_NS {
                    self.restore(autopilot);
                }
            }
        }
        if let Some(action) = value(autopilot, COM_OBL_RC_ACT)
            && action != HOLDS
            && !std::mem::replace(&mut self.is_silence_logged, true)
        {
            tracing::warn!(
                "{COM_OBL_RC_ACT} is {action}: should this process die, PX4 does that instead of holding its place, and in the modes 0 to 2 it descends and drifts without a remote control; set it to {HOLDS} (hold)"
            );
        }
        let mut limits = read(autopilot);
        // A setpoint that arrives once more, late, makes the autopilot wait once more.
        let behind_s = autopilot.packets_come_behind(now_ns).as_secs_f64();
        limits.setpoint_timeout_s = limits
            .setpoint_timeout_s
            .map(|timeout_s| timeout_s + (behind_s / BEHIND_STEP_S).ceil() * BEHIND_STEP_S);
        let is_new = self.known != Some(limits);
        self.known = Some(limits);
        is_new.then_some(limits)
    }

    /// The parameter to restore; `None` if there is none.
    pub fn note(&self) -> Option<&Note> {
        self.note.as_ref().or(self.left.as_ref())
    }

    /// Puts the timeout back, if it may have been changed; true while the autopilot has not confirmed it. One that has not reported
    /// the shorter timeout may have taken it all the same.
    pub fn restore(&mut self, autopilot: &mut Autopilot) -> bool {
        let Some(note) = &self.note else { return false };
        let (Some(timeout_s), Some(name)) = (timeout_s(autopilot), name(autopilot)) else {
            return false;
        };
        let is_at = |seconds: f64| (timeout_s - seconds).abs() < SAME_S;
        let is_others = name != note.parameter || !is_at(note.set_s) && !is_at(note.original_s);
        if !is_others {
            if !std::mem::replace(&mut self.is_restoring, true) {
                autopilot.set_parameter(name, note.original_s);
                return true;
            }
            if autopilot.is_setting(name) {
                return true;
            }
            if autopilot.is_unanswered(name) || !is_at(note.original_s) {
                self.is_restoring = false;
                return true;
            }
        }
        if is_others {
            tracing::warn!(
                parameter = note.parameter,
                seconds = timeout_s,
                "Setpoint timeout was changed by another program; it stays so"
            );
        } else {
            tracing::info!(
                parameter = note.parameter,
                seconds = timeout_s,
                "Setpoint timeout is put back"
            );
        }
        self.note = None;
        self.is_restoring = false;
        false
    }

    /// The note of an earlier controller becomes ours, where the vehicle still has its value.
    fn check_left(&mut self, name: &str, timeout_s: f64, autopilot: &Autopilot) {
        let Some(left) = self.left.take() else { return };
        if left.address == self.address
            && Some(left.system) == autopilot.system()
            && left.parameter == name
            && (timeout_s - left.set_s).abs() < SAME_S
            && (0.0..=MAX_ORIGINAL_S).contains(&left.original_s)
        {
            self.note = Some(left);
        }
    }

    fn shorten(&mut self, name: &'static str, timeout_s: f64, autopilot: &mut Autopilot) {
        let is_short = timeout_s <= self.wanted_s + SAME_S && !self.is_restoring;
        if self.wanted_s <= 0.0 || is_short || self.is_refused {
            return;
        }
        let Some(system) = autopilot.system() else { return };
        let is_restoring = std::mem::take(&mut self.is_restoring);
        let ours = self.note.as_ref().filter(|note| note.parameter == name);
        let is_begun = ours.is_some_and(|note| note.set_s == self.wanted_s) && !is_restoring;
        if !is_begun {
            // A value of an earlier landing is not the vehicle's own.
            let is_ours = |note: &&Note| is_restoring || (timeout_s - note.set_s).abs() < SAME_S;
            let original_s = ours.filter(is_ours).map_or(timeout_s, |note| note.original_s);
            self.note = Some(Note {
                address: self.address.clone(),
                system,
                parameter: name.to_owned(),
                original_s,
                set_s: self.wanted_s,
            });
            tracing::info!(
                parameter = name,
                from_s = timeout_s,
                to_s = self.wanted_s,
                "Setpoint timeout is shortened for the landing"
            );
            autopilot.set_parameter(name, self.wanted_s);
        } else if !autopilot.is_setting(name) {
            self.is_refused = true;
            tracing::warn!(
                parameter = name,
                seconds = timeout_s,
                "The autopilot does not take a shorter setpoint timeout; the descent is slower for it"
            );
        }
    }
}

/// The parameter that holds the setpoint timeout.
fn name(autopilot: &Autopilot) -> Option<&'static str> {
    match autopilot.firmware()? {
        Firmware::Copter => Some(GUID_TIMEOUT),
        Firmware::Px4 => Some(COM_OF_LOSS_T),
        _ => None,
    }
}

/// The setpoint timeout in seconds; `None` while it is not known.
pub fn timeout_s(autopilot: &Autopilot) -> Option<f64> {
    value(autopilot, name(autopilot)?)
}

fn read(autopilot: &Autopilot) -> AutopilotLimits {
    let default = AutopilotLimits::default();
    let first =
        |names: &[Scaled]| names.iter().find_map(|it| Some(value(autopilot, it.name)? * it.scale));
    let or = |names: [Scaled; 2], default| first(&names).unwrap_or(default);
    let land_m_s = match autopilot.firmware() {
        Some(Firmware::Px4) => first(&MPC_LAND_SPEED),
        _ => first(&LAND_SPEED).map(|low_m_s| {
            let high_m_s = first(&LAND_SPEED_HIGH).filter(|high_m_s| *high_m_s > 0.0);
            high_m_s.map_or(low_m_s, |high_m_s| libm::fmin(high_m_s, low_m_s))
        }),
    };
    AutopilotLimits {
        setpoint_timeout_s: timeout_s(autopilot),
        acceleration_m_s2: or(ACCELERATION, default.acceleration_m_s2),
        jerk_m_s3: or(JERK, default.jerk_m_s3),
        vertical_acceleration_m_s2: or(VERTICAL_ACCELERATION, default.vertical_acceleration_m_s2),
        land_m_s: land_m_s.unwrap_or(default.land_m_s),
    }
}

fn value(autopilot: &Autopilot, name: &str) -> Option<f64> {
    match autopilot.parameter(name) {
        Parameter::Value(value) => Some(value),
        Parameter::Unknown | Parameter::Silent => None,
    }
}
