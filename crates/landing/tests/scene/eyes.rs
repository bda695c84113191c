//! Camera and detector: the detector's model of `crates/world` behind a camera that looks down.

use std::collections::VecDeque;

use geometry::{Body, Camera, CameraModel, Marker, Ned, Point, Rotation, Transform, Vector};
use landing::{FrameObservation, MarkerInFrame, Timestamp};
use world::World;
use world::camera::Shutter;
use world::pad::PadState;
use world::vehicle::VehicleTruth;
use world::vision::{Vision, VisionModel};

use super::Scene;

/// The thesis' camera and marker.
const IMAGE_SIZE: (u32, u32) = (1296, 972);
const FOCAL_PX: f64 = 1818.0;
const MARKER_M: f64 = 0.153_41;
/// Height of the camera over the vehicle's lowest point, in metres.
const MOUNT_M: f64 = 0.12;

/// A detector with more noise than `world::vision::RINGS`, without blur and wild errors.
const DETECTOR: VisionModel = VisionModel {
    never_px: [8.0, 0.0],
    always_px: [16.0, 0.0],
    miss: 0.0,
    centre_px: 0.2,
    centre_per_blur: 0.0,
    size_px: 0.25,
    size_per_blur: 0.0,
    range_bias: 0.0,
    tilt_rad_px: 0.0,
    tilt_rad: 0.0,
    reported: [1.0, 1.0],
    outliers: 0.0,
    outlier_times: 1.0,
};

/// The camera, its detector, and the frames in transit.
pub(crate) struct Eyes {
    shutter: Shutter,
    vision: Vision,
    due_s: f64,
    in_transit: VecDeque<(f64, FrameObservation)>,
}

impl Eyes {
    pub(crate) fn new(scene: &Scene) -> Self {
        let (width, height) = IMAGE_SIZE;
        let model = CameraModel::pinhole(width, height, FOCAL_PX);
        let marker_m = MARKER_M * scene.marker_scale;
        Self {
            shutter: Shutter::new(scene.camera.clone(), scene.seed),
            vision: Vision::new(DETECTOR, model, marker_m, scene.seed),
            due_s: 0.0,
            in_transit: VecDeque::new(),
        }
    }

    /// Takes a frame when one is due.
    pub(crate) fn look(&mut self, scene: &Scene, world: &World, now_s: f64) {
        if now_s < self.due_s {
            return;
        }
        self.due_s = now_s + 1.0 / scene.frames_hz - 1e-6;
        let (truth, pad) = (world.truth(), world.pad_at(world.now_s()));
        let marker = self.detect(scene, &truth, pad, now_s);
        let height_m = pad.position.z() - truth.position.z();
        let Some(passage) = self.shutter.take(Some(now_s), height_m) else { return };
        let frame = FrameObservation {
            stamp: Timestamp::from_seconds(now_s + passage.stamp_error_s),
            image_size: IMAGE_SIZE,
            focal_px: Some(FOCAL_PX),
            body_from_camera: Some(mount()),
            marker,
        };
        for after_s in [Some(passage.arrives_after_s), passage.again_after_s].into_iter().flatten()
        {
            let arrives_s = now_s + after_s;
            let index = self.in_transit.partition_point(|(at, _)| *at <= arrives_s);
            self.in_transit.insert(index, (arrives_s, frame));
        }
    }

    /// The next frame that has arrived.
    pub(crate) fn arrived(&mut self, now_s: f64) -> Option<FrameObservation> {
        let is_due = self.in_transit.front().is_some_and(|(at, _)| *at <= now_s);
        if is_due { self.in_transit.pop_front().map(|(_, frame)| frame) } else { None }
    }

    fn detect(
        &mut self,
        scene: &Scene,
        truth: &VehicleTruth,
        mut pad: PadState,
        now_s: f64,
    ) -> Option<MarkerInFrame> {
        let faults = &scene.vision;
        let [miss, wrong] = [(); 2].map(|()| self.vision.draw());
        if let Some((part, metres)) = faults.wrong
            && wrong < part
        {
            pad.position = pad.position + Vector::new(0.0, metres, 0.0);
        }
        if let Some((from_s, to_s, metres)) = faults.offset
            && (from_s..to_s).contains(&now_s)
        {
            pad.position = pad.position + Vector::new(metres, 0.0, 0.0);
        }
        let camera_from_marker = self.camera_from_marker(scene, truth, &pad);
        let is_blind = camera_from_marker.origin().z() < faults.blind_below_m;
        let found = self.vision.look(&camera_from_marker, 0.0);
        let found = found.filter(|_| miss >= faults.miss && !is_blind)?;
        let seen = found.camera_from_marker;
        let range = 1.0 + faults.size_error;
        let in_camera = (seen.origin() - Point::origin()) * range;
        let depth_m = in_camera.z() / scene.focal_ratio;
        let in_body = mount() * Vector::new(in_camera.x(), in_camera.y(), depth_m);
        let camera = Point::new(0.0, 0.0, scene.standing_m - MOUNT_M);
        let origin = camera + misread(scene, in_body);
        let to_body = mount().quaternion.to_rotation_matrix().into_inner();
        let covariance_m2 = to_body * found.covariance_m2 * to_body.transpose();
        Some(MarkerInFrame {
            centre: found.centre,
            body_from_marker: Some(Transform::new(mount() * seen.rotation(), origin)),
            alternative: None,
            covariance_m2: scene.has_covariance.then_some(covariance_m2),
            size_px: Some(found.size_px),
            confidence: 0.9,
        })
    }

    /// The marker seen by the camera as it is really mounted: with a small error that the controller does not
    /// know.
    fn camera_from_marker(
        &self,
        scene: &Scene,
        truth: &VehicleTruth,
        pad: &PadState,
    ) -> Transform<Camera, Marker> {
        let [roll, pitch] = self.shutter.mount_error_rad();
        let error = Rotation::<Body, Body>::from_euler(roll, pitch, 0.0);
        let [roll, pitch] = scene.mount_off_rad;
        let off = Rotation::<Body, Body>::from_euler(roll, pitch, 0.0);
        let camera_from_body = mount().inverse() * off.inverse() * error;
        let lens = truth.position + truth.ned_from_body * Vector::new(0.0, 0.0, -MOUNT_M);
        let ned_from_marker = pad.ned_from_marker();
        let camera_from_ned: Rotation<Camera, Ned> =
            camera_from_body * truth.ned_from_body.inverse();
        let origin = Point::origin() + camera_from_ned * (ned_from_marker.origin() - lens);
        Transform::new(camera_from_ned * ned_from_marker.rotation(), origin)
    }
}

/// The configured mount: image right is the vehicle's right, image up its forward.
fn mount() -> Rotation<Body, Camera> {
    Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2)
}

/// The position that is reported when the camera is not mounted as configured.
fn misread(scene: &Scene, v: Vector<Body>) -> Vector<Body> {
    let (sin, cos) = scene.camera_turned_rad.sin_cos();
    let (x, y) = (cos * v.x() + sin * v.y(), cos * v.y() - sin * v.x());
    Vector::new(x, if scene.mirrored { -y } else { y }, v.z())
}
