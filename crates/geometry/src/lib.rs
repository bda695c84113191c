//! Defines coordinate frames as types, rigid transforms, and camera models.
//!
//! A position has its coordinate frame in its type: `Point<Camera>` cannot be added to a
//! `Vector<Ned>`. Transforms are named `to_from_from` and compose like fractions:
//! `ned_from_body * body_from_camera * point_in_camera`.
//!
//! This crate does not depend on images, markers, a clock or files.
//!
//! Modules in reading order: [`frame`] names the coordinate frames, [`transform`] moves between them,
//! [`camera`] goes from the camera frame to pixels and back, [`roi`] from a region of an image to the whole,
//! [`mod@homography`] from a plane to its image;
//! [`arithmetic`] has the functions of numbers that may be used.

#![cfg_attr(not(test), deny(clippy::disallowed_methods))] // The same results on every machine.

pub mod arithmetic;
pub mod camera;
pub mod frame;
pub mod homography;
pub mod roi;
pub mod transform;

pub use arithmetic::{cubed, squared};
pub use camera::{CameraModel, Distortion, Pixel};
pub use frame::{Board, Body, Camera, Frame, Marker, Ned, Odometry, Pad};
pub use homography::homography;
pub use roi::Roi;
pub use transform::{Point, Rotation, Transform, Vector};
