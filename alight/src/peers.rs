//! The peers on which a supervisor's restarts depend: whether a landing is under way, and which detectors are
//! running.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use messages::{ControllerStatus, DetectorInfo, Place, topic};
use node::{Network, Node};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::notes::Note;
use crate::runtime::tool_identity;

/// Maximum number of detectors that are followed; a network has far fewer.
const MAX_DETECTORS: usize = 64;
/// Interval at which the note of a landing is written anew.
const REFRESH: Duration = Duration::from_secs(1);
/// A note older than this is stale: its landing is not resumed.
pub(crate) const STALE_AFTER: Duration = Duration::from_secs(15);

/// The peers, as received so far.
pub(crate) struct Peers {
    table: watch::Receiver<PeerTable>,
    session: Option<(Node, JoinHandle<()>)>,
}

/// The place and camera of a detector: detectors in one slot can replace each other.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Slot {
    place: Place,
    camera: String,
}

#[derive(Clone, Debug, Default)]
struct PeerTable {
    landing: bool,
    alive: BTreeSet<String>,
    infos: BTreeMap<String, DetectorInfo>,
}

impl Peers {
    /// No peers.
    pub(crate) fn none() -> Self {
        Self { table: watch::channel(PeerTable::default()).1, session: None }
    }

    /// Follows the peers from now on, and keeps the note of a landing under way.
    pub(crate) async fn follow(network: &Network, key: &str, note: Note) -> anyhow::Result<Self> {
        let node = Node::open(tool_identity("up"), &network.source(key)?).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
        let presence = node.presence("detector").await?;
        let (sender, table) = watch::channel(PeerTable::default());
        let task = tokio::spawn(async move {
            let mut monitor = LandingMonitor { note, ..LandingMonitor::default() };
            loop {
                tokio::select! {
                    Some(status) = statuses.next() => {
                        let landing = monitor.update(&status, Instant::now());
                        if sender.borrow().landing != landing {
                            sender.send_modify(|table| table.landing = landing);
                        }
                    }
                    Some((key, info)) = infos.next_with_key() => {
                        let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                        if sender.borrow().infos.get(name) != Some(&info) {
                            sender.send_modify(|table| table.set_info(name, info));
                        }
                    }
                    Some((name, alive)) = presence.next() => {
                        sender.send_modify(|table| table.set_alive(name, alive));
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

    /// Whether a landing is under way.
    pub(crate) fn landing(&self) -> bool {
        self.table.borrow().landing
    }

    /// The slot of the detector with this process number on this host.
    pub(crate) fn slot_of(&self, pid: i32) -> Option<Slot> {
        let host = node::host_name();
        let table = self.table.borrow();
        table.infos.values().find(|info| is_process(info, &host, pid)).map(Slot::of)
    }

    /// A running detector in this slot other than the processes with these numbers on this host.
    pub(crate) fn replacement(&self, slot: &Slot, own: &[i32]) -> Option<String> {
        self.table.borrow().replacement(slot, &node::host_name(), own)
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
    fn set_info(&mut self, name: &str, info: DetectorInfo) {
        if self.infos.len() < MAX_DETECTORS || self.infos.contains_key(name) {
            self.infos.insert(name.to_owned(), info);
        }
    }

    fn set_alive(&mut self, name: String, alive: bool) {
        if alive && self.alive.len() < MAX_DETECTORS {
            self.alive.insert(name);
        } else if !alive {
            self.alive.remove(&name);
            // The information on a detector that is gone is needed for a while, to find its slot.
            let alive = &self.alive;
            if self.infos.len() >= MAX_DETECTORS {
                self.infos.retain(|name, _| alive.contains(name));
            }
        }
    }

    fn replacement(&self, slot: &Slot, host: &str, own: &[i32]) -> Option<String> {
        let is_own = |info: &DetectorInfo| own.iter().any(|pid| is_process(info, host, *pid));
        let running = self.infos.iter().filter(|(name, _)| self.alive.contains(*name));
        let mut others = running.filter(|(_, info)| Slot::of(info) == *slot && !is_own(info));
        others.next().map(|(name, _)| name.clone())
    }
}

fn is_process(info: &DetectorInfo, host: &str, pid: i32) -> bool {
    info.host == host && u32::try_from(pid).is_ok_and(|pid| info.pid == pid)
}

/// Follows from the controller's status whether a landing is under way.
#[derive(Default)]
struct LandingMonitor {
    note: Note,
    under_way: Option<Instant>,
    noted: Option<Instant>,
}

impl LandingMonitor {
    fn update(&mut self, status: &ControllerStatus, now: Instant) -> bool {
        let is_under_way = status.started_ns.is_some() && !status.finished;
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
        self.under_way.is_some()
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

    #[test]
    fn a_running_detector_of_the_same_place_and_camera_is_a_replacement() {
        let mut table = PeerTable::default();
        for (name, place, host, pid) in [
            ("main", Place::Onboard, "pi", 7),
            ("second", Place::Onboard, "pi", 8),
            ("new", Place::Onboard, "pi", 9),
            ("ground", Place::Ground, "laptop", 7),
        ] {
            table.set_info(name, info(place, host, pid));
            table.set_alive(name.into(), true);
        }
        // It is the first by name.
        let forward = DetectorInfo { camera: "forward".into(), ..info(Place::Onboard, "pi", 10) };
        table.set_info("forward", forward);
        table.set_alive("forward".into(), true);
        let slot = |place: Place| Slot { place, camera: "down".into() };
        let replacement =
            |table: &PeerTable| table.replacement(&slot(Place::Onboard), "pi", &[7, 8]);
        assert_eq!(replacement(&table).as_deref(), Some("new"));
        assert_eq!(table.replacement(&slot(Place::Ground), "laptop", &[7]), None);
        table.set_alive("new".into(), false);
        assert_eq!(
            replacement(&table),
            None,
            "not its own processes, nor a detector on the ground, nor one of another camera"
        );
    }

    #[test]
    fn a_landing_stays_under_way_while_a_restarted_controller_waits() {
        let status = |started_ns: Option<i64>, finished: bool| ControllerStatus {
            started_ns,
            finished,
            ..ControllerStatus::default()
        };
        let (mut monitor, now) = (LandingMonitor::default(), Instant::now());
        assert!(!monitor.update(&status(None, false), now));
        assert!(monitor.update(&status(Some(1), false), now));
        assert!(monitor.update(&status(None, false), now + STALE_AFTER / 2));
        assert!(!monitor.update(&status(None, false), now + STALE_AFTER));
        assert!(monitor.update(&status(Some(1), false), now));
        assert!(!monitor.update(&status(Some(1), true), now));
        assert!(!monitor.update(&status(None, false), now));
    }
}
