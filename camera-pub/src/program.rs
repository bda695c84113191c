//! A camera that another program reads: pictures from its standard output, each with the time at which it came.
//!
//! So any camera can be used for which there is a program that writes its pictures, and none of their libraries is
//! needed here: `rpicam-vid`, `ffmpeg`, `gst-launch-1.0`.

use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, anyhow, bail};
use node::now_ns;
use tokio::io::{AsyncBufRead, AsyncBufReadExt, AsyncReadExt, BufReader};
use tokio::process::{Child, ChildStdout, Command};
use tokio::time::timeout;

use crate::config::ProgramConfig;
use crate::image::jpeg_len;

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
    period: Duration,
    /// When the one before this came, and when it had been read.
    before_ns: Option<(i64, i64)>,
    count: u64,
}

impl<R: AsyncBufRead + Unpin> Pictures<R> {
    fn new(input: R, form: Form, period: Duration) -> Self {
        Self { input, form, period, before_ns: None, count: 0 }
    }

    /// Waits for the first byte of a picture; `None` at the end.
    async fn wait(&mut self) -> std::io::Result<Option<Arrival>> {
        let asked_ns = now_ns();
        if self.input.fill_buf().await?.is_empty() {
            return Ok(None);
        }
        let stamp_ns = now_ns();
        // What comes sooner than a camera can is from a queue. What was there when it was asked for may have come at any
        // time since the last one was read.
        let soon_ns = self.period.as_nanos() as i64 / 2;
        let has_waited = self.before_ns.is_some_and(|(came_ns, read_ns)| {
            let was_there = stamp_ns - asked_ns < WAKE_UP_NS;
            stamp_ns - came_ns < soon_ns || (was_there && asked_ns - read_ns > soon_ns)
        });
        self.before_ns = Some((stamp_ns, stamp_ns));
        Ok(Some(Arrival { stamp_ns, has_waited }))
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
        if let Some((_, read_ns)) = &mut self.before_ns {
            *read_ns = now_ns();
        }
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

    /// Reads up to the end marker, beginning at the next start marker.
    async fn read_jpeg(&mut self, most_bytes: usize) -> std::io::Result<Vec<u8>> {
        let mut jpeg = Vec::new();
        loop {
            let there = self.input.fill_buf().await?;
            if there.is_empty() {
                return Err(std::io::ErrorKind::UnexpectedEof.into());
            }
            let before = jpeg.len();
            jpeg.extend_from_slice(there);
            let read = there.len();
            let start = jpeg.windows(3).position(|bytes| bytes == [0xff, 0xd8, 0xff]);
            let len = start.and_then(|start| Some(start + jpeg_len(jpeg.get(start..)?)?));
            self.input.consume(len.map_or(read, |len| len.saturating_sub(before)));
            match (start, len) {
                (Some(start), Some(len)) => {
                    jpeg.truncate(len);
                    jpeg.drain(..start);
                    return Ok(jpeg);
                }
                _ if jpeg.len() > most_bytes => {
                    return Err(std::io::Error::other(format!(
                        "no JPEG ends within {most_bytes} bytes; does it write what `source.pixels` says?"
                    )));
                }
                _ => {}
            }
        }
    }
}

/// What was there already is given within this time.
const WAKE_UP_NS: i64 = 200_000;

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{GrayImage, ImageFormat, Luma};
    use std::io::Cursor;
    use tokio::io::{AsyncWriteExt, duplex};

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

    #[tokio::test]
    async fn pictures_that_have_waited_are_known() {
        let (mut camera, output) = duplex(1 << 16);
        let form = Form::Samples { row: (4, 4), rows: 1, rest: 0 };
        let mut pictures = Pictures::new(BufReader::new(output), form, PERIOD);
        let mut next = async || {
            let arrival = pictures.wait().await.unwrap().unwrap();
            pictures.read(&mut [0; 4]).await.unwrap();
            arrival.has_waited
        };
        camera.write_all(&[0; 4]).await.unwrap();
        assert!(!next().await, "the first one");
        let (has_waited, ()) = tokio::join!(next(), async {
            tokio::time::sleep(PERIOD).await;
            camera.write_all(&[0; 4]).await.unwrap();
        });
        assert!(!has_waited, "it came while it was waited for");
        // Three at once, while nobody reads.
        camera.write_all(&[0; 12]).await.unwrap();
        tokio::time::sleep(PERIOD).await;
        assert_eq!([next().await, next().await, next().await], [true; 3]);
        let (has_waited, ()) = tokio::join!(next(), async {
            tokio::time::sleep(PERIOD).await;
            camera.write_all(&[0; 4]).await.unwrap();
        });
        assert!(!has_waited, "it came while it was waited for again");
    }
}
