//! Limits the pictures in transit to a browser: at most two that it has not drawn yet.
//!
//! So no picture waits in a queue behind another on a slow link, and a browser that hangs costs nothing. Where a picture
//! takes long, a second one behind it would only be older when it is drawn: then only one is in transit.

use std::collections::VecDeque;

/// Maximum number of pictures in transit.
const MAX_UNACKNOWLEDGED: usize = 2;
/// A link is slow where a picture takes longer than this until it is drawn, in nanoseconds.
const SLOW_NS: i64 = 100_000_000;
/// It is fast again where a picture that is sent alone takes less than this, in nanoseconds: two in sequence then stay below
/// `SLOW_NS`.
const FAST_NS: i64 = 50_000_000;
/// A browser that draws nothing for this time is disconnected, in nanoseconds.
const DRAW_TIMEOUT_NS: i64 = 15_000_000_000;

/// The pictures in transit to one browser.
#[derive(Clone, Debug, Default)]
pub struct Window {
    sent: VecDeque<Sent>,
    is_slow: bool,
}

#[derive(Copy, Clone, Debug)]
struct Sent {
    number: u64,
    at_ns: i64,
}

impl Window {
    /// Whether a further picture may be sent.
    pub fn has_room(&self) -> bool {
        self.sent.len() < if self.is_slow { 1 } else { MAX_UNACKNOWLEDGED }
    }

    /// Notes a picture that was sent.
    pub fn sent(&mut self, now_ns: i64, number: u64) {
        self.sent.push_back(Sent { number, at_ns: now_ns });
    }

    /// Notes that a picture, and so every earlier one, was drawn; false for one that was never sent.
    pub fn acknowledged(&mut self, now_ns: i64, number: u64) -> bool {
        let Some(sent) = self.sent.iter().find(|sent| sent.number == number) else { return false };
        let took_ns = now_ns.saturating_sub(sent.at_ns);
        self.is_slow = took_ns > if self.is_slow { FAST_NS } else { SLOW_NS };
        self.sent.retain(|sent| sent.number > number);
        true
    }

    /// Whether the browser has drawn nothing for too long.
    pub fn is_stuck(&self, now_ns: i64) -> bool {
        self.sent.front().is_some_and(|sent| now_ns.saturating_sub(sent.at_ns) > DRAW_TIMEOUT_NS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn at_most_two_pictures_are_in_transit() {
        let mut window = Window::default();
        window.sent(0, 3);
        assert!(window.has_room());
        window.sent(1, 5);
        assert!(!window.has_room());
        assert!(!window.acknowledged(2, 4));
        assert!(!window.has_room());
        assert!(window.acknowledged(2, 3));
        assert!(window.has_room());
        window.sent(2, 9);
        assert!(window.acknowledged(3, 9));
        assert!(window.sent.is_empty());
    }

    #[test]
    fn on_a_slow_link_one_picture_is_in_transit() {
        const MS: i64 = 1_000_000;
        let mut window = Window::default();
        window.sent(0, 1);
        window.sent(60 * MS, 2);
        assert!(window.acknowledged(130 * MS, 1), "130 ms");
        assert!(!window.has_room());
        window.acknowledged(200 * MS, 2);
        assert!(window.has_room());
        window.sent(200 * MS, 3);
        assert!(!window.has_room());
        // A link that would be slow again with a second picture stays slow.
        window.acknowledged(270 * MS, 3);
        window.sent(270 * MS, 4);
        assert!(!window.has_room());
        window.acknowledged(310 * MS, 4);
        window.sent(310 * MS, 5);
        assert!(window.has_room());
    }

    #[test]
    fn a_browser_that_draws_nothing_is_disconnected() {
        let mut window = Window::default();
        assert!(!window.is_stuck(i64::MAX));
        window.sent(0, 1);
        assert!(!window.is_stuck(DRAW_TIMEOUT_NS));
        assert!(window.is_stuck(DRAW_TIMEOUT_NS + 1));
    }
}
