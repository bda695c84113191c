//! Maps markers that were found in parts of a frame to pixels of the whole frame.

use fiducial::Observation;
use geometry::Roi;
use messages::FramePart;

/// The region of the frame that a part shows.
pub fn roi(part: &FramePart) -> Roi {
    let [left, top, scale] = [part.x, part.y, part.scale].map(f64::from);
    Roi::binned(left, top, part.width, part.height, scale)
}

/// Adds the observations of a finer part; they replace those of the same markers in coarser parts.
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
    use geometry::CameraModel;
    use imaging::GrayImage;

    const PART: FramePart =
        FramePart { x: 160, y: 80, width: 120, height: 100, scale: 2, bytes: 0 };

    /// A marker drawn at a position in a frame.
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
    fn a_marker_in_a_part_is_where_it_is_in_the_frame() {
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
        let part_camera = roi(&PART).camera(&camera);
        let seen = detector.detect(coarse.view().unwrap(), Some(&part_camera), &mut ());
        let mut found: Vec<_> = seen.iter().map(|seen| seen.mapped(&roi(&PART))).collect();
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
