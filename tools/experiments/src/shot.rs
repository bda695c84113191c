//! One frame of a set: what is seen, by which camera, from where, through what; and how it is taken.

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

/// A frame to take.
#[derive(Clone, Debug)]
pub struct Shot {
    /// The group in its set whose frames are counted together.
    pub group: String,
    /// The marker, with its size; none in a picture without one.
    pub marker: Option<Marker>,
    /// Other things on the ground.
    pub clutter: Vec<PadInScene>,
    /// Whether black and white are swapped.
    pub inverted: bool,
    /// The camera and its setting.
    pub settings: CameraSettings,
    /// `camera_from_marker` from the opening to the closing of the shutter, of a rolling one from that of the first row to
    /// that of the last; of one pose when nothing moves. Without a marker, of the place where one would be.
    pub path: Vec<Transform<Camera, MarkerFrame>>,
    /// The ground.
    pub surface: Surface,
    /// Painted marks on the ground.
    pub painted_marks: u32,
    /// Light on the scene; 1 is full sun.
    pub light: f64,
    /// What happens to the light on its way.
    pub occluder: Occluder,
    /// Whether the sensor has colour filters, and grey is interpolated from them.
    pub bayer: bool,
    /// Chance.
    pub seed: u64,
}

/// What a shot shows, for whoever measures.
#[derive(Clone, Copy, Debug)]
pub struct Shown {
    /// The marker as seen by the camera half-way through the exposure, of a rolling shutter through that of the centre's row.
    pub camera_from_marker: Transform<Camera, MarkerFrame>,
    /// Where its centre appears.
    pub centre: Pixel,
    /// Where the corners of the square of its size appear: its own top left first, then clockwise on the print.
    pub corners: [Pixel; 4],
}

impl Shot {
    /// A marker on asphalt in full sun, seen from `camera_from_marker`.
    pub fn of(
        marker: Marker,
        settings: CameraSettings,
        camera_from_marker: Transform<Camera, MarkerFrame>,
        seed: u64,
    ) -> Self {
        Self {
            group: String::new(),
            marker: Some(marker),
            clutter: Vec::new(),
            inverted: false,
            settings,
            path: vec![camera_from_marker],
            surface: Surface::Asphalt,
            painted_marks: 20,
            light: 1.0,
            occluder: Occluder::None,
            bayer: false,
            seed,
        }
    }

    /// The place on the ground where the marker lies, or would lie.
    pub fn place(&self) -> Point<Ned> {
        pad(self).ned_from_marker.origin()
    }

    /// Where a place on the marker appears, and the pose by which it does: that half-way through the exposure of its row.
    fn seen(&self, place: Point<MarkerFrame>) -> Option<(Pixel, Transform<Camera, MarkerFrame>)> {
        const ROUNDS: usize = 8;
        let settings = &self.settings;
        let mut pose = *self.path.get(self.path.len() / 2)?;
        let mut pixel = settings.model.project(pose * place)?;
        if settings.readout_s > 0.0 {
            // Its row depends on the time, which depends on its row: a little less each round.
            for _ in 0..ROUNDS {
                pose = between(&self.path, settings.part_at_row(pixel.y, 0.5))?;
                pixel = settings.model.project(pose * place)?;
            }
        }
        Some((pixel, pose))
    }

    /// What it shows; `None` when the marker is not in front of the camera, or there is none.
    pub fn shown(&self) -> Option<Shown> {
        let half = self.marker?.size_m? / 2.0;
        let project = |x: f64, y: f64| self.seen(Point::new(x, y, 0.0)).map(|(pixel, _)| pixel);
        let (_, camera_from_marker) = self.seen(Point::origin())?;
        let corners = [
            project(-half, half)?,
            project(half, half)?,
            project(half, -half)?,
            project(-half, -half)?,
        ];
        Some(Shown { camera_from_marker, centre: project(0.0, 0.0)?, corners })
    }
}

/// `camera_from_marker` for a marker whose centre is seen at a pixel, at a distance along the optical axis. The print
/// is turned by `heading`, and then tilted by `tilt` about the direction `about` in the image (radians).
pub fn pose(
    model: &CameraModel,
    seen_at: Pixel,
    distance_m: f64,
    (tilt, about): (f64, f64),
    heading: f64,
) -> Transform<Camera, MarkerFrame> {
    let turn = |axis: Vector3<f64>, angle: f64| {
        Rotation3::from_axis_angle(&nalgebra::Unit::new_normalize(axis), angle)
    };
    let facing = turn(Vector3::x(), std::f64::consts::PI);
    let axis = Vector3::new(about.cos(), about.sin(), 0.0);
    let rotation = turn(axis, tilt) * facing * turn(Vector3::z(), heading);
    let ray = model.unproject(seen_at);
    Transform::new(
        Rotation::from_quaternion(UnitQuaternion::from_rotation_matrix(&rotation)),
        Point::new(ray.x() * distance_m, ray.y() * distance_m, distance_m),
    )
}

/// The pose at a part of a path, from 0 to 1.
fn between(
    path: &[Transform<Camera, MarkerFrame>],
    part: f64,
) -> Option<Transform<Camera, MarkerFrame>> {
    let along = part.clamp(0.0, 1.0) * path.len().saturating_sub(1) as f64;
    let index = (along.floor() as usize).min(path.len().saturating_sub(2));
    let (from, to) = (path.get(index)?, path.get(index + 1).or(path.get(index))?);
    let share = along - index as f64;
    let origin = from.origin() + (to.origin() - from.origin()) * share;
    Some(Transform::new(from.rotation().interpolate(&to.rotation(), share), origin))
}

/// Takes shots; it keeps the grounds, which take long to grow.
#[derive(Debug, Default)]
pub struct Studio {
    grounds: HashMap<(&'static str, u64), Arc<Ground>>,
}

/// Grounds of each kind.
const GROUNDS: u64 = 2;

impl Studio {
    /// The pixels of a shot, row by row.
    ///
    /// # Errors
    /// [`RenderError`] when the shot makes no sense.
    pub fn take(&mut self, shot: &Shot) -> Result<Vec<u8>, RenderError> {
        let key = (shot.surface.name(), shot.seed % GROUNDS);
        let ground = self.grounds.entry(key);
        let ground =
            Arc::clone(ground.or_insert_with(|| Arc::new(Ground::new(shot.surface, key.1))));
        let pad = pad(shot);
        let (ned_from_marker, body_from_camera) =
            (pad.ned_from_marker, shot.settings.body_from_camera);
        let mut pads = shot.clutter.clone();
        if shot.marker.is_some() {
            pads.push(pad);
        }
        let scene = Scene {
            surface: shot.surface,
            pads,
            painted_marks: shot.painted_marks,
            light: shot.light,
        };
        let mut renderer = Renderer::with_ground(ground, &scene, shot.settings.clone(), shot.seed)?;
        let poses: Vec<_> = shot
            .path
            .iter()
            .map(|pose| ned_from_marker * pose.inverse() * body_from_camera.inverse())
            .collect();
        let model = shot.settings.model;
        let mut pixels = vec![0; model.width as usize * model.height as usize];
        let mut apply = |v: usize, light: &mut [f32]| {
            shot.occluder.apply(v, light);
            if shot.bayer {
                filter_colours(v, light);
            }
        };
        renderer.render_through(&mut apply, &poses, shot.seed, &mut pixels)?;
        Ok(if shot.bayer { interpolated(&pixels, model.width as usize) } else { pixels })
    }
}

/// Where the pad lies on the ground: anywhere, so that no two frames have the same ground.
fn pad(shot: &Shot) -> PadInScene {
    let mut rng = ChaCha8Rng::seed_from_u64(shot.seed ^ 0x70_6164);
    let mut place = || rng.random_range(-20.0..20.0);
    let (north_m, east_m, heading) = (place(), place(), place());
    let marker = shot.marker.unwrap_or(Marker {
        family: markers::Family::Rings,
        id: None,
        size_m: Some(0.1),
    });
    let mut pad = PadInScene::flat(marker, north_m, east_m, heading);
    if shot.inverted {
        pad.drawing = inverted(&pad.drawing);
    }
    pad
}

/// A drawing with black and white swapped, that of its paper as well.
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

/// What red, green and blue filters let through of white light, before the camera's white balance.
const FILTERS: [f32; 3] = [0.6, 1.0, 0.75];

/// Red, green or blue (0, 1, 2) of a pixel of an RGGB mosaic.
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

/// Grey (0.299, 0.587, 0.114) from an RGGB mosaic whose colours are balanced and interpolated bilinearly.
fn interpolated(mosaic: &[u8], width: usize) -> Vec<u8> {
    let height = mosaic.len() / width.max(1);
    let at = |x: isize, y: isize| {
        // Mirrored at the border, which keeps the colours' order.
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

    fn shot() -> Shot {
        let settings = rendering::views::Binning::FourByFour.settings();
        let at = Pixel::new(200.0, 300.0);
        let pose = pose(&settings.model, at, 2.0, (0.3, 1.0), 0.5);
        Shot::of("apriltag-36h11:3:0.2".parse().unwrap(), settings, pose, 7)
    }

    #[test]
    fn a_marker_is_seen_where_it_is_put_and_faces_the_camera() {
        let shown = shot().shown().unwrap();
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
    fn a_shot_is_the_same_each_time_and_an_inverted_one_is_not() {
        let take = |shot: &Shot| Studio::default().take(shot).unwrap();
        assert_eq!(take(&shot()), take(&shot()));
        let swapped = Shot { inverted: true, ..shot() };
        assert_ne!(take(&shot()), take(&swapped));
    }

    #[test]
    fn grey_from_a_mosaic_is_the_grey_there_was() {
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
