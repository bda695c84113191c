//! The client's part for HEARTBEAT and PX4's CURRENT_MODE: finds the vehicle and its firmware, and follows its flight mode, motors
//! and contact with the ground.

use super::{Autopilot, Vehicle};
use crate::boot::BootClock;
use crate::command::MODE_OF_NOW_NS;
use crate::contact::Contact;
use crate::dialect::{CURRENT_MODE_DATA, HEARTBEAT_DATA, MavModeFlag, MavState};
use crate::event::Event;
use crate::mode::{Firmware, FlightMode};
use crate::px4_listener::Listener;
use crate::simulation::Simulation;
use crate::state::{Battery, LandedState, Readiness, VehicleState};
use crate::stream::{self, Streams};
use crate::text::Joiner;

/// Time for which a heartbeat may come behind CURRENT_MODE, in nanoseconds, in addition to the link's delay up to as long.
const OVERTAKEN_NS: i64 = 300_000_000;

/// CURRENT_MODE's number of a chosen mode that the autopilot does not state.
const NOT_SUPPLIED: u32 = 0;

/// Whether a heartbeat reports motors that are armed. Those of a PX4 that its kill switch or its flight termination has stopped stay armed, for
/// 5 s (`COM_KILL_DISARM`) or for ever; its heartbeat shows the stop (`streams/HEARTBEAT.hpp`).
fn runs(firmware: Firmware, heartbeat: &HEARTBEAT_DATA) -> bool {
    let is_killed = firmware == Firmware::Px4
        && (heartbeat.system_status == MavState::MAV_STATE_FLIGHT_TERMINATION
            || FlightMode::of(firmware, heartbeat.custom_mode) == FlightMode::TERMINATION);
    heartbeat.base_mode.contains(MavModeFlag::MAV_MODE_FLAG_SAFETY_ARMED) && !is_killed
}

impl Autopilot {
    pub(super) fn take_heartbeat(&mut self, now_ns: i64, system: u8, heartbeat: &HEARTBEAT_DATA) {
        if self.config.system_id.is_some_and(|pinned| pinned != system) {
            return;
        }
        match &self.vehicle {
            None => self.find(now_ns, system, heartbeat),
            Some(vehicle) if vehicle.system != system => {
                if self.other_system.is_none() {
                    self.other_system = Some(system);
                    self.push(Event::OtherVehicle { system });
                }
                return;
            }
            Some(_) => {}
        }
        self.follow_heartbeat(now_ns, heartbeat);
        self.step_requests(now_ns, false);
    }

    fn find(&mut self, now_ns: i64, system: u8, heartbeat: &HEARTBEAT_DATA) {
        let firmware = Firmware::of(heartbeat);
        let mode = FlightMode::of(firmware, heartbeat.custom_mode);
        self.vehicle = Some(Vehicle {
            system,
            firmware,
            state: VehicleState {
                stamp_ns: now_ns,
                attitude: None,
                position: None,
                range: None,
                mode,
                armed: false,
                landed: LandedState::Unknown,
                ready: false,
                battery: Battery::default(),
                connected: true,
            },
            readiness: Readiness::default(),
            simulation: Simulation::default(),
            found_ns: now_ns,
            contact_ns: now_ns,
            heartbeat_ns: now_ns,
            mode_ns: now_ns,
            mode_since_ns: now_ns,
            mode_before: None,
            received_ns: now_ns,
            boot: BootClock::default(),
            contact: Contact::default(),
            batteries: [Battery::default(); 2],
            amsl_m: None,
            joiner: Joiner::default(),
            listener: Listener::default(),
        });
        if self.stopped_system == Some(system) {
            self.offboard_return.taken_over(now_ns, mode);
        }
        self.streams = Streams::new(&stream::of_firmware(firmware, &self.config.streams));
        self.push(Event::Found { system, firmware });
        self.push(Event::ModeChanged { from: None, to: mode });
    }

    fn follow_heartbeat(&mut self, now_ns: i64, heartbeat: &HEARTBEAT_DATA) {
        let is_overtaken = self.is_overtaken(now_ns, heartbeat.custom_mode);
        let Some(vehicle) = &mut self.vehicle else { return };
        let is_terminated = vehicle.state.mode == FlightMode::TERMINATION;
        let armed = runs(vehicle.firmware, heartbeat) && !(is_overtaken && is_terminated);
        let state = &mut vehicle.state;
        vehicle.heartbeat_ns = now_ns;
        vehicle.simulation.take_mode(heartbeat.base_mode);
        vehicle.received_ns = now_ns;
        state.stamp_ns = now_ns;
        let returned = !std::mem::replace(&mut state.connected, true);
        vehicle.contact_ns = if returned { now_ns } else { vehicle.contact_ns };
        let armed_changed = std::mem::replace(&mut state.armed, armed) != armed;
        let landed = if armed { state.landed } else { vehicle.contact.disarmed() };
        let landed_before = std::mem::replace(&mut state.landed, landed);
        if returned {
            self.streams.restart();
            self.push(Event::Returned);
        }
        if !is_overtaken {
            let is_failsafe = heartbeat.system_status == MavState::MAV_STATE_CRITICAL;
            self.take_mode(now_ns, heartbeat.custom_mode, is_failsafe);
        }
        if armed_changed {
            self.push(Event::ArmedChanged(armed));
        }
        self.report_contact(landed_before);
    }

    /// Takes the mode that PX4 sends in addition to the heartbeat. When the motors stop after a landing PX4 goes back to OFFBOARD, which the
    /// heartbeat shows together with the motors, so on the ground, and for that change, the heartbeat alone counts. Without a
    /// heartbeat the message does not count.
    ///
    /// The mode that was chosen, in the same message, shows whether another one is a failsafe of OFFBOARD or a pilot's choice.
    pub(super) fn take_current_mode(&mut self, now_ns: i64, message: &CURRENT_MODE_DATA) {
        let number = message.custom_mode;
        let Some(state) = self.state().filter(|state| state.connected) else { return };
        let to = FlightMode::of(Firmware::Px4, number);
        let may_be_the_end =
            state.mode.is_landing() && to.is_guided() && !self.is_requesting_offboard();
        if !state.landed.is_flying() || may_be_the_end {
            return;
        }
        let (before, was_expected) = (state.mode, self.offboard_return.is_expected(now_ns));
        if message.intended_custom_mode != NOT_SUPPLIED {
            let chosen = FlightMode::of(Firmware::Px4, message.intended_custom_mode);
            self.offboard_return.reported(now_ns, to, chosen);
        }
        let is_changed = self.take_mode(now_ns, number, false);
        let mut is_killed = false;
        if is_changed && let Some(vehicle) = &mut self.vehicle {
            vehicle.mode_before = Some((before, now_ns));
            // The heartbeat that reports it follows up to a second later.
            let state = &mut vehicle.state;
            is_killed = to == FlightMode::TERMINATION && std::mem::take(&mut state.armed);
        }
        if is_killed {
            self.push(Event::ArmedChanged(false));
        }
        if is_changed || was_expected != self.offboard_return.is_expected(now_ns) {
            self.report_status();
        }
    }

    /// Whether a heartbeat shows the mode before a change that CURRENT_MODE, sent later, has just shown: a link may reorder packets.
    fn is_overtaken(&self, now_ns: i64, number: u32) -> bool {
        let delay_ns = self.link_delay(now_ns).map_or(0, |delay| delay.as_nanos() as i64);
        let delay_ns = delay_ns.min(OVERTAKEN_NS);
        let before = self.vehicle.as_ref().and_then(|vehicle| vehicle.mode_before);
        before.is_some_and(|(mode, changed_ns)| {
            let is_recent =
                now_ns.saturating_sub(changed_ns) <= OVERTAKEN_NS.saturating_add(delay_ns);
            is_recent && mode == FlightMode::of(Firmware::Px4, number)
        })
    }

    /// Takes a mode that was just shown, perhaps with an active failsafe; true when it is another one than before.
    fn take_mode(&mut self, now_ns: i64, number: u32, is_failsafe: bool) -> bool {
        let Some(vehicle) = &mut self.vehicle else { return false };
        vehicle.mode_ns = now_ns;
        let [attitude_ns, position_ns] = [
            vehicle.state.attitude.map(|it| it.stamp_ns),
            vehicle.state.position.map(|it| it.stamp_ns),
        ];
        self.standstill.mode_shown(now_ns, attitude_ns.max(position_ns));
        let to = FlightMode::of(vehicle.firmware, number);
        let from = std::mem::replace(&mut vehicle.state.mode, to);
        if from != to || now_ns.saturating_sub(vehicle.mode_since_ns) >= MODE_OF_NOW_NS {
            vehicle.mode_since_ns = now_ns;
        }
        if from != to {
            self.offboard_return.mode_changed(now_ns, from, to, is_failsafe);
            self.push(Event::ModeChanged { from: Some(from), to });
        }
        from != to
    }

    /// Reports mode, motors and contact with the ground, and the contact's change from `before`.
    pub(super) fn report_contact(&mut self, before: LandedState) {
        let Some(state) = self.state() else { return };
        if before != state.landed {
            self.push(Event::LandedChanged { from: before, to: state.landed });
        }
        self.report_status();
    }

    fn report_status(&mut self) {
        if let Some(state) = self.state().copied() {
            self.push(Event::Status(state));
        }
    }
}
