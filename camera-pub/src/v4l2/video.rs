//! The frames of a Video4Linux camera that may be unplugged, stall or change: it is opened again until it is
//! back, also under another number.

use std::io;
use std::time::Duration;

use super::abi::Device;
use super::capture::{Capture, Identity, Lost, Taken, Wanted};

/// Time between attempts to open the camera.
const RETRY_NS: i64 = 500_000_000;
/// Maximum time to wait for a frame at once, so that a shutdown is noticed.
const POLL: Duration = Duration::from_millis(50);
/// Time without a frame after which the camera has stalled, in addition to three periods: drivers that recover take less.
const STALL_NS: i64 = 1_000_000_000;

/// Where a camera is opened.
pub(crate) trait Port: Sized {
    /// The type of device that it opens.
    type Device: Device;

    /// Opens the device.
    ///
    /// # Errors
    /// It is not there, or may not be used.
    fn open(&self) -> io::Result<Self::Device>;

    /// Whether the path is a device's number (`/dev/video0`), which another camera may have after a loss.
    fn is_by_number(&self) -> bool;

    /// The devices of all other numbers.
    fn others(&self) -> Vec<Self>;

    /// Its name in messages.
    fn name(&self) -> String;

    /// The host's clock.
    fn now_ns(&self) -> i64;
}

/// A camera, open or lost.
pub(crate) struct Video<P: Port> {
    port: P,
    wanted: Wanted,
    capture: Option<Capture<P::Device>>,
    /// Which camera it was first: another one has another mount and another calibration.
    identity: Identity,
    /// Whether its stamps have been of the host's clock: then others end no service.
    has_clock: bool,
    last_frame_ns: i64,
    retry_ns: i64,
    outage: Option<Outage>,
}

/// Since when there are no frames, and why.
struct Outage {
    since_ns: i64,
    problem: String,
}

/// The next event.
pub(crate) enum Next {
    /// A frame, to be given back.
    Frame(Taken),
    /// Nothing yet.
    Nothing,
    /// Nothing for so long: the camera is lost.
    Wait(Duration),
    /// The camera has just been lost, for a reason that is counted.
    Lost(&'static str),
}

impl<P: Port> Video<P> {
    /// Opens the camera.
    ///
    /// # Errors
    /// It is not there, or does not support the configuration.
    pub(crate) fn start(port: P, wanted: Wanted) -> Result<Self, Lost> {
        let capture = open(&port, &wanted, None)?;
        let now_ns = port.now_ns();
        Ok(Self {
            port,
            wanted,
            identity: capture.identity().clone(),
            capture: Some(capture),
            has_clock: false,
            last_frame_ns: now_ns,
            retry_ns: now_ns,
            outage: None,
        })
    }

    /// The host's clock.
    pub(crate) fn now_ns(&self) -> i64 {
        self.port.now_ns()
    }

    /// The open camera.
    pub(crate) fn capture(&mut self) -> Option<&mut Capture<P::Device>> {
        self.capture.as_mut()
    }

    /// The next frame, or the event instead of one.
    ///
    /// # Errors
    /// The camera's stamps have been of another clock from the start.
    pub(crate) fn next(&mut self) -> Result<Next, Lost> {
        let now_ns = self.port.now_ns();
        let Some(capture) = &mut self.capture else {
            if now_ns < self.retry_ns {
                return Ok(Next::Wait(POLL));
            }
            return Ok(self.reopen());
        };
        match capture.take(POLL) {
            Ok(Some(taken)) => {
                self.last_frame_ns = self.port.now_ns();
                if let Some(outage) = self.outage.take() {
                    let lost_s = (self.last_frame_ns - outage.since_ns) as f64 * 1e-9;
                    tracing::info!(lost_s, "The camera is back");
                }
                Ok(Next::Frame(taken))
            }
            Ok(None) => {
                let silent_ns = self.port.now_ns() - self.last_frame_ns;
                let period_ns = (1e9 / capture.rate_hz().max(1e-3)) as i64;
                if silent_ns < STALL_NS.max(3 * period_ns) {
                    return Ok(Next::Nothing);
                }
                let silent = Duration::from_nanos(u64::try_from(silent_ns).unwrap_or(0));
                Ok(self.lose(&Lost::Stalled(silent)))
            }
            Err(foreign @ Lost::ForeignClock { .. }) => Err(foreign),
            Err(lost) => Ok(self.lose(&lost)),
        }
    }

    /// Closes the camera; it is opened again after a while.
    pub(crate) fn lose(&mut self, lost: &Lost) -> Next {
        self.has_clock |= self.capture.take().is_some_and(|capture| capture.has_clock());
        let now_ns = self.port.now_ns();
        self.retry_ns = now_ns + RETRY_NS;
        let problem = lost.to_string();
        let since_ns = self.outage.as_ref().map_or(now_ns, |outage| outage.since_ns);
        // A repeated error is logged once.
        if self.outage.as_ref().is_none_or(|outage| outage.problem != problem) {
            tracing::warn!(problem, "The camera is lost; it is opened again until it is back");
        }
        self.outage = Some(Outage { since_ns, problem });
        Next::Lost(lost.reason())
    }

    fn reopen(&mut self) -> Next {
        let opened = match open(&self.port, &self.wanted, Some(&self.identity)) {
            Err(lost @ Lost::Another(_)) => self.open_elsewhere().unwrap_or(Err(lost)),
            opened => opened,
        };
        match opened {
            Ok(mut capture) => {
                if self.has_clock {
                    capture.believe_clock();
                }
                self.capture = Some(capture);
                self.last_frame_ns = self.port.now_ns();
                Next::Nothing
            }
            Err(lost) => {
                self.lose(&lost);
                Next::Wait(POLL)
            }
        }
    }

    /// Opens the camera at another number, where another camera has got its own one.
    fn open_elsewhere(&self) -> Option<Result<Capture<P::Device>, Lost>> {
        if !self.port.is_by_number() {
            return None;
        }
        let is_it = |port: &P| {
            port.open().is_ok_and(|device| Identity::of(&device).as_ref() == Some(&self.identity))
        };
        let mut found = self.port.others().into_iter().filter(is_it);
        // Several cameras of one device cannot be distinguished.
        let (Some(port), None) = (found.next(), found.next()) else { return None };
        let opened = open(&port, &self.wanted, Some(&self.identity));
        if opened.is_ok() {
            tracing::warn!(
                number = port.name(),
                "The camera has another number now, where it is read until it is lost again. Started again, the service would take \
                 the camera that has its number: set `source.device` to a path in /dev/v4l/by-id or by-path, which stays with it"
            );
        }
        Some(opened)
    }
}

/// Opens the camera; after a loss only the same one.
fn open<P: Port>(
    port: &P,
    wanted: &Wanted,
    before: Option<&Identity>,
) -> Result<Capture<P::Device>, Lost> {
    let device = port.open().map_err(|cause| match cause.raw_os_error() {
        Some(libc::ENODEV | libc::ENXIO | libc::ENOENT) => Lost::Unplugged,
        Some(libc::EACCES | libc::EPERM) => Lost::Refused(
            "this user may not open it; the group `video` may, in most systems".to_owned(),
        ),
        _ => Lost::Failed { call: "open", cause },
    })?;
    Capture::start(device, wanted, |now| match before {
        // A link is of a camera or of a place, but a camera of the same name may be plugged in elsewhere.
        Some(before) if now.card != before.card || port.is_by_number() && now != before => {
            Err(Lost::Another(format!(
                "another camera is there now, `{}` at {}; `{}` at {} is waited for. A path in /dev/v4l/by-id or by-path stays \
                 with its camera; start the service again if this is the one to take",
                now.card, now.bus, before.card, before.bus
            )))
        }
        _ => Ok(()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Configured;
    use crate::exposure::StampedAt;
    use crate::v4l2::abi::CID_EXPOSURE_AUTO;
    use crate::v4l2::capture::Counts;
    use crate::v4l2::fake::{Fake, Happening, MS, Oddity, Stamps};
    use std::rc::Rc;

    fn wanted(fake: &Fake) -> Wanted {
        Wanted {
            fourcc: fake.fourcc().to_owned(),
            width: 640,
            height: 480,
            rate_hz: 100.0,
            controls: Vec::new(),
            for_marker: None,
            stamped_at: None,
            readout_ns: 0,
            delay_ns: 30 * MS,
        }
    }

    /// The frames and counts of a run.
    #[derive(Default)]
    struct Seen {
        frames: u64,
        exact: u64,
        worst_ns: i64,
        copied_bytes: usize,
        lost: Vec<&'static str>,
        /// The longest time between two frames.
        gap_ns: i64,
    }

    /// Reads frames until this time of the fake's clock; each has its number in its pixels.
    fn run(fake: &Rc<Fake>, video: &mut Video<Rc<Fake>>, until_ns: i64) -> Seen {
        let mut seen = Seen::default();
        let mut last_ns = fake.now_ns();
        let mut grey = vec![0; 640 * 480];
        while fake.now_ns() < until_ns {
            match video.next().unwrap() {
                Next::Frame(taken) => {
                    let capture = video.capture().unwrap();
                    seen.copied_bytes += capture.copy_grey(&taken, &mut grey);
                    let number = u32::from_le_bytes(grey[..4].try_into().unwrap());
                    let exposure = taken.exposure;
                    capture.give_back(taken).unwrap();
                    seen.frames += 1;
                    let truth_ns = fake.mid_exposure_ns(number);
                    let error_ns = (exposure.mid_ns - truth_ns).abs();
                    if exposure.is_exact() {
                        seen.exact += 1;
                        seen.worst_ns = seen.worst_ns.max(error_ns);
                    }
                    seen.gap_ns = seen.gap_ns.max(fake.now_ns() - last_ns);
                    last_ns = fake.now_ns();
                }
                Next::Nothing => {}
                Next::Wait(time) => fake.pass(time),
                Next::Lost(reason) => seen.lost.push(reason),
            }
        }
        seen
    }

    #[test]
    fn stamps_are_the_middle_of_the_exposure_whatever_the_driver_stamps() {
        for fourcc in ["GREY", "YUYV", "NV12", "YU12"] {
            for stamps in [Stamps::ExposureStart, Stamps::FirstPacket, Stamps::FrameEnd] {
                for readout_ns in [0, 12 * MS] {
                    let fake = Fake::of(fourcc, stamps, readout_ns);
                    let wanted = Wanted { readout_ns, ..wanted(&fake) };
                    let mut video = Video::start(Rc::clone(&fake), wanted).unwrap();
                    let seen = run(&fake, &mut video, 1000 * MS);
                    assert!(seen.frames > 80 && seen.exact == seen.frames, "{}", seen.frames);
                    // Drivers stamp in microseconds.
                    assert!(seen.worst_ns <= 1000, "{fourcc} {stamps:?}: {} ns", seen.worst_ns);
                    // One copy of each frame, and no more.
                    assert_eq!(seen.copied_bytes as u64, seen.frames * 640 * 480);
                    assert!(seen.lost.is_empty());
                }
            }
        }
    }

    #[test]
    fn the_exposure_is_reported_also_for_a_driver_whose_stamps_are_of_no_clock() {
        for stamps in [Stamps::ExposureStart, Stamps::Unknown] {
            let fake = Fake::of("GREY", stamps, 0);
            let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
            run(&fake, &mut video, 100 * MS);
            let fixed = Configured::Fixed { exposure_ns: 5_000_000 };
            assert_eq!(video.capture().unwrap().configured(), Some(fixed), "{stamps:?}");
            fake.meter();
            run(&fake, &mut video, 1500 * MS);
            let metering = Some(Configured::Metering);
            assert_eq!(video.capture().unwrap().configured(), metering, "{stamps:?}");
        }
    }

    #[test]
    fn a_stamp_that_is_not_exact_is_marked() {
        let inexact = |fake: Rc<Fake>| {
            let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
            let seen = run(&fake, &mut video, 1000 * MS);
            assert!(seen.frames > 80);
            seen.frames - seen.exact
        };
        // A driver that does not report its clock, and a camera that meters on its own.
        assert!(inexact(Fake::of("GREY", Stamps::Unknown, 0)) > 80);
        let metering = Fake::of("GREY", Stamps::ExposureStart, 0);
        metering.meter();
        assert!(inexact(metering) > 80);
        // One that does not report whether it meters.
        let silent = Fake::of("GREY", Stamps::ExposureStart, 0);
        silent.meter();
        silent.hide(Some(CID_EXPOSURE_AUTO));
        assert!(inexact(silent) > 80);
        assert_eq!(inexact(Fake::of("GREY", Stamps::ExposureStart, 0)), 0);
    }

    #[test]
    fn a_camera_that_sends_sooner_than_it_reads_gives_frames_by_their_arrival() {
        let fake = Fake::of("GREY", Stamps::FirstPacket, 0);
        let wanted = Wanted { readout_ns: 20 * MS, ..wanted(&fake) };
        let mut video = Video::start(Rc::clone(&fake), wanted).unwrap();
        let seen = run(&fake, &mut video, 1000 * MS);
        assert!(seen.frames > 80 && seen.exact == 0 && seen.lost.is_empty(), "{}", seen.frames);
        assert_eq!(video.capture().unwrap().take_counts().early, seen.frames);
    }

    #[test]
    fn the_configured_instant_goes_before_the_drivers() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        let stamped_at = Some(StampedAt::FrameEnd);
        let mut video =
            Video::start(Rc::clone(&fake), Wanted { stamped_at, ..wanted(&fake) }).unwrap();
        // Exposed for 5 ms: half before the stamp instead of half after it.
        assert_eq!(run(&fake, &mut video, 1000 * MS).worst_ns / MS, 5);
    }

    #[test]
    fn damaged_cut_and_missing_frames_are_counted_and_never_delivered() {
        let fake = Fake::of("YUYV", Stamps::ExposureStart, 0);
        fake.script(20, Happening::Damaged);
        fake.script(30, Happening::Cut);
        fake.script(40, Happening::Skipped(3));
        fake.script(50, Happening::IoError);
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        let seen = run(&fake, &mut video, 1000 * MS);
        let counts = video.capture().unwrap().take_counts();
        assert_eq!((counts.damaged, counts.cut, counts.missed), (2, 1, 3));
        assert!(seen.lost.is_empty() && seen.frames > 80 && seen.worst_ns <= 1000);
    }

    #[test]
    fn a_camera_that_is_lost_is_named_and_back_within_two_seconds() {
        let cases = [
            ("camera unplugged", Happening::Unplugged(2900 * MS), 2000),
            ("camera stalled", Happening::Stalled, 2000),
            ("camera's format changed", Happening::Resized, 2000),
        ];
        for (reason, happening, max_ms) in cases {
            let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
            fake.script(100, happening);
            let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
            let seen = run(&fake, &mut video, 8000 * MS);
            assert_eq!(seen.lost, [reason]);
            let away_ns = if let Happening::Unplugged(away_ns) = happening { away_ns } else { 0 };
            let back_ms = (seen.gap_ns - away_ns) / MS;
            println!("{reason}: back after {back_ms} ms");
            assert!((0..=max_ms).contains(&back_ms), "{reason}: {back_ms} ms");
            assert!(seen.frames > 300 && seen.worst_ns <= 1000);
        }
    }

    #[test]
    fn another_camera_of_the_same_kind_is_not_taken_after_a_loss() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        assert!(run(&fake, &mut video, 200 * MS).frames > 10);
        // Their numbers have changed.
        fake.unplug(200 * MS);
        fake.plug_in_at(b"usb-0000:0e:00.0-2.1");
        let seen = run(&fake, &mut video, 3000 * MS);
        assert_eq!((seen.frames, &seen.lost[..]), (0, &["camera unplugged"][..]));
        fake.plug_in_at(b"usb-0000:0e:00.0-2.4");
        assert!(run(&fake, &mut video, 4000 * MS).frames > 10);
        // By its link it is the same one wherever it is.
        fake.link();
        fake.unplug(200 * MS);
        fake.plug_in_at(b"usb-0000:0e:00.0-2.1");
        assert!(run(&fake, &mut video, 6000 * MS).frames > 10);
    }

    #[test]
    fn a_camera_that_has_changed_its_number_with_another_is_found_at_the_other_one() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        assert!(run(&fake, &mut video, 200 * MS).frames > 10);
        let there = Fake::of("GREY", Stamps::ExposureStart, 0);
        there.plug_in_at(b"usb-0000:0e:00.0-2.2");
        fake.add_other(&there);
        let other = Fake::of("GREY", Stamps::ExposureStart, 0);
        other.plug_in_at(b"usb-0000:0e:00.0-2.3");
        fake.add_other(&other);
        fake.unplug(200 * MS);
        fake.plug_in_at(b"usb-0000:0e:00.0-2.1");
        assert_eq!(run(&fake, &mut video, 3000 * MS).frames, 0);
        assert_eq!((fake.open_devices(), there.open_devices()), (0, 0));
        // Two at its place are two of one device.
        there.plug_in_at(b"usb-0000:0e:00.0-2.4");
        other.plug_in_at(b"usb-0000:0e:00.0-2.4");
        assert_eq!(run(&fake, &mut video, 4000 * MS).frames, 0);
        other.plug_in_at(b"usb-0000:0e:00.0-2.3");
        assert!(run(&fake, &mut video, 8000 * MS).frames > 10);
        assert_eq!((fake.open_devices(), there.open_devices()), (0, 1));
        // Back at its own number it is read there.
        fake.plug_in_at(b"usb-0000:0e:00.0-2.4");
        video.lose(&Lost::Unplugged);
        assert!(run(&fake, &mut video, 10_000 * MS).frames > 10);
        assert_eq!((fake.open_devices(), there.open_devices()), (1, 0));
    }

    #[test]
    fn a_slow_reader_gets_the_newest_frame_and_those_before_it_are_counted() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        let slow = Duration::from_millis(350);
        let (mut frames, mut counts) = (0, Counts::default());
        while fake.now_ns() < 20_000 * MS {
            let Next::Frame(taken) = video.next().unwrap() else { continue };
            let exposure = taken.exposure;
            let age_ns = fake.now_ns() - exposure.mid_ns;
            fake.pass(slow);
            let capture = video.capture().unwrap();
            capture.give_back(taken).unwrap();
            let more = capture.take_counts();
            counts.queued += more.queued;
            counts.missed += more.missed;
            frames += 1;
            assert!(exposure.is_exact(), "frame {frames}");
            assert!(age_ns < slow.as_nanos() as i64, "frame {frames}: {} ms", age_ns / MS);
        }
        // Three buffers are filled while the fourth is read, and the frames after them find none.
        assert_eq!((frames, counts.queued), (58, 2 * 57));
        assert!(counts.missed > 30 * 57, "{counts:?}");
    }

    #[test]
    fn a_slow_reader_gets_the_newest_complete_frame() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        (1..2000).step_by(2).for_each(|number| fake.script(number, Happening::Damaged));
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        let mut frames = 0;
        while fake.now_ns() < 10_000 * MS {
            let Next::Frame(taken) = video.next().unwrap() else { continue };
            assert_eq!(fake.number_at(taken.exposure.mid_ns + MS) % 2, 0);
            fake.pass(Duration::from_millis(25));
            video.capture().unwrap().give_back(taken).unwrap();
            frames += 1;
        }
        // Each of 25 ms, in which two or three come, one of them at least whole.
        assert!(frames > 390, "{frames}");
    }

    #[test]
    fn a_clock_that_was_good_once_ends_no_service_when_the_camera_is_back_with_another() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        fake.script(100, Happening::Unplugged(300 * MS));
        fake.script(101, Happening::OtherClock);
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        let seen = run(&fake, &mut video, 4000 * MS);
        assert_eq!(seen.lost, ["camera unplugged"]);
        assert!(seen.frames - seen.exact > 200 && seen.worst_ns <= 1000, "{}", seen.frames);
    }

    #[test]
    fn a_thousand_reopenings_leave_nothing_open() {
        let fake = Fake::of("GREY", Stamps::ExposureStart, 0);
        let mut video = Video::start(Rc::clone(&fake), wanted(&fake)).unwrap();
        for n in 0..1000 {
            let lost = match n % 3 {
                0 => Lost::Unplugged,
                1 => Lost::Stalled(Duration::ZERO),
                _ => Lost::FormatChanged(String::new()),
            };
            if n % 3 == 0 {
                fake.unplug(200 * MS);
            }
            video.lose(&lost);
            assert_eq!((fake.open_devices(), fake.mappings()), (0, 0), "after {n} reopenings");
            let until_ns = fake.now_ns() + 700 * MS;
            assert!(run(&fake, &mut video, until_ns).frames > 0, "not back after {n} reopenings");
            assert_eq!((fake.open_devices(), fake.mappings()), (1, 4), "after {n} reopenings");
        }
        drop(video);
        assert_eq!((fake.open_devices(), fake.mappings(), fake.opened()), (0, 0, 1001));
    }

    #[test]
    fn unsupported_settings_are_refused_with_the_supported_ones() {
        use crate::v4l2::capture::ControlValue;
        let problem = |wanted: Wanted| {
            let fake = Fake::of("MJPG", Stamps::ExposureStart, 0);
            Video::start(fake, wanted).err().unwrap().to_string()
        };
        let fine = wanted(&Fake::of("MJPG", Stamps::ExposureStart, 0));
        let size = problem(Wanted { width: 800, ..fine.clone() });
        assert!(size.contains("nearest is `MJPG` of 640 x 480"), "{size}");
        assert!(size.contains("`MJPG` of 1280 x 720, 640 x 480"), "{size}");
        let format = problem(Wanted { fourcc: "NV12".into(), ..fine.clone() });
        assert!(format.contains("has no `NV12` of 640 x 480"), "{format}");
        let control = |name: &str, value| {
            let controls = vec![ControlValue { name: name.into(), value }];
            problem(Wanted { controls, ..fine.clone() })
        };
        let unknown = control("exposure", 3);
        assert!(unknown.contains("no control `exposure`"), "{unknown}");
        assert!(
            unknown.contains("it has gain, auto_exposure, exposure_time_absolute"),
            "{unknown}"
        );
        let range = control("exposure_time_absolute", 9999);
        assert!(range.contains("to 9999, but it can be from 1 to 2500"), "{range}");
        let odd = |oddity| {
            let fake = Fake::of("MJPG", Stamps::ExposureStart, 0);
            fake.make(oddity);
            Video::start(fake, fine.clone()).err().unwrap().to_string()
        };
        let interlaced = odd(Oddity::Interlaced);
        assert!(interlaced.contains("interlaced") && interlaced.contains("yadif"), "{interlaced}");
        let planes = odd(Oddity::MultiPlanar);
        assert!(planes.contains("multi-planar") && planes.contains("GStreamer"), "{planes}");
        let crowded = odd(Oddity::Crowded);
        assert!(crowded.contains("no room") && crowded.contains("lower rate"), "{crowded}");
        let fake = Fake::of("MJPG", Stamps::ExposureStart, 0);
        fake.script(0, Happening::OtherClock);
        let mut video = Video::start(Rc::clone(&fake), fine).unwrap();
        let foreign = (0..100).find_map(|_| match video.next() {
            Ok(Next::Frame(taken)) => {
                video.capture().unwrap().give_back(taken).unwrap();
                None
            }
            Ok(_) => None,
            Err(foreign) => Some(foreign.to_string()),
        });
        assert!(foreign.unwrap().contains("not of this machine's clock"));
    }
}
