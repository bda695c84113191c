//! Eliminates the drifting states from the equations, one marker after the other.
//!
//! At given parameters the equations are linear, and the drifts are first-order Gauss-Markov processes. The parameters that
//! result at the end are those of least squares over all states together: a Kalman filter is that elimination
//! (Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, chapter 5). A detection's
//! error has the heavy tails of Student's distribution, by which outliers lose influence (Lange, Little, Taylor, "Robust
//! statistical modeling using the t distribution", 1989).

use nalgebra::{Matrix3, SMatrix};

use super::model::{
    CLIMB, DRIFTS, HEADING, LEAN, Linearised, PAD, PARAMETERS, POSITION, Parameters, STATES, State,
};
use super::noise::Noise;
use super::quantity::{QUANTITIES, Quantity};

type Covariance = SMatrix<f64, STATES, STATES>;

/// Degrees of freedom of a detection's error.
const FREEDOM: f64 = 8.0;
/// The normalised square of an error from which on a detection is elsewhere.
const ELSEWHERE: f64 = 40.0;
/// Standard deviations before the flight: of the heading, of the scale of changes of the height, and of the pad's place around
/// where it was first seen, to each side and downwards.
const HEADING_RAD: f64 = 0.1;
const CLIMB_PART: f64 = 0.05;
const PAD_M: [f64; 3] = [10.0, 10.0, 3.0];

/// The prior of the parameters.
#[derive(Copy, Clone, Debug)]
pub(super) struct Prior {
    mean: Parameters,
    deviation: Parameters,
}

impl Prior {
    /// The prior of a flight whose pad is about where these parameters have it.
    pub(super) fn around(begin: &Parameters) -> Self {
        let (mut mean, mut deviation) = (Parameters::zeros(), Parameters::zeros());
        for quantity in QUANTITIES {
            deviation[quantity.index()] = quantity.prior_deviation();
        }
        (deviation[HEADING], deviation[CLIMB]) = (HEADING_RAD, CLIMB_PART);
        for (i, pad_m) in PAD_M.into_iter().enumerate() {
            (mean[PAD + i], deviation[PAD + i]) = (begin[PAD + i], pad_m);
        }
        Self { mean, deviation }
    }

    /// The same with a quantity that is known.
    pub(super) fn with(mut self, quantity: Quantity, value: f64) -> Self {
        let at = quantity.index();
        (self.mean[at], self.deviation[at]) = (value, 0.0);
        self
    }
}

/// The result for the parameters.
#[derive(Copy, Clone, Debug)]
pub(super) struct Filtered {
    /// From the place of the equations to the minimum.
    pub(super) step: Parameters,
    pub(super) covariance: SMatrix<f64, PARAMETERS, PARAMETERS>,
    /// Logarithm of the likelihood, without its constants.
    pub(super) likelihood: f64,
    /// The part of the detections that are elsewhere.
    pub(super) outliers: f64,
}

/// Solves the equations at given parameters; `None` where the result is not finite.
pub(super) fn filtered(
    steps: &[Linearised],
    place: &Parameters,
    prior: &Prior,
    noise: &Noise,
) -> Option<Filtered> {
    let mut filter = Filter::new(place, prior, noise);
    let mut before_s = steps.first()?.stamp_s;
    let (mut likelihood, mut outliers) = (0.0, 0u32);
    for step in steps {
        filter.drift(step.stamp_s - before_s);
        before_s = step.stamp_s;
        let (added, square) = filter.add(step)?;
        likelihood += added;
        outliers += u32::from(square > ELSEWHERE);
    }
    let step: Parameters = filter.mean.fixed_rows::<PARAMETERS>(0).into();
    let covariance: SMatrix<f64, PARAMETERS, PARAMETERS> =
        filter.covariance.fixed_view::<PARAMETERS, PARAMETERS>(0, 0).into();
    let is_finite = likelihood.is_finite()
        && step.iter().chain(covariance.iter()).all(|value| value.is_finite());
    let outliers = f64::from(outliers) / steps.len() as f64;
    is_finite.then_some(Filtered { step, covariance, likelihood, outliers })
}

/// The parameters relative to the equations' place, and the drifts.
struct Filter<'a> {
    mean: State,
    covariance: Covariance,
    noise: &'a Noise,
}

impl<'a> Filter<'a> {
    fn new(place: &Parameters, prior: &Prior, noise: &'a Noise) -> Self {
        let (mut mean, mut covariance) = (State::zeros(), Covariance::zeros());
        for i in 0..PARAMETERS {
            mean[i] = prior.mean[i] - place[i];
            covariance[(i, i)] = prior.deviation[i] * prior.deviation[i];
        }
        for (i, variance) in variances(noise).into_iter().enumerate() {
            covariance[(PARAMETERS + i, PARAMETERS + i)] = variance;
        }
        Self { mean, covariance, noise }
    }

    /// Lets time pass.
    fn drift(&mut self, after_s: f64) {
        let kept_in = |time_constant_s: f64| libm::exp(-after_s / time_constant_s);
        let (position, lean) = (kept_in(self.noise.position_s), kept_in(self.noise.lean_s));
        let variances = variances(self.noise);
        for i in PARAMETERS..STATES {
            let kept = if i < LEAN { position } else { lean };
            self.mean[i] *= kept;
            for j in 0..STATES {
                self.covariance[(i, j)] *= kept;
            }
            for j in 0..STATES {
                self.covariance[(j, i)] *= kept;
            }
            self.covariance[(i, i)] += variances[i - PARAMETERS] * (1.0 - kept * kept);
        }
    }

    /// Adds a marker; the logarithm of its likelihood, and its normalised square.
    fn add(&mut self, step: &Linearised) -> Option<(f64, f64)> {
        let across = self.covariance * step.slope.transpose();
        let known = step.slope * across;
        let noise = step.noise + self.noise.of_detection();
        let innovation = step.residual - step.slope * self.mean;
        let usual = symmetric(known + noise);
        let square = innovation.dot(&usual.cholesky()?.solve(&innovation));
        // An error that is too large is the detection's, not the drift's.
        let weight = libm::fmin((FREEDOM + 3.0) / (FREEDOM - 2.0 + square), 1.0);
        let inverse = symmetric(known + noise / weight).cholesky()?.inverse();
        let gain = across * inverse;
        self.mean += gain * innovation;
        self.covariance -= gain * across.transpose();
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
        let tails = 0.5 * (FREEDOM + 3.0) * libm::log1p(square / (FREEDOM - 2.0));
        Some((-0.5 * libm::log(usual.determinant()) - tails, square))
    }
}

fn symmetric(matrix: Matrix3<f64>) -> Matrix3<f64> {
    (matrix + matrix.transpose()) * 0.5
}

/// The variances of the drifts.
fn variances(noise: &Noise) -> [f64; DRIFTS] {
    let mut variances = [0.0; DRIFTS];
    let mut set = |state: usize, deviation: f64| {
        variances[state - PARAMETERS] = deviation * deviation;
    };
    set(POSITION, noise.position_m);
    set(POSITION + 1, noise.position_m);
    set(POSITION + 2, noise.height_m);
    set(LEAN, noise.lean_rad);
    set(LEAN + 1, noise.lean_rad);
    variances
}
