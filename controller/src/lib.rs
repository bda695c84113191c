//! Marker detections in, velocity setpoints out.
//!
//! The service receives detections and the autopilot's state, lets the lander decide, and sends setpoints. It
//! stands between three crates that do not know each other: `messages` (what detectors find), `landing` (what
//! to do) and `autopilot` (how to do it).
//!
//! Modules in reading order: [`config`] has the settings; [`service`] joins network and link to the
//! [`flight`] with its [`tape`], an event loop over [`frames`] (detections in, the lander's next frame out, with [`selection`]
//! of the detector by health and [`agreement`], what they have [`announced`], the [`stamps`] that they pass on, the [`cameras`], and the [`refusals`] that last; [`unreadable`] ones never come so far), [`mount`] (what is said of a camera that is not as configured), [`mission`]
//! (when a landing begins), [`setpoints`] (the lander's actions to the autopilot), [`control`] (how a PX4 comes to follow setpoints) and [`offboard_watch`] (that it is not left so), [`landing_target`] (the
//! other way to land, by the autopilot's own precision landing), [`limits`] (the autopilot's parameters for
//! setpoints), [`link_delay`] (how slow the link is), [`alarms`] and [`wind`]; [`status`] is what is published, [`journal`] what is logged and
//! counted, [`pad_note`] where the pad is, for the controller that is started next, [`note_file`] what must survive a crash, [`wire`] converts messages into the lander's types and
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
pub mod limits;
pub mod link_delay;
pub mod mission;
pub mod mount;
pub mod note_file;
pub mod offboard_watch;
pub mod pad_note;
pub mod refusals;
pub mod selection;
pub mod service;
pub mod setpoints;
pub mod stamps;
pub mod status;
pub mod tape;
pub mod unreadable;
pub mod wind;
pub mod wire;

pub use config::Config;
pub use service::run;
