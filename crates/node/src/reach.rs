//! Explains to a tool why it sees no process of the vehicle, by separate TCP and TLS connections: a name or address unknown,
//! no program listening, no answer on an open connection, its key refused. Zenoh retries an address for ever without a log message, and a relay sends nothing to a
//! client that it rejects.

use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow};
use rustls::pki_types::ServerName;
use rustls::{AlertDescription, CertificateError, ClientConfig, ClientConnection};
use tokio::sync::oneshot;
use tokio::time::timeout;

use crate::endpoint::{self, Endpoint};
use crate::foreign::GREETING;
use crate::key_pair;

/// Maximum time for a connection, and then for an answer on it, such as the exchange of certificates.
const PATIENCE: Duration = Duration::from_secs(1);
/// Maximum time for an address altogether: the system may look a name up for longer.
const MAX_TIME: Duration = Duration::from_secs(4);
/// A refusal of a certificate arrives one round trip later; a relay that accepts it waits for the first message.
const MIN_REFUSAL: Duration = Duration::from_millis(300);
/// Addresses that are tried; a session has one, or the few of its site.
const MAX_PLACES: usize = 4;
/// The remedy for a wrong address.
const CORRECT: &str =
    "correct the address: `--connect`, `address` or `relay_address` of the site, or ALIGHT_CONNECT";

/// The addresses to which a session connects, and its keys.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Reach {
    /// The vehicle's name.
    vehicle: String,
    /// The first port of each host beyond this machine's rendezvous.
    places: Vec<Place>,
    /// The rendezvous port of this machine.
    meet: Option<u16>,
    keys: Option<Keys>,
}

#[derive(Clone, Debug, PartialEq, Eq)]
struct Place {
    host: String,
    port: u16,
    is_encrypted: bool,
}

/// The files of a key.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Keys {
    authority: PathBuf,
    certificate: PathBuf,
    private: PathBuf,
}

/// The result of a connection to an address.
#[derive(Debug)]
enum Finding {
    /// The name is not known.
    Unknown(io::Error),
    /// No program listens, or no answer arrives.
    Unreachable(io::Error),
    /// The connection is open, and nothing answers on it.
    Stalled,
    /// The exchange of certificates failed.
    Refused(io::Error),
    /// No result in time.
    Slow,
    /// The files of this process's key cannot be used.
    Keys(anyhow::Error),
    Accepted,
}

impl Reach {
    pub(crate) fn of(config: &zenoh::Config) -> Self {
        let part = |key: &str| config.get_json(key).unwrap_or_default();
        let text = |key: &str| serde_json::from_str::<Option<String>>(&part(key)).ok().flatten();
        let mut reach = Self { vehicle: text("namespace").unwrap_or_default(), ..Self::default() };
        for endpoint in endpoint::connected(&part("mode"), &part("connect/endpoints")) {
            let Some(endpoint) = Endpoint::parse(&endpoint) else { continue };
            let is_rendezvous = endpoint.is_rendezvous();
            let Endpoint { protocol, host, port, .. } = endpoint;
            let place = Place { host, port, is_encrypted: protocol == "tls" };
            if is_rendezvous {
                reach.meet = Some(port);
            } else if ["tcp", "tls"].contains(&protocol.as_str())
                && reach.places.len() < MAX_PLACES
                && reach.places.iter().all(|known| known.host != place.host)
            {
                reach.places.push(place);
            }
        }
        let file = |key: &str| text(&format!("transport/link/tls/{key}")).map(PathBuf::from);
        let authority = file("root_ca_certificate");
        let own = (file("connect_certificate"), file("connect_private_key"));
        if let (Some(authority), (Some(certificate), Some(private))) = (authority, own) {
            reach.keys = Some(Keys { authority, certificate, private });
        }
        reach
    }

    /// The vehicle and the rendezvous port, as a text.
    pub(crate) fn network(&self) -> String {
        match self.meet {
            Some(port) => format!("vehicle `{}`, port {port} of this machine", self.vehicle),
            None => format!("vehicle `{}`", self.vehicle),
        }
    }

    /// The vehicle's name.
    pub(crate) fn vehicle(&self) -> &str {
        &self.vehicle
    }

    /// The certificate of this process.
    pub(crate) fn certificate(&self) -> Option<&Path> {
        self.keys.as_ref().map(|keys| keys.certificate.as_path())
    }

    /// The reason why no process of the vehicle is seen, and a remedy.
    pub(crate) async fn explain(&self) -> String {
        let mut reasons = self.reasons().await;
        if let Some(port) = self.meet {
            reasons.push(format!(
                "no process of the vehicle `{}` meets at port {port} of this machine: `alight land` prints the port of its processes (`--meet`, \
                 ALIGHT_MEET) and of which vehicle (`--vehicle`, ALIGHT_VEHICLE); for `alight up` the site says it",
                self.vehicle
            ));
        }
        match reasons.is_empty() {
            true => format!("is one running for the vehicle `{}`?", self.vehicle),
            false => reasons.join("; "),
        }
    }

    /// The same for the other machines only: why their processes are not seen.
    pub(crate) async fn explain_others(&self) -> Option<String> {
        let reasons = self.reasons().await;
        (!reasons.is_empty()).then(|| reasons.join("; "))
    }

    async fn reasons(&self) -> Vec<String> {
        let mut reasons = Vec::new();
        for place in &self.places {
            let finding = self.finding(place).await;
            reasons.push(self.reason(place, &finding));
        }
        reasons
    }

    /// Connects in a separate thread, for which neither the runtime's workers nor the end of the process waits.
    async fn finding(&self, place: &Place) -> Finding {
        let (place, keys) = (place.clone(), self.keys.clone());
        let (sender, receiver) = oneshot::channel();
        let asks = move || drop(sender.send(place.finding(keys.as_ref())));
        if let Err(cause) = std::thread::Builder::new().name("reach".into()).spawn(asks) {
            return Finding::Keys(anyhow!(
                "starting a thread that connects to the addresses: {cause}"
            ));
        }
        match timeout(MAX_TIME, receiver).await {
            Ok(Ok(finding)) => finding,
            Ok(Err(_)) | Err(_) => Finding::Slow,
        }
    }

    fn reason(&self, place: &Place, finding: &Finding) -> String {
        let Place { host, port, .. } = place;
        let at = format!("{host}:{port}");
        let own = self.keys.as_ref().map(|keys| keys.certificate.display().to_string());
        let own = own.unwrap_or_default();
        match finding {
            Finding::Unknown(cause) => {
                format!("the address of `{host}` is not known here ({}); {CORRECT}", plain(cause))
            }
            Finding::Unreachable(cause) if cause.kind() == io::ErrorKind::ConnectionRefused => {
                format!(
                    "no program listens at {at}: start the relay there (`alight up drone`), or {CORRECT}"
                )
            }
            Finding::Unreachable(cause) => format!(
                "{at} cannot be reached ({}): is it switched on, and is this machine in its network? Else {CORRECT}",
                plain(cause)
            ),
            Finding::Stalled => format!(
                "the connection to {at} opens, but nothing answers on it within {} s: the link or the relay there is stalled. The drone continues \
                 its landing on its own; to intervene, use the pilot's mode switch. If it persists, start the relay again, or {CORRECT}",
                PATIENCE.as_secs()
            ),
            Finding::Slow => format!(
                "{at} was not reached, or has not answered, within {} s: its name is resolved slowly, or it cannot be reached; {CORRECT}",
                MAX_TIME.as_secs()
            ),
            Finding::Keys(cause) => format!("{cause:#}"),
            Finding::Refused(cause) => match rustls_error(cause) {
                // Also reported for a certificate that is not valid yet.
                Some(rustls::Error::AlertReceived(AlertDescription::CertificateExpired)) => {
                    format!(
                        "the relay at {at} refuses the certificate {own}, as not valid at this time: it has expired (`alight keys issue` makes \
                         another), or the clock of that machine is wrong, as without NTP after a start: set it there (`timedatectl` shows it)"
                    )
                }
                Some(rustls::Error::AlertReceived(alert)) => format!(
                    "the relay at {at} refuses the certificate {own} ({alert:?}): it is of another authority, or cannot be used; \
                     `alight keys issue` makes another"
                ),
                Some(rustls::Error::InvalidCertificate(problem)) => {
                    let problem = certificate_problem(problem, host);
                    format!("the relay at {at} has a certificate {problem}")
                }
                _ => format!(
                    "the program that listens at {at} has not answered with a certificate ({}): another program, or a relay without keys \
                     (`--keys`); else {CORRECT}",
                    plain(cause)
                ),
            },
            Finding::Accepted if place.is_encrypted && self.keys.is_none() => {
                format!("the relay at {at} wants a key, and this process has none (`--keys`)")
            }
            Finding::Accepted if place.is_encrypted => format!(
                "the relay at {at} accepts the certificate {own}, but announces no process to it: its holder was revoked, is of another vehicle than \
                 `{}`, or is not in the relay's holders.txt, which `alight keys issue` and `revoke` write next to the authority's key, and \
                 which is to be copied to each relay",
                self.vehicle
            ),
            Finding::Accepted => format!(
                "{at} answers, and no process of the vehicle `{}` is there: is that its name (`--vehicle`, ALIGHT_VEHICLE)?",
                self.vehicle
            ),
        }
    }
}

impl Place {
    /// Connects, and exchanges certificates on an encrypted address.
    fn finding(&self, keys: Option<&Keys>) -> Finding {
        let host = self.host.trim_matches(['[', ']']);
        let addresses: Vec<SocketAddr> = match (host, self.port).to_socket_addrs() {
            Ok(addresses) => addresses.take(MAX_PLACES).collect(),
            Err(cause) => return Finding::Unknown(cause),
        };
        let mut last = io::ErrorKind::AddrNotAvailable.into();
        for address in addresses {
            match TcpStream::connect_timeout(&address, PATIENCE) {
                Ok(stream) if self.is_encrypted => {
                    return keys.map_or(Finding::Accepted, |keys| greet(stream, host, keys));
                }
                Ok(stream) => return answer(stream),
                Err(cause) => last = cause,
            }
        }
        Finding::Unreachable(last)
    }
}

/// Whether anything answers Zenoh's greeting on a connection without TLS.
fn answer(mut stream: TcpStream) -> Finding {
    let read = stream
        .set_write_timeout(Some(PATIENCE))
        .and_then(|()| stream.set_read_timeout(Some(PATIENCE)))
        .and_then(|()| stream.write_all(&GREETING))
        .and_then(|()| stream.read(&mut [0]));
    match read {
        Err(cause) if is_timeout(&cause) => Finding::Stalled,
        // Another answer than Zenoh's was reported when the session was opened.
        Ok(_) | Err(_) => Finding::Accepted,
    }
}

/// Exchanges certificates on a connection.
fn greet(mut stream: TcpStream, host: &str, keys: &Keys) -> Finding {
    let mut connection = match connection(host, keys) {
        Ok(connection) => connection,
        Err(cause) => return Finding::Keys(cause),
    };
    let begun = Instant::now();
    let outcome = shake(&mut connection, &mut stream, begun + PATIENCE).and_then(|()| {
        let time_limit = (2 * begun.elapsed()).clamp(MIN_REFUSAL, PATIENCE);
        is_taken(&mut connection, &mut stream, Instant::now() + time_limit)
    });
    match outcome {
        Ok(()) => Finding::Accepted,
        Err(cause) if is_timeout(&cause) => Finding::Stalled,
        Err(cause) => Finding::Refused(cause),
    }
}

/// Exchanges certificates.
fn shake(
    connection: &mut ClientConnection,
    stream: &mut TcpStream,
    end: Instant,
) -> io::Result<()> {
    while connection.is_handshaking() {
        if connection.wants_write() {
            stream.set_write_timeout(Some(left(end)?))?;
            connection.write_tls(stream)?;
        } else {
            read_once(connection, stream, end)?;
        }
    }
    while connection.wants_write() {
        stream.set_write_timeout(Some(left(end)?))?;
        connection.write_tls(stream)?;
    }
    Ok(())
}

/// Waits for a refusal of the certificate: then the other end sends an alert or closes the connection.
fn is_taken(
    connection: &mut ClientConnection,
    stream: &mut TcpStream,
    end: Instant,
) -> io::Result<()> {
    loop {
        match read_once(connection, stream, end) {
            Ok(()) => {}
            Err(cause) if is_timeout(&cause) => return Ok(()),
            Err(cause) => return Err(cause),
        }
    }
}

/// Reads once, until `end`.
fn read_once(
    connection: &mut ClientConnection,
    stream: &mut TcpStream,
    end: Instant,
) -> io::Result<()> {
    stream.set_read_timeout(Some(left(end)?))?;
    match connection.read_tls(stream) {
        Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
        // As after a pause of the process.
        Err(cause) if cause.kind() == io::ErrorKind::Interrupted => return Ok(()),
        read => read?,
    };
    match connection.process_new_packets() {
        Ok(state) if state.peer_has_closed() => Err(io::ErrorKind::UnexpectedEof.into()),
        Ok(_) => Ok(()),
        Err(cause) => {
            // The alert reports the cause to the other end, if that still reads.
            drop(connection.write_tls(stream));
            Err(io::Error::other(cause))
        }
    }
}

/// The time until `end`.
fn left(end: Instant) -> io::Result<Duration> {
    let left = end.saturating_duration_since(Instant::now());
    if left.is_zero() { Err(io::ErrorKind::TimedOut.into()) } else { Ok(left) }
}

fn connection(host: &str, keys: &Keys) -> anyhow::Result<ClientConnection> {
    let Keys { authority, certificate, private } = keys;
    let roots = key_pair::trusted(authority)?;
    let provider = Arc::new(rustls::crypto::ring::default_provider());
    let own = (vec![key_pair::certificate_of(certificate)?], key_pair::private_of(private)?);
    let config = ClientConfig::builder_with_provider(provider)
        .with_safe_default_protocol_versions()?
        .with_root_certificates(roots)
        .with_client_auth_cert(own.0, own.1)
        .with_context(|| format!("{private:?} does not belong to {certificate:?}"))?;
    let name = ServerName::try_from(host.to_owned())
        .with_context(|| format!("`{host}` is no name that a certificate can have"))?;
    Ok(ClientConnection::new(Arc::new(config), name)?)
}

fn is_timeout(cause: &io::Error) -> bool {
    matches!(cause.kind(), io::ErrorKind::WouldBlock | io::ErrorKind::TimedOut)
}

/// An error without the number that the operating system gives it.
fn plain(cause: &io::Error) -> String {
    match cause.raw_os_error() {
        Some(_) => cause.kind().to_string(),
        None => cause.to_string(),
    }
}

fn rustls_error(cause: &io::Error) -> Option<&rustls::Error> {
    cause.get_ref()?.downcast_ref()
}

/// The error of a relay's certificate, and a remedy.
fn certificate_problem(problem: &CertificateError, host: &str) -> String {
    match problem {
        CertificateError::NotValidForName | CertificateError::NotValidForNameContext { .. } => {
            format!(
                "that is not valid for the address `{host}`: connect to an address that it names, or make its key with \
                 `alight keys issue --address {host}`"
            )
        }
        CertificateError::Expired | CertificateError::ExpiredContext { .. } => {
            "that has expired (if this machine's clock is right): `alight keys issue` makes another".to_owned()
        }
        CertificateError::NotValidYet | CertificateError::NotValidYetContext { .. } => {
            "that is not valid yet: this machine's clock is wrong, as without NTP after a start; set it (`timedatectl` shows it)".to_owned()
        }
        // Authorities may have the same name.
        CertificateError::UnknownIssuer | CertificateError::BadSignature => {
            "of another authority than that of this key: it is another vehicle's, or one of both has old keys".to_owned()
        }
        other => format!("that is not valid: {other}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_certificate_that_is_not_valid_at_this_time_is_reported_with_the_clock_as_a_cause() {
        let place = Place { host: "10.0.0.1".to_owned(), port: 7448, is_encrypted: true };
        let reason_of = |problem: rustls::Error| {
            Reach::default().reason(&place, &Finding::Refused(io::Error::other(problem)))
        };
        // A relay reports a certificate that is not valid yet in the same way.
        let expired = AlertDescription::CertificateExpired;
        let refused = reason_of(rustls::Error::AlertReceived(expired));
        for part in ["has expired", "alight keys issue", "clock of that machine", "timedatectl"] {
            assert!(refused.contains(part), "`{part}` is not in: {refused}");
        }
        let other = reason_of(rustls::Error::AlertReceived(AlertDescription::UnknownCA));
        assert!(other.contains("another authority") && !other.contains("clock"), "{other}");
        let early = reason_of(rustls::Error::InvalidCertificate(CertificateError::NotValidYet));
        for part in ["not valid yet", "this machine's clock", "timedatectl"] {
            assert!(early.contains(part), "`{part}` is not in: {early}");
        }
        assert!(!early.contains("alight keys issue"), "{early}");
    }
}
