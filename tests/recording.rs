//! Tests recordings of complete landings: independent programs find every channel and picture in them; recorders are killed, and
//! disks fail.

mod disks;
mod played;

use std::io::{BufRead, BufReader, Read};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use anyhow::{Context, ensure};
use messages::{Phase, Wind, topic};
use node::{Identity, Network, Node, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use testing::{node as node_js, node_passes, ports, python, python_passes, with_second_try};

use crate::flight::{ALIGHT, Landing, PATIENCE, alone, beside_another, output_of};
use crate::recorders::{self, Contents, kills};

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_is_recorded_and_read_by_other_programs() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(others_read_a_landing).await
}

async fn others_read_a_landing() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let file = folder.path().join("flight.mcap");
    let name = file.to_str().context("a path")?;
    let landing = Landing::start(&["--seed", "5", "--record", name]).await?;
    let result = landing.lands().await?;
    ensure!(result["recording"]["file"] == name, "{}", result["recording"]);
    ensure!(result["recording"]["kept"].as_u64().is_some_and(|kept| kept > 1000), "{result}");
    println!("{}", result["recording"]);
    println!("{}", result["processes"]);
    let contents = Contents::read(&file)?;
    let as_received = contents.channels.iter().filter(|(name, _)| name.starts_with("raw/"));
    let as_received: u64 = as_received.map(|(_, count)| *count).sum();
    ensure!(result["recording"]["kept"] == as_received, "{as_received} of {}", result["recording"]);
    for channel in [
        "camera/down/frame",
        "camera/down/picture",
        "camera/down/calibration",
        "camera/down/control",
        "detector/main/detections",
        "detector/main/overlay",
        "detector/main/poses",
        "vehicle/state",
        "controller/status",
        "controller/target/pose",
        "tf",
        "log",
        "truth",
        "health/detector/main",
        "config/controller/main",
    ] {
        ensure!(contents.channels.contains_key(channel), "no {channel} in {contents:?}");
    }
    for file in [
        "calibration/down.json",
        "configuration/controller-main.toml",
        "configuration/detector-main.toml",
        "configuration/simulator-main.toml",
    ] {
        ensure!(contents.files.iter().any(|name| name == file), "no {file} in {contents:?}");
    }
    // Of each topic with pictures, overlays and states there is also every message as it was received.
    for topic in ["camera/down/frame", "detector/main/detections", "vehicle/state"] {
        let as_it_came = contents.channels.get(&format!("raw/{topic}"));
        ensure!(as_it_came == contents.channels.get(topic), "{topic} in {contents:?}");
    }
    let repair = output_of(Command::new(ALIGHT).args(["record", "--repair", name]))?;
    let said = String::from_utf8_lossy(&repair.stdout).into_owned();
    ensure!(repair.status.success() && said.contains("is whole"), "{said}");
    let replay = output_of(Command::new(ALIGHT).args(["replay", name, "--verify"]))?;
    let said = String::from_utf8_lossy(&replay.stdout).into_owned();
    println!("{said}");
    ensure!(replay.status.success() && said.contains("verified"), "{said}");
    let figures = file.with_extension("figures").display().to_string();
    let report = output_of(Command::new(ALIGHT).args(["report", name, "--figures", &figures]))?;
    let said = String::from_utf8_lossy(&report.stdout).into_owned();
    println!("{said}");
    ensure!(report.status.success() && said.contains("landed; "), "{said}");
    ensure!(said.contains("tape verified to the bit"), "{said}");
    let page = std::fs::read_to_string(file.with_extension("html"))?;
    ensure!(page.contains("id=\"landing\"") && page.contains("descending over"), "{}", page.len());
    let Some(reader) = python("tests/recording/read.py", &[name, &figures]) else { return Ok(()) };
    let output = tokio::task::block_in_place(|| reader.wait_with_output())?;
    if !python_passes(&output)? {
        return Ok(());
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let read: serde_json::Value = serde_json::from_str(text.lines().last().context("a line")?)?;
    ensure!(read["is_ended"] == true && read["messages"] == contents.messages, "{read}");
    ensure!(read["figures"].as_u64().is_some_and(|drawn| drawn >= 20), "{}", read["figures"]);
    ensure!(read["indexed"] == contents.messages, "{} of {read}", read["indexed"]);
    let overlays =
        [&read["overlays"], &read["overlays_with_picture"]].map(serde_json::Value::as_u64);
    let [Some(overlays), Some(with_picture)] = overlays else { anyhow::bail!("{read}") };
    // Detections may belong to a frame that the recorder has replaced by the next one.
    ensure!(overlays > 50 && with_picture * 100 >= overlays * 95, "{with_picture} of {overlays}");
    let log = read["log"].to_string();
    ensure!(log.contains("descend") && log.contains("touchdown"), "{log}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_is_followed_by_a_client_of_foxglove() -> anyhow::Result<()> {
    // A machine without time left drops pictures on their way to the viewer.
    let _flight = alone().await?;
    with_second_try(async || {
        let folder = tempfile::tempdir()?;
        let file = folder.path().join("flight.mcap");
        let ([port], _, _) = ports::free()?;
        let serve = format!("recorder.serve=\"127.0.0.1:{port}\"");
        let name = file.to_str().context("a path")?;
        let slowly = "controller.metric.max_descend_m_s=0.5";
        let set = ["--seed", "8", "--set", slowly, "--set", &serve, "--record", name];
        let landing = Landing::start(&set).await?;
        landing.descends_below(9.0).await?;
        let address = format!("ws://127.0.0.1:{port}");
        for subprotocol in flightlog::live::SUBPROTOCOLS {
            let Some(client) = node_js("tests/recording/live.cjs", &[&address, subprotocol]) else {
                return Ok(());
            };
            let output = tokio::task::block_in_place(|| client.wait_with_output())?;
            if !node_passes(&output)? {
                return Ok(());
            }
            follows(&serde_json::from_slice(&output.stdout)?)?;
        }
        landing.lands().await?;
        let contents = Contents::read(&file)?;
        ensure!(contents.is_complete(), "lost while it was followed: {:?}", contents.dropped);
        Ok(())
    })
    .await
}

/// Whether a client received the data of a viewer.
fn follows(seen: &serde_json::Value) -> anyhow::Result<()> {
    for (topic, schema) in [
        ("camera/down/picture", "foxglove.CompressedImage"),
        ("camera/down/calibration", "foxglove.CameraCalibration"),
        ("detector/main/overlay", "foxglove.ImageAnnotations"),
        ("tf", "foxglove.FrameTransforms"),
        ("log", "foxglove.Log"),
        ("vehicle/state", "alight.VehicleState"),
        ("health/detector/main", "alight.Health"),
        ("config/controller/main", "alight.Configuration"),
        ("recorder/dropped", "alight.Dropped"),
    ] {
        ensure!(seen["topics"][topic] == schema, "{topic} in {seen}");
        // Of a state the last value comes at once.
        ensure!(seen["counts"][topic].as_u64() >= Some(1), "{topic} in {seen}");
    }
    let raw = seen["topics"].as_object().context("topics")?;
    ensure!(!raw.keys().any(|topic| topic.starts_with("raw/")), "{raw:?}");
    ensure!(seen["firstBytes"] == "ffd8ff", "no JPEG file: {seen}");
    let [overlays, paired] =
        [&seen["overlays"], &seen["paired"]].map(|it| it.as_u64().unwrap_or(0));
    // The first picture may have come before the client asked.
    ensure!(overlays >= 20 && paired + 2 >= overlays, "{seen}");
    ensure!(seen["newestMs"].as_f64().is_some_and(|age| age < 1000.0), "{seen}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_of_a_vehicle_without_another_process_warns() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    let folder = tempfile::tempdir()?;
    let ([meet], _, _) = ports::free()?;
    let record = |vehicle: &str| {
        let file = folder.path().join(vehicle).with_extension("mcap");
        let mut command = Command::new(ALIGHT);
        command.arg("record").arg("-o").arg(file).args(["--meet", &meet.to_string()]);
        command.args(["--stop-with-parent", &std::process::id().to_string()]);
        command.args(["--vehicle", vehicle]).stderr(Stdio::piped()).spawn()
    };
    let (mut misnamed, mut named) = (record("rhed")?, record("red")?);
    let network =
        Network { meet: Some(meet), vehicle: Some("red".to_owned()), ..Network::default() };
    let identity = Identity { service: "tester", instance: "main".into() };
    let tester = Node::open(identity, &network.source("controller")?).await?;
    let winds = tester.publisher(topic::WIND, &[]).await?;
    let warning = "no message of another process of the vehicle `rhed` has arrived";
    let lines = BufReader::new(misnamed.stderr.take().context("standard error")?).lines();
    let is_warned = Arc::new(AtomicBool::new(false));
    let noted = Arc::clone(&is_warned);
    let reading = tokio::task::spawn_blocking(move || {
        for line in lines.map_while(Result::ok).filter(|line| line.contains(warning)) {
            println!("{line}");
            noted.store(true, Ordering::Relaxed);
        }
    });
    let publish = async {
        while !is_warned.load(Ordering::Relaxed) {
            winds.publish(&Wind { velocity_ned_m_s: [0.0; 3], stamp_ns: now_ns() }).await;
            tokio::time::sleep(Duration::from_millis(200)).await;
        }
    };
    let in_time = tokio::time::timeout(PATIENCE, publish).await;
    for child in [&misnamed, &named] {
        kill_process(Pid::from_child(child), Signal::INT)?;
    }
    in_time.context("no warning")?;
    reading.await?;
    let mut text = String::new();
    named.stderr.take().context("standard error")?.read_to_string(&mut text)?;
    ensure!(!text.contains("another process"), "{text}");
    let ends = [&mut misnamed, &mut named].map(Child::wait);
    ensure!(ends.iter().all(|end| end.as_ref().is_ok_and(ExitStatus::success)), "{ends:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_that_is_killed_leaves_a_file_and_the_landing_continues() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(|| kills(3, &[])).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recorder_that_starts_late_gets_the_tape_from_its_beginning() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(late_recorder).await
}

/// Maximum number of parts of a tape that a recorder receives twice at its start.
const MAX_TWICE: u64 = 5;

async fn late_recorder() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let [first, late] = ["first.mcap", "late.mcap"].map(|name| folder.path().join(name));
    let name = first.to_str().context("a path")?;
    let mut landing = Landing::start(&["--seed", "5", "--record", name]).await?;
    landing.descends_below(8.0).await?;
    let pid = landing.start_by_hand("recorder", &["id=late", &format!("file={late:?}")])?;
    landing.status("it has landed", |s| s.phase == Phase::Landed).await?;
    kill_process(pid, Signal::INT)?;
    let mut recorder = landing.by_hand.pop().context("the late recorder")?;
    let end = tokio::task::spawn_blocking(move || recorder.wait()).await??;
    ensure!(end.success(), "the late recorder: {end}");
    landing.lands().await?;
    let replay = output_of(Command::new(ALIGHT).arg("replay").arg(&late).arg("--verify"))?;
    let text = String::from_utf8_lossy(&replay.stdout).into_owned();
    println!("{text}");
    ensure!(replay.status.success() && text.contains("verified"), "{text}");
    // The first recorder does not get what the late one requests.
    let bytes = std::fs::read(&first)?;
    let mut reader = flightlog::TapeReader::default();
    reader.read(&bytes)?;
    let parts: usize = reader.tapes().iter().map(|tape| tape.parts.len()).sum();
    let messages = Contents::read(&first)?.channels.get("raw/controller/tape").copied();
    let messages = messages.context("no tape")?;
    // Parts that are published while it makes its own request may arrive twice.
    let of_one_request = parts as u64..=parts as u64 + MAX_TWICE;
    ensure!(of_one_request.contains(&messages), "{messages} messages of {parts} parts");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn losses_of_an_overloaded_recorder_are_in_its_file_to_the_frame() -> anyhow::Result<()> {
    let _alone = alone().await?;
    with_second_try(recorders::overload).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_disk_that_is_full_read_only_or_removed_is_reported_and_the_landing_continues()
-> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(disks::fail).await
}

#[tokio::test(flavor = "multi_thread")]
async fn data_that_waits_for_a_stopped_disk_is_bounded_and_each_failure_is_reported_soon()
-> anyhow::Result<()> {
    let _alone = alone().await?;
    with_second_try(disks::beside_a_flight).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_recording_is_published_again_to_services_that_run() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(played::to_services).await
}
