//! The simulated camera as a function of the world: which frames are taken, how they travel, and their pixels.

use anyhow::Context;
use geometry::{Body, Camera, Marker, Ned, Pixel, Rotation, Transform, Vector};
use rendering::veil::Line;
use rendering::{CameraSettings, RenderError, Renderer, Scene, Veil};
use world::camera::{Passage, Shutter};
use world::pad::PadState;
use world::vehicle::VehicleTruth;

use crate::config::{Config, VeilKind, VeilSettings};

/// Poses through an exposure.
const POSES: usize = 5;
/// Grey level of what covers a marker, and what white glare adds.
const COVER_LEVEL: f32 = 40.0;
const GLARE_LEVELS: f64 = 400.0;

/// A moment that may become a frame.
#[derive(Copy, Clone, Debug)]
pub struct Moment {
    /// The frame's number.
    pub sequence: u64,
    /// Mid-exposure, in seconds of the world.
    pub time_s: f64,
    /// Time since the world's begin, in seconds.
    pub begun_s: Option<f64>,
    /// The pad then.
    pub pad: PadState,
}

/// The camera.
#[derive(Debug)]
pub struct Eye {
    scene: Scene,
    settings: CameraSettings,
    true_settings: CameraSettings,
    seed: u64,
    renderer: Option<Renderer>,
    shutter: Shutter,
    veil: VeilSettings,
    marker_m: f64,
}

impl Eye {
    /// The camera of this configuration.
    ///
    /// # Errors
    /// When the scene makes no sense.
    pub fn new(config: &Config) -> anyhow::Result<Self> {
        let scene = config.scene().map_err(anyhow::Error::msg)?;
        let settings = config.camera_settings();
        let shutter = Shutter::new(config.camera.faults(), config.seed);
        let [roll, pitch] = shutter.mount_error_rad();
        let told = settings.body_from_camera;
        let tilt = Rotation::<Body, Body>::from_euler(roll, pitch, 0.0);
        let body_from_camera = Transform::new(tilt * told.rotation(), told.origin());
        let marker = config.pad_marker().map_err(anyhow::Error::msg)?;
        Ok(Self {
            true_settings: CameraSettings { body_from_camera, ..settings.clone() },
            scene,
            settings,
            seed: config.seed,
            renderer: None,
            shutter,
            veil: config.veil.clone(),
            marker_m: marker.size_m.unwrap_or_default(),
        })
    }

    /// The camera as everybody is told, without the error of its mount.
    pub fn settings(&self) -> &CameraSettings {
        &self.settings
    }

    /// Where the pad's marker really is, from a vehicle that moves like this.
    pub fn camera_from_marker(
        &self,
        truth: &VehicleTruth,
        pad: &PadState,
    ) -> Transform<Camera, Marker> {
        let ned_from_body = Transform::new(truth.ned_from_body, truth.position);
        let ned_from_camera = ned_from_body * self.true_settings.body_from_camera;
        ned_from_camera.inverse() * self.ned_from_marker(0, pad).unwrap_or(pad.ned_from_marker())
    }

    /// Opens the shutter; `None` when the frame is lost.
    pub fn open(&mut self, moment: &Moment, truth: &VehicleTruth) -> Option<Passage> {
        let height_m = moment.pad.position.z() - truth.position.z();
        self.shutter.take(moment.begun_s, height_m)
    }

    /// The pixels of a moment, the vehicle's motion taken from `truth_at` (seconds of the world).
    ///
    /// # Errors
    /// When the camera's settings make no sense, a pose is unsound, or `out` has not the image's size.
    pub fn render(
        &mut self,
        moment: &Moment,
        truth_at: impl Fn(f64) -> VehicleTruth,
        out: &mut [u8],
    ) -> anyhow::Result<()> {
        let exposure_s = self.settings.exposure_s;
        let pose = |i: usize| {
            let aside_s = exposure_s * (i as f64 / (POSES - 1) as f64 - 0.5);
            let truth = truth_at(moment.time_s + aside_s);
            // The picture's pad stands still, so the vehicle moves as seen from the pad.
            let carried = moment.pad.velocity * -aside_s;
            Transform::<Ned, Body>::new(truth.ned_from_body, truth.position + carried)
        };
        let poses: Vec<_> = (0..POSES).map(pose).collect();
        let veil = self.veil(moment, &truth_at(moment.time_s));
        let pads: Vec<_> = (0..self.scene.pads.len())
            .filter_map(|i| self.ned_from_marker(i, &moment.pad))
            .collect();
        let renderer = self.renderer().context("setting the simulated camera up")?;
        for (index, pad) in pads.into_iter().enumerate() {
            renderer.move_pad(index, pad);
        }
        let mut dim = |v: usize, light: &mut [f32]| veil.dim(v, light);
        renderer.render_through(&mut dim, &poses, moment.sequence, out)?;
        Ok(())
    }

    /// Made when the first frame is rendered: growing the ground takes long, and modelled vision needs none.
    fn renderer(&mut self) -> Result<&mut Renderer, RenderError> {
        if self.renderer.is_none() {
            let made = Renderer::new(&self.scene, self.true_settings.clone(), self.seed)?;
            return Ok(self.renderer.insert(made));
        }
        self.renderer.as_mut().ok_or(RenderError::NoPose)
    }

    /// A pad of the scene after the way that the first of them has gone; they move as one.
    fn ned_from_marker(&self, index: usize, pad: &PadState) -> Option<Transform<Ned, Marker>> {
        let first = self.scene.pads.first()?.ned_from_marker;
        let rest = self.scene.pads.get(index)?.ned_from_marker;
        let turned = pad.ned_from_marker().rotation() * first.rotation().inverse();
        let beside = turned * (rest.origin() - first.origin());
        // The marker is on the lid of a box that stands on the pad.
        let lid = Vector::new(0.0, 0.0, -self.scene.pads.first()?.thickness_m);
        Some(Transform::new(turned * rest.rotation(), pad.position + lid + beside))
    }

    fn veil(&self, moment: &Moment, truth: &VehicleTruth) -> Veil {
        let VeilSettings { kind, strength, at_s, for_s, below_m } = self.veil;
        let is_time = moment.begun_s.is_some_and(|now_s| (at_s..at_s + for_s).contains(&now_s));
        let is_low = moment.pad.position.z() - truth.position.z() < below_m;
        let camera_from_marker = self.camera_from_marker(truth, &moment.pad);
        let model = &self.settings.model;
        let Some(centre) = model.project(camera_from_marker.origin()) else { return Veil::Nothing };
        let size_px = self.marker_m * model.fx / camera_from_marker.origin().z();
        match kind {
            _ if !(is_time && is_low) => Veil::Nothing,
            VeilKind::None => Veil::Nothing,
            VeilKind::Glare => Veil::Glare {
                centre: Pixel::new(centre.x + 0.5 * size_px, centre.y),
                radius_px: (0.5 * size_px) as f32,
                levels: (GLARE_LEVELS * strength) as f32,
            },
            VeilKind::Cover => {
                let through = Pixel::new(centre.x + size_px * (0.5 - strength), centre.y);
                Veil::Cover { edge: Line { through, normal: 0.0 }, level: COVER_LEVEL }
            }
            VeilKind::Haze => {
                Veil::Haze { left: 1.0 - strength as f32, levels: 120.0 * strength as f32 }
            }
        }
    }
}
