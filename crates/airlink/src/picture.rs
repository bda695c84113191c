//! Encodes a frame as a JPEG file or as 8-bit grey pixels, for the page, the recorder and viewers; and a debug image in colours
//! as a JPEG file.

use std::borrow::Cow;

use jpeg_encoder::{ColorType, Encoder, EncodingError};
use messages::{FrameHeader, PixelFormat};

/// A frame as a JPEG file; `None` for other than complete grey or Bayer images. A Bayer image is shown as it is, grey.
pub fn jpeg(header: &FrameHeader, pixels: &[u8], quality: u8) -> Option<Vec<u8>> {
    if header.format == PixelFormat::Jpeg {
        return Some(pixels.to_vec());
    }
    let (width, height) = (u16::try_from(header.width).ok()?, u16::try_from(header.height).ok()?);
    encoded(&grey(header, pixels)?, [width, height], ColorType::Luma, quality).ok()
}

/// Red, green and blue of each pixel in turn as a JPEG file; `None` for fewer pixels than width by height, or more than a JPEG has.
pub fn jpeg_of_rgb(pixels: &[u8], width: usize, height: usize, quality: u8) -> Option<Vec<u8>> {
    let (width, height) = (u16::try_from(width).ok()?, u16::try_from(height).ok()?);
    encoded(pixels, [width, height], ColorType::Rgb, quality).ok()
}

/// Pixels, width by height, as a JPEG file.
pub(crate) fn encoded(
    pixels: &[u8],
    [width, height]: [u16; 2],
    colours: ColorType,
    quality: u8,
) -> Result<Vec<u8>, EncodingError> {
    let mut file = Vec::new();
    Encoder::new(&mut file, quality).encode(pixels, width, height, colours)?;
    Ok(file)
}

/// The pixels of a frame with 8 bits each; `None` for other than complete grey or Bayer images.
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

    #[test]
    fn a_picture_has_colours() {
        let pixels = [200, 30, 90].repeat(16 * 8);
        let file = jpeg_of_rgb(&pixels, 16, 8, 95).unwrap();
        let (size, read) = decoded(&file);
        assert_eq!(size, (16, 8));
        assert!(read.iter().zip(&pixels).all(|(a, b)| a.abs_diff(*b) < 6), "{:?}", &read[..3]);
        assert_eq!(jpeg_of_rgb(&pixels[1..], 16, 8, 95), None);
        assert_eq!(jpeg_of_rgb(&pixels, 1 << 16, 8, 95), None);
    }

    fn decoded(file: &[u8]) -> ((usize, usize), Vec<u8>) {
        let mut decoder = zune_jpeg::JpegDecoder::new(std::io::Cursor::new(file));
        let pixels = decoder.decode().unwrap();
        (decoder.dimensions().unwrap(), pixels)
    }
}
