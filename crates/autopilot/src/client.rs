//! The conversation with one autopilot, a state machine without input and output: packets and time in; vehicle state, events,
//! commands, setpoints, parameters and stream requests out.
//!
//! Feed it every packet ([`Autopilot::handle`]) and the time ([`Autopilot::tick`], 20 times a second or
//! more); send the packets of [`Autopilot::poll_outgoing`] and act on the events of [`Autopilot::poll_event`].
//! Only the heartbeat, and PX4's CURRENT_MODE, show the mode: an acknowledgement is a promise, and the pilot may have changed
//! the mode since.

mod heartbeat;
mod link_delay;
mod texts;

use std::collections::VecDeque;
use std::time::Duration;

use geometry::{Body, Ned, Point, Vector};

use crate::boot::{BootClock, BootTime};
use crate::clock::{Clock, Measured};
use crate::command::{
    Command, CommandError, CommandId, CommandStatus, MODE_OF_NOW_NS, MODE_SETTLES_NS, Request,
    SetpointError, Step, ns,
};
use crate::compose;
use crate::config::Config;
use crate::conflict::{Conflict, LISTENS_NS};
use crate::contact::Contact;
use crate::dialect::{COMMAND_ACK_DATA, MavCmd, MavMessage, TIMESYNC_DATA};
use crate::event::Event;
use crate::mode::{Firmware, FlightMode};
use crate::offboard_return::OffboardReturn;
use crate::packet::{self, AUTOPILOT, Packet, Sender};
use crate::parameter::{Parameter, Parameters};
use crate::px4_listener::Listener;
use crate::same_address::SameAddress;
use crate::setpoint_stream::SetpointStream;
use crate::simulation::Simulation;
use crate::standstill::{Standstill, without_standstill};
use crate::state::{Attitude, Battery, LandedState, Position, Range, Readiness, VehicleState};
use crate::stream::Streams;
use crate::text::Joiner;

/// Maximum number of events and packets that wait; the oldest are dropped.
const MAX_QUEUED: usize = 1024;
/// Maximum number of finished commands whose outcome is stored.
const MAX_OUTCOMES: usize = 32;
/// Period of our heartbeat, in nanoseconds.
const HEARTBEAT_NS: i64 = 1_000_000_000;
/// Maximum age of a position whose vertical speed shows whether the vehicle stands, in nanoseconds.
const MAX_SPEED_AGE_NS: i64 = 500_000_000;

/// The conversation with one autopilot.
#[derive(Clone, Debug)]
pub struct Autopilot {
    config: Config,
    vehicle: Option<Vehicle>,
    clock: Clock,
    parameters: Parameters,
    setpoints: SetpointStream,
    offboard_sent_ns: Option<i64>,
    offboard_return: OffboardReturn,
    /// The system to which stops were sent before it was found.
    stopped_system: Option<u8>,
    streams: Streams,
    requests: Vec<Request>,
    standstill: Standstill,
    outcomes: VecDeque<(CommandId, CommandStatus)>,
    next_id: u64,
    events: VecDeque<Event>,
    outgoing: VecDeque<Vec<u8>>,
    /// The number of the next packet.
    sequence: Option<u8>,
    heartbeat_due_ns: i64,
    /// The system id of the first other vehicle whose heartbeat was received.
    other_system: Option<u8>,
    /// When the clock gave the link's delay last.
    link_delay_ns: Option<i64>,
    same_address: SameAddress,
    /// The time of the last packet or tick.
    now_ns: i64,
    refused_numbers: u64,
    late: u64,
}

#[derive(Clone, Debug)]
struct Vehicle {
    system: u8,
    firmware: Firmware,
    state: VehicleState,
    readiness: Readiness,
    simulation: Simulation,
    /// When it was found.
    found_ns: i64,
    /// Since when its heartbeats have come without a break.
    contact_ns: i64,
    heartbeat_ns: i64,
    /// When its mode was shown last.
    mode_ns: i64,
    /// When its mode was shown first, of the times that are not older than [`MODE_OF_NOW_NS`].
    mode_since_ns: i64,
    /// The mode before the last change that CURRENT_MODE showed, and when it did.
    mode_before: Option<(FlightMode, i64)>,
    /// When its last packet was received.
    received_ns: i64,
    boot: BootClock,
    contact: Contact,
    /// The battery by SYS_STATUS and BATTERY_STATUS.
    batteries: [Battery; 2],
    /// Altitude above mean sea level, in m.
    amsl_m: Option<f64>,
    joiner: Joiner,
    listener: Listener,
}

impl Autopilot {
    /// A conversation that has not begun.
    pub fn new(config: Config) -> Self {
        Self {
            streams: Streams::new(&config.streams),
            clock: Clock::default(),
            parameters: Parameters::new(&config.parameters),
            setpoints: SetpointStream::default(),
            offboard_sent_ns: None,
            offboard_return: OffboardReturn::default(),
            stopped_system: None,
            config,
            vehicle: None,
            requests: Vec::new(),
            standstill: Standstill::default(),
            outcomes: VecDeque::new(),
            next_id: 1,
            events: VecDeque::new(),
            outgoing: VecDeque::new(),
            sequence: None,
            heartbeat_due_ns: i64::MIN,
            other_system: None,
            link_delay_ns: None,
            same_address: SameAddress::default(),
            now_ns: i64::MIN,
            refused_numbers: 0,
            late: 0,
        }
    }

    /// Handles a packet received at `now_ns`.
    pub fn handle(&mut self, now_ns: i64, packet: &Packet) {
        self.now_ns = now_ns;
        let Some(message) = &packet.message else { return };
        if packet.sender == self.our_address() && self.same_address.take(now_ns, packet, message) {
            self.push(Event::SameAddress { sender: packet.sender });
        }
        if packet.sender.component != AUTOPILOT {
            return;
        }
        if let MavMessage::HEARTBEAT(heartbeat) = message {
            if packet.is_heartbeat_of_autopilot() {
                self.take_heartbeat(now_ns, packet.sender.system, heartbeat);
            }
            return;
        }
        if self.vehicle.as_ref().is_none_or(|vehicle| vehicle.system != packet.sender.system) {
            return;
        }
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.received_ns = now_ns;
        }
        self.streams.received(now_ns, packet.message_id);
        match message {
            MavMessage::COMMAND_ACK(ack) => self.take_acknowledgement(now_ns, ack),
            MavMessage::STATUSTEXT(text) => {
                let texts = self.vehicle.as_mut().map(|v| v.joiner.push(now_ns, text));
                for text in texts.unwrap_or_default() {
                    self.take_statustext(text);
                }
            }
            MavMessage::EVENT(event) if self.firmware() == Some(Firmware::Px4) => {
                self.take_px4_event(event);
            }
            MavMessage::TIMESYNC(sync) => self.take_time(now_ns, packet.sender, sync),
            MavMessage::PARAM_VALUE(value) => {
                self.parameters.take(self.firmware().unwrap_or(Firmware::Unknown), value);
            }
            MavMessage::CURRENT_MODE(message) if self.firmware() == Some(Firmware::Px4) => {
                self.take_current_mode(now_ns, message);
            }
            _ => self.take_state(now_ns, message),
        }
        self.step_requests(now_ns, false);
    }

    /// Lets time pass: to be called at 20 Hz or more, also when no packet is received.
    pub fn tick(&mut self, now_ns: i64) {
        self.now_ns = now_ns;
        if self.config.heartbeat && now_ns >= self.heartbeat_due_ns {
            self.send(&MavMessage::HEARTBEAT(compose::heartbeat()));
            // The next one is due a second after this one was, unless time jumped ahead.
            let regular = self.heartbeat_due_ns.saturating_add(HEARTBEAT_NS);
            self.heartbeat_due_ns =
                if regular > now_ns { regular } else { now_ns.saturating_add(HEARTBEAT_NS) };
        }
        let stood_ns = self.standstill.tick(now_ns);
        self.check_silence(now_ns, stood_ns);
        let late = self.vehicle.as_mut().and_then(|vehicle| vehicle.joiner.tick(now_ns));
        if let Some(text) = late {
            self.take_statustext(text);
        }
        if self.is_connected() {
            let (notices, request) = self.streams.tick(now_ns);
            for notice in notices {
                self.push(notice.into());
            }
            if let Some(request) = request {
                self.send_to_vehicle(request);
            }
            self.send_requests(now_ns);
            self.ask_for_checks(now_ns);
        }
        self.prove_setpoints(now_ns);
        self.note_link_delay(now_ns, stood_ns);
        self.step_requests(now_ns, !self.standstill.is_mode_old());
    }

    /// The next event, until there is none.
    pub fn poll_event(&mut self) -> Option<Event> {
        self.events.pop_front()
    }

    /// The next packet to send, until there is none.
    pub fn poll_outgoing(&mut self) -> Option<Vec<u8>> {
        self.outgoing.pop_front()
    }

    /// The vehicle's state; none before it is found.
    pub fn state(&self) -> Option<&VehicleState> {
        self.vehicle.as_ref().map(|vehicle| &vehicle.state)
    }

    /// The vehicle's firmware; none before it is found.
    pub fn firmware(&self) -> Option<Firmware> {
        self.vehicle.as_ref().map(|vehicle| vehicle.firmware)
    }

    /// The vehicle's system id; none before it is found.
    pub fn system(&self) -> Option<u8> {
        self.vehicle.as_ref().map(|vehicle| vehicle.system)
    }

    /// Whether heartbeats are received.
    pub fn is_connected(&self) -> bool {
        self.vehicle.as_ref().is_some_and(|vehicle| vehicle.state.connected)
    }

    /// Whether the vehicle has reported that it is a simulation; it is asked by
    /// [`Autopilot::ask_whether_simulated`].
    pub fn is_simulated(&self) -> bool {
        self.vehicle.as_ref().is_some_and(|vehicle| vehicle.simulation.is_reported())
    }

    /// Asks the vehicle whether it is a simulation, once a second until it has reported that it is.
    pub fn ask_whether_simulated(&mut self, now_ns: i64) {
        let Some(vehicle) = self.vehicle.as_mut().filter(|vehicle| vehicle.state.connected) else {
            return;
        };
        if let Some(question) = vehicle.simulation.question(now_ns, vehicle.firmware) {
            self.send_to_vehicle(question);
        }
    }

    /// The state of a parameter of [`Config::parameters`].
    pub fn parameter(&self, name: &str) -> Parameter {
        self.parameters.get(name)
    }

    /// Reads more parameters than [`Config::parameters`], as the firmware decides which there are.
    pub fn read_parameters(&mut self, names: &[&'static str]) {
        self.parameters.add(names);
    }

    /// Sets a parameter that is read, which must be a 32-bit float; it is sent again until the
    /// autopilot reports the value, a bounded number of times.
    pub fn set_parameter(&mut self, name: &str, value: f64) {
        self.parameters.set(name, value);
    }

    /// True while a parameter is being set.
    pub fn is_setting(&self, name: &str) -> bool {
        self.parameters.is_setting(name)
    }

    /// True when a parameter was set as often as it may be, and its value has not been reported since: it is not known.
    pub fn is_unanswered(&self, name: &str) -> bool {
        self.parameters.is_unanswered(name)
    }

    /// Sends a velocity of zero to a vehicle of which only the system id is known, before its heartbeat
    /// arrives. In a mode that a pilot has chosen an autopilot ignores it. A PX4 that holds its place only because setpoints were missing
    /// in OFFBOARD, its failsafe, follows setpoints again.
    pub fn send_stop(&mut self, now_ns: i64, system: u8) {
        self.stopped_system = Some(system);
        let target = Sender { system, component: AUTOPILOT };
        self.send(&compose::velocity((now_ns / 1_000_000) as u32, Vector::zero(), 0.0, target));
    }

    /// Why neither a take-off nor a landing may begin now: another companion with our ids, or, where [`Config::system_id`] pins none, a
    /// second vehicle from which a heartbeat was ever received. Our packets that a router returns within 2 s do not count as another's.
    pub fn conflict(&self, now_ns: i64) -> Option<Conflict> {
        let several = || {
            let (system, other) = self.system().zip(self.other_system)?;
            Some(Conflict::SeveralVehicles { system, other })
        };
        self.same_address.conflict(now_ns, self.our_address()).or_else(several)
    }

    /// Whether a heartbeat of another vehicle on the link would have been received by now, or is irrelevant as ours is pinned.
    pub fn has_listened(&self, now_ns: i64) -> bool {
        let found_ns = self.vehicle.as_ref().map(|vehicle| vehicle.found_ns);
        self.config.system_id.is_some()
            || found_ns.is_some_and(|found| now_ns.saturating_sub(found) >= LISTENS_NS)
    }

    /// Why the vehicle cannot be armed and flown yet, as texts; empty when it can.
    pub fn not_ready_because(&self) -> Vec<String> {
        match &self.vehicle {
            None => vec!["waiting for the autopilot's heartbeat".to_owned()],
            Some(vehicle) => vehicle.readiness.reasons(),
        }
    }

    /// Number of messages refused because a number in them was not finite.
    pub fn refused_numbers(&self) -> u64 {
        self.refused_numbers
    }

    /// Number of measurements left out because they came after newer ones or seconds late, because their time since the
    /// autopilot's start contradicted that of the others, or because a moving vehicle's position stayed the same.
    pub fn late_measurements(&self) -> u64 {
        self.late
    }

    /// How far behind newer ones the autopilot's measurements came in the last seconds: over a link that repeats or
    /// reorders packets an old setpoint may reach the autopilot as late.
    pub fn packets_come_behind(&self, now_ns: i64) -> Duration {
        Duration::from_nanos(self.clock.behind_ns(now_ns).unsigned_abs())
    }

    /// Requests a command. It is sent with the next [`Autopilot::tick`], and replaces an earlier request of
    /// the same kind; [`Autopilot::status`] and [`Event::Command`] report its result.
    pub fn request(&mut self, now_ns: i64, command: Command) -> CommandId {
        if let Some(pending) = self.requests.iter_mut().find(|r| r.command == command) {
            pending.repeat(now_ns);
            return pending.id;
        }
        let id = CommandId(self.next_id);
        self.next_id += 1;
        let same = |request: &Request| request.command.concerns_same_as(&command);
        if let Some(index) = self.requests.iter().position(same) {
            let old = self.requests.swap_remove(index);
            let error = CommandError::Replaced { command: old.command, by: command };
            self.finish(old.id, old.command, Err(error));
        }
        let proof_ns = if command.is_offboard() { self.setpoints.missing_ns(now_ns) } else { 0 };
        let (mode, from_ns) = (self.state().map(|it| it.mode), now_ns.saturating_add(proof_ns));
        match self.refusal(command) {
            Some(error) => self.finish(id, command, Err(error)),
            None => self.requests.push(Request::new(id, command, mode, from_ns)),
        }
        id
    }

    /// Withdraws all pending requests: none is sent again. To be called at the end of a flight and when the
    /// pilot takes over, or a command that was lost on the way is repeated against the pilot.
    pub fn withdraw(&mut self) {
        self.fail_requests(|command| CommandError::Withdrawn { command });
    }

    /// The status of a request.
    pub fn status(&self, id: CommandId) -> CommandStatus {
        if self.requests.iter().any(|request| request.id == id) {
            return CommandStatus::Pending;
        }
        let outcome = self.outcomes.iter().find(|(known, _)| *known == id);
        outcome.map_or(CommandStatus::Unknown, |(_, status)| status.clone())
    }

    /// When a request that is pending was sent last; `None` before that.
    pub fn sent_ns(&self, id: CommandId) -> Option<i64> {
        self.requests.iter().find(|request| request.id == id).and_then(Request::sent_ns)
    }

    /// Time since the vehicle showed its mode last, in ns; `None` before the first heartbeat.
    pub fn mode_age_ns(&self, now_ns: i64) -> Option<i64> {
        self.vehicle.as_ref().map(|vehicle| now_ns.saturating_sub(vehicle.mode_ns))
    }

    /// True when it has shown its mode, and no other one in a moment since: a pilot can hardly have changed it.
    pub fn shows_mode_of_now(&self, now_ns: i64) -> bool {
        self.vehicle.as_ref().is_some_and(|vehicle| {
            let age_ns = now_ns.saturating_sub(vehicle.mode_since_ns);
            (MODE_SETTLES_NS..MODE_OF_NOW_NS).contains(&age_ns)
        })
    }

    /// True while the vehicle shows OFFBOARD.
    pub fn is_in_offboard(&self) -> bool {
        self.state().is_some_and(|state| state.mode == FlightMode::OFFBOARD)
    }

    /// True while a PX4 shows LAND.
    pub fn is_in_auto_land(&self) -> bool {
        self.state().is_some_and(|state| state.mode == FlightMode::AUTO_LAND)
    }

    /// True while OFFBOARD is requested: the request may be carried out although it is withdrawn.
    pub fn is_requesting_offboard(&self) -> bool {
        self.requests.iter().any(|request| request.command.is_offboard())
    }

    /// True while a PX4 shows HOLD, and that may be its failsafe: it returns to OFFBOARD as setpoints are sent again. So it is while the
    /// vehicle reports that OFFBOARD is the mode that was chosen, for 15 s at most; and where it does not report that and our setpoints were
    /// interrupted just before, for 2.5 s at most. If HOLD still shows then, it was chosen.
    pub fn may_return_to_offboard(&self, now_ns: i64) -> bool {
        self.offboard_return.is_expected(now_ns)
    }

    /// The mode that was chosen, where a PX4 reported it last as it flew in this one (CURRENT_MODE, since 1.15): another one than that is a
    /// failsafe's.
    pub fn chosen_mode_in(&self, flown: FlightMode) -> Option<FlightMode> {
        self.offboard_return.chosen_in(flown)
    }

    /// When a setpoint was sent last, a zero or another.
    pub fn setpoint_sent_ns(&self) -> Option<i64> {
        self.setpoints.last_ns()
    }

    /// When a request for OFFBOARD was sent last.
    pub fn offboard_sent_ns(&self) -> Option<i64> {
        self.offboard_sent_ns
    }

    /// Sends setpoints of zero velocity until the next call, a tick later: before OFFBOARD, and until it shows whether a PX4 has
    /// changed to it. Modes that were chosen ignore them; a HOLD that is the failsafe of OFFBOARD ends with them.
    pub fn send_zeros(&mut self, now_ns: i64) {
        self.send_hover(now_ns, Vector::zero());
    }

    /// The same with a velocity, in m/s, that leads the vehicle back to where it hovers.
    pub fn send_hover(&mut self, now_ns: i64, velocity: Vector<Ned>) {
        let is_finite = velocity.coords.iter().all(|value| (*value as f32).is_finite());
        self.setpoints.ask_for(now_ns, if is_finite { velocity } else { Vector::zero() });
    }

    /// Whether setpoints for a hover were asked for up to the last tick.
    pub fn is_sent_hover(&self, now_ns: i64) -> bool {
        self.setpoints.is_asked(now_ns)
    }

    /// Sends a velocity in m/s, with a yaw rate in rad/s (0 holds the heading): at least twice a second,
    /// because the autopilot flies on with the last one for 3 s. Zeros stop the vehicle.
    ///
    /// Also sent while only the heartbeat is missing and other packets arrive: in a mode that a pilot has chosen the
    /// autopilot takes no setpoint, and without any it would fly on with the last one, downwards maybe. And in HOLD, while
    /// [`Autopilot::may_return_to_offboard`].
    pub fn set_velocity(
        &mut self,
        now_ns: i64,
        velocity: Vector<Ned>,
        yaw_rate: f64,
    ) -> Result<(), SetpointError> {
        let vehicle = self.vehicle.as_ref().ok_or(SetpointError::NoAutopilot)?;
        let state = &vehicle.state;
        let fits = |value: f64| (value as f32).is_finite();
        if !velocity.coords.iter().copied().all(fits) || !fits(yaw_rate) {
            return Err(SetpointError::NotFinite(velocity.coords.into(), yaw_rate));
        }
        let silence_ns = now_ns.saturating_sub(vehicle.received_ns);
        if silence_ns > ns(self.config.heartbeat_timeout) {
            return Err(SetpointError::NoAutopilot);
        }
        if vehicle.firmware.guided().is_none() {
            return Err(SetpointError::Unsupported(vehicle.firmware));
        }
        if !state.mode.is_guided() && !self.may_return_to_offboard(now_ns) {
            return Err(SetpointError::NotGuided(state.mode));
        }
        // "Landing" persists for a moment after LAND. During a takeoff a setpoint would end it.
        if !state.armed || !matches!(state.landed, LandedState::InAir | LandedState::Landing) {
            return Err(SetpointError::NotFlying(state.landed));
        }
        let time_ms = (now_ns / 1_000_000) as u32;
        let target = Sender { system: vehicle.system, component: AUTOPILOT };
        self.send(&compose::velocity(time_ms, velocity, yaw_rate, target));
        self.setpoint_sent(now_ns);
        Ok(())
    }

    /// Sends the landing target for the autopilot's own precision landing, in the coordinate frame that the
    /// firmware takes: ArduPilot `in_body`, relative to the vehicle and by its present attitude; PX4
    /// `in_local`. False when it cannot be sent: the firmware has no precision landing, a number is not
    /// finite, or the point is not below.
    ///
    /// `stamp_ns` is the time of the position, by our clock.
    pub fn send_landing_target(
        &mut self,
        stamp_ns: i64,
        in_body: Point<Body>,
        in_local: Point<Ned>,
    ) -> bool {
        let time_usec = u64::try_from(stamp_ns / 1_000).unwrap_or(0);
        let message = match self.firmware().filter(|_| self.is_connected()) {
            Some(Firmware::Copter) => compose::landing_target_position(time_usec, in_body),
            Some(Firmware::Px4) => compose::landing_target_local(time_usec, in_local),
            _ => None,
        };
        message.inspect(|message| self.send(message)).is_some()
    }

    /// Sends a message under our ids (LANDING_TARGET, STATUSTEXT, ...).
    pub fn send(&mut self, message: &MavMessage) {
        // Two controllers that were started together should not have the same numbers.
        let sequence = self.sequence.unwrap_or((self.now_ns / 1_000) as u8);
        let packet = packet::encode(self.our_address(), sequence, message);
        self.same_address.sent(self.now_ns, sequence, &packet);
        self.sequence = Some(sequence.wrapping_add(1));
        if self.outgoing.len() >= MAX_QUEUED {
            self.outgoing.pop_front();
        }
        self.outgoing.push_back(packet);
    }

    /// The ids under which messages are sent.
    pub fn our_address(&self) -> Sender {
        let system = self.config.our_system.or(self.config.system_id).or(self.system());
        Sender { system: system.unwrap_or(1), component: self.config.our_component }
    }

    /// The altitude over the sea that PX4 takes off from, in m.
    fn ground_amsl_m(&self) -> Option<f64> {
        let vehicle = self.vehicle.as_ref().filter(|vehicle| vehicle.firmware == Firmware::Px4)?;
        vehicle.amsl_m
    }

    /// Requests the time and parameters when they are due.
    fn send_requests(&mut self, now_ns: i64) {
        let Some(system) = self.system() else { return };
        if self.config.timesync
            && let Some(ts1) = self.clock.request(now_ns)
        {
            self.send(&timesync(0, ts1, Sender { system, component: AUTOPILOT }));
        }
        if let Some(request) = self.parameters.request(now_ns, system, AUTOPILOT) {
            self.send(&request);
        }
    }

    /// While OFFBOARD is requested, and as long as asked for, PX4 gets setpoints.
    fn prove_setpoints(&mut self, now_ns: i64) {
        let Some(velocity) = self.setpoints.due(now_ns, self.is_requesting_offboard()) else {
            return;
        };
        // Also while only the heartbeat is missing, like every setpoint.
        let limit_ns = now_ns.saturating_sub(ns(self.config.heartbeat_timeout));
        let vehicle = self.vehicle.as_ref().filter(|vehicle| vehicle.received_ns >= limit_ns);
        let Some(system) = vehicle.map(|vehicle| vehicle.system) else { return };
        self.setpoint_sent(now_ns);
        let time_ms = (now_ns / 1_000_000) as u32;
        let target = Sender { system, component: AUTOPILOT };
        self.send(&compose::velocity(time_ms, velocity, 0.0, target));
    }

    fn setpoint_sent(&mut self, now_ns: i64) {
        self.setpoints.sent(now_ns);
        if let Some(vehicle) = &self.vehicle {
            self.offboard_return.sent(now_ns, vehicle.state.mode, vehicle.received_ns);
        }
    }

    fn take_time(&mut self, now_ns: i64, from: Sender, message: &TIMESYNC_DATA) {
        if message.tc1 == 0 {
            // It requests our time, to synchronise with our stamps.
            self.send(&timesync(now_ns, message.ts1, from));
        } else if self.config.timesync {
            self.clock.answered(now_ns, message.tc1, message.ts1);
        }
    }

    fn send_to_vehicle(&mut self, mut message: MavMessage) {
        if let (MavMessage::COMMAND_LONG(command), Some(vehicle)) = (&mut message, &self.vehicle) {
            command.target_system = vehicle.system;
            command.target_component = AUTOPILOT;
        }
        self.send(&message);
    }

    fn push(&mut self, event: Event) {
        if self.events.len() >= MAX_QUEUED {
            self.events.pop_front();
        }
        self.events.push_back(event);
    }

    /// Notices that heartbeats are missing. While this process did not run, for `stood_ns`, none was.
    fn check_silence(&mut self, now_ns: i64, stood_ns: Option<i64>) {
        let Some(vehicle) = &mut self.vehicle else { return };
        if let Some(stood_ns) = stood_ns {
            vehicle.heartbeat_ns = without_standstill(vehicle.heartbeat_ns, now_ns, stood_ns);
        }
        let silence_ns = now_ns.saturating_sub(vehicle.heartbeat_ns);
        if vehicle.state.connected && silence_ns > ns(self.config.heartbeat_timeout) {
            vehicle.state.connected = false;
            // It may have restarted when it returns, or be another one, so its earlier reports do not hold.
            vehicle.readiness = Readiness::default();
            vehicle.listener = Listener::default();
            vehicle.simulation = Simulation::default();
            vehicle.state.ready = false;
            let (silence_ns, state) = (silence_ns.max(0) as u64, vehicle.state);
            self.push(Event::Lost { silence: Duration::from_nanos(silence_ns) });
            self.push(Event::Status(state));
            self.fail_requests(|command| CommandError::NoAutopilot { command });
        }
    }

    fn take_acknowledgement(&mut self, now_ns: i64, ack: &COMMAND_ACK_DATA) {
        // Old autopilots do not address the requester; others may address a ground station that requested the
        // same.
        let ours = self.our_address();
        let is_ours = ack.target_system == 0
            || (ack.target_system == ours.system
                && [0, ours.component].contains(&ack.target_component));
        if !is_ours {
            return;
        }
        if ack.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL {
            self.streams.acknowledged(now_ns, ack.result);
            return;
        }
        if let MavCmd::MAV_CMD_RUN_PREARM_CHECKS = ack.command {
            self.vehicle.iter_mut().for_each(|vehicle| vehicle.listener.acknowledged(ack.result));
            return;
        }
        let timeouts = self.config.timeouts;
        for request in self.requests.iter_mut().filter(|r| r.command.is_answered_by(ack.command)) {
            request.acknowledge(now_ns, ack.result, &timeouts);
        }
    }

    fn take_state(&mut self, now_ns: i64, message: &MavMessage) {
        let Some(vehicle) = &mut self.vehicle else { return };
        vehicle.simulation.take(message);
        let state = &mut vehicle.state;
        match message {
            MavMessage::ATTITUDE(message) => {
                let attitude = Attitude::from_angles(now_ns, message);
                self.take_attitude(now_ns, attitude);
            }
            MavMessage::ATTITUDE_QUATERNION(message) => {
                let attitude = Attitude::from_quaternion(now_ns, message);
                self.take_attitude(now_ns, attitude);
            }
            MavMessage::LOCAL_POSITION_NED(message) => {
                let position = Position::from_local(now_ns, message);
                self.take_position(now_ns, position);
            }
            MavMessage::DISTANCE_SENSOR(message) => {
                if let Some(range) = Range::downwards(now_ns, message) {
                    state.range = Some(range);
                    self.push(Event::Range(range));
                }
            }
            MavMessage::EXTENDED_SYS_STATE(message) => {
                let reported = LandedState::from(message.landed_state);
                let recent = state.position.filter(|position| {
                    now_ns.saturating_sub(position.stamp_ns) <= MAX_SPEED_AGE_NS
                });
                let sinks_m_s = recent.map(|position| position.velocity.z());
                let to = vehicle.contact.report(now_ns, reported, state.armed, sinks_m_s);
                let before = std::mem::replace(&mut state.landed, to);
                self.report_contact(before);
            }
            MavMessage::SYS_STATUS(message) => {
                let [status, details] = &mut vehicle.batteries;
                *status = Battery::from_status(message);
                state.battery = status.joined_with(details);
                vehicle.readiness.take_status(message);
                self.check_readiness();
            }
            MavMessage::BATTERY_STATUS(message) if message.id == 0 => {
                let [status, details] = &mut vehicle.batteries;
                *details = Battery::from_details(message);
                state.battery = status.joined_with(details);
            }
            MavMessage::EKF_STATUS_REPORT(message) => {
                vehicle.readiness.take_ekf(message.flags);
                self.check_readiness();
            }
            MavMessage::ESTIMATOR_STATUS(message) => {
                vehicle.readiness.take_estimator(message.flags);
                self.check_readiness();
            }
            MavMessage::GLOBAL_POSITION_INT(message) => {
                vehicle.amsl_m = Some(f64::from(message.alt) * 1e-3);
            }
            _ => {}
        }
    }

    fn take_attitude(&mut self, now_ns: i64, attitude: Option<Attitude>) {
        let Some(mut attitude) = attitude else {
            self.refused_numbers += 1;
            return;
        };
        let newest = self.state().and_then(|state| state.attitude).map(|known| known.boot_ms);
        if !self.is_present(now_ns, attitude.boot_ms, newest) {
            return;
        }
        let Some(stamp_ns) = self.measured_ns(now_ns, attitude.boot_ms) else { return };
        attitude.stamp_ns = stamp_ns;
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.state.attitude = Some(attitude);
            vehicle.state.stamp_ns = now_ns;
            let state = vehicle.state;
            self.push(Event::Attitude(attitude));
            self.push(Event::State(state));
        }
    }

    fn take_position(&mut self, now_ns: i64, position: Option<Position>) {
        let Some(mut position) = position else {
            self.refused_numbers += 1;
            return;
        };
        let newest = self.state().and_then(|state| state.position);
        if !self.is_present(now_ns, position.boot_ms, newest.map(|known| known.boot_ms)) {
            return;
        }
        if newest.is_some_and(|known| position.repeats(&known)) {
            // It is as old as the first of its kind.
            self.late += 1;
            return;
        }
        self.clock.position_arrived(now_ns);
        let Some(stamp_ns) = self.measured_ns(now_ns, position.boot_ms) else { return };
        position.stamp_ns = stamp_ns;
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.readiness.take_position();
            vehicle.state.position = Some(position);
            vehicle.state.stamp_ns = now_ns;
            let state = vehicle.state;
            self.push(Event::Position(position));
            self.push(Event::State(state));
            self.check_readiness();
        }
    }

    /// When a measurement that comes now was made, by our clock; that of its reception where the offset is unknown. `None` for one
    /// that was made too long ago, which is counted as late.
    fn measured_ns(&mut self, now_ns: i64, boot_ms: u32) -> Option<i64> {
        match self.clock.arrived(now_ns, boot_ms) {
            Measured::At(stamp_ns) => Some(stamp_ns),
            Measured::Unknown => Some(now_ns),
            Measured::LongAgo => {
                self.late += 1;
                None
            }
        }
    }

    /// False for a measurement that is older than the `newest` of its kind, or whose time contradicts the
    /// others. Detects a restart by the autopilot's clock, which may be quicker than by a lost heartbeat.
    fn is_present(&mut self, now_ns: i64, boot_ms: u32, newest: Option<u32>) -> bool {
        let Some(vehicle) = &mut self.vehicle else { return false };
        let is_present = match vehicle.boot.take(now_ns, boot_ms) {
            BootTime::Present => self.clock.is_newest(now_ns, boot_ms, newest),
            BootTime::Contradicts => false,
            BootTime::Restarted => {
                self.restarted(now_ns.saturating_sub(i64::from(boot_ms) * 1_000_000));
                true
            }
        };
        self.late += u64::from(!is_present);
        is_present
    }

    fn restarted(&mut self, started_ns: i64) {
        let Some(vehicle) = &mut self.vehicle else { return };
        vehicle.readiness = Readiness::default();
        vehicle.listener = Listener::default();
        vehicle.contact = Contact::default();
        vehicle.state.attitude = None;
        vehicle.state.position = None;
        vehicle.state.range = None;
        vehicle.state.ready = false;
        let before = std::mem::replace(&mut vehicle.state.landed, LandedState::Unknown);
        vehicle.amsl_m = None;
        self.clock.restart();
        self.parameters.restart();
        self.streams.restart();
        self.push(Event::Restarted { started_ns });
        self.report_contact(before);
        self.fail_requests(|command| CommandError::Restarted { command });
    }

    fn check_readiness(&mut self) {
        let Some(vehicle) = &mut self.vehicle else { return };
        let ready = vehicle.readiness.is_ready();
        if std::mem::replace(&mut vehicle.state.ready, ready) != ready {
            let reasons = vehicle.readiness.reasons();
            self.push(Event::ReadyChanged { ready, reasons });
        }
    }

    /// Why a command is not sent.
    fn refusal(&self, command: Command) -> Option<CommandError> {
        let vehicle = self.vehicle.as_ref().filter(|vehicle| vehicle.state.connected);
        let Some(vehicle) = vehicle else { return Some(CommandError::NoAutopilot { command }) };
        if vehicle.firmware.guided().is_none() {
            return Some(CommandError::Unsupported { command, firmware: vehicle.firmware });
        }
        let is_blind = vehicle.firmware == Firmware::Px4 && vehicle.amsl_m.is_none();
        if matches!(command, Command::Takeoff { .. }) && is_blind {
            let reason =
                "PX4 has not reported its altitude above mean sea level (GLOBAL_POSITION_INT)";
            return Some(CommandError::Invalid { command, reason });
        }
        let reason = command.why_invalid(Some(&vehicle.state))?;
        Some(CommandError::Invalid { command, reason })
    }

    /// Advances the requests. Only a tick may send: the packet that is read may have waited for this process, and one that shows a
    /// pilot's mode may still wait behind it.
    fn step_requests(&mut self, now_ns: i64, may_send: bool) {
        let Some(state) = self.state().copied() else { return };
        let is_of_now = self.shows_mode_of_now(now_ns);
        let timeouts = self.config.timeouts;
        let mut index = 0;
        while let Some(request) = self.requests.get_mut(index) {
            match request.step(now_ns, &state, is_of_now, may_send, &timeouts) {
                Step::Wait => index += 1,
                Step::Send(command, attempt) => {
                    index += 1;
                    if command.is_offboard() {
                        self.offboard_sent_ns = Some(now_ns);
                    }
                    let message = command.message(attempt, self.ground_amsl_m());
                    self.send_to_vehicle(MavMessage::COMMAND_LONG(message));
                }
                Step::Finish(result) => {
                    let request = self.requests.remove(index);
                    let result = result.map_err(|error| self.explained(error));
                    self.finish(request.id, request.command, result);
                }
            }
        }
    }

    fn fail_requests(&mut self, error: impl Fn(Command) -> CommandError) {
        for request in std::mem::take(&mut self.requests) {
            self.finish(request.id, request.command, Err(error(request.command)));
        }
    }

    fn finish(&mut self, id: CommandId, command: Command, result: Result<(), CommandError>) {
        let status = match &result {
            Ok(()) => CommandStatus::Done,
            Err(error) => CommandStatus::Failed(error.clone()),
        };
        if self.outcomes.len() >= MAX_OUTCOMES {
            self.outcomes.pop_front();
        }
        self.outcomes.push_back((id, status));
        self.push(Event::Command { id, command, result });
    }
}

/// A request for the time (`tc1` zero), or the reply to one.
fn timesync(tc1: i64, ts1: i64, to: Sender) -> MavMessage {
    MavMessage::TIMESYNC(TIMESYNC_DATA {
        tc1,
        ts1,
        target_system: to.system,
        target_component: to.component,
    })
}
