//! Finds the regions of an image where a marker may be.

pub(crate) mod ellipses;
pub(crate) mod evidence;
pub(crate) mod outline_quads;
pub(crate) mod overlap;
pub(crate) mod quad;
pub(crate) mod quiet_zone;
pub(crate) mod ring;
pub(crate) mod ring_profile;
pub(crate) mod segment_quads;
pub(crate) mod sides;
