//! The log texts by which [`node::denied`] recognises denials are those of the Zenoh version in use: a real
//! message without access rights, and a real connection with the certificate of another authority.

mod common;

use std::path::Path;
use std::time::Duration;

use anyhow::Context;
use common::Authority;
use messages::{Wind, topic};
use node::denied::{self, ACCESS_TARGET, CONNECTION_TARGET};
use node::{Identity, Network, Node};
use testing::ports;
use tokio::time::{sleep, timeout};

const TIMEOUT: Duration = Duration::from_secs(20);

async fn open(
    service: &'static str,
    role: &str,
    keys: &Path,
    network: Network,
) -> anyhow::Result<Node> {
    let network = Network { keys: Some(keys.to_owned()), ..network };
    let identity = Identity { service, instance: "main".into() };
    Node::open(identity, &network.source(role)?).await
}

/// Repeats an attempt until a denial with this text is counted.
async fn until_denied(
    text: &str,
    target: &str,
    mut attempt: impl AsyncFnMut(),
) -> anyhow::Result<()> {
    let counted = async {
        while !denied::take().keys().any(|reason| reason.contains(text)) {
            attempt().await;
            sleep(Duration::from_millis(100)).await;
        }
    };
    timeout(TIMEOUT, counted).await.with_context(|| {
        format!(
            "`{text}` was denied but not counted: this version of Zenoh words it differently in its log (target \
             `{target}`), so crates/node/src/denied.rs must be adapted"
        )
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn real_denials_are_counted() -> anyhow::Result<()> {
    node::start_logging("off");
    let (keys, foreign_keys) = (tempfile::tempdir()?, tempfile::tempdir()?);
    let authority = Authority::new()?;
    for holder in ["drone@drone", "detector.main@drone"] {
        authority.issue(keys.path(), holder)?;
        common::list(keys.path(), holder)?;
    }
    Authority::new()?.issue(foreign_keys.path(), "detector.main@drone")?;
    let ([meet], air, _) = ports::free()?;
    let air = format!("127.0.0.1:{air}");
    let drone = Network {
        config: Some("drone".into()),
        listen: Some(air.clone()),
        meet: Some(meet),
        ..Network::default()
    };
    let ground =
        Network { config: Some("ground".into()), connect: Some(air.clone()), ..Network::default() };
    let relay = open("relay", "drone", keys.path(), drone).await?;
    let _winds = relay.subscriber(topic::WIND, &[]).await?;

    // A connection that ends before the exchange of certificates.
    let broken = async || drop(tokio::net::TcpStream::connect(&air).await);
    until_denied("ended before it showed a valid certificate", CONNECTION_TARGET, broken).await?;

    // A detector has no right to publish the wind.
    let detector = open("detector", "detector.main", keys.path(), ground.clone()).await?;
    let publisher = detector.publisher(topic::WIND, &[]).await?;
    let wind = Wind { velocity_ned_m_s: [1.0, 2.0, 3.0], stamp_ns: 7 };
    until_denied("put on drone/wind", ACCESS_TARGET, async || publisher.publish(&wind).await)
        .await?;

    // The session opens without a connection, and retries it.
    let _denied = open("detector", "detector.main", foreign_keys.path(), ground).await?;
    until_denied("a connection without a valid certificate", CONNECTION_TARGET, async || {}).await
}
