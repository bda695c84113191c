//! Arguments that several subcommands share: network and keys, settings of a service, output format, addresses and ports,
//! and the error of a wrong command line.

use std::net::SocketAddr;
use std::ops::RangeInclusive;
use std::path::PathBuf;

use anyhow::Context;
use clap::builder::FalseyValueParser;
use clap::{Args, ValueEnum};
use markers::Marker;
use node::network::variable;
use node::{Network, ZenohSource};

/// The role whose key the tools at the command line use.
pub(crate) const OPERATOR: &str = "operator";

/// The rule for the rendezvous port of the processes of a machine.
pub(crate) const MEET_RULE: &str =
    "all processes of a machine meet at the same port: write a number from 1 to 65535";

/// The error of an invalid command line.
#[derive(Debug)]
pub(crate) struct WrongUse(pub(crate) String);

impl std::fmt::Display for WrongUse {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for WrongUse {}

impl WrongUse {
    /// The error of an argument, or of a file that an argument names.
    pub(crate) fn of(problem: &anyhow::Error) -> Self {
        Self(format!("{problem:#}"))
    }
}

/// The session's configuration for a process with this key.
///
/// # Errors
/// [`WrongUse`]: every error of the network comes from the command line, or from files that it names.
pub(crate) fn source_of(network: &Network, key_name: &str) -> Result<ZenohSource, WrongUse> {
    network.source(key_name).map_err(|problem| WrongUse::of(&problem))
}

/// The arguments of every service.
#[derive(Args, Clone, Default)]
pub(crate) struct ServiceArgs {
    /// Settings over the defaults (TOML).
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// One setting over the file: dotted key, TOML value. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    #[command(flatten)]
    pub(crate) network: NetworkArgs,
    #[command(flatten)]
    pub(crate) parent: ParentArgs,
}

/// The process that started this one.
#[derive(Args, Clone, Default)]
pub(crate) struct ParentArgs {
    /// Stop when the parent process with this number ends.
    #[arg(long, hide = true, value_name = "PID")]
    pub(crate) stop_with_parent: Option<u32>,
}

/// The network to join.
#[derive(Args, Clone, Default)]
#[command(next_help_heading = "Network")]
pub(crate) struct NetworkArgs {
    /// The network configuration: `local` (one machine), `ground`, or for the relay `drone` or `relay`; or a
    /// JSON5 file [default: local; of `alight relay`: drone].
    #[arg(long, value_name = "ROLE|FILE", env = variable::ZENOH)]
    zenoh: Option<PathBuf>,
    /// Address of the drone, or of the relay to it: HOST or HOST:PORT.
    #[arg(long, value_name = "ADDRESS", env = variable::CONNECT)]
    connect: Option<String>,
    /// Address at which the relay listens: HOST or HOST:PORT, and for IPv6 as well `[::]` [default: port 7448 of all IPv4
    /// addresses, with 7449 and 7450 for frames].
    #[arg(long, value_name = "ADDRESS", env = variable::LISTEN)]
    listen: Option<String>,
    /// Rendezvous port of the processes of this machine, with `local` and `drone` [default: 7447].
    #[arg(long, value_name = "PORT", env = variable::MEET, value_parser = meet_port)]
    meet: Option<u16>,
    /// The vehicle's name, the first part of all keys [default: drone].
    #[arg(long, value_name = "NAME", env = variable::VEHICLE)]
    vehicle: Option<String>,
    /// Directory with the keys (`alight keys`). Connections are then encrypted, and each role has its access
    /// rights.
    #[arg(long, value_name = "DIRECTORY", env = variable::KEYS)]
    keys: Option<PathBuf>,
    /// Listen beyond this machine without keys: anyone in reach can then command the vehicle.
    #[arg(long, env = variable::INSECURE, value_parser = FalseyValueParser::new())]
    insecure: bool,
}

impl NetworkArgs {
    /// The session's configuration for a process with this key.
    pub(crate) fn source(&self, key_name: &str) -> Result<ZenohSource, WrongUse> {
        source_of(&self.network(), key_name)
    }

    /// The session's configuration for a program that may be started in any directory: paths of keys are absolute.
    ///
    /// # Errors
    /// As [`source_of`], and when this process has no working directory.
    pub(crate) fn session(&self, key_name: &str) -> anyhow::Result<serde_json::Value> {
        let mut network = self.network();
        if let Some(keys) = &mut network.keys {
            *keys = std::path::absolute(&keys).with_context(|| format!("the path {keys:?}"))?;
        }
        Ok(network.configuration(key_name).map_err(|problem| WrongUse::of(&problem))?)
    }

    pub(crate) fn network(&self) -> Network {
        let Self { zenoh, connect, listen, meet, vehicle, keys, insecure } = self.clone();
        Network { config: zenoh, vehicle, connect, listen, meet, keys, insecure }
    }
}

/// Parses the rendezvous port of the processes of a machine. Port 0 (any free port) is refused: the processes would not find each other.
pub(crate) fn meet_port(text: &str) -> Result<u16, String> {
    match text.parse() {
        Ok(port @ 1..) => Ok(port),
        Ok(0) | Err(_) => Err(MEET_RULE.to_owned()),
    }
}

/// A parser of integers in a range, with the range in its error. The parser of the standard library reports an invalid digit for `-1`.
pub(crate) fn whole_number<T: TryFrom<u64>>(
    range: RangeInclusive<u64>,
) -> impl Fn(&str) -> Result<T, String> + Clone {
    move |text| {
        let number = text.parse().ok().filter(|number| range.contains(number));
        let (first, last) = (range.start(), range.end());
        number
            .and_then(|number| T::try_from(number).ok())
            .ok_or_else(|| format!("write a whole number from {first} to {last}"))
    }
}

/// Flights that are flown at the same time.
pub(crate) const JOBS: RangeInclusive<u64> = 1..=1024;

/// An address at which a service is to listen.
pub(crate) fn address(text: &str) -> Result<SocketAddr, String> {
    text.parse().map_err(|_| {
        let port: u16 = text.rsplit(':').next().unwrap_or_default().parse().unwrap_or(8080);
        format!("write IP:PORT, such as 127.0.0.1:{port}, or 0.0.0.0:{port} for all of this machine's addresses")
    })
}

/// A setting of the simulator or the controller.
pub(crate) fn flight_setting(text: &str) -> Result<String, String> {
    let is_known = ["simulator.", "controller."].iter().any(|service| text.starts_with(service));
    if is_known && text.contains('=') {
        Ok(text.to_owned())
    } else {
        Err("write simulator.KEY=VALUE or controller.KEY=VALUE".to_owned())
    }
}

/// A marker that can be on a pad.
pub(crate) fn sized_marker(text: &str) -> Result<Marker, String> {
    let marker: Marker = text.parse().map_err(|problem| format!("{problem}"))?;
    let is_any = marker.id.is_none() && marker.family.id_count().is_some();
    match marker.size_m {
        Some(_) if !is_any => Ok(marker),
        _ => Err("write FAMILY:ID:SIZE_M, or FAMILY:SIZE_M for a family without ids".to_owned()),
    }
}

/// The format of a result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// For people.
    #[default]
    Text,
    /// For programs.
    Json,
}

#[cfg(test)]
mod tests {
    use clap::Parser;

    use super::*;

    #[derive(Parser)]
    struct Tool {
        #[command(flatten)]
        network: NetworkArgs,
    }

    #[test]
    fn processes_that_would_meet_at_any_port_are_refused() {
        let given = |port: &str| Tool::try_parse_from(["tool", "--meet", port]);
        let error = given("0").err().map(|problem| problem.to_string()).unwrap();
        assert!(error.contains("--meet") && error.contains("1 to 65535"), "{error}");
        assert!(given("x").is_err() && given("65536").is_err());
        assert_eq!(given("9000").map(|tool| tool.network.meet).ok(), Some(Some(9000)));
    }

    #[test]
    fn a_port_alone_is_answered_with_the_address_that_was_meant() {
        assert!(address("127.0.0.1:8080").is_ok() && address("[::1]:8080").is_ok());
        let meant = [
            ("8765", "127.0.0.1:8765"),
            (":99", "127.0.0.1:99"),
            ("localhost:9000", "127.0.0.1:9000"),
            ("x", ":8080"),
        ];
        for (text, meant) in meant {
            let problem = address(text).unwrap_err();
            assert!(problem.contains(meant), "`{meant}` is not in: {problem}");
        }
    }
}
