//! Simulates the same vehicle under PX4's rules, taken from its documentation: modes by two numbers,
//! OFFBOARD only with a stream of setpoints before and during
//! (<https://docs.px4.io/main/en/flight_modes/offboard.html>), a takeoff to an altitude over the sea, a heartbeat with the mode
//! once a second, and events with the checks before arming that fail: after a change and on request. Measured with 1.17 in its
//! own simulation: HOLD as the failsafe for missing setpoints, and OFFBOARD again with the next one, as long as no other mode is
//! chosen; CURRENT_MODE, if it is requested, with each change and twice a second, the former mode once more after an
//! accepted request, and OFFBOARD again when the motors stop after a landing. From its sources (since 1.15): the mode that the user chose
//! last stays OFFBOARD in that failsafe (`Failsafe::checkModeFallback` changes a copy of it, `Commander::handleModeIntentionAndFailsafe`
//! stores both), CURRENT_MODE states both modes (`streams/CURRENT_MODE.hpp`), and the heartbeat states that a failsafe is active
//! (`streams/HEARTBEAT.hpp`: MAV_STATE_CRITICAL).

use autopilot::FlightMode;
use autopilot::dialect::{
    CURRENT_MODE_DATA, ESTIMATOR_STATUS_DATA, EVENT_DATA, EstimatorStatusFlags, MavMessage,
};

use super::flight::{Landed, Mode};

/// The number of CURRENT_MODE.
pub(super) const CURRENT_MODE: u32 = 436;
/// Minimum time for which setpoints must have arrived at 2 Hz or more, in seconds.
const STREAM_S: f64 = 1.0;
const STREAM_GAP_S: f64 = 0.5;
/// Period of CURRENT_MODE while the mode does not change, in seconds.
const CURRENT_MODE_S: f64 = 0.5;
/// The events that begin and end a report of all failing checks, and the check of a position.
const CHECKS_BEGIN: u32 = 0x01a8_93e0;
const CHECKS_END: u32 = 0x011d_3727;
const NO_POSITION: u32 = 0x01d3_1bb9;
/// Their levels, for the log and for others: those of events for programs, and of an error.
const FOR_PROGRAMS: u8 = 0x88;
const ERROR: u8 = 0x33;
/// The modes for which the check of a position fails: those of a landing are among them.
const WITH_POSITION: u32 = 0x0016_4038;
/// Where the first event has the modes in which it can be armed, in bytes.
const CAN_ARM_AT: usize = 9;

/// The state of a PX4 in addition to ArduPilot's.
#[derive(Clone, Debug, Default)]
pub(super) struct Px4 {
    /// Since when setpoints have come, and when the last one did.
    stream: Option<(f64, f64)>,
    /// OFFBOARD is the mode that was chosen.
    offboard: bool,
    /// It holds its place as setpoints are missing.
    is_failsafe: bool,
    /// It was in OFFBOARD before it landed.
    landed_from_offboard: bool,
    pub(super) precision: bool,
    /// Number of its events so far.
    events: u16,
    /// The mode that CURRENT_MODE reported last, and when.
    reported: Option<(Reported, f64)>,
}

/// What a PX4 reports of its mode.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct Reported {
    /// The mode in which it flies.
    pub(super) mode: FlightMode,
    /// The mode that its user chose last.
    pub(super) chosen: FlightMode,
    /// A failsafe has changed the mode.
    pub(super) is_failsafe: bool,
}

impl Px4 {
    /// The events of a report of all failing checks.
    pub(super) fn checks(&mut self, has_position: bool) -> Vec<MavMessage> {
        let can_arm = if has_position { u32::MAX } else { !WITH_POSITION };
        let mut summary = [0; CAN_ARM_AT + 4];
        summary
            .iter_mut()
            .skip(CAN_ARM_AT)
            .zip(can_arm.to_le_bytes())
            .for_each(|(to, of)| *to = of);
        let mut events = vec![self.event(CHECKS_BEGIN, FOR_PROGRAMS, &summary)];
        if !has_position {
            events.push(self.event(NO_POSITION, ERROR, &WITH_POSITION.to_le_bytes()));
        }
        events.push(self.event(CHECKS_END, FOR_PROGRAMS, &[]));
        events
    }

    fn event(&mut self, id: u32, log_levels: u8, arguments: &[u8]) -> MavMessage {
        self.events = self.events.wrapping_add(1);
        let sequence = self.events;
        let mut event = EVENT_DATA { id, log_levels, sequence, ..EVENT_DATA::default() };
        event.arguments.iter_mut().zip(arguments).for_each(|(to, of)| *to = *of);
        MavMessage::EVENT(event)
    }

    /// A setpoint; true when it ends the failsafe, and OFFBOARD continues.
    pub(super) fn on_setpoint(&mut self, now_s: f64) -> bool {
        let continuing = self.stream.filter(|(_, last_s)| now_s - last_s <= STREAM_GAP_S);
        self.stream = Some((continuing.map_or(now_s, |(since_s, _)| since_s), now_s));
        std::mem::take(&mut self.is_failsafe)
    }

    /// The requested mode in ArduPilot's terms; `None` when it is refused.
    pub(super) fn request(&mut self, now_s: f64, main: u8, sub: u8) -> Option<Mode> {
        let is_streaming = self.stream.is_some_and(|(since_s, last_s)| {
            now_s - since_s >= STREAM_S && now_s - last_s <= STREAM_GAP_S
        });
        let mode = match (main, sub) {
            (6, _) if is_streaming => Mode::Guided,
            (4, 6 | 9) => Mode::Land,
            (4, 3) => Mode::Loiter,
            (3, _) => Mode::PosHold,
            _ => return None,
        };
        self.landed_from_offboard =
            mode == Mode::Land && (self.offboard || self.landed_from_offboard);
        (self.offboard, self.is_failsafe) = (mode == Mode::Guided, false);
        self.precision = (main, sub) == (4, 9);
        Some(mode)
    }

    /// True when CURRENT_MODE is to be sent.
    pub(super) fn reports_mode(&mut self, now_s: f64, mode: Reported) -> bool {
        let is_due =
            self.reported.is_none_or(|(last, at_s)| last != mode || now_s - at_s >= CURRENT_MODE_S);
        if is_due {
            self.reported = Some((mode, now_s));
        }
        is_due
    }

    pub(super) fn on_takeoff(&mut self) {
        (self.offboard, self.is_failsafe) = (false, false);
    }

    /// True while it follows setpoints.
    pub(super) fn is_offboard(&self) -> bool {
        self.offboard && !self.is_failsafe
    }

    /// True when the setpoints of OFFBOARD have just been missed for longer than `timeout_s`.
    pub(super) fn has_lost_setpoints(&mut self, now_s: f64, timeout_s: f64) -> bool {
        let lost =
            self.is_offboard() && self.stream.is_none_or(|(_, last_s)| now_s - last_s > timeout_s);
        self.is_failsafe |= lost;
        lost
    }

    /// The motors stop; true when it goes back to the mode before its landing, OFFBOARD (as 1.17 does in its own simulation).
    pub(super) fn ends_landing(&mut self) -> bool {
        self.offboard |= self.landed_from_offboard;
        std::mem::take(&mut self.landed_from_offboard)
    }

    /// What is reported of the mode.
    pub(super) fn report(&self, mode: Mode, landed: Landed) -> Reported {
        let mode = self.shown(mode, landed);
        let chosen = if self.is_failsafe { FlightMode::OFFBOARD } else { mode };
        Reported { mode, chosen, is_failsafe: self.is_failsafe }
    }

    /// The mode that the heartbeat reports.
    fn shown(&self, mode: Mode, landed: Landed) -> FlightMode {
        match mode {
            Mode::Guided if self.is_offboard() => FlightMode::OFFBOARD,
            Mode::Guided if landed == Landed::TakingOff => FlightMode::AUTO_TAKEOFF,
            Mode::Guided | Mode::Loiter | Mode::Brake => FlightMode::AUTO_HOLD,
            Mode::Land if self.precision => FlightMode::AUTO_PRECLAND,
            Mode::Land => FlightMode::AUTO_LAND,
            Mode::Stabilize | Mode::AltHold | Mode::PosHold => FlightMode::Px4(3 << 16),
        }
    }
}

/// PX4's report of its mode.
pub(super) fn current_mode(reported: Reported) -> MavMessage {
    MavMessage::CURRENT_MODE(CURRENT_MODE_DATA {
        custom_mode: reported.mode.custom_mode(),
        intended_custom_mode: reported.chosen.custom_mode(),
        ..CURRENT_MODE_DATA::default()
    })
}

/// PX4's report of its estimator.
pub(super) fn estimator_status(has_position: bool) -> MavMessage {
    // Attitude and vertical motion; with a position also horizontal motion and places.
    let bits = if has_position { 831 } else { 1 + 4 + 32 };
    MavMessage::ESTIMATOR_STATUS(ESTIMATOR_STATUS_DATA {
        flags: EstimatorStatusFlags::from_bits_truncate(bits),
        ..ESTIMATOR_STATUS_DATA::default()
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn offboard_needs_setpoints_before_and_during() {
        let mut px4 = Px4::default();
        assert_eq!(px4.request(0.0, 6, 0), None, "no setpoint yet");
        for step in 0..12 {
            px4.on_setpoint(0.1 * f64::from(step));
        }
        assert_eq!(px4.request(1.15, 6, 0), Some(Mode::Guided));
        assert_eq!(px4.shown(Mode::Guided, Landed::InAir), FlightMode::OFFBOARD);
        assert!(!px4.has_lost_setpoints(2.0, 1.0));
        assert!(px4.has_lost_setpoints(2.2, 1.0), "its failsafe");
        let failsafe = px4.report(Mode::Loiter, Landed::InAir);
        let (mode, chosen) = (FlightMode::AUTO_HOLD, FlightMode::OFFBOARD);
        assert_eq!(failsafe, Reported { mode, chosen, is_failsafe: true });
        assert!(px4.reports_mode(2.2, failsafe) && !px4.reports_mode(2.3, failsafe));
        assert!(px4.on_setpoint(5.0), "the mode that was chosen is OFFBOARD still");
        assert_eq!(px4.shown(Mode::Guided, Landed::InAir), FlightMode::OFFBOARD);
        assert!(px4.has_lost_setpoints(6.1, 1.0));
        assert_eq!(px4.request(6.2, 4, 3), Some(Mode::Loiter));
        // The same mode, chosen now, is reported at once.
        let held = px4.report(Mode::Loiter, Landed::InAir);
        assert_eq!(held, Reported { mode, chosen: mode, is_failsafe: false });
        assert!(px4.reports_mode(2.3, held));
        assert!(!px4.on_setpoint(7.0), "HOLD was chosen");
        assert_eq!(px4.request(7.1, 6, 0), None, "a gap begins the stream again");
    }

    #[test]
    fn land_and_precision_land_are_distinguished() {
        let mut px4 = Px4::default();
        assert_eq!(px4.request(0.0, 4, 6), Some(Mode::Land));
        assert_eq!(px4.shown(Mode::Land, Landed::Landing), FlightMode::AUTO_LAND);
        assert_eq!(px4.request(0.0, 4, 9), Some(Mode::Land));
        assert_eq!(px4.shown(Mode::Land, Landed::Landing), FlightMode::AUTO_PRECLAND);
        assert_eq!(px4.shown(Mode::Guided, Landed::TakingOff), FlightMode::AUTO_TAKEOFF);
    }
}
