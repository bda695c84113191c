//! The client's part for STATUSTEXT and PX4's EVENT: reports texts as events, and explains a refusal to arm by the checks that fail.

use super::Autopilot;
use crate::command::{Command, CommandError};
use crate::dialect::{EVENT_DATA, MavSeverity};
use crate::event::Event;
use crate::mode::Firmware;
use crate::px4_listener::{About, EventText};
use crate::text::Text;

impl Autopilot {
    fn take_text(&mut self, severity: MavSeverity, text: String) {
        // Information ("Arming motors") does not explain a refusal.
        if (severity as u8) <= MavSeverity::MAV_SEVERITY_WARNING as u8 {
            for request in &mut self.requests {
                request.add_text(&text);
            }
        }
        if let Some(vehicle) = &mut self.vehicle {
            vehicle.readiness.take_text(&text);
        }
        self.push(Event::Text { severity, text });
    }

    pub(super) fn take_statustext(&mut self, Text { severity, text, is_event }: Text) {
        let is_reported =
            is_event && self.vehicle.as_mut().is_some_and(|it| it.listener.is_reported(&text));
        if !is_reported {
            self.take_text(severity, text);
        }
    }

    /// A disarmed PX4 that was found, returned or started again is asked which checks fail. ArduPilot repeats its reasons on its own.
    pub(super) fn ask_for_checks(&mut self, now_ns: i64) {
        let is_px4 = |vehicle: &&mut super::Vehicle| vehicle.firmware == Firmware::Px4;
        let Some(vehicle) = self.vehicle.as_mut().filter(is_px4) else { return };
        if let Some(question) = vehicle.listener.question(now_ns, vehicle.state.armed) {
            self.send_to_vehicle(question);
        }
    }

    /// A refusal to arm with the checks that prevent it: PX4 need not report a check again.
    pub(super) fn explained(&self, error: CommandError) -> CommandError {
        let (CommandError::Refused { command: Command::Arm, result, mut texts }, Some(vehicle)) =
            (error.clone(), &self.vehicle)
        else {
            return error;
        };
        for check in vehicle.listener.preventing() {
            if !texts.iter().any(|text| text == check) {
                texts.push(check.to_owned());
            }
        }
        CommandError::Refused { command: Command::Arm, result, texts }
    }

    pub(super) fn take_px4_event(&mut self, event: &EVENT_DATA) {
        let Some(vehicle) = &mut self.vehicle else { return };
        let received = vehicle.listener.take(event);
        let why = vehicle.listener.why_not_armed();
        // The old reason holds until the next report has one, or has ended.
        if why.is_some() || !vehicle.listener.in_report() {
            vehicle.readiness.take_checks(why);
        }
        let Some(EventText { severity, text, about, is_reported }) = received else { return };
        let is_new = match about {
            About::Else if is_reported => return,
            About::Else => return self.take_text(severity, text),
            About::Arming { is_new } => {
                self.requests.iter_mut().for_each(|request| request.add_check(&text));
                is_new
            }
            About::Health { is_new } => is_new,
        };
        if is_new && !is_reported {
            self.push(Event::Text { severity, text });
        }
    }
}
