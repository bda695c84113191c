//! How slow the link to the autopilot is, as the landing reckons with it: what is measured, for a while what was measured last, or what is
//! assumed of a link that does not tell.

use autopilot::Autopilot;

use crate::refusals::Warning;

/// Change of the delay that the lander is told of, in seconds.
const STEP_S: f64 = 0.01;
/// The delay of a link, both ways together, that does not tell it, in seconds: that of a telemetry radio. A delay that is taken for none
/// makes the vehicle swing over the pad, and one that is taken for longer than it is only makes the landing slower.
const UNKNOWN_S: f64 = 0.3;

/// The link's delay that the lander was told last.
#[derive(Copy, Clone, Debug, Default)]
pub struct LinkDelay {
    seconds: f64,
}

impl LinkDelay {
    /// The delay, both ways together, in seconds; 0 until it is known or given up.
    pub fn seconds(self) -> f64 {
        self.seconds
    }

    /// Follows the link's delay; in seconds when the lander is to be told of another one. Where it is not measured any more, or the
    /// vehicle is silent, it is taken for what it was, until [`Autopilot::lacks_link_delay`].
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

/// That nothing tells how slow the link is, although the autopilot is asked.
pub fn warning(now_ns: i64, autopilot: &Autopilot) -> Option<Warning> {
    autopilot.lacks_link_delay(now_ns).then(|| Warning {
        matter: "link-delay".to_owned(),
        text: format!(
            "the autopilot does not answer TIMESYNC, so the delay of its link is not known: {UNKNOWN_S} s are assumed, and the \
             landing is slower; see whether the link (a telemetry radio, a router) passes TIMESYNC in both directions"
        ),
    })
}
