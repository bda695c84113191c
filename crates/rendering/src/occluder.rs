//! Renders effects between the scene and the sensor: shadows, glare, occlusion, haze, objects on a marker or dirt on the lens.

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
    /// Long things in front of the scene, later ones over earlier ones: blades of grass, a rope, fingers.
    Strokes(Vec<Stroke>),
    /// Discs that change the light behind them: dirt, snow, dust and drops on the lens.
    Patches {
        /// The discs.
        patches: Vec<Disc>,
        /// Width of their edges, in pixels.
        edge_px: f32,
        /// Fraction of the light that remains behind them.
        transmission: f32,
        /// Grey levels added in front of it.
        levels: f32,
    },
    /// A lamp next to the camera: the light falls off from a pixel.
    Lamp {
        /// Where it is brightest.
        centre: Pixel,
        /// Standard deviation of the light, in pixels.
        radius_px: f32,
        /// Fraction of the light that remains far away.
        rest: f32,
    },
    /// Unevenly mixed with a grey level: faded ink, the threads of cloth.
    Mottle {
        /// Where; it fades out over half the disc's radius.
        area: Disc,
        /// Size of the spots, in pixels.
        spot_px: [f32; 2],
        /// The fraction of the grey level where it is least and where it is most.
        share: [f32; 2],
        /// The grey level.
        level: f32,
    },
    /// One after the other.
    Several(Vec<Occluder>),
}

/// A straight thing with round ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stroke {
    /// Where it begins.
    pub from: Pixel,
    /// Where it ends.
    pub to: Pixel,
    /// Half its width, in pixels.
    pub radius_px: f32,
    /// Its grey level.
    pub level: f32,
}

impl Stroke {
    /// Covers the pixels that it hides in row `y`.
    fn cover_row(&self, y: f64, light: &mut [f32]) {
        let reach = f64::from(self.radius_px + EDGE_PX);
        if y < self.from.y.min(self.to.y) - reach || y > self.from.y.max(self.to.y) + reach {
            return;
        }
        let first = (self.from.x.min(self.to.x) - reach).max(0.0) as usize;
        let last = (self.from.x.max(self.to.x) + reach).max(0.0) as usize;
        let (dx, dy) = (self.to.x - self.from.x, self.to.y - self.from.y);
        let length2 = (dx * dx + dy * dy).max(1e-12);
        for (x, level) in light.iter_mut().enumerate().take(last + 1).skip(first) {
            let (px, py) = (x as f64 - self.from.x, y - self.from.y);
            let along = ((px * dx + py * dy) / length2).clamp(0.0, 1.0);
            let away_px = (px - along * dx).hypot(py - along * dy) as f32;
            *level += rise((self.radius_px - away_px) / EDGE_PX) * (self.level - *level);
        }
    }
}

/// Values from 0 to 1 that change smoothly over spots of some size.
fn mottle(x: f32, y: f32) -> f32 {
    let corner = |x: f32, y: f32| {
        let mut bits = (x as i32 as u32).wrapping_mul(0x9e37_79b9)
            ^ (y as i32 as u32).wrapping_mul(0x85eb_ca6b);
        bits = (bits ^ bits >> 15).wrapping_mul(0x2c1b_3c6d);
        bits = (bits ^ bits >> 12).wrapping_mul(0x297a_2d39);
        ((bits ^ bits >> 15) >> 8) as f32 / 16_777_215.0
    };
    let (left, top) = (x.floor(), y.floor());
    let (across, down) = (rise(x - left - 0.5), rise(y - top - 0.5));
    let row = |y: f32| {
        let (from, to) = (corner(left, y), corner(left + 1.0, y));
        from + across * (to - from)
    };
    row(top) + down * (row(top + 1.0) - row(top))
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
        match self {
            Self::Strokes(strokes) => strokes.iter().for_each(|stroke| stroke.cover_row(y, light)),
            Self::Several(effects) => effects.iter().for_each(|effect| effect.apply(v, light)),
            _ => self.apply_by_pixel(y, light),
        }
    }

    fn apply_by_pixel(&self, y: f64, light: &mut [f32]) {
        for (x, level) in light.iter_mut().enumerate() {
            let x = x as f64;
            match self {
                Self::None | Self::Strokes(_) | Self::Several(_) => return,
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
                Self::Patches { patches, edge_px, transmission, levels } => {
                    let behind = *level * transmission + levels;
                    *level += covered(patches, x, y, *edge_px) * (behind - *level);
                }
                Self::Lamp { centre, radius_px, rest } => {
                    let away = (Pixel::new(x, y).distance(centre) as f32) / radius_px;
                    *level *= rest + (1.0 - rest) * (-0.5 * away * away).exp();
                }
                Self::Mottle { area, spot_px: [across, down], share: [min, max], level: own } => {
                    let spots = mottle(x as f32 / across, y as f32 / down);
                    let inside = area.cover(x, y, 0.5 * area.radius_px);
                    let share = inside * (min + spots * (max - min));
                    *level += share * (own - *level);
                }
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

    #[test]
    fn strokes_cover_their_width_and_patches_their_disc() {
        let (from, to) = (Pixel::new(10.0, 0.0), Pixel::new(10.0, 9.0));
        let stroke = Stroke { from, to, radius_px: 3.0, level: 30.0 };
        let mut row = [200.0f32; 40];
        Occluder::Strokes(vec![stroke]).apply(5, &mut row);
        assert_eq!([row[10], row[8], row[5], row[15]], [30.0, 30.0, 200.0, 200.0]);
        let mut row = [200.0f32; 40];
        Occluder::Strokes(vec![stroke]).apply(16, &mut row);
        assert_eq!(row, [200.0; 40]);
        let disc = Disc { centre: Pixel::new(20.0, 3.0), radius_px: 6.0 };
        let patches = Occluder::Patches {
            patches: vec![disc],
            edge_px: 2.0,
            transmission: 0.5,
            levels: 20.0,
        };
        Occluder::Several(vec![patches, Occluder::Haze { transmission: 0.5, levels: 0.0 }])
            .apply(3, &mut row);
        assert_eq!([row[20], row[2]], [60.0, 100.0]);
    }

    #[test]
    fn a_lamp_falls_off_and_a_mottle_stays_within_its_shares() {
        let mut row = [200.0f32; 400];
        Occluder::Lamp { centre: Pixel::new(50.0, 0.0), radius_px: 40.0, rest: 0.1 }
            .apply(0, &mut row);
        assert!((row[50] - 200.0).abs() < 1e-3 && (row[399] - 20.0).abs() < 1e-3);
        let mut row = [200.0f32; 400];
        let area = Disc { centre: Pixel::new(100.0, 0.0), radius_px: 90.0 };
        let share = [0.1, 0.5];
        Occluder::Mottle { area, spot_px: [5.0, 5.0], share, level: 0.0 }.apply(0, &mut row);
        let (low, high) = row[40..160]
            .iter()
            .fold((f32::MAX, 0.0f32), |(low, high), level| (low.min(*level), high.max(*level)));
        assert!((100.0..140.0).contains(&low) && (160.0..=180.0).contains(&high), "{low} {high}");
        assert_eq!(row[300], 200.0);
    }
}
