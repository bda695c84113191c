//! The settings of a conversation with an autopilot: system and component ids, heartbeat, timeouts,
//! parameters to read, and the messages to request with their rates.

use std::time::Duration;

use crate::command::Timeouts;
use crate::stream::{Expected, Stream};

/// Settings of the conversation with the autopilot.
#[derive(Clone, Debug, PartialEq)]
pub struct Config {
    /// The vehicle's system id; `None` takes the first autopilot found, and keeps it.
    pub system_id: Option<u8>,
    /// Our system id; `None` takes the vehicle's.
    pub our_system: Option<u8>,
    /// Our component id.
    pub our_component: u8,
    /// Whether to send our heartbeat once a second.
    pub heartbeat: bool,
    /// Silence after which the autopilot counts as lost.
    pub heartbeat_timeout: Duration,
    /// The messages to request; ArduPilot's own are replaced by their equivalents on PX4.
    pub streams: Vec<Stream>,
    /// The parameters to read.
    pub parameters: Vec<&'static str>,
    /// Whether to synchronise with the autopilot's clock: measurements are then stamped with the time of the
    /// measurement.
    pub timesync: bool,
    /// Timeouts of commands.
    pub timeouts: Timeouts,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            system_id: None,
            our_system: None,
            our_component: 191,
            heartbeat: true,
            heartbeat_timeout: Duration::from_secs(3),
            streams: default_streams(50.0),
            parameters: Vec::new(),
            timesync: true,
            timeouts: Timeouts::default(),
        }
    }
}

/// The messages that landing needs, with attitude and position at this rate in Hz.
pub fn default_streams(rate_hz: f64) -> Vec<Stream> {
    let always = |message_id, rate_hz| Stream { message_id, rate_hz, expected: Expected::Always };
    let if_present =
        |message_id, rate_hz| Stream { message_id, rate_hz, expected: Expected::IfPresent };
    vec![
        always(30, rate_hz),   // ATTITUDE
        always(32, rate_hz),   // LOCAL_POSITION_NED
        always(245, 5.0),      // EXTENDED_SYS_STATE
        always(1, 2.0),        // SYS_STATUS
        always(193, 2.0),      // EKF_STATUS_REPORT
        if_present(132, 10.0), // DISTANCE_SENSOR
        if_present(147, 1.0),  // BATTERY_STATUS
    ]
}
