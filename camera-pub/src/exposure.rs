//! Computes when a frame was exposed from the one instant that a camera's driver stamps.
//!
//! A row is exposed for the exposure time and then read; a rolling shutter reads one row after the other. A frame's
//! stamp is the middle of its exposure: that of its middle row.

/// The instant that a driver's stamp is of.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum StampedAt {
    /// The first row begins to be exposed.
    ExposureStart,
    /// The first row has been exposed and begins to be read.
    ReadoutStart,
    /// The last row has been read.
    FrameEnd,
}

/// How a camera's stamps relate to the exposure of its frames.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Shutter {
    pub(crate) stamped_at: StampedAt,
    /// Time from the exposure of the first row to that of the last one; 0 for a global shutter.
    pub(crate) readout_ns: i64,
}

/// When a frame was exposed.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Exposure {
    /// Its middle, in nanoseconds of the host's clock.
    pub(crate) mid_ns: i64,
    /// How long; 0 when it is not known, and the middle is an estimate.
    pub(crate) exposure_ns: u32,
}

impl Exposure {
    /// An exposure whose middle is estimated only.
    pub(crate) fn estimated(mid_ns: i64) -> Self {
        Self { mid_ns, exposure_ns: 0 }
    }

    /// True when the camera reported it.
    pub(crate) fn is_exact(self) -> bool {
        self.exposure_ns > 0
    }
}

impl Shutter {
    /// The middle of the exposure of a frame that was stamped at `stamp_ns`.
    pub(crate) fn mid_exposure_ns(self, stamp_ns: i64, exposure_ns: u32) -> i64 {
        let half_exposure_ns = i64::from(exposure_ns) / 2;
        let half_readout_ns = self.readout_ns / 2;
        match self.stamped_at {
            StampedAt::ExposureStart => stamp_ns + half_exposure_ns + half_readout_ns,
            StampedAt::ReadoutStart => stamp_ns - half_exposure_ns + half_readout_ns,
            StampedAt::FrameEnd => stamp_ns - half_exposure_ns - half_readout_ns,
        }
    }

    /// Time from a frame's stamp until its last row has been read: no frame arrives sooner.
    pub(crate) fn until_read_ns(self, exposure_ns: u32) -> i64 {
        match self.stamped_at {
            StampedAt::ExposureStart => i64::from(exposure_ns) + self.readout_ns,
            StampedAt::ReadoutStart => self.readout_ns,
            StampedAt::FrameEnd => 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_same_frame_has_the_same_middle_whichever_instant_is_stamped() {
        // Rows are exposed from 1000 us on for 400 us each, the last one 300 us after the first.
        const US: i64 = 1000;
        for (readout_us, middle_us) in [(0, 1200), (300, 1350)] {
            let instants = [
                (StampedAt::ExposureStart, 1000),
                (StampedAt::ReadoutStart, 1400),
                (StampedAt::FrameEnd, 1400 + readout_us),
            ];
            for (stamped_at, stamp_us) in instants {
                let shutter = Shutter { stamped_at, readout_ns: readout_us * US };
                let middle_ns = shutter.mid_exposure_ns(stamp_us * US, 400_000);
                assert_eq!(middle_ns, middle_us * US, "{stamped_at:?}, {readout_us} us");
                let read_ns = stamp_us * US + shutter.until_read_ns(400_000);
                assert_eq!(read_ns, (1400 + readout_us) * US, "{stamped_at:?}, {readout_us} us");
            }
        }
    }
}
