//! A camera below the vehicle and a detector, as far as a landing feels them: where the marker is, when it is in view,
//! with which errors, how late, and what goes wrong.

use std::collections::VecDeque;

use geometry::{Body, CameraModel, Marker, Ned, Pixel, Point, Rotation, Transform, Vector};
use landing::{FrameObservation, MarkerInFrame, Timestamp};
use nalgebra::Matrix3;
use rand_chacha::ChaCha8Rng;

use super::Scene;
use super::chance::{normal, stream, uniform};
use super::multirotor::Multirotor;

/// The thesis' camera and marker.
const WIDTH: u32 = 1296;
const HEIGHT: u32 = 972;
pub(crate) const FOCAL_PX: f64 = 1818.0;
const MARKER_M: f64 = 0.153_41;
/// The camera over the vehicle's lowest point, in metres.
const MOUNT_M: f64 = 0.12;
/// Deviation of the marker's centre and of its edges in the image, in pixels.
const CENTRE_NOISE_PX: f64 = 0.2;
const EDGE_NOISE_PX: f64 = 0.25;
/// Markers smaller than this are seen less and less often, down to half of it, in pixels.
const SMALL_PX: f64 = 16.0;

/// What can go wrong with the detections.
#[derive(Clone, Debug)]
pub(crate) struct Faults {
    /// Part of the frames in which the marker is missed.
    pub(crate) miss: f64,
    /// Part of the frames that never arrive.
    pub(crate) drop: f64,
    /// Part of the frames that arrive twice.
    pub(crate) duplicate: f64,
    /// No frame arrives between these seconds.
    pub(crate) outage_s: Option<(f64, f64)>,
    /// No frame arrives from the first time below this height on, for so long.
    pub(crate) outage_below_m: Option<(f64, f64)>,
    /// The marker is not seen from below this height.
    pub(crate) blind_below_m: f64,
    /// Between these seconds the marker is reported beside its place by this much, in metres northwards.
    pub(crate) lie: Option<(f64, f64, f64)>,
    /// Part of the frames in which another marker, so far to the east, is taken for ours.
    pub(crate) wrong: Option<(f64, f64)>,
    /// Part of the stamps that are wrong, and by how much at most, in seconds.
    pub(crate) stamp_jumps: Option<(f64, f64)>,
    /// By how much the detector's size of the marker is wrong, as a part.
    pub(crate) size_error: f64,
}

impl Faults {
    pub(crate) const USUAL: Self = Self {
        miss: 0.03,
        drop: 0.0,
        duplicate: 0.0,
        outage_s: None,
        outage_below_m: None,
        blind_below_m: 0.0,
        lie: None,
        wrong: None,
        stamp_jumps: None,
        size_error: 0.0,
    };
}

/// What a camera sees that is not mounted as the controller was told.
fn misread(scene: &Scene, v: Vector<Body>) -> Vector<Body> {
    let (sin, cos) = scene.camera_turned_rad.sin_cos();
    let (x, y) = (cos * v.x() + sin * v.y(), cos * v.y() - sin * v.x());
    Vector::new(x, if scene.mirrored { -y } else { y }, v.z())
}

/// The camera, its detector, and the frames on their way.
pub(crate) struct Eyes {
    random: ChaCha8Rng,
    mount_error: Rotation<Body, Body>,
    due_s: f64,
    on_the_way: VecDeque<(f64, FrameObservation)>,
    dark_since_s: Option<f64>,
}

impl Eyes {
    pub(crate) fn new(scene: &Scene) -> Self {
        let mut random = stream(scene.seed, 4);
        let mut tilt = || 0.002 * scene.estimator.scale * normal(&mut random);
        let mount_error = Rotation::from_euler(tilt(), tilt(), 0.0);
        Self { random, mount_error, due_s: 0.0, on_the_way: VecDeque::new(), dark_since_s: None }
    }

    /// Takes a frame when one is due.
    pub(crate) fn look(
        &mut self,
        scene: &Scene,
        now_s: f64,
        vehicle: &Multirotor,
        pad: (Point<Ned>, f64),
    ) {
        if now_s < self.due_s {
            return;
        }
        self.due_s = now_s + 1.0 / scene.frames_hz - 1e-6;
        let frame = self.frame(scene, now_s, vehicle, pad);
        let [lost, jitter, twice] = [(); 3].map(|()| uniform(&mut self.random));
        if lost < scene.faults.drop || self.is_dark(scene, now_s, vehicle, pad.0) {
            return;
        }
        let arrives_s = now_s + scene.latency_s + scene.latency_jitter_s * jitter;
        self.put(arrives_s, frame);
        if twice < scene.faults.duplicate {
            self.put(arrives_s + 0.01, frame);
        }
    }

    /// The frames that have arrived, one at a time.
    pub(crate) fn arrived(&mut self, now_s: f64) -> Option<FrameObservation> {
        let is_due = self.on_the_way.front().is_some_and(|(at, _)| *at <= now_s);
        if is_due { self.on_the_way.pop_front().map(|(_, frame)| frame) } else { None }
    }

    fn put(&mut self, arrives_s: f64, frame: FrameObservation) {
        let place = self.on_the_way.partition_point(|(at, _)| *at <= arrives_s);
        self.on_the_way.insert(place, (arrives_s, frame));
    }

    fn is_dark(
        &mut self,
        scene: &Scene,
        now_s: f64,
        vehicle: &Multirotor,
        pad: Point<Ned>,
    ) -> bool {
        let faults = &scene.faults;
        if let Some((below_m, for_s)) = faults.outage_below_m {
            if pad.z() - vehicle.position.z() < below_m {
                self.dark_since_s.get_or_insert(now_s);
            }
            if self.dark_since_s.is_some_and(|since| now_s - since < for_s) {
                return true;
            }
        }
        faults.outage_s.is_some_and(|(from, to)| (from..to).contains(&now_s))
    }

    fn frame(
        &mut self,
        scene: &Scene,
        now_s: f64,
        vehicle: &Multirotor,
        (pad, pad_yaw): (Point<Ned>, f64),
    ) -> FrameObservation {
        let faults = &scene.faults;
        let [wrong, jumps, jump] = [(); 3].map(|()| uniform(&mut self.random));
        let mut place = pad;
        if let Some((part, metres)) = faults.wrong
            && wrong < part
        {
            place = place + Vector::new(0.0, metres, 0.0);
        }
        let mut marker = self.marker(scene, vehicle, place, pad_yaw);
        if let Some((from, to, metres)) = faults.lie
            && (from..to).contains(&now_s)
        {
            marker = marker.map(|marker| lying(marker, vehicle, metres));
        }
        let mut stamp_s = now_s - scene.stamp_error_s;
        if let Some((part, most_s)) = faults.stamp_jumps
            && jumps < part
        {
            stamp_s += most_s * (2.0 * jump - 1.0);
        }
        FrameObservation {
            stamp: Timestamp::from_seconds(stamp_s),
            image_size: (WIDTH, HEIGHT),
            focal_px: Some(FOCAL_PX),
            body_from_camera: Some(Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2)),
            marker,
        }
    }

    /// Image right is the vehicle's right, image up its forward; the mounting is wrong by a little that nobody knows.
    fn marker(
        &mut self,
        scene: &Scene,
        vehicle: &Multirotor,
        pad: Point<Ned>,
        pad_yaw: f64,
    ) -> Option<MarkerInFrame> {
        let model = CameraModel::pinhole(WIDTH, HEIGHT, FOCAL_PX);
        let body_from_ned = vehicle.ned_from_body().inverse();
        let mount = Vector::<Body>::new(0.0, 0.0, -MOUNT_M);
        let see = |offset: Vector<Ned>| {
            let in_body = body_from_ned * (pad - vehicle.position + offset) - mount;
            self.mount_error * in_body
        };
        let project = |v: Vector<Body>| model.project(Point::new(v.y(), -v.x(), v.z()));
        let half = 0.5 * MARKER_M * scene.marker_scale;
        let inside = |pixel: Pixel| {
            (0.0..f64::from(WIDTH)).contains(&pixel.x)
                && (0.0..f64::from(HEIGHT)).contains(&pixel.y)
        };
        let corners = [(-half, -half), (-half, half), (half, -half), (half, half)];
        let whole =
            corners.iter().all(|(n, e)| project(see(Vector::new(*n, *e, 0.0))).is_some_and(inside));
        let centre = see(Vector::zero());
        let pixel = project(centre)?;
        let random = &mut self.random;
        let luck = uniform(random);
        let noise = [(); 3].map(|()| normal(random));
        let size_px = 2.0 * half * FOCAL_PX / centre.z();
        let seen = (2.0 * size_px / SMALL_PX - 1.0).clamp(0.0, 1.0) * (1.0 - scene.faults.miss);
        let low = centre.z() < scene.faults.blind_below_m;
        if !whole || low || luck >= seen {
            return None;
        }
        let pixel =
            Pixel::new(pixel.x + noise[0] * CENTRE_NOISE_PX, pixel.y + noise[1] * CENTRE_NOISE_PX);
        let ray = model.unproject(pixel);
        let ray = Vector::<Body>::new(-ray.y(), ray.x(), ray.z());
        let part = EDGE_NOISE_PX / size_px;
        let range = centre.z() * (1.0 + part * noise[2]) * (1.0 + scene.faults.size_error);
        let from_camera = ray * (range / ray.z());
        let place = misread(scene, from_camera) + mount;
        let heading = body_from_ned
            * Rotation::<Ned, Marker>::from_euler(
                std::f64::consts::PI,
                0.0,
                pad_yaw + std::f64::consts::FRAC_PI_2,
            );
        let sideways = (centre.z() * CENTRE_NOISE_PX / FOCAL_PX).powi(2);
        let along = from_camera.coords / from_camera.coords.z;
        let covariance = Matrix3::from_diagonal(&[sideways, sideways, 0.0].into())
            + along * along.transpose() * (centre.z() * part).powi(2);
        Some(MarkerInFrame {
            centre: pixel,
            body_from_marker: Some(Transform::new(
                heading,
                Point::new(place.x(), place.y(), place.z()),
            )),
            alternative: None,
            covariance_m2: scene.tells_covariance.then_some(covariance),
            size_px: Some(size_px),
            confidence: 0.9,
        })
    }
}

/// The marker, reported so many metres north of its place.
fn lying(marker: MarkerInFrame, vehicle: &Multirotor, metres: f64) -> MarkerInFrame {
    let moved = vehicle.ned_from_body().inverse() * Vector::new(metres, 0.0, 0.0);
    let lie =
        |pose: Transform<Body, Marker>| Transform::new(pose.rotation(), pose.origin() + moved);
    MarkerInFrame { body_from_marker: marker.body_from_marker.map(lie), ..marker }
}
