//! Cross-validates two halves of the views, solved separately.
//!
//! The projections of the two cameras are compared after the rotation between their frames that brings them nearest, as a
//! calibration defines no other frame than its own (mrcal, "Differences in projection", has the idea).

use geometry::{CameraModel, Pixel, Point};
use libm::fmax;
use nalgebra::{Matrix3, SMatrix, UnitQuaternion, Vector3};

use crate::lens::INTRINSICS;
use crate::stages::Solved;
use crate::view::ImageSize;

/// The comparison of two halves of the views.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct CrossValidation {
    /// Root mean square, over the image, of the distance between both projections, after the best rotation; px.
    pub difference_px: f64,
    /// The difference expected from the halves' stated uncertainties, in pixels.
    pub expected_px: f64,
}

impl CrossValidation {
    /// The difference by its expectation: around 1 when the uncertainty is honest.
    pub fn ratio(&self) -> f64 {
        self.difference_px / fmax(self.expected_px, 1e-12)
    }
}

/// A camera and how sure it is.
#[derive(Copy, Clone, Debug)]
struct Half {
    camera: CameraModel,
    covariance: SMatrix<f64, INTRINSICS, INTRINSICS>,
}

impl Half {
    fn new(whole: &Solved, keep: impl Fn(usize) -> bool) -> Option<Self> {
        let part = whole.part(keep);
        let certainty = part.information()?.certainty(&part.free)?;
        let covariance =
            certainty.covariance.fixed_view::<INTRINSICS, INTRINSICS>(0, 0).into_owned();
        Some(Self { camera: part.bundle().camera(&part.place.shared), covariance })
    }
}

/// The comparison of every second view with the others, and of the first half with the second, which shows changes in between.
/// Empty where a half does not determine the camera.
pub(crate) fn cross_validations(whole: &Solved) -> impl Iterator<Item = CrossValidation> {
    let middle = whole.views.len() / 2;
    let by = |is_first: &dyn Fn(usize) -> bool| {
        compare(&Half::new(whole, is_first)?, &Half::new(whole, |view| !is_first(view))?)
    };
    let both = [by(&|view| view % 2 == 0), by(&|view| view < middle)];
    both.into_iter().flatten()
}

/// Columns and rows of the places that are compared.
const COLUMNS: usize = 12;
const ROWS: usize = 9;
/// Steps to the best rotation, from none.
const STEPS: usize = 4;

/// A place of the image: how the projection there changes with the rotation and with the intrinsics.
struct Comparison {
    pixel: Pixel,
    ray: Vector3<f64>,
    by_turn: SMatrix<f64, 2, 3>,
    by_intrinsics: SMatrix<f64, 2, INTRINSICS>,
}

/// The comparison of two halves; `None` where they share too little of the image.
fn compare(a: &Half, b: &Half) -> Option<CrossValidation> {
    let size = ImageSize { width: a.camera.width, height: a.camera.height };
    let places: Vec<Comparison> = size
        .middles(COLUMNS, ROWS)
        .filter_map(|pixel| comparison(&a.camera, &b.camera, pixel))
        .collect();
    let mut matrix = Matrix3::zeros();
    let mut mixed = SMatrix::<f64, 3, INTRINSICS>::zeros();
    for place in &places {
        matrix += place.by_turn.transpose() * place.by_turn;
        mixed += place.by_turn.transpose() * place.by_intrinsics;
    }
    let inverse = matrix.cholesky()?.inverse();
    let turn = best_turn(&places, &b.camera, &inverse)?;
    let covariance = a.covariance + b.covariance;
    let (mut squares, mut expected, mut count) = (0.0, 0.0, 0.0);
    for place in &places {
        let Some(other) = b.camera.project(Point::from_coords((turn * place.ray).into())) else {
            continue;
        };
        let distance = other.distance(&place.pixel);
        let slope = place.by_intrinsics - place.by_turn * inverse * mixed;
        squares += distance * distance;
        expected += fmax((slope * covariance * slope.transpose()).trace(), 0.0);
        count += 1.0;
    }
    (count > 0.0).then(|| CrossValidation {
        difference_px: (squares / count).sqrt(),
        expected_px: (expected / count).sqrt(),
    })
}

fn comparison(a: &CameraModel, b: &CameraModel, pixel: Pixel) -> Option<Comparison> {
    let ray = a.unproject(pixel)?.coords;
    let point = Point::from_coords(ray.into());
    b.project(point)?;
    let (_, by_point) = a.project_with_jacobian(point)?;
    let by_turn = by_point * -ray.cross_matrix();
    Some(Comparison { pixel, ray, by_turn, by_intrinsics: a.intrinsics_jacobian(point)? })
}

/// The rotation after which `b` projects the rays nearest to where `a` does.
fn best_turn(
    places: &[Comparison],
    b: &CameraModel,
    inverse: &Matrix3<f64>,
) -> Option<UnitQuaternion<f64>> {
    let mut turn = UnitQuaternion::identity();
    for _ in 0..STEPS {
        let mut right = Vector3::zeros();
        for place in places {
            if let Some(other) = b.project(Point::from_coords((turn * place.ray).into())) {
                let gap = nalgebra::Vector2::new(place.pixel.x - other.x, place.pixel.y - other.y);
                right += place.by_turn.transpose() * gap;
            }
        }
        let step = inverse * right;
        if !step.iter().all(|value| value.is_finite()) {
            return None;
        }
        turn = UnitQuaternion::from_scaled_axis(step) * turn;
    }
    Some(turn)
}
