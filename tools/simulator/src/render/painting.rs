//! Flat vector drawings in the scene, and how they appear: every shape's exact outline, averaged over the area of a
//! pixel, the lens's blur and the exposure.
//!
//! A square tile of pixels that lies wholly in one ink is one number. In any other, each shape covers subsamples by
//! its distance from them along its own gradient, and the subsamples are weighted with the blur.

use geometry::{Camera, Marker, Ned, Transform};

use super::lens::{Blur, Lens, Linear};

/// A drawing on a plane in the scene.
#[derive(Clone, Debug)]
pub(super) struct Painting {
    pub(super) ned_from_plane: Transform<Ned, Marker>,
    /// Half the edge of the square that holds everything.
    pub(super) half_extent_m: f64,
    /// Depth of the box whose lid the square is.
    pub(super) thickness_m: f64,
    /// What is painted, bottom first.
    pub(super) coats: Vec<Coat>,
}

/// A shape and what comes back from it.
#[derive(Copy, Clone, Debug)]
pub(super) struct Coat {
    pub(super) area: Area,
    pub(super) paint: Paint,
    /// The light of the coat beneath, for a coat whose outline may coincide with that coat's and never crosses it.
    pub(super) within: Option<f32>,
}

/// How much of the ground is covered (1 all, 0 none), and the light that comes back from the cover.
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
    /// All of the box that can be seen: lid and sides.
    Box,
    /// A disc about the origin.
    Disc(f64),
    /// An upright rectangle between two corners.
    Rectangle([f64; 2], [f64; 2]),
}

/// Three numbers that make a function linear in two coordinates: constant, per x, per y.
type Affine = [f64; 3];

/// A painting from one instant's camera.
#[derive(Clone, Debug)]
pub(super) struct Sight {
    /// The plane's homogeneous coordinates (x, y, w), each from ideal image coordinates; w is positive in front of
    /// the camera.
    plane_from_ideal: [Affine; 3],
    /// The box's outline on the plane of its lid: half-planes in which the functions are positive, the first four
    /// along its edges.
    outline: [Affine; 8],
    outline_len: usize,
}

impl Sight {
    /// `None` when the camera does not look at the painted face.
    pub(super) fn new(
        painting: &Painting,
        ned_from_camera: &Transform<Ned, Camera>,
    ) -> Option<Self> {
        let plane_from_camera = painting.ned_from_plane.inverse() * *ned_from_camera;
        let eye = plane_from_camera.origin();
        if eye.z() < CLOSEST_M {
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
    fn about(&self, lens: &Linear) -> [Affine; 3] {
        self.plane_from_ideal.map(|[one, x, y]| {
            let along = |d: [f64; 2]| x * d[0] + y * d[1];
            [one + along(lens.centre), along(lens.per_column), along(lens.per_row)]
        })
    }

    fn outline(&self) -> &[Affine] {
        self.outline.get(..self.outline_len).unwrap_or(&[])
    }
}

/// A camera nearer to the painted plane than this sees nothing of it.
const CLOSEST_M: f64 = 1e-3;

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

/// What a tile shows of a painting.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) enum Shown {
    /// The same paint all over.
    Even(Paint),
    /// Coats whose outlines may cross the tile, on this paint.
    Edges(Paint),
}

/// Sights looked at to tell what a tile shows; those between them lie between.
const MOST_LOOKS: usize = 3;

/// What a window of `half` its edge about the lens's centre shows of a painting; it must contain all that light may
/// come from. The coats with edges in it are put into `crossing`, top first.
pub(super) fn shown(
    painting: &Painting,
    sights: &[Sight],
    lens: &Linear,
    half: f64,
    crossing: &mut Vec<Coat>,
) -> Shown {
    crossing.clear();
    let mut places = [[0.0; 2]; 4 * MOST_LOOKS];
    let mut count = 0;
    let looks = sights.len().min(MOST_LOOKS);
    for look in 0..looks {
        let Some(sight) = sights.get(look * (sights.len() - 1) / (looks - 1).max(1)) else {
            continue;
        };
        let [x, y, w] = sight.about(lens);
        for (du, dv) in [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)] {
            let at = |f: Affine| f[0] + (f[1] * du + f[2] * dv) * half;
            if at(w) < 1e-6 {
                crossing.extend(painting.coats.iter().rev());
                return Shown::Edges(BARE);
            }
            if let Some(place) = places.get_mut(count) {
                *place = [at(x) / at(w), at(y) / at(w)];
                count += 1;
            }
        }
    }
    let places = places.get(..count).unwrap_or(&[]);
    let around = Around::new(places);
    let mut beneath = BARE;
    for coat in painting.coats.iter().rev() {
        match around.part(coat.area, sights) {
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

/// Places whose hull holds all that a tile sees of the plane.
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

    fn part(&self, area: Area, sights: &[Sight]) -> Part {
        let (outside, inside) = match area {
            Area::Disc(radius) => {
                let beyond = |i: usize| self.min[i].max(-self.max[i]).max(0.0);
                let far = self.places.iter().all(|p| p[0].hypot(p[1]) <= radius);
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
                    sights.iter().all(|s| self.places.iter().all(|p| side(&s.outline[k], p) < 0.0))
                });
                let inside = sights.iter().all(|s| {
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

/// Paints tiles.
#[derive(Debug)]
pub(super) struct Painter {
    tile: usize,
    /// From coarse to fine subsamples.
    blurs: [Blur; 3],
    /// Of the row of subsamples being painted.
    cover: Vec<f32>,
    paint: Channels,
    /// Sums over the instants, subsample by subsample.
    sums: Channels,
    /// Rows of pixels by columns of subsamples.
    rows: Vec<f32>,
    /// The painted tile, pixel by pixel.
    pub(super) tile_paint: Channels,
    offsets: Vec<f32>,
}

/// Cover and light, place by place.
#[derive(Debug, Default)]
pub(super) struct Channels {
    pub(super) cover: Vec<f32>,
    pub(super) light: Vec<f32>,
}

impl Channels {
    pub(super) fn new(len: usize) -> Self {
        Self { cover: vec![0.0; len], light: vec![0.0; len] }
    }
}

/// The finest subsamples to a pixel.
const FINEST: usize = 8;

impl Painter {
    pub(super) fn new(lens: &Lens, blur_px: f64) -> Self {
        let blurs = [2, 4, FINEST].map(|per_pixel| Blur::new(blur_px, per_pixel));
        let tile = lens.tile;
        let edge = blurs.iter().map(|b| tile * b.per_pixel + 2 * b.margin).max().unwrap_or(0);
        Self {
            tile,
            blurs,
            cover: vec![0.0; edge],
            paint: Channels::new(edge),
            sums: Channels::new(edge * edge),
            rows: vec![0.0; tile * edge],
            tile_paint: Channels::new(tile * tile),
            offsets: vec![0.0; edge],
        }
    }

    /// How far outside a tile its light may come from, in pixels.
    pub(super) fn reach_px(&self) -> f64 {
        self.blurs.iter().map(Blur::reach_px).fold(0.0, f64::max)
    }

    /// Paints coats, top first, over what lies `beneath` into [`Painter::tile_paint`], a tile about the lens's centre.
    pub(super) fn paint(
        &mut self,
        coats: &[Coat],
        beneath: Paint,
        sights: &[Sight],
        lens: &Linear,
    ) {
        let Some(blur) = self.blurs.get(self.fineness(coats, sights, lens)) else { return };
        let step = 1.0 / blur.per_pixel as f32;
        let edge = self.tile * blur.per_pixel + 2 * blur.margin;
        let first = -0.5 * (edge as f32 - 1.0) * step;
        let Some(offsets) = self.offsets.get_mut(..edge) else { return };
        for (index, offset) in offsets.iter_mut().enumerate() {
            *offset = first + index as f32 * step;
        }
        let opaque = beneath.cover == 1.0 && coats.iter().all(|coat| coat.paint.cover == 1.0);
        let (Some(cover), Some(paint_cover), Some(paint_light)) = (
            self.cover.get_mut(..edge),
            self.paint.cover.get_mut(..edge),
            self.paint.light.get_mut(..edge),
        ) else {
            return;
        };
        let part = 1.0 / sights.len().max(1) as f32;
        for (instant, sight) in sights.iter().enumerate() {
            let plane = sight.about(lens);
            let reach = f64::from(-first);
            let behind = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
                .iter()
                .any(|(u, v)| plane[2][0] + (plane[2][1] * u + plane[2][2] * v) * reach < 1e-6);
            let rows =
                self.sums.cover.chunks_exact_mut(edge).zip(self.sums.light.chunks_exact_mut(edge));
            for ((sum_cover, sum_light), v) in rows.zip(&*offsets) {
                paint_cover.fill(beneath.cover);
                paint_light.fill(beneath.light);
                for coat in coats.iter().rev() {
                    let outline = Outline { plane: &plane, sight, sharpness: 1.0 / step };
                    outline.cover_row(coat.area, *v, offsets, cover);
                    if behind {
                        hide_behind(plane[2], *v, offsets, cover);
                    }
                    apply(coat, cover, paint_cover, paint_light, opaque);
                }
                accumulate(sum_light, paint_light, part, instant == 0);
                if !opaque {
                    accumulate(sum_cover, paint_cover, part, instant == 0);
                }
            }
        }
        let blurred = Blurred { tile: self.tile, edge, blur };
        blurred.into_pixels(&self.sums.light, &mut self.rows, &mut self.tile_paint.light);
        if opaque {
            self.tile_paint.cover.fill(1.0);
        } else {
            blurred.into_pixels(&self.sums.cover, &mut self.rows, &mut self.tile_paint.cover);
        }
    }

    /// Which of the blurs resolves the smallest of the shapes.
    fn fineness(&self, coats: &[Coat], sights: &[Sight], lens: &Linear) -> usize {
        let Some(sight) = sights.first() else { return 0 };
        let [x, y, w] = sight.about(lens);
        let speed = |f: Affine, axis: usize| (f[axis] * w[0] - f[0] * w[axis]) / (w[0] * w[0]);
        let per_pixel = |axis: usize| speed(x, axis).hypot(speed(y, axis));
        let metres_per_pixel = per_pixel(1).max(per_pixel(2));
        let smallest_m = coats.iter().fold(f64::INFINITY, |smallest, coat| match coat.area {
            Area::Disc(radius) => smallest.min(radius),
            Area::Rectangle(min, max) => smallest.min((max[0] - min[0]).min(max[1] - min[1])),
            Area::Box => smallest,
        });
        let smallest_px = smallest_m / metres_per_pixel;
        let sharp = self.blurs.first().is_some_and(|blur| blur.margin == 0);
        match smallest_px {
            // Also when it is not a number, at the horizon.
            px if px > 5.0 && !sharp => 0,
            px if px > 1.0 => 1,
            _ => 2,
        }
    }
}

/// Coverage of subsamples by shapes, from one instant.
struct Outline<'a> {
    plane: &'a [Affine; 3],
    sight: &'a Sight,
    /// Subsamples to a pixel.
    sharpness: f32,
}

impl Outline<'_> {
    fn cover_row(&self, area: Area, v: f32, offsets: &[f32], cover: &mut [f32]) {
        match area {
            Area::Disc(radius) => self.disc(radius, v, offsets, cover),
            Area::Rectangle(min, max) => {
                cover.fill(1.0);
                for edge in [
                    [max[0], -1.0, 0.0],
                    [-min[0], 1.0, 0.0],
                    [max[1], 0.0, -1.0],
                    [-min[1], 0.0, 1.0],
                ] {
                    self.half_plane(edge, v, offsets, cover);
                }
            }
            Area::Box => {
                cover.fill(1.0);
                for edge in self.sight.outline() {
                    self.half_plane(*edge, v, offsets, cover);
                }
            }
        }
    }

    /// Multiplies the cover with that of a half-plane, in which `edge` is positive.
    fn half_plane(&self, edge: Affine, v: f32, offsets: &[f32], cover: &mut [f32]) {
        let [x, y, w] = self.plane;
        let line = [0, 1, 2].map(|i| edge[0] * w[i] + edge[1] * x[i] + edge[2] * y[i]);
        let scale = f64::from(self.sharpness) / line[1].hypot(line[2]).max(1e-30);
        let [constant, per_u, per_v] = line.map(|l| (l * scale).clamp(-1e30, 1e30) as f32);
        let start = 0.5 + constant + per_v * v;
        for (cover, u) in cover.iter_mut().zip(offsets) {
            *cover *= (start + per_u * u).clamp(0.0, 1.0);
        }
    }

    /// The cover by a disc: x^2 + y^2 - radius^2 w^2 is a quadratic in the image, and its distance from nought in
    /// pixels is its value over its gradient.
    fn disc(&self, radius: f64, v: f32, offsets: &[f32], cover: &mut [f32]) {
        let [x, y, w] = self.plane;
        let r2 = radius * radius;
        let product = |i: usize, j: usize| x[i] * x[j] + y[i] * y[j] - r2 * w[i] * w[j];
        let (u1, v1) = (2.0 * product(0, 1), 2.0 * product(0, 2));
        let (uu, uv, vv) = (product(1, 1), 2.0 * product(1, 2), product(2, 2));
        let scale =
            1.0 / [u1, v1, 8.0 * uu, 8.0 * vv].iter().fold(1e-200, |m: f64, c| m.max(c.abs()));
        let [c, u1, v1, uu, uv, vv] =
            [product(0, 0), u1, v1, uu, uv, vv].map(|c| (c * scale) as f32);
        let (start, slope) = (c + (v1 + vv * v) * v, u1 + uv * v);
        let down = v1 + 2.0 * vv * v;
        for (cover, u) in cover.iter_mut().zip(offsets) {
            let value = start + (slope + uu * u) * u;
            let across = slope + 2.0 * uu * u;
            let along = down + uv * u;
            let steepness = (across * across + along * along + 1e-12).sqrt();
            *cover = (0.5 - value / steepness * self.sharpness).clamp(0.0, 1.0);
        }
    }
}

/// Takes away what lies behind the camera.
fn hide_behind(w: Affine, v: f32, offsets: &[f32], cover: &mut [f32]) {
    let [start, per_u, per_v] = w.map(|w| w as f32);
    for (cover, u) in cover.iter_mut().zip(offsets) {
        if start + per_v * v + per_u * u < 1e-6 {
            *cover = 0.0;
        }
    }
}

fn apply(
    coat: &Coat,
    cover: &[f32],
    paint_cover: &mut [f32],
    paint_light: &mut [f32],
    opaque: bool,
) {
    let Paint { cover: own_cover, light: own_light } = coat.paint;
    if let Some(within) = coat.within {
        for (light, c) in paint_light.iter_mut().zip(cover) {
            *light += c * (own_light - within);
        }
        return;
    }
    for (light, c) in paint_light.iter_mut().zip(cover) {
        *light += c * (own_light - *light);
    }
    if !opaque {
        for (paint, c) in paint_cover.iter_mut().zip(cover) {
            *paint += c * (own_cover - *paint);
        }
    }
}

fn accumulate(sums: &mut [f32], values: &[f32], part: f32, first: bool) {
    for (sum, value) in sums.iter_mut().zip(values) {
        *sum = if first { value * part } else { *sum + value * part };
    }
}

/// Subsamples on their way into pixels.
struct Blurred<'a> {
    tile: usize,
    edge: usize,
    blur: &'a Blur,
}

impl Blurred<'_> {
    fn into_pixels(&self, sums: &[f32], rows: &mut [f32], pixels: &mut [f32]) {
        let weights = &self.blur.weights;
        let rows = rows.chunks_exact_mut(self.edge).take(self.tile).enumerate();
        for ((y, row), pixels) in rows.zip(pixels.chunks_exact_mut(self.tile)) {
            row.fill(0.0);
            let sources = sums.chunks_exact(self.edge).skip(y * self.blur.per_pixel);
            for (source, weight) in sources.zip(weights) {
                for (sum, value) in row.iter_mut().zip(source) {
                    *sum += value * weight;
                }
            }
            let windows = row.windows(weights.len()).step_by(self.blur.per_pixel);
            for (pixel, window) in pixels.iter_mut().zip(windows) {
                *pixel = window.iter().zip(weights).map(|(v, w)| v * w).sum();
            }
        }
    }
}
