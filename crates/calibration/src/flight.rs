//! Estimates a camera's time offset, mount, focal length and first radial coefficient (k1) from a flight over a stationary pad.
//!
//! The pad has one position. Its position computed from the vehicle's attitude and position moves with the vehicle when the
//! camera is not as configured: with the height and the heading under a mount that is off, with the tilt under a focal length
//! or a k1 that is off, with every turn under stamps that are early or late. The autopilot's errors move it as well, slowly.
//! They are estimated together with the camera, and their size is estimated from the flight itself, so that the deviations
//! follow from the flight. Hovering shows nothing (Yang, Geneva, Eckenhoff, Huang, "Degenerate motion analysis for aided INS
//! with online spatial and temporal sensor calibration", 2019).
//!
//! Stages in reading order: `sample` has the input, `quantity` the estimated quantities; `motion` is the vehicle's pose at any
//! time, `model` predicts the detections, [`excitation`] measures which quantities are observable, `filter` eliminates the
//! drift, `scale` estimates its size (`noise`), `start` finds the time offset roughly.

pub mod excitation;
mod filter;
mod model;
mod motion;
mod noise;
mod quantity;
mod sample;
mod scale;
mod start;

use geometry::squared;
use nalgebra::SMatrix;
use thiserror::Error;

use excitation::Excitation;
use filter::{Filtered, Prior, filtered};
use model::{Model, PARAMETERS, Parameters};
use motion::Motion;
use noise::Noise;
use quantity::OFFSET;
pub use quantity::{QUANTITIES, Quantity};
pub use sample::{ConfiguredCamera, MarkerSample, VehicleSample};

/// An estimated quantity: a correction of the configured value.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct FlightEstimate {
    /// Which.
    pub quantity: Quantity,
    /// The estimate, in the quantity's unit; meaningless where it is not observable.
    pub value: f64,
    /// Its standard deviation; infinite where the vehicle did not move so that it shows.
    pub deviation: f64,
}

impl FlightEstimate {
    /// Whether the flight showed it.
    pub fn is_observable(&self) -> bool {
        self.deviation <= self.quantity.max_deviation()
    }

    /// Whether the configured value may be right: an estimate with no smaller deviation would make it worse as often as better.
    pub fn may_be_as_configured(&self) -> bool {
        self.value.abs() <= MIN_DEVIATIONS * self.deviation
    }

    /// The correction of the configured value: zero where it is not observable or may be right.
    pub fn correction(&self) -> f64 {
        if self.is_observable() && !self.may_be_as_configured() { self.value } else { 0.0 }
    }
}

/// The result of a flight for its camera.
#[derive(Clone, Debug)]
pub struct FlightCalibration {
    /// The camera after the correction of the observable quantities.
    pub camera: ConfiguredCamera,
    /// The estimates, in the order of [`QUANTITIES`].
    pub estimates: [FlightEstimate; 6],
    /// Their covariance, in the same order.
    pub covariance: SMatrix<f64, 6, 6>,
    /// The estimated errors of the autopilot's estimate.
    pub drift: Drift,
    /// How the vehicle moved.
    pub excitation: Excitation,
    /// Detections that were used.
    pub markers: usize,
}

/// Standard deviations of the autopilot's estimated errors.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Drift {
    /// Of the slow error of the horizontal position, in metres.
    pub position_m: f64,
    /// Of the slow error of the attitude, in radians.
    pub lean_rad: f64,
    /// How long errors of the position last, in seconds.
    pub position_s: f64,
    /// How long errors of the attitude last, in seconds.
    pub lean_s: f64,
    /// Of a single detection's direction beyond its own covariance, in pixels.
    pub pixel_px: f64,
}

/// Why a flight gives no calibration of its camera.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum FlightRefusal {
    /// Too few detections at times of which the vehicle's pose is known.
    #[error(
        "the flight has {found} detections at times of which the vehicle's pose is known, and at least {MIN_MARKERS} are needed: \
         record a landing from its begin to its end"
    )]
    TooFew {
        /// How many there are.
        found: usize,
    },
    /// Stamps and poses do not fit together.
    #[error(
        "the frames' stamps seem to be {offset_s:+.2} s off the autopilot's, which is more than {MAX_OFFSET_S} s: camera and \
         autopilot are not stamped by one clock; `alight doctor` checks the camera's"
    )]
    Offset {
        /// By how much.
        offset_s: f64,
    },
    /// The markers' places contradict each other for any camera.
    #[error(
        "no camera explains the flight: after all corrections the pad's place still wanders by {wander_m:.2} m within a second \
         (more than {MAX_WANDER_M} m), and {share:.0} % of the detections are elsewhere; the pad moved, there were several, the \
         autopilot's position is poor, or the recording is of another camera",
        share = 100.0 * .share
    )]
    Contradiction {
        /// How far the pad seems to wander within a second, in metres.
        wander_m: f64,
        /// The part of the detections that do not fit.
        share: f64,
    },
    /// Solutions go back and forth, or on and on.
    #[error(
        "the flight has no solution that stands: after {ITERATIONS} steps the {quantity} still changes by {steps:.1} standard \
         deviations; record a flight with more tilt and turns"
    )]
    Unsettled {
        /// The quantity that changes most.
        quantity: &'static str,
        /// By how much, over its standard deviation.
        steps: f64,
    },
    /// Invalid numbers in the flight.
    #[error("the flight's numbers have no solution: {why}")]
    Numbers {
        /// The error.
        why: &'static str,
    },
}

/// The quantities of the image's scale, which an error of the attitude makes smaller.
const SCALE: [Quantity; 2] = [Quantity::FocalScale, Quantity::K1];
/// The fewest detections of a flight.
pub const MIN_MARKERS: usize = 60;
/// Largest time offset that is accepted, in seconds.
pub const MAX_OFFSET_S: f64 = 1.0;
/// How many deviations a value must be from the configured one to be changed.
const MIN_DEVIATIONS: f64 = 3.0;
/// How far the pad may seem to wander within a second, in metres.
pub const MAX_WANDER_M: f64 = 0.5;
/// Largest part of the detections that may be elsewhere.
const MAX_OUTLIERS: f64 = 0.3;
/// Iterations of the solution.
const ITERATIONS: usize = 30;
/// From this iteration on only half of each step is taken: around some solutions whole ones go back and forth, as detections at the
/// flight's ends come and go with the time offset.
const HALF_FROM: usize = 12;
/// How often the errors' sizes are estimated again.
const NOISE_ROUNDS: usize = 2;
/// A step that is smaller than this part of the deviations is the last.
const CONVERGED: f64 = 0.02;
/// Largest step, in deviations, that may still be ahead when there are no more iterations.
const MAX_UNSETTLED: f64 = 3.0;

/// Estimates the differences between a camera and its configuration.
///
/// # Errors
/// When the samples are too few or contradict each other.
pub fn calibrate_flight(
    configured: &ConfiguredCamera,
    vehicle: &[VehicleSample],
    markers: &[MarkerSample],
) -> Result<FlightCalibration, FlightRefusal> {
    let motion = Motion::new(vehicle);
    let model = Model::new(configured, &motion, markers);
    if model.markers().len() < MIN_MARKERS {
        return Err(FlightRefusal::TooFew { found: model.markers().len() });
    }
    let excitation = Excitation::of(&model);
    let begin = start::parameters(&model, &excitation)
        .ok_or(FlightRefusal::Numbers { why: "the marker is never before the camera" })?;
    if begin[OFFSET].abs() > MAX_OFFSET_S {
        return Err(FlightRefusal::Offset { offset_s: begin[OFFSET] });
    }
    let unknown = Prior::around(&begin);
    let hidden = QUANTITIES.into_iter().filter(|quantity| !excitation.shows(*quantity));
    let prior = hidden.fold(unknown, |prior, quantity| prior.with(quantity, 0.0));
    let mut solution = solved(&model, &prior, Noise::default(), begin)?;
    // The attitude's errors may be too large a part of the tilts: their effect on the scale would be attributed to the camera.
    let shows_scale = excitation.shows(Quantity::FocalScale);
    let scale_bias = Some(excitation.attenuation(solution.noise.lean_rad))
        .filter(|bias| shows_scale && *bias <= Quantity::FocalScale.max_deviation());
    if shows_scale && scale_bias.is_none() {
        let prior = SCALE.into_iter().fold(prior, |prior, quantity| prior.with(quantity, 0.0));
        solution = solved(&model, &prior, solution.noise, solution.parameters)?;
    }
    let Solution { parameters, result, noise } = solution;
    if parameters[OFFSET].abs() > MAX_OFFSET_S {
        return Err(FlightRefusal::Offset { offset_s: parameters[OFFSET] });
    }
    let wander_m = noise.wander_m();
    if result.outliers > MAX_OUTLIERS || wander_m > MAX_WANDER_M {
        return Err(FlightRefusal::Contradiction { wander_m, share: result.outliers });
    }
    is_settled(&result)?;
    let assessment =
        Assessment { configured, markers: model.markers().len(), excitation, noise, scale_bias };
    Ok(assessment.calibration(&parameters, &result))
}

/// The parameters that explain a flight best, and the size of the errors.
struct Solution {
    parameters: Parameters,
    result: Filtered,
    noise: Noise,
}

/// Solves for both in turn, from some size of the errors and some parameters on.
fn solved(
    model: &Model<'_>,
    prior: &Prior,
    mut noise: Noise,
    begin: Parameters,
) -> Result<Solution, FlightRefusal> {
    let (mut parameters, mut result) = minimum(model, prior, &noise, begin)?;
    for _ in 0..NOISE_ROUNDS {
        noise = scale::noise(&model.linearised(&parameters), &parameters, prior, noise);
        (parameters, result) = minimum(model, prior, &noise, parameters)?;
    }
    Ok(Solution { parameters, result, noise })
}

/// The parameters that explain the flight best, for errors of this size: Gauss and Newton's steps, none of which is long.
fn minimum(
    model: &Model<'_>,
    prior: &Prior,
    noise: &Noise,
    begin: Parameters,
) -> Result<(Parameters, Filtered), FlightRefusal> {
    let mut parameters = begin;
    let solved = |parameters: &Parameters| {
        filtered(&model.linearised(parameters), parameters, prior, noise)
            .ok_or(FlightRefusal::Numbers { why: "the equations are singular" })
    };
    for iteration in 0..ITERATIONS {
        let result = solved(&parameters)?;
        if (0..PARAMETERS).all(|i| result.step[i].abs() <= CONVERGED * deviation(&result, i)) {
            return Ok((parameters, result));
        }
        let too_long =
            |quantity: Quantity| result.step[quantity.index()].abs() / quantity.max_step();
        let longest = QUANTITIES.into_iter().map(too_long).fold(1.0, libm::fmax);
        let share = if iteration < HALF_FROM { 1.0 } else { 0.5 };
        parameters += result.step * (share / longest);
    }
    Ok((parameters, solved(&parameters)?))
}

fn deviation(result: &Filtered, index: usize) -> f64 {
    libm::fmax(result.covariance[(index, index)], 0.0).sqrt()
}

/// The variance of an estimate: of the flight's noise, of errors that no flight averages out, and of the remaining step where
/// the solution oscillates.
fn variance(result: &Filtered, quantity: Quantity) -> f64 {
    let i = quantity.index();
    let noise = libm::fmax(result.covariance[(i, i)], 0.0);
    noise + squared(quantity.model_deviation()) + squared(result.step[i])
}

/// Refuses a solution that is still far away.
fn is_settled(result: &Filtered) -> Result<(), FlightRefusal> {
    for quantity in QUANTITIES {
        let i = quantity.index();
        let step = result.step[i].abs();
        let deviation = libm::hypot(deviation(result, i), quantity.model_deviation());
        if step > MAX_UNSETTLED * deviation {
            let quantity = quantity.name();
            return Err(FlightRefusal::Unsettled { quantity, steps: step / deviation });
        }
    }
    Ok(())
}

/// The quality of a solution, with which its calibration is reported.
struct Assessment<'a> {
    configured: &'a ConfiguredCamera,
    markers: usize,
    excitation: Excitation,
    noise: Noise,
    /// The part by which the attitude's errors may make the focal length too short; `None` where the flight does not show it.
    scale_bias: Option<f64>,
}

impl Assessment<'_> {
    fn shows(&self, quantity: Quantity) -> bool {
        let is_scale = SCALE.contains(&quantity);
        self.excitation.shows(quantity) && (!is_scale || self.scale_bias.is_some())
    }

    /// The variance of the focal length from the attitude's errors. A longer flight does not average it out.
    fn bias_variance(&self, quantity: Quantity) -> f64 {
        match quantity {
            Quantity::FocalScale => self.scale_bias.map_or(0.0, squared),
            _ => 0.0,
        }
    }

    fn calibration(&self, parameters: &Parameters, result: &Filtered) -> FlightCalibration {
        let covariance: SMatrix<f64, 6, 6> = SMatrix::from_fn(|i, j| {
            let [one, other] = [QUANTITIES[i], QUANTITIES[j]];
            match i == j {
                true => variance(result, one) + self.bias_variance(one),
                false => result.covariance[(one.index(), other.index())],
            }
        });
        let estimates: [FlightEstimate; 6] = std::array::from_fn(|i| {
            let quantity = QUANTITIES[i];
            let (value, variance) = (parameters[quantity.index()], covariance[(i, i)]);
            match self.shows(quantity) {
                true => {
                    FlightEstimate { quantity, value, deviation: libm::fmax(variance, 0.0).sqrt() }
                }
                false => FlightEstimate { quantity, value: 0.0, deviation: f64::INFINITY },
            }
        });
        let mut corrected = Parameters::zeros();
        for estimate in &estimates {
            corrected[estimate.quantity.index()] = estimate.correction();
        }
        let Noise { position_m, lean_rad, position_s, lean_s, pixel_px, .. } = self.noise;
        FlightCalibration {
            camera: model::corrected(self.configured, &corrected),
            estimates,
            covariance,
            drift: Drift { position_m, lean_rad, position_s, lean_s, pixel_px },
            excitation: self.excitation,
            markers: self.markers,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_solution_that_still_moves_is_refused() {
        let mut result = Filtered {
            step: Parameters::zeros(),
            covariance: SMatrix::identity(),
            likelihood: 0.0,
            outliers: 0.0,
        };
        assert_eq!(is_settled(&result), Ok(()));
        assert!((variance(&result, Quantity::FocalScale) - 1.0).abs() < 1e-6);
        result.step[Quantity::FocalScale.index()] = -2.0;
        assert_eq!(is_settled(&result), Ok(()));
        assert!((variance(&result, Quantity::FocalScale) - 5.0).abs() < 1e-6);
        result.step[Quantity::FocalScale.index()] = -4.0;
        let refusal = is_settled(&result).unwrap_err();
        let is_named = matches!(refusal, FlightRefusal::Unsettled { quantity: "focal length", .. });
        assert!(is_named, "{refusal}");
        assert!(refusal.to_string().contains("4.0 standard deviations"), "{refusal}");
    }
}
