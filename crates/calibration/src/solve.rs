//! Minimises by Levenberg-Marquardt over the numbers that the views share and a pose for each.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3, Vector6};

use crate::board::Shared;
use crate::equations::{Bundle, Equations, Free, Place, inverse};

/// Where Levenberg-Marquardt's steps lead from a place, with the cost there.
pub(crate) struct Minimum {
    pub(crate) place: Place,
    pub(crate) cost: f64,
    /// Whether it ended because nothing was left to gain.
    pub(crate) has_settled: bool,
}

/// Fraction of the cost that a step must gain, or the fit has converged: far below the cost of a thousandth of a standard
/// deviation.
const SETTLED: f64 = 1e-9;
const MAX_DAMPING: f64 = 1e9;

/// The place of least cost that steps lead to.
pub(crate) fn minimise(
    bundle: &Bundle<'_>,
    start: Place,
    free: &Free,
    max_steps: usize,
) -> Minimum {
    let cost = bundle.cost(&start);
    let mut best = Minimum { place: start, cost, has_settled: false };
    let mut damping = 1e-4;
    let mut equations = bundle.equations(&best.place);
    for _ in 0..max_steps {
        let next = step(&equations, &best.place, free, damping).map(|place| {
            let cost = bundle.cost(&place);
            Minimum { place, cost, has_settled: false }
        });
        match next.filter(|next| next.cost <= best.cost) {
            Some(next) => {
                let has_settled = best.cost - next.cost <= SETTLED * best.cost;
                best = next;
                if has_settled {
                    best.has_settled = true;
                    break;
                }
                damping = libm::fmax(damping * 0.1, 1e-12);
                equations = bundle.equations(&best.place);
            }
            None if damping > MAX_DAMPING => {
                best.has_settled = true;
                break;
            }
            None => damping *= 10.0,
        }
    }
    best
}

fn step(equations: &Equations, from: &Place, free: &Free, damping: f64) -> Option<Place> {
    let reduced = equations.reduced(damping)?;
    let shared = inverse(&free.masked(&reduced.matrix))? * free.masked_vector(&reduced.right);
    let mut poses = Vec::with_capacity(from.poses.len());
    for ((pose, view), inverse) in from.poses.iter().zip(&equations.views).zip(&reduced.inverses) {
        let step = inverse * (view.right - view.cross.transpose() * shared);
        poses.push(moved(pose, &step)?);
    }
    let shared = from.shared + shared;
    shared.iter().all(|value| value.is_finite()).then_some(Place { shared, poses })
}

/// The pose after a step: translation, then rotation vector, both in the camera frame.
pub(crate) fn moved(pose: &Isometry3<f64>, step: &Vector6<f64>) -> Option<Isometry3<f64>> {
    let turn = Vector3::new(step[3], step[4], step[5]);
    // No single step may flip the board.
    let turn = turn * (0.5 / libm::fmax(turn.norm(), 0.5));
    step.iter().all(|value| value.is_finite()).then(|| {
        Isometry3::from_parts(
            Translation3::from(pose.translation.vector + step.fixed_rows::<3>(0)),
            UnitQuaternion::from_scaled_axis(turn) * pose.rotation,
        )
    })
}

/// The shared numbers of a camera without distortion.
pub(crate) fn undistorted(focal_px: f64, size: crate::view::ImageSize) -> Shared {
    let mut shared = Shared::zeros();
    (shared[0], shared[1]) = (focal_px, focal_px);
    shared[2] = (f64::from(size.width) - 1.0) / 2.0;
    shared[3] = (f64::from(size.height) - 1.0) / 2.0;
    shared
}
