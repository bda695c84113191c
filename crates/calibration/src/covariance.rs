//! How sure a result is, when the errors of one tag's points are not independent.
//!
//! The covariance is a "sandwich" clustered by tag and view: the spread of the sums over each cluster, between two inverses of
//! the equations' matrix (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986). Residuals are
//! smaller than errors, as the fit follows them; each cluster's sum is therefore paired with the sum that it would have had
//! if the fit had not seen it (Kline, Saggio and Solvsten, "Leave-out estimation of variance components", 2020).

use nalgebra::{Matrix6, Vector6};

use crate::board::{Linearised, Shared};
use crate::equations::{Bundle, Cross, Free, Place, SharedMatrix, ViewSums, inverse};

/// What is known about the solved numbers.
pub(crate) struct Certainty {
    pub(crate) covariance: SharedMatrix,
    /// From the place to the minimum: zero but for numbers that were not free there.
    pub(crate) step: Shared,
}

/// The certainty of the free numbers at a minimum; `None` where the views do not determine them.
pub(crate) fn certainty(bundle: &Bundle<'_>, place: &Place, free: &Free) -> Option<Certainty> {
    let reduced = bundle.equations(place).reduced(0.0)?;
    let bread = inverse(&free.masked(&reduced.matrix))?;
    let camera = bundle.camera(&place.shared);
    let mut middle = SharedMatrix::zeros();
    let (mut weights, mut squared_weights) = (0.0, 0.0);
    let equations = bundle.equations(place);
    for (i, (points, pose)) in bundle.views.iter().zip(&place.poses).enumerate() {
        let (Some(view), Some(own)) = (equations.views.get(i), reduced.inverses.get(i)) else {
            continue;
        };
        for tag in points.chunk_by(|a, b| a.tag == b.tag) {
            let mut cluster = Cluster::default();
            for point in tag {
                let Some(linearised) = point.linearised(&camera, &place.shared, pose) else {
                    continue;
                };
                let [x, y] = linearised.residual;
                let weight = bundle.weight(x * x + y * y);
                weights += weight;
                squared_weights += weight * weight;
                cluster.add(&linearised, weight);
            }
            let [seen, unseen] = cluster.scores(&view.cross, &view.matrix, own);
            let [seen, unseen] = [seen, unseen].map(|score| free.masked_vector(&score));
            middle += (seen * unseen.transpose() + unseen * seen.transpose()) * 0.5;
        }
    }
    // The slope of the loss's weight, which the equations leave out.
    let slope = squared_weights / weights;
    let step = bread * free.masked_vector(&reduced.right);
    let covariance = bread * middle * bread / (slope * slope);
    covariance.iter().all(|value| value.is_finite()).then_some(Certainty { covariance, step })
}

/// The sums over the points of one tag in one view.
#[derive(Default)]
struct Cluster {
    shared: Shared,
    sums: ViewSums,
}

impl Cluster {
    fn add(&mut self, point: &Linearised, weight: f64) {
        let [x, y] = point.residual.map(|residual| weight * residual);
        for (i, (u, v)) in point.by_shared[0].iter().zip(&point.by_shared[1]).enumerate() {
            self.shared[i] += u * x + v * y;
        }
        self.sums.add(point, weight);
    }

    /// The gradient by the shared numbers with the view's pose eliminated: as the fit saw it, and as it would have been had
    /// the pose been fitted without this tag.
    fn scores(&self, cross: &Cross, matrix: &Matrix6<f64>, own: &Matrix6<f64>) -> [Shared; 2] {
        let block = self.sums.block();
        let score = |shared: &Shared, pose: &Vector6<f64>| shared - cross * (own * pose);
        let seen = score(&self.shared, &block.right);
        let others = matrix - block.matrix;
        // Where the tag alone determines the pose, nothing is left to compare it with.
        let is_alone = (0..6).any(|i| others[(i, i)] < 1e-6 * matrix[(i, i)]);
        let others = others.cholesky().filter(|_| !is_alone);
        let unseen = others.map(|others| {
            let correction = others.solve(&block.right);
            let pose = block.right + block.matrix * correction;
            score(&(self.shared + block.cross * correction), &pose)
        });
        [seen, unseen.unwrap_or(seen)]
    }
}
