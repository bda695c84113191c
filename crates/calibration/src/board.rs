//! Models the board's points for the solver, and predicts the pixel of each, with its derivatives.
//!
//! Besides the intrinsics all views share the board's bend and, when a result is judged, flaws of its print: tags of another
//! size, a stretch, a shear. The flaws are zero wherever something is linearised: only their slopes are needed.

use geometry::{Board, Camera, CameraModel, Point};
use libm::fmax;
use nalgebra::{Isometry3, SMatrix, SVector, Vector3};

use crate::lens::INTRINSICS;
use crate::view::View;

/// Where the bend's two numbers are among those that the views share.
pub(crate) const BEND: usize = INTRINSICS;
/// Intrinsics and bend.
pub(crate) const SOLVED: usize = BEND + 2;
/// Where the print's flaws are: the tags' scale about their middles, a stretch of x against y, a shear.
pub(crate) const FLAWS: usize = SOLVED;
/// All that the views share.
pub(crate) const SHARED: usize = FLAWS + 3;

/// Intrinsics, bend (metres that the centre is deeper than the ends, along x and along y), flaws.
pub(crate) type Shared = SVector<f64, SHARED>;
/// How a pixel changes with them, row by row.
pub(crate) type SharedSlope = [[f64; SHARED]; 2];
/// How a pixel changes with the pose: translation, then rotation vector, both in the camera frame.
pub(crate) type PoseSlope = [[f64; 6]; 2];

/// A point of the board, seen in an image.
#[derive(Copy, Clone, Debug)]
pub(crate) struct BoardPoint {
    pub(crate) tag: u32,
    /// From the board's middle, in metres.
    pub(crate) place_m: [f64; 2],
    /// From the middle of its tag, in metres.
    arm_m: [f64; 2],
    /// From the board's middle, by half of the board's extent along each axis.
    share: [f64; 2],
    /// How deep it lies for a bend of 1 m along x and along y.
    sag: [f64; 2],
    pub(crate) seen: [f64; 2],
}

/// Half of the board's width and height, in metres, and the places of its points in each view.
#[derive(Clone, Debug)]
pub(crate) struct Sheet {
    pub(crate) middle_m: [f64; 2],
    pub(crate) half_m: [f64; 2],
    pub(crate) views: Vec<Vec<BoardPoint>>,
}

impl Sheet {
    /// The board's points in the views; each view's points in the order of their tags.
    pub(crate) fn new(views: &[&View]) -> Self {
        let places = || views.iter().flat_map(|view| &view.points).map(|point| point.place_m);
        let bounds = [0, 1].map(|axis| {
            places()
                .map(|place| place[axis])
                .fold([f64::INFINITY, f64::NEG_INFINITY], |[min, max], at| {
                    [libm::fmin(min, at), fmax(max, at)]
                })
        });
        let middle_m = bounds.map(|[min, max]| (min + max) / 2.0);
        let half_m = bounds.map(|[min, max]| fmax((max - min) / 2.0, 1e-9));
        let views = views.iter().map(|view| Self::points(view, middle_m, half_m)).collect();
        Self { middle_m, half_m, views }
    }

    fn points(view: &View, middle_m: [f64; 2], half_m: [f64; 2]) -> Vec<BoardPoint> {
        let mut points: Vec<BoardPoint> = view
            .points
            .iter()
            .map(|sighting| {
                let place_m = [0, 1].map(|axis| sighting.place_m[axis] - middle_m[axis]);
                let share = [0, 1].map(|axis| place_m[axis] / half_m[axis]);
                let sag = share.map(|share| 1.0 - share * share);
                let seen = [sighting.seen.x, sighting.seen.y];
                BoardPoint { tag: sighting.tag, place_m, arm_m: [0.0; 2], share, sag, seen }
            })
            .collect();
        points.sort_by_key(|point| point.tag);
        for tag in points.chunk_by_mut(|a, b| a.tag == b.tag) {
            let count = tag.len() as f64;
            let middle =
                [0, 1].map(|axis| tag.iter().map(|p| p.place_m[axis]).sum::<f64>() / count);
            for point in tag {
                point.arm_m = [0, 1].map(|axis| point.place_m[axis] - middle[axis]);
            }
        }
        points
    }
}

impl BoardPoint {
    /// Where it is in the board's frame, whose origin is the board's middle.
    fn place(&self, shared: &Shared) -> Vector3<f64> {
        let depth = shared[BEND] * self.sag[0] + shared[BEND + 1] * self.sag[1];
        Vector3::new(self.place_m[0], self.place_m[1], depth)
    }

    /// Its place from the board's middle, by half of the board's extent along each axis.
    pub(crate) fn share(&self) -> [f64; 2] {
        self.share
    }

    /// Where it is from the camera.
    pub(crate) fn in_camera(&self, shared: &Shared, pose: &Isometry3<f64>) -> Point<Camera> {
        let camera_from_board = geometry::Transform::<Camera, Board>::from_isometry(*pose);
        camera_from_board * Point::from_coords(self.place(shared).into())
    }

    /// The residual, observed less predicted, in pixels; `None` where the point is not in the image.
    pub(crate) fn residual(
        &self,
        camera: &CameraModel,
        shared: &Shared,
        pose: &Isometry3<f64>,
    ) -> Option<[f64; 2]> {
        let pixel = camera.project(self.in_camera(shared, pose))?;
        Some([self.seen[0] - pixel.x, self.seen[1] - pixel.y])
    }

    /// The same with the expected pixel's derivatives.
    pub(crate) fn linearised(
        &self,
        camera: &CameraModel,
        shared: &Shared,
        pose: &Isometry3<f64>,
    ) -> Option<Linearised> {
        let place = self.place(shared);
        let rotation = pose.rotation.to_rotation_matrix();
        let arm = rotation * place;
        let point = Point::from_coords((arm + pose.translation.vector).into());
        let (pixel, by_point) = camera.project_with_jacobian(point)?;
        let by_intrinsics = camera.intrinsics_jacobian(point)?;
        let by_place = by_point * rotation.matrix();
        let by_turn: SMatrix<f64, 2, 3> = by_point * -arm.cross_matrix();
        let [x, y] = self.place_m;
        let mut by_shared = [[0.0; SHARED]; 2];
        let mut by_pose = [[0.0; 6]; 2];
        for row in 0..2 {
            let slopes = &mut by_shared[row];
            for (slope, by) in slopes.iter_mut().zip(by_intrinsics.row(row).iter()) {
                *slope = *by;
            }
            let [by_x, by_y, by_z] = [0, 1, 2].map(|axis| by_place[(row, axis)]);
            slopes[BEND] = by_z * self.sag[0];
            slopes[BEND + 1] = by_z * self.sag[1];
            slopes[FLAWS] = by_x * self.arm_m[0] + by_y * self.arm_m[1];
            slopes[FLAWS + 1] = by_x * x - by_y * y;
            slopes[FLAWS + 2] = by_x * y;
            by_pose[row] = [0, 1, 2, 3, 4, 5]
                .map(|i| if i < 3 { by_point[(row, i)] } else { by_turn[(row, i - 3)] });
        }
        let residual = [self.seen[0] - pixel.x, self.seen[1] - pixel.y];
        Some(Linearised { residual, by_shared, by_pose })
    }
}

/// A residual in pixels, and how the expected pixel changes.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Linearised {
    pub(crate) residual: [f64; 2],
    pub(crate) by_shared: SharedSlope,
    pub(crate) by_pose: PoseSlope,
}

#[cfg(test)]
mod tests {
    use geometry::Pixel;
    use nalgebra::{UnitQuaternion, Vector6};
    use proptest::prelude::*;

    use super::*;
    use crate::lens::Lens;
    use crate::solve::moved;
    use crate::view::{ImageSize, Sighting};

    const SIZE: ImageSize = ImageSize { width: 1280, height: 960 };

    fn shared(lens: Lens) -> Shared {
        let mut shared = Shared::zeros();
        let numbers: &[f64] = match lens {
            Lens::KannalaBrandt => &[600.0, 610.0, 640.0, 470.0, 0.02, -0.01, 0.003, -0.001],
            _ => &[900.0, 910.0, 640.0, 470.0, 0.3, -0.1, 1e-3, -2e-3, 0.02, 0.4, 0.05, 0.01],
        };
        for (value, number) in shared.iter_mut().zip(numbers) {
            *value = *number;
        }
        (shared[BEND], shared[BEND + 1]) = (0.004, -0.003);
        shared
    }

    fn board_point(x: f64, y: f64) -> BoardPoint {
        let corner = |dx: f64, dy: f64| Sighting {
            tag: 3,
            place_m: [x + dx, y + dy],
            seen: Pixel::new(500.0, 400.0),
        };
        let far = |at: f64| Sighting { tag: 9, ..corner(at - x, at - y) };
        let points = vec![
            corner(0.0, 0.0),
            corner(0.05, 0.0),
            corner(0.05, 0.05),
            corner(0.0, 0.05),
            far(-0.4),
            far(0.4),
        ];
        let view = View { name: String::new(), size: SIZE, points };
        Sheet::new(&[&view]).views[0][0]
    }

    proptest! {
        #[test]
        fn derivatives_are_the_slopes_of_the_expected_pixel(
            x in -0.3..0.3f64, y in -0.3..0.3f64, z in 0.6..2.0f64, tilt in -0.7..0.7f64, turn in -3.0..3.0f64,
        ) {
            for lens in [Lens::BrownConrady8, Lens::KannalaBrandt] {
                let size = SIZE;
                let camera = |shared: &Shared| lens.camera(size, &std::array::from_fn(|i| shared[i]));
                let (point, shared) = (board_point(x, y), shared(lens));
                let rotation = UnitQuaternion::from_euler_angles(tilt, 0.5 * tilt, turn);
                let pose = Isometry3::from_parts([0.1, -0.05, z].into(), rotation);
                let at = point.linearised(&camera(&shared), &shared, &pose).unwrap();
                for i in 0..SOLVED {
                    let step = if i < 4 { 1e-4 } else { 1e-7 };
                    let residual = |step: f64| {
                        let mut moved = shared;
                        moved[i] += step;
                        point.residual(&camera(&moved), &moved, &pose).unwrap()
                    };
                    let (ahead, behind) = (residual(step), residual(-step));
                    for row in 0..2 {
                        let slope = (behind[row] - ahead[row]) / (2.0 * step);
                        let error = (at.by_shared[row][i] - slope).abs();
                        prop_assert!(error < 1e-5 * (1.0 + slope.abs()) + 1e-4, "{lens} {i} {row}: {slope} {error}");
                    }
                }
                for i in 0..6 {
                    let residual = |step: f64| {
                        let pose = moved(&pose, &Vector6::from_fn(|j, _| if i == j { step } else { 0.0 })).unwrap();
                        point.residual(&camera(&shared), &shared, &pose).unwrap()
                    };
                    let (ahead, behind) = (residual(1e-6), residual(-1e-6));
                    for row in 0..2 {
                        let slope = (behind[row] - ahead[row]) / 2e-6;
                        let error = (at.by_pose[row][i] - slope).abs();
                        prop_assert!(error < 1e-5 * (1.0 + slope.abs()), "{lens} pose {i} {row}: {slope} {error}");
                    }
                }
            }
        }

        #[test]
        fn a_flaw_of_the_print_moves_the_points_by_its_slope(
            x in -0.3..0.3f64, y in -0.3..0.3f64, z in 0.6..2.0f64, tilt in -0.7..0.7f64,
        ) {
            let lens = Lens::BrownConrady8;
            let mut shared = shared(lens);
            (shared[BEND], shared[BEND + 1]) = (0.0, 0.0);
            let camera = lens.camera(SIZE, &std::array::from_fn(|i| shared[i]));
            let point = board_point(x, y);
            let pose = Isometry3::from_parts([0.0, 0.0, z].into(), UnitQuaternion::from_euler_angles(tilt, 0.0, 0.3));
            let at = point.linearised(&camera, &shared, &pose).unwrap();
            let [px, py] = point.place_m;
            let [ax, ay] = point.arm_m;
            let printed = [[ax, ay], [px, -py], [py, 0.0]];
            for (i, [dx, dy]) in printed.into_iter().enumerate() {
                let residual = |step: f64| {
                    let place_m = [px + step * dx, py + step * dy];
                    BoardPoint { place_m, ..point }.residual(&camera, &shared, &pose).unwrap()
                };
                let (ahead, behind) = (residual(1e-6), residual(-1e-6));
                for row in 0..2 {
                    let slope = (behind[row] - ahead[row]) / 2e-6;
                    prop_assert!((at.by_shared[row][FLAWS + i] - slope).abs() < 1e-4, "{i} {row}: {slope}");
                }
            }
        }
    }
}
