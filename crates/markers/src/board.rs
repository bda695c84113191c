//! Defines a calibration board: rows of tags in known positions, as Kalibr's AprilGrid without the squares between its tags.
//!
//! The squares between Kalibr's tags touch their corners, where the outline of a tag would run on into the next one.

use crate::drawing::{Drawing, Layer, Shape};
use crate::marker::{Family, Marker};

/// A board of tags of AprilTag 36h11, numbered from 0, row by row from the top left.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Board {
    columns: u32,
    rows: u32,
    tag_m: f64,
    gap_m: f64,
}

/// Why there is no such board.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum BoardError {
    /// More tags than have numbers, or too few to be a board.
    #[error(
        "a board of {columns} x {rows} tags is not possible: it has at least 2 columns, 2 rows, and at most {max_tags} tags"
    )]
    Tags {
        /// Its columns.
        columns: u32,
        /// Its rows.
        rows: u32,
        /// The tags there are.
        max_tags: u32,
    },
    /// A tag's size that is none.
    #[error("tags of {tag_m} m are not possible: their side is from {} to {} m", SIDE_M[0], SIDE_M[1])]
    Side {
        /// The side.
        tag_m: f64,
    },
    /// Tags that touch, or are lost in white.
    #[error(
        "a gap of {gap_m} m between tags is not possible: it is from {min_m:.4} m (the white that a tag needs around it) to \
         {max_m:.4} m"
    )]
    Gap {
        /// The gap.
        gap_m: f64,
        /// Its limits.
        min_m: f64,
        /// Its limits.
        max_m: f64,
    },
}

const FAMILY: Family = Family::AprilTag36h11;
/// Sides of a tag, in metres.
const SIDE_M: [f64; 2] = [0.002, 2.0];
/// Gaps by the side of a tag: a cell of the tag is an eighth, and as much white must be around it.
const GAPS: [f64; 2] = [0.125, 4.0];

impl Board {
    /// The board that fills a sheet of A4.
    pub const A4: Self = Self { columns: 5, rows: 7, tag_m: 0.028, gap_m: 0.0084 };

    /// A board with so many tags, of this side and with this gap between them.
    ///
    /// # Errors
    /// [`BoardError`] with the limit.
    pub fn new(columns: u32, rows: u32, tag_m: f64, gap_m: f64) -> Result<Self, BoardError> {
        let max_tags = FAMILY.id_count().unwrap_or(0);
        if columns < 2 || rows < 2 || u64::from(columns) * u64::from(rows) > u64::from(max_tags) {
            return Err(BoardError::Tags { columns, rows, max_tags });
        }
        if !(SIDE_M[0]..=SIDE_M[1]).contains(&tag_m) {
            return Err(BoardError::Side { tag_m });
        }
        let [min_m, max_m] = GAPS.map(|share| share * tag_m);
        if !(min_m..=max_m).contains(&gap_m) {
            return Err(BoardError::Gap { gap_m, min_m, max_m });
        }
        Ok(Self { columns, rows, tag_m, gap_m })
    }

    /// How many tags lie side by side.
    pub fn columns(&self) -> u32 {
        self.columns
    }

    /// How many tags lie one above the other.
    pub fn rows(&self) -> u32 {
        self.rows
    }

    /// The side of a tag's black square, in metres.
    pub fn tag_m(&self) -> f64 {
        self.tag_m
    }

    /// The white between two tags, in metres.
    pub fn gap_m(&self) -> f64 {
        self.gap_m
    }

    /// Width and height from the first tag's outline to the last one's, in metres.
    pub fn size_m(&self) -> [f64; 2] {
        [self.columns, self.rows].map(|tags| {
            f64::from(tags) * self.tag_m + f64::from(tags.saturating_sub(1)) * self.gap_m
        })
    }

    /// The tags to look for.
    pub fn markers(&self) -> Vec<Marker> {
        let marker = |id| Marker { family: FAMILY, id: Some(id), size_m: None };
        (0..self.columns * self.rows).map(marker).collect()
    }

    /// The corners of a tag, its top left first, then clockwise; from the board's top left corner, x right and y down, in
    /// metres. `None` for a tag that is not on the board.
    pub fn corners_m(&self, family: Family, id: u32) -> Option<[[f64; 2]; 4]> {
        if family != FAMILY || id >= self.columns * self.rows {
            return None;
        }
        let step_m = self.tag_m + self.gap_m;
        let left = f64::from(id % self.columns) * step_m;
        let top = f64::from(id / self.columns) * step_m;
        let (right, bottom) = (left + self.tag_m, top + self.tag_m);
        Some([[left, top], [right, top], [right, bottom], [left, bottom]])
    }

    /// The print, with the board's centre at the origin.
    pub fn drawing(&self) -> Drawing {
        let size_m = self.size_m();
        let half_extent_m = size_m[0].max(size_m[1]) / 2.0 + self.tag_m / 8.0;
        let mut layers = Vec::new();
        for id in 0..self.columns * self.rows {
            let marker = Marker { family: FAMILY, id: Some(id), size_m: None };
            let (Some(drawing), Some([[left, top], ..])) =
                (Drawing::new(&marker, self.tag_m), self.corners_m(FAMILY, id))
            else {
                continue;
            };
            // The tag's middle; a drawing's y axis points up.
            let middle =
                [left + (self.tag_m - size_m[0]) / 2.0, (size_m[1] - self.tag_m) / 2.0 - top];
            layers.extend(drawing.layers.iter().map(|layer| moved(layer, middle)));
        }
        Drawing { half_extent_m, layers }
    }
}

fn moved(layer: &Layer, by: [f64; 2]) -> Layer {
    let place = |[x, y]: [f64; 2]| [x + by[0], y + by[1]];
    let shape = match layer.shape {
        Shape::Disc { centre_m, radius_m } => Shape::Disc { centre_m: place(centre_m), radius_m },
        Shape::Rectangle { min_m, max_m } => {
            Shape::Rectangle { min_m: place(min_m), max_m: place(max_m) }
        }
    };
    Layer { shape, ink: layer.ink }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::drawing::Ink;

    #[test]
    fn the_corners_are_where_the_drawing_turns_black() {
        let board = Board::new(4, 3, 0.04, 0.01).unwrap();
        let drawing = board.drawing();
        let [width, height] = board.size_m();
        assert!((width - 0.19).abs() < 1e-12 && (height - 0.14).abs() < 1e-12);
        let ink = |x: f64, y: f64| drawing.ink_at(x - width / 2.0, height / 2.0 - y);
        for id in 0..12 {
            let corners = board.corners_m(FAMILY, id).unwrap();
            for ([x, y], [inwards, down]) in
                corners.into_iter().zip([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
            {
                let d = 1e-4;
                assert_eq!(ink(x + inwards * d, y + down * d), Ink::Black, "{id}");
                assert_eq!(ink(x - inwards * d, y - down * d), Ink::White, "{id}");
            }
        }
        assert_eq!(board.corners_m(FAMILY, 12), None);
        assert_eq!(board.corners_m(Family::AprilTag16h5, 0), None);
        assert_eq!(board.markers().len(), 12);
    }

    #[test]
    fn impossible_boards_are_refused() {
        let problem = |columns, rows, tag_m, gap_m| {
            Board::new(columns, rows, tag_m, gap_m).unwrap_err().to_string()
        };
        assert!(problem(1, 7, 0.03, 0.01).contains("at least 2 columns"));
        assert!(problem(u32::MAX, 7, 0.03, 0.01).contains("at most 587 tags"));
        assert!(problem(5, 7, f64::NAN, 0.01).contains("from 0.002 to 2 m"));
        assert!(problem(5, 7, 0.04, 0.0).contains("from 0.0050 m"));
        let Board { columns, rows, tag_m, gap_m } = Board::A4;
        assert_eq!(Board::new(columns, rows, tag_m, gap_m), Ok(Board::A4));
    }
}
