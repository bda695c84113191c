//! Follows the borders between white and black pixels of a binary image (Suzuki and Abe), for the thesis'
//! detector: the points of each, and whether it is that of a hole.

use crate::view::GrayView;

/// The borders between the white (not 0) and the black (0) pixels of an image, by Suzuki and Abe's border
/// following (1985), as OpenCV's `findContours` with `RETR_LIST` and `CHAIN_APPROX_SIMPLE`.
///
/// White is connected across corners. The points are white pixels: an outer border's are the outermost of a
/// white region, a hole's are those around a black region. Pixels beyond the image count as black. Of
/// straight runs (vertical, horizontal, diagonal) only the ends are stored. Borders come in raster order from
/// the top left; OpenCV lists them in reverse.
#[derive(Clone, Debug, Default)]
pub struct Contours {
    /// One byte per pixel with a border of one: 0 black, 1 white, [`SEEN`] on a border, [`SEEN_RIGHT`] on a
    /// border with black to the right.
    labels: Vec<u8>,
    points: Vec<[i32; 2]>,
    spans: Vec<Span>,
}

#[derive(Copy, Clone, Debug)]
struct Span {
    start: usize,
    end: usize,
    hole: bool,
}

/// One border.
#[derive(Copy, Clone, Debug)]
pub struct Contour<'a> {
    /// Its pixels (x, y), without the inner ones of straight runs.
    pub points: &'a [[i32; 2]],
    /// True for the border around a black region, false for the outer border of a white one.
    pub hole: bool,
}

/// Which borders [`Contours::find`] keeps.
#[derive(Copy, Clone, Debug)]
pub struct Limits {
    /// Borders of fewer points are dropped.
    pub min_points: usize,
    /// The search ends when the stored borders have this many points.
    pub max_points: usize,
}

const SEEN: u8 = 2;
const SEEN_RIGHT: u8 = 3;

/// The eight neighbours, counter-clockwise as seen in the image, from the one to the right.
const NEIGHBOURS: [[i32; 2]; 8] =
    [[1, 0], [1, -1], [0, -1], [-1, -1], [-1, 0], [-1, 1], [0, 1], [1, 1]];

impl Contours {
    /// Finds the borders of an image, replacing those found before.
    pub fn find(&mut self, binary: GrayView<'_>, limits: Limits) {
        self.points.clear();
        self.spans.clear();
        self.label(binary);
        let stride = binary.width() + 2;
        for y in 0..binary.height() {
            let row = (y + 1) * stride;
            let mut x = 1;
            while let Some(step) = self.next_change(row, x, stride) {
                x = step;
                let at = row + x;
                let (before, here) = (self.labels[at - 1], self.labels[at]);
                if before == 0 && here == 1 {
                    self.keep(at, [x as i32 - 1, y as i32], false, stride, limits);
                } else if here == 0 && matches!(before, 1 | SEEN) {
                    self.keep(at - 1, [x as i32 - 2, y as i32], true, stride, limits);
                }
                if self.points.len() >= limits.max_points {
                    return;
                }
                x += 1;
            }
        }
    }

    /// Number of borders.
    pub fn len(&self) -> usize {
        self.spans.len()
    }

    /// True when there are none.
    pub fn is_empty(&self) -> bool {
        self.spans.is_empty()
    }

    /// The border of an index below [`Contours::len`].
    pub fn get(&self, index: usize) -> Option<Contour<'_>> {
        let span = self.spans.get(index)?;
        Some(Contour { points: self.points.get(span.start..span.end)?, hole: span.hole })
    }

    /// All borders, in order.
    pub fn iter(&self) -> impl Iterator<Item = Contour<'_>> {
        self.spans
            .iter()
            .map(|span| Contour { points: &self.points[span.start..span.end], hole: span.hole })
    }

    fn label(&mut self, binary: GrayView<'_>) {
        let stride = binary.width() + 2;
        self.labels.clear();
        self.labels.resize(stride * (binary.height() + 2), 0);
        for y in 0..binary.height() {
            let row = &mut self.labels[(y + 1) * stride + 1..];
            for (label, pixel) in row.iter_mut().zip(binary.row(y)) {
                *label = u8::from(*pixel != 0);
            }
        }
    }

    /// The first column from `x` on whose label differs from its left neighbour's, up to the right border's.
    fn next_change(&self, row: usize, mut x: usize, stride: usize) -> Option<usize> {
        let labels = self.labels.get(row..row + stride)?;
        // Eight pairs of neighbours at a time: the first byte that is not 0 in the difference is the change.
        let word = |from: usize| {
            let bytes = labels.get(from..from + 8)?;
            Some(u64::from_le_bytes(bytes.try_into().ok()?))
        };
        while let (Some(left), Some(here)) = (word(x - 1), word(x)) {
            let difference = left ^ here;
            if difference != 0 {
                return Some(x + difference.trailing_zeros() as usize / 8);
            }
            x += 8;
        }
        (x..stride).find(|x| labels[x - 1] != labels[*x])
    }

    fn keep(&mut self, at: usize, pixel: [i32; 2], hole: bool, stride: usize, limits: Limits) {
        let start = self.points.len();
        self.follow(at, pixel, hole, stride);
        let end = self.points.len();
        if end - start < limits.min_points {
            self.points.truncate(start);
        } else {
            self.spans.push(Span { start, end, hole });
        }
    }

    /// Follows the border that begins at label `start` (pixel `pixel`), marks it and stores its corners.
    fn follow(&mut self, start: usize, mut pixel: [i32; 2], hole: bool, stride: usize) {
        let offsets = NEIGHBOURS.map(|[dx, dy]| dx as isize + dy as isize * stride as isize);
        let step = |at: usize, direction: usize| at.wrapping_add_signed(offsets[direction & 7]);
        // Clockwise from the black neighbour for the last pixel of the border.
        let black = if hole { 0 } else { 4 };
        let Some(back) = (1..8)
            .map(|turn| (black + 8 - turn) & 7)
            .find(|direction| self.labels[step(start, *direction)] != 0)
        else {
            self.labels[start] = SEEN_RIGHT;
            self.points.push(pixel);
            return;
        };
        let last = step(start, back);
        let (mut at, mut from, mut run) = (start, back, back ^ 4);
        loop {
            // Counter-clockwise from where the border came from; that pixel itself is the last resort.
            let mut turn = 1;
            while self.labels[step(at, from + turn)] == 0 {
                turn += 1;
            }
            let direction = (from + turn) & 7;
            // The right neighbour (direction 0) was skipped as black exactly when the turn passed it.
            if from + turn > 8 {
                self.labels[at] = SEEN_RIGHT;
            } else if self.labels[at] == 1 {
                self.labels[at] = SEEN;
            }
            if direction != run {
                self.points.push(pixel);
                run = direction;
            }
            let next = step(at, direction);
            if next == start && at == last {
                return;
            }
            pixel = [pixel[0] + NEIGHBOURS[direction][0], pixel[1] + NEIGHBOURS[direction][1]];
            at = next;
            from = (direction + 4) & 7;
        }
    }
}

/// Area within a closed polygon, in square pixels (OpenCV's `contourArea`).
pub fn contour_area(points: &[[i32; 2]]) -> f64 {
    let Some(last) = points.last() else {
        return 0.0;
    };
    let mut previous = *last;
    let mut twice = 0_i64;
    for point in points {
        twice += i64::from(previous[0]) * i64::from(point[1])
            - i64::from(previous[1]) * i64::from(point[0]);
        previous = *point;
    }
    twice.abs() as f64 / 2.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const ALL: Limits = Limits { min_points: 1, max_points: usize::MAX };

    fn find(rows: &[&str]) -> Vec<(Vec<[i32; 2]>, bool)> {
        let data: Vec<u8> = rows
            .iter()
            .flat_map(|row| row.bytes().map(|b| if b == b'#' { 255 } else { 0 }))
            .collect();
        let mut contours = Contours::default();
        contours.find(GrayView::packed(&data, rows[0].len(), rows.len()).unwrap(), ALL);
        contours.iter().map(|c| (c.points.to_vec(), c.hole)).collect()
    }

    #[test]
    fn a_frame_has_an_outer_border_and_a_hole() {
        let found = find(&["#####", "#...#", "#...#", "#####"]);
        assert_eq!(found.len(), 2);
        assert_eq!(found[0], (vec![[0, 0], [0, 3], [4, 3], [4, 0]], false));
        assert_eq!(
            found[1],
            (vec![[0, 1], [1, 0], [3, 0], [4, 1], [4, 2], [3, 3], [1, 3], [0, 2]], true)
        );
    }

    #[test]
    fn a_lone_pixel_is_a_border_of_one_point() {
        assert_eq!(find(&["...", ".#.", "..."]), [(vec![[1, 1]], false)]);
    }

    #[test]
    fn white_is_connected_across_corners_and_black_is_not() {
        let found = find(&["#.#", ".#.", "#.#"]);
        assert_eq!(found.iter().filter(|c| !c.1).count(), 1);
        let found = find(&[".#.", "#.#", ".#."]);
        assert_eq!(found.iter().map(|c| c.1).collect::<Vec<_>>(), [false, true]);
    }

    #[test]
    fn short_and_surplus_borders_are_dropped() {
        let data: Vec<u8> =
            (0..10_000).map(|i| if (i % 100 + i / 100) % 2 == 0 { 255 } else { 0 }).collect();
        let view = GrayView::packed(&data, 100, 100).unwrap();
        let mut contours = Contours::default();
        contours.find(view, Limits { min_points: 5, max_points: 1000 });
        assert!(contours.iter().all(|c| c.points.len() >= 5));
        contours.find(view, Limits { min_points: 1, max_points: 1000 });
        let total: usize = contours.iter().map(|c| c.points.len()).sum();
        assert!((1000..1000 + 400).contains(&total), "{total}");
    }

    #[test]
    fn areas_of_polygons() {
        assert_eq!(contour_area(&[[0, 0], [0, 3], [4, 3], [4, 0]]), 12.0);
        assert_eq!((contour_area(&[]), contour_area(&[[3, 4]])), (0.0, 0.0));
    }

    proptest! {
        #[test]
        fn each_white_region_has_one_outer_border(
            (width, data) in (1_usize..12).prop_flat_map(|w| {
                (Just(w), (1_usize..12).prop_flat_map(move |h| prop::collection::vec(prop::bool::ANY, w * h)))
            })
        ) {
            let pixels: Vec<u8> = data.iter().map(|white| u8::from(*white)).collect();
            let view = GrayView::packed(&pixels, width, pixels.len() / width).unwrap();
            let mut contours = Contours::default();
            contours.find(view, ALL);
            let outer = contours.iter().filter(|c| !c.hole).count();
            prop_assert_eq!(outer, regions(&data, width));
            for contour in contours.iter() {
                for [x, y] in contour.points {
                    prop_assert_eq!(view.at(*x as usize, *y as usize), 1);
                }
            }
        }
    }

    /// Number of white regions, connected across corners, by flooding.
    fn regions(white: &[bool], width: usize) -> usize {
        let mut left = white.to_vec();
        let mut count = 0;
        while let Some(seed) = left.iter().position(|w| *w) {
            count += 1;
            let mut stack = vec![seed];
            while let Some(at) = stack.pop() {
                if !std::mem::replace(&mut left[at], false) {
                    continue;
                }
                let (x, y) = (at % width, at / width);
                for ny in y.saturating_sub(1)..(y + 2).min(white.len() / width) {
                    for nx in x.saturating_sub(1)..(x + 2).min(width) {
                        stack.push(ny * width + nx);
                    }
                }
            }
        }
        count
    }
}
