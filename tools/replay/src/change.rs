//! The phases and setpoints that another configuration of the controller would have decided on a tape's events,
//! and how far they are from the recorded ones.
//!
//! The vehicle flies as it flew: the events after a decision are those of the flight that was recorded.

use std::ops::ControlFlow;

use flightlog::RecordedTape;
use messages::{Phase, TapeAction, TapeDecision, TapeEvent, TapeRecord, TapeTarget};

use crate::difference::Comparison;
use crate::run::{End, run_with};

/// A phase, and when it began.
#[derive(Clone, Debug, PartialEq)]
pub struct Begun {
    /// Since the tape began, in seconds.
    pub time_s: f64,
    /// The phase.
    pub phase: Phase,
    /// The reason, as a sentence.
    pub why: String,
}

/// The result of a replay, and how it differs from the recorded one.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Change {
    /// How far the replay came.
    pub end: End,
    /// The phases of the replay with their reasons.
    pub phases: Vec<Begun>,
    /// Events at which the decision is another one.
    pub different: u64,
    /// When the first of them was, since the begin, in seconds.
    pub first_s: Option<f64>,
    /// Events at which the packets for the autopilot or the reply are other ones, and the decision is the same.
    pub other_outputs: u64,
    /// Events at which the phase is another one.
    pub other_phase: u64,
    /// Greatest difference of the velocity setpoints, where there are both, in m/s.
    pub max_velocity_m_s: f64,
    /// Its root mean square, in m/s.
    pub rms_velocity_m_s: f64,
    /// Greatest horizontal difference of the estimated landing points, where there are both, in metres.
    pub max_target_m: f64,
}

/// Replays a tape, under its configuration with some settings `key=value` over it, and summarises the differences.
///
/// # Errors
/// As [`crate::run()`].
pub fn change(tape: &RecordedTape, set: &[String]) -> anyhow::Result<Change> {
    change_with(tape, set, |_event| None)
}

/// As [`change()`], with another event in the place of those for which `instead` has one.
///
/// # Errors
/// As [`crate::run()`].
pub fn change_with(
    tape: &RecordedTape,
    set: &[String],
    instead: impl FnMut(&TapeEvent<'_>) -> Option<TapeEvent<'static>>,
) -> anyhow::Result<Change> {
    let mut change = Change::default();
    let mut comparison = Comparison::default();
    let (mut squares, mut setpoints) = (0.0, 0.0);
    let end = run_with(tape, set, instead, |step| {
        let status = step.flight.status(step.recorded.now_ns);
        let is_new = change
            .phases
            .last()
            .is_none_or(|last| (last.phase, &last.why) != (status.phase, &status.why));
        if is_new {
            let (phase, why) = (status.phase, status.why);
            change.phases.push(Begun { time_s: step.time_s, phase, why });
        }
        let difference = comparison.next(step.recorded, step.replayed);
        let (then, now) = (comparison.recorded(), comparison.replayed());
        change.other_phase += u64::from(then.map(|it| it.phase) != now.map(|it| it.phase));
        if !comparison.is_same_decision() {
            change.different += 1;
            change.first_s.get_or_insert(step.time_s);
        } else if difference.is_some() && !is_state(step.recorded) {
            change.other_outputs += 1;
        }
        if let (Some(then), Some(now)) = (then.and_then(velocity), now.and_then(velocity)) {
            let away_m_s = distance(&then, &now);
            change.max_velocity_m_s = change.max_velocity_m_s.max(away_m_s);
            squares += away_m_s * away_m_s;
            setpoints += 1.0;
        }
        let target = |decision: Option<TapeDecision<'_>>| decision.and_then(|it| it.target);
        if let (Some(then), Some(now)) = (target(then), target(now)) {
            let position = |target: TapeTarget| {
                let [north_m, east_m, _] = target.position_ned_m;
                [north_m, east_m]
            };
            let away_m = distance(&position(then), &position(now));
            change.max_target_m = change.max_target_m.max(away_m);
        }
        ControlFlow::Continue(())
    })?;
    change.end = end;
    change.rms_velocity_m_s = if setpoints > 0.0 { f64::sqrt(squares / setpoints) } else { 0.0 };
    Ok(change)
}

/// Whether it is the controller's state, which is not published.
fn is_state(record: &TapeRecord<'_>) -> bool {
    matches!(record.event, TapeEvent::State(_))
}

fn velocity(decision: TapeDecision<'_>) -> Option<[f64; 3]> {
    match decision.action {
        TapeAction::Velocity { velocity_ned_m_s, .. } => Some(velocity_ned_m_s),
        _ => None,
    }
}

fn distance(one: &[f64], other: &[f64]) -> f64 {
    one.iter().zip(other).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}
