//! Reads a recording for the report: statuses, targets, vehicle states, truth, detections, frames, light, health, settings, packets and
//! tapes of a flight, each with its time.

use std::collections::BTreeMap;
use std::ops::Range;

use flightlog::{Begin, Entry, Lost, Reading, Received, RecordedTape, TapeReader};
use messages::{
    CameraInfo, Configuration, ControllerStatus, Detections, DetectorInfo, FrameHeader, GcsStatus,
    Health, MavlinkBytes, Message, RecorderStatus, TapeEvent, TargetEstimate, Topic, Truth,
    VehicleState, Wind, decode, topic,
};

use replay::{Brightness, Meter};

use crate::origin::Origin;
use crate::packets::Packets;
use crate::settings::{self, Difference};

/// Longest gap over which a position is interpolated, in nanoseconds.
const MAX_GAP_NS: i64 = 500_000_000;

/// How much later after its stamp than the one before a message may be received, in nanoseconds; beyond this the vehicle's clock restarted.
const MAX_LATE_NS: i64 = 60_000_000_000;

/// The time after a landing's end that still belongs to it, in seconds.
const AFTER_END_S: f64 = 2.0;

/// Time between pictures that are measured, in nanoseconds.
const LIGHT_PERIOD_NS: u64 = 1_000_000_000;

/// Detections as they were received.
#[derive(Clone, Debug)]
pub struct Found {
    /// The detector on whose key they were received.
    pub detector: String,
    /// When the recorder received them, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// The message.
    pub message: Detections,
}

/// A frame of a camera.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Frame {
    /// Its number.
    pub sequence: u64,
    /// Mid-exposure, in nanoseconds of its clock.
    pub stamp_ns: i64,
}

/// How bright a picture is.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Light {
    /// Mid-exposure, in nanoseconds of the camera's clock.
    pub stamp_ns: i64,
    /// How long it was exposed, in milliseconds; `None` where that is not known.
    pub exposure_ms: Option<f64>,
    /// Its brightness.
    pub brightness: Brightness,
}

/// Messages that could not be read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Unreadable {
    /// How many.
    pub count: u64,
    /// Why the first could not: "is of another version ...".
    pub why: String,
}

/// The first and the last health of a process.
#[derive(Clone, Debug)]
pub struct Process {
    /// When the recorder received the first, in nanoseconds of the recorder's clock: a process may stamp by the clock of another machine.
    pub first_ns: i64,
    /// The first.
    pub first: Health,
    /// The last.
    pub last: Health,
}

/// The last status of a bridge to the ground stations.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Bridge {
    /// When the recorder received it, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// The status.
    pub status: GcsStatus,
}

/// A service's change of a setting.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Change {
    /// Service and instance.
    pub service: String,
    /// When the recorder received it, in nanoseconds of the recorder's clock.
    pub received_ns: i64,
    /// The key, and its value before and after.
    pub setting: Difference,
}

/// The result of a replay of its tape.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Replayed {
    /// Whether every event gives the same result again.
    pub is_verified: bool,
    /// The same as a sentence.
    pub text: String,
}

/// A start of the vehicle's computer, with which its clock restarts.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq)]
pub struct Boot {
    /// Its number, from 1 on.
    pub number: usize,
    /// How many the recording has.
    pub of: usize,
}

/// A landing of a recording that has several.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Landing {
    /// Its number, from 1 on.
    pub number: usize,
    /// How many the recording has.
    pub of: usize,
    /// The time that belongs to it, in nanoseconds of the vehicle's clock: until the next one.
    pub time_ns: Range<i64>,
    /// How often the controller had changed the detector before it.
    pub detector_changes_before: u64,
}

/// A flight as its recording has it: messages that were not recorded are empty. All of it is of one start of the vehicle's computer.
#[derive(Clone, Debug, Default)]
pub struct Flight {
    /// The name of its file.
    pub name: String,
    /// Facts about the recording: program, host, clock.
    pub facts: BTreeMap<String, String>,
    /// When it was recorded, and the size of its files.
    pub origin: Origin,
    /// Whether its files have their end, and had it before a repair.
    pub is_ended: bool,
    /// Whether a file is the repaired copy of a recording of which a part is lost.
    pub is_repaired: bool,
    /// Messages that were read.
    pub messages: u64,
    /// How far the clock of UTC was set ahead of a file's own times while it was open, each time, in seconds.
    pub time_set_s: Vec<f64>,
    /// The parts of its files that could not be read, as sentences.
    pub damage: Vec<String>,
    /// The chunks of its files that could not be read.
    pub lost_chunks: Lost,
    /// Messages that could not be read, by key.
    pub unreadable: BTreeMap<String, Unreadable>,
    /// Messages that the recorders lost since their start, by key.
    pub lost: BTreeMap<String, u64>,
    /// The controller's status.
    pub statuses: Vec<ControllerStatus>,
    /// The estimates of the landing point.
    pub targets: Vec<TargetEstimate>,
    /// The vehicle's state as the autopilot reports it.
    pub vehicle: Vec<VehicleState>,
    /// The truth, of a simulation.
    pub truth: Vec<Truth>,
    /// The wind, of a simulation.
    pub wind: Vec<Wind>,
    /// Detections of all detectors, as they were received.
    pub found: Vec<Found>,
    /// Frames by camera.
    pub frames: BTreeMap<String, Vec<Frame>>,
    /// How bright one picture of each second is, by camera.
    pub light: BTreeMap<String, Vec<Light>>,
    /// Processes by service, instance and process id.
    pub processes: BTreeMap<String, Process>,
    /// The last configurations as TOML, by service and instance.
    pub configurations: BTreeMap<String, String>,
    /// How services changed theirs, in order.
    pub changes: Vec<Change>,
    /// Detectors by name.
    pub detectors: BTreeMap<String, DetectorInfo>,
    /// The last status of each bridge to the ground stations, by its name.
    pub bridges: BTreeMap<String, Bridge>,
    /// When the recorder received the last message, in nanoseconds of its clock.
    pub last_received_ns: i64,
    /// Cameras by name.
    pub cameras: BTreeMap<String, CameraInfo>,
    /// The recorder's last status.
    pub recorder: Option<RecorderStatus>,
    /// The contents of the autopilot's packets.
    pub packets: Packets,
    /// The controllers' tapes.
    pub tapes: Vec<RecordedTape>,
    /// The result of a replay of the tapes; `None` when none was tried.
    pub replayed: Option<Replayed>,
    /// Whether status, estimates and the vehicle's state were computed again from the tapes.
    pub is_rebuilt: bool,
    /// The time by which the recorder's clock is ahead of the vehicle's, in nanoseconds.
    pub shift_ns: i64,
    /// When the landing began, or else the recording, in nanoseconds of the vehicle's clock.
    pub zero_ns: i64,
    /// Which of the landings in the recording this is; `None` where all of it is.
    pub landing: Option<Landing>,
    /// Which start of the vehicle's computer it is of.
    pub boot: Boot,
    /// The flights of other starts of the vehicle's computer in the recording.
    pub(crate) other_boots: Vec<Flight>,
    /// Minimum time from a stamp of the vehicle's clock to the reception of its message, in nanoseconds.
    min_apart_ns: Option<i64>,
    /// That time of the last message, in nanoseconds.
    last_apart_ns: i64,
}

/// Reads the recording of a flight, which may be several files.
#[derive(Default)]
pub struct FlightReader {
    flight: Flight,
    tapes: TapeReader,
    /// Number of starts of the vehicle's computer before the last part of a tape, by the tape's begin.
    boot_of_tape: BTreeMap<i64, usize>,
    meter: Meter,
    begin: Begin,
    /// Messages that a recorder lost since its start, by its run and their key; each run of the files that were added is in it.
    lost_by_run: BTreeMap<String, BTreeMap<String, u64>>,
}

impl FlightReader {
    /// An empty one for a flight of this name.
    pub fn new(name: &str) -> Self {
        let flight = Flight { name: name.to_owned(), is_ended: true, ..Flight::default() };
        Self { flight, ..Self::default() }
    }

    /// Adds a file of the recording, after those that were written before it ([`FlightReader::begin`]).
    ///
    /// # Errors
    /// When it is not an MCAP file.
    pub fn add(&mut self, recording: &[u8]) -> Result<(), flightlog::Error> {
        let Self { flight, tapes, boot_of_tape, meter, begin, lost_by_run } = self;
        let tape_key = topic::TAPE.key(&[]);
        let mut lost = BTreeMap::new();
        let mut run = String::new();
        let mut set_s = Vec::new();
        let mut file_offset_ns: Option<i64> = None;
        let Reading { is_ended, is_repaired, messages, damage, lost: lost_chunks } =
            flightlog::read(recording, |entry| match entry {
                Entry::About(facts) => {
                    run = facts.get("run").cloned().unwrap_or_default();
                    let offset_ns = facts.get("utc_offset_ns").and_then(|it| it.parse().ok());
                    flight.origin.utc_offset_ns = offset_ns.or(flight.origin.utc_offset_ns);
                    file_offset_ns = offset_ns;
                    flight.facts.extend(facts);
                }
                Entry::Dropped(counts) => lost = counts,
                Entry::Message(message) => {
                    begin.take(message);
                    flight.origin.take(message);
                    if message.key != tape_key {
                        flight.take(message);
                    } else if let Some(begun_ns) = tapes.take(message.payload) {
                        boot_of_tape.insert(begun_ns, flight.other_boots.len());
                    }
                }
                Entry::TimeSet(ahead_ns) => {
                    set_s.push(ahead_ns as f64 * 1e-9);
                    let set_ns = file_offset_ns.map(|it| it.saturating_add(ahead_ns));
                    flight.origin.utc_offset_ns = set_ns.or(flight.origin.utc_offset_ns);
                }
                Entry::Picture { header, bytes, .. } => flight.see(meter, &header, bytes),
            })?;
        flight.origin.bytes += recording.len() as u64;
        flight.time_set_s.extend(set_s);
        // Counted since the recorder's start: of its files the last has those before it.
        let so_far = lost_by_run.entry(run).or_default();
        for (key, count) in lost {
            let max = so_far.entry(key).or_default();
            *max = count.max(*max);
        }
        flight.is_ended &= is_ended;
        flight.is_repaired |= is_repaired;
        flight.messages += messages;
        flight.damage.extend(damage);
        flight.lost_chunks.extend(lost_chunks);
        Ok(())
    }

    /// True when no message of a flight was added.
    pub fn is_empty(&self) -> bool {
        self.flight.messages == 0 && self.tapes.is_empty()
    }

    /// True when a file lacks its end.
    pub fn is_cut(&self) -> bool {
        !self.flight.is_ended
    }

    /// The begin of the first file: it gives the order of files.
    pub fn begin(&self) -> Begin {
        self.begin
    }

    /// True when another is of the same recording: one run of a recorder wrote both, or a tape continues in it, as after a restart of the
    /// recorder; and its times are of the same clock. The ground's of the same flight is another.
    pub fn goes_on_in(&self, other: &Self) -> bool {
        let clock = |reader: &Self| reader.flight.facts.get("clock").cloned();
        let mut runs = self.lost_by_run.keys().filter(|run| !run.is_empty());
        let is_of_one_run = runs.any(|run| other.lost_by_run.contains_key(run));
        (is_of_one_run || self.tapes.shares_tape_with(&other.tapes)) && clock(self) == clock(other)
    }

    /// The flight; of several starts of the vehicle's computer that with the last landing, or the last.
    pub fn finish(self) -> Flight {
        let Self { mut flight, tapes, boot_of_tape, lost_by_run, .. } = self;
        for (key, count) in lost_by_run.into_values().flatten() {
            *flight.lost.entry(key).or_default() += count;
        }
        flight.damage.extend_from_slice(tapes.damage());
        let mut boots = std::mem::take(&mut flight.other_boots);
        boots.iter_mut().for_each(|boot| boot.take_over(&flight));
        boots.push(flight);
        for tape in tapes.tapes() {
            let index = boot_of_tape.get(&tape.begun_ns);
            if let Some(boot) = index.and_then(|index| boots.get_mut(*index)) {
                boot.tapes.push(tape);
            }
        }
        let of = boots.len();
        for (number, boot) in (1..).zip(&mut boots) {
            boot.boot = Boot { number, of };
            boot.settle();
        }
        let has_landing =
            |boot: &Flight| boot.statuses.iter().any(|status| status.started_ns.is_some());
        let chosen = boots.iter().rposition(has_landing).unwrap_or(of - 1);
        let mut flight = boots.remove(chosen);
        flight.other_boots = boots;
        flight
    }
}

/// The configuration at the begin of a tape.
fn configuration_of(tape: &RecordedTape) -> Option<String> {
    let first = tape.parts.first()?.records().next()?.ok()?;
    match first.event {
        TapeEvent::Begin { configuration, .. } => Some(configuration.into_owned()),
        _ => None,
    }
}

impl Flight {
    /// A mark that identifies its page: made of its recording's name, run and begin, and of its landing.
    pub fn mark(&self) -> String {
        let run = self.facts.get("run").map_or("", String::as_str);
        let landing = self.landing.as_ref().map_or(0, |it| it.number);
        let text = format!("{}\0{run}\0{}\0{landing}", self.name, self.zero_ns);
        // FNV-1a: the same in every version of the program.
        let hash = text.bytes().fold(0xcbf2_9ce4_8422_2325_u64, |hash, byte| {
            (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3)
        });
        format!("alight-flight-{hash:016x}")
    }

    /// A time of the recorder's clock by the vehicle's, in nanoseconds.
    pub fn vehicle_ns(&self, received_ns: i64) -> i64 {
        received_ns.saturating_sub(self.shift_ns)
    }

    /// Notes when the first landing began, or else the recording.
    pub(crate) fn set_zero(&mut self) {
        let started = self.statuses.iter().find_map(|status| status.started_ns);
        self.zero_ns = started.unwrap_or_else(|| self.first_ns());
    }

    /// The first time in any message, in nanoseconds of the vehicle's clock.
    fn first_ns(&self) -> i64 {
        let firsts = [
            self.statuses.first().map(|it| it.stamp_ns),
            self.vehicle.first().map(|it| it.stamp_ns),
            self.truth.first().map(|it| it.stamp_ns),
            self.found.first().map(|it| it.message.header.stamp_ns),
            self.tapes.first().map(|it| it.begun_ns),
        ];
        firsts.into_iter().flatten().min().unwrap_or(0)
    }

    /// The last status of the landing, or of all where none is of a landing: after a landing its controller may wait for the
    /// next flight, or be started again.
    pub fn last_status(&self) -> Option<&ControllerStatus> {
        let of_landing = self.statuses.iter().rev().find(|it| it.started_ns.is_some());
        of_landing.or(self.statuses.last())
    }

    /// When the landing ended, in seconds since [`Flight::zero_ns`], with the moment after it. Later nothing happens for as long as the
    /// recording continues.
    pub fn end_s(&self) -> Option<f64> {
        let mut of_landing = self.statuses.iter().filter(|it| it.stamp_ns >= self.zero_ns);
        let finished = of_landing.find(|status| status.finished)?;
        Some(self.at_s(finished.stamp_ns) + AFTER_END_S)
    }

    /// Whether a time of the vehicle's clock belongs to the landing that is kept.
    pub fn has(&self, stamp_ns: i64) -> bool {
        self.landing.as_ref().is_none_or(|landing| landing.time_ns.contains(&stamp_ns))
    }

    /// A stamp of the vehicle's clock in seconds since [`Flight::zero_ns`].
    pub fn at_s(&self, stamp_ns: i64) -> f64 {
        stamp_ns.saturating_sub(self.zero_ns) as f64 * 1e-9
    }

    /// Position of the vehicle as the autopilot reports it, in local NED, in metres.
    pub fn position_at(&self, stamp_ns: i64) -> Option<[f64; 3]> {
        interpolated(&self.vehicle, stamp_ns, |it| (it.stamp_ns, it.position_ned_m))
    }

    /// True position of the vehicle, from the pad's landing point, in metres north, east and down.
    pub fn true_offset_at(&self, stamp_ns: i64) -> Option<[f64; 3]> {
        interpolated(&self.truth, stamp_ns, |it| (it.stamp_ns, true_offset(it)))
    }

    /// The marker that the controller lands on, `FAMILY` or `FAMILY:ID`.
    pub fn marker(&self) -> Option<String> {
        let mut all = self.configurations.iter();
        let (_, text) = all.find(|(name, _)| name.starts_with("controller"))?;
        let table: toml::Table = text.parse().ok()?;
        Some(table.get("marker")?.as_str()?.to_owned())
    }

    /// Measures a picture, unless one was measured a moment before: to decode each would take minutes.
    fn see(&mut self, meter: &mut Meter, header: &FrameHeader, bytes: &[u8]) {
        let FrameHeader { ref camera, stamp_ns, exposure_ns, .. } = *header;
        let before = self.light.get(camera).and_then(|all| all.last());
        if before.is_some_and(|it| stamp_ns.abs_diff(it.stamp_ns) < LIGHT_PERIOD_NS) {
            return;
        }
        if let Some(brightness) = meter.measure(header, bytes) {
            let exposure_ms = (exposure_ns > 0).then(|| f64::from(exposure_ns) * 1e-6);
            let all = self.light.entry(camera.clone()).or_default();
            all.push(Light { stamp_ns, exposure_ms, brightness });
        }
    }

    fn take(&mut self, message: Received<'_>) {
        let Received { key, payload, attachment, received_ns } = message;
        let parts: Vec<&str> = key.split('/').collect();
        match parts.as_slice() {
            ["controller", "status"] => {
                if let Some(status) = self.decoded(topic::STATUS, key, payload) {
                    let last_ns = self.statuses.last().map(|it| it.stamp_ns);
                    self.note_stamp(received_ns, status.stamp_ns, last_ns);
                    self.statuses.push(status);
                }
            }
            ["controller", "target"] => {
                let target = self.decoded(topic::TARGET, key, payload);
                self.targets.extend(target);
            }
            ["vehicle", "state"] => {
                if let Some(state) = self.decoded(topic::VEHICLE_STATE, key, payload) {
                    let last_ns = self.vehicle.last().map(|it| it.stamp_ns);
                    self.note_stamp(received_ns, state.stamp_ns, last_ns);
                    self.vehicle.push(state);
                }
            }
            ["truth"] => {
                let truth = self.decoded(topic::TRUTH, key, payload);
                self.truth.extend(truth);
            }
            ["wind"] => {
                let wind = self.decoded(topic::WIND, key, payload);
                self.wind.extend(wind);
            }
            ["detector", detector, "detections"] => {
                let message = self.decoded(topic::DETECTIONS, key, payload);
                let detector = (*detector).to_owned();
                self.found.extend(message.map(|message| Found { detector, received_ns, message }));
            }
            ["detector", detector, "info"] => {
                let info = self.decoded(topic::DETECTOR_INFO, key, payload);
                self.detectors.extend(info.map(|info| ((*detector).to_owned(), info)));
            }
            ["camera", camera, "frame"] => {
                if let Some(header) = self.decoded_as::<FrameHeader>(key, attachment) {
                    let FrameHeader { sequence, stamp_ns, .. } = header;
                    let frames = self.frames.entry((*camera).to_owned()).or_default();
                    frames.push(Frame { sequence, stamp_ns });
                }
            }
            ["camera", camera, "info"] => {
                let info = self.decoded(topic::CAMERA_INFO, key, payload);
                self.cameras.extend(info.map(|info| ((*camera).to_owned(), info)));
            }
            ["health", ..] => {
                let health = self.decoded(topic::HEALTH, key, payload);
                health.into_iter().for_each(|health| self.add_health(health, received_ns));
            }
            ["config", ..] => {
                if let Some(configuration) = self.decoded(topic::CONFIGURATION, key, payload) {
                    self.packets.own.configure(&configuration);
                    let Configuration { service, instance, toml, .. } = configuration;
                    let service = format!("{service}/{instance}");
                    if let Some(before) = self.configurations.get(&service) {
                        let of_service =
                            |setting| Change { service: service.clone(), received_ns, setting };
                        let settings = settings::of_service(before, &toml);
                        self.changes.extend(settings.into_iter().map(of_service));
                    }
                    self.configurations.insert(service, toml);
                }
            }
            ["recorder", _, "status"] => {
                let status = self.decoded(topic::RECORDER_STATUS, key, payload);
                self.recorder = status.or(self.recorder.take());
            }
            ["gcs", "status"] => {
                let status = self.decoded(topic::GCS_STATUS, key, payload);
                let by_bridge =
                    |status: GcsStatus| (status.bridge.clone(), Bridge { received_ns, status });
                self.bridges.extend(status.map(by_bridge));
            }
            ["mavlink", "from-autopilot"] => {
                if let Some(MavlinkBytes { packet }) =
                    self.decoded(topic::FROM_AUTOPILOT, key, payload)
                {
                    self.packets.take(received_ns, &packet);
                }
            }
            _ => {}
        }
        // At last: a message may have begun another boot.
        self.last_received_ns = self.last_received_ns.max(received_ns);
    }

    fn decoded<M: Message>(&mut self, _topic: Topic<M>, key: &str, payload: &[u8]) -> Option<M> {
        self.decoded_as(key, payload)
    }

    fn decoded_as<M: Message>(&mut self, key: &str, payload: &[u8]) -> Option<M> {
        match decode(payload) {
            Ok(message) => Some(message),
            Err(error) => {
                let unreadable = self
                    .unreadable
                    .entry(key.to_owned())
                    .or_insert_with(|| Unreadable { count: 0, why: error.in_recording() });
                unreadable.count += 1;
                None
            }
        }
    }

    fn add_health(&mut self, health: Health, received_ns: i64) {
        let name = format!("{}/{} ({})", health.service, health.instance, health.pid);
        match self.processes.get_mut(&name) {
            Some(process) => process.last = health,
            None => {
                let (first_ns, first) = (received_ns, health.clone());
                self.processes.insert(name, Process { first_ns, first, last: health });
            }
        }
    }

    /// Notes how much later than its stamp a message was received, and whether the vehicle's clock restarted after the last of its kind.
    fn note_stamp(&mut self, received_ns: i64, stamp_ns: i64, last_ns: Option<i64>) {
        let apart_ns = received_ns.saturating_sub(stamp_ns);
        // A message that was only delayed has no earlier stamp.
        let is_later = apart_ns > self.last_apart_ns.saturating_add(MAX_LATE_NS);
        if last_ns.is_some_and(|last_ns| stamp_ns < last_ns) && is_later {
            self.begin_boot();
        }
        self.last_apart_ns = apart_ns;
        self.min_apart_ns = Some(self.min_apart_ns.map_or(apart_ns, |it| it.min(apart_ns)));
    }

    /// The next messages are of another start of the vehicle's computer. Facts about the recording and the last configurations are
    /// retained.
    fn begin_boot(&mut self) {
        let mut before = std::mem::take(self);
        self.take_over(&before);
        self.name.clone_from(&before.name);
        self.configurations.clone_from(&before.configurations);
        self.detectors.clone_from(&before.detectors);
        self.cameras.clone_from(&before.cameras);
        self.packets.own.clone_from(&before.packets.own);
        self.other_boots = std::mem::take(&mut before.other_boots);
        self.other_boots.push(before);
    }

    /// Whether all of its recording could be read, up to its end. Messages that the recorder lost do not count here.
    pub fn is_complete(&self) -> bool {
        self.is_ended && self.damage.is_empty() && self.unreadable.is_empty()
    }

    /// Takes over the facts of another one about the recording.
    fn take_over(&mut self, other: &Self) {
        (self.is_ended, self.messages) = (other.is_ended, other.messages);
        self.facts.clone_from(&other.facts);
        self.time_set_s.clone_from(&other.time_set_s);
        self.is_repaired = other.is_repaired;
        self.origin.clone_from(&other.origin);
        self.damage.clone_from(&other.damage);
        self.lost_chunks.clone_from(&other.lost_chunks);
        self.unreadable.clone_from(&other.unreadable);
        self.lost.clone_from(&other.lost);
        self.recorder.clone_from(&other.recorder);
    }

    /// Completes the flight after the last message.
    fn settle(&mut self) {
        self.set_shift();
        self.sort();
        self.set_zero();
        let configuration = self.tapes.iter().find_map(configuration_of);
        if let Some(toml) = configuration
            && !self.configurations.keys().any(|name| name.starts_with("controller"))
        {
            self.configurations.insert("controller (from its tape)".to_owned(), toml);
        }
    }

    /// Sets the time by which the recorder's clock is ahead of the vehicle's: zero on one machine, and else that of the quickest
    /// message.
    fn set_shift(&mut self) {
        let own = self.facts.get("clock");
        let controllers = self.processes.values().map(|it| &it.last);
        let controllers = controllers.filter(|it| it.service == "controller").map(|it| &it.clock);
        let frames = self.found.iter().map(|it| &it.message.header.clock);
        let vehicles = controllers.chain(frames).next();
        let is_other = own.zip(vehicles).is_some_and(|(own, vehicles)| own != vehicles);
        self.shift_ns = self.min_apart_ns.filter(|_| is_other).unwrap_or(0);
    }

    /// Puts everything in order: a second file begins with states of the first one.
    fn sort(&mut self) {
        fn order<T>(samples: &mut Vec<T>, stamp_ns: impl Fn(&T) -> i64) {
            samples.sort_by_key(&stamp_ns);
            samples.dedup_by_key(|it| stamp_ns(it));
        }
        order(&mut self.statuses, |it| it.stamp_ns);
        order(&mut self.targets, |it| it.stamp_ns);
        order(&mut self.vehicle, |it| it.stamp_ns);
        order(&mut self.truth, |it| it.stamp_ns);
        order(&mut self.wind, |it| it.stamp_ns);
        self.found.sort_by_key(|it| it.received_ns);
        self.packets.received.sort_by_key(|it| it.received_ns);
        self.packets.power.sort_by_key(|it| it.received_ns);
        self.packets.texts.sort_by_key(|it| it.received_ns);
        for frames in self.frames.values_mut() {
            order(frames, |it| it.stamp_ns);
        }
    }
}

/// True position of the vehicle from the pad's landing point, in metres north, east and down.
pub fn true_offset(truth: &Truth) -> [f64; 3] {
    let [north, east, down] = truth.position_ned_m;
    let [pad_north, pad_east, pad_down] = truth.pad_ned_m;
    [north - pad_north, east - pad_east, down - pad_down]
}

/// A value between two samples; `None` beyond them, and where they are too far apart.
fn interpolated<T>(
    samples: &[T],
    at_ns: i64,
    of: impl Fn(&T) -> (i64, [f64; 3]),
) -> Option<[f64; 3]> {
    let after = samples.partition_point(|sample| of(sample).0 < at_ns);
    let (next_ns, next) = of(samples.get(after)?);
    if next_ns == at_ns {
        return Some(next);
    }
    let (last_ns, last) = of(samples.get(after.checked_sub(1)?)?);
    let gap_ns = next_ns.saturating_sub(last_ns);
    if gap_ns > MAX_GAP_NS {
        return None;
    }
    let part = at_ns.saturating_sub(last_ns) as f64 / gap_ns as f64;
    let [x, y, z] = last;
    let [next_x, next_y, next_z] = next;
    Some([x + part * (next_x - x), y + part * (next_y - y), z + part * (next_z - z)])
}
