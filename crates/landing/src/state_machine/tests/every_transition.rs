//! Explores the state machine completely: every event of an alphabet in every reachable state, where two
//! states are the same when phase, reason, flags, retries and the expired timeouts agree.

use super::*;
use std::collections::hash_map::Entry;
use std::collections::{HashMap, VecDeque};

/// The values that distinguish two states.
type Key = (Phase, Reason, [bool; 6], u32, [bool; 4], bool);

const LONG_S: f64 = 1e6;

fn config() -> PhaseConfig {
    PhaseConfig { retries: 2, on_battery_low: AlarmAction::Hold, ..PhaseConfig::default() }
}

fn now() -> Timestamp {
    Timestamp::from_seconds(LONG_S)
}

fn key(machine: &StateMachine) -> Key {
    let (config, elapsed_s) = (&machine.config, machine.elapsed_s(now()));
    let over = [
        elapsed_s > MIN_RETRY_S,
        elapsed_s > config.retry_timeout_s,
        elapsed_s > config.search_timeout_s.min(config.hold_timeout_s),
        elapsed_s > config.descend_timeout_s.max(config.operator_hold_timeout_s),
    ];
    let late = now().seconds_since(machine.started) > config.landing_timeout_s;
    let terminal = machine.phase.is_terminal();
    // The time spent in a terminal phase does not matter.
    let (over, late) = if terminal { ([false; 4], false) } else { (over, late) };
    let released = machine.phase == Phase::Aborted && machine.released;
    let retries = if terminal { 0 } else { machine.retries };
    let waited_s = machine.disarmed.map(|since| now().seconds_since(since));
    let flags = [
        machine.landing,
        released,
        machine.is_recalling,
        waited_s.is_some() && !terminal,
        machine.stopped_in_air && !terminal,
        waited_s.is_some_and(|s| s >= MAX_CONTACT_WAIT_S) && !terminal,
    ];
    (machine.phase, machine.reason, flags, retries, over, late)
}

/// The same machine, so much later, with its moments moved so that it is always the same time.
fn aged(machine: &StateMachine, seconds: f64) -> StateMachine {
    let earlier = |moment: Timestamp| {
        let age_s = (now().seconds_since(moment) + seconds).min(2000.0);
        now().plus_seconds(-age_s)
    };
    StateMachine {
        entered: earlier(machine.entered),
        started: earlier(machine.started),
        disarmed: machine.disarmed.map(earlier),
        became_low: machine.became_low.map(earlier),
        ..machine.clone()
    }
}

fn vehicles() -> Vec<Option<VehicleInputs>> {
    let change = |change: fn(&mut VehicleInputs)| {
        let mut vehicle = FLYING;
        change(&mut vehicle);
        Some(vehicle)
    };
    vec![
        None,
        Some(FLYING),
        change(|v| v.age_s = 1.0),
        change(|v| v.mode = Mode::Land),
        change(|v| (v.mode, v.height_m) = (Mode::Land, 0.4)),
        change(|v| (v.mode, v.height_m, v.is_over_target) = (Mode::Land, -9.0, false)),
        change(|v| (v.mode, v.sinks) = (Mode::Land, true)),
        change(|v| v.mode = Mode::Other),
        change(|v| v.mode = Mode::Unknown),
        change(|v| v.armed = false),
        change(|v| (v.armed, v.flies) = (false, true)),
        change(|v| (v.armed, v.landed) = (false, Landed::OnGround)),
        change(|v| (v.age_s, v.armed, v.awaits_state) = (1.0, false, true)),
        change(|v| (v.mode, v.armed, v.landed) = (Mode::Land, false, Landed::OnGround)),
        change(|v| v.landed = Landed::OnGround),
        change(|v| (v.mode, v.landed) = (Mode::Land, Landed::OnGround)),
        change(|v| v.landed = Landed::TakingOff),
    ]
}

fn alphabet() -> Vec<Inputs> {
    let operators = [
        None,
        Some(OperatorCommand::Start),
        Some(OperatorCommand::Hold),
        Some(OperatorCommand::Resume),
        Some(OperatorCommand::Abort),
        Some(OperatorCommand::LandHere),
    ];
    let alarms = [
        None,
        Some((AlarmAction::Hold, Reason::BatteryLow)),
        Some((AlarmAction::Abort, Reason::OperatorLost)),
        Some((AlarmAction::Land, Reason::BatteryCritical)),
    ];
    let progresses = [
        Progress::Aligning,
        Progress::Descending,
        Progress::Blind,
        Progress::Stuck,
        Progress::Unchanged,
        Progress::Ready(Reason::LowAndAligned),
    ];
    let mut all = Vec::new();
    for vehicle in vehicles() {
        for operator in operators {
            for alarm in alarms {
                // A command and an alarm never come as one event.
                if operator.is_some() && alarm.is_some() {
                    continue;
                }
                for progress in progresses {
                    for (target_age_s, target_missed_s, target_known) in [
                        (0.1, 0.1, true),
                        (0.7, 0.7, true),
                        (5.0, 5.0, true),
                        (5.0, 5.0, false),
                        (2.5, 0.5, true),
                    ] {
                        all.push(Inputs {
                            now: now(),
                            operator,
                            alarm,
                            vehicle,
                            target_age_s,
                            target_missed_s,
                            target_confirmed: true,
                            target_known,
                            target_refused: false,
                            progress,
                            mismatch: None,
                            may_descend: true,
                            is_link_slow: false,
                            may_stand: false,
                            has_stood_still: false,
                        });
                    }
                }
            }
        }
    }
    let turned = Some(Reason::CameraTurned);
    all.push(Inputs { is_link_slow: true, now: now(), ..at(0.0) });
    all.push(Inputs { target_refused: true, target_known: true, now: now(), ..at(0.0) });
    all.push(Inputs { has_stood_still: true, now: now(), ..at(0.0) });
    all.push(Inputs { may_stand: true, now: now(), ..at(0.0) });
    all.push(Inputs { may_stand: true, target_known: true, now: now(), ..at(0.0) });
    all.push(Inputs { mismatch: turned, may_descend: false, now: now(), ..at(0.0) });
    all
}

/// Invariants of every single step.
fn check_step(before: &StateMachine, inputs: &Inputs, after: &StateMachine) {
    let (from, to) = (before.phase, after.phase);
    let step = format!("{from} to {to} after {inputs:?}");
    if from.is_terminal() {
        let started =
            matches!(inputs.operator, Some(OperatorCommand::Start | OperatorCommand::LandHere));
        assert!(from == to || started, "left without a command: {step}");
        return;
    }
    let vehicle = inputs.vehicle;
    if vehicle.is_some_and(|v| v.mode == Mode::Other) {
        assert_eq!(to, Phase::PilotInCommand, "the pilot is not obeyed: {step}");
        return;
    }
    if to == Phase::Descend && from != Phase::Descend {
        let seen = inputs.target_age_s <= before.config.lost_target_s;
        assert!(seen || inputs.progress == Progress::Blind, "descends blindly: {step}");
        assert!(vehicle.is_some_and(|v| v.age_s < 0.5), "descends stale: {step}");
        assert!(vehicle.is_some_and(|v| v.mode == Mode::Guided), "descends unknown: {step}");
    }
    if to == Phase::Landed {
        assert!(vehicle.is_some_and(|v| !v.armed || v.landed == Landed::OnGround), "{step}");
        assert!(vehicle.is_some_and(|v| v.armed || !v.flies), "landed in the air: {step}");
    }
    if inputs.operator == Some(OperatorCommand::Abort) {
        let lands = before.landing || vehicle.is_some_and(|v| v.mode == Mode::Land);
        let too_late = lands && vehicle.is_none_or(|v| v.height_m < 1.0);
        assert!(to.is_terminal() || too_late, "an abort is not obeyed: {step}");
    }
    if inputs.operator == Some(OperatorCommand::LandHere) && !to.is_terminal() {
        assert_eq!(to, Phase::Final, "landing here is not obeyed: {step}");
    }
    assert!(after.retries <= before.config.retries, "too many retries: {step}");
}

#[test]
fn every_transition_is_allowed_and_every_phase_ends() {
    let alphabet = alphabet();
    let first = aged(&StateMachine::new(config()), 10.0);
    let mut found = HashMap::from([(key(&first), first.clone())]);
    let mut open = VecDeque::from([first]);
    while let Some(machine) = open.pop_front() {
        for wait_s in [0.0, 3.0, 10.0, 65.0, 200.0, 400.0] {
            let waited = aged(&machine, wait_s);
            for inputs in &alphabet {
                let mut after = waited.clone();
                after.advance(inputs);
                check_step(&waited, inputs, &after);
                let key = key(&after);
                if let Entry::Vacant(entry) = found.entry(key) {
                    entry.insert(after.clone());
                    open.push_back(after);
                }
            }
        }
    }
    for phase in [
        Phase::Idle,
        Phase::Search,
        Phase::Approach,
        Phase::Descend,
        Phase::Retry,
        Phase::Final,
        Phase::Landed,
        Phase::Hold,
        Phase::Aborted,
        Phase::PilotInCommand,
    ] {
        assert!(found.values().any(|m| m.phase == phase), "{phase} is never reached");
    }
    for machine in found.values() {
        assert!(ends(machine), "does not end: {machine:?}");
    }
}

/// Without further events every state ends, with a vehicle that flies or lands as commanded.
fn ends(machine: &StateMachine) -> bool {
    let mut machine = machine.clone();
    for _ in 0..200 {
        if machine.phase.is_terminal() {
            return true;
        }
        let mut vehicle = FLYING;
        if machine.landing {
            vehicle.mode = Mode::Land;
        }
        machine = aged(&machine, 5.0);
        machine.advance(&Inputs { vehicle: Some(vehicle), now: now(), ..at(0.0) });
    }
    false
}
