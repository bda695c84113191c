//! Records topics to a file, and serves them to viewers that follow a flight.
//!
//! The service records every message that is published, byte for byte and as other programs read it, in an MCAP file. It
//! subscribes like any client, so no other service depends on it or waits for it; it publishes its own health, configuration
//! and counts of recorded messages. A file whose writer is killed is read up to its last half second.
//!
//! Modules in reading order: [`config`]; [`service`] takes messages, `frame` makes pictures, `unseen` counts the frames
//! that were never received, `alone` warns when no message of another process arrives; `recording` is one
//! file as MCAP with its `name`, and `disk` the thread that writes it. `live` offers messages to viewers: `hub` has
//! channels and clients, `outbox` and `window` bound the messages that wait for one and are on their way to it, `guard` decides which
//! clients are allowed, and `server` answers them.

mod alone;
pub mod config;
mod disk;
mod frame;
mod guard;
mod hub;
mod live;
mod name;
mod outbox;
mod recording;
mod server;
pub mod service;
mod unseen;
mod window;

pub use config::Config;
pub use service::run;
