//! Writes the pages of a PDF file: texts, rules and charts on A4, in the standard fonts that every viewer has.

use std::convert::Infallible;

use anyhow::anyhow;
use pdf_writer::types::{LineCapStyle, LineJoinStyle};
use pdf_writer::{Content, Finish, Name, Pdf, Rect, Ref, Str, TextStr};
use plotters::prelude::{Color, DrawingBackend, IntoDrawingArea, RGBColor, ShapeStyle};
use plotters_backend::text_anchor::{HPos, VPos};
use plotters_backend::{
    BackendColor, BackendCoord, BackendStyle, BackendTextStyle, DrawingErrorKind, FontTransform,
};

use crate::chart::{Chart, Ink, SIZE_FACTOR, Shape, WIDTH};

/// Size of a page, in units of 1/72 inch.
pub const PAGE: [f64; 2] = [595.28, 841.89];
/// Width of a layer's sample in a legend.
pub const SAMPLE: f64 = 11.0;
/// Steps of opacity.
const ALPHAS: u8 = 20;
/// Distance of the control points of a quarter circle's Bezier curve along the tangent, in radii.
const QUARTER_CIRCLE: f64 = 0.552_285;
/// Ratio of the drawing library's text size to a font's size; for SVG it has 1.24, but charts are smaller here.
const FONT_FACTOR: f64 = 1.05;
/// Widths of the letters of Helvetica from the space on, in thousandths of its size (Adobe's font metrics).
const WIDTHS: [u16; 95] = [
    278, 278, 355, 556, 556, 889, 667, 191, 333, 333, 389, 584, 278, 333, 278, 278, 556, 556, 556,
    556, 556, 556, 556, 556, 556, 556, 278, 278, 584, 584, 584, 556, 1015, 667, 667, 722, 722, 667,
    611, 778, 722, 278, 500, 667, 556, 833, 722, 778, 667, 778, 722, 667, 611, 722, 667, 944, 667,
    667, 611, 278, 278, 278, 469, 556, 333, 556, 556, 500, 556, 556, 278, 556, 556, 222, 222, 500,
    222, 833, 556, 556, 556, 556, 333, 500, 278, 556, 500, 722, 500, 500, 500, 334, 260, 334, 584,
];
/// The same of a letter beyond ASCII, about.
const OTHER_WIDTH: u16 = 556;
/// Bold letters are wider than plain ones by this, at most but for a few.
const BOLD: f64 = 1.09;
/// Width of every letter of Courier, in thousandths of its size.
const FIXED_WIDTH: f64 = 600.0;

/// A font.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Font {
    /// Helvetica.
    Plain,
    /// Helvetica, bold.
    Bold,
    /// Courier.
    Fixed,
}

impl Font {
    const ALL: [Self; 3] = [Self::Plain, Self::Bold, Self::Fixed];

    fn name(self) -> Name<'static> {
        match self {
            Self::Plain => Name(b"F1"),
            Self::Bold => Name(b"F2"),
            Self::Fixed => Name(b"F3"),
        }
    }

    fn base(self) -> Name<'static> {
        match self {
            Self::Plain => Name(b"Helvetica"),
            Self::Bold => Name(b"Helvetica-Bold"),
            Self::Fixed => Name(b"Courier"),
        }
    }

    /// Width of a text in this font of a size, in the size's units.
    pub fn width(self, size: f64, text: &str) -> f64 {
        let of = |letter: char| {
            let index = (letter as usize).checked_sub(usize::from(b' '));
            index.and_then(|index| WIDTHS.get(index)).copied().unwrap_or(OTHER_WIDTH)
        };
        let thousandths = match self {
            Self::Fixed => FIXED_WIDTH * text.chars().count() as f64,
            Self::Plain => text.chars().map(|letter| f64::from(of(letter))).sum(),
            Self::Bold => BOLD * text.chars().map(|letter| f64::from(of(letter))).sum::<f64>(),
        };
        thousandths * size * 1e-3
    }
}

/// How a text is set.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Type {
    /// Its font.
    pub font: Font,
    /// Its size, in units of 1/72 inch.
    pub size: f64,
    /// Its colour: red, green, blue.
    pub rgb: [u8; 3],
}

/// The pages so far. Positions are from a page's left upper corner to the right and down, in units of 1/72 inch.
pub struct Pages {
    done: Vec<Vec<u8>>,
    content: Content,
}

impl Default for Pages {
    fn default() -> Self {
        Self { done: Vec::new(), content: Content::new() }
    }
}

impl Pages {
    /// Begins another page.
    pub fn turn(&mut self) {
        let full = std::mem::replace(&mut self.content, Content::new());
        self.done.push(full.finish().into_vec());
    }

    /// Number of the page that is being written, from 1 on.
    pub fn number(&self) -> usize {
        self.done.len() + 1
    }

    /// Writes a line of text, whose foot is at a position.
    pub fn text(&mut self, [left, foot]: [f64; 2], of: Type, text: &str) {
        let Type { font, size, rgb: [red, green, blue] } = of;
        let [red, green, blue] = [red, green, blue].map(|it| f32::from(it) / 255.0);
        self.content.begin_text().set_font(font.name(), size as f32);
        self.content.set_fill_rgb(red, green, blue);
        self.content.next_line(left as f32, (PAGE[1] - foot) as f32);
        self.content.show(Str(&encoded(text))).end_text();
    }

    /// Fills a rectangle.
    pub fn fill(&mut self, [left, top]: [f64; 2], [width, height]: [f64; 2], rgb: [u8; 3]) {
        let [red, green, blue] = rgb.map(|it| f32::from(it) / 255.0);
        self.content.set_fill_rgb(red, green, blue);
        let bottom = (PAGE[1] - top - height) as f32;
        self.content.rect(left as f32, bottom, width as f32, height as f32).fill_nonzero();
    }

    /// Draws a chart so wide; without title and legend.
    ///
    /// # Errors
    /// When it cannot be drawn.
    pub fn chart(
        &mut self,
        chart: &Chart,
        [left, top]: [f64; 2],
        width: f64,
    ) -> anyhow::Result<()> {
        let size = [WIDTH, chart.height].map(|pixels| pixels * SIZE_FACTOR);
        let scale = width / f64::from(WIDTH * SIZE_FACTOR);
        self.content.save_state();
        // The drawing counts downwards.
        let foot = PAGE[1] - top;
        self.content.transform([scale, 0.0, 0.0, -scale, left, foot].map(|it| it as f32));
        self.content.set_line_join(LineJoinStyle::RoundJoin).set_line_cap(LineCapStyle::RoundCap);
        let drawn = {
            let area = Drawing { content: &mut self.content, size }.into_drawing_area();
            chart.draw(&area, size)
        };
        self.content.restore_state();
        drawn.map_err(|error| anyhow!("{}: {error}", chart.title))
    }

    /// Draws how a layer is drawn, for a legend whose text's foot is at this position: [`SAMPLE`] wide.
    pub fn sample(&mut self, shape: Shape, ink: Ink, [left, foot]: [f64; 2]) {
        let [red, green, blue] = ink.channels();
        let colour = RGBColor(red, green, blue);
        self.content.save_state();
        // A tenth of a unit is one of the drawing, which counts downwards.
        let transform = [0.1, 0.0, 0.0, -0.1, left, PAGE[1] - foot];
        self.content.transform(transform.map(|it| it as f32));
        let right = (10.0 * SAMPLE) as i32;
        let (centre, middle) = (right / 2, -24);
        let mut drawing = Drawing { content: &mut self.content, size: [right.unsigned_abs(), 60] };
        let drawn = match shape {
            Shape::Area => drawing.draw_rect((0, -54), (right, 4), &colour.mix(0.3), true),
            Shape::Dots => drawing.draw_circle((centre, middle), 16, &colour, true),
            Shape::LargeDots => drawing.draw_circle((centre, middle), 26, &colour, true),
            Shape::Crosses => {
                let style = ShapeStyle::from(colour).stroke_width(9);
                let corner = |x: i32, y: i32| (centre + 22 * x, middle + 22 * y);
                drawing
                    .draw_line(corner(-1, -1), corner(1, 1), &style)
                    .and_then(|()| drawing.draw_line(corner(-1, 1), corner(1, -1), &style))
            }
            Shape::Line | Shape::Wide | Shape::Thin | Shape::Steps => {
                let width = match shape {
                    Shape::Thin => 8,
                    Shape::Wide => 30,
                    _ => 17,
                };
                let style = ShapeStyle::from(colour).stroke_width(width);
                drawing.draw_line((0, middle), (right, middle), &style)
            }
        };
        // Nothing can fail in memory.
        let _ = drawn;
        self.content.restore_state();
    }

    /// The file, with keywords in ASCII.
    pub fn finish(mut self, title: &str, keywords: &str) -> Vec<u8> {
        self.turn();
        let mut next = 0;
        let mut reference = || {
            next += 1;
            Ref::new(next)
        };
        let [catalog, tree, info] = [reference(), reference(), reference()];
        let fonts = Font::ALL.map(|font| (font, reference()));
        let alphas: Vec<(u8, Ref)> = (0..=ALPHAS).map(|step| (step, reference())).collect();
        let pages: Vec<(Ref, Ref, Vec<u8>)> =
            self.done.into_iter().map(|content| (reference(), reference(), content)).collect();
        let mut pdf = Pdf::new();
        pdf.catalog(catalog).pages(tree);
        pdf.document_info(info)
            .title(TextStr(title))
            .keywords(TextStr(keywords))
            .creator(TextStr("alight report"));
        let count = i32::try_from(pages.len()).unwrap_or(i32::MAX);
        pdf.pages(tree).kids(pages.iter().map(|(page, _, _)| *page)).count(count);
        for (font, reference) in fonts {
            let mut written = pdf.type1_font(reference);
            written.base_font(font.base()).encoding_predefined(Name(b"WinAnsiEncoding"));
        }
        for (step, reference) in &alphas {
            let alpha = f32::from(*step) / f32::from(ALPHAS);
            pdf.ext_graphics(*reference).stroking_alpha(alpha).non_stroking_alpha(alpha);
        }
        for (page, content, bytes) in pages {
            let mut written = pdf.page(page);
            let [width, height] = PAGE.map(|it| it as f32);
            written.media_box(Rect::new(0.0, 0.0, width, height)).parent(tree).contents(content);
            let mut resources = written.resources();
            let mut named = resources.fonts();
            for (font, reference) in fonts {
                named.pair(font.name(), reference);
            }
            named.finish();
            let mut named = resources.ext_g_states();
            for (step, reference) in &alphas {
                named.pair(Name(alpha_name(*step).as_bytes()), *reference);
            }
            named.finish();
            resources.finish();
            written.finish();
            pdf.stream(content, &bytes);
        }
        pdf.finish()
    }
}

fn alpha_name(step: u8) -> String {
    format!("A{step}")
}

/// A text in the encoding of the standard fonts; other letters become a question mark.
fn encoded(text: &str) -> Vec<u8> {
    let byte = |letter: char| match letter {
        '\u{2013}' => 0x96,
        '\u{2014}' => 0x97,
        '\u{2018}' => 0x91,
        '\u{2019}' => 0x92,
        '\u{201c}' => 0x93,
        '\u{201d}' => 0x94,
        '\u{2026}' => 0x85,
        letter if letter.is_control() => b' ',
        letter => u8::try_from(letter).unwrap_or(b'?'),
    };
    text.chars().map(byte).collect()
}

/// A chart's drawing on a page, whose coordinates are the drawing's.
struct Drawing<'a> {
    content: &'a mut Content,
    size: [u32; 2],
}

type Drawn = Result<(), DrawingErrorKind<Infallible>>;

impl Drawing<'_> {
    /// Takes a colour; false for one that cannot be seen.
    fn ink(&mut self, colour: BackendColor) -> bool {
        let (red, green, blue) = colour.rgb;
        let [red, green, blue] = [red, green, blue].map(|it| f32::from(it) / 255.0);
        let step = (colour.alpha * f64::from(ALPHAS)).round().clamp(0.0, f64::from(ALPHAS)) as u8;
        self.content.set_parameters(Name(alpha_name(step).as_bytes()));
        self.content.set_fill_rgb(red, green, blue).set_stroke_rgb(red, green, blue);
        step > 0
    }

    /// Adds the lines between points; false for none.
    fn path(&mut self, points: impl IntoIterator<Item = BackendCoord>) -> bool {
        let mut is_begun = false;
        for (x, y) in points {
            let [x, y] = [x, y].map(|it| it as f32);
            if std::mem::replace(&mut is_begun, true) {
                self.content.line_to(x, y);
            } else {
                self.content.move_to(x, y);
            }
        }
        is_begun
    }
}

impl DrawingBackend for Drawing<'_> {
    type ErrorType = Infallible;

    fn get_size(&self) -> (u32, u32) {
        self.size.into()
    }

    fn ensure_prepared(&mut self) -> Drawn {
        Ok(())
    }

    fn present(&mut self) -> Drawn {
        Ok(())
    }

    fn draw_pixel(&mut self, (x, y): BackendCoord, colour: BackendColor) -> Drawn {
        if self.ink(colour) {
            self.content.rect(x as f32, y as f32, 1.0, 1.0).fill_nonzero();
        }
        Ok(())
    }

    fn draw_line<S: BackendStyle>(
        &mut self,
        from: BackendCoord,
        to: BackendCoord,
        style: &S,
    ) -> Drawn {
        self.draw_path([from, to], style)
    }

    fn draw_rect<S: BackendStyle>(
        &mut self,
        upper_left: BackendCoord,
        bottom_right: BackendCoord,
        style: &S,
        fill: bool,
    ) -> Drawn {
        if self.ink(style.color()) {
            let ((left, top), (right, bottom)) = (upper_left, bottom_right);
            let [left, top, width, height] =
                [left, top, right - left, bottom - top].map(|it| it as f32);
            self.content.set_line_width(style.stroke_width() as f32);
            self.content.rect(left, top, width, height);
            if fill {
                self.content.fill_nonzero();
            } else {
                self.content.stroke();
            }
        }
        Ok(())
    }

    fn draw_path<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        path: I,
        style: &S,
    ) -> Drawn {
        if self.ink(style.color()) {
            self.content.set_line_width(style.stroke_width() as f32);
            if self.path(path) {
                self.content.stroke();
            }
        }
        Ok(())
    }

    fn draw_circle<S: BackendStyle>(
        &mut self,
        (x, y): BackendCoord,
        radius: u32,
        style: &S,
        fill: bool,
    ) -> Drawn {
        if self.ink(style.color()) {
            let [x, y] = [x, y].map(f64::from);
            let radius = f64::from(radius);
            let at = |right: f64, down: f64| (x + radius * right, y + radius * down);
            let k = QUARTER_CIRCLE;
            let quarters = [
                [at(1.0, k), at(k, 1.0), at(0.0, 1.0)],
                [at(-k, 1.0), at(-1.0, k), at(-1.0, 0.0)],
                [at(-1.0, -k), at(-k, -1.0), at(0.0, -1.0)],
                [at(k, -1.0), at(1.0, -k), at(1.0, 0.0)],
            ];
            self.content.set_line_width(style.stroke_width() as f32);
            self.content.move_to((x + radius) as f32, y as f32);
            for [one, two, end] in quarters {
                let [one, two, end] = [one, two, end].map(|(x, y)| (x as f32, y as f32));
                self.content.cubic_to(one.0, one.1, two.0, two.1, end.0, end.1);
            }
            if fill {
                self.content.fill_nonzero();
            } else {
                self.content.stroke();
            }
        }
        Ok(())
    }

    fn fill_polygon<S: BackendStyle, I: IntoIterator<Item = BackendCoord>>(
        &mut self,
        vert: I,
        style: &S,
    ) -> Drawn {
        if self.ink(style.color()) && self.path(vert) {
            self.content.close_path().fill_nonzero();
        }
        Ok(())
    }

    fn draw_text<S: BackendTextStyle>(
        &mut self,
        text: &str,
        style: &S,
        (x, y): BackendCoord,
    ) -> Drawn {
        if !self.ink(style.color()) {
            return Ok(());
        }
        let size = style.size() / FONT_FACTOR;
        let width = Font::Plain.width(size, text);
        let anchor = style.anchor();
        let along = match anchor.h_pos {
            HPos::Left => 0.0,
            HPos::Center => -0.5 * width,
            HPos::Right => -width,
        };
        let below = size
            * match anchor.v_pos {
                VPos::Top => 0.76,
                VPos::Center => 0.26,
                VPos::Bottom => -0.26,
            };
        // Where the text goes, and where its letters' feet are.
        let (right, down) = match style.transform() {
            FontTransform::None => ([1.0, 0.0], [0.0, 1.0]),
            FontTransform::Rotate90 => ([0.0, 1.0], [-1.0, 0.0]),
            FontTransform::Rotate180 => ([-1.0, 0.0], [0.0, -1.0]),
            FontTransform::Rotate270 => ([0.0, -1.0], [1.0, 0.0]),
        };
        let [right_x, right_y]: [f64; 2] = right;
        let [down_x, down_y]: [f64; 2] = down;
        let from_x = f64::from(x) + along * right_x + below * down_x;
        let from_y = f64::from(y) + along * right_y + below * down_y;
        self.content.begin_text().set_font(Font::Plain.name(), size as f32);
        let matrix = [right_x, right_y, -down_x, -down_y, from_x, from_y];
        self.content.set_text_matrix(matrix.map(|it| it as f32));
        self.content.show(Str(&encoded(text))).end_text();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_legend_distinguishes_areas_dots_crosses_and_lines() {
        let drawn = |shape: Shape| {
            let mut pages = Pages::default();
            pages.sample(shape, Ink::Blue, [100.0, 100.0]);
            String::from_utf8_lossy(&pages.content.finish().into_vec()).into_owned()
        };
        let shapes =
            [Shape::Area, Shape::Dots, Shape::Crosses, Shape::Line, Shape::Wide, Shape::Thin];
        let samples: std::collections::BTreeSet<String> = shapes.into_iter().map(drawn).collect();
        assert_eq!(samples.len(), shapes.len(), "{samples:?}");
        // As pale as in the chart, and only there.
        let area = drawn(Shape::Area);
        assert!(area.contains("/A6 gs") && area.trim_end().ends_with('Q'), "{area}");
        assert_eq!(drawn(Shape::Steps), drawn(Shape::Line));
    }
}
