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
    /// Shade with discs of sun in it, as under a tree.
    Dapple {
        /// The discs.
        suns: Vec<Disc>,
        /// Width of their edges, in pixels.
        penumbra_px: f32,
        /// Fraction of the light that remains in the shade.
        transmission: f32,
    },
    /// Discs in front of the scene.
    Leaves {
        /// The discs.
        leaves: Vec<Disc>,
        /// Their grey level.
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

/// A disc in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// Its centre.
    pub centre: Pixel,
    /// Its radius, in pixels.
    pub radius_px: f32,
}

impl Disc {
    /// How much of a pixel it covers, from 0 to 1, with an edge of some width.
    fn cover(&self, x: f64, y: f64, edge_px: f32) -> f32 {
        let away_px = Pixel::new(x, y).distance(&self.centre) as f32;
        rise((self.radius_px - away_px) / edge_px)
    }
}

/// How much of a pixel the nearest of some discs covers.
fn covered(discs: &[Disc], x: f64, y: f64, edge_px: f32) -> f32 {
    discs.iter().map(|disc| disc.cover(x, y, edge_px)).fold(0.0, f32::max)
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
                Self::Dapple { suns, penumbra_px, transmission } => {
                    let shade = 1.0 - covered(suns, x, y, *penumbra_px);
                    *level *= 1.0 - shade * (1.0 - transmission);
                }
                Self::Leaves { leaves, level: own } => {
                    let cover = covered(leaves, x, y, EDGE_PX);
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dapples_let_the_sun_through_and_leaves_cover() {
        let disc = Disc { centre: Pixel::new(20.0, 3.0), radius_px: 6.0 };
        let mut row = [200.0f32; 40];
        let dapple = Occluder::Dapple { suns: vec![disc], penumbra_px: 2.0, transmission: 0.25 };
        dapple.apply(3, &mut row);
        assert_eq!([row[20], row[2], row[38]], [200.0, 50.0, 50.0]);
        // Half-way at the disc's edge.
        assert!((row[26] - 125.0).abs() < 1.0);
        let mut row = [200.0f32; 40];
        Occluder::Leaves { leaves: vec![disc], level: 30.0 }.apply(3, &mut row);
        assert_eq!([row[20], row[2]], [30.0, 200.0]);
    }
}
