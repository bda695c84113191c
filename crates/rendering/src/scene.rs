//! Defines the rendered scene: light, ground, pads (drawing, pose, paper) and painted marks; and the camera's model, mount,
//! exposure, gain, noise, blur and processing.

use geometry::{Body, Camera, CameraModel, Marker as MarkerFrame, Ned, Point, Rotation, Transform};
use markers::{Drawing, Marker};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};

use crate::error::RenderError;
use crate::ground::Surface;
use crate::processing::Processing;

/// Reflectance of paper.
pub(crate) const PAPER: f32 = 0.88;

/// The objects in the scene.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The ground, at height 0 in NED.
    pub surface: Surface,
    /// The pads on it.
    pub pads: Vec<PadInScene>,
    /// Number of circles, rings and lines painted around the first pad that are not markers.
    pub painted_marks: u32,
    /// Light on the scene; 1 is full sun.
    pub light: f64,
}

/// Something printed on top of a flat square box.
#[derive(Clone, Debug)]
pub struct PadInScene {
    /// Its print.
    pub drawing: Drawing,
    /// The printed face in the world.
    pub ned_from_marker: Transform<Ned, MarkerFrame>,
    /// Edge of the box's white lid, in metres.
    pub paper_m: f64,
    /// Height of the box under the printed face, in metres.
    pub thickness_m: f64,
}

/// The camera and its settings.
#[derive(Clone, Debug)]
pub struct CameraSettings {
    /// Intrinsics.
    pub model: CameraModel,
    /// Where it is mounted.
    pub body_from_camera: Transform<Body, Camera>,
    /// Exposure time, in seconds.
    pub exposure_s: f64,
    /// Time from the exposure of the first row to that of the last, in seconds: 0 for a global shutter.
    pub readout_s: f64,
    /// Gain; at 1 a full well is white.
    pub gain: f64,
    /// Electrons a pixel collects per second from white in full sun.
    pub electrons_per_s: f64,
    /// Full-well capacity of a pixel, in electrons.
    pub full_well_e: f64,
    /// Standard deviation of the read noise, in electrons.
    pub read_noise_e: f64,
    /// Whether shot and read noise are added.
    pub noise: bool,
    /// Standard deviation of the lens blur, in pixels, from 0 to 3.
    pub blur_px: f64,
    /// Vignetting: 0 none, 1 that of the lens' projection, the fourth power of the cosine for a lens that is no fisheye.
    pub vignetting: f64,
    /// The processing of the light on the sensor.
    pub processing: Processing,
}

impl PadInScene {
    /// A marker that lies flat on the ground, as in the thesis (section 4.4.2): `heading` turns the marker's
    /// y axis from north towards east (radians), the box is 0.01 m high, and its lid holds the drawing's
    /// quiet zone.
    pub fn flat(marker: Marker, north_m: f64, east_m: f64, heading: f64) -> Self {
        // The renderer refuses a marker that cannot be drawn.
        let drawing = marker
            .size_m
            .and_then(|size_m| Drawing::new(&marker, size_m))
            .unwrap_or(Drawing { half_extent_m: f64::NAN, layers: Vec::new() });
        Self::printed(drawing, north_m, east_m, heading)
    }

    /// Like [`PadInScene::flat`], with any drawing.
    pub fn printed(drawing: Drawing, north_m: f64, east_m: f64, heading: f64) -> Self {
        const THICKNESS_M: f64 = 0.01;
        let up = Matrix3::from_columns(&[Vector3::y(), Vector3::x(), -Vector3::z()]);
        let flat = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(up));
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading) * flat;
        Self {
            ned_from_marker: Transform::new(
                Rotation::from_quaternion(turned),
                Point::new(north_m, east_m, -THICKNESS_M),
            ),
            paper_m: 2.0 * drawing.half_extent_m,
            thickness_m: THICKNESS_M,
            drawing,
        }
    }
}

impl CameraSettings {
    /// The thesis' camera (section 4.1) with 2 x 2 binning: 1296 x 972 pixels of 4.4 um behind 8 mm, looking
    /// down from the body's origin with the nose at the top of the image; 2 ms in full sun.
    pub fn thesis() -> Self {
        let down = Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        Self {
            model: CameraModel::pinhole(1296, 972, 8e-3 / 4.4e-6),
            body_from_camera: Transform::new(down, Point::origin()),
            exposure_s: 0.002,
            readout_s: 0.0,
            gain: 1.0,
            electrons_per_s: 4e6,
            full_well_e: 8_000.0,
            read_noise_e: 8.0,
            noise: true,
            blur_px: 0.6,
            vignetting: 0.5,
            processing: Processing::LINEAR,
        }
    }

    /// With the exposure of at most `max_exposure_s`, and the gain, at which white paper in `light` has the
    /// grey level `white`.
    #[must_use]
    pub fn exposed_for(mut self, light: f64, white: f64, max_exposure_s: f64) -> Self {
        let electrons = white / 255.0 * self.full_well_e / f64::from(PAPER);
        let needed_s = electrons / (self.electrons_per_s * light.max(1e-9));
        self.exposure_s = needed_s.min(max_exposure_s);
        self.gain = needed_s / self.exposure_s.max(1e-12);
        self
    }

    /// The time at which row `v` has been exposed for the fraction `exposed` of its time, as a fraction of
    /// the time from the opening of the first row to the closing of the last.
    pub fn part_at_row(&self, v: f64, exposed: f64) -> f64 {
        let last = f64::from(self.model.height.saturating_sub(1)).max(1.0);
        let whole_s = self.readout_s + self.exposure_s;
        let at_s = self.readout_s * v / last + self.exposure_s * exposed;
        if whole_s > 0.0 { at_s / whole_s } else { 0.5 }
    }

    /// Grey level of a surface of reflectance 1.
    pub(crate) fn levels_per_reflectance(&self, light: f64) -> f64 {
        self.electrons_per_s * self.exposure_s * light / self.full_well_e * self.gain * 255.0
    }

    pub(crate) fn check(&self) -> Result<(), RenderError> {
        let model = &self.model;
        let pixels = |edge: u32| (1..=65_535).contains(&edge);
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let checks = [
            (pixels(model.width) && pixels(model.height), "an image edge is not from 1 to 65535"),
            (positive(model.fx) && positive(model.fy), "a focal length is not above 0"),
            (model.cx.is_finite() && model.cy.is_finite(), "the principal point is not finite"),
            (self.exposure_s.is_finite() && self.exposure_s >= 0.0, "the exposure is below 0"),
            (self.readout_s.is_finite() && self.readout_s >= 0.0, "the readout time is below 0"),
            (positive(self.gain), "the gain is not above 0"),
            (positive(self.electrons_per_s), "the electrons per second are not above 0"),
            (positive(self.full_well_e), "the full well is not above 0"),
            (
                self.read_noise_e.is_finite() && self.read_noise_e >= 0.0,
                "the read noise is below 0",
            ),
            ((0.0..=3.0).contains(&self.blur_px), "the lens blur is not from 0 to 3 px"),
            ((0.0..=1.0).contains(&self.vignetting), "the vignetting is not from 0 to 1"),
        ];
        checks
            .iter()
            .find(|(holds, _)| !holds)
            .map_or(Ok(()), |(_, why)| Err(RenderError::Setting(why)))?;
        self.processing.check()
    }
}
