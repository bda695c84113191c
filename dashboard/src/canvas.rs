//! Draws the picture of a camera: its frame, or the parts of the air link's frames over the previous picture.

use airlink::Unpacker;
use airlink::picture::grey;
use imaging::GrayImage;
use messages::{FrameHeader, FramePart, PixelFormat};

/// Maximum width and height of a picture, in pixels: receivers at the ground decode Full HD, and a larger frame would take
/// the time of the next.
const MAX_EDGE: usize = 1920;
/// Intensity of pixels that have not been received yet.
const UNSEEN: u8 = 128;

/// The picture of one camera.
#[derive(Debug, Default)]
pub(crate) struct Canvas {
    image: GrayImage,
    /// The frames' size, and the factor by which the picture is smaller.
    frame: [u32; 2],
    scale: usize,
    unpacker: Unpacker,
}

impl Canvas {
    /// Draws a frame.
    ///
    /// # Errors
    /// The reason for which the frame cannot be drawn.
    pub(crate) fn draw(
        &mut self,
        header: &FrameHeader,
        bytes: &[u8],
    ) -> Result<&GrayImage, String> {
        let frame = [header.width, header.height];
        if self.frame != frame {
            let [width, height] = frame.map(|edge| edge as usize);
            let scale = width.max(height).div_ceil(MAX_EDGE).max(1);
            self.image = GrayImage::filled(width / scale, height / scale, UNSEEN);
            (self.frame, self.scale) = (frame, scale);
        }
        if header.format == PixelFormat::Jpeg {
            let mut unpacker = std::mem::take(&mut self.unpacker);
            let parts = unpacker.unpack(header, bytes).map_err(|error| error.to_string())?;
            // The finest parts are first, and are drawn last.
            for (part, image) in parts.iter().rev() {
                self.place(part, image.pixels());
            }
            self.unpacker = unpacker;
        } else {
            let pixels = grey(header, bytes).ok_or("it is not a complete grey or Bayer image")?;
            let [width, height] = frame;
            let full = FramePart { x: 0, y: 0, width, height, scale: 1, bytes: 0 };
            self.place(&full, &pixels);
        }
        Ok(&self.image)
    }

    /// Draws a part, each pixel of the picture as the part's nearest one.
    fn place(&mut self, part: &FramePart, pixels: &[u8]) {
        let [x, y, width, height, scale] =
            [part.x, part.y, part.width, part.height, part.scale.max(1)].map(|it| it as usize);
        let columns =
            x.div_ceil(self.scale)..((x + width * scale) / self.scale).min(self.image.width());
        let rows =
            y.div_ceil(self.scale)..((y + height * scale) / self.scale).min(self.image.height());
        for row in rows {
            let line = (row * self.scale - y) / scale;
            let Some(line) = pixels.get(line * width..(line + 1) * width) else { return };
            let target = self.image.row_mut(row);
            for column in columns.clone() {
                let from = line.get((column * self.scale - x) / scale);
                if let (Some(pixel), Some(from)) = (target.get_mut(column), from) {
                    *pixel = *from;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn header(width: u32, height: u32) -> FrameHeader {
        let format = PixelFormat::Mono8;
        FrameHeader { width, height, format, parts: Vec::new(), ..FrameHeader::sample() }
    }

    #[test]
    fn a_frame_is_the_picture_and_a_large_one_a_smaller() {
        let mut canvas = Canvas::default();
        let pixels: Vec<u8> = (0..12).collect();
        assert_eq!(canvas.draw(&header(4, 3), &pixels).unwrap().pixels(), pixels);
        assert!(canvas.draw(&header(4, 3), &pixels[1..]).is_err());
        let large: Vec<u8> = (0..4000 * 2).map(|at| (at % 4000 / 16) as u8).collect();
        let picture = canvas.draw(&header(4000, 2), &large).unwrap();
        assert_eq!((picture.width(), picture.height()), (1333, 0));
        let large = vec![9; 2000 * 1000];
        let picture = canvas.draw(&header(2000, 1000), &large).unwrap();
        assert_eq!((picture.width(), picture.height()), (1000, 500));
        assert!(picture.pixels().iter().all(|pixel| *pixel == 9));
    }

    #[test]
    fn a_part_is_drawn_over_the_previous_picture() {
        let mut canvas = Canvas::default();
        canvas.draw(&header(6, 4), &[1; 24]).unwrap();
        let part = FramePart { x: 2, y: 2, width: 2, height: 1, scale: 2, bytes: 0 };
        canvas.place(&part, &[7, 8]);
        let rows: Vec<&[u8]> = (0..4).map(|row| canvas.image.row(row)).collect();
        assert_eq!(rows, [[1; 6], [1; 6], [1, 1, 7, 7, 8, 8], [1, 1, 7, 7, 8, 8]]);
    }
}
