//! Bounds the bytes that are on their way to a client: not more than it has taken for some time.
//!
//! The systems between two programs take megabytes before a sender has to wait, which on a slow link are many seconds of
//! flight. Every WebSocket answers a ping when it has taken all messages before it, so pings show the taken messages.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// A message may be sent while less than this is on its way, in bytes: two pictures.
const MAX_UNACKNOWLEDGED: usize = 150_000;
/// A ping follows so many bytes.
const PING_BYTES: usize = 32_000;
/// A client that answers no ping for this time is disconnected.
const PONG_TIMEOUT: Duration = Duration::from_secs(15);

/// The bytes on their way to one client.
#[derive(Debug, Default)]
pub(crate) struct Window {
    pings: VecDeque<Ping>,
    /// Bytes on their way, and those after the last ping.
    bytes: usize,
    after_ping: usize,
    number: u64,
}

#[derive(Debug)]
struct Ping {
    number: u64,
    /// Bytes that were sent since the one before.
    bytes: usize,
    at: Instant,
}

impl Window {
    /// Whether more may be sent.
    pub(crate) fn has_room(&self) -> bool {
        self.bytes < MAX_UNACKNOWLEDGED
    }

    /// Notes the sent bytes; true when a ping is due.
    pub(crate) fn sent(&mut self, bytes: usize) -> bool {
        self.bytes += bytes;
        self.after_ping += bytes;
        self.after_ping >= PING_BYTES
    }

    /// The number of a ping that is sent now.
    pub(crate) fn ping(&mut self, now: Instant) -> u64 {
        self.number += 1;
        let bytes = std::mem::take(&mut self.after_ping);
        self.pings.push_back(Ping { number: self.number, bytes, at: now });
        self.number
    }

    /// Notes an answer, which holds for all pings before as well.
    pub(crate) fn pong(&mut self, number: u64) {
        while let Some(ping) = self.pings.pop_front_if(|ping| ping.number <= number) {
            self.bytes = self.bytes.saturating_sub(ping.bytes);
        }
    }

    /// Whether a client takes no more messages.
    pub(crate) fn is_stuck(&self, now: Instant) -> bool {
        self.pings.front().is_some_and(|ping| now.duration_since(ping.at) > PONG_TIMEOUT)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_pictures_are_on_their_way_at_most() {
        let (mut window, now) = (Window::default(), Instant::now());
        let mut pings = Vec::new();
        for _ in 0..2 {
            assert!(window.has_room());
            assert!(window.sent(97_000));
            pings.push(window.ping(now));
        }
        assert!(!window.has_room());
        window.pong(99);
        assert!(window.has_room() && window.bytes == 0);
        assert!(!window.sent(PING_BYTES - 1) && window.sent(1));
    }

    #[test]
    fn a_client_that_answers_no_ping_is_given_up() {
        let (mut window, now) = (Window::default(), Instant::now());
        assert!(!window.is_stuck(now + 2 * PONG_TIMEOUT));
        let ping = window.ping(now);
        assert!(!window.is_stuck(now + PONG_TIMEOUT));
        assert!(window.is_stuck(now + PONG_TIMEOUT + Duration::from_millis(1)));
        window.pong(ping);
        assert!(!window.is_stuck(now + 2 * PONG_TIMEOUT));
    }
}
