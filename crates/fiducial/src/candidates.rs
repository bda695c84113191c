//! Where in an image a marker may be.

pub(crate) mod ellipses;
pub(crate) mod quad;
pub(crate) mod ring;
pub(crate) mod ring_profile;
pub(crate) mod segment_quads;
