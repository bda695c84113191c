//! A picture as `camera-pub` publishes it, whatever its configuration reads: a device, a program, a stream or files.

use std::time::Duration;

use anyhow::Context;
use camera_pub::Config;
use imaging::{Converter, GrayImage};
use messages::topic;
use node::{Identity, Node, Shutdown, ZenohSource};

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
const SETTLING_FRAMES: usize = 10;
/// Maximum time until there is a picture: programs of cameras take seconds to start.
const PATIENCE: Duration = Duration::from_secs(20);

/// A picture of the camera with this configuration, as a detector would get it: the tenth frame, or the last of fewer.
///
/// # Errors
/// When the camera cannot be read, or gives no frame in 20 s.
pub(super) fn published(config: Config) -> anyhow::Result<GrayImage> {
    let camera = config.instance().to_owned();
    block_on(async {
        let identity = Identity { service: "camera-pub", instance: camera.clone() };
        let node = Node::open(identity, &ZenohSource::Text(NO_NETWORK.to_owned())).await?;
        let taken = tokio::time::timeout(PATIENCE, take(&node, config)).await;
        node.close().await;
        taken.with_context(|| {
            format!("camera `{camera}` gave no picture within {} s", PATIENCE.as_secs())
        })?
    })?
}

async fn take(node: &Node, config: Config) -> anyhow::Result<GrayImage> {
    let frames = node.frame_subscriber(topic::FRAME, &[config.instance()]).await?;
    let mut service = camera_pub::run(node.clone(), config, Shutdown::on_signals()?);
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
                break;
            }
        };
        newest = Some(grey(&frame, &mut converter)?);
    }
    newest.context("the camera ended before its first frame")
}
