//! Relates the variance of a fit to its residuals: errors along a side that repeat from pixel to pixel or cancel, and errors that all
//! edges have in common.
//!
//! The residuals of a fit give the variance of a place as if the errors of its pixels were independent. Most errors at edges are not
//! noise, but what the model of a camera's processing leaves, and depend on where an edge crosses a pixel. A side that rises by several
//! rows crosses pixels at all places, so that these errors cancel. A side along the rows crosses all of them at the same place, so that
//! they add up; a side along their diagonals crosses them at few.

use nalgebra::{Matrix2, SMatrix, Vector2};

use crate::optics::homography::{CORNERS, Homography};

/// Variance of a pixel that comes of whole grey levels, in square grey levels; no picture is better than that.
pub(crate) const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

/// Of the shift that a tone curve gives all edges, this fraction differs between the edges that have black outside and those that have it
/// inside. From `positions` of the seeds 1300001 and 1300002: in `industrial`, `usb`, `phone`, `action-camera` and `raspberry-pi`
/// edges are shifted by 0.09, 0.39, 0.39, 0.61 and 0.68 px; half a side is off by 0.03, 0.03, 0.03, 0.05 and 0.06 of that beyond its
/// noise (root mean square).
const FORM_ERROR_OF_SHIFT: f64 = 0.04;

/// The variance of a marker's place in units of that of independent errors, by the direction of its sides.
#[derive(Copy, Clone, Debug)]
pub(crate) struct SideErrors {
    /// Where sides cross many rows and columns.
    across: f64,
    /// What sides along rows or columns have more.
    along_rows: f64,
    /// The same along the pixels' diagonals.
    along_diagonals: f64,
}

/// From `positions` of the seeds 1300001 and 1300002 with six cameras. Where a camera's processing was fitted, squared errors of the
/// centre were 0.5 to 0.85 times those of independent pixels with sides 10 to 40 degrees off the rows, 1.3 to 2.7 times within 2 degrees
/// of the rows and 1 to 1.5 times within 5 degrees of the diagonals. In `linear` they were 0.75 to 1, 1 to 1.6 and 0.8 times. Of edges
/// that were located one by one they were 0.8 to 1.1, 1.3 to 1.7 (within 5 degrees) and 1.1 to 1.9 times those of independent edges.
impl SideErrors {
    /// Of edges, each compared on its own.
    pub(crate) const OF_EDGES: Self = Self { across: 1.0, along_rows: 3.0, along_diagonals: 2.0 };
    /// Of grey values in an image that is linear in light.
    pub(crate) const OF_PIXELS: Self = Self { across: 1.0, along_rows: 1.0, along_diagonals: 0.0 };
    /// The same behind a camera's processing.
    pub(crate) const OF_PROCESSED_PIXELS: Self =
        Self { across: 0.45, along_rows: 3.0, along_diagonals: 1.0 };

    /// The factor of a square's covariance. The rows are those of the pixels: `undistortion` are the derivatives of the ideal image, in
    /// which the square is, by the pixels there.
    pub(crate) fn factor(&self, square: &Homography, undistortion: &Matrix2<f64>) -> f64 {
        let corners = CORNERS.map(|corner| Vector2::from(square.project(corner).image));
        let distortion = undistortion.try_inverse().unwrap_or(Matrix2::identity());
        let of_side = |i: usize| {
            let extent_px = distortion * (corners[(i + 1) % 4] - corners[i]);
            self.factor_of_side(extent_px.into())
        };
        [0, 1, 2, 3].map(of_side).into_iter().sum::<f64>() / 4.0
    }

    /// The same of a single side with this extent, in pixels.
    fn factor_of_side(&self, extent_px: [f64; 2]) -> f64 {
        let [x, y] = extent_px.map(f64::abs);
        // How many rows or columns, and how many diagonals, it crosses.
        let rows = x.min(y);
        let diagonals = (x - y).abs() * std::f64::consts::FRAC_1_SQRT_2;
        self.across
            + self.along_rows / (1.0 + rows * rows)
            + self.along_diagonals / (1.0 + diagonals * diagonals)
    }
}

/// By how much all sides of a marker may be off outwards or inwards together, because a model is not quite the picture.
#[derive(Copy, Clone, Debug)]
pub(crate) struct FormError {
    /// In pixels, with any camera: what the model of an edge leaves where the blur is hardly wider than a pixel.
    edge_px: f64,
    /// As a fraction of tone curve times blur: the form of a camera's tone curve.
    by_curve: f64,
    /// Curves steeper than this add no more.
    max_curve: f64,
}

impl FormError {
    /// Of codes of square cells. From `positions` of the seeds 1300001 and 1300002: in `linear` markers of 10 to 37 px were too
    /// large by 0.001 px, 0.002 px (root mean square) with a stated deviation of 0.001. In `industrial`, whose weak curve is a
    /// power, they were too large by 0.003 px and in `usb` by 0.01; behind the steeper curve of `raspberry-pi`, which is of the
    /// model's form, by no more.
    pub(crate) const SQUARE: Self = Self { edge_px: 0.0007, by_curve: 0.008, max_curve: 1.0 };
    /// Of an STag, whose disc and dots are drawn in small cells, and whose edges are not of both senses everywhere. From the same
    /// frames, and from `positions` of seed 7 in `raspberry-pi`, where STags were too small by 0.025 px beyond their noise.
    pub(crate) const STAG: Self =
        Self { edge_px: 0.0015, by_curve: 0.009, max_curve: f64::INFINITY };

    /// The distance, in pixels, behind a curve and with a blur of these.
    pub(crate) fn distance_px(&self, curve: f64, spread_px: f64) -> f64 {
        self.edge_px.hypot(self.by_curve * curve.abs().min(self.max_curve) * spread_px)
    }
}

/// The distance by which all sides may be off where all edges are shifted by `shift_px`, in pixels.
pub(crate) fn form_error_of_shift_px(shift_px: f64) -> f64 {
    FORM_ERROR_OF_SHIFT * shift_px.abs()
}

/// Adds the uncertainty of a square's size whose sides may all be off by `edge_px` outwards or inwards, in pixels.
pub(crate) fn add_size_error(
    covariance: &mut SMatrix<f64, 8, 8>,
    square: &Homography,
    edge_px: f64,
) {
    let by_size = square.by_scale() * (2.0 * edge_px / square.longest_side_px());
    *covariance += by_size * by_size.transpose();
}

#[cfg(test)]
mod tests {
    use geometry::{CameraModel, Distortion, Pixel};

    use super::*;
    use crate::optics::undistort::Undistortion;

    /// The factor of a square whose first side has this direction, in degrees.
    fn factor(errors: SideErrors, degrees: f64, side_px: f64) -> f64 {
        let (sin, cos) = f64::to_radians(degrees).sin_cos();
        let corners = CORNERS.map(|[a, b]| {
            [a * cos - b * sin, a * sin + b * cos].map(|at| 100.0 + 0.5 * side_px * at)
        });
        let pixels = corners.map(|[x, y]| Pixel::new(x, y));
        let lens = Undistortion::new(None, &pixels).unwrap();
        errors.factor(&lens.homography(&pixels).unwrap(), lens.jacobian())
    }

    #[test]
    fn the_rows_are_those_of_the_image_behind_a_fisheye_as_well() {
        let camera = CameraModel {
            width: 1600,
            height: 1200,
            fx: 500.0,
            fy: 500.0,
            cx: 800.0,
            cy: 600.0,
            distortion: Distortion::KannalaBrandt([0.0; 4]),
        };
        // 25 and 45 degrees off the axis, aside of both of the ideal image's axes.
        for [x, y] in [[175.0, 131.0], [314.0, 236.0]] {
            let corners = CORNERS
                .map(|[a, b]| Pixel::new(camera.cx + x + 15.0 * a, camera.cy + y + 15.0 * b));
            let lens = Undistortion::new(Some(&camera), &corners).unwrap();
            let square = lens.homography(&corners).unwrap();
            let factor = SideErrors::OF_PROCESSED_PIXELS.factor(&square, lens.jacobian());
            assert!((factor - 3.45).abs() < 0.1, "{x} {y}: {factor}");
        }
    }

    #[test]
    fn errors_add_up_along_rows_and_diagonals_and_cancel_between_them() {
        for turn in [0.0, 90.0, 180.0, 270.0] {
            let of = |degrees: f64| factor(SideErrors::OF_PROCESSED_PIXELS, turn + degrees, 30.0);
            assert!((of(0.0) - 3.45).abs() < 0.01, "{}", of(0.0));
            assert!((of(45.0) - 1.45).abs() < 0.01, "{}", of(45.0));
            assert!((0.45..0.55).contains(&of(25.0)), "{}", of(25.0));
            assert!((of(2.0) - of(-2.0)).abs() < 1e-9);
            // It rises by one pixel.
            assert!((of(1.91) - 0.45 - 1.5).abs() < 0.02, "{}", of(1.91));
        }
        let [small, large] = [10.0, 100.0].map(|px| factor(SideErrors::OF_EDGES, 3.0, px));
        assert!(small > 1.5 * large, "{small} {large}");
    }

    #[test]
    fn the_size_of_a_square_is_no_more_certain_than_the_model_of_its_edges() {
        let off = |form: FormError, curve: f64, spread_px: f64| form.distance_px(curve, spread_px);
        assert!((off(FormError::SQUARE, 0.0, 0.7) - 0.0007).abs() < 1e-12);
        assert!((off(FormError::SQUARE, 0.5, 0.7) - 0.0029).abs() < 1e-4);
        assert!(
            (off(FormError::SQUARE, 3.0, 0.7) - off(FormError::SQUARE, 1.0, 0.7)).abs() < 1e-12
        );
        assert!(off(FormError::STAG, 3.0, 0.7) > 2.8 * off(FormError::STAG, 1.0, 0.7));
        assert!((form_error_of_shift_px(-0.4) - 0.016).abs() < 1e-12);
    }
}
