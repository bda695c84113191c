//! Defines the camera models that can be calibrated, and their numbers as a vector.

use geometry::{CameraModel, Distortion, Point};
use nalgebra::{SMatrix, SVector};

use crate::view::ImageSize;

/// A lens model.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Lens {
    /// Brown-Conrady with k1, k2, p1, p2.
    BrownConrady4,
    /// Brown-Conrady with k1, k2, p1, p2, k3: OpenCV's default, for lenses up to about 90 degrees.
    BrownConrady5,
    /// Brown-Conrady with a fraction of polynomials (k4, k5, k6): OpenCV's rational model.
    BrownConrady8,
    /// Kannala-Brandt with k1 to k4: OpenCV's fisheye, for wide lenses.
    KannalaBrandt,
}

/// fx, fy, cx, cy and the lens's numbers.
pub(crate) const INTRINSICS: usize = 12;

impl Lens {
    /// All of them, simplest first.
    pub const ALL: [Self; 4] =
        [Self::BrownConrady4, Self::BrownConrady5, Self::BrownConrady8, Self::KannalaBrandt];

    /// How many numbers the model has: focal lengths, principal point and distortion.
    pub fn parameters(self) -> usize {
        4 + match self {
            Self::BrownConrady4 | Self::KannalaBrandt => 4,
            Self::BrownConrady5 => 5,
            Self::BrownConrady8 => 8,
        }
    }

    /// The camera with these numbers.
    pub(crate) fn camera(self, size: ImageSize, numbers: &[f64; INTRINSICS]) -> CameraModel {
        let [fx, fy, cx, cy, k @ ..] = *numbers;
        let distortion = match self {
            Self::KannalaBrandt => Distortion::KannalaBrandt([k[0], k[1], k[2], k[3]]),
            _ => Distortion::BrownConrady(k),
        };
        CameraModel { width: size.width, height: size.height, fx, fy, cx, cy, distortion }
    }
}

/// Radii at which the lenses are compared.
const RADII: usize = 60;
/// Times that the equations are weighted again.
const ROUNDS: usize = 5;

/// The numbers of Brown-Conrady that distort most like this fisheye up to `max_radius`, in focal lengths of an ideal image, with the
/// numbers held near zero by `ridge`; `None` where there are none. Multiplied by the fraction's denominator the equations are linear; each is weighted by the
/// denominator of the round before (Sanathanan and Koerner, "Transfer function synthesis as a ratio of two complex
/// polynomials", 1963).
pub(crate) fn brown_conrady_like(
    fisheye: &CameraModel,
    max_radius: f64,
    ridge: f64,
) -> Option<[f64; INTRINSICS]> {
    let flat = CameraModel { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0, ..*fisheye };
    let mut k = SVector::<f64, 6>::zeros();
    for _ in 0..ROUNDS {
        let mut matrix = SMatrix::<f64, 6, 6>::identity() * ridge;
        let mut right = SVector::<f64, 6>::zeros();
        for i in 1..=RADII {
            let radius = max_radius * i as f64 / RADII as f64;
            let distorted = flat.project(Point::new(radius, 0.0, 1.0))?.x;
            let r2 = radius * radius;
            let powers = [r2, r2 * r2, r2 * r2 * r2];
            let below = 1.0 + k[3] * powers[0] + k[4] * powers[1] + k[5] * powers[2];
            let [a, b] =
                [radius, -distorted].map(|factor| powers.map(|power| factor * power / below));
            let row = SVector::from([a[0], a[1], a[2], b[0], b[1], b[2]]);
            matrix += row * row.transpose();
            right += row * ((distorted - radius) / below);
        }
        k = matrix.cholesky()?.solve(&right);
    }
    let CameraModel { fx, fy, cx, cy, .. } = *fisheye;
    let numbers = [fx, fy, cx, cy, k[0], k[1], 0.0, 0.0, k[2], k[3], k[4], k[5]];
    numbers.iter().all(|number| number.is_finite()).then_some(numbers)
}

impl std::fmt::Display for Lens {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::BrownConrady4 => "Brown-Conrady with 4 numbers",
            Self::BrownConrady5 => "Brown-Conrady with 5 numbers",
            Self::BrownConrady8 => "Brown-Conrady with 8 numbers",
            Self::KannalaBrandt => "Kannala-Brandt",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Pixel;

    #[test]
    fn a_fisheye_is_like_a_fraction_of_polynomials() {
        for degrees in [30.0_f64, 50.0, 60.0, 70.0] {
            for k in [[0.0; 4], [0.02, -0.01, 0.003, -0.001], [0.3, 0.1, 0.05, 0.0]] {
                let fisheye = CameraModel {
                    distortion: Distortion::KannalaBrandt(k),
                    ..CameraModel::pinhole(1280, 960, 500.0)
                };
                let max_radius = degrees.to_radians().tan();
                let numbers = brown_conrady_like(&fisheye, max_radius, 1e-9).unwrap();
                let size = ImageSize { width: 1280, height: 960 };
                let brown = Lens::BrownConrady8.camera(size, &numbers);
                for i in 0..=20 {
                    let point = Point::new(max_radius * f64::from(i) / 20.0, 0.0, 1.0);
                    let expected = fisheye.project(point).unwrap();
                    let found = brown.project(point).unwrap_or(Pixel::new(f64::NAN, 0.0));
                    let distance = found.distance(&expected);
                    assert!(distance < 0.1, "{degrees} {k:?} {i}: {distance} px");
                }
            }
        }
    }
}
