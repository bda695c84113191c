//! Applies a lens's errors besides a Gaussian blur: field curvature, lateral colour, veiling glare. Also changes from frame
//! to frame: flicker of lamps, steps of the exposure.

use serde::{Deserialize, Serialize};

use super::filters::Gaussian;

/// The flaws of a lens; by default none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Lens {
    /// Standard deviation of the blur that the corners of the image have more than its middle, in pixels,
    /// from 0 to 5; it grows with the square of the distance from the middle (field curvature).
    pub curvature_px: f32,
    /// Distance of blue from green in the corners, in pixels outwards, from -3 to 3 (lateral colour). Red lies
    /// on the other side, so that grey is where a calibration has it. Only with a mosaic.
    pub fringe_px: f32,
    /// Part of the light that is spread over the whole image, from 0 to 0.5 (veiling glare).
    pub flare: f32,
}

/// The changes from frame to frame; by default none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Unsteady {
    /// Part of the light that comes and goes with the mains, from 0 to 1, which a rolling shutter shows as
    /// bands.
    pub flicker: f32,
    /// Number of such bands in the image, from 0 to 20: twice the mains' frequency times the readout time.
    pub bands: f32,
    /// Maximum step of the automatic exposure from frame to frame, in stops, from 0 to 2.
    pub exposure_stops: f32,
}

/// Weights of red and blue in grey.
const RED_OVER_BLUE: f32 = 0.114 / 0.299;

impl Lens {
    pub(super) fn is_sound(&self) -> bool {
        (0.0..=5.0).contains(&self.curvature_px)
            && (-3.0..=3.0).contains(&self.fringe_px)
            && (0.0..=0.5).contains(&self.flare)
    }

    /// Blurs and veils the light of a whole frame.
    pub(super) fn spread(
        &self,
        light: &mut [f32],
        width: usize,
        work: &mut Vec<f32>,
        blurred: &mut Vec<f32>,
    ) {
        if self.curvature_px > 0.0 {
            Gaussian::new(self.curvature_px.max(0.3)).blur(light, width, work, blurred);
            let field = Field::new(light.len(), width);
            let across: Vec<f32> =
                (0..width).map(|u| field.part2([u as f32 - field.middle[0], 0.0])).collect();
            let rows = light.chunks_mut(width).zip(blurred.chunks(width)).enumerate();
            for (v, (row, soft)) in rows {
                let down = field.part2([0.0, v as f32 - field.middle[1]]);
                for ((level, soft), across) in row.iter_mut().zip(soft).zip(&across) {
                    // A core and a skirt whose variance grows with the fourth power of the distance.
                    let part2 = across + down;
                    *level += (part2 * part2).min(1.0) * (soft - *level);
                }
            }
        }
        if self.flare > 0.0 {
            let mean = sum(light) / light.len().max(1) as f32;
            for level in light {
                *level += self.flare * (mean - *level);
            }
        }
    }

    /// Moves red and blue of an RGGB mosaic's light, of which `source` has all colours alike.
    pub(super) fn fringe(&self, source: &[f32], light: &mut [f32], width: usize) {
        let width = width.max(1);
        let field = Field::new(light.len(), width);
        let height = light.len() / width;
        // Of red and of blue: pixels further outwards in the image come from nearer the centre, by a fraction of the distance
        // that is the same everywhere. So each column and each row has its own taps.
        let scales = [-self.fringe_px * RED_OVER_BLUE, self.fringe_px]
            .map(|outwards| -outwards / field.half_diagonal);
        let taps = |at: usize, middle: f32, scale: f32, edge: usize| {
            Taps::new(at as f32 + (at as f32 - middle) * scale, edge)
        };
        let columns = [0, 1].map(|first| -> Vec<Taps> {
            let own = (first..width).step_by(2);
            own.map(|u| taps(u, field.middle[0], scales[first], width)).collect()
        });
        let mut line = vec![0.0; width];
        for (v, row) in light.chunks_exact_mut(width).enumerate() {
            let Taps { places, weights } = taps(v, field.middle[1], scales[v % 2], height);
            line.fill(0.0);
            for (place, weight) in places.into_iter().zip(weights) {
                let from = source.get(place * width..(place + 1) * width).unwrap_or(&[]);
                line.iter_mut().zip(from).for_each(|(sum, level)| *sum += weight * level);
            }
            let own = row.iter_mut().skip(v % 2).step_by(2);
            for (level, taps) in own.zip(&columns[v % 2]) {
                *level = taps.of(&line);
            }
        }
    }
}

impl Unsteady {
    pub(super) fn is_sound(&self) -> bool {
        (0.0..=1.0).contains(&self.flicker)
            && (0.0..=20.0).contains(&self.bands)
            && (0.0..=2.0).contains(&self.exposure_stops)
    }

    /// The factor of row `v`'s light in a frame.
    pub(super) fn gain(&self, frame_index: u64, v: usize, height: usize) -> f32 {
        // The golden ratio spreads phases and steps evenly over the frames.
        const RATIO: f64 = 0.618_033_988_749_894_9;
        let spread = |by: f64| (frame_index as f64 * RATIO * by).fract() as f32;
        let place = v as f32 / height.max(1) as f32;
        let phase = std::f32::consts::TAU * (self.bands * place + spread(1.0));
        let lamp = 1.0 - self.flicker * 0.5 * (1.0 + phase.sin());
        lamp * (self.exposure_stops * (spread(RATIO) - 0.5)).exp2()
    }
}

/// Places relative to the middle of an image.
struct Field {
    middle: [f32; 2],
    half_diagonal: f32,
}

impl Field {
    fn new(len: usize, width: usize) -> Self {
        let edges = [width, len / width.max(1)].map(|edge| edge.saturating_sub(1) as f32);
        let middle = edges.map(|edge| 0.5 * edge);
        Self { middle, half_diagonal: middle[0].hypot(middle[1]).max(1.0) }
    }

    /// The squared length of an offset; 1 from the middle to a corner.
    fn part2(&self, [x, y]: [f32; 2]) -> f32 {
        (x * x + y * y) / (self.half_diagonal * self.half_diagonal)
    }
}

/// The pixels along a line that make the value between two of them, and their weights (Keys, "Cubic convolution
/// interpolation for digital image processing", 1981). Beyond the ends the last ones count again.
#[derive(Copy, Clone, Debug)]
struct Taps {
    places: [usize; 4],
    weights: [f32; 4],
}

impl Taps {
    fn new(along: f32, edge: usize) -> Self {
        let low = along.floor();
        let t = along - low;
        let last = edge.saturating_sub(1) as isize;
        Self {
            places: [-1, 0, 1, 2].map(|k| (low as isize + k).clamp(0, last) as usize),
            weights: [
                ((-0.5 * t + 1.0) * t - 0.5) * t,
                (1.5 * t - 2.5) * t * t + 1.0,
                ((-1.5 * t + 2.0) * t + 0.5) * t,
                (0.5 * t - 0.5) * t * t,
            ],
        }
    }

    fn of(&self, line: &[f32]) -> f32 {
        let value = |(place, weight): (&usize, &f32)| weight * line.get(*place).unwrap_or(&0.0);
        self.places.iter().zip(&self.weights).map(value).sum()
    }
}

/// The sum of an image, several pixels at once.
fn sum(image: &[f32]) -> f32 {
    const LANES: usize = 16;
    let mut sums = [0.0f32; LANES];
    let parts = image.chunks_exact(LANES);
    let rest: f32 = parts.remainder().iter().sum();
    for part in parts {
        sums.iter_mut().zip(part).for_each(|(sum, level)| *sum += level);
    }
    sums.iter().sum::<f32>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    const WIDTH: usize = 65;
    const HEIGHT: usize = 49;

    /// A wave along the rows, which is slow against a pixel.
    fn wave(phase_px: f32) -> Vec<f32> {
        (0..WIDTH * HEIGHT)
            .map(|i| 100.0 + 50.0 * (0.3 * ((i % WIDTH) as f32 - phase_px)).sin())
            .collect()
    }

    #[test]
    fn blue_moves_outwards_by_its_fringe_and_green_stays() {
        let source = wave(0.0);
        let mut light = source.clone();
        let lens = Lens { fringe_px: 0.5, ..Lens::default() };
        lens.fringe(&source, &mut light, WIDTH);
        // Blue (odd column, odd row) right of the middle, almost half-way to the corner.
        let (u, v) = (51, 25);
        let by_px = 0.5 * (51.0 - 32.0) / 32f32.hypot(24.0);
        let expected = wave(by_px)[v * WIDTH + u];
        assert!((light[v * WIDTH + u] - expected).abs() < 0.05);
        let green = v * WIDTH + u + 1;
        assert_eq!(light[green], source[green]);
    }

    #[test]
    fn corners_are_blurred_and_the_middle_is_not() {
        let mut light = wave(0.0);
        light.iter_mut().enumerate().for_each(|(i, level)| *level += (i % 2) as f32 * 40.0);
        let before = light.clone();
        let lens = Lens { curvature_px: 1.5, ..Lens::default() };
        lens.spread(&mut light, WIDTH, &mut Vec::new(), &mut Vec::new());
        let middle = 24 * WIDTH + 32;
        assert!((light[middle] - before[middle]).abs() < 0.1);
        assert!((light[0] - before[0]).abs() > 5.0);
    }

    #[test]
    fn flare_lifts_black_and_keeps_the_mean() {
        let mut light: Vec<f32> = (0..WIDTH * HEIGHT).map(|i| (i % 2) as f32 * 200.0).collect();
        let lens = Lens { flare: 0.1, ..Lens::default() };
        lens.spread(&mut light, WIDTH, &mut Vec::new(), &mut Vec::new());
        assert!((light[0] - 10.0).abs() < 0.1 && (light[1] - 190.0).abs() < 0.1);
    }

    #[test]
    fn flicker_makes_bands_and_the_exposure_stays_within_its_steps() {
        let unsteady = Unsteady { flicker: 0.4, bands: 2.0, exposure_stops: 0.0 };
        let gains: Vec<f32> = (0..480).map(|v| unsteady.gain(3, v, 480)).collect();
        let [low, high] = [f32::min as fn(f32, f32) -> f32, f32::max]
            .map(|pick| gains.iter().copied().reduce(pick).unwrap());
        assert!((low - 0.6).abs() < 0.01 && (high - 1.0).abs() < 0.01);
        assert!((gains[10] - gains[250]).abs() < 0.02);
        let unsteady = Unsteady { exposure_stops: 1.0, ..Unsteady::default() };
        assert!((0..100).all(|k| (0.70..=1.42).contains(&unsteady.gain(k, 0, 480))));
        assert_eq!(Unsteady::default().gain(9, 7, 480), 1.0);
    }
}
