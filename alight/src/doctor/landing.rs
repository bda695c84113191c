//! `alight doctor` on the controller: the autopilot's link, warnings, and the detector in use.

use messages::{ControllerStatus, DetectorState};

use super::{Finding, Findings, Seen, Verdict};
use crate::staleness::Limits;

/// The remedy if no detector is alive.
const START_ONE: &str = "start one (`alight up`, `alight detector`); the output of the one that ended contains the reason";
/// The consequence of a warning of the controller.
const UNTIL_THEN: &str =
    "until then a landing may not be started or finished, or ends further from the marker";
/// The remedy of a warning that has none of its own.
const SEE_TABLE: &str = "see `alight detectors`, the log of the program that it names, and the table of symptoms in docs/detectors.md";
/// The first words of the remedies in the controller's warnings, which follow a semicolon or a colon.
const FIRST_WORDS: [&str; 19] = [
    "check", "copy", "correct", "give", "look", "measure", "name", "publish", "restart", "run",
    "say", "search", "see", "set", "stamp", "start", "stop", "use", "write",
];

/// Checks the controller: its phase, the autopilot's link, its warnings and the detector that it uses.
pub(super) fn check(findings: &mut Findings, seen: &Seen) {
    let Some(status) = &seen.status else { return };
    let text = format!("{} ({}); autopilot: {}", status.phase, status.why, status.autopilot);
    findings.good("controller", text);
    // The state of the link is published as text only: `system 1 in GUIDED` if the autopilot's heartbeat is received. Otherwise the text
    // contains the advice.
    let link = &status.autopilot;
    let is_received = link.starts_with("system ") && !link.contains("is silent");
    if !is_received {
        let text =
            "the controller does not receive its heartbeat, and no landing starts without it";
        findings.wrong("autopilot", text.to_owned(), link);
    }
    match status.setpoint_timeout_s {
        Some(seconds) => findings.good(
            "setpoint timeout",
            format!("without setpoints the autopilot stops after {seconds:.1} s; a landing shortens this to `autopilot.setpoint_timeout_s`"),
        ),
        None if !is_received => {}
        None => findings.doubtful(
            "setpoint timeout",
            "the autopilot has not reported its GUID_TIMEOUT or COM_OF_LOSS_T; landings are slower for it".to_owned(),
            "check that it answers parameter requests on this link",
        ),
    }
    for warning in &status.warnings {
        let (finding, remedy) = finding_and_remedy(warning);
        let remedy = match is_obstacle(status, warning) {
            true => Some(format!("{}; {UNTIL_THEN}", remedy.unwrap_or(SEE_TABLE))),
            false => remedy.map(str::to_owned),
        };
        let finding = finding.to_owned();
        findings.findings.push(Finding {
            verdict: Verdict::Wrong,
            about: "controller",
            finding,
            remedy,
        });
    }
    check_used(findings, seen, status);
}

/// A warning of the controller, and the remedy at its end.
fn finding_and_remedy(warning: &str) -> (&str, Option<&str>) {
    let is_remedy = |text: &str| {
        let word = text.split(|c: char| !c.is_ascii_alphabetic()).next().unwrap_or_default();
        FIRST_WORDS.contains(&word)
    };
    let ends = warning.match_indices("; ").chain(warning.match_indices(": ")).map(|(at, _)| at);
    let split = ends.filter(|at| warning.get(at + 2..).is_some_and(is_remedy)).min();
    match split.and_then(|at| Some((warning.get(..at)?, warning.get(at + 2..)?))) {
        Some((finding, remedy)) => (finding, Some(remedy)),
        None => (warning, None),
    }
}

/// Whether a warning of the controller concerns a landing that is still to be started or finished.
fn is_obstacle(status: &ControllerStatus, warning: &str) -> bool {
    // Measured on the pad, after the touchdown.
    !status.finished && !warning.starts_with("the vehicle stood about ")
}

/// Checks that a detector is there, and that the controller uses one that is.
fn check_used(findings: &mut Findings, seen: &Seen, status: &ControllerStatus) {
    let state_of = |name: &str| status.candidates.iter().find(|it| it.detector == name);
    match &status.active_detector {
        _ if !seen.has_detector() => findings.wrong(
            "detector",
            format!("none is alive, so a landing sees nothing: {}", status.detector_why),
            START_ONE,
        ),
        Some(used) if state_of(used).is_some_and(|it| !it.alive) => findings.wrong(
            "detector",
            format!(
                "`{used}` was in use and has left the network, and no other has taken its place"
            ),
            START_ONE,
        ),
        Some(used) => match state_of(used) {
            Some(candidate) if candidate.state == DetectorState::Stale => findings.doubtful(
                "detector",
                match seen.limits.or_else(Limits::by_default) {
                    Some(limits) => format!(
                        "`{used}` is in use, no other is better, and it is {}",
                        limits.stale(candidate)
                    ),
                    None => format!("`{used}` is in use, and is stale; no other is better"),
                },
                "see the lines of the cameras above, its log, and `alight detectors`",
            ),
            _ => findings.good("detector", format!("`{used}` is in use")),
        },
        None => findings.doubtful(
            "detector",
            format!("the controller uses none: {}", status.detector_why),
            "check that one runs and gets frames",
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::Candidate;

    #[test]
    fn the_reason_for_a_missing_heartbeat_is_reported() {
        let findings_text = |autopilot: &str| {
            let status =
                ControllerStatus { autopilot: autopilot.into(), ..ControllerStatus::default() };
            let mut findings = Findings::default();
            check(&mut findings, &Seen { status: Some(status), ..Seen::default() });
            findings.text()
        };
        let other = findings_text(
            "no heartbeat of system 7 yet, but of 1: set `autopilot.system_id` to the vehicle's",
        );
        assert!(
            other.contains("does not receive its heartbeat") && other.contains("->"),
            "{other}"
        );
        assert_eq!(other.matches("but of 1: set `autopilot.system_id`").count(), 2, "{other}");
        let silent = findings_text("system 1 is silent: check its cable");
        assert!(silent.contains("does not receive") && silent.contains("-> "), "{silent}");
        assert!(!findings_text("system 1 in GUIDED").contains("does not receive"));
    }

    #[test]
    fn a_warning_is_an_obstacle_of_a_landing_that_is_not_finished() {
        let findings_text = |warning: &str, finished| {
            let warnings = vec![warning.to_owned()];
            let status = ControllerStatus { warnings, finished, ..ControllerStatus::default() };
            let mut findings = Findings::default();
            check(&mut findings, &Seen { status: Some(status), ..Seen::default() });
            findings.text()
        };
        let stood = "the vehicle stood about 0.3 m over the pad";
        for (warning, finished, is_obstacle) in
            [("no mount", false, true), ("no mount", true, false), (stood, false, false)]
        {
            let text = findings_text(warning, finished);
            assert!(text.contains(&format!("WRONG  controller    {warning}")), "{text}");
            assert_eq!(text.contains("until then a landing"), is_obstacle, "{text}");
        }
    }

    #[test]
    fn the_remedy_of_a_warning_is_that_at_its_end() {
        for (warning, finding, remedy) in [
            (
                "detections of `mine` are refused: the stamps lie 0.3 s in the future; stamp frames with this host's clock, or set `x`: higher",
                "detections of `mine` are refused: the stamps lie 0.3 s in the future",
                Some("stamp frames with this host's clock, or set `x`: higher"),
            ),
            (
                "no frame from camera `down` for 3 s: check the camera, and whether its detector hangs",
                "no frame from camera `down` for 3 s",
                Some("check the camera, and whether its detector hangs"),
            ),
            (
                "detector `mine` is not used: 2 others see the marker 1.00 m from where it does",
                "detector `mine` is not used: 2 others see the marker 1.00 m from where it does",
                None,
            ),
            (
                "the battery is checked; setpoints stop",
                "the battery is checked; setpoints stop",
                None,
            ),
            ("", "", None),
        ] {
            assert_eq!(finding_and_remedy(warning), (finding, remedy));
            let status = ControllerStatus {
                warnings: vec![warning.to_owned()],
                ..ControllerStatus::default()
            };
            let mut findings = Findings::default();
            check(&mut findings, &Seen { status: Some(status), ..Seen::default() });
            let text = findings.text();
            let line = format!("{:22}{}; until then a landing", "->", remedy.unwrap_or(SEE_TABLE));
            assert!(text.contains(&line), "{text}");
        }
    }

    #[test]
    fn a_controller_without_a_detector_that_is_alive_is_wrong() {
        let candidate = |alive: bool, state: DetectorState| Candidate {
            detector: "main".into(),
            alive,
            state,
            ..Candidate::sample()
        };
        let findings_text = |peers: &[&str], candidate: Option<Candidate>| {
            let status = ControllerStatus {
                active_detector: candidate.as_ref().map(|it| it.detector.clone()),
                detector_why: "the last one has gone".into(),
                candidates: candidate.into_iter().collect(),
                ..ControllerStatus::default()
            };
            let peers = peers.iter().map(|service| ((*service).to_owned(), "main".to_owned()));
            let seen = Seen { peers: peers.collect(), ..Seen::default() };
            let mut findings = Findings::default();
            check_used(&mut findings, &seen, &status);
            findings.text()
        };
        let both = ["controller", "detector"];
        let active = Some(candidate(true, DetectorState::Active));
        assert!(findings_text(&both, active.clone()).ends_with("Nothing is wrong."));
        let none = findings_text(&["controller"], None);
        assert!(none.contains("WRONG  detector      none is alive"), "{none}");
        assert!(none.contains("the last one has gone"), "{none}");
        assert!(
            findings_text(&["controller"], active).contains("none is alive"),
            "it is no longer used"
        );
        let gone = findings_text(&both, Some(candidate(false, DetectorState::Stale)));
        assert!(gone.contains("WRONG") && gone.contains("`main` was in use"), "{gone}");
        let late = findings_text(&both, Some(candidate(true, DetectorState::Stale)));
        assert!(late.ends_with("0 wrong, 1 doubtful."), "{late}");
        let slow = Candidate {
            rate_hz: 1.9,
            age_ms: 39.0,
            latency_ms: 28.0,
            ..candidate(true, DetectorState::Stale)
        };
        let slow = findings_text(&both, Some(slow));
        assert!(
            slow.contains(
                "`main` is in use, no other is better, and it is slow: 1.9 of at least 3 Hz"
            ),
            "{slow}"
        );
        assert!(findings_text(&both, None).ends_with("0 wrong, 1 doubtful."));
    }
}
