//! A flight with the modelled PX4, in lock-step: what follows interruptions of the setpoints, from the take-off to the abort, and whether
//! a pilot's switch wins.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

mod modelled;
mod packets;

use autopilot::FlightMode;
use messages::{ControllerCommand, Phase};
use modelled::Site;
use world::ardupilot::Mode;

/// PX4's modes by their two numbers.
const HOLD: (f32, f32) = (4.0, 3.0);
const POSITION: (f32, f32) = (3.0, 0.0);

/// A PX4 that took off for us and hovers in OFFBOARD, while its landing waits for a command, as the controller did not run for 20 s in the
/// climb.
fn waiting_in_air(set: &[&str]) -> Site {
    let mut site = Site::new("takeoff", set);
    let is_climbing = |site: &Site| site.world.truth().height_m > 1.0;
    assert!(site.run_until(60.0, is_climbing), "{:?}", site.status());
    site.freeze(20.0);
    let waits = |site: &Site| site.status().why.contains("`resume` begins");
    assert!(site.run_until(60.0, waits), "{:?}", site.status());
    site.run(3.0);
    assert_eq!(site.mode(), Mode::Guided);
    assert_eq!(site.status().phase, Phase::Takeoff);
    site
}

#[test]
fn a_px4_that_waits_in_the_air_hovers_again_after_an_interruption_and_lands_by_command() {
    for command in [ControllerCommand::Resume, ControllerCommand::Start] {
        for frozen_s in [1.5, 3.0, 8.0, 20.0] {
            let mut site = waiting_in_air(&[]);
            site.freeze(frozen_s);
            assert_eq!(site.mode(), Mode::Loiter, "its failsafe");
            // The standstill is noticed with the first tick.
            site.run(0.03);
            let reply = site.command(&command);
            assert!(reply.accepted, "{reply:?}");
            site.run(1.0);
            assert_eq!(site.mode(), Mode::Guided, "{:?}", site.status());
            let lands = site.run_until(60.0, |site| site.status().phase == Phase::Landed);
            assert!(lands, "{command:?} after {frozen_s} s: {:?}", site.status());
        }
    }
}

#[test]
fn a_battery_alarm_lands_a_px4_that_waits_in_the_air_once_it_follows_setpoints_again() {
    let mut site = waiting_in_air(&[]);
    site.charge = Some(8);
    // The alarm is raised while its setpoints are interrupted again and again.
    for _ in 0..4 {
        site.freeze(1.4);
        site.run(0.2);
    }
    let lands = site.run_until(60.0, |site| site.status().phase == Phase::Landed);
    assert!(lands && site.status().why.contains("battery"), "{:?}", site.status());

    // In a pilot's HOLD it is kept until the operator takes the vehicle out of that.
    let mut site = waiting_in_air(&[]);
    site.charge = Some(8);
    site.pilot(HOLD.0, HOLD.1);
    site.run(10.0);
    assert_eq!(site.mode(), Mode::Loiter, "{:?}", site.status());
    let reply = site.command(&ControllerCommand::Start);
    assert!(reply.accepted, "{reply:?}");
    let lands = site.run_until(60.0, |site| site.status().phase == Phase::Landed);
    assert!(lands && site.status().why.contains("battery"), "{:?}", site.status());
}

#[test]
fn a_px4_that_a_pilot_holds_after_its_takeoff_stays_there_and_resume_says_what_to_do() {
    for is_interrupted in [false, true] {
        let mut site = waiting_in_air(&[]);
        if is_interrupted {
            site.is_frozen = true;
            site.run(2.0);
        }
        site.pilot(HOLD.0, HOLD.1);
        site.run(1.0);
        site.is_frozen = false;
        site.run(5.0);
        let status = site.status();
        assert!(site.mode() == Mode::Loiter && status.why.contains("`start`"), "{status:?}");
        let reply = site.command(&ControllerCommand::Resume);
        assert!(!reply.accepted && reply.reason.contains("`start`"), "{reply:?}");
        site.run(5.0);
        assert!(site.mode() == Mode::Loiter, "{:?}", site.status());
        let command = match is_interrupted {
            true => ControllerCommand::LandHere,
            false => ControllerCommand::Start,
        };
        let reply = site.command(&command);
        assert!(reply.accepted, "{reply:?}");
        let lands = site.run_until(60.0, |site| site.status().phase == Phase::Landed);
        assert!(lands, "{:?}", site.status());
    }
    // Any other mode ends the mission.
    let mut site = waiting_in_air(&[]);
    site.freeze(3.0);
    site.pilot(POSITION.0, POSITION.1);
    site.run(5.0);
    let status = site.status();
    assert!(status.phase == Phase::Failed && status.why.contains("pilot"), "{status:?}");
    assert!(site.mode() == Mode::PosHold && !site.command(&ControllerCommand::Resume).accepted);
}

/// A PX4 that is landing by our setpoints, some metres over the pad.
fn landing(set: &[&str]) -> Site {
    let mut site = Site::new("takeoff", set);
    let is_low = |site: &Site| {
        let status = site.status();
        matches!(status.phase, Phase::Approach | Phase::Descend)
            && status.height_m.is_some_and(|height_m| height_m < 8.0)
    };
    assert!(site.run_until(90.0, is_low), "{:?}", site.status());
    site
}

#[test]
fn an_abort_just_after_an_interruption_ends_in_a_hold_that_is_chosen() {
    for after_s in [0.03, 0.1, 0.5, 1.0] {
        for waits in [false, true] {
            let mut site = if waits { waiting_in_air(&[]) } else { landing(&[]) };
            site.freeze(1.5);
            assert_eq!((site.mode(), site.chosen()), (Mode::Loiter, FlightMode::OFFBOARD));
            site.run(after_s);
            let reply = site.command(&ControllerCommand::Abort);
            assert!(reply.accepted, "{reply:?}");
            site.run(12.0);
            let status = site.status();
            assert_eq!(site.mode(), Mode::Loiter, "{status:?}");
            assert_eq!(site.chosen(), FlightMode::AUTO_HOLD, "after {after_s} s: {status:?}");
            assert!(status.why.ends_with("in HOLD"), "{status:?}");
        }
    }
}

#[test]
fn an_aborted_landing_is_over_only_when_the_mode_is_known_in_which_a_px4_is_left() {
    for after_s in [0.03, 0.1, 0.5, 1.0, 3.0] {
        let mut site = landing(&[]);
        site.freeze(1.5);
        site.run(after_s);
        let reply = site.command(&ControllerCommand::Abort);
        assert!(reply.accepted, "{reply:?}");
        assert!(!site.status().finished, "after {after_s} s: {:?}", site.status());
        let ends = site.run_until(15.0, |site| site.status().finished);
        let status = site.status();
        assert!(ends && status.why.ends_with("in HOLD"), "after {after_s} s: {status:?}");
        assert_eq!(site.chosen(), FlightMode::AUTO_HOLD, "after {after_s} s: {status:?}");
    }
}

#[test]
fn an_abort_just_after_an_interruption_in_which_the_pilot_took_over_changes_no_mode() {
    for (main, sub) in [HOLD, POSITION] {
        for waits in [false, true] {
            let mut site = if waits { waiting_in_air(&[]) } else { landing(&[]) };
            site.is_frozen = true;
            site.run(2.0);
            site.pilot(main, sub);
            site.run(0.5);
            site.is_frozen = false;
            site.requested.clear();
            let mode = site.mode();
            site.run(0.03);
            site.command(&ControllerCommand::Abort);
            site.run(12.0);
            assert_eq!(site.mode(), mode, "{:?}", site.status());
            assert!(site.requested.is_empty(), "{:?}", site.requested);
        }
    }
}

/// A controller that is to resume the landing of a PX4 that an earlier one was landing, and did not run for 20 s before it could begin.
fn held_resume() -> Site {
    let mut site = landing(&[]);
    site.restart_controller("resume");
    let is_found = |site: &Site| site.flight.system().is_some();
    assert!(site.run_until(5.0, is_found));
    site.freeze(20.0);
    site.run(0.5);
    site
}

#[test]
fn a_landing_of_a_px4_that_is_to_be_resumed_waits_for_the_command_for_any_time() {
    for command in [ControllerCommand::Resume, ControllerCommand::Abort] {
        for waited_s in [1.0, 8.0, 40.0] {
            let mut site = held_resume();
            site.run(waited_s);
            let status = site.status();
            assert!(status.why.contains("`resume` begins"), "after {waited_s} s: {status:?}");
            assert_eq!(site.mode(), Mode::Guided, "{status:?}");
            let reply = site.command(&command);
            assert!(reply.accepted, "{reply:?}");
            if command == ControllerCommand::Resume {
                let lands = site.run_until(90.0, |site| site.status().phase == Phase::Landed);
                assert!(lands, "after {waited_s} s: {:?}", site.status());
            } else {
                site.run(5.0);
                let status = site.status();
                assert_eq!(site.chosen(), FlightMode::AUTO_HOLD, "{status:?}");
                assert!(status.phase == Phase::Failed && status.started_ns.is_none(), "{status:?}");
                assert!(!site.command(&ControllerCommand::Resume).accepted);
            }
        }
    }
    // A pilot's HOLD ends the wait.
    let mut site = held_resume();
    site.pilot(HOLD.0, HOLD.1);
    site.run(5.0);
    assert!(!site.command(&ControllerCommand::Resume).accepted);
    assert_eq!(site.mode(), Mode::Loiter);
}

#[test]
fn a_command_to_a_landing_that_cannot_be_resumed_does_not_end_a_later_one() {
    for command in [ControllerCommand::Abort, ControllerCommand::Hold] {
        let mut site = landing(&[]);
        site.pilot(HOLD.0, HOLD.1);
        site.run(3.0);
        site.restart_controller("resume");
        assert!(site.command(&command).accepted);
        site.run(10.0);
        assert_eq!(site.mode(), Mode::Loiter, "{:?}", site.status());
        let reply = site.command(&ControllerCommand::Start);
        assert!(reply.accepted, "{reply:?}");
        let lands = site.run_until(90.0, |site| site.status().phase == Phase::Landed);
        assert!(lands, "{command:?}: {:?}", site.status());
    }
}

#[test]
fn a_precision_landing_of_a_px4_continues_after_an_interruption() {
    let waiting = |site: &Site| site.status().phase == Phase::Approach;
    for frozen_s in [1.2, 3.0, 8.0] {
        let mut site = Site::new("takeoff", &["mode=landing-target", "landing_target.steady_s=30"]);
        assert!(site.run_until(60.0, waiting), "{:?}", site.status());
        site.run(0.5);
        site.freeze(frozen_s);
        assert_eq!(site.mode(), Mode::Loiter, "its failsafe");
        let lands = site.run_until(90.0, |site| site.status().phase == Phase::Landed);
        assert!(lands, "after {frozen_s} s: {:?}", site.status());
        // A pilot who holds it meanwhile keeps it.
        let mut site = Site::new("takeoff", &["mode=landing-target", "landing_target.steady_s=30"]);
        assert!(site.run_until(60.0, waiting), "{:?}", site.status());
        site.is_frozen = true;
        site.run(frozen_s);
        site.pilot(HOLD.0, HOLD.1);
        site.run(0.5);
        site.is_frozen = false;
        site.requested.clear();
        site.run(10.0);
        assert_eq!(site.mode(), Mode::Loiter, "{:?}", site.status());
        assert!(site.requested.is_empty(), "{:?}", site.requested);
    }
}

#[test]
fn a_landing_continues_after_packets_to_the_px4_alone_were_lost() {
    for lost_s in [1.5, 4.0, 12.0] {
        let mut site = landing(&[]);
        site.uplink_is_lost = true;
        site.run(lost_s);
        let status = site.status();
        assert_eq!((site.mode(), status.phase), (Mode::Loiter, Phase::Hold), "{status:?}");
        site.uplink_is_lost = false;
        let lands = site.run_until(90.0, |site| site.status().phase == Phase::Landed);
        assert!(lands, "after {lost_s} s: {:?}", site.status());
    }
    // After more than 15 s nothing continues without a command.
    let mut site = landing(&[]);
    site.uplink_is_lost = true;
    site.run(20.0);
    site.uplink_is_lost = false;
    site.run(20.0);
    let status = site.status();
    assert_eq!((site.mode(), status.phase), (Mode::Loiter, Phase::PilotInCommand), "{status:?}");
    assert!(site.command(&ControllerCommand::Start).accepted);
    assert!(site.run_until(90.0, |site| site.status().phase == Phase::Landed));
}

#[test]
fn a_pilots_hold_is_recognised_at_once_just_after_an_interruption_as_well() {
    for (main, sub) in [HOLD, POSITION] {
        for is_frozen in [true, false] {
            let mut site = landing(&[]);
            (site.is_frozen, site.uplink_is_lost) = (is_frozen, !is_frozen);
            site.run(3.0);
            assert_eq!((site.mode(), site.chosen()), (Mode::Loiter, FlightMode::OFFBOARD));
            site.pilot(main, sub);
            site.run(0.1);
            let mode = site.mode();
            (site.is_frozen, site.uplink_is_lost) = (false, false);
            site.requested.clear();
            site.run(0.1);
            let status = site.status();
            assert_eq!(status.phase, Phase::PilotInCommand, "{status:?}");
            site.run(10.0);
            assert_eq!(site.mode(), mode, "{:?}", site.status());
            assert!(site.requested.is_empty() && site.status().setpoint.is_none());
        }
    }
}
