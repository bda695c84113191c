//! The state machine step by step: starts refused, each phase's transitions and timeouts, the pilot, holds
//! and aborts, alarms, LAND refused, touchdown.

use super::*;

mod every_transition;

const FLYING: VehicleInputs = VehicleInputs {
    age_s: 0.0,
    mode: Mode::Guided,
    armed: true,
    landed: Landed::InAir,
    height_m: 5.0,
    is_over_target: true,
    sinks: false,
    land_m_s: 0.5,
    flies: false,
    awaits_state: false,
};

fn at(seconds: f64) -> Inputs {
    Inputs {
        now: Timestamp::from_seconds(seconds),
        operator: None,
        alarm: None,
        vehicle: Some(FLYING),
        target_age_s: f64::INFINITY,
        target_missed_s: f64::INFINITY,
        target_confirmed: false,
        target_known: false,
        target_refused: false,
        progress: Progress::Unchanged,
        mismatch: None,
        may_descend: true,
        is_link_slow: false,
        may_stand: false,
        has_stood_still: false,
    }
}

fn seen(seconds: f64, progress: Progress) -> Inputs {
    Inputs {
        target_age_s: 0.1,
        target_missed_s: 0.1,
        target_confirmed: true,
        progress,
        ..at(seconds)
    }
}

fn commanded(seconds: f64, command: OperatorCommand) -> Inputs {
    Inputs { operator: Some(command), ..at(seconds) }
}

fn flown(seconds: f64, change: impl Fn(&mut VehicleInputs)) -> Inputs {
    let mut vehicle = FLYING;
    change(&mut vehicle);
    Inputs { vehicle: Some(vehicle), ..at(seconds) }
}

/// Takes a new machine through the inputs and compares where it ends.
fn check(inputs: &[Inputs], phase: Phase, reason: Reason) {
    let mut machine = StateMachine::new(PhaseConfig::default());
    for input in inputs {
        machine.advance(input);
    }
    assert_eq!((machine.phase(), machine.reason()), (phase, reason), "after {inputs:#?}");
}

fn start() -> Inputs {
    commanded(0.0, OperatorCommand::Start)
}

#[test]
fn a_start_is_refused_with_the_reason() {
    let starting = |change: fn(&mut VehicleInputs)| Inputs {
        operator: start().operator,
        ..flown(0.0, change)
    };
    check(&[Inputs { vehicle: None, ..start() }], Phase::Idle, Reason::NoVehicleState);
    check(&[starting(|v| v.age_s = 0.6)], Phase::Idle, Reason::NoVehicleState);
    check(&[starting(|v| v.armed = false)], Phase::Idle, Reason::NotArmed);
    check(&[starting(|v| v.landed = Landed::OnGround)], Phase::Idle, Reason::OnTheGround);
    check(&[starting(|v| v.mode = Mode::Other)], Phase::Idle, Reason::NotGuided);
    check(&[starting(|v| v.mode = Mode::Land)], Phase::Idle, Reason::NotGuided);
    check(&[start()], Phase::Search, Reason::Searching);
}

#[test]
fn a_refused_start_does_not_replace_the_reason_for_the_phase() {
    let low = |v: &mut VehicleInputs| (v.mode, v.height_m) = (Mode::Land, 0.4);
    let starting = Inputs { operator: start().operator, ..flown(0.0, low) };
    let stands = |v: &mut VehicleInputs| {
        (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround);
    };
    let landed = [starting, flown(3.0, stands)];
    for command in [OperatorCommand::Start, OperatorCommand::LandHere] {
        let refused = Inputs { operator: Some(command), ..flown(4.0, stands) };
        let refused = [&landed[..], &[refused]].concat();
        check(&refused, Phase::Landed, Reason::NotArmed);
        let after = [&refused[..], &[flown(4.1, stands)]].concat();
        check(&after, Phase::Landed, Reason::TouchedDown);
        // Refused twice.
        let again = [&refused[..], &refused[2..], &[flown(4.1, stands)]].concat();
        check(&again, Phase::Landed, Reason::TouchedDown);
    }
}

#[test]
fn a_start_low_in_land_mode_monitors_the_touchdown() {
    let low = |v: &mut VehicleInputs| (v.mode, v.height_m) = (Mode::Land, 0.4);
    let starting = Inputs { operator: start().operator, ..flown(0.0, low) };
    check(&[starting], Phase::Final, Reason::AutopilotLands);
    let down = flown(3.0, |v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround));
    check(&[starting, down], Phase::Landed, Reason::TouchedDown);
}

#[test]
fn a_landing_goes_through_its_phases() {
    let aligned = seen(2.0, Progress::Descending);
    let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
    let land = flown(9.2, |v| v.mode = Mode::Land);
    let down = flown(12.0, |v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround));
    let all = [start(), seen(1.0, Progress::Unchanged), aligned, ready, land, down];
    check(&all[..2], Phase::Approach, Reason::Aligning);
    check(&all[..3], Phase::Descend, Reason::Descending);
    check(&all[..4], Phase::Final, Reason::LowAndAligned);
    check(&all[..5], Phase::Final, Reason::AutopilotLands);
    check(&all, Phase::Landed, Reason::TouchedDown);
    // An autopilot may leave LAND as it stops the motors.
    let left = flown(12.0, |v| (v.mode, v.armed) = (Mode::Guided, false));
    let [a, b, c, d, e, _] = all;
    check(&[a, b, c, d, e, left], Phase::Landed, Reason::TouchedDown);
}

#[test]
fn a_marker_out_of_the_cameras_view_is_waited_for_and_not_descended_to() {
    let gone = |seconds, target_missed_s, progress| Inputs {
        target_age_s: 2.5,
        target_missed_s,
        target_known: true,
        progress,
        ..at(seconds)
    };
    let approach = [start(), seen(1.0, Progress::Unchanged)];
    for progress in [Progress::Unchanged, Progress::Aligning, Progress::Descending, Progress::Blind]
    {
        let waits = gone(2.0, 0.5, progress);
        check(&[approach[0], approach[1], waits], Phase::Approach, Reason::Aligning);
        let missed = gone(2.5, 1.1, progress);
        check(&[approach[0], approach[1], waits, missed], Phase::Retry, Reason::Retrying);
    }
    let descent = seen(2.0, Progress::Descending);
    for progress in [Progress::Unchanged, Progress::Aligning, Progress::Descending] {
        let descends = [approach[0], approach[1], descent];
        let [waits, missed] = [gone(3.0, 0.5, progress), gone(3.5, 1.1, progress)];
        check(&[&descends[..], &[waits]].concat(), Phase::Approach, Reason::Aligning);
        check(&[&descends[..], &[waits, missed]].concat(), Phase::Retry, Reason::Retrying);
        check(&[&descends[..], &[missed]].concat(), Phase::Retry, Reason::Retrying);
    }
}

#[test]
fn every_wait_has_a_timeout() {
    let approach = [start(), seen(1.0, Progress::Unchanged)];
    check(&[start(), at(60.1)], Phase::Hold, Reason::TargetNotFound);
    check(&[start(), at(60.1), at(120.3)], Phase::Aborted, Reason::HeldTooLong);
    check(
        &[approach[0], approach[1], seen(61.2, Progress::Aligning)],
        Phase::Hold,
        Reason::NoProgress,
    );
    check(
        &[start(), commanded(1.0, OperatorCommand::Hold), at(182.0)],
        Phase::Aborted,
        Reason::HeldTooLong,
    );
    check(
        &[start(), commanded(1.0, OperatorCommand::Hold), at(301.0)],
        Phase::Aborted,
        Reason::LandingTooLong,
    );
    let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
    let refused = [approach[0], approach[1], ready, at(14.1), at(74.2)];
    check(&refused[..4], Phase::Final, Reason::LandingBySetpoints);
    check(&refused, Phase::Aborted, Reason::LandRefused);
    let alarm = Inputs { alarm: Some((AlarmAction::Land, Reason::BatteryCritical)), ..at(1.0) };
    check(&[start(), alarm, at(6.1)], Phase::Aborted, Reason::LandRefused);
    let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
    check(
        &[approach[0], approach[1], ready, land(9.1), land(79.3)],
        Phase::Aborted,
        Reason::TouchdownOverdue,
    );
}

#[test]
fn a_landing_that_lasts_long_is_not_broken_off_on_its_last_metre() {
    let long_s = PhaseConfig::default().landing_timeout_s;
    let hold = commanded(long_s - 60.0, OperatorCommand::Hold);
    let land = commanded(long_s - 1.0, OperatorCommand::LandHere);
    check(&[start(), hold, land, at(long_s + 1.0)], Phase::Final, Reason::OperatorLand);
    check(&[start(), hold, land, at(long_s + 5.0)], Phase::Aborted, Reason::LandRefused);
    let resume = commanded(long_s - 59.0, OperatorCommand::Resume);
    let seen_low =
        [long_s - 58.0, long_s - 57.0].map(|s| seen(s, Progress::Ready(Reason::LowAndAligned)));
    let refused = [start(), hold, resume, seen_low[0], seen_low[1], at(long_s - 51.0)];
    check(&refused, Phase::Final, Reason::LandingBySetpoints);
    let late = [&refused[..], &[at(long_s + 1.0)]].concat();
    check(&late, Phase::Final, Reason::LandingBySetpoints);
    // Without a heartbeat LAND cannot be requested, and Final waits.
    let unknown = |seconds| flown(seconds, |v| v.mode = Mode::Unknown);
    let waits = [start(), hold, land, unknown(long_s - 0.5)];
    check(&waits, Phase::Final, Reason::OperatorLand);
    let late = [&waits[..], &[unknown(long_s + 1.0)]].concat();
    check(&late, Phase::Aborted, Reason::LandingTooLong);
}

#[test]
fn an_abort_ends_land_only_while_the_vehicle_is_high() {
    let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
    let land =
        |seconds, height_m| flown(seconds, move |v| (v.mode, v.height_m) = (Mode::Land, height_m));
    let abort = |inputs| Inputs { operator: Some(OperatorCommand::Abort), ..inputs };
    let all = [start(), seen(1.0, Progress::Unchanged), ready, land(9.2, 3.0)];
    let [a, b, c, d] = all;
    check(&[a, b, c, d, abort(land(9.3, 0.5))], Phase::Final, Reason::AutopilotLands);
    check(&[a, b, c, d, abort(land(9.3, 3.0))], Phase::Aborted, Reason::OperatorAbort);
    let after = |inputs: &[Inputs]| {
        let mut machine = StateMachine::new(PhaseConfig::default());
        all.iter().chain([&abort(land(9.3, 3.0))]).chain(inputs).for_each(|inputs| {
            machine.advance(inputs);
        });
        (machine.is_recalling(), machine.is_released())
    };
    assert_eq!(after(&[]), (true, false));
    assert_eq!(after(&[land(9.4, 3.0)]), (true, false));
    assert_eq!(after(&[land(9.4, 3.0), at(9.6)]), (false, false), "it follows again");
    assert_eq!(after(&[land(15.0, 3.0)]), (false, true), "it did not return");
    let low = land(10.0, 0.9);
    assert_eq!(after(&[low]), (false, false), "it may have carried out the request");
    assert_eq!(after(&[low, land(10.2, 1.1)]), (false, false), "it is requested no more");
    assert_eq!(
        after(&[low, land(10.2, 0.8), at(10.4), at(14.0)]),
        (false, false),
        "it follows again"
    );
    assert_eq!(after(&[low, land(12.6, 0.1)]), (false, true), "it is as good as down");
    assert_eq!(after(&[low, land(12.6, 0.1), at(13.0)]), (false, true), "it stays released");
    assert_eq!(after(&[low, at(10.2), land(10.4, 0.9)]), (false, true), "LAND is the pilot's");
    let other = flown(10.2, |v| v.mode = Mode::Other);
    assert_eq!(after(&[low, other]), (false, true), "the pilot flies");
    assert_eq!(after(&[flown(9.4, |v| v.mode = Mode::Other)]), (false, true));
    let unknown = flown(9.6, |v| (v.mode, v.height_m) = (Mode::Unknown, 3.0));
    assert_eq!(after(&[unknown, land(11.0, 3.0)]), (true, false), "a heartbeat was lost");
    let landing = PhaseConfig { on_abort: OnAbort::Land, ..PhaseConfig::default() };
    let mut machine = StateMachine::new(landing);
    for inputs in all.iter().chain([&abort(land(9.3, 3.0))]) {
        machine.advance(inputs);
    }
    assert_eq!(machine.phase(), Phase::Final, "it lands already");
}

#[test]
fn the_cause_of_a_landing_is_kept_until_after_it() {
    let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
    let down = flown(20.0, |v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround));
    let alarm = Inputs { alarm: Some((AlarmAction::Land, Reason::BatteryCritical)), ..at(1.0) };
    let ready = seen(2.0, Progress::Ready(Reason::LowAndAligned));
    for (inputs, cause) in [
        (vec![alarm], Some(Reason::BatteryCritical)),
        (vec![commanded(1.0, OperatorCommand::LandHere)], Some(Reason::OperatorLand)),
        (vec![seen(1.0, Progress::Unchanged), ready], None),
    ] {
        let mut machine = StateMachine::new(PhaseConfig::default());
        for input in [start()].iter().chain(&inputs).chain(&[land(2.2)]) {
            machine.advance(input);
        }
        let lands = (Phase::Final, Reason::AutopilotLands, cause);
        assert_eq!((machine.phase(), machine.reason(), machine.cause()), lands);
        machine.advance(&down);
        assert_eq!((machine.phase(), machine.cause()), (Phase::Landed, cause));
        // The next landing has its own.
        machine.advance(&commanded(90.0, OperatorCommand::Start));
        assert_eq!((machine.phase(), machine.cause()), (Phase::Search, None));
    }
}

#[test]
fn landing_here_is_kept_as_the_cause_also_of_a_vehicle_that_lands_already() {
    let mut machine = StateMachine::new(PhaseConfig::default());
    let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
    let here = Inputs { operator: Some(OperatorCommand::LandHere), ..land(3.0) };
    for input in [start(), commanded(1.0, OperatorCommand::Abort), land(2.0), here] {
        machine.advance(&input);
    }
    let lands = (Phase::Final, Reason::AutopilotLands, Some(Reason::OperatorLand));
    assert_eq!((machine.phase(), machine.reason(), machine.cause()), lands);
}

#[test]
fn landing_here_needs_no_marker_and_leaves_a_vehicle_that_may_not_in_the_air() {
    let here = |seconds| commanded(seconds, OperatorCommand::LandHere);
    let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
    check(&[start(), here(1.0)], Phase::Final, Reason::OperatorLand);
    check(&[start(), here(1.0), land(1.2)], Phase::Final, Reason::AutopilotLands);
    let held = commanded(1.0, OperatorCommand::Hold);
    check(&[start(), held, here(9.0)], Phase::Final, Reason::OperatorLand);
    // The autopilot refuses LAND: this high, nothing descends by setpoints.
    check(&[start(), here(1.0), at(6.1)], Phase::Aborted, Reason::LandRefused);
    check(
        &[start(), here(1.0), commanded(1.5, OperatorCommand::Abort)],
        Phase::Aborted,
        Reason::OperatorAbort,
    );
}

#[test]
fn landing_here_needs_no_landing_but_a_vehicle_that_flies_in_our_mode() {
    let here = |inputs| Inputs { operator: Some(OperatorCommand::LandHere), ..inputs };
    let aborted = [start(), commanded(1.0, OperatorCommand::Abort)];
    let [a, b] = aborted;
    check(&[here(at(1.0))], Phase::Final, Reason::OperatorLand);
    check(&[a, b, here(at(9.0))], Phase::Final, Reason::OperatorLand);
    check(&[a, b, here(at(9.0)), at(14.1)], Phase::Aborted, Reason::LandRefused);
    // Where the vehicle is need not be known now.
    check(&[a, b, here(flown(9.0, |v| v.age_s = 3.0))], Phase::Final, Reason::OperatorLand);
    let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
    check(&[a, b, here(land(9.0))], Phase::Final, Reason::AutopilotLands);
    let pilot = flown(2.0, |v| v.mode = Mode::Other);
    check(&[a, pilot, here(at(9.0))], Phase::Final, Reason::OperatorLand);
    for (change, reason) in [
        ((|v| v.mode = Mode::Other) as fn(&mut VehicleInputs), Reason::NotGuided),
        (|v| v.mode = Mode::Unknown, Reason::NoVehicleState),
        (|v| v.armed = false, Reason::NotArmed),
        (|v| v.landed = Landed::OnGround, Reason::OnTheGround),
    ] {
        check(&[a, b, here(flown(9.0, change))], Phase::Aborted, reason);
    }
    check(&[here(Inputs { vehicle: None, ..at(1.0) })], Phase::Idle, Reason::NoVehicleState);
}

#[test]
fn land_from_high_up_has_the_time_that_its_speed_takes() {
    let land = |seconds, height_m: f64, land_m_s: f64, sinks| {
        flown(seconds, move |v| {
            *v = VehicleInputs { mode: Mode::Land, height_m, land_m_s, sinks, ..*v };
        })
    };
    let here = [start(), commanded(1.0, OperatorCommand::LandHere)];
    let [a, b] = here;
    let overdue = (Phase::Aborted, Reason::TouchdownOverdue);
    let lands = (Phase::Final, Reason::AutopilotLands);
    for (height_m, land_m_s, limit_s) in [(70.0, 0.5, 200.0), (70.0, 1.0, 130.0), (3.0, 0.3, 70.0)]
    {
        let from = |seconds| land(2.0 + seconds, height_m, land_m_s, false);
        check(&[a, b, from(0.0), from(limit_s - 0.1)], lands.0, lands.1);
        check(&[a, b, from(0.0), from(limit_s + 0.1)], overdue.0, overdue.1);
    }
    // The ground is far below the position where it took off: while it sinks it lands.
    let valley = |seconds, sinks| land(2.0 + seconds, -40.0, 0.5, sinks);
    check(&[a, b, valley(0.0, true), valley(120.0, true)], lands.0, lands.1);
    check(&[a, b, valley(0.0, true), valley(120.0, false)], overdue.0, overdue.1);
    check(&[a, b, valley(0.0, true), valley(661.0, true)], overdue.0, overdue.1);
}

#[test]
fn below_the_position_of_its_take_off_a_vehicle_that_sinks_is_called_back_from_land() {
    let here = [start(), commanded(1.0, OperatorCommand::LandHere)];
    let aborted = |height_m: f64, is_over_target, sinks| {
        let land = flown(2.0, move |v| {
            *v = VehicleInputs { mode: Mode::Land, height_m, is_over_target, sinks, ..*v };
        });
        let abort = Inputs { operator: Some(OperatorCommand::Abort), ..land };
        let mut machine = StateMachine::new(PhaseConfig::default());
        here.iter().chain([&land, &abort]).for_each(|inputs| {
            machine.advance(inputs);
        });
        (machine.phase(), machine.is_recalling())
    };
    let (recalled, lands) = ((Phase::Aborted, true), (Phase::Final, false));
    assert_eq!(aborted(-20.0, false, true), recalled);
    assert_eq!(aborted(-0.2, false, true), recalled, "a slope");
    assert_eq!(aborted(-0.2, false, false), lands, "it may stand");
    assert_eq!(aborted(0.5, false, true), lands);
    assert_eq!(aborted(-0.2, true, true), lands, "the pad is right below");
    assert_eq!(aborted(2.0, false, false), recalled);
    // Before it shows LAND.
    let valley = |seconds, mode| {
        flown(seconds, move |v| {
            *v = VehicleInputs { mode, height_m: -9.0, is_over_target: false, ..*v };
        })
    };
    let abort = Inputs { operator: Some(OperatorCommand::Abort), ..valley(1.4, Mode::Guided) };
    let mut machine = StateMachine::new(PhaseConfig::default());
    here.iter().chain([&abort, &valley(1.8, Mode::Land)]).for_each(|inputs| {
        machine.advance(inputs);
    });
    assert_eq!((machine.phase(), machine.is_recalling()), recalled);
}

#[test]
fn an_abort_before_the_vehicle_shows_land_calls_it_back_all_the_same() {
    let land =
        |seconds, height_m| flown(seconds, move |v| (v.mode, v.height_m) = (Mode::Land, height_m));
    let abort = commanded(1.4, OperatorCommand::Abort);
    let here = [start(), commanded(1.0, OperatorCommand::LandHere)];
    let after = |inputs: &[Inputs]| {
        let mut machine = StateMachine::new(PhaseConfig::default());
        here.iter().chain(inputs).for_each(|inputs| {
            machine.advance(inputs);
        });
        (machine.phase(), machine.is_recalling(), machine.is_released())
    };
    assert_eq!(after(&[abort]), (Phase::Aborted, false, false));
    assert_eq!(after(&[abort, land(1.8, 5.0)]), (Phase::Aborted, true, false));
    assert_eq!(after(&[abort, at(1.5), land(1.8, 5.0)]), (Phase::Aborted, true, false));
    assert_eq!(after(&[abort, land(1.8, 5.0), at(2.5)]), (Phase::Aborted, false, false));
    // Later, or from a vehicle that was low, LAND is the pilot's; so is it without a request of ours.
    assert_eq!(after(&[abort, at(2.0), land(4.0, 5.0)]), (Phase::Aborted, false, true));
    let low = Inputs { operator: abort.operator, ..flown(1.4, |v| v.height_m = 0.5) };
    assert_eq!(after(&[low, land(1.8, 0.5)]), (Phase::Aborted, false, true));
    check(&[start(), abort, land(1.8, 5.0)], Phase::Aborted, Reason::OperatorAbort);
    let mut machine = StateMachine::new(PhaseConfig::default());
    [start(), abort, land(1.8, 5.0)].iter().for_each(|inputs| {
        machine.advance(inputs);
    });
    assert_eq!((machine.is_recalling(), machine.is_released()), (false, true));
    let hold = commanded(1.4, OperatorCommand::Hold);
    check(&[here[0], here[1], hold], Phase::Final, Reason::OperatorLand);
}

#[test]
fn an_axis_mismatch_holds_and_a_running_check_delays_the_descent() {
    let open = Inputs { may_descend: false, ..seen(2.0, Progress::Descending) };
    check(&[start(), seen(1.0, Progress::Unchanged), open], Phase::Approach, Reason::Aligning);
    let turned = Inputs { mismatch: Some(Reason::CameraTurned), ..open };
    let all = [start(), seen(1.0, Progress::Unchanged), turned, turned];
    check(&all, Phase::Hold, Reason::CameraTurned);
    check(&[all[0], all[1], all[2], at(63.0)], Phase::Aborted, Reason::HeldTooLong);
}

#[test]
fn a_lost_vehicle_or_target_holds() {
    let approach = [start(), seen(1.0, Progress::Unchanged)];
    let stale = flown(2.0, |v| v.age_s = 0.6);
    check(&[approach[0], approach[1], stale], Phase::Hold, Reason::VehicleStale);
    check(&[approach[0], approach[1], stale, at(3.0)], Phase::Search, Reason::Searching);
    check(&[approach[0], approach[1], at(2.0)], Phase::Hold, Reason::TargetLost);
    let again = seen(3.0, Progress::Unchanged);
    check(&[approach[0], approach[1], at(2.0), again, again], Phase::Approach, Reason::Aligning);
}

#[test]
fn a_marker_that_is_seen_and_refused_is_not_called_lost() {
    let [a, b, c] = [start(), seen(1.0, Progress::Unchanged), seen(2.0, Progress::Descending)];
    let refused = Inputs { target_refused: true, ..at(4.0) };
    check(&[a, b, c, refused], Phase::Hold, Reason::TargetRefused);
    check(&[a, b, c, refused, seen(5.0, Progress::Unchanged)], Phase::Search, Reason::Searching);
    let known = Inputs { target_known: true, ..refused };
    check(&[a, b, c, known], Phase::Retry, Reason::RetryingRefused);
    check(&[a, b, c, known, seen(4.5, Progress::Unchanged)], Phase::Approach, Reason::Aligning);
}

#[test]
fn a_vehicle_that_may_stand_on_the_pad_does_not_climb() {
    let [a, b, c] = [start(), seen(1.0, Progress::Unchanged), seen(2.0, Progress::Descending)];
    let stale = flown(3.0, |v| v.age_s = 0.6);
    let low = Inputs { may_stand: true, ..at(4.0) };
    let known = Inputs { target_known: true, ..low };
    check(&[a, b, c, stale, at(4.0)], Phase::Search, Reason::Searching);
    check(&[a, b, c, stale, low], Phase::Final, Reason::MayStand);
    check(&[a, b, c, Inputs { may_stand: false, ..known }], Phase::Retry, Reason::Retrying);
    check(&[a, b, c, known], Phase::Final, Reason::MayStand);
    // It waits for the vehicle's state, and a hold by the operator persists.
    check(
        &[a, b, c, stale, Inputs { may_stand: true, ..stale }],
        Phase::Hold,
        Reason::VehicleStale,
    );
    let held = commanded(3.0, OperatorCommand::Hold);
    check(&[a, b, c, held, low], Phase::Hold, Reason::OperatorHold);
}

#[test]
fn the_pilot_and_only_the_pilot_takes_over() {
    let land = |seconds| flown(seconds, |v| v.mode = Mode::Land);
    let taken = (Phase::PilotInCommand, Reason::PilotTookOver);
    check(&[start(), flown(1.0, |v| v.mode = Mode::Other)], taken.0, taken.1);
    check(&[start(), land(1.0)], taken.0, taken.1);
    let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
    let finals = [start(), seen(1.0, Progress::Unchanged), ready, land(9.1)];
    let [a, b, c, d] = finals;
    check(&[a, b, c, d, at(10.4)], taken.0, taken.1);
    // A heartbeat that LAND has overtaken.
    check(&[a, b, c, d, at(10.0)], Phase::Final, Reason::AutopilotLands);
    check(&[a, b, c, d, at(10.0), land(10.1)], Phase::Final, Reason::AutopilotLands);
    check(&[start(), land(1.0), at(2.0), start()], Phase::Search, Reason::Searching);
}

#[test]
fn disarmed_motors_end_the_landing() {
    let stopped = |seconds| flown(seconds, |v| v.armed = false);
    check(&[start(), stopped(1.0), stopped(1.4)], Phase::Search, Reason::Searching);
    check(&[start(), stopped(1.0), stopped(1.5)], Phase::Aborted, Reason::Disarmed);
    let down = |v: &mut VehicleInputs| (v.armed, v.landed) = (false, Landed::OnGround);
    check(&[start(), flown(1.0, down)], Phase::Landed, Reason::TouchedDown);
    check(&[start(), stopped(1.0), flown(1.2, down)], Phase::Landed, Reason::TouchedDown);
    check(
        &[start(), flown(1.0, |v| v.landed = Landed::OnGround)],
        Phase::Final,
        Reason::TouchedEarly,
    );
}

#[test]
fn motors_that_stop_in_the_air_are_no_touchdown() {
    let falls = |seconds| flown(seconds, |v| (v.armed, v.flies) = (false, true));
    let down = |v: &mut VehicleInputs| (v.armed, v.landed) = (false, Landed::OnGround);
    let fell = (Phase::Aborted, Reason::StoppedInAir);
    check(&[start(), falls(1.0), flown(1.3, down)], Phase::Search, Reason::Searching);
    check(&[start(), falls(1.0), flown(1.3, down), flown(1.5, down)], fell.0, fell.1);
    let ready = seen(9.0, Progress::Ready(Reason::LowAndAligned));
    let land = flown(9.1, |v| v.mode = Mode::Land);
    let finals = [start(), seen(1.0, Progress::Unchanged), ready, land];
    let [a, b, c, d] = finals;
    check(&[a, b, c, d, falls(9.5)], fell.0, fell.1);
    check(&[a, b, c, d, falls(9.5), flown(9.8, down)], fell.0, fell.1);
    // While the state is old a newer one decides.
    let is_open = |v: &mut VehicleInputs| {
        (v.mode, v.armed, v.landed, v.awaits_state) = (Mode::Other, false, Landed::OnGround, true);
    };
    check(&[a, b, c, d, flown(9.5, is_open)], Phase::Final, Reason::AutopilotLands);
    check(&[a, b, c, d, flown(9.5, is_open), falls(9.8)], fell.0, fell.1);
    // The report of the motors may be wrong: an abort is obeyed.
    let aborted = Inputs { operator: Some(OperatorCommand::Abort), ..flown(9.8, is_open) };
    check(&[a, b, c, d, flown(9.5, is_open), aborted], Phase::Aborted, Reason::OperatorAbort);
    let stands = (Phase::Landed, Reason::TouchedDown);
    check(&[a, b, c, d, flown(9.5, is_open), flown(9.8, down)], stands.0, stands.1);
    // Motors that run again were not off.
    check(&[start(), falls(1.0), at(1.2), flown(9.0, down)], Phase::Landed, Reason::TouchedDown);
}

#[test]
fn an_unknown_mode_holds_until_it_is_known_and_is_no_takeover() {
    let unknown = |seconds| flown(seconds, |v| v.mode = Mode::Unknown);
    let flying = [start(), seen(1.0, Progress::Unchanged), seen(2.0, Progress::Descending)];
    let [a, b, c] = flying;
    check(&[a, b, c, unknown(3.0), unknown(9.0)], Phase::Hold, Reason::ModeUnknown);
    check(&[a, b, c, unknown(3.0), at(5.0)], Phase::Search, Reason::Searching);
    let taken = flown(5.0, |v| v.mode = Mode::Other);
    check(&[a, b, c, unknown(3.0), taken], Phase::PilotInCommand, Reason::PilotTookOver);
    check(&[a, b, c, unknown(3.0), unknown(63.1)], Phase::Aborted, Reason::HeldTooLong);
    // A landing for the battery's sake waits for the heartbeat.
    let alarm = Inputs { alarm: Some((AlarmAction::Land, Reason::BatteryCritical)), ..at(1.0) };
    check(&[a, alarm, unknown(2.0), unknown(20.0)], Phase::Final, Reason::BatteryCritical);
}

#[test]
fn a_slow_link_holds_until_it_is_quick_again() {
    let slow = |seconds| Inputs { is_link_slow: true, ..at(seconds) };
    let flying = [start(), seen(1.0, Progress::Unchanged), slow(2.0), slow(9.0), at(10.0)];
    check(&flying[..4], Phase::Hold, Reason::LinkSlow);
    check(&flying, Phase::Search, Reason::Searching);
}

#[test]
fn a_vehicle_that_may_stand_is_landed_and_not_lifted_when_its_link_becomes_slow() {
    let [a, b, c] = [start(), seen(1.0, Progress::Unchanged), seen(2.0, Progress::Descending)];
    let slow = |seconds, may_stand| Inputs {
        is_link_slow: true,
        may_stand,
        ..seen(seconds, Progress::Descending)
    };
    check(&[a, b, c, slow(3.0, true)], Phase::Final, Reason::MayStand);
    check(&[a, b, c, slow(3.0, false)], Phase::Hold, Reason::LinkSlow);
    // It touches down after the link has become slow.
    check(&[a, b, c, slow(3.0, false), slow(3.5, true)], Phase::Final, Reason::MayStand);
    // Without a heartbeat LAND cannot be requested.
    let unknown =
        Inputs { vehicle: flown(3.5, |v| v.mode = Mode::Unknown).vehicle, ..slow(3.5, true) };
    check(&[a, b, c, slow(3.0, false), unknown], Phase::Hold, Reason::LinkSlow);
    // Another hold is the operator's to end.
    let held = commanded(3.0, OperatorCommand::Hold);
    check(&[a, b, c, held, slow(3.5, true)], Phase::Hold, Reason::OperatorHold);
}

#[test]
fn after_a_long_standstill_of_the_controller_the_operator_decides() {
    let stopped = |seconds| Inputs { has_stood_still: true, ..seen(seconds, Progress::Descending) };
    let descending = [start(), seen(1.0, Progress::Unchanged), seen(2.0, Progress::Descending)];
    let [a, b, c] = descending;
    let on = [seen(30.5, Progress::Descending), seen(90.0, Progress::Descending)];
    check(&[a, b, c, stopped(30.0), on[0], on[1]], Phase::Hold, Reason::Standstill);
    let resumed = Inputs { operator: Some(OperatorCommand::Resume), ..at(31.0) };
    check(&[a, b, c, stopped(30.0), on[0], resumed], Phase::Search, Reason::Searching);
    check(&[a, b, c, stopped(30.0), at(211.0)], Phase::Aborted, Reason::HeldTooLong);
    // A hold that would end without a command, and an alarm whose hold would.
    let slow = Inputs { is_link_slow: true, ..at(3.0) };
    check(&[a, b, c, slow, stopped(30.0), on[0]], Phase::Hold, Reason::Standstill);
    let lost = Inputs { alarm: Some((AlarmAction::Hold, Reason::AutopilotLost)), ..stopped(30.0) };
    check(&[a, b, c, lost, on[0]], Phase::Hold, Reason::Standstill);
    let unknown = flown(3.0, |v| v.mode = Mode::Unknown);
    let stale = flown(3.0, |v| v.age_s = 0.6);
    for held in [unknown, stale, Inputs { target_age_s: 2.5, ..at(3.0) }] {
        check(&[a, b, c, held, stopped(30.0), on[0], on[1]], Phase::Hold, Reason::Standstill);
    }
    // Commands, alarms that end the landing, and the ground come first.
    let held = commanded(3.0, OperatorCommand::Hold);
    check(&[a, b, c, held, stopped(30.0)], Phase::Hold, Reason::OperatorHold);
    let abort = Inputs { operator: Some(OperatorCommand::Abort), ..stopped(30.0) };
    check(&[a, b, c, abort], Phase::Aborted, Reason::OperatorAbort);
    let empty = Inputs { alarm: Some((AlarmAction::Land, Reason::BatteryCritical)), ..abort };
    check(&[a, b, c, Inputs { operator: None, ..empty }], Phase::Final, Reason::BatteryCritical);
    let stands = Inputs { may_stand: true, ..at(31.0) };
    check(&[a, b, c, stopped(30.0), stands], Phase::Final, Reason::MayStand);
    // LAND has been asked for.
    let ready = seen(3.0, Progress::Ready(Reason::LowAndAligned));
    check(&[a, b, c, ready, stopped(30.0)], Phase::Final, Reason::LandingBySetpoints);
    let mut machine = StateMachine::new(PhaseConfig::default());
    for inputs in [a, b, c, stopped(30.0)] {
        machine.advance(&inputs);
    }
    assert!(machine.waits_for_operator());
}

#[test]
fn a_landing_continues_by_itself_only_where_the_link_is_back_within_15_s() {
    let lost = |seconds| flown(seconds, |v| v.age_s = seconds - 2.0);
    let descending = [start(), seen(1.0, Progress::Unchanged), seen(2.0, Progress::Descending)];
    let [a, b, c] = descending;
    check(&[a, b, c, lost(3.0), lost(17.0), at(17.5)], Phase::Search, Reason::Searching);
    let alarm = Inputs { alarm: Some((AlarmAction::Hold, Reason::AutopilotLost)), ..lost(4.0) };
    check(&[a, b, c, lost(3.0), alarm, lost(18.0), at(18.5)], Phase::Search, Reason::Searching);
    // The lander states that the link was lost for longer.
    let back = Inputs { has_stood_still: true, ..at(19.5) };
    let long = [a, b, c, lost(3.0), alarm, lost(18.0), back, at(20.0)];
    check(&long, Phase::Hold, Reason::Standstill);
    let resumed = Inputs { operator: Some(OperatorCommand::Resume), ..at(60.0) };
    check(&[a, b, c, lost(3.0), alarm, back, resumed], Phase::Search, Reason::Searching);
    check(&[a, b, c, lost(3.0), lost(62.5), lost(64.0)], Phase::Aborted, Reason::HeldTooLong);
}

#[test]
fn a_running_axis_check_also_delays_a_descent_without_the_marker() {
    let blind = Inputs { may_descend: false, ..seen(2.0, Progress::Blind) };
    check(&[start(), seen(1.0, Progress::Unchanged), blind], Phase::Approach, Reason::Aligning);
}

#[test]
fn nothing_is_sent_during_a_take_off() {
    let rising = |seconds| flown(seconds, |v| v.landed = Landed::TakingOff);
    let starting = Inputs { operator: start().operator, ..rising(0.0) };
    check(&[starting, rising(0.1)], Phase::Search, Reason::TakingOff);
    check(&[starting, rising(30.0), at(31.0)], Phase::Search, Reason::Searching);
}
