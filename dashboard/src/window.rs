//! What is on its way to a browser: at most two pictures that it has not drawn yet.
//!
//! So no picture waits in a queue behind another on a slow link, and a browser that stands still costs nothing.

use std::collections::VecDeque;

/// Maximum number of pictures on their way.
const MAX_UNACKNOWLEDGED: usize = 2;
/// A browser that draws nothing for this time is given up, in nanoseconds.
const PATIENCE_NS: i64 = 15_000_000_000;

/// The pictures on their way to one browser.
#[derive(Clone, Debug, Default)]
pub struct Window {
    sent: VecDeque<Sent>,
}

#[derive(Copy, Clone, Debug)]
struct Sent {
    number: u64,
    at_ns: i64,
}

impl Window {
    /// Whether a further picture may be sent.
    pub fn has_room(&self) -> bool {
        self.sent.len() < MAX_UNACKNOWLEDGED
    }

    /// Notes a picture that was sent.
    pub fn sent(&mut self, now_ns: i64, number: u64) {
        self.sent.push_back(Sent { number, at_ns: now_ns });
    }

    /// Notes that a picture was drawn, and all before it with it; false for one that was never sent.
    pub fn acknowledged(&mut self, number: u64) -> bool {
        let is_known = self.sent.iter().any(|sent| sent.number == number);
        if is_known {
            self.sent.retain(|sent| sent.number > number);
        }
        is_known
    }

    /// Whether the browser has drawn nothing for too long.
    pub fn is_stuck(&self, now_ns: i64) -> bool {
        self.sent.front().is_some_and(|sent| now_ns.saturating_sub(sent.at_ns) > PATIENCE_NS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_pictures_are_on_their_way_at_most() {
        let mut window = Window::default();
        window.sent(0, 3);
        assert!(window.has_room());
        window.sent(1, 5);
        assert!(!window.has_room());
        assert!(!window.acknowledged(4));
        assert!(!window.has_room());
        assert!(window.acknowledged(3));
        assert!(window.has_room());
        window.sent(2, 9);
        assert!(window.acknowledged(9));
        assert!(window.sent.is_empty());
    }

    #[test]
    fn a_browser_that_draws_nothing_is_given_up() {
        let mut window = Window::default();
        assert!(!window.is_stuck(i64::MAX));
        window.sent(0, 1);
        assert!(!window.is_stuck(PATIENCE_NS));
        assert!(window.is_stuck(PATIENCE_NS + 1));
    }
}
