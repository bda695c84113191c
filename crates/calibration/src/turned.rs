//! Finds views that were turned by 180 degrees after they were taken.

use nalgebra::{Isometry3, UnitQuaternion, Vector3};

use crate::board::BoardPoint;
use crate::equations::{Bundle, Place};
use crate::stages::Solved;
use crate::start::refined;

/// By how much, in variances of the noise, the cost of a view's residuals must be smaller after the turn. Views as they were taken
/// gain up to 4 where the lens is symmetric about the image's centre, and are otherwise far worse. Turned views of a principal point
/// that is 10 px off the centre gain 400 and more.
const MIN_GAIN: f64 = 100.0;
/// By which factor the cost must be smaller: residuals of motion or of another lens remain after the turn.
const MIN_RATIO: f64 = 2.0;

/// Whether the camera explains a view better after a turn by 180 degrees: a turned image has the principal point and the centre of
/// the distortion on the other side of its centre.
pub(crate) fn is_turned(solved: &Solved, points: &[BoardPoint], pose: &Isometry3<f64>) -> bool {
    let shared = solved.place.shared;
    let bundle = solved.bundle();
    let cost = |points: &Vec<BoardPoint>, place: &Place| {
        Bundle { views: std::slice::from_ref(points), ..bundle }.cost(place)
    };
    let given = points.to_vec();
    let given_cost = cost(&given, &Place { shared, poses: vec![*pose] });
    let [width, height] = [solved.size.width, solved.size.height].map(f64::from);
    let mut back = given;
    for point in &mut back {
        point.seen = [width - 1.0 - point.seen[0], height - 1.0 - point.seen[1]];
    }
    let half_turn = UnitQuaternion::from_scaled_axis(Vector3::z() * std::f64::consts::PI);
    let place = refined(&bundle, &back, &shared, half_turn * pose, bundle.scale_px);
    place.is_some_and(|place| {
        let (back_cost, noise_px2) = (cost(&back, &place), solved.noise_px * solved.noise_px);
        given_cost - back_cost > MIN_GAIN * noise_px2 && given_cost > MIN_RATIO * back_cost
    })
}
