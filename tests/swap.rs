//! Detectors that come, go, are swapped and die in flight; and one that is written in Python.
//!
//! The long versions are ignored: `cargo test --test swap -- --ignored --nocapture`; the numbers of swaps and of
//! flights with kills are in ALIGHT_SWAPS and ALIGHT_KILLS.

#![expect(
    clippy::print_stdout,
    reason = "what a test measured, or why it is skipped, is for people to read"
)]

mod flight;

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use messages::{
    ControllerCommand, ControllerStatus, Detections, DetectorCommand, DetectorState, Health,
    TargetEstimate, topic,
};
use node::{Identity, Node, Subscriber, ZenohSource, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use tokio::time::{sleep, timeout};

use crate::flight::{ALIGHT, Landing, ONE_AT_A_TIME, PATIENCE, output_of, python, seconds};

/// Ends processes that outlive those who started them.
#[derive(Default)]
struct Outliving(Vec<Pid>);

impl Drop for Outliving {
    fn drop(&mut self) {
        for pid in &self.0 {
            // Those that were swapped away have ended.
            let _ = kill_process(*pid, Signal::KILL);
        }
    }
}

/// `alight swap --to TO`; its report, and whether its exit status is 0.
fn swap(landing: &Landing, to: &str) -> anyhow::Result<(bool, serde_json::Value)> {
    let output = output_of(
        Command::new(ALIGHT)
            .args(["swap", "--format", "json", "--to", to, "--zenoh"])
            .arg(&landing.zenoh),
    )?;
    let said = String::from_utf8_lossy(&output.stdout);
    let report = said.lines().last().with_context(|| format!("no report: {output:?}"))?;
    Ok((output.status.success(), serde_json::from_str(report)?))
}

fn detectors(landing: &Landing, args: &[&str]) -> anyhow::Result<String> {
    let output = output_of(
        Command::new(ALIGHT).arg("detectors").args(args).arg("--zenoh").arg(&landing.zenoh),
    )?;
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

/// How often something was counted by the controller, by its latest health.
async fn counted(healths: &Subscriber<Health>, what: &str) -> anyhow::Result<u64> {
    let mut last = None;
    // What has arrived meanwhile, and the next second's.
    while let Ok(Some(health)) = timeout(Duration::from_millis(1500), healths.next()).await {
        let is_fresh = seconds(now_ns() - health.stamp_ns) < 0.5;
        last = Some(health);
        if is_fresh {
            break;
        }
    }
    let rates = last.context("no health of the controller")?.rates;
    Ok(rates.iter().find(|rate| rate.name == what).map_or(0, |rate| rate.count))
}

async fn command(landing: &Landing, command: ControllerCommand) -> anyhow::Result<()> {
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{reply:?}");
    Ok(())
}

/// Two versions of a detector, as files.
fn versions(directory: &Path) -> anyhow::Result<[PathBuf; 2]> {
    let [a, b] = ["a.toml", "b.toml"].map(|name| directory.join(name));
    std::fs::write(&a, "id = \"version-a\"\n[tracking]\nenabled = true\n")?;
    std::fs::write(&b, "id = \"version-b\"\nleast_confidence = 0.05\n")?;
    Ok([a, b])
}

const STALE: &str = "ticks without a fresh frame";
const MISSED: &str = "ticks without a fresh frame although there was one";

/// Holds over the pad, swaps again and again, and lands.
async fn swaps(number: usize) -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let directory = tempfile::tempdir()?;
    let versions = versions(directory.path())?;
    let mut outliving = Outliving::default();
    let long = [
        "--timeout-s",
        "3000",
        "--set",
        "controller.phases.hold_timeout_s=600",
        "--set",
        "controller.phases.landing_timeout_s=3000",
    ];
    let landing = Landing::start(&[&["--seed", "21"], &long[..]].concat()).await?;
    let healths = landing.node.subscriber(topic::HEALTH, &["controller", "main"]).await?;
    landing.descends_below(7.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    landing.status("it holds", |s| s.phase == "hold").await?;
    let before = (counted(&healths, STALE).await?, counted(&healths, MISSED).await?);
    let mut used = "main".to_owned();
    let mut took_s = Vec::new();
    for i in 0..number {
        if i % 25 == 24 && i + 3 < number {
            // A hold must not end by its own patience.
            command(&landing, ControllerCommand::Resume).await?;
            command(&landing, ControllerCommand::Hold).await?;
        }
        let file = versions[i % 2].to_str().context("a path")?;
        let (is_done, report) = tokio::task::block_in_place(|| swap(&landing, file))?;
        outliving.0.extend(report["pid"].as_i64().and_then(|pid| Pid::from_raw(pid as i32)));
        ensure!(is_done && report["swapped"] == true, "swap {i}: {report}");
        ensure!(report["from"] == used.as_str() && report["old_stopped"] == true, "{report}");
        used = report["to"].as_str().context("a name")?.to_owned();
        took_s.extend(report["active_s"].as_f64());
        if i + 3 == number {
            command(&landing, ControllerCommand::Resume).await?;
        }
    }
    let after = (counted(&healths, STALE).await?, counted(&healths, MISSED).await?);
    took_s.sort_by(f64::total_cmp);
    println!(
        "{number} swaps, {:.1} s each; ticks {}, without a fresh frame {}, although there was one {}",
        took_s.get(took_s.len() / 2).copied().unwrap_or_default(),
        counted(&healths, "ticks").await.unwrap_or_default(),
        after.0 - before.0,
        after.1 - before.1
    );
    ensure!(after.1 == before.1, "{} ticks missed a frame that was there", after.1 - before.1);
    let result = landing.lands().await?;
    println!("{result}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn detectors_are_swapped_in_flight_without_a_gap() -> anyhow::Result<()> {
    swaps(3).await
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes ten minutes"]
async fn detectors_are_swapped_a_hundred_times() -> anyhow::Result<()> {
    let number = std::env::var("ALIGHT_SWAPS").ok().and_then(|text| text.parse().ok());
    swaps(number.unwrap_or(100)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_swap_that_fails_keeps_the_old_one_and_says_why() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let landing = Landing::start(&["--seed", "22"]).await?;
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    let zenoh = landing.zenoh.display();
    let blind = format!(
        "'{ALIGHT}' detector --set id=blind --set 'markers=[\"apriltag-36h11:5:0.2\"]' --zenoh '{zenoh}'"
    );
    for (to, parts) in [
        (blind.as_str(), &["main stays in use", "agrees in 0 of", "does not see the marker"][..]),
        ("false", &["main stays in use", "the new detector ended"]),
        ("no-such-program --x", &["no-such-program"]),
        ("detector 'x", &["a quote is missing"]),
    ] {
        let output = tokio::task::block_in_place(|| {
            output_of(
                Command::new(ALIGHT).args(["swap", "--to", to, "--zenoh"]).arg(&landing.zenoh),
            )
        })?;
        let said = String::from_utf8_lossy(&[output.stdout.as_slice(), &output.stderr].concat())
            .into_owned();
        ensure!(output.status.code() == Some(1), "{to} ended with {}: {said}", output.status);
        for part in parts {
            ensure!(said.contains(part), "`{part}` is not in: {said}");
        }
    }
    let listed = tokio::task::block_in_place(|| detectors(&landing, &[]))?;
    println!("{listed}");
    ensure!(listed.contains("Used: main") && listed.contains("rings:0.15341"), "{listed}");
    let answer = tokio::task::block_in_place(|| detectors(&landing, &["prefer", "ground"]))?;
    ensure!(answer.contains("accepted") && answer.contains("none yet"), "{answer}");
    let answer = tokio::task::block_in_place(|| detectors(&landing, &["use", "nobody"]))?;
    ensure!(answer.contains("refused") && answer.contains("there is: main"), "{answer}");
    command(&landing, ControllerCommand::Resume).await?;
    landing.lands().await?;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_detector_in_python_lands_it() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let marker = "aruco-4x4-50:7:0.3";
    let script = "../detector/examples/python/detector.py";
    let Some(probe) = python(script, &["--help"])? else { return Ok(()) };
    if probe.wait_with_output()?.status.code() == Some(77) {
        println!("skipped: eclipse-zenoh, numpy or opencv-python-headless is missing");
        return Ok(());
    }
    let landing = Landing::start(&["--seed", "23", "--marker", marker]).await?;
    let file = landing.zenoh.to_str().context("a path")?.to_owned();
    // A landing whose detector ends before it began would be broken off.
    landing.descends_below(9.5).await?;
    let python = python(script, &["--id", "python", "--marker", marker, "--zenoh", &file])?;
    let mut python = python.context("it started a moment ago")?;
    let flown = async {
        landing
            .status("the Python detector agrees in shadow", |s| {
                let python = s.candidates.iter().find(|c| c.detector == "python");
                python.is_some_and(|c| c.state == DetectorState::Shadow && c.agreed >= 10)
            })
            .await?;
        command(&landing, ControllerCommand::UseDetector("python".into())).await?;
        let stopped = landing
            .node
            .command(topic::DETECTOR_COMMAND, &["main"], &DetectorCommand::Stop)
            .await?;
        ensure!(stopped.accepted, "{stopped:?}");
        landing
            .status("it is alone", |s| {
                s.candidates.iter().all(|c| c.detector == "python" || !c.alive)
            })
            .await?;
        let listed = tokio::task::block_in_place(|| detectors(&landing, &[]))?;
        println!("{listed}");
        ensure!(listed.contains("python, OpenCV"), "{listed}");
        let node = landing.node.clone();
        let result = landing.lands().await?;
        println!("{result}");
        let bye =
            node.command(topic::DETECTOR_COMMAND, &["python"], &DetectorCommand::Stop).await?;
        ensure!(bye.accepted, "{bye:?}");
        anyhow::Ok(())
    };
    let flown = flown.await;
    sleep(Duration::from_millis(500)).await;
    let ended = python.try_wait()?;
    let _ = python.kill();
    let _ = python.wait();
    flown?;
    ensure!(ended.is_some_and(|status| status.success()), "{ended:?} after it was told to stop");
    Ok(())
}

/// Waits until a status holds; the answer is how long after a moment.
async fn after(
    landing: &Landing,
    since_ns: i64,
    what: &str,
    holds: impl Fn(&ControllerStatus) -> bool,
) -> anyhow::Result<f64> {
    let status = landing.status(what, |s| s.stamp_ns > since_ns && holds(s)).await?;
    Ok(seconds(status.stamp_ns - since_ns))
}

/// What was noticed how long after a kill, and when all was well again, in seconds.
type Times = Vec<(&'static str, f64, f64)>;

/// One flight in which each process is killed once, at a moment of its own.
async fn kills(round: u64, times: &mut Times) -> anyhow::Result<()> {
    let seed = (30 + round).to_string();
    let mut landing = Landing::start(&["--seed", &seed]).await?;
    let presence = landing.node.presence("gcs-bridge").await?;
    let active =
        |name: &'static str| move |s: &ControllerStatus| s.active_detector.as_deref() == Some(name);
    landing.status("the first detector is used", active("main")).await?;
    let shadow = landing.start_by_hand("detector", &["id=spare"])?;
    let is_shadow = |s: &ControllerStatus| {
        s.candidates.iter().any(|c| c.detector == "spare" && c.state == DetectorState::Shadow)
    };
    landing.status("the second stands by", is_shadow).await?;
    landing.status("it has taken off", |s| s.phase != "takeoff" && s.phase != "idle").await?;
    // A moment that differs from round to round, by less than a frame and by more.
    sleep(Duration::from_millis(300 + round * 137 % 900)).await;

    kill_process(shadow, Signal::KILL)?;
    let killed_ns = now_ns();
    let gone =
        |s: &ControllerStatus| s.candidates.iter().all(|c| c.detector != "spare" || !c.alive);
    let noticed_s = after(&landing, killed_ns, "the shadow's end is noticed", gone).await?;
    landing.start_by_hand("detector", &["id=spare"])?;
    let back_s = after(&landing, killed_ns, "the shadow is back", is_shadow).await?;
    times.push(("detector in shadow", noticed_s, back_s));

    sleep(Duration::from_millis(round * 71 % 400)).await;
    let killed_ns = landing.kill("detector")?;
    let noticed_s = after(&landing, killed_ns, "the spare one is used", active("spare")).await?;
    let fresh = |s: &ControllerStatus| {
        s.active_detector.as_deref() == Some("spare")
            && s.detection_age_ms.is_some_and(|age| age < 250.0)
    };
    let well_s = after(&landing, killed_ns, "its detections are used", fresh).await?;
    times.push(("detector in use", noticed_s, well_s));

    let killed_ns = landing.kill("gcs-bridge")?;
    let left = async { while presence.next().await.is_some_and(|(_, alive)| alive) {} };
    timeout(PATIENCE, left).await?;
    let noticed_s = seconds(now_ns() - killed_ns);
    landing.start_by_hand("gcs-bridge", &[])?;
    timeout(PATIENCE, presence.next()).await?;
    times.push(("gcs-bridge", noticed_s, seconds(now_ns() - killed_ns)));

    sleep(Duration::from_millis(round * 53 % 400)).await;
    let killed_ns = landing.kill("controller")?;
    // Its supervisor notices the end of the process at once.
    landing.start_by_hand("controller", &[])?;
    let lands_again = |s: &ControllerStatus| {
        s.started_ns.is_some() && s.setpoint.is_some() || s.phase == "landed"
    };
    let well_s = after(&landing, killed_ns, "the next controller steers", lands_again).await?;
    times.push(("controller", 0.0, well_s));
    let result = landing.lands().await?;
    let speed_m_s = result["touchdown_speed_m_s"].as_f64().context("a speed")?;
    ensure!(speed_m_s < 1.0, "touched down at {speed_m_s} m/s");
    Ok(())
}

fn print_times(times: &Times) {
    println!(
        "{:20} {:>5} {:>22} {:>22}",
        "killed", "times", "noticed, median / max", "well, median / max"
    );
    for name in ["detector in shadow", "detector in use", "gcs-bridge", "controller"] {
        let column = |pick: fn(&(&'static str, f64, f64)) -> f64| {
            let mut column: Vec<f64> = times.iter().filter(|it| it.0 == name).map(pick).collect();
            column.sort_by(f64::total_cmp);
            let median = column.get(column.len() / 2).copied().unwrap_or_default();
            (
                column.len(),
                format!("{median:.2} / {:.2} s", column.last().copied().unwrap_or_default()),
            )
        };
        let ((number, noticed), (_, well)) = (column(|it| it.1), column(|it| it.2));
        println!("{name:20} {number:>5} {noticed:>22} {well:>22}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn processes_that_are_killed_are_missed_and_replaced_and_it_lands() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let mut times = Times::new();
    kills(0, &mut times).await?;
    print_times(&times);
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "takes ten minutes"]
async fn processes_are_killed_at_many_moments() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let rounds = std::env::var("ALIGHT_KILLS").ok().and_then(|text| text.parse().ok());
    let mut times = Times::new();
    for round in 1..=rounds.unwrap_or(20) {
        let flown = kills(round, &mut times).await;
        print_times(&times);
        flown.with_context(|| format!("round {round}"))?;
    }
    Ok(())
}

/// Ages at which frames were used over a time, in ms: median and 99th percentile.
async fn ages(targets: &Subscriber<TargetEstimate>, over: Duration) -> anyhow::Result<[f64; 2]> {
    while timeout(Duration::from_millis(1), targets.next()).await.is_ok() {}
    let mut ages = Vec::new();
    let _ = timeout(over, async {
        while let Some(target) = targets.next().await {
            ages.extend(target.age_ms);
        }
    })
    .await;
    ages.sort_by(f64::total_cmp);
    let at = |part: f64| ages.get((part * (ages.len().max(1) - 1) as f64) as usize).copied();
    Ok([at(0.5).context("no frame was used")?, at(0.99).context("no frame was used")?])
}

/// Publishes what a detector publishes once more, in the names of ten others.
async fn ten_more(node: Node, tens: usize) -> anyhow::Result<()> {
    let mut others = Vec::new();
    for i in 0..10 {
        let name = format!("extra-{tens}{i}");
        let publisher = node.publisher(topic::DETECTIONS, &[&name]).await?;
        others.push((name, publisher));
    }
    let seen = node.subscriber(topic::DETECTIONS, &["main"]).await?;
    while let Some(message) = seen.next().await {
        for (name, publisher) in &others {
            publisher.publish(&Detections { detector: name.clone(), ..message.clone() }).await;
        }
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn twenty_detectors_and_ten_dashboards_leave_the_controls_latency_as_it_was()
-> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    let landing = Landing::start(&["--seed", "24"]).await?;
    let open = async |instance: String| {
        let identity = Identity { service: "alight", instance };
        Node::open(identity, &ZenohSource::File(landing.zenoh.clone())).await
    };
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    let targets = landing.node.subscriber(topic::TARGET, &[]).await?;
    let [alone_ms, alone_99_ms] = ages(&targets, Duration::from_secs(8)).await?;
    let mut tasks = Vec::new();
    for tens in 0..2 {
        tasks.push(tokio::spawn(ten_more(open(format!("extra-{tens}")).await?, tens)));
    }
    for i in 0..10 {
        let node = open(format!("dashboard-{i}")).await?;
        tasks.push(tokio::spawn(async move {
            let statuses = node.subscriber(topic::STATUS, &[]).await?;
            let vehicles = node.subscriber(topic::VEHICLE_STATE, &[]).await?;
            let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
            let targets = node.subscriber(topic::TARGET, &[]).await?;
            loop {
                tokio::select! {
                    Some(_) = statuses.next() => {}
                    Some(_) = vehicles.next() => {}
                    Some(_) = detections.next() => {}
                    Some(_) = targets.next() => {}
                    else => return Ok(()),
                }
            }
        }));
    }
    let many = landing.status("all are known", |s| s.candidates.len() == 21).await?;
    ensure!(many.active_detector.as_deref() == Some("main"), "{:?}", many.active_detector);
    let [many_ms, many_99_ms] = ages(&targets, Duration::from_secs(8)).await?;
    println!(
        "stamp to use, median / 99 %: alone {alone_ms:.1} / {alone_99_ms:.1} ms; with 20 more detectors and 10 \
         dashboards {many_ms:.1} / {many_99_ms:.1} ms: {:.2} times",
        many_ms / alone_ms
    );
    for task in tasks {
        task.abort();
    }
    ensure!(many_ms < 2.0 * alone_ms, "{many_ms:.1} ms instead of {alone_ms:.1}");
    command(&landing, ControllerCommand::Resume).await?;
    landing.lands().await?;
    Ok(())
}
