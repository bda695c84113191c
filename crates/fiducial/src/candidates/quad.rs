//! Finds quads, the candidates for square markers, in closed outlines: four corners between straight sides; their lengths, area, middle
//! and pyramid level.

use geometry::Pixel;
use imaging::Outline;
use imaging::pyramid::to_level_0;

/// A quad that may be a square marker's outline.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Quad {
    /// Its corners, clockwise as seen in the image.
    pub(crate) corners: [Pixel; 4],
    /// Bright inside, dark outside.
    pub(crate) inverted: bool,
}

/// The mean of four corners, in pixels.
pub(crate) fn middle(corners: &[Pixel; 4]) -> Pixel {
    let mean = |of: fn(&Pixel) -> f64| corners.iter().map(of).sum::<f64>() / 4.0;
    Pixel::new(mean(|c| c.x), mean(|c| c.y))
}

/// The lengths of the four sides, in pixels; the first begins at the first corner.
pub(crate) fn sides_px(corners: &[Pixel; 4]) -> [f64; 4] {
    [0, 1, 2, 3].map(|i| corners[i].distance(&corners[(i + 1) % 4]))
}

/// The mean of the four sides, in pixels.
pub(crate) fn mean_side_px(corners: &[Pixel; 4]) -> f64 {
    sides_px(corners).iter().sum::<f64>() / 4.0
}

/// The shortest of the four sides, in pixels.
pub(crate) fn shortest_side_px(corners: &[Pixel; 4]) -> f64 {
    sides_px(corners).into_iter().fold(f64::INFINITY, f64::min)
}

/// A side by which the level is chosen on which a square is read, in pixels: of a square that is seen from the side no more than one and a
/// half times its width across, the distance between its longer sides. That is less than the mean side where the ratio of the axes is
/// below a half, along a diagonal below 0.38.
pub(crate) fn at_most_across(side_px: f64, corners: &[Pixel; 4]) -> f64 {
    const MAX_WIDTHS: f64 = 1.5;
    let longest = sides_px(corners).into_iter().fold(f64::MIN_POSITIVE, f64::max);
    side_px.min(MAX_WIDTHS * area_px2(corners) / longest)
}

/// The area, in square pixels.
pub(crate) fn area_px2(corners: &[Pixel; 4]) -> f64 {
    let [a, b, c, d] = corners;
    ((c.x - a.x) * (d.y - b.y) - (c.y - a.y) * (d.x - b.x)).abs() / 2.0
}

/// The longer diagonal, in pixels.
pub(crate) fn diagonal_px(corners: &[Pixel; 4]) -> f64 {
    corners[0].distance(&corners[2]).max(corners[1].distance(&corners[3]))
}

impl Quad {
    /// The quad with its corners, as seen from its middle, moved by a function.
    pub(crate) fn moved(&self, to: impl Fn([f64; 2]) -> [f64; 2]) -> Self {
        let centre = middle(&self.corners);
        let corner = |c: Pixel| {
            let [x, y] = to([c.x - centre.x, c.y - centre.y]);
            Pixel::new(centre.x + x, centre.y + y)
        };
        Self { corners: self.corners.map(corner), ..*self }
    }

    /// The quad scaled about its middle.
    pub(crate) fn scaled(&self, factor: f64) -> Self {
        self.moved(|[x, y]| [factor * x, factor * y])
    }

    /// The quad whose sides fit an outline's points; `None` when the outline is not four-sided.
    pub(crate) fn from_outline(outline: &Outline<'_>) -> Option<Self> {
        let points = outline.points;
        let indices = Self::corner_points(points)?;
        let [width, height] = [0, 1].map(|i| f32::from(outline.bounds[i + 2] - outline.bounds[i]));
        let size = width.max(height);
        let max_rms = MAX_RMS_PX + MAX_RMS_RATIO * size;
        let mut sides = [Side::default(); 4];
        for (i, side) in sides.iter_mut().enumerate() {
            *side = Side::new(points, indices[i], indices[(i + 1) % 4], max_rms)?;
        }
        let mut lines = [Line::default(); 4];
        for (i, line) in lines.iter_mut().enumerate() {
            // Opposite sides of small quads are practically parallel; together they give a better direction.
            let parallel = outline.level == 0 && size <= PARALLEL_PX;
            let opposite = parallel.then_some(&sides[(i + 2) % 4]);
            *line = sides[i].line(opposite)?;
            if line.rms > max_rms {
                return None;
            }
        }
        let mut corners = [[0.0; 2]; 4];
        for i in 0..4 {
            corners[i] = lines[(i + 3) % 4].intersection(&lines[i])?;
            let seen = points[indices[i]];
            let off = (corners[i][0] - seen[0]).hypot(corners[i][1] - seen[1]);
            if off > MAX_CORNER_PX + MAX_CORNER_RATIO * size {
                return None;
            }
        }
        let is_plausible = is_plausible(&corners, outline.area as f32);
        is_plausible.then(|| Self {
            corners: corners.map(|[x, y]| {
                let place = |at: f32| to_level_0(f64::from(at), outline.level);
                Pixel::new(place(x), place(y))
            }),
            inverted: !outline.dark,
        })
    }

    /// Indices of the likeliest corners, in order: the point farthest from the middle, the one farthest from
    /// that one, and the two farthest from the line between them.
    fn corner_points(points: &[[f32; 2]]) -> Option<[usize; 4]> {
        if points.len() < MIN_POINTS {
            return None;
        }
        let n = points.len() as f32;
        let sum = points.iter().fold([0.0; 2], |[x, y], p| [x + p[0], y + p[1]]);
        let first = farthest(points, [sum[0] / n, sum[1] / n]);
        let third = farthest(points, points[first]);
        let ([ax, ay], [bx, by]) = (points[first], points[third]);
        let (mut second, mut fourth) = ((first, 0.0), (first, 0.0));
        for (index, [x, y]) in points.iter().enumerate() {
            // Positive to the right of the line from the first to the third, where, clockwise, the fourth
            // corner lies.
            let across = (bx - ax) * (y - ay) - (by - ay) * (x - ax);
            if across > fourth.1 {
                fourth = (index, across);
            }
            if across < second.1 {
                second = (index, across);
            }
        }
        let mut indices = [first, second.0, third, fourth.0];
        if second.1 == 0.0 || fourth.1 == 0.0 {
            return None;
        }
        // The ends of a short side may not be the farthest points, so each corner is moved to the point
        // farthest from the line between its neighbours.
        for i in [0, 2, 1, 3] {
            let (before, after) = (indices[(i + 3) % 4], indices[(i + 1) % 4]);
            indices[i] = farthest_from_line(points, before, after)?;
        }
        let wraps = (0..4).filter(|i| indices[(i + 1) % 4] < indices[*i]).count();
        (wraps == 1).then_some(indices)
    }
}

/// Smallest number of points of a four-sided outline.
const MIN_POINTS: usize = 12;
/// Largest root mean square distance of a side's points from its line: in pixels, plus a fraction of the
/// outline's size.
const MAX_RMS_PX: f32 = 0.3;
const MAX_RMS_RATIO: f32 = 0.012;
/// Quads up to this size, in pixels, are taken to be parallelograms.
const PARALLEL_PX: f32 = 20.0;
/// Largest distance of a corner from the outline's extreme point, since blur rounds corners: in pixels, plus
/// a fraction of the outline's size.
const MAX_CORNER_PX: f32 = 1.6;
const MAX_CORNER_RATIO: f32 = 0.12;
/// Minimum sine of the angle at a corner: 7.5 degrees. Seen from the side along a diagonal, at a sixth of its width, a square has 19.
const MIN_CORNER_SINE: f32 = 0.13;
/// Maximum ratio of the longest side to the shortest, of a square that is seen from the side under 7 degrees.
const MAX_SIDE_RATIO: f32 = 8.0;
/// Part at either end of a side that is left out because corners are rounded: a fraction of the side, plus
/// pixels.
const END_RATIO: f32 = 0.1;
const END_PX: f32 = 1.0;

fn farthest(points: &[[f32; 2]], from: [f32; 2]) -> usize {
    let mut best = (0, -1.0);
    for (index, [x, y]) in points.iter().enumerate() {
        let distance = (x - from[0]).powi(2) + (y - from[1]).powi(2);
        if distance > best.1 {
            best = (index, distance);
        }
    }
    best.0
}

/// Of the points from `before` to `after`, the one farthest to the left of the line between them.
fn farthest_from_line(points: &[[f32; 2]], before: usize, after: usize) -> Option<usize> {
    let ([ax, ay], [bx, by]) = (points[before], points[after]);
    let mut best = (None, 0.0);
    for (index, [x, y]) in between(points, before, after) {
        let across = (by - ay) * (x - ax) - (bx - ax) * (y - ay);
        if across > best.1 {
            best = (Some(index), across);
        }
    }
    best.0
}

/// The points from one index to another, round the end of the list where need be.
fn between(
    points: &[[f32; 2]],
    from: usize,
    to: usize,
) -> impl Iterator<Item = (usize, &[f32; 2])> {
    let all = points.iter().enumerate();
    let (head, tail) = if from <= to { (0, to) } else { (to, points.len()) };
    let wrapped = all.clone().take(head);
    all.take(tail).skip(from).chain(wrapped)
}

/// A straight line through points: `normal` . p = `offset`.
#[derive(Copy, Clone, Debug, Default)]
struct Line {
    normal: [f32; 2],
    offset: f32,
    rms: f32,
}

impl Line {
    fn distance(&self, [x, y]: [f32; 2]) -> f32 {
        (self.normal[0] * x + self.normal[1] * y - self.offset).abs()
    }

    fn intersection(&self, other: &Self) -> Option<[f32; 2]> {
        let ([a, b], [c, d]) = (self.normal, other.normal);
        let determinant = a * d - b * c;
        if determinant.abs() < MIN_CORNER_SINE {
            return None;
        }
        let (e, f) = (self.offset, other.offset);
        Some([(e * d - b * f) / determinant, (a * f - e * c) / determinant])
    }
}

/// The points of a side: their mean, and the sums of the squares and products of their offsets from it.
#[derive(Copy, Clone, Debug, Default)]
struct Side {
    count: f32,
    mean: [f32; 2],
    xx: f32,
    xy: f32,
    yy: f32,
    /// Root mean square distance of all points of the side from their line, outliers included.
    rms: f32,
}

impl Side {
    /// The points from one index to another, without the ends and without outliers; `None` where they are farther from their line
    /// than this.
    fn new(points: &[[f32; 2]], from: usize, to: usize, max_rms: f32) -> Option<Self> {
        let ([ax, ay], [bx, by]) = (points[from], points[to]);
        let length = (bx - ax).hypot(by - ay);
        let end = (END_PX + END_RATIO * length).min(0.3 * length) * length;
        let along = |[x, y]: &[f32; 2]| (x - ax) * (bx - ax) + (y - ay) * (by - ay);
        let inner = || {
            between(points, from, to)
                .map(|(_, point)| *point)
                .filter(|point| (end..=length * length - end).contains(&along(point)))
        };
        let all = Self::sums(inner(), points[from]);
        let line = all.line(None)?;
        if line.rms > max_rms {
            return None;
        }
        let max_distance = (2.0 * line.rms).max(0.25);
        let near =
            Self::sums(inner().filter(|point| line.distance(*point) <= max_distance), points[from]);
        Some(Self { rms: line.rms, ..near })
    }

    fn sums(points: impl Iterator<Item = [f32; 2]>, origin: [f32; 2]) -> Self {
        let [n, x, y, xx, xy, yy] = points.fold([0.0; 6], |[n, a, b, c, d, e], point| {
            let (x, y) = (point[0] - origin[0], point[1] - origin[1]);
            [n + 1.0, a + x, b + y, c + x * x, d + x * y, e + y * y]
        });
        let (mx, my) = (x / n, y / n);
        Self {
            count: n,
            mean: [mx + origin[0], my + origin[1]],
            xx: xx - n * mx * mx,
            xy: xy - n * mx * my,
            yy: yy - n * my * my,
            rms: 0.0,
        }
    }

    /// The total least-squares line, or the one parallel to the common direction with a second side.
    fn line(&self, parallel_to: Option<&Self>) -> Option<Line> {
        if self.count < 2.0 {
            return None;
        }
        let (mut xx, mut xy, mut yy) = (self.xx, self.xy, self.yy);
        if let Some(other) = parallel_to {
            (xx, xy, yy) = (xx + other.xx, xy + other.xy, yy + other.yy);
        }
        let root = (((xx - yy) / 2.0).powi(2) + xy * xy).sqrt();
        // The normal is the eigenvector of the smaller eigenvalue; of its two forms, the longer one is more
        // exact.
        let smaller = (xx + yy) / 2.0 - root;
        let [a, b] = if xx > yy { [-xy, xx - smaller] } else { [yy - smaller, -xy] };
        let length = a.hypot(b);
        if length < 1e-6 {
            return None;
        }
        let normal = [a / length, b / length];
        let offset = normal[0] * self.mean[0] + normal[1] * self.mean[1];
        let own = (smaller.max(0.0) / self.count).sqrt();
        Some(Line { normal, offset, rms: self.rms.max(own) })
    }
}

/// Whether the corners make a convex quad of about this area that may be the image of a square.
fn is_plausible(corners: &[[f32; 2]; 4], area: f32) -> bool {
    let (mut twice, mut shortest, mut longest) = (0.0, f32::MAX, 0.0_f32);
    for i in 0..4 {
        let [before, at, after] = [(i + 3) % 4, i, (i + 1) % 4].map(|k| corners[k]);
        let (ux, uy) = (at[0] - before[0], at[1] - before[1]);
        let (vx, vy) = (after[0] - at[0], after[1] - at[1]);
        if ux * vy - uy * vx <= 0.0 {
            return false;
        }
        let length = vx.hypot(vy);
        shortest = shortest.min(length);
        longest = longest.max(length);
        twice += at[0] * after[1] - at[1] * after[0];
    }
    let quad_area = twice / 2.0;
    let tolerance = 0.12 * quad_area + 1.2 * longest;
    shortest >= 3.5 && shortest * MAX_SIDE_RATIO >= longest && (quad_area - area).abs() <= tolerance
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::{GrayView, Outlines, outline};

    /// A dark shape on white; each pixel is the mean of 8 x 8 points.
    fn render(within: impl Fn(f64, f64) -> bool) -> Vec<u8> {
        let grey = |x: usize, y: usize| {
            let inside = (0..64).filter(|i| {
                let part = |p: usize, k: usize| p as f64 + (k as f64 + 0.5) / 8.0 - 0.5;
                within(part(x, i % 8), part(y, i / 8))
            });
            (220 - 200 * inside.count() / 64) as u8
        };
        (0..96 * 96).map(|i| grey(i % 96, i / 96)).collect()
    }

    /// The quads on the first levels; on later ones a disc of a few pixels may be taken for a square.
    fn quads(data: &[u8], levels: usize) -> Vec<Quad> {
        let mut outlines = Outlines::default();
        outlines.find(GrayView::packed(data, 96, 96).unwrap(), &outline::Settings::default());
        outlines
            .iter()
            .filter(|o| o.level < levels)
            .filter_map(|o| Quad::from_outline(&o))
            .collect()
    }

    #[test]
    fn corners_of_rotated_squares_are_found_to_a_fraction_of_a_pixel() {
        for (half, turn) in [(4.0, 0.3), (6.0, 0.7), (10.0, 0.0), (14.0, 0.4), (30.0, 1.1)] {
            let (sin, cos) = f64::sin_cos(turn);
            let within = |x: f64, y: f64| {
                let (x, y) = (x - 47.3, y - 48.1);
                (x * cos + y * sin).abs() < half && (y * cos - x * sin).abs() < half
            };
            let found = quads(&render(within), 9);
            assert!(!found.is_empty(), "{half} {turn}");
            for quad in found {
                for corner in quad.corners {
                    let (x, y) = (corner.x - 47.3, corner.y - 48.1);
                    let off = [x * cos + y * sin, y * cos - x * sin].map(|a| a.abs() - half);
                    assert!(
                        off.iter().all(|o| o.abs() < 0.35 + 0.02 * half),
                        "{half} {turn} {off:?}"
                    );
                }
            }
        }
    }

    #[test]
    fn discs_and_triangles_are_not_quads() {
        let disc = |x: f64, y: f64| (x - 48.0).hypot(y - 48.0) < 24.0;
        assert_eq!(quads(&render(disc), 2), []);
        let triangle = |x: f64, y: f64| y > 20.0 && y < 80.0 && (x - 48.0).abs() < (y - 20.0) / 2.0;
        assert_eq!(quads(&render(triangle), 2), []);
    }
}
