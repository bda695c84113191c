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
    /// As a sentence; where only its numbers change, from the first to the last: `climbing, 0 to 10 m`.
    pub why: String,
}

/// Whether two reasons differ in their numbers at most: that of a climb contains its height.
pub fn is_same(one: &str, other: &str) -> bool {
    let is_number = |c: &char| c.is_ascii_digit() || *c == '.';
    one.chars().filter(|c| !is_number(c)).eq(other.chars().filter(|c| !is_number(c)))
}

/// A reason whose numbers changed, from the first text to the last.
fn from_to(first: &str, last: &str) -> String {
    fn parts(text: &str) -> Vec<&str> {
        let is_number = |c: char| c.is_ascii_digit() || c == '.';
        let mut parts = Vec::new();
        let mut rest = text;
        while let Some(c) = rest.chars().next() {
            let end = rest.find(|it| is_number(it) != is_number(c)).unwrap_or(rest.len());
            let (part, after) = rest.split_at(end);
            parts.push(part);
            rest = after;
        }
        parts
    }
    let (from, to) = (parts(first), parts(last));
    // Numbers at other places are of another sentence.
    if from.len() != to.len() {
        return last.to_owned();
    }
    let joined = |(from, to): (&str, &str)| match from == to {
        true => to.to_owned(),
        false => format!("{from} to {to}"),
    };
    from.into_iter().zip(to).map(joined).collect()
}

/// The phases of a flight.
pub fn of(flight: &Flight) -> Vec<Phase> {
    let mut phases: Vec<Phase> = Vec::new();
    // The text with which the last reason began.
    let mut first = "";
    for status in &flight.statuses {
        let (name, from_s) = (status.phase.name(), flight.at_s(status.stamp_ns));
        let why = status.why.as_str();
        let reason = || Reason { from_s, why: why.to_owned() };
        match phases.last_mut() {
            Some(last) if last.name == name => {
                last.to_s = from_s;
                match last.reasons.last_mut() {
                    Some(last) if is_same(first, why) => last.why = from_to(first, why),
                    _ => {
                        first = why;
                        last.reasons.push(reason());
                    }
                }
            }
            last => {
                if let Some(last) = last {
                    last.to_s = from_s;
                }
                first = why;
                let (name, reasons) = (name.to_owned(), vec![reason()]);
                phases.push(Phase { name, from_s, to_s: from_s, reasons });
            }
        }
    }
    phases
}

#[cfg(test)]
mod tests {
    use messages::ControllerStatus;

    use super::*;

    #[test]
    fn a_reason_whose_numbers_change_has_the_first_and_the_last() {
        let mut flight = Flight::default();
        for (stamp_ns, why) in (0..).zip([
            "climbing, 0 m of 10 m",
            "climbing, 4.5 m of 10 m",
            "climbing, 9.5 m of 10 m",
            "above 10 m. Waiting 3 s",
            "above 10 m. Waiting 3 s",
        ]) {
            let why = why.to_owned();
            flight.statuses.push(ControllerStatus { stamp_ns, why, ..ControllerStatus::default() });
        }
        let phases = of(&flight);
        let reasons: Vec<&str> = phases[0].reasons.iter().map(|it| it.why.as_str()).collect();
        assert_eq!(reasons, ["climbing, 0 to 9.5 m of 10 m", "above 10 m. Waiting 3 s"]);
        assert_eq!(from_to("1 of 2 (3)", "1 of 2 ()"), "1 of 2 ()");
    }
}
