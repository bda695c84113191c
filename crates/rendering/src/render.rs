//! Renders a frame of a scene (ground, pads, painted marks) as the camera on a vehicle sees it at its poses during the exposure,
//! one row of tiles after the other.
//!
//! Projection is exact. Markers are averaged over each pixel's area, the lens blur and the exposure; the ground is a texture
//! sampled at the size of a pixel. A frame depends on the seed, its index and the poses only, with H.264 on those before it as
//! well.
//!
//! Modules in reading order: `exposure` has the camera's poses while the shutter is open, `lens` the
//! direction of each pixel, `painting` the part of a marker in a tile of the image, `scenery` the paintings of
//! a scene, `painter` the edges of markers, `band` a row of tiles, `ground_row` the ground along a row,
//! `sensor` turns light into grey levels, or into raw values for a camera that processes its frames.

mod band;
mod exposure;
mod ground_row;
mod lens;
mod painter;
mod painting;
mod scenery;
mod sensor;

use std::sync::Arc;

use geometry::{Body, Marker as MarkerFrame, Ned, Transform};

use crate::error::RenderError;
use crate::ground::Ground;
use crate::processing::{Developer, Processing};
use crate::scene::{CameraSettings, Scene};
use band::{Band, TileState};
use exposure::{Exposure, MAX_INSTANTS, between};
use ground_row::GroundRow;
use lens::Lens;
use painter::{Channels, Glimpse, Painter};
use painting::{BARE, Coat, Painting, Shown, Sight, View, pixel_bounds, shown};
use scenery::{pad_painting, painted_marks};
use sensor::Sensor;

/// Number of tiles over which the perspective of the ground is approximated as linear.
const LINEAR_TILES: usize = 8;

/// Renders frames of one scene with one camera.
#[derive(Debug)]
pub struct Renderer {
    settings: CameraSettings,
    lens: Lens,
    ground: Arc<Ground>,
    sensor: Sensor,
    /// For a camera that processes its frames.
    developer: Option<Developer>,
    levels_per_reflectance: f32,
    paintings: Vec<Painting>,
    /// Number of pads, which are the last paintings, in the scene's order.
    pads: usize,
    exposure: Exposure,
    views: Vec<View>,
    painter: Painter,
    /// The coats with edges in the tile being painted.
    crossing: Vec<Coat>,
    band: Band,
}

impl Renderer {
    /// A renderer whose ground, painted marks and noise grow from `seed`.
    ///
    /// # Errors
    /// [`RenderError::Setting`] for an invalid setting or size of a pad.
    pub fn new(scene: &Scene, settings: CameraSettings, seed: u64) -> Result<Self, RenderError> {
        settings.check()?;
        Self::with_ground(Arc::new(Ground::new(scene.surface, seed)), scene, settings, seed)
    }

    /// Like [`Renderer::new`], with a ground that several renderers may share.
    ///
    /// # Errors
    /// As [`Renderer::new`].
    pub fn with_ground(
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
            paintings.push(pad_painting(pad)?);
        }
        let lens = Lens::new(settings.model);
        let painter = Painter::new(&lens, settings.blur_px);
        let tiles = (settings.model.width as usize).div_ceil(lens.tile);
        let view = || View {
            looks: None,
            sights: Vec::with_capacity(MAX_INSTANTS),
            columns: [0; 2],
            rows: [0; 2],
        };
        let max_coats = paintings.iter().map(|painting| painting.coats.len()).max().unwrap_or(0);
        Ok(Self {
            ground,
            sensor: Sensor::new(&settings, seed),
            developer: if settings.processing == Processing::LINEAR {
                None
            } else {
                Some(Developer::new(&settings.processing, settings.model.width as usize)?)
            },
            levels_per_reflectance: settings.levels_per_reflectance(scene.light) as f32,
            views: paintings.iter().map(|_| view()).collect(),
            paintings,
            pads: scene.pads.len(),
            exposure: Exposure::new(),
            painter,
            crossing: Vec::with_capacity(max_coats),
            band: Band {
                tiles: vec![TileState::Bare; tiles],
                paint: Channels::new(tiles * lens.tile * lens.tile),
                light: vec![0.0; tiles * lens.tile],
            },
            lens,
            settings,
        })
    }

    /// The camera and its settings.
    pub fn settings(&self) -> &CameraSettings {
        &self.settings
    }

    /// Takes the next frames with this exposure time, in seconds, and gain, in this light on the scene.
    ///
    /// # Errors
    /// [`RenderError::Setting`] for invalid settings of camera or scene.
    pub fn expose(&mut self, exposure_s: f64, gain: f64, light: f64) -> Result<(), RenderError> {
        let settings = CameraSettings { exposure_s, gain, ..self.settings.clone() };
        settings.check()?;
        if !(light.is_finite() && light >= 0.0) {
            return Err(RenderError::Setting("the light is below 0"));
        }
        self.settings = settings;
        self.levels_per_reflectance = self.settings.levels_per_reflectance(light) as f32;
        self.sensor.amplify(&self.settings);
        Ok(())
    }

    /// Moves a pad. An invalid index is ignored.
    pub fn move_pad(&mut self, index: usize, ned_from_marker: Transform<Ned, MarkerFrame>) {
        let first = self.paintings.len() - self.pads;
        if let Some(painting) = self.paintings.get_mut(first.saturating_add(index)) {
            painting.ned_from_plane = ned_from_marker;
        }
    }

    /// Renders frame `frame_index` into `out`, row by row. `poses` are `ned_from_body` during the exposure,
    /// evenly spaced in time from the opening of the first row to the closing of the last; with one pose the
    /// vehicle is stationary. With [`crate::processing::Processing::video`] it also depends on the frames that were rendered
    /// before.
    ///
    /// # Errors
    /// [`RenderError`] when a pose is invalid or `out` does not have the size of the image.
    pub fn render(
        &mut self,
        poses: &[Transform<Ned, Body>],
        frame_index: u64,
        out: &mut [u8],
    ) -> Result<(), RenderError> {
        self.render_through(&mut |_, _| {}, poses, frame_index, out)
    }

    /// Like [`Renderer::render`], through an `occluder` between scene and sensor. It gets each row's number
    /// and its light, in grey levels before vignetting and noise, and may change the light.
    ///
    /// # Errors
    /// As [`Renderer::render`].
    pub fn render_through(
        &mut self,
        occluder: &mut dyn FnMut(usize, &mut [f32]),
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
                let light = self.band.light.get_mut(..width).unwrap_or(&mut []);
                occluder(v, light);
                let Some(developer) = &mut self.developer else {
                    self.sensor.expose(frame_index, v, light, row);
                    continue;
                };
                let row = developer.raw(width * height).chunks_mut(width).nth(v);
                row.unwrap_or(&mut []).copy_from_slice(light);
            }
        }
        let Some(developer) = &mut self.developer else { return Ok(()) };
        developer.pass_lens(frame_index);
        for (v, row) in developer.raw(width * height).chunks_mut(width).enumerate() {
            self.sensor.expose_raw(frame_index, v, row);
        }
        developer.develop(out)
    }

    /// Sets the exposure to that of one row of a rolling shutter.
    fn follow_row(&mut self, poses: &[Transform<Ned, Body>], v: usize) -> Result<(), RenderError> {
        let at = |part: f64| between(poses, self.settings.part_at_row(v as f64, part));
        let row_poses = [at(0.0), at(0.5), at(1.0)];
        let Self { exposure, settings, .. } = self;
        exposure.follow(&row_poses, &settings.body_from_camera, &settings.model)?;
        self.look_at_paintings();
        Ok(())
    }

    /// Computes from where and in which part of the image each painting is seen.
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
                && let Some(bounds) =
                    pixel_bounds(painting, &self.exposure, &self.lens, &self.settings.model, reach)
            {
                view.looks = Some([first, middle, last]);
                (view.columns, view.rows) = (bounds.columns, bounds.rows);
            }
        }
    }

    /// Paints all paintings into a row of tiles.
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
        let ground_row = GroundRow::new(&self.ground, &self.exposure, &self.lens, v);
        let Band { tiles, paint, light } = &mut self.band;
        let mut column = 0;
        while let Some(state) = tiles.get(column) {
            let bare = |state: &&TileState| **state != TileState::Covered;
            let run = tiles.iter().skip(column).take(LINEAR_TILES).take_while(bare).count();
            if *state != TileState::Covered
                && let Some(span) = light.get_mut(column * tile..(column + run) * tile)
            {
                ground_row.fill(column, run, span);
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
