//! Detects AprilTag and ArUco markers: quads, also of tags in a grid, their cells, the codeword with its false-positive rate,
//! refined corners and pose; fallbacks for hidden and small ones.
//!
//! Fallbacks read quads of segments, of which a part may be hidden, and the quiet zones of markers whose border blur or a tone curve
//! breaks.

mod grid;
mod larger;

use geometry::Pixel;
use imaging::GrayView;
use markers::{Marker, Match, SquareCode};

use crate::candidates::evidence::{Needs, OutlineNeeds};
use crate::candidates::overlap::Overlap;
use crate::candidates::quad::{Quad, mean_side_px};
use crate::candidates::quiet_zone::{
    MAX_CONTRAST_VARIATION, PaperTone, TONES, border_contrast_variation, has_dark_border,
};
use crate::decode::cells::{Cells, Layout, SquareImage};
use crate::decode::erasures::Reading;
use crate::decode::false_positive;
use crate::decode::occluded::{Occluded, OccludedQuery, SquareReading};
use crate::decode::steps::Steps;
use crate::families::family::{FamilyDetector, FrameInput, Output, Prediction};
use crate::families::query::{ExpectedMarker, FamilyQuery, ImageInput, segment_corner_px};
use crate::families::square::larger::LargerCode;
use crate::observation::Observation;
use crate::refine::corners::refine;
use crate::refine::fit::{CornerGuess, Refined, Scratch};
use crate::refine::pattern::Pattern;
use crate::schedule::FallbackStep;
use crate::trace::{Reason, Trace};

/// Bounds on the work in one image, far above the needs of frames with markers: layouts that are solved for in quads that are
/// no markers, and markers, of which a calibration board has hundreds.
const MAX_SOLVED: usize = 500;
const MAX_FOUND: usize = 1024;
const MAX_DOUBTFUL: usize = 64;

/// Cells up to this width, in pixels, are read by their quiet zone: blur or a tone curve may break their border.
const MAX_QUIET_ZONE_CELL_PX: f64 = 4.0;

/// Quads in quiet zones are moved to where their cells explain the pixels best: up to this width of the cells, in pixels, from this
/// R² of the word of the cells on, so many in an image, their sides by these numbers of pixels.
const MAX_ALIGNED_CELL_PX: f64 = 2.0;
const MIN_ALIGNED_R_SQUARED: f64 = 0.6;
const MAX_ALIGNED: usize = 8;
const ALIGNING_PX: [f64; 4] = [0.3, 0.2, 0.15, 0.1];

/// Smallest R² of a marker; textures with a codeword reach less. In 565 images without markers, the highest
/// R² was 0.75, but for one with an ambiguous bit.
const MIN_R_SQUARED: f64 = 0.78;
/// The same with strong evidence, which chance does not give: compression spoils the pixels of small markers.
const MIN_R_SQUARED_STRONG: f64 = 0.68;
const STRONG_EVIDENCE_BITS: f64 = 14.0;
/// Smallest confidence without evidence, and by how much it falls with each bit of evidence.
const MIN_CONFIDENCE: f64 = 0.68;
const CONFIDENCE_PER_BIT: f64 = 0.02;
/// The same falls by this where cells are narrower than a bound in pixels: bits of small markers are
/// uncertain, and few other things are as small.
const SMALL_CELL_PX: f64 = 1.5;
const CONFIDENCE_OF_SMALL: f64 = 0.06;

/// The level of the pyramid from which on bright outlines are followed for markers printed white on black.
pub(crate) const INVERTED_FROM: usize = 2;

/// Standard deviation of the corners of an outline, in pixels.
const OUTLINE_CORNER_PX: f64 = 0.2;

/// A quad in a quiet zone whose cells are not a codeword.
#[derive(Copy, Clone, Debug)]
struct Unread {
    quad: Quad,
    /// The tone curve with which it was read, and the R² of the word that is nearest to its cells.
    curve: f64,
    r_squared: f64,
}

/// How a quad is moved to where its cells explain the pixels best.
#[derive(Copy, Clone, Debug)]
enum Move {
    Right,
    Down,
    Grow,
    Turn,
}

impl Move {
    const ALL: [Self; 4] = [Self::Right, Self::Down, Self::Grow, Self::Turn];

    /// The quad with its sides moved by so many pixels.
    fn of(self, quad: &Quad, step_px: f64) -> Quad {
        let ratio = 2.0 * step_px / mean_side_px(&quad.corners);
        match self {
            Self::Right => quad.moved(|[x, y]| [x + step_px, y]),
            Self::Down => quad.moved(|[x, y]| [x, y + step_px]),
            Self::Grow => quad.scaled(1.0 + ratio),
            Self::Turn => quad.moved(|[x, y]| [x - ratio * y, y + ratio * x]),
        }
    }
}

/// One family that is looked for.
#[derive(Debug)]
struct SquareQuery {
    query: FamilyQuery,
    code: &'static SquareCode,
    /// Indices of its layouts: with the code's border, and with one that is a cell wider.
    layouts: [Option<usize>; 2],
    /// The codes whose tags may contain one of these.
    larger: Vec<LargerCode>,
    /// The ids that a fallback looks for.
    missing: Vec<u32>,
    is_missing: bool,
}

impl SquareQuery {
    /// The ids that a fallback looks for; `None` means all.
    fn missing_ids(&self) -> Option<&[u32]> {
        (!self.query.has_any_id()).then_some(self.missing.as_slice())
    }

    /// How many codewords are looked for.
    fn codewords(&self) -> usize {
        if self.query.has_any_id() { self.code.codewords.len() } else { self.query.markers.len() }
    }
}

/// Finds the square markers of any number of families. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct SquareTagDetector {
    queries: Vec<SquareQuery>,
    layouts: Vec<Layout>,
    cells: Cells,
    found: Vec<Decoded>,
    /// Quads with a codeword that does not explain the pixels, with the index of the layout.
    doubtful: Vec<(Quad, usize)>,
    /// The number of quads in quiet zones of this image that were solved for, as they are and moved, and of those moved.
    solved: usize,
    aligned: usize,
    scratch: Scratch,
    occluded: Occluded<SquareReading>,
    /// Whether markers printed white on black are looked for as well.
    inverted: bool,
}

/// A marker that was decoded.
#[derive(Copy, Clone, Debug)]
struct Decoded {
    query: usize,
    id: u32,
    extra_border: u8,
    corners: [Pixel; 4],
    hamming: u8,
    r_squared: f64,
    /// Distance of the most doubtful bit from the middle between black and white, from 0 to 1.
    decision_margin: f64,
    /// Standard deviation of the corners, in pixels.
    corner_px: f64,
    /// Whether a reflection moves its edges, so that refined corners are hardly better.
    is_washed_out: bool,
}

impl SquareTagDetector {
    /// Largest size of outlines on the finest levels, in pixels of the level. Seen from the side, at a sixth of its length, a marker of
    /// 192 px is 32 px across: two levels on, its cells would be a pixel wide. Two levels on, a scratch opens the border of a marker of
    /// 64 px that is in full view.
    const MAX_OUTLINE_PX: u16 = 192;

    /// Looks for these markers; those of other families are left out. With `inverted` it looks for markers
    /// printed in the opposite colours as well.
    pub(crate) fn new(markers: &[Marker], inverted: bool) -> Self {
        let mut detector = Self { inverted, ..Self::default() };
        for marker in markers {
            let Some(code) = SquareCode::for_family(marker.family) else { continue };
            let known = detector.queries.iter_mut().find(|q| q.query.family == marker.family);
            if let Some(known) = known {
                known.query.markers.push(*marker);
                continue;
            }
            let mut layouts = [None; 2];
            for (extra_border, index) in (0..=extra_border_cells(code)).zip(&mut layouts) {
                *index = detector.layout(code, extra_border);
            }
            if layouts[0].is_some() {
                let query = FamilyQuery::new(*marker);
                let (larger, missing) = (LargerCode::all_of(code), Vec::new());
                detector.queries.push(SquareQuery {
                    query,
                    code,
                    layouts,
                    larger,
                    missing,
                    is_missing: false,
                });
            }
        }
        detector
    }

    /// Index of a code's layout, which codes may have in common; those with wider borders come last.
    fn layout(&mut self, code: &SquareCode, extra_border: u8) -> Option<usize> {
        let known = self.layouts.iter().position(|layout| layout.fits(code, extra_border));
        if known.is_none() {
            self.layouts.push(Layout::for_code(code, extra_border)?);
        }
        known.or(Some(self.layouts.len() - 1))
    }

    /// Reserves memory for a frame with texture.
    fn reserve(&mut self) {
        if self.is_empty() {
            return;
        }
        self.found.clear();
        self.found.reserve(MAX_FOUND);
        self.doubtful.clear();
        self.doubtful.reserve(MAX_DOUBTFUL);
        self.scratch.make_room();
        self.occluded.make_room();
        for query in &mut self.queries {
            query.missing.clear();
            query.missing.reserve(query.query.markers.len());
        }
    }

    /// Whether there is nothing to look for.
    pub(crate) fn is_empty(&self) -> bool {
        self.queries.is_empty()
    }

    /// Whether a family with a white border is looked for; the outlines of its markers are bright.
    fn has_reversed_border(&self) -> bool {
        self.layouts.iter().any(|layout| layout.reversed)
    }

    /// Finds the markers among the quads of an image, given likeliest first.
    fn detect_whole<'a>(
        &mut self,
        input: ImageInput<'_>,
        quads: impl Iterator<Item = &'a Quad>,
        out: &mut Output<'_>,
    ) {
        self.found.clear();
        self.doubtful.clear();
        self.decode_all(input, quads, out.trace);
        self.decode_grid(input, out.trace);
        out.stages.ended("codes");
        self.observe_all(input, 0, out.found);
        out.stages.ended("poses");
    }

    /// Finds one marker where it is expected.
    fn detect_expected(
        &mut self,
        input: ImageInput<'_>,
        expected: &ExpectedMarker,
    ) -> Option<Observation> {
        let index = self.queries.iter().position(|q| q.query.family == expected.family)?;
        let query = self.queries.get(index)?;
        let layout = self.layouts.get(query.layouts[0]?)?;
        let quad = Quad { corners: expected.corners, inverted: query.code.reversed_border };
        if border_contrast_variation(&quad, input.view, 0) > MAX_CONTRAST_VARIATION {
            return None;
        }
        let image = SquareImage::new(&quad.corners, layout.cells, input.view, input.pyramid)?;
        if !self.cells.solve_fast(&image, layout) {
            return None;
        }
        let found = query.code.nearest(self.cells.word(), max_hamming(query.code));
        let found = found.filter(|found| (found.id, found.rotation) == (expected.id, 0))?;
        let decoded = self.check(&quad, index, 0, found).ok()?;
        let refined = decoded.refined(query, input, true, &mut self.scratch)?;
        if query.larger.iter().any(|it| it.is_shown(&mut self.cells, input, &refined.corners)) {
            return None;
        }
        decoded.observation(query, refined, input)
    }

    /// Finds partly hidden markers among quads of segments, after [`SquareTagDetector::detect_whole`] and
    /// [`SquareTagDetector::note_missing`].
    fn detect_occluded(&mut self, input: ImageInput<'_>, quads: &[Quad], out: &mut Output<'_>) {
        let first = self.found.len();
        self.decode_doubtful(input.view, out.trace);
        self.decode_occluded(input.view, quads, out.trace);
        self.observe_all(input, first, out.found);
    }

    /// Finds markers whose border blur or a tone curve breaks, by their quiet zone, which is taken to be one
    /// cell wide.
    fn detect_in_quiet_zones(
        &mut self,
        input: ImageInput<'_>,
        quiet_zones: &[Quad],
        out: &mut Output<'_>,
    ) {
        let first = self.found.len();
        (self.solved, self.aligned) = (0, 0);
        for quiet_zone in quiet_zones {
            for layout in 0..self.layouts.len() {
                if self.solved < MAX_SOLVED {
                    self.decode_in_quiet_zone(input, quiet_zone, layout, out.trace);
                }
            }
        }
        self.observe_all(input, first, out.found);
    }

    fn decode_in_quiet_zone(
        &mut self,
        input: ImageInput<'_>,
        quiet_zone: &Quad,
        layout: usize,
        trace: &mut Trace,
    ) {
        let Layout { cells, extra_border, reversed, .. } = self.layouts[layout];
        let factor = cells as f64 / (cells + 2) as f64;
        let quad = Quad { inverted: false, ..quiet_zone.scaled(factor) };
        let cell_px = mean_side_px(&quad.corners) / cells as f64;
        if reversed
            || extra_border > 0
            || cell_px > MAX_QUIET_ZONE_CELL_PX
            || is_covered(&self.found, &quad)
            || !has_dark_border(&quad, input.view)
        {
            return;
        }
        let mut best: Option<Unread> = None;
        for PaperTone { curve, scale } in TONES {
            let quad = quad.scaled(scale);
            match self.decode_shown(input, &quad, layout, curve) {
                Ok(found) => return self.accept(found, trace),
                Err(r_squared) if best.is_none_or(|best| r_squared > best.r_squared) => {
                    best = Some(Unread { quad, curve, r_squared });
                }
                Err(_) => {}
            }
        }
        let best = best.filter(|best| best.r_squared > MIN_ALIGNED_R_SQUARED);
        let Some(best) = best else { return };
        if cell_px > MAX_ALIGNED_CELL_PX || self.aligned >= MAX_ALIGNED {
            return;
        }
        self.aligned += 1;
        // Of cells a pixel or two wide a quad that is off by a third of a pixel shows their neighbours.
        if let Some(found) = self.decode_aligned(input, best, layout, ALIGNING_PX) {
            self.accept(found, trace);
        }
    }

    /// The marker in a quad that is moved to where its cells explain the pixels best, by ever smaller steps, in pixels.
    fn decode_aligned(
        &mut self,
        input: ImageInput<'_>,
        mut best: Unread,
        layout: usize,
        steps_px: [f64; 4],
    ) -> Option<Decoded> {
        for step_px in steps_px {
            for (direction, step_px) in
                Move::ALL.into_iter().flat_map(|it| [(it, step_px), (it, -step_px)])
            {
                let quad = direction.of(&best.quad, step_px);
                match self.decode_shown(input, &quad, layout, best.curve) {
                    Ok(found) => return Some(found),
                    Err(r_squared) if r_squared > best.r_squared => {
                        best = Unread { quad, r_squared, ..best };
                    }
                    Err(_) => {}
                }
            }
        }
        None
    }

    /// The marker in a quad as a camera with this tone curve shows it; if there is none, the R² of the word that is nearest to the
    /// cells.
    fn decode_shown(
        &mut self,
        input: ImageInput<'_>,
        quad: &Quad,
        layout: usize,
        curve: f64,
    ) -> Result<Decoded, f64> {
        let Layout { cells, .. } = self.layouts[layout];
        let image = SquareImage::new(&quad.corners, cells, input.view, input.pyramid);
        let image = image.ok_or(0.0)?.through(curve, cells);
        self.solved += 1;
        if !self.cells.solve(&image, &self.layouts[layout]) {
            return Err(0.0);
        }
        let r_squared = self.cells.explain(self.cells.word()).r_squared;
        self.match_codewords(quad, layout).map_err(|_| r_squared)
    }

    fn accept(&mut self, found: Decoded, trace: &mut Trace) {
        trace.accept_quad(found.corners);
        self.found.push(found);
    }

    /// Adds the observations decoded from the index `from` on, the most confident first; not those of parts of a larger tag.
    fn observe_all(&mut self, input: ImageInput<'_>, from: usize, found: &mut Vec<Observation>) {
        let first = found.len();
        let mut index = from;
        while let Some(marker) = self.found.get(index) {
            let Some(query) = self.queries.get(marker.query) else { break };
            let refined = marker.refined(query, input, false, &mut self.scratch);
            let refined =
                refined.unwrap_or_else(|| Refined::unrefined(&marker.corners, marker.corner_px));
            let cells = &mut self.cells;
            let is_part = query.larger.iter().any(|it| it.is_shown(cells, input, &refined.corners));
            match marker.observation(query, refined, input).filter(|_| !is_part) {
                Some(seen) => {
                    found.push(seen);
                    index += 1;
                }
                // A fallback may find more of it.
                None => {
                    self.found.swap_remove(index);
                }
            }
        }
        found[first..].sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
    }

    fn decode_all<'a>(
        &mut self,
        input: ImageInput<'_>,
        quads: impl Iterator<Item = &'a Quad>,
        trace: &mut Trace,
    ) {
        let mut solved = 0;
        for quad in quads {
            let (solved_before, found_before) = (solved, self.found.len());
            for layout in 0..self.layouts.len() {
                if self.is_known(quad, layout) {
                    continue;
                }
                let Layout { cells, extra_border, .. } = self.layouts[layout];
                let image = SquareImage::new(&quad.corners, cells, input.view, input.pyramid);
                let Some(image) = image else { continue };
                if extra_border > 0 && !image.has_second_ring(cells) {
                    continue;
                }
                solved += 1;
                let is_solved = self.cells.solve(&image, &self.layouts[layout]);
                let found =
                    if is_solved { self.match_codewords(quad, layout) } else { Err(Reason::Small) };
                match found {
                    Ok(found) => {
                        self.drop_parts(quad, layout);
                        self.accept(found, trace);
                    }
                    Err(reason) => {
                        if reason == Reason::Confidence && self.doubtful.len() < MAX_DOUBTFUL {
                            self.doubtful.push((*quad, layout));
                        }
                        trace.refuse_quad(quad.corners, reason);
                    }
                }
            }
            if self.found.len() > found_before {
                solved = solved_before;
            }
            if solved >= MAX_SOLVED || self.found.len() >= MAX_FOUND {
                break;
            }
        }
    }

    /// Notes which markers a fallback is to look for, as in [`FamilyQuery::is_missing`]; false when none.
    fn note_missing(&mut self, all: bool) -> bool {
        for (index, query) in self.queries.iter_mut().enumerate() {
            let known =
                self.found.iter().filter(|found| found.query == index).map(|found| found.id);
            query.is_missing = query.query.is_missing(all, known.clone());
            query.missing.clear();
            let ids = query.query.ids();
            query.missing.extend(ids.filter(|id| known.clone().all(|found| found != *id)));
        }
        self.queries.iter().any(|query| query.is_missing)
    }

    /// Reads doubtful quads by the steps between their cells: in uneven light no codeword explains the pixels.
    fn decode_doubtful(&mut self, view: GrayView<'_>, trace: &mut Trace) {
        for (quad, layout) in &self.doubtful {
            if is_covered(&self.found, quad) {
                continue;
            }
            let queries = self.queries.iter().enumerate();
            let queries = queries.filter(|(_, it)| it.is_missing && it.layouts[0] == Some(*layout));
            let mut read = queries.filter_map(|(index, query)| {
                let ids = query.missing_ids();
                let reading = Steps::read(view, quad, query.code)?.decode(query.code, ids)?;
                let mut corners = quad.corners;
                corners.rotate_left(usize::from(reading.rotation % 4));
                Some(Decoded {
                    corner_px: OUTLINE_CORNER_PX,
                    ..Decoded::read(index, corners, reading)
                })
            });
            if let Some(found) = read.next() {
                trace.accept_quad(found.corners);
                self.found.push(found);
            }
        }
    }

    fn decode_occluded(&mut self, view: GrayView<'_>, quads: &[Quad], trace: &mut Trace) {
        let missing = self.queries.iter().enumerate().filter(|(_, query)| query.is_missing);
        let queries = missing.map(|(family, query)| {
            let ids = query.missing_ids();
            OccludedQuery { family, code: query.code, ids }
        });
        let (known, inverted) = (&self.found, self.inverted);
        let is_open = |quad: &Quad, code: &SquareCode| {
            (inverted || quad.inverted == code.reversed_border) && !is_covered(known, quad)
        };
        for marker in self.occluded.find_squares(view, quads, queries, is_open) {
            let corners = marker.quad.corners;
            trace.accept_quad(corners);
            let SquareReading { family, reading } = marker.reading;
            self.found.push(Decoded::read(family, corners, reading));
        }
    }

    /// Whether a marker was found in this quad by this layout, or by one that contains it.
    fn is_known(&self, quad: &Quad, layout: usize) -> bool {
        let contains_it = |other: &Layout| self.layouts[layout].is_part_of(other);
        // Asked once, as boards have hundreds of markers.
        let is_contained = self.layouts.iter().any(contains_it);
        let has_layout = |found: &&Decoded| {
            let layouts = &self.queries[found.query].layouts;
            layouts.contains(&Some(layout))
                || is_contained
                    && layouts.iter().flatten().any(|other| contains_it(&self.layouts[*other]))
        };
        self.found
            .iter()
            .filter(has_layout)
            .any(|found| Overlap::new(&found.corners, &quad.corners).is_same_square())
    }

    /// Drops markers that were found in this quad by a part of this layout's bits: a part of a codeword may be a codeword of a smaller
    /// code. Four tags of Standard41h12 contain one of Circle21h7.
    fn drop_parts(&mut self, quad: &Quad, layout: usize) {
        let Self { found, queries, layouts, .. } = self;
        found.retain(|other| {
            let of_other = queries[other.query].layouts;
            let is_part = |other: &usize| layouts[*other].is_part_of(&layouts[layout]);
            !of_other.iter().flatten().any(is_part)
                || !Overlap::new(&other.corners, &quad.corners).is_same_square()
        });
    }

    /// The marker whose codeword is nearest to the cells of a quad.
    fn match_codewords(&self, quad: &Quad, layout: usize) -> Result<Decoded, Reason> {
        let word = self.cells.word();
        let mut best = Err(Reason::Code);
        for (index, query) in self.queries.iter().enumerate() {
            if !query.layouts.contains(&Some(layout)) {
                continue;
            }
            let Some(found) = query.code.nearest(word, max_hamming(query.code)) else { continue };
            let is_better = match &best {
                Ok(Decoded { hamming, .. }) => found.hamming < *hamming,
                Err(_) => true,
            };
            if is_better {
                best = self.check(quad, index, self.layouts[layout].extra_border, found);
            }
        }
        best
    }

    /// The marker of a codeword, if it is looked for and explains the pixels.
    fn check(
        &self,
        quad: &Quad,
        index: usize,
        extra_border: u8,
        found: Match,
    ) -> Result<Decoded, Reason> {
        let Match { id, rotation, hamming } = found;
        let query = self.queries.get(index).ok_or(Reason::Unwanted)?;
        let code = query.code;
        if !query.query.includes(id) {
            return Err(Reason::Unwanted);
        }
        if quad.inverted != code.reversed_border && !self.inverted {
            return Err(Reason::Unwanted);
        }
        let codeword = *code.codewords.get(id as usize).ok_or(Reason::Unwanted)?;
        // As it is rotated in the image.
        let seen = (0..(4 - rotation) % 4).fold(codeword, |word, _| code.rotated(word));
        let explanation = self.cells.explain(seen);
        let [dark, bright] = explanation.levels;
        if (bright > dark) != (quad.inverted == code.reversed_border) {
            return Err(Reason::Contrast);
        }
        let r_squared = explanation.r_squared;
        let bits = code.bits.len();
        let evidence = false_positive::evidence(
            code,
            codeword,
            query.codewords(),
            bits as u32,
            hamming.into(),
        );
        let is_strong = evidence >= STRONG_EVIDENCE_BITS;
        if r_squared < if is_strong { MIN_R_SQUARED_STRONG } else { MIN_R_SQUARED } {
            return Err(Reason::Confidence);
        }
        let bit_margin = |bit| (2.0 * self.cells.value(bit) - 1.0).abs();
        let decision_margin = (0..bits).map(bit_margin).fold(1.0, f64::min);
        let cell_px = mean_side_px(&quad.corners) / f64::from(code.cells + 2 * extra_border);
        let small = if cell_px < SMALL_CELL_PX { CONFIDENCE_OF_SMALL } else { 0.0 };
        let min_confidence = MIN_CONFIDENCE - CONFIDENCE_PER_BIT * evidence - small;
        if confidence(r_squared, decision_margin) < min_confidence {
            return Err(Reason::Confidence);
        }
        let mut corners = quad.corners;
        corners.rotate_left(usize::from(rotation) % 4);
        Ok(Decoded {
            query: index,
            id,
            extra_border,
            corners,
            hamming,
            r_squared,
            decision_margin,
            corner_px: OUTLINE_CORNER_PX,
            is_washed_out: false,
        })
    }
}

impl FamilyDetector for SquareTagDetector {
    fn needs(&self) -> Needs {
        // Markers with a white border may be as small as others; others printed white on black are searched where they are
        // large.
        let bright_from = match self.has_reversed_border() {
            true => Some(0),
            false => self.inverted.then_some(INVERTED_FROM),
        };
        let quads = OutlineNeeds { bright_from, max_size_px: Self::MAX_OUTLINE_PX };
        Needs { pyramid: true, quads: Some(quads) }
    }

    fn fallback_steps(&self) -> &'static [FallbackStep] {
        &[FallbackStep::Segments, FallbackStep::QuietZones]
    }

    fn make_room(&mut self) {
        self.reserve();
    }

    fn detect(&mut self, input: FrameInput<'_>, out: &mut Output<'_>) {
        let image = ImageInput::new(&input);
        let evidence = &*input.evidence;
        self.detect_whole(image, evidence.outline_quads.iter(), out);
    }

    fn detect_at(&mut self, input: FrameInput<'_>, at: &Prediction) -> Option<Observation> {
        let image = ImageInput::new(&input);
        self.detect_expected(image, &ExpectedMarker::new(at)?)
    }

    fn wants_fallback(&mut self, step: FallbackStep, all: bool, _found: &[Observation]) -> bool {
        match step {
            FallbackStep::Segments => self.note_missing(all),
            _ => all,
        }
    }

    fn fallback(&mut self, step: FallbackStep, input: FrameInput<'_>, out: &mut Output<'_>) {
        let image = ImageInput::new(&input);
        let evidence = &*input.evidence;
        match step {
            FallbackStep::Segments => self.detect_occluded(image, evidence.segment_quads(), out),
            FallbackStep::QuietZones => {
                self.detect_in_quiet_zones(image, &evidence.quiet_zones, out);
            }
            _ => {}
        }
    }
}

fn is_covered(found: &[Decoded], quad: &Quad) -> bool {
    found.iter().any(|found| Overlap::new(&found.corners, &quad.corners).is_covered())
}

fn confidence(r_squared: f64, decision_margin: f64) -> f64 {
    r_squared * (0.5 + 0.5 * decision_margin.min(1.0))
}

/// Largest Hamming distance that is corrected; short codes get none, since their codewords are too dense.
fn max_hamming(code: &SquareCode) -> u8 {
    match code.min_hamming {
        0..=6 => 0,
        7..=9 => 1,
        10..=12 => 2,
        _ => 3,
    }
}

/// By how many cells a border may be wider than the code's: calibration boards have borders of two cells.
/// Only for codes with a low false-positive rate.
fn extra_border_cells(code: &SquareCode) -> u8 {
    u8::from(code.min_hamming >= 9 && !code.reversed_border)
}

impl Decoded {
    /// A marker whose bits were read one by one, of a quad of segments.
    fn read(query: usize, corners: [Pixel; 4], reading: Reading) -> Self {
        // Evidence of 20 bits gives the confidence of a marker in full view.
        let decision_margin = f64::from(reading.intact * (reading.evidence / 20.0).min(1.0));
        Self {
            query,
            id: reading.id,
            extra_border: 0,
            corners,
            hamming: reading.hamming,
            r_squared: f64::from(reading.r_squared),
            decision_margin,
            corner_px: segment_corner_px(&corners),
            is_washed_out: reading.is_washed_out,
        }
    }

    /// Its refined corners; `is_near` as in [`CornerGuess`].
    fn refined(
        &self,
        query: &SquareQuery,
        input: ImageInput<'_>,
        is_near: bool,
        scratch: &mut Scratch,
    ) -> Option<Refined> {
        let codeword = query.code.codewords.get(self.id as usize)?;
        let pattern = Pattern::bordered(query.code, *codeword, self.extra_border)?;
        let ImageInput { view, camera, response, .. } = input;
        let guess = CornerGuess { view, corners: &self.corners, camera, is_near, response };
        refine(&guess, &pattern, scratch)
    }

    fn observation(
        &self,
        query: &SquareQuery,
        mut refined: Refined,
        input: ImageInput<'_>,
    ) -> Option<Observation> {
        if self.is_washed_out {
            refined.add_uncertainty(self.corner_px);
        }
        let confidence = confidence(self.r_squared, self.decision_margin);
        query.query.observation(self.id, self.hamming, confidence, &refined, input)
    }
}
