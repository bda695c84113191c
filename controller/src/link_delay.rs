//! The delay of the link to the autopilot for the landing: the measured one, for a while the last measurement, or the delay that is assumed
//! where none can be measured.

use autopilot::Autopilot;

use crate::refusals::Warning;

/// Change of the delay that is passed to the lander, in seconds.
const STEP_S: f64 = 0.01;
/// The delay of a link, both ways together, where it cannot be measured, in seconds: that of a telemetry radio. A delay that is taken for none
/// makes the vehicle swing over the pad, and one that is taken for longer than it is only makes the landing slower.
const UNKNOWN_S: f64 = 0.3;

/// The link's delay that was passed to the lander last.
#[derive(Copy, Clone, Debug, Default)]
pub struct LinkDelay {
    seconds: f64,
}

impl LinkDelay {
    /// The delay, both ways together, in seconds; 0 until it is known or given up.
    pub fn seconds(self) -> f64 {
        self.seconds
    }

    /// Follows the link's delay; in seconds when the lander must receive another one. Where it is not measured any more, or the
    /// vehicle is silent, the last delay is assumed, until [`Autopilot::lacks_link_delay`].
    pub fn step(&mut self, now_ns: i64, autopilot: &Autopilot) -> Option<f64> {
        let seconds = match autopilot.link_delay(now_ns) {
            Some(delay) => delay.as_secs_f64(),
            None if autopilot.lacks_link_delay(now_ns) => UNKNOWN_S,
            None => self.seconds,
        };
        let is_other = (seconds - self.seconds).abs() > STEP_S;
        is_other.then(|| {
            self.seconds = seconds;
            seconds
        })
    }
}

/// The warning that the link's delay cannot be measured, although the autopilot is asked.
pub fn warning(now_ns: i64, autopilot: &Autopilot) -> Option<Warning> {
    autopilot.lacks_link_delay(now_ns).then(|| Warning {
        matter: "link-delay".to_owned(),
        text: format!(
            "the autopilot does not answer TIMESYNC, so the delay of its link is not known: {UNKNOWN_S} s are assumed, and the \
             landing is slower; see whether the link (a telemetry radio, a router) passes TIMESYNC in both directions"
        ),
    })
}
