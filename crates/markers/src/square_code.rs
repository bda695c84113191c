//! Assigns the cells of a square marker to a family's bits, and lists its codewords.

use std::sync::OnceLock;

use crate::codebook::{Codebook, Match};
use crate::marker::Family;
use crate::tables;

/// The code of a family of square markers.
#[derive(Debug)]
pub struct SquareCode {
    /// The family.
    pub family: Family,
    /// Cells across the square whose outline is detected, its border included.
    pub cells: u8,
    /// The cell, column and row, of each bit from the most significant; the square's top left cell is `[0, 0]`, and some
    /// families have bits outside the square.
    pub bits: &'static [[i8; 2]],
    /// Whether the square's border is white on black; otherwise black on white.
    pub reversed_border: bool,
    /// The codeword of each id, 1 for white.
    pub codewords: &'static [u64],
    /// The smallest Hamming distance between two markers in any rotation.
    pub min_hamming: u8,
    book: Codebook,
}

impl SquareCode {
    /// The code of a family; `None` for a family whose marker has no square cells. Prepared at the first call.
    pub fn for_family(family: Family) -> Option<&'static Self> {
        static CODES: [OnceLock<Option<SquareCode>>; Family::ALL.len()] =
            [const { OnceLock::new() }; Family::ALL.len()];
        CODES.get(family as usize)?.get_or_init(|| Self::new(family)).as_ref()
    }

    fn new(family: Family) -> Option<Self> {
        let Layout { cells, reversed_border, min_hamming } = layout(family)?;
        let (bits, codewords) = (tables::cells(family), tables::codewords(family));
        let book = Codebook::new(codewords, &quarter_turn(bits, cells));
        Some(Self { family, cells, bits, reversed_border, codewords, min_hamming, book })
    }

    /// The codeword nearest to `read` in any rotation, with at most `max_hamming` wrong bits; `None` when there is none, or
    /// when two ids are equally near.
    pub fn nearest(&self, read: u64, max_hamming: u8) -> Option<Match> {
        self.book.nearest(read, max_hamming)
    }

    /// The same cells, read with the corners counted from the next one.
    pub fn rotated(&self, word: u64) -> u64 {
        self.book.rotated(word)
    }

    /// Whether a marker looks the same upside down, so that half a turn of it cannot be seen. The only one is a white bar in a
    /// black frame, as windows, doors and letters on signs are too.
    pub fn is_symmetrical(&self, id: u32) -> bool {
        let codeword = self.codewords.get(id as usize);
        codeword.is_some_and(|word| self.rotated(self.rotated(*word)) == *word)
    }

    /// The codes whose markers have the same square, all bits of this one and at least so many more: a part of such a marker may be
    /// one of this code. They are prepared at the first call.
    pub fn containing(&self, min_more_bits: usize) -> impl Iterator<Item = &'static Self> {
        let has_same_square = move |family: &Family| {
            layout(*family).is_some_and(|other| {
                (other.cells, other.reversed_border) == (self.cells, self.reversed_border)
            })
        };
        let has_all_bits = move |family: &Family| {
            let bits = tables::cells(*family);
            bits.len() >= self.bits.len() + min_more_bits
                && self.bits.iter().all(|bit| bits.contains(bit))
        };
        let families = Family::ALL.into_iter().filter(has_same_square).filter(has_all_bits);
        families.filter_map(Self::for_family)
    }

    /// Cells across the square in its middle that has no bits, and is left free for a smaller marker; 0 if there is none.
    pub fn free_cells(&self) -> u8 {
        let cells = self.cells as i8;
        // The border lies inside of the outline.
        let is_free = |from: &i8| {
            let inside = *from..cells - *from;
            !self.bits.iter().any(|bit| bit.iter().all(|place| inside.contains(place)))
        };
        // Half of the cells leave nothing.
        (1..=cells / 2).find(is_free).map_or(0, |from| (cells - 2 * from) as u8)
    }

    /// Columns and rows that the marker has outside the square on each side: white paper around a black border, the
    /// black ring and the outer bits around a white one.
    pub fn margin(&self) -> u8 {
        let outside = self.bits.iter().map(|[column, _]| -column).max().unwrap_or(0);
        outside.max(1) as u8
    }
}

/// The bit that takes the place of each bit when the corners are counted from the next one.
fn quarter_turn(bits: &[[i8; 2]], cells: u8) -> Vec<u8> {
    let place = |[column, row]: [i8; 2]| [cells as i8 - 1 - row, column];
    let index = |cell| bits.iter().position(|bit| *bit == cell).unwrap_or(0) as u8;
    bits.iter().map(|bit| index(place(*bit))).collect()
}

/// How a family's square is divided, and how far its codewords are apart.
struct Layout {
    cells: u8,
    reversed_border: bool,
    min_hamming: u8,
}

fn layout(family: Family) -> Option<Layout> {
    use Family as F;
    let black = |cells, min_hamming| Some(Layout { cells, reversed_border: false, min_hamming });
    let white = |cells, min_hamming| Some(Layout { cells, reversed_border: true, min_hamming });
    match family {
        F::AprilTag16h5 => black(6, 5),
        F::AprilTag25h9 => black(7, 9),
        F::AprilTag36h10 => black(8, 10),
        F::AprilTag36h11 => black(8, 11),
        F::AprilTagCircle21h7 => white(5, 7),
        F::AprilTagCircle49h12 => white(5, 12),
        F::AprilTagCustom48h12 => white(6, 12),
        F::AprilTagStandard41h12 => white(5, 12),
        F::AprilTagStandard52h13 => white(6, 13),
        F::Aruco4x4_50 => black(6, 4),
        F::Aruco4x4_100 | F::Aruco4x4_250 => black(6, 3),
        F::Aruco4x4_1000 => black(6, 2),
        F::Aruco5x5_50 => black(7, 8),
        F::Aruco5x5_100 => black(7, 7),
        F::Aruco5x5_250 => black(7, 6),
        F::Aruco5x5_1000 => black(7, 5),
        F::Aruco6x6_50 => black(8, 13),
        F::Aruco6x6_100 => black(8, 12),
        F::Aruco6x6_250 => black(8, 11),
        F::Aruco6x6_1000 => black(8, 9),
        F::Aruco7x7_50 => black(9, 19),
        F::Aruco7x7_100 => black(9, 18),
        F::Aruco7x7_250 => black(9, 17),
        F::Aruco7x7_1000 => black(9, 14),
        // Its id 1023 looks the same after half a turn.
        F::ArucoOriginal => black(7, 1),
        F::ArucoMip36h12 => black(8, 12),
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

    fn codes() -> impl Iterator<Item = &'static SquareCode> {
        Family::ALL.into_iter().filter_map(SquareCode::for_family)
    }

    #[test]
    fn every_codeword_of_every_family_is_read_in_every_rotation() {
        for code in codes() {
            for (&word, id) in code.codewords.iter().zip(0u32..) {
                // Counting from the next corner three times is one step back.
                let mut read = word;
                for rotation in [0, 3, 2, 1] {
                    let found = code.nearest(read, 0);
                    let is_symmetrical = code.is_symmetrical(id);
                    let rotation = if is_symmetrical { rotation % 2 } else { rotation };
                    assert_eq!(
                        found,
                        Some(Match { id, rotation, hamming: 0 }),
                        "{} {id}",
                        code.family
                    );
                    read = code.rotated(read);
                }
                assert_eq!(read, word);
            }
        }
    }

    #[test]
    fn one_marker_of_one_family_is_symmetrical() {
        let symmetrical = codes().flat_map(|code| {
            let ids = 0..code.codewords.len() as u32;
            ids.filter(|id| code.is_symmetrical(*id)).map(|id| (code.family, id))
        });
        assert_eq!(symmetrical.collect::<Vec<_>>(), [(Family::ArucoOriginal, 1023)]);
    }

    #[test]
    fn one_family_leaves_its_middle_free() {
        let free = codes().filter(|code| code.free_cells() > 0);
        let free: Vec<_> = free.map(|code| (code.family, code.free_cells())).collect();
        assert_eq!(free, [(Family::AprilTagCustom48h12, 2)]);
    }

    #[test]
    fn the_bits_of_two_families_are_among_those_of_others() {
        let pairs = codes().flat_map(|code| code.containing(1).map(|it| (code.family, it.family)));
        let round = Family::AprilTagCircle21h7;
        let expected = [
            (round, Family::AprilTagCircle49h12),
            (round, Family::AprilTagStandard41h12),
            (Family::AprilTagCustom48h12, Family::AprilTagStandard52h13),
        ];
        assert_eq!(pairs.collect::<Vec<_>>(), expected);
        let custom = SquareCode::for_family(Family::AprilTagCustom48h12).unwrap();
        assert_eq!(custom.containing(5).count(), 0);
    }

    #[test]
    fn a_turn_moves_every_bit_to_a_place_of_its_own() {
        for code in codes() {
            let mut from = quarter_turn(code.bits, code.cells);
            from.sort_unstable();
            assert!(from.iter().zip(0..).all(|(a, b)| *a == b), "{}", code.family);
        }
    }

    #[test]
    fn wrong_bits_are_corrected_up_to_half_the_distance() {
        for code in codes() {
            let max_hamming = (code.min_hamming - 1) / 2;
            let step = code.codewords.len() / 25 + 1;
            for id in (0..code.codewords.len()).step_by(step) {
                let flips = (0..max_hamming).fold(0u64, |flips, k| {
                    flips | 1 << ((id * 7 + usize::from(k) * 5) % code.bits.len())
                });
                let hamming = flips.count_ones() as u8;
                let expected = Match { id: id as u32, rotation: 3, hamming };
                let found = code.nearest(code.rotated(code.codewords[id] ^ flips), max_hamming);
                assert_eq!(found, Some(expected), "{} {id}", code.family);
                if hamming > 0 {
                    assert_eq!(code.nearest(code.codewords[id] ^ flips, hamming - 1), None);
                }
            }
        }
    }

    #[test]
    fn bits_as_near_to_one_id_as_to_another_are_neither() {
        let code = SquareCode::for_family(Family::Aruco4x4_1000).unwrap();
        let near = |a: u64, b: u64| (a ^ b).count_ones() == 2;
        let pairs = code.codewords.iter().enumerate();
        let mut pairs =
            pairs.flat_map(|(i, a)| code.codewords[i + 1..].iter().map(move |b| (*a, *b)));
        let (a, b) = pairs.find(|(a, b)| near(*a, *b)).unwrap();
        let between = a ^ (1 << (a ^ b).trailing_zeros());
        assert_eq!(code.nearest(between, 1), None);
        assert!(code.nearest(a, 1).is_some());
    }
}
