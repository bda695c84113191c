//! Computes the vehicle's track relative to the pad: the estimated and the true one.

use crate::flight::{Flight, true_offset};

/// The vehicle relative to the pad's landing point at a time.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct TrackPoint {
    /// When, in seconds since the landing began.
    pub time_s: f64,
    /// How far north, in metres.
    pub north_m: f64,
    /// How far east, in metres.
    pub east_m: f64,
    /// How high, in metres.
    pub height_m: f64,
    /// Standard deviation of its horizontal position, in metres; 0 for truth.
    pub deviation_m: f64,
}

/// The error of the estimate at a time.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct EstimateError {
    /// When, in seconds since the landing began.
    pub time_s: f64,
    /// Horizontal distance between the estimated and the true position of the vehicle relative to the pad, in metres.
    pub horizontal_m: f64,
    /// Estimated less true height over the pad, in metres.
    pub height_m: f64,
    /// The standard deviation that the estimate claims, in metres.
    pub deviation_m: Option<f64>,
}

/// Where the vehicle truly was.
pub fn truth(flight: &Flight) -> Vec<TrackPoint> {
    let position = |truth: &messages::Truth| {
        let [north_m, east_m, down_m] = true_offset(truth);
        let time_s = flight.at_s(truth.stamp_ns);
        TrackPoint { time_s, north_m, east_m, height_m: -down_m, deviation_m: 0.0 }
    };
    flight.truth.iter().map(position).collect()
}

/// Where the vehicle was by the estimate of the landing point.
pub fn estimated(flight: &Flight) -> Vec<TrackPoint> {
    let position = |target: &messages::TargetEstimate| {
        let [north_m, east_m, down_m] = target.position_ned_m?;
        let [own_north_m, own_east_m, own_down_m] = flight.position_at(target.stamp_ns)?;
        Some(TrackPoint {
            time_s: flight.at_s(target.stamp_ns),
            north_m: own_north_m - north_m,
            east_m: own_east_m - east_m,
            height_m: down_m - own_down_m,
            deviation_m: target.deviation_m.unwrap_or(0.0),
        })
    };
    flight.targets.iter().filter_map(position).collect()
}

/// Errors of the estimate against truth: of the vehicle's position relative to the pad, so that where the two count from
/// does not matter.
pub fn estimate_errors(flight: &Flight) -> Vec<EstimateError> {
    let error = |target: &messages::TargetEstimate| {
        let [north_m, east_m, down_m] = target.position_ned_m?;
        let [own_north_m, own_east_m, own_down_m] = flight.position_at(target.stamp_ns)?;
        let [true_north_m, true_east_m, true_down_m] = flight.true_offset_at(target.stamp_ns)?;
        Some(EstimateError {
            time_s: flight.at_s(target.stamp_ns),
            horizontal_m: (own_north_m - north_m - true_north_m)
                .hypot(own_east_m - east_m - true_east_m),
            height_m: true_down_m - (own_down_m - down_m),
            deviation_m: target.deviation_m,
        })
    };
    flight.targets.iter().filter_map(error).collect()
}
