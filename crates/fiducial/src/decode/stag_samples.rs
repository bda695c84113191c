//! Samples the dots of an STag: fast where the marker is clearly visible, and with erasures where it is not.
//!
//! The border, which is black, and the quiet zone and the rim of the disc, which are white, determine the
//! illumination. By it each dot is black, white or, where it is covered or washed out, erased. Codewords are
//! compared by the known dots.

use std::sync::LazyLock;

use imaging::{GrayView, bilinear};
use markers::Codebook;
use markers::stag_code::{self, DOT_RADIUS, DOTS};

use crate::decode::erasures::ErasedWord;
use crate::decode::false_positive::words_within;
use crate::decode::illumination::{
    Agreement, BorderRatios, Colour, Illumination, ReferenceCells, intact_fraction,
};
use crate::optics::homography::Homography;

/// Units across the square; the border is one unit wide.
const ACROSS: usize = 10;
/// Positions along each side, on the border and on the quiet zone next to it.
const PER_SIDE: usize = 10;
/// Their distance from the outline, in units.
const DEPTH: f64 = 0.5;
/// Places on the white rim between the dots and the disc's edge, and the rim's radius in sides of the square.
const ON_RIM: usize = 20;
const RIM_RADIUS: f64 = 0.375;
/// Places in a black corner, by their distance from both sides, in units.
const CORNERS: [[f64; 2]; 3] = [[0.6, 0.6], [1.3, 1.3], [1.3, 0.6]];
const IN_CORNERS: usize = 4 * CORNERS.len();
const PLACES: usize = 8 * PER_SIDE + ON_RIM + IN_CORNERS;
/// Samples of a dot: its middle, and places around it at this fraction of its radius.
const PER_DOT: usize = 5;
const SAMPLE_RADIUS: f64 = 0.5;

/// White dots this near to something that covers the marker, in units, are erased.
const COVERED_DISTANCE: f32 = 1.1;
/// Smallest number of known dots.
const MIN_KNOWN: u32 = 20;
/// Stray light in the ratio of paper to border, in grey levels.
const STRAY_LIGHT: f32 = 8.0;

/// The sampled dots of a square.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Sampled {
    /// The dots; a set bit is black.
    pub(crate) word: ErasedWord,
    /// Fraction of the known places that look as they should.
    pub(crate) intact: f32,
    /// Fraction of the variance of the known dots' samples that black and white explain.
    pub(crate) r_squared: f32,
    /// Whether there is a reflection.
    pub(crate) is_washed_out: bool,
}

/// A codeword that agrees with the samples.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct SampledMatch {
    pub(crate) id: u32,
    pub(crate) rotation: u8,
    pub(crate) hamming: u8,
    /// Agreement in excess of that of a chance codeword, in bits.
    pub(crate) evidence: f32,
}

/// A place in units from the middle of the upper left unit, and from the square's corner.
#[derive(Copy, Clone, Debug)]
struct Place {
    unit: [f32; 2],
    square: [f64; 2],
}

impl Place {
    /// By its place in the square, from 0 to [`ACROSS`] on both axes.
    fn new(square: [f64; 2]) -> Self {
        Self { unit: square.map(|s| (s - 0.5) as f32), square }
    }
}

/// The places that are sampled.
struct Places {
    /// Places of known colour, and whether they are white: border and quiet zone in turn, all round; the rim;
    /// the corners.
    known: [(Place, bool); PLACES],
    dots: [[Place; PER_DOT]; DOTS],
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
        let mut known = [(Place::new([0.0; 2]), false); PLACES];
        for (index, place) in known.iter_mut().enumerate() {
            *place = if index < 8 * PER_SIDE {
                let (is_white, side, along) = (index % 2 == 1, index / 2 % 4, index / 8);
                let depth = if is_white { -DEPTH } else { DEPTH };
                let along = (along as f64 + 0.5) * n / PER_SIDE as f64;
                (Place::new(turned([along, depth], side)), is_white)
            } else if index < 8 * PER_SIDE + ON_RIM {
                let angle = std::f64::consts::TAU * (index as f64 + 0.5) / ON_RIM as f64;
                let (sin, cos) = angle.sin_cos();
                (Place::new([cos, sin].map(|s| n * (0.5 + RIM_RADIUS * s))), true)
            } else {
                let index = index - 8 * PER_SIDE - ON_RIM;
                (Place::new(turned(CORNERS[index / 4], index % 4)), false)
            };
        }
        let centres = stag_code::dots();
        let dots = std::array::from_fn(|dot| {
            std::array::from_fn(|sample| {
                let [x, y] = centres[dot];
                let off = SAMPLE_RADIUS * DOT_RADIUS;
                let [dx, dy] = match sample {
                    0 => [0.0, 0.0],
                    1 => [off, 0.0],
                    2 => [0.0, off],
                    3 => [-off, 0.0],
                    _ => [0.0, -off],
                };
                Place::new([n * (0.5 + x + dx), n * (0.5 - y - dy)])
            })
        });
        Places { known, dots }
    });
    &PLACES_
}

/// Samples a square with these corners, printed white on black when `inverted`; `None` when it is not an
/// STag.
pub(crate) fn sample(
    view: GrayView<'_>,
    corners: &[[f64; 2]; 4],
    inverted: bool,
) -> Option<Sampled> {
    let homography = Homography::from_square([0.0, ACROSS as f64], corners)?;
    let places = places();
    let value = |place: &Place| {
        let [x, y] = homography.project(place.square).image;
        match bilinear(view, x, y) {
            Some(value) if inverted => 255.0 - value as f32,
            Some(value) => value as f32,
            None => f32::NAN,
        }
    };
    let mut values = [f32::NAN; PLACES];
    // The pairs of border and quiet zone, where both are in the image.
    let mut ratios = BorderRatios::<{ 4 * PER_SIDE }>::new(4 * PER_SIDE);
    let pairs = values.as_chunks_mut::<2>().0.iter_mut().zip(places.known.as_chunks::<2>().0);
    for (pair, known) in pairs.take(4 * PER_SIDE) {
        *pair = [0, 1].map(|i| value(&known[i].0));
        let ratio = ((pair[1] + STRAY_LIGHT) / (pair[0] + STRAY_LIGHT)).ln();
        if ratio.is_finite() && !ratios.add(ratio) {
            return None;
        }
    }
    if !ratios.is_border(2 * PER_SIDE) {
        return None;
    }
    let mut known = ReferenceCells::default();
    for (index, (place, is_white)) in places.known.iter().enumerate() {
        if index >= 8 * PER_SIDE {
            values[index] = value(place);
        }
        if values[index].is_finite() {
            known.push(place.unit, values[index], *is_white);
        }
    }
    let light = known.illumination((ACROSS as f32 - 1.0) / 2.0)?;
    let colours: [Colour; PLACES] =
        std::array::from_fn(|index| colour(&light, &places.known[index].0, values[index]));
    let known = || places.known.iter().zip(colours);
    let intact = intact_fraction(known().map(|((_, is_white), colour)| (*is_white, colour)))?;
    let mut covered = [[f32::NAN; 2]; PLACES];
    let mut count = 0;
    for ((place, is_white), colour) in known() {
        if is_covered(*is_white, colour) {
            covered[count] = place.unit;
            count += 1;
        }
    }
    let (word, r_squared) = read_dots(&light, places, &covered[..count], value);
    let is_washed_out = light.is_reflected() || colours.contains(&Colour::Glare);
    (word.known.count_ones() >= MIN_KNOWN).then_some(Sampled {
        word,
        intact,
        r_squared,
        is_washed_out,
    })
}

fn colour(light: &Illumination, place: &Place, value: f32) -> Colour {
    match light.white_share(place.unit, value) {
        Some(share) if share > 1.2 && light.is_glare(place.unit, value) => Colour::Glare,
        Some(share) => Colour::from_white_share(share),
        None => Colour::Unknown,
    }
}

/// Whether a place of known colour looks like something else.
fn is_covered(is_white: bool, colour: Colour) -> bool {
    match colour {
        Colour::Black => is_white,
        Colour::White => !is_white,
        Colour::Grey | Colour::Glare => true,
        Colour::Unknown => false,
    }
}

/// The dots, and the fraction of the variance of their samples that black and white explain.
fn read_dots(
    light: &Illumination,
    places: &Places,
    covered: &[[f32; 2]],
    value: impl Fn(&Place) -> f32,
) -> (ErasedWord, f32) {
    let mut word = ErasedWord::default();
    let mut agreement = Agreement::default();
    for samples in &places.dots {
        let middle = samples[0].unit;
        let is_near = |place: &[f32; 2]| {
            (place[0] - middle[0]).abs().max((place[1] - middle[1]).abs()) < COVERED_DISTANCE
        };
        let mut shares = [0.0; PER_DOT];
        let (mut seen, mut bright) = (0, 0);
        for place in samples {
            let value = value(place);
            let Some(share) = light.white_share(place.unit, value) else { continue };
            bright += usize::from(share > 1.2 && light.is_glare(place.unit, value));
            shares[seen] = share.clamp(-0.5, 1.5);
            seen += 1;
        }
        let mean = shares[..seen].iter().sum::<f32>() / seen.max(1) as f32;
        let is_grey = (0.4..0.6).contains(&mean);
        let is_white = mean > 0.5;
        // Glare only adds light, so dark samples next to it are black.
        let is_doubtful = is_white && covered.iter().any(is_near);
        let is_erased = seen < 3 || bright > 1 || is_grey || is_doubtful;
        word = word.appended((!is_erased).then_some(!is_white));
        if !is_erased {
            agreement.add(is_white, &shares[..seen]);
        }
    }
    (word, agreement.r_squared())
}

impl Sampled {
    /// The codeword of these ids that agrees best with the known dots; `None` when another agrees as well, or
    /// more than the family's minimum distance allows is wrong.
    pub(crate) fn decode(
        &self,
        book: &Codebook,
        ids: impl Iterator<Item = u32> + Clone,
        min_distance: u32,
    ) -> Option<SampledMatch> {
        let known = self.word.known.count_ones();
        let best = self.word.best_codeword(book.codewords(), ids, |word| book.rotated(word));
        let correctable = (min_distance + known).saturating_sub(DOTS as u32 + 1) / 2;
        if best.hamming > correctable || best.second <= best.hamming {
            return None;
        }
        let chance =
            (best.compared as f32).log2() + words_within(known, best.hamming).log2() as f32;
        Some(SampledMatch {
            id: best.id,
            rotation: best.rotation,
            hamming: best.hamming as u8,
            evidence: known as f32 - chance,
        })
    }
}
