//! Tests the dashboard's H.264 over RTP from a simulated camera: a program in Python receives and decodes it without
//! errors.

use std::path::PathBuf;
use std::time::Duration;

use anyhow::{Context, ensure};
use dashboard::Config;
use messages::{FrameHeader, PixelFormat, topic};
use node::{Identity, Layers, Node, Shutdown, ZenohSource, clock_name, now_ns};
use serde_json::Value;
use testing::ports;
use tokio::task::JoinHandle;
use tokio::time::{MissedTickBehavior, interval, timeout};

const WIDTH: usize = 1296;
const HEIGHT: usize = 972;
const RATE_HZ: f64 = 15.0;
const PICTURES: usize = 60;
const TIMEOUT: Duration = Duration::from_secs(90);

async fn open(service: &'static str, meet: u16) -> anyhow::Result<Node> {
    let source = ZenohSource::Text(node::session::local_config(meet));
    Node::open(Identity { service, instance: "main".into() }, &source).await
}

/// A camera whose frames have their number in sixteen squares, over a moving background.
fn camera(node: Node) -> JoinHandle<anyhow::Result<()>> {
    tokio::spawn(async move {
        let frames = node.frame_publisher(topic::FRAME, &["down"], WIDTH * HEIGHT).await?;
        let mut due = interval(Duration::from_secs_f64(1.0 / RATE_HZ));
        due.set_missed_tick_behavior(MissedTickBehavior::Delay);
        for number in 0_usize.. {
            due.tick().await;
            let mut loan = frames.loan(WIDTH * HEIGHT);
            for (row, line) in loan.chunks_mut(WIDTH).enumerate() {
                for (column, pixel) in line.iter_mut().enumerate() {
                    let (x, y) = (column + 3 * number, row + number);
                    *pixel = 60 + ((x / 7 * 31 + y / 5 * 17) % 97) as u8;
                }
                for (bit, square) in line.chunks_mut(32).take(16).enumerate().filter(|_| row < 32) {
                    square.fill(if number >> bit & 1 == 1 { 250 } else { 5 });
                }
            }
            let header = FrameHeader {
                camera: "down".into(),
                clock: clock_name().into(),
                sequence: number as u64,
                stamp_ns: now_ns(),
                width: WIDTH as u32,
                height: HEIGHT as u32,
                format: PixelFormat::Mono8,
                ..FrameHeader::sample()
            };
            frames.publish(&header, loan).await;
        }
        Ok(())
    })
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_is_decoded_without_errors() -> anyhow::Result<()> {
    let ([meet, port], neighbours, _) = ports::free()?;
    // RTP uses an even port, and its control the next one.
    let to = (neighbours + 1) & !1;
    let set = [
        format!("listen=127.0.0.1:{port}"),
        format!("video.rtp=127.0.0.1:{to}"),
        "video.rtp_kbit_s=4000".to_owned(),
    ];
    let config = Layers { file: None, set: set.into() }.load::<Config>()?.settings;
    let node = open("dashboard", meet).await?;
    let serving = tokio::spawn(dashboard::run(node.clone(), config, Shutdown::on_signals()?));
    let filming = camera(open("camera-pub", meet).await?);
    let script = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/dashboard/rtp.py");
    let run = tokio::process::Command::new(testing::interpreter())
        .arg(script)
        .args([to.to_string(), PICTURES.to_string()])
        .kill_on_drop(true)
        .output();
    let output = match timeout(TIMEOUT, run).await.context("the stream does not end")? {
        Ok(output) => output,
        Err(error) => {
            testing::skip("python", format_args!("it does not start: {error}"));
            return Ok(());
        }
    };
    if !testing::python_passes(&output)? {
        return Ok(());
    }
    let text = String::from_utf8_lossy(&output.stdout);
    let result: Value = serde_json::from_str(text.lines().last().context("no output")?)?;
    ensure!(result["size"] == serde_json::json!([WIDTH, HEIGHT]), "{result}");
    // A busy machine may leave some out, and so may a receiver's buffer.
    ensure!(result["steps_of_1"].as_u64() > Some(PICTURES as u64 / 2), "{result}");
    let report = node.health().report(node.identity(), 0);
    let latency = report.latencies.iter().find(|it| it.name == "frame to stream");
    println!("{result}; frame to stream: {:?}", latency.context("no latency")?);
    filming.abort();
    serving.abort();
    Ok(())
}
