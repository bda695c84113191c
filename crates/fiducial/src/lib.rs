//! Detects markers and estimates their pose.
//!
//! This crate knows images as borrowed grey views and cameras as models. It knows no network, no file, no
//! clock and no thread; a stage of a detection that wants to be timed tells a [`Stages`] observer.
//!
//! What a marker is stands in the crate `markers`. Modules in reading order: [`square`] finds square markers, `stag` finds
//! STags among the same quads, [`observation`] is what was found, [`pose`] where it is in space, [`detector`] finds it, [`bundle`] solves the markers of one pad together.
//! `optics` is what camera and lens do to an edge, `candidates` where a marker may be, [`families`] one detector for each
//! kind of marker. [`trace`] is what they saw, [`overlay`] draws that on the image. [`tracker`]
//! searches first where the markers of the last images should be.

pub mod bundle;
mod candidates;
mod decode;
pub mod detector;
pub mod families;
pub mod observation;
mod optics;
pub mod overlay;
pub mod pose;
pub mod refine;
pub mod trace;
pub mod tracker;

pub use bundle::{PadObservation, observe_pad};
pub use candidates::ring::Ring;
pub use detector::{Detector, DetectorError, Settings};
pub use observation::{MarkerPose, Observation, PoseSolution, Stages};
pub use pose::{PlanePoint, planar_pose, square_pose};
pub use trace::{Candidate, Reason, Refusal, Trace, TracedMarker};
pub use tracker::{Tracker, TrackingSettings};
