//! Carries the autopilot's link with its faults, in lock-step and in real time.

use autopilot::Parser;

use super::begun::BegunFaults;
use super::channel::{Channel, MAX_DELAY_S, MAX_LOSS, MIN_DELAY_S, MIN_LOSS, SOME, Trouble};
use super::falsify::Falsifier;
use super::kind::Kind;
use super::plan::Fault;

/// Both directions of the link.
#[derive(Clone, Debug)]
pub struct FaultyLink {
    faults: BegunFaults,
    parser: Parser,
    falsifier: Falsifier,
    from_autopilot: Channel,
    to_autopilot: Channel,
}

impl FaultyLink {
    /// A link without faults so far.
    pub fn new(seed: u64) -> Self {
        Self {
            faults: BegunFaults::default(),
            parser: Parser::new(),
            falsifier: Falsifier::default(),
            from_autopilot: Channel::new(seed, 1),
            to_autopilot: Channel::new(seed, 2),
        }
    }

    /// A fault begins, of any kind.
    pub fn begin(&mut self, now_s: f64, fault: Fault) {
        self.faults.begin(now_s, fault);
    }

    /// The autopilot sends.
    pub fn put_from_autopilot(&mut self, now_s: f64, bytes: &[u8]) {
        let trouble = self.trouble(Kind::SilenceFrom, now_s);
        let faults = &self.faults;
        for packet in self.parser.push(bytes) {
            if let Some(raw) = self.falsifier.apply(&packet, |kind| faults.is_on(kind, now_s)) {
                self.from_autopilot.put(now_s, raw, &trouble);
            }
        }
    }

    /// The controller sends.
    pub fn put_to_autopilot(&mut self, now_s: f64, packet: Vec<u8>) {
        let trouble = self.trouble(Kind::SilenceTo, now_s);
        self.to_autopilot.put(now_s, packet, &trouble);
    }

    /// The next packet that has arrived at the controller.
    pub fn take_from_autopilot(&mut self, now_s: f64) -> Option<Vec<u8>> {
        self.from_autopilot.take(now_s)
    }

    /// The next packet that has arrived at the autopilot.
    pub fn take_to_autopilot(&mut self, now_s: f64) -> Option<Vec<u8>> {
        self.to_autopilot.take(now_s)
    }

    fn trouble(&self, silence: Kind, now_s: f64) -> Trouble {
        let value = |kind, range| self.faults.value(kind, now_s, range);
        Trouble {
            silent: self.faults.is_on(silence, now_s)
                || self.faults.is_on(Kind::SilenceBoth, now_s),
            delay_s: value(Kind::LinkDelay, MIN_DELAY_S..=MAX_DELAY_S),
            jitter_s: value(Kind::LinkJitter, MIN_DELAY_S..=MAX_DELAY_S),
            loss: value(Kind::LinkLoss, MIN_LOSS..=MAX_LOSS),
            twice: value(Kind::LinkDuplication, SOME..=SOME),
            late: value(Kind::LinkReordering, SOME..=SOME),
            damaged: value(Kind::LinkCorruption, SOME..=SOME),
        }
    }
}
