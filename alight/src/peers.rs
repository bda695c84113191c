//! The peers on which a supervisor's restarts depend: whether a landing is under way, and which detectors are
//! running.

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use messages::{ControllerStatus, DetectorInfo, Place, topic};
use node::{Network, Node, clock_name, now_ns};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

use crate::runtime::tool_identity;

/// Maximum number of detectors that are followed; a network has far fewer.
const MAX_DETECTORS: usize = 64;
/// Interval at which the marker file of a landing is refreshed.
const REFRESH: Duration = Duration::from_secs(1);
/// A marker file older than this is stale: its landing is not resumed.
const STALE_AFTER: Duration = Duration::from_secs(15);

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

    /// Follows the peers from now on, and keeps the marker file.
    pub(crate) async fn follow(
        network: &Network,
        key: &str,
        marker_file: LandingMarkerFile,
    ) -> anyhow::Result<Self> {
        let node = Node::open(tool_identity("up"), &network.source(key)?).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
        let presence = node.presence("detector").await?;
        let (sender, table) = watch::channel(PeerTable::default());
        let task = tokio::spawn(async move {
            let mut monitor = LandingMonitor { marker_file, ..LandingMonitor::default() };
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

    /// Stops following; the marker file is not written after this.
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
    marker_file: LandingMarkerFile,
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
            self.marker_file.note(true);
            self.noted = Some(now);
        } else if self.under_way.is_none() && self.noted.take().is_some() {
            self.marker_file.note(false);
        }
        self.under_way.is_some()
    }
}

/// A file that marks a landing under way, for the supervisor that is started after one that was killed. It is
/// in the directory for runtime files ($RUNTIME_DIRECTORY or $XDG_RUNTIME_DIR), which does not survive a
/// reboot.
#[derive(Clone, Debug, Default)]
pub(crate) struct LandingMarkerFile {
    file: Option<PathBuf>,
}

/// Whether only this user (and root) can write to a directory: whoever can may have a landing resumed.
fn is_ours_alone(directory: &Path) -> bool {
    let Ok(found) = std::fs::metadata(directory) else { return true };
    let user = rustix::process::geteuid();
    (found.uid() == user.as_raw() || user.is_root()) && found.mode() & 0o022 == 0
}

/// The contents of the file.
#[derive(Serialize, Deserialize)]
struct LandingMarker {
    clock: String,
    stamp_ns: i64,
}

impl LandingMarkerFile {
    /// The file of the supervisor with this name.
    pub(crate) fn for_supervisor(name: &str) -> Self {
        let directory = ["RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"].iter().find_map(std::env::var_os);
        let directory = directory.map(PathBuf::from).filter(|directory| {
            let is_ours = is_ours_alone(directory);
            if !is_ours {
                tracing::warn!(
                    ?directory,
                    "Other users can write there, so no landing is resumed after a crash"
                );
            }
            is_ours
        });
        Self { file: directory.map(|it| it.join(format!("alight-{name}.landing"))) }
    }

    /// Notes whether a landing is under way.
    pub(crate) fn note(&self, landing: bool) {
        let Some(file) = &self.file else { return };
        let marker = LandingMarker { clock: clock_name().to_owned(), stamp_ns: now_ns() };
        let written = match (landing, serde_json::to_vec(&marker)) {
            (true, Ok(text)) => {
                // Renamed, so that a reader never sees half of it.
                let new = file.with_extension("new");
                std::fs::write(&new, text).and_then(|()| std::fs::rename(&new, file))
            }
            _ if !file.exists() => Ok(()),
            _ => std::fs::remove_file(file),
        };
        if let Err(problem) = written {
            tracing::warn!(%problem, ?file, "Marker file of the landing not written");
        }
    }

    /// Whether a landing was under way a moment ago.
    pub(crate) fn landing(&self) -> bool {
        let text = self.file.as_ref().and_then(|file| std::fs::read(file).ok());
        let marker: Option<LandingMarker> =
            text.and_then(|text| serde_json::from_slice(&text).ok());
        marker.is_some_and(|marker| {
            let age_ns = now_ns().saturating_sub(marker.stamp_ns);
            let limit_ns = i64::try_from(STALE_AFTER.as_nanos()).unwrap_or(i64::MAX);
            marker.clock == clock_name() && (0..limit_ns).contains(&age_ns)
        })
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

    #[test]
    fn a_directory_in_which_others_write_has_no_marker_file() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        for (mode, is_ours) in [(0o700, true), (0o755, true), (0o775, false), (0o1777, false)] {
            let permissions = std::fs::Permissions::from_mode(mode);
            std::fs::set_permissions(folder.path(), permissions).unwrap();
            assert_eq!(is_ours_alone(folder.path()), is_ours, "{mode:o}");
        }
    }

    #[test]
    fn a_marker_file_becomes_stale_and_is_removed_at_the_end() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("x.landing");
        let marker_file = LandingMarkerFile { file: Some(file.clone()) };
        assert!(!marker_file.landing() && !LandingMarkerFile::default().landing());
        marker_file.note(false);
        marker_file.note(true);
        assert!(marker_file.landing());
        let is_fresh = |clock: &str, age: Duration| {
            let stamp_ns = now_ns() - i64::try_from(age.as_nanos()).unwrap();
            let marker = LandingMarker { clock: clock.into(), stamp_ns };
            std::fs::write(&file, serde_json::to_vec(&marker).unwrap()).unwrap();
            marker_file.landing()
        };
        assert!(!is_fresh(clock_name(), STALE_AFTER * 2), "long ago");
        assert!(!is_fresh("before the system started", Duration::ZERO));
        marker_file.note(false);
        assert!(!file.exists());
    }
}
