//! Logs a flight's phases, alarms, warnings and detector changes, and counts setpoints and rejected
//! detections for the health report, with the latency from a frame's exposure to the setpoint.

use std::sync::Arc;
use std::time::Duration;

use autopilot::Event;
use autopilot::command::SetpointError;
use autopilot::dialect::MavSeverity;
use landing::{Alarm, Decision, Phase, Reason};
use node::HealthCounters;

use crate::refusals::Warning;

/// The latency from the middle of a frame's exposure, its stamp, to the setpoint that used it, as health, `alight land` and the report
/// name it.
const EXPOSURE_TO_SETPOINT: &str = "exposure to setpoint";

/// Writes the log and counts for the health report.
#[derive(Debug)]
pub struct Journal {
    health: Arc<HealthCounters>,
    /// Why the latest detection of the detector in use was rejected, if it was.
    rejection: Option<String>,
    /// The warnings that are in the log.
    logged: Vec<Logged>,
}

/// A warning that is in the log.
#[derive(Debug)]
struct Logged {
    matter: String,
    /// The warning as it was logged.
    text: String,
    /// When it was logged, in nanoseconds.
    at_ns: i64,
    /// Since when it is over, in nanoseconds; `None` while it persists.
    over_ns: Option<i64>,
}

/// Minimum time between two lines of one warning that ends and begins again, in nanoseconds; its end is logged after the same time.
const QUIET_NS: i64 = 5_000_000_000;

impl Journal {
    /// A journal that counts into `health`.
    pub fn new(health: Arc<HealthCounters>) -> Self {
        Self { health, rejection: None, logged: Vec::new() }
    }

    /// Logs the beginning and the end of each warning, and not every short interruption.
    pub fn warnings(&mut self, now_ns: i64, warnings: &[Warning]) {
        for Warning { matter, text } in warnings {
            let Some(logged) = self.logged.iter_mut().find(|logged| logged.matter == *matter)
            else {
                tracing::warn!("{text}");
                let (matter, text) = (matter.clone(), text.clone());
                self.logged.push(Logged { matter, text, at_ns: now_ns, over_ns: None });
                continue;
            };
            if logged.over_ns.take().is_some() && now_ns.saturating_sub(logged.at_ns) >= QUIET_NS {
                tracing::warn!("{text}");
                (logged.at_ns, logged.text) = (now_ns, text.clone());
            }
        }
        self.logged.retain_mut(|logged| {
            if warnings.iter().any(|warning| warning.matter == logged.matter) {
                return true;
            }
            let over_ns = *logged.over_ns.get_or_insert(now_ns);
            let is_over = now_ns.saturating_sub(over_ns) >= QUIET_NS;
            if is_over {
                tracing::info!("No longer: {}", logged.text);
            }
            !is_over
        });
    }

    /// Counts a camera's information that was refused, for a reason that is a short name for programs.
    pub fn reject_camera(&self, reason: &str) {
        self.health.dropped(&format!("camera info: {reason}"));
    }

    /// Logs that a camera has another calibration than before.
    pub fn camera_replaced(&self, camera: &str, difference: &str) {
        tracing::warn!(camera, difference, "Camera started again with another calibration");
    }

    /// Counts an event.
    pub fn count(&self, name: &'static str) {
        self.health.count(name);
    }

    /// Counts a rejected detection of the detector in use and remembers the reason, a short name for programs.
    pub fn reject(&mut self, reason: &str) {
        self.health.dropped(&format!("detection: {reason}"));
        self.rejection = Some(reason.to_owned());
    }

    /// Counts a rejected detection of a detector that is not in use.
    pub fn reject_unused(&self, reason: &str) {
        self.health.dropped(&format!("detection: {reason}"));
    }

    /// Counts a rejected detection that arrived after a newer one.
    pub fn reject_late(&self, reason: &str) {
        self.health.dropped(&format!("late detection: {reason}"));
    }

    /// The latest detection was not rejected.
    pub fn accept(&mut self) {
        self.rejection = None;
    }

    /// Why the latest detection of the detector in use was rejected, if it was.
    pub fn rejection(&self) -> Option<&str> {
        self.rejection.as_deref()
    }

    /// Counts a tick of a landing, and whether the newest frame that was used was no longer fresh then:
    /// because no detector had a newer one, or although one had.
    pub fn tick(&self, is_fresh: bool, has_newer: bool) {
        self.health.count("ticks");
        if !is_fresh {
            self.health.count("ticks without a fresh frame");
            if has_newer {
                self.health.count("ticks without a fresh frame although there was one");
            }
        }
    }

    /// Records the latency of a setpoint or landing target that used the frame with this stamp.
    pub fn used_frame(&self, now_ns: i64, stamp_ns: i64) {
        let age_ns = now_ns.saturating_sub(stamp_ns).max(0);
        self.health.latency(EXPOSURE_TO_SETPOINT, Duration::from_nanos(age_ns.unsigned_abs()));
    }

    /// Median and 99th percentile from a frame's exposure to the setpoint that used it, in milliseconds.
    pub fn latency_ms(&self) -> Option<[f64; 2]> {
        self.health.percentiles(EXPOSURE_TO_SETPOINT)
    }

    /// Counts a setpoint that was sent or refused.
    pub fn setpoint(&self, result: Result<(), SetpointError>) {
        match result {
            Ok(()) => self.health.count("setpoints"),
            Err(problem) => {
                if self.health.failed("setpoints") {
                    tracing::warn!(%problem, "Setpoint not sent (further failures are only counted)");
                }
            }
        }
    }

    /// Logs an alarm.
    pub fn alarm(&self, alarm: Alarm) {
        tracing::warn!(%alarm, "Alarm");
        self.health.count("alarms");
    }

    /// Logs a change of the active detector.
    pub fn detector_changed(&self, detector: &str, why: &str) {
        self.health.count("changes of the detector");
        tracing::warn!(detector, why, "Active detector changed");
    }

    /// Logs a change of the lander's phase.
    pub fn phase_changed(&self, from: Phase, decision: &Decision) {
        let Decision { phase: to, why, .. } = decision;
        let by_operator = matches!(why, Reason::OperatorHold | Reason::OperatorAbort);
        match to {
            Phase::Retry | Phase::Hold | Phase::Aborted if !by_operator => {
                tracing::warn!(%from, %to, %why, "Phase");
            }
            _ => tracing::info!(%from, %to, %why, "Phase"),
        }
    }

    /// Logs an event of the autopilot.
    pub fn autopilot(&self, event: &Event) {
        match event {
            Event::Found { system, firmware } => {
                tracing::info!(system, %firmware, "Autopilot found");
            }
            Event::OtherVehicle { system } => tracing::warn!(
                system,
                "Another vehicle is on the link; it is ignored, and no flight begins until ours is pinned with `autopilot.system_id`"
            ),
            Event::SameAddress { .. } => tracing::warn!(
                "Another program uses our system and component id, and no flight begins until it ends; the status shows its messages and the remedy"
            ),
            Event::Lost { silence } => {
                let silence = format_args!("{:.1} s", silence.as_secs_f64());
                tracing::error!(%silence, "Autopilot heartbeat lost");
            }
            Event::Returned => tracing::info!("Autopilot heartbeat regained"),
            Event::Restarted { .. } => tracing::error!("Autopilot restarted"),
            Event::ArmedChanged(armed) => tracing::info!(armed, "Motors"),
            // The first one is no change.
            Event::ModeChanged { from: None, to } => tracing::info!(mode = %to, "Flight mode"),
            Event::ModeChanged { from: Some(from), to } => {
                tracing::info!(%from, %to, "Flight mode");
            }
            Event::LandedChanged { from, to } => tracing::info!(%from, %to, "Landed state"),
            Event::ReadyChanged { ready: true, .. } => tracing::info!("Ready to arm"),
            Event::ReadyChanged { ready: false, reasons } => {
                tracing::info!(reasons = reasons.join("; "), "Not ready to arm");
            }
            Event::Text { severity, text } => {
                tracing::info!(severity = severity_name(*severity), text, "Autopilot");
            }
            Event::Command { command, result: Ok(()), .. } => tracing::info!(%command, "Done"),
            Event::Command { result: Err(problem), .. } => {
                self.health.failed("commands");
                tracing::warn!(%problem, "Command failed");
            }
            Event::StreamMissing { message, wanted_hz, measured_hz } => {
                self.health.failed("missing messages");
                tracing::warn!(
                    message,
                    wanted_hz,
                    measured_hz,
                    "A requested MAVLink message is not streaming at the requested rate"
                );
            }
            Event::StreamRestored { message, measured_hz } => {
                tracing::info!(message, measured_hz, "A MAVLink message is streaming again");
            }
            Event::State(_)
            | Event::Status(_)
            | Event::Attitude(_)
            | Event::Position(_)
            | Event::Range(_) => {}
        }
    }
}

/// The name of a severity.
fn severity_name(severity: MavSeverity) -> &'static str {
    match severity {
        MavSeverity::MAV_SEVERITY_EMERGENCY => "emergency",
        MavSeverity::MAV_SEVERITY_ALERT => "alert",
        MavSeverity::MAV_SEVERITY_CRITICAL => "critical",
        MavSeverity::MAV_SEVERITY_ERROR => "error",
        MavSeverity::MAV_SEVERITY_WARNING => "warning",
        MavSeverity::MAV_SEVERITY_NOTICE => "notice",
        MavSeverity::MAV_SEVERITY_INFO => "information",
        MavSeverity::MAV_SEVERITY_DEBUG => "debug",
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::{Mutex, PoisonError};

    use autopilot::FlightMode;
    use landing::Action;

    use super::*;

    /// A log in memory.
    #[derive(Clone, Default)]
    struct Log(Arc<Mutex<Vec<u8>>>);

    impl Write for Log {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).write(bytes)
        }

        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    /// The lines that are logged meanwhile.
    fn logged(run: impl FnOnce()) -> String {
        let log = Log::default();
        let writer = log.clone();
        let subscriber = tracing_subscriber::fmt()
            .with_ansi(false)
            .without_time()
            .with_writer(move || writer.clone())
            .finish();
        tracing::subscriber::with_default(subscriber, run);
        let output = log.0.lock().unwrap_or_else(PoisonError::into_inner);
        std::str::from_utf8(&output).unwrap().to_owned()
    }

    #[test]
    fn a_warning_that_comes_and_goes_is_logged_every_few_seconds_and_its_end_once() {
        let warning = Warning { matter: "dispute a b".into(), text: "they differ".into() };
        let output = logged(|| {
            let mut journal = Journal::new(Arc::default());
            // It is there in every other call for twelve seconds.
            for i in 0..480_i64 {
                let warnings = std::slice::from_ref(&warning);
                let warnings = if i % 2 == 0 { warnings } else { &[] };
                journal.warnings(i * 25_000_000, warnings);
            }
            for i in 480..800_i64 {
                journal.warnings(i * 25_000_000, &[]);
            }
        });
        assert_eq!(output.matches("WARN").count(), 3, "{output}");
        assert_eq!(output.matches("they differ").count(), 4, "{output}");
        assert_eq!(output.matches("No longer: they differ").count(), 1, "{output}");
    }

    #[test]
    fn a_phase_that_ends_the_descent_is_a_warning_unless_the_operator_asked_for_it() {
        for (phase, why, level) in [
            (Phase::Retry, Reason::Retrying, "WARN"),
            (Phase::Hold, Reason::TargetLost, "WARN"),
            (Phase::Aborted, Reason::RetriesUsed, "WARN"),
            (Phase::Hold, Reason::OperatorHold, "INFO"),
            (Phase::Descend, Reason::Descending, "INFO"),
        ] {
            let decision =
                Decision { phase, why, action: Action::None, target: None, rejected: None };
            let line =
                logged(|| Journal::new(Arc::default()).phase_changed(Phase::Search, &decision));
            assert!(line.contains(level) && line.contains(&why.to_string()), "{line}");
        }
    }

    #[test]
    fn the_log_is_written_in_words() {
        let output = logged(|| {
            let journal = Journal::new(Arc::default());
            journal.alarm(Alarm::AutopilotLost);
            journal.autopilot(&Event::ModeChanged { from: None, to: FlightMode::Guided });
            journal.autopilot(&Event::ModeChanged {
                from: Some(FlightMode::Guided),
                to: FlightMode::Land,
            });
            let reasons = vec!["no position".to_owned(), "no compass".to_owned()];
            journal.autopilot(&Event::ReadyChanged { ready: false, reasons });
            let severity = MavSeverity::MAV_SEVERITY_WARNING;
            journal.autopilot(&Event::Text { severity, text: "Low".to_owned() });
            journal.autopilot(&Event::Lost { silence: Duration::from_millis(3003) });
        });
        for expected in [
            "Alarm alarm=the link to the autopilot is lost",
            "Flight mode mode=GUIDED",
            "Flight mode from=GUIDED to=LAND",
            "no position; no compass",
            "warning",
            "silence=3.0 s",
        ] {
            assert!(output.contains(expected), "`{expected}` is not in {output}");
        }
        for debug in ["Some(", "MAV_", "AutopilotLost", "["] {
            assert!(!output.contains(debug), "`{debug}` is in {output}");
        }
    }
}
