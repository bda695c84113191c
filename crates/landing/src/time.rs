//! Time stamps of one clock, which the caller owns.

/// A moment in nanoseconds of the caller's clock; its origin does not matter, as long as all stamps share it.
#[derive(Copy, Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Default)]
pub struct Timestamp(i64);

impl Timestamp {
    /// The moment at this many nanoseconds after the clock's origin.
    pub fn from_nanos(nanos: i64) -> Self {
        Self(nanos)
    }

    /// The moment at this many seconds after the clock's origin; NaN gives the origin.
    pub fn from_seconds(seconds: f64) -> Self {
        Self((seconds * 1e9).round() as i64)
    }

    /// Nanoseconds after the clock's origin.
    pub fn nanos(self) -> i64 {
        self.0
    }

    /// Seconds after the clock's origin.
    pub fn seconds(self) -> f64 {
        self.0 as f64 * 1e-9
    }

    /// Seconds from `earlier` to this moment; negative when `earlier` is later.
    pub fn seconds_since(self, earlier: Self) -> f64 {
        // The difference of two extreme moments does not fit into 64 bits.
        (i128::from(self.0) - i128::from(earlier.0)) as f64 * 1e-9
    }

    /// The moment this many seconds later, saturating.
    pub fn plus_seconds(self, seconds: f64) -> Self {
        Self(self.0.saturating_add((seconds * 1e9).round() as i64))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_survive_the_ends_of_time() {
        let (first, last) = (Timestamp::from_nanos(i64::MIN), Timestamp::from_nanos(i64::MAX));
        assert!((last.seconds_since(first) - 1.844_674_407e10).abs() < 100.0);
        assert_eq!(last.plus_seconds(1.0), last);
        assert_eq!(first.plus_seconds(-1.0), first);
        assert_eq!(first.plus_seconds(f64::NAN), first);
    }

    #[test]
    fn a_moment_comes_back_from_its_seconds() {
        let start = Timestamp::from_seconds(12.5);
        assert_eq!(start.nanos(), 12_500_000_000);
        assert!((start.plus_seconds(0.25).seconds_since(start) - 0.25).abs() < 1e-12);
    }
}
