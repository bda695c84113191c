//! What the cells of a square marker mean: where a family's bits lie, and which words there are.

use std::sync::OnceLock;

use crate::marker::Family;
use crate::square::codebook::{self, Codebook};
use crate::square::tables;

/// The code of a family of square markers.
#[derive(Debug)]
pub struct Code {
    /// The family.
    pub family: Family,
    /// Cells across the square whose outline is detected, its border included.
    pub cells: u8,
    /// The cell, column and row, of each bit from the most significant; the square's top left cell is `[0, 0]`, and some
    /// families have bits outside the square.
    pub bits: &'static [[i8; 2]],
    /// Whether the square's border is white on black; otherwise black on white.
    pub reversed_border: bool,
    /// The word of each id, 1 for white.
    pub words: &'static [u64],
    /// The smallest number of bits by which two markers differ, however they are turned.
    pub min_hamming: u8,
    book: Codebook,
}

/// Where a family's bits lie, and how far its words are apart.
struct Layout {
    cells: u8,
    bits: &'static [[i8; 2]],
    reversed_border: bool,
    min_hamming: u8,
}

impl Code {
    /// The code of a family; `None` for a family whose marker has no square cells. Prepared at the first call.
    pub fn of(family: Family) -> Option<&'static Self> {
        static CODES: [OnceLock<Option<Code>>; Family::ALL.len()] =
            [const { OnceLock::new() }; Family::ALL.len()];
        CODES.get(family as usize)?.get_or_init(|| Self::new(family)).as_ref()
    }

    fn new(family: Family) -> Option<Self> {
        let Layout { cells, bits, reversed_border, min_hamming } = layout(family)?;
        let words = codebook::words(family);
        let book = Codebook::new(words, &turn(bits, cells));
        Some(Self { family, cells, bits, reversed_border, words, min_hamming, book })
    }

    /// The id whose word is nearest to one that was read, the quarter turns, and the number of wrong bits, at most
    /// `max_wrong`. The marker's own top left corner is corner `quarter_turns` of those by which the word was read, when
    /// these are counted clockwise from 0. `None` when no word is so near, or two ids are equally near.
    pub fn match_word(&self, word: u64, max_wrong: u8) -> Option<(u32, u8, u8)> {
        let found = self.book.nearest(word, max_wrong)?;
        Some((found.id, found.quarter_turns, found.wrong_bits))
    }

    /// The same cells, read with the corners counted from the next one.
    pub fn turned(&self, word: u64) -> u64 {
        self.book.turned(word)
    }

    /// Columns and rows that the marker has outside the square on each side: the paper for a border of black, the
    /// black ring and the outer bits for one of white.
    pub fn margin(&self) -> u8 {
        let outside = self.bits.iter().map(|[column, _]| -column).max().unwrap_or(0);
        outside.max(1) as u8
    }
}

/// The bit that takes the place of each bit when the corners are counted from the next one.
fn turn(bits: &[[i8; 2]], cells: u8) -> Vec<u8> {
    let place = |[column, row]: [i8; 2]| [cells as i8 - 1 - row, column];
    let index = |cell| bits.iter().position(|bit| *bit == cell).unwrap_or(0) as u8;
    bits.iter().map(|bit| index(place(*bit))).collect()
}

fn layout(family: Family) -> Option<Layout> {
    use Family as F;
    let black = |cells, bits, min_hamming| {
        Some(Layout { cells, bits, reversed_border: false, min_hamming })
    };
    let white =
        |cells, bits, min_hamming| Some(Layout { cells, bits, reversed_border: true, min_hamming });
    match family {
        F::AprilTag16h5 => black(6, &tables::apriltag_16h5::BITS, 5),
        F::AprilTag25h9 => black(7, &tables::apriltag_25h9::BITS, 9),
        F::AprilTag36h10 => black(8, &tables::apriltag_36h10::BITS, 10),
        F::AprilTag36h11 => black(8, &tables::apriltag_36h11::BITS, 11),
        F::AprilTagCircle21h7 => white(5, &tables::apriltag_circle21h7::BITS, 7),
        F::AprilTagCircle49h12 => white(5, &tables::apriltag_circle49h12::BITS, 12),
        F::AprilTagCustom48h12 => white(6, &tables::apriltag_custom48h12::BITS, 12),
        F::AprilTagStandard41h12 => white(5, &tables::apriltag_standard41h12::BITS, 12),
        F::AprilTagStandard52h13 => white(6, &tables::apriltag_standard52h13::BITS, 13),
        F::Aruco4x4_50 => black(6, &tables::aruco_4x4::BITS, 4),
        F::Aruco4x4_100 | F::Aruco4x4_250 => black(6, &tables::aruco_4x4::BITS, 3),
        F::Aruco4x4_1000 => black(6, &tables::aruco_4x4::BITS, 2),
        F::Aruco5x5_50 => black(7, &tables::aruco_5x5::BITS, 8),
        F::Aruco5x5_100 => black(7, &tables::aruco_5x5::BITS, 7),
        F::Aruco5x5_250 => black(7, &tables::aruco_5x5::BITS, 6),
        F::Aruco5x5_1000 => black(7, &tables::aruco_5x5::BITS, 5),
        F::Aruco6x6_50 => black(8, &tables::aruco_6x6::BITS, 13),
        F::Aruco6x6_100 => black(8, &tables::aruco_6x6::BITS, 12),
        F::Aruco6x6_250 => black(8, &tables::aruco_6x6::BITS, 11),
        F::Aruco6x6_1000 => black(8, &tables::aruco_6x6::BITS, 9),
        F::Aruco7x7_50 => black(9, &tables::aruco_7x7::BITS, 19),
        F::Aruco7x7_100 => black(9, &tables::aruco_7x7::BITS, 18),
        F::Aruco7x7_250 => black(9, &tables::aruco_7x7::BITS, 17),
        F::Aruco7x7_1000 => black(9, &tables::aruco_7x7::BITS, 14),
        // Its id 1023 looks the same after half a turn.
        F::ArucoOriginal => black(7, &tables::aruco_original::BITS, 1),
        F::ArucoMip36h12 => black(8, &tables::aruco_mip_36h12::BITS, 12),
        F::StagHd11
        | F::StagHd13
        | F::StagHd15
        | F::StagHd17
        | F::StagHd19
        | F::StagHd21
        | F::StagHd23
        | F::Rings
        | F::RingsThesis => None,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn codes() -> impl Iterator<Item = &'static Code> {
        Family::ALL.into_iter().filter_map(Code::of)
    }

    #[test]
    fn every_word_of_every_family_is_read_in_every_orientation() {
        for code in codes() {
            for (&word, id) in code.words.iter().zip(0u32..) {
                // Counting from the next corner three times is one step back.
                let mut read = word;
                for turns in [0, 3, 2, 1] {
                    let found = code.match_word(read, 0);
                    let is_symmetrical = code.family == Family::ArucoOriginal && id == 1023;
                    let expected = if is_symmetrical { turns % 2 } else { turns };
                    assert_eq!(found, Some((id, expected, 0)), "{} {id}", code.family);
                    read = code.turned(read);
                }
                assert_eq!(read, word);
            }
        }
    }

    #[test]
    fn a_turn_moves_every_bit_to_a_place_of_its_own() {
        for code in codes() {
            let mut from = turn(code.bits, code.cells);
            from.sort_unstable();
            assert!(from.iter().zip(0..).all(|(a, b)| *a == b), "{}", code.family);
        }
    }

    #[test]
    fn wrong_bits_are_mended_up_to_half_the_distance() {
        for code in codes() {
            let most = (code.min_hamming - 1) / 2;
            let step = code.words.len() / 25 + 1;
            for id in (0..code.words.len()).step_by(step) {
                let flips = (0..most).fold(0u64, |flips, k| {
                    flips | 1 << ((id * 7 + usize::from(k) * 5) % code.bits.len())
                });
                let wrong = flips.count_ones() as u8;
                let found = code.match_word(code.turned(code.words[id] ^ flips), most);
                assert_eq!(found, Some((id as u32, 3, wrong)), "{} {id}", code.family);
                if wrong > 0 {
                    assert_eq!(code.match_word(code.words[id] ^ flips, wrong - 1), None);
                }
            }
        }
    }

    #[test]
    fn no_two_markers_of_a_small_family_are_nearer_than_stated() {
        for code in codes().filter(|code| code.words.len() <= 600) {
            let mut nearest = u32::MAX;
            for (i, &word) in code.words.iter().enumerate() {
                let mut turned = word;
                for turns in 0..4 {
                    let others = code.words[i + usize::from(turns == 0)..].iter();
                    nearest = others.fold(nearest, |n, other| n.min((turned ^ other).count_ones()));
                    turned = code.turned(turned);
                }
            }
            assert_eq!(nearest, u32::from(code.min_hamming), "{}", code.family);
        }
    }

    #[test]
    fn a_word_as_near_to_one_id_as_to_another_is_neither() {
        let code = Code::of(Family::Aruco4x4_1000).unwrap();
        let near = |a: u64, b: u64| (a ^ b).count_ones() == 2;
        let pairs = code.words.iter().enumerate();
        let mut pairs = pairs.flat_map(|(i, a)| code.words[i + 1..].iter().map(move |b| (*a, *b)));
        let (a, b) = pairs.find(|(a, b)| near(*a, *b)).unwrap();
        let between = a ^ (1 << (a ^ b).trailing_zeros());
        assert_eq!(code.match_word(between, 1), None);
        assert!(code.match_word(a, 1).is_some());
    }
}
