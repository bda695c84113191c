//! Names the first value in which the replayed result of an event differs from the recorded one.

use autopilot::Parser;
use messages::{TapeDecision, TapeEvent, TapeRecord};
use serde_json::Value;

/// Longest value that is shown, in characters.
const MAX_SHOWN: usize = 120;

/// A value that differs.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Difference {
    /// Its name.
    pub field: String,
    /// Its recorded value.
    pub recorded: String,
    /// Its replayed value.
    pub replayed: String,
}

/// Compares results, and remembers the latest decisions: a tape has each only once.
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    recorded: Vec<u8>,
    replayed: Vec<u8>,
}

impl Comparison {
    /// The first difference between the recorded and the replayed result; `None` when they are the same to the bit.
    pub fn next(
        &mut self,
        recorded: &TapeRecord<'_>,
        replayed: &TapeRecord<'_>,
    ) -> Option<Difference> {
        for (latest, record) in [(&mut self.recorded, recorded), (&mut self.replayed, replayed)] {
            if !record.decision.is_empty() {
                latest.clear();
                latest.extend_from_slice(&record.decision);
            }
        }
        if !self.is_same_decision() {
            let (old, new) = (as_json(&self.recorded), as_json(&self.replayed));
            return Some(value("decision", &old, &new).unwrap_or_else(|| Difference {
                field: "decision".to_owned(),
                recorded: shown(&old),
                replayed: shown(&new),
            }));
        }
        if recorded.packets != replayed.packets {
            return Some(packets(&recorded.packets, &replayed.packets));
        }
        if let (TapeEvent::State(old), TapeEvent::State(new)) = (&recorded.event, &replayed.event) {
            let json = |state| serde_json::to_value(state).unwrap_or(Value::Null);
            return value("state", &json(old), &json(new));
        }
        (recorded.reply != replayed.reply).then(|| Difference {
            field: "reply".to_owned(),
            recorded: format!("{:?}", recorded.reply),
            replayed: format!("{:?}", replayed.reply),
        })
    }

    /// Whether the decision is the same then and now.
    pub fn is_same_decision(&self) -> bool {
        self.recorded == self.replayed
    }

    /// The decision that the tape has.
    pub fn recorded(&self) -> Option<TapeDecision<'_>> {
        TapeDecision::from_bytes(&self.recorded)
    }

    /// The decision of the replay.
    pub fn replayed(&self) -> Option<TapeDecision<'_>> {
        TapeDecision::from_bytes(&self.replayed)
    }
}

fn as_json(decision: &[u8]) -> Value {
    TapeDecision::from_bytes(decision)
        .and_then(|decision| serde_json::to_value(decision).ok())
        .unwrap_or(Value::Null)
}

/// The first value that differs, by its path.
fn value(path: &str, recorded: &Value, replayed: &Value) -> Option<Difference> {
    match (recorded, replayed) {
        (Value::Object(old), Value::Object(new)) if old.keys().eq(new.keys()) => {
            let mut pairs = old.iter().zip(new.values());
            pairs.find_map(|((key, old), new)| value(&format!("{path}.{key}"), old, new))
        }
        (Value::Array(old), Value::Array(new)) if old.len() == new.len() => {
            let mut pairs = old.iter().zip(new).enumerate();
            pairs.find_map(|(at, (old, new))| value(&format!("{path}[{at}]"), old, new))
        }
        (old, new) if old == new => None,
        (old, new) => {
            Some(Difference { field: path.to_owned(), recorded: shown(old), replayed: shown(new) })
        }
    }
}

fn shown(value: &Value) -> String {
    match value {
        Value::Null => "nothing".to_owned(),
        value => cut(&value.to_string()),
    }
}

fn cut(text: &str) -> String {
    match text.char_indices().nth(MAX_SHOWN) {
        Some((at, _)) => format!("{}...", text.get(..at).unwrap_or_default()),
        None => text.to_owned(),
    }
}

/// The first difference between the packets for the autopilot.
fn packets(recorded: &[u8], replayed: &[u8]) -> Difference {
    let read = |bytes: &[u8]| Parser::new().push(bytes);
    let (old, new) = (read(recorded), read(replayed));
    let at = old.iter().zip(&new).take_while(|(old, new)| old.raw == new.raw).count();
    let name = |packet: Option<&autopilot::Packet>| {
        packet.map_or("nothing".to_owned(), |packet| packet.name().unwrap_or("unknown").to_owned())
    };
    let (old, new) = (old.get(at), new.get(at));
    let field = format!("packet {} for the autopilot", at + 1);
    let (name_then, name_now) = (name(old), name(new));
    if name_then != name_now {
        return Difference { field, recorded: name_then, replayed: name_now };
    }
    let text = |packet: Option<&autopilot::Packet>| {
        packet.and_then(|packet| packet.message.as_ref()).map(|message| format!("{message:?}"))
    };
    let (text_then, text_now) = (text(old).unwrap_or_default(), text(new).unwrap_or_default());
    let mut parts = text_then.split(", ").zip(text_now.split(", "));
    match parts.find(|(then, now)| then != now) {
        Some((then, now)) => Difference {
            field: format!("{field}, {name_then}"),
            recorded: cut(then),
            replayed: cut(now),
        },
        None => {
            let sequence =
                |packet: Option<&autopilot::Packet>| packet.map_or(0, |packet| packet.sequence);
            Difference {
                field: format!("{field}, {name_then}, its sequence number"),
                recorded: sequence(old).to_string(),
                replayed: sequence(new).to_string(),
            }
        }
    }
}
