//! Frames from cameras and image files, published with their stamp.
