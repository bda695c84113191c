//! Watches for a PX4 that flies in OFFBOARD while no setpoint is sent to it, and leads it out into HOLD.
//!
//! Every part that steers leads the vehicle out of OFFBOARD itself when it ends. This is for cases that no part expects: a withdrawn
//! request that is carried out late, a takeover that was none, another station that chooses OFFBOARD while zeros are sent.

use autopilot::{Autopilot, OffboardExit};

/// Time without a setpoint after which no part steers, in nanoseconds: PX4 waits for half a second or more (`COM_OF_LOSS_T`).
const UNSTEERED_NS: i64 = 150_000_000;
/// Time after our last setpoint or request for OFFBOARD up to which OFFBOARD is ours, in nanoseconds: later it is another
/// program's.
const OURS_NS: i64 = 10_000_000_000;

/// Watches for OFFBOARD in which no part of the flight steers.
#[derive(Clone, Debug, Default)]
pub struct OffboardWatch {
    exit: Option<OffboardExit>,
    /// It was led out, or in vain, since something steered it: OFFBOARD is another program's from then on.
    is_done: bool,
}

impl OffboardWatch {
    /// Advances it, after all parts that may steer; to be called with each tick. True while it leads the vehicle out.
    pub fn step(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        self.lead_out(now_ns, autopilot, !is_steered(now_ns, autopilot))
    }

    /// The same when the steering part ends: a vehicle in OFFBOARD is led out at once.
    pub fn end(&mut self, now_ns: i64, autopilot: &mut Autopilot) -> bool {
        self.lead_out(now_ns, autopilot, true)
    }

    /// Something steers: nothing is left.
    pub fn stand_down(&mut self) {
        *self = Self::default();
    }

    /// True while it leads the vehicle out.
    pub fn is_leading_out(&self) -> bool {
        self.exit.is_some()
    }

    /// True while it leads the vehicle out, or is about to, as nothing steers it.
    pub fn is_due(&self, now_ns: i64, autopilot: &Autopilot) -> bool {
        let is_left = is_flying_offboard(autopilot) && is_ours(now_ns, autopilot);
        self.exit.is_some() || is_left && !self.is_done
    }

    fn lead_out(&mut self, now_ns: i64, autopilot: &mut Autopilot, is_left: bool) -> bool {
        let is_left = is_left && is_flying_offboard(autopilot) && is_ours(now_ns, autopilot);
        if self.exit.is_none() && is_left && !self.is_done {
            tracing::warn!("PX4 is in OFFBOARD without setpoints: it is asked to hold its place");
            self.exit = Some(OffboardExit::begin(now_ns, autopilot));
        }
        let goes_on = self.exit.as_mut().is_some_and(|exit| exit.step(now_ns, autopilot));
        if !goes_on && self.exit.take().is_some() {
            self.is_done = true;
        }
        goes_on
    }
}

fn is_flying_offboard(autopilot: &Autopilot) -> bool {
    let flies = autopilot.state().is_some_and(|state| state.armed && state.landed.is_flying());
    flies && autopilot.is_in_offboard()
}

/// Whether a setpoint was sent of late, a zero or another.
fn is_steered(now_ns: i64, autopilot: &Autopilot) -> bool {
    let sent_ns = autopilot.setpoint_sent_ns();
    sent_ns.is_some_and(|sent_ns| now_ns.saturating_sub(sent_ns) <= UNSTEERED_NS)
}

fn is_ours(now_ns: i64, autopilot: &Autopilot) -> bool {
    let sent_ns = autopilot.setpoint_sent_ns().max(autopilot.offboard_sent_ns());
    sent_ns.is_some_and(|sent_ns| now_ns.saturating_sub(sent_ns) <= OURS_NS)
}
