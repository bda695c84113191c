//! Parameters of the autopilot that are read, never written: asked for one after the other, a bounded number of times.

use crate::dialect::{MavMessage, MavParamType, PARAM_REQUEST_READ_DATA, PARAM_VALUE_DATA};
use crate::mode::Firmware;

/// How long an answer may take.
const ANSWER_NS: i64 = 500_000_000;
/// How often each is asked for.
const ATTEMPTS: u32 = 6;

/// What is known of a parameter.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Parameter {
    /// Not asked for, or its answer is awaited.
    Unknown,
    /// It does not answer: this autopilot has none of this name, or is deaf.
    Silent,
    /// Its value.
    Value(f64),
}

/// The parameters that are asked for.
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

    /// Asks for everything anew.
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

    /// The next question, if one is due.
    pub(crate) fn ask(&mut self, now_ns: i64, system: u8, component: u8) -> Option<MavMessage> {
        if now_ns < self.due_ns {
            return None;
        }
        let waits = |wanted: &&mut Wanted| wanted.value.is_none() && wanted.attempts <= ATTEMPTS;
        // The one that was asked for least, so that a silent one holds up no other.
        let wanted = self.list.iter_mut().filter(waits).min_by_key(|wanted| wanted.attempts)?;
        wanted.attempts += 1;
        self.due_ns = now_ns.saturating_add(ANSWER_NS);
        (wanted.attempts <= ATTEMPTS).then(|| {
            MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
                param_index: -1,
                target_system: system,
                target_component: component,
                param_id: wanted.name.into(),
            })
        })
    }

    /// Takes a value that is told, whoever asked for it.
    pub(crate) fn take(&mut self, firmware: Firmware, message: &PARAM_VALUE_DATA) {
        let name = message.param_id.to_str().unwrap_or_default();
        let Some(wanted) = self.list.iter_mut().find(|wanted| wanted.name == name) else { return };
        let is_whole = message.param_type == MavParamType::MAV_PARAM_TYPE_INT32;
        let value = match firmware {
            // PX4 puts a whole number's bits where the float is.
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
    fn what_does_not_answer_is_asked_for_a_few_times_and_holds_up_no_other() {
        let mut parameters = Parameters::new(&["A", "B"]);
        let mut asked = Vec::new();
        for now_ns in (0..20_000_000_000).step_by(100_000_000) {
            if let Some(MavMessage::PARAM_REQUEST_READ(request)) = parameters.ask(now_ns, 1, 1) {
                let name = request.param_id.to_str().unwrap().to_owned();
                if name == "B" {
                    let answer = value("B", 3.0, MavParamType::MAV_PARAM_TYPE_INT8);
                    parameters.take(Firmware::Copter, &answer);
                }
                asked.push(name);
            }
        }
        assert_eq!(asked.iter().filter(|name| *name == "B").count(), 1);
        assert_eq!(asked.len(), 1 + ATTEMPTS as usize);
        assert_eq!(parameters.get("A"), Parameter::Silent);
        assert_eq!(parameters.get("B"), Parameter::Value(3.0));
        assert_eq!(parameters.get("C"), Parameter::Unknown);
        parameters.restart();
        assert_eq!(parameters.get("B"), Parameter::Unknown);
    }

    #[test]
    fn px4_tells_whole_numbers_by_their_bits() {
        let mut parameters = Parameters::new(&["PLD_SRCH_TOUT"]);
        let told = value("PLD_SRCH_TOUT", f32::from_bits(7), MavParamType::MAV_PARAM_TYPE_INT32);
        parameters.take(Firmware::Px4, &told);
        assert_eq!(parameters.get("PLD_SRCH_TOUT"), Parameter::Value(7.0));
    }
}
