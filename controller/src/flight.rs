//! One vehicle's flight: everything that is heard goes in, everything that is to be said comes out.
//!
//! No network and no waiting here: the service feeds packets, detections, commands and the time, and sends what
//! [`Flight::poll_outgoing`] returns.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

use autopilot::dialect::{MavMessage, MavType};
use autopilot::{
    Autopilot, Command, CommandId, CommandStatus, Event, Firmware, FlightMode, Packet, Takeoff,
    TakeoffError, TakeoffProgress,
};
use geometry::Vector;
use landing::{
    Action, Decision, Event as LanderEvent, Lander, OperatorCommand, Phase as LanderPhase,
    Timestamp,
};
use messages::{
    CameraInfo, CommandReply, ControllerCommand, ControllerStatus, Detections, DetectorInfo, Phase,
    Place, Setpoint, TargetEstimate,
};
use node::{HealthCounters, clock_name};

use crate::alarms::Alarms;
use crate::config::{Config, DetectorSettings, LandingTargetSource, Mode, PreferredPlace, Start};
use crate::feed::{self, Feed};
use crate::selection::{Limits, MOST, Preference, Selection, Sight};
use crate::wind::WindEstimate;
use crate::wire;

/// The latency that matters, as health and status name it.
const STAMP_TO_SETPOINT: &str = "stamp to setpoint";
/// Cameras whose calibration is kept; more are a mistake in the network.
const MOST_CAMERAS: usize = 16;

/// A flight.
pub struct Flight {
    config: Config,
    autopilot: Autopilot,
    lander: Lander,
    mission: Mission,
    selection: Selection,
    /// The newest frame of each detector, to be used when it becomes the active one.
    frames: BTreeMap<String, landing::FrameObservation>,
    changes_told: u64,
    cameras: BTreeMap<String, CameraInfo>,
    decision: Option<Decision>,
    setpoint: Option<Setpoint>,
    setpoint_ns: i64,
    used_stamp_ns: Option<i64>,
    /// Stamp of the newest frame that was used, with a marker in it or without.
    looked_stamp_ns: i64,
    /// Late frames of the active detector are used only if they are newer than the last one of its predecessor.
    handover_stamp_ns: i64,
    /// The autopilot's own precision landing, where that steers.
    feed: Option<Feed>,
    alarms: Alarms,
    wind: WindEstimate,
    /// The way back to the mode that follows setpoints, or the stop of the motors, as it was asked for last.
    asked: Option<CommandId>,
    detections_used: u64,
    started_ns: Option<i64>,
    disarmed_ns: Option<i64>,
    rejected: Option<String>,
    health: Arc<HealthCounters>,
}

/// What comes before and after the landing.
enum Mission {
    /// Until the operator says so.
    AwaitsCommand,
    /// Until the vehicle flies in GUIDED.
    AwaitsAir,
    /// From the ground into the air.
    TakesOff { takeoff: Takeoff, why: String },
    /// The lander decides.
    Lands,
    /// The autopilot's own precision landing decides.
    Feeds,
    /// Nothing more happens without a command.
    Failed { why: String },
}

impl Flight {
    /// A flight that has not begun.
    ///
    /// # Errors
    /// When the lander refuses its settings.
    pub fn new(config: Config, health: Arc<HealthCounters>) -> anyhow::Result<Self> {
        let mission = match config.start {
            Start::Command => Mission::AwaitsCommand,
            Start::Airborne | Start::Resume => Mission::AwaitsAir,
            Start::Takeoff => Mission::TakesOff {
                takeoff: Takeoff::new(config.takeoff_height_m),
                why: "waiting for the autopilot's heartbeat".to_owned(),
            },
        };
        let settings = &config.autopilot;
        let autopilot = Autopilot::new(autopilot::Config {
            system_id: Some(settings.system_id).filter(|id| *id != 0),
            our_component: settings.component_id,
            streams: autopilot::client::default_streams(settings.state_rate_hz),
            parameters: if config.mode == Mode::LandingTarget {
                feed::PARAMETERS.to_vec()
            } else {
                Vec::new()
            },
            timesync: settings.timesync,
            ..autopilot::Config::default()
        });
        Ok(Self {
            autopilot,
            lander: Lander::new(config.lander())?,
            mission,
            selection: selection(&config.detectors),
            frames: BTreeMap::new(),
            changes_told: 0,
            cameras: BTreeMap::new(),
            decision: None,
            setpoint: None,
            setpoint_ns: i64::MIN,
            used_stamp_ns: None,
            looked_stamp_ns: i64::MIN,
            handover_stamp_ns: i64::MIN,
            feed: (config.mode == Mode::LandingTarget)
                .then(|| Feed::new(config.landing_target, config.phases.search_timeout_s)),
            alarms: Alarms::new(config.alarms),
            wind: WindEstimate::default(),
            asked: None,
            detections_used: 0,
            started_ns: None,
            disarmed_ns: None,
            rejected: None,
            health,
            config,
        })
    }

    /// Takes a packet from the autopilot's link.
    pub fn packet(&mut self, now_ns: i64, packet: &Packet) {
        self.listen_for_operator(now_ns, packet);
        self.autopilot.handle(now_ns, packet);
        self.take_autopilot_events(now_ns);
    }

    /// Takes note of what the ground station sends to the autopilot through us.
    pub fn ground_packet(&mut self, now_ns: i64, packet: &Packet) {
        self.listen_for_operator(now_ns, packet);
    }

    fn listen_for_operator(&mut self, now_ns: i64, packet: &Packet) {
        if let Some(MavMessage::HEARTBEAT(heartbeat)) = &packet.message
            && heartbeat.mavtype == MavType::MAV_TYPE_GCS
        {
            self.alarms.operator_heard(now_ns);
        }
    }

    /// Lets time pass; to be called 20 times a second or more.
    pub fn tick(&mut self, now_ns: i64) {
        self.autopilot.tick(now_ns);
        self.take_autopilot_events(now_ns);
        self.selection.tick(now_ns);
        self.frames.retain(|name, _| self.selection.knows(name));
        self.use_newest(now_ns);
        self.count_ticks(now_ns);
        self.advance_mission(now_ns);
        self.watch(now_ns);
        self.decide(now_ns, LanderEvent::Tick);
    }

    /// Raises what the lander must know of while it lands.
    fn watch(&mut self, now_ns: i64) {
        if !self.is_landing() || matches!(self.mission, Mission::Feeds) {
            return;
        }
        let battery = self.autopilot.state().map(|state| state.battery);
        if let Some(alarm) = self.alarms.tick(now_ns, battery.as_ref()) {
            tracing::warn!(?alarm, "Alarm");
            self.health.count("alarms");
            self.decide(now_ns, LanderEvent::Alarm(alarm));
        }
    }

    /// Takes what the detector `publisher` found; that is whose key it was published on. True when it was used or
    /// refused; false when another detector is the active one.
    pub fn detections(&mut self, now_ns: i64, publisher: &str, message: &Detections) -> bool {
        self.health.count("detections");
        let header = &message.header;
        // Who may publish is decided by the key; what the message says of its sender is only a claim.
        if message.detector != publisher {
            self.reject("another-detectors-name");
            return true;
        }
        if header.clock != clock_name() {
            self.reject("another-clock");
            return true;
        }
        // Refused here, because the newest stamp is what later ones are compared with: one from the future would shut
        // all of them out.
        let ahead_ns = header.stamp_ns.saturating_sub(now_ns);
        if ahead_ns as f64 * 1e-9 > self.config.target.max_future_s {
            self.reject("from-the-future");
            return true;
        }
        let mount = self.cameras.get(&header.camera).and_then(wire::body_from_camera);
        let marker = wire::wanted(message, &self.config.marker)
            .map(|detection| wire::marker_in_frame(detection, mount));
        let sight = marker.as_ref().map(|marker| Sight {
            place_m: marker.body_from_marker.map(|pose| {
                let place = pose.origin();
                [place.x(), place.y(), place.z()]
            }),
        });
        if self.selection.heard(now_ns, publisher, header.stamp_ns, sight) {
            let frame = landing::FrameObservation {
                stamp: Timestamp::from_nanos(header.stamp_ns),
                image_size: (header.width, header.height),
                focal_px: self.cameras.get(&header.camera).and_then(|info| {
                    let scale = f64::from(header.width) / f64::from(info.width.max(1));
                    info.focal_px.map(|[fx, fy]| 0.5 * (fx + fy) * scale)
                }),
                body_from_camera: mount.map(|mount| mount.rotation()),
                marker,
            };
            self.frames.insert(publisher.to_owned(), frame);
            debug_assert!(self.frames.len() <= MOST);
        } else if self.selection.active() == Some(publisher)
            && (self.handover_stamp_ns..self.looked_stamp_ns).contains(&header.stamp_ns)
            && let Some(marker) = marker
        {
            // Overtaken on its way by a later one: the estimator fuses it at its own time.
            self.late_frame(now_ns, header, marker);
        }
        self.use_newest(now_ns)
    }

    fn late_frame(
        &mut self,
        now_ns: i64,
        header: &messages::FrameHeader,
        marker: landing::MarkerInFrame,
    ) {
        self.health.count("late frames");
        let frame = landing::FrameObservation {
            stamp: Timestamp::from_nanos(header.stamp_ns),
            image_size: (header.width, header.height),
            focal_px: None,
            body_from_camera: None,
            marker: Some(marker),
        };
        self.decide(now_ns, LanderEvent::Frame(frame));
        if let Some(rejection) = self.decision.and_then(|decision| decision.rejected) {
            self.health.dropped(&format!("late detection: {}", rejection.name()));
        }
    }

    /// Gives the lander the frame that is to be used next, if there is one, and tells of a change of the detector.
    fn use_newest(&mut self, now_ns: i64) -> bool {
        let next = self.selection.next_frame();
        let next = next.and_then(|(name, _stamp)| self.frames.get(&name).copied());
        let changed = self.selection.changes() != self.changes_told;
        if changed {
            self.handover_stamp_ns = self.looked_stamp_ns;
        }
        if let Some(frame) = next {
            self.frame(now_ns, frame);
        }
        if changed {
            self.changes_told = self.selection.changes();
            self.health.count("changes of the detector");
            let detector = self.selection.active().unwrap_or_default();
            tracing::warn!(detector, why = self.selection.why(), "Another detector is used");
        }
        next.is_some()
    }

    fn frame(&mut self, now_ns: i64, frame: landing::FrameObservation) {
        let stamp_ns = frame.stamp.nanos();
        self.looked_stamp_ns = stamp_ns;
        let sent_before = self.setpoint_ns;
        self.decide(now_ns, LanderEvent::Frame(frame));
        let rejection = self.decision.and_then(|decision| decision.rejected);
        self.rejected = None;
        match rejection {
            Some(rejection) => self.reject(rejection.name()),
            None if frame.marker.is_some() => {
                self.detections_used += u64::from(self.is_landing());
                self.used_stamp_ns = Some(stamp_ns);
                self.feed(now_ns, &frame);
                if self.setpoint_ns != sent_before {
                    let age_ns = now_ns.saturating_sub(stamp_ns).max(0);
                    self.health
                        .latency(STAMP_TO_SETPOINT, Duration::from_nanos(age_ns.unsigned_abs()));
                }
            }
            None => {}
        }
    }

    /// Tells the autopilot's own precision landing where the landing point is.
    fn feed(&mut self, now_ns: i64, frame: &landing::FrameObservation) {
        if self.feed.is_none() {
            return;
        }
        let target = self.decision.and_then(|decision| decision.target);
        let vehicle = self.autopilot.state().and_then(wire::vehicle);
        let (Some(target), Some(vehicle)) = (target, vehicle) else { return };
        let as_seen = frame.marker.and_then(|marker| marker.body_from_marker);
        let is_raw = self.config.landing_target.source == LandingTargetSource::Detection;
        let (stamp, in_body) = match as_seen.filter(|_| is_raw) {
            Some(seen) => (frame.stamp, seen.origin()),
            None => {
                let offset = vehicle.ned_from_body.inverse() * (target.position - vehicle.position);
                (vehicle.stamp, geometry::Point::origin() + offset)
            }
        };
        let sent = self.autopilot.send_landing_target(stamp.nanos(), in_body, target.position);
        if let Some(feed) = self.feed.as_mut().filter(|_| sent) {
            feed.sent(now_ns);
            self.health.count("landing targets");
            let age_ns = now_ns.saturating_sub(frame.stamp.nanos()).max(0);
            self.health.latency(STAMP_TO_SETPOINT, Duration::from_nanos(age_ns.unsigned_abs()));
        }
    }

    /// Counts the ticks of a landing, and those at which the newest frame that was used is no longer fresh: because no
    /// detector has a newer one, or although one has.
    fn count_ticks(&mut self, now_ns: i64) {
        if !self.is_landing() {
            return;
        }
        self.health.count("ticks");
        let age_ns = now_ns.saturating_sub(self.looked_stamp_ns);
        if age_ns as f64 * 1e-9 > self.config.detectors.max_age_s {
            self.health.count("ticks without a fresh frame");
            if self.selection.has_newer() {
                self.health.count("ticks without a fresh frame although there was one");
            }
        }
    }

    /// Takes a camera's calibration and mount.
    pub fn camera(&mut self, info: CameraInfo) {
        if self.cameras.len() < MOST_CAMERAS || self.cameras.contains_key(&info.camera) {
            self.cameras.insert(info.camera.clone(), info);
        }
    }

    /// A detector came or went.
    pub fn presence(&mut self, now_ns: i64, detector: &str, alive: bool) {
        self.selection.presence(now_ns, detector, alive);
        self.use_newest(now_ns);
    }

    /// The detector `publisher` tells about itself.
    pub fn introduced(&mut self, now_ns: i64, publisher: &str, info: &DetectorInfo) {
        if info.detector != publisher {
            self.reject("another-detectors-name");
            return;
        }
        self.selection.introduced(now_ns, publisher, info.place);
        self.use_newest(now_ns);
    }

    /// Does what the operator asks for, or says why not.
    pub fn command(&mut self, now_ns: i64, command: &ControllerCommand) -> CommandReply {
        self.alarms.operator_heard(now_ns);
        let result = match command {
            ControllerCommand::Start => self.start(now_ns),
            ControllerCommand::Hold => self.operator(now_ns, OperatorCommand::Hold),
            ControllerCommand::Resume => self.operator(now_ns, OperatorCommand::Resume),
            ControllerCommand::Abort => self.operator(now_ns, OperatorCommand::Abort),
            ControllerCommand::UseDetector(name) => self.selection.prefer(now_ns, name),
            ControllerCommand::PreferDetectors(place) => {
                Ok(self.selection.prefer_place(now_ns, *place))
            }
        };
        self.use_newest(now_ns);
        match result {
            Ok(reason) => CommandReply { accepted: true, reason },
            Err(reason) => CommandReply { accepted: false, reason },
        }
    }

    /// Stops the vehicle where it is, as the last thing that is said: silence would stop it only after 3 s.
    pub fn leave(&mut self, now_ns: i64) {
        if self.is_landing() && self.setpoint.is_some() {
            self.send_velocity(now_ns, Vector::zero(), 0.0);
        }
    }

    /// The next packet for the autopilot.
    pub fn poll_outgoing(&mut self) -> Option<Vec<u8>> {
        self.autopilot.poll_outgoing()
    }

    /// The vehicle, once attitude and position are known.
    pub fn vehicle(&self) -> Option<messages::VehicleState> {
        wire::vehicle_message(self.autopilot.state()?)
    }

    /// The estimate of the landing point.
    pub fn target(&self, now_ns: i64) -> TargetEstimate {
        let target = self.decision.and_then(|decision| decision.target);
        TargetEstimate {
            stamp_ns: now_ns,
            position_ned_m: target.map(|t| t.position.coords.into()),
            lateral_error_m: target.map(|t| t.lateral_error_m),
            height_m: target.map(|t| t.height_m),
            age_ms: self.detection_age_ms(now_ns),
            rejected: self.rejected.clone(),
            decided: self.decision.and_then(|d| d.rejected).map(|why| why.to_string()),
            velocity_ned_m_s: target.map(|t| t.velocity.coords.into()),
            deviation_m: target.map(|t| t.deviation_m),
            heading_rad: target.and_then(|t| t.heading_rad),
            nis: target.and_then(|t| t.nis),
            time_offset_ms: target.map(|t| t.time_offset_s * 1e3),
            wind_ned_m_s: self.wind.velocity_m_s(self.config.autopilot.drag_per_s),
        }
    }

    /// What is being done, and why.
    pub fn status(&self, now_ns: i64) -> ControllerStatus {
        let target = self.decision.and_then(|decision| decision.target);
        let above_origin_m =
            self.autopilot.state().and_then(|s| s.position).map(|p| -p.position.z());
        let (phase, why) = self.phase(now_ns);
        ControllerStatus {
            stamp_ns: now_ns,
            phase,
            why,
            guidance: match self.config.mode {
                Mode::Guided => self.config.guidance.name().to_owned(),
                Mode::LandingTarget => self.config.mode.name().to_owned(),
            },
            autopilot: self.link_in_words(),
            active_detector: self.selection.active().map(str::to_owned),
            detector_why: self.selection.why().to_owned(),
            preference: self.selection.preference().to_owned(),
            detector_changes: self.selection.changes(),
            candidates: self.selection.candidates(now_ns),
            detection_age_ms: self.detection_age_ms(now_ns),
            height_m: target.map(|t| t.height_m).or(above_origin_m),
            lateral_error_m: target.map(|t| t.lateral_error_m),
            setpoint: self.setpoint,
            started_ns: self.started_ns,
            disarmed_ns: self.disarmed_ns,
            finished: self.is_finished(),
            detections_used: self.detections_used,
            latency_ms: self.health.percentiles(STAMP_TO_SETPOINT),
        }
    }

    fn phase(&self, now_ns: i64) -> (Phase, String) {
        match &self.mission {
            Mission::AwaitsCommand | Mission::AwaitsAir | Mission::Feeds
                if let Some(feed) = &self.feed =>
            {
                feed.phase(now_ns, feed::problem(&self.autopilot))
            }
            Mission::Feeds => (Phase::Failed, "no landing target is told in this mode".to_owned()),
            Mission::AwaitsCommand => {
                (Phase::Idle, "waiting for the start of a landing".to_owned())
            }
            Mission::AwaitsAir => {
                (Phase::Idle, "waiting for the vehicle to fly in GUIDED".to_owned())
            }
            Mission::TakesOff { why, .. } => (Phase::Takeoff, why.clone()),
            Mission::Failed { why } => (Phase::Failed, why.clone()),
            Mission::Lands if self.is_landing() && self.selection.is_blind() => {
                let why = "no detector is alive, nothing descends".to_owned();
                (wire::phase(self.lander.phase()), why)
            }
            Mission::Lands => {
                let mut why = self.decision.map_or_else(String::new, |d| d.why.to_string());
                if self.lander.phase() == LanderPhase::PilotInCommand
                    && let Some(state) = self.autopilot.state()
                {
                    // It may as well be the autopilot's failsafe: when PX4 misses setpoints it leaves OFFBOARD.
                    why = format!("{why} (or the autopilot's failsafe), in {}", state.mode);
                }
                (wire::phase(self.lander.phase()), why)
            }
        }
    }

    fn is_finished(&self) -> bool {
        let silent = self.decision.is_none_or(|decision| decision.action == Action::None);
        match self.mission {
            Mission::Failed { .. } => true,
            Mission::Lands => self.lander.phase().is_terminal() && silent,
            Mission::Feeds => self.feed.as_ref().is_none_or(Feed::is_finished),
            Mission::AwaitsCommand | Mission::AwaitsAir | Mission::TakesOff { .. } => false,
        }
    }

    fn is_landing(&self) -> bool {
        match self.mission {
            Mission::Lands => !self.lander.phase().is_terminal(),
            Mission::Feeds => self.feed.as_ref().is_some_and(Feed::is_under_way),
            _ => false,
        }
    }

    fn link_in_words(&self) -> String {
        match (self.autopilot.system(), self.autopilot.is_connected()) {
            (Some(system), true) => {
                let mode = self.autopilot.state().map(|state| state.mode);
                let mode = mode.map_or_else(String::new, |mode| format!(" in {mode}"));
                format!("system {system}{mode}")
            }
            (Some(system), false) => format!("system {system} is silent"),
            (None, _) => "not heard yet".to_owned(),
        }
    }

    fn detection_age_ms(&self, now_ns: i64) -> Option<f64> {
        self.used_stamp_ns.map(|stamp| now_ns.saturating_sub(stamp) as f64 * 1e-6)
    }

    fn reject(&mut self, reason: &str) {
        self.health.dropped(&format!("detection: {reason}"));
        self.rejected = Some(reason.to_owned());
    }

    fn start(&mut self, now_ns: i64) -> Result<String, String> {
        if self.is_landing() {
            return Err(format!("a landing is under way, in phase `{}`", self.phase(now_ns).0));
        }
        if let Mission::TakesOff { .. } = self.mission {
            return Err("the vehicle is taking off; the landing begins by itself".to_owned());
        }
        if self.autopilot.state().and_then(wire::vehicle).is_none() {
            return Err("attitude and position of the vehicle are not known".to_owned());
        }
        if self.feed.is_some() {
            return self.start_feeding(now_ns);
        }
        let awaits_air = matches!(self.mission, Mission::AwaitsAir);
        self.begin(now_ns);
        let why = self.decision.map_or_else(String::new, |d| d.why.to_string());
        match self.lander.phase() {
            LanderPhase::Idle
            | LanderPhase::Landed
            | LanderPhase::PilotInCommand
            | LanderPhase::Aborted => {
                self.mission = if awaits_air { Mission::AwaitsAir } else { Mission::AwaitsCommand };
                self.started_ns = None;
                Err(format!("no landing was started: {why}"))
            }
            phase => Ok(format!("in phase `{phase}`: {why}")),
        }
    }

    fn start_feeding(&mut self, now_ns: i64) -> Result<String, String> {
        if let Some(problem) = feed::problem(&self.autopilot) {
            return Err(problem);
        }
        if !self.flies_guided() {
            return Err(
                "the vehicle does not fly in a mode from which we may ask for LAND".to_owned()
            );
        }
        self.begin(now_ns);
        let (phase, why) = self.phase(now_ns);
        Ok(format!("in phase `{phase}`: {why}"))
    }

    fn flies_guided(&self) -> bool {
        self.autopilot
            .state()
            .is_some_and(|s| s.armed && s.mode.is_guided() && s.landed.is_flying())
    }

    /// True when there is no landing to be taken up: it has ended, though the motors may still run, or the pilot flies.
    fn is_nobodys_landing(&self) -> bool {
        self.autopilot.state().is_some_and(|s| {
            let stands = s.landed == autopilot::LandedState::OnGround;
            !s.armed || stands || !s.mode.is_guided() && !s.mode.is_landing()
        })
    }

    fn operator(&mut self, now_ns: i64, command: OperatorCommand) -> Result<String, String> {
        if let Mission::TakesOff { .. } = self.mission {
            if command == OperatorCommand::Resume {
                return Err("the vehicle is taking off; there is nothing to resume".to_owned());
            }
            let why =
                "broken off by the operator; the autopilot ends the take-off by itself".to_owned();
            self.fail(why.clone());
            return Ok(why);
        }
        let before = self.lander.phase();
        if !self.is_landing() {
            return Err(format!("no landing is under way (phase `{}`)", self.phase(now_ns).0));
        }
        if let Some(feed) = self.feed.as_mut().filter(|_| matches!(self.mission, Mission::Feeds)) {
            if command == OperatorCommand::Resume {
                return Err("the autopilot steers; there is nothing to resume".to_owned());
            }
            let height_m = self.decision.and_then(|d| d.target).map(|target| target.height_m);
            let lowest_m = self.config.phases.no_return_height_m;
            return feed.give_up(now_ns, height_m, lowest_m, &mut self.autopilot);
        }
        self.decide(now_ns, LanderEvent::Operator(command));
        let why = self.decision.map_or_else(String::new, |d| d.why.to_string());
        let after = self.lander.phase();
        if before == after && command == OperatorCommand::Abort {
            let lowest_m = self.config.phases.no_return_height_m;
            return Err(format!(
                "the autopilot's landing is left to finish: it is lower than {lowest_m} m, or an abort would land as well"
            ));
        }
        if before == after {
            return Err(format!("it changes nothing in phase `{after}`: {why}"));
        }
        Ok(format!("in phase `{after}`: {why}"))
    }

    /// Nothing is said any more, and nothing that was asked for is repeated.
    fn fail(&mut self, why: String) {
        self.autopilot.withdraw();
        self.mission = Mission::Failed { why };
    }

    fn begin(&mut self, now_ns: i64) {
        self.started_ns = Some(now_ns);
        self.disarmed_ns = None;
        self.alarms.begin();
        if let Some(feed) = &mut self.feed {
            feed.begin(now_ns);
            self.mission = Mission::Feeds;
            return;
        }
        self.mission = Mission::Lands;
        self.decide(now_ns, LanderEvent::Operator(OperatorCommand::Start));
    }

    fn advance_mission(&mut self, now_ns: i64) {
        // The lander refuses a start without them, and would not be asked again.
        let state = self.autopilot.state().and_then(wire::vehicle);
        let stale_s = self.config.phases.stale_vehicle_s;
        let is_known = state.is_some_and(|state| {
            Timestamp::from_nanos(now_ns).seconds_since(state.stamp) <= stale_s
        });
        let flies = self.flies_guided();
        if let Some(feed) = &mut self.feed
            && feed.step(now_ns, &mut self.autopilot)
            && !matches!(self.mission, Mission::Feeds)
        {
            // Somebody else began it; it is followed as if it were ours.
            self.started_ns = Some(now_ns);
            self.disarmed_ns = None;
            self.mission = Mission::Feeds;
        }
        match &mut self.mission {
            Mission::AwaitsAir if !is_known => {}
            Mission::AwaitsAir => {
                let lands = self.autopilot.state().is_some_and(|state| {
                    state.armed && state.mode.is_landing() && state.landed.is_flying()
                });
                let resumes = self.config.start == Start::Resume;
                if flies || lands && self.feed.is_none() {
                    self.begin(now_ns);
                } else if resumes && self.is_nobodys_landing() {
                    self.mission = Mission::AwaitsCommand;
                }
                // A pilot's own landing is none of ours while it is high; the next flight may be.
                if matches!(self.mission, Mission::Lands) && self.lander.phase().is_terminal() {
                    self.mission =
                        if resumes { Mission::AwaitsCommand } else { Mission::AwaitsAir };
                    self.started_ns = None;
                }
            }
            Mission::TakesOff { takeoff, why } => {
                match takeoff.step(now_ns, &mut self.autopilot) {
                    // LAND may be the end of the landing that an earlier controller began.
                    end @ (TakeoffProgress::Done
                    | TakeoffProgress::Failed(TakeoffError::PilotInCommand {
                        mode: FlightMode::Land | FlightMode::AUTO_LAND,
                        ..
                    })) => {
                        let is_up = matches!(end, TakeoffProgress::Done);
                        if is_known {
                            self.begin(now_ns);
                            // The news of the mode may be newer than the state that the lander knows.
                            if is_up
                                && matches!(self.mission, Mission::Lands)
                                && self.lander.phase() == LanderPhase::Idle
                            {
                                self.mission = Mission::AwaitsAir;
                                self.started_ns = None;
                            }
                        } else {
                            "waiting for attitude and position".clone_into(why);
                        }
                    }
                    TakeoffProgress::Failed(problem) => {
                        tracing::error!(%problem, "No take-off");
                        self.fail(problem.to_string());
                    }
                    TakeoffProgress::Waiting(reasons) => *why = reasons.join("; "),
                    progress => *why = progress.to_string(),
                }
            }
            Mission::AwaitsCommand | Mission::Lands | Mission::Feeds | Mission::Failed { .. } => {}
        }
    }

    fn take_autopilot_events(&mut self, now_ns: i64) {
        while let Some(event) = self.autopilot.poll_event() {
            match event {
                Event::State(state) => {
                    self.alarms.autopilot_heard(now_ns);
                    if let Some(vehicle) = wire::vehicle(&state) {
                        if state.landed == autopilot::LandedState::InAir {
                            self.wind.take(&vehicle);
                        }
                        self.decide(now_ns, LanderEvent::Vehicle(vehicle));
                    }
                }
                Event::ArmedChanged(armed) => {
                    if !armed && self.started_ns.is_some() {
                        self.disarmed_ns = self.disarmed_ns.or(Some(now_ns));
                    }
                    // A takeoff was for one flight, which the pilot has ended.
                    if !armed
                        && self.config.start != Start::Airborne
                        && matches!(self.mission, Mission::AwaitsAir)
                    {
                        self.mission = Mission::AwaitsCommand;
                    }
                    // The next flight is one more to be landed, if that is what was asked for.
                    let over =
                        self.is_finished() && !matches!(self.mission, Mission::Failed { .. });
                    if armed && over && self.config.start == Start::Airborne {
                        self.mission = Mission::AwaitsAir;
                        self.started_ns = None;
                    }
                    tracing::info!(armed, "Motors");
                }
                Event::Restarted => {
                    let why = "the autopilot restarted in flight".to_owned();
                    tracing::error!("The autopilot restarted");
                    if self.started_ns.is_some() {
                        self.fail(why);
                    }
                }
                Event::Attitude(_) | Event::Position(_) | Event::Range(_) => {}
                other => self.log(other),
            }
        }
    }

    fn log(&self, event: Event) {
        match event {
            Event::Found { system, firmware } => {
                tracing::info!(system, %firmware, "Autopilot found");
            }
            Event::OtherVehicle { system } => {
                tracing::warn!(
                    system,
                    "Another vehicle is on the link and is ignored; pin ours with autopilot.system_id"
                );
            }
            Event::SameAddress { .. } => {
                tracing::warn!(
                    "Another companion speaks in our name; give one of the two another autopilot.component_id"
                );
            }
            Event::Lost { silence } => tracing::error!(?silence, "The autopilot is silent"),
            Event::Returned => tracing::info!("The autopilot is heard again"),
            Event::ModeChanged { from, to } => tracing::info!(?from, %to, "Flight mode"),
            Event::LandedChanged { from, to } => {
                tracing::info!(%from, %to, "Contact with the ground");
            }
            Event::ReadyChanged { ready, reasons } => tracing::info!(ready, ?reasons, "Readiness"),
            Event::Text { severity, text } => tracing::info!(?severity, text, "Autopilot"),
            Event::Command { command, result, .. } => match result {
                Ok(()) => tracing::info!(%command, "Done"),
                Err(problem) => {
                    self.health.failed("commands");
                    tracing::warn!(%problem, "A command was not carried out");
                }
            },
            Event::StreamMissing { message, wanted_hz, measured_hz } => {
                self.health.failed("missing messages");
                tracing::warn!(
                    message,
                    wanted_hz,
                    measured_hz,
                    "A message of the autopilot does not come as asked"
                );
            }
            Event::StreamRestored { message, measured_hz } => {
                tracing::info!(message, measured_hz, "A message of the autopilot comes again");
            }
            Event::State(_)
            | Event::ArmedChanged(_)
            | Event::Restarted
            | Event::Attitude(_)
            | Event::Position(_)
            | Event::Range(_) => {}
        }
    }

    fn decide(&mut self, now_ns: i64, event: LanderEvent) {
        let before = self.lander.phase();
        let decision = self.lander.step(Timestamp::from_nanos(now_ns), event);
        if decision.phase != before {
            tracing::info!(from = %before, to = %decision.phase, why = %decision.why, "Phase");
            // A LAND that was lost on the way must not be asked for again after the pilot took over.
            self.autopilot.withdraw();
        }
        self.decision = Some(decision);
        if !matches!(self.mission, Mission::Lands) {
            return;
        }
        match decision.action {
            Action::None => self.setpoint = None,
            Action::Guided => {
                self.setpoint = None;
                if let Some(mode) = self.autopilot.firmware().and_then(Firmware::guided) {
                    self.ask(now_ns, Command::SetMode(mode));
                }
            }
            Action::Disarm => self.ask(now_ns, Command::Disarm),
            Action::Land => {
                let mode = self.autopilot.firmware().and_then(Firmware::land);
                let mode = mode.unwrap_or(FlightMode::Land);
                self.autopilot.request(now_ns, Command::SetMode(mode));
                // Sent at once: at half a metre every tick counts.
                self.autopilot.tick(now_ns);
            }
            Action::Velocity { velocity, yaw_rate } => {
                let velocity = match self.selection.is_blind() {
                    // A search without a detector finds nothing.
                    true if decision.phase == LanderPhase::Search => Vector::zero(),
                    true => level(velocity),
                    false => velocity,
                };
                let period_ns = (1e9 / self.config.autopilot.setpoint_rate_hz) as i64;
                let is_frame = matches!(event, LanderEvent::Frame(_));
                if is_frame || now_ns.saturating_sub(self.setpoint_ns) >= period_ns {
                    self.send_velocity(now_ns, velocity, yaw_rate);
                }
            }
        }
    }

    /// Asks for something once, unless it is being asked for already.
    fn ask(&mut self, now_ns: i64, command: Command) {
        let is_pending = |id| self.autopilot.status(id) == CommandStatus::Pending;
        if !self.asked.is_some_and(is_pending) {
            self.asked = Some(self.autopilot.request(now_ns, command));
            self.autopilot.tick(now_ns);
        }
    }

    fn send_velocity(&mut self, now_ns: i64, velocity: Vector<geometry::Ned>, yaw_rate: f64) {
        match self.autopilot.set_velocity(now_ns, velocity, yaw_rate) {
            Ok(()) => {
                self.health.count("setpoints");
                self.setpoint_ns = now_ns;
                self.setpoint = Some(Setpoint {
                    velocity_ned_m_s: velocity.coords.into(),
                    yaw_rate_rad_s: yaw_rate,
                });
            }
            // LAND was asked for and has just begun.
            Err(_) if self.lander.phase() == LanderPhase::Final => self.setpoint = None,
            Err(problem) => {
                self.setpoint = None;
                if self.health.failed("setpoints") {
                    tracing::warn!(%problem, "A setpoint was not sent; further ones are counted only");
                }
            }
        }
    }
}

/// The choice of the detector, as configured.
fn selection(settings: &DetectorSettings) -> Selection {
    let limits = Limits {
        max_age_s: settings.max_age_s,
        least_rate_hz: settings.least_rate_hz,
        return_after_s: settings.return_after_s,
        tolerance_m: settings.tolerance_m,
        tolerance_per_m: settings.tolerance_per_m,
    };
    let detector = Some(settings.preferred.clone()).filter(|name| !name.is_empty());
    let place = match settings.place {
        PreferredPlace::Any => None,
        PreferredPlace::Onboard => Some(Place::Onboard),
        PreferredPlace::Ground => Some(Place::Ground),
    };
    Selection::new(limits, Preference { detector, place })
}

/// The same velocity without its downward part: a crash of the last detector is told at once, and need not wait until
/// the target has aged.
fn level(velocity: Vector<geometry::Ned>) -> Vector<geometry::Ned> {
    Vector::new(velocity.x(), velocity.y(), velocity.z().min(0.0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use autopilot::dialect::{
        ATTITUDE_DATA, EXTENDED_SYS_STATE_DATA, HEARTBEAT_DATA, LANDING_TARGET_DATA,
        LOCAL_POSITION_NED_DATA, MavAutopilot, MavCmd, MavLandedState, MavMessage, MavModeFlag,
        MavType, PARAM_VALUE_DATA, SYS_STATUS_DATA,
    };
    use autopilot::{Parser, Sender};
    use messages::{Detection, FrameHeader};
    use node::Layers;

    const MS: i64 = 1_000_000;

    fn flight(start: &str) -> Flight {
        flight_with(start, &[])
    }

    fn flight_with(start: &str, set: &[&str]) -> Flight {
        let mut all = vec![format!("start={start}")];
        all.extend(set.iter().map(|s| (*s).to_owned()));
        let layers = Layers { file: None, set: all };
        Flight::new(layers.load::<Config>().unwrap().settings, Arc::default()).unwrap()
    }

    fn hear(flight: &mut Flight, now_ns: i64, message: &MavMessage) {
        let sender = Sender { system: 1, component: 1 };
        for packet in Parser::new().push(&autopilot::packet::encode(sender, 0, message)) {
            flight.packet(now_ns, &packet);
        }
    }

    fn heartbeat(mode: u32, armed: bool) -> MavMessage {
        let armed =
            if armed { MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED } else { MavModeFlag::empty() };
        MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: mode,
            mavtype: MavType::MAV_TYPE_QUADROTOR,
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            base_mode: armed,
            ..Default::default()
        })
    }

    fn contact(landed_state: MavLandedState) -> MavMessage {
        MavMessage::EXTENDED_SYS_STATE(EXTENDED_SYS_STATE_DATA {
            landed_state,
            ..Default::default()
        })
    }

    /// Attitude and position 5 m over the origin.
    fn pose(flight: &mut Flight, now_ns: i64) {
        pose_at(flight, now_ns, 5.0);
    }

    fn pose_at(flight: &mut Flight, now_ns: i64, height_m: f32) {
        let time_boot_ms = (now_ns / MS) as u32;
        let attitude = ATTITUDE_DATA { time_boot_ms, ..Default::default() };
        hear(flight, now_ns, &MavMessage::ATTITUDE(attitude));
        let position = LOCAL_POSITION_NED_DATA { time_boot_ms, z: -height_m, ..Default::default() };
        hear(flight, now_ns + 1, &MavMessage::LOCAL_POSITION_NED(position));
    }

    /// What was sent since the last call: setpoints, and commands other than for messages.
    fn sent(flight: &mut Flight) -> (usize, Vec<MavCmd>) {
        let (mut setpoints, mut commands) = (0, Vec::new());
        while let Some(packet) = flight.poll_outgoing() {
            for packet in Parser::new().push(&packet) {
                match packet.message {
                    Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(_)) => setpoints += 1,
                    Some(MavMessage::COMMAND_LONG(c))
                        if c.command != MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL =>
                    {
                        commands.push(c.command);
                    }
                    _ => {}
                }
            }
        }
        (setpoints, commands)
    }

    fn in_flight(start: &str) -> Flight {
        let mut flight = flight(start);
        hear(&mut flight, 0, &heartbeat(4, true));
        hear(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        flight
    }

    #[test]
    fn a_landing_is_taken_up_only_once_attitude_and_position_are_known() {
        for start in ["takeoff", "airborne"] {
            let mut flight = in_flight(start);
            flight.tick(2 * MS);
            let status = flight.status(2 * MS);
            assert!(!status.finished && status.phase != Phase::Search, "{status:?}");
            pose(&mut flight, 30 * MS);
            flight.tick(31 * MS);
            assert_eq!(flight.status(31 * MS).phase, Phase::Search);
            assert_eq!(sent(&mut flight).0, 1);
        }
    }

    #[test]
    fn the_pilots_switch_silences_at_once_and_for_good() {
        let mut flight = in_flight("airborne");
        pose(&mut flight, 30 * MS);
        flight.tick(31 * MS);
        assert_eq!(sent(&mut flight), (1, vec![]));
        hear(&mut flight, 100 * MS, &heartbeat(5, true));
        for i in 0..100 {
            let now_ns = (101 + i * 25) * MS;
            pose(&mut flight, now_ns);
            flight.tick(now_ns + 2);
        }
        assert_eq!(flight.status(3000 * MS).phase, Phase::PilotInCommand);
        assert_eq!(sent(&mut flight), (0, vec![]));
    }

    #[test]
    fn the_search_waits_for_a_detector_and_climbs_before_it_goes_sideways() {
        let searched = |height_m: f32, has_detector: bool| {
            let mut flight = in_flight("airborne");
            if has_detector {
                flight.presence(0, "main", true);
            }
            for i in 0..80 {
                let now_ns = (30 + i * 25) * MS;
                pose_at(&mut flight, now_ns, height_m);
                flight.tick(now_ns + 2);
            }
            let status = flight.status(2030 * MS);
            assert_eq!(status.phase, Phase::Search);
            status.setpoint.unwrap().velocity_ned_m_s
        };
        assert_eq!(searched(5.0, false), [0.0; 3]);
        let [north, east, down] = searched(5.0, true);
        assert!(north.hypot(east) > 0.5 && down == 0.0);
        let [north, east, down] = searched(0.6, true);
        assert!(north.hypot(east) == 0.0 && down < 0.0);
    }

    #[test]
    fn a_start_is_refused_on_the_ground_and_while_taking_off() {
        let mut rising = flight("takeoff");
        let reply = rising.command(0, &ControllerCommand::Start);
        assert!(!reply.accepted && reply.reason.contains("taking off"), "{reply:?}");
        let mut flight = flight("airborne");
        hear(&mut flight, 0, &heartbeat(4, false));
        hear(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        pose(&mut flight, 2 * MS);
        let reply = flight.command(3 * MS, &ControllerCommand::Start);
        assert!(!reply.accepted && reply.reason.contains("not armed"), "{reply:?}");
        // It still begins by itself, as it was told to.
        hear(&mut flight, 10 * MS, &heartbeat(4, true));
        hear(&mut flight, 11 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        pose(&mut flight, 12 * MS);
        flight.tick(13 * MS);
        assert_eq!(flight.status(13 * MS).phase, Phase::Search);
    }

    #[test]
    fn a_frame_from_the_future_does_not_shut_out_those_of_now() {
        let mut flight = in_flight("airborne");
        let now_ns = 1000 * MS;
        let seen = |stamp_ns: i64| Detections {
            header: FrameHeader { width: 64, height: 48, ..header(stamp_ns) },
            detections: vec![Detection { pose: None, ..Detection::sample() }],
            ..Detections::sample()
        };
        for stamp_ns in [i64::MAX, now_ns + 10_000 * MS, now_ns + 60 * MS] {
            flight.detections(now_ns, "main", &seen(stamp_ns));
            assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("from-the-future"));
        }
        for stamp_ns in [i64::MIN, now_ns - 1] {
            flight.detections(now_ns, "main", &seen(stamp_ns));
        }
        assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("no-pose"), "it was looked at");
        assert_eq!(flight.status(now_ns).active_detector.as_deref(), Some("main"));
        // Another one's name is no way into the flight.
        flight.detections(now_ns, "intruder", &seen(now_ns));
        assert_eq!(flight.target(now_ns).rejected.as_deref(), Some("another-detectors-name"));
        assert_eq!(flight.status(now_ns).candidates.len(), 1);
    }

    fn header(stamp_ns: i64) -> FrameHeader {
        FrameHeader { stamp_ns, clock: clock_name().into(), ..FrameHeader::sample() }
    }

    /// A frame in which the marker lies 5 m below a camera at the body's origin.
    fn seen(stamp_ns: i64) -> Detections {
        Detections { header: header(stamp_ns), ..Detections::sample() }
    }

    /// Hovers in view of the marker for so long, in the autopilot's mode of this number.
    fn hover(flight: &mut Flight, from_ms: i64, to_ms: i64, mode: u32) -> Heard {
        let mut heard = Heard::default();
        for ms in (from_ms..to_ms).step_by(20) {
            if ms % 1000 == 0 {
                hear(flight, ms * MS, &heartbeat(mode, true));
            }
            pose(flight, ms * MS);
            if ms % 60 == 0 {
                flight.detections(ms * MS + 2, "main", &seen(ms * MS - 40 * MS));
            }
            flight.tick(ms * MS + 3);
            heard.take(flight);
        }
        heard
    }

    #[derive(Default)]
    struct Heard {
        setpoints: usize,
        targets: Vec<LANDING_TARGET_DATA>,
        modes: Vec<f32>,
        asked: Vec<String>,
    }

    impl Heard {
        fn take(&mut self, flight: &mut Flight) {
            while let Some(packet) = flight.poll_outgoing() {
                for packet in Parser::new().push(&packet) {
                    match packet.message {
                        Some(MavMessage::SET_POSITION_TARGET_LOCAL_NED(_)) => self.setpoints += 1,
                        Some(MavMessage::LANDING_TARGET(target)) => self.targets.push(target),
                        Some(MavMessage::COMMAND_LONG(c))
                            if c.command == MavCmd::MAV_CMD_DO_SET_MODE =>
                        {
                            self.modes.push(c.param2);
                        }
                        Some(MavMessage::PARAM_REQUEST_READ(r)) => {
                            self.asked.push(r.param_id.to_str().unwrap_or_default().to_owned());
                        }
                        _ => {}
                    }
                }
            }
        }
    }

    fn told(flight: &mut Flight, now_ns: i64, name: &str, value: f32) {
        let value =
            PARAM_VALUE_DATA { param_value: value, param_id: name.into(), ..Default::default() };
        hear(flight, now_ns, &MavMessage::PARAM_VALUE(value));
    }

    fn feeding(start: &str) -> Flight {
        let mut flight = flight_with(start, &["mode=landing-target"]);
        flight.camera(CameraInfo::sample());
        flight.presence(0, "main", true);
        hear(&mut flight, 0, &heartbeat(4, true));
        hear(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        flight
    }

    #[test]
    fn the_autopilots_own_precision_landing_is_told_the_target_and_gets_no_setpoint() {
        let mut flight = feeding("airborne");
        told(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        told(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        let early = hover(&mut flight, 1000, 3000, 4);
        assert!(early.modes.is_empty(), "it does not know the target for long enough");
        let heard = hover(&mut flight, 3000, 6000, 4);
        assert_eq!((early.setpoints, heard.setpoints), (0, 0));
        assert_eq!(heard.modes.first(), Some(&9.0), "LAND");
        assert!(heard.targets.len() >= 45, "at the frames' rate: {}", heard.targets.len());
        for target in &heard.targets {
            assert_eq!((target.frame as u8, target.position_valid.bits()), (12, 1));
            // Image right (0.2 m) is the vehicle's right, image down (0.1 m) its back.
            let [x, y, z] = [target.x, target.y, target.z];
            assert!((x + 0.1).abs() < 0.03 && (y - 0.2).abs() < 0.03 && (z - 5.0).abs() < 0.1);
        }
        let stamps = heard.targets.windows(2).all(|pair| pair[0].time_usec <= pair[1].time_usec);
        assert!(stamps, "of one steady clock");
        hover(&mut flight, 6000, 7000, 9);
        assert_eq!(flight.status(7000 * MS).phase, Phase::Final);
        hear(&mut flight, 8000 * MS, &heartbeat(9, false));
        flight.tick(8001 * MS);
        let status = flight.status(8001 * MS);
        assert!(status.phase == Phase::Landed && status.finished, "{status:?}");
        assert_eq!(status.guidance, "landing-target");
    }

    #[test]
    fn a_precision_landing_that_is_off_is_told_with_what_to_set() {
        let mut flight = feeding("command");
        let asked = hover(&mut flight, 1000, 1500, 4).asked;
        assert!(asked.iter().any(|name| name == "PLND_ENABLED"), "{asked:?}");
        for (name, value, word) in [
            ("PLND_ENABLED", 0.0, "set PLND_ENABLED to 1"),
            ("PLND_ENABLED", 1.0, "PLND_TYPE"),
            ("PLND_TYPE", 2.0, "set PLND_TYPE to 1"),
        ] {
            told(&mut flight, 1600 * MS, name, value);
            let reply = flight.command(1600 * MS, &ControllerCommand::Start);
            assert!(!reply.accepted && reply.reason.contains(word), "{reply:?}");
            assert!(flight.status(1600 * MS).why.contains(word));
        }
        told(&mut flight, 1700 * MS, "PLND_TYPE", 1.0);
        assert!(flight.command(1700 * MS, &ControllerCommand::Start).accepted);
    }

    #[test]
    fn a_landing_that_the_pilot_began_is_fed_and_taken_back_only_from_high_up() {
        let mut flight = feeding("command");
        told(&mut flight, 2 * MS, "PLND_ENABLED", 1.0);
        told(&mut flight, 2 * MS, "PLND_TYPE", 1.0);
        hover(&mut flight, 1000, 4000, 4);
        let heard = hover(&mut flight, 4000, 5000, 9);
        assert!(heard.targets.len() > 10 && heard.modes.is_empty());
        assert_eq!(flight.status(5000 * MS).phase, Phase::Final);
        assert!(flight.command(5000 * MS, &ControllerCommand::Abort).accepted);
        let heard = hover(&mut flight, 5020, 5500, 9);
        assert_eq!(heard.modes, [4.0], "GUIDED");
        assert_eq!(flight.status(5500 * MS).phase, Phase::Aborted);
    }

    #[test]
    fn a_low_battery_leads_to_what_is_configured() {
        let set = ["phases.on_battery_low=\"hold\"", "alarms.battery_s=1"];
        let mut flight = flight_with("airborne", &set);
        hear(&mut flight, 0, &heartbeat(4, true));
        hear(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        hover(&mut flight, 1000, 2000, 4);
        assert_eq!(flight.status(2000 * MS).phase, Phase::Search);
        let battery = SYS_STATUS_DATA { battery_remaining: 15, ..Default::default() };
        hear(&mut flight, 2000 * MS, &MavMessage::SYS_STATUS(battery));
        hover(&mut flight, 2000, 3500, 4);
        let status = flight.status(3500 * MS);
        assert_eq!((status.phase, status.why.as_str()), (Phase::Hold, "the battery is low"));
    }

    #[test]
    fn a_pilots_landing_high_up_does_not_end_the_readiness_for_the_next_flight() {
        let mut flight = flight("airborne");
        hear(&mut flight, 0, &heartbeat(9, true));
        hear(&mut flight, MS, &contact(MavLandedState::MAV_LANDED_STATE_LANDING));
        hover(&mut flight, 20, 1000, 9);
        assert_eq!(flight.status(1000 * MS).phase, Phase::Idle);
        hear(&mut flight, 1000 * MS, &heartbeat(9, false));
        hear(&mut flight, 1001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
        hear(&mut flight, 5000 * MS, &heartbeat(4, true));
        hear(&mut flight, 5001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
        hover(&mut flight, 5020, 5500, 4);
        assert_eq!(flight.status(5500 * MS).phase, Phase::Search);
    }

    #[test]
    fn a_landing_taken_up_is_the_only_one_that_begins_by_itself() {
        let next_flight = |start: &str, mode: u32, contact_at_start: MavLandedState| {
            let mut flight = flight(start);
            flight.presence(0, "main", true);
            hear(&mut flight, 0, &heartbeat(mode, true));
            hear(&mut flight, MS, &contact(contact_at_start));
            hover(&mut flight, 20, 1000, mode);
            let first = flight.status(1000 * MS).phase;
            hear(&mut flight, 1000 * MS, &heartbeat(mode, false));
            hear(&mut flight, 1001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_ON_GROUND));
            pose(&mut flight, 1010 * MS);
            flight.tick(1011 * MS);
            hear(&mut flight, 5000 * MS, &heartbeat(4, true));
            hear(&mut flight, 5001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
            hover(&mut flight, 5020, 5500, 4);
            (first, flight.status(5500 * MS).phase)
        };
        let (flying, landing) =
            (MavLandedState::MAV_LANDED_STATE_IN_AIR, MavLandedState::MAV_LANDED_STATE_LANDING);
        for (start, mode, contact, first, next) in [
            ("resume", 4, flying, Phase::Search, Phase::Landed),
            ("resume", 5, flying, Phase::Idle, Phase::Idle),
            ("resume", 9, landing, Phase::Idle, Phase::Idle),
            ("airborne", 4, flying, Phase::Search, Phase::Search),
            ("airborne", 5, flying, Phase::Idle, Phase::Search),
        ] {
            let phases = next_flight(start, mode, contact);
            assert_eq!(phases, (first, next), "{start} in {mode}");
        }
    }

    #[test]
    fn a_controller_restarted_after_the_touch_lands_no_later_flight_with_the_motors_still_running()
    {
        let first_and_next = |mode: u32, contact_at_start: MavLandedState| {
            let mut flight = flight("resume");
            flight.presence(0, "main", true);
            hear(&mut flight, 0, &heartbeat(mode, true));
            // Whether it stands is not known yet.
            hover(&mut flight, 20, 500, mode);
            hear(&mut flight, 500 * MS, &contact(contact_at_start));
            hover(&mut flight, 520, 1000, mode);
            let first = flight.status(1000 * MS).phase;
            hear(&mut flight, 5001 * MS, &contact(MavLandedState::MAV_LANDED_STATE_IN_AIR));
            hover(&mut flight, 5020, 5500, 4);
            (first, flight.status(5500 * MS).phase)
        };
        let on_ground = MavLandedState::MAV_LANDED_STATE_ON_GROUND;
        for mode in [4, 9] {
            let (first, next) = first_and_next(mode, on_ground);
            assert_eq!((first, next), (Phase::Idle, Phase::Idle), "in mode {mode}");
        }
        let (first, _) = first_and_next(4, MavLandedState::MAV_LANDED_STATE_IN_AIR);
        assert_eq!(first, Phase::Search);
    }

    #[test]
    fn a_controller_restarted_in_the_last_metre_of_land_takes_the_landing_up() {
        for contact_at_start in
            [MavLandedState::MAV_LANDED_STATE_LANDING, MavLandedState::MAV_LANDED_STATE_IN_AIR]
        {
            let mut flight = flight("resume");
            flight.presence(0, "main", true);
            hear(&mut flight, 0, &heartbeat(9, true));
            hear(&mut flight, MS, &contact(contact_at_start));
            pose_at(&mut flight, 20 * MS, 0.5);
            flight.tick(21 * MS);
            assert_eq!(flight.status(21 * MS).phase, Phase::Final);
        }
    }

    #[test]
    fn the_last_setpoint_before_the_pilots_switch_is_no_later_than_the_news_of_it() {
        let mut flight = in_flight("airborne");
        flight.presence(0, "main", true);
        let mut last_ms = 0;
        for ms in (20..4000).step_by(5) {
            // The news of the switch comes at 2 s, between two ticks.
            if ms == 2000 {
                hear(&mut flight, ms * MS, &heartbeat(5, true));
            }
            if ms % 20 == 0 {
                pose(&mut flight, ms * MS);
            }
            if ms % 25 == 0 {
                flight.tick(ms * MS + 3);
            }
            if sent(&mut flight).0 > 0 {
                last_ms = ms;
            }
        }
        assert!((1900..2000).contains(&last_ms), "{last_ms} ms");
        assert_eq!(flight.status(4000 * MS).setpoint, None);
    }
}
