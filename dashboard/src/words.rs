//! Describes phases, detector states and ground contact in words for an operator.

use messages::{ControllerStatus, DetectorState, LandedState, Phase};

/// Height above the target below which a vehicle that the autopilot lands is touching down, in metres.
const TOUCHDOWN_M: f64 = 1.0;

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

/// The phase of a status in words.
pub fn phase(status: &ControllerStatus) -> Words {
    let (title, next, mood) = match status.phase {
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
        Phase::Final => {
            // It begins close to the ground, or, by a command or an alarm, at any height.
            let is_low = status.height_m.is_some_and(|height_m| height_m <= TOUCHDOWN_M);
            let title = if is_low { "Touching down" } else { "The autopilot lands" };
            (title, "The autopilot stops the motors on the ground.", "busy")
        }
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

/// The state of a detector while the controller, which decides it, sends nothing.
pub const WITHOUT_CONTROLLER: &str = "not known without the controller";

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
    fn only_a_vehicle_close_to_the_ground_is_touching_down() {
        let title = |height_m| {
            phase(&ControllerStatus { phase: Phase::Final, height_m, ..Default::default() }).title
        };
        assert_eq!(title(Some(4.9)), "The autopilot lands");
        assert_eq!(title(None), "The autopilot lands");
        assert_eq!(title(Some(0.4)), "Touching down");
    }

    #[test]
    fn a_detector_without_a_pose_is_distinguished_from_one_that_sees_no_marker() {
        assert_eq!(detector(DetectorState::Blind), "sees no marker");
        assert_eq!(detector(DetectorState::NoPose), "gives no pose");
    }
}
