//! Recordings of real landings: read by programs that are not ours, with recorders that are killed and disks that fail.

#![expect(
    clippy::print_stdout,
    reason = "what a test measured, or why it is skipped, is for people to read"
)]

mod flight;
#[path = "recording/recorders.rs"]
mod recorders;

use std::path::Path;
use std::process::Command;

use anyhow::{Context, ensure};
use messages::{RecorderStatus, topic};
use node::Subscriber;
use testing::{node, node_passes, python, python_passes, skip, with_second_try};
use tokio::time::timeout;

use crate::flight::{Landing, ONE_AT_A_TIME, PATIENCE, output_of};
use crate::recorders::{Contents, kills};

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_is_recorded_and_read_by_other_programs() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
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
    for channel in [
        "camera/down/frame",
        "camera/down/picture",
        "camera/down/calibration",
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
    // Of each topic with pictures, overlays and states there is also every message as it came.
    for topic in ["camera/down/frame", "detector/main/detections", "vehicle/state"] {
        let as_it_came = contents.channels.get(&format!("raw/{topic}"));
        ensure!(as_it_came == contents.channels.get(topic), "{topic} in {contents:?}");
    }
    let repair = output_of(Command::new(flight::ALIGHT).args(["record", "--repair", name]))?;
    let said = String::from_utf8_lossy(&repair.stdout).into_owned();
    ensure!(repair.status.success() && said.contains("is whole"), "{said}");
    let replay = output_of(Command::new(flight::ALIGHT).args(["replay", name, "--verify"]))?;
    let said = String::from_utf8_lossy(&replay.stdout).into_owned();
    println!("{said}");
    ensure!(replay.status.success() && said.contains("verified"), "{said}");
    let Some(reader) = python("tests/recording/read.py", &[name]) else { return Ok(()) };
    let output = tokio::task::block_in_place(|| reader.wait_with_output())?;
    if !python_passes(&output)? {
        return Ok(());
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let read: serde_json::Value = serde_json::from_str(text.lines().last().context("a line")?)?;
    ensure!(read["is_ended"] == true && read["messages"] == contents.messages, "{read}");
    ensure!(read["indexed"] == contents.messages, "{} of {read}", read["indexed"]);
    let overlays =
        [&read["overlays"], &read["overlays_with_picture"]].map(serde_json::Value::as_u64);
    let [Some(overlays), Some(with_picture)] = overlays else { anyhow::bail!("{read}") };
    // The detector may tell of a frame that the recorder lost to the one after it.
    ensure!(overlays > 50 && with_picture * 100 >= overlays * 95, "{with_picture} of {overlays}");
    let log = read["log"].to_string();
    ensure!(log.contains("descend") && log.contains("touchdown"), "{log}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_is_followed_by_a_client_of_foxglove() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    with_second_try(async || {
        let folder = tempfile::tempdir()?;
        let file = folder.path().join("flight.mcap");
        let ([port], _, _) = testing::ports::free()?;
        let serve = format!("recorder.serve=\"127.0.0.1:{port}\"");
        let name = file.to_str().context("a path")?;
        let slowly = "controller.metric.max_descend_m_s=0.5";
        let set = ["--seed", "8", "--set", slowly, "--set", &serve, "--record", name];
        let landing = Landing::start(&set).await?;
        landing.descends_below(9.0).await?;
        let address = format!("ws://127.0.0.1:{port}");
        for subprotocol in flightlog::live::SUBPROTOCOLS {
            let Some(client) = node("tests/recording/live.cjs", &[&address, subprotocol]) else {
                return Ok(());
            };
            let output = tokio::task::block_in_place(|| client.wait_with_output())?;
            if !node_passes(&output)? {
                return Ok(());
            }
            follows(&serde_json::from_slice(&output.stdout)?)?;
        }
        landing.lands().await?;
        let dropped = Contents::read(&file)?.dropped;
        ensure!(dropped.is_empty(), "lost while it was followed: {dropped:?}");
        Ok(())
    })
    .await
}

/// Whether a client saw what a viewer shows.
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
async fn a_recorder_that_is_killed_leaves_a_file_and_the_landing_goes_on() -> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    with_second_try(|| kills(3, &[])).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_disk_that_is_full_read_only_or_removed_is_told_and_the_landing_goes_on()
-> anyhow::Result<()> {
    let _alone = ONE_AT_A_TIME.lock().await;
    with_second_try(disks_fail).await
}

/// A small disk of its own, until it is dropped.
struct Disk<'a>(&'a Path);

impl<'a> Disk<'a> {
    fn mount(path: &'a Path, options: &str) -> anyhow::Result<Option<Self>> {
        std::fs::create_dir(path)?;
        let mut command = Command::new("mount");
        let output = command.args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(path).output();
        let is_there = output.as_ref().is_ok_and(|output| output.status.success());
        if !is_there {
            skip("namespaces", format_args!("a disk could not be mounted: {output:?}"));
        }
        Ok(is_there.then_some(Self(path)))
    }

    fn change(&self, options: &str) -> anyhow::Result<()> {
        let options = format!("remount,{options}");
        let status = Command::new("mount").args(["-o", &options]).arg(self.0).status()?;
        ensure!(status.success(), "{options}: {status}");
        Ok(())
    }
}

impl Drop for Disk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

async fn disks_fail() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("disk");
    let Some(disk) = Disk::mount(&path, "ro,size=3m")? else { return Ok(()) };
    let file = path.join("flights/flight.mcap");
    let name = file.to_str().context("a path")?;
    let slowly = "controller.metric.max_descend_m_s=0.5";
    let landing = Landing::start(&["--seed", "6", "--set", slowly, "--record", name]).await?;
    let statuses = landing.node.subscriber(topic::RECORDER_STATUS, &[]).await?;
    let healths = landing.node.subscriber(topic::HEALTH, &["recorder", "main"]).await?;
    told(&statuses, "the disk is read-only", |s| has_problem(s, "Read-only")).await?;
    disk.change("rw")?;
    told(&statuses, "it records", |s| s.problem.is_none() && s.bytes > 0).await?;
    told(&statuses, "the disk is full", |s| has_problem(s, "No space left")).await?;
    disk.change("rw,size=400m")?;
    let again = told(&statuses, "it records again", |s| s.problem.is_none() && s.bytes > 0).await?;
    std::fs::remove_dir_all(path.join("flights"))?;
    told(&statuses, "the file is removed", |s| has_problem(s, "removed")).await?;
    told(&statuses, "it records again", |s| s.problem.is_none() && s.bytes > 0).await?;
    let lost: u64 = again.dropped.iter().map(|loss| loss.count).sum();
    ensure!(lost > 100, "{again:?}");
    let in_health = timeout(PATIENCE, async {
        while let Some(health) = healths.next().await {
            if health.errors.iter().any(|error| error.reason == "the file failed") {
                return true;
            }
        }
        false
    });
    ensure!(in_health.await?, "nothing in the health report");
    let result = landing.lands().await?;
    println!("{}", result["recording"]);
    let contents = Contents::read(&file)?;
    let in_file = contents.dropped.get("vehicle/state").copied();
    ensure!(in_file.is_some_and(|lost| lost > 10), "{:?}", contents.dropped);
    Ok(())
}

fn has_problem(status: &RecorderStatus, part: &str) -> bool {
    status.problem.as_ref().is_some_and(|problem| problem.contains(part))
}

async fn told(
    statuses: &Subscriber<RecorderStatus>,
    what: &str,
    holds: impl Fn(&RecorderStatus) -> bool,
) -> anyhow::Result<RecorderStatus> {
    let mut last = None;
    let found = timeout(PATIENCE, async {
        while let Some(status) = statuses.next().await {
            if holds(&status) {
                return Some(status);
            }
            last = Some(status);
        }
        None
    });
    let found = found.await.ok().flatten();
    found.with_context(|| format!("waiting until {what}; last: {last:?}"))
}
