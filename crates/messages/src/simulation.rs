//! Ground truth, which only a simulator can publish.

use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    Truth = 10 v 1;
    Wind = 11 v 1;
}

/// The true state of vehicle and pad.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// When, in nanoseconds of the simulator's clock.
    pub stamp_ns: i64,
    /// Attitude: the body frame (FRD) in NED, as a unit quaternion w, x, y, z.
    pub ned_from_body_wxyz: [f64; 4],
    /// Position in NED, in metres.
    pub position_ned_m: [f64; 3],
    /// Velocity in NED, in m/s.
    pub velocity_ned_m_s: [f64; 3],
    /// The pad's landing point in NED, in metres.
    pub pad_ned_m: [f64; 3],
    /// True when the landing gear touches the ground.
    pub on_ground: bool,
    /// The first contact after the vehicle was in the air.
    pub touchdown: Option<Touchdown>,
    /// The largest tilt since the vehicle left the ground, in radians.
    pub max_tilt_rad: f64,
    /// Frames rendered so far.
    pub frames: u64,
}

/// A touchdown.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Touchdown {
    /// When, in nanoseconds of the simulator's clock.
    pub stamp_ns: i64,
    /// Horizontal distance from the vehicle to the pad's landing point, in metres.
    pub error_m: f64,
    /// Vertical speed just before, in m/s.
    pub vertical_speed_m_s: f64,
    /// Horizontal speed just before, in m/s.
    pub lateral_speed_m_s: f64,
}

impl Touchdown {
    /// Horizontal distance beyond which a touchdown misses the pad, in metres.
    pub const MAX_ERROR_M: f64 = 0.3;
}

/// The wind at the vehicle.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Wind {
    /// When, in nanoseconds of the simulator's clock.
    pub stamp_ns: i64,
    /// Velocity of the air in NED, in m/s.
    pub velocity_ned_m_s: [f64; 3],
}
