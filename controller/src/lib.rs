//! Marker detections in, velocity setpoints out.
//!
//! The service receives detections and the autopilot's state, lets the lander decide, and sends setpoints. It
//! joins three independent crates: `messages` (the detections), `landing` (the decision) and `autopilot` (its
//! execution).
//!
//! Modules in reading order: [`config`] has the settings; [`service`] joins network and link to the
//! [`flight`] with its [`tape`], an event loop over [`frames`] (detections in, the lander's next frame out, with [`selection`]
//! of the detector by health and [`agreement`], the markers that they have [`announced`], the [`stamps`] that they pass on, their [`lateness`], the [`reprojection`] of their poses, the [`namesakes`] among them, the [`cameras`], and the [`refusals`] that persist; [`unreadable`] ones are counted before), [`mount`] (warnings of a camera that is not as configured), [`mission`]
//! (when a landing begins), [`setpoints`] (the lander's actions to the autopilot), [`control`] (takes a PX4 into OFFBOARD) and [`offboard_watch`] (leads it out again), [`landing_target`] (the
//! other way to land, by the autopilot's own precision landing), [`limits`] (the autopilot's parameters for
//! setpoints), [`link_delay`] (the delay of the link), [`alarms`] and [`wind`]; [`status`] is published, [`journal`] logs and
//! counts, [`pad_note`] has the pad's position for the next controller, [`note_file`] survives a crash, [`wire`] converts messages into the lander's types and
//! back.

#![cfg_attr(not(test), deny(clippy::disallowed_methods))] // The same results on every machine.

pub mod agreement;
pub mod alarms;
pub mod announced;
pub mod camera_watch;
pub mod cameras;
pub mod config;
pub mod control;
pub mod flight;
pub mod frames;
pub mod journal;
pub mod landing_target;
pub mod lateness;
pub mod limits;
pub mod link_delay;
pub mod mission;
pub mod mount;
pub mod namesakes;
pub mod note_file;
pub mod offboard_watch;
pub mod pad_note;
pub mod refusals;
pub mod reprojection;
pub mod selection;
pub mod service;
pub mod setpoints;
pub mod stamps;
pub mod status;
pub mod tape;
mod tape_publisher;
pub mod unreadable;
pub mod wind;
pub mod wire;

pub use autopilot::KeyFileError;
pub use config::Config;
pub use landing::MAX_STANDSTILL_S;
pub use service::run;
