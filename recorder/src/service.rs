//! The recorder's service: writes messages and frames of the topics to a recording and, when that is full or fails, to the next one,
//! offers them to viewers, and counts recorded, lost and never received messages by key.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, bail, ensure};
use flightlog::About;
use messages::{
    Delivery, FrameHeader, OTHER_KEYS, RecorderCount, RecorderStatus, Row, TOPICS, has_never_come,
    topic,
};
use node::{BoxFuture, HealthCounters, Node, Shutdown, Tap, Tapped, now_ns};

use crate::alone::Alone;
use crate::config::{Config, Frames};
use crate::frame::{Frame, Pictures, header, received};
use crate::live::Live;
use crate::name::named;
use crate::recording::{Ending, Recording};
use crate::unseen::Unseen;

/// Longest wait for a message, after which the file is looked after.
const MAX_WAIT: Duration = Duration::from_millis(50);
/// Period in which the file is maintained while messages are received.
const LOOK_PERIOD: Duration = Duration::from_millis(20);
/// Pause after a file that could not be opened or written, before another one is tried.
const RETRY_PAUSE: Duration = Duration::from_secs(2);
/// A disk that takes nothing for this time is reported.
const STALLED: Duration = Duration::from_secs(1);
/// Time for the last messages of others that end at the same time, as a controller does that puts parameters back.
const LAST_MESSAGES: Duration = Duration::from_millis(600);
/// Time in which the messages are written that were received before that and still wait.
const CATCH_UP: Duration = Duration::from_millis(200);
/// Time from the last messages on in which the disk is to have the rest; `alight land` kills after 4 s.
const END_TIMEOUT: Duration = Duration::from_millis(1100);
/// A change of the clock of UTC that is noted in the file, in nanoseconds; corrections of NTP are smaller.
const TIME_SET_NS: i64 = 100_000_000;
/// Minimum time between two statuses.
const MIN_STATUS_PERIOD: Duration = Duration::from_millis(500);
/// Maximum time between two statuses, between which only messages and bytes are counted.
const MAX_STATUS_PERIOD: Duration = Duration::from_secs(2);
/// Maximum number of keys whose last values are remembered.
const MAX_STATES: usize = 1024;

/// Records until shutdown. A disk that fails does not end it: the failure is reported, lost messages are counted, and another file is
/// tried.
///
/// # Errors
/// When another recorder has this name, the address for viewers is taken and there is no file, the network session cannot be used, a
/// file could not be ended, or received messages are in no file.
pub fn run(
    node: Node,
    config: Config,
    shutdown: Shutdown,
) -> BoxFuture<'static, anyhow::Result<()>> {
    Box::pin(run_service(node, config, shutdown))
}

async fn run_service(node: Node, config: Config, shutdown: Shutdown) -> anyhow::Result<()> {
    node.claim_unique_name(&config.id).await?;
    let frames = node::named(&config.frames).map_err(anyhow::Error::msg)?;
    let has_file = config.has_file();
    let requested = TOPICS.iter().copied().filter(|row| is_wanted(row, frames, has_file));
    let requested: Vec<Row> = requested.collect();
    let live = Live::listen(&node, &config).await?;
    let max_waiting_bytes = config.max_waiting_mb as usize * 1_000_000 / 2;
    let tap = node.tap(&requested, max_waiting_bytes).await?;
    let publisher = node.publisher(topic::RECORDER_STATUS, &[&config.id]).await?;
    node.announce().await?;
    let status = RecorderStatus { recorder: config.id.clone(), ..RecorderStatus::default() };
    let status = Arc::new(Mutex::new(status));
    let alone = Arc::new(Alone::new(&node, &config.id, has_file));
    let recorder = Recorder {
        alone: Some(Arc::clone(&alone)),
        live,
        health: node.shared_health(),
        status: Arc::clone(&status),
        utc_offset_ns: utc_offset_ns(),
        ..Recorder::new(config, frames, max_waiting_bytes, about(&node))
    };
    let is_over = Arc::new(AtomicBool::new(false));
    let stop = Arc::clone(&is_over);
    let thread = std::thread::Builder::new()
        .name("recorder".to_owned())
        .spawn(move || recorder.run(&tap, &stop))
        .context("starting the thread of the recorder")?;
    let mut due = tokio::time::interval(MIN_STATUS_PERIOD);
    let mut published = None;
    let mut is_warned = false;
    loop {
        tokio::select! {
            _ = due.tick() => {
                if !is_warned && let Some(warning) = alone.warning_in_time() {
                    tracing::warn!("{warning}");
                    is_warned = true;
                }
                let now = {
                    let now = status.lock().unwrap_or_else(PoisonError::into_inner);
                    is_due(published.as_ref(), &now, now_ns()).then(|| now.clone())
                };
                if let Some(now) = now {
                    let now = RecorderStatus { stamp_ns: now_ns(), ..now };
                    publisher.publish(&now).await;
                    published = Some(now);
                }
                ensure!(!thread.is_finished(), "the thread of the recorder ended; see the log above");
            }
            () = shutdown.requested() => break,
        }
    }
    is_over.store(true, Ordering::Relaxed);
    let ended = tokio::task::spawn_blocking(move || thread.join()).await?;
    // With the last messages and the end of the file.
    let last = status.lock().unwrap_or_else(PoisonError::into_inner).clone();
    publisher.publish(&RecorderStatus { stamp_ns: now_ns(), ..last }).await;
    if let Some(warning) = alone.warning() {
        tracing::warn!("{warning}");
    }
    ended.unwrap_or_else(|_panic| bail!("the thread of the recorder panicked"))
}

/// Whether a status is published, after the last one: at once when something but the numbers of messages and bytes has changed.
fn is_due(last: Option<&RecorderStatus>, now: &RecorderStatus, now_ns: i64) -> bool {
    let Some(last) = last else { return true };
    // A tick is a little early or late.
    let max_ns = (MAX_STATUS_PERIOD - MIN_STATUS_PERIOD / 2).as_nanos();
    u128::from(now_ns.abs_diff(last.stamp_ns)) >= max_ns
        || last.problem != now.problem
        || last.file != now.file
        || last.dropped != now.dropped
        || last.free_bytes.is_some() != now.free_bytes.is_some()
}

/// Whether a topic is subscribed to. JPEG and rectified frames, a detector's refusals and its debug images are made only while
/// a client subscribes, and would cost their publishers time. The tape, of which a controller sends each new client the last ten minutes,
/// is of use in a file only.
fn is_wanted(row: &Row, frames: Frames, has_file: bool) -> bool {
    let is_tape = row.key == topic::TAPE.key(&[]);
    let is_frame = row.key == topic::FRAME.key(&["{camera}"]);
    let is_made_on_demand = [
        topic::JPEG.key(&["{camera}"]),
        topic::RECT.key(&["{camera}"]),
        topic::REFUSALS.key(&["{detector}"]),
        topic::DEBUG_IMAGE.key(&["{detector}", "{image}"]),
    ];
    row.delivery != Delivery::Query
        && (has_file || !is_tape)
        && !is_made_on_demand.iter().any(|key| key == row.key)
        && (frames != Frames::None || !is_frame)
}

/// Time since 1970 less that of the clock of this host, in nanoseconds; it changes when the time is set.
fn utc_offset_ns() -> i64 {
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH);
    since_1970.map_or(0, |it| i64::try_from(it.as_nanos()).unwrap_or(0)) - now_ns()
}

fn about(node: &Node) -> About {
    let facts = [
        ("vehicle".to_owned(), node.vehicle().to_owned()),
        ("recorder".to_owned(), node.identity().instance.clone()),
        ("host".to_owned(), node::host_name()),
        ("clock".to_owned(), node::clock_name().to_owned()),
        // Names the run of this process, since whose start losses are counted.
        ("run".to_owned(), format!("{}-{}", std::process::id(), now_ns())),
    ];
    About {
        program: format!("alight {}", node::version()),
        facts: facts.into(),
        utc_offset_ns: utc_offset_ns(),
    }
}

/// The thread's state.
struct Recorder {
    config: Config,
    pictures: Pictures,
    /// The viewers, where they are served.
    live: Option<Live>,
    /// Bytes that may wait for the disk; as many may wait before they are handled.
    max_waiting_bytes: usize,
    about: About,
    /// `None` in tests.
    alone: Option<Arc<Alone>>,
    health: Arc<HealthCounters>,
    status: Arc<Mutex<RecorderStatus>>,
    /// Time since 1970 less that of the clock of this host when it was looked at last, in nanoseconds.
    utc_offset_ns: i64,
    recording: Option<Recording>,
    /// The file before, while the disk takes its rest.
    ending: Option<Ending>,
    /// Why an earlier file lacks its end.
    end_problem: Option<String>,
    /// When a file that failed is tried again.
    retry: Option<Instant>,
    /// Messages that were kept.
    kept: Counts,
    /// Frames that were never received.
    unseen: Unseen,
    /// Messages that were lost.
    lost: Counts,
    /// How many of them the file states.
    lost_in_file: Option<u64>,
    /// When the messages by key were last put into the status: this thread looks after the file far more often than a status is due.
    listed: Option<Instant>,
    /// The last value of each state: every file begins with them.
    states: BTreeMap<String, Tapped>,
}

/// The end of the time in which messages are still taken.
#[derive(Clone, Copy)]
struct Last {
    at: Instant,
    /// The same by the clock of the messages, in nanoseconds.
    at_ns: i64,
}

impl Last {
    fn from_now() -> Self {
        let after_ns = i64::try_from(LAST_MESSAGES.as_nanos()).unwrap_or(i64::MAX);
        Self { at: Instant::now() + LAST_MESSAGES, at_ns: now_ns().saturating_add(after_ns) }
    }

    /// Whether a message was received in that time: other processes may publish without end.
    fn has(self, message: &Tapped) -> bool {
        message.received_ns <= self.at_ns
    }
}

/// Numbers of messages by key; of the first keys, as many as a status may have, and of all others together.
#[derive(Debug, Default)]
struct Counts(BTreeMap<String, u64>);

impl Counts {
    fn add(&mut self, key: &str, count: u64) {
        if let Some(so_far) = self.0.get_mut(key) {
            *so_far += count;
            return;
        }
        // The last place is for the others.
        let is_new = self.0.len() + 1 < RecorderStatus::MAX_KEYS;
        *self.0.entry(if is_new { key } else { OTHER_KEYS }.to_owned()).or_default() += count;
    }

    fn take_back(&mut self, key: &str, count: u64) {
        let key = if self.0.contains_key(key) { key } else { OTHER_KEYS };
        if let Some(so_far) = self.0.get_mut(key) {
            *so_far = so_far.saturating_sub(count);
        }
    }

    fn total(&self) -> u64 {
        self.0.values().sum()
    }

    fn list(&self) -> Vec<RecorderCount> {
        let counts = self.0.iter().map(|(key, count)| (key.clone(), *count));
        counts.map(|(key, count)| RecorderCount { key, count }).collect()
    }
}

impl Recorder {
    /// One that has no file yet, and serves no viewer.
    fn new(config: Config, frames: Frames, max_waiting_bytes: usize, about: About) -> Self {
        Self {
            pictures: Pictures::new(&config, frames),
            live: None,
            max_waiting_bytes,
            about,
            alone: None,
            health: Arc::default(),
            status: Arc::default(),
            config,
            utc_offset_ns: 0,
            recording: None,
            ending: None,
            end_problem: None,
            retry: None,
            kept: Counts::default(),
            unseen: Unseen::default(),
            lost: Counts::default(),
            lost_in_file: None,
            listed: None,
            states: BTreeMap::new(),
        }
    }

    fn run(mut self, tap: &Tap, is_over: &AtomicBool) -> anyhow::Result<()> {
        // Before the first message, which would be lost without a file.
        self.look_after_file();
        let mut looked = Instant::now();
        let mut last = None;
        loop {
            let is_last = is_over.load(Ordering::Relaxed);
            if is_last {
                last.get_or_insert_with(Last::from_now);
            }
            let message = tap.next(MAX_WAIT);
            let message = message.filter(|it| last.is_none_or(|last| last.has(it)));
            let is_empty = message.is_none();
            if let Some(message) = message {
                self.take(message);
            }
            if is_empty || looked.elapsed() >= LOOK_PERIOD {
                looked = Instant::now();
                self.count_dropped(tap);
                self.look_after_file();
            }
            // Those that still wait and were received in time are behind it in the queue.
            let wait = if is_empty { Duration::ZERO } else { CATCH_UP };
            if let Some(last) = last.filter(|last| Instant::now() >= last.at + wait) {
                while let Some(message) = tap.next(Duration::ZERO) {
                    if last.has(&message) {
                        self.take_number(&message);
                        self.lost.add(&message.key, 1);
                    }
                }
                self.count_dropped(tap);
                return self.end(last.at + END_TIMEOUT);
            }
        }
    }

    fn count_dropped(&mut self, tap: &Tap) {
        for (key, count) in tap.take_dropped() {
            self.unseen.dropped(&key, count);
            self.lost.add(&key, count);
        }
        for (key, count) in self.unseen.more() {
            self.health.dropped_times("frames that never came", count);
            self.lost.add(&key, count);
        }
    }

    /// The header of a frame, whose number is looked at; `None` for any other message.
    fn take_number(&mut self, message: &Tapped) -> Option<FrameHeader> {
        let header = header(message)?;
        let camera = &header.camera;
        if self.unseen.take(&message.key, &header)
            && self.health.failed(&format!("two publishers of camera `{camera}`"))
        {
            tracing::warn!(
                key = message.key,
                "Two publishers of one camera, by the sequence numbers or clocks of its frames: end one of them, or give each camera its \
                 own name (`id`)"
            );
        }
        Some(header)
    }

    /// Records a message, or counts it as lost; offers it to the viewers.
    fn take(&mut self, message: Tapped) {
        if let Some(alone) = &self.alone {
            alone.take(&message.key);
        }
        let header = self.take_number(&message);
        let before_bytes = self.ending_bytes();
        let waiting_bytes = self.recording.as_ref().map(|it| it.status().waiting_bytes);
        let has_room =
            waiting_bytes.is_some_and(|bytes| bytes + before_bytes <= self.max_waiting_bytes);
        let is_followed = self
            .live
            .as_mut()
            .is_some_and(|live| live.is_followed(utc_offset_ns, self.states.values()));
        let is_wanted = has_room || is_followed;
        let header = header.filter(|_| is_wanted);
        let frame = header.map(|header| self.pictures.frame(&message, header));
        if let Some(recording) = self.recording.as_mut().filter(|_| has_room) {
            match keep(recording, &message, frame.as_ref()) {
                Ok(()) => {
                    recording.count(&message.key);
                    self.kept.add(&message.key, 1);
                    self.health.count("messages");
                }
                Err(error) => self.give_up(&format!("{error:#}")),
            }
        } else if self.config.has_file() {
            let is_slow = self.recording.is_some();
            self.health.dropped(if is_slow { "the disk is too slow" } else { "no file" });
            self.lost.add(&message.key, 1);
        }
        if frame.as_ref().is_some_and(|frame| !frame.is_complete) {
            self.health.dropped("a picture that is no complete image");
        }
        if let Some(live) = self.live.as_mut().filter(|_| is_followed) {
            live.take(&message, frame.as_ref());
        }
        if message.is_state
            && (self.states.len() < MAX_STATES || self.states.contains_key(&message.key))
        {
            self.states.insert(message.key.clone(), message);
        }
    }

    /// The bytes of the previous file that still wait.
    fn ending_bytes(&self) -> usize {
        self.ending.as_ref().map_or(0, |ending| ending.status().waiting_bytes)
    }

    /// Opens, flushes, ends and replaces the file, and publishes its state.
    fn look_after_file(&mut self) {
        if let Some(live) = &mut self.live
            && live.is_followed(utc_offset_ns, self.states.values())
        {
            live.report_lost(&self.lost.0);
        }
        if self.config.has_file() {
            self.write_file();
        }
        if self.listed.is_none_or(|listed| listed.elapsed() >= MIN_STATUS_PERIOD) {
            self.listed = Some(Instant::now());
            let (kept, dropped) = (self.kept.list(), self.lost.list());
            let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
            (status.kept, status.dropped) = (kept, dropped);
        }
    }

    fn write_file(&mut self) {
        match self.write_out() {
            Ok(()) => {}
            Err(error) => self.give_up(&format!("{error:#}")),
        }
        if let Some(ended) = self.ending.take_if(|ending| ending.status().has_ended) {
            let problem = ended.status().problem;
            self.count_unsynced(ended.unsynced());
            if let Some(problem) = problem {
                self.health.failed("the file failed");
                tracing::error!(problem, "The end of a recording is missing");
                self.end_problem = Some(format!("the end of a recording is missing: {problem}"));
            }
        }
        // At last, so that a full file is followed by the next before another message is received.
        let is_due = self.retry.is_none_or(|retry| Instant::now() >= retry);
        if self.recording.is_none() && is_due {
            match self.begin() {
                Ok(recording) => self.recording = Some(recording),
                Err(error) => self.give_up(&format!("{error:#}")),
            }
        }
    }

    /// Messages that were recorded and are not on the disk are lost.
    fn count_unsynced(&mut self, unsynced: BTreeMap<String, u64>) {
        for (key, count) in unsynced {
            self.kept.take_back(&key, count);
            self.lost.add(&key, count);
        }
    }

    fn begin(&mut self) -> anyhow::Result<Recording> {
        // The clock of a computer without a battery is set once it has found the time.
        self.about.utc_offset_ns = utc_offset_ns();
        self.utc_offset_ns = self.about.utc_offset_ns;
        let utc_ns = now_ns().saturating_add(self.about.utc_offset_ns);
        let mut recording = Recording::begin(named(&self.config.file, utc_ns), &self.about)?;
        for state in self.states.values() {
            recording.writer.receive(received(state))?;
        }
        self.lost_in_file = None;
        Ok(recording)
    }

    fn write_out(&mut self) -> anyhow::Result<()> {
        let before_bytes = self.ending_bytes();
        let Some(recording) = &mut self.recording else { return Ok(()) };
        let lost = self.lost.total();
        let waiting_bytes = recording.status().waiting_bytes + before_bytes;
        let has_room = waiting_bytes <= self.max_waiting_bytes;
        let utc_offset_ns = utc_offset_ns();
        if utc_offset_ns.abs_diff(self.utc_offset_ns) > TIME_SET_NS.unsigned_abs() {
            recording.writer.time_set(now_ns(), utc_offset_ns)?;
            let set_s = utc_offset_ns.saturating_sub(self.utc_offset_ns) as f64 * 1e-9;
            tracing::warn!(
                "The clock was set by {set_s:+.1} s; the times of this recording continue as they began"
            );
            self.utc_offset_ns = utc_offset_ns;
        }
        if recording.hand_over()? && has_room && self.lost_in_file != Some(lost) {
            // On the disk with the next flush; the sums of a file that is not flushed again are those of the one before.
            recording.writer.dropped(now_ns(), &self.lost.0)?;
            self.lost_in_file = Some(lost);
        }
        let disk = recording.status();
        if let Some(problem) = disk.problem {
            bail!("{problem}");
        }
        let shown = disk.path.map_or_else(String::new, |path| path.display().to_string());
        if disk.bytes > 0 && self.retry.take().is_some() {
            tracing::warn!(file = %shown, "Recording again");
        }
        let stall_s = disk.stalled.as_secs();
        let stalls = disk.stalled >= STALLED;
        let problem = stalls.then(|| format!("the disk has taken nothing for {stall_s} s"));
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        if stalls && status.problem.is_none() && self.health.failed("the disk takes nothing") {
            tracing::error!(file = %shown, "The disk takes nothing; waiting for it");
        }
        if !shown.is_empty() && status.file != shown {
            tracing::info!(file = %shown, "Recording to this file");
        }
        status.file = shown;
        status.bytes = disk.bytes;
        status.waiting_bytes = (disk.waiting_bytes + before_bytes) as u64;
        status.free_bytes = disk.free_bytes;
        if self.retry.is_none() {
            status.problem = problem.or_else(|| self.end_problem.clone());
        }
        drop(status);
        let max_bytes = u64::from(self.config.max_file_mb) * 1_000_000;
        let max_age = Duration::from_secs_f64(60.0 * self.config.max_file_minutes);
        // A second file would not be written sooner, and wait next to the first.
        if self.ending.is_none()
            && !stalls
            && recording.is_full(max_bytes, max_age)
            && let Some(full) = self.recording.take()
        {
            self.ending = Some(full.end()?);
        }
        Ok(())
    }

    /// The file failed: it stays as it is, for `alight record --repair`, and another one is tried later.
    fn give_up(&mut self, problem: &str) {
        if self.health.failed("the file failed") || self.retry.is_none() {
            tracing::error!(problem, "Not recording; trying again, and the flight continues");
        }
        let unsynced = self.recording.take().map(Recording::unsynced).unwrap_or_default();
        self.count_unsynced(unsynced);
        self.retry = Some(Instant::now() + RETRY_PAUSE);
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        status.problem = Some(problem.to_owned());
        status.file.clear();
        status.waiting_bytes = 0;
        status.free_bytes = None;
    }

    /// Ends the file, waits for the disk until then, and states the result in the status.
    fn end(mut self, until: Instant) -> anyhow::Result<()> {
        let ended = self.end_files(until);
        let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
        (status.kept, status.dropped) = (self.kept.list(), self.lost.list());
        let earlier = status.problem.take();
        status.problem = ended.as_ref().err().map(|error| earlier.unwrap_or(format!("{error:#}")));
        drop(status);
        ended?;
        // Without a file only viewers missed them, to which they were reported.
        let is_lost = |(key, _): &(&String, &u64)| self.config.has_file() && !has_never_come(key);
        let lost: Vec<_> = self.lost.0.iter().filter(is_lost).collect();
        let keys: Vec<_> = lost.iter().map(|(key, count)| format!("{count} of {key}")).collect();
        let count: u64 = lost.iter().map(|(_, count)| **count).sum();
        ensure!(
            count == 0,
            "{count} messages came and are in no file, as the recording counts them: {}",
            keys.join(", ")
        );
        Ok(())
    }

    fn end_files(&mut self, until: Instant) -> anyhow::Result<()> {
        let last = match self.recording.take() {
            Some(mut recording) => {
                recording.writer.dropped(now_ns(), &self.lost.0)?;
                Some(recording.end()?)
            }
            None => None,
        };
        let is_missing = self.config.has_file() && last.is_none() && self.ending.is_none();
        for ending in self.ending.take().into_iter().chain(last) {
            let disk = ending.wait(until.saturating_duration_since(Instant::now()));
            let mut status = self.status.lock().unwrap_or_else(PoisonError::into_inner);
            status.file =
                disk.path.as_ref().map_or_else(String::new, |it| it.display().to_string());
            (status.bytes, status.waiting_bytes) = (disk.bytes, disk.waiting_bytes as u64);
            drop(status);
            let name = disk.path.as_ref().unwrap_or(&self.config.file);
            if let Some(problem) = disk.problem {
                self.count_unsynced(ending.unsynced());
                bail!(
                    "the end of the recording is missing: {problem}; `alight record --repair` ends its file"
                );
            }
            ensure!(
                disk.has_ended,
                "the disk did not take the end of {name:?} in time; `alight record --repair` ends it"
            );
            tracing::info!(file = %name.display(), bytes = disk.bytes, messages = self.kept.total(), "Recorded");
        }
        ensure!(!is_missing, "nothing could be recorded at the end; see the log above");
        if let Some(problem) = &self.end_problem {
            bail!("{problem}");
        }
        Ok(())
    }
}

/// Writes a message: frames as configured, everything else as it was received.
fn keep(recording: &mut Recording, message: &Tapped, frame: Option<&Frame>) -> anyhow::Result<()> {
    match frame {
        Some(Frame { header, picture, .. }) => {
            recording.writer.frame(received(message), header, picture)?;
        }
        None => recording.writer.receive(received(message))?,
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use node::Layers;

    use super::*;

    /// A recorder with a file in the folder.
    fn recorder(folder: &tempfile::TempDir) -> Recorder {
        let set = vec![format!("file={:?}", folder.path().join("flight.mcap"))];
        let config = Layers { file: None, set }.load::<Config>().unwrap().settings;
        let recording = Recording::begin(config.file.clone(), &About::default()).unwrap();
        Recorder {
            recording: Some(recording),
            ..Recorder::new(config, Frames::None, 1000, About::default())
        }
    }

    /// Whether a recorder with a file has done all when it ends.
    fn ends(change: impl FnOnce(&mut Recorder)) -> Result<(), String> {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&folder);
        change(&mut recorder);
        let ended = recorder.end(Instant::now() + Duration::from_secs(20));
        ended.map_err(|error| format!("{error:#}"))
    }

    #[test]
    fn a_recorder_that_lost_messages_or_the_end_of_a_file_reports_it_at_its_end() {
        ends(|_| {}).unwrap();
        ends(|it| it.lost.add("camera/down/frame (never came)", 7)).unwrap();
        let error = ends(|it| it.lost.add("wind", 3)).unwrap_err();
        assert!(error.contains("3 messages") && error.contains("3 of wind"), "{error}");
        let error = ends(|it| it.end_problem = Some("the end is missing".to_owned())).unwrap_err();
        assert!(error.contains("the end is missing"), "{error}");
        // A recorder that only serves viewers has reported the loss to them.
        ends(|it| {
            it.lost.add("wind", 3);
            it.config.file = std::path::PathBuf::new();
        })
        .unwrap();
    }

    #[test]
    fn the_last_status_has_every_message_and_the_file_that_was_ended() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&folder);
        let status = Arc::clone(&recorder.status);
        recorder.look_after_file();
        for _ in 0..3 {
            recorder.take(Tapped { key: "wind".to_owned(), ..Tapped::default() });
        }
        recorder.lost.add("truth", 2);
        drop(recorder.end(Instant::now() + Duration::from_secs(20)));
        let status = status.lock().unwrap();
        let file = folder.path().join("flight.mcap");
        assert_eq!((status.total_kept(), status.lost()), (3, 2));
        assert_eq!(status.file, file.display().to_string());
        assert_eq!((status.bytes, status.waiting_bytes), (file.metadata().unwrap().len(), 0));
        assert_eq!(status.problem, None);
    }

    #[test]
    fn a_status_is_due_when_more_than_its_counts_has_changed_and_every_two_seconds() {
        const MS: i64 = 1_000_000;
        let last = RecorderStatus { stamp_ns: 500 * MS, ..RecorderStatus::default() };
        assert!(is_due(None, &last, 0));
        let count = vec![RecorderCount { key: "wind".into(), count: 1 }];
        let counted = RecorderStatus {
            bytes: 9,
            waiting_bytes: 9,
            kept: count.clone(),
            ..RecorderStatus::default()
        };
        let at_ms = |at_ms: i64| is_due(Some(&last), &counted, at_ms * MS);
        assert_eq!([1000, 1500, 2003, 2497, 3000].map(at_ms), [false, false, false, true, true]);
        for now in [
            RecorderStatus { problem: Some("the disk is full".into()), ..counted.clone() },
            RecorderStatus { file: "next.mcap".into(), ..counted.clone() },
            RecorderStatus { dropped: count, ..counted.clone() },
        ] {
            assert!(is_due(Some(&last), &now, 1000 * MS), "{now:?}");
        }
    }

    #[test]
    fn messages_by_key_are_listed_no_more_often_than_a_status_may_be_due() {
        let folder = tempfile::tempdir().unwrap();
        let mut recorder = recorder(&folder);
        let listed = |recorder: &Recorder| recorder.status.lock().unwrap().kept.len();
        recorder.kept.add("wind", 1);
        recorder.look_after_file();
        recorder.kept.add("truth", 1);
        // However long the machine took for the first.
        recorder.listed = Some(Instant::now() + Duration::from_secs(60));
        recorder.look_after_file();
        assert_eq!(listed(&recorder), 1);
        recorder.listed = Instant::now().checked_sub(MIN_STATUS_PERIOD);
        recorder.look_after_file();
        assert_eq!(listed(&recorder), 2);
    }

    #[test]
    fn messages_after_the_last_moment_are_not_recorded() {
        let last = Last::from_now();
        let message = |received_ns| Tapped { received_ns, ..Tapped::default() };
        assert!(last.has(&message(now_ns())) && last.has(&message(last.at_ns)));
        assert!(!last.has(&message(last.at_ns + 1)));
    }

    #[test]
    fn messages_are_counted_by_key_and_those_of_too_many_keys_together() {
        let max = RecorderStatus::MAX_KEYS;
        let mut counts = Counts::default();
        for number in 0..max + 10 {
            counts.add(&format!("key {number:05}"), 2);
        }
        counts.add("key 00000", 1);
        let list = counts.list();
        let of = |key: &str| list.iter().find(|it| it.key == key).map(|it| it.count);
        assert_eq!((list.len(), counts.total()), (max, 2 * (max as u64 + 10) + 1));
        assert_eq!((of("key 00000"), of("wind"), of(OTHER_KEYS)), (Some(3), None, Some(22)));
        counts.take_back("key 00000", 3);
        counts.take_back("wind", 1);
        assert_eq!(counts.total(), 2 * (max as u64 + 10) - 3);
        assert!(counts.list().contains(&RecorderCount { key: OTHER_KEYS.into(), count: 21 }));
    }
}
