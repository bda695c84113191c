//! The landing decision as one function of time and events.

use crate::config::{Config, ConfigError};
use crate::decision::{Action, Decision, Reason};
use crate::event::Event;
use crate::phase::Phase;
use crate::time::Timestamp;

/// One landing after the other: told what happens, it answers what to do.
#[derive(Clone, Debug)]
pub struct Lander {
    phase: Phase,
}

impl Lander {
    /// A lander that waits for a start; refuses settings out of range.
    pub fn new(config: Config) -> Result<Self, ConfigError> {
        config.validate()?;
        Ok(Self { phase: Phase::Idle })
    }

    /// What to do now that `event` has happened.
    pub fn step(&mut self, _now: Timestamp, _event: Event) -> Decision {
        Decision {
            phase: self.phase,
            action: Action::None,
            why: Reason::WaitingForStart,
            target: None,
            rejected: None,
        }
    }

    /// Where the landing stands.
    pub fn phase(&self) -> Phase {
        self.phase
    }
}
