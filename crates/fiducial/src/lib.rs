//! Marker families: draw them, detect them, and their pose.
//!
//! This crate knows images as borrowed grey views and cameras as models. It knows no network, no file, no
//! clock and no thread; a stage of a detection that wants to be timed tells a [`Stages`] observer.
//!
//! Modules in reading order: [`marker`] names what is looked for, [`square`] has the codes of square markers and finds
//! them, `stag` finds STags among the same quads, [`drawing`] says what a marker looks like, [`observation`] is what was
//! found, [`pose`] where it is in space, [`detector`] finds it, [`pad`] solves the markers of one pad together. [`ring`] and [`rings_thesis`] are the thesis' way
//! (Algorithms 1-15). [`rings`] is the second generation: `outline` takes ellipses from outlines, `profile` compares the
//! bands about them with the marker's, `search` goes from one circle to all edges, `circles` and, for small markers,
//! `photometry` give the pose, `lens` serves images of unknown cameras. `step` is what a camera makes of a sharp edge;
//! `exposure`, the black and contrast of a picture, serves squares and rings. [`trace`] is what they saw on the way,
//! [`debug`] draws that on a [`canvas`] with its [`letters`]. [`tracking`] searches first where the markers of the last
//! images should be.

pub mod canvas;
mod circles;
pub mod debug;
pub mod detector;
pub mod drawing;
mod exposure;
mod lens;
pub mod letters;
pub mod marker;
pub mod observation;
mod outline;
pub mod pad;
mod photometry;
pub mod pose;
mod profile;
pub mod ring;
pub mod rings;
pub mod rings_thesis;
mod search;
pub mod square;
mod stag;
mod step;
pub mod trace;
pub mod tracking;

pub use detector::{Detector, DetectorError, Settings};
pub use drawing::{Drawing, Ink, Layer, Shape};
pub use marker::{Family, Marker, MarkerError};
pub use observation::{MarkerPose, Observation, PoseSolution, Stages};
pub use pad::{Pad, PadError, PadObservation, PlacedMarker};
pub use pose::{PlanePoint, planar_pose, square_pose};
pub use ring::{Ring, RingKind};
pub use trace::{Candidate, Reason, Refusal, Trace, TracedMarker};
pub use tracking::{Tracker, TrackingSettings};
