//! Receives every message of many topics as bytes, for a recorder, in one queue of bounded size, and counts by key
//! the messages that did not fit.

use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use anyhow::anyhow;
use messages::{Delivery, Row};
use tokio::task::JoinSet;
use zenoh::query::Querier;
use zenoh::sample::Sample;

use crate::boxed::BoxFuture;
use crate::clock::now_ns;
use crate::health::HealthCounters;
use crate::session::Node;
use crate::topics::{REPLY_TIMEOUT, with_query_qos, with_record_qos};

/// Maximum number of messages that wait.
const MAX_WAITING: usize = 16_384;
/// Maximum number of keys whose losses are counted one by one.
const MAX_KEYS: usize = 1024;
/// Longest time in which the earlier messages of a record are received: a controller sends those of ten minutes in one.
const EARLIER_TIMEOUT: Duration = Duration::from_secs(180);
/// The name under which the losses of further keys are counted.
const OTHER_KEYS: &str = "other keys";

/// A message as it was received.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tapped {
    /// Its key, without the vehicle.
    pub key: String,
    /// Its payload.
    pub payload: Vec<u8>,
    /// Its attachment; empty without.
    pub attachment: Vec<u8>,
    /// When it came, in nanoseconds of this process' clock.
    pub received_ns: i64,
    /// Whether it is a state, of which the last value holds.
    pub is_state: bool,
}

/// Receives the messages of several topics. A reader that is too slow loses the newest, and they are counted.
pub struct Tap {
    shared: Arc<Shared>,
    _subscribers: Vec<zenoh::pubsub::Subscriber<()>>,
    /// Those that receive the earlier messages of records.
    _earlier: JoinSet<()>,
}

struct Shared {
    queue: Mutex<Queue>,
    arrived: Condvar,
    max_bytes: usize,
    health: Arc<HealthCounters>,
}

#[derive(Default)]
struct Queue {
    messages: VecDeque<Tapped>,
    /// Bytes that wait, and of messages that are being copied.
    bytes: usize,
    dropped: BTreeMap<String, u64>,
}

impl Tapped {
    fn bytes(&self) -> usize {
        self.key.len() + self.payload.len() + self.attachment.len()
    }
}

impl Node {
    /// Receives all messages of some topics, of which up to `max_bytes` may wait. Frames are copied as they arrive,
    /// so that none of the shared memory is held. Of a state the last value is received first; of a record the earlier
    /// messages as well, as far as its publisher has them, next to the new ones. One that is published at that moment may be
    /// received twice.
    ///
    /// # Errors
    /// When the session is closed.
    pub fn tap<'a>(
        &'a self,
        topics: &'a [Row],
        max_bytes: usize,
    ) -> BoxFuture<'a, anyhow::Result<Tap>> {
        Box::pin(async move {
            let shared = Arc::new(Shared::new(max_bytes, self.shared_health()));
            let mut subscribers = Vec::new();
            let mut earlier = JoinSet::new();
            for row in topics {
                let key = pattern(row.key);
                let is_state = row.delivery == Delivery::LastValue;
                let taken = Arc::clone(&shared);
                let subscriber = self
                    .session
                    .declare_subscriber(key.clone())
                    .callback(move |sample| taken.take(&sample, is_state))
                    .await
                    .map_err(|cause| anyhow!("subscribing to {key}: {cause}"))?;
                subscribers.push(subscriber);
                if is_state {
                    let taken = Arc::clone(&shared);
                    let reply = move |reply: zenoh::query::Reply| {
                        if let Ok(sample) = reply.result() {
                            taken.take(sample, is_state);
                        }
                    };
                    // At the start of a system there is no publisher yet, which is not an error.
                    let query = with_query_qos(self.session.get(&key)).timeout(REPLY_TIMEOUT);
                    drop(query.callback(reply).await);
                }
                if row.delivery == Delivery::Record {
                    let querier = with_record_qos(self.session.declare_querier(key.clone()));
                    let querier = querier.timeout(EARLIER_TIMEOUT).await;
                    let querier = querier.map_err(|cause| anyhow!("querying {key}: {cause}"))?;
                    earlier.spawn(take_earlier(querier, Arc::clone(&shared)));
                }
            }
            Ok(Tap { shared, _subscribers: subscribers, _earlier: earlier })
        })
    }
}

/// Takes the earlier messages of a record once, as soon as its publisher is there: later it is of no use, as all are received.
async fn take_earlier(querier: Querier<'static>, shared: Arc<Shared>) {
    let Ok(changes) = querier.matching_listener().await else { return };
    while !querier.matching_status().await.is_ok_and(|status| status.matching()) {
        if changes.recv_async().await.is_err() {
            return;
        }
    }
    let Ok(replies) = querier.get().await else { return };
    while let Ok(reply) = replies.recv_async().await {
        if let Ok(sample) = reply.result() {
            shared.take(sample, false);
        }
    }
}

/// The key with `*` for each of its placeholders.
fn pattern(key: &str) -> String {
    let parts = key.split('/').map(|part| if part.starts_with('{') { "*" } else { part });
    parts.collect::<Vec<_>>().join("/")
}

impl Shared {
    fn new(max_bytes: usize, health: Arc<HealthCounters>) -> Self {
        Self { queue: Mutex::default(), arrived: Condvar::new(), max_bytes, health }
    }

    /// Copies a message, unless too much waits already.
    fn take(&self, sample: &Sample, is_state: bool) {
        let key = sample.key_expr().as_str();
        let attachment = sample.attachment().map(|it| it.to_bytes().into_owned());
        let attachment = attachment.unwrap_or_default();
        let bytes = key.len() + sample.payload().len() + attachment.len();
        if !self.reserve(key, bytes) {
            return;
        }
        let message = Tapped {
            key: key.to_owned(),
            payload: sample.payload().to_bytes().into_owned(),
            attachment,
            received_ns: now_ns(),
            is_state,
        };
        self.lock().messages.push_back(message);
        self.arrived.notify_one();
    }

    /// Whether there is room; if not, the loss is counted.
    fn reserve(&self, key: &str, bytes: usize) -> bool {
        let mut queue = self.lock();
        if queue.messages.len() < MAX_WAITING && queue.bytes + bytes <= self.max_bytes {
            queue.bytes += bytes;
            return true;
        }
        let is_known = queue.dropped.contains_key(key) || queue.dropped.len() < MAX_KEYS;
        let name = if is_known { key } else { OTHER_KEYS };
        *queue.dropped.entry(name.to_owned()).or_default() += 1;
        drop(queue);
        self.health.dropped("not taken in time");
        false
    }

    // A message is either in the queue or not, also when a thread panics.
    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Tap {
    /// The next message; `None` when there is none within `time_limit`.
    pub fn next(&self, time_limit: Duration) -> Option<Tapped> {
        let is_empty = |queue: &mut Queue| queue.messages.is_empty();
        let waited =
            self.shared.arrived.wait_timeout_while(self.shared.lock(), time_limit, is_empty);
        let (mut queue, _timeout) = waited.unwrap_or_else(PoisonError::into_inner);
        let message = queue.messages.pop_front()?;
        queue.bytes = queue.bytes.saturating_sub(message.bytes());
        Some(message)
    }

    /// How many messages were lost since the last call, by key.
    pub fn take_dropped(&self) -> BTreeMap<String, u64> {
        std::mem::take(&mut self.shared.lock().dropped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_without_room_are_counted_by_key() {
        let shared = Shared::new(100, Arc::default());
        assert!(shared.reserve("wind", 60));
        assert!(!shared.reserve("wind", 41) && !shared.reserve("truth", 41));
        assert!(!shared.reserve("wind", 41));
        assert!(shared.reserve("wind", 40));
        let dropped = std::mem::take(&mut shared.lock().dropped);
        assert_eq!(dropped, [("truth".to_owned(), 1), ("wind".to_owned(), 2)].into());
        for key in 0..MAX_KEYS + 3 {
            assert!(!shared.reserve(&key.to_string(), 1));
        }
        let dropped = &shared.lock().dropped;
        assert_eq!((dropped.len(), dropped[OTHER_KEYS]), (MAX_KEYS + 1, 3));
    }

    #[test]
    fn a_read_message_makes_room() {
        let tap = Tap {
            shared: Arc::new(Shared::new(8, Arc::default())),
            _subscribers: vec![],
            _earlier: JoinSet::new(),
        };
        let message = Tapped { key: "wind".into(), payload: vec![1; 4], ..Tapped::default() };
        for _ in 0..3 {
            assert!(tap.shared.reserve("wind", message.bytes()));
            tap.shared.lock().messages.push_back(message.clone());
            assert!(!tap.shared.reserve("wind", 1));
            assert_eq!(tap.next(Duration::ZERO), Some(message.clone()));
            assert_eq!(tap.next(Duration::ZERO), None);
        }
    }
}
