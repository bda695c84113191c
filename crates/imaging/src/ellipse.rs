//! Fits an ellipse to points by least squares; its axes, area, eccentricity, points along it and distance in
//! units of it.

use std::f64::consts::PI;

/// An ellipse in an image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Ellipse {
    /// Its centre (x, y) in pixels.
    pub centre: [f64; 2],
    /// Whole length of its minor axis, in pixels (a in the thesis).
    pub minor: f64,
    /// Whole length of its major axis, in pixels (b in the thesis).
    pub major: f64,
    /// From the image's x axis to the minor axis, turning from x to y, in radians from 0 to pi (OpenCV's
    /// angle).
    pub angle: f64,
}

impl Ellipse {
    /// Its area in square pixels (Equation 3.4).
    pub fn area(&self) -> f64 {
        self.minor * self.major * PI / 4.0
    }

    /// Its eccentricity (Equation 3.8), 0 for a circle.
    pub fn eccentricity(&self) -> f64 {
        (self.major * self.major - self.minor * self.minor).max(0.0).sqrt() / self.major
    }

    /// The ellipse with both axes longer by `by_px` pixels.
    pub fn grown(&self, by_px: f64) -> Self {
        Self { minor: self.minor + by_px, major: self.major + by_px, ..*self }
    }

    /// The point at the parameter `t` (radians; 0 and pi are the ends of the minor axis).
    pub fn at(&self, t: f64) -> [f64; 2] {
        let (sin, cos) = t.sin_cos();
        self.axes().at([sin, cos])
    }

    /// Distance from the centre in units of the ellipse: 1 on it, less inside.
    pub fn radius_of(&self, point: [f64; 2]) -> f64 {
        self.axes().radius_of(point)
    }

    /// Its half axes, prepared for many points.
    pub fn axes(&self) -> Axes {
        let (sin, cos) = self.angle.sin_cos();
        let (minor, major) = (self.minor / 2.0, self.major / 2.0);
        Axes { centre: self.centre, direction: [cos, sin], lengths: [minor, major] }
    }
}

/// The half axes of an ellipse.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Axes {
    /// The ellipse's centre, in pixels.
    centre: [f64; 2],
    /// Unit vector along the minor axis.
    direction: [f64; 2],
    /// Half of the minor and of the major axis, in pixels.
    lengths: [f64; 2],
}

impl Axes {
    /// As [`Ellipse::at`], for the sine and cosine of the parameter.
    #[inline]
    pub fn at(&self, [sin, cos]: [f64; 2]) -> [f64; 2] {
        let (along_minor, along_major) = (self.lengths[0] * cos, self.lengths[1] * sin);
        let [cos, sin] = self.direction;
        [
            self.centre[0] + along_minor * cos - along_major * sin,
            self.centre[1] + along_minor * sin + along_major * cos,
        ]
    }

    /// As [`Ellipse::radius_of`].
    #[inline]
    pub fn radius_of(&self, point: [f64; 2]) -> f64 {
        let (dx, dy) = (point[0] - self.centre[0], point[1] - self.centre[1]);
        let [cos, sin] = self.direction;
        let along_minor = (dx * cos + dy * sin) / self.lengths[0];
        let along_major = (dy * cos - dx * sin) / self.lengths[1];
        (along_minor * along_minor + along_major * along_major).sqrt()
    }
}

/// The ellipse through points by algebraic least squares, as OpenCV's `fitEllipse`: first all five
/// coefficients of the conic, which give the centre, then the three of second degree about that centre.
/// `None` for fewer than five points, and when the conic is not an ellipse.
pub fn fit_ellipse<I>(points: I) -> Option<Ellipse>
where
    I: Iterator<Item = [f64; 2]> + Clone,
{
    let (mean, scale) = spread(points.clone())?;
    let scaled = points.map(|[x, y]| [(x - mean[0]) * scale, (y - mean[1]) * scale]);
    let [a, b, c, d, e] = least_squares(scaled.clone().map(|[x, y]| [x * x, y * y, x * y, x, y]))?;
    let [cx, cy] = solve([[2.0 * a, c], [c, 2.0 * b]], [-d, -e])?;
    let about = scaled.map(|[x, y]| {
        let (x, y) = (x - cx, y - cy);
        [x * x, y * y, x * y]
    });
    let [a, b, c] = least_squares(about)?;
    // The larger eigenvalue belongs to the shorter axis.
    let middle = (a + b) / 2.0;
    let half_gap = ((a - b) / 2.0).hypot(c / 2.0);
    let (small, large) = (middle - half_gap, middle + half_gap);
    if !(small > 0.0 && large.is_finite()) {
        return None;
    }
    let ellipse = Ellipse {
        centre: [cx / scale + mean[0], cy / scale + mean[1]],
        minor: 2.0 / large.sqrt() / scale,
        major: 2.0 / small.sqrt() / scale,
        angle: (0.5 * c.atan2(a - b)).rem_euclid(PI),
    };
    ellipse.major.is_finite().then_some(ellipse)
}

/// Mean of at least five points, and the factor that brings their mean distance from it to 1.
fn spread(points: impl Iterator<Item = [f64; 2]> + Clone) -> Option<([f64; 2], f64)> {
    let (mut count, mut sum) = (0_u32, [0.0, 0.0]);
    for [x, y] in points.clone() {
        count += 1;
        sum = [sum[0] + x, sum[1] + y];
    }
    if count < 5 {
        return None;
    }
    let mean = sum.map(|s| s / f64::from(count));
    let size: f64 = points.map(|[x, y]| (x - mean[0]).abs() + (y - mean[1]).abs()).sum();
    let scale = f64::from(count) / size;
    scale.is_finite().then_some((mean, scale))
}

/// The coefficients whose products with each row are closest to 1, by the normal equations.
fn least_squares<const N: usize>(rows: impl Iterator<Item = [f64; N]>) -> Option<[f64; N]> {
    let mut normal = [[0.0; N]; N];
    let mut right = [0.0; N];
    for row in rows {
        for ((line, sum), a) in normal.iter_mut().zip(&mut right).zip(row) {
            for (entry, b) in line.iter_mut().zip(row) {
                *entry += a * b;
            }
            *sum += a;
        }
    }
    solve(normal, right)
}

/// Solves linear equations by Gaussian elimination with partial pivoting; `None` when they are singular.
fn solve<const N: usize>(mut matrix: [[f64; N]; N], mut right: [f64; N]) -> Option<[f64; N]> {
    let largest = matrix.iter().flatten().fold(0.0_f64, |max, entry| max.max(entry.abs()));
    for column in 0..N {
        let pivot = (column..N)
            .max_by(|i, j| matrix[*i][column].abs().total_cmp(&matrix[*j][column].abs()))?;
        matrix.swap(column, pivot);
        right.swap(column, pivot);
        let head = matrix[column][column];
        if head.is_nan() || head.abs() <= largest * 1e-13 {
            return None;
        }
        for row in column + 1..N {
            let factor = matrix[row][column] / head;
            let upper = matrix[column];
            for (entry, above) in matrix[row].iter_mut().zip(upper).skip(column) {
                *entry -= factor * above;
            }
            right[row] -= factor * right[column];
        }
    }
    let mut solution = [0.0; N];
    for row in (0..N).rev() {
        let known: f64 = (row + 1..N).map(|k| matrix[row][k] * solution[k]).sum();
        solution[row] = (right[row] - known) / matrix[row][row];
    }
    Some(solution)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn points_of(ellipse: Ellipse, count: u32) -> impl Iterator<Item = [f64; 2]> + Clone {
        (0..count).map(move |i| ellipse.at(f64::from(i) * 2.0 * PI / f64::from(count)))
    }

    proptest! {
        #[test]
        fn an_ellipse_is_recovered_from_its_points(
            x in -100.0..5000.0f64, y in -100.0..5000.0f64,
            minor in 3.0..1000.0f64, ratio in 1.05..4.0f64, angle in 0.0..PI, count in 6_u32..200,
        ) {
            let ellipse = Ellipse { centre: [x, y], minor, major: minor * ratio, angle };
            let found = fit_ellipse(points_of(ellipse, count)).unwrap();
            prop_assert!((found.centre[0] - x).hypot(found.centre[1] - y) < 1e-5 * minor);
            prop_assert!((found.minor - minor).abs() < 1e-5 * minor);
            prop_assert!((found.major - ellipse.major).abs() < 1e-5 * ellipse.major);
            prop_assert!((2.0 * (found.angle - angle)).sin().abs() < 1e-4);
        }
    }

    #[test]
    fn points_without_an_ellipse_give_none() {
        let fit = |points: &[[f64; 2]]| fit_ellipse(points.iter().copied());
        assert_eq!(fit(&[[0.0, 0.0]; 9]), None);
        assert_eq!(fit(&[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]), None);
        let line: Vec<_> = (0..20).map(|i| [f64::from(i), 2.0 * f64::from(i)]).collect();
        assert_eq!(fit(&line), None);
        let hyperbola: Vec<_> =
            (-9..=9).map(|i| [f64::from(i), f64::from(i * i + 9).sqrt() + 40.0]).collect();
        assert_eq!(fit(&hyperbola), None);
        assert_eq!(fit(&[[f64::NAN, 0.0]; 6]), None);
    }
}
