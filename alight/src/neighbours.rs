//! What a supervisor must know of the network to start its own processes again rightly: whether a landing is under way,
//! and which detectors there are.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::time::Duration;

use messages::{ControllerStatus, DetectorInfo, Place, topic};
use node::{Identity, Network, Node, clock_name, now_ns};
use serde::{Deserialize, Serialize};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::Instant;

/// Detectors that are followed at most; more are a mistake in the network.
const MOST: usize = 64;
/// How often the memory of a landing is refreshed.
const REFRESH: Duration = Duration::from_secs(1);
/// A landing of which nothing was noted for so long is none to be taken up.
const FORGOTTEN: Duration = Duration::from_secs(15);

/// The neighbours, as they are heard.
pub(crate) struct Neighbours {
    heard: watch::Receiver<Heard>,
    follows: Option<(Node, JoinHandle<()>)>,
}

/// What a detector is there for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Post {
    place: Place,
    camera: String,
}

#[derive(Clone, Debug, Default)]
struct Heard {
    landing: bool,
    alive: BTreeSet<String>,
    told: BTreeMap<String, DetectorInfo>,
}

impl Neighbours {
    /// Nobody is heard.
    pub(crate) fn none() -> Self {
        Self { heard: watch::channel(Heard::default()).1, follows: None }
    }

    /// Listens from now on, and notes landings in the memory.
    pub(crate) async fn follow(
        network: &Network,
        key: &str,
        memory: Memory,
    ) -> anyhow::Result<Self> {
        let identity =
            Identity { service: "alight", instance: format!("up-{}", std::process::id()) };
        let node = Node::open(identity, &network.source(key)?).await?;
        let statuses = node.subscriber(topic::STATUS, &[]).await?;
        let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
        let presence = node.presence("detector").await?;
        let (sender, heard) = watch::channel(Heard::default());
        let task = tokio::spawn(async move {
            let mut landings = Landings { memory, ..Landings::default() };
            loop {
                tokio::select! {
                    Some(status) = statuses.next() => {
                        let landing = landings.take(&status, Instant::now());
                        if sender.borrow().landing != landing {
                            sender.send_modify(|heard| heard.landing = landing);
                        }
                    }
                    Some((key, info)) = infos.next_with_key() => {
                        let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                        if sender.borrow().told.get(name) != Some(&info) {
                            sender.send_modify(|heard| heard.tell(name, info));
                        }
                    }
                    Some((name, alive)) = presence.next() => {
                        sender.send_modify(|heard| heard.change(name, alive));
                    }
                    else => return,
                }
            }
        });
        Ok(Self { heard, follows: Some((node, task)) })
    }

    /// Listens no longer: after this nothing more is noted.
    pub(crate) async fn close(&mut self) {
        if let Some((_node, task)) = self.follows.take() {
            task.abort();
            // Its end is waited for; that it was broken off is no news.
            drop(task.await);
        }
    }

    /// True while a landing is under way.
    pub(crate) fn landing(&self) -> bool {
        self.heard.borrow().landing
    }

    /// Where the detector with this process number on this host runs, and for which camera.
    pub(crate) fn post_of(&self, pid: i32) -> Option<Post> {
        let host = node::host_name();
        let heard = self.heard.borrow();
        heard.told.values().find(|info| is_process(info, &host, pid)).map(Post::of)
    }

    /// A detector at this post that is none of the processes with these numbers on this host.
    pub(crate) fn stand_in(&self, post: &Post, own: &[i32]) -> Option<String> {
        self.heard.borrow().stand_in(post, &node::host_name(), own)
    }

    /// Returns when something was heard that changes the answers.
    pub(crate) async fn changed(&mut self) {
        if self.heard.changed().await.is_err() {
            // Nobody is heard any more.
            std::future::pending::<()>().await;
        }
    }
}

impl Post {
    fn of(info: &DetectorInfo) -> Self {
        Self { place: info.place, camera: info.camera.clone() }
    }
}

impl Heard {
    fn tell(&mut self, name: &str, info: DetectorInfo) {
        if self.told.len() < MOST || self.told.contains_key(name) {
            self.told.insert(name.to_owned(), info);
        }
    }

    fn change(&mut self, name: String, alive: bool) {
        if alive && self.alive.len() < MOST {
            self.alive.insert(name);
        } else if !alive {
            self.alive.remove(&name);
            // Of those that are gone only the last ones are needed, for who ended.
            let alive = &self.alive;
            if self.told.len() >= MOST {
                self.told.retain(|name, _| alive.contains(name));
            }
        }
    }

    fn stand_in(&self, post: &Post, host: &str, own: &[i32]) -> Option<String> {
        let is_own = |info: &DetectorInfo| own.iter().any(|pid| is_process(info, host, *pid));
        let told = self.told.iter().filter(|(name, _)| self.alive.contains(*name));
        let mut others = told.filter(|(_, info)| Post::of(info) == *post && !is_own(info));
        others.next().map(|(name, _)| name.clone())
    }
}

fn is_process(info: &DetectorInfo, host: &str, pid: i32) -> bool {
    info.host == host && u32::try_from(pid).is_ok_and(|pid| info.pid == pid)
}

/// Whether a landing is under way, as a controller tells it.
#[derive(Default)]
struct Landings {
    memory: Memory,
    under_way: Option<Instant>,
    noted: Option<Instant>,
}

impl Landings {
    fn take(&mut self, status: &ControllerStatus, now: Instant) -> bool {
        let is_under_way = status.started_ns.is_some() && !status.finished;
        // One that is started again to take a landing up waits for a moment before it does.
        let waits = status.started_ns.is_none() && !status.finished;
        if is_under_way {
            self.under_way = Some(now);
        } else if !waits || self.under_way.is_some_and(|last| now - last >= FORGOTTEN) {
            self.under_way = None;
        }
        let is_due = self.noted.is_none_or(|noted| now - noted >= REFRESH);
        if is_under_way && is_due {
            self.memory.note(true);
            self.noted = Some(now);
        } else if self.under_way.is_none() && self.noted.take().is_some() {
            self.memory.note(false);
        }
        self.under_way.is_some()
    }
}

/// Whether a landing was under way a moment ago, for the supervisor that is started after one that was killed: a file
/// in the directory for what lives as long as the system ($RUNTIME_DIRECTORY or $XDG_RUNTIME_DIR).
#[derive(Clone, Debug, Default)]
pub(crate) struct Memory {
    file: Option<PathBuf>,
}

/// The file.
#[derive(Serialize, Deserialize)]
struct Note {
    clock: String,
    stamp_ns: i64,
}

impl Memory {
    /// The memory of the supervisor with this name.
    pub(crate) fn of(name: &str) -> Self {
        let directory = ["RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"].iter().find_map(std::env::var_os);
        let file = format!("alight-{name}.landing");
        Self { file: directory.map(|directory| PathBuf::from(directory).join(file)) }
    }

    /// A landing is under way now, or is not.
    pub(crate) fn note(&self, landing: bool) {
        let Some(file) = &self.file else { return };
        let note = Note { clock: clock_name().to_owned(), stamp_ns: now_ns() };
        let written = match (landing, serde_json::to_vec(&note)) {
            (true, Ok(text)) => {
                // Moved to its place, so that nobody ever reads half of it.
                let new = file.with_extension("new");
                std::fs::write(&new, text).and_then(|()| std::fs::rename(&new, file))
            }
            _ if !file.exists() => Ok(()),
            _ => std::fs::remove_file(file),
        };
        if let Err(problem) = written {
            tracing::warn!(%problem, ?file, "A landing is not remembered");
        }
    }

    /// True when a landing was noted a moment ago.
    pub(crate) fn landing(&self) -> bool {
        let text = self.file.as_ref().and_then(|file| std::fs::read(file).ok());
        let note: Option<Note> = text.and_then(|text| serde_json::from_slice(&text).ok());
        note.is_some_and(|note| {
            let age_ns = now_ns().saturating_sub(note.stamp_ns);
            let limit_ns = i64::try_from(FORGOTTEN.as_nanos()).unwrap_or(i64::MAX);
            note.clock == clock_name() && (0..limit_ns).contains(&age_ns)
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
    fn another_living_detector_of_the_same_place_and_camera_stands_in() {
        let mut heard = Heard::default();
        for (name, place, host, pid) in [
            ("main", Place::Onboard, "pi", 7),
            ("second", Place::Onboard, "pi", 8),
            ("new", Place::Onboard, "pi", 9),
            ("ground", Place::Ground, "laptop", 7),
        ] {
            heard.tell(name, info(place, host, pid));
            heard.change(name.into(), true);
        }
        // By its name it would come first.
        let forward = DetectorInfo { camera: "forward".into(), ..info(Place::Onboard, "pi", 10) };
        heard.tell("forward", forward);
        heard.change("forward".into(), true);
        let post = |place: Place| Post { place, camera: "down".into() };
        let stand_in = |heard: &Heard| heard.stand_in(&post(Place::Onboard), "pi", &[7, 8]);
        assert_eq!(stand_in(&heard).as_deref(), Some("new"));
        assert_eq!(heard.stand_in(&post(Place::Ground), "laptop", &[7]), None);
        heard.change("new".into(), false);
        assert_eq!(
            stand_in(&heard),
            None,
            "neither one's own, nor the one on the ground, nor one of another camera does"
        );
    }

    #[test]
    fn a_landing_is_under_way_until_it_ends_also_while_the_next_controller_waits() {
        let status = |started_ns: Option<i64>, finished: bool| ControllerStatus {
            started_ns,
            finished,
            ..ControllerStatus::default()
        };
        let (mut landings, now) = (Landings::default(), Instant::now());
        assert!(!landings.take(&status(None, false), now));
        assert!(landings.take(&status(Some(1), false), now));
        assert!(landings.take(&status(None, false), now + FORGOTTEN / 2));
        assert!(!landings.take(&status(None, false), now + FORGOTTEN));
        assert!(landings.take(&status(Some(1), false), now));
        assert!(!landings.take(&status(Some(1), true), now));
        assert!(!landings.take(&status(None, false), now));
    }

    #[test]
    fn a_landing_is_remembered_for_a_moment_and_only_until_it_ends() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("x.landing");
        let memory = Memory { file: Some(file.clone()) };
        assert!(!memory.landing() && !Memory::default().landing());
        memory.note(false);
        memory.note(true);
        assert!(memory.landing());
        let note = |clock: &str, age: Duration| {
            let stamp_ns = now_ns() - i64::try_from(age.as_nanos()).unwrap();
            let note = Note { clock: clock.into(), stamp_ns };
            std::fs::write(&file, serde_json::to_vec(&note).unwrap()).unwrap();
            memory.landing()
        };
        assert!(!note(clock_name(), FORGOTTEN * 2), "long ago");
        assert!(!note("before the system started", Duration::ZERO));
        memory.note(false);
        assert!(!file.exists());
    }
}
