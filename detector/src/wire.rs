//! Between the algorithm's types and the messages.

use fiducial::{MarkerPose, Observation, PadObservation};
use markers::Pad;
use messages::{AlternativePose, Detection};

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
        camera_from_marker: (&pose.camera_from_marker).into(),
        reprojection_rms_px: pose.reprojection_rms_px,
        covariance: messages::MarkerPose::upper_triangle(&pose.covariance),
        alternative: pose.alternative.as_ref().map(|other| AlternativePose {
            camera_from_marker: (&other.camera_from_marker).into(),
            reprojection_rms_px: other.reprojection_rms_px,
        }),
    }
}
