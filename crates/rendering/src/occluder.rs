//! Effects between the scene and the sensor: shadows, glare, occlusion, haze.

use geometry::Pixel;

/// An effect on the light in the image.
#[derive(Clone, Debug, PartialEq)]
pub enum Occluder {
    /// No effect.
    None,
    /// A shadow on one side of a line.
    Shadow {
        /// Its edge; the shadow is where the line's distance is positive.
        edge: Line,
        /// Width of the penumbra, in pixels.
        penumbra_px: f32,
        /// Fraction of the light that remains.
        transmission: f32,
    },
    /// A reflection that adds light.
    Glare {
        /// Its centre.
        centre: Pixel,
        /// Standard deviation of the round blob, in pixels.
        radius_px: f32,
        /// Grey levels added at its centre.
        levels: f32,
    },
    /// An object in front of the scene on one side of a line.
    Cover {
        /// Its edge; it covers where the line's distance is positive.
        edge: Line,
        /// Its grey level.
        level: f32,
    },
    /// Low contrast: less light, and added grey levels.
    Haze {
        /// Fraction of the light that remains.
        transmission: f32,
        /// Grey levels added everywhere.
        levels: f32,
    },
}

/// A directed line in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// A pixel on it.
    pub through: Pixel,
    /// The direction of its normal, radians from right towards down.
    pub normal: f64,
}

impl Line {
    /// Distance of a pixel in the direction of the normal, in pixels.
    pub fn distance(&self, x: f64, y: f64) -> f64 {
        let (sin, cos) = self.normal.sin_cos();
        (x - self.through.x) * cos + (y - self.through.y) * sin
    }
}

/// Width of the edge of an object in front of the scene, in pixels.
const EDGE_PX: f32 = 1.5;

impl Occluder {
    /// Applies the effect to the light of row `v`, in grey levels.
    pub fn apply(&self, v: usize, light: &mut [f32]) {
        let y = v as f64;
        for (x, level) in light.iter_mut().enumerate() {
            let x = x as f64;
            match self {
                Self::None => return,
                Self::Shadow { edge, penumbra_px, transmission } => {
                    let shade = rise(edge.distance(x, y) as f32 / penumbra_px);
                    *level *= 1.0 - shade * (1.0 - transmission);
                }
                Self::Glare { centre, radius_px, levels } => {
                    let away = (Pixel::new(x, y).distance(centre) as f32) / radius_px;
                    *level += levels * (-0.5 * away * away).exp();
                }
                Self::Cover { edge, level: own } => {
                    let cover = rise(edge.distance(x, y) as f32 / EDGE_PX);
                    *level += cover * (own - *level);
                }
                Self::Haze { transmission, levels } => *level = *level * transmission + levels,
            }
        }
    }
}

/// A smooth step from 0 to 1 over the interval from -0.5 to 0.5.
fn rise(place: f32) -> f32 {
    let t = (place + 0.5).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
