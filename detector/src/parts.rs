//! Markers found in parts of a frame, told in the whole frame's pixels.
//!
//! A part is a camera of its own: the same place and direction, another size, centre and focal length. So poses come
//! out the same, and only what is in pixels is moved and scaled.

use fiducial::Observation;
use geometry::{CameraModel, Pixel};
use messages::FramePart;

/// The camera that a part was taken by.
pub fn camera_of(part: &FramePart, camera: &CameraModel) -> CameraModel {
    let scale = f64::from(part.scale);
    let [left, top] = offset(part);
    CameraModel {
        width: part.width,
        height: part.height,
        fx: camera.fx / scale,
        fy: camera.fy / scale,
        cx: (camera.cx - left) / scale,
        cy: (camera.cy - top) / scale,
        ..*camera
    }
}

/// An observation in a part, in pixels of the frame.
pub fn in_frame(part: &FramePart, seen: &Observation) -> Observation {
    let scale = f64::from(part.scale);
    let [left, top] = offset(part);
    let moved = |at: Pixel| Pixel::new(left + scale * at.x, top + scale * at.y);
    let mut seen = seen.clone();
    seen.centre = moved(seen.centre);
    seen.corners = seen.corners.map(|corners| corners.map(moved));
    seen.centre_covariance_px2 *= scale * scale;
    seen.size_px *= scale;
    if let Some(pose) = &mut seen.pose {
        pose.reprojection_rms_px *= scale;
        if let Some(other) = &mut pose.alternative {
            other.reprojection_rms_px *= scale;
        }
    }
    seen
}

/// Where the middle of the part's first pixel lies in the frame.
fn offset(part: &FramePart) -> [f64; 2] {
    let half = (f64::from(part.scale) - 1.0) / 2.0;
    [f64::from(part.x) + half, f64::from(part.y) + half]
}

/// Adds what was seen in a finer part, in the place of the same markers in coarser ones.
pub fn add_finer(found: &mut Vec<Observation>, finer: impl Iterator<Item = Observation>) {
    for seen in finer {
        let is_same = |other: &Observation| {
            (other.family, other.id) == (seen.family, seen.id)
                && other.centre.distance(&seen.centre) < 0.5 * seen.size_px
        };
        found.retain(|other| !is_same(other));
        found.push(seen);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use fiducial::Detector;
    use geometry::Point;
    use imaging::GrayImage;

    const PART: FramePart =
        FramePart { x: 160, y: 80, width: 120, height: 100, scale: 2, bytes: 0 };

    #[test]
    fn a_parts_camera_sees_the_same_directions() {
        let camera = CameraModel::pinhole(640, 480, 500.0);
        let part = camera_of(&PART, &camera);
        let point = Point::new(-0.3, 0.2, 2.0);
        let (whole, own) = (camera.project(point).unwrap(), part.project(point).unwrap());
        assert!((whole.x - (160.5 + 2.0 * own.x)).abs() < 1e-9);
        assert!((whole.y - (80.5 + 2.0 * own.y)).abs() < 1e-9);
    }

    /// A marker drawn at a place of a frame.
    fn frame(centre: [f64; 2], size_px: f64) -> GrayImage {
        let marker = "aruco-4x4-50:7".parse().unwrap();
        let drawing = markers::Drawing::new(&marker, size_px).unwrap();
        let mut image = GrayImage::filled(640, 480, 180);
        // A pixel is the mean of its area, and of some of its neighbours' as behind any lens.
        let steps: Vec<f64> = (0..8).map(|i| f64::from(i) * 0.25 - 0.875).collect();
        for y in 0..480 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let (right, up) = (x as f64 - centre[0], centre[1] - y as f64);
                if right.abs().max(up.abs()) > drawing.half_extent_m {
                    continue;
                }
                let white =
                    |dx: f64, dy: f64| drawing.ink_at(right + dx, up + dy) == markers::Ink::White;
                let all = steps.iter().flat_map(|dx| steps.iter().map(move |dy| (*dx, *dy)));
                let count = all.filter(|(dx, dy)| white(*dx, *dy)).count();
                *pixel = (20 + 200 * count / (steps.len() * steps.len())) as u8;
            }
        }
        image
    }

    #[test]
    fn what_a_part_shows_is_where_the_frame_shows_it() {
        let image = frame([270.0, 170.0], 90.0);
        let camera = CameraModel::pinhole(640, 480, 500.0);
        let marker = "aruco-4x4-50:7:0.2".parse().unwrap();
        let mut detector = Detector::new(&[marker], fiducial::Settings::default()).unwrap();
        let whole = detector.detect(image.view().unwrap(), Some(&camera), &mut ()).to_vec();
        let mut coarse = GrayImage::filled(120, 100, 0);
        for y in 0..100 {
            for (x, pixel) in coarse.row_mut(y).iter_mut().enumerate() {
                let at = |dx, dy| u32::from(image.row(80 + 2 * y + dy)[160 + 2 * x + dx]);
                *pixel = ((at(0, 0) + at(1, 0) + at(0, 1) + at(1, 1) + 2) / 4) as u8;
            }
        }
        let part_camera = camera_of(&PART, &camera);
        let seen = detector.detect(coarse.view().unwrap(), Some(&part_camera), &mut ());
        let mut found: Vec<_> = seen.iter().map(|seen| in_frame(&PART, seen)).collect();
        assert_eq!((whole.len(), found.len()), (1, 1));
        assert!(whole[0].centre.distance(&found[0].centre) < 0.2, "{whole:?} {found:?}");
        assert!((whole[0].size_px / found[0].size_px - 1.0).abs() < 0.03);
        let distance = |seen: &Observation| {
            let origin = seen.pose.as_ref().unwrap().camera_from_marker.origin();
            (origin.x().powi(2) + origin.y().powi(2) + origin.z().powi(2)).sqrt()
        };
        assert!((distance(&whole[0]) / distance(&found[0]) - 1.0).abs() < 0.01);
        add_finer(&mut found, whole.clone().into_iter());
        assert_eq!(found, whole);
    }
}
