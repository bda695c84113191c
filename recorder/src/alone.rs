//! Warns when no message of another process of the recorder's vehicle arrives, as with a wrong vehicle name, or none of a controller.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use messages::topic;
use node::Node;

/// Time after the start within which a message is expected: each process publishes its health once a second.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Whether only this recorder's own messages have arrived, and whether one of a controller has.
pub(crate) struct Alone {
    vehicle: String,
    /// The keys of its own messages.
    own: [String; 3],
    /// The keys that only a controller publishes, except its health.
    of_controller: [String; 2],
    begun: Instant,
    has_others: AtomicBool,
    has_controller: AtomicBool,
}

impl Alone {
    /// A recorder without a file, which only serves viewers, needs no controller.
    pub(crate) fn new(node: &Node, id: &str, has_file: bool) -> Self {
        let identity = node.identity();
        let alone = Self::of(node.vehicle(), &[identity.service, &identity.instance], id);
        Self { has_controller: AtomicBool::new(!has_file), ..alone }
    }

    fn of(vehicle: &str, process: &[&str], id: &str) -> Self {
        Self {
            vehicle: vehicle.to_owned(),
            own: [
                topic::HEALTH.key(process),
                topic::CONFIGURATION.key(process),
                topic::RECORDER_STATUS.key(&[id]),
            ],
            of_controller: [topic::STATUS.key(&[]), topic::TAPE.key(&[])],
            begun: Instant::now(),
            has_others: AtomicBool::new(false),
            has_controller: AtomicBool::new(false),
        }
    }

    /// Takes the key of a message.
    pub(crate) fn take(&self, key: &str) {
        if !self.has_others.load(Ordering::Relaxed) && self.own.iter().all(|own| own != key) {
            self.has_others.store(true, Ordering::Relaxed);
        }
        if !self.has_controller.load(Ordering::Relaxed) && self.is_of_controller(key) {
            self.has_controller.store(true, Ordering::Relaxed);
        }
    }

    /// Whether it is the key of a message that a controller publishes.
    fn is_of_controller(&self, key: &str) -> bool {
        topic::HEALTH.first_name(key) == Some("controller")
            || self.of_controller.iter().any(|of_it| of_it == key)
    }

    /// The warning, once the time for a message of another process is over.
    pub(crate) fn warning_in_time(&self) -> Option<String> {
        if self.begun.elapsed() < TIMEOUT {
            return None;
        }
        self.warning().or_else(|| {
            (!self.has_controller.load(Ordering::Relaxed)).then(|| {
                format!(
                    "no message of a controller of the vehicle `{}` has arrived: the recording contains no decisions until a controller starts. \
                     Start one, unless only the camera is to be recorded",
                    self.vehicle
                )
            })
        })
    }

    /// The warning, at any time.
    pub(crate) fn warning(&self) -> Option<String> {
        (!self.has_others.load(Ordering::Relaxed)).then(|| {
            format!(
                "no message of another process of the vehicle `{}` has arrived, so this recorder has only its own messages. Check the vehicle's \
                 name (`--vehicle`, ALIGHT_VEHICLE) and the network (`--meet`, or `--zenoh` and `--connect`)",
                self.vehicle
            )
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn own_messages_are_not_those_of_another_process() {
        let alone = Alone::of("rhed", &["recorder", "main"], "main");
        assert_eq!(alone.warning_in_time(), None, "others may still start");
        for key in ["health/recorder/main", "config/recorder/main", "recorder/main/status"] {
            alone.take(key);
        }
        let warning = alone.warning().unwrap();
        assert!(warning.contains("`rhed`") && warning.contains("--vehicle"), "{warning}");
        let late = Alone { begun: Instant::now().checked_sub(TIMEOUT).unwrap(), ..alone };
        assert_eq!(late.warning_in_time(), Some(warning));
        late.take("health/detector/main");
        let warning = late.warning_in_time().unwrap();
        assert!(warning.contains("controller of the vehicle `rhed`"), "{warning}");
        assert_eq!(late.warning(), None, "at its end the file shows it");
        late.take("health/controller/main");
        assert_eq!((late.warning_in_time(), late.warning()), (None, None));
    }
}
