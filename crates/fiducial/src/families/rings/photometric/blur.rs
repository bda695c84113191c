//! Predicts the whiteness of one pixel of the three-ring marker through the blur of lens, motion and mosaic, from the
//! distribution of radii about it, with derivatives.

use nalgebra::Vector3;

use super::scene::Scene;
use crate::families::rings::circle_pose::{CirclePlane, RayPlaneIntersection};
use crate::optics::camera_response::CameraResponse;
use crate::optics::edge_response::pixel_kurtosis;
use crate::optics::mosaic::{Kernel, Mosaic, PHASES};

/// An edge further away than this many standard deviations of the blur does not show.
const MAX_BLUR_SIGMAS: f64 = 4.0;

/// Number of circles between the outermost and the dot.
pub(super) const FREE_RADII: usize = 3;

/// The model's response at one pixel, with its derivatives.
pub(super) struct PixelResponse {
    /// The fractions of the pixel's light from inside each circle, the outermost first.
    pub(super) inside: [f64; 6],
    /// How white the camera shows the pixel, from 0 (black) to 1; sharpened beyond them.
    pub(super) shown: f64,
    /// Gradient of the distance from the centre, in pixels, by the pose.
    pub(super) distance_by_pose: [f64; 5],
    /// Derivatives of `shown` by that distance, by the blur, by the motion and by the camera's response.
    pub(super) by_distance: f64,
    pub(super) by_blur: f64,
    pub(super) by_motion: [f64; 2],
    pub(super) by_response: [f64; 2],
}

impl PixelResponse {
    /// How white the pixel would be in an image linear in light, from 0 (black) to 1.
    #[inline]
    pub(super) fn white(&self) -> f64 {
        let [a, b, c, d, e, f] = self.inside;
        1.0 - a + b - c + d - e + f
    }

    /// As a camera of this response shows it. `blurred` is the same pixel blurred further by the sharpening's
    /// kernel, to `1 / blur_ratio` times the blur; `ratio_by_blur` and `wide_by_blur` are the derivatives of the ratio and of
    /// that wider blur by the lens'.
    pub(super) fn processed(
        &self,
        response: &CameraResponse,
        blurred: &Self,
        blur_ratio: f64,
        ratio_by_blur: f64,
        wide_by_blur: f64,
    ) -> Self {
        let seen = response.shown(self.white(), blurred.white(), blur_ratio);
        let both = |own: f64, wide: f64| seen.by_own * own + seen.by_blurred * wide;
        Self {
            inside: self.inside,
            shown: seen.white,
            distance_by_pose: self.distance_by_pose,
            by_distance: both(self.by_distance, blurred.by_distance),
            by_blur: both(self.by_blur, blurred.by_blur * wide_by_blur)
                + seen.by_ratio * ratio_by_blur,
            by_motion: [
                both(self.by_motion[0], blurred.by_motion[0]),
                both(self.by_motion[1], blurred.by_motion[1]),
            ],
            by_response: seen.by_response,
        }
    }
}

/// A Gaussian blur that may differ by direction.
pub(super) struct Blur {
    blur_px: f64,
    /// Variance to the right, covariance, variance down, in square pixels.
    covariance: [f64; 3],
    /// Variance in the direction of least blur.
    min_variance: f64,
    /// Inverse of the standard deviation in the direction of most blur.
    inverse_max: f64,
}

impl Blur {
    /// A blur of this standard deviation, averaged over all directions, and with this motion (see
    /// [`RingModel::motion`](super::solve::RingModel)).
    pub(super) fn new(blur_px: f64, [p, q]: [f64; 2]) -> Self {
        let variance = blur_px * blur_px;
        Self {
            blur_px,
            covariance: [variance + p, q, variance - p],
            min_variance: variance - p.hypot(q),
            inverse_max: 1.0 / (variance + p.hypot(q)).sqrt(),
        }
    }

    /// The blur with this variance added to the right and down, in square pixels.
    fn widened(self, [x, y]: [f64; 2]) -> Self {
        let [xx, xy, yy] = self.covariance;
        let max_variance = self.inverse_max.powi(-2) + x.max(y);
        Self {
            covariance: [xx + x, xy, yy + y],
            min_variance: self.min_variance + x.min(y),
            inverse_max: 1.0 / max_variance.sqrt(),
            ..self
        }
    }
}

/// The blur of one kind of pixel of a colour mosaic.
pub(super) struct InterpolatedBlur {
    blur: Blur,
    kernel: Kernel,
}

impl InterpolatedBlur {
    /// By [`phase`](crate::optics::mosaic::phase), of a lens with this blur.
    pub(super) fn by_phase(mosaic: Mosaic, blur_px: f64, motion: [f64; 2]) -> [Self; PHASES] {
        mosaic.kernels().map(|kernel| Self {
            blur: Blur::new(blur_px, motion).widened(kernel.variances()),
            kernel,
        })
    }
}

/// Distribution of the distance from the centre over the blur about a pixel.
///
/// The squared distance is a quadratic form in normal variables. Raised to `power` it is nearly normal, also
/// for circles no larger than the blur (Jensen and Solomon, "A Gaussian approximation to the distribution of
/// a definite quadratic form", JASA 1972).
#[derive(Copy, Clone)]
pub(super) struct RadiusDistribution {
    pub(super) at: RayPlaneIntersection,
    /// The logarithm of the mean of the squared distance.
    log_mean_square: f64,
    power: f64,
    /// Of the squared distance over its mean, to that power: its mean and the inverse of its standard
    /// deviation.
    mean: f64,
    inverse_deviation: f64,
    /// Derivative of the fraction inside a circle by the pixel's distance from the centre.
    by_distance: f64,
    pixel_kurtosis: f64,
    /// Inverse of an upper bound of the blur, in metres: near the centre, tangential blur changes the
    /// distance as well.
    inverse_max_blur: f64,
    /// Derivatives of the logarithm of the deviation by the blur and by the motion.
    by_blur: f64,
    by_motion: [f64; 2],
}

impl RadiusDistribution {
    /// Free of branches, for vectorisation.
    #[inline(always)]
    pub(super) fn about(ray: &Vector3<f64>, plane: &CirclePlane, blur: &Blur) -> Self {
        let at = plane.intersect(ray);
        let RayPlaneIntersection {
            rho, radial: a, tangential: b, metres_per_px, px_per_metre, ..
        } = at;
        // Radial and tangential variance, and their covariance.
        let [xx, xy, yy] = blur.covariance;
        let blurred = |[x, y]: [f64; 2]| [xx * x + xy * y, xy * x + yy * y];
        let dot = |[x, y]: [f64; 2], [u, v]: [f64; 2]| x * u + y * v;
        let (rr, tt, rt) = (dot(a, blurred(a)), dot(b, blurred(b)), dot(b, blurred(a)));
        let (trace, det) = (rr + tt, rr * tt - rt * rt);
        let square = rho * rho;
        // Cumulants of the squared distance.
        let k1 = square + trace;
        let k2 = 2.0 * (trace * trace - 2.0 * det) + 4.0 * square * rr;
        let k3 = 8.0 * (trace * trace - 3.0 * det) * trace + 24.0 * square * (rr * rr + rt * rt);
        let (per_k1, per_k2) = (1.0 / k1, 1.0 / k2);
        let power = 1.0 - k1 * k3 * (per_k2 * per_k2) / 3.0;
        let mean = 1.0 + power * (power - 1.0) * k2 * (per_k1 * per_k1) / 2.0;
        let per_spread = k2.sqrt() * per_k2;
        let normal = a.map(|part| part * px_per_metre);
        let [nx, ny] = normal;
        let variance = rr * (px_per_metre * px_per_metre);
        let per_variance = 1.0 / variance;
        // Motion blurs like a box, as a pixel does; its variance is the excess over the smallest of any direction.
        let of_box = 1.0 - blur.min_variance * per_variance;
        Self {
            at,
            log_mean_square: k1.ln(),
            power,
            mean,
            inverse_deviation: k1 * per_spread / power,
            by_distance: -2.0 * rho * metres_per_px * per_spread,
            pixel_kurtosis: pixel_kurtosis(normal, variance) - of_box * of_box / 20.0,
            inverse_max_blur: px_per_metre * blur.inverse_max,
            by_blur: blur.blur_px * per_variance,
            by_motion: [0.5 * (nx * nx - ny * ny) * per_variance, nx * ny * per_variance],
        }
    }

    /// As [`RadiusDistribution::about`] for a pixel of a colour mosaic.
    #[inline]
    pub(super) fn interpolated(
        ray: &Vector3<f64>,
        plane: &CirclePlane,
        InterpolatedBlur { blur, kernel }: &InterpolatedBlur,
    ) -> Self {
        let all = Self::about(ray, plane, blur);
        let RayPlaneIntersection { radial, px_per_metre, .. } = all.at;
        let normal = radial.map(|part| part * px_per_metre);
        let variance = blur.blur_px / all.by_blur;
        let kurtosis = pixel_kurtosis(normal, variance) + kernel.kurtosis(normal, variance);
        Self { pixel_kurtosis: kurtosis, ..all }
    }

    /// The square of a circle's radius over the mean square of the distance, to the power of the distribution, and how
    /// many deviations the circle is from the mean.
    #[inline(always)]
    fn next_to_circle(&self, log_radius: f64) -> (f64, f64) {
        let ratio = exp(self.power * (2.0 * log_radius - self.log_mean_square));
        (ratio, (ratio - self.mean) * self.inverse_deviation)
    }

    /// Derivatives of the whiteness by the logarithms of the radii of the circles between the outermost and the dot.
    pub(super) fn by_log_radii(&self, scene: &Scene<'_>) -> [f64; FREE_RADII] {
        std::array::from_fn(|index| {
            // The first of them is the inner edge of a dark ring.
            let sign = if index % 2 == 0 { 1.0 } else { -1.0 };
            let Some((radius, log_radius)) = scene.radii.get(index + 1) else { return 0.0 };
            let sigmas = (radius - self.at.rho) * self.inverse_max_blur;
            if sigmas.abs() > MAX_BLUR_SIGMAS {
                return 0.0;
            }
            let (ratio, z) = self.next_to_circle(*log_radius);
            let (_, density) = scene.edge.at(z, self.pixel_kurtosis);
            sign * density * ratio * 2.0 * self.power * self.inverse_deviation
        })
    }

    #[inline]
    pub(super) fn response(&self, scene: &Scene<'_>) -> PixelResponse {
        let RayPlaneIntersection { rho, by_pose, .. } = self.at;
        let (mut inside, mut by_distance, mut by_deviation) = ([0.0; 6], 0.0, 0.0);
        for (index, (inside, (radius, log_radius))) in
            inside.iter_mut().zip(scene.radii).enumerate()
        {
            // Inside an outer edge it is black, inside an inner one white.
            let sign = if index % 2 == 0 { -1.0 } else { 1.0 };
            let sigmas = (radius - rho) * self.inverse_max_blur;
            if sigmas.abs() > MAX_BLUR_SIGMAS {
                *inside = if sigmas > 0.0 { 1.0 } else { 0.0 };
                continue;
            }
            let (ratio, z) = self.next_to_circle(log_radius);
            let (share, density) = scene.edge.at(z, self.pixel_kurtosis);
            *inside = share;
            by_distance += sign * density * self.by_distance * ratio;
            by_deviation -= sign * density * z;
        }
        let [a, b, c, d, e, f] = inside;
        PixelResponse {
            inside,
            shown: 1.0 - a + b - c + d - e + f,
            distance_by_pose: by_pose,
            by_distance,
            by_blur: by_deviation * self.by_blur,
            by_motion: self.by_motion.map(|by| by_deviation * by),
            by_response: [0.0; 2],
        }
    }
}

/// The exponential function, faster for small arguments.
#[inline]
fn exp(x: f64) -> f64 {
    if x.abs() > 0.4 {
        return x.exp();
    }
    // Taylor series to the eighth power: relative error below 2e-9.
    let [a, b, c, d] = [1.0 / 6.0, 1.0 / 24.0, 1.0 / 120.0, 1.0 / 720.0];
    // Estrin's scheme: pairs that can be computed in parallel.
    let square = x * x;
    let low = 1.0 + x + square * (0.5 + x * a);
    let high = b + x * c + square * (d + x * (1.0 / 5040.0) + square * (1.0 / 40_320.0));
    low + square * square * high
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_exponential_matches_the_exact_one() {
        for i in -80..=80 {
            let x = f64::from(i) * 0.01;
            assert!((exp(x) / x.exp() - 1.0).abs() < 2e-9, "{x}");
        }
    }
}
