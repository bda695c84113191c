//! What a detection saw on its way: for people, and for the debug images.

use geometry::Pixel;
use imaging::Ellipse;

use crate::observation::Observation;
use crate::ring::Ring;

/// What the last detection saw.
#[derive(Clone, Debug, Default)]
pub struct Trace {
    /// The contours that are ellipses.
    pub ellipses: Vec<Ellipse>,
    /// The pairs of ellipses that are rings.
    pub rings: Vec<Ring>,
    /// The pairs of concentric ellipses that are not, and the candidates that did not hold; no more than
    /// [`Trace::MOST_REFUSALS`].
    pub refusals: Vec<Refusal>,
    /// The markers found: centre and outer edge.
    pub markers: Vec<TracedMarker>,
}

/// A candidate that was refused.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Refusal {
    /// Its ellipses.
    pub ellipses: [Ellipse; 2],
    /// The first check that failed.
    pub reason: Reason,
}

/// Why two ellipses are no ring, or a ring is no marker.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Reason {
    /// Their shapes differ (Algorithm 3).
    Eccentricity,
    /// Their orientations differ (Algorithm 4).
    Orientation,
    /// The ratio of their axes is no ring's (Algorithm 5).
    Type,
    /// What lies between them is not black (Algorithm 6), or what lies around is not white.
    Blackness,
    /// No circle in space looks like this.
    Pose,
    /// The edges are not where a marker of this size and pose has them.
    Edges,
    /// It lies in a marker that was found already.
    Repeated,
}

/// A marker found.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct TracedMarker {
    /// The projection of its centre.
    pub centre: Pixel,
    /// Its diameter in pixels.
    pub size_px: f64,
}

impl Trace {
    /// How many refusals are kept.
    pub const MOST_REFUSALS: usize = 256;

    pub(crate) fn clear(&mut self) {
        self.ellipses.clear();
        self.rings.clear();
        self.refusals.clear();
        self.markers.clear();
    }

    pub(crate) fn refuse(&mut self, first: Ellipse, second: Ellipse, reason: Reason) {
        if self.refusals.len() < Self::MOST_REFUSALS {
            self.refusals.push(Refusal { ellipses: [first, second], reason });
        }
    }
}

impl From<&Observation> for TracedMarker {
    fn from(observation: &Observation) -> Self {
        Self { centre: observation.centre, size_px: observation.size_px }
    }
}
