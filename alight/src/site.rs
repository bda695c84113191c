//! Reads a site, the TOML file that lists the processes of every machine, into jobs with program, settings, key and network. Refuses two
//! detectors with one id.

use std::collections::BTreeMap;
use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};
use clap::ValueEnum;
use messages::looks_for_others;
use node::access::key_name;
use node::network::{Address, NO_KEYS_OVER_IPV6, variable};
use node::session::LOCAL_PORT;
use node::{ConfigError, Layers, Network, RELAY};
use serde::Deserialize;

use crate::args::{MEET_RULE, WrongUse, meet_port, source_of};
use crate::services::Service;

/// The role of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Role {
    /// The companion computer: its services, and the relay to the ground.
    Drone,
    /// A laptop on the ground.
    Ground,
    /// A base station between both.
    Relay,
    /// All processes on one machine, without a network.
    Local,
}

impl Role {
    /// The name of its table in the file and of its Zenoh configuration.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Drone => "drone",
            Self::Ground => "ground",
            Self::Relay => "relay",
            Self::Local => "local",
        }
    }
}

/// The contents of the file.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Site {
    /// The vehicle's name.
    vehicle: Option<String>,
    /// The drone's address for the ground: HOST or HOST:PORT.
    address: Option<String>,
    /// The address of a relay between both, if there is one: HOST or HOST:PORT.
    relay_address: Option<String>,
    /// The directory with the keys.
    keys: Option<PathBuf>,
    /// Whether the relay may listen without keys.
    insecure: bool,
    /// The rendezvous port of the processes of one machine.
    meet: Option<u16>,
    drone: Vec<Entry>,
    ground: Vec<Entry>,
    relay: Vec<Entry>,
    local: Vec<Entry>,
    /// The folder of the file; all paths in it are relative to it.
    #[serde(skip)]
    pub(crate) folder: PathBuf,
    /// Which of `meet` and the environment sets the rendezvous port, where the environment contains one.
    #[serde(skip)]
    pub(crate) meet_note: Option<String>,
}

/// A process in the file, and its position there as a text.
struct Placed<'a> {
    role: Role,
    place: String,
    entry: &'a Entry,
}

/// A process in the file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Entry {
    /// A service: camera-pub, detector, controller, gcs-bridge, recorder, dashboard, simulator.
    run: Option<String>,
    /// Or another program with its arguments.
    command: Option<Vec<String>>,
    /// Its name in the output [default: that of the service or the program].
    name: Option<String>,
    /// The service's configuration file.
    config: Option<PathBuf>,
    /// Settings over the file.
    #[serde(default)]
    set: Vec<String>,
}

/// A process of a role, ready to be started.
#[derive(Clone, Debug)]
pub(crate) struct Job {
    /// Its name.
    pub(crate) name: String,
    /// The service, unless it is the relay or another program.
    pub(crate) service: Option<Service>,
    /// The service's instance; none of the relay and of another program.
    pub(crate) instance: Option<String>,
    /// The program and its arguments; `alight` for this program.
    pub(crate) command: Vec<String>,
    /// The network that it joins.
    pub(crate) network: Network,
    /// The name of its key's files.
    pub(crate) key: String,
    /// The settings over the service's defaults.
    pub(crate) layers: Layers,
}

impl Job {
    /// Whether it needs a key; local processes do not.
    pub(crate) fn needs_key(&self) -> bool {
        self.network.config.as_deref().is_none_or(|config| config != Path::new("local"))
    }
}

impl Site {
    /// Reads a file. Without `meet` in it, the environment sets the rendezvous port, as for every other command.
    ///
    /// # Errors
    /// Names the file and the problem.
    pub(crate) fn read(path: &Path) -> Result<Self, ConfigError> {
        Self::read_in(path, std::env::var_os(variable::MEET))
    }

    /// The same, with the rendezvous port of an environment.
    fn read_in(path: &Path, meet: Option<OsString>) -> Result<Self, ConfigError> {
        let text = node::read_text(path)?;
        let mut site: Self = toml::from_str(&text).map_err(|cause| ConfigError::Syntax {
            source_name: path.display().to_string(),
            cause: cause.to_string().trim_end().to_owned(),
        })?;
        if site.meet == Some(0) {
            return Err(ConfigError::Refused {
                source_name: path.display().to_string(),
                key: "meet".to_owned(),
                value: "0".to_owned(),
                limit: MEET_RULE.to_owned(),
            });
        }
        site.take_meet(meet)?;
        let folder = media::folder_of(path);
        site.folder = std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned());
        Ok(site)
    }

    /// Takes the rendezvous port of the environment unless the site has its own, which is the same wherever it is started.
    fn take_meet(&mut self, environment: Option<OsString>) -> Result<(), ConfigError> {
        let Some(text) = environment.filter(|text| !text.is_empty()) else { return Ok(()) };
        let (text, name) = (text.to_string_lossy(), variable::MEET);
        let note = match self.meet {
            Some(own) if own.to_string() == text => return Ok(()),
            Some(own) => {
                format!(
                    "port {own}, by `meet` of the site, and not at {text}, by {name} in the environment"
                )
            }
            None => {
                let refused = |limit| ConfigError::Refused {
                    source_name: "the environment".to_owned(),
                    key: name.to_owned(),
                    value: text.to_string(),
                    limit,
                };
                let port = meet_port(&text).map_err(refused)?;
                self.meet = Some(port);
                format!("port {port}, by {name} in the environment, as the site has no `meet`")
            }
        };
        self.meet_note = Some(format!("the processes of this machine meet at {note}"));
        Ok(())
    }

    /// The network of the processes of a role, but of its relay.
    pub(crate) fn network(&self, role: Role) -> Network {
        // The services on the drone are local; only its relay connects to others. Those of a base station are on the ground, and reach
        // the drone through their own relay, at the port where it listens.
        let (config, connect) = match role {
            Role::Drone | Role::Local => (Role::Local, None),
            Role::Ground => {
                (Role::Ground, self.relay_address.clone().or_else(|| self.address.clone()))
            }
            Role::Relay => {
                let address = self.relay_address.as_deref().map(Address::parse);
                let port = address.and_then(Result::ok).and_then(|address| address.port);
                let port = port.map_or_else(String::new, |port| format!(":{port}"));
                (Role::Ground, Some(format!("127.0.0.1{port}")))
            }
        };
        Network {
            config: Some(config.name().into()),
            vehicle: self.vehicle.clone(),
            connect,
            listen: None,
            meet: self.meet,
            keys: self.keys.as_ref().map(|keys| self.folder.join(keys)),
            insecure: self.insecure,
        }
    }

    /// The drone's address for the ground: HOST or HOST:PORT.
    pub(crate) fn drone_address(&self) -> Option<&str> {
        self.address.as_deref()
    }

    /// The address of a relay between both, if there is one.
    pub(crate) fn relay_address(&self) -> Option<&str> {
        self.relay_address.as_deref()
    }

    /// A name for the supervisor of a role, unique on its machine.
    pub(crate) fn instance(&self, role: Role) -> String {
        let vehicle = self.vehicle.as_deref().unwrap_or("drone");
        let meet = self.meet.unwrap_or(LOCAL_PORT);
        format!("{}-{vehicle}-{meet}", role.name())
    }

    /// The processes of a role, in starting order.
    ///
    /// # Errors
    /// When an entry or a setting is invalid, or an address or a key is missing.
    pub(crate) fn jobs(&self, role: Role) -> anyhow::Result<Vec<Job>> {
        let mut jobs: Vec<Job> = self.relay_job(role)?.into_iter().collect();
        for (number, entry) in self.entries(role).iter().enumerate() {
            let job = self
                .job(role, entry)
                .with_context(|| format!("[[{}]] number {}", role.name(), number + 1))?;
            jobs.push(job);
        }
        self.check_detectors(role)?;
        ensure!(
            !jobs.is_empty(),
            WrongUse(format!("the site has no [[{}]], so there is nothing to run", role.name()))
        );
        for index in 1..jobs.len() {
            let (before, rest) = jobs.split_at_mut(index);
            let taken = before.iter().filter(|job| job.name == rest[0].name).count();
            if taken > 0 {
                rest[0].name = format!("{}-{}", rest[0].name, taken + 1);
            }
        }
        for job in &jobs {
            source_of(&job.network, &job.key).with_context(|| job.name.clone())?;
        }
        Ok(jobs)
    }

    fn entries(&self, role: Role) -> &[Entry] {
        match role {
            Role::Drone => &self.drone,
            Role::Ground => &self.ground,
            Role::Relay => &self.relay,
            Role::Local => &self.local,
        }
    }

    /// Refuses two detectors with one id, of which the second would not run: on this machine and on those that it reaches.
    fn check_detectors(&self, role: Role) -> anyhow::Result<()> {
        let mut taken = BTreeMap::new();
        for Placed { role, place, entry } in self.placed(role) {
            // The files of another machine's services may be missing here.
            let job = self.job(role, entry).ok();
            let Some(job) = job.filter(|job| job.service == Some(Service::Detector)) else {
                continue;
            };
            if let Some(first) = taken.insert(job.key.clone(), place.clone()) {
                let id = job.key.split_once('.').map_or(job.key.as_str(), |(_, id)| id);
                anyhow::bail!(WrongUse(format!(
                    "{first} and {place} are detectors with one id, `{id}`; give one of them another: set = ['id=\"other\"']"
                )));
            }
        }
        Ok(())
    }

    /// The error that no detector of the site looks for the marker of its controller. `None` if one may: by its configuration, or because
    /// it is another program or a service whose files are not here. `role` is one of the machines in question.
    pub(crate) fn marker_problem(&self, role: Role) -> Option<String> {
        let mut detectors = Vec::new();
        let mut controller = None;
        for Placed { role, place, entry } in self.placed(role) {
            let job = self.job(role, entry).ok()?;
            match job.service {
                Some(Service::Controller) => {
                    let marker = job.layers.load::<controller::Config>().ok()?.settings.marker;
                    controller = Some((place, marker));
                }
                Some(Service::Detector) => {
                    let config = job.layers.load::<detector::Config>().ok()?.settings;
                    detectors.push((place, config.looked_for().ok()?));
                }
                // It may be a detector.
                None => return None,
                Some(_) => {}
            }
        }
        let (at, marker) = controller?;
        let is_other = |markers: &Vec<String>| looks_for_others(markers, &marker);
        if detectors.is_empty() || !detectors.iter().all(|(_, markers)| is_other(markers)) {
            return None;
        }
        let searched = detectors
            .iter()
            .map(|(place, markers)| format!("{place} looks for {}", markers.join(" ")));
        let searched: Vec<String> = searched.collect();
        Some(format!(
            "the controller, {at}, lands on {marker}, and no detector looks for that: {}; correct its `marker`, or their `markers`",
            searched.join(", ")
        ))
    }

    /// The processes of the machines that meet in one network with that of a role.
    fn placed(&self, role: Role) -> impl Iterator<Item = Placed<'_>> {
        let together: &[Role] = match role {
            Role::Local => &[Role::Local],
            Role::Drone | Role::Relay | Role::Ground => &[Role::Drone, Role::Relay, Role::Ground],
        };
        together.iter().flat_map(|&role| {
            self.entries(role).iter().enumerate().map(move |(index, entry)| {
                let place = format!("[[{}]] number {}", role.name(), index + 1);
                Placed { role, place, entry }
            })
        })
    }

    fn relay_job(&self, role: Role) -> anyhow::Result<Option<Job>> {
        let (config, key, reached_at) = match role {
            Role::Drone => (Role::Drone, "address", &self.address),
            Role::Relay => (Role::Relay, "relay_address", &self.relay_address),
            Role::Ground | Role::Local => return Ok(None),
        };
        // It listens at the port to which others connect, and for IPv6 if they use that: by default it does not.
        let address = reached_at.as_deref().map(Address::parse).transpose();
        let refused = |problem: &str| WrongUse(format!("`{key}` of the site: {problem}"));
        let address = address.map_err(|problem| refused(&format!("{problem:#}")))?;
        let is_ipv6 = address.as_ref().is_some_and(|address| address.host.starts_with('['));
        ensure!(!is_ipv6 || self.keys.is_none(), refused(NO_KEYS_OVER_IPV6));
        let listen = address.and_then(|Address { port, .. }| {
            let port = port.map(|port| format!(":{port}"));
            match is_ipv6 {
                true => Some(format!("[::]{}", port.unwrap_or_default())),
                false => port.map(|port| format!("0.0.0.0{port}")),
            }
        });
        let connect = self.address.clone().filter(|_| role == Role::Relay);
        let network =
            Network { config: Some(config.name().into()), connect, listen, ..self.network(role) };
        Ok(Some(Job {
            name: RELAY.to_owned(),
            service: None,
            instance: None,
            command: vec![
                "alight".to_owned(),
                RELAY.to_owned(),
                "--id".to_owned(),
                if role == Role::Drone { "drone" } else { "base" }.to_owned(),
            ],
            network,
            key: if role == Role::Drone { "drone" } else { RELAY }.to_owned(),
            layers: Layers::default(),
        }))
    }

    fn job(&self, role: Role, entry: &Entry) -> anyhow::Result<Job> {
        let network = self.network(role);
        let (service, command) = match (&entry.run, &entry.command) {
            (Some(run), None) => {
                let service = Service::from_str(run, false).map_err(|_| ConfigError::Refused {
                    source_name: "the site".to_owned(),
                    key: "run".to_owned(),
                    value: run.clone(),
                    limit: "must be camera-pub, detector, controller, gcs-bridge, recorder, dashboard or simulator"
                        .to_owned(),
                })?;
                (Some(service), vec!["alight".to_owned(), service.name().to_owned()])
            }
            (None, Some(command)) if !command.is_empty() => {
                let rule = "`config` and `set` are for services; put the arguments of a program into its `command`";
                let has_settings = entry.config.is_some() || !entry.set.is_empty();
                ensure!(!has_settings, WrongUse(rule.to_owned()));
                (None, command.clone())
            }
            _ => {
                let rule =
                    "needs either `run`, a service, or `command`, a program with its arguments";
                anyhow::bail!(WrongUse(rule.to_owned()))
            }
        };
        let mut layers = Layers {
            file: entry.config.as_ref().map(|file| self.folder.join(file)),
            set: entry.set.clone(),
        };
        if service == Some(Service::Detector) && matches!(role, Role::Ground | Role::Relay) {
            // The controller can prefer detectors by their place.
            layers.set.insert(0, "place=ground".to_owned());
        }
        if service == Some(Service::Dashboard) && role != Role::Local && role != Role::Drone {
            // Raw frames exceed the bandwidth of any radio.
            layers.set.insert(0, "video.input=jpeg".to_owned());
        }
        let config = match service {
            Some(service) => Some(service.effective_config(&layers)?),
            None => None,
        };
        let program = command.last().filter(|_| service.is_some()).or(command.first());
        let own_name = program.map(|p| p.rsplit('/').next().unwrap_or(p).to_owned());
        let name = entry.name.clone().or(own_name).unwrap_or_default();
        // Another program is a detector of its own name.
        let instance =
            config.as_ref().and_then(|config| Some(config.get("id")?.as_str()?.to_owned()));
        let role = service.map_or(Service::Detector.name(), Service::name);
        let key = key_name(role, instance.as_deref().unwrap_or(&name));
        Ok(Job { name, service, instance, command, network, key, layers })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keys;

    fn site(text: &str) -> Site {
        toml::from_str(text).unwrap()
    }

    fn problem(text: &str, role: Role) -> String {
        format!("{:#}", site(text).jobs(role).unwrap_err())
    }

    const SITE: &str = "
        vehicle = 'kestrel'
        address = '10.42.0.1:8000'
        insecure = true
        drone = [{ run = 'detector' }, { run = 'controller', set = ['marker=\"rings\"'] }]
        ground = [{ run = 'detector', set = ['id=\"ground\"'] }, { run = 'detector', set = ['id=\"second\"'] }, { run = 'dashboard' }, { command = ['/usr/bin/python3', 'x.py'] }]";

    #[test]
    fn the_drone_has_a_relay_and_local_services() {
        let jobs = site(SITE).jobs(Role::Drone).unwrap();
        let names: Vec<_> = jobs.iter().map(|job| job.name.as_str()).collect();
        assert_eq!(names, ["relay", "detector", "controller"]);
        let relay = jobs[0].network.environment();
        assert!(relay.contains(&("ALIGHT_ZENOH", "drone".into())), "{relay:?}");
        assert!(relay.contains(&("ALIGHT_LISTEN", "0.0.0.0:8000".into())), "{relay:?}");
        let detector = jobs[1].network.environment();
        assert!(detector.contains(&("ALIGHT_ZENOH", "local".into())), "{detector:?}");
        assert!(detector.contains(&("ALIGHT_VEHICLE", "kestrel".into())), "{detector:?}");
    }

    #[test]
    fn the_ground_connects_to_the_drone_or_to_the_relay() {
        let jobs = site(SITE).jobs(Role::Ground).unwrap();
        let names: Vec<_> = jobs.iter().map(|job| job.name.as_str()).collect();
        assert_eq!(names, ["detector", "detector-2", "dashboard", "python3"]);
        assert!(
            jobs[2].layers.set.contains(&"video.input=jpeg".to_owned()),
            "{:?}",
            jobs[2].layers
        );
        assert!(jobs[0].layers.set.contains(&"place=ground".to_owned()), "{:?}", jobs[0].layers);
        let environment = jobs[0].network.environment();
        assert!(environment.contains(&("ALIGHT_CONNECT", "10.42.0.1:8000".into())));
        let mut between = site(SITE);
        between.relay_address = Some("base.local".to_owned());
        let jobs = between.jobs(Role::Ground).unwrap();
        assert!(jobs[0].network.environment().contains(&("ALIGHT_CONNECT", "base.local".into())));
    }

    #[test]
    fn processes_on_a_base_station_connect_to_its_relay() {
        let with = |relay_address: &str| {
            let own = "relay = [{ run = 'detector' }, { command = ['python3', 'x.py'] }]";
            site(&format!("address = '10.0.0.1'\ninsecure = true\n{relay_address}\n{own}"))
        };
        for (relay_address, connect) in [
            ("", "127.0.0.1"),
            ("relay_address = '192.168.1.20'", "127.0.0.1"),
            ("relay_address = '192.168.1.20:8000'", "127.0.0.1:8000"),
            ("relay_address = '[fd00::1]:8000'", "127.0.0.1:8000"),
        ] {
            let with = with(relay_address);
            let jobs = with.jobs(Role::Relay).unwrap();
            let relay = jobs[0].network.environment();
            assert!(relay.contains(&("ALIGHT_ZENOH", "relay".into())), "{relay:?}");
            assert!(relay.contains(&("ALIGHT_CONNECT", "10.0.0.1".into())), "{relay:?}");
            for network in [&jobs[1].network, &jobs[2].network, &with.network(Role::Relay)] {
                // Only the relay listens at its ports.
                let other = network.environment();
                assert!(other.contains(&("ALIGHT_ZENOH", "ground".into())), "{other:?}");
                assert!(other.contains(&("ALIGHT_CONNECT", connect.into())), "{other:?}");
            }
            assert!(jobs[1].layers.set.contains(&"place=ground".to_owned()));
        }
    }

    #[test]
    fn a_relay_listens_at_ipv6_addresses_when_others_connect_to_one() {
        for (address, listen) in [
            ("fd00::1", Some("[::]")),
            ("[fd00::1]", Some("[::]")),
            ("[fd00::1]:8000", Some("[::]:8000")),
            ("10.0.0.1:8000", Some("0.0.0.0:8000")),
            ("10.0.0.1", None),
            ("kestrel.local", None),
        ] {
            let of_drone = format!("insecure = true\naddress = '{address}'");
            let of_base =
                format!("insecure = true\naddress = '10.0.0.1'\nrelay_address = '{address}'");
            for (text, role) in [(of_drone, Role::Drone), (of_base, Role::Relay)] {
                let jobs = site(&text).jobs(role).unwrap();
                assert_eq!(jobs[0].network.listen.as_deref(), listen, "{text}");
            }
        }
        let error = problem("keys = 'keys'\naddress = 'fd00::1'", Role::Drone);
        assert!(error.contains("`address` of the site: with keys, nothing"), "{error}");
    }

    /// The example, with the keys that `docs/deploy.md` makes for it.
    fn example_with_keys(change: impl Fn(String) -> String) -> (tempfile::TempDir, Site) {
        let home = tempfile::tempdir().unwrap();
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
        std::fs::copy(folder.join("camera.toml"), home.path().join("camera.toml")).unwrap();
        let text = std::fs::read_to_string(folder.join("site.toml")).unwrap();
        let path = home.path().join("site.toml");
        std::fs::write(&path, change(text)).unwrap();
        keys::make_for_tests(&home.path().join("keys"), &["ground"]).unwrap();
        let site = Site::read(&path).unwrap();
        (home, site)
    }

    #[test]
    fn the_example_is_valid() {
        let (_home, example) = example_with_keys(|text| text);
        for role in [Role::Drone, Role::Ground, Role::Relay] {
            example.jobs(role).unwrap();
        }
    }

    #[test]
    fn the_examples_of_one_machine_are_valid_and_need_no_keys() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
        for (name, services) in [
            ("rehearsal.toml", "simulator detector controller gcs-bridge dashboard"),
            ("pi5-usb.toml", "recorder camera-pub detector controller"),
        ] {
            let jobs = Site::read(&folder.join(name)).unwrap().jobs(Role::Local).unwrap();
            let names: Vec<&str> =
                jobs.iter().filter_map(|job| job.service).map(Service::name).collect();
            assert_eq!(names.join(" "), services, "{name}");
            for job in jobs {
                // Every key of an example is known, and the keys that it leaves out have their defaults.
                job.service.unwrap().effective_config(&job.layers).unwrap();
            }
        }
    }

    #[test]
    fn without_keys_the_example_runs_only_with_insecure_set() {
        let (_home, without) = example_with_keys(|text| text.replace("\nkeys = ", "\n# keys = "));
        for role in [Role::Drone, Role::Relay] {
            let problem = format!("{:#}", without.jobs(role).unwrap_err());
            assert!(problem.contains("insecure = true"), "{problem}");
        }
        let (_home, insecure) =
            example_with_keys(|text| text.replace("\nkeys = \"keys\"", "\ninsecure = true"));
        let jobs = insecure.jobs(Role::Drone).unwrap();
        let relay = jobs[0].network.environment();
        assert!(relay.contains(&("ALIGHT_INSECURE", "true".into())), "{relay:?}");
    }

    #[test]
    fn a_detector_on_the_ground_needs_the_key_of_its_name() {
        let (_home, other) = example_with_keys(|text| text.replace("id=ground", "id=laptop"));
        let problem = format!("{:#}", other.jobs(Role::Ground).unwrap_err());
        assert!(problem.contains("--role detector --name laptop"), "{problem}");
    }

    #[test]
    fn two_detectors_with_one_id_are_refused() {
        let detector = "{ run = 'detector', set = ['id=\"one\"'] }";
        let local = format!("local = [{detector}, {detector}]");
        let error = problem(&local, Role::Local);
        assert!(error.contains("[[local]] number 1 and [[local]] number 2"), "{error}");
        assert!(error.contains("`one`"), "{error}");
        let apart = format!(
            "address = '10.0.0.1'\ninsecure = true\ndrone = [{detector}]\nground = [{{ run = 'dashboard' }}, {detector}]"
        );
        for role in [Role::Drone, Role::Ground] {
            let error = problem(&apart, role);
            assert!(error.contains("[[drone]] number 1 and [[ground]] number 2"), "{error}");
        }
    }

    #[test]
    fn a_controller_whose_marker_no_detector_of_the_site_looks_for_is_reported() {
        let of = |drone: &str, ground: &str, role: Role| {
            let text = format!(
                "address = '10.0.0.1'\ninsecure = true\ndrone = [{drone}]\nground = [{ground}]"
            );
            site(&text).marker_problem(role)
        };
        let controller = "{ run = 'controller', set = ['marker=\"aruco-4x4-50:7\"'] }";
        let detector =
            |markers: &str| format!("{{ run = 'detector', set = ['markers={markers}'] }}");
        let (rings, tag) = (detector("[\"rings:0.15\"]"), detector("[\"aruco-4x4-50:*:0.1\"]"));
        let wrong = format!("{controller}, {rings}");
        let dashboard = "{ run = 'dashboard' }";
        for role in [Role::Drone, Role::Ground] {
            let error = of(&wrong, dashboard, role).unwrap();
            assert!(error.contains("[[drone]] number 1, lands on aruco-4x4-50:7"), "{error}");
            assert!(error.contains("[[drone]] number 2 looks for rings:0.15"), "{error}");
            assert_eq!(of(&wrong, &tag, role), None, "one on the ground does");
        }
        assert_eq!(of(&wrong, dashboard, Role::Local), None, "it has no process here");
        assert_eq!(
            of(&format!("{wrong}, {{ command = ['./mine'] }}"), dashboard, Role::Drone),
            None
        );
        let unread = "{ run = 'detector', config = 'not-here.toml' }";
        assert_eq!(of(&format!("{wrong}, {unread}"), dashboard, Role::Drone), None);
        assert_eq!(of(controller, dashboard, Role::Drone), None, "none is named");
        assert_eq!(of(&format!("{controller}, {tag}"), dashboard, Role::Drone), None);
    }

    #[test]
    fn a_site_in_another_encoding_is_refused_with_its_line() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("site.toml");
        std::fs::write(&path, b"vehicle = 'x'\n# H\xf6he\n").unwrap();
        let error = Site::read(&path).unwrap_err().to_string();
        assert!(error.contains("site.toml") && error.contains("line 2"), "{error}");
        assert!(error.contains("save it as UTF-8"), "{error}");
    }

    #[test]
    fn a_site_whose_processes_would_meet_at_any_port_is_refused() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("site.toml");
        std::fs::write(&path, "meet = 0").unwrap();
        let error = Site::read(&path).unwrap_err().to_string();
        assert!(error.contains("`meet` = 0 is invalid") && error.contains("1 to 65535"), "{error}");
        std::fs::write(&path, "meet = 9000").unwrap();
        assert_eq!(Site::read(&path).unwrap().meet, Some(9000));
    }

    #[test]
    fn the_port_of_the_environment_is_used_unless_the_site_has_one() {
        let home = tempfile::tempdir().unwrap();
        let path = home.path().join("site.toml");
        let read = |text: &str, environment: Option<&str>| {
            std::fs::write(&path, format!("{text}\nlocal = [{{ run = 'detector' }}]")).unwrap();
            Site::read_in(&path, environment.map(Into::into))
        };
        let other = read("", Some("7555")).unwrap();
        let environment = other.jobs(Role::Local).unwrap()[0].network.environment();
        assert!(environment.contains(&("ALIGHT_MEET", "7555".into())), "{environment:?}");
        assert_eq!(other.instance(Role::Local), "local-drone-7555");
        let note = other.meet_note.unwrap();
        assert!(note.contains("meet at port 7555, by ALIGHT_MEET in the environment"), "{note}");
        let own = read("meet = 9000", Some("7555")).unwrap();
        assert_eq!(own.network(Role::Local).meet, Some(9000));
        let note = own.meet_note.unwrap();
        assert!(note.contains("port 9000, by `meet` of the site, and not at 7555"), "{note}");
        for (text, environment) in [("meet = 9000", "9000"), ("", "")] {
            assert_eq!(read(text, Some(environment)).unwrap().meet_note, None);
        }
        assert_eq!(read("", None).unwrap().network(Role::Local).meet, None);
        let error = read("", Some("0")).unwrap_err().to_string();
        assert!(error.contains("`ALIGHT_MEET` = 0 is invalid"), "{error}");
    }

    #[test]
    fn problems_in_a_site_are_reported() {
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
