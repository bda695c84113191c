//! Estimates the pose of a pad with its covariance from its markers found in an image, without those that contradict the
//! others: their corners and ring centres solved as points of one plane.
//!
//! Far markers give the tilt that near ones cannot, and only the covariance changes when one of them leaves the view. Rings
//! look the same in any rotation: next to other markers their centre is a point of the plane; alone they give the pad's pose
//! only when they lie at the landing point.

use geometry::{
    Camera, CameraModel, Distortion, Marker as MarkerFrame, Pad as PadFrame, Pixel, Point,
    Rotation, Transform, Vector,
};
use markers::{Pad, PlacedMarker};
use nalgebra::{Matrix2, Matrix6, SMatrix, Vector2};

use crate::observation::{MarkerPose, Observation, PoseSolution};
use crate::pose::{PlanePoint, Sheets, pose_of_sheets};

/// A pad found in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct PadObservation {
    /// Where the pad is; its frame's origin is the landing point.
    pub pose: MarkerPose,
    /// The projection of the landing point.
    pub centre: Pixel,
    /// Covariance of `centre`, in square pixels.
    pub centre_covariance_px2: Matrix2<f64>,
    /// The largest extent of a marker that was used, in pixels.
    pub size_px: f64,
    /// The highest confidence of a marker that was used, from 0 to 1.
    pub confidence: f64,
    /// Number of markers that were used.
    pub used: usize,
    /// Number of markers of the pad that were left out, for their residuals.
    pub left_out: usize,
}

/// Degrees of freedom of four corners over those of a pose: a pose's covariance projected to its corners is too small by
/// this factor.
const CORNERS_PER_POSE: f64 = 8.0 / 6.0;
/// Lower bound of a corner's variance, in square pixels.
const MIN_VARIANCE_PX2: f64 = 1e-6;
/// Gate for a marker's residual against the pose of all, as mean squared Mahalanobis distance of its corners: five standard
/// deviations. Markers beyond it are left out.
const MAX_RESIDUAL: f64 = 25.0;

/// The pose of `pad` from the markers found in one image; `None` when none of its markers with a pose is among them.
/// Markers whose residual against the pose of all is too large are left out, and so is one without which the others have a
/// pose, where all have none; of two that contradict each other the smaller or less sure one is.
pub fn observe_pad<'a>(
    pad: &Pad,
    found: impl IntoIterator<Item = &'a Observation>,
    camera: &CameraModel,
) -> Option<PadObservation> {
    let found = found.into_iter();
    let mut seen: Vec<Member<'_>> = found.filter_map(|it| member(pad, it, camera)).collect();
    let all = seen.len();
    while seen.len() > 1 {
        let pose = joint_pose(seen.iter(), camera);
        match (outlier(&seen, pose.as_ref(), camera), pose) {
            (Some(index), _) => {
                seen.remove(index);
            }
            (None, pose) => return observation(&seen, pose?, all - seen.len(), camera),
        }
    }
    let only = seen.first()?.pad_pose()?;
    observation(&seen, only, all - seen.len(), camera)
}

fn member<'a>(pad: &Pad, found: &'a Observation, camera: &CameraModel) -> Option<Member<'a>> {
    let placed = pad.markers().iter().find(|it| it.marker.includes(found.family, found.id))?;
    Member::new(placed, found, pad.tolerance_m(), camera)
}

fn observation(
    used: &[Member<'_>],
    pose: MarkerPose,
    left_out: usize,
    camera: &CameraModel,
) -> Option<PadObservation> {
    let (centre, centre_covariance_px2) = landing_point(&pose, camera)?;
    let max = |of: fn(&Observation) -> f64| used.iter().map(|m| of(m.found)).fold(0.0, f64::max);
    Some(PadObservation {
        centre,
        centre_covariance_px2,
        pose,
        size_px: max(|found| found.size_px),
        confidence: max(|found| found.confidence),
        used: used.len(),
        left_out,
    })
}

/// The pixel of the landing point, and its covariance. Beside a marker that is seen near the ground it may lie where the lens
/// model has no pixels: then its pixel is the last one on the way there, and is uncertain by the rest of the way.
fn landing_point(pose: &MarkerPose, camera: &CameraModel) -> Option<(Pixel, Matrix2<f64>)> {
    let origin = pose.camera_from_marker.origin();
    let reached = camera.project_with_jacobian(origin).map(|it| (it, 0.0)).or_else(|| {
        let ideal = CameraModel { distortion: Distortion::None, ..*camera }.project(origin)?;
        let ray = camera.unproject_clamped(ideal);
        let on_ray = Point::from_coords((ray.coords * origin.z()).into());
        let last = camera.project_with_jacobian(on_ray)?;
        Some((last, last.0.distance(&ideal)))
    });
    let ((pixel, by_place), beyond_px) = reached?;
    let place = pose.covariance.fixed_view::<3, 3>(0, 0);
    let beyond = Matrix2::identity() * (beyond_px * beyond_px);
    Some((pixel, by_place * place * by_place.transpose() + beyond))
}

/// The marker's frame in the pad's.
fn pad_from_marker(placed: &PlacedMarker) -> Transform<PadFrame, MarkerFrame> {
    let turn = f64::from(placed.quarter_turns) * std::f64::consts::FRAC_PI_2;
    let [x, y] = placed.position_m;
    let turn = Rotation::from_rotation_vector(Vector::new(0.0, 0.0, turn));
    Transform::new(turn, Point::new(x, y, 0.0))
}

/// A pad is reported like a marker whose centre is the landing point.
fn as_marker(camera_from_pad: Transform<Camera, PadFrame>) -> Transform<Camera, MarkerFrame> {
    camera_from_pad * Transform::identity()
}

/// A marker of the pad that was found in the image.
struct Member<'a> {
    placed: PlacedMarker,
    found: &'a Observation,
    marker_pose: &'a MarkerPose,
    /// Its corners on the pad and in the image, or its centre where it has no corners.
    points: Vec<PlanePoint>,
    /// Standard deviation of its place on the pad, in metres: it moves as a whole.
    tolerance_m: f64,
}

impl<'a> Member<'a> {
    fn new(
        placed: &PlacedMarker,
        found: &'a Observation,
        tolerance_m: f64,
        camera: &CameraModel,
    ) -> Option<Self> {
        let marker_pose = found.pose.as_ref()?;
        let points = match found.corners {
            Some(corners) => corner_points(placed, corners, marker_pose, camera)?,
            None => vec![plane_point(placed.position_m, found.centre, found.centre_covariance_px2)],
        };
        Some(Self { placed: *placed, found, marker_pose, points, tolerance_m })
    }

    /// Its weight among contradicting markers: its extent in the image by its confidence, zero without corners.
    fn weight(&self) -> f64 {
        self.found.corners.map_or(0.0, |_| self.found.size_px * self.found.confidence)
    }

    /// The pad's pose from this marker alone; `None` for a marker without orientation, unless it lies at the landing point.
    fn pad_pose(&self) -> Option<MarkerPose> {
        if self.found.corners.is_none() && self.placed.position_m != [0.0; 2] {
            return None;
        }
        let marker_from_pad = pad_from_marker(&self.placed).inverse();
        let pose = self.marker_pose;
        let camera_from_pad = pose.camera_from_marker * marker_from_pad;
        let arm = camera_from_pad.origin().coords - pose.camera_from_marker.origin().coords;
        let mut lever = Matrix6::identity();
        lever.fixed_view_mut::<3, 3>(0, 3).copy_from(&-arm.cross_matrix());
        let mut covariance = lever * pose.covariance * lever.transpose();
        // The marker lies elsewhere in the pad's plane.
        let turn = camera_from_pad.rotation().quaternion.to_rotation_matrix();
        let along = turn.matrix().fixed_view::<3, 2>(0, 0) * self.tolerance_m;
        let placement = along * along.transpose();
        let mut place = covariance.fixed_view_mut::<3, 3>(0, 0);
        place += placement;
        covariance.iter().all(|c| c.is_finite()).then_some(MarkerPose {
            camera_from_marker: as_marker(camera_from_pad),
            reprojection_rms_px: pose.reprojection_rms_px,
            covariance,
            alternative: pose.alternative.map(|other| PoseSolution {
                camera_from_marker: as_marker(other.camera_from_marker * marker_from_pad),
                ..other
            }),
        })
    }

    /// Mean squared Mahalanobis distance of its corners from those of a pad at `pose`.
    fn residual(&self, pose: &MarkerPose, camera: &CameraModel) -> f64 {
        let squares = self.points.iter().map(|point| {
            let [x, y] = point.place_m;
            let place = pose.camera_from_marker * Point::<MarkerFrame>::new(x, y, 0.0);
            let (pixel, by_place) = camera.project_with_jacobian(place)?;
            let residual = Vector2::new(point.seen.x - pixel.x, point.seen.y - pixel.y);
            let placement = by_place * by_place.transpose() * self.tolerance_m.powi(2);
            let covariance = point.covariance_px2 + placement;
            Some(residual.dot(&(covariance.cholesky()?.inverse() * residual)))
        });
        let values = 2.0 * self.points.len() as f64;
        squares.sum::<Option<f64>>().map_or(f64::INFINITY, |sum| sum / values)
    }
}

/// A marker's corners, on the pad and in the image.
fn corner_points(
    placed: &PlacedMarker,
    seen: [Pixel; 4],
    marker_pose: &MarkerPose,
    camera: &CameraModel,
) -> Option<Vec<PlanePoint>> {
    let half = placed.size_m / 2.0;
    let corners = [[-half, half], [half, half], [half, -half], [-half, -half]];
    let pose = &marker_pose.camera_from_marker;
    let points = corners.iter().zip(seen).map(|(corner, seen)| {
        let place = *pose * Point::<MarkerFrame>::new(corner[0], corner[1], 0.0);
        let (_, by_place) = camera.project_with_jacobian(place)?;
        let arm = (place.coords - pose.origin().coords).cross_matrix();
        let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
        by_pose.fixed_view_mut::<2, 3>(0, 0).copy_from(&by_place);
        by_pose.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_place * -arm));
        let spread = by_pose * marker_pose.covariance * by_pose.transpose() * CORNERS_PER_POSE;
        let place_m = placed.position_on_pad(*corner);
        Some(plane_point(place_m, seen, spread))
    });
    points.collect()
}

/// A point with the uncertainty of its pixel.
fn plane_point(place_m: [f64; 2], seen: Pixel, spread_px2: Matrix2<f64>) -> PlanePoint {
    let min = Matrix2::identity() * MIN_VARIANCE_PX2;
    PlanePoint { place_m, seen, covariance_px2: spread_px2 + min }
}

/// The pose of the pad from several members.
fn joint_pose<'a>(
    members: impl Iterator<Item = &'a Member<'a>>,
    camera: &CameraModel,
) -> Option<MarkerPose> {
    let (mut points, mut last, mut tolerance_m) = (Vec::new(), Vec::new(), 0.0);
    for member in members {
        points.extend_from_slice(&member.points);
        last.push(points.len() - 1);
        tolerance_m = member.tolerance_m;
    }
    pose_of_sheets(&points, Sheets { last: &last, tolerance_m }, camera)
}

/// The member to leave out, if the largest residual is beyond the gate or all together have no pose. Of two members the one of
/// less weight is left out, since their residuals do not show which is wrong.
fn outlier(
    members: &[Member<'_>],
    pose: Option<&MarkerPose>,
    camera: &CameraModel,
) -> Option<usize> {
    let largest = |of: &dyn Fn(&Member<'_>) -> f64| {
        let values = members.iter().map(of).enumerate();
        values.max_by(|(_, a), (_, b)| a.total_cmp(b))
    };
    let (worst, residual) = match pose {
        Some(pose) => largest(&|member| member.residual(pose, camera))?,
        None => (largest(&|member| -member.weight())?.0, f64::INFINITY),
    };
    if residual <= MAX_RESIDUAL {
        return None;
    }
    match members {
        [first, second] => Some(usize::from(first.weight() >= second.weight())),
        _ => Some(leave_one_out(members, camera).unwrap_or(worst)),
    }
}

/// The member without which the residuals of the others are smallest. A gross outlier pulls the pose so far that the
/// others can have larger residuals than itself.
fn leave_one_out(members: &[Member<'_>], camera: &CameraModel) -> Option<usize> {
    let cost = |without: usize| {
        let kept = members.iter().enumerate().filter(|(i, _)| *i != without).map(|(_, m)| m);
        let pose = joint_pose(kept.clone(), camera)?;
        Some(kept.map(|member| member.residual(&pose, camera)).sum::<f64>())
    };
    let costs = (0..members.len()).filter_map(|without| Some((without, cost(without)?)));
    costs.min_by(|(_, a), (_, b)| a.total_cmp(b)).map(|(without, _)| without)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pose::square_pose;
    use markers::Family;

    const TWO: &str = r#"
id = 1
tolerance_m = 0.005
markers = [{ marker = "aruco-4x4-50:1:0.15", x_m = -0.15 }, { marker = "aruco-4x4-50:2:0.15", x_m = 0.15 }]
"#;
    const NOISE_PX: f64 = 0.05;

    /// The markers of a pad, each moved on the ground as a whole.
    fn sheets(
        pad: &Pad,
        camera_from_pad: &Transform<Camera, PadFrame>,
        camera: &CameraModel,
        gaussian: &mut impl FnMut() -> f64,
    ) -> Vec<Observation> {
        let seen = pad.markers().iter().map(|placed| {
            let shift = [gaussian(), gaussian()].map(|it| it * pad.tolerance_m());
            let half = placed.size_m / 2.0;
            let corners = [[-half, half], [half, half], [half, -half], [-half, -half]].map(|at| {
                let [x, y] = placed.position_on_pad(at);
                let place = *camera_from_pad * Point::new(x + shift[0], y + shift[1], 0.0);
                let pixel = camera.project(place).unwrap();
                let noise = [gaussian(), gaussian()].map(|it| it * NOISE_PX);
                Pixel::new(pixel.x + noise[0], pixel.y + noise[1])
            });
            let spread = SMatrix::identity() * (NOISE_PX * NOISE_PX);
            Observation {
                family: Family::Aruco4x4_50,
                id: placed.marker.id,
                centre: corners[0],
                centre_covariance_px2: Matrix2::identity() * (NOISE_PX * NOISE_PX),
                corners: Some(corners),
                wrong_bits: 0,
                size_px: corners[0].distance(&corners[2]),
                confidence: 1.0,
                pose: square_pose(&corners, &spread, placed.size_m, camera),
                response: None,
            }
        });
        seen.collect()
    }

    #[test]
    fn sheets_that_lie_elsewhere_as_a_whole_do_not_change_the_distance() {
        let pad: Pad = TWO.parse().unwrap();
        let camera = CameraModel::pinhole(1280, 960, 900.0);
        let turn = Rotation::from_euler(std::f64::consts::PI - 0.2, 0.1, 0.3);
        let truth = Transform::new(turn, Point::new(0.05, -0.02, 1.0));
        let mut seed = 7_u64;
        let mut gaussian = move || {
            let mut uniform = || {
                seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(99);
                ((seed >> 33) as f64 + 0.5) / 2_f64.powi(31)
            };
            let radius = (-2.0 * uniform().ln()).sqrt();
            radius * (std::f64::consts::TAU * uniform()).cos()
        };
        const SETS: usize = 200;
        let (mut squares, mut off_m, mut one_off_m) = (0.0, 0.0, 0.0);
        for _ in 0..SETS {
            let found = sheets(&pad, &truth, &camera, &mut gaussian);
            let seen = observe_pad(&pad, &found, &camera).unwrap();
            assert_eq!(seen.used, 2);
            let error = |of: &PadObservation| {
                of.pose.camera_from_marker.origin().coords.coords - truth.origin().coords.coords
            };
            let covariance = seen.pose.covariance.fixed_view::<3, 3>(0, 0).into_owned();
            squares += error(&seen).dot(&(covariance.try_inverse().unwrap() * error(&seen)));
            off_m += error(&seen).z.powi(2);
            let one = observe_pad(&pad, &found[..1], &camera).unwrap();
            one_off_m += error(&one).z.powi(2);
        }
        let [nees, off_m, one_off_m] = [squares, off_m, one_off_m].map(|it| it / SETS as f64);
        assert!((2.3..3.8).contains(&nees), "{nees}");
        assert!(off_m <= one_off_m, "{off_m} {one_off_m}");
    }
}
