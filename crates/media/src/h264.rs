//! Decodes H.264 of a camera that is streaming, one picture at a time and without waiting for the next.

use std::collections::BTreeMap;
use std::fmt::{self, Display};

use imaging::{Converter, GrayImage, SampleFormat};
use rust_h264::decoder::{Decoder, Frame};
use rust_h264::nal::{NalUnit, NalUnitType, parse_annex_b, parse_sps_info};
use rust_h264::pps::{Pps, parse_pps};
use rust_h264::slice::parse_slice_header;
use rust_h264::sps::{Sps, parse_sps};

use crate::contained::contained;

/// Why a picture could not be decoded. The decoder continues at the next key frame.
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
pub struct LiveH264 {
    decoder: Decoder,
    limits: Limits,
    /// Whether pictures depend on decoded ones: not before the first key frame, nor after a loss.
    has_begun: bool,
}

impl LiveH264 {
    /// A decoder of pictures of at most so many pixels.
    pub fn new(max_pixels: u64) -> Self {
        Self { decoder: Decoder::default(), limits: Limits::new(max_pixels), has_begun: false }
    }

    /// Forgets the stream: pictures before the next key frame are not decoded, as they refer to missing ones.
    pub fn restart(&mut self) {
        *self = Self::new(self.limits.max_pixels);
    }

    /// Decodes a picture: all of its units, each behind a start code. `None` before the first key frame, and where there is no
    /// picture.
    ///
    /// # Errors
    /// When it is damaged, too large, or in a format that the decoder does not support.
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
            if let Some(excess) = self.limits.excess(&unit) {
                let advice = match excess {
                    Excess::Pixels { .. } => "; set the camera to a smaller size",
                    Excess::Standard { .. } => "",
                };
                return Err(H264Error { cause: format!("it has {excess}{advice}") });
            }
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
pub(crate) fn luma(frame: &Frame) -> Result<GrayImage, H264Error> {
    let format = SampleFormat { bits: u32::from(frame.bit_depth), bayer: None };
    let (width, height) = (frame.width as usize, frame.height as usize);
    let mut converter = Converter::default();
    let view = converter.convert(&frame.y, width, height, format).map_err(H264Error::new)?;
    let mut image = GrayImage::filled(width, height, 0);
    (0..height).for_each(|y| image.row_mut(y).copy_from_slice(view.row(y)));
    Ok(image)
}

/// Maximum number of pictures that others may refer to, all of which are stored in memory, and of entries in a slice's list of
/// them (ITU-T H.264, A.3.1 and 7.4.3).
const MAX_REFERENCES: u32 = 16;
const MAX_REFERENCE_LIST: u32 = 32;
/// Largest numbers of parameter sets, of sequences and of pictures (7.4.2).
const MAX_SEQUENCE: u32 = 31;
const MAX_PICTURE: u32 = 255;
/// Maximum bytes of a slice's header: with all of its lists it has two thousand.
const MAX_HEADER_BYTES: usize = 4096;

/// A value of a stream that exceeds a limit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Excess {
    /// The pixels of a picture.
    Pixels { pixels: u64, limit: u64 },
    /// A number that the standard bounds.
    Standard { count: u32, quantity: &'static str, limit: u32 },
}

impl Display for Excess {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Pixels { pixels, limit } => {
                write!(f, "{pixels} pixels per picture (limit {limit})")
            }
            Self::Standard { count, quantity, limit } => {
                write!(f, "{count} {quantity} (limit {limit})")
            }
        }
    }
}

/// Refuses streams for which a decoder would allocate too much memory, before they are decoded.
pub(crate) struct Limits {
    max_pixels: u64,
    sequences: BTreeMap<u32, Sps>,
    pictures: BTreeMap<u32, Pps>,
}

impl Limits {
    /// For pictures of at most so many pixels.
    pub(crate) fn new(max_pixels: u64) -> Self {
        Self { max_pixels, sequences: BTreeMap::new(), pictures: BTreeMap::new() }
    }

    /// The largest number of pixels of a picture.
    pub(crate) fn max_pixels(&self) -> u64 {
        self.max_pixels
    }

    /// The value of a unit that exceeds a limit, if any. A damaged unit is left to the decoder.
    pub(crate) fn excess(&mut self, unit: &NalUnit<'_>) -> Option<Excess> {
        let beyond = |count: u32, quantity: &'static str, limit: u32| {
            (count > limit).then_some(Excess::Standard { count, quantity, limit })
        };
        match unit.nal_unit_type {
            NalUnitType::Sps => {
                let info = parse_sps_info(unit).ok()?;
                let pixels = u64::from(info.coded_width) * u64::from(info.coded_height);
                if pixels > self.max_pixels {
                    return Some(Excess::Pixels { pixels, limit: self.max_pixels });
                }
                let sps = parse_sps(&unit.rbsp).ok()?;
                let id = sps.seq_parameter_set_id;
                let excess = beyond(info.reference_frames, "pictures referred to", MAX_REFERENCES);
                let excess = excess.or_else(|| beyond(id, "as a sequence's number", MAX_SEQUENCE));
                if excess.is_none() {
                    self.sequences.insert(id, sps);
                }
                excess
            }
            NalUnitType::Pps => {
                // Which sequence it is of changes its scaling lists only.
                let pps = parse_pps(&unit.rbsp, None).ok()?;
                let id = pps.pic_parameter_set_id;
                let excess = beyond(id, "as a picture's number", MAX_PICTURE);
                if excess.is_none() {
                    self.pictures.insert(id, pps);
                }
                excess
            }
            NalUnitType::Slice | NalUnitType::SliceIdr => {
                let bytes = unit.rbsp.get(..MAX_HEADER_BYTES).unwrap_or(&unit.rbsp);
                let pps = self.pictures.get(&picture_of_slice(bytes)?)?;
                let sps = self.sequences.get(&pps.seq_parameter_set_id)?;
                let (kind, importance) = (unit.nal_unit_type, unit.nal_ref_idc);
                match parse_slice_header(bytes, sps, pps, kind, importance) {
                    Ok((header, _)) => {
                        let count = header.num_ref_idx_l0_active.max(header.num_ref_idx_l1_active);
                        beyond(count, "references of a slice", MAX_REFERENCE_LIST)
                    }
                    Err(_) => {
                        let length = u32::try_from(unit.rbsp.len()).unwrap_or(u32::MAX);
                        beyond(length, "bytes of a slice's header", MAX_HEADER_BYTES as u32)
                    }
                }
            }
            _ => None,
        }
    }
}

/// The number of a slice's parameter set: the third of its header's numbers, which are exponential Golomb codes (9.1).
fn picture_of_slice(bytes: &[u8]) -> Option<u32> {
    let mut bits = bytes.iter().flat_map(|byte| (0..8).rev().map(move |bit| byte >> bit & 1 == 1));
    let mut number = || {
        let zeros = bits.by_ref().take_while(|bit| !bit).take(32).count();
        let rest = bits.by_ref().take(zeros).fold(0_u64, |sum, bit| sum << 1 | u64::from(bit));
        u32::try_from((1_u64 << zeros) - 1 + rest).ok()
    };
    let (_first_block, _kind) = (number()?, number()?);
    number()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slice_with_more_references_than_the_standard_allows_is_refused() {
        // Found by fuzzing: a few pictures of it take a gigabyte.
        let stream = include_bytes!("../../../fuzz/corpus/h264/many_references.h264");
        let mut limits = Limits::new(1 << 20);
        let excess: Vec<Excess> =
            parse_annex_b(stream).iter().filter_map(|unit| limits.excess(unit)).collect();
        let is_list =
            |it: &Excess| matches!(it, Excess::Standard { limit: MAX_REFERENCE_LIST, .. });
        assert!(excess.iter().any(is_list), "{excess:?}");
        // Far beyond, before the requested lists are allocated.
        let long = NalUnit { rbsp: vec![0xff; 5 << 20].into(), ..parse_annex_b(stream).remove(2) };
        assert!(limits.excess(&long).is_some());
    }
}
