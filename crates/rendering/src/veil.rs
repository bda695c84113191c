//! What happens to light between a scene and the sensor: shadows, glare, things in the way, haze.

use geometry::Pixel;

/// A change of light over the image.
#[derive(Clone, Debug, PartialEq)]
pub enum Veil {
    /// None.
    Nothing,
    /// A shadow on one side of a line.
    Shadow {
        /// The shadow's edge; the shadow is where the line's distance is positive.
        edge: Line,
        /// Width of the half-shadow, in pixels.
        soft_px: f32,
        /// Part of the light that is left.
        left: f32,
    },
    /// A reflection that adds light.
    Glare {
        /// Its middle.
        centre: Pixel,
        /// Standard deviation of its round blob, in pixels.
        radius_px: f32,
        /// Grey levels that it adds in its middle.
        levels: f32,
    },
    /// A thing in front of the scene on one side of a line.
    Cover {
        /// Its edge; it covers where the line's distance is positive.
        edge: Line,
        /// Its grey level.
        level: f32,
    },
    /// Little contrast: a part of the light is left, and grey levels are added.
    Haze {
        /// Part of the light that is left.
        left: f32,
        /// Grey levels that are added.
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

/// How softly the edge of a thing in the way is seen, in pixels.
const SHARP_PX: f32 = 1.5;

impl Veil {
    /// Changes the light of row `v`, in grey levels.
    pub fn dim(&self, v: usize, light: &mut [f32]) {
        let y = v as f64;
        for (x, level) in light.iter_mut().enumerate() {
            let x = x as f64;
            match self {
                Self::Nothing => return,
                Self::Shadow { edge, soft_px, left } => {
                    let shade = rise(edge.distance(x, y) as f32 / soft_px);
                    *level *= 1.0 - shade * (1.0 - left);
                }
                Self::Glare { centre, radius_px, levels } => {
                    let away = (Pixel::new(x, y).distance(centre) as f32) / radius_px;
                    *level += levels * (-0.5 * away * away).exp();
                }
                Self::Cover { edge, level: own } => {
                    let cover = rise(edge.distance(x, y) as f32 / SHARP_PX);
                    *level += cover * (own - *level);
                }
                Self::Haze { left, levels } => *level = *level * left + levels,
            }
        }
    }
}

/// A smooth step from 0 to 1 over one unit about 0.
fn rise(place: f32) -> f32 {
    let t = (place + 0.5).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}
