//! Topics to a browser.
//!
//! The service shows a landing on a page that is built into the program, and passes an operator's commands on. It
//! subscribes like anyone, so no other service knows of it or waits for it; it knows nothing of how a landing is decided.
//!
//! Modules in reading order: [`config`]; [`state`] is what is known, as JSON with the age of each number, with [`words`] for
//! people, what was [`found`], the [`funnel`] of the descent, the [`checks`] before a flight and the [`log`]; [`pairing`] joins a picture with
//! what was found in it, and [`window`] bounds what is on its way to a browser; [`guard`] decides who may read and command, with
//! [`nonce`] for each command and [`tokens`] in a file. These are without network. `server` answers browsers, `video` makes pictures,
//! `mjpeg` gives them to viewers of Motion JPEG, `stream` (with the feature `h264`) sends them as H.264, both on a `canvas` where
//! a picture comes in parts, and [`service`] follows the topics.

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
