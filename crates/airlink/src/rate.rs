//! Chooses the frames that become pictures for people, within a maximum rate.

/// Share of the period by which a frame may be early, as frames come unevenly.
const MAX_EARLY: f64 = 0.3;

/// Takes frames at no more than a rate, in the mean.
#[derive(Clone, Debug)]
pub struct Rate {
    period_ns: i64,
    early_ns: i64,
    /// When the next frame is due.
    due_ns: i64,
}

impl Rate {
    /// At most so many a second.
    pub fn new(max_hz: f64) -> Self {
        let period_ns = 1e9 / max_hz;
        let early_ns = (MAX_EARLY * period_ns) as i64;
        Self { period_ns: period_ns as i64, early_ns, due_ns: i64::MIN }
    }

    /// Whether a frame of this time may be taken. A time before the last, as of a restarted camera, restarts the schedule.
    pub fn is_due(&self, now_ns: i64) -> bool {
        let first_ns = self.due_ns.saturating_sub(self.early_ns);
        now_ns >= first_ns || now_ns < first_ns.saturating_sub(self.period_ns)
    }

    /// Notes that it is taken. The next one is due a period after this one was due: an early frame allows no further one. After
    /// a pause, or where times begin again, it is due a period after this one.
    pub fn take(&mut self, now_ns: i64) {
        let turn_ns =
            self.due_ns.saturating_sub(self.early_ns)..self.due_ns.saturating_add(self.period_ns);
        let is_in_turn = turn_ns.contains(&now_ns);
        self.due_ns = if is_in_turn { self.due_ns } else { now_ns }.saturating_add(self.period_ns);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many frames of a camera are taken in 10 s.
    fn taken(camera_hz: f64, max_hz: f64) -> usize {
        let mut rate = Rate::new(max_hz);
        let frames = (0..(10.0 * camera_hz) as i64).map(|n| (n as f64 * 1e9 / camera_hz) as i64);
        frames
            .filter(|now_ns| {
                rate.is_due(*now_ns) && {
                    rate.take(*now_ns);
                    true
                }
            })
            .count()
    }

    #[test]
    fn there_are_no_more_than_the_rate_allows_and_hardly_fewer() {
        for (camera_hz, max_hz, min) in [
            (15.0, 15.0, 149),
            (20.0, 15.0, 145),
            (30.0, 15.0, 149),
            (14.7, 15.0, 146),
            (60.0, 0.5, 5),
        ] {
            let taken = taken(camera_hz, max_hz);
            let max = (10.0 * max_hz) as usize + 1;
            assert!((min..=max).contains(&taken), "{taken} of {camera_hz} Hz at {max_hz} Hz");
        }
    }

    #[test]
    fn after_a_pause_no_frames_are_made_up_for() {
        let mut rate = Rate::new(10.0);
        rate.take(0);
        assert!(rate.is_due(5_000_000_000));
        rate.take(5_000_000_000);
        assert!(!rate.is_due(5_050_000_000) && rate.is_due(5_075_000_000));
    }

    #[test]
    fn times_that_step_back_restart_the_schedule() {
        let mut rate = Rate::new(10.0);
        rate.take(5_000_000_000);
        assert!(!rate.is_due(4_990_000_000), "a little uneven");
        assert!(rate.is_due(1_000_000_000));
        rate.take(1_000_000_000);
        assert!(!rate.is_due(1_050_000_000) && rate.is_due(1_100_000_000));
    }
}
