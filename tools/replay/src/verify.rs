//! Finds the first event that gives another result than when it was recorded.

use std::ops::ControlFlow;

use flightlog::RecordedTape;
use messages::TapeEvent;

use crate::difference::{Comparison, Difference};
use crate::run::{End, Stop, run};

/// The result of a verification.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// How far it came, and why it stopped.
    pub end: End,
    /// The first state of the controller that is another one, a [`Stop::Different`]. The results may still be the same.
    pub other_state: Option<Stop>,
}

impl Verdict {
    /// True when every event of the tape gives the same result to the bit, and the controller's state is the same.
    pub fn is_verified(&self) -> bool {
        self.end.stop.is_none() && self.other_state.is_none()
    }
}

/// Replays a tape, under its configuration with some settings `key=value` over it, up to the first difference.
///
/// # Errors
/// As [`run`].
pub fn verify(tape: &RecordedTape, set: &[String]) -> anyhow::Result<Verdict> {
    let mut comparison = Comparison::default();
    let mut other_state = None;
    let end = run(tape, set, |step| {
        let Some(difference) = comparison.next(step.recorded, step.replayed) else {
            return ControlFlow::Continue(());
        };
        let Difference { field, recorded, replayed } = difference;
        let stop = Stop::Different {
            number: step.recorded.number,
            event: step.recorded.event.name(),
            time_s: step.time_s,
            field,
            recorded,
            replayed,
        };
        if matches!(step.recorded.event, TapeEvent::State(_)) {
            other_state.get_or_insert(stop);
            return ControlFlow::Continue(());
        }
        ControlFlow::Break(stop)
    })?;
    Ok(Verdict { end, other_state })
}
