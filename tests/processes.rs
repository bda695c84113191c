//! Tests `alight land` as processes: landings next to other programs, controllers, detectors and the landing itself killed in
//! flight, aborts, two landings at once, ports that are taken, wrong settings.
//!
//! A test that flies waits until the machine has time for it, flies `alight land` in real time, and joins its network
//! as one more process.

use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, ensure};
use messages::{ControllerCommand, DetectorCommand, Phase, Touchdown, topic};
use node::now_ns;
use rustix::process::{Pid, Signal, kill_process};
use testing::{ports, python, python_passes, skip, with_second_try};

use crate::flight::{
    ALIGHT, Landing, Vehicle, beside_another, descent_m_s, output_of, seconds, speed_m_s, time_for,
};

/// Longest time that the processes of a landing which was killed may run on.
const MAX_ORPHANED: Duration = Duration::from_secs(6);
/// Exit status of a script that lacks a package.
const LACKS_MAVSDK: i32 = 77;

#[tokio::test(flavor = "multi_thread")]
async fn it_lands_with_other_programs_watching_and_without_the_ground_station() -> anyhow::Result<()>
{
    with_second_try(others_watch_and_the_ground_dies).await
}

async fn others_watch_and_the_ground_dies() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let ([], _, ground) = ports::free()?;
    let address = format!("gcs-bridge.ground=udpout:127.0.0.1:{ground}");
    let connect = ["--connect", &format!("udpin:127.0.0.1:{ground}")];
    let station = python("tests/gcs/ground_station.py", &connect);
    let landing = Landing::start(&["--seed", "2", "--set", &address]).await?;
    landing.descends_below(9.0).await?;
    // It waits at this height for the other programs, which start slowly.
    command(&landing, ControllerCommand::Hold).await?;
    let port = std::fs::read_to_string(&landing.zenoh)?
        .split("connect: {")
        .nth(1)
        .and_then(|rest| rest.split("127.0.0.1:").nth(1)?.split('"').next().map(str::to_owned))
        .context("the rendezvous port")?;
    let client = python("tests/zenoh_client.py", &[&format!("tcp/127.0.0.1:{port}")]);
    if let Some(client) = client {
        tokio::task::block_in_place(|| python_passes(&client.wait_with_output()?))?;
    }
    if let Some(station) = station {
        tokio::task::block_in_place(|| python_passes(&station.wait_with_output()?))?;
    }
    command(&landing, ControllerCommand::Resume).await?;
    landing.descends_below(8.0).await?;
    landing.kill("gcs-bridge")?;
    check_result_values(&landing.lands().await?)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_of_mavsdk_finds_the_vehicle_its_parameters_and_its_camera() -> anyhow::Result<()>
{
    let _flight = beside_another().await?;
    with_second_try(async || {
        let ([], _, ground) = ports::free()?;
        let address = format!("gcs-bridge.ground=udpout:127.0.0.1:{ground}");
        let video = "gcs-bridge.video='rtsp://10.0.0.2:8554/down'";
        let landing = Landing::start(&["--seed", "2", "--set", &address, "--set", video]).await?;
        landing.descends_below(9.0).await?;
        command(&landing, ControllerCommand::Hold).await?;
        let connect = format!("udpin://127.0.0.1:{ground}");
        let station = "tests/gcs/mavsdk_station.py";
        let Some(station) = python(station, &["--camera", "--connect", &connect]) else {
            return Ok(());
        };
        let output = tokio::task::block_in_place(|| station.wait_with_output())?;
        let said = String::from_utf8_lossy(&output.stdout);
        println!("{said}");
        if output.status.code() == Some(LACKS_MAVSDK) {
            skip("mavsdk", said.trim());
            return Ok(());
        }
        let found: serde_json::Value =
            serde_json::from_str(said.lines().last().context("nothing was printed")?)?;
        ensure!(found["ok"] == true && output.status.success(), "{found}");
        ensure!(found["camera"]["model"] == "down", "{found}");
        ensure!(found["camera"]["size"] == serde_json::json!([648, 486]), "{found}");
        ensure!(found["video"] == "rtsp://10.0.0.2:8554/down", "{found}");
        ensure!(found["parameters"].as_u64().is_some_and(|it| it > 5), "{found}");
        command(&landing, ControllerCommand::Resume).await?;
        landing.lands().await.map(drop)
    })
    .await
}

/// The result of a landing has all values that it should contain.
fn check_result_values(result: &serde_json::Value) -> anyhow::Result<()> {
    for key in [
        "time_to_disarm_s",
        "time_to_touchdown_s",
        "touchdown_error_m",
        "touchdown_speed_m_s",
        "max_tilt_deg",
        "detections",
        "frames",
    ] {
        ensure!(result[key].is_number(), "`{key}` is {}", result[key]);
    }
    ensure!(result["outcome"] == "landed");
    // Later than that a detection is too old to be steered by.
    let latency_ms = result["latency_ms"]["p50"].as_f64().context("latency_ms.p50")?;
    ensure!(latency_ms > 0.0 && latency_ms < 500.0, "{latency_ms} ms from frame to command");
    let processes = result["processes"].as_array().context("processes")?;
    for service in ["simulator", "detector", "controller"] {
        let cost = processes.iter().find(|p| p["service"] == service).context(service)?;
        ensure!(cost["cpu_percent"].as_f64().is_some_and(|percent| percent > 0.0), "{cost}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn without_controller_or_detector_it_stops_and_lands_with_the_next_one() -> anyhow::Result<()>
{
    let _flight = beside_another().await?;
    with_second_try(controller_and_detector_die_in_turn).await
}

async fn controller_and_detector_die_in_turn() -> anyhow::Result<()> {
    // Slowly: this process may be late.
    let slowly = "controller.metric.max_descend_m_s=0.8";
    let mut landing =
        Landing::start(&["--seed", "4", "--set", slowly, "--timeout-s", "200"]).await?;
    landing.descends_below(9.0).await?;
    without_a_controller_the_autopilot_stops_it(&landing).await?;
    landing.start_by_hand("controller", &["metric.max_descend_m_s=0.8"])?;
    landing.descends_below(6.0).await?;
    without_a_detector_it_stops_descending(&landing).await?;
    landing.start_by_hand("detector", &["id=second"])?;
    landing
        .status("the second detector is used", |s| {
            s.active_detector.as_deref() == Some("second") && s.phase == Phase::Descend
        })
        .await?;
    landing.lands().await?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_controller_killed_at_any_height_lets_nothing_hit_the_ground() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(the_controller_is_killed_again_and_again).await
}

async fn the_controller_is_killed_again_and_again() -> anyhow::Result<()> {
    let mut landing = Landing::start(&["--seed", "6"]).await?;
    let mut resumed: Option<Pid> = None;
    for height_m in [5.0, 3.0, 1.5] {
        landing.descends_below(height_m).await?;
        let killed_ns = match resumed {
            None => landing.kill("controller")?,
            Some(pid) => {
                kill_process(pid, Signal::KILL)?;
                now_ns()
            }
        };
        let stopped = landing
            .truth("the vehicle has stopped or stands", |t| {
                seconds(t.stamp_ns - killed_ns) > 0.3 && (t.on_ground || speed_m_s(t) < 0.1)
            })
            .await?;
        println!(
            "killed below {height_m} m: stopped after {:.1} s at {:.1} m",
            seconds(stopped.stamp_ns - killed_ns),
            -stopped.position_ned_m[2]
        );
        if let Some(touchdown) = stopped.touchdown {
            ensure!(is_soft(&touchdown), "it hit the ground: {touchdown:?}");
            return Ok(());
        }
        resumed = Some(landing.start_by_hand("controller", &[])?);
    }
    landing.lands().await?;
    Ok(())
}

/// The landing leads another simulated vehicle: its own simulator would end with the kill.
#[tokio::test(flavor = "multi_thread")]
async fn a_landing_killed_in_the_descent_takes_its_processes_with_it_and_lets_nothing_hit_the_ground()
-> anyhow::Result<()> {
    for height_m in [3.0, 0.7] {
        let _flight = time_for(2).await?;
        with_second_try(|| a_landing_is_killed(height_m)).await?;
    }
    Ok(())
}

async fn a_landing_is_killed(height_m: f64) -> anyhow::Result<()> {
    let vehicle = Vehicle::start().await?;
    let mut landing = Landing::start(&["--seed", "4", "--autopilot", &vehicle.address]).await?;
    landing.descends_below(height_m).await?;
    landing.land.kill()?;
    let killed = Instant::now();
    landing.land.wait()?;
    let mut motion = Vec::new();
    while landing.services.iter().any(|it| runs(it.pid)) && killed.elapsed() < MAX_ORPHANED {
        motion.extend(vehicle.motion(Duration::from_millis(20)).await);
    }
    let ended_s = killed.elapsed().as_secs_f64();
    let left: Vec<_> = landing.services.iter().filter(|it| runs(it.pid)).collect();
    for service in &left {
        let _ = kill_process(service.pid, Signal::KILL);
    }
    let left: Vec<_> = left.iter().map(|it| &it.name).collect();
    ensure!(left.is_empty(), "{left:?} outlive their landing by {MAX_ORPHANED:?}");
    motion.extend(vehicle.motion(Duration::from_secs(8)).await);
    let last = motion.last().context("no truth of the vehicle was received")?;
    println!(
        "killed below {height_m} m: its processes ended after {ended_s:.1} s, the vehicle is at {:.2} m; {:?}",
        last.pad_ned_m[2] - last.position_ned_m[2],
        last.touchdown
    );
    ensure!(last.on_ground || speed_m_s(last) < 0.1, "it still moves: {last:?}");
    ensure!(last.touchdown.as_ref().is_none_or(is_soft), "it hit the ground: {last:?}");
    Ok(())
}

/// Whether a process that is not a child of ours runs; one that has ended stays as a zombie if no process waits for orphans.
fn runs(pid: Pid) -> bool {
    let stat = std::fs::read_to_string(format!("/proc/{}/stat", pid.as_raw_nonzero()));
    let state = stat.ok().and_then(|stat| stat.rsplit_once(')')?.1.trim_start().chars().next());
    state.is_some_and(|state| state != 'Z')
}

fn is_soft(touchdown: &Touchdown) -> bool {
    touchdown.vertical_speed_m_s <= 0.8 && touchdown.lateral_speed_m_s <= 0.3
}

async fn without_a_controller_the_autopilot_stops_it(landing: &Landing) -> anyhow::Result<()> {
    let killed_ns = landing.kill("controller")?;
    let stopped = landing
        .truth("the autopilot has stopped it", |t| {
            seconds(t.stamp_ns - killed_ns) > 3.0 && speed_m_s(t) < 0.15
        })
        .await?;
    println!(
        "stopped after {:.1} s at {:.1} m",
        seconds(stopped.stamp_ns - killed_ns),
        -stopped.position_ned_m[2]
    );
    ensure!(!stopped.on_ground, "it came down without a controller");
    Ok(())
}

async fn without_a_detector_it_stops_descending(landing: &Landing) -> anyhow::Result<()> {
    let killed_ns = landing.kill("detector")?;
    let mut descended_s: f64 = 0.0;
    let stopped = landing
        .status("no descent is requested", |s| {
            let is_later = s.stamp_ns > killed_ns;
            let descends = s.setpoint.is_some_and(|s| s.velocity_ned_m_s[2] > 0.0);
            if is_later && descends {
                descended_s = descended_s.max(seconds(s.stamp_ns - killed_ns));
            }
            is_later && !descends
        })
        .await?;
    let after_s = seconds(stopped.stamp_ns - killed_ns);
    println!("descent last requested after {descended_s:.2} s, no longer after {after_s:.2} s");
    ensure!(descended_s <= 0.5, "descent still requested {descended_s:.2} s after the kill");
    let still = landing
        .truth("it is stationary", |t| t.stamp_ns > killed_ns && descent_m_s(t).abs() < 0.1)
        .await?;
    println!("descent ended after {:.2} s", seconds(still.stamp_ns - killed_ns));
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    // Drained first: the next messages are the motion from now on.
    landing.motion(Duration::from_millis(100)).await;
    let motion = landing.motion(Duration::from_secs(2)).await;
    let fastest = motion.iter().map(speed_m_s).fold(0.0, f64::max);
    ensure!(!motion.is_empty() && fastest < 0.25, "it moves at {fastest:.2} m/s while it holds");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_detectors_the_chosen_one_is_active_and_the_other_takes_over() -> anyhow::Result<()>
{
    let _flight = beside_another().await?;
    with_second_try(two_detectors_take_turns).await
}

async fn two_detectors_take_turns() -> anyhow::Result<()> {
    let mut landing = Landing::start(&["--seed", "5"]).await?;
    landing.status("a detector is active", |s| s.active_detector.is_some()).await?;
    landing.start_by_hand("detector", &["id=spare"])?;
    let both = landing
        .status("both are named", |s| s.candidates.iter().filter(|c| c.alive).count() == 2)
        .await?;
    ensure!(both.active_detector.as_deref() == Some("main"), "{both:?}");
    the_operators_choice_is_followed(&landing).await?;
    // The landing continues without the detector of its start, also before the take-off.
    let stopped =
        landing.node.command(topic::DETECTOR_COMMAND, &["main"], &DetectorCommand::Stop).await?;
    ensure!(stopped.accepted, "{stopped:?}");
    landing
        .status("the first one is gone", |s| {
            s.candidates.iter().all(|c| c.detector != "main" || !c.alive)
        })
        .await?;
    let third = landing.start_by_hand("detector", &["id=third"])?;
    landing
        .status("the third one is there", |s| {
            s.candidates.iter().any(|c| c.detector == "third" && c.alive)
        })
        .await?;
    // Hold and resume on the way down.
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    command(&landing, ControllerCommand::UseDetector("third".into())).await?;
    landing
        .status("the third one is active", |s| s.active_detector.as_deref() == Some("third"))
        .await?;
    command(&landing, ControllerCommand::Resume).await?;
    landing.descends_below(8.0).await?;
    kill_process(third, Signal::KILL)?;
    let killed_ns = now_ns();
    let mut named_s: f64 = 0.0;
    let handed_over = landing
        .status("the spare one is active", |s| {
            let is_active = s.active_detector.as_deref() == Some("spare");
            if s.stamp_ns > killed_ns && !is_active {
                named_s = named_s.max(seconds(s.stamp_ns - killed_ns));
            }
            is_active
        })
        .await?;
    let after_s = seconds(handed_over.stamp_ns - killed_ns);
    println!("the killed one last named after {named_s:.3} s, handed over after {after_s:.3} s");
    ensure!(named_s <= 0.5, "the killed one was still active {named_s:.3} s after its end");
    let result = landing.lands().await?;
    println!("{result}");
    Ok(())
}

async fn the_operators_choice_is_followed(landing: &Landing) -> anyhow::Result<()> {
    let absent = ControllerCommand::UseDetector("nobody".into());
    let refused = landing.node.command(topic::COMMAND, &[], &absent).await?;
    ensure!(!refused.accepted && refused.reason.contains("main"), "{refused:?}");
    let output = output_of(
        Command::new(ALIGHT)
            .args(["command", "use-detector", "spare", "--zenoh"])
            .arg(&landing.zenoh),
    )?;
    ensure!(output.status.success(), "{output:?}");
    landing
        .status("the spare one is active", |s| s.active_detector.as_deref() == Some("spare"))
        .await?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_touchdown_after_an_abort_is_not_reported_as_a_landing() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    for on_abort in ["hover", "land"] {
        with_second_try(async || comes_down_after_an_abort(on_abort).await).await?;
    }
    Ok(())
}

async fn comes_down_after_an_abort(on_abort: &str) -> anyhow::Result<()> {
    let on = format!("controller.phases.on_abort={on_abort}");
    let landing = Landing::start(&["--seed", "6", "--set", &on]).await?;
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Abort).await?;
    let expected = match on_abort {
        "hover" => {
            command(&landing, ControllerCommand::LandHere).await?;
            "the operator's command to land here; it touched down "
        }
        _ => "aborted by the operator; it touched down ",
    };
    let (result, status) = landing.ends().await?;
    ensure!(status == Some(1), "{status:?}: {result}");
    ensure!(result["landed"] == false && result["down"] == true, "{result}");
    let outcome = result["outcome"].as_str().context("outcome")?;
    ensure!(
        outcome.starts_with(expected) && outcome.contains("from the pad's centre"),
        "{outcome}"
    );
    Ok(())
}

async fn command(landing: &Landing, command: ControllerCommand) -> anyhow::Result<()> {
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{reply:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_second_controller_and_a_port_in_use_are_refused_in_words() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(a_second_one_is_refused).await
}

async fn a_second_one_is_refused() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let recording = folder.path().join("flight.mcap");
    let file = recording.to_string_lossy();
    let mut landing = Landing::start(&["--seed", "7", "--record", &file]).await?;
    landing.status("the controller is there", |_| true).await?;
    let second =
        output_of(Command::new(ALIGHT).args(&landing.service("controller")?.by_hand).args([
            "--set",
            "id=second",
            "--set",
            "autopilot.address=udpin:127.0.0.1:0",
        ]))?;
    let said = String::from_utf8_lossy(&second.stderr);
    ensure!(second.status.code() == Some(1), "{second:?}");
    ensure!(said.contains("another controller (`main`) is running for this vehicle"), "{said}");
    let twin = output_of(Command::new(ALIGHT).args(&landing.service("detector")?.by_hand))?;
    let said = String::from_utf8_lossy(&twin.stderr);
    ensure!(
        twin.status.code() == Some(1) && said.contains("has the name `main` already"),
        "{said}"
    );
    // The first still flies; in its descent it is asked to stop, and stops all of its services, the recorder last.
    landing.status("it descends", |status| status.phase == Phase::Descend).await?;
    let pids: Vec<Pid> = landing.services.iter().map(|s| s.pid).collect();
    kill_process(Pid::from_raw(i32::try_from(landing.land.id())?).context("pid")?, Signal::TERM)?;
    let status = tokio::task::block_in_place(|| landing.land.wait())?;
    ensure!(status.code() == Some(1), "an interrupted landing ends with {status}");
    for pid in pids {
        ensure!(rustix::process::test_kill_process(pid).is_err(), "{pid:?} still runs");
    }
    let replay = output_of(Command::new(ALIGHT).args(["replay", &file, "--verify"]))?;
    let said = [&replay.stdout[..], &replay.stderr].concat();
    let said = String::from_utf8_lossy(&said);
    ensure!(replay.status.success() && said.contains("verified"), "{said}");
    ensure!(!said.contains("has no end"), "{said}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn two_landings_that_begin_at_once_both_land() -> anyhow::Result<()> {
    let _flights = time_for(2).await?;
    with_second_try(async || {
        let options = [&["--seed", "11"][..], &["--seed", "12", "--vehicle", "kestrel"]];
        let landings =
            options.map(|it| tokio::spawn(async move { Landing::start(it).await?.lands().await }));
        for landing in landings {
            landing.await??;
        }
        Ok(())
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_link_whose_port_is_taken_reports_it() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let taken = std::net::UdpSocket::bind("127.0.0.1:0")?;
    let port = taken.local_addr()?.port();
    let directory = tempfile::tempdir()?;
    let zenoh = directory.path().join("zenoh.json5");
    let ([free], _, _) = ports::free()?;
    std::fs::write(&zenoh, node::session::local_config(free))?;
    let output = output_of(
        Command::new(ALIGHT)
            .args([
                "controller",
                "--set",
                &format!("autopilot.address=udpin:127.0.0.1:{port}"),
                "--zenoh",
            ])
            .arg(&zenoh),
    )?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(output.status.code() == Some(1), "{output:?}");
    ensure!(said.contains(&format!("port {port} is already in use")), "{said}");
    Ok(())
}

#[test]
fn wrong_settings_stop_the_start_with_file_key_value_and_limit() -> anyhow::Result<()> {
    let check = |args: &[&str], parts: &[&str]| {
        let output = output_of(Command::new(ALIGHT).args(args).stdin(Stdio::null()))?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        ensure!(output.status.code() == Some(2), "{args:?} ended with {}: {said}", output.status);
        for part in parts {
            ensure!(said.contains(part), "`{part}` is not in the output of {args:?}: {said}");
        }
        anyhow::Ok(())
    };
    let directory = tempfile::tempdir()?;
    let file = directory.path().join("mine.toml");
    std::fs::write(&file, "[phases]\nhold_timeout_s = 9999\n")?;
    let path = file.to_str().context("path")?;
    check(
        &["controller", "--config", path],
        &["mine.toml", "phases.hold_timeout_s", "9999", "from 1 to 600"],
    )?;
    check(&["controller", "--config", "no/such.toml"], &["no/such.toml", "check the path"])?;
    check(&["detector", "--set", "marker=rings"], &["no key `marker`", "did you mean `markers`?"])?;
    check(&["simulator", "--set", "wind.mean_m_s=99"], &["wind.mean_m_s", "99", "from 0 to 20"])?;
    check(&["land", "--set", "wind.mean_m_s=5"], &["begins with its service", "simulator."])?;
    check(&["land", "--guidance", "magic"], &["magic"])?;
    check(&["land", "--autopilot", "usb"], &["usb"])?;
    check(&["config", "detector", "--set", "camera=a/b"], &["camera", "letters, digits"])?;
    check(&["fly"], &["fly"])?;
    Ok(())
}
