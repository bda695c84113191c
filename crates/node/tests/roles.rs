//! Two hosts: the processes on the drone, its relay, and the ground.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use messages::{CommandReply, ControllerCommand, Wind, topic};
use node::{Identity, Network, Node};
use testing::ports;
use tokio::time::timeout;

const PATIENCE: Duration = Duration::from_secs(20);

/// The ports of one test.
#[derive(Clone)]
struct Site {
    meet: u16,
    air: String,
}

impl Site {
    fn new() -> anyhow::Result<Self> {
        let ([meet], air, _) = ports::free()?;
        Ok(Self { meet, air: format!("127.0.0.1:{air}") })
    }

    fn network(&self, role: &str) -> Network {
        Network {
            config: Some(PathBuf::from(role)),
            connect: Some(self.air.clone()),
            listen: Some(self.air.clone()),
            meet: Some(self.meet),
            ..Network::default()
        }
    }

    async fn open(&self, role: &str, service: &'static str, name: &str) -> anyhow::Result<Node> {
        let mut network = self.network(role);
        if role == "drone" {
            // `drone` connects to its own rendezvous.
            network.connect = None;
        }
        let identity = Identity { service, instance: name.into() };
        Node::open(identity, &network.source(service)?).await
    }
}

/// Publishes until a message is received.
async fn is_received(from: &Node, by: &Node) -> anyhow::Result<()> {
    let subscriber = by.subscriber(topic::WIND, &[]).await?;
    let publisher = from.publisher(topic::WIND, &[]).await?;
    let wind = Wind { velocity_ned_m_s: [1.0, 2.0, 3.0], stamp_ns: 7 };
    let received = async {
        loop {
            publisher.publish(&wind).await;
            if let Ok(Some(wind)) = timeout(Duration::from_millis(50), subscriber.next()).await {
                return wind;
            }
        }
    };
    let received = timeout(PATIENCE, received).await.context("nothing is received")?;
    ensure!(received == wind);
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_ground_takes_part_through_the_drones_relay() -> anyhow::Result<()> {
    let site = Site::new()?;
    let controller = site.open("local", "controller", "main").await?;
    let camera = site.open("local", "camera-pub", "down").await?;
    let commands = controller.commands(topic::COMMAND, &[]).await?;
    controller.announce().await?;
    // The ground starts before the relay.
    let detector = site.open("ground", "detector", "ground").await?;
    detector.announce().await?;
    let relay = site.open("drone", "relay", "drone").await?;
    is_received(&camera, &detector).await?;
    is_received(&detector, &controller).await?;
    let answering = tokio::spawn(async move {
        let request = commands.next().await.context("a command")?;
        request.answer(&CommandReply { accepted: true, reason: "it is done".into() }).await;
        anyhow::Ok(commands)
    });
    let reply = detector.command(topic::COMMAND, &[], &ControllerCommand::Hold).await?;
    ensure!(reply.accepted, "{reply:?}");
    let _commands = answering.await??;
    ensure!(controller.alive("detector", "*").await? == ["ground"]);
    ensure!(detector.alive("controller", "*").await? == ["main"]);
    // Without the relay the drone is disconnected; the next relay connects both again.
    let presence = controller.presence("detector").await?;
    let change = || async { timeout(PATIENCE, presence.next()).await?.ok_or(anyhow!("closed")) };
    ensure!(change().await? == ("ground".to_owned(), true));
    relay.close().await;
    ensure!(change().await? == ("ground".to_owned(), false));
    is_received(&camera, &controller).await?;
    let _relay = site.open("drone", "relay", "drone").await?;
    ensure!(change().await? == ("ground".to_owned(), true));
    is_received(&camera, &detector).await?;
    is_received(&detector, &controller).await
}

#[tokio::test(flavor = "multi_thread")]
async fn processes_on_the_ground_are_connected_without_the_drone() -> anyhow::Result<()> {
    let site = Site::new()?;
    let relay = site.open("drone", "relay", "drone").await?;
    let first = site.open("ground", "detector", "ground").await?;
    let second = site.open("ground", "gcs-bridge", "ground").await?;
    is_received(&first, &second).await?;
    relay.close().await;
    is_received(&first, &second).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_base_station_relays_between_drone_and_ground() -> anyhow::Result<()> {
    let drone = Site::new()?;
    let base = Site::new()?;
    let camera = drone.open("local", "camera-pub", "down").await?;
    let _drones = drone.open("drone", "relay", "drone").await?;
    let between = Network { listen: Some(base.air.clone()), ..drone.network("relay") };
    let identity = Identity { service: "relay", instance: "base".into() };
    let _between = Node::open(identity, &between.source("relay")?).await?;
    let detector = base.open("ground", "detector", "ground").await?;
    is_received(&camera, &detector).await?;
    is_received(&detector, &camera).await
}
