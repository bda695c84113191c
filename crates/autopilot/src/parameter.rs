//! Reads parameters of the autopilot, one after the other, with a bounded number of requests; never writes
//! them.

use crate::dialect::{MavMessage, MavParamType, PARAM_REQUEST_READ_DATA, PARAM_VALUE_DATA};
use crate::mode::Firmware;

/// Timeout of a reply, in nanoseconds.
const REPLY_TIMEOUT_NS: i64 = 500_000_000;
/// Maximum number of requests for each parameter.
const ATTEMPTS: u32 = 6;

/// The state of a parameter.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Parameter {
    /// Not requested, or the reply is pending.
    Unknown,
    /// No reply: the autopilot has no parameter of this name, or does not receive our packets.
    Silent,
    /// Its value.
    Value(f64),
}

/// The requested parameters.
#[derive(Clone, Debug, Default)]
pub(crate) struct Parameters {
    list: Vec<Wanted>,
    due_ns: i64,
}

#[derive(Clone, Debug)]
struct Wanted {
    name: &'static str,
    attempts: u32,
    value: Option<f64>,
}

impl Parameters {
    pub(crate) fn new(names: &[&'static str]) -> Self {
        let wanted = |name: &&'static str| Wanted { name, attempts: 0, value: None };
        Self { list: names.iter().map(wanted).collect(), due_ns: i64::MIN }
    }

    /// Requests everything again.
    pub(crate) fn restart(&mut self) {
        let names: Vec<_> = self.list.iter().map(|wanted| wanted.name).collect();
        *self = Self::new(&names);
    }

    pub(crate) fn get(&self, name: &str) -> Parameter {
        match self.list.iter().find(|wanted| wanted.name == name) {
            Some(Wanted { value: Some(value), .. }) => Parameter::Value(*value),
            Some(wanted) if wanted.attempts > ATTEMPTS => Parameter::Silent,
            _ => Parameter::Unknown,
        }
    }

    /// The next request, if one is due.
    pub(crate) fn request(&mut self, now_ns: i64, system: u8, component: u8) -> Option<MavMessage> {
        if now_ns < self.due_ns {
            return None;
        }
        let waits = |wanted: &&mut Wanted| wanted.value.is_none() && wanted.attempts <= ATTEMPTS;
        // The one with the fewest requests, so that a silent one does not delay the others.
        let wanted = self.list.iter_mut().filter(waits).min_by_key(|wanted| wanted.attempts)?;
        wanted.attempts += 1;
        self.due_ns = now_ns.saturating_add(REPLY_TIMEOUT_NS);
        (wanted.attempts <= ATTEMPTS).then(|| {
            MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
                param_index: -1,
                target_system: system,
                target_component: component,
                param_id: wanted.name.into(),
            })
        })
    }

    /// Handles a value, whoever requested it.
    pub(crate) fn take(&mut self, firmware: Firmware, message: &PARAM_VALUE_DATA) {
        let name = message.param_id.to_str().unwrap_or_default();
        let Some(wanted) = self.list.iter_mut().find(|wanted| wanted.name == name) else { return };
        let is_whole = message.param_type == MavParamType::MAV_PARAM_TYPE_INT32;
        let value = match firmware {
            // PX4 sends the bits of an integer in the place of the float.
            Firmware::Px4 if is_whole => f64::from(message.param_value.to_bits().cast_signed()),
            _ => f64::from(message.param_value),
        };
        if value.is_finite() {
            wanted.value = Some(value);
            self.due_ns = i64::MIN;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn value(name: &str, value: f32, param_type: MavParamType) -> PARAM_VALUE_DATA {
        PARAM_VALUE_DATA {
            param_value: value,
            param_id: name.into(),
            param_type,
            ..Default::default()
        }
    }

    #[test]
    fn a_silent_parameter_is_requested_a_few_times_and_delays_no_other() {
        let mut parameters = Parameters::new(&["A", "B"]);
        let mut requests = Vec::new();
        for now_ns in (0..20_000_000_000).step_by(100_000_000) {
            if let Some(MavMessage::PARAM_REQUEST_READ(request)) = parameters.request(now_ns, 1, 1)
            {
                let name = request.param_id.to_str().unwrap().to_owned();
                if name == "B" {
                    let answer = value("B", 3.0, MavParamType::MAV_PARAM_TYPE_INT8);
                    parameters.take(Firmware::Copter, &answer);
                }
                requests.push(name);
            }
        }
        assert_eq!(requests.iter().filter(|name| *name == "B").count(), 1);
        assert_eq!(requests.len(), 1 + ATTEMPTS as usize);
        assert_eq!(parameters.get("A"), Parameter::Silent);
        assert_eq!(parameters.get("B"), Parameter::Value(3.0));
        assert_eq!(parameters.get("C"), Parameter::Unknown);
        parameters.restart();
        assert_eq!(parameters.get("B"), Parameter::Unknown);
    }

    #[test]
    fn px4_tells_whole_numbers_by_their_bits() {
        let mut parameters = Parameters::new(&["PLD_SRCH_TOUT"]);
        let integer = value("PLD_SRCH_TOUT", f32::from_bits(7), MavParamType::MAV_PARAM_TYPE_INT32);
        parameters.take(Firmware::Px4, &integer);
        assert_eq!(parameters.get("PLD_SRCH_TOUT"), Parameter::Value(7.0));
    }
}
