//! Marker detections in, velocity setpoints out.
