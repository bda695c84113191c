//! Manages the channels offered to viewers and the viewers' slots: each client's subscriptions, the last values for a client that
//! joins, and a bound on their number.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use flightlog::live::{Subscription, advertise};
use flightlog::{Record, Schema};
use tokio::sync::Notify;

use crate::outbox::{Message, Next, Outbox, max_waiting};

/// Maximum number of channels; further ones are not offered.
const MAX_CHANNELS: usize = 1024;
/// Maximum size of the last value of a state that is stored for later clients, in bytes.
const MAX_STATE_BYTES: usize = 100_000;

/// The channels and the clients.
#[derive(Debug)]
pub(crate) struct Hub {
    state: Mutex<State>,
    max_clients: usize,
}

#[derive(Debug, Default)]
struct State {
    /// A channel's number is its index here.
    channels: Vec<Channel>,
    numbers: BTreeMap<String, u32>,
    clients: BTreeMap<u64, Client>,
    next_client: u64,
    /// Whether there was no client before the last one joined.
    has_begun: bool,
}

#[derive(Debug)]
struct Channel {
    topic: String,
    schema: Schema,
    /// The last value of a state, for clients that subscribe later.
    last: Option<Message>,
}

#[derive(Debug)]
struct Client {
    outbox: Outbox,
    changed: Arc<Notify>,
}

/// A client's slot, which is free again once this is dropped.
#[derive(Debug)]
pub(crate) struct Slot {
    hub: Arc<Hub>,
    client: u64,
    changed: Arc<Notify>,
}

impl Hub {
    /// Without channels and clients.
    pub(crate) fn new(max_clients: usize) -> Self {
        Self { state: Mutex::default(), max_clients }
    }

    // Every state is complete, also when a thread panics.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A slot for one more client, to which all channels are announced; `None` when all slots are taken.
    pub(crate) fn join(self: &Arc<Self>) -> Option<Slot> {
        let mut state = self.lock();
        if state.clients.len() >= self.max_clients {
            return None;
        }
        state.has_begun |= state.clients.is_empty();
        let mut outbox = Outbox::default();
        outbox.announce(advertise(state.numbered()));
        let changed = Arc::new(Notify::new());
        let client = state.next_client;
        state.next_client += 1;
        state.clients.insert(client, Client { outbox, changed: Arc::clone(&changed) });
        Some(Slot { hub: Arc::clone(self), client, changed })
    }

    /// Whether a client follows.
    pub(crate) fn is_followed(&self) -> bool {
        !self.lock().clients.is_empty()
    }

    /// Whether a client has joined a hub without clients since the last call.
    pub(crate) fn take_begun(&self) -> bool {
        std::mem::take(&mut self.lock().has_begun)
    }

    /// Offers a message to the clients that subscribe to its channel; how many messages clients miss for that.
    pub(crate) fn offer(&self, record: Record, log_time_ns: u64, is_state: bool) -> u64 {
        let mut state = self.lock();
        let Some((number, schema)) = state.number(&record) else { return 0 };
        let message = Message { log_time_ns, data: record.data.into() };
        let mut dropped = 0;
        for client in state.clients.values_mut() {
            dropped += client.outbox.push(number, max_waiting(schema), &message);
            client.changed.notify_one();
        }
        let is_retained = is_state && message.data.len() <= MAX_STATE_BYTES;
        if let Some(channel) = state.channels.get_mut(number as usize).filter(|_| is_retained) {
            channel.last = Some(message);
        }
        dropped
    }
}

impl State {
    /// Number, topic and schema of each channel.
    fn numbered(&self) -> impl Iterator<Item = (u32, &str, Schema)> {
        (0..).zip(&self.channels).map(|(number, it)| (number, it.topic.as_str(), it.schema))
    }

    /// The number and the schema of a record's channel, which is announced to all clients when it is new. A channel has one schema: a
    /// camera that starts again may send pictures of another kind.
    fn number(&mut self, record: &Record) -> Option<(u32, Schema)> {
        let is_its =
            |it: &Channel| it.topic == record.channel && it.schema.name() == record.schema.name();
        let last = self.numbers.get(&record.channel).copied();
        if let Some(number) = last
            && let Some(channel) = self.channels.get(number as usize).filter(|it| is_its(it))
        {
            return Some((number, channel.schema));
        }
        if last.is_some()
            && let Some(number) = self.channels.iter().position(is_its)
        {
            self.numbers.insert(record.channel.clone(), number as u32);
            return Some((number as u32, record.schema));
        }
        if self.channels.len() >= MAX_CHANNELS {
            return None;
        }
        let number = self.channels.len() as u32;
        let Record { channel, schema, .. } = record;
        for client in self.clients.values_mut() {
            client.outbox.announce(advertise([(number, channel.as_str(), *schema)]));
        }
        self.numbers.insert(channel.clone(), number);
        self.channels.push(Channel { topic: channel.clone(), schema: *schema, last: None });
        Some((number, *schema))
    }
}

impl Slot {
    /// Waits until something may be there to be sent.
    pub(crate) async fn changed(&self) {
        self.changed.notified().await;
    }

    /// The next text or message to be sent.
    pub(crate) fn next(&self) -> Option<Next> {
        self.hub.lock().clients.get_mut(&self.client)?.outbox.next()
    }

    /// How many messages the client missed.
    pub(crate) fn dropped(&self) -> u64 {
        self.hub.lock().clients.get(&self.client).map_or(0, |it| it.outbox.dropped())
    }

    /// From now on the client receives the messages of a channel, of a state first the last value.
    ///
    /// # Errors
    /// Why it does not.
    pub(crate) fn subscribe(&self, requested: Subscription) -> Result<(), String> {
        let Subscription { id, channel_id } = requested;
        let mut state = self.hub.lock();
        let State { channels, clients, .. } = &mut *state;
        let Some(channel) = channels.get(channel_id as usize) else {
            return Err(format!("there is no channel {channel_id}"));
        };
        let Some(client) = clients.get_mut(&self.client) else { return Ok(()) };
        if !client.outbox.subscribe(requested) {
            return Err(format!(
                "channel {channel_id} is subscribed to already, or subscription {id} is in use"
            ));
        }
        if let Some(last) = &channel.last {
            client.outbox.push(channel_id, max_waiting(channel.schema), last);
            client.changed.notify_one();
        }
        Ok(())
    }

    /// The client receives no more messages of a subscription.
    pub(crate) fn unsubscribe(&self, id: u32) {
        if let Some(client) = self.hub.lock().clients.get_mut(&self.client) {
            client.outbox.unsubscribe(id);
        }
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        let mut state = self.hub.lock();
        state.clients.remove(&self.client);
        if state.clients.is_empty() {
            // No client receives the values that follow.
            for channel in &mut state.channels {
                channel.last = None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wind(number: u8) -> Record {
        Record {
            channel: "wind".to_owned(),
            schema: Schema::Json("Wind"),
            stamp_ns: 0,
            data: vec![number],
        }
    }

    fn messages(slot: &Slot) -> Vec<u8> {
        let next = || loop {
            match slot.next()? {
                Next::Message(_, message) => return message.data.first().copied(),
                Next::Text(_) => {}
            }
        };
        std::iter::from_fn(next).collect()
    }

    #[test]
    fn a_later_client_receives_the_last_value_of_a_state() {
        let hub = Arc::new(Hub::new(2));
        assert!(!hub.is_followed() && !hub.take_begun());
        let first = hub.join().unwrap();
        assert!(hub.is_followed() && hub.take_begun() && !hub.take_begun());
        hub.offer(wind(1), 0, true);
        hub.offer(wind(2), 0, true);
        let requested = Subscription { id: 5, channel_id: 0 };
        first.subscribe(requested).unwrap();
        hub.offer(wind(3), 0, true);
        assert_eq!(messages(&first), [2, 3]);
        assert!(first.subscribe(requested).unwrap_err().contains("already"));
        let unknown = Subscription { id: 6, channel_id: 1 };
        assert!(first.subscribe(unknown).unwrap_err().contains("no channel 1"));
        let second = hub.join().unwrap();
        assert!(hub.join().is_none() && !hub.take_begun());
        second.subscribe(requested).unwrap();
        assert_eq!(messages(&second), [3]);
        drop((first, second));
        let third = hub.join().unwrap();
        assert!(hub.take_begun());
        third.subscribe(requested).unwrap();
        assert!(messages(&third).is_empty());
    }

    #[test]
    fn new_channels_are_announced_and_their_number_is_bounded() {
        let hub = Arc::new(Hub::new(1));
        let slot = hub.join().unwrap();
        for number in 0..=MAX_CHANNELS {
            let channel = format!("channel/{number}");
            hub.offer(Record { channel, ..wind(0) }, 0, false);
        }
        let mut texts = Vec::new();
        while let Some(Next::Text(text)) = slot.next() {
            texts.push(text);
        }
        assert_eq!(texts.len(), 1 + MAX_CHANNELS);
        assert!(texts[1].contains("channel/0") && texts[0].contains("\"channels\":[]"));
    }
}
