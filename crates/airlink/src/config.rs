//! Defines the configuration of the frames for the air link, the same for every camera.

use std::ops::RangeInclusive;

use serde::Deserialize;

/// The keys of the table `air` of a camera, which its TOML file explains.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AirConfig {
    /// Which part of a frame is sent.
    pub mode: Mode,
    /// JPEG quality while the link's rate allows it.
    pub quality: u8,
    /// Minimum JPEG quality; below it the resolution is reduced instead.
    pub min_quality: u8,
    /// Maximum size of a frame, in kilobytes.
    pub max_kb: f64,
    /// Size below which frames do not shrink, in kilobytes.
    pub min_kb: f64,
    /// Target for the time from sending a frame to its acknowledgement, in milliseconds.
    pub round_trip_ms: f64,
    /// Maximum number of frames in flight.
    pub window: u32,
    /// Time without an acknowledgement after which a frame counts as lost, in milliseconds.
    pub timeout_ms: f64,
}

/// Which part of a frame is sent.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Mode {
    /// The whole frame.
    Full,
    /// The region of interest around the markers at full resolution, and an overview; while no marker is
    /// detected, one tile of the frame after the other.
    Roi,
}

impl AirConfig {
    /// The allowed range of each number: key, value, range.
    pub fn ranges(&self) -> [(&'static str, f64, RangeInclusive<f64>); 7] {
        let (quality, min_quality) = (f64::from(self.quality), f64::from(self.min_quality));
        [
            ("air.quality", quality, 1.0..=100.0),
            ("air.min_quality", min_quality, 1.0..=quality.max(1.0)),
            ("air.max_kb", self.max_kb, 1.0..=10_000.0),
            ("air.min_kb", self.min_kb, 1.0..=self.max_kb.max(1.0)),
            ("air.round_trip_ms", self.round_trip_ms, 1.0..=2000.0),
            ("air.window", f64::from(self.window), 1.0..=8.0),
            ("air.timeout_ms", self.timeout_ms, 20.0..=5000.0),
        ]
    }
}
