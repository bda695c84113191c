//! Tests detectors in flight: `alight swap`, failed swaps, twenty more detectors with ten dashboards, and a
//! detector written in Python that leads a landing. `measure.rs` swaps them more often.

use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use messages::{
    ControllerCommand, Detections, DetectorCommand, DetectorState, TargetEstimate, topic,
};
use node::{Identity, Node, Subscriber, ZenohSource};
use testing::{python, python_passes, with_second_try};
use tokio::time::{sleep, timeout};

use crate::flight::{ALIGHT, Landing, PATIENCE, beside_another, output_of, time_for};
use crate::swaps::{self, command};

fn detectors(landing: &Landing, args: &[&str]) -> anyhow::Result<String> {
    let output = output_of(
        Command::new(ALIGHT).arg("detectors").args(args).arg("--zenoh").arg(&landing.zenoh),
    )?;
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

#[tokio::test(flavor = "multi_thread")]
async fn detectors_are_swapped_in_flight_without_a_gap() -> anyhow::Result<()> {
    with_second_try(async || {
        // A machine without time for it may skip this; a failure may not be ignored.
        if !swaps::swaps(3).await? && !swaps::swaps(3).await? {
            testing::skip("time", "frames were late for every detector");
        }
        Ok(())
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_detector_in_python_lands_it() -> anyhow::Result<()> {
    with_second_try(python_lands_it).await
}

async fn python_lands_it() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let marker = "aruco-4x4-50:7:0.3";
    let script = "detector/examples/python/detector.py";
    let Some(probe) = python(script, &["--help"]) else { return Ok(()) };
    if !python_passes(&probe.wait_with_output()?)? {
        return Ok(());
    }
    let landing = Landing::start(&["--seed", "23", "--marker", marker]).await?;
    let file = landing.zenoh.to_str().context("a path")?.to_owned();
    // A landing whose detector ends before it began would be broken off.
    landing.descends_below(9.5).await?;
    let python = python(script, &["--id", "python", "--marker", marker, "--zenoh", &file]);
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
    // Closing its session takes Zenoh a while.
    let mut ended = python.try_wait()?;
    let stopped = std::time::Instant::now();
    while flown.is_ok() && ended.is_none() && stopped.elapsed() < PATIENCE / 4 {
        sleep(Duration::from_millis(50)).await;
        ended = python.try_wait()?;
    }
    let _ = python.kill();
    let _ = python.wait();
    flown?;
    ensure!(ended.is_some_and(|status| status.success()), "{ended:?} after its command to stop");
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

/// Publishes the messages of a detector again, in the names of ten others.
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
async fn failed_swaps_and_twenty_more_detectors_change_nothing() -> anyhow::Result<()> {
    with_second_try(swaps_fail_and_many_publish).await
}

async fn swaps_fail_and_many_publish() -> anyhow::Result<()> {
    let _flight = time_for(3).await?;
    let landing = Landing::start(&["--seed", "22"]).await?;
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    tokio::task::block_in_place(|| {
        a_swap_that_fails_keeps_the_old_one_and_reports_the_reason(&landing)
    })?;
    twenty_detectors_and_ten_dashboards_leave_the_latency_as_it_was(&landing).await?;
    command(&landing, ControllerCommand::Resume).await?;
    landing.lands().await?;
    Ok(())
}

fn a_swap_that_fails_keeps_the_old_one_and_reports_the_reason(
    landing: &Landing,
) -> anyhow::Result<()> {
    let zenoh = landing.zenoh.display();
    let blind = format!(
        "'{ALIGHT}' detector --set id=blind --set 'markers=[\"apriltag-36h11:5:0.2\"]' --zenoh '{zenoh}'"
    );
    let wrong_size = format!(
        "'{ALIGHT}' detector --set id=large --set 'markers=[\"rings:0.199433\"]' --zenoh '{zenoh}'"
    );
    for (to, parts) in [
        (
            blind.as_str(),
            &["main stays in use", "agrees in only 0 of", "does not see the marker"][..],
        ),
        (
            wrong_size.as_str(),
            &[
                "main stays in use",
                "agrees in only 0 of",
                "m from where `main` does",
                "m farther, in the camera's view",
                "`detectors.tolerance_m` of the controller, 0.1",
                "as where the marker's size or the focal length is given 30 % larger",
            ],
        ),
        ("false", &["main stays in use", "the new detector exited"]),
        ("no-such-program --x", &["no-such-program"]),
        ("detector 'x", &["a quote is missing"]),
    ] {
        let output = output_of(
            Command::new(ALIGHT).args(["swap", "--to", to, "--zenoh"]).arg(&landing.zenoh),
        )?;
        let said = String::from_utf8_lossy(&[output.stdout.as_slice(), &output.stderr].concat())
            .into_owned();
        // Only an invalid command line is a wrong use.
        let status = if to.contains('\'') && !to.contains(ALIGHT) { 2 } else { 1 };
        ensure!(output.status.code() == Some(status), "{to} ended with {}: {said}", output.status);
        for part in parts {
            ensure!(said.contains(part), "`{part}` is not in: {said}");
        }
    }
    let listed = detectors(landing, &[])?;
    println!("{listed}");
    ensure!(listed.contains("Used: main") && listed.contains("rings:0.15341"), "{listed}");
    let answer = detectors(landing, &["prefer", "ground"])?;
    ensure!(answer.contains("accepted") && answer.contains("none yet"), "{answer}");
    let answer = detectors(landing, &["use", "nobody"])?;
    ensure!(answer.contains("refused") && answer.contains("known detectors: main"), "{answer}");
    Ok(())
}

async fn twenty_detectors_and_ten_dashboards_leave_the_latency_as_it_was(
    landing: &Landing,
) -> anyhow::Result<()> {
    let open = async |instance: String| {
        let identity = Identity { service: "alight", instance };
        Node::open(identity, &ZenohSource::File(landing.zenoh.clone())).await
    };
    let dashboard = async |node: Node| {
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
                else => return anyhow::Ok(()),
            }
        }
    };
    let targets = landing.node.subscriber(topic::TARGET, &[]).await?;
    // Frames may be late while so many begin at once; then it is used again.
    command(landing, ControllerCommand::UseDetector("main".into())).await?;
    let mut ratio = f64::INFINITY;
    // Other load of the machine varies.
    for _ in 0..3 {
        let [alone_ms, alone_99_ms] = ages(&targets, Duration::from_secs(8)).await?;
        let mut tasks = Vec::new();
        for tens in 0..2 {
            tasks.push(tokio::spawn(ten_more(open(format!("extra-{tens}")).await?, tens)));
        }
        for i in 0..10 {
            tasks.push(tokio::spawn(dashboard(open(format!("dashboard-{i}")).await?)));
        }
        landing
            .status("all are known, and the chosen one is used", |s| {
                s.candidates.len() == 21 && s.active_detector.as_deref() == Some("main")
            })
            .await?;
        let [many_ms, many_99_ms] = ages(&targets, Duration::from_secs(8)).await?;
        ratio = many_ms / alone_ms;
        println!(
            "stamp to use, median / 99 %: alone {alone_ms:.1} / {alone_99_ms:.1} ms; with 20 more detectors and 10 \
             dashboards {many_ms:.1} / {many_99_ms:.1} ms: {ratio:.2} times"
        );
        for task in tasks {
            task.abort();
        }
        if ratio < 2.0 {
            break;
        }
        sleep(Duration::from_secs(2)).await;
    }
    ensure!(ratio < 2.0, "{ratio:.2} times the latency without them");
    Ok(())
}
