//! Typed publishers, subscribers with a ring as mailbox, last values for late subscribers, and commands with their replies
//! and deadlines, on the keys of the topic table.
//!
//! Every mailbox is a ring: a slow reader loses the oldest messages, and never blocks a publisher.
//!
//! A command is not carried out once its requester has given up. Clocks of two hosts differ, so the requester asks the
//! recipient for its time first, and sends this time with the command, by the recipient's clock. A recipient that is
//! frozen does not answer, and a command that waited on a link is refused.

use std::marker::PhantomData;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::anyhow;
use messages::{DecodeError, Delivery, Message, Row, Topic, decode, encode};
use zenoh::bytes::ZBytes;
use zenoh::handlers::{RingChannel, RingChannelHandler};
use zenoh::qos::{CongestionControl, Priority};
use zenoh::query::{ConsolidationMode, QuerierBuilder, Query, Queryable};
use zenoh::sample::Sample;
use zenoh::session::SessionGetBuilder;

use crate::boxed::BoxFuture;
use crate::clock::now_ns;
use crate::health::{HealthCounters, Unlogged};
use crate::sender;
use crate::session::Node;

/// Timeout of the reply to a query.
pub(crate) const REPLY_TIMEOUT: Duration = Duration::from_secs(2);
/// Pause before a command without a recipient is sent again.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// Letters of a command in the log.
const MAX_LOGGED: usize = 200;
/// The parameter of a query's selector that names the sender of a command.
const SENDER: &str = "from";
/// The attachment of a query that asks for the recipient's time.
const ASKS_TIME: &[u8] = b"time?";

/// A mailbox of messages that are published on the keys that match.
pub(crate) type SampleMailbox = zenoh::pubsub::Subscriber<RingChannelHandler<Sample>>;
/// A mailbox of queries on a key.
pub(crate) type QueryMailbox = Queryable<RingChannelHandler<Query>>;

/// Publishes messages of one type on one key.
pub struct Publisher<M> {
    bytes: BytesPublisher,
    message: PhantomData<fn(M)>,
}

/// Publishes encoded messages on one key.
struct BytesPublisher {
    publisher: zenoh::pubsub::Publisher<'static>,
    /// Replies to late subscribers; only for states.
    last_value: Option<LastValue>,
    health: Arc<HealthCounters>,
}

/// The last value, and the queryable that sends it to late subscribers until this is dropped.
struct LastValue {
    bytes: Arc<Mutex<Vec<u8>>>,
    _queryable: Queryable<()>,
}

/// Receives messages of one type from the keys that match.
pub struct Subscriber<M> {
    subscriber: SampleMailbox,
    /// Last values from before the subscription.
    initial: Mutex<Vec<(String, M)>>,
    health: Arc<HealthCounters>,
    message: PhantomData<fn() -> M>,
}

/// A command, to be answered.
pub struct Request<M> {
    /// The command.
    pub message: M,
    /// When it was sent, in nanoseconds of this recipient's clock; `None` from a requester that has not requested this time.
    pub sent_ns: Option<i64>,
    /// The sender's name as it stated it, for a log.
    pub sender: String,
    query: Query,
}

/// The reply to a query.
enum Reply {
    Command(messages::CommandReply),
    /// The recipient's time, in nanoseconds of its clock.
    Time(i64),
}

/// Zenoh's quality of service for a delivery.
struct Qos {
    priority: Priority,
    congestion: CongestionControl,
    /// Capacity of a mailbox, in messages.
    depth: usize,
}

/// Nothing is published with `CongestionControl::Block`: a broken link would block the publisher, and with it
/// the messages to all others, until Zenoh closes the link. `Drop` waits at most a millisecond, and only when
/// the link's queue for this priority is full.
fn qos(delivery: Delivery) -> Qos {
    let (priority, congestion, depth) = match delivery {
        Delivery::Latest => (Priority::Data, CongestionControl::Drop, 4),
        // Room for the messages of all detectors at once.
        Delivery::LatestPriority => (Priority::RealTime, CongestionControl::Drop, 64),
        Delivery::LastValue => (Priority::InteractiveHigh, CongestionControl::Drop, 64),
        Delivery::Reliable => (Priority::InteractiveLow, CongestionControl::Drop, 512),
        // On the air link with the frames, and not with control: data that waited for a late recorder are large.
        Delivery::Record => (Priority::Data, CongestionControl::Drop, 512),
        Delivery::Query => (Priority::InteractiveHigh, CongestionControl::Drop, 16),
    };
    Qos { priority, congestion, depth }
}

impl Node {
    /// A publisher on the topic's key with its placeholders filled in.
    ///
    /// # Errors
    /// When the session is closed or a name makes no key.
    pub async fn publisher<M: Message>(
        &self,
        topic: Topic<M>,
        names: &[&str],
    ) -> anyhow::Result<Publisher<M>> {
        let bytes = self.bytes_publisher(topic.key(names), topic.delivery()).await?;
        Ok(Publisher { bytes, message: PhantomData })
    }

    /// A publisher of messages that are encoded already, on a key of the row's topic.
    ///
    /// # Errors
    /// When the session is closed or the key is invalid.
    pub async fn encoded_publisher(
        &self,
        row: &Row,
        key: &str,
    ) -> anyhow::Result<Publisher<Vec<u8>>> {
        let bytes = self.bytes_publisher(key.to_owned(), row.delivery).await?;
        Ok(Publisher { bytes, message: PhantomData })
    }

    fn bytes_publisher(
        &self,
        key: String,
        delivery: Delivery,
    ) -> BoxFuture<'_, anyhow::Result<BytesPublisher>> {
        Box::pin(async move {
            let Qos { priority, congestion, .. } = qos(delivery);
            let publisher = self
                .session
                .declare_publisher(key.clone())
                .priority(priority)
                .congestion_control(congestion)
                .await
                .map_err(|cause| anyhow!("declaring a publisher on {key}: {cause}"))?;
            let last_value = match delivery {
                Delivery::LastValue => Some(self.last_value(&key).await?),
                Delivery::Latest
                | Delivery::LatestPriority
                | Delivery::Reliable
                | Delivery::Record
                | Delivery::Query => None,
            };
            Ok(BytesPublisher { publisher, last_value, health: self.shared_health() })
        })
    }

    async fn last_value(&self, key: &str) -> anyhow::Result<LastValue> {
        let bytes = Arc::new(Mutex::new(Vec::new()));
        let kept = Arc::clone(&bytes);
        // Replies on its own key, not on that of the query: of several replies on one key only one arrives.
        let own_key = key.to_owned();
        let reply = move |query: Query| {
            let bytes: Vec<u8> = kept.lock().unwrap_or_else(PoisonError::into_inner).clone();
            if !bytes.is_empty() {
                // The requester may be gone.
                drop(zenoh::Wait::wait(query.reply(own_key.as_str(), bytes)));
            }
        };
        let queryable = self
            .session
            .declare_queryable(key.to_owned())
            .callback(reply)
            .await
            .map_err(|cause| anyhow!("declaring the last value of {key}: {cause}"))?;
        Ok(LastValue { bytes, _queryable: queryable })
    }

    /// A subscriber to the topic's keys; omitted names match any.
    ///
    /// # Errors
    /// When the session is closed.
    pub async fn subscriber<M: Message>(
        &self,
        topic: Topic<M>,
        names: &[&str],
    ) -> anyhow::Result<Subscriber<M>> {
        let key = topic.key(names);
        let (subscriber, last_values) = self.samples(key, topic.delivery()).await?;
        let subscriber = Subscriber {
            subscriber,
            initial: Mutex::default(),
            health: self.shared_health(),
            message: PhantomData,
        };
        let last_values = last_values.iter().filter_map(|sample| {
            Some((sample.key_expr().as_str().to_owned(), subscriber.decode(sample)?))
        });
        let last_values = last_values.collect();
        *subscriber.initial.lock().unwrap_or_else(PoisonError::into_inner) = last_values;
        Ok(subscriber)
    }

    /// A mailbox, and the last values from before it was there.
    fn samples(
        &self,
        key: String,
        delivery: Delivery,
    ) -> BoxFuture<'_, anyhow::Result<(SampleMailbox, Vec<Sample>)>> {
        Box::pin(async move {
            let subscriber = self
                .session
                .declare_subscriber(key.clone())
                .with(RingChannel::new(qos(delivery).depth))
                .await
                .map_err(|cause| anyhow!("subscribing to {key}: {cause}"))?;
            let mut last_values = Vec::new();
            if delivery == Delivery::LastValue {
                // At the start of a system there is no publisher yet, which is not an error.
                let query = with_query_qos(self.session.get(key)).timeout(REPLY_TIMEOUT);
                if let Ok(replies) = query.await {
                    while let Ok(reply) = replies.recv_async().await {
                        last_values.extend(reply.into_result());
                    }
                }
            }
            Ok((subscriber, last_values))
        })
    }

    /// The commands sent to this service on a topic's key.
    ///
    /// # Errors
    /// When the session is closed or a name makes no key.
    pub async fn commands<M: Message>(
        &self,
        topic: Topic<M>,
        names: &[&str],
    ) -> anyhow::Result<Commands<M>> {
        let queryable = self.queryable(topic.key(names), qos(topic.delivery()).depth).await?;
        Ok(Commands { queryable, health: self.shared_health(), message: PhantomData })
    }

    pub(crate) fn queryable(
        &self,
        key: String,
        depth: usize,
    ) -> BoxFuture<'_, anyhow::Result<QueryMailbox>> {
        Box::pin(async move {
            self.session
                .declare_queryable(key.clone())
                .with(RingChannel::new(depth))
                .await
                .map_err(|cause| anyhow!("answering on {key}: {cause}"))
        })
    }

    /// Sends a command on a topic's key and waits for its reply. A new session may not be connected to the
    /// recipient yet, so its time is requested until it answers; the command itself is sent once, and is refused
    /// when it arrives after this requester has given up.
    ///
    /// # Errors
    /// When there is no reply in time: states whether the command was sent.
    pub async fn command<M: Message>(
        &self,
        topic: Topic<M>,
        names: &[&str],
        command: &M,
    ) -> anyhow::Result<messages::CommandReply> {
        self.send_command(topic.key(names), encode(command)).await
    }

    fn send_command(
        &self,
        key: String,
        command: Vec<u8>,
    ) -> BoxFuture<'_, anyhow::Result<messages::CommandReply>> {
        Box::pin(async move {
            let until_ns = now_ns() + REPLY_TIMEOUT.as_nanos() as i64;
            let mut reply = None;
            while reply.is_none() && now_ns() < until_ns {
                let left_ns = until_ns.saturating_sub(now_ns());
                reply = self.query(&key, &[], ASKS_TIME, nanoseconds(left_ns)).await?;
                if reply.is_none() {
                    tokio::time::sleep(RETRY_PAUSE).await;
                }
            }
            let sent = match reply {
                Some(Reply::Time(time_ns)) => time_ns.to_le_bytes().to_vec(),
                // A recipient that gives no time.
                Some(Reply::Command(_)) => Vec::new(),
                None => return Err(self.unanswered(&key).await),
            };
            let named = format!("{key}?{SENDER}={}", self.sender());
            let sent_at = Instant::now();
            match self.query(&named, &command, &sent, REPLY_TIMEOUT).await? {
                Some(Reply::Command(reply)) => Ok(reply),
                Some(Reply::Time(_)) | None => Err(unconfirmed(&key, sent_at.elapsed())),
            }
        })
    }

    /// The error when no recipient answered the request for the time; no command was sent.
    async fn unanswered(&self, key: &str) -> anyhow::Error {
        let recipient = recipient(key);
        let (service, wanted) = match recipient.split_once('/') {
            Some((service, instance)) => (service, Some(instance)),
            None => (recipient, None),
        };
        let why = self.explain_silence(service, wanted).await;
        anyhow!("no {recipient} answered within {} s: {why}", REPLY_TIMEOUT.as_secs())
    }

    async fn query(
        &self,
        key: &str,
        payload: &[u8],
        attachment: &[u8],
        time_limit: Duration,
    ) -> anyhow::Result<Option<Reply>> {
        let replies = with_query_qos(self.session.get(key))
            .payload(payload)
            .attachment(attachment)
            .timeout(time_limit)
            .await
            .map_err(|cause| anyhow!("sending a command on {key}: {cause}"))?;
        while let Ok(reply) = replies.recv_async().await {
            let Ok(sample) = reply.result() else { continue };
            return Ok(Some(match sample.attachment().and_then(time) {
                Some(time_ns) => Reply::Time(time_ns),
                None => Reply::Command(decode(&sample.payload().to_bytes())?),
            }));
        }
        Ok(None)
    }
}

/// The service, and its instance if one is meant, to which a command's key belongs.
fn recipient(key: &str) -> &str {
    key.rsplit_once('/').map_or(key, |(recipient, _command)| recipient)
}

/// The error of a command that was sent this long ago and has no reply.
fn unconfirmed(key: &str, waited: Duration) -> anyhow::Error {
    let lack = match waited < REPLY_TIMEOUT {
        true => "the connection to it ended before an answer came".to_owned(),
        false => format!("no answer came within {} s", REPLY_TIMEOUT.as_secs()),
    };
    anyhow!(
        "the command was sent to the {}, and {lack}: it may have been carried out; look at the status (`alight doctor` shows it) before you \
         give it again",
        recipient(key)
    )
}

/// Queries for earlier messages of a record, each of which is a reply, with the quality of service of the record.
pub(crate) fn with_record_qos<'a, 'b>(querier: QuerierBuilder<'a, 'b>) -> QuerierBuilder<'a, 'b> {
    let Qos { priority, congestion, .. } = qos(Delivery::Record);
    let querier = querier.priority(priority).congestion_control(congestion);
    // Otherwise only the last reply on a key arrives.
    querier.consolidation(ConsolidationMode::None)
}

fn nanoseconds(ns: i64) -> Duration {
    Duration::from_nanos(u64::try_from(ns).unwrap_or(0))
}

/// The time in an attachment, in nanoseconds.
fn time(attachment: &ZBytes) -> Option<i64> {
    Some(i64::from_le_bytes(attachment.to_bytes().as_ref().try_into().ok()?))
}

/// A query with the quality of service of commands; its replies get the same.
pub(crate) fn with_query_qos<'a, 'b, H>(
    get: SessionGetBuilder<'a, 'b, H>,
) -> SessionGetBuilder<'a, 'b, H> {
    let Qos { priority, congestion, .. } = qos(Delivery::Query);
    get.priority(priority).congestion_control(congestion)
}

/// Receives the commands to a service.
pub struct Commands<M> {
    queryable: QueryMailbox,
    health: Arc<HealthCounters>,
    message: PhantomData<fn() -> M>,
}

impl<M: Message> Commands<M> {
    /// The next command; `None` once the session is closed. A payload that cannot be decoded is refused, and so is a
    /// command whose requester has given up.
    pub async fn next(&self) -> Option<Request<M>> {
        loop {
            let query = next_query(&self.queryable).await?;
            let attachment = query.attachment();
            if attachment.is_some_and(|asks| asks.to_bytes().as_ref() == ASKS_TIME) {
                reply_with_time(query).await;
                continue;
            }
            let sent_ns = attachment.and_then(time);
            let is_odd = attachment.is_some_and(|it| !it.is_empty() && sent_ns.is_none());
            let sender = sender::shown(query.parameters().get(SENDER).unwrap_or_default());
            let payload = query.payload().map(|p| p.to_bytes().into_owned()).unwrap_or_default();
            let reason = match decode(&payload) {
                Ok(_) if is_odd => {
                    if self.health.failed("commands: an attachment that is no time") {
                        let key = query.key_expr().as_str();
                        tracing::warn!(
                            key,
                            sender,
                            "Command refused: its attachment is no time (further ones are counted)"
                        );
                    }
                    "the command's attachment is no time (8 bytes), so it is not known how old the command is".to_owned()
                }
                Ok(message) => match refusal(sent_ns, now_ns()) {
                    None => return Some(Request { message, sent_ns, sender, query }),
                    Some(reason) => {
                        let key = query.key_expr().as_str();
                        tracing::warn!(key, reason, sender, "Command refused");
                        self.health.failed("commands: too late");
                        reason
                    }
                },
                Err(problem) => {
                    report_refused(
                        &self.health,
                        query.key_expr().as_str(),
                        payload.len(),
                        &problem,
                    );
                    problem.to_string()
                }
            };
            let reply = messages::CommandReply { accepted: false, reason };
            answer(query, encode(&reply)).await;
        }
    }
}

/// Why a command that was sent at this time is not carried out any more.
fn refusal(sent_ns: Option<i64>, now_ns: i64) -> Option<String> {
    let age_ns = now_ns.saturating_sub(sent_ns?);
    let max_ns = REPLY_TIMEOUT.as_nanos() as i64;
    // A time in the future is from another process, before this host was started again.
    (!(0..=max_ns).contains(&age_ns)).then(|| {
        format!(
            "the command is {:.1} s old and its sender has given up after {REPLY_TIMEOUT:?}: it waited, as a process or a link was stopped; give it again if it is still needed",
            age_ns as f64 * 1e-9
        )
    })
}

fn next_query(mailbox: &QueryMailbox) -> BoxFuture<'_, Option<Query>> {
    Box::pin(async move { mailbox.recv_async().await.ok() })
}

/// The next sample; `None` once the session is closed.
fn next_sample(mailbox: &SampleMailbox) -> BoxFuture<'_, Option<Sample>> {
    Box::pin(async move { mailbox.recv_async().await.ok() })
}

/// Answers a request for the time.
fn reply_with_time(query: Query) -> BoxFuture<'static, ()> {
    Box::pin(async move {
        let key = query.key_expr().clone();
        let reply = query.reply(key, Vec::<u8>::new()).attachment(now_ns().to_le_bytes().to_vec());
        if let Err(cause) = reply.await {
            tracing::debug!(%cause, "The reply to a question for the time was not delivered");
        }
    })
}

/// A command for a log: its name, or JSON where it has a value.
fn logged<M: Message>(command: &M) -> String {
    let json = serde_json::to_string(command).unwrap_or_default();
    let name = json.strip_prefix('"').and_then(|it| it.strip_suffix('"')).unwrap_or(&json);
    name.chars().take(MAX_LOGGED).collect()
}

impl<M: Message> Request<M> {
    /// Answers the command, and logs its sender.
    pub async fn answer(self, reply: &messages::CommandReply) {
        let command = logged(&self.message);
        let (sender, reason) = (&self.sender, &reply.reason);
        match reply.accepted {
            true => tracing::info!(%command, sender, reason, "Command accepted"),
            false => tracing::warn!(%command, sender, reason, "Command refused"),
        }
        answer(self.query, encode(reply)).await;
    }
}

fn answer(query: Query, reply: Vec<u8>) -> BoxFuture<'static, ()> {
    Box::pin(async move {
        let key = query.key_expr().clone();
        if let Err(cause) = query.reply(key, reply).await {
            tracing::debug!(%cause, "The reply to a command was not delivered");
        }
    })
}

impl<M: Message> Publisher<M> {
    /// Publishes a message. A failure is counted, and the stream continues with the next message.
    pub async fn publish(&self, message: &M) {
        self.bytes.put(encode(message)).await;
    }
}

impl Publisher<Vec<u8>> {
    /// As [`Publisher::publish`], for the bytes of an encoded message.
    pub async fn publish_encoded(&self, bytes: Vec<u8>) {
        self.bytes.put(bytes).await;
    }
}

impl<M> Publisher<M> {
    /// Whether there is a subscriber.
    pub async fn has_subscribers(&self) -> bool {
        self.bytes.has_subscribers().await
    }
}

impl BytesPublisher {
    fn put(&self, bytes: Vec<u8>) -> BoxFuture<'_, ()> {
        Box::pin(async move {
            if let Some(last_value) = &self.last_value {
                last_value.bytes.lock().unwrap_or_else(PoisonError::into_inner).clone_from(&bytes);
            }
            if let Err(cause) = self.publisher.put(bytes).await
                && !is_closed(&cause)
                && self.health.failed("publish")
            {
                tracing::warn!(key = %self.publisher.key_expr(), %cause, "A message could not be published");
            }
        })
    }

    fn has_subscribers(&self) -> BoxFuture<'_, bool> {
        Box::pin(async move {
            self.publisher.matching_status().await.is_ok_and(|status| status.matching())
        })
    }
}

impl<M: Message> Subscriber<M> {
    /// The next valid message; `None` once the session is closed. Others are counted, and logged once.
    pub async fn next(&self) -> Option<M> {
        self.next_with_key().await.map(|(_key, message)| message)
    }

    /// As [`Subscriber::next`], with the key on which it was published.
    pub async fn next_with_key(&self) -> Option<(String, M)> {
        let initial = self.initial.lock().unwrap_or_else(PoisonError::into_inner).pop();
        if initial.is_some() {
            return initial;
        }
        loop {
            let sample = next_sample(&self.subscriber).await?;
            if let Some(message) = self.decode(&sample) {
                return Some((sample.key_expr().as_str().to_owned(), message));
            }
        }
    }

    /// The next valid message that has arrived already.
    pub fn waiting(&self) -> Option<M> {
        let initial = self.initial.lock().unwrap_or_else(PoisonError::into_inner).pop();
        if let Some((_key, message)) = initial {
            return Some(message);
        }
        loop {
            let sample = self.subscriber.try_recv().ok()??;
            if let Some(message) = self.decode(&sample) {
                return Some(message);
            }
        }
    }

    fn decode(&self, sample: &Sample) -> Option<M> {
        decode(&sample.payload().to_bytes())
            .map_err(|problem| {
                let (key, bytes) = (sample.key_expr().as_str(), sample.payload().len());
                report_refused(&self.health, key, bytes, &problem);
            })
            .ok()
    }
}

/// Whether nothing was published because this process has closed its session: at its end that is no failure. Zenoh does not export the
/// error's type.
pub(crate) fn is_closed(cause: &zenoh::Error) -> bool {
    cause.to_string() == "session closed"
}

/// Counts a payload of so many bytes that cannot be read, by its reason and by its key, and logs the first of each key, and then one now
/// and then.
pub(crate) fn report_refused(
    health: &HealthCounters,
    key: &str,
    bytes: usize,
    problem: &DecodeError,
) {
    health.failed(&format!("payload: {}", problem.reason()));
    let why = match problem {
        DecodeError::Foreign { .. } | DecodeError::Damaged { .. } => problem.to_string(),
        _ => format!("{problem} ({bytes} bytes)"),
    };
    if let Some(unlogged) = health.unreadable_payload(now_ns(), key, why.clone()) {
        tracing::warn!("Unreadable payload on {}{}: {why}", key.escape_debug(), often(unlogged));
    }
}

/// How many payloads were unreadable since the last line of the log, as a text.
fn often(Unlogged { count, period_s }: Unlogged) -> String {
    match period_s {
        Some(period_s) => format!(" ({count} in {period_s:.0} s)"),
        None => " (further ones are counted)".to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unreadable_payloads_are_logged_with_their_number_and_time() {
        let unlogged = |period_s| Unlogged { count: 151, period_s };
        assert_eq!(often(unlogged(Some(10.04))), " (151 in 10 s)");
        assert_eq!(often(unlogged(None)), " (further ones are counted)");
    }

    #[test]
    fn a_command_is_logged_by_its_plain_name() {
        use messages::ControllerCommand::{Hold, UseDetector};
        assert_eq!(logged(&Hold), "Hold");
        assert_eq!(logged(&UseDetector("a\nb".into())), r#"{"UseDetector":"a\nb"}"#);
    }
}
