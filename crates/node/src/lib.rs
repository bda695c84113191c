//! What every service needs: configuration, a session, presence, typed topics, health, and an orderly end.
//!
//! This is the only crate that knows Zenoh. It knows no image, no marker and no autopilot.
//!
//! Modules in reading order: [`config`] lays a user's settings over the defaults, [`service`] runs a service from
//! its start to its end, [`network`] says which network it joins, [`session`] is its place there, [`topics`] are its
//! typed messages, [`frames`] its pixels, [`health`] its counters, [`refusals`] what was not let in, [`clock`] its clock.

pub mod clock;
pub mod config;
pub mod frames;
pub mod health;
pub mod network;
pub mod refusals;
pub mod service;
pub mod session;
pub mod topics;

pub use clock::{Clock, clock_name, host_name, now_ns};
pub use config::{Check, ConfigError, Effective, Layers, Settings, changed};
pub use frames::{Frame, FramePublisher, FrameSubscriber, Loan};
pub use health::HealthCounters;
pub use network::Network;
pub use service::{Options, Shutdown, relaunch_with_zenoh_threads, run, start_logging};
pub use session::{Identity, Node, Presence, ZenohSource};
pub use topics::{Commands, Publisher, Request, Subscriber};
