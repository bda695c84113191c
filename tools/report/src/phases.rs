//! Finds the phases of a flight with their reasons.

use serde::Serialize;

use crate::flight::Flight;

/// A phase, from its begin to that of the next.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Phase {
    /// Its short name.
    pub name: String,
    /// When it began, in seconds since the landing began.
    pub from_s: f64,
    /// When it ended, in seconds since the landing began.
    pub to_s: f64,
    /// Its reasons with the time at which each began, in order.
    pub reasons: Vec<Reason>,
}

/// A reason for a phase.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Reason {
    /// When it began, in seconds since the landing began.
    pub from_s: f64,
    /// As a sentence; where only its numbers change, with the last.
    pub why: String,
}

/// Whether two reasons differ in their numbers at most: that of a climb contains its height.
pub fn is_same(one: &str, other: &str) -> bool {
    let is_number = |c: &char| c.is_ascii_digit() || *c == '.';
    one.chars().filter(|c| !is_number(c)).eq(other.chars().filter(|c| !is_number(c)))
}

/// The phases of a flight.
pub fn of(flight: &Flight) -> Vec<Phase> {
    let mut phases: Vec<Phase> = Vec::new();
    for status in &flight.statuses {
        let (name, from_s) = (status.phase.name(), flight.at_s(status.stamp_ns));
        let reason = || Reason { from_s, why: status.why.clone() };
        match phases.last_mut() {
            Some(last) if last.name == name => {
                last.to_s = from_s;
                match last.reasons.last_mut() {
                    Some(last) if is_same(&last.why, &status.why) => {
                        last.why.clone_from(&status.why);
                    }
                    _ => last.reasons.push(reason()),
                }
            }
            last => {
                if let Some(last) = last {
                    last.to_s = from_s;
                }
                let (name, reasons) = (name.to_owned(), vec![reason()]);
                phases.push(Phase { name, from_s, to_s: from_s, reasons });
            }
        }
    }
    phases
}
