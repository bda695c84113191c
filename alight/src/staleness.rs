//! The reason why the controller takes a detector for stale: silent, late or slow, with the number and its limit.

use messages::{Candidate, Configuration};
use node::Layers;

/// Periods of a detector without detections from which on it is silent here, as the controller's status states no silence: more than
/// the controller allows.
const SILENT_PERIODS: f64 = 4.0;

/// The controller's limits for a detector.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Limits {
    /// `detectors.max_age_s`.
    pub(crate) max_age_s: f64,
    /// `detectors.min_rate_hz`.
    pub(crate) min_rate_hz: f64,
}

impl Limits {
    /// Those of a configuration.
    pub(crate) fn of(controller: &controller::Config) -> Self {
        let detectors = &controller.detectors;
        Self { max_age_s: detectors.max_age_s, min_rate_hz: detectors.min_rate_hz }
    }

    /// Those of the built-in configuration.
    pub(crate) fn by_default() -> Option<Self> {
        let config = Layers::default().load::<controller::Config>().ok()?;
        Some(Self::of(&config.settings))
    }

    /// Those of the configuration that a controller publishes.
    pub(crate) fn published(controller: &Configuration) -> Option<Self> {
        let table: toml::Table = controller.toml.parse().ok()?;
        let number = |key| table.get("detectors")?.get(key)?.as_float();
        Some(Self { max_age_s: number("max_age_s")?, min_rate_hz: number("min_rate_hz")? })
    }

    /// Why a detector is too slow, if it is.
    pub(crate) fn slow(self, candidate: &Candidate) -> Option<String> {
        let (rate_hz, min_rate_hz) = (candidate.rate_hz, self.min_rate_hz);
        let is_slow = rate_hz > 0.0 && rate_hz < min_rate_hz;
        is_slow.then(|| {
            format!("slow: {rate_hz:.1} of at least {min_rate_hz} Hz (`detectors.min_rate_hz`)")
        })
    }

    /// Why a detector is too late, if it is.
    pub(crate) fn late(self, candidate: &Candidate) -> Option<String> {
        let (latency_ms, max_ms) = (candidate.latency_ms, self.max_age_s * 1e3);
        (latency_ms > max_ms).then(|| {
            format!(
                "late: its detections come {latency_ms:.0} ms after the exposure, limit {max_ms:.0} ms (`detectors.max_age_s`)"
            )
        })
    }

    /// Why a stale detector is so.
    pub(crate) fn stale(self, candidate: &Candidate) -> String {
        let Candidate { age_ms, latency_ms, rate_hz, alive, .. } = *candidate;
        if !alive {
            return "gone: it has left the network".to_owned();
        }
        let silence_ms = age_ms - latency_ms;
        let is_silent = silence_ms * 1e-3 * rate_hz > SILENT_PERIODS;
        let silent = is_silent.then(|| format!("silent: no detections for {silence_ms:.0} ms"));
        let all: Vec<String> =
            [silent, self.late(candidate), self.slow(candidate)].into_iter().flatten().collect();
        match all.is_empty() {
            true => format!("silent: its newest frame is {age_ms:.0} ms old"),
            false => all.join("; "),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::DetectorState;

    #[test]
    fn a_stale_detector_is_silent_late_or_slow_with_the_number_and_its_limit() {
        let limits = Limits { max_age_s: 0.2, min_rate_hz: 3.0 };
        let of = |age_ms, latency_ms, rate_hz, alive| {
            let state = DetectorState::Stale;
            let sample = Candidate::sample();
            limits.stale(&Candidate { state, age_ms, latency_ms, rate_hz, alive, ..sample })
        };
        assert_eq!(
            of(3050.0, 3018.0, 15.0, true),
            "late: its detections come 3018 ms after the exposure, limit 200 ms (`detectors.max_age_s`)"
        );
        assert_eq!(
            of(39.0, 28.0, 1.9, true),
            "slow: 1.9 of at least 3 Hz (`detectors.min_rate_hz`)"
        );
        assert_eq!(of(740.0, 34.0, 15.0, true), "silent: no detections for 706 ms");
        assert_eq!(of(190.0, 34.0, 15.0, true), "silent: its newest frame is 190 ms old");
        let both = of(400.0, 300.0, 1.9, true);
        assert!(both.contains("late: ") && both.contains("; slow: "), "{both}");
        assert!(of(9.0, 9.0, 15.0, false).starts_with("gone"));
    }

    #[test]
    fn the_limits_are_those_of_the_published_configuration() {
        let published = |toml: &str| {
            Limits::published(&Configuration {
                service: "controller".into(),
                instance: "main".into(),
                host: String::new(),
                version: String::new(),
                toml: toml.into(),
            })
        };
        let limits = published("[detectors]\nmax_age_s = 0.5\nmin_rate_hz = 2.0");
        assert_eq!(limits, Some(Limits { max_age_s: 0.5, min_rate_hz: 2.0 }));
        assert_eq!(published("[detectors]\nmax_age_s = 0.5"), None);
        assert_eq!(Limits::by_default().map(|it| it.max_age_s), Some(0.2));
    }
}
