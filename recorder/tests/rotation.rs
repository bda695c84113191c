//! A recording of several files: nothing is lost between them.

use std::path::Path;
use std::time::Duration;

use anyhow::ensure;
use flightlog::{Entry, read};
use messages::{FrameHeader, PixelFormat, Wind, decode, topic};
use node::{Identity, Layers, Node, Shutdown, ZenohSource, now_ns};
use recorder::Config;
use testing::{ports, until, with_second_try};
use tokio::time::sleep;

const TIMEOUT: Duration = Duration::from_secs(20);
/// Bytes of a frame, of which a file of 1 MB has eleven.
const EDGE: u32 = 300;
const WINDS: u32 = 3000;

async fn open(service: &'static str, meet: u16) -> anyhow::Result<Node> {
    let source = ZenohSource::Text(node::session::local_config(meet));
    Node::open(Identity { service, instance: "main".into() }, &source).await
}

/// The winds in a file, which are counted; and whether it is complete.
fn winds(file: &Path) -> anyhow::Result<(Vec<u32>, bool)> {
    let (mut winds, mut vehicle) = (Vec::new(), None);
    let reading = read(&std::fs::read(file)?, |entry| {
        if let Entry::About(facts) = &entry {
            vehicle = facts.get("vehicle").cloned();
        }
        if let Entry::Message(message) = entry
            && message.key == topic::WIND.key(&[])
            && let Ok(wind) = decode::<Wind>(message.payload)
        {
            winds.push(wind.velocity_ned_m_s[0] as u32);
        }
    })?;
    ensure!(vehicle.as_deref() == Some("drone"), "a recording of the vehicle {vehicle:?}");
    Ok((winds, reading.is_ended && reading.damage.is_empty()))
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_is_lost_when_a_full_file_is_followed_by_the_next() -> anyhow::Result<()> {
    with_second_try(is_complete).await
}

async fn is_complete() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("flight-{time}.mcap");
    let ([meet], _, _) = ports::free()?;
    let set = vec![format!("file={path:?}"), "frames=raw".into(), "max_file_mb=1".into()];
    let config = Layers { file: None, set }.load::<Config>()?.settings;
    let node = open("recorder", meet).await?;
    let task = tokio::spawn(recorder::run(node.clone(), config, Shutdown::on_signals()?));
    let is_begun =
        async || std::fs::read_dir(folder.path()).is_ok_and(|mut files| files.next().is_some());
    until("the recorder makes a file", TIMEOUT, is_begun).await?;
    let source = open("simulator", meet).await?;
    let wind = source.publisher(topic::WIND, &[]).await?;
    let bytes = (EDGE * EDGE) as usize;
    let frames = source.frame_publisher(topic::FRAME, &["down"], bytes).await?;
    sleep(Duration::from_millis(500)).await;
    for number in 0..WINDS {
        let velocity_ned_m_s = [f64::from(number), 0.0, 0.0];
        wind.publish(&Wind { velocity_ned_m_s, stamp_ns: now_ns() }).await;
        if number % 30 == 0 {
            let header = FrameHeader {
                sequence: u64::from(number / 30),
                stamp_ns: now_ns(),
                width: EDGE,
                height: EDGE,
                format: PixelFormat::Mono8,
                ..FrameHeader::sample()
            };
            frames.publish(&header, frames.loan(bytes)).await;
        }
        sleep(Duration::from_millis(1)).await;
    }
    sleep(Duration::from_millis(1500)).await;
    let drops = node.health().report(node.identity(), 0).drops;
    ensure!(drops.is_empty(), "{drops:?}");
    let mut files: Vec<_> = std::fs::read_dir(folder.path())?
        .map(|entry| anyhow::Ok(entry?.path()))
        .collect::<Result<_, _>>()?;
    files.sort_by_key(|file| winds(file).ok().and_then(|(winds, _)| winds.last().copied()));
    let mut seen = Vec::new();
    let mut ended = 0;
    for file in &files {
        let (winds, is_complete) = winds(file)?;
        // A file begins with the last value of each state.
        let last = seen.last().copied();
        seen.extend(winds.into_iter().filter(|wind| last != Some(*wind)));
        ended += usize::from(is_complete);
    }
    ensure!(files.len() > 5 && ended + 1 >= files.len(), "{ended} of {} files", files.len());
    let is_gapless = seen.windows(2).all(|pair| pair[1] == pair[0] + 1);
    ensure!(is_gapless && seen.last() == Some(&(WINDS - 1)), "{} winds: {seen:?}", seen.len());
    task.abort();
    Ok(())
}
