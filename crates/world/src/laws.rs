//! Defines small laws of motion that the vehicle and its autopilot share.

/// Share of a step that a first-order lag covers in `dt_s`.
pub(crate) fn lag(dt_s: f64, time_constant_s: f64) -> f64 {
    if time_constant_s > 0.0 { 1.0 - (-dt_s / time_constant_s).exp() } else { 1.0 }
}

/// The angle between -pi and pi that points the same way.
pub(crate) fn wrap(angle: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    angle - turn * (angle / turn).round()
}

/// Rate that removes `error`, as ArduPilot's `sqrt_controller`: proportional near zero, farther away the
/// square root that never needs more than `limit` of the next derivative.
pub(crate) fn square_root_law(error: f64, gain: f64, limit: f64) -> f64 {
    let linear = limit / (gain * gain);
    if error.abs() > linear {
        error.signum() * (2.0 * limit * (error.abs() - 0.5 * linear)).sqrt()
    } else {
        error * gain
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_square_root_law_is_smooth_where_its_parts_meet() {
        let linear = 5.0 / 4.0;
        let (below, above) = (linear - 1e-6, linear + 1e-6);
        let difference = square_root_law(above, 2.0, 5.0) - square_root_law(below, 2.0, 5.0);
        assert!((difference / 2e-6 - 2.0).abs() < 1e-3, "{difference}");
        assert_eq!(square_root_law(-3.0, 2.0, 5.0), -square_root_law(3.0, 2.0, 5.0));
    }

    #[test]
    fn an_angle_keeps_its_direction_when_wrapped() {
        for angle in [-7.0, -3.2, 0.5, 3.2, 100.0f64] {
            assert!(wrap(angle).abs() <= std::f64::consts::PI + 1e-9);
            assert!((wrap(angle).sin() - angle.sin()).abs() < 1e-9);
        }
    }
}
