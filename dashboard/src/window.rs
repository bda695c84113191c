//! What is on its way to a browser: at most two pictures that it has not drawn yet.
//!
//! So no picture waits in a queue behind another on a slow link, and a browser that stands still costs nothing. Where a
//! picture takes long a second one behind it would only be older when it is drawn: then one is on its way.

use std::collections::VecDeque;

/// Maximum number of pictures on their way.
const MAX_UNACKNOWLEDGED: usize = 2;
/// A way is slow where a picture takes longer than this until it is drawn, in nanoseconds.
const SLOW_NS: i64 = 100_000_000;
/// It is quick again where one that travels alone takes less than this, in nanoseconds: two behind each other then stay below
/// the above.
const QUICK_NS: i64 = 50_000_000;
/// A browser that draws nothing for this time is given up, in nanoseconds.
const PATIENCE_NS: i64 = 15_000_000_000;

/// The pictures on their way to one browser.
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

    /// Notes that a picture was drawn, and all before it with it; false for one that was never sent.
    pub fn acknowledged(&mut self, now_ns: i64, number: u64) -> bool {
        let Some(sent) = self.sent.iter().find(|sent| sent.number == number) else { return false };
        let took_ns = now_ns.saturating_sub(sent.at_ns);
        self.is_slow = took_ns > if self.is_slow { QUICK_NS } else { SLOW_NS };
        self.sent.retain(|sent| sent.number > number);
        true
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
        assert!(!window.acknowledged(2, 4));
        assert!(!window.has_room());
        assert!(window.acknowledged(2, 3));
        assert!(window.has_room());
        window.sent(2, 9);
        assert!(window.acknowledged(3, 9));
        assert!(window.sent.is_empty());
    }

    #[test]
    fn on_a_slow_way_one_is_on_its_way() {
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
        // What would be slow again with a second one behind it stays so.
        window.acknowledged(270 * MS, 3);
        window.sent(270 * MS, 4);
        assert!(!window.has_room());
        window.acknowledged(310 * MS, 4);
        window.sent(310 * MS, 5);
        assert!(window.has_room());
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
