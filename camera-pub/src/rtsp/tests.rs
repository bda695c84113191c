//! Tests the feed of an RTSP camera with the simulated server, and with ffmpeg: pictures, stamps of each kind,
//! damaged and lost streams.

use std::os::unix::fs::PermissionsExt;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use media::decode_image;
use node::now_ns;

use super::feed::{Feed, Image, Next};
use super::server::{
    CREDENTIALS, Camera, DELAY_NS, HEIGHT, PERIOD, Script, Streamed, WIDTH, jpeg_level, level,
};
use crate::config::{FrameSize, RtspConfig, RtspStamps};

const MS: i64 = 1_000_000;

fn config(camera: &Camera) -> RtspConfig {
    RtspConfig {
        url: camera.url(),
        credentials: None,
        size: FrameSize { width: WIDTH, height: HEIGHT },
        rate_hz: 50.0,
        stamps: RtspStamps::Arrival,
        delay_ns: DELAY_NS,
        max_pixels: 1_000_000,
    }
}

/// The output of the feed until so many frames have come.
#[derive(Default)]
struct Seen {
    /// Grey levels, width, and stamp.
    frames: Vec<(Vec<u8>, usize, i64)>,
    dropped: Vec<&'static str>,
    lost: Vec<&'static str>,
}

async fn see(feed: &mut Feed, frames: usize) -> Seen {
    let mut seen = Seen::default();
    let begun = Instant::now();
    while seen.frames.len() < frames {
        assert!(begun.elapsed() < Duration::from_secs(30), "{} frames", seen.frames.len());
        match feed.next().await.unwrap() {
            Next::Frame(image, exposure) => {
                assert!(!exposure.is_exact());
                let image = match image {
                    Image::Grey(image) => image,
                    Image::Jpeg(file) => {
                        decode_image(std::path::Path::new("a picture"), &file, 1_000_000).unwrap()
                    }
                };
                seen.frames.push((image.pixels().to_vec(), image.width(), exposure.mid_ns));
            }
            Next::Dropped(reason) => seen.dropped.push(reason),
            Next::Lost(reason) => seen.lost.push(reason),
            Next::Nothing => {}
        }
    }
    seen
}

/// The number of a picture of H.264, all of whose macroblocks must be those of that picture.
fn number(pixels: &[u8], near: u64) -> u64 {
    let is = |number: &u64| {
        (0..HEIGHT / 16 * WIDTH / 16).all(|block| {
            let (x, y) = (block % (WIDTH / 16) * 16, block / (WIDTH / 16) * 16);
            let expected = level(*number, block as u64);
            (y..y + 16).all(|y| pixels[y * WIDTH + x..][..16].iter().all(|p| *p == expected))
        })
    };
    (near..near + 400).find(is).expect("no picture that was sent looks like this")
}

/// The error of each frame's stamp, in nanoseconds, from the `skipped`th frame on; pictures are identified by their pixels.
fn errors(camera: &Camera, seen: &Seen, skipped: usize) -> Vec<i64> {
    let mut before = 0;
    let mut errors = Vec::new();
    for (pixels, _, stamp_ns) in &seen.frames {
        let number = number(pixels, before);
        before = number + 1;
        errors.push(stamp_ns - camera.taken_ns(number));
    }
    errors.drain(..skipped);
    errors
}

#[tokio::test(flavor = "multi_thread")]
async fn pictures_are_those_that_were_sent_and_stamped_when_they_were_taken() {
    let camera = Camera::play(Script::of(Streamed::H264)).await;
    let mut feed = Feed::start(&config(&camera)).await.unwrap();
    let seen = see(&mut feed, 100).await;
    let mut errors = errors(&camera, &seen, 20);
    errors.sort_unstable();
    // The quickest gives all stamps; a loaded machine may be late with each.
    assert!(errors[errors.len() / 2].abs() <= MS, "{errors:?}");
    assert!(seen.lost.is_empty(), "{:?}", seen.lost);
    assert!(feed.decoding() > Duration::ZERO);
}

#[tokio::test(flavor = "multi_thread")]
async fn stamps_of_the_cameras_clock_are_exact_to_a_tenth_of_a_millisecond() {
    let script = Script { clock_ahead_ns: Some(0), ..Script::of(Streamed::H264) };
    let camera = Camera::play(script).await;
    let stamps = RtspConfig { stamps: RtspStamps::Camera, delay_ns: 0, ..config(&camera) };
    let mut feed = Feed::start(&stamps).await.unwrap();
    let seen = see(&mut feed, 60).await;
    assert!(seen.dropped.contains(&"pictures before the camera sent its clock"));
    let errors = errors(&camera, &seen, 0);
    // 90 kHz is 11 microseconds; between two calls of the clocks a loaded machine may do something else.
    let exact = errors.iter().filter(|error| error.abs() <= 50_000).count();
    assert!(exact * 10 >= errors.len() * 9, "{errors:?}");
    assert!(errors.iter().all(|error| error.abs() <= 5 * MS), "{errors:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_camera_whose_clock_is_wrong_or_not_sent_is_refused_with_the_reason() {
    for (clock_ahead_ns, part) in
        [(Some(-3600 * 1000 * MS), "3600.0 s old"), (None, "sender reports")]
    {
        let camera = Camera::play(Script { clock_ahead_ns, ..Script::of(Streamed::H264) }).await;
        // Of a camera at 1 Hz it is expected after 20 pictures.
        let wanted = RtspConfig { stamps: RtspStamps::Camera, rate_hz: 1.0, ..config(&camera) };
        let mut feed = Feed::start(&wanted).await.unwrap();
        let problem = loop {
            match feed.next().await {
                Ok(Next::Frame(..)) => panic!("a frame with a wrong stamp"),
                Ok(_) => {}
                Err(problem) => break problem.to_string(),
            }
        };
        assert!(problem.contains(part) && problem.contains("rtsp_stamps"), "{problem}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn motion_jpeg_is_read() {
    let camera = Camera::play(Script::of(Streamed::Jpeg)).await;
    let mut feed = Feed::start(&config(&camera)).await.unwrap();
    let first = see(&mut feed, 1).await;
    // Those that are left out before the first picture are missing between no two.
    feed.take_missed();
    let seen = see(&mut feed, 39).await;
    let (mut before, mut missed) = (None, 0);
    for (pixels, width, stamp_ns) in first.frames.iter().chain(&seen.frames) {
        assert_eq!((*width, pixels.len()), (WIDTH, WIDTH * HEIGHT));
        let shown = pixels[3 * WIDTH + 5];
        let number = (0..100).min_by_key(|n| jpeg_level(*n).abs_diff(shown)).unwrap();
        assert!(jpeg_level(number).abs_diff(shown) < 2, "{shown}");
        assert!(before.is_none_or(|before| number > before), "{number} after {before:?}");
        missed += before.map_or(0, |before| number - before - 1);
        let error_ns = stamp_ns - camera.taken_ns(number);
        assert!(number < 20 || error_ns.abs() <= 10 * MS, "{number}: {error_ns} ns");
        before = Some(number);
    }
    assert_eq!(
        missed,
        feed.take_missed(),
        "missing are those that a busy machine was too slow for"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn a_slow_reader_of_motion_jpeg_gets_the_newest_picture() {
    let camera = Camera::play(Script::of(Streamed::Jpeg)).await;
    let mut feed = Feed::start(&config(&camera)).await.unwrap();
    let mut ages_ns = Vec::new();
    for _ in 0..40 {
        tokio::time::sleep(PERIOD * 3 / 2).await;
        let seen = see(&mut feed, 1).await;
        ages_ns.extend(seen.frames.iter().map(|(.., stamp_ns)| now_ns() - stamp_ns));
    }
    // A busy machine may be late with each.
    let quickest_ns = ages_ns.iter().skip(30).min().unwrap();
    assert!(*quickest_ns < 80 * MS, "{ages_ns:?}");
    assert!(feed.take_missed() >= 10);
}

#[tokio::test(flavor = "multi_thread")]
async fn lost_packets_cost_pictures_until_the_next_key_frame_and_tear_none() {
    let script = Script { lose_every: 37, ..Script::of(Streamed::H264) };
    let camera = Camera::play(script).await;
    let mut feed = Feed::start(&config(&camera)).await.unwrap();
    let seen = see(&mut feed, 100).await;
    // `errors` panics for a picture that was not sent.
    assert_eq!(errors(&camera, &seen, 0).len(), 100);
    assert!(seen.dropped.len() > 10, "{:?}", seen.dropped);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_camera_that_is_gone_or_silent_is_read_again_within_two_seconds() {
    for (silent_after, closes_after, reason) in
        [(60, u64::MAX, "camera stalled"), (u64::MAX, 60, "camera's stream ended")]
    {
        let script = Script { silent_after, closes_after, ..Script::of(Streamed::H264) };
        let camera = Camera::play(script).await;
        let mut feed = Feed::start(&config(&camera)).await.unwrap();
        see(&mut feed, 20).await;
        let lost = loop {
            if let Next::Lost(reason) = feed.next().await.unwrap() {
                break reason;
            }
        };
        assert_eq!(lost, reason);
        camera.switch(true);
        for _ in 0..2 {
            assert!(matches!(feed.next().await.unwrap(), Next::Nothing));
        }
        camera.switch(false);
        let replugged = Instant::now();
        let seen = see(&mut feed, 1).await;
        assert!(replugged.elapsed() < Duration::from_secs(2), "{:?}", replugged.elapsed());
        assert!(number(&seen.frames[0].0, 60) > 60);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn pictures_of_another_size_are_delivered_with_their_size() {
    let script = Script { wide: 20..40, ..Script::of(Streamed::H264) };
    let camera = Camera::play(script).await;
    let mut feed = Feed::start(&config(&camera)).await.unwrap();
    let seen = see(&mut feed, 60).await;
    let wide = seen.frames.iter().filter(|(_, width, _)| *width == 2 * WIDTH).count();
    assert_eq!(wide, 20);
    assert_eq!(seen.frames.last().unwrap().1, WIDTH);
}

#[tokio::test(flavor = "multi_thread")]
async fn credentials_are_sent_and_never_shown() {
    let script = Script { wants_credentials: true, ..Script::of(Streamed::H264) };
    let camera = Camera::play(script).await;
    let refused = |config: RtspConfig| async move {
        format!("{:#}", Feed::start(&config).await.err().expect("a refusal"))
    };
    let problem = refused(config(&camera)).await;
    assert!(problem.contains("401") || problem.contains("nauthorized"), "{problem}");

    let file = tempfile::NamedTempFile::new().unwrap();
    let with = || RtspConfig { credentials: Some(file.path().to_owned()), ..config(&camera) };
    let write = |text: &str, mode: u32| {
        std::fs::write(file.path(), text).unwrap();
        std::fs::set_permissions(file.path(), std::fs::Permissions::from_mode(mode)).unwrap();
    };
    for (text, mode, part) in [
        (CREDENTIALS[0], 0o644, "chmod 600"),
        ("only-a-s3cret", 0o600, "user:password"),
        ("alight:another-s3cret", 0o600, "401"),
    ] {
        write(text, mode);
        let problem = refused(with()).await;
        assert!(problem.contains(part), "{problem}");
        assert!(!problem.contains("s3cret"), "{problem}");
        assert!(!format!("{:?}", with()).contains("s3cret"));
    }
    write(&format!("{}\n", CREDENTIALS[0]), 0o600);
    let mut feed = Feed::start(&with()).await.unwrap();
    assert_eq!(see(&mut feed, 3).await.frames.len(), 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_that_cannot_be_read_is_refused_with_the_reason() {
    let camera = Camera::play(Script::of(Streamed::H265)).await;
    let problem = format!("{:#}", Feed::start(&config(&camera)).await.err().unwrap());
    assert!(problem.contains("its video is H265") && problem.contains("H.264"), "{problem}");
    let closed = RtspConfig { url: "rtsp://127.0.0.1:9/main".to_owned(), ..config(&camera) };
    let problem = format!("{:#}", Feed::start(&closed).await.err().unwrap());
    assert!(problem.contains("cannot be opened"), "{problem}");
    assert_eq!(camera.requests(), ["DESCRIBE"]);
}

/// The luma of ffmpeg's test picture, frame by frame, as its encoder gets it.
const SOURCE: [&str; 4] = ["-f", "lavfi", "-i", "testsrc=size=320x240:rate=25"];
const SIZE: (usize, usize) = (320, 240);

fn ffmpeg(arguments: &[&str]) -> Command {
    let mut command = Command::new("ffmpeg");
    command.args(["-nostdin", "-loglevel", "error"]).args(arguments).stdin(Stdio::null());
    command
}

#[tokio::test(flavor = "multi_thread")]
async fn pictures_of_an_ffmpeg_stream_equal_those_that_ffmpeg_decodes() {
    if !testing::has_x264() {
        return;
    }
    let raw = ["-frames:v", "100", "-pix_fmt", "yuv420p", "-f", "rawvideo", "-"];
    let shown = ffmpeg(&[&SOURCE[..], &raw].concat()).output().unwrap().stdout;
    let (width, height) = SIZE;
    let shown: Vec<&[u8]> = shown.chunks_exact(width * height * 3 / 2).collect();
    assert_eq!(shown.len(), 100);
    for profile in ["baseline", "high"] {
        let camera = Camera::play(Script::of(Streamed::Pushed)).await;
        let url = camera.url();
        let coding =
            ["-c:v", "libx264", "-profile:v", profile, "-bf", "0", "-g", "10", "-crf", "15"];
        let pushing = ["-pix_fmt", "yuv420p", "-f", "rtsp", "-rtsp_transport", "tcp", &url];
        let mut pushes =
            ffmpeg(&[&["-re"], &SOURCE[..], &coding, &pushing].concat()).spawn().unwrap();
        let is_pushing = async || camera.has_been_pushed_to();
        testing::until("ffmpeg pushes", Duration::from_secs(20), is_pushing).await.unwrap();
        let wanted = RtspConfig {
            size: FrameSize { width, height },
            rate_hz: 25.0,
            stamps: RtspStamps::Arrival,
            delay_ns: 0,
            ..config(&camera)
        };
        let mut feed = Feed::start(&wanted).await.unwrap();
        let seen = see(&mut feed, 30).await;
        pushes.kill().unwrap();
        pushes.wait().unwrap();
        let mut before = None;
        for (pixels, _, stamp_ns) in &seen.frames {
            let mean = |luma: &[u8]| {
                let apart = pixels.iter().zip(luma).map(|(a, b)| u64::from(a.abs_diff(*b)));
                apart.sum::<u64>() as f64 / pixels.len() as f64
            };
            let errors: Vec<f64> = shown.iter().map(|frame| mean(frame)).collect();
            let best = (0..100).min_by(|a, b| errors[*a].total_cmp(&errors[*b])).unwrap();
            assert!(errors[best] < 1.5, "{profile}: {} off frame {best}", errors[best]);
            if let Some((number, ns)) = before {
                assert!(best == number + 1, "{profile}: {best} after {number}");
                let apart_ms = (stamp_ns - ns) as f64 / 1e6;
                assert!(apart_ms > 0.0, "{profile}: {apart_ms} ms");
            }
            before = Some((best, *stamp_ns));
        }
        assert!(seen.frames.iter().all(|(.., stamp_ns)| *stamp_ns < now_ns()));
    }
}
