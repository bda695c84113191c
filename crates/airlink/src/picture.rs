//! Pictures of frames, for people.

use std::borrow::Cow;

use messages::{FrameHeader, PixelFormat};

/// A frame as a JPEG file; `None` for one that is no whole grey or Bayer image. A Bayer image is shown as it is, grey.
pub fn jpeg(header: &FrameHeader, pixels: &[u8], quality: u8) -> Option<Vec<u8>> {
    if header.format == PixelFormat::Jpeg {
        return Some(pixels.to_vec());
    }
    let (width, height) = (u16::try_from(header.width).ok()?, u16::try_from(header.height).ok()?);
    let mut file = Vec::new();
    let encoder = jpeg_encoder::Encoder::new(&mut file, quality);
    encoder.encode(&grey(header, pixels)?, width, height, jpeg_encoder::ColorType::Luma).ok()?;
    Some(file)
}

/// The pixels of a frame with 8 bits each; `None` for one that is no whole grey or Bayer image.
pub fn grey<'a>(header: &FrameHeader, pixels: &'a [u8]) -> Option<Cow<'a, [u8]>> {
    let bits = match header.format {
        PixelFormat::Jpeg => return None,
        PixelFormat::Mono8 | PixelFormat::Bayer8(_) => 8,
        PixelFormat::Mono10 | PixelFormat::Bayer10(_) => 10,
        PixelFormat::Mono12 | PixelFormat::Bayer12(_) => 12,
        PixelFormat::Mono16 | PixelFormat::Bayer16(_) => 16,
    };
    let samples = usize::try_from(header.width).ok()?.checked_mul(header.height as usize)?;
    if samples.checked_mul(header.format.bytes_per_pixel()?) != Some(pixels.len()) {
        return None;
    }
    if bits == 8 {
        return Some(Cow::Borrowed(pixels));
    }
    let eight = |pair: &[u8; 2]| (u16::from_le_bytes(*pair) >> (bits - 8)).min(255) as u8;
    Some(Cow::Owned(pixels.as_chunks::<2>().0.iter().map(eight).collect()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(format: PixelFormat) -> FrameHeader {
        FrameHeader { width: 16, height: 8, format, parts: Vec::new(), ..FrameHeader::sample() }
    }

    #[test]
    fn grey_of_any_depth_becomes_a_picture() {
        for (format, bytes) in [(PixelFormat::Mono8, 128), (PixelFormat::Mono12, 256)] {
            let file = jpeg(&header(format), &vec![7; bytes], 90).unwrap();
            assert!(file.starts_with(&[0xff, 0xd8]), "{format:?}");
            assert_eq!(jpeg(&header(format), &vec![7; bytes - 1], 90), None);
        }
    }
}
