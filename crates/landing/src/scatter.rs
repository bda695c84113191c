//! Compares how much a marker's positions scatter with the covariance that their detector states, and raises a covariance that is far too
//! small.
//!
//! A filter that believes such a covariance takes most detections for outliers, and follows single ones. Of three positions in a row the
//! middle one is compared with the line through the others, so that a constant velocity (of the pad, of an autopilot whose position
//! drifts) leaves nothing; the difference has a covariance by those of the three. Its normalised square is chi-square with 3 degrees of
//! freedom (Bar-Shalom, Li, Kirubarajan: Estimation with Applications to Tracking and Navigation, section 5.4). The median of the latest
//! ones is compared with that of the distribution, so that a jump or an outlier among them counts for nothing.

use geometry::squared;
use libm::sqrt;

use crate::measurement::Measurement;

/// Number of differences whose median counts, and how many there must be.
const DIFFERENCES: usize = 15;
const MIN_DIFFERENCES: usize = 10;
/// Maximum time from the first to the third position, in seconds: over longer times a pad that heaves is not on a line.
const MAX_SPAN_S: f64 = 0.3;
/// Median of chi-square with 3 degrees of freedom.
const MEDIAN: f64 = 2.366;
/// How many times the stated deviation positions must scatter before the covariance is raised. In modelled flights with wind, gusts and
/// faults, positions of a detector that states its covariance well scatter by up to 5.9 times as much, as attitude and stamps err as well.
const MIN_RATIO: f64 = 6.0;
/// Fraction of a limit beyond which it is not raised any more.
const CLEAR_FRACTION: f64 = 0.7;
/// Smallest and largest deviation along an axis with which it is raised, in metres. Positions that scatter less mislead no landing; those that
/// scatter more are of two markers in turn, between which a filter must not take the mean.
const MIN_DEVIATION_M: f64 = 0.02;
const MAX_DEVIATION_M: f64 = 0.1;
/// Number of detections in a row with a raised covariance from which on that is reported.
const MIN_IN_A_ROW: u32 = 30;

/// The latest positions and their differences; nothing is allocated.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Scatter {
    /// The last position but one, and the last.
    past: [Option<Measurement>; 2],
    /// Normalised squared differences, and squared differences in m^2.
    differences: [Difference; DIFFERENCES],
    count: usize,
    in_a_row: u32,
    excess: Option<ScatterExcess>,
}

#[derive(Copy, Clone, Debug, Default)]
struct Difference {
    normalised: f64,
    square_m2: f64,
}

/// Positions that scatter more than their covariance states.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct ScatterExcess {
    /// The standard deviation along one axis by which they scatter, in metres.
    pub measured_m: f64,
    /// The one that is stated, with the noise of the vehicle's own attitude and position, in metres.
    pub stated_m: f64,
}

impl Scatter {
    /// Adds a detection, and raises its covariance to the measured scatter, where that is far larger.
    pub(crate) fn raised(&mut self, measurement: Measurement) -> Measurement {
        self.add(&measurement);
        Measurement { noise: measurement.noise * self.factor().unwrap_or(1.0), ..measurement }
    }

    /// The factor by which covariances are raised.
    pub(crate) fn factor(&self) -> Option<f64> {
        self.excess.map(|it| squared(it.measured_m / it.stated_m))
    }

    /// The excess, once it has lasted.
    pub(crate) fn reported(&self) -> Option<ScatterExcess> {
        self.excess.filter(|_| self.in_a_row >= MIN_IN_A_ROW)
    }

    fn add(&mut self, newest: &Measurement) {
        let [first, middle] = self.past;
        if middle.is_some_and(|last| newest.stamp.seconds_since(last.stamp) <= 0.0) {
            // A late frame.
            return;
        }
        self.past = [middle, Some(*newest)];
        let (Some(first), Some(middle)) = (first, middle) else { return };
        if newest.stamp.seconds_since(first.stamp) > MAX_SPAN_S {
            // After a pause, and of a slow detector, nothing is known.
            *self = Self { past: self.past, ..Self::default() };
        } else if let Some(difference) = Difference::new([&first, &middle, newest]) {
            self.differences[self.count % DIFFERENCES] = difference;
            self.count += 1;
            self.judge();
        }
    }

    fn judge(&mut self) {
        let known = self.differences.get(..self.count.min(DIFFERENCES)).unwrap_or_default();
        let normalised = median(known, |it| it.normalised);
        let measured_m = sqrt(median(known, |it| it.square_m2) / MEDIAN);
        let ratio = sqrt(normalised / MEDIAN);
        let margin = if self.excess.is_some() { CLEAR_FRACTION } else { 1.0 };
        let is_excess = known.len() >= MIN_DIFFERENCES
            && ratio.is_finite()
            && ratio > margin * MIN_RATIO
            && (margin * MIN_DEVIATION_M..=MAX_DEVIATION_M / margin).contains(&measured_m);
        self.excess = is_excess.then(|| ScatterExcess { measured_m, stated_m: measured_m / ratio });
        self.in_a_row = if is_excess { self.in_a_row.saturating_add(1) } else { 0 };
    }
}

impl Difference {
    /// `None` for a covariance that has no inverse.
    fn new([first, middle, last]: [&Measurement; 3]) -> Option<Self> {
        let span_s = last.stamp.seconds_since(first.stamp);
        let share = last.stamp.seconds_since(middle.stamp) / span_s;
        let other = 1.0 - share;
        let difference = middle.position - first.position * share - last.position * other;
        let noise = middle.noise + first.noise * squared(share) + last.noise * squared(other);
        let normalised = difference.dot(&(noise.try_inverse()? * difference));
        // As a single position scatters.
        let square_m2 = difference.norm_squared() / (1.0 + squared(share) + squared(other));
        Some(Self { normalised, square_m2 })
    }
}

fn median(known: &[Difference], of: impl Fn(&Difference) -> f64) -> f64 {
    let mut values = [f64::INFINITY; DIFFERENCES];
    for (value, difference) in values.iter_mut().zip(known) {
        *value = of(difference);
    }
    values.sort_by(f64::total_cmp);
    values.get(known.len() / 2).copied().unwrap_or(f64::INFINITY)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::time::Timestamp;
    use nalgebra::{Matrix3, Vector3};
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;
    use rand_distr::{Distribution, StandardNormal};

    const STATED_M: f64 = 0.003;

    /// The check after positions of a pad that moves, at 15 Hz with times that vary, each with its error.
    fn after(frames: usize, error: impl Fn(usize, [f64; 3]) -> Vector3<f64>) -> Scatter {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut scatter = Scatter::default();
        for i in 0..frames {
            let seconds = i as f64 / 15.0 + if i % 3 == 0 { 0.02 } else { 0.0 };
            let normal = [(); 3].map(|()| StandardNormal.sample(&mut random));
            let measurement = Measurement {
                stamp: Timestamp::from_seconds(seconds),
                position: Vector3::new(0.8 * seconds, -0.5 * seconds, 0.1) + error(i, normal),
                range_m: 5.0,
                noise: Matrix3::identity() * squared(STATED_M),
                tilt: Matrix3::zeros(),
                slip: Vector3::zeros(),
            };
            let raised = scatter.raised(measurement);
            assert!(raised.noise[(0, 0)] >= measurement.noise[(0, 0)]);
            assert_eq!(raised.noise != measurement.noise, scatter.excess.is_some());
            // A late frame, and one that comes twice, change nothing.
            let late = Measurement { position: Vector3::repeat(9.0), ..measurement };
            let before = scatter.count;
            scatter.add(&late);
            assert_eq!(scatter.count, before);
        }
        scatter
    }

    fn noise(of_stated: f64) -> impl Fn(usize, [f64; 3]) -> Vector3<f64> {
        move |_, normal| Vector3::from(normal) * (of_stated * STATED_M)
    }

    #[test]
    fn positions_that_scatter_far_more_than_stated_are_measured_and_reported() {
        for of_stated in [0.1, 1.0, 2.0] {
            let scatter = after(100, noise(of_stated));
            assert!(scatter.excess.is_none() && scatter.reported().is_none(), "{of_stated}");
        }
        let scatter = after(100, noise(15.0));
        let ScatterExcess { measured_m, stated_m } = scatter.reported().unwrap();
        assert!((0.03..0.06).contains(&measured_m), "{measured_m} m");
        assert!((0.002..0.004).contains(&stated_m), "{stated_m} m");
        assert!(after(30, noise(15.0)).reported().is_none(), "not at once");
        assert!(after(30, noise(15.0)).excess.is_some());
    }

    #[test]
    fn an_excess_is_forgotten_after_a_pause() {
        let mut scatter = after(100, noise(15.0));
        let last = scatter.past[1].unwrap();
        for i in 1..=2 {
            let stamp = last.stamp.plus_seconds(0.2 * f64::from(i));
            assert!(scatter.reported().is_some(), "{i}");
            scatter.add(&Measurement { stamp, ..last });
        }
        assert!(scatter.reported().is_none() && scatter.excess.is_none());
        let next = Measurement { stamp: last.stamp.plus_seconds(0.6), ..last };
        assert_eq!(scatter.raised(next).noise, next.noise);
    }

    #[test]
    fn jumps_outliers_and_two_markers_in_turn_raise_nothing() {
        type Place = fn(usize) -> f64;
        let places: [(&str, Place); 3] = [
            ("jumps", |i| if i / 20 % 2 == 0 { 0.0 } else { 0.5 }),
            ("outliers", |i| if i.is_multiple_of(8) { 2.0 } else { 0.0 }),
            ("in turn", |i| if i.is_multiple_of(2) { 1.0 } else { 0.0 }),
        ];
        for (name, x) in places {
            let of_one = noise(1.0);
            let scatter = after(100, |i, normal| of_one(i, normal) + Vector3::new(x(i), 0.0, 0.0));
            assert!(scatter.excess.is_none(), "{name}: {scatter:?}");
        }
    }
}
