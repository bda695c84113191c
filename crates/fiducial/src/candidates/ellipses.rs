//! Finds ellipses among the outlines of regions, complete or in arcs: circles seen at an angle.

use std::f64::consts::TAU;

use imaging::pyramid::to_level_0;
use imaging::{Ellipse, Outline, fit_ellipse};

/// An ellipse along which dark meets bright, in pixels of the image.
#[derive(Copy, Clone, Debug)]
pub(crate) struct EllipseCandidate {
    pub(crate) ellipse: Ellipse,
    pub(crate) dark_inside: bool,
    /// Whether it was seen all round.
    pub(crate) complete: bool,
}

/// Points used in one fit.
const FIT_POINTS: usize = 32;
/// Minimum ratio of the axes: a circle seen at 72 degrees.
const MIN_AXIS_RATIO: f64 = 0.3;
/// Shorter outlines do not determine an arc's ellipse.
const MIN_ARC_POINTS: usize = 28;
/// Minimum number of the 32 sectors of an ellipse that an arc covers; less than a quarter fits many ellipses.
const MIN_SECTORS: u32 = 8;

/// The ellipse that a closed outline is.
pub(crate) fn complete_ellipse(outline: &Outline<'_>) -> Option<EllipseCandidate> {
    let [left, top, right, bottom] = outline.bounds.map(f64::from);
    let (width, height) = (right - left, bottom - top);
    let fill = f64::from(outline.area) / (width * height);
    let around = outline.points.len() as f64 / (2.0 * (width + height));
    // Cheap checks first: an ellipse fills 0.79 of its bounds, less when oblique.
    let flat = width.max(height) > 3.3 * width.min(height);
    if outline.cut || flat || !(0.45..0.93).contains(&fill) || around > 1.3 {
        return None;
    }
    let step = 1 + outline.points.len() / FIT_POINTS;
    let points = outline.points.iter().step_by(step).map(|p| p.map(f64::from));
    let ellipse = fit_ellipse(points.clone())?;
    let count = points.clone().count() as f64;
    let axes = ellipse.axes();
    let squares: f64 =
        points.map(|p| ((axes.radius_of(p) - 1.0) * ellipse.minor / 2.0).powi(2)).sum();
    let tolerance = 0.35 + 0.012 * ellipse.minor;
    let fits = squares <= tolerance * tolerance * count
        && ellipse.minor > MIN_AXIS_RATIO * ellipse.major
        && ellipse.minor > 2.0;
    let dark_inside = outline.dark;
    fits.then(|| in_image(&ellipse, outline.level)).map(|ellipse| EllipseCandidate {
        ellipse,
        dark_inside,
        complete: true,
    })
}

/// Adds the ellipses of which an outline shows arcs: the image's edge cuts a ring, something covers it, or it
/// merges with something dark. `size` is that of the outline's level. Each fit takes one from `budget`.
pub(crate) fn add_arc_ellipses(
    outline: &Outline<'_>,
    size: [usize; 2],
    budget: &mut usize,
    found: &mut Vec<EllipseCandidate>,
) {
    let points = outline.points;
    if points.len() < MIN_ARC_POINTS {
        return;
    }
    let mut arcs = Arcs { outline, found: [None; MAX_ARCS] };
    if !outline.cut {
        arcs.search(0, points.len(), true, budget);
    } else {
        let limits = size.map(|edge| edge as f32 - 1.6);
        let ends = |[x, y]: &[f32; 2]| *x < 0.6 || *y < 0.6 || *x > limits[0] || *y > limits[1];
        let Some(first) = points.iter().position(ends) else { return };
        let mut start = 0;
        // Once round, from one end at the image's edge to the next.
        while start < points.len() {
            let onwards = points.iter().cycle().skip(first + start + 1);
            let length = onwards.take(points.len()).take_while(|p| !ends(p)).count();
            arcs.search(first + start + 1, length, false, budget);
            start += length + 1;
        }
    }
    for (ellipse, dark_inside) in arcs.found.into_iter().flatten() {
        let ellipse = in_image(&ellipse, outline.level);
        found.push(EllipseCandidate { ellipse, dark_inside, complete: false });
    }
}

/// Maximum number of arcs of one outline.
const MAX_ARCS: usize = 4;

struct Arcs<'a> {
    outline: &'a Outline<'a>,
    /// Ellipses in pixels of the level, and whether they are dark inside.
    found: [Option<(Ellipse, bool)>; MAX_ARCS],
}

impl Arcs<'_> {
    fn at(&self, index: usize) -> [f64; 2] {
        let points = self.outline.points;
        points.get(index % points.len()).map_or([0.0; 2], |p| p.map(f64::from))
    }

    /// Tries long parts of a run of points, then shorter ones.
    fn search(&mut self, start: usize, length: usize, closed: bool, budget: &mut usize) {
        let parts: &[f64] = if closed { &[0.45, 0.27] } else { &[1.0, 0.5, 0.28] };
        for part in parts {
            let window = (length as f64 * part) as usize;
            if window < MIN_ARC_POINTS {
                return;
            }
            let last = if closed { length } else { length - window + 1 };
            for offset in (0..last).step_by(window.div_ceil(2)) {
                if *budget == 0 {
                    return;
                }
                self.try_part(start + offset, window, budget);
            }
        }
    }

    fn try_part(&mut self, start: usize, length: usize, budget: &mut usize) {
        let Some(slot) = self.found.iter().position(Option::is_none) else { return };
        let ends = [start, start + length / 2, start + length - 1].map(|i| self.at(i));
        let is_known = |(ellipse, _): &(Ellipse, bool)| {
            ends.iter().all(|p| distance_px(ellipse, *p).abs() < 1.5)
        };
        if self.found.iter().flatten().any(is_known) {
            return;
        }
        let Some(region_inside) = self.bend(start, length) else { return };
        *budget -= 1;
        let arc = (0..length).step_by(1 + length / FIT_POINTS).map(|i| self.at(start + i));
        let Some(rough) = fit_ellipse(arc.clone()).filter(is_plausible) else { return };
        let count = arc.clone().count() as f64;
        let squares: f64 = arc.map(|p| distance_px(&rough, p).powi(2)).sum();
        if squares > 0.5 * count {
            return;
        }
        // Refit with every point of the outline that lies on it.
        let is_near = |p: &[f64; 2]| distance_px(&rough, *p).abs() < 1.0;
        let total = self.outline.points.len();
        let all = (0..total).step_by(1 + total / 160).map(|i| self.at(i)).filter(is_near);
        let Some(ellipse) = fit_ellipse(all.clone()).filter(is_plausible) else { return };
        let sectors = all.fold(0_u32, |seen, p| seen | 1 << sector(&ellipse, p));
        if sectors.count_ones() >= MIN_SECTORS {
            self.found[slot] = Some((ellipse, region_inside == self.outline.dark));
        }
    }

    /// Whether the region lies inside the bend of a part of the outline; `None` when the part does not turn
    /// steadily in one direction.
    fn bend(&self, start: usize, length: usize) -> Option<bool> {
        const CHORDS: usize = 6;
        let place = |i: usize| self.at(start + i * (length - 1) / CHORDS);
        let chord = |i: usize| {
            let (a, b) = (place(i), place(i + 1));
            [b[0] - a[0], b[1] - a[1]]
        };
        let mut signs = 0;
        for i in 0..CHORDS - 1 {
            let (a, b) = (chord(i), chord(i + 1));
            let (cross, dot) = (a[0] * b[1] - a[1] * b[0], a[0] * b[0] + a[1] * b[1]);
            // Corners turn too much at once, straight lines not at all.
            if dot <= 0.0 || cross.abs() < 0.03 * dot {
                return None;
            }
            signs += if cross > 0.0 { 1 } else { -1 };
        }
        // Regions lie to the right of their outlines; y points down.
        (signs == 5 || signs == -5).then_some(signs > 0)
    }
}

fn is_plausible(ellipse: &Ellipse) -> bool {
    ellipse.minor > 9.0
        && ellipse.minor > MIN_AXIS_RATIO * ellipse.major
        && ellipse.major < 20_000.0
}

/// Approximate distance of a point from an ellipse in pixels; positive outside.
fn distance_px(ellipse: &Ellipse, point: [f64; 2]) -> f64 {
    (ellipse.radius_of(point) - 1.0) * ellipse.minor / 2.0
}

/// Which of the 32 sectors of an ellipse a point lies in.
fn sector(ellipse: &Ellipse, point: [f64; 2]) -> u32 {
    let (dx, dy) = (point[0] - ellipse.centre[0], point[1] - ellipse.centre[1]);
    let turn = (dy.atan2(dx) / TAU + 0.5) * 32.0;
    (turn as u32).min(31)
}

fn in_image(ellipse: &Ellipse, level: usize) -> Ellipse {
    let scale = to_level_0(1.0, level) - to_level_0(0.0, level);
    Ellipse {
        centre: ellipse.centre.map(|c| to_level_0(c, level)),
        minor: ellipse.minor * scale,
        major: ellipse.major * scale,
        angle: ellipse.angle,
    }
}
