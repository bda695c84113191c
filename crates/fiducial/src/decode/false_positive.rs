//! Estimates the probability that a quad other than a marker shows a codeword by chance.
//!
//! Windows, stripes and letters show simple words, whose rows or columns repeat. The information of a
//! codeword is the length of its shortest description, in bits: bit by bit; by its few different rows (or
//! columns) and their order; or by the positions of its few white cells. The evidence is the remainder
//! after the choice among all codewords that are looked for, in four rotations.

use markers::SquareCode;

/// Largest number of rows and columns of bits.
const MAX_LINES: usize = 16;
/// Bits to name the kind of description.
const KIND_BITS: f64 = 2.0;

/// Agreement with a codeword in excess of chance among `codewords` in four rotations, in bits,
/// when `read` of its bits were read and `hamming` of these differ.
pub(crate) fn evidence(
    code: &SquareCode,
    codeword: u64,
    codewords: usize,
    read: u32,
    hamming: u32,
) -> f64 {
    let all = code.bits.len() as f64;
    // The bits that were read are as simple as the whole codeword, in proportion.
    let information = f64::from(read) * (information(code, codeword) / all).min(1.0);
    information - (4.0 * codewords as f64).log2() - words_within(read, hamming).log2()
}

/// The number of words within a Hamming distance of one.
pub(crate) fn words_within(bits: u32, hamming: u32) -> f64 {
    (0..=hamming.min(bits)).map(|k| binomial(bits, k)).sum()
}

fn binomial(n: u32, k: u32) -> f64 {
    (1..=k).map(|i| f64::from(n + 1 - i) / f64::from(i)).product()
}

/// Length of a codeword's shortest description, in bits.
fn information(code: &SquareCode, codeword: u64) -> f64 {
    let (mut rows, mut columns) = ([0_u32; MAX_LINES], [0_u32; MAX_LINES]);
    let margin = code.margin() as i8;
    for (k, [column, row]) in code.bits.iter().enumerate() {
        if codeword >> (code.bits.len() - 1 - k) & 1 == 0 {
            continue;
        }
        let place = |at: i8| usize::try_from(at + margin).unwrap_or(0).min(MAX_LINES - 1);
        rows[place(*row)] |= 1 << place(*column);
        columns[place(*column)] |= 1 << place(*row);
    }
    let all = || code.bits.iter().flatten().copied();
    let (first, last) = (all().min().unwrap_or(0), all().max().unwrap_or(0).max(0));
    let lines = (i32::from(last) - i32::from(first) + 1).clamp(1, MAX_LINES as i32) as usize;
    let from = usize::try_from(first + margin).unwrap_or(0);
    let by_lines = |all: &[u32]| {
        let all = all.get(from..from + lines).unwrap_or_default();
        let different = (0..all.len()).filter(|i| !all[..*i].contains(&all[*i])).count() as f64;
        let lines = lines as f64;
        // The order in which the different lines are listed carries no information.
        let orders = (1..=different as u32).map(|n| f64::from(n).log2()).sum::<f64>();
        different * lines + lines * different.log2() - orders + KIND_BITS
    };
    let bits = code.bits.len() as u32;
    let ones = codeword.count_ones().min(bits);
    let few = ones.min(bits - ones);
    let sparse = binomial(bits, few).log2() + f64::from(bits).log2();
    by_lines(&rows).min(by_lines(&columns)).min(sparse).min(f64::from(bits))
}

#[cfg(test)]
mod tests {
    use super::*;
    use markers::Family;

    #[test]
    fn stripes_carry_little_information() {
        let code = SquareCode::for_family(Family::ArucoOriginal).unwrap();
        // One white column on black, two, and two different rows.
        for (id, max) in [(0, 7.0), (682, 7.0), (255, 16.0)] {
            let bits = information(code, code.codewords[id]);
            assert!(bits < max + 1e-9, "{id}: {bits}");
        }
        let plain = code.codewords.iter().filter(|word| information(code, **word) > 22.0).count();
        assert!(plain > 700, "{plain}");
    }

    #[test]
    fn evidence_falls_with_the_codewords_looked_for_and_with_corrected_bits() {
        let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
        let word = code.codewords[5];
        let one = evidence(code, word, 1, 36, 0);
        assert!((one - 34.0).abs() < 1e-9, "{one}");
        assert!((one - evidence(code, word, 512, 36, 0) - 9.0).abs() < 1e-9);
        assert!((one - evidence(code, word, 1, 36, 1) - 37_f64.log2()).abs() < 1e-9);
        assert!((one - evidence(code, word, 1, 30, 0) - 6.0).abs() < 1e-9);
    }

    #[test]
    fn every_codeword_has_information() {
        for code in Family::ALL.into_iter().filter_map(SquareCode::for_family) {
            for word in code.codewords {
                let bits = information(code, *word);
                assert!(bits >= 3.0 && bits <= code.bits.len() as f64, "{} {word:x}", code.family);
            }
        }
    }
}
