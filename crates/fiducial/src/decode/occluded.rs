//! Searches quads of edge segments for markers partly in shadow, washed out, covered or beyond the frame, and
//! keeps the best reading of each place.

use imaging::GrayView;
use markers::SquareCode;

use crate::candidates::overlap::{Overlap, suppress_non_maxima};
use crate::candidates::quad::{Quad, shortest_side_px};
use crate::decode::erasures::{CellImage, Reading, has_border, have_same_cells};
use crate::decode::steps::Steps;

/// Largest number of readings in one image.
const MAX_FOUND: usize = 64;

/// A quad with its reading.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct OccludedMarker<R> {
    pub(crate) quad: Quad,
    pub(crate) reading: R,
    /// Of conflicting markers, the one with the highest score is retained.
    pub(crate) score: f64,
}

/// Collects readings of quads and keeps the best of each place. It keeps its memory from image to image.
#[derive(Clone, Debug)]
pub(crate) struct Occluded<R> {
    found: Vec<OccludedMarker<R>>,
}

impl<R> Default for Occluded<R> {
    fn default() -> Self {
        Self { found: Vec::new() }
    }
}

impl<R: Copy> Occluded<R> {
    /// Makes room for a frame's readings.
    pub(crate) fn make_room(&mut self) {
        self.found.clear();
        self.found.reserve(MAX_FOUND);
    }

    /// The markers that `read` adds for the quads, each place once, the best first.
    pub(crate) fn find(
        &mut self,
        quads: &[Quad],
        mut read: impl FnMut(&Quad, &mut Self),
    ) -> &[OccludedMarker<R>] {
        self.found.clear();
        for quad in quads {
            if self.is_full() {
                break;
            }
            read(quad, self);
        }
        suppress_non_maxima(
            &mut self.found,
            |marker| marker.score,
            |better, marker| Overlap::new(&better.quad.corners, &marker.quad.corners).is_conflict(),
        );
        &self.found
    }

    pub(crate) fn push(&mut self, marker: OccludedMarker<R>) {
        if !self.is_full() {
            self.found.push(marker);
        }
    }

    fn is_full(&self) -> bool {
        self.found.len() >= MAX_FOUND
    }
}

/// The markers of one family that are looked for.
#[derive(Copy, Clone, Debug)]
pub(crate) struct OccludedQuery<'a> {
    /// The caller's index of the family.
    pub(crate) family: usize,
    pub(crate) code: &'a SquareCode,
    /// The ids; `None` means all.
    pub(crate) ids: Option<&'a [u32]>,
}

/// A reading of a square marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct SquareReading {
    /// The caller's index of the family.
    pub(crate) family: usize,
    pub(crate) reading: Reading,
}

/// Smallest cell that can be distinguished from its neighbours, in pixels.
const MIN_CELL_PX: f64 = 2.5;
/// Largest number of readings tried in one image.
const MAX_READ: usize = 100;
/// A place where this fraction of border and quiet zone is intact is not read again.
const WELL_INTACT: f32 = 0.9;

impl Occluded<SquareReading> {
    /// The square markers among quads of segments. `is_open` is true where a quad may be a marker of a code.
    pub(crate) fn find_squares<'a>(
        &mut self,
        view: GrayView<'_>,
        quads: &[Quad],
        queries: impl Iterator<Item = OccludedQuery<'a>> + Clone,
        is_open: impl Fn(&Quad, &SquareCode) -> bool,
    ) -> &[OccludedMarker<SquareReading>] {
        let mut left = MAX_READ;
        self.find(quads, |quad, found| {
            let queries = queries.clone().filter(|query| is_open(quad, query.code));
            read_square(view, quad, queries, &mut left, found);
        })
    }
}

/// Reads a quad as a marker of each family that is looked for.
fn read_square<'a>(
    view: GrayView<'_>,
    quad: &Quad,
    queries: impl Iterator<Item = OccludedQuery<'a>>,
    left: &mut usize,
    found: &mut Occluded<SquareReading>,
) {
    let is_known = found.found.iter().any(|marker| {
        marker.reading.reading.intact > WELL_INTACT
            && Overlap::new(&marker.quad.corners, &quad.corners).is_conflict()
    });
    if is_known {
        return;
    }
    let side_px = shortest_side_px(&quad.corners);
    // Families with the same cells share their image.
    let mut border: Option<(u8, bool)> = None;
    let mut image: Option<(&SquareCode, Option<CellImage>)> = None;
    for OccludedQuery { family, code, ids } in queries {
        if side_px < MIN_CELL_PX * f64::from(code.cells) {
            continue;
        }
        if *left == 0 || found.is_full() {
            return;
        }
        let known = border.filter(|(cells, _)| *cells == code.cells);
        let (_, is_bordered) =
            *border.insert(known.unwrap_or_else(|| (code.cells, has_border(view, quad, code))));
        if !is_bordered {
            continue;
        }
        *left -= 1;
        if image.as_ref().is_none_or(|(other, _)| !have_same_cells(other, code)) {
            image = Some((code, CellImage::read(view, quad, code)));
        }
        let cells = image.as_ref().and_then(|(_, cells)| cells.as_ref());
        let reading = cells.and_then(|cells| cells.decode(code, ids));
        let reading = reading
            .or_else(|| Steps::read(view, quad, code).and_then(|steps| steps.decode(code, ids)));
        if let Some(reading) = reading {
            let mut quad = *quad;
            quad.corners.rotate_left(usize::from(reading.rotation % 4));
            let score = f64::from(reading.intact * reading.r_squared * reading.evidence);
            let reading = SquareReading { family, reading };
            found.push(OccludedMarker { quad, reading, score });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::candidates::segment_quads::{ImageQuads, Scale};
    use geometry::Pixel;
    use imaging::{GrayImage, Pyramid};
    use markers::Family;

    const SIDE: f64 = 80.0;
    const ID: u32 = 7;

    /// A rotated marker on paper on grey ground. `light` changes the grey value at a place, which is given in
    /// sides from the marker's middle, along its edges.
    fn render(
        code: &SquareCode,
        centre: [f64; 2],
        turn: f64,
        light: impl Fn([f64; 2], f64) -> f64,
    ) -> (GrayImage, [Pixel; 4]) {
        let (sin, cos) = turn.sin_cos();
        let cells = f64::from(code.cells);
        let grey = |u: f64, v: f64| {
            let cell = [u, v].map(|at| ((at + 0.5) * cells).floor() as i8);
            let bit = code.bits.iter().position(|bit| *bit == cell);
            let word = code.codewords[ID as usize] >> (code.bits.len() - 1 - bit.unwrap_or(0));
            match (u.abs().max(v.abs()), bit) {
                (_, Some(_)) => {
                    if word & 1 != 0 {
                        200.0
                    } else {
                        30.0
                    }
                }
                (..0.5, None) => 30.0,
                (..0.7, None) => 200.0,
                _ => 110.0,
            }
        };
        let mut image = GrayImage::filled(320, 240, 0);
        for y in 0..240 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let sum: f64 = (0..9)
                    .map(|i| {
                        let dx = x as f64 + f64::from(i % 3 - 1) / 3.0 - centre[0];
                        let dy = y as f64 + f64::from(i / 3 - 1) / 3.0 - centre[1];
                        let (u, v) = ((dx * cos + dy * sin) / SIDE, (dy * cos - dx * sin) / SIDE);
                        light([u, v], grey(u, v)).clamp(0.0, 255.0)
                    })
                    .sum();
                // A texture of a few grey levels.
                *pixel = (sum / 9.0 + ((x * 7 + y * 13) % 5) as f64 - 2.0).clamp(0.0, 255.0) as u8;
            }
        }
        let corners = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]].map(|[u, v]| {
            let (dx, dy) = (u * SIDE, v * SIDE);
            Pixel::new(centre[0] + dx * cos - dy * sin, centre[1] + dx * sin + dy * cos)
        });
        (image, corners)
    }

    fn find(
        image: &GrayImage,
        code: &SquareCode,
        ids: Option<&[u32]>,
    ) -> Vec<OccludedMarker<SquareReading>> {
        let mut pyramid = Pyramid::default();
        let view = image.view().unwrap();
        pyramid.build(view, 4, 16);
        let queries = std::iter::once(OccludedQuery { family: 0, code, ids });
        let mut quads = ImageQuads::default();
        quads.begin(Scale::ALL.map(Some));
        quads.make(view, &pyramid);
        let mut occluded = Occluded::default();
        occluded.find_squares(view, quads.quads(), queries, |_, _| true).to_vec()
    }

    /// Asserts that the marker is found in any rotation, with errors of its corners below `max_px`.
    fn expect(family: Family, centre: [f64; 2], max_px: f64, light: impl Fn([f64; 2], f64) -> f64) {
        let code = SquareCode::for_family(family).unwrap();
        for step in 0..8 {
            let turn = 0.1 + 0.8 * f64::from(step);
            let (image, corners) = render(code, centre, turn, &light);
            let found = find(&image, code, Some(&[ID]));
            assert_eq!(found.len(), 1, "{family} {turn}");
            assert_eq!(found[0].reading.reading.id, ID);
            for (corner, truth) in found[0].quad.corners.iter().zip(corners) {
                let off = corner.distance(&truth);
                assert!(off < max_px, "{family} turned by {turn}: {off} px off");
            }
        }
    }

    const FAMILIES: [Family; 3] =
        [Family::AprilTag16h5, Family::AprilTag36h11, Family::Aruco4x4_50];
    const MIDDLE: [f64; 2] = [160.3, 120.6];

    #[test]
    fn a_marker_under_the_edge_of_a_shadow_is_found() {
        for family in FAMILIES {
            expect(
                family,
                MIDDLE,
                1.5,
                |[u, v], grey| {
                    if u + 0.4 * v > 0.07 { 0.25 * grey } else { grey }
                },
            );
        }
    }

    #[test]
    fn a_marker_with_a_covered_corner_is_found() {
        for level in [20.0, 90.0, 230.0] {
            for family in FAMILIES {
                expect(family, MIDDLE, 1.5, |[u, v], grey| if u + v > 0.75 { level } else { grey });
            }
        }
    }

    #[test]
    fn a_marker_of_which_two_corners_are_covered_is_found() {
        let opposite = [[-0.5, -0.5], [0.5, 0.5]];
        let at_one_side = [[-0.5, -0.5], [0.5, -0.5]];
        for corners in [opposite, at_one_side] {
            for level in [20.0, 90.0, 230.0] {
                expect(Family::AprilTag36h11, MIDDLE, 1.5, |[u, v], grey| {
                    let covered = |[x, y]: [f64; 2]| (u - x).hypot(v - y) < 0.22;
                    if corners.into_iter().any(covered) { level } else { grey }
                });
            }
        }
    }

    #[test]
    fn a_marker_with_a_reflection_is_found() {
        expect(Family::AprilTag36h11, MIDDLE, 3.0, |[u, v], grey| {
            let away = (u - 0.35).hypot(v + 0.2) / 0.15;
            grey + 350.0 * (-0.5 * away * away).exp()
        });
    }

    #[test]
    fn a_marker_in_the_light_between_leaves_is_found() {
        let suns = [
            [-0.42, -0.3, 0.2],
            [0.1, -0.45, 0.14],
            [0.35, 0.1, 0.25],
            [-0.2, 0.2, 0.17],
            [0.1, 0.5, 0.2],
        ];
        for family in FAMILIES {
            expect(family, MIDDLE, 1.5, |[u, v], grey| {
                let lit = suns.iter().map(|[x, y, radius]| {
                    (1.0 + (radius - (u - x).hypot(v - y)) / 0.06).clamp(0.0, 1.0)
                });
                grey * (0.22 + 0.78 * lit.fold(0.0, f64::max))
            });
        }
    }

    #[test]
    fn a_marker_in_white_on_black_is_found() {
        for family in FAMILIES {
            expect(family, MIDDLE, 1.5, |_, grey| 235.0 - grey);
        }
    }

    #[test]
    fn a_marker_cut_by_the_frame_is_found() {
        let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
        // A corner is beyond the left edge of the frame.
        let (image, corners) = render(code, [46.0, 120.0], std::f64::consts::FRAC_PI_4, |_, g| g);
        let found = find(&image, code, None);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].reading.reading.id, ID);
        for (corner, truth) in found[0].quad.corners.iter().zip(corners) {
            assert!(corner.distance(&truth) < 1.5);
        }
    }

    #[test]
    fn dark_squares_and_other_ids_are_not_found() {
        let code = SquareCode::for_family(Family::AprilTag16h5).unwrap();
        let (image, _) =
            render(
                code,
                MIDDLE,
                0.3,
                |[u, v], grey| {
                    if u.abs().max(v.abs()) < 0.5 { 30.0 } else { grey }
                },
            );
        assert_eq!(find(&image, code, None), []);
        let (image, _) = render(code, MIDDLE, 0.3, |_, grey| grey);
        assert_eq!(find(&image, code, Some(&[8, 9])), []);
        assert_eq!(find(&image, code, None).len(), 1);
    }

    #[test]
    fn textures_are_not_markers() {
        let code = SquareCode::for_family(Family::AprilTagCircle21h7).unwrap();
        let mut random = 1_u32;
        for (width, height) in [(1, 1), (2, 9), (16, 16), (64, 48), (301, 7), (150, 150)] {
            for pattern in 0..4 {
                let mut image = GrayImage::filled(width, height, 128);
                for (i, pixel) in image.pixels_mut().iter_mut().enumerate() {
                    random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    *pixel = match pattern {
                        0 => (random >> 24) as u8,
                        1 => 255 * ((i % width / 5 + i / width / 5) % 2) as u8,
                        2 => 255 * ((i % width + i / width) % 2) as u8,
                        _ => 255 * (i % width / 3 % 2) as u8,
                    };
                }
                assert_eq!(find(&image, code, None), [], "{width} x {height}, {pattern}");
            }
        }
    }
}
