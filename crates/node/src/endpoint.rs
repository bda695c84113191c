//! Parses Zenoh's endpoints: the addresses at which a session listens and to which it connects.

use std::net::IpAddr;

use serde_json::Value;

/// An endpoint: `tcp/127.0.0.1:7447?prio=1-4#iface=wlan0`.
pub(crate) struct Endpoint {
    pub(crate) protocol: String,
    pub(crate) host: String,
    pub(crate) port: u16,
    /// The text after the port.
    pub(crate) rest: String,
}

impl Endpoint {
    pub(crate) fn parse(text: &str) -> Option<Self> {
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

    pub(crate) fn text(&self) -> String {
        format!("{}/{}:{}{}", self.protocol, self.host, self.port, self.rest)
    }

    /// Whether it is the rendezvous of this machine; else it is the other side of a link, and each connection has settings.
    pub(crate) fn is_rendezvous(&self) -> bool {
        self.protocol == "tcp" && self.rest.is_empty() && self.is_local()
    }

    /// Whether only processes of this machine can connect there.
    pub(crate) fn is_local(&self) -> bool {
        let host = self.host.trim_matches(['[', ']']);
        host == "localhost" || host.parse::<IpAddr>().is_ok_and(|address| address.is_loopback())
    }
}

/// Where a session connects, by its mode and its endpoints as JSON: a list, or one for each mode.
pub(crate) fn connected(mode: &str, endpoints: &str) -> Vec<String> {
    let mode: Value = serde_json::from_str(mode).unwrap_or_default();
    let endpoints: Value = serde_json::from_str(endpoints).unwrap_or_default();
    let of_mode = endpoints.get(mode.as_str().unwrap_or("peer")).unwrap_or(&endpoints);
    let texts = of_mode.as_array().into_iter().flatten().filter_map(Value::as_str);
    texts.map(str::to_owned).collect()
}
