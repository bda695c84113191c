//! Opens the sockets and serial lines of a link, and explains why one cannot be opened.

use std::io;
use std::net::{Ipv4Addr, Ipv6Addr, SocketAddr};
use std::time::Duration;

use tokio::net::{TcpListener, TcpStream, UdpSocket, lookup_host};
use tokio::time::timeout;
use tokio_serial::{SerialPortBuilderExt, SerialStream};

use crate::address::Endpoint;

/// Timeout of opening a connection.
const CONNECT_LIMIT: Duration = Duration::from_secs(3);

/// A socket that listens at an endpoint.
pub(crate) async fn listen_udp(at: &Endpoint) -> io::Result<UdpSocket> {
    UdpSocket::bind(local(at).await?).await
}

/// The same for TCP.
pub(crate) async fn listen_tcp(at: &Endpoint) -> io::Result<TcpListener> {
    TcpListener::bind(local(at).await?).await
}

/// The address to listen on. Not each of the host's in turn, or a second program would get the next one where the port is in use.
async fn local(at: &Endpoint) -> io::Result<SocketAddr> {
    let found = lookup_host((at.host.as_str(), at.port)).await?;
    in_order(found).first().copied().ok_or_else(|| io::ErrorKind::AddrNotAvailable.into())
}

/// The addresses of a host with those of IPv4 first, which autopilots and ground stations speak; a socket has either IPv4 or IPv6.
fn in_order(found: impl Iterator<Item = SocketAddr>) -> Vec<SocketAddr> {
    let mut found: Vec<_> = found.collect();
    found.sort_by_key(SocketAddr::is_ipv6);
    found
}

/// A socket that is connected to the first of a host's addresses that can be, and that address.
pub(crate) async fn call_udp(to: &Endpoint) -> io::Result<(UdpSocket, SocketAddr)> {
    let mut result = Err(io::ErrorKind::HostUnreachable.into());
    for peer in in_order(lookup_host((to.host.as_str(), to.port)).await?) {
        result = connect_udp(peer).await.map(|socket| (socket, peer));
        if result.is_ok() {
            break;
        }
    }
    result
}

/// A socket that is connected to one address.
pub(crate) async fn connect_udp(peer: SocketAddr) -> io::Result<UdpSocket> {
    let local: SocketAddr = match peer {
        SocketAddr::V4(_) => (Ipv4Addr::UNSPECIFIED, 0).into(),
        SocketAddr::V6(_) => (Ipv6Addr::UNSPECIFIED, 0).into(),
    };
    let socket = UdpSocket::bind(local).await?;
    socket.connect(peer).await?;
    Ok(socket)
}

/// A connection over TCP.
pub(crate) async fn call_tcp(to: &Endpoint) -> io::Result<TcpStream> {
    let connecting = TcpStream::connect((to.host.as_str(), to.port));
    let stream =
        timeout(CONNECT_LIMIT, connecting).await.map_err(|_| io::ErrorKind::TimedOut)??;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// A serial line.
pub(crate) fn open_serial(device: &str, baud: u32) -> tokio_serial::Result<SerialStream> {
    tokio_serial::new(device, baud).open_native_async()
}

/// The cause of a failed connection, and the things to check.
pub(crate) fn explain_socket(error: &io::Error, other_side: &str) -> String {
    match error.kind() {
        io::ErrorKind::ConnectionRefused => {
            format!("connection refused; is the {other_side} running?")
        }
        io::ErrorKind::TimedOut => {
            format!("no reply; is the {other_side} running and in range?")
        }
        _ => format!("cannot reach it: {error}"),
    }
}

/// The same for a serial line.
pub(crate) fn explain_serial(device: &str, error: &tokio_serial::Error) -> String {
    use tokio_serial::ErrorKind;
    match error.kind() {
        ErrorKind::NoDevice | ErrorKind::Io(io::ErrorKind::NotFound) => {
            format!("no device {device}; is the cable plugged in and the other side switched on?")
        }
        ErrorKind::Io(io::ErrorKind::PermissionDenied) => format!(
            "no permission to open {device}; on most systems the group `dialout` has it (then log in again)"
        ),
        _ => format!("cannot open {device} (another program may hold it): {error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ipv4_is_used_for_a_host_with_addresses_of_both_kinds() {
        let [v6, v4] = ["[::1]:14550", "127.0.0.1:14550"].map(|text| text.parse().unwrap());
        assert_eq!(in_order([v6, v4].into_iter()), [v4, v6]);
        assert_eq!(in_order([v6].into_iter()), [v6]);
    }
}
