//! A link and the conversation over it, for services: the only place where packets, time and the client meet.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use tokio::time::{Interval, MissedTickBehavior, interval};

use crate::address::Address;
use crate::client::{Autopilot, Config, Event};
use crate::link::{Link, LinkError, LinkEvent, LinkSender, SendError};
use crate::packet::{Counters, Frame};

/// How often time passes for the client when nothing is received.
const TICK: Duration = Duration::from_millis(20);
/// What happened while nobody asked: the oldest goes.
const MAX_WAITING: usize = 4096;

/// A conversation with the autopilot at an address.
#[derive(Debug)]
pub struct Session<Clock> {
    link: Link,
    autopilot: Autopilot,
    clock: Clock,
    ticks: Interval,
    happened: VecDeque<Happening>,
    refused: u64,
}

/// What happened.
#[derive(Clone, Debug, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "few wait at a time, and each is looked at once")]
pub enum Happening {
    /// The link is up; see [`LinkEvent::Connected`].
    Connected {
        /// The other side, for people.
        peer: String,
    },
    /// The link is down and being retried; see [`LinkEvent::Disconnected`].
    Disconnected {
        /// Why, for people.
        reason: String,
    },
    /// Any packet on the link, also of other senders, for those who pass packets on.
    Packet {
        /// When it was received, in ns of the session's clock.
        stamp_ns: i64,
        /// The packet.
        frame: Box<Frame>,
    },
    /// Something about the vehicle.
    Vehicle(Event),
    /// Time passed; comes at least 50 times a second, a good moment for what is to be done regularly.
    Tick {
        /// The time in ns.
        now_ns: i64,
    },
}

impl<Clock: Fn() -> i64> Session<Clock> {
    /// Opens the link; `clock` gives nanoseconds and does not jump.
    pub async fn open(address: Address, config: Config, clock: Clock) -> Result<Self, LinkError> {
        let link = Link::open(address).await?;
        let mut ticks = interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let autopilot = Autopilot::new(config);
        Ok(Self { link, autopilot, clock, ticks, happened: VecDeque::new(), refused: 0 })
    }

    /// What happens next; may be cancelled without losing anything.
    pub async fn next(&mut self) -> Happening {
        loop {
            if let Some(happening) = self.happened.pop_front() {
                return happening;
            }
            tokio::select! {
                event = self.link.recv() => self.take(event),
                _ = self.ticks.tick() => {
                    let now_ns = (self.clock)();
                    self.autopilot.tick(now_ns);
                    self.push(Happening::Tick { now_ns });
                }
            }
            self.exchange();
        }
    }

    /// What is known about the vehicle.
    pub fn autopilot(&self) -> &Autopilot {
        &self.autopilot
    }

    /// Does something with the client at the present time, and sends at once what it wants sent.
    pub fn act<R>(&mut self, deed: impl FnOnce(i64, &mut Autopilot) -> R) -> R {
        let result = deed((self.clock)(), &mut self.autopilot);
        self.exchange();
        result
    }

    /// Sends a packet of somebody else (a ground station) as it is.
    pub fn pass_on(&self, packet: &[u8]) -> Result<(), SendError> {
        self.link.send(packet)
    }

    /// A handle that passes packets on from another task.
    pub fn sender(&self) -> LinkSender {
        self.link.sender()
    }

    /// How many packets the link did not take because it was down or too slow.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// What was received so far, good and bad.
    pub fn counters(&self) -> Counters {
        self.link.counters()
    }

    /// How many received packets were thrown away because nobody read them in time.
    pub fn dropped(&self) -> u64 {
        self.link.dropped()
    }

    fn take(&mut self, event: LinkEvent) {
        let happening = match event {
            LinkEvent::Connected { peer } => Happening::Connected { peer },
            LinkEvent::Disconnected { reason } => Happening::Disconnected { reason },
            LinkEvent::Frame { frame, received } => {
                let stamp_ns = self.stamp(received);
                self.autopilot.handle(stamp_ns, &frame);
                Happening::Packet { stamp_ns, frame }
            }
        };
        self.push(happening);
    }

    fn push(&mut self, happening: Happening) {
        if self.happened.len() >= MAX_WAITING {
            self.happened.pop_front();
        }
        self.happened.push_back(happening);
    }

    /// The time of reception by the session's clock.
    fn stamp(&self, received: Instant) -> i64 {
        let age_ns = i64::try_from(received.elapsed().as_nanos()).unwrap_or(i64::MAX);
        (self.clock)().saturating_sub(age_ns)
    }

    fn exchange(&mut self) {
        while let Some(packet) = self.autopilot.poll_outgoing() {
            self.refused += u64::from(self.link.send(&packet).is_err());
        }
        while let Some(event) = self.autopilot.poll_event() {
            self.push(Happening::Vehicle(event));
        }
    }
}
