//! Contains the innermost loops over rows of pixels, for AVX2, NEON and plain Rust: extremes of tiles, halving, sharpening,
//! comparison with thresholds to bits.
//!
//! The three give the same result to the bit. The plain one also serves the ends of rows, and processors with neither.
#![allow(unsafe_code, reason = "vector instructions; each is tested against its plain twin")]
#![cfg_attr(
    not(any(target_arch = "x86_64", all(target_arch = "aarch64", target_feature = "neon"))),
    allow(unused_mut, reason = "without vectors nothing is done before the plain part")
)]

/// Edge of a tile, in pixels.
pub(crate) const TILE: usize = 4;

/// Darkest and brightest pixel of each tile of up to four rows of the same length; the last tile may be
/// narrower.
pub(crate) fn tile_extremes(rows: &[&[u8]; TILE], low: &mut [u8], high: &mut [u8]) {
    let tiles = rows[0].len().div_ceil(TILE).min(low.len()).min(high.len());
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        done = unsafe { avx2::tile_extremes(rows, &mut low[..tiles], &mut high[..tiles]) };
    }
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    {
        // SAFETY: the target has NEON, as all of AArch64 but bare metal has.
        done += unsafe { neon::tile_extremes(rows, &mut low[..tiles], &mut high[..tiles]) };
    }
    plain::tile_extremes(rows, &mut low[..tiles], &mut high[..tiles], done);
}

/// Rounded means of 2 x 2 pixels; a last odd column is left out.
pub(crate) fn halve_rows(above: &[u8], below: &[u8], out: &mut [u8]) {
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        done = unsafe { avx2::halve_rows(above, below, out) };
    }
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    {
        // SAFETY: the target has NEON, as all of AArch64 but bare metal has.
        done += unsafe { neon::halve_rows(above, below, out) };
    }
    plain::halve_rows(above, below, out, done);
}

/// A row sharpened: each pixel moves away from the mean of its 3 x 3 neighbours (weights 1 2 1, both ways) by
/// as much as it differs from it. Beyond the ends of the row its last pixels count again.
pub(crate) fn sharpen_row(above: &[u8], here: &[u8], below: &[u8], out: &mut [u8]) {
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        done = unsafe { avx2::sharpen_row(above, here, below, out) };
    }
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    {
        // SAFETY: the target has NEON, as all of AArch64 but bare metal has.
        done += unsafe { neon::sharpen_row(above, here, below, out) };
    }
    plain::sharpen_row(above, here, below, out, 0..done.min(1));
    plain::sharpen_row(above, here, below, out, done..here.len());
}

/// Bit i of the words is set when pixel i is below its threshold. Bits beyond the row are 0.
pub(crate) fn below(pixels: &[u8], thresholds: &[u8], words: &mut [u64]) {
    let mut done = 0;
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        done = unsafe { avx2::below(pixels, thresholds, words) };
    }
    #[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
    {
        // SAFETY: the target has NEON, as all of AArch64 but bare metal has.
        done += unsafe { neon::below(pixels, thresholds, words) };
    }
    plain::below(pixels, thresholds, words, done);
}

/// Bit i of the words is set when pixel i is above its threshold. Bits beyond the row are 0.
pub(crate) fn above(pixels: &[u8], thresholds: &[u8], words: &mut [u64]) {
    // Pixel above threshold is threshold below pixel.
    below(thresholds, pixels, words);
}

/// Runs `work`, with the loops of all inlined code compiled for AVX2 where the processor has it (for NEON all code is compiled
/// where the target has it). The code is the same, and none of its arithmetic is fused, so the result is the same.
#[inline]
pub fn with_vectors<T>(work: impl FnOnce() -> T) -> T {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx2") {
        // SAFETY: the processor has AVX2.
        return unsafe { avx2::with_vectors(work) };
    }
    work()
}

/// In plain Rust, from tile, pixel or word `from` on.
mod plain {
    use std::ops::Range;

    use super::TILE;

    pub(super) fn tile_extremes(
        rows: &[&[u8]; TILE],
        low: &mut [u8],
        high: &mut [u8],
        from: usize,
    ) {
        for (tile, (low, high)) in low.iter_mut().zip(high).enumerate().skip(from) {
            (*low, *high) = (255, 0);
            for row in rows {
                let end = (tile * TILE + TILE).min(row.len());
                for pixel in &row[(tile * TILE).min(end)..end] {
                    *low = (*low).min(*pixel);
                    *high = (*high).max(*pixel);
                }
            }
        }
    }

    pub(super) fn halve_rows(above: &[u8], below: &[u8], out: &mut [u8], from: usize) {
        let pairs = above.chunks_exact(2).zip(below.chunks_exact(2));
        for (out, (a, b)) in out.iter_mut().zip(pairs).skip(from) {
            let sum = u16::from(a[0]) + u16::from(a[1]) + u16::from(b[0]) + u16::from(b[1]);
            *out = ((sum + 2) / 4) as u8;
        }
    }

    pub(super) fn sharpen_row(
        above: &[u8],
        here: &[u8],
        below: &[u8],
        out: &mut [u8],
        columns: Range<usize>,
    ) {
        let mean = |a: u8, b: u8| (u16::from(a) + u16::from(b)).div_ceil(2) as u8;
        let down = |x: usize| mean(mean(above[x], below[x]), here[x]);
        for x in columns {
            let sides = mean(down(x.saturating_sub(1)), down((x + 1).min(here.len() - 1)));
            let smooth = mean(sides, down(x));
            let up = here[x].saturating_sub(smooth);
            out[x] = here[x].saturating_add(up).saturating_sub(smooth.saturating_sub(here[x]));
        }
    }

    pub(super) fn below(pixels: &[u8], thresholds: &[u8], words: &mut [u64], from: usize) {
        let chunks = pixels.chunks(64).zip(thresholds.chunks(64));
        for (word, (pixels, thresholds)) in words.iter_mut().zip(chunks).skip(from) {
            *word = 0;
            for (bit, (pixel, threshold)) in pixels.iter().zip(thresholds).enumerate() {
                *word |= u64::from(pixel < threshold) << bit;
            }
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use std::arch::x86_64::{
        __m256i, _mm_cvtsi128_si64, _mm256_add_epi16, _mm256_adds_epu8, _mm256_and_si256,
        _mm256_avg_epu8, _mm256_castsi256_si128, _mm256_cmpeq_epi8, _mm256_loadu_si256,
        _mm256_maddubs_epi16, _mm256_max_epu8, _mm256_min_epu8, _mm256_movemask_epi8,
        _mm256_packus_epi16, _mm256_packus_epi32, _mm256_permute4x64_epi64,
        _mm256_permutevar8x32_epi32, _mm256_set_epi32, _mm256_set1_epi8, _mm256_set1_epi16,
        _mm256_set1_epi32, _mm256_srli_epi16, _mm256_srli_epi32, _mm256_storeu_si256,
        _mm256_subs_epu8,
    };

    use super::TILE;

    #[target_feature(enable = "avx2")]
    pub(super) fn with_vectors<T>(work: impl FnOnce() -> T) -> T {
        work()
    }

    /// 32 bytes of `row` from `at` on.
    #[target_feature(enable = "avx2")]
    fn load(row: &[u8], at: usize) -> __m256i {
        let bytes = &row[at..at + 32];
        // SAFETY: `bytes` has 32 bytes, and the load needs no alignment.
        unsafe { _mm256_loadu_si256(bytes.as_ptr().cast()) }
    }

    /// Writes 32 bytes to `row` from `at` on.
    #[target_feature(enable = "avx2")]
    fn store(row: &mut [u8], at: usize, value: __m256i) {
        let bytes = &mut row[at..at + 32];
        // SAFETY: `bytes` has 32 bytes, and the store needs no alignment.
        unsafe { _mm256_storeu_si256(bytes.as_mut_ptr().cast(), value) }
    }

    /// The lowest bytes of the 32 four-byte groups of four vectors, in order.
    #[target_feature(enable = "avx2")]
    fn lowest_bytes(groups: [__m256i; 4]) -> __m256i {
        let byte = _mm256_set1_epi32(0xff);
        let [a, b, c, d] = groups;
        let ab = _mm256_packus_epi32(_mm256_and_si256(a, byte), _mm256_and_si256(b, byte));
        let cd = _mm256_packus_epi32(_mm256_and_si256(c, byte), _mm256_and_si256(d, byte));
        // Packing works within halves of the vector, so groups of four bytes come out as a b c d a b c d.
        let mixed = _mm256_packus_epi16(ab, cd);
        _mm256_permutevar8x32_epi32(mixed, _mm256_set_epi32(7, 3, 6, 2, 5, 1, 4, 0))
    }

    /// Returns how many tiles it did.
    #[target_feature(enable = "avx2")]
    pub(super) fn tile_extremes(rows: &[&[u8]; TILE], low: &mut [u8], high: &mut [u8]) -> usize {
        const TILES: usize = 32;
        let count = rows[0].len() / (TILES * TILE);
        for step in 0..count {
            let mut lows = [_mm256_set1_epi8(0); 4];
            let mut highs = lows;
            for (part, (low, high)) in lows.iter_mut().zip(&mut highs).enumerate() {
                (*low, *high) = extremes_of_tiles(rows, step * TILES * TILE + part * 32);
            }
            store(low, step * TILES, lowest_bytes(lows));
            store(high, step * TILES, lowest_bytes(highs));
        }
        let zero = _mm256_set1_epi8(0);
        let mut done = count * TILES;
        while (done + 8) * TILE <= rows[0].len() {
            let (min, max) = extremes_of_tiles(rows, done * TILE);
            for (row, groups) in [(&mut *low, min), (&mut *high, max)] {
                let bytes = lowest_bytes([groups, zero, zero, zero]);
                let eight = _mm_cvtsi128_si64(_mm256_castsi256_si128(bytes)).to_le_bytes();
                row[done..done + 8].copy_from_slice(&eight);
            }
            done += 8;
        }
        done
    }

    /// Of 8 tiles from a column on, the minimum and the maximum pixel in the lowest byte of each group of
    /// four.
    #[target_feature(enable = "avx2")]
    fn extremes_of_tiles(rows: &[&[u8]; TILE], at: usize) -> (__m256i, __m256i) {
        let [a, b, c, d] = rows.map(|row| load(row, at));
        let min = _mm256_min_epu8(_mm256_min_epu8(a, b), _mm256_min_epu8(c, d));
        let max = _mm256_max_epu8(_mm256_max_epu8(a, b), _mm256_max_epu8(c, d));
        let min = _mm256_min_epu8(min, _mm256_srli_epi16::<8>(min));
        let max = _mm256_max_epu8(max, _mm256_srli_epi16::<8>(max));
        (
            _mm256_min_epu8(min, _mm256_srli_epi32::<16>(min)),
            _mm256_max_epu8(max, _mm256_srli_epi32::<16>(max)),
        )
    }

    /// Returns how many means it did.
    #[target_feature(enable = "avx2")]
    pub(super) fn halve_rows(above: &[u8], below: &[u8], out: &mut [u8]) -> usize {
        let ones = _mm256_set1_epi8(1);
        let two = _mm256_set1_epi16(2);
        let count = (above.len().min(below.len()) / 64).min(out.len() / 32);
        for step in 0..count {
            let half = |part: usize| {
                let at = step * 64 + part * 32;
                let pairs = |row: &[u8]| _mm256_maddubs_epi16(load(row, at), ones);
                let sum = _mm256_add_epi16(_mm256_add_epi16(pairs(above), pairs(below)), two);
                _mm256_srli_epi16::<2>(sum)
            };
            let mixed = _mm256_packus_epi16(half(0), half(1));
            store(out, step * 32, _mm256_permute4x64_epi64::<0b11_01_10_00>(mixed));
        }
        count * 32
    }

    /// Returns the column up to which it did all but the first.
    #[target_feature(enable = "avx2")]
    pub(super) fn sharpen_row(above: &[u8], here: &[u8], below: &[u8], out: &mut [u8]) -> usize {
        let length = here.len().min(above.len()).min(below.len()).min(out.len());
        let mut one = |at: usize| {
            let down = |at: usize| {
                _mm256_avg_epu8(_mm256_avg_epu8(load(above, at), load(below, at)), load(here, at))
            };
            let smooth = _mm256_avg_epu8(_mm256_avg_epu8(down(at - 1), down(at + 1)), down(at));
            let pixel = load(here, at);
            let brighter = _mm256_adds_epu8(pixel, _mm256_subs_epu8(pixel, smooth));
            store(out, at, _mm256_subs_epu8(brighter, _mm256_subs_epu8(smooth, pixel)));
        };
        if length < 34 {
            return 0;
        }
        let mut at = 1;
        while at + 33 <= length {
            one(at);
            at += 32;
        }
        // Some at the end are done twice rather than one by one.
        one(length - 33);
        length - 1
    }

    /// Returns how many words it did: all where there are 32 pixels at least.
    #[target_feature(enable = "avx2")]
    pub(super) fn below(pixels: &[u8], thresholds: &[u8], words: &mut [u64]) -> usize {
        let length = pixels.len().min(thresholds.len());
        if length < 32 || words.len() < length.div_ceil(64) {
            return 0;
        }
        let half = |at: usize| {
            let (pixel, threshold) = (load(pixels, at), load(thresholds, at));
            let reached = _mm256_cmpeq_epi8(_mm256_max_epu8(pixel, threshold), pixel);
            u64::from(!(_mm256_movemask_epi8(reached) as u32))
        };
        for (step, word) in words.iter_mut().enumerate() {
            let at = step * 64;
            let left = length.saturating_sub(at);
            *word = match left {
                0 => 0,
                64.. => half(at) | half(at + 32) << 32,
                // Of the last 32 pixels of the row those that belong to this word.
                1..=32 => half(length - 32) >> (32 - left),
                _ => half(at) | half(length - 32) >> (64 - left) << 32,
            };
        }
        words.len()
    }
}

#[cfg(all(target_arch = "aarch64", target_feature = "neon"))]
mod neon {
    use std::arch::aarch64::{
        uint8x16_t, vandq_u8, vcltq_u8, vcombine_u8, vgetq_lane_u64, vld1q_u8, vld4_u8, vld4q_u8,
        vmax_u8, vmaxq_u8, vmin_u8, vminq_u8, vpadalq_u8, vpaddlq_u8, vpaddq_u8, vqaddq_u8,
        vqsubq_u8, vreinterpretq_u64_u8, vrhaddq_u8, vrshrn_n_u16, vst1_u8, vst1q_u8,
    };

    use super::TILE;

    /// 16 bytes of `row` from `at` on.
    #[target_feature(enable = "neon")]
    fn load(row: &[u8], at: usize) -> uint8x16_t {
        let bytes = &row[at..at + 16];
        // SAFETY: `bytes` has 16 bytes, and the load needs no alignment.
        unsafe { vld1q_u8(bytes.as_ptr()) }
    }

    /// Writes 16 bytes to `row` from `at` on.
    #[target_feature(enable = "neon")]
    fn store(row: &mut [u8], at: usize, value: uint8x16_t) {
        let bytes = &mut row[at..at + 16];
        // SAFETY: `bytes` has 16 bytes, and the store needs no alignment.
        unsafe { vst1q_u8(bytes.as_mut_ptr(), value) }
    }

    /// Returns how many tiles it did.
    #[target_feature(enable = "neon")]
    pub(super) fn tile_extremes(rows: &[&[u8]; TILE], low: &mut [u8], high: &mut [u8]) -> usize {
        let tiles = (rows[0].len() / TILE).min(low.len()).min(high.len());
        let mut done = 0;
        while done + 16 <= tiles {
            let part = |row: usize| {
                let bytes = &rows[row][done * TILE..(done + 16) * TILE];
                // SAFETY: `bytes` has 64 bytes, and the load needs no alignment.
                let columns = unsafe { vld4q_u8(bytes.as_ptr()) };
                let (a, b, c, d) = (columns.0, columns.1, columns.2, columns.3);
                (vminq_u8(vminq_u8(a, b), vminq_u8(c, d)), vmaxq_u8(vmaxq_u8(a, b), vmaxq_u8(c, d)))
            };
            let (mut min, mut max) = part(0);
            for row in 1..TILE {
                let (lower, higher) = part(row);
                (min, max) = (vminq_u8(min, lower), vmaxq_u8(max, higher));
            }
            store(low, done, min);
            store(high, done, max);
            done += 16;
        }
        if done + 8 <= tiles {
            let part = |row: usize| {
                let bytes = &rows[row][done * TILE..(done + 8) * TILE];
                // SAFETY: `bytes` has 32 bytes, and the load needs no alignment.
                let columns = unsafe { vld4_u8(bytes.as_ptr()) };
                let (a, b, c, d) = (columns.0, columns.1, columns.2, columns.3);
                (vmin_u8(vmin_u8(a, b), vmin_u8(c, d)), vmax_u8(vmax_u8(a, b), vmax_u8(c, d)))
            };
            let (mut min, mut max) = part(0);
            for row in 1..TILE {
                let (lower, higher) = part(row);
                (min, max) = (vmin_u8(min, lower), vmax_u8(max, higher));
            }
            let (low, high) = (&mut low[done..done + 8], &mut high[done..done + 8]);
            // SAFETY: both have 8 bytes, and the stores need no alignment.
            unsafe {
                vst1_u8(low.as_mut_ptr(), min);
                vst1_u8(high.as_mut_ptr(), max);
            }
            done += 8;
        }
        done
    }

    /// Returns how many means it did.
    #[target_feature(enable = "neon")]
    pub(super) fn halve_rows(above: &[u8], below: &[u8], out: &mut [u8]) -> usize {
        let count = (above.len().min(below.len()) / 32).min(out.len() / 16);
        for step in 0..count {
            let half = |at: usize| {
                let sums = vpadalq_u8(vpaddlq_u8(load(above, at)), load(below, at));
                // Shifts and rounds.
                vrshrn_n_u16::<2>(sums)
            };
            store(out, step * 16, vcombine_u8(half(step * 32), half(step * 32 + 16)));
        }
        count * 16
    }

    /// Returns the column up to which it did all but the first.
    #[target_feature(enable = "neon")]
    pub(super) fn sharpen_row(above: &[u8], here: &[u8], below: &[u8], out: &mut [u8]) -> usize {
        let length = here.len().min(above.len()).min(below.len()).min(out.len());
        let mut one = |at: usize| {
            let down = |at: usize| {
                vrhaddq_u8(vrhaddq_u8(load(above, at), load(below, at)), load(here, at))
            };
            let smooth = vrhaddq_u8(vrhaddq_u8(down(at - 1), down(at + 1)), down(at));
            let pixel = load(here, at);
            let brighter = vqaddq_u8(pixel, vqsubq_u8(pixel, smooth));
            store(out, at, vqsubq_u8(brighter, vqsubq_u8(smooth, pixel)));
        };
        if length < 18 {
            return 0;
        }
        let mut at = 1;
        while at + 17 <= length {
            one(at);
            at += 16;
        }
        // Some at the end are done twice rather than one by one.
        one(length - 17);
        length - 1
    }

    /// Returns how many words it did.
    #[target_feature(enable = "neon")]
    pub(super) fn below(pixels: &[u8], thresholds: &[u8], words: &mut [u64]) -> usize {
        const BITS: [u8; 16] = [1, 2, 4, 8, 16, 32, 64, 128, 1, 2, 4, 8, 16, 32, 64, 128];
        let bits = load(&BITS, 0);
        let count = (pixels.len().min(thresholds.len()) / 64).min(words.len());
        for (step, word) in words.iter_mut().take(count).enumerate() {
            let part = |index: usize| {
                let at = step * 64 + index * 16;
                vandq_u8(vcltq_u8(load(pixels, at), load(thresholds, at)), bits)
            };
            // Adding neighbours three times makes a byte of the bits of eight pixels.
            let halves = [vpaddq_u8(part(0), part(1)), vpaddq_u8(part(2), part(3))];
            let quarters = vpaddq_u8(halves[0], halves[1]);
            *word = vgetq_lane_u64::<0>(vreinterpretq_u64_u8(vpaddq_u8(quarters, quarters)));
        }
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn vectors_give_the_results_of_plain_rust(
            (width, bytes) in (1_usize..700).prop_flat_map(|w| (Just(w), prop::collection::vec(any::<u8>(), w * 4))),
        ) {
            let rows: [&[u8]; 4] = [0, 1, 2, 3].map(|i| &bytes[i * width..][..width]);
            let tiles = width.div_ceil(TILE);
            let (mut low, mut high) = (vec![0; tiles], vec![0; tiles]);
            tile_extremes(&rows, &mut low, &mut high);
            let (mut plain_low, mut plain_high) = (vec![0; tiles], vec![0; tiles]);
            plain::tile_extremes(&rows, &mut plain_low, &mut plain_high, 0);
            prop_assert_eq!((low, high), (plain_low, plain_high));

            let (mut half, mut plain_half) = (vec![0; width / 2], vec![0; width / 2]);
            halve_rows(rows[0], rows[1], &mut half);
            plain::halve_rows(rows[0], rows[1], &mut plain_half, 0);
            prop_assert_eq!(half, plain_half);

            let (mut sharp, mut plain_sharp) = (vec![0; width], vec![0; width]);
            sharpen_row(rows[0], rows[1], rows[2], &mut sharp);
            plain::sharpen_row(rows[0], rows[1], rows[2], &mut plain_sharp, 0..width);
            prop_assert_eq!(sharp, plain_sharp);

            let words = width.div_ceil(64);
            let (mut bits, mut plain_bits) = (vec![9; words], vec![9; words]);
            below(rows[0], rows[1], &mut bits);
            plain::below(rows[0], rows[1], &mut plain_bits, 0);
            prop_assert_eq!(&bits, &plain_bits);
            for (x, (a, b)) in rows[0].iter().zip(rows[1]).enumerate() {
                prop_assert_eq!(bits[x / 64] >> (x % 64) & 1 == 1, a < b);
            }
            above(rows[0], rows[1], &mut bits);
            for (x, (a, b)) in rows[0].iter().zip(rows[1]).enumerate() {
                prop_assert_eq!(bits[x / 64] >> (x % 64) & 1 == 1, a > b);
            }
        }
    }
}
