//! Message of a recorder: its file, the number of messages stored, lost or never received by key, and its error.

use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    RecorderStatus = 18 v 2;
}

/// The messages that a recorder has stored and lost.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecorderStatus {
    /// The recorder's name.
    pub recorder: String,
    /// When, in nanoseconds of the recorder's clock.
    pub stamp_ns: i64,
    /// The file that is being written; empty while there is none.
    pub file: String,
    /// Bytes of it that are on the disk.
    pub bytes: u64,
    /// Bytes that wait for the disk.
    pub waiting_bytes: u64,
    /// Bytes that are free for the recorder on the disk of the file, as of the last time that something was written to it;
    /// `None` while there is no file, or where its file system has no bound.
    pub free_bytes: Option<u64>,
    /// Messages that were stored since the start, by key; of at most [`Self::MAX_KEYS`] keys.
    pub kept: Vec<RecorderCount>,
    /// Messages that were lost since the start, by key; with [`NEVER_CAME`] after it, frames whose numbers are missing. Of at most
    /// [`Self::MAX_KEYS`] keys.
    pub dropped: Vec<RecorderCount>,
    /// Why no messages are stored, as a sentence.
    pub problem: Option<String>,
}

/// The name under which messages of further keys are counted.
pub const OTHER_KEYS: &str = "other keys";

/// Follows the key of frames whose numbers are missing: the simulator left them out, or they were lost on their way to the
/// recorder. Frames that a real camera misses have no number, and are counted in its health.
pub const NEVER_CAME: &str = "(never came)";

/// Whether this key counts frames that never came; messages of all other keys came, and were lost by the recorder.
pub fn has_never_come(key: &str) -> bool {
    key.ends_with(NEVER_CAME)
}

impl RecorderStatus {
    /// Maximum number of keys that are counted, [`OTHER_KEYS`] among them.
    pub const MAX_KEYS: usize = 256;

    /// How many messages were stored.
    pub fn total_kept(&self) -> u64 {
        self.kept.iter().map(|kept| kept.count).sum()
    }

    /// How many messages came to the recorder and were lost by it.
    pub fn lost(&self) -> u64 {
        self.sum(|key| !has_never_come(key))
    }

    /// How many frames never came to it.
    pub fn never_came(&self) -> u64 {
        self.sum(has_never_come)
    }

    fn sum(&self, is_of_it: impl Fn(&str) -> bool) -> u64 {
        let losses = self.dropped.iter().filter(|loss| is_of_it(&loss.key));
        losses.map(|loss| loss.count).sum()
    }
}

/// Messages of one key that a recorder stored or lost.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecorderCount {
    /// The key.
    pub key: String,
    /// How many.
    pub count: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_that_never_came_are_no_loss_of_the_recorder() {
        let count = |key: &str, count| RecorderCount { key: key.into(), count };
        let dropped = vec![
            count("wind", 3),
            count("camera/down/frame", 2),
            count("camera/down/frame (never came)", 7),
        ];
        let kept = vec![count("wind", 40), count("camera/down/frame", 2)];
        let status = RecorderStatus { kept, dropped, ..RecorderStatus::default() };
        assert_eq!((status.total_kept(), status.lost(), status.never_came()), (42, 5, 7));
    }
}
