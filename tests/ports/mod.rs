//! Ports that are free, for the tests that name them in a file before anybody listens there.

use std::net::{TcpListener, UdpSocket};

/// So many TCP ports, one that has another free one next to it, and a UDP port; all different.
pub(crate) fn free<const N: usize>() -> anyhow::Result<([u16; N], u16, u16)> {
    // They stay taken until all are chosen, or one could be chosen twice.
    let mut taken = Vec::new();
    let mut ports = [0; N];
    for port in &mut ports {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        *port = listener.local_addr()?.port();
        taken.push(listener);
    }
    let pair = loop {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let port = listener.local_addr()?.port();
        if TcpListener::bind(("127.0.0.1", port.saturating_add(1))).is_ok() {
            break port;
        }
    };
    let udp = UdpSocket::bind("127.0.0.1:0")?.local_addr()?.port();
    Ok((ports, pair, udp))
}
