//! Draws markers of square cells.

use super::cover;
use super::{Drawing, Ink, Layer, Shape};
use crate::square_code::SquareCode;

/// The marker with this codeword. Rectangles of one ink lie side by side on one rectangle of the other.
pub(super) fn drawing(code: &SquareCode, codeword: u64, size_m: f64) -> Drawing {
    let grid = Grid { code, codeword, cell_m: size_m / f64::from(code.cells) };
    let margin = i32::from(code.margin());
    let mut layers = Vec::new();
    let quiet = if code.reversed_border {
        // The black that makes the white border's outline.
        grid.paint(Ink::Black, -1, &mut layers, |_| true);
        let is_outer = |cell| grid.depth(cell) < -1 && grid.bit(cell) == Some(false);
        grid.paint(Ink::Black, -margin, &mut layers, is_outer);
        grid.paint(Ink::White, 0, &mut layers, |_| true);
        grid.paint(Ink::Black, 0, &mut layers, |cell| grid.bit(cell) == Some(false));
        margin + 1
    } else {
        grid.paint(Ink::Black, 0, &mut layers, |_| true);
        grid.paint(Ink::White, 0, &mut layers, |cell| grid.bit(cell) == Some(true));
        margin
    };
    // At least one cell of paper lies around all that is printed.
    Drawing {
        half_extent_m: (f64::from(code.cells) / 2.0 + f64::from(quiet)) * grid.cell_m,
        layers,
    }
}

struct Grid<'a> {
    code: &'a SquareCode,
    codeword: u64,
    cell_m: f64,
}

impl Grid<'_> {
    /// The codeword's bit at a cell, column and row from the square's top left.
    fn bit(&self, cell: [i32; 2]) -> Option<bool> {
        let bits = self.code.bits;
        let place = bits.iter().position(|bit| bit.map(i32::from) == cell)?;
        Some(self.codeword >> (bits.len() - 1 - place) & 1 == 1)
    }

    /// How many cells lie between a cell and the square's outline; negative outside.
    fn depth(&self, [x, y]: [i32; 2]) -> i32 {
        let last = i32::from(self.code.cells) - 1;
        x.min(y).min(last - x).min(last - y)
    }

    /// Adds the rectangles of one ink. The first column and row are `from`, and as many lie beyond the square's end.
    fn paint(
        &self,
        ink: Ink,
        from: i32,
        layers: &mut Vec<Layer>,
        is_painted: impl Fn([i32; 2]) -> bool,
    ) {
        let side = i32::from(self.code.cells) - 2 * from;
        let cells = (0..side * side).map(|i| is_painted([from + i % side, from + i / side]));
        let half_m = f64::from(side) / 2.0 * self.cell_m;
        let place = |count: usize| count as f64 * self.cell_m - half_m;
        let rectangles = cover::rectangles(side as usize, cells.collect()).into_iter();
        layers.extend(rectangles.map(|[[left, top], [right, bottom]]| {
            let min_m = [place(left), -place(bottom)];
            let shape = Shape::Rectangle { min_m, max_m: [place(right), -place(top)] };
            Layer { shape, ink }
        }));
    }
}
