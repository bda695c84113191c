//! The lander: each event with its time goes through plausibility, estimator, checks, state machine, guidance and envelope to one
//! decision.

mod aborted;
mod checks;
mod hovering;
mod lost;
mod marker;
mod motors;

use aborted::AbortClimb;
use geometry::{Ned, Odometry, Point, Vector};
use motors::LastFall;

use crate::axis_check::AxisConsistencyCheck;
use crate::config::{AlarmAction, Config};
use crate::decision::{Action, Decision, Phase, Reason, Rejection, TargetEstimate};
use crate::envelope;
use crate::event::{
    AutopilotLimits, Event, FrameObservation, Landed, Mode, OperatorCommand, VehicleState,
    VehicleStatus,
};
use crate::guidance::ActiveGuidance;
use crate::guidance::situation::{Progress, Situation};
use crate::history::History;
use crate::hover::Hover;
use crate::limits::ConfigError;
use crate::mount_check::{MountCheck, MountFindings};
use crate::repeated_picture::RepeatedPicture;
use crate::search::Square;
use crate::size_check::SizeCheck;
use crate::standing::{
    MAX_STANDING_M_S, RememberedPad, Resumed, SeenPad, StandingHeight, may_stand,
    standing_height_m, to_remember,
};
use crate::state_machine::{Inputs, MAX_STANDSTILL_S, StateMachine, VehicleInputs, reaction};
use crate::target_filter::{Sightings, TargetFilter};
use crate::time::Timestamp;

/// Largest position and velocity that is plausible, in m and m/s.
const MAX_PLAUSIBLE: f64 = 1e6;

/// Time for which the guidance still steers while LAND is awaited, in seconds.
const HAND_OVER_S: f64 = 1.0;

/// Height over the one at which it waits for detectors to agree, at which the vehicle counts as waiting, in
/// metres.
const DISPUTE_MARGIN_M: f64 = 0.5;

/// Height over the one that it stands with, in metres, up to which LAND is requested although detectors do not agree: a climb may
/// be one from the ground.
const MAX_DISPUTED_LAND_M: f64 = 0.3;

/// Maximum height over the target or the ground, in metres, at which the autopilot's report of the ground is
/// believed: estimates of the height err by decimetres.
const MAX_CONTACT_M: f64 = 1.0;

/// Maximum vertical speed at which that report is accepted, in m/s, in addition to the pad's heave.
const MAX_CONTACT_M_S: f64 = 0.5;

/// Maximum delay of the link to the autopilot, both ways together, in seconds, at which the vehicle is steered;
/// and the one at which it is steered again.
const MAX_LINK_DELAY_S: f64 = 0.7;
const MAX_QUICK_DELAY_S: f64 = 0.5;

/// Maximum age of the vehicle's state at which it descends, in seconds, in addition to the link's delay: a state that is late now
/// was sent over a link that has become slow, and setpoints will take as long.
const MAX_DESCEND_AGE_S: f64 = 0.2;

/// Vertical speed of a vehicle that hovers, in m/s.
const MAX_HOVER_M_S: f64 = 0.3;

/// Minimum time of a search by a lander that takes over before it climbs, in seconds: the vehicle may stand.
const MIN_RESUMED_LOOK_S: f64 = 1.5;

/// Maximum age of the newest detection, in seconds, up to which heights are those over the target.
const MAX_TARGET_AGE_S: f64 = 20.0;

/// One landing after the other: each event leads to a decision.
#[derive(Clone, Debug)]
pub struct Lander {
    config: Config,
    now: Option<Timestamp>,
    history: History,
    /// Mode, motors and contact with the ground, as they were reported last.
    status: Option<VehicleStatus>,
    /// Since when the motors are reported as off.
    disarmed: Option<Timestamp>,
    last_fall: LastFall,
    detectors_alive: bool,
    link_delay_s: f64,
    is_link_slow: bool,
    /// Where the vehicle last stood on the ground.
    ground: Option<Point<Odometry>>,
    standing_height: StandingHeight,
    /// The known facts about the landing that this lander takes over, or takes up again after a silence, until it has seen the
    /// marker.
    resumed: Option<Resumed>,
    /// Where the landing started.
    start: Point<Odometry>,
    target_filter: TargetFilter,
    sightings: Sightings,
    repeated_picture: RepeatedPicture,
    newest_frame: Option<Timestamp>,
    guidance: ActiveGuidance,
    axis_check: AxisConsistencyCheck,
    mount_check: MountCheck,
    size_check: SizeCheck,
    /// Stamp of the landing's first marker.
    first_seen: Option<Timestamp>,
    state_machine: StateMachine,
    land_requested: Option<Timestamp>,
    /// Height over the local origin to which a retry climbs, in metres.
    retry_to_m: Option<f64>,
    /// How an aborted landing changes its height.
    abort_climb: AbortClimb,
    /// The aborted vehicle is not lifted, as it may stand.
    is_left_low: bool,
    /// Since when states of an aborted vehicle are received.
    received_since: Option<Timestamp>,
    /// Smallest angle from the image's centre to its edge, in radians.
    half_view_rad: Option<f64>,
    /// The expanding square that is being flown.
    square: Option<Square>,
    /// The present hover.
    hover: Option<Hover>,
    /// That of a vehicle that waits for a landing.
    wait: Option<Hover>,
    /// How the autopilot follows setpoints.
    limits: AutopilotLimits,
    /// Since when two detectors see the marker at two positions.
    disputed: Option<Timestamp>,
}

impl Lander {
    /// A lander that waits for a start; refuses settings out of range.
    pub fn new(config: Config) -> Result<Self, ConfigError> {
        config.validate()?;
        Ok(Self {
            config,
            now: None,
            history: History::new(config.target.max_extrapolation_s),
            status: None,
            disarmed: None,
            last_fall: LastFall::default(),
            detectors_alive: true,
            link_delay_s: 0.0,
            is_link_slow: false,
            ground: None,
            standing_height: StandingHeight::default(),
            resumed: None,
            start: Point::origin(),
            target_filter: TargetFilter::new(&config),
            sightings: Sightings::default(),
            repeated_picture: RepeatedPicture::default(),
            newest_frame: None,
            guidance: ActiveGuidance::new(config.guidance),
            axis_check: AxisConsistencyCheck::default(),
            mount_check: MountCheck::default(),
            size_check: SizeCheck::default(),
            first_seen: None,
            state_machine: StateMachine::new(config.phases),
            land_requested: None,
            retry_to_m: None,
            abort_climb: AbortClimb::default(),
            is_left_low: false,
            received_since: None,
            half_view_rad: None,
            square: None,
            hover: None,
            wait: None,
            limits: AutopilotLimits::default(),
            disputed: None,
        })
    }

    /// The decision after `event`. A `now` earlier than the last one counts as the last one.
    pub fn step(&mut self, now: Timestamp, event: Event) -> Decision {
        let now = self.now.map_or(now, |last| last.max(now));
        let is_long =
            |last: Timestamp, next: Timestamp| next.seconds_since(last) > MAX_STANDSTILL_S;
        let did_not_run = self.now.is_some_and(|last| is_long(last, now));
        let last_state = self.newest_stamp();
        self.now = Some(now);
        let result = match event {
            Event::Vehicle(state) => self.vehicle(now, state),
            Event::Status(status) => {
                self.status = Some(status);
                Ok(())
            }
            Event::DetectorsAlive(alive) => {
                self.detectors_alive = alive;
                Ok(())
            }
            Event::Frame(frame) => self.frame(now, &frame),
            Event::LinkDelay(seconds) => {
                self.set_link_delay(seconds);
                Ok(())
            }
            Event::Limits(limits) => {
                self.limits = limits.plausible();
                Ok(())
            }
            Event::Dispute(is_disputed) => {
                self.disputed = is_disputed.then(|| self.disputed.unwrap_or(now));
                Ok(())
            }
            Event::Operator(_) | Event::Alarm(_) | Event::Tick => Ok(()),
        };
        // After a silence of the autopilot as long as such a standstill the landing waits for a command, whatever it was held for.
        let was_silent =
            last_state.zip(self.newest_stamp()).is_some_and(|(last, newest)| is_long(last, newest));
        let is_disarmed = self.status.is_some_and(|status| !status.armed);
        self.disarmed = is_disarmed.then(|| self.disarmed.unwrap_or(now));
        let operator = if let Event::Operator(command) = event { Some(command) } else { None };
        let operator =
            operator.or_else(|| self.is_dispute_over().then_some(OperatorCommand::Resume));
        let alarm = reaction(&self.config.phases, event).or_else(|| self.dispute_alarm(now));
        // After a dispute the landing continues automatically; any other mismatch is checked again only on an operator's command.
        if matches!(event, Event::Operator(OperatorCommand::Resume)) {
            self.repeat_checks();
        }
        let inputs = Inputs {
            now,
            operator,
            alarm,
            vehicle: self.vehicle_inputs(now),
            target_age_s: self.sightings.age_s(now),
            target_missed_s: self.sightings.missed_s(now),
            target_confirmed: self.sightings.in_a_row >= self.config.target.confirm_after,
            target_known: self.has_target(now),
            target_refused: self.sightings.is_refused(now, self.config.phases.stale_target_s),
            progress: self.progress(now),
            mismatch: self.mismatch(),
            may_descend: self.is_axis_check_done(now),
            is_link_slow: self.is_link_slow,
            may_stand: self.may_stand(now),
            has_stood_still: did_not_run || was_silent,
        };
        let was_active = !self.phase().is_terminal();
        let has_started = self.state_machine.advance(&inputs);
        if was_active && self.phase().is_terminal() {
            self.resumed = None;
            self.repeat_size_check();
        }
        if has_started {
            self.guidance = ActiveGuidance::new(self.config.guidance);
            self.standing_height = StandingHeight::default();
            self.begin_checks();
            self.last_fall.begin();
            self.start = self.position().unwrap_or(Point::origin());
        }
        let (action, why) = self.act(now);
        let action = self.keep_position(now, action);
        Decision {
            phase: self.state_machine.phase(),
            action,
            why,
            target: self.target(now),
            rejected: result.err(),
        }
    }

    /// The next landing is one that an earlier controller began; with the pad's position as that one knew it.
    pub fn resume(&mut self, pad: Option<RememberedPad>) {
        self.resumed = Some(Resumed::new(pad));
    }

    /// The pad's position for a controller that has to take over this landing; `None` where it is not known well.
    pub fn pad_to_remember(&self) -> Option<SeenPad> {
        let target = self.target(self.now?)?;
        let is_active = !self.phase().is_terminal() && !self.pad_moves();
        let pad = to_remember(self.now?, &target).filter(|_| is_active)?;
        Some(SeenPad { pad, height_m: target.height_m })
    }

    /// Ends the landing without another action, as the autopilot restarted: positions in its old frame are forgotten. A new one
    /// may be started.
    pub fn stand_down(&mut self) {
        self.state_machine.stand_down(self.now.unwrap_or_default());
        self.target_filter = TargetFilter::new(&self.config);
        self.size_check.interrupt();
        (self.resumed, self.ground) = (None, None);
    }

    /// The present phase.
    pub fn phase(&self) -> Phase {
        self.state_machine.phase()
    }

    /// True while a landing that began continues only by a command: it was aborted, or held for a reason that does not end on its own.
    pub fn waits_for_operator(&self) -> bool {
        self.state_machine.waits_for_operator()
    }

    /// True while an aborted vehicle is being commanded from LAND back to GUIDED.
    pub fn is_recalling(&self) -> bool {
        self.state_machine.is_recalling()
    }

    /// The alarm or the operator's command for which the vehicle lands, or has landed, away from the marker.
    pub fn cause(&self) -> Option<Reason> {
        self.state_machine.cause()
    }

    /// By how much the camera's mount and focal length are certainly off.
    pub fn mount_findings(&self) -> MountFindings {
        self.mount_check.findings()
    }

    /// The height of the body's origin over the pad in metres, after a landing that measured it and where it is not small.
    pub fn standing_height_m(&self) -> Option<f64> {
        self.standing_height.measured_m().filter(|_| self.phase() == Phase::Landed)
    }

    fn vehicle(&mut self, now: Timestamp, state: VehicleState) -> Result<(), Rejection> {
        if !state.is_finite() {
            return Err(Rejection::NotFinite);
        }
        if (state.position - Point::origin()).norm() > MAX_PLAUSIBLE
            || state.velocity.norm() > MAX_PLAUSIBLE
        {
            return Err(Rejection::Implausible);
        }
        self.check_stamp(now, state.stamp, self.config.phases.stale_vehicle_s)?;
        let silence = self.pad_before_silence(state.stamp);
        let before = self.history.newest().copied();
        if !self.history.push(state) {
            return Err(Rejection::OutOfOrder);
        }
        self.watch_fall(before.as_ref(), &state);
        if silence.is_some() {
            self.resumed = Some(Resumed::new(silence));
        }
        self.status = Some(state.status());
        if let Some(resumed) = &mut self.resumed {
            resumed.observe(&state);
        }
        let is_standing =
            self.landed(now) == Landed::OnGround && state.velocity.norm() <= MAX_STANDING_M_S;
        if is_standing {
            self.ground = self.position();
            let is_of_landing = self.phase() == Phase::Final && !self.pad_moves();
            self.standing_height.observe(is_of_landing.then(|| self.target(now)).flatten());
        }
        Ok(())
    }

    /// The time of the vehicle's newest state.
    fn newest_stamp(&self) -> Option<Timestamp> {
        self.history.newest().map(|vehicle| vehicle.stamp)
    }

    /// Where the vehicle is, apart from the jumps of the autopilot's position.
    fn position(&self) -> Option<Point<Odometry>> {
        Some(self.history.ned_from_odometry().inverse() * self.history.newest()?.position)
    }

    /// Height over the local origin of a position, in metres.
    fn altitude_of(&self, position: Point<Odometry>) -> f64 {
        -(self.history.ned_from_odometry() * position).z()
    }

    fn recent_target(&self, now: Timestamp) -> Option<TargetEstimate> {
        self.target(now).filter(|target| target.age_s <= MAX_TARGET_AGE_S)
    }

    /// Height over the target, else over the ground that the vehicle stood on, in metres; `None` when neither
    /// is known.
    fn known_height_m(&self, now: Timestamp) -> Option<f64> {
        let vehicle = self.history.newest()?;
        let over_ground =
            self.ground.map(|ground| -vehicle.position.z() - self.altitude_of(ground));
        self.recent_target(now).map(|target| target.height_m).or(over_ground)
    }

    /// The same; over the local origin when neither is known.
    fn height_m(&self, now: Timestamp) -> f64 {
        let altitude_m = self.history.newest().map_or(0.0, |vehicle| -vehicle.position.z());
        self.known_height_m(now).unwrap_or(altitude_m)
    }

    /// The height over the local origin that is this far over the target, else over the ground that the vehicle
    /// stood on. Where neither is known the local origin stands for the ground, but the height is at most that
    /// far over the start of the landing: the origin may be far above it.
    fn altitude_m(&self, now: Timestamp, height_m: f64) -> f64 {
        let pad_m = self.recent_target(now).map(|target| -target.position.z());
        let ground_m = pad_m.or_else(|| self.ground.map(|ground| self.altitude_of(ground)));
        ground_m.unwrap_or_else(|| libm::fmin(self.altitude_of(self.start), 0.0)) + height_m
    }

    /// The contact with the ground. A vehicle that flies high, or moves up or down, does not stand on it, whatever is
    /// said of its motors.
    fn landed(&self, now: Timestamp) -> Landed {
        let Some(status) = self.status else { return Landed::Unknown };
        if status.landed != Landed::OnGround {
            return status.landed;
        }
        let max_m_s = MAX_CONTACT_M_S + self.config.estimator.pad_heave_m_s;
        let moves = self.history.newest().is_some_and(|vehicle| {
            let is_recent = now.seconds_since(vehicle.stamp) <= self.config.phases.stale_vehicle_s;
            is_recent && vehicle.velocity.z().abs() > max_m_s
        });
        // The height over the ground of an earlier flight may have drifted. Outside of a landing motors that are off correct it.
        let is_old = self.recent_target(now).is_none() && self.phase().is_terminal();
        let is_high = (status.armed || !is_old)
            && self.known_height_m(now).is_some_and(|height_m| height_m > MAX_CONTACT_M);
        if moves || is_high { Landed::InAir } else { Landed::OnGround }
    }

    fn frame(&mut self, now: Timestamp, frame: &FrameObservation) -> Result<(), Rejection> {
        if frame.image_size.0 == 0
            || frame.image_size.1 == 0
            || frame.marker.is_some_and(|m| !m.is_finite())
        {
            return Err(Rejection::NotFinite);
        }
        if frame.marker.is_some_and(|marker| !marker.is_near()) {
            return Err(Rejection::Implausible);
        }
        if frame.marker.is_some_and(|marker| !marker.has_sound_covariance()) {
            return Err(Rejection::BadCovariance);
        }
        self.check_stamp(now, frame.stamp, self.config.target.max_latency_s)?;
        let is_late = self.newest_frame.is_some_and(|newest| frame.stamp <= newest);
        if is_late && !self.target_filter.takes_late_frames() {
            return Err(Rejection::OutOfOrder);
        }
        if is_late {
            return frame.marker.map_or(Ok(()), |marker| self.marker(frame, &marker));
        }
        let before = self.newest_frame.replace(frame.stamp);
        let short_px = f64::from(frame.image_size.0.min(frame.image_size.1));
        let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0);
        self.half_view_rad = focal_px.map(|focal_px| libm::atan(0.5 * short_px / focal_px));
        if frame.marker.is_none() {
            self.target_filter.miss(frame, &self.history);
            if self.is_out_of_view(frame) {
                let after_s = before.map_or(0.0, |before| frame.stamp.seconds_since(before));
                self.sightings.miss_out_of_view(after_s);
            }
        }
        let result = frame.marker.map_or(Ok(()), |marker| self.marker(frame, &marker));
        self.inform_guidance(frame, result.is_ok());
        result
    }

    /// The thesis' controller runs once per frame, and only while the vehicle is guided.
    fn inform_guidance(&mut self, frame: &FrameObservation, used: bool) {
        let Some(state) = self.history.newest() else { return };
        if !matches!(self.state_machine.phase(), Phase::Approach | Phase::Descend) {
            return;
        }
        let motion = self.history.at(frame.stamp);
        let heading_rad =
            motion.map_or(state.heading_rad(), |motion| motion.ned_from_body.euler().2);
        let altitude_m = self.height_m(frame.stamp);
        let marker = frame.marker.filter(|_| used);
        self.guidance.observe(&FrameObservation { marker, ..*frame }, heading_rad, altitude_m);
    }

    fn vehicle_inputs(&self, now: Timestamp) -> Option<VehicleInputs> {
        let (state, status) = (self.history.newest()?, self.status?);
        let age_s = now.seconds_since(state.stamp);
        Some(VehicleInputs {
            age_s,
            mode: status.mode,
            armed: status.armed,
            landed: self.landed(now),
            height_m: self.height_m(now),
            is_over_target: self.recent_target(now).is_some(),
            sinks: age_s <= self.config.phases.stale_vehicle_s
                && state.velocity.z() > MAX_STANDING_M_S + self.config.estimator.pad_heave_m_s,
            land_m_s: self.limits.land_m_s,
            flies: self.flies(now),
            awaits_state: self.awaits_state(now),
        })
    }

    fn may_stand(&self, now: Timestamp) -> bool {
        self.history.newest().is_some_and(|vehicle| {
            let situation = self.situation(now, vehicle);
            let resumed = self.resumed;
            let is_steered = matches!(self.state_machine.phase(), Phase::Approach | Phase::Descend);
            may_stand(&situation, &self.config, is_steered)
                || resumed.is_some_and(|resumed| resumed.may_stand(&situation, &self.config))
        })
    }

    fn set_link_delay(&mut self, seconds: f64) {
        self.link_delay_s = if seconds >= 0.0 { libm::fmin(seconds, 10.0) } else { 0.0 };
        let limit_s = if self.is_link_slow { MAX_QUICK_DELAY_S } else { MAX_LINK_DELAY_S };
        self.is_link_slow = self.link_delay_s > limit_s;
        // A frame may be received long before the vehicle's state of its time.
        let one_way_s = 0.5 * libm::fmin(self.link_delay_s, MAX_LINK_DELAY_S);
        let usual_s = self.config.target.max_extrapolation_s;
        self.history.set_max_extrapolation(usual_s + one_way_s);
    }

    /// Requests to the autopilot change its mode or its motors: only in our own mode.
    fn is_ours(&self) -> bool {
        self.status.is_some_and(|status| matches!(status.mode, Mode::Guided | Mode::Land))
    }

    fn pad_moves(&self) -> bool {
        let estimator = &self.config.estimator;
        estimator.pad_speed_m_s > 0.0 || estimator.pad_heave_m_s > 0.0
    }

    fn has_target(&self, now: Timestamp) -> bool {
        self.history
            .newest()
            .is_some_and(|vehicle| self.guidance.has_target(&self.situation(now, vehicle)))
    }

    fn check_stamp(
        &self,
        now: Timestamp,
        stamp: Timestamp,
        max_age_s: f64,
    ) -> Result<(), Rejection> {
        let age_s = now.seconds_since(stamp);
        if age_s < -self.config.target.max_future_s {
            Err(Rejection::FromTheFuture)
        } else if age_s > max_age_s {
            Err(Rejection::Stale)
        } else {
            Ok(())
        }
    }

    /// The landing point relative to the vehicle's newest state.
    fn target(&self, now: Timestamp) -> Option<TargetEstimate> {
        let vehicle = self.history.newest()?.position;
        let target = self.target_filter.estimate(vehicle, &self.history, now)?;
        Some(self.mount_check.widen(target))
    }

    fn situation<'a>(&self, now: Timestamp, vehicle: &'a VehicleState) -> Situation<'a> {
        Situation {
            now,
            vehicle,
            target: self.target(now),
            age_s: self.sightings.age_s(now),
            half_view_rad: self.half_view_rad,
            pad_moves: self.pad_moves(),
            pad_heave_m_s: self.config.estimator.pad_heave_m_s,
            limits: self.limits,
            level_because: self.level_because(now),
            link_delay_s: self.link_delay_s,
        }
    }

    /// Why the vehicle must not descend now.
    fn level_because(&self, now: Timestamp) -> Option<Reason> {
        let is_approach = self.state_machine.phase() == Phase::Approach;
        let is_checking = is_approach && !self.is_axis_check_done(now);
        let is_lost = self.sightings.age_s(now) > self.config.phases.lost_target_s;
        // The end of the last detector is known at once, so this does not wait until the target is stale.
        let alone = (!self.detectors_alive).then_some(Reason::NoDetector);
        let is_aging = self.history.newest().is_some_and(|vehicle| {
            let max_s = MAX_DESCEND_AGE_S + 0.5 * self.link_delay_s;
            now.seconds_since(vehicle.stamp) > max_s
        });
        alone
            .or_else(|| is_aging.then_some(Reason::VehicleAging))
            .or_else(|| is_checking.then_some(Reason::AxisCheck))
            .or_else(|| (is_approach && is_lost).then_some(Reason::Aligning))
    }

    fn progress(&mut self, now: Timestamp) -> Progress {
        if !matches!(self.state_machine.phase(), Phase::Approach | Phase::Descend) {
            return Progress::Unchanged;
        }
        let Some(vehicle) = self.history.newest().copied() else { return Progress::Unchanged };
        let situation = self.situation(now, &vehicle);
        match self.guidance.progress(&situation) {
            Progress::Ready(reason)
                if reason != Reason::TouchedEarly
                    && self.waits_for_agreement(&situation)
                    && self.is_over_contact(&situation) =>
            {
                Progress::Unchanged
            }
            progress => progress,
        }
    }

    /// True where the vehicle is certainly not about to stand on the target.
    fn is_over_contact(&self, situation: &Situation<'_>) -> bool {
        let standing_m = standing_height_m(&self.config);
        situation.target.is_some_and(|target| target.height_m - standing_m > MAX_DISPUTED_LAND_M)
    }

    /// The action of the present phase.
    fn act(&mut self, now: Timestamp) -> (Action, Reason) {
        let why = self.state_machine.reason();
        let guided = matches!(self.state_machine.phase(), Phase::Approach | Phase::Descend);
        let low =
            matches!(why, Reason::LowAndAligned | Reason::LowAndUnseen | Reason::TouchedEarly);
        let retrying = self.state_machine.phase() == Phase::Retry;
        let handing_over = self.state_machine.phase() == Phase::Final
            && low
            && !self.state_machine.is_landing()
            && self.guidance.steers_until_land()
            && self.state_machine.elapsed_s(now) <= HAND_OVER_S;
        if !retrying {
            self.retry_to_m = None;
        }
        if self.state_machine.phase() != Phase::Aborted {
            (self.abort_climb, self.is_left_low) = (AbortClimb::default(), false);
            self.received_since = None;
        }
        if !guided && !handing_over && !retrying {
            self.guidance.reset();
        }
        // A search goes on along its square after a hold: one that began anew would lead ever farther away.
        if !matches!(self.state_machine.phase(), Phase::Search | Phase::Hold) {
            self.square = None;
        }
        // Nothing is requested of a vehicle whose motors are off: it stands, or falls.
        let is_disarmed = self.disarmed.is_some();
        match self.state_machine.phase() {
            Phase::Idle | Phase::Landed | Phase::PilotInCommand => (Action::None, why),
            phase if is_disarmed && phase != Phase::Aborted => (Action::None, why),
            Phase::Search if why == Reason::TakingOff => (Action::None, why),
            Phase::Search => (self.search(now), why),
            Phase::Approach | Phase::Descend => self.guided(now),
            Phase::Retry => (self.retry(now), why),
            Phase::Hold => (self.hold(now), why),
            Phase::Final if self.state_machine.is_landing() => (Action::None, why),
            Phase::Final if why == Reason::LandingBySetpoints => {
                (self.descend_vertically(now), why)
            }
            Phase::Final if handing_over && !self.is_land_request_due(now) => {
                (self.guided(now).0, why)
            }
            Phase::Final => (self.request_land(now), why),
            Phase::Aborted => (self.aborted(now), why),
        }
    }

    /// True in a hold for a dispute that is over.
    fn is_dispute_over(&self) -> bool {
        let is_held = self.state_machine.phase() == Phase::Hold
            && self.state_machine.reason() == Reason::Disputed;
        is_held && self.disputed.is_none()
    }

    /// The hold after too long a wait over the target while detectors see the marker at two positions.
    fn dispute_alarm(&self, now: Timestamp) -> Option<(AlarmAction, Reason)> {
        let phases = &self.config.phases;
        let since = self.disputed?;
        let situation = self.situation(now, self.history.newest()?);
        let is_low = situation.target?.height_m <= phases.dispute_height_m + DISPUTE_MARGIN_M;
        let is_long = now.seconds_since(since) > phases.dispute_timeout_s;
        (is_low && is_long && self.waits_for_agreement(&situation))
            .then_some((AlarmAction::Hold, Reason::Disputed))
    }

    /// True when a dispute of two detectors prevents the descent.
    fn waits_for_agreement(&self, situation: &Situation<'_>) -> bool {
        self.disputed.is_some()
            && matches!(self.state_machine.phase(), Phase::Approach | Phase::Descend)
            && self.config.phases.dispute_height_m > 0.0
            && !self.guidance.touches_down(situation)
    }

    /// The velocity while detectors see the marker at two positions: not below a height from which the vehicle
    /// can still be led to either, and back up to it, but neither over the fence nor over the height where the
    /// landing started.
    fn disputed_velocity(
        &self,
        position: Point<Ned>,
        target: &TargetEstimate,
        desired: Vector<Ned>,
    ) -> Vector<Ned> {
        let phases = &self.config.phases;
        let above_m = target.height_m - phases.dispute_height_m;
        let below_start_m = libm::fmax(self.altitude_of(self.start) + position.z(), 0.0);
        let max_climb_m_s = libm::fmin(phases.retry_climb_m_s, below_start_m);
        let down_m_s = libm::fmax(above_m, -max_climb_m_s);
        let level = Vector::new(desired.x(), desired.y(), libm::fmin(desired.z(), down_m_s));
        envelope::below_fence(phases, position, level)
    }

    fn guided(&mut self, now: Timestamp) -> (Action, Reason) {
        let Some(vehicle) = self.history.newest().copied() else {
            return (Action::hover(), Reason::VehicleStale);
        };
        let situation = self.situation(now, &vehicle);
        let (mut desired, mut why) = self.guidance.velocity(&situation);
        if self.waits_for_agreement(&situation)
            && let Some(target) = situation.target
        {
            let level = self.disputed_velocity(vehicle.position, &target, desired);
            if level.z() < desired.z() {
                (desired, why) = (level, Reason::Disputed);
            }
        }
        let may_descend =
            self.guidance.may_descend(&situation) && situation.level_because.is_none();
        if let Some(reason) = situation.level_because.filter(|_| desired.z() > 0.0) {
            why = reason;
        }
        let velocity = envelope::clamp_setpoint(&self.config.envelope, desired, may_descend);
        let yaw_rate = self.guidance.yaw_rate(&situation);
        self.guidance.on_setpoint_sent(velocity);
        (Action::Velocity { velocity, yaw_rate }, why)
    }

    /// Climbs to where the legs overlap in the camera's view, as far as the fence allows, and flies the
    /// expanding square.
    fn search(&mut self, now: Timestamp) -> Action {
        let (Some(vehicle), Some(position)) = (self.history.newest(), self.position()) else {
            return Action::hover();
        };
        let phases = &self.config.phases;
        let look_s = if self.resumed.is_some() { MIN_RESUMED_LOOK_S } else { 0.0 };
        let delay_s = libm::fmax(phases.search_delay_s, look_s);
        // A search without a detector finds no marker.
        if self.state_machine.elapsed_s(now) < delay_s || !self.detectors_alive {
            return Action::hover();
        }
        let altitude_m = -vehicle.position.z();
        let up = envelope::clamp_to_fence(
            phases,
            vehicle.position,
            Vector::new(0.0, 0.0, -phases.search_climb_m_s),
        );
        // Where the envelope allows no climb the legs are flown from where it is.
        let up = envelope::clamp_setpoint(&self.config.envelope, up, false);
        let is_low = altitude_m < self.altitude_m(now, phases.search_height_m);
        let height_m = self.height_m(now);
        let desired = if self.square.is_none() && is_low && up.z() < 0.0 {
            up
        } else {
            // About where the search began, if the wind keeps the vehicle next to it.
            let centre = self.hover.and_then(|hover| hover.position()).unwrap_or(position);
            let square = self.square.get_or_insert_with(|| {
                Square::new(&self.config, now, centre, vehicle.ned_from_body, height_m)
            });
            let legs = square.velocity(phases, position);
            let desired = envelope::clamp_to_fence(phases, vehicle.position, legs);
            square.move_on(
                phases,
                now,
                position,
                desired.horizontal_norm() < legs.horizontal_norm(),
            );
            desired
        };
        let velocity = envelope::clamp_setpoint(&self.config.envelope, desired, false);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }

    /// Descends vertically where LAND is refused, and disarms on the ground.
    fn descend_vertically(&mut self, now: Timestamp) -> Action {
        let down = self.landed(now) == Landed::OnGround;
        if down && self.is_ours() && self.is_retry_due(now) {
            self.land_requested = Some(now);
            return Action::Disarm;
        }
        // Where it is going is not known without a state.
        let is_recent = self.history.newest().is_some_and(|vehicle| {
            now.seconds_since(vehicle.stamp) <= self.config.phases.stale_vehicle_s
        });
        if !is_recent {
            return Action::hover();
        }
        let desired = Vector::new(0.0, 0.0, self.config.phases.refused_descend_m_s);
        let velocity = envelope::clamp_setpoint(&self.config.envelope, desired, true);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }

    /// Hovers; where the marker was lost so low that it may just have left the view, climbs to
    /// `regain_height_m`. So it does where the link has become slow, or a sway would touch the ground.
    fn hold(&self, now: Timestamp) -> Action {
        let phases = &self.config.phases;
        let is_lost =
            matches!(self.state_machine.reason(), Reason::TargetLost | Reason::TargetRefused);
        let lost = is_lost && self.state_machine.elapsed_s(now) > phases.regain_after_s;
        let low = self.history.newest().is_some_and(|vehicle| {
            let age_s = now.seconds_since(vehicle.stamp);
            let target = self.target(now);
            age_s <= phases.stale_vehicle_s
                && target.is_some_and(|target| target.height_m < phases.regain_height_m)
        });
        if self.sinks_over_slow_link(now) {
            return self.climb(self.config.envelope.climb_m_s);
        }
        let is_slow = self.state_machine.reason() == Reason::LinkSlow;
        if !(low && (lost || is_slow)) {
            return Action::hover();
        }
        self.climb(phases.regain_climb_m_s)
    }

    /// True while the vehicle still goes down although it holds because of its slow link: setpoints that were sent
    /// before arrive after those that stop it, so it is commanded to climb until it no longer sinks.
    fn sinks_over_slow_link(&self, now: Timestamp) -> bool {
        self.state_machine.reason() == Reason::LinkSlow
            && self.history.newest().is_some_and(|vehicle| {
                let is_recent =
                    now.seconds_since(vehicle.stamp) <= self.config.phases.stale_vehicle_s;
                is_recent && vehicle.velocity.z() > MAX_HOVER_M_S
            })
    }

    /// Climbs, as far as the fence allows.
    fn climb(&self, climb_m_s: f64) -> Action {
        let Some(vehicle) = self.history.newest() else { return Action::hover() };
        let desired = Vector::new(0.0, 0.0, -climb_m_s);
        let desired = envelope::below_fence(&self.config.phases, vehicle.position, desired);
        let velocity = envelope::clamp_setpoint(&self.config.envelope, desired, false);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }

    /// Requests LAND at once and at intervals, and hovers in between.
    fn request_land(&mut self, now: Timestamp) -> Action {
        if self.is_ours() && self.is_land_request_due(now) {
            self.land_requested = Some(now);
            return Action::Land;
        }
        Action::hover()
    }

    fn is_land_request_due(&self, now: Timestamp) -> bool {
        self.state_machine.elapsed_s(now) <= 0.0 || self.is_retry_due(now)
    }

    /// True at the interval at which modes and motors are requested again.
    fn is_retry_due(&self, now: Timestamp) -> bool {
        let is_due = |sent: Timestamp| now.seconds_since(sent) >= self.config.phases.land_retry_s;
        self.land_requested.is_none_or(is_due)
    }

    /// The speed of a climb by so much, in m/s: over the last half metre it slows down.
    fn climb_speed(&self, missing_m: f64) -> f64 {
        (2.0 * missing_m).clamp(0.0, self.config.phases.retry_climb_m_s)
    }
}
