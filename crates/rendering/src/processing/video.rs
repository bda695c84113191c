//! Applies the losses of H.264 to rendered frames: each macroblock predicted with a motion vector or from its neighbours, its
//! residual transformed and quantised, the edges deblocked.
//!
//! Only residuals larger than the quantiser's step are sent. So parts of a picture stay as they were, move with their
//! surroundings, or are coded again, which no compression of single pictures shows. Motion compensation, the transform of 4 x 4
//! residuals, the quantiser and the deblocking filter are those of the format (ITU-T H.264); the free choices of an encoder are
//! those of fast ones: one motion vector for each macroblock, found by descending the sum of absolute differences, intra
//! prediction of whole macroblocks and of 4 x 4 blocks in five of its nine modes, and no blocks of single small levels. Left
//! out are the coding of the numbers, which loses nothing, chroma, partitions, the transforms of 8 x 8 pixels and of the mean
//! levels of a macroblock, the pixels above right of a block, and the control of the rate: the quantiser is the same
//! everywhere. Fewer pixels stay as they were than with x264.

mod deblock;
mod plane;
mod transform;

use serde::{Deserialize, Serialize};

use deblock::{Coded, deblock};
use plane::{MACROBLOCK, Motion, Plane, Reference};
use transform::{Block, Quantiser, worth};

/// How a stream of H.264 is made.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Video {
    /// The quantisation parameter (QP) of predicted pictures, from 10 to 51: the step is 1 at 4, and doubles with every 6. Key frames
    /// have 3 less.
    pub quantiser: u8,
    /// Pictures from key frame to key frame.
    pub key_frame_every: u16,
}

impl Video {
    pub(super) fn is_sound(&self) -> bool {
        (10..=51).contains(&self.quantiser) && self.key_frame_every > 0
    }
}

/// By how much finer key frames are quantised.
const KEY_FRAME_FINER: u8 = 3;
/// Steps of the search for a motion: by two pixels, and then by each of these, in quarters.
const MAX_STEPS: usize = 24;
const FINER: [i32; 3] = [4, 2, 1];
/// Residuals of lower cost are not coded, of a quarter of a macroblock and of the whole (thresholds on the cost of
/// coefficients, as in x264).
const MIN_WORTH_OF_QUARTER: u32 = 4;
const MIN_WORTH: u32 = 6;
/// Cost of coding how a macroblock is predicted, in bits: from the previous picture without its motion, from its neighbours as
/// a whole, and block by block.
const BITS_INTER: u32 = 1;
const BITS_INTRA: u32 = 8;
const BITS_INTRA_BLOCKS: u32 = 64;

/// Encodes and decodes a stream, picture by picture.
#[derive(Clone, Debug)]
pub(super) struct VideoCoder {
    video: Video,
    /// Pictures since the last key frame; `None` before the first one.
    since_key_frame: Option<u16>,
    /// Width and height of the pictures.
    size: [usize; 2],
    source: Plane,
    now: Plane,
    reference: Reference,
    coded: Vec<Coded>,
    /// The motions of the previous picture.
    before: Vec<Coded>,
}

impl VideoCoder {
    pub(super) fn new(video: Video) -> Self {
        Self {
            video,
            since_key_frame: None,
            size: [0; 2],
            source: Plane::default(),
            now: Plane::default(),
            reference: Reference::default(),
            coded: Vec::new(),
            before: Vec::new(),
        }
    }

    /// Replaces the next picture by the decoder's result.
    pub(super) fn apply(&mut self, pixels: &mut [u8], width: usize) {
        let height = pixels.len() / width.max(1);
        if width == 0 || height == 0 {
            return;
        }
        if self.size != [width, height] {
            *self = Self { size: [width, height], ..Self::new(self.video) };
            self.source.resize(width, height);
            self.now.resize(width, height);
            self.reference.resize(width, height);
        }
        for (y, row) in pixels.chunks_exact(width).enumerate() {
            self.source.row_mut(0, y as i32, width).copy_from_slice(row);
        }
        self.source.extend(width, height);
        self.since_key_frame = match self.since_key_frame {
            Some(since) if since + 1 < self.video.key_frame_every => Some(since + 1),
            _ => Some(0),
        };
        self.code(self.since_key_frame == Some(0));
        for (y, row) in pixels.chunks_exact_mut(width).enumerate() {
            row.copy_from_slice(self.now.row(0, y as i32, width));
        }
        std::mem::swap(self.reference.pixels(), &mut self.now);
        let [width, height] = [self.source.width, self.source.height];
        self.reference.pixels().extend(width, height);
        if self.video.key_frame_every > 1 {
            self.reference.interpolate();
        }
        std::mem::swap(&mut self.coded, &mut self.before);
    }

    /// Codes the picture into `now`.
    fn code(&mut self, is_key_frame: bool) {
        let finer = if is_key_frame { KEY_FRAME_FINER } else { 0 };
        let parameter = self.video.quantiser.saturating_sub(finer);
        let intra = Quantiser::new(parameter, true);
        let inter = Quantiser::new(parameter, false);
        // The cost of a bit in absolute differences (the Joint Model's choice for motion).
        let per_bit =
            (0.85 * 2_f64.powf((f64::from(parameter) - 12.0) / 3.0)).sqrt().max(1.0) as u32;
        self.coded.clear();
        let columns = self.source.width / MACROBLOCK;
        for y in (0..self.source.height).step_by(MACROBLOCK) {
            for x in (0..self.source.width).step_by(MACROBLOCK) {
                let block = macroblock(&self.source, x, y);
                let moved = (!is_key_frame).then(|| self.motion(&block, x, y, columns, per_bit));
                let moved_cost = moved.map_or(u32::MAX, |(_, cost)| cost);
                // Neither is looked for where saying so alone costs more.
                let is_open = |bits: u32| moved_cost > per_bit * bits;
                let whole = is_open(BITS_INTRA).then(|| self.whole_prediction(&block, x, y));
                let whole_cost =
                    whole.as_ref().map_or(u32::MAX, |(cost, _)| cost + per_bit * BITS_INTRA);
                let parts_cost = if is_open(BITS_INTRA_BLOCKS) {
                    blocks_cost(&block, &self.source, x, y) + per_bit * BITS_INTRA_BLOCKS
                } else {
                    u32::MAX
                };
                let moved = moved.filter(|(_, cost)| *cost <= whole_cost.min(parts_cost));
                let coded = if let Some((motion, _)) = moved {
                    let predicted = self.reference.predict(x, y, motion);
                    let blocks = self.code_moved(&block, &predicted, x, y, &inter);
                    Coded { is_intra: false, motion, blocks }
                } else {
                    let whole = whole.filter(|_| whole_cost <= parts_cost).map(|(_, whole)| whole);
                    self.code_intra(&block, whole.as_ref(), x, y, &intra);
                    Coded { is_intra: true, ..Coded::default() }
                };
                self.coded.push(coded);
            }
        }
        deblock(&mut self.now, &self.coded, parameter);
    }

    /// The motion that predicts a macroblock best, and its cost.
    fn motion(
        &self,
        block: &[u8; 256],
        x: usize,
        y: usize,
        columns: usize,
        per_bit: u32,
    ) -> (Motion, u32) {
        let index = self.coded.len();
        let column = index % columns;
        let known = |is_there: bool, back: usize| {
            let at = index.checked_sub(back).filter(|_| is_there);
            at.and_then(|at| self.coded.get(at)).map_or([0; 2], |coded| coded.motion)
        };
        let last = self.before.get(index).map_or([0; 2], |coded| coded.motion);
        // To the left, above, and above right or, in the last column, above left.
        let corner = if column + 1 < columns { columns - 1 } else { columns + 1 };
        let near = [known(column > 0, 1), known(true, columns), known(columns > 1, corner)];
        let expected = [0, 1].map(|axis| median(near.map(|motion| motion[axis])));
        let cost = |motion: Motion, bound: u32| {
            let bits: u32 = motion.iter().zip(expected).map(|(a, b)| bits(a - b)).sum();
            let bits = per_bit * (bits + BITS_INTER);
            bits + self.reference.difference(block, x, y, motion, bound.saturating_sub(bits))
        };
        let mut best = ([0; 2], cost([0; 2], u32::MAX));
        let attempt = |motion: Motion, best: &mut (Motion, u32)| {
            let motion = self.reference.clamped(motion, x, y);
            let cost = cost(motion, best.1);
            let is_better = cost < best.1;
            if is_better {
                *best = (motion, cost);
            }
            is_better
        };
        for motion in [expected, last, near[0], near[1], near[2]] {
            if motion != best.0 {
                attempt(motion, &mut best);
            }
        }
        let coarse = std::iter::repeat_n(8, MAX_STEPS);
        let fine = FINER.into_iter().flat_map(|step| [step; 2]);
        let mut settled = 0;
        for step in coarse.chain(fine) {
            if step == settled {
                continue;
            }
            let [dx, dy] = best.0;
            let ways = [[dx + step, dy], [dx - step, dy], [dx, dy + step], [dx, dy - step]];
            let mut is_better = false;
            for motion in ways {
                is_better |= attempt(motion, &mut best);
            }
            if !is_better {
                settled = step;
            }
        }
        best
    }

    /// Codes the residual of a prediction from the previous picture; returns which blocks have levels.
    fn code_moved(
        &mut self,
        block: &[u8; 256],
        predicted: &[u8; 256],
        x: usize,
        y: usize,
        quantiser: &Quantiser,
    ) -> u16 {
        let mut levels = [[0; 16]; 16];
        let mut worths = [0; 4];
        for (part, levels) in levels.iter_mut().enumerate() {
            *levels = quantiser.levels(&std::array::from_fn(|at| {
                let at = place_in_macroblock(part, at);
                i32::from(block[at]) - i32::from(predicted[at])
            }));
            worths[part / 8 * 2 + part % 4 / 2] += worth(levels);
        }
        let worths = worths.map(|worth| if worth < MIN_WORTH_OF_QUARTER { 0 } else { worth });
        let is_worth = worths.iter().sum::<u32>() >= MIN_WORTH;
        let mut blocks = 0;
        for (part, levels) in levels.iter().enumerate() {
            let is_coded = is_worth
                && worths[part / 8 * 2 + part % 4 / 2] > 0
                && levels.iter().any(|level| *level != 0);
            let residual = if is_coded { quantiser.residual(levels) } else { [0; 16] };
            blocks |= u16::from(is_coded) << part;
            let at = |at| i32::from(predicted[place_in_macroblock(part, at)]);
            self.write(x + part % 4 * 4, y + part / 4 * 4, std::array::from_fn(at), &residual);
        }
        blocks
    }

    /// Codes a macroblock that is predicted as a whole, or else block by block, from the coded part of the picture.
    fn code_intra(
        &mut self,
        block: &[u8; 256],
        whole: Option<&[u8; 256]>,
        x: usize,
        y: usize,
        quantiser: &Quantiser,
    ) {
        for part in 0..16 {
            let (left, top) = (x + part % 4 * 4, y + part / 4 * 4);
            let own: Block =
                std::array::from_fn(|at| i32::from(block[place_in_macroblock(part, at)]));
            let predicted = match whole {
                Some(whole) => {
                    std::array::from_fn(|at| i32::from(whole[place_in_macroblock(part, at)]))
                }
                None => best_prediction(&own, &self.now, left, top).1,
            };
            let levels = quantiser.levels(&std::array::from_fn(|at| own[at] - predicted[at]));
            self.write(left, top, predicted, &quantiser.residual(&levels));
        }
    }

    /// Writes a block of 4 x 4 pixels.
    fn write(&mut self, x: usize, y: usize, predicted: Block, residual: &Block) {
        for row in 0..4 {
            let out = self.now.row_mut(x as i32, (y + row) as i32, 4);
            for (column, pixel) in out.iter_mut().enumerate() {
                let at = 4 * row + column;
                *pixel = (predicted[at] + residual[at]).clamp(0, 255) as u8;
            }
        }
    }

    /// The best prediction of a whole macroblock from its neighbours, with the sum of its absolute differences.
    fn whole_prediction(&self, block: &[u8; 256], x: usize, y: usize) -> (u32, [u8; 256]) {
        let above = (y > 0).then(|| self.now.row(x as i32, y as i32 - 1, MACROBLOCK));
        let left = (x > 0).then(|| column(&self.now, x, y));
        let around = above.into_iter().flatten().chain(left.iter().flatten());
        let count = around.clone().count() as u32;
        let sum: u32 = around.map(|grey| u32::from(*grey)).sum();
        let mean = (sum + count / 2).checked_div(count).map_or(128, |mean| mean as u8);
        let mut best = (difference(block, &[mean; 256]), [mean; 256]);
        let mut attempt = |fill: &dyn Fn(usize, &mut [u8])| {
            let mut predicted = [0; 256];
            for (row, line) in predicted.chunks_exact_mut(MACROBLOCK).enumerate() {
                fill(row, line);
            }
            let cost = difference(block, &predicted);
            if cost < best.0 {
                best = (cost, predicted);
            }
        };
        if let Some(above) = above {
            attempt(&|_, line| line.copy_from_slice(above));
        }
        if let Some(left) = left {
            attempt(&|row, line| line.fill(left[row]));
        }
        best
    }
}

fn macroblock(plane: &Plane, x: usize, y: usize) -> [u8; 256] {
    let mut block = [0; 256];
    for (row, line) in block.chunks_exact_mut(MACROBLOCK).enumerate() {
        line.copy_from_slice(plane.row(x as i32, (y + row) as i32, MACROBLOCK));
    }
    block
}

/// The column of pixels to the left of a macroblock.
fn column(plane: &Plane, x: usize, y: usize) -> [u8; MACROBLOCK] {
    std::array::from_fn(|row| plane.row(x as i32 - 1, (y + row) as i32, 1)[0])
}

fn difference(block: &[u8; 256], predicted: &[u8; 256]) -> u32 {
    block.iter().zip(predicted).map(|(a, b)| u32::from(a.abs_diff(*b))).sum()
}

/// Index in a macroblock of a pixel of one of its 16 blocks.
#[inline]
fn place_in_macroblock(part: usize, at: usize) -> usize {
    (part / 4 * 4 + at / 4) * MACROBLOCK + part % 4 * 4 + at % 4
}

/// The approximate cost of predicting the blocks of a macroblock one by one: from the pixels of the picture itself, as the
/// coded ones are not known before.
fn blocks_cost(block: &[u8; 256], source: &Plane, x: usize, y: usize) -> u32 {
    (0..16)
        .map(|part| {
            let own = std::array::from_fn(|at| i32::from(block[place_in_macroblock(part, at)]));
            best_prediction(&own, source, x + part % 4 * 4, y + part / 4 * 4).0
        })
        .sum()
}

/// The best intra prediction of a block of 4 x 4 pixels at (x, y), of the modes whose neighbours are in the picture: their mean, from above,
/// from the left, along the two diagonals; with the sum of its absolute differences.
fn best_prediction(own: &Block, plane: &Plane, x: usize, y: usize) -> (u32, Block) {
    let (has_left, has_above) = (x > 0, y > 0);
    // Pixels outside the picture are in the plane's margin.
    let (x, y) = (x as i32, y as i32);
    let above = plane.row(x - 1, y - 1, 5);
    let left = [0, 1, 2, 3].map(|row| plane.row(x - 1, y + row, 1)[0]);
    let [corner, a, b, c, d] = [0, 1, 2, 3, 4].map(|at| i32::from(above[at]));
    let [e, f, g, h] = left.map(i32::from);
    let (sum_above, sum_left) = (a + b + c + d, e + f + g + h);
    let mean = match (has_above, has_left) {
        (true, true) => (sum_above + sum_left + 4) >> 3,
        (true, false) => (sum_above + 2) >> 2,
        (false, true) => (sum_left + 2) >> 2,
        (false, false) => 128,
    };
    let soft = |a: i32, b: i32, c: i32| (a + 2 * b + c + 2) >> 2;
    // From the lower left to the upper right along the border, smoothed.
    let border = [
        soft(h, g, f),
        soft(g, f, e),
        soft(f, e, corner),
        soft(e, corner, a),
        soft(corner, a, b),
        soft(a, b, c),
        soft(b, c, d),
    ];
    let predictions: [(bool, Block); 5] = [
        (true, [mean; 16]),
        (has_above, std::array::from_fn(|at| [a, b, c, d][at % 4])),
        (has_left, std::array::from_fn(|at| [e, f, g, h][at / 4])),
        (has_above && has_left, std::array::from_fn(|at| border[3 + at % 4 - at / 4])),
        (
            has_above,
            std::array::from_fn(|at| {
                let line = [a, b, c, d, d, d, d, d];
                let from = at % 4 + at / 4;
                soft(line[from], line[from + 1], line[(from + 2).min(7)])
            }),
        ),
    ];
    let cost = |predicted: &Block| own.iter().zip(predicted).map(|(a, b)| a.abs_diff(*b)).sum();
    predictions
        .into_iter()
        .filter(|(is_known, _)| *is_known)
        .map(|(_, predicted)| (cost(&predicted), predicted))
        .min_by_key(|(cost, _)| *cost)
        .unwrap_or((u32::MAX, [mean; 16]))
}

fn median([a, b, c]: [i32; 3]) -> i32 {
    a.max(b).min(a.min(b).max(c))
}

/// Bits of a signed number in Exp-Golomb code.
fn bits(value: i32) -> u32 {
    let code = 2 * value.unsigned_abs() + u32::from(value <= 0);
    2 * code.ilog2() + 1
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::processing::rms;

    const SIZE: [usize; 2] = [150, 90];

    /// Blots and a noise that moves with them, seen from a place.
    fn scene([left, top]: [f64; 2]) -> Vec<u8> {
        (0..SIZE[0] * SIZE[1])
            .map(|at| {
                let (x, y) = ((at % SIZE[0]) as f64 + left, (at / SIZE[0]) as f64 + top);
                let blots = 60.0 * (0.31 * x).sin() * (0.23 * y + 0.002 * x * y).cos();
                let fine = 12.0 * (1.9 * x + 0.7 * y).sin() * (1.3 * y - 0.4 * x).cos();
                (128.0 + blots + fine) as u8
            })
            .collect()
    }

    /// The pictures of a moving camera, and their coded versions.
    fn stream(
        quantiser: u8,
        key_frame_every: u16,
        pictures: usize,
        step: [f64; 2],
    ) -> Vec<[Vec<u8>; 2]> {
        let mut coder = VideoCoder::new(Video { quantiser, key_frame_every });
        (0..pictures)
            .map(|index| {
                let shown = scene(step.map(|step| step * index as f64));
                let mut left = shown.clone();
                coder.apply(&mut left, SIZE[0]);
                [shown, left]
            })
            .collect()
    }

    #[test]
    fn more_is_lost_at_a_coarser_quantiser() {
        let mut before = 0.0;
        for (quantiser, range) in [(10, 0.1..1.0), (24, 1.0..4.0), (36, 4.0..14.0)] {
            for [shown, left] in stream(quantiser, 30, 4, [1.3, 0.4]) {
                let off = rms(&shown, &left);
                assert!(range.contains(&off), "{quantiser}: {off}");
            }
            let key_frame = &stream(quantiser, 1, 1, [0.0; 2])[0];
            let off = rms(&key_frame[0], &key_frame[1]);
            assert!(off > before, "{quantiser}: {off}");
            before = off;
        }
    }

    #[test]
    fn a_still_picture_settles() {
        let pictures = stream(34, 30, 6, [0.0; 2]);
        // Nothing new is worth sending.
        assert_eq!(pictures[4][1], pictures[5][1]);
        assert!(rms(&pictures[5][0], &pictures[5][1]) <= rms(&pictures[0][0], &pictures[0][1]));
    }

    #[test]
    fn motion_is_found_and_costs_little() {
        let mut coder = VideoCoder::new(Video { quantiser: 30, key_frame_every: 99 });
        for index in 0..5 {
            coder.apply(&mut scene([f64::from(index) * 2.75, f64::from(index) * -1.25]), SIZE[0]);
        }
        let columns = 10;
        let inner = |at: usize| {
            (1..columns - 1).contains(&(at % columns)) && (columns..4 * columns).contains(&at)
        };
        let moved: Vec<_> =
            (0..coder.before.len()).filter(|at| inner(*at)).map(|at| coder.before[at]).collect();
        let found = moved.iter().filter(|coded| {
            !coded.is_intra && (coded.motion[0] - 11).abs() <= 1 && (coded.motion[1] + 5).abs() <= 1
        });
        assert!(found.count() * 10 > moved.len() * 9, "{moved:?}");
    }

    #[test]
    fn another_size_and_a_key_frame_restart_the_stream() {
        let video = Video { quantiser: 26, key_frame_every: 2 };
        let coded = |coder: &mut VideoCoder, width: usize| {
            let mut pixels = scene([3.0, 5.0]);
            pixels.truncate(pixels.len() / width * width);
            coder.apply(&mut pixels, width);
            pixels
        };
        let mut coder = VideoCoder::new(video);
        // Some have as many macroblocks as the one before.
        for width in [150, 155, 33, 150, 147] {
            for _ in 0..2 {
                coder.apply(&mut scene([1.0, 0.0]), SIZE[0]);
            }
            assert_eq!(
                coded(&mut coder, width),
                coded(&mut VideoCoder::new(video), width),
                "{width}"
            );
            coder = VideoCoder { since_key_frame: None, ..coder };
        }
        coder.apply(&mut [], 0);
        let mut one = [77];
        coder.apply(&mut one, 1);
        assert!(one[0].abs_diff(77) <= 4, "{one:?}");
    }
}
