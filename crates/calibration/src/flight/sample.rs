//! Defines the input of a flight: the vehicle's poses and the markers' detections.

use geometry::{Body, Camera, CameraModel, Ned, Point, Rotation, Transform, Vector};
use nalgebra::Matrix3;

/// The vehicle at an instant, as reported by its autopilot.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct VehicleSample {
    /// When, in seconds of the clock of all samples.
    pub stamp_s: f64,
    /// The attitude.
    pub ned_from_body: Rotation<Ned, Body>,
    /// The position of the body's origin.
    pub position: Point<Ned>,
    /// Its velocity in m/s.
    pub velocity: Vector<Ned>,
}

/// The pad's marker as it was found in a frame.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct MarkerSample {
    /// The frame's stamp, in seconds of the clock of all samples.
    pub stamp_s: f64,
    /// The marker's place by the configured intrinsics.
    pub place: Point<Camera>,
    /// Its covariance in square metres.
    pub covariance_m2: Matrix3<f64>,
}

/// The camera as it is configured.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct ConfiguredCamera {
    /// The intrinsics.
    pub model: CameraModel,
    /// The mount.
    pub body_from_camera: Transform<Body, Camera>,
}
