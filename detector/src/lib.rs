//! Frames in, marker detections out.
//!
//! The service takes the newest frame of its camera, searches it for its markers and publishes what it found, with
//! the frame's header unchanged; also when it found nothing. It knows nothing of the vehicle and of control, and it
//! runs as well on the drone as on the ground.
//!
//! Modules in reading order: [`config`] is what it is told, [`service`] joins the network (`inbox`) to the image work of
//! [`search`], [`parts`] tells what was found in parts of a frame in the whole one's pixels, and [`wire`] turns the algorithm's
//! types into messages and back.

pub mod config;
mod inbox;
pub mod parts;
pub mod search;
pub mod service;
pub mod wire;

pub use config::{Config, Input};
pub use search::{Search, StageClock};
pub use service::run;
