//! Puts a process on Zenoh's network: opens the session, claims a unique name, declares its presence, or that of services whose recording
//! is played, and follows that of others.

use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use messages::{Configuration, topic};
use tokio::sync::watch;
use zenoh::handlers::RingChannelHandler;
use zenoh::liveliness::LivelinessToken;
use zenoh::sample::{Sample, SampleKind};

use crate::boxed::BoxFuture;
use crate::cipher;
use crate::clock::{host_name, now_ns};
use crate::foreign;
use crate::halt;
use crate::health::HealthCounters;
use crate::identity::Identity;
use crate::memory::lack_of_shared_memory;
use crate::reach::Reach;
use crate::sender;
use crate::version::version;

/// The configuration for one machine, the default.
pub const LOCAL_CONFIG: &str = include_str!("../../../zenoh-config/local.json5");

/// The rendezvous port of one machine in [`LOCAL_CONFIG`].
pub const LOCAL_PORT: u16 = 7447;

/// [`LOCAL_CONFIG`] with another rendezvous port.
pub fn local_config(port: u16) -> String {
    LOCAL_CONFIG.replace(&format!(":{LOCAL_PORT}"), &format!(":{port}"))
}

/// The name of a relay as a service.
pub const RELAY: &str = "relay";

/// Presence changes that a mailbox keeps.
const PRESENCE_DEPTH: usize = 256;

/// Timeout of a presence query.
const PRESENCE_TIMEOUT: Duration = Duration::from_millis(500);

/// Delays before each check for other instances. A new session learns of the others one by one, through the
/// rendezvous, so that a single early check would miss some.
const CLAIM_CHECK_DELAYS: [Duration; 3] =
    [Duration::ZERO, Duration::from_millis(200), Duration::from_millis(500)];

/// Period of a service's configuration.
const CONFIGURATION_PERIOD: Duration = Duration::from_secs(3);
/// Period in which a service that will publish it checks whether it is announced.
const ANNOUNCED_PERIOD: Duration = Duration::from_millis(100);

/// Timeout for closing the session.
const CLOSE_TIMEOUT: Duration = Duration::from_millis(300);

/// The source of the session's configuration.
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
    pub(crate) has_shared_memory: bool,
    identity: Arc<Identity>,
    health: Arc<HealthCounters>,
    token: Arc<Mutex<Option<LivelinessToken>>>,
    /// Held from before the check for other instances until the service is announced.
    claim: Arc<Mutex<Option<LivelinessToken>>>,
    /// The configuration that the service has changed to, as TOML; `None` while it is that of its start.
    changed: Arc<watch::Sender<Option<String>>>,
    reach: Arc<Reach>,
    started_ns: i64,
}

/// Another service that is shown as ready.
pub struct Announcement {
    _token: LivelinessToken,
}

/// Follows which instances join and leave.
pub struct Presence {
    subscriber: zenoh::pubsub::Subscriber<RingChannelHandler<Sample>>,
}

impl Node {
    /// Opens the session of a service, which continues where another program answers: it connects once the right one is there.
    /// The service is not announced before [`Node::announce`].
    ///
    /// # Errors
    /// When the configuration cannot be read, or the session cannot be opened.
    pub fn open(identity: Identity, source: &ZenohSource) -> BoxFuture<'_, anyhow::Result<Self>> {
        Box::pin(async move {
            let config = zenoh_config(source)?;
            foreign::watch(&config);
            Self::open_with(identity, config).await
        })
    }

    /// Opens the session of a tool, which ends soon: it is refused where another program answers.
    ///
    /// # Errors
    /// When the configuration cannot be read, another program answers wherever it connects, or the session cannot be opened.
    pub fn open_tool(
        identity: Identity,
        source: &ZenohSource,
    ) -> BoxFuture<'_, anyhow::Result<Self>> {
        Box::pin(async move {
            let config = zenoh_config(source)?;
            foreign::refuse(&config)
                .await
                .with_context(|| format!("{identity} cannot join the network"))?;
            Self::open_with(identity, config).await
        })
    }

    async fn open_with(identity: Identity, mut config: zenoh::Config) -> anyhow::Result<Self> {
        let has_shared_memory = share_memory(&mut config)?;
        let reach = Arc::new(Reach::of(&config));
        cipher::choose();
        halt::session_opens();
        let session = zenoh::open(config)
            .await
            .map_err(|cause| anyhow!("opening the Zenoh session of {identity}: {cause}"))?;
        Ok(Self {
            session,
            has_shared_memory,
            identity: Arc::new(identity),
            health: Arc::default(),
            token: Arc::default(),
            claim: Arc::default(),
            changed: Arc::new(watch::Sender::new(None)),
            reach,
            started_ns: now_ns(),
        })
    }

    /// The name of this process as a sender of commands.
    pub(crate) fn sender(&self) -> String {
        sender::name(&self.identity, self.reach.certificate())
    }

    /// The identity of this process.
    pub fn identity(&self) -> &Identity {
        &self.identity
    }

    /// The name of the vehicle to whose processes it connects.
    pub fn vehicle(&self) -> &str {
        self.reach.vehicle()
    }

    /// The service's counters.
    pub fn health(&self) -> &HealthCounters {
        &self.health
    }

    /// The counters, for a thread.
    pub fn shared_health(&self) -> Arc<HealthCounters> {
        Arc::clone(&self.health)
    }

    /// Claims the name of this instance: fails when an instance of this service that `matches` (`*` for any)
    /// is running, or is starting at the same time and has priority.
    ///
    /// The claim is declared before the check, so that of two that start at once at least one sees the other;
    /// the one whose name and session id sort first has priority.
    ///
    /// # Errors
    /// Names the other instance.
    pub fn claim_unique_name<'a>(&'a self, matches: &'a str) -> BoxFuture<'a, anyhow::Result<()>> {
        Box::pin(async move {
            let service = self.identity.service;
            let ours = (self.identity.instance.clone(), self.session.zid().to_string());
            let claim = self.declare(&topic::claim_key(service, &ours.0, &ours.1)).await?;
            *self.claim.lock().unwrap_or_else(PoisonError::into_inner) = Some(claim);
            for delay in CLAIM_CHECK_DELAYS {
                tokio::time::sleep(delay).await;
                match self.alive(service, matches).await?.first() {
                    None => {}
                    Some(other) if matches == "*" => bail!(
                        "another {service} (`{other}`) is running for this vehicle; stop it first, or set another vehicle (`namespace` in the Zenoh configuration)"
                    ),
                    Some(other) => bail!(
                        "another {service} has the name `{other}` already ({}); choose another with `--set id=...`, or join another network \
                         (`--meet`, `--vehicle`, or ALIGHT_MEET and ALIGHT_VEHICLE)",
                        self.reach.network()
                    ),
                }
                let claims = self.tokens(&topic::claim_key(service, matches, "*")).await?;
                if let Some((other, _)) =
                    claims.iter().filter_map(|key| last_two(key)).find(|it| *it < ours)
                {
                    bail!(
                        "another {service} (`{other}`) is starting at the same time and has priority"
                    );
                }
            }
            Ok(())
        })
    }

    /// The instances of a service that are ready, by liveliness.
    ///
    /// # Errors
    /// When the query fails.
    pub fn alive<'a>(
        &'a self,
        service: &'a str,
        instance: &'a str,
    ) -> BoxFuture<'a, anyhow::Result<Vec<String>>> {
        Box::pin(async move {
            let keys = self.tokens(&topic::alive_key(service, instance)).await?;
            Ok(keys.iter().filter_map(|key| instance_of(key)).collect())
        })
    }

    /// The keys of the liveliness tokens that match.
    async fn tokens(&self, key: &str) -> anyhow::Result<Vec<String>> {
        let replies = self
            .session
            .liveliness()
            .get(key)
            .timeout(PRESENCE_TIMEOUT)
            .await
            .map_err(|cause| anyhow!("querying the liveliness of {key}: {cause}"))?;
        let mut keys = Vec::new();
        while let Ok(reply) = replies.recv_async().await {
            keys.extend(reply.result().map(|sample| sample.key_expr().as_str().to_owned()));
        }
        Ok(keys)
    }

    /// All services that are ready, by liveliness: service and instance, sorted.
    ///
    /// # Errors
    /// When the query fails.
    pub fn list_peers(&self) -> BoxFuture<'_, anyhow::Result<Vec<(String, String)>>> {
        Box::pin(async move {
            let keys = self.tokens(&topic::alive_key("*", "*")).await?;
            let mut peers: Vec<_> = keys.iter().filter_map(|key| last_two(key)).collect();
            peers.sort();
            peers.dedup();
            Ok(peers)
        })
    }

    /// The reason why a service, or its instance of this name, does not answer, and a remedy: for a tool that gives up.
    pub fn explain_silence<'a>(
        &'a self,
        service: &'a str,
        wanted: Option<&'a str>,
    ) -> BoxFuture<'a, String> {
        Box::pin(async move {
            let ready = self.list_peers().await.unwrap_or_default();
            if ready.is_empty() {
                return self.reach.explain().await;
            }
            let is_wanted = |(name, id): &(String, String)| {
                name == service && wanted.is_none_or(|wanted| wanted == id)
            };
            if ready.iter().any(is_wanted) {
                let role = match self.reach.certificate() {
                    Some(_) => ", or the role of this key may not command",
                    None => "",
                };
                return format!("the {service} is there: it is stopped, or too busy{role}");
            }
            // Each process that may be present chooses its name.
            let names = ready.iter().map(|(name, id)| format!("{name} `{id}`"));
            let names: Vec<_> = names.map(|name| sender::shown(&name)).collect();
            let vehicle = self.reach.vehicle();
            let only = format!("of the vehicle `{vehicle}` there is only {}", names.join(", "));
            // Without a relay in sight, these are processes of this machine, which need none.
            if ready.iter().any(|(name, _)| name == RELAY) {
                return only;
            }
            match self.reach.explain_others().await {
                Some(why) => format!("{only}; {why}"),
                None => only,
            }
        })
    }

    /// The round-trip time of a query to an instance; `None` without a reply within `timeout`.
    pub fn round_trip<'a>(
        &'a self,
        service: &'a str,
        instance: &'a str,
        timeout: Duration,
    ) -> BoxFuture<'a, Option<Duration>> {
        Box::pin(async move {
            let key = topic::HEALTH.key(&[service, instance]);
            let began = std::time::Instant::now();
            // With the priority of commands, so that frames do not delay it.
            let get = self.session.get(key).priority(zenoh::qos::Priority::InteractiveHigh);
            let replies = get.timeout(timeout).await.ok()?;
            let reply = replies.recv_async().await.ok()?;
            reply.result().is_ok().then(|| began.elapsed())
        })
    }

    /// Announces that the service is ready.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn announce(&self) -> BoxFuture<'_, anyhow::Result<()>> {
        self.announce_as("Ready")
    }

    /// Announces that the service is there, and logs its state or what it waits for; a service logs later changes itself.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn announce_as<'a>(&'a self, state: &'a str) -> BoxFuture<'a, anyhow::Result<()>> {
        Box::pin(async move {
            let key = topic::alive_key(self.identity.service, &self.identity.instance);
            let token = self.declare(&key).await?;
            *self.token.lock().unwrap_or_else(PoisonError::into_inner) = Some(token);
            // The announcement replaces the claim.
            drop(self.claim.lock().unwrap_or_else(PoisonError::into_inner).take());
            tracing::info!(service = self.identity.service, instance = %self.identity.instance, "{state}");
            Ok(())
        })
    }

    /// Shows another service as ready for as long as the result lives: one of a recording that is published again.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn announce_other<'a>(
        &'a self,
        service: &'a str,
        instance: &'a str,
    ) -> BoxFuture<'a, anyhow::Result<Announcement>> {
        Box::pin(async move {
            Ok(Announcement { _token: self.declare(&topic::alive_key(service, instance)).await? })
        })
    }

    async fn declare(&self, key: &str) -> anyhow::Result<LivelinessToken> {
        let token = self.session.liveliness().declare_token(key).await;
        token.map_err(|cause| anyhow!("declaring {key}: {cause}"))
    }

    /// Follows which instances of a service join and leave, beginning with those that are ready.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn presence<'a>(&'a self, service: &'a str) -> BoxFuture<'a, anyhow::Result<Presence>> {
        Box::pin(async move {
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
        })
    }

    /// Publishes the service's health once a second, until it fails.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn publish_health(&self) -> BoxFuture<'_, anyhow::Result<()>> {
        Box::pin(async move {
            let names = [self.identity.service, self.identity.instance.as_str()];
            let publisher = self.publisher(topic::HEALTH, &names).await?;
            let mut second = tokio::time::interval(Duration::from_secs(1));
            loop {
                second.tick().await;
                publisher.publish(&self.health.report(&self.identity, self.started_ns)).await;
            }
        })
    }

    /// The service has changed its configuration to this TOML: [`Node::publish_configuration`] publishes it at once.
    pub fn configuration_changed(&self, toml: String) {
        self.changed.send_replace(Some(toml));
    }

    /// Publishes the service's configuration once it is announced, when it changes, and every few seconds for late
    /// subscribers, until it fails. One that is refused its name publishes none.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn publish_configuration(&self, toml: String) -> BoxFuture<'_, anyhow::Result<()>> {
        Box::pin(async move {
            while self.token.lock().unwrap_or_else(PoisonError::into_inner).is_none() {
                tokio::time::sleep(ANNOUNCED_PERIOD).await;
            }
            let names = [self.identity.service, self.identity.instance.as_str()];
            let publisher = self.publisher(topic::CONFIGURATION, &names).await?;
            let mut configuration = Configuration {
                service: self.identity.service.to_owned(),
                instance: self.identity.instance.clone(),
                host: host_name(),
                version: version().to_owned(),
                toml,
            };
            let mut due = tokio::time::interval(CONFIGURATION_PERIOD);
            let mut changed = self.changed.subscribe();
            loop {
                tokio::select! {
                    _ = due.tick() => {}
                    // The sender lives as long as this node.
                    _ = changed.changed() => {}
                }
                if let Some(toml) = changed.borrow_and_update().clone() {
                    configuration.toml = toml;
                }
                publisher.publish(&configuration).await;
            }
        })
    }

    /// Closes the session.
    ///
    /// A session that still waits for the rendezvous can take long to close; the end of the process then
    /// closes it.
    pub fn close(self) -> BoxFuture<'static, ()> {
        Box::pin(async move {
            // All of it is kept until then: its tokens are undeclared by the session's end.
            let node = self;
            match tokio::time::timeout(CLOSE_TIMEOUT, node.session.close()).await {
                Ok(Ok(())) => {}
                Ok(Err(cause)) => tracing::debug!(%cause, "Zenoh session did not close cleanly"),
                Err(_) => {
                    tracing::debug!("Zenoh session left to be closed by the end of the process");
                }
            }
        })
    }
}

impl Presence {
    /// The next change: an instance, and whether it is ready. `None` once the session is closed.
    pub fn next(&self) -> BoxFuture<'_, Option<(String, bool)>> {
        Box::pin(async move {
            loop {
                let sample = self.subscriber.recv_async().await.ok()?;
                if let Some(instance) = instance_of(sample.key_expr().as_str()) {
                    return Some((instance, sample.kind() == SampleKind::Put));
                }
            }
        })
    }
}

fn instance_of(key: &str) -> Option<String> {
    key.rsplit('/').next().map(str::to_owned)
}

/// The last two chunks of a key: service and instance, or instance and session of a claim.
fn last_two(key: &str) -> Option<(String, String)> {
    let mut chunks = key.rsplit('/');
    let last = chunks.next()?;
    Some((chunks.next()?.to_owned(), last.to_owned()))
}

/// Whether the session shares memory. It does not where it cannot, and then frames are copied.
fn share_memory(config: &mut zenoh::Config) -> anyhow::Result<bool> {
    let enabled = "transport/shared_memory/enabled";
    let is_wanted = config.get_json(enabled).is_ok_and(|value| value == "true");
    let Some(lack) = is_wanted.then(lack_of_shared_memory).flatten() else { return Ok(is_wanted) };
    tracing::warn!("No shared memory; frames are copied instead: {lack}");
    // It would be set up as the session opens, whether enabled or not.
    for (key, value) in [(enabled, "false"), ("transport/shared_memory/mode", "\"lazy\"")] {
        let set = config.insert_json5(key, value);
        set.map_err(|cause| anyhow!("leaving shared memory out of the session: {cause}"))?;
    }
    Ok(false)
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
