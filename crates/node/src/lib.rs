//! The base of every service: configuration, a session, presence, typed topics, health, and an orderly
//! shutdown.
//!
//! This is the only crate that uses Zenoh. It does not depend on images, markers or autopilots.
//!
//! Modules in reading order: [`config`] merges a user's settings into the defaults; [`service`] runs a
//! service from start to shutdown, and `halt` ends Zenoh's threads after it; [`network`] configures the network, its `endpoint`s and, from [`access`], the rights of
//! others by their [`certificate`]s and the `cipher` of links, and [`session`] joins it under an [`identity`], for a tool
//! unless `foreign` programs answer there (`reach` finds why no process does), with shared memory where `memory` allows it;
//! [`topics`] has typed messages and commands, with their `sender`, [`frames`] pixels in their [`frame_order`], and [`tap`] all messages as bytes, to which
//! `earlier` sends those from before it;
//! [`health`] counts, with [`stats`]; [`denied`] counts denials of access control; [`clock`] is the host's clock,
//! [`standstill`] detects that a process was frozen, [`state`] is the folder of data that survive a reboot, and
//! [`version`](mod@version) the version of the program.

pub mod access;
mod block_on;
mod boxed;
pub mod certificate;
mod cipher;
pub mod clock;
pub mod config;
pub mod denied;
mod earlier;
mod endpoint;
mod foreign;
pub mod frame_order;
pub mod frames;
mod halt;
pub mod health;
pub mod identity;
mod key_pair;
mod memory;
pub mod network;
mod reach;
mod sender;
pub mod service;
pub mod session;
pub mod standstill;
pub mod state;
pub mod stats;
pub mod tap;
pub mod topics;
pub mod version;

pub use block_on::{block_on, block_on_for};
pub use boxed::BoxFuture;
pub use clock::{boot_ahead_ns, clock_name, host_name, now_ns};
pub use config::{
    Check, ConfigError, Effective, Layers, Settings, changed, from_toml, named, read_text, to_toml,
    without_credentials,
};
pub use earlier::{EarlierRequest, EarlierRequests};
pub use frames::{Frame, FramePublisher, FrameSubscriber, Loan};
pub use halt::halt_zenoh;
pub use health::HealthCounters;
pub use identity::Identity;
pub use network::{INSECURE, Network, OPEN};
pub use service::{
    Options, Shutdown, ignores_hangups, own_program, relaunch, relaunch_with_zenoh_threads, run,
    start_logging,
};
pub use session::{Announcement, Node, Presence, RELAY, ZenohSource};
pub use standstill::Standstill;
pub use state::{STATE_VARIABLE, state_directory};
pub use tap::{Tap, Tapped};
pub use topics::{Commands, Publisher, Request, Subscriber};
pub use version::{set_version, version};
