//! Swaps detectors of two families repeatedly in one flight, and checks that no frame is missed.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use anyhow::{Context, ensure};
use messages::{ControllerCommand, Detections, Health, Phase, topic};
use node::{Node, Subscriber, now_ns};
use rustix::process::{Pid, Signal, kill_process};
use tokio::time::{sleep, timeout};

use crate::flight::{ALIGHT, LONG, Landing, PATIENCE, alone, output_of, seconds};

/// Ends processes that outlive their parents.
#[derive(Default)]
struct Outliving(Vec<Pid>);

impl Drop for Outliving {
    fn drop(&mut self) {
        for pid in &self.0 {
            // Replaced detectors have ended.
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

/// The latest health, or that of the next second if the latest is old.
async fn latest(healths: &Subscriber<Health>) -> anyhow::Result<Health> {
    let mut last = None;
    while let Ok(Some(health)) = timeout(PATIENCE, healths.next()).await {
        let is_fresh = seconds(now_ns() - health.stamp_ns) < 0.5;
        last = Some(health);
        if is_fresh {
            break;
        }
    }
    last.context("no health of the controller")
}

pub(crate) async fn command(landing: &Landing, command: ControllerCommand) -> anyhow::Result<()> {
    let reply = landing.node.command(topic::COMMAND, &[], &command).await?;
    ensure!(reply.accepted, "{reply:?}");
    Ok(())
}

/// A pad of two families: rings in its centre, an AprilTag next to them.
const RINGS: &str = "[[markers]]\nmarker = \"rings:0.15341\"\n";
const TAG: &str = "[[markers]]\nmarker = \"apriltag-36h11:3:0.12\"\nx_m = 0.17\n";

/// The pad, and four detectors of it as files: two families, each in two versions.
fn pad_and_detectors(directory: &Path) -> anyhow::Result<(PathBuf, Vec<PathBuf>)> {
    let write = |name: &str, text: String| -> anyhow::Result<PathBuf> {
        let file = directory.join(name);
        std::fs::write(&file, text)?;
        Ok(file)
    };
    let pad = write("pad.toml", format!("id = 5\n{RINGS}{TAG}"))?;
    let mut detectors = Vec::new();
    for (version, settings) in
        [("a", "[tracking]\nenabled = true\n"), ("b", "min_confidence = 0.05\n")]
    {
        for (family, marker) in [("rings", RINGS), ("tag", TAG)] {
            let part = write(&format!("{family}.toml"), format!("id = 5\n{marker}"))?;
            let part = toml_text(&part)?;
            detectors.push(write(
                &format!("{family}-{version}.toml"),
                format!("id = \"{family}-{version}\"\nmarkers = []\npads = [{part}]\n{settings}"),
            )?);
        }
    }
    Ok((pad, detectors))
}

fn toml_text(path: &Path) -> anyhow::Result<String> {
    Ok(format!("'{}'", path.to_str().context("a path")?))
}

const TICKS: &str = "ticks";
const STALE: &str = "ticks without a fresh frame";
const MISSED: &str = "ticks without a fresh frame although there was one";
/// Age from which on a frame is not fresh: the controller's `detectors.max_age_s`.
const FRESH_NS: i64 = 200_000_000;

/// Ticks of a controller: all, those without a fresh frame, and of these those although there was one.
#[derive(Clone, Copy, Default)]
struct Ticks([u64; 3]);

impl Ticks {
    async fn now(healths: &Subscriber<Health>) -> anyhow::Result<Self> {
        let mut ticks = [0; 3];
        let rates = latest(healths).await?.rates;
        for (count, name) in ticks.iter_mut().zip([TICKS, STALE, MISSED]) {
            *count = rates.iter().find(|rate| rate.name == name).map_or(0, |rate| rate.count);
        }
        Ok(Self(ticks))
    }

    fn add_since(&mut self, before: Self, after: Self) {
        for (sum, (after, before)) in self.0.iter_mut().zip(after.0.into_iter().zip(before.0)) {
            *sum += after - before;
        }
    }
}

impl std::fmt::Display for Ticks {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self([all, stale, missed]) = self;
        write!(
            f,
            "{all} ticks, {stale} without a fresh frame, {missed} of them although there was one"
        )
    }
}

/// A received message of any detector: when it came, and of which frame.
#[derive(Clone, Copy)]
struct Received {
    at_ns: i64,
    stamp_ns: i64,
    sequence: u64,
}

/// Notes all detections from now on.
async fn listen(node: &Node) -> anyhow::Result<Arc<Mutex<Vec<Received>>>> {
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let received = Arc::new(Mutex::new(Vec::new()));
    let noted = Arc::clone(&received);
    tokio::spawn(async move {
        while let Some(message) = detections.next().await {
            let Detections { header, .. } = message;
            let message =
                Received { at_ns: now_ns(), stamp_ns: header.stamp_ns, sequence: header.sequence };
            noted.lock().unwrap_or_else(PoisonError::into_inner).push(message);
        }
    });
    Ok(received)
}

/// The times without detections of a fresh frame, each with its length in ms and its cause.
fn droughts(received: &[Received]) -> Vec<(i64, f64, String)> {
    let mut droughts = Vec::new();
    let Some(mut newest) = received.first().copied() else { return droughts };
    for next in received {
        if next.stamp_ns <= newest.stamp_ns {
            continue;
        }
        let over_ns = next.at_ns - newest.stamp_ns - FRESH_NS;
        if over_ns > 0 {
            let ms = |ns: i64| ns as f64 * 1e-6;
            let cause = format!(
                "{:.0} ms and {} frames after the last one, received {:.0} ms later",
                ms(next.stamp_ns - newest.stamp_ns),
                next.sequence - newest.sequence,
                ms(next.at_ns - next.stamp_ns),
            );
            droughts.push((next.at_ns, ms(over_ns), cause));
        }
        newest = *next;
    }
    droughts
}

/// Holds over the pad, swaps detectors of two families again and again, and lands. Between the swaps, for a third as long,
/// the same hold without them. False when the machine had no time for it: then frames were late for every
/// detector, and the frames that a hand-over missed are not known.
pub(crate) async fn swaps(number: usize) -> anyhow::Result<bool> {
    let _alone = alone().await?;
    let directory = tempfile::tempdir()?;
    let (pad, detectors) = pad_and_detectors(directory.path())?;
    let mut outliving = Outliving::default();
    let args = [
        "--seed",
        "21",
        // Slowly, as the last swap comes on the way down: the tag is in view down to 0.7 m.
        "--set",
        "controller.metric.max_descend_m_s=0.3",
        "--pad",
        pad.to_str().context("a path")?,
    ];
    let landing = Landing::start(&[&LONG[..], &args].concat()).await?;
    let healths = landing.node.subscriber(topic::HEALTH, &["controller", "main"]).await?;
    let received = listen(&landing.node).await?;
    landing.descends_below(8.0).await?;
    command(&landing, ControllerCommand::Hold).await?;
    landing.status("it holds", |s| s.phase == Phase::Hold).await?;
    let mut used = "main".to_owned();
    let mut took_s = Vec::new();
    let (mut with, mut without) = (Ticks::default(), Ticks::default());
    let mut marks = Vec::new();
    for i in 0..number {
        if i + 1 == number {
            command(&landing, ControllerCommand::Resume).await?;
        }
        let before = Ticks::now(&healths).await?;
        let began_ns = now_ns();
        let file = detectors[i % detectors.len()].to_str().context("a path")?;
        let (mut is_done, mut report) = tokio::task::block_in_place(|| swap(&landing, file))?;
        for _ in 0..2 {
            if is_done {
                break;
            }
            // Where the machine is too busy for the frames to be fresh, the old one stays, as it should.
            println!("swap {i}: {report}");
            (is_done, report) = tokio::task::block_in_place(|| swap(&landing, file))?;
        }
        outliving.0.extend(report["pid"].as_i64().and_then(|pid| Pid::from_raw(pid as i32)));
        ensure!(is_done && report["swapped"] == true, "swap {i}: {report}");
        ensure!(report["from"] == used.as_str() && report["old_stopped"] == true, "{report}");
        used = report["to"].as_str().context("a name")?.to_owned();
        let at = |key: &str| report[key].as_f64().unwrap_or_default();
        let ended_s = seconds(now_ns() - began_ns);
        // The program itself starts first, and the last thing it does is to wait for the end of the old one.
        marks.push((began_ns, [at("ready_s"), at("agreed_s"), at("active_s")], ended_s));
        took_s.push(at("active_s"));
        let after = Ticks::now(&healths).await?;
        with.add_since(before, after);
        if i + 1 < number {
            sleep(Duration::from_secs_f64(0.3 * ended_s)).await;
            without.add_since(after, Ticks::now(&healths).await?);
        }
        if i % 25 == 24 {
            println!("{} swaps; with them {with}; between them {without}", i + 1);
        }
    }
    took_s.sort_by(f64::total_cmp);
    println!(
        "{number} swaps, in use after {:.1} s each; with them {with}; between them {without}",
        took_s.get(took_s.len() / 2).copied().unwrap_or_default(),
    );
    let received = received.lock().unwrap_or_else(PoisonError::into_inner).clone();
    for (at_ns, over_ms, cause) in droughts(&received) {
        let swap = marks.iter().find(|(began_ns, _, ended_s)| {
            (0.0..*ended_s + 0.2).contains(&seconds(at_ns - began_ns))
        });
        let when = swap.map_or("between the swaps".to_owned(), |(began_ns, at_s, _)| {
            format!("{:.2} s into a swap {at_s:.2?}", seconds(at_ns - began_ns))
        });
        println!("no fresh frame for {over_ms:.0} ms {when}: the next was taken {cause}");
    }
    let result = landing.lands().await?;
    println!("{result}");
    // A hand-over with a gap would miss a tenth of a swap's ticks; a machine that is late misses single ones.
    let Ticks([all, stale, missed]) = with;
    if 10 * (stale - missed) > all {
        return Ok(false);
    }
    ensure!(100 * missed <= all, "{missed} of {all} ticks missed a frame that was there");
    Ok(true)
}
