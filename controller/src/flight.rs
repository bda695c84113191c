//! One vehicle's flight, a state machine without input and output: packets, detections, camera information, commands and ticks
//! in; setpoints, mode requests, landing targets, status and warnings out.
//!
//! The service feeds it packets, detections, commands and the time, and sends the packets that
//! [`Flight::poll_outgoing`] returns.

mod commands;
mod targets;

use std::sync::Arc;
use std::time::Duration;

use autopilot::dialect::{MavMessage, MavType};
use autopilot::{Autopilot, Event, FlightMode, LISTENING, LandedState, MIN_STANDSTILL_NS, Packet};
use geometry::{Ned, Vector};
use landing::{
    Action, Alarm, AlarmAction, Decision, Event as LanderEvent, FrameObservation, Lander,
    MAX_STANDSTILL_S, OperatorCommand, Phase, Reason, Rejection, Timestamp,
};
use messages::{
    CameraInfo, CommandReply, ControllerCommand, ControllerStatus, Detections, DetectorInfo,
    TargetEstimate,
};
use node::HealthCounters;

use crate::alarms::{self, Alarms};
use crate::cameras::Reception;
use crate::config::{Config, Mode, Start};
use crate::control::{is_holding_px4, needs_setpoints};
use crate::frames::{Arrival, Frames};
use crate::journal::Journal;
use crate::landing_target::{self, LandingTargetMode, Situation};
use crate::limits::{Limits, Note};
use crate::link_delay::LinkDelay;
use crate::mission::{Conditions, Mission, Trigger, is_flying_guided};
use crate::offboard_watch::OffboardWatch;
use crate::pad_note::{PadNote, PadNotes};
use crate::setpoints::Setpoints;
use crate::status::{Used, View};
use crate::wind::WindEstimate;
use crate::wire;

/// A flight.
pub struct Flight {
    config: Config,
    autopilot: Autopilot,
    lander: Lander,
    decision: Option<Decision>,
    /// How many decisions there were.
    decisions: u64,
    /// Whether a detector is alive, as the lander received it last.
    detectors_alive: bool,
    link_delay: LinkDelay,
    mission: Mission,
    frames: Frames,
    used: Used,
    setpoints: Setpoints,
    offboard: OffboardWatch,
    /// The autopilot's own precision landing, where that steers.
    landing_target: Option<LandingTargetMode>,
    limits: Limits,
    pad_notes: PadNotes,
    alarms: Alarms,
    wind: WindEstimate,
    journal: Journal,
    /// The service ends: nothing but a stop is sent any more.
    is_ending: bool,
    /// Two detectors see the marker at two places or with two headings.
    is_disputed: bool,
    /// Since when a take-off waits for a battery that is not empty.
    empty_since_ns: Option<i64>,
    /// The time of the last tick.
    ticked_ns: Option<i64>,
    /// The mode that ended the last landing as the pilot's, and the one that was chosen then, where the vehicle reports that.
    pilots_mode: Option<FlightMode>,
    chosen_mode: Option<FlightMode>,
}

impl Flight {
    /// A flight that has not begun.
    ///
    /// # Errors
    /// When the lander refuses its settings.
    pub fn new(config: Config, health: Arc<HealthCounters>) -> anyhow::Result<Self> {
        let is_autopilots = config.mode == Mode::LandingTarget;
        let settings = &config.autopilot;
        let parameters =
            if is_autopilots { landing_target::PARAMETERS.to_vec() } else { Vec::new() };
        let autopilot = Autopilot::new(autopilot::Config {
            system_id: config.system_id(),
            our_component: settings.component_id,
            streams: autopilot::config::default_streams(settings.state_rate_hz),
            parameters,
            timesync: settings.timesync,
            ..autopilot::Config::default()
        });
        Ok(Self {
            autopilot,
            lander: Lander::new(config.lander())?,
            decision: None,
            decisions: 0,
            detectors_alive: true,
            link_delay: LinkDelay::default(),
            mission: Mission::new(config.start, config.takeoff()),
            frames: Frames::new(&config),
            used: Used::default(),
            setpoints: Setpoints::new(
                settings.setpoint_rate_hz,
                Duration::from_secs_f64(config.phases.stale_vehicle_s),
                Duration::from_secs_f64(config.phases.land_retry_s),
            ),
            offboard: OffboardWatch::default(),
            landing_target: is_autopilots.then(|| {
                LandingTargetMode::new(config.landing_target, config.phases.search_timeout_s)
            }),
            limits: Limits::new(settings.address.clone(), settings.setpoint_timeout_s),
            pad_notes: PadNotes::default(),
            alarms: Alarms::new(config.alarms),
            wind: WindEstimate::default(),
            journal: Journal::new(health),
            is_ending: false,
            is_disputed: false,
            empty_since_ns: None,
            ticked_ns: None,
            pilots_mode: None,
            chosen_mode: None,
            config,
        })
    }

    /// Handles a packet from the autopilot's link.
    pub fn packet(&mut self, now_ns: i64, packet: &Packet) {
        self.ground_packet(now_ns, packet);
        self.stop_before_resuming(now_ns, packet);
        self.autopilot.handle(now_ns, packet);
        self.handle_autopilot_events(now_ns);
    }

    /// Stops a vehicle whose landing is to be resumed, from the first packet of its autopilot on: the heartbeat with
    /// the rest may be a second away. A PX4 that holds its place as the setpoints of the earlier controller ended follows again; one that a
    /// pilot has switched ignores it.
    fn stop_before_resuming(&mut self, now_ns: i64, packet: &Packet) {
        let pinned = self.config.autopilot.system_id;
        let is_vehicle = packet.sender.component == autopilot::packet::AUTOPILOT
            && packet.message.is_some()
            && (pinned == 0 || packet.sender.system == pinned);
        if self.config.start == Start::Resume && is_vehicle && self.autopilot.state().is_none() {
            self.setpoints.stop_unknown(now_ns, packet.sender.system, &mut self.autopilot);
        }
    }

    /// Handles a packet that the ground station sends to the autopilot through us.
    pub fn ground_packet(&mut self, now_ns: i64, packet: &Packet) {
        if self.is_of_ground_station(packet) {
            self.alarms.operator_active(now_ns);
        }
    }

    /// Whether a packet is a ground station's heartbeat. Programs on the vehicle may claim to be one, too, and continue when no ground station is
    /// there any more: they have the vehicle's system id, which a ground station never has.
    fn is_of_ground_station(&self, packet: &Packet) -> bool {
        let Some(MavMessage::HEARTBEAT(heartbeat)) = &packet.message else { return false };
        let system = packet.sender.system;
        let is_on_vehicle = system == self.autopilot.our_address().system
            || Some(system) == self.autopilot.system();
        heartbeat.mavtype == MavType::MAV_TYPE_GCS && !is_on_vehicle
    }

    /// Lets time pass; to be called at least 20 times a second.
    pub fn tick(&mut self, now_ns: i64) {
        self.notice_standstill(now_ns);
        self.autopilot.tick(now_ns);
        self.handle_autopilot_events(now_ns);
        self.frames.tick(now_ns);
        self.use_newest(now_ns);
        self.send_predicted_target(now_ns);
        self.follow_warnings(now_ns);
        if self.is_landing() {
            let is_fresh = self.frames.age_s(now_ns) <= self.config.detectors.max_age_s;
            self.journal.tick(is_fresh, self.frames.selection.has_newer());
        }
        self.advance_mission(now_ns);
        self.follow_limits(now_ns);
        self.note_pad();
        self.check_alarms(now_ns);
        if let Some(delay_s) = self.link_delay.step(now_ns, &self.autopilot) {
            self.decide(now_ns, LanderEvent::LinkDelay(delay_s));
        }
        self.decide(now_ns, LanderEvent::Tick);
        self.watch_offboard(now_ns);
    }

    /// After a standstill of this process for which a landing would be held, what was to begin waits for a command as well.
    fn notice_standstill(&mut self, now_ns: i64) {
        let before_ns = self.ticked_ns.replace(now_ns).unwrap_or(now_ns);
        let stood_ns = now_ns.saturating_sub(before_ns);
        self.frames.follow(now_ns);
        if stood_ns > MIN_STANDSTILL_NS {
            self.alarms.stood_still(now_ns, stood_ns);
        }
        let stood_s = stood_ns as f64 * 1e-9;
        if stood_s <= MAX_STANDSTILL_S {
            return;
        }
        let is_active = self.is_landing();
        self.mission.stand_still(now_ns, &mut self.autopilot, stood_s, is_active);
        if let Some(landing_target) = &mut self.landing_target {
            landing_target.stand_still(stood_s, &mut self.autopilot);
        }
    }

    /// Leads a PX4 out of OFFBOARD that is left there while nothing steers it.
    fn watch_offboard(&mut self, now_ns: i64) {
        if self.is_steering() {
            self.offboard.stand_down();
        } else if !self.is_ending {
            self.offboard.step(now_ns, &mut self.autopilot);
        }
    }

    /// Whether a part of this flight steers the vehicle, or is to.
    fn is_steering(&self) -> bool {
        if self.mission.is_landing() {
            return self.decision.is_some_and(|decision| {
                !decision.phase.is_terminal() || decision.action != Action::None
            });
        }
        self.mission.is_taking_off()
            || self.mission.is_taking_control()
            || self.mission.is_asking_for_land()
            || self.mission.leaves_offboard_because().is_some()
            || self.landing_target.as_ref().is_some_and(LandingTargetMode::is_active)
    }

    /// Reads the autopilot's limits, and has its setpoint timeout shortened while our setpoints land it.
    fn follow_limits(&mut self, now_ns: i64) {
        let is_landing = self.is_landing() && self.landing_target.is_none();
        if let Some(limits) = self.limits.step(now_ns, is_landing, &mut self.autopilot) {
            self.decide(now_ns, LanderEvent::Limits(limits));
        }
    }

    /// The autopilot's parameters to restore; `None` if there are none.
    pub fn note(&self) -> Option<&Note> {
        self.limits.note()
    }

    /// Takes over the parameters that an earlier controller left to restore.
    pub fn take_over(&mut self, note: Note) {
        self.limits.take_over(note);
    }

    /// Where the pad is, for the controller that is started next; `None` when it need not know.
    pub fn pad_note(&self) -> Option<&PadNote> {
        self.pad_notes.note()
    }

    /// Takes over the pad's place from an earlier controller, for a landing that is resumed.
    pub fn take_over_pad(&mut self, note: PadNote) {
        self.pad_notes.take_over(note);
    }

    /// The system id of the vehicle that is landed, or whose landing is to be resumed, for the controller that is started next.
    pub fn landed_system(&self) -> Option<u8> {
        if self.is_landing() {
            return self.autopilot.system();
        }
        let resumes = self.config.start == Start::Resume && self.mission.is_awaiting_takeoff();
        self.config.system_id().filter(|_| resumes)
    }

    fn note_pad(&mut self) {
        let is_landing = self.is_landing() && self.landing_target.is_none();
        let seen = self.lander.pad_to_remember();
        let address = &self.config.autopilot.address;
        self.pad_notes.step(is_landing, seen, address, self.autopilot.system());
    }

    /// Logs the warnings for the operator, and passes a dispute between detectors to the lander.
    fn follow_warnings(&mut self, now_ns: i64) {
        let warnings = self.view().warnings(now_ns);
        self.journal.warnings(now_ns, &warnings);
        let is_disputed = self.frames.selection.dispute().is_some();
        if is_disputed != self.is_disputed {
            self.is_disputed = is_disputed;
            self.decide(now_ns, LanderEvent::Dispute(is_disputed));
        }
    }

    /// Passes alarms to the lander while it lands, or while a landing waits in the air: after our take-off, or one that is to be resumed.
    fn check_alarms(&mut self, now_ns: i64) {
        let waits_to_resume = self.mission.waits_to_resume();
        let waits = self.mission.waits_in_air() || waits_to_resume;
        let waits_in_air = waits && self.landing_target.is_none();
        let is_landing = self.is_landing() && !self.mission.is_sending_landing_target();
        if !is_landing && !waits_in_air {
            return;
        }
        let battery = self.autopilot.state().map(|state| state.battery);
        let Some(alarm) = self.alarms.tick(now_ns, battery.as_ref()) else { return };
        if !self.alarms.is_postponed(alarm) {
            self.journal.alarm(alarm);
        }
        if waits_in_air {
            let phases = &self.config.phases;
            let is_to_land = match alarm {
                Alarm::BatteryCritical => phases.on_battery_critical == AlarmAction::Land,
                Alarm::BatteryLow => phases.on_battery_low == AlarmAction::Land,
                Alarm::AutopilotLost | Alarm::OperatorLost => false,
            };
            if !is_to_land {
                return;
            }
            // A PX4 that holds as setpoints were missing returns within a second; one that a pilot holds is the pilot's. One that did not take
            // off for us may be another controller's.
            let may_be_others = waits_to_resume
                && (self.autopilot.conflict(now_ns).is_some()
                    || !self.autopilot.has_listened(now_ns));
            // Without a fresh state the lander refuses to begin.
            if may_be_others || !self.is_state_fresh(now_ns) || !is_flying_guided(&self.autopilot) {
                self.alarms.postpone(alarm);
                return;
            }
            // It lands at once, whatever keeps it from being led to a marker.
            let (before, alarms) = (self.mission.clone(), self.alarms.clone());
            if waits_to_resume {
                self.resume_lander();
            }
            self.begin(now_ns);
            if self.lander.phase().is_terminal() {
                (self.mission, self.alarms) = (before, alarms);
                self.alarms.postpone(alarm);
                return;
            }
        }
        self.decide(now_ns, LanderEvent::Alarm(alarm));
    }

    /// Handles the detections that were published on the key of the detector `publisher`. True when a frame
    /// was used or these detections were refused, and so the target is to be published; false when they wait, as those of a detector on
    /// standby do, or when detections of such a detector were refused.
    pub fn detections(&mut self, now_ns: i64, publisher: &str, message: &Detections) -> bool {
        self.journal.count("detections");
        match self.frames.add(now_ns, publisher, message) {
            Arrival::Refused(reason) => return self.refuse(publisher, reason),
            Arrival::Late(frame) => {
                self.journal.count("late frames");
                self.decide(now_ns, LanderEvent::Frame(frame));
                if let Some(rejection) = self.decision.and_then(|decision| decision.rejected) {
                    self.journal.reject_late(rejection.name());
                }
            }
            Arrival::Kept => {}
        }
        self.use_newest(now_ns)
    }

    /// Counts refused detections. True if they are of the detector in use, or none is in use: the reason for another one has nothing to do with
    /// the target.
    fn refuse(&mut self, publisher: &str, reason: &str) -> bool {
        let active = self.frames.selection.active();
        let is_in_use = active.is_none_or(|active| active == publisher);
        if is_in_use {
            self.journal.reject(reason);
        } else {
            self.journal.reject_unused(reason);
        }
        is_in_use
    }

    /// Gives the lander the next frame, if there is one, and reports a change of the active detector.
    fn use_newest(&mut self, now_ns: i64) -> bool {
        let next = self.frames.take_next();
        if let Some(frame) = next.frame {
            self.frame(now_ns, frame);
        }
        if next.is_handover {
            let selection = &self.frames.selection;
            self.journal.detector_changed(selection.active().unwrap_or_default(), selection.why());
        }
        next.frame.is_some()
    }

    fn frame(&mut self, now_ns: i64, frame: FrameObservation) {
        let stamp_ns = frame.stamp.nanos();
        let sent_before_ns = self.setpoints.sent_ns();
        self.decide(now_ns, LanderEvent::Frame(frame));
        self.journal.accept();
        if let Some(rejection) = self.decision.and_then(|decision| decision.rejected) {
            self.journal.reject(rejection.name());
            if rejection == Rejection::RepeatedPicture {
                self.frames.repeats_picture(now_ns);
            }
            return;
        }
        if frame.marker.is_none() {
            return;
        }
        self.used.count += u64::from(self.is_landing());
        self.used.stamp_ns = Some(stamp_ns);
        self.send_landing_target(now_ns, &frame);
        if self.setpoints.sent_ns() != sent_before_ns {
            self.journal.used_frame(now_ns, stamp_ns);
        }
    }

    /// Handles a camera's calibration and mount.
    pub fn camera(&mut self, now_ns: i64, info: CameraInfo) {
        let camera = info.camera.clone();
        match self.frames.add_camera(now_ns, info, self.is_landing()) {
            Reception::Known => {}
            Reception::Replaced(difference) => {
                self.journal.camera_replaced(&camera, &difference);
                // It may be mounted rightly now.
                self.lander.repeat_checks();
            }
            Reception::Refused(reason, _) => self.journal.reject_camera(reason),
        }
    }

    /// Messages of another version were refused.
    pub fn refused_version(&mut self, now_ns: i64) {
        self.frames.refused_version(now_ns);
    }

    /// A detector came or went.
    pub fn presence(&mut self, now_ns: i64, detector: &str, alive: bool) {
        self.frames.presence(now_ns, detector, alive);
        self.use_newest(now_ns);
    }

    /// Handles the information that was published on the key of the detector `publisher`.
    pub fn on_detector_info(&mut self, now_ns: i64, publisher: &str, info: &DetectorInfo) {
        if info.detector != publisher {
            self.refuse(publisher, "another-detectors-name");
            return;
        }
        self.frames.on_detector_info(now_ns, publisher, info);
        self.use_newest(now_ns);
    }

    /// Carries out an operator's command, or refuses it with the reason.
    pub fn command(&mut self, now_ns: i64, command: &ControllerCommand) -> CommandReply {
        self.alarms.operator_active(now_ns);
        self.frames.follow(now_ns);
        let selection = &mut self.frames.selection;
        let result = match command {
            ControllerCommand::Start => self.start(now_ns),
            ControllerCommand::Hold => self.operator(now_ns, OperatorCommand::Hold),
            ControllerCommand::Resume => self.operator(now_ns, OperatorCommand::Resume),
            ControllerCommand::Abort => self.operator(now_ns, OperatorCommand::Abort),
            ControllerCommand::LandHere => self.land_here(now_ns),
            ControllerCommand::UseDetector(name) => selection.prefer(now_ns, name),
            ControllerCommand::PreferDetectors(place) => Ok(selection.prefer_place(now_ns, *place)),
            ControllerCommand::PreferAnyDetector => Ok(selection.prefer_any(now_ns)),
        };
        self.use_newest(now_ns);
        match result {
            Ok(reason) => CommandReply { accepted: true, reason },
            Err(reason) => CommandReply { accepted: false, reason },
        }
    }

    /// Stops the vehicle where it is: without a last setpoint it would stop only after its setpoint timeout, which
    /// is put back. True while the autopilot has not confirmed that, or a PX4 may be in OFFBOARD.
    pub fn shutdown(&mut self, now_ns: i64) -> bool {
        if !std::mem::replace(&mut self.is_ending, true) {
            let result = self.setpoints.stop(now_ns, &mut self.autopilot);
            self.log_setpoint(result);
        }
        let why = "the controller was ended";
        let leaves = self.mission.leave_offboard(now_ns, &mut self.autopilot, why);
        if self.mission.is_taking_off() {
            // Nothing that it has asked for may start the motors now.
            self.mission.fail(&mut self.autopilot, why.to_owned());
        }
        let waits = self.setpoints.end(now_ns, &mut self.autopilot);
        // A landing that is not over has been ended by its setpoints.
        let is_over = !self.mission.is_landing() || self.lander.phase().is_terminal();
        let waits = waits || !leaves && is_over && self.offboard.end(now_ns, &mut self.autopilot);
        let is_pending = self.limits.restore(&mut self.autopilot);
        self.autopilot.tick(now_ns);
        is_pending || leaves || waits
    }

    /// The next packet for the autopilot.
    pub fn poll_outgoing(&mut self) -> Option<Vec<u8>> {
        self.autopilot.poll_outgoing()
    }

    /// The lander's latest decision.
    pub fn decision(&self) -> Option<&Decision> {
        self.decision.as_ref()
    }

    /// How many decisions there were; another number may come with the same decision.
    pub(crate) fn decisions(&self) -> u64 {
        self.decisions
    }

    /// The link's delay that the landing reckons with, both ways together, in seconds; 0 until it is known or given up.
    pub fn link_delay_s(&self) -> f64 {
        self.link_delay.seconds()
    }

    /// The detector in use.
    pub fn active_detector(&self) -> Option<&str> {
        self.frames.selection.active()
    }

    /// The vehicle's system id; none before it is found.
    pub fn system(&self) -> Option<u8> {
        self.autopilot.system()
    }

    /// The vehicle's state, once attitude and position are known.
    pub fn vehicle(&self) -> Option<messages::VehicleState> {
        wire::vehicle_message(self.autopilot.state()?)
    }

    /// The estimate of the landing point.
    pub fn target(&self, now_ns: i64) -> TargetEstimate {
        self.view().target(now_ns)
    }

    /// Whether the last tick is so long ago that this process stood still: what was missing in that time is not known before the next one.
    pub fn has_stood_still(&self, now_ns: i64) -> bool {
        self.ticked_ns.is_some_and(|at_ns| now_ns.saturating_sub(at_ns) > MIN_STANDSTILL_NS)
    }

    /// The phase and its reason, and all else of the status.
    pub fn status(&self, now_ns: i64) -> ControllerStatus {
        self.view().status(now_ns)
    }

    fn view(&self) -> View<'_> {
        View {
            config: &self.config,
            autopilot: &self.autopilot,
            lander: &self.lander,
            decision: self.decision,
            mission: &self.mission,
            landing_target: self.landing_target.as_ref(),
            frames: &self.frames,
            journal: &self.journal,
            setpoint: self.setpoints.last(),
            leads_out: self.leads_out(),
            pilots_mode: self.pilots_mode,
            chosen_mode: self.chosen_mode,
            used: self.used,
            wind_ned_m_s: self.wind.velocity_m_s(self.config.autopilot.drag()),
        }
    }

    /// Whether a PX4 that may be in OFFBOARD after a landing is led out of it, or is about to be.
    fn leads_out(&self) -> bool {
        let is_over = self.mission.is_landing() && self.lander.phase().is_terminal();
        is_over
            && (self.setpoints.is_leaving()
                || self.offboard.is_due(self.ticked_ns.unwrap_or_default(), &self.autopilot))
    }

    fn is_landing(&self) -> bool {
        self.view().is_landing()
    }

    /// The reason for the lander's latest decision.
    fn why(&self) -> String {
        self.decision.map_or_else(String::new, |decision| decision.why.to_string())
    }

    fn begin(&mut self, now_ns: i64) {
        self.alarms.begin();
        self.mission.begin(now_ns, self.landing_target.is_some());
        match &mut self.landing_target {
            Some(landing_target) => landing_target.begin(now_ns, is_holding_px4(&self.autopilot)),
            None => self.decide(now_ns, LanderEvent::Operator(OperatorCommand::Start)),
        }
    }

    /// The next landing of the lander is one that an earlier controller began.
    fn resume_lander(&mut self) {
        let address = &self.config.autopilot.address;
        self.lander.resume(self.pad_notes.pad(address, self.autopilot.system()));
    }

    fn advance_mission(&mut self, now_ns: i64) {
        let may_recall = self.lander.may_recall();
        let back = self.back_to_wait(now_ns);
        let situation = Situation {
            back,
            may_recall,
            distrust: self.view().distrust(),
            is_flying: self.lander.is_flying(),
            is_awaiting_state: self.lander.is_awaiting_state(),
        };
        let earlier = self.mission.when_resumed();
        if let Some(landing_target) = &mut self.landing_target
            && landing_target.step(now_ns, situation, &mut self.autopilot)
            && !self.mission.is_sending_landing_target()
        {
            // Another station or the pilot began it; it is followed like our own.
            self.mission.begin(now_ns, true);
            if self.follow_earlier_command(now_ns, earlier) {
                return;
            }
        }
        if !may_recall {
            self.mission.leave_in_land(&mut self.autopilot);
        }
        let is_leading_out = self.offboard.is_leading_out();
        if is_leading_out || self.waits_for_battery(now_ns) || self.waits_for_detector(now_ns) {
            return;
        }
        // The lander refuses a start without a fresh state, and the mission would not try again.
        let is_fresh = self.is_state_fresh(now_ns);
        // A landing that would see no marker waits, with the reason in the status. So does that of a vehicle that another controller may fly,
        // or that may be the wrong one; a vehicle that took off for us is ours.
        let begins_by_itself = self.mission.is_awaiting_takeoff();
        let conflict = self.autopilot.conflict(now_ns).filter(|_| begins_by_itself);
        let obstacle = match (conflict, self.mission.held_because()) {
            (Some(conflict), _) => Some(conflict.to_string()),
            (None, Some(why)) => Some(why.to_owned()),
            (None, None) if begins_by_itself && !self.autopilot.has_listened(now_ns) => {
                Some(LISTENING.to_owned())
            }
            (None, None) if is_fresh => self.frames.obstacle(now_ns),
            (None, None) => Some("waiting for attitude and position".to_owned()),
        };
        let conditions = Conditions {
            is_fresh,
            obstacle: obstacle.as_deref(),
            steers: self.landing_target.is_none(),
            back,
        };
        let trigger = self.mission.step(now_ns, &mut self.autopilot, conditions);
        let Some(trigger) = trigger else { return };
        if trigger == Trigger::LandsHere {
            if let Err(why) = self.begin_here(now_ns) {
                self.mission.fail(&mut self.autopilot, why);
            }
            return;
        }
        let before = (trigger == Trigger::InControl).then(|| self.mission.clone());
        let resumes = trigger == Trigger::InFlight && self.config.start == Start::Resume;
        if resumes {
            self.resume_lander();
        }
        self.begin(now_ns);
        if self.follow_earlier_command(now_ns, earlier.filter(|_| resumes)) {
            return;
        }
        if !self.mission.is_landing() {
            return;
        }
        match (trigger, self.lander.phase()) {
            // The pilot's own landing is not ours while it is high; the next flight may be.
            (Trigger::InFlight, phase) if phase.is_terminal() => {
                let (why, kept) = (self.why(), earlier.filter(|_| resumes));
                self.mission.skip(&mut self.autopilot, kept, &why);
            }
            (Trigger::ArmedAgain, phase) if phase.is_terminal() => self.mission.stay_landed(),
            // The mode may be newer than the state that the lander has.
            (Trigger::TakenOff, Phase::Idle) => self.mission.stand_down(true),
            (Trigger::InControl, phase) if phase.is_terminal() => {
                if let Some(before) = before {
                    self.mission = before;
                }
            }
            _ => {}
        }
    }

    /// The velocity that leads a PX4 that waits for its landing in OFFBOARD back to where it waits: to where it was when our setpoints for
    /// that began.
    fn back_to_wait(&mut self, now_ns: i64) -> Vector<Ned> {
        let waits = !self.mission.is_landing() && self.autopilot.is_sent_hover(now_ns);
        if !waits || !needs_setpoints(now_ns, &self.autopilot) {
            self.lander.end_wait();
            return Vector::zero();
        }
        self.lander.back_to_wait(Timestamp::from_nanos(now_ns))
    }

    /// Whether attitude and position of the vehicle are as new as the lander requires.
    fn is_state_fresh(&self, now_ns: i64) -> bool {
        self.autopilot.state().and_then(wire::vehicle).is_some_and(|state| {
            let age_s = Timestamp::from_nanos(now_ns).seconds_since(state.stamp);
            age_s <= self.config.phases.stale_vehicle_s
        })
    }

    /// A take-off does not begin with a battery for which the vehicle would land at once, and is refused where that persists. True while it
    /// waits for another reading.
    fn waits_for_battery(&mut self, now_ns: i64) -> bool {
        let phases = &self.config.phases;
        let would_end =
            matches!(phases.on_battery_critical, AlarmAction::Land | AlarmAction::Abort);
        let standing = self.autopilot.state().filter(|state| !state.armed && would_end);
        let standing = standing.filter(|_| self.mission.is_taking_off());
        let why = standing.and_then(|it| alarms::too_empty(&self.config.alarms, &it.battery));
        let Some(why) = why else {
            self.empty_since_ns = None;
            return false;
        };
        let since_ns = *self.empty_since_ns.get_or_insert(now_ns);
        if now_ns.saturating_sub(since_ns) as f64 * 1e-9 >= self.config.alarms.battery_s {
            tracing::error!("{why}");
            self.mission.fail(&mut self.autopilot, why);
        }
        true
    }

    /// A take-off does not begin while no detector looks for the marker. True while it waits for one.
    fn waits_for_detector(&mut self, now_ns: i64) -> bool {
        let why = self.frames.no_detector_looks_for_marker();
        why.is_some_and(|why| self.mission.put_off(now_ns, &mut self.autopilot, why))
    }

    fn handle_autopilot_events(&mut self, now_ns: i64) {
        while let Some(event) = self.autopilot.poll_event() {
            self.journal.autopilot(&event);
            match event {
                Event::State(state) => {
                    self.alarms.autopilot_active(now_ns);
                    if let Some(mut vehicle) = wire::vehicle(&state) {
                        vehicle.mode = self.known_mode(now_ns, vehicle.mode);
                        if state.landed == LandedState::InAir {
                            self.wind.update(&vehicle);
                        }
                        self.decide(now_ns, LanderEvent::Vehicle(vehicle));
                    }
                }
                Event::Found { .. } => self.limits.found(&mut self.autopilot),
                Event::Status(state) => {
                    let mut status = wire::vehicle_status(&state);
                    status.mode = self.known_mode(now_ns, status.mode);
                    self.decide(now_ns, LanderEvent::Status(status));
                }
                Event::ModeChanged { to, .. } => self.withdraw_from(to),
                Event::ArmedChanged(armed) => {
                    let is_finished = self.view().is_finished();
                    let why = self.decision.map(|decision| decision.why);
                    let by_motors = matches!(
                        why,
                        Some(Reason::TouchedDown | Reason::Disarmed | Reason::StoppedInAir)
                    );
                    self.mission.armed_changed(now_ns, armed, is_finished, by_motors);
                }
                Event::Restarted { started_ns }
                    if self.mission.started_ns().is_some() && !self.was_over_at(started_ns) =>
                {
                    let why = "the autopilot restarted in flight".to_owned();
                    self.mission.fail(&mut self.autopilot, why);
                    // Its further decisions would precede the next start.
                    self.lander.stand_down();
                }
                _ => {}
            }
        }
    }

    /// The mode for the lander: unknown while a PX4 that shows HOLD may return to OFFBOARD automatically.
    fn known_mode(&self, now_ns: i64, mode: landing::Mode) -> landing::Mode {
        match self.autopilot.may_return_to_offboard(now_ns) {
            true => landing::Mode::Unknown,
            false => mode,
        }
    }

    /// True after a landing whose motors were off before this time. An autopilot that restarts in flight reports motors that are off as well, but only then.
    fn was_over_at(&self, time_ns: i64) -> bool {
        let is_off = self.autopilot.state().is_some_and(|state| !state.armed);
        let was_off = self.mission.disarmed_ns().is_none_or(|off_ns| off_ns < time_ns);
        self.view().is_finished() && is_off && was_off
    }

    /// The pilot has taken over: earlier requests are not repeated against the pilot. A take-off passes
    /// through modes of its own, and looks after its requests itself.
    fn withdraw_from(&mut self, mode: FlightMode) {
        if !mode.is_guided() && !mode.is_landing() && !self.mission.is_taking_off() {
            self.autopilot.withdraw();
        }
    }

    fn decide(&mut self, now_ns: i64, event: LanderEvent) {
        let alive = !self.frames.selection.is_blind();
        if std::mem::replace(&mut self.detectors_alive, alive) != alive {
            self.step(now_ns, LanderEvent::DetectorsAlive(alive));
        }
        self.step(now_ns, event);
    }

    fn step(&mut self, now_ns: i64, event: LanderEvent) {
        let (before, was_recalling) = (self.lander.phase(), self.lander.is_recalling());
        let decision = self.lander.step(Timestamp::from_nanos(now_ns), event);
        if decision.phase != before {
            self.journal.phase_changed(before, &decision);
            if decision.phase == Phase::PilotInCommand {
                self.pilots_mode = self.autopilot.state().map(|state| state.mode);
                self.chosen_mode = None;
            }
        }
        // The report may follow the heartbeat that shows the mode.
        if decision.phase == Phase::PilotInCommand {
            let chosen = self.pilots_mode.and_then(|mode| self.autopilot.chosen_mode_in(mode));
            self.chosen_mode = self.chosen_mode.or(chosen);
        }
        // A LAND that was lost on the way must not be repeated after the pilot took over, nor GUIDED on the ground.
        if decision.phase != before || was_recalling && !self.lander.is_recalling() {
            self.autopilot.withdraw();
        }
        self.decision = Some(decision);
        self.decisions += 1;
        if !self.mission.is_landing() || self.is_ending {
            return;
        }
        let is_urgent = matches!(event, LanderEvent::Frame(_) | LanderEvent::DetectorsAlive(_));
        let result = self.setpoints.carry_out(now_ns, &decision, is_urgent, &mut self.autopilot);
        self.log_setpoint(result);
    }

    fn log_setpoint(&self, result: Option<Result<(), autopilot::command::SetpointError>>) {
        match result {
            // LAND was requested and has just begun.
            Some(Err(_)) if self.lander.phase() == Phase::Final => {}
            Some(result) => self.journal.setpoint(result),
            None => {}
        }
    }
}
