//! Implements ArduPilot's precision landing, as far as it was measured: it accepts a target after 2 s of reports without
//! gaps, and moves over it while LAND descends.

/// Minimum time of reports, and the longest gap between them, in seconds.
const STEADY_S: f64 = 2.0;
const MAX_GAP_S: f64 = 0.5;
/// Time without a report after which the target is discarded, in seconds.
const FORGOTTEN_S: f64 = 4.0;
/// Time constant of its filter, in seconds.
const FILTER_S: f64 = 0.3;

/// The estimated target.
#[derive(Clone, Debug, Default)]
pub(super) struct Precision {
    place: [f64; 2],
    steady: Option<(f64, f64)>,
}

impl Precision {
    /// Takes a report of the target, north and east of the origin in metres.
    pub(super) fn take(&mut self, now_s: f64, place: [f64; 2]) {
        if !place.iter().all(|metres| metres.is_finite()) {
            return;
        }
        let continuing = self.steady.filter(|(_, last_s)| now_s - last_s < MAX_GAP_S);
        let Some((since_s, last_s)) = continuing else {
            self.place = place;
            self.steady = Some((now_s, now_s));
            return;
        };
        let share = 1.0 - (-(now_s - last_s) / FILTER_S).exp();
        for (estimate, reported) in self.place.iter_mut().zip(place) {
            *estimate += share * (reported - *estimate);
        }
        self.steady = Some((since_s, now_s));
    }

    /// The target, once it has been reported for long enough.
    pub(super) fn target(&self, now_s: f64) -> Option<[f64; 2]> {
        let (since_s, last_s) = self.steady?;
        (last_s - since_s >= STEADY_S && now_s - last_s < FORGOTTEN_S).then_some(self.place)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_target_is_accepted_after_two_seconds_and_discarded_after_four() {
        let mut precision = Precision::default();
        for step in 0..40 {
            assert_eq!(precision.target(0.05 * f64::from(step)), None);
            precision.take(0.05 * f64::from(step), [1.0, 2.0]);
        }
        precision.take(2.0, [1.0, 2.0]);
        assert_eq!(precision.target(2.0), Some([1.0, 2.0]));
        assert_eq!(precision.target(6.1), None);
        precision.take(6.2, [1.0, 2.0]);
        assert_eq!(precision.target(6.3), None, "it begins again");
    }
}
