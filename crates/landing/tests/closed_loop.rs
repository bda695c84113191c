//! Landings of the lander in the modelled world, one or a few seeds each, with metric and thesis guidance: error, time,
//! wind, latency, lost targets, disputes, pilot, operator, LAND refused.

mod scene;

use geometry::{Point, Rotation, Vector};
use landing::{
    Action, Config, Event, GuidanceConfig, Landed, Lander, MetricConfig, Mode, OnAbort,
    OperatorCommand, Phase, PhaseConfig, Reason, ThesisConfig, Timestamp, VehicleState,
};
use scene::{Flight, Sample, Scene};

/// The median and the maximum of a number over the flights.
fn spread(flights: &[Flight], of: fn(&Flight) -> f64) -> (f64, f64) {
    let mut values: Vec<f64> = flights.iter().map(of).collect();
    values.sort_by(f64::total_cmp);
    let at = |i: usize| values.get(i).copied().unwrap_or(f64::NAN);
    (at(values.len() / 2), at(values.len().saturating_sub(1)))
}

fn summary(flights: &[Flight]) -> String {
    let (land, _) = spread(flights, |f| f.land_s.unwrap_or(f64::INFINITY));
    let (disarm, slowest) = spread(flights, |f| f.disarm_s.unwrap_or(f64::INFINITY));
    let (error, worst) = spread(flights, |f| f.error_m);
    let (overshoot, max_overshoot) = spread(flights, |f| f.overshoot_m);
    let (_, tilt) = spread(flights, |f| f.max_tilt_rad.to_degrees());
    format!(
        "LAND {land:.1} s, disarmed {disarm:.1} (slowest {slowest:.1}) s, error {error:.3} (worst {worst:.3}) m, \
         overshoot {overshoot:.2} ({max_overshoot:.2}) m, tilt {tilt:.1} deg"
    )
}

fn fly(seeds: std::ops::Range<u64>, scene: impl Fn(u64) -> Scene) -> Vec<Flight> {
    seeds.map(|seed| scene(seed).fly()).collect()
}

fn thesis(seed: u64, constants: ThesisConfig) -> Scene {
    let guidance = GuidanceConfig::Thesis(ThesisConfig { seed, ..constants });
    Scene { config: Config { guidance, ..Config::default() }, ..Scene::new(seed) }
}

/// A flight in which no frame arrives between two times.
fn outage(from_s: f64, to_s: f64, seed: u64) -> Scene {
    Scene::new(seed).with(|scene| scene.camera.outage_s = Some((from_s, to_s - from_s)))
}

/// The largest descent speed that was commanded between two times.
fn deepest(flight: &Flight, from_s: f64, to_s: f64) -> f64 {
    let within = flight.samples.iter().filter(|s| (from_s..to_s).contains(&s.seconds));
    within.fold(0.0, |deepest, sample| match sample.decision.action {
        Action::Velocity { velocity, .. } => velocity.z().max(deepest),
        Action::None | Action::Land | Action::Guided | Action::Disarm => deepest,
    })
}

#[test]
fn the_metric_guidance_lands_on_the_pad_from_the_thesis_start() {
    let flights = fly(0..20, Scene::new);
    println!("metric: {}", summary(&flights));
    assert!(flights.iter().all(|f| f.phase == Phase::Landed));
    let (error, worst) = spread(&flights, |f| f.error_m);
    let (disarm, slowest) = spread(&flights, |f| f.disarm_s.unwrap_or(f64::INFINITY));
    assert!(error <= 0.05 && worst <= 0.15, "{error} {worst}");
    assert!(disarm <= 14.0 && slowest <= 18.0, "{disarm} {slowest}");
}

#[test]
fn without_disturbance_it_does_not_overshoot() {
    let flights = fly(0..5, |seed| Scene::new(seed).perfect());
    println!("metric, calm: {}", summary(&flights));
    let (_, overshoot) = spread(&flights, |f| f.overshoot_m);
    let (_, worst) = spread(&flights, |f| f.error_m);
    assert!(overshoot < 0.02 && worst < 0.02, "{overshoot} {worst}");
}

#[test]
fn any_heading_height_and_offset_will_do() {
    let flights = fly(0..40, |seed| {
        let angle = seed as f64 * 2.4;
        let height_m = 4.0 + (seed % 7) as f64 * 1.5;
        let offset_m = (seed % 9) as f64 / 8.0 * 0.24 * height_m;
        let start =
            Point::new(1.5 + offset_m * angle.cos(), -1.5 + offset_m * angle.sin(), -height_m);
        Scene::new(seed)
            .from(start)
            .with(|scene| scene.world.vehicle.start_heading_rad = 1.7 * angle)
    });
    println!("metric, 4 to 13 m: {}", summary(&flights));
    assert!(flights.iter().all(|f| f.phase == Phase::Landed));
    let (error, worst) = spread(&flights, |f| f.error_m);
    assert!(error <= 0.05 && worst <= 0.15, "{error} {worst}");
}

#[test]
fn gusts_latency_and_missed_frames_are_survived() {
    let flights = fly(0..20, |seed| {
        Scene::windy(seed, 4.0, 2.0)
            .with(|scene| (scene.camera.latency_s, scene.vision.miss) = (0.2, 0.3))
    });
    println!("metric, gusts, 200 ms, 30 % missed: {}", summary(&flights));
    assert!(flights.iter().all(|f| f.phase == Phase::Landed));
    let (error, worst) = spread(&flights, |f| f.error_m);
    assert!(error <= 0.1 && worst <= 0.3, "{error} {worst}");
}

#[test]
fn stamps_that_are_50_ms_wrong_are_survived() {
    for early_s in [-0.05, 0.05] {
        let flights =
            fly(0..10, |seed| Scene::new(seed).with(|scene| scene.camera.stamp_early_s = early_s));
        println!("metric, stamps early by {early_s} s: {}", summary(&flights));
        assert!(flights.iter().all(|f| f.phase == Phase::Landed && f.error_m < 0.15));
    }
}

#[test]
fn a_pad_above_the_origin_is_met_at_its_own_height() {
    let pad = Point::new(1.0, 0.5, -3.0);
    let flight = Scene::new(3).with(|scene| scene.world.pad.position = pad).fly();
    assert_eq!(flight.phase, Phase::Landed);
    let touchdown = flight.touchdown.unwrap();
    assert!(touchdown.error_m < 0.05 && touchdown.sink_m_s < 0.6, "{touchdown:?}");
}

/// A landing of a vehicle whose origin is 0.25 m over its lowest point.
fn high_on_its_legs(seed: u64) -> Scene {
    Scene::windy(seed, 3.0, 0.15).with(|scene| scene.standing_m = 0.25)
}

#[test]
fn the_height_at_which_a_vehicle_stands_is_measured() {
    for seed in 0..5 {
        let flight = high_on_its_legs(seed).fly();
        assert_eq!(flight.phase, Phase::Landed);
        assert!(flight.error_m < 0.15, "{} m", flight.error_m);
        let measured_m = flight.standing_height_m.unwrap();
        assert!((measured_m - 0.25).abs() < 0.15, "measured {measured_m} m");
        let usual = Scene::windy(seed, 3.0, 0.15).fly();
        assert_eq!(usual.standing_height_m, None);
    }
}

#[test]
fn on_a_pad_that_heaves_no_standing_height_is_measured() {
    let heaving = high_on_its_legs(1).with(|scene| scene.config.estimator.pad_heave_m_s = 0.3);
    let flight = heaving.fly();
    assert_eq!((flight.phase, flight.standing_height_m), (Phase::Landed, None));
}

#[test]
fn a_lost_target_stops_the_descent_and_is_looked_for_from_higher_up() {
    for seed in 0..5 {
        let flight = outage(3.0, 16.0, seed).fly();
        assert!(deepest(&flight, 2.0, 3.0) > 1.0);
        assert_eq!(deepest(&flight, 3.9, 16.0), 0.0);
        let before = flight.samples.iter().filter(|s| s.seconds < 8.0);
        let lowest_m = before.fold(10.0, |m: f64, s| m.min(-s.position.z()));
        let higher = flight.at(8.0).unwrap();
        assert_eq!((higher.decision.phase, higher.decision.why), (Phase::Retry, Reason::Retrying));
        let height_m = -higher.position.z();
        assert!(height_m > lowest_m + 1.0 && height_m < 10.3, "{lowest_m} {height_m}");
        let offset = (higher.position - Point::new(1.5, -1.5, 0.0)).horizontal_norm();
        assert!(offset < 0.3, "{offset} m from the pad");
        assert_eq!(flight.phase, Phase::Landed);
        assert!(flight.error_m < 0.05, "{}", flight.error_m);
    }
}

#[test]
fn a_target_lost_for_good_ends_in_an_abort_and_silence() {
    let flight = Scene { limit_s: 150.0, ..outage(3.0, 1e9, 1) }.fly();
    assert_eq!(flight.phase, Phase::Aborted);
    let last = flight.samples.last().unwrap();
    assert_eq!((last.decision.action, last.decision.why), (Action::None, Reason::HeldTooLong));
    let mut scene = Scene { limit_s: 200.0, ..outage(3.0, 1e9, 1) };
    scene.config.phases.on_abort = OnAbort::Land;
    assert!(scene.fly().touchdown_s.is_some());
}

#[test]
fn a_marker_lost_low_over_it_does_not_keep_the_vehicle_in_the_air() {
    let undisturbed = Scene::new(2).fly();
    let low_s = undisturbed.samples.iter().find(|s| s.position.z() > -0.7).unwrap().seconds;
    let flight = outage(low_s, 1e9, 2).fly();
    assert_eq!(flight.phase, Phase::Landed);
    assert!(flight.error_m < 0.15, "{}", flight.error_m);
}

/// When the flight is first below a height.
fn below(flight: &Flight, height_m: f64) -> f64 {
    let first = flight.samples.iter().find(|s| s.position.z() > -height_m);
    first.map_or(f64::NAN, |sample| sample.seconds)
}

#[test]
fn a_marker_lost_for_good_below_two_metres_is_landed_on_from_memory() {
    for seed in 0..10 {
        let lost_s = below(&Scene::new(seed).fly(), 2.0);
        let flight = outage(lost_s, 1e9, seed).fly();
        assert_eq!(flight.phase, Phase::Landed);
        assert!(flight.error_m < 0.1, "{}", flight.error_m);
        let unseen = flight.at(lost_s + 1.0).unwrap().decision.why;
        assert_eq!(unseen, Reason::DescendingUnseen);
    }
}

#[test]
fn a_dispute_of_detectors_lifts_a_vehicle_to_wait_but_not_one_that_touches_down() {
    let disputed = |below_m: f64, seed: u64| {
        // On a pad that may move the touchdown comes before LAND.
        let flight = Scene::windy(seed, 5.0, 1.0).with(|scene| {
            scene.config.estimator.pad_speed_m_s = 0.5;
            scene.disputed_below_m = below_m;
        });
        let flight = flight.fly();
        let risen_m = flight.samples.iter().scan(f64::INFINITY, |lowest_m, sample| {
            let height_m = sample.pad.z() - sample.position.z();
            *lowest_m = lowest_m.min(height_m);
            Some(height_m - *lowest_m)
        });
        (risen_m.fold(0.0, f64::max), flight.error_m)
    };
    for seed in 0..6 {
        let (risen_m, error_m) = disputed(1.0, seed);
        assert!(risen_m > 0.5 && error_m.is_infinite(), "{seed}: {risen_m} m, {error_m} m");
        for below_m in [0.0, 0.02, 0.05] {
            let (risen_m, error_m) = disputed(below_m, seed);
            assert!(risen_m < 0.15 && error_m < 0.15, "{seed}, {below_m} m: {risen_m}, {error_m}");
        }
    }
}

#[test]
fn a_dispute_that_is_to_be_ignored_is_also_after_its_time() {
    let flight = Scene::new(1).with(|scene| {
        scene.config.phases.dispute_height_m = 0.0;
        scene.config.phases.dispute_timeout_s = 1.0;
        scene.disputed_below_m = 3.0;
    });
    let flight = flight.fly();
    assert!(flight.phase == Phase::Landed && flight.error_m < 0.1, "{:?}", flight.phase);
}

#[test]
fn a_marker_that_the_first_acceleration_tilts_out_of_view_is_hardly_ever_lost() {
    let (mut unseen, mut lost) = (0, 0);
    for seed in 0..24 {
        let flight = Scene::windy(seed, 5.0, 2.0).fly();
        let begins = || flight.samples.iter().take_while(|sample| sample.seconds < 8.0);
        let age_s = |sample: &Sample| sample.decision.target.map_or(0.0, |target| target.age_s);
        unseen += u32::from(begins().any(|sample| age_s(sample) > 1.0));
        lost += u32::from(begins().any(|sample| sample.decision.phase == Phase::Retry));
        assert!(flight.error_m < 0.1, "seed {seed}: {:?}, {} m", flight.phase, flight.error_m);
    }
    assert!(unseen >= 6 && lost <= 2, "unseen in {unseen}, lost in {lost} of 24 flights");
}

#[test]
fn a_retry_climbs_a_little_and_is_not_repeated_for_ever() {
    let unsure = |scene: Scene| {
        let metric = MetricConfig { blind_height_m: 0.0, ..MetricConfig::default() };
        Scene {
            config: Config { guidance: GuidanceConfig::Metric(metric), ..scene.config },
            ..scene
        }
    };
    let lost_s = below(&Scene::new(2).fly(), 1.3);
    let flight = unsure(outage(lost_s, lost_s + 5.0, 2)).fly();
    let after = flight.samples.iter().filter(|s| s.seconds > lost_s);
    let highest_m = after.fold(0.0, |m: f64, s| m.max(-s.position.z()));
    assert!((2.0..3.3).contains(&highest_m), "{highest_m} m");
    assert_eq!(flight.phase, Phase::Landed);
    // Whenever it is low the marker is gone.
    let flight = unsure(
        Scene::new(2).with(|scene| (scene.vision.blind_below_m, scene.limit_s) = (1.5, 290.0)),
    )
    .fly();
    let mut retries = 0;
    let mut before = Phase::Idle;
    for sample in &flight.samples {
        retries += u32::from(sample.decision.phase == Phase::Retry && before != Phase::Retry);
        before = sample.decision.phase;
    }
    assert_eq!((retries, flight.phase), (PhaseConfig::default().retries, Phase::Aborted));
}

#[test]
fn the_vehicle_turns_to_the_pad_when_asked_to() {
    let turning = MetricConfig { turn_rad_s: 0.5, pad_heading_rad: 0.2, ..MetricConfig::default() };
    for (seed, pad_rad) in [(1, 0.5), (2, -1.5), (3, 2.8)] {
        let config = Config { guidance: GuidanceConfig::Metric(turning), ..Config::default() };
        let mut scene = Scene { config, ..Scene::windy(seed, 3.0, 1.0) };
        scene.world.vehicle.start_heading_rad = 0.3;
        scene.world.pad.heading_rad = pad_rad;
        let flight = scene.fly();
        assert_eq!(flight.phase, Phase::Landed);
        assert!(flight.error_m < 0.08, "{}", flight.error_m);
        let touchdown = flight.touchdown.unwrap();
        let offset = (touchdown.heading_rad - pad_rad - 0.2).sin().abs();
        assert!(
            offset < 0.1 && (touchdown.heading_rad - pad_rad - 0.2).cos() > 0.0,
            "{offset} rad"
        );
    }
}

#[test]
fn the_pilot_silences_us_at_once() {
    let flight = Scene { pilot_s: Some(3.0), limit_s: 20.0, ..Scene::new(1) }.fly();
    assert!(
        flight
            .samples
            .iter()
            .filter(|s| s.seconds > 3.03)
            .all(|s| s.decision.action == Action::None)
    );
    assert_eq!(flight.phase, Phase::PilotInCommand);
}

#[test]
fn the_operator_can_hold_resume_and_abort() {
    let commands = vec![
        (0.0, OperatorCommand::Start),
        (3.0, OperatorCommand::Hold),
        (8.0, OperatorCommand::Resume),
    ];
    let flight = Scene { commands, ..Scene::new(1) }.fly();
    assert_eq!(deepest(&flight, 3.01, 7.9), 0.0);
    assert_eq!(flight.phase, Phase::Landed);
    let commands = vec![(0.0, OperatorCommand::Start), (3.0, OperatorCommand::Abort)];
    let flight = Scene { commands, limit_s: 20.0, ..Scene::new(1) }.fly();
    assert_eq!(flight.phase, Phase::Aborted);
    // Straight down where it is, next to the marker.
    let commands = vec![(0.0, OperatorCommand::Start), (3.0, OperatorCommand::LandHere)];
    let flight = Scene { commands, ..Scene::new(1) }.fly();
    let land_s = flight.land_s.unwrap();
    assert!((3.0..3.5).contains(&land_s), "{land_s} s");
    assert_eq!(flight.phase, Phase::Landed);
}

#[test]
fn land_is_asked_for_again_and_done_without_when_refused() {
    let flight = Scene { refuses_land: true, limit_s: 40.0, ..Scene::new(1) }.fly();
    let requests = flight.samples.iter().filter(|s| s.decision.action == Action::Land).count();
    assert!((8..=12).contains(&requests), "{requests}");
    let is_reported = |s: &Sample| s.decision.why == Reason::LandingBySetpoints;
    let reported = flight.samples.iter().find(|s| is_reported(s));
    let descends_s = reported.map(|sample| sample.seconds).unwrap();
    assert_eq!(flight.phase, Phase::Landed);
    assert!(flight.error_m < 0.15 && flight.land_s.is_none(), "{} m", flight.error_m);
    // It is disarmed on the ground before the autopilot finds it idle. The autopilot notices the ground only while it is
    // commanded down.
    let pressed_s = flight.touchdown_s.unwrap().max(descends_s);
    let stopped_s = flight.disarm_s.unwrap();
    assert!(stopped_s - pressed_s < 6.0, "{} s", stopped_s - pressed_s);
    // LAND is asked for during 5 s.
    let stood_s = stopped_s - flight.touchdown_s.unwrap();
    assert!(stood_s < 5.0 + 6.0, "{stood_s} s");
}

#[test]
fn after_a_search_without_a_result_it_is_aborted_where_the_search_began_in_wind_as_well() {
    let flights = fly(0..6, |seed| {
        Scene::windy(seed, seed as f64, 1.0).with(|scene| {
            scene.camera.outage_s = Some((0.0, 1e3));
            scene.limit_s = 126.0;
        })
    });
    for flight in &flights {
        assert_eq!(flight.phase, Phase::Aborted);
        let [first, last] = [flight.samples.first(), flight.samples.last()].map(Option::unwrap);
        let searched = flight.samples.iter().filter(|it| it.decision.phase == Phase::Search);
        let far_m = |it: &Sample| (it.position - first.position).horizontal_norm();
        let farthest_m = searched.map(far_m).fold(0.0, f64::max);
        assert!(farthest_m > 4.0 && far_m(last) < 1.5, "{farthest_m} m, {} m", far_m(last));
    }
}

#[test]
fn an_abort_takes_the_vehicle_back_from_land_while_it_is_high() {
    let mut config = Config::default();
    config.phases.on_battery_low = landing::AlarmAction::Land;
    let mut lander = Lander::new(config).unwrap();
    let mut step = |seconds: f64, mode: Mode, event: Option<Event>| {
        let now = Timestamp::from_seconds(seconds);
        let state = VehicleState {
            stamp: now,
            ned_from_body: Rotation::identity(),
            position: Point::new(0.0, 0.0, -6.0),
            velocity: Vector::zero(),
            mode,
            armed: true,
            landed: Landed::InAir,
        };
        let decision = lander.step(now, Event::Vehicle(state));
        match event {
            Some(event) => lander.step(now, event),
            None => decision,
        }
    };
    step(1.0, Mode::Guided, Some(Event::Operator(OperatorCommand::Start)));
    let alarmed = step(1.1, Mode::Guided, Some(Event::Alarm(landing::Alarm::BatteryLow)));
    assert_eq!((alarmed.action, alarmed.why), (Action::Land, Reason::BatteryLow));
    assert_eq!(step(1.3, Mode::Land, None).why, Reason::AutopilotLands);
    let aborted = step(2.0, Mode::Land, Some(Event::Operator(OperatorCommand::Abort)));
    assert_eq!((aborted.phase, aborted.action), (Phase::Aborted, Action::Guided));
    assert_eq!(step(2.1, Mode::Land, None).action, Action::None, "not at every tick");
    assert_eq!(step(2.6, Mode::Land, None).action, Action::Guided, "but again");
    assert_eq!(step(2.8, Mode::Guided, None).action, Action::hover());
    assert_eq!(step(9.0, Mode::Guided, None).action, Action::None, "and then setpoints stop");
}

#[test]
fn a_lander_started_in_mid_air_takes_the_landing_up() {
    let start = Point::new(1.0, -1.2, -5.0);
    let flights = fly(0..10, |seed| Scene::new(seed).from(start));
    assert!(flights.iter().all(|f| f.phase == Phase::Landed && f.error_m < 0.15));
}

#[test]
fn a_lander_started_low_and_out_of_sight_of_the_pad_climbs_to_find_it() {
    for seed in 0..24u32 {
        let (sin, cos) = (f64::from(seed) * 2.399).sin_cos();
        let away_m = 1.5 + 0.1 * f64::from(seed);
        let start = Point::new(1.5 + away_m * cos, -1.5 + away_m * sin, -2.1);
        let flight = Scene::windy(u64::from(seed), 3.0, 1.0).from(start).fly();
        let highest_m = flight.samples.iter().fold(0.0, |m: f64, s| m.max(-s.position.z()));
        assert_eq!(flight.phase, Phase::Landed, "from {start:?}");
        assert!(flight.error_m < 0.15 && highest_m < 6.0, "{} {highest_m}", flight.error_m);
    }
    let mut fenced = Scene::new(1).from(Point::new(-1.5, 1.5, -2.1));
    fenced.config.phases.fence_height_m = 4.0;
    let flight = fenced.fly();
    assert!(flight.samples.iter().all(|s| s.position.z() > -4.3));
    assert_eq!(flight.phase, Phase::Landed);
}

#[test]
fn a_heading_that_the_autopilot_resets_in_the_descent_is_survived() {
    for degrees in [-20.0f64, -8.0, 8.0, 20.0] {
        let flights = fly(0..4, |seed| {
            Scene::windy(seed, 3.0, 1.0).with(|scene| {
                let reset = (degrees.to_radians(), 4.0);
                scene.world.autopilot.estimate.heading_reset = Some(reset);
            })
        });
        println!("metric, heading reset by {degrees} degrees: {}", summary(&flights));
        assert!(flights.iter().all(|f| f.phase == Phase::Landed && !f.is_unsafe()));
        assert!(flights.iter().all(|f| f.error_m < 0.15));
    }
}

#[test]
fn the_thesis_landing_takes_about_its_55_seconds() {
    let flights = fly(0..20, |seed| thesis(seed, ThesisConfig::default()).perfect());
    println!("thesis: {}", summary(&flights));
    assert!(flights.iter().all(|f| f.phase == Phase::Landed));
    let (disarm, _) = spread(&flights, |f| f.disarm_s.unwrap_or(f64::INFINITY));
    let (error, worst) = spread(&flights, |f| f.error_m);
    assert!((50.0..60.0).contains(&disarm), "{disarm}");
    assert!((0.02..0.1).contains(&error) && worst < 0.2, "{error} {worst}");
    for sample in flights.iter().flat_map(|f| &f.samples) {
        if let Action::Velocity { velocity, .. } = sample.decision.action {
            // The limits of x and y, and five standard deviations of the wind noise on each.
            assert!(
                velocity.x().abs() <= 0.62
                    && velocity.y().abs() <= 0.62
                    && velocity.z().abs() <= 0.62
            );
        }
    }
}

#[test]
fn the_thesis_guidance_works_with_any_heading() {
    let flights = fly(0..6, |seed| {
        thesis(seed, ThesisConfig::default())
            .with(|scene| scene.world.vehicle.start_heading_rad = seed as f64)
    });
    println!("thesis, any heading, gusts: {}", summary(&flights));
    assert!(flights.iter().all(|f| f.phase == Phase::Landed));
}

#[test]
fn the_thesis_gain_as_printed_does_not_land() {
    let flights = fly(0..5, |seed| thesis(seed, ThesisConfig::as_printed()));
    assert!(flights.iter().all(|f| f.land_s.is_none()));
}

#[test]
fn the_same_flight_twice_is_the_same() {
    let (a, b) = (Scene::new(7).fly(), Scene::new(7).fly());
    assert_eq!(a.samples.len(), b.samples.len());
    assert!(a.samples.iter().zip(&b.samples).all(|(a, b)| a.decision == b.decision));
}
