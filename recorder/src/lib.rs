//! Topics to a file, and to viewers that follow a flight.
//!
//! The service keeps every message that is published, byte for byte and as other programs read it, in an MCAP file. It
//! subscribes like anyone, so no other service knows of it or waits for it; of itself it publishes health, configuration
//! and what it has kept. A file whose writer is killed is read up to its last half second.
//!
//! Modules in reading order: [`config`]; [`service`] takes messages, `frame` makes pictures, `unseen` counts the frames
//! that never came; `recording` is one
//! file as MCAP with its `name`, and `disk` the thread that writes it. `live` offers messages to those who follow: `hub` has
//! channels and clients, `outbox` and `window` what waits for one and is on its way to it, `guard` who may be one, and `server`
//! answers them.

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
