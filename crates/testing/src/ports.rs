//! Finds free ports, for tests that name them in a file before a process listens there.

use std::net::{TcpListener, UdpSocket};
use std::sync::atomic::{AtomicU32, Ordering};

use anyhow::Context;

/// Ports that neither Linux gives to a process that requests any port, nor `alight land` to its processes, so free ones stay free.
const FIRST: u32 = 20_000;
const COUNT: u32 = 6_000;
/// The maximum number of neighbouring ports that are requested.
const MAX_ROW: u32 = 3;
/// No port is chosen twice by one process, and processes begin at different ones.
static CHOSEN: AtomicU32 = AtomicU32::new(0);

/// `N` TCP ports, the first of three neighbouring ports for an air link, and a UDP port; all different.
///
/// # Errors
/// A thousand ports that were tried are all in use.
pub fn free<const N: usize>() -> anyhow::Result<([u16; N], u16, u16)> {
    let mut ports = [0; N];
    for port in &mut ports {
        *port = row(1)?;
    }
    Ok((ports, row(3)?, row(1)?))
}

/// The first of so many neighbouring ports.
fn row(len: u16) -> anyhow::Result<u16> {
    let is_free = |port: u16| {
        UdpSocket::bind(("127.0.0.1", port)).is_ok()
            && TcpListener::bind(("127.0.0.1", port)).is_ok()
    };
    let begin = std::process::id().wrapping_mul(97);
    (0..1000)
        .map(|_| {
            let chosen = CHOSEN.fetch_add(u32::from(len), Ordering::Relaxed);
            (FIRST + begin.wrapping_add(chosen) % (COUNT - MAX_ROW)) as u16
        })
        .find(|first| (*first..first + len).all(is_free))
        .context("no free port of 1000 that were tried")
}
