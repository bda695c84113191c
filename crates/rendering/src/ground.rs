//! Generates the ground (asphalt, grass, tiles, plain) from a seed, and gives its reflectance: patches at a
//! point, grain along a row of pixels.
//!
//! Coarse and fine grain are tiles of 8-bit texels with mipmaps. Patches metres across hide the repetition from
//! heights at which a tile's period fits into the image.

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
    /// Every kind, in the order of messages.
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
            format!("unknown ground `{text}`; it must be one of {known}")
        })
    }
}

/// A row of pixels on the ground: its ends, and the area that a pixel averages.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Span {
    /// North and east of the first pixel's centre, in metres.
    pub from_m: [f64; 2],
    /// North and east of the pixel after the last, in metres.
    pub to_m: [f64; 2],
    /// Motion of the pixels over the ground during the exposure, in metres.
    pub smear_m: [f64; 2],
    /// Edge of the area that a pixel sees, in metres.
    pub footprint_m: f64,
}

/// The ground and its textures.
#[derive(Clone, Debug)]
pub struct Ground {
    mean: f32,
    coarse: Option<Texture>,
    fine: Option<Texture>,
    patches: Option<Patches>,
}

/// Edge of a texel in footprints for bilinear sampling, whose blur (box and triangle) then has the variance of a
/// pixel behind a common lens (box and Gaussian).
const TEXEL_PER_FOOTPRINT: f64 = 1.33;

/// Edge of a texel in footprints for nearest-neighbour sampling, whose blur has no triangle.
const NEAREST_TEXEL_PER_FOOTPRINT: f64 = 0.8;

/// Motion above which samples along it replace bilinear interpolation, in texels.
const LONG_SMEAR: f64 = 1.5;

/// Number of samples along a long motion.
const TAPS: usize = 3;

/// Number of pixels sampled together.
const BATCH: usize = 64;

/// Distance between samples where pixels are much finer than texels, in pixels.
const STRIDE: usize = 4;

/// Minimum standard deviation of a texture level, as a reflectance: less is a fraction of a grey level.
const MIN_CONTRAST: f32 = 0.0025;

impl Ground {
    /// A ground of this kind, generated from `seed`.
    pub fn new(surface: Surface, seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6772_6f75_6e64);
        match surface {
            Surface::Asphalt => asphalt(&mut rng),
            Surface::Grass => grass(&mut rng),
            Surface::Tiles => tiles(&mut rng),
            Surface::Plain => Self { mean: 0.35, coarse: None, fine: None, patches: None },
        }
    }

    /// Mean reflectance.
    pub fn mean(&self) -> f32 {
        self.mean
    }

    /// Reflectance at a point (north and east in metres) without the grain.
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

/// A square tile of texels and its mipmaps.
#[derive(Clone, Debug)]
struct Texture {
    texel_m: f64,
    /// Reflectance per unit of a texel.
    gain: f32,
    /// From fine to coarse; each has half the edge of the previous one.
    levels: Vec<Level>,
}

/// One resolution of a tile. A texel of 128 adds nothing.
#[derive(Clone, Debug)]
struct Level {
    /// Edge in texels as a power of two.
    log2: u32,
    /// Each texel with the one below it in the upper byte, row by row. Each row ends with its first texel again,
    /// so that the right neighbour always follows.
    pairs: Vec<u16>,
}

impl Texture {
    /// From zero-mean reflectances on a square of 2^`log2` texels.
    fn new(texel_m: f64, log2: u32, mut values: Vec<f32>) -> Self {
        let largest = values.iter().fold(1e-6f32, |m, v| m.max(v.abs()));
        let gain = largest / 127.0;
        let mut levels = Vec::new();
        for log2 in (0..=log2).rev() {
            levels.push(Level::new(log2, &values, gain));
            values = halve(&values, 1 << log2);
            if deviation(&values) < MIN_CONTRAST {
                break;
            }
        }
        Self { texel_m, gain, levels }
    }

    fn add(&self, span: &Span, row: &mut [f32]) {
        let smear_m =
            (span.smear_m[0] * span.smear_m[0] + span.smear_m[1] * span.smear_m[1]).sqrt();
        let halvings = nearest_log2(span.footprint_m * TEXEL_PER_FOOTPRINT / self.texel_m);
        let texel_m = self.texel_m * (1u64 << halvings) as f64;
        if smear_m < LONG_SMEAR * texel_m {
            if let Some(level) = self.levels.get(halvings) {
                level.add_bilinear(self.gain, &Walk::new(span, texel_m, row.len()), row);
            }
            return;
        }
        // The texels are as coarse as the distance between samples.
        let share_m = (smear_m / TAPS as f64).max(span.footprint_m);
        let halvings = nearest_log2(share_m * NEAREST_TEXEL_PER_FOOTPRINT / self.texel_m);
        let texel_m = self.texel_m * (1u64 << halvings) as f64;
        if let Some(level) = self.levels.get(halvings) {
            level.add_smeared(self.gain, &Walk::new(span, texel_m, row.len()), row);
        }
    }
}

/// A span in texels, as fixed-point numbers with 16 fractional bits, which wrap around.
struct Walk {
    start: [u32; 2],
    step: [u32; 2],
    smear: [u32; 2],
}

impl Walk {
    fn new(span: &Span, texel_m: f64, count: usize) -> Self {
        let scale = 1.0 / texel_m;
        let step = scale / count.max(1) as f64;
        Self {
            start: span.from_m.map(|m| fixed(m * scale)),
            step: [0, 1].map(|i| fixed((span.to_m[i] - span.from_m[i]) * step)),
            smear: span.smear_m.map(|m| fixed(m * scale)),
        }
    }
}

impl Level {
    fn new(log2: u32, values: &[f32], gain: f32) -> Self {
        let edge = 1usize << log2;
        let quantise = |v: &f32| (v / gain + 128.5).clamp(0.0, 255.0) as u8;
        let rows = values.chunks_exact(edge);
        let below = rows.clone().cycle().skip(1);
        let pair =
            |(upper, lower): (&f32, &f32)| u16::from_le_bytes([quantise(upper), quantise(lower)]);
        let pairs = rows
            .zip(below)
            .flat_map(|(upper, lower)| {
                let around =
                    |row: &'_ [f32]| row.iter().chain(row.first()).copied().collect::<Vec<_>>();
                around(upper).iter().zip(&around(lower)).map(pair).collect::<Vec<_>>()
            })
            .collect();
        Self { log2, pairs }
    }

    fn add_bilinear(&self, gain: f32, walk: &Walk, row: &mut [f32]) {
        // From texel corners to texel centres.
        let [mut x, mut y] = walk.start.map(|s| s.wrapping_sub(1 << 15));
        let [dx, dy] = walk.step;
        let fine = |step: u32| (step as i32).unsigned_abs() < (1 << 16) / STRIDE as u32;
        if fine(dx) && fine(dy) {
            self.add_sparsely(gain, [x, y], walk.step, row);
            return;
        }
        let mut fours = [0; BATCH];
        for values in row.chunks_mut(BATCH) {
            // Three loops, so that indices and interpolation are vectorised.
            for (index, four) in fours.iter_mut().enumerate() {
                let ahead = index as u32;
                let (x, y) = (
                    x.wrapping_add(dx.wrapping_mul(ahead)),
                    y.wrapping_add(dy.wrapping_mul(ahead)),
                );
                *four = self.index(x, y);
            }
            for four in fours.iter_mut().take(values.len()) {
                *four = self.four(*four);
            }
            for (value, four) in values.iter_mut().zip(&fours) {
                *value += mixed(*four, x, y) * gain;
                (x, y) = (x.wrapping_add(dx), y.wrapping_add(dy));
            }
        }
    }

    /// Samples every [`STRIDE`]th pixel and interpolates between them.
    fn add_sparsely(&self, gain: f32, start: [u32; 2], step: [u32; 2], row: &mut [f32]) {
        let [mut x, mut y] = start;
        let mut from = mixed(self.four(self.index(x, y)), x, y) * gain;
        for values in row.chunks_mut(STRIDE) {
            x = x.wrapping_add(step[0].wrapping_mul(STRIDE as u32));
            y = y.wrapping_add(step[1].wrapping_mul(STRIDE as u32));
            let to = mixed(self.four(self.index(x, y)), x, y) * gain;
            let slope = (to - from) / STRIDE as f32;
            for (index, value) in values.iter_mut().enumerate() {
                *value += from + slope * index as f32;
            }
            from = to;
        }
    }

    /// Index of the texel at a point.
    fn index(&self, x: u32, y: u32) -> u32 {
        let mask = (1u32 << self.log2) - 1;
        let (column, row) = ((x >> 16) & mask, (y >> 16) & mask);
        (row << self.log2) + row + column
    }

    /// A texel and, in the higher bytes, those below, right, and below right.
    fn four(&self, index: u32) -> u32 {
        match self.pairs.get(index as usize..index as usize + 2) {
            Some(&[left, right]) => u32::from(left) | (u32::from(right) << 16),
            _ => 0x8080_8080,
        }
    }

    fn add_smeared(&self, gain: f32, walk: &Walk, row: &mut [f32]) {
        let gain = gain / TAPS as f32;
        let third = walk.smear.map(|smear| smear as i32 / TAPS as i32);
        let [dx, dy] = walk.step;
        let (mut indices, mut sums) = ([0; BATCH], [0; BATCH]);
        let [mut x, mut y] = walk.start;
        for values in row.chunks_mut(BATCH) {
            sums.fill(-128 * TAPS as i32);
            for thirds in [-1, 0, 1] {
                let [ahead_x, ahead_y] = third.map(|third| third.wrapping_mul(thirds) as u32);
                let (x, y) = (x.wrapping_add(ahead_x), y.wrapping_add(ahead_y));
                for (count, index) in indices.iter_mut().enumerate() {
                    let count = count as u32;
                    *index = self.index(
                        x.wrapping_add(dx.wrapping_mul(count)),
                        y.wrapping_add(dy.wrapping_mul(count)),
                    );
                }
                for (sum, index) in sums.iter_mut().zip(&indices).take(values.len()) {
                    let pair = self.pairs.get(*index as usize).copied();
                    *sum += i32::from(pair.unwrap_or(0x8080) & 255);
                }
            }
            for (value, sum) in values.iter_mut().zip(&sums) {
                *value += *sum as f32 * gain;
            }
            let count = values.len() as u32;
            x = x.wrapping_add(dx.wrapping_mul(count));
            y = y.wrapping_add(dy.wrapping_mul(count));
        }
    }
}

/// Bilinear interpolation of four texels, minus 128.
fn mixed(four: u32, x: u32, y: u32) -> f32 {
    let byte = |shift: u32| ((four >> shift) & 255) as i32 as f32;
    let [fx, fy] = [x, y].map(|place| (place & 0xffff) as i32 as f32 * (1.0 / 65_536.0));
    let left = byte(0) + (byte(8) - byte(0)) * fy;
    let right = byte(16) + (byte(24) - byte(16)) * fy;
    left + (right - left) * fx - 128.0
}

/// Texels as a fixed-point number with 16 fractional bits, which wraps around.
fn fixed(texels: f64) -> u32 {
    (texels * 65_536.0) as i64 as u32
}

/// The rounded binary logarithm, from the exponent; 0 below 1.
fn nearest_log2(value: f64) -> usize {
    let exponent = ((value * std::f64::consts::SQRT_2).to_bits() >> 52) & 0x7ff;
    (exponent as usize).saturating_sub(1023)
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

/// Variation over metres.
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
    let mut coarse = noise(rng, 11, &[(7, 0.5), (6, 0.5), (5, 0.5), (4, 0.6), (3, 0.6), (2, 0.4)]);
    normalise(&mut coarse, 0.022);
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
        coarse: Some(Texture::new(0.0025, 11, centred(coarse))),
        fine: Some(Texture::new(0.00025, 10, centred(fine))),
        patches: Some(Patches::new(rng, 0.018)),
    }
}

fn grass(rng: &mut ChaCha8Rng) -> Ground {
    let mut coarse = noise(rng, 11, &[(7, 0.6), (6, 0.9), (5, 1.0), (4, 1.0), (3, 0.7)]);
    normalise(&mut coarse, 0.05);
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
        coarse: Some(Texture::new(0.0025, 11, centred(coarse))),
        fine: Some(Texture::new(0.00025, 10, centred(fine))),
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
        coarse: Some(Texture::new(0.002, 11, centred(coarse))),
        fine: Some(Texture::new(0.00025, 10, centred(fine))),
        patches: Some(Patches::new(rng, 0.015)),
    }
}

/// Periodic value noise on a square of 2^`log2` texels: a sum of octaves (log2 of the wavelength in texels,
/// amplitude).
fn noise(rng: &mut impl Rng, log2: u32, octaves: &[(u32, f32)]) -> Vec<f32> {
    let edge = 1usize << log2;
    let mut sum = vec![0.0f32; edge * edge];
    for &(wave, amplitude) in octaves {
        let (cells, length) = (edge >> wave, 1usize << wave);
        let lattice: Vec<f32> =
            (0..cells * cells).map(|_| rng.random_range(-amplitude..amplitude)).collect();
        let weights: Vec<f32> = (0..length)
            .map(|texel| {
                let t = texel as f32 / length as f32;
                t * t * (3.0 - 2.0 * t)
            })
            .collect();
        for (y, row) in sum.chunks_exact_mut(edge).enumerate() {
            let weight = weights.get(y % length).copied().unwrap_or(0.0);
            let knots = |cell: usize| lattice.iter().skip(cell % cells * cells).take(cells);
            let mixed =
                knots(y / length).zip(knots(y / length + 1)).map(|(u, l)| u + (l - u) * weight);
            let mixed: Vec<f32> = mixed.collect();
            let next = mixed.iter().cycle().skip(1);
            for ((values, from), to) in row.chunks_exact_mut(length).zip(&mixed).zip(next) {
                for (value, weight) in values.iter_mut().zip(&weights) {
                    *value += from + (to - from) * weight;
                }
            }
        }
    }
    sum
}

/// Root of the mean square.
fn deviation(values: &[f32]) -> f32 {
    (values.iter().map(|v| v * v).sum::<f32>() / values.len().max(1) as f32).sqrt()
}

/// Scales values to a standard deviation.
fn normalise(values: &mut [f32], to: f32) {
    let factor = to / deviation(values).max(1e-9);
    values.iter_mut().for_each(|v| *v *= factor);
}

/// Values minus their mean.
fn centred(mut values: Vec<f32>) -> Vec<f32> {
    let mean = values.iter().map(|v| f64::from(*v)).sum::<f64>() / values.len().max(1) as f64;
    values.iter_mut().for_each(|v| *v -= mean as f32);
    values
}

/// A point on a tile at which a small shape is drawn; it wraps around at the edges.
struct Canvas<'a> {
    values: &'a mut [f32],
    log2: u32,
    x: f32,
    y: f32,
}

/// The texel at a coordinate near a tile.
fn texel(place: f32) -> i32 {
    const FAR: f32 = 4096.0;
    (place + FAR) as i32 - FAR as i32
}

/// Draws `count` shapes at random points.
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
        let (cx, cy) = (texel(self.x), texel(self.y));
        for y in cy - reach..=cy + reach {
            for x in cx - reach..=cx + reach {
                let (dx, dy) = (x as f32 + 0.5 - self.x, y as f32 + 0.5 - self.y);
                let cover = radius + 0.5 - (dx * dx + dy * dy).sqrt();
                if cover > 0.0 {
                    self.mix(x, y, grey, cover.min(1.0));
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
                self.mix(texel(x), texel(y), grey * (0.6 + 0.4 * t), cover);
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

    fn contrast(row: &[f32]) -> f32 {
        let mean = row.iter().sum::<f32>() / row.len() as f32;
        deviation(&row.iter().map(|v| v - mean).collect::<Vec<_>>())
    }

    #[test]
    fn every_ground_except_plain_has_grain_at_every_height() {
        for surface in Surface::ALL {
            let ground = Ground::new(surface, 1);
            for height_m in [0.3, 1.0, 3.0, 10.0] {
                let grain = contrast(&row(&ground, &span(height_m, 0.0)));
                let expected = if surface == Surface::Plain { 0.0..1e-5 } else { 0.004..0.12 };
                assert!(expected.contains(&grain), "{surface:?} at {height_m} m: {grain}");
            }
        }
    }

    #[test]
    fn motion_blurs_grain_and_keeps_the_mean() {
        let ground = Ground::new(Surface::Asphalt, 1);
        let (still, moved) = (row(&ground, &span(2.0, 0.0)), row(&ground, &span(2.0, 24.0)));
        assert!(contrast(&moved) < 0.85 * contrast(&still));
        let mean = |row: &[f32]| row.iter().sum::<f32>() / row.len() as f32;
        assert!((mean(&still) - mean(&moved)).abs() < 0.003);
    }

    #[test]
    fn a_ground_depends_on_its_seed_only() {
        let look = |seed| row(&Ground::new(Surface::Grass, seed), &span(2.0, 0.0));
        assert_eq!(look(7), look(7));
        assert_ne!(look(7), look(8));
    }

    #[test]
    fn a_texture_repeats_without_a_seam_and_accepts_any_point() {
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
