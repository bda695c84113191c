//! A camera that another program reads: pictures from its standard output, each with the time at which it came.
//!
//! So any camera can be used for which there is a program that writes its pictures, and none of their libraries is
//! needed here: `rpicam-vid`, `ffmpeg`, `gst-launch-1.0`.

use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use media::jpeg_len;
use node::now_ns;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncReadExt, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::time::timeout;

use crate::config::ProgramConfig;

/// Bytes that are read ahead, as many as a pipe of Linux holds.
const READ_AHEAD: usize = 1 << 16;
/// Time in which a program that has closed its output is expected to end.
const END: Duration = Duration::from_secs(1);

/// How a program writes a picture.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum Form {
    /// Rows of samples of one or two bytes.
    Samples {
        /// Bytes of a row's samples, and those with what fills it up.
        row: (usize, usize),
        /// Rows.
        rows: usize,
        /// Bytes after the rows: colours.
        rest: usize,
    },
    /// A JPEG file of at most so many bytes.
    Jpeg { most_bytes: usize },
}

impl Form {
    /// Bytes of the picture in memory.
    pub(crate) fn frame_bytes(self) -> usize {
        match self {
            Self::Samples { row: (bytes, _), rows, .. } => bytes * rows,
            Self::Jpeg { .. } => 0,
        }
    }
}

/// A running program and the pictures that it writes.
pub(crate) struct Program {
    name: String,
    silence: Duration,
    child: Child,
    pictures: Pictures<BufReader<ChildStdout>>,
}

impl Program {
    /// Starts the program.
    pub(crate) fn start(config: &ProgramConfig) -> anyhow::Result<Self> {
        let (program, arguments) =
            config.command.split_first().context("`source.command` names no program")?;
        let name = program.clone();
        let mut child = Command::new(program)
            .args(arguments)
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| {
                format!(
                    "starting `{name}`, the camera's program in `source.command`; is it installed?"
                )
            })?;
        let output = child.stdout.take().with_context(|| format!("`{name}` has no output"))?;
        let input = BufReader::with_capacity(READ_AHEAD, output);
        let period = Duration::from_secs_f64(1.0 / config.rate_hz);
        let pictures = Pictures::new(input, config.form, period);
        Ok(Self { name, silence: config.silence, child, pictures })
    }

    /// Waits for the next picture.
    ///
    /// # Errors
    /// When the program is silent, ends, or writes what is no picture.
    pub(crate) async fn wait(&mut self) -> anyhow::Result<Arrival> {
        let Self { name, silence, .. } = self;
        match timeout(*silence, self.pictures.wait()).await {
            Ok(Ok(Some(arrival))) => Ok(arrival),
            Ok(Ok(None)) => Err(self.end().await),
            Ok(Err(cause)) => Err(anyhow!("reading pictures from `{name}`: {cause}")),
            Err(_elapsed) => bail!(
                "no picture came from `{name}` for {:.1} s (`source.silence_s`); is the camera connected, and used by \
                 nobody else?",
                silence.as_secs_f64()
            ),
        }
    }

    /// Reads the picture that has arrived: samples into `samples`, of [`Form::frame_bytes`]; a JPEG file is returned.
    ///
    /// # Errors
    /// As [`Self::wait`].
    pub(crate) async fn read(&mut self, samples: &mut [u8]) -> anyhow::Result<Vec<u8>> {
        let Self { name, silence, .. } = self;
        match timeout(*silence, self.pictures.read(samples)).await {
            Ok(Ok(jpeg)) => Ok(jpeg),
            Ok(Err(cause)) if cause.kind() == std::io::ErrorKind::UnexpectedEof => {
                Err(self.end().await.context("its last picture is not whole"))
            }
            Ok(Err(cause)) => Err(anyhow!("reading a picture from `{name}`: {cause}")),
            Err(_elapsed) => bail!(
                "`{name}` stopped in the middle of a picture for {:.1} s (`source.silence_s`)",
                silence.as_secs_f64()
            ),
        }
    }

    /// Says how the program ended.
    async fn end(&mut self) -> anyhow::Error {
        let pictures = self.pictures.count;
        let how = match timeout(END, self.child.wait()).await {
            Ok(Ok(status)) => format!("ended ({status})"),
            _ => "closed its output".to_owned(),
        };
        anyhow!(
            "the camera's program `{}` {how} after {pictures} pictures; its own words stand above",
            self.name
        )
    }
}

/// A picture that begins to come.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Arrival {
    /// When its first byte came, in nanoseconds of the host's clock.
    pub(crate) stamp_ns: i64,
    /// True when it has waited somewhere, so that its age is not known.
    pub(crate) has_waited: bool,
}

/// Pictures one after the other from a stream of bytes.
struct Pictures<R> {
    input: R,
    form: Form,
    /// From picture to picture.
    period_ns: i64,
    /// When the one before this came.
    before_ns: Option<i64>,
    count: u64,
}

impl<R: AsyncBufRead + Unpin> Pictures<R> {
    fn new(input: R, form: Form, period: Duration) -> Self {
        let period_ns = period.as_nanos().try_into().unwrap_or(i64::MAX);
        Self { input, form, period_ns, before_ns: None, count: 0 }
    }

    /// Waits for the first byte of a picture; `None` at the end.
    async fn wait(&mut self) -> std::io::Result<Option<Arrival>> {
        let asked_ns = now_ns();
        let begins = match self.form {
            Form::Samples { .. } => !self.input.fill_buf().await?.is_empty(),
            Form::Jpeg { most_bytes } => self.find_jpeg(most_bytes).await?,
        };
        if !begins {
            return Ok(None);
        }
        let stamp_ns = now_ns();
        let has_waited = self
            .before_ns
            .is_some_and(|before_ns| has_waited(before_ns, asked_ns, stamp_ns, self.period_ns));
        self.before_ns = Some(stamp_ns);
        Ok(Some(Arrival { stamp_ns, has_waited }))
    }

    /// Passes over what stands before the next start marker, and its first byte; false at the end.
    async fn find_jpeg(&mut self, most_bytes: usize) -> std::io::Result<bool> {
        let mut passed = 0;
        let mut follows_ff = false;
        loop {
            let there = self.input.fill_buf().await?;
            match there {
                [] => return Ok(false),
                [0xd8, ..] if follows_ff => return Ok(true),
                _ => {}
            }
            let next = there.iter().position(|byte| *byte == 0xff);
            follows_ff = next.is_some();
            let taken = next.map_or(there.len(), |at| at + 1);
            self.input.consume(taken);
            passed += taken;
            if passed > most_bytes {
                return Err(no_jpeg("begins", most_bytes));
            }
        }
    }

    async fn read(&mut self, samples: &mut [u8]) -> std::io::Result<Vec<u8>> {
        let jpeg = match self.form {
            Form::Samples { row: (bytes, with_fill), rows: _, rest } => {
                for row in samples.chunks_exact_mut(bytes.max(1)) {
                    self.input.read_exact(row).await?;
                    self.skip(with_fill - bytes).await?;
                }
                self.skip(rest).await?;
                Vec::new()
            }
            Form::Jpeg { most_bytes } => self.read_jpeg(most_bytes).await?,
        };
        self.count += 1;
        Ok(jpeg)
    }

    async fn skip(&mut self, bytes: usize) -> std::io::Result<()> {
        let mut left = bytes;
        while left > 0 {
            let there = self.input.fill_buf().await?.len();
            if there == 0 {
                return Err(std::io::ErrorKind::UnexpectedEof.into());
            }
            let taken = there.min(left);
            self.input.consume(taken);
            left -= taken;
        }
        Ok(())
    }

    /// Reads up to the end marker, from the second byte on.
    async fn read_jpeg(&mut self, most_bytes: usize) -> std::io::Result<Vec<u8>> {
        let mut jpeg = vec![0xff];
        loop {
            let there = self.input.fill_buf().await?;
            if there.is_empty() {
                return Err(std::io::ErrorKind::UnexpectedEof.into());
            }
            let (before, read) = (jpeg.len(), there.len());
            jpeg.extend_from_slice(there);
            let len = jpeg_len(&jpeg);
            self.input.consume(len.map_or(read, |len| len.saturating_sub(before)));
            if let Some(len) = len {
                jpeg.truncate(len);
                return Ok(jpeg);
            }
            if jpeg.len() > most_bytes {
                return Err(no_jpeg("ends", most_bytes));
            }
        }
    }
}

/// What is there when it is asked for is given within this time, in nanoseconds.
const AT_ONCE_NS: i64 = 200_000;

/// True for a picture that comes sooner after the one before than a camera can, which is from a queue; and for one that was
/// there when it was asked for, later than it was due: it may have come at any time since then.
fn has_waited(before_ns: i64, asked_ns: i64, stamp_ns: i64, period_ns: i64) -> bool {
    let quarter_ns = period_ns / 4;
    let since_ns = stamp_ns - before_ns;
    let was_there = stamp_ns - asked_ns < AT_ONCE_NS;
    since_ns < quarter_ns || (was_there && since_ns > period_ns.saturating_add(quarter_ns))
}

fn no_jpeg(what: &str, most_bytes: usize) -> std::io::Error {
    std::io::Error::other(format!(
        "no JPEG {what} within {most_bytes} bytes; does it write what `source.pixels` says?"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{GrayImage, ImageFormat, Luma};
    use std::io::Cursor;
    const PERIOD: Duration = Duration::from_millis(40);

    async fn all(form: Form, bytes: &[u8]) -> Result<Vec<Vec<u8>>, String> {
        // A buffer of a few bytes makes every picture come in many pieces.
        let input = BufReader::with_capacity(7, bytes);
        let mut pictures = Pictures::new(input, form, PERIOD);
        let mut read = Vec::new();
        while pictures.wait().await.map_err(|e| e.to_string())?.is_some() {
            let mut samples = vec![0; form.frame_bytes()];
            let jpeg = pictures.read(&mut samples).await.map_err(|e| e.to_string())?;
            read.push(if jpeg.is_empty() { samples } else { jpeg });
        }
        Ok(read)
    }

    #[tokio::test]
    async fn rows_are_read_without_what_fills_them_up() {
        let form = Form::Samples { row: (3, 5), rows: 2, rest: 4 };
        let picture = |v: u8| [v, v, v, 99, 99, v + 1, v + 1, v + 1, 99, 99, 1, 2, 3, 4];
        let bytes = [picture(10), picture(20)].concat();
        let expected = vec![vec![10, 10, 10, 11, 11, 11], vec![20, 20, 20, 21, 21, 21]];
        assert_eq!(all(form, &bytes).await.unwrap(), expected);
        assert!(all(form, &bytes[..20]).await.is_err(), "a cut picture");
    }

    #[tokio::test]
    async fn jpeg_files_are_told_apart() {
        let jpeg = |level: u8| {
            let mut bytes = Cursor::new(Vec::new());
            GrayImage::from_fn(40, 24, |x, _| Luma([level ^ (x as u8)]))
                .write_to(&mut bytes, ImageFormat::Jpeg)
                .unwrap();
            bytes.into_inner()
        };
        let (one, two) = (jpeg(3), jpeg(120));
        // What stands between files is passed over.
        let bytes = [b"text\n".as_slice(), &one, b"\r\n", &two, &one].concat();
        let form = Form::Jpeg { most_bytes: 100_000 };
        assert_eq!(all(form, &bytes).await.unwrap(), vec![one.clone(), two, one.clone()]);
        assert!(all(form, &one[..one.len() - 2]).await.is_err(), "a cut picture");
        let problem = all(Form::Jpeg { most_bytes: 64 }, &[7; 500]).await.unwrap_err();
        assert!(problem.contains("`source.pixels`"), "{problem}");
    }

    #[test]
    fn pictures_that_have_waited_are_known() {
        const MS: i64 = 1_000_000;
        let has_waited = |asked_ms, stamp_ns| has_waited(0, asked_ms * MS, stamp_ns, 40 * MS);
        assert!(!has_waited(5, 40 * MS), "it was waited for");
        assert!(!has_waited(5, 200 * MS), "the camera made a pause");
        assert!(!has_waited(30, 30 * MS), "a little early, and there at once");
        assert!(!has_waited(45, 45 * MS), "there at once, as it should be by now");
        assert!(has_waited(3, 9 * MS), "no camera is so quick");
        assert!(has_waited(70, 70 * MS), "there since some time between 40 and 70 ms");
    }
}
