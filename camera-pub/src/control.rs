//! Publishes a camera's exposure: the process that sets it, the requested setting, and the reason.

use messages::{CameraControl, ExposureSetter, ExposureSetting, topic};
use metering::ControlThrottle;
use node::{Node, Publisher, clock_name};

/// The exposure of a camera that does not follow the marker.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Configured {
    /// A fixed exposure time.
    Fixed { exposure_ns: u32 },
    /// By its own metering.
    Metering,
}

impl From<Configured> for CameraControl {
    fn from(configured: Configured) -> Self {
        let (set_by, in_use) = match configured {
            // Its gain is known only as a number in the driver's unit.
            Configured::Fixed { exposure_ns } => {
                (ExposureSetter::Fixed, Some(ExposureSetting { exposure_ns, gain: None }))
            }
            Configured::Metering => (ExposureSetter::Camera, None),
        };
        Self { set_by, in_use, ..Self::default() }
    }
}

/// Publishes a camera's exposure.
pub(crate) struct ControlPublisher {
    publisher: Publisher<CameraControl>,
    camera: String,
    throttle: ControlThrottle,
}

impl ControlPublisher {
    /// For a camera of this name.
    ///
    /// # Errors
    /// When the session is closed.
    pub(crate) async fn new(node: &Node, camera: &str) -> anyhow::Result<Self> {
        Ok(Self {
            publisher: node.publisher(topic::CAMERA_CONTROL, &[camera]).await?,
            camera: camera.to_owned(),
            throttle: ControlThrottle::default(),
        })
    }

    /// Publishes the exposure after a frame with this stamp, when it is due. A frame that was not published has no number.
    pub(crate) async fn publish(
        &mut self,
        sequence: Option<u64>,
        stamp_ns: i64,
        control: CameraControl,
    ) {
        let (camera, clock) = (self.camera.clone(), clock_name().to_owned());
        let control = CameraControl { camera, sequence, stamp_ns, clock, ..control };
        if self.throttle.is_due(&control) {
            self.publisher.publish(&control).await;
        }
    }
}
