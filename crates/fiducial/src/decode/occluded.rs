//! Finds square markers that are in part in shadow, washed out, covered or beyond the frame: the slow way, for when
//! closed outlines do not show them.

use imaging::GrayView;
use markers::SquareCode;

use crate::candidates::quad::{Quad, diagonal_px, middle, sides_px};
use crate::decode::erasures::{Reading, Seen, has_border, have_same_cells, look};

/// The markers of one family that are looked for.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Sought<'a> {
    /// What the caller knows the family by.
    pub(crate) index: usize,
    /// The family's code.
    pub(crate) code: &'a SquareCode,
    /// The ids; `None` stands for all.
    pub(crate) ids: Option<&'a [u32]>,
}

/// A marker that was found.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct DamagedMarker {
    /// What the caller knows its family by.
    pub(crate) index: usize,
    /// Its outline, the marker's own top left corner first.
    pub(crate) quad: Quad,
    /// What it says.
    pub(crate) reading: Reading,
}

/// Finds damaged markers. It keeps its memory from image to image.
#[derive(Clone, Debug, Default)]
pub(crate) struct Damaged {
    found: Vec<DamagedMarker>,
}

/// Cells that are narrower, in pixels, cannot be told apart one by one.
const LEAST_CELL_PX: f64 = 2.5;
/// The most quads that are read in an image, and the most markers that are found.
const MOST_READ: usize = 100;
const MOST_FOUND: usize = 64;

impl Damaged {
    /// Makes room for what may be found.
    pub(crate) fn make_room(&mut self) {
        self.found.clear();
        self.found.reserve(MOST_FOUND);
    }

    /// The markers in an image among the quads that its segments make, as far as these are open to markers of the code; the
    /// surest first.
    pub(crate) fn find<'a>(
        &mut self,
        view: GrayView<'_>,
        quads: &[Quad],
        sought: impl Iterator<Item = Sought<'a>> + Clone,
        is_open: impl Fn(&Quad, &SquareCode) -> bool,
    ) -> &[DamagedMarker] {
        self.found.clear();
        let mut left = MOST_READ;
        for quad in quads {
            let sought = sought.clone().filter(|sought| is_open(quad, sought.code));
            read(view, quad, sought, &mut left, &mut self.found);
        }
        self.choose();
        &self.found
    }

    /// Of what was found in one place more than once, keeps the surest.
    fn choose(&mut self) {
        let sureness = |marker: &DamagedMarker| {
            let Reading { intact, explained, evidence, .. } = marker.reading;
            intact * explained * evidence
        };
        self.found.sort_unstable_by(|a, b| sureness(b).total_cmp(&sureness(a)));
        let mut kept = 0;
        for index in 0..self.found.len() {
            let marker = self.found[index];
            if !self.found[..kept].iter().any(|other| is_same_place(&other.quad, &marker.quad)) {
                self.found[kept] = marker;
                kept += 1;
            }
        }
        self.found.truncate(kept);
    }
}

/// Reads a quad as a marker of each family that is looked for.
fn read<'a>(
    view: GrayView<'_>,
    quad: &Quad,
    sought: impl Iterator<Item = Sought<'a>>,
    left: &mut usize,
    found: &mut Vec<DamagedMarker>,
) {
    // What was read well needs no second reading.
    let is_known = found.iter().any(|m| m.reading.intact > 0.9 && is_same_place(&m.quad, quad));
    if is_known {
        return;
    }
    let shortest = sides_px(&quad.corners).into_iter().fold(f64::MAX, f64::min);
    // Families with the same cells see the same.
    let mut border: Option<(u8, bool)> = None;
    let mut looked: Option<(&SquareCode, Option<Seen>)> = None;
    for family in sought {
        let code = family.code;
        if shortest < LEAST_CELL_PX * f64::from(code.cells) {
            continue;
        }
        if *left == 0 || found.len() >= MOST_FOUND {
            return;
        }
        let known = border.filter(|(cells, _)| *cells == code.cells);
        let (_, has_border) =
            *border.insert(known.unwrap_or_else(|| (code.cells, has_border(view, quad, code))));
        if !has_border {
            continue;
        }
        *left -= 1;
        if looked.as_ref().is_none_or(|(other, _)| !have_same_cells(other, code)) {
            looked = Some((code, look(view, quad, code)));
        }
        let seen = looked.as_ref().and_then(|(_, seen)| seen.as_ref());
        if let Some(reading) = seen.and_then(|seen| seen.reading(code, family.ids)) {
            let mut quad = *quad;
            quad.corners.rotate_left(usize::from(reading.quarter_turns % 4));
            found.push(DamagedMarker { index: family.index, quad, reading });
        }
    }
}

/// Whether two quads overlap so much that only one of them can be a marker.
fn is_same_place(a: &Quad, b: &Quad) -> bool {
    let size = diagonal_px(&a.corners).max(diagonal_px(&b.corners));
    middle(&a.corners).distance(&middle(&b.corners)) < 0.4 * size
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

    /// A marker on paper on grey ground, turned, with its middle at `centre`; `light` says what becomes of the grey value
    /// at a place, which is given in sides from the marker's middle and along its edges.
    fn picture(
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
                // A texture of a few grey levels, as no surface is even.
                *pixel = (sum / 9.0 + ((x * 7 + y * 13) % 5) as f64 - 2.0).clamp(0.0, 255.0) as u8;
            }
        }
        let corners = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]].map(|[u, v]| {
            let (dx, dy) = (u * SIDE, v * SIDE);
            Pixel::new(centre[0] + dx * cos - dy * sin, centre[1] + dx * sin + dy * cos)
        });
        (image, corners)
    }

    fn find(image: &GrayImage, code: &SquareCode, ids: Option<&[u32]>) -> Vec<DamagedMarker> {
        let mut pyramid = Pyramid::default();
        let view = image.view().unwrap();
        pyramid.build(view, 4, 16);
        let sought = std::iter::once(Sought { index: 0, code, ids });
        let mut quads = ImageQuads::default();
        quads.begin(Scale::ALL.map(Some));
        quads.make(view, &pyramid);
        Damaged::default().find(view, quads.quads(), sought, |_, _| true).to_vec()
    }

    /// Finds the one marker there is, whatever its turn, with its corners to so many pixels.
    fn expect(
        family: Family,
        centre: [f64; 2],
        most_px: f64,
        light: impl Fn([f64; 2], f64) -> f64,
    ) {
        let code = SquareCode::for_family(family).unwrap();
        for step in 0..8 {
            let turn = 0.1 + 0.8 * f64::from(step);
            let (image, corners) = picture(code, centre, turn, &light);
            let found = find(&image, code, Some(&[ID]));
            assert_eq!(found.len(), 1, "{family} {turn}");
            assert_eq!(found[0].reading.id, ID);
            for (corner, truth) in found[0].quad.corners.iter().zip(corners) {
                let off = corner.distance(&truth);
                assert!(off < most_px, "{family} turned by {turn}: {off} px off");
            }
        }
    }

    const FAMILIES: [Family; 3] =
        [Family::AprilTag16h5, Family::AprilTag36h11, Family::Aruco4x4_50];
    const MIDDLE: [f64; 2] = [160.3, 120.6];

    #[test]
    fn with_the_edge_of_a_shadow_across_it() {
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
    fn with_a_corner_covered() {
        for level in [20.0, 90.0, 230.0] {
            for family in FAMILIES {
                expect(family, MIDDLE, 1.5, |[u, v], grey| if u + v > 0.75 { level } else { grey });
            }
        }
    }

    #[test]
    fn with_a_reflection_on_it() {
        expect(Family::AprilTag36h11, MIDDLE, 3.0, |[u, v], grey| {
            let away = (u - 0.35).hypot(v + 0.2) / 0.15;
            grey + 350.0 * (-0.5 * away * away).exp()
        });
    }

    #[test]
    fn white_on_black() {
        for family in FAMILIES {
            expect(family, MIDDLE, 1.5, |_, grey| 235.0 - grey);
        }
    }

    #[test]
    fn cut_by_the_frame() {
        let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
        // A corner is beyond the left edge of the frame.
        let (image, corners) = picture(code, [46.0, 120.0], std::f64::consts::FRAC_PI_4, |_, g| g);
        let found = find(&image, code, None);
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].reading.id, ID);
        for (corner, truth) in found[0].quad.corners.iter().zip(corners) {
            assert!(corner.distance(&truth) < 1.5);
        }
    }

    #[test]
    fn a_dark_square_and_another_id_are_no_such_marker() {
        let code = SquareCode::for_family(Family::AprilTag16h5).unwrap();
        let (image, _) =
            picture(
                code,
                MIDDLE,
                0.3,
                |[u, v], grey| {
                    if u.abs().max(v.abs()) < 0.5 { 30.0 } else { grey }
                },
            );
        assert_eq!(find(&image, code, None), []);
        let (image, _) = picture(code, MIDDLE, 0.3, |_, grey| grey);
        assert_eq!(find(&image, code, Some(&[8, 9])), []);
        assert_eq!(find(&image, code, None).len(), 1);
    }

    #[test]
    fn any_image_is_survived() {
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
