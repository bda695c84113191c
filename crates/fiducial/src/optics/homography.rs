//! Computes the homography from a marker's plane to the image, its inverse and its derivatives.

use geometry::homography::PlanePair;
use imaging::GrayView;
use nalgebra::{SMatrix, SVector};

/// Corners of a square in its own coordinates: x right, y down, from -1 to 1, clockwise from the top left.
pub(crate) const CORNERS: [[f64; 2]; 4] = [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]];

/// Projective map from a plane to the image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Homography {
    /// Its parameters, row by row; the ninth is 1.
    pub(crate) h: [f64; 8],
    /// Image point that the parameters are relative to, for better conditioning.
    pub(crate) origin: [f64; 2],
}

/// Image of a point of the plane.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Projected {
    pub(crate) image: [f64; 2],
    plane: [f64; 2],
    /// `image` relative to the homography's origin.
    relative: [f64; 2],
    inverse_depth: f64,
}

impl Homography {
    /// The map of the square from `min` to `max` on both axes to a quad, both clockwise from the top left, in
    /// closed form (Heckbert, "Fundamentals of texture mapping", 1989). `None` when the corners lie on a
    /// line.
    pub(crate) fn from_square([min, max]: [f64; 2], corners: &[[f64; 2]; 4]) -> Option<Self> {
        let [[x0, y0], [x1, y1], [x2, y2], [x3, y3]] = *corners;
        let (dx1, dx2, dx3) = (x1 - x2, x3 - x2, x0 - x1 + x2 - x3);
        let (dy1, dy2, dy3) = (y1 - y2, y3 - y2, y0 - y1 + y2 - y3);
        let determinant = dx1 * dy2 - dx2 * dy1;
        let g = (dx3 * dy2 - dx2 * dy3) / determinant;
        let h = (dx1 * dy3 - dx3 * dy1) / determinant;
        let side = max - min;
        let rows = [
            [(x1 - x0 + g * x1) / side, (x3 - x0 + h * x3) / side, x0],
            [(y1 - y0 + g * y1) / side, (y3 - y0 + h * y3) / side, y0],
            [g / side, h / side, 1.0],
        ];
        // From the unit square's corner to the plane's origin.
        let [[a, b, c], [d, e, f], [g, h, i]] = rows.map(|[x, y, one]| [x, y, one - (x + y) * min]);
        let h = [a / i, b / i, c / i, d / i, e / i, f / i, g / i, h / i];
        h.iter().all(|h| h.is_finite()).then_some(Self { h, origin: [0.0; 2] })
    }

    /// The map that fits pairs of a plane's point and its image best, algebraically; the image points are
    /// relative to `origin`. `None` when they do not determine it.
    pub(crate) fn from_points(
        pairs: impl Iterator<Item = [[f64; 2]; 2]>,
        origin: [f64; 2],
    ) -> Option<Self> {
        let pairs = pairs.map(|[plane, image]| PlanePair { plane, image });
        geometry::homography(pairs).map(|h| Self { h, origin })
    }

    /// The image of a point of the plane.
    #[inline]
    pub(crate) fn project(&self, [a, b]: [f64; 2]) -> Projected {
        let h = &self.h;
        let inverse_depth = 1.0 / (h[6] * a + h[7] * b + 1.0);
        let relative = [
            (h[0] * a + h[1] * b + h[2]) * inverse_depth,
            (h[3] * a + h[4] * b + h[5]) * inverse_depth,
        ];
        let image = [relative[0] + self.origin[0], relative[1] + self.origin[1]];
        Projected { image, plane: [a, b], relative, inverse_depth }
    }

    /// As [`Homography::project`]; `None` on the horizon and beyond it.
    pub(crate) fn project_visible(&self, plane: [f64; 2]) -> Option<[f64; 2]> {
        let projected = self.project(plane);
        (projected.inverse_depth > 0.0 && projected.inverse_depth < 1e3).then_some(projected.image)
    }

    /// Whether the square is a convex quad, clockwise in the image, and in front of the camera.
    pub(crate) fn is_valid(&self) -> bool {
        let [h0, h1, _, h3, h4, _, h6, h7] = self.h;
        let finite = self.h.iter().all(|h| h.is_finite());
        // The bound of 0.6 keeps the cells around the square in front of the camera as well.
        finite && h0 * h4 - h1 * h3 > 0.0 && h6.abs() + h7.abs() < 0.6 && {
            CORNERS.iter().all(|corner| {
                let [a, b] = self.project(*corner).jacobian(self);
                a[0] * b[1] - a[1] * b[0] > 0.0
            })
        }
    }

    /// From image points, relative to the origin, to the plane.
    pub(crate) fn inverse(&self) -> Inverse {
        let [a, b, c, d, e, f, g, h] = self.h;
        Inverse([
            e - f * h,
            c * h - b,
            b * f - c * e,
            f * g - d,
            a - c * g,
            c * d - a * f,
            d * h - e * g,
            b * g - a * h,
            a * e - b * d,
        ])
    }

    /// The homography after a step of its parameters; `None` where it is not valid.
    pub(crate) fn stepped(&self, step: impl Fn(usize) -> f64) -> Option<Self> {
        let mut stepped = *self;
        for (i, h) in stepped.h.iter_mut().enumerate() {
            *h += step(i);
        }
        stepped.is_valid().then_some(stepped)
    }

    /// Derivatives of the parameters by the relative size of the square.
    pub(crate) fn by_scale(&self) -> SVector<f64, 8> {
        let [a, b, _, d, e, _, g, h] = self.h;
        SVector::from([a, b, 0.0, d, e, 0.0, g, h])
    }

    /// Largest distance between a corner of this and of another square, in pixels.
    pub(crate) fn distance_px(&self, other: &Self) -> f64 {
        let distances = CORNERS.map(|corner| {
            let [a, b] = [self.project(corner).relative, other.project(corner).relative];
            (a[0] - b[0]).hypot(a[1] - b[1])
        });
        distances.into_iter().fold(0.0, f64::max)
    }

    /// Shortest side of the square, in pixels.
    pub(crate) fn shortest_side_px(&self) -> f64 {
        self.sides_px().into_iter().fold(f64::INFINITY, f64::min)
    }

    /// Longest side of the square, in pixels.
    pub(crate) fn longest_side_px(&self) -> f64 {
        self.sides_px().into_iter().fold(0.0, f64::max)
    }

    fn sides_px(&self) -> [f64; 4] {
        let corners = CORNERS.map(|corner| self.project(corner).relative);
        [0, 1, 2, 3].map(|i| {
            let (from, to) = (corners[i], corners[(i + 1) % 4]);
            (to[0] - from[0]).hypot(to[1] - from[1])
        })
    }

    /// Distance between opposite sides of the narrowest of the square's cells, in pixels.
    pub(crate) fn narrowest_cell_px(&self, cells: usize) -> f64 {
        let widths = CORNERS.map(|corner| {
            let [a, b] = self.project(corner).jacobian(self);
            let area = (a[0] * b[1] - a[1] * b[0]).abs();
            area / a[0].hypot(a[1]).max(b[0].hypot(b[1]))
        });
        2.0 / cells as f64 * widths.into_iter().fold(f64::INFINITY, f64::min)
    }
}

impl Projected {
    /// Derivatives of the image point by the plane's x and by its y.
    pub(crate) fn jacobian(&self, homography: &Homography) -> [[f64; 2]; 2] {
        let h = &homography.h;
        let by = |i: usize| {
            [
                (h[i] - self.relative[0] * h[6 + i]) * self.inverse_depth,
                (h[3 + i] - self.relative[1] * h[6 + i]) * self.inverse_depth,
            ]
        };
        [by(0), by(1)]
    }

    /// Derivatives of the image point by the homography's parameters.
    pub(crate) fn parameter_jacobian(&self) -> SMatrix<f64, 2, 8> {
        let x = self.parameter_gradient([1.0, 0.0]);
        let y = self.parameter_gradient([0.0, 1.0]);
        SMatrix::from_fn(|row, column| if row == 0 { x[column] } else { y[column] })
    }

    /// Derivatives of the image point's component along a direction by the homography's parameters.
    #[inline]
    pub(crate) fn parameter_gradient(&self, [dx, dy]: [f64; 2]) -> [f64; 8] {
        let d = self.inverse_depth;
        let (a, b) = (self.plane[0] * d, self.plane[1] * d);
        let far = -(dx * self.relative[0] + dy * self.relative[1]);
        [dx * a, dx * b, dx * d, dy * a, dy * b, dy * d, far * a, far * b]
    }
}

/// Projective map from the image to a plane, row by row.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Inverse([f64; 9]);

impl Inverse {
    /// The point of the plane seen at an image point.
    #[inline]
    pub(crate) fn plane(&self, image: [f64; 2]) -> [f64; 2] {
        self.plane_and_scale(image).0
    }

    /// The same, with the scale that [`Inverse::jacobian`] needs.
    #[inline]
    pub(crate) fn plane_and_scale(&self, [x, y]: [f64; 2]) -> ([f64; 2], f64) {
        let i = &self.0;
        let scale = 1.0 / (i[6] * x + i[7] * y + i[8]);
        ([(i[0] * x + i[1] * y + i[2]) * scale, (i[3] * x + i[4] * y + i[5]) * scale], scale)
    }

    /// Derivatives of the plane's x, and of its y, by the image point, times a factor that `scale` includes.
    #[inline]
    pub(crate) fn jacobian(&self, [a, b]: [f64; 2], scale: f64) -> [[f64; 2]; 2] {
        let i = &self.0;
        [
            [(i[0] - a * i[6]) * scale, (i[1] - a * i[7]) * scale],
            [(i[3] - b * i[6]) * scale, (i[4] - b * i[7]) * scale],
        ]
    }

    /// How many units of the plane a pixel is wide along both of the plane's axes, at a point of the image.
    pub(crate) fn units_per_pixel(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [u0, v0] = self.plane([x, y]);
        let [u1, v1] = self.plane([x + 1.0, y]);
        let [u2, v2] = self.plane([x, y + 1.0]);
        [(u1 - u0).hypot(u2 - u0), (v1 - v0).hypot(v2 - v0)]
    }
}

/// First column and row of the pixels among these points, then the last ones, within the image.
pub(crate) fn pixel_bounds(points: &[[f64; 2]; 4], view: GrayView<'_>) -> [usize; 4] {
    let bounds = |axis: usize, size: usize| {
        let low = points.iter().map(|p| p[axis]).fold(f64::MAX, f64::min);
        let high = points.iter().map(|p| p[axis]).fold(f64::MIN, f64::max);
        let last = size as f64 - 1.0;
        [low.ceil().clamp(0.0, last) as usize, high.floor().clamp(0.0, last) as usize]
    };
    let [left, right] = bounds(0, view.width());
    let [top, bottom] = bounds(1, view.height());
    [left, top, right, bottom]
}

#[cfg(test)]
mod tests {
    use super::*;

    const QUAD: [[f64; 2]; 4] = [[12.0, 7.0], [61.0, 14.0], [55.0, 70.0], [4.0, 52.0]];

    #[test]
    fn the_derivative_by_scale_is_that_of_a_larger_square() {
        // A square that is larger by a millionth shows the quad where its own coordinates are that much smaller.
        let [own, larger] =
            [1.0, 1.0 - 1e-6].map(|half| Homography::from_square([-half, half], &QUAD).unwrap());
        for (i, by_scale) in own.by_scale().iter().enumerate() {
            let step = (larger.h[i] - own.h[i]) / 1e-6;
            assert!((step - by_scale).abs() < 1e-3, "{i}: {step} {by_scale}");
        }
    }

    #[test]
    fn corners_map_to_corners_and_back() {
        for range in [[-1.0, 1.0], [0.0, 1.0], [0.0, 8.0]] {
            let homography = Homography::from_square(range, &QUAD).unwrap();
            let inverse = homography.inverse();
            for (corner, expected) in CORNERS.iter().zip(QUAD) {
                let plane = corner.map(|at| range[0] + (at + 1.0) / 2.0 * (range[1] - range[0]));
                let image = homography.project(plane).image;
                let back = inverse.plane(image);
                for axis in 0..2 {
                    assert!((image[axis] - expected[axis]).abs() < 1e-9);
                    assert!((back[axis] - plane[axis]).abs() < 1e-9);
                }
            }
        }
        assert_eq!(Homography::from_square([0.0, 1.0], &[[3.0, 3.0]; 4]), None);
    }

    #[test]
    fn points_and_corners_give_the_same_homography() {
        let origin = [30.0, 40.0];
        let pairs = CORNERS.into_iter().zip(QUAD);
        let pairs = pairs.map(|(plane, [x, y])| [plane, [x - origin[0], y - origin[1]]]);
        let fitted = Homography::from_points(pairs, origin).unwrap();
        let exact = Homography::from_square([-1.0, 1.0], &QUAD).unwrap();
        assert!(fitted.distance_px(&Homography { origin, ..fitted }) < 1e-12);
        for plane in [[0.0, 0.0], [0.3, -0.8], [1.2, 1.1]] {
            let [a, b] = [fitted, exact].map(|homography| homography.project(plane).image);
            assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-6);
        }
    }

    #[test]
    fn derivatives_are_those_of_the_projection() {
        let homography = Homography::from_square([-1.0, 1.0], &QUAD).unwrap();
        let plane = [0.4, -0.3];
        let at = homography.project(plane);
        let jacobian = at.parameter_jacobian();
        for parameter in 0..8 {
            let mut moved = homography;
            moved.h[parameter] += 1e-6;
            let image = moved.project(plane).image;
            for axis in 0..2 {
                let slope = (image[axis] - at.image[axis]) / 1e-6;
                assert!((slope - jacobian[(axis, parameter)]).abs() < 1e-3 * slope.abs().max(1.0));
            }
        }
        let [by_x, _] = at.jacobian(&homography);
        let image = homography.project([plane[0] + 1e-6, plane[1]]).image;
        assert!(((image[0] - at.image[0]) / 1e-6 - by_x[0]).abs() < 1e-3);
    }
}
