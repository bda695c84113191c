//! Plans the flights of the landing experiment: every combination of wind, turbulence, latency, height, offset
//! and fault, with several seeds each, as settings of simulator and controller.

use std::borrow::Cow;
use std::ops::RangeInclusive;
use std::str::FromStr;

use markers::Marker;
use node::ConfigError;

use super::configuration;
pub use super::fault::Vision;
use super::fault::{Change, Fault, START_ANGLE, drawn, drawn_angle};

/// Values of one axis of the grid: a list `1,2,3`, or a range `0..8` with a random value for each seed.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Each of these.
    List(Vec<f64>),
    /// A random value of this range.
    Range(f64, f64),
}

impl Values {
    fn cells(&self) -> Vec<Self> {
        match self {
            Self::List(values) => {
                without_repeats(values).map(|value| Self::List(vec![*value])).collect()
            }
            Self::Range(..) => vec![self.clone()],
        }
    }

    /// The value of a flight in a cell.
    fn of(&self, seed: u64, which: u32) -> f64 {
        match self {
            Self::List(values) => values.first().copied().unwrap_or_default(),
            Self::Range(min, max) => min + (max - min) * drawn(seed, which),
        }
    }
}

impl std::fmt::Display for Values {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::List(values) => {
                let texts: Vec<String> = values.iter().map(f64::to_string).collect();
                write!(f, "{}", texts.join(","))
            }
            Self::Range(min, max) => write!(f, "{min}..{max}"),
        }
    }
}

impl FromStr for Values {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number = |part: &str| {
            let number: Option<f64> = part.trim().parse().ok();
            number
                .filter(|n| n.is_finite() && *n >= 0.0)
                .ok_or_else(|| format!("`{part}` is not a number >= 0; write 5, or 0,5,8, or 0..8"))
        };
        match text.split_once("..") {
            Some((min, max)) => match (number(min)?, number(max)?) {
                (min, max) if min <= max => Ok(Self::Range(min, max)),
                (min, max) => {
                    Err(format!("the range `{text}` begins above its end; write {max}..{min}"))
                }
            },
            None => Ok(Self::List(text.split(',').map(number).collect::<Result<_, _>>()?)),
        }
    }
}

/// Heights at which a landing can begin: the vehicle flies, and the simulator places it there.
pub const HEIGHTS_M: RangeInclusive<f64> = 0.1..=100.0;

/// Heights at the start.
///
/// # Errors
/// When they are none, or one is outside of [`HEIGHTS_M`].
pub fn heights(text: &str) -> Result<Values, String> {
    let values: Values = text.parse()?;
    let all = match &values {
        Values::List(values) => values.clone(),
        Values::Range(min, max) => vec![*min, *max],
    };
    match all.iter().find(|height_m| !HEIGHTS_M.contains(height_m)) {
        None => Ok(values),
        Some(height_m) => Err(format!(
            "no landing begins at {height_m} m: heights are from {} to {} m",
            HEIGHTS_M.start(),
            HEIGHTS_M.end()
        )),
    }
}

/// A grid of flights.
#[derive(Clone, Debug)]
pub struct Plan {
    /// The vision of a flight.
    pub vision: Vision,
    /// Number of flights of each combination.
    pub flights: u64,
    /// Seed of the first flight of each combination; the others follow.
    pub seed: u64,
    /// Mean wind, in m/s.
    pub wind: Values,
    /// Strength of the turbulence.
    pub turbulence: Values,
    /// Latency from exposure to arrival, in milliseconds.
    pub latency: Values,
    /// Height over the pad at the start, in metres.
    pub height: Values,
    /// Horizontal distance from the pad at the start, in metres.
    pub offset: Values,
    /// Faults.
    pub faults: Vec<Fault>,
    /// The marker of pad, detector and controller, instead of the configured ones.
    pub marker: Option<Marker>,
    /// Further settings, `simulator.KEY=VALUE` or `controller.KEY=VALUE`.
    pub set: Vec<String>,
}

impl Default for Plan {
    fn default() -> Self {
        Self {
            vision: Vision::Modelled,
            flights: 20,
            seed: 1,
            wind: Values::List(vec![0.0, 2.0, 5.0, 8.0]),
            turbulence: Values::List(vec![1.0]),
            latency: Values::List(vec![80.0]),
            height: Values::List(vec![10.0]),
            offset: Values::List(vec![2.12]),
            faults: vec![Fault::NONE],
            marker: None,
            set: Vec::new(),
        }
    }
}

/// A setting of which each flight has a value of its own, and the option that chooses it.
#[derive(Copy, Clone, Debug)]
pub struct Swept {
    setting: &'static str,
    option: &'static str,
}

impl Swept {
    /// With the service's name before the setting.
    pub const fn new(setting: &'static str, option: &'static str) -> Self {
        Self { setting, option }
    }
}

/// Those of `alight experiment landing`.
pub const SWEPT: [Swept; 7] = [
    Swept::new("simulator.wind.mean_m_s", "--wind"),
    Swept::new("simulator.wind.turbulence", "--turbulence"),
    Swept::new("simulator.camera.latency_ms", "--latency"),
    Swept::new("simulator.start.height_m", "--height"),
    Swept::new("simulator.start.north_m", "--offset"),
    Swept::new("simulator.start.east_m", "--offset"),
    Swept::new("simulator.seed", "--seed"),
];

/// Refuses a setting by which a flight would differ from its stated circumstances, with the option that chooses it.
///
/// # Errors
/// When there is such a setting.
pub fn refuse_swept(settings: &[String], swept: &[Swept]) -> Result<(), String> {
    for setting in settings {
        let key = setting.split('=').next().unwrap_or_default().trim();
        if let Some(Swept { option, .. }) = swept.iter().find(|swept| swept.setting == key) {
            return Err(format!(
                "`--set {setting}`: results are sorted by it, so give it with `{option}`"
            ));
        }
    }
    Ok(())
}

/// The experiment to run.
#[derive(Clone, Debug, Default)]
pub struct Request {
    /// The command that requested it, for the report.
    pub command: String,
    /// The flights.
    pub plan: Plan,
    /// Number of flights in parallel.
    pub jobs: usize,
    /// Number of the worst flights of each combination that are written as recordings.
    pub recordings: usize,
}

/// One flight of a plan.
#[derive(Clone, Debug)]
pub struct Planned {
    /// The name of its cell.
    pub cell: String,
    /// The number of the cell, as the table's rows are counted.
    pub row: usize,
    /// The options of its command.
    pub options: String,
    /// The vision of a flight.
    pub vision: Vision,
    /// Its seed.
    pub seed: u64,
    /// Mean wind, in m/s.
    pub wind_m_s: f64,
    /// Strength of the turbulence.
    pub turbulence: f64,
    /// Latency, in milliseconds.
    pub latency_ms: f64,
    /// Height at the start, in metres.
    pub height_m: f64,
    /// Horizontal distance at the start, in metres.
    pub offset_m: f64,
    /// The fault.
    pub fault: Fault,
    /// The guidance, the marker where one was requested, and the further settings, in a word for each.
    pub settings: String,
    /// All settings, and the faults of the modelled detector.
    pub change: Change,
}

impl Plan {
    /// Checks the settings of every flight, so that none is refused after others were flown.
    ///
    /// # Errors
    /// The first setting that a service refuses.
    pub fn check(&self) -> Result<(), ConfigError> {
        self.flights().iter().try_for_each(|planned| {
            configuration::<simulator::Config>("simulator", &planned.change.simulator)?;
            configuration::<controller::Config>("controller", &planned.change.controller)?;
            Ok(())
        })
    }

    /// Refuses flights whose controller looks for another marker than the pad has: none would land, and none would report the reason.
    ///
    /// # Errors
    /// When there is such a flight, with a remedy.
    pub fn check_marker(&self) -> Result<(), String> {
        let mut flights = self.flights();
        flights.retain(|planned| planned.seed == self.seed);
        flights.iter().try_for_each(|planned| {
            let Change { simulator, controller, .. } = &planned.change;
            refuse_other_marker(simulator, controller)
        })
    }

    /// Its flights, cell after cell.
    pub fn flights(&self) -> Vec<Planned> {
        let settings = settings_text(self.marker.as_ref(), &self.set);
        let mut flights = Vec::new();
        let mut row = 0;
        for fault in without_repeats(&self.faults) {
            for [wind, turbulence, latency, height, offset] in self.cells() {
                row += 1;
                let axes = [&wind, &turbulence, &latency, &height, &offset];
                for seed in (0..self.flights).map(|i| self.seed.wrapping_add(i)) {
                    let settings = settings.clone();
                    flights.push(Planned { row, settings, ..self.flight(seed, *fault, axes) });
                }
            }
        }
        flights
    }

    fn cells(&self) -> Vec<[Values; 5]> {
        let mut cells = Vec::new();
        for wind in self.wind.cells() {
            for turbulence in self.turbulence.cells() {
                for latency in self.latency.cells() {
                    for height in self.height.cells() {
                        for offset in self.offset.cells() {
                            let axes = [&wind, &turbulence, &latency, &height, &offset];
                            cells.push(axes.map(Clone::clone));
                        }
                    }
                }
            }
        }
        cells
    }

    fn flight(&self, seed: u64, fault: Fault, axes: [&Values; 5]) -> Planned {
        let [wind, turbulence, latency, height, offset] = axes;
        let mut planned = Planned {
            row: 0,
            cell: format!(
                "{}, wind {wind} m/s, turbulence {turbulence}, {latency} ms, from {height} m, {offset} m aside",
                fault.name()
            ),
            options: format!(
                "--vision {} --wind {wind} --turbulence {turbulence} --latency {latency} --height {height} \
                 --offset {offset} --fault {}",
                self.vision.name(),
                fault.name()
            ),
            vision: self.vision,
            seed,
            wind_m_s: wind.of(seed, 1),
            turbulence: turbulence.of(seed, 2),
            latency_ms: latency.of(seed, 3),
            height_m: height.of(seed, 4),
            offset_m: offset.of(seed, 5),
            fault,
            settings: String::new(),
            change: Change::default(),
        };
        if let Some(marker) = &self.marker {
            planned.options.push_str(&format!(" --marker {marker}"));
        }
        for setting in &self.set {
            planned.options.push_str(&set_option(setting));
        }
        planned.change = self.change(&planned);
        planned
    }

    /// The settings of a flight: start and wind, then the fault, then the further settings.
    fn change(&self, planned: &Planned) -> Change {
        let seed = planned.seed;
        let fault = planned.fault.change(seed);
        let (east, north) = drawn_angle(seed, START_ANGLE).sin_cos();
        let (pad_north, pad_east) = (1.5, -1.5);
        let mut simulator = vec![
            format!("seed={}", seed & (i64::MAX as u64)),
            format!("wind.mean_m_s={:.4}", planned.wind_m_s),
            format!("wind.turbulence={:.4}", planned.turbulence),
            format!("wind.from_deg={:.2}", drawn_angle(seed, 7).to_degrees()),
            "wind.thesis_noise=false".to_owned(),
            format!("camera.latency_ms={:.3}", planned.latency_ms),
            format!("camera.jitter_ms={:.3}", 0.25 * planned.latency_ms),
            format!("start.height_m={:.4}", planned.height_m),
            format!("start.north_m={:.4}", pad_north + planned.offset_m * north),
            format!("start.east_m={:.4}", pad_east + planned.offset_m * east),
            format!("start.heading_deg={:.2}", drawn_angle(seed, 8).to_degrees()),
            "begin_height_m=1000".to_owned(),
        ];
        simulator.extend(fault.simulator);
        let mut controller =
            ["start=airborne", "autopilot.system_id=1"].map(str::to_owned).to_vec();
        controller.extend(fault.controller);
        if let Some(mut marker) = self.marker {
            // To a thousandth of a millimetre.
            let scaled = |size_m: f64| (1e6 * size_m * planned.fault.marker_scale()).round() / 1e6;
            marker.size_m = marker.size_m.map(scaled);
            simulator.push(format!("pad.marker=\"{marker}\""));
            controller.push(format!("marker=\"{}\"", marker.name()));
        }
        for setting in &self.set {
            match setting.split_once('.') {
                Some(("simulator", rest)) => simulator.push(rest.to_owned()),
                Some(("controller", rest)) => controller.push(rest.to_owned()),
                _ => {}
            }
        }
        Change { simulator, controller, vision: fault.vision }
    }
}

impl Planned {
    /// The command that repeats and draws it, in a folder of its own: that of the campaign is taken.
    pub fn command(&self) -> String {
        format!(
            "alight experiment landing -o again-row-{}-seed-{} {} --flights 1 --seed {}",
            self.row, self.seed, self.options, self.seed
        )
    }
}

/// Refuses a flight with these settings if its controller looks for another marker than the pad has. Settings that a service refuses
/// anyway are not reported again.
pub(crate) fn refuse_other_marker(
    simulator: &[String],
    controller: &[String],
) -> Result<(), String> {
    let simulator = configuration::<simulator::Config>("simulator", simulator);
    let controller = configuration::<controller::Config>("controller", controller);
    let (Ok(simulator), Ok(controller)) = (simulator, controller) else { return Ok(()) };
    let (pad, wanted) = (simulator.settings.pad, controller.settings.marker);
    if !pad.markers.is_empty() {
        return Err(format!(
            "`simulator.pad.markers` = {}: the flights of experiments have a pad of one marker; \
             take `alight land --pad` for one of several",
            pad.markers
        ));
    }
    if is_of(&pad.marker, &wanted) {
        return Ok(());
    }
    Err(format!(
        "the pad has the marker {}, and the controller looks for {wanted}: `--marker FAMILY:ID:SIZE_M` sets both",
        pad.marker
    ))
}

/// The warning on flights for which [`only_size_counts`].
pub const ONLY_SIZE_COUNTS: &str = "Vision is modelled with the errors of `rings`: of this marker nothing but the size counts, and another family gives \
     the same flights. Markers are compared with `--vision rendered` (faults with `--real-time`).";

/// Whether flights with this vision and these settings have a marker whose detections are not modelled: modelled vision has the errors of the
/// rings for every marker.
pub fn only_size_counts(vision: &str, settings: &str) -> bool {
    let words = shlex::split(settings).unwrap_or_default();
    let marker = words.iter().rev().find_map(|word| {
        word.strip_prefix("simulator.pad.marker=").or_else(|| word.strip_prefix("marker="))
    });
    let is_of_rings = |marker: &str| marker.trim_matches(['"', '\'']).starts_with("rings");
    vision == Vision::Modelled.name() && marker.is_some_and(|marker| !is_of_rings(marker))
}

/// Whether the pad's marker is the one that a controller looks for, `FAMILY` or `FAMILY:ID`.
fn is_of(pad: &str, wanted: &str) -> bool {
    let (Ok(pad), Ok((family, id))) = (pad.parse::<Marker>(), messages::marker_name(wanted)) else {
        return false;
    };
    pad.family.name() == family && (id.is_none() || pad.id == id)
}

/// Each value once: the same flights again would count twice.
fn without_repeats<T: PartialEq>(values: &[T]) -> impl Iterator<Item = &T> {
    let is_first = |at: usize, value: &T| values.iter().position(|it| it == value) == Some(at);
    values
        .iter()
        .enumerate()
        .filter(move |(at, value)| is_first(*at, value))
        .map(|(_, value)| value)
}

/// The guidance, the marker where one was requested, and the further settings, one word for each: they distinguish the flights of
/// two campaigns.
pub fn settings_text(marker: Option<&Marker>, set: &[String]) -> String {
    const GUIDANCE: &str = "controller.guidance";
    let key_of = |setting: &String| setting.split('=').next().unwrap_or_default().trim().to_owned();
    let of_controller: Vec<String> =
        set.iter().filter_map(|it| it.strip_prefix("controller.")).map(str::to_owned).collect();
    let controller = configuration::<controller::Config>("controller", &of_controller).ok();
    let guidance = controller.as_ref().and_then(|it| it.table.get("guidance")?.as_str());
    let guidance = guidance.map(|name| format!("{GUIDANCE}={name}"));
    let marker = marker.map(|marker| format!("marker={marker}"));
    let others = set.iter().filter(|setting| guidance.is_none() || key_of(setting) != GUIDANCE);
    let words = guidance.iter().chain(&marker).chain(others);
    let word = |it: &String| match it.contains(char::is_whitespace) {
        true => quoted(it).into_owned(),
        false => it.clone(),
    };
    words.map(word).collect::<Vec<_>>().join(" ")
}

/// A word, for a shell.
fn quoted(word: &str) -> Cow<'_, str> {
    // Only a zero byte cannot be quoted, and no argument has one.
    shlex::try_quote(word).unwrap_or(Cow::Borrowed(word))
}

/// The option that sets this, for a shell.
pub(crate) fn set_option(setting: &str) -> String {
    format!(" --set {}", quoted(setting))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lists_and_ranges_are_parsed() {
        assert_eq!("0,5".parse(), Ok(Values::List(vec![0.0, 5.0])));
        assert_eq!("0..8".parse(), Ok(Values::Range(0.0, 8.0)));
        for wrong in ["", "a", "1,", "0..", "-1", "8..2", "0.3..0.2"] {
            assert!(wrong.parse::<Values>().is_err(), "{wrong}");
        }
        assert!("8..2".parse::<Values>().unwrap_err().contains("write 2..8"));
    }

    #[test]
    fn heights_at_which_no_landing_begins_are_refused() {
        assert_eq!(heights("0.1,10"), Ok(Values::List(vec![0.1, 10.0])));
        for wrong in ["0", "10,0.05", "0..5", "5..101", "12..4", "x"] {
            assert!(heights(wrong).is_err(), "{wrong}");
        }
        assert!(heights("0").unwrap_err().contains("from 0.1 to 100 m"));
    }

    #[test]
    fn one_flight_alone_is_the_same_as_among_others() {
        let plan = Plan {
            wind: Values::Range(0.0, 8.0),
            height: Values::List(vec![5.0, 15.0]),
            flights: 7,
            seed: 3,
            ..Plan::default()
        };
        let flights = plan.flights();
        assert_eq!(flights.len(), 14);
        let sixth = &flights[5];
        let again = Plan {
            flights: 1,
            seed: sixth.seed,
            height: Values::List(vec![sixth.height_m]),
            ..plan
        };
        let alone = &again.flights()[0];
        assert_eq!((alone.wind_m_s, &alone.options), (sixth.wind_m_s, &sixth.options));
        assert_eq!(alone.change.simulator, sixth.change.simulator);
        assert!(alone.command().contains("--wind 0..8") && alone.command().ends_with("--seed 8"));
    }

    #[test]
    fn the_command_of_a_flight_has_each_setting_as_it_was_given() {
        let set = vec!["controller.detectors.preferred=\"it's main\"".to_owned()];
        let command = Plan { set: set.clone(), ..Plan::default() }.flights()[0].command();
        let words = shlex::split(&command).unwrap();
        assert!(words.windows(2).any(|pair| pair == ["--set", &set[0]]), "{command}");
    }

    #[test]
    fn guidance_marker_and_settings_distinguish_flights() {
        let settings_of = |plan: Plan| plan.flights()[0].settings.clone();
        assert_eq!(settings_of(Plan::default()), "controller.guidance=metric");
        let set = ["controller.guidance=\"thesis\"", "simulator.camera.rate_hz=20"];
        let set = set.map(str::to_owned).to_vec();
        let marker = "apriltag-36h11:7:0.15".parse().ok();
        assert_eq!(
            settings_of(Plan { set, marker, ..Plan::default() }),
            "controller.guidance=thesis marker=apriltag-36h11:7:0.15 simulator.camera.rate_hz=20"
        );
    }

    #[test]
    fn modelled_vision_of_a_marker_other_than_rings_needs_a_warning() {
        let needs_warning = |vision: Vision, marker: &str, set: &[&str]| {
            let set = set.iter().map(|&it| it.to_owned()).collect();
            let plan = Plan { vision, marker: marker.parse().ok(), set, ..Plan::default() };
            only_size_counts(plan.vision.name(), &plan.flights()[0].settings)
        };
        assert!(needs_warning(Vision::Modelled, "aruco-4x4-50:3:0.15", &[]));
        let of_pad = ["simulator.pad.marker=\"stag-hd23:7:0.15\"", "controller.marker=stag-hd23"];
        assert!(needs_warning(Vision::Modelled, "", &of_pad));
        assert!(!needs_warning(Vision::Rendered, "aruco-4x4-50:3:0.15", &[]));
        assert!(!needs_warning(Vision::Modelled, "rings:0.3", &["simulator.camera.rate_hz=20"]));
        assert!(!needs_warning(Vision::Modelled, "", &[]));
    }

    #[test]
    fn a_marker_is_that_of_pad_and_controller_under_every_fault() {
        let marker: Option<Marker> = "apriltag-36h11:7:0.2".parse().ok();
        let plan = Plan { marker, faults: Fault::all().collect(), flights: 1, ..Plan::default() };
        plan.check().unwrap();
        assert_eq!(plan.check_marker(), Ok(()));
        let command = plan.flights()[0].command();
        assert!(command.contains(" --marker apriltag-36h11:7:0.2 "), "{command}");
        let moving = plan.flights().into_iter().find(|it| it.fault.name() == "pad-heaves").unwrap();
        let last = moving.change.simulator.iter().rfind(|it| it.starts_with("pad.marker="));
        assert!(last.unwrap().contains("apriltag-36h11:7:0.3"), "{last:?}");
    }

    #[test]
    fn a_pad_whose_marker_the_controller_does_not_look_for_is_refused() {
        let checked = |set: &[&str]| {
            let set = set.iter().map(|&it| it.to_owned()).collect();
            Plan { set, ..Plan::default() }.check_marker()
        };
        let alone = checked(&["simulator.pad.marker=apriltag-36h11:7:0.15"]).unwrap_err();
        assert!(alone.contains("looks for rings") && alone.contains("--marker"), "{alone}");
        let both =
            ["simulator.pad.marker=apriltag-36h11:7:0.15", "controller.marker=apriltag-36h11"];
        assert_eq!(checked(&both), Ok(()));
        assert_eq!(checked(&["simulator.pad.marker=rings:0.3"]), Ok(()));
        assert!(checked(&["simulator.pad.markers=a4"]).unwrap_err().contains("one marker"));
    }

    #[test]
    fn a_value_that_is_given_twice_is_flown_once() {
        let winds = |wind: &str| {
            let faults = vec![Fault::NONE, Fault::NONE];
            let plan = Plan { wind: wind.parse().unwrap(), faults, flights: 2, ..Plan::default() };
            plan.flights().iter().map(|planned| planned.wind_m_s).collect::<Vec<_>>()
        };
        assert_eq!(winds("5,5"), [5.0, 5.0]);
        assert_eq!(winds("5,2,5"), [5.0, 5.0, 2.0, 2.0]);
    }

    #[test]
    fn a_plan_with_a_flight_that_would_be_refused_is_refused() {
        let windy = |wind: &str| Plan { wind: wind.parse().unwrap(), ..Plan::default() }.check();
        assert!(windy("0,20").is_ok());
        for wind in ["0,25", "0..200"] {
            let error = windy(wind).unwrap_err().to_string();
            assert!(error.contains("wind.mean_m_s") && error.contains("20"), "{error}");
        }
    }
}
