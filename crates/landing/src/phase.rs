//! The phases of a landing.

use std::fmt;

/// Where the landing stands.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Phase {
    /// Nothing asked for.
    Idle,
    /// Hovering until the marker is seen.
    Search,
    /// Moving over the marker.
    Approach,
    /// Descending over the marker.
    Descend,
    /// The autopilot's LAND mode does the rest.
    Final,
    /// On the ground, disarmed.
    Landed,
    /// Hovering until the reason passes.
    Hold,
    /// Given up.
    Aborted,
    /// Somebody else flies; silent until a new start.
    PilotInCommand,
}

impl Phase {
    /// True when only a new start leaves this phase.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Idle | Self::Landed | Self::Aborted | Self::PilotInCommand)
    }

    /// A short name for machines, in kebab-case; it does not change between versions.
    pub fn name(self) -> &'static str {
        match self {
            Self::Idle => "idle",
            Self::Search => "search",
            Self::Approach => "approach",
            Self::Descend => "descend",
            Self::Final => "final",
            Self::Landed => "landed",
            Self::Hold => "hold",
            Self::Aborted => "aborted",
            Self::PilotInCommand => "pilot-in-command",
        }
    }
}

impl fmt::Display for Phase {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
