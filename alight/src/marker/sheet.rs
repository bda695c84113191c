//! Lays out the sheet of paper to print: a marker or pad at its centre with cut marks, or a calibration
//! board, and below a ruler of 100 mm and lines of text, in millimetres.

use clap::ValueEnum;
use markers::{Board, Drawing, Ink, Marker, Pad, Shape};

/// Margin that printers leave blank, in millimetres.
const MARGIN_MM: f64 = 5.0;
/// Height of the area below the marker (cut marks, ruler, two lines of text), in millimetres.
const BELOW_MM: f64 = 33.0;
/// Around a board, and below it for the ruler and three lines of text, in millimetres.
const BOARD_TOP_MM: f64 = 12.0;
const BOARD_BELOW_MM: f64 = 32.0;
const BOARD_TEXT_LEFT_MM: f64 = 12.0;
/// Tolerance for rounding errors when fitting to the paper, in millimetres.
const ROUNDING_MM: f64 = 1e-6;
/// Length of the ruler, in millimetres.
const RULER_MM: f64 = 100.0;
/// Width of the lines, in millimetres.
const LINE_MM: f64 = 0.2;
/// Distance of the cut marks from the quiet zone, and their length, in millimetres.
const CUT_MARK_GAP_MM: f64 = 1.0;
const CUT_MARK_LENGTH_MM: f64 = 3.5;
/// Font size, in millimetres.
pub(super) const TEXT_MM: f64 = 3.2;
/// No letter is wider than this fraction of the font size.
const LETTER: f64 = 0.75;

/// Paper sizes, upright.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Paper {
    /// 148 x 210 mm.
    A5,
    /// 210 x 297 mm.
    A4,
    /// 297 x 420 mm.
    A3,
    /// 420 x 594 mm.
    A2,
    /// 594 x 841 mm.
    A1,
    /// 841 x 1189 mm.
    A0,
    /// 8.5 x 11 in.
    Letter,
    /// 8.5 x 14 in.
    Legal,
    /// 11 x 17 in.
    Tabloid,
}

impl Paper {
    /// Width and height in millimetres.
    pub(crate) fn size_mm(self) -> [f64; 2] {
        match self {
            Self::A5 => [148.0, 210.0],
            Self::A4 => [210.0, 297.0],
            Self::A3 => [297.0, 420.0],
            Self::A2 => [420.0, 594.0],
            Self::A1 => [594.0, 841.0],
            Self::A0 => [841.0, 1189.0],
            Self::Letter => [215.9, 279.4],
            Self::Legal => [215.9, 355.6],
            Self::Tabloid => [279.4, 431.8],
        }
    }

    /// Its name on the command line.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::A5 => "a5",
            Self::A4 => "a4",
            Self::A3 => "a3",
            Self::A2 => "a2",
            Self::A1 => "a1",
            Self::A0 => "a0",
            Self::Letter => "letter",
            Self::Legal => "legal",
            Self::Tabloid => "tabloid",
        }
    }

    /// The largest marker with its quiet zone that fits between the edges and above the ruler, in
    /// millimetres.
    fn room_mm(self) -> f64 {
        let [width, height] = self.size_mm();
        (width - 2.0 * MARGIN_MM).min(height - 2.0 * BELOW_MM)
    }

    /// Width and height of the largest pad that fits between the edges and above the ruler, in millimetres.
    fn pad_room_mm(self) -> [f64; 2] {
        let [width, height] = self.size_mm();
        [width - 2.0 * MARGIN_MM, height - MARGIN_MM - BELOW_MM]
    }

    /// Whether a pad of this width and height fits, in millimetres.
    fn has_room(self, needed_mm: [f64; 2]) -> bool {
        let room_mm = self.pad_room_mm();
        (0..2).all(|axis| needed_mm[axis] <= room_mm[axis] + ROUNDING_MM)
    }
}

/// Why a sheet is impossible.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum SheetError {
    /// The marker does not fit on the paper.
    TooLarge {
        /// The marker that does not fit, and the largest size that does.
        problem: String,
    },
    /// The marker has no id.
    NoId,
    /// The marker has no size.
    NoSize,
    /// The marker has a size, and `--size` is another one.
    TwoSizes {
        /// That of `--size`, in metres.
        size: f64,
        /// That of the marker, in metres.
        other: f64,
    },
    /// The image has too many pixels.
    TooManyPixels {
        /// Width and height in pixels.
        pixels: [u32; 2],
        /// The maximum pixels per inch for this paper.
        max_dpi: u32,
    },
}

impl std::fmt::Display for SheetError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::TooLarge { problem } => f.write_str(problem),
            Self::NoId => f.write_str("missing id: write the marker as FAMILY:ID"),
            Self::NoSize => f.write_str("missing marker size: pass `--size` in metres"),
            Self::TwoSizes { size, other } => {
                write!(f, "two sizes: {size} m by `--size`, and {other} m with the marker")
            }
            Self::TooManyPixels { pixels: [width, height], max_dpi } => write!(
                f,
                "an image of {width} x {height} pixels is too large; use `--dpi {max_dpi}` or less, or a PDF"
            ),
        }
    }
}

impl std::error::Error for SheetError {}

/// An element on the paper, in millimetres from its top left corner, x right, y down; later marks cover
/// earlier ones.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Mark {
    /// A filled circle.
    Disc { centre_mm: [f64; 2], radius_mm: f64, ink: Ink },
    /// A filled, upright rectangle: its top left and its bottom right corner.
    Rectangle { min_mm: [f64; 2], max_mm: [f64; 2], ink: Ink },
    /// A line of text, from the left end of its base line.
    Text { at_mm: [f64; 2], text: String },
}

impl Mark {
    /// The fill of a shape; `None` for text.
    pub(super) fn ink(&self) -> Option<Ink> {
        match self {
            Self::Disc { ink, .. } | Self::Rectangle { ink, .. } => Some(*ink),
            Self::Text { .. } => None,
        }
    }
}

/// The part of the paper that a marker or pad covers, with its quiet zones.
struct Frame {
    /// The marker's centre or the pad's landing point, from the paper's top left corner, x right, y down, in millimetres.
    origin_mm: [f64; 2],
    /// Its minimum and maximum coordinates from there, x right, y up, in millimetres.
    bounds_mm: [[f64; 2]; 2],
}

/// A sheet of paper with a marker or pad.
#[derive(Clone, Debug)]
pub(crate) struct Sheet {
    pub(super) size_mm: [f64; 2],
    pub(super) marks: Vec<Mark>,
}

impl Sheet {
    pub(super) fn new(marker: &Marker, size_m: f64, paper: Paper) -> Result<Self, SheetError> {
        let drawing = Drawing::new(marker, size_m).ok_or(SheetError::NoId)?;
        let half_mm = drawing.half_extent_m * 1e3;
        if 2.0 * half_mm > paper.room_mm() + ROUNDING_MM {
            return Err(too_large(marker, size_m, half_mm, paper));
        }
        let [width, height] = paper.size_mm();
        let frame = Frame {
            origin_mm: [width / 2.0, height / 2.0],
            bounds_mm: [[-half_mm; 2], [half_mm; 2]],
        };
        let titles = [format!("{}, size {size_m} m", marker.name())];
        Ok(Self::from_drawing(&drawing, &frame, &titles, paper))
    }

    /// A sheet with all markers of a pad, its landing point at the centre, or as near to it as its markers fit on the paper.
    pub(super) fn with_pad(pad: &Pad, paper: Paper) -> Result<Self, SheetError> {
        let drawing = pad.drawing().ok_or(SheetError::NoId)?;
        let bounds_mm =
            pad.bounds_m().ok_or(SheetError::NoId)?.map(|corner| corner.map(|m| 1e3 * m));
        let [[left, bottom], [right, top]] = bounds_mm;
        let needed_mm = [right - left, top - bottom];
        if !paper.has_room(needed_mm) {
            let mut papers = Paper::value_variants().iter();
            let instead = papers
                .find(|paper| paper.has_room(needed_mm))
                .map_or(String::new(), |paper| format!("; it fits on {}", paper.name()));
            let [room_width, room_height] = paper.pad_room_mm();
            let problem = format!(
                "{} needs {:.1} x {:.1} mm, its quiet zones included; {} has {room_width:.1} x {room_height:.1} mm{instead}",
                pad.name(),
                needed_mm[0],
                needed_mm[1],
                paper.name(),
            );
            return Err(SheetError::TooLarge { problem });
        }
        let [width, height] = paper.size_mm();
        let across = (width / 2.0).max(MARGIN_MM - left).min(width - MARGIN_MM - right);
        let down = (height / 2.0).max(MARGIN_MM + top).min(height - BELOW_MM + bottom);
        let frame = Frame { origin_mm: [across, down], bounds_mm };
        let markers = pad.markers().iter().map(|placed| placed.marker);
        let titles = [pad_title(pad), in_one_line(&kinds(markers), paper)];
        Ok(Self::from_drawing(&drawing, &frame, &titles, paper))
    }

    /// A sheet with a calibration board and its instructions.
    pub(crate) fn with_board(board: &Board, paper: Paper) -> Result<Self, SheetError> {
        let [width_mm, height_mm] = board.size_m().map(|edge| edge * 1e3);
        let [page_width, page_height] = paper.size_mm();
        let room = [page_width - 2.0 * BOARD_TOP_MM, page_height - BOARD_TOP_MM - BOARD_BELOW_MM];
        if width_mm > room[0] + ROUNDING_MM || height_mm > room[1] + ROUNDING_MM {
            let scale = (room[0] / width_mm).min(room[1] / height_mm);
            // Rounded down to tenths of millimetres, so that the stated sizes fit.
            let fitting = |m: f64| (m * scale * 1e4).floor() / 1e4;
            let problem = format!(
                "the board is {width_mm:.1} x {height_mm:.1} mm, and {} has {:.1} x {:.1} mm; `--tag {} --gap {}` fit",
                paper.name(),
                room[0],
                room[1],
                fitting(board.tag_m()),
                fitting(board.gap_m()),
            );
            return Err(SheetError::TooLarge { problem });
        }
        let mut sheet = Self { size_mm: paper.size_mm(), marks: Vec::new() };
        sheet.draw(&board.drawing(), [page_width / 2.0, BOARD_TOP_MM + height_mm / 2.0]);
        sheet.draw_ruler();
        let [tag_mm, gap_mm] = [board.tag_m(), board.gap_m()].map(|edge| edge * 1e3);
        let lines = [
            format!(
                "{} x {} tags of AprilTag 36h11, side {tag_mm:.1} mm, gap {gap_mm:.1} mm.",
                board.columns(),
                board.rows()
            ),
            "Print at 100 %: the ruler must measure 100 mm. Glue it flat to glass or a board."
                .to_owned(),
            "Measure the side of a tag and the gap, and give both: --tag and --gap, in metres."
                .to_owned(),
        ];
        for (line, text) in lines.into_iter().enumerate() {
            let below = 12.0 - 3.5 * line as f64;
            sheet.write([BOARD_TEXT_LEFT_MM, page_height - below], text);
        }
        Ok(sheet)
    }

    fn from_drawing(drawing: &Drawing, frame: &Frame, titles: &[String], paper: Paper) -> Self {
        let mut sheet = Self { size_mm: paper.size_mm(), marks: Vec::new() };
        sheet.draw(drawing, frame.origin_mm);
        sheet.draw_cut_marks(frame);
        sheet.draw_ruler();
        let [width, height] = sheet.size_mm;
        let left = (width - RULER_MM) / 2.0;
        let advice_mm = height - MARGIN_MM - 1.0;
        let line_mm = if titles.len() > 1 { 3.5 } else { 5.0 };
        for (above, title) in (1..).zip(titles.iter().rev()) {
            sheet.write([left, advice_mm - line_mm * f64::from(above)], title.clone());
        }
        let advice = "Print at 100 %: the ruler must measure 100 mm.";
        sheet.write([left, advice_mm], advice.to_owned());
        sheet
    }

    /// Draws it with its origin there.
    fn draw(&mut self, drawing: &Drawing, [x, y]: [f64; 2]) {
        // The marker's y axis points up, the paper's down.
        let place = |[right, up]: [f64; 2]| [x + right * 1e3, y - up * 1e3];
        self.marks.extend(drawing.layers.iter().map(|layer| match layer.shape {
            Shape::Disc { centre_m, radius_m } => {
                Mark::Disc { centre_mm: place(centre_m), radius_mm: radius_m * 1e3, ink: layer.ink }
            }
            Shape::Rectangle { min_m, max_m } => {
                let ([left, bottom], [right, top]) = (place(min_m), place(max_m));
                Mark::Rectangle { min_mm: [left, top], max_mm: [right, bottom], ink: layer.ink }
            }
        }));
    }

    /// Draws cut marks outside the quiet zone's corners.
    fn draw_cut_marks(&mut self, frame: &Frame) {
        let [x, y] = frame.origin_mm;
        let [[left, bottom], [right, top]] = frame.bounds_mm;
        let (near, far) = (CUT_MARK_GAP_MM, CUT_MARK_GAP_MM + CUT_MARK_LENGTH_MM);
        for (at_x, outwards) in [(x + left, -1.0), (x + right, 1.0)] {
            for (at_y, downwards) in [(y - top, -1.0), (y - bottom, 1.0)] {
                self.line([at_x + outwards * near, at_y], [at_x + outwards * far, at_y]);
                self.line([at_x, at_y + downwards * near], [at_x, at_y + downwards * far]);
            }
        }
    }

    fn draw_ruler(&mut self) {
        let [width, height] = self.size_mm;
        let (left, top) = ((width - RULER_MM) / 2.0, height - 25.0);
        self.line([left, top], [left + RULER_MM, top]);
        for mm in 0..=RULER_MM as u32 {
            let len = match mm {
                _ if mm % 10 == 0 => 5.0,
                _ if mm % 5 == 0 => 3.5,
                _ => 2.0,
            };
            let x = left + f64::from(mm);
            self.line([x, top], [x, top + len]);
        }
        for (mm, label) in [(0.0, "0"), (50.0, "50"), (RULER_MM, "100 mm")] {
            self.write([left + mm - 1.0, height - 16.5], label.to_owned());
        }
    }

    /// Draws a vertical or horizontal line centred on the points.
    fn line(&mut self, from_mm: [f64; 2], to_mm: [f64; 2]) {
        let half = LINE_MM / 2.0;
        let level = from_mm[1] == to_mm[1];
        let (dx, dy) = if level { (0.0, half) } else { (half, 0.0) };
        let min_mm = [from_mm[0].min(to_mm[0]) - dx, from_mm[1].min(to_mm[1]) - dy];
        let max_mm = [from_mm[0].max(to_mm[0]) + dx, from_mm[1].max(to_mm[1]) + dy];
        self.marks.push(Mark::Rectangle { min_mm, max_mm, ink: Ink::Black });
    }

    fn write(&mut self, at_mm: [f64; 2], text: String) {
        self.marks.push(Mark::Text { at_mm, text });
    }
}

/// The name of a pad and its number of markers.
pub(super) fn pad_title(pad: &Pad) -> String {
    let name = pad.name();
    match pad.markers().len() {
        1 => format!("{name}, 1 marker"),
        count => format!("{name}, {count} markers"),
    }
}

/// The markers of one family and size on a pad, as a sheet names them.
struct Kind {
    /// With its ids.
    full: String,
    /// With their number, where there is no room for the ids.
    short: String,
    /// Number of markers.
    count: usize,
}

/// The markers of a pad by family and size.
fn kinds(markers: impl Iterator<Item = Marker>) -> Vec<Kind> {
    let mut kinds: Vec<(Marker, Vec<u32>)> = Vec::new();
    for marker in markers {
        let same = kinds
            .iter_mut()
            .find(|(first, _)| first.family == marker.family && first.size_m == marker.size_m);
        match same {
            Some((_, ids)) => ids.extend(marker.id),
            None => kinds.push((marker, marker.id.into_iter().collect())),
        }
    }
    let kinds = kinds.into_iter().map(|(Marker { family, size_m, .. }, mut ids)| {
        let size = size_m.map_or_else(String::new, |size_m| format!(" {size_m} m"));
        if ids.is_empty() {
            let name = format!("{family}{size}");
            return Kind { full: name.clone(), short: name, count: 1 };
        }
        ids.sort_unstable();
        let full = format!("{family}:{}{size}", ranges(&ids).join(","));
        Kind { full, short: format!("{family}: {} of{size}", ids.len()), count: ids.len() }
    });
    kinds.collect()
}

/// Sorted numbers, with those in a row as the first and the last of them.
fn ranges(sorted: &[u32]) -> Vec<String> {
    let rows = sorted.chunk_by(|one, next| one.checked_add(1) == Some(*next));
    let texts = rows.map(|row| match row {
        [first, _, .., last] => format!("{first}-{last}"),
        _ => row.iter().map(u32::to_string).collect::<Vec<_>>().join(","),
    });
    texts.collect()
}

/// As many kinds of markers as there is room for next to the ruler's left end, with their ids or else with their numbers; the others are
/// counted.
fn in_one_line(kinds: &[Kind], paper: Paper) -> String {
    let [width, _] = paper.size_mm();
    let room_mm = (width + RULER_MM) / 2.0 - MARGIN_MM;
    let max_letters = (room_mm / (LETTER * TEXT_MM)) as usize;
    let line = |shown: usize, name: fn(&Kind) -> &str| {
        let more = match kinds.iter().skip(shown).map(|kind| kind.count).sum::<usize>() {
            0 => None,
            rest => Some(format!("{rest} more")),
        };
        let parts = kinds.iter().take(shown).map(|kind| name(kind).to_owned()).chain(more);
        parts.collect::<Vec<_>>().join(", ")
    };
    let full = (1..=kinds.len()).rev().map(|shown| line(shown, |kind| &kind.full));
    let short = (0..=kinds.len()).rev().map(|shown| line(shown, |kind| &kind.short));
    full.chain(short).find(|line| line.len() <= max_letters).unwrap_or_default()
}

/// The smallest paper on which it fits.
fn larger_paper(needed_mm: f64) -> Option<&'static Paper> {
    Paper::value_variants().iter().find(|paper| paper.room_mm() + ROUNDING_MM >= needed_mm)
}

fn too_large(marker: &Marker, size_m: f64, half_mm: f64, paper: Paper) -> SheetError {
    let per_metre = 2.0 * half_mm / size_m;
    // Rounded down to tenths of millimetres, so that the stated size fits.
    let largest_m = (paper.room_mm() / per_metre * 1e4).floor() / 1e4;
    let instead = match larger_paper(2.0 * half_mm) {
        Some(paper) => format!("; {size_m} m fit on {}", paper.name()),
        None => String::new(),
    };
    SheetError::TooLarge {
        problem: format!(
            "{} of {size_m} m needs {:.1} mm with its white border; at most {largest_m} m fit on {}{instead}",
            marker.name(),
            2.0 * half_mm,
            paper.name()
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sheet(size_m: f64, paper: Paper) -> Result<Sheet, SheetError> {
        Sheet::new(&"rings".parse().unwrap(), size_m, paper)
    }

    #[test]
    fn a_marker_that_does_not_fit_is_reported_with_the_largest_that_does() {
        let problem = sheet(0.2, Paper::A4).unwrap_err().to_string();
        assert!(problem.contains("needs 240.0 mm"), "{problem}");
        assert!(problem.contains("at most 0.1666 m fit on a4; 0.2 m fit on a3"), "{problem}");
        assert!(sheet(0.1666, Paper::A4).is_ok() && sheet(0.2, Paper::A3).is_ok());
        let problem = sheet(5.0, Paper::A0).unwrap_err().to_string();
        assert!(problem.ends_with("at most 0.6925 m fit on a0"), "{problem}");
    }

    #[test]
    fn marks_are_on_the_paper_and_outside_the_quiet_zone() {
        for paper in Paper::value_variants() {
            let size_m = paper.room_mm() / 1200.0;
            let sheet = sheet(size_m, *paper).unwrap();
            let [width, height] = paper.size_mm();
            let reach = size_m * 1e3 * 0.6;
            let is_clear = |[x, y]: [f64; 2]| {
                (x - width / 2.0).abs().max((y - height / 2.0).abs()) >= reach - LINE_MM
            };
            for mark in &sheet.marks {
                match mark {
                    Mark::Disc { centre_mm, .. } => {
                        assert_eq!(*centre_mm, [width / 2.0, height / 2.0]);
                    }
                    Mark::Rectangle { min_mm, max_mm, .. } => {
                        assert!(min_mm[0] >= 0.0 && min_mm[1] >= 0.0, "{mark:?}");
                        assert!(max_mm[0] <= width && max_mm[1] <= height, "{mark:?}");
                        assert!(is_clear(*min_mm) && is_clear(*max_mm), "{mark:?} on {paper:?}");
                    }
                    Mark::Text { at_mm: [x, y], text } => {
                        // No letter is wider than the font size.
                        assert!(x + 0.75 * TEXT_MM * text.len() as f64 <= width, "{text}");
                        assert!(*y <= height - MARGIN_MM && is_clear([*x, y - TEXT_MM]));
                    }
                }
            }
        }
    }

    #[test]
    fn a_pads_sheet_names_its_markers_with_ids_and_sizes() {
        let texts = |pad: &Pad, paper: Paper| -> Vec<String> {
            let [width, _] = paper.size_mm();
            let sheet = Sheet::with_pad(pad, paper).unwrap();
            let texts = sheet.marks.iter().filter_map(|mark| match mark {
                Mark::Text { at_mm: [x, _], text } => {
                    assert!(x + LETTER * TEXT_MM * text.len() as f64 <= width, "{text}");
                    Some(text.clone())
                }
                Mark::Disc { .. } | Mark::Rectangle { .. } => None,
            });
            texts.collect()
        };
        let built_in = texts(&Pad::named("a4", |file| node::read_text(file)).unwrap(), Paper::A4);
        assert!(built_in.contains(&"pad:0, 2 markers".to_owned()), "{built_in:?}");
        let markers = "apriltag-custom48h12:0 0.099 m, aruco-4x4-50:0 0.024 m".to_owned();
        assert!(built_in.contains(&markers), "{built_in:?}");
        let one: Pad = "id = 2\nmarkers = [{ marker = \"rings:0.1\" }]".parse().unwrap();
        assert_eq!(pad_title(&one), "pad:2, 1 marker");
        let four = |size_m: &dyn Fn(u32) -> String| -> Pad {
            let placed = (0..4).map(|id| {
                let (x_m, size_m) = (0.03 * f64::from(id) - 0.045, size_m(id));
                format!("[[markers]]\nmarker = \"aruco-4x4-50:{id}:{size_m}\"\nx_m = {x_m}\n")
            });
            format!("id = 1\n{}", placed.collect::<String>()).parse().unwrap()
        };
        let row = texts(&four(&|_| "0.02".to_owned()), Paper::A5);
        assert!(row.contains(&"aruco-4x4-50:0-3 0.02 m".to_owned()), "{row:?}");
        let sizes = texts(&four(&|id| format!("0.01{id}")), Paper::A5);
        assert!(sizes.iter().any(|text| text.ends_with(", 3 more")), "{sizes:?}");
    }

    #[test]
    fn a_pad_fits_by_its_width_and_height_wherever_its_landing_point_is() {
        let pad = |y_m: f64, size_m: f64| -> Pad {
            let far = format!("{{ marker = \"apriltag-36h11:7:0.1\", y_m = {y_m} }}");
            let near = format!("{{ marker = \"aruco-4x4-50:1:{size_m}\", y_m = -0.03 }}");
            format!("id = 1\nmarkers = [{far}, {near}]").parse().unwrap()
        };
        // Tall, and its landing point far below its centre: 125 x 240 mm.
        let tall = Sheet::with_pad(&pad(0.1375, 0.0075), Paper::A4).unwrap();
        assert!(Sheet::with_pad(&pad(0.1375, 0.0075), Paper::A5).is_err());
        for mark in &tall.marks {
            if let Mark::Rectangle { min_mm, max_mm, .. } = mark {
                assert!(min_mm[0] >= 0.0 && min_mm[1] >= 0.0, "{mark:?}");
                assert!(max_mm[0] <= 210.0 && max_mm[1] <= 297.0, "{mark:?}");
            }
        }
        let lowest = |ink: Ink| {
            let marks = tall.marks.iter().filter(|mark| mark.ink() == Some(ink));
            let bottoms = marks.filter_map(|mark| match mark {
                Mark::Rectangle { max_mm, .. } => Some(max_mm[1]),
                _ => None,
            });
            bottoms.fold(0.0, f64::max)
        };
        assert!(lowest(Ink::White) <= 297.0 - BELOW_MM + ROUNDING_MM);
        let refused = Sheet::with_pad(&pad(0.24, 0.0075), Paper::A4).unwrap_err().to_string();
        assert!(refused.contains("a4 has 200.0 x 259.0 mm; it fits on a3"), "{refused}");
    }

    #[test]
    fn ids_in_a_row_are_named_by_the_first_and_the_last_and_many_apart_by_their_number() {
        assert_eq!(ranges(&[3]), ["3"]);
        assert_eq!(ranges(&[0, 1, 4, 5, 6, 9]), ["0,1", "4-6", "9"]);
        let of = |ids: Vec<u32>| {
            let markers = ids.iter().map(|id| format!("aruco-4x4-50:{id}:0.02").parse().unwrap());
            in_one_line(&kinds(markers), Paper::A5)
        };
        assert_eq!(of((0..20).rev().collect()), "aruco-4x4-50:0-19 0.02 m");
        assert_eq!(of((0..25).map(|i| 2 * i).collect()), "aruco-4x4-50: 25 of 0.02 m");
        // Of 16 markers of 8 families and sizes 2 are named.
        let pairs =
            (0..16).map(|id| format!("aruco-4x4-50:{id}:0.0{}", 15 + id % 8).parse().unwrap());
        assert_eq!(in_one_line(&kinds(pairs), Paper::A5), "aruco-4x4-50:0,8 0.015 m, 14 more");
    }

    #[test]
    fn the_ruler_is_a_hundred_millimetres_long() {
        let sheet = sheet(0.1, Paper::A5).unwrap();
        let edges = sheet.marks.iter().filter_map(|mark| match mark {
            Mark::Rectangle { min_mm, max_mm, .. }
                if (max_mm[1] - min_mm[1] - 5.0).abs() < 1e-9 =>
            {
                Some((min_mm[0] + max_mm[0]) / 2.0)
            }
            _ => None,
        });
        let edges: Vec<f64> = edges.collect();
        assert_eq!(edges.len(), 11);
        assert!((edges[10] - edges[0] - 100.0).abs() < 1e-9);
    }
}
