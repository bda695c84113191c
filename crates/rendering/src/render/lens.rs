//! Computes the direction of each pixel for the renderer, exact or from a table for a distorting lens, linear about a
//! tile; and the blur of lens and pixel area.

use geometry::{CameraModel, Distortion, Pixel};

/// Directions of pixels: exact for a pinhole, from a table for a distorting lens.
#[derive(Debug)]
pub(super) struct Lens {
    /// Edge of the tile in which the lens is approximated as linear, in pixels.
    pub(super) tile: usize,
    model: CameraModel,
    /// Ideal coordinates of the pixels at multiples of the tile's edge, row by row; empty for a pinhole.
    nodes: Vec<[f64; 2]>,
    nodes_per_row: usize,
}

/// Ideal coordinates (x and y where z is 1) as a linear function of pixels about a centre.
#[derive(Copy, Clone, Debug)]
pub(super) struct Linear {
    pub(super) centre: [f64; 2],
    pub(super) per_column: [f64; 2],
    pub(super) per_row: [f64; 2],
}

/// Edge of a tile for a pinhole, which is linear everywhere, in pixels.
pub(super) const PINHOLE_TILE: usize = 16;

/// Edge of a tile for a distorting lens, in pixels; within it common lenses are linear to thousandths of a
/// pixel.
const DISTORTED_TILE: usize = 8;

impl Lens {
    pub(super) fn new(model: CameraModel) -> Self {
        let mut lens = Self { tile: PINHOLE_TILE, model, nodes: Vec::new(), nodes_per_row: 0 };
        if model.distortion != Distortion::None {
            lens.tile = DISTORTED_TILE;
            let count = |edge: u32| (edge as usize).div_ceil(DISTORTED_TILE) + 1;
            lens.nodes_per_row = count(model.width);
            lens.nodes = (0..count(model.height) * lens.nodes_per_row)
                .map(|k| {
                    let place = |n: usize| (n * DISTORTED_TILE) as f64;
                    lens.exact(place(k % lens.nodes_per_row), place(k / lens.nodes_per_row))
                })
                .collect();
        }
        lens
    }

    /// Ideal coordinates of a pixel; where the lens model has no solution, those of a pinhole.
    fn exact(&self, u: f64, v: f64) -> [f64; 2] {
        let ray = self.model.unproject_clamped(Pixel::new(u, v));
        if ray.is_finite() { [ray.x(), ray.y()] } else { self.pinhole(u, v) }
    }

    fn pinhole(&self, u: f64, v: f64) -> [f64; 2] {
        [(u - self.model.cx) / self.model.fx, (v - self.model.cy) / self.model.fy]
    }

    /// Ideal coordinates at column `node * tile` of row `v`.
    pub(super) fn at_node(&self, node: usize, v: usize) -> [f64; 2] {
        if self.nodes.is_empty() {
            return self.pinhole((node * self.tile) as f64, v as f64);
        }
        let index = v / self.tile * self.nodes_per_row + node;
        let part = (v % self.tile) as f64 / self.tile as f64;
        match (self.nodes.get(index), self.nodes.get(index + self.nodes_per_row)) {
            (Some(a), Some(b)) => [0, 1].map(|i| a[i] + (b[i] - a[i]) * part),
            _ => [0.0; 2],
        }
    }

    /// Minimum and maximum ideal coordinates of the image with a margin, in pixels.
    pub(super) fn field(&self, margin: f64) -> ([f64; 2], [f64; 2]) {
        let (mut min, mut max) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        let mut include = |place: [f64; 2]| {
            for i in 0..2 {
                min[i] = min[i].min(place[i]);
                max[i] = max[i].max(place[i]);
            }
        };
        let last = [self.model.width, self.model.height].map(|edge| f64::from(edge) - 1.0);
        include(self.pinhole(-margin, -margin));
        include(self.pinhole(last[0] + margin, last[1] + margin));
        let extra = [margin / self.model.fx, margin / self.model.fy];
        for node in &self.nodes {
            include([0, 1].map(|i| node[i] - extra[i]));
            include([0, 1].map(|i| node[i] + extra[i]));
        }
        (min, max)
    }

    /// The lens linearised around pixel (u, v), over `reach` pixels to each side.
    pub(super) fn about(&self, u: f64, v: f64, reach: f64) -> Linear {
        if self.nodes.is_empty() {
            return Linear {
                centre: self.pinhole(u, v),
                per_column: [1.0 / self.model.fx, 0.0],
                per_row: [0.0, 1.0 / self.model.fy],
            };
        }
        let [left, right] = [self.exact(u - reach, v), self.exact(u + reach, v)];
        let [top, bottom] = [self.exact(u, v - reach), self.exact(u, v + reach)];
        let middle = self.exact(u, v);
        let mean = |i: usize| (left[i] + right[i] + top[i] + bottom[i]) / 4.0;
        Linear {
            // The mean of tangent and chord spreads the error over the tile.
            centre: [0, 1].map(|i| (middle[i] + mean(i)) / 2.0),
            per_column: [0, 1].map(|i| (right[i] - left[i]) / (2.0 * reach)),
            per_row: [0, 1].map(|i| (bottom[i] - top[i]) / (2.0 * reach)),
        }
    }
}

/// Weights of the subsamples of a row or column in a pixel: a box of one pixel, blurred by the lens.
#[derive(Debug)]
pub(super) struct Blur {
    /// Subsamples per pixel.
    pub(super) per_pixel: usize,
    /// Subsamples beyond the pixel on each side.
    pub(super) margin: usize,
    /// `per_pixel + 2 * margin` weights whose sum is 1.
    pub(super) weights: Vec<f32>,
}

/// Half width of the lens blur, in standard deviations.
const BLUR_REACH: f64 = 3.3;

/// Width of an edge's profile in subsamples: wide enough against aliasing of edges in any direction into
/// frequencies that the blur passes.
pub(super) const PROFILE_WIDTH: f64 = 2.0;

impl Blur {
    pub(super) fn new(sigma_px: f64, per_pixel: usize) -> Self {
        // The profile already blurs more than a subsample does.
        let excess = PROFILE_WIDTH * PROFILE_WIDTH / 28.0 - 1.0 / 12.0;
        let sigma = ((sigma_px * per_pixel as f64).powi(2) - excess).max(0.0).sqrt();
        // A blur well below a subsample is negligible.
        let margin = if sigma < 0.25 { 0 } else { (BLUR_REACH * sigma).ceil() as usize };
        let spread =
            |offset: f64| if margin == 0 { 1.0 } else { (-0.5 * (offset / sigma).powi(2)).exp() };
        let lens: Vec<f64> = (0..=2 * margin).map(|k| spread(k as f64 - margin as f64)).collect();
        let total: f64 = lens.iter().sum();
        let mut weights = vec![0.0; per_pixel + 2 * margin];
        for start in 0..per_pixel {
            for (weight, part) in weights.iter_mut().skip(start).zip(&lens) {
                *weight += (part / total / per_pixel as f64) as f32;
            }
        }
        Self { per_pixel, margin, weights }
    }

    /// Maximum distance from a pixel's centre to the light it gets, in pixels.
    pub(super) fn reach_px(&self) -> f64 {
        0.5 + self.margin as f64 / self.per_pixel as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_blur_has_sum_one_and_the_variance_of_pixel_and_lens() {
        for (sigma, per_pixel) in [(0.0, 8), (0.5, 2), (0.6, 4), (1.5, 2)] {
            let blur = Blur::new(sigma, per_pixel);
            let centre = (blur.weights.len() as f64 - 1.0) / 2.0;
            let step = 1.0 / per_pixel as f64;
            let variance: f64 = (0..blur.weights.len())
                .zip(&blur.weights)
                .map(|(k, w)| f64::from(*w) * ((k as f64 - centre) * step).powi(2))
                .sum();
            let total: f32 = blur.weights.iter().sum();
            let expected = sigma * sigma + 1.0 / 12.0 - (PROFILE_WIDTH * step).powi(2) / 28.0;
            assert!((total - 1.0).abs() < 1e-5);
            assert!((variance / expected - 1.0).abs() < 0.02, "{variance} for {expected}");
        }
    }

    #[test]
    fn a_distorting_lens_is_linear_in_a_tile() {
        let pinhole = CameraModel::pinhole(1296, 972, 1818.0);
        let barrel = Distortion::BrownConrady([-0.28, 0.07, 2e-4, 2e-5, 0.0, 0.0, 0.0, 0.0]);
        let lens = Lens::new(CameraModel { distortion: barrel, ..pinhole });
        for (u, v) in [(12.0, 12.0), (640.0, 500.0), (1280.0, 960.0), (100.0, 900.0)] {
            let linear = lens.about(u, v, 4.0);
            for (du, dv) in [(-4.0, -4.0), (4.0, -4.0), (0.0, 0.0), (3.0, 2.0)] {
                let exact = lens.exact(u + du, v + dv);
                let error = [0, 1].map(|i| {
                    linear.centre[i] + linear.per_column[i] * du + linear.per_row[i] * dv - exact[i]
                });
                assert!(error[0].hypot(error[1]) * 1818.0 < 0.01, "{error:?}");
            }
        }
    }
}
