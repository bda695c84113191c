//! The network that a process joins: a built-in configuration and the settings of a site.
//!
//! The JSON5 file of a role configures how its processes connect; the vehicle's name, addresses and keys
//! differ from site to site and are filled in here, so that no site needs files of its own.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail, ensure};
use serde_json::{Value, json};

use crate::config::{NAME_RULE, is_name};
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

/// The file name of the authority's certificate in a directory of keys.
pub const AUTHORITY: &str = "authority.pem";

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
}

impl Network {
    /// The session's configuration for a process with the certificate of `role`.
    ///
    /// # Errors
    /// When a file cannot be read or is not a configuration, or when an address is missing or invalid.
    pub fn source(&self, role: &str) -> anyhow::Result<ZenohSource> {
        Ok(ZenohSource::Text(serde_json::to_string(&self.configuration(role)?)?))
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
        ];
        all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
    }

    /// The session's configuration as JSON.
    ///
    /// # Errors
    /// As [`Network::source`].
    pub fn configuration(&self, role: &str) -> anyhow::Result<Value> {
        let (name, text) = self.text()?;
        let mut config = parse(&name, &text)?;
        if let Some(vehicle) = &self.vehicle {
            ensure!(is_name(vehicle), "invalid vehicle name `{vehicle}`: {NAME_RULE}");
            config["namespace"] = json!(vehicle);
        }
        if let Some(keys) = &self.keys {
            secure(&mut config, keys, role).with_context(|| format!("securing {name}"))?;
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
        let missing = endpoints(&config, "connect").any(|e| e.contains(ADDRESS_PLACEHOLDER));
        ensure!(
            !missing,
            "{name} needs the address of the drone: `--connect ADDRESS`, or ALIGHT_CONNECT in the environment"
        );
        check_access(&config).with_context(|| name.clone())?;
        Ok(config)
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

/// Adds TLS and access control to a configuration.
fn secure(config: &mut Value, keys: &Path, role: &str) -> anyhow::Result<()> {
    // The services on the drone use its loopback interface, where everybody with a login is trusted.
    let connects_locally = endpoints(config, "connect").any(|e| e.contains(LOOPBACK));
    let listens_locally = endpoints(config, "listen").all(|e| e.contains(LOOPBACK));
    if connects_locally && listens_locally {
        return Ok(());
    }
    for file in [AUTHORITY.to_owned(), format!("{role}.pem"), format!("{role}.key")] {
        let path = keys.join(&file);
        ensure!(
            path.is_file(),
            "missing key file {path:?}; make it with `alight keys issue --role {role} -o {}`",
            keys.display()
        );
    }
    each_endpoint(config, &["connect", "listen"], |e| {
        if !(connects_locally && e.host == LOOPBACK) {
            e.protocol = "tls".to_owned();
        }
    });
    let mut layer = parse("secured.json5", SECURED_CONFIG)?;
    let directory = keys.to_str().context("the path of the key directory is not valid UTF-8")?;
    for value in layer["transport"]["link"]["tls"].as_object_mut().into_iter().flatten() {
        if let Some(file) = value.1.as_str() {
            *value.1 = json!(file.replace("DIRECTORY", directory).replace("NAME", role));
        }
    }
    merge(config, layer);
    Ok(())
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

/// An endpoint: `tcp/127.0.0.1:7447?prio=1-4#iface=wlan0`.
struct Endpoint {
    protocol: String,
    host: String,
    port: u16,
    rest: String,
}

impl Endpoint {
    fn parse(text: &str) -> Option<Self> {
        let (protocol, rest) = text.split_once('/')?;
        let end = rest.find(['?', '#']).unwrap_or(rest.len());
        let (host, port) = rest.get(..end)?.rsplit_once(':')?;
        Some(Self {
            protocol: protocol.to_owned(),
            host: host.to_owned(),
            port: port.parse().ok()?,
            rest: rest.get(end..)?.to_owned(),
        })
    }

    fn text(&self) -> String {
        format!("{}/{}:{}{}", self.protocol, self.host, self.port, self.rest)
    }

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

fn endpoints<'a>(config: &'a Value, section: &str) -> impl Iterator<Item = &'a str> {
    config[section]["endpoints"].as_array().into_iter().flatten().filter_map(Value::as_str)
}

fn each_endpoint(config: &mut Value, sections: &[&str], change: impl Fn(&mut Endpoint)) {
    for section in sections {
        let list = config.pointer_mut(&format!("/{section}/endpoints"));
        for entry in list.and_then(Value::as_array_mut).into_iter().flatten() {
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
            let network = Network { connect: Some("10.0.0.1".into()), ..built_in(name) };
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
        let network = Network { listen: Some("10.0.0.7:9000".into()), ..built_in("drone") };
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
        let keys = Some("no/keys".into());
        let connect = Some("10.0.0.1".into());
        refused(
            Network { keys, connect, ..built_in("ground") },
            "alight keys issue --role detector",
        );
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
