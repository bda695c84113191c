//! `alight doctor` on cameras: calibration, and of received frames their size, age, stamps, exposure and blur, sharpness, drops
//! and silence.

use std::fmt::Write;

use messages::{CameraInfo, Health, PixelFormat};
use node::frame_order::FrameOrder;
use node::{clock_name, stats};

use super::focus::ReceivedFrame;
use super::{Findings, Seen, Watched};
use crate::staleness::Limits;

/// Maximum age of a frame on arrival, in milliseconds; a larger one means a wrong clock or an unusable link.
const MAX_AGE_MS: f64 = 1000.0;
/// Age from which on a stamp is of another clock, in milliseconds: a day.
const OTHER_CLOCK_MS: f64 = 86_400_000.0;
/// A brisk turn of the vehicle, in radians per second, at which the blur is stated.
const TURN_RAD_S: f64 = 0.5;
/// Blur at that turn from which on markers are found less far, in pixels.
const MAX_BLUR_PX: f64 = 3.0;
/// Width of edges from which on a picture is blurred, in pixels: one in focus has 2 to 3, and a blur of two pixels' deviation 4
/// to 5, on photographs of markers, streets, rooms and fields.
const MAX_EDGE_WIDTH_PX: f64 = 4.0;
/// Part of the frames that a camera may drop.
const MAX_DROPPED: f64 = 0.02;

/// Silence after which a camera whose frames are needed is dead, in seconds.
const MAX_SILENCE_S: f64 = 2.0;

/// Checks the cameras that were seen: calibration, frames, stamps, exposure, and drops. A site may have `has_camera`
/// run on this machine.
pub(super) fn check(findings: &mut Findings, seen: &Seen, watched: Watched, has_camera: bool) {
    let seconds = watched.duration.as_secs();
    for info in &seen.cameras {
        let camera = &info.camera;
        if let Some(problem) = info.problem() {
            findings.wrong(
                "calibration",
                format!("camera `{camera}`: its information is refused by detectors: {problem}"),
                "correct `[calibration]` and `[mount]` of camera-pub, or the CameraInfo of a camera of your own (docs/wire-format.md)",
            );
            continue;
        }
        let Some([fx, fy]) = info.focal_px else {
            let text = format!("camera `{camera}` is not calibrated, so distances are unknown");
            let advice =
                "calibrate it (`alight calibrate board`), and set `calibration.file` of camera-pub";
            // A camera whose frames are searched for markers is meant for the landing.
            if seen.is_searched(camera) {
                findings.wrong("calibration", format!("{text} and no landing starts"), advice);
            } else {
                findings.doubtful("calibration", text, advice);
            }
            continue;
        };
        let problem = implausible(info, [fx, fy]);
        match problem {
            Some(problem) => findings.wrong(
                "calibration",
                format!("camera `{camera}`: {problem}"),
                "use the calibration of this camera at this resolution",
            ),
            None => findings.good(
                "calibration",
                format!(
                    "camera `{camera}`: {} x {} pixels, f = {fx:.0} px",
                    info.width, info.height
                ),
            ),
        }
    }
    let clocks: Vec<_> = seen.healths.iter().filter(|h| h.service == "controller").collect();
    let raw_only = |frame: &&ReceivedFrame| {
        !seen.frames.iter().any(|jpeg| jpeg.header.camera == frame.header.camera)
    };
    let all: Vec<&ReceivedFrame> =
        seen.frames.iter().chain(seen.raw_frames.iter().filter(raw_only)).collect();
    let mut names: Vec<&str> = all.iter().map(|frame| frame.header.camera.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    for camera in names {
        let frames: Vec<&ReceivedFrame> =
            all.iter().copied().filter(|frame| frame.header.camera == camera).collect();
        let raw = seen.raw_frames.iter().filter(|frame| frame.header.camera == camera);
        let raw: Vec<&ReceivedFrame> = raw.collect();
        // A detector here takes raw frames where there are some.
        let searched = if raw.is_empty() { &frames } else { &raw };
        let mut text = describe_frames(camera, &frames, seconds);
        let raw_ms = stats::quantile(&ages_ms(&raw), 0.5).filter(|_| is_jpeg(&frames));
        if let Some(age_ms) = raw_ms.filter(|age_ms| age_ms.abs() <= OTHER_CLOCK_MS) {
            // Writing to a string cannot fail.
            let _ = write!(text, "; its raw frames are {age_ms:.0} ms old");
        }
        check_age(findings, text, searched, seen.limits);
        check_publishers(findings, camera, &seen.raw_frames);
        check_stamps(findings, camera, &frames);
        check_exposure(findings, camera, &frames, focal_px(seen, camera));
        check_focus(findings, camera, &frames);
        check_size(findings, camera, &frames, &seen.cameras);
        check_drops(findings, camera, &seen.healths);
        if let Some(ReceivedFrame { header, .. }) = frames.first()
            && let Some(controller) = clocks.iter().find(|health| health.clock != header.clock)
        {
            findings.wrong(
                "clock",
                format!(
                    "camera `{camera}` stamps with the clock {}, the controller has {}, so it rejects all frames",
                    header.clock, controller.clock
                ),
                "run camera and controller on one machine; a camera of your own must use that clock's name",
            );
        }
        if clocks.is_empty() {
            check_clock(findings, camera, &raw);
        }
        let is_calibrated = seen.cameras.iter().any(|info| info.camera == camera);
        if !is_calibrated && !seen.unusable.has_info(camera) {
            findings.wrong(
                "calibration",
                format!("camera `{camera}` sends frames, but not its calibration and mount"),
                "publish them on `camera/CAMERA/info` every second",
            );
        }
    }
    seen.unusable.report(findings);
    if all.is_empty() && seen.unusable.has_frames() {
        return;
    }
    let is_needed = has_camera || seen.lands();
    let are_silent = is_needed && report_silent(findings, seen, watched);
    if all.is_empty() && !seen.peers.is_empty() && !are_silent {
        findings.doubtful(
            "camera",
            format!("no frame arrived within {seconds} s"),
            "check that a camera-pub runs, and the bandwidth of the link",
        );
    }
}

/// Reports cameras whose frames have ended, or that no camera sends any, if frames are needed. Returns whether it reported any.
fn report_silent(findings: &mut Findings, seen: &Seen, watched: Watched) -> bool {
    let watched_s = watched.duration.as_secs_f64();
    let frames = || seen.frames.iter().chain(&seen.raw_frames);
    let mut names: Vec<&str> = frames().map(|frame| frame.header.camera.as_str()).collect();
    // Over an air link only JPEG frames come, which only our cameras make.
    let is_ours = |name: &str| {
        seen.healths.iter().any(|it| it.service == "camera-pub" && it.instance == name)
    };
    let infos = seen.cameras.iter().map(|info| info.camera.as_str());
    names.extend(infos.filter(|name| watched.has_raw_frames || is_ours(name)));
    names.sort_unstable();
    names.dedup();
    let mut silent: Vec<(String, f64)> = Vec::new();
    if names.is_empty() && seen.cameras.is_empty() {
        silent.push(("any camera".to_owned(), watched_s));
    }
    for name in names {
        let of_camera = frames().filter(|frame| frame.header.camera == name);
        let newest_ns = of_camera.map(|frame| frame.received_ns).max();
        let since_s = |at_ns: i64| seen.ended_ns.saturating_sub(at_ns) as f64 * 1e-9;
        silent.push((format!("camera `{name}`"), newest_ns.map_or(watched_s, since_s)));
    }
    silent.retain(|(_, silence_s)| *silence_s > MAX_SILENCE_S);
    for (name, silence_s) in &silent {
        findings.wrong(
            "camera",
            format!("no frame from {name} for {silence_s:.0} s, where a landing needs them"),
            "on the drone: check the camera and its cable, see the output of its camera-pub (or of your own camera), and start it again",
        );
    }
    !silent.is_empty()
}

fn implausible(info: &CameraInfo, focal_px: [f64; 2]) -> Option<String> {
    let (width, height) = (f64::from(info.width), f64::from(info.height));
    let [fx, fy] = focal_px;
    if !(0.2 * width..=20.0 * width).contains(&fx) || !(0.7..=1.4).contains(&(fy / fx)) {
        return Some(format!(
            "f = {fx:.0}, {fy:.0} px for {width} x {height} pixels is not plausible"
        ));
    }
    let [cx, cy] = info.principal_px;
    let off = ((cx - width / 2.0) / width).abs().max(((cy - height / 2.0) / height).abs());
    (off > 0.2).then(|| {
        format!("the principal point ({cx:.0}, {cy:.0}) is far from the centre of {width} x {height} pixels")
    })
}

fn is_jpeg(frames: &[&ReceivedFrame]) -> bool {
    frames.iter().all(|frame| frame.header.format == PixelFormat::Jpeg)
}

fn describe_frames(camera: &str, frames: &[&ReceivedFrame], seconds: u64) -> String {
    let rate_hz = frames.len() as f64 / seconds as f64;
    let bytes: usize = frames.iter().map(|frame| frame.bytes).sum();
    let megabits_s = bytes as f64 * 8e-6 / seconds as f64;
    let kind = if is_jpeg(frames) { "JPEG frames" } else { "raw frames" };
    let mut text = format!("camera `{camera}`: {rate_hz:.1} {kind}/s, {megabits_s:.2} Mbit/s");
    if is_jpeg(frames) {
        text.push_str(" (it takes more: they are few where no detector acknowledges them)");
    }
    match stats::quantile(&ages_ms(frames), 0.5) {
        Some(median_ms) if median_ms.abs() > OTHER_CLOCK_MS => {
            text.push_str(", of unknown age, as their stamps are impossible");
        }
        Some(median_ms) => {
            // Writing to a string cannot fail.
            let _ = write!(text, ", {median_ms:.0} ms old on arrival");
        }
        None => text
            .push_str(", of unknown age, as their clock is another one than that of this machine"),
    }
    text
}

/// Adds the description of a camera's frames: doubtful where they are older on arrival than the controller allows a detector's frames.
fn check_age(
    findings: &mut Findings,
    text: String,
    frames: &[&ReceivedFrame],
    limits: Option<Limits>,
) {
    let limit_s = limits.or_else(Limits::by_default).map(|limits| limits.max_age_s);
    let age_ms = stats::quantile(&ages_ms(frames), 0.5);
    let age_s = age_ms.filter(|ms| ms.abs() <= OTHER_CLOCK_MS).map(|ms| ms * 1e-3);
    match age_s.zip(limit_s) {
        Some((age_s, limit_s)) if age_s > limit_s => findings.doubtful(
            "camera",
            format!(
                "{text}; the controller takes a detector for late whose detections come more than {:.0} ms after the exposure \
                 (`detectors.max_age_s`)",
                limit_s * 1e3
            ),
            "measure `source.delay_ms` (docs/camera.md), take a faster camera or link, or increase `detectors.max_age_s` of the controller",
        ),
        _ => findings.good("camera", text),
    }
}

/// Reports a camera that two programs publish, by the order of its raw frames. Frames of the air link arrive over two connections, in
/// any order.
fn check_publishers(findings: &mut Findings, camera: &str, raw: &[ReceivedFrame]) {
    let mut order = FrameOrder::default();
    let headers = raw.iter().map(|frame| &frame.header).filter(|header| header.camera == camera);
    let as_of_two = headers.filter(|header| order.on_frame(header).as_of_two).count();
    if as_of_two > 0 {
        findings.wrong(
            "camera",
            format!(
                "two publishers of camera `{camera}`: sequence numbers step back, or the clock changes, again and again"
            ),
            "end one of them, or give it another name; for a camera-pub, set `id`",
        );
    }
}

/// Reports raw frames, which come from this machine, whose clock has another name than that of this machine.
fn check_clock(findings: &mut Findings, camera: &str, raw: &[&ReceivedFrame]) {
    let other = raw.iter().map(|frame| &frame.header.clock).find(|clock| *clock != clock_name());
    if let Some(clock) = other {
        findings.doubtful(
            "clock",
            format!(
                "camera `{camera}` stamps with the clock `{clock}`, that of this machine is `{}`: a controller here rejects all its frames",
                clock_name()
            ),
            "where the camera runs on this machine, give that name as `clock` in the FrameHeader (docs/wire-format.md)",
        );
    }
}

/// The longer focal length of a camera, if it is calibrated.
fn focal_px(seen: &Seen, camera: &str) -> Option<f64> {
    let info = seen.cameras.iter().find(|info| info.camera == camera)?;
    let focal_px = info.focal_px.map(|[fx, fy]| fx.max(fy));
    focal_px.filter(|focal_px| info.problem().is_none() && focal_px.is_finite())
}

fn check_stamps(findings: &mut Findings, camera: &str, frames: &[&ReceivedFrame]) {
    let ages_ms = ages_ms(frames);
    let wrong = ages_ms.iter().find(|age_ms| !(0.0..=MAX_AGE_MS).contains(*age_ms));
    if let Some(age_ms) = wrong.filter(|age_ms| age_ms.abs() > OTHER_CLOCK_MS) {
        let days = age_ms.abs() / OTHER_CLOCK_MS;
        let side = if *age_ms < 0.0 { "in the future" } else { "in the past" };
        findings.wrong(
            "stamps",
            format!("camera `{camera}` stamps its frames {days:.0} days {side}, as with another clock, for example the time of day (CLOCK_REALTIME)"),
            "stamp with CLOCK_MONOTONIC in nanoseconds (`time.monotonic_ns()` in Python; docs/wire-format.md), at the middle of the exposure",
        );
    } else if let Some(age_ms) = wrong {
        findings.wrong(
            "stamps",
            format!(
                "camera `{camera}` stamps a frame {age_ms:.0} ms before it arrives; 0 to {MAX_AGE_MS} ms are possible"
            ),
            "set `source.delay_ms` and `source.stamp_at` of camera-pub; stamps are mid-exposure (docs/camera.md)",
        );
    }
    let exact = frames.iter().filter(|frame| frame.header.exposure_ns > 0).count();
    let text = format!("camera `{camera}`: {exact} of {} are stamped by the camera", frames.len());
    if exact * 10 >= frames.len() * 9 {
        findings.good("stamps", text);
    } else {
        findings.doubtful(
            "stamps",
            format!("{text}, the others are estimates"),
            "fix the exposure, or take the camera's metadata (docs/camera.md, Time stamps)",
        );
    }
}

fn check_exposure(
    findings: &mut Findings,
    camera: &str,
    frames: &[&ReceivedFrame],
    focal_px: Option<f64>,
) {
    let exposures_s: Vec<f64> = frames
        .iter()
        .filter(|frame| frame.header.exposure_ns > 0)
        .map(|frame| f64::from(frame.header.exposure_ns) * 1e-9)
        .collect();
    let Some(exposure_s) = stats::quantile(&exposures_s, 0.5) else { return };
    let text = format!("camera `{camera}` exposes for {:.2} ms", exposure_s * 1e3);
    let Some(focal_px) = focal_px else { return findings.good("exposure", text) };
    let blur_px = exposure_s * TURN_RAD_S * focal_px;
    let text = format!(
        "{text}, which blurs by {blur_px:.1} pixels at a turn of {:.0} degrees per second",
        TURN_RAD_S.to_degrees()
    );
    if blur_px <= MAX_BLUR_PX {
        findings.good("exposure", text);
    } else {
        findings.doubtful(
            "exposure",
            text,
            "expose for a shorter time and with more gain, or for the marker (docs/camera.md, Exposure)",
        );
    }
}

/// Judges the sharpest picture, as others may be blurred by motion.
fn check_focus(findings: &mut Findings, camera: &str, frames: &[&ReceivedFrame]) {
    let Some(width_px) = frames.iter().filter_map(|frame| frame.edge_width_px).reduce(f64::min)
    else {
        return findings.good(
            "focus",
            format!(
                "camera `{camera}`: not judged, as no picture in full resolution had enough edges"
            ),
        );
    };
    let text = format!("camera `{camera}`: edges are {width_px:.1} pixels wide");
    if width_px <= MAX_EDGE_WIDTH_PX {
        findings.good("focus", text);
    } else {
        findings.doubtful(
            "focus",
            format!("{text}; 2 to 3 are sharp"),
            "focus the lens at the height of flight and lock it, clean it, or hold it still; markers are found less far",
        );
    }
}

fn check_size(
    findings: &mut Findings,
    camera: &str,
    frames: &[&ReceivedFrame],
    cameras: &[CameraInfo],
) {
    let info = cameras.iter().find(|info| info.camera == camera);
    let Some((info, frame)) = info.zip(frames.first()) else { return };
    let (width, height) = (frame.header.width, frame.header.height);
    if (width, height) != (info.width, info.height) {
        findings.wrong(
            "calibration",
            format!(
                "camera `{camera}` is calibrated at {} x {} pixels, but its frames have {width} x {height}",
                info.width, info.height
            ),
            "calibrate it at the size that is flown, or fly the size that is calibrated",
        );
    }
}

fn check_drops(findings: &mut Findings, camera: &str, healths: &[Health]) {
    let is_its = |health: &&Health| health.service == "camera-pub" && health.instance == camera;
    let Some(health) = healths.iter().find(is_its) else { return };
    let dropped: u64 = health.drops.iter().map(|drop| drop.count).sum();
    let frames = health.rates.iter().find(|rate| rate.name == "frames");
    let frames = frames.map_or(0, |rate| rate.count);
    if dropped == 0 {
        return findings
            .good("camera", format!("camera `{camera}` dropped none of {frames} frames"));
    }
    let reasons: Vec<_> =
        health.drops.iter().map(|drop| format!("{} ({})", drop.reason, drop.count)).collect();
    let text = format!(
        "camera `{camera}` dropped {dropped} in addition to {frames} frames: {}",
        reasons.join(", ")
    );
    if dropped as f64 <= MAX_DROPPED * frames as f64 {
        findings.good("camera", text);
    } else {
        findings.doubtful("camera", text, "docs/camera.md explains the cause of each of them");
    }
}

/// How old frames were on arrival; of those on this machine's clock.
fn ages_ms(frames: &[&ReceivedFrame]) -> Vec<f64> {
    let ours = frames.iter().filter(|frame| frame.header.clock == clock_name());
    ours.map(|frame| frame.received_ns.saturating_sub(frame.header.stamp_ns) as f64 * 1e-6)
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    use super::super::unusable::{FRAMES, Unusable};
    use messages::{ControllerStatus, Count, FrameHeader, Phase, Rate};

    fn frame(age_ms: i64, exposure_ns: u32) -> ReceivedFrame {
        let header = FrameHeader {
            camera: "down".into(),
            sequence: 0,
            stamp_ns: 1_000_000_000_000,
            clock: clock_name().to_owned(),
            exposure_ns,
            width: 640,
            height: 480,
            format: PixelFormat::Mono8,
            parts: Vec::new(),
        };
        let received_ns = header.stamp_ns + age_ms * 1_000_000;
        ReceivedFrame { header, bytes: 640 * 480, received_ns, edge_width_px: None }
    }

    /// The findings on a camera with these frames.
    fn text(frames: Vec<ReceivedFrame>, width: u32, healths: Vec<Health>) -> String {
        let model = geometry::CameraModel::pinhole(width, 480, 1800.0);
        let mount = geometry::Transform::identity();
        let mut findings = Findings::default();
        let cameras = vec![CameraInfo::new("down", &model, &mount)];
        let watched =
            Watched { role: None, duration: Duration::from_secs(1), has_raw_frames: true };
        let seen = Seen { cameras, healths, raw_frames: frames, ..Seen::default() };
        check(&mut findings, &seen, watched, false);
        findings.text()
    }

    fn health(drops: Vec<Count>) -> Health {
        Health {
            service: "camera-pub".into(),
            instance: "down".into(),
            rates: vec![Rate { name: "frames".into(), count: 1000, hz: 30.0 }],
            drops,
            ..Health::sample()
        }
    }

    #[test]
    fn a_camera_that_stamps_exactly_and_exposes_briefly_is_well() {
        let text =
            text(vec![frame(30, 2_000_000), frame(31, 2_000_000)], 640, vec![health(Vec::new())]);
        assert!(text.ends_with("Nothing is wrong."), "{text}");
        assert!(text.contains("2 of 2 are stamped by the camera"), "{text}");
        assert!(text.contains("2.00 ms, which blurs by 1.8 pixels"), "{text}");
        assert!(text.contains("dropped none of 1000 frames"), "{text}");
    }

    #[test]
    fn estimated_and_impossible_stamps_long_exposures_and_drops_are_reported() {
        assert!(text(vec![frame(30, 0)], 640, Vec::new()).contains("the others are estimates"));
        let early = text(vec![frame(30, 1), frame(-5, 1)], 640, Vec::new());
        assert!(early.contains("stamps a frame -5 ms before it arrives"), "{early}");
        assert!(early.contains("1 wrong"), "{early}");
        let long = text(vec![frame(30, 10_000_000)], 640, Vec::new());
        assert!(long.contains("10.00 ms, which blurs by 9.0 pixels"), "{long}");
        assert!(long.contains("for the marker"), "{long}");
        let drops = vec![Count { reason: "frames that were queued".into(), count: 50 }];
        let dropping = text(vec![frame(30, 1)], 640, vec![health(drops)]);
        assert!(
            dropping
                .contains("dropped 50 in addition to 1000 frames: frames that were queued (50)")
        );
    }

    #[test]
    fn stamps_of_the_time_of_day_are_reported_with_the_right_clock() {
        let day_ms = 86_400_000;
        let future = text(vec![frame(-20_788 * day_ms, 1)], 640, Vec::new());
        assert!(future.contains("stamps its frames 20788 days in the future"), "{future}");
        assert!(future.contains("`time.monotonic_ns()` in Python"), "{future}");
        assert!(!future.contains("source.delay_ms") && !future.contains("ms old"), "{future}");
        assert!(future.contains("1 wrong"), "{future}");
        let past = text(vec![frame(2 * day_ms, 1)], 640, Vec::new());
        assert!(past.contains("2 days in the past"), "{past}");
    }

    #[test]
    fn another_clock_than_that_of_this_machine_is_doubtful_without_a_controller() {
        let of = |clock: &str, healths| {
            let mut other = frame(30, 1);
            other.header.clock = clock.to_owned();
            text(vec![other], 640, healths)
        };
        for clock in ["", "unix"] {
            let found = of(clock, Vec::new());
            let named = format!("stamps with the clock `{clock}`, that of this machine is `");
            assert!(found.contains(&named) && found.contains("0 wrong, 1 doubtful"), "{found}");
        }
        assert!(!of(clock_name(), Vec::new()).contains("clock `"));
        let controller =
            Health { service: "controller".into(), clock: clock_name().into(), ..Health::sample() };
        let wrong = of("unix", vec![controller]);
        assert!(
            wrong.contains("so it rejects all frames") && wrong.contains("0 doubtful"),
            "{wrong}"
        );
    }

    #[test]
    fn a_refused_focal_length_gives_no_blur() {
        let model = geometry::CameraModel::pinhole(640, 480, 1800.0);
        let mut info = CameraInfo::new("down", &model, &geometry::Transform::identity());
        info.focal_px = Some([f64::NAN; 2]);
        let watched =
            Watched { role: None, duration: Duration::from_secs(1), has_raw_frames: true };
        let (cameras, raw_frames) = (vec![info], vec![frame(30, 2_000_000)]);
        let mut findings = Findings::default();
        check(&mut findings, &Seen { cameras, raw_frames, ..Seen::default() }, watched, false);
        let text = findings.text();
        assert!(text.contains("refused by detectors: focal lengths of NaN"), "{text}");
        assert!(text.contains("exposes for 2.00 ms\n") && !text.contains("blurs"), "{text}");
    }

    #[test]
    fn a_blurred_picture_is_reported_and_one_without_edges_is_not_judged() {
        let of = |widths: [Option<f64>; 3]| {
            let frames =
                widths.map(|edge_width_px| ReceivedFrame { edge_width_px, ..frame(30, 1) });
            text(frames.into(), 640, Vec::new())
        };
        // The sharpest counts: the others were blurred by motion.
        let sharp = of([Some(7.0), None, Some(2.4)]);
        assert!(sharp.contains("edges are 2.4 pixels wide\n"), "{sharp}");
        let soft = of([Some(7.0), None, Some(5.5)]);
        assert!(soft.contains("edges are 5.5 pixels wide; 2 to 3 are sharp"), "{soft}");
        assert!(soft.contains("focus the lens"), "{soft}");
        assert!(of([None; 3]).contains("not judged"));
    }

    #[test]
    fn frames_that_are_older_than_the_controller_allows_are_doubtful() {
        let of = |age_ms: i64, max_age_s: Option<f64>| {
            let mut findings = Findings::default();
            let watched =
                Watched { role: None, duration: Duration::from_secs(1), has_raw_frames: true };
            let limits = max_age_s.map(|max_age_s| Limits { max_age_s, min_rate_hz: 3.0 });
            let seen = Seen { raw_frames: vec![frame(age_ms, 1)], limits, ..Seen::default() };
            check(&mut findings, &seen, watched, false);
            findings.text()
        };
        let late = "more than 200 ms after the exposure (`detectors.max_age_s`)";
        for max_age_s in [None, Some(0.2)] {
            let text = of(399, max_age_s);
            assert!(text.contains("?      camera") && text.contains(late), "{text}");
            assert!(!of(199, max_age_s).contains("max_age_s"));
        }
        assert!(!of(399, Some(0.5)).contains("max_age_s"));
        // JPEG frames of the air link may be early, and raw ones late.
        let mut jpeg = frame(20, 1);
        jpeg.header.format = PixelFormat::Jpeg;
        let mut findings = Findings::default();
        let watched =
            Watched { role: None, duration: Duration::from_secs(1), has_raw_frames: true };
        let (frames, raw_frames) = (vec![jpeg], vec![frame(399, 1)]);
        check(&mut findings, &Seen { frames, raw_frames, ..Seen::default() }, watched, false);
        let text = findings.text();
        assert!(text.contains("20 ms old on arrival; its raw frames are 399 ms old; "), "{text}");
        assert!(text.contains(late), "{text}");
    }

    #[test]
    fn two_publishers_of_one_camera_are_wrong_and_a_restart_is_not() {
        let of = |sequences: &[u64]| {
            let frames = sequences.iter().map(|sequence| {
                let mut frame = frame(30, 1);
                frame.header.sequence = *sequence;
                frame
            });
            text(frames.collect(), 640, Vec::new())
        };
        let two = of(&[1, 501, 2, 502, 3, 503, 4]);
        assert!(two.contains("two publishers of camera `down`"), "{two}");
        assert!(!of(&[100, 101, 102, 0, 1, 2]).contains("two publishers"));
    }

    #[test]
    fn frames_that_cannot_be_used_are_no_missing_frames() {
        let findings_text = |unusable: Unusable, has_camera| {
            let mut findings = Findings::default();
            let watched =
                Watched { role: None, duration: Duration::from_secs(3), has_raw_frames: true };
            let peers = vec![("detector".into(), "main".into())];
            let ended_ns = 3_000_000_000;
            let seen = Seen { peers, unusable, ended_ns, ..Seen::default() };
            check(&mut findings, &seen, watched, has_camera);
            findings.text()
        };
        assert!(findings_text(Unusable::default(), false).contains("no frame arrived within 3 s"));
        for has_camera in [false, true] {
            let mut unusable = Unusable::default();
            unusable.names_its_key(FRAMES, "down", "front");
            let text = findings_text(unusable, has_camera);
            assert!(text.contains("frames are refused") && !text.contains("no frame"), "{text}");
        }
    }

    #[test]
    fn a_mount_that_detectors_refuse_is_wrong() {
        let model = geometry::CameraModel::pinhole(640, 480, 1800.0);
        let mut info = CameraInfo::new("down", &model, &geometry::Transform::identity());
        info.body_from_camera.rotation_wxyz = [0.0; 4];
        let mut findings = Findings::default();
        let watched =
            Watched { role: None, duration: Duration::from_secs(1), has_raw_frames: true };
        check(&mut findings, &Seen { cameras: vec![info], ..Seen::default() }, watched, false);
        let text = findings.text();
        assert!(text.contains("WRONG  calibration") && text.contains("a mount of the"), "{text}");
        assert!(!text.contains("ok     calibration"), "{text}");
    }

    #[test]
    fn a_calibration_of_another_size_is_wrong() {
        let other = text(vec![frame(30, 1)], 1280, Vec::new());
        assert!(
            other.contains("calibrated at 1280 x 480 pixels, but its frames have 640 x 480"),
            "{other}"
        );
    }

    #[test]
    fn a_camera_without_a_calibration_is_wrong_where_a_detector_searches_its_frames() {
        let model = geometry::CameraModel::pinhole(640, 480, 1800.0);
        let info = CameraInfo::new("down", &model, &geometry::Transform::identity());
        let findings_text = |searched: &str| {
            let mut findings = Findings::default();
            let watched =
                Watched { role: None, duration: Duration::from_secs(3), has_raw_frames: true };
            let seen = Seen {
                cameras: vec![CameraInfo { focal_px: None, ..info.clone() }],
                searched: [searched.to_owned()].into(),
                ..Seen::default()
            };
            check(&mut findings, &seen, watched, false);
            findings.text()
        };
        let needed = findings_text("down");
        assert!(needed.contains("no landing starts") && needed.contains("1 wrong"), "{needed}");
        let other = findings_text("front");
        assert!(other.contains("not calibrated") && other.contains("0 wrong"), "{other}");
    }

    #[test]
    fn a_camera_whose_frames_ended_is_wrong_where_they_are_needed() {
        let model = geometry::CameraModel::pinhole(640, 480, 1800.0);
        let info = CameraInfo::new("down", &model, &geometry::Transform::identity());
        let status = |phase| ControllerStatus { phase, ..ControllerStatus::default() };
        let findings_text =
            |phase, is_of_site, frames: Vec<ReceivedFrame>, cameras, ended_s: i64| {
                let mut findings = Findings::default();
                let watched =
                    Watched { role: None, duration: Duration::from_secs(3), has_raw_frames: true };
                let seen = Seen {
                    peers: vec![("controller".into(), "main".into())],
                    status: Some(status(phase)),
                    ended_ns: 1_000_000_000_000 + ended_s * 1_000_000_000,
                    raw_frames: frames,
                    cameras,
                    ..Seen::default()
                };
                check(&mut findings, &seen, watched, is_of_site);
                findings.text()
            };
        let dead = "WRONG  camera        no frame from camera `down` for 3 s";
        let silent = findings_text(Phase::Search, false, Vec::new(), vec![info.clone()], 3);
        assert!(silent.contains(dead) && silent.contains("on the drone"), "{silent}");
        let ended = findings_text(Phase::Search, false, vec![frame(30, 1)], vec![info.clone()], 3);
        assert!(ended.contains(dead), "{ended}");
        let here = findings_text(Phase::Idle, true, Vec::new(), Vec::new(), 3);
        assert!(here.contains("no frame from any camera for 3 s"), "{here}");
        // It sends frames, or no landing needs them.
        let well = findings_text(Phase::Search, false, vec![frame(30, 1)], vec![info.clone()], 1);
        assert!(well.ends_with("Nothing is wrong."), "{well}");
        let idle = findings_text(Phase::Idle, false, Vec::new(), vec![info], 3);
        assert!(idle.contains("0 wrong, 1 doubtful"), "{idle}");
    }
}
