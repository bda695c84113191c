//! An STag read place by place: quick where it is plain to see, and able to leave out what is not.
//!
//! What is known to be black (the border) and white (the paper, the rim of the disc) tells the light over the whole marker:
//! one light, two on the sides of a shadow's edge, or one with a reflection ([`crate::decode::erasures`]). By it each dot
//! is black, white or, where something lies on the marker or outshines it, unknown; and words are compared by the dots that
//! are known.

use std::sync::LazyLock;

use imaging::{GrayView, bilinear};
use markers::Codebook;
use markers::stag_code::{self, DOT_RADIUS, DOTS};

use crate::decode::cells::Grid;
use crate::decode::erasures::{Known, Light};
use crate::decode::false_positive::ways;

/// Units of length across the square: the border is one wide.
const ACROSS: usize = 10;
/// Places along each side, on the border and on the paper beside it.
const ON_SIDE: usize = 10;
/// How far from the outline they lie, in units.
const DEPTH: f64 = 0.5;
/// Places on the white rim between the dots and the disc's edge, and how far from the middle, in sides of the square.
const ON_RIM: usize = 20;
const RIM_RADIUS: f64 = 0.375;
/// Places in a corner's black: how far from both sides, in units.
const CORNERS: [[f64; 2]; 3] = [[0.6, 0.6], [1.3, 1.3], [1.3, 0.6]];
const IN_CORNERS: usize = 4 * CORNERS.len();
const PLACES: usize = 8 * ON_SIDE + ON_RIM + IN_CORNERS;
/// Samples of a dot: its middle, and places about it at this share of its radius.
const PER_DOT: usize = 5;
const WITHIN_DOT: f64 = 0.5;

/// Least share of the border's places, and of those on the paper, that look as they should, and that must be seen.
const LEAST_INTACT: f32 = 0.6;
const LEAST_SEEN: f32 = 0.35;
/// Least logarithm of the ratio of white to black, and how much more it may be in some places.
const LEAST_RATIO: f32 = 0.08;
const MOST_UNEVEN: f32 = 4.0;
/// Dots this near to something that does not belong to the marker are not believed, in units.
const DOUBTFUL: f32 = 1.1;
/// More dots than this must be known.
const LEAST_KNOWN: u32 = 20;

/// What a square says, place by place.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Sampled {
    /// The dots that are black, and those that are known; the most significant bit first.
    pub(crate) word: u64,
    pub(crate) known: u64,
    /// The share of what is known to be black and white that looks so.
    pub(crate) intact: f32,
    /// The share of the variance of the known dots' places that black and white explain.
    pub(crate) explained: f32,
    /// Whether a reflection adds light.
    pub(crate) washed_out: bool,
}

/// A word that agrees with what was sampled.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Agreement {
    pub(crate) id: u32,
    pub(crate) turns: u8,
    pub(crate) wrong_bits: u8,
    /// By how many bits it exceeds what chance would give among the words looked for.
    pub(crate) evidence: f32,
}

/// A place, in units from the middle of the upper left one, and where it is in the square.
#[derive(Copy, Clone, Debug)]
struct Place {
    unit: [f32; 2],
    square: [f64; 2],
}

impl Place {
    /// Of a place of the square, from 0 to [`ACROSS`] both ways.
    fn of(square: [f64; 2]) -> Self {
        Self { unit: square.map(|s| (s - 0.5) as f32), square }
    }
}

/// The places to look at.
struct Places {
    /// Border and paper in turns, all round; then the rim, then the corners.
    known: [(Place, bool); PLACES],
    dots: [[Place; PER_DOT]; DOTS],
}

/// What a place looks like.
#[derive(Copy, Clone, Debug, PartialEq)]
enum Look {
    Black,
    White,
    Grey,
    /// Brighter than paper is here.
    Glare,
    /// Outside of the image, or where black and white look the same.
    Unknown,
}

fn places() -> &'static Places {
    static PLACES_: LazyLock<Places> = LazyLock::new(|| {
        let n = ACROSS as f64;
        let turned = |[x, y]: [f64; 2], quarter: usize| match quarter {
            0 => [x, y],
            1 => [n - y, x],
            2 => [n - x, n - y],
            _ => [y, n - x],
        };
        let mut known = [(Place::of([0.0; 2]), false); PLACES];
        for (index, place) in known.iter_mut().enumerate() {
            *place = if index < 8 * ON_SIDE {
                let (is_paper, side, along) = (index % 2 == 1, index / 2 % 4, index / 8);
                let depth = if is_paper { -DEPTH } else { DEPTH };
                let along = (along as f64 + 0.5) * n / ON_SIDE as f64;
                (Place::of(turned([along, depth], side)), is_paper)
            } else if index < 8 * ON_SIDE + ON_RIM {
                let angle = std::f64::consts::TAU * (index as f64 + 0.5) / ON_RIM as f64;
                let (sin, cos) = angle.sin_cos();
                (Place::of([cos, sin].map(|s| n * (0.5 + RIM_RADIUS * s))), true)
            } else {
                let index = index - 8 * ON_SIDE - ON_RIM;
                (Place::of(turned(CORNERS[index / 4], index % 4)), false)
            };
        }
        let centres = stag_code::dots();
        let dots = std::array::from_fn(|dot| {
            std::array::from_fn(|sample| {
                let [x, y] = centres[dot];
                let off = WITHIN_DOT * DOT_RADIUS;
                let [dx, dy] = match sample {
                    0 => [0.0, 0.0],
                    1 => [off, 0.0],
                    2 => [0.0, off],
                    3 => [-off, 0.0],
                    _ => [0.0, -off],
                };
                Place::of([n * (0.5 + x + dx), n * (0.5 - y - dy)])
            })
        });
        Places { known, dots }
    });
    &PLACES_
}

/// Looks at a square with these corners in a view, white on black when `inverted`; `None` when it is no STag.
pub(crate) fn sample(
    view: GrayView<'_>,
    corners: &[[f64; 2]; 4],
    inverted: bool,
) -> Option<Sampled> {
    let grid = Grid::new(corners, ACROSS)?;
    let places = places();
    let value = |place: &Place| {
        let [x, y] = grid.pixel(place.square);
        match bilinear(view, x, y) {
            Some(value) if inverted => 255.0 - value as f32,
            Some(value) => value as f32,
            None => f32::NAN,
        }
    };
    let mut values = [f32::NAN; PLACES];
    for (value_of, (place, _)) in values.iter_mut().zip(&places.known).take(8 * ON_SIDE) {
        *value_of = value(place);
    }
    if !has_border(&values) {
        return None;
    }
    let mut known = Known::default();
    for (index, (place, is_white)) in places.known.iter().enumerate() {
        if index >= 8 * ON_SIDE {
            values[index] = value(place);
        }
        if values[index].is_finite() {
            known.push(place.unit, values[index], *is_white);
        }
    }
    let light = known.light((ACROSS as f32 - 1.0) / 2.0)?;
    let looks: [Look; PLACES] =
        std::array::from_fn(|index| look(&light, &places.known[index].0, values[index]));
    let intact = intact(&places.known, &looks)?;
    let mut sampled =
        Sampled { word: 0, known: 0, intact, explained: 0.0, washed_out: light.is_reflected() };
    sampled.washed_out |= looks.contains(&Look::Glare);
    sampled.read(&light, (places, &looks), value);
    (sampled.known.count_ones() >= LEAST_KNOWN).then_some(sampled)
}

/// Whether the border is darker than the paper beside it by nearly the same ratio nearly all round: a shadow keeps the ratio
/// of ink and paper.
fn has_border(values: &[f32; PLACES]) -> bool {
    let mut ratios = [0.0_f32; 4 * ON_SIDE];
    let mut seen = 0;
    for pair in values[..8 * ON_SIDE].chunks_exact(2) {
        let ratio = ((pair[1] + 8.0) / (pair[0] + 8.0)).ln();
        if ratio.is_finite() {
            ratios[seen] = ratio;
            seen += 1;
        }
    }
    if seen < 2 * ON_SIDE {
        return false;
    }
    let ratios = &mut ratios[..seen];
    ratios.sort_unstable_by(f32::total_cmp);
    let (low, high) = (ratios[2 * seen / 5], ratios[4 * seen / 5]);
    low > LEAST_RATIO && high < MOST_UNEVEN * low
}

fn look(light: &Light, place: &Place, value: f32) -> Look {
    match light.white_share(place.unit, value) {
        Some(share) if share > 1.2 && light.is_brighter(place.unit, value) => Look::Glare,
        Some(share) if share < 0.4 => Look::Black,
        Some(share) if share > 0.6 => Look::White,
        Some(_) => Look::Grey,
        None => Look::Unknown,
    }
}

/// The share of what should be black and white that is; `None` when that or what is seen of it is too little.
fn intact(known: &[(Place, bool); PLACES], looks: &[Look; PLACES]) -> Option<f32> {
    let mut counts = [[0.0_f32; 3]; 2];
    for ((_, is_white), look) in known.iter().zip(looks) {
        let expected = if *is_white { Look::White } else { Look::Black };
        let count = &mut counts[usize::from(*is_white)];
        count[0] += 1.0;
        count[1] += f32::from(u8::from(*look == expected));
        count[2] += f32::from(u8::from(matches!(look, Look::Unknown | Look::Glare)));
    }
    let shares = counts.map(
        |[all, good, unknown]| {
            if good >= LEAST_SEEN * all { good / (all - unknown) } else { 0.0 }
        },
    );
    let all_good = shares.iter().all(|share| *share >= LEAST_INTACT);
    all_good.then_some(0.5 * (shares[0] + shares[1]))
}

impl Sampled {
    /// Reads the dots.
    fn read(
        &mut self,
        light: &Light,
        (places, looks): (&Places, &[Look; PLACES]),
        value: impl Fn(&Place) -> f32,
    ) {
        // Something lies on the marker where black is not black, or where white is not white.
        let mut covered = [[f32::NAN; 2]; PLACES];
        let mut count = 0;
        for ((place, is_white), look) in places.known.iter().zip(looks) {
            let is_other = match look {
                Look::Black => *is_white,
                Look::White => !is_white,
                Look::Grey | Look::Glare => true,
                Look::Unknown => false,
            };
            if is_other {
                covered[count] = place.unit;
                count += 1;
            }
        }
        let (mut off, mut samples, mut whites) = (0.0_f32, 0.0_f32, 0.0_f32);
        for (dot, places) in places.dots.iter().enumerate() {
            let middle = places[0].unit;
            let is_near = |place: &[f32; 2]| {
                (place[0] - middle[0]).abs().max((place[1] - middle[1]).abs()) < DOUBTFUL
            };
            let mut shares = [0.0; PER_DOT];
            let (mut seen, mut bright) = (0, 0);
            for place in places {
                let value = value(place);
                let Some(share) = light.white_share(place.unit, value) else { continue };
                bright += usize::from(share > 1.2 && light.is_brighter(place.unit, value));
                shares[seen] = share.clamp(-0.5, 1.5);
                seen += 1;
            }
            let mean = shares[..seen].iter().sum::<f32>() / seen.max(1) as f32;
            let is_grey = (0.4..0.6).contains(&mean);
            // Light is only added, so what is dark beside glare is black.
            let is_doubtful = mean > 0.5 && covered[..count].iter().any(is_near);
            if seen < 3 || bright > 1 || is_grey || is_doubtful {
                continue;
            }
            let is_white = mean > 0.5;
            let bit = 1 << (DOTS - 1 - dot);
            self.known |= bit;
            if !is_white {
                self.word |= bit;
            }
            let white = f32::from(u8::from(is_white));
            off += shares[..seen].iter().map(|share| (share - white).powi(2)).sum::<f32>();
            samples += seen as f32;
            whites += white * seen as f32;
        }
        let share = whites / samples.max(1.0);
        // Words are about half white; one that is not must not be held to less.
        let variance = (share * (1.0 - share)).max(0.15);
        self.explained = (1.0 - off / samples.max(1.0) / variance).clamp(0.0, 1.0);
    }

    /// The word among these ids that agrees best with the known dots; `None` when another one does nearly as well, and when
    /// chance may be all there is to it. `distance` is how many dots the family's words differ in at least.
    pub(crate) fn agreement(
        &self,
        book: &Codebook,
        ids: impl Iterator<Item = u32> + Clone,
        distance: u32,
    ) -> Option<Agreement> {
        let known = self.known.count_ones();
        let (mut best, mut second) = ((u32::MAX, 0, 0), u32::MAX);
        let mut count = 0;
        let (mut word, mut mask) = (self.word, self.known);
        for turns in 0..4 {
            for id in ids.clone() {
                let Some(expected) = book.codewords().get(id as usize) else { continue };
                let wrong = ((expected ^ word) & mask).count_ones();
                count += 1;
                // The same id at another turn is a rival as well.
                if wrong < best.0 {
                    second = best.0;
                    best = (wrong, id, turns);
                } else {
                    second = second.min(wrong);
                }
            }
            word = book.rotated(word);
            mask = book.rotated(mask);
        }
        let (wrong, id, turns) = best;
        // As many as the words' distance allows for when so many dots are unknown.
        let correctable = (distance + known).saturating_sub(DOTS as u32 + 1) / 2;
        if wrong > correctable || second <= wrong {
            return None;
        }
        let evidence = known as f32 - (count as f32).log2() - ways(known, wrong).log2() as f32;
        Some(Agreement { id, turns, wrong_bits: wrong as u8, evidence })
    }
}
