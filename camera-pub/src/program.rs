//! Reads a camera through another program (`rpicam-vid`, `ffmpeg`, `gst-launch-1.0`): frames from its standard
//! output, each with its time of arrival.
//!
//! Any camera with such a program can be used, and none of their libraries is needed here.

use std::future::poll_fn;
use std::io::ErrorKind;
use std::pin::pin;
use std::process::Stdio;
use std::time::{Duration, Instant};

use anyhow::{Context, anyhow, bail};
use media::JpegScanner;
use node::now_ns;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::time::timeout;

use crate::config::{FrameFormat, ProgramConfig};
use crate::exposure::Exposure;
use crate::side_channel::{PLACEHOLDER, SideChannel};

/// Size of the read buffer, in bytes: the capacity of a Linux pipe.
const BUFFER_BYTES: usize = 1 << 16;
/// Time a program may take to exit after it has closed its output.
const EXIT_TIMEOUT: Duration = Duration::from_secs(1);
/// A read that returns within this time, in nanoseconds, found its data already there.
const IMMEDIATE_NS: i64 = 200_000;

/// A running program and the frames it writes.
pub(crate) struct Program {
    name: String,
    timeout: Duration,
    child: Child,
    frames: FrameReader<BufReader<ChildStdout>>,
    delay_ns: i64,
    metadata: Option<SideChannel>,
    rate: Rate,
}

impl Program {
    /// Starts the program.
    pub(crate) fn start(config: &ProgramConfig) -> anyhow::Result<Self> {
        let (program, arguments) =
            config.command.split_first().context("`source.command` names no program")?;
        let name = program.clone();
        let period = Duration::from_secs_f64(1.0 / config.rate_hz);
        let metadata = config.has_metadata().then(|| SideChannel::open(config.shutter, period));
        let metadata = metadata.transpose()?;
        let path = metadata.as_ref().map(|metadata| metadata.path().display().to_string());
        let path = path.unwrap_or_default();
        let mut child = Command::new(program)
            .args(arguments.iter().map(|argument| argument.replace(PLACEHOLDER, &path)))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| {
                format!(
                    "starting the camera program `{name}` of `source.command`; is it installed?"
                )
            })?;
        let output = child.stdout.take().with_context(|| format!("`{name}` has no output"))?;
        let input = BufReader::with_capacity(BUFFER_BYTES, output);
        let frames = FrameReader::new(input, config.format, period, config.timeout);
        let (timeout, delay_ns) = (config.timeout, config.delay_ns);
        let rate = Rate::of(config.rate_hz);
        Ok(Self { name, timeout, child, frames, delay_ns, metadata, rate })
    }

    /// Waits for the first byte of the next frame.
    ///
    /// # Errors
    /// When the program writes nothing within the timeout, exits, or writes something else.
    pub(crate) async fn wait(&mut self) -> anyhow::Result<Arrival> {
        let Self { name, frames, metadata, .. } = self;
        let waiting = async {
            let mut frame = pin!(frames.wait());
            let Some(metadata) = metadata else { return frame.await };
            loop {
                tokio::select! {
                    // Where both are there, the frame was written first.
                    biased;
                    arrival = &mut frame => return arrival,
                    () = metadata.take_before_frame() => {}
                }
            }
        };
        match timeout(self.timeout, waiting).await {
            Ok(Ok(Some(arrival))) => Ok(arrival),
            Ok(Ok(None)) => Err(self.exit_error().await),
            Ok(Err(cause)) => Err(anyhow!("reading frames from `{name}`: {cause}")),
            Err(_elapsed) => bail!(
                "no frame from `{name}` for {:.1} s (`source.timeout_s`); is the camera connected, and does no other \
                 program use it?",
                self.timeout.as_secs_f64()
            ),
        }
    }

    /// Reads the frame that has begun to arrive: samples into `samples`, of [`FrameFormat::frame_bytes`]; a
    /// JPEG file is returned.
    ///
    /// # Errors
    /// When the program writes nothing within the timeout, exits, or writes something else.
    pub(crate) async fn read(&mut self, samples: &mut [u8]) -> anyhow::Result<Vec<u8>> {
        let name = &self.name;
        match self.frames.read(samples).await {
            Ok(jpeg) => Ok(jpeg),
            Err(cause) if cause.kind() == ErrorKind::UnexpectedEof => {
                Err(self.exit_error().await.context("its last frame is incomplete"))
            }
            Err(cause) if cause.kind() == ErrorKind::TimedOut => bail!(
                "`{name}` stopped in the middle of a frame for {:.1} s (`source.timeout_s`)",
                self.timeout.as_secs_f64()
            ),
            Err(cause) => Err(anyhow!("reading a frame from `{name}`: {cause}")),
        }
    }

    /// The rate of the program's frames, in hertz, once when it is twice the configured one for two seconds: the size or the pixel format
    /// may be another one.
    pub(crate) fn excessive_rate_hz(&mut self) -> Option<f64> {
        self.rate.add(Instant::now())
    }

    /// When the frame that was read was exposed: by its metadata, or by its arrival. `None` when it was queued.
    ///
    /// # Errors
    /// The metadata are of another clock.
    pub(crate) async fn exposure(&mut self, arrival: Arrival) -> anyhow::Result<Option<Exposure>> {
        if arrival.was_queued {
            if let Some(metadata) = &mut self.metadata {
                metadata.skip_frame();
            }
            return Ok(None);
        }
        let by_metadata = match &mut self.metadata {
            Some(metadata) => metadata
                .end_frame(arrival.stamp_ns)
                .await
                .with_context(|| format!("reading the metadata of `{}`", self.name))?,
            None => None,
        };
        let by_arrival = Exposure::estimated(arrival.stamp_ns - self.delay_ns);
        Ok(Some(by_metadata.unwrap_or(by_arrival)))
    }

    /// True when frames have metadata with their exposure.
    pub(crate) fn has_metadata(&self) -> bool {
        self.metadata.as_ref().is_some_and(SideChannel::has_agreed)
    }

    /// How the program ended.
    async fn exit_error(&mut self) -> anyhow::Error {
        let frames = self.frames.count;
        let how = match timeout(EXIT_TIMEOUT, self.child.wait()).await {
            Ok(Ok(status)) => format!("ended ({status})"),
            _ => "closed its output".to_owned(),
        };
        anyhow!(
            "the camera program `{}` {how} after {frames} frames; see its stderr above",
            self.name
        )
    }
}

/// A frame that begins to arrive.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Arrival {
    /// Time of its first byte, in nanoseconds of the host's clock.
    pub(crate) stamp_ns: i64,
    /// True when it was queued before it was read, so that its age is unknown.
    pub(crate) was_queued: bool,
}

/// Splits a stream of bytes into frames.
struct FrameReader<R> {
    input: R,
    format: FrameFormat,
    scanner: JpegScanner,
    queue: Queue,
    /// Maximum time without a byte within a frame, and in which a JPEG file must end.
    timeout: Duration,
    count: u64,
}

impl<R: AsyncBufRead + Unpin> FrameReader<R> {
    fn new(input: R, format: FrameFormat, period: Duration, timeout: Duration) -> Self {
        let queue = Queue::of(period);
        Self { input, format, scanner: JpegScanner::default(), queue, timeout, count: 0 }
    }

    /// Waits for the first byte of a frame; `None` at the end of the input.
    async fn wait(&mut self) -> std::io::Result<Option<Arrival>> {
        let read_ns = now_ns();
        if self.count == 0 {
            check_format(self.input.fill_buf().await?, self.format)?;
        }
        let has_begun = match self.format {
            FrameFormat::Samples { .. } => !self.input.fill_buf().await?.is_empty(),
            FrameFormat::Jpeg { max_bytes } => self.find_jpeg(max_bytes).await?,
        };
        if !has_begun {
            return Ok(None);
        }
        let stamp_ns = now_ns();
        let was_queued = self.queue.has_held(stamp_ns, stamp_ns - read_ns);
        Ok(Some(Arrival { stamp_ns, was_queued }))
    }

    /// Skips to the next SOI marker and past it; false at the end of the input.
    async fn find_jpeg(&mut self, max_bytes: usize) -> std::io::Result<bool> {
        let mut skipped = 0;
        while !self.scanner.has_started() {
            let ahead = self.input.fill_buf().await?;
            if ahead.is_empty() {
                return Ok(false);
            }
            let taken = self.scanner.push(ahead);
            self.input.consume(taken);
            skipped += taken;
            if skipped > max_bytes {
                return Err(no_jpeg("start", max_bytes));
            }
        }
        Ok(true)
    }

    async fn read(&mut self, samples: &mut [u8]) -> std::io::Result<Vec<u8>> {
        let (jpeg, waiting) = waiting_of(self.read_rest(samples)).await;
        self.queue.has_read(waiting);
        jpeg
    }

    async fn read_rest(&mut self, samples: &mut [u8]) -> std::io::Result<Vec<u8>> {
        let jpeg = match self.format {
            FrameFormat::Samples { row_bytes, stride_bytes, rows: _, chroma_bytes } => {
                for row in samples.chunks_exact_mut(row_bytes.max(1)) {
                    self.read_exact(row).await?;
                    self.skip(stride_bytes - row_bytes).await?;
                }
                self.skip(chroma_bytes).await?;
                Vec::new()
            }
            FrameFormat::Jpeg { max_bytes } => self.read_jpeg(max_bytes).await?,
        };
        self.count += 1;
        Ok(jpeg)
    }

    async fn read_exact(&mut self, mut to: &mut [u8]) -> std::io::Result<()> {
        while !to.is_empty() {
            let taken =
                std::io::Write::write(&mut to, ahead(&mut self.input, self.timeout).await?)?;
            self.input.consume(taken);
        }
        Ok(())
    }

    async fn skip(&mut self, bytes: usize) -> std::io::Result<()> {
        let mut left = bytes;
        while left > 0 {
            let taken = ahead(&mut self.input, self.timeout).await?.len().min(left);
            self.input.consume(taken);
            left -= taken;
        }
        Ok(())
    }

    /// Reads from the SOI marker to the end of the file.
    async fn read_jpeg(&mut self, max_bytes: usize) -> std::io::Result<Vec<u8>> {
        let began = Instant::now();
        while !self.scanner.is_complete() {
            let taken = self.scanner.push(ahead(&mut self.input, self.timeout).await?);
            self.input.consume(taken);
            let is_late = began.elapsed() > self.timeout;
            if !self.scanner.is_complete() && (self.scanner.file_len() > max_bytes || is_late) {
                return Err(no_jpeg("end", self.scanner.file_len()));
            }
        }
        Ok(self.scanner.take())
    }
}

/// Refuses a stream whose first bytes show that it is in another format than the configured one.
fn check_format(first: &[u8], format: FrameFormat) -> std::io::Result<()> {
    let found = match (first, format) {
        // An SOI marker, and one that may follow it (tables, frame header, application data, comment): a row of a Bayer pattern may begin with
        // the same three bytes.
        (
            [0xff, 0xd8, 0xff, 0xc0..=0xcf | 0xdb | 0xdd | 0xe0..=0xef | 0xfe, ..],
            FrameFormat::Samples { .. },
        ) => "it writes JPEG files; set `source.pixels` to \"mjpeg\", or let it write raw frames",
        // A start code, a sequence parameter set, and one of the profiles (ITU-T H.264, 7.4.2.1.1).
        ([0, 0, 0, 1, 0x27 | 0x67, 66 | 77 | 88 | 100 | 110 | 122 | 244, ..], _) => {
            "it writes H.264; let it write the raw frames of `source.pixels` (ffmpeg: -pix_fmt gray -f rawvideo), or \
             Motion JPEG for `source.pixels` = \"mjpeg\""
        }
        _ => return Ok(()),
    };
    Err(std::io::Error::other(found))
}

/// The next bytes of a frame; an error when none come within the time limit, or the input ends.
async fn ahead<R: AsyncBufRead + Unpin>(input: &mut R, limit: Duration) -> std::io::Result<&[u8]> {
    match timeout(limit, input.fill_buf()).await {
        Ok(Ok([])) => Err(ErrorKind::UnexpectedEof.into()),
        Ok(bytes) => bytes,
        Err(_elapsed) => Err(ErrorKind::TimedOut.into()),
    }
}

/// How a read waited for bytes.
#[derive(Copy, Clone, Debug, Default)]
struct Waiting {
    total_ns: i64,
    /// When the last wait ended.
    ended_ns: i64,
}

/// Does the work; returns its result, and how it waited.
async fn waiting_of<T>(work: impl Future<Output = T>) -> (T, Waiting) {
    let mut work = pin!(work);
    let mut waiting = Waiting::default();
    let mut since_ns = None;
    let result = poll_fn(|context| {
        if let Some(since_ns) = since_ns.take() {
            waiting.ended_ns = now_ns();
            waiting.total_ns += waiting.ended_ns - since_ns;
        }
        let polled = work.as_mut().poll(context);
        if polled.is_pending() {
            since_ns = Some(now_ns());
        }
        polled
    })
    .await;
    (result, waiting)
}

/// Measures the rate of frames.
struct Rate {
    expected_hz: f64,
    since: Option<Instant>,
    frames: u32,
    /// Seconds in which it was excessive, one after the other.
    seconds: u32,
}

impl Rate {
    fn of(expected_hz: f64) -> Self {
        Self { expected_hz, since: None, frames: 0, seconds: 0 }
    }

    /// Counts a frame; the rate in hertz, once for each time that it is about twice the expected one or more for two seconds. A burst of frames
    /// that were queued takes less.
    fn add(&mut self, now: Instant) -> Option<f64> {
        let since = *self.since.get_or_insert(now);
        self.frames += u32::from(now > since);
        let elapsed_s = now.saturating_duration_since(since).as_secs_f64();
        if elapsed_s < 1.0 {
            return None;
        }
        let rate_hz = f64::from(self.frames) / elapsed_s;
        let is_excessive = rate_hz > 1.8 * self.expected_hz;
        self.seconds = if is_excessive { self.seconds.saturating_add(1) } else { 0 };
        (self.since, self.frames) = (Some(now), 0);
        (self.seconds == 2).then_some(rate_hz)
    }
}

/// Detects frames that were queued on their way.
struct Queue {
    /// Nominal time between frames.
    period_ns: i64,
    last: Option<Last>,
    /// When the frame before had all been read, where it came as slowly as it was made: until then nothing was queued.
    empty_ns: Option<i64>,
}

/// The frame before.
#[derive(Copy, Clone)]
struct Last {
    /// When its first byte was read.
    read_ns: i64,
    /// When that was there, as far as it is known.
    due_ns: i64,
}

impl Queue {
    fn of(period: Duration) -> Self {
        Self {
            period_ns: period.as_nanos().try_into().unwrap_or(i64::MAX),
            last: None,
            empty_ns: None,
        }
    }

    /// Notes how the rest of a frame was waited for. Of a frame that was queued all is there, or comes at once; over most of
    /// a period come those of a program that writes rows as they are scanned, or over a narrow link.
    fn has_read(&mut self, waiting: Waiting) {
        let is_made = waiting.total_ns >= self.period_ns / 4 * 3;
        self.empty_ns = is_made.then_some(waiting.ended_ns);
    }

    /// Whether the frame whose first byte is read at `stamp_ns`, after the read waited so long for it, was queued: one that
    /// follows sooner than a camera can deliver, and one that was there already and is later than it was due. Due
    /// times are counted from the last frame that was waited for, so that the delay of a slow reader adds up. They are no
    /// sooner than the end of a frame that was read as it was made.
    fn has_held(&mut self, stamp_ns: i64, waited_ns: i64) -> bool {
        let quarter_ns = self.period_ns / 4;
        let due_ns = match self.last {
            Some(last) if waited_ns < IMMEDIATE_NS => {
                let due_ns = last.due_ns.saturating_add(self.period_ns);
                due_ns.max(self.empty_ns.unwrap_or(i64::MIN)).min(stamp_ns)
            }
            _ => stamp_ns,
        };
        let last = self.last.replace(Last { read_ns: stamp_ns, due_ns });
        last.is_some_and(|last| stamp_ns - last.read_ns < quarter_ns)
            || stamp_ns - due_ns > quarter_ns
    }
}

fn no_jpeg(event: &str, bytes: usize) -> std::io::Error {
    std::io::Error::other(format!(
        "no JPEG {event} within {bytes} bytes; is `source.pixels` the format it writes?"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{GrayImage, ImageFormat, Luma};
    use std::io::Cursor;

    const PERIOD: Duration = Duration::from_millis(40);
    const TIMEOUT: Duration = Duration::from_secs(5);

    async fn all(format: FrameFormat, bytes: &[u8]) -> Result<Vec<Vec<u8>>, String> {
        // A buffer of a few bytes cuts every frame into many pieces.
        let input = BufReader::with_capacity(7, bytes);
        let mut frames = FrameReader::new(input, format, PERIOD, TIMEOUT);
        let mut read = Vec::new();
        while frames.wait().await.map_err(|e| e.to_string())?.is_some() {
            let mut samples = vec![0; format.frame_bytes()];
            let jpeg = frames.read(&mut samples).await.map_err(|e| e.to_string())?;
            read.push(if jpeg.is_empty() { samples } else { jpeg });
        }
        Ok(read)
    }

    #[tokio::test]
    async fn rows_are_read_without_their_padding() {
        let format =
            FrameFormat::Samples { row_bytes: 3, stride_bytes: 5, rows: 2, chroma_bytes: 4 };
        let frame = |v: u8| [v, v, v, 99, 99, v + 1, v + 1, v + 1, 99, 99, 1, 2, 3, 4];
        let bytes = [frame(10), frame(20)].concat();
        let expected = vec![vec![10, 10, 10, 11, 11, 11], vec![20, 20, 20, 21, 21, 21]];
        assert_eq!(all(format, &bytes).await.unwrap(), expected);
        assert!(all(format, &bytes[..20]).await.is_err(), "a cut frame");
    }

    #[tokio::test]
    async fn jpeg_files_are_separated() {
        let jpeg = |level: u8| {
            let mut bytes = Cursor::new(Vec::new());
            GrayImage::from_fn(40, 24, |x, _| Luma([level ^ (x as u8)]))
                .write_to(&mut bytes, ImageFormat::Jpeg)
                .unwrap();
            bytes.into_inner()
        };
        let (one, two) = (jpeg(3), jpeg(120));
        let bytes = [b"text\n".as_slice(), &one, b"\r\n", &two, &one].concat();
        let format = FrameFormat::Jpeg { max_bytes: 100_000 };
        assert_eq!(all(format, &bytes).await.unwrap(), vec![one.clone(), two, one.clone()]);
        assert!(all(format, &one[..one.len() - 2]).await.is_err(), "a cut frame");
        let problem = all(FrameFormat::Jpeg { max_bytes: 64 }, &[7; 500]).await.unwrap_err();
        assert!(problem.contains("`source.pixels`"), "{problem}");
    }

    /// The error of a frame of which a program writes 16 bytes in every period, so many times, and then nothing.
    async fn slowly(format: FrameFormat, bytes: [u8; 16], times: u32) -> Option<String> {
        let (mut program, output) = tokio::io::duplex(1 << 16);
        let writing = async move {
            for _ in 0..times {
                tokio::io::AsyncWriteExt::write_all(&mut program, &bytes).await.unwrap();
                tokio::time::sleep(PERIOD).await;
            }
            std::future::pending::<()>().await;
        };
        let reading = async {
            let mut frames = FrameReader::new(BufReader::new(output), format, PERIOD, 5 * PERIOD);
            frames.wait().await.unwrap().unwrap();
            frames.read(&mut vec![0; format.frame_bytes()]).await.err().map(|e| e.to_string())
        };
        tokio::select! {
            // Also on a machine that is busy, bytes are written before the time limit is checked.
            biased;
            () = writing => None,
            error = reading => error,
        }
    }

    #[tokio::test]
    async fn a_frame_times_out_only_when_nothing_arrives() {
        let samples = |stride_bytes| FrameFormat::Samples {
            row_bytes: 32,
            stride_bytes,
            rows: 5,
            chroma_bytes: 0,
        };
        let silent = std::io::Error::from(ErrorKind::TimedOut).to_string();
        for stride_bytes in [32, 64] {
            assert_eq!(slowly(samples(stride_bytes), [7; 16], 20).await, None, "all arrive");
            let error = slowly(samples(stride_bytes), [7; 16], 9).await;
            assert_eq!(error.as_ref(), Some(&silent), "half of it arrives");
        }
        // Coded data of a JPEG file that has no end, and of one that stops.
        let jpeg = FrameFormat::Jpeg { max_bytes: 100_000 };
        let mut endless = [7; 16];
        (endless[14], endless[15]) = (0xff, 0xd8);
        let error = slowly(jpeg, endless, 1).await;
        assert_eq!(error.as_ref(), Some(&silent));
    }

    #[tokio::test]
    async fn a_stream_that_has_no_jpeg_end_in_time_is_reported_as_another_format() {
        let (mut program, output) = tokio::io::duplex(1 << 16);
        let writing = async move {
            let mut bytes: &[u8] = &[0xff, 0xd8, 7, 7];
            while tokio::io::AsyncWriteExt::write_all(&mut program, bytes).await.is_ok() {
                bytes = &[7; 64];
                tokio::time::sleep(PERIOD).await;
            }
        };
        let reading = async {
            let format = FrameFormat::Jpeg { max_bytes: 1 << 20 };
            let mut frames = FrameReader::new(BufReader::new(output), format, PERIOD, 5 * PERIOD);
            frames.wait().await.unwrap().unwrap();
            frames.read(&mut []).await.unwrap_err().to_string()
        };
        let error = tokio::select! {
            () = writing => panic!("the reader has ended"),
            error = reading => error,
        };
        assert!(
            error.contains("no JPEG end within") && error.contains("`source.pixels`"),
            "{error}"
        );
    }

    #[tokio::test]
    async fn a_stream_in_another_format_is_refused_by_its_first_bytes() {
        let samples =
            FrameFormat::Samples { row_bytes: 4, stride_bytes: 4, rows: 2, chroma_bytes: 0 };
        let jpeg = FrameFormat::Jpeg { max_bytes: 1000 };
        let h264 = [0, 0, 0, 1, 0x67, 0x64, 0, 0x1f];
        for (format, bytes, found) in [
            (samples, [0xff, 0xd8, 0xff, 0xe0, 0, 16, b'J', b'F'], "it writes JPEG files"),
            (samples, h264, "it writes H.264"),
            (jpeg, h264, "it writes H.264"),
        ] {
            let mut frames = FrameReader::new(&bytes[..], format, PERIOD, TIMEOUT);
            let error = frames.wait().await.unwrap_err().to_string();
            assert!(error.contains(found) && error.contains("`source.pixels`"), "{error}");
        }
        let dark = [0, 0, 0, 1, 0, 0, 0, 1];
        assert_eq!(all(samples, &dark).await.unwrap(), [dark]);
    }

    #[test]
    fn frames_at_twice_the_configured_rate_are_noticed_once() {
        let noticed = |rate_hz: u32, burst: u32| {
            let (began, mut rate) = (Instant::now(), Rate::of(30.0));
            let at = |number: u32| began + Duration::from_secs(1) * number / rate_hz;
            let early = (0..burst).filter_map(|_| rate.add(began)).count();
            early + (0..rate_hz * 5).filter_map(|number| rate.add(at(number))).count()
        };
        assert_eq!([30, 45, 60, 90].map(|rate_hz| noticed(rate_hz, 0)), [0, 0, 1, 1]);
        assert_eq!(noticed(30, 1000), 0, "a burst");
    }

    #[test]
    fn queued_frames_are_recognised() {
        const MS: i64 = 1_000_000;
        let was_queued = |since_previous_ms, waited_ms| {
            let mut queue = Queue::of(PERIOD);
            assert!(!queue.has_held(0, 0), "the first one");
            queue.has_held(since_previous_ms * MS, waited_ms * MS)
        };
        assert!(!was_queued(40, 35), "the read waited for it");
        assert!(!was_queued(200, 195), "the camera paused");
        assert!(!was_queued(30, 0), "a little early, and already there");
        assert!(!was_queued(45, 0), "due, and already there");
        assert!(was_queued(9, 6), "sooner than a camera can");
        assert!(was_queued(70, 0), "there since some time between 40 and 70 ms");
    }
    /// The largest age of the frames that were not queued, and their number, of 500 frames of a camera that are read by a
    /// reader that needs so long for each that is not queued.
    fn read_slowly(period: Duration, needed: Duration) -> (Duration, usize) {
        let ns = |time: Duration| time.as_nanos() as i64;
        let mut queue = Queue::of(PERIOD);
        let (mut free_ns, mut oldest_ns, mut fresh) = (0, 0, 0);
        for number in 0..500 {
            let arrival_ns = number * ns(period);
            let stamp_ns = arrival_ns.max(free_ns);
            if queue.has_held(stamp_ns, stamp_ns - free_ns) {
                free_ns = stamp_ns + ns(Duration::from_millis(2));
                continue;
            }
            free_ns = stamp_ns + ns(needed);
            oldest_ns = oldest_ns.max(stamp_ns - arrival_ns);
            fresh += 1;
        }
        (Duration::from_nanos(oldest_ns as u64), fresh)
    }

    #[test]
    fn frames_that_are_written_over_the_whole_period_are_fresh_also_when_it_is_longer_than_configured()
     {
        let (made_ns, needed_ns) = (1_000_000_000_000 / 29_970, 5_000_000);
        let mut queue = Queue::of(Duration::from_secs_f64(1.0 / 30.0));
        let mut stamp_ns = 0;
        for number in 1..=2000 {
            assert!(!queue.has_held(stamp_ns, 0), "frame {number}");
            // Its last byte comes with the first of the next one.
            let ended_ns = number * made_ns;
            queue.has_read(Waiting { total_ns: ended_ns - stamp_ns, ended_ns });
            stamp_ns = ended_ns + needed_ns;
        }
    }

    #[tokio::test]
    async fn a_program_that_writes_all_the_time_and_is_a_little_slow_loses_no_frames() {
        let format =
            FrameFormat::Samples { row_bytes: 64, stride_bytes: 64, rows: 8, chroma_bytes: 0 };
        let (mut program, output) = tokio::io::duplex(1 << 16);
        let writing = async move {
            // No frame begins with a write: eight of these take 44 ms or more.
            let mut bytes = 32;
            while tokio::io::AsyncWriteExt::write_all(&mut program, &[0; 64][..bytes]).await.is_ok()
            {
                bytes = 64;
                tokio::time::sleep(Duration::from_micros(5500)).await;
            }
        };
        let reading = async {
            let input = BufReader::with_capacity(BUFFER_BYTES, output);
            let mut frames = FrameReader::new(input, format, PERIOD, TIMEOUT);
            let mut queued = 0;
            for _ in 0..20 {
                queued += u32::from(frames.wait().await.unwrap().unwrap().was_queued);
                frames.read(&mut [0; 8 * 64]).await.unwrap();
            }
            queued
        };
        let queued = tokio::select! {
            () = writing => panic!("the reader has ended"),
            queued = reading => queued,
        };
        // A busy machine may hold a few.
        assert!(queued <= 5, "{queued} of 20");
    }

    #[test]
    fn frames_of_a_slightly_slow_reader_do_not_grow_old() {
        for needed_ms in [39, 41, 45, 49, 55, 81, 130] {
            let (oldest, fresh) = read_slowly(PERIOD, Duration::from_millis(needed_ms));
            assert!(oldest <= PERIOD / 4, "{needed_ms} ms for a frame: {oldest:?} old");
            // Of every two that a frame's time covers one is fresh.
            let all = 500 * 40 / needed_ms.max(40) as usize;
            assert!(fresh > all * 3 / 5, "{needed_ms} ms for a frame: {fresh} of {all}");
        }
        // Of a camera that is a little slower than configured, for a reader that is quick enough.
        let (oldest, fresh) = read_slowly(PERIOD + PERIOD / 50, PERIOD);
        assert!(oldest.is_zero() && fresh == 500, "{oldest:?}, {fresh} frames");
    }
}
