//! Refines a larger marker along its edges, each edge in its own light.
//!
//! At samples along every edge, the pixels across it are compared with the profile of a blurred step. Black
//! and white belong to the sample, so that neither a gradient of the light nor the edge of a shadow moves
//! anything; the blur belongs to the marker. The measured shifts of all edges move the square. Samples that
//! contradict the others get less weight, as something covers the marker there.

use geometry::Pixel;
use imaging::GrayView;
use nalgebra::{SMatrix, SVector};

use crate::optics::edge_response::{EdgeResponse, pixel_kurtosis};
use crate::optics::homography::{CORNERS, Homography};
use crate::optics::least_squares::NormalEquations;
use crate::optics::undistort::Undistortion;
use crate::refine::common_shift::{CommonShift, Scatter, UNKNOWNS, covariance};
use crate::refine::fit::{EdgeMeasurement, EdgeSample, Fit, PhotometricModel, Scratch, Target};
use crate::refine::pattern::Pattern;
use crate::refine::side_errors::SideErrors;

/// Number of samples along a marker's edges.
const MAX_SAMPLES: usize = 210;
/// Largest number of pixels across an edge.
const MAX_PIXELS: usize = 24;
/// Smallest number of measured samples, and smallest fraction of those within the image.
const MIN_SAMPLES: usize = 16;
const MIN_SAMPLE_RATIO: f64 = 0.35;
/// Coarse passes search for the edges, fine ones compare their profiles.
const COARSE_PASSES: usize = 2;
const FINE_PASSES: usize = 6;
/// Distance within which coarse passes search for an edge, in pixels.
const SEARCH_PX: f64 = 4.5;
/// The same where the first pass finds less than this fraction of the edges: quads of segments can be far
/// off.
const WIDE_SEARCH_PX: f64 = 40.0;
const MIN_FOUND_RATIO: f64 = 0.7;
/// A coarse pass that moves the corners less than this, in pixels, is the last.
const COARSE_SETTLED_PX: f64 = 0.5;
/// The first passes use every third sample, unless there are few; fine ones do so until the corners move less
/// than this, in pixels.
const SUBSET_STEP: usize = 3;
const SUBSET_SETTLED_PX: f64 = 0.1;
/// A fine pass over all samples that moves the corners less than this, in pixels, is the last; the error that
/// remains is of the order of its square. It is smaller for the first pass, before which the blur was not
/// fitted.
const SETTLED_PX: f64 = 0.03;
const FIRST_PASS_SETTLED_PX: f64 = 0.01;
/// Smallest contrast of an edge, in grey levels.
const MIN_CONTRAST: f64 = 5.0;
/// Shifts beyond this multiple of the median one are weighted down.
const OUTLIER_SHIFTS: f64 = 2.5;
/// Above this fraction of saturated pixels, black and white must be common to the whole marker, and this fit
/// fails.
const MAX_SATURATED_RATIO: f64 = 0.03;

/// The edge of a sample as the current homography projects it.
struct ProjectedEdge {
    pixel: Pixel,
    /// Unit normal in the image, from black to white.
    normal: [f64; 2],
    /// Derivatives of the position along the normal by the homography's parameters.
    gradient: [f64; 8],
    /// Distance to the next cell's edge, in pixels.
    cell_px: f64,
}

/// The homography that the edges of a pattern agree on. From a start that `is_near`, to about half a pixel,
/// no coarse pass is made. `None` when too few edges are seen, or they are too close to each other for their
/// blur.
pub(crate) fn fit(
    target: Target<'_>,
    pattern: &Pattern,
    is_near: bool,
    scratch: &mut Scratch,
) -> Option<Fit> {
    place_samples(target, pattern, &mut scratch.edges);
    fit_samples(target, is_near, scratch)
}

/// The same for edges that are given.
pub(crate) fn fit_edges(
    target: Target<'_>,
    edges: &[[[f64; 2]; 2]],
    scratch: &mut Scratch,
) -> Option<Fit> {
    scratch.edges.clear();
    let sample = |[place, across]: &[[f64; 2]; 2]| EdgeSample {
        place: *place,
        across: *across,
        measurement: None,
    };
    scratch.edges.extend(edges.iter().take(2 * MAX_SAMPLES).map(sample));
    fit_samples(target, false, scratch)
}

fn fit_samples(target: Target<'_>, is_near: bool, scratch: &mut Scratch) -> Option<Fit> {
    let Target { view, lens, start, .. } = target;
    let mut fit = EdgeFit {
        view,
        lens,
        homography: *start,
        spread_px: 0.75,
        response: EdgeResponse::new(),
        inside: 0,
        saturated: 0,
        pixels: 0,
    };
    let has_many = scratch.edges.len() >= 4 * MIN_SAMPLES * SUBSET_STEP;
    let mut step = if has_many { SUBSET_STEP } else { 1 };
    for pass in 0..if is_near { 0 } else { COARSE_PASSES } {
        let before = fit.homography;
        let found = fit.locate(&mut scratch.edges, step, SEARCH_PX);
        if pass == 0 && found < MIN_FOUND_RATIO {
            fit.locate(&mut scratch.edges, step, WIDE_SEARCH_PX);
        }
        fit.align(scratch)?;
        if before.distance_px(&fit.homography) < COARSE_SETTLED_PX {
            break;
        }
    }
    let mut equations = None;
    let mut measured_at = fit.homography;
    for pass in 0..FINE_PASSES {
        fit.measure_all(&mut scratch.edges, step);
        if fit.saturated as f64 > MAX_SATURATED_RATIO * fit.pixels as f64 {
            return None;
        }
        fit.reweight(scratch)?;
        let next = normal_equations(&scratch.edges);
        measured_at = fit.homography;
        let moved_px = fit.step(&next)?;
        if step > 1 {
            if moved_px < SUBSET_SETTLED_PX || pass + 3 >= FINE_PASSES {
                step = 1;
            }
            continue;
        }
        equations = Some(next);
        if moved_px < if pass > 0 { SETTLED_PX } else { FIRST_PASS_SETTLED_PX } {
            break;
        }
    }
    let (equations, edges) = (equations?, &scratch.edges);
    let shift = CommonShift::from_edges(&equations, edges);
    let plain = fit.result(&equations, shift.is_some_and(|shift| shift.is_known), edges)?;
    let shifted =
        shift.and_then(|shift| shift.applied(&measured_at, fit.lens, plain.clone(), edges));
    Some(shifted.unwrap_or(plain))
}

/// Spreads a bounded number of samples along the pattern's edges within the image.
fn place_samples(target: Target<'_>, pattern: &Pattern, samples: &mut Vec<EdgeSample>) {
    let Target { view, lens, start, .. } = target;
    let mut length_px = 0.0;
    each_edge(pattern, |edge| length_px += edge.usable(start).map_or(0.0, |[from, to]| to - from));
    samples.clear();
    if !length_px.is_finite() {
        return;
    }
    let spacing_px = (length_px / MAX_SAMPLES as f64).max(1.0);
    spread_samples(start, pattern, spacing_px, |_| true, samples);
    let is_visible = |place: [f64; 2]| {
        lens.distort(start.project(place).image).is_some_and(|(pixel, _)| is_inside(view, pixel))
    };
    if !CORNERS.into_iter().all(is_visible) {
        // Samples outside of the image are replaced by more samples within it.
        let inside = samples.iter().filter(|sample| is_visible(sample.place)).count();
        let ratio = inside.max(1) as f64 / samples.len().max(1) as f64;
        let spacing_px = (ratio * spacing_px).max(1.0);
        spread_samples(start, pattern, spacing_px, is_visible, samples);
    }
}

fn is_inside(view: GrayView<'_>, pixel: Pixel) -> bool {
    let within = |at: f64, size: usize| at >= 0.0 && at < size as f64;
    within(pixel.x, view.width()) && within(pixel.y, view.height())
}

/// Places samples at this spacing along all edges, and keeps those that are visible.
fn spread_samples(
    start: &Homography,
    pattern: &Pattern,
    spacing_px: f64,
    is_visible: impl Fn([f64; 2]) -> bool,
    samples: &mut Vec<EdgeSample>,
) {
    samples.clear();
    // The spacing continues from edge to edge, so that short edges get their fraction.
    let mut next_px = 0.5 * spacing_px;
    let mut passed_px = 0.0;
    each_edge(pattern, |edge| {
        let Some([from, to]) = edge.usable(start) else { return };
        let end_px = passed_px + to - from;
        while next_px < end_px && samples.len() < 2 * MAX_SAMPLES {
            let share = (from + next_px - passed_px) / edge.length_px(start);
            let place = [0, 1].map(|i| edge.from[i] + (edge.to[i] - edge.from[i]) * share);
            if is_visible(place) {
                samples.push(EdgeSample { place, across: edge.across, measurement: None });
            }
            next_px += spacing_px;
        }
        passed_px = end_px;
    });
}

/// A straight edge between cells, in the square's coordinates.
#[derive(Copy, Clone, Debug)]
struct CellEdge {
    from: [f64; 2],
    to: [f64; 2],
    across: [f64; 2],
}

impl CellEdge {
    fn length_px(&self, homography: &Homography) -> f64 {
        let [from, to] = [self.from, self.to].map(|place| homography.project(place).image);
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
fn each_edge(pattern: &Pattern, mut with: impl FnMut(CellEdge)) {
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
                    with(CellEdge { from: place(first), to: place(first + count), across });
                }
                first += count;
            }
        }
    }
}

struct EdgeFit<'a> {
    view: GrayView<'a>,
    lens: &'a Undistortion<'a>,
    homography: Homography,
    spread_px: f64,
    response: EdgeResponse,
    /// In the last pass: samples within the image, pixels of samples whose black or white is saturated that are so, and all
    /// pixels.
    inside: usize,
    saturated: usize,
    pixels: usize,
}

/// Pixels across an edge: their distance from it towards white, and their grey value.
type Pixels = [[f64; 2]; MAX_PIXELS];

impl EdgeFit<'_> {
    fn project(&self, sample: &EdgeSample) -> Option<ProjectedEdge> {
        let place = self.homography.project(sample.place);
        let (pixel, distortion) = self.lens.distort(place.image)?;
        let jacobian = place.jacobian(&self.homography);
        let towards = |[a, b]: [f64; 2]| {
            let x = jacobian[0][0] * a + jacobian[1][0] * b;
            let y = jacobian[0][1] * a + jacobian[1][1] * b;
            [
                distortion[(0, 0)] * x + distortion[(0, 1)] * y,
                distortion[(1, 0)] * x + distortion[(1, 1)] * y,
            ]
        };
        let along = towards([-sample.across[1], sample.across[0]]);
        let cell = towards(sample.across);
        let length = along[0].hypot(along[1]);
        let upright = [along[1] / length, -along[0] / length];
        let cell_px = upright[0] * cell[0] + upright[1] * cell[1];
        let normal = if cell_px < 0.0 { upright.map(|n| -n) } else { upright };
        let ideal_normal = [
            distortion[(0, 0)] * normal[0] + distortion[(1, 0)] * normal[1],
            distortion[(0, 1)] * normal[0] + distortion[(1, 1)] * normal[1],
        ];
        let gradient = place.parameter_gradient(ideal_normal);
        let edge = ProjectedEdge { pixel, normal, gradient, cell_px: cell_px.abs() };
        (edge.cell_px.is_finite() && edge.cell_px > 1.0).then_some(edge)
    }

    /// Reads the pixels of the row or column that crosses the edge most steeply, up to `reach_px` away from
    /// the edge; every n-th of them where there are many. Returns their number.
    fn pixels(&self, edge: &ProjectedEdge, reach_px: f64, pixels: &mut Pixels) -> usize {
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
        let stride = (last - first) / MAX_PIXELS + 1;
        let mut count = 0;
        for (slot, at) in pixels.iter_mut().zip((first..=last).step_by(stride)) {
            let grey = if level { self.view.at(at, nearest) } else { self.view.at(nearest, at) };
            *slot = [(at as f64 - crossing) * steep, f64::from(grey)];
            count += 1;
        }
        count
    }

    /// Finds where grey values cross the middle between black and white, within `reach_px` of every `step`-th
    /// sample. Returns the fraction of the samples within the image at which an edge was found.
    fn locate(&mut self, samples: &mut [EdgeSample], step: usize, reach_px: f64) -> f64 {
        let mut pixels = [[0.0; 2]; MAX_PIXELS];
        let mut found = 0;
        self.inside = 0;
        for (i, sample) in samples.iter_mut().enumerate() {
            sample.measurement = None;
            if i % step != 0 {
                continue;
            }
            let Some(edge) = self.project(sample) else { continue };
            self.inside += usize::from(is_inside(self.view, edge.pixel));
            let reach = reach_px.min(edge.cell_px - 0.5);
            let count = self.pixels(&edge, reach, &mut pixels);
            let Some(pixels) = pixels.get_mut(..count).filter(|p| p.len() >= 4) else { continue };
            if pixels[0][0] > pixels[count - 1][0] {
                pixels.reverse();
            }
            sample.measurement =
                crossing(pixels).map(|Crossing { shift, black, contrast }| EdgeMeasurement {
                    gradient: edge.gradient,
                    matrix: [1.0, 0.0, 1.0],
                    right: [shift, 0.0],
                    squares: 0.0,
                    freedom: 1.0,
                    black,
                    contrast,
                    weight: 1.0,
                });
            found += usize::from(sample.measurement.is_some());
        }
        found as f64 / self.inside.max(1) as f64
    }

    /// Moves the square onto the edges that were located; edges that contradict the others are outliers.
    fn align(&mut self, scratch: &mut Scratch) -> Option<()> {
        for _ in 0..3 {
            self.reweight(scratch)?;
            let step = solve(&normal_equations(&scratch.edges))?;
            self.homography = self.homography.stepped(|i| step[i])?;
            for measurement in scratch.edges.iter_mut().filter_map(|e| e.measurement.as_mut()) {
                let moved: f64 = (0..8).map(|i| measurement.gradient[i] * step[i]).sum();
                measurement.right[0] -= moved;
            }
        }
        Some(())
    }

    /// Compares every `step`-th sample with the profile of its edge.
    fn measure_all(&mut self, samples: &mut [EdgeSample], step: usize) {
        let mut pixels = [[0.0; 2]; MAX_PIXELS];
        (self.inside, self.saturated, self.pixels) = (0, 0, 0);
        for (i, sample) in samples.iter_mut().enumerate() {
            sample.measurement = None;
            if i % step != 0 {
                continue;
            }
            let Some(edge) = self.project(sample) else { continue };
            self.inside += usize::from(is_inside(self.view, edge.pixel));
            let reach = (3.0 * self.spread_px + 1.0).min(edge.cell_px - 2.3 * self.spread_px);
            if reach < 1.8 * self.spread_px + 0.5 {
                continue;
            }
            let count = self.pixels(&edge, reach, &mut pixels);
            let Some(pixels) = pixels.get(..count).filter(|p| p.len() >= 5) else { continue };
            self.pixels += count;
            let is_saturated = |[_, grey]: &[f64; 2]| *grey <= 0.0 || *grey >= 255.0;
            // In the halos that sharpening adds next to an edge, black and white are seen beyond them.
            if pixels.first().is_some_and(is_saturated) || pixels.last().is_some_and(is_saturated) {
                self.saturated += pixels.iter().filter(|pixel| is_saturated(pixel)).count();
            }
            sample.measurement = self.measure(&edge, pixels);
        }
    }

    /// Fits the profile of a blurred edge to the pixels across it.
    fn measure(&self, edge: &ProjectedEdge, pixels: &[[f64; 2]]) -> Option<EdgeMeasurement> {
        let pixel_kurtosis = pixel_kurtosis(edge.normal, self.spread_px * self.spread_px);
        let mut model = [[0.0; 3]; MAX_PIXELS];
        let count = pixels.len() as f64;
        // Sums for the linear regression of grey values on the fraction of white, and for its derivatives.
        let (mut sf, mut sff, mut sg, mut sfg) = (0.0, 0.0, 0.0, 0.0);
        for ([distance, grey], point) in pixels.iter().zip(&mut model) {
            let z = distance / self.spread_px;
            let (white, slope) = self.response.at(z, pixel_kurtosis);
            *point = [white, -slope, -z * slope];
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
        // Black and contrast are eliminated from both derivatives.
        let line = |index: usize| {
            let (mut s, mut fs) = (0.0, 0.0);
            for point in model.iter().take(pixels.len()) {
                s += point[index];
                fs += point[0] * point[index];
            }
            let rise = (count * fs - sf * s) / determinant;
            ((s - rise * sf) / count, rise)
        };
        let lines = [line(1), line(2)];
        let (mut matrix, mut right, mut squares) = ([0.0; 3], [0.0; 2], 0.0);
        for ([_, grey], point) in pixels.iter().zip(&model) {
            let difference = grey - black - contrast * point[0];
            let shift = (point[1] - lines[0].0 - lines[0].1 * point[0]) * scale;
            let spread = (point[2] - lines[1].0 - lines[1].1 * point[0]) * scale;
            matrix[0] += shift * shift;
            matrix[1] += shift * spread;
            matrix[2] += spread * spread;
            right[0] += shift * difference;
            right[1] += spread * difference;
            squares += difference * difference;
        }
        let is_edge = contrast > MIN_CONTRAST && matrix[0] > 0.0;
        is_edge.then_some(EdgeMeasurement {
            gradient: edge.gradient,
            matrix,
            right,
            squares,
            freedom: count - 3.0,
            black,
            contrast,
            weight: 1.0,
        })
    }

    /// Weights each measurement by its consistency with the others.
    fn reweight(&self, scratch: &mut Scratch) -> Option<()> {
        let Scratch { edges, magnitudes, .. } = scratch;
        let min_count = MIN_SAMPLE_RATIO * self.inside as f64;
        let mut median_of = |of: &dyn Fn(&EdgeMeasurement) -> f64| {
            magnitudes.clear();
            magnitudes.extend(edges.iter().filter_map(|edge| edge.measurement.as_ref()).map(of));
            let middle = magnitudes.len() / 2;
            (magnitudes.len() > MIN_SAMPLES && magnitudes.len() as f64 > min_count)
                .then(|| *magnitudes.select_nth_unstable_by(middle, f64::total_cmp).1)
        };
        let contrast = median_of(&|m| m.contrast)?;
        let scatter = 1.5 * median_of(&|m| m.normalised_shift().abs())?;
        let noise = median_of(&|m| m.squares / m.freedom)?;
        for measurement in edges.iter_mut().filter_map(|edge| edge.measurement.as_mut()) {
            let limit = OUTLIER_SHIFTS * scatter.max(1e-9)
                / measurement.normalised_shift().abs().max(1e-12);
            let noisy =
                9.0 * noise.max(0.2) / (measurement.squares / measurement.freedom).max(1e-12);
            measurement.weight = limit.min(1.0).powi(2) * noisy.min(1.0);
            if measurement.contrast < 0.25 * contrast {
                measurement.weight = 0.0;
            }
        }
        Some(())
    }

    /// Moves the square and changes the blur; returns how far the square moved, in pixels.
    fn step(&mut self, equations: &NormalEquations<UNKNOWNS>) -> Option<f64> {
        let step = solve(equations)?;
        let before = self.homography;
        self.homography = before.stepped(|i| step[i])?;
        self.spread_px = (self.spread_px + step[8].clamp(-0.4, 0.6)).clamp(0.29, 4.0);
        Some(before.distance_px(&self.homography))
    }

    /// The fit without a common shift. `is_shift_known`: whether a shift could be distinguished from the square's size.
    fn result(
        &self,
        equations: &NormalEquations<UNKNOWNS>,
        is_shift_known: bool,
        edges: &[EdgeSample],
    ) -> Option<Fit> {
        let (mut weight, mut black, mut contrast) = (0.0, 0.0, 0.0);
        for measurement in edges.iter().filter_map(|edge| edge.measurement.as_ref()) {
            weight += measurement.weight;
            black += measurement.weight * measurement.black;
            contrast += measurement.weight * measurement.contrast;
        }
        if weight < MIN_SAMPLES as f64 {
            return None;
        }
        let inverse = equations.matrix.cholesky()?.inverse();
        let step = inverse * equations.right;
        let scatter = Scatter::after(&step, edges);
        let factor = SideErrors::OF_EDGES.factor(&self.homography, self.lens.jacobian());
        let variance = scatter.variance(is_shift_known) * factor;
        let covariance = covariance(&inverse, variance, &step, edges);
        let model = PhotometricModel {
            black: black / weight,
            contrast: contrast / weight,
            shade: [0.0; 2],
            beyond: 0.0,
            spread_px: self.spread_px,
        };
        let residual = scatter.of_pixels.sqrt() / model.contrast;
        let (homography, response, shift_px) = (self.homography, None, 0.0);
        Some(Fit { homography, covariance, model, residual, is_shift_known, shift_px, response })
    }
}

impl EdgeMeasurement {
    /// The shift in units of its standard deviation for a noise of one grey level.
    fn normalised_shift(&self) -> f64 {
        self.right[0] / self.matrix[0].sqrt()
    }
}

/// An edge between black and white pixels.
struct Crossing {
    /// Distance from the expected place, towards white.
    shift: f64,
    black: f64,
    contrast: f64,
}

/// Where pixels, sorted from black to white, cross the middle grey value; the crossing nearest to the
/// expected place.
fn crossing(pixels: &[[f64; 2]]) -> Option<Crossing> {
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
    (white - black > 2.0 * MIN_CONTRAST).then_some(Crossing {
        shift: place,
        black,
        contrast: white - black,
    })
}

/// The normal equations of the homography's parameters and the blur.
fn normal_equations(edges: &[EdgeSample]) -> NormalEquations<UNKNOWNS> {
    // Filling all of the symmetric matrix takes no longer than half of it.
    let (mut rows, mut mixed_row, mut spread_sum) = ([[0.0; 8]; 8], [0.0; 8], 0.0);
    let (mut sums, mut right_spread) = ([0.0; 8], 0.0);
    for measurement in edges.iter().filter_map(|edge| edge.measurement.as_ref()) {
        let [shift, mixed, spread] = measurement.matrix.map(|m| measurement.weight * m);
        let right = measurement.right.map(|r| measurement.weight * r);
        let gradient = &measurement.gradient;
        for (row, along) in rows.iter_mut().zip(gradient) {
            let scaled = shift * along;
            for (entry, other) in row.iter_mut().zip(gradient) {
                *entry += scaled * other;
            }
        }
        for ((entry, sum), along) in mixed_row.iter_mut().zip(&mut sums).zip(gradient) {
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
    NormalEquations { matrix, right, cost: 0.0, extra: () }
}

/// The Gauss-Newton step.
fn solve(equations: &NormalEquations<UNKNOWNS>) -> Option<SVector<f64, UNKNOWNS>> {
    equations.step(0.0, 0.0).filter(|step| step.iter().all(|s| s.is_finite()))
}
