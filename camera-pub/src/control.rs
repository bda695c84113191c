//! What is published of a camera's exposure: who sets it, what is wanted, and why.

use messages::{CameraControl, ExposureSetter, ExposureSetting, topic};
use metering::Telling;
use node::{Node, Publisher, clock_name};

/// How a camera is exposed that does not follow the marker.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Configured {
    /// For this long.
    Fixed { exposure_ns: u32 },
    /// By its own metering.
    Metering,
}

impl From<Configured> for CameraControl {
    fn from(configured: Configured) -> Self {
        let (set_by, in_use) = match configured {
            // Of its gain no more is known than the number in a unit of its own.
            Configured::Fixed { exposure_ns } => {
                (ExposureSetter::Fixed, Some(ExposureSetting { exposure_ns, gain: None }))
            }
            Configured::Metering => (ExposureSetter::Camera, None),
        };
        Self { set_by, in_use, ..Self::default() }
    }
}

/// Publishes it.
pub(crate) struct ControlPublisher {
    publisher: Publisher<CameraControl>,
    camera: String,
    telling: Telling,
}

impl ControlPublisher {
    /// Of a camera of this name.
    ///
    /// # Errors
    /// When the session is closed.
    pub(crate) async fn new(node: &Node, camera: &str) -> anyhow::Result<Self> {
        Ok(Self {
            publisher: node.publisher(topic::CAMERA_CONTROL, &[camera]).await?,
            camera: camera.to_owned(),
            telling: Telling::default(),
        })
    }

    /// Publishes what is told after a frame with this stamp, when it is due. A frame that was not published has no number.
    pub(crate) async fn publish(
        &mut self,
        sequence: Option<u64>,
        stamp_ns: i64,
        control: CameraControl,
    ) {
        let (camera, clock) = (self.camera.clone(), clock_name().to_owned());
        let control = CameraControl { camera, sequence, stamp_ns, clock, ..control };
        if self.telling.is_due(&control) {
            self.publisher.publish(&control).await;
        }
    }
}
