//! Which camera model is looked for, and its numbers as a vector.

use geometry::{CameraModel, Distortion};

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
