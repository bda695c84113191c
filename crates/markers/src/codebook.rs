//! A family's words, and which of them a word that was read is.

use crate::marker::Family;
use crate::square::tables;

/// A list with more words than this is searched by their quarters, a shorter one from end to end.
const SHORT: usize = 1500;
/// Parts into which the bits are divided for a search. A word with fewer wrong bits than parts has a part without any.
const PARTS: u32 = 4;

/// The words of a family: for square cells and for STag's dots alike.
#[derive(Debug)]
pub(crate) struct Codebook {
    words: &'static [u64],
    bits: u32,
    /// Where bit `k` is read from after a quarter turn, the most significant first.
    turn: [u8; 64],
    /// One for each part of the bits; none for a short list.
    indices: Vec<Index>,
}

/// A word that was read, as one of a family's.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Match {
    /// The id.
    pub(crate) id: u32,
    /// The marker's own top left corner is this one of the corners by which the word was read.
    pub(crate) quarter_turns: u8,
    /// Bits that were read wrongly.
    pub(crate) wrong_bits: u8,
}

impl Codebook {
    /// A book of words of `turn.len()` bits, at most 64. Bit `turn[k]` is where bit `k` is found when the corners are
    /// counted from the next one.
    pub(crate) fn new(words: &'static [u64], turn: &[u8]) -> Self {
        let bits = turn.len().min(64) as u32;
        let mut padded = [0; 64];
        padded.iter_mut().zip(turn).for_each(|(to, from)| *to = *from);
        let parts = if words.len() > SHORT { PARTS } else { 0 };
        let indices = (0..parts).map(|part| Index::new(words, bits, part)).collect();
        Self { words, bits, turn: padded, indices }
    }

    /// The word nearest to `word` in any of its four orientations with at most `max_wrong` wrong bits; `None` when
    /// there is none, or two ids are equally near.
    pub(crate) fn nearest(&self, word: u64, max_wrong: u8) -> Option<Match> {
        let mut best: Option<Match> = None;
        let mut is_tie = false;
        let mut turned = word;
        for quarter_turns in 0..4 {
            self.for_each_near(turned, u32::from(max_wrong), |id, wrong| {
                let found = Match { id, quarter_turns, wrong_bits: wrong as u8 };
                match best {
                    Some(b) if b.wrong_bits < found.wrong_bits => {}
                    Some(b) if b.wrong_bits == found.wrong_bits => is_tie |= b.id != id,
                    _ => (best, is_tie) = (Some(found), false),
                }
            });
            turned = self.turned(turned);
        }
        best.filter(|_| !is_tie)
    }

    /// The words.
    pub(crate) fn words(&self) -> &'static [u64] {
        self.words
    }

    /// The same cells, read with the corners counted from the next one.
    pub(crate) fn turned(&self, word: u64) -> u64 {
        (0..self.bits as usize).fold(0, |turned, k| {
            turned << 1 | word >> (self.bits - 1 - u32::from(self.turn[k])) & 1
        })
    }

    /// Every id whose word differs from `word` in at most `max_wrong` bits, and in how many; some of them twice.
    fn for_each_near(&self, word: u64, max_wrong: u32, mut found: impl FnMut(u32, u32)) {
        let mut look_at = |id: u32, candidate: u64| {
            let wrong = (candidate ^ word).count_ones();
            if wrong <= max_wrong {
                found(id, wrong);
            }
        };
        if self.indices.is_empty() || max_wrong >= PARTS {
            self.words.iter().zip(0..).for_each(|(candidate, id)| look_at(id, *candidate));
            return;
        }
        // Any match has a part without wrong bits among the first `max_wrong + 1`.
        for index in &self.indices[..=max_wrong as usize] {
            for &id in index.ids(word) {
                look_at(u32::from(id), self.words[usize::from(id)]);
            }
        }
    }
}

/// The ids by the value of one part of their words.
#[derive(Debug)]
struct Index {
    shift: u32,
    mask: u64,
    /// Where the ids of each value begin in `ids`, and where the last ones end.
    starts: Vec<u32>,
    ids: Vec<u16>,
}

impl Index {
    fn new(words: &[u64], bits: u32, part: u32) -> Self {
        let (shift, end) = (bits * part / PARTS, bits * (part + 1) / PARTS);
        let mask = (1u64 << (end - shift)) - 1;
        let value = |word: u64| (word >> shift & mask) as usize;
        let mut starts = vec![0; mask as usize + 2];
        words.iter().for_each(|word| starts[value(*word) + 1] += 1);
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut ids = vec![0; words.len()];
        for (word, id) in words.iter().zip(0..=u16::MAX) {
            let place = &mut next[value(*word)];
            ids[*place as usize] = id;
            *place += 1;
        }
        Self { shift, mask, starts, ids }
    }

    fn ids(&self, word: u64) -> &[u16] {
        let value = (word >> self.shift & self.mask) as usize;
        &self.ids[self.starts[value] as usize..self.starts[value + 1] as usize]
    }
}

/// The words of a family, of id 0 first; empty for a family without ids.
pub(crate) fn words(family: Family) -> &'static [u64] {
    use Family as F;
    let all: &[u64] = match family {
        F::AprilTag16h5 => &tables::apriltag_16h5::WORDS,
        F::AprilTag25h9 => &tables::apriltag_25h9::WORDS,
        F::AprilTag36h10 => &tables::apriltag_36h10::WORDS,
        F::AprilTag36h11 => &tables::apriltag_36h11::WORDS,
        F::AprilTagCircle21h7 => &tables::apriltag_circle21h7::WORDS,
        F::AprilTagCircle49h12 => &tables::apriltag_circle49h12::WORDS,
        F::AprilTagCustom48h12 => &tables::apriltag_custom48h12::WORDS,
        F::AprilTagStandard41h12 => &tables::apriltag_standard41h12::WORDS,
        F::AprilTagStandard52h13 => &tables::apriltag_standard52h13::WORDS,
        F::Aruco4x4_50 | F::Aruco4x4_100 | F::Aruco4x4_250 | F::Aruco4x4_1000 => {
            &tables::aruco_4x4::WORDS
        }
        F::Aruco5x5_50 | F::Aruco5x5_100 | F::Aruco5x5_250 | F::Aruco5x5_1000 => {
            &tables::aruco_5x5::WORDS
        }
        F::Aruco6x6_50 | F::Aruco6x6_100 | F::Aruco6x6_250 | F::Aruco6x6_1000 => {
            &tables::aruco_6x6::WORDS
        }
        F::Aruco7x7_50 | F::Aruco7x7_100 | F::Aruco7x7_250 | F::Aruco7x7_1000 => {
            &tables::aruco_7x7::WORDS
        }
        F::ArucoOriginal => &tables::aruco_original::WORDS,
        F::ArucoMip36h12 => &tables::aruco_mip_36h12::WORDS,
        F::StagHd11 => &tables::stag_hd11::WORDS,
        F::StagHd13 => &tables::stag_hd13::WORDS,
        F::StagHd15 => &tables::stag_hd15::WORDS,
        F::StagHd17 => &tables::stag_hd17::WORDS,
        F::StagHd19 => &tables::stag_hd19::WORDS,
        F::StagHd21 => &tables::stag_hd21::WORDS,
        F::StagHd23 => &tables::stag_hd23::WORDS,
        F::Rings | F::RingsThesis => &[],
    };
    all.get(..family.id_count().unwrap_or(0) as usize).unwrap_or(all)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_family_has_as_many_words_as_ids() {
        for family in Family::ALL {
            assert_eq!(words(family).len(), family.id_count().unwrap_or(0) as usize, "{family}");
        }
    }
}
