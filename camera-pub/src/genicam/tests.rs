//! Tests the feed of a GenICam camera with a camera of GigE Vision that Aravis plays on the loopback interface: whole frames,
//! stamps, lost packets, a slow reader, loss and return.

use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, ensure};
use aravis::GvFakeCamera;
use imaging::BayerPattern;
use node::now_ns;
use testing::with_second_try;

use super::camera::{OpenCamera, Taken};
use super::feed::{Feed, Next};
use crate::config::{FrameSize, GenicamConfig};
use crate::control::Configured;
use crate::exposure::{Shutter, StampedAt};

const ADDRESS: &str = "127.0.0.1";
const SIZE: FrameSize = FrameSize { width: 648, height: 486 };
const RATE_HZ: f64 = 25.0;

/// The port of GigE Vision is one for the whole machine.
fn alone() -> MutexGuard<'static, ()> {
    static ALONE: Mutex<()> = Mutex::new(());
    ALONE.lock().unwrap_or_else(PoisonError::into_inner)
}

fn fake() -> GvFakeCamera {
    let fake = GvFakeCamera::new(Some(ADDRESS), Some("one"));
    assert!(fake.is_running(), "the port of GigE Vision is taken");
    fake
}

/// An exposure at which the played camera's pixels are neither brighter nor darker than its pattern.
fn config() -> GenicamConfig {
    GenicamConfig {
        name: ADDRESS.to_owned(),
        size: SIZE,
        rate_hz: RATE_HZ,
        features: vec!["ExposureTimeAbs=10000".to_owned(), "GainRaw=0".to_owned()],
        bayer: None,
        // It stamps a frame when it makes it, and sends it at once.
        shutter: Shutter { stamped_at: StampedAt::FrameEnd, readout_ns: 0 },
        delay_ns: 0,
    }
}

/// The duration of the longest test: `ALIGHT_GENICAM_SECONDS`, or a few seconds.
fn seconds() -> f64 {
    let wanted = std::env::var("ALIGHT_GENICAM_SECONDS").ok().and_then(|text| text.parse().ok());
    wanted.unwrap_or(5.0)
}

/// The number in a frame's pixels, modulo 255, when all of them are of one frame: a ramp over x and y that begins with it.
fn number_in(taken: &Taken) -> Option<u8> {
    let pixels = &taken.pixels()[..SIZE.pixels()];
    let first = u32::from(pixels[0]);
    let is_whole = pixels.iter().enumerate().all(|(at, pixel)| {
        let (x, y) = (at % SIZE.width, at / SIZE.width);
        u32::from(*pixel) == (first + x as u32 + y as u32) % 255
    });
    is_whole.then_some(first as u8)
}

/// The frames and counts of a period.
#[derive(Debug, Default)]
struct Seen {
    whole: u64,
    /// Frames whose pixels are not of one frame.
    mixed: u64,
    /// Frames that are missing between two that came.
    missing: u64,
    exact: u64,
    /// Errors of the stamps, in nanoseconds.
    errors_ns: Vec<i64>,
    lost: Vec<&'static str>,
    /// The longest time between two frames.
    gap: Duration,
}

fn watch(feed: &mut Feed, time: Duration) -> Seen {
    let mut seen = Seen::default();
    let (began, mut last_frame, mut last) = (Instant::now(), Instant::now(), None::<u8>);
    while began.elapsed() < time {
        match feed.next() {
            Next::Frame(taken) => {
                match number_in(&taken) {
                    Some(number) => {
                        if last.is_none() {
                            // Frames that were dropped before the first one are not missing between two.
                            feed.take_counts();
                        }
                        let expected = last.map(|last| (u64::from(last) + 1) % 255);
                        let apart = expected.map_or(0, |it| (u64::from(number) + 255 - it) % 255);
                        seen.missing += apart;
                        seen.whole += 1;
                        last = Some(number);
                    }
                    None => seen.mixed += 1,
                }
                if taken.exposure.is_exact() {
                    seen.exact += 1;
                    // Its clock is the system's.
                    let utc_ns =
                        SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64;
                    let truth_ns = taken.stamp_ns() - utc_ns + now_ns() - 5_000_000;
                    seen.errors_ns.push(taken.exposure.mid_ns - truth_ns);
                }
                feed.give_back(taken);
                seen.gap = seen.gap.max(last_frame.elapsed());
                last_frame = Instant::now();
            }
            Next::Nothing => {}
            Next::Wait(time) => std::thread::sleep(time),
            Next::Lost(reason) => seen.lost.push(reason),
        }
    }
    seen
}

#[tokio::test]
async fn every_frame_arrives_complete_with_its_stamp() -> anyhow::Result<()> {
    with_second_try(async || every_frame_is_complete()).await
}

fn every_frame_is_complete() -> anyhow::Result<()> {
    let _alone = alone();
    let _fake = fake();
    let mut feed = Feed::start(&config())?;
    let seconds = seconds();
    let mut seen = watch(&mut feed, Duration::from_secs_f64(seconds));
    seen.errors_ns.sort_unstable();
    let median_ns = seen.errors_ns.get(seen.errors_ns.len() / 2).context("no exact stamp")?;
    println!(
        "{} frames in {seconds} s, {} missing, {} mixed, {} with exact stamps, their error {:.2} ms in the median",
        seen.whole,
        seen.missing,
        seen.mixed,
        seen.exact,
        *median_ns as f64 * 1e-6
    );
    // A busy machine takes longer than a period for some.
    let counts = feed.take_counts();
    ensure!(seen.missing == counts.queued, "{seen:?} {counts:?}");
    ensure!((seen.mixed, seen.lost.len()) == (0, 0), "{seen:?}");
    ensure!(
        seen.whole as f64 > 0.9 * seconds * RATE_HZ && seen.exact + 10 > seen.whole,
        "{seen:?}"
    );
    // A busy machine sends the quickest of its frames late as well.
    ensure!(median_ns.abs() < 10_000_000, "{median_ns} ns");
    Ok(())
}

#[test]
fn the_exposure_time_of_a_camera_is_reported() {
    let _alone = alone();
    let _fake = fake();
    let feed = Feed::start(&config()).unwrap();
    assert_eq!(feed.configured(), Some(Configured::Fixed { exposure_ns: 10_000_000 }));
}

#[test]
fn a_slow_reader_gets_the_newest_frame() {
    let _alone = alone();
    let _fake = fake();
    let mut feed = Feed::start(&config()).unwrap();
    let period = Duration::from_secs_f64(1.0 / RATE_HZ);
    let began = Instant::now();
    let mut ages_ns = Vec::new();
    while ages_ns.len() < 40 && began.elapsed() < Duration::from_secs(20) {
        let Next::Frame(taken) = feed.next() else { continue };
        ages_ns.push(now_ns() - taken.exposure.mid_ns);
        feed.give_back(taken);
        std::thread::sleep(period * 3 / 2);
    }
    // A busy machine may be late with each.
    let quickest_ns = ages_ns.iter().skip(30).min().unwrap();
    assert!(*quickest_ns < 2 * period.as_nanos() as i64, "{ages_ns:?}");
    assert!(feed.take_counts().queued >= 10);
}

#[test]
fn frames_of_which_packets_are_lost_are_counted_and_never_delivered() {
    let _alone = alone();
    let fake = fake();
    let mut feed = Feed::start(&config()).unwrap();
    fake.set_gvsp_lost_ratio(0.01);
    let seen = watch(&mut feed, Duration::from_secs(4));
    let counts = feed.take_counts();
    println!("{} whole frames, {} torn and not delivered", seen.whole, counts.torn);
    assert_eq!(seen.mixed, 0);
    // A frame has some 220 packets, so that one of ten is whole: the played camera sends no packet again.
    assert!(seen.whole > 0 && counts.torn > 10 && counts.other == 0, "{seen:?} {counts:?}");
}

#[test]
fn a_camera_that_is_unplugged_is_named_and_used_again_when_it_is_back() {
    let _alone = alone();
    let plugged = fake();
    let mut feed = Feed::start(&config()).unwrap();
    assert!(watch(&mut feed, Duration::from_millis(500)).whole > 5);
    drop(plugged);
    let away = watch(&mut feed, Duration::from_secs(4));
    assert!(!away.lost.is_empty() && away.whole < 10, "{away:?}");
    let _again = fake();
    let began = Instant::now();
    let mut back = Duration::MAX;
    while back == Duration::MAX && began.elapsed() < Duration::from_secs(10) {
        if watch(&mut feed, Duration::from_millis(100)).whole > 0 {
            back = began.elapsed();
        }
    }
    println!("lost as {:?}, back after {:.1} s", away.lost, back.as_secs_f64());
    assert!(back < Duration::from_secs(10));
}

#[test]
fn opening_again_and_again_leaves_nothing_open() {
    let _alone = alone();
    let _fake = fake();
    let files = || std::fs::read_dir("/proc/self/fd").unwrap().count();
    let times = if std::env::var_os("ALIGHT_GENICAM_SECONDS").is_some() { 1000 } else { 20 };
    let open = || drop(OpenCamera::start(&config()).unwrap());
    (0..3).for_each(|_| open());
    let before = files();
    (0..times).for_each(|_| open());
    println!("{times} reopenings: {before} open files before, {} after", files());
    // Other tests of this process may have a few.
    assert!(files() <= before + 10, "{before}, then {}", files());
}

#[test]
fn colours_have_their_pattern_and_unsupported_features_are_reported() {
    let _alone = alone();
    let _fake = fake();
    let mut feed =
        Feed::start(&GenicamConfig { bayer: Some(BayerPattern::Rggb), ..config() }).unwrap();
    let seen = watch(&mut feed, Duration::from_millis(700));
    assert!(seen.whole + seen.mixed > 5);
    drop(feed);
    let problem = |config: GenicamConfig| {
        let refused = OpenCamera::start(&config).err().expect("it is refused");
        format!("{refused:#}")
    };
    let unknown = problem(GenicamConfig { features: vec!["Brightness=3".to_owned()], ..config() });
    assert!(unknown.contains("`Brightness=3`"), "{unknown}");
    let size = FrameSize { width: 9000, height: 486 };
    let large = problem(GenicamConfig { size, ..config() });
    assert!(large.contains("at most [2048, 2048]"), "{large}");
    let missing = problem(GenicamConfig { name: "127.0.0.77".to_owned(), ..config() });
    assert!(missing.contains("does not answer"), "{missing}");
}
