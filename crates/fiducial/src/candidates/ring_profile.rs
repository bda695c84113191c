//! Whether an ellipse, taken for one of the marker's circles, has the marker's bands about it.

use std::f64::consts::TAU;
use std::sync::LazyLock;

use imaging::pyramid::to_level_0;
use imaging::{Ellipse, GrayView, bilinear};

use crate::candidates::ellipses::Border;

/// Fewer grey levels are noise.
pub(crate) const LEAST_STEP: f64 = 6.0;
/// From band to band the dark one lacks at least this share of the bright one's light.
const LEAST_SHARE: f64 = 0.12;
/// Radii at which the bands are looked at, in marker sizes, and their widths; white and black in turn.
const BANDS: [(f64, f64); 7] =
    [(0.55, 0.1), (0.45, 0.1), (0.325, 0.15), (0.2, 0.1), (0.09, 0.12), (0.02, 0.02), (0.0, 0.02)];
/// A place in the white about the innermost ring that is close to it.
const NEAR_DOT: f64 = 0.055;
const RAYS: u32 = 32;
/// Of so many neighbouring bands that can be seen, this share must differ as they should.
pub(crate) const LEAST_SCORE: f64 = 0.55;
/// The same of white rings on black, for which any hole in something dark may be taken.
const LEAST_SCORE_OF_INVERTED: f64 = 0.8;
/// A marker of this diameter or less is so blurred that only its mean over all directions is looked at.
pub(crate) const SMALL_PX: f64 = 24.0;

/// A border taken for a circle of the marker.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Candidate {
    pub(crate) border: Border,
    /// The circle's radius in marker sizes.
    pub(crate) radius: f64,
    /// White rings on black.
    pub(crate) inverted: bool,
    /// How much of it looks as it should, from 0 to 1.
    pub(crate) score: f64,
    /// The share of the bright bands' light that the dark ones lack.
    pub(crate) contrast: f64,
}

impl Candidate {
    /// The marker's diameter in pixels along the minor axis.
    pub(crate) fn diameter_px(&self) -> f64 {
        self.border.ellipse.minor / (2.0 * self.radius)
    }
}

/// The circles that a border may be, with what lies about it looking like the marker.
pub(crate) fn candidates(view: GrayView<'_>, border: &Border, found: &mut Vec<Candidate>) {
    for (radius, dark_within) in
        [(0.5, true), (0.4, false), (0.25, true), (0.15, false), (0.03, true), (0.01, false)]
    {
        let inverted = dark_within != border.dark_within;
        let diameter_px = border.ellipse.minor / (2.0 * radius);
        // The inner rings of a small marker have no outlines.
        let blurred = diameter_px < SMALL_PX && (radius < 0.2 || !border.whole);
        if blurred || inverted && radius < 0.02 {
            continue;
        }
        let looks = if diameter_px < SMALL_PX { looks_small } else { looks };
        if let Some((score, contrast)) = looks(view, &border.ellipse, radius, inverted)
            && (!inverted || score > LEAST_SCORE_OF_INVERTED)
        {
            found.push(Candidate { border: *border, radius, inverted, score, contrast });
        }
    }
}

/// Compares the bands along rays.
fn looks(view: GrayView<'_>, ellipse: &Ellipse, radius: f64, inverted: bool) -> Option<(f64, f64)> {
    const FIRST: u32 = 8;
    let px_per_size = ellipse.minor / (2.0 * radius);
    let bands = BANDS.iter().take_while(|(_, width)| width * px_per_size > 1.6).count();
    let (mut seen, mut agree, mut share) = (0.0, 0.0, 0.0);
    let mut by_edge = [[0_u32; 2]; 6];
    let axes = ellipse.axes();
    for (i, ray) in (0..RAYS).zip(rays()) {
        if i == FIRST && agree < 0.35 * seen {
            return None;
        }
        let on = axes.at(*ray);
        let at = |band: f64| {
            let along = |axis: usize| {
                ellipse.centre[axis] + (on[axis] - ellipse.centre[axis]) * (band / radius)
            };
            bilinear(view, along(0), along(1))
        };
        let mut before = None;
        for (index, (band, _)) in BANDS.iter().take(bands).enumerate() {
            // So near that the dot can be told, the white about it is looked at near it.
            let here = at(if index == 4 && bands > 5 { NEAR_DOT } else { *band });
            if let (Some(a), Some(b)) = (before, here) {
                let (dark, bright): (f64, f64) =
                    if (index % 2 == 1) != inverted { (b, a) } else { (a, b) };
                seen += 1.0;
                let tally = &mut by_edge[index - 1];
                tally[0] += 1;
                if bright - dark > LEAST_STEP.max(LEAST_SHARE * bright) {
                    agree += 1.0;
                    share += (bright - dark) / bright;
                    tally[1] += 1;
                }
            }
            before = here;
        }
    }
    let edges = by_edge.iter().filter(|[seen, agree]| *seen >= 6 && 2 * agree >= *seen).count();
    // A ring of which the rest is covered has two good edges.
    let clear = by_edge.iter().filter(|[seen, agree]| *seen >= 28 && agree + 2 >= *seen).count();
    let score = agree / seen;
    (edges >= 2 && (score >= LEAST_SCORE || clear >= 2)).then_some((score, share / agree))
}

/// Sines and cosines of the rays' directions, in an order in which the first few are a fair sample.
fn rays() -> &'static [[f64; 2]; RAYS as usize] {
    static ALL: LazyLock<[[f64; 2]; RAYS as usize]> =
        LazyLock::new(|| directions(|index| index * 13));
    &ALL
}

/// Sines and cosines of directions all round, each as often as `order` says.
fn directions<const COUNT: usize>(order: impl Fn(usize) -> usize) -> [[f64; 2]; COUNT] {
    std::array::from_fn(|index| {
        let (sin, cos) = ((order(index) % COUNT) as f64 * TAU / COUNT as f64).sin_cos();
        [sin, cos]
    })
}

/// A marker so far away that only its paper is a region: looked for about the middle of a bright outline.
pub(crate) fn speck(view: GrayView<'_>, outline: &imaging::Outline<'_>) -> Option<Candidate> {
    // The paper's edge in marker sizes, as the marker is drawn.
    const PAPER: f64 = 1.2;
    // Both in steps that the pattern's rings tolerate.
    const STEP_PX: f64 = 0.5;
    const STEP: f64 = 1.07;
    const MOST_STEPS: usize = 6;
    let [left, top, right, bottom] = outline.bounds.map(f64::from);
    let (width, height) = (right - left, bottom - top);
    if outline.dark || outline.cut || width.max(height) > 2.0 * width.min(height) {
        return None;
    }
    let middle = |from: f64, to: f64| to_level_0((from + to) / 2.0 - 0.5, outline.level);
    let scale = to_level_0(1.0, outline.level) - to_level_0(0.0, outline.level);
    let mut place = [middle(left, right), middle(top, bottom)];
    let mut diameter_px = f64::from(outline.area).sqrt() * scale / PAPER;
    if !(5.0..SMALL_PX).contains(&diameter_px) {
        return None;
    }
    let pattern = |place: [f64; 2], diameter_px: f64| {
        let disc = Ellipse { centre: place, minor: diameter_px, major: diameter_px, angle: 0.0 };
        means(view, &disc, 0.5, false)
    };
    let worth = |m: &Means| m.ripple() + 0.5 * m.step().min(m.ripple().max(0.0));
    let first = pattern(place, diameter_px)?;
    // Most bright specks just grow darker outwards.
    if first.step() < 0.0 && first.gap < first.middle {
        return None;
    }
    let mut best = worth(&first);
    for step in 0..MOST_STEPS {
        let from = (place, diameter_px);
        // All neighbours at first, then those along one axis.
        let near = NEIGHBOURS.iter().take(if step == 0 { 26 } else { 6 });
        for [dx, dy, grow] in near {
            let next = [from.0[0] + f64::from(*dx) * STEP_PX, from.0[1] + f64::from(*dy) * STEP_PX];
            let grown = from.1 * f64::powi(STEP, *grow);
            if let Some(value) = pattern(next, grown).as_ref().map(worth)
                && value > best
            {
                (place, diameter_px, best) = (next, grown, value);
            }
        }
        if from == (place, diameter_px) {
            break;
        }
    }
    let ellipse = Ellipse { centre: place, minor: diameter_px, major: diameter_px, angle: 0.0 };
    let (score, contrast) = looks_small(view, &ellipse, 0.5, false)?;
    let border = Border { ellipse, dark_within: true, whole: true };
    Some(Candidate { border, radius: 0.5, inverted: false, score, contrast })
}

/// Steps to the neighbours of a place and a size, those along one axis first.
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
fn looks_small(
    view: GrayView<'_>,
    ellipse: &Ellipse,
    radius: f64,
    inverted: bool,
) -> Option<(f64, f64)> {
    let means = means(view, ellipse, radius, inverted)?;
    let (step, ripple) = (means.step(), means.ripple());
    if means.rim < LEAST_RIM || step < LEAST_STEP / 2.0 || ripple < 0.02 * step {
        return None;
    }
    Some(((0.6 + ripple / step).min(1.0), (step / means.paper.max(1.0)).min(1.0)))
}

/// Of so many directions the paper must be brighter than the outer ring.
const LEAST_RIM: u32 = 9;

/// Mean grey values of bands over all directions.
struct Means {
    paper: f64,
    outer: f64,
    gap: f64,
    middle: f64,
    /// Of 12 directions, in how many the paper is brighter than the outer ring.
    rim: u32,
}

impl Means {
    fn step(&self) -> f64 {
        self.paper - self.outer
    }

    fn ripple(&self) -> f64 {
        self.gap - (self.outer + self.middle) / 2.0
    }
}

fn means(view: GrayView<'_>, ellipse: &Ellipse, radius: f64, inverted: bool) -> Option<Means> {
    const RAYS: usize = 12;
    static ALL: LazyLock<[[f64; 2]; RAYS]> = LazyLock::new(|| directions(|index| index));
    let mut sums = [0.0; 4];
    let mut rim = 0;
    let axes = ellipse.axes();
    for ray in ALL.iter() {
        let on = axes.at(*ray);
        let mut values = [0.0; 4];
        for (value, band) in values.iter_mut().zip([0.57, 0.45, 0.325, 0.2]) {
            let along = |axis: usize| {
                ellipse.centre[axis] + (on[axis] - ellipse.centre[axis]) * (band / radius)
            };
            let sample = bilinear(view, along(0), along(1))?;
            *value = if inverted { 255.0 - sample } else { sample };
        }
        rim += u32::from(values[0] > values[1] + 2.0);
        for (sum, value) in sums.iter_mut().zip(values) {
            *sum += value / RAYS as f64;
        }
    }
    let [paper, outer, gap, middle] = sums;
    Some(Means { paper, outer, gap, middle, rim })
}
