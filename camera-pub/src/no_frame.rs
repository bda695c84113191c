//! Describes why a picture gives no frame, with the size that it has and the one that is configured.

use std::time::Duration;

use crate::config::FrameSize;
use crate::v4l2::capture::Lost;

/// Why a picture gives no frame.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum NoFrame {
    /// It cannot be read.
    Damaged,
    /// It has another size.
    OtherSize(FrameSize),
}

impl NoFrame {
    /// Why a camera that has sent nothing else for so long counts as lost, where frames of this size are configured.
    pub(crate) fn as_loss(self, wanted: FrameSize, for_ns: i64) -> Lost {
        match self {
            Self::Damaged => Lost::Unreadable(Duration::from_nanos(for_ns.unsigned_abs())),
            Self::OtherSize(size) => Lost::FormatChanged(other_size(size, wanted)),
        }
    }
}

/// The error that frames have a size other than the one that is configured.
pub(crate) fn other_size(size: FrameSize, wanted: FrameSize) -> String {
    let FrameSize { width, height } = size;
    format!(
        "its frames have {width} x {height} pixels, {} x {} are configured: correct `source.size_px`, or the size at the source",
        wanted.width, wanted.height
    )
}
