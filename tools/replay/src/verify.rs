//! Finds the first event that gives another result than when it was recorded.

use std::ops::ControlFlow;

use flightlog::RecordedTape;

use crate::difference::{Comparison, Difference};
use crate::run::{End, Stop, run};

/// What a verification found.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// How far it came, and why it went no further.
    pub end: End,
}

impl Verdict {
    /// True when every event of the tape gives the same result to the bit.
    pub fn is_verified(&self) -> bool {
        self.end.stop.is_none()
    }
}

/// Replays a tape, under its configuration with some settings `key=value` over it, up to the first difference.
///
/// # Errors
/// When the configuration cannot be used.
pub fn verify(tape: &RecordedTape, set: &[String]) -> anyhow::Result<Verdict> {
    let mut comparison = Comparison::default();
    let end = run(tape, set, |step| match comparison.next(step.recorded, step.replayed) {
        None => ControlFlow::Continue(()),
        Some(Difference { field, recorded, replayed }) => ControlFlow::Break(Stop::Different {
            number: step.recorded.number,
            event: step.recorded.event.name(),
            time_s: step.time_s,
            field,
            recorded,
            replayed,
        }),
    })?;
    Ok(Verdict { end })
}
