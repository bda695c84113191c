//! Simulates a connection that delays, loses, doubles, reorders and damages its payloads.

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Maximum number of payloads under way; further ones are lost.
const MAX_WAITING: usize = 4096;
/// Bounds of delays and jitters, in seconds.
pub const MIN_DELAY_S: f64 = 0.05;
/// Bounds of delays and jitters, in seconds.
pub const MAX_DELAY_S: f64 = 0.5;
/// Bounds of the part that is lost.
pub const MIN_LOSS: f64 = 0.2;
/// Bounds of the part that is lost.
pub const MAX_LOSS: f64 = 0.8;
/// The part that is doubled, late or damaged.
pub const SOME: f64 = 0.3;
/// Maximum number of bits that are flipped in one payload.
const MAX_FLIPPED: usize = 8;

/// The faults of a connection.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub struct Trouble {
    /// Nothing arrives.
    pub silent: bool,
    /// Each is late by this time, in seconds.
    pub delay_s: f64,
    /// Each is late by up to this time more, in seconds, in order.
    pub jitter_s: f64,
    /// Part that never arrives.
    pub loss: f64,
    /// Part that arrives twice, the second time up to a second later.
    pub twice: f64,
    /// Part that arrives up to 0.3 s late, behind later ones.
    pub late: f64,
    /// Part that arrives with flipped bits.
    pub damaged: f64,
}

/// One direction of a connection.
#[derive(Clone, Debug)]
pub struct Channel {
    random: ChaCha8Rng,
    waiting: VecDeque<(f64, Vec<u8>)>,
    newest_s: f64,
}

impl Channel {
    /// A connection with its own random numbers.
    pub fn new(seed: u64, stream: u64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(seed);
        random.set_stream(stream);
        Self { random, waiting: VecDeque::new(), newest_s: 0.0 }
    }

    /// Sends a payload that would arrive at a time.
    pub fn put(&mut self, at_s: f64, mut payload: Vec<u8>, trouble: &Trouble) {
        // The same number of draws for each, so that one trouble does not change the draws of another.
        let [lost, jitter, twice, again, late, later, damaged] =
            [(); 7].map(|()| self.random.random::<f64>());
        if trouble.silent || lost < trouble.loss {
            return;
        }
        if damaged < trouble.damaged {
            self.flip(&mut payload);
        }
        let mut due_s = at_s + trouble.delay_s;
        if trouble.jitter_s > 0.0 {
            due_s = (due_s + trouble.jitter_s * jitter).max(self.newest_s);
        }
        if late < trouble.late {
            due_s += 0.3 * later;
        } else {
            self.newest_s = self.newest_s.max(due_s);
        }
        if twice < trouble.twice {
            self.insert(due_s + again, payload.clone());
        }
        self.insert(due_s, payload);
    }

    /// The next payload that has arrived.
    pub fn take(&mut self, now_s: f64) -> Option<Vec<u8>> {
        self.waiting.front().filter(|(due_s, _)| *due_s <= now_s)?;
        self.waiting.pop_front().map(|(_, payload)| payload)
    }

    fn insert(&mut self, due_s: f64, payload: Vec<u8>) {
        if self.waiting.len() < MAX_WAITING {
            let place = self.waiting.partition_point(|(other_s, _)| *other_s <= due_s);
            self.waiting.insert(place, (due_s, payload));
        }
    }

    fn flip(&mut self, payload: &mut [u8]) {
        let count = self.random.random_range(1..=MAX_FLIPPED);
        for _ in 0..count {
            let at = self.random.random_range(0..payload.len().max(1));
            let bit = self.random.random_range(0..8u8);
            if let Some(byte) = payload.get_mut(at) {
                *byte ^= 1 << bit;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The payloads that arrive, of those numbered 0 to 199 that are sent every 10 ms.
    fn carried(trouble: Trouble) -> Vec<(f64, Vec<u8>)> {
        let mut channel = Channel::new(1, 1);
        let mut arrived = Vec::new();
        for step in 0..500u32 {
            let now_s = f64::from(step) * 0.01;
            if let Ok(number) = u8::try_from(step) {
                channel.put(now_s, vec![number; 4], &trouble);
            }
            while let Some(payload) = channel.take(now_s) {
                arrived.push((now_s, payload));
            }
        }
        arrived
    }

    fn numbers(arrived: &[(f64, Vec<u8>)]) -> Vec<u8> {
        arrived.iter().map(|(_, payload)| payload[0]).collect()
    }

    #[test]
    fn without_trouble_all_arrive_at_once_in_order() {
        let arrived = carried(Trouble::default());
        assert_eq!(numbers(&arrived), (0..=255).collect::<Vec<u8>>());
        assert!(arrived.iter().all(|(at_s, p)| (at_s - f64::from(p[0]) * 0.01).abs() < 1e-9));
    }

    #[test]
    fn each_trouble_has_its_effect() {
        assert!(carried(Trouble { silent: true, ..Trouble::default() }).is_empty());
        let lost = carried(Trouble { loss: 0.5, ..Trouble::default() }).len();
        assert!((90..170).contains(&lost), "{lost}");
        let twice = carried(Trouble { twice: 0.3, ..Trouble::default() }).len();
        assert!((300..370).contains(&twice), "{twice}");
        let jitter = numbers(&carried(Trouble { jitter_s: 0.3, ..Trouble::default() }));
        assert!(jitter.is_sorted() && jitter.len() == 256);
        let late = numbers(&carried(Trouble { late: 0.3, ..Trouble::default() }));
        assert!(!late.is_sorted() && late.len() == 256);
        let delayed = carried(Trouble { delay_s: 0.2, ..Trouble::default() });
        assert!(delayed.iter().all(|(at_s, p)| at_s - f64::from(p[0]) * 0.01 >= 0.2 - 1e-9));
        let damaged = carried(Trouble { damaged: 0.3, ..Trouble::default() });
        let hurt = damaged.iter().filter(|(_, p)| p.iter().any(|byte| *byte != p[0])).count();
        assert!((40..110).contains(&hurt), "{hurt}");
    }
}
