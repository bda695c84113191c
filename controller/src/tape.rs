//! The flight that writes its tape: each packet, detection, command and tick with its time, and the decisions and packets
//! out of it; a tape is replayed the same way.
//!
//! The tape is enough to fly the same flight again. [`TapedFlight::replay`] does so, with a tape of its own, which has
//! the same hashes as long as the flight decides the same.

use std::borrow::Cow;
use std::collections::VecDeque;
use std::sync::Arc;

use autopilot::Packet;
use landing::{Action, Decision};
use messages::{
    CameraInfo, CommandReply, ControllerCommand, ControllerStatus, Detections, DetectorInfo, Tape,
    TapeAction, TapeDecision, TapeEvent, TapeNote, TapeOutput, TapePad, TapeState, TapeTarget,
    TapeWriter,
};
use node::{HealthCounters, to_toml};

use crate::config::Config;
use crate::flight::Flight;
use crate::limits::Note;
use crate::pad_note::PadNote;

/// Maximum number of packets for the autopilot that wait to be taken; the oldest goes.
const MAX_OUTGOING: usize = 1024;

/// Period in which the state is written, in nanoseconds.
const STATE_PERIOD_NS: i64 = 10_000_000_000;

/// A flight with its tape.
pub struct TapedFlight {
    flight: Flight,
    writer: TapeWriter,
    outgoing: VecDeque<Vec<u8>>,
    /// The packets of one event, one after the other.
    packets: Vec<u8>,
    /// Number of the decision that the tape has, and the detector.
    decisions: u64,
    detector: Option<String>,
    /// When the state was written last, in nanoseconds.
    state_ns: i64,
}

/// The program with its version, as the tape names it.
pub fn program() -> String {
    format!("alight {}", node::version())
}

/// The platform of this program, as the tape names it.
pub fn build() -> String {
    let library = if cfg!(target_env = "musl") { "musl" } else { "gnu" };
    let profile = if cfg!(debug_assertions) { "debug" } else { "release" };
    format!("{}-{}-{library} {profile}", std::env::consts::ARCH, std::env::consts::OS)
}

impl TapedFlight {
    /// A flight that has not begun, with a tape that begins at `now_ns`.
    ///
    /// # Errors
    /// When the lander refuses its settings.
    pub fn new(
        now_ns: i64,
        mut config: Config,
        health: Arc<HealthCounters>,
    ) -> anyhow::Result<Self> {
        config.clock = config.clock().to_owned();
        let configuration = to_toml(&config);
        let mut flight = Self {
            flight: Flight::new(config, health)?,
            writer: TapeWriter::new(now_ns),
            outgoing: VecDeque::new(),
            packets: Vec::new(),
            decisions: 0,
            detector: None,
            state_ns: now_ns,
        };
        let event = TapeEvent::Begin {
            program: program().into(),
            build: build().into(),
            configuration: configuration.into(),
        };
        flight.write(now_ns, &event, None);
        Ok(flight)
    }

    /// The flight, to look at.
    pub fn flight(&self) -> &Flight {
        &self.flight
    }

    /// As [`Flight::take_over`].
    pub fn take_over(&mut self, now_ns: i64, note: Note) {
        let event = TapeEvent::TakeOver(TapeNote {
            address: note.address.clone(),
            system: note.system,
            parameter: note.parameter.clone(),
            original_s: note.original_s,
            set_s: note.set_s,
        });
        self.flight.take_over(note);
        self.write(now_ns, &event, None);
    }

    /// As [`Flight::take_over_pad`].
    pub fn take_over_pad(&mut self, now_ns: i64, note: PadNote) {
        let event = TapeEvent::TakeOverPad(TapePad {
            address: note.address.clone(),
            system: note.system,
            stamp_ns: note.stamp_ns,
            position_ned_m: note.position_ned_m,
            deviation_m: note.deviation_m,
        });
        self.flight.take_over_pad(note);
        self.write(now_ns, &event, None);
    }

    /// As [`Flight::packet`].
    pub fn packet(&mut self, now_ns: i64, packet: &Packet) {
        self.flight.packet(now_ns, packet);
        self.write(now_ns, &TapeEvent::Packet { raw: Cow::Borrowed(&packet.raw) }, None);
    }

    /// As [`Flight::ground_packet`].
    pub fn ground_packet(&mut self, now_ns: i64, packet: &Packet) {
        self.flight.ground_packet(now_ns, packet);
        self.write(now_ns, &TapeEvent::GroundPacket { raw: Cow::Borrowed(&packet.raw) }, None);
    }

    /// As [`Flight::tick`]; the state follows at its period.
    pub fn tick(&mut self, now_ns: i64) {
        self.tick_only(now_ns);
        if now_ns.saturating_sub(self.state_ns) >= STATE_PERIOD_NS {
            self.state_ns = now_ns;
            self.write_state(now_ns);
        }
    }

    fn tick_only(&mut self, now_ns: i64) {
        self.flight.tick(now_ns);
        self.write(now_ns, &TapeEvent::Tick, None);
    }

    fn write_state(&mut self, now_ns: i64) {
        let status = ControllerStatus { latency_ms: None, ..self.flight.status(now_ns) };
        let state = TapeState { status, target: self.flight.target(now_ns) };
        self.write(now_ns, &TapeEvent::State(Box::new(state)), None);
    }

    /// As [`Flight::detections`].
    pub fn detections(&mut self, now_ns: i64, publisher: &str, message: &Detections) -> bool {
        let is_used = self.flight.detections(now_ns, publisher, message);
        let publisher = Cow::Borrowed(publisher);
        let event = TapeEvent::Detections { publisher, message: Cow::Borrowed(message) };
        self.write(now_ns, &event, None);
        is_used
    }

    /// As [`Flight::camera`].
    pub fn camera(&mut self, now_ns: i64, info: CameraInfo) {
        self.flight.camera(now_ns, info.clone());
        self.write(now_ns, &TapeEvent::Camera(Cow::Owned(info)), None);
    }

    /// As [`Flight::refused_version`].
    pub fn refused_version(&mut self, now_ns: i64) {
        self.flight.refused_version(now_ns);
        self.write(now_ns, &TapeEvent::RefusedVersion, None);
    }

    /// As [`Flight::presence`].
    pub fn presence(&mut self, now_ns: i64, detector: &str, alive: bool) {
        self.flight.presence(now_ns, detector, alive);
        let event = TapeEvent::Presence { detector: Cow::Borrowed(detector), alive };
        self.write(now_ns, &event, None);
    }

    /// As [`Flight::on_detector_info`].
    pub fn on_detector_info(&mut self, now_ns: i64, publisher: &str, info: &DetectorInfo) {
        self.flight.on_detector_info(now_ns, publisher, info);
        let (publisher, info) = (Cow::Borrowed(publisher), Cow::Borrowed(info));
        self.write(now_ns, &TapeEvent::DetectorInfo { publisher, info }, None);
    }

    /// As [`Flight::command`].
    pub fn command(&mut self, now_ns: i64, command: &ControllerCommand) -> CommandReply {
        let reply = self.flight.command(now_ns, command);
        self.write(now_ns, &TapeEvent::Command(Cow::Borrowed(command)), Some(&reply));
        reply
    }

    /// As [`Flight::shutdown`].
    pub fn shutdown(&mut self, now_ns: i64) -> bool {
        let is_pending = self.flight.shutdown(now_ns);
        self.write(now_ns, &TapeEvent::Shutdown, None);
        is_pending
    }

    /// Handles an event of a tape as it was handled then, and writes the state where it was written then. False for events that a
    /// flight cannot handle: a second beginning, and bytes that are no packet.
    pub fn replay(&mut self, now_ns: i64, event: &TapeEvent<'_>) -> bool {
        match event {
            TapeEvent::Begin { .. } => return false,
            TapeEvent::TakeOver(note) => {
                let TapeNote { address, system, parameter, original_s, set_s } = note.clone();
                let note = Note { address, system, parameter, original_s, set_s };
                self.take_over(now_ns, note);
            }
            TapeEvent::TakeOverPad(pad) => {
                let TapePad { address, system, stamp_ns, position_ned_m, deviation_m } =
                    pad.clone();
                let note = PadNote { address, system, stamp_ns, position_ned_m, deviation_m };
                self.take_over_pad(now_ns, note);
            }
            TapeEvent::Packet { raw } => match Packet::from_raw(raw) {
                Some(packet) => self.packet(now_ns, &packet),
                None => return false,
            },
            TapeEvent::GroundPacket { raw } => match Packet::from_raw(raw) {
                Some(packet) => self.ground_packet(now_ns, &packet),
                None => return false,
            },
            TapeEvent::Tick => self.tick_only(now_ns),
            TapeEvent::Detections { publisher, message } => {
                self.detections(now_ns, publisher, message);
            }
            TapeEvent::Camera(info) => self.camera(now_ns, info.clone().into_owned()),
            TapeEvent::Presence { detector, alive } => self.presence(now_ns, detector, *alive),
            TapeEvent::DetectorInfo { publisher, info } => {
                self.on_detector_info(now_ns, publisher, info);
            }
            TapeEvent::Command(command) => drop(self.command(now_ns, command)),
            TapeEvent::RefusedVersion => self.refused_version(now_ns),
            TapeEvent::Shutdown => drop(self.shutdown(now_ns)),
            TapeEvent::State(_) => self.write_state(now_ns),
        }
        true
    }

    /// The next packet for the autopilot.
    pub fn poll_outgoing(&mut self) -> Option<Vec<u8>> {
        self.outgoing.pop_front()
    }

    /// Size of the parts that the tape still contains, in bytes.
    pub fn waiting_bytes(&self) -> usize {
        self.writer.waiting_bytes()
    }

    /// The tape since the last call; `None` when nothing has happened.
    pub fn take_tape(&mut self) -> Option<Tape> {
        self.writer.take()
    }

    fn write(&mut self, now_ns: i64, event: &TapeEvent<'_>, reply: Option<&CommandReply>) {
        self.packets.clear();
        while let Some(packet) = self.flight.poll_outgoing() {
            self.packets.extend_from_slice(&packet);
            if self.outgoing.len() >= MAX_OUTGOING {
                self.outgoing.pop_front();
            }
            self.outgoing.push_back(packet);
        }
        let detector = self.flight.active_detector();
        let is_other_detector = detector != self.detector.as_deref();
        let is_new = self.flight.decisions() != self.decisions || is_other_detector;
        let decision = self.flight.decision().filter(|_| is_new);
        let output = TapeOutput {
            decision: decision.map(|decision| on_tape(decision, detector)),
            packets: &self.packets,
            reply,
        };
        self.writer.write(now_ns, event, &output);
        self.decisions = self.flight.decisions();
        if is_other_detector {
            self.detector = detector.map(str::to_owned);
        }
    }
}

/// A decision as it stands on the tape.
fn on_tape<'a>(decision: &Decision, detector: Option<&'a str>) -> TapeDecision<'a> {
    TapeDecision {
        phase: decision.phase.name(),
        action: match decision.action {
            Action::None => TapeAction::None,
            Action::Velocity { velocity, yaw_rate } => TapeAction::Velocity {
                velocity_ned_m_s: velocity.coords.into(),
                yaw_rate_rad_s: yaw_rate,
            },
            Action::Guided => TapeAction::Guided,
            Action::Disarm => TapeAction::Disarm,
            Action::Land => TapeAction::Land,
        },
        why: decision.why.name(),
        target: decision.target.map(|target| TapeTarget {
            position_ned_m: target.position.coords.into(),
            velocity_ned_m_s: target.velocity.coords.into(),
            lateral_error_m: target.lateral_error_m,
            height_m: target.height_m,
            age_s: target.age_s,
            deviation_m: target.deviation_m,
            detections: target.detections,
            heading_rad: target.heading_rad,
            time_offset_s: target.time_offset_s,
            nis: target.nis,
            ambiguous: target.ambiguous,
        }),
        rejected: decision.rejected.map(landing::Rejection::name),
        detector,
    }
}
