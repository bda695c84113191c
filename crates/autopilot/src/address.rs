//! The address of a link to an autopilot or a ground station.

use std::fmt;
use std::str::FromStr;

/// Default speed of a serial line, in baud: ArduPilot's default for a telemetry port.
pub const DEFAULT_BAUD: u32 = 57_600;

/// The address of a link to an autopilot or a ground station.
///
/// ```
/// use autopilot::Address;
/// let address: Address = "serial:/dev/ttyACM0:921600".parse()?;
/// assert_eq!(address, Address::Serial { device: "/dev/ttyACM0".into(), baud: 921_600 });
/// assert_eq!(address.to_string(), "serial:/dev/ttyACM0:921600");
/// # Ok::<(), autopilot::address::AddressError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// Listen on this UDP port, and reply to the other side's address.
    UdpIn(Endpoint),
    /// Send to this UDP port, and receive its replies.
    UdpOut(Endpoint),
    /// Connect to this TCP port.
    Tcp(Endpoint),
    /// Accept one connection on this TCP port.
    TcpIn(Endpoint),
    /// A serial line.
    Serial {
        /// The device's path or name.
        device: String,
        /// Bits per second; USB ignores it.
        baud: u32,
    },
}

/// A host and a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Name or number of the host, an IPv6 number without its brackets.
    pub host: String,
    /// Port; 0 when listening means any free one.
    pub port: u16,
}

/// Why an address is invalid.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is not an address of a MAVLink link: {reason}; {EXPECTED}")]
pub struct AddressError {
    text: String,
    reason: String,
}

const EXPECTED: &str = "write udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT, tcpin:HOST:PORT or \
                        serial:DEVICE[:BAUD], for example udpin:0.0.0.0:14550 or serial:/dev/ttyACM0:57600";

impl FromStr for Address {
    type Err = AddressError;

    fn from_str(text: &str) -> Result<Self, AddressError> {
        parse(text).map_err(|reason| AddressError { text: text.into(), reason })
    }
}

impl fmt::Display for Address {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UdpIn(endpoint) => write!(f, "udpin:{endpoint}"),
            Self::UdpOut(endpoint) => write!(f, "udpout:{endpoint}"),
            Self::Tcp(endpoint) => write!(f, "tcp:{endpoint}"),
            Self::TcpIn(endpoint) => write!(f, "tcpin:{endpoint}"),
            Self::Serial { device, baud } => write!(f, "serial:{device}:{baud}"),
        }
    }
}

impl fmt::Display for Endpoint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { host, port } = self;
        if host.contains(':') { write!(f, "[{host}]:{port}") } else { write!(f, "{host}:{port}") }
    }
}

fn parse(text: &str) -> Result<Address, String> {
    let Some((kind, rest)) = text.split_once(':') else {
        return Err(if text.starts_with('/') {
            format!("missing scheme: write serial:{text}")
        } else {
            "it has no `:`".into()
        });
    };
    match kind {
        "udpin" => endpoint(rest, true).map(Address::UdpIn),
        "udpout" => endpoint(rest, false).map(Address::UdpOut),
        "tcp" => endpoint(rest, false).map(Address::Tcp),
        "tcpin" => endpoint(rest, true).map(Address::TcpIn),
        "serial" => serial(rest),
        "udp" => Err("ambiguous scheme `udp`: use `udpin` (listen) or `udpout` (connect)".into()),
        "tcpout" => Err("unknown scheme `tcpout`: use `tcp` (connect) or `tcpin` (listen)".into()),
        _ if kind.starts_with('/') => Err(format!("missing scheme: write serial:{text}")),
        _ => Err(format!("unknown scheme `{kind}`")),
    }
}

fn endpoint(text: &str, listens: bool) -> Result<Endpoint, String> {
    let Some((host, port)) = text.rsplit_once(':') else {
        return Err(format!("`{text}` has no port behind the host"));
    };
    let bare = host.strip_prefix('[').and_then(|host| host.strip_suffix(']'));
    if bare.is_none() && host.contains(':') {
        return Err(format!("the IPv6 address `{host}` needs brackets, as in [{host}]"));
    }
    let host = bare.unwrap_or(host);
    if host.is_empty() || host.contains(|c: char| c.is_whitespace() || "[]/".contains(c)) {
        return Err(format!("invalid host `{host}` (use 0.0.0.0 for all interfaces)"));
    }
    match port.parse() {
        Ok(0) if !listens => Err("cannot connect to port 0".into()),
        Ok(port) => Ok(Endpoint { host: host.into(), port }),
        Err(_) => Err(format!("invalid port `{port}` (1 to 65535)")),
    }
}

/// A device path may contain colons, so only a number at its end is the speed.
fn serial(text: &str) -> Result<Address, String> {
    let (device, baud) = match text.rsplit_once(':') {
        Some((device, baud)) if baud.is_empty() || baud.bytes().all(|b| b.is_ascii_digit()) => {
            let baud = baud.parse().ok().filter(|baud| (1_200..=12_000_000).contains(baud));
            (device, baud.ok_or("the speed must be from 1200 to 12000000 baud")?)
        }
        _ => (text, DEFAULT_BAUD),
    };
    if device.is_empty() {
        return Err("the device is missing".into());
    }
    Ok(Address::Serial { device: device.into(), baud })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn addresses_are_written_as_they_are_read() {
        for text in [
            "udpin:127.0.0.1:14550",
            "udpout:[::1]:14550",
            "tcp:drone.local:5760",
            "tcpin:0.0.0.0:5760",
            "serial:/dev/ttyACM0:921600",
            "serial:COM3:115200",
        ] {
            assert_eq!(text.parse::<Address>().unwrap().to_string(), text);
        }
        let path = "serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:1:1.0";
        assert_eq!(path.parse::<Address>().unwrap().to_string(), format!("{path}:57600"));
    }

    #[test]
    fn an_invalid_address_is_reported_with_the_reason_and_a_valid_example() {
        for (text, reason) in [
            ("", "no `:`"),
            ("/dev/ttyACM0", "serial:/dev/ttyACM0"),
            ("udp:0.0.0.0:14550", "ambiguous scheme"),
            ("usb:0", "unknown scheme `usb`"),
            ("udpin:14550", "no port"),
            ("udpin:::1:14550", "needs brackets"),
            ("udpin::14550", "invalid host"),
            ("tcp:host:0", "port 0"),
            ("tcp:host:70000", "invalid port"),
            ("serial::57600", "device is missing"),
            ("serial:/dev/ttyS0:99", "from 1200"),
        ] {
            let error = text.parse::<Address>().unwrap_err().to_string();
            assert!(error.contains(reason), "{text}: {error}");
            assert!(error.contains("for example"), "{error}");
        }
    }

    proptest! {
        #[test]
        fn no_text_panics(text in ".{0,40}") {
            if let Ok(address) = text.parse::<Address>() {
                prop_assert_eq!(address.to_string().parse::<Address>().unwrap(), address);
            }
        }
    }
}
