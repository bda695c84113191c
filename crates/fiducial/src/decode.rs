//! Decodes the codeword of a candidate.

pub(crate) mod cells;
pub(crate) mod erasures;
pub(crate) mod false_positive;
pub(crate) mod illumination;
pub(crate) mod occluded;
pub(crate) mod stag_cells;
pub(crate) mod stag_samples;
pub(crate) mod steps;
