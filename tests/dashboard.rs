//! Tests the page of `alight land`'s landings: a real browser that commands, Motion JPEG, overlays on the right picture,
//! the page killed or its port taken, twenty browsers at once.

use std::io::{BufRead, BufReader, Write};
use std::path::PathBuf;
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, ensure};
use futures_util::{SinkExt, StreamExt};
use rustix::process::{Signal, kill_process};
use serde_json::Value;
use testing::{interpreter, ports, skip, with_second_try};
use tokio::net::TcpStream;
use tokio::time::{sleep, timeout};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::{WebSocketStream, client_async};

use crate::film;
use crate::flight::{ALIGHT, Landing, PATIENCE, alone, beside_another, output_of, time_for};
use crate::many_clients::{Browsers, memory_mb};

/// Exit status of a script that lacks a browser or a package.
const LACKS: i32 = 77;
/// Longest time in which a page that is cut off strikes through its values, and in which it is connected again once its
/// server is there; beyond the time in which the browser answers a question, up to a limit.
const MAX_GREY_S: f64 = 1.0;
const MAX_BACK_S: f64 = 2.0;
const MAX_ANSWER_S: f64 = 1.5;
/// Twice two pictures and their texts for each of twenty browsers, with room for the system's buffers.
const MAX_BROWSERS_MB: f64 = 60.0;
/// A descent of twenty seconds.
const SLOWLY: [&str; 2] = ["--set", "controller.metric.max_descend_m_s=0.5"];

async fn socket(page: &str, path: &str) -> anyhow::Result<WebSocketStream<TcpStream>> {
    let found = timeout(PATIENCE / 4, async {
        loop {
            if let Ok(stream) = TcpStream::connect(page).await {
                return stream;
            }
            sleep(Duration::from_millis(50)).await;
        }
    });
    Ok(client_async(format!("ws://{page}{path}"), found.await?).await?.0)
}

async fn next(socket: &mut WebSocketStream<TcpStream>) -> anyhow::Result<Message> {
    Ok(timeout(PATIENCE, socket.next()).await?.context("the page closed the connection")??)
}

fn free_page() -> anyhow::Result<String> {
    let ([port], _, _) = ports::free()?;
    Ok(format!("127.0.0.1:{port}"))
}

#[test]
fn a_landing_does_not_begin_when_another_program_has_the_port_of_its_page() -> anyhow::Result<()> {
    let taken = std::net::TcpListener::bind("127.0.0.1:0")?;
    let page = taken.local_addr()?.to_string();
    let output =
        output_of(std::process::Command::new(ALIGHT).args(["land", "--dashboard", &page]))?;
    let problem = String::from_utf8_lossy(&output.stderr);
    ensure!(!output.status.success() && !problem.contains("takeoff"), "{output:?}");
    ensure!(problem.contains(&page) && problem.contains("`--dashboard IP:PORT`"), "{problem}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_landing_is_shown_and_continues_when_the_page_is_killed() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(async || {
        let page = free_page()?;
        let landing = Landing::start(&["--seed", "4", "--dashboard", &page]).await?;
        let mut data = socket(&page, "/ws").await?;
        let mut video = socket(&page, "/video").await?;
        let (mut pictures, mut with_detections) = (0, 0);
        let descends = |it: &Value| it["status"]["phase"] == "descend" && it["target"]["position_m"].is_array();
        let mut shown = Value::Null;
        while pictures < 30 || !descends(&shown) {
            tokio::select! {
                message = next(&mut video) => {
                    let bytes = message?.into_data();
                    let length = u32::from_le_bytes(bytes.get(..4).context("a length")?.try_into()?) as usize;
                    let header: Value = serde_json::from_slice(bytes.get(4..4 + length).context("a header")?)?;
                    let has_detections = !header["found_sequence"].is_null();
                    ensure!(!has_detections || header["found_sequence"] == header["sequence"], "{header}");
                    with_detections += usize::from(has_detections);
                    pictures += 1;
                    video.send(Message::text(header["number"].to_string())).await?;
                }
                message = next(&mut data) => {
                    let it: Value = serde_json::from_str(message?.to_text()?)?;
                    if it["kind"] == "now" {
                        shown = it;
                    }
                }
            }
        }
        println!("{with_detections} of {pictures} pictures with their detections; {shown}");
        ensure!(with_detections * 10 >= pictures * 8, "{with_detections} of {pictures}");
        landing.kill("dashboard")?;
        landing.lands().await?;
        Ok(())
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_browser_shows_a_landing_and_commands_it() -> anyhow::Result<()> {
    // A browser that shares two processors with other landings is slower than the landing that it is to command.
    let _alone = alone().await?;
    with_second_try(in_a_browser).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_with_only_motion_jpeg_sees_the_landing() -> anyhow::Result<()> {
    let _flight = beside_another().await?;
    with_second_try(async || {
        let page = free_page()?;
        let landing = Landing::start(&["--seed", "4", "--dashboard", &page]).await?;
        drop(socket(&page, "/ws").await?);
        let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("dashboard/mjpeg.py");
        let url = format!("http://{page}/video.mjpeg");
        let ended = tokio::process::Command::new(interpreter()).arg(script).arg(url).output();
        let Ok(ended) = timeout(PATIENCE, ended).await? else {
            skip("python", "there is no Python");
            return Ok(());
        };
        let said = String::from_utf8_lossy(&ended.stdout);
        let last = said.lines().last().unwrap_or_default();
        println!("{last}");
        if ended.status.code() == Some(LACKS) {
            skip("python", last);
            return Ok(());
        }
        ensure!(ended.status.success(), "{}", String::from_utf8_lossy(&ended.stderr));
        let seen: Value = serde_json::from_str(last)?;
        let is_more = |name: &str, than: u64| seen[name].as_u64().is_some_and(|it| it > than);
        ensure!(
            is_more("pictures", 29) && is_more("changes", 20) && is_more("spread", 50),
            "{seen}"
        );
        landing.lands().await?;
        Ok(())
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn each_overlay_is_drawn_over_the_picture_in_which_it_was_found() -> anyhow::Result<()> {
    let _alone = alone().await?;
    with_second_try(async || {
        if let Some(read) = film::overlay(200).await? {
            println!("{read}");
        }
        Ok(())
    })
    .await
}

#[tokio::test(flavor = "multi_thread")]
async fn twenty_browsers_and_a_page_that_is_stopped_and_killed_change_no_decision()
-> anyhow::Result<()> {
    let _flight = time_for(3).await?;
    with_second_try(async || {
        let folder = tempfile::tempdir()?;
        let file = folder.path().join("flight.mcap");
        let name = file.to_str().context("a path")?;
        let page = free_page()?;
        let args = [["--seed", "4"], ["--dashboard", &page], ["--record", name], SLOWLY].concat();
        let landing = Landing::start(&args).await?;
        drop(socket(&page, "/ws").await?);
        let dashboard = landing.service("dashboard")?.pid;
        let alone_mb = memory_mb(dashboard)?;
        let browsers = Browsers::new(&page);
        landing.descends_below(8.0).await?;
        sleep(Duration::from_secs(3)).await;
        let with_mb = memory_mb(dashboard)?;
        kill_process(dashboard, Signal::STOP)?;
        sleep(Duration::from_secs(4)).await;
        kill_process(dashboard, Signal::CONT)?;
        sleep(Duration::from_secs(3)).await;
        let after_mb = memory_mb(dashboard)?;
        println!(
            "{alone_mb:.0} MB alone, {with_mb:.0} with 20 browsers, {after_mb:.0} after a stop"
        );
        ensure!(with_mb.max(after_mb) < alone_mb + MAX_BROWSERS_MB, "{after_mb} MB");
        landing.kill("dashboard")?;
        landing.lands().await?;
        drop(browsers);
        let replay =
            output_of(std::process::Command::new(ALIGHT).args(["replay", name, "--verify"]))?;
        let said = String::from_utf8_lossy(&replay.stdout).into_owned();
        ensure!(replay.status.success() && said.contains("verified"), "{said}");
        Ok(())
    })
    .await
}

async fn in_a_browser() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let pictures = std::env::var_os("ALIGHT_PICTURES").map_or(folder.path().into(), PathBuf::from);
    let page = free_page()?;
    let few = ["--set", "dashboard.max_clients=2"];
    let args = [["--seed", "4"], ["--dashboard", &page], SLOWLY, few].concat();
    let mut landing = Landing::start(&args).await?;
    drop(socket(&page, "/ws").await?);
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("dashboard/browser.py");
    let started = std::process::Command::new(interpreter())
        .arg(script)
        .arg(format!("http://{page}/"))
        .arg(pictures)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn();
    let Ok(mut browser) = started else {
        skip("browser", "there is no Python");
        return Ok(());
    };
    let mut answers = browser.stdin.take().context("standard input")?;
    let lines = BufReader::new(browser.stdout.take().context("standard output")?).lines();
    let mut last = String::new();
    for line in lines {
        last = tokio::task::block_in_place(|| line)?;
        println!("{last}");
        match last.as_str() {
            "STOP" => kill_process(landing.service("dashboard")?.pid, Signal::STOP)?,
            "CONT" => kill_process(landing.service("dashboard")?.pid, Signal::CONT)?,
            "KILL" => drop(landing.kill("dashboard")?),
            "START" => {
                landing.start_by_hand("dashboard", &[])?;
                drop(socket(&page, "/ws").await?);
            }
            _ => continue,
        }
        writeln!(answers, "done")?;
    }
    let status = tokio::task::block_in_place(|| browser.wait())?;
    if status.code() == Some(LACKS) {
        skip("browser", last);
        return Ok(());
    }
    ensure!(status.success(), "the browser's script ended with {status}: {last}");
    let measured: Value = serde_json::from_str(&last)?;
    if measured["accessibility"].is_null() {
        skip("node", "axe-core is not there");
    }
    let within = |name: &str, max_s: f64| {
        let [time_s, answer_s] = [&measured[name][0], &measured[name][1]].map(Value::as_f64);
        time_s
            .zip(answer_s)
            .is_some_and(|(time_s, answer_s)| time_s <= max_s + answer_s.min(MAX_ANSWER_S))
    };
    ensure!(within("grey_s", MAX_GREY_S) && within("back_s", MAX_BACK_S), "{measured}");
    landing.lands().await?;
    Ok(())
}
