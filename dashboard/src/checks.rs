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
    /// The controller's status.
    pub status: Option<&'a ControllerStatus>,
    /// Its age in milliseconds.
    pub status_age_ms: Option<f64>,
    /// The vehicle's state.
    pub vehicle: Option<&'a VehicleState>,
    /// Its age in milliseconds.
    pub vehicle_age_ms: Option<f64>,
    /// The detections of the detector in use in its newest frame.
    pub found: Option<&'a Detections>,
    /// Its age in milliseconds.
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
    let todo = "Start `alight controller`, or read its log.";
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
    let stated = facts.status.map_or("", |status| status.autopilot.as_str());
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
        return finding(Verdict::Bad, "no calibration of the camera in use has arrived", todo);
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
    match (facts.found.map(|found| found.header.clock.as_str()), facts.controller_clock) {
        (Some(camera), Some(controller)) if camera == controller => {
            finding(Verdict::Good, "camera and controller use the same", todo)
        }
        (Some(camera), Some(controller)) => finding(
            Verdict::Bad,
            format!("the camera has {camera}, the controller {controller}"),
            todo,
        ),
        _ => finding(Verdict::Bad, "unknown until frames are searched", todo),
    }
}

fn detector(facts: &Facts<'_>) -> Finding {
    let todo =
        "Start a detector; a slow one needs fewer markers, a smaller picture or a faster machine.";
    let Some(status) = facts.status else { return finding(Verdict::Bad, "no controller", todo) };
    let Some(name) = &status.active_detector else {
        return finding(Verdict::Bad, format!("none in use: {}", status.detector_why), todo);
    };
    let Some(it) = status.candidates.iter().find(|it| it.detector == *name) else {
        return finding(Verdict::Bad, format!("the controller has no data of `{name}`"), todo);
    };
    let text = format!("{name}: {:.1} Hz, {:.0} ms", it.rate_hz, it.latency_ms);
    let is_quick = it.rate_hz >= MIN_RATE_HZ && it.latency_ms <= MAX_LATENCY_MS;
    finding(if is_quick { Verdict::Good } else { Verdict::Bad }, text, todo)
}

fn marker(facts: &Facts<'_>) -> Finding {
    let todo = "Show the pad to the camera, give the detector the marker's family and size, and the controller its name (`marker`).";
    let Some(found) = facts.found.filter(|_| is_current(facts.found_age_ms)) else {
        return finding(Verdict::Bad, "no detector searches for it", todo);
    };
    let any = found.detections.first();
    let requested = facts.status.and_then(ControllerStatus::landing_marker);
    match (requested.map_or(any, |marker| found.first_of(marker)), any, requested) {
        (Some(it), ..) if it.pose.is_some() => finding(Verdict::Good, in_words(it), todo),
        (Some(_), ..) => finding(Verdict::Bad, "seen, but its size is not configured", todo),
        (None, Some(other), Some(requested)) => {
            let text = format!("sees {}, the landing uses {requested}", in_words(other));
            finding(Verdict::Bad, text, todo)
        }
        (None, ..) => finding(Verdict::Open, "not in view; the search in flight finds it", todo),
    }
}

fn mount(facts: &Facts<'_>) -> Finding {
    let todo = "Correct the camera's mount in its configuration (docs/camera.md).";
    let Some(status) = facts.status else { return finding(Verdict::Bad, "no controller", todo) };
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
        [] if facts.status.is_none() => finding(Verdict::Open, "no controller is present", todo),
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

    #[test]
    fn without_data_the_checks_fail_and_name_a_remedy() {
        let checks = checks(&Facts::default());
        for name in ["controller", "autopilot", "camera", "calibration", "detector", "marker"] {
            let check = checks.iter().find(|check| check.name == name).unwrap();
            assert!(check.verdict == Verdict::Bad && !check.todo.is_empty(), "{check:?}");
        }
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
        assert_eq!(verdict(&old, "marker"), Verdict::Bad);
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
