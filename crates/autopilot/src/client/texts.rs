//! What the autopilot says in texts, and PX4 in events.

use super::Autopilot;
use crate::dialect::{EVENT_DATA, MavSeverity};
use crate::event::Event;
use crate::px4_listener::{About, Heard};
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
        // PX4 sends it twice where it hears a ground station.
        let is_told = is_event && self.vehicle.as_ref().is_some_and(|it| it.listener.has_heard());
        if !is_told {
            self.take_text(severity, text);
        }
    }

    pub(super) fn take_px4_event(&mut self, event: &EVENT_DATA) {
        let Some(vehicle) = &mut self.vehicle else { return };
        let heard = vehicle.listener.take(event);
        vehicle.readiness.take_checks(vehicle.listener.why_not_armed());
        let Some(Heard { severity, text, about }) = heard else { return };
        let is_new = match about {
            About::Else => return self.take_text(severity, text),
            About::Arming { is_new } => {
                self.requests.iter_mut().for_each(|request| request.add_check(&text));
                is_new
            }
            About::Health { is_new } => is_new,
        };
        if is_new {
            self.push(Event::Text { severity, text });
        }
    }
}
