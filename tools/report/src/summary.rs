//! Computes a flight's summary for the report: how it ended, touchdown error and speed, times, frames used
//! and refused, losses, wind, battery, latency; and one line of it.

use messages::{LandedState, Phase, Touchdown, topic};
use node::stats::quantile;
use serde::Serialize;

use crate::flight::{Flight, Landing};
use crate::frames::{Fate, Frames};
use crate::latency::{Stage, TO_SETPOINT, budget};
use crate::origin::size;
use crate::{light, losses, phases, track};

/// A flight in numbers. Values that were not recorded are `None`.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Summary {
    /// The name of its file.
    pub name: String,
    /// When the landing began, or else the recording, as date and time of UTC.
    pub begun_utc: Option<String>,
    /// The time that the recording covers, in seconds.
    pub recording_s: Option<f64>,
    /// The size of its files, in bytes.
    pub recording_bytes: u64,
    /// Whether the recording has a landing, from whose begin all times count; else they count from the recording's.
    pub has_landing: bool,
    /// The program that flew it, with its version.
    pub program: Option<String>,
    /// The guidance law.
    pub guidance: Option<String>,
    /// The last phase of the landing.
    pub phase: Option<String>,
    /// Its reason.
    pub why: Option<String>,
    /// Whether it landed and its motors stopped; `None` without a status of a controller.
    pub landed: Option<bool>,
    /// The alarm or the command for which it landed where it was, which is in its reason.
    #[serde(skip)]
    pub landed_for: Option<String>,
    /// Why no status of a controller could be read, where there are some.
    pub unreadable_status: Option<String>,
    /// From the start of the landing to disarmed motors, in seconds.
    pub time_to_disarm_s: Option<f64>,
    /// From the start of the landing to the first contact, in seconds.
    pub time_to_touchdown_s: Option<f64>,
    /// True distance from the pad at the touchdown, in metres.
    pub touchdown_error_m: Option<f64>,
    /// The controller's last estimate of the distance from the pad, in metres.
    pub estimated_error_m: Option<f64>,
    /// Vertical speed at the touchdown, in m/s.
    pub touchdown_speed_m_s: Option<f64>,
    /// Horizontal speed at the touchdown, in m/s.
    pub touchdown_lateral_speed_m_s: Option<f64>,
    /// Largest tilt, in degrees: the true one, or that which the autopilot reports.
    pub max_tilt_deg: Option<f64>,
    /// Median error of the estimated horizontal position against truth from the begin of the landing to the touchdown, in metres;
    /// without a landing that of the whole recording.
    pub estimate_error_p50_m: Option<f64>,
    /// Its 95th percentile, in metres.
    pub estimate_error_p95_m: Option<f64>,
    /// Frames that the detector in use searched during the landing.
    pub frames: usize,
    /// Frames that the estimate used.
    pub frames_used: usize,
    /// Frames without the marker.
    pub frames_without_marker: usize,
    /// Frames whose marker was refused.
    pub frames_refused: usize,
    /// From exposure to setpoint, median, in milliseconds.
    pub latency_p50_ms: Option<f64>,
    /// Its 99th percentile, in milliseconds.
    pub latency_p99_ms: Option<f64>,
    /// Changes of the detector in use.
    pub detector_changes: Option<u64>,
    /// Messages that the recorder lost.
    pub messages_lost: u64,
    /// Mean true wind, in m/s.
    pub wind_mean_m_s: Option<f64>,
    /// Strongest true wind, in m/s.
    pub wind_max_m_s: Option<f64>,
    /// Lowest charge of the battery, from 0 to 1.
    pub battery_min: Option<f64>,
    /// Retries: climbs for another attempt.
    pub retries: Option<usize>,
    /// Whether the tape gives the same decisions again; `None` when that was not tried.
    pub tape_verified: Option<bool>,
    /// The tape's verdict as a sentence.
    pub tape: Option<String>,
    /// The gaps of the recording, as sentences.
    pub problems: Vec<String>,
    /// Warnings about the light, as sentences, where most frames had no marker.
    pub light: Vec<String>,
    /// The latency budget.
    pub latency: Vec<Stage>,
    /// The phases with their reasons.
    pub phases: Vec<phases::Phase>,
}

/// A flight in numbers.
pub fn of(flight: &Flight, frames: &Frames) -> Summary {
    let latency = budget(frames);
    let last = flight.last_status();
    let since_start_s = |stamp_ns: i64| {
        flight.statuses.iter().find_map(|status| status.started_ns).map(|_| flight.at_s(stamp_ns))
    };
    let disarmed_ns = flight.statuses.iter().find_map(|status| status.disarmed_ns);
    // A simulator publishes the last touchdown until the next.
    let touchdowns = flight.truth.iter().filter_map(|truth| truth.touchdown);
    let touchdown = touchdowns.into_iter().find(|it| it.stamp_ns >= flight.zero_ns);
    let of_landing = flight.vehicle.iter().filter(|it| it.stamp_ns >= flight.zero_ns);
    let standing = of_landing.skip_while(|it| it.landed != LandedState::InAir);
    let standing_ns =
        standing.skip_while(|it| it.landed != LandedState::OnGround).map(|it| it.stamp_ns).next();
    // Neither the climb before the landing nor the time on the ground counts.
    let in_landing_ns = flight.landing_ns().map(|it| {
        let down_ns = touchdown.map(|it| it.stamp_ns).or(standing_ns).unwrap_or(it.end);
        it.start..down_ns.min(it.end)
    });
    let is_in_landing = |time_s: f64| {
        in_landing_ns
            .as_ref()
            .is_none_or(|it| (flight.at_s(it.start)..=flight.at_s(it.end)).contains(&time_s))
    };
    let errors = track::estimate_errors(flight);
    let in_landing = errors.iter().filter(|error| is_in_landing(error.time_s));
    let errors_m: Vec<f64> = in_landing.map(|error| error.horizontal_m).collect();
    let winds: Vec<f64> = flight.wind.iter().map(|wind| norm(wind.velocity_ned_m_s)).collect();
    let phases = phases::of(flight);
    let to_setpoint = latency.iter().find(|stage| stage.name == TO_SETPOINT);
    let of_controller = last.and_then(|status| status.latency_ms);
    Summary {
        name: match &flight.landing {
            Some(Landing { number, of, .. }) => {
                format!("{}, landing {number} of {of}", flight.name)
            }
            None => flight.name.clone(),
        },
        begun_utc: flight.begun_utc(),
        recording_s: flight.origin.length_s(),
        recording_bytes: flight.origin.bytes,
        has_landing: flight.landing_ns().is_some(),
        program: flight.facts.get("program").cloned(),
        guidance: last.map(|status| status.guidance.clone()),
        phase: last.map(|status| status.phase.name().to_owned()),
        why: last.map(|status| status.why.clone()),
        landed: last.map(|status| status.phase == Phase::Landed),
        landed_for: last.and_then(|status| status.landed_for()).map(str::to_owned),
        unreadable_status: flight
            .unreadable
            .get(&topic::STATUS.key(&[]))
            .filter(|_| last.is_none())
            .map(|it| it.why.clone()),
        time_to_disarm_s: disarmed_ns.and_then(since_start_s),
        time_to_touchdown_s: touchdown
            .map(|it| it.stamp_ns)
            .or(standing_ns)
            .and_then(since_start_s),
        touchdown_error_m: touchdown.map(|it| it.error_m),
        estimated_error_m: flight.targets.iter().rev().find_map(|it| it.lateral_error_m),
        touchdown_speed_m_s: touchdown.map(|it| it.vertical_speed_m_s),
        touchdown_lateral_speed_m_s: touchdown.map(|it| it.lateral_speed_m_s),
        max_tilt_deg: max_tilt_deg(flight),
        estimate_error_p50_m: quantile(&errors_m, 0.5),
        estimate_error_p95_m: quantile(&errors_m, 0.95),
        frames: frames.of_landing(),
        frames_used: frames.count(&Fate::Used),
        frames_without_marker: frames.count(&Fate::NoMarker),
        frames_refused: frames.refused(),
        latency_p50_ms: to_setpoint.map(|it| it.p50_ms).or(of_controller.map(|[p50, _]| p50)),
        latency_p99_ms: to_setpoint.map(|it| it.p99_ms).or(of_controller.map(|[_, p99]| p99)),
        detector_changes: last.map(|status| {
            let before = flight.landing.as_ref().map_or(0, |it| it.detector_changes_before);
            status.detector_changes.saturating_sub(before)
        }),
        messages_lost: losses::recorder(flight)
            .iter()
            .map(|it| it.count)
            .fold(0, u64::saturating_add),
        wind_mean_m_s: node::stats::mean(&winds),
        wind_max_m_s: winds.iter().copied().reduce(f64::max),
        battery_min: battery_min(flight),
        retries: last
            .map(|_| phases.iter().filter(|phase| phase.name == Phase::Retry.name()).count()),
        tape_verified: flight.replayed.as_ref().map(|it| it.is_verified),
        tape: flight.replayed.as_ref().map(|it| it.text.clone()),
        problems: losses::recording(flight),
        light: match frames.count(&Fate::NoMarker) * 2 > frames.of_landing() {
            true => light::warnings(flight),
            false => Vec::new(),
        },
        latency,
        phases,
    }
}

fn norm(vector: [f64; 3]) -> f64 {
    vector.iter().map(|value| value * value).sum::<f64>().sqrt()
}

/// Tilt of a body whose attitude is this quaternion, in degrees.
pub fn tilt_deg(wxyz: [f64; 4]) -> f64 {
    let [_, x, y, _] = wxyz;
    (1.0 - 2.0 * (x * x + y * y)).clamp(-1.0, 1.0).acos().to_degrees()
}

fn max_tilt_deg(flight: &Flight) -> Option<f64> {
    let true_deg = flight.truth.iter().map(|truth| truth.max_tilt_rad.to_degrees());
    let estimated_deg = flight.vehicle.iter().map(|state| tilt_deg(state.ned_from_body_wxyz));
    true_deg.reduce(f64::max).or(estimated_deg.reduce(f64::max))
}

fn battery_min(flight: &Flight) -> Option<f64> {
    let states = flight.vehicle.iter().filter_map(|state| state.battery).map(f64::from);
    let packets = flight.packets.power.iter().filter_map(|power| power.remaining);
    states.chain(packets).reduce(f64::min)
}

impl Summary {
    /// Whether it landed on the pad, led there by the marker.
    pub fn is_on_the_pad(&self) -> bool {
        self.landed == Some(true) && self.landed_for.is_none() && self.beside_m().is_none()
    }

    /// How far from the pad's centre it touched down, if that is beside the pad.
    fn beside_m(&self) -> Option<f64> {
        self.touchdown_error_m.filter(|error_m| *error_m > Touchdown::MAX_ERROR_M)
    }

    /// Date, duration and size of the recording, in a line.
    pub fn origin(&self) -> String {
        let event = if self.has_landing { "landing" } else { "recording" };
        let begun = self.begun_utc.as_ref().map(|utc| {
            let time = utc.replace('T', " ").replace('Z', " UTC");
            format!("{event} began {time}")
        });
        let length = self.recording_s.map(|length_s| format!("{length_s:.0} s recorded"));
        let size = (self.recording_bytes > 0).then(|| size(self.recording_bytes));
        [begun, length, size].into_iter().flatten().collect::<Vec<_>>().join(", ")
    }

    /// How it ended, in a few words.
    pub fn outcome(&self) -> String {
        match (&self.phase, &self.why) {
            _ if self.landed == Some(true) => match &self.landed_for {
                Some(cause) => format!("landed, but not led to the marker: {cause}"),
                None => match self.beside_m() {
                    Some(error_m) => {
                        format!("landed, beside the pad: {error_m:.3} m from its centre")
                    }
                    None => "landed".to_owned(),
                },
            },
            (Some(phase), Some(why)) if why.starts_with(phase) => why.clone(),
            (Some(phase), Some(why)) => format!("{phase}: {why}"),
            _ => match &self.unreadable_status {
                Some(why) => format!("the status of the controller {why}"),
                None => "no status of a controller was recorded".to_owned(),
            },
        }
    }

    /// The line for a bug report.
    pub fn line(&self) -> String {
        let number = |value: Option<f64>, digits: usize, unit: &str, suffix: &str| {
            value.map(|value| format!("{value:.digits$} {unit}{suffix}"))
        };
        let latency = self.latency_p50_ms.zip(self.latency_p99_ms);
        let parts = [
            number(self.time_to_disarm_s, 1, "s", " to disarmed"),
            number(self.touchdown_error_m, 3, "m", " from the pad (truth)"),
            number(self.touchdown_speed_m_s, 2, "m/s", " down"),
            number(self.touchdown_lateral_speed_m_s, 2, "m/s", " aside"),
            number(self.max_tilt_deg, 1, "deg", " tilt at most"),
            number(self.wind_mean_m_s, 1, "m/s", " mean wind"),
            Some(format!(
                "{} of {} frames of the landing used, {} refused, {} without the marker",
                self.frames_used, self.frames, self.frames_refused, self.frames_without_marker
            )),
            latency.map(|(p50, p99)| format!("exposure to setpoint {p50:.0} ms, 99 % {p99:.0} ms")),
            self.detector_changes.map(|changes| {
                format!("{} of the detector", counted(changes, "change", "changes"))
            }),
            self.retries.map(|retries| counted(retries as u64, "retry", "retries")),
            Some(format!("recorder lost {}", counted(self.messages_lost, "message", "messages"))),
            self.tape.clone(),
            (!self.light.is_empty()).then(|| self.light.join("; ")),
            (!self.problems.is_empty()).then(|| format!("recording: {}", self.problems.join("; "))),
        ];
        let parts: Vec<String> = parts.into_iter().flatten().collect();
        let program = self.program.as_deref().unwrap_or("unknown program");
        let guidance = self.guidance.as_deref().unwrap_or("unknown guidance");
        let Self { name, .. } = self;
        format!("{name} [{program}, {guidance}] {}; {}", self.outcome(), parts.join("; "))
    }
}

/// A number of things: `1 change`, `2 changes`.
pub fn counted(number: u64, one: &str, several: &str) -> String {
    format!("{number} {}", if number == 1 { one } else { several })
}

#[cfg(test)]
mod tests {
    use messages::ControllerStatus;

    use super::*;

    /// The names of an object's values, in their order.
    fn names(value: &impl Serialize) -> Vec<String> {
        let text = serde_json::to_string(value).unwrap();
        let mut names = Vec::new();
        let mut depth = 0;
        for part in text.split_inclusive(['{', '}', '[', ']', ',']) {
            if let (1, Some((name, _))) = (depth, part.split_once("\":")) {
                names.push(name.trim_start_matches('"').to_owned());
            }
            match part.chars().last() {
                Some('{' | '[') => depth += 1,
                Some('}' | ']') => depth -= 1,
                _ => {}
            }
        }
        names
    }

    #[test]
    fn each_name_of_the_json_is_explained_in_the_documentation() {
        let text = include_str!("../../../docs/recording.md");
        let (_, section) = text.split_once("### The report as JSON\n").unwrap();
        let section = section.split("\n## ").next().unwrap();
        let (_, table) = section.split_once("|---|---|\n").unwrap();
        let summary = of(&Flight::default(), &Frames::default());
        let summary = names(&summary);
        let at: Vec<_> = summary.iter().map(|name| table.find(&format!("`{name}`"))).collect();
        assert!(summary.len() > 30 && at.iter().all(Option::is_some), "{summary:?} {at:?}");
        assert!(at.is_sorted(), "{summary:?} {at:?}");
        let stage = Stage {
            name: String::new(),
            is_part: false,
            frames: 0,
            p50_ms: 0.0,
            p90_ms: 0.0,
            p99_ms: 0.0,
            max_ms: 0.0,
        };
        let reason = phases::Reason { from_s: 0.0, why: String::new() };
        let phase =
            phases::Phase { name: String::new(), from_s: 0.0, to_s: 0.0, reasons: Vec::new() };
        for (row, parts) in [
            ("| `latency` ", names(&stage)),
            ("| `phases` ", [names(&phase), names(&reason)].concat()),
        ] {
            let (_, line) = table.split_once(row).unwrap();
            let line = line.lines().next().unwrap();
            assert!(parts.len() > 3, "{parts:?}");
            for part in parts {
                assert!(line.contains(&format!("`{part}`")), "`{part}` is not in {row}");
            }
        }
        // No name that the program does not write.
        for name in table.lines().filter_map(|line| line.split(" | ").next()) {
            for name in name.split('`').skip(1).step_by(2) {
                assert!(summary.iter().any(|it| it == name), "`{name}` is not written");
            }
        }
    }

    #[test]
    fn the_status_after_a_landing_is_not_its_outcome() {
        let status = |phase, started_ns, why: &str| ControllerStatus {
            phase,
            started_ns,
            why: why.to_owned(),
            ..ControllerStatus::default()
        };
        let descent = status(Phase::Descend, Some(1), "descending over the marker");
        let landed = status(Phase::Landed, Some(1), "on the ground, disarmed");
        let again = status(Phase::Idle, None, "waiting until the vehicle flies");
        let outcome = |statuses: &[&ControllerStatus]| {
            let mut flight = Flight::default();
            flight.statuses = statuses.iter().map(|it| (*it).clone()).collect();
            let found = of(&flight, &Frames::default());
            (found.landed, found.outcome())
        };
        let complete = outcome(&[&again, &descent, &landed, &again, &again]);
        assert_eq!(complete, (Some(true), "landed".to_owned()));
        let none = outcome(&[&again]);
        assert_eq!(none, (Some(false), "idle: waiting until the vehicle flies".to_owned()));
    }
}
