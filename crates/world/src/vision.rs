//! Models the detector `rings`: detections with the errors that it makes in rendered frames, without the
//! frames.
//!
//! The numbers of [`RINGS`] are fitted by `cargo run --release -p experiments --example fit_vision`, which
//! prints the table they are read from.

use geometry::{Camera, CameraModel, Marker, Pixel, Point, Rotation, Transform, Vector};
use nalgebra::Matrix3;
use rand_chacha::ChaCha8Rng;

use crate::drift::{normal, random_stream, uniform};

/// The errors of a detector by the marker's size in the image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct VisionModel {
    /// Markers up to this size are never found, in pixels, and the increase per pixel of motion blur.
    pub never_px: [f64; 2],
    /// Markers from this size on are always found, but for `miss`, in pixels, and the increase per pixel
    /// of motion blur.
    pub always_px: [f64; 2],
    /// Part of the frames in which a large marker is missed.
    pub miss: f64,
    /// Deviation of the centre along either axis of the image, in pixels.
    pub centre_px: f64,
    /// Growth of the centre's deviation per pixel of motion blur.
    pub centre_per_blur: f64,
    /// Deviation of the size in the image, and with it of the range, in pixels.
    pub size_px: f64,
    /// Growth of the size's deviation per pixel of motion blur.
    pub size_per_blur: f64,
    /// Mean error of the range, relative to the range.
    pub range_bias: f64,
    /// Deviation of the tilt, times the size, in radians times pixels.
    pub tilt_rad_px: f64,
    /// Largest deviation of the tilt, in radians.
    pub tilt_rad: f64,
    /// Reported standard deviation over the true one: of the centre, and of the range.
    pub reported: [f64; 2],
    /// Part of the detections whose error is `outlier_times` as large.
    pub outliers: f64,
    /// Factor on the error of those.
    pub outlier_times: f64,
}

/// The detector of the family `rings` with its defaults, on the thesis' camera.
pub const RINGS: VisionModel = VisionModel {
    never_px: [6.0, 4.5],
    always_px: [8.0, 6.0],
    miss: 0.0,
    centre_px: 0.003,
    centre_per_blur: 0.0015,
    size_px: 0.01,
    size_per_blur: 0.005,
    range_bias: 0.0,
    tilt_rad_px: 0.13,
    tilt_rad: 0.5,
    reported: [1.5, 1.5],
    outliers: 0.02,
    outlier_times: 5.0,
};

/// A detection of the model.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Found {
    /// The projection of the marker's centre.
    pub centre: Pixel,
    /// Edge or diameter in the image, in pixels.
    pub size_px: f64,
    /// The marker's pose.
    pub camera_from_marker: Transform<Camera, Marker>,
    /// Covariance of its origin in the camera's axes, in m^2.
    pub covariance_m2: Matrix3<f64>,
}

/// Faults of a detector beyond its noise.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub struct VisionFaults {
    /// Part of the frames in which the marker is missed, in addition to the model's misses.
    pub miss: f64,
    /// Between these times, in seconds after the world's begin, the marker is reported this many metres north
    /// of its place.
    pub offset: Option<(f64, f64, f64)>,
    /// Part of the frames in which a wrong marker is reported, and its distance to the east in metres.
    pub wrong: Option<(f64, f64)>,
    /// Error of the configured marker size, relative to the size.
    pub size_error: f64,
    /// The marker is not found from below this height over it, in metres.
    pub blind_below_m: f64,
}

/// A detector that looks at truths instead of frames.
#[derive(Clone, Debug)]
pub struct Vision {
    model: VisionModel,
    camera: CameraModel,
    marker_m: f64,
    random: ChaCha8Rng,
}

impl Vision {
    /// A detector behind this camera for a marker of this size in metres; its chance comes from the seed.
    pub fn new(model: VisionModel, camera: CameraModel, marker_m: f64, seed: u64) -> Self {
        Self { model, camera, marker_m, random: random_stream(seed, 6) }
    }

    /// The detection of a marker with this true pose and motion blur.
    pub fn look(&mut self, truth: &Transform<Camera, Marker>, blur_px: f64) -> Option<Found> {
        // Always drawn, so that one frame does not change the random numbers of the next.
        let luck = [(); 2].map(|()| uniform(&mut self.random));
        let noise = [(); 5].map(|()| normal(&mut self.random));
        let depth_m = truth.origin().z();
        let size_px = self.size_px(truth)?;
        let model = &self.model;
        let limit_px = |[still, per_blur]: [f64; 2]| still + per_blur * blur_px;
        let (never_px, always_px) = (limit_px(model.never_px), limit_px(model.always_px));
        let share = (size_px - never_px) / (always_px - never_px).max(1e-6);
        if luck[0] >= share.clamp(0.0, 1.0) * (1.0 - model.miss) || !self.sees_all_of(truth) {
            return None;
        }
        let wild = if luck[1] < model.outliers { model.outlier_times } else { 1.0 };
        let centre_px = wild * (model.centre_px + model.centre_per_blur * blur_px);
        let range_part = wild * (model.size_px + model.size_per_blur * blur_px) / size_px;
        let tilt_rad = wild * (model.tilt_rad_px / size_px).min(model.tilt_rad);
        let true_centre = self.camera.project(truth.origin())?;
        let centre =
            Pixel::new(true_centre.x + centre_px * noise[0], true_centre.y + centre_px * noise[1]);
        let range_m = depth_m * (1.0 + model.range_bias + range_part * noise[2]);
        let ray = self.camera.unproject_clamped(centre);
        let turned = Vector::<Camera>::new(tilt_rad * noise[3], tilt_rad * noise[4], 0.0);
        let rotation = Rotation::<Camera, Camera>::from_rotation_vector(turned) * truth.rotation();
        let along = ray.coords / ray.z();
        let focal_px = 0.5 * (self.camera.fx + self.camera.fy);
        let sideways = (model.reported[0] * depth_m * centre_px / wild / focal_px).powi(2);
        let spread = (model.reported[1] * depth_m * range_part / wild).powi(2);
        Some(Found {
            centre,
            size_px,
            camera_from_marker: Transform::new(
                rotation,
                Point::origin() + ray * (range_m / ray.z()),
            ),
            covariance_m2: Matrix3::from_diagonal(&[sideways, sideways, 0.0].into())
                + along * along.transpose() * spread,
        })
    }

    /// A number from 0 to 1 from the detector's chance.
    pub fn draw(&mut self) -> f64 {
        uniform(&mut self.random)
    }

    /// Size of the marker in the image, in pixels; `None` behind the camera.
    pub fn size_px(&self, truth: &Transform<Camera, Marker>) -> Option<f64> {
        let depth_m = truth.origin().z();
        let focal_px = 0.5 * (self.camera.fx + self.camera.fy);
        (depth_m > 1e-3).then(|| self.marker_m * focal_px / depth_m)
    }

    fn sees_all_of(&self, truth: &Transform<Camera, Marker>) -> bool {
        let half = 0.5 * self.marker_m;
        let (width, height) = (f64::from(self.camera.width), f64::from(self.camera.height));
        let rim = (0..8).map(|i| f64::from(i) * std::f64::consts::FRAC_PI_4);
        rim.map(|angle| *truth * Point::new(half * angle.cos(), half * angle.sin(), 0.0)).all(
            |point| {
                let pixel = self.camera.project(point);
                pixel.is_some_and(|p| (0.0..width).contains(&p.x) && (0.0..height).contains(&p.y))
            },
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn above(depth_m: f64, aside_m: f64) -> Transform<Camera, Marker> {
        let half_turn = Vector::<Marker>::new(std::f64::consts::PI, 0.0, 0.0);
        Transform::new(Rotation::from_rotation_vector(half_turn), Point::new(aside_m, 0.0, depth_m))
    }

    fn vision() -> Vision {
        Vision::new(RINGS, CameraModel::pinhole(1296, 972, 1818.0), 0.153_41, 1)
    }

    #[test]
    fn errors_are_as_large_as_modelled_and_as_reported() {
        let (mut vision, truth) = (vision(), above(5.0, 0.3));
        let all: Vec<Found> = (0..4000).filter_map(|_| vision.look(&truth, 1.0)).collect();
        assert!(all.len() > 3800, "{}", all.len());
        let rms = |of: &dyn Fn(&Found) -> f64| {
            (all.iter().map(|f| of(f).powi(2)).sum::<f64>() / all.len() as f64).sqrt()
        };
        let right = vision.camera.project(truth.origin()).unwrap();
        let centre = rms(&|f| f.centre.x - right.x);
        let wanted = RINGS.centre_px + RINGS.centre_per_blur;
        assert!((centre / wanted - 1.0).abs() < 0.3, "{centre} px for {wanted}");
        let range = rms(&|f| f.camera_from_marker.origin().z() - 5.0 * (1.0 + RINGS.range_bias));
        let stated = rms(&|f| f.covariance_m2.m33.sqrt());
        assert!(
            (range * RINGS.reported[1] / stated - 1.0).abs() < 0.3,
            "{range} m, stated {stated}"
        );
    }

    #[test]
    fn markers_too_small_or_cut_by_the_image_are_not_found() {
        let mut vision = vision();
        assert!(vision.look(&above(60.0, 0.0), 0.0).is_none());
        assert!(vision.look(&above(1.0, 0.34), 0.0).is_none());
        assert!(vision.look(&above(-1.0, 0.0), 0.0).is_none());
        assert!(vision.look(&above(1.0, 0.0), 0.0).is_some());
    }
}
