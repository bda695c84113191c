//! Gathers the pixels in and around a three-ring marker, or along its edges, to which the photometric model is fitted, and
//! the mosaics they may come from.

use std::f64::consts::TAU;

use geometry::{CameraModel, Pixel};
use imaging::Ellipse;
use markers::RingKind;
use nalgebra::Vector3;

use super::model::{Effort, Extras, PhotometricInput, UNKNOWNS};
use crate::families::rings::circle_pose::{CirclePose, project};
use crate::optics::edge_response::EdgeResponse;
use crate::optics::mosaic::{Mosaic, phase};

/// Larger markers have edges far enough apart to be located one by one.
pub(crate) const MAX_DIAMETER_PX: f64 = 180.0;
/// With fewer pixels across, rings look like a disc.
const MIN_DIAMETER_PX: f64 = 5.0;
/// Up to this diameter all pixels are used, above it those about the edges.
pub(super) const ALL_PIXELS_PX: f64 = 22.0;
/// Up to this diameter the radii are compared with other rings'.
pub(super) const MAX_RADII_PX: f64 = 48.0;
/// Up to this diameter they are compared with a fit of other rings.
pub(super) const MAX_TARGETS_PX: f64 = 26.0;
/// Approximate number of pixels used of a larger marker.
const EDGE_SAMPLES: f64 = 260.0;
/// Blur of a lens in focus together with the pixel's own extent, as a standard deviation in pixels.
pub(super) const FOCUSED_PX: f64 = 0.6;

/// A pixel that takes part in the fit.
#[derive(Copy, Clone, Debug)]
pub(crate) struct PixelSample {
    pub(super) ray: Vector3<f64>,
    /// Offset from the marker's centre, in pixels.
    pub(super) offset: [f64; 2],
    pub(super) grey: f64,
    /// Which pixel of a colour mosaic it would be ([`phase`]).
    pub(super) phase: u8,
    /// Whether it lies well inside the marker's rim.
    pub(super) inside: bool,
}

/// The data to which a model is fitted.
#[derive(Clone, Copy)]
pub(super) struct Scene<'a> {
    pub(super) samples: &'a [PixelSample],
    /// One of this many samples counts.
    pub(super) stride: usize,
    pub(super) camera: &'a CameraModel,
    /// Radii of the circles in metres, the outermost first, with their logarithms.
    pub(super) radii: [(f64, f64); 6],
    pub(super) edge: EdgeResponse,
    /// Largest residual before each of the first steps.
    pub(super) early_reject: [f64; 3],
    pub(super) effort: Effort,
    pub(super) extras: Extras,
    /// The mosaic from which the pixels were interpolated.
    pub(super) mosaic: Option<Mosaic>,
    /// Whether the radii that fit best are requested.
    pub(super) radii_count: bool,
    /// Whether targets of evenly wide rings are fitted as well.
    pub(super) compares_targets: bool,
    /// Whether a camera's processing is constrained by the prior of ordinary cameras.
    pub(super) has_prior: bool,
}

impl<'a> Scene<'a> {
    pub(super) fn new(
        samples: &'a [PixelSample],
        size_m: f64,
        camera: &'a CameraModel,
        early_reject: [f64; 3],
    ) -> Self {
        let mut radii = [(0.0, 0.0); 6];
        for (pair, kind) in radii.chunks_mut(2).zip(RingKind::ALL) {
            let (inner, outer) = kind.radii();
            for (slot, radius) in pair.iter_mut().zip([outer, inner]) {
                *slot = (radius * size_m, (radius * size_m).ln());
            }
        }
        Self {
            samples,
            stride: 1,
            camera,
            radii,
            edge: EdgeResponse::new(),
            early_reject,
            effort: Effort::FULL,
            extras: Extras::Nothing,
            mosaic: None,
            radii_count: false,
            compares_targets: false,
            has_prior: true,
        }
    }

    /// Number of samples that count.
    pub(super) fn count(&self) -> f64 {
        self.samples.len().div_ceil(self.stride) as f64
    }
}

/// Where samples are taken from.
pub(super) struct SampleSource<'a>(pub(super) PhotometricInput<'a>);

impl SampleSource<'_> {
    /// The two colour mosaics from which the pixels in an outline may be interpolated: by those every other pixel, a green
    /// one, differs more from its neighbours than the others do.
    pub(super) fn mosaics(&self, outline: &Ellipse) -> Option<[Mosaic; 2]> {
        const MIN_RATIO: f64 = 1.5;
        let view = self.0.view;
        let half = outline.major / 2.0;
        let range = |axis: usize, size: usize| {
            let [from, to] = [-half, half].map(|by| (outline.centre[axis] + by).max(1.0) as usize);
            from..to.min(size.saturating_sub(2)) + 1
        };
        let mut squares = [0_i64; 2];
        for y in range(1, view.height()) {
            for x in range(0, view.width()) {
                let at = |x: usize, y: usize| i64::from(view.at(x, y));
                let around = at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1);
                let parity = (x + y) % 2;
                if let Some(sum) = squares.get_mut(parity) {
                    *sum += (4 * at(x, y) - around).pow(2);
                }
            }
        }
        let [even, odd] = squares.map(|sum| sum as f64);
        if odd > MIN_RATIO * even {
            Some([Mosaic { red: 0 }, Mosaic { red: 3 }])
        } else if even > MIN_RATIO * odd {
            Some([Mosaic { red: 1 }, Mosaic { red: 2 }])
        } else {
            None
        }
    }

    /// Takes the pixels in and just around the marker, of a large one those about its edges. False when they
    /// would be the ones that were already taken for a lens in focus.
    pub(super) fn gather(
        &self,
        pose: &CirclePose,
        blur_px: f64,
        samples: &mut Vec<PixelSample>,
    ) -> Option<bool> {
        let PhotometricInput { view, camera, size_m, white_on_black } = self.0;
        let outline = pose.projected(size_m / 2.0, camera)?;
        let middle = project(pose.centre, camera)?;
        let diameter_px = outline.major;
        if !(MIN_DIAMETER_PX..=MAX_DIAMETER_PX).contains(&diameter_px) {
            return None;
        }
        // The paper is white for a ring's width around the marker.
        let reach = |blur_px: f64| (0.6 - 1.5 * blur_px / diameter_px).clamp(0.45, 0.55);
        let focused = reach(FOCUSED_PX).max(0.51);
        let reach = reach(blur_px).min(focused);
        if !samples.is_empty() && (diameter_px > ALL_PIXELS_PX || reach > focused - 0.015) {
            return Some(false);
        }
        samples.clear();
        let mut add = |x: usize, y: usize, inside: bool| {
            let place = [x as f64, y as f64];
            let grey = f64::from(view.at(x, y));
            samples.push(PixelSample {
                ray: camera.unproject_clamped(Pixel::new(place[0], place[1])).coords,
                offset: [place[0] - middle.x, place[1] - middle.y],
                grey: if white_on_black { 255.0 - grey } else { grey },
                phase: phase(x, y),
                inside,
            });
        };
        let size = [view.width(), view.height()];
        if diameter_px > ALL_PIXELS_PX {
            for_each_edge_place(pose, size_m, camera, |place, inside| {
                let [x, y] = place.map(f64::round);
                if x >= 0.0 && y >= 0.0 && x < size[0] as f64 && y < size[1] as f64 {
                    add(x as usize, y as usize, inside);
                }
            });
        } else {
            let around = outline.grown(diameter_px * (2.0 * reach - 1.0));
            let half = around.major / 2.0;
            let bound = |axis: usize| {
                let from = (outline.centre[axis] - half).floor().max(0.0) as usize;
                let to = (outline.centre[axis] + half).ceil() + 1.0;
                from..to.clamp(0.0, size[axis] as f64) as usize
            };
            let (around, rim) = (around.axes(), outline.axes());
            let (rows, columns) = (bound(1), bound(0));
            for y in rows {
                for x in columns.clone() {
                    let place = [x as f64, y as f64];
                    if around.radius_of(place) <= 1.0 {
                        add(x, y, rim.radius_of(place) < 0.95);
                    }
                }
            }
        }
        (samples.len() > 3 * UNKNOWNS).then_some(true)
    }
}

/// Calls `visit` with places across each edge of the marker, all round, and whether they lie inside its rim.
fn for_each_edge_place(
    pose: &CirclePose,
    size_m: f64,
    camera: &CameraModel,
    mut visit: impl FnMut([f64; 2], bool),
) {
    const ACROSS: i32 = 2;
    let px_per_m = camera.fx / pose.centre.z;
    let (u, v) = pose.basis();
    let edges = RingKind::ALL.map(RingKind::radii);
    let total: f64 = edges.iter().map(|(inner, outer)| inner + outer).sum();
    for (index, radius) in edges.iter().flat_map(|(inner, outer)| [outer, inner]).enumerate() {
        let radius = radius * size_m;
        if radius * px_per_m < 2.5 {
            continue;
        }
        let share = radius / (total * size_m);
        let count = (EDGE_SAMPLES * share / f64::from(2 * ACROSS + 1)).ceil() as u32;
        for i in 0..count {
            let turn = (f64::from(i) + 0.37 * index as f64) * TAU / f64::from(count);
            let (sin, cos) = turn.sin_cos();
            let out = u * cos + v * sin;
            let (Some(on), Some(beyond)) = (
                project(pose.centre + out * radius, camera),
                project(pose.centre + out * (radius * 1.001), camera),
            ) else {
                continue;
            };
            let length = on.distance(&beyond);
            for step in -ACROSS..=ACROSS {
                let along = f64::from(step) / length;
                let place = [on.x + (beyond.x - on.x) * along, on.y + (beyond.y - on.y) * along];
                visit(place, index > 0 || step < 0);
            }
        }
    }
}
