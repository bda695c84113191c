//! The decoded and stamped pictures of an RTSP camera that may be lost: its stream is opened again until it
//! is back.

use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use anyhow::{Context, bail, ensure};
use imaging::GrayImage;
use media::LiveH264;
use node::now_ns;
use tokio::time::timeout;

use super::session::{Coding, OpenStream, Picture};
use super::stamps::{Stamp, StreamStamps};
use crate::config::RtspConfig;
use crate::exposure::Exposure;

/// Time between attempts to open the stream.
const RETRY: Duration = Duration::from_millis(500);
/// Time without a picture after which the camera has stalled, in addition to three periods.
const STALL_S: f64 = 1.0;
/// Time of pictures that give no frame after which the reason is logged, in nanoseconds.
const FRAMELESS_NS: i64 = 5_000_000_000;
/// Time in which a camera must send its clock, where that is configured, in seconds: most send it every five.
const CLOCK_S: f64 = 20.0;

/// A camera's stream, open or lost.
pub(crate) struct Feed {
    config: RtspConfig,
    stream: Option<OpenStream>,
    decoder: LiveH264,
    stamps: StreamStamps,
    /// Stamp of the newest picture that was delivered.
    newest_ns: i64,
    /// Since when there are no pictures, and why.
    outage: Option<(i64, String)>,
    /// Pictures in a row whose time is not known.
    unknown: u32,
    /// Pictures that came faster than they were taken.
    missed: u64,
    /// How long the last picture took to decode.
    decoding: Duration,
    frameless: Frameless,
}

/// Pictures that come and give no frame.
#[derive(Default)]
struct Frameless {
    since_ns: Option<i64>,
    is_reported: bool,
}

impl Frameless {
    /// Counts a picture without a frame; true when the reason is to be logged, which is once.
    fn add(&mut self, now_ns: i64) -> bool {
        let since_ns = *self.since_ns.get_or_insert(now_ns);
        let is_due = now_ns - since_ns >= FRAMELESS_NS && !self.is_reported;
        self.is_reported |= is_due;
        is_due
    }

    /// A frame has come.
    fn end(&mut self) {
        self.since_ns = None;
    }
}

/// The next event.
pub(crate) enum Next {
    /// A picture and the time at which it was taken. This is an estimate, as RTSP carries no exposure time.
    Frame(Image, Exposure),
    /// A picture that is not delivered, and why.
    Dropped(&'static str),
    /// The camera has just been lost, for a reason that is counted.
    Lost(&'static str),
    /// The camera is still lost.
    Nothing,
}

/// A picture.
pub(crate) enum Image {
    /// A JPEG file.
    Jpeg(Vec<u8>),
    /// Decoded.
    Grey(GrayImage),
}

impl Feed {
    /// Opens the stream.
    ///
    /// # Errors
    /// The camera does not answer, or has no stream that can be read.
    pub(crate) async fn start(config: &RtspConfig) -> anyhow::Result<Self> {
        let stream = OpenStream::open(config).await.context(
            "the stream cannot be opened; try it with `ffplay -rtsp_transport tcp` and its address",
        )?;
        Ok(Self {
            stream: Some(stream),
            decoder: LiveH264::new(config.max_pixels),
            stamps: StreamStamps::new(config.stamps, config.delay_ns),
            newest_ns: i64::MIN,
            outage: None,
            unknown: 0,
            missed: 0,
            decoding: Duration::ZERO,
            frameless: Frameless::default(),
            config: config.clone(),
        })
    }

    /// The next picture, or the event instead of one.
    ///
    /// # Errors
    /// The stamps shall be of the camera's clock, and that differs from the host's or is not sent.
    pub(crate) async fn next(&mut self) -> anyhow::Result<Next> {
        let Some(stream) = &mut self.stream else { return Ok(self.reopen().await) };
        let stall_s = (3.0 / self.config.rate_hz.max(1e-3)).max(STALL_S);
        match timeout(Duration::from_secs_f64(stall_s), stream.next()).await {
            Ok(Ok(picture)) => {
                let coding = stream.coding;
                self.take(picture, coding)
            }
            Ok(Err(problem)) => Ok(self.lose("camera's stream ended", problem)),
            Err(_elapsed) => {
                let problem = format!("it has sent no picture for {stall_s:.1} s");
                Ok(self.lose("camera stalled", problem))
            }
        }
    }

    /// How many pictures came faster than they were taken since the last call.
    pub(crate) fn take_missed(&mut self) -> u64 {
        std::mem::take(&mut self.missed)
    }

    /// How long the last picture took to decode here.
    pub(crate) fn decoding(&self) -> Duration {
        self.decoding
    }

    fn take(&mut self, picture: Picture, coding: Coding) -> anyhow::Result<Next> {
        if let Some((since_ns, _)) = self.outage.take() {
            let lost_s = (now_ns() - since_ns) as f64 * 1e-9;
            tracing::info!(lost_s, "The camera is back");
        }
        self.missed += picture.missed;
        let stamp = self.stamps.stamp(&picture.times, utc_ahead_ns());
        // Also of a picture that is dropped: the next ones refer to it.
        let image = match coding {
            Coding::Jpeg => Some(Image::Jpeg(picture.bytes)),
            Coding::H264 => {
                if picture.is_after_loss {
                    self.decoder.restart();
                }
                let began = Instant::now();
                let decoded = self.decoder.decode(&picture.bytes);
                self.decoding = began.elapsed();
                match decoded {
                    Ok(Some(image)) => {
                        self.frameless.end();
                        Some(Image::Grey(image))
                    }
                    Ok(None) => {
                        if self.frameless.add(now_ns()) {
                            tracing::warn!(
                                "The camera's pictures give no frame since {} s, as none of them is a key frame (IDR): set the \
                                 camera to one each second or more often",
                                FRAMELESS_NS / 1_000_000_000
                            );
                        }
                        None
                    }
                    Err(problem) => {
                        tracing::debug!(%problem, "Waiting for the next key frame");
                        if self.frameless.add(now_ns()) {
                            tracing::warn!(
                                %problem,
                                "The camera's pictures give no frame since {} s",
                                FRAMELESS_NS / 1_000_000_000
                            );
                        }
                        return Ok(Next::Dropped("pictures that cannot be decoded"));
                    }
                }
            }
        };
        let stamp_ns = match stamp {
            Stamp::At(stamp_ns) => stamp_ns,
            Stamp::Unknown => {
                self.unknown += 1;
                ensure!(
                    f64::from(self.unknown) < CLOCK_S * self.config.rate_hz,
                    "the camera sends no times of its clock (RTCP sender reports): set `source.rtsp_stamps` to \"arrival\""
                );
                return Ok(Next::Dropped("pictures before the camera sent its clock"));
            }
            Stamp::OtherClock { age_ns } => {
                let age_s = age_ns as f64 * 1e-9;
                bail!(
                    "by the camera's clock its pictures are {age_s:.1} s old when they arrive, so that it is not this host's: \
                     set both by NTP, or `source.rtsp_stamps` to \"arrival\""
                );
            }
        };
        self.unknown = 0;
        let Some(image) = image else { return Ok(Next::Dropped("pictures before a key frame")) };
        if stamp_ns <= self.newest_ns {
            return Ok(Next::Dropped("pictures out of order, as of B-frames: switch them off"));
        }
        self.newest_ns = stamp_ns;
        Ok(Next::Frame(image, Exposure::estimated(stamp_ns)))
    }

    fn lose(&mut self, reason: &'static str, problem: String) -> Next {
        self.stream = None;
        self.decoder.restart();
        self.frameless.end();
        self.note(problem);
        Next::Lost(reason)
    }

    async fn reopen(&mut self) -> Next {
        tokio::time::sleep(RETRY).await;
        match OpenStream::open(&self.config).await {
            Ok(stream) => {
                self.stream = Some(stream);
                self.stamps.reopened();
            }
            Err(problem) => self.note(format!("{problem:#}")),
        }
        Next::Nothing
    }

    /// A repeated error is logged once.
    fn note(&mut self, problem: String) {
        let since_ns = self.outage.as_ref().map_or_else(now_ns, |(since_ns, _)| *since_ns);
        if self.outage.as_ref().is_none_or(|(_, before)| *before != problem) {
            tracing::warn!(
                problem,
                "The camera is lost; its stream is opened again until it is back"
            );
        }
        self.outage = Some((since_ns, problem));
    }
}

/// By how much UTC is more than the host's clock, in nanoseconds.
fn utc_ahead_ns() -> i64 {
    let utc = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let utc_ns: i64 = utc.as_nanos().try_into().unwrap_or(i64::MAX);
    utc_ns.saturating_sub(now_ns())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pictures_without_a_frame_are_reported_once_after_five_seconds() {
        const SECOND: i64 = 1_000_000_000;
        let mut frameless = Frameless::default();
        let reports = |frameless: &mut Frameless, from_s: i64| {
            (from_s..from_s + 10).filter(|at_s| frameless.add(at_s * SECOND)).collect::<Vec<_>>()
        };
        assert!((0..4).all(|at_s| !frameless.add(at_s * SECOND)));
        // A frame in between, as after a loss.
        frameless.end();
        assert_eq!(reports(&mut frameless, 4), [9]);
        assert!(reports(&mut frameless, 14).is_empty());
    }
}
