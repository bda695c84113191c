//! Computes the values of the report from a flight: frames, track, setpoints, phases as bands, and curves over
//! time with gaps.

use std::ops::Range;

use messages::{Phase, TapeAction};

use crate::chart::{At, Band, at};
use crate::flight::Flight;
use crate::frames::Frames;
use crate::phases;
use crate::summary::{self, Summary};
use crate::track::{self, EstimateError, TrackPoint};

/// Number of usual periods without a sample over which no line is drawn.
const MAX_GAP_PERIODS: f64 = 5.0;
/// Shortest time without a sample over which no line is drawn, in seconds.
const MIN_GAP_S: f64 = 0.5;
/// Time shown before the first phase of a landing, in seconds.
const BEFORE_S: f64 = 1.0;

/// Period in which a setpoint that stays is drawn again, in seconds: less than the gap that is drawn as missing.
const SETPOINT_PERIOD_S: f64 = 0.2;

/// A flight with the values computed from it.
#[derive(Clone, Debug)]
pub struct View<'a> {
    /// The flight.
    pub flight: &'a Flight,
    /// It in numbers.
    pub summary: Summary,
    /// The outcome of each frame.
    pub frames: Frames,
    /// Where the vehicle truly was.
    pub truth: Vec<TrackPoint>,
    /// Where it was by the estimate.
    pub estimated: Vec<TrackPoint>,
    /// The error of the estimate.
    pub errors: Vec<EstimateError>,
    /// The velocity setpoints.
    pub setpoints: Vec<Setpoint>,
    /// The shown time, in seconds since the landing began.
    pub time: Range<f64>,
}

/// A velocity setpoint.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Setpoint {
    /// When, in seconds since the landing began.
    pub time_s: f64,
    /// In local NED, in m/s; not a number where none is given.
    pub velocity_ned_m_s: [f64; 3],
}

impl<'a> View<'a> {
    /// A flight to show.
    pub fn new(flight: &'a Flight) -> Self {
        let frames = Frames::of(flight);
        let summary = summary::of(flight, &frames);
        Self {
            frames,
            truth: track::truth(flight),
            estimated: track::estimated(flight),
            errors: track::estimate_errors(flight),
            setpoints: setpoints(flight),
            time: time(flight, &summary.phases),
            summary,
            flight,
        }
    }

    /// The phases as bands of charts over time.
    pub fn bands(&self) -> Vec<Band> {
        let phases = self.summary.phases.iter();
        phases
            .map(|phase| Band { name: phase.name.clone(), from: phase.from_s, to: phase.to_s })
            .collect()
    }

    /// Whether a time is shown.
    pub fn is_shown(&self, time_s: f64) -> bool {
        self.time.contains(&time_s)
    }

    /// The shown points of a curve over time, which ends where samples are missing.
    pub fn curve<T>(&self, samples: &[T], of: impl Fn(&T) -> Option<At>) -> Vec<At> {
        let points = samples.iter().filter_map(of).filter(|point| self.is_shown(point.x));
        unbridged(&points.collect::<Vec<_>>(), |point| point.x, |point| *point)
    }

    /// A component of the setpoints over time.
    pub fn setpoint_curve(&self, axis: usize) -> Vec<At> {
        self.curve(&self.setpoints, |it| Some(at(it.time_s, component(it.velocity_ned_m_s, axis))))
    }
}

/// The points of samples, with one that is not a number where samples are missing: no line is drawn there.
pub fn unbridged<T>(samples: &[T], time_s: impl Fn(&T) -> f64, of: impl Fn(&T) -> At) -> Vec<At> {
    let mut drawn: Vec<At> = Vec::with_capacity(samples.len());
    for piece in pieces(samples, time_s) {
        drawn.extend(drawn.last().map(|last| at(last.x, f64::NAN)));
        drawn.extend(piece.iter().map(&of));
    }
    drawn
}

/// Samples in pieces in which none are missing.
pub fn pieces<T>(samples: &[T], time_s: impl Fn(&T) -> f64) -> Vec<&[T]> {
    let between = || {
        let pairs = samples.iter().zip(samples.iter().skip(1));
        pairs.map(|(it, next)| time_s(next) - time_s(it))
    };
    let usual_s = node::stats::quantile(&between().collect::<Vec<_>>(), 0.5).unwrap_or(0.0);
    let max_s = (MAX_GAP_PERIODS * usual_s).max(MIN_GAP_S);
    samples.chunk_by(|it, next| time_s(next) - time_s(it) <= max_s).collect()
}

/// A component of a vector.
pub fn component(vector: [f64; 3], axis: usize) -> f64 {
    vector.get(axis).copied().unwrap_or(f64::NAN)
}

/// From before the first phase of the flight to the last known time.
fn time(flight: &Flight, phases: &[phases::Phase]) -> Range<f64> {
    let lasts = [
        flight.statuses.last().map(|it| it.stamp_ns),
        flight.vehicle.last().map(|it| it.stamp_ns),
        flight.truth.last().map(|it| it.stamp_ns),
        flight.found.last().map(|it| it.message.header.stamp_ns),
    ];
    let end_s = lasts.into_iter().flatten().max().map_or(1.0, |last_ns| flight.at_s(last_ns));
    let begun = phases.iter().find(|phase| phase.name != Phase::Idle.name());
    let from_s = begun.map_or(0.0, |phase| phase.from_s - BEFORE_S);
    let end_s = flight.end_s().map_or(end_s, |it| it.min(end_s));
    from_s..end_s.max(from_s + 1.0)
}

/// The setpoints: each one of the tape, else those in the status.
fn setpoints(flight: &Flight) -> Vec<Setpoint> {
    const NONE: [f64; 3] = [f64::NAN; 3];
    let mut setpoints = Vec::new();
    for tape in &flight.tapes {
        let mut last = None::<Setpoint>;
        for record in tape.parts.iter().flat_map(messages::Tape::records).flatten() {
            let time_s = flight.at_s(record.now_ns);
            let velocity_ned_m_s = match (record.decision().map(|it| it.action), &last) {
                (Some(TapeAction::Velocity { velocity_ned_m_s, .. }), _) => velocity_ned_m_s,
                (Some(_), _) => NONE,
                // The tape has a decision only where it differs from the one before.
                (None, Some(last)) if time_s - last.time_s > SETPOINT_PERIOD_S => {
                    last.velocity_ned_m_s
                }
                (None, _) => continue,
            };
            let setpoint = Setpoint { time_s, velocity_ned_m_s };
            last = Some(setpoint);
            setpoints.push(setpoint);
        }
    }
    if setpoints.is_empty() {
        let is_flown = |status: &messages::ControllerStatus| {
            !matches!(status.phase, Phase::Idle | Phase::Final | Phase::Landed)
        };
        setpoints.extend(flight.statuses.iter().map(|status| {
            Setpoint {
                time_s: flight.at_s(status.stamp_ns),
                velocity_ned_m_s: status
                    .setpoint
                    .filter(|_| is_flown(status))
                    .map_or(NONE, |setpoint| setpoint.velocity_ned_m_s),
            }
        }));
    }
    setpoints
}
