//! Recognises the detector that a swap has started among all that join: by its name if that is known, or else by its process.
//!
//! Other detectors may join meanwhile, for example the built-in one when a landing starts. Such a detector is not switched to.

use std::collections::{BTreeMap, BTreeSet};

use messages::DetectorInfo;

/// Maximum number of detectors that are noted; a network has far fewer.
const MAX_DETECTORS: usize = 64;
/// Maximum number of ancestors of a process that are looked at.
const MAX_ANCESTORS: usize = 32;

/// The detectors that have joined since the start.
pub(super) struct Joined {
    /// The name of the started one, if it is known beforehand.
    expected: Option<String>,
    /// The names of those that were there before.
    existing: BTreeSet<String>,
    /// The number of the process that was started.
    leader: u32,
    /// This host's name.
    host: String,
    found: BTreeMap<String, Found>,
}

/// A detector that has joined.
#[derive(Default)]
struct Found {
    is_ready: bool,
    /// Its process, by its information.
    process: Option<Process>,
}

struct Process {
    host: String,
    pid: u32,
    /// Whether the started command is this process, or has started it.
    is_started: bool,
}

impl Joined {
    pub(super) fn new(expected: Option<String>, existing: BTreeSet<String>, leader: u32) -> Self {
        let host = node::host_name();
        Self { expected, existing, leader, host, found: BTreeMap::new() }
    }

    /// Takes the presence of a detector.
    pub(super) fn set_ready(&mut self, name: &str, is_ready: bool) {
        if let Some(found) = self.found(name) {
            found.is_ready = is_ready;
        }
    }

    /// Takes the information of a detector, by the name in its key.
    pub(super) fn set_info(&mut self, name: &str, info: &DetectorInfo) {
        let is_started = info.host == self.host && is_started_by(info.pid, self.leader);
        let process = Process { host: info.host.clone(), pid: info.pid, is_started };
        if let Some(found) = self.found(name) {
            found.process = Some(process);
        }
    }

    fn found(&mut self, name: &str) -> Option<&mut Found> {
        let is_full = self.found.len() >= MAX_DETECTORS && !self.found.contains_key(name);
        let is_ignored = is_full || self.existing.contains(name);
        (!is_ignored).then(|| self.found.entry(name.to_owned()).or_default())
    }

    /// The name of the started detector, once it is ready.
    pub(super) fn started(&self) -> Option<String> {
        let is_started = |(name, found): &(&String, &Found)| match &self.expected {
            Some(expected) => expected == *name,
            None => found.process.as_ref().is_some_and(|process| process.is_started),
        };
        let mut ready = self.found.iter().filter(|(_, found)| found.is_ready);
        ready.find(is_started).map(|(name, _)| name.clone())
    }

    /// The condition that is waited for, with the reasons why the detectors that joined are not the started one.
    pub(super) fn waiting_for(&self) -> String {
        let mut text = "the new detector is ready".to_owned();
        if let Some(expected) = &self.expected {
            text.push_str(&format!(", as `{expected}`"));
        }
        if !self.existing.is_empty() {
            let taken: Vec<&str> = self.existing.iter().map(String::as_str).collect();
            text.push_str(&format!(", with another name than {}", taken.join(", ")));
        }
        for (name, found) in self.found.iter().filter(|(_, found)| found.is_ready) {
            let reason = match &found.process {
                None => "its DetectorInfo was not received, so its process is not known".to_owned(),
                Some(Process { host, pid, .. }) => {
                    format!("it is process {pid} on {host}, which this command has not started")
                }
            };
            text.push_str(&format!("; `{name}` joined, and is not used: {reason}"));
            if self.expected.is_none() {
                text.push_str(&format!(" (if it is the new one, add `--id {name}`)"));
            }
        }
        text
    }
}

/// Whether a process of this host is the one with the number `leader`, which leads a process group, is in its group, or descends from it.
fn is_started_by(pid: u32, leader: u32) -> bool {
    let mut pid = pid;
    for _ in 0..MAX_ANCESTORS {
        if pid == leader {
            return true;
        }
        match parent_and_group(pid) {
            Some((_, group)) if group == leader => return true,
            Some((parent @ 2.., _)) => pid = parent,
            _ => return false,
        }
    }
    false
}

/// The numbers of a process's parent and of its group; `None` if there is no such process.
fn parent_and_group(pid: u32) -> Option<(u32, u32)> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    // The name of the program before may contain spaces and brackets; the state follows it.
    let mut fields = stat.rsplit_once(')')?.1.split_whitespace().skip(1);
    Some((fields.next()?.parse().ok()?, fields.next()?.parse().ok()?))
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::unix::process::CommandExt;
    use std::process::{Child, Command, Stdio};

    use messages::Place;

    use super::*;

    fn info(host: &str, pid: u32) -> DetectorInfo {
        DetectorInfo {
            detector: "any".into(),
            host: host.into(),
            place: Place::Onboard,
            camera: "down".into(),
            markers: Vec::new(),
            version: String::new(),
            pid,
        }
    }

    /// A script in a process group of its own that starts a process, and that process's number.
    fn script_with_child(script: &str) -> (Child, u32) {
        let mut shell = Command::new("sh");
        shell.args(["-c", script]).process_group(0).stdout(Stdio::piped());
        let mut shell = shell.spawn().unwrap();
        let mut line = String::new();
        BufReader::new(shell.stdout.take().unwrap()).read_line(&mut line).unwrap();
        (shell, line.trim().parse().unwrap())
    }

    #[test]
    fn a_detector_that_joins_meanwhile_is_not_taken_for_the_started_one() {
        let host = node::host_name();
        for script in ["sleep 30 & echo $!; wait", "setsid sh -c 'echo $$; exec sleep 30'; true"] {
            let (mut shell, pid) = script_with_child(script);
            let leader = shell.id();
            let mut joined = Joined::new(None, BTreeSet::from(["old".to_owned()]), leader);
            // The same number on another host is another process.
            for (name, info) in [
                ("third", info(&host, std::process::id())),
                ("far", info("ground-station", pid)),
                ("old", info(&host, pid)),
            ] {
                joined.set_ready(name, true);
                joined.set_info(name, &info);
            }
            joined.set_ready("silent", true);
            assert_eq!(joined.started(), None);
            let text = joined.waiting_for();
            assert!(text.contains("another name than old"), "{text}");
            assert!(text.contains("`third` joined, and is not used: it is process"), "{text}");
            assert!(text.contains("on ground-station") && text.contains("`--id far`"), "{text}");
            assert!(text.contains("`silent` joined, and is not used: its DetectorInfo"), "{text}");
            joined.set_info("new", &info(&host, pid));
            assert_eq!(joined.started(), None, "it is not ready yet");
            joined.set_ready("new", true);
            assert_eq!(joined.started().as_deref(), Some("new"), "{script}");
            shell.kill().unwrap();
            shell.wait().unwrap();
            let started = rustix::process::Pid::from_raw(pid as i32).unwrap();
            rustix::process::kill_process(started, rustix::process::Signal::KILL).unwrap();
        }
    }

    #[test]
    fn a_detector_whose_name_is_given_may_run_anywhere() {
        let mut joined = Joined::new(Some("far".into()), BTreeSet::new(), std::process::id());
        joined.set_ready("third", true);
        joined.set_info("third", &info(&node::host_name(), std::process::id()));
        assert_eq!(joined.started(), None, "that is its process, and another name");
        let text = joined.waiting_for();
        assert!(text.contains("as `far`") && !text.contains("--id"), "{text}");
        joined.set_ready("far", true);
        assert_eq!(joined.started().as_deref(), Some("far"));
    }
}
