//! A process that may lock no memory.

use std::time::Duration;

use messages::{FrameHeader, PixelFormat, topic};
use node::session::local_config;
use node::{Identity, Node, ZenohSource};
use rustix::process::{Resource, Rlimit, setrlimit};
use testing::ports;
use tokio::time::{sleep, timeout};

const PATIENCE: Duration = Duration::from_secs(20);

#[tokio::test(flavor = "multi_thread")]
async fn without_shared_memory_frames_are_copied() -> anyhow::Result<()> {
    // The limit of many containers. It is of this process, in which there is no other test.
    let limit = Some(64 << 10);
    setrlimit(Resource::Memlock, Rlimit { current: limit, maximum: limit })?;
    let ([meet], _, _) = ports::free()?;
    let source = ZenohSource::Text(local_config(meet));
    let identity = |service| Identity { service, instance: "main".into() };
    let camera = Node::open(identity("camera-pub"), &source).await?;
    let detector = Node::open(identity("detector"), &source).await?;
    let received = detector.frame_subscriber(topic::FRAME, &[]).await?;
    let frames = camera.frame_publisher(topic::FRAME, &["down"], 64 * 48).await?;
    let header = FrameHeader {
        width: 64,
        height: 48,
        format: PixelFormat::Mono8,
        parts: Vec::new(),
        ..FrameHeader::sample()
    };
    let sending = async {
        loop {
            let mut loan = frames.loan(64 * 48);
            loan.fill(77);
            frames.publish(&header, loan).await;
            sleep(Duration::from_millis(20)).await;
        }
    };
    let frame = tokio::select! {
        () = sending => None,
        frame = timeout(PATIENCE, received.next()) => frame?,
    };
    let frame = frame.expect("a frame");
    assert_eq!(frame.header, header);
    assert!(frame.bytes().len() == 64 * 48 && frame.bytes().iter().all(|pixel| *pixel == 77));
    let report = camera.health().report(camera.identity(), 0);
    assert!(report.drops.iter().any(|it| it.reason.contains("frame copied")), "{:?}", report.drops);
    camera.close().await;
    detector.close().await;
    Ok(())
}
