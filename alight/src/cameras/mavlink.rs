//! Cameras that are announced over MAVLink, and the addresses of their video.
//!
//! Messages and commands are those of <https://mavlink.io/en/services/camera.html>: whoever sends a heartbeat is asked for
//! CAMERA_INFORMATION and for VIDEO_STREAM_INFORMATION of all its streams, in the new and in the old form.

use std::collections::BTreeMap;
use std::time::Duration;

use anyhow::Context;
use autopilot::dialect::{
    CAMERA_INFORMATION_DATA, COMMAND_LONG_DATA, MavCmd, MavMessage, MavType, MessageData,
    VIDEO_STREAM_INFORMATION_DATA, VideoStreamEncoding, VideoStreamType,
};
use autopilot::packet::encode;
use autopilot::{Address, Link, LinkEvent, Packet, Peering, Sender, compose};
use serde::Serialize;
use tokio::time::{Instant, interval, sleep_until};

use crate::runtime::runtime;

/// How long cameras may announce themselves and answer: they send a heartbeat each second.
const LISTEN_FOR: Duration = Duration::from_secs(5);
/// Period of the questions, until they are answered.
const ASK_PERIOD: Duration = Duration::from_millis(700);
/// Silence after which a listening port hears another host.
const PEER_SILENCE: Duration = Duration::from_secs(3);
/// Maximum number of components that are asked, and of streams of each.
const MAX_COMPONENTS: usize = 32;
const MAX_STREAMS: usize = 16;
/// Component id of a companion computer (MAV_COMP_ID_ONBOARD_COMPUTER).
const COMPANION: u8 = 191;

/// A camera that was announced.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct MavlinkCamera {
    pub(crate) system: u8,
    pub(crate) component: u8,
    /// Its maker and model, where it says them.
    pub(crate) name: String,
    pub(crate) streams: Vec<Stream>,
}

/// A video stream of a camera.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Stream {
    pub(crate) id: u8,
    pub(crate) name: String,
    /// How it is sent: `RTSP`, `RTP over UDP`, `MPEG over TCP`, `MPEG-TS` or `WebRTC`.
    pub(crate) transport: &'static str,
    /// `H.264`, `H.265`, or nothing where the camera does not say it.
    pub(crate) encoding: &'static str,
    /// Its address, or the port at which the ground station receives it.
    pub(crate) address: String,
    pub(crate) width: u16,
    pub(crate) height: u16,
    pub(crate) rate_hz: f32,
    /// The `[source]` table; `None` for what camera-pub does not read by itself.
    pub(crate) source: Option<String>,
}

/// Asks at an address for a few seconds.
///
/// # Errors
/// When the address cannot be listened at.
pub(super) fn announced(address: &Address) -> anyhow::Result<Vec<MavlinkCamera>> {
    runtime()?.block_on(ask(address, LISTEN_FOR))
}

async fn ask(address: &Address, listen_for: Duration) -> anyhow::Result<Vec<MavlinkCamera>> {
    let peering = Peering::GroundStation { known: Vec::new(), silence: PEER_SILENCE };
    let link = Link::open_for(address.clone(), peering, None).await;
    let mut link = link.with_context(|| format!("asking for cameras at {address}"))?;
    let end = Instant::now() + listen_for;
    let mut due = interval(ASK_PERIOD);
    let mut inquiry = Inquiry::default();
    let mut sequence = 0_u8;
    loop {
        tokio::select! {
            () = sleep_until(end) => return Ok(inquiry.cameras()),
            event = link.recv() => {
                if let LinkEvent::Packet { packet, .. } = event {
                    inquiry.take(&packet);
                }
            }
            _ = due.tick() => {
                for (system, message) in inquiry.questions() {
                    let packet = encode(Sender { system, component: COMPANION }, sequence, &message);
                    sequence = sequence.wrapping_add(1);
                    // What cannot be sent now is asked again at the next tick.
                    if link.send(&packet).is_err() {
                        break;
                    }
                }
            }
        }
    }
}

/// Who is there, and what is known of it.
#[derive(Debug, Default)]
struct Inquiry {
    components: BTreeMap<(u8, u8), Component>,
}

#[derive(Debug, Default)]
struct Component {
    name: Option<String>,
    streams: BTreeMap<u8, Stream>,
    /// The number of streams that it says it has.
    count: Option<u8>,
}

impl Inquiry {
    fn take(&mut self, packet: &Packet) {
        let Sender { system, component } = packet.sender;
        let Some(message) = &packet.message else { return };
        let is_camera = match message {
            MavMessage::HEARTBEAT(heartbeat) => heartbeat.mavtype != MavType::MAV_TYPE_GCS,
            MavMessage::CAMERA_INFORMATION(_) | MavMessage::VIDEO_STREAM_INFORMATION(_) => true,
            _ => false,
        };
        let is_known = self.components.contains_key(&(system, component));
        if !is_camera || !is_known && self.components.len() >= MAX_COMPONENTS {
            return;
        }
        let component = self.components.entry((system, component)).or_default();
        match message {
            MavMessage::CAMERA_INFORMATION(told) => component.name = Some(name(told)),
            MavMessage::VIDEO_STREAM_INFORMATION(told) => {
                component.count = Some(told.count);
                if component.streams.len() < MAX_STREAMS {
                    component.streams.insert(told.stream_id, stream(told));
                }
            }
            _ => {}
        }
    }

    /// A heartbeat, without which an autopilot passes no answers on to this program, and what is not answered yet; each with
    /// the system in whose name it is sent.
    #[expect(deprecated, reason = "older cameras know only the older commands")]
    fn questions(&self) -> Vec<(u8, MavMessage)> {
        let mut questions = Vec::new();
        let mut systems: Vec<u8> = self.components.keys().map(|(system, _)| *system).collect();
        systems.dedup();
        // Before anybody is known, a heartbeat opens the way to whom this program sends to.
        for system in if systems.is_empty() { vec![1] } else { systems } {
            questions.push((system, compose::heartbeat()));
        }
        for (&(system, component), known) in &self.components {
            let command = |command, param1: u32| {
                let message = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
                    command,
                    param1: param1 as f32,
                    target_system: system,
                    target_component: component,
                    ..Default::default()
                });
                (system, message)
            };
            if known.name.is_none() {
                questions
                    .push(command(MavCmd::MAV_CMD_REQUEST_MESSAGE, CAMERA_INFORMATION_DATA::ID));
                questions.push(command(MavCmd::MAV_CMD_REQUEST_CAMERA_INFORMATION, 1));
            }
            // The second parameter is the stream, of which 0 is all of them.
            if known.count.is_none_or(|count| known.streams.len() < usize::from(count)) {
                let stream = VIDEO_STREAM_INFORMATION_DATA::ID;
                questions.push(command(MavCmd::MAV_CMD_REQUEST_MESSAGE, stream));
                questions.push(command(MavCmd::MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION, 0));
            }
        }
        questions
    }

    /// Those of them that are cameras.
    fn cameras(&self) -> Vec<MavlinkCamera> {
        let is_camera =
            |component: &Component| component.name.is_some() || !component.streams.is_empty();
        let cameras = self.components.iter().filter(|(_, component)| is_camera(component));
        cameras
            .map(|(&(system, component), known)| MavlinkCamera {
                system,
                component,
                name: known.name.clone().unwrap_or_default(),
                streams: known.streams.values().cloned().collect(),
            })
            .collect()
    }
}

fn name(told: &CAMERA_INFORMATION_DATA) -> String {
    let text = |bytes: &[u8]| {
        let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
        printable(&String::from_utf8_lossy(&bytes[..end]))
    };
    [text(&told.vendor_name), text(&told.model_name)].join(" ").trim().to_owned()
}

fn stream(told: &VIDEO_STREAM_INFORMATION_DATA) -> Stream {
    let encoding = match told.encoding {
        VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264 => "H.264",
        VideoStreamEncoding::VIDEO_STREAM_ENCODING_H265 => "H.265",
        VideoStreamEncoding::VIDEO_STREAM_ENCODING_UNKNOWN => "",
    };
    let told_address = printable(told.uri.to_str().unwrap_or_default());
    // A name and a password are for a file, not for a terminal or a configuration.
    let (address, is_secret) = match told_address.split_once("://") {
        Some((scheme, rest)) => match rest.split('/').next().and_then(|host| host.rfind('@')) {
            Some(at) => (format!("{scheme}://{}", &rest[at + 1..]), true),
            None => (told_address, false),
        },
        None => (told_address, false),
    };
    let is_rtsp = told.mavtype == VideoStreamType::VIDEO_STREAM_TYPE_RTSP
        && address.starts_with("rtsp://")
        && encoding != "H.265";
    let mut table = format!("[source]\nrtsp = {address:?}");
    if is_secret {
        table += "\nrtsp_credentials = \"FILE\"  # with a line user:password, chmod 600";
    }
    if told.resolution_h > 0 && told.resolution_v > 0 {
        table += &format!("\nsize_px = [{}, {}]", told.resolution_h, told.resolution_v);
    }
    if told.framerate.is_finite() && told.framerate > 0.0 {
        table += &format!("\nrate_hz = {}", told.framerate);
    }
    Stream {
        id: told.stream_id,
        name: printable(told.name.to_str().unwrap_or_default()),
        transport: match told.mavtype {
            VideoStreamType::VIDEO_STREAM_TYPE_RTSP => "RTSP",
            VideoStreamType::VIDEO_STREAM_TYPE_RTPUDP => "RTP over UDP",
            VideoStreamType::VIDEO_STREAM_TYPE_TCP_MPEG => "MPEG over TCP",
            VideoStreamType::VIDEO_STREAM_TYPE_MPEG_TS => "MPEG-TS",
            VideoStreamType::VIDEO_STREAM_TYPE_WHEP => "WebRTC",
        },
        encoding,
        address,
        width: told.resolution_h,
        height: told.resolution_v,
        rate_hz: told.framerate,
        source: is_rtsp.then_some(table),
    }
}

/// What others sent, without what would move a terminal's cursor.
fn printable(text: &str) -> String {
    text.chars().filter(|it| !it.is_control()).collect()
}

#[cfg(test)]
mod tests {
    use std::net::UdpSocket;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicBool, Ordering};

    use autopilot::Parser;
    use autopilot::dialect::HEARTBEAT_DATA;

    use super::*;

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

    /// A camera that answers the old commands only, and the first question not at all.
    #[expect(deprecated, reason = "older cameras know only the older commands")]
    fn play(port: u16, is_over: &AtomicBool) {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.connect(("127.0.0.1", port)).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let send = |message| drop(socket.send(&encode(CAMERA, 0, &message)));
        let mut asked = 0;
        let mut parser = Parser::new();
        while !is_over.load(Ordering::Relaxed) {
            send(heartbeat(MavType::MAV_TYPE_CAMERA));
            let mut buffer = [0; 2048];
            let Ok(length) = socket.recv(&mut buffer) else { continue };
            for packet in parser.push(&buffer[..length]) {
                let Some(MavMessage::COMMAND_LONG(command)) = packet.message else { continue };
                assert_eq!((command.target_system, command.target_component), (1, 100));
                asked += 1;
                if command.command == MavCmd::MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION && asked > 4
                {
                    let encoding = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264;
                    let told = information("rtsp://10.0.0.2:8554/main", encoding);
                    send(MavMessage::VIDEO_STREAM_INFORMATION(told));
                }
            }
        }
    }

    #[test]
    fn a_camera_that_answers_old_commands_only_is_found() {
        let port = UdpSocket::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let is_over = Arc::new(AtomicBool::new(false));
        let camera = std::thread::spawn({
            let is_over = Arc::clone(&is_over);
            move || play(port, &is_over)
        });
        let address = format!("udpin:127.0.0.1:{port}").parse().unwrap();
        let found = runtime().unwrap().block_on(ask(&address, Duration::from_secs(3))).unwrap();
        is_over.store(true, Ordering::Relaxed);
        camera.join().unwrap();
        let [camera] = &found[..] else { panic!("{found:?}") };
        assert_eq!((camera.system, camera.component), (1, 100));
        let source = camera.streams[0].source.as_deref().unwrap();
        assert_eq!(
            source,
            "[source]\nrtsp = \"rtsp://10.0.0.2:8554/main\"\nsize_px = [1280, 720]\nrate_hz = 30"
        );
    }

    #[test]
    fn what_is_announced_is_shown_without_secrets_and_read_only_where_it_can_be() {
        let h264 = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H264;
        let h265 = VideoStreamEncoding::VIDEO_STREAM_ENCODING_H265;
        let told = stream(&information("rtsp://me:hidden@10.0.0.2/a@b", h264));
        assert_eq!(told.address, "rtsp://10.0.0.2/a@b");
        let source = told.source.unwrap();
        assert!(source.contains("rtsp_credentials") && !source.contains("hidden"), "{source}");
        assert_eq!(stream(&information("rtsp://10.0.0.2/a", h265)).source, None);
        assert_eq!(stream(&information("5600", h264)).source, None);
        assert_eq!(
            stream(&information("rtsp://\u{1b}[2J10.0.0.2/a", h264)).address,
            "rtsp://[2J10.0.0.2/a"
        );
    }

    #[test]
    fn neither_ground_stations_nor_a_crowd_are_asked() {
        let mut inquiry = Inquiry::default();
        let station = Sender { system: 255, component: 190 };
        inquiry.take(&packet(station, &heartbeat(MavType::MAV_TYPE_GCS)));
        assert!(inquiry.components.is_empty());
        for component in 0..200 {
            let sender = Sender { system: 1, component };
            inquiry.take(&packet(sender, &heartbeat(MavType::MAV_TYPE_CAMERA)));
        }
        assert_eq!(inquiry.components.len(), MAX_COMPONENTS);
        assert_eq!(inquiry.questions().len(), 1 + 4 * MAX_COMPONENTS);
        // None of them said that it is a camera.
        assert_eq!(inquiry.cameras(), []);
    }
}
