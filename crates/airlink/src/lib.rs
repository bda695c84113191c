//! Chooses and compresses the parts of a frame for the link between drone and ground, within the link's bandwidth.
//!
//! The camera's side sends JPEG frames on `camera/{camera}/jpeg`: the region of interest around the markers
//! with a small overview, one tile of the frame after the other while no marker is detected, or always the
//! whole frame. It sends the next one only once the last one has arrived. The detector's side decodes such a
//! payload. The crate reads markers only as rectangles in detections.
//!
//! Modules in reading order: [`config`] has the keys, [`window`] decides when the next frame may be sent and
//! how large it may be, [`prediction`] where the markers should be in it, [`plan`] which parts are sent at
//! which scale and quality, [`payload`] encodes and decodes the bytes; [`picture`] makes one of a
//! whole frame for people, and [`rate`] chooses those frames. These are algorithms, without clock,
//! thread and network; [`sender`] is the camera's side, which has all three.

pub mod config;
pub mod payload;
pub mod picture;
pub mod plan;
pub mod prediction;
pub mod rate;
pub mod sender;
pub mod window;

pub use config::AirConfig;
pub use payload::{Packer, PayloadError, Unpacker};
pub use plan::{FrameSize, Plan, Planner};
pub use rate::Rate;
pub use sender::AirSender;
