//! Finds the running process of a service of this machine by its command line and its environment.

use std::collections::BTreeSet;

use node::network::variable;

use crate::site::Job;
use crate::up::arguments;

/// The number of the process that `alight up` started for a job; `None` also if this user may not read its environment.
pub(super) fn process(job: &Job) -> Option<i32> {
    let command = arguments(job);
    let environment = job.network.environment().into_iter();
    let network: BTreeSet<Vec<u8>> = environment
        .map(|(name, value)| [name.as_bytes(), b"=", value.as_encoded_bytes()].concat())
        .collect();
    let entries = std::fs::read_dir("/proc").ok()?.flatten();
    let mut numbers = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    numbers.find(|number| {
        is_started_by(&parts(*number, "cmdline"), &command) && network_of(*number) == network
    })
}

/// Whether a process has the arguments of a command, and no others than those that `alight up` adds. Its program may have any path.
fn is_started_by(arguments: &[Vec<u8>], command: &[String]) -> bool {
    let (Some(own), Some(added)) =
        (arguments.get(1..command.len()), arguments.get(command.len()..))
    else {
        return false;
    };
    let mut added = added.iter().filter(|argument| !argument.is_empty());
    let is_own = own.iter().zip(command.iter().skip(1)).all(|(one, other)| one == other.as_bytes());
    let mut is_added = true;
    while let Some(option) = added.next() {
        let value = added.next().map_or(&[][..], Vec::as_slice);
        is_added &= match option.as_slice() {
            b"--set" => value.starts_with(b"start="),
            b"--stop-with-parent" => true,
            _ => false,
        };
    }
    is_own && is_added
}

/// The variables of a process's environment that configure its network.
fn network_of(number: i32) -> BTreeSet<Vec<u8>> {
    let is_of_network = |part: &Vec<u8>| {
        let name = part.split(|byte| *byte == b'=').next().unwrap_or_default();
        variable::ALL.iter().any(|variable| variable.as_bytes() == name)
    };
    parts(number, "environ").into_iter().filter(is_of_network).collect()
}

/// The parts of a process's file, each of which ends in a zero byte; none of a file that this user may not read.
fn parts(number: i32, file: &str) -> Vec<Vec<u8>> {
    let bytes = std::fs::read(format!("/proc/{number}/{file}")).unwrap_or_default();
    bytes.split(|byte| *byte == 0).map(<[u8]>::to_vec).collect()
}

#[cfg(test)]
mod tests {
    use std::process::{Command, Stdio};
    use std::time::{Duration, Instant};

    use node::{Layers, Network};

    use super::*;
    use crate::services::Service;

    #[test]
    fn a_process_with_further_settings_is_of_another_job() {
        let words = |line: &str| line.split(' ').map(str::to_owned).collect::<Vec<_>>();
        let arguments = |line: &str| {
            let parts = line.split(' ').chain([""]);
            parts.map(|part| part.as_bytes().to_vec()).collect::<Vec<_>>()
        };
        let job = words("alight detector --config d.toml");
        let is_of = |line: &str| is_started_by(&arguments(line), &job);
        assert!(is_of("/usr/bin/alight detector --config d.toml"));
        assert!(is_of(
            "alight detector --config d.toml --set start=\"resume\" --stop-with-parent 7"
        ));
        assert!(!is_of("alight detector --config d.toml --set id=\"spare\" --stop-with-parent 7"));
        assert!(!is_of("alight detector --config e.toml") && !is_of("alight detector"));
    }

    #[test]
    fn a_process_is_found_by_its_arguments_and_its_network() {
        let meet = u16::try_from(std::process::id() % 60_000).unwrap() + 1000;
        let mut job = Job {
            name: "own".to_owned(),
            service: Some(Service::Controller),
            instance: Some("main".to_owned()),
            command: vec!["alight".to_owned(), "600".to_owned()],
            network: Network { meet: Some(meet), ..Network::default() },
            key: "controller".to_owned(),
            layers: Layers::default(),
        };
        let mut sleeping = Command::new("sleep")
            .arg("600")
            .envs(job.network.environment())
            .stdin(Stdio::null())
            .spawn()
            .unwrap();
        // Until it has become that program, its command line and environment are those of this one.
        let until = Instant::now() + Duration::from_secs(20);
        let found = loop {
            let found = process(&job);
            if found.is_some() || Instant::now() > until {
                break found;
            }
            std::thread::sleep(Duration::from_millis(10));
        };
        job.network.vehicle = Some("kestrel".to_owned());
        let of_another_vehicle = process(&job);
        job.network = Network::default();
        let without_a_network = process(&job);
        sleeping.kill().unwrap();
        sleeping.wait().unwrap();
        assert_eq!(found, i32::try_from(sleeping.id()).ok());
        assert_eq!((of_another_vehicle, without_a_network), (None, None));
    }
}
