//! Makes the Zenoh configuration of a process: its role's JSON5, built in or of a file, with the site's vehicle name, addresses and
//! keys filled in. Checks access rules, key files and ports.
//!
//! The processes of a role connect in the same way at every site. The differences are filled in here, so that no site needs files
//! of its own.

use std::ffi::OsString;
use std::io;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail, ensure};
use serde_json::{Value, json};

use crate::access::{HOLDERS, access_control};
use crate::config::{NAME_RULE, is_name};
use crate::endpoint::Endpoint;
use crate::key_pair;
use crate::session::{LOCAL_CONFIG, LOCAL_PORT, ZenohSource};

/// The relay on the drone.
pub const DRONE_CONFIG: &str = include_str!("../../../zenoh-config/drone.json5");
/// A process on the ground.
pub const GROUND_CONFIG: &str = include_str!("../../../zenoh-config/ground.json5");
/// A relay between drone and ground.
pub const RELAY_CONFIG: &str = include_str!("../../../zenoh-config/relay.json5");
/// TLS and access control, added by [`Network::keys`].
pub const SECURED_CONFIG: &str = include_str!("../../../zenoh-config/secured.json5");

/// The port of the air link for control; the next two are for frames.
pub const AIR_PORT: u16 = 7448;

/// The error that a process counts in its health when every client in range may command it.
pub const INSECURE: &str = "insecure: without keys anyone in reach can command the vehicle";

/// The error that a bridge counts in its health when every ground station in range may command by it.
pub const OPEN: &str =
    "open: any ground station in reach can command the vehicle; see `ground_stations`";

/// The file name of the authority's certificate in a directory of keys.
pub const AUTHORITY: &str = "authority.pem";

/// The error of an IPv6 address with keys, and a remedy.
pub const NO_KEYS_OVER_IPV6: &str = "with keys, nothing can be reached at an IPv6 address: give the IPv4 address of that machine, which its key has to name as well \
     (`alight keys issue --address`)";

/// Maximum port of an address: the next two are used as well.
const MAX_PORT: u16 = u16::MAX - 2;
/// The placeholder in a configuration for the address of the other side.
const ADDRESS_PLACEHOLDER: &str = "DRONE";
/// The loopback interface.
const LOOPBACK: &str = "127.0.0.1";

/// The environment variables that set a [`Network`].
pub mod variable {
    /// [`Network::config`](super::Network::config).
    pub const ZENOH: &str = "ALIGHT_ZENOH";
    /// [`Network::connect`](super::Network::connect).
    pub const CONNECT: &str = "ALIGHT_CONNECT";
    /// [`Network::listen`](super::Network::listen).
    pub const LISTEN: &str = "ALIGHT_LISTEN";
    /// [`Network::meet`](super::Network::meet).
    pub const MEET: &str = "ALIGHT_MEET";
    /// [`Network::vehicle`](super::Network::vehicle).
    pub const VEHICLE: &str = "ALIGHT_VEHICLE";
    /// [`Network::keys`](super::Network::keys).
    pub const KEYS: &str = "ALIGHT_KEYS";
    /// [`Network::insecure`](super::Network::insecure).
    pub const INSECURE: &str = "ALIGHT_INSECURE";
    /// All of them.
    pub const ALL: [&str; 7] = [ZENOH, CONNECT, LISTEN, MEET, VEHICLE, KEYS, INSECURE];
}

/// A network to join. The default is local to this machine.
#[derive(Clone, Debug, Default)]
pub struct Network {
    /// A built-in configuration (`local`, `drone`, `ground`, `relay`) or a JSON5 file; `local` if there is
    /// none.
    pub config: Option<PathBuf>,
    /// The vehicle's name, the namespace of all keys.
    pub vehicle: Option<String>,
    /// The address of the drone or of the relay to it: `HOST` or `HOST:PORT`.
    pub connect: Option<String>,
    /// The address at which this process listens: `HOST` or `HOST:PORT`.
    pub listen: Option<String>,
    /// The rendezvous port of this machine.
    pub meet: Option<u16>,
    /// The directory with the keys; enables TLS and access control.
    pub keys: Option<PathBuf>,
    /// Whether it may listen beyond this machine without keys.
    pub insecure: bool,
}

impl Network {
    /// The session's configuration for a process with the key `key_name` ([`crate::access::key_name`]).
    ///
    /// # Errors
    /// When a file cannot be read or is not a configuration, or when an address is missing or invalid.
    pub fn source(&self, key_name: &str) -> anyhow::Result<ZenohSource> {
        Ok(ZenohSource::Text(serde_json::to_string(&self.configuration(key_name)?)?))
    }

    /// Whether it is allowed to listen beyond this machine without keys, and does.
    ///
    /// # Errors
    /// As [`Network::source`].
    pub fn is_open(&self) -> anyhow::Result<bool> {
        Ok(self.insecure
            && self.keys.is_none()
            && open_endpoint(&self.configuration("")?).is_some())
    }

    /// This network as environment variables, for a child process.
    pub fn environment(&self) -> Vec<(&'static str, OsString)> {
        let path = |path: &Option<PathBuf>| path.as_ref().map(|path| path.clone().into_os_string());
        let text = |text: &Option<String>| text.as_ref().map(Into::into);
        let all = [
            (variable::ZENOH, path(&self.config)),
            (variable::CONNECT, text(&self.connect)),
            (variable::LISTEN, text(&self.listen)),
            (variable::MEET, self.meet.map(|port| port.to_string().into())),
            (variable::VEHICLE, text(&self.vehicle)),
            (variable::KEYS, path(&self.keys)),
            (variable::INSECURE, self.insecure.then(|| "true".into())),
        ];
        all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
    }

    /// The session's configuration as JSON.
    ///
    /// # Errors
    /// As [`Network::source`].
    pub fn configuration(&self, key_name: &str) -> anyhow::Result<Value> {
        let (name, text) = self.text()?;
        let mut config = parse(&name, &text)?;
        if let Some(vehicle) = &self.vehicle {
            ensure!(is_name(vehicle), "invalid vehicle name `{vehicle}`: {NAME_RULE}");
            config["namespace"] = json!(vehicle);
        }
        if let Some(keys) = &self.keys {
            secure(&mut config, keys, key_name).with_context(|| format!("securing {name}"))?;
        }
        if let Some(port) = self.meet {
            each_endpoint(&mut config, &["connect", "listen"], |e| e.move_rendezvous(port));
        }
        if let Some(address) = &self.connect {
            let address = Address::parse(address)?;
            each_endpoint(&mut config, &["connect"], |e| e.redirect(ADDRESS_PLACEHOLDER, &address));
        }
        if let Some(address) = &self.listen {
            let address = Address::parse(address)?;
            each_endpoint(&mut config, &["listen"], |e| e.redirect("0.0.0.0", &address));
        }
        let is_missing = self.connect.is_none()
            && endpoints(&config, "connect")
                .filter_map(Endpoint::parse)
                .any(|endpoint| endpoint.host == ADDRESS_PLACEHOLDER);
        ensure!(
            !is_missing,
            "{name} needs the address of the drone: `--connect ADDRESS`, or ALIGHT_CONNECT in the environment"
        );
        if let Some(endpoint) = endpoints(&config, "connect").find(|e| is_refused_by_tls(e)) {
            bail!("{name} connects to {endpoint}: {NO_KEYS_OVER_IPV6}");
        }
        if let Some(endpoint) = open_endpoint(&config).filter(|_| !self.insecure) {
            bail!(
                "{name} listens beyond this machine ({endpoint}) without keys, so anyone in reach could command the \
                 vehicle. Make keys (`alight keys`, docs/deploy.md) and give them with `--keys DIRECTORY` (`keys` in \
                 the site), or allow it with `--insecure` (`insecure = true` in the site)"
            );
        }
        check_access(&config).with_context(|| name.clone())?;
        Ok(config)
    }

    /// The vehicle's name, by its setting or by the configuration.
    ///
    /// # Errors
    /// When the configuration cannot be read, or has none.
    pub fn vehicle_name(&self) -> anyhow::Result<String> {
        if let Some(vehicle) = &self.vehicle {
            return Ok(vehicle.clone());
        }
        let (name, text) = self.text()?;
        let config = parse(&name, &text)?;
        let vehicle = config["namespace"].as_str();
        Ok(vehicle.with_context(|| format!("{name} has no `namespace`"))?.to_owned())
    }

    /// The first endpoint at which this process is to listen and whose port is in use. Zenoh would wait for it without a log message.
    ///
    /// # Errors
    /// As [`Network::source`].
    pub fn taken_endpoint(&self, key_name: &str) -> anyhow::Result<Option<String>> {
        let config = self.configuration(key_name)?;
        let is_taken = |endpoint: &&str| {
            // Port 0 is any that is free.
            let Some(Endpoint { protocol, host, port: port @ 1.., .. }) = Endpoint::parse(endpoint)
            else {
                return false;
            };
            if !["tcp", "tls"].contains(&protocol.as_str()) {
                return false;
            }
            let bound = std::net::TcpListener::bind(format!("{host}:{port}"));
            bound.is_err_and(|problem| problem.kind() == io::ErrorKind::AddrInUse)
        };
        Ok(endpoints(&config, "listen").find(is_taken).map(str::to_owned))
    }

    fn text(&self) -> anyhow::Result<(String, String)> {
        let Some(path) = &self.config else {
            return Ok(("the built-in `local`".to_owned(), LOCAL_CONFIG.to_owned()));
        };
        let built_in = match path.to_str() {
            Some("local") => Some(LOCAL_CONFIG),
            Some("drone") => Some(DRONE_CONFIG),
            Some("ground") => Some(GROUND_CONFIG),
            Some("relay") => Some(RELAY_CONFIG),
            _ => None,
        };
        match built_in {
            Some(text) => Ok((format!("the built-in `{}`", path.display()), text.to_owned())),
            None => {
                let text = std::fs::read_to_string(path)
                    .with_context(|| format!("reading the Zenoh configuration {path:?}"))?;
                Ok((path.display().to_string(), text))
            }
        }
    }
}

/// Rejects access control with policies that name undefined rules or subjects: Zenoh would accept them, and
/// then allow or deny something else than intended.
///
/// # Errors
/// Names the policy's entry.
pub fn check_access(config: &Value) -> anyhow::Result<()> {
    let access = &config["access_control"];
    let names = |list: &Value| -> Vec<String> {
        let entries = list.as_array().into_iter().flatten();
        entries.filter_map(|entry| entry["id"].as_str().map(str::to_owned)).collect()
    };
    for (kind, known) in
        [("rules", names(&access["rules"])), ("subjects", names(&access["subjects"]))]
    {
        for policy in access["policies"].as_array().into_iter().flatten() {
            for name in policy[kind].as_array().into_iter().flatten() {
                let name = name.as_str().unwrap_or_default();
                ensure!(
                    known.iter().any(|k| k == name),
                    "a policy of `access_control` names `{name}`, which is not one of its {kind}"
                );
            }
        }
    }
    Ok(())
}

fn parse(name: &str, text: &str) -> anyhow::Result<Value> {
    json5::from_str(text).map_err(|cause| anyhow!("{name} is not JSON5: {cause}"))
}

/// Adds TLS to a configuration, and access control where others connect.
fn secure(config: &mut Value, keys: &Path, key_name: &str) -> anyhow::Result<()> {
    // The services on the drone use its loopback interface, where every user with a login is trusted.
    let connects_locally = endpoints(config, "connect").any(|e| e.contains(LOOPBACK));
    let listens_locally = endpoints(config, "listen").all(|e| e.contains(LOOPBACK));
    if connects_locally && listens_locally {
        return Ok(());
    }
    let key_file = format!("{key_name}.key");
    for file in [AUTHORITY, &format!("{key_name}.pem"), &key_file] {
        let path = keys.join(file);
        check_is_there(&path, std::fs::metadata(&path).map(|found| found.is_file()), key_name)?;
    }
    let key_file = keys.join(key_file);
    check_private(&key_file)?;
    check_pair(keys, key_name)?;
    each_endpoint(config, &["connect", "listen"], |e| {
        if !(connects_locally && e.host == LOOPBACK) {
            e.protocol = "tls".to_owned();
        }
    });
    let mut layer = parse("secured.json5", SECURED_CONFIG)?;
    let directory = keys.to_str().context("the path of the key directory is not valid UTF-8")?;
    for value in layer["transport"]["link"]["tls"].as_object_mut().into_iter().flatten() {
        // In the file's own text only: directories and detectors may be named as the placeholders are.
        if let Some(file) = value.1.as_str().and_then(|path| path.strip_prefix("DIRECTORY/")) {
            *value.1 = json!(format!("{directory}/{}", file.replace("NAME", key_name)));
        }
    }
    let path = keys.join(HOLDERS);
    if listens_locally && !path.is_file() {
        // Only this machine connects here; the relay checks messages over the air link.
        layer.as_object_mut().and_then(|layer| layer.remove("access_control"));
    } else {
        let text = std::fs::read_to_string(&path).with_context(|| {
            format!("reading {path:?}, the list of holders that may connect; copy it from the authority's directory")
        })?;
        let holders = text.parse().with_context(|| format!("{path:?}"))?;
        let vehicle =
            config["namespace"].as_str().context("the configuration has no `namespace`")?;
        layer["access_control"] = access_control(&layer["access_control"], &holders, vehicle)?;
    }
    merge(config, layer);
    Ok(())
}

/// Checks that a file of a key is there, by the result of the system call.
fn check_is_there(path: &Path, is_file: io::Result<bool>, key_name: &str) -> anyhow::Result<()> {
    if let Err(cause) = &is_file {
        key_pair::check_permission(path, cause)?;
    }
    ensure!(
        is_file.is_ok_and(|is_file| is_file),
        "missing key file {path:?}; make it with `alight keys issue {} --authority DIR -o {}`, where DIR has the authority",
        issue_arguments(key_name),
        path.parent().unwrap_or(path).display()
    );
    Ok(())
}

/// The arguments with which `alight keys issue` makes a key.
pub fn issue_arguments(key_name: &str) -> String {
    match key_name.split_once('.') {
        Some((role, name)) => format!("--role {role} --name {name}"),
        // Others connect to these.
        None if matches!(key_name, "drone" | "relay") => {
            format!("--role {key_name} --address HOST")
        }
        None => format!("--role {key_name}"),
    }
}

/// Refuses a private key that other users can read.
///
/// # Errors
/// Names a remedy.
pub fn check_private(path: &Path) -> anyhow::Result<()> {
    let file = std::fs::metadata(path).with_context(|| format!("reading {path:?}"))?;
    let mode = file.permissions().mode() & 0o777;
    ensure!(
        mode & 0o077 == 0,
        "the private key {path:?} is open to other users (mode {mode:o}): `chmod 600 {}`; if another user may have read \
         it, revoke it (`alight keys revoke`) and make another",
        path.display()
    );
    Ok(())
}

/// Checks that the key of this name in a directory belongs to its certificate.
///
/// # Errors
/// Names the invalid file, or the key of another certificate.
pub fn check_pair(keys: &Path, key_name: &str) -> anyhow::Result<()> {
    let [certificate, key] = ["pem", "key"].map(|end| keys.join(format!("{key_name}.{end}")));
    key_pair::check(&keys.join(AUTHORITY), &certificate, &key)
}

/// An endpoint at which every client in range may connect to this configuration; `None` if only this machine or
/// holders of a certificate may.
fn open_endpoint(config: &Value) -> Option<String> {
    let asks_for_certificates = config["transport"]["link"]["tls"]["enable_mtls"] == true;
    let is_open = |endpoint: &str| {
        let protocol = endpoint.split('/').next().unwrap_or_default();
        match protocol {
            "unixsock-stream" | "unixpipe" | "serial" => false,
            "tls" | "quic" if asks_for_certificates => false,
            _ => Endpoint::parse(endpoint).is_none_or(|endpoint| !endpoint.is_local()),
        }
    };
    let listen = &config["listen"]["endpoints"];
    if listen.is_null() {
        // Zenoh then listens on every interface, unless it is a client.
        return (config["mode"] != "client").then(|| "Zenoh's default endpoint".to_owned());
    }
    endpoints(config, "listen").find(|endpoint| is_open(endpoint)).map(str::to_owned)
}

/// Whether an endpoint is an IPv6 address over TLS: Zenoh takes the brackets for a part of its name, and never connects.
fn is_refused_by_tls(endpoint: &str) -> bool {
    Endpoint::parse(endpoint).is_some_and(|it| it.protocol == "tls" && it.host.starts_with('['))
}

fn merge(below: &mut Value, above: Value) {
    match (below, above) {
        (Value::Object(below), Value::Object(above)) => {
            for (key, value) in above {
                merge(below.entry(key).or_insert(Value::Null), value);
            }
        }
        (below, above) => *below = above,
    }
}

/// The address of another process.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Address {
    /// A host name or an IP address, an IPv6 address in brackets.
    pub host: String,
    /// The port; [`AIR_PORT`] if it is omitted.
    pub port: Option<u16>,
}

impl Address {
    /// Parses `HOST` or `HOST:PORT`.
    ///
    /// # Errors
    /// When the text has another form.
    pub fn parse(text: &str) -> anyhow::Result<Self> {
        let invalid = || {
            anyhow!(
                "invalid address `{text}`: expected HOST or HOST:PORT, for example 192.168.1.10"
            )
        };
        let (host, port) = match text.rsplit_once(':') {
            // An IPv6 address without brackets.
            Some((host, _)) if host.contains(':') && !host.ends_with(']') => (text, None),
            Some((host, port)) => (host, Some(port.parse().map_err(|_| invalid())?)),
            None => (text, None),
        };
        let is_host = !host.is_empty()
            && host.chars().all(|c| c.is_ascii_alphanumeric() || ".-_[]:%".contains(c));
        if !is_host || port.is_some_and(|port| port == 0 || port > MAX_PORT) {
            bail!(invalid());
        }
        let host = if host.contains(':') && !host.starts_with('[') {
            format!("[{host}]")
        } else {
            host.to_owned()
        };
        Ok(Self { host, port })
    }
}

impl Endpoint {
    /// Replaces a host; the ports keep their offsets from the first one.
    fn redirect(&mut self, replaced: &str, address: &Address) {
        if self.host == replaced {
            self.host.clone_from(&address.host);
            let offset = self.port.saturating_sub(AIR_PORT);
            self.port = address.port.unwrap_or(AIR_PORT).saturating_add(offset);
        }
    }

    fn move_rendezvous(&mut self, port: u16) {
        if self.host == LOOPBACK && self.port == LOCAL_PORT {
            self.port = port;
        }
    }
}

/// The endpoints of a section: a list, or one for each mode.
fn endpoints<'a>(config: &'a Value, section: &str) -> impl Iterator<Item = &'a str> {
    let found = &config[section]["endpoints"];
    let of_modes = found.as_object().into_iter().flat_map(|modes| modes.values());
    of_modes.chain([found]).filter_map(Value::as_array).flatten().filter_map(Value::as_str)
}

fn each_endpoint(config: &mut Value, sections: &[&str], change: impl Fn(&mut Endpoint)) {
    for section in sections {
        let lists: Vec<&mut Value> = match config.pointer_mut(&format!("/{section}/endpoints")) {
            Some(Value::Object(modes)) => modes.values_mut().collect(),
            found => found.into_iter().collect(),
        };
        for entry in lists.into_iter().filter_map(Value::as_array_mut).flatten() {
            if let Some(mut endpoint) = entry.as_str().and_then(Endpoint::parse) {
                change(&mut endpoint);
                *entry = json!(endpoint.text());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn configured(network: &Network) -> Result<Value, String> {
        network.configuration("detector").map_err(|problem| format!("{problem:#}"))
    }

    fn built_in(name: &str) -> Network {
        Network { config: Some(name.into()), ..Network::default() }
    }

    #[test]
    fn zenoh_takes_every_built_in_configuration() {
        for name in ["local", "drone", "ground", "relay"] {
            let connect = Some("10.0.0.1".into());
            let network = Network { connect, insecure: true, ..built_in(name) };
            let config = configured(&network).unwrap();
            zenoh::Config::from_json5(&config.to_string()).unwrap();
            assert_eq!(config["namespace"], "drone");
        }
    }

    #[test]
    fn an_address_goes_into_all_connections() {
        let ends = |connect: &str| -> Vec<String> {
            let network = Network { connect: Some(connect.into()), ..built_in("ground") };
            endpoints(&configured(&network).unwrap(), "connect").map(str::to_owned).collect()
        };
        assert_eq!(
            ends("10.0.0.1"),
            [
                "tcp/10.0.0.1:7448?prio=1-4#dscp=0xb8",
                "tcp/10.0.0.1:7449?prio=5-6",
                "tcp/10.0.0.1:7450?prio=7-7"
            ]
        );
        assert_eq!(ends("uav.local:9000")[1], "tcp/uav.local:9001?prio=5-6");
        assert_eq!(ends("fe80::1")[0], "tcp/[fe80::1]:7448?prio=1-4#dscp=0xb8");
        let listen = Some("10.0.0.7:9000".into());
        let network = Network { listen, insecure: true, ..built_in("drone") };
        let listens: Vec<_> =
            endpoints(&configured(&network).unwrap(), "listen").map(str::to_owned).collect();
        assert_eq!(
            listens,
            [
                "tcp/127.0.0.1:0",
                "tcp/10.0.0.7:9000?prio=1-4#dscp=0xb8",
                "tcp/10.0.0.7:9001?prio=5-6#so_sndbuf=32768",
                "tcp/10.0.0.7:9002?prio=7-7#so_sndbuf=32768"
            ]
        );
    }

    #[test]
    fn a_host_may_be_named_as_the_placeholder_is() {
        for (connect, host) in
            [("DRONE.local", "DRONE.local"), ("MYDRONE:9000", "MYDRONE"), ("DRONE", "DRONE")]
        {
            let network = Network { connect: Some(connect.into()), ..built_in("ground") };
            let config = configured(&network).unwrap();
            let first = endpoints(&config, "connect").next().unwrap();
            assert!(first.starts_with(&format!("tcp/{host}:")), "{connect}: {first}");
        }
    }

    #[test]
    fn invalid_networks_are_rejected_with_the_reason() {
        let refused = |network: Network, part: &str| {
            let problem = configured(&network).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        refused(built_in("ground"), "--connect ADDRESS");
        refused(built_in("no/such.json5"), "no/such.json5");
        for address in ["", "a b", "10.0.0.1:0", "10.0.0.1:x", "a/b", "host:70000"] {
            let network = Network { connect: Some(address.into()), ..built_in("ground") };
            refused(network, "HOST:PORT");
        }
        refused(Network { vehicle: Some("a/b".into()), ..Network::default() }, "letters, digits");
        let folder = tempfile::tempdir().unwrap();
        write_keys(folder.path(), "detector");
        let keys = Some(folder.path().to_owned());
        let connect = Some("fd00::1".into());
        let part = "connects to tls/[fd00::1]:7448?prio=1-4#dscp=0xb8: with keys, nothing";
        refused(Network { keys, connect, ..built_in("ground") }, part);
        let keys = Some("no/keys".into());
        let connect = Some("10.0.0.1".into());
        refused(
            Network { keys, connect, ..built_in("ground") },
            "alight keys issue --role detector --authority DIR -o no/keys`",
        );
        for role in ["drone", "relay"] {
            let arguments = issue_arguments(role);
            assert_eq!(arguments, format!("--role {role} --address HOST"));
        }
    }

    #[test]
    fn a_port_that_another_process_has_is_named() {
        let held = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
        let port = held.local_addr().unwrap().port();
        let network = Network {
            listen: Some(format!("127.0.0.1:{port}")),
            insecure: true,
            ..built_in("drone")
        };
        let taken = || network.taken_endpoint("drone").unwrap();
        assert!(taken().is_some_and(|it| it.starts_with(&format!("tcp/127.0.0.1:{port}"))));
        drop(held);
        assert_ne!(taken().map(|it| it.contains(&format!(":{port}?"))), Some(true));
    }

    #[test]
    fn no_process_listens_beyond_this_machine_without_keys_unless_configured() {
        let open = |network: &Network| configured(network).err();
        for name in ["drone", "relay"] {
            let network = Network { connect: Some("10.0.0.1".into()), ..built_in(name) };
            let problem = open(&network).unwrap();
            assert!(
                problem.contains("0.0.0.0:7448") && problem.contains("--insecure"),
                "{problem}"
            );
            assert!(!network.is_open().is_ok_and(|is_open| is_open));
            let allowed = Network { insecure: true, ..network.clone() };
            assert!(open(&allowed).is_none() && allowed.is_open().unwrap());
            let local = Network { listen: Some("127.0.0.1:9000".into()), ..network };
            assert!(open(&local).is_none());
            let local = Network { insecure: true, ..local };
            assert!(!local.is_open().unwrap(), "it cannot be reached from outside");
        }
        for (text, is_open) in [
            ("{}", true),
            ("{ mode: 'client' }", false),
            ("{ listen: { endpoints: ['tcp/[::]:7447'] } }", true),
            ("{ listen: { endpoints: ['tcp/[::1]:7447', 'tcp/localhost:1'] } }", false),
            ("{ listen: { endpoints: { peer: ['tcp/10.0.0.1:0'] } } }", true),
            ("{ listen: { endpoints: ['tls/0.0.0.0:7447'] } }", true),
            (
                "{ listen: { endpoints: ['tls/0.0.0.0:7447'] },
                   transport: { link: { tls: { enable_mtls: true } } } }",
                false,
            ),
            ("{ listen: { endpoints: ['udp/0.0.0.0:7447'] } }", true),
        ] {
            let config = parse("a test", text).unwrap();
            assert_eq!(open_endpoint(&config).is_some(), is_open, "{text}");
        }
    }

    /// A key with its certificate, which is its own authority.
    fn write_keys(folder: &Path, name: &str) {
        let key = rcgen::KeyPair::generate().unwrap();
        let certificate = rcgen::CertificateParams::new(vec![name.to_owned()]).unwrap();
        let certificate = certificate.self_signed(&key).unwrap().pem();
        for file in [AUTHORITY.to_owned(), format!("{name}.pem")] {
            std::fs::write(folder.join(file), &certificate).unwrap();
        }
        let path = folder.join(format!("{name}.key"));
        std::fs::write(&path, key.serialize_pem()).unwrap();
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600)).unwrap();
    }

    #[test]
    fn keys_that_others_can_read_are_refused() {
        let keys = tempfile::tempdir().unwrap();
        write_keys(keys.path(), "operator");
        let network = Network {
            keys: Some(keys.path().to_owned()),
            connect: Some("10.0.0.1".into()),
            ..built_in("ground")
        };
        let key = keys.path().join("operator.key");
        for (mode, is_private) in [(0o644, false), (0o640, false), (0o600, true), (0o400, true)] {
            std::fs::set_permissions(&key, std::fs::Permissions::from_mode(mode)).unwrap();
            let result = network.configuration("operator").map_err(|cause| format!("{cause:#}"));
            match result {
                Ok(_) => assert!(is_private, "{mode:o}"),
                Err(problem) => {
                    assert!(!is_private && problem.contains("chmod 600"), "{mode:o}: {problem}");
                }
            }
        }
    }

    #[test]
    fn keys_that_this_user_may_not_read_are_not_called_missing() {
        let problem_of = |kind: io::ErrorKind| {
            let result = check_is_there(Path::new("keys/x.pem"), Err(kind.into()), "operator");
            result.unwrap_err().to_string()
        };
        let denied = problem_of(io::ErrorKind::PermissionDenied);
        assert!(denied.contains("may not read \"keys/x.pem\"") && denied.contains("sudo -u"));
        let absent = problem_of(io::ErrorKind::NotFound);
        assert!(absent.contains("missing key file") && absent.contains("-o keys`"), "{absent}");
    }

    #[test]
    fn endpoints_for_each_mode_are_secured_as_a_list_is() {
        let keys = tempfile::tempdir().unwrap();
        write_keys(keys.path(), "relay");
        std::fs::write(keys.path().join(HOLDERS), "").unwrap();
        for listen in ["['tcp/0.0.0.0:7448']", "{ peer: ['tcp/0.0.0.0:7448'] }"] {
            let text = format!(
                "{{ mode: 'peer', namespace: 'hawk', connect: {{ endpoints: [] }}, listen: {{ endpoints: {listen} }} }}"
            );
            let mut config = parse("a test", &text).unwrap();
            secure(&mut config, keys.path(), "relay").unwrap();
            assert_eq!(endpoints(&config, "listen").collect::<Vec<_>>(), ["tls/0.0.0.0:7448"]);
            assert_eq!(config["access_control"]["enabled"], true, "{listen}");
            assert_eq!(open_endpoint(&config), None);
        }
    }

    #[test]
    fn a_directory_of_keys_may_be_named_as_a_placeholder_is() {
        let folder = tempfile::tempdir().unwrap();
        let keys = folder.path().join("NAMES").join("DIRECTORY");
        std::fs::create_dir_all(&keys).unwrap();
        let key_name = "detector.DIRECTORY";
        write_keys(&keys, key_name);
        let mut config = parse("ground", GROUND_CONFIG).unwrap();
        secure(&mut config, &keys, key_name).unwrap();
        let tls = &config["transport"]["link"]["tls"];
        for (part, file) in [
            ("root_ca_certificate", AUTHORITY),
            ("listen_certificate", "detector.DIRECTORY.pem"),
            ("connect_private_key", "detector.DIRECTORY.key"),
        ] {
            let path = tls[part].as_str().map(Path::new);
            assert_eq!(path, Some(keys.join(file).as_path()), "{part}");
        }
    }

    #[test]
    fn a_policy_with_an_undefined_rule_is_rejected() {
        let mut config = parse("secured.json5", SECURED_CONFIG).unwrap();
        check_access(&config).unwrap();
        config["access_control"]["policies"][0]["rules"][0] = json!("lisen");
        assert!(check_access(&config).unwrap_err().to_string().contains("`lisen`"));
    }

    #[test]
    fn services_on_the_drone_need_no_keys() {
        let network = Network { keys: Some("no/keys".into()), ..Network::default() };
        assert_eq!(configured(&network), configured(&Network::default()));
    }
}
