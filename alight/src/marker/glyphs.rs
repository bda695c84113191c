//! Draws text in a dot-matrix font as rectangles on the sheet.

use fiducial::overlay::font::rows;

use super::sheet::TEXT_MM;

/// Cap height relative to the font size, as in the font of the PDF.
const CAPITAL: f64 = 0.72;
const ROWS: f64 = 7.0;
/// Columns per letter, with the gap.
const ADVANCE: f64 = 6.0;

type Rectangle = ([f64; 2], [f64; 2]);

/// The dots of a text as rectangles (top left and bottom right corner), in millimetres; `at_mm` is the left
/// end of its baseline. The font has capitals only; unknown characters are blank.
pub(super) fn rectangles(text: &str, at_mm: [f64; 2]) -> impl Iterator<Item = Rectangle> {
    let dot = TEXT_MM * CAPITAL / ROWS;
    text.chars().zip(0..).flat_map(move |(letter, index)| {
        let left = at_mm[0] + f64::from(index) * ADVANCE * dot;
        let rows = rows(letter).into_iter().zip(0..7);
        rows.flat_map(move |(bits, row)| {
            let top = at_mm[1] - (ROWS - f64::from(row)) * dot;
            let columns = (0..5).filter(move |column| bits >> (4 - column) & 1 == 1);
            columns.map(move |column| {
                let x = left + f64::from(column) * dot;
                ([x, top], [x + dot, top + dot])
            })
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_stand_on_their_base_line() {
        let dots: Vec<Rectangle> = rectangles("Hi-1 \u{fc}", [10.0, 20.0]).collect();
        let bottom = dots.iter().map(|(_, max)| max[1]).fold(0.0, f64::max);
        let top = dots.iter().map(|(min, _)| min[1]).fold(99.0, f64::min);
        assert!((bottom - 20.0).abs() < 1e-9 && (bottom - top - 0.72 * TEXT_MM).abs() < 1e-9);
        assert!((dots[0].0[0] - 10.0).abs() < 1e-9);
        assert_eq!(rectangles("\u{fc} ", [0.0, 0.0]).count(), 0);
    }
}
