//! Which network a process joins: the built-in configurations, and what a person lays over them.
//!
//! A role's JSON5 file says how its processes meet; the vehicle's name, the other side's address and the keys differ
//! from site to site and are put in here, so that nobody has to write a file of his own.

use std::path::{Path, PathBuf};

use anyhow::{Context, anyhow, bail, ensure};
use serde_json::{Value, json};

use crate::session::{LOCAL_CONFIG, LOCAL_PORT, ZenohSource};

/// The drone's end of the air link.
pub const DRONE_CONFIG: &str = include_str!("../../../zenoh-config/drone.json5");
/// A process on the ground.
pub const GROUND_CONFIG: &str = include_str!("../../../zenoh-config/ground.json5");
/// A relay between both.
pub const RELAY_CONFIG: &str = include_str!("../../../zenoh-config/relay.json5");
/// What `keys` lays over them: TLS and access control.
pub const SECURED_CONFIG: &str = include_str!("../../../zenoh-config/secured.json5");

/// The port of the air link for control; those for frames are the next two.
pub const AIR_PORT: u16 = 7448;

/// Two more ports follow that of an address.
const HIGHEST_PORT: u16 = u16::MAX - 2;
/// What stands in a file where the other side's address belongs.
const ADDRESS_PLACEHOLDER: &str = "DRONE";
/// The loopback interface, which no message leaves.
const LOOPBACK: &str = "127.0.0.1";
/// The name of the authority's certificate in a directory of keys.
const AUTHORITY: &str = "authority.pem";

/// A network to join. The default is this machine's own.
#[derive(Clone, Debug, Default)]
pub struct Network {
    /// A built-in configuration (`local`, `drone`, `ground`, `relay`) or a JSON5 file; `local` if there is none.
    pub config: Option<PathBuf>,
    /// The vehicle's name, the namespace of all keys.
    pub vehicle: Option<String>,
    /// Where the drone or its relay is: `HOST` or `HOST:PORT`.
    pub connect: Option<String>,
    /// Where others find this process: `HOST` or `HOST:PORT`.
    pub listen: Option<String>,
    /// The port at which the processes of this machine meet.
    pub meet: Option<u16>,
    /// The directory with the keys; TLS and access control are used then.
    pub keys: Option<PathBuf>,
}

impl Network {
    /// The session's configuration for a process that shows the certificate of `role`.
    ///
    /// # Errors
    /// When a file cannot be read or is no configuration, or when an address is needed or makes no sense.
    pub fn source(&self, role: &str) -> anyhow::Result<ZenohSource> {
        Ok(ZenohSource::Text(serde_json::to_string(&self.configuration(role)?)?))
    }

    /// The same as JSON.
    ///
    /// # Errors
    /// As [`Network::source`].
    pub fn configuration(&self, role: &str) -> anyhow::Result<Value> {
        let (name, text) = self.text()?;
        let mut config = parse(&name, &text)?;
        if let Some(vehicle) = &self.vehicle {
            config["namespace"] = json!(checked_name(vehicle)?);
        }
        if let Some(keys) = &self.keys {
            secure(&mut config, keys, role).with_context(|| format!("securing {name}"))?;
        }
        if let Some(port) = self.meet {
            each_endpoint(&mut config, &["connect", "listen"], |e| e.move_meeting_point(port));
        }
        if let Some(address) = &self.connect {
            let address = Address::parse(address)?;
            each_endpoint(&mut config, &["connect"], |e| e.go_to(ADDRESS_PLACEHOLDER, &address));
        }
        if let Some(address) = &self.listen {
            let address = Address::parse(address)?;
            each_endpoint(&mut config, &["listen"], |e| e.go_to("0.0.0.0", &address));
        }
        let missing = endpoints(&config, "connect").any(|e| e.contains(ADDRESS_PLACEHOLDER));
        ensure!(
            !missing,
            "{name} needs to know where the drone is: `--connect ADDRESS`, or ALIGHT_CONNECT in the environment"
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

/// Refuses access control whose policies name rules or subjects that are not there: Zenoh would open, and deny or allow
/// something else than was meant.
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
                    "a policy of `access_control` names `{name}`, which is not among its {kind}"
                );
            }
        }
    }
    Ok(())
}

fn parse(name: &str, text: &str) -> anyhow::Result<Value> {
    json5::from_str(text).map_err(|cause| anyhow!("{name} is not JSON5: {cause}"))
}

fn checked_name(vehicle: &str) -> anyhow::Result<&str> {
    let is_name = !vehicle.is_empty()
        && vehicle.len() <= 64
        && vehicle.chars().all(|c| c.is_ascii_alphanumeric() || "-_".contains(c));
    ensure!(
        is_name,
        "the vehicle's name `{vehicle}` is refused: 1 to 64 letters, digits, `-` and `_`"
    );
    Ok(vehicle)
}

/// Lays TLS and access control over a configuration.
fn secure(config: &mut Value, keys: &Path, role: &str) -> anyhow::Result<()> {
    // The services on the drone meet on its loopback interface, where who has a login is trusted.
    let meets_here = endpoints(config, "connect").any(|e| e.contains(LOOPBACK));
    let only_here = endpoints(config, "listen").all(|e| e.contains(LOOPBACK));
    if meets_here && only_here {
        return Ok(());
    }
    for file in [AUTHORITY.to_owned(), format!("{role}.pem"), format!("{role}.key")] {
        let path = keys.join(&file);
        ensure!(
            path.is_file(),
            "there is no {path:?}; make it with `alight keys issue --role {role} -o {}`",
            keys.display()
        );
    }
    each_endpoint(config, &["connect", "listen"], |e| {
        if !(meets_here && e.host == LOOPBACK) {
            e.protocol = "tls".to_owned();
        }
    });
    let mut layer = parse("secured.json5", SECURED_CONFIG)?;
    let directory = keys.to_str().context("the directory of the keys has no printable name")?;
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

/// The host and port of another process.
struct Address {
    host: String,
    port: Option<u16>,
}

impl Address {
    fn parse(text: &str) -> anyhow::Result<Self> {
        let refused = || {
            anyhow!(
                "the address `{text}` is refused: it must be HOST or HOST:PORT, for example 192.168.1.10"
            )
        };
        let (host, port) = match text.rsplit_once(':') {
            // A bare IPv6 address has colons of its own.
            Some((host, _)) if host.contains(':') && !host.ends_with(']') => (text, None),
            Some((host, port)) => (host, Some(port.parse().map_err(|_| refused())?)),
            None => (text, None),
        };
        let is_host = !host.is_empty()
            && host.chars().all(|c| c.is_ascii_alphanumeric() || ".-_[]:%".contains(c));
        if !is_host || port.is_some_and(|port| port == 0 || port > HIGHEST_PORT) {
            bail!(refused());
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

    /// Replaces a host; the ports keep their distance from the first one.
    fn go_to(&mut self, replaced: &str, address: &Address) {
        if self.host == replaced {
            self.host.clone_from(&address.host);
            let beyond_the_first = self.port.saturating_sub(AIR_PORT);
            self.port = address.port.unwrap_or(AIR_PORT).saturating_add(beyond_the_first);
        }
    }

    fn move_meeting_point(&mut self, port: u16) {
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
    fn what_is_wrong_is_said() {
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
    fn a_policy_that_names_no_rule_or_subject_is_refused() {
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
