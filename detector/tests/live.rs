//! Tests a running detector service with a simulated camera and operator: markers of several families, changed parameters,
//! acknowledged frames of the air link, a camera in Python.

use std::time::Duration;

use airlink::{Packer, Plan};
use anyhow::{Context, ensure};
use detector::Config;
use imaging::{GrayImage, GrayView};
use markers::{Drawing, Ink};
use messages::{
    BayerPattern, CameraInfo, CommandReply, Configuration, Detections, DetectorCommand,
    FrameHeader, PixelFormat, topic,
};
use node::{
    FramePublisher, Identity, Layers, Loan, Node, Shutdown, Subscriber, ZenohSource, clock_name,
    now_ns,
};
use testing::{ports, python, python_passes};
use tokio::time::timeout;

const TIMEOUT: Duration = Duration::from_secs(30);
const MARKERS: [(&str, [f64; 2], f64); 3] = [
    ("rings", [170.0, 240.0], 180.0),
    ("apriltag-36h11:7", [430.0, 120.0], 100.0),
    ("aruco-4x4-50:3", [480.0, 350.0], 90.0),
];

/// The local configuration with another rendezvous port.
fn local(port: u16) -> ZenohSource {
    let text = include_str!("../../zenoh-config/local.json5");
    ZenohSource::Text(text.replace(":7447", &format!(":{port}")))
}

async fn open(service: &'static str, instance: &str, port: u16) -> anyhow::Result<Node> {
    Node::open(Identity { service, instance: instance.into() }, &local(port)).await
}

/// Markers of three families, seen head-on on a grey ground.
fn picture() -> anyhow::Result<GrayImage> {
    let mut image = GrayImage::filled(640, 480, 120);
    for (name, [x0, y0], size_px) in MARKERS {
        let drawing = Drawing::new(&name.parse()?, size_px).context("a drawing")?;
        for y in 0..480 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                let samples = (0..16).map(|i| {
                    let [dx, dy] = [i % 4, i / 4].map(|d| (f64::from(d) - 1.5) / 4.0);
                    let (right, up) = (x as f64 + dx - x0, y0 - y as f64 - dy);
                    match drawing.ink_at(right, up) {
                        _ if right.abs().max(up.abs()) > drawing.half_extent_m => None,
                        Ink::Black => Some(20),
                        Ink::White => Some(220),
                    }
                });
                let inked: Vec<u32> = samples.flatten().collect();
                if inked.len() == 16 {
                    *pixel = (inked.iter().sum::<u32>() / 16) as u8;
                }
            }
        }
    }
    Ok(image)
}

/// The same through a sensor of 12 bits behind a mosaic, whose red and blue are darker.
fn behind_a_mosaic(image: &GrayImage) -> Vec<u8> {
    let sample = |(i, grey): (usize, &u8)| {
        let (x, y) = (i % image.width(), i / image.width());
        let level = u16::from(*grey) * if x % 2 == y % 2 { 6 } else { 12 };
        level.to_le_bytes()
    };
    image.pixels().iter().enumerate().flat_map(sample).collect()
}

/// Publishes a picture again and again.
async fn film(frames: FramePublisher, format: PixelFormat, bytes: Vec<u8>) {
    for sequence in 0.. {
        let mut loan = frames.loan(bytes.len());
        loan.copy_from_slice(&bytes);
        let header = FrameHeader {
            sequence,
            stamp_ns: now_ns(),
            clock: clock_name().into(),
            width: 640,
            height: 480,
            format,
            ..FrameHeader::sample()
        };
        frames.publish(&header, loan).await;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

/// Waits for detections that meet a condition.
async fn until(
    detections: &Subscriber<Detections>,
    condition: &str,
    holds: impl Fn(&Detections) -> bool,
) -> anyhow::Result<Detections> {
    let wait = async {
        let mut last = None;
        while let Some(message) = detections.next().await {
            if holds(&message) {
                return Ok(message);
            }
            last = Some(message);
        }
        Err(last)
    };
    match timeout(TIMEOUT, wait).await {
        Ok(Ok(message)) => Ok(message),
        Ok(Err(last)) => Err(anyhow::anyhow!("{condition}; last: {last:?}")),
        Err(_) => Err(anyhow::anyhow!("waiting until {condition}")),
    }
}

fn names(message: &Detections) -> Vec<String> {
    let name = |family: &str, id: Option<u32>| match id {
        Some(id) => format!("{family}:{id}"),
        None => family.to_owned(),
    };
    let mut names: Vec<_> =
        message.detections.iter().map(|seen| name(&seen.family, seen.id)).collect();
    names.sort_unstable();
    names
}

fn sorted(names: &[&str]) -> Vec<String> {
    let mut names: Vec<_> = names.iter().map(|name| (*name).to_owned()).collect();
    names.sort_unstable();
    names
}

async fn set(operator: &Node, key: &str, value: &str) -> anyhow::Result<CommandReply> {
    let command = DetectorCommand::SetParameter { key: key.into(), value: value.into() };
    operator.command(topic::DETECTOR_COMMAND, &["main"], &command).await
}

async fn accept(operator: &Node, key: &str, value: &str) -> anyhow::Result<()> {
    let reply = set(operator, key, value).await?;
    ensure!(reply.accepted, "{reply:?}");
    Ok(())
}

const ALL: &str = r#"["rings:0.2", "apriltag-36h11:*:0.1", "aruco-4x4-50:3:0.1"]"#;

async fn check_live_changes(
    operator: &Node,
    detections: &Subscriber<Detections>,
) -> anyhow::Result<()> {
    let all = sorted(&MARKERS.map(|(name, _, _)| name));
    let seen = until(detections, "all families are found", |m| names(m) == all).await?;
    for detection in &seen.detections {
        let (_, [x, y], size_px) = MARKERS
            .into_iter()
            .find(|(name, _, _)| name.split(':').next() == Some(&detection.family))
            .context("a marker that was drawn")?;
        let [found_x, found_y] = detection.centre_px;
        ensure!((found_x - x).hypot(found_y - y) < 0.2, "{detection:?}");
        ensure!((detection.size_px / size_px - 1.0).abs() < 0.5, "{detection:?}");
        ensure!(detection.centre_covariance_px2.iter().all(|c| c.is_finite()), "{detection:?}");
    }
    ensure!(!seen.stages.is_empty());

    accept(operator, "tracking.enabled", "true").await?;
    for _ in 0..5 {
        until(detections, "all are followed", |m| names(m) == all).await?;
    }
    accept(operator, "markers", "[\"aruco-4x4-50:*\"]").await?;
    let only = sorted(&["aruco-4x4-50:3"]);
    until(detections, "only ArUco is found", |m| names(m) == only).await?;

    for (key, value, part) in [
        ("markers", "[\"hexagons:1\"]", "no family `hexagons`"),
        ("min_confidence", "1.5", "from 0 to 1"),
        ("mn_confidence", "0.5", "did you mean `min_confidence`"),
        ("camera", "other", "start the detector again"),
    ] {
        let reply = set(operator, key, value).await?;
        ensure!(!reply.accepted && reply.reason.contains(part), "{reply:?}");
    }
    until(detections, "only ArUco is still found", |m| names(m) == only).await?;
    accept(operator, "min_confidence", "1").await?;
    until(detections, "no confidence is sufficient", |m| m.detections.is_empty()).await?;
    accept(operator, "min_confidence", "0").await?;
    accept(operator, "markers", ALL).await?;
    until(detections, "all families are found again", |m| names(m) == all).await?;
    Ok(())
}

/// The response that was configured is published, and later that it is not known any more; late subscribers get it as well.
async fn check_response(operator: &Node) -> anyhow::Result<()> {
    let responses = operator.subscriber(topic::CAMERA_RESPONSE, &["main"]).await?;
    let configured = async {
        while !responses.next().await.context("a response")?.configured {}
        let late = operator.subscriber(topic::CAMERA_RESPONSE, &["main"]).await?;
        late.next().await.context("the last response")
    };
    let received = timeout(TIMEOUT, configured).await.context("waiting for the response")??;
    ensure!(
        (received.curve, received.sharpening) == (1.1, 0.5) && received.camera == "down",
        "{received:?}"
    );
    accept(operator, "response", "\"auto\"").await?;
    // These frames, whose camera is not calibrated, give no estimate.
    let estimated = async {
        while responses.next().await.context("a response")?.configured {}
        let late = operator.subscriber(topic::CAMERA_RESPONSE, &["main"]).await?;
        late.next().await.context("the last response")
    };
    let received = timeout(TIMEOUT, estimated).await.context("waiting for another response")??;
    ensure!(
        (received.configured, received.markers, received.curve) == (false, 0, 0.0),
        "{received:?}"
    );
    Ok(())
}

/// A detector publishes its configuration with the last change, also for late subscribers.
#[tokio::test(flavor = "multi_thread")]
async fn a_changed_parameter_is_in_the_published_configuration() -> anyhow::Result<()> {
    let ([port], _, _) = ports::free()?;
    let node = open("detector", "main", port).await?;
    let operator = open("alight", "test", port).await?;
    let layers = Layers { file: None, set: vec![format!("markers={ALL}")] };
    let config = layers.load::<Config>()?;
    let (publishing, toml) = (node.clone(), config.table.to_string());
    let publishing = tokio::spawn(async move { publishing.publish_configuration(toml).await });
    let service = tokio::spawn(detector::run(node, config.settings, Shutdown::on_signals()?));
    let received = operator.subscriber(topic::CONFIGURATION, &["detector", "main"]).await?;
    let next_with = async |received: &Subscriber<Configuration>, value: &str| {
        let wait = async {
            while let Some(Configuration { toml, .. }) = received.next().await {
                // The others stay.
                ensure!(toml.contains("aruco-4x4-50:3:0.1"), "{toml}");
                if toml.lines().any(|line| line == format!("min_confidence = {value}")) {
                    return Ok(());
                }
            }
            anyhow::bail!("the session is closed")
        };
        timeout(TIMEOUT, wait).await.with_context(|| format!("waiting for {value}"))?
    };
    next_with(&received, "0.0").await?;
    ensure!(!set(&operator, "min_confidence", "1.5").await?.accepted);
    accept(&operator, "min_confidence", "0.75").await?;
    next_with(&received, "0.75").await?;
    let late = operator.subscriber(topic::CONFIGURATION, &["detector", "main"]).await?;
    next_with(&late, "0.75").await?;
    publishing.abort();
    service.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn several_families_are_found_and_parameters_change_while_it_runs() -> anyhow::Result<()> {
    let ([port], _, _) = ports::free()?;
    let (camera, node) =
        (open("camera-pub", "down", port).await?, open("detector", "main", port).await?);
    let operator = open("alight", "test", port).await?;
    let layers = Layers { file: None, set: vec![format!("markers={ALL}")] };
    let config = layers.load::<Config>()?.settings;
    let service = tokio::spawn(detector::run(node, config, Shutdown::on_signals()?));
    let detections = operator.subscriber(topic::DETECTIONS, &["main"]).await?;
    let image = picture()?;
    let grey = image.pixels().to_vec();
    let mosaic = behind_a_mosaic(&image);
    let formats = [(PixelFormat::Mono8, grey), (PixelFormat::Bayer12(BayerPattern::Rggb), mosaic)];
    for (format, bytes) in formats {
        let frames = camera.frame_publisher(topic::FRAME, &["down"], bytes.len()).await?;
        let filming = tokio::spawn(film(frames, format, bytes));
        until(&detections, "its frames are searched", |m| m.header.format == format).await?;
        check_live_changes(&operator, &detections).await.with_context(|| format!("{format:?}"))?;
        accept(&operator, "tracking.enabled", "false").await?;
        accept(&operator, "response", "\"1.1,0.5\"").await?;
        check_response(&operator).await?;
        filming.abort();
    }
    service.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_response_that_is_not_configured_any_more_is_no_last_value_also_without_a_camera()
-> anyhow::Result<()> {
    let ([port], _, _) = ports::free()?;
    let node = open("detector", "main", port).await?;
    let operator = open("alight", "test", port).await?;
    let set = vec![format!("markers={ALL}"), "response=1.1,0.5".into()];
    let config = Layers { file: None, set }.load::<Config>()?.settings;
    let service = tokio::spawn(detector::run(node, config, Shutdown::on_signals()?));
    check_response(&operator).await?;
    service.abort();
    Ok(())
}

/// A frame of the air link, of noise, in which a search takes its time.
async fn send_noise(
    jpegs: &FramePublisher,
    sequence: u64,
    width: usize,
    height: usize,
) -> anyhow::Result<()> {
    let mut state = 1_u32;
    let noise = (0..width * height).map(|_| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 24) as u8
    });
    let noise: Vec<u8> = noise.collect();
    let header = FrameHeader {
        sequence,
        stamp_ns: now_ns(),
        clock: clock_name().into(),
        width: width as u32,
        height: height as u32,
        ..FrameHeader::sample()
    };
    let plan = Plan { quality: 75, overview_quality: 75, parts: Vec::new() };
    let view = GrayView::packed(&noise, width, height)?;
    let (header, bytes) = Packer::default().pack(view, &header, &plan)?;
    jpegs.publish(&header, Loan::Private(bytes)).await;
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_frame_of_the_air_link_is_acknowledged_while_another_is_searched() -> anyhow::Result<()> {
    let ([port], _, _) = ports::free()?;
    let (camera, node) =
        (open("camera-pub", "down", port).await?, open("detector", "main", port).await?);
    let operator = open("alight", "test", port).await?;
    let set = vec!["input=jpeg".into(), format!("markers={ALL}")];
    let config = Layers { file: None, set }.load::<Config>()?.settings;
    let detections = operator.subscriber(topic::DETECTIONS, &["main"]).await?;
    let acks = camera.subscriber(topic::FRAME_ACK, &["main"]).await?;
    let jpegs = camera.frame_publisher(topic::JPEG, &["down"], 0).await?;
    let service = tokio::spawn(detector::run(node, config, Shutdown::on_signals()?));
    let watched = async {
        while !jpegs.has_subscribers().await {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        // Where the search has not begun before the small frame comes, that one replaces the large one: then once more.
        for large in [1, 3, 5, 7, 9] {
            let small = large + 1;
            send_noise(&jpegs, large, 4000, 3000).await?;
            let ack = acks.next().await.context("an acknowledgement")?;
            ensure!(ack.sequence == large, "{ack:?}");
            send_noise(&jpegs, small, 64, 48).await?;
            let (ack, found) = tokio::select! {
                biased;
                ack = acks.next() => (ack, None),
                found = detections.next() => (None, found),
            };
            if found.as_ref().is_some_and(|found| found.header.sequence == large) {
                anyhow::bail!("the second frame waited for the search of the first");
            }
            let (ack, found) = match (ack, found) {
                (Some(ack), None) => (Some(ack), detections.next().await),
                (None, found) => (acks.next().await, found),
                both => both,
            };
            ensure!(ack.as_ref().is_some_and(|ack| ack.sequence == small), "{ack:?}");
            let found = found.context("detections")?;
            if found.header.sequence == small {
                continue;
            }
            ensure!(found.header.sequence == large, "{found:?}");
            let found = detections.next().await.context("detections of the second frame")?;
            ensure!(found.header.sequence == small, "{found:?}");
            return Ok(());
        }
        anyhow::bail!("the small frame always came before the search of the large one began")
    };
    timeout(TIMEOUT, watched).await.context("waiting for acknowledgements and detections")??;
    service.abort();
    Ok(())
}

/// The distance of the marker `rings` along the camera's axis, in metres.
fn rings_m(message: &Detections) -> Option<f64> {
    let rings = message.detections.iter().find(|seen| seen.family == "rings")?;
    Some(rings.pose.as_ref()?.camera_from_marker.translation_m[2])
}

/// A camera sends its next frame over the air link when the last one is acknowledged.
#[test]
fn the_detector_in_python_acknowledges_a_frame_before_it_looks_at_it() -> anyhow::Result<()> {
    let Some(acks) = python("detector/tests/python/acks.py", &[]) else { return Ok(()) };
    python_passes(&acks.wait_with_output()?).map(drop)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_camera_in_python_is_searched_and_no_other_client_gives_its_calibration()
-> anyhow::Result<()> {
    let script = "camera-pub/examples/python/camera.py";
    let Some(probe) = python(script, &["--help"]) else { return Ok(()) };
    if !python_passes(&probe.wait_with_output()?)? {
        return Ok(());
    }
    let ([port], _, _) = ports::free()?;
    let node = open("detector", "main", port).await?;
    let health = node.shared_health();
    let other = open("camera-pub", "other-client", port).await?;
    let layers = Layers { file: None, set: vec![format!("markers={ALL}")] };
    let service = tokio::spawn(detector::run(
        node,
        layers.load::<Config>()?.settings,
        Shutdown::on_signals()?,
    ));
    let detections = other.subscriber(topic::DETECTIONS, &["main"]).await?;
    let infos = other.subscriber(topic::CAMERA_INFO, &["down"]).await?;
    let image = picture()?;
    let picture = std::env::temp_dir().join(format!("alight-camera-{}.pgm", std::process::id()));
    let header = format!("P5 {} {} 255\n", image.width(), image.height());
    std::fs::write(&picture, [header.as_bytes(), image.pixels()].concat())?;
    let path = picture.to_str().context("a path")?;
    let connect = format!("tcp/127.0.0.1:{port}");
    let args = ["--picture", path, "--focal-px", "1000", "--connect", &connect];
    let mut camera = python(script, &args).context("it started a moment ago")?;
    let watched = async {
        let seen = until(&detections, "it has a pose", |m| rings_m(m).is_some()).await?;
        ensure!(seen.header.clock == clock_name(), "{seen:?}");
        // 180 pixels of 0.2 m, seen with 1000 pixels.
        let distance_m = rings_m(&seen).context("a pose")?;
        ensure!((distance_m - 1.11).abs() < 0.06, "{distance_m} m");
        let info = timeout(TIMEOUT, infos.next()).await?.context("its calibration")?;
        ensure!(info.body_from_camera == CameraInfo::sample().body_from_camera, "{info:?}");
        let false_infos = other.publisher(topic::CAMERA_INFO, &["down"]).await?;
        for focal_px in [f64::NAN, 500.0, 2000.0].repeat(5) {
            false_infos
                .publish(&CameraInfo { focal_px: Some([focal_px; 2]), ..info.clone() })
                .await;
            for _ in 0..2 {
                let seen = timeout(TIMEOUT, detections.next()).await?.context("detections")?;
                ensure!(rings_m(&seen).is_none_or(|m| (m - 1.11).abs() < 0.06), "{seen:?}");
            }
        }
        let misnamed = CameraInfo { camera: "front".into(), ..info.clone() };
        false_infos.publish(&misnamed).await;
        let publisher = other.frame_publisher(topic::FRAME, &["down"], 0).await?;
        let header = FrameHeader { camera: "front".into(), width: 1, height: 1, ..seen.header };
        let is_counted = |kind: &str| {
            health.failures(&format!("{kind} that names another camera than its key")) > 0
        };
        let counted = timeout(TIMEOUT, async {
            while !(is_counted("camera info") && is_counted("frame")) {
                publisher.publish(&header, publisher.loan(1)).await;
                tokio::time::sleep(Duration::from_millis(7)).await;
            }
        });
        counted.await.context("messages of another camera are counted")?;
        anyhow::Ok(())
    };
    let watched = watched.await;
    camera.kill()?;
    camera.wait()?;
    std::fs::remove_file(&picture)?;
    service.abort();
    watched
}
