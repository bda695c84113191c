//! Makes frames for the file and for viewers, with the picture that is recorded of them.

use std::collections::BTreeMap;

use airlink::Rate;
use airlink::picture::jpeg;
use flightlog::{Picture, Received};
use messages::{FrameHeader, decode, topic};
use node::Tapped;

use crate::config::{Config, Frames};

/// Maximum number of cameras whose last pictures are remembered.
const MAX_CAMERAS: usize = 1024;

/// The recorded part of a frame.
#[derive(Clone, Debug)]
pub(crate) struct Frame {
    /// Its header.
    pub(crate) header: FrameHeader,
    /// Its picture, as configured.
    pub(crate) picture: Picture,
    /// Whether that is all that is configured: an incomplete image makes no picture.
    pub(crate) is_complete: bool,
}

/// Makes the pictures.
#[derive(Debug)]
pub(crate) struct Pictures {
    frames: Frames,
    jpeg_quality: u8,
    /// At most so many of each camera a second, by the stamps of its frames.
    max_hz: f64,
    /// Which frames of each camera are taken, by their key.
    rates: BTreeMap<String, Rate>,
}

impl Pictures {
    /// As configured.
    pub(crate) fn new(config: &Config, frames: Frames) -> Self {
        let (jpeg_quality, max_hz) = (config.jpeg_quality, config.max_picture_hz);
        Self { frames, jpeg_quality, max_hz, rates: BTreeMap::new() }
    }

    /// The frame that a message with this header is.
    pub(crate) fn frame(&mut self, message: &Tapped, header: FrameHeader) -> Frame {
        let known = self.rates.get(&message.key);
        let is_remembered = known.is_some() || self.rates.len() < MAX_CAMERAS;
        let mut rate = known.cloned().unwrap_or_else(|| Rate::new(self.max_hz));
        let is_due = rate.is_due(header.stamp_ns);
        let picture = match self.frames {
            Frames::Jpeg if is_due => {
                jpeg(&header, &message.payload, self.jpeg_quality).map(Picture::Jpeg)
            }
            Frames::Raw if is_due => Some(Picture::Pixels),
            Frames::Jpeg | Frames::Raw | Frames::None => Some(Picture::None),
        };
        let is_complete = picture.is_some();
        let picture = picture.unwrap_or(Picture::None);
        if picture != Picture::None && is_remembered {
            rate.take(header.stamp_ns);
            self.rates.insert(message.key.clone(), rate);
        }
        Frame { header, picture, is_complete }
    }
}

/// The header of a frame; `None` for any other message.
pub(crate) fn header(message: &Tapped) -> Option<FrameHeader> {
    topic::FRAME.first_name(&message.key)?;
    decode(&message.attachment).ok()
}

/// A message as it was received.
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
    use node::Layers;

    use super::*;

    #[test]
    fn a_camera_of_the_maximum_rate_loses_no_pictures_though_its_frames_come_unevenly() {
        let layers = Layers { file: None, set: vec!["max_picture_hz=15".into()] };
        let config = layers.load::<Config>().unwrap().settings;
        let mut pictures = Pictures::new(&config, Frames::Raw);
        let message = Tapped { key: "camera/down/frame".into(), ..Tapped::default() };
        let kept = (0..150).filter(|number| {
            let stamp_ns = number * 1_000_000_000 / 15 + number % 2 * 50_000;
            let header = FrameHeader { stamp_ns, ..FrameHeader::sample() };
            pictures.frame(&message, header).picture == Picture::Pixels
        });
        let kept = kept.count();
        assert!(kept >= 149, "{kept} of 150");
    }

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
