//! Converts a detection to a measurement: the marker's pose joined with the vehicle's motion at the exposure.

use geometry::{Body, Marker, Ned, Point, Rotation, Transform, Vector, squared};
use libm::{acos, fmax};
use nalgebra::{Matrix3, Vector3};

use crate::config::EstimatorConfig;
use crate::decision::Rejection;
use crate::event::{FrameObservation, MarkerInFrame};
use crate::history::Motion;
use crate::time::Timestamp;

/// Largest horizontal distance of a marker from the vehicle, relative to its depth below.
const MAX_SLOPE: f64 = 3.0;

/// Two solutions of a flat marker's pose whose normals are equally upright within this angle, in radians, are
/// averaged.
const UNDECIDED_RAD: f64 = 0.05;

/// A measurement of the pad's position.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Measurement {
    pub(crate) stamp: Timestamp,
    /// The pad in the odometry frame, in metres.
    pub(crate) position: Vector3<f64>,
    /// Distance of the vehicle, in metres.
    pub(crate) range_m: f64,
    /// Covariance of that position, in m^2.
    pub(crate) noise: Matrix3<f64>,
    /// Derivative of that position by a tilt about each of the body's axes, in metres per radian.
    pub(crate) tilt: Matrix3<f64>,
    /// Derivative of that position by the time offset, apart from the pad's own velocity, in m/s.
    pub(crate) slip: Vector3<f64>,
}

/// A marker as the vehicle sees it: the one of two pose solutions that fits a pad.
#[derive(Copy, Clone, Debug)]
pub(crate) struct MarkerPose {
    /// From the body's origin to the marker.
    in_body: Vector<Body>,
    pub(crate) rotation: Rotation<Body, Marker>,
    /// Covariance that the ambiguity of the pose adds, in m^2.
    spread: Matrix3<f64>,
}

impl MarkerPose {
    /// Of two solutions of a flat marker's pose the one whose face looks up; when both do, their mean, with
    /// their difference as covariance.
    pub(crate) fn resolve(
        motion: &Motion,
        pose: Transform<Body, Marker>,
        alternative: Option<Transform<Body, Marker>>,
    ) -> Self {
        let of = |pose: Transform<Body, Marker>| Self {
            in_body: pose.origin() - Point::origin(),
            rotation: pose.rotation(),
            spread: Matrix3::zeros(),
        };
        let first = of(pose);
        let Some(alternative) = alternative else { return first };
        let second = of(alternative);
        let tilt = |pose: &Self| {
            let face =
                motion.ned_from_body * (pose.rotation * Vector::<Marker>::new(0.0, 0.0, 1.0));
            acos((-face.z()).clamp(-1.0, 1.0))
        };
        let preference = tilt(&second) - tilt(&first);
        if preference > UNDECIDED_RAD {
            first
        } else if preference < -UNDECIDED_RAD {
            second
        } else {
            let half = (second.in_body - first.in_body) * 0.5;
            Self {
                in_body: first.in_body + half,
                spread: half.coords * half.coords.transpose(),
                ..first
            }
        }
    }

    /// The measurement that this pose makes, or why it is not plausible.
    pub(crate) fn measurement(
        &self,
        config: &EstimatorConfig,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        motion: &Motion,
    ) -> Result<Measurement, Rejection> {
        let from_vehicle = motion.ned_from_body * self.in_body;
        check_plausible(from_vehicle, config.max_range_m)?;
        let in_body = noise_in_body(config, frame, marker, self.in_body) + self.spread;
        let r = from_vehicle.coords;
        let axis = |x, y, z| (motion.ned_from_body * Vector::<Body>::new(x, y, z)).coords;
        let axes =
            Matrix3::from_columns(&[axis(1.0, 0.0, 0.0), axis(0.0, 1.0, 0.0), axis(0.0, 0.0, 1.0)]);
        let tilt = Matrix3::from_columns(&[
            axes.column(0).cross(&r),
            axes.column(1).cross(&r),
            axes.column(2).cross(&r),
        ]);
        let turning = (motion.ned_from_body * motion.rate).coords;
        let noise = axes * in_body * axes.transpose()
            + tilt * tilt.transpose() * squared(config.attitude_noise_rad)
            + Matrix3::identity() * squared(config.position_noise_m);
        Ok(Measurement {
            stamp: frame.stamp,
            position: motion.odometry.coords.coords + r,
            range_m: r.norm(),
            noise,
            tilt,
            slip: -motion.velocity.coords - turning.cross(&r),
        })
    }
}

/// Refuses a marker that is not below the vehicle, far to its side, or out of range.
pub(crate) fn check_plausible(
    from_vehicle: Vector<Ned>,
    max_range_m: f64,
) -> Result<(), Rejection> {
    let is_below = from_vehicle.z() > 0.0;
    let is_steep = from_vehicle.horizontal_norm() < MAX_SLOPE * from_vehicle.z();
    if is_below && is_steep && from_vehicle.norm() <= max_range_m {
        Ok(())
    } else {
        Err(Rejection::Implausible)
    }
}

/// Covariance of a pose's origin: the detector's, or one from pixel noise, size and range.
fn noise_in_body(
    config: &EstimatorConfig,
    frame: &FrameObservation,
    marker: &MarkerInFrame,
    in_body: Vector<Body>,
) -> Matrix3<f64> {
    let range_m = in_body.norm();
    let along = in_body.coords / fmax(range_m, 1e-6);
    if let Some(covariance) = marker.covariance_m2 {
        // A detector measures pixels, not how large the marker was printed.
        let floor = squared(config.range_floor_ratio * range_m);
        return (covariance + covariance.transpose()) * 0.5 + along * along.transpose() * floor;
    }
    let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0);
    let pixel_rad =
        focal_px.map_or(config.direction_noise_rad, |focal_px| config.pixel_noise_px / focal_px);
    let size_px = marker.size_px.filter(|size_px| *size_px > 1.0);
    let range_ratio =
        size_px.map_or(config.range_noise_ratio, |size_px| 2.0 * config.pixel_noise_px / size_px);
    let across = squared(range_m * pixel_rad);
    Matrix3::identity() * across
        + along * along.transpose() * (squared(range_m * range_ratio) - across)
}
