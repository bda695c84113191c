//! Computes the transform of 4 x 4 residuals and its quantiser (ITU-T H.264, 8.5.12).

/// A block of 4 x 4 values, by rows.
pub(super) type Block = [i32; 16];

/// The value of a level at QP 0 to 5, doubled with every six more: where row and column are even, where both are odd, and
/// elsewhere (`normAdjust4x4`).
const SCALES: [[i32; 3]; 6] =
    [[10, 16, 13], [11, 18, 14], [13, 20, 16], [14, 23, 18], [16, 25, 20], [18, 29, 23]];
/// The inverse of a scale and of the transform's own gain, as multiples of 2^-15.
const PER_SCALE: [[i32; 3]; 6] = [
    [13107, 5243, 8066],
    [11916, 4660, 7490],
    [10082, 4194, 6554],
    [9362, 3647, 5825],
    [8192, 3355, 5243],
    [7282, 2893, 4559],
];
/// The order in which the amplitudes are coded, from the lowest frequency to the highest.
const ZIGZAG: [usize; 16] = [0, 1, 4, 8, 5, 2, 3, 6, 9, 12, 13, 10, 7, 11, 14, 15];

/// Quantises the amplitudes of blocks, and rounds those of a predicted picture down more often, as encoders do: most are noise there.
#[derive(Clone, Copy, Debug)]
pub(super) struct Quantiser {
    shift: u32,
    scales: Block,
    per_scale: Block,
    rounding: i32,
}

impl Quantiser {
    /// The quantiser of a quantisation parameter (QP) from 0 to 51.
    pub(super) fn new(parameter: u8, is_intra: bool) -> Self {
        let (six, rest) = (u32::from(parameter) / 6, usize::from(parameter) % 6);
        let by_place = |table: &[[i32; 3]; 6]| {
            std::array::from_fn(|at| {
                let [corner, middle, side] = table[rest];
                match (at % 2, at / 4 % 2) {
                    (0, 0) => corner,
                    (1, 1) => middle,
                    _ => side,
                }
            })
        };
        Self {
            shift: six,
            scales: by_place(&SCALES),
            per_scale: by_place(&PER_SCALE),
            rounding: (1 << (15 + six)) / if is_intra { 3 } else { 6 },
        }
    }

    /// The levels of a residual.
    pub(super) fn levels(&self, residual: &Block) -> Block {
        let mut values = *residual;
        for line in 0..4 {
            forward(&mut values, [4 * line, 4 * line + 1, 4 * line + 2, 4 * line + 3]);
        }
        for line in 0..4 {
            forward(&mut values, [line, line + 4, line + 8, line + 12]);
        }
        std::array::from_fn(|at| {
            let level =
                (values[at].abs() * self.per_scale[at] + self.rounding) >> (15 + self.shift);
            level * values[at].signum()
        })
    }

    /// The residual that a decoder makes of levels.
    pub(super) fn residual(&self, levels: &Block) -> Block {
        let mut values: Block =
            std::array::from_fn(|at| (levels[at] * self.scales[at]) << self.shift);
        for line in 0..4 {
            inverse(&mut values, [4 * line, 4 * line + 1, 4 * line + 2, 4 * line + 3]);
        }
        for line in 0..4 {
            inverse(&mut values, [line, line + 4, line + 8, line + 12]);
        }
        values.map(|value| (value + 32) >> 6)
    }
}

fn forward(values: &mut Block, at: [usize; 4]) {
    let [a, b, c, d] = at.map(|at| values[at]);
    let (outer, inner) = ([a + d, a - d], [b + c, b - c]);
    values[at[0]] = outer[0] + inner[0];
    values[at[1]] = 2 * outer[1] + inner[1];
    values[at[2]] = outer[0] - inner[0];
    values[at[3]] = outer[1] - 2 * inner[1];
}

fn inverse(values: &mut Block, at: [usize; 4]) {
    let [a, b, c, d] = at.map(|at| values[at]);
    let (even, odd) = ([a + c, a - c], [(b >> 1) - d, b + (d >> 1)]);
    values[at[0]] = even[0] + odd[1];
    values[at[1]] = even[1] + odd[0];
    values[at[2]] = even[1] - odd[0];
    values[at[3]] = even[0] - odd[1];
}

/// How much a block of a predicted picture is worth being coded: encoders drop blocks in which single levels of 1 stand alone
/// (coefficient cost, by the zeros before each level of 1 in the zigzag; as in x264).
pub(super) fn worth(levels: &Block) -> u32 {
    const BY_ZEROS: [u32; 7] = [3, 2, 2, 1, 1, 1, 0];
    const MUCH: u32 = 9;
    let (mut sum, mut zeros) = (0, 0);
    for at in ZIGZAG {
        match levels[at].abs() {
            0 => zeros += 1,
            1 => {
                sum += BY_ZEROS.get(zeros).copied().unwrap_or(0);
                zeros = 0;
            }
            _ => return MUCH,
        }
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::*;

    fn residual(seed: u32) -> Block {
        let mut random = seed;
        std::array::from_fn(|_| {
            random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (random >> 24) as i32 - 128
        })
    }

    #[test]
    fn a_fine_quantiser_loses_nothing_and_a_coarse_one_about_its_step() {
        // The step doubles with every six: 0.625 at 0, 40 at 36.
        for (parameter, max_rms) in [(0, 0.6), (12, 1.0), (24, 4.0), (36, 16.0)] {
            let quantiser = Quantiser::new(parameter, true);
            let mut squares = 0.0;
            for seed in 0..50 {
                let block = residual(seed);
                let back = quantiser.residual(&quantiser.levels(&block));
                squares +=
                    block.iter().zip(back).map(|(a, b)| f64::from((a - b) * (a - b))).sum::<f64>();
            }
            let rms = (squares / 800.0).sqrt();
            assert!(rms < max_rms && (parameter < 24 || rms > max_rms / 3.0), "{parameter}: {rms}");
        }
    }

    #[test]
    fn a_lone_level_is_worth_little_and_a_large_one_much() {
        let mut block = [0; 16];
        block[15] = 1;
        assert_eq!(worth(&block), 0);
        block[0] = -1;
        assert_eq!(worth(&block), 3);
        block[1] = 2;
        assert_eq!(worth(&block), 9);
        assert_eq!(worth(&[0; 16]), 0);
    }
}
