//! What a recorder publishes.

use serde::{Deserialize, Serialize};

use crate::codec::wire;

wire! {
    RecorderStatus = 18 v 1;
}

/// What a recorder has kept, and what not.
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
    /// Messages that were kept since the start.
    pub kept: u64,
    /// Messages that were lost since the start, by key; with [`NEVER_CAME`] after it, frames whose numbers are missing.
    pub dropped: Vec<RecorderLoss>,
    /// Why nothing is being kept, as a sentence.
    pub problem: Option<String>,
}

/// Follows the key of frames whose numbers are missing: the simulator left them out, or they were lost on their way to the
/// recorder. What a real camera misses has no number, and stands in its own health.
pub const NEVER_CAME: &str = "(never came)";

/// Whether what is counted under this key are frames that never came; everything else came, and was lost by the recorder.
pub fn has_never_come(key: &str) -> bool {
    key.ends_with(NEVER_CAME)
}

impl RecorderStatus {
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

/// Messages of one key that a recorder lost.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecorderLoss {
    /// The key.
    pub key: String,
    /// How many.
    pub count: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_never_came_is_no_loss_of_the_recorder() {
        let loss = |key: &str, count| RecorderLoss { key: key.into(), count };
        let dropped = vec![
            loss("wind", 3),
            loss("camera/down/frame", 2),
            loss("camera/down/frame (never came)", 7),
        ];
        let status = RecorderStatus { dropped, ..RecorderStatus::default() };
        assert_eq!((status.lost(), status.never_came()), (5, 7));
    }
}
