//! Records a flight to disks that are full, read-only, removed or do not respond.

use std::fs::File;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use anyhow::{Context, ensure};
use messages::{ControllerCommand, Health, Phase, RecorderStatus, topic};
use node::Subscriber;
use rustix::process::Pid;
use testing::skip;
use tokio::time::{Instant, sleep, timeout};

use crate::flight::{ALIGHT, LONG, Landing, PATIENCE, output_of};
use crate::recorders::{Contents, command};

/// Longest time until a failure of the disk is reported.
const MAX_UNREPORTED: Duration = Duration::from_secs(2);
/// How long a disk does not respond.
const STALL: Duration = Duration::from_secs(5);
/// Maximum growth of a recorder that waits for its disk, in MB; of `max_waiting_mb` = 16 half may wait, in addition to the data
/// that are being written.
const MAX_HELD_MB: f64 = 32.0;

/// A small separate disk, until this is dropped.
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
        change(self.0, options)
    }
}

fn change(path: &Path, options: &str) -> anyhow::Result<()> {
    let options = format!("remount,{options}");
    let status = Command::new("mount").args(["-o", &options]).arg(path).status()?;
    ensure!(status.success(), "{options}: {status}");
    Ok(())
}

/// A file as a disk, which can be stopped.
struct Freezing<'a>(&'a Path);

impl<'a> Freezing<'a> {
    fn mount(path: &'a Path) -> anyhow::Result<Option<Self>> {
        std::fs::create_dir(path)?;
        let image = path.with_extension("image");
        File::create(&image)?.set_len(200_000_000)?;
        let run = |command: &mut Command| {
            let output = command.output();
            let is_done = output.as_ref().is_ok_and(|output| output.status.success());
            if !is_done {
                skip("namespaces", format_args!("{command:?}: {output:?}"));
            }
            is_done
        };
        let is_there = run(Command::new("mkfs.ext4").arg("-q").arg(&image))
            && run(Command::new("mount").args(["-o", "loop"]).arg(&image).arg(path));
        Ok(is_there.then_some(Self(path)))
    }

    fn change(&self, options: &str) -> anyhow::Result<()> {
        change(self.0, options)
    }

    /// Removes it, though files on it are open.
    fn unmount(self) -> anyhow::Result<()> {
        let status = Command::new("umount").arg("-l").arg(self.0).status()?;
        ensure!(status.success(), "umount -l: {status}");
        std::mem::forget(self);
        Ok(())
    }

    /// Stops it for as long as the result lives. A process that writes to it cannot be ended meanwhile.
    fn frozen(&self) -> anyhow::Result<Frozen<'_>> {
        let status = Command::new("fsfreeze").arg("-f").arg(self.0).status()?;
        ensure!(status.success(), "fsfreeze -f: {status}");
        Ok(Frozen(self.0))
    }
}

/// A disk that is stopped.
struct Frozen<'a>(&'a Path);

impl Drop for Frozen<'_> {
    fn drop(&mut self) {
        let _ = Command::new("fsfreeze").arg("-u").arg(self.0).status();
    }
}

impl Drop for Freezing<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

impl Drop for Disk<'_> {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.0).status();
    }
}

/// A landing is recorded to a disk that is read-only, full, and from which the file is removed.
pub(crate) async fn fail() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("disk");
    let Some(disk) = Disk::mount(&path, "ro,size=3m")? else { return Ok(()) };
    let file = path.join("flights/flight.mcap");
    let name = file.to_str().context("a path")?;
    let slowly = "controller.metric.max_descend_m_s=0.5";
    let landing = Landing::start(&["--seed", "6", "--set", slowly, "--record", name]).await?;
    let statuses = landing.node.subscriber(topic::RECORDER_STATUS, &[]).await?;
    let healths = landing.node.subscriber(topic::HEALTH, &["recorder", "main"]).await?;
    reported(&statuses, "the disk is read-only", |s| has_problem(s, "Read-only")).await?;
    disk.change("rw")?;
    reported(&statuses, "it records", |s| s.problem.is_none() && s.bytes > 0).await?;
    reported(&statuses, "the disk is full", |s| has_problem(s, "No space left")).await?;
    disk.change("rw,size=400m")?;
    let again =
        reported(&statuses, "it records again", |s| s.problem.is_none() && s.bytes > 0).await?;
    std::fs::remove_dir_all(path.join("flights"))?;
    reported(&statuses, "the file is removed", |s| has_problem(s, "removed")).await?;
    reported(&statuses, "it records again", |s| s.problem.is_none() && s.bytes > 0).await?;
    let lost = again.lost();
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
    let (result, status) = landing.lands_with_losses().await?;
    println!("{}", result["recording"]);
    ensure!(status == Some(1), "messages are lost, and the exit status is {status:?}: {result}");
    let contents = Contents::read(&file)?;
    let in_file = contents.dropped.get("vehicle/state").copied();
    ensure!(in_file.is_some_and(|lost| lost > 10), "{:?}", contents.dropped);
    Ok(())
}

fn has_problem(status: &RecorderStatus, part: &str) -> bool {
    status.problem.as_ref().is_some_and(|problem| problem.contains(part))
}

async fn reported(
    statuses: &Subscriber<RecorderStatus>,
    condition: &str,
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
    found.with_context(|| format!("waiting until {condition}; last: {last:?}"))
}

/// A landing is recorded twice: as usual, and with every pixel at 30 frames a second to a disk that is read-only, does not respond, is
/// full, from which the file is removed, and that is taken away. Flown again without any recorder, the same decisions are
/// made on the same events, to the bit.
pub(crate) async fn beside_a_flight() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("disk");
    let Some(disk) = Freezing::mount(&path)? else { return Ok(()) };
    let good = folder.path().join("good.mcap");
    let name = good.to_str().context("a path")?;
    let args = ["--seed", "9", "--set", "simulator.camera.rate_hz=30", "--record", name];
    let mut landing = Landing::start(&[&LONG[..], &args].concat()).await?;
    let statuses = landing.node.subscriber(topic::RECORDER_STATUS, &["failing"]).await?;
    let healths = landing.node.subscriber(topic::HEALTH, &["controller", "main"]).await?;
    let file = format!("file={:?}", path.join("flights/failing.mcap"));
    disk.change("ro")?;
    let pid = landing
        .start_by_hand("recorder", &["id=failing", &file, "frames=raw", "max_waiting_mb=16"])?;
    landing.descends_below(9.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    reported(&statuses, "the disk is read-only", |s| has_problem(s, "Read-only")).await?;
    disk.change("rw")?;
    let is_well = |s: &RecorderStatus| s.problem.is_none() && s.bytes > 0;
    reported(&statuses, "it records", is_well).await?;

    let before_mb = resident_mb(pid)?;
    let frozen = disk.frozen()?;
    let began = Instant::now();
    reported(&statuses, "it does not respond", |s| has_problem(s, "taken nothing")).await?;
    let still = began.elapsed();
    let mut max_mb = before_mb;
    while began.elapsed() < STALL {
        max_mb = max_mb.max(resident_mb(pid)?);
        sleep(Duration::from_millis(50)).await;
    }
    drop(frozen);
    let after = reported(&statuses, "it records again", is_well).await?;

    fill(&path.join("filler"))?;
    let began = Instant::now();
    reported(&statuses, "the disk is full", |s| has_problem(s, "No space left")).await?;
    let full = began.elapsed();
    std::fs::remove_file(path.join("filler"))?;
    std::fs::remove_dir_all(path.join("flights"))?;
    reported(&statuses, "it records again", is_well).await?;

    let began = Instant::now();
    std::fs::remove_dir_all(path.join("flights"))?;
    reported(&statuses, "the file is removed", |s| has_problem(s, "removed")).await?;
    let removed = began.elapsed();
    reported(&statuses, "it records again", is_well).await?;

    let began = Instant::now();
    disk.unmount()?;
    reported(&statuses, "the disk is taken away", |s| has_problem(s, "removed")).await?;
    let taken_away = began.elapsed();
    reported(&statuses, "it records again", is_well).await?;

    let controller = latest(&healths).await?;
    command(&landing, ControllerCommand::Resume).await?;
    landing.lands().await?;
    let lost = after.lost();
    println!(
        "reported after {still:.1?} (does not respond), {full:.1?} (full), {removed:.1?} (removed), {taken_away:.1?} (unmounted); held {:.0} MB more than {before_mb:.0} MB; {lost} messages lost in {STALL:?}; drops of the controller: {:?}",
        max_mb - before_mb,
        controller.drops,
    );
    for reported_after in [still, full, removed, taken_away] {
        ensure!(reported_after < MAX_UNREPORTED, "it was reported after {reported_after:?}");
    }
    ensure!(lost > 0, "nothing was lost, so that the bound was not reached");
    ensure!(max_mb - before_mb < MAX_HELD_MB, "{max_mb} MB after {before_mb} MB");
    let mut again = Command::new(ALIGHT);
    let output = output_of(again.arg("replay").arg(&good).arg("--verify"))?;
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    println!("{said}");
    ensure!(output.status.success() && said.contains("verified"), "{said}");
    Ok(())
}

/// The resident memory of a process, in MB, without memory that it shares with others: a camera's pool is mapped completely.
fn resident_mb(pid: Pid) -> anyhow::Result<f64> {
    let status = std::fs::read_to_string(format!("/proc/{}/status", pid.as_raw_nonzero()))?;
    let line = status.lines().find_map(|line| line.strip_prefix("RssAnon:"));
    let kb: f64 = line.and_then(|it| it.split_whitespace().next()).context("RssAnon")?.parse()?;
    Ok(kb * 1.024e-3)
}

/// Writes a file until its disk is full.
fn fill(path: &Path) -> anyhow::Result<()> {
    let mut file = File::create(path)?;
    let megabyte = vec![0; 1 << 20];
    while std::io::Write::write_all(&mut file, &megabyte).is_ok() {}
    Ok(())
}

async fn latest(healths: &Subscriber<Health>) -> anyhow::Result<Health> {
    timeout(PATIENCE, healths.next()).await?.context("the controller's health")
}
