//! Defines the input of a calibration: the points of a board that were found in images.

use geometry::Pixel;

/// The size of an image.
#[derive(Copy, Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct ImageSize {
    /// In pixels.
    pub width: u32,
    /// In pixels.
    pub height: u32,
}

impl ImageSize {
    /// The middles of equal parts of the image, row by row.
    pub(crate) fn middles(self, columns: usize, rows: usize) -> impl Iterator<Item = Pixel> {
        let (width, height) = (f64::from(self.width), f64::from(self.height));
        let share = |part: usize, parts: usize| (part as f64 + 0.5) / parts as f64;
        (0..rows * columns).map(move |i| {
            let (column, row) = (share(i % columns, columns), share(i / columns, rows));
            Pixel::new(column * width - 0.5, row * height - 0.5)
        })
    }
}

impl std::fmt::Display for ImageSize {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

/// A point of the board, seen in an image.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Sighting {
    /// The tag that it belongs to: the errors of one tag's points in one image are not independent. A point that was found
    /// alone has a number of its own.
    pub tag: u32,
    /// Its place on the board, x right and y down, in metres.
    pub place_m: [f64; 2],
    /// Where it is in the image, as captured.
    pub seen: Pixel,
}

/// The board's points in one image.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// For people: the file's name.
    pub name: String,
    /// The image's size.
    pub size: ImageSize,
    /// The points that were found.
    pub points: Vec<Sighting>,
}
