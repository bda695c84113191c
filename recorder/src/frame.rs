//! Messages for the file and for those who follow: frames with the picture that is kept of them.

use std::collections::BTreeMap;

use airlink::picture::jpeg;
use flightlog::{Picture, Received};
use messages::{FrameHeader, decode, topic};
use node::Tapped;

use crate::config::{Config, Frames};

/// Maximum number of cameras whose last pictures are remembered.
const MAX_CAMERAS: usize = 1024;

/// What is kept of a frame.
#[derive(Clone, Debug)]
pub(crate) struct Frame {
    /// Its header.
    pub(crate) header: FrameHeader,
    /// Its picture, as configured.
    pub(crate) picture: Picture,
    /// Whether that is all that is configured: pixels that are no whole image make no picture.
    pub(crate) is_whole: bool,
}

/// Makes the pictures.
#[derive(Debug)]
pub(crate) struct Pictures {
    frames: Frames,
    jpeg_quality: u8,
    period_ns: i64,
    /// When the last picture of each camera was taken, in nanoseconds, by the key of its frames.
    last: BTreeMap<String, i64>,
}

impl Pictures {
    /// As configured.
    pub(crate) fn new(config: &Config, frames: Frames) -> Self {
        let period_ns = (1e9 / config.max_picture_hz) as i64;
        Self { frames, jpeg_quality: config.jpeg_quality, period_ns, last: BTreeMap::new() }
    }

    /// The frame that a message with this header is.
    pub(crate) fn frame(&mut self, message: &Tapped, header: FrameHeader) -> Frame {
        // A camera that begins anew may have other stamps.
        let last_ns = self.last.get(&message.key).copied();
        let is_due = last_ns.is_none_or(|last_ns| {
            header.stamp_ns.saturating_sub(last_ns).saturating_abs() >= self.period_ns
        });
        let picture = match self.frames {
            Frames::Jpeg if is_due => {
                jpeg(&header, &message.payload, self.jpeg_quality).map(Picture::Jpeg)
            }
            Frames::Raw if is_due => Some(Picture::Pixels),
            Frames::Jpeg | Frames::Raw | Frames::None => Some(Picture::None),
        };
        let is_whole = picture.is_some();
        let picture = picture.unwrap_or(Picture::None);
        if picture != Picture::None && (self.last.len() < MAX_CAMERAS || last_ns.is_some()) {
            self.last.insert(message.key.clone(), header.stamp_ns);
        }
        Frame { header, picture, is_whole }
    }
}

/// The header of a frame; `None` for any other message.
pub(crate) fn header(message: &Tapped) -> Option<FrameHeader> {
    topic::FRAME.first_name(&message.key)?;
    decode(&message.attachment).ok()
}

/// A message as it came.
pub(crate) fn received(message: &Tapped) -> Received<'_> {
    Received {
        key: &message.key,
        payload: &message.payload,
        attachment: &message.attachment,
        received_ns: message.received_ns,
    }
}

#[cfg(test)]
mod tests {
    use messages::encode;

    use super::*;

    #[test]
    fn only_a_frame_with_a_header_of_ours_is_a_frame() {
        let sent = FrameHeader { sequence: 7, ..FrameHeader::sample() };
        let message = |key: &str, attachment: Vec<u8>| Tapped {
            key: key.into(),
            attachment,
            ..Tapped::default()
        };
        assert_eq!(header(&message("camera/down/frame", encode(&sent))), Some(sent.clone()));
        assert_eq!(header(&message("camera/down/frame", vec![1, 2, 3])), None);
        assert_eq!(header(&message("health/recorder/main", encode(&sent))), None);
    }
}
