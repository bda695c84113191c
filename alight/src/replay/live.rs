//! `alight replay --live`: publishes a recording's messages and frames on the network again, each when it is due and with stamps
//! of now, and shows their services as ready.

use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use flightlog::{Begin, Entry, Received, is_state};
use messages::{Delivery, FrameHeader, Row, TOPICS, topic};
use node::{Announcement, FramePublisher, Node, Publisher, clock_name, now_ns};
use replay::Restamp;
use tokio::sync::mpsc;
use tokio::time::sleep;

use crate::args::NetworkArgs;
use crate::runtime::with_node;
use crate::terminal::{print, write_error};

/// The services whose messages are published. Services that watch or relay are running themselves.
const PLAYED: [&str; 4] = ["camera-pub", "simulator", "detector", "controller"];
/// Maximum number of messages that were read and are not due yet.
const MAX_READ_AHEAD: usize = 64;
/// Pauses before each look for services that run: a new session receives their announcements one by one.
const LOOKS: [Duration; 4] = [
    Duration::from_millis(200),
    Duration::from_millis(500),
    Duration::from_millis(1000),
    Duration::from_millis(1500),
];
/// Time for subscribers to be found before the first message.
const BEGIN: Duration = Duration::from_millis(500);
/// A service is shown as ready for this time after its last health report, which comes every second.
const ALIVE_NS: i64 = 1_500_000_000;

/// A message or a frame to publish.
enum Item {
    Message { key: String, payload: Vec<u8> },
    Frame { header: FrameHeader, pixels: Vec<u8> },
}

/// A message and when it is due.
struct Due {
    at_ns: i64,
    item: Item,
}

/// A service and its instance.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Name {
    service: String,
    instance: String,
}

impl Name {
    /// The service whose health is published on a key.
    fn of_health(key: &str) -> Option<Self> {
        match key.split('/').collect::<Vec<_>>().as_slice() {
            ["health", service, instance] => {
                Some(Self { service: (*service).to_owned(), instance: (*instance).to_owned() })
            }
            _ => None,
        }
    }
}

/// The facts about a recording that are needed before it is published.
#[derive(Default)]
struct Overview {
    /// When the first published message was received that is no earlier state, in nanoseconds.
    first_ns: Option<i64>,
    last_ns: i64,
    /// The name of the recorder's clock.
    clock: Option<String>,
    /// When the last health report of each service and instance came.
    services: BTreeMap<Name, i64>,
    /// The unreadable parts of it, as sentences.
    damage: Vec<String>,
}

/// The topic of a key, if it is published again. Messages to the autopilot never are, nor statuses of the recorder or of the ground
/// stations at that time.
fn played(key: &str, without: &[String]) -> Option<&'static Row> {
    let is_same = |row: &&Row| {
        let mut wanted = row.key.split('/');
        let same = key
            .split('/')
            .all(|part| wanted.next().is_some_and(|it| it.starts_with('{') || it == part));
        same && wanted.next().is_none()
    };
    let row = TOPICS.iter().find(is_same)?;
    let never = [
        topic::TO_AUTOPILOT.key(&[]),
        topic::TAPE.key(&[]),
        topic::RECORDER_STATUS.key(&["{recorder}"]),
        topic::GCS_STATUS.key(&[]),
    ];
    if row.delivery == Delivery::Query || never.iter().any(|it| it == row.key) {
        return None;
    }
    let of_service = topic::HEALTH.first_name(key).or(topic::CONFIGURATION.first_name(key));
    let is_left_out = match of_service {
        Some(service) => !is_played(service, without),
        None => row.publishers.iter().any(|it| without.iter().any(|other| other == it)),
    };
    (!is_left_out).then_some(row)
}

fn is_played(service: &str, without: &[String]) -> bool {
    PLAYED.contains(&service) && !without.iter().any(|it| it == service)
}

/// Publishes a recording, in several files or one, at the pace at which it was recorded: a failure where something of it cannot be
/// read.
pub(crate) fn run(
    files: Vec<Vec<u8>>,
    without: &[String],
    network: &NetworkArgs,
) -> anyhow::Result<ExitCode> {
    let (files, overview) = in_order(files, without)?;
    overview.damage.iter().for_each(|damage| write_error(damage));
    let first_ns = overview.first_ns.context("nothing in the recording is to be published")?;
    let is_complete = overview.damage.is_empty();
    let unreadable = with_node(network, "replay", async |node| {
        for pause in LOOKS {
            sleep(pause).await;
            refuse_duplicates(node, &overview).await?;
        }
        let mut player = Player::new(node, without.to_vec());
        sleep(BEGIN).await;
        let length_s = overview.last_ns.saturating_sub(first_ns) as f64 * 1e-9;
        write_error(&format!("publishing {length_s:.0} s of flight; Ctrl-C ends it"));
        let mut restamp =
            Restamp::new(first_ns, now_ns(), clock_name()).recorded_by(overview.clock.as_deref());
        let alive: BTreeMap<_, _> = overview
            .services
            .into_iter()
            .map(|(name, last_ns)| (name, restamp.due_ns(last_ns).saturating_add(ALIVE_NS)))
            .collect();
        let (sender, receiver) = mpsc::channel(MAX_READ_AHEAD);
        let left_out = without.to_vec();
        let reading =
            tokio::task::spawn_blocking(move || read_all(&files, &left_out, &mut restamp, &sender));
        tokio::select! {
            played = player.play(receiver, alive) => played?,
            interrupted = tokio::signal::ctrl_c() => interrupted?,
        }
        // A channel without its receiver ends it.
        let unreadable = reading.await?;
        player.print_totals()?;
        Ok(unreadable)
    })?;
    if unreadable > 0 {
        write_error(&format!("{unreadable} pictures cannot be read, and were left out"));
    }
    Ok(if is_complete && unreadable == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The files of a recording in the order in which they were written, and their common overview.
fn in_order(files: Vec<Vec<u8>>, without: &[String]) -> anyhow::Result<(Vec<Vec<u8>>, Overview)> {
    let mut all = Overview::default();
    let mut parts = Vec::new();
    for file in files {
        let (begin, part) = overview(&file, without)?;
        all.first_ns = all.first_ns.into_iter().chain(part.first_ns).min();
        all.last_ns = all.last_ns.max(part.last_ns);
        all.clock = all.clock.or(part.clock);
        all.damage.extend(part.damage);
        for (name, last_ns) in part.services {
            let newest_ns = all.services.entry(name).or_insert(last_ns);
            *newest_ns = last_ns.max(*newest_ns);
        }
        parts.push((begin, file));
    }
    parts.sort_by_key(|(begin, _)| *begin);
    Ok((parts.into_iter().map(|(_, file)| file).collect(), all))
}

/// The begin of a file, and its overview.
fn overview(file: &[u8], without: &[String]) -> anyhow::Result<(Begin, Overview)> {
    let (mut begin, mut overview) = (Begin::default(), Overview::default());
    let reading = flightlog::read(file, |entry| {
        let message = match entry {
            Entry::Message(message) => message,
            Entry::About(facts) => {
                overview.clock = facts.get("clock").cloned();
                return;
            }
            _ => return,
        };
        begin.take(message);
        let Received { key, received_ns, .. } = message;
        if played(key, without).is_none() {
            return;
        }
        if overview.first_ns.is_none() && !is_state(key) {
            overview.first_ns = Some(received_ns);
        }
        overview.last_ns = overview.last_ns.max(received_ns);
        if let Some(name) = Name::of_health(key) {
            overview.services.insert(name, received_ns);
        }
    })?;
    overview.damage = reading.damage;
    Ok((begin, overview))
}

/// Refuses services that run already: a flying controller must not be mistaken for one of a recording, nor the other way round.
async fn refuse_duplicates(node: &Node, overview: &Overview) -> anyhow::Result<()> {
    let running = node.list_peers().await?;
    let services: BTreeSet<&str> =
        overview.services.keys().map(|name| name.service.as_str()).collect();
    let doubled: Vec<String> = running
        .into_iter()
        .map(|(service, instance)| Name { service, instance })
        .filter(|name| {
            // Detectors may be several, of other names.
            let is_other = name.service != "detector" && services.contains(name.service.as_str());
            is_other || overview.services.contains_key(name)
        })
        .map(|Name { service, instance }| format!("{service} `{instance}`"))
        .collect();
    if doubled.is_empty() {
        return Ok(());
    }
    bail!(
        "{} run here, and the recording has messages of the same; stop them, leave them out of the recording with `--without SERVICE`, or name another vehicle with `--vehicle`",
        doubled.join(", ")
    );
}

/// Reads the recording as far ahead as there is room, until the receiver is closed. The result is the number of pictures that could not be
/// read.
fn read_all(
    files: &[Vec<u8>],
    without: &[String],
    restamp: &mut Restamp,
    due: &mpsc::Sender<Due>,
) -> usize {
    let mut unreadable = 0;
    for file in files {
        // It was read before, with its damage.
        let _ = flightlog::read(file, |entry| {
            if due.is_closed() {
                return;
            }
            let next = match entry {
                Entry::Message(message) if is_message(message.key, without) => {
                    let (key, payload) = (message.key.to_owned(), restamp.payload(message));
                    let at_ns = restamp.due_ns(message.received_ns);
                    Some(Due { at_ns, item: Item::Message { key, payload } })
                }
                Entry::Picture { header, bytes, received_ns }
                    if played(&topic::FRAME.key(&[&header.camera]), without).is_some() =>
                {
                    let at_ns = restamp.due_ns(received_ns);
                    let frame = restamp.frame(&header, bytes, received_ns);
                    unreadable += usize::from(frame.is_none());
                    frame
                        .map(|(header, pixels)| Due { at_ns, item: Item::Frame { header, pixels } })
                }
                _ => None,
            };
            if let Some(next) = next {
                // Its receiver may have ended.
                drop(due.blocking_send(next));
            }
        });
    }
    unreadable
}

/// Whether a message is published as it is: one with an attachment is a frame, whose pixels follow.
fn is_message(key: &str, without: &[String]) -> bool {
    played(key, without).is_some() && topic::FRAME.first_name(key).is_none()
}

/// Publishes the messages and frames that are due.
struct Player<'a> {
    node: &'a Node,
    without: Vec<String>,
    publishers: BTreeMap<String, Publisher<Vec<u8>>>,
    cameras: BTreeMap<String, FramePublisher>,
    alive: BTreeMap<Name, Announcement>,
    messages: u64,
    frames: u64,
    latest: Duration,
}

impl<'a> Player<'a> {
    fn new(node: &'a Node, without: Vec<String>) -> Self {
        Self {
            node,
            without,
            publishers: BTreeMap::new(),
            cameras: BTreeMap::new(),
            alive: BTreeMap::new(),
            messages: 0,
            frames: 0,
            latest: Duration::ZERO,
        }
    }

    async fn play(
        &mut self,
        mut due: mpsc::Receiver<Due>,
        alive: BTreeMap<Name, i64>,
    ) -> anyhow::Result<()> {
        while let Some(Due { at_ns, item }) = due.recv().await {
            let early_ns = at_ns.saturating_sub(now_ns());
            if early_ns > 0 {
                sleep(Duration::from_nanos(early_ns.unsigned_abs())).await;
            }
            match item {
                Item::Message { key, payload } => {
                    // An earlier state has no due time.
                    if !self.is_state(&key) {
                        let late_ns = now_ns().saturating_sub(at_ns).max(0);
                        self.latest = self.latest.max(Duration::from_nanos(late_ns.unsigned_abs()));
                    }
                    self.show_alive(&key).await?;
                    self.message(&key, payload).await?;
                }
                Item::Frame { header, pixels } => self.frame(&header, &pixels).await?,
            }
            let now = now_ns();
            self.alive.retain(|name, _| alive.get(name).is_some_and(|until_ns| now < *until_ns));
        }
        Ok(())
    }

    fn is_state(&self, key: &str) -> bool {
        played(key, &self.without).is_some_and(|row| row.delivery == Delivery::LastValue)
    }

    /// Shows a service as ready from its first health report on.
    async fn show_alive(&mut self, key: &str) -> anyhow::Result<()> {
        if let Some(name) = Name::of_health(key)
            && !self.alive.contains_key(&name)
        {
            let announcement = self.node.announce_other(&name.service, &name.instance).await?;
            self.alive.insert(name, announcement);
        }
        Ok(())
    }

    async fn message(&mut self, key: &str, payload: Vec<u8>) -> anyhow::Result<()> {
        if !self.publishers.contains_key(key) {
            let row = played(key, &self.without).context("a topic")?;
            let publisher = self.node.encoded_publisher(row, key).await?;
            self.publishers.insert(key.to_owned(), publisher);
        }
        if let Some(publisher) = self.publishers.get(key) {
            publisher.publish_encoded(payload).await;
            self.messages += 1;
        }
        Ok(())
    }

    async fn frame(&mut self, header: &FrameHeader, pixels: &[u8]) -> anyhow::Result<()> {
        let camera = header.camera.as_str();
        if !self.cameras.contains_key(camera) {
            let publisher =
                self.node.frame_publisher(topic::FRAME, &[camera], pixels.len()).await?;
            self.cameras.insert(camera.to_owned(), publisher);
        }
        if let Some(publisher) = self.cameras.get(camera) {
            let mut loan = publisher.loan(pixels.len());
            loan.copy_from_slice(pixels);
            publisher.publish(header, loan).await;
            self.frames += 1;
        }
        Ok(())
    }

    fn print_totals(&self) -> anyhow::Result<()> {
        print(&format!(
            "published {} messages and {} frames, at most {:.0} ms late",
            self.messages,
            self.frames,
            self.latest.as_secs_f64() * 1e3
        ))?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_goes_to_an_autopilot_again_and_services_are_left_out() {
        for key in ["mavlink/to-autopilot", "controller/tape", "recorder/main/status", "gcs/status"]
        {
            assert!(played(key, &[]).is_none(), "{key}");
        }
        for key in ["controller/command", "health/gcs-bridge/main", "config/dashboard/main", "?"] {
            assert!(played(key, &[]).is_none(), "{key}");
        }
        let keys = [
            "controller/status",
            "health/controller/main",
            "config/controller/main",
            "vehicle/state",
            "mavlink/from-autopilot",
        ];
        let without = ["controller".to_owned()];
        for key in keys {
            assert!(played(key, &[]).is_some() && played(key, &without).is_none(), "{key}");
        }
        assert!(played("detector/main/detections", &without).is_some());
        assert!(played("camera/down/frame", &without).is_some());
    }

    /// A recording of a JPEG picture with these bytes, in a chunk of its own, and of another chunk.
    fn recording(jpeg: &[u8]) -> Vec<u8> {
        let mut recording = Vec::new();
        let about = flightlog::About::default();
        let mut writer = flightlog::Writer::new(&mut recording, &about).unwrap();
        let header = FrameHeader::sample();
        let key = topic::FRAME.key(&[&header.camera]);
        let attachment = messages::encode(&header);
        let message = Received { key: &key, payload: b"", attachment: &attachment, received_ns: 9 };
        let picture = flightlog::Picture::Jpeg(jpeg.to_vec());
        writer.frame(message, &header, &picture).unwrap();
        writer.flush().unwrap();
        let wind =
            messages::encode(&messages::Wind { stamp_ns: 9, velocity_ned_m_s: [1.0, 0.0, 0.0] });
        let key = topic::WIND.key(&[]);
        writer
            .receive(Received { key: &key, payload: &wind, attachment: b"", received_ns: 10 })
            .unwrap();
        writer.finish().unwrap();
        recording
    }

    #[test]
    fn unreadable_pictures_are_counted() {
        let mut file = recording(b"no JPEG file");
        let (_, overview) = in_order(vec![file.clone()], &[]).unwrap();
        assert!(overview.damage.is_empty(), "{:?}", overview.damage);
        let (due, mut published) = mpsc::channel(9);
        let mut restamp = Restamp::new(9, 9, "here");
        assert_eq!(read_all(&[file.clone()], &[], &mut restamp, &due), 1);
        drop(due);
        let item = published.try_recv().map(|due| due.item);
        assert!(matches!(item, Ok(Item::Message { key, .. }) if key == "wind"));
        // A byte of the first chunk.
        let place = file.windows(4).position(|it| it == b"no J").unwrap();
        file[place] ^= 1;
        let (_, overview) = in_order(vec![file], &[]).unwrap();
        assert!(!overview.damage.is_empty());
    }
}
