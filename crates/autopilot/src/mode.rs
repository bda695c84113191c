//! Firmware (ArduPilot, PX4) of a heartbeat, and flight modes by name and custom number: those that follow
//! setpoints, land, or land on a target.

use std::fmt;

use crate::dialect::{HEARTBEAT_DATA, MavAutopilot, MavType};

/// The autopilot's firmware.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Firmware {
    /// ArduPilot on a multicopter or helicopter: supported.
    Copter,
    /// ArduPilot on a vehicle of another kind, with other mode numbers: not supported.
    OtherArduPilot,
    /// PX4 on a multicopter or helicopter: supported as documented; OFFBOARD was flown on 1.17 in simulation.
    Px4,
    /// PX4 on a vehicle of another kind: not supported.
    OtherPx4,
    /// Anything else: not supported.
    Unknown,
}

/// A flight mode.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum FlightMode {
    /// ArduPilot Copter follows the setpoints of a companion.
    Guided,
    /// ArduPilot Copter lands at its position.
    Land,
    /// Another mode of ArduPilot Copter, by number.
    Other(u32),
    /// A mode of PX4: main mode in bits 16 to 23, sub mode in bits 24 to 31.
    Px4(u32),
    /// A mode of an unknown firmware.
    Foreign(u32),
}

const GUIDED: u32 = 4;
const LAND: u32 = 9;

impl Firmware {
    /// The firmware of a heartbeat.
    pub fn of(heartbeat: &HEARTBEAT_DATA) -> Self {
        let hovers = matches!(
            heartbeat.mavtype,
            MavType::MAV_TYPE_QUADROTOR
                | MavType::MAV_TYPE_COAXIAL
                | MavType::MAV_TYPE_HELICOPTER
                | MavType::MAV_TYPE_HEXAROTOR
                | MavType::MAV_TYPE_OCTOROTOR
                | MavType::MAV_TYPE_TRICOPTER
                | MavType::MAV_TYPE_DODECAROTOR
                | MavType::MAV_TYPE_DECAROTOR
        );
        match (heartbeat.autopilot, hovers) {
            (MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, true) => Self::Copter,
            (MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA, false) => Self::OtherArduPilot,
            (MavAutopilot::MAV_AUTOPILOT_PX4, true) => Self::Px4,
            (MavAutopilot::MAV_AUTOPILOT_PX4, false) => Self::OtherPx4,
            _ => Self::Unknown,
        }
    }

    /// The mode that follows a companion's setpoints; `None` when not supported.
    pub fn guided(self) -> Option<FlightMode> {
        match self {
            Self::Copter => Some(FlightMode::Guided),
            Self::Px4 => Some(FlightMode::OFFBOARD),
            Self::OtherArduPilot | Self::OtherPx4 | Self::Unknown => None,
        }
    }

    /// The mode that lands; `None` when not supported.
    pub fn land(self) -> Option<FlightMode> {
        match self {
            Self::Copter => Some(FlightMode::Land),
            Self::Px4 => Some(FlightMode::AUTO_LAND),
            Self::OtherArduPilot | Self::OtherPx4 | Self::Unknown => None,
        }
    }

    /// The mode of the precision landing on a landing target: differs from [`Firmware::land`] only on PX4.
    pub fn precision_land(self) -> Option<FlightMode> {
        if self == Self::Px4 { Some(FlightMode::AUTO_PRECLAND) } else { self.land() }
    }
}

impl fmt::Display for Firmware {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Copter => "ArduPilot Copter",
            Self::OtherArduPilot => "ArduPilot on a vehicle that is not a copter",
            Self::Px4 => "PX4",
            Self::OtherPx4 => "PX4 on a vehicle that is not a copter",
            Self::Unknown => "an unknown firmware",
        })
    }
}

impl FlightMode {
    /// PX4 follows the setpoints of a companion (main mode 6).
    pub const OFFBOARD: Self = Self::Px4(6 << 16);
    /// PX4 takes off (main mode 4, sub mode 2).
    pub const AUTO_TAKEOFF: Self = Self::Px4(0x0204_0000);
    /// PX4 holds its position (main mode 4, sub mode 3).
    pub const AUTO_HOLD: Self = Self::Px4(0x0304_0000);
    /// PX4 lands at its position (main mode 4, sub mode 6).
    pub const AUTO_LAND: Self = Self::Px4(0x0604_0000);
    /// PX4 lands on a landing target (main mode 4, sub mode 9).
    pub const AUTO_PRECLAND: Self = Self::Px4(0x0904_0000);
    /// PX4 has stopped its motors for good, by a failsafe or a command (main mode 10).
    pub const TERMINATION: Self = Self::Px4(10 << 16);

    /// True when the autopilot follows setpoints.
    pub fn is_guided(self) -> bool {
        self == Self::Guided || self == Self::OFFBOARD
    }

    /// True when the autopilot lands.
    pub fn is_landing(self) -> bool {
        [Self::Land, Self::AUTO_LAND, Self::AUTO_PRECLAND].contains(&self)
    }

    /// The mode of `firmware` with this number.
    pub fn of(firmware: Firmware, custom_mode: u32) -> Self {
        match (firmware, custom_mode) {
            (Firmware::Copter, GUIDED) => Self::Guided,
            (Firmware::Copter, LAND) => Self::Land,
            (Firmware::Copter, number) => Self::Other(number),
            (Firmware::Px4 | Firmware::OtherPx4, number) => Self::Px4(number),
            (_, number) => Self::Foreign(number),
        }
    }

    /// The firmware's number of this mode.
    pub fn custom_mode(self) -> u32 {
        match self {
            Self::Guided => GUIDED,
            Self::Land => LAND,
            Self::Other(number) | Self::Px4(number) | Self::Foreign(number) => number,
        }
    }
}

impl fmt::Display for FlightMode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Guided => f.write_str("GUIDED"),
            Self::Land => f.write_str("LAND"),
            Self::Other(number) => match copter_name(*number) {
                Some(name) => f.write_str(name),
                None => write!(f, "mode {number}"),
            },
            Self::Px4(number) => match px4_name(*number) {
                Some(name) => write!(f, "PX4 {name}"),
                None => write!(f, "PX4 mode {number:#x}"),
            },
            Self::Foreign(number) => write!(f, "mode {number}"),
        }
    }
}

/// ArduPilot's enumeration COPTER_MODE.
fn copter_name(number: u32) -> Option<&'static str> {
    Some(match number {
        0 => "STABILIZE",
        1 => "ACRO",
        2 => "ALT_HOLD",
        3 => "AUTO",
        5 => "LOITER",
        6 => "RTL",
        7 => "CIRCLE",
        11 => "DRIFT",
        13 => "SPORT",
        14 => "FLIP",
        15 => "AUTOTUNE",
        16 => "POSHOLD",
        17 => "BRAKE",
        18 => "THROW",
        19 => "AVOID_ADSB",
        20 => "GUIDED_NOGPS",
        21 => "SMART_RTL",
        22 => "FLOWHOLD",
        23 => "FOLLOW",
        24 => "ZIGZAG",
        25 => "SYSTEMID",
        26 => "AUTOROTATE",
        27 => "AUTO_RTL",
        _ => return None,
    })
}

/// PX4's main and sub modes (`px4_custom_mode.h`).
fn px4_name(number: u32) -> Option<&'static str> {
    let [_, _, main, sub] = number.to_le_bytes();
    Some(match (main, sub) {
        (1, _) => "MANUAL",
        (2, _) => "ALTITUDE",
        (3, _) => "POSITION",
        (4, 2) => "TAKEOFF",
        (4, 3) => "HOLD",
        (4, 4) => "MISSION",
        (4, 5) => "RETURN",
        (4, 6) => "LAND",
        (4, 8) => "FOLLOW",
        (4, 9) => "PRECISION LAND",
        (4, 20) => "DESCEND",
        (5, _) => "ACRO",
        (6, _) => "OFFBOARD",
        (7, _) => "STABILIZED",
        (10, _) => "TERMINATION",
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mode_keeps_its_number_and_its_firmwares_name() {
        for (firmware, number, name) in [
            (Firmware::Copter, 4, "GUIDED"),
            (Firmware::Copter, 9, "LAND"),
            (Firmware::Copter, 5, "LOITER"),
            (Firmware::Copter, 99, "mode 99"),
            (Firmware::Px4, 6 << 16, "PX4 OFFBOARD"),
            (Firmware::Px4, 0x0604_0000, "PX4 LAND"),
            (Firmware::Px4, 10 << 16, "PX4 TERMINATION"),
            (Firmware::Px4, 0x1404_0000, "PX4 DESCEND"),
            (Firmware::OtherArduPilot, 4, "mode 4"),
        ] {
            let mode = FlightMode::of(firmware, number);
            assert_eq!(mode.custom_mode(), number);
            assert_eq!(mode.to_string(), name);
        }
    }

    #[test]
    fn each_supported_firmware_has_a_mode_for_setpoints_and_one_to_land() {
        for firmware in [Firmware::Copter, Firmware::Px4] {
            assert!(firmware.guided().is_some_and(FlightMode::is_guided));
            assert!(firmware.land().is_some_and(FlightMode::is_landing));
            assert!(firmware.precision_land().is_some_and(FlightMode::is_landing));
        }
        assert_eq!(Firmware::OtherPx4.guided(), None);
        assert!(!FlightMode::Px4(4).is_guided() && !FlightMode::Foreign(4).is_guided());
    }
}
