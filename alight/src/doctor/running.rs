//! Finds the process of a service that runs on this machine and does not answer, by its command line and its environment.

use std::os::unix::ffi::OsStrExt;

use crate::site::Job;
use crate::up::arguments;

/// The number of the process that `alight up` started for a job, if this user may look at it.
pub(super) fn process(job: &Job) -> Option<i32> {
    let command: Vec<Vec<u8>> = arguments(job).into_iter().map(String::into_bytes).collect();
    let environment: Vec<Vec<u8>> = job
        .network
        .environment()
        .into_iter()
        .map(|(name, value)| [name.as_bytes(), b"=", value.as_bytes()].concat())
        .collect();
    let entries = std::fs::read_dir("/proc").ok()?.flatten();
    let mut numbers = entries.filter_map(|entry| entry.file_name().to_str()?.parse::<i32>().ok());
    numbers.find(|number| {
        // The program may have any path, and more arguments follow.
        let arguments = parts(*number, "cmdline");
        let is_command = arguments.len() >= command.len()
            && arguments.iter().zip(&command).skip(1).all(|(one, other)| one == other);
        is_command && {
            let variables = parts(*number, "environ");
            environment.iter().all(|wanted| variables.contains(wanted))
        }
    })
}

/// The parts of a process's file, each of which ends in a zero byte; nothing of one that this user may not read.
fn parts(number: i32, file: &str) -> Vec<Vec<u8>> {
    let bytes = std::fs::read(format!("/proc/{number}/{file}")).unwrap_or_default();
    bytes.split(|byte| *byte == 0).map(<[u8]>::to_vec).collect()
}

#[cfg(test)]
mod tests {
    use std::process::{Command, Stdio};

    use node::{Layers, Network};

    use super::*;
    use crate::services::Service;

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
        let found = process(&job);
        job.network.vehicle = Some("kestrel".to_owned());
        let other = process(&job);
        sleeping.kill().unwrap();
        sleeping.wait().unwrap();
        assert_eq!((found, other), (i32::try_from(sleeping.id()).ok(), None));
    }
}
