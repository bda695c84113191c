//! The operator's commands to a flight: start, hold, resume, abort and land here, carried out or refused with the reason.

use autopilot::{Conflict, LISTENING};
use landing::{Event as LanderEvent, OnAbort, OperatorCommand, Phase};

use super::Flight;
use crate::control::{is_held_px4, is_holding_px4, pilots_px4_mode};
use crate::landing_target;
use crate::mission::{START_FROM_HOLD, is_flying_guided, what_happens};
use crate::wire;

impl Flight {
    pub(super) fn start(&mut self, now_ns: i64) -> Result<String, String> {
        if self.is_landing() {
            let (phase, _) = self.view().phase(now_ns);
            return Err(format!("a landing is active, in phase `{phase}`"));
        }
        if self.mission.is_taking_off() && !self.holds_in_air(now_ns) {
            let is_held = self.mission.resume();
            let why = "the vehicle is taking off; the landing begins automatically".to_owned();
            return if is_held { Ok(why) } else { Err(why) };
        }
        if self.mission.is_taking_control() {
            return Err(format!("a start is under way: {}", self.view().phase(now_ns).1));
        }
        if self.mission.is_asking_for_land() {
            return Err("the vehicle is asked to land here".to_owned());
        }
        let of_vehicles = |it: &Conflict| matches!(it, Conflict::SeveralVehicles { .. });
        let conflict = self.autopilot.conflict(now_ns);
        if let Some(conflict) = conflict.filter(|it| !(self.is_ours() && of_vehicles(it))) {
            return Err(format!("no landing was started: {conflict}"));
        }
        self.check_way_out()?;
        if self.autopilot.state().and_then(wire::vehicle).is_none() {
            return Err(
                "no landing was started: attitude and position of the vehicle are not known"
                    .to_owned(),
            );
        }
        if self.is_listening(now_ns) {
            return Err(format!("no landing was started: {LISTENING}. Give the command again"));
        }
        if let Some(obstacle) = self.frames.start_obstacle(now_ns) {
            return Err(format!("no landing was started: {obstacle}"));
        }
        if self.landing_target.is_some() {
            return self.start_landing_target(now_ns);
        }
        if is_holding_px4(&self.autopilot) {
            self.mission.take_control(now_ns, &mut self.autopilot);
            return Ok(self.view().phase(now_ns).1);
        }
        if let Some(mode) = pilots_px4_mode(&self.autopilot) {
            return Err(format!(
                "no landing was started: the vehicle is in {mode}; change to HOLD, from which it is asked to follow setpoints"
            ));
        }
        let before = self.mission.clone();
        self.begin(now_ns);
        let (why, phase) = (self.why(), self.lander.phase());
        if phase.is_terminal() {
            self.mission = before;
            return Err(format!("no landing was started: {why}"));
        }
        Ok(format!("in phase `{phase}`: {why}"))
    }

    /// Whether a PX4 that took off and waits for its landing holds its place by choice: only a command leads it out of that.
    fn holds_in_air(&self, now_ns: i64) -> bool {
        self.mission.waits_in_air() && is_held_px4(now_ns, &self.autopilot)
    }

    /// Whether the vehicle took off for us, or has flown a landing of ours and its motors still run: a later program does not take the
    /// way down from it.
    fn is_ours(&self) -> bool {
        let is_armed = self.autopilot.state().is_some_and(|state| state.armed);
        self.mission.is_taking_off() || is_armed && self.mission.started_ns().is_some()
    }

    /// Whether this may be another vehicle than the one that is meant: a heartbeat of a second one on the link may still be due.
    fn is_listening(&self, now_ns: i64) -> bool {
        let is_found = self.autopilot.system().is_some();
        is_found && !self.is_ours() && !self.autopilot.has_listened(now_ns)
    }

    /// Refuses while a PX4 is taken back to HOLD.
    fn check_way_out(&self) -> Result<(), String> {
        let refusal = "the vehicle is just being taken back to HOLD";
        match self.mission.leaves_offboard_because() {
            Some(why) => Err(format!("{refusal}: {why}")),
            None if self.offboard.is_leading_out() => Err(refusal.to_owned()),
            None => Ok(()),
        }
    }

    fn start_landing_target(&mut self, now_ns: i64) -> Result<String, String> {
        if let Some(problem) = landing_target::problem(&self.autopilot) {
            return Err(problem);
        }
        if !is_flying_guided(&self.autopilot) && !is_holding_px4(&self.autopilot) {
            return Err(
                "the vehicle does not fly in a mode from which LAND may be requested (GUIDED; PX4: HOLD or OFFBOARD)"
                    .into(),
            );
        }
        if let Some(mismatch) = self.lander.mismatch() {
            // As after a hold for it, a second command of the operator repeats the check.
            self.lander.repeat_checks();
            return Err(format!("no landing was started: {mismatch}; a second start begins it"));
        }
        self.begin(now_ns);
        let (phase, why) = self.view().phase(now_ns);
        Ok(format!("in phase `{phase}`: {why}"))
    }

    /// Lands where the vehicle is. Without a landing, too: it needs no marker and no detector.
    pub(super) fn land_here(&mut self, now_ns: i64) -> Result<String, String> {
        if self.landing_target.is_some() {
            return Err(
                "the autopilot steers to the marker; abort, and land it by its own mode LAND"
                    .to_owned(),
            );
        }
        if self.is_landing() {
            return self.operator(now_ns, OperatorCommand::LandHere);
        }
        // PX4 climbs in a mode of its own.
        let may_land = is_flying_guided(&self.autopilot) || self.holds_in_air(now_ns);
        if self.mission.is_taking_off() && !may_land {
            let why = match self.mission.waits_in_air() {
                true => {
                    "the vehicle is not in a mode from which it can be landed yet; give the command again"
                }
                false => "the vehicle is taking off; land it once it is up",
            };
            return Err(why.to_owned());
        }
        let conflict = self.autopilot.conflict(now_ns).filter(|_| !self.is_ours());
        if let Some(conflict) = conflict {
            return Err(format!("not landed here: {conflict}"));
        }
        if self.is_listening(now_ns) {
            return Err(format!("not landed here: {LISTENING}. Give the command again"));
        }
        if is_holding_px4(&self.autopilot) {
            self.check_way_out()?;
            self.mission.ask_for_land(now_ns, &mut self.autopilot);
            let (phase, why) = self.view().phase(now_ns);
            return Ok(format!("in phase `{phase}`: {why}"));
        }
        self.begin_here(now_ns)
    }

    pub(super) fn begin_here(&mut self, now_ns: i64) -> Result<String, String> {
        let before = self.mission.clone();
        self.alarms.begin();
        self.mission.begin(now_ns, false);
        self.decide(now_ns, LanderEvent::Operator(OperatorCommand::LandHere));
        let (why, phase) = (self.why(), self.lander.phase());
        if phase.is_terminal() {
            self.mission = before;
            return Err(format!("not landed here: {why}"));
        }
        Ok(format!("in phase `{phase}`: {why}"))
    }

    pub(super) fn operator(
        &mut self,
        now_ns: i64,
        command: OperatorCommand,
    ) -> Result<String, String> {
        if command == OperatorCommand::Resume && self.holds_in_air(now_ns) {
            return Err(format!("the vehicle is in HOLD: {START_FROM_HOLD}"));
        }
        if command == OperatorCommand::Resume && self.mission.resume() {
            return Ok("the landing begins as soon as nothing else prevents it".to_owned());
        }
        if self.mission.is_taking_off() {
            if command == OperatorCommand::Resume {
                return Err("the vehicle is taking off; there is nothing to resume".to_owned());
            }
            let why = "aborted by the operator before the landing began; the vehicle is to hold its place";
            if self.mission.leave_offboard(now_ns, &mut self.autopilot, why) {
                return Ok(why.to_owned());
            }
            let why = match self.autopilot.state().filter(|_| self.mission.waits_in_air()) {
                Some(state) => format!(
                    "aborted by the operator before the landing began; the vehicle stays in {}",
                    state.mode
                ),
                None => "aborted by the operator; the autopilot completes the take-off".to_owned(),
            };
            self.mission.fail(&mut self.autopilot, why.clone());
            return Ok(why);
        }
        if self.mission.is_taking_control() {
            if command == OperatorCommand::Resume {
                return Err("the landing has not begun; there is nothing to resume".to_owned());
            }
            let why = "ended by the operator before the vehicle followed setpoints";
            self.mission.leave_offboard(now_ns, &mut self.autopilot, why);
            return Ok(why.to_owned());
        }
        if self.mission.is_asking_for_land() {
            if command == OperatorCommand::Resume {
                return Err("the vehicle is asked to land; there is nothing to resume".to_owned());
            }
            if self.mission.may_be_in_land(&self.autopilot) && !self.lander.may_recall() {
                return Err(format!(
                    "LAND was asked for already, and below {} m it is not interrupted; the pilot's mode switch stops it",
                    self.config.phases.no_return_height_m
                ));
            }
            let why = "ended by the operator before the vehicle landed";
            if self.mission.call_back_land(now_ns, &mut self.autopilot, why) {
                return Ok(format!(
                    "{why}; a LAND that it has taken already is called back to HOLD, and the pilot's mode switch stops it at once"
                ));
            }
            return Ok(why.to_owned());
        }
        if command == OperatorCommand::Abort {
            let why =
                "aborted by the operator: the landing that waited for a command does not begin";
            if self.mission.cancel(now_ns, &mut self.autopilot, why) {
                return Ok(why.to_owned());
            }
        }
        if !self.is_landing()
            && self.mission.is_resuming()
            && let Some(done) = what_happens(command)
        {
            self.mission.command_when_resumed(command);
            return Ok(format!(
                "the landing of an earlier controller is {done} as soon as it is resumed"
            ));
        }
        if !self.is_landing() {
            let (phase, _) = self.view().phase(now_ns);
            let start = match command {
                OperatorCommand::Resume => "; `start` begins one",
                _ => "",
            };
            return Err(format!("no landing is active (phase `{phase}`){start}"));
        }
        let no_return_m = self.config.phases.no_return_height_m;
        if let Some(landing_target) = &mut self.landing_target
            && self.mission.is_sending_landing_target()
        {
            if command == OperatorCommand::Resume {
                return Err("the autopilot steers; there is nothing to resume".to_owned());
            }
            let may_recall = self.lander.may_recall();
            return landing_target.abort(now_ns, may_recall, no_return_m, &mut self.autopilot);
        }
        let before = self.lander.phase();
        self.decide(now_ns, LanderEvent::Operator(command));
        let (why, after) = (self.why(), self.lander.phase());
        if before == after && command == OperatorCommand::Abort {
            return Err(format!(
                "the autopilot's landing is not interrupted: the vehicle is below {no_return_m} m, or an abort would land as well"
            ));
        }
        // Held already for another reason, it is held by the operator.
        let is_held = command == OperatorCommand::Hold && after == Phase::Hold;
        if before == after && !is_held {
            let instead = match (command, after) {
                (OperatorCommand::Hold, Phase::Final) => self.instead_of_hold(),
                _ => String::new(),
            };
            return Err(format!("no effect in phase `{after}`: {why}{instead}"));
        }
        let why = if after == Phase::Aborted { self.view().phase(now_ns).1 } else { why };
        Ok(format!("in phase `{after}`: {why}"))
    }

    /// Gives a landing that was just resumed the command that came before. False where there is none, or no landing.
    pub(super) fn follow_earlier_command(
        &mut self,
        now_ns: i64,
        command: Option<OperatorCommand>,
    ) -> bool {
        let begins = self.mission.is_sending_landing_target()
            || self.mission.is_landing() && !self.lander.phase().is_terminal();
        let Some(command) = command.filter(|_| begins) else { return false };
        match self.operator(now_ns, command) {
            Ok(why) => tracing::warn!(?command, "Given before the landing was resumed: {why}"),
            Err(why) => tracing::error!(?command, "Given before the landing was resumed: {why}"),
        }
        true
    }

    /// The commands that stop a vehicle in LAND, or about to enter it, where `hold` does not.
    fn instead_of_hold(&self) -> String {
        let phases = &self.config.phases;
        let no_return_m = phases.no_return_height_m;
        let pilot = "the pilot's mode switch stops it";
        if phases.on_abort == OnAbort::Land {
            return format!("; LAND is not held, and an abort lands as well; {pilot}");
        }
        if self.lander.may_recall() {
            return format!(
                "; LAND is not held: above {no_return_m} m `abort` takes the vehicle back from it; {pilot} at any height"
            );
        }
        format!("; below {no_return_m} m LAND is neither held nor aborted; {pilot}")
    }
}
