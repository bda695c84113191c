//! The result of a landing, collected from statuses, true poses, health reports and the recorder's status: time, touchdown error and
//! speed, latency, each process's load, and the recording.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use messages::{
    ControllerStatus, Health, LandedState, Phase, RecorderStatus, Touchdown, Truth, VehicleState,
};
use node::health::LATENCIES_KEPT;
use serde::Serialize;

use crate::children::Exit;
use crate::peers::is_in_the_air;

/// The thesis' one simulated flight (section 4.4.3).
const THESIS_TIME_S: f64 = 55.0;
const THESIS_ERROR_M: f64 = 0.0682;

/// The state of a landing under way, from the messages received so far.
#[derive(Default)]
pub(crate) struct LandingSummary {
    pub(crate) last_status: Option<ControllerStatus>,
    pub(crate) last_truth: Option<Truth>,
    /// The vehicle as its autopilot reports it, a real one as well.
    pub(crate) last_vehicle: Option<VehicleState>,
    /// When it last came down, by the truth.
    sank_ns: Option<i64>,
    /// First and last health by service and process.
    healths: BTreeMap<(String, u32), (Health, Health)>,
    /// The first start: a restarted controller reports its own.
    started_ns: Option<i64>,
    disarmed_ns: Option<i64>,
    interrupted: Option<String>,
    /// Detections used by earlier controllers.
    detections_before: u64,
    recorder: Option<RecorderStatus>,
    /// The last file that has taken bytes.
    recorded_file: String,
    /// How the recorder exited before it was to, or with an error.
    recorders_exit: Option<Exit>,
    /// The error with which it exited at the end, from its standard error.
    recorders_word: Option<String>,
    /// The recorder that is to record it.
    recorded_by: Option<OurRecorder>,
}

/// The result of a landing.
#[derive(Serialize)]
pub(crate) struct Outcome {
    /// On the pad, by the landing.
    pub(crate) landed: bool,
    /// On the ground, wherever and however it came down.
    down: bool,
    outcome: String,
    time_to_disarm_s: Option<f64>,
    time_to_touchdown_s: Option<f64>,
    touchdown_error_m: Option<f64>,
    touchdown_speed_m_s: Option<f64>,
    touchdown_lateral_speed_m_s: Option<f64>,
    max_tilt_deg: Option<f64>,
    detections: u64,
    frames: u64,
    latency_ms: Option<Percentiles>,
    guidance: String,
    processes: Vec<Process>,
    recording: Option<Recording>,
    /// Whether the landing led it down, too far from the pad's centre.
    #[serde(skip)]
    is_beside: bool,
    /// Whether it was to be recorded: others may have recorded it as well.
    #[serde(skip)]
    is_to_be_recorded: bool,
}

/// The recording of a landing.
#[derive(Serialize)]
struct Recording {
    /// The last file; none where it ended before one was begun.
    file: Option<String>,
    kept: u64,
    dropped: u64,
    /// Frames whose numbers are missing.
    never_came: u64,
    problem: Option<String>,
}

/// Median and 99th percentile.
#[derive(Serialize)]
struct Percentiles {
    p50: f64,
    p99: f64,
}

/// The cost of a process.
#[derive(Serialize)]
struct Process {
    service: String,
    pid: u32,
    /// Share of one core, in percent, from its first to its last report.
    cpu_percent: f64,
}

/// The recorder of a landing.
pub(crate) struct OurRecorder {
    /// Its name.
    pub(crate) name: String,
    /// The file that it is to write.
    pub(crate) file: PathBuf,
}

impl OurRecorder {
    /// Whether this recorder published the status, not one of the same name that another process started. A status without a file contains
    /// the reason.
    fn published(&self, status: &RecorderStatus) -> bool {
        let wanted = self.file.to_string_lossy();
        let is_of_its_file = match status.file.as_str() {
            "" => status.problem.is_some() || wanted.is_empty(),
            // The time in a name is that at which the recorder began it.
            file => wanted.contains("{time}") || self.may_write(Path::new(file)),
        };
        status.recorder == self.name && is_of_its_file
    }

    /// Whether it is the file, or one with a number after its name: a recorder takes those when the first is taken or fails.
    fn may_write(&self, other: &Path) -> bool {
        let absolute = |path: &Path| std::path::absolute(path).unwrap_or_else(|_| path.to_owned());
        let (wanted, other) = (absolute(&self.file), absolute(other));
        let stem = |path: &Path| path.file_stem().map(|it| it.to_string_lossy().into_owned());
        let (Some(wanted_stem), Some(other_stem)) = (stem(&wanted), stem(&other)) else {
            return false;
        };
        let number = other_stem.strip_prefix(&wanted_stem).map(|rest| rest.strip_prefix('-'));
        let has_number =
            number.flatten().is_some_and(|number| number.parse::<u64>().is_ok_and(|it| it > 1));
        wanted.parent() == other.parent()
            && wanted.extension() == other.extension()
            && (wanted_stem == other_stem || has_number)
    }
}

/// The problem of a recorder until it reports.
const NO_REPORT: &str = "the recorder has not reported";

/// A vehicle that sinks faster comes down, in m/s.
const MIN_SINK_M_S: f64 = 0.1;

/// Longest pause of a vehicle that comes down, in nanoseconds.
const MAX_PAUSE_NS: i64 = 3_000_000_000;

/// Longest time after a touchdown in which an autopilot may stop the motors, in nanoseconds: ArduPilot takes 7 s.
const MAX_DISARMING_NS: i64 = 12_000_000_000;

impl LandingSummary {
    /// Of a landing that this recorder is to record.
    pub(crate) fn recorded_by(recorder: OurRecorder) -> Self {
        let no_report =
            RecorderStatus { problem: Some(NO_REPORT.to_owned()), ..RecorderStatus::default() };
        Self { recorder: Some(no_report), recorded_by: Some(recorder), ..Self::default() }
    }

    /// Adds a status; true when the controller has finished.
    pub(crate) fn status(&mut self, status: ControllerStatus) -> bool {
        self.started_ns = self.started_ns.or(status.started_ns);
        self.disarmed_ns = self.disarmed_ns.or(status.disarmed_ns);
        if let Some(last) = &self.last_status
            && last.detections_used > status.detections_used
        {
            self.detections_before += last.detections_used;
        }
        let finished = status.finished;
        self.last_status = Some(status);
        finished
    }

    pub(crate) fn truth(&mut self, truth: Truth) {
        if !truth.on_ground && truth.velocity_ned_m_s[2] > MIN_SINK_M_S {
            self.sank_ns = Some(truth.stamp_ns);
        }
        self.last_truth = Some(truth);
    }

    pub(crate) fn health(&mut self, health: Health) {
        let key = (health.service.clone(), health.pid);
        let span = self.healths.entry(key).or_insert_with(|| (health.clone(), health.clone()));
        span.1 = health;
    }

    pub(crate) fn recorder(&mut self, recorder: RecorderStatus) {
        // Other recorders may run in parallel.
        if self.recorded_by.as_ref().is_some_and(|ours| !ours.published(&recorder)) {
            return;
        }
        if recorder.bytes > 0 {
            self.recorded_file.clone_from(&recorder.file);
        }
        let before = self.recorder.replace(recorder).map(|before| before.file);
        if let (Some(now), Some(before)) = (&mut self.recorder, before) {
            if now.file.is_empty() {
                // A recorder that fails continues without a file; its recorded messages are in the last one that has taken any. One
                // that has not, as on a full disk, is removed.
                now.file.clone_from(&self.recorded_file);
            } else if !before.is_empty() && now.file != before {
                // Another one has taken its place.
                self.recorders_exit = None;
            }
        }
    }

    /// Notes that the recorder exited before it was to: later messages are not in its file, which lacks its end unless the recorder ended
    /// in good order.
    pub(crate) fn recording_ended_early(&mut self, exit: &Exit) {
        self.recorder.get_or_insert_default();
        self.recorders_exit = Some(exit.clone());
    }

    /// Notes that the recorder exited with an error when it was to, and the last line of its standard error.
    pub(crate) fn recording_failed(&mut self, exit: &Exit, said: Option<String>) {
        self.recording_ended_early(exit);
        self.recorders_word = said;
    }

    /// Why the recording is incomplete. Statuses that the recorder published before it exited may be received later, and do not undo that.
    fn recording_problem(&self, recorder: &RecorderStatus) -> Option<String> {
        let Some(exit) = &self.recorders_exit else { return recorder.problem.clone() };
        let is_begun = !recorder.file.is_empty();
        let ended_early = match (exit.status, is_begun) {
            (Some(0), true) => {
                "the recorder ended before the landing; its file is complete".to_owned()
            }
            (Some(0), false) => "the recorder ended before the landing".to_owned(),
            (_, true) => {
                format!("the recorder exited: {exit}; `alight record --repair` ends its file")
            }
            (_, false) => format!("the recorder exited: {exit}"),
        };
        let known = recorder.problem.clone().filter(|problem| problem != NO_REPORT);
        Some(known.or(self.recorders_word.clone()).unwrap_or(ended_early))
    }

    /// Notes why the landing was not watched to its end.
    pub(crate) fn interrupted(&mut self, why: &str) {
        self.interrupted = Some(why.to_owned());
    }

    /// Notes that the landing took too long; `exit` is that of the controller if none has taken its place.
    pub(crate) fn timed_out(&mut self, exit: Option<&str>) {
        self.interrupted(&match exit {
            Some(exit) => format!(
                "the controller exited ({exit}), and none resumed the landing before the timeout (--timeout-s)"
            ),
            None => "timeout before the end of the landing (--timeout-s)".to_owned(),
        });
    }

    /// The last healths of the processes of a service, the newest first.
    pub(crate) fn healths_of(&self, service: &str, instance: &str) -> Vec<&Health> {
        let last = self.healths.values().map(|(_, last)| last);
        let is_its = |it: &&Health| it.service == service && it.instance == instance;
        let mut healths: Vec<&Health> = last.filter(is_its).collect();
        healths.sort_by_key(|it| std::cmp::Reverse(it.stamp_ns));
        healths
    }

    /// Whether a landing that was interrupted or aborted may have left its vehicle in the air.
    pub(crate) fn may_be_in_the_air(&self) -> bool {
        let is_flying = self.last_vehicle.as_ref().is_some_and(is_reported_in_the_air);
        let is_down = !is_flying && self.last_truth.as_ref().is_some_and(|truth| truth.on_ground);
        let has_flown = self.started_ns.is_some() || self.has_taken_off();
        let is_interrupted = self.interrupted.is_some() && has_flown && self.disarmed_ns.is_none();
        (is_interrupted || self.last_status.as_ref().is_some_and(is_in_the_air)) && !is_down
    }

    /// True while no landing has begun.
    pub(crate) fn never_flew(&self) -> bool {
        self.started_ns.is_none()
    }

    /// Whether the vehicle takes off, or has, for a landing that has not begun: its controller still takes it up, or holds it there. The
    /// ground under a real vehicle is unknown to the simulation; its autopilot reports the motors at once, and the take-off later.
    pub(crate) fn has_taken_off(&self) -> bool {
        let is_up = match &self.last_vehicle {
            Some(vehicle) => vehicle.armed,
            None => self.last_truth.as_ref().is_some_and(|truth| !truth.on_ground),
        };
        self.takes_off() && is_up
    }

    fn takes_off(&self) -> bool {
        self.last_status.as_ref().is_some_and(|it| it.phase == Phase::Takeoff)
    }

    /// Frames a second, as the detectors count them.
    pub(crate) fn frame_rate_hz(&self) -> Option<f64> {
        let camera = self
            .healths
            .iter()
            .find(|((service, _), _)| service == "simulator" || service == "camera-pub")?;
        let rates = &camera.1.1.rates;
        rates.iter().find(|rate| rate.name == "frames").map(|rate| rate.hz)
    }

    /// The result.
    pub(crate) fn outcome(&self) -> Outcome {
        let status = self.last_status.as_ref();
        let touchdown = self.last_truth.as_ref().and_then(|t| t.touchdown);
        let since_start =
            |ns: i64| self.started_ns.map(|start| ns.saturating_sub(start) as f64 / 1e9);
        let down =
            self.last_truth.as_ref().is_some_and(|truth| truth.on_ground) && touchdown.is_some();
        let elsewhere = touchdown.and_then(|touchdown| self.elsewhere(&touchdown));
        let landed = self.disarmed_ns.is_some() && touchdown.is_some() && elsewhere.is_none();
        let outcome = match (&self.interrupted, status) {
            (Some(why), Some(status)) => format!("{why}; it was in {}", status.sentence()),
            (Some(why), None) => format!("{why}; no controller was running"),
            (None, _) if landed => "landed".to_owned(),
            (None, Some(status)) => match elsewhere.filter(|_| down) {
                Some(elsewhere) => elsewhere,
                None if status.phase == Phase::Landed => {
                    format!("{}, but the simulation saw no touchdown", status.sentence())
                }
                None => status.sentence(),
            },
            (None, None) => "no controller was running".to_owned(),
        };
        Outcome {
            landed,
            down,
            outcome,
            time_to_disarm_s: self.disarmed_ns.and_then(since_start),
            time_to_touchdown_s: touchdown.and_then(|t| since_start(t.stamp_ns)),
            touchdown_error_m: touchdown.map(|t| t.error_m),
            touchdown_speed_m_s: touchdown.map(|t| t.vertical_speed_m_s),
            touchdown_lateral_speed_m_s: touchdown.map(|t| t.lateral_speed_m_s),
            max_tilt_deg: self.last_truth.as_ref().map(|t| t.max_tilt_rad.to_degrees()),
            detections: self.detections_before + status.map_or(0, |s| s.detections_used),
            frames: self.last_truth.as_ref().map_or(0, |t| t.frames),
            latency_ms: status
                .and_then(|s| s.latency_ms)
                .map(|[p50, p99]| Percentiles { p50, p99 }),
            guidance: status.map_or_else(String::new, |s| s.guidance.clone()),
            processes: self.processes(),
            recording: self.recorder.as_ref().map(|recorder| Recording {
                file: Some(&recorder.file).filter(|file| !file.is_empty()).cloned(),
                kept: recorder.total_kept(),
                dropped: recorder.lost(),
                never_came: recorder.never_came(),
                problem: self.recording_problem(recorder),
            }),
            is_beside: down
                && status.is_some_and(|it| it.phase == Phase::Landed && it.landed_for().is_none())
                && touchdown.is_some_and(|it| it.error_m > Touchdown::MAX_ERROR_M),
            is_to_be_recorded: self.recorded_by.is_some(),
        }
    }

    /// How it came down, and how far from the pad, if the landing did not lead it onto the pad.
    fn elsewhere(&self, touchdown: &Touchdown) -> Option<String> {
        let status = self.last_status.as_ref()?;
        let error_m = touchdown.error_m;
        let limit =
            format!("more than the {} m within which a landing counts", Touchdown::MAX_ERROR_M);
        let (why, beyond) = match (status.phase, status.landed_for()) {
            (Phase::Landed, None) if error_m <= Touchdown::MAX_ERROR_M => return None,
            (Phase::Landed, None) => (status.why.clone(), format!(", {limit}")),
            (Phase::Landed, Some(cause)) => (cause.to_owned(), String::new()),
            _ => (status.sentence(), String::new()),
        };
        let motors = match self.disarmed_ns {
            None => ", and its motors may still run",
            Some(_) if why.contains("disarmed") => "",
            Some(_) => ", and its motors are off",
        };
        Some(format!("{why}; it touched down {error_m:.3} m from the pad's centre{beyond}{motors}"))
    }

    /// Whether it comes down although the landing has ended, as after an abort that lands it, or has just done so with its motors on.
    pub(crate) fn comes_down(&self) -> bool {
        let is_landed = self.last_status.as_ref().is_some_and(|it| it.phase == Phase::Landed);
        self.last_truth.as_ref().filter(|_| !is_landed).is_some_and(|truth| {
            let standing_ns = truth.touchdown.map(|it| truth.stamp_ns.saturating_sub(it.stamp_ns));
            match standing_ns.filter(|_| truth.on_ground) {
                Some(standing_ns) => self.disarmed_ns.is_none() && standing_ns < MAX_DISARMING_NS,
                // A pilot pauses, and LAND brakes first.
                None => self.sank_ns.is_some_and(|it| {
                    (0..MAX_PAUSE_NS).contains(&truth.stamp_ns.saturating_sub(it))
                }),
            }
        })
    }

    fn processes(&self) -> Vec<Process> {
        let cost = |((service, pid), (first, last)): (&(String, u32), &(Health, Health))| {
            let wall_s = last.uptime_s - first.uptime_s;
            let cpu_percent =
                if wall_s > 0.0 { 100.0 * (last.cpu_s - first.cpu_s) / wall_s } else { 0.0 };
            Process { service: service.clone(), pid: *pid, cpu_percent }
        };
        self.healths.iter().map(cost).collect()
    }
}

/// Whether the autopilot reports that the vehicle has left the ground.
fn is_reported_in_the_air(vehicle: &VehicleState) -> bool {
    let is_off_ground = matches!(
        vehicle.landed,
        LandedState::TakingOff | LandedState::InAir | LandedState::Landing
    );
    vehicle.armed && is_off_ground
}

impl Outcome {
    /// Whether everything requested is done: it landed on the pad, and it was recorded if that was requested. Frames that never reached the
    /// recorder do not count as lost.
    pub(crate) fn is_done(&self) -> bool {
        let is_complete =
            |recording: &Recording| recording.problem.is_none() && recording.dropped == 0;
        let is_recorded = self.recording.as_ref().is_none_or(is_complete);
        self.landed && (is_recorded || !self.is_to_be_recorded)
    }

    /// The result and that of the thesis, as a table.
    pub(crate) fn table(&self) -> String {
        let mut text = String::new();
        let verdict = match self.landed {
            true => "Landed.".to_owned(),
            false if self.is_beside => format!("Down beside the pad: {}.", self.outcome),
            false if self.down => format!("Down, but not led to the pad: {}.", self.outcome),
            false => format!("Not landed: {}.", self.outcome),
        };
        // Writing to a string cannot fail.
        let mut line = |args: std::fmt::Arguments<'_>| {
            let _ = writeln!(text, "{args}");
        };
        line(format_args!("{verdict}"));
        line(format_args!("{:34} {:>14} {:>14}", "", "this flight", "thesis"));
        let mut row = |name: &str, value: Option<f64>, unit: &str, digits: usize, thesis: &str| {
            let value = value.map_or("-".to_owned(), |v| format!("{v:.digits$} {unit}"));
            line(format_args!("{name:34} {value:>14} {thesis:>14}"));
        };
        row("time to disarm", self.time_to_disarm_s, "s", 1, &format!("{THESIS_TIME_S:.0} s"));
        row("time to touchdown", self.time_to_touchdown_s, "s", 1, "-");
        row("touchdown error", self.touchdown_error_m, "m", 3, &format!("{THESIS_ERROR_M:.3} m"));
        row("vertical speed at touchdown", self.touchdown_speed_m_s, "m/s", 2, "-");
        row("lateral speed at touchdown", self.touchdown_lateral_speed_m_s, "m/s", 2, "-");
        row("largest tilt", self.max_tilt_deg, "deg", 1, "-");
        let latency = self.latency_ms.as_ref();
        row("exposure to setpoint, median", latency.map(|l| l.p50), "ms", 1, "-");
        row("exposure to setpoint, 99 %", latency.map(|l| l.p99), "ms", 1, "-");
        line(format_args!(
            "{:34} {:>14}",
            "detections used of all frames",
            format!("{} of {}", self.detections, self.frames)
        ));
        for process in &self.processes {
            let name = format!("processor, {}", process.service);
            line(format_args!(
                "{name:34} {:>14}",
                format!("{:.0} % of a core", process.cpu_percent)
            ));
        }
        if let Some(Recording { file, kept, dropped, never_came, problem }) = &self.recording {
            let unseen = match never_came {
                0 => String::new(),
                count => format!("; {count} frames never came"),
            };
            let problem = problem.as_ref().map_or_else(String::new, |it| format!("; {it}"));
            let file = file.as_deref().unwrap_or("no file");
            line(format_args!("recorded {kept} messages, lost {dropped}{unseen}: {file}{problem}"));
        }
        line(format_args!("{}", counted()));
        text.truncate(text.trim_end().len());
        text
    }
}

/// The intervals that the latency and the frames are counted over: they differ from those in the report of a recording.
fn counted() -> String {
    format!(
        "Frames and detections count from the camera's first frame, the take-off's too; the latency is of the last {LATENCIES_KEPT} setpoints. \
         `alight report` of a recording has both of the landing alone."
    )
}

#[cfg(test)]
pub(crate) mod tests {
    use messages::RecorderCount;

    use super::*;

    fn status(phase: Phase) -> ControllerStatus {
        ControllerStatus {
            phase,
            why: "because".into(),
            guidance: "metric".into(),
            ..ControllerStatus::default()
        }
    }

    /// A vehicle as its autopilot reports it.
    pub(crate) fn reported(armed: bool, landed: LandedState) -> VehicleState {
        VehicleState {
            stamp_ns: 0,
            ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
            position_ned_m: [0.0; 3],
            velocity_ned_m_s: [0.0; 3],
            mode: "GUIDED".to_owned(),
            armed,
            landed,
            battery: None,
        }
    }

    fn truth(touchdown: Option<Touchdown>) -> Truth {
        Truth {
            on_ground: touchdown.is_some(),
            touchdown,
            max_tilt_rad: 0.1,
            frames: 300,
            ..Truth::sample()
        }
    }

    #[test]
    fn times_count_from_the_first_start_of_any_controller() {
        let mut landing = LandingSummary::default();
        let second = 1_000_000_000;
        landing.status(ControllerStatus {
            started_ns: Some(second),
            detections_used: 40,
            ..status(Phase::Descend)
        });
        // A restarted controller.
        landing.status(ControllerStatus {
            started_ns: Some(9 * second),
            detections_used: 2,
            ..status(Phase::Descend)
        });
        let touchdown = Touchdown {
            stamp_ns: 14 * second,
            error_m: 0.02,
            vertical_speed_m_s: 0.5,
            lateral_speed_m_s: 0.0,
        };
        landing.truth(truth(Some(touchdown)));
        let done = ControllerStatus {
            started_ns: Some(9 * second),
            disarmed_ns: Some(16 * second),
            finished: true,
            detections_used: 60,
            ..status(Phase::Landed)
        };
        assert!(landing.status(done));
        let outcome = landing.outcome();
        assert!(outcome.landed && outcome.outcome == "landed");
        assert_eq!(
            (outcome.time_to_disarm_s, outcome.time_to_touchdown_s),
            (Some(15.0), Some(13.0))
        );
        assert_eq!(outcome.detections, 100);
        let table = outcome.table();
        assert!(table.contains("0.020 m        0.068 m"), "{table}");
        for part in ["of the last 512 setpoints", "the take-off's too", "of the landing alone"] {
            assert!(table.contains(part), "{part} is not in: {table}");
        }
    }

    /// The result of a landing that ended like this, and the distance from the pad at the touchdown.
    fn ended(phase: Phase, why: &str, error_m: f64) -> Outcome {
        let mut landing = LandingSummary::default();
        landing.status(ControllerStatus {
            why: why.into(),
            started_ns: Some(0),
            disarmed_ns: Some(9),
            ..status(phase)
        });
        let touchdown =
            Touchdown { stamp_ns: 5, error_m, vertical_speed_m_s: 0.5, lateral_speed_m_s: 0.0 };
        landing.truth(truth(Some(touchdown)));
        landing.outcome()
    }

    #[test]
    fn a_vehicle_that_came_down_otherwise_has_not_landed_on_the_pad() {
        let landed = ended(Phase::Landed, "on the ground, disarmed", 0.02);
        assert_eq!((landed.landed, landed.down, landed.is_done()), (true, true, true));
        for (phase, why, error_m, expected) in [
            (
                Phase::Landed,
                "on the ground, disarmed: the operator's command to land here",
                0.44,
                "the operator's command to land here; it touched down 0.440 m from the pad's centre, and its motors are off",
            ),
            (
                Phase::Landed,
                "on the ground, disarmed",
                0.44,
                "on the ground, disarmed; it touched down 0.440 m from the pad's centre, more than the 0.3 m within which a landing counts",
            ),
            (
                Phase::Aborted,
                "aborted: disarmed before the touchdown",
                0.02,
                "aborted: disarmed before the touchdown; it touched down 0.020 m from the pad's centre",
            ),
            (
                Phase::PilotInCommand,
                "the pilot flies",
                0.02,
                "pilot-in-command: the pilot flies; it touched down 0.020 m from the pad's centre, and its motors are off",
            ),
        ] {
            let outcome = ended(phase, why, error_m);
            assert_eq!(outcome.outcome, expected);
            assert_eq!((outcome.landed, outcome.down, outcome.is_done()), (false, true, false));
            let how = if expected.contains("counts") {
                "beside the pad"
            } else {
                "but not led to the pad"
            };
            let verdict = outcome.table().lines().next().unwrap_or_default().to_owned();
            assert!(verdict.starts_with("Down"), "{verdict}");
            assert!(verdict.ends_with(&format!("{how}: {expected}.")), "{verdict}");
        }
    }

    #[test]
    fn a_vehicle_that_an_abort_lands_is_watched_until_its_motors_stop() {
        let mut landing = LandingSummary::default();
        landing.status(status(Phase::Aborted));
        let sinks = |sink_m_s, stamp_ns| Truth {
            velocity_ned_m_s: [0.0, 0.0, sink_m_s],
            stamp_ns,
            ..truth(None)
        };
        let mut seen = |truth| {
            landing.truth(truth);
            landing.comes_down()
        };
        assert!(!seen(sinks(0.0, 0)), "it hovers");
        assert!(seen(sinks(0.5, 0)) && seen(sinks(0.0, 2_000_000_000)), "it pauses");
        assert!(!seen(sinks(0.0, 4_000_000_000)), "it hovers again");
        let touchdown = Touchdown {
            stamp_ns: 0,
            error_m: 0.02,
            vertical_speed_m_s: 0.5,
            lateral_speed_m_s: 0.0,
        };
        let stands = |stamp_ns| Truth { stamp_ns, ..truth(Some(touchdown)) };
        assert!(seen(stands(7_000_000_000)) && !seen(stands(13_000_000_000)));
        landing.status(ControllerStatus { disarmed_ns: Some(1), ..status(Phase::Aborted) });
        landing.truth(stands(7_000_000_000));
        assert!(!landing.comes_down());
    }

    #[test]
    fn a_landing_whose_recording_failed_or_lost_messages_is_not_done() {
        let landed = |mut landing: LandingSummary| {
            landing.status(ControllerStatus { disarmed_ns: Some(2), ..status(Phase::Landed) });
            let touchdown = Touchdown {
                stamp_ns: 1,
                error_m: 0.02,
                vertical_speed_m_s: 0.5,
                lateral_speed_m_s: 0.0,
            };
            landing.truth(truth(Some(touchdown)));
            landing
        };
        let is_done = |landing: &LandingSummary| {
            let outcome = landing.outcome();
            assert_eq!(outcome.landed, landing.disarmed_ns.is_some(), "whatever was recorded");
            outcome.is_done()
        };
        assert!(!is_done(&LandingSummary::default()));
        assert!(is_done(&landed(LandingSummary::default())));
        let reported = |recorder: &str, file: &str, problem: Option<&str>| RecorderStatus {
            recorder: recorder.into(),
            file: file.into(),
            problem: problem.map(str::to_owned),
            ..RecorderStatus::default()
        };
        let ours = || OurRecorder { name: "main".into(), file: "flight.mcap".into() };
        let mut landing = landed(LandingSummary::recorded_by(ours()));
        assert!(!is_done(&landing), "no recorder has reported");
        landing.recorder(reported("main", "", Some("No space left")));
        assert!(!is_done(&landing));
        landing.recorder(reported("main", "flight-2.mcap", None));
        landing.recorder(reported("another", "", Some("No space left")));
        assert!(is_done(&landing), "another file took its place");
        let exit = |words: &str, status| Exit { words: words.into(), status };
        landing.recording_ended_early(&exit("exit status: 1", Some(1)));
        assert!(!is_done(&landing));
        assert!(landing.outcome().table().contains("--repair"));
        landing.recorder(reported("main", "flight-2.mcap", None));
        assert!(!is_done(&landing), "an earlier status is received late");
        assert!(landing.outcome().table().contains("--repair"));
        landing.recorder(reported("main", "", None));
        landing.recorder(reported("main", "elsewhere/flight.mcap", None));
        assert!(!is_done(&landing), "one of the same name says nothing of it");
        for (wanted, file) in [("flight-{time}.mcap", "flight-20261122T105011Z.mcap"), ("", "")] {
            let ours = OurRecorder { name: "main".into(), file: wanted.into() };
            let mut landing = landed(LandingSummary::recorded_by(ours));
            landing.recorder(reported("main", file, None));
            assert!(is_done(&landing), "{wanted}");
        }
        let mut landing = landed(LandingSummary::recorded_by(ours()));
        landing.recorder(reported("main", "flight.mcap", None));
        landing.recording_ended_early(&exit("exit status: 0", Some(0)));
        assert!(!is_done(&landing), "the landing is not in it");
        let table = landing.outcome().table();
        assert!(table.contains("its file is complete") && !table.contains("--repair"), "{table}");
        landing.recorder(reported("main", "flight-2.mcap", None));
        assert!(is_done(&landing), "another recorder continues");
        let losing = |key: &str| RecorderStatus {
            dropped: vec![RecorderCount { key: key.into(), count: 3 }],
            ..reported("main", "flight-2.mcap", None)
        };
        landing.recorder(losing("camera/down/frame (never came)"));
        assert!(is_done(&landing), "the recorder lost nothing");
        landing.recorder(losing("wind"));
        assert!(!is_done(&landing), "the recorder lost something");
        let mut landing = landed(LandingSummary::recorded_by(ours()));
        landing.recorder(reported("main", "flight.mcap", None));
        let said = "running recorder: 3 messages came and are in no file".to_owned();
        landing.recording_failed(&exit("exit status: 1", Some(1)), Some(said));
        let table = landing.outcome().table();
        assert!(!is_done(&landing) && table.contains("in no file"), "{table}");
        assert!(!table.contains("--repair"), "{table}");
        let mut beside = landed(LandingSummary::default());
        beside.recorder(losing("wind"));
        assert!(is_done(&beside), "it is another's recording");
    }

    #[test]
    fn a_file_that_a_full_disk_does_not_take_is_not_the_recording() {
        let ours = OurRecorder { name: "main".into(), file: "f.mcap".into() };
        let mut landing = LandingSummary::recorded_by(ours);
        let reported = |file: &str, bytes: u64| RecorderStatus {
            recorder: "main".into(),
            file: file.into(),
            bytes,
            problem: file.is_empty().then(|| "No space left".to_owned()),
            ..RecorderStatus::default()
        };
        for status in [reported("f.mcap", 900), reported("", 0), reported("f-2.mcap", 0)] {
            landing.recorder(status);
        }
        landing.recorder(reported("", 0));
        let table = landing.outcome().table();
        assert!(table.contains(": f.mcap; No space left"), "{table}");
    }

    #[test]
    fn a_recorder_writes_its_file_or_one_with_a_number() {
        let ours = OurRecorder { name: "main".into(), file: "a/flight.mcap".into() };
        for file in ["a/flight.mcap", "./a/flight-2.mcap", "a/flight-11.mcap"] {
            assert!(ours.may_write(Path::new(file)), "{file}");
        }
        for file in ["flight.mcap", "a/flights.mcap", "a/flight-x.mcap", "a/flight-2", "a/b.mcap"] {
            assert!(!ours.may_write(Path::new(file)), "{file}");
        }
    }

    #[test]
    fn an_interrupted_landing_names_its_phase() {
        let mut landing = LandingSummary::default();
        landing.status(status(Phase::Search));
        landing.interrupted("interrupted");
        let outcome = landing.outcome();
        assert!(!outcome.landed);
        assert_eq!(outcome.outcome, "interrupted; it was in search: because");
        landing.timed_out(None);
        assert!(landing.outcome().outcome.starts_with("timeout before the end of the landing ("));
        landing.timed_out(Some("signal: 9 (SIGKILL)"));
        let outcome = landing.outcome().outcome;
        assert!(outcome.starts_with("the controller exited (signal: 9 (SIGKILL))"), "{outcome}");
    }

    #[test]
    fn a_vehicle_that_has_taken_off_may_be_left_in_the_air_before_the_landing() {
        for (last_status, on_ground, has_taken_off) in [
            (Some(status(Phase::Takeoff)), false, true),
            (Some(status(Phase::Takeoff)), true, false),
            (Some(status(Phase::Idle)), false, false),
            (None, false, false),
        ] {
            let last_truth = Some(Truth { on_ground, ..truth(None) });
            let mut landing =
                LandingSummary { last_status, last_truth, ..LandingSummary::default() };
            assert_eq!(landing.has_taken_off(), has_taken_off);
            assert!(!landing.may_be_in_the_air(), "it was not interrupted");
            landing.interrupted("interrupted");
            assert_eq!(landing.may_be_in_the_air(), has_taken_off);
            // The autopilot's report of a real vehicle decides, whatever the simulation has as its height.
            for (armed, landed, is_left) in [
                (false, LandedState::OnGround, false),
                (true, LandedState::OnGround, has_taken_off),
                (true, LandedState::InAir, landing.takes_off()),
            ] {
                let vehicle = reported(armed, landed);
                landing.last_vehicle = Some(vehicle);
                assert_eq!(landing.has_taken_off(), armed && landing.takes_off());
                assert_eq!(landing.may_be_in_the_air(), is_left, "{armed} {landed:?}");
            }
        }
    }

    #[test]
    fn only_a_landing_that_was_interrupted_or_aborted_may_leave_its_vehicle_in_the_air() {
        let mut landing = LandingSummary { started_ns: Some(1), ..LandingSummary::default() };
        assert!(!landing.may_be_in_the_air(), "it was not interrupted");
        let aborted = ControllerStatus {
            started_ns: Some(1),
            waits_for_operator: true,
            finished: true,
            ..status(Phase::Aborted)
        };
        landing.last_status = Some(aborted.clone());
        assert!(landing.may_be_in_the_air(), "it was aborted");
        landing.last_status = Some(ControllerStatus { disarmed_ns: Some(2), ..aborted });
        assert!(!landing.may_be_in_the_air(), "its motors are off");
        landing.last_status = None;
        landing.interrupted("interrupted");
        assert!(landing.may_be_in_the_air());
        landing.last_truth = Some(Truth { on_ground: true, ..truth(None) });
        assert!(!landing.may_be_in_the_air(), "it is on the ground");
        let landing = LandingSummary { started_ns: None, last_truth: None, ..landing };
        assert!(!landing.may_be_in_the_air(), "no landing had begun");
    }
}
