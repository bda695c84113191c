//! Covers cells with few rectangles.

/// A rectangle of cells: its first column and row, and those after its last.
pub(super) type Rectangle = [[usize; 2]; 2];

/// The marked cells of a square of `side` cells, given row by row, as rectangles side by side: each is the largest of the
/// cells that are left.
pub(super) fn rectangles(side: usize, mut cells: Vec<bool>) -> Vec<Rectangle> {
    let mut chosen = Vec::new();
    while let Some(next) = largest(side, &cells) {
        let [[left, top], [right, bottom]] = next;
        (top..bottom).for_each(|y| cells[y * side + left..y * side + right].fill(false));
        chosen.push(next);
    }
    chosen
}

/// The largest rectangle of marked cells.
fn largest(side: usize, cells: &[bool]) -> Option<Rectangle> {
    let mut best = None;
    let mut best_area = 0;
    for (start, _) in cells.iter().enumerate().filter(|(_, is_marked)| **is_marked) {
        let [left, top] = [start % side, start / side];
        let mut right = side;
        for y in top..side {
            let row = &cells[y * side + left..y * side + right];
            right = left + row.iter().take_while(|is_marked| **is_marked).count();
            let area = (right - left) * (y + 1 - top);
            if area > best_area {
                (best, best_area) = (Some([[left, top], [right, y + 1]]), area);
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cover(rows: &[&str]) -> Vec<Rectangle> {
        rectangles(rows.len(), rows.iter().flat_map(|row| row.chars().map(|c| c == '#')).collect())
    }

    #[test]
    fn an_angle_is_two_rectangles() {
        assert_eq!(cover(&["#..", "#..", "###"]), [[[0, 0], [1, 3]], [[1, 2], [3, 3]]]);
    }

    #[test]
    fn a_full_square_is_one_and_an_empty_one_none() {
        assert_eq!(cover(&["##", "##"]), [[[0, 0], [2, 2]]]);
        assert_eq!(cover(&["..", ".."]), [] as [Rectangle; 0]);
    }

    #[test]
    fn each_cell_is_in_one_rectangle() {
        let cells: Vec<bool> =
            (0..81u32).map(|i| i.wrapping_mul(2_654_435_761) >> 31 == 0).collect();
        let mut count = [0; 81];
        for [[left, top], [right, bottom]] in rectangles(9, cells.clone()) {
            for y in top..bottom {
                count[y * 9 + left..y * 9 + right].iter_mut().for_each(|n| *n += 1);
            }
        }
        assert!(count.iter().zip(cells).all(|(n, is_marked)| *n == i32::from(is_marked)));
    }
}
