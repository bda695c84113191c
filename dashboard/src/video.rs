//! Makes JPEG pictures of the frames of the camera in use, each with its detections and refused candidates as JSON, while
//! at least one browser shows them.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use airlink::Rate;
use airlink::picture::jpeg;
use anyhow::Context;
use axum::body::Bytes;
use messages::{
    Detection, Detections, EllipsePx, FrameHeader, Refusal, Refusals, RefusedShape, topic,
};
use node::{Frame, Node, Subscriber, now_ns};
use serde_json::{Value, json};
use tokio::sync::watch;
use tokio::time::{Instant, interval, sleep, sleep_until, timeout};

use crate::config::{Input, VideoConfig};
use crate::pairing::{Pairing, Picture};
use crate::state::State;

/// Period in which a new viewer is noticed.
pub(crate) const LOOK_PERIOD: Duration = Duration::from_millis(100);
/// Frames are received for this time after the last browser has disconnected, so that a page that is reloaded shows a
/// picture at once.
const LINGER: Duration = Duration::from_secs(2);
/// Maximum size of a picture, in bytes.
const MAX_BYTES: usize = 16_000_000;
/// Maximum number of markers that are drawn.
const MAX_MARKERS: usize = 32;
/// Maximum number of refused candidates that are drawn.
const MAX_REFUSALS: usize = 64;

/// A picture as it is sent to browsers.
#[derive(Clone, Debug)]
pub(crate) struct Shown {
    /// Its number since the start of this process.
    pub(crate) number: u64,
    /// When it was made, in nanoseconds of this process' clock.
    pub(crate) at_ns: i64,
    /// The length of the header (4 bytes, lowest first), the header as JSON, the JPEG files.
    pub(crate) message: Bytes,
    /// The header of its frame.
    pub(crate) header: FrameHeader,
    /// The JPEG files, one for each part of the frame.
    pub(crate) files: Bytes,
}

/// The newest picture, for all viewers.
#[derive(Clone, Debug, Default)]
pub(crate) struct Pictures {
    /// For the page.
    pub(crate) shown: Arc<watch::Sender<Option<Shown>>>,
    /// As one JPEG file, for programs that support Motion JPEG only.
    pub(crate) files: Arc<watch::Sender<Option<Bytes>>>,
    /// Its receivers are the browsers that show refused candidates: detectors publish these only while there is one.
    pub(crate) show_refused: Arc<watch::Sender<()>>,
}

/// Makes pictures while there is a viewer.
pub(crate) struct Video {
    node: Node,
    config: VideoConfig,
    state: Arc<Mutex<State>>,
    shown: Arc<watch::Sender<Option<Shown>>>,
    show_refused: Arc<watch::Sender<()>>,
    number: u64,
}

impl Video {
    pub(crate) fn new(
        node: Node,
        config: VideoConfig,
        state: Arc<Mutex<State>>,
        pictures: &Pictures,
    ) -> Self {
        let shown = Arc::clone(&pictures.shown);
        let show_refused = Arc::clone(&pictures.show_refused);
        Self { node, config, state, shown, show_refused, number: 0 }
    }

    /// Makes pictures until the session is closed.
    pub(crate) async fn run(mut self) -> anyhow::Result<()> {
        let input = node::named(&self.config.input).map_err(anyhow::Error::msg)?;
        let topic = match input {
            Input::Frames => topic::FRAME,
            Input::Jpeg => topic::JPEG,
            Input::None => return std::future::pending().await,
        };
        loop {
            while self.shown.receiver_count() == 0 {
                sleep(LOOK_PERIOD).await;
            }
            self.while_watched(topic).await?;
            self.shown.send_replace(None);
        }
    }

    async fn while_watched(&mut self, topic: messages::Topic<FrameHeader>) -> anyhow::Result<()> {
        let frames = self.node.frame_subscriber(topic, &[]).await?;
        let detections = self.node.subscriber(topic::DETECTIONS, &[]).await?;
        let mut refused: Option<Subscriber<Refusals>> = None;
        let mut pairing = Pairing::new(i64::from(self.config.hold_ms) * 1_000_000);
        let mut rate = Rate::new(self.config.max_hz);
        let mut look = interval(LOOK_PERIOD);
        let mut watched = Instant::now();
        loop {
            let wait_ns = pairing.deadline_ns().map(|at_ns| at_ns.saturating_sub(now_ns()).max(0));
            let due = wait_ns.map(|ns| Instant::now() + Duration::from_nanos(ns.cast_unsigned()));
            tokio::select! {
                // In this order: detections are taken before a further picture is made, which takes time.
                biased;
                found = detections.next_with_key() => {
                    let (key, found) = found.context("the network session was closed")?;
                    add_detections(&mut pairing, &key, found);
                }
                refusals = next_refusals(refused.as_ref()), if refused.is_some() => {
                    let (key, refusals) = refusals.context("the network session was closed")?;
                    let detector = topic::REFUSALS.first_name(&key).unwrap_or_default().to_owned();
                    pairing.refusals(Refusals { detector, ..refusals });
                }
                _ = look.tick() => {
                    match (self.show_refused.receiver_count() > 0, refused.is_some()) {
                        (true, false) => {
                            refused = Some(self.node.subscriber(topic::REFUSALS, &[]).await?);
                        }
                        (false, true) => {
                            refused = None;
                            pairing.forget_refusals();
                        }
                        _ => {}
                    }
                    if self.shown.receiver_count() > 0 {
                        watched = Instant::now();
                    } else if watched.elapsed() > LINGER {
                        return Ok(());
                    }
                }
                () = sleep_until(due.unwrap_or_else(Instant::now)), if due.is_some() => {}
                frame = frames.next() => {
                    let frame = frame.context("the network session was closed")?;
                    if rate.is_due(now_ns()) && self.is_selected(&frame.header) {
                        rate.take(now_ns());
                        self.add(frame, &mut pairing).await?;
                        // Detections that arrived while the picture was made are taken before the picture's wait ends.
                        while let Ok(found) = timeout(Duration::ZERO, detections.next_with_key()).await {
                            let (key, found) = found.context("the network session was closed")?;
                            add_detections(&mut pairing, &key, found);
                        }
                    }
                }
            }
            let in_use = self.lock().in_use().map(str::to_owned);
            while let Some(picture) = pairing.ready(now_ns(), in_use.as_deref()) {
                self.show(&picture);
            }
        }
    }

    /// Of several cameras the one of the detector in use is shown.
    fn is_selected(&self, header: &FrameHeader) -> bool {
        self.lock().camera().is_none_or(|camera| camera == header.camera)
    }

    /// Makes the picture of a frame, on a thread for blocking work.
    async fn add(&self, frame: Frame, pairing: &mut Pairing) -> anyhow::Result<()> {
        // The time for making it counts.
        let (began, received_ns) = (Instant::now(), now_ns());
        let quality = self.config.jpeg_quality;
        let make = move || {
            let files = files(&frame.header, &frame.bytes(), quality);
            (frame.header, files)
        };
        let (header, files) = tokio::task::spawn_blocking(make).await?;
        match files.filter(|files| files.len() <= MAX_BYTES) {
            Some(files) => {
                self.node.health().latency("picture", began.elapsed());
                if pairing.picture(received_ns, header, files) {
                    self.node.health().dropped("too many pictures wait");
                }
            }
            None => {
                if self.node.health().failed("no picture of a frame") {
                    tracing::warn!(
                        ?header,
                        "A frame cannot be shown: it is not a complete grey or Bayer image"
                    );
                }
            }
        }
        Ok(())
    }

    fn show(&mut self, picture: &Picture) {
        self.number += 1;
        let at_ns = now_ns();
        let header = header_json(self.number, at_ns, picture, node::clock_name()).to_string();
        let mut message = Vec::with_capacity(4 + header.len() + picture.files.len());
        message.extend_from_slice(&(header.len() as u32).to_le_bytes());
        message.extend_from_slice(header.as_bytes());
        message.extend_from_slice(&picture.files);
        self.node.health().count("pictures");
        if picture.found.is_none() {
            self.node.health().dropped("picture without detections in time");
        }
        let message = Bytes::from(message);
        let files = message.slice(4 + header.len()..);
        let header = picture.header.clone();
        self.shown.send_replace(Some(Shown { number: self.number, at_ns, message, header, files }));
    }

    // The state is complete after each message, also when a thread panics.
    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The next refused candidates of a detector; without a subscriber it waits for ever.
async fn next_refusals(refused: Option<&Subscriber<Refusals>>) -> Option<(String, Refusals)> {
    match refused {
        Some(refused) => refused.next_with_key().await,
        None => std::future::pending().await,
    }
}

/// Adds the detections of a detector, whose name is in the key.
fn add_detections(pairing: &mut Pairing, key: &str, found: Detections) {
    let detector = topic::DETECTIONS.first_name(key).unwrap_or_default().to_owned();
    pairing.detections(Detections { detector, ..found });
}

/// The JPEG files of a frame: the received ones, or a new one; `None` when they do not match the header.
fn files(header: &FrameHeader, bytes: &[u8], quality: u8) -> Option<Vec<u8>> {
    let stated: u64 = header.parts.iter().map(|part| u64::from(part.bytes)).sum();
    let is_complete = header.parts.is_empty() || stated == bytes.len() as u64;
    is_complete.then(|| jpeg(header, bytes, quality)).flatten()
}

fn header_json(number: u64, at_ns: i64, picture: &Picture, clock: &str) -> Value {
    let header = &picture.header;
    let parts: Vec<Value> = header
        .parts
        .iter()
        .map(|it| {
            json!({ "x": it.x, "y": it.y, "width": it.width, "height": it.height, "scale": it.scale, "bytes": it.bytes })
        })
        .collect();
    // Stamps of another host's clock cannot be compared with this host's; the arrival can.
    let is_own_clock = header.clock == clock;
    let taken_ns = if is_own_clock { header.stamp_ns } else { picture.received_ns };
    let found = picture.found.as_ref();
    json!({
        "number": number,
        "camera": header.camera, "sequence": header.sequence, "stamp_ns": header.stamp_ns.to_string(),
        "taken_ms": taken_ns as f64 * 1e-6, "is_own_clock": is_own_clock, "shown_ms": at_ns as f64 * 1e-6,
        "width": header.width, "height": header.height, "parts": parts,
        "detector": found.map(|it| &it.detector), "is_used": picture.is_used,
        "found_sequence": found.map(|it| it.header.sequence),
        "markers": found.map(|it| it.detections.iter().take(MAX_MARKERS).map(marker).collect::<Vec<_>>()),
        "refused": picture.refused.as_ref().map(|it| it.refusals.iter().take(MAX_REFUSALS).map(refusal).collect::<Vec<_>>()),
        "refused_total": picture.refused.as_ref().map(|it| it.total),
    })
}

fn refusal(it: &Refusal) -> Value {
    let ellipse = |it: &EllipsePx| json!({ "centre": it.centre_px, "axes": it.axes_px, "angle": it.angle_rad });
    match &it.shape {
        RefusedShape::Quad(corners) => json!({ "reason": it.reason, "corners": corners }),
        RefusedShape::Ring(edges) => {
            json!({ "reason": it.reason, "edges": edges.each_ref().map(ellipse) })
        }
    }
}

fn marker(it: &Detection) -> Value {
    let distance_m = it.pose.map(|pose| {
        let [x, y, z] = pose.camera_from_marker.translation_m;
        (x * x + y * y + z * z).sqrt()
    });
    let name = it.id.map_or_else(|| it.family.clone(), |id| format!("{}:{id}", it.family));
    json!({
        "name": name, "centre": it.centre_px, "covariance": it.centre_covariance_px2, "corners": it.corners_px,
        "size": it.size_px, "confidence": it.confidence, "distance_m": distance_m,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::FramePart;

    #[test]
    fn parts_that_do_not_match_their_bytes_give_no_picture() {
        let part = FramePart { x: 0, y: 0, width: 8, height: 8, scale: 1, bytes: 5 };
        let format = messages::PixelFormat::Jpeg;
        let header = FrameHeader { parts: vec![part], format, ..FrameHeader::sample() };
        assert!(files(&header, &[0; 5], 80).is_some());
        assert!(files(&header, &[0; 6], 80).is_none());
    }

    #[test]
    fn the_header_has_the_frame_and_its_detections() {
        let picture = Picture {
            header: FrameHeader { sequence: 7, stamp_ns: 2_000_000, ..FrameHeader::sample() },
            files: Arc::default(),
            received_ns: 5_000_000,
            found: Some(Detections::sample()),
            is_used: true,
            refused: None,
        };
        let json = header_json(3, 9_000_000, &picture, "clock");
        assert_eq!((&json["sequence"], &json["taken_ms"]), (&json!(7), &json!(2.0)));
        assert_eq!((&json["is_own_clock"], &json["shown_ms"]), (&json!(true), &json!(9.0)));
        assert_eq!(json["markers"][0]["centre"], json!([720.0, 522.0]));
        let other = header_json(3, 9_000_000, &picture, "another");
        assert_eq!((&other["is_own_clock"], &other["taken_ms"]), (&json!(false), &json!(5.0)));
        assert_eq!((&json["refused"], &json["refused_total"]), (&Value::Null, &Value::Null));
        let with_refused = Picture { refused: Some(Refusals::sample()), ..picture.clone() };
        let json = header_json(3, 9_000_000, &with_refused, "clock");
        assert_eq!(
            (&json["refused"][0]["reason"], &json["refused_total"]),
            (&json!("code"), &json!(1))
        );
        assert_eq!(json["refused"][0]["corners"][2], json!([140.0, 140.0]));
        let bare = header_json(3, 9_000_000, &Picture { found: None, ..picture }, "clock");
        assert_eq!(bare["markers"], Value::Null);
    }
}
