//! Square markers: [`code`] says which cells of which family carry which words, `quad` finds four-sided outlines,
//! `decode` reads their cells. `pattern` says which cells of a marker are black and white, `refine` where its
//! corners are. [`Squares`] does it all, for any number of families at once. Where outlines are broken, `segments`
//! makes quads of straight pieces of edges, `erasures` reads what is left of a marker, and `damaged` does both.

use geometry::{CameraModel, Pixel};
use imaging::{GrayView, Outline, Outlines, Pyramid, bilinear};
use markers::{Family, Marker, Match, SquareCode};
use nalgebra::{Matrix2, SMatrix};

use crate::candidates::quad::{Quad, diagonal_px, middle, sides_px};
use crate::decode::cells::{Cells, Layout, Look};
use crate::decode::false_positive as chance;
use crate::decode::occluded::{Damaged, Sought};
use crate::observation::{Observation, Stages};
use crate::pose::square_pose;
use crate::refine::corners::{Refined, Scratch, refine_from};
use crate::refine::pattern::Pattern;
use crate::trace::{Reason, Trace};

/// Bounds on the work in one image, far above what frames with markers need.
const MOST_QUADS: usize = 4000;
const MOST_SOLVED: usize = 500;
const MOST_FOUND: usize = 256;
pub(crate) const MOST_PAPERS: usize = 64;

/// Borders are broken by what is in them where cells are not wider, in pixels.
const MOST_BROKEN_CELL_PX: f64 = 2.0;

/// How alike the steps from border to paper are all round a marker: the standard deviation as a share of the mean.
pub(crate) const MOST_UNEVEN: f64 = 0.6;
/// Share of the variance of its pixels that a marker explains; textures that happen to spell a word explain less. In 565
/// pictures without markers none did more than 0.75, but for one with a bit that was neither black nor white.
const LEAST_EXPLAINED: f64 = 0.78;
/// The same for a word with as much evidence, in bits: chance spells none. Compression spoils the pixels of small ones.
const LEAST_EXPLAINED_SURE: f64 = 0.68;
const SURE_BITS: f64 = 14.0;
/// What a marker is sure to at least: so much, less for each bit of evidence.
const LEAST_CONFIDENCE: f64 = 0.68;
const CONFIDENCE_PER_BIT: f64 = 0.02;
/// Where cells are hardly wider than a pixel the doubtful bits of true markers are as doubtful as those of others, but
/// there are fewer of the latter.
const SMALL_CELL_PX: f64 = 1.5;
const CONFIDENCE_OF_SMALL: f64 = 0.06;

/// How good corners are before they are refined: of an outline; of joined segments, at least, and as a share of the
/// diagonal.
const OUTLINED_PX: f64 = 0.2;
pub(crate) const JOINED_PX: f64 = 0.5;
pub(crate) const JOINED_SHARE: f64 = 0.015;

/// One family that is looked for, and which of its ids.
#[derive(Debug)]
struct Wanted {
    code: &'static SquareCode,
    /// Indices of the cells it shares with other families: with its border, and with one that is a cell wider.
    layouts: [Option<usize>; 2],
    markers: Vec<Marker>,
    /// The ids that were not yet found in this image.
    missing: Vec<u32>,
    is_missing: bool,
}

impl Wanted {
    /// How many markers are looked for.
    fn words(&self) -> usize {
        let any_id = self.markers.iter().any(|m| m.id.is_none());
        if any_id { self.code.codewords.len() } else { self.markers.len() }
    }
}

/// Finds the square markers of any number of families. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct Squares {
    wanted: Vec<Wanted>,
    layouts: Vec<Layout>,
    quads: Vec<Candidate>,
    cells: Cells,
    found: Vec<Found>,
    scratch: Scratch,
    damaged: Damaged,
    /// Whether markers printed in the other colours are looked for.
    inverted: bool,
}

#[derive(Copy, Clone, Debug)]
struct Candidate {
    quad: Quad,
    unevenness: f64,
}

#[derive(Copy, Clone, Debug)]
struct Found {
    wanted: usize,
    id: u32,
    /// Cells by which its border is wider than the code's.
    extra_border: u8,
    corners: [Pixel; 4],
    wrong_bits: u8,
    explained: f64,
    margin: f64,
    /// How good the corners are as they were found, in pixels.
    corner_px: f64,
    /// Whether a reflection moves its edges, so that the refined corners are hardly better.
    washed_out: bool,
}

impl Squares {
    /// Outlines on the finest levels up to this size, in pixels of the level, may be a marker's: two levels on, cells of
    /// markers of ten across would be narrower than two pixels, and a scratch in a border would open it.
    pub(crate) const LARGEST_PX: u16 = 64;

    /// Looks for these markers, printed in the other colours as well when `inverted`; those of families without square cells
    /// are left out.
    pub(crate) fn new(markers: &[Marker], inverted: bool) -> Self {
        let mut squares = Self { inverted, ..Self::default() };
        for marker in markers {
            let Some(code) = SquareCode::for_family(marker.family) else {
                continue;
            };
            if let Some(known) = squares.wanted.iter_mut().find(|w| w.code.family == marker.family)
            {
                known.markers.push(*marker);
                continue;
            }
            let mut layouts = [None; 2];
            for (extra_border, index) in (0..=wider_by(code)).zip(&mut layouts) {
                *index = squares.layout(code, extra_border);
            }
            if layouts[0].is_none() {
                continue;
            }
            let markers = vec![*marker];
            squares.wanted.push(Wanted {
                code,
                layouts,
                markers,
                missing: Vec::new(),
                is_missing: false,
            });
        }
        squares
    }

    /// Index of a code's cells, which other codes may have in common; those with wider borders come last.
    fn layout(&mut self, code: &SquareCode, extra_border: u8) -> Option<usize> {
        let known = self.layouts.iter().position(|layout| layout.fits(code, extra_border));
        if known.is_none() {
            self.layouts.push(Layout::of(code, extra_border)?);
        }
        known.or(Some(self.layouts.len() - 1))
    }

    /// Makes the buffers as large as frames with texture need.
    pub(crate) fn make_room(&mut self) {
        const QUADS: usize = 2000;
        // STags are looked for among these quads, too.
        self.quads.clear();
        self.quads.reserve(QUADS);
        if !self.is_empty() {
            self.found.clear();
            self.found.reserve(MOST_FOUND);
            self.scratch.make_room();
            self.damaged.make_room();
            for wanted in &mut self.wanted {
                wanted.missing.clear();
                wanted.missing.reserve(wanted.markers.len());
            }
        }
    }

    /// True when there is nothing to look for.
    pub(crate) fn is_empty(&self) -> bool {
        self.wanted.is_empty()
    }

    /// The quads of the last image that have an even border, the evenest first.
    pub(crate) fn quads(&self) -> impl Iterator<Item = &Quad> {
        self.quads.iter().map(|candidate| &candidate.quad)
    }

    /// Whether families with a white border are among those looked for; their outlines are bright.
    pub(crate) fn has_bright(&self) -> bool {
        self.layouts.iter().any(|layout| layout.reversed)
    }

    /// Finds the markers among the outlines of an image.
    pub(crate) fn detect(
        &mut self,
        view: GrayView<'_>,
        outlines: &Outlines,
        camera: Option<&CameraModel>,
        (trace, stages): (&mut Trace, &mut impl Stages),
        found: &mut Vec<Observation>,
    ) {
        self.quads.clear();
        for outline in outlines.iter() {
            self.consider(view, outlines, &outline, trace);
            if self.quads.len() >= MOST_QUADS {
                break;
            }
        }
        stages.ended("quads");
        self.found.clear();
        self.read(view, outlines, trace);
        stages.ended("codes");
        self.observe_all(view, 0, camera, found);
        stages.ended("poses");
    }

    /// Finds the marker of this family and id whose corners, its own top left first, should be about here.
    pub(crate) fn detect_at(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        (family, id, corners): (Family, u32, [Pixel; 4]),
        camera: Option<&CameraModel>,
    ) -> Option<Observation> {
        let index = self.wanted.iter().position(|wanted| wanted.code.family == family)?;
        let wanted = self.wanted.get(index)?;
        let layout = self.layouts.get(wanted.layouts[0]?)?;
        let quad = Quad { corners, inverted: wanted.code.reversed_border };
        if unevenness(&quad, view, 0) > MOST_UNEVEN {
            return None;
        }
        let look = Look::at(&corners, layout.cells, view, pyramid)?;
        if !self.cells.solve_plain(&look, layout) {
            return None;
        }
        let code = wanted.code;
        let found = code.nearest(self.cells.word(), most_wrong(code));
        let found = found.filter(|found| (found.id, found.rotation) == (id, 0))?;
        let found = self.admit(&quad, (index, 0), found).ok()?;
        let refined = found.refined((view, true), wanted, camera, &mut self.scratch)?;
        Some(observed(&found, wanted, refined, camera))
    }

    /// Finds the markers that closed outlines do not show, as something hides a part of them, among quads of segments, after
    /// [`Squares::note_missing`] said that some are missing; it comes after [`Squares::detect`].
    pub(crate) fn detect_damaged(
        &mut self,
        (view, quads): (GrayView<'_>, &[Quad]),
        camera: Option<&CameraModel>,
        (trace, stages): (&mut Trace, &mut impl Stages),
        found: &mut Vec<Observation>,
    ) {
        let whole = self.found.len();
        self.read_damaged((view, quads), trace);
        self.observe_all(view, whole, camera, found);
        stages.ended("damaged");
    }

    /// Finds markers so small that their border is broken by the outlines of their paper, which is taken to be as wide around
    /// the border as a cell.
    pub(crate) fn detect_on_paper(
        &mut self,
        (view, pyramid, papers): (GrayView<'_>, &Pyramid, &[Quad]),
        camera: Option<&CameraModel>,
        trace: &mut Trace,
        found: &mut Vec<Observation>,
    ) {
        let whole = self.found.len();
        for paper in papers {
            for layout in 0..self.layouts.len() {
                self.read_on_paper((view, pyramid), paper, layout, trace);
            }
        }
        self.observe_all(view, whole, camera, found);
    }

    fn read_on_paper(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        paper: &Quad,
        layout: usize,
        trace: &mut Trace,
    ) {
        let Layout { cells, extra_border, reversed, .. } = self.layouts[layout];
        let quad = Quad { inverted: false, ..paper.scaled(cells as f64 / (cells + 2) as f64) };
        let cell_px = mean_side(&quad.corners) / cells as f64;
        let is_known = self.found.iter().any(|found| covers(&found.corners, &quad.corners));
        if reversed || extra_border > 0 || cell_px > MOST_BROKEN_CELL_PX || is_known {
            return;
        }
        let Some(look) = Look::at(&quad.corners, cells, view, pyramid) else { return };
        if self.cells.solve(&look, &self.layouts[layout])
            && let Ok(found) = self.match_words(&quad, layout)
        {
            trace.accept_quad(quad.corners);
            self.found.push(found);
        }
    }

    /// Observes what was found from the index `from` on.
    fn observe_all(
        &mut self,
        view: GrayView<'_>,
        from: usize,
        camera: Option<&CameraModel>,
        found: &mut Vec<Observation>,
    ) {
        let first = found.len();
        for marker in self.found.iter().skip(from) {
            if let Some(wanted) = self.wanted.get(marker.wanted) {
                found.push(observe(view, marker, wanted, camera, &mut self.scratch));
            }
        }
        found[first..].sort_unstable_by(|a, b| b.confidence.total_cmp(&a.confidence));
    }

    /// Keeps an outline that is a quad with an even border.
    fn consider(
        &mut self,
        view: GrayView<'_>,
        outlines: &Outlines,
        outline: &Outline<'_>,
        trace: &mut Trace,
    ) {
        let Some(quad) = Quad::of(outline) else {
            return;
        };
        let Some(level) = outlines.pyramid().level(view, outline.level) else {
            return;
        };
        let uneven = unevenness(&quad, level, outline.level);
        if uneven <= MOST_UNEVEN {
            self.quads.push(Candidate { quad, unevenness: uneven });
        } else {
            trace.refuse_quad(quad.corners, Reason::Border);
        }
    }

    fn read(&mut self, view: GrayView<'_>, outlines: &Outlines, trace: &mut Trace) {
        // The evenest first, so that a bound on the work costs the least likely ones.
        self.quads.sort_unstable_by(|a, b| a.unevenness.total_cmp(&b.unevenness));
        let mut solved = 0;
        for index in 0..self.quads.len() {
            let quad = self.quads[index].quad;
            for layout in 0..self.layouts.len() {
                if self.is_known(&quad, layout) {
                    continue;
                }
                let cells = self.layouts[layout].cells;
                let Some(look) = Look::at(&quad.corners, cells, view, outlines.pyramid()) else {
                    continue;
                };
                if self.layouts[layout].extra_border > 0 && !look.has_second_ring(cells) {
                    continue;
                }
                solved += 1;
                let read = self.cells.solve(&look, &self.layouts[layout]);
                match if read { self.match_words(&quad, layout) } else { Err(Reason::Small) } {
                    Ok(found) => {
                        trace.accept_quad(quad.corners);
                        self.found.push(found);
                    }
                    Err(reason) => trace.refuse_quad(quad.corners, reason),
                }
            }
            if solved >= MOST_SOLVED || self.found.len() >= MOST_FOUND {
                break;
            }
        }
    }

    /// Notes what is looked for on where closed outlines do not show it; false when nothing is. That is `all` that is missing, or
    /// else those of any id of families of which two were found: of a board.
    pub(crate) fn note_missing(&mut self, all: bool) -> bool {
        let mut is_any_missing = false;
        for (index, wanted) in self.wanted.iter_mut().enumerate() {
            wanted.missing.clear();
            let known = || self.found.iter().filter(|found| found.wanted == index);
            let any = wanted.markers.iter().any(|marker| marker.id.is_none());
            let ids = wanted.markers.iter().filter_map(|marker| marker.id);
            wanted.missing.extend(ids.filter(|id| known().all(|found| found.id != *id)));
            wanted.is_missing = if any {
                all || known().nth(1).is_some()
            } else {
                all && !wanted.missing.is_empty()
            };
            is_any_missing |= wanted.is_missing;
        }
        is_any_missing
    }

    /// Looks for what is missing.
    fn read_damaged(&mut self, (view, quads): (GrayView<'_>, &[Quad]), trace: &mut Trace) {
        let missing = self.wanted.iter().enumerate().filter(|(_, wanted)| wanted.is_missing);
        let sought = missing.map(|(index, wanted)| {
            let any = wanted.markers.iter().any(|marker| marker.id.is_none());
            Sought { index, code: wanted.code, ids: (!any).then_some(wanted.missing.as_slice()) }
        });
        let (known, inverted) = (&self.found, self.inverted);
        let is_open = |quad: &Quad, code: &SquareCode| {
            (inverted || quad.inverted == code.reversed_border)
                && !known.iter().any(|found| covers(&found.corners, &quad.corners))
        };
        for marker in self.damaged.find(view, quads, sought, is_open) {
            let corners = marker.quad.corners;
            trace.accept_quad(corners);
            let reading = marker.reading;
            // As many bits again as make the reading certain make it as sure as a whole marker's.
            let margin = f64::from(reading.intact * (reading.evidence / 20.0).min(1.0));
            self.found.push(Found {
                wanted: marker.index,
                id: reading.id,
                extra_border: 0,
                corners,
                wrong_bits: reading.wrong_bits,
                explained: f64::from(reading.explained),
                margin,
                corner_px: (JOINED_SHARE * corners[0].distance(&corners[2])).max(JOINED_PX),
                washed_out: reading.washed_out,
            });
        }
    }

    /// Whether a marker with these cells was found where the quad is.
    fn is_known(&self, quad: &Quad, layout: usize) -> bool {
        let of_layout = |found: &&Found| self.wanted[found.wanted].layouts.contains(&Some(layout));
        self.found.iter().filter(of_layout).any(|found| is_same(&found.corners, &quad.corners))
    }

    /// The family and id whose word the cells of a quad carry, or how near to one they are.
    fn match_words(&self, quad: &Quad, layout: usize) -> Result<Found, Reason> {
        let word = self.cells.word();
        let mut best = Err(Reason::Code);
        for (index, wanted) in self.wanted.iter().enumerate() {
            if !wanted.layouts.contains(&Some(layout)) {
                continue;
            }
            let most = most_wrong(wanted.code);
            let Some(nearest) = wanted.code.nearest(word, most) else {
                continue;
            };
            let is_better = match &best {
                Ok(Found { wrong_bits: least, .. }) => nearest.hamming < *least,
                Err(_) => true,
            };
            if is_better {
                let extra_border = self.layouts[layout].extra_border;
                best = self.admit(quad, (index, extra_border), nearest);
            }
        }
        best
    }

    /// A word that was read as a marker, if that is wanted and explains what is seen.
    fn admit(
        &self,
        quad: &Quad,
        (index, extra_border): (usize, u8),
        Match { id, rotation, hamming }: Match,
    ) -> Result<Found, Reason> {
        let wanted = self.wanted.get(index).ok_or(Reason::Unwanted)?;
        if !wanted.markers.iter().any(|m| m.id.is_none_or(|wanted| wanted == id)) {
            return Err(Reason::Unwanted);
        }
        if quad.inverted != wanted.code.reversed_border && !self.inverted {
            return Err(Reason::Unwanted);
        }
        let word = wanted.code.codewords.get(id as usize).ok_or(Reason::Unwanted)?;
        // The word as it stands in the picture.
        let seen = (0..(4 - rotation) % 4).fold(*word, |word, _| wanted.code.rotated(word));
        let explanation = self.cells.explain(seen);
        let [dark, bright] = explanation.levels;
        // A marker printed in the other colours has them the other way round.
        if (bright > dark) != (quad.inverted == wanted.code.reversed_border) {
            return Err(Reason::Contrast);
        }
        let explained = explanation.explained;
        let bits = wanted.code.bits.len();
        let evidence =
            chance::evidence(wanted.code, *word, wanted.words(), bits as u32, hamming.into());
        let is_sure = evidence >= SURE_BITS;
        if explained < if is_sure { LEAST_EXPLAINED_SURE } else { LEAST_EXPLAINED } {
            return Err(Reason::Confidence);
        }
        let margin =
            (0..bits).map(|bit| (2.0 * self.cells.value(bit) - 1.0).abs()).fold(1.0, f64::min);
        let cells = wanted.code.cells + 2 * extra_border;
        let cell_px = mean_side(&quad.corners) / f64::from(cells);
        let small = if cell_px < SMALL_CELL_PX { CONFIDENCE_OF_SMALL } else { 0.0 };
        if confidence(explained, margin) < LEAST_CONFIDENCE - CONFIDENCE_PER_BIT * evidence - small
        {
            return Err(Reason::Confidence);
        }
        let mut corners = quad.corners;
        corners.rotate_left(usize::from(rotation) % 4);
        Ok(Found {
            wanted: index,
            id,
            extra_border,
            corners,
            wrong_bits: hamming,
            explained,
            margin,
            corner_px: OUTLINED_PX,
            washed_out: false,
        })
    }
}

/// From what a marker explains of its pixels, and from its most doubtful bit.
fn confidence(explained: f64, margin: f64) -> f64 {
    explained * (0.5 + 0.5 * margin.min(1.0))
}

pub(crate) fn mean_side(corners: &[Pixel; 4]) -> f64 {
    sides_px(corners).iter().sum::<f64>() / 4.0
}

/// How many wrong bits are mended. Families of few bits have words near most words; theirs must be read as they are.
fn most_wrong(code: &SquareCode) -> u8 {
    match code.min_hamming {
        0..=6 => 0,
        7..=9 => 1,
        10..=12 => 2,
        _ => 3,
    }
}

/// How many cells the border of a family's markers may be wider than the code says: grids for calibration have borders of
/// two cells. Only words that chance does not spell are read so.
fn wider_by(code: &SquareCode) -> u8 {
    u8::from(code.min_hamming >= 9 && !code.reversed_border)
}

/// Whether two quads are of the same square, up to a turn.
fn is_same(a: &[Pixel; 4], b: &[Pixel; 4]) -> bool {
    let (size, other) = (diagonal_px(a), diagonal_px(b));
    middle(a).distance(&middle(b)) < 0.2 * size && other < 1.5 * size && size < 1.5 * other
}

/// Whether a marker that was found leaves no place for another one there: one around it may be.
pub(crate) fn covers(known: &[Pixel; 4], other: &[Pixel; 4]) -> bool {
    let size = diagonal_px(known);
    middle(known).distance(&middle(other)) < 0.4 * size && diagonal_px(other) < 1.5 * size
}

/// The quads of bright outlines from the index `first` on that stand out evenly all round, as the paper of a small marker does.
pub(crate) fn papers<'a>(
    view: GrayView<'a>,
    outlines: &'a Outlines,
    first: usize,
) -> impl Iterator<Item = Quad> + 'a {
    outlines
        .iter()
        .skip(first)
        .filter_map(|outline| Quad::of(&outline))
        .filter(move |paper| unevenness(paper, view, 0) <= MOST_UNEVEN)
        .take(MOST_PAPERS)
}

/// Standard deviation of the steps from just within a quad to just outside, all round, as a share of their mean: in grey
/// levels or, across the edge of a shadow, in their logarithms, whichever is less. Large where the mean is not positive.
pub(crate) fn unevenness(quad: &Quad, view: GrayView<'_>, level: usize) -> f64 {
    use imaging::pyramid::from_level_0;
    const POINTS: usize = 6;
    let corners = quad.corners.map(|c| [from_level_0(c.x, level), from_level_0(c.y, level)]);
    let (mut plain, mut logarithms) = (Spread::default(), Spread::default());
    for side in 0..4 {
        let ([ax, ay], [bx, by]) = (corners[side], corners[(side + 1) % 4]);
        let (dx, dy) = (bx - ax, by - ay);
        let length = dx.hypot(dy);
        // To the left of a clockwise way is outside.
        let off = (0.07 * length).max(0.7) / length;
        let (nx, ny) = (dy * off, -dx * off);
        for k in 0..POINTS {
            let t = (k as f64 + 0.75) / (POINTS as f64 + 0.5);
            let (x, y) = (ax + dx * t, ay + dy * t);
            if let (Some(outer), Some(inner)) =
                (bilinear(view, x + nx, y + ny), bilinear(view, x - nx, y - ny))
            {
                let (dark, bright) = if quad.inverted { (outer, inner) } else { (inner, outer) };
                plain.add(bright - dark);
                logarithms.add(((bright + 4.0) / (dark + 4.0)).ln());
            }
        }
    }
    plain.relative().min(logarithms.relative())
}

#[derive(Default)]
struct Spread {
    count: f64,
    sum: f64,
    squares: f64,
}

impl Spread {
    fn add(&mut self, value: f64) {
        self.count += 1.0;
        self.sum += value;
        self.squares += value * value;
    }

    /// Standard deviation as a share of the mean.
    fn relative(&self) -> f64 {
        let mean = self.sum / self.count;
        let variance = self.squares / self.count - mean * mean;
        if mean > 0.0 { variance.max(0.0).sqrt() / mean } else { f64::MAX }
    }
}

impl Found {
    /// Its corners between the pixels, when those it has may be near.
    fn refined(
        &self,
        (view, are_near): (GrayView<'_>, bool),
        wanted: &Wanted,
        camera: Option<&CameraModel>,
        scratch: &mut Scratch,
    ) -> Option<Refined> {
        let word = wanted.code.codewords.get(self.id as usize)?;
        let pattern = Pattern::bordered(wanted.code, *word, self.extra_border)?;
        refine_from((view, &self.corners, are_near), &pattern, camera, scratch)
    }
}

/// The marker with its corners between the pixels and its pose.
fn observe(
    view: GrayView<'_>,
    found: &Found,
    wanted: &Wanted,
    camera: Option<&CameraModel>,
    scratch: &mut Scratch,
) -> Observation {
    let refined = found.refined((view, false), wanted, camera, scratch);
    let refined = refined.unwrap_or_else(|| coarse(&found.corners, found.corner_px));
    observed(found, wanted, refined, camera)
}

fn observed(
    found: &Found,
    wanted: &Wanted,
    mut refined: Refined,
    camera: Option<&CameraModel>,
) -> Observation {
    if found.washed_out {
        let coarse = coarse(&found.corners, found.corner_px);
        refined.covariance_px2 += coarse.covariance_px2;
        refined.centre_covariance_px2 += coarse.centre_covariance_px2;
    }
    let corners = refined.corners;
    let named = wanted.markers.iter().find(|m| m.id == Some(found.id));
    let marker = named.or_else(|| wanted.markers.iter().find(|m| m.id.is_none()));
    let size_m = marker.and_then(|marker| marker.size_m);
    let pose = camera.zip(size_m).and_then(|(camera, size_m)| {
        square_pose(&corners, &refined.covariance_px2, size_m, camera)
    });
    Observation {
        family: wanted.code.family,
        id: Some(found.id),
        centre: refined.centre,
        centre_covariance_px2: refined.centre_covariance_px2,
        corners: Some(corners),
        wrong_bits: found.wrong_bits,
        size_px: diagonal_px(&corners),
        confidence: confidence(found.explained, found.margin),
        pose,
    }
}

/// Corners that could not be refined, and how good they are in pixels.
pub(crate) fn coarse(corners: &[Pixel; 4], corner_px: f64) -> Refined {
    let corner_px2 = corner_px * corner_px;
    Refined {
        corners: *corners,
        covariance_px2: SMatrix::identity() * corner_px2,
        centre: crossing(corners),
        centre_covariance_px2: Matrix2::identity() * (corner_px2 / 4.0),
        blur_px: 0.0,
        black: 0.0,
        white: 0.0,
        residual: 1.0,
    }
}

/// Where the diagonals of a quad cross: the image of the square's centre.
fn crossing(corners: &[Pixel; 4]) -> Pixel {
    let [a, b, c, d] = corners;
    let (ux, uy) = (c.x - a.x, c.y - a.y);
    let (vx, vy) = (d.x - b.x, d.y - b.y);
    let t = ((b.x - a.x) * vy - (b.y - a.y) * vx) / (ux * vy - uy * vx);
    Pixel::new(a.x + t * ux, a.y + t * uy)
}
