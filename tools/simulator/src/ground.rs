//! What the ground looks like: textures that repeat, each over a period and at a resolution of its own.
//!
//! Coarse and fine grain are tiles of 8-bit texels with all their halved copies (a mip pyramid); patches
//! metres across lie under both, so that no repetition is seen from the heights at which a tile's period fits into
//! the picture.

use std::f32::consts::TAU;
use std::str::FromStr;

use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A kind of ground.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Surface {
    /// Dark stones in a darker binder.
    Asphalt,
    /// Blades in clumps.
    Grass,
    /// Square floor tiles with dark joints.
    Tiles,
    /// The same grey everywhere.
    Plain,
}

impl Surface {
    /// Every kind, in the order in which they are listed to people.
    pub const ALL: [Self; 4] = [Self::Asphalt, Self::Grass, Self::Tiles, Self::Plain];

    /// The name in configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Asphalt => "asphalt",
            Self::Grass => "grass",
            Self::Tiles => "tiles",
            Self::Plain => "plain",
        }
    }
}

impl FromStr for Surface {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|surface| surface.name() == text).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            format!("there is no ground `{text}`; known are {known}")
        })
    }
}

/// A row of pixels on the ground: where it begins and ends, and how much of the ground a pixel mixes.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Span {
    /// North and east of the first pixel's centre, in metres.
    pub from_m: [f64; 2],
    /// North and east of the pixel after the last, in metres.
    pub to_m: [f64; 2],
    /// How far the pixels move over the ground during the exposure, in metres.
    pub smear_m: [f64; 2],
    /// Edge of the ground that a pixel sees, in metres.
    pub footprint_m: f64,
}

/// A ground, ready to be looked at.
#[derive(Clone, Debug)]
pub struct Ground {
    mean: f32,
    coarse: Option<Texture>,
    fine: Option<Texture>,
    patches: Option<Patches>,
}

/// Texels that a pixel's footprint should span: the blur of bilinear sampling then equals that of a pixel behind a
/// usual lens (variances of a texel's box and of the interpolation's triangle against a box and a Gaussian).
const TEXELS_PER_FOOTPRINT: f64 = 0.75;

/// A smear longer than this many pixels is made of nearest texels instead of interpolated ones.
const LONG_SMEAR_PX: f64 = 2.0;

/// The most places at which a pixel looks at the ground along its smear.
const MOST_TAPS: f64 = 8.0;

impl Ground {
    /// The ground of this kind that `seed` grows.
    pub fn new(surface: Surface, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6772_6f75_6e64);
        match surface {
            Surface::Asphalt => asphalt(&mut rng),
            Surface::Grass => grass(&mut rng),
            Surface::Tiles => tiles(&mut rng),
            Surface::Plain => Self { mean: 0.35, coarse: None, fine: None, patches: None },
        }
    }

    /// Reflectance from afar.
    pub fn mean(&self) -> f32 {
        self.mean
    }

    /// Reflectance of the ground at a place (north and east in metres) as far as it changes over metres only.
    pub fn patch(&self, place_m: [f64; 2]) -> f32 {
        self.mean + self.patches.as_ref().map_or(0.0, |patches| patches.at(place_m))
    }

    /// Adds the grain to the reflectances of a row of pixels.
    pub fn add_grain(&self, span: &Span, row: &mut [f32]) {
        for texture in [&self.coarse, &self.fine].into_iter().flatten() {
            texture.add(span, row);
        }
    }
}

/// A square tile of texels and its halved copies; a texel of 128 changes nothing.
#[derive(Clone, Debug)]
struct Texture {
    texel_m: f64,
    /// Reflectance per unit of a texel.
    gain: f32,
    /// Edge in texels as a power of two, and texels; each level has half the edge of the one before.
    levels: Vec<(u32, Vec<u8>)>,
}

impl Texture {
    /// From reflectances about 0 on a square of 2^`log2` texels.
    fn new(texel_m: f64, log2: u32, values: &[f32]) -> Self {
        let largest = values.iter().fold(1e-6f32, |m, v| m.max(v.abs()));
        let gain = largest / 127.0;
        let mut levels = vec![(log2, quantise(values, gain))];
        let mut values = values.to_vec();
        for log2 in (0..log2).rev() {
            values = halve(&values, 1 << (log2 + 1));
            levels.push((log2, quantise(&values, gain)));
            // What is left is below a texel's resolution.
            if values.iter().all(|v| v.abs() < gain) {
                break;
            }
        }
        Self { texel_m, gain, levels }
    }

    fn add(&self, span: &Span, row: &mut [f32]) {
        let smear_px = span.smear_m[0].hypot(span.smear_m[1]) / span.footprint_m;
        let taps = f64::from((smear_px + 0.5) as u32).clamp(1.0, MOST_TAPS);
        let footprint_m = span.footprint_m * (smear_px / taps).max(1.0);
        let halvings = nearest_log2(footprint_m / (self.texel_m * TEXELS_PER_FOOTPRINT));
        let Some((log2, level)) = self.levels.get(halvings) else { return };
        let texel_m = self.texel_m * (1u64 << halvings) as f64;
        let near = smear_px >= LONG_SMEAR_PX;
        let walk = Walk { log2: *log2, gain: self.gain / taps as f32, texels: level };
        for tap in 0..taps as u32 {
            let along = (f64::from(tap) + 0.5) / taps - 0.5;
            // The centre of a texel is half a texel from its corner.
            let start = [0, 1].map(|i| {
                let place = (span.from_m[i] + span.smear_m[i] * along) / texel_m;
                fixed(if near { place } else { place - 0.5 })
            });
            let count = row.len().max(1) as f64;
            let step = [0, 1].map(|i| fixed((span.to_m[i] - span.from_m[i]) / (texel_m * count)));
            if near { walk.nearest(start, step, row) } else { walk.bilinear(start, step, row) }
        }
    }
}

/// Texels with 16 binary places; whole periods wrap.
fn fixed(texels: f64) -> u32 {
    (texels * 65_536.0) as i64 as u32
}

/// The binary logarithm, rounded, and 0 for what is below 1: read off the exponent.
fn nearest_log2(value: f64) -> usize {
    let exponent = ((value * std::f64::consts::SQRT_2).to_bits() >> 52) & 0x7ff;
    (exponent as usize).saturating_sub(1023)
}

/// One level of a texture, to be walked along a line.
struct Walk<'a> {
    log2: u32,
    gain: f32,
    texels: &'a [u8],
}

impl Walk<'_> {
    fn nearest(&self, start: [u32; 2], step: [u32; 2], row: &mut [f32]) {
        let mask = (1u32 << self.log2) - 1;
        let [mut x, mut y] = start;
        for value in row {
            let index = (((y >> 16) & mask) << self.log2) | ((x >> 16) & mask);
            let texel = self.texels.get(index as usize).copied().unwrap_or(128);
            *value += (f32::from(texel) - 128.0) * self.gain;
            x = x.wrapping_add(step[0]);
            y = y.wrapping_add(step[1]);
        }
    }

    fn bilinear(&self, start: [u32; 2], step: [u32; 2], row: &mut [f32]) {
        let mask = (1u32 << self.log2) - 1;
        let gain = self.gain / 65_536.0;
        let [mut x, mut y] = start;
        for value in row {
            let (column, below) = ((x >> 16) & mask, ((y >> 16) & mask) << self.log2);
            let (right, under) = (((x >> 16) + 1) & mask, (((y >> 16) + 1) & mask) << self.log2);
            let texel =
                |index: u32| self.texels.get(index as usize).copied().map_or(128, u32::from);
            let (fx, fy) = ((x >> 8) & 255, (y >> 8) & 255);
            let upper = texel(below | column) * (256 - fx) + texel(below | right) * fx;
            let lower = texel(under | column) * (256 - fx) + texel(under | right) * fx;
            let mixed = upper * (256 - fy) + lower * fy;
            *value += (mixed as i32 - (128 << 16)) as f32 * gain;
            x = x.wrapping_add(step[0]);
            y = y.wrapping_add(step[1]);
        }
    }
}

fn quantise(values: &[f32], gain: f32) -> Vec<u8> {
    values.iter().map(|v| (v / gain + 128.0).round().clamp(0.0, 255.0) as u8).collect()
}

/// Means of 2 x 2 texels of a square `edge` texels wide.
fn halve(values: &[f32], edge: usize) -> Vec<f32> {
    values
        .chunks_exact(2 * edge)
        .flat_map(|pair| {
            let (upper, lower) = pair.split_at(edge);
            upper
                .chunks_exact(2)
                .zip(lower.chunks_exact(2))
                .map(|(u, l)| (u.iter().sum::<f32>() + l.iter().sum::<f32>()) / 4.0)
        })
        .collect()
}

/// Slow changes over metres.
#[derive(Clone, Debug)]
struct Patches {
    values: Vec<f32>,
}

impl Patches {
    const TEXEL_M: f64 = 0.25;
    const LOG2: u32 = 8;

    fn new(rng: &mut impl Rng, contrast: f32) -> Self {
        let mut values =
            noise(rng, Self::LOG2, &[(5, 1.0), (4, 0.8), (3, 0.6), (2, 0.5), (1, 0.4)]);
        normalise(&mut values, contrast);
        Self { values }
    }

    fn at(&self, place_m: [f64; 2]) -> f32 {
        let [x, y] = place_m.map(|p| fixed(p / Self::TEXEL_M));
        let mask = (1u32 << Self::LOG2) - 1;
        let at = |dx: u32, dy: u32| {
            let index = ((((y >> 16) + dy) & mask) << Self::LOG2) | (((x >> 16) + dx) & mask);
            self.values.get(index as usize).copied().unwrap_or(0.0)
        };
        let [fx, fy] = [x, y].map(|c| (c & 0xffff) as f32 / 65_536.0);
        let upper = at(0, 0) + (at(1, 0) - at(0, 0)) * fx;
        let lower = at(0, 1) + (at(1, 1) - at(0, 1)) * fx;
        upper + (lower - upper) * fy
    }
}

fn asphalt(rng: &mut ChaCha8Rng) -> Ground {
    let mut coarse = noise(rng, 11, &[(6, 0.5), (5, 0.5), (4, 0.5), (3, 0.5), (2, 0.4)]);
    normalise(&mut coarse, 0.014);
    scatter(&mut coarse, 11, 700_000, rng, |rng, canvas| {
        let grey = rng.random_range(-0.06..0.06f32) + 0.1 * rng.random::<f32>().powi(6);
        canvas.stone(rng.random_range(0.6..1.9), grey);
    });
    let mut fine = noise(rng, 10, &[(4, 0.3), (3, 0.5), (2, 0.6), (1, 0.8)]);
    normalise(&mut fine, 0.02);
    scatter(&mut fine, 10, 3_500, rng, |rng, canvas| {
        let grey = rng.random_range(-0.05..0.07);
        canvas.stone(rng.random_range(3.0..11.0), grey);
    });
    Ground {
        mean: 0.2,
        coarse: Some(Texture::new(0.0025, 11, &centred(coarse))),
        fine: Some(Texture::new(0.00025, 10, &centred(fine))),
        patches: Some(Patches::new(rng, 0.018)),
    }
}

fn grass(rng: &mut ChaCha8Rng) -> Ground {
    let mut coarse = noise(rng, 11, &[(6, 0.8), (5, 1.0), (4, 0.8), (3, 0.5)]);
    normalise(&mut coarse, 0.03);
    scatter(&mut coarse, 11, 420_000, rng, |rng, canvas| {
        let (angle, length) = (rng.random_range(0.0..TAU), rng.random_range(8.0..22.0));
        canvas.blade(angle, length, 0.8, rng.random_range(-0.11..0.13));
    });
    let mut fine = noise(rng, 10, &[(6, 0.8), (5, 0.8), (4, 0.4)]);
    normalise(&mut fine, 0.02);
    scatter(&mut fine, 10, 1_400, rng, |rng, canvas| {
        let (angle, length) = (rng.random_range(0.0..TAU), rng.random_range(80.0..200.0));
        canvas.blade(angle, length, 5.0, rng.random_range(-0.09..0.11));
    });
    Ground {
        mean: 0.17,
        coarse: Some(Texture::new(0.0025, 11, &centred(coarse))),
        fine: Some(Texture::new(0.00025, 10, &centred(fine))),
        patches: Some(Patches::new(rng, 0.03)),
    }
}

fn tiles(rng: &mut ChaCha8Rng) -> Ground {
    const EDGE: usize = 1 << 11;
    const PER_PERIOD: usize = 13;
    const JOINT: usize = 3;
    let mut coarse = noise(rng, 11, &[(6, 0.4), (4, 0.4), (2, 0.6), (1, 0.8)]);
    normalise(&mut coarse, 0.012);
    let shades: Vec<f32> =
        (0..PER_PERIOD * PER_PERIOD).map(|_| rng.random_range(-0.035..0.035)).collect();
    let tile = |texel: usize| (texel * PER_PERIOD / EDGE, (texel * PER_PERIOD % EDGE) / PER_PERIOD);
    for (index, value) in coarse.iter_mut().enumerate() {
        let ((column, x), (row, y)) = (tile(index % EDGE), tile(index / EDGE));
        if x < JOINT || y < JOINT {
            *value -= 0.22;
        } else {
            *value += shades.get(row * PER_PERIOD + column).copied().unwrap_or(0.0);
        }
    }
    let mut fine = noise(rng, 10, &[(5, 0.3), (3, 0.5), (2, 0.6), (1, 0.8)]);
    normalise(&mut fine, 0.012);
    Ground {
        mean: 0.45,
        coarse: Some(Texture::new(0.002, 11, &centred(coarse))),
        fine: Some(Texture::new(0.00025, 10, &centred(fine))),
        patches: Some(Patches::new(rng, 0.015)),
    }
}

/// Value noise on a square of 2^`log2` texels that repeats: a sum of (log2 of the wavelength in texels, amplitude).
fn noise(rng: &mut impl Rng, log2: u32, octaves: &[(u32, f32)]) -> Vec<f32> {
    let edge = 1usize << log2;
    let mut sum = vec![0.0f32; edge * edge];
    for &(wave, amplitude) in octaves {
        let cells = edge >> wave;
        let lattice: Vec<f32> =
            (0..cells * cells).map(|_| rng.random_range(-amplitude..amplitude)).collect();
        let at = |x: usize, y: usize| {
            lattice.get((y % cells) * cells + x % cells).copied().unwrap_or(0.0)
        };
        let weight = |texel: usize| {
            let t = (texel & ((1 << wave) - 1)) as f32 / (1 << wave) as f32;
            t * t * (3.0 - 2.0 * t)
        };
        for (y, row) in sum.chunks_exact_mut(edge).enumerate() {
            let (cy, fy) = (y >> wave, weight(y));
            for (x, value) in row.iter_mut().enumerate() {
                let (cx, fx) = (x >> wave, weight(x));
                let upper = at(cx, cy) + (at(cx + 1, cy) - at(cx, cy)) * fx;
                let lower = at(cx, cy + 1) + (at(cx + 1, cy + 1) - at(cx, cy + 1)) * fx;
                *value += upper + (lower - upper) * fy;
            }
        }
    }
    sum
}

/// Scales values to a standard deviation.
fn normalise(values: &mut [f32], deviation: f32) {
    let square = values.iter().map(|v| v * v).sum::<f32>() / values.len().max(1) as f32;
    let factor = deviation / square.sqrt().max(1e-9);
    values.iter_mut().for_each(|v| *v *= factor);
}

/// Values about their mean.
fn centred(mut values: Vec<f32>) -> Vec<f32> {
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / values.len().max(1) as f64;
    values.iter_mut().for_each(|v| *v -= mean as f32);
    values
}

/// A place on a tile at which something small is drawn; what crosses an edge comes in on the other side.
struct Canvas<'a> {
    values: &'a mut [f32],
    log2: u32,
    x: f32,
    y: f32,
}

/// Draws `count` things at random places.
fn scatter(
    values: &mut [f32],
    log2: u32,
    count: usize,
    rng: &mut ChaCha8Rng,
    mut draw: impl FnMut(&mut ChaCha8Rng, &mut Canvas<'_>),
) {
    let edge = (1u32 << log2) as f32;
    for _ in 0..count {
        let (x, y) = (rng.random::<f32>() * edge, rng.random::<f32>() * edge);
        draw(rng, &mut Canvas { values, log2, x, y });
    }
}

impl Canvas<'_> {
    fn mix(&mut self, x: i32, y: i32, grey: f32, cover: f32) {
        let mask = (1i32 << self.log2) - 1;
        let index = ((y & mask) << self.log2) | (x & mask);
        if let Some(value) = self.values.get_mut(index as usize) {
            *value += (grey - *value) * cover;
        }
    }

    /// A round spot with a soft edge.
    fn stone(&mut self, radius: f32, grey: f32) {
        let reach = radius.ceil() as i32 + 1;
        let (cx, cy) = (self.x.floor() as i32, self.y.floor() as i32);
        for y in cy - reach..=cy + reach {
            for x in cx - reach..=cx + reach {
                let distance = (x as f32 + 0.5 - self.x).hypot(y as f32 + 0.5 - self.y);
                let cover = (radius - distance + 0.5).clamp(0.0, 1.0);
                if cover > 0.0 {
                    self.mix(x, y, grey, cover);
                }
            }
        }
    }

    /// A line in some direction that gets brighter towards its tip.
    fn blade(&mut self, angle: f32, length: f32, half_width: f32, grey: f32) {
        let (sin, cos) = angle.sin_cos();
        let reach = half_width.ceil() as i32;
        for along in 0..length as i32 {
            let t = along as f32 / length;
            let width = half_width * (1.0 - t).sqrt();
            for across in -reach..=reach {
                let cover = (width - across.abs() as f32 + 0.5).clamp(0.0, 1.0);
                let (a, b) = (along as f32, across as f32);
                let (x, y) = (self.x + a * cos - b * sin, self.y + a * sin + b * cos);
                self.mix(x.floor() as i32, y.floor() as i32, grey * (0.6 + 0.4 * t), cover);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn span(height_m: f64, smear_px: f64) -> Span {
        let pixel_m = height_m / 1818.0;
        Span {
            from_m: [-3.0, 2.0],
            to_m: [-3.0 + 1024.0 * pixel_m, 2.0],
            smear_m: [smear_px * pixel_m, 0.0],
            footprint_m: pixel_m,
        }
    }

    fn row(ground: &Ground, span: &Span) -> Vec<f32> {
        let mut row = vec![ground.mean(); 1024];
        ground.add_grain(span, &mut row);
        row
    }

    fn deviation(row: &[f32]) -> f32 {
        let mean = row.iter().sum::<f32>() / row.len() as f32;
        (row.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / row.len() as f32).sqrt()
    }

    #[test]
    fn every_ground_but_the_plain_one_has_grain_at_every_height() {
        for surface in Surface::ALL {
            let ground = Ground::new(surface, 1);
            for height_m in [0.3, 1.0, 3.0, 10.0] {
                let grain = deviation(&row(&ground, &span(height_m, 0.0)));
                let expected = if surface == Surface::Plain { 0.0..1e-9 } else { 0.004..0.12 };
                assert!(expected.contains(&grain), "{surface:?} at {height_m} m: {grain}");
            }
        }
    }

    #[test]
    fn motion_wipes_grain_out_and_keeps_the_mean() {
        let ground = Ground::new(Surface::Asphalt, 1);
        let (still, moved) = (row(&ground, &span(5.0, 0.0)), row(&ground, &span(5.0, 6.0)));
        assert!(deviation(&moved) < 0.7 * deviation(&still));
        let mean = |row: &[f32]| row.iter().sum::<f32>() / row.len() as f32;
        assert!((mean(&still) - mean(&moved)).abs() < 0.003);
    }

    #[test]
    fn the_seed_is_all_that_chance_knows() {
        let look = |seed| row(&Ground::new(Surface::Grass, seed), &span(2.0, 0.0));
        assert_eq!(look(7), look(7));
        assert_ne!(look(7), look(8));
    }

    #[test]
    fn a_texture_repeats_without_a_seam_and_takes_any_place() {
        let ground = Ground::new(Surface::Tiles, 3);
        let at = |north_m: f64| {
            let mut value = [0.0];
            let to_m = [north_m + 0.01, 0.5];
            let smear_m = [0.0; 2];
            ground.add_grain(
                &Span { from_m: [north_m, 0.5], to_m, smear_m, footprint_m: 0.002 },
                &mut value,
            );
            value[0]
        };
        let period_m = 2048.0 * 0.002;
        assert!((at(0.7) - at(0.7 + 3.0 * period_m)).abs() < 1e-3);
        assert!((at(-period_m - 1e-6) - at(-1e-6)).abs() < 1e-3);
        for wild in [1e9, -1e300, f64::INFINITY, f64::NAN] {
            assert!(at(wild).is_finite());
        }
    }

    #[test]
    fn grounds_are_named() {
        assert_eq!("tiles".parse(), Ok(Surface::Tiles));
        assert!("mud".parse::<Surface>().unwrap_err().contains("asphalt, grass"));
    }
}
