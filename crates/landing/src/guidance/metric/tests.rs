//! The metric guidance on modelled vehicle states: the observed velocity bias, the end of waiting, a retry, sinking onto the pad,
//! gusts and wrong heights near the ground.

use super::*;
use crate::event::{Landed, Mode, VehicleState};
use geometry::Rotation;

#[test]
fn a_velocity_bias_is_observed_within_two_seconds() {
    let mut metric = Metric::new(MetricConfig::default());
    for i in 0..80u32 {
        let s = f64::from(i) / 40.0;
        // Its reported velocity is 0.5 m/s, its reported position constant.
        let vehicle = vehicle(s, Point::new(0.3, 0.0, -5.0), Vector::new(0.0, 0.5, 0.0));
        let _ = metric.velocity(&situation(&vehicle));
    }
    let bias = metric.observer.unwrap().bias;
    assert!((bias - Vector::new(0.0, -0.5, 0.0)).norm() < 0.1, "{bias:?}");
}

/// The largest bias observed of a vehicle that moves and reports to move east at 0.5 m/s, with states and
/// ticks at the given times, and with a reported position that is shifted north as a function of time.
fn largest_bias(times: impl Iterator<Item = (f64, f64)>, north: impl Fn(f64) -> f64) -> f64 {
    let mut metric = Metric::new(MetricConfig::default());
    let mut largest_m_s = 0.0f64;
    for (stamp_s, now_s) in times {
        let position = Point::new(north(stamp_s), 0.5 * stamp_s, -5.0);
        let vehicle = vehicle(stamp_s, position, Vector::new(0.0, 0.5, 0.0));
        let now = Timestamp::from_seconds(now_s);
        let _ = metric.velocity(&Situation { now, ..situation(&vehicle) });
        largest_m_s = largest_m_s.max(metric.observer.unwrap().bias.norm());
    }
    largest_m_s
}

#[test]
fn jumps_pauses_and_old_states_make_no_bias() {
    let steady = |i: u32| f64::from(i) * 0.025;
    let every = || (0..120u32).map(steady);
    let jumped = largest_bias(every().map(|s| (s, s)), |s| 0.25 * f64::from(u8::from(s > 1.0)));
    assert!(jumped < 1e-6, "{jumped}");
    for pause_s in [0.2, 0.3, 0.5] {
        let missed = |s: f64| s > 1.0 && s < 1.0 + pause_s;
        let paused = largest_bias(every().filter(|s| !missed(*s)).map(|s| (s, s)), |_| 0.0);
        assert!(paused < 1e-6, "a pause of {pause_s} s: {paused}");
        let held = |s: f64| (if missed(s) { 1.0 } else { s }, s);
        let silent = largest_bias(every().map(held), |_| 0.0);
        assert!(silent < 1e-6, "no state for {pause_s} s: {silent}");
    }
    let late = largest_bias(every().map(|s| (s, s + 0.3)), |_| 0.0);
    assert!(late < 1e-6, "late states: {late}");
}

#[test]
fn waiting_never_allows_a_fast_slide_and_ends() {
    for (speed_m_s, ready) in [(0.25, true), (0.35, false)] {
        let mut metric = Metric::new(MetricConfig::default());
        let mut ends = Vec::new();
        for i in 0..600u32 {
            let s = f64::from(i) / 40.0;
            // Over the target, and never still.
            let velocity =
                Vector::new(speed_m_s * if s % 2.0 < 1.0 { 1.0 } else { -1.0 }, 0.0, 0.0);
            let aside_m = speed_m_s * (0.5 - (s % 2.0 - 1.0).abs());
            let vehicle = vehicle(s, Point::new(aside_m, 0.0, -0.04), velocity);
            let situation = situation(&vehicle);
            let speed_scale = metric.lateral_speed_scale(&situation, &situation.target.unwrap());
            ends.push((s, speed_scale < 1.0, metric.progress(&situation)));
            let _ = metric.velocity(&situation);
        }
        let slow = ends.iter().any(|(s, slow, _)| *s > 3.5 && *slow);
        assert_eq!(slow, ready, "at {speed_m_s} m/s");
        let stuck = ends.iter().any(|(s, _, end)| *s > 10.1 && *end == Progress::Stuck);
        assert!(stuck || ready, "at {speed_m_s} m/s");
    }
}

fn vehicle(seconds: f64, position: Point<Ned>, velocity: Vector<Ned>) -> VehicleState {
    VehicleState {
        stamp: Timestamp::from_seconds(seconds),
        ned_from_body: Rotation::identity(),
        position,
        velocity,
        mode: Mode::Guided,
        armed: true,
        landed: Landed::InAir,
    }
}

/// One that sinks this far to the side of its target.
pub(crate) fn sinking(s: f64, aside_m: f64, height_m: f64, down_m_s: f64) -> VehicleState {
    vehicle(s, Point::new(aside_m, 0.0, -height_m), Vector::new(0.0, 0.0, down_m_s))
}

/// With a well-known target at the origin.
pub(crate) fn situation(vehicle: &VehicleState) -> Situation<'_> {
    let offset = Point::origin() - vehicle.position;
    let target = TargetEstimate {
        position: Point::origin(),
        velocity: Vector::zero(),
        lateral_error_m: offset.horizontal_norm(),
        height_m: offset.z(),
        age_s: 0.05,
        deviation_m: 0.01,
        detections: 100,
        heading_rad: None,
        time_offset_s: 0.0,
        nis: None,
        ambiguous: false,
    };
    Situation {
        now: vehicle.stamp,
        vehicle,
        target: Some(target),
        age_s: 0.05,
        half_view_rad: None,
        pad_moves: false,
        pad_heave_m_s: 0.0,
        limits: crate::event::AutopilotLimits::default(),
        level_because: None,
        link_delay_s: 0.0,
    }
}

/// A vehicle that stays next to its target at heights that change with time.
fn hovered(aside_m: f64, seconds: f64, height_m: impl Fn(f64) -> f64) -> Progress {
    let mut metric = Metric::new(MetricConfig::default());
    let mut progress = Progress::Unchanged;
    for i in 0..(seconds * 40.0) as u32 {
        let s = f64::from(i) / 40.0;
        let vehicle = vehicle(s, Point::new(aside_m, 0.0, -height_m(s)), Vector::zero());
        let situation = situation(&vehicle);
        progress = metric.progress(&situation);
        let _ = metric.velocity(&situation);
    }
    progress
}

#[test]
fn waiting_ends_also_for_a_vehicle_that_sways_about_the_waiting_height() {
    let sways = |s: f64| LOW_M + 0.1 * (2.0 * s).sin();
    assert!(!matches!(hovered(0.6, 5.0, sways), Progress::Stuck));
    assert!(matches!(hovered(0.6, 12.0, sways), Progress::Stuck));
    // A vehicle that has climbed away no longer waits.
    let climbs = |s: f64| LOW_M - 0.1 + 0.5 * f64::from(u8::from(s > 6.0));
    assert!(!matches!(hovered(0.6, 12.0, climbs), Progress::Stuck));
}

#[test]
fn a_retry_has_the_time_of_the_first_try_at_the_height_of_waiting_as_well() {
    let mut metric = Metric::new(MetricConfig::default());
    let mut stuck = Vec::new();
    for i in 0..1200u32 {
        // Always next to its target, and low.
        let s = f64::from(i) / 40.0;
        let vehicle = vehicle(s, Point::new(0.6, 0.0, -0.4), Vector::zero());
        let situation = situation(&vehicle);
        if matches!(metric.progress(&situation), Progress::Stuck) {
            stuck.push(s);
            metric.begin_retry();
        }
        let _ = metric.velocity(&situation);
    }
    assert_eq!(stuck.len(), 2, "{stuck:?}");
}

#[test]
fn a_vehicle_that_stands_is_pushed_down_and_not_steered_whatever_it_says_of_its_velocity() {
    let mut metric = Metric::new(MetricConfig::default());
    let (mut commanded_m_s, mut stands) = (0.0f64, None);
    for i in 0..80u32 {
        // It sinks until it stands, at 0.08 m, while its reported velocity errs by 0.15 m/s.
        let s = f64::from(i) / 40.0;
        let (height_m, sinking_m_s) = if s < 1.0 { (0.48 - 0.4 * s, 0.4) } else { (0.08, 0.0) };
        let drift = Vector::new(0.15, 0.0, sinking_m_s);
        let vehicle = vehicle(s, Point::new(0.03, 0.0, -height_m), drift);
        let situation = situation(&vehicle);
        if matches!(metric.progress(&situation), Progress::Ready(Reason::TouchedEarly)) {
            stands.get_or_insert(s - 1.0);
        }
        let (setpoint, _) = metric.velocity(&situation);
        if s > 1.0 + TOUCHING_S + 0.05 {
            // Beyond the velocity that it reports.
            commanded_m_s = commanded_m_s.max((setpoint - drift).horizontal_norm());
            assert!(setpoint.z() >= PUSHING_M_S, "{s}: {setpoint:?}");
        }
    }
    assert!(commanded_m_s < 0.03, "{commanded_m_s} m/s sideways");
    assert!(stands.is_some_and(|s| s < 0.5), "{stands:?} s");
}

/// The minimum speed down, in m/s, that is commanded from 0.2 m down to the ground and for a second there, of a vehicle that sinks at
/// 0.5 m/s while the estimate of its pad changes by the time in seconds; and whether it is known to stand at the end.
fn touched(noise_m_s: f64, change: impl Fn(f64, &mut TargetEstimate)) -> (f64, bool) {
    let mut metric = Metric::new(MetricConfig::default());
    let (mut down_m_s, mut stands) = (f64::INFINITY, false);
    for i in 0..80u32 {
        // On the ground from 1 s on.
        let s = f64::from(i) / 40.0;
        let (height_m, sinking_m_s) = match s {
            s if s < 1.0 => (0.5 - 0.5 * s, 0.5),
            // For a moment its speed errs.
            s => (0.0, if s > 1.35 && s < 1.4 { noise_m_s } else { 0.0 }),
        };
        let vehicle = sinking(s, 0.0, height_m, sinking_m_s);
        let mut situation = situation(&vehicle);
        situation.target.as_mut().into_iter().for_each(|target| change(s, target));
        situation.age_s = situation.target.unwrap().age_s;
        stands = matches!(metric.progress(&situation), Progress::Ready(Reason::TouchedEarly));
        let (setpoint, _) = metric.velocity(&situation);
        if height_m <= 0.2 {
            assert!(metric.may_descend(&situation), "{s}");
            down_m_s = down_m_s.min(setpoint.z());
        }
    }
    (down_m_s, stands)
}

#[test]
fn nothing_that_the_estimate_becomes_lifts_a_vehicle_that_touches_down() {
    let low = |s: f64| s > 0.7;
    let unsure = touched(0.06, |s, target| {
        (target.age_s, target.deviation_m) = (s, if low(s) { 0.3 } else { 0.03 });
    });
    let ambiguous = touched(0.06, |s, target| target.ambiguous = low(s));
    let old = touched(0.0, |s, target| target.age_s = if low(s) { 10.0 } else { s });
    let aside = touched(0.06, |s, target| {
        target.position = Point::new(if s > 1.1 { 0.3 } else { 0.0 }, 0.0, 0.0);
    });
    for (name, (down_m_s, stands)) in
        [("unsure", unsure), ("ambiguous", ambiguous), ("old", old), ("aside", aside)]
    {
        assert!(stands && down_m_s >= 2.0 * PUSHING_M_S - 1e-9, "{name}: {down_m_s} m/s, {stands}");
    }
}

#[test]
fn a_pad_that_seems_to_sink_is_not_followed_hard_onto_the_ground() {
    let touchdown = |config: &MetricConfig, pad_m_s: f64, pad_heave_m_s: f64| {
        let mut metric = Metric::new(*config);
        let mut down_m_s = 0.0;
        for i in 0..=40u32 {
            let s = f64::from(i) / 40.0;
            let vehicle = sinking(s, 0.0, 0.7 - 0.7 * s, 0.7);
            let mut situation = Situation { pad_heave_m_s, ..situation(&vehicle) };
            let pad_velocity = Vector::new(0.0, 0.0, pad_m_s);
            situation.target.as_mut().into_iter().for_each(|target| target.velocity = pad_velocity);
            down_m_s = metric.velocity(&situation).0.z();
        }
        down_m_s
    };
    let config = MetricConfig::default();
    let touchdown_m_s =
        |pad_m_s: f64, pad_heave_m_s: f64| touchdown(&config, pad_m_s, pad_heave_m_s);
    // As after three frames with wrong stamps.
    for pad_m_s in [0.31, 1.0] {
        let down_m_s = touchdown_m_s(pad_m_s, 0.0);
        assert!(down_m_s <= 0.7 + 1e-9, "{pad_m_s} m/s: {down_m_s} m/s");
    }
    assert!(touchdown_m_s(0.1, 0.0) > 0.59, "the autopilot's height drifts");
    assert!(touchdown_m_s(-0.3, 0.0) < 0.21, "or rises");
    assert!(touchdown_m_s(0.45, 0.4) > 0.74, "a pad that heaves is followed");
    // A slow descent continues also where the autopilot's height drifts down quickly.
    let slow = MetricConfig { touchdown_descend_m_s: 0.2, ..config };
    assert!(touchdown(&slow, 0.4, 0.0) > 0.59);
    // One that is too far to the side to touch down follows it by 0.5 m/s at most.
    let mut metric = Metric::new(config);
    for i in 0..=40u32 {
        let vehicle = sinking(f64::from(i) / 40.0, 1.0, 0.3, 0.0);
        let mut situation = situation(&vehicle);
        let pad_velocity = Vector::new(0.0, 0.0, 1.0);
        situation.target.as_mut().into_iter().for_each(|target| target.velocity = pad_velocity);
        let down_m_s = metric.velocity(&situation).0.z();
        assert!(down_m_s <= 0.5 + 1e-9, "{down_m_s} m/s");
    }
}

#[test]
fn a_height_that_is_wrong_ends_the_descent_of_a_vehicle_that_was_to_touch_down() {
    let mut metric = Metric::new(MetricConfig::default());
    for i in 0..80u32 {
        // The ground is lower than the estimate, and the pad was not seen for long.
        let s = f64::from(i) / 40.0;
        let height_m = 0.5 - 0.5 * s;
        let vehicle = sinking(s, 0.0, height_m, 0.5);
        let mut situation = situation(&vehicle);
        situation.age_s = if height_m < 0.2 { 10.0 } else { 0.05 };
        let (setpoint, _) = metric.velocity(&situation);
        let descends = metric.may_descend(&situation) && setpoint.z() > 0.0;
        if (height_m + NEAR_M).abs() > 0.01 {
            assert_eq!(descends, height_m > -NEAR_M, "{height_m} m: {setpoint:?}");
        }
    }
}

#[test]
fn a_gap_in_the_states_of_a_vehicle_that_touches_down_is_no_loss_of_its_marker() {
    let mut metric = Metric::new(MetricConfig::default());
    for i in 0..40u32 {
        let s = f64::from(i) / 40.0;
        let height_m = 0.5 - 0.5 * s;
        let vehicle = sinking(s, 0.0, height_m, 0.5);
        let mut situation = situation(&vehicle);
        let is_gap = i == 36;
        situation.level_because = is_gap.then_some(Reason::VehicleStale);
        let progress = metric.progress(&situation);
        assert!(!is_gap || matches!(progress, Progress::Blind), "{progress:?}");
        assert_eq!(metric.may_descend(&situation), !is_gap, "{s}");
        let _ = metric.velocity(&situation);
    }
}

#[test]
fn a_gentle_descent_ends_with_a_push_that_shows_whether_the_vehicle_stands() {
    let mut metric = Metric::new(MetricConfig::default());
    let mut stands = None;
    for i in 0..120u32 {
        // It stands from 0.75 s on, nearly out of its funnel, where a descent is slow.
        let s = f64::from(i) / 40.0;
        let (height_m, sinking_m_s) = if s < 0.75 { (0.1 - 0.08 * s, 0.08) } else { (0.04, 0.0) };
        let vehicle = sinking(s, 0.1, height_m, sinking_m_s);
        let situation = situation(&vehicle);
        if matches!(metric.progress(&situation), Progress::Ready(Reason::TouchedEarly)) {
            stands.get_or_insert(s - 0.75);
        }
        let _ = metric.velocity(&situation);
    }
    assert!(stands.is_some_and(|s| s > 0.3 && s < 0.6), "{stands:?} s");
}

#[test]
fn a_gust_that_lifts_a_vehicle_near_the_ground_leaves_it_steered_and_free_to_climb() {
    let mut metric = Metric::new(MetricConfig::default());
    for i in 0..80u32 {
        // It sinks to 0.2 m; then it is lifted, and blown out of its funnel.
        let s = f64::from(i) / 40.0;
        let (height_m, down_m_s, aside_m) = match s {
            s if s < 1.0 => (0.6 - 0.4 * s, 0.4, 0.0),
            s => (0.2 + 0.2 * (s - 1.0), -0.2, 0.4 * (s - 1.0)),
        };
        let blown = Vector::new(if s < 1.0 { 0.0 } else { 0.4 }, 0.0, down_m_s);
        let vehicle = vehicle(s, Point::new(aside_m, 0.0, -height_m), blown);
        let situation = situation(&vehicle);
        let progress = metric.progress(&situation);
        assert!(!matches!(progress, Progress::Ready(_)), "{s}: {progress:?}");
        let (setpoint, _) = metric.velocity(&situation);
        if s > 1.6 {
            assert!(setpoint.x() < -0.1 && setpoint.z() < 0.0, "{s}: {setpoint:?}");
        }
    }
}

#[test]
fn a_vehicle_that_leans_against_a_gust_waits_above_the_ground_and_touches_down_where_it_is_about_to()
 {
    let descent = |tilt_rad: f64, path_m_s: f64, height_m: f64| {
        let mut vehicle = sinking(0.0, 0.0, height_m, 0.3);
        vehicle.ned_from_body = Rotation::from_euler(0.0, -tilt_rad, 0.0);
        let situation = situation(&vehicle);
        let mut metric = Metric::new(MetricConfig::default());
        let mut observer = Observer::new(&situation);
        // Faster than the vehicle, which is stationary over the pad.
        observer.path = Path::new(Vector::new(path_m_s, 0.0, 0.0));
        metric.observer = Some(observer);
        metric.descent(&situation, &situation.target.unwrap())
    };
    for (tilt_rad, path_m_s, height_m, descends) in [
        (0.4, 0.0, 0.3, true),
        (0.4, 0.2, 0.3, true),
        (0.4, 0.8, 0.3, false),
        (0.4, 0.8, 0.05, true),
        // A level vehicle does not lean against a gust.
        (0.0, 0.8, 0.3, true),
    ] {
        let (descent_m_s, why) = descent(tilt_rad, path_m_s, height_m);
        let case = format!("{tilt_rad} rad, {path_m_s} m/s, {height_m} m");
        assert_eq!(descent_m_s > 0.1, descends, "{case}: {descent_m_s} m/s");
        assert_eq!(why == Reason::Settling, !descends, "{case}: {why:?}");
    }
}

#[test]
fn a_vehicle_whose_path_continues_is_known_to_stand_where_its_height_reads_too_much() {
    for (tilt_rad, after_s) in [(0.0, 0.3..1.0), (0.15, 0.3..1.0), (0.4, 2.9..3.6)] {
        let mut metric = Metric::new(MetricConfig::default());
        let mut stands = None;
        for i in 0..200u32 {
            // It touches at a reading of 0.2 m, 0.05 m aside, while its path goes at 0.8 m/s.
            let s = f64::from(i) / 40.0;
            let (height_m, down_m_s) = if s < 1.0 { (0.45 - 0.25 * s, 0.25) } else { (0.2, 0.0) };
            let mut vehicle = sinking(s, 0.05, height_m, down_m_s);
            vehicle.ned_from_body = Rotation::from_euler(0.0, -tilt_rad, 0.0);
            let situation = situation(&vehicle);
            if i == 40 {
                let observer = metric.observer.as_mut().unwrap();
                observer.path = Path::new(Vector::new(0.8, 0.0, 0.0));
            }
            if matches!(metric.progress(&situation), Progress::Ready(Reason::TouchedEarly)) {
                stands.get_or_insert(s - 1.0);
            }
            let _ = metric.velocity(&situation);
        }
        assert!(stands.is_some_and(|s| after_s.contains(&s)), "{tilt_rad} rad: {stands:?} s");
    }
}

#[test]
fn a_vehicle_that_a_gust_holds_low_over_the_pad_is_neither_pushed_down_nor_taken_for_standing() {
    for (tilt_rad, holds) in [(0.45, true), (0.1, false)] {
        let mut metric = Metric::new(MetricConfig::default());
        let (mut pushed, mut stands) = (0, false);
        for i in 0..88u32 {
            // It sinks to 0.25 m; there it stays, 0.17 m aside, at the edge of its funnel.
            let s = f64::from(i) / 40.0;
            let (height_m, down_m_s) = if s < 1.0 { (0.75 - 0.5 * s, 0.5) } else { (0.25, 0.0) };
            let aside_m = if s < 1.0 { 0.0 } else { 0.17 };
            let mut vehicle = sinking(s, aside_m, height_m, down_m_s);
            vehicle.ned_from_body = Rotation::from_euler(0.0, tilt_rad, 0.0);
            let situation = situation(&vehicle);
            stands |= matches!(metric.progress(&situation), Progress::Ready(Reason::TouchedEarly));
            let (setpoint, _) = metric.velocity(&situation);
            // The touch that was to come is over.
            pushed += u32::from(s > 1.5 && setpoint.z() > 0.1);
        }
        assert_eq!((pushed > 0, stands), (!holds, !holds), "{tilt_rad} rad: {pushed} times");
    }
}
