//! Decides the landing, as a pure function of time and events.
//!
//! [`Lander::step`] takes the time and an event (the vehicle's state, a searched image, an operator's
//! command, an alarm, or a tick) and returns a phase, an action for the autopilot, and the reasons. It keeps
//! the vehicle's recent motion, joins every detection with the motion at its exposure, estimates the target's
//! position and motion, and steers by one of two guidances. The same events give the same decisions, to the
//! bit.
//!
//! This crate uses no clock, network, file, thread, log or message, and no autopilot protocol.
//!
//! Modules in reading order:
//!
//! - [`time`], [`event`], [`decision`]: stamps, inputs, outputs; [`config`] has every number.
//! - [`history`]: the vehicle's recent motion, and the odometry frame.
//! - `measurement`, `scatter`, `filter`, `view`, `hypotheses`, [`estimator`]: from detections to the landing point; [`mean_target`] for
//!   the thesis' guidance; `target_filter` is the one that is needed.
//! - [`guidance`]: from the target to a velocity. [`search`]: where to look for the marker. `hover`: how
//!   to stay at a position.
//! - [`axis_check`]: are the axes of camera and autopilot consistent? [`mount_check`]: by how much are they off?
//!   `size_check`: is the marker as large as configured? `standing`: how high does the vehicle stand, and does it?
//!   `repeated_picture`: is the camera's picture an old one?
//! - [`state_machine`]: the phases. [`envelope`]: the last check of a setpoint.
//! - [`lander`] joins them.

#![cfg_attr(not(test), deny(clippy::disallowed_methods))] // The same results on every machine.

pub mod axis_check;
pub mod config;
pub mod decision;
pub mod envelope;
pub mod estimator;
pub mod event;
mod filter;
pub mod guidance;
pub mod history;
mod hover;
mod hypotheses;
pub mod lander;
mod limits;
pub mod mean_target;
mod measurement;
pub mod mount_check;
mod repeated_picture;
mod scatter;
pub mod search;
mod size_check;
mod standing;
pub mod state_machine;
mod target_filter;
pub mod time;
mod view;

pub use config::{
    AlarmAction, Config, EnvelopeConfig, EstimatorConfig, GuidanceConfig, MetricConfig, OnAbort,
    PhaseConfig, TargetConfig, ThesisConfig,
};
pub use decision::{Action, Decision, Phase, Reason, Rejection, TargetEstimate};
pub use event::{
    Alarm, AutopilotLimits, Event, FrameObservation, Landed, MarkerInFrame, Mode, OperatorCommand,
    VehicleState, VehicleStatus, is_covariance,
};
pub use lander::Lander;
pub use limits::ConfigError;
pub use mount_check::{Measured, MountFindings};
pub use scatter::ScatterExcess;
pub use standing::{RememberedPad, SeenPad};
pub use state_machine::MAX_STANDSTILL_S;
pub use time::Timestamp;
