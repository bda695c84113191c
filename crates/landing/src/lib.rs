//! The landing decision, a pure function of time and events.
//!
//! [`Lander::step`] is told the time and what happened (the vehicle's state, a frame looked at, an operator's
//! command, or nothing) and answers with a phase, an action for the autopilot, and the reasons. It keeps the
//! vehicle's recent motion, joins every detection with the motion at its exposure, estimates the target's place and motion,
//! and steers by one of two guidances. Same events, same decisions, to the bit.
//!
//! This crate knows no clock, network, file, thread, log or message, and no autopilot protocol.
//!
//! Modules in reading order: [`event`] is what the lander is told and [`decision`] what it answers, [`config`] has
//! every number; [`lander`] joins [`history`] (the vehicle a moment ago), [`estimator`] (where the landing point is, by the `standing` of two places that claim to be it; [`target`] for the thesis' guidance),
//! [`guidance`] (target to velocity), [`agreement`] (do camera and autopilot mean the same directions), [`phase`] (what comes next), [`search`] (where to look) and [`envelope`] (the last look at a setpoint);
//! [`time`] has the stamps.

pub mod agreement;
pub mod config;
pub mod decision;
pub mod envelope;
pub mod estimator;
pub mod event;
pub mod guidance;
pub mod history;
pub mod lander;
mod limits;
pub mod phase;
pub mod search;
mod standing;
pub mod target;
pub mod time;

pub use config::{
    AlarmAction, Config, EnvelopeConfig, EstimatorConfig, GuidanceConfig, MetricConfig, OnAbort,
    PhaseConfig, TargetConfig, ThesisConfig,
};
pub use decision::{Action, Decision, Phase, Reason, Rejection, TargetEstimate};
pub use event::{
    Alarm, Event, FrameObservation, Landed, MarkerInFrame, Mode, OperatorCommand, VehicleState,
};
pub use lander::Lander;
pub use limits::ConfigError;
pub use time::Timestamp;
