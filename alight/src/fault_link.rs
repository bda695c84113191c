//! A UDP proxy between the simulated autopilot and the controller, in real time: it delays, drops and changes MAVLink packets while a fault
//! of the link persists.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use anyhow::Context;
use experiments::faults::link::FaultyLink;
use experiments::faults::plan::Fault;
use tokio::net::UdpSocket;
use tokio::task::JoinHandle;
use tokio::time::interval;

use crate::land::LOOPBACK;

/// Period with which delayed packets are sent on.
const PERIOD: Duration = Duration::from_millis(2);
/// Longest datagram of MAVLink that is passed on, in bytes.
const MAX_DATAGRAM: usize = 2048;

/// A proxy between two UDP ports.
pub(crate) struct Proxy {
    link: Arc<Mutex<FaultyLink>>,
    opened: Instant,
    task: JoinHandle<()>,
}

impl Proxy {
    /// Forwards datagrams from `world_port` to the controller's port, and back.
    ///
    /// # Errors
    /// When a port is in use.
    pub(crate) async fn start(seed: u64, world_port: u16, port: u16) -> anyhow::Result<Self> {
        let world = UdpSocket::bind((LOOPBACK, world_port)).await.context("opening the proxy")?;
        let controller = UdpSocket::bind((LOOPBACK, 0)).await.context("opening the proxy")?;
        controller.connect((LOOPBACK, port)).await.context("opening the proxy")?;
        let link = Arc::new(Mutex::new(FaultyLink::new(seed)));
        let opened = Instant::now();
        let task = tokio::spawn(pass(world, controller, Arc::clone(&link), opened));
        Ok(Self { link, opened, task })
    }

    /// A fault begins.
    pub(crate) fn begin(&self, fault: Fault) {
        let now_s = self.opened.elapsed().as_secs_f64();
        lock(&self.link).begin(now_s, fault);
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.task.abort();
    }
}

async fn pass(
    world: UdpSocket,
    controller: UdpSocket,
    link: Arc<Mutex<FaultyLink>>,
    opened: Instant,
) {
    let mut from: [u8; MAX_DATAGRAM] = [0; MAX_DATAGRAM];
    let mut to: [u8; MAX_DATAGRAM] = [0; MAX_DATAGRAM];
    let mut autopilot: Option<SocketAddr> = None;
    let mut due = interval(PERIOD);
    loop {
        // An error of a socket means that the peer is not there at the moment.
        tokio::select! {
            Ok((length, peer)) = world.recv_from(&mut from) => {
                autopilot = Some(peer);
                let now_s = opened.elapsed().as_secs_f64();
                lock(&link).put_from_autopilot(now_s, from.get(..length).unwrap_or_default());
            }
            Ok(length) = controller.recv(&mut to) => {
                let now_s = opened.elapsed().as_secs_f64();
                let packet = to.get(..length).unwrap_or_default().to_vec();
                lock(&link).put_to_autopilot(now_s, packet);
            }
            _ = due.tick() => {}
        }
        let now_s = opened.elapsed().as_secs_f64();
        while let Some(packet) = take(&link, |link| link.take_from_autopilot(now_s)) {
            let _ = controller.try_send(&packet);
        }
        while let Some(packet) = take(&link, |link| link.take_to_autopilot(now_s)) {
            if let Some(peer) = autopilot {
                let _ = world.try_send_to(&packet, peer);
            }
        }
    }
}

fn take(
    link: &Mutex<FaultyLink>,
    next: impl FnOnce(&mut FaultyLink) -> Option<Vec<u8>>,
) -> Option<Vec<u8>> {
    next(&mut lock(link))
}

// The link stays valid when another thread panicked.
fn lock(link: &Mutex<FaultyLink>) -> MutexGuard<'_, FaultyLink> {
    link.lock().unwrap_or_else(PoisonError::into_inner)
}
