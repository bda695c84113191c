//! Makes a detector's message from the simulated world: rendered frames with the real detector, or a model of
//! its errors.

use anyhow::Context;
use detector::wire;
use fiducial::Detector;
use geometry::{Camera, CameraModel, Transform, Vector};
use imaging::GrayView;
use markers::Marker;
use messages::{CameraInfo, Detection, Detections, FrameHeader, MarkerPose, PixelFormat};
use nalgebra::Matrix6;
use node::{Layers, clock_name};
use simulator::camera::{FrameRequest, SimCamera};
use world::World;
use world::vehicle::VehicleTruth;
use world::vision::{Found, RINGS, Vision, VisionFaults};

use super::plan;

/// The name of the detector.
pub const DETECTOR: &str = "main";
/// Time step for the marker's velocity in the image, in seconds.
const BLUR_STEP_S: f64 = 1e-3;

/// Camera and detector of one flight.
pub struct SimVision {
    camera: SimCamera,
    detector: SimDetector,
    info: CameraInfo,
    model: CameraModel,
    faults: VisionFaults,
    marker: Marker,
}

enum SimDetector {
    Rendered { detector: Box<Detector>, pixels: Vec<u8> },
    Modelled(Box<Vision>),
}

/// A message with its time of arrival.
#[derive(Clone, Debug)]
pub struct Arrival {
    /// Time of arrival, in seconds of the world.
    pub at_s: f64,
    /// The message.
    pub message: Detections,
}

impl SimVision {
    /// The vision of a simulator's configuration.
    ///
    /// # Errors
    /// When the scene or the marker is invalid.
    pub fn new(
        config: &simulator::Config,
        how: plan::Vision,
        faults: VisionFaults,
    ) -> anyhow::Result<Self> {
        let camera = SimCamera::new(config)?;
        let marker = config.pad_marker().map_err(anyhow::Error::msg)?;
        let settings = camera.settings();
        let model = settings.model;
        let detector = match how {
            plan::Vision::Rendered => {
                let set = vec![format!("markers=[\"{}\"]", config.pad.marker)];
                let detector = Layers { file: None, set }.load::<detector::Config>()?.settings;
                SimDetector::Rendered {
                    detector: Box::new(detector.detector().map_err(anyhow::Error::msg)?),
                    pixels: vec![0; model.width as usize * model.height as usize],
                }
            }
            plan::Vision::Modelled => {
                let size_m = marker.size_m.context("the pad's marker has no size")?;
                SimDetector::Modelled(Box::new(Vision::new(RINGS, model, size_m, config.seed)))
            }
        };
        let info = CameraInfo::new(&config.camera.name, &model, &settings.body_from_camera);
        Ok(Self { camera, detector, info, model, faults, marker })
    }

    /// The camera information for the controller.
    pub fn info(&self) -> &CameraInfo {
        &self.info
    }

    /// Exposure time, in seconds.
    pub fn exposure_s(&self) -> f64 {
        self.camera.settings().exposure_s
    }

    /// Passes a detector's detections to the camera, for its exposure.
    pub fn detected(&mut self, message: &Detections) {
        self.camera.detected(message);
    }

    /// Takes a frame and finds the marker. `stamp_ns` converts the time of the world to a stamp.
    ///
    /// # Errors
    /// When a frame cannot be rendered.
    pub fn observe(
        &mut self,
        world: &World,
        sequence: u64,
        time_s: f64,
        stamp_ns: impl Fn(f64) -> i64,
    ) -> anyhow::Result<Vec<Arrival>> {
        let truth = world.truth_at(time_s);
        let begun_s = world.since_begin_s(time_s);
        let pad = world.pad_at(time_s);
        let request = FrameRequest { sequence, time_s, stamp_ns: stamp_ns(time_s), begun_s, pad };
        let Some(passage) = self.camera.open(&request, &truth) else { return Ok(Vec::new()) };
        let detections = match &mut self.detector {
            SimDetector::Rendered { detector, pixels } => {
                self.camera.render(&request, |s| world.truth_at(s), pixels)?;
                let (width, height) = (self.info.width as usize, self.info.height as usize);
                let view = GrayView::packed(pixels, width, height).context("an image")?;
                let found = detector.detect(view, Some(&self.model), &mut ());
                found.iter().map(wire::detection).collect()
            }
            SimDetector::Modelled(_) => self.model_detections(world, &request, &truth),
        };
        let header = FrameHeader {
            camera: self.info.camera.clone(),
            sequence,
            stamp_ns: stamp_ns(time_s + passage.stamp_error_s),
            clock: clock_name().to_owned(),
            exposure_ns: (self.exposure_s() * 1e9) as u32,
            width: self.info.width,
            height: self.info.height,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        };
        let message =
            Detections { detector: DETECTOR.to_owned(), header, detections, stages: Vec::new() };
        let arrivals = [Some(passage.arrives_after_s), passage.again_after_s];
        Ok(arrivals
            .into_iter()
            .flatten()
            .map(|after_s| Arrival { at_s: time_s + after_s, message: message.clone() })
            .collect())
    }

    fn model_detections(
        &mut self,
        world: &World,
        request: &FrameRequest,
        truth: &VehicleTruth,
    ) -> Vec<Detection> {
        let SimDetector::Modelled(vision) = &mut self.detector else { return Vec::new() };
        let mut pad = request.pad;
        let camera_from_marker = self.camera.camera_from_marker(truth, &pad);
        let before = self.camera.camera_from_marker(
            &world.truth_at(request.time_s - BLUR_STEP_S),
            &world.pad_at(request.time_s - BLUR_STEP_S),
        );
        let pixels = [&camera_from_marker, &before].map(|pose| self.model.project(pose.origin()));
        let [Some(now), Some(then)] = pixels else { return Vec::new() };
        let blur_px = now.distance(&then) / BLUR_STEP_S * self.camera.settings().exposure_s;
        let faults = self.faults;
        let (misses, luck) = (vision.draw() < faults.miss, vision.draw());
        if let Some((part, metres)) = faults.wrong
            && luck < part
        {
            pad.position = pad.position + Vector::new(0.0, metres, 0.0);
        }
        if let Some((from_s, to_s, metres)) = faults.offset
            && request.begun_s.is_some_and(|now_s| (from_s..to_s).contains(&now_s))
        {
            pad.position = pad.position + Vector::new(metres, 0.0, 0.0);
        }
        let seen = self.camera.camera_from_marker(truth, &pad);
        let low = seen.origin().z() < faults.blind_below_m;
        let found = vision.look(&seen, blur_px).filter(|_| !misses && !low);
        found.map(|found| detection(&self.marker, &found)).into_iter().collect()
    }
}

fn detection(marker: &Marker, found: &Found) -> Detection {
    let mut covariance = Matrix6::zeros();
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&found.covariance_m2);
    Detection {
        family: marker.family.name().to_owned(),
        id: marker.id,
        centre_px: [found.centre.x, found.centre.y],
        centre_covariance_px2: [0.0; 3],
        corners_px: None,
        size_px: found.size_px,
        wrong_bits: 0,
        confidence: 1.0,
        pose: Some(MarkerPose {
            camera_from_marker: (&found.camera_from_marker).into(),
            reprojection_rms_px: 0.1,
            covariance: MarkerPose::upper_triangle(&covariance),
            alternative: None,
        }),
    }
}

/// The detector's error for a known pose, to fit the model: centre x and y in pixels, relative range, tilt in
/// radians.
pub fn errors(
    model: &CameraModel,
    found: &Transform<Camera, geometry::Marker>,
    truth: &Transform<Camera, geometry::Marker>,
) -> Option<[f64; 4]> {
    let (seen, right) = (model.project(found.origin())?, model.project(truth.origin())?);
    let part = found.origin().z() / truth.origin().z() - 1.0;
    let up =
        |pose: &Transform<Camera, geometry::Marker>| pose.rotation() * Vector::new(0.0, 0.0, 1.0);
    let tilt = up(found).coords.dot(&up(truth).coords).clamp(-1.0, 1.0).acos();
    Some([seen.x - right.x, seen.y - right.y, part, tilt])
}
