//! A camera's intrinsics from images of a board, and its time offset, mount, focal length and k1 from a flight, with what they are
//! worth.
//!
//! The way through it: one [`View`] for each image, with the board's points that were found in it, goes into
//! [`calibrate`]. What comes out is a [`Calibration`] (the [`geometry::CameraModel`], its covariance, each view's pose and
//! residuals, and functions that say what the uncertainty means), or a [`Refusal`] with the reason in a sentence for people.
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
//! This crate knows no image, no marker, no file and no clock.
//!
//! Modules in reading order: [`view`] is what is given, [`lens`] which camera model is looked for; `board` predicts a board's
//! point with its derivatives, `equations` and `solve` find a minimum, `start` guesses where, `stages` is the way from guess
//! to result, `covariance` says how sure it is;
//! [`evidence`] is what the fit leaves unexplained, [`halves`] compares two halves of the views; [`calibration`] is the result,
//! `judge` refuses by [`refusal`]. [`flight`] is another way, without a board: [`calibrate_flight`] compares the pad that a
//! camera sees in flight with where the autopilot says that the vehicle is.

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
