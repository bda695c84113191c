//! The messages between processes: types, the topic table, and the codec.
//!
//! Wire types are plain data. They do not define how they are used, and this crate does not depend on Zenoh, on
//! a clock or on an algorithm. Units are in the fields' names; coordinate frames and pixel conventions are those
//! of the `geometry` crate.
//!
//! Modules in reading order: [`topic`] is the table of everything that is published, [`codec`] turns it into
//! bytes and back, [`convert`] into the types of `geometry` and `imaging` and back; [`sample`] has messages
//! for tests, [`tape`] the events of a controller in order, and the others are the types by publisher.

#![cfg_attr(not(test), deny(clippy::disallowed_methods))] // The same results on every machine.

pub mod camera;
pub mod codec;
pub mod controller;
pub mod convert;
pub mod detector;
pub mod gcs;
pub mod health;
pub mod recorder;
pub mod sample;
pub mod simulation;
pub mod tape;
pub mod topic;
pub mod vehicle;

pub use camera::{
    BayerPattern, CameraControl, CameraInfo, ExposureLimits, ExposureReason, ExposureSetter,
    ExposureSetting, FrameAck, FrameHeader, FramePart, LensModel, MarkerLevels, PixelFormat,
    Transform3,
};
pub use codec::{DecodeError, Message, decode, encode};
pub use controller::{
    Candidate, CommandReply, ControllerCommand, ControllerStatus, DetectorState, Phase, Setpoint,
    TargetEstimate, matter,
};
pub use detector::{
    AlternativePose, CameraResponse, Detection, Detections, DetectorCommand, DetectorInfo,
    EllipsePx, MarkerPose, Place, Refusal, Refusals, RefusedShape, StageTime, looks_for_others,
    marker_name,
};
pub use gcs::{GcsSigning, GcsStatus, GroundStation, PacketSignature, SigningState};
pub use health::{Configuration, Count, Health, Latency, Rate};
pub use recorder::{NEVER_CAME, OTHER_KEYS, RecorderCount, RecorderStatus, has_never_come};
pub use simulation::{Touchdown, Truth, Wind};
pub use tape::{
    Tape, TapeAction, TapeDecision, TapeEvent, TapeNote, TapeOutput, TapePad, TapeRecord,
    TapeState, TapeTarget, TapeWriter,
};
pub use topic::{Delivery, MONITORS, Row, TOPICS, Topic};
pub use vehicle::{LandedState, MavlinkBytes, VehicleState};
