//! Defines grey images: borrowed views and owned buffers, 8 bits a pixel.

/// Why bytes cannot be viewed as an image.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum ViewError {
    /// An image without pixels, or wider or higher than [`GrayView::MAX_EDGE_PX`].
    Size {
        /// Stated width in pixels.
        width: usize,
        /// Stated height in pixels.
        height: usize,
    },
    /// Rows that are shorter than the image is wide.
    Stride {
        /// Stated width in pixels.
        width: usize,
        /// Stated bytes from row to row.
        stride: usize,
    },
    /// Fewer bytes than the size needs.
    Length {
        /// Available bytes.
        len: usize,
        /// Bytes that the size needs.
        needed: usize,
    },
}

impl std::fmt::Display for ViewError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let max = GrayView::MAX_EDGE_PX;
        match *self {
            Self::Size { width, height } => {
                write!(
                    f,
                    "an image of {width} x {height} pixels; each edge must be from 1 to {max}"
                )
            }
            Self::Stride { width, stride } => {
                write!(f, "rows of {stride} bytes in an image {width} pixels wide")
            }
            Self::Length { len, needed } => {
                write!(f, "{len} bytes of pixels where {needed} are needed")
            }
        }
    }
}

impl std::error::Error for ViewError {}

/// A borrowed 8-bit grey image. Row 0 is at the top.
#[derive(Copy, Clone, Debug)]
pub struct GrayView<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    stride: usize,
}

impl<'a> GrayView<'a> {
    /// Maximum width and height, in pixels.
    pub const MAX_EDGE_PX: usize = 65_535;

    /// A view of `width` x `height` pixels whose rows begin `stride` bytes apart.
    ///
    /// # Errors
    /// [`ViewError`] when the size is zero or too large, or there are too few bytes.
    pub fn new(
        data: &'a [u8],
        width: usize,
        height: usize,
        stride: usize,
    ) -> Result<Self, ViewError> {
        let in_range = |edge: usize| (1..=Self::MAX_EDGE_PX).contains(&edge);
        if !in_range(width) || !in_range(height) {
            return Err(ViewError::Size { width, height });
        }
        if stride < width {
            return Err(ViewError::Stride { width, stride });
        }
        let needed = stride.saturating_mul(height - 1).saturating_add(width);
        if data.len() < needed {
            return Err(ViewError::Length { len: data.len(), needed });
        }
        Ok(Self { data, width, height, stride })
    }

    /// A view of pixels without gaps between the rows.
    ///
    /// # Errors
    /// As [`GrayView::new`].
    pub fn packed(data: &'a [u8], width: usize, height: usize) -> Result<Self, ViewError> {
        Self::new(data, width, height, width)
    }

    /// The part of `width` x `height` pixels whose top left pixel is (x, y); `None` when it is empty or
    /// reaches beyond the image.
    pub fn crop(&self, x: usize, y: usize, width: usize, height: usize) -> Option<Self> {
        let fits = |from: usize, edge: usize, whole: usize| {
            edge > 0 && from.checked_add(edge).is_some_and(|end| end <= whole)
        };
        if !fits(x, width, self.width) || !fits(y, height, self.height) {
            return None;
        }
        let data = self.data.get(y * self.stride + x..)?;
        Some(Self { data, width, height, stride: self.stride })
    }

    /// The bytes from the first pixel on, and their number from row to row.
    #[inline]
    pub(crate) fn bytes_and_stride(&self) -> (&'a [u8], usize) {
        (self.data, self.stride)
    }

    /// Width in pixels.
    #[inline]
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    #[inline]
    pub fn height(&self) -> usize {
        self.height
    }

    /// The pixels of row `y`.
    ///
    /// # Panics
    /// When `y` is not below the height, as a slice does.
    #[inline]
    pub fn row(&self, y: usize) -> &'a [u8] {
        assert!(y < self.height, "no such row in the image");
        &self.data[y * self.stride..][..self.width]
    }

    /// The pixel at a place, and those `right` columns to the right, `below` rows below, and both; `None`
    /// beyond the end of the memory.
    #[inline]
    pub(crate) fn square(&self, x: usize, y: usize, [right, below]: [usize; 2]) -> Option<[u8; 4]> {
        let (first, down) = (y * self.stride + x, below * self.stride);
        let pixels = self.data.get(first..=first + down + right)?;
        Some([*pixels.first()?, *pixels.get(right)?, *pixels.get(down)?, *pixels.last()?])
    }

    /// As [`GrayView::square`], with the pixels to the right and below.
    #[inline]
    pub(crate) fn four(&self, x: usize, y: usize) -> Option<[u8; 4]> {
        let first = y * self.stride + x;
        let [a, b] = *self.data.get(first..)?.first_chunk()?;
        let [c, d] = *self.data.get(first + self.stride..)?.first_chunk()?;
        Some([a, b, c, d])
    }

    /// The pixel at column `x` of row `y`.
    ///
    /// # Panics
    /// When the place lies outside the image, as a slice does.
    #[inline]
    pub fn at(&self, x: usize, y: usize) -> u8 {
        self.row(y)[x]
    }
}

/// An owned 8-bit grey image without gaps between the rows. Its buffer is reused.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct GrayImage {
    data: Vec<u8>,
    width: usize,
    height: usize,
}

/// The square root of each grey value, in units of full scale, rounded.
const SQUARE_ROOTS: [u8; 256] = {
    let mut roots = [0; 256];
    let (mut value, mut root) = (0, 0);
    while value < 256 {
        // Until the next root's middle, squared, is above the value: (root + 1/2)^2 > 255 value.
        while root < 255 && 4 * 255 * value > (2 * root + 1) * (2 * root + 1) {
            root += 1;
        }
        roots[value] = root as u8;
        value += 1;
    }
    roots
};

impl GrayImage {
    /// An image of `width` x `height` pixels, all of value `value`.
    pub fn filled(width: usize, height: usize, value: u8) -> Self {
        Self { data: vec![value; width * height], width, height }
    }

    /// Changes the size; the values of the pixels are then undefined.
    pub fn resize(&mut self, width: usize, height: usize) {
        self.data.resize(width * height, 0);
        (self.width, self.height) = (width, height);
    }

    /// Becomes the square root of an image, in units of full scale: as the tone curve of an ordinary camera shows it.
    pub fn make_brightened(&mut self, view: GrayView<'_>) {
        self.resize(view.width(), view.height());
        for (y, to) in self.data.chunks_exact_mut(view.width()).enumerate() {
            let from = view.row(y);
            to.iter_mut().zip(from).for_each(|(to, from)| *to = SQUARE_ROOTS[usize::from(*from)]);
        }
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.width
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.height
    }

    /// All pixels, row by row.
    pub fn pixels(&self) -> &[u8] {
        &self.data
    }

    /// All pixels, row by row, mutable.
    pub fn pixels_mut(&mut self) -> &mut [u8] {
        &mut self.data
    }

    /// The pixels of row `y`.
    pub fn row(&self, y: usize) -> &[u8] {
        &self.data[y * self.width..][..self.width]
    }

    /// The pixels of row `y`, mutable.
    pub fn row_mut(&mut self, y: usize) -> &mut [u8] {
        &mut self.data[y * self.width..][..self.width]
    }

    /// A view of the image; `None` while it has no pixels.
    pub fn view(&self) -> Option<GrayView<'_>> {
        GrayView::packed(&self.data, self.width, self.height).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn impossible_sizes_are_refused() {
        let check = |len: usize, size: (usize, usize), stride, expected| {
            let data = vec![0; len];
            assert_eq!(GrayView::new(&data, size.0, size.1, stride).map(|v| v.width()), expected);
        };
        check(0, (0, 0), 0, Err(ViewError::Size { width: 0, height: 0 }));
        check(1, (1, 1), 1, Ok(1));
        check(9, (5, 2), 4, Err(ViewError::Stride { width: 5, stride: 4 }));
        check(9, (5, 2), 5, Err(ViewError::Length { len: 9, needed: 10 }));
        check(9, (65_536, 1), 65_536, Err(ViewError::Size { width: 65_536, height: 1 }));
        check(
            9,
            (65_535, 65_535),
            usize::MAX,
            Err(ViewError::Length { len: 9, needed: usize::MAX }),
        );
    }

    #[test]
    fn a_crop_has_the_pixels_of_its_place() {
        let data: Vec<u8> = (0..20).collect();
        let view = GrayView::packed(&data, 5, 4).unwrap();
        let part = view.crop(1, 2, 3, 2).unwrap();
        assert_eq!((part.row(0), part.row(1)), (&[11, 12, 13][..], &[16, 17, 18][..]));
        for (x, y, width, height) in
            [(0, 0, 6, 1), (5, 0, 1, 1), (0, 0, 0, 1), (usize::MAX, 0, 2, 1), (0, 3, 1, 2)]
        {
            assert!(view.crop(x, y, width, height).is_none());
        }
    }

    #[test]
    fn a_brightened_image_is_the_square_root_of_its_light() {
        let data: Vec<u8> = (0..=255).flat_map(|value| [value, 7]).collect();
        let view = GrayView::new(&data, 1, 256, 2).unwrap();
        let mut brightened = GrayImage::default();
        brightened.make_brightened(view);
        for (value, root) in (0_u8..=255).zip(brightened.pixels()) {
            let expected = (255.0 * f64::from(value)).sqrt().round() as u8;
            assert_eq!(*root, expected, "{value}");
        }
    }

    #[test]
    fn a_stride_skips_the_gaps_between_rows() {
        let view = GrayView::new(&[1, 2, 9, 3, 4], 2, 2, 3).unwrap();
        assert_eq!((view.row(0), view.row(1)), (&[1, 2][..], &[3, 4][..]));
    }
}
