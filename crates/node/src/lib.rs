//! What every service needs: configuration, a session, presence, typed topics, health, and an orderly
//! shutdown.
//!
//! This is the only crate that uses Zenoh. It knows nothing of images, markers or autopilots.
//!
//! Modules in reading order: [`config`] merges a user's settings into the defaults; [`service`] runs a
//! service from start to shutdown; [`network`] configures the network, its `endpoint`s and, from [`access`], the rights of others by their [`certificate`]s and the `cipher` of links,
//! and [`session`] joins it under an [`identity`], a tool's unless `foreign` programs answer there (`reach` says why nobody does), with shared memory where `memory`
//! says that it can; [`topics`] has typed messages and commands, with their `sender`, [`frames`] pixels,
//! and [`tap`] everything as it came; [`health`] counts, with [`stats`]; [`denied`] counts what access control
//! denies; [`clock`] is the host's clock, [`standstill`] says that a process was frozen, [`state`] where a service keeps
//! what survives a reboot, and [`version`](mod@version) which program it is.

pub mod access;
mod block_on;
mod boxed;
pub mod certificate;
mod cipher;
pub mod clock;
pub mod config;
pub mod denied;
mod endpoint;
mod foreign;
pub mod frames;
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

pub use block_on::block_on;
pub use boxed::BoxFuture;
pub use clock::{boot_ahead_ns, clock_name, host_name, now_ns};
pub use config::{
    Check, ConfigError, Effective, Layers, Settings, changed, from_toml, named, read_text, to_toml,
    without_credentials,
};
pub use frames::{Frame, FramePublisher, FrameSubscriber, Loan};
pub use health::HealthCounters;
pub use identity::Identity;
pub use network::{INSECURE, Network, OPEN};
pub use service::{
    Options, Shutdown, ignores_hangups, own_program, relaunch, relaunch_with_zenoh_threads, run,
    start_logging,
};
pub use session::{Announcement, Node, Presence, ZenohSource};
pub use standstill::Standstill;
pub use state::{STATE_VARIABLE, state_directory};
pub use tap::{Tap, Tapped};
pub use topics::{Commands, Publisher, Request, Subscriber};
pub use version::{set_version, version};
