//! Extracts the grey levels of a frame in a driver's buffer.

use super::abi::fourcc;

/// A pixel format that is read.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Pixels {
    /// JPEG files.
    Mjpeg,
    /// One byte per pixel.
    Grey,
    /// Luma and chroma in turn.
    Yuyv,
    /// Luma as `Grey`, then chroma.
    LumaFirst,
}

/// Where the rows of a frame lie in its buffer.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Rows {
    pub(crate) pixels: Pixels,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Bytes from row to row.
    pub(crate) stride: usize,
    /// Whether luma is from 16 to 235 instead of from 0 to 255.
    pub(crate) is_limited: bool,
}

impl Pixels {
    /// The formats by their four letters, the best first: without loss, and with the fewest bytes.
    pub(crate) const ALL: [(&'static str, Self); 5] = [
        ("GREY", Self::Grey),
        ("NV12", Self::LumaFirst),
        ("YU12", Self::LumaFirst),
        ("YUYV", Self::Yuyv),
        ("MJPG", Self::Mjpeg),
    ];

    /// The format of these letters.
    pub(crate) fn of(name: &str) -> Option<Self> {
        Self::ALL.iter().find(|(known, _)| *known == name).map(|(_, pixels)| *pixels)
    }

    /// The kernel's number of the format of these letters.
    pub(crate) fn number(name: &str) -> Option<u32> {
        name.as_bytes().try_into().ok().map(fourcc)
    }

    fn bytes_per_pixel(self) -> usize {
        if self == Self::Yuyv { 2 } else { 1 }
    }
}

impl Rows {
    /// Bytes of a row.
    pub(crate) fn row_bytes(self) -> usize {
        self.width * self.pixels.bytes_per_pixel()
    }

    /// Bytes up to the end of the last row of luma.
    pub(crate) fn min_bytes(self) -> usize {
        self.stride * self.height.saturating_sub(1) + self.row_bytes()
    }

    /// Writes the grey levels, one byte per pixel; the one copy between driver and detector. Returns how many bytes it
    /// wrote: fewer than the frame has when the buffer is too short.
    pub(crate) fn copy_grey(self, buffer: &[u8], grey: &mut [u8]) -> usize {
        let rows = buffer.chunks(self.stride.max(1)).zip(grey.chunks_exact_mut(self.width.max(1)));
        let mut copied = 0;
        for (row, grey) in rows.take(self.height) {
            let Some(row) = row.get(..self.row_bytes()) else { break };
            match self.pixels {
                Pixels::Yuyv => {
                    for (grey, pair) in grey.iter_mut().zip(row.chunks_exact(2)) {
                        *grey = pair.first().copied().unwrap_or(0);
                    }
                }
                _ => grey.copy_from_slice(row),
            }
            copied += grey.len();
        }
        copied
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn luma_is_taken_without_padding_and_chroma() {
        let rows = |pixels, stride| Rows { pixels, width: 3, height: 2, stride, is_limited: false };
        let mut grey = [0; 6];
        let grey_rows = rows(Pixels::Grey, 4);
        assert_eq!(grey_rows.copy_grey(&[1, 2, 3, 99, 4, 5, 6], &mut grey), 6);
        assert_eq!((grey, grey_rows.min_bytes()), ([1, 2, 3, 4, 5, 6], 7));
        let planar = [1, 2, 3, 4, 5, 6, 128, 128, 128, 128];
        assert_eq!(rows(Pixels::LumaFirst, 3).copy_grey(&planar, &mut grey), 6);
        assert_eq!(grey, [1, 2, 3, 4, 5, 6]);
        let packed = [1, 9, 2, 9, 3, 9, 0, 0, 4, 9, 5, 9, 6, 9];
        assert_eq!(rows(Pixels::Yuyv, 8).copy_grey(&packed, &mut grey), 6);
        assert_eq!(grey, [1, 2, 3, 4, 5, 6]);
        assert_eq!(rows(Pixels::Grey, 3).copy_grey(&[1, 2, 3, 4, 5], &mut grey), 3, "a cut frame");
    }
}
