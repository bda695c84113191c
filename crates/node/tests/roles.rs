//! Zenoh sessions of drone and ground through one relay or two, with the configuration of each role: which
//! process receives from which, and the error texts for an operator without a connection.

mod common;

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use common::Authority;
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
async fn the_ground_reaches_a_relay_at_either_kind_of_address() -> anyhow::Result<()> {
    if std::net::TcpListener::bind("[::1]:0").is_err() {
        // This machine has no IPv6.
        return Ok(());
    }
    let site = Site::new()?;
    let camera = site.open("local", "camera-pub", "down").await?;
    let listen = Some(site.air.replace("127.0.0.1", "[::]"));
    let relay = Network { connect: None, listen, insecure: true, ..site.network("drone") };
    let identity = Identity { service: "relay", instance: "drone".into() };
    let _relay = Node::open(identity, &relay.source("relay")?).await?;
    for host in ["[::1]", "127.0.0.1"] {
        let connect = Some(site.air.replace("127.0.0.1", host));
        let ground = Network { connect, listen: None, ..site.network("ground") };
        let identity = Identity { service: "detector", instance: "ground".into() };
        let detector = Node::open(identity, &ground.source("detector")?).await?;
        is_received(&camera, &detector).await?;
        detector.close().await;
    }
    Ok(())
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

/// The error text for an operator whose command goes through this network.
async fn error_text(network: &Network) -> anyhow::Result<String> {
    let identity = Identity { service: "alight", instance: "command".into() };
    let operator = Node::open_tool(identity, &network.source("operator")?).await?;
    let unanswered = operator.command(topic::COMMAND, &[], &ControllerCommand::Hold).await;
    operator.close().await;
    Ok(unanswered.err().context("it is answered")?.to_string())
}

fn contains(text: &str, parts: &[&str]) -> anyhow::Result<()> {
    for part in parts {
        ensure!(text.contains(part), "`{part}` is not in: {text}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_cause_of_a_missing_answer_is_reported_to_the_operator() -> anyhow::Result<()> {
    let site = Site::new()?;
    let ground = site.network("ground");
    let at = |network: &Network, host: &str| Network {
        connect: Some(site.air.replace("127.0.0.1", host)),
        ..network.clone()
    };
    // The label is too long for a query to a name server.
    let name = format!("{}.invalid", "nowhere".repeat(10));
    let nowhere = at(&ground, &name);
    let here = Network { meet: Some(site.meet), ..Network::default() };
    let (no_relay, unknown, alone) =
        tokio::join!(error_text(&ground), error_text(&nowhere), error_text(&here));
    contains(&no_relay?, &["no controller", "no program listens at 127.0.0.1", "--connect"])?;
    contains(&unknown?, &[&format!("address of `{name}` is not known")])?;
    contains(&alone?, &["no process of the vehicle `drone`", "--meet"])?;

    let relay = site.open("drone", "relay", "drone").await?;
    relay.announce().await?;
    let other = Network { vehicle: Some("kestrel".into()), ..ground.clone() };
    let (known, other) = tokio::join!(error_text(&ground), error_text(&other));
    contains(&known?, &["there is only relay `drone`"])?;
    contains(&other?, &["no process of the vehicle `kestrel`", "--vehicle"])
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stalled_relay_or_link_is_reported_as_such() -> anyhow::Result<()> {
    let keys = tempfile::tempdir()?;
    Authority::new()?.issue(keys.path(), "operator.anna@drone")?;
    // The kernel accepts connections, as for a stopped relay.
    let stopped = std::net::TcpListener::bind("127.0.0.1:0")?;
    let site = Site { meet: 1, air: stopped.local_addr()?.to_string() };
    let plain = Network { meet: None, ..site.network("ground") };
    let encrypted = Network { keys: Some(keys.path().to_owned()), ..plain.clone() };
    let (plain, encrypted) = tokio::join!(error_text(&plain), error_text(&encrypted));
    for text in [plain?, encrypted?] {
        let stalled = format!("the connection to {} opens, but nothing answers", site.air);
        contains(&text, &[&stalled, "within 1 s", "stalled", "pilot's mode switch"])?;
        for wrong in ["os error", "another program", "certificate"] {
            ensure!(!text.contains(wrong), "`{wrong}` is in: {text}");
        }
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_client_that_a_relay_rejects_gets_the_reason() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let keys_of = |name: &str| -> anyhow::Result<PathBuf> {
        let path = folder.path().join(name);
        std::fs::create_dir(&path)?;
        Ok(path)
    };
    let (authority, others) = (Authority::new()?, Authority::new()?);
    let drone = keys_of("drone")?;
    authority.issue(&drone, "drone@drone")?;
    for line in ["drone@drone", "operator.anna@drone", "revoked operator.bob@drone"] {
        common::list(&drone, line)?;
    }
    let issue = |authority: &Authority, name: &str, holder: &str| -> anyhow::Result<PathBuf> {
        let keys = keys_of(name)?;
        authority.issue(&keys, holder)?;
        Ok(keys)
    };
    let keys_of_anna = issue(&authority, "anna", "operator.anna@drone")?;
    let keys_of_bob = issue(&authority, "bob", "operator.bob@drone")?;
    let keys_of_eve = issue(&others, "eve", "operator.eve@drone")?;
    let mallory = issue(&authority, "mallory", "observer.mallory@drone")?;
    for extension in ["pem", "key"] {
        let copied = |role: &str| mallory.join(format!("{role}.{extension}"));
        std::fs::rename(copied("observer"), copied("operator"))?;
    }
    common::list(&drone, "observer.mallory@drone")?;

    let site = Site::new()?;
    let with = |network: Network, keys: &Path| Network { keys: Some(keys.to_owned()), ..network };
    let relays = Network { connect: None, ..with(site.network("drone"), &drone) };
    let identity = Identity { service: "relay", instance: "drone".into() };
    let relay = Node::open(identity, &relays.source("drone")?).await?;
    relay.announce().await?;
    let controller = site.open("local", "controller", "main").await?;
    let ground = |keys: &Path| with(site.network("ground"), keys);
    let elsewhere = Some(site.air.replace("127.0.0.1", "localhost"));
    let to_anna = ground(&keys_of_anna);
    let (to_bob, to_eve) = (ground(&keys_of_bob), ground(&keys_of_eve));
    let named = Network { connect: elsewhere, ..to_anna.clone() };
    let (anna, bob, eve, named) = tokio::join!(
        error_text(&to_anna),
        error_text(&to_bob),
        error_text(&to_eve),
        error_text(&named)
    );
    contains(&anna?, &["there is only relay `drone`"])?;
    contains(&bob?, &["bob/operator.pem, but announces no process to it", "revoked"])?;
    contains(&eve?, &["of another authority"])?;
    contains(&named?, &["not valid for the address `localhost`", "--address"])?;
    // Processes of the ground see each other without the relay, which still announces none to a revoked holder.
    let own = issue(&authority, "dave", "operator.dave@drone")?;
    common::list(&drone, "operator.dave@drone")?;
    let identity = Identity { service: "detector", instance: "ground".into() };
    let detector = Node::open(identity, &ground(&own).source("operator")?).await?;
    detector.announce().await?;
    contains(
        &error_text(&to_bob).await?,
        &["there is only detector `ground`; ", "bob/operator.pem, but announces no", "revoked"],
    )?;
    detector.close().await;
    controller.announce().await?;
    contains(
        &error_text(&ground(&mallory)).await?,
        &["the controller is there", "role of this key"],
    )?;
    relay.close().await;

    // A relay that has no keys yet.
    let open = Site::new()?;
    let _relay = open.open("drone", "relay", "drone").await?;
    let plain = with(open.network("ground"), &keys_of_anna);
    contains(&error_text(&plain).await?, &["has not answered with a certificate", "without keys"])
}
