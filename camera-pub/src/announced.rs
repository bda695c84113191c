//! Finds cameras on MAVLink by their heartbeats, requests CAMERA_INFORMATION and VIDEO_STREAM_INFORMATION, and lists the
//! addresses of their video.
//!
//! Messages and commands are those of <https://mavlink.io/en/services/camera.html>; each is requested in the new and in
//! the old form.

use std::collections::BTreeMap;
use std::net::SocketAddr;
use std::time::Duration;

use anyhow::Context;
use autopilot::dialect::{
    CAMERA_INFORMATION_DATA, COMMAND_LONG_DATA, MavCmd, MavMessage, MavType, MessageData,
    VIDEO_STREAM_INFORMATION_DATA, VideoStreamEncoding, VideoStreamType,
};
use autopilot::packet::encode;
use autopilot::{Address, Link, LinkEvent, Packet, Parser, Sender, compose};
use node::without_credentials;
use serde::Serialize;
use tokio::net::UdpSocket;
use tokio::time::{Instant, interval, sleep_until};

use crate::config::RATES_HZ;
use crate::v4l2::abi::text;

/// Period of the questions, until they are answered.
const ASK_PERIOD: Duration = Duration::from_millis(700);
/// Maximum number of components that are queried, of streams of each, and of hosts whose packets are read.
const MAX_COMPONENTS: usize = 32;
const MAX_STREAMS: usize = 16;
const MAX_HOSTS: usize = 16;
/// Longest UDP packet that is read, in bytes.
const MAX_DATAGRAM: usize = 4096;
/// The component id under which questions are sent (MAV_COMP_ID_ONBOARD_COMPUTER4): 191 is the controller's, whose packets a
/// bridge takes for its own vehicle's.
const ASKING_AS: u8 = 194;

/// A camera that was announced.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AnnouncedCamera {
    /// MAVLink's id of its system.
    pub system: u8,
    /// MAVLink's id of the component that answers for it.
    pub component: u8,
    /// Which of the component's cameras it is, from 1 to 6 for cameras of an autopilot; 0 where the component is the camera.
    pub device: u8,
    /// Its maker and model; empty where it does not report them.
    pub name: String,
    /// Its video streams.
    pub streams: Vec<AnnouncedStream>,
}

/// A video stream of a camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AnnouncedStream {
    /// Its number.
    pub id: u8,
    /// Its name.
    pub name: String,
    /// How it is sent: `RTSP`, `RTP over UDP`, `MPEG over TCP`, `MPEG-TS` or `WebRTC`.
    pub transport: &'static str,
    /// `H.264`, `H.265`, or empty where the camera does not report it.
    pub encoding: &'static str,
    /// Its address without name and password, or the port at which the ground station receives it.
    pub address: String,
    /// Width and height in pixels; `None` where the camera does not report them.
    pub size_px: Option<[u16; 2]>,
    /// Pictures per second; `None` where the camera does not report it.
    pub rate_hz: Option<f32>,
    /// The `[source]` table; `None` for streams that `camera-pub` does not read on its own.
    pub source: Option<String>,
}

/// The cameras found at an address.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Announced {
    /// The cameras.
    pub cameras: Vec<AnnouncedCamera>,
    /// The reason why there may be more, or none at all.
    pub problem: Option<String>,
}

/// Queries an address (that of an autopilot's link, or a UDP port at which cameras announce themselves) for `ask_for`.
///
/// # Errors
/// When the address is invalid, or its port cannot be opened.
pub async fn announced_cameras(address: &str, ask_for: Duration) -> anyhow::Result<Announced> {
    let address: Address = address.parse()?;
    let mut port = Port::open(&address).await?;
    let end = Instant::now() + ask_for;
    let mut due = interval(ASK_PERIOD);
    let mut inquiry = Inquiry::default();
    let (mut sequence, mut attempt, mut problem) = (0_u8, 0_u8, None);
    loop {
        tokio::select! {
            () = sleep_until(end) => break,
            received = port.recv() => match received {
                Received::Packets(packets, from) => {
                    packets.iter().for_each(|packet| inquiry.take(packet, from));
                }
                Received::Error(reason) => problem = Some(reason),
            },
            _ = due.tick() => {
                for Question { to, system, message } in inquiry.questions(attempt) {
                    let sender = Sender { system, component: ASKING_AS };
                    port.send(to, &encode(sender, sequence, &message));
                    sequence = sequence.wrapping_add(1);
                }
                attempt = attempt.saturating_add(1);
            }
        }
    }
    let cameras = inquiry.cameras();
    let is_deaf = inquiry.components.is_empty();
    let problem = match problem.filter(|_| is_deaf) {
        Some(reason) => Some(reason),
        None if is_deaf => Some(format!("no MAVLink came to {address} within {ask_for:?}")),
        None if port.lacks_key() => Some(format!(
            "the sender at {address} signs its packets, and may answer no program without its key"
        )),
        None => None,
    };
    Ok(Announced { cameras, problem })
}

/// The source of MAVLink packets.
enum Port {
    /// A port at which any host may announce itself, with a parser for each.
    Open { socket: UdpSocket, hosts: BTreeMap<SocketAddr, Parser> },
    /// The link to one other side.
    Link(Link),
}

/// What a port received.
enum Received {
    Packets(Vec<Packet>, Option<SocketAddr>),
    /// The reason why no packet can be received.
    Error(String),
}

impl Port {
    async fn open(address: &Address) -> anyhow::Result<Self> {
        let doing = || format!("asking for cameras at {address}");
        if let Address::UdpIn(endpoint) = address {
            let place = (endpoint.host.as_str(), endpoint.port);
            let socket = UdpSocket::bind(place).await.with_context(|| {
                format!("{}; another program may have the port: stop it, or have the cameras send to another one", doing())
            })?;
            return Ok(Self::Open { socket, hosts: BTreeMap::new() });
        }
        Ok(Self::Link(Link::open(address.clone()).await.with_context(doing)?))
    }

    /// May be cancelled without losing anything.
    async fn recv(&mut self) -> Received {
        match self {
            Self::Open { socket, hosts } => {
                let mut buffer = [0; MAX_DATAGRAM];
                loop {
                    // A host that has gone refuses packets that were sent to it.
                    let Ok((length, from)) = socket.recv_from(&mut buffer).await else { continue };
                    if hosts.contains_key(&from) || hosts.len() < MAX_HOSTS {
                        let packets = hosts.entry(from).or_default().push(&buffer[..length]);
                        return Received::Packets(packets, Some(from));
                    }
                }
            }
            Self::Link(link) => loop {
                match link.recv().await {
                    LinkEvent::Packet { packet, .. } => {
                        return Received::Packets(vec![*packet], None);
                    }
                    LinkEvent::Disconnected { reason } => return Received::Error(reason),
                    LinkEvent::Connected { .. } | LinkEvent::OtherAutopilot { .. } => {}
                }
            },
        }
    }

    /// Errors are ignored: each question is sent again until it is answered.
    fn send(&self, to: Option<SocketAddr>, packet: &[u8]) {
        match self {
            Self::Open { socket, .. } => {
                if let Some(to) = to {
                    socket.try_send_to(packet, to).ok();
                }
            }
            Self::Link(link) => {
                link.send(packet).ok();
            }
        }
    }

    fn lacks_key(&self) -> bool {
        matches!(self, Self::Link(link) if link.lacks_key())
    }
}

/// The components that were seen, and what is known of each.
#[derive(Debug, Default)]
struct Inquiry {
    components: BTreeMap<(u8, u8), Component>,
}

#[derive(Debug, Default)]
struct Component {
    /// Where its packets came from, where that can differ.
    from: Option<SocketAddr>,
    is_camera: bool,
    /// By the number of the camera, of which an autopilot has several.
    names: BTreeMap<u8, String>,
    /// By the number of the camera and that of the stream.
    streams: BTreeMap<(u8, u8), AnnouncedStream>,
    /// The number of streams that it reports.
    count: Option<u8>,
}

/// A message to send.
struct Question {
    to: Option<SocketAddr>,
    /// The system id of the sender: an autopilot forwards packets that come from its own vehicle.
    system: u8,
    message: MavMessage,
}

impl Inquiry {
    fn take(&mut self, packet: &Packet, from: Option<SocketAddr>) {
        let Sender { system, component } = packet.sender;
        let Some(message) = &packet.message else { return };
        let is_camera = match message {
            MavMessage::HEARTBEAT(heartbeat) if heartbeat.mavtype == MavType::MAV_TYPE_GCS => {
                return;
            }
            MavMessage::HEARTBEAT(heartbeat) => heartbeat.mavtype == MavType::MAV_TYPE_CAMERA,
            MavMessage::CAMERA_INFORMATION(_) | MavMessage::VIDEO_STREAM_INFORMATION(_) => true,
            _ => return,
        };
        // As a target 0 is a broadcast.
        if system == 0 || component == 0 || !self.has_room(system, component, is_camera) {
            return;
        }
        let component = self.components.entry((system, component)).or_default();
        component.from = from;
        component.is_camera |= is_camera;
        match message {
            MavMessage::CAMERA_INFORMATION(camera) if component.names.len() < MAX_STREAMS => {
                component.names.insert(camera.camera_device_id, name(camera));
            }
            MavMessage::VIDEO_STREAM_INFORMATION(video) => {
                component.count = Some(video.count);
                if component.streams.len() < MAX_STREAMS {
                    component
                        .streams
                        .insert((video.camera_device_id, video.stream_id), stream(video));
                }
            }
            _ => {}
        }
    }

    /// Whether this component is known or can be added: a camera replaces a component that is not known to be a camera.
    fn has_room(&mut self, system: u8, component: u8, is_camera: bool) -> bool {
        if self.components.contains_key(&(system, component))
            || self.components.len() < MAX_COMPONENTS
        {
            return true;
        }
        let other = self.components.iter().find(|(_, known)| is_camera && !known.is_camera);
        let other = other.map(|(key, _)| *key);
        other.is_some_and(|key| self.components.remove(&key).is_some())
    }

    /// A heartbeat, without which an autopilot forwards no answers to this program, and all questions without an answer.
    #[expect(deprecated, reason = "older cameras support only the older commands")]
    fn questions(&self, attempt: u8) -> Vec<Question> {
        let mut questions = Vec::new();
        if self.components.is_empty() {
            // It opens the way to the address that this program sends to.
            questions.push(Question {
                to: None,
                system: 1,
                message: MavMessage::HEARTBEAT(compose::heartbeat()),
            });
        }
        for (&(system, component), known) in &self.components {
            let mut ask = |message| questions.push(Question { to: known.from, system, message });
            let command = |command, param1: u32| {
                MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
                    command,
                    param1: param1 as f32,
                    target_system: system,
                    target_component: component,
                    confirmation: attempt,
                    ..Default::default()
                })
            };
            ask(MavMessage::HEARTBEAT(compose::heartbeat()));
            if known.names.is_empty() {
                ask(command(MavCmd::MAV_CMD_REQUEST_MESSAGE, CAMERA_INFORMATION_DATA::ID));
                ask(command(MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION, 1));
            }
            // The second parameter is the stream, of which 0 is all of them.
            if known.count.is_none_or(|count| known.streams.len() < usize::from(count)) {
                ask(command(MavCmd::MAV_CMD_REQUEST_MESSAGE, VIDEO_STREAM_INFORMATION_DATA::ID));
                ask(command(MavCmd::MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 0));
            }
        }
        questions
    }

    /// The components that are cameras.
    fn cameras(&self) -> Vec<AnnouncedCamera> {
        let mut cameras = Vec::new();
        for (&(system, component), known) in &self.components {
            let mut devices: Vec<u8> = known.names.keys().copied().collect();
            devices.extend(known.streams.keys().map(|(device, _)| *device));
            if devices.is_empty() && known.is_camera {
                devices.push(0);
            }
            devices.sort_unstable();
            devices.dedup();
            cameras.extend(devices.into_iter().map(|device| {
                AnnouncedCamera {
                    system,
                    component,
                    device,
                    name: known.names.get(&device).cloned().unwrap_or_default(),
                    streams: known
                        .streams
                        .iter()
                        .filter(|((of, _), _)| *of == device)
                        .map(|(_, stream)| stream.clone())
                        .collect(),
                }
            }));
        }
        cameras
    }
}

fn name(camera: &CAMERA_INFORMATION_DATA) -> String {
    let parts = [&camera.vendor_name, &camera.model_name].map(|bytes| printable(&text(bytes)));
    parts.join(" ").trim().to_owned()
}

fn stream(video: &VIDEO_STREAM_INFORMATION_DATA) -> AnnouncedStream {
    let encoding = match video.encoding {
        VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264 => "H.264",
        VideoStreamEncoding::VIDEO_STREAM_ENCODING_H265 => "H.265",
        VideoStreamEncoding::VIDEO_STREAM_ENCODING_UNKNOWN => "",
    };
    let reported_address = printable(video.uri.to_str().unwrap_or_default());
    // A name and a password are for a file, not for a terminal or a configuration.
    let address = without_credentials(&reported_address);
    let size_px = [video.resolution_h, video.resolution_v];
    let size_px = (size_px.iter().all(|edge| (1..=16384).contains(edge))).then_some(size_px);
    let rate_hz = Some(video.framerate).filter(|rate| RATES_HZ.contains(&f64::from(*rate)));
    let is_read = video.mavtype == VideoStreamType::VIDEO_STREAM_TYPE_RTSP
        && address.starts_with("rtsp://")
        && encoding != "H.265";
    let mut table = format!("[source]\nrtsp = \"{address}\"");
    if address != reported_address {
        table += "\nrtsp_credentials = \"FILE\"  # with a line user:password, chmod 600";
    }
    table += &match size_px {
        Some([width, height]) => format!("\nsize_px = [{width}, {height}]"),
        None => {
            "\n# size_px = [WIDTH, HEIGHT] is needed, and the camera does not report it".to_owned()
        }
    };
    if let Some(rate_hz) = rate_hz {
        table += &format!("\nrate_hz = {rate_hz:?}");
    }
    AnnouncedStream {
        id: video.stream_id,
        name: printable(video.name.to_str().unwrap_or_default()),
        transport: match video.mavtype {
            VideoStreamType::VIDEO_STREAM_TYPE_RTSP => "RTSP",
            VideoStreamType::VIDEO_STREAM_TYPE_RTPUDP => "RTP over UDP",
            VideoStreamType::VIDEO_STREAM_TYPE_TCP_MPEG => "MPEG over TCP",
            VideoStreamType::VIDEO_STREAM_TYPE_MPEG_TS => "MPEG-TS",
            VideoStreamType::VIDEO_STREAM_TYPE_WHEP => "WebRTC",
        },
        encoding,
        address,
        size_px,
        rate_hz,
        source: is_read.then_some(table),
    }
}

/// Text of another program, without characters that move a terminal's cursor, reverse its text or end a string of TOML.
fn printable(text: &str) -> String {
    text.chars().filter(|it| (' '..='~').contains(it) && !matches!(it, '"' | '\\')).collect()
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket as BlockingSocket;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use autopilot::dialect::HEARTBEAT_DATA;

    use super::*;
    use crate::Config;

    const CAMERA: Sender = Sender { system: 1, component: 100 };

    fn heartbeat(mavtype: MavType) -> MavMessage {
        MavMessage::HEARTBEAT(HEARTBEAT_DATA { mavtype, ..HEARTBEAT_DATA::default() })
    }

    fn information(uri: &str, encoding: VideoStreamEncoding) -> VIDEO_STREAM_INFORMATION_DATA {
        VIDEO_STREAM_INFORMATION_DATA {
            stream_id: 1,
            count: 1,
            mavtype: VideoStreamType::VIDEO_STREAM_TYPE_RTSP,
            framerate: 30.0,
            resolution_h: 1280,
            resolution_v: 720,
            name: "down".into(),
            uri: uri.into(),
            encoding,
            ..VIDEO_STREAM_INFORMATION_DATA::default()
        }
    }

    fn packet(sender: Sender, message: &MavMessage) -> Packet {
        Parser::new().push(&encode(sender, 0, message)).remove(0)
    }

    /// A component that answers the old commands only, and the first questions not at all.
    #[expect(deprecated, reason = "older cameras support only the older commands")]
    fn play(port: u16, sender: Sender, mavtype: MavType, is_over: &AtomicBool) {
        let socket = BlockingSocket::bind("127.0.0.1:0").unwrap();
        socket.connect(("127.0.0.1", port)).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let send = |message| drop(socket.send(&encode(sender, 0, &message)));
        let mut asked = 0;
        let mut parser = Parser::new();
        while !is_over.load(Ordering::Relaxed) {
            send(heartbeat(mavtype));
            let mut buffer = [0; 2048];
            let Ok(length) = socket.recv(&mut buffer) else { continue };
            for packet in parser.push(&buffer[..length]) {
                assert_eq!(packet.sender, Sender { system: 1, component: ASKING_AS });
                let Some(MavMessage::COMMAND_LONG(command)) = packet.message else { continue };
                let target = (command.target_system, command.target_component);
                assert_eq!(target, (sender.system, sender.component));
                asked += 1;
                let is_old = command.command == MavCmd::MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION;
                if is_old && asked > 4 && mavtype == MavType::MAV_TYPE_CAMERA {
                    let encoding = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264;
                    let video = information("rtsp://10.0.0.2:8554/main", encoding);
                    send(MavMessage::VIDEO_STREAM_INFORMATION(video));
                }
            }
        }
    }

    #[tokio::test]
    async fn a_camera_that_answers_old_commands_only_is_found_next_to_an_autopilot() {
        let port = BlockingSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let is_over = Arc::new(AtomicBool::new(false));
        let autopilot = Sender { system: 1, component: 1 };
        let players =
            [(autopilot, MavType::MAV_TYPE_QUADROTOR), (CAMERA, MavType::MAV_TYPE_CAMERA)];
        let players = players.map(|(sender, mavtype)| {
            let is_over = Arc::clone(&is_over);
            std::thread::spawn(move || play(port, sender, mavtype, &is_over))
        });
        let address = format!("udpin:127.0.0.1:{port}");
        let found = announced_cameras(&address, Duration::from_secs(3)).await.unwrap();
        is_over.store(true, Ordering::Relaxed);
        players.into_iter().for_each(|player| player.join().unwrap());
        assert_eq!(found.problem, None);
        let [camera] = &found.cameras[..] else { panic!("{found:?}") };
        assert_eq!((camera.system, camera.component, camera.device), (1, 100, 0));
        assert!(camera.streams[0].source.is_some(), "{camera:?}");
    }

    #[tokio::test]
    async fn a_silent_port_and_a_closed_port_are_distinguished() {
        let soon = Duration::from_millis(900);
        let silent = announced_cameras("udpin:127.0.0.1:0", soon).await.unwrap();
        assert!(silent.problem.unwrap().contains("no MAVLink came to udpin:127.0.0.1:0"));
        let closed = announced_cameras("tcp:127.0.0.1:1", soon).await.unwrap().problem.unwrap();
        assert!(closed.contains("127.0.0.1:1") && !closed.contains("no MAVLink"), "{closed}");
        let problem = announced_cameras("somewhere", soon).await.unwrap_err().to_string();
        assert!(problem.contains("`somewhere` is not an address of a MAVLink link"), "{problem}");
    }

    #[test]
    fn announced_streams_are_shown_without_secrets_and_read_only_where_possible() {
        let h264 = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264;
        let h265 = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H265;
        for (uri, shown) in [
            ("rtsp://me:hidden@10.0.0.2/a", "rtsp://10.0.0.2/a"),
            ("rtsp://me:hid/den@10.0.0.2/a", "rtsp://10.0.0.2/a"),
            ("me:hidden@10.0.0.2:554/a", "10.0.0.2:554/a"),
            ("rtsp://\u{1b}[2J\u{202e}10.0.0.2/\"a", "rtsp://[2J10.0.0.2/a"),
        ] {
            assert_eq!(stream(&information(uri, h264)).address, shown);
        }
        assert_eq!(stream(&information("rtsp://10.0.0.2/a", h265)).source, None);
        assert_eq!(stream(&information("5600", h264)).source, None);
        let odd = VIDEO_STREAM_INFORMATION_DATA {
            framerate: 1e30,
            ..information("rtsp://me:hidden@10.0.0.2/a", h264)
        };
        for video in [information("rtsp://me:hidden@10.0.0.2/a", h264), odd] {
            let table = stream(&video).source.unwrap();
            assert!(table.contains("rtsp_credentials") && !table.contains("hidden"), "{table}");
            let folder = tempfile::tempdir().unwrap();
            let file = Some(folder.path().join("camera.toml"));
            std::fs::write(file.as_ref().unwrap(), table).unwrap();
            let loaded = node::Layers { file, set: Vec::new() }.load::<Config>();
            if cfg!(feature = "rtsp") {
                loaded.unwrap();
            } else {
                let problem = loaded.unwrap_err().to_string();
                assert!(problem.contains("build it with `--features rtsp`"), "{problem}");
            }
        }
        let unsized_stream =
            VIDEO_STREAM_INFORMATION_DATA { resolution_h: 0, ..information("rtsp://a/b", h264) };
        let table = stream(&unsized_stream).source.unwrap();
        assert!(table.contains("# size_px = [WIDTH, HEIGHT] is needed"), "{table}");
    }

    #[test]
    fn cameras_of_an_autopilot_are_distinguished() {
        let mut inquiry = Inquiry::default();
        let h264 = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264;
        for camera_device_id in [1, 2] {
            let video = information(&format!("rtsp://10.0.0.{camera_device_id}/a"), h264);
            let video = VIDEO_STREAM_INFORMATION_DATA { camera_device_id, ..video };
            let message = MavMessage::VIDEO_STREAM_INFORMATION(video);
            inquiry.take(&packet(Sender { system: 1, component: 1 }, &message), None);
        }
        let cameras = inquiry.cameras();
        assert_eq!(cameras.iter().map(|it| it.device).collect::<Vec<_>>(), [1, 2]);
    }

    #[test]
    fn neither_ground_stations_nor_too_many_components_are_queried() {
        let mut inquiry = Inquiry::default();
        let station = Sender { system: 255, component: 190 };
        inquiry.take(&packet(station, &heartbeat(MavType::MAV_TYPE_GCS)), None);
        assert!(inquiry.components.is_empty());
        for component in 0..200 {
            let sender = Sender { system: 1, component };
            inquiry.take(&packet(sender, &heartbeat(MavType::MAV_TYPE_GIMBAL)), None);
        }
        assert_eq!(inquiry.components.len(), MAX_COMPONENTS);
        assert_eq!(inquiry.questions(0).len(), 5 * MAX_COMPONENTS);
        assert_eq!(inquiry.cameras(), []);
        // A camera replaces one of them.
        inquiry.take(&packet(CAMERA, &heartbeat(MavType::MAV_TYPE_CAMERA)), None);
        assert_eq!(inquiry.components.len(), MAX_COMPONENTS);
        assert_eq!(inquiry.cameras().len(), 1);
    }
}
