//! The bytes of a JPEG frame: one file after the other, as the header's parts say.
//!
//! Reading trusts nothing: sizes are checked against the header before anything is decoded.

use imaging::{GrayImage, GrayView};
use jpeg_encoder::{ColorType, Encoder};
use messages::{FrameHeader, FramePart, PixelFormat};
use zune_jpeg::JpegDecoder;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use crate::plan::Plan;

/// Parts that a frame may have.
pub const MOST_PARTS: usize = 8;
/// The longest edge of a JPEG, in pixels.
const MOST_EDGE: u32 = 65_535;
/// Pixels that all parts together may have.
const MOST_PIXELS: u64 = 100_000_000;

/// Why a payload was not made or not read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PayloadError {
    /// A part that is not in its frame, or bytes that are not those of the parts.
    #[error("parts that do not fit the frame or its bytes")]
    Misfit,
    /// A size that a JPEG cannot have.
    #[error("a size that a JPEG cannot have")]
    Size,
    /// The encoder's or the decoder's reason.
    #[error("a JPEG that cannot be made or read: {0}")]
    Jpeg(String),
}

/// Makes payloads; keeps its buffers.
#[derive(Debug, Default)]
pub struct Packer {
    scratch: GrayImage,
}

impl Packer {
    /// The payload of a frame, and the header it travels with.
    ///
    /// # Errors
    /// [`PayloadError`] when the plan does not fit the picture.
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

    /// A part's own pixels.
    fn cut(&mut self, view: GrayView<'_>, part: &FramePart) -> Result<&GrayImage, PayloadError> {
        let [x, y, width, height, scale] =
            [part.x, part.y, part.width, part.height, part.scale].map(|n| n as usize);
        if scale == 0 || width.max(height) > MOST_EDGE as usize {
            return Err(PayloadError::Size);
        }
        let source = view.crop(x, y, width * scale, height * scale).ok_or(PayloadError::Misfit)?;
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

/// The means of blocks of `scale` x `scale` pixels, from the row `top` on.
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
    let (width, height) = (edge(image.width())?, edge(image.height())?);
    let mut bytes = Vec::new();
    Encoder::new(&mut bytes, quality)
        .encode(image.pixels(), width, height, ColorType::Luma)
        .map_err(|problem| PayloadError::Jpeg(problem.to_string()))?;
    Ok(bytes)
}

fn whole(width: usize, height: usize) -> FramePart {
    FramePart { x: 0, y: 0, width: width as u32, height: height as u32, scale: 1, bytes: 0 }
}

/// The pictures of a payload; keeps its buffers.
#[derive(Debug, Default)]
pub struct Pictures {
    images: Vec<GrayImage>,
}

impl Pictures {
    /// Decodes the parts of a payload, finest first as they came.
    ///
    /// # Errors
    /// [`PayloadError`] when header and bytes do not fit each other, or a file is none.
    pub fn read(
        &mut self,
        header: &FrameHeader,
        bytes: &[u8],
    ) -> Result<Vec<(FramePart, &GrayImage)>, PayloadError> {
        let parts = parts_of(header, bytes.len())?;
        self.images.resize_with(self.images.len().max(parts.len()), GrayImage::default);
        let mut rest = bytes;
        for (part, image) in parts.iter().zip(&mut self.images) {
            let (file, after) =
                rest.split_at_checked(part.bytes as usize).ok_or(PayloadError::Misfit)?;
            rest = after;
            decode(file, part, image)?;
        }
        Ok(parts.into_iter().zip(&self.images).collect())
    }
}

/// The parts of a frame; the whole one is a part, too.
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
            && (1..=MOST_EDGE).contains(&part.width)
            && (1..=MOST_EDGE).contains(&part.height)
            && lies_within(part.x, part.width, part.scale, header.width)
            && lies_within(part.y, part.height, part.scale, header.height)
    };
    let pixels: u64 = parts.iter().map(|p| u64::from(p.width) * u64::from(p.height)).sum();
    let bytes: u64 = parts.iter().map(|part| u64::from(part.bytes)).sum();
    let all_fit = parts.len() <= MOST_PARTS
        && parts.iter().all(fits)
        && pixels <= MOST_PIXELS
        && bytes == len as u64;
    all_fit.then_some(parts).ok_or(PayloadError::Misfit)
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
        return Err(PayloadError::Misfit);
    }
    image.resize(part.width as usize, part.height as usize);
    decoder.decode_into(image.pixels_mut()).map_err(jpeg)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A wave that is different everywhere.
    fn picture(width: usize, height: usize) -> GrayImage {
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
        FrameHeader {
            camera: "down".into(),
            sequence: 1,
            stamp_ns: 2,
            clock: "c".into(),
            exposure_ns: 0,
            width,
            height,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        }
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
    fn parts_come_back_as_they_were_cut() {
        let image = picture(320, 240);
        let plans = [plan(&[]), plan(&[[64, 40, 96, 64, 1], [0, 0, 80, 60, 4]])];
        for plan in plans {
            let (header, bytes) =
                Packer::default().pack(image.view().unwrap(), &header(320, 240), &plan).unwrap();
            assert_eq!((header.width, header.height, header.format), (320, 240, PixelFormat::Jpeg));
            let mut pictures = Pictures::default();
            let read = pictures.read(&header, &bytes).unwrap();
            assert_eq!(read.len(), plan.parts.len().max(1));
            for (part, found) in read {
                for v in 0..found.height() {
                    for u in 0..found.width() {
                        // The middle of the part's pixel in the frame, where the wave is nearly straight.
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
    fn what_does_not_fit_is_refused_before_it_is_decoded() {
        let image = picture(64, 48);
        let (good, bytes) = Packer::default()
            .pack(image.view().unwrap(), &header(64, 48), &plan(&[[8, 8, 16, 16, 2]]))
            .unwrap();
        let mut pictures = Pictures::default();
        assert!(pictures.read(&good, &bytes).is_ok());
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
            assert!(pictures.read(&bad, &bytes).is_err(), "{bad:?}");
        }
        assert!(pictures.read(&good, &bytes[1..]).is_err());
        let outside = plan(&[[60, 8, 16, 16, 2]]);
        let packed = Packer::default().pack(image.view().unwrap(), &header(64, 48), &outside);
        assert_eq!(packed.map(|_| ()), Err(PayloadError::Misfit));
    }

    proptest! {
        #[test]
        fn damaged_files_do_not_make_it_panic(at in 0_usize..1000, to in any::<u8>()) {
            let image = picture(64, 48);
            let (header, mut bytes) = Packer::default()
                .pack(image.view().unwrap(), &header(64, 48), &plan(&[]))
                .unwrap();
            let len = bytes.len();
            bytes[at % len] = to;
            let _ = Pictures::default().read(&header, &bytes);
        }
    }
}
