//! Messages of every service: its health (rates of the last second, latencies of the last seconds,
//! drops and errors since its start) and its configuration.

use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    Health = 12 v 2;
    Configuration = 17 v 1;
}

/// The configuration that a service uses.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Configuration {
    /// The service.
    pub service: String,
    /// Name of this instance.
    pub instance: String,
    /// The host's name.
    pub host: String,
    /// The program's version.
    pub version: String,
    /// All keys with their values, as TOML.
    pub toml: String,
}

/// A service's health over the last second.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// The service.
    pub service: String,
    /// Name of this instance.
    pub instance: String,
    /// The host's name.
    pub host: String,
    /// The program's version.
    pub version: String,
    /// Name of the host's clock; stamps with the same name may be compared.
    pub clock: String,
    /// When, in nanoseconds of the host's clock.
    pub stamp_ns: i64,
    /// Process id on its host.
    pub pid: u32,
    /// Processor time of the process since it started, in seconds.
    pub cpu_s: f64,
    /// Wall time since it started, in seconds.
    pub uptime_s: f64,
    /// Events per second, by name.
    pub rates: Vec<Rate>,
    /// Durations, by name.
    pub latencies: Vec<Latency>,
    /// Dropped inputs since the start, by reason.
    pub drops: Vec<Count>,
    /// Failures since the start, by reason.
    pub errors: Vec<Count>,
}

/// Rate of an event.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// Its name.
    pub name: String,
    /// Count since the start.
    pub count: u64,
    /// Count per second over the last period.
    pub hz: f64,
}

/// A duration, over the last seconds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Latency {
    /// Its name.
    pub name: String,
    /// Median in milliseconds.
    pub p50_ms: f64,
    /// 99th percentile in milliseconds.
    pub p99_ms: f64,
}

/// A count with its reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Count {
    /// The reason.
    pub reason: String,
    /// Count since the start.
    pub count: u64,
}
