//! The link to the autopilot, and the only crate that knows MAVLink.
