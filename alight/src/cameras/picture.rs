//! Takes a picture as `camera-pub` publishes it, from any source of its configuration: a device, a program, a stream or files.

use std::pin::pin;
use std::time::Duration;

use anyhow::Context;
use camera_pub::Config;
use imaging::{Converter, GrayImage};
use messages::topic;
use node::{Identity, Node, Shutdown, ZenohSource, now_ns};

use crate::grey::grey;
use crate::runtime::block_on;

/// A session that meets no other: the frames stay in this process.
const NO_NETWORK: &str = r#"{
  mode: "peer",
  namespace: "picture",
  listen: { endpoints: [] },
  connect: { endpoints: [] },
  scouting: { multicast: { enabled: false }, gossip: { enabled: false } },
}"#;
/// Number of frames in which a camera's own metering settles.
const SETTLING_FRAMES: usize = 15;
/// Maximum time until there is a picture: programs of cameras take seconds to start.
const PICTURE_TIMEOUT: Duration = Duration::from_secs(20);

/// A picture of the camera with this configuration, as a detector would get it: the fifteenth frame, or the last of as many as
/// come within 20 s.
///
/// # Errors
/// When the camera cannot be read, or gives no frame in that time.
pub(super) fn published(config: Config) -> anyhow::Result<GrayImage> {
    published_within(config, PICTURE_TIMEOUT)
}

fn published_within(config: Config, limit: Duration) -> anyhow::Result<GrayImage> {
    block_on(async {
        let identity = Identity { service: "camera-pub", instance: config.instance().to_owned() };
        let node = Node::open(identity, &ZenohSource::Text(NO_NETWORK.to_owned())).await?;
        let taken = take(&node, config, limit).await;
        node.close().await;
        taken
    })?
}

async fn take(node: &Node, config: Config, limit: Duration) -> anyhow::Result<GrayImage> {
    let camera = config.instance().to_owned();
    let frames = node.frame_subscriber(topic::FRAME, &[&*camera]).await?;
    let mut service = camera_pub::run(node.clone(), config, Shutdown::on_signals()?);
    let mut late = pin!(tokio::time::sleep(limit));
    let mut converter = Converter::default();
    let mut newest = None;
    for _ in 0..SETTLING_FRAMES {
        let frame = tokio::select! {
            frame = frames.next() => frame.context("the session was closed")?,
            ended = &mut service => {
                if let Some(frame) = frames.waiting() {
                    newest = Some(grey(&frame, &mut converter)?);
                }
                // A program that ends is an error of the service; a few frames are enough here.
                if newest.is_none() {
                    ended?;
                }
                return newest.context("the camera ended before its first frame");
            }
            () = &mut late => break,
        };
        newest = Some(grey(&frame, &mut converter)?);
    }
    newest.with_context(|| {
        let seconds = limit.as_secs();
        format!("camera `{camera}` gave no picture within {seconds} s{}", reasons(node))
    })
}

/// The counts of the camera's service of frames that it did not publish.
fn reasons(node: &Node) -> String {
    let health = node.health().report(node.identity(), now_ns());
    let counts = health.errors.iter().chain(&health.drops);
    let reasons: Vec<_> =
        counts.map(|count| format!("{} ({})", count.reason, count.count)).collect();
    if reasons.is_empty() { String::new() } else { format!(": {}", reasons.join(", ")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The picture of a program that is run by a shell and writes JPEG files of 8 x 8 pixels.
    fn of_script(script: &str, limit: Duration) -> anyhow::Result<GrayImage> {
        let command = format!("source.command=[\"sh\", \"-c\", {script:?}]");
        let set = [&*command, "source.pixels=mjpeg", "source.size_px=[8, 8]", "source.timeout_s=5"];
        let layers = node::Layers { file: None, set: set.map(str::to_owned).into() };
        published_within(layers.load::<Config>()?.settings, limit)
    }

    #[test]
    fn a_camera_without_a_picture_is_reported_with_the_error_of_its_frames() {
        let damaged = r"while sleep 0.05; do printf '\377\330\377\331'; done";
        let problem = of_script(damaged, Duration::from_secs(2)).unwrap_err().to_string();
        let said = "camera `down` gave no picture within 2 s: unreadable image (";
        assert!(problem.starts_with(said), "{problem}");
    }

    #[test]
    fn frames_of_another_size_are_reported_with_both_sizes_within_the_timeout_of_the_source() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("seen.jpg");
        image::save_buffer(&file, &[200; 256], 16, 16, image::ExtendedColorType::L8).unwrap();
        let script = format!("while cat '{}'; do sleep 0.05; done", file.display());
        let problem = of_script(&script, Duration::from_secs(60)).unwrap_err().to_string();
        assert!(
            problem.contains("its frames have 16 x 16 pixels, 8 x 8 are configured"),
            "{problem}"
        );
    }

    #[test]
    fn of_a_slow_camera_the_last_picture_in_time_is_taken() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("seen.jpg");
        image::save_buffer(&file, &[200; 64], 8, 8, image::ExtendedColorType::L8).unwrap();
        let script = format!("cat '{}'; exec sleep 60", file.display());
        let picture = of_script(&script, Duration::from_secs(3)).unwrap();
        assert!(picture.pixels().iter().all(|level| level.abs_diff(200) < 3), "{picture:?}");
    }
}
