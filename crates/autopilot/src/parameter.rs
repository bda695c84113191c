//! Reads parameters of the autopilot and sets them, one after the other, with a bounded rate of requests.

use libm::fmax;

use crate::dialect::{
    MavMessage, MavParamType, PARAM_REQUEST_READ_DATA, PARAM_SET_DATA, PARAM_VALUE_DATA,
};
use crate::mode::Firmware;

/// Timeout of a reply, in nanoseconds.
const REPLY_TIMEOUT_NS: i64 = 500_000_000;
/// Maximum number of parameters that are read.
const MAX_PARAMETERS: usize = 64;
/// Number of requests after which a parameter counts as silent.
const ATTEMPTS: u32 = 6;
/// Time between the requests for silent ones, in nanoseconds: all the packets of the first seconds may have been lost.
const SILENT_NS: i64 = 10_000_000_000;

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

/// Relative difference up to which a value is the one that was set: the link carries 32-bit floats.
const TOLERANCE: f64 = 1e-5;

/// The requested parameters.
#[derive(Clone, Debug, Default)]
pub(crate) struct Parameters {
    list: Vec<Requested>,
    due_ns: i64,
}

#[derive(Clone, Debug)]
struct Requested {
    name: &'static str,
    attempts: u32,
    value: Option<f64>,
    /// The value to set, until the autopilot reports it or the attempts are used up.
    set: Option<f64>,
    /// The attempts of the last value to set were used up, and it has not been reported since.
    is_unanswered: bool,
}

impl Requested {
    fn new(name: &'static str) -> Self {
        Self { name, attempts: 0, value: None, set: None, is_unanswered: false }
    }

    fn is_pending(&self) -> bool {
        self.attempts <= ATTEMPTS && (self.value.is_none() || self.set.is_some())
    }

    fn is_silent(&self) -> bool {
        self.attempts > ATTEMPTS && self.value.is_none()
    }

    fn request(&self, system: u8, component: u8) -> MavMessage {
        match self.set {
            Some(value) => MavMessage::PARAM_SET(PARAM_SET_DATA {
                param_value: value as f32,
                target_system: system,
                target_component: component,
                param_id: self.name.into(),
                param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
            }),
            None => MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
                param_index: -1,
                target_system: system,
                target_component: component,
                param_id: self.name.into(),
            }),
        }
    }
}

impl Parameters {
    pub(crate) fn new(names: &[&'static str]) -> Self {
        Self { list: names.iter().map(|name| Requested::new(name)).collect(), due_ns: i64::MIN }
    }

    /// Adds parameters to read; those that are known already stay as they are.
    pub(crate) fn add(&mut self, names: &[&'static str]) {
        for name in names {
            if self.list.len() < MAX_PARAMETERS && self.list.iter().all(|known| known.name != *name)
            {
                self.list.push(Requested::new(name));
                self.due_ns = i64::MIN;
            }
        }
    }

    /// Requests everything again.
    pub(crate) fn restart(&mut self) {
        let names: Vec<_> = self.list.iter().map(|requested| requested.name).collect();
        *self = Self::new(&names);
    }

    pub(crate) fn get(&self, name: &str) -> Parameter {
        match self.list.iter().find(|requested| requested.name == name) {
            Some(Requested { value: Some(value), .. }) => Parameter::Value(*value),
            Some(requested) if requested.is_silent() => Parameter::Silent,
            _ => Parameter::Unknown,
        }
    }

    /// Sets one of the parameters that are read; it must be a 32-bit float. Until the autopilot reports the
    /// value it is sent again, a bounded number of times.
    pub(crate) fn set(&mut self, name: &str, value: f64) {
        if let Some(requested) = self.list.iter_mut().find(|requested| requested.name == name)
            && requested.set.is_none_or(|set| !is_same(set, value))
        {
            requested.set = Some(value);
            requested.is_unanswered = false;
            requested.attempts = 0;
            self.due_ns = i64::MIN;
        }
    }

    /// True while a value is being set.
    pub(crate) fn is_setting(&self, name: &str) -> bool {
        let is_it = |requested: &&Requested| requested.name == name;
        self.list
            .iter()
            .find(is_it)
            .is_some_and(|requested| requested.set.is_some() && requested.is_pending())
    }

    /// True when a value was set as often as it may be, and none has been reported since.
    pub(crate) fn is_unanswered(&self, name: &str) -> bool {
        self.list.iter().any(|requested| requested.name == name && requested.is_unanswered)
    }

    /// The next request, if one is due.
    pub(crate) fn request(&mut self, now_ns: i64, system: u8, component: u8) -> Option<MavMessage> {
        if now_ns < self.due_ns {
            return None;
        }
        // A value to set comes first; then the one with the fewest requests, so that a silent one does not
        // delay the others.
        let requested = self
            .list
            .iter_mut()
            .filter(|requested| requested.is_pending() || requested.is_silent());
        let requested = requested.min_by_key(|requested| {
            (requested.is_silent(), requested.set.is_none(), requested.attempts)
        })?;
        let was_silent = requested.is_silent();
        requested.attempts = requested.attempts.saturating_add(1);
        let pause_ns = if was_silent { SILENT_NS } else { REPLY_TIMEOUT_NS };
        self.due_ns = now_ns.saturating_add(pause_ns);
        if !was_silent && requested.attempts > ATTEMPTS {
            requested.is_unanswered = requested.set.take().is_some();
            return None;
        }
        Some(requested.request(system, component))
    }

    /// Handles a value, also one that another client requested.
    pub(crate) fn take(&mut self, firmware: Firmware, message: &PARAM_VALUE_DATA) {
        let name = message.param_id.to_str().unwrap_or_default();
        let Some(requested) = self.list.iter_mut().find(|requested| requested.name == name) else {
            return;
        };
        let is_integer = message.param_type == MavParamType::MAV_PARAM_TYPE_INT32;
        let value = match firmware {
            // PX4 sends the bits of an integer instead of a float.
            Firmware::Px4 if is_integer => f64::from(message.param_value.to_bits().cast_signed()),
            _ => f64::from(message.param_value),
        };
        if value.is_finite() {
            let was_silent = requested.is_silent();
            requested.value = Some(value);
            requested.is_unanswered = false;
            // Before the first request it answers another one.
            let is_answer = requested.attempts > 0;
            requested.set = requested.set.filter(|set| !(is_answer && is_same(*set, value)));
            self.due_ns = i64::MIN;
            // The link works now, so the others may answer as well.
            for other in self.list.iter_mut().filter(|other| was_silent && other.is_silent()) {
                other.attempts = 0;
            }
        }
    }
}

fn is_same(a: f64, b: f64) -> bool {
    (a - b).abs() <= TOLERANCE * fmax(a.abs(), b.abs())
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
    fn a_silent_parameter_is_requested_a_few_times_and_then_rarely_and_delays_no_other() {
        let mut parameters = Parameters::new(&["A", "B"]);
        let mut requests = Vec::new();
        for now_ns in (0..10_000_000_000).step_by(100_000_000) {
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
        // The first of the rare ones comes at once.
        assert_eq!(requests.len(), 2 + ATTEMPTS as usize);
        assert_eq!(parameters.get("A"), Parameter::Silent);
        assert_eq!(parameters.get("B"), Parameter::Value(3.0));
        assert_eq!(parameters.get("C"), Parameter::Unknown);
        // Packets that begin to arrive after a minute.
        let late = (10..70).filter(|s| parameters.request(s * 1_000_000_000, 1, 1).is_some());
        assert_eq!(late.count(), 6);
        assert!(parameters.request(75_000_000_000, 1, 1).is_some());
        parameters.take(Firmware::Copter, &value("A", 4.0, MavParamType::MAV_PARAM_TYPE_REAL32));
        assert_eq!(parameters.get("A"), Parameter::Value(4.0));
        assert!(parameters.request(90_000_000_000, 1, 1).is_none());
        let mut silent = Parameters::new(&["A", "B", "C"]);
        let asked = (0..60).filter(|s| silent.request(s * 1_000_000_000, 1, 1).is_some()).count();
        assert!(asked >= 3 * ATTEMPTS as usize);
        silent.take(Firmware::Copter, &value("B", 4.0, MavParamType::MAV_PARAM_TYPE_REAL32));
        assert_eq!(silent.get("C"), Parameter::Unknown, "the link works now");
        let quick =
            (0..20).filter(|i| silent.request(60_000_000_000 + i * 500_000_000, 1, 1).is_some());
        assert!(quick.count() >= 2 * ATTEMPTS as usize);
        parameters.restart();
        assert_eq!(parameters.get("B"), Parameter::Unknown);
    }

    #[test]
    fn px4_sends_integers_by_their_bits() {
        let mut parameters = Parameters::new(&["PLD_SRCH_TOUT"]);
        let integer = value("PLD_SRCH_TOUT", f32::from_bits(7), MavParamType::MAV_PARAM_TYPE_INT32);
        parameters.take(Firmware::Px4, &integer);
        assert_eq!(parameters.get("PLD_SRCH_TOUT"), Parameter::Value(7.0));
    }

    #[test]
    fn a_value_is_set_until_it_is_reported_and_a_limited_number_of_times() {
        let mut parameters = Parameters::new(&["GUID_TIMEOUT"]);
        let real = |x| value("GUID_TIMEOUT", x, MavParamType::MAV_PARAM_TYPE_REAL32);
        parameters.take(Firmware::Copter, &real(3.0));
        parameters.set("GUID_TIMEOUT", 0.5);
        parameters.set("OTHER", 0.5);
        let Some(MavMessage::PARAM_SET(set)) = parameters.request(0, 1, 1) else { panic!() };
        assert_eq!((set.param_value, set.param_id.to_str()), (0.5, Ok("GUID_TIMEOUT")));
        // A report of the old value, as after a lost packet, does not end it; the new one does.
        parameters.take(Firmware::Copter, &real(3.0));
        assert!(parameters.is_setting("GUID_TIMEOUT"));
        parameters.take(Firmware::Copter, &real(0.5));
        assert!(!parameters.is_setting("GUID_TIMEOUT"));
        assert_eq!(parameters.get("GUID_TIMEOUT"), Parameter::Value(0.5));
        // An autopilot that refuses reports the old value again and again.
        parameters.set("GUID_TIMEOUT", 0.2);
        let mut sent = 0;
        for now_ns in (0..20_000_000_000).step_by(100_000_000) {
            if parameters.request(now_ns, 1, 1).is_some() {
                sent += 1;
                parameters.take(Firmware::Copter, &real(0.5));
            }
        }
        assert_eq!(sent, ATTEMPTS as usize);
        assert!(!parameters.is_setting("GUID_TIMEOUT"));
        assert_eq!(parameters.get("GUID_TIMEOUT"), Parameter::Value(0.5));
    }

    #[test]
    fn a_value_that_is_known_already_is_sent_all_the_same_and_silence_is_no_confirmation() {
        let mut parameters = Parameters::new(&["GUID_TIMEOUT"]);
        let real = |x| value("GUID_TIMEOUT", x, MavParamType::MAV_PARAM_TYPE_REAL32);
        parameters.take(Firmware::Copter, &real(3.0));
        parameters.set("GUID_TIMEOUT", 3.0);
        parameters.take(Firmware::Copter, &real(3.0));
        assert!(parameters.is_setting("GUID_TIMEOUT"), "nothing was sent yet");
        for now_ns in (0..20_000_000_000).step_by(100_000_000) {
            assert!(!parameters.is_unanswered("GUID_TIMEOUT") || now_ns >= 3_000_000_000);
            parameters.request(now_ns, 1, 1);
        }
        assert!(parameters.is_unanswered("GUID_TIMEOUT") && !parameters.is_setting("GUID_TIMEOUT"));
        parameters.set("GUID_TIMEOUT", 3.0);
        assert!(parameters.request(30_000_000_000, 1, 1).is_some());
        parameters.take(Firmware::Copter, &real(3.0));
        assert!(
            !parameters.is_unanswered("GUID_TIMEOUT") && !parameters.is_setting("GUID_TIMEOUT")
        );
    }
}
