//! Topics to and from the ground station.
