//! Plans a campaign of flights with faults: each seed draws one fault or two, the height at which they begin, their
//! durations, and the wind.

use std::path::PathBuf;

use markers::Marker;
use node::ConfigError;

use super::kind::{FAULTY_DETECTOR, Kind};
use crate::landing::configuration;
use crate::landing::fault::{START_ANGLE, drawn, drawn_angle};
use crate::landing::plan::{Swept, Values, refuse_other_marker, set_option, settings_text};

/// Durations that are drawn, in seconds; infinity is for ever.
pub const DURATIONS_S: [f64; 4] = [0.5, 2.0, 5.0, f64::INFINITY];
/// Winds that are drawn, in m/s.
const WINDS_M_S: [f64; 2] = [0.0, 5.0];
/// Part of the flights that have a second fault.
const PART_WITH_TWO: f64 = 0.2;
/// Maximum time from the first fault to the second, in seconds.
const MAX_BETWEEN_S: f64 = 1.5;
/// Height over the pad at the start, in metres.
pub const START_HEIGHT_M: f64 = 10.0;

/// The choice of flights.
#[derive(Clone, Debug)]
pub struct Plan {
    /// Number of flights.
    pub flights: u64,
    /// Seed of the first flight; the others follow.
    pub seed: u64,
    /// Kinds, of which each flight has the next one.
    pub kinds: Vec<Kind>,
    /// Height over the pad at which the fault begins, in metres.
    pub height: Values,
    /// Durations in seconds; empty for those that are drawn.
    pub durations_s: Vec<f64>,
    /// Winds in m/s; empty for those that are drawn.
    pub winds_m_s: Vec<f64>,
    /// The second fault.
    pub second: Second,
    /// The marker of pad, detector and controller, instead of the configured ones.
    pub marker: Option<Marker>,
    /// Further settings, `simulator.KEY=VALUE` or `controller.KEY=VALUE`.
    pub set: Vec<String>,
    /// True when it is flown with real processes.
    pub real_time: bool,
}

/// Which flights have a second fault.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Second {
    /// A fifth of them, of any kind.
    Drawn,
    /// None.
    None,
    /// All, of this kind.
    Always(Kind),
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            flights: 1000,
            seed: 1,
            kinds: Kind::in_lockstep().collect(),
            height: Values::Range(0.2, 9.0),
            durations_s: Vec::new(),
            winds_m_s: Vec::new(),
            second: Second::Drawn,
            marker: None,
            set: Vec::new(),
            real_time: false,
        }
    }
}

/// The settings of which a flight of `alight experiment faults` has a value of its own.
pub const SWEPT: [Swept; 2] =
    [Swept::new("simulator.wind.mean_m_s", "--wind"), Swept::new("simulator.seed", "--seed")];

/// The campaign to run.
#[derive(Clone, Debug)]
pub struct Request {
    /// The command that requested it, for the report.
    pub command: String,
    /// The flights.
    pub plan: Plan,
    /// Folder of the recordings with the controllers' tapes, if they are requested.
    pub tapes_in: Option<PathBuf>,
    /// Number of flights in parallel.
    pub jobs: usize,
}

/// A fault of one flight.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Fault {
    /// Its kind.
    pub kind: Kind,
    /// From the moment the height is reached to its begin, in seconds.
    pub after_s: f64,
    /// Its duration, in seconds; infinity is for ever.
    pub for_s: f64,
    /// Its size, from 0 to 1; the meaning depends on the kind.
    pub size: f64,
}

/// One flight.
#[derive(Clone, Debug)]
pub struct Planned {
    /// Its seed.
    pub seed: u64,
    /// Height over the pad at which the faults begin, in metres.
    pub height_m: f64,
    /// Mean wind, in m/s.
    pub wind_m_s: f64,
    /// Its faults, one or two.
    pub faults: Vec<Fault>,
    /// Settings of the simulator.
    pub simulator: Vec<String>,
    /// Settings of the controller.
    pub controller: Vec<String>,
    /// The marker that was requested.
    marker: Option<Marker>,
    /// Further settings.
    set: Vec<String>,
    /// Further options of its command, besides the drawn values.
    options: String,
}

impl Plan {
    /// Checks every flight before one is flown: its settings, and that its fault begins no higher than it starts.
    ///
    /// # Errors
    /// The first setting that a service refuses, or the start that is too low.
    pub fn check(&self) -> Result<(), ConfigError> {
        // The pad is the same in all.
        configuration::<detector::Config>("detector", &self.flight(self.seed).detector()?)?;
        self.flights().iter().try_for_each(|planned| {
            let simulated =
                configuration::<simulator::Config>("simulator", &planned.simulator)?.settings;
            configuration::<controller::Config>("controller", &planned.controller)?;
            let (start_m, begins_m) = (simulated.start.height_m, planned.height_m);
            if begins_m <= start_m {
                return Ok(());
            }
            Err(ConfigError::Refused {
                source_name: format!("--height {}", self.height),
                key: "simulator.start.height_m".to_owned(),
                value: start_m.to_string(),
                limit: format!("a fault cannot begin at {begins_m} m, over the start; choose a lower `--height`"),
            })
        })
    }

    /// Refuses flights whose controller looks for another marker than the pad has, which is the same in all.
    ///
    /// # Errors
    /// When they are such flights, with a remedy.
    pub fn check_marker(&self) -> Result<(), String> {
        let Planned { simulator, controller, .. } = self.flight(self.seed);
        refuse_other_marker(&simulator, &controller)
    }

    /// Its flights.
    pub fn flights(&self) -> Vec<Planned> {
        (0..self.flights).map(|i| self.flight(self.seed.wrapping_add(i))).collect()
    }

    fn flight(&self, seed: u64) -> Planned {
        let kind = pick_in_turn(&self.kinds, seed).unwrap_or(Kind::ControllerKilled);
        let all: Vec<Kind> = Kind::in_lockstep().collect();
        let second = match self.second {
            Second::None => None,
            Second::Always(kind) => Some(kind),
            Second::Drawn if drawn(seed, 20) < PART_WITH_TWO => pick(&all, drawn(seed, 21)),
            Second::Drawn => None,
        };
        let or_drawn = |given: &[f64], usual: &[f64], which| {
            let values = if given.is_empty() { usual } else { given };
            pick(values, drawn(seed, which)).unwrap_or_default()
        };
        let first = Fault {
            kind,
            after_s: 0.0,
            for_s: or_drawn(&self.durations_s, &DURATIONS_S, 22),
            size: drawn(seed, 23),
        };
        let second = second.filter(|second| *second != kind).map(|kind| Fault {
            kind,
            after_s: MAX_BETWEEN_S * drawn(seed, 24),
            for_s: or_drawn(&self.durations_s, &DURATIONS_S, 25),
            size: drawn(seed, 26),
        });
        let mut planned = Planned {
            seed,
            height_m: match &self.height {
                Values::Range(min, max) => min + (max - min) * drawn(seed, 27),
                Values::List(values) => pick(values, drawn(seed, 27)).unwrap_or_default(),
            },
            wind_m_s: or_drawn(&self.winds_m_s, &WINDS_M_S, 28),
            faults: std::iter::once(first).chain(second).collect(),
            simulator: Vec::new(),
            controller: Vec::new(),
            marker: self.marker,
            set: self.set.clone(),
            options: self.options(),
        };
        planned.add_settings();
        planned
    }
}

impl Plan {
    fn options(&self) -> String {
        let mut options = String::new();
        if !self.durations_s.is_empty() {
            let text = |s: &f64| if s.is_finite() { s.to_string() } else { "ever".to_owned() };
            let durations: Vec<String> = self.durations_s.iter().map(text).collect();
            options.push_str(&format!(" --for {}", durations.join(",")));
        }
        if let Some(marker) = &self.marker {
            options.push_str(&format!(" --marker {marker}"));
        }
        for setting in &self.set {
            options.push_str(&set_option(setting));
        }
        if self.real_time {
            options.push_str(" --real-time");
        }
        options
    }
}

impl Planned {
    fn add_settings(&mut self) {
        let seed = self.seed;
        let (east, north) = drawn_angle(seed, START_ANGLE).sin_cos();
        let (pad_north, pad_east) = (1.5, -1.5);
        let turbulence = if self.wind_m_s > 0.0 { 1.0 } else { 0.0 };
        self.simulator = vec![
            format!("seed={}", seed & (i64::MAX as u64)),
            format!("wind.mean_m_s={:.4}", self.wind_m_s),
            format!("wind.turbulence={turbulence}"),
            format!("wind.from_deg={:.2}", drawn_angle(seed, 7).to_degrees()),
            "wind.thesis_noise=false".to_owned(),
            "camera.latency_ms=80".to_owned(),
            "camera.jitter_ms=20".to_owned(),
            format!("start.height_m={START_HEIGHT_M}"),
            format!("start.north_m={:.4}", pad_north + 0.5 * north),
            format!("start.east_m={:.4}", pad_east + 0.5 * east),
            format!("start.heading_deg={:.2}", drawn_angle(seed, 8).to_degrees()),
            "begin_height_m=1000".to_owned(),
        ];
        self.controller = ["start=airborne", "autopilot.system_id=1"].map(str::to_owned).to_vec();
        if self.faults.iter().any(|fault| fault.kind.prefers_a_faulty_detector()) {
            self.controller.push(format!("detectors.preferred=\"{FAULTY_DETECTOR}\""));
        }
        self.simulator.extend(self.given("simulator"));
        self.controller.extend(self.given("controller"));
    }

    /// The requested settings of simulator or controller, which come after the drawn ones: the marker, then the further settings.
    pub fn given(&self, service: &str) -> Vec<String> {
        let marker = self.marker.as_ref().and_then(|marker| match service {
            "simulator" => Some(format!("pad.marker=\"{marker}\"")),
            "controller" => Some(format!("marker=\"{}\"", marker.name())),
            _ => None,
        });
        let of_service = |setting: &String| {
            let (owner, rest) = setting.split_once('.')?;
            (owner == service).then(|| rest.to_owned())
        };
        marker.into_iter().chain(self.set.iter().filter_map(of_service)).collect()
    }

    /// Settings of the detector: it looks for the marker on the pad, for any option that has set it.
    ///
    /// # Errors
    /// When a setting of the simulator is invalid.
    pub fn detector(&self) -> Result<Vec<String>, ConfigError> {
        let simulated = configuration::<simulator::Config>("simulator", &self.simulator)?.settings;
        Ok(vec![format!("markers=[\"{}\"]", simulated.pad.marker)])
    }

    /// Its guidance, the marker where one was requested, and the further settings, in a word for each.
    pub fn settings(&self) -> String {
        settings_text(self.marker.as_ref(), &self.set)
    }

    /// Names of its faults.
    pub fn kinds(&self) -> String {
        let names: Vec<&str> = self.faults.iter().map(|fault| fault.kind.name()).collect();
        names.join(" + ")
    }

    /// The command that repeats it, in a folder of its own: that of the campaign is taken.
    pub fn command(&self) -> String {
        let mut kinds = self.faults.iter().map(|fault| fault.kind.name());
        // There is always a first.
        let (kind, second) = (kinds.next().unwrap_or_default(), kinds.next().unwrap_or("none"));
        format!(
            "alight experiment faults -o again-{kind}-{seed} --flights 1 --seed {seed} --height {} --wind {} --kind {kind} --with {second}{}",
            self.height_m,
            self.wind_m_s,
            self.options,
            seed = self.seed,
        )
    }
}

/// A value by a random number from 0 to 1.
fn pick<T: Copy>(values: &[T], part: f64) -> Option<T> {
    values.get((part * values.len() as f64) as usize).or(values.last()).copied()
}

/// The kind of a seed: neighbours have different ones.
fn pick_in_turn(kinds: &[Kind], seed: u64) -> Option<Kind> {
    let count = u64::try_from(kinds.len()).ok().filter(|count| *count > 0)?;
    usize::try_from(seed % count).ok().and_then(|at| kinds.get(at)).copied()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flight_alone_is_the_same_as_among_others() {
        let flights = Plan { flights: 200, seed: 5, ..Plan::default() }.flights();
        for planned in &flights {
            let alone = Plan {
                flights: 1,
                seed: planned.seed,
                kinds: vec![planned.faults[0].kind],
                height: Values::List(vec![planned.height_m]),
                winds_m_s: vec![planned.wind_m_s],
                second: planned
                    .faults
                    .get(1)
                    .map_or(Second::None, |second| Second::Always(second.kind)),
                ..Plan::default()
            };
            let alone = alone.flights().remove(0);
            assert_eq!(alone.faults, planned.faults);
            assert_eq!(
                (alone.simulator, alone.controller),
                (planned.simulator.clone(), planned.controller.clone())
            );
        }
        let twice = flights.iter().filter(|planned| planned.faults.len() == 2).count();
        assert!((20..60).contains(&twice), "{twice}");
    }

    #[test]
    fn the_command_of_a_flight_has_each_setting_as_it_was_given() {
        let set = vec!["controller.detectors.preferred=\"it's main\"".to_owned()];
        let command = Plan { set: set.clone(), ..Plan::default() }.flights()[0].command();
        let words = shlex::split(&command).unwrap();
        assert!(words.windows(2).any(|pair| pair == ["--set", &set[0]]), "{command}");
    }

    #[test]
    fn every_kind_is_flown_before_one_is_flown_again() {
        let flights = Plan { flights: 39, ..Plan::default() }.flights();
        let mut names: Vec<&str> = flights.iter().map(|f| f.faults[0].kind.name()).collect();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), 39);
    }

    #[test]
    fn a_pad_whose_marker_the_controller_does_not_look_for_is_refused() {
        let checked = |set: &[&str]| {
            let set = set.iter().map(|&it| it.to_owned()).collect();
            Plan { set, ..Plan::default() }.check_marker()
        };
        assert_eq!(checked(&[]), Ok(()));
        let pad = "simulator.pad.marker=apriltag-36h11:7:0.15";
        let alone = checked(&[pad]).unwrap_err();
        assert!(alone.contains("looks for rings") && alone.contains("--marker"), "{alone}");
        let other = checked(&["controller.marker=apriltag-36h11"]).unwrap_err();
        assert!(other.contains("looks for apriltag-36h11"), "{other}");
        assert_eq!(checked(&[pad, "controller.marker=apriltag-36h11:7"]), Ok(()));
        assert!(checked(&["simulator.pad.markers=a4"]).unwrap_err().contains("one marker"));
    }

    #[test]
    fn a_marker_is_that_of_pad_controller_and_detector() {
        for (name, family) in [("apriltag-36h11:7:0.2", "apriltag-36h11:7"), ("rings:0.3", "rings")]
        {
            let plan = Plan { marker: name.parse().ok(), flights: 1, ..Plan::default() };
            assert_eq!(plan.check_marker(), Ok(()));
            assert!(plan.check().is_ok());
            let planned = plan.flights().remove(0);
            let pad = format!("pad.marker=\"{name}\"");
            assert_eq!(planned.simulator.iter().filter(|it| **it == pad).count(), 1);
            assert_eq!(planned.given("simulator"), [pad]);
            assert_eq!(planned.given("controller"), [format!("marker=\"{family}\"")]);
            assert!(planned.controller.ends_with(&planned.given("controller")));
            assert_eq!(planned.detector().unwrap(), [format!("markers=[\"{name}\"]")]);
            assert!(planned.command().contains(&format!(" --marker {name}")), "{planned:?}");
            assert!(planned.settings().contains(&format!(" marker={name}")), "{planned:?}");
        }
    }

    #[test]
    fn a_detector_looks_for_the_marker_that_further_settings_put_on_the_pad() {
        let set = ["simulator.pad.marker=aruco-4x4-50:3:0.2", "controller.marker=aruco-4x4-50:3"];
        let plan = Plan { set: set.map(str::to_owned).to_vec(), ..Plan::default() };
        let planned = plan.flights().remove(0);
        assert_eq!(planned.detector().unwrap(), ["markers=[\"aruco-4x4-50:3:0.2\"]"]);
        let usual = Plan::default().flights().remove(0).detector().unwrap();
        let usual = configuration::<detector::Config>("detector", &usual).unwrap().settings;
        let configured = configuration::<detector::Config>("detector", &[]).unwrap().settings;
        assert_eq!(usual.markers, configured.markers);
    }

    #[test]
    fn heights_over_the_start_and_settings_that_a_service_refuses_are_refused_before_the_first_flight()
     {
        let plan = |heights: &[f64], set: &[&str]| Plan {
            flights: 20,
            height: Values::List(heights.to_vec()),
            set: set.iter().map(|&setting| setting.to_owned()).collect(),
            ..Plan::default()
        };
        let error_of = |plan: Plan| plan.check().unwrap_err().to_string();
        assert!(plan(&[0.3, 10.0], &[]).check().is_ok());
        assert!(plan(&[30.0], &["simulator.start.height_m=30"]).check().is_ok());
        let high = error_of(plan(&[3.0, 30.0], &[]));
        assert!(high.contains("--height 3,30") && high.contains("at 30 m"), "{high}");
        let unknown = error_of(plan(&[3.0], &["simulator.nonsense=3"]));
        assert!(unknown.contains("no key `simulator.nonsense`"), "{unknown}");
        let refused = error_of(plan(&[3.0], &["controller.start=never"]));
        assert!(refused.contains("controller.start"), "{refused}");
    }
}
