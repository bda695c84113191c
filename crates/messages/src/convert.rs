//! Converts transforms, covariances, lens and camera models, Bayer patterns and pixel formats between
//! messages and the types of `geometry` and `imaging`.

use geometry::{Body, Camera, CameraModel, Distortion, Frame, Point, Rotation, Transform};
use imaging::SampleFormat;
use nalgebra::{Matrix3, Matrix6};

use crate::camera::{BayerPattern, CameraInfo, LensModel, PixelFormat, Transform3};
use crate::detector::MarkerPose;

impl<A: Frame, B: Frame> From<&Transform<A, B>> for Transform3 {
    fn from(transform: &Transform<A, B>) -> Self {
        Self {
            translation_m: transform.origin().coords.into(),
            rotation_wxyz: transform.rotation().wxyz(),
        }
    }
}

impl Transform3 {
    /// The transform between the coordinate frames in the field's name; `None` for a rotation without
    /// a direction or numbers that are not finite.
    pub fn transform<A: Frame, B: Frame>(&self) -> Option<Transform<A, B>> {
        let [x, y, z] = self.translation_m;
        let origin = Point::new(x, y, z);
        let rotation = Rotation::from_wxyz(self.rotation_wxyz)?;
        origin.is_finite().then(|| Transform::new(rotation, origin))
    }
}

impl From<Distortion> for LensModel {
    fn from(distortion: Distortion) -> Self {
        match distortion {
            Distortion::None => Self::Pinhole,
            Distortion::BrownConrady(k) => Self::BrownConrady(k),
            Distortion::KannalaBrandt(k) => Self::KannalaBrandt(k),
        }
    }
}

impl From<LensModel> for Distortion {
    fn from(lens: LensModel) -> Self {
        match lens {
            LensModel::Pinhole => Self::None,
            LensModel::BrownConrady(k) => Self::BrownConrady(k),
            LensModel::KannalaBrandt(k) => Self::KannalaBrandt(k),
        }
    }
}

impl CameraInfo {
    /// A calibrated camera.
    pub fn new(
        camera: &str,
        model: &CameraModel,
        body_from_camera: &Transform<Body, Camera>,
    ) -> Self {
        Self {
            camera: camera.to_owned(),
            width: model.width,
            height: model.height,
            focal_px: Some([model.fx, model.fy]),
            principal_px: [model.cx, model.cy],
            lens: model.distortion.into(),
            body_from_camera: body_from_camera.into(),
        }
    }

    /// The camera model; `None` for a camera that is not calibrated, or numbers that are not a camera's.
    pub fn model(&self) -> Option<CameraModel> {
        let [fx, fy] = self.focal_px?;
        let [cx, cy] = self.principal_px;
        let is_valid = fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|n| n.is_finite());
        is_valid.then_some(CameraModel {
            width: self.width,
            height: self.height,
            fx,
            fy,
            cx,
            cy,
            distortion: self.lens.into(),
        })
    }
}

impl CameraInfo {
    /// The pixel at which the camera shows a place in its frame, in metres; `None` for a camera without a [`CameraInfo::model`] and for a
    /// place that [`CameraModel::project`] does not show.
    pub fn pixel_of(&self, [x, y, z]: [f64; 3]) -> Option<[f64; 2]> {
        self.model()?.project(Point::new(x, y, z)).map(|pixel| [pixel.x, pixel.y])
    }
}

impl From<imaging::BayerPattern> for BayerPattern {
    fn from(pattern: imaging::BayerPattern) -> Self {
        use imaging::BayerPattern as Raw;
        match pattern {
            Raw::Rggb => Self::Rggb,
            Raw::Grbg => Self::Grbg,
            Raw::Gbrg => Self::Gbrg,
            Raw::Bggr => Self::Bggr,
        }
    }
}

impl From<BayerPattern> for imaging::BayerPattern {
    fn from(pattern: BayerPattern) -> Self {
        match pattern {
            BayerPattern::Rggb => Self::Rggb,
            BayerPattern::Grbg => Self::Grbg,
            BayerPattern::Gbrg => Self::Gbrg,
            BayerPattern::Bggr => Self::Bggr,
        }
    }
}

impl PixelFormat {
    /// The layout of the samples; `None` for a compressed image.
    pub fn sample_format(self) -> Option<SampleFormat> {
        let (bits, pattern) = match self {
            Self::Jpeg => return None,
            Self::Mono8 => (8, None),
            Self::Mono10 => (10, None),
            Self::Mono12 => (12, None),
            Self::Mono16 => (16, None),
            Self::Bayer8(pattern) => (8, Some(pattern)),
            Self::Bayer10(pattern) => (10, Some(pattern)),
            Self::Bayer12(pattern) => (12, Some(pattern)),
            Self::Bayer16(pattern) => (16, Some(pattern)),
        };
        Some(SampleFormat { bits, bayer: pattern.map(imaging::BayerPattern::from) })
    }
}

impl MarkerPose {
    /// The upper triangle of a symmetric matrix, row by row, as in [`MarkerPose::covariance`].
    pub fn upper_triangle(matrix: &Matrix6<f64>) -> [f32; 21] {
        let mut cells = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
        std::array::from_fn(|_| {
            cells.next().and_then(|at| matrix.get(at)).map_or(0.0, |c| *c as f32)
        })
    }

    /// Covariance of the translation in the camera frame, in square metres.
    pub fn translation_covariance_m2(&self) -> Matrix3<f64> {
        let [xx, xy, xz, _, _, _, yy, yz, _, _, _, zz, ..] = self.covariance.map(f64::from);
        Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_covariance_is_sent_as_its_upper_triangle_row_by_row() {
        let matrix =
            Matrix6::from_fn(|row, column| (10 * row.min(column) + row.max(column)) as f64);
        let sent = MarkerPose::upper_triangle(&matrix);
        assert_eq!((sent[0], sent[5], sent[6], sent[11], sent[20]), (0.0, 5.0, 11.0, 22.0, 55.0));
        let pose = MarkerPose { covariance: sent, ..MarkerPose::sample() };
        let translation = matrix.fixed_view::<3, 3>(0, 0).into_owned();
        assert_eq!(pose.translation_covariance_m2(), translation);
    }

    #[test]
    fn numbers_that_are_not_a_transform_are_refused() {
        let good =
            Transform3 { translation_m: [0.0, 0.0, 1.0], rotation_wxyz: [1.0, 0.0, 0.0, 0.0] };
        let transform = good.transform::<Body, Camera>().unwrap();
        assert_eq!(Transform3::from(&transform), good);
        let nan = Transform3 { translation_m: [f64::NAN, 0.0, 1.0], ..good };
        assert!(nan.transform::<Body, Camera>().is_none());
        let flat = Transform3 { rotation_wxyz: [0.0; 4], ..good };
        assert!(flat.transform::<Body, Camera>().is_none());
    }

    #[test]
    fn a_camera_is_sent_and_read_back() {
        let mut model = CameraModel::pinhole(640, 480, 500.0);
        model.distortion = Distortion::KannalaBrandt([0.1, 0.2, 0.3, 0.4]);
        let mount = Transform::identity();
        assert_eq!(CameraInfo::new("down", &model, &mount).model(), Some(model));
        for focal_px in [None, Some([1.0, f64::INFINITY]), Some([0.0, 1.0])] {
            assert_eq!(CameraInfo { focal_px, ..CameraInfo::sample() }.model(), None);
        }
    }

    #[test]
    fn the_sample_marker_is_where_the_sample_camera_shows_it() {
        let place_m = MarkerPose::sample().camera_from_marker.translation_m;
        let [x, y] = CameraInfo::sample().pixel_of(place_m).unwrap();
        let [u, v] = crate::Detection::sample().centre_px;
        assert!((x - u).hypot(y - v) < 0.5, "({x}, {y})");
        assert_eq!(CameraInfo::sample().pixel_of([0.0, 0.0, -1.0]), None);
    }

    #[test]
    fn every_pattern_and_lens_is_read_back() {
        use BayerPattern::{Bggr, Gbrg, Grbg, Rggb};
        for pattern in [Rggb, Grbg, Gbrg, Bggr] {
            assert_eq!(BayerPattern::from(imaging::BayerPattern::from(pattern)), pattern);
        }
        let lens = LensModel::BrownConrady([1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]);
        assert_eq!(LensModel::from(Distortion::from(lens)), lens);
    }
}
