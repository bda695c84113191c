//! Where a square marker's corners are, to a hundredth of a pixel.
//!
//! The grey values around a marker's edges say more than any binary outline: the picture of the marker is predicted,
//! with the blur and the light as unknowns, and moved to where it agrees with the image best. All edges count, those
//! between the cells as well. Two ways lead there: where cells are wide, each edge is compared on its own, in light of
//! its own (`profiles`); where the blur of one edge reaches the next, the whole picture is compared (`picture`).
//!
//! Lines are straight only without the lens: the picture is made in the ideal image, and the lens bends places, not
//! images.

use geometry::{CameraModel, Distortion, Pixel, Point};
use imaging::GrayView;
use nalgebra::{Matrix2, SMatrix, SVector};

use crate::candidates::quad::middle;
use crate::refine::edges::{self as profiles, Run};
use crate::refine::pattern::Pattern;
use crate::refine::photometric::{self as picture, Picture};

/// A square marker's corners and what else its picture tells.
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// The corners of the square, in the order in which they were given.
    pub corners: [Pixel; 4],
    /// Joint covariance of the corners (x and y of the first, then of the second, ...), in square pixels.
    pub covariance_px2: SMatrix<f64, 8, 8>,
    /// The image of the square's centre.
    pub centre: Pixel,
    /// Covariance of `centre`, in square pixels.
    pub centre_covariance_px2: Matrix2<f64>,
    /// Standard deviation of the lens' blur, in pixels.
    pub blur_px: f64,
    /// Grey values of black and white where nothing is blurred, in the marker's middle.
    pub black: f64,
    /// See `black`.
    pub white: f64,
    /// Root mean square of the differences between the picture and the image, as a share of the contrast.
    pub residual: f64,
}

/// Working memory of [`refine`].
#[derive(Debug, Default)]
pub struct Scratch {
    pub(crate) runs: Vec<Run>,
    pub(crate) shifts: Vec<f64>,
    pub(crate) spots: Vec<picture::Spot>,
}

impl Scratch {
    /// Makes the buffers as large as markers need.
    pub(crate) fn make_room(&mut self) {
        const MOST: usize = 1024;
        self.runs.clear();
        self.runs.reserve(MOST / 2);
        self.shifts.clear();
        self.shifts.reserve(MOST / 2);
        self.spots.clear();
        self.spots.reserve(2 * MOST);
    }
}

/// Cells narrower than this, in pixels, have edges that blur into each other.
const LEAST_CELL_PX: f64 = 5.5;
/// The same for a single border, beside which there is nothing as fine.
const LEAST_BORDER_PX: f64 = 4.0;
/// Squares smaller than this, in pixels, tell nothing.
const LEAST_SIDE_PX: f64 = 4.0;
/// A corner moves no further than this: pixels, and a share of the shortest side.
const MOST_MOVE: (f64, f64) = (2.0, 0.12);

/// The corners of the square marker whose corners are about at `corners`, clockwise in the image, the first being the
/// top left of `pattern`. Without a camera, lines are taken to be straight in the image. `None` when no such marker is
/// there.
pub fn refine(
    view: GrayView<'_>,
    corners: &[Pixel; 4],
    pattern: &Pattern,
    camera: Option<&CameraModel>,
    scratch: &mut Scratch,
) -> Option<Refined> {
    refine_from((view, corners, false), pattern, camera, scratch)
}

/// As [`refine`], from corners that may be near, to about half a pixel.
pub(crate) fn refine_from(
    (view, corners, are_near): (GrayView<'_>, &[Pixel; 4], bool),
    pattern: &Pattern,
    camera: Option<&CameraModel>,
    scratch: &mut Scratch,
) -> Option<Refined> {
    let lens = Lens::new(camera, corners)?;
    let start = Homography::from_corners(&lens, corners)?;
    let cell_px = start.narrowest_cell_px(pattern.cells());
    let by_profiles = (cell_px >= LEAST_CELL_PX)
        .then(|| profiles::fit(view, &lens, &start, (pattern, are_near), scratch))
        .flatten();
    let fit = match by_profiles {
        Some(fit) => fit,
        None => picture::fit(view, &lens, &start, pattern, scratch)?,
    };
    fit.refined(&lens, corners, start.shortest_side_px())
}

/// Most small cells across a [`Design`].
pub(crate) const MOST_ACROSS: usize = 60;

/// A square picture that is not made of square cells of one colour.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Design<'a> {
    /// Small cells across the square, and around it on each side.
    pub(crate) cells: usize,
    pub(crate) margin: usize,
    /// The share of white in each of them, row by row.
    pub(crate) white: &'a [[f64; MOST_ACROSS]; MOST_ACROSS],
    /// Places on edges, in the square's coordinates, and from there towards white as far as no other edge is.
    pub(crate) edges: &'a [[[f64; 2]; 2]],
    /// How far the square's outline is from the next edge, in sides of the square.
    pub(crate) border: f64,
}

/// The same as [`refine`] for other pictures.
pub(crate) fn refine_design(
    view: GrayView<'_>,
    corners: &[Pixel; 4],
    design: &Design<'_>,
    camera: Option<&CameraModel>,
    scratch: &mut Scratch,
) -> Option<Refined> {
    let lens = Lens::new(camera, corners)?;
    let start = Homography::from_corners(&lens, corners)?;
    let side_px = start.shortest_side_px();
    let by_profiles = (design.border * side_px >= LEAST_BORDER_PX)
        .then(|| profiles::fit_edges(view, &lens, &start, design.edges, scratch))
        .flatten();
    let fit = match by_profiles {
        Some(fit) => fit,
        None => picture::fit_design(view, &lens, &start, design, scratch)?,
    };
    fit.refined(&lens, corners, side_px)
}

/// What both ways end with.
#[derive(Clone, Debug)]
pub(crate) struct Fit {
    pub(crate) homography: Homography,
    /// Of the homography's eight numbers.
    pub(crate) covariance: SMatrix<f64, 8, 8>,
    pub(crate) picture: Picture,
    /// As in [`Refined`].
    pub(crate) residual: f64,
}

impl Fit {
    fn refined(&self, lens: &Lens<'_>, coarse: &[Pixel; 4], side_px: f64) -> Option<Refined> {
        let mut corners = *coarse;
        let mut by_homography = SMatrix::<f64, 8, 8>::zeros();
        let most = MOST_MOVE.0 + MOST_MOVE.1 * side_px;
        for (i, place) in CORNERS.into_iter().enumerate() {
            let (pixel, slopes) = self.seen(lens, place)?;
            if pixel.distance(&coarse[i]) > most {
                return None;
            }
            corners[i] = pixel;
            by_homography.fixed_view_mut::<2, 8>(2 * i, 0).copy_from(&slopes);
        }
        let (centre, slopes) = self.seen(lens, [0.0, 0.0])?;
        let covariance_px2 = by_homography * self.covariance * by_homography.transpose();
        let refined = Refined {
            corners,
            covariance_px2,
            centre,
            centre_covariance_px2: slopes * self.covariance * slopes.transpose(),
            blur_px: self.picture.blur_px(),
            black: self.picture.black,
            white: self.picture.black + self.picture.contrast,
            residual: self.residual,
        };
        refined.covariance_px2.iter().all(|c| c.is_finite()).then_some(refined)
    }

    /// Where a place of the square is seen, and how that changes with the homography.
    fn seen(&self, lens: &Lens<'_>, place: [f64; 2]) -> Option<(Pixel, SMatrix<f64, 2, 8>)> {
        let at = self.homography.at(place);
        let (pixel, bend) = lens.seen(at.ideal)?;
        Some((pixel, bend * at.slopes()))
    }
}

/// The corners of the square in its own coordinates: x right, y down, from -1 to 1.
pub(crate) const CORNERS: [[f64; 2]; 4] = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];

/// The lens: between pixels and the ideal image, which has the same focal length and straight lines.
#[derive(Debug)]
pub(crate) struct Lens<'a> {
    camera: Option<&'a CameraModel>,
    /// A pixel nearby, its place in the ideal image, and the change of the latter with the former.
    near: (Pixel, [f64; 2], Matrix2<f64>),
}

impl<'a> Lens<'a> {
    fn new(camera: Option<&'a CameraModel>, corners: &[Pixel; 4]) -> Option<Self> {
        if !corners.iter().all(|c| c.x.abs() < 1e6 && c.y.abs() < 1e6) {
            return None;
        }
        let middle = middle(corners);
        // A lens model that says nothing of this place helps nobody: lines are then taken to be straight.
        let camera = camera.filter(|camera| {
            camera.distortion != Distortion::None
                && corners.iter().all(|corner| camera.sight(*corner).is_some())
        });
        let mut lens = Self { camera, near: (middle, [middle.x, middle.y], Matrix2::identity()) };
        if let Some(camera) = camera {
            let ray = camera.sight(middle)?;
            lens.near.1 = [camera.fx * ray.x() + camera.cx, camera.fy * ray.y() + camera.cy];
            let (_, bend) = lens.seen(lens.near.1)?;
            lens.near.2 = bend.try_inverse()?;
        }
        Some(lens)
    }

    /// Where a place of the ideal image is seen, and how that changes with the place.
    pub(crate) fn seen(&self, ideal: [f64; 2]) -> Option<(Pixel, Matrix2<f64>)> {
        let Some(camera) = self.camera else {
            return Some((Pixel::new(ideal[0], ideal[1]), Matrix2::identity()));
        };
        let ray = [(ideal[0] - camera.cx) / camera.fx, (ideal[1] - camera.cy) / camera.fy];
        let (pixel, slope) = camera.project_with_jacobian(Point::new(ray[0], ray[1], 1.0))?;
        let bend = Matrix2::new(
            slope[(0, 0)] / camera.fx,
            slope[(0, 1)] / camera.fy,
            slope[(1, 0)] / camera.fx,
            slope[(1, 1)] / camera.fy,
        );
        Some((pixel, bend))
    }

    /// The place in the ideal image of a pixel near the marker.
    #[inline]
    pub(crate) fn ideal(&self, pixel: Pixel) -> Option<[f64; 2]> {
        let (near, ideal, slope) = &self.near;
        let from = |to: [f64; 2], pixel: Pixel, other: Pixel| {
            let (dx, dy) = (pixel.x - other.x, pixel.y - other.y);
            [
                to[0] + slope[(0, 0)] * dx + slope[(0, 1)] * dy,
                to[1] + slope[(1, 0)] * dx + slope[(1, 1)] * dy,
            ]
        };
        let mut at = from(*ideal, pixel, *near);
        let Some(camera) = self.camera else { return Some(at) };
        // The lens hardly changes across a marker, so that each step gains digits.
        for _ in 0..20 {
            let ray = [(at[0] - camera.cx) / camera.fx, (at[1] - camera.cy) / camera.fy];
            let seen = camera.project(Point::new(ray[0], ray[1], 1.0))?;
            let step = (pixel.x - seen.x).abs() + (pixel.y - seen.y).abs();
            at = from(at, pixel, seen);
            if step < 1e-3 {
                return Some(at);
            }
        }
        None
    }

    /// How the ideal image changes with the pixels, near the marker.
    pub(crate) fn slope(&self) -> &Matrix2<f64> {
        &self.near.2
    }
}

/// The square's place in the ideal image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Homography {
    /// The homography's numbers, row by row without the last, which is 1.
    pub(crate) h: [f64; 8],
    /// Places are relative to this one.
    pub(crate) about: [f64; 2],
}

/// A place of the square in the ideal image.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Place {
    pub(crate) ideal: [f64; 2],
    square: [f64; 2],
    relative: [f64; 2],
    depth: f64,
}

impl Homography {
    fn from_corners(lens: &Lens<'_>, corners: &[Pixel; 4]) -> Option<Self> {
        let about = lens.near.1;
        let mut matrix = SMatrix::<f64, 8, 8>::zeros();
        let mut right = SVector::<f64, 8>::zeros();
        for (i, ([a, b], corner)) in CORNERS.iter().zip(corners).enumerate() {
            let [x, y] = lens.ideal(*corner)?;
            let (x, y) = (x - about[0], y - about[1]);
            let rows = [
                [*a, *b, 1.0, 0.0, 0.0, 0.0, -x * a, -x * b],
                [0.0, 0.0, 0.0, *a, *b, 1.0, -y * a, -y * b],
            ];
            for (row, (numbers, value)) in rows.iter().zip([x, y]).enumerate() {
                matrix.row_mut(2 * i + row).copy_from_slice(numbers);
                right[2 * i + row] = value;
            }
        }
        let found = matrix.lu().solve(&right)?;
        let homography = Self { h: found.into(), about };
        (homography.is_sound() && homography.shortest_side_px() >= LEAST_SIDE_PX)
            .then_some(homography)
    }

    /// Whether the square is a convex quad, clockwise in the image, and in front of the camera.
    pub(crate) fn is_sound(&self) -> bool {
        let [h0, h1, _, h3, h4, _, h6, h7] = self.h;
        let finite = self.h.iter().all(|h| h.is_finite());
        // Just beyond the corners as well, for the cells around the square.
        finite && h0 * h4 - h1 * h3 > 0.0 && h6.abs() + h7.abs() < 0.6 && {
            CORNERS.iter().all(|corner| {
                let [a, b] = self.at(*corner).jacobian(self);
                a[0] * b[1] - a[1] * b[0] > 0.0
            })
        }
    }

    /// The place of a point of the square.
    #[inline]
    pub(crate) fn at(&self, [a, b]: [f64; 2]) -> Place {
        let h = &self.h;
        let depth = 1.0 / (h[6] * a + h[7] * b + 1.0);
        let relative = [(h[0] * a + h[1] * b + h[2]) * depth, (h[3] * a + h[4] * b + h[5]) * depth];
        let ideal = [relative[0] + self.about[0], relative[1] + self.about[1]];
        Place { ideal, square: [a, b], relative, depth }
    }

    /// The inverse, row by row.
    pub(crate) fn inverse(&self) -> [f64; 9] {
        let [a, b, c, d, e, f, g, h] = self.h;
        [
            e - f * h,
            c * h - b,
            b * f - c * e,
            f * g - d,
            a - c * g,
            c * d - a * f,
            d * h - e * g,
            b * g - a * h,
            a * e - b * d,
        ]
    }

    /// The homography after a step of its numbers, if that is one.
    pub(crate) fn moved(&self, step: impl Fn(usize) -> f64) -> Option<Self> {
        let mut moved = *self;
        for (i, h) in moved.h.iter_mut().enumerate() {
            *h += step(i);
        }
        moved.is_sound().then_some(moved)
    }

    /// How far the corners are from another's, at most, in pixels.
    pub(crate) fn distance_px(&self, other: &Self) -> f64 {
        let moved = CORNERS.map(|corner| {
            let [a, b] = [self.at(corner).relative, other.at(corner).relative];
            (a[0] - b[0]).hypot(a[1] - b[1])
        });
        moved.into_iter().fold(0.0, f64::max)
    }

    fn sides_px(&self) -> [f64; 4] {
        let corners = CORNERS.map(|corner| self.at(corner).relative);
        [0, 1, 2, 3].map(|i| {
            let (from, to) = (corners[i], corners[(i + 1) % 4]);
            (to[0] - from[0]).hypot(to[1] - from[1])
        })
    }

    pub(crate) fn shortest_side_px(&self) -> f64 {
        self.sides_px().into_iter().fold(f64::INFINITY, f64::min)
    }

    /// Distance between opposite sides of the narrowest cell, in pixels.
    fn narrowest_cell_px(&self, cells: usize) -> f64 {
        let widths = CORNERS.map(|corner| {
            let [a, b] = self.at(corner).jacobian(self);
            let area = (a[0] * b[1] - a[1] * b[0]).abs();
            area / a[0].hypot(a[1]).max(b[0].hypot(b[1]))
        });
        2.0 / cells as f64 * widths.into_iter().fold(f64::INFINITY, f64::min)
    }
}

impl Place {
    /// How the place changes with the square's x and with its y.
    pub(crate) fn jacobian(&self, homography: &Homography) -> [[f64; 2]; 2] {
        let h = &homography.h;
        let by = |i: usize| {
            [
                (h[i] - self.relative[0] * h[6 + i]) * self.depth,
                (h[3 + i] - self.relative[1] * h[6 + i]) * self.depth,
            ]
        };
        [by(0), by(1)]
    }

    /// How the place changes with the homography's numbers.
    pub(crate) fn slopes(&self) -> SMatrix<f64, 2, 8> {
        let x = self.along([1.0, 0.0]);
        let y = self.along([0.0, 1.0]);
        SMatrix::from_fn(|row, column| if row == 0 { x[column] } else { y[column] })
    }

    /// How the place, along a direction, changes with the homography's numbers.
    #[inline]
    pub(crate) fn along(&self, [dx, dy]: [f64; 2]) -> [f64; 8] {
        let d = self.depth;
        let (a, b) = (self.square[0] * d, self.square[1] * d);
        let far = -(dx * self.relative[0] + dy * self.relative[1]);
        [dx * a, dx * b, dx * d, dy * a, dy * b, dy * d, far * a, far * b]
    }
}
