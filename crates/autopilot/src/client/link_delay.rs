//! The client's part for the link's delay: states how slow the link is, and whether that is not measured.

use std::time::Duration;

use super::Autopilot;
use crate::standstill::without_standstill;

/// The delay for which an unsteady link counts.
const UNSTEADY: Duration = Duration::from_secs(1);
/// Time within which the clock's answers show how slow the link is, in nanoseconds: it is requested ten times a second.
const LINK_DELAY_DUE_NS: i64 = 3_000_000_000;
/// Time for which a delay counts that is not measured any more, in nanoseconds.
const MAX_LINK_DELAY_AGE_NS: i64 = 10_000_000_000;

impl Autopilot {
    /// The shortest round trip to the autopilot; `None` while its clock is not known and measurements are
    /// stamped with the time of their reception.
    pub fn round_trip(&self, now_ns: i64) -> Option<Duration> {
        self.clock.round_trip_ns(now_ns).map(|ns| Duration::from_nanos(ns.max(0).unsigned_abs()))
    }

    /// How slow the link is now, both ways together; `None` while it is not known. A link that delays most packets
    /// by a varying time is as slow as its late packets.
    pub fn link_delay(&self, now_ns: i64) -> Option<Duration> {
        if self.vehicle.as_ref().is_some_and(|vehicle| vehicle.boot.is_unsteady()) {
            return Some(UNSTEADY);
        }
        self.clock.link_delay_ns(now_ns).map(|ns| Duration::from_nanos(ns.max(0).unsigned_abs()))
    }

    /// Whether the link's delay is unknown after 3 s of connection, or has not been measured for 10 s. Then the clock is not
    /// requested ([`Config::timesync`](crate::config::Config::timesync)), or the link does not pass the requests or the answers.
    pub fn lacks_link_delay(&self, now_ns: i64) -> bool {
        let vehicle = self.vehicle.as_ref().filter(|vehicle| vehicle.state.connected);
        let Some(vehicle) = vehicle else { return false };
        let has_passed = |since_ns: i64, limit_ns: i64| now_ns.saturating_sub(since_ns) >= limit_ns;
        has_passed(vehicle.contact_ns, LINK_DELAY_DUE_NS)
            && self.link_delay_ns.is_none_or(|at_ns| has_passed(at_ns, MAX_LINK_DELAY_AGE_NS))
    }

    /// Notes that the delay is measured now. While this process did not run, for `stood_ns`, nothing was measured, and nothing was missing.
    pub(super) fn note_link_delay(&mut self, now_ns: i64, stood_ns: Option<i64>) {
        if self.clock.link_delay_ns(now_ns).is_some() {
            self.link_delay_ns = Some(now_ns);
        }
        if let (Some(stood_ns), Some(at_ns)) = (stood_ns, &mut self.link_delay_ns) {
            *at_ns = without_standstill(*at_ns, now_ns, stood_ns);
        }
    }
}
