//! The edges of a larger square marker, each compared with the image in light of its own.
//!
//! At places along every edge, a run of pixels across it is compared with the profile of a blurred step. Black and white
//! are the run's own, so that neither a gradient of light nor a shadow's edge across the marker moves anything; the blur
//! is the marker's. What the runs say of their edges' shifts moves the whole square, less so where they disagree
//! with the others: something covers the marker there.

use geometry::Pixel;
use imaging::GrayView;
use nalgebra::{SMatrix, SVector};

use crate::optics::edge_response::{EdgeResponse, pixel_kurtosis};
use crate::refine::corners::{CORNERS, Fit, Homography, Lens, Scratch};
use crate::refine::pattern::Pattern;
use crate::refine::photometric::Picture;

/// A place at which an edge is looked at.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Run {
    /// In the square's coordinates.
    place: [f64; 2],
    /// Across the edge, from black to white: one cell, in the square's coordinates.
    across: [f64; 2],
    /// What the last comparison said.
    sight: Option<Sight>,
}

/// What a run of pixels says.
#[derive(Copy, Clone, Debug)]
struct Sight {
    /// How the edge's place changes with the homography.
    slope: [f64; 8],
    /// Normal equations of the edge's shift in pixels and of the spread, black and contrast being free.
    matrix: [f64; 3],
    right: [f64; 2],
    /// Squares of the differences that are left, and the pixels there are beyond the unknowns.
    squares: f64,
    freedom: f64,
    black: f64,
    contrast: f64,
    weight: f64,
}

/// What the edge of a run looks like before anything is compared.
struct Edge {
    pixel: Pixel,
    /// Unit normal in the image, from black to white.
    normal: [f64; 2],
    slope: [f64; 8],
    /// Distance to the next cell's edge, in pixels.
    cell_px: f64,
}

/// Numbers of the homography, and the spread.
const UNKNOWNS: usize = 9;
const MOST_RUNS: usize = 210;
const MOST_PIXELS: usize = 24;
/// Fewer runs than this, or than this share of those within the image, do not make a square.
const LEAST_RUNS: usize = 16;
const LEAST_SHARE: f64 = 0.35;
/// Rough and fine passes over all runs.
const ROUGH_PASSES: usize = 2;
const FINE_PASSES: usize = 6;
/// How far from their places edges are looked for in rough passes, in pixels; and how far at first where less than a
/// share of those within the image is found so near: a quad that was put together of pieces can be off by much.
const REACH_PX: f64 = 4.5;
const WIDE_REACH_PX: f64 = 40.0;
const FEW_SEEN: f64 = 0.7;
/// A rough pass that moves the corners less, in pixels, is the last.
const NEARBY_PX: f64 = 0.5;
/// Of the runs every so many-th takes part in the first passes, unless they are few; in fine ones until the corners move
/// less than this, in pixels.
const FEW_EVERY: usize = 3;
const SETTLED_BY_FEW_PX: f64 = 0.1;
/// A fine pass over all runs that moves the corners less, in pixels, is the last: what is left to be moved after a step is
/// in its square. When the blur was not fitted before, it takes less.
const SETTLED_PX: f64 = 0.03;
const SETTLED_AT_ONCE_PX: f64 = 0.01;
/// Smaller differences, in grey levels, are no edges.
const LEAST_CONTRAST: f64 = 5.0;
/// Runs whose shift is more times its usual size pull no harder.
const USUAL_SHIFTS: f64 = 2.5;
/// Where more of the pixels are at the sensor's end, black and white must be common to the whole marker.
const MOST_CLIPPED: f64 = 0.03;

/// The homography on which the runs agree. `None` when too few of the marker's edges are seen, or they are too
/// close to each other for their blur.
pub(crate) fn fit(
    view: GrayView<'_>,
    lens: &Lens<'_>,
    start: &Homography,
    (pattern, is_near): (&Pattern, bool),
    scratch: &mut Scratch,
) -> Option<Fit> {
    place_runs((view, lens, start), pattern, &mut scratch.runs);
    fit_runs(view, lens, (start, is_near), scratch)
}

/// The same for edges that are given.
pub(crate) fn fit_edges(
    view: GrayView<'_>,
    lens: &Lens<'_>,
    start: &Homography,
    edges: &[[[f64; 2]; 2]],
    scratch: &mut Scratch,
) -> Option<Fit> {
    scratch.runs.clear();
    let run = |[place, across]: &[[f64; 2]; 2]| Run { place: *place, across: *across, sight: None };
    scratch.runs.extend(edges.iter().take(2 * MOST_RUNS).map(run));
    fit_runs(view, lens, (start, false), scratch)
}

/// From a start that `is_near`, to about half a pixel, fine passes find the edges at once.
fn fit_runs(
    view: GrayView<'_>,
    lens: &Lens<'_>,
    (start, is_near): (&Homography, bool),
    scratch: &mut Scratch,
) -> Option<Fit> {
    let mut search = Search {
        view,
        lens,
        homography: *start,
        spread_px: 0.75,
        step: EdgeResponse::new(),
        inside: 0,
        clipped: 0,
        pixels: 0,
    };
    let mut every = if scratch.runs.len() >= 4 * LEAST_RUNS * FEW_EVERY { FEW_EVERY } else { 1 };
    for pass in 0..if is_near { 0 } else { ROUGH_PASSES } {
        let before = search.homography;
        let seen = search.look(&mut scratch.runs, every, REACH_PX);
        if pass == 0 && seen < FEW_SEEN {
            search.look(&mut scratch.runs, every, WIDE_REACH_PX);
        }
        search.agree(scratch)?;
        if before.distance_px(&search.homography) < NEARBY_PX {
            break;
        }
    }
    let mut system = None;
    for pass in 0..FINE_PASSES {
        search.compare_all(&mut scratch.runs, every)?;
        if search.clipped as f64 > MOST_CLIPPED * search.pixels as f64 {
            return None;
        }
        search.weigh(scratch)?;
        let next = System::new(&scratch.runs);
        let moved_px = search.step(&next)?;
        if every > 1 {
            if moved_px < SETTLED_BY_FEW_PX || pass + 3 >= FINE_PASSES {
                every = 1;
            }
            continue;
        }
        system = Some(next);
        if moved_px < if pass > 0 { SETTLED_PX } else { SETTLED_AT_ONCE_PX } {
            break;
        }
    }
    search.result(system?, &scratch.runs)
}

/// Places within the image along all edges of the pattern, spread so that their number is bounded.
fn place_runs(
    (view, lens, start): (GrayView<'_>, &Lens<'_>, &Homography),
    pattern: &Pattern,
    runs: &mut Vec<Run>,
) {
    let mut length_px = 0.0;
    each_edge(pattern, |edge| length_px += edge.usable(start).map_or(0.0, |[from, to]| to - from));
    runs.clear();
    if !length_px.is_finite() {
        return;
    }
    let spacing_px = (length_px / MOST_RUNS as f64).max(1.0);
    spread_runs(start, pattern, (spacing_px, |_| true), runs);
    let is_seen = |place: [f64; 2]| {
        lens.seen(start.at(place).ideal).is_some_and(|(pixel, _)| is_inside(view, pixel))
    };
    if !CORNERS.into_iter().all(is_seen) {
        // Those outside of the image would take the places of others.
        let inside = runs.iter().filter(|run| is_seen(run.place)).count();
        let share = inside.max(1) as f64 / runs.len().max(1) as f64;
        spread_runs(start, pattern, ((share * spacing_px).max(1.0), is_seen), runs);
    }
}

fn is_inside(view: GrayView<'_>, pixel: Pixel) -> bool {
    let within = |at: f64, size: usize| at >= 0.0 && at < size as f64;
    within(pixel.x, view.width()) && within(pixel.y, view.height())
}

/// Places so far apart along all edges, of which some are kept.
fn spread_runs(
    start: &Homography,
    pattern: &Pattern,
    (spacing_px, is_kept): (f64, impl Fn([f64; 2]) -> bool),
    runs: &mut Vec<Run>,
) {
    runs.clear();
    // Lengths are counted through, so that short edges get their share.
    let mut next_px = 0.5 * spacing_px;
    let mut passed_px = 0.0;
    each_edge(pattern, |edge| {
        let Some([from, to]) = edge.usable(start) else { return };
        let end_px = passed_px + to - from;
        while next_px < end_px && runs.len() < 2 * MOST_RUNS {
            let share = (from + next_px - passed_px) / edge.length_px(start);
            let place = [0, 1].map(|i| edge.from[i] + (edge.to[i] - edge.from[i]) * share);
            if is_kept(place) {
                runs.push(Run { place, across: edge.across, sight: None });
            }
            next_px += spacing_px;
        }
        passed_px = end_px;
    });
}

/// A straight edge between cells, in the square's coordinates.
#[derive(Copy, Clone, Debug)]
struct Segment {
    from: [f64; 2],
    to: [f64; 2],
    across: [f64; 2],
}

impl Segment {
    fn length_px(&self, homography: &Homography) -> f64 {
        let [from, to] = [self.from, self.to].map(|place| homography.at(place).ideal);
        (to[0] - from[0]).hypot(to[1] - from[1])
    }

    /// The part of its length, in pixels, that is away from its ends; `None` when there is none.
    fn usable(&self, homography: &Homography) -> Option<[f64; 2]> {
        const CLEAR_PX: f64 = 2.0;
        let length = self.length_px(homography);
        (length > 2.0 * CLEAR_PX + 0.5).then_some([CLEAR_PX, length - CLEAR_PX])
    }
}

/// Calls `with` for every straight edge of the pattern.
fn each_edge(pattern: &Pattern, mut with: impl FnMut(Segment)) {
    let across = pattern.across();
    let half = pattern.cells() as f64 / 2.0;
    let margin = pattern.margin() as f64;
    let at = |cell: usize| (cell as f64 - margin) / half - 1.0;
    for upright in [true, false] {
        let ink = |line: usize, along: usize| {
            if upright { pattern.is_white(line, along) } else { pattern.is_white(along, line) }
        };
        for line in 1..across {
            let sign = |along: usize| match (ink(line - 1, along), ink(line, along)) {
                (Some(false), Some(true)) => 1.0,
                (Some(true), Some(false)) => -1.0,
                _ => 0.0,
            };
            let mut first = 0;
            while first < across {
                let towards = sign(first);
                let count = (first..across).take_while(|along| sign(*along) == towards).count();
                let place = |along: usize| {
                    if upright { [at(line), at(along)] } else { [at(along), at(line)] }
                };
                if towards != 0.0 {
                    let cell = towards / half;
                    let across = if upright { [cell, 0.0] } else { [0.0, cell] };
                    with(Segment { from: place(first), to: place(first + count), across });
                }
                first += count;
            }
        }
    }
}

struct Search<'a> {
    view: GrayView<'a>,
    lens: &'a Lens<'a>,
    homography: Homography,
    spread_px: f64,
    step: EdgeResponse,
    /// Runs within the image in the last pass; pixels at the sensor's end, and all.
    inside: usize,
    clipped: usize,
    pixels: usize,
}

/// Pixels across an edge: their distance from it towards white, and their grey value.
type Pixels = [[f64; 2]; MOST_PIXELS];

impl Search<'_> {
    fn edge(&self, run: &Run) -> Option<Edge> {
        let place = self.homography.at(run.place);
        let (pixel, bend) = self.lens.seen(place.ideal)?;
        let jacobian = place.jacobian(&self.homography);
        let towards = |[a, b]: [f64; 2]| {
            let x = jacobian[0][0] * a + jacobian[1][0] * b;
            let y = jacobian[0][1] * a + jacobian[1][1] * b;
            [bend[(0, 0)] * x + bend[(0, 1)] * y, bend[(1, 0)] * x + bend[(1, 1)] * y]
        };
        let along = towards([-run.across[1], run.across[0]]);
        let cell = towards(run.across);
        let length = along[0].hypot(along[1]);
        let upright = [along[1] / length, -along[0] / length];
        let cell_px = upright[0] * cell[0] + upright[1] * cell[1];
        let normal = if cell_px < 0.0 { upright.map(|n| -n) } else { upright };
        let ideal_normal = [
            bend[(0, 0)] * normal[0] + bend[(1, 0)] * normal[1],
            bend[(0, 1)] * normal[0] + bend[(1, 1)] * normal[1],
        ];
        let edge = Edge { pixel, normal, slope: place.along(ideal_normal), cell_px: cell_px.abs() };
        (edge.cell_px.is_finite() && edge.cell_px > 1.0).then_some(edge)
    }

    /// The pixels of the row or column that crosses the edge most steeply, up to `reach_px` away from it; of many, every
    /// so many-th.
    fn pixels(&self, edge: &Edge, reach_px: f64, pixels: &mut Pixels) -> usize {
        let [nx, ny] = edge.normal;
        let level = nx.abs() >= ny.abs();
        let (line, place, steep, flat) = if level {
            (edge.pixel.y, edge.pixel.x, nx, ny)
        } else {
            (edge.pixel.x, edge.pixel.y, ny, nx)
        };
        let (lines, length) = if level {
            (self.view.height(), self.view.width())
        } else {
            (self.view.width(), self.view.height())
        };
        let nearest = line.round();
        // Where the edge crosses that row.
        let crossing = place - (nearest - line) * flat / steep;
        let reach = reach_px / steep.abs();
        let (first, last) = ((crossing - reach).ceil(), (crossing + reach).floor());
        let inside =
            nearest >= 0.0 && nearest < lines as f64 && first >= 0.0 && last < length as f64;
        if !inside || last < first {
            return 0;
        }
        let (nearest, first, last) = (nearest as usize, first as usize, last as usize);
        let stride = (last - first) / MOST_PIXELS + 1;
        let mut count = 0;
        for (slot, at) in pixels.iter_mut().zip((first..=last).step_by(stride)) {
            let grey = if level { self.view.at(at, nearest) } else { self.view.at(nearest, at) };
            *slot = [(at as f64 - crossing) * steep, f64::from(grey)];
            count += 1;
        }
        count
    }

    /// Looks where grey values cross the middle between black and white, up to so far from every so many-th edge's place;
    /// returns the share of the edges within the image that were found.
    fn look(&mut self, runs: &mut [Run], every: usize, reach_px: f64) -> f64 {
        let mut pixels = [[0.0; 2]; MOST_PIXELS];
        let mut seen = 0;
        self.inside = 0;
        for (i, run) in runs.iter_mut().enumerate() {
            run.sight = None;
            if i % every != 0 {
                continue;
            }
            let Some(edge) = self.edge(run) else { continue };
            self.inside += usize::from(is_inside(self.view, edge.pixel));
            let reach = reach_px.min(edge.cell_px - 0.5);
            let count = self.pixels(&edge, reach, &mut pixels);
            let Some(pixels) = pixels.get_mut(..count).filter(|p| p.len() >= 4) else { continue };
            if pixels[0][0] > pixels[count - 1][0] {
                pixels.reverse();
            }
            run.sight = crossing(pixels).map(|(shift, black, contrast)| Sight {
                slope: edge.slope,
                matrix: [1.0, 0.0, 1.0],
                right: [shift, 0.0],
                squares: 0.0,
                freedom: 1.0,
                black,
                contrast,
                weight: 1.0,
            });
            seen += usize::from(run.sight.is_some());
        }
        seen as f64 / self.inside.max(1) as f64
    }

    /// Moves the square to where what was looked at says; those far from what the others say are something else's edges.
    fn agree(&mut self, scratch: &mut Scratch) -> Option<()> {
        for _ in 0..3 {
            self.weigh(scratch)?;
            let system = System::new(&scratch.runs);
            let step = system.solve()?;
            self.homography = self.homography.moved(|i| step[i])?;
            for sight in scratch.runs.iter_mut().filter_map(|run| run.sight.as_mut()) {
                let moved: f64 = (0..8).map(|i| sight.slope[i] * step[i]).sum();
                sight.right[0] -= moved;
            }
        }
        Some(())
    }

    /// Compares every so many-th run with the profile of its edge.
    fn compare_all(&mut self, runs: &mut [Run], every: usize) -> Option<()> {
        let mut pixels = [[0.0; 2]; MOST_PIXELS];
        (self.inside, self.clipped, self.pixels) = (0, 0, 0);
        for (i, run) in runs.iter_mut().enumerate() {
            run.sight = None;
            if i % every != 0 {
                continue;
            }
            let Some(edge) = self.edge(run) else { continue };
            self.inside += usize::from(is_inside(self.view, edge.pixel));
            let reach = (3.0 * self.spread_px + 1.0).min(edge.cell_px - 2.3 * self.spread_px);
            if reach < 1.8 * self.spread_px + 0.5 {
                continue;
            }
            let count = self.pixels(&edge, reach, &mut pixels);
            let Some(pixels) = pixels.get(..count).filter(|p| p.len() >= 5) else { continue };
            self.pixels += count;
            self.clipped +=
                pixels.iter().filter(|[_, grey]| *grey <= 0.0 || *grey >= 255.0).count();
            run.sight = self.compare(&edge, pixels);
        }
        Some(())
    }

    /// What pixels say of the edge's shift and of the spread.
    fn compare(&self, edge: &Edge, pixels: &[[f64; 2]]) -> Option<Sight> {
        let pixel_kurtosis = pixel_kurtosis(edge.normal, self.spread_px * self.spread_px);
        let mut looks = [[0.0; 3]; MOST_PIXELS];
        let count = pixels.len() as f64;
        // Sums for the straight line of grey over whiteness, and over both slopes.
        let (mut sf, mut sff, mut sg, mut sfg) = (0.0, 0.0, 0.0, 0.0);
        for ([distance, grey], look) in pixels.iter().zip(&mut looks) {
            let z = distance / self.spread_px;
            let (white, slope) = self.step.at(z, pixel_kurtosis);
            *look = [white, -slope, -z * slope];
            sf += white;
            sff += white * white;
            sg += grey;
            sfg += white * grey;
        }
        let determinant = count * sff - sf * sf;
        if determinant < 0.05 {
            return None;
        }
        let contrast = (count * sfg - sf * sg) / determinant;
        let black = (sg - contrast * sf) / count;
        let scale = contrast / self.spread_px;
        // What the line explains is taken out of both slopes.
        let line = |index: usize| {
            let (mut s, mut fs) = (0.0, 0.0);
            for look in looks.iter().take(pixels.len()) {
                s += look[index];
                fs += look[0] * look[index];
            }
            let rise = (count * fs - sf * s) / determinant;
            ((s - rise * sf) / count, rise)
        };
        let lines = [line(1), line(2)];
        let (mut matrix, mut right, mut squares) = ([0.0; 3], [0.0; 2], 0.0);
        for ([_, grey], look) in pixels.iter().zip(&looks) {
            let difference = grey - black - contrast * look[0];
            let shift = (look[1] - lines[0].0 - lines[0].1 * look[0]) * scale;
            let spread = (look[2] - lines[1].0 - lines[1].1 * look[0]) * scale;
            matrix[0] += shift * shift;
            matrix[1] += shift * spread;
            matrix[2] += spread * spread;
            right[0] += shift * difference;
            right[1] += spread * difference;
            squares += difference * difference;
        }
        let seen = contrast > LEAST_CONTRAST && matrix[0] > 0.0;
        seen.then_some(Sight {
            slope: edge.slope,
            matrix,
            right,
            squares,
            freedom: count - 3.0,
            black,
            contrast,
            weight: 1.0,
        })
    }

    /// Gives each run its weight by how far it is from what the others say.
    fn weigh(&self, scratch: &mut Scratch) -> Option<()> {
        let Scratch { runs, shifts, .. } = scratch;
        let least = LEAST_SHARE * self.inside as f64;
        let mut median_of = |of: &dyn Fn(&Sight) -> f64| {
            shifts.clear();
            shifts.extend(runs.iter().filter_map(|run| run.sight.as_ref()).map(of));
            let middle = shifts.len() / 2;
            (shifts.len() > LEAST_RUNS && shifts.len() as f64 > least)
                .then(|| *shifts.select_nth_unstable_by(middle, f64::total_cmp).1)
        };
        let contrast = median_of(&|sight| sight.contrast)?;
        let scatter = 1.5 * median_of(&|sight| sight.standing().abs())?;
        let noise = median_of(&|sight| sight.squares / sight.freedom)?;
        for sight in runs.iter_mut().filter_map(|run| run.sight.as_mut()) {
            let limit = USUAL_SHIFTS * scatter.max(1e-9) / sight.standing().abs().max(1e-12);
            let noisy = 9.0 * noise.max(0.2) / (sight.squares / sight.freedom).max(1e-12);
            sight.weight = limit.min(1.0).powi(2) * noisy.min(1.0);
            if sight.contrast < 0.25 * contrast {
                sight.weight = 0.0;
            }
        }
        Some(())
    }

    /// Moves the square and the spread; returns how far the square moved, in pixels.
    fn step(&mut self, system: &System) -> Option<f64> {
        let step = system.solve()?;
        let before = self.homography;
        self.homography = before.moved(|i| step[i])?;
        self.spread_px = (self.spread_px + step[8].clamp(-0.4, 0.6)).clamp(0.29, 4.0);
        Some(before.distance_px(&self.homography))
    }

    fn result(&self, system: System, runs: &[Run]) -> Option<Fit> {
        let (mut weight, mut black, mut contrast) = (0.0, 0.0, 0.0);
        let (mut squares, mut freedom, mut scatter) = (0.0, 0.0, 0.0);
        for sight in runs.iter().filter_map(|run| run.sight.as_ref()) {
            weight += sight.weight;
            black += sight.weight * sight.black;
            contrast += sight.weight * sight.contrast;
            squares += sight.weight * sight.squares;
            freedom += sight.weight * sight.freedom;
            scatter += sight.weight * sight.standing().powi(2);
        }
        if weight < LEAST_RUNS as f64 {
            return None;
        }
        let noise = squares / freedom;
        // Where the runs scatter more than their pixels' noise explains, the paper or the model is to blame.
        let scatter = scatter / (weight - UNKNOWNS as f64).max(1.0);
        let inverse = system.full().cholesky()?.inverse();
        let covariance = inverse.fixed_view::<8, 8>(0, 0) * noise.max(scatter);
        let picture = Picture {
            black: black / weight,
            contrast: contrast / weight,
            shade: [0.0; 2],
            beyond: 0.0,
            spread_px: self.spread_px,
        };
        let residual = noise.sqrt() / picture.contrast;
        Some(Fit { homography: self.homography, covariance, picture, residual })
    }
}

impl Sight {
    /// The shift it asks for, in units of grey levels of noise.
    fn standing(&self) -> f64 {
        self.right[0] / self.matrix[0].sqrt()
    }
}

/// Where pixels sorted from black to white cross the middle between both, nearest to the expected place; with black
/// and contrast.
fn crossing(pixels: &[[f64; 2]]) -> Option<(f64, f64, f64)> {
    let count = pixels.len();
    let black = pixels[0][1].min(pixels[1][1]);
    let white = pixels[count - 1][1].max(pixels[count - 2][1]);
    let middle = (black + white) / 2.0;
    let place = pixels
        .windows(2)
        .filter(|pair| pair[0][1] < middle && pair[1][1] >= middle)
        .map(|pair| {
            let share = (middle - pair[0][1]) / (pair[1][1] - pair[0][1]);
            pair[0][0] + share * (pair[1][0] - pair[0][0])
        })
        .min_by(|a, b| a.abs().total_cmp(&b.abs()))?;
    (white - black > 2.0 * LEAST_CONTRAST).then_some((place, black, white - black))
}

/// The normal equations of the homography and the spread.
struct System {
    matrix: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    right: SVector<f64, UNKNOWNS>,
}

impl System {
    fn new(runs: &[Run]) -> Self {
        // All of the rows, though half would do: it takes no longer.
        let (mut rows, mut mixed_row, mut spread_sum) = ([[0.0; 8]; 8], [0.0; 8], 0.0);
        let (mut sums, mut right_spread) = ([0.0; 8], 0.0);
        for sight in runs.iter().filter_map(|run| run.sight.as_ref()) {
            let [shift, mixed, spread] = sight.matrix.map(|m| sight.weight * m);
            let right = sight.right.map(|r| sight.weight * r);
            let slope = &sight.slope;
            for (row, along) in rows.iter_mut().zip(slope) {
                let scaled = shift * along;
                for (entry, other) in row.iter_mut().zip(slope) {
                    *entry += scaled * other;
                }
            }
            for ((entry, sum), along) in mixed_row.iter_mut().zip(&mut sums).zip(slope) {
                *entry += mixed * along;
                *sum += right[0] * along;
            }
            spread_sum += spread;
            right_spread += right[1];
        }
        let matrix = SMatrix::<f64, UNKNOWNS, UNKNOWNS>::from_fn(|i, j| match (i, j) {
            (8, 8) => spread_sum,
            (8, other) | (other, 8) => mixed_row[other],
            _ => rows[i][j],
        });
        let right =
            SVector::<f64, UNKNOWNS>::from_fn(|i, _| if i < 8 { sums[i] } else { right_spread });
        Self { matrix, right }
    }

    fn full(&self) -> SMatrix<f64, UNKNOWNS, UNKNOWNS> {
        self.matrix
    }

    fn solve(&self) -> Option<SVector<f64, UNKNOWNS>> {
        let step = self.matrix.cholesky()?.solve(&self.right);
        step.iter().all(|s| s.is_finite()).then_some(step)
    }
}
