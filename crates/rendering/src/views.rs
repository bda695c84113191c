//! Renders the thesis' marker from above, at the reference positions of the thesis' experiment (Table 4.1): the
//! frames, their pixels and their truth.

use std::f64::consts::TAU;
use std::fmt::Write as _;

use crate::error::RenderError;
use crate::ground::Surface;
use crate::render::Renderer;
use crate::scene::{CameraSettings, PadInScene, Scene};
use geometry::{Body, Camera, CameraModel, Marker, Ned, Pixel, Rotation, Transform, Vector};

/// Outer diameter of the thesis' marker, in metres.
pub const SIZE_M: f64 = 0.15341;

/// The markers of the experiments, without their size: the four of the thesis, and the most widely used one.
pub const MARKERS: [&str; 5] =
    ["rings", "apriltag-16h5:0", "aruco-4x4-50:0", "stag-hd23:0", "apriltag-36h11:0"];

/// Maximum height of the camera above the marker, in metres; the minimum is 1 m.
pub const MAX_HEIGHT_M: u32 = 13;

/// Binning of the thesis' sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Binning {
    /// 1296 x 972 pixels of 4.4 um behind 8 mm.
    TwoByTwo,
    /// 648 x 486 pixels of 8.8 um behind the same lens.
    FourByFour,
}

impl Binning {
    /// The name of files and tables.
    pub fn name(self) -> &'static str {
        match self {
            Self::TwoByTwo => "2x2",
            Self::FourByFour => "4x4",
        }
    }

    /// The camera's intrinsics.
    pub fn camera(self) -> CameraModel {
        self.settings().model
    }

    /// The camera's settings. At 4 x 4 a pixel is the sum of four of those at 2 x 2: half the lens blur in
    /// pixels, four times the light and full well, and twice the read noise.
    pub fn settings(self) -> CameraSettings {
        let fine = CameraSettings::thesis();
        match self {
            Self::TwoByTwo => fine,
            Self::FourByFour => CameraSettings {
                model: CameraModel::pinhole(648, 486, fine.model.fx / 2.0),
                electrons_per_s: 4.0 * fine.electrons_per_s,
                full_well_e: 4.0 * fine.full_well_e,
                read_noise_e: 2.0 * fine.read_noise_e,
                blur_px: fine.blur_px / 2.0,
                ..fine
            },
        }
    }

    /// The intrinsics as ROS `camera_info` YAML.
    pub fn calibration(self) -> String {
        let CameraModel { width, height, fx, fy, cx, cy, .. } = self.camera();
        let mut text = format!("image_width: {width}\nimage_height: {height}\n");
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "camera_matrix: {{rows: 3, cols: 3, data: [{fx}, 0, {cx}, 0, {fy}, {cy}, 0, 0, 1]}}"
        );
        text.push_str("distortion_model: plumb_bob\n");
        text.push_str(
            "distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}\n",
        );
        text
    }
}

/// A frame to render.
#[derive(Clone, Copy, Debug)]
pub struct View {
    /// The camera's binning.
    pub binning: Binning,
    /// Height of the camera above the marker's face.
    pub height_m: u32,
    /// Distance of the marker to the right of the axis of a camera without tilt, in metres.
    pub lateral_m: f64,
    /// Angle of the axis from straight down, in degrees.
    pub tilt_deg: f64,
    /// Number of the frame at its position.
    pub repeat: u32,
}

/// Lateral positions of the thesis' marker at a height, in metres (Table 4.1).
pub fn laterals_m(height_m: u32) -> &'static [f64] {
    match height_m {
        ..=1 => &[0.0],
        2..=3 => &[-0.5, 0.0, 0.5],
        4..=6 => &[-1.0, 0.0, 1.0],
        7.. => &[-2.0, 0.0, 2.0],
    }
}

/// `repeats` frames at each position, of one camera at one tilt.
pub fn views(binning: Binning, tilt_deg: f64, repeats: u32) -> Vec<View> {
    let mut views = Vec::new();
    for height_m in 1..=MAX_HEIGHT_M {
        for lateral_m in laterals_m(height_m).iter().copied() {
            let view = |repeat| View { binning, height_m, lateral_m, tilt_deg, repeat };
            views.extend((0..repeats).map(view));
        }
    }
    views
}

impl View {
    /// A unique name, such as `2x2-tilt0-07m-left2.0m-3`.
    pub fn name(&self) -> String {
        let side = match self.lateral_m {
            ..0.0 => "left",
            0.0 => "mid",
            _ => "right",
        };
        format!(
            "{}-tilt{}-{:02}m-{side}{:.1}m-{}",
            self.binning.name(),
            self.tilt_deg,
            self.height_m,
            self.lateral_m.abs(),
            self.repeat
        )
    }

    /// A number that is unique among the frames of a binning.
    fn index(&self) -> u32 {
        let position = self.height_m * 10 + (self.lateral_m * 2.0 + 4.0) as u32;
        (position * 100 + self.repeat % 100) * 100 + self.tilt_deg as u32
    }

    /// `ned_from_body` for a camera that sees the marker's centre within a few pixels of the position's.
    /// Heading, direction of the tilt and the pixel are spread evenly over the frames.
    fn ned_from_body(
        &self,
        settings: &CameraSettings,
        ned_from_marker: &Transform<Ned, Marker>,
    ) -> Transform<Ned, Body> {
        const MAX_JITTER_PX: f64 = 4.0;
        let spread = Spread { index: self.index() };
        let (heading, towards) = (spread.fraction(1) * TAU, spread.fraction(2) * TAU);
        let tilt = self.tilt_deg.to_radians();
        let axis = Vector::new(tilt * towards.cos(), tilt * towards.sin(), 0.0);
        let ned_from_level = Rotation::<Ned, Body>::from_euler(0.0, 0.0, heading);
        let ned_from_body = Rotation::from_quaternion(
            ned_from_level.quaternion
                * Rotation::<Ned, Body>::from_rotation_vector(axis).quaternion,
        );
        let ned_from_camera = ned_from_body * settings.body_from_camera.rotation();
        let camera = &settings.model;
        let lateral_px = camera.fx * self.lateral_m / f64::from(self.height_m);
        let jitter_px = |i| MAX_JITTER_PX * (2.0 * spread.fraction(i) - 1.0);
        let seen_at = Pixel::new(camera.cx + lateral_px + jitter_px(3), camera.cy + jitter_px(4));
        let sight = ned_from_camera * camera.unproject_clamped(seen_at);
        let place = ned_from_marker.origin() - sight * (f64::from(self.height_m) / sight.z());
        let ned_from_camera: Transform<Ned, Camera> = Transform::new(ned_from_camera, place);
        ned_from_camera * settings.body_from_camera.inverse()
    }
}

/// Quasirandom numbers: the additive sequence in four dimensions of the generalised golden ratio (Roberts,
/// "The unreasonable effectiveness of quasirandom sequences", 2018).
struct Spread {
    index: u32,
}

impl Spread {
    /// A number from 0 to 1, in dimension 1 to 4.
    fn fraction(&self, dimension: i32) -> f64 {
        // The root of x^5 = x + 1.
        const RATIO: f64 = 1.167_303_978_261_418_7;
        (0.5 + f64::from(self.index) * RATIO.powi(-dimension)).fract()
    }
}

/// The truth of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Truth {
    /// The marker's centre in the image.
    pub centre: Pixel,
    /// The marker in the camera frame.
    pub camera_from_marker: Transform<Camera, Marker>,
}

/// A camera over the marker on painted asphalt in full sun.
#[derive(Debug)]
pub struct TestScene {
    renderer: Renderer,
    ned_from_marker: Transform<Ned, Marker>,
}

impl TestScene {
    /// The marker of the thesis under a camera of this binning.
    ///
    /// # Errors
    /// [`RenderError`] when the scene is invalid.
    pub fn new(binning: Binning) -> Result<Self, RenderError> {
        let marker =
            markers::Marker { family: markers::Family::Rings, id: None, size_m: Some(SIZE_M) };
        let pad = PadInScene::flat(marker, 0.0, 0.0, 0.0);
        let ned_from_marker = pad.ned_from_marker;
        let scene =
            Scene { surface: Surface::Asphalt, pads: vec![pad], painted_marks: 20, light: 1.0 };
        Ok(Self { renderer: Renderer::new(&scene, binning.settings(), 1)?, ned_from_marker })
    }

    /// The pixels, row by row, and their truth.
    ///
    /// # Errors
    /// [`RenderError`] when the marker is behind the camera.
    pub fn render(&mut self, view: &View) -> Result<(Vec<u8>, Truth), RenderError> {
        let settings = self.renderer.settings().clone();
        let ned_from_body = view.ned_from_body(&settings, &self.ned_from_marker);
        let mut pixels = vec![0; settings.model.width as usize * settings.model.height as usize];
        self.renderer.render(&[ned_from_body], u64::from(view.index()), &mut pixels)?;
        let ned_from_camera = ned_from_body * settings.body_from_camera;
        let camera_from_marker = ned_from_camera.inverse() * self.ned_from_marker;
        let centre = settings.model.project(camera_from_marker.origin());
        let centre = centre.ok_or(RenderError::Setting("the marker is behind the camera"))?;
        Ok((pixels, Truth { centre, camera_from_marker }))
    }
}
