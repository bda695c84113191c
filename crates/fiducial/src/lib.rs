//! Detects markers and estimates their pose.
//!
//! This crate reads images as borrowed grey views and cameras as models. It does not depend on network, files, a
//! clock or threads; a [`StageObserver`] can time the stages of a detection.
//!
//! The crate `markers` defines markers. Modules in the order of the data: `optics` models the effect of camera and
//! lens on a marker, `candidates` finds regions that may be markers, `decode` reads a candidate's codeword,
//! [`refine`] measures its corners to a fraction of a pixel, [`pose`] its pose; [`families`] has a detector for each
//! kind of marker, [`schedule`] chooses the fallback passes of an image, [`detector`] runs them,
//! [`observation`] is their result. [`tracker`] searches first where the markers of the last images should be,
//! and remembers their camera's [`response`]; [`bundle`] solves the markers of one pad together. [`trace`]
//! records why candidates were refused, [`overlay`] draws that on the image.

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
pub mod response;
pub mod schedule;
mod settings;
pub mod trace;
pub mod tracker;

pub use bundle::{PadObservation, observe_pad};
pub use candidates::ring::Ring;
pub use detector::{Detector, DetectorError};
pub use observation::{MarkerPose, Observation, PoseSolution, StageObserver};
pub use pose::{PlanePoint, planar_pose, square_pose};
pub use response::{Measured, ResponseEstimate, ResponseMemory, ResponseSetting};
pub use schedule::{FallbackPass, ImageStrip, PassSchedule};
pub use settings::Settings;
pub use trace::{Candidate, Reason, Refusal, Trace, TracedMarker};
pub use tracker::{Tracker, TrackingSettings};
