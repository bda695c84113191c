//! The lander's decisions, with their reasons.

use std::fmt;

use geometry::{Ned, Point, Vector};

/// What to do now, and why.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Decision {
    /// Where the landing stands.
    pub phase: Phase,
    /// What the autopilot must be told.
    pub action: Action,
    /// Why this phase and this action.
    pub why: Reason,
    /// The landing point as estimated; `None` before the marker was measured.
    pub target: Option<TargetEstimate>,
    /// Why this event was not used; `None` when it was.
    pub rejected: Option<Rejection>,
}

/// What the autopilot must be told.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Action {
    /// Nothing: stop streaming setpoints.
    None,
    /// Stream this velocity setpoint until the next decision.
    Velocity {
        /// In m/s.
        velocity: Vector<Ned>,
        /// In rad/s, clockwise seen from above.
        yaw_rate: f64,
    },
    /// Change back to the mode that follows setpoints. Given again, at the configured interval, until the mode changes.
    Guided,
    /// Stop the motors: the vehicle stands on the ground. Given again until they stand still.
    Disarm,
    /// Change to the autopilot's own LAND mode. Given again, at the configured interval, until the mode changes.
    Land,
}

impl Action {
    /// The setpoint that stops all motion.
    pub fn hover() -> Self {
        Self::Velocity { velocity: Vector::zero(), yaw_rate: 0.0 }
    }
}

/// The landing point as estimated from the detections.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct TargetEstimate {
    /// Where it is.
    pub position: Point<Ned>,
    /// How it moves in the autopilot's frame, in m/s: its own motion and the frame's drift.
    pub velocity: Vector<Ned>,
    /// Horizontal distance between the vehicle and the target, in metres.
    pub lateral_error_m: f64,
    /// Height of the vehicle's body origin above the target, in metres.
    pub height_m: f64,
    /// Time since the exposure of the newest detection used, in seconds.
    pub age_s: f64,
    /// Standard deviation of the horizontal position, in metres.
    pub deviation_m: f64,
    /// Detections used since the estimate was begun.
    pub detections: u32,
    /// Heading of the marker's upper edge in radians from north to east, when poses tell it.
    pub heading_rad: Option<f64>,
    /// By how much exposures are later than their stamps, in seconds.
    pub time_offset_s: f64,
    /// The newest detection's squared innovation over its covariance: about 3 when all is as expected.
    pub nis: Option<f64>,
    /// True while the marker is seen more often elsewhere than here: the vehicle does not descend.
    pub ambiguous: bool,
}

/// Where the landing stands.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Phase {
    /// Nothing asked for.
    Idle,
    /// Flying an expanding square until the marker is seen.
    Search,
    /// Moving over the marker.
    Approach,
    /// Descending over the marker.
    Descend,
    /// Climbing to where the lost marker must be in view.
    Retry,
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
            Self::Retry => "retry",
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

macro_rules! named {
    ($(#[$doc:meta])* $name:ident { $($(#[$variant_doc:meta])* $variant:ident = $key:literal, $text:literal;)* }) => {
        $(#[$doc])*
        #[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
        pub enum $name { $($(#[$variant_doc])* $variant,)* }

        impl $name {
            /// A short name for machines, in kebab-case; it does not change between versions.
            pub fn name(self) -> &'static str {
                match self { $(Self::$variant => $key,)* }
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self { $(Self::$variant => $text,)* })
            }
        }
    };
}

named! {
    /// Why the lander does what it does.
    Reason {
        /// Nobody asked for a landing.
        WaitingForStart = "waiting-for-start", "waiting for the start of a landing";
        /// A start was refused: no vehicle state is known, or it is stale.
        NoVehicleState = "no-vehicle-state", "no recent vehicle state is known";
        /// A start was refused: the vehicle is disarmed.
        NotArmed = "not-armed", "the vehicle is not armed";
        /// A start was refused: the vehicle is on the ground.
        OnTheGround = "on-the-ground", "the vehicle is on the ground";
        /// A start was refused: the autopilot does not follow setpoints.
        NotGuided = "not-guided", "the vehicle is not in GUIDED mode";
        /// A setpoint would abort the take-off.
        TakingOff = "taking-off", "waiting for the end of the take-off";
        /// The marker has not been seen often enough.
        Searching = "searching", "looking for the marker";
        /// The lateral error is too large for a descent at this height.
        Aligning = "aligning", "moving over the marker before descending";
        /// All is well.
        Descending = "descending", "descending over the marker";
        /// The marker left the view low over it, and the estimate is good.
        DescendingUnseen = "descending-unseen", "descending on the estimate, the marker is out of view";
        /// No recent detection: the descent stops until there is one.
        TargetAging = "target-aging", "no recent detection, descent stopped";
        /// The marker is seen at two places, and which is the pad is not decided.
        Ambiguous = "ambiguous", "the marker is seen at two places, descent stopped until one is seen in most frames";
        /// Low over the marker, waiting for a small error and a small speed.
        Settling = "settling", "settling over the marker before the touchdown";
        /// Low over the marker and settled.
        LowAndAligned = "low-and-aligned", "low and settled over the marker, handing over to LAND";
        /// The marker left the view when it was already right below.
        LowAndUnseen = "low-and-unseen", "marker out of view right below, handing over to LAND";
        /// The vehicle touched the ground before LAND was asked for.
        TouchedEarly = "touched-early", "on the ground already, handing over to LAND";
        /// The autopilot is in its LAND mode.
        AutopilotLands = "autopilot-lands", "the autopilot is landing";
        /// On the ground, disarmed.
        TouchedDown = "touched-down", "landed and disarmed";
        /// The operator asked to wait.
        OperatorHold = "operator-hold", "held by the operator";
        /// The marker was seen and is no longer.
        TargetLost = "target-lost", "marker lost, holding";
        /// The marker was never seen.
        TargetNotFound = "target-not-found", "marker not found, holding";
        /// The marker was seen and is no longer; it is looked for from higher up.
        Retrying = "retrying", "marker lost, climbing to see it again";
        /// Low over the marker for long, never near enough to its centre.
        NotSettling = "not-settling", "cannot settle over the marker, climbing to try again";
        /// The battery is low.
        BatteryLow = "battery-low", "the battery is low";
        /// The battery is nearly empty.
        BatteryCritical = "battery-critical", "the battery is nearly empty";
        /// The operator is no longer heard.
        OperatorLost = "operator-lost", "the operator is no longer heard";
        /// The link to the autopilot is lost.
        AutopilotLost = "autopilot-lost", "the autopilot is no longer heard, holding until it is";
        /// The autopilot's reports stopped.
        VehicleStale = "vehicle-stale", "no recent vehicle state, holding";
        /// The vehicle came no nearer in the time allowed.
        NoProgress = "no-progress", "too long in one phase, holding";
        /// The operator gave up.
        OperatorAbort = "operator-abort", "aborted by the operator";
        /// A hold lasted too long.
        HeldTooLong = "held-too-long", "aborted: held too long";
        /// The whole landing lasted too long.
        LandingTooLong = "landing-too-long", "aborted: the landing took too long";
        /// The marker was lost too often.
        RetriesUsed = "retries-used", "aborted: the marker was lost too often";
        /// The autopilot does not enter LAND, so low that there is only one way.
        LandingBySetpoints = "landing-by-setpoints", "the autopilot refuses LAND, going down without it: watch it and be ready to disarm";
        /// Camera and autopilot do not mean the same directions.
        CameraTurned = "camera-turned", "the camera's image moves as if it were mounted turned about the vertical, holding: check its mount";
        /// The same.
        ImageMirrored = "image-mirrored", "the camera's image moves as if it were mirrored, holding: check the camera's settings";
        /// The same.
        AttitudeSign = "attitude-sign", "the camera's image moves as if roll or pitch had the wrong sign, holding: check mount and autopilot";
        /// The descent waits for motion that shows whether camera and autopilot mean the same directions.
        AxisCheck = "axis-check", "checking camera/autopilot axis alignment before descending";
        /// The autopilot did not enter its LAND mode.
        LandRefused = "land-refused", "aborted: the autopilot did not enter LAND";
        /// The autopilot did not reach the ground.
        TouchdownOverdue = "touchdown-overdue", "aborted: no touchdown in the time allowed";
        /// The motors stopped in the middle of the landing.
        Disarmed = "disarmed", "aborted: disarmed before the touchdown";
        /// Somebody changed the flight mode.
        PilotTookOver = "pilot-took-over", "the flight mode was changed, the pilot flies";
    }
}

named! {
    /// Why an event was not used.
    Rejection {
        /// Too old when it arrived.
        Stale = "stale", "too old when it arrived";
        /// Its stamp lies in the future.
        FromTheFuture = "from-the-future", "its stamp lies in the future";
        /// Not newer than what was already used.
        OutOfOrder = "out-of-order", "not newer than what was already used";
        /// A number is infinite or not a number, or an image has no size.
        NotFinite = "not-finite", "a number in it is not finite";
        /// The vehicle's attitude at the stamp is not known.
        NoAttitude = "no-attitude", "the vehicle's attitude at its stamp is not known";
        /// The guidance needs metres and the detector gave none.
        NoPose = "no-pose", "it has no pose";
        /// The pose puts the marker beside or above the vehicle, or out of reach.
        Implausible = "implausible", "its pose is not below the vehicle";
        /// The detector was not sure enough.
        LowConfidence = "low-confidence", "its confidence is too low";
        /// A frame of this stamp was used already.
        Duplicate = "duplicate", "a frame of the same stamp was used already";
        /// Too far from the estimate.
        Outlier = "outlier", "too far from the estimate";
    }
}
