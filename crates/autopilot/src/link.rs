//! Sends and receives MAVLink packets over UDP, TCP or a serial line, to an autopilot or a ground station: bounded queues,
//! reconnection, signatures, and explained errors.
//!
//! A permanent problem (a port used by another program) is an error at once; a temporary one (no device yet,
//! no reply, a cable pulled) is retried without end. Slow readers and slow lines do not block: queues are
//! bounded, the oldest received packet is dropped, and a packet that cannot be sent is refused, because a
//! late command is a wrong one.

use std::collections::{BTreeSet, VecDeque};
use std::future::poll_fn;
use std::io;
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};
use std::time::{Duration, Instant, SystemTime};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::net::{TcpListener, TcpStream, UdpSocket};
use tokio::sync::{Notify, mpsc};
use tokio::task::JoinHandle;
use tokio::time::{sleep, sleep_until};
use tokio_serial::{SerialPort, SerialStream};

use crate::address::{Address, Endpoint};
use crate::connect::{
    call_tcp, call_udp, connect_udp, explain_serial, explain_socket, listen_tcp, listen_udp,
    open_serial,
};
use crate::gate::{Admitted, Gate};
use crate::key_file::{SigningConfig, StampFile};
use crate::newest::Newest;
use crate::packet::{Counters, Packet, Parser};
use crate::peers::{PACKET_GAP, Peering, Peers};
use crate::received::{Received, note_systems};
use crate::signing::{Refusals, Signing, stamp};

/// Maximum number of packets received and not yet read, about 4 s of an autopilot's traffic.
const INCOMING: usize = 1024;
/// Maximum number of packets waiting to be sent.
const OUTGOING: usize = 256;
/// Maximum number of waiting packets of low priority, about a second of a slow line.
const SPARE: usize = 16;
/// Room behind them that only commands of low priority have.
const COMMANDS: usize = 16;
/// Maximum time that a line needs for its unsent bytes, when one of them or a setpoint is sent.
const SPARE_BACKLOG: Duration = Duration::from_millis(50);
/// Pause before it is checked again how much a line has still to send.
const BACKLOG_PAUSE: Duration = Duration::from_millis(10);
/// Pause before the first retry; it doubles up to the last.
const FIRST_RETRY: Duration = Duration::from_millis(200);
/// Maximum pause between two retries.
const LAST_RETRY: Duration = Duration::from_secs(2);
/// Timeout of writing one packet.
const WRITE_LIMIT: Duration = Duration::from_secs(2);
/// Time without a datagram that could be sent, after which it is checked whether a UDP connection would have another address.
const SEND_LIMIT: Duration = Duration::from_secs(2);
/// Silence after which a TCP connection counts as dead.
const TCP_SILENCE: Duration = Duration::from_secs(10);
/// Silence after which an incomplete packet of a TCP connection is noise. It loses no byte, and bytes that a stall holds up come later; but
/// it may begin inside a packet, or bring the noise of a serial line behind it.
const TCP_GAP: Duration = Duration::from_secs(2);
/// A time that no operation takes.
const NO_LIMIT: Duration = Duration::from_secs(3600);

/// A connection to an autopilot or a ground station that reconnects automatically.
#[derive(Debug)]
pub struct Link {
    shared: Arc<Shared>,
    sender: LinkSender,
    task: JoinHandle<()>,
    local: Option<SocketAddr>,
}

/// Sends packets over a [`Link`], from any task.
#[derive(Clone, Debug)]
pub struct LinkSender {
    shared: Arc<Shared>,
    queue: mpsc::Sender<Vec<u8>>,
    spare: mpsc::Sender<Vec<u8>>,
}

/// An event of a link.
#[derive(Clone, Debug, PartialEq)]
pub enum LinkEvent {
    /// Packets can be sent; over `udpin` a peer was chosen.
    Connected {
        /// The other side, as text.
        peer: String,
    },
    /// Packets cannot be sent; the link is retried. Reported once per reason.
    Disconnected {
        /// The reason, as text.
        reason: String,
    },
    /// A packet.
    Packet {
        /// The packet.
        packet: Box<Packet>,
        /// Time of reception of its last byte.
        received: Instant,
    },
    /// The heartbeat of another autopilot than the link's peer, at a listening UDP port where none is pinned; at most
    /// one a second.
    OtherAutopilot {
        /// The heartbeat.
        packet: Box<Packet>,
        /// Time of its reception.
        received: Instant,
    },
}

/// Why a link cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// Another program uses the port.
    #[error(
        "{address}: port {port} is already in use by another program, often a ground station \
         (QGroundControl, MAVProxy) or a second controller; stop that program, or listen on another \
         port and have the packets sent there"
    )]
    PortInUse {
        /// The address.
        address: Address,
        /// The port.
        port: u16,
    },
    /// The host to listen on is not this machine.
    #[error(
        "{address}: this machine has no network address `{host}`, so it cannot listen there; \
         0.0.0.0 listens on every network, 127.0.0.1 on this machine only"
    )]
    NotLocal {
        /// The address.
        address: Address,
        /// The host.
        host: String,
    },
    /// Any other error of listening.
    #[error("{address}: cannot listen there: {source}")]
    Listen {
        /// The address.
        address: Address,
        /// The error of the operating system.
        source: io::Error,
    },
}

/// Why a packet was not sent.
#[derive(Copy, Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// No connection.
    #[error("not sent: the link is not connected")]
    NotConnected,
    /// The line is too slow.
    #[error("not sent: the queue is full, the line is too slow")]
    Full,
}

impl Link {
    /// Opens the link; needs a tokio runtime with network and time, and ends when it is dropped.
    pub async fn open(address: Address) -> Result<Self, LinkError> {
        Self::open_for(address, Peering::default(), None).await
    }

    /// The same, for the peers of a kind where it listens, and with a key for signed packets only; all others are dropped
    /// and counted.
    pub async fn open_for(
        address: Address,
        peering: Peering,
        signing: Option<SigningConfig>,
    ) -> Result<Self, LinkError> {
        let listener = listen(&address).await?;
        let local = match &listener {
            Listener::Udp(socket) => socket.local_addr().ok(),
            Listener::Tcp(listener) => listener.local_addr().ok(),
            Listener::None => None,
        };
        let (queue, outgoing) = mpsc::channel(OUTGOING);
        let (spare, outgoing_spare) = mpsc::channel(SPARE + COMMANDS);
        let shared = Arc::new(Shared::new());
        let (gate, keeping) = signing.map_or((Gate::new(None), None), keyed);
        let port = Port {
            shared: Arc::clone(&shared),
            outgoing,
            outgoing_spare,
            peering,
            first_autopilot: None,
            gate,
            keeping,
        };
        let task = tokio::spawn(run(address, listener, port));
        let sender = LinkSender { shared: Arc::clone(&shared), queue, spare };
        Ok(Self { shared, sender, task, local })
    }

    /// The next event; may be cancelled without losing one.
    pub async fn recv(&mut self) -> LinkEvent {
        loop {
            if let Some(event) = self.try_recv() {
                return event;
            }
            self.shared.arrived.notified().await;
        }
    }

    /// The next event if there is one already.
    pub fn try_recv(&mut self) -> Option<LinkEvent> {
        self.shared.events().pop_front()
    }

    /// Sends a packet without waiting; see [`LinkSender::send`].
    pub fn send(&self, packet: &[u8]) -> Result<(), SendError> {
        self.sender.send(packet)
    }

    /// Sends a packet of low priority without waiting; see [`LinkSender::send_spare`].
    pub fn send_spare(&self, packet: &[u8]) -> Result<(), SendError> {
        self.sender.send_spare(packet)
    }

    /// Sends a setpoint without waiting; see [`LinkSender::send_newest`].
    ///
    /// # Errors
    /// When there is no connection.
    pub fn send_newest(&self, packet: &[u8]) -> Result<(), SendError> {
        self.sender.send_newest(packet)
    }

    /// Sends a command of low priority without waiting; see [`LinkSender::send_command`].
    pub fn send_command(&self, packet: &[u8]) -> Result<(), SendError> {
        self.sender.send_command(packet)
    }

    /// A handle for sending over this link.
    pub fn sender(&self) -> LinkSender {
        self.sender.clone()
    }

    /// Where it listens, for `udpin` and `tcpin`.
    pub fn local_address(&self) -> Option<SocketAddr> {
        self.local
    }

    /// The parser's counters.
    pub fn counters(&self) -> Counters {
        *self.shared.counters.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The traffic received since the link was opened.
    pub fn received(&self) -> Received {
        Received::new(self.shared.systems().clone(), self.counters())
    }

    /// Number of packets and connections of senders other than the peer, which were dropped.
    pub fn unknown_senders(&self) -> u64 {
        self.shared.unknown_senders.load(Ordering::Relaxed)
    }

    /// True when packets with a signature arrived and there is no key here: the other side may refuse packets from here.
    pub fn lacks_key(&self) -> bool {
        self.shared.peer_signs.load(Ordering::Relaxed)
    }

    /// Numbers of packets that were refused because of their signatures, by reason.
    pub fn refusals(&self) -> Refusals {
        *self.shared.refusals.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Number of setpoints that were not sent because a newer one came while they waited for a slow line.
    pub fn replaced(&self) -> u64 {
        self.shared.newest.replaced()
    }

    /// Number of received packets that were dropped because they were not read in time.
    pub fn dropped(&self) -> u64 {
        self.shared.dropped.load(Ordering::Relaxed)
    }
}

impl Drop for Link {
    fn drop(&mut self) {
        self.task.abort();
    }
}

impl LinkSender {
    /// Sends a packet without waiting. It is refused without a connection or when the line is too slow;
    /// packets that wait when a connection breaks are not sent on the next one.
    pub fn send(&self, packet: &[u8]) -> Result<(), SendError> {
        self.put(&self.queue, packet)
    }

    /// Sends a packet when no other one waits and a serial line has little left to send, so that heavy traffic (a ground
    /// station that sends corrections or files over a slow line) hardly delays the setpoints. Few such packets wait.
    pub fn send_spare(&self, packet: &[u8]) -> Result<(), SendError> {
        self.check_connected()?;
        if self.spare.capacity() <= COMMANDS {
            return Err(SendError::Full);
        }
        self.put(&self.spare, packet)
    }

    /// The same for a command, in its order behind the packets that wait: there is room for it where other packets are refused.
    pub fn send_command(&self, packet: &[u8]) -> Result<(), SendError> {
        self.put(&self.spare, packet)
    }

    /// Sends a packet that makes those like it before it useless: a setpoint. It waits until a serial line has little left to send, and
    /// replaces one that still waits: a line that is too slow for all of them carries new ones instead of old ones.
    ///
    /// # Errors
    /// When there is no connection.
    pub fn send_newest(&self, packet: &[u8]) -> Result<(), SendError> {
        self.check_connected()?;
        self.shared.newest.put(packet.to_vec());
        Ok(())
    }

    fn check_connected(&self) -> Result<(), SendError> {
        // The link's task, which has the other end of the queue, may have ended.
        let is_connected = self.shared.connected.load(Ordering::Acquire);
        if is_connected && !self.queue.is_closed() { Ok(()) } else { Err(SendError::NotConnected) }
    }

    fn put(&self, queue: &mpsc::Sender<Vec<u8>>, packet: &[u8]) -> Result<(), SendError> {
        self.check_connected()?;
        queue.try_send(packet.to_vec()).map_err(|refused| match refused {
            mpsc::error::TrySendError::Full(_) => SendError::Full,
            mpsc::error::TrySendError::Closed(_) => SendError::NotConnected,
        })
    }
}

#[derive(Debug)]
struct Shared {
    events: Mutex<VecDeque<LinkEvent>>,
    arrived: Notify,
    /// The setpoint that waits to be sent.
    newest: Newest,
    connected: AtomicBool,
    dropped: AtomicU64,
    unknown_senders: AtomicU64,
    counters: Mutex<Counters>,
    /// Systems whose autopilots sent a heartbeat.
    systems: Mutex<BTreeSet<u8>>,
    refusals: Mutex<Refusals>,
    peer_signs: AtomicBool,
    opened: Instant,
    /// When bytes came last, in milliseconds since the link was opened.
    active_ms: AtomicU64,
}

impl Shared {
    fn new() -> Self {
        Self {
            events: Mutex::new(VecDeque::with_capacity(INCOMING)),
            arrived: Notify::new(),
            newest: Newest::default(),
            connected: AtomicBool::new(false),
            dropped: AtomicU64::new(0),
            unknown_senders: AtomicU64::new(0),
            counters: Mutex::new(Counters::default()),
            systems: Mutex::new(BTreeSet::new()),
            refusals: Mutex::new(Refusals::default()),
            peer_signs: AtomicBool::new(false),
            opened: Instant::now(),
            active_ms: AtomicU64::new(0),
        }
    }

    fn events(&self) -> MutexGuard<'_, VecDeque<LinkEvent>> {
        self.events.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn systems(&self) -> MutexGuard<'_, BTreeSet<u8>> {
        self.systems.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn push(&self, event: LinkEvent) {
        let mut events = self.events();
        if events.len() >= INCOMING {
            // The oldest packet is dropped; events of the connection stay, unless there are no packets.
            let oldest = events.iter().position(|event| matches!(event, LinkEvent::Packet { .. }));
            events.remove(oldest.unwrap_or(0));
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
        events.push_back(event);
        drop(events);
        self.arrived.notify_one();
    }

    /// Counts dropped packets and connections of unknown senders; true for the first, which is the one to log.
    fn count_unknown_senders(&self, count: u64) -> bool {
        self.unknown_senders.fetch_add(count, Ordering::Relaxed) == 0
    }

    fn mark_active(&self) {
        let now = self.opened.elapsed().as_millis().try_into().unwrap_or(u64::MAX);
        self.active_ms.store(now, Ordering::Relaxed);
    }

    fn silence(&self) -> Duration {
        let active = Duration::from_millis(self.active_ms.load(Ordering::Relaxed));
        self.opened.elapsed().saturating_sub(active)
    }
}

/// The task's side of a link.
struct Port {
    shared: Arc<Shared>,
    outgoing: mpsc::Receiver<Vec<u8>>,
    /// Packets of low priority.
    outgoing_spare: mpsc::Receiver<Vec<u8>>,
    peering: Peering,
    /// The system id of the first autopilot at a UDP port.
    first_autopilot: Option<u8>,
    gate: Gate,
    keeping: Option<Keeping>,
}

/// Where a gate's stamps come from, and go to.
struct Keeping {
    clock: fn() -> SystemTime,
    file: Option<StampFile>,
}

/// The gate for a key.
fn keyed(config: SigningConfig) -> (Gate, Option<Keeping>) {
    let file = config.stamp_file.map(StampFile::read);
    let used = file.as_ref().map_or(0, |file| file.reserved);
    let signing = Signing::new(config.key, config.link_id, used);
    (Gate::new(Some(signing)), Some(Keeping { clock: config.clock, file }))
}

impl Port {
    fn connected(&mut self, peer: String) {
        while self.outgoing.try_recv().is_ok() {}
        while self.outgoing_spare.try_recv().is_ok() {}
        self.shared.newest.forget();
        self.shared.mark_active();
        tracing::info!(%peer, "Link connected");
        self.shared.connected.store(true, Ordering::Release);
        self.shared.push(LinkEvent::Connected { peer });
    }

    /// The next packet to send, a setpoint or one of low priority only when the line has room; may be cancelled without losing one.
    async fn next(&mut self, has_room: bool) -> Option<Vec<u8>> {
        tokio::select! {
            biased;
            packet = self.outgoing.recv() => packet,
            packet = self.shared.newest.take(), if has_room => Some(packet),
            packet = self.outgoing_spare.recv(), if has_room => packet,
        }
    }

    fn disconnected(&mut self, reason: String) {
        self.shared.connected.store(false, Ordering::Release);
        self.shared.push(LinkEvent::Disconnected { reason });
    }

    fn received(&mut self, packets: Vec<Packet>, counted: Counters) {
        self.shared.counters.lock().unwrap_or_else(PoisonError::into_inner).add(counted);
        self.keep_stamps();
        self.count_refusals();
        self.note_signatures(&packets);
        note_systems(&mut self.shared.systems(), &packets);
        let received = Instant::now();
        for packet in packets {
            self.shared.push(LinkEvent::Packet { packet: Box::new(packet), received });
        }
    }
}

impl Port {
    /// The clock's stamp for signed packets.
    fn stamp(&self) -> u64 {
        let now = self.keeping.as_ref().map(|keeping| (keeping.clock)());
        stamp(now.and_then(|it| it.duration_since(SystemTime::UNIX_EPOCH).ok()).unwrap_or_default())
    }

    /// The packets that are let in.
    fn admit(&mut self, packets: Vec<Packet>) -> Admitted {
        self.gate.admit(self.stamp(), packets)
    }

    /// A packet as it is sent.
    fn seal(&mut self, raw: Vec<u8>) -> Option<Vec<u8>> {
        let sealed = self.gate.seal(self.stamp(), raw);
        self.keep_stamps();
        sealed
    }

    fn keep_stamps(&mut self) {
        let file = self.keeping.as_mut().and_then(|keeping| keeping.file.as_mut());
        if let (Some(file), Some(newest)) = (file, self.gate.newest()) {
            file.keep(newest);
        }
    }

    /// Warns once of a peer whose packets are signed while there is no key here.
    fn note_signatures(&self, packets: &[Packet]) {
        if self.gate.is_open()
            && packets.iter().any(Packet::is_signed)
            && !self.shared.peer_signs.swap(true, Ordering::Relaxed)
        {
            tracing::warn!(
                advice = "give this side the same key (`signing_key`)",
                "The other side signs its packets and this one has no key: packets sent from here may be refused there"
            );
        }
    }

    /// Hands the numbers of refused packets on, and logs the first of each reason.
    fn count_refusals(&self) {
        if self.gate.is_open() {
            return;
        }
        let refusals = self.gate.refusals();
        let mut before = self.shared.refusals.lock().unwrap_or_else(PoisonError::into_inner);
        for (reason, _) in refusals.since(*before).filter(|(reason, _)| before.of(*reason) == 0) {
            let advice = reason.advice();
            tracing::warn!(%reason, advice, "Packet refused (further ones are only counted)");
        }
        *before = refusals;
    }
}

/// A socket that is bound first, so that a port in use is an error at once.
enum Listener {
    None,
    Udp(UdpSocket),
    Tcp(TcpListener),
}

async fn listen(address: &Address) -> Result<Listener, LinkError> {
    let (bound, Endpoint { host, port }) = match address {
        Address::UdpIn(at) => (listen_udp(at).await.map(Listener::Udp), at),
        Address::TcpIn(at) => (listen_tcp(at).await.map(Listener::Tcp), at),
        Address::UdpOut(_) | Address::Tcp(_) | Address::Serial { .. } => return Ok(Listener::None),
    };
    bound.map_err(|source| {
        let address = address.clone();
        match source.kind() {
            io::ErrorKind::AddrInUse => LinkError::PortInUse { address, port: *port },
            io::ErrorKind::AddrNotAvailable => LinkError::NotLocal { address, host: host.clone() },
            _ => LinkError::Listen { address, source },
        }
    })
}

/// Serves one connection after the other, with a pause that grows while connections fail.
async fn run(address: Address, mut listener: Listener, mut port: Port) {
    let mut pause = FIRST_RETRY;
    let mut last_reason = String::new();
    loop {
        let began = Instant::now();
        let (worked, reason) = serve(&address, &mut listener, &mut port).await;
        let reason = format!("{address}: {reason}");
        if worked || reason != last_reason {
            tracing::warn!(%reason, "Link lost, reconnecting");
            port.disconnected(reason.clone());
            last_reason = reason;
        }
        if worked && began.elapsed() > LAST_RETRY {
            pause = FIRST_RETRY;
        }
        sleep(pause).await;
        pause = (pause * 2).min(LAST_RETRY);
    }
}

/// Serves one connection to its end; returns whether there was one, and why it ended.
async fn serve(address: &Address, listener: &mut Listener, port: &mut Port) -> (bool, String) {
    match address {
        Address::UdpIn(_) => {
            if let Listener::None = listener {
                match listen(address).await {
                    Ok(again) => *listener = again,
                    Err(error) => return (false, error.to_string()),
                }
            }
            let Listener::Udp(socket) = &*listener else { return (false, "no socket".into()) };
            let reason = serve_udp(socket, port, None).await;
            *listener = Listener::None;
            (true, reason)
        }
        Address::UdpOut(to) => match call_udp(to).await {
            Ok((socket, peer)) => (true, serve_udp(&socket, port, Some(peer)).await),
            Err(error) => (false, explain_socket(&error, port.peering.other_side())),
        },
        Address::Tcp(to) => match call_tcp(to).await {
            Ok(stream) => {
                port.connected(to.to_string());
                (true, serve_stream(stream, tcp(Some(TCP_SILENCE)), port).await)
            }
            Err(error) => (false, explain_socket(&error, port.peering.other_side())),
        },
        Address::TcpIn(_) => {
            let Listener::Tcp(listener) = &*listener else { return (false, "no socket".into()) };
            serve_tcp_in(listener, port).await
        }
        Address::Serial { device, baud } => match open_serial(device, *baud) {
            Ok(stream) => {
                port.connected(address.to_string());
                (true, serve_stream(stream, serial(*baud), port).await)
            }
            Err(error) => (false, explain_serial(device, &error)),
        },
    }
}

/// One connection at a time; a new one replaces one that has been silent.
async fn serve_tcp_in(listener: &TcpListener, port: &mut Port) -> (bool, String) {
    let (shared, peering) = (Arc::clone(&port.shared), port.peering.clone());
    let mut next = loop {
        match listener.accept().await {
            Ok(next) if peering.admits(next.1.ip()) => break next,
            Ok((_, peer)) => refuse(&shared, peer, "it is not one of the known ground stations"),
            Err(error) => return (false, format!("cannot accept a connection: {error}")),
        }
    };
    loop {
        let (stream, peer) = next;
        // A connection without this works too, only later.
        let _ = stream.set_nodelay(true);
        port.connected(peer.to_string());
        tokio::select! {
            reason = serve_stream(stream, tcp(None), port) => return (true, reason),
            newcomer = accept_when_silent(listener, &shared, &peering) => next = newcomer,
        }
    }
}

async fn accept_when_silent(
    listener: &TcpListener,
    shared: &Shared,
    peering: &Peering,
) -> (TcpStream, SocketAddr) {
    loop {
        match listener.accept().await {
            Ok((_, peer)) if !peering.admits(peer.ip()) => {
                refuse(shared, peer, "it is not one of the known ground stations");
            }
            Ok(newcomer) if shared.silence() > peering.silence() => return newcomer,
            Ok((_, peer)) => refuse(shared, peer, "another one is in use"),
            Err(error) => {
                tracing::warn!(%error, "Cannot accept a connection");
                sleep(LAST_RETRY).await;
            }
        }
    }
}

/// Counts a refused connection, and logs the first.
fn refuse(shared: &Shared, peer: SocketAddr, reason: &str) {
    if shared.count_unknown_senders(1) {
        tracing::warn!(%peer, reason, "Connection refused (further ones are only counted)");
    }
}

/// How a stream is served.
struct Manner<B> {
    /// The time that the line needs for its unsent bytes.
    backlog: B,
    /// Silence after which an incomplete packet is noise.
    gap: Duration,
    /// Silence after which the connection counts as dead.
    silence: Option<Duration>,
}

fn serial(baud: u32) -> Manner<impl Fn(&SerialStream) -> Duration> {
    let backlog = move |line: &SerialStream| {
        let bytes = line.bytes_to_write().unwrap_or(0);
        // A byte takes ten bits.
        Duration::from_secs(u64::from(bytes) * 10) / baud.max(1)
    };
    Manner { backlog, gap: PACKET_GAP, silence: None }
}

fn tcp(silence: Option<Duration>) -> Manner<impl Fn(&TcpStream) -> Duration> {
    Manner { backlog: |_: &TcpStream| Duration::ZERO, gap: TCP_GAP, silence }
}

/// The event on a line: bytes were read, or written.
enum Moved {
    Read(io::Result<usize>),
    Written(io::Result<usize>),
}

/// Writes the remaining bytes, or reads.
fn poll_line<L: AsyncRead + AsyncWrite + Unpin>(
    line: &mut L,
    context: &mut Context<'_>,
    bytes: &mut [u8],
    unsent: &[u8],
) -> Poll<Moved> {
    if !unsent.is_empty()
        && let Poll::Ready(written) = Pin::new(&mut *line).poll_write(context, unsent)
    {
        return Poll::Ready(Moved::Written(written));
    }
    let mut read = ReadBuf::new(bytes);
    let done = Pin::new(line).poll_read(context, &mut read);
    done.map(|done| Moved::Read(done.map(|()| read.filled().len())))
}

/// Moves bytes in both directions until the connection breaks; returns why.
async fn serve_stream<L>(
    mut line: L,
    manner: Manner<impl Fn(&L) -> Duration>,
    port: &mut Port,
) -> String
where
    L: AsyncRead + AsyncWrite + Unpin,
{
    let mut parser = Parser::new();
    let mut bytes = [0; 4096];
    let mut active = tokio::time::Instant::now();
    // The unsent bytes of the packet that is being written, and since when it is.
    let mut unsent = Vec::new();
    let mut writing = active;
    loop {
        let limit = manner.silence.unwrap_or(NO_LIMIT);
        let is_writing = !unsent.is_empty();
        let is_free = !is_writing && (manner.backlog)(&line) <= SPARE_BACKLOG;
        tokio::select! {
            moved = poll_fn(|context| poll_line(&mut line, context, &mut bytes, &unsent)) => match moved {
                Moved::Read(Ok(0)) => return "the other side closed the connection".into(),
                Moved::Read(Ok(count)) => {
                    active = tokio::time::Instant::now();
                    let packets = parser.push(bytes.get(..count).unwrap_or(&[]));
                    let admitted = port.admit(packets);
                    // A client without the key does not keep the connection from others.
                    if port.gate.is_open() || admitted.is_peer {
                        port.shared.mark_active();
                    }
                    port.received(admitted.packets, parser.take_counters());
                }
                Moved::Read(Err(error)) => return format!("reading failed: {error}"),
                Moved::Written(Ok(0)) => return "the other side takes no more bytes".into(),
                Moved::Written(Ok(count)) => drop(unsent.drain(..count.min(unsent.len()))),
                Moved::Written(Err(error)) => return format!("writing failed: {error}"),
            },
            packet = port.next(is_free), if !is_writing => {
                let Some(packet) = packet else { return "closed".into() };
                unsent = port.seal(packet).unwrap_or_default();
                writing = tokio::time::Instant::now();
            }
            () = sleep(BACKLOG_PAUSE), if !is_writing && !is_free => {}
            () = sleep_until(writing + WRITE_LIMIT), if is_writing => {
                return "the other side takes no more bytes".into();
            }
            () = sleep_until(active + manner.gap), if parser.is_waiting() => {
                let packets = port.admit(parser.finish()).packets;
                port.received(packets, parser.take_counters());
            }
            () = sleep_until(active + limit), if manner.silence.is_some() => {
                return format!("silent for {} s", limit.as_secs());
            }
        }
    }
}

/// Moves datagrams in both directions until the socket breaks; returns why. Without a `fixed` peer,
/// the peer is chosen by [`Peering`]: the sender of the autopilot's heartbeat, or the first ground station.
async fn serve_udp(socket: &UdpSocket, port: &mut Port, fixed: Option<SocketAddr>) -> String {
    let mut peers = Peers::new(fixed, port.peering.clone(), port.first_autopilot);
    if let Some(peer) = fixed {
        port.connected(peer.to_string());
    }
    let mut bytes = vec![0; 65_536];
    let mut unsent: Option<Unsent> = None;
    loop {
        tokio::select! {
            read = socket.recv_from(&mut bytes) => match read {
                Ok((count, from)) => {
                    let before = peers.chosen;
                    let datagram = bytes.get(..count).unwrap_or(&[]);
                    let stamp = port.stamp();
                    let taken = peers.take(from, datagram, Instant::now(), &mut port.gate, stamp);
                    port.first_autopilot = peers.first;
                    if let Some(peer) = peers.chosen.filter(|_| peers.chosen != before) {
                        port.connected(peer.to_string());
                    }
                    if taken.unknown_senders > 0 && port.shared.count_unknown_senders(taken.unknown_senders) {
                        tracing::warn!(%from, "Packets of an unknown sender dropped (further ones are only counted)");
                    }
                    port.received(taken.packets, taken.counted);
                    if let Some(packet) = taken.other_autopilot.map(Box::new) {
                        let received = Instant::now();
                        port.shared.push(LinkEvent::OtherAutopilot { packet, received });
                    }
                }
                // A datagram of ours had no receiver: the other side is not running.
                Err(error) if is_refusal(&error) => {}
                Err(error) => return format!("receiving failed: {error}"),
            },
            packet = port.next(true) => {
                let Some(packet) = packet else { return "closed".into() };
                let Some(packet) = port.seal(packet) else { continue };
                let sent = match (fixed, peers.chosen) {
                    (Some(_), _) => socket.send(&packet).await,
                    (None, Some(peer)) => socket.send_to(&packet, peer).await,
                    (None, None) => continue,
                };
                match sent {
                    // A network may be away for a moment; the packet counts as lost.
                    Err(error) if !is_refusal(&error) => {
                        tracing::debug!(%error, "datagram not sent");
                        let failing = Unsent::after(unsent);
                        let is_long = failing.first.elapsed() > SEND_LIMIT;
                        unsent = Some(failing).filter(|_| !is_long);
                        if is_long && let Some(peer) = fixed && has_moved(socket, peer).await {
                            return format!("this machine's address has changed: {error}");
                        }
                    }
                    _ => unsent = None,
                }
            }
        }
    }
}

/// Whether a new connection would have another address of this machine: one keeps that with which it was made.
async fn has_moved(socket: &UdpSocket, peer: SocketAddr) -> bool {
    let of = |socket: &UdpSocket| socket.local_addr().map(|address| address.ip());
    let Ok(new) = connect_udp(peer).await else { return false };
    matches!((of(socket), of(&new)), (Ok(old), Ok(new)) if old != new)
}

/// Datagrams that could not be sent, one soon after the other.
#[derive(Copy, Clone)]
struct Unsent {
    first: Instant,
    last: Instant,
}

impl Unsent {
    /// One more now.
    fn after(before: Option<Self>) -> Self {
        let last = Instant::now();
        let first = before.filter(|it| it.last.elapsed() < SEND_LIMIT).map_or(last, |it| it.first);
        Self { first, last }
    }
}

fn is_refusal(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::ConnectionRefused | io::ErrorKind::ConnectionReset)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tokio::io::{AsyncReadExt, AsyncWriteExt};

    /// A line that has more to send than is allowed while it is slow.
    fn slow_line<L>(is_slow: &AtomicBool) -> Manner<impl Fn(&L) -> Duration> {
        let backlog = |_: &L| match is_slow.load(Ordering::Relaxed) {
            true => SPARE_BACKLOG * 2,
            false => SPARE_BACKLOG,
        };
        Manner { backlog, gap: PACKET_GAP, silence: None }
    }

    /// A link's two sides, connected.
    fn pair() -> (LinkSender, Port) {
        let (queue, outgoing) = mpsc::channel(OUTGOING);
        let (spare, outgoing_spare) = mpsc::channel(SPARE + COMMANDS);
        let shared = Arc::new(Shared::new());
        let sender = LinkSender { shared: Arc::clone(&shared), queue, spare };
        let (peering, gate) = (Peering::default(), Gate::new(None));
        let (first_autopilot, keeping) = (None, None);
        let port =
            Port { shared, outgoing, outgoing_spare, peering, first_autopilot, gate, keeping };
        (sender, port)
    }

    #[tokio::test]
    async fn packets_of_low_priority_never_fill_the_queue() {
        let (sender, mut port) = pair();
        assert_eq!(sender.send_spare(b"packet"), Err(SendError::NotConnected));
        port.connected("peer".into());
        let sent = (0..100).take_while(|_| sender.send_spare(b"packet").is_ok()).count();
        assert_eq!(sent, SPARE);
        assert_eq!(sender.send_spare(b"packet"), Err(SendError::Full));
        assert_eq!(sender.send(b"setpoint"), Ok(()), "the setpoint is still sent");
        assert_eq!(port.next(true).await.unwrap(), b"setpoint", "and is sent first");
        assert_eq!(port.next(true).await.unwrap(), b"packet");
        assert_eq!(sender.send_spare(b"packet"), Ok(()));
    }

    #[tokio::test]
    async fn a_command_of_a_ground_station_has_room_behind_its_bulk_traffic() {
        let (sender, mut port) = pair();
        assert_eq!(sender.send_command(b"command"), Err(SendError::NotConnected));
        port.connected("peer".into());
        assert_eq!((0..100).take_while(|_| sender.send_spare(b"bulk").is_ok()).count(), SPARE);
        let sent = (0..100).take_while(|_| sender.send_command(b"command").is_ok()).count();
        assert_eq!(sent, COMMANDS);
        assert_eq!(sender.send_command(b"command"), Err(SendError::Full));
        for number in 0..SPARE + COMMANDS {
            let expected: &[u8] = if number < SPARE { b"bulk" } else { b"command" };
            assert_eq!(port.next(true).await.unwrap(), expected, "in order");
        }
        assert_eq!(sender.send_spare(b"bulk"), Ok(()));
    }

    #[tokio::test]
    async fn packets_of_low_priority_wait_until_a_slow_line_has_sent_the_others() {
        let is_slow = AtomicBool::new(true);
        let manner = slow_line(&is_slow);
        let (sender, mut port) = pair();
        port.connected("peer".into());
        let (line, mut other_end) = tokio::io::duplex(4096);
        let sending = async {
            sender.send_spare(b"packet").unwrap();
            let mut bytes = [0; 100];
            for _ in 0..3 {
                sender.send(b"setpoint").unwrap();
                let count = other_end.read(&mut bytes).await.unwrap();
                assert_eq!(&bytes[..count], b"setpoint");
                sleep(BACKLOG_PAUSE).await;
            }
            is_slow.store(false, Ordering::Relaxed);
            let count = other_end.read(&mut bytes).await.unwrap();
            assert_eq!(&bytes[..count], b"packet");
        };
        tokio::select! {
            () = sending => {}
            reason = serve_stream(line, manner, &mut port) => panic!("{reason}"),
        }
    }

    #[tokio::test]
    async fn of_setpoints_that_wait_for_a_slow_line_only_the_newest_is_sent() {
        let is_slow = AtomicBool::new(true);
        let manner = slow_line(&is_slow);
        let (sender, mut port) = pair();
        assert_eq!(sender.send_newest(b"setpoint"), Err(SendError::NotConnected));
        port.connected("peer".into());
        let (line, mut other_end) = tokio::io::duplex(4096);
        let sending = async {
            sender.send_spare(b"packet").unwrap();
            let mut bytes = [0; 100];
            for i in 0..100 {
                sender.send_newest(format!("setpoint {i}").as_bytes()).unwrap();
            }
            sender.send(b"command").unwrap();
            let count = other_end.read(&mut bytes).await.unwrap();
            assert_eq!(&bytes[..count], b"command", "it does not wait for setpoints");
            sleep(BACKLOG_PAUSE * 2).await;
            is_slow.store(false, Ordering::Relaxed);
            let mut sent = String::new();
            while !sent.ends_with("packet") {
                let count = other_end.read(&mut bytes).await.unwrap();
                sent.push_str(std::str::from_utf8(&bytes[..count]).unwrap());
            }
            assert_eq!(sent, "setpoint 99packet");
            assert_eq!(sender.shared.newest.replaced(), 99);
        };
        tokio::select! {
            () = sending => {}
            reason = serve_stream(line, manner, &mut port) => panic!("{reason}"),
        }
    }

    #[tokio::test]
    async fn bytes_are_read_while_none_can_be_written() {
        let (sender, mut port) = pair();
        port.connected("peer".into());
        let (line, mut other_end) = tokio::io::duplex(4);
        let manner = Manner { backlog: |_: &_| Duration::ZERO, gap: PACKET_GAP, silence: None };
        sender.send(b"more than the line takes").unwrap();
        let receiving = async {
            sleep(Duration::from_millis(20)).await;
            other_end.write_all(b"noise").await.unwrap();
            while sender.shared.counters.lock().unwrap().bad_bytes < 5 {
                sleep(Duration::from_millis(5)).await;
            }
        };
        tokio::select! {
            () = receiving => {}
            reason = serve_stream(line, manner, &mut port) => panic!("{reason}"),
        }
    }
}
