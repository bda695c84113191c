//! Follows the controller's statuses and the detectors for a supervisor: whether a landing is under way, which it notes in a file, and
//! which detector has replaced one that exited.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use messages::{ControllerStatus, DetectorInfo, Health, Place, topic};
use node::{Network, Node, Subscriber};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::notes::Note;
use crate::runtime::tool_identity;

/// Maximum number of detectors that are followed; a network has far fewer.
const MAX_DETECTORS: usize = 64;
/// Maximum number of processes of this machine whose health is followed.
const MAX_PROCESSES: usize = 256;
/// Interval at which the note of a landing is written again.
const REFRESH: Duration = Duration::from_secs(1);
/// A note older than this is stale: its landing is not resumed, as a controller that stood still for as long does not continue it.
pub(crate) const STALE_AFTER: Duration =
    Duration::from_millis((controller::MAX_STANDSTILL_S * 1e3) as u64);

/// The peers, as received so far.
pub(crate) struct Peers {
    table: watch::Receiver<PeerTable>,
    session: Option<(Node, JoinHandle<()>)>,
}

/// The place and camera of a detector: detectors in one slot can replace each other.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Slot {
    place: Place,
    camera: String,
}

/// A detector that runs in place of a supervised one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Replacement {
    pub(crate) name: String,
    slot: Slot,
    joined: Instant,
}

#[derive(Clone, Debug, Default)]
struct PeerTable {
    /// When a landing was under way the last time, unless it is over.
    under_way: Option<Instant>,
    /// Whether the vehicle may be in the air during a landing, by the controller's last status.
    is_in_the_air: bool,
    /// The controller's: a detector's name, a place, or nothing.
    preference: String,
    detectors: BTreeMap<String, KnownDetector>,
    /// When the health of each process of this machine was received the last time, by its number.
    healths: BTreeMap<u32, Instant>,
}

/// A detector that is there, or was a while ago.
#[derive(Clone, Debug, Default)]
struct KnownDetector {
    alive: bool,
    /// When it came, the last time.
    joined: Option<Instant>,
    info: Option<DetectorInfo>,
}

impl Peers {
    /// No peers.
    pub(crate) fn none() -> Self {
        Self { table: watch::channel(PeerTable::default()).1, session: None }
    }

    /// Follows the peers from now on, and keeps the note of a landing under way; `under_way` is when one was, by the note before.
    pub(crate) async fn follow(
        network: &Network,
        key: &str,
        note: Note,
        under_way: Option<Instant>,
    ) -> anyhow::Result<Self> {
        let node = Node::open(tool_identity("up"), &network.source(key)?).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
        let presence = node.presence("detector").await?;
        // Through a relay with keys this session may not receive it. On the drone every process may.
        let healths = match network.config.as_deref().is_none_or(|it| it == Path::new("local")) {
            true => Some(node.subscriber(topic::HEALTH, &[]).await?),
            false => None,
        };
        let host = node::host_name();
        let (sender, table) = watch::channel(PeerTable { under_way, ..PeerTable::default() });
        let task = tokio::spawn(async move {
            // The note of before is removed once its landing is over.
            let mut monitor = LandingMonitor { note, under_way, noted: under_way };
            loop {
                tokio::select! {
                    Some(status) = statuses.next() => {
                        let under_way = monitor.update(&status, Instant::now());
                        // No task waits for this value: it is looked up when a controller is started.
                        sender.send_if_modified(|table| {
                            table.under_way = under_way;
                            table.is_in_the_air = is_in_the_air(&status);
                            false
                        });
                        if sender.borrow().preference != status.preference {
                            sender.send_modify(|table| table.preference = status.preference);
                        }
                    }
                    Some((key, info)) = infos.next_with_key() => {
                        let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                        if sender.borrow().info(name) != Some(&info) {
                            sender.send_modify(|table| table.set_info(name, info));
                        }
                    }
                    Some(health) = next(healths.as_ref()) => {
                        // No task waits for this value either.
                        sender.send_if_modified(|table| {
                            table.set_health(&health, &host, Instant::now());
                            false
                        });
                    }
                    Some((name, alive)) = presence.next() => {
                        sender.send_modify(|table| table.set_alive(&name, alive, Instant::now()));
                    }
                    else => return,
                }
            }
        });
        Ok(Self { table, session: Some((node, task)) })
    }

    /// Stops following; the note is not written after this.
    pub(crate) async fn close(&mut self) {
        if let Some((_node, task)) = self.session.take() {
            task.abort();
            // Waits for its end; its result is that it was aborted.
            drop(task.await);
        }
    }

    /// Whether a landing is under way, or was a moment ago.
    pub(crate) fn landing(&self) -> bool {
        self.table.borrow().landing(Instant::now())
    }

    /// Whether the vehicle may be in the air during a landing, also one that is held or aborted.
    pub(crate) fn may_be_in_the_air(&self) -> bool {
        self.landing() || self.table.borrow().is_in_the_air
    }

    /// When the health of the process with this number was received the last time, if it was.
    pub(crate) fn last_health(&self, pid: i32) -> Option<Instant> {
        let pid = u32::try_from(pid).ok()?;
        self.table.borrow().healths.get(&pid).copied()
    }

    /// The detector that replaces the one with this process number on this host, which has ended; `own` are the numbers of those that
    /// are supervised.
    pub(crate) fn replacement(&self, pid: i32, own: &[i32]) -> Option<Replacement> {
        self.table.borrow().replacement(&node::host_name(), pid, own)
    }

    /// The detector that now runs in place of a supervised one: the known replacement, or, once that is gone, one that came after it.
    pub(crate) fn successor(&self, of: &Replacement, own: &[i32]) -> Option<Replacement> {
        self.table.borrow().successor(of, &node::host_name(), own)
    }

    /// Returns at the next change.
    pub(crate) async fn changed(&mut self) {
        if self.table.changed().await.is_err() {
            // The session is closed: there are no changes any more.
            std::future::pending::<()>().await;
        }
    }
}

impl Slot {
    fn of(info: &DetectorInfo) -> Self {
        Self { place: info.place, camera: info.camera.clone() }
    }
}

impl PeerTable {
    /// A dead controller publishes nothing, so a landing without a status counts as under way only for a while.
    fn landing(&self, now: Instant) -> bool {
        self.under_way.is_some_and(|last| now - last < STALE_AFTER)
    }

    fn info(&self, name: &str) -> Option<&DetectorInfo> {
        self.detectors.get(name)?.info.as_ref()
    }

    fn set_info(&mut self, name: &str, info: DetectorInfo) {
        if let Some(detector) = self.detector(name) {
            detector.info = Some(info);
        }
    }

    fn set_health(&mut self, health: &Health, host: &str, now: Instant) {
        let has_room = self.healths.len() < MAX_PROCESSES || self.healths.contains_key(&health.pid);
        if !has_room {
            self.healths.retain(|_, last| now - *last < STALE_AFTER);
        }
        if health.host == host && (has_room || self.healths.len() < MAX_PROCESSES) {
            self.healths.insert(health.pid, now);
        }
    }

    fn set_alive(&mut self, name: &str, alive: bool, now: Instant) {
        let Some(detector) = self.detector(name) else { return };
        if alive && !detector.alive {
            detector.joined = Some(now);
        }
        detector.alive = alive;
    }

    /// The entry of a detector; `None` if there is no room for a further one.
    fn detector(&mut self, name: &str) -> Option<&mut KnownDetector> {
        let is_full = |table: &Self| {
            table.detectors.len() >= MAX_DETECTORS && !table.detectors.contains_key(name)
        };
        if is_full(self) {
            // One that is gone is needed for a while only, to find its slot.
            self.detectors.retain(|_, detector| detector.alive);
        }
        (!is_full(self)).then(|| self.detectors.entry(name.to_owned()).or_default())
    }

    /// One that the operator has named, or that came after it. Other detectors in its slot ran in parallel with it all along. If the
    /// controller uses one of them, that shows only that this one has gone.
    fn replacement(&self, host: &str, pid: i32, own: &[i32]) -> Option<Replacement> {
        let is_it =
            |it: &&KnownDetector| it.info.as_ref().is_some_and(|info| is_process(info, host, pid));
        let replaced = self.detectors.values().find(is_it)?;
        let (slot, joined) = (Slot::of(replaced.info.as_ref()?), replaced.joined?);
        let is_chosen = |it: &Replacement| it.name == self.preference;
        let all = || self.others_in(&slot, host, own);
        all().find(is_chosen).or_else(|| newest_after(joined, all()))
    }

    fn successor(&self, of: &Replacement, host: &str, own: &[i32]) -> Option<Replacement> {
        let all = || self.others_in(&of.slot, host, own);
        all().find(|it| it == of).or_else(|| newest_after(of.joined, all()))
    }

    /// The running detectors in a slot that are not supervised here.
    fn others_in(&self, slot: &Slot, host: &str, own: &[i32]) -> impl Iterator<Item = Replacement> {
        let running = self.detectors.iter().filter(|(_, detector)| detector.alive);
        running.filter_map(move |(name, detector)| {
            let (info, joined) = (detector.info.as_ref()?, detector.joined?);
            let is_own = own.iter().any(|pid| is_process(info, host, *pid));
            let found = Replacement { name: name.clone(), slot: Slot::of(info), joined };
            (found.slot == *slot && !is_own).then_some(found)
        })
    }
}

/// The next health; never one without a subscriber.
async fn next(healths: Option<&Subscriber<Health>>) -> Option<Health> {
    match healths {
        Some(healths) => healths.next().await,
        None => std::future::pending().await,
    }
}

/// The one that came last, if it came after a time.
fn newest_after(time: Instant, all: impl Iterator<Item = Replacement>) -> Option<Replacement> {
    all.filter(|it| it.joined > time).max_by_key(|it| it.joined)
}

fn is_process(info: &DetectorInfo, host: &str, pid: i32) -> bool {
    info.host == host && u32::try_from(pid).is_ok_and(|pid| info.pid == pid)
}

/// Whether a landing has begun, and neither has it ended nor have the motors stopped. An aborted one has not ended.
pub(crate) fn is_in_the_air(status: &ControllerStatus) -> bool {
    let is_over = status.finished && !status.waits_for_operator;
    status.started_ns.is_some() && status.disarmed_ns.is_none() && !is_over
}

/// Follows from the controller's status whether a landing is under way.
#[derive(Default)]
struct LandingMonitor {
    note: Note,
    under_way: Option<Instant>,
    noted: Option<Instant>,
}

impl LandingMonitor {
    /// When a landing was under way the last time; `None` when none is to be resumed.
    fn update(&mut self, status: &ControllerStatus, now: Instant) -> Option<Instant> {
        // One that an operator has held or aborted is none: a controller that takes it up again would descend.
        let is_under_way =
            status.started_ns.is_some() && !status.finished && !status.waits_for_operator;
        // A restarted controller waits for a moment before it resumes a landing.
        let waits = status.started_ns.is_none() && !status.finished;
        if is_under_way {
            self.under_way = Some(now);
        } else if !waits || self.under_way.is_some_and(|last| now - last >= STALE_AFTER) {
            self.under_way = None;
        }
        let is_due = self.noted.is_none_or(|noted| now - noted >= REFRESH);
        if is_under_way && is_due {
            self.note.write();
            self.noted = Some(now);
        } else if self.under_way.is_none() && self.noted.take().is_some() {
            self.note.remove();
        }
        self.under_way
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn info(place: Place, host: &str, pid: u32) -> DetectorInfo {
        DetectorInfo {
            detector: String::new(),
            host: host.into(),
            place,
            camera: "down".into(),
            markers: Vec::new(),
            version: String::new(),
            pid,
        }
    }

    /// A table with detectors of the host `pi`, on board, that joined one second after the other; their numbers are 1, 2 ...
    fn table(names: &[&str], start: Instant) -> PeerTable {
        let mut table = PeerTable::default();
        for (pid, name) in (1..).zip(names) {
            table.set_info(name, info(Place::Onboard, "pi", pid));
            table.set_alive(name, true, start + Duration::from_secs(pid.into()));
        }
        table
    }

    fn name(replacement: Option<Replacement>) -> Option<String> {
        replacement.map(|it| it.name)
    }

    #[test]
    fn a_landing_that_is_held_or_aborted_may_be_in_the_air_and_one_that_is_over_is_not() {
        let flying = ControllerStatus { started_ns: Some(1), ..ControllerStatus::default() };
        let held = ControllerStatus { waits_for_operator: true, ..flying.clone() };
        let aborted = ControllerStatus { finished: true, ..held.clone() };
        assert!([&flying, &held, &aborted].into_iter().all(is_in_the_air));
        let landed = ControllerStatus { disarmed_ns: Some(2), ..flying.clone() };
        let ended = ControllerStatus { finished: true, ..flying };
        let waiting = ControllerStatus::default();
        assert!(![&landed, &ended, &waiting].into_iter().any(is_in_the_air));
    }

    #[test]
    fn a_detector_is_replaced_by_one_of_its_place_and_camera_that_came_after_it() {
        let start = Instant::now();
        let mut table = table(&["spare", "main", "second", "new"], start);
        let own = [2, 3];
        let late = start + Duration::from_secs(60);
        for (name, info) in [
            ("ground", info(Place::Ground, "laptop", 2)),
            ("forward", DetectorInfo { camera: "forward".into(), ..info(Place::Onboard, "pi", 9) }),
        ] {
            table.set_info(name, info);
            table.set_alive(name, true, late);
        }
        table.set_alive("main", false, late);
        assert_eq!(name(table.replacement("pi", 2, &own)).as_deref(), Some("new"));
        table.set_alive("new", false, late);
        assert_eq!(
            table.replacement("pi", 2, &own),
            None,
            "neither one that ran in parallel, nor a supervised one, nor one of another place or camera"
        );
        table.preference = "spare".into();
        assert_eq!(name(table.replacement("pi", 2, &own)).as_deref(), Some("spare"));
        assert_eq!(table.replacement("pi", 77, &own), None, "it never published its slot");
    }

    #[test]
    fn a_replacement_that_is_gone_is_followed_only_by_one_that_came_after_it() {
        let start = Instant::now();
        let mut table = table(&["spare", "main", "new"], start);
        let late = |s: u64| start + Duration::from_secs(60 + s);
        table.set_alive("main", false, late(0));
        let first = table.replacement("pi", 2, &[2]).unwrap();
        assert_eq!(table.successor(&first, "pi", &[2]).as_ref(), Some(&first));
        table.set_info("newer", info(Place::Onboard, "pi", 4));
        table.set_alive("newer", true, late(1));
        assert_eq!(table.successor(&first, "pi", &[2]).as_ref(), Some(&first));
        table.set_alive("new", false, late(2));
        let second = table.successor(&first, "pi", &[2]).unwrap();
        assert_eq!(second.name, "newer");
        table.set_alive("newer", false, late(3));
        assert_eq!(table.successor(&second, "pi", &[2]), None);
    }

    #[test]
    fn a_full_table_forgets_those_that_are_gone() {
        let names: Vec<_> = (0..MAX_DETECTORS).map(|i| format!("{i:02}")).collect();
        let names: Vec<_> = names.iter().map(String::as_str).collect();
        let mut table = table(&names, Instant::now());
        table.set_alive("more", true, Instant::now());
        assert!(!table.detectors.contains_key("more"));
        table.set_alive("07", false, Instant::now());
        table.set_alive("more", true, Instant::now());
        assert!(table.detectors["more"].alive && !table.detectors.contains_key("07"));
    }

    #[test]
    fn a_landing_stays_under_way_while_a_restarted_controller_waits() {
        let status = |started_ns: Option<i64>, finished: bool| ControllerStatus {
            started_ns,
            finished,
            ..ControllerStatus::default()
        };
        let (mut monitor, now) = (LandingMonitor::default(), Instant::now());
        let mut lands = |status, now| monitor.update(&status, now).is_some();
        assert!(!lands(status(None, false), now));
        assert!(lands(status(Some(1), false), now));
        assert!(lands(status(None, false), now + STALE_AFTER / 2));
        assert!(!lands(status(None, false), now + STALE_AFTER));
        assert!(lands(status(Some(1), false), now));
        assert!(!lands(status(Some(1), true), now));
        assert!(!lands(status(None, false), now));
    }

    #[test]
    fn a_landing_that_is_held_or_aborted_is_not_resumed_after_a_crash() {
        let folder = tempfile::tempdir().unwrap();
        let notes = crate::notes::Notes::kept_in(Some(folder.path()), "x");
        let mut monitor = LandingMonitor { note: notes.landing.clone(), ..Default::default() };
        let now = Instant::now();
        let landing = ControllerStatus { started_ns: Some(1), ..ControllerStatus::default() };
        let held = ControllerStatus { waits_for_operator: true, ..landing.clone() };
        let restarted = ControllerStatus::default();
        assert!(monitor.update(&landing, now).is_some() && notes.landing.is_there());
        assert!(monitor.update(&held, now).is_none() && !notes.landing.is_there());
        assert!(monitor.update(&restarted, now).is_none(), "nor while the next one waits");
        // The operator continues it.
        assert!(monitor.update(&landing, now).is_some() && notes.landing.is_there());
    }

    #[test]
    fn a_landing_without_further_statuses_is_soon_over() {
        let (mut monitor, now) = (LandingMonitor::default(), Instant::now());
        let landing = ControllerStatus { started_ns: Some(1), ..ControllerStatus::default() };
        let waiting = ControllerStatus::default();
        let lands_after = |under_way, silence| {
            PeerTable { under_way, ..PeerTable::default() }.landing(now + silence)
        };
        let under_way = monitor.update(&landing, now);
        assert!(lands_after(under_way, STALE_AFTER / 2));
        assert!(!lands_after(under_way, STALE_AFTER));
        // A controller that waits does not make the landing any younger.
        let under_way = monitor.update(&waiting, now + STALE_AFTER / 2);
        assert!(lands_after(under_way, STALE_AFTER / 2));
        assert!(!lands_after(under_way, STALE_AFTER));
    }
}
