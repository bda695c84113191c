//! The thesis' guidance: a PI controller from the marker's pixels and the altitude to a velocity, with wind noise (section 3.2, Algorithms
//! 16 to 18).
//!
//! # Where the text leaves a choice, and which reading was taken
//!
//! The readings were flown on a model of the vehicle (dead time 0.25 s, then first order with 0.43 s;
//! attitude tilts the camera; 15 frames per second; 80 ms of latency) from 10 m with the pad at (1.5, -1.5)
//! m, and compared with the thesis' section 4.4: "rapidly converges", "some overshoot ... not severe", stable
//! after about 20 s, within limits of 0.5 m/s, a landing of 55 s, 0.068 m from the centre.
//!
//! | question | reading taken | why |
//! |---|---|---|
//! | unit of the altitude in `K_pz e_z` | centimetres, as in "80 cm" | -5e-4 * 1000 cm is the limit 0.5 m/s at 10 m exactly, and 20 s * ln(10 / 0.8) = 50.5 s until LAND; with metres the descent would take hours |
//! | sign of `K_pz` and the limits 1e-5 to 0.5 m/s | the limits are of the speed of descent: `u_z = -limit(-K_pz e_z)` (up positive) | to the letter every command would be the lower limit, a climb |
//! | `K_p` = 1e-6 | 1e-3 (`kp`) | see below |
//! | errors of x and y inside the tolerance | used as they are, as Algorithm 18 lists them: the tolerance only gates the descent | set to zero, as the text can be read, the vehicle drifts through the circle: it is over the pad after 31 s instead of 8 s, LAND comes after 55.5 s instead of 50.4 s, and the error is 0.11 m instead of 0.065 m |
//! | how fast the loop runs, and the sum's time step | once per frame; the sum counts frames, not seconds (Equation 3.14) | "upon receiving a message" |
//! | anti-windup | none: the sum grows while the output is limited | none is described; with these gains x and y seldom reach their limit |
//! | altitude over the marker | the target's height where the detector gives a pose, else the altitude over the autopilot's origin | the text says "relative to the marker", the algorithm `drone.altitude()`; on the thesis' field they are equal |
//! | coordinates | image right and image up are the vehicle's right and forward, turned into the world by its heading | the thesis flew with one heading, where image up was its ENU's y |
//! | end of the run | LAND at the first frame inside the tolerance below 80 cm | as listed |
//!
//! `K_p`: the printed 1e-6 m/s per pixel moves the vehicle by less than 0.7 mm/s at the edge of the image.
//! The remaining loop is an integrator that steers an integrator, without damping: it passes the pad after half a
//! minute, swings further in pixels with every metre of descent, and the marker leaves the view; of 12 such
//! flights none had landed after 200 s. With 1e-4 the LAND mode is reached after 78 s with an overshoot of
//! 0.4 m, with 1e-3 after 50.4 s (and 2 s more to the ground, 2 s more until disarmed) with an overshoot of
//! 0.1 m and a median error of 0.065 m, with 2e-3 the loop is unstable near the ground. Only 1e-3 fits all
//! that the thesis reports, so the exponent is taken for a misprint. `K_i` is as printed.
//! [`ThesisConfig::as_printed`] has the printed gain.
//!
//! Two additions do not show in a flight with the marker in view: the envelope of all guidances applies, so
//! the wind noise cannot push the vehicle down without a detection, and a marker that stays lost leads to a
//! hold.

use geometry::{Ned, Vector};
use libm::{fmax, fmin, hypot, sincos};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rand_distr::{Distribution, StandardNormal};

use crate::config::ThesisConfig;
use crate::decision::Reason;
use crate::event::FrameObservation;
use crate::guidance::situation::{Guidance, Progress, Situation};

/// Beyond this `rand_distr` draws from the tail of the normal distribution; by its tables at 3.654.
const NORMAL_TAIL: f64 = 3.65;

impl ThesisConfig {
    /// The constants with the proportional gain as printed, which does not land.
    pub fn as_printed() -> Self {
        Self { kp: 1e-6, ..Self::default() }
    }
}

/// The thesis' controller with its memory.
#[derive(Clone, Debug)]
pub struct Thesis {
    config: ThesisConfig,
    random: ChaCha8Rng,
    /// The wind noise of the last frame: right, forward, up, in m/s.
    wind_m_s: [f64; 3],
    /// The summed errors, in pixels: right, forward.
    sum_px: [f64; 2],
    progress: Progress,
    command: Vector<Ned>,
    why: Reason,
}

impl Guidance for Thesis {
    /// True when the newest detection is recent; near the ground a short gap is allowed.
    fn may_descend(&self, situation: &Situation<'_>) -> bool {
        let config = &self.config;
        let is_low = situation.height_m() <= config.low_height_m;
        let stale_s = config.stale_target_s + if is_low { config.low_grace_s } else { 0.0 };
        situation.level_because.is_none() && situation.age_s <= stale_s
    }

    /// Algorithm 18: one frame, with or without the marker, becomes the velocity command until the next
    /// frame.
    fn observe(&mut self, frame: &FrameObservation, heading_rad: f64, altitude_m: f64) {
        self.step_wind();
        let [wind_right, wind_forward, wind_up] = self.wind_m_s;
        let Some(marker) = frame.marker else {
            self.progress = Progress::Unchanged;
            self.why = Reason::TargetAging;
            self.command = self.ned(heading_rad, [wind_right, wind_forward, wind_up]);
            return;
        };
        let right_px = marker.centre.x - f64::from(frame.image_size.0) / 2.0;
        let up_px = f64::from(frame.image_size.1) / 2.0 - marker.centre.y;
        let aligned = hypot(right_px, up_px) < self.config.tolerance_px;
        self.progress = if !aligned {
            Progress::Aligning
        } else if altitude_m < self.config.land_altitude_m {
            Progress::Ready(Reason::LowAndAligned)
        } else {
            Progress::Descending
        };
        self.why = if aligned { Reason::Descending } else { Reason::Aligning };
        self.sum_px = [self.sum_px[0] + right_px, self.sum_px[1] + up_px];
        let velocity = [
            self.horizontal(right_px, self.sum_px[0]) + wind_right,
            self.horizontal(up_px, self.sum_px[1]) + wind_forward,
            self.vertical(if aligned { altitude_m } else { 0.0 }) + wind_up,
        ];
        self.command = self.ned(heading_rad, velocity);
    }

    /// Where the last frame showed the marker.
    fn progress(&mut self, _situation: &Situation<'_>) -> Progress {
        self.progress
    }

    /// The command of the last frame.
    fn velocity(&mut self, _situation: &Situation<'_>) -> (Vector<Ned>, Reason) {
        (self.command, self.why)
    }

    /// Stops; the sums stay, as the thesis' script has no pause.
    fn reset(&mut self) {
        self.command = Vector::zero();
        self.progress = Progress::Unchanged;
    }
}

impl Thesis {
    /// A controller whose sums and wind noise are zero.
    pub fn new(config: ThesisConfig) -> Self {
        Self {
            config,
            random: ChaCha8Rng::seed_from_u64(config.seed),
            wind_m_s: [0.0; 3],
            sum_px: [0.0; 2],
            progress: Progress::Unchanged,
            command: Vector::zero(),
            why: Reason::Searching,
        }
    }

    /// Algorithm 16, Equation 3.15: noise that stands for wind, one independent value per axis.
    fn step_wind(&mut self) {
        let ThesisConfig { wind_memory, wind_mean_m_s, wind_sigma_m_s, .. } = self.config;
        for wind in &mut self.wind_m_s {
            let noise_m_s = wind_mean_m_s + wind_sigma_m_s * normal(&mut self.random);
            *wind = wind_memory * *wind + (1.0 - wind_memory) * noise_m_s;
        }
    }

    /// Equation 3.14 with the limits of x and y.
    fn horizontal(&self, error_px: f64, sum_px: f64) -> f64 {
        let limit = self.config.max_horizontal_m_s;
        limited(self.config.kp * error_px + self.config.ki * sum_px, -limit, limit)
    }

    /// The vertical command, up positive, from the altitude in metres (zero when not aligned).
    fn vertical(&self, altitude_m: f64) -> f64 {
        let descent = -self.config.kpz * altitude_m * 100.0;
        -limited(descent, self.config.min_descend_m_s, self.config.max_descend_m_s)
    }

    /// From right, forward (as the image shows them) and up to the world.
    fn ned(&self, heading_rad: f64, velocity: [f64; 3]) -> Vector<Ned> {
        let [right, forward, up] = velocity;
        let (sin, cos) = sincos(heading_rad + self.config.image_up_rad);
        Vector::new(forward * cos - right * sin, forward * sin + right * cos, -up)
    }
}

/// A number of the standard normal distribution.
fn normal(random: &mut ChaCha8Rng) -> f64 {
    let number: f64 = StandardNormal.sample(random);
    // One in 4000 is beyond, where `rand_distr` takes the C library's logarithm; rounded it is the same on every machine.
    if number.abs() > NORMAL_TAIL { f64::from(number as f32) } else { number }
}

/// Algorithm 17: the value, within its limits.
fn limited(value: f64, lower: f64, upper: f64) -> f64 {
    fmax(fmin(value, upper), lower)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::event::MarkerInFrame;
    use crate::time::Timestamp;
    use geometry::Pixel;
    use std::f64::consts::FRAC_PI_2;

    fn frame(centre: Option<(f64, f64)>) -> FrameObservation {
        let marker = centre.map(|(x, y)| MarkerInFrame {
            centre: Pixel::new(x, y),
            body_from_marker: None,
            alternative: None,
            covariance_m2: None,
            size_px: None,
            confidence: 1.0,
        });
        FrameObservation {
            stamp: Timestamp::default(),
            image_size: (1296, 972),
            focal_px: None,
            body_from_camera: None,
            marker,
        }
    }

    fn calm() -> ThesisConfig {
        ThesisConfig { wind_sigma_m_s: 0.0, ..ThesisConfig::default() }
    }

    #[test]
    fn the_first_command_is_algorithm_18_by_hand() {
        let mut thesis = Thesis::new(calm());
        thesis.observe(&frame(Some((748.0, 436.0))), 0.0, 6.0);
        let (velocity, why) = (thesis.command, thesis.why);
        assert!((velocity.y() - (1e-3 + 7e-7) * 100.0).abs() < 1e-12, "image right is east");
        assert!((velocity.x() - (1e-3 + 7e-7) * 50.0).abs() < 1e-12, "image up is north");
        assert!((velocity.z() - 0.3).abs() < 1e-12);
        assert_eq!((why, thesis.progress), (Reason::Descending, Progress::Descending));
    }

    #[test]
    fn the_command_turns_with_the_vehicle() {
        let mut thesis = Thesis::new(calm());
        thesis.observe(&frame(Some((648.0, 386.0))), FRAC_PI_2, 5.0);
        let velocity = thesis.command;
        assert!(
            velocity.y() > 0.09 && velocity.x().abs() < 1e-12,
            "forward is east now: {velocity:?}"
        );
    }

    #[test]
    fn outside_the_tolerance_it_descends_at_the_lower_limit_only() {
        let mut thesis = Thesis::new(calm());
        thesis.observe(&frame(Some((648.0 + 301.0, 486.0))), 0.0, 10.0);
        assert_eq!(thesis.command.z(), 1e-5);
        assert_eq!(thesis.progress, Progress::Aligning);
        thesis.observe(&frame(Some((648.0 + 299.0, 486.0))), 0.0, 0.79);
        assert_eq!(thesis.progress, Progress::Ready(Reason::LowAndAligned));
    }

    #[test]
    fn commands_stay_within_their_limits() {
        let mut thesis = Thesis::new(calm());
        for _ in 0..10_000 {
            thesis.observe(&frame(Some((0.0, 971.0))), 0.0, 100.0);
        }
        let velocity = thesis.command;
        assert_eq!((velocity.x(), velocity.y()), (-0.5, -0.5));
        thesis.observe(&frame(Some((648.0, 486.0))), 0.0, 100.0);
        assert_eq!(thesis.command.z(), 0.5);
    }

    #[test]
    fn without_a_marker_only_the_wind_noise_is_left() {
        let mut thesis = Thesis::new(ThesisConfig::default());
        let mut speeds = Vec::new();
        for _ in 0..20_000 {
            thesis.observe(&frame(None), 0.0, 5.0);
            speeds.push(thesis.command.x());
        }
        let mean = speeds.iter().sum::<f64>() / 20_000.0;
        let deviation = (speeds.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / 20_000.0).sqrt();
        // A first-order filter leaves sigma * sqrt((1 - lambda) / (1 + lambda)).
        assert!(
            mean.abs() < 0.005 && (deviation - 0.1 * (0.1f64 / 1.9).sqrt()).abs() < 0.002,
            "{mean} {deviation}"
        );
    }

    #[test]
    fn the_same_seed_gives_the_same_wind() {
        let (mut a, mut b) =
            (Thesis::new(ThesisConfig::default()), Thesis::new(ThesisConfig::default()));
        let mut other = Thesis::new(ThesisConfig { seed: 1, ..ThesisConfig::default() });
        for thesis in [&mut a, &mut b, &mut other] {
            thesis.observe(&frame(None), 0.0, 5.0);
        }
        assert_eq!(a.command, b.command);
        assert_ne!(a.command, other.command);
    }
}
