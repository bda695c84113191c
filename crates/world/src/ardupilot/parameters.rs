//! Defines the few parameters that the simulated autopilot obeys, under the names, units and defaults of ArduPilot, and
//! one of PX4.

use autopilot::dialect::MavParamType;

/// A parameter that can be read and set over the link.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Parameter {
    /// Seconds on the ground with nothing to do, until the motors are switched off.
    DisarmDelay,
    /// Seconds without a setpoint until the vehicle brakes.
    GuidedTimeout,
    /// PX4's seconds without a setpoint until it holds its place.
    OffboardLoss,
    /// Height below which LAND descends slowly, in cm.
    LandAltLow,
    /// Final speed of LAND, in cm/s.
    LandSpeed,
    /// First speed of LAND, in cm/s; 0 takes the descent speed of missions.
    LandSpeedHigh,
    /// Whether it lands on a reported target (1) or not (0).
    PrecisionLanding,
    /// Where that target comes from: 1 is MAVLink.
    PrecisionType,
    /// Largest horizontal jerk, in m/s^3.
    JerkXy,
    /// Largest vertical jerk, in m/s^3.
    JerkZ,
    /// Number of this system.
    SystemId,
    /// Horizontal acceleration, in cm/s^2.
    Acceleration,
    /// Vertical acceleration, in cm/s^2.
    AccelerationZ,
    /// Horizontal speed of missions, in cm/s.
    Speed,
    /// Descent speed of missions, in cm/s.
    SpeedDown,
    /// Climb speed, in cm/s.
    SpeedUp,
}

/// Name, type, default, minimum and maximum.
type Row = (Parameter, &'static str, MavParamType, f32, f32, f32);

const REAL: MavParamType = MavParamType::MAV_PARAM_TYPE_REAL32;
const INT8: MavParamType = MavParamType::MAV_PARAM_TYPE_INT8;
const INT16: MavParamType = MavParamType::MAV_PARAM_TYPE_INT16;

const TABLE: [Row; 16] = [
    (Parameter::DisarmDelay, "DISARM_DELAY", INT8, 10.0, 0.0, 127.0),
    (Parameter::GuidedTimeout, "GUID_TIMEOUT", REAL, 3.0, 0.1, 5.0),
    (Parameter::LandAltLow, "LAND_ALT_LOW", INT16, 1000.0, 100.0, 10_000.0),
    (Parameter::LandSpeed, "LAND_SPEED", INT16, 50.0, 30.0, 200.0),
    (Parameter::LandSpeedHigh, "LAND_SPEED_HIGH", INT16, 0.0, 0.0, 500.0),
    (Parameter::PrecisionLanding, "PLND_ENABLED", INT8, 0.0, 0.0, 1.0),
    (Parameter::PrecisionType, "PLND_TYPE", INT8, 0.0, 0.0, 4.0),
    (Parameter::JerkXy, "PSC_JERK_XY", REAL, 5.0, 1.0, 20.0),
    (Parameter::JerkZ, "PSC_JERK_Z", REAL, 5.0, 1.0, 20.0),
    (Parameter::SystemId, "SYSID_THISMAV", INT16, 1.0, 1.0, 255.0),
    (Parameter::Acceleration, "WPNAV_ACCEL", REAL, 250.0, 50.0, 500.0),
    (Parameter::AccelerationZ, "WPNAV_ACCEL_Z", REAL, 100.0, 50.0, 500.0),
    (Parameter::Speed, "WPNAV_SPEED", REAL, 1000.0, 10.0, 2000.0),
    (Parameter::SpeedDown, "WPNAV_SPEED_DN", REAL, 150.0, 10.0, 500.0),
    (Parameter::SpeedUp, "WPNAV_SPEED_UP", REAL, 250.0, 10.0, 1000.0),
    (Parameter::OffboardLoss, "COM_OF_LOSS_T", REAL, 1.0, 0.0, 60.0),
];

/// One parameter as the link shows it.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct ParameterValue {
    pub(super) index: u16,
    pub(super) name: &'static str,
    pub(super) kind: MavParamType,
    pub(super) value: f32,
}

/// All parameters with their values.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Parameters {
    values: [f32; TABLE.len()],
}

impl Parameters {
    /// How many there are.
    pub(super) const COUNT: u16 = TABLE.len() as u16;

    /// ArduPilot's defaults.
    pub(super) fn new() -> Self {
        Self { values: TABLE.map(|(.., value, _, _)| value) }
    }

    pub(super) fn get(&self, parameter: Parameter) -> f64 {
        let found = TABLE.iter().zip(self.values).find(|(row, _)| row.0 == parameter);
        f64::from(found.map_or(0.0, |(_, value)| value))
    }

    /// Sets a value, clamped to its range; NaN and infinity change nothing.
    pub(super) fn set(&mut self, name: &str, value: f32) -> Option<ParameterValue> {
        let index = TABLE.iter().position(|row| row.1 == name)?;
        let (.., min, max) = *TABLE.get(index)?;
        if value.is_finite() {
            *self.values.get_mut(index)? = value.clamp(min, max);
        }
        self.by_index(index)
    }

    pub(super) fn by_name(&self, name: &str) -> Option<ParameterValue> {
        self.by_index(TABLE.iter().position(|row| row.1 == name)?)
    }

    pub(super) fn by_index(&self, index: usize) -> Option<ParameterValue> {
        let (_, name, kind, ..) = *TABLE.get(index)?;
        Some(ParameterValue { index: index as u16, name, kind, value: *self.values.get(index)? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_parameter_is_found_by_name_and_by_index() {
        let parameters = Parameters::new();
        for index in 0..usize::from(Parameters::COUNT) {
            let shown = parameters.by_index(index).unwrap();
            assert_eq!(parameters.by_name(shown.name), Some(shown));
            assert!(shown.name.len() <= 16);
        }
        assert_eq!(parameters.by_index(99), None);
        assert_eq!(parameters.get(Parameter::LandSpeed), 50.0);
    }

    #[test]
    fn values_stay_in_range() {
        let mut parameters = Parameters::new();
        assert_eq!(parameters.set("LAND_SPEED", 1e9).unwrap().value, 200.0);
        assert_eq!(parameters.set("LAND_SPEED", f32::NAN).unwrap().value, 200.0);
        assert_eq!(parameters.set("NO_SUCH", 1.0), None);
    }
}
