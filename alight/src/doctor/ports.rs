//! Checks whether the ports of the machines to which this one connects accept connections.

use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use node::Network;
use node::network::{AIR_PORT, Address};

use super::Findings;
use crate::site::{Role, Site};

const CONNECT_TIMEOUT: Duration = Duration::from_millis(1000);

/// A machine to which this one connects.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Target {
    /// HOST or HOST:PORT.
    address: String,
    /// The remedy if it does not answer.
    remedy: &'static str,
}

/// The machines whose ports are to be tried. The relay counts a connection to its ports as a denial, so they are tried only if no message
/// shows that it is there: `sees_any` service, `sees_drone`.
pub(super) fn targets(
    role: Option<Role>,
    site: Option<&Site>,
    network: &Network,
    sees_any: bool,
    sees_drone: bool,
) -> Vec<Target> {
    let is_relay = role == Some(Role::Relay);
    let has_base = site.is_some_and(|site| site.relay_address().is_some());
    let remedy = match (is_relay, has_base) {
        (true, _) => "check that `alight up relay` runs on this machine",
        (false, true) => {
            "check that `alight up relay` runs on the base station, `relay_address` of the site, and firewalls"
        }
        (false, false) => {
            "check that `alight up drone` runs on the drone, the address, and firewalls"
        }
    };
    let nearest = network.connect.clone().filter(|_| !sees_any);
    let nearest = nearest.map(|address| Target { address, remedy });
    // Behind its own relay.
    let drone = site.and_then(Site::drone_address).filter(|_| is_relay && !sees_drone);
    let drone = drone.map(|address| Target {
        address: address.to_owned(),
        remedy: "check that `alight up drone` runs on the drone, `address` of the site, and firewalls",
    });
    nearest.into_iter().chain(drone).collect()
}

/// Tries the ports of a machine.
pub(super) fn check(findings: &mut Findings, target: &Target, with_keys: bool) {
    // An invalid address is reported with the network's configuration.
    let Ok(Address { host, port }) = Address::parse(&target.address) else { return };
    let first_port = port.unwrap_or(AIR_PORT);
    let bare_host = host.trim_matches(['[', ']']);
    let over = if with_keys { "TLS over TCP" } else { "TCP" };
    for (offset, what) in (0_u16..).zip(["control", "frames", "frames, second connection"]) {
        let port = first_port.saturating_add(offset);
        let found = (bare_host, port).to_socket_addrs().ok().and_then(|mut all| all.next());
        let Some(found) = found else {
            findings.wrong(
                "ports",
                format!("address {host} cannot be resolved"),
                "use an IP address, or a name that this machine can resolve",
            );
            return;
        };
        match TcpStream::connect_timeout(&found, CONNECT_TIMEOUT) {
            Ok(_) => findings.good("ports", format!("{found} answers ({what}; {over})")),
            Err(cause) => findings.wrong(
                "ports",
                format!("{found} ({what}) does not answer: {cause}"),
                target.remedy,
            ),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_base_station_tries_its_own_relay_and_the_drone() {
        let site: Site = toml::from_str("address = '10.42.0.1'\ninsecure = true").unwrap();
        let addresses = |role: Role, sees_any: bool, sees_drone: bool| {
            let network = site.network(role);
            let all = targets(Some(role), Some(&site), &network, sees_any, sees_drone);
            let all = all.iter().map(|it| (it.address.clone(), it.remedy.contains("up drone")));
            all.collect::<Vec<_>>()
        };
        let (own, drone) = (("127.0.0.1".into(), false), ("10.42.0.1".into(), true));
        assert_eq!(addresses(Role::Relay, false, false), [own, drone.clone()]);
        assert_eq!(addresses(Role::Relay, true, false), std::slice::from_ref(&drone));
        assert_eq!(addresses(Role::Relay, true, true), []);
        assert_eq!(addresses(Role::Ground, false, false), [drone]);
        assert_eq!(addresses(Role::Ground, true, false), []);
        assert_eq!(addresses(Role::Drone, false, false), []);
    }

    #[test]
    fn the_machine_that_does_not_answer_is_named() {
        let text = "address = '10.0.0.1'\nrelay_address = '127.0.0.1:1'\ninsecure = true";
        let site: Site = toml::from_str(text).unwrap();
        let network = site.network(Role::Ground);
        let all = targets(Some(Role::Ground), Some(&site), &network, false, false);
        let mut findings = Findings::default();
        all.iter().for_each(|target| check(&mut findings, target, false));
        let text = findings.text();
        assert!(text.contains("127.0.0.1:1 (control) does not answer"), "{text}");
        assert!(text.contains("`alight up relay` runs on the base station"), "{text}");
    }
}
