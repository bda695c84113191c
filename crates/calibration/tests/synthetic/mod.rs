//! Makes views of a board whose truth is known: a detector's points in them, with errors that its tags' corners share.
#![allow(dead_code, unreachable_pub, reason = "each of the tests that share this file uses a part")]

use calibration::{Calibration, ImageSize, Lens, Sighting, View};
use geometry::{CameraModel, Distortion, Pixel, Point};
use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector2, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

pub mod bad;
pub mod score;

/// Tags along each side, their side and the gap between two, in metres: the AprilGrid of Kalibr's documentation.
pub const TAGS: u32 = 6;
pub const TAG_M: f64 = 0.088;
pub const GAP_M: f64 = 0.0264;
pub const BOARD_M: f64 = TAGS as f64 * (TAG_M + GAP_M) - GAP_M;
pub const SIZE: ImageSize = ImageSize { width: 1280, height: 960 };

/// A camera whose numbers are known, with the model that describes it.
#[derive(Copy, Clone, Debug)]
pub struct Truth {
    pub name: &'static str,
    pub lens: Lens,
    pub camera: CameraModel,
}

fn camera(focal_px: f64, distortion: Distortion) -> CameraModel {
    CameraModel {
        width: SIZE.width,
        height: SIZE.height,
        fx: focal_px,
        fy: focal_px * 1.002,
        cx: 648.3,
        cy: 471.6,
        distortion,
    }
}

/// Lenses of 60, 120 and 180 degrees across the image's width.
pub fn lenses() -> [Truth; 4] {
    let barrel = Distortion::BrownConrady([-0.28, 0.11, 2e-4, -1e-4, -0.02, 0.0, 0.0, 0.0]);
    let rational = Distortion::BrownConrady([0.35, 0.02, 2e-4, -1e-4, 0.001, 0.62, 0.09, 0.002]);
    [
        Truth { name: "60", lens: Lens::BrownConrady5, camera: camera(1105.0, barrel) },
        Truth { name: "120 rational", lens: Lens::BrownConrady8, camera: camera(520.0, rational) },
        Truth {
            name: "120 fisheye",
            lens: Lens::KannalaBrandt,
            camera: camera(611.0, Distortion::KannalaBrandt([0.02, -0.01, 0.003, -0.001])),
        },
        Truth {
            name: "180 fisheye",
            lens: Lens::KannalaBrandt,
            camera: camera(408.0, Distortion::KannalaBrandt([0.01, -0.008, 0.002, -0.0005])),
        },
    ]
}

/// How the views are taken.
#[derive(Copy, Clone, Debug)]
pub struct Taking {
    pub views: usize,
    /// Of each corner alone, along each axis.
    pub noise_px: f64,
    /// Of all corners of a tag in a view together, along each axis.
    pub tag_noise_px: f64,
    /// How much deeper the board's middle lies.
    pub bend_m: [f64; 2],
    /// The board's tilt against the line of sight, from and to.
    pub tilts: [f64; 2],
    /// Nearest and farthest distance, by that at which the board is as wide as half of the image.
    pub distances: [f64; 2],
    /// The part of the image where the board's middle lies: left, right, top, bottom.
    pub part: [f64; 4],
    /// Whether the board is always parallel to the image.
    pub is_parallel: bool,
    /// The side of the printed tags, in metres: the stated size is TAG_M.
    pub tag_m: f64,
    /// How far the board moves while a picture is read out, row by row, in metres.
    pub motion_m: f64,
    /// By how much the bend changes from view to view, one standard deviation.
    pub floppy_m: f64,
    /// The fraction of tags that are found elsewhere, by up to 20 px.
    pub outliers: f64,
}

impl Default for Taking {
    fn default() -> Self {
        Self {
            views: 60,
            noise_px: 0.03,
            tag_noise_px: 0.02,
            bend_m: [0.002, 0.001],
            tilts: [0.2, 0.9],
            distances: [0.45, 1.2],
            part: [0.1, 0.9, 0.1, 0.9],
            is_parallel: false,
            tag_m: TAG_M,
            motion_m: 0.0,
            floppy_m: 0.0,
            outliers: 0.0,
        }
    }
}

impl Taking {
    /// Good sets of many kinds: fewer views, more noise, a flat or a bent board, some tags that are found elsewhere.
    pub fn good(seed: u64) -> Self {
        let usual = Self::default();
        let at = |shift: u32, values: [f64; 3]| {
            values[(seed / u64::from(3_u32.pow(shift)) % 3) as usize]
        };
        Self {
            views: at(0, [60.0, 40.0, 25.0]) as usize,
            noise_px: at(1, [0.03, 0.01, 0.08]),
            tag_noise_px: at(1, [0.02, 0.01, 0.06]),
            bend_m: [at(2, [0.002, 0.0, -0.004]), at(2, [0.001, 0.0, 0.002])],
            outliers: at(3, [0.0, 0.01, 0.03]),
            ..usual
        }
    }
}

/// The four corners of a tag, from the board's middle, in metres.
fn corners(tag: u32, side_m: f64) -> [[f64; 2]; 4] {
    let [column, row] = [tag % TAGS, tag / TAGS].map(f64::from);
    let middle = |at: f64| at * (TAG_M + GAP_M) + TAG_M / 2.0 - BOARD_M / 2.0;
    let [x, y, half] = [middle(column), middle(row), side_m / 2.0];
    [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]]
}

/// The views of this camera, by these rules.
pub fn views(camera: &CameraModel, taking: &Taking, seed: u64) -> Vec<View> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut views = Vec::new();
    while views.len() < taking.views {
        let points = points(camera, taking, &mut random);
        if points.len() >= 24 {
            views.push(View { name: format!("{:03}.png", views.len()), size: SIZE, points });
        }
    }
    views
}

fn normal(random: &mut impl Rng, sigma: f64) -> f64 {
    let value: f64 = StandardNormal.sample(random);
    value * sigma
}

fn points(camera: &CameraModel, taking: &Taking, random: &mut impl Rng) -> Vec<Sighting> {
    let Some(pose) = pose(camera, taking, random) else { return Vec::new() };
    let bend_m = taking.bend_m.map(|bend| bend + normal(random, taking.floppy_m));
    let motion = Vector3::new(normal(random, 1.0), normal(random, 1.0), 0.3 * normal(random, 1.0));
    let motion = motion.normalize() * taking.motion_m;
    let mut points = Vec::new();
    for tag in 0..TAGS * TAGS {
        let shared = [0, 1].map(|_| normal(random, taking.tag_noise_px));
        let printed = corners(tag, taking.tag_m);
        let seen = printed.map(|[x, y]| {
            let sag = |at: f64| 1.0 - (2.0 * at / BOARD_M) * (2.0 * at / BOARD_M);
            let depth = bend_m[0] * sag(x) + bend_m[1] * sag(y);
            let place = pose * Vector3::new(x, y, depth) + pose.translation.vector;
            let first = seen(camera, place)?;
            seen(camera, place + motion * (first.y / f64::from(SIZE.height) - 0.5))
        });
        let is_outlier = random.random_bool(taking.outliers);
        let off = [0, 1].map(|_| if is_outlier { random.random_range(-20.0..20.0) } else { 0.0 });
        let shared = [0, 1].map(|axis| shared[axis] + off[axis]);
        let noises =
            [0; 4].map(|_| [0, 1].map(|axis| shared[axis] + normal(random, taking.noise_px)));
        if seen.iter().all(Option::is_some) {
            for ((place_m, seen), [dx, dy]) in corners(tag, TAG_M).into_iter().zip(seen).zip(noises)
            {
                let seen = seen.map(|seen| Pixel::new(seen.x + dx, seen.y + dy));
                points.extend(seen.map(|seen| Sighting { tag, place_m, seen }));
            }
        }
    }
    points
}

/// Where a point is seen: within the image, and less than 88 degrees off the axis.
fn seen(camera: &CameraModel, place: Vector3<f64>) -> Option<Pixel> {
    let pixel = camera.project(Point::from_coords(place.into()))?;
    let border = 4.0;
    let is_inside = (border..f64::from(SIZE.width) - border).contains(&pixel.x)
        && (border..f64::from(SIZE.height) - border).contains(&pixel.y);
    (is_inside && place.z > 0.035 * place.norm()).then_some(pixel)
}

fn pose(camera: &CameraModel, taking: &Taking, random: &mut impl Rng) -> Option<Isometry3<f64>> {
    let [left, right, top, bottom] = taking.part;
    let x = random.random_range(left..right) * f64::from(SIZE.width);
    let y = random.random_range(top..bottom) * f64::from(SIZE.height);
    let sight = camera.unproject(Pixel::new(x, y))?.coords.normalize();
    let half_wide = BOARD_M * camera.fx / (0.5 * f64::from(SIZE.width));
    let [near, far] = taking.distances;
    let distance = half_wide * if near < far { random.random_range(near..far) } else { near };
    let facing = UnitQuaternion::rotation_between(&Vector3::z(), &sight)?;
    let towards = random.random_range(0.0..std::f64::consts::TAU);
    let axis = Vector3::new(towards.cos(), towards.sin(), 0.0);
    let [min, max] = taking.tilts;
    let tilt = UnitQuaternion::from_scaled_axis(axis * random.random_range(min..=max));
    let roll = UnitQuaternion::from_scaled_axis(Vector3::z() * random.random_range(-0.8..0.8));
    let rotation = if taking.is_parallel { tilt * roll } else { facing * tilt * roll };
    Some(Isometry3::from_parts(Translation3::from(sight * distance), rotation))
}

/// How far the projections of two cameras differ, in pixels: the 95th percentile over the image that `truth` describes.
pub fn map_error_px(truth: &CameraModel, found: &CameraModel) -> f64 {
    turned_error_px(truth, found, &UnitQuaternion::identity(), pixels())
}

/// The same over the part of the image where a calibration counts as known.
pub fn known_error_px(truth: &CameraModel, found: &Calibration) -> f64 {
    let known = pixels().filter(|pixel| found.is_known_at(*pixel));
    turned_error_px(truth, &found.camera, &UnitQuaternion::identity(), known)
}

/// As `map_error_px`, after the rotation between the two cameras' frames that brings the projections nearest: a principal point that
/// is off by a pixel is then little more than a camera that is turned by as much.
pub fn turned_map_error_px(truth: &CameraModel, found: &CameraModel) -> f64 {
    let mut turn = UnitQuaternion::identity();
    for _ in 0..3 {
        let (mut matrix, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for pixel in pixels() {
            let Some(ray) = truth.unproject(pixel).map(|ray| turn * ray.coords) else { continue };
            let Some((other, slope)) = found.project_with_jacobian(Point::from_coords(ray.into()))
            else {
                continue;
            };
            let slope = slope * -ray.cross_matrix();
            matrix += slope.transpose() * slope;
            right += slope.transpose() * Vector2::new(pixel.x - other.x, pixel.y - other.y);
        }
        let step = matrix.lu().solve(&right).unwrap_or_default();
        turn = UnitQuaternion::from_scaled_axis(step) * turn;
    }
    turned_error_px(truth, found, &turn, pixels())
}

fn pixels() -> impl Iterator<Item = Pixel> {
    let at = |i: u32, parts: u32| f64::from(i % parts) * 20.0 + 9.5;
    (0..64 * 48).map(move |i| Pixel::new(at(i, 64), at(i / 64, 48)))
}

fn turned_error_px(
    truth: &CameraModel,
    found: &CameraModel,
    turn: &UnitQuaternion<f64>,
    pixels: impl Iterator<Item = Pixel>,
) -> f64 {
    let error = |pixel: Pixel| {
        let ray = turn * truth.unproject(pixel)?.coords;
        let other = found.project(Point::from_coords(ray.into()));
        Some(other.map_or(f64::INFINITY, |other| other.distance(&pixel)))
    };
    let mut errors: Vec<f64> = pixels.filter_map(error).collect();
    errors.sort_by(f64::total_cmp);
    errors[errors.len() * 95 / 100]
}
