//! Searches camera frames for markers and publishes the detections.
//!
//! The service takes the newest frame of its camera, searches it for its markers and publishes the detections with
//! the frame's header unchanged; also when there are none. It does not depend on the vehicle and on control, and it
//! runs as well on the drone as on the ground.
//!
//! Modules in reading order: [`config`] is its configuration, [`service`] joins the network (`inbox`, `order`) to the image work of
//! [`search`], [`parts`] maps detections in parts of a frame to the whole frame's pixels, and [`wire`] turns the algorithm's
//! types into messages and back.

pub mod config;
mod inbox;
mod order;
pub mod parts;
pub mod search;
pub mod service;
pub mod wire;

pub use config::{Config, Input};
pub use search::{Search, StageClock};
pub use service::run;
