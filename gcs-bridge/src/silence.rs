//! Watches whether the controller's status keeps coming while a landing is active: a frozen controller stays a member of the network, and its
//! last status would otherwise be shown as the present one.

/// Silence of the controller that is reported, in nanoseconds: ten periods of its status (0.2 s).
pub(crate) const MAX_SILENCE_NS: i64 = 2_000_000_000;

/// The silence of the controller.
#[derive(Debug, Default)]
pub(crate) struct Silence {
    /// When a status of an active landing was last received, or the bridge's own standstill ended; none without an active landing.
    since_ns: Option<i64>,
    /// It has been longer than the maximum.
    is_long: bool,
}

impl Silence {
    /// Takes the arrival of a status. Returns the length of a long silence that ended with it, in nanoseconds.
    pub(crate) fn status(&mut self, now_ns: i64, is_landing: bool) -> Option<i64> {
        let before_ns = self.since_ns;
        self.since_ns = is_landing.then_some(now_ns);
        let was_long = std::mem::take(&mut self.is_long);
        before_ns.filter(|_| was_long).map(|before_ns| now_ns.saturating_sub(before_ns))
    }

    /// Whether a long silence begins now. Just after a standstill of this process a status may still be waiting to be read, so the
    /// silence is measured from then on.
    pub(crate) fn begins(&mut self, now_ns: i64, is_after_standstill: bool) -> bool {
        let Some(since_ns) = &mut self.since_ns else { return false };
        if self.is_long {
            return false;
        }
        if is_after_standstill {
            *since_ns = now_ns;
        }
        self.is_long = now_ns.saturating_sub(*since_ns) > MAX_SILENCE_NS;
        self.is_long
    }

    /// Whether the controller is silent in a landing.
    pub(crate) fn is_long(&self) -> bool {
        self.is_long
    }

    /// The last controller has gone.
    pub(crate) fn gone(&mut self) {
        *self = Self::default();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    #[test]
    fn a_long_silence_in_a_landing_begins_once_and_ends_with_a_status() {
        let mut silence = Silence::default();
        assert_eq!(silence.status(0, true), None);
        let begins: Vec<i64> =
            (0..20_000).step_by(50).filter(|ms| silence.begins(ms * MS, false)).collect();
        assert_eq!(begins, [2050]);
        assert!(silence.is_long());
        assert_eq!(silence.status(20_000 * MS, true), Some(20_000 * MS));
        assert!(!silence.is_long());
        assert_eq!(silence.status(20_200 * MS, true), None);
        assert!(silence.begins(22_300 * MS, false), "it begins again");
        silence.gone();
        assert!(!silence.is_long() && !silence.begins(40_000 * MS, false));
    }

    #[test]
    fn without_a_landing_no_silence_is_long() {
        let mut silence = Silence::default();
        assert!(!silence.begins(60_000 * MS, false));
        silence.status(60_000 * MS, true);
        silence.status(60_200 * MS, false);
        assert!(!silence.begins(90_000 * MS, false));
    }

    #[test]
    fn the_bridges_own_standstill_is_no_silence_of_the_controller() {
        let mut silence = Silence::default();
        silence.status(0, true);
        // Frozen for 20 s; the waiting status is read after some ticks.
        for ms in (20_000..21_000).step_by(50) {
            assert!(!silence.begins(ms * MS, true), "{ms}");
        }
        assert!(!silence.begins(21_000 * MS, false));
        assert_eq!(silence.status(21_050 * MS, true), None);
        // Where the controller stands still as well, its silence is measured from then on.
        silence.begins(30_000 * MS, true);
        assert!(!silence.begins(31_900 * MS, false));
        assert!(silence.begins(32_050 * MS, false));
    }
}
