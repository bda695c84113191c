//! Calibrates a camera: intrinsics from images of a board, and time offset, mount, focal length and k1 from a flight, each with
//! its uncertainty.
//!
//! Usage: [`calibrate`] takes one [`View`] for each image, with the board's points that were found in it. It returns a
//! [`Calibration`] (the [`geometry::CameraModel`], its covariance, each view's pose and residuals, and functions that convert
//! the uncertainty to pixels and metres), or a [`Refusal`] with the reason in a sentence for users.
//!
//! ```
//! use calibration::{calibrate, ImageSize, Lens, Options, Sighting, View};
//! use geometry::Pixel;
//!
//! let size = ImageSize { width: 1280, height: 960 };
//! // x right and y down on the board, in metres; `tag` names the marker that the point is a corner of.
//! let sighting = Sighting { tag: 7, place_m: [0.088, 0.0], seen: Pixel::new(311.2, 240.9) };
//! let view = View { name: "001.png".into(), size, points: vec![sighting] };
//! let refusal = calibrate(&[view], Lens::BrownConrady5, &Options::default()).unwrap_err();
//! println!("{refusal}");
//! ```
//!
//! This crate does not depend on images, markers, files or a clock.
//!
//! Modules in reading order: [`view`] is the input, [`lens`] the camera model that is estimated; `board` predicts a board's
//! point with its derivatives, `equations` and `solve` find a minimum, `start` computes the first guess, `stages` leads from
//! it to the result, `covariance` gives the uncertainty;
//! [`evidence`] measures the residuals of the fit, `turned` finds views that were turned by 180 degrees, [`halves`] compares two
//! halves of the views; [`calibration`] is the result, `judge` refuses by [`refusal`]. [`flight`] is another method, without a board: [`calibrate_flight`] compares the pad's
//! detections in flight with the vehicle's pose that the autopilot reports.

#![cfg_attr(not(test), deny(clippy::disallowed_methods))] // The same results on every machine.

mod board;
pub mod calibration;
mod covariance;
mod equations;
pub mod evidence;
pub mod flight;
pub mod halves;
mod judge;
pub mod lens;
pub mod refusal;
mod solve;
mod stages;
mod start;
mod turned;
pub mod view;

pub use calibration::{
    Calibration, Options, PlaceResidual, PlaceUncertainty, PlacementError, Residual, SolvedView,
};
pub use evidence::{Coverage, Estimate, Evidence};
pub use flight::{
    ConfiguredCamera, FlightCalibration, FlightEstimate, FlightRefusal, MarkerSample, Quantity,
    VehicleSample, calibrate_flight,
};
pub use halves::CrossValidation;
pub use judge::{calibrate, calibrate_unjudged};
pub use lens::Lens;
pub use refusal::Refusal;
pub use view::{ImageSize, Sighting, View};
