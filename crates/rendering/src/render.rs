//! A camera that looks at the scene from a vehicle.
//!
//! Projection is exact. Markers are averaged over each pixel's area, the lens's blur and the exposure; the ground
//! is a texture sampled at the size of a pixel. A frame depends on the seed, its index and the poses, never on the
//! frames before it.
//!
//! Modules in reading order: `exposure` says where the camera is while the shutter is open, `lens` where a pixel
//! looks, `painting` what a part of the image shows of a marker, `painter` draws its edges, `sensor` turns light into grey levels.

mod exposure;
mod lens;
mod painter;
mod painting;
mod sensor;

use std::sync::Arc;

use geometry::{
    Body, Camera, CameraModel, Distortion, Marker as MarkerFrame, Ned, Point, Rotation, Transform,
};
use markers::{Drawing, Ink, Marker, Shape};
use nalgebra::{Matrix3, Rotation3, UnitQuaternion, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::ground::{Ground, Span, Surface};
use exposure::{Exposure, MOST_INSTANTS, between};
use lens::Lens;
use painter::{Channels, Glimpse, Painter};
use painting::{Area, BARE, Coat, Paint, Painting, Shown, Sight, View, shown};
use sensor::Sensor;

/// What there is to see.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The ground, at height 0 in NED.
    pub surface: Surface,
    /// The pads on it.
    pub pads: Vec<PadInScene>,
    /// Circles, rings and lines painted on the ground about the first pad that are no markers.
    pub painted_marks: u32,
    /// Light on the scene; 1 is full sun.
    pub light: f64,
}

/// Something printed on top of a flat square box.
#[derive(Clone, Debug)]
pub struct PadInScene {
    /// What is printed.
    pub drawing: Drawing,
    /// The printed face in the world.
    pub ned_from_marker: Transform<Ned, MarkerFrame>,
    /// Edge of the box's white lid, in metres.
    pub paper_m: f64,
    /// Height of the box under the printed face, in metres.
    pub thickness_m: f64,
}

/// The camera and its setting.
#[derive(Clone, Debug)]
pub struct CameraSettings {
    /// Intrinsics.
    pub model: CameraModel,
    /// Where it is mounted.
    pub body_from_camera: Transform<Body, Camera>,
    /// How long the shutter is open, in seconds.
    pub exposure_s: f64,
    /// Time from the exposure of the first row to that of the last, in seconds: 0 of a global shutter.
    pub readout_s: f64,
    /// Amplification; 1 makes a full well white.
    pub gain: f64,
    /// Electrons a pixel collects per second from white in full sun.
    pub electrons_per_s: f64,
    /// Electrons a pixel holds.
    pub full_well_e: f64,
    /// Standard deviation of the noise of reading a pixel, in electrons.
    pub read_noise_e: f64,
    /// Whether there is shot and read noise at all.
    pub noise: bool,
    /// Standard deviation of the lens's blur, in pixels, from 0 to 3.
    pub blur_px: f64,
    /// Loss of light off axis: 0 none, 1 the fourth power of the cosine.
    pub vignetting: f64,
}

/// Why there is no picture.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum RenderError {
    /// No pose was given.
    NoPose,
    /// A pose that is not finite, no rotation, or farther than 100 km away.
    Pose {
        /// Its place among the poses.
        index: usize,
    },
    /// A buffer of another size than the picture.
    Size {
        /// Bytes there are.
        len: usize,
        /// Bytes of the picture.
        needed: usize,
    },
    /// A setting of the camera or the scene that makes no sense.
    Setting(&'static str),
}

impl std::fmt::Display for RenderError {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::NoPose => write!(f, "no pose to see the scene from"),
            Self::Pose { index } => {
                write!(f, "pose {index} is not finite, no rotation, or farther than 100 km away")
            }
            Self::Size { len, needed } => {
                write!(f, "a buffer of {len} bytes for a picture of {needed}")
            }
            Self::Setting(problem) => write!(f, "{problem}"),
        }
    }
}

impl std::error::Error for RenderError {}

/// Reflectance of printer's ink and of paper.
const BLACK: f32 = 0.05;
const WHITE: f32 = 0.88;

/// Reflectance of the sides of a pad's box.
const SIDES: f32 = 0.3;

/// What the sky and the inside of the ground look like, as reflectances.
const SKY: f32 = 0.95;
const UNDERGROUND: f32 = 0.02;

/// Ground farther along the ray than this is seen without grain, in metres.
const FARTHEST_GRAIN_M: f64 = 500.0;

impl PadInScene {
    /// A marker that lies flat on the ground, as in the thesis (section 4.4.2): `heading` turns the marker's y axis
    /// from north towards east (radians), the box is 0.01 m high, and its lid holds the drawing's quiet zone.
    pub fn flat(marker: Marker, north_m: f64, east_m: f64, heading: f64) -> Self {
        // What cannot be drawn is refused when it is rendered.
        let drawing = marker
            .size_m
            .and_then(|size_m| Drawing::new(&marker, size_m))
            .unwrap_or(Drawing { half_extent_m: f64::NAN, layers: Vec::new() });
        Self::printed(drawing, north_m, east_m, heading)
    }

    /// Anything printed that lies flat on the ground, as [`PadInScene::flat`].
    pub fn printed(drawing: Drawing, north_m: f64, east_m: f64, heading: f64) -> Self {
        const THICKNESS_M: f64 = 0.01;
        let up = Matrix3::from_columns(&[Vector3::y(), Vector3::x(), -Vector3::z()]);
        let flat = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(up));
        let turned = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading) * flat;
        Self {
            ned_from_marker: Transform::new(
                Rotation::from_quaternion(turned),
                Point::new(north_m, east_m, -THICKNESS_M),
            ),
            paper_m: 2.0 * drawing.half_extent_m,
            thickness_m: THICKNESS_M,
            drawing,
        }
    }
}

impl CameraSettings {
    /// The thesis' camera (section 4.1) with 2 x 2 binning: 1296 x 972 pixels of 4.4 um behind 8 mm, looking down
    /// from the body's origin with the nose at the top of the image; 2 ms in full sun.
    pub fn thesis() -> Self {
        let down = Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2);
        Self {
            model: CameraModel::pinhole(1296, 972, 8e-3 / 4.4e-6),
            body_from_camera: Transform::new(down, Point::origin()),
            exposure_s: 0.002,
            readout_s: 0.0,
            gain: 1.0,
            electrons_per_s: 4e6,
            full_well_e: 8_000.0,
            read_noise_e: 8.0,
            noise: true,
            blur_px: 0.6,
            vignetting: 0.5,
        }
    }

    /// With the exposure, and where `longest_s` does not suffice the gain, that makes white paper in `light` the
    /// grey level `white`.
    #[must_use]
    pub fn exposed_for(mut self, light: f64, white: f64, longest_s: f64) -> Self {
        let electrons = white / 255.0 * self.full_well_e / f64::from(WHITE);
        let needed_s = electrons / (self.electrons_per_s * light.max(1e-9));
        self.exposure_s = needed_s.min(longest_s);
        self.gain = needed_s / self.exposure_s.max(1e-12);
        self
    }

    /// When a row has been exposed for a part of its time, from 0 to 1, as a part of the time from the opening of the first row
    /// to the closing of the last.
    pub fn part_at_row(&self, v: f64, exposed: f64) -> f64 {
        let last = f64::from(self.model.height.saturating_sub(1)).max(1.0);
        let whole_s = self.readout_s + self.exposure_s;
        let at_s = self.readout_s * v / last + self.exposure_s * exposed;
        if whole_s > 0.0 { at_s / whole_s } else { 0.5 }
    }

    /// Grey levels of a surface that reflects everything.
    fn levels_per_reflectance(&self, light: f64) -> f64 {
        self.electrons_per_s * self.exposure_s * light / self.full_well_e * self.gain * 255.0
    }

    fn check(&self) -> Result<(), RenderError> {
        let model = &self.model;
        let pixels = |edge: u32| (1..=65_535).contains(&edge);
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let checks = [
            (pixels(model.width) && pixels(model.height), "an image edge is not from 1 to 65535"),
            (positive(model.fx) && positive(model.fy), "a focal length is not above 0"),
            (model.cx.is_finite() && model.cy.is_finite(), "the principal point is not finite"),
            (self.exposure_s.is_finite() && self.exposure_s >= 0.0, "the exposure is below 0"),
            (
                self.readout_s.is_finite() && self.readout_s >= 0.0,
                "the readout takes less than no time",
            ),
            (positive(self.gain), "the gain is not above 0"),
            (positive(self.electrons_per_s), "the electrons per second are not above 0"),
            (positive(self.full_well_e), "the full well is not above 0"),
            (
                self.read_noise_e.is_finite() && self.read_noise_e >= 0.0,
                "the read noise is below 0",
            ),
            ((0.0..=3.0).contains(&self.blur_px), "the lens's blur is not from 0 to 3 px"),
            ((0.0..=1.0).contains(&self.vignetting), "the vignetting is not from 0 to 1"),
        ];
        checks
            .iter()
            .find(|(holds, _)| !holds)
            .map_or(Ok(()), |(_, why)| Err(RenderError::Setting(why)))
    }
}

/// Renders frames of one scene with one camera.
#[derive(Debug)]
pub struct Renderer {
    settings: CameraSettings,
    lens: Lens,
    ground: Arc<Ground>,
    sensor: Sensor,
    levels_per_reflectance: f32,
    paintings: Vec<Painting>,
    /// How many of the paintings are pads; they come last, in the scene's order.
    pads: usize,
    exposure: Exposure,
    views: Vec<View>,
    painter: Painter,
    /// The coats with edges in the tile being painted.
    crossing: Vec<Coat>,
    band: Band,
}

/// A row of tiles.
#[derive(Debug)]
struct Band {
    tiles: Vec<TileState>,
    paint: Channels,
    light: Vec<f32>,
}

#[derive(Copy, Clone, Debug, PartialEq)]
enum TileState {
    Bare,
    Mixed,
    Covered,
}

impl Renderer {
    /// A renderer whose ground, painted marks and noise grow from `seed`.
    ///
    /// # Errors
    /// [`RenderError::Setting`] when a setting or a pad's size makes no sense.
    pub fn new(scene: &Scene, settings: CameraSettings, seed: u64) -> Result<Self, RenderError> {
        settings.check()?;
        Self::on(Arc::new(Ground::new(scene.surface, seed)), scene, settings, seed)
    }

    /// As [`Renderer::new`], on a ground that has grown already and may serve several renderers.
    ///
    /// # Errors
    /// As [`Renderer::new`].
    pub fn on(
        ground: Arc<Ground>,
        scene: &Scene,
        settings: CameraSettings,
        seed: u64,
    ) -> Result<Self, RenderError> {
        settings.check()?;
        if !(scene.light.is_finite() && scene.light >= 0.0) {
            return Err(RenderError::Setting("the light is below 0"));
        }
        let mut paintings = painted_marks(scene, seed);
        for pad in &scene.pads {
            paintings.push(painting_of(pad)?);
        }
        let lens = Lens::new(settings.model);
        let painter = Painter::new(&lens, settings.blur_px);
        let tiles = (settings.model.width as usize).div_ceil(lens.tile);
        let view = || View {
            looks: None,
            sights: Vec::with_capacity(MOST_INSTANTS),
            columns: [0; 2],
            rows: [0; 2],
        };
        let most_coats = paintings.iter().map(|painting| painting.coats.len()).max().unwrap_or(0);
        Ok(Self {
            ground,
            sensor: Sensor::new(&settings, seed),
            levels_per_reflectance: settings.levels_per_reflectance(scene.light) as f32,
            views: paintings.iter().map(|_| view()).collect(),
            paintings,
            pads: scene.pads.len(),
            exposure: Exposure::new(),
            painter,
            crossing: Vec::with_capacity(most_coats),
            band: Band {
                tiles: vec![TileState::Bare; tiles],
                paint: Channels::new(tiles * lens.tile * lens.tile),
                light: vec![0.0; tiles * lens.tile],
            },
            lens,
            settings,
        })
    }

    /// The camera and its setting.
    pub fn settings(&self) -> &CameraSettings {
        &self.settings
    }

    /// Moves a pad; nothing happens when there is no pad of that index.
    pub fn move_pad(&mut self, index: usize, ned_from_marker: Transform<Ned, MarkerFrame>) {
        let first = self.paintings.len() - self.pads;
        if let Some(painting) = self.paintings.get_mut(first.saturating_add(index)) {
            painting.ned_from_plane = ned_from_marker;
        }
    }

    /// Renders frame `frame_index` as seen from a vehicle that goes through `poses` (`ned_from_body`, evenly spaced
    /// in time from the opening of the shutter to its closing, of a rolling one from that of the first row to that of the last;
    /// one pose stands still) into `out`, row by row.
    ///
    /// # Errors
    /// [`RenderError`] when a pose is unsound or `out` has another size than the image.
    pub fn render(
        &mut self,
        poses: &[Transform<Ned, Body>],
        frame_index: u64,
        out: &mut [u8],
    ) -> Result<(), RenderError> {
        self.render_through(&mut |_, _| {}, poses, frame_index, out)
    }

    /// As [`Renderer::render`], through a `veil` between scene and sensor: it is given each row's number and its
    /// light, in grey levels before vignetting and noise, and may change it as shadows, glare and hands do.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render_through(
        &mut self,
        veil: &mut dyn FnMut(usize, &mut [f32]),
        poses: &[Transform<Ned, Body>],
        frame_index: u64,
        out: &mut [u8],
    ) -> Result<(), RenderError> {
        let model = self.settings.model;
        let (width, height) = (model.width as usize, model.height as usize);
        if out.len() != width * height {
            return Err(RenderError::Size { len: out.len(), needed: width * height });
        }
        self.exposure.follow(poses, &self.settings.body_from_camera, &model)?;
        self.look_at_paintings();
        let tile = self.lens.tile;
        let rolls = self.settings.readout_s > 0.0 && poses.len() > 1;
        for (index, rows) in out.chunks_mut(width * tile).enumerate() {
            if !rolls {
                self.paint_band(index);
            }
            for (y, row) in rows.chunks_mut(width).enumerate() {
                let v = index * tile + y;
                if rolls {
                    self.follow_row(poses, v)?;
                    self.paint_band(index);
                }
                self.fill_row(v);
                veil(v, self.band.light.get_mut(..width).unwrap_or(&mut []));
                self.sensor.expose(frame_index, v, &self.band.light, row);
            }
        }
        Ok(())
    }

    /// Follows the vehicle through the exposure of one row, of those through which a rolling shutter goes.
    fn follow_row(&mut self, poses: &[Transform<Ned, Body>], v: usize) -> Result<(), RenderError> {
        let at = |part: f64| between(poses, self.settings.part_at_row(v as f64, part));
        let of_row = [at(0.0), at(0.5), at(1.0)];
        let Self { exposure, settings, .. } = self;
        exposure.follow(&of_row, &settings.body_from_camera, &settings.model)?;
        self.look_at_paintings();
        Ok(())
    }

    /// Finds out from where and in which part of the image the paintings are seen.
    fn look_at_paintings(&mut self) {
        let reach = self.painter.reach_px();
        let [opening, closing] = &self.exposure.ends;
        for (view, painting) in self.views.iter_mut().zip(&self.paintings) {
            let look = |instant| Sight::new(painting, instant);
            view.looks = None;
            view.sights.clear();
            view.sights.extend(self.exposure.instants.iter().map_while(look));
            if let (Some(first), Some(middle), Some(last)) =
                (look(opening), look(&self.exposure.middle), look(closing))
                && view.sights.len() == self.exposure.instants.len()
                && let Some((columns, rows)) =
                    bounds_px(painting, &self.exposure, &self.lens, &self.settings.model, reach)
            {
                view.looks = Some([first, middle, last]);
                (view.columns, view.rows) = (columns, rows);
            }
        }
    }

    /// Paints all that is painted into a row of tiles.
    fn paint_band(&mut self, band: usize) {
        let tile = self.lens.tile;
        self.band.tiles.fill(TileState::Bare);
        let rows = [band * tile, (band + 1) * tile - 1];
        let marks = self.paintings.len() - self.pads;
        let half = 0.5 * (tile as f64 - 1.0) + self.painter.reach_px();
        for (index, (view, painting)) in self.views.iter().zip(&self.paintings).enumerate() {
            let Some(looks) = &view.looks else { continue };
            if rows[1] < view.rows[0] || rows[0] > view.rows[1] {
                continue;
            }
            let last = (view.columns[1] / tile).min(self.band.tiles.len().saturating_sub(1));
            for column in view.columns[0] / tile..=last {
                let centre = |index: usize| index as f64 * tile as f64 + 0.5 * (tile as f64 - 1.0);
                let lens = self.lens.about(centre(column), centre(band), 0.5 * tile as f64);
                match shown(painting, looks, &lens, half, &mut self.crossing) {
                    Shown::Even(BARE) => {}
                    Shown::Even(paint) => self.band.lay_evenly(column, tile, paint),
                    Shown::Edges(beneath) => {
                        let glimpse = Glimpse {
                            sights: &view.sights,
                            lens: &lens,
                            motion_px: view.motion_px(&lens),
                            exact: index >= marks,
                        };
                        self.painter.paint(&self.crossing, beneath, &glimpse);
                        self.band.lay(column, tile, &self.painter.tile_paint);
                    }
                }
            }
        }
    }

    /// Fills the band's light with row `v` of the image.
    fn fill_row(&mut self, v: usize) {
        let tile = self.lens.tile;
        let gain = self.levels_per_reflectance;
        let look = GroundLook::new(&self.ground, &self.exposure, &self.lens, v);
        let Band { tiles, paint, light } = &mut self.band;
        let mut column = 0;
        while let Some(state) = tiles.get(column) {
            let bare = |state: &&TileState| **state != TileState::Covered;
            let run = tiles.iter().skip(column).take(RUN).take_while(bare).count();
            if *state != TileState::Covered
                && let Some(span) = light.get_mut(column * tile..(column + run) * tile)
            {
                look.fill(column, run, span);
            }
            column += run.max(1);
        }
        for (column, (span, state)) in light.chunks_exact_mut(tile).zip(&*tiles).enumerate() {
            let start = (column * tile + v % tile) * tile;
            let (cover, own) = (paint.cover.get(start..), paint.light.get(start..));
            let (Some(cover), Some(own)) = (cover, own) else { continue };
            match state {
                TileState::Bare => span.iter_mut().for_each(|value| *value *= gain),
                TileState::Mixed => {
                    for ((value, cover), own) in span.iter_mut().zip(cover).zip(own) {
                        *value = (*value * (1.0 - cover) + own) * gain;
                    }
                }
                TileState::Covered => {
                    span.iter_mut().zip(own).for_each(|(value, own)| *value = own * gain);
                }
            }
        }
    }
}

/// Tiles over which the ground's perspective counts as linear.
const RUN: usize = 8;

impl Band {
    /// Lays one paint over a tile.
    fn lay_evenly(&mut self, column: usize, tile: usize, paint: Paint) {
        let Some(state) = self.tiles.get_mut(column) else { return };
        let range = column * tile * tile..(column + 1) * tile * tile;
        let (Some(cover), Some(light)) =
            (self.paint.cover.get_mut(range.clone()), self.paint.light.get_mut(range))
        else {
            return;
        };
        if paint.cover == 1.0 || *state == TileState::Bare {
            cover.fill(paint.cover);
            light.fill(paint.light);
        } else {
            cover.iter_mut().for_each(|c| *c = *c * (1.0 - paint.cover) + paint.cover);
            light.iter_mut().for_each(|l| *l = *l * (1.0 - paint.cover) + paint.light);
        }
        *state = if paint.cover == 1.0 { TileState::Covered } else { TileState::Mixed };
    }

    /// Lays a painted tile over what is there.
    fn lay(&mut self, column: usize, tile: usize, paint: &Channels) {
        let Some(state) = self.tiles.get_mut(column) else { return };
        let range = column * tile * tile..(column + 1) * tile * tile;
        let (Some(cover), Some(light)) =
            (self.paint.cover.get_mut(range.clone()), self.paint.light.get_mut(range))
        else {
            return;
        };
        if *state == TileState::Bare {
            cover.copy_from_slice(&paint.cover);
            light.copy_from_slice(&paint.light);
        } else {
            let below = cover.iter_mut().zip(light.iter_mut());
            for ((c, l), (own_c, own_l)) in below.zip(paint.cover.iter().zip(&paint.light)) {
                *l = *l * (1.0 - own_c) + own_l;
                *c = *c * (1.0 - own_c) + own_c;
            }
        }
        if *state != TileState::Covered {
            *state = TileState::Mixed;
        }
    }
}

/// The ground and the sky along a row of the image.
struct GroundLook<'a> {
    ground: &'a Ground,
    lens: &'a Lens,
    v: usize,
    middle: Eye,
    ends: [Eye; 2],
    moves: bool,
}

/// A camera's place and its rotation's rows.
#[derive(Copy, Clone)]
struct Eye {
    place: [f64; 3],
    turn: [[f64; 3]; 3],
}

/// Where a ray meets the ground.
#[derive(Copy, Clone)]
struct Hit {
    place_m: [f64; 2],
    /// Length along the optical axis, in metres; not positive or very large when the ray looks past the ground.
    reach_m: f64,
    /// Length of the ray over its depth below the camera.
    slant: f64,
}

impl Eye {
    fn new(ned_from_camera: &Transform<Ned, Camera>) -> Self {
        let turn = ned_from_camera.isometry.rotation.to_rotation_matrix();
        let origin = ned_from_camera.origin();
        Self {
            place: [origin.x(), origin.y(), origin.z()],
            turn: [0, 1, 2].map(|i| [0, 1, 2].map(|j| turn[(i, j)])),
        }
    }

    /// The ray through ideal image coordinates, in NED.
    fn ray(&self, ideal: [f64; 2]) -> [f64; 3] {
        self.turn.map(|row| row[0] * ideal[0] + row[1] * ideal[1] + row[2])
    }

    fn hit(&self, ideal: [f64; 2]) -> Hit {
        let ray = self.ray(ideal);
        let reach_m = -self.place[2] / ray[2];
        let place_m = [0, 1].map(|i| self.place[i] + ray[i] * reach_m);
        let slant = (1.0 + ideal[0] * ideal[0] + ideal[1] * ideal[1]).sqrt() / ray[2];
        Hit { place_m, reach_m, slant }
    }
}

impl Hit {
    fn is_ground(&self) -> bool {
        self.reach_m > 0.0 && self.reach_m < FARTHEST_GRAIN_M
    }
}

impl<'a> GroundLook<'a> {
    fn new(ground: &'a Ground, exposure: &Exposure, lens: &'a Lens, v: usize) -> Self {
        Self {
            ground,
            lens,
            v,
            middle: Eye::new(&exposure.middle),
            ends: [Eye::new(&exposure.ends[0]), Eye::new(&exposure.ends[1])],
            moves: exposure.motion_px > 0.5,
        }
    }

    fn node(&self, column: usize) -> ([f64; 2], Hit, f32) {
        let ideal = self.lens.at_node(column, self.v);
        let hit = self.middle.hit(ideal);
        let patch = if hit.is_ground() { self.ground.patch(hit.place_m) } else { 0.0 };
        (ideal, hit, patch)
    }

    /// Fills the pixels of `run` tiles from `column` on.
    fn fill(&self, column: usize, run: usize, span: &mut [f32]) {
        if self.middle.place[2] >= 0.0 {
            span.fill(UNDERGROUND);
            return;
        }
        let (ideal, from, patch) = self.node(column);
        let (ideal_to, to, patch_to) = self.node(column + run);
        if !(from.is_ground() && to.is_ground()) {
            self.fill_horizon(ideal, ideal_to, span);
            return;
        }
        let count = span.len().max(1) as f64;
        let step = (patch_to - patch) / count as f32;
        for (index, value) in span.iter_mut().enumerate() {
            *value = patch + step * index as f32;
        }
        let middle = [0, 1].map(|i| 0.5 * (ideal[i] + ideal_to[i]));
        let smear_m = if self.moves { self.smear(middle) } else { [0.0; 2] };
        let pixel = length([0, 1].map(|i| ideal_to[i] - ideal[i])) / count;
        let footprint_m = pixel * from.reach_m * from.slant.abs().sqrt();
        let span_m = Span { from_m: from.place_m, to_m: to.place_m, smear_m, footprint_m };
        self.ground.add_grain(&span_m, span);
    }

    /// How far a pixel moves over the ground.
    fn smear(&self, ideal: [f64; 2]) -> [f64; 2] {
        let [first, last] = self.ends.map(|eye| eye.hit(ideal));
        if first.is_ground() && last.is_ground() {
            [0, 1].map(|i| last.place_m[i] - first.place_m[i])
        } else {
            [0.0; 2]
        }
    }

    /// Pixel by pixel, without grain.
    fn fill_horizon(&self, from: [f64; 2], to: [f64; 2], span: &mut [f32]) {
        let count = span.len().max(1) as f64;
        let pixel = length([0, 1].map(|i| to[i] - from[i])) / count;
        for (index, value) in span.iter_mut().enumerate() {
            let part = index as f64 / count;
            let ray = self.middle.ray([0, 1].map(|i| from[i] + (to[i] - from[i]) * part));
            let ground = (ray[2] / pixel + 0.5).clamp(0.0, 1.0) as f32;
            *value = SKY + (self.ground.mean() - SKY) * ground;
        }
    }
}

/// Euclidean length, without the care of `hypot` for very large and very small ones.
fn length([x, y]: [f64; 2]) -> f64 {
    (x * x + y * y).sqrt()
}

/// Columns and rows of pixels, first and last.
type Bounds = ([usize; 2], [usize; 2]);

/// The pixels that may show a painting during an exposure; `None` when there are none.
fn bounds_px(
    painting: &Painting,
    exposure: &Exposure,
    lens: &Lens,
    model: &CameraModel,
    reach: f64,
) -> Option<Bounds> {
    let last = [model.width, model.height].map(|edge| edge as usize - 1);
    let (ideal_min, ideal_max) = lens.field(reach + BEND_PX);
    let (mut min, mut max) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let mut in_front = true;
    // How many of all corners lie beyond the left, top, right and bottom of the view.
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
    // The corners in a picture that a lens distorts do not bound what lies between them.
    if !in_front || model.distortion != Distortion::None {
        return Some(([0, last[0]], [0, last[1]]));
    }
    let (focal, centre) = ([model.fx, model.fy], [model.cx, model.cy]);
    let bound = |i: usize| {
        let from = (min[i] * focal[i] + centre[i] - reach - BEND_PX).max(0.0);
        let to = (max[i] * focal[i] + centre[i] + reach + BEND_PX).min(last[i] as f64);
        (from <= to).then_some([from.floor() as usize, to.ceil() as usize])
    };
    Some((bound(0)?, bound(1)?))
}

/// Between the instants of an exposure the way of a corner may bend by so many pixels.
const BEND_PX: f64 = 1.0;

fn painting_of(pad: &PadInScene) -> Result<Painting, RenderError> {
    let finite = |value: f64| value.is_finite() && value >= 0.0;
    if !(finite(pad.paper_m) && finite(pad.thickness_m) && pad.ned_from_marker.origin().is_finite())
    {
        return Err(RenderError::Setting(
            "a pad's marker has no size or no id, or its place is not finite",
        ));
    }
    let half_m = pad.paper_m / 2.0;
    let opaque = |area, light| Coat { area, paint: Paint { cover: 1.0, light }, within: None };
    let lid = Area::Rectangle([-half_m; 2], [half_m; 2]);
    let mut coats =
        vec![opaque(Area::Box, SIDES), Coat { within: Some(SIDES), ..opaque(lid, WHITE) }];
    for layer in &pad.drawing.layers {
        let area = match layer.shape {
            Shape::Disc { centre_m, radius_m } => Area::Disc { centre: centre_m, radius: radius_m },
            Shape::Rectangle { min_m, max_m } => Area::Rectangle(min_m, max_m),
        };
        let light = match layer.ink {
            Ink::Black => BLACK,
            Ink::White => WHITE,
        };
        coats.push(Coat { within: ground_of(&area, &coats), ..opaque(area, light) });
    }
    Ok(Painting {
        ned_from_plane: pad.ned_from_marker,
        half_extent_m: half_m,
        thickness_m: pad.thickness_m,
        coats,
    })
}

/// The light of the one coat that a rectangle lies upon: rectangles side by side add up to one without a seam.
fn ground_of(area: &Area, below: &[Coat]) -> Option<f32> {
    let Area::Rectangle(min, max) = area else { return None };
    // Edges that coincide differ by rounding.
    let slack = 1e-6 * (max[0] - min[0]).min(max[1] - min[1]);
    for coat in below.iter().rev() {
        let Area::Rectangle(low, high) = &coat.area else { return None };
        let apart = |i: usize| min[i] > high[i] - slack || max[i] < low[i] + slack;
        let inside = |i: usize| min[i] >= low[i] - slack && max[i] <= high[i] + slack;
        if inside(0) && inside(1) {
            return Some(coat.paint.light);
        }
        if !(apart(0) || apart(1)) {
            return None;
        }
    }
    None
}

/// Lines, discs and rings on the ground, clear of the pads.
fn painted_marks(scene: &Scene, seed: u64) -> Vec<Painting> {
    const SPREAD_M: f64 = 5.0;
    let mut rng = ChaCha8Rng::seed_from_u64(seed ^ 0x6d_6172_6b73);
    let about = scene.pads.first().map_or(Point::origin(), |pad| pad.ned_from_marker.origin());
    let mut marks = Vec::new();
    for _ in 0..scene.painted_marks {
        let paint = Paint { cover: 1.0, light: rng.random_range(0.35..0.7) };
        let light = if rng.random::<f64>() < 0.25 { Paint { light: 0.06, ..paint } } else { paint };
        let (kind, size_m): (u32, f64) = (rng.random_range(0..3), rng.random_range(0.05..0.5));
        let coat = |area, paint| Coat { area, paint, within: None };
        let disc = |radius| Area::Disc { centre: [0.0; 2], radius };
        let (half_extent_m, coats) = match kind {
            0 => {
                let half = [rng.random_range(0.02..0.08), 3.0 * size_m];
                (half[1], vec![coat(Area::Rectangle(half.map(|h| -h), half), light)])
            }
            1 => (size_m, vec![coat(disc(size_m), light)]),
            _ => {
                let inner = size_m * rng.random_range(0.4..0.9);
                (size_m, vec![coat(disc(size_m), light), coat(disc(inner), BARE)])
            }
        };
        let mut offset = || rng.random_range(-SPREAD_M..SPREAD_M);
        let place = Point::<Ned>::new(about.x() + offset(), about.y() + offset(), 0.0);
        let turn = rng.random_range(0.0..std::f64::consts::TAU);
        let near = |pad: &PadInScene| {
            let clear_m = half_extent_m * 1.5 + pad.paper_m;
            (pad.ned_from_marker.origin() - place).horizontal_norm() < clear_m
        };
        if !scene.pads.iter().any(near) {
            let up = Rotation::<Ned, MarkerFrame>::from_euler(std::f64::consts::PI, 0.0, turn);
            let ned_from_plane = Transform::new(up, place);
            marks.push(Painting { ned_from_plane, half_extent_m, thickness_m: 0.0, coats });
        }
    }
    marks
}
