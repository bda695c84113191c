//! The bridge between topics of a vehicle made up here and ground stations on UDP sockets: packets both ways,
//! refusals, texts, camera, parameters, signing, silence.

use std::fs::Permissions;
use std::io::Write;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::sync::Arc;
use std::time::{Duration, Instant, SystemTime};

use anyhow::{Context, bail, ensure};
use autopilot::dialect::{
    COMMAND_ACK_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavBool, MavCmd, MavFrame,
    MavMessage, MavResult, MavState, MavType, Message, MessageData, PARAM_REQUEST_READ_DATA,
    PARAM_VALUE_DATA, calculate_crc,
};
use autopilot::packet::encode;
use autopilot::signing::{Signing, stamp};
use autopilot::{Packet, Parser, Sender};
use gcs_bridge::Config;
use messages::{
    ControllerStatus, Detections, GcsStatus, Health, MavlinkBytes, PacketSignature, Phase,
    RecorderStatus, SigningState, TargetEstimate, topic,
};
use node::{INSECURE, Identity, Layers, Node, Shutdown, Subscriber, ZenohSource, now_ns};
use testing::ports;
use tokio::net::{TcpStream, UdpSocket};
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tokio::time::{interval, sleep, timeout};

const TIMEOUT: Duration = Duration::from_secs(30);
const AUTOPILOT: Sender = Sender { system: 7, component: 1 };
const COMPANION: Sender = Sender { system: 7, component: 191 };
const CAMERA: Sender = Sender { system: 7, component: 100 };
const GROUND: Sender = Sender { system: 255, component: 190 };

#[tokio::test(flavor = "multi_thread")]
async fn the_ground_gets_the_companions_and_the_vehicles_packets() -> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let vehicle = FakeVehicle::start(port).await?;
    let bridge = start_bridge(port, &ground, &[]).await?;

    let companion = ground.expect(|f| f.sender == COMPANION && is_heartbeat(f)).await?;
    let Some(MavMessage::HEARTBEAT(heartbeat)) = companion.message else { bail!("no heartbeat") };
    assert_eq!(heartbeat.mavtype, MavType::MAV_TYPE_ONBOARD_CONTROLLER);
    assert_eq!(heartbeat.autopilot, MavAutopilot::MAV_AUTOPILOT_INVALID);

    let packet = ground.expect(|f| f.sender == AUTOPILOT && is_heartbeat(f)).await?;
    assert_eq!(packet.raw, autopilot_heartbeat());
    let packet = ground.expect(|f| f.message_id == UNKNOWN_ID).await?;
    assert_eq!(packet.raw, unknown_packet(AUTOPILOT));

    ground.expect_text("Alight: search: looking for the marker").await?;
    let why = "1.93 m beside the marker, which is more than the 0.35 m of the funnel";
    vehicle.status.send_replace(status(Phase::Approach, why));
    ground.expect_text(&format!("Alight: approach: {why}")).await?;
    ground.expect_text("Alight: detector spare").await?;

    let active = |f: &Packet| match &f.message {
        Some(MavMessage::HEARTBEAT(h)) => h.system_status == MavState::MAV_STATE_ACTIVE,
        _ => false,
    };
    ground.expect(|f| f.sender == COMPANION && active(f)).await?;

    let shown = ground.expect(|f| matches!(f.message, Some(MavMessage::LANDING_TARGET(_)))).await?;
    let Some(MavMessage::LANDING_TARGET(target)) = shown.message else { bail!("no target") };
    assert_eq!(shown.sender, COMPANION);
    assert_eq!(target.frame, MavFrame::MAV_FRAME_LOCAL_NED);
    assert_eq!(target.position_valid, MavBool::MAV_BOOL_TRUE);
    assert_eq!([target.x, target.y, target.z], [1.5, -1.5, 0.0]);

    vehicle.stop().await;
    ground.expect_text("Alight: controller gone, or link to drone lost").await?;
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_controller_that_freezes_in_a_landing_is_reported_and_so_is_its_return()
-> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let mut vehicle = FakeVehicle::start(port).await?;
    let bridge = start_bridge(port, &ground, &[]).await?;
    let has_state = |state: MavState| {
        move |f: &Packet| match &f.message {
            Some(MavMessage::HEARTBEAT(h)) => f.sender == COMPANION && h.system_status == state,
            _ => false,
        }
    };
    ground.expect(has_state(MavState::MAV_STATE_ACTIVE)).await?;
    // It stays a member of the network.
    vehicle.tasks[0].abort();
    ground.expect_text("Alight: be ready to take over: no status of the controller for 2 s, it hangs, or the link to the drone does").await?;
    ground.expect(has_state(MavState::MAV_STATE_CRITICAL)).await?;
    vehicle.tasks[0] = tokio::spawn(speak(vehicle.node.clone(), Arc::clone(&vehicle.status)));
    ground.expect(has_state(MavState::MAV_STATE_ACTIVE)).await?;
    let back = "Alight: the controller's status is back after ";
    ensure!(ground.texts.iter().any(|text| text.starts_with(back)), "{:?}", ground.texts);

    // Without a landing its silence has no effect.
    vehicle.status.send_replace(status(Phase::Idle, "waiting"));
    ground.expect(has_state(MavState::MAV_STATE_STANDBY)).await?;
    vehicle.tasks[0].abort();
    let silence = async { ground.expect(has_state(MavState::MAV_STATE_CRITICAL)).await };
    ensure!(timeout(Duration::from_secs(4), silence).await.is_err(), "{:?}", ground.texts);
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn only_the_grounds_own_packets_go_up_unchanged() -> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let vehicle = FakeVehicle::start(port).await?;
    let bridge = start_bridge(port, &ground, &[]).await?;
    ground.expect(|f| f.sender == COMPANION).await?;

    let first = encode(GROUND, 1, &param_request(1));
    let arriving = timeout(TIMEOUT, vehicle.next_packet());
    let calling = async {
        // Until the two sessions know each other, packets are lost.
        loop {
            ground.send(&first).await?;
            sleep(Duration::from_millis(20)).await;
        }
    };
    let arrived: anyhow::Result<Vec<u8>> = tokio::select! {
        problem = calling => problem,
        arrived = arriving => arrived?,
    };
    assert_eq!(arrived?, first);

    let mut damaged = encode(GROUND, 2, &param_request(2));
    damaged[12] ^= 0x40;
    let last = encode(GROUND, 3, &param_request(3));
    for bytes in [
        b"PX4 boot text \xfd\xfe\x03 and more of it, which is not MAVLink at all".to_vec(),
        damaged,
        last[..last.len() / 2].to_vec(),
        encode(COMPANION, 4, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default())),
        autopilot_heartbeat(),
        encode(GROUND, 5, &command_to(COMPANION)),
        unknown_packet(GROUND),
        last.clone(),
    ] {
        ground.send(&bytes).await?;
    }
    let mut others = Vec::new();
    loop {
        let packet = timeout(TIMEOUT, vehicle.next_packet()).await??;
        if packet == last {
            break;
        }
        if packet != first {
            others.push(packet);
        }
    }
    assert_eq!(others, [unknown_packet(GROUND)]);

    let ack = ground.expect(|f| matches!(f.message, Some(MavMessage::COMMAND_ACK(_)))).await?;
    let Some(MavMessage::COMMAND_ACK(answer)) = ack.message else { bail!("no answer") };
    assert_eq!((ack.sender, answer.result), (COMPANION, MavResult::MAV_RESULT_UNSUPPORTED));
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_first_ground_station_is_kept_and_packets_of_other_senders_are_counted()
-> anyhow::Result<()> {
    let port = free_port()?;
    let ([], _, listening) = ports::free()?;
    let vehicle = FakeVehicle::start(port).await?;
    let health = vehicle.node.subscriber(topic::HEALTH, &["gcs-bridge", "main"]).await?;
    let mut ground = Ground::open().await?;
    let stranger = UdpSocket::bind("127.0.0.1:0").await?;
    let setting = format!("ground=udpin:127.0.0.1:{listening}");
    let bridge = start_bridge(port, &ground, &[&setting]).await?;
    let to = SocketAddr::from(([127, 0, 0, 1], listening));
    ground.bridge = Some(to);
    let first = encode(GROUND, 1, &param_request(1));
    let received = async {
        loop {
            ground.send(&first).await?;
            if timeout(Duration::from_millis(50), vehicle.next_packet()).await.is_ok() {
                return anyhow::Ok(());
            }
        }
    };
    timeout(TIMEOUT, received).await??;
    // Disarming in the air, by force; and the heartbeat of an autopilot, as if the stranger were one.
    let disarm = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        param2: 21196.0,
        target_system: AUTOPILOT.system,
        target_component: AUTOPILOT.component,
        ..COMMAND_LONG_DATA::default()
    });
    let disarm = encode(GROUND, 2, &disarm);
    for _ in 0..20 {
        stranger.send_to(&autopilot_heartbeat(), to).await?;
        stranger.send_to(&disarm, to).await?;
    }
    let counted = until_error(&health, "of an unknown sender", 40).await?;
    ensure!(counted == 40, "{counted} of 40 packets counted");
    ground.send(&encode(GROUND, 3, &param_request(3))).await?;
    loop {
        let packet = timeout(TIMEOUT, vehicle.next_packet()).await??;
        ensure!(packet != disarm, "a packet of the unknown sender was passed on");
        if packet == encode(GROUND, 3, &param_request(3)) {
            break;
        }
    }
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn only_packets_of_known_ground_stations_are_accepted() -> anyhow::Result<()> {
    for kind in ["udpin", "tcpin"] {
        let port = free_port()?;
        let ([tcp], _, udp) = ports::free()?;
        let listening = if kind == "udpin" { udp } else { tcp };
        let vehicle = FakeVehicle::start(port).await?;
        let health = vehicle.node.subscriber(topic::HEALTH, &["gcs-bridge", "main"]).await?;
        let ground = Ground::open().await?;
        let setting = format!("ground={kind}:127.0.0.1:{listening}");
        let known = "ground_stations=['10.255.255.1']";
        let bridge = start_bridge(port, &ground, &[&setting, known]).await?;
        let to = SocketAddr::from(([127, 0, 0, 1], listening));
        let knocking = async {
            for _ in 0..400 {
                match kind {
                    "udpin" => drop(ground.socket.send_to(&autopilot_heartbeat(), to).await),
                    _ => drop(TcpStream::connect(to).await),
                }
                sleep(Duration::from_millis(50)).await;
            }
        };
        let counted = tokio::select! {
            counted = until_error(&health, "of an unknown sender", 3) => counted?,
            () = knocking => bail!("{kind}: nothing was counted"),
        };
        ensure!(counted >= 3, "{kind}: {counted}");
        bridge.abort();
        vehicle.stop().await;
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_ground_station_that_may_not_arm_is_informed_of_the_refusal() -> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let vehicle = FakeVehicle::start(port).await?;
    let health = vehicle.node.subscriber(topic::HEALTH, &["gcs-bridge", "main"]).await?;
    let bridge = start_bridge(port, &ground, &["ground_may=no-arming"]).await?;
    ground.expect(|f| f.sender == COMPANION).await?;
    let arm = MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        param1: 1.0,
        target_system: AUTOPILOT.system,
        target_component: AUTOPILOT.component,
        ..COMMAND_LONG_DATA::default()
    });
    let arm = encode(GROUND, 1, &arm);
    ground.send(&arm).await?;
    let text = "Alight: refused command 400: arming or stopping motors (ground_may = no-arming)";
    ground.expect_text(text).await?;
    until_error(&health, "refused: arming", 1).await?;
    ground.send(&arm).await?;
    // Ground stations take the acknowledgement of the component that the command was for, and no other.
    let answer = ground.expect(|f| f.message_id == COMMAND_ACK_DATA::ID).await?;
    assert_eq!(answer.sender, AUTOPILOT);
    let Some(MavMessage::COMMAND_ACK(answer)) = answer.message else { bail!("no answer") };
    assert_eq!(answer.command, MavCmd::MAV_CMD_COMPONENT_ARM_DISARM);
    assert_eq!(answer.result, MavResult::MAV_RESULT_DENIED);
    ground.send(&unknown_command()).await?;
    let is_its_answer = |f: &Packet| {
        f.message_id == COMMAND_ACK_DATA::ID && f.payload().starts_with(&UNKNOWN_COMMAND)
    };
    assert_eq!(ground.expect(is_its_answer).await?.sender, AUTOPILOT);
    let allowed = encode(GROUND, 2, &param_request(2));
    let passed = async {
        loop {
            ground.send(&allowed).await?;
            if let Ok(packet) = timeout(Duration::from_millis(50), vehicle.next_packet()).await {
                return packet;
            }
        }
    };
    ensure!(timeout(TIMEOUT, passed).await?? == allowed, "the autopilot was armed");
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_ground_station_is_warned_when_any_host_may_command() -> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let _vehicle = FakeVehicle::start(port).await?;
    let relay = open("relay", "drone", port).await?;
    relay.health().failed(INSECURE);
    let publishing = tokio::spawn(async move { relay.publish_health().await });
    let bridge = start_bridge(port, &ground, &[]).await?;
    let text = "Alight: insecure: anyone in reach can command the vehicle";
    ground.expect_text(text).await?;
    bridge.abort();
    publishing.abort();
    Ok(())
}

/// Waits until the bridge has counted so many errors of a reason.
async fn until_error(
    healths: &Subscriber<Health>,
    reason: &str,
    times: u64,
) -> anyhow::Result<u64> {
    let counted = async {
        loop {
            let health = healths.next().await.context("health")?;
            let found = health.errors.iter().find(|error| error.reason.contains(reason));
            if let Some(found) = found.filter(|error| error.count >= times) {
                return anyhow::Ok(found.count);
            }
        }
    };
    timeout(TIMEOUT, counted).await.with_context(|| format!("`{reason}` was not counted"))?
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_sent_before_the_system_id_is_known_or_assumed() -> anyhow::Result<()> {
    let mut ground = Ground::open().await?;
    let began = Instant::now();
    let bridge = start_bridge(free_port()?, &ground, &["assume_system_after_s=1.5"]).await?;
    let first = ground.expect(|_| true).await?;
    assert!(began.elapsed() >= Duration::from_millis(1500), "{:?}", began.elapsed());
    assert_eq!((first.sender.system, first.sender.component), (1, 191));
    let Some(MavMessage::HEARTBEAT(heartbeat)) = first.message else { bail!("no heartbeat") };
    assert_eq!(heartbeat.system_status, MavState::MAV_STATE_STANDBY);
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_bridge_outlives_the_ground_station() -> anyhow::Result<()> {
    let port = free_port()?;
    let ground = Ground::open().await?;
    let address = ground.socket.local_addr()?;
    let vehicle = FakeVehicle::start(port).await?;
    let bridge = start_bridge(port, &ground, &[]).await?;
    // Its packets now find no receiver, which the system reports to the bridge as refused connections.
    drop(ground);
    let health = vehicle.node.subscriber(topic::HEALTH, &["gcs-bridge", "main"]).await?;
    let sent = || async {
        let report = health.next().await.context("health")?;
        let rate = report.rates.into_iter().find(|rate| rate.name == "to ground");
        anyhow::Ok(rate.map_or(0, |rate| rate.count))
    };
    let before = timeout(TIMEOUT, sent()).await??;
    while timeout(TIMEOUT, sent()).await?? <= before {}
    let mut ground = Ground { socket: UdpSocket::bind(address).await?, ..Ground::open().await? };
    ground.expect(|f| f.sender == COMPANION && is_heartbeat(f)).await?;
    ground.send(&encode(GROUND, 0, &param_request(1))).await?;
    // A ground station that comes late gets the phase of the landing.
    ground.expect_text("Alight: search: looking for the marker").await?;
    assert!(!bridge.is_finished());
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_ground_station_that_joins_later_receives_earlier_texts() -> anyhow::Result<()> {
    let port = free_port()?;
    let ([], _, listening) = ports::free()?;
    let vehicle = FakeVehicle::start(port).await?;
    let recorder = open("recorder", "main", port).await?;
    let recording = tokio::spawn(record_nothing(recorder));
    let setting = format!("ground=udpin:127.0.0.1:{listening}");
    let settings = [setting.as_str(), "ground_silence_s=1"];
    let bridge = start_bridge(port, &Ground::open().await?, &settings).await?;
    let to = SocketAddr::from(([127, 0, 0, 1], listening));
    let not_recording = "Alight: not recording: the disk is full";
    let mut first = Ground { bridge: Some(to), ..Ground::open().await? };
    first.call_until_text(not_recording).await?;
    vehicle.stop().await;
    first.call_until_text("Alight: controller gone, or link to drone lost").await?;
    let mut second = Ground { bridge: Some(to), ..Ground::open().await? };
    second.call_until_text("Alight: controller gone, or link to drone lost").await?;
    second.call_until_text(not_recording).await?;
    recording.abort();
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_port_in_use_is_an_error() -> anyhow::Result<()> {
    let taken = Ground::open().await?;
    let setting = format!("ground=udpin:{}", taken.socket.local_addr()?);
    let bridge = start_bridge(free_port()?, &taken, &[&setting]).await?;
    let problem = timeout(TIMEOUT, bridge).await??.err().context("a port was taken twice")?;
    assert!(format!("{problem:#}").contains("already in use"), "{problem:#}");
    Ok(())
}

/// The same with an independent implementation of MAVLink as the ground station.
#[tokio::test(flavor = "multi_thread")]
async fn pymavlink_agrees() -> anyhow::Result<()> {
    let port = free_port()?;
    let free = Ground::open().await?;
    let address = free.socket.local_addr()?;
    let vehicle = FakeVehicle::start(port).await?;
    let bridge = start_bridge(port, &free, &[]).await?;
    drop(free);
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/gcs/ground_station.py");
    let run = tokio::process::Command::new(testing::interpreter())
        .args([script, "--connect", &format!("udpin:{address}"), "--timeout", "30"])
        .kill_on_drop(true)
        .output();
    // The phases of a landing, again and again, until the script has seen enough.
    let phases = async {
        let mut tick = interval(Duration::from_millis(700));
        for phase in [Phase::Search, Phase::Approach, Phase::Descend].into_iter().cycle() {
            tick.tick().await;
            vehicle.status.send_replace(status(phase, "so that pymavlink sees it"));
        }
    };
    let output = tokio::select! {
        output = run => output,
        () = phases => bail!("the phases ended"),
    };
    bridge.abort();
    match output {
        Ok(output) => testing::python_passes(&output).map(drop),
        Err(problem) => {
            testing::skip("python", format_args!("it does not start: {problem}"));
            Ok(())
        }
    }
}

/// The camera as QGroundControl looks for it, where packets are lost and where none is.
#[tokio::test(flavor = "multi_thread")]
async fn a_ground_station_finds_the_camera_its_video_and_the_marker() -> anyhow::Result<()> {
    let port = free_port()?;
    let free = Ground::open().await?;
    let address = free.socket.local_addr()?;
    let vehicle = FakeVehicle::start(port).await?;
    let seeing = tokio::spawn(see(vehicle.node.clone()));
    let bridge = start_bridge(port, &free, &["video='rtsp://10.0.0.2:8554/down'"]).await?;
    drop(free);
    let area = ["--area", "0.2", "0.2", "0.4", "0.4"];
    for (loss, further) in [("0", &["--commands"][..]), ("0.3", &[])] {
        let further = [&["--loss", loss], &area[..], further].concat();
        let Some(output) = script("camera.py", address, &further).await? else { return Ok(()) };
        eprintln!("{output}");
        // The sample's marker: within a hundredth of the width of where it was put.
        for part in [
            r#""model": "down""#,
            r#""size": [1296, 972]"#,
            r#""uri": "rtsp://10.0.0.2:8554/down""#,
            r#""tracked": [0.25"#,
        ] {
            ensure!(output.contains(part), "{part} is not in {output}");
        }
    }
    seeing.abort();
    bridge.abort();
    Ok(())
}

/// The camera's packets may return to the bridge, as an autopilot forwards the packets of one link to all others.
#[tokio::test(flavor = "multi_thread")]
async fn a_camera_gives_way_to_another_one_and_not_to_its_own_echo() -> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let vehicle = FakeVehicle::start(port).await?;
    let seeing = tokio::spawn(see(vehicle.node.clone()));
    let back = vehicle.node.publisher(topic::FROM_AUTOPILOT, &[]).await?;
    let bridge = start_bridge(port, &ground, &[]).await?;
    let mut last = None;
    for _ in 0..4 {
        let is_new = |f: &Packet| f.sender == CAMERA && Some(f.sequence) > last;
        let packet = ground.expect(is_new).await?;
        last = Some(packet.sequence);
        back.publish(&MavlinkBytes { packet: packet.raw }).await;
    }
    let other = HEARTBEAT_DATA { mavtype: MavType::MAV_TYPE_CAMERA, ..HEARTBEAT_DATA::default() };
    let other = encode(CAMERA, 200, &MavMessage::HEARTBEAT(other));
    let is_other = |f: &Packet| f.raw == other;
    let came = async {
        loop {
            back.publish(&MavlinkBytes { packet: other.clone() }).await;
            let next = timeout(Duration::from_millis(100), ground.expect(is_other)).await;
            if let Ok(packet) = next {
                return packet;
            }
        }
    };
    timeout(TIMEOUT, came).await??;
    seeing.abort();
    bridge.abort();
    Ok(())
}

/// The controller's configuration as QGroundControl loads it, where packets are lost and where none is.
#[tokio::test(flavor = "multi_thread")]
async fn a_ground_station_loads_the_companions_parameters_and_changes_none() -> anyhow::Result<()> {
    let port = free_port()?;
    let free = Ground::open().await?;
    let address = free.socket.local_addr()?;
    let vehicle = FakeVehicle::start(port).await?;
    let toml = include_str!("../../controller/controller.toml").to_owned();
    let publisher = vehicle.node.clone();
    let publishing = tokio::spawn(async move { publisher.publish_configuration(toml).await });
    let bridge = start_bridge(port, &free, &[]).await?;
    drop(free);
    for (loss, seed) in [("0", "1"), ("0.3", "1"), ("0.3", "2")] {
        let further = ["--loss", loss, "--seed", seed];
        let output = script("params.py", address, &further).await?;
        let Some(output) = output else { return Ok(()) };
        eprintln!("{output}");
        for part in [r#""ok": true"#, r#""parameters": 36, "names": 36"#, r#""value": 2.0"#] {
            ensure!(output.contains(part), "{part} is not in {output}");
        }
    }
    publishing.abort();
    bridge.abort();
    Ok(())
}

/// A ground station with a key, with pymavlink as the other side; and packets that are sent without the key.
#[tokio::test(flavor = "multi_thread")]
async fn only_signed_packets_of_the_ground_station_are_answered() -> anyhow::Result<()> {
    let port = free_port()?;
    let free = Ground::open().await?;
    let address = free.socket.local_addr()?;
    let vehicle = FakeVehicle::start(port).await?;
    let health = vehicle.node.subscriber(topic::HEALTH, &["gcs-bridge", "main"]).await?;
    let mut key = tempfile::Builder::new().permissions(Permissions::from_mode(0o600)).tempfile()?;
    writeln!(key, "correct horse battery")?;
    let setting = format!("signing_key={}", key.path().display());
    let bridge = start_bridge(port, &free, &[&setting]).await?;
    drop(free);
    let further = ["--passphrase", "correct horse battery", "--flood-s", "3"];
    let Some(output) = script("signing.py", address, &further).await? else { return Ok(()) };
    eprintln!("{output}");
    ensure!(output.contains(r#""ok": true"#), "{output}");
    for (reason, times) in
        [("not signed", 1), ("another key", 1000), ("sent before", 1), ("a minute old", 1)]
    {
        until_error(&health, reason, times).await?;
    }
    // A key that other users can read is refused.
    std::fs::set_permissions(key.path(), Permissions::from_mode(0o644))?;
    let open = start_bridge(free_port()?, &Ground::open().await?, &[&setting]).await?;
    let problem = timeout(TIMEOUT, open).await??.err().context("a key for all to read")?;
    ensure!(format!("{problem:#}").contains("chmod 600"), "{problem:#}");
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_status_contains_ground_stations_refused_packets_and_silence() -> anyhow::Result<()> {
    let port = free_port()?;
    let ([], _, listening) = ports::free()?;
    let vehicle = FakeVehicle::start(port).await?;
    let statuses = vehicle.node.subscriber(topic::GCS_STATUS, &[]).await?;
    let link = format!("udpin:127.0.0.1:{listening}");
    let setting = format!("ground={link}");
    let settings = [setting.as_str(), "ground_silence_s=1", "ground_may=no-arming"];
    let bridge = start_bridge(port, &Ground::open().await?, &settings).await?;
    let status = until_status(&statuses, |it| it.system == Some(AUTOPILOT.system)).await?;
    assert_eq!((status.bridge.as_str(), status.link, status.peer), ("main", link, None));
    assert_eq!((status.ground_may.as_str(), status.stations.len()), ("no-arming", 0));
    assert_eq!(status.signing.state, SigningState::Off);

    // A station, a stranger, a packet that may not pass, and a damaged one.
    let to = SocketAddr::from(([127, 0, 0, 1], listening));
    let ground = Ground { bridge: Some(to), ..Ground::open().await? };
    let stranger = UdpSocket::bind("127.0.0.1:0").await?;
    let heartbeat = |sender| encode(sender, 0, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()));
    let arm = COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_COMPONENT_ARM_DISARM,
        target_system: AUTOPILOT.system,
        ..COMMAND_LONG_DATA::default()
    };
    let mut damaged = encode(GROUND, 2, &param_request(2));
    damaged[12] ^= 0x40;
    let speaking = async {
        loop {
            ground.send(&heartbeat(GROUND)).await?;
            ground.send(&encode(GROUND, 1, &MavMessage::COMMAND_LONG(arm.clone()))).await?;
            ground.send(&damaged).await?;
            stranger.send_to(&heartbeat(GROUND), to).await?;
            sleep(Duration::from_millis(50)).await;
        }
    };
    let is_all_counted = |it: &GcsStatus| {
        [
            "arming or stopping motors",
            "wrong checksum",
            "packets or connections of an unknown sender",
        ]
        .iter()
        .all(|reason| it.refused.iter().any(|count| count.reason == *reason))
    };
    let status = tokio::select! {
        status = until_status(&statuses, is_all_counted) => status?,
        problem = speaking => return problem,
    };
    let address = ground.socket.local_addr()?.to_string();
    assert_eq!(status.peer.as_ref(), Some(&address));
    let [station] = status.stations.as_slice() else { bail!("{status:?}") };
    assert_eq!((station.system, station.component), (GROUND.system, GROUND.component));
    assert_eq!((station.silent, &station.peer), (false, &address));
    ensure!(station.refused > 0 && station.packets > station.refused, "{station:?}");
    ensure!((0..TIMEOUT.as_nanos() as i64).contains(&(now_ns() - station.last_ns)), "{status:?}");
    assert_eq!(station.signature, PacketSignature::Unsigned);

    // It falls silent, which a subscriber that joins later receives as well.
    until_status(&statuses, |it| it.stations.iter().all(|station| station.silent)).await?;
    let late = open("dashboard", "main", port).await?;
    let late = late.subscriber(topic::GCS_STATUS, &[]).await?;
    let status = until_status(&late, |_| true).await?;
    assert_eq!(status.stations.iter().map(|it| it.silent).collect::<Vec<_>>(), [true]);

    // Very many stations behind one address: some are listed, and the others counted.
    for number in 0..300_u16 {
        let [high, component] = number.to_be_bytes();
        ground.send(&heartbeat(Sender { system: 100 + high, component })).await?;
        sleep(Duration::from_millis(1)).await;
    }
    let status = until_status(&statuses, |it| it.unlisted > 0).await?;
    assert_eq!(status.stations.len(), 16);
    bridge.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_state_of_signing_is_published() -> anyhow::Result<()> {
    let port = free_port()?;
    let mut ground = Ground::open().await?;
    let vehicle = FakeVehicle::start(port).await?;
    let statuses = vehicle.node.subscriber(topic::GCS_STATUS, &[]).await?;
    let mut key = tempfile::Builder::new().permissions(Permissions::from_mode(0o600)).tempfile()?;
    writeln!(key, "correct horse battery")?;
    let setting = format!("signing_key={}", key.path().display());
    let bridge = start_bridge(port, &ground, &[&setting]).await?;
    ground.expect(|f| f.sender == COMPANION && f.is_signed()).await?;
    ground.send(&encode(GROUND, 1, &param_request(1))).await?;
    let has_refused = |it: &GcsStatus, reason: &str| it.refused.iter().any(|c| c.reason == reason);
    let status = until_status(&statuses, |it| has_refused(it, "not signed")).await?;
    assert_eq!(status.signing.state, SigningState::Wanted);
    assert_eq!((status.signing.link_id, status.signing.verified_ns), (Some(191), None));
    ensure!(status.stations.is_empty(), "{status:?}");

    let mut signing = Signing::new("correct horse battery".parse()?, 7, 0);
    let since_1970 = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH)?;
    let signed = signing.sign(stamp(since_1970), &encode(GROUND, 2, &param_request(2)));
    let signed = signed.context("signing")?;
    for _ in 0..2 {
        ground.send(&signed).await?;
    }
    let status = until_status(&statuses, |it| has_refused(it, "signed, but sent before")).await?;
    assert_eq!(status.signing.state, SigningState::InForce);
    ensure!(status.signing.verified_ns.is_some(), "{status:?}");
    let [station] = status.stations.as_slice() else { bail!("{status:?}") };
    assert_eq!((station.packets, station.signature), (1, PacketSignature::Verified));
    bridge.abort();
    Ok(())
}

/// Waits for a status of the bridge.
async fn until_status(
    statuses: &Subscriber<GcsStatus>,
    wanted: impl Fn(&GcsStatus) -> bool,
) -> anyhow::Result<GcsStatus> {
    let found = async {
        loop {
            let status = statuses.next().await.context("status")?;
            if wanted(&status) {
                return anyhow::Ok(status);
            }
        }
    };
    timeout(TIMEOUT, found).await.context("the expected status was not received")?
}

/// The output of a script of `tests/gcs`; none where it cannot run.
async fn script(
    name: &str,
    address: SocketAddr,
    further: &[&str],
) -> anyhow::Result<Option<String>> {
    let script = format!("{}/../tests/gcs/{name}", env!("CARGO_MANIFEST_DIR"));
    let run = tokio::process::Command::new(testing::interpreter())
        .args([&script, "--connect", &format!("udpin:{address}")])
        .args(further)
        .kill_on_drop(true)
        .output();
    match timeout(Duration::from_secs(120), run).await? {
        Ok(output) => {
            let has_run = testing::python_passes(&output)?;
            Ok(has_run.then(|| String::from_utf8_lossy(&output.stdout).into_owned()))
        }
        Err(problem) => {
            testing::skip("python", format_args!("it does not start: {problem}"));
            Ok(None)
        }
    }
}

/// Publishes detections of the detector in use: a marker from a quarter to half of the picture.
async fn see(node: Node) -> anyhow::Result<()> {
    let detections = node.publisher(topic::DETECTIONS, &["spare"]).await?;
    let mut found = Detections::sample();
    let [left, right, top, bottom] = [323.5, 647.5, 242.5, 485.5];
    found.detections[0].corners_px =
        Some([[left, top], [right, top], [right, bottom], [left, bottom]]);
    let mut tick = interval(Duration::from_millis(50));
    loop {
        tick.tick().await;
        detections.publish(&found).await;
    }
}

/// Publishes that nothing is recorded.
async fn record_nothing(node: Node) -> anyhow::Result<()> {
    let statuses = node.publisher(topic::RECORDER_STATUS, &[]).await?;
    let status = RecorderStatus {
        recorder: "main".into(),
        problem: Some("the disk is full".into()),
        ..RecorderStatus::default()
    };
    let mut tick = interval(Duration::from_millis(100));
    loop {
        tick.tick().await;
        statuses.publish(&status).await;
    }
}

fn free_port() -> anyhow::Result<u16> {
    let ([port], _, _) = ports::free()?;
    Ok(port)
}

async fn open(service: &'static str, instance: &str, port: u16) -> anyhow::Result<Node> {
    let text = include_str!("../../zenoh-config/local.json5");
    ensure!(text.contains(":7447"), "the rendezvous has moved");
    let source = ZenohSource::Text(text.replace(":7447", &format!(":{port}")));
    Node::open(Identity { service, instance: instance.into() }, &source).await
}

async fn start_bridge(
    port: u16,
    ground: &Ground,
    set: &[&str],
) -> anyhow::Result<JoinHandle<anyhow::Result<()>>> {
    let ground = format!("ground=udpout:{}", ground.socket.local_addr()?);
    let set = [ground.as_str()].iter().chain(set).map(|text| (*text).to_owned()).collect();
    let config = Layers { file: None, set }.load::<Config>()?.settings;
    let node = open("gcs-bridge", "main", port).await?;
    let shutdown = Shutdown::on_signals()?;
    Ok(tokio::spawn(async move {
        tokio::select! {
            result = gcs_bridge::run(node.clone(), config, shutdown) => result,
            result = node.publish_health() => result,
        }
    }))
}

/// A ground station on a UDP socket.
struct Ground {
    socket: UdpSocket,
    parser: Parser,
    waiting: Vec<Packet>,
    /// The companion's texts so far.
    texts: Vec<String>,
    bridge: Option<SocketAddr>,
}

impl Ground {
    async fn open() -> anyhow::Result<Self> {
        let socket = UdpSocket::bind("127.0.0.1:0").await?;
        let (waiting, texts) = (Vec::new(), Vec::new());
        Ok(Self { socket, parser: Parser::new(), waiting, texts, bridge: None })
    }

    async fn next(&mut self) -> anyhow::Result<Packet> {
        let mut bytes = [0; 2048];
        while self.waiting.is_empty() {
            let (count, from) = timeout(TIMEOUT, self.socket.recv_from(&mut bytes)).await??;
            self.bridge = Some(from);
            self.waiting = self.parser.push(&bytes[..count]);
        }
        let packet = self.waiting.remove(0);
        self.keep_text(&packet)?;
        Ok(packet)
    }

    async fn expect(&mut self, wanted: impl Fn(&Packet) -> bool) -> anyhow::Result<Packet> {
        let seen = async {
            loop {
                let packet = self.next().await?;
                if wanted(&packet) {
                    return Ok(packet);
                }
            }
        };
        timeout(TIMEOUT, seen).await.context("the expected packet was not received")?
    }

    /// Waits for a text of the companion, unless it came already.
    async fn expect_text(&mut self, wanted: &str) -> anyhow::Result<()> {
        let seen = async {
            while !self.texts.iter().any(|text| text == wanted) {
                self.next().await?;
            }
            anyhow::Ok(())
        };
        let outcome = timeout(TIMEOUT, seen).await;
        outcome.with_context(|| format!("`{wanted}` is not in {:?}", self.texts))?
    }

    /// Sends heartbeats until a text of the companion has come.
    async fn call_until_text(&mut self, wanted: &str) -> anyhow::Result<()> {
        let heartbeat = encode(GROUND, 0, &MavMessage::HEARTBEAT(HEARTBEAT_DATA::default()));
        let seen = async {
            while !self.texts.iter().any(|text| text == wanted) {
                self.send(&heartbeat).await?;
                if let Ok(packet) = timeout(Duration::from_millis(200), self.next()).await {
                    packet?;
                }
            }
            anyhow::Ok(())
        };
        let outcome = timeout(TIMEOUT, seen).await;
        outcome.with_context(|| format!("`{wanted}` is not in {:?}", self.texts))?
    }

    /// Keeps a text, and joins its parts.
    fn keep_text(&mut self, packet: &Packet) -> anyhow::Result<()> {
        let Some(MavMessage::STATUSTEXT(part)) = &packet.message else { return Ok(()) };
        ensure!(packet.sender == COMPANION, "a text of {:?}", packet.sender);
        let text = part.text.to_str()?;
        match self.texts.last_mut() {
            Some(last) if part.chunk_seq > 0 => last.push_str(text),
            _ => self.texts.push(text.to_owned()),
        }
        Ok(())
    }

    async fn send(&self, bytes: &[u8]) -> anyhow::Result<()> {
        let to = self.bridge.context("no packet of the bridge yet")?;
        self.socket.send_to(bytes, to).await?;
        Ok(())
    }
}

/// The controller's messages, of a vehicle that hovers over its marker.
struct FakeVehicle {
    node: Node,
    status: Arc<watch::Sender<ControllerStatus>>,
    to_autopilot: Subscriber<MavlinkBytes>,
    tasks: [JoinHandle<anyhow::Result<()>>; 2],
}

impl FakeVehicle {
    async fn start(port: u16) -> anyhow::Result<Self> {
        let node = open("controller", "main", port).await?;
        let first = ControllerStatus {
            active_detector: None,
            ..status(Phase::Search, "looking for the marker")
        };
        let status = Arc::new(watch::Sender::new(first));
        let to_autopilot = node.subscriber(topic::TO_AUTOPILOT, &[]).await?;
        let tasks = [
            tokio::spawn(speak(node.clone(), Arc::clone(&status))),
            tokio::spawn(answer_parameters(node.clone())),
        ];
        node.announce().await?;
        Ok(Self { node, status, to_autopilot, tasks })
    }

    async fn next_packet(&self) -> anyhow::Result<Vec<u8>> {
        Ok(self.to_autopilot.next().await.context("the session was closed")?.packet)
    }

    async fn stop(self) {
        self.tasks.iter().for_each(JoinHandle::abort);
        drop(self.to_autopilot);
        self.node.close().await;
    }
}

async fn speak(node: Node, status: Arc<watch::Sender<ControllerStatus>>) -> anyhow::Result<()> {
    let from_autopilot = node.publisher(topic::FROM_AUTOPILOT, &[]).await?;
    let statuses = node.publisher(topic::STATUS, &[]).await?;
    let targets = node.publisher(topic::TARGET, &[]).await?;
    let mut tick = interval(Duration::from_millis(50));
    loop {
        tick.tick().await;
        for packet in [autopilot_heartbeat(), unknown_packet(AUTOPILOT)] {
            from_autopilot.publish(&MavlinkBytes { packet }).await;
        }
        let now = status.borrow().clone();
        statuses.publish(&now).await;
        targets.publish(&target()).await;
    }
}

async fn answer_parameters(node: Node) -> anyhow::Result<()> {
    let requests = node.subscriber(topic::TO_AUTOPILOT, &[]).await?;
    let answers = node.publisher(topic::FROM_AUTOPILOT, &[]).await?;
    while let Some(MavlinkBytes { packet }) = requests.next().await {
        for packet in Parser::new().push(&packet) {
            let Some(MavMessage::PARAM_REQUEST_READ(request)) = packet.message else { continue };
            let value = MavMessage::PARAM_VALUE(PARAM_VALUE_DATA {
                param_id: request.param_id,
                param_value: 50.0,
                param_count: 1,
                ..PARAM_VALUE_DATA::default()
            });
            answers.publish(&MavlinkBytes { packet: encode(AUTOPILOT, 1, &value) }).await;
        }
    }
    Ok(())
}

fn status(phase: Phase, why: &str) -> ControllerStatus {
    ControllerStatus {
        stamp_ns: now_ns(),
        phase,
        why: why.into(),
        guidance: "metric".into(),
        autopilot: "connected".into(),
        active_detector: Some("spare".into()),
        detection_age_ms: Some(60.0),
        height_m: Some(10.0),
        lateral_error_m: Some(1.93),
        started_ns: Some(0),
        detections_used: 1,
        ..ControllerStatus::default()
    }
}

fn target() -> TargetEstimate {
    TargetEstimate { stamp_ns: now_ns(), ..TargetEstimate::sample() }
}

fn is_heartbeat(packet: &Packet) -> bool {
    matches!(packet.message, Some(MavMessage::HEARTBEAT(_)))
}

fn autopilot_heartbeat() -> Vec<u8> {
    let heartbeat = HEARTBEAT_DATA {
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        ..HEARTBEAT_DATA::default()
    };
    encode(AUTOPILOT, 0, &MavMessage::HEARTBEAT(heartbeat))
}

fn param_request(index: i16) -> MavMessage {
    MavMessage::PARAM_REQUEST_READ(PARAM_REQUEST_READ_DATA {
        param_index: index,
        target_system: AUTOPILOT.system,
        target_component: AUTOPILOT.component,
        ..PARAM_REQUEST_READ_DATA::default()
    })
}

fn command_to(target: Sender) -> MavMessage {
    MavMessage::COMMAND_LONG(COMMAND_LONG_DATA {
        command: MavCmd::MAV_CMD_REQUEST_MESSAGE,
        target_system: target.system,
        target_component: target.component,
        ..COMMAND_LONG_DATA::default()
    })
}

/// A number that no dialect gives to a command.
const UNKNOWN_COMMAND: [u8; 2] = 60_123_u16.to_le_bytes();

fn unknown_command() -> Vec<u8> {
    let mut packet = encode(GROUND, 1, &command_to(AUTOPILOT));
    packet[38..40].copy_from_slice(&UNKNOWN_COMMAND);
    let end = packet.len() - 2;
    let extra = MavMessage::extra_crc(COMMAND_LONG_DATA::ID);
    let checksum = calculate_crc(&packet[1..end], extra);
    packet[end..].copy_from_slice(&checksum.to_le_bytes());
    packet
}

/// A number that no dialect gives to a message.
const UNKNOWN_ID: u32 = 16_000_000;

fn unknown_packet(sender: Sender) -> Vec<u8> {
    let [id0, id1, id2, _] = UNKNOWN_ID.to_le_bytes();
    let mut packet = vec![0xFD, 4, 0, 0, 9, sender.system, sender.component, id0, id1, id2];
    packet.extend([1, 2, 3, 4]);
    packet.extend(calculate_crc(&packet[1..], 42).to_le_bytes());
    packet
}
