//! Publishes the tape once there is a subscriber, and sends the parts from before to each recorder that starts later.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use messages::{Tape, topic};
use node::{EarlierRequest, EarlierRequests, HealthCounters, Node, now_ns};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use tokio::task::JoinHandle;
use tokio::time::{sleep, timeout};

use crate::tape::TapedFlight;

/// Period in which the tape is handed over, in nanoseconds; it is earlier when this much of it waits, in bytes.
const TAPE_PERIOD_NS: i64 = 100_000_000;
const TAPE_BYTES: usize = 16_000;
/// Maximum size of the parts of the tape that wait for a subscriber and of those that were published, together, as a recorder
/// may start after the controller: about ten minutes.
const MAX_TAPE_BYTES: usize = 16 << 20;
/// Maximum number of the parts that wait, and of those that were published.
const MAX_TAPES: usize = 8192;
/// Pause before the next check for a subscriber of the tape.
const SUBSCRIBER_POLL: Duration = Duration::from_millis(100);
/// Pause between two parts of the tape while further ones wait: sent all at once, some would be dropped, and a recorder
/// beyond an air link would take the room of its frames.
const TAPE_PAUSE: Duration = Duration::from_millis(8);
/// Time for the waiting parts of the tape at the end.
const TAPE_END: Duration = Duration::from_millis(200);

/// Publishes the tape, once there is a subscriber, and answers requests for the published parts.
pub(crate) struct Tapes {
    /// Each part with its share of the room.
    waiting: mpsc::Sender<(Tape, OwnedSemaphorePermit)>,
    room: Arc<Room>,
    publishing: JoinHandle<()>,
    answering: JoinHandle<()>,
    passed_on_ns: i64,
    /// Whether a part found no room.
    is_cut: bool,
    health: Arc<HealthCounters>,
}

/// The room for the parts that wait and for the published ones, of which the oldest give way.
struct Room {
    /// In bytes.
    free: Arc<Semaphore>,
    /// The newest published parts, in order.
    published: Mutex<VecDeque<(Arc<Tape>, OwnedSemaphorePermit)>>,
}

impl Room {
    fn new(bytes: usize) -> Self {
        Self { free: Arc::new(Semaphore::new(bytes)), published: Mutex::default() }
    }

    /// Room for a part; the oldest published parts are removed for it. `None` where those that wait fill it.
    fn share(&self, tape: &Tape) -> Option<OwnedSemaphorePermit> {
        let bytes = u32::try_from(tape.records.len()).unwrap_or(u32::MAX);
        let mut published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Ok(share) = Arc::clone(&self.free).try_acquire_many_owned(bytes) {
                return Some(share);
            }
            drop(published.pop_front()?);
        }
    }

    /// Retains a part that is published.
    fn retain(&self, tape: Arc<Tape>, share: OwnedSemaphorePermit) {
        let mut published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        if published.len() >= MAX_TAPES {
            published.pop_front();
        }
        published.push_back((tape, share));
    }

    /// The oldest published part whose first record has at least this number.
    fn first_from(&self, first: u64) -> Option<Arc<Tape>> {
        let published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        let index = published.partition_point(|(tape, _share)| tape.first < first);
        published.get(index).map(|(tape, _share)| Arc::clone(tape))
    }

    /// The number of the first record of the newest published part.
    fn newest(&self) -> Option<u64> {
        let published = self.published.lock().unwrap_or_else(PoisonError::into_inner);
        published.back().map(|(tape, _share)| tape.first)
    }
}

impl Tapes {
    pub(crate) async fn new(node: &Node) -> anyhow::Result<Self> {
        let (waiting, mut tapes) = mpsc::channel::<(Tape, _)>(MAX_TAPES);
        let publisher = node.publisher(topic::TAPE, &[]).await?;
        let requests = node.earlier_requests(topic::TAPE).await?;
        let room = Arc::new(Room::new(MAX_TAPE_BYTES));
        let retained = Arc::clone(&room);
        let publishing = tokio::spawn(async move {
            while let Some((tape, share)) = tapes.recv().await {
                while !publisher.has_subscribers().await {
                    sleep(SUBSCRIBER_POLL).await;
                }
                let tape = Arc::new(tape);
                // Before it is published: a recorder that subscribes at this moment gets it twice rather than never.
                retained.retain(Arc::clone(&tape), share);
                publisher.publish(&tape).await;
                if !tapes.is_empty() {
                    sleep(TAPE_PAUSE).await;
                }
            }
        });
        let answering = tokio::spawn(answer(requests, Arc::clone(&room)));
        let health = node.shared_health();
        let passed_on_ns = now_ns();
        Ok(Self { waiting, room, publishing, answering, passed_on_ns, is_cut: false, health })
    }

    /// Hands the tape over at its period. Parts without room are missing, which the numbers of later parts show.
    pub(crate) fn pass_on(&mut self, flight: &mut TapedFlight) {
        let now = now_ns();
        let is_due = now.saturating_sub(self.passed_on_ns) >= TAPE_PERIOD_NS;
        if !is_due && flight.waiting_bytes() < TAPE_BYTES {
            return;
        }
        self.passed_on_ns = now;
        let Some(tape) = flight.take_tape() else { return };
        if !self.has_kept(tape) {
            self.health.dropped("parts of the tape");
            if !std::mem::replace(&mut self.is_cut, true) {
                tracing::info!(
                    "No recorder, or one that is too slow: a recording from now on cannot be replayed from the start"
                );
            }
        }
    }

    /// Keeps a part until it is published; false when there is no room.
    fn has_kept(&self, tape: Tape) -> bool {
        let share = self.room.share(&tape);
        share.is_some_and(|share| self.waiting.try_send((tape, share)).is_ok())
    }

    /// Publishes the waiting parts, if there is a subscriber.
    pub(crate) async fn end(mut self, flight: &mut TapedFlight) {
        self.passed_on_ns = i64::MIN;
        self.pass_on(flight);
        drop(self.waiting);
        let publishing = self.publishing.abort_handle();
        if timeout(TAPE_END, self.publishing).await.is_err() {
            publishing.abort();
        }
        self.answering.abort();
    }
}

/// Sends the published parts to each recorder that starts later, one recorder after the other.
async fn answer(requests: EarlierRequests<Tape>, room: Arc<Room>) {
    while let Some(request) = requests.next().await {
        answer_one(&request, &room).await;
    }
}

/// Sends the parts that were published before the request: the requester receives the later ones as a subscriber.
async fn answer_one(request: &EarlierRequest<Tape>, room: &Room) {
    let Some(newest) = room.newest() else { return };
    let mut first = 0;
    while let Some(tape) = room.first_from(first).filter(|tape| tape.first <= newest) {
        if let Err(error) = request.send(&tape).await {
            tracing::debug!("{error:#}");
            return;
        }
        first = tape.first.saturating_add(1);
        sleep(TAPE_PAUSE).await;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(first: u64) -> Tape {
        Tape { first, records: vec![0; 10], ..Tape::default() }
    }

    #[test]
    fn the_oldest_published_parts_give_way_to_new_ones_and_waiting_parts_do_not() {
        let room = Room::new(30);
        for first in [0, 4, 7] {
            let share = room.share(&part(first)).unwrap();
            room.retain(Arc::new(part(first)), share);
        }
        let firsts = |from: u64| room.first_from(from).map(|tape| tape.first);
        assert_eq!([0, 1, 5, 8].map(firsts), [Some(0), Some(4), Some(7), None]);
        assert_eq!(room.newest(), Some(7));
        let waiting = [room.share(&part(9)), room.share(&part(12))];
        assert!(waiting.iter().all(Option::is_some));
        assert_eq!((firsts(0), room.newest()), (Some(7), Some(7)));
        let more = room.share(&part(13));
        assert!(more.is_some() && room.newest().is_none());
        assert!(room.share(&part(14)).is_none());
    }
}
