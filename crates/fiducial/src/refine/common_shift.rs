//! Measures the shift that a tone curve gives all edges of a marker, and the covariance that located edges leave: by the scatter of their
//! places, and by the contradiction of the marker's parts.

use nalgebra::{SMatrix, SVector};

use crate::optics::homography::Homography;
use crate::optics::least_squares::NormalEquations;
use crate::optics::undistort::Undistortion;
use crate::refine::fit::{EdgeSample, Fit, no_pulls, part, widen_by_parts};
use crate::refine::side_errors::{
    ROUNDING_VARIANCE, SideErrors, add_size_error, form_error_of_shift_px,
};

/// Parameters of the homography, and the blur.
pub(crate) const UNKNOWNS: usize = 9;
/// Unknowns with a common shift.
const SHIFTED: usize = UNKNOWNS + 1;

/// A shift of all edges towards black by the same distance: a tone curve makes white wider. Edges that have black outside and
/// others that have it inside distinguish it from the square's size.
#[derive(Copy, Clone, Debug)]
pub(crate) struct CommonShift {
    /// Of all unknowns, from where the edges were measured.
    step: SVector<f64, SHIFTED>,
    inverse: SMatrix<f64, SHIFTED, SHIFTED>,
    /// Whether there is one.
    is_found: bool,
    /// Whether it can be distinguished from the square's size.
    pub(crate) is_known: bool,
    scatter: Scatter,
}

impl CommonShift {
    pub(crate) fn from_edges(
        equations: &NormalEquations<UNKNOWNS>,
        edges: &[EdgeSample],
    ) -> Option<Self> {
        // A shift is one when it is this many standard deviations from none, and this many pixels.
        const MIN_SIGMAS: f64 = 4.0;
        const MIN_SHIFT_PX: f64 = 0.01;
        // With a larger standard deviation the shift is not known: where none is found, and where there is one.
        const MAX_SIGMA_PX: f64 = 0.02;
        const MAX_SIGMA_SHIFTED_PX: f64 = 0.06;
        let mut matrix = SMatrix::<f64, SHIFTED, SHIFTED>::zeros();
        let mut right = SVector::<f64, SHIFTED>::zeros();
        matrix.fixed_view_mut::<UNKNOWNS, UNKNOWNS>(0, 0).copy_from(&equations.matrix);
        right.fixed_rows_mut::<UNKNOWNS>(0).copy_from(&equations.right);
        for measurement in edges.iter().filter_map(|edge| edge.measurement.as_ref()) {
            let [shift, mixed, _] = measurement.matrix.map(|m| measurement.weight * m);
            for (i, along) in measurement.gradient.iter().enumerate() {
                matrix[(UNKNOWNS, i)] += shift * along;
            }
            matrix[(UNKNOWNS, 8)] += mixed;
            matrix[(UNKNOWNS, UNKNOWNS)] += shift;
            right[UNKNOWNS] += measurement.weight * measurement.right[0];
        }
        let inverse = matrix.cholesky()?.inverse();
        let step = inverse * right;
        let scatter = Scatter::after(&step, edges);
        let sigma_px = (inverse[(UNKNOWNS, UNKNOWNS)] * scatter.larger_variance()).sqrt();
        let is_found = step[UNKNOWNS].abs() > (MIN_SIGMAS * sigma_px).max(MIN_SHIFT_PX);
        let is_known = sigma_px < if is_found { MAX_SIGMA_SHIFTED_PX } else { MAX_SIGMA_PX };
        Some(Self { step, inverse, is_found, is_known, scatter })
    }

    /// The fit with the shift; `None` where there is none.
    pub(crate) fn applied(
        &self,
        measured_at: &Homography,
        lens: &Undistortion<'_>,
        plain: Fit,
        edges: &[EdgeSample],
    ) -> Option<Fit> {
        let step = &self.step;
        let homography = measured_at.stepped(|i| step[i]).filter(|_| self.is_found)?;
        let shift_px = step[UNKNOWNS];
        let variance = self.scatter.variance(self.is_known);
        let factor = SideErrors::OF_EDGES.factor(&homography, lens.jacobian());
        let mut covariance = covariance(&self.inverse, variance * factor, step, edges);
        add_size_error(&mut covariance, &homography, form_error_of_shift_px(shift_px));
        Some(Fit { homography, covariance, shift_px, ..plain })
    }
}

/// How far edges are off their places after a step, and the pixels across them off their profiles.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Scatter {
    /// Variance of a pixel by the places of the edges, in square grey levels.
    of_places: f64,
    /// The same by their profiles.
    pub(crate) of_pixels: f64,
}

impl Scatter {
    pub(crate) fn after<const N: usize>(step: &SVector<f64, N>, edges: &[EdgeSample]) -> Self {
        let (mut squares, mut weight, mut noise, mut freedom) = (0.0, 0.0, 0.0, 0.0);
        let common = if N > UNKNOWNS { step[N - 1] } else { 0.0 };
        for measurement in edges.iter().filter_map(|edge| edge.measurement.as_ref()) {
            let along = measurement.gradient.iter().zip(step.iter());
            let moved = along.map(|(by, step)| by * step).sum::<f64>() + common;
            let [shift, mixed, _] = measurement.matrix;
            let left = measurement.right[0] - shift * moved - mixed * step[8];
            squares += measurement.weight * left * left / shift;
            weight += measurement.weight;
            noise += measurement.weight * measurement.squares;
            freedom += measurement.weight * measurement.freedom;
        }
        Self { of_places: squares / (weight - N as f64).max(1.0), of_pixels: noise / freedom }
    }

    /// The variance with which the edges determine the square: that of their places. A profile is also off its pixels where a tone
    /// curve changes its form, by far more than by noise, but does so alike at all edges. Where a shift of all edges is not known,
    /// this form may have moved the square's sides, and the larger variance counts.
    pub(crate) fn variance(&self, is_shift_known: bool) -> f64 {
        if is_shift_known { self.of_places.max(ROUNDING_VARIANCE) } else { self.larger_variance() }
    }

    fn larger_variance(&self) -> f64 {
        self.of_places.max(self.of_pixels)
    }
}

/// The covariance of a homography from the `inverse` of its normal equations and the variance of a pixel, widened by the contradiction of
/// the edges after the last step: of the homography, the blur and, where there is one, the common shift.
pub(crate) fn covariance<const N: usize>(
    inverse: &SMatrix<f64, N, N>,
    variance: f64,
    step: &SVector<f64, N>,
    edges: &[EdgeSample],
) -> SMatrix<f64, 8, 8> {
    let mut covariance = inverse.fixed_view::<8, 8>(0, 0) * variance;
    let mut pulls = no_pulls();
    for sample in edges {
        let Some(measurement) = &sample.measurement else { continue };
        let [shift, mixed, spread] = measurement.matrix;
        let along = measurement.gradient.iter().chain([&0.0, &1.0]);
        let mut pull = SVector::<f64, N>::zeros();
        pull.iter_mut().zip(along).for_each(|(slot, by)| *slot = *by);
        let moved = pull.dot(step);
        let left = |right: f64, by_move: f64, by_spread: f64| {
            measurement.weight * (right - by_move * moved - by_spread * step[8])
        };
        pull *= left(measurement.right[0], shift, mixed);
        pull[8] = left(measurement.right[1], mixed, spread);
        if let Some(all) = pulls.get_mut(part(sample.place)) {
            *all += pull;
        }
    }
    widen_by_parts(&mut covariance, inverse, &pulls);
    covariance
}
