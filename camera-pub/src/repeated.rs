//! Detects a source that repeats its last picture as a new frame: a frame grabber without a signal, a player at a constant
//! rate, a stream whose camera hangs. Such a frame is not of the time of its stamp.
//!
//! No two pictures of a sensor are alike to the last bit, as its noise differs; but those without any structure may be, in the dark or in
//! the sun, and a coded video of a scene that does not move. A source that has only ever given one picture shows a still one, as on a
//! bench.

use std::time::{Duration, Instant};

use xxhash_rust::xxh3::xxh3_64;

/// Time after which a picture that is repeated is a failure: a converter of rates repeats single ones.
const MIN_STUCK: Duration = Duration::from_secs(1);

/// The pictures of a source.
#[derive(Debug, Default)]
pub(crate) struct Pictures {
    /// The checksum of the newest one, and since when it is that.
    newest: Option<(u64, Instant)>,
    /// Whether there were different ones.
    has_changed: bool,
    is_stuck: bool,
}

/// The kind of a picture.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Picture {
    /// Another one than before, or a still one.
    New,
    /// The one before.
    Repeated,
    /// The one before, for so long that the camera seems to be stuck; once each time.
    Stuck,
}

impl Pictures {
    /// Adds the samples of a picture.
    pub(crate) fn add(&mut self, samples: &[u8], now: Instant) -> Picture {
        let checksum = xxh3_64(samples);
        let Some((_, since)) = self.newest.filter(|(newest, _)| *newest == checksum) else {
            self.has_changed |= self.newest.is_some();
            self.newest = Some((checksum, now));
            self.is_stuck = false;
            return Picture::New;
        };
        if !self.has_changed || is_plain(samples) {
            return Picture::New;
        }
        if self.is_stuck || now.saturating_duration_since(since) < MIN_STUCK {
            return Picture::Repeated;
        }
        self.is_stuck = true;
        Picture::Stuck
    }
}

/// Whether all samples are alike.
fn is_plain(samples: &[u8]) -> bool {
    samples.first().is_none_or(|first| samples.iter().all(|sample| sample == first))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_picture_that_comes_again_is_repeated_and_after_a_second_stuck() {
        let start = Instant::now();
        let mut pictures = Pictures::default();
        let mut add = |grey: u8, at_ms: u64| {
            let mut samples = [grey; 3072];
            samples[0] = 200;
            pictures.add(&samples, start + Duration::from_millis(at_ms))
        };
        // A still picture, which a camera gives as well before it runs.
        assert_eq!([0, 500, 5000].map(|ms| add(1, ms)), [Picture::New; 3]);
        assert_eq!((add(2, 5100), add(2, 5200)), (Picture::New, Picture::Repeated));
        assert_eq!((add(1, 5300), add(1, 6200)), (Picture::New, Picture::Repeated));
        assert_eq!((add(1, 6300), add(1, 9000)), (Picture::Stuck, Picture::Repeated));
        // It continues, and is stuck again.
        assert_eq!((add(3, 9100), add(3, 10_100)), (Picture::New, Picture::Stuck));
        // One sample of them differs.
        let mut samples = [3; 3072];
        (samples[0], samples[3071]) = (200, 4);
        assert_eq!(pictures.add(&samples, start), Picture::New);
        assert_eq!(pictures.add(&samples, start), Picture::Repeated);
        // In the dark.
        for _ in 0..3 {
            assert_eq!(pictures.add(&[0; 3072], start), Picture::New);
        }
    }
}
