//! Reads markers in uneven light, as under leaves, by the steps at the edges between cells.
//!
//! Light hardly changes across the edge between two cells, and the ratio of black to white is that of the border to the quiet
//! zone next to it in any light. So each edge shows whether its cells differ, and which of them is white. The
//! codeword is the one that explains the edges best.

use imaging::GrayView;
use markers::SquareCode;

use crate::candidates::quad::{Quad, mean_side_px};
use crate::decode::erasures::{Reading, Source};
use crate::decode::false_positive;

/// Largest number of cells across, with the quiet zone.
const MAX_ACROSS: usize = 12;
/// Largest number of edges between two cells.
const MAX_EDGES: usize = 2 * MAX_ACROSS * (MAX_ACROSS - 1);
/// Number of times that the bits are made to agree with their neighbours.
const SWEEPS: usize = 12;
/// Largest number of bits of a code.
const MAX_BITS: usize = 64;

/// Distance of the samples from an edge, in cells, and at least in pixels.
const DISTANCE: f64 = 0.2;
const MIN_DISTANCE_PX: f64 = 1.0;
/// Darkest white, in grey levels: below it a step is noise.
const MIN_WHITE: f32 = 12.0;
/// Largest ratio of black to white.
const MAX_RATIO: f32 = 0.7;
/// Squared difference from an expected step from which on an edge is not used: the edge of a shadow, or of an object.
const MAX_COST: f32 = 0.25;
/// By how much flipping a bit must change the cost of its edges for the bit to be read: one edge.
const MIN_BIT_COST: f32 = 0.2;
/// Smallest fraction of the border's edges that show a step.
const MIN_INTACT: f32 = 0.7;
/// Largest cost of a codeword, as a fraction of that of edges without information, with strong evidence and with weak. In a
/// thousand scenes of clutter and man-made circles no quad with these bounds showed a codeword; without a margin, and with
/// evidence of 6 bits, 49 did, all of them windows that look like one and the same codeword.
const MAX_RESIDUAL: f32 = 0.25;
const MAX_RESIDUAL_WEAK: f32 = 0.2;
/// Smallest evidence, in bits, and the evidence from which on it is strong.
const MIN_EVIDENCE: f32 = 7.0;
const STRONG_EVIDENCE: f32 = 8.0;
/// Codewords this much farther from the word of the cells than the code's smallest distance are no rivals of the best one.
const RIVALS: u32 = 3;
/// Smallest margin to the second best codeword: nine edges.
const MIN_MARGIN: f32 = 2.2;

/// The cell on one side of an edge.
#[derive(Copy, Clone, Debug, PartialEq)]
enum Cell {
    Known { is_white: bool },
    Bit(u8),
}

/// The step across an edge: 1 where the second cell is white and the first black, -1 the other way round.
#[derive(Copy, Clone, Debug)]
struct Edge {
    cells: [Cell; 2],
    step: f32,
}

/// The edges between the cells of a quad, but for those between two cells whose colours are known.
pub(crate) struct Steps {
    edges: [Edge; MAX_EDGES],
    count: usize,
    intact: f32,
}

impl Steps {
    /// Reads the edges of a code in `quad`; `None` when there is no border in a quiet zone.
    pub(crate) fn read(view: GrayView<'_>, quad: &Quad, code: &SquareCode) -> Option<Self> {
        let source = Source::new(view, quad, code)?;
        let cells = i16::from(code.cells);
        if cells as usize + 2 > MAX_ACROSS || code.margin() > 1 || code.bits.len() > MAX_BITS {
            return None;
        }
        let distance = (MIN_DISTANCE_PX * f64::from(code.cells) / mean_side_px(&quad.corners))
            .clamp(DISTANCE, 0.4);
        let (ratio, intact) = border_ratio(&source, cells, distance)?;
        let unread = Edge { cells: [Cell::Known { is_white: false }; 2], step: 0.0 };
        let mut steps = Self { edges: [unread; MAX_EDGES], count: 0, intact };
        let mut bits = [[None; MAX_ACROSS]; MAX_ACROSS];
        for (bit, [column, row]) in code.bits.iter().enumerate() {
            let [column, row] = [*column, *row].map(|at| usize::try_from(at + 1).ok());
            *bits.get_mut(row?)?.get_mut(column?)? = Some(bit as u8);
        }
        let cell = |[column, row]: [i16; 2]| {
            let inside = |at: i16| (0..cells).contains(&at);
            match bits[(row + 1) as usize][(column + 1) as usize] {
                Some(bit) => Cell::Bit(bit),
                None => Cell::Known { is_white: !(inside(column) && inside(row)) },
            }
        };
        for row in 0..cells {
            for column in 0..cells {
                for direction in [[1, 0], [0, 1]] {
                    let next = [column + direction[0], row + direction[1]];
                    let pair = [cell([column, row]), cell(next)];
                    if matches!(pair, [Cell::Known { .. }, Cell::Known { .. }]) {
                        continue;
                    }
                    let Some(step) = step(&source, [column, row], direction, distance) else {
                        continue;
                    };
                    if let Some(edge) = steps.edges.get_mut(steps.count) {
                        *edge = Edge { cells: pair, step: step / (1.0 - ratio) };
                        steps.count += 1;
                    }
                }
            }
        }
        // For any codeword: texture is refused here.
        let min_cost = |edge: &Edge| {
            [-1.0, 0.0, 1.0].map(|at| edge.cost_of(at)).into_iter().fold(MAX_COST, f32::min)
        };
        let min_cost: f32 = steps.edges().map(min_cost).sum();
        (min_cost <= MAX_RESIDUAL * MAX_COST * steps.count as f32).then_some(steps)
    }

    fn edges(&self) -> impl Iterator<Item = &Edge> {
        self.edges[..self.count].iter()
    }

    /// The marker of one family that they show. `ids` are those looked for; `None` means all.
    pub(crate) fn decode(&self, code: &SquareCode, ids: Option<&[u32]>) -> Option<Reading> {
        let all = code.codewords.len();
        let count = ids.map_or(all, <[u32]>::len);
        let id = |index: usize| ids.map_or(Some(index as u32), |ids| ids.get(index).copied());
        let ids = (0..count).filter_map(id);
        // As it is rotated in the image.
        let seen = |codeword: u64, rotation: u8| {
            (0..(4 - rotation) % 4).fold(codeword, |word, _| code.rotated(word))
        };
        let mut words = [self.word(code); 4];
        for turn in 1..4 {
            words[turn] = code.rotated(words[turn - 1]);
        }
        let (ids, words) = (&ids, &words);
        let near = |limit: u32| {
            (0_u8..).zip(words).flat_map(move |(rotation, word)| {
                let codeword = move |id: u32| Some((id, *code.codewords.get(id as usize)?));
                let known = ids.clone().filter_map(codeword);
                let near = known.filter(move |(_, other)| (other ^ word).count_ones() <= limit);
                near.map(move |(id, codeword)| (id, rotation, codeword))
            })
        };
        let min_hamming = u32::from(code.min_hamming);
        near(min_hamming / 2).next()?;
        // The best codeword and its rivals.
        let mut best: Option<(f32, u32, u8)> = None;
        let mut second = f32::INFINITY;
        for (id, rotation, codeword) in near(min_hamming + RIVALS) {
            let cost = self.cost(seen(codeword, rotation), code);
            match best {
                Some((min_cost, ..)) if cost >= min_cost => second = second.min(cost),
                _ => {
                    second = best.map_or(second, |(min_cost, ..)| min_cost);
                    best = Some((cost, id, rotation));
                }
            }
        }
        let (cost, id, rotation) = best?;
        let codeword = *code.codewords.get(id as usize)?;
        let seen = seen(codeword, rotation);
        let residual = cost / (MAX_COST * self.count.max(1) as f32);
        let [known, hamming] = self.bits_read(seen, code);
        let erased = code.bits.len() as u32 - known;
        let correctable = u32::from(code.min_hamming).saturating_sub(erased + 1) / 2;
        if second - cost < MIN_MARGIN || hamming > correctable {
            return None;
        }
        let evidence = false_positive::evidence(code, codeword, count, known, hamming) as f32;
        let is_strong = evidence >= STRONG_EVIDENCE;
        let max_residual = if is_strong { MAX_RESIDUAL } else { MAX_RESIDUAL_WEAK };
        (evidence >= MIN_EVIDENCE && residual <= max_residual).then_some(Reading {
            id,
            rotation,
            hamming: hamming as u8,
            intact: self.intact,
            r_squared: 1.0 - residual,
            is_washed_out: false,
            evidence,
        })
    }

    /// The word of the cells that differ by the steps, in the sense of least squares.
    fn word(&self, code: &SquareCode) -> u64 {
        let bits = code.bits.len();
        let mut whites = [0.5_f32; MAX_BITS];
        for _ in 0..SWEEPS {
            let mut sums = [[0.0_f32; 2]; MAX_BITS];
            for Edge { cells: [a, b], step } in self.edges() {
                let step = step.clamp(-1.0, 1.0);
                let white = |cell: &Cell| match *cell {
                    Cell::Known { is_white } => f32::from(u8::from(is_white)),
                    Cell::Bit(bit) => whites[usize::from(bit)],
                };
                for (cell, by_other) in [(a, white(b) - step), (b, white(a) + step)] {
                    if let Cell::Bit(bit) = *cell {
                        let [sum, count] = &mut sums[usize::from(bit)];
                        *sum += by_other;
                        *count += 1.0;
                    }
                }
            }
            for (white, [sum, count]) in whites.iter_mut().zip(sums) {
                // Half of the way: neighbours that are set at once would swing.
                *white = 0.5 * (*white + (sum / count.max(1.0)).clamp(0.0, 1.0));
            }
        }
        whites[..bits]
            .iter()
            .fold(0, |word, white| word << 1 | u64::from((*white > 0.5) != code.reversed_border))
    }

    fn cost(&self, word: u64, code: &SquareCode) -> f32 {
        self.edges().map(|edge| edge.cost(word, code)).sum()
    }

    /// How many bits the edges show, and how many of these differ from the word's.
    fn bits_read(&self, word: u64, code: &SquareCode) -> [u32; 2] {
        let mut known = 0;
        let mut hamming = 0;
        for bit in 0..code.bits.len() as u8 {
            let flipped = word ^ 1 << (code.bits.len() - 1 - usize::from(bit));
            let edges = self.edges().filter(|edge| edge.cells.contains(&Cell::Bit(bit)));
            let change: f32 =
                edges.map(|edge| edge.cost(flipped, code) - edge.cost(word, code)).sum();
            known += u32::from(change.abs() > MIN_BIT_COST);
            hamming += u32::from(change < -MIN_BIT_COST);
        }
        [known, hamming]
    }
}

impl Edge {
    fn cost(&self, word: u64, code: &SquareCode) -> f32 {
        let [a, b] = self.cells.map(|cell| match cell {
            Cell::Known { is_white } => is_white,
            // The image is the negative of a marker with a white border.
            Cell::Bit(bit) => {
                let is_one = word >> (code.bits.len() - 1 - usize::from(bit)) & 1 != 0;
                is_one != code.reversed_border
            }
        });
        self.cost_of(f32::from(i8::from(b) - i8::from(a)))
    }

    /// The cost of an expected step.
    fn cost_of(&self, expected: f32) -> f32 {
        (self.step - expected).powi(2).min(MAX_COST)
    }
}

/// The ratio of black to white at the border, and the fraction of its edges that show a step.
fn border_ratio(source: &Source<'_>, cells: i16, distance: f64) -> Option<(f32, f32)> {
    let mut ratios = [0.0_f32; 4 * MAX_ACROSS];
    let mut count = 0;
    for along in 0..cells {
        let last = cells - 1;
        for (cell, direction) in [
            ([along, 0], [0, -1]),
            ([last, along], [1, 0]),
            ([along, last], [0, 1]),
            ([0, along], [-1, 0]),
        ] {
            if let Some(step) = step(source, cell, direction, distance) {
                ratios[count] = 1.0 - step;
                count += 1;
            }
        }
    }
    let ratios = ratios.get_mut(..count).filter(|seen| seen.len() as i16 >= 2 * cells)?;
    ratios.sort_unstable_by(f32::total_cmp);
    let ratio = *ratios.get(count / 2)?;
    let is_step = |other: &&f32| **other < 0.5 * (1.0 + ratio);
    let intact = ratios.iter().filter(is_step).count() as f32 / count as f32;
    (ratio < MAX_RATIO && intact >= MIN_INTACT).then_some((ratio, intact))
}

/// The step across the edge of a cell, positive where it becomes brighter, as a fraction of the brighter side: the middle
/// one of several along the edge, as a shadow's edge may cross it.
fn step(source: &Source<'_>, cell: [i16; 2], direction: [i16; 2], distance: f64) -> Option<f32> {
    const ALONG: [f64; 5] = [-0.3, -0.15, 0.0, 0.15, 0.3];
    let middle = cell.map(|at| f64::from(at) + 0.5);
    let direction = direction.map(f64::from);
    let mut steps = [0.0_f32; ALONG.len()];
    for (step, along) in steps.iter_mut().zip(ALONG) {
        let grey = |across: f64| {
            source.grey([
                middle[0] + across * direction[0] - along * direction[1],
                middle[1] + across * direction[1] + along * direction[0],
            ])
        };
        let (here, there) = (grey(0.5 - distance)?, grey(0.5 + distance)?);
        *step = (there - here) / here.max(there).max(MIN_WHITE);
    }
    steps.sort_unstable_by(f32::total_cmp);
    Some(steps[ALONG.len() / 2])
}
