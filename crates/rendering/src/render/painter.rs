//! Paints the image tiles through which edges of a painting go: coverage of subsamples by its outlines, moved over the exposure
//! and weighted with lens blur and pixel area.

use super::exposure::GROUP;
use super::lens::{Blur, Lens, Linear, PROFILE_WIDTH};
use super::painting::{Affine, Area, Coat, Paint, Sight, jacobian};

/// Paints tiles.
#[derive(Debug)]
pub(super) struct Painter {
    tile: usize,
    /// From coarse to fine subsamples, and the coarsest that suffices for straight edges.
    blurs: [Blur; 3],
    coarsest: usize,
    offsets: Vec<f32>,
    outlines: Outlines,
    /// Coverage of the row of subsamples being painted.
    cover: Vec<f32>,
    paint: Channels,
    /// Sums over the instants, subsample by subsample.
    sums: Channels,
    /// Rows of pixels by columns of subsamples.
    rows: Vec<f32>,
    /// The painted tile, pixel by pixel.
    pub(super) tile_paint: Channels,
}

/// Coverage and light of each sample.
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

/// The subsamples of a row that lie in a range of pixels.
fn columns(
    [from, to]: [f32; 2],
    first: f32,
    per_pixel: f32,
    edge: usize,
) -> std::ops::Range<usize> {
    let index = |place: f32| ((place - first) * per_pixel).max(0.0) as usize;
    let end = (index(to) + 2).min(edge);
    index(from).min(end)..end
}

/// The part of a painting in a tile during the exposure.
#[derive(Copy, Clone, Debug)]
pub(super) struct Glimpse<'a> {
    /// At each instant.
    pub(super) sights: &'a [Sight],
    /// Around the tile's centre.
    pub(super) lens: &'a Linear,
    /// Motion in the image during the exposure, in pixels.
    pub(super) motion_px: [f64; 2],
    /// Whether to render at full accuracy.
    pub(super) exact: bool,
}

/// How finely a tile is resolved.
#[derive(Copy, Clone, Debug)]
struct Resolution {
    /// Index of the blur.
    blur: usize,
    /// One of this number of instants is painted.
    group: usize,
    /// Motion between painted instants, over which edges are averaged, in pixels.
    motion: [f64; 2],
    /// Whether the edges of polygons are averaged too. Corners do not follow from averaged edges.
    polygons_move: bool,
    /// Minimum radius of averaged discs, in metres: the edges of smaller ones are too curved.
    min_moving_m: f64,
}

/// Minimum lens blur for the coarsest and for the next finer subsamples, in pixels.
const SHARP_PX: [f64; 2] = [0.5, 0.2];

/// Size in pixels above which a shape's edge is nearly straight within a subsample.
const LARGE_PX: f64 = 4.0;

/// Size above which a shape is nearly straight along its motion, in units of the motion within a group of
/// instants.
const STRAIGHT: f64 = 4.0;

/// Minimum radius of a disc that is averaged over its motion, in units of the motion within an instant.
const BENT: f64 = 2.0;

/// Size in pixels below which a shape needs the finest subsamples.
const SMALL_PX: f64 = 0.7;

impl Painter {
    pub(super) fn new(lens: &Lens, blur_px: f64) -> Self {
        let blurs = [2, 4, 8].map(|per_pixel| Blur::new(blur_px, per_pixel));
        let tile = lens.tile;
        let edge = blurs.iter().map(|b| tile * b.per_pixel + 2 * b.margin).max().unwrap_or(0);
        Self {
            tile,
            blurs,
            coarsest: SHARP_PX.iter().filter(|sharp| blur_px < **sharp).count(),
            offsets: vec![0.0; edge],
            outlines: Outlines::default(),
            cover: vec![0.0; edge],
            paint: Channels::new(edge),
            sums: Channels::new(edge * edge),
            rows: vec![0.0; tile * edge],
            tile_paint: Channels::new(tile * tile),
        }
    }

    /// Maximum distance from a tile to the light it gets, in pixels.
    pub(super) fn reach_px(&self) -> f64 {
        self.blurs.iter().map(Blur::reach_px).fold(0.0, f64::max)
    }

    /// Paints coats, top first, over the paint `beneath`, into [`Painter::tile_paint`].
    pub(super) fn paint(&mut self, coats: &[Coat], beneath: Paint, glimpse: &Glimpse<'_>) {
        let resolution = self.resolution(coats, glimpse);
        let Some(blur) = self.blurs.get(resolution.blur) else { return };
        let step = 1.0 / blur.per_pixel as f32;
        let edge = self.tile * blur.per_pixel + 2 * blur.margin;
        let first = -0.5 * (edge as f32 - 1.0) * step;
        let opaque = beneath.cover == 1.0 && coats.iter().all(|coat| coat.paint.cover == 1.0);
        let (Some(offsets), Some(cover), Some(paint_cover), Some(paint_light)) = (
            self.offsets.get_mut(..edge),
            self.cover.get_mut(..edge),
            self.paint.cover.get_mut(..edge),
            self.paint.light.get_mut(..edge),
        ) else {
            return;
        };
        for (index, offset) in offsets.iter_mut().enumerate() {
            *offset = first + index as f32 * step;
        }
        let count = glimpse.sights.len() / resolution.group;
        let part = 1.0 / count.max(1) as f32;
        // The middle instant represents its group.
        let chosen = glimpse.sights.iter().skip(resolution.group / 2).step_by(resolution.group);
        for (instant, sight) in chosen.enumerate() {
            let plane = sight.about(glimpse.lens);
            let samples = Samples { step: f64::from(step), reach: f64::from(-first) };
            self.outlines.draw(coats, sight, &plane, &resolution, samples);
            let rows =
                self.sums.cover.chunks_exact_mut(edge).zip(self.sums.light.chunks_exact_mut(edge));
            for ((sum_cover, sum_light), v) in rows.zip(&*offsets) {
                paint_cover.fill(beneath.cover);
                paint_light.fill(beneath.light);
                for (coat, outline) in &self.outlines.of_coats {
                    let Some(reach) = self.outlines.reach(outline, *v, [first, -first]) else {
                        continue;
                    };
                    let columns = columns(reach, first, 1.0 / step, edge);
                    let (Some(offsets), Some(cover), Some(paint_cover), Some(paint_light)) = (
                        offsets.get(columns.clone()),
                        cover.get_mut(columns.clone()),
                        paint_cover.get_mut(columns.clone()),
                        paint_light.get_mut(columns),
                    ) else {
                        continue;
                    };
                    self.outlines.cover_row(outline, *v, offsets, cover);
                    apply(coat, cover, paint_cover, paint_light, opaque);
                }
                accumulate(sum_light, paint_light, part, instant == 0);
                if !opaque {
                    accumulate(sum_cover, paint_cover, part, instant == 0);
                }
            }
        }
        let blurred = Blurred { tile: self.tile, edge, blur };
        blurred.fill_pixels(&self.sums.light, &mut self.rows, &mut self.tile_paint.light);
        if opaque {
            self.tile_paint.cover.fill(1.0);
        } else {
            blurred.fill_pixels(&self.sums.cover, &mut self.rows, &mut self.tile_paint.cover);
        }
    }

    /// The resolution that the smallest shape needs.
    fn resolution(&self, coats: &[Coat], glimpse: &Glimpse<'_>) -> Resolution {
        let count = glimpse.sights.len();
        let coarse = Resolution {
            blur: self.coarsest,
            group: GROUP.min(count.max(1)),
            motion: glimpse.motion_px.map(|m| m * GROUP as f64 / count.max(GROUP) as f64),
            polygons_move: true,
            min_moving_m: 0.0,
        };
        let Some(middle) = glimpse.sights.get(count / 2) else { return coarse };
        if !glimpse.exact {
            return coarse;
        }
        let plane = middle.about(glimpse.lens);
        let [du, dv] = jacobian(&plane);
        let metres_per_pixel =
            (du[0] * du[0] + du[1] * du[1]).max(dv[0] * dv[0] + dv[1] * dv[1]).sqrt();
        let min_size_m = coats.iter().fold(f64::INFINITY, |size, coat| match coat.area {
            Area::Disc { radius, .. } => size.min(radius),
            Area::Rectangle(min, max) => size.min((max[0] - min[0]).min(max[1] - min[1])),
            Area::Box => size,
        });
        let min_size_px = min_size_m / metres_per_pixel;
        let cornered = self.has_corner(coats, middle, &plane);
        let step_px = |motion: [f64; 2]| (motion[0] * motion[0] + motion[1] * motion[1]).sqrt();
        let straight = min_size_px > STRAIGHT * step_px(coarse.motion);
        if min_size_px > LARGE_PX && (count == 1 || (straight && !cornered)) {
            return coarse;
        }
        let motion = glimpse.motion_px.map(|m| m / count as f64);
        let blur = match min_size_px {
            px if px > LARGE_PX => self.coarsest,
            px if px > SMALL_PX || count > 1 => self.coarsest.max(1),
            // Also at the horizon, where it is NaN.
            _ => 2,
        };
        let min_moving_m = BENT * step_px(motion) * metres_per_pixel;
        Resolution { blur, group: 1, motion, polygons_move: !cornered, min_moving_m }
    }

    /// True when two edges of one shape are near the tile.
    fn has_corner(&self, coats: &[Coat], sight: &Sight, plane: &[Affine; 3]) -> bool {
        let near = (self.tile as f64 / 2.0 + self.reach_px()) * std::f64::consts::SQRT_2;
        let edges_near = |edges: &[Affine]| {
            edges.iter().filter(|edge| depth_px(plane, edge)[0].abs() < near).count()
        };
        coats.iter().any(|coat| match coat.area {
            Area::Disc { .. } => false,
            Area::Rectangle(min, max) => edges_near(&rectangle(min, max)) > 1,
            Area::Box => edges_near(sight.outline()) > 1,
        })
    }
}

/// The subsamples of a tile: their size, and their maximum distance from its centre, in pixels.
#[derive(Copy, Clone)]
struct Samples {
    step: f64,
    reach: f64,
}

/// The coats' outlines in a tile at one instant.
#[derive(Debug, Default)]
struct Outlines {
    of_coats: Vec<(Coat, Outline)>,
    half_planes: Vec<HalfPlane>,
    /// The plane's w when some of the tile is behind the camera.
    behind: Option<[f32; 3]>,
    profile: Profile,
}

#[derive(Copy, Clone, Debug)]
enum Outline {
    Disc {
        /// Coefficients 1, u, v, uu, uv, vv of a quadratic that is negative inside.
        quadratic: [f32; 6],
        motion: [f32; 2],
        /// First and last column and row of its bounding box.
        bounds: [[f32; 2]; 2],
    },
    /// Its range of the half-planes.
    Polygon { first: usize, len: usize },
}

/// Depth behind its edge, in pixels: constant, per column, per row; and the motion of the edge.
#[derive(Copy, Clone, Debug)]
struct HalfPlane {
    depth: [f32; 3],
    motion: f32,
    /// Depth behind the opposite edge of a strip that is thinner than the profile: such edges together cover the part
    /// between them, and not the product of their single coverages.
    opposite: Option<[f32; 3]>,
}

/// Coverage across an edge: the integral of a biweight kernel.
#[derive(Copy, Clone, Debug, Default)]
struct Profile {
    /// Width of the kernel, and its inverse, in pixels.
    width: f32,
    inverse: f32,
}

/// Motion below which an edge counts as still, in pixels.
const STILL_PX: f32 = 0.05;

impl Profile {
    fn new(width: f64) -> Self {
        Self { width: width as f32, inverse: (1.0 / width) as f32 }
    }

    /// Half width of the band of partial coverage along a moving edge, in pixels.
    fn margin(self, motion: [f32; 2]) -> f32 {
        let moved = (motion[0] * motion[0] + motion[1] * motion[1]).sqrt();
        0.5 * (self.width + moved.max(STILL_PX))
    }

    /// Coverage at a depth behind a still edge.
    fn cover(self, depth: f32) -> f32 {
        let t = (0.5 + depth * self.inverse).clamp(0.0, 1.0);
        t * t * t * (10.0 + t * (6.0 * t - 15.0))
    }

    /// Mean coverage at a depth behind an edge that moves along its normal by `motion`, at least
    /// [`STILL_PX`].
    fn mean_cover(self, depth: f32, motion: f32) -> f32 {
        (self.integral(depth + 0.5 * motion) - self.integral(depth - 0.5 * motion)) / motion
    }

    /// Integral of the coverage up to a depth.
    fn integral(self, depth: f32) -> f32 {
        let t = (0.5 + depth * self.inverse).clamp(0.0, 1.0);
        let t2 = t * t;
        t2 * t2 * (2.5 + t * (t - 3.0)) * self.width + (depth - 0.5 * self.width).max(0.0)
    }
}

impl Outlines {
    /// Computes the outlines of coats, top first, as seen in `sight`.
    fn draw(
        &mut self,
        coats: &[Coat],
        sight: &Sight,
        plane: &[Affine; 3],
        resolution: &Resolution,
        Samples { step, reach }: Samples,
    ) {
        let min = |f: &Affine| f[0] - (f[1].abs() + f[2].abs()) * reach;
        self.behind = (min(&plane[2]) < 1e-6).then(|| plane[2].map(|w| w as f32));
        self.profile = Profile::new(PROFILE_WIDTH * step);
        let spread = (PROFILE_WIDTH * step).powi(2) / 28.0;
        let motion_of_polygons =
            if resolution.polygons_move { resolution.motion } else { [0.0; 2] };
        self.of_coats.clear();
        self.half_planes.clear();
        for coat in coats.iter().rev() {
            let outline = match coat.area {
                Area::Disc { centre, radius } => {
                    let moves = radius > resolution.min_moving_m;
                    let motion = if moves { resolution.motion } else { [0.0; 2] };
                    let about = about(plane, centre);
                    let quadratic = disc(&about, radius, motion, spread);
                    let motion = motion.map(|m| m as f32);
                    let bounds = bounds(&quadratic, self.profile.margin(motion));
                    Outline::Disc { quadratic, motion, bounds }
                }
                Area::Rectangle(min, max) => {
                    self.rectangle(plane, &rectangle(min, max), motion_of_polygons, reach)
                }
                Area::Box => self.polygon(plane, sight.outline(), motion_of_polygons, reach),
            };
            self.of_coats.push((*coat, outline));
        }
    }

    /// The half-planes of a polygon that have an edge in the tile.
    fn polygon(
        &mut self,
        plane: &[Affine; 3],
        edges: &[Affine],
        motion: [f64; 2],
        reach: f64,
    ) -> Outline {
        let first = self.half_planes.len();
        for edge in edges {
            let half_plane = self.half_plane(plane, edge, motion, reach);
            self.half_planes.extend(half_plane);
        }
        Outline::Polygon { first, len: self.half_planes.len() - first }
    }

    /// The same of a rectangle, of which each edge is followed by the opposite one.
    fn rectangle(
        &mut self,
        plane: &[Affine; 3],
        edges: &[Affine; 4],
        motion: [f64; 2],
        reach: f64,
    ) -> Outline {
        let first = self.half_planes.len();
        let [right, left, top, bottom] =
            edges.each_ref().map(|edge| self.half_plane(plane, edge, motion, reach));
        for pair in [[right, left], [top, bottom]] {
            match pair {
                [Some(one), Some(other)]
                    if one.depth[0] + other.depth[0] < self.profile.width + one.motion =>
                {
                    self.half_planes.push(HalfPlane { opposite: Some(other.depth), ..one });
                }
                _ => self.half_planes.extend(pair.into_iter().flatten()),
            }
        }
        Outline::Polygon { first, len: self.half_planes.len() - first }
    }

    /// The half-plane behind an edge; `None` where it covers all of the tile.
    fn half_plane(
        &self,
        plane: &[Affine; 3],
        edge: &Affine,
        motion: [f64; 2],
        reach: f64,
    ) -> Option<HalfPlane> {
        let depth = depth_px(plane, edge);
        let moved = (depth[1] * motion[0] + depth[2] * motion[1]).abs();
        let min = depth[0] - (depth[1].abs() + depth[2].abs()) * reach;
        let has_edge = min < f64::from(self.profile.width) + moved;
        let depth = depth.map(|d| d as f32);
        has_edge.then_some(HalfPlane { depth, motion: moved as f32, opposite: None })
    }

    /// The part of row `v` of a tile, which spans `from` to `to`, that an outline may cover.
    fn reach(&self, outline: &Outline, v: f32, [from, to]: [f32; 2]) -> Option<[f32; 2]> {
        match outline {
            Outline::Disc { quadratic, motion, bounds: [columns, rows] } => {
                if v < rows[0] || v > rows[1] {
                    return None;
                }
                let [from, to] = [from.max(columns[0]), to.min(columns[1])];
                if from > to {
                    return None;
                }
                // Where the quadratic is below its maximum at the margin.
                let row = Row::new(quadratic, v);
                let max = row.steepness(from).max(row.steepness(to)) * self.profile.margin(*motion);
                let half = 0.5 * row.slope / row.bend;
                let square = half * half - (row.start - max) / row.bend;
                if row.bend.is_nan() || row.bend < 1e-6 {
                    return Some([from, to]);
                }
                let width = square.max(0.0).sqrt();
                let reach = [from.max(-half - width), to.min(-half + width)];
                (square > 0.0 && reach[0] <= reach[1]).then_some(reach)
            }
            Outline::Polygon { first, len } => {
                let planes = self.half_planes.get(*first..first + len).unwrap_or(&[]);
                let mut reach = [from, to];
                for plane in planes {
                    let margin = self.profile.margin([plane.motion, 0.0]);
                    for [start, per_u, per_v] in std::iter::once(plane.depth).chain(plane.opposite)
                    {
                        let start = start + per_v * v + margin;
                        if per_u > 1e-6 {
                            reach[0] = reach[0].max(-start / per_u);
                        } else if per_u < -1e-6 {
                            reach[1] = reach[1].min(-start / per_u);
                        }
                    }
                }
                (reach[0] <= reach[1]).then_some(reach)
            }
        }
    }

    /// Coverage of each subsample in row `v` by an outline.
    fn cover_row(&self, outline: &Outline, v: f32, offsets: &[f32], cover: &mut [f32]) {
        let ends = [offsets.first(), offsets.last()].map(|end| end.copied().unwrap_or(0.0));
        match outline {
            Outline::Disc { quadratic, motion, .. } => {
                let row = Row::new(quadratic, v);
                let margin = self.profile.margin(*motion);
                let deep = |u: f32| -row.value(u) > row.steepness(u) * margin;
                // A convex shape that contains both ends contains all points between them.
                if row.bend > 0.0 && ends.iter().all(|u| deep(*u)) {
                    cover.fill(1.0);
                } else if *motion == [0.0; 2] {
                    self.disc_row(&row, offsets, cover);
                } else {
                    self.moving_disc_row(&row, *motion, offsets, cover);
                }
            }
            Outline::Polygon { first, len } => {
                let planes = self.half_planes.get(*first..first + len).unwrap_or(&[]);
                cover.fill(1.0);
                for plane in planes {
                    let [start, per_u, per_v] = plane.depth;
                    let margin = self.profile.margin([plane.motion, 0.0]);
                    if let Some(opposite) = plane.opposite {
                        self.strip_row(plane, opposite, v, offsets, cover);
                    } else if ends.iter().any(|u| start + per_v * v + per_u * u < margin) {
                        self.half_plane_row(plane, v, offsets, cover);
                    }
                }
            }
        }
        if let Some([start, per_u, per_v]) = self.behind {
            for (cover, u) in cover.iter_mut().zip(offsets) {
                if start + per_v * v + per_u * u < 1e-6 {
                    *cover = 0.0;
                }
            }
        }
    }

    /// Multiplies the coverage with that of a half-plane.
    fn half_plane_row(&self, plane: &HalfPlane, v: f32, offsets: &[f32], cover: &mut [f32]) {
        let [start, per_u, per_v] = plane.depth;
        let start = start + per_v * v;
        if plane.motion < STILL_PX {
            for (cover, u) in cover.iter_mut().zip(offsets) {
                *cover *= self.profile.cover(start + per_u * u);
            }
        } else {
            for (cover, u) in cover.iter_mut().zip(offsets) {
                *cover *= self.profile.mean_cover(start + per_u * u, plane.motion);
            }
        }
    }

    /// Multiplies the coverage with that of a strip between two nearly parallel edges. The part of the kernel beyond one edge
    /// is completely behind the other, so the strip has the sum of both coverages, less one.
    fn strip_row(
        &self,
        plane: &HalfPlane,
        opposite: [f32; 3],
        v: f32,
        offsets: &[f32],
        cover: &mut [f32],
    ) {
        let cover_of = |[start, per_u, per_v]: [f32; 3], u: f32| {
            let depth = start + per_v * v + per_u * u;
            if plane.motion < STILL_PX {
                self.profile.cover(depth)
            } else {
                self.profile.mean_cover(depth, plane.motion)
            }
        };
        for (cover, u) in cover.iter_mut().zip(offsets) {
            *cover *= (cover_of(plane.depth, *u) + cover_of(opposite, *u) - 1.0).max(0.0);
        }
    }

    /// The distance to a quadratic's zero, in pixels, is its value over its gradient.
    fn disc_row(&self, row: &Row, offsets: &[f32], cover: &mut [f32]) {
        for (cover, u) in cover.iter_mut().zip(offsets) {
            *cover = self.profile.cover(-row.value(*u) / row.steepness(*u));
        }
    }

    fn moving_disc_row(&self, row: &Row, motion: [f32; 2], offsets: &[f32], cover: &mut [f32]) {
        for (cover, u) in cover.iter_mut().zip(offsets) {
            let flatness = 1.0 / row.steepness(*u);
            let [across, along] = row.gradient(*u);
            let moved = (across * motion[0] + along * motion[1]) * flatness;
            let depth = -row.value(*u) * flatness;
            *cover = self.profile.mean_cover(depth, moved.abs().max(STILL_PX));
        }
    }
}

/// A quadratic along one row: its value `start + slope u + bend u^2`, and its slope across rows.
#[derive(Copy, Clone, Debug)]
struct Row {
    start: f32,
    slope: f32,
    bend: f32,
    down: f32,
    down_per_u: f32,
}

impl Row {
    fn new([c, u1, v1, uu, uv, vv]: &[f32; 6], v: f32) -> Self {
        Self {
            start: c + (v1 + vv * v) * v,
            slope: u1 + uv * v,
            bend: *uu,
            down: v1 + 2.0 * vv * v,
            down_per_u: *uv,
        }
    }

    fn value(&self, u: f32) -> f32 {
        self.start + (self.slope + self.bend * u) * u
    }

    fn gradient(&self, u: f32) -> [f32; 2] {
        [self.slope + 2.0 * self.bend * u, self.down + self.down_per_u * u]
    }

    fn steepness(&self, u: f32) -> f32 {
        let [across, along] = self.gradient(u);
        (across * across + along * along + 1e-14).sqrt()
    }
}

/// First and last column and row where a quadratic is negative, with a margin; infinite without bounds.
fn bounds(&[c, u1, v1, uu, uv, vv]: &[f32; 6], margin: f32) -> [[f32; 2]; 2] {
    let everywhere = [[f32::NEG_INFINITY, f32::INFINITY]; 2];
    let [c, u1, v1, uu, uv, vv] = [c, u1, v1, uu, uv, vv].map(f64::from);
    let round = 4.0 * uu * vv - uv * uv;
    if !(uu > 0.0 && round > 1e-3 * (uu + vv) * (uu + vv)) {
        return everywhere;
    }
    let centre = [(uv * v1 - 2.0 * vv * u1) / round, (uv * u1 - 2.0 * uu * v1) / round];
    let depth = -(c + 0.5 * (u1 * centre[0] + v1 * centre[1]));
    // Far from a small disc, value over gradient is half the distance.
    let margin = 2.0 * f64::from(margin) + 0.1;
    let half = [vv, uu].map(|q| (depth.max(0.0) * 4.0 * q / round).sqrt() + margin);
    [0, 1].map(|i| [(centre[i] - half[i]) as f32, (centre[i] + half[i]) as f32])
}

/// The half-planes of an axis-aligned rectangle.
fn rectangle(min: [f64; 2], max: [f64; 2]) -> [Affine; 4] {
    [[max[0], -1.0, 0.0], [-min[0], 1.0, 0.0], [max[1], 0.0, -1.0], [-min[1], 0.0, 1.0]]
}

/// Depth behind the edge of a half-plane, in pixels.
fn depth_px([x, y, w]: &[Affine; 3], edge: &Affine) -> Affine {
    let line = [0, 1, 2].map(|i| edge[0] * w[i] + edge[1] * x[i] + edge[2] * y[i]);
    let steepness = (line[1] * line[1] + line[2] * line[2]).sqrt().max(1e-30);
    line.map(|l| (l / steepness).clamp(-1e9, 1e9))
}

/// The plane's homogeneous coordinates relative to a point.
fn about([x, y, w]: &[Affine; 3], centre: [f64; 2]) -> [Affine; 3] {
    [[0, 1, 2].map(|i| x[i] - centre[0] * w[i]), [0, 1, 2].map(|i| y[i] - centre[1] * w[i]), *w]
}

/// A disc around the origin: x^2 + y^2 - radius^2 w^2, a quadratic in the image. Its curvature is corrected
/// for: along the motion by the mean over it, and within the profile of variance `spread` by that of a round
/// one.
fn disc([x, y, w]: &[Affine; 3], radius: f64, [mu, mv]: [f64; 2], spread: f64) -> [f32; 6] {
    let r2 = radius * radius;
    let product = |i: usize, j: usize| x[i] * x[j] + y[i] * y[j] - r2 * w[i] * w[j];
    let (u1, v1) = (2.0 * product(0, 1), 2.0 * product(0, 2));
    let (uu, uv, vv) = (product(1, 1), 2.0 * product(1, 2), product(2, 2));
    let bend = (uu * mu * mu + uv * mu * mv + vv * mv * mv) / 12.0 + (uu + vv) * spread;
    let largest = [u1, v1, 8.0 * uu, 8.0 * vv].iter().fold(1e-200, |m: f64, c| m.max(c.abs()));
    [product(0, 0) + bend, u1, v1, uu, uv, vv].map(|c| (c / largest) as f32)
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

/// Combines subsamples into pixels.
struct Blurred<'a> {
    tile: usize,
    edge: usize,
    blur: &'a Blur,
}

impl Blurred<'_> {
    fn fill_pixels(&self, sums: &[f32], rows: &mut [f32], pixels: &mut [f32]) {
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
