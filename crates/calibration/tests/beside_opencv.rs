//! Compares calibrations of the same points by this crate and by OpenCV.

mod opencv;
mod synthetic;

use calibration::{Calibration, Lens, Options, calibrate_unjudged};
use geometry::CameraModel;
use synthetic::{Taking, lenses, map_error_px, views};

#[test]
fn a_flat_board_gives_the_camera_that_opencv_finds_and_a_bent_one_a_better() {
    let truth = lenses()[0];
    for bend_m in [[0.0; 2], [0.002, 0.001]] {
        let views = views(&truth.camera, &Taking { bend_m, ..Taking::default() }, 700);
        let Some(found) = opencv::solve(&views, truth.lens) else { return };
        let theirs = found.unwrap();
        let ours = calibrate_unjudged(&views, truth.lens, &Options::default()).unwrap();
        let errors =
            [&ours.camera, &theirs.camera].map(|camera| map_error_px(&truth.camera, camera));
        if bend_m == [0.0; 2] {
            let sigma = |i: usize| ours.covariance[(i, i)].sqrt();
            let (a, b) = (ours.camera, theirs.camera);
            let differences = [a.fx - b.fx, a.fy - b.fy, a.cx - b.cx, a.cy - b.cy];
            for (i, difference) in differences.into_iter().enumerate() {
                assert!(difference.abs() < sigma(i), "{i}: {difference} {}", sigma(i));
            }
        } else {
            assert!(errors[0] < 0.1 * errors[1], "{errors:?}");
        }
    }
}

#[test]
fn photographs_give_the_camera_that_opencv_finds() {
    for set in opencv::photographs() {
        let Some(found) = opencv::solve(&set.views, Lens::BrownConrady5) else { return };
        let theirs = found.unwrap();
        let flat =
            calibrate_unjudged(&set.views, Lens::BrownConrady5, &Options { solve_bend: false })
                .unwrap();
        let bent =
            calibrate_unjudged(&set.views, Lens::BrownConrady5, &Options::default()).unwrap();
        let print = |name: &str, found: &Calibration| {
            let CameraModel { fx, fy, cx, cy, .. } = found.camera;
            let sigma = found.covariance[(0, 0)].sqrt();
            println!(
                "{}, {name}: {fx:.2} +- {sigma:.2}, {fy:.2}, {cx:.2}, {cy:.2}, rms {:.3} px",
                set.name, found.rms_px
            );
        };
        print("flat", &flat);
        print("bent", &bent);
        // Theirs is the least RMS of a flat board; ours gives single bad corners less weight.
        assert!(
            flat.rms_px < 1.05 * theirs.rms_px,
            "{}: {} {}",
            set.name,
            flat.rms_px,
            theirs.rms_px
        );
        assert!(
            bent.rms_px < 1.02 * theirs.rms_px,
            "{}: {} {}",
            set.name,
            bent.rms_px,
            theirs.rms_px
        );
        assert!((theirs.rms_px - set.rms_px).abs() < 1e-3, "{}: {}", set.name, theirs.rms_px);
        let (a, b) = (flat.camera, theirs.camera);
        let differences = [a.fx - b.fx, a.fy - b.fy, a.cx - b.cx, a.cy - b.cy];
        for (i, difference) in differences.into_iter().enumerate() {
            let sigma = flat.covariance[(i, i)].sqrt();
            assert!(difference.abs() < 2.0 * sigma, "{} {i}: {difference} {sigma}", set.name);
        }
    }
}
