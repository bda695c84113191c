//! Decodes PX4's EVENT messages into texts: failing checks, why it does not arm, failsafes, modes, take-off and landing.
//!
//! PX4 sends texts (STATUSTEXT) only over links on which it receives a ground station; events it sends over all of them, as numbers with
//! arguments (<https://mavlink.io/en/services/events.html>). The texts here are of the metadata that PX4 v1.17.0-alpha1 is built
//! with (`events/all_events.json`; BSD 3-clause): the checks before arming and of the health, and the commander's texts on arming,
//! failsafes, modes, take-off and landing, setpoints and landing targets. An event that is not among them is
//! reported by its number.

use crate::dialect::{EVENT_DATA, MavSeverity};

/// Bits of an event's id that identify the event; those above identify the component.
const EVENT_BITS: u32 = 0x00ff_ffff;
/// The least severe of PX4's levels that is reported. Levels above it have no text, or are for programs.
const INFORMATION: u8 = 6;
/// The least severe level at which an event with an unknown text is reported.
const WARNING: u8 = 4;
/// The events for programs that begin and end a report of all failing checks.
const CHECKS_BEGIN: u32 = 11_047_904;
const CHECKS_END: u32 = 1_914_663;
/// Where the first of them has the modes in which the vehicle can be armed, in bytes.
const CAN_ARM_AT: usize = 9;

/// A decoded event.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Px4Event {
    /// The first of a report of all failing checks.
    ChecksBegin {
        /// The modes in which it can be armed, as bits.
        can_arm: u32,
    },
    /// The end of such a report.
    ChecksEnd,
    /// It has a text.
    Text(TextEvent),
}

/// An event with a text.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct TextEvent {
    pub(crate) severity: MavSeverity,
    pub(crate) text: String,
    /// Whether the text is PX4's own; else it names the number.
    pub(crate) is_known: bool,
    pub(crate) check: Option<Check>,
}

/// A check before arming or of the health that fails.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Check {
    pub(crate) id: CheckId,
    /// The modes for which it fails, as bits; all of them also where it prevents arming in none.
    pub(crate) modes: u32,
}

/// A check's event, and the number of the sensor, battery or motor, its fault and the like: one battery may have several.
pub(crate) type CheckId = (u32, [u8; 3]);

/// An argument in a text.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum Kind {
    U8,
    U16,
    I16,
    F32,
    Action,
    Cause,
    Mode,
    Reason,
    BatteryFault,
    EscFault,
    Advice,
}

use Kind::{Action, Advice, BatteryFault, Cause, EscFault, F32, I16, Mode, Reason, U8, U16};

/// An event's number, whether it is a check before arming, its text, and the arguments in it with their offset in bytes.
type Row = (u32, bool, &'static str, &'static [(Kind, usize)]);

/// PX4's failsafe actions and their causes, its modes, its reasons to arm and disarm, faults of batteries and motors, and the
/// advice on them, by number.
const ACTIONS: [&str; 11] = [
    "nothing",
    "a warning",
    "Position mode",
    "Altitude mode",
    "Stabilized mode",
    "Hold",
    "RTL",
    "Land",
    "Descend",
    "disarm",
    "terminate",
];
const CAUSES: [&str; 7] = [
    "Failsafe",
    "Manual control loss",
    "GCS connection loss",
    "Low battery level",
    "Critical battery level",
    "Emergency battery level",
    "Remaining flight time low",
];
const MODES: [&str; 16] = [
    "Manual",
    "Altitude control",
    "Position control",
    "Mission",
    "Hold",
    "RTL",
    "Acro",
    "Offboard",
    "Stabilized",
    "Position Slow",
    "Takeoff",
    "Land",
    "Follow Target",
    "Precision Landing",
    "Orbit",
    "Vtol Takeoff",
];
const REASONS: [&str; 15] = [
    "transition to standby",
    "stick gesture",
    "RC switch",
    "internal command",
    "external command",
    "mission start",
    "landing",
    "auto preflight disarming",
    "kill switch",
    "lockdown",
    "failure detector",
    "shutdown request",
    "unit tests",
    "RC (button)",
    "failsafe",
];

const BATTERY_FAULTS: [&str; 11] = [
    "Battery has deep discharged",
    "Battery detected voltage spikes",
    "One or more battery cells have failed",
    "Battery reported over-current",
    "Battery has reached a critical temperature which can result in a critical failure",
    "Battery temperature is below operating range",
    "Voltage mismatch, use equally charged batteries",
    "Battery firmware is not compatible with current autopilot firmware",
    "Battery model is not supported by the system",
    "Battery reported an hardware problem",
    "Battery failed to arm",
];
const ESC_FAULTS: [&str; 10] = [
    "detected over current",
    "detected over voltage",
    "Motor has reached a critical temperature",
    "Motor RPM is exceeding the limits",
    "received an invalid control command",
    "Motor stalled",
    "detected a generic hardware failure",
    "Motor is over-heating",
    "is over-heating",
    "reached a critical temperature",
];
const ADVICE: [&str; 3] = ["", "Land now!", "Reduce throttle!"];

/// Decodes an event; `None` for one that is for programs only. `in_report` after the beginning of a report of all failing
/// checks: there, an event whose text is not known is a check as well.
pub(crate) fn read(event: &EVENT_DATA, in_report: bool) -> Option<Px4Event> {
    let number = event.id & EVENT_BITS;
    match number {
        CHECKS_BEGIN => {
            let can_arm = u32::from_le_bytes(bytes(event, CAN_ARM_AT));
            return Some(Px4Event::ChecksBegin { can_arm });
        }
        CHECKS_END => return Some(Px4Event::ChecksEnd),
        _ => {}
    }
    let level = event.log_levels & 0x0f;
    let severity = severity(level)?;
    let modes = u32::from_le_bytes(bytes(event, 0));
    let row = TABLE.binary_search_by_key(&number, |row| row.0).ok().and_then(|at| TABLE.get(at));
    let Some((_, is_check, text, arguments)) = row else {
        let text = format!(
            "PX4's event {number}, whose text is not known here: look the number up in all_events.json of PX4's build"
        );
        let check = in_report.then_some(Check { id: (number, [0; 3]), modes });
        let decoded = TextEvent { severity, text, is_known: false, check };
        return (level <= WARNING).then_some(Px4Event::Text(decoded));
    };
    let mut text = (*text).to_owned();
    for (kind, at) in *arguments {
        text = text.replacen("{}", &argument(event, *kind, *at), 1);
    }
    let text = text.trim_end().to_owned();
    let mut which = [0; 3];
    // Measured values change, and the check is the same.
    let bytes_of = arguments.iter().filter(|(kind, _)| !matches!(kind, U16 | I16 | F32));
    for (slot, (_, at)) in which.iter_mut().zip(bytes_of) {
        [*slot] = bytes(event, *at);
    }
    let check = is_check.then_some(Check { id: (number, which), modes });
    Some(Px4Event::Text(TextEvent { severity, text, is_known: true, check }))
}

fn severity(level: u8) -> Option<MavSeverity> {
    Some(match level {
        0 => MavSeverity::MAV_SEVERITY_EMERGENCY,
        1 => MavSeverity::MAV_SEVERITY_ALERT,
        2 => MavSeverity::MAV_SEVERITY_CRITICAL,
        3 => MavSeverity::MAV_SEVERITY_ERROR,
        WARNING => MavSeverity::MAV_SEVERITY_WARNING,
        5 => MavSeverity::MAV_SEVERITY_NOTICE,
        INFORMATION => MavSeverity::MAV_SEVERITY_INFO,
        _ => return None,
    })
}

fn argument(event: &EVENT_DATA, kind: Kind, at: usize) -> String {
    let [byte] = bytes(event, at);
    let named = |names: &[&str]| {
        names.get(usize::from(byte)).map_or_else(|| byte.to_string(), |name| (*name).to_owned())
    };
    match kind {
        U8 => byte.to_string(),
        U16 => u16::from_le_bytes(bytes(event, at)).to_string(),
        I16 => i16::from_le_bytes(bytes(event, at)).to_string(),
        F32 => format!("{:.1}", f32::from_le_bytes(bytes(event, at))),
        Action => named(&ACTIONS),
        Cause => named(&CAUSES),
        Mode => named(&MODES),
        Reason => named(&REASONS),
        BatteryFault => named(&BATTERY_FAULTS),
        EscFault => named(&ESC_FAULTS),
        Advice => named(&ADVICE),
    }
}

/// Bytes of the arguments; those that are not there are zero.
fn bytes<const N: usize>(event: &EVENT_DATA, at: usize) -> [u8; N] {
    std::array::from_fn(|i| event.arguments.get(at + i).copied().unwrap_or(0))
}

#[rustfmt::skip] // A line for each event.
const TABLE: [Row; 169] = [
    (51327, false, "Emergency battery level, land immediately", &[]),
    (79408, true, "Home position not set", &[]),
    (124285, true, "Geofence RTL requires valid home", &[]),
    (133277, false, "Arming denied: Resolve system health failures first", &[]),
    (143019, true, "Geofence violation: approaching or outside geofence", &[]),
    (276785, true, "Press safety button first", &[]),
    (377561, true, "No valid mission available", &[]),
    (453929, true, "No manual control input", &[]),
    (516062, true, "GPS Vertical Position Error too high", &[]),
    (666479, true, "Motor failure detected", &[]),
    (713405, false, "Manual control regained after {} s", &[(F32, 0)]),
    (810921, true, "Waypoint above maximum height", &[]),
    (929525, false, "Estimated position error is approaching the failsafe threshold", &[]),
    (961599, false, "Pilot took over using sticks", &[]),
    (1049276, true, "GPS Horizontal Position Error too high", &[]),
    (1058956, true, "CPU load too high: {}%", &[(F32, 5)]),
    (1326449, true, "Gyro {} uncalibrated", &[(U8, 5)]),
    (1604295, false, "Terrain collision risk, descent is stopped", &[]),
    (1670367, true, "Avionics Power low: {} Volt", &[(F32, 5)]),
    (1746622, false, "Pilot took over using sticks", &[]),
    (1749061, false, "Arming denied: throttle above center", &[]),
    (1802995, true, "Airspeed too high", &[]),
    (1871713, true, "Mode not suitable for arming", &[]),
    (1917030, true, "RC calibration for channel {} invalid: TRIM greater than MAX", &[(U8, 5)]),
    (2066387, false, "Arming denied: calibrating", &[]),
    (2088119, true, "Poor GPS Quality", &[]),
    (2228586, true, "Remaining flight time low", &[]),
    (2229864, true, "Power redundancy not met", &[]),
    (2308551, false, "Low remaining flight time, return advised", &[]),
    (2474944, false, "Critical battery level, land now", &[]),
    (2481841, true, "Gyro {} inconsistent", &[(U8, 5)]),
    (2627595, true, "Critical battery", &[]),
    (3061044, true, "Accel {} inconsistent", &[(U8, 5)]),
    (3087815, true, "No offboard signal", &[]),
    (3092229, false, "Unsupported auto mode", &[]),
    (3189229, true, "No valid data from barometer {}", &[(U8, 5)]),
    (3322590, false, "Landing at current position", &[]),
    (3484900, false, "Returning to launch", &[]),
    (3568720, true, "Gyro sensor {} missing", &[(U8, 5)]),
    (3603209, true, "Stopping compass use", &[]),
    (3613628, true, "High Accelerometer Bias", &[]),
    (4065583, true, "Geofence violation: exceeding maximum distance to Home", &[]),
    (4261821, true, "Failure triggered by external system", &[]),
    (4277609, false, "Takeoff detected", &[]),
    (4448091, true, "Crash dumps present on SD card", &[]),
    (4502496, false, "Failsafe activated: switching to {} in {} seconds", &[(Action, 4), (U16, 5)]),
    (4549029, true, "Altitude failure detected", &[]),
    (4643123, true, "Airspeed invalid", &[]),
    (4877352, true, "Imbalanced propeller detected", &[]),
    (4975227, true, "GPS Horizontal Speed Drift too high", &[]),
    (5049764, true, "Low battery", &[]),
    (5095593, true, "Barometer {} missing", &[(U8, 5)]),
    (5273740, true, "Compass inconsistent by {} degrees", &[(I16, 5)]),
    (5444856, true, "Accelerometer {} uncalibrated", &[(U8, 5)]),
    (5623108, false, "Manual control lost", &[]),
    (5650341, false, "SET_POSITION_TARGET_LOCAL_NED: invalid, missing position, velocity or acceleration", &[]),
    (5699115, true, "Overcurrent detected for the peripheral 5V supply", &[]),
    (5704353, true, "Arm authorization denied", &[]),
    (5717196, true, "GPS Horizontal Position Drift too high", &[]),
    (5847165, false, "Dangerously low battery! System shut down failed", &[]),
    (5874720, false, "Arming denied: high throttle", &[]),
    (5943233, true, "Found {} compass (required: {})", &[(U8, 5), (U8, 6)]),
    (6054338, true, "Waiting for estimator to initialize", &[]),
    (6258044, true, "Estimator fault due to Compass {}", &[(U8, 5)]),
    (6410608, true, "No valid data from Compass {}", &[(U8, 5)]),
    (6491364, true, "Home position required", &[]),
    (6558257, true, "GPS Vertical Speed Drift too high", &[]),
    (6659180, true, "RC calibration for channel {} invalid: DZ greater than {}", &[(U8, 5), (U16, 6)]),
    (6801787, true, "No connection to the ground control station", &[]),
    (6880628, false, "Approaching max flight time (system will RTL in {} minutes)", &[(I16, 0)]),
    (6948489, true, "ESC {}: {}. {}", &[(U8, 5), (EscFault, 6), (Advice, 7)]),
    (6962647, true, "Overcurrent detected for the hipower 5V supply", &[]),
    (6979701, true, "RC calibration for channel {} invalid: MIN less than {}", &[(U8, 5), (U16, 6)]),
    (7214714, true, "System power unavailable", &[]),
    (7662152, true, "USB connected", &[]),
    (7714236, false, "Approaching max flight time (system will RTL in {} seconds)", &[(I16, 0)]),
    (7847312, true, "RC calibration for channel {} invalid: MAX greater than {}", &[(U8, 5), (U16, 6)]),
    (7884377, true, "RTL switch engaged", &[]),
    (7908333, true, "Power module not connected", &[]),
    (7959667, true, "Vehicle is in safety configuration", &[]),
    (8227839, true, "Accelerometer sensor {} missing", &[(U8, 5)]),
    (8310204, false, "Landing using precision landing", &[]),
    (8441780, true, "Open Drone ID system not ready", &[]),
    (8495477, true, "RC calibration for channel {} invalid: TRIM less than MIN", &[(U8, 5)]),
    (8538897, true, "Attitude failure detected", &[]),
    (8544646, true, "No valid data from distance sensor {}", &[(U8, 5)]),
    (8557551, false, "Failsafe warning: {}", &[(Cause, 4)]),
    (8713942, true, "GPS signal spoofed", &[]),
    (8792768, true, "Optical flow sensor missing", &[]),
    (8799553, true, "Battery {} disconnected", &[(U8, 5)]),
    (8902208, true, "Horizontal velocity unstable", &[]),
    (9077977, true, "Kill switch engaged", &[]),
    (9091509, false, "Disarming denied: not landed", &[]),
    (9171208, true, "Vertical velocity unstable", &[]),
    (9191449, true, "ESC telemetry missing", &[]),
    (9266821, true, "No CPU and RAM load information", &[]),
    (9307221, true, "High Gyro Bias", &[]),
    (9489139, false, "Armed by {}", &[(Reason, 0)]),
    (9493632, true, "No airspeed data", &[]),
    (9608226, true, "Estimator not using GPS", &[]),
    (9634798, true, "Height estimate not stable", &[]),
    (9643369, true, "Angular velocity not valid", &[]),
    (9697819, true, "Horizontal position unstable", &[]),
    (9751178, false, "{}: switching to {}", &[(Cause, 5), (Action, 4)]),
    (9815168, true, "Mode is unresponsive", &[]),
    (9844908, false, "Landing detected", &[]),
    (9965819, true, "GNSS heading not reliable", &[]),
    (10011251, true, "Navigation error: No valid global position estimate", &[]),
    (10161216, true, "Open Drone ID system missing", &[]),
    (10198977, true, "GPS PDOP too high", &[]),
    (10318274, true, "Battery {} missing", &[(U8, 5)]),
    (10450063, true, "No valid attitude estimate", &[]),
    (10503063, false, "Switching to mode '{}' is currently not possible", &[(Mode, 4)]),
    (10678671, true, "GPS Speed Accuracy too low", &[]),
    (10716939, false, "Onboard controller regained", &[]),
    (10794072, false, "Connection to ground control station lost", &[]),
    (10960133, true, "Position estimate has low accuracy", &[]),
    (10996333, true, "Missing FMU SD Card", &[]),
    (11123101, false, "Connection to mission computer lost", &[]),
    (11125932, true, "No valid data from optical flow sensor", &[]),
    (11290563, false, "Kill engaged", &[]),
    (11344647, true, "Emergency battery level", &[]),
    (11413600, true, "Wind speed is above limit ({}m/s)", &[(F32, 5)]),
    (11478328, true, "No valid data from Gyro {}", &[(U8, 5)]),
    (11497430, true, "GPS Vertical Position Drift too high", &[]),
    (11552065, false, "SET_POSITION_TARGET_LOCAL_NED: coordinate frame {} unsupported", &[(U8, 0)]),
    (12216659, false, "Low battery level, return advised", &[]),
    (12221094, false, "Landing target: unsupported coordinate frame {}", &[(U8, 0)]),
    (12276004, true, "Global position estimate required", &[]),
    (12369553, true, "GPS fix too low", &[]),
    (12420351, false, "Arming denied: switch to manual mode first", &[]),
    (12689900, true, "Navigation error: No valid altitude estimate", &[]),
    (12754954, true, "Flight termination active", &[]),
    (12770418, false, "Failsafe activated: Autopilot disengaged, switching to {}", &[(Action, 4)]),
    (12780289, true, "GPS reports critical jamming state", &[]),
    (12805643, true, "Mission cannot be completed", &[]),
    (13094458, true, "Not enough GPS Satellites", &[]),
    (13277401, false, "Failsafe warning, no action", &[]),
    (13344346, true, "Battery unhealthy", &[]),
    (13372152, true, "Parachute system not ready", &[]),
    (13528143, true, "Vehicle is in transition state", &[]),
    (13704694, false, "{}: switching to {} in {} seconds", &[(Cause, 7), (Action, 4), (U16, 5)]),
    (13835193, true, "Navigation error: No valid position estimate", &[]),
    (13923616, true, "Geofence violation: exceeding maximum altitude above Home", &[]),
    (14200647, true, "Vehicle is not in multicopter mode", &[]),
    (14221469, true, "Distance sensor {} missing", &[(U8, 5)]),
    (14234660, false, "GCS connection regained", &[]),
    (14421482, true, "RAM usage too high: {}%", &[(F32, 5)]),
    (14566046, true, "ESC {} offline", &[(U8, 5)]),
    (14605264, false, "Failsafe activated: switching to {}", &[(Action, 4)]),
    (14644618, true, "Maximum flight time reached", &[]),
    (14748737, true, "Mode is not registered", &[]),
    (15180799, true, "VTOL fixed-wing system failure detected. Verify reason for failure, and reboot the vehicle once confirmed safe", &[]),
    (15289843, true, "Avionics Power high: {} Volt", &[(F32, 5)]),
    (15388760, true, "Compass sensor {} missing", &[(U8, 5)]),
    (15456613, false, "Accel {} clipping, not safe to fly!", &[(U8, 0)]),
    (15536452, false, "External mode is unresponsive, falling back to internal", &[]),
    (15602498, true, "Battery {}: {}. {}", &[(U8, 5), (BatteryFault, 6), (Advice, 7)]),
    (15603271, false, "Dangerously low battery! Shutting system down", &[]),
    (15713375, true, "Strong magnetic interference", &[]),
    (15793174, true, "ESC failure", &[]),
    (15965684, true, "Parachute system missing", &[]),
    (16017271, false, "Disarmed by {}", &[(Reason, 0)]),
    (16158540, true, "Landing gear switch set in UP position", &[]),
    (16230031, true, "No valid data from Accelerometer {}", &[(U8, 5)]),
    (16642797, true, "Heading estimate not stable", &[]),
    (16682655, false, "Kill disengaged", &[]),
    (16716537, true, "Compass {} uncalibrated", &[(U8, 5)]),
    (16745468, true, "Attitude failure detected", &[]),
];

#[cfg(test)]
mod tests {
    use super::*;

    /// An event with arguments as PX4 packs them.
    fn event(id: u32, level: u8, arguments: &[u8]) -> EVENT_DATA {
        let mut event = EVENT_DATA { id, log_levels: level, ..EVENT_DATA::default() };
        event.arguments.iter_mut().zip(arguments).for_each(|(to, of)| *to = *of);
        event
    }

    fn text_event(id: u32, level: u8, arguments: &[u8]) -> TextEvent {
        match read(&event(id, level, arguments), false) {
            Some(Px4Event::Text(decoded)) => decoded,
            other => panic!("{other:?}"),
        }
    }

    fn text(id: u32, level: u8, arguments: &[u8]) -> String {
        text_event(id, level, arguments).text
    }

    #[test]
    fn every_event_is_found_and_all_its_arguments_are_shown() {
        assert!(TABLE.is_sorted_by_key(|row| row.0));
        for (id, is_check, text, arguments) in &TABLE {
            assert_eq!(text.matches("{}").count(), arguments.len(), "{text}");
            let decoded = text_event(0x0100_0000 | id, 2, &[0xff; 40]);
            assert!(!decoded.text.contains("{}"), "{}", decoded.text);
            assert_eq!(decoded.check.is_some(), *is_check, "{}", decoded.text);
        }
    }

    #[test]
    fn events_recorded_from_px4_are_decoded() {
        // Recorded from 1.17.
        assert_eq!(
            text(0x0102_089d, 0x62, &[]),
            "Arming denied: Resolve system health failures first"
        );
        assert_eq!(text(0x0190_caf3, 0x66, &[4]), "Armed by external command");
        let no_stick = text_event(0x0106_ed29, 0x44, &[0xff, 0xff, 0xff, 0xff, 7]);
        let check = Check { id: (453_929, [0; 3]), modes: u32::MAX };
        assert_eq!(
            (no_stick.text.as_str(), no_stick.check),
            ("No manual control input", Some(check))
        );
    }

    #[test]
    fn a_report_of_the_checks_gives_the_modes_in_which_it_can_be_armed() {
        let mut summary = [0; 17];
        summary[9..13].copy_from_slice(&0x0002_8010_u32.to_le_bytes());
        let begin = read(&event(0x01a8_93e0, 0x88, &summary), false);
        assert_eq!(begin, Some(Px4Event::ChecksBegin { can_arm: 0x0002_8010 }));
        assert_eq!(read(&event(0x011d_3727, 0x88, &[]), true), Some(Px4Event::ChecksEnd));
        let unknown = |in_report| match read(&event(1, 3, &[0x10]), in_report) {
            Some(Px4Event::Text(decoded)) => decoded.check,
            other => panic!("{other:?}"),
        };
        assert_eq!(unknown(true), Some(Check { id: (1, [0; 3]), modes: 0x10 }));
        assert_eq!(unknown(false), None);
    }

    #[test]
    fn failsafes_name_cause_and_action_and_unknown_events_their_number() {
        let enter = &[0, 0, 0, 0, 5, 2];
        assert_eq!(text(9_751_178, 2, enter), "GCS connection loss: switching to Hold");
        let wait = &[0, 0, 0, 0, 6, 5, 0, 3];
        assert_eq!(text(13_704_694, 4, wait), "Low battery level: switching to RTL in 5 seconds");
        assert_eq!(text(16_017_271, 6, &[77]), "Disarmed by 77");
        let unknown = text(1, 3, &[]);
        assert!(
            unknown.starts_with("PX4's event 1, whose text is not known here: look"),
            "{unknown}"
        );
        assert_eq!(read(&event(1, 6, &[]), false), None);
        assert_eq!(read(&event(1, 0xff, &[]), false), None);
    }

    #[test]
    fn faults_name_the_failed_part_and_the_advice() {
        let battery = text(15_602_498, 0x40, &[0xff, 0xff, 0xff, 0xff, 11, 1, 2, 1]);
        assert_eq!(battery, "Battery 1: One or more battery cells have failed. Land now!");
        let esc = text(6_948_489, 0x33, &[0xff, 0xff, 0xff, 0xff, 8, 4, 5, 0]);
        assert_eq!(esc, "ESC 4: Motor stalled.");
        assert_eq!(
            text(11_552_065, 3, &[8]),
            "SET_POSITION_TARGET_LOCAL_NED: coordinate frame 8 unsupported"
        );
    }
}
