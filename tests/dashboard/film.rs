//! Plays camera and detectors for a page: each frame has its number in its pixels, and a browser reads back the drawn pictures.

#![allow(dead_code, reason = "each program uses its part")]

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, bail, ensure};
use messages::{ControllerStatus, Detection, Detections, FrameHeader, Phase, topic};
use node::{Identity, Node, ZenohSource, clock_name, now_ns};
use serde_json::Value;
use testing::{interpreter, ports, skip};
use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval, sleep};

use crate::flight::ALIGHT;
use crate::site::{Air, Radio};

/// Exit status of the script where a browser or a package is missing.
const LACKS: i32 = 77;
/// Blocks of the number in the pixels: their edge in pixels, and their intensities.
const BLOCK: usize = 24;
const BLACK: u8 = 20;
const WHITE: u8 = 230;
/// Longest wait for the page.
const PATIENCE: Duration = Duration::from_secs(30);
/// The square whose position follows from the number, as `tests/dashboard/frames.py` computes it: its edge in pixels, and by how much
/// the detector that is not in use is wrong.
const SQUARE: usize = 80;
const SPARE_SHIFT: f64 = 40.0;
/// Of this number of frames in a row the first have detections of both detectors, the next of none, the last of the one that is not in use.
const CYCLE: u64 = 40;
const BOTH: u64 = 24;
const NONE: u64 = 32;

/// The frames of a film.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Film {
    pub(crate) size: [u32; 2],
    pub(crate) rate_hz: f64,
    /// Whether detections come late, from two detectors, and not always, as in a test of the overlay; else at once from one.
    pub(crate) is_difficult: bool,
}

/// The 16 lowest bits of a number between a white and a black block, and all of that inverted below.
fn write_number(pixels: &mut [u8], width: usize, number: u64) {
    for (row, line) in pixels.chunks_exact_mut(width).take(2 * BLOCK).enumerate() {
        for (column, pixel) in line.iter_mut().take(18 * BLOCK).enumerate() {
            let is_white = match column / BLOCK {
                0 => true,
                17 => false,
                bit => (number >> (bit - 1) & 1 == 1) == (row < BLOCK),
            };
            *pixel = if is_white { WHITE } else { BLACK };
        }
    }
}

/// Where the square of a frame begins: its first column and row.
fn place(number: u64) -> [usize; 2] {
    let number = (number & 0xffff) as usize;
    [60 + number * 53 % 200, 110 + number * 31 % 200]
}

fn write_square(pixels: &mut [u8], width: usize, number: u64) {
    let [left, top] = place(number);
    for line in pixels.chunks_exact_mut(width).skip(top).take(SQUARE) {
        line[left..left + SQUARE].fill(BLACK);
    }
}

/// A ground that takes as many bytes as a JPEG file as a photograph does: a slope with noise.
fn ground([width, height]: [usize; 2]) -> Vec<u8> {
    let mut random = 0x2545_f491_u32;
    let mut noise = || {
        random ^= random << 13;
        random ^= random >> 17;
        random ^= random << 5;
        (random % 9) as u8
    };
    let at = |index: usize| 90 + (index % width * 60 / width + index / width * 40 / height) as u8;
    (0..width * height).map(|index| at(index) + noise()).collect()
}

/// A detector's message on a frame: the square, shifted by the detector's error.
fn detections_of(detector: &str, header: &FrameHeader, shift_px: f64) -> Detections {
    let [left, top] = place(header.sequence).map(|it| it as f64 - 0.5);
    let (left, edge) = (left + shift_px, SQUARE as f64);
    let corners = [[0.0, 0.0], [edge, 0.0], [edge, edge], [0.0, edge]];
    let square = Detection {
        family: "square".into(),
        centre_px: [left + edge / 2.0, top + edge / 2.0],
        corners_px: Some(corners.map(|[x, y]| [left + x, top + y])),
        size_px: edge,
        pose: None,
        ..Detection::sample()
    };
    Detections {
        detector: detector.into(),
        header: header.clone(),
        detections: vec![square],
        stages: Vec::new(),
    }
}

async fn play(node: Node, film: Film) -> anyhow::Result<()> {
    let [width, height] = film.size.map(|edge| edge as usize);
    let frames = node.frame_publisher(topic::FRAME, &["down"], width * height).await?;
    let main = Arc::new(node.publisher(topic::DETECTIONS, &["main"]).await?);
    let spare = Arc::new(node.publisher(topic::DETECTIONS, &["spare"]).await?);
    let statuses = node.publisher(topic::STATUS, &[]).await?;
    let status = ControllerStatus {
        phase: Phase::Descend,
        active_detector: Some("main".into()),
        ..ControllerStatus::default()
    };
    let ground = ground([width, height]);
    let mut due = interval(Duration::from_secs_f64(1.0 / film.rate_hz));
    due.set_missed_tick_behavior(MissedTickBehavior::Skip);
    for sequence in 0.. {
        due.tick().await;
        if sequence % 5 == 0 {
            statuses.publish(&status).await;
        }
        let header = FrameHeader {
            sequence,
            stamp_ns: now_ns(),
            clock: clock_name().into(),
            width: film.size[0],
            height: film.size[1],
            ..FrameHeader::sample()
        };
        let mut loan = frames.loan(width * height);
        loan.copy_from_slice(&ground);
        write_number(&mut loan, width, sequence);
        write_square(&mut loan, width, sequence);
        frames.publish(&header, loan).await;
        if !film.is_difficult {
            main.publish(&detections_of("main", &header, 0.0)).await;
            continue;
        }
        let (main, spare) = (Arc::clone(&main), Arc::clone(&spare));
        // Longer than a frame's period: the next frame's may come first.
        let delay = Duration::from_millis(sequence * 37 % 71);
        tokio::spawn(async move {
            let at = sequence % CYCLE;
            if !(BOTH..NONE).contains(&at) {
                spare.publish(&detections_of("spare", &header, SPARE_SHIFT)).await;
            }
            sleep(delay).await;
            if at < BOTH {
                main.publish(&detections_of("main", &header, 0.0)).await;
            }
        });
    }
    Ok(())
}

/// A page with its film, until this is dropped.
pub(crate) struct Shown {
    dashboard: Child,
    player: JoinHandle<anyhow::Result<()>>,
    port: u16,
    token: String,
    _folder: tempfile::TempDir,
}

impl Shown {
    pub(crate) async fn start(film: Film) -> anyhow::Result<Self> {
        let ([meet, port], _, _) = ports::free()?;
        let folder = tempfile::tempdir()?;
        let tokens = format!("tokens={:?}", folder.path().join("tokens").display().to_string());
        let made = Command::new(ALIGHT).args(["dashboard", "token", "--set", &tokens]).output()?;
        ensure!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let token = String::from_utf8(made.stdout)?.trim().to_owned();
        let source = ZenohSource::Text(node::session::local_config(meet));
        let identity = Identity { service: "simulator", instance: "film".into() };
        let node = Node::open(identity, &source).await?;
        let mut dashboard = Command::new(ALIGHT)
            .args(["dashboard", "--meet", &meet.to_string(), "--set", "video.max_hz=120"])
            .args(["--set", &tokens, "--set", &format!("listen=\"0.0.0.0:{port}\"")])
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .env("ALIGHT_LOG", "error")
            .spawn()?;
        let began = Instant::now();
        while node.alive("dashboard", "*").await?.is_empty() {
            ensure!(dashboard.try_wait()?.is_none(), "the dashboard ended");
            if began.elapsed() > PATIENCE {
                drop(dashboard.kill());
                bail!("the dashboard is not ready after {PATIENCE:?}");
            }
            sleep(Duration::from_millis(50)).await;
        }
        let player = tokio::spawn(play(node, film));
        Ok(Self { dashboard, player, port, token, _folder: folder })
    }

    /// The result of a browser, on this machine or at the other end of a link: of this number of frames with their overlays, or for
    /// this time. `None` without a browser, after a message.
    pub(crate) async fn read(
        &mut self,
        air: Option<&Air>,
        seconds: f64,
        frames: u64,
    ) -> anyhow::Result<Option<Value>> {
        let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("dashboard/frames.py");
        let host = air.map_or("127.0.0.1", |air| air.drone.as_str());
        let url = format!("http://{host}:{}/", self.port);
        let mut command = match air {
            Some(air) => air.on_the_ground(&interpreter()),
            None => Command::new(interpreter()),
        };
        command.arg(script).args([&url, &seconds.to_string(), &frames.to_string()]);
        command.args(air.map(|_| &self.token));
        let mut command = tokio::process::Command::from(command);
        let Ok(ended) = command.output().await else {
            skip("browser", "there is no Python");
            return Ok(None);
        };
        if self.player.is_finished() {
            bail!("the film ended");
        }
        ensure!(self.dashboard.try_wait()?.is_none(), "the dashboard ended");
        let said = String::from_utf8_lossy(&ended.stdout);
        let last = said.lines().last().unwrap_or_default();
        if ended.status.code() == Some(LACKS) {
            skip("browser", last);
            return Ok(None);
        }
        ensure!(ended.status.success(), "{said}{}", String::from_utf8_lossy(&ended.stderr));
        Ok(Some(serde_json::from_str(last).with_context(|| last.to_owned())?))
    }
}

impl Drop for Shown {
    fn drop(&mut self) {
        self.player.abort();
        // A process that has ended needs no kill.
        drop(self.dashboard.kill());
        drop(self.dashboard.wait());
    }
}

/// Reads back this number of frames with their overlays; an error when one has the overlay of another.
pub(crate) async fn overlay(frames: u64) -> anyhow::Result<Option<Value>> {
    let film = Film { size: [648, 486], rate_hz: 30.0, is_difficult: true };
    let mut shown = Shown::start(film).await?;
    let Some(read) = shown.read(None, 0.0, frames).await? else { return Ok(None) };
    let count = |name: &str| read[name].as_u64().with_context(|| format!("{name} of {read}"));
    ensure!(count("frames")? >= frames, "{read}");
    ensure!(count("coloured_elsewhere")? == 0 && count("of_another_frame")? == 0, "{read}");
    ensure!(read["corner_max_px"].as_f64().is_some_and(|px| px < 1.0), "{read}");
    // All three kinds of frames were drawn; those with detections of both, three of five, are shown with them.
    ensure!(count("with_overlay")? * 10 >= frames * 3, "{read}");
    ensure!(count("bare")? > 0 && count("of_another_detector")? > 0, "{read}");
    Ok(Some(read))
}

/// From sent to drawn, in milliseconds, for this time; over a link if there is one.
pub(crate) async fn latency(
    rate_hz: f64,
    seconds: f64,
    radio: Option<Radio>,
) -> anyhow::Result<Option<Value>> {
    let film = Film { size: [1296, 972], rate_hz, is_difficult: false };
    let air = match radio {
        Some(radio) => match Air::new(radio)? {
            Some(air) => Some(air),
            None => return Ok(None),
        },
        None => None,
    };
    let mut shown = Shown::start(film).await?;
    shown.read(air.as_ref(), seconds, u64::MAX >> 16).await
}
