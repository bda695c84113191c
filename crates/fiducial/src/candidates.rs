//! Where in an image a marker may be.

pub(crate) mod ellipses;
pub(crate) mod ring;
pub(crate) mod ring_profile;
