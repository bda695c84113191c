//! The controller's configuration, `controller.toml`: mode, start, guidance, alarms, autopilot's link, landing targets, choice of
//! detector; ranges checked, and made into the lander's settings.

use std::time::Duration;

use autopilot::packet::setpoint_bytes;
use autopilot::{Address, KeyFileError, Permission, SigningConfig, Takeoff};
use landing::{
    EnvelopeConfig, EstimatorConfig, GuidanceConfig, MetricConfig, PhaseConfig, TargetConfig,
    ThesisConfig,
};
use node::{Check, Settings, clock_name, state_directory};
use serde::{Deserialize, Serialize};

use crate::agreement::{HEADING_TOLERANCE_RAD, Tolerance};
use crate::wind::Drag;

/// Period of the flight's ticks.
pub(crate) const TICK: Duration = Duration::from_millis(25);
/// Maximum part of a serial line that setpoints take: the rest is for those that follow detections, and for all other packets.
const MAX_SETPOINTS_SHARE: f64 = 0.5;
/// Bits that a byte takes on a serial line.
const BITS_PER_BYTE: f64 = 10.0;
/// Periods of the setpoints that the autopilot's setpoint timeout must last: with 2 of them one lost setpoint is survived.
const MIN_TIMEOUT_PERIODS: f64 = 2.5;

/// The keys of `controller.toml`, which has their meanings, units and ranges.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this controller.
    pub id: String,
    /// When the landing begins.
    pub start: Start,
    /// Height of the take-off in metres.
    pub takeoff_height_m: f64,
    /// Whether the take-off may arm a vehicle that does not say that it is a simulation.
    pub takeoff_real_vehicle: bool,
    /// The controller of the landing: this one, or the autopilot.
    pub mode: Mode,
    /// Which guidance is used.
    pub guidance: GuidanceName,
    /// The marker to land on.
    pub marker: String,
    /// Name of the clock whose frames are used; empty: this machine's.
    pub clock: String,
    /// The link to the autopilot.
    pub autopilot: AutopilotSettings,
    /// The landing targets for the autopilot's own precision landing.
    pub landing_target: LandingTargetSettings,
    /// Limits of battery, operator and link.
    pub alarms: AlarmSettings,
    /// The choice of the detector.
    pub detectors: DetectorSettings,
    /// Which detections are used.
    pub target: TargetConfig,
    /// How detections become a target.
    pub estimator: EstimatorConfig,
    /// Limits of all setpoints.
    pub envelope: EnvelopeConfig,
    /// Limits of the phases.
    pub phases: PhaseConfig,
    /// The metric guidance.
    pub metric: MetricConfig,
    /// The thesis' guidance.
    pub thesis: ThesisConfig,
}

/// The controller of the landing.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// This controller, by velocity setpoints.
    Guided,
    /// The autopilot's own precision landing, which is sent the landing target.
    LandingTarget,
}

/// The landing targets for the autopilot's own precision landing.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct LandingTargetSettings {
    /// Which position is sent.
    pub source: LandingTargetSource,
    /// Time for which it is sent without a gap before LAND is requested, in seconds.
    pub steady_s: f64,
}

/// Which position is sent as the landing target.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum LandingTargetSource {
    /// The estimate, relative to the vehicle's newest state.
    Estimate,
    /// Each detection as it is, with the stamp of its frame; PX4 gets the estimate in either case.
    Detection,
}

/// Limits of battery, operator and link.
#[derive(Copy, Clone, Debug, PartialEq, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AlarmSettings {
    /// Charge at or below which the battery is low, from 0 to 1.
    pub battery_low: f64,
    /// Charge at or below which the battery is critical, from 0 to 1.
    pub battery_critical: f64,
    /// Voltage at or below which the battery is low, in V.
    pub battery_low_v: f64,
    /// Voltage at or below which the battery is critical, in V.
    pub battery_critical_v: f64,
    /// Time for which the battery must be below a limit, in seconds.
    pub battery_s: f64,
    /// Silence after which a known operator is lost, in seconds; 0 turns the alarm off.
    pub operator_lost_s: f64,
    /// Silence after which the autopilot is lost, in seconds; 0 turns the alarm off.
    pub autopilot_lost_s: f64,
}

/// When the landing begins.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Start {
    /// On the operator's command.
    Command,
    /// As soon as the vehicle is seen flying in GUIDED.
    Airborne,
    /// After a take-off.
    Takeoff,
    /// Resumes an active landing, in GUIDED or LAND; after that flight on the operator's command.
    Resume,
}

/// Which guidance is used.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum GuidanceName {
    /// The metric guidance.
    Metric,
    /// The thesis' guidance.
    Thesis,
}

/// The link to the autopilot.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct AutopilotSettings {
    /// Where it is.
    pub address: String,
    /// The vehicle's system id, or 0.
    pub system_id: u8,
    /// Our own component id.
    pub component_id: u8,
    /// Requested rate of attitude and position, in Hz.
    pub state_rate_hz: f64,
    /// Rate of setpoints, in Hz.
    pub setpoint_rate_hz: f64,
    /// Setpoint timeout that the autopilot gets for a landing, in seconds; 0 leaves its own.
    pub setpoint_timeout_s: f64,
    /// File with the key of signed packets, or nothing.
    pub signing_key: String,
    /// The packets that a ground station may send to the autopilot.
    pub ground_may: String,
    /// Whether to synchronise with the autopilot's clock.
    pub timesync: bool,
    /// The part of the vehicle's drag that grows with the airspeed, for the estimate of the wind, in 1/s.
    pub drag_per_s: f64,
    /// The part that grows with its square, in 1/m; both 0 turn the estimate off.
    pub drag_per_m: f64,
}

impl AutopilotSettings {
    /// The vehicle's drag.
    pub fn drag(&self) -> Drag {
        Drag { linear_per_s: self.drag_per_s, quadratic_per_m: self.drag_per_m }
    }

    /// A line that is too slow for the setpoints would delay all that is sent more and more.
    fn check_setpoint_rate(&self, check: &mut Check<'_>) {
        let (key, rate_hz) = ("autopilot.setpoint_rate_hz", self.setpoint_rate_hz);
        check.range(key, rate_hz, 5.0..=100.0);
        let Ok(Address::Serial { device, baud }) = self.address.parse() else { return };
        let bytes = setpoint_bytes(!self.signing_key.is_empty());
        let max_hz = MAX_SETPOINTS_SHARE * f64::from(baud) / (BITS_PER_BYTE * bytes as f64);
        let fits = rate_hz <= max_hz;
        check.parses(key, fits.then_some(()).ok_or_else(|| {
            format!(
                "it must be at most {max_hz:.1} over {device} with {baud} baud (`autopilot.address`): a setpoint has {bytes} bytes, and setpoints may take half of its capacity; lower it, or raise the baud rate here and at the autopilot"
            )
        }));
    }

    /// The timeout must outlast a lost setpoint, or the vehicle stops between two of them.
    fn check_setpoint_timeout(&self, check: &mut Check<'_>) {
        let (timeout_s, rate_hz) = (self.setpoint_timeout_s, self.setpoint_rate_hz);
        if timeout_s == 0.0 {
            return;
        }
        let key = "autopilot.setpoint_timeout_s";
        check.range(key, timeout_s, 0.2..=5.0);
        // A setpoint that is due waits for the next tick.
        let min_s = MIN_TIMEOUT_PERIODS / rate_hz + TICK.as_secs_f64();
        let is_kept = timeout_s >= min_s;
        check.parses(key, is_kept.then_some(()).ok_or_else(|| {
            format!(
                "with `autopilot.setpoint_rate_hz` = {rate_hz} it must be at least {min_s:.3}, or the autopilot stops where a setpoint is lost; raise one of the two"
            )
        }));
    }
}

/// The choice of the detector.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorSettings {
    /// The preferred detector, or nothing.
    pub preferred: String,
    /// Where the preferred detectors run.
    pub place: PreferredPlace,
    /// Maximum median age of a healthy detector's frames on arrival, in seconds.
    pub max_age_s: f64,
    /// Minimum frame rate of a healthy detector, in Hz.
    pub min_rate_hz: f64,
    /// Time for which a preferred detector must have been healthy before it is used, in seconds.
    pub return_after_s: f64,
    /// Maximum distance between the marker positions of two detectors that agree, in metres.
    pub tolerance_m: f64,
    /// Growth of that distance per metre of range.
    pub tolerance_per_m: f64,
}

/// Where the preferred detectors run.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum PreferredPlace {
    /// Anywhere.
    Any,
    /// On the vehicle.
    Onboard,
    /// On the ground.
    Ground,
}

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../controller.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.range("takeoff_height_m", self.takeoff_height_m, 1.0..=100.0);
        check.parses("marker", messages::marker_name(&self.marker));
        check.parses("autopilot.address", self.autopilot.address.parse::<Address>());
        check.parses("autopilot.ground_may", self.autopilot.ground_may.parse::<Permission>());
        check.range("autopilot.component_id", self.autopilot.component_id, 2..=255);
        check.range("autopilot.state_rate_hz", self.autopilot.state_rate_hz, 10.0..=200.0);
        self.autopilot.check_setpoint_rate(check);
        self.autopilot.check_setpoint_timeout(check);
        if !self.detectors.preferred.is_empty() {
            check.name("detectors.preferred", &self.detectors.preferred);
        }
        check.range("autopilot.drag_per_s", self.autopilot.drag_per_s, 0.0..=5.0);
        check.range("autopilot.drag_per_m", self.autopilot.drag_per_m, 0.0..=1.0);
        check.range("landing_target.steady_s", self.landing_target.steady_s, 0.0..=30.0);
        self.alarms.check(check);
        // A stale state makes the vehicle hold already; the alarm is for a longer silence.
        let (lost_s, stale_s) = (self.alarms.autopilot_lost_s, self.phases.stale_vehicle_s);
        if lost_s > 0.0 {
            check.at_least("alarms.autopilot_lost_s", lost_s, "phases.stale_vehicle_s", stale_s);
        }
        // A marker that is lost and still counts as visible would end all retries at once.
        let (lost_s, stale_s) = (self.phases.lost_target_s, self.phases.stale_target_s);
        check.at_least("phases.lost_target_s", lost_s, "phases.stale_target_s", stale_s);
        // The deviation of an unseen marker grows for as long as it is extrapolated: a descent without the marker must see it grow.
        if self.guidance == GuidanceName::Metric {
            let blind_s = self.metric.stale_target_s + self.metric.blind_s;
            let (key, other) =
                ("estimator.forget_after_s", "metric.stale_target_s + metric.blind_s");
            check.at_least(key, self.estimator.forget_after_s, other, blind_s);
        }
        self.detectors.check(check);
        check.parses("metric.turn_rad_s", self.turn());
        // Both guidances are checked, so that a wrong number is found before it is used.
        for guidance in [GuidanceConfig::Metric(self.metric), GuidanceConfig::Thesis(self.thesis)] {
            if let Err(problem) = self.landing(guidance).validate() {
                let (key, min, max) = (problem.key, problem.min, problem.max);
                check.range(key, problem.value, min..=max);
            }
        }
    }
}

impl AlarmSettings {
    fn check(&self, check: &mut Check<'_>) {
        check.range("alarms.battery_low", self.battery_low, 0.0..=1.0);
        check.range("alarms.battery_critical", self.battery_critical, 0.0..=1.0);
        check.range("alarms.battery_low_v", self.battery_low_v, 0.0..=100.0);
        check.range("alarms.battery_critical_v", self.battery_critical_v, 0.0..=100.0);
        check.range("alarms.battery_s", self.battery_s, 0.0..=60.0);
        check.range("alarms.operator_lost_s", self.operator_lost_s, 0.0..=600.0);
        check.range("alarms.autopilot_lost_s", self.autopilot_lost_s, 0.0..=600.0);
    }
}

impl DetectorSettings {
    fn check(&self, check: &mut Check<'_>) {
        check.range("detectors.max_age_s", self.max_age_s, 0.05..=5.0);
        check.range("detectors.min_rate_hz", self.min_rate_hz, 0.1..=100.0);
        check.range("detectors.return_after_s", self.return_after_s, 0.0..=60.0);
        check.range("detectors.tolerance_m", self.tolerance_m, 0.001..=10.0);
        check.range("detectors.tolerance_per_m", self.tolerance_per_m, 0.0..=1.0);
    }
}

impl Config {
    /// The vehicle's system id, if it is pinned.
    pub(crate) fn system_id(&self) -> Option<u8> {
        Some(self.autopilot.system_id).filter(|id| *id != 0)
    }

    /// Pins the vehicle that an earlier controller was landing, by its system id, where a landing is to be resumed and none is pinned.
    pub fn go_on_with(&mut self, landed: Option<u8>) {
        if let (Start::Resume, None, Some(system)) = (self.start, self.system_id(), landed) {
            self.autopilot.system_id = system;
        }
    }

    /// The clock whose frames are used.
    pub(crate) fn clock(&self) -> &str {
        if self.clock.is_empty() { clock_name() } else { &self.clock }
    }

    /// The device of the autopilot's serial line; `None` of another link.
    pub fn serial_device(&self) -> Option<String> {
        match self.autopilot.address.parse() {
            Ok(Address::Serial { device, .. }) => Some(device),
            _ => None,
        }
    }

    /// The key of the packets between controller and autopilot, if they are signed.
    ///
    /// # Errors
    /// When its file cannot be used.
    pub fn signing(&self) -> Result<Option<SigningConfig>, KeyFileError> {
        let AutopilotSettings { signing_key, component_id, .. } = &self.autopilot;
        if signing_key.is_empty() {
            return Ok(None);
        }
        let name = format!("controller-{}", self.id);
        SigningConfig::read(signing_key.as_ref(), *component_id, state_directory(), &name).map(Some)
    }

    /// Whether the landing is led by poses of the marker: the thesis' guidance goes by its place in the image.
    pub fn needs_pose(&self) -> bool {
        self.mode == Mode::LandingTarget || self.guidance == GuidanceName::Metric
    }

    /// The differences up to which two detectors agree: in heading where the vehicle turns to the marker's, which it does not where the
    /// autopilot lands on its own.
    pub fn tolerance(&self) -> Tolerance {
        let is_flown = self.mode != Mode::LandingTarget && self.guidance == GuidanceName::Metric;
        let turns = is_flown && self.metric.turn_rad_s > 0.0;
        Tolerance {
            base_m: self.detectors.tolerance_m,
            per_m: self.detectors.tolerance_per_m,
            heading_rad: turns.then_some(HEADING_TOLERANCE_RAD),
        }
    }

    /// Whether the vehicle can turn to the marker's heading: rings look the same from all sides, so the upper edge that their pose has
    /// is the image's, and turns with the vehicle.
    fn turn(&self) -> Result<(), String> {
        let is_round = messages::marker_name(&self.marker)
            .is_ok_and(|(family, _)| family.starts_with("rings"));
        if self.metric.turn_rad_s > 0.0 && is_round {
            let marker = &self.marker;
            return Err(format!(
                "it must be 0 with `marker` = {marker}, which has no heading; choose a square marker, a STag or a pad"
            ));
        }
        Ok(())
    }

    /// The take-off of `start = "takeoff"`.
    pub(crate) fn takeoff(&self) -> Takeoff {
        Takeoff::new(self.takeoff_height_m).of_real_vehicle(self.takeoff_real_vehicle)
    }

    /// The lander's settings.
    pub fn lander(&self) -> landing::Config {
        self.landing(match self.guidance {
            GuidanceName::Metric => GuidanceConfig::Metric(self.metric),
            GuidanceName::Thesis => GuidanceConfig::Thesis(self.thesis),
        })
    }

    fn landing(&self, guidance: GuidanceConfig) -> landing::Config {
        landing::Config {
            guidance,
            target: self.target,
            estimator: self.estimator,
            envelope: self.envelope,
            phases: self.phases,
        }
    }
}

impl Mode {
    /// Its name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Guided => "guided",
            Self::LandingTarget => "landing-target",
        }
    }
}

impl GuidanceName {
    /// Its name in the configuration.
    pub fn name(self) -> &'static str {
        match self {
            Self::Metric => "metric",
            Self::Thesis => "thesis",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::Layers;

    fn load(set: &[&str]) -> Result<Config, String> {
        let set = set.iter().map(|s| (*s).to_owned()).collect();
        let layers = Layers { file: None, set };
        layers.load::<Config>().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn the_shipped_defaults_are_the_landers() {
        let metric = load(&[]).unwrap();
        assert_eq!(metric.lander(), landing::Config::default());
        assert_eq!(metric.thesis, ThesisConfig::default());
    }

    #[test]
    fn a_setpoint_timeout_that_the_setpoints_rate_cannot_keep_is_refused() {
        let refused = |set: &[&str]| load(set).unwrap_err();
        let problem = refused(&["autopilot.setpoint_rate_hz=5"]);
        for part in [
            "`autopilot.setpoint_timeout_s` = 0.5",
            "at least 0.525",
            "`autopilot.setpoint_rate_hz` = 5",
            "raise one of the two",
        ] {
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
        refused(&["autopilot.setpoint_timeout_s=0.2", "autopilot.setpoint_rate_hz=14"]);
        for set in [
            ["autopilot.setpoint_timeout_s=0.2", "autopilot.setpoint_rate_hz=15"],
            ["autopilot.setpoint_timeout_s=0.53", "autopilot.setpoint_rate_hz=5"],
            ["autopilot.setpoint_timeout_s=0", "autopilot.setpoint_rate_hz=5"],
        ] {
            assert!(load(&set).is_ok(), "{set:?}");
        }
    }

    #[test]
    fn setpoints_that_a_serial_line_cannot_carry_are_refused() {
        let set = |rate_hz: u32, address: &str| {
            load(&[
                &format!("autopilot.setpoint_rate_hz={rate_hz}"),
                &format!("autopilot.address={address}"),
                "autopilot.setpoint_timeout_s=0",
            ])
        };
        let problem = set(50, "serial:/dev/ttyAMA0").unwrap_err();
        for part in [
            "`autopilot.setpoint_rate_hz` = 50",
            "at most 44.3 over /dev/ttyAMA0 with 57600 baud",
            "65 bytes",
            "half",
        ] {
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
        for (rate_hz, address) in [
            (44, "serial:/dev/ttyAMA0:57600"),
            (25, "serial:/dev/ttyAMA0:38400"),
            (100, "serial:/dev/ttyAMA0:921600"),
            (100, "udpin:0.0.0.0:14550"),
        ] {
            assert!(set(rate_hz, address).is_ok(), "{rate_hz} over {address}");
        }
        assert!(set(25, "serial:/dev/ttyAMA0:9600").is_err());
        let signed = [
            "autopilot.setpoint_rate_hz=44",
            "autopilot.signing_key=key.txt",
            "autopilot.address=serial:/dev/ttyAMA0",
        ];
        let problem = load(&signed).unwrap_err();
        assert!(problem.contains("at most 36.9") && problem.contains("78 bytes"), "{problem}");
    }

    #[test]
    fn a_turn_to_the_heading_of_a_marker_that_has_none_is_refused() {
        let problem = load(&["metric.turn_rad_s=0.3"]).unwrap_err();
        for part in ["`metric.turn_rad_s` = 0.3", "it must be 0", "`marker` = rings", "no heading"]
        {
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
        assert!(load(&["metric.turn_rad_s=0.3", "marker=rings-thesis"]).is_err());
        for marker in ["marker=aruco-4x4-50:7", "marker=pad:1"] {
            assert!(load(&["metric.turn_rad_s=0.3", marker]).is_ok(), "{marker}");
        }
    }

    #[test]
    fn the_device_of_a_serial_line_is_known_without_its_speed() {
        for (address, device) in [
            ("serial:/dev/ttyACM0:921600", Some("/dev/ttyACM0")),
            ("serial:/dev/serial/by-path/usb-0:1.0", Some("/dev/serial/by-path/usb-0:1.0")),
            ("udpin:0.0.0.0:14550", None),
        ] {
            let config = load(&[&format!("autopilot.address={address}")]).unwrap();
            assert_eq!(config.serial_device().as_deref(), device, "{address}");
        }
    }

    #[test]
    fn values_out_of_range_are_refused_with_their_limits() {
        let check = |set: &str, parts: &[&str]| {
            let problem = load(&[set]).unwrap_err();
            for part in parts {
                assert!(problem.contains(part), "`{part}` is not in: {problem}");
            }
        };
        check("phases.hold_timeout_s=0", &["phases.hold_timeout_s", "from 1 to 600"]);
        check("thesis.kp=5", &["`thesis.kp` = 5", "from 0 to 0.1"]);
        check("autopilot.address=usb", &["autopilot.address", "usb"]);
        check("marker=aruco-4x4-50:x7", &["`marker`", "FAMILY:ID"]);
        check("guidance=magic", &["magic", "metric"]);
        check("mode=magic", &["magic", "landing-target"]);
        check("alarms.battery_low=30", &["`alarms.battery_low` = 30", "from 0 to 1"]);
        check("metric.gain=1", &["no key `metric.gain`"]);
        let stale = ["`alarms.autopilot_lost_s` = 0.3", "`phases.stale_vehicle_s` (0.5)"];
        check("alarms.autopilot_lost_s=0.3", &stale);
        check("phases.stale_vehicle_s=1.5", &["`alarms.autopilot_lost_s` = 1", "(1.5)"]);
        assert!(load(&["alarms.autopilot_lost_s=0"]).is_ok(), "the alarm is off");
        check("phases.stale_target_s=1.5", &["`phases.lost_target_s` = 1", "(1.5)"]);
        check("estimator.forget_after_s=5", &["`estimator.forget_after_s` = 5", "blind_s", "6.7"]);
    }
}
