//! The rings a marker is made of.

use geometry::Pixel;
use imaging::Ellipse;

use crate::drawing::RING_RADII;

/// Which of the marker's three rings.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum RingKind {
    /// Seen from afar; inner radius 4/5 of the outer one.
    Outer,
    /// Between the others; inner radius 3/5 of the outer one.
    Middle,
    /// Seen from close up; inner radius 1/3 of the outer one.
    Inner,
}

impl RingKind {
    /// All kinds, in the thesis' order (types 0, 1, 2).
    pub const ALL: [Self; 3] = [Self::Outer, Self::Middle, Self::Inner];

    /// Inner and outer radius in units of the marker's size (its outermost diameter).
    pub fn radii(self) -> (f64, f64) {
        let (inner, outer) = RING_RADII[self as usize];
        let size = 2.0 * RING_RADII[0].1;
        (inner / size, outer / size)
    }

    /// Inner radius in units of the outer one.
    pub fn ratio(self) -> f64 {
        let (inner, outer) = self.radii();
        inner / outer
    }
}

/// A black ring in an image: two ellipses about one another.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Ring {
    /// Which ring it is by the ratio of its axes.
    pub kind: RingKind,
    /// Mean of its ellipses' centres.
    pub centre: Pixel,
    /// Mean of its ellipses' angles, in radians.
    pub angle: f64,
    /// Its inner edge.
    pub inner: Ellipse,
    /// Its outer edge.
    pub outer: Ellipse,
}

impl Ring {
    /// The ring between two ellipses.
    pub fn new(kind: RingKind, inner: Ellipse, outer: Ellipse) -> Self {
        let mean = |axis: usize| (inner.centre[axis] + outer.centre[axis]) / 2.0;
        let centre = Pixel::new(mean(0), mean(1));
        Self { kind, centre, angle: (inner.angle + outer.angle) / 2.0, inner, outer }
    }

    /// The marker's diameter in the image, in pixels along the major axis, that this ring's outer edge speaks of.
    pub fn marker_size_px(&self) -> f64 {
        self.outer.major / (2.0 * self.kind.radii().1)
    }
}
