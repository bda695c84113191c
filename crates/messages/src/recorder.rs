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
    /// Messages that were lost since the start, by key.
    pub dropped: Vec<RecorderLoss>,
    /// Why nothing is being kept, as a sentence.
    pub problem: Option<String>,
}

/// Messages of one key that a recorder lost.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecorderLoss {
    /// The key.
    pub key: String,
    /// How many.
    pub count: u64,
}
