//! Builds the status and the target estimate that the controller publishes: phase and its reason in words, warnings, detector in
//! use, height, link and ages.

use autopilot::{Autopilot, FlightMode, LISTENING, LandedState};
use landing::{Action, Decision, Lander, Reason};
use messages::{ControllerStatus, Phase, Setpoint, TargetEstimate};

use crate::config::{Config, GuidanceName, Mode, Start};
use crate::frames::Frames;
use crate::journal::Journal;
use crate::landing_target::{self, LandingTargetMode};
use crate::limits;
use crate::link_delay;
use crate::mission::{Mission, State, what_happens};
use crate::mount;
use crate::refusals::Warning;
use crate::wire;

/// Age of a PX4's mode from which on it may be another one now, in nanoseconds: it is sent twice a second.
const MAX_MODE_AGE_NS: i64 = 1_200_000_000;
/// Silence of the vehicle after which its mode is not known, in nanoseconds: attitude and position come fifty times a second. Where the
/// link is lost, the failsafe of a PX4 follows half a second after the last setpoint.
const MAX_MODE_SILENCE_NS: i64 = 300_000_000;

/// The warning of a vehicle that an abort does not lift.
const LEFT_LOW: &str = "the vehicle is not lifted, as it may stand on the ground, and its motors run; give `land-here`, or take over and land or disarm it";

/// The parts of a flight that its status shows.
pub struct View<'a> {
    /// The configuration.
    pub config: &'a Config,
    /// The autopilot.
    pub autopilot: &'a Autopilot,
    /// The lander.
    pub lander: &'a Lander,
    /// The lander's latest decision.
    pub decision: Option<Decision>,
    /// The mission.
    pub mission: &'a Mission,
    /// The autopilot's own precision landing, where that steers.
    pub landing_target: Option<&'a LandingTargetMode>,
    /// Frames and detectors.
    pub frames: &'a Frames,
    /// Logs and counters.
    pub journal: &'a Journal,
    /// The last setpoint.
    pub setpoint: Option<Setpoint>,
    /// A PX4 that may be in OFFBOARD after a landing is led out of it.
    pub leads_out: bool,
    /// The mode that ended the landing as the pilot's; the vehicle may show another one since.
    pub pilots_mode: Option<FlightMode>,
    /// The mode that was chosen as the vehicle flew in that one, where it reports it.
    pub chosen_mode: Option<FlightMode>,
    /// The detections that were used.
    pub used: Used,
    /// Wind velocity to the north and east, in m/s.
    pub wind_ned_m_s: Option<[f64; 2]>,
}

/// The detections that were used.
#[derive(Copy, Clone, Debug, Default)]
pub struct Used {
    /// How many in landings.
    pub count: u64,
    /// Stamp of the newest.
    pub stamp_ns: Option<i64>,
}

impl View<'_> {
    /// The estimate of the landing point.
    pub fn target(&self, now_ns: i64) -> TargetEstimate {
        let target = self.present_target(now_ns);
        TargetEstimate {
            stamp_ns: now_ns,
            position_ned_m: target.map(|t| t.position.coords.into()),
            lateral_error_m: target.map(|t| t.lateral_error_m),
            height_m: target.map(|t| t.height_m),
            age_ms: self.detection_age_ms(now_ns),
            rejected: self.journal.rejection().map(str::to_owned),
            decided: self.decision.and_then(|d| d.rejected).map(|why| why.to_string()),
            velocity_ned_m_s: target.map(|t| t.velocity.coords.into()),
            deviation_m: target.map(|t| t.deviation_m),
            heading_rad: target.and_then(|t| t.heading_rad),
            nis: target.and_then(|t| t.nis),
            time_offset_ms: target.map(|t| t.time_offset_s * 1e3),
            wind_ned_m_s: self.wind_ned_m_s,
        }
    }

    /// The status: phase and reason, detectors, height, link and warnings.
    pub fn status(&self, now_ns: i64) -> ControllerStatus {
        let target = self.present_target(now_ns);
        let position = self.autopilot.state().and_then(|state| state.position);
        let above_origin_m = position.map(|position| -position.position.z());
        let selection = &self.frames.selection;
        let (phase, why) = self.phase(now_ns);
        ControllerStatus {
            stamp_ns: now_ns,
            phase,
            why,
            guidance: match self.config.mode {
                Mode::Guided => self.config.guidance.name().to_owned(),
                Mode::LandingTarget => self.config.mode.name().to_owned(),
            },
            marker: self.config.marker.clone(),
            autopilot: self.link(),
            active_detector: selection.active().map(str::to_owned),
            detector_why: selection.why().to_owned(),
            preference: selection.preference().to_owned(),
            detector_changes: selection.changes(),
            candidates: selection.candidates(now_ns),
            detection_age_ms: self.detection_age_ms(now_ns),
            height_m: target.map(|t| t.height_m).or(above_origin_m),
            lateral_error_m: target.map(|t| t.lateral_error_m),
            setpoint: self.setpoint,
            started_ns: self.mission.started_ns(),
            disarmed_ns: self.mission.disarmed_ns(),
            // Only then is the mode known in which the vehicle is left.
            finished: self.is_finished() && !self.leads_out,
            waits_for_operator: self.waits_for_operator(),
            detections_used: self.used.count,
            latency_ms: self.journal.latency_ms(),
            setpoint_timeout_s: limits::timeout_s(self.autopilot),
            warnings: self.warnings(now_ns).into_iter().map(|warning| warning.text).collect(),
        }
    }

    /// The warnings for the operator.
    pub fn warnings(&self, now_ns: i64) -> Vec<Warning> {
        let mut warnings = self.frames.warnings(now_ns);
        warnings.extend(self.autopilot.conflict(now_ns).map(|conflict| Warning {
            matter: "conflict".to_owned(),
            text: format!("no take-off and no landing begins: {conflict}"),
        }));
        if self.config.autopilot.timesync {
            warnings.extend(link_delay::warning(now_ns, self.autopilot));
        }
        let is_alone = self.is_blind() && self.no_frame(now_ns).is_none();
        warnings.extend(is_alone.then(|| Warning {
            matter: "no detector".to_owned(),
            text: Reason::NoDetector.to_string(),
        }));
        let left_low = self.left_low();
        warnings.extend(left_low.map(|text| Warning { matter: "aborted low".to_owned(), text }));
        let size_ratio = self.lander.marker_size_ratio();
        warnings.extend(mount::warnings(&self.lander.mount_findings(), size_ratio));
        let scatter = self.lander.scatter_excess().zip(self.frames.selection.active());
        warnings.extend(scatter.map(|(excess, name)| mount::scatter_warning(excess, name)));
        let configured_m = self.config.metric.standing_height_m;
        let is_metric = self.config.guidance == GuidanceName::Metric;
        let measured_m = self.lander.standing_height_m().filter(|_| is_metric);
        warnings.extend(
            measured_m.and_then(|it| mount::standing_warning(it, configured_m, size_ratio)),
        );
        warnings
    }

    /// The phase and the reason for it.
    pub fn phase(&self, now_ns: i64) -> (Phase, String) {
        if let (State::AwaitingTakeoff, Some(why)) =
            (self.mission.state(), self.mission.held_because())
        {
            return (Phase::Idle, why.to_owned());
        }
        match (self.mission.state(), self.landing_target) {
            (
                State::Idle | State::AwaitingTakeoff | State::SendingLandingTarget,
                Some(landing_target),
            ) => {
                let distrust = self.distrust().map(|why| why.to_string());
                let problem = landing_target::problem(self.autopilot).or(distrust);
                let (phase, why) = landing_target.phase(now_ns, problem);
                match self.mission.when_resumed().and_then(what_happens) {
                    Some(done) => {
                        (phase, format!("{why}; a landing under way is {done} once found"))
                    }
                    None => (phase, why),
                }
            }
            (State::SendingLandingTarget, None) => {
                (Phase::Failed, "no landing target is sent in this mode".to_owned())
            }
            (State::Idle, None) if self.is_said_to_stand() => {
                let why = "no landing is resumed, as the autopilot reports that the vehicle stands on the ground; waiting for the start of one";
                (Phase::Idle, why.to_owned())
            }
            (State::Idle, None) => (Phase::Idle, "waiting for the start of a landing".to_owned()),
            (State::AwaitingTakeoff, None) if self.mission.is_resuming() => {
                (Phase::Idle, self.resuming(now_ns))
            }
            (State::AwaitingTakeoff, None) if self.autopilot.state().is_none() => {
                (Phase::Idle, "waiting for the autopilot's heartbeat".to_owned())
            }
            (State::AwaitingTakeoff, None) => {
                let waits = match self.autopilot.has_listened(now_ns) {
                    true => "waiting for the vehicle to fly in GUIDED",
                    false => LISTENING,
                };
                let conflict = self.autopilot.conflict(now_ns).map(|it| it.to_string());
                (Phase::Idle, conflict.unwrap_or_else(|| waits.to_owned()))
            }
            (State::TakingOff { why, .. }, _) => (Phase::Takeoff, why.clone()),
            (State::TakingControl { .. }, _) => {
                let waits =
                    "changing to OFFBOARD; the landing begins once the vehicle follows setpoints";
                (Phase::Idle, waits.to_owned())
            }
            (State::LeavingOffboard { why, .. }, _) => (Phase::Idle, why.clone()),
            (State::AskingForLand { .. }, _) => (Phase::Final, Reason::OperatorLand.to_string()),
            (State::Failed { why }, _) => (Phase::Failed, why.clone()),
            (State::Landing, _) => (wire::phase(self.lander.phase()), self.reason(now_ns)),
        }
    }

    /// Why the autopilot's own landing gets no target: the reason for which our own guidance would not descend, and which the autopilot does not have.
    pub fn distrust(&self) -> Option<Reason> {
        self.landing_target?;
        let checks_disputes = self.config.phases.dispute_height_m > 0.0;
        let is_disputed = checks_disputes && self.frames.selection.dispute().is_some();
        let target = self.decision.and_then(|decision| decision.target);
        let is_ambiguous = target.is_some_and(|target| target.ambiguous);
        let dispute = is_disputed.then_some(Reason::Disputed);
        self.lander.mismatch().or(dispute).or(is_ambiguous.then_some(Reason::Ambiguous))
    }

    /// That an aborted landing leaves the vehicle where it may stand, with the reason for the abort.
    fn left_low(&self) -> Option<String> {
        let is_left = matches!(self.mission.state(), State::Landing) && self.lander.is_left_low();
        let decision = self.decision.filter(|_| is_left)?;
        Some(format!("{}: {LEFT_LOW}", decision.why))
    }

    /// Whether a landing was to be resumed, and the motors of a vehicle run that is said to stand.
    fn is_said_to_stand(&self) -> bool {
        self.config.start == Start::Resume
            && self.autopilot.state().is_some_and(|s| s.armed && s.landed == LandedState::OnGround)
    }

    /// The reason for the lander's phase.
    fn reason(&self, now_ns: i64) -> String {
        let is_blind = self.is_blind();
        let no_frame = self.no_frame(now_ns);
        let reason = self.decision.map(|decision| decision.why);
        let why = match (reason, no_frame) {
            // A detector that has searched nothing for long is forgotten by the selection, and is there all the same.
            (Some(Reason::NoDetector), Some(no_frame)) => format!("nothing descends: {no_frame}"),
            (_, Some(no_frame)) if is_blind => format!("nothing descends: {no_frame}"),
            _ if is_blind => return Reason::NoDetector.to_string(),
            (Some(reason), Some(no_frame)) if looks_for_marker(reason) => {
                format!("{reason}: {no_frame}")
            }
            (Some(reason), None) if looks_for_marker(reason) || is_refused(reason) => {
                match self.frames.unseen_because(now_ns) {
                    Some(unseen) if looks_for_marker(reason) => format!("{reason}: {unseen}"),
                    Some(unseen) => format!("nothing descends: {unseen}"),
                    None => reason.to_string(),
                }
            }
            (reason, _) => reason.map_or_else(String::new, |reason| reason.to_string()),
        };
        if let Some(reason) = self.cause() {
            return match self.lander.phase() {
                landing::Phase::Landed => format!("{why}: {reason}"),
                _ => format!("{reason}: {why}"),
            };
        }
        if let Some(left_low) = self.left_low() {
            return left_low;
        }
        if let Some(hovers) = self.hovers_after_abort(now_ns) {
            return format!("{why}; {hovers}");
        }
        let mode =
            self.pilots_mode.filter(|_| self.lander.phase() == landing::Phase::PilotInCommand);
        match (mode, self.chosen_mode) {
            (None, _) => why,
            (Some(mode), Some(chosen)) if chosen == mode => format!("{why}, in {mode}"),
            (Some(mode), Some(chosen))
                if self.autopilot.state().is_some_and(|state| state.mode == mode) =>
            {
                format!(
                    "a failsafe of the autopilot flies the vehicle, in {mode}: {chosen} is the mode that was chosen"
                )
            }
            (Some(mode), Some(chosen)) => format!(
                "a failsafe of the autopilot ended the landing, in {mode}: {chosen} was the mode that was chosen"
            ),
            // It may as well be a failsafe: when PX4 misses setpoints it holds.
            (Some(mode), None) => format!("{why} (or the autopilot's failsafe), in {mode}"),
        }
    }

    /// What a landing waits for that is to be resumed, and what happens to it then.
    fn resuming(&self, now_ns: i64) -> String {
        let conflict = self.autopilot.conflict(now_ns).map(|it| it.to_string());
        let obstacle = self.frames.obstacle(now_ns);
        let waits = match (&conflict, self.autopilot.state()) {
            (Some(conflict), _) => conflict,
            (None, None) => "waiting for the autopilot's heartbeat",
            (None, Some(_)) if !self.autopilot.has_listened(now_ns) => LISTENING,
            (None, Some(_)) => obstacle.as_deref().unwrap_or("waiting for the vehicle's state"),
        };
        let done = self.mission.when_resumed().and_then(what_happens);
        match done {
            Some(done) => {
                format!("{waits}; a landing under way is resumed then, and {done} at once")
            }
            None => format!("{waits}; a landing under way is resumed then"),
        }
    }

    /// How a PX4 hovers after an abort: by setpoints or in a mode of its own; `None` where its mode is not known now.
    fn hovers_after_abort(&self, now_ns: i64) -> Option<&'static str> {
        let is_aborted = self.lander.phase() == landing::Phase::Aborted;
        let state = self.autopilot.state().filter(|state| is_aborted && state.armed)?;
        // A mode from before the link was lost is not that of now.
        self.autopilot.mode_age_ns(now_ns).filter(|age_ns| *age_ns <= MAX_MODE_AGE_NS)?;
        if now_ns.saturating_sub(state.stamp_ns) > MAX_MODE_SILENCE_NS {
            return None;
        }
        match state.mode {
            _ if self.autopilot.may_return_to_offboard(now_ns) => Some(
                "in HOLD, and it returns to OFFBOARD with zero setpoints if that is its failsafe: not known yet",
            ),
            FlightMode::AUTO_HOLD => Some("in HOLD"),
            FlightMode::OFFBOARD => Some("in OFFBOARD, by setpoints"),
            _ => None,
        }
    }

    /// In LAND the vehicle descends without the marker.
    fn needs_marker(&self) -> bool {
        self.is_landing() && self.lander.phase() != landing::Phase::Final
    }

    /// Whether a landing needs the marker, and no detector is alive.
    fn is_blind(&self) -> bool {
        self.needs_marker() && self.frames.selection.is_blind()
    }

    /// Why the detectors get no frames, where a landing needs the marker.
    fn no_frame(&self, now_ns: i64) -> Option<String> {
        self.frames.camera_watch.no_frame(now_ns).filter(|_| self.needs_marker())
    }

    /// The cause of a landing away from the marker, once the decision's own reason no longer states it.
    fn cause(&self) -> Option<String> {
        let reason = self.lander.cause()?;
        let is_stated = self.decision.is_none_or(|decision| decision.why == reason);
        (!is_stated).then(|| match reason {
            Reason::OperatorLand => "the operator's command to land here".to_owned(),
            // The full text describes a hold.
            Reason::AutopilotLost => "autopilot link lost".to_owned(),
            reason => reason.to_string(),
        })
    }

    /// True once nothing more happens without a command.
    pub fn is_finished(&self) -> bool {
        let is_silent = self.decision.is_none_or(|decision| decision.action == Action::None);
        match self.mission.state() {
            State::Failed { .. } => true,
            State::Landing => self.lander.phase().is_terminal() && is_silent,
            State::SendingLandingTarget => {
                self.landing_target.is_none_or(LandingTargetMode::is_finished)
            }
            State::Idle
            | State::AwaitingTakeoff
            | State::TakingOff { .. }
            | State::TakingControl { .. }
            | State::LeavingOffboard { .. }
            | State::AskingForLand { .. } => false,
        }
    }

    /// True while a landing that began is held or aborted and continues only by a command.
    fn waits_for_operator(&self) -> bool {
        match (self.mission.state(), self.landing_target) {
            (State::Landing, _) => self.lander.waits_for_operator(),
            (State::SendingLandingTarget, Some(landing_target)) => landing_target.is_aborted(),
            _ => false,
        }
    }

    /// True from the beginning of a landing to its end.
    pub fn is_landing(&self) -> bool {
        match self.mission.state() {
            State::Landing => !self.lander.phase().is_terminal(),
            State::SendingLandingTarget => {
                self.landing_target.is_some_and(LandingTargetMode::is_active)
            }
            _ => false,
        }
    }

    /// The link to the autopilot, as text.
    fn link(&self) -> String {
        match (self.autopilot.system(), self.autopilot.is_connected()) {
            (Some(system), true) => {
                let mode = self.autopilot.state().map(|state| state.mode);
                let mode = mode.map_or_else(String::new, |mode| format!(" in {mode}"));
                format!("system {system}{mode}")
            }
            (Some(system), false) => {
                format!("system {system} is silent: check that it is on, and its cable or radio")
            }
            (None, _) => "no heartbeat yet: check that the autopilot is on, its cable, and `autopilot.address`".to_owned(),
        }
    }

    /// The estimate, unless no detection was used for so long that the next one begins another.
    fn present_target(&self, now_ns: i64) -> Option<landing::TargetEstimate> {
        let limit_ms = self.config.estimator.forget_after_s * 1e3;
        let is_present = self.detection_age_ms(now_ns).is_some_and(|age_ms| age_ms <= limit_ms);
        self.decision.and_then(|decision| decision.target).filter(|_| is_present)
    }

    fn detection_age_ms(&self, now_ns: i64) -> Option<f64> {
        self.used.stamp_ns.map(|stamp| now_ns.saturating_sub(stamp) as f64 * 1e-6)
    }
}

/// True for the reasons that say that the marker is seen, and not taken.
fn is_refused(reason: Reason) -> bool {
    matches!(reason, Reason::TargetRefused | Reason::RetryingRefused)
}

/// True for the reasons that say that the marker is not seen.
fn looks_for_marker(reason: Reason) -> bool {
    matches!(
        reason,
        Reason::Searching
            | Reason::TargetAging
            | Reason::TargetLost
            | Reason::TargetNotFound
            | Reason::Retrying
    )
}
