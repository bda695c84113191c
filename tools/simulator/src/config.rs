//! The simulator's configuration.

use autopilot::Address;
use fiducial::{Drawing, Marker, Pad};
use geometry::{CameraModel, Point, Transform};
use node::{Check, Settings};
use rendering::{CameraSettings, PadInScene, Scene, Surface};
use serde::Deserialize;

use world::ardupilot::{AutopilotConfig, Firmware};
use world::wind::{WindConfig, WindNoise};
use world::world::WorldConfig;

/// The keys of `simulator.toml`; meanings, units and ranges are told there.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this simulator.
    pub id: String,
    /// Seed of everything random.
    pub seed: u64,
    /// What flies.
    pub vehicle: Flown,
    /// The simulated autopilot.
    pub autopilot: AutopilotSettings,
    /// What blows.
    pub wind: WindSettings,
    /// The pad.
    pub pad: PadSettings,
    /// The ground.
    pub ground: GroundSettings,
    /// The camera.
    pub camera: CameraConfig,
}

/// What flies.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Flown {
    /// Our own vehicle and autopilot.
    Simulated,
    /// The vehicle whose pose an autopilot reports.
    Reported,
}

/// Whose rules the simulated autopilot keeps.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FirmwareName {
    /// Those of ArduPilot, as measured.
    ArduPilot,
    /// Those of PX4, as documented.
    Px4,
}

/// The simulated autopilot.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AutopilotSettings {
    /// Where it talks MAVLink to.
    pub address: String,
    /// Time until it can be armed, in seconds.
    pub ready_after_s: f64,
    /// Whose rules it keeps.
    pub firmware: FirmwareName,
    /// Whether its own precision landing is on.
    pub precision_landing: bool,
    /// Its speed of descent in LAND, in cm/s.
    pub land_speed_cm_s: f64,
}

/// What blows.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WindSettings {
    /// Speed of the mean wind, in m/s.
    pub mean_m_s: f64,
    /// Where it comes from, in degrees.
    pub from_deg: f64,
    /// Strength of the turbulence.
    pub turbulence: f64,
    /// Whether the thesis' wind noise is added.
    pub thesis_noise: bool,
}

/// The pad.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PadSettings {
    /// What is printed on it.
    pub marker: String,
    /// The pad of several markers that is printed in place of one, or nothing.
    pub markers: String,
    /// Where it lies, north of the start, in metres.
    pub north_m: f64,
    /// Where it lies, east of the start, in metres.
    pub east_m: f64,
    /// Heading of the marker's upper edge, in degrees.
    pub heading_deg: f64,
}

/// The ground.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GroundSettings {
    /// What it looks like.
    pub surface: String,
    /// Painted marks that are no markers.
    pub painted_marks: u32,
    /// Light on the scene.
    pub light: f64,
}

/// The camera.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Its name.
    pub name: String,
    /// Frames a second.
    pub rate_hz: f64,
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal length in pixels.
    pub focal_px: f64,
    /// Height above the vehicle's lowest point, in metres.
    pub mount_height_m: f64,
    /// The lens's blur, in pixels.
    pub blur_px: f64,
    /// Grey level of white paper.
    pub white_level: f64,
    /// Longest exposure, in milliseconds.
    pub longest_exposure_ms: f64,
    /// Whether there is noise.
    pub noise: bool,
    /// Quality of the JPEG frames.
    pub jpeg_quality: u8,
}

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../simulator.toml");

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.parses("autopilot.address", self.autopilot.address.parse::<Address>());
        check.range("autopilot.ready_after_s", self.autopilot.ready_after_s, 0.5..=600.0);
        check.range("autopilot.land_speed_cm_s", self.autopilot.land_speed_cm_s, 30.0..=200.0);
        check.range("wind.mean_m_s", self.wind.mean_m_s, 0.0..=20.0);
        check.range("wind.from_deg", self.wind.from_deg, 0.0..=360.0);
        check.range("wind.turbulence", self.wind.turbulence, 0.0..=10.0);
        check.parses("pad.marker", self.pad_marker());
        check.parses("pad.markers", self.printed());
        check.range("pad.north_m", self.pad.north_m, -1000.0..=1000.0);
        check.range("pad.east_m", self.pad.east_m, -1000.0..=1000.0);
        check.range("pad.heading_deg", self.pad.heading_deg, -360.0..=360.0);
        check.parses("ground.surface", self.ground.surface.parse::<Surface>());
        check.range("ground.painted_marks", self.ground.painted_marks, 0..=1000);
        check.range("ground.light", self.ground.light, 0.001..=2.0);
        self.camera.check(check);
    }
}

impl CameraConfig {
    fn check(&self, check: &mut Check<'_>) {
        check.name("camera.name", &self.name);
        check.range("camera.rate_hz", self.rate_hz, 0.1..=120.0);
        check.range("camera.width", self.width, 16..=8192);
        check.range("camera.height", self.height, 16..=8192);
        check.range("camera.focal_px", self.focal_px, 10.0..=1e5);
        check.range("camera.mount_height_m", self.mount_height_m, -1.0..=1.0);
        check.range("camera.blur_px", self.blur_px, 0.0..=3.0);
        check.range("camera.white_level", self.white_level, 20.0..=255.0);
        check.range("camera.longest_exposure_ms", self.longest_exposure_ms, 0.01..=100.0);
        check.range("camera.jpeg_quality", self.jpeg_quality, 1..=100);
    }
}

impl Config {
    /// What is printed on the pad.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub fn pad_marker(&self) -> Result<Marker, String> {
        let marker: Marker = self.pad.marker.parse().map_err(|e| format!("{e}"))?;
        match marker.size_m {
            Some(_) => Ok(marker),
            None => Err(format!("`{marker}` needs a size in metres, as in `{marker}:0.15341`")),
        }
    }

    /// What is on the pad's lid, of one marker or several.
    fn printed(&self) -> Result<Drawing, String> {
        let name = self.pad.markers.as_str();
        if name.is_empty() {
            let marker = self.pad_marker()?;
            let drawing = marker.size_m.and_then(|size_m| Drawing::new(&marker, size_m));
            return drawing.ok_or_else(|| format!("`{marker}` cannot be printed: which id?"));
        }
        let pad = Pad::named(name, |file| std::fs::read_to_string(file));
        let pad = pad.map_err(|problem| problem.to_string())?;
        pad.drawing().ok_or_else(|| format!("pad `{name}` cannot be printed"))
    }

    /// The world of a simulated flight.
    pub fn world(&self) -> WorldConfig {
        let precision = f32::from(u8::from(self.autopilot.precision_landing));
        let autopilot = AutopilotConfig {
            ready_after_s: self.autopilot.ready_after_s,
            firmware: match self.autopilot.firmware {
                FirmwareName::ArduPilot => Firmware::ArduPilot,
                FirmwareName::Px4 => Firmware::Px4,
            },
            parameters: vec![
                ("LAND_SPEED".to_owned(), self.autopilot.land_speed_cm_s as f32),
                ("PLND_ENABLED".to_owned(), precision),
                ("PLND_TYPE".to_owned(), precision),
            ],
            ..AutopilotConfig::default()
        };
        let wind = WindConfig {
            mean_m_s: self.wind.mean_m_s,
            from_rad: self.wind.from_deg.to_radians(),
            turbulence: self.wind.turbulence,
            noise: self.wind.thesis_noise.then(WindNoise::default),
        };
        WorldConfig { autopilot, wind, ..WorldConfig::default() }
    }

    /// What there is to see.
    ///
    /// # Errors
    /// Says what is wrong with the pad or the ground.
    pub fn scene(&self) -> Result<Scene, String> {
        let heading_rad = self.pad.heading_deg.to_radians();
        let (north_m, east_m) = (self.pad.north_m, self.pad.east_m);
        let pad = PadInScene::printed(self.printed()?, north_m, east_m, heading_rad);
        Ok(Scene {
            surface: self.ground.surface.parse()?,
            pads: vec![pad],
            painted_marks: self.ground.painted_marks,
            light: self.ground.light,
        })
    }

    /// The camera and its setting.
    pub fn camera_settings(&self) -> CameraSettings {
        let camera = &self.camera;
        let thesis = CameraSettings::thesis();
        let mount = Point::new(0.0, 0.0, -camera.mount_height_m);
        CameraSettings {
            model: CameraModel::pinhole(camera.width, camera.height, camera.focal_px),
            body_from_camera: Transform::new(thesis.body_from_camera.rotation(), mount),
            blur_px: camera.blur_px,
            noise: camera.noise,
            ..thesis
        }
        .exposed_for(
            self.ground.light,
            camera.white_level,
            camera.longest_exposure_ms * 1e-3,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::Layers;

    fn load(set: &str) -> Result<Config, String> {
        let set = if set.is_empty() { Vec::new() } else { vec![set.to_owned()] };
        Layers { file: None, set }.load::<Config>().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn the_defaults_are_the_thesis_experiment() {
        let config = load("").unwrap();
        let scene = config.scene().unwrap();
        let origin = scene.pads[0].ned_from_marker.origin();
        assert!((origin.x() - 1.5).abs() < 1e-12 && (origin.y() + 1.5).abs() < 1e-12);
        let model = config.camera_settings().model;
        assert_eq!((model.width, model.height, model.fx.round()), (1296, 972, 1818.0));
    }

    #[test]
    fn impossible_worlds_are_refused() {
        for (set, part) in [
            ("pad.marker=rings", "needs a size"),
            ("ground.surface=lava", "lava"),
            ("camera.rate_hz=0", "from 0.1 to 120"),
            ("vehicle=pigeon", "pigeon"),
            ("seed=-1", "-1"),
        ] {
            let problem = load(set).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
    }
}
