//! Applies the filter across the edges of blocks, which is part of the format (ITU-T H.264, 8.7).

use super::plane::{MACROBLOCK, Motion, Plane};

/// How a macroblock was coded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Coded {
    /// Predicted from its neighbours in the same picture.
    pub(super) is_intra: bool,
    /// The motion of one that is predicted from the previous picture.
    pub(super) motion: Motion,
    /// Which of its 16 blocks have levels, by rows.
    pub(super) blocks: u16,
}

/// Bounds of the steps that are filtered, by the QP: across the edge (alpha), and on each side of it (beta; Table 8-16).
const ACROSS: [u8; 52] = [
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 4, 4, 5, 6, 7, 8, 9, 10, 12, 13, 15, 17, 20,
    22, 25, 28, 32, 36, 40, 45, 50, 56, 63, 71, 80, 90, 101, 113, 127, 144, 162, 182, 203, 226,
    255, 255,
];
const BESIDE: [u8; 52] = [
    0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 2, 2, 2, 3, 3, 3, 3, 4, 4, 4, 6, 6, 7, 7, 8, 8,
    9, 9, 10, 10, 11, 11, 12, 12, 13, 13, 14, 14, 15, 15, 16, 16, 17, 17, 18, 18,
];
/// Maximum change (t_C0) of the pixels at an edge of boundary strengths 1 to 3, from QP 17 on (Table 8-17).
const CHANGES: [[u8; 3]; 35] = [
    [0, 0, 1],
    [0, 0, 1],
    [0, 0, 1],
    [0, 0, 1],
    [0, 1, 1],
    [0, 1, 1],
    [1, 1, 1],
    [1, 1, 1],
    [1, 1, 1],
    [1, 1, 1],
    [1, 1, 2],
    [1, 1, 2],
    [1, 1, 2],
    [1, 1, 2],
    [1, 2, 3],
    [1, 2, 3],
    [2, 2, 3],
    [2, 2, 4],
    [2, 3, 4],
    [2, 3, 4],
    [3, 3, 5],
    [3, 4, 6],
    [3, 4, 6],
    [4, 5, 7],
    [4, 5, 8],
    [4, 6, 9],
    [5, 7, 10],
    [6, 8, 11],
    [6, 8, 13],
    [7, 10, 14],
    [8, 11, 16],
    [9, 12, 18],
    [10, 13, 20],
    [11, 15, 23],
    [13, 17, 25],
];

/// Filters a picture in place; `coded` has its macroblocks by rows. The boundary strength (bS) is 4 or 3 beside intra prediction, 2 beside
/// levels, 1 between motions that differ.
pub(super) fn deblock(plane: &mut Plane, coded: &[Coded], quantiser: u8) {
    let filter = Filter::new(quantiser);
    let columns = plane.width / MACROBLOCK;
    for (index, here) in coded.iter().enumerate() {
        let (column, row) = (index % columns, index / columns);
        let left = column.checked_sub(1).and_then(|_| coded.get(index - 1));
        let above = row.checked_sub(1).and_then(|_| coded.get(index - columns));
        for (across, neighbour) in [(true, left), (false, above)] {
            for edge in 0..4 {
                let Some(other) = (if edge == 0 { neighbour } else { Some(here) }) else {
                    continue;
                };
                for part in 0..4 {
                    let block =
                        |edge: usize| if across { 4 * part + edge } else { 4 * edge + part };
                    let has = |of: &Coded, edge: usize| of.blocks >> block(edge) & 1 == 1;
                    let strength = if here.is_intra || other.is_intra {
                        if edge == 0 { 4 } else { 3 }
                    } else if has(here, edge) || has(other, (edge + 3) % 4) {
                        2
                    } else {
                        usize::from(differ(here.motion, other.motion))
                    };
                    if strength == 0 {
                        continue;
                    }
                    let (x, y) = if across { (4 * edge, 4 * part) } else { (4 * part, 4 * edge) };
                    let (pixels, at, stride) =
                        plane.pixels_from(MACROBLOCK * column + x, MACROBLOCK * row + y);
                    let (step, along) = if across { (1, stride) } else { (stride, 1) };
                    for line in 0..4 {
                        filter.apply(pixels, at + line * along, step, strength);
                    }
                }
            }
        }
    }
}

/// Whether motions differ by a pixel or more.
fn differ(a: Motion, b: Motion) -> bool {
    a.iter().zip(b).any(|(a, b)| (a - b).abs() >= 4)
}

struct Filter {
    across: i32,
    beside: i32,
    changes: [i32; 3],
}

impl Filter {
    fn new(quantiser: u8) -> Self {
        let at = usize::from(quantiser.min(51));
        let changes = at.checked_sub(17).map_or([0; 3], |at| CHANGES[at]);
        Self {
            across: i32::from(ACROSS[at]),
            beside: i32::from(BESIDE[at]),
            changes: changes.map(i32::from),
        }
    }

    /// Filters across the edge before the pixel `at`; `step` leads across it.
    #[inline]
    fn apply(&self, pixels: &mut [u8], at: usize, step: usize, strength: usize) {
        let grey = |steps: usize| i32::from(pixels[at + steps * step]);
        let back = |steps: usize| i32::from(pixels[at - steps * step]);
        let [p0, p1, p2, p3] = [back(1), back(2), back(3), back(4)];
        let [q0, q1, q2, q3] = [grey(0), grey(1), grey(2), grey(3)];
        if (p0 - q0).abs() >= self.across
            || (p1 - p0).abs() >= self.beside
            || (q1 - q0).abs() >= self.beside
        {
            return;
        }
        let [is_flat_before, is_flat_after] =
            [(p2 - p0).abs() < self.beside, (q2 - q0).abs() < self.beside];
        let mut set = |steps: isize, value: i32| {
            pixels[at.wrapping_add_signed(steps * step as isize)] = value as u8;
        };
        if strength == 4 {
            let is_small = (p0 - q0).abs() < (self.across >> 2) + 2;
            if is_small && is_flat_before {
                set(-1, (p2 + 2 * p1 + 2 * p0 + 2 * q0 + q1 + 4) >> 3);
                set(-2, (p2 + p1 + p0 + q0 + 2) >> 2);
                set(-3, (2 * p3 + 3 * p2 + p1 + p0 + q0 + 4) >> 3);
            } else {
                set(-1, (2 * p1 + p0 + q1 + 2) >> 2);
            }
            if is_small && is_flat_after {
                set(0, (p1 + 2 * p0 + 2 * q0 + 2 * q1 + q2 + 4) >> 3);
                set(1, (p0 + q0 + q1 + q2 + 2) >> 2);
                set(2, (2 * q3 + 3 * q2 + q1 + q0 + p0 + 4) >> 3);
            } else {
                set(0, (2 * q1 + q0 + p1 + 2) >> 2);
            }
            return;
        }
        let bound = self.changes[strength - 1];
        let more = bound + i32::from(is_flat_before) + i32::from(is_flat_after);
        let change = ((4 * (q0 - p0) + p1 - q1 + 4) >> 3).clamp(-more, more);
        set(-1, (p0 + change).clamp(0, 255));
        set(0, (q0 - change).clamp(0, 255));
        let middle = (p0 + q0 + 1) >> 1;
        if is_flat_before {
            set(-2, p1 + ((p2 + middle - 2 * p1) >> 1).clamp(-bound, bound));
        }
        if is_flat_after {
            set(1, q1 + ((q2 + middle - 2 * q1) >> 1).clamp(-bound, bound));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The row of pixels across the edge between two macroblocks with a step, filtered.
    fn across(step: u8, left: Coded, right: Coded) -> [u8; 8] {
        let mut plane = Plane::default();
        plane.resize(32, 16);
        for y in 0..16 {
            let row = plane.row_mut(0, y, 32);
            row[..16].fill(100);
            row[16..].fill(100 + step);
        }
        deblock(&mut plane, &[left, right], 30);
        let row = plane.row(12, 5, 8);
        std::array::from_fn(|at| row[at])
    }

    #[test]
    fn an_edge_is_smoothed_by_how_its_blocks_were_coded() {
        let intra = Coded { is_intra: true, ..Coded::default() };
        let levels = Coded { blocks: u16::MAX, ..Coded::default() };
        let moved = |by: i32| Coded { motion: [by, 0], ..Coded::default() };
        let still = Coded::default();
        // At QP 30 a step is filtered below 25; the strong filter reaches three pixels where it is below 8.
        assert_eq!(across(6, intra, still), [100, 101, 102, 102, 104, 105, 105, 106]);
        assert_eq!(across(20, intra, still), [100, 100, 100, 105, 115, 120, 120, 120]);
        for strong in [intra, levels] {
            assert_eq!(across(25, strong, still), [100, 100, 100, 100, 125, 125, 125, 125]);
        }
        // One more at each flat side than t_C0, which is 1 for both.
        assert_eq!(across(20, levels, still), [100, 100, 101, 103, 117, 119, 120, 120]);
        assert_eq!(across(20, moved(4), still), [100, 100, 101, 103, 117, 119, 120, 120]);
        assert_eq!(across(20, moved(3), still), [100, 100, 100, 100, 120, 120, 120, 120]);
        assert_eq!(across(20, still, still), [100, 100, 100, 100, 120, 120, 120, 120]);
    }
}
