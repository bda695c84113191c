//! From the target to a velocity.

pub mod metric;
pub mod thesis;
