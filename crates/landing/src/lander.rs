//! The landing decision as one function of time and events.

use geometry::{Ned, Point, Vector};

use crate::agreement::{Agreement, Verdict, Wrong};
use crate::config::{AlarmAction, Config, GuidanceConfig, OnAbort, PhaseConfig};
use crate::decision::{Action, Decision, Phase, Reason, Rejection, TargetEstimate};
use crate::envelope;
use crate::estimator::Estimator;
use crate::event::{Alarm, Event, FrameObservation, Landed, MarkerInFrame, Mode, VehicleState};
use crate::guidance::Guide;
use crate::guidance::situation::{Progress, Situation};
use crate::history::History;
use crate::limits::ConfigError;
use crate::phase::{Facts, Machine, VehicleFacts};
use crate::search;
use crate::target::Target;
use crate::time::Timestamp;

/// Positions and velocities beyond this are no flight of ours, in m and m/s.
const FARTHEST: f64 = 1e6;

/// For so long the guidance flies on while LAND is awaited, in seconds.
const HAND_OVER_S: f64 = 1.0;

/// The fence is looked ahead to over this time, in seconds.
const FENCE_LEAD_S: f64 = 1.0;

/// For so long an aborted landing climbs and stays before it falls silent, in seconds.
const CLIMB_AWAY_S: f64 = 60.0;

/// One landing after the other: told what happens, it answers what to do.
#[derive(Clone, Debug)]
pub struct Lander {
    config: Config,
    now: Option<Timestamp>,
    history: History,
    tracker: Tracker,
    sightings: Sightings,
    newest_frame: Option<Timestamp>,
    guide: Guide,
    agreement: Agreement,
    /// When the landing's first marker was seen.
    first_seen: Option<Timestamp>,
    machine: Machine,
    land_asked: Option<Timestamp>,
    /// Height over the local origin at which the landing began, in metres.
    ceiling_m: f64,
    /// Height over the local origin to which a retry climbs, in metres.
    retry_to_m: Option<f64>,
    /// Smallest angle from the middle of the camera's image to its edge, in radians.
    half_view_rad: Option<f64>,
    /// The expanding square under way.
    square: Option<Square>,
}

/// An expanding square under way.
#[derive(Copy, Clone, Debug)]
struct Square {
    begun: Timestamp,
    /// Direction of the first leg, in radians from north to east.
    first_leg_rad: f64,
    /// How far it goes upwind before the first leg, in metres.
    upwind_m: f64,
}

/// Where the landing point is, by the filter that the guidance takes.
#[derive(Clone, Debug)]
#[expect(
    clippy::large_enum_variant,
    reason = "there is one, and nothing may be allocated in flight"
)]
enum Tracker {
    Mean(Target),
    Filter(Estimator),
}

/// The markers used, as moments.
#[derive(Copy, Clone, Debug, Default)]
struct Sightings {
    newest: Option<Timestamp>,
    /// How many there were without a long gap.
    in_a_row: u32,
}

impl Lander {
    /// A lander that waits for a start; refuses settings out of range.
    pub fn new(config: Config) -> Result<Self, ConfigError> {
        config.validate()?;
        Ok(Self {
            config,
            now: None,
            history: History::new(config.target.max_extrapolation_s),
            tracker: Tracker::new(&config),
            sightings: Sightings::default(),
            newest_frame: None,
            guide: Guide::new(config.guidance),
            agreement: Agreement::default(),
            first_seen: None,
            machine: Machine::new(config.phases),
            land_asked: None,
            ceiling_m: 0.0,
            retry_to_m: None,
            half_view_rad: None,
            square: None,
        })
    }

    /// What to do now that `event` has happened. A `now` earlier than the last one counts as the last one.
    pub fn step(&mut self, now: Timestamp, event: Event) -> Decision {
        let now = self.now.map_or(now, |last| last.max(now));
        self.now = Some(now);
        let refused = match event {
            Event::Vehicle(state) => self.vehicle(now, state),
            Event::Frame(frame) => self.frame(now, &frame),
            Event::Operator(_) | Event::Alarm(_) | Event::Tick => Ok(()),
        };
        let operator = if let Event::Operator(command) = event { Some(command) } else { None };
        let alarm = if let Event::Alarm(alarm) = event { Some(self.answer(alarm)) } else { None };
        let facts = Facts {
            now,
            operator,
            alarm,
            vehicle: self.vehicle_facts(now),
            target_age_s: self.sightings.age_s(now),
            target_confirmed: self.sightings.in_a_row >= self.config.target.confirm_after,
            target_known: self.knows(now),
            progress: self.progress(now),
            disagreement: self.disagreement(),
            may_descend: self.is_tested(now),
        };
        if self.machine.advance(&facts) {
            self.guide = Guide::new(self.config.guidance);
            self.first_seen = None;
            if self.disagreement().is_some() {
                self.agreement = Agreement::default();
            }
            self.ceiling_m = self.history.newest().map_or(0.0, |state| -state.position.z());
        }
        let (action, why) = self.act(now);
        Decision {
            phase: self.machine.phase(),
            action,
            why,
            target: self.target(now),
            rejected: refused.err(),
        }
    }

    /// Where the landing stands.
    pub fn phase(&self) -> Phase {
        self.machine.phase()
    }

    fn vehicle(&mut self, now: Timestamp, state: VehicleState) -> Result<(), Rejection> {
        if !state.is_finite() {
            return Err(Rejection::NotFinite);
        }
        if (state.position - Point::origin()).norm() > FARTHEST || state.velocity.norm() > FARTHEST
        {
            return Err(Rejection::Implausible);
        }
        self.timely(now, state.stamp, self.config.phases.stale_vehicle_s)?;
        if self.history.push(state) { Ok(()) } else { Err(Rejection::OutOfOrder) }
    }

    fn frame(&mut self, now: Timestamp, frame: &FrameObservation) -> Result<(), Rejection> {
        if frame.image_size.0 == 0
            || frame.image_size.1 == 0
            || frame.marker.is_some_and(|m| !m.is_finite())
        {
            return Err(Rejection::NotFinite);
        }
        self.timely(now, frame.stamp, self.config.target.max_latency_s)?;
        let late = self.newest_frame.is_some_and(|newest| frame.stamp <= newest);
        if late && !self.tracker.takes_late_frames() {
            return Err(Rejection::OutOfOrder);
        }
        if late {
            return frame.marker.map_or(Ok(()), |marker| self.marker(frame, &marker));
        }
        self.newest_frame = Some(frame.stamp);
        let short_px = f64::from(frame.image_size.0.min(frame.image_size.1));
        let focal_px = frame.focal_px.filter(|focal_px| *focal_px > 1.0);
        self.half_view_rad = focal_px.map(|focal_px| (0.5 * short_px / focal_px).atan());
        if frame.marker.is_none() {
            self.tracker.miss(frame, &self.history);
        }
        let seen = frame.marker.map_or(Ok(()), |marker| self.marker(frame, &marker));
        self.tell_guide(frame, seen.is_ok());
        seen
    }

    /// A marker with a pose goes through the target's gates; one without serves only a guidance that needs none.
    fn marker(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
    ) -> Result<(), Rejection> {
        if marker.confidence < self.config.target.min_confidence {
            return Err(Rejection::LowConfidence);
        }
        if let (Some(pose), Some(motion)) = (marker.body_from_marker, self.history.at(frame.stamp))
        {
            self.agreement.add(frame.stamp, &motion, pose.origin());
        }
        self.first_seen.get_or_insert(frame.stamp);
        match self.tracker.observe(frame, marker, &self.history) {
            Err(Rejection::NoPose) if !self.guide.needs_pose() => {}
            Err(rejection) => return Err(rejection),
            Ok(()) => {}
        }
        self.sightings.add(frame.stamp, self.config.phases.lost_target_s);
        Ok(())
    }

    /// The thesis' controller runs once per frame, and only while it descends.
    fn tell_guide(&mut self, frame: &FrameObservation, used: bool) {
        let Some(state) = self.history.newest() else { return };
        if !matches!(self.machine.phase(), Phase::Approach | Phase::Descend) {
            return;
        }
        let motion = self.history.at(frame.stamp);
        let heading_rad =
            motion.map_or(state.heading_rad(), |motion| motion.ned_from_body.euler().2);
        let altitude_m = self.target(frame.stamp);
        let altitude_m = altitude_m.map_or(-state.position.z(), |target| target.height_m);
        let marker = frame.marker.filter(|_| used);
        self.guide.frame(&FrameObservation { marker, ..*frame }, heading_rad, altitude_m);
    }

    /// What is configured to follow an alarm.
    fn answer(&self, alarm: Alarm) -> (AlarmAction, Reason) {
        let phases = &self.config.phases;
        match alarm {
            Alarm::BatteryLow => (phases.on_battery_low, Reason::BatteryLow),
            Alarm::BatteryCritical => (phases.on_battery_critical, Reason::BatteryCritical),
            Alarm::OperatorLost => (phases.on_operator_lost, Reason::OperatorLost),
            Alarm::AutopilotLost => (phases.on_autopilot_lost, Reason::AutopilotLost),
        }
    }

    fn vehicle_facts(&self, now: Timestamp) -> Option<VehicleFacts> {
        let state = self.history.newest()?;
        let altitude_m = -state.position.z();
        Some(VehicleFacts {
            age_s: now.seconds_since(state.stamp),
            mode: state.mode,
            armed: state.armed,
            landed: state.landed,
            altitude_m,
            height_m: self.target(now).map_or(altitude_m, |target| target.height_m),
        })
    }

    fn pad_moves(&self) -> bool {
        let estimator = &self.config.estimator;
        estimator.pad_speed_m_s > 0.0 || estimator.pad_heave_m_s > 0.0
    }

    /// A pad that moves cannot show what the camera does, and the thesis' guidance stays as it was.
    fn tests_itself(&self) -> bool {
        let metric = matches!(self.config.guidance, GuidanceConfig::Metric(_));
        metric
            && self.config.phases.axis_check_s > 0.0
            && self.config.estimator.pad_speed_m_s == 0.0
    }

    /// Why camera and autopilot do not mean the same directions.
    fn disagreement(&self) -> Option<Reason> {
        match self.agreement.verdict() {
            Verdict::Disagrees(wrong) if self.tests_itself() => Some(match wrong {
                Wrong::Turned(_) => Reason::CameraTurned,
                Wrong::Mirrored(_) => Reason::ImageMirrored,
                Wrong::RollSign | Wrong::PitchSign => Reason::AttitudeSign,
            }),
            _ => None,
        }
    }

    /// True once camera and autopilot agree, or natural motion has not shown it in the time allowed.
    fn is_tested(&self, now: Timestamp) -> bool {
        let waited_s = self.first_seen.map_or(0.0, |seen| now.seconds_since(seen));
        let over = waited_s > self.config.phases.axis_check_s;
        !self.tests_itself() || over || self.agreement.verdict() == Verdict::Agrees
    }

    fn knows(&self, now: Timestamp) -> bool {
        self.history.newest().is_some_and(|vehicle| self.guide.knows(&self.situation(now, vehicle)))
    }

    fn timely(&self, now: Timestamp, stamp: Timestamp, max_age_s: f64) -> Result<(), Rejection> {
        let age_s = now.seconds_since(stamp);
        if age_s < -self.config.target.max_future_s {
            Err(Rejection::FromTheFuture)
        } else if age_s > max_age_s {
            Err(Rejection::Stale)
        } else {
            Ok(())
        }
    }

    /// The landing point as seen from the vehicle's newest state.
    fn target(&self, now: Timestamp) -> Option<TargetEstimate> {
        let vehicle = self.history.newest()?.position;
        match &self.tracker {
            Tracker::Mean(target) => target.seen_from(vehicle, now),
            Tracker::Filter(estimator) => {
                estimator.seen_from(vehicle, self.history.ned_from_odometry(), now)
            }
        }
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
        }
    }

    fn progress(&mut self, now: Timestamp) -> Progress {
        if !matches!(self.machine.phase(), Phase::Approach | Phase::Descend) {
            return Progress::Unchanged;
        }
        let Some(vehicle) = self.history.newest().copied() else { return Progress::Unchanged };
        let situation = self.situation(now, &vehicle);
        self.guide.progress(&situation)
    }

    /// What the present phase does.
    fn act(&mut self, now: Timestamp) -> (Action, Reason) {
        let why = self.machine.why();
        let guided = matches!(self.machine.phase(), Phase::Approach | Phase::Descend);
        let low =
            matches!(why, Reason::LowAndAligned | Reason::LowAndUnseen | Reason::TouchedEarly);
        let retrying = self.machine.phase() == Phase::Retry;
        let handing_over = self.machine.phase() == Phase::Final
            && low
            && !self.machine.is_landing()
            && self.guide.flies_until_land()
            && self.machine.elapsed_s(now) <= HAND_OVER_S;
        if !retrying {
            self.retry_to_m = None;
        }
        if !guided && !handing_over && !retrying {
            self.guide.rest();
        }
        if self.machine.phase() != Phase::Search {
            self.square = None;
        }
        match self.machine.phase() {
            Phase::Idle | Phase::Landed | Phase::PilotInCommand => (Action::None, why),
            Phase::Search if why == Reason::TakingOff => (Action::None, why),
            Phase::Search => (self.search(now), why),
            Phase::Approach | Phase::Descend => self.guided(now),
            Phase::Retry => (self.retry(now), why),
            Phase::Hold => (self.hold(now), why),
            Phase::Final if self.machine.is_landing() => (Action::None, why),
            Phase::Final if why == Reason::LandingBySetpoints => (self.go_down(now), why),
            Phase::Final if handing_over && !self.asks_for_land(now) => (self.guided(now).0, why),
            Phase::Final => (self.ask_for_land(now), why),
            Phase::Aborted => (self.aborted(now), why),
        }
    }

    fn guided(&mut self, now: Timestamp) -> (Action, Reason) {
        let Some(vehicle) = self.history.newest().copied() else {
            return (Action::hover(), Reason::VehicleStale);
        };
        let situation = self.situation(now, &vehicle);
        let (wanted, mut why) = self.guide.velocity(&situation);
        let is_tested = self.is_tested(now) || self.machine.phase() != Phase::Approach;
        let may_descend = self.guide.may_descend(&situation) && is_tested;
        if !is_tested && wanted.z() > 0.0 {
            why = Reason::SelfTest;
        }
        let velocity = envelope::admit(&self.config.envelope, wanted, may_descend);
        let yaw_rate = self.guide.yaw_rate(&situation);
        self.guide.sent(velocity);
        (Action::Velocity { velocity, yaw_rate }, why)
    }

    /// Stays where the marker must be in view, and climbs, never above the height where the landing began.
    fn retry(&mut self, now: Timestamp) -> Action {
        let Some(vehicle) = self.history.newest().copied() else { return Action::hover() };
        let phases = self.config.phases;
        let altitude_m = -vehicle.position.z();
        let to_m =
            *self.retry_to_m.get_or_insert((altitude_m + phases.retry_climb_m).min(self.ceiling_m));
        let (wanted, _) = self.guide.velocity(&self.situation(now, &vehicle));
        // The last half metre is flown ever more slowly.
        let climb_m_s = (2.0 * (to_m - altitude_m)).clamp(0.0, phases.retry_climb_m_s);
        let wanted = Vector::new(wanted.x(), wanted.y(), -climb_m_s);
        let velocity = envelope::admit(&self.config.envelope, wanted, false);
        self.guide.sent(velocity);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }

    /// Climbs to where legs overlap in the camera's view, as far as the fence lets it, and flies the expanding square there.
    fn search(&mut self, now: Timestamp) -> Action {
        let Some(vehicle) = self.history.newest() else { return Action::hover() };
        let phases = &self.config.phases;
        if self.machine.elapsed_s(now) < phases.search_delay_s {
            return Action::hover();
        }
        let altitude_m = -vehicle.position.z();
        let up = inside(phases, vehicle.position, Vector::new(0.0, 0.0, -phases.search_climb_m_s));
        let wanted = if self.square.is_none() && altitude_m < phases.search_height_m && up.z() < 0.0
        {
            up
        } else {
            let square = self.square.get_or_insert_with(|| Square {
                begun: now,
                first_leg_rad: search::first_leg_rad(vehicle.ned_from_body),
                upwind_m: search::upwind_m(phases, vehicle.ned_from_body, altitude_m),
            });
            let elapsed_s = now.seconds_since(square.begun);
            let legs = search::velocity(phases, elapsed_s, square.first_leg_rad, square.upwind_m);
            inside(phases, vehicle.position, legs)
        };
        let velocity = envelope::admit(&self.config.envelope, wanted, false);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }

    /// Goes straight down where LAND is refused, and has the motors stopped on the ground.
    fn go_down(&mut self, now: Timestamp) -> Action {
        let down = self.history.newest().is_some_and(|state| state.landed == Landed::OnGround);
        if down && self.asks_again(now) {
            self.land_asked = Some(now);
            return Action::Disarm;
        }
        let wanted = Vector::new(0.0, 0.0, self.config.phases.refused_descend_m_s);
        let velocity = envelope::admit(&self.config.envelope, wanted, true);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }

    /// Hovers; where the marker was lost so low that it may just have left the view, climbs a little.
    fn hold(&self, now: Timestamp) -> Action {
        let phases = &self.config.phases;
        let lost = self.machine.why() == Reason::TargetLost
            && self.machine.elapsed_s(now) > phases.regain_after_s;
        let low = self.history.newest().is_some_and(|vehicle| {
            let age_s = now.seconds_since(vehicle.stamp);
            let target = self.target(now);
            age_s <= phases.stale_vehicle_s
                && target.is_some_and(|target| target.height_m < phases.regain_height_m)
        });
        if !(lost && low) {
            return Action::hover();
        }
        let wanted = Vector::new(0.0, 0.0, -phases.regain_climb_m_s);
        Action::Velocity {
            velocity: envelope::admit(&self.config.envelope, wanted, false),
            yaw_rate: 0.0,
        }
    }

    /// Asks for LAND at once and at intervals, and hovers in between.
    fn ask_for_land(&mut self, now: Timestamp) -> Action {
        if self.asks_for_land(now) {
            self.land_asked = Some(now);
            return Action::Land;
        }
        Action::hover()
    }

    fn asks_for_land(&self, now: Timestamp) -> bool {
        self.machine.elapsed_s(now) <= 0.0 || self.asks_again(now)
    }

    /// True at the interval at which modes and motors are asked for again.
    fn asks_again(&self, now: Timestamp) -> bool {
        let again = |asked: Timestamp| now.seconds_since(asked) >= self.config.phases.land_retry_s;
        self.land_asked.is_none_or(again)
    }

    fn aborted(&mut self, now: Timestamp) -> Action {
        let phases = self.config.phases;
        if self.machine.recalls() {
            return self.recall(now);
        }
        let follows = self.history.newest().is_some_and(|state| {
            let fresh = now.seconds_since(state.stamp) <= phases.stale_vehicle_s;
            fresh && state.armed && state.mode == Mode::Guided
        });
        if self.machine.is_released() || !follows {
            return Action::None;
        }
        let elapsed_s = self.machine.elapsed_s(now);
        match phases.on_abort {
            OnAbort::Hover if elapsed_s <= phases.release_after_s => Action::hover(),
            OnAbort::Land if elapsed_s <= phases.land_timeout_s => self.ask_for_land(now),
            OnAbort::Climb if elapsed_s <= CLIMB_AWAY_S => self.climb_away(),
            OnAbort::Hover | OnAbort::Land | OnAbort::Climb => Action::None,
        }
    }

    /// Asks for the mode that follows setpoints, at once and at intervals.
    fn recall(&mut self, now: Timestamp) -> Action {
        if !self.asks_for_land(now) {
            return Action::None;
        }
        self.land_asked = Some(now);
        Action::Guided
    }

    /// Climbs to the height of aborted landings and stays there.
    fn climb_away(&self) -> Action {
        let phases = &self.config.phases;
        let altitude_m = self.history.newest().map_or(f64::MAX, |state| -state.position.z());
        let climb_m_s =
            (phases.abort_height_m - altitude_m).clamp(0.0, self.config.envelope.climb_m_s);
        let wanted = Vector::new(0.0, 0.0, -climb_m_s);
        let velocity = envelope::admit(&self.config.envelope, wanted, false);
        Action::Velocity { velocity, yaw_rate: 0.0 }
    }
}

impl Tracker {
    fn new(config: &Config) -> Self {
        match config.guidance {
            GuidanceConfig::Thesis(_) => Self::Mean(Target::new(config.target)),
            GuidanceConfig::Metric(_) => Self::Filter(Estimator::new(config.estimator)),
        }
    }

    fn takes_late_frames(&self) -> bool {
        matches!(self, Self::Filter(_))
    }

    fn miss(&mut self, frame: &FrameObservation, history: &History) {
        if let Self::Filter(estimator) = self {
            estimator.miss(frame, history);
        }
    }

    fn observe(
        &mut self,
        frame: &FrameObservation,
        marker: &MarkerInFrame,
        history: &History,
    ) -> Result<(), Rejection> {
        match self {
            Self::Mean(target) => target.observe(frame, marker, history),
            Self::Filter(estimator) => estimator.observe(frame, marker, history),
        }
    }
}

impl Sightings {
    fn add(&mut self, stamp: Timestamp, longest_gap_s: f64) {
        let gap_s = self.age_s(stamp);
        if gap_s < 0.0 {
            return;
        }
        self.in_a_row = if gap_s > longest_gap_s { 1 } else { self.in_a_row.saturating_add(1) };
        self.newest = Some(stamp);
    }

    fn age_s(&self, now: Timestamp) -> f64 {
        self.newest.map_or(f64::INFINITY, |newest| now.seconds_since(newest))
    }
}

/// The same velocity without what leads out of the fence; the way back stays open.
fn inside(phases: &PhaseConfig, place: Point<Ned>, wanted: Vector<Ned>) -> Vector<Ned> {
    let ahead = place + wanted * FENCE_LEAD_S;
    let far = |p: Point<Ned>| p.x().hypot(p.y());
    let radius_m = phases.fence_radius_m;
    let leaves = radius_m > 0.0 && far(ahead) > radius_m && far(ahead) > far(place);
    let too_high = phases.fence_height_m > 0.0 && -ahead.z() > phases.fence_height_m;
    let (x, y) = if leaves { (0.0, 0.0) } else { (wanted.x(), wanted.y()) };
    Vector::new(x, y, if too_high { wanted.z().max(0.0) } else { wanted.z() })
}
