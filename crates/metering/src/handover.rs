//! Decides whether the pad or the camera's own metering sets the exposure.

/// A pad that was metered for this long was seen well, in nanoseconds.
const WELL_NS: i64 = 3_000_000_000;
/// First and maximum time for which a pad must be seen before it is metered again, after it was lost sooner.
const MIN_WAIT_NS: i64 = 5_000_000_000;
const MAX_WAIT_NS: i64 = 40_000_000_000;

/// Hands the exposure to the pad while it is seen.
///
/// A pad that its own metering makes invisible, as the edge of a deep shadow on it may, is seen again once the camera meters
/// on its own, and would be lost again at once. Each time this happens the handover waits twice as long.
#[derive(Clone, Debug, Default)]
pub struct Handover {
    seen_since_ns: Option<i64>,
    metered_since_ns: Option<i64>,
    wait_ns: i64,
}

impl Handover {
    /// True when the pad sets the exposure after the frame with this stamp.
    pub fn meters_pad(&mut self, stamp_ns: i64, is_seen: bool) -> bool {
        if !is_seen {
            if let Some(since_ns) = self.metered_since_ns.take() {
                let was_seen_well = stamp_ns.saturating_sub(since_ns) >= WELL_NS;
                let longer_ns = (2 * self.wait_ns).clamp(MIN_WAIT_NS, MAX_WAIT_NS);
                self.wait_ns = if was_seen_well { 0 } else { longer_ns };
            }
            self.seen_since_ns = None;
            return false;
        }
        let seen_since_ns = *self.seen_since_ns.get_or_insert(stamp_ns);
        if stamp_ns.saturating_sub(seen_since_ns) < self.wait_ns {
            return false;
        }
        self.metered_since_ns.get_or_insert(stamp_ns);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_pad_that_is_lost_whenever_it_is_metered_is_metered_more_and_more_seldom() {
        let mut handover = Handover::default();
        let (mut seen_ms, mut metered) = (0, Vec::new());
        for ms in (0..200_000).step_by(100) {
            // Metered for half a second it is lost, and seen again half a second later.
            let is_seen = ms >= seen_ms;
            if handover.meters_pad(ms * MS, is_seen) {
                if metered.last().is_none_or(|last| ms - last > 600) {
                    metered.push(ms);
                }
                if ms - metered[metered.len() - 1] >= 500 {
                    seen_ms = ms + 500;
                }
            }
        }
        let waits: Vec<_> = metered.windows(2).map(|pair| (pair[1] - pair[0]) / 1000).collect();
        assert_eq!(waits, [6, 11, 21, 41, 41, 41]);
    }

    #[test]
    fn a_pad_that_was_seen_well_is_metered_at_once_when_it_is_back() {
        let mut handover = Handover::default();
        assert!(handover.meters_pad(0, true) && handover.meters_pad(3000 * MS, true));
        assert!(!handover.meters_pad(3100 * MS, false));
        assert!(handover.meters_pad(4000 * MS, true));
        assert!(!handover.meters_pad(4100 * MS, false));
        assert!(!handover.meters_pad(4200 * MS, true), "it was lost soon");
        assert!(!handover.meters_pad(9100 * MS, true) && handover.meters_pad(9200 * MS, true));
    }

    #[test]
    fn stamps_that_jump_do_not_make_it_panic() {
        let mut handover = Handover::default();
        for stamp_ns in [0, i64::MAX, i64::MIN, 5, i64::MAX] {
            handover.meters_pad(stamp_ns, true);
            handover.meters_pad(stamp_ns, false);
        }
    }
}
