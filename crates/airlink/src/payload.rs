//! Encodes and decodes the bytes of a JPEG frame: consecutive JPEG files, one per part in the header.
//!
//! Payloads are untrusted: all sizes are checked against the header before anything is decoded.

use std::panic::{AssertUnwindSafe, catch_unwind};

use imaging::{GrayImage, GrayView};
use jpeg_encoder::ColorType;
use messages::{FrameHeader, FramePart, PixelFormat};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::picture::encoded;
use crate::plan::Plan;

/// Maximum number of parts of a frame.
pub const MAX_PARTS: usize = 8;
/// Maximum edge of a JPEG image, in pixels.
const MAX_EDGE_PX: u32 = 65_535;
/// Maximum number of pixels of all parts together.
const MAX_PIXELS: u64 = 100_000_000;

/// Why a payload was not encoded or not decoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PayloadError {
    /// A part outside of its frame, or parts that do not match the bytes.
    #[error("the parts do not match the frame or its bytes")]
    Mismatch,
    /// A size that a JPEG cannot have.
    #[error("a JPEG cannot have this size")]
    Size,
    /// The encoder's or the decoder's reason.
    #[error("JPEG encoding or decoding failed: {0}")]
    Jpeg(String),
}

/// Encodes payloads; reuses its buffers.
#[derive(Debug, Default)]
pub struct Packer {
    scratch: GrayImage,
}

impl Packer {
    /// The header and the payload of a frame.
    ///
    /// # Errors
    /// [`PayloadError`] when the plan does not match the image.
    pub fn pack(
        &mut self,
        view: GrayView<'_>,
        header: &FrameHeader,
        plan: &Plan,
    ) -> Result<(FrameHeader, Vec<u8>), PayloadError> {
        let mut bytes = Vec::new();
        let mut parts = plan.parts.clone();
        if parts.is_empty() {
            bytes = encode(self.cut(view, &whole(view.width(), view.height()))?, plan.quality)?;
        }
        for (index, part) in parts.iter_mut().enumerate() {
            let quality = if index == 0 { plan.quality } else { plan.overview_quality };
            let file = encode(self.cut(view, part)?, quality)?;
            part.bytes = file.len() as u32;
            bytes.extend_from_slice(&file);
        }
        let header = FrameHeader { format: PixelFormat::Jpeg, parts, ..header.clone() };
        Ok((header, bytes))
    }

    /// The pixels of a part, at its scale.
    fn cut(&mut self, view: GrayView<'_>, part: &FramePart) -> Result<&GrayImage, PayloadError> {
        let [x, y, width, height, scale] =
            [part.x, part.y, part.width, part.height, part.scale].map(|n| n as usize);
        if scale == 0 || width.max(height) > MAX_EDGE_PX as usize {
            return Err(PayloadError::Size);
        }
        let source =
            view.crop(x, y, width * scale, height * scale).ok_or(PayloadError::Mismatch)?;
        self.scratch.resize(width, height);
        for row in 0..height {
            let out = self.scratch.row_mut(row);
            if scale == 1 {
                out.copy_from_slice(source.row(row));
            } else {
                shrink_row(source, row * scale, scale, out);
            }
        }
        Ok(&self.scratch)
    }
}

/// Means of the blocks of `scale` x `scale` pixels whose upper edge is the row `top`.
fn shrink_row(source: GrayView<'_>, top: usize, scale: usize, out: &mut [u8]) {
    let half = (scale * scale / 2) as u32;
    let area = (scale * scale) as u32;
    for (column, pixel) in out.iter_mut().enumerate() {
        let block = (top..top + scale).flat_map(|y| {
            source.row(y).iter().skip(column * scale).take(scale).map(|grey| u32::from(*grey))
        });
        *pixel = ((block.sum::<u32>() + half) / area) as u8;
    }
}

fn encode(image: &GrayImage, quality: u8) -> Result<Vec<u8>, PayloadError> {
    let edge = |n: usize| u16::try_from(n).map_err(|_| PayloadError::Size);
    let size = [edge(image.width())?, edge(image.height())?];
    encoded(image.pixels(), size, ColorType::Luma, quality)
        .map_err(|problem| PayloadError::Jpeg(problem.to_string()))
}

fn whole(width: usize, height: usize) -> FramePart {
    FramePart { x: 0, y: 0, width: width as u32, height: height as u32, scale: 1, bytes: 0 }
}

/// Decodes payloads; reuses its buffers.
#[derive(Debug, Default)]
pub struct Unpacker {
    images: Vec<GrayImage>,
}

impl Unpacker {
    /// The parts of a payload in its order, which is finest first.
    ///
    /// # Errors
    /// [`PayloadError`] when header and bytes do not match, or a file is not a valid JPEG.
    pub fn unpack(
        &mut self,
        header: &FrameHeader,
        bytes: &[u8],
    ) -> Result<Vec<(FramePart, &GrayImage)>, PayloadError> {
        let parts = parts_of(header, bytes.len())?;
        self.images.resize_with(self.images.len().max(parts.len()), GrayImage::default);
        let mut rest = bytes;
        for (part, image) in parts.iter().zip(&mut self.images) {
            let (file, after) =
                rest.split_at_checked(part.bytes as usize).ok_or(PayloadError::Mismatch)?;
            rest = after;
            // The decoder panics on some damaged files.
            catch_unwind(AssertUnwindSafe(|| decode(file, part, image)))
                .unwrap_or_else(|_| Err(PayloadError::Jpeg("the decoder failed".to_owned())))?;
        }
        Ok(parts.into_iter().zip(&self.images).collect())
    }
}

/// The parts of a frame; without any, the whole frame as one.
fn parts_of(header: &FrameHeader, len: usize) -> Result<Vec<FramePart>, PayloadError> {
    if header.parts.is_empty() {
        let bytes = u32::try_from(len).map_err(|_| PayloadError::Size)?;
        let part = whole(header.width as usize, header.height as usize);
        return check(header, vec![FramePart { bytes, ..part }], len);
    }
    check(header, header.parts.clone(), len)
}

fn check(
    header: &FrameHeader,
    parts: Vec<FramePart>,
    len: usize,
) -> Result<Vec<FramePart>, PayloadError> {
    let lies_within = |from: u32, pixels: u32, scale: u32, edge: u32| {
        u64::from(from) + u64::from(pixels) * u64::from(scale) <= u64::from(edge)
    };
    let fits = |part: &FramePart| {
        part.scale > 0
            && (1..=MAX_EDGE_PX).contains(&part.width)
            && (1..=MAX_EDGE_PX).contains(&part.height)
            && lies_within(part.x, part.width, part.scale, header.width)
            && lies_within(part.y, part.height, part.scale, header.height)
    };
    let pixels: u64 = parts.iter().map(|p| u64::from(p.width) * u64::from(p.height)).sum();
    let bytes: u64 = parts.iter().map(|part| u64::from(part.bytes)).sum();
    let all_fit = parts.len() <= MAX_PARTS
        && parts.iter().all(fits)
        && pixels <= MAX_PIXELS
        && bytes == len as u64;
    all_fit.then_some(parts).ok_or(PayloadError::Mismatch)
}

fn decode(file: &[u8], part: &FramePart, image: &mut GrayImage) -> Result<(), PayloadError> {
    let options = DecoderOptions::default()
        .jpeg_set_out_colorspace(ColorSpace::Luma)
        .set_max_width(part.width as usize)
        .set_max_height(part.height as usize);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(file), options);
    let jpeg = |problem: zune_jpeg::errors::DecodeErrors| PayloadError::Jpeg(problem.to_string());
    decoder.decode_headers().map_err(jpeg)?;
    let size = decoder.info().map(|info| (u32::from(info.width), u32::from(info.height)));
    if size != Some((part.width, part.height)) {
        return Err(PayloadError::Mismatch);
    }
    image.resize(part.width as usize, part.height as usize);
    decoder.decode_into(image.pixels_mut()).map_err(jpeg)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A wave that does not repeat.
    fn wave(width: usize, height: usize) -> GrayImage {
        let mut image = GrayImage::filled(width, height, 0);
        for y in 0..height {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let wave = (x as f64 * 0.11).sin() + (y as f64 * 0.07 + x as f64 * 0.01).cos();
                *pixel = (128.0 + 50.0 * wave) as u8;
            }
        }
        image
    }

    fn header(width: u32, height: u32) -> FrameHeader {
        FrameHeader { width, height, ..FrameHeader::sample() }
    }

    fn plan(parts: &[[u32; 5]]) -> Plan {
        let part = |[x, y, width, height, scale]: [u32; 5]| FramePart {
            x,
            y,
            width,
            height,
            scale,
            bytes: 0,
        };
        let parts = parts.iter().copied().map(part).collect();
        Plan { quality: 90, overview_quality: 90, parts }
    }

    #[test]
    fn parts_are_unpacked_as_they_were_packed() {
        let image = wave(320, 240);
        let plans = [plan(&[]), plan(&[[64, 40, 96, 64, 1], [0, 0, 80, 60, 4]])];
        for plan in plans {
            let (header, bytes) =
                Packer::default().pack(image.view().unwrap(), &header(320, 240), &plan).unwrap();
            assert_eq!((header.width, header.height, header.format), (320, 240, PixelFormat::Jpeg));
            let mut unpacker = Unpacker::default();
            let read = unpacker.unpack(&header, &bytes).unwrap();
            assert_eq!(read.len(), plan.parts.len().max(1));
            for (part, found) in read {
                for v in 0..found.height() {
                    for u in 0..found.width() {
                        // The centre of the part's pixel in the frame.
                        let centre = |from: u32, at: usize| {
                            (from as usize + part.scale as usize * at) as f64
                                + f64::from(part.scale - 1) / 2.0
                        };
                        let (x, y) = (centre(part.x, u), centre(part.y, v));
                        let wave = (x * 0.11).sin() + (y * 0.07 + x * 0.01).cos();
                        let off = f64::from(found.row(v)[u]) - (128.0 + 50.0 * wave);
                        assert!(off.abs() < 8.0, "{part:?} at {u} {v}: {off}");
                    }
                }
            }
        }
    }

    #[test]
    fn parts_that_do_not_match_are_refused_before_decoding() {
        let image = wave(64, 48);
        let (good, bytes) = Packer::default()
            .pack(image.view().unwrap(), &header(64, 48), &plan(&[[8, 8, 16, 16, 2]]))
            .unwrap();
        let mut unpacker = Unpacker::default();
        assert!(unpacker.unpack(&good, &bytes).is_ok());
        let with = |change: &dyn Fn(&mut FramePart)| {
            let mut header = good.clone();
            change(&mut header.parts[0]);
            header
        };
        for bad in [
            with(&|part| part.x = 60),
            with(&|part| part.width = u32::MAX),
            with(&|part| part.scale = 0),
            with(&|part| part.bytes -= 1),
            with(&|part| part.width = 15),
            FrameHeader { parts: vec![good.parts[0]; 9], ..good.clone() },
            FrameHeader { parts: Vec::new(), ..good.clone() },
        ] {
            assert!(unpacker.unpack(&bad, &bytes).is_err(), "{bad:?}");
        }
        assert!(unpacker.unpack(&good, &bytes[1..]).is_err());
        let outside = plan(&[[60, 8, 16, 16, 2]]);
        let packed = Packer::default().pack(image.view().unwrap(), &header(64, 48), &outside);
        assert_eq!(packed.map(|_| ()), Err(PayloadError::Mismatch));
    }

    proptest! {
        #[test]
        fn damaged_files_do_not_panic(at in 0_usize..1000, to in any::<u8>()) {
            let image = wave(64, 48);
            let (header, mut bytes) = Packer::default()
                .pack(image.view().unwrap(), &header(64, 48), &plan(&[]))
                .unwrap();
            let len = bytes.len();
            bytes[at % len] = to;
            let _ = Unpacker::default().unpack(&header, &bytes);
        }
    }
}
