//! Frames in, marker detections out.
