//! Builds the normal equations of a bundle: the numbers that the views share, and a pose for each.
//!
//! Each view's pose meets the shared numbers in its own block only, so the poses are eliminated one by one (Schur complement;
//! Triggs et al., "Bundle adjustment: a modern synthesis", 2000, section 6.1), and a small system is left.

use geometry::CameraModel;
use nalgebra::{Isometry3, Matrix6, SMatrix, Vector6};

use crate::board::{BoardPoint, Linearised, SHARED, Shared};
use crate::lens::{INTRINSICS, Lens};
use crate::view::ImageSize;

/// A matrix over the shared numbers.
pub(crate) type SharedMatrix = SMatrix<f64, SHARED, SHARED>;
/// The block between the shared numbers and a pose.
pub(crate) type Cross = SMatrix<f64, SHARED, 6>;

/// The unknowns.
#[derive(Clone, Debug)]
pub(crate) struct Place {
    pub(crate) shared: Shared,
    pub(crate) poses: Vec<Isometry3<f64>>,
}

/// The cost that is minimised: the points of each view, and the loss of their residuals.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Bundle<'a> {
    pub(crate) lens: Lens,
    pub(crate) size: ImageSize,
    pub(crate) views: &'a [Vec<BoardPoint>],
    /// Residuals beyond this lose influence: the scale of Cauchy's loss.
    pub(crate) scale_px: f64,
    /// The standard deviation that is expected of the bend, in metres, so that boards without information about it stay flat.
    pub(crate) bend_m: f64,
}

/// A view's part of the equations.
#[derive(Clone, Debug)]
pub(crate) struct ViewBlock {
    pub(crate) matrix: Matrix6<f64>,
    pub(crate) cross: Cross,
    pub(crate) right: Vector6<f64>,
}

/// The equations at a place.
#[derive(Clone, Debug)]
pub(crate) struct Equations {
    pub(crate) matrix: SharedMatrix,
    pub(crate) right: Shared,
    pub(crate) views: Vec<ViewBlock>,
}

impl Bundle<'_> {
    pub(crate) fn camera(&self, shared: &Shared) -> CameraModel {
        let mut numbers = [0.0; INTRINSICS];
        for (number, value) in numbers.iter_mut().zip(shared.iter()) {
            *number = *value;
        }
        self.lens.camera(self.size, &numbers)
    }

    /// The weight of a residual with this square.
    pub(crate) fn weight(&self, square: f64) -> f64 {
        1.0 / (1.0 + square / (self.scale_px * self.scale_px))
    }

    fn loss(&self, square: f64) -> f64 {
        let scale = self.scale_px * self.scale_px;
        scale * libm::log1p(square / scale)
    }

    /// The sum of all losses. A point that the camera does not show costs as much as one at the image's other end.
    pub(crate) fn cost(&self, place: &Place) -> f64 {
        let camera = self.camera(&place.shared);
        let lost = self.loss(f64::from(self.size.width) * f64::from(self.size.width));
        let mut cost = self.bend_cost(&place.shared);
        for (points, pose) in self.views.iter().zip(&place.poses) {
            for point in points {
                cost += match point.residual(&camera, &place.shared, pose) {
                    Some([x, y]) => self.loss(x * x + y * y),
                    None => lost,
                };
            }
        }
        cost
    }

    fn bend_cost(&self, shared: &Shared) -> f64 {
        let bend = shared.fixed_rows::<2>(crate::board::BEND) / self.bend_m;
        bend.norm_squared()
    }

    /// The equations at a place.
    pub(crate) fn equations(&self, place: &Place) -> Equations {
        let camera = self.camera(&place.shared);
        let mut sums = Sums::default();
        let mut views = Vec::with_capacity(self.views.len());
        for (points, pose) in self.views.iter().zip(&place.poses) {
            let mut view = ViewSums::default();
            for point in points {
                if let Some(linearised) = point.linearised(&camera, &place.shared, pose) {
                    let [x, y] = linearised.residual;
                    let weight = self.weight(x * x + y * y);
                    sums.add(&linearised, weight);
                    view.add(&linearised, weight);
                }
            }
            views.push(view.block());
        }
        let mut matrix = SharedMatrix::from_fn(|i, j| sums.matrix[i.max(j)][i.min(j)]);
        let mut right = Shared::from(sums.right);
        for i in [crate::board::BEND, crate::board::BEND + 1] {
            let information = 1.0 / (self.bend_m * self.bend_m);
            matrix[(i, i)] += information;
            right[i] -= information * place.shared[i];
        }
        Equations { matrix, right, views }
    }
}

/// The shared part, of which the lower half is summed.
#[derive(Default)]
struct Sums {
    matrix: [[f64; SHARED]; SHARED],
    right: [f64; SHARED],
}

impl Sums {
    fn add(&mut self, point: &Linearised, weight: f64) {
        let [u, v] = &point.by_shared;
        let [x, y] = point.residual.map(|residual| weight * residual);
        for i in 0..SHARED {
            let (by_u, by_v) = (weight * u[i], weight * v[i]);
            self.right[i] += u[i] * x + v[i] * y;
            for (sum, (u, v)) in self.matrix[i].iter_mut().zip(u.iter().zip(v)).take(i + 1) {
                *sum += by_u * u + by_v * v;
            }
        }
    }
}

/// A view's part.
#[derive(Default)]
pub(crate) struct ViewSums {
    matrix: [[f64; 6]; 6],
    cross: [[f64; 6]; SHARED],
    right: [f64; 6],
}

impl ViewSums {
    pub(crate) fn add(&mut self, point: &Linearised, weight: f64) {
        let [u, v] = &point.by_pose;
        let [x, y] = point.residual.map(|residual| weight * residual);
        for i in 0..6 {
            let (by_u, by_v) = (weight * u[i], weight * v[i]);
            self.right[i] += u[i] * x + v[i] * y;
            for j in 0..6 {
                self.matrix[i][j] += by_u * u[j] + by_v * v[j];
            }
        }
        for (row, (by_u, by_v)) in
            self.cross.iter_mut().zip(point.by_shared[0].iter().zip(&point.by_shared[1]))
        {
            let (by_u, by_v) = (weight * by_u, weight * by_v);
            for j in 0..6 {
                row[j] += by_u * u[j] + by_v * v[j];
            }
        }
    }

    pub(crate) fn block(&self) -> ViewBlock {
        ViewBlock {
            matrix: Matrix6::from_fn(|i, j| self.matrix[i][j]),
            cross: Cross::from_fn(|i, j| self.cross[i][j]),
            right: Vector6::from(self.right),
        }
    }
}

/// Which of the shared numbers are solved for.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Free(pub(crate) [bool; SHARED]);

impl Free {
    /// The poses only.
    pub(crate) fn none() -> Self {
        Self([false; SHARED])
    }

    /// The first numbers of a lens: focal lengths and so many of the others.
    pub(crate) fn intrinsics(count: usize) -> Self {
        Self(std::array::from_fn(|i| i < count))
    }

    /// These and others.
    pub(crate) fn with(mut self, others: std::ops::Range<usize>) -> Self {
        for i in others {
            self.0[i] = true;
        }
        self
    }

    /// A matrix whose other rows and columns are those of the identity.
    pub(crate) fn masked(&self, matrix: &SharedMatrix) -> SharedMatrix {
        SharedMatrix::from_fn(|i, j| match self.0[i] && self.0[j] {
            true => matrix[(i, j)],
            false => f64::from(u8::from(i == j)),
        })
    }

    pub(crate) fn masked_vector(&self, vector: &Shared) -> Shared {
        Shared::from_fn(|i, _| if self.0[i] { vector[i] } else { 0.0 })
    }
}

/// The equations of the shared numbers alone.
pub(crate) struct Reduced {
    pub(crate) matrix: SharedMatrix,
    pub(crate) right: Shared,
    /// The inverse of each view's own matrix.
    pub(crate) inverses: Vec<Matrix6<f64>>,
}

impl Equations {
    /// With every diagonal element increased by `damping` of itself; `None` where a view's pose is not determined.
    pub(crate) fn reduced(&self, damping: f64) -> Option<Reduced> {
        let mut matrix = self.matrix;
        for i in 0..SHARED {
            matrix[(i, i)] *= 1.0 + damping;
        }
        let mut right = self.right;
        let mut inverses = Vec::with_capacity(self.views.len());
        for view in &self.views {
            let mut own = view.matrix;
            for i in 0..6 {
                own[(i, i)] *= 1.0 + damping;
            }
            let inverse = own.cholesky()?.inverse();
            let across = view.cross * inverse;
            matrix -= across * view.cross.transpose();
            right -= across * view.right;
            inverses.push(inverse);
        }
        Some(Reduced { matrix, right, inverses })
    }
}

/// The inverse of a positive definite matrix whose diagonal may span many powers of ten; `None` for another.
pub(crate) fn inverse(matrix: &SharedMatrix) -> Option<SharedMatrix> {
    let scale = Shared::from_fn(|i, _| {
        let root = matrix[(i, i)].sqrt();
        if root > 0.0 { 1.0 / root } else { 1.0 }
    });
    let scaled = SharedMatrix::from_fn(|i, j| matrix[(i, j)] * scale[i] * scale[j]);
    let inverse = scaled.cholesky()?.inverse();
    let inverse = SharedMatrix::from_fn(|i, j| inverse[(i, j)] * scale[i] * scale[j]);
    inverse.iter().all(|value| value.is_finite()).then_some(inverse)
}
