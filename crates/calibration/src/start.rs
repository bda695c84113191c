//! Computes the first guess: a focal length, and the board's pose in each view.
//!
//! For a focal length a homography gives each view's pose (Zhang, "A flexible new technique for camera calibration", 2000,
//! section 3.1), and the right focal length is the one whose poses explain the points best. The homography is to the plane
//! across the line of sight to the board, so that it holds for boards at the border of a fisheye's image as well.

use geometry::homography::PlanePair;
use geometry::{CameraModel, Pixel, homography};
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};

use crate::board::{BoardPoint, Shared};
use crate::equations::{Bundle, Free, Place};
use crate::lens::{INTRINSICS, Lens};
use crate::solve::{minimise, undistorted};
use crate::view::ImageSize;

/// Number of views from which the focal length is guessed: more add no information.
const SCANNED_VIEWS: usize = 24;
/// The focal lengths that are tried, in image widths: from wider than half a sphere to a long lens.
const FOCAL_SHARES: std::ops::Range<i32> = -14..17;
/// The ratio of one to the next.
const FOCAL_RATIO: f64 = 1.12;
/// Cosine of the angle from the middle of the board's image beyond which points are left out of the homography.
const MIN_COSINE: f64 = 0.2;

/// A view's pose in closed form.
pub(crate) struct FirstPose {
    pub(crate) pose: Isometry3<f64>,
    /// Whether the board is seen as in a mirror.
    pub(crate) is_mirrored: bool,
}

/// The pose in closed form; `None` for points that do not determine it.
pub(crate) fn first_pose(points: &[BoardPoint], camera: &CameraModel) -> Option<FirstPose> {
    let rays: Vec<Option<Vector3<f64>>> = points
        .iter()
        .map(|point| camera.unproject(Pixel::new(point.seen[0], point.seen[1])))
        .map(|ray| ray.map(|ray| ray.coords.normalize()))
        .collect();
    let sight = rays.iter().flatten().sum::<Vector3<f64>>().try_normalize(1e-9)?;
    let turn = UnitQuaternion::rotation_between(&sight, &Vector3::z())?;
    let pairs = points.iter().zip(&rays).filter_map(|(point, ray)| {
        let ahead = turn * (*ray)?;
        (ahead.z > MIN_COSINE).then(|| PlanePair {
            plane: point.place_m,
            image: [ahead.x / ahead.z, ahead.y / ahead.z],
        })
    });
    let pairs: Vec<PlanePair> = pairs.collect();
    if pairs.len() < 4 {
        return None;
    }
    let [plane, image] =
        [Spread::of(pairs.iter().map(|p| p.plane)), Spread::of(pairs.iter().map(|p| p.image))];
    let scaled = pairs
        .iter()
        .map(|pair| PlanePair { plane: plane.scaled(pair.plane), image: image.scaled(pair.image) });
    let [a, b, c, d, e, f, g, h] = homography(scaled)?;
    let is_mirrored = (a - c * g) * (e - f * h) - (b - c * h) * (d - f * g) < 0.0;
    // From the board's own units to directions.
    let back = Matrix3::new(
        image.half,
        0.0,
        image.middle[0],
        0.0,
        image.half,
        image.middle[1],
        0.0,
        0.0,
        1.0,
    );
    let map = back * Matrix3::new(a, b, c, d, e, f, g, h, 1.0);
    let [x, y] = [0, 1].map(|column| map.column(column) / plane.half);
    let scale = 1.0 / (x.norm() * y.norm()).sqrt();
    let columns = Matrix3::from_columns(&[x * scale, y * scale, (x * scale).cross(&(y * scale))]);
    let svd = columns.svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    let rotation = Rotation3::from_matrix_unchecked(rotation);
    let origin =
        map.column(2) * scale - rotation * Vector3::new(plane.middle[0], plane.middle[1], 0.0);
    let back = turn.inverse();
    let pose = Isometry3::from_parts(
        Translation3::from(back * origin),
        back * UnitQuaternion::from_rotation_matrix(&rotation),
    );
    let is_finite = pose.translation.vector.iter().all(|value| value.is_finite());
    (is_finite && rotation.matrix().iter().all(|value| value.is_finite()))
        .then_some(FirstPose { pose, is_mirrored })
}

/// The middle of points and half of their extent.
struct Spread {
    middle: [f64; 2],
    half: f64,
}

impl Spread {
    fn of(points: impl Iterator<Item = [f64; 2]> + Clone) -> Self {
        let count = points.clone().count() as f64;
        let middle =
            [0, 1].map(|axis| points.clone().map(|point| point[axis]).sum::<f64>() / count);
        let half = points
            .flat_map(|point| [point[0] - middle[0], point[1] - middle[1]])
            .fold(1e-12, |half, arm: f64| libm::fmax(half, arm.abs()));
        Self { middle, half }
    }

    fn scaled(&self, point: [f64; 2]) -> [f64; 2] {
        [0, 1].map(|axis| (point[axis] - self.middle[axis]) / self.half)
    }
}

/// The other pose that a plane far away may have: tilted the other way about the line of sight.
pub(crate) fn tilted_back(pose: &Isometry3<f64>) -> Option<Isometry3<f64>> {
    let sight = pose.translation.vector.try_normalize(1e-12)?;
    let turn = UnitQuaternion::rotation_between(&sight, &Vector3::z())?;
    let ahead = (turn * pose.rotation).to_rotation_matrix();
    let [x, y] = [0, 1].map(|column| {
        let column = ahead.matrix().column(column);
        Vector3::new(column[0], column[1], -column[2])
    });
    let rotation = Rotation3::from_basis_unchecked(&[x, y, x.cross(&y)]);
    let rotation = turn.inverse() * UnitQuaternion::from_rotation_matrix(&rotation);
    Some(Isometry3::from_parts(pose.translation, rotation))
}

/// The focal lengths whose poses explain the views best, the best first.
pub(crate) fn focal_guesses(lens: Lens, size: ImageSize, views: &[Vec<BoardPoint>]) -> Vec<f64> {
    let wide = f64::from(size.width.max(size.height));
    let stride = views.len().div_ceil(SCANNED_VIEWS).max(1);
    let mut scores: Vec<Guess> = FOCAL_SHARES
        .map(|share| {
            let focal_px = wide * libm::pow(FOCAL_RATIO, f64::from(share));
            let camera = lens.camera(size, &intrinsics(&undistorted(focal_px, size)));
            let score = views
                .iter()
                .step_by(stride)
                .map(|points| pose_residual(points, &camera, wide))
                .sum();
            Guess { focal_px, score }
        })
        .collect();
    let minima: Vec<bool> = (0..scores.len())
        .map(|i| {
            let better =
                |j: usize| scores.get(j).is_none_or(|other| other.score >= scores[i].score);
            (i == 0 || better(i - 1)) && better(i + 1)
        })
        .collect();
    let mut keep = minima.into_iter();
    scores.retain(|_| keep.next().unwrap_or(false));
    scores.sort_by(|a, b| a.score.total_cmp(&b.score));
    scores.into_iter().map(|guess| guess.focal_px).collect()
}

struct Guess {
    focal_px: f64,
    score: f64,
}

/// How badly the pose in closed form explains a view's points; grows slowly with single bad views.
fn pose_residual(points: &[BoardPoint], camera: &CameraModel, wide: f64) -> f64 {
    let lost = (0.1 * wide) * (0.1 * wide);
    let mean = match first_pose(points, camera) {
        None => lost,
        Some(FirstPose { pose, .. }) => {
            let squares = points.iter().map(|point| {
                let residual = point.residual(camera, &Shared::zeros(), &pose);
                residual.map_or(lost, |[x, y]| libm::fmin(x * x + y * y, lost))
            });
            squares.sum::<f64>() / points.len() as f64
        }
    };
    libm::log1p(mean / (1e-6 * wide * wide))
}

fn intrinsics(shared: &Shared) -> [f64; INTRINSICS] {
    std::array::from_fn(|i| shared[i])
}

/// Each view's pose for a camera, refined separately; the view's pose from before, where there is no better.
pub(crate) fn poses(bundle: &Bundle<'_>, shared: &Shared) -> Vec<Option<Isometry3<f64>>> {
    let camera = bundle.camera(shared);
    let wide = f64::from(bundle.size.width.max(bundle.size.height));
    bundle
        .views
        .iter()
        .map(|points| {
            let first = first_pose(points, &camera)?.pose;
            Some(refined(bundle, points, shared, first, 0.02 * wide)?.poses[0])
        })
        .collect()
}

/// A view's pose, refined separately.
pub(crate) fn refined(
    bundle: &Bundle<'_>,
    points: &Vec<BoardPoint>,
    shared: &Shared,
    pose: Isometry3<f64>,
    scale_px: f64,
) -> Option<Place> {
    let alone = Bundle { views: std::slice::from_ref(points), scale_px, ..*bundle };
    let start = Place { shared: *shared, poses: vec![pose] };
    let found = minimise(&alone, start, &Free::none(), 15);
    found.cost.is_finite().then_some(found.place)
}

/// The place where each view has the best of three poses: the one it has, the one tilted back, the one in closed form; and
/// whether any has changed.
pub(crate) fn with_better_poses(bundle: &Bundle<'_>, place: &mut Place) -> bool {
    let camera = bundle.camera(&place.shared);
    let mut has_changed = false;
    for (points, pose) in bundle.views.iter().zip(&mut place.poses) {
        let alone = Bundle { views: std::slice::from_ref(points), ..*bundle };
        let cost = alone.cost(&Place { shared: place.shared, poses: vec![*pose] });
        let others = [tilted_back(pose), first_pose(points, &camera).map(|first| first.pose)];
        for other in others.into_iter().flatten() {
            let Some(found) = refined(bundle, points, &place.shared, other, bundle.scale_px) else {
                continue;
            };
            if alone.cost(&found) < 0.8 * cost - 1e-9 {
                *pose = found.poses[0];
                has_changed = true;
            }
        }
    }
    has_changed
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::board::Sheet;
    use crate::view::{Sighting, View};

    const SIZE: ImageSize = ImageSize { width: 1280, height: 960 };

    /// A board of 0.6 m, 1.2 m away, seen around the direction of a pixel; `None` where part of it is not seen.
    fn seen(camera: &CameraModel, at: [f64; 2], pose: &Isometry3<f64>) -> Option<Vec<BoardPoint>> {
        let sight = camera.unproject(Pixel::new(at[0], at[1]))?.coords.normalize();
        let places =
            (0..25).map(|i| [f64::from(i % 5) * 0.15 - 0.3, f64::from(i / 5) * 0.15 - 0.3]);
        let points = places.map(|[x, y]| {
            let place = pose.rotation * Vector3::new(x, y, 0.0) + sight * 1.2;
            Some(Sighting {
                tag: 0,
                place_m: [x, y],
                seen: camera.project(geometry::Point::from_coords(place.into()))?,
            })
        });
        let view = View { name: String::new(), size: SIZE, points: points.collect::<Option<_>>()? };
        Sheet::new(&[&view]).views.pop()
    }

    proptest! {
        #[test]
        fn the_first_pose_of_exact_points_is_the_pose(
            u in 50.0..1230.0f64, v in 50.0..910.0f64, a in -0.6..0.6f64, b in -0.6..0.6f64, turn in -3.0..3.0f64,
        ) {
            let fisheye = geometry::Distortion::KannalaBrandt([0.01, -0.008, 0.002, -0.0005]);
            let pinhole = CameraModel::pinhole(1280, 960, 900.0);
            for camera in [pinhole, CameraModel { fx: 410.0, fy: 410.0, distortion: fisheye, ..pinhole }] {
                let rotation = UnitQuaternion::from_euler_angles(a, b, turn);
                let pose = Isometry3::from_parts(Translation3::identity(), rotation);
                if let Some(points) = seen(&camera, [u, v], &pose) {
                    let found = first_pose(&points, &camera).unwrap();
                    prop_assert!(found.pose.rotation.angle_to(&rotation) < 1e-6);
                    prop_assert!((found.pose.translation.vector.norm() - 1.2).abs() < 1e-6);
                    let faces = (rotation * Vector3::z()).dot(&found.pose.translation.vector) > 0.0;
                    prop_assert_eq!(found.is_mirrored, !faces);
                }
            }
        }

        #[test]
        fn tilted_back_twice_is_as_before(a in -0.6..0.6f64, b in -0.6..0.6f64, turn in -3.0..3.0f64, x in -1.0..1.0f64) {
            let rotation = UnitQuaternion::from_euler_angles(a, b, turn);
            let pose = Isometry3::from_parts(Translation3::new(x, 0.2, 1.5), rotation);
            let twice = tilted_back(&tilted_back(&pose).unwrap()).unwrap();
            prop_assert!(twice.rotation.angle_to(&rotation) < 1e-9);
        }
    }
}
