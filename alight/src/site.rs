//! A site: one TOML file that says for every machine what runs there, and how the machines find each other.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::ValueEnum;
use node::{ConfigError, Layers, Network};
use serde::Deserialize;

use crate::relay;
use crate::services::Service;

/// What a machine is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Role {
    /// The companion computer: its services, and the relay to the ground.
    Drone,
    /// A laptop on the ground.
    Ground,
    /// A base station between both.
    Relay,
    /// Everything on one machine, nothing outside.
    Local,
}

impl Role {
    /// The name of its table in the file, and of its Zenoh configuration.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Drone => "drone",
            Self::Ground => "ground",
            Self::Relay => "relay",
            Self::Local => "local",
        }
    }
}

/// The file.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Site {
    /// The vehicle's name.
    vehicle: Option<String>,
    /// Where the drone is for the ground: HOST or HOST:PORT.
    address: Option<String>,
    /// Where a relay between both is, if there is one: HOST or HOST:PORT.
    relay_address: Option<String>,
    /// The directory with the keys.
    keys: Option<PathBuf>,
    /// Where the processes of one machine meet.
    meet: Option<u16>,
    drone: Vec<Entry>,
    ground: Vec<Entry>,
    relay: Vec<Entry>,
    local: Vec<Entry>,
    /// Where the file is: all paths in it are relative to it.
    #[serde(skip)]
    pub(crate) folder: PathBuf,
}

/// A process.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Entry {
    /// A service: camera-pub, detector, controller, gcs-bridge, simulator.
    run: Option<String>,
    /// Or a program of one's own.
    command: Option<Vec<String>>,
    /// What it is called in the output; the service's or the program's name if it is left out.
    name: Option<String>,
    /// The service's configuration file.
    config: Option<PathBuf>,
    /// Settings laid over it.
    #[serde(default)]
    set: Vec<String>,
}

/// A process of a role, ready to be started.
#[derive(Clone, Debug)]
pub(crate) struct Job {
    /// What it is called.
    pub(crate) name: String,
    /// The service, unless it is the relay or a program of one's own.
    pub(crate) service: Option<Service>,
    /// The program, and what follows it; `alight` for this one.
    pub(crate) command: Vec<String>,
    /// What its environment says of the network.
    pub(crate) network: Network,
    /// The role whose key it shows.
    pub(crate) key: String,
    /// What is laid over the service's defaults.
    pub(crate) layers: Layers,
}

impl Job {
    /// Whether it shows a key: the services on the drone are among themselves.
    pub(crate) fn needs_key(&self) -> bool {
        self.network.config.as_deref().is_none_or(|config| config != Path::new("local"))
    }

    /// The network as environment variables, which every subcommand reads.
    pub(crate) fn environment(&self) -> Vec<(&'static str, String)> {
        let Network { config, vehicle, connect, listen, meet, keys } = self.network.clone();
        let path = |path: PathBuf| path.display().to_string();
        [
            ("ALIGHT_ZENOH", config.map(path)),
            ("ALIGHT_CONNECT", connect),
            ("ALIGHT_LISTEN", listen),
            ("ALIGHT_MEET", meet.map(|port| port.to_string())),
            ("ALIGHT_VEHICLE", vehicle),
            ("ALIGHT_KEYS", keys.map(path)),
        ]
        .into_iter()
        .filter_map(|(name, value)| Some((name, value?)))
        .collect()
    }
}

impl Site {
    /// Reads a file.
    ///
    /// # Errors
    /// Names the file and what is wrong in it.
    pub(crate) fn read(path: &Path) -> Result<Self, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|cause| ConfigError::Unreadable { path: path.to_owned(), cause })?;
        let mut site: Self = toml::from_str(&text).map_err(|cause| ConfigError::Syntax {
            source_name: path.display().to_string(),
            cause: cause.to_string().trim_end().to_owned(),
        })?;
        let folder = path.parent().filter(|folder| *folder != Path::new(""));
        let folder = folder.unwrap_or(Path::new("."));
        site.folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        Ok(site)
    }

    /// The network as a process of a role joins it.
    pub(crate) fn network(&self, role: Role) -> Network {
        let connect = match role {
            Role::Ground => self.relay_address.clone().or_else(|| self.address.clone()),
            Role::Relay => self.address.clone(),
            Role::Drone | Role::Local => None,
        };
        Network {
            // On the drone the processes are among themselves; its relay is their way out.
            config: Some(if role == Role::Drone { Role::Local } else { role }.name().into()),
            vehicle: self.vehicle.clone(),
            connect,
            listen: None,
            meet: self.meet,
            keys: self.keys.as_ref().map(|keys| self.folder.join(keys)),
        }
    }

    /// What tells the supervisor of a role from others on the same machine.
    pub(crate) fn instance(&self, role: Role) -> String {
        let vehicle = self.vehicle.as_deref().unwrap_or("drone");
        let meet = self.meet.unwrap_or(node::session::LOCAL_PORT);
        format!("{}-{vehicle}-{meet}", role.name())
    }

    /// What runs in a role, in the order in which it is started.
    ///
    /// # Errors
    /// When an entry makes no sense, a setting is refused, or an address or a key is missing.
    pub(crate) fn jobs(&self, role: Role) -> anyhow::Result<Vec<Job>> {
        let entries = match role {
            Role::Drone => &self.drone,
            Role::Ground => &self.ground,
            Role::Relay => &self.relay,
            Role::Local => &self.local,
        };
        let mut jobs: Vec<Job> = self.relay_job(role).into_iter().collect();
        for (number, entry) in entries.iter().enumerate() {
            let job = self
                .job(role, entry)
                .with_context(|| format!("[[{}]] number {}", role.name(), number + 1))?;
            jobs.push(job);
        }
        ensure!(!jobs.is_empty(), "the site has no [[{}]]: there is nothing to run", role.name());
        for index in 1..jobs.len() {
            let (before, rest) = jobs.split_at_mut(index);
            let taken = before.iter().filter(|job| job.name == rest[0].name).count();
            if taken > 0 {
                rest[0].name = format!("{}-{}", rest[0].name, taken + 1);
            }
        }
        for job in &jobs {
            job.network.source(&job.key).with_context(|| job.name.clone())?;
        }
        Ok(jobs)
    }

    fn relay_job(&self, role: Role) -> Option<Job> {
        let (config, reached_at) = match role {
            Role::Drone => (Role::Drone, &self.address),
            Role::Relay => (Role::Relay, &self.relay_address),
            Role::Ground | Role::Local => return None,
        };
        // Others find it at the port that they are given.
        let port = reached_at.as_deref().and_then(port_of);
        let network = Network {
            config: Some(config.name().into()),
            listen: port.map(|port| format!("0.0.0.0:{port}")),
            ..self.network(role)
        };
        Some(Job {
            name: relay::NAME.to_owned(),
            service: None,
            command: vec![
                "alight".to_owned(),
                relay::NAME.to_owned(),
                "--id".to_owned(),
                if role == Role::Drone { "drone" } else { "base" }.to_owned(),
            ],
            network,
            key: if role == Role::Drone { "drone" } else { relay::NAME }.to_owned(),
            layers: Layers::default(),
        })
    }

    fn job(&self, role: Role, entry: &Entry) -> anyhow::Result<Job> {
        let network = self.network(role);
        let (service, command) = match (&entry.run, &entry.command) {
            (Some(run), None) => {
                let service = Service::from_str(run, false).map_err(|_| ConfigError::Refused {
                    source_name: "the site".to_owned(),
                    key: "run".to_owned(),
                    value: run.clone(),
                    limit: "it must be camera-pub, detector, controller, gcs-bridge or simulator"
                        .to_owned(),
                })?;
                (Some(service), vec!["alight".to_owned(), service.name().to_owned()])
            }
            (None, Some(command)) if !command.is_empty() => {
                ensure!(
                    entry.config.is_none() && entry.set.is_empty(),
                    "`config` and `set` are for services; write the arguments of a program into its `command`"
                );
                (None, command.clone())
            }
            _ => anyhow::bail!(
                "it needs either `run`, a service, or `command`, a program with its arguments"
            ),
        };
        let mut layers = Layers {
            file: entry.config.as_ref().map(|file| self.folder.join(file)),
            set: entry.set.clone(),
        };
        if service == Some(Service::Detector) && role == Role::Ground {
            // Who prefers the detectors on the ground must be able to tell them.
            layers.set.insert(0, "place=ground".to_owned());
        }
        if let Some(service) = service {
            service.effective_config(&layers)?;
        }
        let program = command.last().filter(|_| service.is_some()).or(command.first());
        let own_name = program.map(|p| p.rsplit('/').next().unwrap_or(p).to_owned());
        let name = entry.name.clone().or(own_name).unwrap_or_default();
        let key = service.map_or("detector", Service::name).to_owned();
        Ok(Job { name, service, command, network, key, layers })
    }
}

fn port_of(address: &str) -> Option<u16> {
    let (host, port) = address.rsplit_once(':')?;
    (!host.contains(':') || host.ends_with(']')).then(|| port.parse().ok())?
}

#[cfg(test)]
mod tests {
    use super::*;

    fn site(text: &str) -> Site {
        toml::from_str(text).unwrap()
    }

    fn problem(text: &str, role: Role) -> String {
        format!("{:#}", site(text).jobs(role).unwrap_err())
    }

    const SITE: &str = "
        vehicle = 'kestrel'
        address = '10.42.0.1:8000'
        drone = [{ run = 'detector' }, { run = 'controller', set = ['marker=\"rings\"'] }]
        ground = [{ run = 'detector', set = ['id=\"ground\"'] }, { run = 'detector' }, { command = ['/usr/bin/python3', 'x.py'] }]";

    #[test]
    fn the_drone_has_a_relay_and_its_services_are_among_themselves() {
        let jobs = site(SITE).jobs(Role::Drone).unwrap();
        let names: Vec<_> = jobs.iter().map(|job| job.name.as_str()).collect();
        assert_eq!(names, ["relay", "detector", "controller"]);
        let relay = jobs[0].environment();
        assert!(relay.contains(&("ALIGHT_ZENOH", "drone".to_owned())), "{relay:?}");
        assert!(relay.contains(&("ALIGHT_LISTEN", "0.0.0.0:8000".to_owned())), "{relay:?}");
        let detector = jobs[1].environment();
        assert!(detector.contains(&("ALIGHT_ZENOH", "local".to_owned())), "{detector:?}");
        assert!(detector.contains(&("ALIGHT_VEHICLE", "kestrel".to_owned())), "{detector:?}");
    }

    #[test]
    fn the_ground_connects_to_the_drone_or_to_the_relay() {
        let jobs = site(SITE).jobs(Role::Ground).unwrap();
        let names: Vec<_> = jobs.iter().map(|job| job.name.as_str()).collect();
        assert_eq!(names, ["detector", "detector-2", "python3"]);
        assert!(jobs[0].layers.set.contains(&"place=ground".to_owned()), "{:?}", jobs[0].layers);
        let environment = jobs[0].environment();
        assert!(environment.contains(&("ALIGHT_CONNECT", "10.42.0.1:8000".to_owned())));
        let mut between = site(SITE);
        between.relay_address = Some("base.local".to_owned());
        let jobs = between.jobs(Role::Ground).unwrap();
        assert!(jobs[0].environment().contains(&("ALIGHT_CONNECT", "base.local".to_owned())));
    }

    #[test]
    fn the_example_is_a_site() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy/site.toml");
        let example = Site::read(&path).unwrap();
        for role in [Role::Drone, Role::Ground, Role::Relay] {
            example.jobs(role).unwrap();
        }
    }

    #[test]
    fn what_is_wrong_in_a_site_is_said() {
        assert!(problem("vehicle = 'x'", Role::Ground).contains("no [[ground]]"));
        assert!(problem("ground = [{ run = 'detector' }]", Role::Ground).contains("--connect"));
        let wrong = "drone = [{ run = 'detectr' }]";
        assert!(
            problem(wrong, Role::Drone).contains("[[drone]] number 1"),
            "{}",
            problem(wrong, Role::Drone)
        );
        let wrong = "drone = [{ run = 'detector', set = ['idd=1'] }]";
        assert!(problem(wrong, Role::Drone).contains("did you mean"));
        assert!(problem("drone = [{ name = 'x' }]", Role::Drone).contains("either `run`"));
        assert!(toml::from_str::<Site>("vehicel = 'x'").is_err());
    }
}
