//! What a camera makes of a sharp edge between black and white.

use std::sync::LazyLock;

use crate::optics::normal;

/// The edge's profile has ended at this many standard deviations.
pub(crate) const END: f64 = 3.75;
const PER_UNIT: f64 = 64.0;
const NODES: usize = 2 * (END as usize + 1) * PER_UNIT as usize + 1;
const FIRST: f64 = -(END as usize as f64 + 1.0);

/// A straight edge through a Gaussian blur, averaged over the area of a pixel.
///
/// Both together have the variance of the blur plus a twelfth of a pixel on every axis; that a pixel is a box and not
/// a Gaussian is in the fourth cumulant, which depends on the edge's direction (Edgeworth's series).
#[derive(Copy, Clone, Debug)]
pub(crate) struct Step {
    nodes: &'static [[f64; 2]; NODES],
}

/// Variance of a pixel's own extent, in square pixels.
pub(crate) const PIXEL_VARIANCE: f64 = 1.0 / 12.0;

/// Fourth cumulant of a pixel's extent along the unit vector `normal`, over 24 times the square of the whole variance.
#[inline]
pub(crate) fn boxiness(normal: [f64; 2], variance: f64) -> f64 {
    let [x, y] = normal.map(|n| n * n);
    -(x * x + y * y) / (120.0 * 24.0 * variance * variance)
}

impl Step {
    pub(crate) fn new() -> Self {
        static NORMAL: LazyLock<[[f64; 2]; NODES]> = LazyLock::new(|| {
            let mut nodes = [[0.0; 2]; NODES];
            for (i, node) in nodes.iter_mut().enumerate() {
                let z = FIRST + i as f64 / PER_UNIT;
                *node = [normal::cumulative(z), normal::density(z)];
            }
            nodes
        });
        Self { nodes: &NORMAL }
    }

    /// The step's height at `z` standard deviations on its bright side, from 0 to 1, and its slope, for an edge of
    /// this [`boxiness`].
    #[inline]
    pub(crate) fn at(&self, z: f64, boxiness: f64) -> (f64, f64) {
        if z.is_nan() || z.abs() >= END {
            return (if z > 0.0 { 1.0 } else { 0.0 }, 0.0);
        }
        let place = (z - FIRST) * PER_UNIT;
        let index = (place + 0.5) as usize;
        let Some([whole, density]) = self.nodes.get(index) else { return (0.0, 0.0) };
        let near = FIRST + index as f64 / PER_UNIT;
        let d = z - near;
        let height = whole + density * d * (1.0 - 0.5 * d * near);
        let slope = density * (1.0 - d * near);
        let square = z * z;
        let third = z * (square - 3.0);
        let fourth = square * (square - 6.0) + 3.0;
        (height - boxiness * third * slope, slope * (1.0 + boxiness * fourth))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_a_box_it_is_the_normal_distribution() {
        let step = Step::new();
        for (z, expected) in [
            (0.0, 0.5),
            (1.0, 0.841_344_746_068_543),
            (-2.0, 0.022_750_131_948_179),
            (3.011, 0.998_698_055_737),
            (9.0, 1.0),
            (-9.0, 0.0),
            (f64::NAN, 0.0),
        ] {
            assert!(
                (step.at(z, 0.0).0 - expected).abs() < 1e-8
                    || z.abs() > END && expected == f64::from(u8::from(z > 0.0)),
                "{z}"
            );
        }
        for i in -370..370 {
            let z = f64::from(i) * 0.01 + 0.003;
            let slope = (step.at(z + 1e-4, -0.01).0 - step.at(z - 1e-4, -0.01).0) / 2e-4;
            assert!((step.at(z, -0.01).1 - slope).abs() < 1e-4, "{z}");
        }
    }

    /// A step averaged over pixels numerically, upright and at 30 degrees.
    #[test]
    fn a_blurred_step_over_a_pixel_is_met_to_a_thousandth() {
        let step = Step::new();
        for (blur, allowed) in [(0.3, 4e-3), (0.5, 6e-4), (0.8, 1e-4), (1.5, 1e-5)] {
            for angle in [0.0_f64, 0.5] {
                let (y, x) = angle.sin_cos();
                let variance: f64 = blur * blur + PIXEL_VARIANCE;
                for i in -20..20 {
                    let at = f64::from(i) * 0.1;
                    let mut mean = 0.0;
                    for k in 0..1600 {
                        let (dx, dy) = (f64::from(k % 40) - 19.5, f64::from(k / 40) - 19.5);
                        mean += normal::cumulative((at + (x * dx + y * dy) / 40.0) / blur) / 1600.0;
                    }
                    let (height, _) = step.at(at / variance.sqrt(), boxiness([x, y], variance));
                    assert!(
                        (height - mean).abs() < allowed,
                        "{blur} {angle} {at} {}",
                        height - mean
                    );
                }
            }
        }
    }
}
