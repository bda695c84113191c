//! The detectors, one for each kind of marker.

pub(crate) mod query;
pub mod rings;
pub mod rings_thesis;
pub(crate) mod square;
pub(crate) mod stag;
