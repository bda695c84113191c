//! What can be chosen about the frames for the air link; the same for every camera.

use node::Check;
use serde::Deserialize;

/// The keys of the table `air` of a camera; meanings, units and ranges are told in its TOML file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AirConfig {
    /// What of a frame is sent.
    pub mode: Mode,
    /// JPEG quality where the link carries it.
    pub quality: u8,
    /// JPEG quality below which the picture is made coarser instead.
    pub quality_least: u8,
    /// Largest frame, in kilobytes.
    pub largest_kb: f64,
    /// Smallest size that frames shrink to, in kilobytes.
    pub smallest_kb: f64,
    /// Time aimed at from sending a frame to hearing that it has arrived, in milliseconds.
    pub round_trip_ms: f64,
    /// Frames that may be under way at once.
    pub window: u32,
    /// After this time without an answer a frame counts as lost, in milliseconds.
    pub timeout_ms: f64,
}

/// What of a frame is sent.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// The whole frame.
    Full,
    /// A region about the markers at full resolution and an overview; the whole frame while none is seen.
    Region,
}

impl AirConfig {
    /// Checks the values' ranges, for a camera whose keys are below `air`.
    pub fn check(&self, check: &mut Check<'_>) {
        check.range("air.quality", self.quality, 1..=100);
        check.range("air.quality_least", self.quality_least, 1..=self.quality.max(1));
        check.range("air.largest_kb", self.largest_kb, 1.0..=10_000.0);
        check.range("air.smallest_kb", self.smallest_kb, 1.0..=self.largest_kb.max(1.0));
        check.range("air.round_trip_ms", self.round_trip_ms, 1.0..=2000.0);
        check.range("air.window", self.window, 1..=8);
        check.range("air.timeout_ms", self.timeout_ms, 20.0..=5000.0);
    }
}
