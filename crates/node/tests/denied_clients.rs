//! Clients without rights at the drone's relay: all that they publish and query is refused on every topic. The relay counts
//! their connections and messages that reach it as denied.
//!
//! Prints the table of `docs/results.md`:
//! `cargo test -p node --test denied_clients -- --nocapture`.

mod common;

use std::collections::{BTreeMap, BTreeSet};
use std::net::TcpStream;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use common::Authority;
use messages::{Delivery, MONITORS, TOPICS};
use node::network::AUTHORITY;
use node::{Identity, Network, Node, denied};
use rustls::crypto::{CryptoProvider, ring};
use rustls::pki_types::pem::PemObject;
use rustls::pki_types::{CertificateDer, PrivateKeyDer, ServerName};
use rustls::{ClientConfig, ClientConnection, RootCertStore, SupportedCipherSuite};
use testing::ports;
use tokio::time::{sleep, timeout};
use zenoh::Session;
use zenoh::query::Query;
use zenoh::sample::Sample;

const PATIENCE: Duration = Duration::from_secs(30);
const PAUSE: Duration = Duration::from_millis(100);

/// A peer's session opens without a connection.
const PEER: &str = "peer";
/// A client sends to the relay with or without known subscribers; the relay announces the subscribers on the drone to no
/// client without rights.
const CLIENT: &str = "client";

/// The messages that were received: their sender and key.
type Received = Arc<Mutex<BTreeSet<(String, String)>>>;

fn note(received: &Received, payload: &[u8], key: &str) {
    let sender = String::from_utf8_lossy(payload).into_owned();
    let mut received = received.lock().unwrap_or_else(PoisonError::into_inner);
    received.insert((sender, key.to_owned()));
}

fn is_received(received: &Received, sender: &str, key: &str) -> bool {
    let received = received.lock().unwrap_or_else(PoisonError::into_inner);
    received.contains(&(sender.to_owned(), key.to_owned()))
}

/// The drone: its relay, and a process on it that receives everything.
struct Drone {
    _relay: Node,
    inside: Session,
    published: Received,
    queried: Received,
    air: String,
}

async fn open(network: &Network, key_name: &str) -> anyhow::Result<Session> {
    opened(network.configuration(key_name)?).await
}

async fn opened(config: serde_json::Value) -> anyhow::Result<Session> {
    let config =
        zenoh::Config::from_json5(&config.to_string()).map_err(|cause| anyhow!("{cause}"))?;
    zenoh::open(config).await.map_err(|cause| anyhow!("{cause}"))
}

impl Drone {
    async fn start(keys: &Path) -> anyhow::Result<Self> {
        let ([meet], air, _) = ports::free()?;
        let air = format!("127.0.0.1:{air}");
        let network = Network {
            config: Some("drone".into()),
            listen: Some(air.clone()),
            meet: Some(meet),
            keys: Some(keys.to_owned()),
            ..Network::default()
        };
        let identity = Identity { service: "relay", instance: "drone".into() };
        let relay = Node::open(identity, &network.source("drone")?).await?;
        let local = Network { meet: Some(meet), ..Network::default() };
        let inside = open(&local, "controller").await?;
        let (published, queried) = (Received::default(), Received::default());
        let notes = Arc::clone(&published);
        inside
            .declare_subscriber("**")
            .callback(move |sample: Sample| {
                note(&notes, &sample.payload().to_bytes(), sample.key_expr().as_str());
            })
            .background()
            .await
            .map_err(|cause| anyhow!("{cause}"))?;
        let notes = Arc::clone(&queried);
        inside
            .declare_queryable("**")
            .callback(move |query: Query| {
                let payload = query.payload().map(|p| p.to_bytes().into_owned());
                note(&notes, &payload.unwrap_or_default(), query.key_expr().as_str());
            })
            .background()
            .await
            .map_err(|cause| anyhow!("{cause}"))?;
        Ok(Self { _relay: relay, inside, published, queried, air })
    }

    /// A client on the ground.
    async fn client(
        &self,
        keys: Option<&Path>,
        key_name: &str,
        mode: &str,
    ) -> anyhow::Result<Client> {
        let network = Network {
            config: Some("ground".into()),
            connect: Some(self.air.clone()),
            keys: keys.map(Path::to_owned),
            ..Network::default()
        };
        let mut config = network.configuration(key_name)?;
        config["mode"] = mode.into();
        if mode == CLIENT {
            config["listen"]["endpoints"] = serde_json::json!([]);
        }
        let session = opened(config).await?;
        let received = Received::default();
        // Each key on its own: a client that may not subscribe to all of them may subscribe to some.
        for key in all_keys().keys() {
            let notes = Arc::clone(&received);
            session
                .declare_subscriber(key.as_str())
                .callback(move |sample: Sample| {
                    note(&notes, &sample.payload().to_bytes(), sample.key_expr().as_str());
                })
                .background()
                .await
                .map_err(|cause| anyhow!("{cause}"))?;
        }
        Ok(Client { session, received })
    }
}

#[derive(Clone)]
struct Client {
    session: Session,
    received: Received,
}

impl Client {
    /// Publishes and queries on a key, with its name.
    async fn publish_and_query(&self, name: &str, key: &str) {
        drop(self.session.put(key, name).await);
        let get = self.session.get(key).payload(name).timeout(Duration::from_millis(200));
        drop(get.await);
    }
}

/// Every key of the topic table, of a detector `ground` and any other name `main`, with its row.
fn all_keys() -> BTreeMap<String, &'static messages::Row> {
    let filled = |row: &messages::Row| {
        let service = row.publishers.first().copied().unwrap_or_default();
        row.key
            .replace("{detector}", "ground")
            .replace("{service}", service)
            .replace("{camera}", "down")
            .replace("{recorder}", "main")
            .replace("{instance}", if service == "detector" { "ground" } else { "main" })
            .replace("{image}", "rings")
    };
    let rows = TOPICS.iter().filter(|row| row.message != "CommandReply");
    rows.map(|row| (filled(row), row)).collect()
}

/// The role in a certificate of a publisher in the topic table.
fn role_of(publisher: &str) -> &str {
    if publisher == "alight" { "operator" } else { publisher }
}

fn file_of(role: &str) -> String {
    node::access::key_name(role, "ground")
}

const ROLES: [&str; 10] = [
    "drone",
    "operator",
    "observer",
    "camera-pub",
    "detector.ground",
    "controller",
    "dashboard",
    "gcs-bridge",
    "recorder",
    "simulator",
];

/// Publishes on the ground a topic to which a gcs-bridge may subscribe and one to which it may not, until a changed bridge
/// has received the former; returns whether it received the latter as well.
async fn is_sent_a_forbidden_topic(
    drone: &Drone,
    home: &Path,
    ground: &Path,
) -> anyhow::Result<bool> {
    let network = Network {
        config: Some("ground".into()),
        connect: Some(drone.air.clone()),
        keys: Some(ground.to_owned()),
        ..Network::default()
    };
    let detector = open(&network, "detector.ground").await?;
    let changed = drone.client(Some(home), "gcs-bridge", PEER).await?;
    let (may, may_not) = ("detector/ground/detections", "detector/ground/ack");
    timeout(PATIENCE, async {
        let mut rounds = 0;
        // A while longer, as the two may come by two ways.
        while rounds < 20 {
            drop(detector.put(may, "ground").await);
            drop(detector.put(may_not, "ground").await);
            rounds += i32::from(is_received(&changed.received, "ground", may));
            sleep(PAUSE).await;
        }
    })
    .await
    .context("the changed gcs-bridge does not receive an allowed topic")?;
    let is_sent = is_received(&changed.received, "ground", may_not);
    for session in [detector, changed.session] {
        session.close().await.map_err(|cause| anyhow!("{cause}"))?;
    }
    Ok(is_sent)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_ground_process_with_the_list_sends_only_to_subscribers_with_the_right()
-> anyhow::Result<()> {
    let (home, plain) = (tempfile::tempdir()?, tempfile::tempdir()?);
    let authority = Authority::new()?;
    for role in ["drone", "detector.ground", "gcs-bridge"] {
        for folder in [home.path(), plain.path()] {
            authority.issue(folder, &format!("{role}@drone"))?;
        }
        common::list(home.path(), &format!("{role}@drone"))?;
    }
    let drone = Drone::start(home.path()).await?;
    let without = is_sent_a_forbidden_topic(&drone, home.path(), plain.path()).await?;
    let with = is_sent_a_forbidden_topic(&drone, home.path(), home.path()).await?;
    println!(
        "sent a topic to which it may not subscribe: without a list {without}, with it {with}"
    );
    ensure!(!with, "sent although the ground has the list");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_without_rights_are_refused_on_every_topic() -> anyhow::Result<()> {
    node::start_logging("off");
    let folders: Vec<_> = (0..5).map(|_| tempfile::tempdir()).collect::<Result<_, _>>()?;
    let [home, foreign, kestrel, revoked, spare] =
        [0, 1, 2, 3, 4].map(|index| folders[index].path());
    let authority = Authority::new()?;
    for role in ROLES {
        authority.issue(home, &format!("{role}@drone"))?;
        common::list(home, &format!("{role}@drone"))?;
    }
    for (folder, holder, line) in [
        (kestrel, "operator@kestrel", "operator@kestrel"),
        (kestrel, "detector.ground@kestrel", "detector.ground@kestrel"),
        (revoked, "operator.bob@drone", "revoked operator.bob@drone"),
        (spare, "detector.spare@drone", "detector.spare@drone"),
    ] {
        authority.issue(folder, holder)?;
        common::list(home, line)?;
    }
    Authority::new()?.issue(foreign, "operator@drone")?;
    let drone = Drone::start(home).await?;
    denied::take();

    // Clients whose connection is refused.
    let mut counted = BTreeMap::new();
    let no_key = drone.client(None, "operator", PEER).await?;
    let wrong_key = drone.client(Some(foreign), "operator", PEER).await?;
    let connection = "denied: a connection without a valid certificate";
    until(&mut counted, "two refused connections", async |counted| {
        counted.get(connection).is_some_and(|times| *times >= 2)
    })
    .await?;

    // Clients that are connected, with no rights or with other rights.
    // The first two have no rights, so the relay announces no subscribers to them: they send nothing, and their
    // connections are counted.
    let without_rights = "denied: a connection without rights, of another vehicle or revoked";
    let mut connected = Vec::new();
    for keys in [kestrel, revoked] {
        let mut counted = BTreeMap::new();
        denied::take();
        connected.push(drone.client(Some(keys), "operator", CLIENT).await?);
        until(&mut counted, "a connection without rights", async |counted| {
            counted.contains_key(without_rights)
        })
        .await?;
    }
    let [other_vehicle, revoked] =
        <[Client; 2]>::try_from(connected).map_err(|_| anyhow!("two clients were connected"))?;
    let observer = drone.client(Some(home), "observer", CLIENT).await?;
    let other_name = drone.client(Some(spare), "detector.spare", CLIENT).await?;
    let clients = [
        ("no key", &no_key),
        ("wrong key", &wrong_key),
        ("another vehicle's", &other_vehicle),
        ("revoked", &revoked),
        ("another role's", &observer),
        ("another detector's", &other_name),
    ];
    // Clients that may subscribe, each to the topics of its role.
    let mut subscribers = Vec::new();
    for service in ["camera-pub", "controller", "gcs-bridge", "simulator", "recorder"] {
        let file = file_of(role_of(service));
        subscribers.push((service, drone.client(Some(home), &file, CLIENT).await?));
    }
    let mut subscriptions = BTreeMap::new();
    until(&mut subscriptions, "refused subscriptions are counted", async |counted| {
        counted.keys().any(|reason| reason.starts_with("denied: declare subscriber"))
    })
    .await?;
    subscribers.push(("observer", observer.clone()));
    subscribers.push(("detector", other_name.clone()));
    let mut rows = Vec::new();
    let mut refused = 0;
    for (key, row) in &all_keys() {
        let is_query = row.delivery == Delivery::Query;
        // Messages of a client with the right arrive; otherwise the absence of the others' messages would prove nothing.
        let role = role_of(row.publishers.first().context("a publisher")?);
        let rightful = drone.client(Some(home), &file_of(role), CLIENT).await?;
        let received = if is_query { &drone.queried } else { &drone.published };
        until(&mut counted, &format!("{role} is received on {key}"), async |_| {
            rightful.publish_and_query("rightful", key).await;
            is_received(received, "rightful", key)
        })
        .await?;
        let action = if is_query { "query" } else { "put" };
        let reason = format!("denied: {action} on drone/{key}");
        denied::take();
        let mut refusals = BTreeMap::new();
        for (name, client) in clients {
            let has_rights = ["another role's", "another detector's"].contains(&name);
            until(&mut refusals, &format!("{name} is refused on {key}"), async |refusals| {
                client.publish_and_query(name, key).await;
                // The relay announces subscribers only to clients with some rights.
                !has_rights || refusals.remove(&reason).is_some()
            })
            .await?;
        }
        // Their messages do not arrive later either, and each client receives the topics of its role.
        let may_subscribe =
            |service: &str| MONITORS.contains(&service) || row.subscribers.contains(&service);
        until(&mut counted, &format!("each client with the right receives {key}"), async |_| {
            drop(drone.inside.put(key.as_str(), "inside").await);
            let mut allowed = subscribers.iter().filter(|(service, _)| may_subscribe(service));
            allowed.all(|(_, it)| is_received(&it.received, "inside", key))
        })
        .await?;
        let subscribed: Vec<&str> = subscribers
            .iter()
            .filter(|(_, it)| is_received(&it.received, "inside", key))
            .map(|(service, _)| *service)
            .collect();
        for (service, _) in &subscribers {
            let receives = subscribed.contains(service);
            ensure!(receives == may_subscribe(service), "{service} on {key}: receives: {receives}");
            refused += usize::from(!receives);
        }
        let mut cells = Vec::new();
        for (name, client) in clients {
            let has_arrived = is_received(received, name, key);
            ensure!(!has_arrived, "{name}: {action} on {key} has arrived");
            let receives = is_received(&client.received, "inside", key);
            let has_rights = ["another role's", "another detector's"].contains(&name);
            ensure!(!receives || has_rights, "{name} on {key}: receives");
            cells.push(if receives { "refused; receives" } else { "refused; receives nothing" });
        }
        let subscribed = subscribed.join(", ");
        rows.push(format!("| `{key}` | {action} | {} | {subscribed} |", cells.join(" | ")));
    }
    ensure!(refused > 50, "only {refused} subscriptions were refused");
    let denied_subscriptions = subscriptions
        .iter()
        .filter(|(reason, _)| reason.starts_with("denied: declare subscriber on drone/"));
    let denied_subscriptions = denied_subscriptions.count();
    ensure!(denied_subscriptions > 10, "counted subscriptions: {subscriptions:?}");
    let names: Vec<&str> = clients.iter().map(|(name, _)| *name).collect();
    println!("| key | what | {} | subscribers |", names.join(" | "));
    println!("|---|---|{}---|", "---|".repeat(names.len()));
    rows.iter().for_each(|row| println!("{row}"));
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn an_encrypted_link_takes_the_cipher_that_needs_no_change_of_keys() -> anyhow::Result<()> {
    let home = tempfile::tempdir()?;
    Authority::new()?.issue(home.path(), "drone@drone")?;
    common::list(home.path(), "drone@drone")?;
    let drone = Drone::start(home.path()).await?;
    let file = |name: &str| home.path().join(name);
    let mut roots = RootCertStore::empty();
    roots.add(CertificateDer::from_pem_file(file(AUTHORITY))?)?;
    let own = vec![CertificateDer::from_pem_file(file("drone.pem"))?];
    let private = PrivateKeyDer::from_pem_file(file("drone.key"))?;
    // A client that would take any.
    let config = ClientConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()?
        .with_root_certificates(roots)
        .with_client_auth_cert(own, private)?;
    let mut client = ClientConnection::new(Arc::new(config), ServerName::try_from("127.0.0.1")?)?;
    let mut stream = TcpStream::connect(&drone.air)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    tokio::task::block_in_place(|| {
        while client.is_handshaking() {
            client.complete_io(&mut stream)?;
        }
        anyhow::Ok(())
    })?;
    let is_without_limit = |suite: &SupportedCipherSuite| {
        suite.tls13().is_some_and(|it| it.common.confidentiality_limit == u64::MAX)
    };
    let taken = client.negotiated_cipher_suite().context("a cipher")?;
    ensure!(is_without_limit(&taken), "{taken:?}");
    // The ciphers that our own connections offer.
    let offered = &CryptoProvider::get_default().context("a default")?.cipher_suites;
    ensure!(!offered.is_empty() && offered.iter().all(is_without_limit), "{offered:?}");
    Ok(())
}

/// Repeats an attempt until it succeeds, and counts the denials meanwhile.
async fn until(
    counted: &mut BTreeMap<String, u64>,
    what: &str,
    mut attempt: impl AsyncFnMut(&mut BTreeMap<String, u64>) -> bool,
) -> anyhow::Result<()> {
    let succeeded = async {
        loop {
            for (reason, times) in denied::take() {
                *counted.entry(reason).or_insert(0) += times;
            }
            if attempt(counted).await {
                return;
            }
            sleep(PAUSE).await;
        }
    };
    let outcome = timeout(PATIENCE, succeeded).await;
    outcome.with_context(|| format!("waiting until {what}; denied so far: {counted:?}"))
}
