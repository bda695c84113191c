//! Computes the edge spread function: a camera's image of a sharp edge between black and white.

use std::sync::LazyLock;

use crate::optics::normal;

/// The response is 0 or 1 beyond this many standard deviations.
pub(crate) const MAX_SIGMAS: f64 = 3.75;
const NODES_PER_SIGMA: f64 = 64.0;
const NODES: usize = 2 * (MAX_SIGMAS as usize + 1) * NODES_PER_SIGMA as usize + 1;
const FIRST: f64 = -(MAX_SIGMAS as usize as f64 + 1.0);

/// A straight edge through a Gaussian blur, averaged over the area of a pixel.
///
/// The variance is that of the blur plus that of a pixel on every axis. That a pixel is a box and not a
/// Gaussian shows in the fourth cumulant, which depends on the edge's direction (Edgeworth series).
#[derive(Copy, Clone, Debug)]
pub(crate) struct EdgeResponse {
    /// The normal distribution and its density, tabulated.
    nodes: &'static [[f64; 2]; NODES],
}

/// Variance of a pixel's own extent, in square pixels.
pub(crate) const PIXEL_VARIANCE: f64 = 1.0 / 12.0;

/// Fourth cumulant of a pixel's extent along the unit vector `normal`, over 24 times the square of the whole
/// variance.
#[inline]
pub(crate) fn pixel_kurtosis(normal: [f64; 2], variance: f64) -> f64 {
    let [x, y] = normal.map(|n| n * n);
    -(x * x + y * y) / (120.0 * 24.0 * variance * variance)
}

impl EdgeResponse {
    pub(crate) fn new() -> Self {
        static NORMAL: LazyLock<[[f64; 2]; NODES]> = LazyLock::new(|| {
            std::array::from_fn(|i| {
                let z = FIRST + i as f64 / NODES_PER_SIGMA;
                [normal::cumulative(z), normal::density(z)]
            })
        });
        Self { nodes: &NORMAL }
    }

    /// The response, from 0 to 1, at `z` standard deviations on the bright side of an edge of this
    /// [`pixel_kurtosis`], and its derivative by `z`.
    #[inline]
    pub(crate) fn at(&self, z: f64, pixel_kurtosis: f64) -> (f64, f64) {
        if z.is_nan() || z.abs() >= MAX_SIGMAS {
            return (if z > 0.0 { 1.0 } else { 0.0 }, 0.0);
        }
        let place = (z - FIRST) * NODES_PER_SIGMA;
        let index = (place + 0.5) as usize;
        let Some([whole, density]) = self.nodes.get(index) else { return (0.0, 0.0) };
        let node = FIRST + index as f64 / NODES_PER_SIGMA;
        let d = z - node;
        let height = whole + density * d * (1.0 - 0.5 * d * node);
        let slope = density * (1.0 - d * node);
        let square = z * z;
        let third = z * (square - 3.0);
        let fourth = square * (square - 6.0) + 3.0;
        (height - pixel_kurtosis * third * slope, slope * (1.0 + pixel_kurtosis * fourth))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gaussian_pixel_gives_the_normal_distribution() {
        let edge = EdgeResponse::new();
        for (z, expected) in [
            (0.0, 0.5),
            (1.0, 0.841_344_746_068_543),
            (-2.0, 0.022_750_131_948_179),
            (3.011, 0.998_698_055_737),
            (9.0, 1.0),
            (-9.0, 0.0),
            (f64::NAN, 0.0),
        ] {
            assert!((edge.at(z, 0.0).0 - expected).abs() < 1e-8, "{z}");
        }
        for i in -370..370 {
            let z = f64::from(i) * 0.01 + 0.003;
            let slope = (edge.at(z + 1e-4, -0.01).0 - edge.at(z - 1e-4, -0.01).0) / 2e-4;
            assert!((edge.at(z, -0.01).1 - slope).abs() < 1e-4, "{z}");
        }
    }

    /// Against a blurred step averaged over pixels numerically, upright and at 30 degrees.
    #[test]
    fn the_response_matches_numerical_integration() {
        let edge = EdgeResponse::new();
        for (blur, tolerance) in [(0.3, 4e-3), (0.5, 6e-4), (0.8, 1e-4), (1.5, 1e-5)] {
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
                    let kurtosis = pixel_kurtosis([x, y], variance);
                    let error = edge.at(at / variance.sqrt(), kurtosis).0 - mean;
                    assert!(error.abs() < tolerance, "{blur} {angle} {at} {error}");
                }
            }
        }
    }
}
