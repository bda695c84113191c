//! Predicts where the camera sees the pad, from the vehicle's motion and all unknowns (mount, focal length, k1, time offset,
//! drift), linearised for each marker.

use geometry::{
    Body, Camera, CameraModel, Distortion, Ned, Pixel, Point, Rotation, Transform, Vector,
};
use nalgebra::{Matrix3, SMatrix, SVector, Vector3};

use super::motion::{Motion, Pose};
use super::quantity::{FOCAL, K1, MOUNT, OFFSET};
use super::sample::{ConfiguredCamera, MarkerSample};

/// The constant parameters of a flight: the camera's, then the autopilot's and the pad's.
pub(super) const PARAMETERS: usize = 11;
/// Error of the autopilot's heading, in radians.
pub(super) const HEADING: usize = 6;
/// True over estimated changes of the height, less 1: a barometer's error.
pub(super) const CLIMB: usize = 7;
/// The pad's place in local NED, in metres.
pub(super) const PAD: usize = 8;
/// The drifting states: the autopilot's position, in metres, and its roll and pitch, in radians.
pub(super) const DRIFTS: usize = 5;
pub(super) const POSITION: usize = PARAMETERS;
pub(super) const LEAN: usize = PARAMETERS + 3;
/// All of it.
pub(super) const STATES: usize = PARAMETERS + DRIFTS;

/// The constant parameters, in the order above.
pub(super) type Parameters = SVector<f64, PARAMETERS>;
/// The same with the drifting states.
pub(super) type State = SVector<f64, STATES>;

/// The observation of a marker: its pixel, and the logarithm of its distance along the optical axis.
type Seen = Vector3<f64>;

/// Steps of the derivatives, in the states' units.
const STEPS: [f64; STATES] = [
    5e-3, 1e-4, 1e-4, 1e-4, 1e-4, 1e-3, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-3, 1e-4, 1e-4,
];
/// Newton's steps to the drift that explains a marker, and the step of its derivatives, in metres.
const EXPLAINING: usize = 3;
const EXPLAINING_STEP_M: f64 = 1e-4;
/// Shortest time between detections that are used, in seconds, and the most of them. The autopilot's errors alone look like a
/// motion that shows the time offset to 2 ms by so many and the focal length to 2 %; more of them must not look like more.
const MIN_APART_S: f64 = 0.045;
const MAX_MARKERS: usize = 2000;
/// Height over the marker from which on a detection is used, in metres: lower, the air and the ground move the vehicle in ways
/// that the autopilot does not measure, and a marker fills the image.
const MIN_DISTANCE_M: f64 = 0.5;

/// A flight to explain.
#[derive(Clone, Debug)]
pub(super) struct Model<'a> {
    configured: ConfiguredCamera,
    motion: &'a Motion,
    markers: Vec<Measured>,
}

/// A marker as the equations have it.
#[derive(Copy, Clone, Debug)]
pub(super) struct Measured {
    pub(super) stamp_s: f64,
    seen: Seen,
    noise: Matrix3<f64>,
}

/// A marker's equation at a place.
#[derive(Copy, Clone, Debug)]
pub(super) struct Linearised {
    pub(super) stamp_s: f64,
    /// The residual, observed less predicted.
    pub(super) residual: Seen,
    /// The prediction's derivative.
    pub(super) slope: SMatrix<f64, 3, STATES>,
    /// The detection's own covariance.
    pub(super) noise: Matrix3<f64>,
}

impl<'a> Model<'a> {
    pub(super) fn new(
        configured: &ConfiguredCamera,
        motion: &'a Motion,
        markers: &[MarkerSample],
    ) -> Self {
        let usable = |marker: &&MarkerSample| motion.at(marker.stamp_s).is_some();
        let mut markers: Vec<Measured> = markers
            .iter()
            .filter(usable)
            .filter_map(|marker| Measured::new(&configured.model, marker))
            .collect();
        markers.sort_by(|a, b| a.stamp_s.total_cmp(&b.stamp_s));
        markers.dedup_by(|next, before| next.stamp_s < before.stamp_s + MIN_APART_S);
        let markers = thinned(&markers, MAX_MARKERS);
        Self { configured: *configured, motion, markers }
    }

    pub(super) fn markers(&self) -> &[Measured] {
        &self.markers
    }

    /// Each marker's distance along the optical axis, and the vehicle's pose.
    pub(super) fn sights(&self) -> impl Iterator<Item = (f64, Pose)> {
        self.markers
            .iter()
            .filter_map(|marker| Some((libm::exp(marker.seen.z), self.motion.at(marker.stamp_s)?)))
    }

    /// Where the first marker is that has a place, by the configuration.
    pub(super) fn first_pad(&self) -> Option<Point<Ned>> {
        let ConfiguredCamera { model, body_from_camera } = &self.configured;
        self.markers.iter().find_map(|marker| {
            let pose = self.motion.at(marker.stamp_s)?;
            let ray = model.unproject(Pixel::new(marker.seen.x, marker.seen.y))?;
            let place = Point::origin() + ray * libm::exp(marker.seen.z);
            Some(Transform::new(pose.ned_from_body, pose.position) * (*body_from_camera * place))
        })
    }

    /// The same flight with at most so many of its markers.
    pub(super) fn thinned(&self, count: usize) -> Self {
        Self { markers: thinned(&self.markers, count), ..self.clone() }
    }

    /// The equations of all markers that are in front of the camera there.
    pub(super) fn linearised(&self, parameters: &Parameters) -> Vec<Linearised> {
        let mut state = State::zeros();
        state.fixed_rows_mut::<PARAMETERS>(0).copy_from(parameters);
        self.markers.iter().filter_map(|marker| self.linearise(&state, marker)).collect()
    }

    fn linearise(&self, state: &State, marker: &Measured) -> Option<Linearised> {
        let pose = self.motion.at(marker.stamp_s + state[OFFSET])?;
        let place = self.explained(marker, state, &pose)?;
        let mut slope = SMatrix::<f64, 3, STATES>::zeros();
        for (i, step) in STEPS.into_iter().enumerate() {
            let aside = |step: f64| {
                let mut place = place;
                place[i] += step;
                let pose = if i == OFFSET { pose.after(step) } else { pose };
                self.predicted(&place, &pose)
            };
            slope.set_column(i, &((aside(step)? - aside(-step)?) / (2.0 * step)));
        }
        // As if it were the residual without drifts.
        let residual = marker.seen - self.predicted(&place, &pose)? + slope * (place - state);
        let is_finite = residual.iter().chain(slope.iter()).all(|value| value.is_finite());
        let Measured { stamp_s, noise, .. } = *marker;
        is_finite.then_some(Linearised { stamp_s, residual, slope, noise })
    }

    /// The same state with the drift of the position that explains a marker. Derivatives are taken there: without, they would
    /// follow the autopilot's errors, and of a vehicle that does not move a focal length of zero would explain best that its
    /// image does not show them. Of the drifts this one turns nothing.
    fn explained(&self, marker: &Measured, state: &State, pose: &Pose) -> Option<State> {
        let mut state = *state;
        for _ in 0..EXPLAINING {
            let seen = self.predicted(&state, pose)?;
            let mut slope = Matrix3::zeros();
            for i in 0..3 {
                let mut aside = state;
                aside[POSITION + i] += EXPLAINING_STEP_M;
                slope.set_column(i, &((self.predicted(&aside, pose)? - seen) / EXPLAINING_STEP_M));
            }
            let step = slope.lu().solve(&(marker.seen - seen))?;
            for (i, step) in step.iter().enumerate() {
                state[POSITION + i] += step;
            }
        }
        Some(state)
    }

    /// The predicted observation from the vehicle's pose that the autopilot reports.
    fn predicted(&self, state: &State, pose: &Pose) -> Option<Seen> {
        let parameters: Parameters = state.fixed_rows::<PARAMETERS>(0).into();
        let camera = corrected(&self.configured, &parameters);
        let place = camera.body_from_camera.inverse() * in_body(state, pose);
        let (pixel, scale) = image_of(&camera.model, place)?;
        let (_, before) = image_of(&self.configured.model, place)?;
        // A marker's distance was calculated from its size in the image, by the configured intrinsics.
        let distance = libm::log(place.z()) - libm::log(scale / before);
        Some(Seen::new(pixel.x, pixel.y, distance))
    }
}

/// Three numbers of a state, north, east and down.
fn ned(state: &State, index: usize) -> Vector<Ned> {
    Vector::new(state[index], state[index + 1], state[index + 2])
}

/// Where the pad is in the body.
fn in_body(state: &State, pose: &Pose) -> Point<Body> {
    let apart = Point::origin() + ned(state, PAD) - (pose.position + ned(state, POSITION));
    let apart = Vector::<Ned>::new(apart.x(), apart.y(), apart.z() * (1.0 + state[CLIMB]));
    let heading = Vector::<Ned>::new(0.0, 0.0, state[HEADING]);
    let lean = Vector::<Body>::new(state[LEAN], state[LEAN + 1], 0.0);
    let ned_from_body = Rotation::<Ned, Ned>::from_rotation_vector(heading)
        * pose.ned_from_body
        * Rotation::<Body, Body>::from_rotation_vector(lean);
    Point::origin() + ned_from_body.inverse() * apart
}

impl Measured {
    fn new(camera: &CameraModel, marker: &MarkerSample) -> Option<Self> {
        let place = marker.place;
        if !marker.stamp_s.is_finite() || place.z() < MIN_DISTANCE_M {
            return None;
        }
        let (pixel, by_place) = camera.project_with_jacobian(place)?;
        let mut slope = Matrix3::zeros();
        slope.fixed_rows_mut::<2>(0).copy_from(&by_place);
        slope[(2, 2)] = 1.0 / place.z();
        let noise = slope * marker.covariance_m2 * slope.transpose();
        let is_finite = noise.iter().all(|value| value.is_finite());
        let seen = Seen::new(pixel.x, pixel.y, libm::log(place.z()));
        is_finite.then_some(Self { stamp_s: marker.stamp_s, seen, noise })
    }
}

/// At most so many of the markers, over all of the flight.
fn thinned(markers: &[Measured], count: usize) -> Vec<Measured> {
    let step = markers.len().div_ceil(count.max(1)).max(1);
    markers.iter().step_by(step).copied().collect()
}

/// Where a point is in the image, and how many pixels a small thing there has per unit of its angle.
fn image_of(camera: &CameraModel, place: Point<Camera>) -> Option<(Pixel, f64)> {
    let (pixel, by_place) = camera.project_with_jacobian(place)?;
    let area = by_place[(0, 0)] * by_place[(1, 1)] - by_place[(0, 1)] * by_place[(1, 0)];
    (area > 0.0).then(|| (pixel, area.sqrt() * place.z()))
}

/// A camera that differs from another by the parameters.
pub(super) fn corrected(camera: &ConfiguredCamera, parameters: &Parameters) -> ConfiguredCamera {
    let ConfiguredCamera { mut model, body_from_camera } = *camera;
    let scale = 1.0 + parameters[FOCAL];
    (model.fx, model.fy) = (scale * model.fx, scale * model.fy);
    let k1 = parameters[K1];
    model.distortion = match model.distortion {
        Distortion::None if k1 == 0.0 => Distortion::None,
        Distortion::None => Distortion::BrownConrady([k1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        Distortion::BrownConrady(mut k) => {
            k[0] += k1;
            Distortion::BrownConrady(k)
        }
        Distortion::KannalaBrandt(mut k) => {
            k[0] += k1;
            Distortion::KannalaBrandt(k)
        }
    };
    let turn = Vector::<Body>::new(parameters[MOUNT], parameters[MOUNT + 1], parameters[MOUNT + 2]);
    let turned = Rotation::<Body, Body>::from_rotation_vector(turn) * body_from_camera.rotation();
    ConfiguredCamera { model, body_from_camera: Transform::new(turned, body_from_camera.origin()) }
}
