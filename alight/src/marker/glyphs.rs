//! Letters as dots, seven high and five wide, for images, which have no fonts.

use super::sheet::TEXT_MM;

/// Height of a capital letter as part of the letters' body, as in the font of the other forms.
const CAPITAL: f64 = 0.72;
const ROWS: f64 = 7.0;
/// Columns from one letter to the next.
const ADVANCE: f64 = 6.0;

type Rectangle = ([f64; 2], [f64; 2]);

/// The dots of a text as rectangles (top left and bottom right corner), in millimetres; `at_mm` is the left end of its
/// base line. Small letters look like capitals; what has no shape is left blank.
pub(super) fn rectangles(text: &str, at_mm: [f64; 2]) -> impl Iterator<Item = Rectangle> {
    let dot = TEXT_MM * CAPITAL / ROWS;
    text.chars().zip(0..).flat_map(move |(letter, index)| {
        let left = at_mm[0] + f64::from(index) * ADVANCE * dot;
        let rows = rows(letter.to_ascii_uppercase()).into_iter().zip(0..7);
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

/// The seven rows of a letter, from the top; the lowest of five bits is its right column.
fn rows(letter: char) -> [u8; 7] {
    match letter {
        'A' => [0b01110, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'B' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10001, 0b10001, 0b11110],
        'C' => [0b01110, 0b10001, 0b10000, 0b10000, 0b10000, 0b10001, 0b01110],
        'D' => [0b11110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b11110],
        'E' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b11111],
        'F' => [0b11111, 0b10000, 0b10000, 0b11110, 0b10000, 0b10000, 0b10000],
        'G' => [0b01110, 0b10001, 0b10000, 0b10111, 0b10001, 0b10001, 0b01110],
        'H' => [0b10001, 0b10001, 0b10001, 0b11111, 0b10001, 0b10001, 0b10001],
        'I' => [0b01110, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
        'J' => [0b00111, 0b00010, 0b00010, 0b00010, 0b00010, 0b10010, 0b01100],
        'K' => [0b10001, 0b10010, 0b10100, 0b11000, 0b10100, 0b10010, 0b10001],
        'L' => [0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b10000, 0b11111],
        'M' => [0b10001, 0b11011, 0b10101, 0b10101, 0b10001, 0b10001, 0b10001],
        'N' => [0b10001, 0b11001, 0b10101, 0b10101, 0b10011, 0b10001, 0b10001],
        'O' => [0b01110, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110],
        'P' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10000, 0b10000, 0b10000],
        'Q' => [0b01110, 0b10001, 0b10001, 0b10001, 0b10101, 0b10010, 0b01101],
        'R' => [0b11110, 0b10001, 0b10001, 0b11110, 0b10100, 0b10010, 0b10001],
        'S' => [0b01111, 0b10000, 0b10000, 0b01110, 0b00001, 0b00001, 0b11110],
        'T' => [0b11111, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100, 0b00100],
        'U' => [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01110],
        'V' => [0b10001, 0b10001, 0b10001, 0b10001, 0b10001, 0b01010, 0b00100],
        'W' => [0b10001, 0b10001, 0b10001, 0b10101, 0b10101, 0b11011, 0b10001],
        'X' => [0b10001, 0b10001, 0b01010, 0b00100, 0b01010, 0b10001, 0b10001],
        'Y' => [0b10001, 0b10001, 0b01010, 0b00100, 0b00100, 0b00100, 0b00100],
        'Z' => [0b11111, 0b00001, 0b00010, 0b00100, 0b01000, 0b10000, 0b11111],
        '0' => [0b01110, 0b10001, 0b10011, 0b10101, 0b11001, 0b10001, 0b01110],
        '1' => [0b00100, 0b01100, 0b00100, 0b00100, 0b00100, 0b00100, 0b01110],
        '2' => [0b01110, 0b10001, 0b00001, 0b00110, 0b01000, 0b10000, 0b11111],
        '3' => [0b11110, 0b00001, 0b00001, 0b01110, 0b00001, 0b00001, 0b11110],
        '4' => [0b00010, 0b00110, 0b01010, 0b10010, 0b11111, 0b00010, 0b00010],
        '5' => [0b11111, 0b10000, 0b11110, 0b00001, 0b00001, 0b10001, 0b01110],
        '6' => [0b01110, 0b10000, 0b10000, 0b11110, 0b10001, 0b10001, 0b01110],
        '7' => [0b11111, 0b00001, 0b00010, 0b00100, 0b00100, 0b00100, 0b00100],
        '8' => [0b01110, 0b10001, 0b10001, 0b01110, 0b10001, 0b10001, 0b01110],
        '9' => [0b01110, 0b10001, 0b10001, 0b01111, 0b00001, 0b00001, 0b01110],
        '-' => [0b00000, 0b00000, 0b00000, 0b11111, 0b00000, 0b00000, 0b00000],
        ':' => [0b00000, 0b00100, 0b00100, 0b00000, 0b00100, 0b00100, 0b00000],
        '.' => [0b00000, 0b00000, 0b00000, 0b00000, 0b00000, 0b01100, 0b01100],
        ',' => [0b00000, 0b00000, 0b00000, 0b00000, 0b00100, 0b00100, 0b01000],
        '%' => [0b11001, 0b11001, 0b00010, 0b00100, 0b01000, 0b10011, 0b10011],
        _ => [0; 7],
    }
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

    #[test]
    fn every_letter_of_a_sheet_has_a_shape() {
        let letters = "abcdefghijklmnopqrstuvwxyz0123456789-:.,%";
        for letter in letters.chars() {
            assert!(rows(letter.to_ascii_uppercase()) != [0; 7], "{letter}");
        }
    }
}
