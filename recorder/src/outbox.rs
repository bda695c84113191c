//! Queues the messages to one client: of each channel to which it subscribes only the newest.
//!
//! A client that is too slow misses the oldest; the recorder does not wait for it.

use std::collections::{BTreeMap, VecDeque};
use std::mem::size_of;

use axum::body::Bytes;
use flightlog::Schema;
use flightlog::foxglove::{COMPRESSED_IMAGE, LOG, RAW_IMAGE};
use flightlog::live::Subscription;

/// Maximum size of the waiting messages, in bytes, unless it is one message.
const MAX_BYTES: usize = 2_000_000;
/// Maximum number of pictures of a camera that wait.
const MAX_PICTURES: usize = 1;
/// Maximum number of messages that wait, of a channel of another kind: a second of most.
const MAX_MESSAGES: usize = 16;
/// Maximum number of lines of the log that wait.
const MAX_LINES: usize = 256;

/// A message of a channel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Message {
    /// When it was received, in nanoseconds since 1970.
    pub(crate) log_time_ns: u64,
    /// Its bytes, shared by all clients to which it is sent.
    pub(crate) data: Bytes,
}

impl Message {
    fn bytes(&self) -> usize {
        size_of::<Self>() + self.data.len()
    }
}

/// How many messages of a channel may wait.
pub(crate) fn max_waiting(schema: Schema) -> usize {
    match schema {
        Schema::Protobuf(it) if [COMPRESSED_IMAGE.name, RAW_IMAGE.name].contains(&it.name) => {
            MAX_PICTURES
        }
        Schema::Protobuf(it) if it.name == LOG.name => MAX_LINES,
        Schema::Protobuf(_) | Schema::Json(_) | Schema::Raw => MAX_MESSAGES,
    }
}

/// The next text or message to be sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Next {
    /// A text.
    Text(String),
    /// A message, under the number of its subscription.
    Message(u32, Message),
}

/// The texts and messages that wait to be sent to one client.
#[derive(Debug, Default)]
pub(crate) struct Outbox {
    /// Announcements of channels: not more texts than channels.
    texts: VecDeque<String>,
    /// By channel.
    subscribed: BTreeMap<u32, Subscribed>,
    bytes: usize,
    /// Of the next message.
    number: u64,
    dropped: u64,
}

#[derive(Debug)]
struct Subscribed {
    id: u32,
    /// With their numbers, in the order of reception.
    waiting: VecDeque<(u64, Message)>,
}

impl Outbox {
    /// Adds the announcement of channels.
    pub(crate) fn announce(&mut self, text: String) {
        self.texts.push_back(text);
    }

    /// From now on the client receives the messages of a channel; false when it does already, or uses the number for another.
    pub(crate) fn subscribe(&mut self, subscription: Subscription) -> bool {
        let Subscription { id, channel_id } = subscription;
        let is_free = !self.subscribed.contains_key(&channel_id)
            && self.subscribed.values().all(|it| it.id != id);
        if is_free {
            self.subscribed.insert(channel_id, Subscribed { id, waiting: VecDeque::new() });
        }
        is_free
    }

    /// The client receives no more messages of a subscription.
    pub(crate) fn unsubscribe(&mut self, id: u32) {
        self.subscribed.retain(|_, it| it.id != id);
        let waiting = self.subscribed.values().flat_map(|it| &it.waiting);
        self.bytes = waiting.map(|(_, message)| message.bytes()).sum();
    }

    /// Adds a message, if the client subscribes to its channel; how many it misses for that.
    pub(crate) fn push(&mut self, channel: u32, max_waiting: usize, message: &Message) -> u64 {
        let Some(subscribed) = self.subscribed.get_mut(&channel) else { return 0 };
        self.bytes += message.bytes();
        subscribed.waiting.push_back((self.number, message.clone()));
        self.number += 1;
        let before = self.dropped;
        if subscribed.waiting.len() > max_waiting {
            self.drop_oldest(channel);
        }
        while self.bytes > MAX_BYTES && self.bytes > message.bytes() {
            let Some(oldest) = self.oldest() else { break };
            self.drop_oldest(oldest);
        }
        self.dropped - before
    }

    /// The channel of the oldest message.
    fn oldest(&self) -> Option<u32> {
        let fronts = self
            .subscribed
            .iter()
            .filter_map(|(channel, it)| it.waiting.front().map(|(number, _)| (*number, *channel)));
        fronts.min().map(|(_, channel)| channel)
    }

    fn take(&mut self, channel: u32) -> Option<(u32, Message)> {
        let subscribed = self.subscribed.get_mut(&channel)?;
        let (_, message) = subscribed.waiting.pop_front()?;
        self.bytes = self.bytes.saturating_sub(message.bytes());
        Some((subscribed.id, message))
    }

    fn drop_oldest(&mut self, channel: u32) {
        self.dropped += u64::from(self.take(channel).is_some());
    }

    /// The next text or message, in the order of reception.
    pub(crate) fn next(&mut self) -> Option<Next> {
        if let Some(text) = self.texts.pop_front() {
            return Some(Next::Text(text));
        }
        let (id, message) = self.take(self.oldest()?)?;
        Some(Next::Message(id, message))
    }

    /// How many messages the client missed.
    pub(crate) fn dropped(&self) -> u64 {
        self.dropped
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(log_time_ns: u64, bytes: usize) -> Message {
        Message { log_time_ns, data: vec![0; bytes].into() }
    }

    fn outbox(channels: &[u32]) -> Outbox {
        let mut outbox = Outbox::default();
        for &channel_id in channels {
            assert!(outbox.subscribe(Subscription { id: 100 + channel_id, channel_id }));
        }
        outbox
    }

    /// Subscription and time of all waiting messages.
    fn rest(outbox: &mut Outbox) -> Vec<(u32, u64)> {
        let next = || match outbox.next()? {
            Next::Message(id, message) => Some((id, message.log_time_ns)),
            Next::Text(text) => panic!("{text}"),
        };
        std::iter::from_fn(next).collect()
    }

    #[test]
    fn a_slow_client_gets_the_newest_in_the_order_in_which_they_came() {
        let mut outbox = outbox(&[1, 2]);
        let lost = [
            outbox.push(1, 1, &message(1, 10)),
            outbox.push(2, 2, &message(2, 10)),
            outbox.push(1, 1, &message(3, 10)),
            outbox.push(2, 2, &message(4, 10)),
            outbox.push(2, 2, &message(5, 10)),
            outbox.push(9, 2, &message(6, 10)),
        ];
        assert_eq!((lost, outbox.dropped()), ([0, 0, 1, 0, 1, 0], 2));
        assert_eq!(rest(&mut outbox), [(101, 3), (102, 4), (102, 5)]);
        assert_eq!((outbox.bytes, outbox.next()), (0, None));
    }

    #[test]
    fn waiting_messages_are_bounded_in_bytes_unless_there_is_only_one() {
        let mut outbox = outbox(&[1, 2]);
        for time in 0..40 {
            outbox.push(1, MAX_MESSAGES, &message(time, 200_000));
            assert!(outbox.bytes <= MAX_BYTES);
        }
        assert_eq!(outbox.subscribed[&1].waiting.len(), 9);
        assert_eq!(outbox.push(2, 1, &message(40, 3 * MAX_BYTES)), 9);
        assert_eq!(rest(&mut outbox), [(102, 40)]);
        assert_eq!(outbox.bytes, 0);
    }

    #[test]
    fn a_channel_has_one_subscription_and_a_subscription_one_channel() {
        let mut outbox = outbox(&[1, 2]);
        assert!(!outbox.subscribe(Subscription { id: 7, channel_id: 1 }));
        assert!(!outbox.subscribe(Subscription { id: 101, channel_id: 3 }));
        outbox.push(1, 4, &message(1, 10));
        outbox.push(2, 4, &message(2, 10));
        outbox.unsubscribe(101);
        assert!(outbox.subscribe(Subscription { id: 101, channel_id: 3 }));
        assert_eq!(rest(&mut outbox), [(102, 2)]);
        assert_eq!(outbox.bytes, 0);
    }
}
