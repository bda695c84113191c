//! What a detector found in its newest frame, in short.

use messages::{Detections, FrameHeader};

/// What a detector found in its newest frame.
#[derive(Clone, Debug)]
pub struct Found {
    /// The frame.
    pub header: FrameHeader,
    /// How many markers.
    pub markers: usize,
    /// How many of them have a pose.
    pub poses: usize,
    /// The best of them, in words.
    pub best: Option<String>,
}

impl Found {
    /// The short of a message.
    pub fn new(told: Detections) -> Self {
        let best = told.detections.first().map(|best| {
            let id = best.id.map_or_else(String::new, |id| format!(":{id}"));
            let distance = best.pose.map(|pose| {
                let [x, y, z] = pose.camera_from_marker.translation_m;
                format!("{:.2} m away", (x * x + y * y + z * z).sqrt())
            });
            let distance = distance.unwrap_or_else(|| "no pose".to_owned());
            format!("{}{id}, {:.0} px, {distance}", best.family, best.size_px)
        });
        Self {
            markers: told.detections.len(),
            poses: told.detections.iter().filter(|it| it.pose.is_some()).count(),
            header: told.header,
            best,
        }
    }
}
