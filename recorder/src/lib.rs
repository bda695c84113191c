//! Topics to a file.
//!
//! The service keeps every message that is published, byte for byte and as other programs read it, in an MCAP file. It
//! subscribes like anyone, so no other service knows of it or waits for it; of itself it publishes health, configuration
//! and what it has kept. A file whose writer is killed is read up to its last half second.
//!
//! Modules in reading order: [`config`]; [`service`] takes messages; `recording` is one
//! file as MCAP with its `name`, and `disk` the thread that writes it.

pub mod config;
mod disk;
mod name;
mod recording;
pub mod service;

pub use config::Config;
pub use service::run;
