//! Which outlines of regions are circles seen aslant, whole or in part.

use std::f64::consts::TAU;

use imaging::pyramid::to_level_0;
use imaging::{Ellipse, fit_ellipse};

/// An ellipse along which dark meets bright, in pixels of the image.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Border {
    pub(crate) ellipse: Ellipse,
    pub(crate) dark_within: bool,
    /// Whether it was seen all round.
    pub(crate) whole: bool,
}

/// Points that take part in a fit.
const FIT_POINTS: usize = 32;
/// Ellipses that are flatter are circles seen from 72 degrees aside.
const LEAST_FLATNESS: f64 = 0.3;
/// Shorter outlines show no arc that says which ellipse it belongs to.
const LEAST_ARC_POINTS: usize = 28;
/// An arc of less than a quarter of an ellipse may belong to many.
const LEAST_SECTORS: u32 = 8;

/// The ellipse that an outline is.
pub(crate) fn whole_border(outline: &imaging::Outline<'_>) -> Option<Border> {
    let [left, top, right, bottom] = outline.bounds.map(f64::from);
    let (width, height) = (right - left, bottom - top);
    let fill = f64::from(outline.area) / (width * height);
    let around = outline.points.len() as f64 / (2.0 * (width + height));
    // Cheap first: an ellipse fills 0.79 of its bounds, less where it lies aslant.
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
    let round = squares <= tolerance * tolerance * count
        && ellipse.minor > LEAST_FLATNESS * ellipse.major
        && ellipse.minor > 2.0;
    let border = |ellipse| Border { ellipse, dark_within: outline.dark, whole: true };
    round.then(|| border(in_image(&ellipse, outline.level)))
}

/// Adds the ellipses of which an outline shows arcs: the image's border cuts a ring, something lies on it, or it runs
/// into something dark. `size` is that of the outline's level. Each fit takes one from `budget`.
pub(crate) fn add_arcs(
    outline: &imaging::Outline<'_>,
    size: [usize; 2],
    budget: &mut usize,
    borders: &mut Vec<Border>,
) {
    let points = outline.points;
    if points.len() < LEAST_ARC_POINTS {
        return;
    }
    let mut arcs = Arcs { outline, found: [None; MOST_ARCS] };
    if !outline.cut {
        arcs.search(0, points.len(), true, budget);
    } else {
        let limits = size.map(|edge| edge as f32 - 1.6);
        let ends = |[x, y]: &[f32; 2]| *x < 0.6 || *y < 0.6 || *x > limits[0] || *y > limits[1];
        let Some(first) = points.iter().position(ends) else { return };
        let mut start = 0;
        // Once round, from an end to the next.
        while start < points.len() {
            let onwards = points.iter().cycle().skip(first + start + 1);
            let length = onwards.take(points.len()).take_while(|p| !ends(p)).count();
            arcs.search(first + start + 1, length, false, budget);
            start += length + 1;
        }
    }
    for (ellipse, dark_within) in arcs.found.into_iter().flatten() {
        let ellipse = in_image(&ellipse, outline.level);
        borders.push(Border { ellipse, dark_within, whole: false });
    }
}

/// Of one outline no more arcs are taken.
const MOST_ARCS: usize = 4;

struct Arcs<'a> {
    outline: &'a imaging::Outline<'a>,
    /// Ellipses in pixels of the level, and whether dark lies within.
    found: [Option<(Ellipse, bool)>; MOST_ARCS],
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
            if window < LEAST_ARC_POINTS {
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
        let known =
            |(ellipse, _): &(Ellipse, bool)| ends.iter().all(|p| off_px(ellipse, *p).abs() < 1.5);
        if self.found.iter().flatten().any(known) {
            return;
        }
        let Some(dark_within) = self.turns(start, length) else { return };
        *budget -= 1;
        let arc = (0..length).step_by(1 + length / FIT_POINTS).map(|i| self.at(start + i));
        let Some(rough) = fit_ellipse(arc.clone()).filter(sound) else { return };
        let count = arc.clone().count() as f64;
        let squares: f64 = arc.map(|p| off_px(&rough, p).powi(2)).sum();
        if squares > 0.5 * count {
            return;
        }
        // What else of the outline lies on it.
        let near = |p: &[f64; 2]| off_px(&rough, *p).abs() < 1.0;
        let total = self.outline.points.len();
        let all = (0..total).step_by(1 + total / 160).map(|i| self.at(i)).filter(near);
        let Some(ellipse) = fit_ellipse(all.clone()).filter(sound) else { return };
        let sectors = all.fold(0_u32, |seen, p| seen | 1 << sector(&ellipse, p));
        if sectors.count_ones() >= LEAST_SECTORS {
            self.found[slot] = Some((ellipse, dark_within == self.outline.dark));
        }
    }

    /// Whether a part of the outline turns steadily one way, and if so whether the region lies within the bend.
    fn turns(&self, start: usize, length: usize) -> Option<bool> {
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

fn sound(ellipse: &Ellipse) -> bool {
    ellipse.minor > 9.0
        && ellipse.minor > LEAST_FLATNESS * ellipse.major
        && ellipse.major < 20_000.0
}

/// Distance of a point from an ellipse in pixels, roughly; positive outside.
fn off_px(ellipse: &Ellipse, point: [f64; 2]) -> f64 {
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
