//! Detects STags (a black square, a white disc in it, 48 dots in that): quads, their dots sampled or solved for, the codeword,
//! the refined square and its pose. STags are those of Benligiray, Topal, Akinlar: "STag: A stable fiducial marker system", Image and
//! Vision Computing 89, 2019.
//!
//! The dots of large and clearly visible quads are sampled one by one. Those of others are solved for
//! together, and the codeword that explains the pixels best is taken. Fallbacks sample quads of segments,
//! with hidden dots erased, and squares in quiet zones. Then the whole marker is refined: by its outline and
//! the disc's edge where these are far enough apart, by all grey values where they are not.

use geometry::Pixel;
use imaging::bilinear;
use imaging::pyramid::from_level_0;
use markers::stag_code::{self, DOTS, QUIET_ZONE};
use markers::{Codebook, Marker};

use crate::candidates::evidence::{Needs, OutlineNeeds};
use crate::candidates::overlap::Overlap;
use crate::candidates::quad::{Quad, at_most_across, shortest_side_px};
use crate::candidates::quiet_zone::{
    MAX_CONTRAST_VARIATION, PaperTone, TONES, border_contrast_variation, has_dark_border,
};
use crate::decode::occluded::{Occluded, OccludedMarker};
use crate::decode::stag_cells::Dots;
use crate::decode::stag_samples::{Sampled, SampledMatch, sample};
use crate::families::family::{FamilyDetector, FrameInput, Output, Prediction};
use crate::families::query::{ExpectedMarker, FamilyQuery, ImageInput, segment_corner_px};
use crate::families::square::INVERTED_FROM;
use crate::observation::Observation;
use crate::optics::camera_response::CameraResponse;
use crate::optics::homography::Homography;
use crate::refine::corners::refine_design;
use crate::refine::fit::{CornerGuess, Refined, Scratch};
use crate::refine::stag_design::StagDesign;
use crate::schedule::FallbackStep;
use crate::trace::Reason;

/// Sides of a quad on the level of the pyramid on which it is read, in pixels: from this to twice this, first
/// with coarse and then with refined corners.
const COARSE_SIDE_PX: f64 = 12.0;
const FINE_SIDE_PX: f64 = 20.0;
/// The same for the last attempt: out of focus, the blur is as expected on a coarser level.
const UNSHARP_SIDE_PX: f64 = 8.0;
/// Quads with a shorter side than this, in pixels, are not read.
const MIN_SIDE_PX: f64 = 7.0;
/// Up to this number of ids, every codeword is compared with the image.
const MAX_COMPARED: usize = 40;
/// Bounds on the work in one image.
const MAX_READ: usize = 400;
const MAX_FOUND: usize = 64;
/// Number of designs that are stored.
const MAX_DESIGNS: usize = 32;

/// Smallest R² of a marker, and smallest ratio of the second best codeword's unexplained variance to the best
/// one's.
const MIN_R_SQUARED: f64 = 0.8;
const MIN_RATIO: f64 = 1.5;
/// The same with coarse corners, which lower both; with less, refinement is not worth its time.
const MIN_COARSE_R_SQUARED: f64 = 0.6;
const MIN_COARSE_RATIO: f64 = 1.25;

/// Quads from this size on, in pixels, must show the disc's white rim before anything is solved for: at this
/// fraction of the contrast or above. All of 800 markers in light, shadow and glare reached half, of other
/// quads a fifth does.
const RIM_SIDE_PX: f64 = 10.0;
const MIN_RIM: f64 = 0.35;

/// Markers from this size on, in pixels, are sampled dot by dot, on the level on which they are from this
/// size to twice this.
const SAMPLED_SIDE_PX: f64 = 28.0;
/// Bounds on the intact fraction, the R² and the evidence, in bits, of markers that need no more than
/// samples.
const MIN_SAMPLED_INTACT: f32 = 0.95;
const MIN_SAMPLED_R_SQUARED: f32 = 0.85;
const MIN_SAMPLED_EVIDENCE: f32 = 20.0;
/// The same for partly hidden markers.
const MIN_OCCLUDED_R_SQUARED: f32 = 0.7;
const MIN_OCCLUDED_EVIDENCE: f32 = 14.0;

/// Largest number of outline quads whose dots are read, above that of frames with markers.
const MAX_QUADS: usize = 128;

/// Finds STags among quads. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct StagDetector {
    queries: Vec<StagQuery>,
    dots: Dots,
    designs: Vec<StagDesign>,
    scratch: Scratch,
    occluded: Occluded<Reading>,
    /// Corners of the markers that were found.
    known: Vec<[Pixel; 4]>,
    /// Whether markers printed white on black are looked for as well.
    inverted: bool,
}

/// One family that is looked for.
#[derive(Debug)]
struct StagQuery {
    query: FamilyQuery,
    book: &'static Codebook,
    /// The ids whose codewords are each compared with the image; empty where there are too many.
    compared: Vec<u32>,
}

/// The codeword of a quad.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Reading {
    query: usize,
    id: u32,
    rotation: u8,
    hamming: u8,
    r_squared: f64,
    /// The second best codeword's unexplained variance over this one's.
    ratio: f64,
    /// Whether a reflection moves its edges, so that refined corners are hardly better.
    is_washed_out: bool,
}

/// The limits for samples.
#[derive(Copy, Clone, Debug)]
struct SampleBounds {
    r_squared: f32,
    evidence: f32,
    /// Whether all dots must be known, and nearly all places intact.
    is_complete: bool,
}

const COMPLETE: SampleBounds = SampleBounds {
    r_squared: MIN_SAMPLED_R_SQUARED,
    evidence: MIN_SAMPLED_EVIDENCE,
    is_complete: true,
};
const OCCLUDED: SampleBounds = SampleBounds {
    r_squared: MIN_OCCLUDED_R_SQUARED,
    evidence: MIN_OCCLUDED_EVIDENCE,
    is_complete: false,
};

impl StagDetector {
    /// Largest size of outlines on the finest levels, in pixels of the level. Seen from the side, at a sixth of its length, the border of
    /// a marker of 192 px, a tenth of its side, is 3 px wide: on the next level it is too thin, and out of focus too bright.
    const MAX_OUTLINE_PX: u16 = 192;

    /// Looks for these markers; those of other families are left out. With `inverted` it looks for markers
    /// printed white on black as well.
    pub(crate) fn new(markers: &[Marker], inverted: bool) -> Self {
        let mut detector = Self { inverted, ..Self::default() };
        for marker in markers {
            let Some(book) = stag_code::codebook(marker.family) else { continue };
            match detector.queries.iter_mut().find(|q| q.query.family == marker.family) {
                Some(known) => known.query.markers.push(*marker),
                None => {
                    let query = FamilyQuery::new(*marker);
                    detector.queries.push(StagQuery { query, book, compared: Vec::new() });
                }
            }
        }
        for StagQuery { query, book, compared } in &mut detector.queries {
            *compared = if query.has_any_id() {
                (0..book.codewords().len() as u32).collect()
            } else {
                query.ids().collect()
            };
            if compared.len() > MAX_COMPARED {
                compared.clear();
            }
        }
        detector
    }

    /// Reserves memory for a frame with texture.
    fn reserve(&mut self) {
        if !self.is_empty() {
            self.known.clear();
            self.known.reserve(MAX_FOUND);
            self.scratch.make_room();
            self.occluded.make_room();
        }
    }

    /// Whether there is nothing to look for.
    pub(crate) fn is_empty(&self) -> bool {
        self.queries.is_empty()
    }

    /// Whether a fallback is to look for markers, as in [`FamilyQuery::is_missing`].
    fn is_missing(&self, all: bool, found: &[Observation]) -> bool {
        self.queries.iter().any(|StagQuery { query, .. }| {
            let known = found.iter().filter(|o| o.family == query.family).filter_map(|o| o.id);
            query.is_missing(all, known)
        })
    }

    /// Finds the markers among the quads of an image, given likeliest first.
    fn detect_whole<'a>(
        &mut self,
        input: ImageInput<'_>,
        quads: impl Iterator<Item = &'a Quad>,
        out: &mut Output<'_>,
    ) {
        self.known.clear();
        let inverted = self.inverted;
        for quad in quads.filter(|quad| inverted || !quad.inverted).take(MAX_READ) {
            if self.known.len() >= MAX_FOUND {
                break;
            }
            let is_known = |known| Overlap::new(known, &quad.corners).is_concentric();
            if !self.known.iter().any(is_known)
                && let Err(reason) = self.add(input, quad, CameraResponse::LINEAR.curve, out)
            {
                out.trace.refuse_quad(quad.corners, reason);
            }
        }
        out.stages.ended("stags");
    }

    /// Finds one marker where it is expected.
    fn detect_expected(
        &mut self,
        input: ImageInput<'_>,
        expected: &ExpectedMarker,
    ) -> Option<Observation> {
        let quad = Quad { corners: expected.corners, inverted: false };
        if !self.queries.iter().any(|q| q.query.family == expected.family)
            || border_contrast_variation(&quad, input.view, 0) > MAX_CONTRAST_VARIATION
        {
            return None;
        }
        let (reading, refined) = self.read(input, &quad, CameraResponse::LINEAR.curve).ok()?;
        let family = self.queries.get(reading.query)?.query.family;
        let is_expected = (family, reading.id) == (expected.family, expected.id);
        (is_expected && reading.rotation == 0)
            .then(|| self.observation(&reading, &refined, input))
            .flatten()
    }

    /// Finds small markers by their quiet zone.
    fn detect_in_quiet_zones(
        &mut self,
        input: ImageInput<'_>,
        quiet_zones: &[Quad],
        out: &mut Output<'_>,
    ) {
        for quiet_zone in quiet_zones {
            let factor = 1.0 / (1.0 + 2.0 * QUIET_ZONE);
            let quad = Quad { inverted: false, ..quiet_zone.scaled(factor) };
            if self.is_covered(&quad) || !has_dark_border(&quad, input.view) {
                continue;
            }
            // A quiet zone without a marker is not counted as a refused candidate.
            let _ = TONES.into_iter().find(|PaperTone { curve, scale }| {
                self.add(input, &quad.scaled(*scale), *curve, out).is_ok()
            });
        }
    }

    /// Finds partly hidden markers among quads of segments; it takes several times as long as
    /// [`StagDetector::detect_whole`].
    fn detect_occluded(&mut self, input: ImageInput<'_>, quads: &[Quad], out: &mut Output<'_>) {
        let mut occluded = std::mem::take(&mut self.occluded);
        let markers = occluded.find(quads, |quad, found| {
            if self.is_covered(quad) || quad.inverted && !self.inverted {
                return;
            }
            if let Some(reading) = self.sampled(input, quad, OCCLUDED) {
                let score = reading.r_squared * (1.0 - 1.0 / (1.0 + reading.ratio));
                found.push(OccludedMarker { quad: *quad, reading, score });
            }
        });
        for OccludedMarker { quad, reading, .. } in markers {
            let refined = self.refined_occluded(input, quad, reading);
            if let Some(seen) = self.observation(reading, &refined, input) {
                out.trace.accept_quad(refined.corners);
                out.found.push(seen);
            }
        }
        self.occluded = occluded;
    }

    fn is_covered(&self, quad: &Quad) -> bool {
        self.known.iter().any(|known| Overlap::new(known, &quad.corners).is_covered())
    }

    /// Reads a quad, as shown with a tone curve, and adds its marker to the results.
    fn add(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        curve: f64,
        out: &mut Output<'_>,
    ) -> Result<(), Reason> {
        let (reading, refined) = self.read(input, quad, curve)?;
        let seen = self.observation(&reading, &refined, input).ok_or(Reason::Edges)?;
        out.trace.accept_quad(refined.corners);
        self.known.push(refined.corners);
        out.found.push(seen);
        Ok(())
    }

    /// The corners of a partly hidden marker: refined where enough of its edges is seen and it still reads
    /// the same.
    fn refined_occluded(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        reading: &Reading,
    ) -> Refined {
        let mut corners = quad.corners;
        corners.rotate_left(usize::from(reading.rotation) % 4);
        let corner_px = segment_corner_px(&corners);
        let unrefined = || Refined::unrefined(&corners, corner_px);
        let Some(mut refined) = self.refined(input, quad, reading) else { return unrefined() };
        let better = Quad { corners: refined.corners, ..*quad };
        let again = self.sampled(input, &better, OCCLUDED);
        if again.is_none_or(|again| (again.id, again.rotation) != (reading.id, 0)) {
            return unrefined();
        }
        if reading.is_washed_out {
            refined.add_uncertainty(corner_px);
        }
        refined
    }

    /// The codeword of a quad by samples of its dots.
    fn sampled(&self, input: ImageInput<'_>, quad: &Quad, bounds: SampleBounds) -> Option<Reading> {
        let (level, corners) = on_level(&quad.corners, SAMPLED_SIDE_PX, input);
        let image = input.pyramid.level(input.view, level)?;
        let seen = sample(image, &corners, quad.inverted)?;
        let is_complete = seen.word.known.count_ones() as usize == DOTS
            && seen.intact >= MIN_SAMPLED_INTACT
            && !seen.is_washed_out;
        if seen.r_squared < bounds.r_squared || bounds.is_complete && !is_complete {
            return None;
        }
        let read = |(index, query): (usize, &StagQuery)| {
            let SampledMatch { id, rotation, hamming, evidence } =
                query.decode(&seen).filter(|found| found.evidence >= bounds.evidence)?;
            Some(Reading {
                query: index,
                id,
                rotation,
                hamming,
                r_squared: f64::from(seen.r_squared * seen.intact),
                ratio: f64::from(evidence / 8.0).max(MIN_RATIO),
                is_washed_out: seen.is_washed_out,
            })
        };
        let all = self.queries.iter().enumerate().filter_map(read);
        all.max_by(|a, b| a.ratio.total_cmp(&b.ratio))
    }

    /// The marker that a quad shows with a tone curve, with refined corners.
    fn read(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        curve: f64,
    ) -> Result<(Reading, Refined), Reason> {
        let side_px = shortest_side_px(&quad.corners);
        if side_px < MIN_SIDE_PX {
            return Err(Reason::Small);
        }
        if side_px >= RIM_SIDE_PX && !has_rim(input, quad) {
            return Err(Reason::Blackness);
        }
        if side_px >= SAMPLED_SIDE_PX
            && let Some(reading) = self.sampled(input, quad, COMPLETE)
            && let Some(refined) = self.refined(input, quad, &reading)
        {
            return Ok((reading, refined));
        }
        let first = self.solved(input, quad, curve, COARSE_SIDE_PX)?;
        if first.r_squared < MIN_COARSE_R_SQUARED || first.ratio < MIN_COARSE_RATIO {
            return Err(Reason::Code);
        }
        // A wrong codeword has the same outline: with its better corners, the right one explains more.
        let refined = self.refined(input, quad, &first).ok_or(Reason::Edges)?;
        let mut better = Quad { corners: refined.corners, ..*quad };
        better.corners.rotate_right(usize::from(first.rotation) % 4);
        let mut second = self.solved(input, &better, curve, FINE_SIDE_PX)?;
        if !is_certain(&second) {
            second = self.solved(input, &better, curve, UNSHARP_SIDE_PX)?;
            if !is_certain(&second) {
                return Err(Reason::Confidence);
            }
        }
        if (second.query, second.id, second.rotation) == (first.query, first.id, first.rotation) {
            return Ok((second, refined));
        }
        let refined = self.refined(input, &better, &second).ok_or(Reason::Edges)?;
        Ok((second, refined))
    }

    fn refined(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        reading: &Reading,
    ) -> Option<Refined> {
        let mut corners = quad.corners;
        corners.rotate_left(usize::from(reading.rotation) % 4);
        let family = self.queries.get(reading.query)?.query.family;
        let is_it = |design: &StagDesign| (design.family, design.id) == (family, reading.id);
        if !self.designs.iter().any(is_it) {
            if self.designs.len() >= MAX_DESIGNS {
                self.designs.remove(0);
            }
            self.designs.push(StagDesign::new(family, reading.id)?);
        }
        let design = self.designs.iter().find(|design| is_it(design))?;
        let design = design.design(shortest_side_px(&corners), quad.inverted);
        let ImageInput { view, camera, response, .. } = input;
        let guess = CornerGuess { view, corners: &corners, camera, is_near: false, response };
        refine_design(&guess, &design, &mut self.scratch)
    }

    /// The codeword that explains the pixels of a square best, with a tone curve.
    fn solved(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        curve: f64,
        side_px: f64,
    ) -> Result<Reading, Reason> {
        let (level, corners) = on_level(&quad.corners, side_px, input);
        let image = input.pyramid.level(input.view, level).ok_or(Reason::Small)?;
        if !self.dots.add_pixels(image, &corners, curve) {
            return Err(Reason::Small);
        }
        let word = if self.dots.solve() { self.dots.word() } else { return Err(Reason::Code) };
        let mut best: Option<Reading> = None;
        for (index, query) in self.queries.iter().enumerate() {
            let reading = query.best(index, word, &self.dots, quad.inverted);
            let is_better =
                |reading: &Reading| best.is_none_or(|best| best.r_squared < reading.r_squared);
            best = reading.filter(is_better).or(best);
        }
        best.ok_or(Reason::Code)
    }

    fn observation(
        &self,
        reading: &Reading,
        refined: &Refined,
        input: ImageInput<'_>,
    ) -> Option<Observation> {
        let Reading { id, hamming, .. } = *reading;
        let confidence = reading.r_squared * (1.0 - 0.5 / reading.ratio);
        let query = &self.queries[reading.query].query;
        query.observation(id, hamming, confidence, refined, input)
    }
}

impl FamilyDetector for StagDetector {
    fn needs(&self) -> Needs {
        let bright_from = self.inverted.then_some(INVERTED_FROM);
        let quads = OutlineNeeds { bright_from, max_size_px: Self::MAX_OUTLINE_PX };
        Needs { pyramid: true, quads: Some(quads) }
    }

    fn fallback_steps(&self) -> &'static [FallbackStep] {
        &[FallbackStep::QuietZones, FallbackStep::LateSegments]
    }

    fn make_room(&mut self) {
        self.reserve();
    }

    fn detect(&mut self, input: FrameInput<'_>, out: &mut Output<'_>) {
        let image = ImageInput::new(&input);
        let evidence = &*input.evidence;
        self.detect_whole(image, evidence.outline_quads.iter().take(MAX_QUADS), out);
    }

    fn detect_at(&mut self, input: FrameInput<'_>, at: &Prediction) -> Option<Observation> {
        let image = ImageInput::new(&input);
        self.detect_expected(image, &ExpectedMarker::new(at)?)
    }

    fn wants_fallback(&mut self, _step: FallbackStep, all: bool, found: &[Observation]) -> bool {
        self.is_missing(all, found)
    }

    fn fallback(&mut self, step: FallbackStep, input: FrameInput<'_>, out: &mut Output<'_>) {
        let image = ImageInput::new(&input);
        let evidence = &*input.evidence;
        match step {
            FallbackStep::QuietZones => {
                self.detect_in_quiet_zones(image, &evidence.quiet_zones, out);
            }
            FallbackStep::LateSegments => {
                self.detect_occluded(image, evidence.segment_quads(), out);
            }
            _ => {}
        }
    }
}

impl StagQuery {
    /// The codeword that explains the pixels best, given the word nearest to the dots.
    fn best(&self, index: usize, word: u64, dots: &Dots, inverted: bool) -> Option<Reading> {
        let reading = |id: u32, rotation: u8| {
            // As it is rotated in the image.
            let seen = (0..(4 - rotation) % 4)
                .fold(*self.book.codewords().get(id as usize)?, |word, _| self.book.rotated(word));
            let explanation = dots.explain(seen);
            let [black, white] = explanation.levels;
            ((white > black) != inverted).then(|| Reading {
                query: index,
                id,
                rotation,
                hamming: (seen ^ word).count_ones() as u8,
                r_squared: explanation.r_squared,
                ratio: 1.0,
                is_washed_out: false,
            })
        };
        if self.compared.is_empty() {
            let found = self.book.nearest(word, self.max_hamming())?;
            let reading =
                reading(found.id, found.rotation).filter(|_| self.query.includes(found.id))?;
            return Some(Reading { ratio: 2.0 * MIN_RATIO, ..reading });
        }
        let mut best: Option<Reading> = None;
        let mut second = 0.0_f64;
        let rotations = |id: &u32| {
            let id = *id;
            (0..4).filter_map(move |rotation| reading(id, rotation))
        };
        for found in self.compared.iter().flat_map(rotations) {
            match best {
                Some(best) if best.r_squared >= found.r_squared => {
                    second = second.max(found.r_squared);
                }
                _ => {
                    second = best.map_or(0.0, |best| best.r_squared);
                    best = Some(found);
                }
            }
        }
        best.map(|best| Reading {
            ratio: (1.0 - second) / (1.0 - best.r_squared).max(1e-6),
            ..best
        })
    }

    /// The codeword looked for that agrees best with sampled dots.
    fn decode(&self, seen: &Sampled) -> Option<SampledMatch> {
        let min_distance = self.min_distance();
        if self.query.has_any_id() {
            return seen.decode(self.book, 0..self.book.codewords().len() as u32, min_distance);
        }
        seen.decode(self.book, self.query.ids(), min_distance)
    }

    /// The family's minimum Hamming distance, over all rotations.
    fn min_distance(&self) -> u32 {
        stag_code::min_hamming(self.query.family).map_or(0, u32::from)
    }

    /// Largest Hamming distance that is corrected; a random word is hardly ever that near to a codeword.
    fn max_hamming(&self) -> u8 {
        (self.min_distance().saturating_sub(3) / 2).min(7) as u8
    }
}

/// Whether a codeword explains enough, and more than the others.
fn is_certain(reading: &Reading) -> bool {
    reading.r_squared >= MIN_R_SQUARED && reading.ratio >= MIN_RATIO
}

/// Whether a quad is brighter around its middle than in its corners, as an STag's disc is.
fn has_rim(input: ImageInput<'_>, quad: &Quad) -> bool {
    // In tenths of the square: in the corners, next to the sides, and on the disc's rim.
    const CORNERS: [[f64; 2]; 4] = [[0.9, 0.9], [9.1, 0.9], [9.1, 9.1], [0.9, 9.1]];
    const OUTSIDE: [[f64; 2]; 4] = [[5.0, -0.8], [10.8, 5.0], [5.0, 10.8], [-0.8, 5.0]];
    const RIM: [[f64; 2]; 12] = [
        [8.6, 5.0],
        [8.12, 6.8],
        [6.8, 8.12],
        [5.0, 8.6],
        [3.2, 8.12],
        [1.88, 6.8],
        [1.4, 5.0],
        [1.88, 3.2],
        [3.2, 1.88],
        [5.0, 1.4],
        [6.8, 1.88],
        [8.12, 3.2],
    ];
    let (level, corners) = on_level(&quad.corners, COARSE_SIDE_PX, input);
    let image = input.pyramid.level(input.view, level);
    let Some((image, square)) = image.zip(Homography::from_square([0.0, 10.0], &corners)) else {
        return false;
    };
    let mean = |places: &[[f64; 2]]| {
        let seen = places.iter().filter_map(|place| {
            let [x, y] = square.project(*place).image;
            bilinear(image, x, y)
        });
        let [sum, count] = seen.fold([0.0, 0.0], |[s, n], grey| [s + grey, n + 1.0]);
        sum / count
    };
    let [black, outside, rim] = [mean(&CORNERS), mean(&OUTSIDE), mean(&RIM)];
    let contrast = (rim - black) / (outside - black);
    // Where all places of one kind are beyond the frame, it is not finite.
    !contrast.is_finite() || contrast > MIN_RIM
}

/// The level of the pyramid on which a quad's shortest side (where it is narrower, one and a half times its width across) is between this
/// length and twice this, and its corners there.
fn on_level(corners: &[Pixel; 4], side_px: f64, input: ImageInput<'_>) -> (usize, [[f64; 2]; 4]) {
    let level =
        ((at_most_across(shortest_side_px(corners), corners) / side_px).log2().floor().max(0.0)
            as usize)
            .min(input.pyramid.levels().saturating_sub(1));
    (level, corners.map(|c| [from_level_0(c.x, level), from_level_0(c.y, level)]))
}
