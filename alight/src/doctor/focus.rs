//! Measures the sharpness (edge width) of received camera frames for `alight doctor`.

use std::collections::BTreeMap;

use imaging::{Converter, GrayImage, edge_width_px};
use messages::FrameHeader;
use node::{Frame, now_ns};

/// Time from one picture of a camera that is looked at to the next, in nanoseconds.
const PERIOD_NS: i64 = 500_000_000;
/// Maximum number of cameras that are looked at.
const MAX_CAMERAS: usize = 16;

/// A received frame.
pub(super) struct ReceivedFrame {
    pub(super) header: FrameHeader,
    pub(super) bytes: usize,
    pub(super) received_ns: i64,
    /// The width of edges in it, if that was measured.
    pub(super) edge_width_px: Option<f64>,
}

/// Looks at two pictures a second of each camera.
#[derive(Default)]
pub(super) struct Focus {
    converter: Converter,
    looked_ns: BTreeMap<String, i64>,
}

impl Focus {
    /// The header, size and, twice a second, the edge width of a frame.
    pub(super) fn received(&mut self, frame: Frame) -> ReceivedFrame {
        let received_ns = now_ns();
        let bytes = frame.bytes().len();
        let camera = &frame.header.camera;
        let last_ns = self.looked_ns.get(camera).copied();
        let is_due = match last_ns {
            Some(last_ns) => received_ns - last_ns >= PERIOD_NS,
            None => self.looked_ns.len() < MAX_CAMERAS,
        };
        let mut edge_width = None;
        if is_due {
            self.looked_ns.insert(camera.clone(), received_ns);
            // The detector reports frames that cannot be decoded.
            let image = crate::grey::grey(&frame, &mut self.converter).ok();
            let view = image.as_ref().and_then(GrayImage::view);
            edge_width = view.and_then(edge_width_px);
        }
        ReceivedFrame { header: frame.header, bytes, received_ns, edge_width_px: edge_width }
    }
}
