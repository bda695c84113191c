//! Tests square markers drawn pixel by pixel: borders of two cells, tags seen from the side, calibration grids, scratched,
//! covered, sharpened and small ones, round tags next to other markers, boards of hundreds.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

use fiducial::{Detector, Observation, Settings};
use geometry::{CameraModel, Pixel};
use imaging::GrayImage;
use markers::SquareCode;
use markers::{Drawing, Family, Ink, Marker};

/// Black, white and the ground.
const GREYS: [f64; 3] = [30.0, 200.0, 120.0];

/// Whether a marker with a border of `border` cells is white at a place in cells from its top left corner.
fn is_white(code: &SquareCode, id: usize, border: usize, [x, y]: [f64; 2]) -> bool {
    let extra = border as f64 - 1.0;
    let cell = [x - extra, y - extra].map(|at| at.floor() as i8);
    let Some(bit) = code.bits.iter().position(|bit| *bit == cell) else { return false };
    code.codewords[id] >> (code.bits.len() - 1 - bit) & 1 == 1
}

/// An image of `size` pixels of the level at each point, each pixel the mean of a box of `blur` pixels.
fn picture(size: [usize; 2], blur: f64, grey: impl Fn([f64; 2]) -> f64) -> GrayImage {
    const PLACES: usize = 6;
    let mut image = GrayImage::filled(size[0], size[1], 0);
    for y in 0..size[1] {
        for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
            let within =
                |at: usize, k: usize| at as f64 + blur * ((k as f64 + 0.5) / PLACES as f64 - 0.5);
            let sum: f64 = (0..PLACES * PLACES)
                .map(|i| grey([within(x, i % PLACES), within(y, i / PLACES)]))
                .sum();
            *pixel = (sum / (PLACES * PLACES) as f64).round() as u8;
        }
    }
    image
}

fn find(image: &GrayImage, markers: &[&str]) -> Vec<Observation> {
    let markers: Vec<Marker> = markers.iter().map(|name| name.parse().unwrap()).collect();
    let mut detector = Detector::new(&markers, Settings::default()).unwrap();
    detector.detect(image.view().unwrap(), None, &mut ()).to_vec()
}

/// Places turned by `angle` about the middle of an image, in units of `unit` pixels.
fn turned([x, y]: [f64; 2], middle: [f64; 2], angle: f64, unit: f64) -> [f64; 2] {
    let (sin, cos) = angle.sin_cos();
    let (dx, dy) = ((x - middle[0]) / unit, (y - middle[1]) / unit);
    [dx * cos + dy * sin, dy * cos - dx * sin]
}

#[test]
fn a_border_of_two_cells_is_read_and_its_outer_corners_are_found() {
    let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
    let across = f64::from(code.cells) + 2.0;
    for (cell_px, angle) in [(2.2, 0.2), (4.0, 0.7), (6.0, 1.3)] {
        let middle = [80.2, 79.7];
        let image = picture([160, 160], 1.0, |at| {
            let [x, y] = turned(at, middle, angle, cell_px).map(|v| v + 0.5 * across);
            let within = |v: f64| (0.0..across).contains(&v);
            let around = |v: f64| (-2.0..0.0).contains(&v) || (across..across + 2.0).contains(&v);
            // The squares at the corners do not quite touch the marker.
            let squares = around(x + 0.2 * (x - 0.5 * across).signum()) && around(y);
            match (within(x) && within(y), squares) {
                (true, _) => GREYS[usize::from(is_white(code, 17, 2, [x, y]))],
                (_, true) => GREYS[0],
                _ => GREYS[1],
            }
        });
        let found = find(&image, &["apriltag-36h11"]);
        assert_eq!(found.len(), 1, "{cell_px} px");
        assert_eq!(found[0].id, Some(17));
        let (sin, cos) = f64::sin_cos(angle);
        let half = 0.5 * across * cell_px;
        for (corner, [a, b]) in found[0].corners.unwrap().iter().zip([
            [-1.0, -1.0],
            [1.0, -1.0],
            [1.0, 1.0],
            [-1.0, 1.0],
        ]) {
            let (u, v) = (half * a, half * b);
            let truth = [middle[0] + u * cos - v * sin, middle[1] + u * sin + v * cos];
            let off = (corner.x - truth[0]).hypot(corner.y - truth[1]);
            assert!(off < 0.15, "{cell_px} px: {off} px off");
        }
    }
}

/// A drawing that was resized shows black, white, and at edges that are not between pixels one grey pixel: too little for a fit of the
/// pixels, which the outline does not need. The side of a cell, and the place of the tag's top left corner, in pixels.
#[test]
fn a_drawing_without_noise_and_blur_has_a_pose_and_a_covariance_that_is_sane() {
    const DRAWN: [f64; 2] = [0.0, 255.0];
    let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
    let (focal_px, size_m) = (800.0, 0.15);
    let camera = CameraModel::pinhole(300, 300, focal_px);
    for (cell_px, corner) in [
        (26.95, [39.5, 39.5]),
        (26.95, [39.6, 39.5]),
        (20.1, [39.5, 39.5]),
        (20.1, [39.5, 39.75]),
        (15.05, [39.5, 39.75]),
        (12.5, [39.6, 39.5]),
    ] {
        let name = format!("{cell_px} px at {corner:?}");
        let image = picture([300, 300], 1.0, |at| {
            let cell = [0, 1].map(|axis| (at[axis] - corner[axis]) / cell_px);
            let is_within = cell.iter().all(|v| (0.0..8.0).contains(v));
            DRAWN[usize::from(!is_within || is_white(code, 3, 1, cell))]
        });
        let markers = [format!("apriltag-36h11:3:{size_m}").parse::<Marker>().unwrap()];
        let mut detector = Detector::new(&markers, Settings::default()).unwrap();
        let found = detector.detect(image.view().unwrap(), Some(&camera), &mut ()).to_vec();
        assert_eq!(found.len(), 1, "{name}");
        let far = corner.map(|at| at + 8.0 * cell_px);
        let truth = [corner, [far[0], corner[1]], far, [corner[0], far[1]]];
        for (seen, [x, y]) in found[0].corners.unwrap().iter().zip(truth) {
            assert!((seen.x - x).hypot(seen.y - y) < 0.15, "{name}: {seen:?}");
        }
        let variance_px2 = found[0].centre_covariance_px2.diagonal();
        assert!(variance_px2.iter().all(|v| (1e-3..0.05).contains(v)), "{name}: {variance_px2}");
        let pose = found[0].pose.unwrap();
        assert!(pose.reprojection_rms_px < 0.15, "{name}: {} px", pose.reprojection_rms_px);
        let range_m = focal_px * size_m / (8.0 * cell_px);
        let off_m = pose.camera_from_marker.origin().z() - range_m;
        let deviation_m = pose.covariance[(2, 2)].sqrt();
        assert!(off_m.abs() < 3.0 * deviation_m, "{name}: {off_m} m, {deviation_m} m stated");
    }
}

/// A drawing in whole pixels, as one that was resized without a filter: sides are up to half a pixel off, which no pixel shows. The side of a
/// cell in pixels, and the turn.
#[test]
fn a_drawing_in_whole_pixels_has_their_covariance() {
    let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
    let (focal_px, size_m) = (800.0, 0.15);
    let camera = CameraModel::pinhole(300, 300, focal_px);
    let markers = [format!("apriltag-36h11:3:{size_m}").parse::<Marker>().unwrap()];
    let mut detector = Detector::new(&markers, Settings::default()).unwrap();
    for (cell_px, angle) in [9.03, 12.45, 17.12, 20.11, 22.46].into_iter().flat_map(|cell_px| {
        [(cell_px, 0.0), (cell_px, 0.3), (cell_px, 0.25 * std::f64::consts::PI)]
    }) {
        let name = format!("{cell_px} px, {angle} rad");
        let middle = [149.7, 150.2];
        let image = picture([300, 300], 0.0, |at| {
            let cell = turned(at, middle, angle, cell_px).map(|v| v + 4.0);
            let is_within = cell.iter().all(|v| (0.0..8.0).contains(v));
            [0.0, 255.0][usize::from(!is_within || is_white(code, 3, 1, cell))]
        });
        let found = detector.detect(image.view().unwrap(), Some(&camera), &mut ()).to_vec();
        assert_eq!(found.len(), 1, "{name}");
        let off_px = (found[0].centre.x - middle[0]).hypot(found[0].centre.y - middle[1]);
        let variance_px2 = found[0].centre_covariance_px2.trace();
        assert!(off_px < 0.4 && off_px * off_px < 4.0 * variance_px2, "{name}: {off_px} px");
        assert!(variance_px2 < 0.15, "{name}: {variance_px2}");
        let pose = found[0].pose.unwrap();
        let off_m = pose.camera_from_marker.origin().z() - focal_px * size_m / (8.0 * cell_px);
        let variance_m2 = pose.covariance[(2, 2)];
        assert!(off_m * off_m < 9.0 * variance_m2, "{name}: {off_m} m, {variance_m2} m2 stated");
    }
}

/// Views of a tag from the side, next to another one in full view, by the pixels of its longer side and the ratio of the
/// shorter one: squeezed along a side and, after a turn of 45 degrees, along a diagonal. AprilTag 3 without decimation reads
/// such tags down to 0.15.
#[test]
fn tags_that_are_seen_from_the_side_are_read_next_to_another_one() {
    let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
    let (middle, other) = ([310.3, 300.7], [60.2, 560.8]);
    for (side_px, ratios) in
        [(80.0, [0.27, 0.22, 0.18]), (160.0, [0.24, 0.18, 0.15]), (300.0, [0.24, 0.18, 0.15])]
    {
        for (ratio, turn) in ratios.into_iter().flat_map(|ratio| [(ratio, 0.0), (ratio, 0.785)]) {
            for angle in [0.1, 0.35, 0.8, 1.25] {
                let name = format!("{side_px} px, {ratio}, turned by {turn}, {angle}");
                // From pixels to cells of the tag, and back.
                let cells = |at: [f64; 2]| {
                    let [u, v] = turned(at, middle, angle, side_px / 8.0);
                    turned([u, v / ratio], [0.0; 2], turn, 1.0).map(|cell| cell + 4.0)
                };
                let pixel = |cell: [f64; 2]| {
                    let [u, v] = turned(cell, [4.0; 2], -turn, 1.0);
                    let [x, y] = turned([u, v * ratio], [0.0; 2], -angle, 8.0 / side_px);
                    Pixel::new(middle[0] + x, middle[1] + y)
                };
                let image = picture([620, 620], 1.3, |at| {
                    let [x, y] = cells(at);
                    let [u, v] = turned(at, other, 0.2, 4.0).map(|cell| cell + 4.0);
                    let on = |[x, y]: [f64; 2], margin: f64| {
                        let within = |v: f64| (-margin..8.0 + margin).contains(&v);
                        within(x) && within(y)
                    };
                    if on([u, v], 0.0) {
                        GREYS[usize::from(is_white(code, 3, 1, [u, v]))]
                    } else if on([x, y], 0.0) {
                        GREYS[usize::from(is_white(code, 7, 1, [x, y]))]
                    } else {
                        GREYS[if on([x, y], 1.0) || on([u, v], 1.0) { 1 } else { 2 }]
                    }
                });
                let mut found = find(&image, &["apriltag-36h11"]);
                found.sort_by_key(|seen| seen.id);
                let ids: Vec<_> = found.iter().map(|seen| seen.id).collect();
                assert_eq!(ids, [Some(3), Some(7)], "{name}");
                let truth = [[0.0, 0.0], [8.0, 0.0], [8.0, 8.0], [0.0, 8.0]].map(pixel);
                let corners = found[1].corners.unwrap().into_iter().zip(truth);
                let worst =
                    corners.map(|(corner, truth)| corner.distance(&truth)).fold(0.0, f64::max);
                assert!(worst < 1.0, "{name}: {worst} px off");
            }
        }
    }
}

/// A grid of three by three tags whose gaps are three cells wide and have a black square at each of their crossings. The squares overlap
/// the corners of all tags but the first, whose outline alone is closed; a lens bends the grid.
#[test]
fn the_tags_of_a_calibration_grid_are_read_next_to_the_one_with_an_outline() {
    const STEP: f64 = 13.0;
    let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
    for (cell_px, angle, bend) in [(3.0, 0.1, 0.0), (4.5, 0.5, 0.04), (6.0, -0.3, -0.02)] {
        let middle = [160.4, 159.8];
        // From pixels to cells of the grid, from the middle.
        let cells = |at: [f64; 2]| {
            let [u, v] = turned(at, middle, angle, cell_px);
            let bent = 1.0 + bend * (u * u + v * v) / (1.5 * STEP).powi(2);
            [u * bent, v * bent]
        };
        let image = picture([320, 320], 1.2, |at| {
            let [x, y] = cells(at).map(|v| v + 1.5 * STEP - 1.5);
            // The tag's number, and the place in it.
            let [column, row] = [x, y].map(|v| v.div_euclid(STEP));
            let [u, v] = [x.rem_euclid(STEP), y.rem_euclid(STEP)];
            let is_tag = |v: f64| (0.0..3.0).contains(&v);
            if u < 10.0 && v < 10.0 && is_tag(column) && is_tag(row) {
                return GREYS
                    [usize::from(is_white(code, (3.0 * row + column) as usize, 2, [u, v]))];
            }
            // Around the first tag the squares are smaller.
            let is_first = x < STEP - 1.0 && y < STEP - 1.0;
            let gap = |v: f64| v > if is_first { 10.6 } else { 9.6 } && (is_first || v < 13.4);
            let by_corner = |v: f64| gap(v) || (v < 0.4 && !is_first);
            let on_grid = |v: f64| (-3.0..3.0 * STEP).contains(&v);
            let is_square = by_corner(u) && by_corner(v) && on_grid(x) && on_grid(y);
            GREYS[if is_square { 0 } else { 1 }]
        });
        let mut ids: Vec<_> =
            find(&image, &["apriltag-36h11"]).iter().filter_map(|seen| seen.id).collect();
        ids.sort_unstable();
        assert_eq!(ids, (0..9).collect::<Vec<_>>(), "{cell_px} px, bent by {bend}");
    }
}

#[test]
fn a_scratched_border_does_not_hide_a_marker_of_eighty_pixels() {
    let code = SquareCode::for_family(Family::Aruco6x6_250).unwrap();
    let middle = [80.4, 80.1];
    for step in 0..6 {
        let angle = 0.1 + 0.25 * f64::from(step);
        let image = picture([160, 160], 1.0, |at| {
            let [u, v] = turned(at, middle, angle, 76.0);
            let [x, y] = [u, v].map(|v| (v + 0.5) * 8.0);
            if !(0.0..8.0).contains(&x) || !(0.0..8.0).contains(&y) {
                return if u.abs().max(v.abs()) < 0.58 { GREYS[1] } else { GREYS[2] };
            }
            // A bare patch in the border, as wide as that but for a line of a pixel and a half.
            let is_bare = (2.6..4.0).contains(&x) && (0.17..1.0).contains(&y);
            GREYS[usize::from(is_bare || is_white(code, 18, 1, [x, y]))]
        });
        let found = find(&image, &["aruco-6x6-250"]);
        assert_eq!(found.iter().map(|marker| marker.id).collect::<Vec<_>>(), [Some(18)], "{angle}");
    }
}

#[test]
fn a_tag_of_twelve_pixels_that_a_camera_sharpened_is_read() {
    let code = SquareCode::for_family(Family::AprilTag36h11).unwrap();
    let mut found_all = 0;
    for id in 0..20 {
        let middle = [30.3, 29.8];
        let angle = 0.06 * id as f64;
        let soft = picture([60, 60], 1.5, |at| {
            let [u, v] = turned(at, middle, angle, 12.5);
            if u.abs().max(v.abs()) < 0.5 {
                let cell = [u, v].map(|v| (v + 0.5) * 8.0);
                GREYS[usize::from(is_white(code, id, 1, cell))]
            } else {
                GREYS[1]
            }
        });
        let mut image = GrayImage::filled(60, 60, 0);
        for y in 0..60_usize {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let view = soft.view().unwrap();
                let at = |dx: usize, dy: usize| {
                    f64::from(view.at((x + dx).clamp(1, 60) - 1, (y + dy).clamp(1, 60) - 1))
                };
                let around = (at(0, 1) + at(2, 1) + at(1, 0) + at(1, 2)) / 4.0;
                *pixel = (at(1, 1) + 1.2 * (at(1, 1) - around)).clamp(0.0, 255.0) as u8;
            }
        }
        let found = find(&image, &["apriltag-36h11"]);
        assert!(found.iter().all(|marker| marker.id == Some(id as u32)));
        found_all += found.len();
    }
    assert!(found_all >= 18, "{found_all} of 20");
}

/// Markers of 60 pixels, side by side on paper, the last one with a corner under something white.
fn board(markers: usize, inverted: bool) -> GrayImage {
    let code = SquareCode::for_family(Family::Aruco4x4_50).unwrap();
    picture([40 + 90 * markers, 130], 1.0, |[x, y]| {
        let marker = ((x - 20.0) / 90.0).floor().clamp(0.0, markers as f64 - 1.0);
        let place = [x - 35.0 - 90.0 * marker, y - 35.0].map(|v| v / 10.0);
        let last = marker as usize + 1 == markers;
        if markers > 1 && last && place[0] + place[1] > 9.9 && place[0].max(place[1]) < 6.5 {
            return GREYS[1];
        }
        let within = place.iter().all(|v| (0.0..6.0).contains(v));
        let white = !within || is_white(code, 5 + marker as usize, 1, place);
        GREYS[usize::from(white != inverted)]
    })
}

fn ids(image: &GrayImage, markers: &[&str], settings: Settings) -> Vec<u32> {
    let markers: Vec<Marker> = markers.iter().map(|name| name.parse().unwrap()).collect();
    let mut detector = Detector::new(&markers, settings).unwrap();
    let found = detector.detect(image.view().unwrap(), None, &mut ());
    let mut ids: Vec<u32> = found.iter().filter_map(|seen| seen.id).collect();
    ids.sort_unstable();
    ids
}

#[test]
fn a_covered_marker_is_found_next_to_others_on_boards_and_on_request() {
    let (quick, thorough) =
        (Settings::default(), Settings { thorough: true, ..Settings::default() });
    let any = ["aruco-4x4-50"];
    assert_eq!(ids(&board(3, false), &any, quick), [5, 6, 7]);
    assert_eq!(ids(&board(2, false), &any, quick), [5]);
    assert_eq!(ids(&board(2, false), &any, thorough), [5, 6]);
    let both = ["aruco-4x4-50:5", "aruco-4x4-50:6"];
    assert_eq!(ids(&board(2, false), &both, quick), [5]);
    assert_eq!(ids(&board(2, false), &both, thorough), [5, 6]);
}

#[test]
fn markers_in_the_other_colours_can_be_left_out() {
    let dark_only = Settings { inverted: false, ..Settings::default() };
    let any = ["aruco-4x4-50"];
    assert_eq!(ids(&board(1, true), &any, Settings::default()), [5]);
    assert_eq!(ids(&board(1, true), &any, dark_only), []);
    assert_eq!(ids(&board(1, false), &any, dark_only), [5]);
}

#[test]
fn a_small_marker_next_to_a_large_one_is_found_by_a_thorough_search() {
    let marker = "rings:1".parse().unwrap();
    let drawing = Drawing::new(&marker, 1.0).unwrap();
    let places = [([150.3, 130.7], 200.0), ([310.6, 80.2], 40.0)];
    let image = picture([360, 260], 1.0, |[x, y]| {
        let on = |(middle, size): ([f64; 2], f64)| {
            let [u, v] = [(x - middle[0]) / size, (middle[1] - y) / size];
            let ink = drawing.ink_at(u, v);
            (u.abs().max(v.abs()) < drawing.half_extent_m)
                .then_some(GREYS[usize::from(ink == Ink::White)])
        };
        places.into_iter().find_map(on).unwrap_or(GREYS[2])
    });
    let count = |settings: Settings| {
        let mut detector = Detector::new(&[marker], settings).unwrap();
        detector.detect(image.view().unwrap(), None, &mut ()).len()
    };
    assert_eq!(count(Settings::default()), 1);
    assert_eq!(count(Settings { thorough: true, ..Settings::default() }), 2);
}

#[test]
fn every_marker_of_a_board_of_hundreds_is_found() {
    const ALONG: usize = 20;
    const PITCH: f64 = 48.0;
    let code = SquareCode::for_family(Family::Aruco6x6_1000).unwrap();
    let side = 16 + ALONG * PITCH as usize;
    let image = picture([side, side], 1.0, |place| {
        let [column, row] = place.map(|at| ((at - 8.0) / PITCH).floor());
        let inside = |index: f64| (0.0..ALONG as f64).contains(&index);
        let cells = [place[0] - 8.0 - PITCH * column, place[1] - 8.0 - PITCH * row];
        let cells = cells.map(|along| (along - 8.0) / 4.0);
        let is_marker = inside(column) && inside(row);
        let within = is_marker && cells.iter().all(|along| (0.0..8.0).contains(along));
        let id = if within { row as usize * ALONG + column as usize } else { 0 };
        GREYS[usize::from(!within || is_white(code, id, 1, cells))]
    });
    let all: Vec<u32> = (0..(ALONG * ALONG) as u32).collect();
    assert_eq!(ids(&image, &["aruco-6x6-1000"], Settings::default()), all);
    let with_others = ["aruco-4x4-50", "aruco-6x6-1000", "apriltag-16h5"];
    assert_eq!(ids(&image, &with_others, Settings::default()), all);
}

/// One family of each layout and dictionary of the square markers, a STag and the rings.
const FAMILIES: [Family; 18] = [
    Family::AprilTag16h5,
    Family::AprilTag25h9,
    Family::AprilTag36h10,
    Family::AprilTag36h11,
    Family::AprilTagCircle21h7,
    Family::AprilTagCircle49h12,
    Family::AprilTagCustom48h12,
    Family::AprilTagStandard41h12,
    Family::AprilTagStandard52h13,
    Family::Aruco4x4_50,
    Family::Aruco5x5_50,
    Family::Aruco6x6_50,
    Family::Aruco7x7_50,
    Family::ArucoOriginal,
    Family::ArucoMip36h12,
    Family::StagHd11,
    Family::StagHd21,
    Family::Rings,
];
const ROUND: [Family; 2] = [Family::AprilTagCircle21h7, Family::AprilTagCircle49h12];

/// A marker on white paper of its width and a little more; its square, or its largest ring, is `size_px` wide.
fn sheet(family: Family, id: u32, size_px: f64) -> GrayImage {
    let id = family.id_count().map(|_| id);
    let drawing = Drawing::new(&Marker { family, id, size_m: None }, size_px).unwrap();
    let side = (2.0 * drawing.half_extent_m) as usize + 30;
    let middle = side as f64 / 2.0 - 0.2;
    let mut image = GrayImage::filled(side, side, 0);
    // A fourth of the places of `picture`, as these are large.
    const ALONG: usize = 3;
    for y in 0..side {
        for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
            let within =
                |at: usize, k: usize| at as f64 + (k as f64 + 0.5) / ALONG as f64 - 0.5 - middle;
            let grey = |i: usize| {
                let (right, up) = (within(x, i % ALONG), -within(y, i / ALONG));
                let is_paper = right.abs().max(up.abs()) > drawing.half_extent_m;
                GREYS[usize::from(is_paper || drawing.ink_at(right, up) == Ink::White)]
            };
            let sum: f64 = (0..ALONG * ALONG).map(grey).sum();
            *pixel = (sum / (ALONG * ALONG) as f64).round() as u8;
        }
    }
    image
}

/// Sheets side by side in rows of `columns`, in places as large as the largest sheet.
fn side_by_side(sheets: &[&GrayImage], columns: usize) -> GrayImage {
    let place = sheets.iter().map(|sheet| sheet.width()).max().unwrap();
    let rows = sheets.len().div_ceil(columns);
    let mut image = GrayImage::filled(columns * place, rows * place, GREYS[1] as u8);
    for (index, sheet) in sheets.iter().enumerate() {
        let (left, top) = (index % columns * place, index / columns * place);
        for y in 0..sheet.height() {
            let row = sheet.view().unwrap().row(y).to_vec();
            image.row_mut(top + y)[left..left + sheet.width()].copy_from_slice(&row);
        }
    }
    image
}

/// The families and ids of the markers that are found, in order.
fn names(found: &[Observation]) -> Vec<(Family, Option<u32>)> {
    let mut names: Vec<_> = found.iter().map(|marker| (marker.family, marker.id)).collect();
    names.sort_unstable_by_key(|(family, id)| (*family as usize, *id));
    names
}

#[test]
fn a_round_tag_is_found_beside_a_marker_of_any_family() {
    const ID: u32 = 5;
    for size_px in [20.0, 60.0, 110.0, 200.0] {
        let sheets = FAMILIES.map(|family| sheet(family, ID, size_px));
        for (round, other) in ROUND.into_iter().flat_map(|round| FAMILIES.map(|it| (round, it))) {
            if round == other {
                continue;
            }
            let at = |family| FAMILIES.iter().position(|it| *it == family).unwrap();
            let image = side_by_side(&[&sheets[at(round)], &sheets[at(other)]], 2);
            let id = |family: Family| family.id_count().map(|_| ID);
            let mut expected = [(round, id(round)), (other, id(other))];
            expected.sort_unstable_by_key(|(family, id)| (*family as usize, *id));
            let markers = [round, other].map(Family::name);
            assert_eq!(names(&find(&image, &markers)), expected, "{size_px} px");
        }
    }
}

#[test]
fn a_round_tag_is_found_alone_where_another_family_is_listed() {
    for (family, size_px) in
        ROUND.into_iter().flat_map(|it| [16.0, 20.0, 30.0, 60.0, 200.0].map(|size| (it, size)))
    {
        let image = sheet(family, 8, size_px);
        let found = find(&image, &[family.name(), "apriltag-36h11"]);
        assert_eq!(names(&found), [(family, Some(8))], "{size_px} px");
        assert!(found[0].confidence > 0.7, "{size_px} px: {}", found[0].confidence);
    }
}

#[test]
fn a_small_marker_does_not_hide_the_round_tag_of_its_pad() {
    for round in ROUND {
        let image =
            side_by_side(&[&sheet(round, 5, 220.0), &sheet(Family::AprilTag36h11, 5, 88.0)], 2);
        let listed = [format!("{}:5", round.name()), "apriltag-36h11:5".to_owned()];
        let found = find(&image, &listed.each_ref().map(String::as_str));
        let expected = [(Family::AprilTag36h11, Some(5)), (round, Some(5))];
        assert_eq!(names(&found), expected);
    }
}

#[test]
fn round_tags_are_found_among_sixteen_markers() {
    let families = [
        Family::AprilTagStandard41h12,
        Family::AprilTag36h11,
        Family::ArucoMip36h12,
        Family::StagHd21,
        Family::Aruco7x7_1000,
        Family::AprilTagCircle21h7,
        Family::ArucoOriginal,
        Family::AprilTagCircle49h12,
    ];
    let sheets: Vec<GrayImage> =
        (0..16).map(|index| sheet(families[index % 8], index as u32, 88.0)).collect();
    let image = side_by_side(&sheets.iter().collect::<Vec<_>>(), 4);
    for family in ROUND {
        let first = families.iter().position(|it| *it == family).unwrap() as u32;
        let expected = [(family, Some(first)), (family, Some(first + 8))];
        assert_eq!(names(&find(&image, &[family.name()])), expected);
    }
    assert_eq!(find(&image, &families.map(Family::name)).len(), 16);
}

/// The bits that this tag has in common with a round one are a codeword of that.
#[test]
fn a_tag_that_contains_a_round_tag_is_one_marker() {
    let (family, id) = (Family::AprilTagStandard41h12, 704);
    let image = sheet(family, id, 80.0);
    for listed in [[family, ROUND[0]], [ROUND[0], family]] {
        assert_eq!(names(&find(&image, &listed.map(Family::name))), [(family, Some(id))]);
    }
}

/// The same with the round tag alone listed: each of these contains one, some with a wrong bit.
#[test]
fn a_part_of_a_larger_tag_is_not_a_round_tag() {
    for (family, id) in [
        (Family::AprilTagStandard41h12, 704),
        (Family::AprilTagStandard41h12, 542),
        (Family::AprilTagCircle49h12, 19158),
        (Family::AprilTagCircle49h12, 28117),
    ] {
        for size_px in [16.0, 24.0, 40.0, 80.0, 200.0] {
            let image = sheet(family, id, size_px);
            assert_eq!(
                names(&find(&image, &[family.name()])),
                [(family, Some(id))],
                "{size_px} px"
            );
            let listed = [ROUND[0].name()];
            assert_eq!(names(&find(&image, &listed)), [], "{family}:{id}, {size_px} px");
        }
    }
}

#[test]
fn every_round_tag_is_found_on_any_ground() {
    let family = Family::AprilTagCircle21h7;
    for (id, ground) in (0..38).flat_map(|id| [20, 250].map(|ground| (id, ground))) {
        let mut image = sheet(family, id, 40.0);
        let middle = image.width() as f64 / 2.0;
        for y in 0..image.height() {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let [right, down] = [x, y].map(|at| at as f64 - middle);
                if right.hypot(down) > f64::hypot(0.7, 0.7) * 40.0 + 2.0 {
                    *pixel = ground;
                }
            }
        }
        let found = find(&image, &[family.name()]);
        assert_eq!(names(&found), [(family, Some(id))], "ground of {ground}");
    }
}

#[test]
fn a_round_tag_may_be_cut_out_along_its_outline() {
    let size_px = 80.0;
    let other = sheet(Family::AprilTag36h11, 5, size_px);
    // The distance of the farthest corner from the middle, in sides of the square.
    for (family, radius) in [
        (Family::AprilTagCircle21h7, f64::hypot(0.7, 0.7)),
        (Family::AprilTagCircle49h12, f64::hypot(1.1, 0.3)),
    ] {
        for ground in [20, 90, 250] {
            let mut round = sheet(family, 5, size_px);
            let middle = round.width() as f64 / 2.0;
            for y in 0..round.height() {
                for (x, pixel) in round.row_mut(y).iter_mut().enumerate() {
                    let [right, down] = [x, y].map(|at| at as f64 - middle);
                    if right.hypot(down) > radius * size_px + 2.0 {
                        *pixel = ground;
                    }
                }
            }
            let image = side_by_side(&[&round, &other], 2);
            let found = find(&image, &[family.name(), "apriltag-36h11"]);
            let expected = [(Family::AprilTag36h11, Some(5)), (family, Some(5))];
            assert_eq!(names(&found), expected, "ground of {ground}");
        }
    }
}
