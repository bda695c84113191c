//! Keeps the faults of a flight that have begun.

use super::kind::Kind;
use super::plan::Fault;

/// A fault that has begun.
#[derive(Copy, Clone, Debug)]
pub struct Begun {
    /// The fault.
    pub fault: Fault,
    /// When it began, in seconds.
    pub at_s: f64,
}

impl Begun {
    /// True while it is active.
    pub fn is_on(&self, now_s: f64) -> bool {
        self.is_on_later(now_s, 0.0, 0.0)
    }

    /// True from `begin_s` after its begin to `end_s` after its end.
    pub fn is_on_later(&self, now_s: f64, begin_s: f64, end_s: f64) -> bool {
        (self.at_s + begin_s..self.at_s + self.fault.for_s + end_s).contains(&now_s)
    }
}

/// The faults of a flight that have begun.
#[derive(Clone, Debug, Default)]
pub struct BegunFaults {
    begun: Vec<Begun>,
}

impl BegunFaults {
    /// A fault begins.
    pub fn begin(&mut self, now_s: f64, fault: Fault) {
        self.begun.push(Begun { fault, at_s: now_s });
    }

    /// All, also those that are over.
    pub fn all(&self) -> &[Begun] {
        &self.begun
    }

    /// The fault of this kind that is on.
    pub fn on(&self, kind: Kind, now_s: f64) -> Option<&Begun> {
        self.begun.iter().find(|begun| begun.fault.kind == kind && begun.is_on(now_s))
    }

    /// True while a fault of this kind is on.
    pub fn is_on(&self, kind: Kind, now_s: f64) -> bool {
        self.on(kind, now_s).is_some()
    }

    /// The value in a range, from start to end, by the size of a fault; 0 while it is off.
    pub fn value(&self, kind: Kind, now_s: f64, range: std::ops::RangeInclusive<f64>) -> f64 {
        let (start, end) = range.into_inner();
        self.on(kind, now_s).map_or(0.0, |begun| start + (end - start) * begun.fault.size)
    }
}
