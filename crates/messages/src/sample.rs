//! Plausible messages for tests, to be changed where a test cares: `FrameHeader { width: 8,
//! ..FrameHeader::sample() }`.

use std::f64::consts::FRAC_1_SQRT_2;

use crate::camera::{CameraInfo, FrameAck, FrameHeader, LensModel, PixelFormat, Transform3};
use crate::controller::{Candidate, DetectorState, TargetEstimate};
use crate::detector::{Detection, Detections, MarkerPose, Refusal, Refusals, RefusedShape};
use crate::gcs::{GroundStation, PacketSignature};
use crate::health::Health;
use crate::simulation::Truth;

impl FrameHeader {
    /// A grey frame of the camera `down`, 1296 x 972, stamped 0.
    pub fn sample() -> Self {
        Self {
            camera: "down".into(),
            sequence: 0,
            stamp_ns: 0,
            clock: "clock".into(),
            exposure_ns: 0,
            width: 1296,
            height: 972,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        }
    }
}

impl FrameAck {
    /// The acknowledgement of frame 1 of the camera `down`.
    pub fn sample() -> Self {
        Self { camera: "down".into(), sequence: 1, stamp_ns: 1, clock: "clock".into(), bytes: 1 }
    }
}

impl CameraInfo {
    /// The camera `down`, 1296 x 972; image right is the vehicle's right, image up its forward.
    pub fn sample() -> Self {
        Self {
            camera: "down".into(),
            width: 1296,
            height: 972,
            focal_px: Some([1818.0; 2]),
            principal_px: [647.5, 485.5],
            lens: LensModel::Pinhole,
            body_from_camera: Transform3 {
                translation_m: [0.0; 3],
                rotation_wxyz: [FRAC_1_SQRT_2, 0.0, 0.0, FRAC_1_SQRT_2],
            },
        }
    }
}

impl MarkerPose {
    /// 5 m in front of the camera, 0.2 m to its right and 0.1 m below, facing it; known to 0.01 m.
    pub fn sample() -> Self {
        let mut covariance = [0.0; 21];
        for diagonal in [0, 6, 11] {
            covariance[diagonal] = 1e-4;
        }
        Self {
            camera_from_marker: Transform3 {
                translation_m: [0.2, 0.1, 5.0],
                rotation_wxyz: [0.0, 1.0, 0.0, 0.0],
            },
            reprojection_rms_px: 0.1,
            covariance,
            alternative: None,
        }
    }
}

impl Detection {
    /// The marker `rings` where the camera `down` sees [`MarkerPose::sample`].
    pub fn sample() -> Self {
        Self {
            family: "rings".into(),
            id: None,
            centre_px: [720.0, 522.0],
            centre_covariance_px2: [0.04, 0.0, 0.04],
            corners_px: None,
            size_px: 55.0,
            wrong_bits: 0,
            confidence: 1.0,
            pose: Some(MarkerPose::sample()),
        }
    }
}

impl Detections {
    /// One marker that the detector `main` found in [`FrameHeader::sample`].
    pub fn sample() -> Self {
        Self {
            detector: "main".into(),
            header: FrameHeader::sample(),
            detections: vec![Detection::sample()],
            stages: Vec::new(),
        }
    }
}

impl Refusals {
    /// One square that the detector `main` refused in [`FrameHeader::sample`].
    pub fn sample() -> Self {
        let shape =
            RefusedShape::Quad([[100.0, 100.0], [140.0, 100.0], [140.0, 140.0], [100.0, 140.0]]);
        Self {
            detector: "main".into(),
            header: FrameHeader::sample(),
            total: 1,
            refusals: vec![Refusal { reason: "code".into(), shape }],
        }
    }
}

impl Candidate {
    /// The healthy detector `main` on standby.
    pub fn sample() -> Self {
        Self {
            detector: "main".into(),
            state: DetectorState::Shadow,
            place: None,
            age_ms: 50.0,
            latency_ms: 40.0,
            rate_hz: 15.0,
            alive: true,
            disagreement_m: None,
            compared: 0,
            agreed: 0,
        }
    }
}

impl TargetEstimate {
    /// A landing point 1.93 m away, 10 m below the vehicle.
    pub fn sample() -> Self {
        Self {
            stamp_ns: 0,
            position_ned_m: Some([1.5, -1.5, 0.0]),
            lateral_error_m: Some(1.93),
            height_m: Some(10.0),
            age_ms: Some(60.0),
            rejected: None,
            decided: None,
            velocity_ned_m_s: None,
            deviation_m: Some(0.02),
            heading_rad: Some(0.0),
            nis: Some(3.0),
            time_offset_ms: Some(0.0),
            wind_ned_m_s: None,
        }
    }
}

impl Health {
    /// A service that has neither name nor clock, and nothing to count.
    pub fn sample() -> Self {
        Self {
            service: String::new(),
            instance: "main".into(),
            host: String::new(),
            version: String::new(),
            clock: String::new(),
            stamp_ns: 0,
            pid: 0,
            cpu_s: 0.0,
            uptime_s: 0.0,
            rates: Vec::new(),
            latencies: Vec::new(),
            drops: Vec::new(),
            errors: Vec::new(),
        }
    }
}

impl Truth {
    /// A level stationary vehicle on the pad, on the ground, before any frame.
    pub fn sample() -> Self {
        Self {
            stamp_ns: 0,
            ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
            position_ned_m: [0.0; 3],
            velocity_ned_m_s: [0.0; 3],
            pad_ned_m: [0.0; 3],
            on_ground: true,
            touchdown: None,
            max_tilt_rad: 0.0,
            frames: 0,
        }
    }
}

impl GroundStation {
    /// QGroundControl at 10.0.0.2, of which one packet came, not signed.
    pub fn sample() -> Self {
        Self {
            system: 255,
            component: 190,
            peer: "10.0.0.2:14550".into(),
            last_ns: 0,
            silent: false,
            packets: 1,
            refused: 0,
            signature: PacketSignature::Unsigned,
        }
    }
}
