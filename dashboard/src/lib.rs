//! Shows a landing in a browser, from the topics of the other services.
//!
//! The page is built into the program. The service also passes an operator's commands on. It is an ordinary subscriber, so
//! no other service depends on it or waits for it, and it contains no logic of the landing.
//!
//! Modules in reading order: [`config`]; [`state`] holds the newest messages and gives them as JSON with the age of each
//! number, with texts from [`words`] and [`found`], the [`funnel`] of the descent, the [`checks`] before a flight and the
//! [`log`]; [`pairing`] joins a picture with its detections, and [`window`] bounds the pictures in transit to a browser;
//! [`guard`] decides which connections may read and command, with a [`nonce`] for each command and [`tokens`] in a file.
//! These modules use no network. `server` answers browsers, `video` makes pictures, `mjpeg` serves them as Motion JPEG,
//! `stream` (with the feature `h264`) sends them as H.264; both use a `canvas` where a frame arrives in parts.
//! [`service`] subscribes to the topics.

mod canvas;
pub mod checks;
pub mod config;
pub mod found;
pub mod funnel;
pub mod guard;
pub mod log;
mod mjpeg;
pub mod nonce;
pub mod pairing;
mod server;
pub mod service;
pub mod state;
#[cfg(feature = "h264")]
mod stream;
pub mod tokens;
mod video;
pub mod window;
pub mod words;

pub use config::Config;
pub use service::run;
