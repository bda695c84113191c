//! Notices that no other process of the recorder's vehicle is present, as where the vehicle's name is wrong.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use messages::topic;
use node::Node;

/// Time after the start in which a process is expected: each publishes its health once a second.
const TIMEOUT: Duration = Duration::from_secs(5);

/// Whether only this recorder's own messages were received.
pub(crate) struct Alone {
    vehicle: String,
    /// The keys of its own messages.
    own: [String; 3],
    begun: Instant,
    has_others: AtomicBool,
}

impl Alone {
    pub(crate) fn new(node: &Node, id: &str) -> Self {
        Self::of(node.vehicle(), node.identity().service, &node.identity().instance, id)
    }

    fn of(vehicle: &str, service: &str, instance: &str, id: &str) -> Self {
        let names = [service, instance];
        Self {
            vehicle: vehicle.to_owned(),
            own: [
                topic::HEALTH.key(&names),
                topic::CONFIGURATION.key(&names),
                topic::RECORDER_STATUS.key(&[id]),
            ],
            begun: Instant::now(),
            has_others: AtomicBool::new(false),
        }
    }

    /// Takes the key of a message.
    pub(crate) fn take(&self, key: &str) {
        if !self.has_others.load(Ordering::Relaxed) && self.own.iter().all(|own| own != key) {
            self.has_others.store(true, Ordering::Relaxed);
        }
    }

    /// The warning once the time of the other processes is over.
    pub(crate) fn problem(&self) -> Option<String> {
        (self.begun.elapsed() >= TIMEOUT).then(|| self.warning()).flatten()
    }

    /// The warning, at any time.
    pub(crate) fn warning(&self) -> Option<String> {
        (!self.has_others.load(Ordering::Relaxed)).then(|| {
            format!(
                "no process of the vehicle `{}` is present: only this recorder's own messages are recorded. Name the vehicle with `--vehicle` \
                 (ALIGHT_VEHICLE), and its network with `--meet`, or with `--zenoh` and `--connect`",
                self.vehicle
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_messages_are_no_process_of_the_vehicle() {
        let alone = Alone::of("rhed", "recorder", "main", "main");
        assert_eq!(alone.problem(), None, "others may still start");
        for key in ["health/recorder/main", "config/recorder/main", "recorder/main/status"] {
            alone.take(key);
        }
        let warning = alone.warning().unwrap();
        assert!(warning.contains("`rhed`") && warning.contains("--vehicle"), "{warning}");
        let late = Alone { begun: Instant::now().checked_sub(TIMEOUT).unwrap(), ..alone };
        assert_eq!(late.problem(), Some(warning));
        late.take("health/controller/main");
        assert_eq!((late.problem(), late.warning()), (None, None));
    }
}
