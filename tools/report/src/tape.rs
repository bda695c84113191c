//! Replays the controller's tape: whether it gives the same decisions, and the status, estimates and states that were not recorded.

use std::ops::ControlFlow;

use messages::{ControllerStatus, TapeEvent, TargetEstimate, VehicleState};
use replay::{Verdict, run, verify};

use crate::flight::{Flight, Replayed};

/// Period of the status while its phase stays, in nanoseconds: as the controller publishes it.
const STATUS_PERIOD_NS: i64 = 200_000_000;
/// Minimum period of the vehicle's state, in nanoseconds.
const VEHICLE_PERIOD_NS: i64 = 18_000_000;

/// Replays the tapes of a flight: whether they verify, and status, estimates and the vehicle's state where the recording
/// has the tapes alone.
pub fn replay_tapes(flight: &mut Flight) {
    flight.other_boots.iter_mut().for_each(replay_tapes);
    let mut texts = Vec::new();
    let mut is_verified = true;
    let is_alone = flight.statuses.is_empty();
    let lacks = is_alone || flight.vehicle.is_empty() || flight.targets.is_empty();
    let mut rebuilt = Rebuilt::default();
    for tape in &flight.tapes {
        let (is_valid, text) = match verify(tape, &[]) {
            Ok(verdict) => (verdict.is_verified(), describe(&verdict)),
            Err(error) => (false, format!("the tape cannot be replayed: {error:#}")),
        };
        is_verified &= is_valid;
        texts.push(text);
        if lacks {
            // A difference was reported above; the time before it is rebuilt.
            let _ = run(tape, &[], |step| {
                rebuilt.take(step.recorded.now_ns, &step.recorded.event, step.flight);
                ControlFlow::Continue(())
            });
        }
    }
    if !texts.is_empty() {
        flight.replayed = Some(Replayed { is_verified, text: texts.join("; ") });
    }
    if is_alone && !rebuilt.statuses.is_empty() {
        flight.is_rebuilt = true;
        flight.statuses = rebuilt.statuses;
        flight.set_zero();
    }
    if flight.targets.is_empty() {
        flight.targets = rebuilt.targets;
    }
    if flight.vehicle.is_empty() {
        flight.vehicle = rebuilt.vehicle;
    }
}

/// The messages that a controller would have published.
#[derive(Default)]
struct Rebuilt {
    statuses: Vec<ControllerStatus>,
    targets: Vec<TargetEstimate>,
    vehicle: Vec<VehicleState>,
    vehicle_ns: Option<i64>,
}

impl Rebuilt {
    fn take(&mut self, now_ns: i64, event: &TapeEvent<'_>, flight: &controller::flight::Flight) {
        if matches!(event, TapeEvent::Detections { .. }) {
            self.targets.push(flight.target(now_ns));
        }
        let is_due = |before_ns: Option<i64>, period_ns: i64| {
            before_ns.is_none_or(|before_ns| now_ns.saturating_sub(before_ns) >= period_ns)
        };
        if is_due(self.vehicle_ns, VEHICLE_PERIOD_NS)
            && let Some(vehicle) = flight.vehicle()
        {
            self.vehicle_ns = Some(now_ns);
            self.vehicle.push(vehicle);
        }
        if matches!(event, TapeEvent::Tick) {
            let status = flight.status(now_ns);
            let last = self.statuses.last();
            let is_new = last.is_none_or(|last| last.phase != status.phase);
            if is_new || is_due(last.map(|last| last.stamp_ns), STATUS_PERIOD_NS) {
                self.statuses.push(status);
            }
        }
    }
}

/// A verdict as a sentence.
fn describe(verdict: &Verdict) -> String {
    let Verdict { end, other_state } = verdict;
    let theirs = format!("{} {}", end.program, end.build);
    let ours = format!("{} {}", controller::tape::program(), controller::tape::build());
    let other = match theirs == ours || end.program.is_empty() {
        true => String::new(),
        false => format!(" (recorded by {theirs}, replayed by {ours})"),
    };
    if let Some(difference) = end.stop.as_ref().or(other_state.as_ref()) {
        return format!("tape not verified: {difference}{other}");
    }
    let no_end = match end.is_ended {
        true => "",
        false => ", but it has no end: later events are not known",
    };
    format!("tape verified to the bit, {} events{no_end}{other}", end.events)
}

#[cfg(test)]
mod tests {
    use super::*;
    use replay::{End, Stop};

    #[test]
    fn only_a_tape_that_is_the_same_to_its_end_is_verified_without_a_reservation() {
        let end = End { events: 7, is_ended: true, ..End::default() };
        let complete = Verdict { end: end.clone(), other_state: None };
        assert_eq!(describe(&complete), "tape verified to the bit, 7 events");
        let open = Verdict { end: End { is_ended: false, ..end }, ..complete.clone() };
        assert!(describe(&open).contains("it has no end"), "{}", describe(&open));
        let other = Verdict { other_state: Some(Stop::NoBeginning { first: 3 }), ..complete };
        assert!(describe(&other).starts_with("tape not verified: "), "{}", describe(&other));
    }
}
