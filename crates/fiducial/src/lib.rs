//! Marker families: draw them, detect them, and their pose.
//!
//! This crate knows images as borrowed grey views and cameras as models. It knows no network, no file, no
//! clock and no thread; a stage of a detection that wants to be timed tells a [`Stages`] observer.
//!
//! Modules in reading order: [`marker`] names what is looked for, [`drawing`] says what it looks like,
//! [`observation`] is what was found.

pub mod drawing;
pub mod marker;
pub mod observation;

pub use drawing::{Drawing, Ink, Layer, Shape};
pub use marker::{Family, Marker, MarkerError};
pub use observation::{MarkerPose, Observation, Stages};
