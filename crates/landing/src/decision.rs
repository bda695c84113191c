//! The lander's result for an event: phase, action (velocity, GUIDED, LAND, disarm), reason, target estimate,
//! and why a detection was rejected.

use std::fmt;

use geometry::{Ned, Point, Vector};

/// The lander's decision for an event, with its reason.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Decision {
    /// The present phase.
    pub phase: Phase,
    /// The command for the autopilot.
    pub action: Action,
    /// Why this phase and this action.
    pub why: Reason,
    /// The landing point as estimated; `None` before the marker was measured.
    pub target: Option<TargetEstimate>,
    /// Why this event was not used; `None` when it was.
    pub rejected: Option<Rejection>,
}

/// A command for the autopilot.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Action {
    /// No action: stop streaming setpoints.
    None,
    /// Stream this velocity setpoint until the next decision.
    Velocity {
        /// In m/s.
        velocity: Vector<Ned>,
        /// In rad/s, clockwise seen from above.
        yaw_rate: f64,
    },
    /// Change back to the mode that follows setpoints. Repeated at the configured interval until the mode
    /// changes.
    Guided,
    /// Stop the motors: the vehicle stands on the ground. Repeated until they stop.
    Disarm,
    /// Change to the autopilot's own LAND mode. Repeated at the configured interval until the mode changes.
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
    /// Number of detections used since the estimate started.
    pub detections: u32,
    /// Heading of the marker's upper edge in radians from north to east, once known.
    pub heading_rad: Option<f64>,
    /// Estimated time offset: how much later exposures are than their stamps, in seconds.
    pub time_offset_s: f64,
    /// Normalised innovation squared (NIS) of the newest detection: about 3 when the model fits.
    pub nis: Option<f64>,
    /// True while the marker is seen more often elsewhere than here: the vehicle does not descend.
    pub ambiguous: bool,
}

/// The phase of a landing.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Phase {
    /// No landing requested.
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
    /// Hovering until the reason is gone.
    Hold,
    /// The landing was aborted.
    Aborted,
    /// The pilot flies; no setpoints until a new start.
    PilotInCommand,
}

impl Phase {
    /// True when only a new start leaves this phase.
    pub fn is_terminal(self) -> bool {
        matches!(self, Self::Idle | Self::Landed | Self::Aborted | Self::PilotInCommand)
    }

    /// A short name for machines, in kebab-case.
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
            /// A short name for machines, in kebab-case.
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
    /// The reason for an action of the lander.
    Reason {
        /// No landing was requested.
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
        /// Everything is nominal.
        Descending = "descending", "descending over the marker";
        /// The marker left the view low over it, and the estimate is good.
        DescendingUnseen = "descending-unseen", "descending on the estimate, the marker is out of view";
        /// No recent detection was used: the descent stops until there is one.
        TargetAging = "target-aging", "no recent detection that could be used, descent stopped";
        /// The marker is seen at two positions, and it is undecided which is the pad.
        Ambiguous = "ambiguous", "the marker is seen at two places, descent stopped until one is seen in most frames";
        /// Two detectors see the marker at two positions, or with two headings where the vehicle turns to it, and it is not known which is
        /// right.
        Disputed = "disputed", "detectors see the marker at two places or turned, not descending near the ground until they agree";
        /// Low over the marker, waiting for a small error and a small speed.
        Settling = "settling", "settling over the marker before the touchdown";
        /// Low over the marker and settled.
        LowAndAligned = "low-and-aligned", "low and settled over the marker, handing over to LAND";
        /// The marker left the view right below the vehicle.
        LowAndUnseen = "low-and-unseen", "marker out of view right below, handing over to LAND";
        /// The vehicle touched the ground before LAND was requested.
        TouchedEarly = "touched-early", "on the ground already, handing over to LAND";
        /// The vehicle is still and low over the pad after the marker or the autopilot was lost: it may stand there.
        MayStand = "may-stand", "still and low over the pad, it may stand there: handing over to LAND";
        /// The autopilot is in its LAND mode.
        AutopilotLands = "autopilot-lands", "the autopilot is landing";
        /// On the ground, disarmed.
        TouchedDown = "touched-down", "on the ground, disarmed";
        /// The operator commanded a hold.
        OperatorHold = "operator-hold", "held by the operator";
        /// The marker was lost.
        TargetLost = "target-lost", "marker lost, holding";
        /// The marker is seen, but its detections are refused.
        TargetRefused = "target-refused", "the marker is seen, but not where it is expected, holding";
        /// The marker was never seen.
        TargetNotFound = "target-not-found", "marker not found, holding";
        /// The marker was lost; the vehicle climbs to find it.
        Retrying = "retrying", "marker lost, climbing to see it again";
        /// The marker is seen, but its detections are refused; the vehicle climbs.
        RetryingRefused = "retrying-refused", "the marker is seen, but not where it is expected, climbing to look again";
        /// Low over the marker for too long without reaching its centre.
        NotSettling = "not-settling", "cannot settle over the marker, climbing to try again";
        /// The battery is low.
        BatteryLow = "battery-low", "the battery is low";
        /// The battery is nearly empty.
        BatteryCritical = "battery-critical", "the battery is nearly empty";
        /// The link to the operator is lost.
        OperatorLost = "operator-lost", "operator link lost";
        /// The link to the autopilot is lost.
        AutopilotLost = "autopilot-lost", "autopilot link lost, holding until it is back";
        /// The autopilot's reports have not been received for a moment.
        VehicleAging = "vehicle-aging", "no vehicle state just now, descent stopped";
        /// The autopilot's reports stopped.
        VehicleStale = "vehicle-stale", "no recent vehicle state, holding";
        /// The autopilot's heartbeat, and with it the mode, is missing, or a mode may be the autopilot's reaction to missing setpoints.
        ModeUnknown = "mode-unknown", "the autopilot's mode is not known (no heartbeat for seconds, or setpoints were missing just before), holding";
        /// Over the link to the autopilot setpoints arrive too late to steer by.
        LinkSlow = "link-slow", "the link to the autopilot takes more than 0.7 s both ways, too slow to steer, holding";
        /// The controller did not run, or its link was lost, for a time after which no landing continues automatically.
        Standstill = "standstill", "the controller did not run, or had no link to the autopilot, for more than 15 s, holding: `resume` continues the landing, `abort` ends it";
        /// No detector is alive.
        NoDetector = "no-detector", "no detector is alive, nothing descends";
        /// No progress in the time allowed.
        NoProgress = "no-progress", "too long in one phase, holding";
        /// The operator aborted.
        OperatorAbort = "operator-abort", "aborted by the operator";
        /// The operator commanded a landing without the marker.
        OperatorLand = "operator-land", "landing straight down here, as the operator commanded";
        /// A hold lasted too long.
        HeldTooLong = "held-too-long", "aborted: held too long";
        /// The whole landing lasted too long.
        LandingTooLong = "landing-too-long", "aborted: the landing took too long";
        /// No retry is left.
        RetriesUsed = "retries-used", "aborted: the marker was lost, or the vehicle did not settle over it, too often";
        /// The autopilot does not enter LAND, too low to stay.
        LandingBySetpoints = "landing-by-setpoints", "the autopilot refuses LAND, descending by setpoints: be ready to disarm";
        /// The axes of camera and autopilot do not match.
        CameraTurned = "camera-turned", "the camera's image moves as if it were mounted turned about the vertical, holding: check its mount";
        /// As above.
        ImageMirrored = "image-mirrored", "the camera's image moves as if it were mirrored, holding: check the camera's settings";
        /// As above.
        AttitudeSign = "attitude-sign", "the camera's image moves as if roll or pitch had the wrong sign, holding: check mount and autopilot";
        /// The marker does not come nearer as one of the configured size does.
        MarkerSize = "marker-size", "the marker does not come nearer as one of the configured size does, holding: check the size of the printed marker and the one configured";
        /// The descent waits for motion that shows whether the axes of camera and autopilot match.
        AxisCheck = "axis-check", "checking camera/autopilot axis alignment before descending";
        /// The autopilot did not enter its LAND mode.
        LandRefused = "land-refused", "aborted: the autopilot did not enter LAND";
        /// The autopilot did not report the ground.
        TouchdownOverdue = "touchdown-overdue", "aborted: the autopilot reported no touchdown in the time allowed";
        /// The motors stopped during the landing, and no report of the ground came.
        Disarmed = "disarmed", "aborted: disarmed before the touchdown";
        /// The motors stopped while the vehicle flew.
        StoppedInAir = "stopped-in-air", "aborted: the motors were stopped (disarmed) in the air";
        /// The flight mode was changed by the pilot or another program.
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
        /// Not newer than an event already used.
        OutOfOrder = "out-of-order", "not newer than an event already used";
        /// A number is infinite or not a number, or an image has no size.
        NotFinite = "not-finite", "a number in it is not finite";
        /// The vehicle's attitude at the stamp is not known.
        NoAttitude = "no-attitude", "the vehicle's attitude at its stamp is not known";
        /// The guidance needs metres and the detector gave none.
        NoPose = "no-pose", "it has no pose";
        /// The pose puts the marker to the side of or above the vehicle, or out of range.
        Implausible = "implausible", "its pose is not below the vehicle";
        /// The covariance is not one: not symmetric, not positive semi-definite, or huge.
        BadCovariance = "bad-covariance", "its covariance is not valid: not symmetric, not positive semi-definite or larger than any range";
        /// The detector's confidence is too low.
        LowConfidence = "low-confidence", "its confidence is too low";
        /// The camera repeats an old picture.
        RepeatedPicture = "repeated-picture", "its marker stays while the vehicle moves, so the camera repeats an old picture";
        /// A frame of this stamp was used already.
        Duplicate = "duplicate", "a frame of the same stamp was used already";
        /// Too far from the estimate.
        Outlier = "outlier", "too far from the estimate";
    }
}
