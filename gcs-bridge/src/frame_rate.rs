//! Measures the rate of a camera's frames by their numbers and stamps, so that frames that are not searched count as well.

use messages::FrameHeader;

/// Time over which the rate is measured, in nanoseconds.
const SPAN_NS: i64 = 2_000_000_000;
/// Shortest time for a first rate, in nanoseconds.
const MIN_SPAN_NS: i64 = 300_000_000;

/// The rate of a camera's frames.
#[derive(Debug, Default)]
pub(crate) struct FrameRate {
    camera: String,
    /// Number and stamp, in nanoseconds, of the first frame of the measured span.
    first: Option<(u64, i64)>,
    /// The rate in Hz.
    hz: Option<f64>,
}

impl FrameRate {
    /// Takes the header of a frame. Another camera, and one whose numbers or stamps begin again, are measured anew.
    pub(crate) fn frame(&mut self, header: &FrameHeader) {
        let newest = (header.sequence, header.stamp_ns);
        let first = self.first.filter(|_| self.camera == header.camera);
        let Some((number, stamp_ns)) = first.filter(|it| it.0 <= newest.0 && it.1 <= newest.1)
        else {
            self.camera.clone_from(&header.camera);
            (self.first, self.hz) = (Some(newest), None);
            return;
        };
        let span_ns = header.stamp_ns.saturating_sub(stamp_ns);
        let is_full = span_ns >= SPAN_NS;
        if is_full || (self.hz.is_none() && span_ns >= MIN_SPAN_NS) {
            let hz = (header.sequence - number) as f64 * 1e9 / span_ns as f64;
            self.hz = Some((hz * 10.0).round() / 10.0);
        }
        if is_full {
            self.first = Some(newest);
        }
    }

    /// The rate in Hz, rounded to 0.1 Hz; 0 while it is unknown.
    pub(crate) fn hz(&self) -> f32 {
        self.hz.unwrap_or(0.0) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: i64 = 1_000_000;

    fn frame(camera: &str, sequence: u64, ms: i64) -> FrameHeader {
        let camera = camera.to_owned();
        FrameHeader { camera, sequence, stamp_ns: ms * MS, ..FrameHeader::sample() }
    }

    #[test]
    fn frames_that_are_not_searched_count_for_the_rate() {
        let mut rate = FrameRate::default();
        // 20 Hz, of which every third frame is searched; then 10 Hz.
        for number in (0..120_u64).step_by(3) {
            rate.frame(&frame("down", number, 50 * number as i64));
            let expected = if number < 6 { 0.0 } else { 20.0 };
            assert_eq!(rate.hz(), expected, "frame {number}");
        }
        for number in 120..170_u64 {
            rate.frame(&frame("down", number, 6000 + 100 * (number as i64 - 120)));
        }
        assert_eq!(rate.hz(), 10.0);
        rate.frame(&frame("down", 0, 20_000));
        assert_eq!(rate.hz(), 0.0, "it has started again");
        rate.frame(&frame("down", 10, 20_500));
        assert_eq!(rate.hz(), 20.0);
        rate.frame(&frame("front", 11, 20_600));
        assert_eq!(rate.hz(), 0.0, "another camera");
        rate.frame(&frame("front", u64::MAX, i64::MAX / MS));
        assert!(rate.hz().is_finite());
    }
}
