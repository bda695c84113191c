//! The landing decision, a pure function of time and events.

pub mod config;
pub mod decision;
pub mod event;
pub mod guidance;
pub mod lander;
pub mod phase;
pub mod time;

pub use config::{
    Config, ConfigError, EnvelopeConfig, Guidance, MetricConfig, OnAbort, PhaseConfig,
    TargetConfig, ThesisConfig,
};
pub use decision::{Action, Decision, Reason, Rejection, TargetEstimate};
pub use event::{Event, Frame, Landed, MarkerInFrame, Mode, OperatorCommand, VehicleState};
pub use lander::Lander;
pub use phase::Phase;
pub use time::Timestamp;
