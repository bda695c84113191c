//! The sheet as SVG: one user unit is one millimetre.

use markers::Ink;
use svg::Document;
use svg::node::element::path::Data;
use svg::node::element::{Circle, Path, Rectangle, Text};

use super::sheet::{Mark, Sheet, TEXT_MM};

/// The text of the SVG file.
pub(super) fn document(sheet: &Sheet) -> String {
    let [width, height] = sheet.size_mm;
    let paper = Rectangle::new().set("width", width).set("height", height).set("fill", "white");
    let document = Document::new()
        .set("width", format!("{width}mm"))
        .set("height", format!("{height}mm"))
        .set("viewBox", (0, 0, width, height))
        .add(paper);
    // Consecutive shapes of one ink are filled together, as viewers leave hairlines between touching shapes.
    let runs = sheet.marks.chunk_by(|a, b| match (a, b) {
        (Mark::Rectangle { ink: a, .. }, Mark::Rectangle { ink: b, .. }) => a == b,
        _ => false,
    });
    runs.fold(document, |document, marks| match &marks[0] {
        Mark::Disc { centre_mm: [x, y], radius_mm, ink } => document.add(
            Circle::new()
                .set("cx", rounded(*x))
                .set("cy", rounded(*y))
                .set("r", rounded(*radius_mm))
                .set("fill", colour(*ink)),
        ),
        Mark::Rectangle { ink, .. } => {
            document.add(Path::new().set("d", outline(marks)).set("fill", colour(*ink)))
        }
        Mark::Text { at_mm: [x, y], text } => document.add(
            Text::new(text.as_str())
                .set("x", rounded(*x))
                .set("y", rounded(*y))
                .set("font-family", "Helvetica, Arial, sans-serif")
                .set("font-size", TEXT_MM),
        ),
    })
    .to_string()
}

/// The rectangles' outlines.
fn outline(marks: &[Mark]) -> Data {
    marks.iter().fold(Data::new(), |data, mark| match mark {
        Mark::Rectangle { min_mm, max_mm, .. } => {
            let ([left, top], [right, bottom]) = (min_mm.map(rounded), max_mm.map(rounded));
            data.move_to((left, top))
                .horizontal_line_to(right)
                .vertical_line_to(bottom)
                .horizontal_line_to(left)
                .close()
        }
        Mark::Disc { .. } | Mark::Text { .. } => data,
    })
}

/// Rounded to 0.1 micrometres.
fn rounded(mm: f64) -> f64 {
    (mm * 1e4).round() / 1e4
}

fn colour(ink: Ink) -> &'static str {
    match ink {
        Ink::Black => "black",
        Ink::White => "white",
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::marker::sheet::Paper;
    use svg::parser::Event;

    #[test]
    fn cells_of_one_ink_are_one_outline() {
        let sheet = Sheet::new(&"apriltag-16h5:0".parse().unwrap(), 0.12, Paper::A4).unwrap();
        let text = document(&sheet);
        let paths: Vec<_> = svg::read(&text)
            .unwrap()
            .filter_map(|event| match event {
                Event::Tag("path", _, attributes) => {
                    Some((attributes["d"].to_string(), attributes["fill"].to_string()))
                }
                _ => None,
            })
            .collect();
        // The black square, the white cells on it, and the lines next to it.
        assert_eq!(paths.len(), 3);
        assert_eq!(paths[0], ("M45,88.5 H165 V208.5 H45 z".to_owned(), "black".to_owned()));
        assert_eq!(paths[1].1, "white");
    }

    #[test]
    fn the_rings_are_read_back_where_table_3_1_puts_them() {
        let sheet = Sheet::new(&"rings".parse().unwrap(), 0.15341, Paper::A4).unwrap();
        let text = document(&sheet);
        let mut radii = Vec::new();
        for event in svg::read(&text).unwrap() {
            let Event::Tag(name, _, attributes) = event else { continue };
            let number = |key: &str| attributes[key].parse::<f64>().unwrap();
            match name {
                "svg" if attributes.contains_key("viewBox") => {
                    assert_eq!((&*attributes["width"], &*attributes["height"]), ("210mm", "297mm"));
                    assert_eq!(&*attributes["viewBox"], "0 0 210 297");
                }
                "circle" => {
                    assert_eq!([number("cx"), number("cy")], [105.0, 148.5]);
                    radii.push((number("r") / 153.41 * 100.0, attributes["fill"].to_string()));
                }
                _ => {}
            }
        }
        let expected = [
            (50.0, "black"),
            (40.0, "white"),
            (25.0, "black"),
            (15.0, "white"),
            (3.0, "black"),
            (1.0, "white"),
        ];
        assert_eq!(radii.len(), expected.len());
        for ((radius, fill), (wanted, ink)) in radii.iter().zip(expected) {
            assert!((radius - wanted).abs() < 1e-3 && fill == ink, "{radius} {fill}");
        }
    }
}
