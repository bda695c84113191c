//! Marker families: draw them, detect them, and their pose.
//!
//! This crate knows images as borrowed grey views and cameras as models. It knows no network, no file, no
//! clock and no thread; a stage of a detection that wants to be timed tells a [`Stages`] observer.
//!
//! Modules in reading order: [`marker`] names what is looked for, [`square`] has the codes of square markers and finds
//! them, `stag` finds STags among the same quads, [`drawing`] says what a marker looks like, [`observation`] is what was
//! found, [`pose`] where it is in space, [`detector`] finds it, [`pad`] solves the markers of one pad together.
//! `optics` is what camera and lens do to an edge, `candidates` where a marker may be, [`families`] one detector for each
//! kind of marker. [`trace`] is what they saw, [`debug`] draws that on a [`canvas`] with its [`letters`]. [`tracking`]
//! searches first where the markers of the last images should be.

mod candidates;
pub mod canvas;
pub mod debug;
pub mod detector;
pub mod drawing;
pub mod families;
pub mod letters;
pub mod marker;
pub mod observation;
mod optics;
pub mod pad;
pub mod pose;
pub mod square;
mod stag;
pub mod trace;
pub mod tracking;

pub use candidates::ring::{Ring, RingKind};
pub use detector::{Detector, DetectorError, Settings};
pub use drawing::{Drawing, Ink, Layer, Shape};
pub use marker::{Family, Marker, MarkerError};
pub use observation::{MarkerPose, Observation, PoseSolution, Stages};
pub use pad::{Pad, PadError, PadObservation, PlacedMarker};
pub use pose::{PlanePoint, planar_pose, square_pose};
pub use trace::{Candidate, Reason, Refusal, Trace, TracedMarker};
pub use tracking::{Tracker, TrackingSettings};
