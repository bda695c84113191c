//! Writes the sheet as PDF: vectors in units of 1/72 inch.

use markers::Ink;
use pdf_writer::{Content, Name, Pdf, Rect, Ref, Str};

use super::sheet::{Mark, Sheet, TEXT_MM};

/// Units of a PDF in a millimetre.
const PER_MM: f64 = 72.0 / 25.4;
/// Distance of the control points of a quarter circle's Bezier curve along the tangent, in radii; the error
/// is below 0.03 %.
const QUARTER_CIRCLE: f64 = 0.552_284_749_830_793_4;

const FONT: Name<'static> = Name(b"F1");

/// The bytes of the PDF file.
pub(super) fn document(sheet: &Sheet) -> Vec<u8> {
    let [catalog, pages, page, font, content] = [1, 2, 3, 4, 5].map(Ref::new);
    let mut pdf = Pdf::new();
    let mut root = pdf.catalog(catalog);
    root.pages(pages);
    // Viewers then suggest printing without "fit to page".
    root.viewer_preferences().pair(Name(b"PrintScaling"), Name(b"None"));
    drop(root);
    pdf.pages(pages).kids([page]).count(1);
    let [width, height] = sheet.size_mm.map(units);
    let mut leaf = pdf.page(page);
    leaf.media_box(Rect::new(0.0, 0.0, width, height)).parent(pages).contents(content);
    leaf.resources().fonts().pair(FONT, font);
    drop(leaf);
    // A standard font of every viewer.
    pdf.type1_font(font).base_font(Name(b"Helvetica"));
    pdf.stream(content, &drawn(sheet));
    pdf.finish()
}

fn units(mm: f64) -> f32 {
    (mm * PER_MM) as f32
}

fn drawn(sheet: &Sheet) -> Vec<u8> {
    let mut content = Content::new();
    // The origin of a PDF page is its bottom left corner.
    let flip = |[x, y]: [f64; 2]| [x, sheet.size_mm[1] - y];
    // Consecutive shapes of one ink are filled together, as viewers leave hairlines between touching shapes.
    for marks in sheet.marks.chunk_by(|a, b| a.ink() == b.ink() && a.ink().is_some()) {
        set_ink(&mut content, marks[0].ink().unwrap_or(Ink::Black));
        for mark in marks {
            match mark {
                Mark::Disc { centre_mm, radius_mm, .. } => {
                    circle(&mut content, flip(*centre_mm), *radius_mm);
                }
                Mark::Rectangle { min_mm, max_mm, .. } => {
                    let [left, bottom] = flip([min_mm[0], max_mm[1]]);
                    let size = [max_mm[0] - min_mm[0], max_mm[1] - min_mm[1]].map(units);
                    content.rect(units(left), units(bottom), size[0], size[1]);
                }
                Mark::Text { at_mm, text } => {
                    let [x, y] = flip(*at_mm).map(units);
                    content.begin_text().set_font(FONT, units(TEXT_MM)).next_line(x, y);
                    content.show(Str(text.as_bytes())).end_text();
                }
            }
        }
        if marks[0].ink().is_some() {
            content.fill_nonzero();
        }
    }
    content.finish().into_vec()
}

fn set_ink(content: &mut Content, ink: Ink) {
    content.set_fill_gray(match ink {
        Ink::Black => 0.0,
        Ink::White => 1.0,
    });
}

fn circle(content: &mut Content, [x, y]: [f64; 2], radius: f64) {
    let k = QUARTER_CIRCLE;
    let at = |dx: f64, dy: f64| [x + dx * radius, y + dy * radius].map(units);
    let [start_x, start_y] = at(1.0, 0.0);
    content.move_to(start_x, start_y);
    for (cos, sin) in [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)] {
        let [x1, y1] = at(cos - k * sin, sin + k * cos);
        let [x2, y2] = at(-sin + k * cos, cos + k * sin);
        let [x3, y3] = at(-sin, cos);
        content.cubic_to(x1, y1, x2, y2, x3, y3);
    }
    content.close_path();
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::marker::sheet::Paper;

    fn text_of(size_m: f64, paper: Paper) -> String {
        let sheet = Sheet::new(&"rings".parse().unwrap(), size_m, paper).unwrap();
        String::from_utf8_lossy(&document(&sheet)).into_owned()
    }

    /// The operands of each use of an operator.
    fn operands(pdf: &str, operator: &str) -> Vec<Vec<f64>> {
        let operator = format!(" {operator}");
        let lines = pdf.lines().filter_map(|line| line.strip_suffix(&operator));
        lines.map(|line| line.split(' ').map(|n| n.parse().unwrap()).collect()).collect()
    }

    #[test]
    fn the_page_is_the_paper() {
        let pdf = text_of(0.15341, Paper::A4);
        let media_box = pdf.split("/MediaBox [").nth(1).unwrap().split(']').next().unwrap();
        let numbers: Vec<f64> = media_box.split(' ').map(|n| n.parse().unwrap()).collect();
        assert!((numbers[2] / 72.0 * 25.4 - 210.0).abs() < 1e-3, "{numbers:?}");
        assert!((numbers[3] / 72.0 * 25.4 - 297.0).abs() < 1e-3, "{numbers:?}");
        assert!(pdf.contains("/PrintScaling /None"));
    }

    #[test]
    fn the_rings_have_their_size() {
        let pdf = text_of(0.15341, Paper::A4);
        let curves = operands(&pdf, "c");
        assert_eq!(curves.len(), 4 * 6);
        // The ends of the outermost circle's curves: top, left, bottom, right.
        let ends: Vec<[f64; 2]> =
            curves[..4].iter().map(|c| [c[4], c[5]].map(|n| n / PER_MM)).collect();
        assert!((ends[3][0] - ends[1][0] - 153.41).abs() < 1e-3, "{ends:?}");
        assert!((ends[0][1] - ends[2][1] - 153.41).abs() < 1e-3, "{ends:?}");
        assert!(((ends[3][0] + ends[1][0]) / 2.0 - 105.0).abs() < 1e-3, "{ends:?}");
        assert!(((ends[0][1] + ends[2][1]) / 2.0 - 148.5).abs() < 1e-3, "{ends:?}");
    }

    #[test]
    fn the_curves_stay_on_the_circle() {
        let mut content = Content::new();
        circle(&mut content, [0.0, 0.0], 1.0);
        let text = content.finish().into_vec();
        for curve in operands(&String::from_utf8(text).unwrap(), "c") {
            let [x1, y1, x2, y2, x3, y3] = curve[..] else { panic!("{curve:?}") };
            // Each begins where the one before ended: a quarter turn to the right of its own end.
            let (x0, y0) = (y3, -x3);
            for i in 0..=20 {
                let t = f64::from(i) / 20.0;
                let u = 1.0 - t;
                let mix = |a: f64, b: f64, c: f64, d: f64| {
                    u * u * u * a + 3.0 * u * u * t * b + 3.0 * u * t * t * c + t * t * t * d
                };
                let radius = mix(x0, x1, x2, x3).hypot(mix(y0, y1, y2, y3)) / PER_MM;
                assert!((radius - 1.0).abs() < 3e-4, "{radius}");
            }
        }
    }
}
