//! The controller's configuration as parameters of the companion (<https://mavlink.io/en/services/parameter.html>).
//!
//! They can be read only: a landing is decided with the configuration with which it began. All are REAL32, because ground
//! stations read other types from the bytes of a float or from its value, depending on the autopilot.

use std::collections::BTreeSet;

use autopilot::dialect::{
    MavMessage, MavParamType, PARAM_REQUEST_LIST_DATA, PARAM_REQUEST_READ_DATA, PARAM_SET_DATA,
    PARAM_VALUE_DATA,
};
use autopilot::{Packet, Sender};
use messages::Configuration;
use toml::{Table, Value};

use crate::parameter_table::{Parameter, TABLE};

/// Maximum length of a configuration that is read, in bytes.
const MAX_TOML: usize = 200_000;
/// Values sent at once; a list shares the line with the autopilot's list.
const BURST: usize = 3;
/// MAVLink component id of the autopilot.
const AUTOPILOT: u8 = 1;
/// Silence of its controller after which another one's configuration is shown, in nanoseconds; it is repeated every 3 s.
const CONTROLLER_TIMEOUT_NS: i64 = 10_000_000_000;

/// A parameter with its value.
#[derive(Copy, Clone, Debug, PartialEq)]
struct Entry {
    parameter: &'static Parameter,
    value: f32,
}

impl Entry {
    /// The value, for a person: with its unit or its word.
    fn meaning(&self) -> String {
        // `value` made the number from the place of the word.
        match self.parameter.words.get(self.value as usize) {
            Some(word) => format!("{} = {word}", self.value),
            None => format!("{} {}", self.value, self.parameter.unit()).trim_end().to_owned(),
        }
    }
}

/// A ground station's request for the companion's parameters.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Ask {
    /// All of them.
    List,
    /// One, by its name.
    Named(String),
    /// One, by its index.
    Numbered(u16),
    /// To change one.
    Set {
        /// Its name.
        name: String,
        /// The requested value.
        value: f32,
    },
}

impl Ask {
    /// The request for the parameters of the companion in a packet; a list is asked of all components at once.
    pub(crate) fn of(packet: &Packet, companion: Sender) -> Option<Self> {
        let message = packet.message.as_ref()?;
        let is_for = |system: u8, component: u8| {
            (system == 0 || system == companion.system) && component == companion.component
        };
        Some(match message {
            MavMessage::PARAM_REQUEST_LIST(PARAM_REQUEST_LIST_DATA {
                target_system,
                target_component,
            }) if is_for(*target_system, *target_component)
                || is_for(*target_system, companion.component) && *target_component == 0 =>
            {
                Self::List
            }
            MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
                target_system,
                target_component,
                param_id,
                param_index,
            }) if is_for(*target_system, *target_component) => match u16::try_from(*param_index) {
                Ok(number) => Self::Numbered(number),
                Err(_) => Self::Named(param_id.to_str().ok()?.to_owned()),
            },
            MavMessage::PARAM_SET(PARAM_SET_DATA {
                target_system,
                target_component,
                param_id,
                param_value,
                ..
            }) if is_for(*target_system, *target_component) => {
                Self::Set { name: param_id.to_str().ok()?.to_owned(), value: *param_value }
            }
            _ => return None,
        })
    }
}

/// Whether a packet asks the vehicle's autopilot, its companion or all its components for all parameters: so begins a ground station.
pub(crate) fn begins(packet: &Packet, companion: Sender) -> bool {
    let Some(MavMessage::PARAM_REQUEST_LIST(list)) = &packet.message else { return false };
    [0, companion.system].contains(&list.target_system)
        && [0, AUTOPILOT, companion.component].contains(&list.target_component)
}

/// The answer to a request.
#[derive(Clone, Debug, Default, PartialEq)]
pub(crate) struct Answer {
    /// The present value, if it was requested.
    pub(crate) message: Option<MavMessage>,
    /// Why nothing was changed or found, for a person.
    pub(crate) why: Option<String>,
}

/// The parameters of the companion.
#[derive(Debug, Default)]
pub(crate) struct Parameters {
    /// The controller whose configuration it is, and when that was received.
    controller: Option<(String, i64)>,
    /// Those of the table that the configuration has.
    list: Vec<Entry>,
    /// Indices of those that are to be sent.
    due: BTreeSet<u16>,
    /// A ground station has asked for the list.
    is_listed: bool,
}

impl Parameters {
    /// Takes a controller's configuration. False for one that cannot be read.
    pub(crate) fn update(&mut self, now_ns: i64, configuration: &Configuration) -> bool {
        let is_silent =
            |received_ns: i64| now_ns.saturating_sub(received_ns) > CONTROLLER_TIMEOUT_NS;
        if let Some((instance, received_ns)) = &self.controller
            && *instance != configuration.instance
            && !is_silent(*received_ns)
        {
            return true;
        }
        if configuration.toml.len() > MAX_TOML {
            return false;
        }
        let Ok(table) = configuration.toml.parse::<Table>() else { return false };
        let entry = |parameter| Some(Entry { parameter, value: value(&table, parameter)? });
        let list: Vec<Entry> = TABLE.iter().filter_map(entry).collect();
        self.controller = Some((configuration.instance.clone(), now_ns));
        if self.is_listed {
            let is_other = list.len() != self.list.len();
            let indices = (0..).zip(&list).filter(|(index, entry)| {
                is_other || self.list.get(usize::from(*index)) != Some(entry)
            });
            let changed: Vec<u16> = indices.map(|(index, _)| index).collect();
            self.due.extend(changed);
        }
        self.list = list;
        true
    }

    /// Answers a request of a ground station; a list is sent in small groups by `due`.
    pub(crate) fn answer(&mut self, ask: &Ask) -> Answer {
        let index = match ask {
            Ask::List => {
                self.is_listed = true;
                self.due = (0..).take(self.list.len()).collect();
                return Answer::default();
            }
            Ask::Numbered(index) => Some(*index),
            Ask::Named(name) | Ask::Set { name, .. } => (0..)
                .zip(&self.list)
                .find(|(_, it)| it.parameter.name == name)
                .map(|(index, _)| index),
        };
        let found = index.and_then(|index| Some((index, self.list.get(usize::from(index))?)));
        let why = match (ask, found) {
            (Ask::Set { name, .. } | Ask::Named(name), None) if !self.list.is_empty() => {
                Some(format!("there is no parameter {name}"))
            }
            (Ask::Numbered(index), None) if !self.list.is_empty() => {
                Some(format!("there is no parameter with the index {index}"))
            }
            (_, None) => Some("there are no parameters, no controller has published them".into()),
            (Ask::Set { value, .. }, Some((_, it))) if *value != it.value => Some(format!(
                "{} is read-only here ({}); change {} in the controller's configuration and restart it",
                it.parameter.name,
                it.meaning(),
                it.parameter.key
            )),
            _ => None,
        };
        let message = index.and_then(|index| self.value(index));
        // A ground station that reads a single value has lost it before, so it is sent once more.
        self.due.extend(index.filter(|_| message.is_some()));
        Answer { message, why }
    }

    /// The next values of a list that was asked for.
    pub(crate) fn due(&mut self) -> Vec<MavMessage> {
        let indices: Vec<u16> = self.due.iter().take(BURST).copied().collect();
        for index in &indices {
            self.due.remove(index);
        }
        indices.into_iter().filter_map(|index| self.value(index)).collect()
    }

    fn value(&self, index: u16) -> Option<MavMessage> {
        let Entry { parameter, value } = self.list.get(usize::from(index))?;
        Some(MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
            param_value: *value,
            param_count: self.list.len() as u16,
            param_index: index,
            param_id: parameter.name.into(),
            param_type: MavParamType::MAV_PARAM_TYPE_REAL32,
        }))
    }
}

/// A parameter's value in a configuration; none for a key or a word that this configuration does not have.
fn value(table: &Table, parameter: &Parameter) -> Option<f32> {
    let mut chunks = parameter.key.split('.');
    let first = table.get(chunks.next()?)?;
    match chunks.try_fold(first, |value, chunk| value.get(chunk))? {
        Value::Float(number) => Some(*number as f32),
        Value::Integer(number) => Some(*number as f32),
        Value::Boolean(is_on) => Some(f32::from(u8::from(*is_on))),
        Value::String(word) => {
            parameter.words.iter().position(|it| it == word).map(|index| index as f32)
        }
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::Parser;
    use autopilot::packet::encode;

    const COMPANION: Sender = Sender { system: 7, component: 191 };
    const GROUND: Sender = Sender { system: 255, component: 190 };
    const CONTROLLER: &str = include_str!("../../controller/controller.toml");

    fn configuration(instance: &str, toml: &str) -> Configuration {
        let text = String::new();
        Configuration {
            service: "controller".into(),
            instance: instance.into(),
            host: text.clone(),
            version: text,
            toml: toml.into(),
        }
    }

    fn parameters_of(toml: &str) -> Parameters {
        let mut parameters = Parameters::default();
        assert!(parameters.update(0, &configuration("main", toml)));
        parameters
    }

    fn data(message: &MavMessage) -> &PARAM_VALUE_DATA {
        match message {
            MavMessage::PARAM_VALUE(data) => data,
            other => panic!("{other:?}"),
        }
    }

    fn all(parameters: &mut Parameters) -> Vec<PARAM_VALUE_DATA> {
        let bursts = std::iter::from_fn(|| Some(parameters.due()).filter(|due| !due.is_empty()));
        bursts
            .inspect(|due| assert!(due.len() <= BURST))
            .flatten()
            .map(|it| data(&it).clone())
            .collect()
    }

    #[test]
    fn every_parameter_is_a_key_of_the_controller_and_has_a_name_of_its_own() {
        let mut parameters = parameters_of(CONTROLLER);
        assert_eq!(parameters.list.len(), TABLE.len());
        assert_eq!(parameters.answer(&Ask::List), Answer::default());
        let listed = all(&mut parameters);
        assert_eq!(listed.len(), TABLE.len());
        let mut names = BTreeSet::new();
        for (index, value) in (0..).zip(&listed) {
            assert_eq!(usize::from(value.param_count), TABLE.len());
            assert_eq!(value.param_index, index);
            assert_eq!(value.param_type, MavParamType::MAV_PARAM_TYPE_REAL32);
            // Longer ones would be cut.
            assert_eq!(value.param_id.to_str(), Ok(TABLE[usize::from(index)].name));
            names.insert(value.param_id.to_str().unwrap());
        }
        assert_eq!(names.len(), TABLE.len());
    }

    #[test]
    fn words_are_numbers_in_the_order_in_which_the_controllers_file_explains_them() {
        for parameter in TABLE.iter().filter(|it| !it.words.is_empty()) {
            let (section, key) = parameter.key.split_once('.').unwrap_or(("", parameter.key));
            let header = if section.is_empty() { String::new() } else { format!("[{section}]\n") };
            for (number, word) in (0_u8..).zip(parameter.words) {
                let table: Table = format!("{header}{key} = '{word}'").parse().unwrap();
                assert_eq!(value(&table, parameter), Some(f32::from(number)), "{word}");
                assert!(CONTROLLER.contains(&format!("\"{word}\"")), "{word}");
            }
            let table: Table = format!("{header}{key} = 'another'").parse().unwrap();
            assert_eq!(value(&table, parameter), None);
        }
    }

    #[test]
    fn one_is_read_by_name_or_place_and_never_changed() {
        let mut parameters = parameters_of("start = 'resume'\n[metric]\nmax_descend_m_s = 2.0");
        let named = parameters.answer(&Ask::Named("AL_DESC_SPEED".into())).message.unwrap();
        let value = data(&named).clone();
        assert_eq!((value.param_value, value.param_count), (2.0, 2));
        let numbered = parameters.answer(&Ask::Numbered(value.param_index)).message.unwrap();
        assert_eq!(numbered, named);
        for (asked, name) in
            [(Ask::Numbered(2), "the index 2"), (Ask::Named("NONE".into()), "parameter NONE")]
        {
            let answer = parameters.answer(&asked);
            assert_eq!(answer.message, None);
            assert!(answer.why.unwrap().ends_with(name), "{asked:?}");
        }
        assert!(parameters.due().len() == 1, "only the one that was read is sent again");
        let none = Parameters::default().answer(&Ask::Numbered(0));
        assert!(none.message.is_none() && none.why.unwrap().contains("no controller"));
        for (wanted, is_refused) in
            [(9.0, true), (f32::NAN, true), (f32::INFINITY, true), (2.0, false)]
        {
            let set = Ask::Set { name: "AL_DESC_SPEED".into(), value: wanted };
            let answer = parameters.answer(&set);
            assert_eq!(answer.message.as_ref(), Some(&named), "{wanted}");
            assert_eq!(answer.why.is_some(), is_refused, "{wanted}");
            let why = answer.why.unwrap_or_else(|| "metric.max_descend_m_s".into());
            assert!(why.contains("metric.max_descend_m_s"), "{why}");
        }
        let unknown = parameters.answer(&Ask::Set { name: "NONE".into(), value: 1.0 });
        assert!(unknown.message.is_none() && unknown.why.unwrap().contains("NONE"));
    }

    #[test]
    fn an_attempt_to_set_a_parameter_is_answered_with_the_meaning_of_its_value_and_its_remedy() {
        let mut parameters = parameters_of(CONTROLLER);
        let mut set = |name: &str, value| {
            parameters.answer(&Ask::Set { name: name.into(), value }).why.unwrap()
        };
        let remedy = "in the controller's configuration and restart it";
        assert_eq!(
            set("AL_RETRIES", 3.0),
            format!("AL_RETRIES is read-only here (10); change phases.retries {remedy}")
        );
        assert_eq!(
            set("AL_DESC_SPEED", 1.0),
            format!(
                "AL_DESC_SPEED is read-only here (2 m/s); change metric.max_descend_m_s {remedy}"
            )
        );
        assert_eq!(
            set("AL_MODE", 1.0),
            format!("AL_MODE is read-only here (0 = guided); change mode {remedy}")
        );
        for parameter in TABLE {
            assert!(set(parameter.name, -7.0).len() < 190, "{}", parameter.name);
        }
    }

    #[test]
    fn changed_values_are_sent_to_a_ground_station_that_has_the_list() {
        let mut parameters = parameters_of("[metric]\nfunnel_m = 1.0\nblind_s = 2.0");
        assert!(
            parameters.update(1, &configuration("main", "[metric]\nfunnel_m = 1.0\nblind_s = 3.0"))
        );
        assert_eq!(parameters.due(), [], "no ground station has asked");
        parameters.answer(&Ask::List);
        assert_eq!(all(&mut parameters).len(), 2);
        assert!(
            parameters.update(2, &configuration("main", "[metric]\nfunnel_m = 1.0\nblind_s = 4.0"))
        );
        let changed = all(&mut parameters);
        assert_eq!(changed.iter().map(|it| it.param_value).collect::<Vec<_>>(), [4.0]);
        // Another controller in parallel is shown only when this one is silent.
        let other = configuration("spare", "[metric]\nfunnel_m = 7.0\nblind_s = 4.0");
        assert!(parameters.update(3, &other) && parameters.due().is_empty());
        assert!(parameters.update(3 + CONTROLLER_TIMEOUT_NS, &other));
        assert_eq!(all(&mut parameters).len(), 1);
        // An unreadable configuration changes nothing.
        assert!(!parameters.update(4 + CONTROLLER_TIMEOUT_NS, &configuration("spare", "[metric")));
        let long = " ".repeat(MAX_TOML + 1);
        assert!(!parameters.update(4 + CONTROLLER_TIMEOUT_NS, &configuration("spare", &long)));
        assert_eq!(parameters.list.len(), 2);
    }

    #[test]
    fn a_list_is_asked_of_all_components_and_the_rest_of_ours_alone() {
        let asked = |message: &MavMessage| {
            let packet = Parser::new().push(&encode(GROUND, 1, message)).remove(0);
            Ask::of(&packet, COMPANION)
        };
        let to = |target_system, target_component| {
            let list = PARAM_REQUEST_LIST_DATA { target_system, target_component };
            let read = PARAM_REQUEST_READ_DATA {
                target_system,
                target_component,
                param_index: -1,
                param_id: "SIXTEEN_LETTERS_".into(),
            };
            let set = PARAM_SET_DATA {
                target_system,
                target_component,
                param_id: "A".into(),
                param_value: 3.0,
                ..PARAM_SET_DATA::default()
            };
            [
                asked(&MavMessage::PARAM_REQUEST_LIST(list)),
                asked(&MavMessage::PARAM_REQUEST_READ(read)),
                asked(&MavMessage::PARAM_SET(set)),
            ]
        };
        let all = [
            Some(Ask::List),
            Some(Ask::Named("SIXTEEN_LETTERS_".into())),
            Some(Ask::Set { name: "A".into(), value: 3.0 }),
        ];
        assert_eq!(to(7, 191), all);
        assert_eq!(to(0, 191), all);
        assert_eq!(to(7, 0), [Some(Ask::List), None, None]);
        assert_eq!(to(7, 1), [None, None, None]);
        assert_eq!(to(8, 191), [None, None, None]);
    }
}
