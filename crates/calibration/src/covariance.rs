//! Computes a result's covariance when the errors of one tag's points are not independent.
//!
//! The covariance is a "sandwich" clustered by tag and view: the spread of the sums over each cluster, between two inverses of
//! the equations' matrix (Liang and Zeger, "Longitudinal data analysis using generalized linear models", 1986). Residuals are
//! smaller than errors, as the fit follows them; each cluster's sum is therefore paired with the sum that it would have had
//! if the fit had not seen it (Kline, Saggio and Solvsten, "Leave-out estimation of variance components", 2020).

use nalgebra::{Matrix6, Vector6};

use crate::board::{Linearised, Shared};
use crate::equations::{Bundle, Cross, Free, Place, Reduced, SharedMatrix, ViewSums, inverse};

/// The covariance of all shared numbers at a minimum, free or fixed.
pub(crate) struct Information {
    reduced: Reduced,
    /// The spread of the clusters' sums, with the slope of the loss's weight that the equations leave out.
    middle: SharedMatrix,
}

/// The information on the free numbers.
pub(crate) struct Certainty {
    pub(crate) covariance: SharedMatrix,
    /// From the place to the minimum: zero but for numbers that were not free there.
    pub(crate) step: Shared,
}

impl Information {
    /// The information at these values; `None` where the views do not determine their poses.
    pub(crate) fn new(bundle: &Bundle<'_>, place: &Place) -> Option<Self> {
        let equations = bundle.equations(place);
        let reduced = equations.reduced(0.0)?;
        let camera = bundle.camera(&place.shared);
        let mut middle = SharedMatrix::zeros();
        let (mut weights, mut squared_weights) = (0.0, 0.0);
        let blocks = equations.views.iter().zip(&reduced.inverses);
        for ((points, pose), (view, own)) in bundle.views.iter().zip(&place.poses).zip(blocks) {
            for tag in points.chunk_by(|a, b| a.tag == b.tag) {
                let mut cluster = Cluster::default();
                for point in tag {
                    if let Some(linearised) = point.linearised(&camera, &place.shared, pose) {
                        let [x, y] = linearised.residual;
                        let weight = bundle.weight(x * x + y * y);
                        weights += weight;
                        squared_weights += weight * weight;
                        cluster.add(&linearised, weight);
                    }
                }
                let [seen, unseen] = cluster.scores(&view.cross, &view.matrix, own);
                middle += (seen * unseen.transpose() + unseen * seen.transpose()) * 0.5;
            }
        }
        let slope = squared_weights / weights;
        Some(Self { reduced, middle: middle / (slope * slope) })
    }

    /// The certainty of the free numbers; `None` where the views do not determine them.
    pub(crate) fn certainty(&self, free: &Free) -> Option<Certainty> {
        let bread = inverse(&free.masked(&self.reduced.matrix))?;
        let bread = bread.map_with_location(|i, j, value| {
            // Numbers that are not free have no part in the others.
            if free.0[i] && free.0[j] { value } else { 0.0 }
        });
        let covariance = bread * self.middle * bread;
        let step = bread * self.reduced.right;
        covariance.iter().all(|value| value.is_finite()).then_some(Certainty { covariance, step })
    }
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
