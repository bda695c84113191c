//! Between the algorithm's types and the messages.

use fiducial::{MarkerPose, Observation};
use geometry::{CameraModel, Distortion};
use messages::{CameraInfo, Detection, LensModel, Transform3};

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

/// An observation as it is sent.
pub fn detection(observation: &Observation) -> Detection {
    Detection {
        family: observation.family.name().to_owned(),
        id: observation.id,
        centre_px: [observation.centre.x, observation.centre.y],
        corners_px: observation.corners.map(|corners| corners.map(|c| [c.x, c.y])),
        size_px: observation.size_px,
        confidence: observation.confidence,
        pose: observation.pose.as_ref().map(marker_pose),
    }
}

fn marker_pose(pose: &MarkerPose) -> messages::MarkerPose {
    let origin = pose.camera_from_marker.origin();
    messages::MarkerPose {
        camera_from_marker: Transform3 {
            translation_m: [origin.x(), origin.y(), origin.z()],
            rotation_wxyz: pose.camera_from_marker.rotation().wxyz(),
        },
        reprojection_rms_px: pose.reprojection_rms_px,
    }
}
