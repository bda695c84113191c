//! Ports that are free, for the tests that name them in a file before anybody listens there.

use std::net::{TcpListener, UdpSocket};

/// So many TCP ports, one that is followed by two more free ones, as an air link needs them, and a UDP port; all different.
pub(crate) fn free<const N: usize>() -> anyhow::Result<([u16; N], u16, u16)> {
    // They stay taken until all are chosen, or one could be chosen twice.
    let mut taken = Vec::new();
    let mut ports = [0; N];
    for port in &mut ports {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        *port = listener.local_addr()?.port();
        taken.push(listener);
    }
    let row = loop {
        let listener = TcpListener::bind("127.0.0.1:0")?;
        let port = listener.local_addr()?.port();
        let next =
            [1, 2].map(|further| TcpListener::bind(("127.0.0.1", port.wrapping_add(further))));
        if next.iter().all(Result::is_ok) {
            break port;
        }
    };
    let udp = UdpSocket::bind("127.0.0.1:0")?.local_addr()?.port();
    Ok((ports, row, udp))
}
