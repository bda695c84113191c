//! Defines the three rings of the thesis' marker.

/// Inner and outer radius of the three rings, outer ring first, in units of `x`, the inner radius of the innermost ring
/// (Table 3.1). The marker's size is twice the outermost radius.
pub const RING_RADII: [(f64, f64); 3] = [(40.0, 50.0), (15.0, 25.0), (1.0, 3.0)];

/// Which of the marker's three rings.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum RingKind {
    /// For large distances; inner radius 4/5 of the outer one.
    Outer,
    /// Between the others; inner radius 3/5 of the outer one.
    Middle,
    /// For small distances; inner radius 1/3 of the outer one.
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
