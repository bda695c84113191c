//! A service's place on the network: its session, its name, its presence and that of others.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use messages::topic;
use zenoh::handlers::RingChannelHandler;
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Sample, SampleKind};

use crate::clock::now_ns;
use crate::health::HealthCounters;

/// The configuration for one machine, used unless another is named.
pub const LOCAL_CONFIG: &str = include_str!("../../../zenoh-config/local.json5");

/// The port at which the processes of one machine meet, by [`LOCAL_CONFIG`].
pub const LOCAL_PORT: u16 = 7447;

/// [`LOCAL_CONFIG`] with another meeting point.
pub fn local_config(port: u16) -> String {
    LOCAL_CONFIG.replace(&format!(":{LOCAL_PORT}"), &format!(":{port}"))
}

/// Comings and goings a mailbox keeps.
const PRESENCE_DEPTH: usize = 256;

/// How long a question about presence may take.
const PRESENCE_TIMEOUT: Duration = Duration::from_millis(500);

/// Pauses before each look for others of the same kind. A session that is new meets the others one by one, through the
/// meeting point, and knows of nobody whom it has not met.
const GREETING: [Duration; 3] =
    [Duration::ZERO, Duration::from_millis(200), Duration::from_millis(500)];

/// How long leaving the network may take.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(300);

/// Which service this is, and which one of them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Identity {
    /// The service.
    pub service: &'static str,
    /// The instance: a name without slashes.
    pub instance: String,
}

impl std::fmt::Display for Identity {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} `{}`", self.service, self.instance)
    }
}

/// Where the session's configuration comes from.
#[derive(Clone, Debug, Default)]
pub enum ZenohSource {
    /// [`LOCAL_CONFIG`].
    #[default]
    Local,
    /// A JSON5 file.
    File(PathBuf),
    /// JSON5 text.
    Text(String),
}

/// A service on the network. Clones share the session.
#[derive(Clone)]
pub struct Node {
    pub(crate) session: zenoh::Session,
    identity: Arc<Identity>,
    health: Arc<HealthCounters>,
    token: Arc<Mutex<Option<LivelinessToken>>>,
    /// Held from before the look for others until the service is announced.
    claim: Arc<Mutex<Option<LivelinessToken>>>,
    started_ns: i64,
}

/// Tells who comes and goes.
pub struct Presence {
    subscriber: zenoh::pubsub::Subscriber<RingChannelHandler<Sample>>,
}

impl Node {
    /// Opens the session. The service is not announced before [`Node::announce`].
    ///
    /// # Errors
    /// When the configuration cannot be read or the session not opened; the message names the file.
    pub async fn open(identity: Identity, source: &ZenohSource) -> anyhow::Result<Self> {
        let config = zenoh_config(source)?;
        let session = zenoh::open(config)
            .await
            .map_err(|cause| anyhow!("opening the Zenoh session of {identity}: {cause}"))?;
        Ok(Self {
            session,
            identity: Arc::new(identity),
            health: Arc::default(),
            token: Arc::default(),
            claim: Arc::default(),
            started_ns: now_ns(),
        })
    }

    /// Who this is.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The service's counters.
    pub fn health(&self) -> &HealthCounters {
        &self.health
    }

    /// The counters, to be kept by a thread.
    pub fn shared_health(&self) -> Arc<HealthCounters> {
        Arc::clone(&self.health)
    }

    /// Stops with an error when a service of this kind is there already whose instance `matches` (`*` for any), or
    /// starts in the same moment and goes first.
    ///
    /// The intention is told before the others are looked for, so that of two that start at once at least one sees
    /// the other; the one whose name and session come first goes on.
    ///
    /// # Errors
    /// Names the other instance.
    pub async fn ensure_alone(&self, matches: &str) -> anyhow::Result<()> {
        let service = self.identity.service;
        let ours = (self.identity.instance.clone(), self.session.zid().to_string());
        let claim = self.declare(&topic::claim_key(service, &ours.0, &ours.1)).await?;
        *self.claim.lock().unwrap_or_else(PoisonError::into_inner) = Some(claim);
        for pause in GREETING {
            tokio::time::sleep(pause).await;
            match self.alive(service, matches).await?.first() {
                None => {}
                Some(other) if matches == "*" => bail!(
                    "another {service} (`{other}`) is at work for this vehicle; stop it first, or give this one another vehicle (`namespace` in the Zenoh configuration)"
                ),
                Some(other) => bail!(
                    "another {service} is called `{other}` already; give this one another name with `--set id=...`"
                ),
            }
            let claims = self.tokens(&topic::claim_key(service, matches, "*")).await?;
            if let Some((other, _)) =
                claims.iter().filter_map(|key| claim_of(key)).find(|it| *it < ours)
            {
                bail!("another {service} (`{other}`) starts in the same moment and goes first");
            }
        }
        Ok(())
    }

    /// The instances of a service that are ready, by liveliness.
    ///
    /// # Errors
    /// When the question cannot be asked.
    pub async fn alive(&self, service: &str, instance: &str) -> anyhow::Result<Vec<String>> {
        let keys = self.tokens(&topic::alive_key(service, instance)).await?;
        Ok(keys.iter().filter_map(|key| instance_of(key)).collect())
    }

    /// The keys of the liveliness tokens that match.
    async fn tokens(&self, key: &str) -> anyhow::Result<Vec<String>> {
        let replies = self
            .session
            .liveliness()
            .get(key)
            .timeout(PRESENCE_TIMEOUT)
            .await
            .map_err(|cause| anyhow!("asking who is at {key}: {cause}"))?;
        let mut keys = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            keys.extend(reply.result().map(|sample| sample.key_expr().as_str().to_owned()));
        }
        Ok(keys)
    }

    /// Everybody who is ready, by liveliness: service and instance.
    ///
    /// # Errors
    /// When the question cannot be asked.
    pub async fn everybody(&self) -> anyhow::Result<Vec<(String, String)>> {
        let key = topic::alive_key("*", "*");
        let replies = self
            .session
            .liveliness()
            .get(&key)
            .timeout(PRESENCE_TIMEOUT)
            .await
            .map_err(|cause| anyhow!("asking who is at {key}: {cause}"))?;
        let mut everybody = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            let key = reply.result().ok().map(|sample| sample.key_expr().as_str().to_owned());
            let mut chunks = key.iter().flat_map(|key| key.rsplit('/'));
            if let (Some(instance), Some(service)) = (chunks.next(), chunks.next()) {
                everybody.push((service.to_owned(), instance.to_owned()));
            }
        }
        everybody.sort();
        everybody.dedup();
        Ok(everybody)
    }

    /// How long a question to an instance and its answer took, or nothing when it did not answer within `patience`.
    pub async fn round_trip(
        &self,
        service: &str,
        instance: &str,
        patience: Duration,
    ) -> Option<Duration> {
        let key = topic::HEALTH.key(&[service, instance]);
        let began = std::time::Instant::now();
        // With what steers, not behind the frames.
        let get = self.session.get(key).priority(zenoh::qos::Priority::InteractiveHigh);
        let replies = get.timeout(patience).await.ok()?;
        let reply = replies.recv_async().await.ok()?;
        reply.result().is_ok().then(|| began.elapsed())
    }

    /// Tells everybody that the service is ready.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn announce(&self) -> anyhow::Result<()> {
        let key = topic::alive_key(self.identity.service, &self.identity.instance);
        let token = self.declare(&key).await?;
        *self.token.lock().unwrap_or_else(PoisonError::into_inner) = Some(token);
        // From here on the announcement says the same.
        drop(self.claim.lock().unwrap_or_else(PoisonError::into_inner).take());
        tracing::info!(service = self.identity.service, instance = %self.identity.instance, "Ready");
        Ok(())
    }

    async fn declare(&self, key: &str) -> anyhow::Result<LivelinessToken> {
        let token = self.session.liveliness().declare_token(key).await;
        token.map_err(|cause| anyhow!("declaring {key}: {cause}"))
    }

    /// Follows the comings and goings of a service's instances, beginning with those that are there.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn presence(&self, service: &str) -> anyhow::Result<Presence> {
        let key = topic::alive_key(service, "*");
        let subscriber = self
            .session
            .liveliness()
            .declare_subscriber(&key)
            .history(true)
            .with(zenoh::handlers::RingChannel::new(PRESENCE_DEPTH))
            .await
            .map_err(|cause| anyhow!("watching {key}: {cause}"))?;
        Ok(Presence { subscriber })
    }

    /// Publishes the service's health once a second, for ever.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn publish_health(&self) -> anyhow::Result<()> {
        let names = [self.identity.service, self.identity.instance.as_str()];
        let publisher = self.publisher(topic::HEALTH, &names).await?;
        let mut second = tokio::time::interval(Duration::from_secs(1));
        loop {
            second.tick().await;
            publisher.publish(&self.health.report(&self.identity, self.started_ns)).await;
        }
    }

    /// Leaves the network in good order.
    ///
    /// A session that still waits for the meeting point would take its own time; the process' end closes what is left.
    pub async fn close(self) {
        match tokio::time::timeout(CLOSE_TIMEOUT, self.session.close()).await {
            Ok(Ok(())) => {}
            Ok(Err(cause)) => tracing::debug!(%cause, "The session did not close in good order"),
            Err(_) => tracing::debug!("The session is closed by the end of the process"),
        }
    }
}

impl Presence {
    /// The next change: an instance, and whether it is there now. `None` once the session is closed.
    pub async fn next(&self) -> Option<(String, bool)> {
        loop {
            let sample = self.subscriber.recv_async().await.ok()?;
            if let Some(instance) = instance_of(sample.key_expr().as_str()) {
                return Some((instance, sample.kind() == SampleKind::Put));
            }
        }
    }
}

fn instance_of(key: &str) -> Option<String> {
    key.rsplit('/').next().map(str::to_owned)
}

/// Instance and session of a claim.
fn claim_of(key: &str) -> Option<(String, String)> {
    let mut chunks = key.rsplit('/');
    let session = chunks.next()?;
    Some((chunks.next()?.to_owned(), session.to_owned()))
}

fn zenoh_config(source: &ZenohSource) -> anyhow::Result<zenoh::Config> {
    let (name, text) = match source {
        ZenohSource::Local => ("the built-in local.json5".to_owned(), LOCAL_CONFIG.to_owned()),
        ZenohSource::Text(text) => ("the Zenoh configuration".to_owned(), text.clone()),
        ZenohSource::File(path) => (path.display().to_string(), read(path)?),
    };
    zenoh::Config::from_json5(&text)
        .map_err(|cause| anyhow!("{name} is not a Zenoh configuration: {cause}"))
}

fn read(path: &Path) -> anyhow::Result<String> {
    std::fs::read_to_string(path)
        .with_context(|| format!("reading the Zenoh configuration {path:?}"))
}
