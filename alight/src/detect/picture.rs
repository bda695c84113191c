//! Draws detections into the images of `alight detect`: each marker's outline, the axes of its pose and a
//! label with name and position; written as PNG files.

use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use anyhow::Context;
use fiducial::Observation;
use fiducial::overlay::canvas::{Colour, LINE, RgbImageBuf};
use fiducial::overlay::font::METRES;
use geometry::{CameraModel, Pixel, Point, Transform};
use imaging::{GrayImage, GrayView};

use super::source::DRAWN_ENDING;

const GREEN: Colour = [40, 230, 80];
const RED: Colour = [255, 60, 60];
const BLUE: Colour = [70, 140, 255];
const YELLOW: Colour = [255, 235, 80];
const WHITE: Colour = [255, 255, 255];

/// Width of a drawing for each pixel of its lines, in pixels.
const WIDTH_PER_LINE_PX: usize = 640;
/// The same for each pixel of a dot of its letters, which are 7 dots high.
const WIDTH_PER_DOT_PX: usize = 450;
/// Distance from one letter to the next, in dots.
const LETTER: f64 = 6.0;
/// Images narrower than this, in pixels, are enlarged to make room for labels.
const MIN_WIDTH_PX: usize = 900;
/// Markers smaller than this, in pixels of the drawing, get a circle of this radius.
const MIN_VISIBLE_PX: f64 = 40.0;

/// Writes annotated images into a folder.
#[derive(Debug)]
pub(super) struct Gallery {
    folder: PathBuf,
}

impl Gallery {
    /// Creates the folder if it is missing.
    ///
    /// # Errors
    /// When it cannot be created.
    pub(super) fn new(folder: &Path) -> anyhow::Result<Self> {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("creating the folder {folder:?} for annotated images"))?;
        Ok(Self { folder: folder.to_owned() })
    }

    /// Writes the annotated image; the ending of its name is that of earlier ones only, which it replaces.
    ///
    /// # Errors
    /// When it cannot be written.
    pub(super) fn add(
        &self,
        stem: &str,
        image: &GrayImage,
        found: &[Observation],
        camera: Option<&CameraModel>,
    ) -> anyhow::Result<()> {
        let path = self.folder.join(format!("{stem}{DRAWN_ENDING}"));
        let Some(view) = image.view() else { return Ok(()) };
        let drawn = draw(view, found, camera);
        let (width, height) = (drawn.width as u32, drawn.height as u32);
        image::save_buffer(&path, &drawn.data, width, height, image::ColorType::Rgb8)
            .with_context(|| format!("writing the annotated image {path:?}"))
    }
}

fn draw(view: GrayView<'_>, found: &[Observation], camera: Option<&CameraModel>) -> RgbImageBuf {
    let enlarged = MIN_WIDTH_PX.div_ceil(view.width()).clamp(1, 4);
    let mut brush = Brush {
        canvas: RgbImageBuf::default(),
        scale: enlarged as f64,
        line_px: (view.width() * enlarged / WIDTH_PER_LINE_PX).clamp(1, 6),
        dot_px: (view.width() * enlarged / WIDTH_PER_DOT_PX).clamp(1, 8),
    };
    brush.draw_image(view, enlarged);
    for seen in found {
        brush.outline(seen, camera);
    }
    for seen in found {
        brush.axes(seen, camera);
    }
    for label in brush.labels(found) {
        brush.write(&label);
    }
    if found.is_empty() {
        brush.canvas.text([0.0, 0.0], "no marker", brush.dot_px, YELLOW);
    }
    brush.canvas
}

struct Brush {
    canvas: RgbImageBuf,
    scale: f64,
    /// Width of lines, in pixels of the drawing.
    line_px: usize,
    /// Width of a dot of the font where there is room, in pixels of the drawing.
    dot_px: usize,
}

/// What is written of a marker, and where.
struct Label {
    lines: Vec<String>,
    /// Width of a dot of its letters, in pixels of the drawing.
    dot_px: usize,
    /// The middle of its upper edge, in the drawing.
    at: [f64; 2],
    area: Area,
}

/// An upright rectangle in the drawing.
#[derive(Clone, Copy, Debug)]
struct Area {
    min: [f64; 2],
    max: [f64; 2],
}

impl Area {
    fn of(points: &[[f64; 2]]) -> Self {
        let corner = |from: f64, choose: fn(f64, f64) -> f64| {
            [0, 1].map(|axis: usize| points.iter().map(|it| it[axis]).fold(from, choose))
        };
        Self { min: corner(f64::INFINITY, f64::min), max: corner(f64::NEG_INFINITY, f64::max) }
    }

    fn has(&self, point: [f64; 2]) -> bool {
        self.overlaps(&Self { min: point, max: point })
    }

    fn overlaps(&self, other: &Self) -> bool {
        [0, 1].into_iter().all(|axis: usize| {
            self.min[axis] <= other.max[axis] && other.min[axis] <= self.max[axis]
        })
    }
}

impl Brush {
    fn draw_image(&mut self, view: GrayView<'_>, enlarged: usize) {
        if enlarged == 1 {
            self.canvas.copy(view);
            return;
        }
        let mut large = GrayImage::filled(view.width() * enlarged, view.height() * enlarged, 0);
        for y in 0..large.height() {
            let row = view.row(y / enlarged);
            for (x, pixel) in large.row_mut(y).iter_mut().enumerate() {
                *pixel = row.get(x / enlarged).copied().unwrap_or_default();
            }
        }
        if let Some(large) = large.view() {
            self.canvas.copy(large);
        }
    }

    /// A pixel of the image in the drawing.
    fn to_drawing(&self, pixel: Pixel) -> [f64; 2] {
        [pixel.x, pixel.y].map(|at| (at + 0.5) * self.scale - 0.5)
    }

    fn line_px(&self) -> f64 {
        self.line_px as f64
    }

    /// Draws the marker's outline, with a red circle at its own top-left corner.
    fn outline(&mut self, seen: &Observation, camera: Option<&CameraModel>) {
        let (line, centre) = (self.line_px(), self.to_drawing(seen.centre));
        match seen.corners {
            Some(corners) => {
                let corners = corners.map(|corner| self.to_drawing(corner));
                self.canvas.polygon(&corners, line, GREEN);
                self.canvas.circle(corners[0], 2.0 * line, RED);
                self.canvas.circle(corners[0], 2.0 * line + 1.0, RED);
            }
            None => {
                let outline = self.round_outline(seen, camera);
                self.canvas.polygon(&outline, line, GREEN);
            }
        }
        if seen.size_px * self.scale < MIN_VISIBLE_PX {
            self.canvas.circle(centre, MIN_VISIBLE_PX, YELLOW);
        }
    }

    /// The outline of a round marker: projected from its pose, or else a circle.
    fn round_outline(&self, seen: &Observation, camera: Option<&CameraModel>) -> Vec<[f64; 2]> {
        const POINTS: u32 = 90;
        let turns = (0..POINTS).map(|i| f64::from(i) * TAU / f64::from(POINTS));
        let of_pose = seen.pose.zip(camera).map(|(pose, camera)| {
            let radius_m = size_m(seen, camera) / 2.0;
            let at = |turn: f64| Point::new(radius_m * turn.cos(), radius_m * turn.sin(), 0.0);
            let seen_at = |turn| camera.project(pose.camera_from_marker * at(turn));
            turns
                .clone()
                .filter_map(seen_at)
                .map(|pixel| self.to_drawing(pixel))
                .collect::<Vec<_>>()
        });
        of_pose.unwrap_or_else(|| {
            let radius = seen.size_px / 2.0;
            let at = |turn: f64| {
                Pixel::new(seen.centre.x + radius * turn.cos(), seen.centre.y + radius * turn.sin())
            };
            turns.map(|turn| self.to_drawing(at(turn))).collect()
        })
    }

    /// Draws the axes of the pose: x red, y green, z (towards the viewer) blue; without a pose a cross.
    fn axes(&mut self, seen: &Observation, camera: Option<&CameraModel>) {
        let (centre, line) = (self.to_drawing(seen.centre), self.line_px());
        let Some((pose, camera)) = seen.pose.zip(camera) else {
            let arm = (0.15 * seen.size_px * self.scale).clamp(3.0, 20.0);
            let [x, y] = centre;
            self.canvas.line([x - arm, y], [x + arm, y], line, RED);
            self.canvas.line([x, y - arm], [x, y + arm], line, RED);
            return;
        };
        let length_m = 0.5 * size_m(seen, camera);
        let tips = [
            (Point::new(length_m, 0.0, 0.0), RED),
            (Point::new(0.0, length_m, 0.0), GREEN),
            (Point::new(0.0, 0.0, length_m), BLUE),
        ];
        for (tip, colour) in tips {
            if let Some(tip) = tip_of(camera, &pose.camera_from_marker, tip) {
                self.canvas.line(centre, self.to_drawing(tip), 2.0 * line, colour);
            }
        }
    }

    /// Name, confidence and position of each marker; beside others only as much as ends neither on them nor on their labels.
    fn labels(&self, found: &[Observation]) -> Vec<Label> {
        let markers: Vec<Area> = found.iter().map(|seen| self.area(seen)).collect();
        let all: Vec<[Label; 4]> = found.iter().map(|seen| self.texts(seen)).collect();
        // Each of a marker's labels lies in the longer ones before it. So two are apart also where the one chosen for the other is longer.
        let is_free = |own: usize, rank: usize, label: &Label| {
            let centre = found.get(own).map(|seen| self.to_drawing(seen.centre));
            // A pad has its markers in it.
            let is_around = |area: &Area| centre.is_some_and(|centre| area.has(centre));
            let ends_on = |area: &Area| area.overlaps(&label.area);
            let others = all.iter().enumerate().filter(|(other, _)| *other != own);
            let mut others = others.filter_map(|(_, labels)| labels.get(rank));
            !markers.iter().any(|it| ends_on(it) && !is_around(it))
                && !others.any(|it| ends_on(&it.area))
        };
        let chosen = |(own, labels): (usize, &[Label; 4])| {
            let mut ranked = labels.iter().enumerate();
            ranked.find(|(rank, label)| is_free(own, *rank, label)).map_or(3, |(rank, _)| rank)
        };
        let chosen: Vec<usize> = all.iter().enumerate().map(chosen).collect();
        let labels = all.into_iter().zip(chosen);
        labels.filter_map(|(labels, rank)| labels.into_iter().nth(rank)).collect()
    }

    /// Labels of a marker, the longest first.
    fn texts(&self, seen: &Observation) -> [Label; 4] {
        let id = seen.id.map_or_else(String::new, |id| id.to_string());
        let name = match seen.id {
            Some(id) => format!("{}:{id}", seen.family),
            None => seen.family.to_string(),
        };
        let wrong = match seen.wrong_bits {
            0 => String::new(),
            bits => format!("  {bits} wrong"),
        };
        let mut all = vec![format!("{name}  {:.2}{wrong}", seen.confidence)];
        if let Some(pose) = &seen.pose {
            let at = pose.camera_from_marker.origin();
            all.push(format!("{:.3}, {:.3}, {:.3} {METRES}", at.x(), at.y(), at.z()));
        }
        let short = format!("{id} {:.2}", seen.confidence).trim().to_owned();
        let shorter = [
            (all, self.dot_px),
            (vec![short], self.dot_px),
            (vec![id.clone()], self.dot_px),
            (vec![id], self.line_px),
        ];
        shorter.map(|(lines, dot_px)| self.label(seen, lines, dot_px))
    }

    /// Lines under a marker.
    fn label(&self, seen: &Observation, lines: Vec<String>, dot_px: usize) -> Label {
        let ([x, y], area) = (self.to_drawing(seen.centre), self.area(seen));
        let is_small = seen.size_px * self.scale < MIN_VISIBLE_PX;
        let reach = if is_small { MIN_VISIBLE_PX } else { area.max[1] - y };
        let dot = dot_px as f64;
        let letters = lines.iter().map(|line| line.chars().count()).max().unwrap_or(0);
        let (width, height) = (LETTER * dot * letters as f64, LINE * dot * lines.len() as f64);
        // At the lower edge all lines move up together: each by itself would end on the others.
        let lowest = self.canvas.height as f64 - height;
        let top = (y + reach + 2.0 * self.line_px()).min(lowest).max(0.0);
        let left = (x - 0.5 * width).min(self.canvas.width as f64 - width).max(0.0);
        let area = Area { min: [left, top], max: [left + width, top + height] };
        Label { lines, dot_px, at: [x, top], area }
    }

    fn write(&mut self, label: &Label) {
        let ([x, top], dot) = (label.at, label.dot_px as f64);
        for (index, text) in (0..).zip(&label.lines) {
            let left = x - 0.5 * LETTER * dot * text.chars().count() as f64;
            let colour = if index == 0 { YELLOW } else { WHITE };
            let at = [left, top + LINE * dot * f64::from(index)];
            self.canvas.text(at, text, label.dot_px, colour);
        }
    }

    /// The marker in the drawing.
    fn area(&self, seen: &Observation) -> Area {
        let corners = seen.corners.unwrap_or_else(|| {
            let radius = 0.5 * seen.size_px;
            [[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]
                .map(|[x, y]| Pixel::new(seen.centre.x + x * radius, seen.centre.y + y * radius))
        });
        Area::of(&corners.map(|corner| self.to_drawing(corner)))
    }
}

/// The approximate size of a marker from its pose, in metres.
fn size_m(seen: &Observation, camera: &CameraModel) -> f64 {
    let Some(pose) = &seen.pose else { return 0.0 };
    match seen.corners {
        Some(corners) => {
            let at = |pixel: Pixel| on_plane(&pose.camera_from_marker, camera, pixel);
            let away = |corner: Pixel| {
                let (corner, centre) = (at(corner)?, at(seen.centre)?);
                Some((corner.0 - centre.0).hypot(corner.1 - centre.1))
            };
            let known: Vec<f64> = corners.into_iter().filter_map(away).collect();
            known.iter().sum::<f64>() / known.len().max(1) as f64 * std::f64::consts::SQRT_2
        }
        None => seen.size_px / camera.fx * pose.camera_from_marker.origin().z(),
    }
}

/// The intersection of a pixel's ray with the marker's plane, in the marker frame.
fn on_plane(
    camera_from_marker: &Transform<geometry::Camera, geometry::Marker>,
    camera: &CameraModel,
    pixel: Pixel,
) -> Option<(f64, f64)> {
    let ray = camera.unproject_clamped(pixel);
    let marker_from_camera = camera_from_marker.inverse();
    let origin = marker_from_camera.origin();
    let direction = marker_from_camera.rotation() * ray;
    let along = -origin.z() / direction.z();
    let (x, y) = (origin.x() + along * direction.x(), origin.y() + along * direction.y());
    (x.is_finite() && y.is_finite()).then_some((x, y))
}

fn tip_of(
    camera: &CameraModel,
    camera_from_marker: &Transform<geometry::Camera, geometry::Marker>,
    tip: Point<geometry::Marker>,
) -> Option<Pixel> {
    camera.project(*camera_from_marker * tip)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_images_are_enlarged_and_labelled_without_a_marker() {
        let image = GrayImage::filled(300, 100, 80);
        let drawn = draw(image.view().unwrap(), &[], None);
        assert_eq!((drawn.width, drawn.height, drawn.data.len()), (900, 300, 900 * 300 * 3));
        assert!(drawn.data.chunks(3).any(|pixel| pixel == YELLOW));
    }

    fn marker(id: Option<u32>, centre: Pixel, size_px: f64) -> Observation {
        let place = Transform::new(geometry::Rotation::identity(), Point::new(0.0, 0.1, 1.0));
        let pose = fiducial::MarkerPose {
            camera_from_marker: place,
            reprojection_rms_px: 0.1,
            covariance: nalgebra::Matrix6::identity(),
            alternative: None,
        };
        Observation {
            family: markers::Family::Rings,
            id,
            centre,
            centre_covariance_px2: nalgebra::Matrix2::identity(),
            corners: None,
            wrong_bits: 0,
            size_px,
            confidence: 1.0,
            pose: Some(pose),
            response: None,
        }
    }

    fn brush(width: usize, height: usize) -> Brush {
        let mut brush = Brush { canvas: RgbImageBuf::default(), scale: 1.0, line_px: 1, dot_px: 2 };
        brush.draw_image(GrayImage::filled(width, height, 80).view().unwrap(), 1);
        brush
    }

    #[test]
    fn labels_beside_each_other_are_shorter_and_end_on_no_other_marker_and_label() {
        let brush = brush(960, 720);
        for (pitch, lines, longest) in [(300.0, 2, 21), (120.0, 1, 8), (75.0, 1, 3), (52.0, 1, 3)] {
            let at = |n: f64| 150.0 + pitch * n;
            let cell = |n: u32| Pixel::new(at(f64::from(n % 3)), at(f64::from(n / 3)));
            let found: Vec<_> = (0..6).map(|n| marker(Some(120 + n), cell(n), 40.0)).collect();
            let labels = brush.labels(&found);
            let markers: Vec<Area> = found.iter().map(|seen| brush.area(seen)).collect();
            assert_eq!(labels.len(), found.len());
            for (n, label) in labels.iter().enumerate() {
                let length = label.lines.iter().map(|it| it.chars().count()).max();
                assert_eq!((label.lines.len(), length), (lines, Some(longest)), "{pitch}");
                assert!(label.lines[0].contains(&format!("{}", 120 + n)), "{:?}", label.lines);
                let others = labels.iter().enumerate().filter(|(other, _)| *other != n);
                let others = others.map(|(_, it)| &it.area).chain(&markers);
                assert_eq!(others.filter(|it| it.overlaps(&label.area)).count(), 0, "{pitch}");
            }
        }
    }

    #[test]
    fn a_marker_of_a_pad_has_its_whole_label() {
        let brush = brush(960, 720);
        let [pad, inner] = [(None, 300.0), (Some(7), 60.0)]
            .map(|(id, size_px)| marker(id, Pixel::new(400.0, 200.0), size_px));
        let lines: Vec<usize> =
            brush.labels(&[pad, inner]).iter().map(|label| label.lines.len()).collect();
        assert_eq!(lines, [2, 2]);
    }

    #[test]
    fn letters_are_14_pixels_high_in_the_smallest_drawing() {
        let image = GrayImage::filled(900, 300, 80);
        let drawn = draw(image.view().unwrap(), &[], None);
        let is_in = |row: &&[u8]| row.chunks(3).any(|pixel| pixel == YELLOW);
        assert_eq!(drawn.data.chunks(900 * 3).filter(is_in).count(), 14);
    }

    #[test]
    fn the_lines_of_a_label_at_the_lower_edge_are_apart() {
        let seen = marker(None, Pixel::new(450.0, 590.0), 60.0);
        let image = GrayImage::filled(900, 600, 80);
        let drawn = draw(image.view().unwrap(), &[seen], None);
        let rows = |colour: Colour| {
            let is_in = |row: &[u8]| row.chunks(3).any(|pixel| pixel == colour);
            let rows: Vec<usize> =
                (0..600).filter(|y| is_in(&drawn.data[y * 2700..][..2700])).collect();
            (rows[0], rows[rows.len() - 1])
        };
        let [(_, name_ends), (place_begins, place_ends)] = [YELLOW, WHITE].map(rows);
        assert!(name_ends < place_begins && place_ends < 600, "{name_ends} {place_begins}");
    }
}
