//! What the autopilot's packets say beside the vehicle's state: parameters, battery, texts.

use std::collections::BTreeMap;

use autopilot::dialect::{MavAutopilot, MavMessage, MavParamType};
use autopilot::{Battery, Packet, Parser};

/// Maximum number of texts that are kept; further ones are left out.
const MAX_TEXTS: usize = 2000;

/// The battery at a time.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Power {
    /// When it came, in nanoseconds of the recorder's clock.
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
    /// When it came, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// Whether it is a warning or worse.
    pub is_warning: bool,
    /// The text.
    pub text: String,
    /// Its number, of a text in several packets; 0 otherwise.
    id: u16,
}

/// What the autopilot's packets say.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Packets {
    /// How many there are.
    pub count: u64,
    /// Bytes of all.
    pub bytes: u64,
    /// When each came, in nanoseconds of the recorder's clock.
    pub received_ns: Vec<i64>,
    /// The last value of each parameter that was asked for.
    pub parameters: BTreeMap<String, f64>,
    /// The battery.
    pub power: Vec<Power>,
    /// What it said.
    pub texts: Vec<Text>,
    is_px4: bool,
}

impl Packets {
    /// Adds a packet that came at `received_ns`.
    pub fn take(&mut self, received_ns: i64, bytes: &[u8]) {
        self.count += 1;
        self.bytes += bytes.len() as u64;
        self.received_ns.push(received_ns);
        let packet = Packet::from_raw(bytes)
            .or_else(|| Parser::new().push(bytes).into_iter().next())
            .and_then(|packet| packet.message);
        match packet {
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
                let is_full = self.texts.len() >= MAX_TEXTS;
                match self.texts.last_mut() {
                    Some(last) if id != 0 && last.id == id => last.text.push_str(&text),
                    _ if is_full => {}
                    _ => self.texts.push(Text { received_ns, is_warning, text, id }),
                }
            }
            _ => {}
        }
    }
}
