//! Compares the drawings with the pictures of the reference libraries, cell by cell, for every id.
//!
//! `reference_drawings.txt` has a checksum for each family, written by `reference_drawings.py` from the libraries.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test may stop anywhere")]

use markers::{Drawing, Family, Ink, Marker, Shape, SquareCode};

/// The marker's cells with their margin, row by row, 255 for white.
fn cells(drawing: &Drawing, code: &SquareCode, out: &mut Vec<u8>) {
    let side = u32::from(code.cells) + 2 * u32::from(code.margin());
    let cell_m = 1.0 / f64::from(code.cells);
    let place = |k: u32| (f64::from(k) + 0.5 - f64::from(side) / 2.0) * cell_m;
    out.clear();
    out.extend((0..side * side).map(|i| {
        let ink = drawing.ink_at(place(i % side), -place(i / side));
        if ink == Ink::White { 255 } else { 0 }
    }));
}

fn drawing(family: Family, id: u32) -> Drawing {
    Drawing::new(&Marker { family, id: Some(id), size_m: None }, 1.0).unwrap()
}

#[test]
fn every_square_marker_is_drawn_as_by_its_reference() {
    let reference: std::collections::HashMap<&str, &str> = include_str!("reference_drawings.txt")
        .lines()
        .filter_map(|line| line.split_once(' '))
        .collect();
    let mut picture = Vec::new();
    let mut count = 0;
    for code in Family::ALL.into_iter().filter_map(SquareCode::for_family) {
        let mut crc = crc32fast::Hasher::new();
        for id in 0..code.family.id_count().unwrap() {
            cells(&drawing(code.family, id), code, &mut picture);
            crc.update(&picture);
        }
        let checksum = format!("{:08x}", crc.finalize());
        assert_eq!(reference.get(code.family.name()), Some(&checksum.as_str()), "{}", code.family);
        count += 1;
    }
    assert_eq!(count, 27);
}

#[test]
fn a_square_marker_has_a_quiet_zone() {
    for code in Family::ALL.into_iter().filter_map(SquareCode::for_family) {
        let drawing = drawing(code.family, 0);
        let reach = drawing.layers.iter().fold(0.0f64, |reach, layer| match layer.shape {
            Shape::Rectangle { min_m, max_m } => {
                [min_m[0], min_m[1], max_m[0], max_m[1]].iter().fold(reach, |r, x| r.max(x.abs()))
            }
            Shape::Disc { .. } => panic!("{} has no discs", code.family),
        });
        let quiet = (drawing.half_extent_m - reach) * f64::from(code.cells);
        assert!(quiet > 0.999, "{}: {quiet} cells", code.family);
    }
}

#[test]
fn there_is_no_drawing_without_an_id() {
    for family in Family::ALL {
        let draw = |id| Drawing::new(&Marker { family, id, size_m: None }, 0.1).is_some();
        assert_eq!(draw(None), family.id_count().is_none());
        assert!(draw(Some(0)));
        assert!(family.id_count().is_none_or(|count| !draw(Some(count))));
    }
}
