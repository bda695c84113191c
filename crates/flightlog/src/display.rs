//! Turns messages into Foxglove's types: pictures, markers found in them, coordinate frames, poses, a map and a log; and into files
//! within the recording.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_1_SQRT_2;

use autopilot::Parser;
use autopilot::dialect::MavMessage;
use messages::{
    BayerPattern, CameraInfo, Configuration, ControllerStatus, Detections, DetectorInfo,
    FrameHeader, Health, LensModel, MavlinkBytes, Phase, PixelFormat, TargetEstimate, Truth,
    VehicleState, decode, topic,
};

use crate::channel::{Received, Record, Schema, as_json, header_as_json, matches};
use crate::foxglove::{
    self, Calibration, FrameTransform, GeoPosition, Level, Outline, Pixels, Pose,
};
use crate::own_autopilot::OwnAutopilot;
use crate::protobuf::MessageType;

/// Name of the world's coordinate frame as viewers have it: x east, y north, z up.
const MAP: &str = "map";
/// Name of the autopilot's local frame: x north, y east, z down.
const WORLD: &str = "local_ned";
/// Name of the vehicle's coordinate frame.
const BODY: &str = "body";
/// The local frame in the map.
const MAP_FROM_NED: FrameTransform<'static> = FrameTransform {
    parent: MAP,
    child: WORLD,
    translation_m: [0.0; 3],
    rotation_wxyz: [0.0, FRAC_1_SQRT_2, FRAC_1_SQRT_2, 0.0],
};
/// Maximum time between a stamp and the reception of its message by one clock, in nanoseconds: stamps farther away are
/// another clock's, where the clocks' names are not known.
const MAX_AGE_NS: i64 = 60_000_000_000;
/// Maximum number of lines and files that are remembered in order not to repeat them; further ones are left out.
const MAX_REMEMBERED: usize = 4096;

/// The part of a frame that is recorded.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Picture {
    /// Its header.
    None,
    /// A JPEG file next to its header.
    Jpeg(Vec<u8>),
    /// Its pixels next to its header.
    Pixels,
}

/// A file within the recording.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct File {
    /// Its name.
    pub name: String,
    /// Its media type.
    pub media_type: &'static str,
    /// Its contents.
    pub data: Vec<u8>,
}

/// Turns messages into records for viewers; remembers the lines that were logged.
#[derive(Debug, Default)]
pub struct Display {
    /// Added to stamps, so that they count from 1970.
    utc_offset_ns: i64,
    vehicle_clock: VehicleClock,
    autopilot: OwnAutopilot,
    status: Option<(Phase, String)>,
    warnings: Vec<String>,
    logged: BTreeSet<String>,
    files: BTreeMap<String, Vec<u8>>,
}

/// The vehicle's clock, as a receiver of its messages estimates it.
#[derive(Clone, Debug, Default)]
pub struct VehicleClock {
    /// The name of ours, where it is known.
    own: Option<String>,
    /// The name of the controller's, by which messages are stamped that do not name their clock.
    controllers: Option<String>,
    offset: Option<Offset>,
}

/// The conversion of another clock's stamps to ours.
#[derive(Clone, Debug)]
struct Offset {
    /// The name of that clock, where it is known; it has another one after each start of its computer.
    clock: Option<String>,
    /// Added to stamps of it, in nanoseconds.
    ns: i64,
}

impl Offset {
    /// Whether it is of a clock of this name by which a message was received so long after its stamp.
    fn fits(&self, clock: Option<&str>, apart_ns: i64) -> bool {
        let is_same =
            self.clock.as_deref().zip(clock).is_none_or(|(known, stated)| known == stated);
        is_same && self.ns.abs_diff(apart_ns) <= MAX_AGE_NS.unsigned_abs()
    }
}

impl VehicleClock {
    /// For a receiver whose clock has this name.
    pub fn new(own: Option<&str>) -> Self {
        Self { own: own.map(str::to_owned), ..Self::default() }
    }

    /// Takes the name of the controller's clock from its health.
    pub fn take_health(&mut self, health: &Health) {
        if health.service == "controller" {
            self.controllers = Some(health.clock.clone());
        }
    }

    /// A stamp by our clock: one of another, by the age of its first message. Clocks are distinguished by their names; where one is not
    /// known, a stamp that is far away is of another.
    pub fn ours(&mut self, received_ns: i64, stamp_ns: i64, clock: Option<&str>) -> i64 {
        let apart_ns = received_ns.saturating_sub(stamp_ns);
        let clock = clock.or(self.controllers.as_deref());
        let is_ours = match (self.own.as_deref(), clock) {
            (Some(own), Some(clock)) => own == clock,
            _ => apart_ns.unsigned_abs() <= MAX_AGE_NS.unsigned_abs(),
        };
        if is_ours {
            return stamp_ns;
        }
        let known = self.offset.take().filter(|known| known.fits(clock, apart_ns));
        let new = || Offset { clock: clock.map(str::to_owned), ns: apart_ns };
        stamp_ns.saturating_add(self.offset.insert(known.unwrap_or_else(new)).ns)
    }
}

impl Display {
    /// Nothing was shown yet; `utc_offset_ns` is the time since 1970 less that of the clock of all stamps, which has this name.
    pub fn new(utc_offset_ns: i64, clock: Option<&str>) -> Self {
        Self { utc_offset_ns, vehicle_clock: VehicleClock::new(clock), ..Self::default() }
    }

    /// A message for programs other than Alight: as JSON, and as it is shown.
    pub(crate) fn message(&mut self, message: Received<'_>) -> Vec<Record> {
        as_json(message).into_iter().chain(self.records(message)).collect()
    }

    /// A frame for such programs: its header as JSON, and the picture.
    pub(crate) fn frame(
        &mut self,
        message: Received<'_>,
        header: &FrameHeader,
        picture: &Picture,
    ) -> Vec<Record> {
        let clock = Some(header.clock.as_str());
        let stamp_ns = self.vehicle_clock.ours(message.received_ns, header.stamp_ns, clock);
        let camera = topic::FRAME.first_name(message.key).unwrap_or(&header.camera);
        let shown = self.picture(camera, stamp_ns, header, message.payload, picture);
        [header_as_json(message, stamp_ns, header)].into_iter().chain(shown).collect()
    }

    /// The records that viewers show of a message.
    fn records(&mut self, message: Received<'_>) -> Vec<Record> {
        let Received { key, payload, received_ns, .. } = message;
        let is = |pattern: String| matches(&pattern, key);
        let records = if let Some(detector) = topic::DETECTIONS.first_name(key) {
            decode(payload).ok().map(|found: Detections| {
                let FrameHeader { stamp_ns, clock, .. } = &found.header;
                let at_ns = self.vehicle_clock.ours(received_ns, *stamp_ns, Some(clock));
                self.detections(detector, at_ns, &found)
            })
        } else if is(topic::VEHICLE_STATE.key(&[])) {
            decode(payload).ok().map(|state: VehicleState| {
                let at_ns = self.our_clock(received_ns, state.stamp_ns);
                self.vehicle(at_ns, &state)
            })
        } else if is(topic::TARGET.key(&[])) {
            decode(payload).ok().map(|target: TargetEstimate| {
                let at_ns = self.our_clock(received_ns, target.stamp_ns);
                self.target(at_ns, &target)
            })
        } else if is(topic::STATUS.key(&[])) {
            decode(payload).ok().map(|status: ControllerStatus| {
                let at_ns = self.our_clock(received_ns, status.stamp_ns);
                self.log(at_ns, &status)
            })
        } else if is(topic::TRUTH.key(&[])) {
            decode(payload).ok().map(|truth: Truth| {
                let at_ns = self.our_clock(received_ns, truth.stamp_ns);
                self.truth(at_ns, &truth)
            })
        } else if let Some(camera) = topic::CAMERA_INFO.first_name(key) {
            decode(payload).ok().map(|info| self.camera(camera, received_ns, &info))
        } else if is(topic::DETECTOR_INFO.key(&[])) {
            decode(payload).ok().map(|info| self.detector(received_ns, &info))
        } else if is(topic::HEALTH.key(&[])) {
            decode(payload).ok().map(|health| {
                self.vehicle_clock.take_health(&health);
                self.health(received_ns, &health)
            })
        } else if is(topic::FROM_AUTOPILOT.key(&[])) {
            decode(payload).ok().map(|bytes| self.packet(received_ns, &bytes))
        } else if is(topic::CONFIGURATION.key(&[])) {
            decode(payload).ok().iter().for_each(|it| self.autopilot.configure(it));
            None
        } else {
            None
        };
        records.unwrap_or_default()
    }

    /// The part of a message that is recorded as a file, when it is new.
    pub(crate) fn file(&mut self, message: Received<'_>) -> Option<File> {
        let file = if matches(&topic::CONFIGURATION.key(&[]), message.key) {
            let Configuration { toml, .. } = decode(message.payload).ok()?;
            let service = topic::CONFIGURATION.first_name(message.key)?;
            let (_, instance) = message.key.rsplit_once('/')?;
            let name = format!("configuration/{service}-{instance}.toml");
            File { name, media_type: "application/toml", data: toml.into_bytes() }
        } else if let Some(camera) = topic::CAMERA_INFO.first_name(message.key) {
            let info: CameraInfo = decode(message.payload).ok()?;
            let name = format!("calibration/{camera}.json");
            let data = serde_json::to_vec_pretty(&info).ok()?;
            File { name, media_type: "application/json", data }
        } else {
            return None;
        };
        let is_full = self.files.len() >= MAX_REMEMBERED && !self.files.contains_key(&file.name);
        let is_known = self.files.get(&file.name) == Some(&file.data);
        if is_full || is_known {
            return None;
        }
        self.files.insert(file.name.clone(), file.data.clone());
        Some(file)
    }

    /// A stamp of the controller's clock, or of the simulator's, by ours.
    fn our_clock(&mut self, received_ns: i64, stamp_ns: i64) -> i64 {
        self.vehicle_clock.ours(received_ns, stamp_ns, None)
    }

    /// A frame of a camera as a picture, taken at `stamp_ns` by our clock.
    fn picture(
        &self,
        camera: &str,
        stamp_ns: i64,
        header: &FrameHeader,
        pixels: &[u8],
        picture: &Picture,
    ) -> Option<Record> {
        let (at_ns, frame_id) = (self.utc(stamp_ns), frame_name(camera));
        let (schema, data) = match picture {
            Picture::None => return None,
            Picture::Jpeg(file) => {
                (&foxglove::COMPRESSED_IMAGE, foxglove::compressed_image(at_ns, &frame_id, file))
            }
            Picture::Pixels if header.format == PixelFormat::Jpeg => {
                (&foxglove::COMPRESSED_IMAGE, foxglove::compressed_image(at_ns, &frame_id, pixels))
            }
            Picture::Pixels => {
                let row_bytes = pixels.len() / header.height.max(1) as usize;
                let image = Pixels {
                    width: header.width,
                    height: header.height,
                    encoding: encoding(header.format),
                    row_bytes: u32::try_from(row_bytes).ok()?,
                    bytes: pixels,
                };
                (&foxglove::RAW_IMAGE, foxglove::raw_image(at_ns, &frame_id, &image))
            }
        };
        Some(shown(picture_channel(camera), schema, stamp_ns, data))
    }

    fn utc(&self, stamp_ns: i64) -> i64 {
        stamp_ns.saturating_add(self.utc_offset_ns)
    }

    /// A detector's detections, with the stamp of the frame.
    fn detections(&self, name: &str, stamp_ns: i64, found: &Detections) -> Vec<Record> {
        let outlines: Vec<Outline> = found
            .detections
            .iter()
            .map(|it| Outline {
                centre_px: it.centre_px,
                corners_px: it.corners_px,
                size_px: it.size_px,
                text: it.id.map_or_else(|| it.family.clone(), |id| format!("{}:{id}", it.family)),
            })
            .collect();
        let poses: Vec<Pose> = found
            .detections
            .iter()
            .filter_map(|it| it.pose)
            .map(|it| Pose {
                position_m: it.camera_from_marker.translation_m,
                orientation_wxyz: it.camera_from_marker.rotation_wxyz,
            })
            .collect();
        let at_ns = self.utc(stamp_ns);
        let overlay = foxglove::image_annotations(at_ns, &outlines);
        let poses = foxglove::poses_in_frame(at_ns, &frame_name(&found.header.camera), &poses);
        vec![
            shown(
                format!("detector/{name}/overlay"),
                &foxglove::IMAGE_ANNOTATIONS,
                stamp_ns,
                overlay,
            ),
            shown(format!("detector/{name}/poses"), &foxglove::POSES_IN_FRAME, stamp_ns, poses),
        ]
    }

    fn vehicle(&self, stamp_ns: i64, state: &VehicleState) -> Vec<Record> {
        let body = FrameTransform {
            parent: WORLD,
            child: BODY,
            translation_m: state.position_ned_m,
            rotation_wxyz: state.ned_from_body_wxyz,
        };
        vec![self.transforms(stamp_ns, &[MAP_FROM_NED, body])]
    }

    fn target(&self, stamp_ns: i64, target: &TargetEstimate) -> Vec<Record> {
        let Some(position_m) = target.position_ned_m else { return Vec::new() };
        let (sin, cos) = (0.5 * target.heading_rad.unwrap_or(0.0)).sin_cos();
        let pose = Pose { position_m, orientation_wxyz: [cos, 0.0, 0.0, sin] };
        let data = foxglove::poses_in_frame(self.utc(stamp_ns), WORLD, &[pose]);
        let channel = "controller/target/pose".to_owned();
        vec![shown(channel, &foxglove::POSE_IN_FRAME, stamp_ns, data)]
    }

    fn truth(&mut self, stamp_ns: i64, truth: &Truth) -> Vec<Record> {
        let body = FrameTransform {
            parent: WORLD,
            child: "true_body",
            translation_m: truth.position_ned_m,
            rotation_wxyz: truth.ned_from_body_wxyz,
        };
        let pad = FrameTransform {
            parent: WORLD,
            child: "true_pad",
            translation_m: truth.pad_ned_m,
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        };
        let mut records = vec![self.transforms(stamp_ns, &[body, pad])];
        if let Some(touchdown) = truth.touchdown {
            let text = format!(
                "touchdown {:.3} m from the pad's centre, {:.2} m/s down, {:.2} m/s sideways",
                touchdown.error_m, touchdown.vertical_speed_m_s, touchdown.lateral_speed_m_s
            );
            records.extend(self.once(stamp_ns, Level::Info, "world", &text));
        }
        records
    }

    fn camera(&self, camera: &str, stamp_ns: i64, info: &CameraInfo) -> Vec<Record> {
        let frame_id = frame_name(camera);
        let mount = FrameTransform {
            parent: BODY,
            child: &frame_id,
            translation_m: info.body_from_camera.translation_m,
            rotation_wxyz: info.body_from_camera.rotation_wxyz,
        };
        let mut records = vec![self.transforms(stamp_ns, &[mount])];
        if let Some(focal_px) = info.focal_px {
            let (model, distortion) = match &info.lens {
                LensModel::Pinhole => ("", &[][..]),
                LensModel::BrownConrady(numbers) => ("rational_polynomial", &numbers[..]),
                LensModel::KannalaBrandt(numbers) => ("kannala_brandt", &numbers[..]),
            };
            let calibration = Calibration {
                frame_id: &frame_id,
                width: info.width,
                height: info.height,
                model,
                distortion,
                focal_px,
                centre_px: info.principal_px,
            };
            let channel = format!("camera/{camera}/calibration");
            let data = foxglove::camera_calibration(self.utc(stamp_ns), &calibration);
            records.push(shown(channel, &foxglove::CAMERA_CALIBRATION, stamp_ns, data));
        }
        records
    }

    /// Lines for changes of the phase, its reason and the warnings.
    fn log(&mut self, stamp_ns: i64, status: &ControllerStatus) -> Vec<Record> {
        let mut lines = Vec::new();
        let now = (status.phase, status.why.clone());
        if self.status.as_ref() != Some(&now) {
            lines.push((Level::Info, format!("{}: {}", status.phase.name(), status.why)));
            self.status = Some(now);
        }
        let new = status.warnings.iter().filter(|warning| !self.warnings.contains(warning));
        lines.extend(new.map(|warning| (Level::Warning, warning.clone())));
        self.warnings.clone_from(&status.warnings);
        lines.iter().map(|(level, text)| self.line(stamp_ns, *level, "controller", text)).collect()
    }

    fn detector(&mut self, stamp_ns: i64, info: &DetectorInfo) -> Vec<Record> {
        let DetectorInfo { detector, host, markers, version, pid, .. } = info;
        let markers = markers.join(", ");
        let text = format!(
            "detector {detector} is process {pid} on {host}, looks for {markers} ({version})"
        );
        self.once(stamp_ns, Level::Info, "detector", &text).into_iter().collect()
    }

    /// A line for each process, and one for each kind of failure.
    fn health(&mut self, stamp_ns: i64, health: &Health) -> Vec<Record> {
        let Health { service, instance, host, version, pid, .. } = health;
        let process = format!("{service} {instance} is process {pid} on {host}, alight {version}");
        let mut records: Vec<Record> =
            self.once(stamp_ns, Level::Info, service, &process).into_iter().collect();
        for error in &health.errors {
            let text = format!("{service} {instance}, process {pid}: {}", error.reason);
            records.extend(self.once(stamp_ns, Level::Warning, service, &text));
        }
        records
    }

    /// The position that the vehicle's autopilot reports.
    fn packet(&mut self, stamp_ns: i64, bytes: &MavlinkBytes) -> Vec<Record> {
        let mut packets = Parser::new().push(&bytes.packet);
        packets.retain(|packet| self.autopilot.has_sent(packet));
        let positions = packets.iter().filter_map(|packet| match packet.message.as_ref()? {
            // It reports zero before it has a position.
            MavMessage::GLOBAL_POSITION_INT(at) if at.lat != 0 || at.lon != 0 => {
                Some(GeoPosition {
                    latitude_deg: f64::from(at.lat) * 1e-7,
                    longitude_deg: f64::from(at.lon) * 1e-7,
                    altitude_m: f64::from(at.alt) * 1e-3,
                })
            }
            _ => None,
        });
        positions
            .map(|position| {
                let data = foxglove::location_fix(self.utc(stamp_ns), BODY, position);
                shown("vehicle/location".to_owned(), &foxglove::LOCATION_FIX, stamp_ns, data)
            })
            .collect()
    }

    fn transforms(&self, stamp_ns: i64, transforms: &[FrameTransform<'_>]) -> Record {
        let data = foxglove::frame_transforms(self.utc(stamp_ns), transforms);
        shown("tf".to_owned(), &foxglove::FRAME_TRANSFORMS, stamp_ns, data)
    }

    /// A line that is not repeated.
    fn once(&mut self, stamp_ns: i64, level: Level, name: &str, text: &str) -> Option<Record> {
        if self.logged.len() >= MAX_REMEMBERED || !self.logged.insert(text.to_owned()) {
            return None;
        }
        Some(self.line(stamp_ns, level, name, text))
    }

    fn line(&self, stamp_ns: i64, level: Level, name: &str, text: &str) -> Record {
        let data = foxglove::log(self.utc(stamp_ns), level, name, text);
        shown("log".to_owned(), &foxglove::LOG, stamp_ns, data)
    }
}

fn shown(channel: String, schema: &'static MessageType, stamp_ns: i64, data: Vec<u8>) -> Record {
    Record { channel, schema: Schema::Protobuf(schema), stamp_ns, data }
}

/// The channel with a camera's pictures.
pub(crate) fn picture_channel(camera: &str) -> String {
    format!("camera/{camera}/picture")
}

/// Name of a camera's coordinate frame.
fn frame_name(camera: &str) -> String {
    format!("camera_{camera}")
}

/// Foxglove's name for the layout of a frame's pixels.
fn encoding(format: PixelFormat) -> &'static str {
    match format {
        PixelFormat::Mono8 => "mono8",
        PixelFormat::Bayer8(BayerPattern::Rggb) => "bayer_rggb8",
        PixelFormat::Bayer8(BayerPattern::Grbg) => "bayer_grbg8",
        PixelFormat::Bayer8(BayerPattern::Gbrg) => "bayer_gbrg8",
        PixelFormat::Bayer8(BayerPattern::Bggr) => "bayer_bggr8",
        PixelFormat::Jpeg => "jpeg",
        // It has no name for Bayer patterns of more than 8 bits: shown as they are, grey.
        PixelFormat::Mono10
        | PixelFormat::Mono12
        | PixelFormat::Mono16
        | PixelFormat::Bayer10(_)
        | PixelFormat::Bayer12(_)
        | PixelFormat::Bayer16(_) => "mono16",
    }
}

#[cfg(test)]
mod tests {
    use autopilot::dialect::{GLOBAL_POSITION_INT_DATA, HEARTBEAT_DATA};
    use autopilot::{Sender, packet};
    use messages::{Message, encode};

    use super::*;

    fn records(display: &mut Display, key: &str, message: &impl Message) -> Vec<Record> {
        let payload = encode(message);
        display.records(Received { key, payload: &payload, attachment: b"", received_ns: 9 })
    }

    fn has(record: &Record, bytes: &[u8]) -> bool {
        record.data.windows(bytes.len()).any(|window| window == bytes)
    }

    #[test]
    fn picture_and_overlay_have_the_same_stamp() {
        let mut display = Display::new(1_700_000_000_000_000_000, None);
        let header = FrameHeader { stamp_ns: 123_456_789, ..FrameHeader::sample() };
        let jpeg = Picture::Jpeg(vec![1]);
        let picture = display.picture("down", 123_456_789, &header, b"", &jpeg).unwrap();
        let found = Detections { header, ..Detections::sample() };
        let overlay = &records(&mut display, "detector/main/detections", &found)[0];
        assert_eq!(overlay.stamp_ns, picture.stamp_ns);
        // 1 700 000 000 s and 123 456 789 ns.
        let stamp = [0x08, 0x80, 0xe2, 0xcf, 0xaa, 0x06, 0x10, 0x95, 0x9a, 0xef, 0x3a];
        assert!(has(overlay, &stamp) && has(&picture, &stamp));
    }

    #[test]
    fn stamps_of_another_clock_are_as_old_as_its_first_message() {
        const S: i64 = 1_000_000_000;
        let mut display = Display::default();
        assert_eq!(display.our_clock(90 * S, 50 * S), 50 * S, "its own");
        // The vehicle has run for 5 minutes, this machine for ten days.
        let days = 864_000 * S;
        assert_eq!(display.our_clock(days, 300 * S), days);
        assert_eq!(display.our_clock(days + 3 * S, 302 * S), days + 2 * S);
        assert_eq!(display.our_clock(days + 9 * S, days + 8 * S), days + 8 * S, "its own");
        // It was started again.
        assert_eq!(display.our_clock(days + 100 * S, 20 * S), days + 100 * S);
        assert_eq!(display.our_clock(i64::MAX, i64::MIN), -1, "saturates");
    }

    #[test]
    fn clocks_are_distinguished_by_their_names() {
        const S: i64 = 1_000_000_000;
        let health = |service: &str, clock: &str| Health {
            service: service.into(),
            clock: clock.into(),
            ..Health::sample()
        };
        let mut clock = VehicleClock::new(Some("ground"));
        // The vehicle was started 20 s after the ground.
        assert_eq!(clock.ours(50 * S, 30 * S, None), 30 * S, "its name is not known");
        clock.take_health(&health("recorder", "ground"));
        assert_eq!(clock.ours(50 * S, 30 * S, None), 30 * S, "its name is not known");
        clock.take_health(&health("controller", "drone"));
        assert_eq!(clock.ours(50 * S, 30 * S, None), 50 * S);
        assert_eq!(clock.ours(53 * S, 32 * S, Some("drone")), 52 * S);
        assert_eq!(clock.ours(200 * S, 100 * S, Some("ground")), 100 * S, "ours, and late");
        assert_eq!(clock.ours(60 * S, 10 * S, Some("drone, started again")), 60 * S);
    }

    #[test]
    fn a_position_on_the_map_comes_from_the_own_autopilots_position() {
        let mut display = Display::default();
        let mut shown = |system, component, message: &MavMessage| {
            let packet = packet::encode(Sender { system, component }, 0, message);
            records(&mut display, "mavlink/from-autopilot", &MavlinkBytes { packet })
        };
        let at = |lat| {
            MavMessage::GLOBAL_POSITION_INT(GLOBAL_POSITION_INT_DATA {
                lat,
                lon: 85_455_938,
                alt: 488_000,
                ..GLOBAL_POSITION_INT_DATA::default()
            })
        };
        assert_eq!(shown(1, 1, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default())).len(), 0);
        let own = shown(1, 1, &at(473_977_418));
        assert_eq!(own[0].channel, "vehicle/location");
        assert!(has(&own[0], &(473_977_418.0 * 1e-7_f64).to_le_bytes()));
        for (system, component) in [(2, 1), (1, 154)] {
            assert_eq!(shown(system, component, &at(1)).len(), 0, "{system} {component}");
        }
    }

    #[test]
    fn lines_and_files_are_not_repeated() {
        let mut display = Display::default();
        let status = ControllerStatus { why: "no marker".into(), ..ControllerStatus::default() };
        assert_eq!(records(&mut display, "controller/status", &status).len(), 1);
        assert_eq!(records(&mut display, "controller/status", &status).len(), 0);
        let payload = encode(&CameraInfo::sample());
        let info = Received {
            key: "camera/down/info",
            payload: &payload,
            attachment: b"",
            received_ns: 9,
        };
        assert_eq!(display.file(info).unwrap().name, "calibration/down.json");
        assert_eq!(display.file(info), None);
    }
}
