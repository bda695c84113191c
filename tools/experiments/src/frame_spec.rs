//! Specifies and renders one frame of the marker experiment: marker or clutter, camera and path of poses, surface, light,
//! occluder, print and binning, with centre, corners and pose as truth.

use std::collections::HashMap;
use std::sync::Arc;

use geometry::{
    Camera, CameraModel, Marker as MarkerFrame, Ned, Pixel, Point, Rotation, Transform,
};
use markers::{Drawing, Ink, Layer, Marker, Shape};
use nalgebra::{Rotation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rendering::ground::Ground;
use rendering::{CameraSettings, PadInScene, RenderError, Renderer, Scene, Surface};

use rendering::occluder::Occluder;

use crate::print::Print;

/// A frame to render.
#[derive(Clone, Debug)]
pub struct FrameSpec {
    /// The group in its set that is scored together.
    pub group: String,
    /// The marker with its size; `None` in a negative.
    pub marker: Option<Marker>,
    /// Other objects on the ground.
    pub clutter: Vec<PadInScene>,
    /// Whether black and white are swapped.
    pub inverted: bool,
    /// The camera.
    pub settings: CameraSettings,
    /// `camera_from_marker` from the opening to the closing of the shutter (with a rolling shutter from the
    /// opening in the first row to the closing in the last); one pose without motion. In a negative, of the
    /// position of a marker.
    pub path: Vec<Transform<Camera, MarkerFrame>>,
    /// The ground.
    pub surface: Surface,
    /// Painted marks on the ground.
    pub painted_marks: u32,
    /// Light on the scene; 1 is full sun.
    pub light: f64,
    /// Objects between scene and camera.
    pub occluder: Occluder,
    /// How the marker is printed.
    pub print: Print,
    /// Whether grey is interpolated from a Bayer mosaic.
    pub bayer: bool,
    /// The frame is binned by software: each of its pixels is the mean of so many of a sensor with a Bayer mosaic, across and down;
    /// 1 for a camera that bins on its own or not at all. Camera and truth are those of the binned frame.
    pub binned: u32,
    /// Seed of the random generators.
    pub seed: u64,
}

/// Where the marker of a frame is.
#[derive(Clone, Copy, Debug)]
pub struct GroundTruth {
    /// The marker in the camera frame at mid-exposure (with a rolling shutter, of the row of its centre).
    pub camera_from_marker: Transform<Camera, MarkerFrame>,
    /// The pixel of its centre.
    pub centre: Pixel,
    /// The pixels of the corners of the square of its size: its own top left first, then clockwise on the
    /// print.
    pub corners: [Pixel; 4],
}

impl FrameSpec {
    /// A marker on asphalt in full sun, seen from `camera_from_marker`.
    pub fn new(
        marker: Marker,
        settings: CameraSettings,
        camera_from_marker: Transform<Camera, MarkerFrame>,
        seed: u64,
    ) -> Self {
        Self { marker: Some(marker), ..Self::negative(settings, camera_from_marker, seed) }
    }

    /// The same without a marker, whose position is seen from `camera_from_place`.
    pub fn negative(
        settings: CameraSettings,
        camera_from_place: Transform<Camera, MarkerFrame>,
        seed: u64,
    ) -> Self {
        Self {
            group: String::new(),
            marker: None,
            clutter: Vec::new(),
            inverted: false,
            settings,
            path: vec![camera_from_place],
            surface: Surface::Asphalt,
            painted_marks: 20,
            light: 1.0,
            occluder: Occluder::None,
            print: Print::Sharp,
            bayer: false,
            binned: 1,
            seed,
        }
    }

    /// The position of the marker on the ground, in a negative its intended position.
    pub fn place(&self) -> Point<Ned> {
        pad(self).ned_from_marker.origin()
    }

    /// The pixel of a point on the marker, and the pose at mid-exposure of its row.
    fn seen(&self, place: Point<MarkerFrame>) -> Option<(Pixel, Transform<Camera, MarkerFrame>)> {
        const ROUNDS: usize = 8;
        let settings = &self.settings;
        let mut pose = *self.path.get(self.path.len() / 2)?;
        let mut pixel = settings.model.project(pose * place)?;
        if settings.readout_s > 0.0 {
            // The row depends on the time, and the time on the row: a fixed-point iteration.
            for _ in 0..ROUNDS {
                pose = between(&self.path, settings.part_at_row(pixel.y, 0.5))?;
                pixel = settings.model.project(pose * place)?;
            }
        }
        Some((pixel, pose))
    }

    /// The ground truth; `None` without a marker, or when it is not in front of the camera.
    pub fn ground_truth(&self) -> Option<GroundTruth> {
        let half = self.marker?.size_m? / 2.0;
        let project = |x: f64, y: f64| self.seen(Point::new(x, y, 0.0)).map(|(pixel, _)| pixel);
        let (_, camera_from_marker) = self.seen(Point::origin())?;
        let corners = [
            project(-half, half)?,
            project(half, half)?,
            project(half, -half)?,
            project(-half, -half)?,
        ];
        Some(GroundTruth { camera_from_marker, centre: project(0.0, 0.0)?, corners })
    }

    /// Whether the marker's square (for rings, that about the outer circle) is inside the frame.
    pub(crate) fn is_whole(&self) -> bool {
        self.ground_truth().is_some_and(|shown| {
            shown.corners.iter().all(|corner| self.settings.model.contains(*corner))
        })
    }

    /// The longest side of the marker's square in the image, in pixels.
    pub(crate) fn size_px(&self) -> f64 {
        self.ground_truth().map_or(0.0, |shown| {
            let [a, b, c, d] = shown.corners;
            [a.distance(&b), b.distance(&c), c.distance(&d), d.distance(&a)]
                .into_iter()
                .fold(0.0, f64::max)
        })
    }

    pub(crate) fn with(mut self, group: impl Into<String>, occluder: Occluder) -> Self {
        self.group = group.into();
        self.occluder = occluder;
        self
    }
}

/// A tilt of the marker against the image plane.
#[derive(Clone, Copy, Debug)]
pub struct Tilt {
    /// The angle, in radians.
    pub angle: f64,
    /// The direction of its axis in the image, in radians.
    pub about: f64,
}

impl Tilt {
    /// No tilt.
    pub const NONE: Self = Self { angle: 0.0, about: 0.0 };
}

/// `camera_from_marker` for a marker with its centre at a pixel, at a distance along the optical axis,
/// rotated by `heading` (radians) in its plane and then tilted.
pub fn pose(
    model: &CameraModel,
    seen_at: Pixel,
    distance_m: f64,
    tilt: Tilt,
    heading: f64,
) -> Transform<Camera, MarkerFrame> {
    let turn = |axis: Vector3<f64>, angle: f64| {
        Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(axis), angle)
    };
    let facing = turn(Vector3::x(), std::f64::consts::PI);
    let axis = Vector3::new(tilt.about.cos(), tilt.about.sin(), 0.0);
    let rotation = turn(axis, tilt.angle) * facing * turn(Vector3::z(), heading);
    let ray = model.unproject_clamped(seen_at);
    Transform::new(
        Rotation::from_quaternion(UnitQuaternion::from_rotation_matrix(&rotation)),
        Point::new(ray.x() * distance_m, ray.y() * distance_m, distance_m),
    )
}

/// The interpolated pose at a fraction of a path.
fn between(
    path: &[Transform<Camera, MarkerFrame>],
    part: f64,
) -> Option<Transform<Camera, MarkerFrame>> {
    let along = part.clamp(0.0, 1.0) * path.len().saturating_sub(1) as f64;
    let index = (along.floor() as usize).min(path.len().saturating_sub(2));
    let (from, to) = (path.get(index)?, path.get(index + 1).or(path.get(index))?);
    let fraction = along - index as f64;
    let origin = from.origin() + (to.origin() - from.origin()) * fraction;
    Some(Transform::new(from.rotation().interpolate(&to.rotation(), fraction), origin))
}

/// Pictures of a video before the frame: a key frame, and one that is predicted from it, as the frame is from that.
const EARLIER_PICTURES: u32 = 2;

/// A pose some pictures earlier, of a camera that comes down past the marker: by 3 in 1000 of its height, and by two pixels.
fn earlier(
    pose: &Transform<Camera, MarkerFrame>,
    model: &CameraModel,
    back: u32,
) -> Transform<Camera, MarkerFrame> {
    const STEP_PX: [f64; 2] = [1.7, -0.9];
    const STEP_DOWN: f64 = 0.003;
    let (at, back) = (pose.origin(), f64::from(back));
    let per_px = [at.z() / model.fx, at.z() / model.fy];
    let place = Point::new(
        at.x() + back * STEP_PX[0] * per_px[0],
        at.y() + back * STEP_PX[1] * per_px[1],
        at.z() * (1.0 + back * STEP_DOWN),
    );
    Transform::new(pose.rotation(), place)
}

/// Renders frames. It keeps the grounds, which take long to generate.
#[derive(Debug, Default)]
pub struct FrameRenderer {
    grounds: HashMap<(&'static str, u64), Arc<Ground>>,
}

/// Number of grounds of each surface.
const GROUNDS: u64 = 2;

impl FrameRenderer {
    /// The pixels of a frame, row by row.
    ///
    /// # Errors
    /// [`RenderError`] when the specification is invalid.
    pub fn render(&mut self, spec: &FrameSpec) -> Result<Vec<u8>, RenderError> {
        let key = (spec.surface.name(), spec.seed % GROUNDS);
        let ground = self.grounds.entry(key);
        let ground =
            Arc::clone(ground.or_insert_with(|| Arc::new(Ground::new(spec.surface, key.1))));
        let pad = pad(spec);
        let (ned_from_marker, body_from_camera) =
            (pad.ned_from_marker, spec.settings.body_from_camera);
        let mut pads = spec.clutter.clone();
        if spec.marker.is_some() {
            pads.extend(spec.print.pieces(pad));
        }
        let scene = Scene {
            surface: spec.surface,
            pads,
            painted_marks: spec.painted_marks,
            light: spec.light,
        };
        let settings = sensor(&spec.settings, spec.binned);
        let model = settings.model;
        let is_mosaic = spec.bayer || spec.binned > 1;
        let mut renderer = Renderer::with_ground(ground, &scene, settings, spec.seed)?;
        let mut pixels = vec![0; model.width as usize * model.height as usize];
        let mut apply = |v: usize, light: &mut [f32]| {
            spec.occluder.apply(v, light);
            if is_mosaic {
                filter_colours(v, light);
            }
        };
        let is_video = spec.settings.processing.video.is_some();
        for back in (0..=if is_video { EARLIER_PICTURES } else { 0 }).rev() {
            let body_pose = |pose: &Transform<Camera, MarkerFrame>| {
                ned_from_marker
                    * earlier(pose, &spec.settings.model, back).inverse()
                    * body_from_camera.inverse()
            };
            let poses: Vec<_> = spec.path.iter().map(body_pose).collect();
            let seed = spec.seed.wrapping_sub(u64::from(back));
            renderer.render_through(&mut apply, &poses, seed, &mut pixels)?;
        }
        if spec.binned > 1 {
            let size = [model.width as usize, model.height as usize];
            let frame = &spec.settings.model;
            let mut binned = vec![0; frame.width as usize * frame.height as usize];
            // The size is a multiple of the binning.
            imaging::bin(&pixels, size, 8, spec.binned as usize, &mut binned)
                .map_err(|_cause| RenderError::Setting("a frame without a pixel"))?;
            return Ok(binned);
        }
        Ok(if spec.bayer { interpolated(&pixels, model.width as usize) } else { pixels })
    }
}

/// The sensor whose pixels make those of a binned frame: as many smaller ones, each with its part of the light and of the well.
fn sensor(frame: &CameraSettings, binned: u32) -> CameraSettings {
    let n = f64::from(binned);
    let CameraModel { width, height, fx, fy, cx, cy, distortion } = frame.model;
    let centre = |at: f64| n * at + (n - 1.0) / 2.0;
    CameraSettings {
        model: CameraModel {
            width: binned * width,
            height: binned * height,
            fx: n * fx,
            fy: n * fy,
            cx: centre(cx),
            cy: centre(cy),
            distortion,
        },
        electrons_per_s: frame.electrons_per_s / (n * n),
        full_well_e: frame.full_well_e / (n * n),
        read_noise_e: frame.read_noise_e / n,
        blur_px: n * frame.blur_px,
        ..frame.clone()
    }
}

/// The pad at a random position, so that frames have different ground.
fn pad(spec: &FrameSpec) -> PadInScene {
    let mut rng = ChaCha8Rng::seed_from_u64(spec.seed ^ 0x70_6164);
    let mut place = || rng.random_range(-20.0..20.0);
    let (north_m, east_m, heading) = (place(), place(), place());
    let marker = spec.marker.unwrap_or(Marker {
        family: markers::Family::Rings,
        id: None,
        size_m: Some(0.1),
    });
    let mut pad = PadInScene::flat(marker, north_m, east_m, heading);
    if spec.inverted {
        pad.drawing = inverted(&pad.drawing);
    }
    pad
}

/// A drawing with black and white swapped, including its paper.
fn inverted(drawing: &Drawing) -> Drawing {
    let half = drawing.half_extent_m;
    let paper =
        Layer { shape: Shape::Rectangle { min_m: [-half; 2], max_m: [half; 2] }, ink: Ink::Black };
    let swapped = drawing.layers.iter().map(|layer| Layer {
        ink: match layer.ink {
            Ink::Black => Ink::White,
            Ink::White => Ink::Black,
        },
        ..*layer
    });
    Drawing { half_extent_m: half, layers: std::iter::once(paper).chain(swapped).collect() }
}

/// Transmission of white light by the red, green and blue filters, before white balance.
const FILTERS: [f32; 3] = [0.6, 1.0, 0.75];

/// The colour of a pixel of an RGGB mosaic: red, green or blue (0, 1, 2).
fn colour(x: usize, y: usize) -> usize {
    match (x % 2, y % 2) {
        (0, 0) => 0,
        (1, 1) => 2,
        _ => 1,
    }
}

fn filter_colours(v: usize, light: &mut [f32]) {
    for (x, level) in light.iter_mut().enumerate() {
        *level *= FILTERS[colour(x, v)];
    }
}

/// Grey (0.299, 0.587, 0.114) from an RGGB mosaic by white balance and bilinear interpolation.
fn interpolated(mosaic: &[u8], width: usize) -> Vec<u8> {
    let height = mosaic.len() / width.max(1);
    let at = |x: isize, y: isize| {
        // Mirrored at the border, which preserves the pattern.
        let mirror = |place: isize, edge: usize| {
            let last = edge as isize - 1;
            (if place < 0 {
                -place
            } else if place > last {
                2 * last - place
            } else {
                place
            }) as usize
        };
        let (x, y) = (mirror(x, width), mirror(y, height));
        f32::from(mosaic.get(y * width + x).copied().unwrap_or(0)) / FILTERS[colour(x, y)]
    };
    let mut grey = Vec::with_capacity(mosaic.len());
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        let own = colour(x, y);
        let (x, y) = (x as isize, y as isize);
        let cross = (at(x - 1, y) + at(x + 1, y) + at(x, y - 1) + at(x, y + 1)) / 4.0;
        let diagonal =
            (at(x - 1, y - 1) + at(x + 1, y - 1) + at(x - 1, y + 1) + at(x + 1, y + 1)) / 4.0;
        let (sides, above) =
            ((at(x - 1, y) + at(x + 1, y)) / 2.0, (at(x, y - 1) + at(x, y + 1)) / 2.0);
        let [red, green, blue] = match own {
            0 => [at(x, y), cross, diagonal],
            2 => [diagonal, cross, at(x, y)],
            _ if y % 2 == 0 => [sides, at(x, y), above],
            _ => [above, at(x, y), sides],
        };
        grey.push((0.299 * red + 0.587 * green + 0.114 * blue + 0.5).clamp(0.0, 255.0) as u8);
    }
    grey
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec() -> FrameSpec {
        let settings = rendering::views::Binning::FourByFour.settings();
        let at = Pixel::new(200.0, 300.0);
        let pose = pose(&settings.model, at, 2.0, Tilt { angle: 0.3, about: 1.0 }, 0.5);
        FrameSpec::new("apriltag-36h11:3:0.2".parse().unwrap(), settings, pose, 7)
    }

    #[test]
    fn a_marker_is_at_its_pixel_and_faces_the_camera() {
        let shown = spec().ground_truth().unwrap();
        assert!(shown.centre.distance(&Pixel::new(200.0, 300.0)) < 1e-9);
        assert!((shown.camera_from_marker.origin().z() - 2.0).abs() < 1e-12);
        // Clockwise in the image, whose y axis points down: the area is positive.
        let corners = shown.corners;
        let area: f64 = (0..4)
            .map(|k| (corners[k], corners[(k + 1) % 4]))
            .map(|(a, b)| (a.x * b.y - b.x * a.y) / 2.0)
            .sum();
        assert!(area > 0.0, "{area}");
    }

    #[test]
    fn rendering_is_repeatable_and_inverted_frames_differ() {
        let render = |spec: &FrameSpec| FrameRenderer::default().render(spec).unwrap();
        assert_eq!(render(&spec()), render(&spec()));
        let swapped = FrameSpec { inverted: true, ..spec() };
        assert_ne!(render(&spec()), render(&swapped));
    }

    #[test]
    fn a_binned_frame_shows_the_marker_where_an_unbinned_one_shows_it() {
        let own = FrameSpec { painted_marks: 0, ..spec() };
        let size = own.settings.model.width as usize;
        let centre = |pixels: &[u8]| {
            // The centre of the dark pixels around the marker's pixel.
            let [mut sum, mut x, mut y] = [0.0; 3];
            for (v, u) in (260..340).flat_map(|v| (160..240).map(move |u| (v, u))) {
                let dark = (200.0 - f64::from(pixels[v * size + u])).max(0.0);
                (sum, x, y) = (sum + dark, x + dark * u as f64, y + dark * v as f64);
            }
            Pixel::new(x / sum, y / sum)
        };
        let raw = FrameSpec { binned: 4, ..own.clone() };
        let frames = [own, raw].map(|spec| FrameRenderer::default().render(&spec).unwrap());
        assert_eq!(frames[0].len(), frames[1].len());
        // The colours' filters take a sixth of the light.
        let brighter = frames[1].iter().map(|p| (f64::from(*p) / 0.8375).min(255.0) as u8);
        let brighter: Vec<u8> = brighter.collect();
        let apart = centre(&frames[0]).distance(&centre(&brighter));
        assert!(apart < 0.3, "{apart} px");
    }

    #[test]
    fn a_grey_scene_stays_grey_through_the_mosaic() {
        let mut levels = [120.0f32; 8];
        let mosaic: Vec<u8> = (0..6)
            .flat_map(|v| {
                levels.fill(120.0);
                filter_colours(v, &mut levels);
                levels.map(|level| level as u8)
            })
            .collect();
        assert!(interpolated(&mosaic, 8).iter().all(|grey| grey.abs_diff(120) <= 1));
    }
}
