//! The simulator's configuration.

use airlink::AirConfig;
use autopilot::Address;
use geometry::{CameraModel, Point, Transform, Vector};
use markers::{Drawing, Marker, Pad};
use node::{Check, Settings};
use rendering::{CameraSettings, PadInScene, Scene, Surface};
use serde::Deserialize;

use world::ardupilot::{AutopilotConfig, EstimateConfig, Firmware};
use world::camera::CameraFaults;
use world::pad::PadConfig;
use world::vehicle::VehicleConfig;
use world::wind::{Gust, WindConfig, WindNoise};
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
    /// Height at which the world begins, in metres.
    pub begin_height_m: f64,
    /// Where the vehicle starts.
    pub start: StartSettings,
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
    /// What is between camera and pad.
    pub veil: VeilSettings,
    /// Its frames for the air link.
    pub air: AirConfig,
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

/// Where the vehicle starts.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartSettings {
    /// Height, in metres; 0 stands on the ground.
    pub height_m: f64,
    /// North of the origin, in metres.
    pub north_m: f64,
    /// East of the origin, in metres.
    pub east_m: f64,
    /// Heading, in degrees.
    pub heading_deg: f64,
    /// Radius of the rotors for the ground effect, in metres.
    pub rotor_m: f64,
}

/// What is between camera and pad for a while.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VeilSettings {
    /// What it is.
    pub kind: VeilKind,
    /// How strong it is.
    pub strength: f64,
    /// From when on, in seconds.
    pub at_s: f64,
    /// For how long, in seconds.
    pub for_s: f64,
    /// Only below this height over the pad, in metres.
    pub below_m: f64,
}

/// What is between camera and pad.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum VeilKind {
    /// Nothing.
    None,
    /// A reflection beside the marker.
    Glare,
    /// Something over a part of the marker.
    Cover,
    /// Little contrast.
    Haze,
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
    /// Errors of its estimator, as a multiple of the usual ones.
    pub errors: f64,
    /// Deviation of the believed velocity's error as a wrong tilt makes it, in m/s.
    pub velocity_wander_m_s: f64,
    /// Its time constant, in seconds.
    pub velocity_wander_s: f64,
    /// Speed of the believed position's drift, in m/s.
    pub gnss_drift_m_s: f64,
    /// Direction of that drift, in degrees.
    pub gnss_drift_to_deg: f64,
    /// Jump of the believed position northwards, in metres.
    pub gnss_jump_m: f64,
    /// When it jumps, in seconds.
    pub gnss_jump_at_s: f64,
    /// When its link is lost, in seconds.
    pub link_lost_at_s: f64,
    /// For how long it is, in seconds.
    pub link_lost_for_s: f64,
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
    /// Peak of a gust, in m/s.
    pub gust_m_s: f64,
    /// When it comes, in seconds.
    pub gust_at_s: f64,
    /// How long it lasts, in seconds.
    pub gust_length_s: f64,
    /// From one gust to the next, in seconds.
    pub gust_every_s: f64,
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
    /// How high it rests over the ground, in metres.
    pub height_m: f64,
    /// Heading of the marker's upper edge, in degrees.
    pub heading_deg: f64,
    /// Speed of its straight way, in m/s.
    pub speed_m_s: f64,
    /// Direction of that way, in degrees.
    pub course_deg: f64,
    /// Amplitude of its heave, in metres.
    pub heave_m: f64,
    /// Period of its heave, in seconds.
    pub heave_period_s: f64,
    /// How fast it turns, in degrees per second.
    pub turn_deg_s: f64,
    /// Radius of the deck that moves with it, in metres.
    pub deck_m: f64,
    /// A second marker that moves with it; empty is none.
    pub wrong_marker: String,
    /// Where that lies, north of the pad's middle, in metres.
    pub wrong_north_m: f64,
    /// Where that lies, east of the pad's middle, in metres.
    pub wrong_east_m: f64,
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
    /// Deviation of the mount's error in roll and pitch, in degrees.
    pub mount_error_deg: f64,
    /// From the exposure to the arrival, in milliseconds.
    pub latency_ms: f64,
    /// What chance adds to it at most, in milliseconds.
    pub jitter_ms: f64,
    /// Part of the frames that never arrive.
    pub drop: f64,
    /// Part of the frames that arrive twice.
    pub duplicate: f64,
    /// By how much all stamps are early, in milliseconds.
    pub stamp_early_ms: f64,
    /// Part of the stamps that jump.
    pub stamp_jumps: f64,
    /// By how much they jump at most, in milliseconds.
    pub stamp_jump_ms: f64,
    /// From when on no frame is taken, in seconds.
    pub outage_at_s: f64,
    /// For how long none is, in seconds.
    pub outage_for_s: f64,
    /// From the first time below this height on no frame is taken, in metres.
    pub outage_below_m: f64,
    /// For how long none is, in seconds.
    pub outage_below_for_s: f64,
}

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../simulator.toml");

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.range("begin_height_m", self.begin_height_m, 0.0..=1000.0);
        check.range("start.height_m", self.start.height_m, 0.0..=100.0);
        check.range("start.north_m", self.start.north_m, -1000.0..=1000.0);
        check.range("start.east_m", self.start.east_m, -1000.0..=1000.0);
        check.range("start.heading_deg", self.start.heading_deg, -360.0..=360.0);
        check.range("start.rotor_m", self.start.rotor_m, 0.0..=1.0);
        check.parses("autopilot.address", self.autopilot.address.parse::<Address>());
        check.range("autopilot.ready_after_s", self.autopilot.ready_after_s, 0.5..=600.0);
        check.range("autopilot.land_speed_cm_s", self.autopilot.land_speed_cm_s, 30.0..=200.0);
        self.autopilot.check(check);
        self.wind.check(check);
        self.pad.check(check);
        check.parses("pad.marker", self.pad_marker());
        check.parses("pad.markers", self.printed());
        check.parses("pad.wrong_marker", self.wrong_marker());
        check.parses("ground.surface", self.ground.surface.parse::<Surface>());
        check.range("ground.painted_marks", self.ground.painted_marks, 0..=1000);
        check.range("ground.light", self.ground.light, 0.001..=2.0);
        check.range("veil.strength", self.veil.strength, 0.0..=1.0);
        check.range("veil.at_s", self.veil.at_s, 0.0..=3600.0);
        check.range("veil.for_s", self.veil.for_s, 0.0..=3600.0);
        check.range("veil.below_m", self.veil.below_m, 0.0..=1000.0);
        self.camera.check(check);
        for (key, value, range) in self.air.ranges() {
            check.range(key, value, range);
        }
    }
}

impl AutopilotSettings {
    fn check(&self, check: &mut Check<'_>) {
        check.range("autopilot.errors", self.errors, 0.0..=10.0);
        check.range("autopilot.velocity_wander_m_s", self.velocity_wander_m_s, 0.0..=2.0);
        check.range("autopilot.velocity_wander_s", self.velocity_wander_s, 0.5..=60.0);
        check.range("autopilot.gnss_drift_m_s", self.gnss_drift_m_s, 0.0..=2.0);
        check.range("autopilot.gnss_drift_to_deg", self.gnss_drift_to_deg, -360.0..=360.0);
        check.range("autopilot.gnss_jump_m", self.gnss_jump_m, -100.0..=100.0);
        check.range("autopilot.gnss_jump_at_s", self.gnss_jump_at_s, 0.0..=3600.0);
        check.range("autopilot.link_lost_at_s", self.link_lost_at_s, 0.0..=3600.0);
        check.range("autopilot.link_lost_for_s", self.link_lost_for_s, 0.0..=3600.0);
    }
}

impl WindSettings {
    fn check(&self, check: &mut Check<'_>) {
        check.range("wind.mean_m_s", self.mean_m_s, 0.0..=20.0);
        check.range("wind.from_deg", self.from_deg, 0.0..=360.0);
        check.range("wind.turbulence", self.turbulence, 0.0..=10.0);
        check.range("wind.gust_m_s", self.gust_m_s, 0.0..=20.0);
        check.range("wind.gust_at_s", self.gust_at_s, 0.0..=3600.0);
        check.range("wind.gust_length_s", self.gust_length_s, 0.1..=60.0);
        check.range("wind.gust_every_s", self.gust_every_s, 0.0..=3600.0);
    }
}

impl PadSettings {
    fn check(&self, check: &mut Check<'_>) {
        check.range("pad.north_m", self.north_m, -1000.0..=1000.0);
        check.range("pad.east_m", self.east_m, -1000.0..=1000.0);
        check.range("pad.height_m", self.height_m, 0.0..=10.0);
        check.range("pad.heading_deg", self.heading_deg, -360.0..=360.0);
        check.range("pad.speed_m_s", self.speed_m_s, 0.0..=10.0);
        check.range("pad.course_deg", self.course_deg, -360.0..=360.0);
        check.range("pad.heave_m", self.heave_m, 0.0..=2.0);
        check.range("pad.heave_period_s", self.heave_period_s, 1.0..=60.0);
        check.range("pad.turn_deg_s", self.turn_deg_s, -90.0..=90.0);
        check.range("pad.deck_m", self.deck_m, 0.1..=100.0);
        check.range("pad.wrong_north_m", self.wrong_north_m, -100.0..=100.0);
        check.range("pad.wrong_east_m", self.wrong_east_m, -100.0..=100.0);
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
        check.range("camera.mount_error_deg", self.mount_error_deg, 0.0..=10.0);
        check.range("camera.latency_ms", self.latency_ms, 0.0..=2000.0);
        check.range("camera.jitter_ms", self.jitter_ms, 0.0..=2000.0);
        check.range("camera.drop", self.drop, 0.0..=1.0);
        check.range("camera.duplicate", self.duplicate, 0.0..=1.0);
        check.range("camera.stamp_early_ms", self.stamp_early_ms, -1000.0..=1000.0);
        check.range("camera.stamp_jumps", self.stamp_jumps, 0.0..=1.0);
        check.range("camera.stamp_jump_ms", self.stamp_jump_ms, 0.0..=2000.0);
        check.range("camera.outage_at_s", self.outage_at_s, 0.0..=3600.0);
        check.range("camera.outage_for_s", self.outage_for_s, 0.0..=3600.0);
        check.range("camera.outage_below_m", self.outage_below_m, 0.0..=100.0);
        check.range("camera.outage_below_for_s", self.outage_below_for_s, 0.0..=3600.0);
    }
}

impl Config {
    /// What is printed on the pad.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub fn pad_marker(&self) -> Result<Marker, String> {
        sized_marker(&self.pad.marker)
    }

    /// The second marker, if there is one.
    ///
    /// # Errors
    /// Says what is wrong with it.
    pub fn wrong_marker(&self) -> Result<Option<Marker>, String> {
        let name = &self.pad.wrong_marker;
        if name.is_empty() { Ok(None) } else { sized_marker(name).map(Some) }
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
        let start = &self.start;
        let lost_for_s = self.autopilot.link_lost_for_s;
        WorldConfig {
            vehicle: VehicleConfig {
                start: Point::new(start.north_m, start.east_m, 0.0),
                start_height_m: start.height_m,
                start_heading_rad: start.heading_deg.to_radians(),
                rotor_m: start.rotor_m,
                ..VehicleConfig::default()
            },
            wind: self.wind.config(),
            autopilot: self.autopilot.config(),
            pad: self.pad.config(),
            link_lost_s: (lost_for_s > 0.0).then_some((self.autopilot.link_lost_at_s, lost_for_s)),
            begin_height_m: self.begin_height_m,
        }
    }

    /// What there is to see, before the pad moves. The pad is the first in the list.
    ///
    /// # Errors
    /// Says what is wrong with the pad or the ground.
    pub fn scene(&self) -> Result<Scene, String> {
        let pad = &self.pad;
        let heading_rad = pad.heading_deg.to_radians();
        let mut pads =
            vec![PadInScene::printed(self.printed()?, pad.north_m, pad.east_m, heading_rad)];
        if let Some(wrong) = self.wrong_marker()? {
            let [north, east] = [pad.north_m + pad.wrong_north_m, pad.east_m + pad.wrong_east_m];
            pads.push(PadInScene::flat(wrong, north, east, heading_rad));
        }
        for flat in &mut pads {
            let raised = Vector::new(0.0, 0.0, -pad.height_m);
            let on_ground = flat.ned_from_marker;
            flat.ned_from_marker =
                Transform::new(on_ground.rotation(), on_ground.origin() + raised);
        }
        Ok(Scene {
            surface: self.ground.surface.parse()?,
            pads,
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

fn sized_marker(name: &str) -> Result<Marker, String> {
    let marker: Marker = name.parse().map_err(|e| format!("{e}"))?;
    match marker.size_m {
        Some(_) => Ok(marker),
        None => Err(format!("`{marker}` needs a size in metres, as in `{marker}:0.15341`")),
    }
}

impl AutopilotSettings {
    fn config(&self) -> AutopilotConfig {
        let (east, north) = self.gnss_drift_to_deg.to_radians().sin_cos();
        let jump = ([self.gnss_jump_m, 0.0], self.gnss_jump_at_s);
        let precision = f32::from(u8::from(self.precision_landing));
        AutopilotConfig {
            ready_after_s: self.ready_after_s,
            firmware: match self.firmware {
                FirmwareName::ArduPilot => Firmware::ArduPilot,
                FirmwareName::Px4 => Firmware::Px4,
            },
            parameters: vec![
                ("LAND_SPEED".to_owned(), self.land_speed_cm_s as f32),
                ("PLND_ENABLED".to_owned(), precision),
                ("PLND_TYPE".to_owned(), precision),
            ],
            estimate: EstimateConfig {
                gnss_drift_m_s: [self.gnss_drift_m_s * north, self.gnss_drift_m_s * east],
                wander_m_s: self.velocity_wander_m_s,
                wander_s: self.velocity_wander_s,
                gnss_jump: (self.gnss_jump_m != 0.0).then_some(jump),
                ..EstimateConfig::default().times(self.errors)
            },
            ..AutopilotConfig::default()
        }
    }
}

impl WindSettings {
    fn config(&self) -> WindConfig {
        WindConfig {
            mean_m_s: self.mean_m_s,
            from_rad: self.from_deg.to_radians(),
            turbulence: self.turbulence,
            noise: self.thesis_noise.then(WindNoise::default),
            gust: (self.gust_m_s > 0.0).then_some(Gust {
                start_s: self.gust_at_s,
                length_s: self.gust_length_s,
                peak_m_s: self.gust_m_s,
                period_s: self.gust_every_s,
            }),
        }
    }
}

impl PadSettings {
    /// The pad as the world moves it.
    pub fn config(&self) -> PadConfig {
        let (east, north) = self.course_deg.to_radians().sin_cos();
        PadConfig {
            position: Point::new(self.north_m, self.east_m, -self.height_m),
            heading_rad: self.heading_deg.to_radians(),
            velocity: Vector::new(north, east, 0.0) * self.speed_m_s,
            heave_m: self.heave_m,
            heave_period_s: self.heave_period_s,
            turn_rad_s: self.turn_deg_s.to_radians(),
            deck_m: self.deck_m,
        }
    }
}

impl CameraConfig {
    /// What happens to its frames on their way.
    pub fn faults(&self) -> CameraFaults {
        let lasting = |at: f64, for_s: f64| (for_s > 0.0).then_some((at, for_s));
        CameraFaults {
            latency_s: 1e-3 * self.latency_ms,
            jitter_s: 1e-3 * self.jitter_ms,
            drop: self.drop,
            duplicate: self.duplicate,
            stamp_early_s: 1e-3 * self.stamp_early_ms,
            stamp_jumps: self.stamp_jumps,
            stamp_jump_s: 1e-3 * self.stamp_jump_ms,
            outage_s: lasting(self.outage_at_s, self.outage_for_s),
            outage_below_m: lasting(self.outage_below_m, self.outage_below_for_s),
            mount_error_rad: self.mount_error_deg.to_radians(),
        }
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
