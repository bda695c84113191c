//! Finds rings in an image.

use geometry::Pixel;
use imaging::Ellipse;
use markers::RingKind;

/// A black ring in an image: two concentric ellipses.
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

    /// The marker's diameter in pixels along the major axis, from this ring's outer edge.
    pub fn marker_size_px(&self) -> f64 {
        self.outer.major / (2.0 * self.kind.radii().1)
    }
}
