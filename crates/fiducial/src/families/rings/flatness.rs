//! Widens a pose's covariance where the edges show that the print is not flat: bent or folded paper, cloth in waves.

use geometry::CameraModel;
use nalgebra::{Matrix6, SMatrix, SVector, Vector3};

use super::circle_pose::{CirclePose, EdgePoint, HUBER_PX, MIN_EDGE_ERROR_PX};
use crate::optics::least_squares::huber;

/// How far prints are bent, as a ratio of the height at the outer circle to its radius (1 sigma).
const BEND: f64 = 0.1;
/// A bend explains so much more than a flat print does by no chance: in squared deviations of an edge point, which with three
/// unknowns one of a thousand flat prints has.
const MIN_BEND: f64 = 16.3;
/// Parts that contradict each other by more, as a ratio of variances, do so by no chance: one of fifty flat prints of which all is
/// seen does in one of five unknowns.
const MAX_CHANCE: f64 = 3.0;
/// Number of parts into which a ring is divided.
const SECTORS: usize = 8;
/// Degrees of freedom needed to measure how far the parts contradict each other; a single ring has fewer.
const MIN_FREE: usize = 8;
/// The parts of three rings.
const PARTS: usize = 3 * SECTORS;
/// Circles that bound a ring.
const CIRCLES_OF_RING: usize = 2;
/// The unknowns of a flat print's pose.
const FLAT: usize = 5;
/// Those and the heights of a bend: a quadratic of the place on the print.
const BENT: usize = FLAT + 3;

impl CirclePose {
    /// The covariance of a pose, centre (m) and rotation vector (rad), that was fitted to a flat print, widened where the
    /// edge points contradict that. The noise of single points, or pixels, hides it.
    ///
    /// A bend (height as a quadratic of the position) may move the pose. Neighbouring points of the print are off together, so
    /// that its parts are independent, not the points (a cluster-robust covariance).
    pub(crate) fn widened_by_form(
        &self,
        covariance: Matrix6<f64>,
        points: &[EdgePoint],
        camera: &CameraModel,
    ) -> Matrix6<f64> {
        let is_flat = self.rms_px(points, camera).is_none_or(|rms_px| rms_px < MIN_EDGE_ERROR_PX);
        let bent = if is_flat { None } else { self.bent(points, camera) };
        let Some(bent) = bent else { return covariance };
        let mut of_step = self.spread_of_parts(points, camera, &bent).unwrap_or_default();
        if bent.explained > MIN_BEND {
            of_step += bent.off * bent.off.transpose();
        }
        let wider = covariance + self.propagated(&of_step);
        if wider.iter().all(|c| c.is_finite()) { wider } else { covariance }
    }

    /// One step of a fit to a print that may be bent, compared with a fit to a flat print.
    fn bent(&self, points: &[EdgePoint], camera: &CameraModel) -> Option<Bent> {
        let plane = self.plane(camera);
        let outer = points.iter().fold(0.0, |max: f64, point| max.max(point.radius));
        let mut matrix = SMatrix::<f64, BENT, BENT>::zeros();
        let mut right = SVector::<f64, BENT>::zeros();
        let mut squares = 0.0;
        for point in points {
            let (residual, by_pose) = plane.residual(point)?;
            let weight = huber(residual, HUBER_PX).weight;
            let [x, y] = plane.place(&point.ray).map(|along| along / outer);
            let [a, b, c, d, e] = by_pose.into();
            // A height moves a place of the print as it moves all of it.
            let by_height = self.normal.dot(&Vector3::new(a, b, c)) * outer;
            let by_bend = [x * x, x * y, y * y].map(|square| by_height * square);
            let row = SVector::from([a, b, c, d, e, by_bend[0], by_bend[1], by_bend[2]]);
            matrix.syger(weight, &row, &row, 1.0);
            right -= row * (weight * residual);
            squares += weight * residual * residual;
        }
        matrix.fill_upper_triangle_with_lower_triangle();
        let free = points.len().checked_sub(BENT).filter(|free| *free > 0)? as f64;
        let right_of_flat: SVector<f64, FLAT> = right.fixed_rows::<FLAT>(0).into();
        let inverse = matrix.fixed_view::<FLAT, FLAT>(0, 0).into_owned().try_inverse()?;
        let flat_step = inverse * right_of_flat;
        let left_by_flat = squares - right_of_flat.dot(&flat_step);
        for i in FLAT..BENT {
            matrix[(i, i)] += left_by_flat / (free * BEND * BEND);
        }
        let step = matrix.try_inverse()? * right;
        let left = squares - right.dot(&step);
        Some(Bent {
            inverse,
            flat_step,
            off: step.fixed_rows::<FLAT>(0) - flat_step,
            explained: (left_by_flat - left) * free / left,
            variance_px2: left_by_flat / free,
        })
    }

    /// The covariance of a step of a flat print's pose by how much its parts contradict each other, where that is more than
    /// the noise of points that are independent.
    fn spread_of_parts(
        &self,
        points: &[EdgePoint],
        camera: &CameraModel,
        bent: &Bent,
    ) -> Option<SMatrix<f64, FLAT, FLAT>> {
        let plane = self.plane(camera);
        let mut pulls = [None::<SVector<f64, FLAT>>; PARTS];
        let circles = points.chunk_by(|a, b| a.radius == b.radius);
        for (index, circle) in circles.enumerate() {
            let ring = index / CIRCLES_OF_RING * SECTORS;
            for point in circle {
                let (residual, by_pose) = plane.residual(point)?;
                let weight = huber(residual, HUBER_PX).weight;
                let [x, y] = plane.place(&point.ray);
                let turn = y.atan2(x) / std::f64::consts::TAU + 0.5;
                let part = ring + ((turn * SECTORS as f64) as usize).min(SECTORS - 1);
                let left = residual + by_pose.dot(&bent.flat_step);
                if let Some(pull) = pulls.get_mut(part) {
                    *pull.get_or_insert_default() -= by_pose * (weight * left);
                }
            }
        }
        let seen = || pulls.iter().flatten();
        let spread = |pull: &SVector<f64, FLAT>| {
            let step = bent.inverse * pull;
            step * step.transpose()
        };
        let count = seen().count();
        let free = count.checked_sub(FLAT).filter(|free| *free >= MIN_FREE)?;
        let few = count as f64 / free as f64;
        let by_parts = seen().map(spread).sum::<SMatrix<f64, FLAT, FLAT>>() * few;
        let by_points = bent.inverse * bent.variance_px2;
        let is_chance = (0..FLAT).all(|i| by_parts[(i, i)] < MAX_CHANCE * by_points[(i, i)]);
        (!is_chance).then_some(by_parts)
    }
}

/// A print that may be bent, compared with a flat one.
struct Bent {
    /// The inverse of the flat print's normal equations.
    inverse: SMatrix<f64, FLAT, FLAT>,
    /// The step to the pose that fits best if the print is flat.
    flat_step: SVector<f64, FLAT>,
    /// From there to the pose that fits best if it is bent.
    off: SVector<f64, FLAT>,
    /// How much more a bend explains, in squared deviations of an edge point.
    explained: f64,
    /// Variance of the edge points about a flat print, in square pixels.
    variance_px2: f64,
}

#[cfg(test)]
mod tests {
    use std::f64::consts::TAU;

    use nalgebra::Vector3;

    use super::*;
    use crate::families::rings::circle_pose::project;

    const RADII: [f64; 6] = [0.0767, 0.0614, 0.0460, 0.0383, 0.0230, 0.0115];

    /// Edge points, with noise of a tenth of a pixel, of the first circles of a marker printed on paper of this height at (x, y),
    /// in metres.
    fn edges(
        pose: &CirclePose,
        camera: &CameraModel,
        (circles, seed): (usize, u64),
        height_m: impl Fn(f64, f64) -> f64,
    ) -> Vec<EdgePoint> {
        let (u, v) = pose.basis();
        let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
        let mut uniform = || {
            // Xorshift (Marsaglia, "Xorshift RNGs", 2003).
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1_u64 << 53) as f64 - 0.5
        };
        let mut of_circles = Vec::new();
        for radius in RADII.into_iter().take(circles) {
            for i in 0..64 {
                let (sin, cos) = (f64::from(i) * TAU / 64.0).sin_cos();
                let off_m = uniform() * 0.34 * pose.centre.z / camera.fx;
                let (x, y) = ((radius + off_m) * cos, (radius + off_m) * sin);
                let point = pose.centre + u * x + v * y + pose.normal * height_m(x, y);
                of_circles.push(EdgePoint { ray: point / point.z, radius, black_inside: true });
            }
        }
        of_circles
    }

    /// The centre's error after the fit to such edges, in pixels; that error squared in units of the covariance of points that
    /// are independent, and of the reported one; and both covariances' ratio.
    fn fitted(
        circles: usize,
        seed: u64,
        height_m: impl Fn(f64, f64) -> f64,
    ) -> (f64, f64, f64, f64) {
        let camera = CameraModel::pinhole(1296, 972, 1818.0);
        let normal = Vector3::new(0.4, 0.2, -1.0).normalize();
        let truth = CirclePose { centre: Vector3::new(0.1, -0.05, 2.0), normal };
        let points = edges(&truth, &camera, (circles, seed), height_m);
        let (found, rms_px) = truth.refined(&points, &camera).unwrap();
        let off = found.centre - truth.centre;
        let seen = project(found.centre, &camera).unwrap();
        let error_px = seen.distance(&project(truth.centre, &camera).unwrap());
        let unit = found.bent(&points, &camera).unwrap().inverse * (rms_px * rms_px);
        let alone = found.propagated(&unit) + Matrix6::identity() * 1e-12;
        let reported = found.widened_by_form(alone, &points, &camera);
        let nees = |all: &Matrix6<f64>| {
            let across = all.fixed_view::<2, 2>(0, 0).into_owned().try_inverse().unwrap();
            off.xy().dot(&(across * off.xy()))
        };
        (error_px, nees(&alone), nees(&reported), reported[(0, 0)] / alone[(0, 0)])
    }

    #[test]
    fn a_flat_print_is_as_sure_as_its_points_are() {
        for circles in [2, 4, 6] {
            const DRAWS: u64 = 500;
            let draws: Vec<_> = (1..=DRAWS).map(|seed| fitted(circles, seed, |_, _| 0.0)).collect();
            let wider = draws.iter().filter(|(.., wider)| *wider > 1.0 + 1e-9).count();
            assert!(wider <= DRAWS as usize / 20, "{circles} circles: {wider} of {DRAWS}");
            let squares: f64 = draws.iter().map(|(_, _, reported, _)| reported).sum();
            let mean = squares / DRAWS as f64;
            assert!((1.6..2.4).contains(&mean), "{circles} circles: {mean}");
        }
    }

    #[test]
    fn the_covariance_of_a_bent_print_covers_its_error() {
        let bend = |height: f64| {
            move |x: f64, y: f64| height * RADII[0] * ((0.6 * x + 0.8 * y) / RADII[0]).powi(2)
        };
        for height in [0.04, 0.1, -0.1] {
            let (error_px, alone, reported, _) = fitted(6, 1, bend(height));
            assert!(error_px > 0.1 && alone > 30.0, "{height}: {error_px} {alone}");
            assert!(reported < 9.2, "{height}: {error_px} {reported}");
        }
    }

    #[test]
    fn the_covariances_of_a_folded_and_a_waved_print_are_wider() {
        let fold = |x: f64, y: f64| 0.06 * (0.6 * x + 0.8 * y).abs();
        let waves = |x: f64, _: f64| 0.02 * RADII[0] * (4.7 * x / RADII[0]).sin();
        for (name, (error_px, alone, reported, wider)) in
            [("fold", fitted(6, 1, fold)), ("waves", fitted(6, 1, waves))]
        {
            assert!(
                wider > 2.0 && reported < 0.5 * alone,
                "{name}: {error_px} {alone} {reported} {wider}"
            );
        }
    }
}
