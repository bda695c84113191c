//! Converts observations, pads and refused candidates of the crate `fiducial` to the messages of a detector.

use fiducial::trace::{Candidate, Trace};
use fiducial::{MarkerPose, Observation, PadObservation};
use imaging::Ellipse;
use markers::Pad;
use messages::{
    AlternativePose, Detection, EllipsePx, FrameHeader, Refusal, Refusals, RefusedShape,
};

/// Maximum number of refused candidates that are sent: about 3 kB for each frame, which a radio carries as well.
const MAX_REFUSALS: usize = 64;

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

/// The refused candidates of a frame, as they are sent: the largest, as a marker is larger than most objects that
/// resemble one.
pub fn refusals(detector: &str, header: &FrameHeader, trace: &Trace) -> Refusals {
    let mut refused: Vec<_> = trace.refusals.iter().collect();
    refused.sort_by(|a, b| extent_px(&b.candidate).total_cmp(&extent_px(&a.candidate)));
    let shown = refused
        .iter()
        .take(MAX_REFUSALS)
        .map(|it| Refusal { reason: it.reason.name().to_owned(), shape: shape(&it.candidate) });
    Refusals {
        detector: detector.to_owned(),
        header: header.clone(),
        total: u32::try_from(trace.refusals.len()).unwrap_or(u32::MAX),
        refusals: shown.collect(),
    }
}

/// The largest extent of a candidate, in pixels; 0 for one whose numbers are not finite.
fn extent_px(candidate: &Candidate) -> f64 {
    let extent_px = match candidate {
        Candidate::Ring(edges) => edges.iter().map(|it| it.major).fold(0.0, f64::max),
        Candidate::Quad([a, b, c, d]) => a.distance(c).max(b.distance(d)),
    };
    if extent_px.is_finite() { extent_px } else { 0.0 }
}

fn shape(candidate: &Candidate) -> RefusedShape {
    let ellipse = |it: &Ellipse| EllipsePx {
        centre_px: it.centre.map(|at| at as f32),
        axes_px: [it.minor as f32, it.major as f32],
        angle_rad: it.angle as f32,
    };
    match candidate {
        Candidate::Ring(edges) => RefusedShape::Ring(edges.each_ref().map(ellipse)),
        Candidate::Quad(corners) => {
            RefusedShape::Quad(corners.map(|it| [it.x as f32, it.y as f32]))
        }
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

#[cfg(test)]
mod tests {
    use super::*;
    use fiducial::trace::Reason;
    use geometry::Pixel;

    #[test]
    fn the_largest_refusals_are_sent_with_their_reasons() {
        let mut trace = Trace::default();
        let square = |size: f64| {
            [(0.0, 0.0), (size, 0.0), (size, size), (0.0, size)].map(|(x, y)| Pixel::new(x, y))
        };
        for size in 1..=100 {
            trace.refuse_quad(square(f64::from(size)), Reason::Border);
        }
        trace.refuse_quad(square(f64::NAN), Reason::Small);
        let edge = |major| Ellipse { centre: [5.0, 6.0], minor: 2.0, major, angle: 0.5 };
        let candidate = Candidate::Ring([edge(300.0), edge(400.0)]);
        trace.refusals.push(fiducial::Refusal { candidate, reason: Reason::Type });
        let message = refusals("main", &FrameHeader::sample(), &trace);
        assert_eq!((message.total, message.refusals.len()), (102, MAX_REFUSALS));
        assert_eq!((message.detector.as_str(), &message.header), ("main", &FrameHeader::sample()));
        let axes_px = [2.0, 300.0];
        let inner = EllipsePx { centre_px: [5.0, 6.0], axes_px, angle_rad: 0.5 };
        let outer = EllipsePx { axes_px: [2.0, 400.0], ..inner };
        let ring = Refusal { reason: "type".into(), shape: RefusedShape::Ring([inner, outer]) };
        assert_eq!(message.refusals[0], ring);
        let corners = [[0.0, 0.0], [100.0, 0.0], [100.0, 100.0], [0.0, 100.0]];
        let shape = RefusedShape::Quad(corners);
        assert_eq!(message.refusals[1], Refusal { reason: "border".into(), shape });
    }
}
