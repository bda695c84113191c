//! What can be chosen about a camera.

use std::path::{Path, PathBuf};
use std::time::Duration;

use airlink::AirConfig;
use anyhow::{bail, ensure};
use geometry::{Body, Camera, CameraModel, Distortion, Point, Rotation, Transform};
use imaging::{GrayView, Mosaic};
use media::read_calibration;
use node::{Check, Settings};
use serde::Deserialize;

use crate::program::Form;

/// The camera service's configuration; its keys are explained in `camera-pub.toml`.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    id: String,
    pub(crate) source: SourceConfig,
    pub(crate) air: AirConfig,
    calibration: CalibrationConfig,
    mount: MountConfig,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct SourceConfig {
    pub(crate) paths: Vec<PathBuf>,
    pub(crate) rate_hz: f64,
    pub(crate) repeat: bool,
    pub(crate) wait_for_subscriber: bool,
    bayer: String,
    largest_megapixels: f64,
    command: Vec<String>,
    pixels: String,
    size_px: [u32; 2],
    row_bytes: usize,
    delay_ms: f64,
    silence_s: f64,
}

/// A program that writes pictures.
#[derive(Clone, Debug)]
pub(crate) struct ProgramConfig {
    /// The program and its arguments.
    pub(crate) command: Vec<String>,
    /// Width and height of its pictures, in pixels.
    pub(crate) size: (usize, usize),
    /// How it writes them.
    pub(crate) form: Form,
    /// Bits of a sample.
    pub(crate) bits: u32,
    /// Pictures a second that it was asked for.
    pub(crate) rate_hz: f64,
    /// From the middle of the exposure to a picture's first byte.
    pub(crate) delay_ns: i64,
    /// Longest time without a picture.
    pub(crate) silence: Duration,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct CalibrationConfig {
    file: PathBuf,
    focal_px: [f64; 2],
    principal_px: Vec<f64>,
    lens: String,
    distortion: Vec<f64>,
}

#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MountConfig {
    translation_m: [f64; 3],
    orientation: String,
    roll_pitch_yaw_deg: [f64; 3],
    rotation_wxyz: [f64; 4],
}

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../camera-pub.toml");

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.range("source.rate_hz", self.source.rate_hz, 0.01..=1000.0);
        check.parses("source.bayer", self.source.mosaic());
        check.range("source.largest_megapixels", self.source.largest_megapixels, 0.001..=4294.0);
        check.one_of("source.pixels", &self.source.pixels, PIXELS);
        check.range("source.delay_ms", self.source.delay_ms, 0.0..=10_000.0);
        check.range("source.silence_s", self.source.silence_s, 0.1..=3600.0);
        check.parses("source.command", self.source.program());
        self.air.check(check);
        self.calibration.check(check);
        self.mount.check(check);
    }
}

impl Config {
    /// The camera's name, which is the service's instance.
    pub fn instance(&self) -> &str {
        &self.id
    }

    /// Pixels an image may have.
    pub(crate) fn most_pixels(&self) -> u64 {
        (self.source.largest_megapixels * 1e6) as u64
    }

    /// The intrinsics for images of this size (width, height); `None` for a camera that is not calibrated.
    pub(crate) fn intrinsics(&self, size: (usize, usize)) -> anyhow::Result<Option<CameraModel>> {
        let (width, height) = (size.0 as u32, size.1 as u32);
        let calibration = &self.calibration;
        if calibration.file != Path::new("") {
            let camera = read_calibration(&calibration.file)?;
            ensure!(
                (camera.width, camera.height) == (width, height),
                "the calibration {:?} is for images of {} x {} pixels, but the frames have {width} x {height}; \
                 calibrate the camera at the size it is used at",
                calibration.file,
                camera.width,
                camera.height,
            );
            return Ok(Some(camera));
        }
        let [fx, fy] = calibration.focal_px;
        if fx == 0.0 || fy == 0.0 {
            return Ok(None);
        }
        let Ok(distortion) = calibration.lens() else {
            bail!("the lens was not checked");
        };
        let middle = CameraModel::pinhole(width, height, fx);
        let (cx, cy) = match *calibration.principal_px.as_slice() {
            [cx, cy] => (cx, cy),
            _ => (middle.cx, middle.cy),
        };
        Ok(Some(CameraModel { fy, cx, cy, distortion, ..middle }))
    }

    /// The camera in the vehicle.
    pub(crate) fn body_from_camera(&self) -> Transform<Body, Camera> {
        let [x, y, z] = self.mount.translation_m;
        // A quaternion of no length does not pass the check.
        let rotation = self.mount.rotation().unwrap_or_else(Rotation::identity);
        Transform::new(rotation, Point::new(x, y, z))
    }
}

/// The forms in which a program may write pictures.
const PIXELS: &[&str] = &["gray8", "gray16", "yuv420", "mjpeg"];

impl SourceConfig {
    /// The program that writes the pictures; `None` where they come from files.
    pub(crate) fn program(&self) -> anyhow::Result<Option<ProgramConfig>> {
        if self.command.is_empty() {
            return Ok(None);
        }
        ensure!(self.paths.is_empty(), "with a program, `source.paths` must be empty");
        let [width, height] = self.size_px.map(|edge| edge as usize);
        let pixels = width.saturating_mul(height);
        let edge = GrayView::LARGEST_EDGE_PX;
        ensure!(
            pixels > 0
                && width.max(height) <= edge
                && pixels as f64 <= self.largest_megapixels * 1e6,
            "`source.size_px` is [{width}, {height}]; write the width and height that the program was asked for, within \
             `source.largest_megapixels` ({}) and {edge} pixels an edge",
            self.largest_megapixels
        );
        let bits = if self.pixels == "gray16" { 16 } else { 8 };
        let bytes = width * bits as usize / 8;
        let with_fill = if self.row_bytes == 0 { bytes } else { self.row_bytes };
        ensure!(
            (bytes..=16 * bytes + 4096).contains(&with_fill),
            "`source.row_bytes` is {with_fill}, but a row has {bytes} bytes; write 0 if nothing fills it up"
        );
        let rest = match self.pixels.as_str() {
            "yuv420" => 2 * with_fill.div_ceil(2) * height.div_ceil(2),
            _ => 0,
        };
        let is_raw = self.pixels.starts_with("gray");
        ensure!(
            is_raw || self.bayer.is_empty(),
            "`source.bayer` needs `source.pixels` gray8 or gray16"
        );
        let form = match self.pixels.as_str() {
            // No picture that is worth looking at is larger as a JPEG than as it is.
            "mjpeg" => Form::Jpeg { most_bytes: 4 * pixels + (1 << 16) },
            _ => Form::Samples { row: (bytes, with_fill), rows: height, rest },
        };
        Ok(Some(ProgramConfig {
            command: self.command.clone(),
            size: (width, height),
            form,
            bits,
            rate_hz: self.rate_hz,
            delay_ns: (self.delay_ms * 1e6) as i64,
            silence: Duration::from_secs_f64(self.silence_s),
        }))
    }

    /// The colours in front of the sensor's pixels.
    pub(crate) fn mosaic(&self) -> anyhow::Result<Option<Mosaic>> {
        Ok(match self.bayer.as_str() {
            "" => None,
            name => Some(name.parse()?),
        })
    }
}

impl CalibrationConfig {
    fn check(&self, check: &mut Check<'_>) {
        let [fx, fy] = self.focal_px;
        let focal_holds =
            [fx, fy].iter().all(|f| (0.0..=1e6).contains(f)) && (fx == 0.0) == (fy == 0.0);
        check.parses(
            "calibration.focal_px",
            holds(focal_holds, "both must be above 0 and at most 1e6, or both 0"),
        );
        let principal_holds = match *self.principal_px.as_slice() {
            [] => true,
            [cx, cy] => [cx, cy].iter().all(|c| (-1e6..=1e6).contains(c)),
            _ => false,
        };
        check.parses(
            "calibration.principal_px",
            holds(principal_holds, "it must be [cx, cy], each from -1e6 to 1e6, or empty"),
        );
        check.one_of(
            "calibration.lens",
            &self.lens,
            &["pinhole", "brown-conrady", "kannala-brandt"],
        );
        check.parses("calibration.distortion", self.lens());
    }

    fn lens(&self) -> Result<Distortion, &'static str> {
        let k = &self.distortion;
        if k.iter().any(|k| !(-1e6..=1e6).contains(k)) {
            return Err("each must be from -1e6 to 1e6");
        }
        match self.lens.as_str() {
            "brown-conrady" if k.len() <= 8 => {
                let mut all = [0.0; 8];
                for (slot, k) in all.iter_mut().zip(k) {
                    *slot = *k;
                }
                Ok(Distortion::BrownConrady(all))
            }
            "brown-conrady" => Err("a brown-conrady lens has at most 8 coefficients"),
            "kannala-brandt" => k
                .as_slice()
                .try_into()
                .map(Distortion::KannalaBrandt)
                .map_err(|_cause| "a kannala-brandt lens has 4 coefficients"),
            _ if k.is_empty() => Ok(Distortion::None),
            _ => Err("a pinhole has none; name the lens"),
        }
    }
}

impl MountConfig {
    fn check(&self, check: &mut Check<'_>) {
        let within = |values: &[f64], most: f64| values.iter().all(|v| (-most..=most).contains(v));
        check.parses(
            "mount.translation_m",
            holds(within(&self.translation_m, 100.0), "each must be from -100 to 100"),
        );
        check.one_of(
            "mount.orientation",
            &self.orientation,
            &["down", "forward", "angles", "quaternion"],
        );
        check.parses(
            "mount.roll_pitch_yaw_deg",
            holds(within(&self.roll_pitch_yaw_deg, 360.0), "each must be from -360 to 360"),
        );
        check.parses(
            "mount.rotation_wxyz",
            self.rotation().ok_or("it must be a quaternion w, x, y, z with a length"),
        );
    }

    fn rotation(&self) -> Option<Rotation<Body, Camera>> {
        match self.orientation.as_str() {
            "quaternion" => Rotation::from_wxyz(self.rotation_wxyz),
            // The image's right is the vehicle's right, its bottom down, its depth ahead.
            "forward" => Rotation::from_wxyz([0.5; 4]),
            "angles" => {
                let [roll, pitch, yaw] = self.roll_pitch_yaw_deg.map(f64::to_radians);
                Some(Rotation::from_euler(roll, pitch, yaw))
            }
            _ => Some(Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2)),
        }
    }
}

fn holds(holds: bool, otherwise: &'static str) -> Result<(), &'static str> {
    if holds { Ok(()) } else { Err(otherwise) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Vector;
    use node::Layers;

    fn load(set: &[&str]) -> Result<Config, String> {
        let set = set.iter().map(|s| (*s).to_owned()).collect();
        let layers = Layers { file: None, set };
        layers.load().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn the_defaults_are_an_uncalibrated_camera_that_looks_down() {
        let config = load(&[]).unwrap();
        assert_eq!(config.instance(), "down");
        assert!(config.intrinsics((640, 480)).unwrap().is_none());
        let ahead = config.body_from_camera() * Vector::new(0.0, 0.0, 1.0);
        let top = config.body_from_camera() * Vector::new(0.0, -1.0, 0.0);
        assert!((ahead - Vector::new(0.0, 0.0, 1.0)).norm() < 1e-12);
        assert!((top - Vector::new(1.0, 0.0, 0.0)).norm() < 1e-12);
    }

    #[test]
    fn a_camera_that_looks_forward_sees_the_sky_at_the_top_of_its_image() {
        let mount = load(&["mount.orientation=forward"]).unwrap().body_from_camera();
        let right = mount * Vector::new(1.0, 0.0, 0.0);
        let top = mount * Vector::new(0.0, -1.0, 0.0);
        assert!((right - Vector::new(0.0, 1.0, 0.0)).norm() < 1e-12);
        assert!((top - Vector::new(0.0, 0.0, -1.0)).norm() < 1e-12);
    }

    #[test]
    fn angles_and_quaternions_say_the_same() {
        let down = load(&[]).unwrap().body_from_camera();
        let angles = load(&["mount.orientation=angles"]).unwrap().body_from_camera();
        let quaternion =
            load(&["mount.orientation=quaternion", "mount.rotation_wxyz=[1, 0, 0, 1]"]).unwrap();
        for other in [angles, quaternion.body_from_camera()] {
            assert!((down.rotation().inverse() * other.rotation()).angle() < 1e-7);
        }
    }

    #[test]
    fn intrinsics_come_from_keys() {
        let config = load(&["calibration.focal_px=[900, 901]"]).unwrap();
        let camera = config.intrinsics((640, 480)).unwrap().unwrap();
        assert_eq!([camera.fx, camera.fy, camera.cx, camera.cy], [900.0, 901.0, 319.5, 239.5]);
        let config = load(&[
            "calibration.focal_px=[900, 900]",
            "calibration.principal_px=[300, 200]",
            "calibration.lens=brown-conrady",
            "calibration.distortion=[-0.3, 0.1]",
        ]);
        let camera = config.unwrap().intrinsics((640, 480)).unwrap().unwrap();
        let k = [-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        assert_eq!((camera.cx, camera.distortion), (300.0, Distortion::BrownConrady(k)));
    }

    #[test]
    fn a_calibration_for_another_size_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let text = "cam0: {camera_model: pinhole, intrinsics: [500, 500, 320, 240], resolution: [640, 480]}";
        std::fs::write(file.path(), text).unwrap();
        let config = load(&[&format!("calibration.file={}", file.path().display())]).unwrap();
        assert_eq!(config.intrinsics((640, 480)).unwrap().unwrap().fx, 500.0);
        let problem = config.intrinsics((320, 240)).unwrap_err().to_string();
        assert!(problem.contains("for images of 640 x 480") && problem.contains("have 320 x 240"));
    }

    #[test]
    fn a_program_writes_pictures_of_a_known_form() {
        let form = |set: &[&str]| {
            let all = [&["source.command=['cat']", "source.size_px=[5, 3]"], set].concat();
            load(&all).unwrap().source.program().unwrap().unwrap().form
        };
        let samples = |row, rest| Form::Samples { row, rows: 3, rest };
        assert_eq!(form(&[]), samples((5, 5), 0));
        assert_eq!(form(&["source.pixels=gray16"]), samples((10, 10), 0));
        // Colours of half the width and height, both rounded up, twice.
        assert_eq!(form(&["source.pixels=yuv420"]), samples((5, 5), 12));
        assert_eq!(form(&["source.pixels=yuv420", "source.row_bytes=8"]), samples((5, 8), 16));
        assert!(matches!(form(&["source.pixels=mjpeg"]), Form::Jpeg { .. }));
        assert!(load(&[]).unwrap().source.program().unwrap().is_none());
    }

    #[test]
    fn impossible_values_are_refused() {
        let check = |set: &[&str], part: &str| {
            let problem = load(set).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check(&["id=a/b"], "letters, digits");
        check(&["source.rate_hz=0"], "from 0.01 to 1000");
        check(&["source.rate_hz=inf"], "from 0.01 to 1000");
        check(&["source.largest_megapixels=nan"], "from 0.001 to 4294");
        check(&["air.quality=0"], "from 1 to 100");
        check(&["calibration.focal_px=[900, 0]"], "or both 0");
        check(&["calibration.focal_px=[nan, 900]"], "above 0");
        check(&["calibration.principal_px=[1]"], "[cx, cy]");
        check(&["calibration.lens=fish"], "kannala-brandt");
        check(&["calibration.distortion=[1]"], "name the lens");
        check(&["calibration.lens=kannala-brandt"], "4 coefficients");
        check(&["mount.orientation=up"], "down, forward");
        check(&["mount.translation_m=[0, 0, 1000]"], "-100 to 100");
        check(&["mount.orientation=quaternion", "mount.rotation_wxyz=[0,0,0,0]"], "a quaternion");
        check(&["source.path='x'"], "did you mean `source.paths`");
        check(&["source.command=['cat']"], "`source.size_px` is [0, 0]");
        let camera = |more: &[&'static str], part: &str| {
            check(&[&["source.command=['cat']", "source.size_px=[64, 48]"], more].concat(), part);
        };
        camera(&["source.paths=['x']"], "`source.paths` must be empty");
        camera(&["source.pixels=rgb"], "gray8, gray16");
        camera(&["source.row_bytes=63"], "a row has 64 bytes");
        camera(&["source.pixels=yuv420", "source.bayer=RGGB"], "gray8 or gray16");
        camera(&["source.delay_ms=-1"], "from 0 to 10000");
        camera(&["source.silence_s=0"], "from 0.1 to 3600");
    }
}
