//! Converts a frame received from a topic into a grey image: raw samples converted, JPEG decoded; of a frame in parts the largest at full
//! resolution.

use std::path::Path;

use anyhow::Context;
use imaging::{Converter, GrayImage};
use messages::{FrameHeader, FramePart};
use node::Frame;

/// Maximum size of an image, in pixels.
const MAX_PIXELS: u64 = 100_000_000;

/// The image of a frame in grey; of one that came in several parts the largest at full resolution.
///
/// # Errors
/// When the frame is damaged, or came at a lower resolution only.
pub(crate) fn grey(frame: &Frame, converter: &mut Converter) -> anyhow::Result<GrayImage> {
    let FrameHeader { width, height, format, ref parts, .. } = frame.header;
    let bytes = frame.bytes();
    let Some(samples) = format.sample_format() else {
        let file = if parts.is_empty() { Some(&*bytes) } else { largest(parts, &bytes) };
        let file = file.context("the frame came at a lower resolution only")?;
        return media::decode_image(Path::new("frame"), file, MAX_PIXELS)
            .context("reading a frame");
    };
    let view = converter
        .convert(&bytes, width as usize, height as usize, samples)
        .context("reading a frame")?;
    let mut image = GrayImage::filled(view.width(), view.height(), 0);
    for y in 0..view.height() {
        image.row_mut(y).copy_from_slice(view.row(y));
    }
    Ok(image)
}

/// The file of the largest part that is not scaled down.
fn largest<'a>(parts: &[FramePart], files: &'a [u8]) -> Option<&'a [u8]> {
    let mut rest = files;
    let mut found: Option<(u64, &[u8])> = None;
    for part in parts {
        let file;
        (file, rest) = rest.split_at_checked(part.bytes as usize)?;
        let area = u64::from(part.width) * u64::from(part.height);
        if part.scale == 1 && found.is_none_or(|(largest, _)| area > largest) {
            found = Some((area, file));
        }
    }
    found.map(|(_, file)| file)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_part_at_full_resolution_is_taken() {
        let part = |width, scale, bytes| FramePart { x: 0, y: 0, width, height: 10, scale, bytes };
        let parts = [part(90, 4, 2), part(20, 1, 3), part(30, 1, 1)];
        assert_eq!(largest(&parts, b"aabbbc"), Some(&b"c"[..]));
        assert_eq!(largest(&parts[..1], b"aa"), None);
        assert_eq!(largest(&parts, b"aabb"), None, "cut off");
    }
}
