//! Models the effect of a camera and its lens on an edge, and has the numerics that fit a model to pixels.

pub(crate) mod camera_response;
pub(crate) mod edge_response;
pub(crate) mod exposure;
pub(crate) mod homography;
pub(crate) mod inverse_tone;
pub(crate) mod least_squares;
pub(crate) mod mosaic;
pub(crate) mod normal;
pub(crate) mod shadow;
pub(crate) mod undistort;
