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
        dot_px: (view.width() * enlarged / 640).clamp(1, 6),
    };
    brush.draw_image(view, enlarged);
    for seen in found {
        brush.outline(seen, camera);
    }
    for seen in found {
        brush.axes(seen, camera);
        brush.label(seen, found);
    }
    if found.is_empty() {
        brush.canvas.text([0.0, 0.0], "no marker", brush.dot_px, YELLOW);
    }
    brush.canvas
}

struct Brush {
    canvas: RgbImageBuf,
    scale: f64,
    /// Width of a dot of the font, in pixels of the drawing.
    dot_px: usize,
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
        self.dot_px as f64
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

    /// Draws name, confidence and position; next to other markers only as much as fits.
    fn label(&mut self, seen: &Observation, all: &[Observation]) {
        let id = seen.id.map_or_else(String::new, |id| format!(":{id}"));
        let wrong = match seen.wrong_bits {
            0 => String::new(),
            bits => format!("  {bits} wrong"),
        };
        let mut lines = vec![format!("{}{id}  {:.2}{wrong}", seen.family, seen.confidence)];
        if let Some(pose) = &seen.pose {
            let at = pose.camera_from_marker.origin();
            lines.push(format!("{:.3}, {:.3}, {:.3} {METRES}", at.x(), at.y(), at.z()));
        }
        let others = all.iter().filter(|other| other.centre != seen.centre);
        let room = others.map(|other| other.centre.distance(&seen.centre) * self.scale);
        let letters = room.fold(f64::INFINITY, f64::min) / (6.0 * self.dot_px as f64);
        if lines.iter().any(|line| line.len() as f64 > letters) {
            lines = vec![format!("{id} {:.2}", seen.confidence)];
            if lines.iter().any(|line| line.len() as f64 > letters) {
                lines = vec![id.trim_start_matches(':').to_owned()];
            }
        }
        let [x, y] = self.to_drawing(seen.centre);
        let reach = match seen.corners {
            Some(corners) => {
                corners.map(|c| self.to_drawing(c)[1] - y).into_iter().fold(0.0, f64::max)
            }
            None => seen.size_px * self.scale / 2.0,
        };
        let reach = if seen.size_px * self.scale < MIN_VISIBLE_PX { MIN_VISIBLE_PX } else { reach };
        let dot = self.dot_px as f64;
        // At the lower edge all lines move up together: moved one by one they would overlap.
        let lowest = self.canvas.height as f64 - LINE * dot * lines.len() as f64;
        let first = (y + reach + 4.0 * dot).min(lowest).max(0.0);
        for (index, text) in (0..).zip(&lines) {
            let left = x - 3.0 * dot * text.len() as f64;
            let top = first + LINE * dot * f64::from(index);
            let colour = if index == 0 { YELLOW } else { WHITE };
            self.canvas.text([left, top], text, self.dot_px, colour);
        }
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

    #[test]
    fn the_lines_of_a_label_at_the_lower_edge_are_apart() {
        let place = Transform::new(geometry::Rotation::identity(), Point::new(0.0, 0.1, 1.0));
        let pose = fiducial::MarkerPose {
            camera_from_marker: place,
            reprojection_rms_px: 0.1,
            covariance: nalgebra::Matrix6::identity(),
            alternative: None,
        };
        let seen = Observation {
            family: markers::Family::Rings,
            id: None,
            centre: Pixel::new(450.0, 590.0),
            centre_covariance_px2: nalgebra::Matrix2::identity(),
            corners: None,
            wrong_bits: 0,
            size_px: 60.0,
            confidence: 1.0,
            pose: Some(pose),
            response: None,
        };
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
