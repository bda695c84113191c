//! Between the algorithm's types and the messages.

use fiducial::{MarkerPose, Observation, PadObservation};
use geometry::{Camera, CameraModel, Distortion, Marker, Transform};
use imaging::{Mosaic, SampleFormat};
use markers::Pad;
use messages::{
    AlternativePose, BayerPattern, CameraInfo, Detection, LensModel, PixelFormat, Transform3,
};
use nalgebra::Matrix6;

/// The camera model of a calibrated camera; `None` for one that is not calibrated or not sound.
pub fn camera_model(info: &CameraInfo) -> Option<CameraModel> {
    let [fx, fy] = info.focal_px?;
    let [cx, cy] = info.principal_px;
    let is_sound = fx > 0.0 && fy > 0.0 && [fx, fy, cx, cy].iter().all(|n| n.is_finite());
    let distortion = match info.lens {
        LensModel::Pinhole => Distortion::None,
        LensModel::BrownConrady(k) => Distortion::BrownConrady(k),
        LensModel::KannalaBrandt(k) => Distortion::KannalaBrandt(k),
    };
    is_sound.then_some(CameraModel {
        width: info.width,
        height: info.height,
        fx,
        fy,
        cx,
        cy,
        distortion,
    })
}

/// How a frame's samples lie; `None` for files, which are not searched.
pub fn sample_format(format: PixelFormat) -> Option<SampleFormat> {
    let (bits, pattern) = match format {
        PixelFormat::Jpeg => return None,
        PixelFormat::Mono8 => (8, None),
        PixelFormat::Mono10 => (10, None),
        PixelFormat::Mono12 => (12, None),
        PixelFormat::Mono16 => (16, None),
        PixelFormat::Bayer8(pattern) => (8, Some(pattern)),
        PixelFormat::Bayer10(pattern) => (10, Some(pattern)),
        PixelFormat::Bayer12(pattern) => (12, Some(pattern)),
        PixelFormat::Bayer16(pattern) => (16, Some(pattern)),
    };
    let mosaic = pattern.map(|pattern| match pattern {
        BayerPattern::Rggb => Mosaic::Rggb,
        BayerPattern::Grbg => Mosaic::Grbg,
        BayerPattern::Gbrg => Mosaic::Gbrg,
        BayerPattern::Bggr => Mosaic::Bggr,
    });
    Some(SampleFormat { bits, mosaic })
}

/// An observation as it is sent.
pub fn detection(observation: &Observation) -> Detection {
    let spread = &observation.centre_covariance_px2;
    Detection {
        family: observation.family.name().to_owned(),
        id: observation.id,
        centre_px: [observation.centre.x, observation.centre.y],
        centre_covariance_px2: [spread.m11 as f32, spread.m12 as f32, spread.m22 as f32],
        corners_px: observation.corners.map(|corners| corners.map(|c| [c.x, c.y])),
        size_px: observation.size_px,
        wrong_bits: observation.wrong_bits,
        confidence: observation.confidence,
        pose: observation.pose.as_ref().map(marker_pose),
    }
}

/// A pad as it is sent: a marker of the family `pad`, whose pose is that of the landing point.
pub fn pad_detection(pad: &Pad, seen: &PadObservation) -> Detection {
    let spread = &seen.centre_covariance_px2;
    Detection {
        family: Pad::FAMILY.to_owned(),
        id: Some(pad.id()),
        centre_px: [seen.centre.x, seen.centre.y],
        centre_covariance_px2: [spread.m11 as f32, spread.m12 as f32, spread.m22 as f32],
        corners_px: None,
        size_px: seen.size_px,
        wrong_bits: 0,
        confidence: seen.confidence,
        pose: Some(marker_pose(&seen.pose)),
    }
}

fn marker_pose(pose: &MarkerPose) -> messages::MarkerPose {
    messages::MarkerPose {
        camera_from_marker: transform(&pose.camera_from_marker),
        reprojection_rms_px: pose.reprojection_rms_px,
        covariance: upper_triangle(&pose.covariance),
        alternative: pose.alternative.as_ref().map(|other| AlternativePose {
            camera_from_marker: transform(&other.camera_from_marker),
            reprojection_rms_px: other.reprojection_rms_px,
        }),
    }
}

fn transform(camera_from_marker: &Transform<Camera, Marker>) -> Transform3 {
    let origin = camera_from_marker.origin();
    Transform3 {
        translation_m: [origin.x(), origin.y(), origin.z()],
        rotation_wxyz: camera_from_marker.rotation().wxyz(),
    }
}

/// The upper triangle of a symmetric matrix, row by row.
fn upper_triangle(matrix: &Matrix6<f64>) -> [f32; 21] {
    let mut cells = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    std::array::from_fn(|_| cells.next().and_then(|at| matrix.get(at)).map_or(0.0, |c| *c as f32))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_covariance_is_sent_as_its_upper_triangle_row_by_row() {
        let matrix =
            Matrix6::from_fn(|row, column| (10 * row.min(column) + row.max(column)) as f64);
        let sent = upper_triangle(&matrix);
        assert_eq!((sent[0], sent[5], sent[6], sent[11], sent[20]), (0.0, 5.0, 11.0, 22.0, 55.0));
    }
}
