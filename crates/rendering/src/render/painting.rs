//! Projects a drawing of shapes on a plane in the scene into the camera of one instant, and finds for a tile of
//! pixels whether it has one paint or edges.

use geometry::{Camera, CameraModel, Distortion, Marker, Ned, Point, Transform};

use super::exposure::Exposure;
use super::lens::{Lens, Linear};

/// A drawing on a plane in the scene.
#[derive(Clone, Debug)]
pub(super) struct Painting {
    pub(super) ned_from_plane: Transform<Ned, Marker>,
    /// Half the edge of the bounding square.
    pub(super) half_extent_m: f64,
    /// Depth of the box whose lid the square is.
    pub(super) thickness_m: f64,
    /// The shapes, bottom first.
    pub(super) coats: Vec<Coat>,
}

/// A shape and its paint.
#[derive(Copy, Clone, Debug)]
pub(super) struct Coat {
    pub(super) area: Area,
    pub(super) paint: Paint,
    /// The light of the coat beneath, for a coat whose outline may touch that coat's but never crosses it.
    pub(super) within: Option<f32>,
}

/// Coverage of the ground (0 none, 1 all), and reflectance of the cover.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct Paint {
    pub(super) cover: f32,
    pub(super) light: f32,
}

/// No paint.
pub(super) const BARE: Paint = Paint { cover: 0.0, light: 0.0 };

/// A shape in the plane.
#[derive(Copy, Clone, Debug)]
pub(super) enum Area {
    /// The visible part of the box: lid and sides.
    Box,
    /// A disc.
    Disc {
        /// Its centre.
        centre: [f64; 2],
        /// Its radius.
        radius: f64,
    },
    /// An upright rectangle between two corners.
    Rectangle([f64; 2], [f64; 2]),
}

/// An affine function of two coordinates: constant, per x, per y.
pub(super) type Affine = [f64; 3];

/// A painting seen from the camera of one instant.
#[derive(Clone, Debug)]
pub(super) struct Sight {
    /// The plane's homogeneous coordinates (x, y, w), each from ideal image coordinates; w is positive in
    /// front of the camera.
    plane_from_ideal: [Affine; 3],
    /// The box's outline on the plane of its lid: half-planes in which the functions are positive, the first
    /// four along its edges.
    outline: [Affine; 8],
    outline_len: usize,
}

impl Sight {
    /// `None` when the camera does not see the painted face.
    pub(super) fn new(
        painting: &Painting,
        ned_from_camera: &Transform<Ned, Camera>,
    ) -> Option<Self> {
        let plane_from_camera = painting.ned_from_plane.inverse() * *ned_from_camera;
        let eye = plane_from_camera.origin();
        if eye.z() < MIN_DISTANCE_M {
            return None;
        }
        let turn = plane_from_camera.isometry.rotation.to_rotation_matrix();
        // The ray along `direction` meets the plane at eye + direction * eye.z / -direction.z.
        let direction = |row: usize| [turn[(row, 2)], turn[(row, 0)], turn[(row, 1)]];
        let (dx, dy, dz) = (direction(0), direction(1), direction(2));
        let on_plane =
            |eye_along: f64, d: Affine| [0, 1, 2].map(|i| eye.z() * d[i] - eye_along * dz[i]);
        let plane_from_ideal = [on_plane(eye.x(), dx), on_plane(eye.y(), dy), dz.map(|d| -d)];
        let (outline, outline_len) = box_outline(painting, [eye.x(), eye.y(), eye.z()]);
        Some(Self { plane_from_ideal, outline, outline_len })
    }

    /// The plane's homogeneous coordinates from pixels about a tile's centre.
    pub(super) fn about(&self, lens: &Linear) -> [Affine; 3] {
        self.plane_from_ideal.map(|[one, x, y]| {
            let along = |d: [f64; 2]| x * d[0] + y * d[1];
            [one + along(lens.centre), along(lens.per_column), along(lens.per_row)]
        })
    }

    pub(super) fn outline(&self) -> &[Affine] {
        self.outline.get(..self.outline_len).unwrap_or(&[])
    }
}

/// Minimum distance of the camera from the painted plane, in metres.
const MIN_DISTANCE_M: f64 = 1e-3;

/// The half-planes that bound a box seen from `eye`: the hull of its lid and its bottom, the latter projected
/// onto the plane of the lid, where it is a smaller square.
fn box_outline(painting: &Painting, eye: [f64; 3]) -> ([Affine; 8], usize) {
    let half = painting.half_extent_m;
    let shrink = eye[2] / (eye[2] + painting.thickness_m.max(0.0));
    let bottom = |corner: f64, axis: usize| eye[axis] + (corner - eye[axis]) * shrink;
    let mut planes = [[0.0; 3]; 8];
    planes[0] = [half.max(bottom(half, 0)), -1.0, 0.0];
    planes[1] = [-(-half).min(bottom(-half, 0)), 1.0, 0.0];
    planes[2] = [half.max(bottom(half, 1)), 0.0, -1.0];
    planes[3] = [-(-half).min(bottom(-half, 1)), 0.0, 1.0];
    let mut len = 4;
    let corners = [(half, half), (-half, half), (-half, -half), (half, -half)];
    let lower = corners.map(|(x, y)| (bottom(x, 0), bottom(y, 1)));
    for (a, b) in corners.iter().zip(&lower) {
        let (nx, ny) = (a.1 - b.1, b.0 - a.0);
        let length = nx.hypot(ny);
        if length < 1e-9 {
            continue;
        }
        let line = [-(nx * a.0 + ny * a.1) / length, nx / length, ny / length];
        let side = |p: &(f64, f64)| line[0] + line[1] * p.0 + line[2] * p.1;
        let all = |sign: f64| corners.iter().chain(&lower).all(|p| sign * side(p) > -1e-12);
        if let Some(sign) = [1.0, -1.0].into_iter().find(|sign| all(*sign))
            && let Some(plane) = planes.get_mut(len)
        {
            *plane = line.map(|l| l * sign);
            len += 1;
        }
    }
    (planes, len)
}

/// The part of a painting in a tile.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) enum Shown {
    /// The same paint everywhere.
    Even(Paint),
    /// Coats whose outlines may cross the tile, on this paint.
    Edges(Paint),
}

/// A painting during an exposure.
#[derive(Debug)]
pub(super) struct View {
    /// At the opening, middle and closing of the shutter; `None` when the painting is not visible.
    pub(super) looks: Option<[Sight; 3]>,
    /// At each instant of the exposure.
    pub(super) sights: Vec<Sight>,
    /// First and last column and row that may show it.
    pub(super) columns: [usize; 2],
    pub(super) rows: [usize; 2],
}

impl View {
    /// Motion in the image of the point at a tile's centre during the exposure, in pixels.
    pub(super) fn motion_px(&self, lens: &Linear) -> [f64; 2] {
        let Some([first, middle, last]) = &self.looks else { return [0.0; 2] };
        let place = |sight: &Sight| {
            let [x, y, w] = sight.about(lens);
            [x[0] / w[0], y[0] / w[0]]
        };
        let (from, to) = (place(first), place(last));
        let [du, dv] = jacobian(&middle.about(lens));
        let (x, y) = (to[0] - from[0], to[1] - from[1]);
        let area = du[0] * dv[1] - du[1] * dv[0];
        let motion = [(x * dv[1] - y * dv[0]) / area, (y * du[0] - x * du[1]) / area];
        if motion.iter().all(|m| m.abs() < 1e3) { motion } else { [0.0; 2] }
    }
}

/// Derivatives of the point on the plane per column and per row of pixels, at a tile's centre.
pub(super) fn jacobian([x, y, w]: &[Affine; 3]) -> [[f64; 2]; 2] {
    let slope = |f: &Affine, axis: usize| (f[axis] * w[0] - f[0] * w[axis]) / (w[0] * w[0]);
    [1, 2].map(|axis| [slope(x, axis), slope(y, axis)])
}

/// First and last columns and rows of pixels.
pub(super) struct PixelBounds {
    pub(super) columns: [usize; 2],
    pub(super) rows: [usize; 2],
}

/// The pixels that may show a painting during an exposure; `None` when there are none.
pub(super) fn pixel_bounds(
    painting: &Painting,
    exposure: &Exposure,
    lens: &Lens,
    model: &CameraModel,
    reach: f64,
) -> Option<PixelBounds> {
    let last = [model.width, model.height].map(|edge| edge as usize - 1);
    let (ideal_min, ideal_max) = lens.field(reach + MAX_DEVIATION_PX);
    let (mut min, mut max) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut in_front = true;
    // Number of corners beyond the left, top, right and bottom edge of the view.
    let (mut beyond, mut corners) = ([0; 4], 0);
    for instant in exposure.ends.iter().chain(&exposure.instants) {
        let camera_from_plane = instant.inverse() * painting.ned_from_plane;
        let half = painting.half_extent_m;
        for corner in 0..8 {
            let side = |bit: u32| if corner >> bit & 1 == 0 { -half } else { half };
            let depth = if corner >> 2 & 1 == 0 { 0.0 } else { -painting.thickness_m };
            let point = camera_from_plane * Point::new(side(0), side(1), depth);
            let (place, z) = ([point.x(), point.y()], point.z());
            corners += 1;
            in_front &= z > 1e-3;
            for i in 0..2 {
                beyond[i] += usize::from(place[i] < ideal_min[i] * z);
                beyond[i + 2] += usize::from(place[i] > ideal_max[i] * z);
                min[i] = min[i].min(place[i] / z);
                max[i] = max[i].max(place[i] / z);
            }
        }
    }
    if beyond.contains(&corners) {
        return None;
    }
    // With a distorting lens the corners do not bound the points between them.
    if !in_front || model.distortion != Distortion::None {
        return Some(PixelBounds { columns: [0, last[0]], rows: [0, last[1]] });
    }
    let (focal, centre) = ([model.fx, model.fy], [model.cx, model.cy]);
    let bound = |i: usize| {
        let from = (min[i] * focal[i] + centre[i] - reach - MAX_DEVIATION_PX).max(0.0);
        let to = (max[i] * focal[i] + centre[i] + reach + MAX_DEVIATION_PX).min(last[i] as f64);
        (from <= to).then_some([from.floor() as usize, to.ceil() as usize])
    };
    Some(PixelBounds { columns: bound(0)?, rows: bound(1)? })
}

/// Maximum deviation of a corner from a straight path between the instants of an exposure, in pixels.
const MAX_DEVIATION_PX: f64 = 1.0;

/// The part of a painting in a window of half edge `half` around the lens's centre. The window must contain
/// all points from which the tile gets light. The coats with edges in it are put into `crossing`, top first.
pub(super) fn shown(
    painting: &Painting,
    looks: &[Sight; 3],
    lens: &Linear,
    half: f64,
    crossing: &mut Vec<Coat>,
) -> Shown {
    crossing.clear();
    let mut places = [[0.0; 2]; 12];
    for (places, sight) in places.chunks_exact_mut(4).zip(looks) {
        let [x, y, w] = sight.about(lens);
        let corners = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)];
        for (place, (du, dv)) in places.iter_mut().zip(corners) {
            let at = |f: Affine| f[0] + (f[1] * du + f[2] * dv) * half;
            if at(w) < 1e-6 {
                crossing.extend(painting.coats.iter().rev());
                return Shown::Edges(BARE);
            }
            *place = [at(x) / at(w), at(y) / at(w)];
        }
    }
    let around = Around::new(&places);
    let mut beneath = BARE;
    for coat in painting.coats.iter().rev() {
        match around.part(coat.area, looks) {
            Part::Outside => {}
            Part::Inside => {
                beneath = coat.paint;
                break;
            }
            Part::Crossed => crossing.push(*coat),
        }
    }
    if crossing.is_empty() { Shown::Even(beneath) } else { Shown::Edges(beneath) }
}

/// Points whose convex hull contains all that a tile sees of the plane.
struct Around<'a> {
    places: &'a [[f64; 2]],
    min: [f64; 2],
    max: [f64; 2],
}

enum Part {
    Outside,
    Inside,
    Crossed,
}

impl<'a> Around<'a> {
    fn new(places: &'a [[f64; 2]]) -> Self {
        let bound = |pick: fn(f64, f64) -> f64, start: f64| {
            [0, 1].map(|i| places.iter().fold(start, |b, p| pick(b, p[i])))
        };
        Self {
            places,
            min: bound(f64::min, f64::INFINITY),
            max: bound(f64::max, f64::NEG_INFINITY),
        }
    }

    fn part(&self, area: Area, looks: &[Sight; 3]) -> Part {
        let (outside, inside) = match area {
            Area::Disc { centre, radius } => {
                let beyond =
                    |i: usize| (self.min[i] - centre[i]).max(centre[i] - self.max[i]).max(0.0);
                let far = self
                    .places
                    .iter()
                    .all(|p| (p[0] - centre[0]).hypot(p[1] - centre[1]) <= radius);
                (beyond(0).hypot(beyond(1)) > radius, far)
            }
            Area::Rectangle(min, max) => {
                let beyond = |i: usize| self.min[i] > max[i] || self.max[i] < min[i];
                let within = |i: usize| self.min[i] >= min[i] && self.max[i] <= max[i];
                (beyond(0) || beyond(1), within(0) && within(1))
            }
            Area::Box => {
                let side = |f: &Affine, p: &[f64; 2]| f[0] + f[1] * p[0] + f[2] * p[1];
                let outside = (0..4).any(|k| {
                    looks.iter().all(|s| self.places.iter().all(|p| side(&s.outline[k], p) < 0.0))
                });
                let inside = looks.iter().all(|s| {
                    s.outline().iter().all(|f| self.places.iter().all(|p| side(f, p) >= 0.0))
                });
                (outside, inside)
            }
        };
        if outside {
            Part::Outside
        } else if inside {
            Part::Inside
        } else {
            Part::Crossed
        }
    }
}
