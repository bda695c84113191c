//! Makes the list of checks before a flight: a verdict, a finding and a remedy for controller, autopilot, camera,
//! calibration, clock, detector, marker, mount, link, battery, recording, keys and warnings.

use messages::{CameraInfo, ControllerStatus, Detections, RecorderStatus, VehicleState};
use serde::Serialize;

use crate::found::in_words;

/// Numbers older than this are no longer current, in milliseconds.
const MAX_AGE_MS: f64 = 1000.0;
/// Minimum rate of frames and of detections, in Hz.
const MIN_RATE_HZ: f64 = 5.0;
/// Maximum median time from a frame's exposure to its detections, in milliseconds.
const MAX_LATENCY_MS: f64 = 250.0;
/// Maximum time of a query and its reply, in milliseconds.
const MAX_ROUND_TRIP_MS: f64 = 200.0;
/// Minimum battery, from 0 to 1.
const MIN_BATTERY: f32 = 0.3;

/// The verdict of a check.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// The check passes.
    Good,
    /// The result is not known yet, or not needed.
    Open,
    /// The check fails.
    Bad,
}

/// A line of the list.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Check {
    /// The subject of the check.
    pub name: &'static str,
    /// The verdict.
    pub verdict: Verdict,
    /// The finding.
    pub text: String,
    /// The remedy.
    pub todo: &'static str,
}

/// The data from which the list is made.
#[derive(Clone, Debug, Default)]
pub struct Facts<'a> {
    /// The controller's status; `None` if it is not current.
    pub status: Option<&'a ControllerStatus>,
    /// Its age in milliseconds, also if it is not current.
    pub status_age_ms: Option<f64>,
    /// The vehicle's state.
    pub vehicle: Option<&'a VehicleState>,
    /// Its age in milliseconds.
    pub vehicle_age_ms: Option<f64>,
    /// The detections of the detector in use in its newest frame; `None` if they are not current.
    pub found: Option<&'a Detections>,
    /// Time since the latest detections of the detector in use arrived, in milliseconds, also if they are not current.
    pub found_age_ms: Option<f64>,
    /// Frames a second, as counted by the camera's service.
    pub frames_hz: Option<f64>,
    /// The calibration of the camera in use.
    pub calibration: Option<&'a CameraInfo>,
    /// The controller's clock.
    pub controller_clock: Option<&'a str>,
    /// The time of a query to the controller and its reply, in milliseconds; the inner `None` without a reply.
    pub round_trip_ms: Option<Option<f64>>,
    /// A recorder that is present.
    pub recorder: Option<&'a RecorderStatus>,
    /// Whether a process listens beyond its machine without keys; `None` while no process is present.
    pub is_insecure: Option<bool>,
    /// Services that have become silent.
    pub silent: Vec<String>,
}

/// The result of one check.
struct Finding {
    verdict: Verdict,
    text: String,
    todo: &'static str,
}

fn finding(verdict: Verdict, text: impl Into<String>, todo: &'static str) -> Finding {
    Finding { verdict, text: text.into(), todo }
}

/// A result that depends on messages of a process that sends none. The check of that process has the remedy.
fn unknown_without(process: &str) -> Finding {
    finding(Verdict::Open, format!("not known without the {process}"), "")
}

/// Whether data of this age count as current.
pub(crate) fn is_current(age_ms: Option<f64>) -> bool {
    age_ms.is_some_and(|age_ms| age_ms < MAX_AGE_MS)
}

/// The list.
pub fn checks(facts: &Facts<'_>) -> Vec<Check> {
    let lines: [(&'static str, Finding); 13] = [
        ("controller", controller(facts)),
        ("autopilot", autopilot(facts)),
        ("camera", camera(facts)),
        ("calibration", calibration(facts)),
        ("clock", clock(facts)),
        ("detector", detector(facts)),
        ("marker", marker(facts)),
        ("mount", mount(facts)),
        ("link", link(facts)),
        ("battery", battery(facts)),
        ("recording", recording(facts)),
        ("keys", keys(facts)),
        ("warnings", warnings(facts)),
    ];
    let check = |(name, it): (&'static str, Finding)| Check {
        name,
        verdict: it.verdict,
        text: it.text,
        todo: if it.verdict == Verdict::Good { "" } else { it.todo },
    };
    lines.into_iter().map(check).collect()
}

fn controller(facts: &Facts<'_>) -> Finding {
    let todo = "Start `alight controller`, or read its log; if it runs on another machine, `alight doctor` measures the link.";
    match facts.status_age_ms {
        None => finding(Verdict::Bad, "none is present", todo),
        Some(age_ms) if age_ms >= MAX_AGE_MS => {
            finding(Verdict::Bad, format!("silent for {:.0} s", age_ms / 1000.0), todo)
        }
        Some(_) => finding(Verdict::Good, "present", todo),
    }
}

fn autopilot(facts: &Facts<'_>) -> Finding {
    let todo = "Check the autopilot's power, cable and `autopilot.address`; `alight doctor` tries the link.";
    let Some(status) = facts.status else { return unknown_without("controller") };
    let stated = status.autopilot.as_str();
    if is_current(facts.vehicle_age_ms) {
        finding(Verdict::Good, stated, todo)
    } else {
        let text = if stated.is_empty() { "no attitude and position arrive" } else { stated };
        finding(Verdict::Bad, text, todo)
    }
}

fn camera(facts: &Facts<'_>) -> Finding {
    let todo = "Start `alight camera-pub`; `alight doctor` tries the camera.";
    match facts.frames_hz {
        Some(hz) if hz >= MIN_RATE_HZ => {
            finding(Verdict::Good, format!("{hz:.1} frames a second"), todo)
        }
        Some(hz) => finding(Verdict::Bad, format!("only {hz:.1} frames a second"), todo),
        None if is_current(facts.found_age_ms) => {
            finding(Verdict::Good, "frames reach the detector", todo)
        }
        None => finding(Verdict::Bad, "no frames", todo),
    }
}

fn calibration(facts: &Facts<'_>) -> Finding {
    let todo = "Calibrate the camera and name the file in its configuration (docs/camera.md).";
    let Some(info) = facts.calibration else {
        return match (facts.status, facts.found) {
            (None, _) => unknown_without("controller"),
            // The camera in use is the one whose frames the detector searches.
            (_, None) => unknown_without("detector"),
            _ => finding(Verdict::Bad, "no calibration of the camera in use has arrived", todo),
        };
    };
    match (info.focal_px, info.problem()) {
        (_, Some(error)) => finding(Verdict::Bad, format!("impossible: {error}"), todo),
        (None, None) => finding(Verdict::Bad, "the camera is not calibrated", todo),
        (Some([focal_px, _]), None) => {
            finding(Verdict::Good, format!("{}: focal length {focal_px:.0} px", info.camera), todo)
        }
    }
}

fn clock(facts: &Facts<'_>) -> Finding {
    let todo = "Run camera and controller on one machine: frames of another clock are not used.";
    if facts.status.is_none() {
        return unknown_without("controller");
    }
    let Some(found) = facts.found else { return unknown_without("detector") };
    match (found.header.clock.as_str(), facts.controller_clock) {
        (camera, Some(controller)) if camera == controller => {
            finding(Verdict::Good, "camera and controller use the same", todo)
        }
        (camera, Some(controller)) => finding(
            Verdict::Bad,
            format!("the camera has {camera}, the controller {controller}"),
            todo,
        ),
        (_, None) => finding(Verdict::Open, "the controller's is not known yet", ""),
    }
}

fn detector(facts: &Facts<'_>) -> Finding {
    let todo = "Start the detector, or read its log.";
    let Some(status) = facts.status else { return unknown_without("controller") };
    let Some(name) = &status.active_detector else {
        return finding(Verdict::Bad, format!("none in use: {}", status.detector_why), todo);
    };
    let Some(it) = status.candidates.iter().find(|it| it.detector == *name) else {
        return finding(Verdict::Bad, format!("the controller has no data of `{name}`"), todo);
    };
    let Some(age_ms) = facts.found_age_ms else {
        return finding(Verdict::Bad, format!("{name}: no detections have arrived"), todo);
    };
    // Rate and latency are those of its latest frames, also while it is silent.
    let age_ms = age_ms.max(it.age_ms - it.latency_ms);
    if !is_current(Some(age_ms)) {
        return finding(Verdict::Bad, format!("{name}: silent for {:.0} s", age_ms / 1000.0), todo);
    }
    let text = format!("{name}: {:.1} Hz, {:.0} ms", it.rate_hz, it.latency_ms);
    let is_quick = it.rate_hz >= MIN_RATE_HZ && it.latency_ms <= MAX_LATENCY_MS;
    let todo = "It needs fewer markers, a smaller picture or a faster machine.";
    finding(if is_quick { Verdict::Good } else { Verdict::Bad }, text, todo)
}

fn marker(facts: &Facts<'_>) -> Finding {
    let todo = "Show the pad to the camera, give the detector the marker's family and size, and the controller its name (`marker`).";
    let Some(status) = facts.status else { return unknown_without("controller") };
    let Some(found) = facts.found.filter(|_| is_current(facts.found_age_ms)) else {
        return unknown_without("detector");
    };
    let any = found.detections.first();
    let requested = status.landing_marker();
    match (requested.map_or(any, |marker| found.first_of(marker)), any, requested) {
        (Some(it), ..) if it.pose.is_some() => finding(Verdict::Good, in_words(it), todo),
        (Some(_), ..) => finding(
            Verdict::Bad,
            "seen, but the detector gives no pose of it",
            "A pose needs the camera's calibration, and the marker's size in the detector's configuration.",
        ),
        (None, Some(other), Some(requested)) => {
            let text = format!("sees {}, the landing uses {requested}", in_words(other));
            finding(Verdict::Bad, text, todo)
        }
        (None, ..) => finding(Verdict::Open, "not in view; the search in flight finds it", todo),
    }
}

fn mount(facts: &Facts<'_>) -> Finding {
    let todo = "Correct the camera's mount in its configuration (docs/camera.md).";
    let Some(status) = facts.status else { return unknown_without("controller") };
    let about =
        status.warnings.iter().find(|text| text.contains("mount") || text.contains("focal"));
    match about {
        Some(text) => finding(Verdict::Bad, text.as_str(), todo),
        None if status.started_ns.is_some() => {
            finding(Verdict::Good, "no contradiction so far", todo)
        }
        None => finding(Verdict::Open, "is tested in flight, before the descent", "Nothing to do."),
    }
}

fn link(facts: &Facts<'_>) -> Finding {
    let todo = "Move the antennas closer; `alight doctor` measures the link.";
    if facts.status.is_none() {
        return unknown_without("controller");
    }
    match facts.round_trip_ms {
        Some(Some(took_ms)) => {
            let is_quick = took_ms <= MAX_ROUND_TRIP_MS;
            let verdict = if is_quick { Verdict::Good } else { Verdict::Bad };
            finding(verdict, format!("to the controller and back in {took_ms:.1} ms"), todo)
        }
        Some(None) => finding(Verdict::Bad, "the controller does not answer", todo),
        None => finding(Verdict::Open, "not measured yet", "Nothing to do."),
    }
}

fn battery(facts: &Facts<'_>) -> Finding {
    let todo = "Charge it.";
    if facts.status.is_none() {
        return unknown_without("controller");
    }
    match facts.vehicle.and_then(|vehicle| vehicle.battery) {
        Some(level) if level >= MIN_BATTERY => {
            finding(Verdict::Good, format!("{:.0} %", 100.0 * level), todo)
        }
        Some(level) => finding(Verdict::Bad, format!("only {:.0} %", 100.0 * level), todo),
        None => finding(Verdict::Open, "the autopilot reports none", "Check its voltage."),
    }
}

fn recording(facts: &Facts<'_>) -> Finding {
    let todo = "`alight record`, or `run = \"recorder\"` in the site (docs/recording.md).";
    match facts.recorder {
        None => finding(Verdict::Open, "no recorder is present", todo),
        Some(RecorderStatus { problem: Some(problem), .. }) => finding(
            Verdict::Bad,
            problem.as_str(),
            "Make room on the disk, or replace it; it then records again on its own.",
        ),
        Some(status) => finding(Verdict::Good, status.file.as_str(), todo),
    }
}

fn keys(facts: &Facts<'_>) -> Finding {
    let todo = "Make keys (`alight keys`, docs/deploy.md), and name the ground stations: every computer within range can command the vehicle.";
    match facts.is_insecure {
        Some(true) => {
            finding(Verdict::Bad, "a process listens beyond its machine without keys", todo)
        }
        Some(false) => {
            finding(Verdict::Good, "no process listens beyond its machine without keys", todo)
        }
        None => finding(Verdict::Open, "no process is present", todo),
    }
}

fn warnings(facts: &Facts<'_>) -> Finding {
    let todo = "Read them, and remove their cause before the start.";
    let mut texts: Vec<&str> =
        facts.status.iter().flat_map(|status| &status.warnings).map(String::as_str).collect();
    let silent = format!("silent: {}", facts.silent.join(", "));
    if !facts.silent.is_empty() {
        texts.push(&silent);
    }
    match texts.as_slice() {
        [] if facts.status.is_none() => unknown_without("controller"),
        [] => finding(Verdict::Good, "none", todo),
        texts => finding(Verdict::Bad, texts.join("; "), todo),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::{Candidate, Detection, DetectorState, LandedState};

    fn verdict(facts: &Facts<'_>, name: &str) -> Verdict {
        checks(facts).into_iter().find(|check| check.name == name).unwrap().verdict
    }

    /// The checks with a remedy.
    fn remedies(facts: &Facts<'_>) -> Vec<&'static str> {
        let failed = checks(facts).into_iter().filter(|check| check.verdict == Verdict::Bad);
        failed
            .inspect(|check| assert!(!check.todo.is_empty(), "{check:?}"))
            .map(|it| it.name)
            .collect()
    }

    /// The checks that are not known without this process.
    fn unknown(facts: &Facts<'_>, process: &str) -> Vec<&'static str> {
        let text = format!("not known without the {process}");
        let unknown = checks(facts).into_iter().filter(|check| check.text == text);
        unknown
            .inspect(|it| assert!(it.verdict == Verdict::Open && it.todo.is_empty(), "{it:?}"))
            .map(|it| it.name)
            .collect()
    }

    #[test]
    fn without_data_only_controller_and_camera_have_a_remedy() {
        let facts = Facts::default();
        assert_eq!(remedies(&facts), ["controller", "camera"]);
        let others = ["autopilot", "calibration", "clock", "detector", "marker", "mount", "link"];
        assert_eq!(unknown(&facts, "controller"), [&others[..], &["battery", "warnings"]].concat());
    }

    #[test]
    fn without_a_detector_only_its_own_check_has_a_remedy() {
        let status = ControllerStatus {
            active_detector: Some("main".into()),
            candidates: vec![Candidate::sample()],
            ..ControllerStatus::default()
        };
        let facts = Facts {
            status: Some(&status),
            status_age_ms: Some(50.0),
            vehicle_age_ms: Some(50.0),
            found_age_ms: Some(3000.0),
            frames_hz: Some(15.0),
            controller_clock: Some("clock"),
            round_trip_ms: Some(Some(1.0)),
            ..Facts::default()
        };
        assert_eq!(remedies(&facts), ["detector"]);
        assert_eq!(unknown(&facts, "detector"), ["calibration", "clock", "marker"]);
        let detector = |facts: &Facts<'_>| {
            let mut found = checks(facts).into_iter().filter(|check| check.name == "detector");
            found.next().map(|check| check.text).unwrap()
        };
        assert_eq!(detector(&facts), "main: silent for 3 s");
        // The controller has none of its detections.
        let late = Candidate { age_ms: 4000.0, ..Candidate::sample() };
        let status = ControllerStatus { candidates: vec![late], ..status.clone() };
        let late = Facts { status: Some(&status), found_age_ms: Some(50.0), ..facts };
        assert_eq!(detector(&late), "main: silent for 4 s");
    }

    #[test]
    fn of_a_detection_without_a_pose_no_cause_is_named() {
        let status = ControllerStatus { marker: "rings".into(), ..ControllerStatus::default() };
        let without = Detection { pose: None, ..Detection::sample() };
        let found = Detections { detections: vec![without], ..Detections::sample() };
        let facts = Facts {
            status: Some(&status),
            found: Some(&found),
            found_age_ms: Some(50.0),
            ..Facts::default()
        };
        let check = checks(&facts).into_iter().find(|check| check.name == "marker").unwrap();
        assert_eq!(check.text, "seen, but the detector gives no pose of it");
        assert_eq!(check.verdict, Verdict::Bad);
    }

    #[test]
    fn all_checks_pass_with_complete_and_current_data() {
        let status = ControllerStatus {
            autopilot: "connected".into(),
            marker: "rings".into(),
            active_detector: Some("main".into()),
            candidates: vec![Candidate { state: DetectorState::Active, ..Candidate::sample() }],
            started_ns: Some(1),
            ..ControllerStatus::default()
        };
        let vehicle = VehicleState {
            stamp_ns: 0,
            ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
            position_ned_m: [0.0; 3],
            velocity_ned_m_s: [0.0; 3],
            mode: "GUIDED".into(),
            armed: false,
            landed: LandedState::OnGround,
            battery: Some(0.9),
        };
        let found = Detections::sample();
        let info = CameraInfo::sample();
        let recorder = RecorderStatus { file: "a.mcap".into(), ..RecorderStatus::default() };
        let facts = Facts {
            status: Some(&status),
            status_age_ms: Some(50.0),
            vehicle: Some(&vehicle),
            vehicle_age_ms: Some(50.0),
            found: Some(&found),
            found_age_ms: Some(50.0),
            frames_hz: Some(15.0),
            calibration: Some(&info),
            controller_clock: Some("clock"),
            round_trip_ms: Some(Some(1.0)),
            recorder: Some(&recorder),
            is_insecure: Some(false),
            silent: Vec::new(),
        };
        for check in checks(&facts) {
            assert!(check.verdict == Verdict::Good && check.todo.is_empty(), "{check:?}");
        }
        let old =
            Facts { vehicle_age_ms: Some(1500.0), found_age_ms: Some(1500.0), ..facts.clone() };
        assert_eq!(verdict(&old, "autopilot"), Verdict::Bad);
        assert_eq!(verdict(&old, "detector"), Verdict::Bad);
        assert_eq!(unknown(&old, "detector"), ["marker"]);
        let foreign = Facts { controller_clock: Some("other"), ..facts.clone() };
        assert_eq!(verdict(&foreign, "clock"), Verdict::Bad);
        let aruco = Detection { family: "aruco-4x4-50".into(), id: Some(7), ..Detection::sample() };
        let other = Detections { detections: vec![aruco], ..found.clone() };
        let other = Facts { found: Some(&other), ..facts.clone() };
        assert_eq!(verdict(&other, "marker"), Verdict::Bad, "another marker is not the landing's");
        let open = Facts { is_insecure: Some(true), silent: vec!["detector main".into()], ..facts };
        assert_eq!(verdict(&open, "keys"), Verdict::Bad);
        assert_eq!(verdict(&open, "warnings"), Verdict::Bad);
    }
}
