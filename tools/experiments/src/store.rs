//! Stores sets on disk, `FOLDER/SET/FAMILY/`: a PNG file per frame, and a line of JSON per frame in `truth.jsonl`.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::Context;
use geometry::{CameraModel, Distortion, Pixel, Point, Rotation, Transform};
use image::codecs::png::{CompressionType, FilterType, PngEncoder};
use image::{ExtendedColorType, ImageEncoder};
use markers::Marker;
use serde::{Deserialize, Serialize};

use crate::frame_spec::{FrameRenderer, FrameSpec};
use crate::set::Set;
use crate::sets::{self, Variant};

/// The file with the ground truth of the frames next to it.
pub const TRUTH: &str = "truth.jsonl";

/// The file with the version that rendered the frames next to it.
pub const RENDERED_BY: &str = "rendered-by.txt";

/// A frame with its ground truth.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StoredFrame {
    /// Its file, in the same folder.
    pub image: String,
    /// The set.
    pub set: String,
    /// The group of the set.
    pub group: String,
    /// The camera.
    pub camera: CameraLine,
    /// The marker; `None` in a negative.
    pub marker: Option<MarkerLine>,
}

/// A camera with the parameters of OpenCV.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CameraLine {
    /// Image width in pixels.
    pub width: u32,
    /// Image height in pixels.
    pub height: u32,
    /// Focal lengths in pixels.
    pub fx: f64,
    /// Focal lengths in pixels.
    pub fy: f64,
    /// Principal point in pixels.
    pub cx: f64,
    /// Principal point in pixels.
    pub cy: f64,
    /// k1, k2, p1, p2, k3, k4, k5, k6 of Brown and Conrady; empty for a pinhole.
    pub distortion: Vec<f64>,
}

/// A marker and its pose.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MarkerLine {
    /// Its family.
    pub family: String,
    /// Its id.
    pub id: Option<u32>,
    /// Its size in metres.
    pub size_m: f64,
    /// The pixel of its centre.
    pub centre_px: [f64; 2],
    /// The pixels of its corners, its own top left first, then clockwise; for rings of the square about the
    /// outer circle.
    pub corners_px: [[f64; 2]; 4],
    /// Its longest side in the image.
    pub size_px: f64,
    /// Whether its square is inside the frame.
    pub is_whole: bool,
    /// Its position in the camera frame.
    pub translation_m: [f64; 3],
    /// Its orientation in the camera frame.
    pub rotation_wxyz: [f64; 4],
}

#[cfg(test)]
impl CameraLine {
    /// A tiny pinhole camera.
    pub fn sample() -> Self {
        let (width, height, distortion) = (8, 8, Vec::new());
        Self { width, height, fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0, distortion }
    }
}

#[cfg(test)]
impl MarkerLine {
    /// A marker of 0.1 m, a metre in front of the camera.
    pub fn sample(family: &str) -> Self {
        Self {
            family: family.to_owned(),
            id: None,
            size_m: 0.1,
            centre_px: [0.0; 2],
            corners_px: [[0.0; 2]; 4],
            size_px: 20.0,
            is_whole: true,
            translation_m: [0.0, 0.0, 1.0],
            rotation_wxyz: [1.0, 0.0, 0.0, 0.0],
        }
    }
}

impl CameraLine {
    fn new(model: &CameraModel) -> Self {
        let CameraModel { width, height, fx, fy, cx, cy, distortion } = *model;
        let distortion = match distortion {
            Distortion::BrownConrady(k) => k.to_vec(),
            _ => Vec::new(),
        };
        Self { width, height, fx, fy, cx, cy, distortion }
    }

    /// The camera's model.
    pub fn model(&self) -> CameraModel {
        let Self { width, height, fx, fy, cx, cy, .. } = *self;
        let distortion = match <[f64; 8]>::try_from(self.distortion.as_slice()) {
            Ok(k) => Distortion::BrownConrady(k),
            Err(_) => Distortion::None,
        };
        CameraModel { width, height, fx, fy, cx, cy, distortion }
    }
}

impl MarkerLine {
    fn new(spec: &FrameSpec) -> Option<Self> {
        let (marker, shown) = (spec.marker?, spec.ground_truth()?);
        let pixel = |p: Pixel| [p.x, p.y];
        let origin = shown.camera_from_marker.origin();
        Some(Self {
            family: marker.family.name().to_owned(),
            id: marker.id,
            size_m: marker.size_m?,
            centre_px: pixel(shown.centre),
            corners_px: shown.corners.map(pixel),
            size_px: spec.size_px(),
            is_whole: spec.is_whole(),
            translation_m: [origin.x(), origin.y(), origin.z()],
            rotation_wxyz: shown.camera_from_marker.rotation().wxyz(),
        })
    }

    /// The pose in the camera frame; `None` when the rotation is invalid.
    pub fn camera_from_marker(&self) -> Option<Transform<geometry::Camera, geometry::Marker>> {
        let [x, y, z] = self.translation_m;
        Some(Transform::new(Rotation::from_wxyz(self.rotation_wxyz)?, Point::new(x, y, z)))
    }
}

/// The folder of a set with one marker.
pub fn folder(root: &Path, set: Set, marker: Marker) -> PathBuf {
    let root = root.join(set.name());
    if set.has_marker() { root.join(marker.family.name()) } else { root }
}

/// Renders a set with one marker if it is missing; returns its number of frames.
///
/// # Errors
/// When a file cannot be written.
pub fn make(
    root: &Path,
    set: Set,
    marker: Marker,
    variant: Variant,
    renderer: &mut FrameRenderer,
) -> anyhow::Result<usize> {
    let folder = folder(root, set, marker);
    let truth = folder.join(TRUTH);
    if let Ok(text) = std::fs::read_to_string(&truth) {
        return Ok(text.lines().count());
    }
    std::fs::create_dir_all(&folder).with_context(|| format!("making {}", folder.display()))?;
    // Renamed when it is complete.
    let unfinished = folder.join("truth.unfinished");
    let mut lines = BufWriter::new(File::create(&unfinished)?);
    let specs = sets::frames_of(set, marker, variant);
    for (index, spec) in specs.iter().enumerate() {
        let image = format!("{index:04}-{}.png", spec.group);
        let pixels = renderer.render(spec)?;
        let camera = CameraLine::new(&spec.settings.model);
        write_png(&folder.join(&image), &pixels, &camera)?;
        let frame = StoredFrame {
            image,
            set: set.name().to_owned(),
            group: spec.group.clone(),
            camera,
            marker: MarkerLine::new(spec),
        };
        serde_json::to_writer(&mut lines, &frame)?;
        lines.write_all(b"\n")?;
    }
    lines.flush()?;
    std::fs::write(folder.join(RENDERED_BY), node::version())?;
    std::fs::rename(&unfinished, &truth)?;
    Ok(specs.len())
}

/// The version that rendered the frames of a folder.
pub fn rendered_by(folder: &Path) -> String {
    let version = std::fs::read_to_string(folder.join(RENDERED_BY));
    version.map_or_else(|_| "of an unknown version".to_owned(), |it| it.trim().to_owned())
}

fn write_png(path: &Path, pixels: &[u8], camera: &CameraLine) -> anyhow::Result<()> {
    let file = BufWriter::new(File::create(path)?);
    PngEncoder::new_with_quality(file, CompressionType::Fast, FilterType::Up)
        .write_image(pixels, camera.width, camera.height, ExtendedColorType::L8)
        .with_context(|| format!("writing {}", path.display()))
}

/// The frames of a folder.
///
/// # Errors
/// When the truth is missing or damaged.
pub fn frames(folder: &Path) -> anyhow::Result<Vec<StoredFrame>> {
    let path = folder.join(TRUTH);
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
    text.lines()
        .map(|line| serde_json::from_str(line).with_context(|| path.display().to_string()))
        .collect()
}
