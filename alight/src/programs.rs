//! Finds the programs, devices and files that the processes of a site need and this machine does not have.

use std::ffi::OsStr;
use std::io::ErrorKind;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use controller::KeyFileError;

use crate::services::Service;
use crate::site::Job;

/// The name of this program in a command.
pub(crate) const OWN_PROGRAM: &str = "alight";

/// Why the program of a process cannot be started, with what to do, or `None`: it is looked for at its path from the site's folder,
/// or in one of the folders of `search`.
pub(crate) fn missing(job: &Job, folder: &Path, search: &OsStr) -> Option<String> {
    let program = job.command.first().filter(|program| *program != OWN_PROGRAM)?;
    absent(program, folder, search)
        .map(|absent| format!("{}: {absent}; install it, or correct its `command`", job.name))
}

/// The same of a program that a service starts: the one that reads a camera.
pub(crate) fn missing_of_service(job: &Job, folder: &Path, search: &OsStr) -> Option<String> {
    let service = job.service.filter(|service| *service == Service::CameraPub)?;
    let config = service.effective_config(&job.layers).ok()?;
    let command = config.get("source")?.get("command")?.as_array()?;
    let program = command.first()?.as_str()?;
    absent(program, folder, search).map(|absent| {
        format!("{}: {absent}; install it, or correct its `source.command`", job.name)
    })
}

/// The missing devices and files of a service, with the remedy: the autopilot's serial port, a camera, images, a calibration, a key for
/// signed packets, which may also be unusable.
pub(crate) fn missing_devices(job: &Job, folder: &Path) -> Vec<String> {
    let Some(config) = job.service.and_then(|it| it.effective_config(&job.layers).ok()) else {
        return Vec::new();
    };
    let text = |table: &str, key: &str| {
        let value = config.get(table).and_then(|table| table.get(key));
        value.and_then(toml::Value::as_str).filter(|text| !text.is_empty())
    };
    let mut wanted: Vec<(String, &str, &str)> = Vec::new();
    match job.service {
        Some(Service::Controller) => {
            let settings = job.layers.load::<controller::Config>().map(|it| it.settings);
            let device = settings.ok().and_then(|it| it.serial_device());
            let advice = "connect the autopilot, or correct `autopilot.address`";
            wanted.extend(device.map(|device| (device, "device", advice)));
        }
        Some(Service::CameraPub) => {
            let device = text("source", "device").map(str::to_owned);
            let advice = "connect the camera (`alight cameras` lists those that are there), or correct `source.device`";
            wanted.extend(device.map(|device| (device, "device", advice)));
            let paths = config.get("source").and_then(|it| it.get("paths")?.as_array());
            let paths = paths.into_iter().flatten().filter_map(toml::Value::as_str);
            wanted.extend(paths.map(|path| (path.to_owned(), "file", "correct `source.paths`")));
            let file = text("calibration", "file").map(str::to_owned);
            let advice =
                "calibrate the camera (`alight calibrate board`), or correct `calibration.file`";
            wanted.extend(file.map(|file| (file, "file", advice)));
        }
        _ => {}
    }
    wanted.retain(|(path, _, _)| std::fs::metadata(folder.join(path)).is_err());
    let message =
        |(path, what, advice)| format!("{}: there is no {what} {path}; {advice}", job.name);
    let missing = wanted.into_iter().map(message);
    let key = unusable_key(job, folder).map(|error| match &error {
        KeyFileError::Read { path, cause } if cause.kind() == ErrorKind::NotFound => {
            let path = path.strip_prefix(folder).unwrap_or(path).display();
            let name = match job.service {
                Some(Service::Controller) => "autopilot.signing_key",
                _ => "signing_key",
            };
            format!("there is no file {path}; make it (`alight keys signing`), or correct `{name}`")
        }
        _ => error.to_string(),
    });
    missing.chain(key.map(|it| format!("{}: {it}", job.name))).collect()
}

/// Why a service's key for signed MAVLink packets cannot be used, if it has one.
pub(crate) fn unusable_key(job: &Job, folder: &Path) -> Option<KeyFileError> {
    let in_folder = |key: &mut String| {
        if !key.is_empty() {
            *key = folder.join(&key).to_string_lossy().into_owned();
        }
    };
    match job.service {
        Some(Service::Controller) => {
            let mut settings = job.layers.load::<controller::Config>().ok()?.settings;
            in_folder(&mut settings.autopilot.signing_key);
            settings.signing().err()
        }
        Some(Service::GcsBridge) => {
            let mut settings = job.layers.load::<gcs_bridge::Config>().ok()?.settings;
            in_folder(&mut settings.signing_key);
            settings.signing().err()
        }
        _ => None,
    }
}

fn absent(program: &str, folder: &Path, search: &OsStr) -> Option<String> {
    let is_program = |path: PathBuf| {
        let found = std::fs::metadata(path);
        found.is_ok_and(|it| it.is_file() && it.permissions().mode() & 0o111 != 0)
    };
    let (is_found, place) = match program.contains('/') {
        true => (is_program(folder.join(program)), format!("from {}", folder.display())),
        false => {
            let mut places = std::env::split_paths(search);
            (places.any(|place| is_program(place.join(program))), "in the PATH".to_owned())
        }
    };
    (!is_found).then(|| format!("there is no program `{program}` {place}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn job(service: Service, command: &[&str], set: &[&str]) -> Job {
        Job {
            name: service.name().to_owned(),
            service: Some(service),
            instance: None,
            command: command.iter().map(|&it| it.to_owned()).collect(),
            network: node::Network::default(),
            key: service.name().to_owned(),
            layers: node::Layers { file: None, set: set.iter().map(|&it| it.to_owned()).collect() },
        }
    }

    /// A folder with the file `there`, which may be run.
    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("there");
        std::fs::write(&file, "#!/bin/sh\n").unwrap();
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o755)).unwrap();
        folder
    }

    #[test]
    fn a_program_that_is_not_found_is_named() {
        let folder = folder();
        let error = |program: &str| {
            let job = job(Service::Detector, &[program], &[]);
            missing(&job, folder.path(), folder.path().as_os_str())
        };
        let file = folder.path().join("there");
        for program in ["alight", "there", "./there", file.to_str().unwrap()] {
            assert_eq!(error(program), None, "{program}");
        }
        for program in ["absent", "./absent", "/no/such"] {
            let error = error(program).unwrap();
            let named = format!("detector: there is no program `{program}`");
            assert!(error.contains(&named), "{error}");
        }
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o644)).unwrap();
        assert!(error("there").is_some(), "it may not be run");
    }

    #[test]
    fn devices_and_files_that_are_not_there_are_named() {
        let folder = folder();
        let missing =
            |service, set: &[&str]| missing_devices(&job(service, &[], set), folder.path());
        let line = missing(Service::Controller, &["autopilot.address=serial:/dev/no-such:57600"]);
        assert!(
            line[0].contains("controller: there is no device /dev/no-such; connect"),
            "{line:?}"
        );
        let line = missing(Service::Controller, &["autopilot.address=udpin:0.0.0.0:14550"]);
        assert_eq!(line, Vec::<String>::new());
        let line = missing(Service::Controller, &["autopilot.signing_key=no-such.signing"]);
        assert!(
            line[0].contains("controller: there is no file no-such.signing; make it"),
            "{line:?}"
        );
        let line = missing(Service::GcsBridge, &["signing_key=no-such.signing"]);
        assert!(
            line[0].contains("gcs-bridge: there is no file no-such.signing; make it"),
            "{line:?}"
        );
        let line = missing(Service::GcsBridge, &["signing_key=there"]);
        assert!(line[0].contains("there\" is open to other users (mode 755)"), "{line:?}");
        let key = folder.path().join("key");
        std::fs::write(&key, "correct horse battery").unwrap();
        std::fs::set_permissions(&key, std::fs::Permissions::from_mode(0o600)).unwrap();
        assert_eq!(missing(Service::GcsBridge, &["signing_key=key"]), Vec::<String>::new());
        let size = "source.size_px=[64, 48]";
        let camera = missing(
            Service::CameraPub,
            &["source.device=/dev/video-no", size, "calibration.file=c.yaml"],
        );
        assert!(
            camera[0].contains("no device /dev/video-no") && camera[1].contains("no file c.yaml"),
            "{camera:?}"
        );
        assert_eq!(missing(Service::CameraPub, &["source.paths=['there']"]), Vec::<String>::new());
        assert_eq!(missing(Service::CameraPub, &["source.paths=['not-there']"]).len(), 1);
    }

    #[test]
    fn the_program_of_a_camera_is_looked_for_as_well() {
        let folder = folder();
        let error = |command: &str| {
            let command = format!("source.command={command}");
            let set = ["source.size_px=[64, 48]", "calibration.file=c.yaml", command.as_str()];
            let job = job(Service::CameraPub, &["alight", "camera-pub"], &set);
            missing_of_service(&job, folder.path(), folder.path().as_os_str())
        };
        assert_eq!(error("['there', 'x']"), None);
        assert_eq!(error("['./there']"), None);
        let problem = error("['rpicam-none', 'x']").unwrap();
        assert_eq!(
            problem,
            "camera-pub: there is no program `rpicam-none` in the PATH; install it, or correct its `source.command`"
        );
    }
}
