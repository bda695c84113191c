//! Sends small messages both ways across the link, with their send times: both hosts share a clock here.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use messages::{CommandReply, ControllerCommand, FrameAck, MavlinkBytes, topic};
use node::{Identity, Node, now_ns};
use serde_json::{Value, json};
use tokio::time::{Instant, interval};

use super::site::ground_network;

/// Between two small messages: 50 in a second.
const PERIOD: Duration = Duration::from_millis(20);
/// Between two commands.
const COMMAND_PERIOD: Duration = Duration::from_millis(200);
/// Names of both ends, as detectors.
const DRONE: &str = "probe-drone";
const GROUND: &str = "probe-ground";

/// How long messages took, and which are missing.
#[derive(Clone, Debug, Default)]
pub(crate) struct Times {
    ms: Vec<f64>,
    first: Option<u64>,
    last: u64,
}

impl Times {
    pub(crate) fn clear(&mut self) {
        *self = Self::default();
    }

    pub(crate) fn add(&mut self, ms: f64) {
        self.ms.push(ms);
    }

    fn add_numbered(&mut self, sequence: u64, sent_ns: i64) {
        self.first.get_or_insert(sequence);
        self.last = self.last.max(sequence);
        self.ms.push((now_ns() - sent_ns) as f64 * 1e-6);
    }

    /// A part of them took at most this long.
    pub(crate) fn at(&self, part: f64) -> f64 {
        let mut sorted = self.ms.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let rank = (part * (sorted.len() as f64 - 1.0)).round() as usize;
        sorted.get(rank).copied().unwrap_or(f64::NAN)
    }

    fn lost(&self) -> u64 {
        let sent = self.first.map_or(0, |first| self.last - first + 1);
        sent.saturating_sub(self.ms.len() as u64)
    }

    pub(crate) fn report(&self) -> Value {
        json!({
            "p50_ms": self.at(0.5), "p99_ms": self.at(0.99), "max_ms": self.at(1.0),
            "count": self.ms.len(), "lost": self.lost(),
        })
    }
}

/// Times that a task continues to measure.
pub(crate) type Shared = Arc<Mutex<Times>>;

pub(crate) fn taken(times: &Shared) -> Times {
    times.lock().unwrap_or_else(PoisonError::into_inner).clone()
}

fn note(times: &Shared, sequence: u64, sent_ns: i64) {
    times.lock().unwrap_or_else(PoisonError::into_inner).add_numbered(sequence, sent_ns);
}

fn stamped(sequence: u64) -> FrameAck {
    FrameAck { sequence, stamp_ns: now_ns(), ..FrameAck::sample() }
}

/// The drone's end: sends in the way of the vehicle's state, and receives in the way of detections.
pub(crate) async fn beacon(node: &Node) -> anyhow::Result<Shared> {
    let sender = node.publisher(topic::FRAME_ACK, &[DRONE]).await?;
    let subscriber = node.subscriber(topic::FRAME_ACK, &[GROUND]).await?;
    let back = Shared::default();
    tokio::spawn(async move {
        let mut ticks = interval(PERIOD);
        for sequence in 0.. {
            ticks.tick().await;
            sender.publish(&stamped(sequence)).await;
        }
    });
    let times = Arc::clone(&back);
    tokio::spawn(async move {
        while let Some(message) = subscriber.next().await {
            note(&times, message.sequence, message.stamp_ns);
        }
    });
    Ok(back)
}

/// The drone's end in place of a controller: packets of MAVLink, and commands are answered.
pub(crate) async fn controller(node: &Node) -> anyhow::Result<()> {
    let packets = node.publisher(topic::FROM_AUTOPILOT, &[]).await?;
    let commands = node.commands(topic::COMMAND, &[]).await?;
    tokio::spawn(async move {
        let mut ticks = interval(PERIOD);
        for sequence in 0_u64.. {
            ticks.tick().await;
            let packet = [sequence.to_le_bytes(), now_ns().to_le_bytes()].concat();
            packets.publish(&MavlinkBytes { packet }).await;
        }
    });
    tokio::spawn(async move {
        while let Some(request) = commands.next().await {
            request.answer(&CommandReply { accepted: true, reason: String::new() }).await;
        }
    });
    Ok(())
}

/// The ground's end, a process of its own; prints its measurements.
pub(crate) async fn run(address: &str, seconds: f64, commands: bool) -> anyhow::Result<Value> {
    let identity = Identity { service: "alight", instance: "probe".into() };
    let node = Node::open(identity, &ground_network(address).source("alight")?).await?;
    let until = Instant::now() + Duration::from_secs_f64(seconds);
    let sender = node.publisher(topic::FRAME_ACK, &[GROUND]).await?;
    let states = node.subscriber(topic::FRAME_ACK, &[DRONE]).await?;
    let packets = node.subscriber(topic::FROM_AUTOPILOT, &[]).await?;
    let frames = node.frame_subscriber(topic::JPEG, &["probe"]).await?;
    let (mut state, mut mavlink, mut frame) = <(Times, Times, Times)>::default();
    let asking = commands.then(|| tokio::spawn(ask(node.clone(), until)));
    let mut ticks = interval(PERIOD);
    let mut sequence = 0;
    loop {
        tokio::select! {
            () = tokio::time::sleep_until(until) => break,
            _ = ticks.tick() => {
                sender.publish(&stamped(sequence)).await;
                sequence += 1;
            }
            Some(message) = states.next() => state.add_numbered(message.sequence, message.stamp_ns),
            Some(message) = packets.next() => {
                if let ([sequence, sent_ns], []) = message.packet.as_chunks::<8>() {
                    let sent_ns = i64::from_le_bytes(*sent_ns);
                    mavlink.add_numbered(u64::from_le_bytes(*sequence), sent_ns);
                }
            }
            Some(it) = frames.next() => frame.add_numbered(it.header.sequence, it.header.stamp_ns),
        }
    }
    let (commands, unanswered) = match asking {
        Some(asking) => asking.await?,
        None => Default::default(),
    };
    node.close().await;
    let mut commands = commands.report();
    commands["lost"] = json!(unanswered);
    Ok(json!({
        "state": state.report(), "mavlink": mavlink.report(), "frames": frame.report(),
        "commands": commands,
    }))
}

/// Sends queries repeatedly; the times of the answers, and the number of missing ones.
async fn ask(node: Node, until: Instant) -> (Times, u64) {
    let (mut times, mut unanswered) = (Times::default(), 0);
    let mut ticks = interval(COMMAND_PERIOD);
    while Instant::now() < until {
        ticks.tick().await;
        let asked_ns = now_ns();
        match node.command(topic::COMMAND, &[], &ControllerCommand::Hold).await {
            Ok(_) => times.add((now_ns() - asked_ns) as f64 * 1e-6),
            // Before the first answer both ends may not have met.
            Err(_) if times.ms.is_empty() => {}
            Err(_) => unanswered += 1,
        }
    }
    (times, unanswered)
}
