//! How a service fares.

use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    Health = 12 v 2;
}

/// A service's health over the last second.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// The service.
    pub service: String,
    /// Which one of them.
    pub instance: String,
    /// The machine's name.
    pub host: String,
    /// The program's version.
    pub version: String,
    /// Names the host's clock: equal names mean that stamps may be compared.
    pub clock: String,
    /// When, in nanoseconds of the host's clock.
    pub stamp_ns: i64,
    /// Process id on its host.
    pub pid: u32,
    /// Processor time of the process since it started, in seconds.
    pub cpu_s: f64,
    /// Wall time since it started, in seconds.
    pub uptime_s: f64,
    /// How often things happened.
    pub rates: Vec<Rate>,
    /// How long things took.
    pub latencies: Vec<Latency>,
    /// What was dropped since the start, by reason.
    pub drops: Vec<Count>,
    /// What failed since the start, by reason.
    pub errors: Vec<Count>,
}

/// How often something happened.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// What.
    pub name: String,
    /// Times since the start.
    pub count: u64,
    /// Times a second, over the last period.
    pub hz: f64,
}

/// How long something took, over the last seconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Latency {
    /// What.
    pub name: String,
    /// Median in milliseconds.
    pub p50_ms: f64,
    /// 99th percentile in milliseconds.
    pub p99_ms: f64,
}

/// How many times, by reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Count {
    /// The reason.
    pub reason: String,
    /// Times since the start.
    pub count: u64,
}
