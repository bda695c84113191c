//! A session over the loopback: packets in, state out, requests back.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use std::time::{Duration, Instant};

use autopilot::dialect::{
    ATTITUDE_DATA, COMMAND_LONG_DATA, HEARTBEAT_DATA, MavAutopilot, MavCmd, MavMessage, MavType,
};
use autopilot::packet::{self, Sender};
use autopilot::{Config, Event, Firmware, Happening, Parser, Session};
use tokio::net::UdpSocket;
use tokio::time::timeout;

const AUTOPILOT: Sender = Sender { system: 1, component: 1 };

fn heartbeat() -> Vec<u8> {
    let message = HEARTBEAT_DATA {
        mavtype: MavType::MAV_TYPE_QUADROTOR,
        autopilot: MavAutopilot::MAV_AUTOPILOT_ARDUPILOTMEGA,
        ..Default::default()
    };
    packet::encode(AUTOPILOT, 0, &MavMessage::HEARTBEAT(message))
}

async fn next(session: &mut Session<impl Fn() -> i64>) -> Happening {
    timeout(Duration::from_secs(30), session.next()).await.unwrap()
}

/// The next message that the autopilot receives.
async fn received(autopilot: &UdpSocket) -> MavMessage {
    let mut bytes = [0; 512];
    let read = timeout(Duration::from_secs(30), autopilot.recv(&mut bytes)).await.unwrap();
    Parser::new().push(&bytes[..read.unwrap()]).remove(0).message.unwrap()
}

#[tokio::test]
async fn a_session_finds_the_autopilot_asks_it_and_tells_its_state() {
    let reserved = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let at = reserved.local_addr().unwrap();
    drop(reserved);
    let began = Instant::now();
    let clock = move || i64::try_from(began.elapsed().as_nanos()).unwrap();
    let address = format!("udpin:{at}").parse().unwrap();
    let mut session = Session::open(address, Config::default(), clock).await.unwrap();

    let autopilot = UdpSocket::bind("127.0.0.1:0").await.unwrap();
    autopilot.connect(at).await.unwrap();
    autopilot.send(&heartbeat()).await.unwrap();
    let found = Happening::Vehicle(Event::Found { system: 1, firmware: Firmware::Copter });
    while next(&mut session).await != found {}
    loop {
        tokio::select! {
            message = received(&autopilot) => {
                let MavMessage::COMMAND_LONG(COMMAND_LONG_DATA { command, .. }) = message else { continue };
                assert_eq!(command, MavCmd::MAV_CMD_SET_MESSAGE_INTERVAL);
                break;
            }
            _ = next(&mut session) => {}
        }
    }

    let before = clock();
    let attitude = ATTITUDE_DATA { roll: 0.25, ..Default::default() };
    autopilot.send(&packet::encode(AUTOPILOT, 1, &MavMessage::ATTITUDE(attitude))).await.unwrap();
    let attitude = loop {
        if let Happening::Vehicle(Event::Attitude(attitude)) = next(&mut session).await {
            break attitude;
        }
    };
    assert!((attitude.ned_from_body.euler().0 - 0.25).abs() < 1e-6);
    assert!((before..=clock()).contains(&attitude.stamp_ns));

    session.act(|_, client| client.send(&autopilot::compose::heartbeat()));
    session.pass_on(&heartbeat()).unwrap();
    while !matches!(
        received(&autopilot).await,
        MavMessage::HEARTBEAT(HEARTBEAT_DATA { mavtype: MavType::MAV_TYPE_QUADROTOR, .. })
    ) {}
}
