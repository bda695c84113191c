//! Decodes H.264 of a camera that is streaming, one picture at a time and without waiting for the next.

use std::fmt::Display;

use imaging::{Converter, GrayImage, SampleFormat};
use rust_h264::decoder::{Decoder, Frame};
use rust_h264::nal::{NalUnit, NalUnitType, parse_annex_b, parse_sps_info};

use crate::contained::contained;

/// Why a picture could not be decoded. The decoder goes on at the next key frame.
#[derive(Debug, thiserror::Error)]
#[error("a picture of H.264 cannot be decoded: {cause}")]
pub struct H264Error {
    cause: String,
}

impl H264Error {
    fn new(cause: impl Display) -> Self {
        Self { cause: cause.to_string() }
    }
}

/// A decoder of H.264 (Baseline, Main and High profile, 8 and 10 bits) for grey images. Pictures come out in the order of the
/// stream: with B-frames that is not the order in which they were taken.
#[derive(Default)]
pub struct LiveH264 {
    decoder: Decoder,
    /// Whether pictures depend on what was decoded: not before the first key frame, nor after a loss.
    has_begun: bool,
    max_pixels: u64,
}

impl LiveH264 {
    /// A decoder of pictures of at most so many pixels.
    pub fn new(max_pixels: u64) -> Self {
        Self { max_pixels, ..Self::default() }
    }

    /// Forgets the stream: pictures before the next key frame are not decoded, as they refer to what is missing.
    pub fn restart(&mut self) {
        *self = Self::new(self.max_pixels);
    }

    /// Decodes a picture: all of its units, each behind a start code. `None` before the first key frame, and where there is no
    /// picture.
    ///
    /// # Errors
    /// When it is damaged, too large, or in a format that the decoder does not know.
    pub fn decode(&mut self, picture: &[u8]) -> Result<Option<GrayImage>, H264Error> {
        let decoded = contained(|| self.decode_unchecked(picture), |cause| H264Error::new(cause));
        if decoded.is_err() {
            self.restart();
        }
        decoded
    }

    /// As [`LiveH264::decode`]; panics where the decoder does.
    fn decode_unchecked(&mut self, picture: &[u8]) -> Result<Option<GrayImage>, H264Error> {
        let mut frame = None;
        for unit in parse_annex_b(picture) {
            check_size(&unit, self.max_pixels)?;
            self.has_begun |= unit.nal_unit_type == NalUnitType::SliceIdr;
            let is_slice = unit.nal_unit_type == NalUnitType::Slice;
            if is_slice && !self.has_begun {
                continue;
            }
            frame = self.decoder.decode_nal(&unit).map_err(H264Error::new)?.or(frame);
        }
        // The decoder would hold the picture until the next one begins.
        self.decoder.flush().or(frame).map(|frame| luma(&frame)).transpose()
    }
}

/// The luma of a picture, as 8 bits.
fn luma(frame: &Frame) -> Result<GrayImage, H264Error> {
    let format = SampleFormat { bits: u32::from(frame.bit_depth), bayer: None };
    let (width, height) = (frame.width as usize, frame.height as usize);
    let mut converter = Converter::default();
    let view = converter.convert(&frame.y, width, height, format).map_err(H264Error::new)?;
    let mut image = GrayImage::filled(width, height, 0);
    (0..height).for_each(|y| image.row_mut(y).copy_from_slice(view.row(y)));
    Ok(image)
}

/// Refuses pictures that are too large before they are decoded.
fn check_size(unit: &NalUnit<'_>, max_pixels: u64) -> Result<(), H264Error> {
    if unit.nal_unit_type != NalUnitType::Sps {
        return Ok(());
    }
    let info = parse_sps_info(unit).map_err(H264Error::new)?;
    let pixels = u64::from(info.coded_width) * u64::from(info.coded_height);
    if pixels > max_pixels {
        let cause = format!(
            "it has {pixels} pixels (limit {max_pixels}); set the camera to a smaller size"
        );
        return Err(H264Error { cause });
    }
    Ok(())
}
