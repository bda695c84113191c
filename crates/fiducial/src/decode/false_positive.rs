//! How likely a quad that is no marker spells a marker's word.
//!
//! Windows, stripes and letters spell simple words: those whose rows, or columns, repeat. A word is as surprising as the
//! shortest way to say it is long, in bits: bit by bit, or by its few different rows and which of them stands where, or
//! by where its few white cells are. What remains of that after the choice among all words looked for and four turns is the evidence.

use markers::SquareCode;

/// Most rows and columns of bits.
const MOST_LINES: usize = 16;
/// Bits to say in which way a word is said.
const WAY_BITS: f64 = 2.0;

/// By how many bits the agreement with a word exceeds what chance gives among `words` words in four turns, when `bits` of
/// the word's bits were read and `wrong` of these are not as they should be.
pub(crate) fn evidence(code: &SquareCode, word: u64, words: usize, bits: u32, wrong: u32) -> f64 {
    let all = code.bits.len() as f64;
    // What is simple about a word is so of the bits that were read as well, in proportion.
    let read = f64::from(bits) * (surprise(code, word) / all).min(1.0);
    read - (4.0 * words as f64).log2() - ways(bits, wrong).log2()
}

/// The number of words within `wrong` bits of one.
pub(crate) fn ways(bits: u32, wrong: u32) -> f64 {
    (0..=wrong.min(bits)).map(|k| choices(bits, k)).sum()
}

/// The number of ways to choose `k` of `n`.
fn choices(n: u32, k: u32) -> f64 {
    (1..=k).map(|i| f64::from(n + 1 - i) / f64::from(i)).product()
}

/// Length of the shortest way to say a word, in bits.
fn surprise(code: &SquareCode, word: u64) -> f64 {
    let (mut rows, mut columns) = ([0_u32; MOST_LINES], [0_u32; MOST_LINES]);
    let margin = code.margin() as i8;
    let mut across = 0;
    for (k, [column, row]) in code.bits.iter().enumerate() {
        if word >> (code.bits.len() - 1 - k) & 1 == 0 {
            continue;
        }
        let place = |at: i8| usize::try_from(at + margin).unwrap_or(0).min(MOST_LINES - 1);
        rows[place(*row)] |= 1 << place(*column);
        columns[place(*column)] |= 1 << place(*row);
    }
    for [column, row] in code.bits {
        across = across.max(i32::from(*column).max(i32::from(*row)));
    }
    let first = code.bits.iter().flatten().fold(i8::MAX, |first, at| first.min(*at));
    let lines = (across - i32::from(first) + 1).clamp(1, MOST_LINES as i32) as usize;
    let from = usize::try_from(first + margin).unwrap_or(0);
    let said = |all: &[u32]| {
        let all = all.get(from..from + lines).unwrap_or_default();
        let different = (0..all.len()).filter(|i| !all[..*i].contains(&all[*i])).count() as f64;
        let lines = lines as f64;
        // The order in which the different lines are said is of no meaning.
        let orders = (1..=different as u32).map(|n| f64::from(n).log2()).sum::<f64>();
        different * lines + lines * different.log2() - orders + WAY_BITS
    };
    let bits = code.bits.len() as u32;
    let ones = word.count_ones().min(bits);
    let few = ones.min(bits - ones);
    let sparse = choices(bits, few).log2() + f64::from(bits).log2();
    said(&rows).min(said(&columns)).min(sparse).min(f64::from(bits))
}

#[cfg(test)]
mod tests {
    use super::*;
    use markers::Family;

    #[test]
    fn stripes_say_little() {
        let code = SquareCode::for_family(Family::ArucoOriginal).unwrap();
        // One white column on black, two, and two different rows.
        for (id, most) in [(0, 7.0), (682, 7.0), (255, 16.0)] {
            let bits = surprise(code, code.codewords[id]);
            assert!(bits < most + 1e-9, "{id}: {bits}");
        }
        let plain = code.codewords.iter().filter(|word| surprise(code, **word) > 22.0).count();
        assert!(plain > 700, "{plain}");
    }

    #[test]
    fn evidence_falls_with_the_words_looked_for_and_those_that_are_mended() {
        let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
        let word = code.codewords[5];
        let one = evidence(code, word, 1, 36, 0);
        assert!((one - 34.0).abs() < 1e-9, "{one}");
        assert!((one - evidence(code, word, 512, 36, 0) - 9.0).abs() < 1e-9);
        assert!((one - evidence(code, word, 1, 36, 1) - 37_f64.log2()).abs() < 1e-9);
        assert!((one - evidence(code, word, 1, 30, 0) - 6.0).abs() < 1e-9);
    }

    #[test]
    fn any_word_of_any_family_is_weighed() {
        for code in Family::ALL.into_iter().filter_map(SquareCode::for_family) {
            for word in code.codewords {
                let bits = surprise(code, *word);
                assert!(bits >= 3.0 && bits <= code.bits.len() as f64, "{} {word:x}", code.family);
            }
        }
    }
}
