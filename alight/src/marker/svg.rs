//! The sheet as SVG: one user unit is one millimetre.

use fiducial::Ink;
use svg::Document;
use svg::node::element::{Circle, Rectangle, Text};

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
    sheet
        .marks
        .iter()
        .fold(document, |document, mark| match mark {
            Mark::Disc { centre_mm: [x, y], radius_mm, ink } => document.add(
                Circle::new()
                    .set("cx", rounded(*x))
                    .set("cy", rounded(*y))
                    .set("r", rounded(*radius_mm))
                    .set("fill", colour(*ink)),
            ),
            Mark::Rectangle { min_mm: [left, top], max_mm: [right, bottom], ink } => document.add(
                Rectangle::new()
                    .set("x", rounded(*left))
                    .set("y", rounded(*top))
                    .set("width", rounded(right - left))
                    .set("height", rounded(bottom - top))
                    .set("fill", colour(*ink)),
            ),
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

/// To a tenth of a micrometre, which no printer can tell apart.
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
