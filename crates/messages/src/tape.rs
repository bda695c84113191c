//! The controller's tape on the wire: records of events (packets, detections, commands, ticks) with their times, decisions and
//! packets out of them, and a running hash.
//!
//! A [`Tape`] holds some records. The hash of each is over its event, time and output and the hash before (XXH3 of 64 bits,
//! seeded with that): a bit that was flipped, and a record that is missing, is found at once. The content of a tape is enough to
//! fly the same flight again.

use std::borrow::Cow;

use serde::{Deserialize, Serialize, Serializer};
use xxhash_rust::xxh3::xxh3_64_with_seed;

use crate::camera::CameraInfo;
use crate::codec::wire;
use crate::controller::{CommandReply, ControllerCommand, ControllerStatus, TargetEstimate};
use crate::detector::{Detections, DetectorInfo};

wire! {
    Tape = 19 v 7;
}

/// Length of the hash at the end of each record, in bytes.
const HASH_LEN: usize = size_of::<u64>();
/// Maximum size of the records that wait to be taken from a [`TapeWriter`], in bytes. Beyond it they are dropped, and the
/// numbers of later records show it.
const MAX_WAITING_BYTES: usize = 1 << 20;

/// Some records of a controller's tape, in order.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Tape {
    /// When the controller began its tape, in nanoseconds of its clock: it distinguishes the tapes of two controllers.
    pub begun_ns: i64,
    /// Number of the first of these records; the first of all has 0.
    pub first: u64,
    /// How many records these are.
    pub count: u32,
    /// The records, one after the other, each with its hash; [`Tape::records`] reads them.
    pub records: Vec<u8>,
}

/// An event that a controller handled.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum TapeEvent<'a> {
    /// It started; always the first.
    Begin {
        /// The program with its version.
        #[serde(borrow)]
        program: Cow<'a, str>,
        /// The target of its build.
        #[serde(borrow)]
        build: Cow<'a, str>,
        /// Its effective configuration, as TOML.
        #[serde(borrow)]
        configuration: Cow<'a, str>,
    },
    /// It took over a parameter that an earlier controller left to restore.
    TakeOver(TapeNote),
    /// A packet of the autopilot's link.
    Packet {
        /// As it came.
        #[serde(borrow, serialize_with = "as_bytes")]
        raw: Cow<'a, [u8]>,
    },
    /// A packet of the ground station for the autopilot.
    GroundPacket {
        /// As it came.
        #[serde(borrow, serialize_with = "as_bytes")]
        raw: Cow<'a, [u8]>,
    },
    /// Time passed.
    Tick,
    /// Detections.
    Detections {
        /// The detector on whose key they came.
        #[serde(borrow)]
        publisher: Cow<'a, str>,
        /// The message.
        message: Cow<'a, Detections>,
    },
    /// A camera's calibration and mount.
    Camera(Cow<'a, CameraInfo>),
    /// A detector came or went.
    Presence {
        /// Its name.
        #[serde(borrow)]
        detector: Cow<'a, str>,
        /// Whether it came.
        alive: bool,
    },
    /// A detector's information.
    DetectorInfo {
        /// The detector on whose key it came.
        #[serde(borrow)]
        publisher: Cow<'a, str>,
        /// The message.
        info: Cow<'a, DetectorInfo>,
    },
    /// An operator's command.
    Command(Cow<'a, ControllerCommand>),
    /// Messages of another version were refused.
    RefusedVersion,
    /// It ends.
    Shutdown,
    /// No event was handled: this is its state, written from time to time. It shows the state of the flight after a missing
    /// part, and in a replay the first difference before a decision shows it.
    State(Box<TapeState>),
    /// It took over the position of the pad that an earlier controller had estimated.
    TakeOverPad(TapePad),
}

/// The state of a controller.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TapeState {
    /// Its status; without latencies, which the health report counts.
    pub status: ControllerStatus,
    /// The landing point.
    pub target: TargetEstimate,
}

/// A parameter of the autopilot that an earlier controller left to restore.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TapeNote {
    /// The link's address.
    pub address: String,
    /// The vehicle's MAVLink system id.
    pub system: u8,
    /// Name of the parameter.
    pub parameter: String,
    /// Its value before the landing, in seconds.
    pub original_s: f64,
    /// Its value for the landing, in seconds.
    pub set_s: f64,
}

/// The position of the pad that an earlier controller had estimated.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TapePad {
    /// The link's address.
    pub address: String,
    /// The vehicle's MAVLink system id.
    pub system: u8,
    /// The time of it, in nanoseconds of the controller's clock.
    pub stamp_ns: i64,
    /// North, east and down of the autopilot's local origin, in metres.
    pub position_ned_m: [f64; 3],
    /// Standard deviation of the horizontal position, in metres.
    pub deviation_m: f64,
}

/// A decision of the lander, with the detector in use.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TapeDecision<'a> {
    /// The phase, by its short name.
    pub phase: &'a str,
    /// The command for the autopilot.
    pub action: TapeAction,
    /// Why this phase and this action, by its short name.
    pub why: &'a str,
    /// The landing point, as estimated.
    pub target: Option<TapeTarget>,
    /// Why the event was not used, by its short name.
    pub rejected: Option<&'a str>,
    /// The detector in use.
    pub detector: Option<&'a str>,
}

/// A command for the autopilot.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub enum TapeAction {
    /// Nothing.
    None,
    /// A velocity setpoint.
    Velocity {
        /// In local NED, in m/s.
        velocity_ned_m_s: [f64; 3],
        /// Clockwise seen from above, in rad/s.
        yaw_rate_rad_s: f64,
    },
    /// The mode that follows setpoints.
    Guided,
    /// Stop the motors.
    Disarm,
    /// The autopilot's LAND mode.
    Land,
}

/// The landing point, as estimated.
#[derive(Copy, Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TapeTarget {
    /// In local NED, in metres.
    pub position_ned_m: [f64; 3],
    /// In local NED, in m/s.
    pub velocity_ned_m_s: [f64; 3],
    /// Horizontal distance from the vehicle, in metres.
    pub lateral_error_m: f64,
    /// Height of the vehicle above it, in metres.
    pub height_m: f64,
    /// Age of the newest detection used, since its exposure, in seconds.
    pub age_s: f64,
    /// Standard deviation of its horizontal position, in metres.
    pub deviation_m: f64,
    /// Number of detections used.
    pub detections: u32,
    /// Heading of the marker's upper edge, from north to east, in radians.
    pub heading_rad: Option<f64>,
    /// Delay of exposures after their stamps, in seconds.
    pub time_offset_s: f64,
    /// Normalised innovation squared of the newest detection.
    pub nis: Option<f64>,
    /// True while the marker is seen more often elsewhere.
    pub ambiguous: bool,
}

/// The output of an event.
#[derive(Copy, Clone, Debug, Default)]
pub struct TapeOutput<'a> {
    /// The decision; `None` when it is the one before.
    pub decision: Option<TapeDecision<'a>>,
    /// The packets for the autopilot, one after the other.
    pub packets: &'a [u8],
    /// The answer to a command.
    pub reply: Option<&'a CommandReply>,
}

/// A record as it stands on the tape, before its hash.
#[derive(Serialize, Deserialize)]
struct Step<'a> {
    now_ns: i64,
    #[serde(borrow)]
    event: TapeEvent<'a>,
    #[serde(borrow, serialize_with = "as_bytes")]
    decision: Cow<'a, [u8]>,
    #[serde(borrow, serialize_with = "as_bytes")]
    packets: Cow<'a, [u8]>,
    reply: Option<Cow<'a, CommandReply>>,
}

/// The same with the event borrowed.
#[derive(Serialize)]
struct StepRef<'a> {
    now_ns: i64,
    event: &'a TapeEvent<'a>,
    #[serde(serialize_with = "as_bytes")]
    decision: &'a [u8],
    #[serde(serialize_with = "as_bytes")]
    packets: &'a [u8],
    reply: Option<&'a CommandReply>,
}

/// A record that was read from a tape.
#[derive(Clone, Debug, PartialEq)]
pub struct TapeRecord<'a> {
    /// Its number; the first has 0.
    pub number: u64,
    /// When it was handled, in nanoseconds of the controller's clock.
    pub now_ns: i64,
    /// The event that was handled.
    pub event: TapeEvent<'a>,
    /// The packets for the autopilot that came out, one after the other.
    pub packets: Cow<'a, [u8]>,
    /// The answer to a command.
    pub reply: Option<CommandReply>,
    /// The decision as bytes, read by [`TapeRecord::decision`]; empty when it is the one before.
    pub decision: Cow<'a, [u8]>,
    /// The running hash.
    pub hash: u64,
    /// The bytes that the hash covers, in addition to the hash before.
    bytes: &'a [u8],
}

/// Why a record cannot be read.
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("record {number} of the tape is cut or damaged")]
pub struct TapeDamage {
    /// Number of the record.
    pub number: u64,
}

/// Writes a tape: records in, [`Tape`]s out.
#[derive(Clone, Debug)]
pub struct TapeWriter {
    begun_ns: i64,
    /// Number of the next record.
    next: u64,
    hash: u64,
    /// The decision of the record before, as bytes.
    decision: Vec<u8>,
    /// That of this record.
    new_decision: Vec<u8>,
    records: Buffer,
    count: u32,
}

fn as_bytes<S: Serializer>(bytes: impl AsRef<[u8]>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_bytes(bytes.as_ref())
}

/// Bytes that grow, in memory that is reused: values are written in place, without a check of its size for each of
/// their parts.
#[derive(Clone, Debug, Default)]
struct Buffer {
    /// The bytes in use, and zeros or older bytes behind them.
    memory: Vec<u8>,
    len: usize,
}

impl Buffer {
    /// Memory that is added at a time, in bytes.
    const STEP: usize = 4096;

    fn bytes(&self) -> &[u8] {
        self.memory.get(..self.len).unwrap_or_default()
    }

    fn clear(&mut self) {
        self.len = 0;
    }

    /// Appends a value as postcard writes it.
    fn append<T: Serialize>(&mut self, value: &T) {
        loop {
            let free = self.memory.get_mut(self.len..).unwrap_or_default();
            match postcard::to_slice(value, free) {
                Ok(written) => {
                    self.len += written.len();
                    return;
                }
                Err(postcard::Error::SerializeBufferFull) => {
                    let more = self.memory.len().max(Self::STEP);
                    self.memory.resize(self.memory.len() + more, 0);
                }
                // Only for sequences of unknown length, which no record has.
                Err(_) => return,
            }
        }
    }
}

fn running_hash(before: u64, bytes: &[u8]) -> u64 {
    xxh3_64_with_seed(bytes, before)
}

impl TapeWriter {
    /// An empty tape that begins at `now_ns`.
    pub fn new(now_ns: i64) -> Self {
        Self {
            begun_ns: now_ns,
            next: 0,
            hash: 0,
            decision: Vec::new(),
            new_decision: Vec::new(),
            records: Buffer::default(),
            count: 0,
        }
    }

    /// Adds an event that was handled at `now_ns`, with its output.
    pub fn write(&mut self, now_ns: i64, event: &TapeEvent<'_>, output: &TapeOutput<'_>) {
        if self.records.len > MAX_WAITING_BYTES {
            self.records.clear();
            self.count = 0;
        }
        self.new_decision.clear();
        if let Some(new) = &output.decision {
            new.write(&mut self.new_decision);
        }
        let is_as_before = self.new_decision == self.decision;
        let start = self.records.len;
        let step = StepRef {
            now_ns,
            event,
            decision: if is_as_before { &[] } else { &self.new_decision },
            packets: output.packets,
            reply: output.reply,
        };
        self.records.append(&step);
        self.hash = running_hash(self.hash, self.records.bytes().get(start..).unwrap_or_default());
        // Postcard writes an array of bytes as it is.
        self.records.append(&self.hash.to_le_bytes());
        self.next += 1;
        self.count += 1;
        if output.decision.is_some() {
            std::mem::swap(&mut self.decision, &mut self.new_decision);
        }
    }

    /// Size of the records that wait to be taken, in bytes.
    pub fn waiting_bytes(&self) -> usize {
        self.records.len
    }

    /// The records since the last call; `None` when there are none.
    pub fn take(&mut self) -> Option<Tape> {
        if self.count == 0 {
            return None;
        }
        let count = std::mem::take(&mut self.count);
        let records = self.records.bytes().to_vec();
        self.records.clear();
        Some(Tape { begun_ns: self.begun_ns, first: self.next - u64::from(count), count, records })
    }
}

impl Tape {
    /// Its records, up to the first that cannot be read.
    pub fn records(&self) -> impl Iterator<Item = Result<TapeRecord<'_>, TapeDamage>> {
        let mut rest = Some(self.records.as_slice());
        let mut number = self.first;
        let end = self.first.saturating_add(u64::from(self.count));
        std::iter::from_fn(move || {
            let bytes = rest.take()?;
            if number == end {
                return (!bytes.is_empty()).then_some(Err(TapeDamage { number }));
            }
            match TapeRecord::read(number, bytes) {
                Some((record, after)) => {
                    number += 1;
                    rest = Some(after);
                    Some(Ok(record))
                }
                None => Some(Err(TapeDamage { number })),
            }
        })
    }
}

impl<'a> TapeRecord<'a> {
    fn read(number: u64, bytes: &'a [u8]) -> Option<(Self, &'a [u8])> {
        let (step, rest) = postcard::take_from_bytes::<Step<'a>>(bytes).ok()?;
        let covered = bytes.get(..bytes.len().checked_sub(rest.len())?)?;
        let (hash, rest) = rest.split_first_chunk::<HASH_LEN>()?;
        let record = Self {
            number,
            now_ns: step.now_ns,
            event: step.event,
            packets: step.packets,
            reply: step.reply.map(Cow::into_owned),
            decision: step.decision,
            hash: u64::from_le_bytes(*hash),
            bytes: covered,
        };
        Some((record, rest))
    }

    /// Whether its hash is the one after `before`, that of the record before; before the first it is 0.
    pub fn follows(&self, before: u64) -> bool {
        running_hash(before, self.bytes) == self.hash
    }

    /// The decision; `None` when it is the one before, or cannot be read.
    pub fn decision(&self) -> Option<TapeDecision<'_>> {
        TapeDecision::from_bytes(&self.decision)
    }
}

/// The parts that follow in the bytes of a decision.
#[derive(Copy, Clone, Default)]
struct Contents(u8);

impl Contents {
    /// The action's number.
    const ACTION: u8 = 0b111;
    const TARGET: u8 = 1 << 3;
    const REJECTED: u8 = 1 << 4;
    const DETECTOR: u8 = 1 << 5;
    const HEADING: u8 = 1 << 6;
    const NIS: u8 = 1 << 7;

    fn with(self, part: u8, is_there: bool) -> Self {
        Self(if is_there { self.0 | part } else { self.0 })
    }

    fn has(self, part: u8) -> bool {
        self.0 & part != 0
    }
}

/// Appends numbers: all of them at once, as there is a decision for most events.
fn write_numbers<const N: usize>(numbers: [f64; N], bytes: &mut Vec<u8>) {
    let mut all = [[0; 8]; N];
    for (slot, number) in all.iter_mut().zip(numbers) {
        *slot = number.to_le_bytes();
    }
    bytes.extend_from_slice(all.as_flattened());
}

/// Appends a name with its length before it. Names are short; of a longer one than can be the rest is left out.
fn write_name(name: &str, bytes: &mut Vec<u8>) {
    let length = u16::try_from(name.len()).unwrap_or(u16::MAX);
    bytes.extend_from_slice(&length.to_le_bytes());
    bytes.extend_from_slice(name.as_bytes().get(..usize::from(length)).unwrap_or_default());
}

fn read_numbers<const N: usize>(bytes: &mut &[u8]) -> Option<[f64; N]> {
    let mut numbers = [0.0; N];
    for number in &mut numbers {
        let (first, rest) = bytes.split_first_chunk()?;
        (*number, *bytes) = (f64::from_le_bytes(*first), rest);
    }
    Some(numbers)
}

fn read_name<'a>(bytes: &mut &'a [u8]) -> Option<&'a str> {
    let (length, rest) = bytes.split_first_chunk()?;
    let (name, rest) = rest.split_at_checked(usize::from(u16::from_le_bytes(*length)))?;
    *bytes = rest;
    std::str::from_utf8(name).ok()
}

impl<'a> TapeDecision<'a> {
    /// Appends its bytes: [`Contents`], the names, the setpoint and the target, as far as it has them; numbers with the lowest
    /// byte first.
    fn write(&self, bytes: &mut Vec<u8>) {
        let action = match self.action {
            TapeAction::None => 0,
            TapeAction::Velocity { .. } => 1,
            TapeAction::Guided => 2,
            TapeAction::Disarm => 3,
            TapeAction::Land => 4,
        };
        let target = self.target.as_ref();
        let contents = Contents(action)
            .with(Contents::TARGET, target.is_some())
            .with(Contents::REJECTED, self.rejected.is_some())
            .with(Contents::DETECTOR, self.detector.is_some())
            .with(Contents::HEADING, target.is_some_and(|it| it.heading_rad.is_some()))
            .with(Contents::NIS, target.is_some_and(|it| it.nis.is_some()));
        bytes.push(contents.0);
        let names = [Some(self.phase), Some(self.why), self.rejected, self.detector];
        names.into_iter().flatten().for_each(|name| write_name(name, bytes));
        if let TapeAction::Velocity { velocity_ned_m_s: [north, east, down], yaw_rate_rad_s } =
            self.action
        {
            write_numbers([north, east, down, yaw_rate_rad_s], bytes);
        }
        let Some(target) = target else { return };
        let [north_m, east_m, down_m] = target.position_ned_m;
        let [north_m_s, east_m_s, down_m_s] = target.velocity_ned_m_s;
        let numbers = [
            north_m,
            east_m,
            down_m,
            north_m_s,
            east_m_s,
            down_m_s,
            target.lateral_error_m,
            target.height_m,
            target.age_s,
            target.deviation_m,
            target.time_offset_s,
        ];
        write_numbers(numbers, bytes);
        target.heading_rad.into_iter().for_each(|it| write_numbers([it], bytes));
        target.nis.into_iter().for_each(|it| write_numbers([it], bytes));
        bytes.extend_from_slice(&target.detections.to_le_bytes());
        bytes.push(u8::from(target.ambiguous));
    }

    /// The decision in the bytes of a [`TapeRecord`]; `None` when they are none.
    pub fn from_bytes(mut bytes: &'a [u8]) -> Option<Self> {
        let (first, rest) = bytes.split_first()?;
        let contents = Contents(*first);
        bytes = rest;
        let (phase, why) = (read_name(&mut bytes)?, read_name(&mut bytes)?);
        let mut name_if = |part| match contents.has(part) {
            true => read_name(&mut bytes).map(Some),
            false => Some(None),
        };
        let (rejected, detector) = (name_if(Contents::REJECTED)?, name_if(Contents::DETECTOR)?);
        let action = match first & Contents::ACTION {
            0 => TapeAction::None,
            1 => {
                let [north, east, down, yaw_rate_rad_s] = read_numbers(&mut bytes)?;
                TapeAction::Velocity { velocity_ned_m_s: [north, east, down], yaw_rate_rad_s }
            }
            2 => TapeAction::Guided,
            3 => TapeAction::Disarm,
            4 => TapeAction::Land,
            _ => return None,
        };
        let target = match contents.has(Contents::TARGET) {
            true => Some(TapeTarget::read(contents, &mut bytes)?),
            false => None,
        };
        bytes.is_empty().then_some(Self { phase, action, why, target, rejected, detector })
    }
}

impl TapeTarget {
    fn read(contents: Contents, bytes: &mut &[u8]) -> Option<Self> {
        let position_ned_m = read_numbers(bytes)?;
        let velocity_ned_m_s = read_numbers(bytes)?;
        let [lateral_error_m, height_m, age_s, deviation_m, time_offset_s] = read_numbers(bytes)?;
        let mut number_if = |part| match contents.has(part) {
            true => read_numbers(bytes).map(|[number]| Some(number)),
            false => Some(None),
        };
        let (heading_rad, nis) = (number_if(Contents::HEADING)?, number_if(Contents::NIS)?);
        let (detections, rest) = bytes.split_first_chunk()?;
        let (ambiguous, rest) = rest.split_first()?;
        *bytes = rest;
        Some(Self {
            position_ned_m,
            velocity_ned_m_s,
            lateral_error_m,
            height_m,
            age_s,
            deviation_m,
            detections: u32::from_le_bytes(*detections),
            heading_rad,
            time_offset_s,
            nis,
            ambiguous: *ambiguous != 0,
        })
    }
}

impl TapeEvent<'_> {
    /// Its name for people.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Begin { .. } => "begin",
            Self::TakeOver(_) => "take-over",
            Self::Packet { .. } => "packet",
            Self::GroundPacket { .. } => "ground-packet",
            Self::Tick => "tick",
            Self::Detections { .. } => "detections",
            Self::Camera(_) => "camera",
            Self::Presence { .. } => "presence",
            Self::DetectorInfo { .. } => "detector-info",
            Self::Command(_) => "command",
            Self::RefusedVersion => "refused-version",
            Self::Shutdown => "shutdown",
            Self::State(_) => "state",
            Self::TakeOverPad(_) => "take-over-pad",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn decision() -> TapeDecision<'static> {
        TapeDecision {
            phase: "descend",
            action: TapeAction::Velocity {
                velocity_ned_m_s: [0.5, -0.25, 0.75],
                yaw_rate_rad_s: 0.0,
            },
            why: "descending",
            target: None,
            rejected: None,
            detector: Some("main"),
        }
    }

    fn written() -> Tape {
        let mut writer = TapeWriter::new(5);
        let output = TapeOutput { decision: Some(decision()), packets: b"abc", reply: None };
        writer.write(7, &TapeEvent::Tick, &output);
        writer.write(8, &TapeEvent::Tick, &output);
        let packet = TapeEvent::Packet { raw: Cow::Borrowed(b"packet") };
        writer.write(9, &packet, &TapeOutput::default());
        writer.take().unwrap()
    }

    #[test]
    fn every_decision_is_read_again_and_cut_bytes_are_no_decision() {
        let target = TapeTarget {
            position_ned_m: [1.0, 2.0, 3.0],
            velocity_ned_m_s: [4.0, 5.0, -0.0],
            lateral_error_m: 7.0,
            height_m: 8.0,
            age_s: 9.0,
            deviation_m: 10.0,
            detections: 11,
            heading_rad: Some(12.0),
            time_offset_s: 13.0,
            nis: Some(14.0),
            ambiguous: true,
        };
        let setpoint = decision().action;
        let actions =
            [TapeAction::None, setpoint, TapeAction::Guided, TapeAction::Disarm, TapeAction::Land];
        let targets = [
            None,
            Some(target),
            Some(TapeTarget { heading_rad: None, ..target }),
            Some(TapeTarget { nis: None, ambiguous: false, ..target }),
        ];
        let mut all = std::collections::BTreeSet::new();
        for action in actions {
            for target in targets {
                for rejected in [None, Some("stale")] {
                    for detector in [None, Some("main"), Some("")] {
                        let decision =
                            TapeDecision { action, target, rejected, detector, ..decision() };
                        let mut bytes = Vec::new();
                        decision.write(&mut bytes);
                        assert_eq!(TapeDecision::from_bytes(&bytes), Some(decision));
                        for length in 0..bytes.len() {
                            assert_eq!(TapeDecision::from_bytes(&bytes[..length]), None);
                        }
                        assert_eq!(TapeDecision::from_bytes(&[&bytes[..], b"?"].concat()), None);
                        assert!(all.insert(bytes), "the same bytes for two decisions");
                    }
                }
            }
        }
        assert_eq!(all.len(), 5 * 4 * 2 * 3);
        assert_eq!(TapeDecision::from_bytes(&[5, 0, 0, 0, 0]), None);
    }

    fn hashes_fit(tape: &Tape) -> bool {
        let mut before = 0;
        let mut count = 0;
        for record in tape.records() {
            let Ok(record) = record else { return false };
            if !record.follows(before) {
                return false;
            }
            before = record.hash;
            count += 1;
        }
        count == tape.count
    }

    #[test]
    fn written_records_are_read_and_a_repeated_decision_is_stored_once() {
        let tape = written();
        assert_eq!((tape.begun_ns, tape.first, tape.count), (5, 0, 3));
        assert!(hashes_fit(&tape));
        let records: Vec<_> = tape.records().map(Result::unwrap).collect();
        assert_eq!(records[0].decision(), Some(decision()));
        assert_eq!(records[0].packets.as_ref(), b"abc");
        assert_eq!((records[1].now_ns, records[1].decision()), (8, None));
        assert_eq!(records[2].event, TapeEvent::Packet { raw: Cow::Borrowed(b"packet") });
    }

    #[test]
    fn every_flipped_bit_and_every_cut_is_found() {
        let tape = written();
        for bit in 0..8 * tape.records.len() {
            let mut flipped = tape.clone();
            flipped.records[bit / 8] ^= 1 << (bit % 8);
            assert!(!hashes_fit(&flipped), "bit {bit}");
        }
        for length in 0..tape.records.len() {
            let mut cut = tape.clone();
            cut.records.truncate(length);
            assert!(!hashes_fit(&cut), "cut to {length} bytes");
        }
    }

    #[test]
    fn a_tape_that_is_not_taken_is_bounded_and_its_numbers_show_missing_records() {
        let mut writer = TapeWriter::new(0);
        let packet = TapeEvent::Packet { raw: Cow::Owned(vec![0; 1000]) };
        for now_ns in 0..2000 {
            writer.write(now_ns, &packet, &TapeOutput::default());
            assert!(writer.waiting_bytes() < MAX_WAITING_BYTES + 2000);
        }
        let tape = writer.take().unwrap();
        assert!(tape.first > 0);
        assert_eq!(tape.first + u64::from(tape.count), 2000);
        assert_eq!(writer.take(), None);
    }
}
