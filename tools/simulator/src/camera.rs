//! Implements the simulated camera as a function of the simulation: which frames it takes, how they are delayed, and
//! their pixels.

use anyhow::Context;
use geometry::{Body, Camera, Marker, Ned, Pixel, Rotation, Transform, Vector};
use imaging::GrayView;
use messages::{CameraControl, ControllerStatus, Detections};
use rendering::occluder::Line;
use rendering::{CameraSettings, Occluder, RenderError, Renderer, Scene};
use world::camera::{Passage, Shutter};
use world::pad::PadState;
use world::vehicle::VehicleTruth;

use crate::config::{Config, OccluderKind, OccluderSettings};
use crate::exposing::Exposing;

/// Number of poses during an exposure.
const POSES: usize = 5;
/// Grey level of an object that covers the marker.
const COVER_LEVEL: f32 = 40.0;
/// Direction of the normal of a shadow's edge in the image, in radians.
const SHADOW_NORMAL: f64 = 0.5;
/// Width of a shadow's edge, in pixels.
const SHADOW_PENUMBRA_PX: f32 = 2.0;
/// Grey levels that glare of strength 1 adds.
const GLARE_LEVELS: f64 = 400.0;

/// A frame to take.
#[derive(Copy, Clone, Debug)]
pub struct FrameRequest {
    /// The frame's number.
    pub sequence: u64,
    /// Time of mid-exposure, in seconds of the simulation.
    pub time_s: f64,
    /// The same as a stamp.
    pub stamp_ns: i64,
    /// Time since the beginning of the scenario, in seconds.
    pub begun_s: Option<f64>,
    /// The pad at that time.
    pub pad: PadState,
}

/// The simulated camera.
#[derive(Debug)]
pub struct SimCamera {
    scene: Scene,
    settings: CameraSettings,
    true_settings: CameraSettings,
    seed: u64,
    renderer: Option<Renderer>,
    shutter: Shutter,
    occluder: OccluderSettings,
    marker_m: f64,
    exposing: Exposing,
    control: CameraControl,
    light: LightSettings,
    /// Exposure time times gain times light for which the levels of haze and glare between camera and pad are stated.
    nominal: f64,
}

/// The light on the scene.
#[derive(Copy, Clone, Debug)]
struct LightSettings {
    light: f64,
    /// By how many stops it changes, and when, in seconds of the scenario.
    step_stops: f64,
    step_at_s: f64,
}

impl LightSettings {
    fn at(self, begun_s: Option<f64>) -> f64 {
        let has_changed = begun_s.is_some_and(|now_s| now_s >= self.step_at_s);
        self.light * if has_changed { self.step_stops.exp2() } else { 1.0 }
    }
}

impl SimCamera {
    /// The camera of this configuration.
    ///
    /// # Errors
    /// When the scene is invalid.
    pub fn new(config: &Config) -> anyhow::Result<Self> {
        let scene = config.scene().map_err(anyhow::Error::msg)?;
        let settings = config.camera_settings();
        let shutter = Shutter::new(config.camera.faults(), config.seed);
        let [roll, pitch] = shutter.mount_error_rad();
        let nominal = settings.body_from_camera;
        let camera = &config.camera;
        let [turned_roll, turned_pitch, turned_yaw] =
            [camera.mount_roll_deg, camera.mount_pitch_deg, camera.mount_yaw_deg]
                .map(f64::to_radians);
        let tilt = Rotation::<Body, Body>::from_euler(turned_roll, turned_pitch, turned_yaw)
            * Rotation::<Body, Body>::from_euler(roll, pitch, 0.0);
        let body_from_camera = Transform::new(tilt * nominal.rotation(), nominal.origin());
        let marker = config.pad_marker().map_err(anyhow::Error::msg)?;
        let ground = &config.ground;
        let light = LightSettings {
            light: ground.light,
            step_stops: ground.light_step_stops,
            step_at_s: ground.light_step_at_s,
        };
        let usual = config.exposed_for(ground.light);
        Ok(Self {
            true_settings: CameraSettings { body_from_camera, ..settings.clone() },
            exposing: Exposing::new(config, &settings),
            control: CameraControl::default(),
            light,
            nominal: usual.exposure_s * usual.gain * ground.light,
            scene,
            settings,
            seed: config.seed,
            renderer: None,
            shutter,
            occluder: config.occluder.clone(),
            marker_m: marker.size_m.unwrap_or_default(),
        })
    }

    /// The published camera, without the error of its mount; exposure and gain are those of the frame that was opened last.
    pub fn settings(&self) -> &CameraSettings {
        &self.settings
    }

    /// The true pose of the pad's marker, seen from a vehicle in this state.
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
    pub fn open(&mut self, request: &FrameRequest, truth: &VehicleTruth) -> Option<Passage> {
        let setting = self.exposing.open(request.sequence);
        (self.settings.exposure_s, self.settings.gain) = (setting.exposure_s, setting.gain);
        let height_m = request.pad.position.z() - truth.position.z();
        self.shutter.take(request.begun_s, height_m)
    }

    /// Takes a detector's message: where the pad is, for the exposure.
    pub fn detected(&mut self, message: &Detections) {
        self.exposing.detected(message);
    }

    /// Takes a controller's status: the detector that it uses, and the marker that it lands on.
    pub fn follow(&mut self, status: &ControllerStatus) {
        self.exposing.follow(status);
    }

    /// The message about the exposure after the frame that was rendered last, without its header.
    pub fn control(&self) -> &CameraControl {
        &self.control
    }

    /// Renders a frame into `out`. `truth_at` gives the vehicle's state at a time, in seconds of the
    /// simulation.
    ///
    /// # Errors
    /// When the camera's settings or a pose are invalid, or `out` does not have the size of the image.
    pub fn render(
        &mut self,
        request: &FrameRequest,
        truth_at: impl Fn(f64) -> VehicleTruth,
        out: &mut [u8],
    ) -> anyhow::Result<()> {
        let exposure_s = self.settings.exposure_s;
        let pose = |i: usize| {
            let aside_s = exposure_s * (i as f64 / (POSES - 1) as f64 - 0.5);
            let truth = truth_at(request.time_s + aside_s);
            // The renderer's pad is stationary, so the vehicle moves relative to it.
            let carried = request.pad.velocity * -aside_s;
            Transform::<Ned, Body>::new(truth.ned_from_body, truth.position + carried)
        };
        let poses: Vec<_> = (0..POSES).map(pose).collect();
        let occluder = self.occluder(request, &truth_at(request.time_s));
        let pads: Vec<_> = (0..self.scene.pads.len())
            .filter_map(|i| self.ned_from_marker(i, &request.pad))
            .collect();
        let light = self.light.at(request.begun_s);
        let CameraSettings { exposure_s, gain, .. } = self.settings;
        let renderer = self.renderer().context("setting up the simulated camera")?;
        renderer.expose(exposure_s, gain, light)?;
        for (index, pad) in pads.into_iter().enumerate() {
            renderer.move_pad(index, pad);
        }
        let mut apply = |v: usize, light: &mut [f32]| occluder.apply(v, light);
        renderer.render_through(&mut apply, &poses, request.sequence, out)?;
        let model = &self.settings.model;
        let frame = GrayView::packed(out, model.width as usize, model.height as usize)?;
        self.control = self.exposing.taken(request.sequence, request.stamp_ns, frame);
        Ok(())
    }

    /// Created with the first frame: generating the ground takes long, and modelled vision does not need it.
    fn renderer(&mut self) -> Result<&mut Renderer, RenderError> {
        if self.renderer.is_none() {
            let renderer = Renderer::new(&self.scene, self.true_settings.clone(), self.seed)?;
            return Ok(self.renderer.insert(renderer));
        }
        self.renderer.as_mut().ok_or(RenderError::NoPose)
    }

    /// The pose of a pad of the scene. All pads move together with the first.
    fn ned_from_marker(&self, index: usize, pad: &PadState) -> Option<Transform<Ned, Marker>> {
        let first = self.scene.pads.first()?.ned_from_marker;
        let rest = self.scene.pads.get(index)?.ned_from_marker;
        let turned = pad.ned_from_marker().rotation() * first.rotation().inverse();
        let beside = turned * (rest.origin() - first.origin());
        // The marker is on the lid of a box on the pad.
        let lid = Vector::new(0.0, 0.0, -self.scene.pads.first()?.thickness_m);
        Some(Transform::new(turned * rest.rotation(), pad.position + lid + beside))
    }

    fn occluder(&self, request: &FrameRequest, truth: &VehicleTruth) -> Occluder {
        let OccluderSettings { kind, strength, at_s, for_s, below_m, beside_m } = self.occluder;
        let is_time = request.begun_s.is_some_and(|now_s| (at_s..at_s + for_s).contains(&now_s));
        let is_low = request.pad.position.z() - truth.position.z() < below_m;
        let camera_from_marker = self.camera_from_marker(truth, &request.pad);
        let model = &self.settings.model;
        let Some(centre) = model.project(camera_from_marker.origin()) else {
            return Occluder::None;
        };
        let size_px = self.marker_m * model.fx / camera_from_marker.origin().z();
        // Added light is also brighter in a frame that is exposed longer.
        let CameraSettings { exposure_s, gain, .. } = self.settings;
        let exposed = exposure_s * gain * self.light.at(request.begun_s) / self.nominal;
        match kind {
            _ if !(is_time && is_low) => Occluder::None,
            OccluderKind::None => Occluder::None,
            OccluderKind::Glare => Occluder::Glare {
                centre: Pixel::new(centre.x + 0.5 * size_px, centre.y),
                radius_px: (0.5 * size_px) as f32,
                levels: (GLARE_LEVELS * strength * exposed) as f32,
            },
            OccluderKind::Cover => {
                let through = Pixel::new(centre.x + size_px * (0.5 - strength), centre.y);
                Occluder::Cover {
                    edge: Line { through, normal: 0.0 },
                    level: COVER_LEVEL * exposed as f32,
                }
            }
            OccluderKind::Shadow => {
                // Turned against the marker's sides; the pad is in the shade when its edge is next to it.
                let beside_px = beside_m * model.fx / camera_from_marker.origin().z();
                let (sin, cos) = SHADOW_NORMAL.sin_cos();
                let through = Pixel::new(centre.x - beside_px * cos, centre.y - beside_px * sin);
                Occluder::Shadow {
                    edge: Line { through, normal: SHADOW_NORMAL },
                    penumbra_px: SHADOW_PENUMBRA_PX,
                    transmission: 1.0 - strength as f32,
                }
            }
            OccluderKind::Haze => Occluder::Haze {
                transmission: 1.0 - strength as f32,
                levels: (120.0 * strength * exposed) as f32,
            },
        }
    }
}
