//! Messages of the vehicle: its state as estimated by the controller, and the autopilot's packets.

use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    VehicleState = 4 v 1;
    MavlinkBytes = 5 v 1;
}

/// Contact with the ground, as the autopilot reports it.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum LandedState {
    /// Not reported yet.
    Unknown,
    /// On the ground.
    OnGround,
    /// Taking off.
    TakingOff,
    /// In the air.
    InAir,
    /// Landing.
    Landing,
}

/// The vehicle's state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct VehicleState {
    /// Time of the newer of attitude and position, in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// Attitude: the body frame (FRD) in NED, as a unit quaternion w, x, y, z.
    pub ned_from_body_wxyz: [f64; 4],
    /// Position in local NED, in metres.
    pub position_ned_m: [f64; 3],
    /// Velocity in local NED, in m/s.
    pub velocity_ned_m_s: [f64; 3],
    /// The autopilot's flight mode, by name.
    pub mode: String,
    /// True when the motors are armed.
    pub armed: bool,
    /// Contact with the ground.
    pub landed: LandedState,
    /// Remaining battery from 0 to 1, if reported.
    pub battery: Option<f32>,
}

/// One MAVLink packet, byte for byte.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MavlinkBytes {
    /// The packet.
    pub packet: Vec<u8>,
}
