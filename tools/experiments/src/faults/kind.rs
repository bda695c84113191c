//! Names the kinds of faults of a campaign: processes killed or stopped, links that delay or damage, false
//! messages of autopilots, detectors and cameras, no memory or disk left.

use std::str::FromStr;

/// The name of the preferred detector with wrong detections.
pub const FAULTY_DETECTOR: &str = "liar";

/// A kind of fault. The order shows the affected part: a process, the autopilot's link, detections and cameras, values of the
/// autopilot, and last faults that only real processes show.
#[derive(Copy, Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// The controller's process ends; after the duration another one resumes the landing.
    ControllerKilled,
    /// The controller's process is stopped (SIGSTOP), and continues after the duration.
    ControllerStopped,
    /// The detector's process ends; after the duration another one replaces it.
    DetectorKilled,
    /// The detector's process is stopped, and continues.
    DetectorStopped,
    /// The camera's process ends, and another one replaces it.
    CameraKilled,
    /// The camera's process is stopped, and continues.
    CameraStopped,
    /// Nothing arrives from the autopilot.
    SilenceFrom,
    /// Nothing arrives at the autopilot.
    SilenceTo,
    /// Neither.
    SilenceBoth,
    /// Packets of the autopilot's link are late, each way.
    LinkDelay,
    /// They are late by a time that varies, in order.
    LinkJitter,
    /// Some never arrive.
    LinkLoss,
    /// Some arrive twice.
    LinkDuplication,
    /// Some arrive behind those that were sent after them.
    LinkReordering,
    /// Some arrive with flipped bits.
    LinkCorruption,
    /// Detections are late.
    FramesDelay,
    /// They are late by a time that varies.
    FramesJitter,
    /// Some never arrive.
    FramesLoss,
    /// Some arrive twice.
    FramesDuplication,
    /// Some arrive behind later ones.
    FramesReordering,
    /// Some arrive with flipped bits.
    FramesCorruption,
    /// The camera's clock steps: the stamps of its frames are wrong by one amount.
    ClockStep,
    /// The camera repeats its last picture, with new stamps.
    PictureRepeated,
    /// It does, and the link codes it again for each frame.
    PictureRecoded,
    /// A preferred detector reports the marker 1 m next to its position.
    LiarJumps,
    /// A preferred detector lets the marker drift by 5 cm/s.
    LiarDrifts,
    /// A preferred detector finds nothing.
    PreferredIsBlind,
    /// The detector's poses are not numbers, infinite or absurd.
    DetectorBabbles,
    /// Seventy unknown detectors publish detections.
    Crowd,
    /// An unknown process publishes another camera's calibration and mount under the camera's name.
    StrangeCamera,
    /// The autopilot's landed state is "undefined".
    LandedUndefined,
    /// It is "taking off".
    LandedTakingOff,
    /// It is "on the ground".
    LandedOnGround,
    /// The autopilot's heartbeats alone are missing.
    HeartbeatMissing,
    /// Its heartbeats falsely report another mode of the pilot.
    ModeLie,
    /// Its heartbeats falsely report that the motors are off.
    DisarmedLie,
    /// One packet has a boot time of long ago.
    OldBootTime,
    /// Its position stays the same, with new stamps.
    PositionFrozen,
    /// Its position is not a number.
    PositionNan,
    /// Its position is missing.
    PositionMissing,
    /// Its attitude is missing.
    AttitudeMissing,
    /// The ground station's bridge ends, and another one replaces it; in real time only.
    BridgeKilled,
    /// The bridge is stopped, and continues; in real time only.
    BridgeStopped,
    /// The controller gets no more memory; in real time only.
    ControllerMemory,
    /// The detector gets no more memory; in real time only.
    DetectorMemory,
    /// No log can be written; in real time only.
    FullDisk,
    /// Shared memory is full; in real time only.
    FullSharedMemory,
}

/// The kinds, in their order, with their names.
const TABLE: [(Kind, &str); 47] = [
    (Kind::ControllerKilled, "controller-killed"),
    (Kind::ControllerStopped, "controller-stopped"),
    (Kind::DetectorKilled, "detector-killed"),
    (Kind::DetectorStopped, "detector-stopped"),
    (Kind::CameraKilled, "camera-killed"),
    (Kind::CameraStopped, "camera-stopped"),
    (Kind::SilenceFrom, "silence-from"),
    (Kind::SilenceTo, "silence-to"),
    (Kind::SilenceBoth, "silence-both"),
    (Kind::LinkDelay, "link-delay"),
    (Kind::LinkJitter, "link-jitter"),
    (Kind::LinkLoss, "link-loss"),
    (Kind::LinkDuplication, "link-duplication"),
    (Kind::LinkReordering, "link-reordering"),
    (Kind::LinkCorruption, "link-corruption"),
    (Kind::FramesDelay, "frames-delay"),
    (Kind::FramesJitter, "frames-jitter"),
    (Kind::FramesLoss, "frames-loss"),
    (Kind::FramesDuplication, "frames-duplication"),
    (Kind::FramesReordering, "frames-reordering"),
    (Kind::FramesCorruption, "frames-corruption"),
    (Kind::ClockStep, "clock-step"),
    (Kind::PictureRepeated, "picture-repeated"),
    (Kind::PictureRecoded, "picture-recoded"),
    (Kind::LiarJumps, "liar-jumps"),
    (Kind::LiarDrifts, "liar-drifts"),
    (Kind::PreferredIsBlind, "preferred-is-blind"),
    (Kind::DetectorBabbles, "detector-babbles"),
    (Kind::Crowd, "crowd"),
    (Kind::StrangeCamera, "strange-camera"),
    (Kind::LandedUndefined, "landed-undefined"),
    (Kind::LandedTakingOff, "landed-taking-off"),
    (Kind::LandedOnGround, "landed-on-ground"),
    (Kind::HeartbeatMissing, "heartbeat-missing"),
    (Kind::ModeLie, "mode-lie"),
    (Kind::DisarmedLie, "disarmed-lie"),
    (Kind::OldBootTime, "old-boot-time"),
    (Kind::PositionFrozen, "position-frozen"),
    (Kind::PositionNan, "position-nan"),
    (Kind::PositionMissing, "position-missing"),
    (Kind::AttitudeMissing, "attitude-missing"),
    (Kind::BridgeKilled, "bridge-killed"),
    (Kind::BridgeStopped, "bridge-stopped"),
    (Kind::ControllerMemory, "controller-memory"),
    (Kind::DetectorMemory, "detector-memory"),
    (Kind::FullDisk, "full-disk"),
    (Kind::FullSharedMemory, "full-shared-memory"),
];

impl Kind {
    /// All kinds.
    pub fn all() -> impl Iterator<Item = Self> {
        TABLE.iter().map(|row| row.0)
    }

    /// The kinds that can be flown in lock-step.
    pub fn in_lockstep() -> impl Iterator<Item = Self> {
        Self::all().filter(|kind| !kind.needs_processes())
    }

    /// The kinds that can be flown in real time: those of processes and of the autopilot's link.
    pub fn in_real_time() -> impl Iterator<Item = Self> {
        Self::all()
            .filter(|kind| kind.needs_processes() || kind.is_of_process() || kind.is_of_autopilot())
    }

    /// True for faults that only real processes show.
    pub fn needs_processes(self) -> bool {
        self >= Self::BridgeKilled
    }

    fn is_of_process(self) -> bool {
        self <= Self::CameraStopped
    }

    fn is_of_autopilot(self) -> bool {
        (Self::SilenceFrom..=Self::LinkCorruption).contains(&self)
            || (Self::LandedUndefined..=Self::AttitudeMissing).contains(&self)
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        TABLE.iter().find(|row| row.0 == self).map_or("", |row| row.1)
    }

    /// True when a second detector with wrong detections is preferred.
    pub fn prefers_a_faulty_detector(self) -> bool {
        matches!(self, Self::LiarJumps | Self::LiarDrifts | Self::PreferredIsBlind)
    }
}

impl FromStr for Kind {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        if name == "none" {
            return Err(
                "here each flight has a fault; those of `alight experiment landing` have none"
                    .to_owned(),
            );
        }
        let found = TABLE.iter().find(|row| row.1 == name).map(|row| row.0);
        found.ok_or_else(|| {
            let names: Vec<&str> = TABLE.iter().map(|row| row.1).collect();
            format!("there is no kind `{name}`; there are {}", names.join(", "))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_has_a_unique_name() {
        assert_eq!((Kind::all().count(), Kind::in_lockstep().count()), (47, 41));
        for kind in Kind::all() {
            assert_eq!(kind.name().parse(), Ok(kind));
        }
        assert!("none".parse::<Kind>().unwrap_err().contains("`alight experiment landing`"));
        assert!("nothing".parse::<Kind>().unwrap_err().contains("controller-killed"));
    }
}
