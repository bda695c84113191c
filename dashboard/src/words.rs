//! Describes phases, detector states and ground contact in words for an operator.

use messages::{DetectorState, LandedState, Phase};

/// The description of a phase for an operator.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Words {
    /// The vehicle's present action.
    pub title: &'static str,
    /// The condition that ends the phase.
    pub next: &'static str,
    /// The style in which it is shown: `calm`, `busy`, `good`, `warn` or `bad`.
    pub mood: &'static str,
}

/// A phase in words.
pub fn phase(phase: Phase) -> Words {
    let (title, next, mood) = match phase {
        Phase::Idle => ("Waiting", "An operator's start begins the landing.", "calm"),
        Phase::Takeoff => ("Taking off", "The search begins at the take-off height.", "busy"),
        Phase::Search => (
            "Searching for the marker",
            "The first detections of the marker end the search.",
            "busy",
        ),
        Phase::Approach => (
            "Flying above the marker",
            "The descent begins once the vehicle is over the marker.",
            "busy",
        ),
        Phase::Descend => (
            "Descending",
            "Close to the ground the autopilot takes over; without the marker it stops and climbs.",
            "busy",
        ),
        Phase::Retry => (
            "Climbing for another attempt",
            "Seeing the marker again begins the next approach.",
            "warn",
        ),
        Phase::Final => ("Touching down", "The autopilot stops the motors on the ground.", "busy"),
        Phase::Landed => ("Landed", "Only a new start does anything further.", "good"),
        Phase::Hold => (
            "Holding the position",
            "Resume continues, unless the reason still holds; abort ends the landing.",
            "warn",
        ),
        Phase::Aborted => ("Aborted", "The pilot or a new start takes over the vehicle.", "bad"),
        Phase::PilotInCommand => {
            ("The pilot flies", "Nothing is sent to the vehicle until a new start.", "warn")
        }
        Phase::Failed => ("Failed", "Nothing is sent any more; the pilot must take over.", "bad"),
    };
    Words { title, next, mood }
}

/// Whether a detector is used.
pub fn detector(state: DetectorState) -> &'static str {
    match state {
        DetectorState::Active => "in use",
        DetectorState::Shadow => "standby",
        DetectorState::Stale => "silent or late",
        DetectorState::Blind => "sees no marker",
        DetectorState::Outvoted => "outvoted",
        DetectorState::NoPose => "gives no pose",
    }
}

/// Contact with the ground.
pub fn landed(state: LandedState) -> &'static str {
    match state {
        LandedState::Unknown => "unknown",
        LandedState::OnGround => "on the ground",
        LandedState::TakingOff => "taking off",
        LandedState::InAir => "in the air",
        LandedState::Landing => "landing",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_detector_without_a_pose_is_distinguished_from_one_that_sees_no_marker() {
        assert_eq!(detector(DetectorState::Blind), "sees no marker");
        assert_eq!(detector(DetectorState::NoPose), "gives no pose");
    }
}
