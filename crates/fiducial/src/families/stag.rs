//! STag: a black square with a white disc in it, and 48 dots in the disc (Benligiray, Topal, Akinlar: "STag: A stable
//! fiducial marker system", Image and Vision Computing 89, 2019).
//!
//! Where a quad is large and plain to see, its dots are sampled one by one. Of others they are solved for together, and the
//! word that explains the pixels best is what the marker says. When outlines show nothing, quads of segments are sampled,
//! with dots left out that are hidden or washed out. Then the whole marker is compared with the image: its outline and the disc's edge where they are wide enough apart, the picture
//! as a whole where they are not.

use geometry::{CameraModel, Pixel};
use imaging::pyramid::from_level_0;
use imaging::{GrayView, Pyramid, bilinear};
use markers::{Codebook, Family, Marker, stag_code};

use crate::candidates::quad::{Quad, diagonal_px, middle, sides_px};
use crate::decode::cells::Grid;
use crate::families::square::{JOINED_PX, JOINED_SHARE, MOST_UNEVEN, coarse, covers, unevenness};
use crate::observation::{Observation, Stages};
use crate::pose::square_pose;
use crate::refine::corners::{Refined, Scratch, refine_design};
use crate::trace::{Reason, Trace};

use crate::decode::occluded_stag::Damaged;
use crate::decode::stag_cells::Dots;
use crate::decode::stag_samples::{Agreement, Sampled, sample};
use crate::refine::stag_design::Picture;

/// A quad is looked at on the level of the pyramid on which its sides are from this long to twice that, in pixels: at first
/// and, when it may be a marker, again.
const SIDE_PX: [f64; 2] = [12.0, 20.0];
/// Where that does not do, it is looked at again where its sides are from this long to twice that: the blur of a lens out of
/// focus is there what is expected of one in focus.
const UNSHARP_SIDE_PX: f64 = 8.0;
/// Shorter sides tell nothing.
const LEAST_SIDE_PX: f64 = 7.0;
/// Of families with more words than this, or of so many ids, not every word is tried.
const MOST_TRIED: usize = 40;
/// Bounds on the work in one image.
const MOST_LOOKS: usize = 400;
const MOST_FOUND: usize = 64;
/// Pictures that are kept.
const MOST_PICTURES: usize = 32;

/// Share of the variance of its pixels that a marker explains.
const LEAST_EXPLAINED: f64 = 0.8;
/// The second best word leaves so many times as much unexplained.
const LEAST_RATIO: f64 = 1.5;
/// With corners that are some tenths of a pixel off, these are less; with less than this there is no need to find better
/// corners.
const ROUGHLY_EXPLAINED: f64 = 0.6;
const ROUGH_RATIO: f64 = 1.25;

/// Before anything is solved for, quads from this size on, in pixels, must show the disc's white rim: this share of the
/// step from black to paper. Of 800 markers in light, shadow and glare all did half; of other quads a fifth do.
const RIM_PX: f64 = 10.0;
const LEAST_RIM: f64 = 0.35;

/// Markers from this size on, in pixels, are sampled dot by dot, on the level of the pyramid on which they are from this
/// wide to twice that.
const SAMPLED_PX: f64 = 28.0;
/// What must be there of a marker, and how well it must be explained, to need no more than samples.
const LEAST_INTACT_PLAIN: f32 = 0.95;
const LEAST_EXPLAINED_PLAIN: f32 = 0.85;
/// What a damaged one must explain of its dots' places.
const LEAST_EXPLAINED_DAMAGED: f32 = 0.7;
/// By how many bits a word must exceed chance: one by which a marker is known at once, and one of a damaged marker.
const LEAST_EVIDENCE_PLAIN: f32 = 20.0;
const LEAST_EVIDENCE: f32 = 14.0;

/// Finds STags among quads. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct Stags {
    wanted: Vec<Wanted>,
    dots: Dots,
    pictures: Vec<Picture>,
    scratch: Scratch,
    damaged: Damaged,
    places: Vec<[Pixel; 4]>,
    /// Whether markers printed white on black are looked for.
    inverted: bool,
}

/// One family that is looked for, and which of its ids.
#[derive(Debug)]
struct Wanted {
    book: &'static Codebook,
    markers: Vec<Marker>,
    /// The ids that are each compared with the image; none where there are too many.
    tried: Vec<u32>,
}

/// What a quad says.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Reading {
    wanted: usize,
    id: u32,
    turns: u8,
    wrong_bits: u8,
    pub(crate) explained: f64,
    /// What the second best leaves unexplained, over what this one does.
    ratio: f64,
    /// Whether a reflection moves its edges, so that the refined corners are hardly better.
    washed_out: bool,
}

impl Stags {
    /// Outlines up to this size are looked for in the image itself: the border of a marker, a tenth of its side, is too
    /// thin on the next level, and out of focus too bright.
    pub(crate) const LARGEST_PX: u16 = 88;

    /// Looks for these markers, white on black as well when `inverted`; those of other families are left out.
    pub(crate) fn new(markers: &[Marker], inverted: bool) -> Self {
        let mut stags = Self { inverted, ..Self::default() };
        for marker in markers {
            let Some(book) = stag_code::codebook(marker.family) else { continue };
            match stags.wanted.iter_mut().find(|w| w.markers[0].family == marker.family) {
                Some(known) => known.markers.push(*marker),
                None => {
                    let tried = Vec::new();
                    stags.wanted.push(Wanted { book, markers: vec![*marker], tried });
                }
            }
        }
        for wanted in &mut stags.wanted {
            wanted.tried = if wanted.markers.iter().any(|m| m.id.is_none()) {
                (0..wanted.book.codewords().len() as u32).collect()
            } else {
                wanted.markers.iter().filter_map(|m| m.id).collect()
            };
            if wanted.tried.len() > MOST_TRIED {
                wanted.tried.clear();
            }
        }
        stags
    }

    /// Makes the buffers as large as frames with texture need.
    pub(crate) fn make_room(&mut self) {
        if !self.is_empty() {
            self.places.clear();
            self.places.reserve(MOST_FOUND);
            self.scratch.make_room();
            self.damaged.make_room();
        }
    }

    /// True when there is nothing to look for.
    pub(crate) fn is_empty(&self) -> bool {
        self.wanted.is_empty()
    }

    /// Whether markers that were not found are to be looked for: `all` of them, or else those of any id of a family of which two
    /// were found.
    pub(crate) fn is_missing(&self, all: bool, found: &[Observation]) -> bool {
        self.wanted.iter().any(|wanted| {
            let known = || found.iter().filter(|o| o.family == wanted.markers[0].family);
            if wanted.markers.iter().any(|marker| marker.id.is_none()) {
                return all || known().nth(1).is_some();
            }
            all && wanted.markers.iter().any(|marker| known().all(|o| o.id != marker.id))
        })
    }

    /// Finds the markers among the quads of an image.
    pub(crate) fn detect<'a>(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        quads: impl Iterator<Item = &'a Quad>,
        camera: Option<&CameraModel>,
        (trace, stages): (&mut Trace, &mut impl Stages),
        found: &mut Vec<Observation>,
    ) {
        self.places.clear();
        let inverted = self.inverted;
        for quad in quads.filter(|quad| inverted || !quad.inverted).take(MOST_LOOKS) {
            if self.places.len() >= MOST_FOUND {
                break;
            }
            if self.places.iter().any(|place| is_same(place, &quad.corners)) {
                continue;
            }
            match self.read(view, pyramid, quad, camera) {
                Ok((reading, refined)) => {
                    trace.accept_quad(refined.corners);
                    self.places.push(refined.corners);
                    found.push(self.observe(&reading, &refined, camera));
                }
                Err(reason) => trace.refuse_quad(quad.corners, reason),
            }
        }
        stages.ended("stags");
    }

    /// Finds the marker of this family and id whose corners, its own top left first, should be about here.
    pub(crate) fn detect_at(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        (family, id, corners): (Family, u32, [Pixel; 4]),
        camera: Option<&CameraModel>,
    ) -> Option<Observation> {
        let quad = Quad { corners, inverted: false };
        let is_wanted = self.wanted.iter().any(|wanted| wanted.markers[0].family == family);
        if !is_wanted || unevenness(&quad, view, 0) > MOST_UNEVEN {
            return None;
        }
        let (reading, refined) = self.read(view, pyramid, &quad, camera).ok()?;
        let is_it =
            (self.wanted.get(reading.wanted)?.markers[0].family, reading.id) == (family, id);
        (is_it && reading.turns == 0).then(|| self.observe(&reading, &refined, camera))
    }

    /// Finds small markers by the outlines of their paper.
    pub(crate) fn detect_on_paper(
        &mut self,
        (view, pyramid, papers): (GrayView<'_>, &Pyramid, &[Quad]),
        camera: Option<&CameraModel>,
        trace: &mut Trace,
        found: &mut Vec<Observation>,
    ) {
        for paper in papers {
            let share = 1.0 / (1.0 + 2.0 * stag_code::QUIET_ZONE);
            let quad = Quad { inverted: false, ..paper.scaled(share) };
            if self.places.iter().any(|place| covers(place, &quad.corners)) {
                continue;
            }
            if let Ok((reading, refined)) = self.read(view, pyramid, &quad, camera) {
                trace.accept_quad(refined.corners);
                self.places.push(refined.corners);
                found.push(self.observe(&reading, &refined, camera));
            }
        }
    }

    /// Finds the markers that closed outlines do not show, as something hides a part of them; it takes several times as long
    /// as [`Stags::detect`].
    pub(crate) fn detect_damaged(
        &mut self,
        (view, pyramid, quads): (GrayView<'_>, &Pyramid, &[Quad]),
        camera: Option<&CameraModel>,
        (trace, stages): (&mut Trace, &mut impl Stages),
        found: &mut Vec<Observation>,
    ) {
        let mut damaged = std::mem::take(&mut self.damaged);
        let candidates = damaged.find(quads, |quad| {
            let is_taken = self.places.iter().any(|place| covers(place, &quad.corners));
            if is_taken || quad.inverted && !self.inverted {
                return None;
            }
            let reading = self.sampled((view, pyramid), quad, false)?;
            Some((reading, reading.explained * (1.0 - 1.0 / (1.0 + reading.ratio))))
        });
        for candidate in candidates {
            let (quad, reading) = (&candidate.quad, &candidate.reading);
            let refined = self.refined_damaged((view, pyramid), (quad, reading), camera);
            trace.accept_quad(refined.corners);
            found.push(self.observe(reading, &refined, camera));
        }
        self.damaged = damaged;
        stages.ended("damaged");
    }

    /// The corners of a damaged marker: refined where enough of its edges is seen, and still read as the same marker.
    fn refined_damaged(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        (quad, reading): (&Quad, &Reading),
        camera: Option<&CameraModel>,
    ) -> Refined {
        let mut corners = quad.corners;
        corners.rotate_left(usize::from(reading.turns) % 4);
        let corner_px = (JOINED_SHARE * corners[0].distance(&corners[2])).max(JOINED_PX);
        let coarse = coarse(&corners, corner_px);
        let Some(mut refined) = self.refined(view, (quad, reading), camera) else { return coarse };
        let better = Quad { corners: refined.corners, ..*quad };
        let again = self.sampled((view, pyramid), &better, false);
        if again.is_none_or(|again| (again.id, again.turns) != (reading.id, 0)) {
            return coarse;
        }
        if reading.washed_out {
            refined.covariance_px2 += coarse.covariance_px2;
            refined.centre_covariance_px2 += coarse.centre_covariance_px2;
        }
        refined
    }

    /// What a quad says, dot by dot: all of it where it is `plain` to see, or what is left of it.
    fn sampled(
        &self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        quad: &Quad,
        plain: bool,
    ) -> Option<Reading> {
        let (level, places) = on_level(&quad.corners, SAMPLED_PX, pyramid);
        let image = pyramid.level(view, level)?;
        let seen = sample(image, &places, quad.inverted)?;
        let is_whole = seen.known.count_ones() as usize == stag_code::DOTS;
        let is_plain = is_whole && seen.intact >= LEAST_INTACT_PLAIN && !seen.washed_out;
        let (explained, evidence) = if plain {
            (LEAST_EXPLAINED_PLAIN, LEAST_EVIDENCE_PLAIN)
        } else {
            (LEAST_EXPLAINED_DAMAGED, LEAST_EVIDENCE)
        };
        if seen.explained < explained || plain && !is_plain {
            return None;
        }
        let read = |(index, wanted): (usize, &Wanted)| {
            let agreement = wanted.agreement(&seen).filter(|a| a.evidence >= evidence)?;
            Some(Reading {
                wanted: index,
                id: agreement.id,
                turns: agreement.turns,
                wrong_bits: agreement.wrong_bits,
                explained: f64::from(seen.explained * seen.intact),
                ratio: f64::from(agreement.evidence / 8.0).max(LEAST_RATIO),
                washed_out: seen.washed_out,
            })
        };
        let all = self.wanted.iter().enumerate().filter_map(read);
        all.max_by(|a, b| a.ratio.total_cmp(&b.ratio))
    }

    /// The marker that a quad is, with its corners between the pixels.
    fn read(
        &mut self,
        view: GrayView<'_>,
        pyramid: &Pyramid,
        quad: &Quad,
        camera: Option<&CameraModel>,
    ) -> Result<(Reading, Refined), Reason> {
        let side_px = shortest_side_px(&quad.corners);
        if side_px < LEAST_SIDE_PX {
            return Err(Reason::Small);
        }
        if side_px >= RIM_PX && !has_rim((view, pyramid), quad) {
            return Err(Reason::Blackness);
        }
        if side_px >= SAMPLED_PX
            && let Some(reading) = self.sampled((view, pyramid), quad, true)
            && let Some(refined) = self.refined(view, (quad, &reading), camera)
        {
            return Ok((reading, refined));
        }
        let first = self.look((view, pyramid), quad, SIDE_PX[0])?;
        if first.explained < ROUGHLY_EXPLAINED || first.ratio < ROUGH_RATIO {
            return Err(Reason::Code);
        }
        // A wrong word has an outline too: with better corners, the right one explains more.
        let refined = self.refined(view, (quad, &first), camera).ok_or(Reason::Edges)?;
        let mut better = Quad { corners: refined.corners, ..*quad };
        better.corners.rotate_right(usize::from(first.turns) % 4);
        let second = self.look((view, pyramid), &better, SIDE_PX[1])?;
        let second = if is_believed(&second) {
            second
        } else {
            let unsharp = self.look((view, pyramid), &better, UNSHARP_SIDE_PX)?;
            if !is_believed(&unsharp) {
                return Err(Reason::Confidence);
            }
            unsharp
        };
        if (second.wanted, second.id, second.turns) == (first.wanted, first.id, first.turns) {
            return Ok((second, refined));
        }
        let refined = self.refined(view, (&better, &second), camera).ok_or(Reason::Edges)?;
        Ok((second, refined))
    }

    fn refined(
        &mut self,
        view: GrayView<'_>,
        (quad, reading): (&Quad, &Reading),
        camera: Option<&CameraModel>,
    ) -> Option<Refined> {
        let mut corners = quad.corners;
        corners.rotate_left(usize::from(reading.turns) % 4);
        let family = self.wanted.get(reading.wanted)?.markers[0].family;
        let is_it = |picture: &Picture| (picture.family, picture.id) == (family, reading.id);
        if !self.pictures.iter().any(is_it) {
            if self.pictures.len() >= MOST_PICTURES {
                self.pictures.remove(0);
            }
            self.pictures.push(Picture::new(family, reading.id)?);
        }
        let picture = self.pictures.iter().find(|picture| is_it(picture))?;
        let design = picture.design(shortest_side_px(&corners), quad.inverted);
        refine_design(view, &corners, &design, camera, &mut self.scratch)
    }

    /// The word that explains a square best.
    fn look(
        &mut self,
        (view, pyramid): (GrayView<'_>, &Pyramid),
        quad: &Quad,
        side_px: f64,
    ) -> Result<Reading, Reason> {
        let (level, places) = on_level(&quad.corners, side_px, pyramid);
        let image = pyramid.level(view, level).ok_or(Reason::Small)?;
        if !self.dots.look(image, &places) {
            return Err(Reason::Small);
        }
        let word = if self.dots.solve() { self.dots.word() } else { return Err(Reason::Code) };
        let mut best: Option<Reading> = None;
        for (index, wanted) in self.wanted.iter().enumerate() {
            let reading = wanted.best(index, word, (&self.dots, quad.inverted));
            let is_better =
                |reading: &Reading| best.is_none_or(|best| best.explained < reading.explained);
            best = reading.filter(is_better).or(best);
        }
        best.ok_or(Reason::Code)
    }

    fn observe(
        &self,
        reading: &Reading,
        refined: &Refined,
        camera: Option<&CameraModel>,
    ) -> Observation {
        let markers = &self.wanted[reading.wanted].markers;
        let named = markers.iter().find(|m| m.id == Some(reading.id));
        let marker = named.or_else(|| markers.iter().find(|m| m.id.is_none()));
        let corners = refined.corners;
        let size_m = marker.and_then(|marker| marker.size_m);
        let pose = camera.zip(size_m).and_then(|(camera, size_m)| {
            square_pose(&corners, &refined.covariance_px2, size_m, camera)
        });
        Observation {
            family: markers[0].family,
            id: Some(reading.id),
            centre: refined.centre,
            centre_covariance_px2: refined.centre_covariance_px2,
            corners: Some(corners),
            wrong_bits: reading.wrong_bits,
            size_px: diagonal_px(&corners),
            confidence: reading.explained * (1.0 - 0.5 / reading.ratio),
            pose,
        }
    }
}

impl Wanted {
    /// The wanted word that explains a picture best, given the word that its dots are nearest to.
    fn best(&self, index: usize, word: u64, (dots, inverted): (&Dots, bool)) -> Option<Reading> {
        let reading = |id: u32, turns: u8| {
            // The word as it stands in the picture.
            let seen = (0..(4 - turns) % 4)
                .fold(*self.book.codewords().get(id as usize)?, |word, _| self.book.rotated(word));
            let explanation = dots.explain(seen);
            let [black, white] = explanation.levels;
            ((white > black) != inverted).then(|| Reading {
                wanted: index,
                id,
                turns,
                wrong_bits: (seen ^ word).count_ones() as u8,
                explained: explanation.explained,
                ratio: 1.0,
                washed_out: false,
            })
        };
        if self.tried.is_empty() {
            let found = self.book.nearest(word, self.most_wrong())?;
            let is_wanted = self.markers.iter().any(|m| m.id.is_none_or(|id| id == found.id));
            let reading = reading(found.id, found.rotation).filter(|_| is_wanted)?;
            return Some(Reading { ratio: 2.0 * LEAST_RATIO, ..reading });
        }
        let mut best: Option<Reading> = None;
        let mut second = 0.0_f64;
        for found in self.tried.iter().flat_map(|id| (0..4).filter_map(|turns| reading(*id, turns)))
        {
            match best {
                Some(best) if best.explained >= found.explained => {
                    second = second.max(found.explained);
                }
                _ => {
                    second = best.map_or(0.0, |best| best.explained);
                    best = Some(found);
                }
            }
        }
        best.map(|best| Reading {
            ratio: (1.0 - second) / (1.0 - best.explained).max(1e-6),
            ..best
        })
    }

    /// The wanted word that agrees best with dots that were sampled.
    fn agreement(&self, seen: &Sampled) -> Option<Agreement> {
        let distance = self.distance();
        if self.markers.iter().any(|m| m.id.is_none()) {
            return seen.agreement(self.book, 0..self.book.codewords().len() as u32, distance);
        }
        seen.agreement(self.book, self.markers.iter().filter_map(|m| m.id), distance)
    }

    /// How many dots the words of the family differ in at least, however they are turned.
    fn distance(&self) -> u32 {
        match self.markers[0].family {
            Family::StagHd11 => 11,
            Family::StagHd13 => 13,
            Family::StagHd15 => 15,
            Family::StagHd17 => 17,
            Family::StagHd19 => 19,
            Family::StagHd21 => 21,
            _ => 23,
        }
    }

    /// How many wrong bits are mended, so that a random word hardly ever becomes one of the family's.
    fn most_wrong(&self) -> u8 {
        match self.markers[0].family {
            Family::StagHd11 => 4,
            Family::StagHd13 => 5,
            Family::StagHd15 => 6,
            _ => 7,
        }
    }
}

/// Whether a word explains enough, and more than the others.
fn is_believed(reading: &Reading) -> bool {
    reading.explained >= LEAST_EXPLAINED && reading.ratio >= LEAST_RATIO
}

/// Whether there is more light about a quad's middle than in its corners, as on an STag's disc.
fn has_rim((view, pyramid): (GrayView<'_>, &Pyramid), quad: &Quad) -> bool {
    // Tenths of the square: in the corners, beside the sides, and on the rim, about the middle.
    const CORNERS: [[f64; 2]; 4] = [[0.9, 0.9], [9.1, 0.9], [9.1, 9.1], [0.9, 9.1]];
    const PAPER: [[f64; 2]; 4] = [[5.0, -0.8], [10.8, 5.0], [5.0, 10.8], [-0.8, 5.0]];
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
    let (level, places) = on_level(&quad.corners, SIDE_PX[0], pyramid);
    let Some((image, grid)) = pyramid.level(view, level).zip(Grid::new(&places, 10)) else {
        return false;
    };
    let mean = |places: &[[f64; 2]]| {
        let seen = places.iter().filter_map(|place| {
            let [x, y] = grid.pixel(*place);
            bilinear(image, x, y)
        });
        let [sum, count] = seen.fold([0.0, 0.0], |[s, n], grey| [s + grey, n + 1.0]);
        sum / count
    };
    let [black, paper, rim] = [mean(&CORNERS), mean(&PAPER), mean(&RIM)];
    // What the frame cuts away says nothing.
    let share = (rim - black) / (paper - black);
    !share.is_finite() || share > LEAST_RIM
}

/// The level of the pyramid on which a square's shortest side is from so long to twice that, and its corners there.
fn on_level(corners: &[Pixel; 4], side_px: f64, pyramid: &Pyramid) -> (usize, [[f64; 2]; 4]) {
    let level = ((shortest_side_px(corners) / side_px).log2().floor().max(0.0) as usize)
        .min(pyramid.levels().saturating_sub(1));
    (level, corners.map(|c| [from_level_0(c.x, level), from_level_0(c.y, level)]))
}

fn shortest_side_px(corners: &[Pixel; 4]) -> f64 {
    sides_px(corners).into_iter().fold(f64::INFINITY, f64::min)
}

/// Whether two quads are of the same square.
fn is_same(a: &[Pixel; 4], b: &[Pixel; 4]) -> bool {
    middle(a).distance(&middle(b)) < 0.25 * a[0].distance(&a[2])
}
