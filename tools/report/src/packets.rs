//! Collects from the recorded packets of the autopilot its parameters, battery, texts and arrival times.

use std::collections::BTreeMap;

use autopilot::dialect::{MavAutopilot, MavMessage, MavParamType};
use autopilot::{Battery, Packet, Parser};
use flightlog::OwnAutopilot;

/// The arrival of a packet.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// When, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// Its length in bytes.
    pub bytes: usize,
}

/// The battery at a time.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Power {
    /// When it was received, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// Voltage, in volts.
    pub voltage_v: Option<f64>,
    /// Current, in amperes.
    pub current_a: Option<f64>,
    /// Remaining charge, from 0 to 1.
    pub remaining: Option<f64>,
}

/// A text of the autopilot.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Text {
    /// When it was received, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// Whether it is a warning or worse.
    pub is_warning: bool,
    /// The text.
    pub text: String,
    /// Its number, of a text in several packets; 0 otherwise.
    id: u16,
}

/// The contents of the autopilot's packets.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Packets {
    /// Each of them.
    pub received: Vec<Arrival>,
    /// The last value of each requested parameter.
    pub parameters: BTreeMap<String, f64>,
    /// The battery.
    pub power: Vec<Power>,
    /// Its status texts.
    pub texts: Vec<Text>,
    /// Distinguishes its packets from others on its link.
    pub(crate) own: OwnAutopilot,
    is_px4: bool,
}

impl Packets {
    /// Adds a packet that was received at `received_ns`, if the vehicle's autopilot has sent it.
    pub fn take(&mut self, received_ns: i64, bytes: &[u8]) {
        let parsed =
            Packet::from_raw(bytes).or_else(|| Parser::new().push(bytes).into_iter().next());
        let Some(packet) = parsed.filter(|packet| self.own.has_sent(packet)) else { return };
        self.received.push(Arrival { received_ns, bytes: bytes.len() });
        match packet.message {
            Some(MavMessage::HEARTBEAT(heartbeat)) => {
                self.is_px4 |= heartbeat.autopilot == MavAutopilot::MAV_AUTOPILOT_PX4;
            }
            Some(MavMessage::PARAM_VALUE(value)) => {
                let is_whole = value.param_type == MavParamType::MAV_PARAM_TYPE_INT32;
                // PX4 sends the bits of an integer in the place of the float.
                let number = match self.is_px4 && is_whole {
                    true => f64::from(value.param_value.to_bits().cast_signed()),
                    false => f64::from(value.param_value),
                };
                if let Ok(name) = value.param_id.to_str() {
                    self.parameters.insert(name.to_owned(), number);
                }
            }
            Some(MavMessage::SYS_STATUS(status)) => {
                let Battery { voltage_v, current_a, remaining } = Battery::from_status(&status);
                if voltage_v.is_some() || remaining.is_some() {
                    self.power.push(Power { received_ns, voltage_v, current_a, remaining });
                }
            }
            Some(MavMessage::STATUSTEXT(part)) => {
                let bytes: &[u8] = &*part.text;
                let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
                let text = String::from_utf8_lossy(bytes.get(..end).unwrap_or(bytes)).into_owned();
                // From 0, the worst, to 7.
                let is_warning = part.severity as u32 <= 4;
                let id = part.id;
                match self.texts.last_mut() {
                    Some(last) if id != 0 && last.id == id => last.text.push_str(&text),
                    _ => self.texts.push(Text { received_ns, is_warning, text, id }),
                }
            }
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use autopilot::dialect::{
        CharArray, HEARTBEAT_DATA, PARAM_VALUE_DATA, STATUSTEXT_DATA, SYS_STATUS_DATA,
    };
    use autopilot::{Sender, packet};

    use super::*;

    #[test]
    fn texts_of_other_systems_on_the_link_are_left_out() {
        let mut packets = Packets::default();
        for (system, component) in [(7, 1), (8, 1), (7, 154)] {
            let text = MavMessage::STATUSTEXT(STATUSTEXT_DATA {
                text: format!("of {system} {component}").as_str().into(),
                ..STATUSTEXT_DATA::default()
            });
            let parameter = MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
                param_id: CharArray::from("NAME"),
                param_value: f32::from(system) + f32::from(component),
                ..PARAM_VALUE_DATA::default()
            });
            let battery = MavMessage::SYS_STATUS(SYS_STATUS_DATA {
                voltage_battery: 1000 * u16::from(system),
                battery_remaining: 50,
                ..SYS_STATUS_DATA::default()
            });
            let heartbeat = MavMessage::HEARTBEAT(HEARTBEAT_DATA::default());
            for message in [heartbeat, text, parameter, battery] {
                let sender = Sender { system, component };
                packets.take(3, &packet::encode(sender, 0, &message));
            }
        }
        assert_eq!((packets.received.len(), packets.power.len()), (4, 1));
        assert_eq!(packets.power[0].voltage_v, Some(7.0));
        assert_eq!(packets.parameters.get("NAME"), Some(&8.0));
        assert_eq!(packets.texts.len(), 1);
        assert_eq!(packets.texts[0].text, "of 7 1");
    }
}
