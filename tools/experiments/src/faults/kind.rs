//! The kinds of faults of a campaign, by name: processes killed or stopped, links that delay or damage, false
//! messages of autopilots, detectors and cameras, no memory or disk left.

use std::str::FromStr;

/// The name of the preferred detector that lies.
pub const LIAR: &str = "liar";

/// A kind of fault.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Kind {
    /// The controller's process ends; after the duration another one resumes the landing.
    ControllerKilled,
    /// The controller's process is stopped (SIGSTOP), and goes on after the duration.
    ControllerStopped,
    /// The detector's process ends; after the duration another one takes its place.
    DetectorKilled,
    /// The detector's process is stopped, and goes on.
    DetectorStopped,
    /// The camera's process ends, and another one takes its place.
    CameraKilled,
    /// The camera's process is stopped, and goes on.
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
    /// It does, and the link codes it anew for each frame.
    PictureRecoded,
    /// A preferred detector says that the marker is 1 m beside its place.
    LiarJumps,
    /// A preferred detector lets the marker drift by 5 cm/s.
    LiarDrifts,
    /// A preferred detector finds nothing.
    PreferredIsBlind,
    /// The detector's poses are not numbers, infinite or absurd.
    DetectorBabbles,
    /// Seventy strangers publish detections.
    Crowd,
    /// A stranger publishes another camera's calibration and mount under the camera's name.
    StrangeCamera,
    /// The autopilot's landed state says "undefined".
    LandedUndefined,
    /// It says "taking off".
    LandedTakingOff,
    /// It says "on the ground".
    LandedOnGround,
    /// The autopilot's heartbeats alone are missing.
    HeartbeatMissing,
    /// Its heartbeats claim that the pilot has taken another mode.
    ModeLie,
    /// Its heartbeats claim that the motors are off.
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
    /// The ground station's bridge ends, and another one takes its place; in real time only.
    BridgeKilled,
    /// The bridge is stopped, and goes on; in real time only.
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

/// A kind, its name and its description.
type Row = (Kind, &'static str, &'static str);

const TABLE: [Row; 47] = [
    (
        Kind::ControllerKilled,
        "controller-killed",
        "its process ends; another one resumes after the duration",
    ),
    (Kind::ControllerStopped, "controller-stopped", "its process is stopped (SIGSTOP) and goes on"),
    (Kind::DetectorKilled, "detector-killed", "its process ends; another one follows"),
    (Kind::DetectorStopped, "detector-stopped", "its process is stopped and goes on"),
    (Kind::CameraKilled, "camera-killed", "its process ends; another one follows"),
    (Kind::CameraStopped, "camera-stopped", "its process is stopped and goes on"),
    (Kind::SilenceFrom, "silence-from", "nothing arrives from the autopilot"),
    (Kind::SilenceTo, "silence-to", "nothing arrives at the autopilot"),
    (Kind::SilenceBoth, "silence-both", "nothing passes the autopilot's link"),
    (Kind::LinkDelay, "link-delay", "the autopilot's packets are 50 to 500 ms late, each way"),
    (Kind::LinkJitter, "link-jitter", "they are late by up to 50 to 500 ms, in order"),
    (Kind::LinkLoss, "link-loss", "20 to 80 % of them never arrive"),
    (Kind::LinkDuplication, "link-duplication", "30 % of them arrive again, up to 1 s later"),
    (Kind::LinkReordering, "link-reordering", "30 % of them arrive up to 0.3 s later"),
    (Kind::LinkCorruption, "link-corruption", "30 % of them have flipped bits"),
    (Kind::FramesDelay, "frames-delay", "detections are 50 to 500 ms late"),
    (Kind::FramesJitter, "frames-jitter", "they are late by up to 50 to 500 ms, in order"),
    (Kind::FramesLoss, "frames-loss", "20 to 80 % of them never arrive"),
    (Kind::FramesDuplication, "frames-duplication", "30 % of them arrive again, up to 1 s later"),
    (Kind::FramesReordering, "frames-reordering", "30 % of them arrive up to 0.3 s later"),
    (Kind::FramesCorruption, "frames-corruption", "30 % of them have flipped bits"),
    (Kind::ClockStep, "clock-step", "frames' stamps are wrong by up to 2 s, either way"),
    (
        Kind::PictureRepeated,
        "picture-repeated",
        "the camera repeats its last picture, with new stamps",
    ),
    (Kind::PictureRecoded, "picture-recoded", "it does, and the link codes it anew each time"),
    (Kind::LiarJumps, "liar-jumps", "a preferred detector is 1 m off, from one frame to the next"),
    (Kind::LiarDrifts, "liar-drifts", "a preferred detector drifts by 5 cm/s"),
    (Kind::PreferredIsBlind, "preferred-is-blind", "a preferred detector finds nothing"),
    (Kind::DetectorBabbles, "detector-babbles", "the detector's poses are absurd"),
    (Kind::Crowd, "crowd", "seventy strangers publish detections"),
    (Kind::StrangeCamera, "strange-camera", "a stranger publishes another mount and focal length"),
    (Kind::LandedUndefined, "landed-undefined", "the autopilot's landed state is undefined"),
    (Kind::LandedTakingOff, "landed-taking-off", "it says \"taking off\""),
    (Kind::LandedOnGround, "landed-on-ground", "it says \"on the ground\""),
    (Kind::HeartbeatMissing, "heartbeat-missing", "the autopilot's heartbeats alone are missing"),
    (Kind::ModeLie, "mode-lie", "its heartbeats claim that the pilot has taken another mode"),
    (Kind::DisarmedLie, "disarmed-lie", "its heartbeats claim that the motors are off"),
    (Kind::OldBootTime, "old-boot-time", "one packet has a boot time of long ago"),
    (Kind::PositionFrozen, "position-frozen", "its position stays the same, with new stamps"),
    (Kind::PositionNan, "position-nan", "its position is not a number"),
    (Kind::PositionMissing, "position-missing", "its position is missing"),
    (Kind::AttitudeMissing, "attitude-missing", "its attitude is missing"),
    (Kind::BridgeKilled, "bridge-killed", "the ground station's bridge ends (real time only)"),
    (Kind::BridgeStopped, "bridge-stopped", "the bridge is stopped and goes on (real time only)"),
    (Kind::ControllerMemory, "controller-memory", "it gets no more memory (real time only)"),
    (Kind::DetectorMemory, "detector-memory", "it gets no more memory (real time only)"),
    (Kind::FullDisk, "full-disk", "no log can be written (real time only)"),
    (Kind::FullSharedMemory, "full-shared-memory", "/dev/shm is full (real time only)"),
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

    /// True for what only real processes show.
    pub fn needs_processes(self) -> bool {
        matches!(
            self,
            Self::BridgeKilled
                | Self::BridgeStopped
                | Self::ControllerMemory
                | Self::DetectorMemory
                | Self::FullDisk
                | Self::FullSharedMemory
        )
    }

    fn is_of_process(self) -> bool {
        matches!(
            self,
            Self::ControllerKilled
                | Self::ControllerStopped
                | Self::DetectorKilled
                | Self::DetectorStopped
                | Self::CameraKilled
                | Self::CameraStopped
        )
    }

    fn is_of_autopilot(self) -> bool {
        matches!(
            self,
            Self::SilenceFrom
                | Self::SilenceTo
                | Self::SilenceBoth
                | Self::LinkDelay
                | Self::LinkJitter
                | Self::LinkLoss
                | Self::LinkDuplication
                | Self::LinkReordering
                | Self::LinkCorruption
                | Self::LandedUndefined
                | Self::LandedTakingOff
                | Self::LandedOnGround
                | Self::HeartbeatMissing
                | Self::ModeLie
                | Self::DisarmedLie
                | Self::OldBootTime
                | Self::PositionFrozen
                | Self::PositionNan
                | Self::PositionMissing
                | Self::AttitudeMissing
        )
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        TABLE.iter().find(|row| row.0 == self).map_or("", |row| row.1)
    }

    /// Its description.
    pub fn words(self) -> &'static str {
        TABLE.iter().find(|row| row.0 == self).map_or("", |row| row.2)
    }

    /// True when a second detector, which lies, is preferred.
    pub fn is_preferred_liar(self) -> bool {
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
            assert!(!kind.words().is_empty());
        }
        assert!("none".parse::<Kind>().unwrap_err().contains("`alight experiment landing`"));
        assert!("nothing".parse::<Kind>().unwrap_err().contains("controller-killed"));
    }
}
