//! Implements ArduPilot's smoothing of setpoints: velocities become accelerations within limits of acceleration and
//! jerk.

use crate::laws::square_root_law;

/// Limits of the smoothed motion of one axis, or of the two horizontal ones together.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct Limits {
    /// In m/s^2.
    pub(super) acceleration: f64,
    /// In m/s^3.
    pub(super) jerk: f64,
}

/// The smoothed motion of `N` axes that the vehicle is to follow.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) struct Path<const N: usize> {
    /// In metres.
    pub(super) position: [f64; N],
    /// In m/s.
    pub(super) velocity: [f64; N],
    /// In m/s^2.
    pub(super) acceleration: [f64; N],
}

impl<const N: usize> Path<N> {
    /// A path that begins with this motion.
    pub(super) fn start(position: [f64; N], velocity: [f64; N], acceleration: [f64; N]) -> Self {
        Self { position, velocity, acceleration }
    }

    /// Moves on by `dt_s`, bending the path towards a velocity.
    pub(super) fn towards_velocity(&mut self, dt_s: f64, wanted: [f64; N], limits: Limits) {
        let error = combine(wanted, self.velocity, |w, v| w - v);
        let size = norm(error);
        let gain = limits.jerk / limits.acceleration;
        let rate =
            square_root_law(size, gain, limits.jerk).min(limits.acceleration).min(size / dt_s);
        let acceleration = scale(error, if size > 0.0 { rate / size } else { 0.0 });
        self.advance(dt_s, acceleration, limits);
    }

    /// Moves on by `dt_s`, bending the path towards a place, no faster than `speed`.
    pub(super) fn towards_position(
        &mut self,
        dt_s: f64,
        wanted: [f64; N],
        speed: f64,
        limits: Limits,
    ) {
        let error = combine(wanted, self.position, |w, p| w - p);
        let size = norm(error);
        // ArduPilot keeps half of the acceleration for the correction of the velocity.
        let gain = 0.5 * limits.jerk / limits.acceleration;
        let rate = square_root_law(size, gain, 0.5 * limits.acceleration).min(speed);
        self.towards_velocity(
            dt_s,
            scale(error, if size > 0.0 { rate / size } else { 0.0 }),
            limits,
        );
    }

    fn advance(&mut self, dt_s: f64, wanted_acceleration: [f64; N], limits: Limits) {
        for i in 0..N {
            self.position[i] += (self.velocity[i] + 0.5 * self.acceleration[i] * dt_s) * dt_s;
            self.velocity[i] += self.acceleration[i] * dt_s;
        }
        let change = combine(wanted_acceleration, self.acceleration, |w, a| w - a);
        let allowed = limits.jerk * dt_s;
        let size = norm(change);
        let share = if size > allowed { allowed / size } else { 1.0 };
        self.acceleration = combine(self.acceleration, change, |a, c| a + share * c);
    }
}

pub(super) fn norm<const N: usize>(v: [f64; N]) -> f64 {
    v.iter().map(|c| c * c).sum::<f64>().sqrt()
}

fn scale<const N: usize>(v: [f64; N], factor: f64) -> [f64; N] {
    v.map(|c| c * factor)
}

fn combine<const N: usize>(a: [f64; N], b: [f64; N], f: impl Fn(f64, f64) -> f64) -> [f64; N] {
    std::array::from_fn(|i| f(a[i], b[i]))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LIMITS: Limits = Limits { acceleration: 2.5, jerk: 5.0 };
    const DT_S: f64 = 0.0025;

    #[test]
    fn a_velocity_step_respects_acceleration_and_jerk() {
        let mut path = Path::start([0.0; 2], [0.0; 2], [0.0; 2]);
        let mut previous = path.acceleration;
        for _ in 0..2000 {
            path.towards_velocity(DT_S, [3.0, -4.0], LIMITS);
            assert!(norm(path.acceleration) <= 2.5 + 1e-9);
            assert!(norm(combine(path.acceleration, previous, |a, b| a - b)) <= 5.0 * DT_S + 1e-9);
            previous = path.acceleration;
        }
        assert!((path.velocity[0] - 3.0).abs() < 0.01 && (path.velocity[1] + 4.0).abs() < 0.01);
    }

    #[test]
    fn a_place_is_reached_without_passing_it() {
        let mut path = Path::start([0.0], [0.0], [0.0]);
        let mut farthest = 0.0f64;
        for _ in 0..8000 {
            path.towards_position(DT_S, [10.0], 2.5, Limits { acceleration: 1.0, jerk: 5.0 });
            farthest = farthest.max(path.position[0]);
            assert!(path.velocity[0] < 2.6);
        }
        assert!((path.position[0] - 10.0).abs() < 0.01 && farthest < 10.1, "{farthest}");
    }
}
