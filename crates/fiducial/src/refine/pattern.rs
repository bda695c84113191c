//! Lists the black and the white cells of a square marker.

use markers::SquareCode;

/// Largest number of cells across a pattern, its surroundings included.
pub const MAX_CELLS: usize = 32;

/// The cells of a square marker and of its surroundings.
#[derive(Clone, Debug, PartialEq)]
pub struct Pattern {
    across: usize,
    margin: usize,
    /// Bit `x` of row `y`, surroundings included.
    white: [u32; MAX_CELLS],
    known: [u32; MAX_CELLS],
}

impl Pattern {
    /// A square of `cells` cells across with `margin` cells around it on each side. `is_white` gives the
    /// colour of the cell in column x and row y, or `None` where it is unknown; the square's top left cell is
    /// (0, 0). `None` when the square has no cells, or too many.
    pub fn new(
        cells: usize,
        margin: usize,
        is_white: impl Fn(i32, i32) -> Option<bool>,
    ) -> Option<Self> {
        let across = margin.checked_mul(2)?.checked_add(cells)?;
        if cells == 0 || across > MAX_CELLS {
            return None;
        }
        let mut pattern = Self { across, margin, white: [0; MAX_CELLS], known: [0; MAX_CELLS] };
        for y in 0..across {
            for x in 0..across {
                let at = |value: usize| value as i32 - margin as i32;
                if let Some(white) = is_white(at(x), at(y)) {
                    pattern.known[y] |= 1 << x;
                    pattern.white[y] |= u32::from(white) << x;
                }
            }
        }
        Some(pattern)
    }

    /// The marker of a family with this codeword. The quiet zone is one cell wide; the colour next to bits
    /// outside of the square is known only where the bits leave no gaps.
    pub fn for_code(code: &SquareCode, word: u64) -> Option<Self> {
        Self::bordered(code, word, 0)
    }

    /// The same with a border that is `extra` cells wider, as on calibration boards. These have black squares
    /// at the corners of the paper around each marker.
    pub fn bordered(code: &SquareCode, word: u64, extra: u8) -> Option<Self> {
        let extra = i32::from(extra);
        let cells = i32::from(code.cells) + 2 * extra;
        let depth = |x: i32, y: i32| x.min(y).min(cells - 1 - x).min(cells - 1 - y);
        let beyond = |at: i32| at < 0 || at >= cells;
        let outside = if code.reversed_border { i32::from(code.margin()) } else { 0 };
        let ring = 4 * (cells + 2 * outside - 1);
        let bits = || code.bits.iter().map(|[x, y]| (i32::from(*x), i32::from(*y)));
        let outermost = bits().filter(|(x, y)| depth(*x, *y) == -outside).count();
        let is_closed = !code.reversed_border || outermost == ring as usize;
        let mut pattern =
            Self::new(cells as usize, outside as usize + 1, |x, y| match depth(x, y) {
                0.. => Some(code.reversed_border),
                _ if extra > 0 && beyond(x) && beyond(y) => None,
                -1 if code.reversed_border => Some(false),
                deep if deep < -outside && is_closed => Some(true),
                _ => None,
            })?;
        for (k, (x, y)) in bits().enumerate() {
            let place = |at: i32| usize::try_from(at + extra + outside + 1).ok();
            let (column, line) = (place(x)?, place(y)?);
            let row = pattern.white.get_mut(line)?;
            let white = word >> (code.bits.len() - 1 - k) & 1 == 1;
            *row = *row & !(1 << column) | u32::from(white) << column;
            *pattern.known.get_mut(line)? |= 1 << column;
        }
        Some(pattern)
    }

    /// A square of `cells` cells across of which only the border, one cell wide, is known.
    pub fn border(cells: usize, white_on_black: bool) -> Option<Self> {
        let last = i32::try_from(cells).ok()? - 1;
        Self::new(cells, 1, |x, y| {
            let outside = x.min(y) < 0 || x.max(y) > last;
            let on_border = x.min(y) == 0 || x.max(y) == last;
            (outside || on_border).then_some(outside != white_on_black)
        })
    }

    /// Cells across the square itself.
    pub fn cells(&self) -> usize {
        self.across - 2 * self.margin
    }

    /// Cells around the square on each side.
    pub fn margin(&self) -> usize {
        self.margin
    }

    /// Cells across, surroundings included.
    pub(crate) fn across(&self) -> usize {
        self.across
    }

    /// Whether a cell is white, by column and row from the surroundings' top left; `None` where it is
    /// unknown.
    pub(crate) fn is_white(&self, x: usize, y: usize) -> Option<bool> {
        let bit = |rows: &[u32; MAX_CELLS]| rows.get(y).is_some_and(|row| row >> x & 1 == 1);
        (x < self.across && bit(&self.known)).then(|| bit(&self.white))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use markers::{Drawing, Family, Ink, Marker};

    #[test]
    fn a_border_is_black_in_white_or_white_in_black() {
        for inverted in [false, true] {
            let border = Pattern::border(6, inverted).unwrap();
            assert_eq!((border.cells(), border.margin(), border.across()), (6, 1, 8));
            let at = |x, y| border.is_white(x, y).map(|white| white != inverted);
            assert_eq!(at(0, 3), Some(true));
            assert_eq!(at(7, 7), Some(true));
            assert_eq!(at(1, 1), Some(false));
            assert_eq!(at(6, 3), Some(false));
            assert_eq!((at(2, 2), at(8, 0), at(0, 9)), (None, None, None));
        }
    }

    /// Every known cell has the colour of the drawing.
    #[test]
    fn patterns_match_the_drawings() {
        for family in Family::ALL {
            let Some(code) = SquareCode::for_family(family) else { continue };
            let marker = Marker { family, id: Some(3), size_m: None };
            let drawing = Drawing::new(&marker, f64::from(code.cells)).unwrap();
            let pattern = Pattern::for_code(code, code.codewords[3]).unwrap();
            let half = pattern.across() as f64 / 2.0 - 0.5;
            let mut known = 0;
            for y in 0..pattern.across() {
                for x in 0..pattern.across() {
                    let Some(white) = pattern.is_white(x, y) else { continue };
                    let ink = drawing.ink_at(x as f64 - half, half - y as f64);
                    assert_eq!(white, ink == Ink::White, "{family} {x} {y}");
                    known += 1;
                }
            }
            assert!(known >= code.bits.len() + 16, "{family}");
        }
    }

    #[test]
    fn invalid_sizes_are_refused() {
        for (cells, margin) in [(0, 1), (31, 1), (5, usize::MAX)] {
            assert_eq!(Pattern::new(cells, margin, |_, _| Some(true)), None);
        }
    }
}
