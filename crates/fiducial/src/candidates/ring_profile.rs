//! Tests the radial profile: whether an ellipse, taken for one of the marker's circles, has the marker's bands
//! around it.

use std::f64::consts::TAU;
use std::sync::LazyLock;

use imaging::pyramid::to_level_0;
use imaging::{Ellipse, GrayView, Outline, bilinear};

use crate::candidates::ellipses::EllipseCandidate;

/// Smaller differences between bands, in grey levels, are noise.
pub(crate) const MIN_STEP: f64 = 6.0;
/// Minimum contrast between neighbouring bands, as a fraction of the brighter one.
const MIN_STEP_RATIO: f64 = 0.12;
/// Radii at which the bands are sampled and their widths, in marker sizes, from outside; white and black in
/// turn.
const BANDS: [(f64, f64); 7] =
    [(0.55, 0.1), (0.45, 0.1), (0.325, 0.15), (0.2, 0.1), (0.09, 0.12), (0.02, 0.02), (0.0, 0.02)];
/// Radius at which the white around the dot is sampled where the dot is large enough to be seen.
const NEAR_DOT: f64 = 0.055;
const RAYS: u32 = 32;
/// Minimum fraction of neighbouring bands that differ as in the marker.
pub(crate) const MIN_SCORE: f64 = 0.55;
/// The same for white rings on black, which any hole in something dark resembles.
const MIN_WHITE_ON_BLACK_SCORE: f64 = 0.8;
/// Up to this diameter in pixels the blur leaves only the mean over all directions.
pub(crate) const SMALL_PX: f64 = 24.0;

/// An ellipse taken for a circle of the marker.
#[derive(Copy, Clone, Debug)]
pub(crate) struct RingCandidate {
    pub(crate) border: EllipseCandidate,
    /// The circle's radius in marker sizes.
    pub(crate) radius: f64,
    pub(crate) white_on_black: bool,
    /// The fraction of the profile that is as it should be, from 0 to 1.
    pub(crate) score: f64,
    /// Mean contrast of the bands, as a fraction of the brighter one.
    pub(crate) contrast: f64,
}

impl RingCandidate {
    /// The marker's diameter in pixels along the minor axis.
    pub(crate) fn diameter_px(&self) -> f64 {
        self.border.ellipse.minor / (2.0 * self.radius)
    }
}

/// How well a profile matches.
struct Match {
    score: f64,
    contrast: f64,
}

/// Adds the circles of the marker that an ellipse may be, by the profile around it.
pub(crate) fn add_ring_candidates(
    view: GrayView<'_>,
    border: &EllipseCandidate,
    found: &mut Vec<RingCandidate>,
) {
    for (radius, dark_inside) in
        [(0.5, true), (0.4, false), (0.25, true), (0.15, false), (0.03, true), (0.01, false)]
    {
        let white_on_black = dark_inside != border.dark_inside;
        let diameter_px = border.ellipse.minor / (2.0 * radius);
        // The inner rings of a small marker have no outlines.
        let is_blurred = diameter_px < SMALL_PX && (radius < 0.2 || !border.complete);
        if is_blurred || white_on_black && radius < 0.02 {
            continue;
        }
        let matching = if diameter_px < SMALL_PX { match_means } else { match_rays };
        if let Some(Match { score, contrast }) =
            matching(view, &border.ellipse, radius, white_on_black)
            && (!white_on_black || score > MIN_WHITE_ON_BLACK_SCORE)
        {
            found.push(RingCandidate { border: *border, radius, white_on_black, score, contrast });
        }
    }
}

/// The grey value on a ray through a point `on` the ellipse, at this fraction of the distance.
#[inline]
fn sample(view: GrayView<'_>, centre: [f64; 2], on: [f64; 2], share: f64) -> Option<f64> {
    let along = |axis: usize| centre[axis] + (on[axis] - centre[axis]) * share;
    bilinear(view, along(0), along(1))
}

/// Compares neighbouring bands along rays.
fn match_rays(
    view: GrayView<'_>,
    ellipse: &Ellipse,
    radius: f64,
    white_on_black: bool,
) -> Option<Match> {
    const FIRST: u32 = 8;
    let px_per_size = ellipse.minor / (2.0 * radius);
    let bands = BANDS.iter().take_while(|(_, width)| width * px_per_size > 1.6).count();
    let (mut seen, mut agree, mut contrast) = (0.0, 0.0, 0.0);
    let mut by_edge = [[0_u32; 2]; 6];
    let axes = ellipse.axes();
    for (i, ray) in (0..RAYS).zip(rays()) {
        // Even if all that is left agreed, there may be too little of it.
        let left = |rays: u32| f64::from(rays.saturating_sub(i)) * bands.saturating_sub(1) as f64;
        if i <= FIRST && agree + left(FIRST) < 0.35 * (seen + left(FIRST)) {
            return None;
        }
        if i >= FIRST {
            let best = (agree + left(RAYS)) / (seen + left(RAYS));
            let edges = || by_edge.iter().take(bands.saturating_sub(1));
            let may_match = match white_on_black {
                true => best > MIN_WHITE_ON_BLACK_SCORE,
                false => {
                    let may_be_clear = |[seen, agree]: &&[u32; 2]| agree + 2 >= *seen;
                    best >= MIN_SCORE || edges().filter(may_be_clear).count() >= 2
                }
            };
            if !may_match {
                return None;
            }
        }
        let on = axes.at(*ray);
        let mut before = None;
        for (index, (band, _)) in BANDS.iter().take(bands).enumerate() {
            let band = if index == 4 && bands > 5 { NEAR_DOT } else { *band };
            let here = sample(view, ellipse.centre, on, band / radius);
            if let (Some(a), Some(b)) = (before, here) {
                let (dark, bright): (f64, f64) =
                    if (index % 2 == 1) != white_on_black { (b, a) } else { (a, b) };
                seen += 1.0;
                let tally = &mut by_edge[index - 1];
                tally[0] += 1;
                if bright - dark > MIN_STEP.max(MIN_STEP_RATIO * bright) {
                    agree += 1.0;
                    contrast += (bright - dark) / bright;
                    tally[1] += 1;
                }
            }
            before = here;
        }
    }
    let edges = by_edge.iter().filter(|[seen, agree]| *seen >= 6 && 2 * agree >= *seen).count();
    // A single ring, with the others covered, has two clear edges.
    let clear = by_edge.iter().filter(|[seen, agree]| *seen >= 28 && agree + 2 >= *seen).count();
    let score = agree / seen;
    let matches = edges >= 2 && (score >= MIN_SCORE || clear >= 2);
    matches.then_some(Match { score, contrast: contrast / agree })
}

/// Sines and cosines of the rays' directions, ordered so that the first few are a fair sample.
fn rays() -> &'static [[f64; 2]; RAYS as usize] {
    static ALL: LazyLock<[[f64; 2]; RAYS as usize]> =
        LazyLock::new(|| directions(|index| index * 13));
    &ALL
}

/// Sines and cosines of `COUNT` directions all round, in this order.
fn directions<const COUNT: usize>(order: impl Fn(usize) -> usize) -> [[f64; 2]; COUNT] {
    std::array::from_fn(|index| {
        let (sin, cos) = ((order(index) % COUNT) as f64 * TAU / COUNT as f64).sin_cos();
        [sin, cos]
    })
}

/// A marker so far away that only its paper is a region: a blob. Its centre and size are searched about the
/// middle of a bright outline.
pub(crate) fn blob(view: GrayView<'_>, outline: &Outline<'_>) -> Option<RingCandidate> {
    // The paper's edge in marker sizes, as the marker is drawn.
    const PAPER: f64 = 1.2;
    // A tone curve makes paper larger, and the search for the size smaller again.
    const MAX_BLOB_PX: f64 = 1.25 * SMALL_PX;
    // Step sizes that the profile tolerates.
    const STEP_PX: f64 = 0.5;
    const STEP_RATIO: f64 = 1.07;
    const MAX_STEPS: usize = 6;
    let [left, top, right, bottom] = outline.bounds.map(f64::from);
    let (width, height) = (right - left, bottom - top);
    if outline.dark || outline.cut || width.max(height) > 2.0 * width.min(height) {
        return None;
    }
    let middle = |from: f64, to: f64| to_level_0((from + to) / 2.0 - 0.5, outline.level);
    let scale = to_level_0(1.0, outline.level) - to_level_0(0.0, outline.level);
    let mut centre = [middle(left, right), middle(top, bottom)];
    let mut diameter_px = f64::from(outline.area).sqrt() * scale / PAPER;
    if !(5.0..MAX_BLOB_PX).contains(&diameter_px) {
        return None;
    }
    let means_at =
        |centre: [f64; 2], diameter_px: f64| means(view, &disc(centre, diameter_px), 0.5, false);
    let score = |m: &BandMeans| m.ripple() + 0.5 * m.step().min(m.ripple().max(0.0));
    let first = means_at(centre, diameter_px)?;
    // Most bright blobs just darken outwards.
    if first.step() < 0.0 && first.gap < first.middle {
        return None;
    }
    let mut best = score(&first);
    for step in 0..MAX_STEPS {
        let from = (centre, diameter_px);
        // All neighbours at first, then those along one axis.
        let near = NEIGHBOURS.iter().take(if step == 0 { 26 } else { 6 });
        for [dx, dy, grow] in near {
            let next = [from.0[0] + f64::from(*dx) * STEP_PX, from.0[1] + f64::from(*dy) * STEP_PX];
            let grown = from.1 * f64::powi(STEP_RATIO, *grow);
            if let Some(value) = means_at(next, grown).as_ref().map(score)
                && value > best
            {
                (centre, diameter_px, best) = (next, grown, value);
            }
        }
        if from == (centre, diameter_px) {
            break;
        }
    }
    let ellipse = disc(centre, diameter_px);
    let Match { score, contrast } = match_means(view, &ellipse, 0.5, false)?;
    let border = EllipseCandidate { ellipse, dark_inside: true, complete: true };
    Some(RingCandidate { border, radius: 0.5, white_on_black: false, score, contrast })
}

fn disc(centre: [f64; 2], diameter_px: f64) -> Ellipse {
    Ellipse { centre, minor: diameter_px, major: diameter_px, angle: 0.0 }
}

/// Steps of place and size to all neighbours, those along one axis first.
const NEIGHBOURS: [[i32; 3]; 26] = neighbours();

const fn neighbours() -> [[i32; 3]; 26] {
    let mut all = [[0; 3]; 26];
    let mut count = 0;
    let mut axes = 1;
    while axes <= 3 {
        let mut i = 0;
        while i < 27 {
            let step = [i % 3 - 1, i / 3 % 3 - 1, i / 9 - 1];
            if step[0] * step[0] + step[1] * step[1] + step[2] * step[2] == axes {
                all[count] = step;
                count += 1;
            }
            i += 1;
        }
        axes += 1;
    }
    all
}

/// Compares the bands' means of a blurred marker.
fn match_means(
    view: GrayView<'_>,
    ellipse: &Ellipse,
    radius: f64,
    white_on_black: bool,
) -> Option<Match> {
    let means = means(view, ellipse, radius, white_on_black)?;
    let (step, ripple) = (means.step(), means.ripple());
    if means.rim < MIN_RIM || step < MIN_STEP / 2.0 || ripple < 0.02 * step {
        return None;
    }
    let contrast = (step / means.paper.max(1.0)).min(1.0);
    Some(Match { score: (0.6 + ripple / step).min(1.0), contrast })
}

/// Minimum number of the 12 directions in which the paper is brighter than the outer ring.
const MIN_RIM: u32 = 9;

/// Mean grey values of bands over 12 directions.
struct BandMeans {
    paper: f64,
    outer: f64,
    gap: f64,
    middle: f64,
    /// Number of directions in which the paper is brighter than the outer ring.
    rim: u32,
}

impl BandMeans {
    fn step(&self) -> f64 {
        self.paper - self.outer
    }

    fn ripple(&self) -> f64 {
        self.gap - (self.outer + self.middle) / 2.0
    }
}

fn means(
    view: GrayView<'_>,
    ellipse: &Ellipse,
    radius: f64,
    white_on_black: bool,
) -> Option<BandMeans> {
    const RAYS: usize = 12;
    static ALL: LazyLock<[[f64; 2]; RAYS]> = LazyLock::new(|| directions(|index| index));
    let mut sums = [0.0; 4];
    let mut rim = 0;
    let axes = ellipse.axes();
    for ray in ALL.iter() {
        let on = axes.at(*ray);
        let mut values = [0.0; 4];
        for (value, band) in values.iter_mut().zip([0.57, 0.45, 0.325, 0.2]) {
            let grey = sample(view, ellipse.centre, on, band / radius)?;
            *value = if white_on_black { 255.0 - grey } else { grey };
        }
        rim += u32::from(values[0] > values[1] + 2.0);
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += value / RAYS as f64;
        }
    }
    let [paper, outer, gap, middle] = sums;
    Some(BandMeans { paper, outer, gap, middle, rim })
}
