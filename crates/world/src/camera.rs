//! Simulates faults of a camera's frames: they arrive late, not at all, twice, or with a wrong stamp.

use rand_chacha::ChaCha8Rng;

use crate::drift::{normal, random_stream, uniform};

/// The faults of a camera. Times count from the world's begin (`World::begin`).
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraFaults {
    /// Latency from the exposure to the arrival, in seconds, without rendering and detection.
    pub latency_s: f64,
    /// Maximum random addition to the latency, in seconds.
    pub jitter_s: f64,
    /// Part of the frames that never arrive.
    pub drop: f64,
    /// Part of the frames that arrive twice.
    pub duplicate: f64,
    /// By how much all stamps are early, in seconds.
    pub stamp_early_s: f64,
    /// Part of the stamps that jump.
    pub stamp_jumps: f64,
    /// Maximum size of these jumps, in either direction, in seconds.
    pub stamp_jump_s: f64,
    /// When stamps jump: start and duration, in seconds; `None` at any time.
    pub stamp_jumps_in_s: Option<(f64, f64)>,
    /// Outage of the camera: start and duration, in seconds.
    pub outage_s: Option<(f64, f64)>,
    /// Outage that starts below a height over the pad, in metres, with its duration in seconds.
    pub outage_below_m: Option<(f64, f64)>,
    /// Deviation of the error of the mount's roll and pitch, in radians.
    pub mount_error_rad: f64,
}

/// How a frame travels.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Passage {
    /// Error of its stamp, in seconds.
    pub stamp_error_s: f64,
    /// From the exposure to its arrival, in seconds.
    pub arrives_after_s: f64,
    /// As before, for a second arrival.
    pub again_after_s: Option<f64>,
}

/// One camera's frames.
#[derive(Clone, Debug)]
pub struct Shutter {
    faults: CameraFaults,
    random: ChaCha8Rng,
    mount_error: [f64; 2],
    dark_since_s: Option<f64>,
}

/// A copy follows its frame after this time, in seconds.
const COPY_AFTER_S: f64 = 0.01;

impl Shutter {
    /// The frames of this seed.
    pub fn new(faults: CameraFaults, seed: u64) -> Self {
        let mut random = random_stream(seed, 5);
        let mount_error = [(); 2].map(|()| faults.mount_error_rad * normal(&mut random));
        Self { faults, random, mount_error, dark_since_s: None }
    }

    /// Error of the configured mount in roll and pitch, in radians.
    pub fn mount_error_rad(&self) -> [f64; 2] {
        self.mount_error
    }

    /// Takes a frame at a time after the world's begin and at a height over the pad; `None` when it is lost.
    pub fn take(&mut self, begun_s: Option<f64>, height_m: f64) -> Option<Passage> {
        let [lost, jitter, twice, jumps, jump] = [(); 5].map(|()| uniform(&mut self.random));
        let faults = &self.faults;
        if lost < faults.drop || begun_s.is_some_and(|s| self.is_dark(s, height_m)) {
            return None;
        }
        let faults = &self.faults;
        let may_jump = faults.stamp_jumps_in_s.is_none_or(|(from_s, for_s)| {
            begun_s.is_some_and(|s| (from_s..from_s + for_s).contains(&s))
        });
        let is_jump = may_jump && jumps < faults.stamp_jumps;
        let jump_s = if is_jump { faults.stamp_jump_s * (2.0 * jump - 1.0) } else { 0.0 };
        let arrives_after_s = faults.latency_s + faults.jitter_s * jitter;
        Some(Passage {
            stamp_error_s: jump_s - faults.stamp_early_s,
            arrives_after_s,
            again_after_s: (twice < faults.duplicate).then_some(arrives_after_s + COPY_AFTER_S),
        })
    }

    fn is_dark(&mut self, begun_s: f64, height_m: f64) -> bool {
        if let Some((below_m, for_s)) = self.faults.outage_below_m {
            if height_m < below_m {
                self.dark_since_s.get_or_insert(begun_s);
            }
            if self.dark_since_s.is_some_and(|since_s| begun_s - since_s < for_s) {
                return true;
            }
        }
        let outage = self.faults.outage_s;
        outage.is_some_and(|(from_s, for_s)| (from_s..from_s + for_s).contains(&begun_s))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn passages(faults: CameraFaults) -> Vec<Option<Passage>> {
        let mut shutter = Shutter::new(faults, 1);
        (0..2000).map(|i| shutter.take(Some(f64::from(i) * 0.01), 10.0)).collect()
    }

    #[test]
    fn without_faults_every_frame_arrives_at_once() {
        let at_once = Passage { stamp_error_s: 0.0, arrives_after_s: 0.0, again_after_s: None };
        assert!(passages(CameraFaults::default()).into_iter().all(|p| p == Some(at_once)));
    }

    #[test]
    fn frames_are_lost_doubled_and_late_as_configured() {
        let faults = CameraFaults {
            latency_s: 0.1,
            jitter_s: 0.05,
            drop: 0.5,
            duplicate: 0.2,
            outage_s: Some((5.0, 2.0)),
            ..CameraFaults::default()
        };
        let all = passages(faults);
        assert!(all.iter().skip(500).take(200).all(Option::is_none));
        let arrived: Vec<Passage> = all.into_iter().flatten().collect();
        assert!((850..950).contains(&arrived.len()), "{}", arrived.len());
        let twice = arrived.iter().filter(|p| p.again_after_s.is_some()).count();
        assert!((140..220).contains(&twice), "{twice}");
        assert!(arrived.iter().all(|p| (0.1..0.15).contains(&p.arrives_after_s)));
    }

    #[test]
    fn below_a_height_it_goes_dark_for_a_while_even_if_the_vehicle_climbs() {
        let faults = CameraFaults { outage_below_m: Some((2.0, 3.0)), ..CameraFaults::default() };
        let mut shutter = Shutter::new(faults, 1);
        assert!(shutter.take(Some(0.0), 2.1).is_some());
        assert!(shutter.take(Some(1.0), 1.9).is_none());
        assert!(shutter.take(Some(3.9), 5.0).is_none());
        assert!(shutter.take(Some(4.1), 1.0).is_some());
    }
}
