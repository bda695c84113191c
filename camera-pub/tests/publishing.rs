//! Tests the camera service from the side of its subscribers: folders of images, programs with raw frames and metadata,
//! ffmpeg, repeated pictures, Bayer samples, JPEG, rates, and errors.

use std::path::Path;
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use camera_pub::Config;
use image::{GrayImage, Luma, RgbImage};
use messages::{BayerPattern, PixelFormat, topic};
use node::{Identity, Layers, Node, Shutdown, ZenohSource, now_ns};
use testing::{ports, until};
use tokio::time::timeout;

const TIMEOUT: Duration = Duration::from_secs(20);

/// The local configuration with another rendezvous port.
fn local(port: u16) -> ZenohSource {
    let text = include_str!("../../zenoh-config/local.json5");
    ZenohSource::Text(text.replace(":7447", &format!(":{port}")))
}

fn free_port() -> anyhow::Result<u16> {
    let ([port], _, _) = ports::free()?;
    Ok(port)
}

async fn open(service: &'static str, port: u16) -> anyhow::Result<Node> {
    Node::open(Identity { service, instance: "down".into() }, &local(port)).await
}

fn config(folder: &Path, set: &[&str]) -> anyhow::Result<Config> {
    let mut layers = Layers::default();
    layers.set.push(format!("source.paths=[{:?}]", folder.display().to_string()));
    layers.set.extend(set.iter().map(|s| (*s).to_owned()));
    Ok(layers.load::<Config>()?.settings)
}

/// A camera program that writes frames of 64 x 48 pixels.
fn program(command: &[&str], set: &[&str]) -> anyhow::Result<Config> {
    let mut layers = Layers::default();
    layers.set.push(format!("source.command={command:?}"));
    layers.set.push("source.size_px=[64, 48]".into());
    layers.set.extend(set.iter().map(|s| (*s).to_owned()));
    Ok(layers.load::<Config>()?.settings)
}

/// Two grey images, a smaller coloured one, and two files that are not images.
fn folder_of_images() -> anyhow::Result<tempfile::TempDir> {
    let folder = tempfile::tempdir()?;
    let path = |name: &str| folder.path().join(name);
    let image = GrayImage::from_fn(64, 48, |x, y| Luma([(x + y) as u8]));
    image.save(path("1.png"))?;
    std::fs::write(path("2.png"), "not an image")?;
    RgbImage::from_pixel(32, 24, image::Rgb([0, 255, 0])).save(path("3.png"))?;
    let whole = std::fs::read(path("1.png"))?;
    std::fs::write(path("4.jpg"), whole.get(..60).context("a longer file")?)?;
    GrayImage::from_pixel(64, 48, Luma([200])).save(path("5.jpg"))?;
    Ok(folder)
}

#[tokio::test(flavor = "multi_thread")]
async fn images_become_frames_in_order_and_unreadable_ones_are_counted() -> anyhow::Result<()> {
    let folder = folder_of_images()?;
    let port = free_port()?;
    let (camera, detector) = (open("camera-pub", port).await?, open("detector", port).await?);
    let frames = detector.frame_subscriber(topic::FRAME, &["down"]).await?;
    let set =
        ["source.rate_hz=50", "source.wait_for_subscriber=true", "calibration.focal_px=[100, 100]"];
    let service =
        camera_pub::run(camera.clone(), config(folder.path(), &set)?, Shutdown::on_signals()?);
    let listening = async {
        let mut expected = None;
        for _ in 0..7 {
            let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
            let header = &frame.header;
            ensure!(header.camera == "down" && header.format == PixelFormat::Mono8);
            ensure!(header.stamp_ns <= now_ns());
            // Only the newest frame is stored: a slow test may miss some.
            ensure!(expected.is_none_or(|expected| header.sequence >= expected));
            expected = Some(header.sequence + 1);
            let bytes = frame.bytes();
            match header.sequence % 3 {
                0 => ensure!((header.width, header.height, bytes[64 + 5]) == (64, 48, 6)),
                1 => ensure!((header.width, header.height, bytes[0]) == (32, 24, 150)),
                _ => ensure!((header.width, header.height, bytes[0]) == (64, 48, 200)),
            }
        }
        let infos = detector.subscriber(topic::CAMERA_INFO, &["down"]).await?;
        let info = timeout(TIMEOUT, infos.next()).await?.context("a camera info")?;
        ensure!(info.focal_px == Some([100.0, 100.0]) && (info.width, info.height) == (64, 48));
        ensure!(detector.alive("camera-pub", "*").await? == ["down"]);
        Ok(())
    };
    tokio::select! {
        result = service => result.and(Err(anyhow::anyhow!("the service ended"))),
        result = listening => result,
    }?;
    let health = camera.health().report(camera.identity(), now_ns());
    let failed = |reason: &str| health.errors.iter().find(|e| e.reason == reason).map(|e| e.count);
    ensure!(failed("unreadable image").is_some_and(|count| count >= 2), "{health:?}");
    ensure!(failed("image of another size").is_some(), "{health:?}");
    ensure!(health.drops.is_empty(), "{health:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn raw_16_bit_bayer_samples_are_published_unchanged() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let image = image::ImageBuffer::from_fn(6, 4, |x, y| Luma([(1000 * x + y) as u16]));
    image.save(folder.path().join("1.png"))?;
    let port = free_port()?;
    let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
    let config = config(folder.path(), &["source.rate_hz=50", "source.bayer=GBRG"])?;
    let service = tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
    let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
    let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
    ensure!(frame.header.format == PixelFormat::Bayer16(BayerPattern::Gbrg));
    ensure!(frame.bytes().len() == 6 * 4 * 2 && frame.bytes()[2..4] == 1000_u16.to_le_bytes());
    ensure!(camera.health().report(camera.identity(), now_ns()).drops.is_empty());
    service.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn jpegs_are_made_while_there_is_a_subscriber() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    GrayImage::from_pixel(64, 48, Luma([200])).save(folder.path().join("1.png"))?;
    let port = free_port()?;
    let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
    let config = config(folder.path(), &["source.rate_hz=50"])?;
    let service = tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
    let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
    timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
    ensure!(camera.health().percentiles("jpeg").is_none(), "a JPEG was made without a subscriber");
    let jpegs = viewer.frame_subscriber(topic::JPEG, &["down"]).await?;
    let jpeg = timeout(TIMEOUT, jpegs.next()).await?.context("a JPEG")?;
    ensure!(jpeg.header.format == PixelFormat::Jpeg && jpeg.header.width == 64);
    let decoded = image::load_from_memory(&jpeg.bytes())?.to_luma8();
    ensure!(decoded.dimensions() == (64, 48) && decoded.get_pixel(9, 9)[0].abs_diff(200) < 3);
    service.abort();
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_is_published_once_without_repeat() -> anyhow::Result<()> {
    let folder = folder_of_images()?;
    let camera = open("camera-pub", free_port()?).await?;
    let config = config(folder.path(), &["source.rate_hz=1000", "source.repeat=false"])?;
    timeout(TIMEOUT, camera_pub::run(camera.clone(), config, Shutdown::on_signals()?)).await??;
    let health = camera.health().report(camera.identity(), now_ns());
    ensure!(health.rates.iter().any(|r| r.name == "frames" && r.count == 3), "{health:?}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_start_without_images_is_an_error_with_its_reason() -> anyhow::Result<()> {
    let camera = open("camera-pub", free_port()?).await?;
    let folder = tempfile::tempdir()?;
    let problem = async |config: Config| -> anyhow::Result<String> {
        let result = camera_pub::run(camera.clone(), config, Shutdown::on_signals()?).await;
        Ok(result.err().context("an error")?.to_string())
    };
    let nothing = problem(Layers::default().load::<Config>()?.settings).await?;
    ensure!(
        nothing.contains("`source.paths`") && nothing.contains("`source.command`"),
        "{nothing}"
    );
    let missing = problem(config(&folder.path().join("none"), &[])?).await?;
    ensure!(missing.contains("does not exist") && missing.contains("none"), "{missing}");
    let empty = problem(config(folder.path(), &[])?).await?;
    ensure!(empty.contains("holds no images"), "{empty}");
    std::fs::write(folder.path().join("1.png"), "text")?;
    let unreadable = problem(config(folder.path(), &[])?).await?;
    ensure!(unreadable.contains("none of the 1 images can be read"), "{unreadable}");
    GrayImage::from_pixel(64, 48, Luma([200])).save(folder.path().join("2.png"))?;
    let too_large = problem(config(folder.path(), &["source.max_megapixels=0.003"])?).await?;
    ensure!(too_large.contains("none of the 2 images"), "{too_large}");
    std::fs::remove_file(folder.path().join("1.png"))?;
    let too_large = problem(config(folder.path(), &["source.max_megapixels=0.003"])?).await?;
    ensure!(too_large.contains("smaller, or raise `source.max_megapixels`"), "{too_large}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_rate_is_the_configured_one() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    for i in 0..60 {
        GrayImage::from_pixel(64, 48, Luma([i])).save(folder.path().join(format!("{i:02}.png")))?;
    }
    let camera = open("camera-pub", free_port()?).await?;
    let config = config(folder.path(), &["source.rate_hz=40", "source.repeat=false"])?;
    let began = now_ns();
    camera_pub::run(camera.clone(), config, Shutdown::on_signals()?).await?;
    // 59 periods of 25 ms; a busy machine may take longer, but none may be faster.
    ensure!(now_ns() - began >= 59 * 25_000_000, "{} ns", now_ns() - began);
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn frames_of_a_program_are_stamped_with_their_arrival() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("picture");
    // Rows of 64 pixels, padded to 80 bytes, then chroma.
    let rows = (0..48_u8).flat_map(|y| (0..80_u8).map(move |x| if x < 64 { x + y } else { 255 }));
    std::fs::write(&path, rows.chain([128; 2 * 40 * 24]).collect::<Vec<_>>())?;
    let forever = format!("while sleep 0.05; do cat '{}'; done", path.display());
    let set = [
        "source.pixels=yuv420",
        "source.row_bytes=80",
        "source.delay_ms=1000",
        "calibration.focal_px=[100, 100]",
    ];
    let config = program(&["sh", "-c", &forever], &set)?;
    let port = free_port()?;
    let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
    let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
    let service = tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
    for _ in 0..3 {
        let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
        let (header, bytes) = (&frame.header, frame.bytes());
        ensure!(header.format == PixelFormat::Mono8 && (header.width, header.height) == (64, 48));
        ensure!(bytes.len() == 64 * 48 && bytes[63] == 63 && bytes[64] == 1 && bytes[3071] == 110);
        ensure!(header.stamp_ns <= now_ns() - 1_000_000_000, "the delay is not in the stamp");
        ensure!(header.stamp_ns > now_ns() - 1_000_000_000 - TIMEOUT.as_nanos() as i64);
    }
    let infos = viewer.subscriber(topic::CAMERA_INFO, &["down"]).await?;
    let info = timeout(TIMEOUT, infos.next()).await?.context("a camera info")?;
    ensure!(info.focal_px == Some([100.0, 100.0]) && (info.width, info.height) == (64, 48));
    service.abort();
    camera.close().await;
    viewer.close().await;
    Ok(())
}

/// A still picture is published again and again, one that a camera repeats is not.
#[tokio::test(flavor = "multi_thread")]
async fn a_picture_that_is_repeated_is_published_once() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let path = folder.path().join("picture");
    let show = |level: u8| {
        let next = folder.path().join("next");
        let mut samples = [level; 64 * 48];
        samples[0] = 200;
        std::fs::write(&next, samples)?;
        std::fs::rename(next, &path)
    };
    show(1)?;
    let forever = format!("while sleep 0.05; do cat '{}'; done", path.display());
    let config = program(&["sh", "-c", &forever], &[])?;
    let port = free_port()?;
    let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
    let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
    let service = tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
    let mut stamp_ns = 0;
    for level in [1, 1, 1, 2, 3] {
        show(level)?;
        let frame = loop {
            let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
            // Of the one before some may be on their way.
            if level != 2 || frame.bytes()[1] != 1 {
                break frame;
            }
        };
        let is_shown = frame.bytes().iter().skip(1).all(|&sample| sample == level);
        ensure!(is_shown, "not {level}");
        ensure!(frame.header.stamp_ns > stamp_ns, "its stamp is not newer");
        stamp_ns = frame.header.stamp_ns;
        if level > 1 {
            let repeats = || camera.health().failures("camera repeats one picture");
            let is_counted = async || repeats() + 1 >= u64::from(level);
            tokio::select! {
                repeats = until("the repeated picture is counted", TIMEOUT, is_counted) => repeats?,
                _ = frames.next() => bail!("the repeated picture {level} is published again"),
            }
        }
    }
    service.abort();
    camera.close().await;
    viewer.close().await;
    Ok(())
}

/// The first frame of a program whose pixels are all this sample of gray16, with these keys.
async fn frame_of_samples(sample: u16, set: &[&str]) -> anyhow::Result<(PixelFormat, Vec<u8>)> {
    let file = tempfile::NamedTempFile::new()?;
    std::fs::write(file.path(), sample.to_le_bytes().repeat(64 * 48))?;
    let forever = format!("while sleep 0.05; do cat '{}'; done", file.path().display());
    let set = [&["source.pixels=gray16"], set].concat();
    let config = program(&["sh", "-c", &forever], &set)?;
    let port = free_port()?;
    let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
    let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
    let service = tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
    let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
    let seen = (frame.header.format, frame.bytes().to_vec());
    service.abort();
    camera.close().await;
    viewer.close().await;
    Ok(seen)
}

#[tokio::test(flavor = "multi_thread")]
async fn samples_of_10_to_14_bits_are_as_bright_as_their_value() -> anyhow::Result<()> {
    let behind_filters = PixelFormat::Bayer12(BayerPattern::Rggb);
    for (bits, bayer, expected, published) in [
        (10, "source.bayer=", PixelFormat::Mono10, 1_u16 << 9),
        (12, "source.bayer=RGGB", behind_filters, 1 << 11),
        // No format has 14 bits: the samples become those of 16.
        (14, "source.bayer=", PixelFormat::Mono16, 1 << 15),
    ] {
        let (sample, key) = (1_u16 << (bits - 1), format!("source.bits={bits}"));
        let (format, pixels) = frame_of_samples(sample, &[&key, "source.binning=2"]).await?;
        ensure!(format == PixelFormat::Mono8 && pixels.len() == 32 * 24, "{bits}: {format:?}");
        ensure!(pixels.iter().all(|pixel| pixel.abs_diff(128) <= 1), "{bits}: {:?}", pixels[0]);
        let (format, pixels) = frame_of_samples(sample, &[&key, bayer]).await?;
        ensure!(format == expected && pixels.len() == 64 * 48 * 2, "{bits}: {format:?}");
        let pairs = pixels.as_chunks::<2>().0;
        ensure!(pairs.iter().all(|pair| *pair == published.to_le_bytes()), "{bits}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_error_states_how_a_camera_program_ended() -> anyhow::Result<()> {
    let problem = async |command: &[&str], set: &[&str]| -> anyhow::Result<String> {
        let config = program(command, set)?;
        let camera = open("camera-pub", free_port()?).await?;
        let service = camera_pub::run(camera, config, Shutdown::on_signals()?);
        let problem = timeout(TIMEOUT, service).await?.err().context("an error")?;
        Ok(format!("{problem:#}"))
    };
    let missing = problem(&["no-such-camera-program"], &[]).await?;
    ensure!(missing.contains("`no-such-camera-program`"), "{missing}");
    let ended = problem(&["sh", "-c", "head -c 3072 /dev/zero; exit 3"], &[]).await?;
    ensure!(ended.contains("`sh` ended (exit status: 3) after 1 frames"), "{ended}");
    let cut = problem(&["head", "-c", "5000", "/dev/zero"], &[]).await?;
    ensure!(cut.contains("incomplete") && cut.contains("after 1 frames"), "{cut}");
    let silent = problem(&["sleep", "60"], &["source.timeout_s=0.2"]).await?;
    ensure!(silent.contains("no frame from `sleep` for 0.2 s"), "{silent}");
    let stuck = ["sh", "-c", "head -c 100 /dev/zero; exec sleep 60"];
    let stuck = problem(&stuck, &["source.timeout_s=3"]).await?;
    ensure!(stuck.contains("in the middle of a frame"), "{stuck}");
    let other = problem(&["head", "-c", "900000", "/dev/zero"], &["source.pixels=mjpeg"]).await?;
    ensure!(other.contains("is `source.pixels` the format it writes"), "{other}");
    let fast = ["sh", "-c", "while head -c 3072 /dev/zero; do sleep 0.001; done"];
    let fast = problem(&fast, &["source.rate_hz=0.1", "source.timeout_s=3"]).await?;
    ensure!(fast.contains("`source.rate_hz` (0.1)"), "{fast}");
    Ok(())
}

#[tokio::test(flavor = "multi_thread")]
async fn a_missing_device_and_one_other_than_a_camera_are_named() -> anyhow::Result<()> {
    for (device, reason) in [("/dev/video-none", "not connected"), ("/dev/null", "VIDIOC_QUERYCAP")]
    {
        let mut layers = Layers::default();
        layers.set.push(format!("source.device={device}"));
        layers.set.push("source.size_px=[64, 48]".into());
        let camera = open("camera-pub", free_port()?).await?;
        let config = layers.load::<Config>()?.settings;
        let service = camera_pub::run(camera, config, Shutdown::on_signals()?);
        let problem = timeout(TIMEOUT, service).await?.err().context("an error")?;
        let problem = format!("{problem:#}");
        ensure!(problem.contains(device) && problem.contains(reason), "{problem}");
        ensure!(problem.contains("`source.device`"), "{problem}");
    }
    Ok(())
}

/// A camera program that writes as `rpicam-vid` does; `None` where there is no Python.
fn rpicam(fault: &str) -> anyhow::Result<Option<Config>> {
    let python = testing::interpreter();
    if std::process::Command::new(&python).arg("--version").output().is_err() {
        testing::skip("python", "it does not start");
        return Ok(None);
    }
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/rpicam.py");
    let set = ["source.rate_hz=25", "source.readout_ms=20", "source.delay_ms=28"];
    program(&[&python, script, "{metadata}", fault], &set).map(Some)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_programs_metadata_stamp_each_frame_with_the_middle_of_its_own_exposure()
-> anyhow::Result<()> {
    let outcomes = tokio::try_join!(
        stamps_are_exact("none", 20),
        stamps_are_exact("late", 12),
        stamps_are_exact("torn", 12),
        stamps_are_exact("doubled", 15),
        stamps_are_exact("lost", 12),
    )?;
    println!("{outcomes:#?}");
    Ok(())
}

/// Reads 40 frames of a program with this fault: no stamp is that of another frame, and so many are exact.
async fn stamps_are_exact(fault: &str, min_exact: u32) -> anyhow::Result<String> {
    let Some(config) = rpicam(fault)? else { return Ok(String::new()) };
    let port = free_port()?;
    let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
    let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
    let service = tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
    let (mut exact, mut inexact) = (0, 0);
    let mut worst_ns = 0;
    while exact + inexact < 40 {
        let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
        let bytes = frame.bytes();
        let number = u16::from_le_bytes([bytes[0], bytes[1]]);
        let sensor_ns = i64::from_le_bytes(bytes[2..10].try_into()?) - node::boot_ahead_ns();
        // The first row had been exposed for 4 ms; the middle row is read 10 ms later.
        let error_ns = frame.header.stamp_ns - (sensor_ns - 2_000_000 + 10_000_000);
        match frame.header.exposure_ns {
            0 => inexact += 1,
            exposure_ns => {
                ensure!(exposure_ns == 4_000_000, "{fault}, frame {number}: {exposure_ns} ns");
                ensure!(error_ns.abs() < 1_000_000, "{fault}, frame {number}: {error_ns} ns");
                worst_ns = worst_ns.max(error_ns.abs());
                exact += 1;
            }
        }
    }
    ensure!(exact >= min_exact, "{fault}: only {exact} frames have an exact stamp");
    service.abort();
    camera.close().await;
    viewer.close().await;
    Ok(format!("{fault}: {exact} exact, {inexact} by arrival, worst error {worst_ns} ns"))
}

#[tokio::test(flavor = "multi_thread")]
async fn metadata_of_another_clock_are_refused() -> anyhow::Result<()> {
    let Some(config) = rpicam("clock")? else { return Ok(()) };
    let camera = open("camera-pub", free_port()?).await?;
    let service = camera_pub::run(camera, config, Shutdown::on_signals()?);
    let problem = timeout(TIMEOUT, service).await?.err().context("an error")?;
    let problem = format!("{problem:#}");
    ensure!(problem.contains("SensorTimestamp is not of this machine's clock"), "{problem}");
    ensure!(
        problem.contains("CLOCK_BOOTTIME") && problem.contains("`source.delay_ms`"),
        "{problem}"
    );
    Ok(())
}

/// The pixel formats as `ffmpeg` writes them, from a test picture of its own.
#[tokio::test(flavor = "multi_thread")]
async fn ffmpeg_is_a_camera() -> anyhow::Result<()> {
    if std::process::Command::new("ffmpeg").arg("-version").output().is_err() {
        testing::skip("ffmpeg", "it does not start");
        return Ok(());
    }
    let grey = "color=c=0x808080:s=64x48:r=20,format=gray";
    let forms: [(&str, &[&str]); 4] = [
        ("gray8", &["-pix_fmt", "gray", "-f", "rawvideo"]),
        ("gray16", &["-pix_fmt", "gray16le", "-f", "rawvideo"]),
        ("yuv420", &["-pix_fmt", "yuv420p", "-f", "rawvideo"]),
        ("mjpeg", &["-c:v", "mjpeg", "-f", "mjpeg"]),
    ];
    for (pixels, output) in forms {
        let input = ["ffmpeg", "-nostdin", "-loglevel", "error", "-re", "-f", "lavfi", "-i", grey];
        let command = [&input, output, &["-"]].concat();
        let set = [format!("source.pixels={pixels}"), "source.rate_hz=20".into()];
        let config = program(&command, &set.each_ref().map(String::as_str))?;
        let port = free_port()?;
        let (camera, viewer) = (open("camera-pub", port).await?, open("gcs-bridge", port).await?);
        let frames = viewer.frame_subscriber(topic::FRAME, &["down"]).await?;
        let service =
            tokio::spawn(camera_pub::run(camera.clone(), config, Shutdown::on_signals()?));
        for _ in 0..3 {
            let frame = timeout(TIMEOUT, frames.next()).await?.context("a frame")?;
            let bytes = frame.bytes();
            // The high byte of two, or the only one. The range of video grey is 16 to 235, or full.
            let level = bytes.last().context("pixels")?;
            ensure!(level.abs_diff(0x80) < 6, "{pixels}: {level}");
            ensure!(bytes.len() == 64 * 48 * if pixels == "gray16" { 2 } else { 1 });
        }
        service.abort();
        camera.close().await;
        viewer.close().await;
    }
    Ok(())
}
