//! Defines the simulator's configuration, `simulator.toml`: vehicle, firmware, wind, pad, camera with its faults,
//! light, exposure, occluders; checked and made into settings of world and renderer.

use airlink::AirConfig;
use autopilot::Address;
use geometry::{CameraModel, Point, Transform, Vector};
use markers::{Drawing, Marker, Pad};
use node::{Check, Settings, read_text};
use rendering::{CameraSettings, PadInScene, Preset, Scene, Surface};
use serde::Deserialize;
use world::ardupilot::{AutopilotConfig, EstimateConfig, Firmware};
use world::camera::CameraFaults;
use world::pad::PadConfig;
use world::vehicle::VehicleConfig;
use world::wind::{Gust, WindConfig, WindNoise};
use world::world::WorldConfig;

/// Declares a table of `simulator.toml`: each key with its type and, for a number, its range. The file
/// explains the keys.
macro_rules! table {
    ($(#[$doc:meta])* $name:ident: $table:literal { $($key:ident: $type:ty $(= $range:expr)?,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Debug, Deserialize)]
        #[serde(deny_unknown_fields)]
        pub struct $name {
            $(#[doc = concat!("The key `", $table, ".", stringify!($key), "`.")] pub $key: $type,)*
        }

        impl $name {
            fn check_ranges(&self, check: &mut Check<'_>) {
                $($(check.range(concat!($table, ".", stringify!($key)), self.$key, $range);)?)*
            }
        }
    };
}

/// The keys of `simulator.toml`, which explains them.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this simulator.
    pub id: String,
    /// Seed of everything random.
    pub seed: u64,
    /// The vehicle.
    pub vehicle: VehicleKind,
    /// Height above which the scenario begins, in metres.
    pub begin_height_m: f64,
    /// Where the vehicle starts.
    pub start: StartSettings,
    /// The simulated autopilot.
    pub autopilot: AutopilotSettings,
    /// The wind.
    pub wind: WindSettings,
    /// The pad.
    pub pad: PadSettings,
    /// The ground.
    pub ground: GroundSettings,
    /// The camera.
    pub camera: CameraConfig,
    /// An effect between camera and pad.
    pub occluder: OccluderSettings,
    /// The camera's frames for the air link.
    pub air: AirConfig,
}

/// The source of the vehicle's pose.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum VehicleKind {
    /// A simulated vehicle and autopilot.
    Simulated,
    /// A vehicle whose pose an autopilot reports.
    Reported,
}

/// The firmware that the simulated autopilot imitates.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum FirmwareName {
    /// ArduPilot, as measured.
    ArduPilot,
    /// PX4, as documented.
    Px4,
}

table! {
    /// Where the vehicle starts.
    StartSettings: "start" {
        height_m: f64 = 0.0..=100.0,
        north_m: f64 = -1000.0..=1000.0,
        east_m: f64 = -1000.0..=1000.0,
        heading_deg: f64 = -360.0..=360.0,
        rotor_m: f64 = 0.0..=1.0,
    }
}

table! {
    /// An effect between camera and pad.
    OccluderSettings: "occluder" {
        kind: OccluderKind,
        strength: f64 = 0.0..=1.0,
        at_s: f64 = 0.0..=3600.0,
        for_s: f64 = 0.0..=3600.0,
        below_m: f64 = 0.0..=1000.0,
        beside_m: f64 = -100.0..=100.0,
    }
}

/// The kind of effect between camera and pad.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum OccluderKind {
    /// No effect.
    None,
    /// A reflection next to the marker.
    Glare,
    /// An object in front of a part of the marker.
    Cover,
    /// Low contrast.
    Haze,
    /// A hard shadow, whose edge is next to the marker's centre or across it.
    Shadow,
}

table! {
    /// The simulated autopilot.
    AutopilotSettings: "autopilot" {
        address: String,
        signing_key: String,
        ready_after_s: f64 = 0.5..=600.0,
        firmware: FirmwareName,
        says_simulated: bool,
        precision_landing: bool,
        land_speed_cm_s: f64 = 30.0..=200.0,
        errors: f64 = 0.0..=10.0,
        velocity_wander_m_s: f64 = 0.0..=2.0,
        velocity_wander_s: f64 = 0.5..=60.0,
        gnss_drift_m_s: f64 = 0.0..=2.0,
        gnss_drift_to_deg: f64 = -360.0..=360.0,
        gnss_jump_m: f64 = -100.0..=100.0,
        gnss_jump_at_s: f64 = 0.0..=3600.0,
        link_lost_at_s: f64 = 0.0..=3600.0,
        link_lost_for_s: f64 = 0.0..=3600.0,
    }
}

/// How the camera sets exposure and gain.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ExposureKind {
    /// Never after the start.
    Fixed,
    /// By the mean of its frames, as a camera's own metering.
    Average,
    /// For the marker, as camera-pub does; without one by the mean.
    Marker,
}

table! {
    /// The wind.
    WindSettings: "wind" {
        mean_m_s: f64 = 0.0..=20.0,
        from_deg: f64 = 0.0..=360.0,
        turbulence: f64 = 0.0..=10.0,
        thesis_noise: bool,
        gust_m_s: f64 = 0.0..=20.0,
        gust_at_s: f64 = 0.0..=3600.0,
        gust_length_s: f64 = 0.1..=60.0,
        gust_every_s: f64 = 0.0..=3600.0,
    }
}

table! {
    /// The pad.
    PadSettings: "pad" {
        marker: String,
        markers: String,
        north_m: f64 = -1000.0..=1000.0,
        east_m: f64 = -1000.0..=1000.0,
        height_m: f64 = 0.0..=10.0,
        heading_deg: f64 = -360.0..=360.0,
        speed_m_s: f64 = 0.0..=10.0,
        course_deg: f64 = -360.0..=360.0,
        heave_m: f64 = 0.0..=2.0,
        heave_period_s: f64 = 1.0..=60.0,
        turn_deg_s: f64 = -90.0..=90.0,
        deck_m: f64 = 0.1..=100.0,
        wrong_marker: String,
        wrong_north_m: f64 = -100.0..=100.0,
        wrong_east_m: f64 = -100.0..=100.0,
    }
}

table! {
    /// The ground.
    GroundSettings: "ground" {
        surface: String,
        painted_marks: u32 = 0..=1000,
        light: f64 = 0.001..=100.0,
        light_step_stops: f64 = -10.0..=10.0,
        light_step_at_s: f64 = 0.0..=3600.0,
    }
}

table! {
    /// The camera.
    CameraConfig: "camera" {
        name: String,
        rate_hz: f64 = 0.1..=120.0,
        width: u32 = 16..=8192,
        height: u32 = 16..=8192,
        focal_px: f64 = 10.0..=1e5,
        mount_height_m: f64 = -1.0..=1.0,
        blur_px: f64 = 0.0..=3.0,
        white_level: f64 = 20.0..=255.0,
        max_exposure_ms: f64 = 0.01..=100.0,
        exposure: ExposureKind,
        max_gain: f64 = 1.0..=1000.0,
        set_for_light: f64 = 0.0..=100.0,
        noise: bool,
        processing: String,
        mount_error_deg: f64 = 0.0..=10.0,
        mount_roll_deg: f64 = -180.0..=180.0,
        mount_pitch_deg: f64 = -180.0..=180.0,
        mount_yaw_deg: f64 = -180.0..=180.0,
        latency_ms: f64 = 0.0..=2000.0,
        jitter_ms: f64 = 0.0..=2000.0,
        drop: f64 = 0.0..=1.0,
        duplicate: f64 = 0.0..=1.0,
        stamp_early_ms: f64 = -1000.0..=1000.0,
        stamp_jumps: f64 = 0.0..=1.0,
        stamp_jump_ms: f64 = 0.0..=2000.0,
        stamp_jumps_at_s: f64 = 0.0..=3600.0,
        stamp_jumps_for_s: f64 = 0.0..=3600.0,
        outage_at_s: f64 = 0.0..=3600.0,
        outage_for_s: f64 = 0.0..=3600.0,
        outage_below_m: f64 = 0.0..=100.0,
        outage_below_for_s: f64 = 0.0..=3600.0,
    }
}

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../simulator.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.range("begin_height_m", self.begin_height_m, 0.0..=1000.0);
        self.start.check_ranges(check);
        check.parses("autopilot.address", self.autopilot.address.parse::<Address>());
        self.autopilot.check_ranges(check);
        self.wind.check_ranges(check);
        self.pad.check_ranges(check);
        check.parses("pad.marker", self.pad_marker());
        let printed = if self.pad.markers.is_empty() { "pad.marker" } else { "pad.markers" };
        check.parses(printed, self.printed());
        check.parses("pad.wrong_marker", self.wrong_marker());
        check.parses("ground.surface", self.ground.surface.parse::<Surface>());
        self.ground.check_ranges(check);
        self.occluder.check_ranges(check);
        check.name("camera.name", &self.camera.name);
        check.parses("camera.processing", self.camera.processing.parse::<Preset>());
        self.camera.check_ranges(check);
        for (key, value, range) in self.air.ranges() {
            check.range(key, value, range);
        }
    }
}

impl Config {
    /// The marker on the pad.
    ///
    /// # Errors
    /// When it is invalid or has no size.
    pub fn pad_marker(&self) -> Result<Marker, String> {
        sized_marker(&self.pad.marker)
    }

    /// The second marker, if there is one.
    ///
    /// # Errors
    /// When it is invalid or has no size.
    pub fn wrong_marker(&self) -> Result<Option<Marker>, String> {
        let name = &self.pad.wrong_marker;
        if name.is_empty() { Ok(None) } else { sized_marker(name).map(Some) }
    }

    /// The drawing on the pad, of one marker or several.
    fn printed(&self) -> Result<Drawing, String> {
        let name = self.pad.markers.as_str();
        if name.is_empty() {
            let marker = self.pad_marker()?;
            let drawing = marker.size_m.and_then(|size_m| Drawing::new(&marker, size_m));
            return drawing.ok_or_else(|| {
                format!("`{marker}` cannot be printed: it needs an id, as FAMILY:ID:SIZE_M")
            });
        }
        let pad = Pad::named(name, |file| read_text(file));
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

    /// The scene before the pad moves. The pad is the first in its list.
    ///
    /// # Errors
    /// When the pad or the ground is invalid.
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

    /// The camera and the settings with which it begins.
    pub fn camera_settings(&self) -> CameraSettings {
        let set_for = self.camera.set_for_light;
        self.exposed_for(if set_for > 0.0 { set_for } else { self.ground.light })
    }

    /// The camera, exposed for this light.
    pub(crate) fn exposed_for(&self, light: f64) -> CameraSettings {
        let camera = &self.camera;
        let thesis = CameraSettings::thesis();
        let mount = Point::new(0.0, 0.0, -camera.mount_height_m);
        CameraSettings {
            model: CameraModel::pinhole(camera.width, camera.height, camera.focal_px),
            body_from_camera: Transform::new(thesis.body_from_camera.rotation(), mount),
            blur_px: camera.blur_px,
            noise: camera.noise,
            // The configuration was checked when it was loaded.
            processing: camera.processing.parse::<Preset>().unwrap_or_default().processing(),
            ..thesis
        }
        .exposed_for(light, camera.white_level, camera.max_exposure_ms * 1e-3)
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
            says_simulated: self.says_simulated,
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
    /// The pad and its motion.
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
    /// The faults of the camera and of its connection.
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
            stamp_jumps_in_s: lasting(self.stamp_jumps_at_s, self.stamp_jumps_for_s),
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
        assert_eq!(config.camera_settings().processing, Preset::Usb.processing());
    }

    #[test]
    fn a_kind_of_camera_is_chosen_by_name() {
        for preset in Preset::ALL {
            let config = load(&format!("camera.processing={preset}")).unwrap();
            assert_eq!(config.camera_settings().processing, preset.processing());
        }
    }

    #[test]
    fn invalid_values_are_refused() {
        for (set, part) in [
            ("pad.marker=rings", "needs a size"),
            ("ground.surface=lava", "lava"),
            ("camera.rate_hz=0", "`camera.rate_hz`"),
            ("camera.rate_hz=0", "from 0.1 to 120"),
            ("vehicle=pigeon", "pigeon"),
            ("camera.processing=webcam", "raspberry-pi"),
            ("seed=-1", "-1"),
        ] {
            let problem = load(set).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
    }
}
