//! Sends pictures as H.264 over RTP, for QGroundControl.

mod encoder;
mod rtp;

use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use airlink::Rate;
use anyhow::Context;
use messages::{FrameHeader, topic};
use node::{Frame, Node, clock_name, now_ns};
use tokio::net::UdpSocket;

use crate::canvas::Canvas;
use crate::config::{Input, VideoConfig};
use crate::state::State;

use encoder::Encoder;
use rtp::Packetizer;

/// Sends pictures while the service runs.
pub(crate) struct Stream {
    node: Node,
    config: VideoConfig,
    state: Arc<Mutex<State>>,
}

/// Makes packets of frames, on another thread.
struct Maker {
    canvas: Canvas,
    encoder: Encoder,
    packetizer: Packetizer,
    camera: String,
}

impl Stream {
    pub(crate) fn new(node: Node, config: VideoConfig, state: Arc<Mutex<State>>) -> Self {
        Self { node, config, state }
    }

    /// Sends pictures until the session is closed; nothing without an address or pictures.
    pub(crate) async fn run(self) -> anyhow::Result<()> {
        let input = node::named(&self.config.input).map_err(anyhow::Error::msg)?;
        let topic = match input {
            Input::Frames => topic::FRAME,
            Input::Jpeg => topic::JPEG,
            Input::None => return std::future::pending().await,
        };
        if self.config.rtp.is_empty() {
            return std::future::pending().await;
        }
        let to: SocketAddr = self.config.rtp.parse().context("`video.rtp`")?;
        let any: SocketAddr = match to {
            SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
            SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
        };
        let socket = UdpSocket::bind(any).await.context("opening a socket for the stream")?;
        let frames = self.node.frame_subscriber(topic, &[]).await?;
        tracing::info!(%to, "Pictures are sent as H.264 over RTP");
        let mut rate = Rate::new(self.config.max_hz);
        let mut maker = Maker {
            canvas: Canvas::default(),
            encoder: Encoder::new(self.config.rtp_kbit_s, self.config.max_hz),
            packetizer: Packetizer::new()?,
            camera: String::new(),
        };
        loop {
            let frame = frames.next().await.context("the network session was closed")?;
            let began_ns = now_ns();
            if !rate.is_due(began_ns) || !self.is_selected(&frame.header) {
                continue;
            }
            rate.take(began_ns);
            // Stamps of another host's clock cannot be compared, so the time of such a frame is its arrival.
            let is_own_clock = frame.header.clock == clock_name();
            let taken_ns = if is_own_clock { frame.header.stamp_ns } else { began_ns };
            let make = move || {
                let packets = maker.packets(&frame, taken_ns, began_ns);
                (maker, packets)
            };
            let packets;
            (maker, packets) = tokio::task::spawn_blocking(make).await?;
            match packets {
                Ok(packets) if packets.is_empty() => {
                    self.node.health().dropped("picture left out of the stream, to keep its rate");
                }
                Ok(packets) => self.send(&socket, to, &packets, taken_ns).await,
                Err(error) => {
                    if self.node.health().failed("no H.264 of a frame") {
                        tracing::warn!(%error, "A frame is not in the stream");
                    }
                }
            }
        }
    }

    /// Of several cameras the one of the detector in use is shown.
    fn is_selected(&self, header: &FrameHeader) -> bool {
        // The state is complete after each message, also when a thread panics.
        let state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.camera().is_none_or(|camera| camera == header.camera)
    }

    async fn send(&self, socket: &UdpSocket, to: SocketAddr, packets: &[Vec<u8>], taken_ns: i64) {
        for packet in packets {
            // There may be no receiver yet, or the network may be unreachable for a moment.
            if socket.send_to(packet, to).await.is_err() {
                self.node.health().dropped("packets of the stream");
            }
        }
        if let Ok(age_ns) = u64::try_from(now_ns() - taken_ns) {
            self.node.health().latency("frame to stream", Duration::from_nanos(age_ns));
        }
        self.node.health().count("pictures in the stream");
    }
}

impl Maker {
    /// The packets of a frame.
    fn packets(
        &mut self,
        frame: &Frame,
        taken_ns: i64,
        now_ns: i64,
    ) -> Result<Vec<Vec<u8>>, String> {
        if self.camera != frame.header.camera {
            self.camera.clone_from(&frame.header.camera);
            self.canvas = Canvas::default();
        }
        let image = self.canvas.draw(&frame.header, &frame.bytes())?;
        let units = self.encoder.encode(image, now_ns)?;
        Ok(self.packetizer.packets(rtp::time(taken_ns), &units))
    }
}
