//! Tests links over UDP and TCP on the loopback and a serial pseudo-terminal: which sender is answered, packets cut in
//! two, reconnection, signatures, and errors at once.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "helpers of tests may fail like tests")]

use std::net::SocketAddr;
use std::time::{Duration, Instant, SystemTime};

use autopilot::dialect::{
    HEARTBEAT_DATA, MavAutopilot, MavCmd, MavMessage, MavType, RADIO_STATUS_DATA, SYSTEM_TIME_DATA,
};
use autopilot::link::SendError;
use autopilot::packet::{self, Sender};
use autopilot::signing::{Refusal, Refusals, stamp};
use autopilot::{
    Address, Autopilot, Config, Event, Firmware, Link, LinkEvent, Parser, Peering, SigningConfig,
};
use testing::until;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, UdpSocket};
use tokio::time::{sleep, timeout};

const TIMEOUT: Duration = Duration::from_secs(30);
const AUTOPILOT: Sender = Sender { system: 1, component: 1 };

fn heartbeat(autopilot: bool) -> Vec<u8> {
    let message = HEARTBEAT_DATA {
        mavtype: if autopilot { MavType::MAV_TYPE_QUADROTOR } else { MavType::MAV_TYPE_GCS },
        autopilot: if autopilot {
            MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA
        } else {
            MavAutopilot::MAV_AUTOPILOT_INVALID
        },
        ..Default::default()
    };
    let sender = if autopilot { AUTOPILOT } else { Sender { system: 255, component: 190 } };
    packet::encode(sender, 0, &MavMessage::HEARTBEAT(message))
}

fn time() -> Vec<u8> {
    let message = SYSTEM_TIME_DATA { time_unix_usec: 7, time_boot_ms: 9 };
    packet::encode(AUTOPILOT, 1, &MavMessage::SYSTEM_TIME(message))
}

async fn open(address: String) -> Link {
    Link::open(address.parse().unwrap()).await.unwrap()
}

async fn next(link: &mut Link) -> LinkEvent {
    timeout(TIMEOUT, link.recv()).await.expect("an event of the link")
}

async fn packet(link: &mut Link) -> Vec<u8> {
    loop {
        if let LinkEvent::Packet { packet, .. } = next(link).await {
            return packet.raw;
        }
    }
}

async fn peer(link: &mut Link) -> String {
    loop {
        if let LinkEvent::Connected { peer } = next(link).await {
            return peer;
        }
    }
}

async fn lost(link: &mut Link) -> String {
    loop {
        if let LinkEvent::Disconnected { reason } = next(link).await {
            return reason;
        }
    }
}

async fn datagram(socket: &UdpSocket) -> (Vec<u8>, SocketAddr) {
    let mut bytes = [0; 2048];
    let (count, from) = timeout(TIMEOUT, socket.recv_from(&mut bytes)).await.unwrap().unwrap();
    (bytes[..count].to_vec(), from)
}

#[tokio::test]
async fn udpin_replies_to_the_sender_of_the_autopilots_heartbeat() {
    let mut link = open("udpin:127.0.0.1:0".into()).await;
    let at = link.local_address().unwrap();
    assert_eq!(link.send(&time()), Err(SendError::NotConnected));

    let station = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    station.send_to(&heartbeat(false), at).await.unwrap();
    assert_eq!(peer(&mut link).await, station.local_addr().unwrap().to_string());

    let autopilot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    autopilot.send_to(&heartbeat(true), at).await.unwrap();
    assert_eq!(peer(&mut link).await, autopilot.local_addr().unwrap().to_string());
    assert_eq!(packet(&mut link).await, heartbeat(true));

    // The ground station's packets are ignored, and it gets none.
    station.send_to(&heartbeat(false), at).await.unwrap();
    autopilot.send_to(&time(), at).await.unwrap();
    assert_eq!(packet(&mut link).await, time());
    link.send(&heartbeat(false)).unwrap();
    assert_eq!(datagram(&autopilot).await.0, heartbeat(false));
}

#[tokio::test]
async fn a_client_over_a_link_finds_the_autopilot_and_requests_its_messages() {
    let mut link = open("udpin:127.0.0.1:0".into()).await;
    let before = Instant::now();
    let autopilot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    autopilot.send_to(&heartbeat(true), link.local_address().unwrap()).await.unwrap();
    let mut client = Autopilot::new(Config::default());
    while client.system().is_none() {
        if let LinkEvent::Packet { packet, received } = next(&mut link).await {
            assert!((before..=Instant::now()).contains(&received));
            client.handle(0, &packet);
        }
    }
    let found = Event::Found { system: 1, firmware: Firmware::Copter };
    assert_eq!(client.poll_event(), Some(found));
    client.tick(1);
    while let Some(packet) = client.poll_outgoing() {
        link.send(&packet).unwrap();
    }
    let is_request = |message: MavMessage| {
        matches!(message, MavMessage::COMMAND_LONG(command)
            if command.command == MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL)
    };
    while !Parser::new()
        .push(&datagram(&autopilot).await.0)
        .into_iter()
        .any(|packet| packet.message.is_some_and(is_request))
    {}
}

#[tokio::test]
async fn a_packet_cut_over_datagrams_survives_another_sender_in_between() {
    let mut link = open("udpin:127.0.0.1:0".into()).await;
    let at = link.local_address().unwrap();
    let autopilot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let other = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    autopilot.send_to(&heartbeat(true), at).await.unwrap();
    assert_eq!(packet(&mut link).await, heartbeat(true));
    let time = time();
    autopilot.send_to(&time[..9], at).await.unwrap();
    other.send_to(&heartbeat(false), at).await.unwrap();
    autopilot.send_to(&time[9..], at).await.unwrap();
    assert_eq!(packet(&mut link).await, time);
}

#[tokio::test]
async fn another_vehicle_at_the_port_is_reported_and_does_not_replace_the_autopilot() {
    let mut link = open("udpin:127.0.0.1:0".into()).await;
    let at = link.local_address().unwrap();
    let ours = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let other = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    ours.send_to(&heartbeat(true), at).await.unwrap();
    assert_eq!(packet(&mut link).await, heartbeat(true));
    // Ours is silent for longer than a link waits for it.
    sleep(Duration::from_millis(3100)).await;
    let theirs = packet::encode(
        Sender { system: 2, component: 1 },
        0,
        &MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
            ..Default::default()
        }),
    );
    other.send_to(&theirs, at).await.unwrap();
    let LinkEvent::OtherAutopilot { packet: reported, .. } = next(&mut link).await else {
        panic!("it is not reported");
    };
    assert_eq!(reported.raw, theirs);
    ours.send_to(&time(), at).await.unwrap();
    assert_eq!(packet(&mut link).await, time());
    link.send(&heartbeat(false)).unwrap();
    assert_eq!(datagram(&ours).await.0, heartbeat(false));
}

#[tokio::test]
async fn a_port_in_use_is_an_error_at_once_with_the_remedy() {
    let holder = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let port = holder.local_addr().unwrap().port();
    let address: Address = format!("udpin:127.0.0.1:{port}").parse().unwrap();
    let error = Link::open(address).await.unwrap_err().to_string();
    assert!(error.contains(&format!("udpin:127.0.0.1:{port}")), "{error}");
    assert!(error.contains("already in use") && error.contains("stop that program"), "{error}");

    let holder = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let port = holder.local_addr().unwrap().port();
    let address: Address = format!("tcpin:127.0.0.1:{port}").parse().unwrap();
    let error = Link::open(address).await.unwrap_err().to_string();
    assert!(error.contains("already in use"), "{error}");
}

#[tokio::test]
async fn listening_on_the_address_of_another_machine_is_explained() {
    let address: Address = "udpin:192.0.2.1:14550".parse().unwrap();
    let error = Link::open(address).await.unwrap_err().to_string();
    assert!(error.contains("no network address `192.0.2.1`"), "{error}");
}

#[tokio::test]
async fn udpout_sends_first_and_outlasts_an_absent_peer() {
    let reserved = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let at = reserved.local_addr().unwrap();
    drop(reserved);
    let mut link = open(format!("udpout:{at}")).await;
    assert_eq!(peer(&mut link).await, at.to_string());
    link.send(&heartbeat(false)).unwrap();

    let autopilot = UdpSocket::bind(at).await.unwrap();
    let from = loop {
        link.send(&heartbeat(false)).unwrap();
        let mut bytes = [0; 512];
        let read = timeout(Duration::from_millis(50), autopilot.recv_from(&mut bytes)).await;
        if let Ok(Ok((_, from))) = read {
            break from;
        }
    };
    autopilot.send_to(&time(), from).await.unwrap();
    assert_eq!(packet(&mut link).await, time());
}

/// Set where the test below runs in a separate network.
const OWN_NETWORK: &str = "ALIGHT_TEST_OWN_NETWORK";

#[cfg(target_os = "linux")]
#[test]
fn udpout_continues_with_a_new_address_of_this_machine() {
    use std::process::Command;
    let shell = |script: &str| Command::new("sh").args(["-ec", script]).output().unwrap();
    if std::env::var_os(OWN_NETWORK).is_some() {
        let sending = async {
            let mut link = open("udpout:10.77.0.1:14550".into()).await;
            peer(&mut link).await;
            assert!(shell("ip address delete 10.77.0.2/24 dev air").status.success());
            assert!(shell("ip address add 10.77.0.3/24 dev air").status.success());
            let reason = loop {
                link.send(&heartbeat(false)).unwrap();
                sleep(Duration::from_millis(50)).await;
                if let Some(LinkEvent::Disconnected { reason }) = link.try_recv() {
                    break reason;
                }
            };
            assert!(reason.contains("this machine's address has changed"), "{reason}");
            peer(&mut link).await;
        };
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async { timeout(TIMEOUT, sending).await }).unwrap();
        return;
    }
    const NETWORK: &str = "ip link set lo up
        ip link add air type veth peer name far
        ip link set air up
        ip link set far up
        ip address add 10.77.0.2/24 dev air";
    let tried = shell(&format!("unshare -rn sh -ec '{NETWORK}'"));
    if !tried.status.success() {
        testing::skip("namespaces", String::from_utf8_lossy(&tried.stderr).trim());
        return;
    }
    let test = "udpout_continues_with_a_new_address_of_this_machine";
    let run = Command::new("unshare")
        .args(["-rn", "sh", "-ec", &format!("{NETWORK}\nexec \"$@\"",), "sh"])
        .arg(std::env::current_exe().unwrap())
        .args(["--exact", test, "--nocapture"])
        .env(OWN_NETWORK, "1")
        .output()
        .unwrap();
    let output = String::from_utf8_lossy(&run.stdout) + String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success() && output.contains("1 passed"), "{output}");
}

#[tokio::test]
async fn tcp_connects_again_and_sends_no_old_packet() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let at = listener.local_addr().unwrap();
    let mut link = open(format!("tcp:{at}")).await;
    let (mut server, _) = listener.accept().await.unwrap();
    peer(&mut link).await;
    server.write_all(&heartbeat(true)).await.unwrap();
    assert_eq!(packet(&mut link).await, heartbeat(true));

    drop(server);
    drop(listener);
    let reason = lost(&mut link).await;
    assert!(reason.contains(&at.to_string()), "{reason}");
    assert_eq!(link.send(&time()), Err(SendError::NotConnected));
    let reason = lost(&mut link).await;
    assert!(reason.contains("connection refused; is the autopilot"), "{reason}");

    let listener = TcpListener::bind(at).await.unwrap();
    let (mut server, _) = timeout(TIMEOUT, listener.accept()).await.unwrap().unwrap();
    peer(&mut link).await;
    link.send(&heartbeat(false)).unwrap();
    let mut bytes = vec![0; heartbeat(false).len()];
    timeout(TIMEOUT, server.read_exact(&mut bytes)).await.unwrap().unwrap();
    assert_eq!(bytes, heartbeat(false));
}

#[tokio::test]
async fn a_packet_that_comes_in_two_parts_over_tcp_is_complete() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let mut link = open(format!("tcp:{}", listener.local_addr().unwrap())).await;
    let (mut server, _) = listener.accept().await.unwrap();
    let heartbeat = heartbeat(true);
    server.write_all(&heartbeat[..9]).await.unwrap();
    // Longer than the pause after which an incomplete packet on a serial line is noise.
    sleep(Duration::from_millis(300)).await;
    server.write_all(&heartbeat[9..]).await.unwrap();
    assert_eq!(packet(&mut link).await, heartbeat);
}

#[tokio::test]
async fn tcpin_takes_one_client_after_the_other() {
    let mut link = open("tcpin:127.0.0.1:0".into()).await;
    let at = link.local_address().unwrap();
    for _ in 0..2 {
        let mut client =
            timeout(TIMEOUT, tokio::net::TcpStream::connect(at)).await.unwrap().unwrap();
        client.write_all(&heartbeat(true)).await.unwrap();
        peer(&mut link).await;
        assert_eq!(packet(&mut link).await, heartbeat(true));
        link.send(&time()).unwrap();
        let mut bytes = vec![0; time().len()];
        timeout(TIMEOUT, client.read_exact(&mut bytes)).await.unwrap().unwrap();
        assert_eq!(bytes, time());
        drop(client);
        lost(&mut link).await;
    }
}

#[tokio::test]
async fn an_absent_ground_station_is_named_as_one() {
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = format!("tcp:{}", listener.local_addr().unwrap());
    drop(listener);
    let silence = Duration::from_secs(10);
    let station = Peering::GroundStation { known: Vec::new(), silence };
    let mut link = Link::open_for(address.parse().unwrap(), station, None).await.unwrap();
    let reason = lost(&mut link).await;
    assert!(reason.contains("connection refused; is the ground station running?"), "{reason}");
}

#[tokio::test]
async fn a_missing_device_is_retried() {
    let mut link = open("serial:/dev/no-such-autopilot:57600".into()).await;
    let reason = lost(&mut link).await;
    assert!(reason.contains("no device /dev/no-such-autopilot"), "{reason}");
    assert_eq!(link.send(&time()), Err(SendError::NotConnected));
}

#[cfg(unix)]
#[tokio::test]
async fn a_serial_line_carries_packets_both_ways_and_its_end_is_noticed() {
    use tokio_serial::SerialPort;
    let (mut autopilot, end) = tokio_serial::SerialStream::pair().unwrap();
    let device = end.name().unwrap();
    let mut link = open(format!("serial:{device}:115200")).await;
    peer(&mut link).await;
    autopilot.write_all(b"Init ArduCopter\r\n").await.unwrap();
    autopilot.write_all(&heartbeat(true)).await.unwrap();
    assert_eq!(packet(&mut link).await, heartbeat(true));
    assert_eq!(link.counters().bad_bytes, 17);
    link.send(&time()).unwrap();
    let mut bytes = vec![0; time().len()];
    timeout(TIMEOUT, autopilot.read_exact(&mut bytes)).await.unwrap().unwrap();
    assert_eq!(bytes, time());
    drop((autopilot, end));
    let reason = lost(&mut link).await;
    assert!(reason.contains(&device), "{reason}");
}

#[tokio::test]
async fn a_missing_heartbeat_is_explained() {
    let peering = Peering::Autopilot { system: Some(7) };
    let address = "udpin:127.0.0.1:0".parse().unwrap();
    let mut link = Link::open_for(address, peering, None).await.unwrap();
    let at = link.local_address().unwrap();
    assert!(link.received().why_no_heartbeat(Some(7)).contains("no bytes received: check"));
    let autopilot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    autopilot.send_to(&heartbeat(true), at).await.unwrap();
    packet(&mut link).await;
    let text = link.received().why_no_heartbeat(Some(7));
    assert!(text.contains("no heartbeat of system 7 yet, but of 1"), "{text}");
}

#[cfg(unix)]
#[tokio::test]
async fn bytes_at_another_speed_are_reported_as_such() {
    use tokio_serial::SerialPort;
    let (mut autopilot, end) = tokio_serial::SerialStream::pair().unwrap();
    let device = end.name().unwrap();
    let mut link = open(format!("serial:{device}:115200")).await;
    peer(&mut link).await;
    autopilot.write_all(&[0x55; 400]).await.unwrap();
    let explained = timeout(TIMEOUT, async {
        loop {
            let text = link.received().why_no_heartbeat(None);
            if text.contains("no MAVLink packet") {
                return text;
            }
            sleep(Duration::from_millis(10)).await;
        }
    });
    let text = explained.await.expect("the bytes are reported");
    assert!(text.contains("speed (baud)"), "{text}");
}

#[tokio::test]
async fn a_reader_that_sleeps_gets_the_newest_packets() {
    let mut link = open("udpin:127.0.0.1:0".into()).await;
    let at = link.local_address().unwrap();
    let autopilot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    autopilot.send_to(&heartbeat(true), at).await.unwrap();
    peer(&mut link).await;
    let mut sent = 0_u32;
    while link.dropped() < 100 {
        for _ in 0..20 {
            sent += 1;
            let message = SYSTEM_TIME_DATA { time_unix_usec: 7, time_boot_ms: sent };
            let raw = packet::encode(AUTOPILOT, 0, &MavMessage::SYSTEM_TIME(message));
            autopilot.send_to(&raw, at).await.unwrap();
        }
        tokio::task::yield_now().await;
    }
    let mut newest = 0;
    while newest < sent {
        if let LinkEvent::Packet { packet, .. } = next(&mut link).await
            && let Some(MavMessage::SYSTEM_TIME(time)) = packet.message
        {
            newest = time.time_boot_ms;
        }
    }
}

/// A clock that was never set, as a companion's without a battery is after each start.
fn never_set() -> SystemTime {
    SystemTime::UNIX_EPOCH
}

fn signing(passphrase: &str, link_id: u8) -> SigningConfig {
    let key = passphrase.parse().unwrap();
    SigningConfig { key, link_id, stamp_file: None, clock: SystemTime::now }
}

async fn open_signed(address: String, signing: SigningConfig) -> Link {
    Link::open_for(address.parse().unwrap(), Peering::default(), Some(signing)).await.unwrap()
}

#[tokio::test]
async fn only_packets_of_key_holders_are_received_and_each_refusal_has_its_reason() {
    let mut vehicle = open_signed("udpin:127.0.0.1:0".into(), signing("correct horse", 191)).await;
    let at = vehicle.local_address().unwrap();
    let to = format!("udpout:{at}");
    // A sender without the key does not become the peer, whatever kind it states.
    let keyless = open(to.clone()).await;
    let other_key = open_signed(to.clone(), signing("another horse", 1)).await;
    keyless.send_when_connected(&heartbeat(true)).await;
    // A radio's own packets need no signature, and make no sender the peer either.
    let radio = MavMessage::RADIO_STATUS(RADIO_STATUS_DATA::default());
    keyless.send(&packet::encode(AUTOPILOT, 1, &radio)).unwrap();
    keyless.send(&heartbeat(true)).unwrap();
    other_key.send_when_connected(&heartbeat(true)).await;
    let are_refused = async || {
        let refusals = vehicle.refusals();
        refusals.of(Refusal::WrongKey) > 0 && refusals.of(Refusal::Unsigned) >= 2
    };
    until("both are refused", TIMEOUT, are_refused).await.unwrap();
    assert_eq!(vehicle.try_recv(), None);

    let mut holder = open_signed(to, signing("correct horse", 1)).await;
    holder.send_when_connected(&heartbeat(true)).await;
    // A received packet has no signature any more, so it can go over another leg.
    assert_eq!(packet(&mut vehicle).await, heartbeat(true));
    vehicle.send(&time()).unwrap();
    assert_eq!(packet(&mut holder).await, time());
    assert_eq!(holder.refusals(), Refusals::default());
    assert!(!vehicle.lacks_key() && !holder.lacks_key());
}

#[tokio::test]
async fn a_peer_that_signs_is_noticed_without_a_key() {
    let mut keyless = open("udpin:127.0.0.1:0".into()).await;
    let to = format!("udpout:{}", keyless.local_address().unwrap());
    let unsigned = open(to.clone()).await;
    unsigned.send_when_connected(&heartbeat(true)).await;
    assert_eq!(packet(&mut keyless).await, heartbeat(true));
    assert!(!keyless.lacks_key());
    drop(unsigned);
    let holder = open_signed(to, signing("correct horse", 1)).await;
    let is_noticed = async || {
        holder.send_when_connected(&heartbeat(true)).await;
        keyless.lacks_key()
    };
    until("the signature is noticed", TIMEOUT, is_noticed).await.unwrap();
}

/// `Link::send` as soon as there is a connection.
trait SendWhenConnected {
    async fn send_when_connected(&self, packet: &[u8]);
}

impl SendWhenConnected for Link {
    async fn send_when_connected(&self, packet: &[u8]) {
        let is_sent = async || self.send(packet).is_ok();
        until("there is a connection", TIMEOUT, is_sent).await.unwrap();
    }
}

#[tokio::test]
async fn after_five_starts_without_a_clock_it_is_still_believed() {
    let directory = tempfile::tempdir().unwrap();
    let stamp_file = directory.path().join("state/signing.stamp");
    let stored =
        || std::fs::read_to_string(&stamp_file).map_or(0, |text| text.trim().parse().unwrap());
    let mut vehicle = open_signed("tcpin:127.0.0.1:0".into(), signing("correct horse", 1)).await;
    let to = format!("tcp:{}", vehicle.local_address().unwrap());
    let mut refused = 0;
    for start in 0..5 {
        let companion = SigningConfig {
            stamp_file: Some(stamp_file.clone()),
            clock: never_set,
            ..signing("correct horse", 191)
        };
        let companion = open_signed(to.clone(), companion).await;
        companion.send_when_connected(&heartbeat(false)).await;
        let packet = async {
            loop {
                if let Some(LinkEvent::Packet { .. }) = vehicle.try_recv() {
                    return;
                }
                // Stamps of 2015 are refused until the companion has seen one of the other side.
                if start == 0 {
                    vehicle.send_when_connected(&heartbeat(true)).await;
                }
                // Again: the first is lost where the vehicle has not noticed yet that the earlier connection is gone.
                companion.send_when_connected(&heartbeat(false)).await;
                sleep(Duration::from_millis(5)).await;
            }
        };
        timeout(TIMEOUT, packet).await.unwrap_or_else(|_| panic!("start {start}"));
        let refusals = vehicle.refusals().of(Refusal::Old);
        if start == 0 {
            refused = refusals;
            let written = async {
                while stored() < stamp(SystemTime::UNIX_EPOCH.elapsed().unwrap()) {
                    // While the disk writes the first stamp, later ones are not written: only with a further packet.
                    vehicle.send_when_connected(&heartbeat(true)).await;
                    sleep(Duration::from_millis(5)).await;
                }
            };
            timeout(TIMEOUT, written).await.expect("the stamp is stored");
        }
        // From the second start on the first packet is believed already.
        assert_eq!(refusals, refused, "start {start}");
    }
}
