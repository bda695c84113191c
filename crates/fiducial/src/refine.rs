//! Measures sub-pixel corners with their covariance.

pub(crate) mod common_shift;
pub mod corners;
pub(crate) mod drawing;
pub(crate) mod edges;
pub mod fit;
pub mod pattern;
pub(crate) mod photometric;
pub(crate) mod prediction;
pub(crate) mod side_errors;
pub(crate) mod stag_design;
