//! Receives an RTSP stream by `retina`: coded pictures (H.264, JPEG) as they arrive, each with its RTP time, the camera's
//! sender report and its arrival.

use std::fmt::Display;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::str::FromStr;
use std::time::Duration;

use anyhow::{Context, anyhow, ensure};
use futures_util::StreamExt;
use node::now_ns;
use retina::client::{Credentials, Demuxed, PlayOptions, Session, SessionOptions, SetupOptions};
use retina::codec::{CodecItem, FrameFormat, VideoFrame};
use retina::rtcp::ReceivedCompoundPacket;
use retina::{NtpTimestamp, Timestamp, UNIX_EPOCH};
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;
use tokio::task::JoinHandle;
use tokio::time::timeout;

use crate::config::RtspConfig;

/// Time for all requests until a stream begins.
const OPEN_TIMEOUT: Duration = Duration::from_secs(5);
/// Number of pictures of H.264 that wait to be decoded, as each refers to others: more of them mean that the decoder is slower
/// than the camera. Of JPEG only the newest waits.
const MAX_WAITING: usize = 8;
/// Maximum size of a file with credentials, in bytes.
const MAX_CREDENTIALS: u64 = 1024;

/// How pictures are coded.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Coding {
    H264,
    Jpeg,
}

/// A picture as it came.
#[derive(Clone, Debug)]
pub(super) struct Picture {
    pub(super) bytes: Vec<u8>,
    /// Whether something before it is missing.
    pub(super) is_after_loss: bool,
    /// Number of those before it that came faster than they were taken.
    pub(super) missed: u64,
    pub(super) times: Times,
}

/// When a picture was taken and came.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct Times {
    /// The stream's own time, in nanoseconds since some instant.
    pub(super) stream_ns: i64,
    /// When its first packet arrived, in nanoseconds of the host's clock.
    pub(super) arrival_ns: i64,
    /// The newest report of the camera's clock before it.
    pub(super) report: Option<SenderReport>,
}

/// One instant of the stream by the camera's clock (RFC 3550, section 6.4.1).
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) struct SenderReport {
    pub(super) stream_ns: i64,
    /// In nanoseconds since 1970, UTC.
    pub(super) utc_ns: i64,
}

/// A stream that is open.
pub(super) struct OpenStream {
    pub(super) coding: Coding,
    /// The newest ones: a slow reader misses the oldest.
    pictures: broadcast::Receiver<Result<Picture, String>>,
    missed: u64,
    reader: JoinHandle<()>,
}

impl OpenStream {
    /// Opens the camera's stream.
    ///
    /// # Errors
    /// The camera does not answer, refuses, or has no video that can be read; the credentials cannot be read.
    pub(super) async fn open(config: &RtspConfig) -> anyhow::Result<Self> {
        let credentials = config.credentials.as_deref().map(credentials).transpose()?;
        let opening = Self::open_with(config, credentials);
        timeout(OPEN_TIMEOUT, opening).await.unwrap_or_else(|_elapsed| {
            Err(anyhow!("no answer within {:.0} s", OPEN_TIMEOUT.as_secs_f64()))
        })
    }

    async fn open_with(
        config: &RtspConfig,
        credentials: Option<Credentials>,
    ) -> anyhow::Result<Self> {
        let options = SessionOptions::default().creds(credentials).user_agent("alight".to_owned());
        let mut session = Session::describe(address(&config.url)?, options).await?;
        let coding = |name: &str| match name {
            "h264" => Some(Coding::H264),
            "jpeg" => Some(Coding::Jpeg),
            _ => None,
        };
        let streams = session.streams();
        let videos = streams.iter().filter(|stream| stream.media() == "video");
        let names: Vec<String> =
            videos.map(|stream| stream.encoding_name().to_uppercase()).collect();
        let known = streams.iter().enumerate().find_map(|(index, stream)| {
            let is_video = stream.media() == "video";
            coding(stream.encoding_name()).filter(|_| is_video).map(|coding| (index, coding))
        });
        let (index, coding) = known.with_context(|| match names.as_slice() {
            [] => "it streams no video".to_owned(),
            names => format!(
                "its video is {}; set the camera to H.264 or Motion JPEG, or read it by `source.command` with ffmpeg",
                names.join(", ")
            ),
        })?;
        session.setup(index, SetupOptions::default().frame_format(FrameFormat::SIMPLE)).await?;
        let session = session.play(PlayOptions::default()).await?.demuxed()?;
        let waiting = if coding == Coding::H264 { MAX_WAITING } else { 1 };
        let (sender, pictures) = broadcast::channel(waiting);
        let reader = tokio::spawn(receive(session, sender));
        Ok(Self { coding, pictures, missed: 0, reader })
    }

    /// The next picture, or why there are no more.
    pub(super) async fn next(&mut self) -> Result<Picture, String> {
        loop {
            match self.pictures.recv().await {
                Ok(Ok(picture)) => {
                    let missed = std::mem::take(&mut self.missed);
                    let is_after_loss = picture.is_after_loss || missed > 0;
                    return Ok(Picture { is_after_loss, missed, ..picture });
                }
                Ok(Err(problem)) => return Err(problem),
                Err(RecvError::Lagged(pictures)) => self.missed += pictures,
                Err(RecvError::Closed) => return Err("the camera ended its stream".to_owned()),
            }
        }
    }
}

impl Drop for OpenStream {
    fn drop(&mut self) {
        self.reader.abort();
    }
}

/// The address as the library has it.
fn address<T: FromStr<Err: Display>>(text: &str) -> anyhow::Result<T> {
    text.parse()
        .map_err(|problem| anyhow!("`{text}` of `source.rtsp` is not an address: {problem}"))
}

/// Passes pictures on, on a task of its own: while one is decoded the next gets the time at which it really arrives.
async fn receive(mut session: Demuxed, pictures: broadcast::Sender<Result<Picture, String>>) {
    let mut report = None;
    while let Some(item) = session.next().await {
        match item {
            Ok(CodecItem::VideoFrame(frame)) => {
                if pictures.send(Ok(picture(frame, report))).is_err() {
                    return;
                }
            }
            Ok(CodecItem::Rtcp(packet)) => report = sender_report(&packet).or(report),
            Ok(_) => {}
            Err(problem) => {
                drop(pictures.send(Err(problem.to_string())));
                return;
            }
        }
    }
}

fn picture(frame: VideoFrame, report: Option<SenderReport>) -> Picture {
    let waited_ns = frame.start_ctx().received().elapsed().as_nanos();
    let arrival_ns = now_ns().saturating_sub(waited_ns.try_into().unwrap_or(i64::MAX));
    let times = Times { stream_ns: nanoseconds(frame.timestamp()), arrival_ns, report };
    Picture { is_after_loss: frame.loss() > 0, missed: 0, times, bytes: frame.into_data() }
}

fn sender_report(packet: &ReceivedCompoundPacket) -> Option<SenderReport> {
    let stream_ns = nanoseconds(packet.rtp_timestamp()?);
    let report = packet.pkts().next()?.as_sender_report().ok()??;
    Some(SenderReport { stream_ns, utc_ns: utc_ns(report.ntp_timestamp()) })
}

fn nanoseconds(timestamp: Timestamp) -> i64 {
    let ticks = i128::from(timestamp.timestamp()) * 1_000_000_000;
    (ticks / i128::from(timestamp.clock_rate().get())) as i64
}

/// Nanoseconds since 1970 of seconds since 1900 with 32 binary places.
fn utc_ns(NtpTimestamp(since_1900): NtpTimestamp) -> i64 {
    let since_1970 = i128::from(since_1900) - i128::from(UNIX_EPOCH.0);
    ((since_1970 * 1_000_000_000) >> 32) as i64
}

/// Reads `user:password` from a file that only its owner can read.
fn credentials(path: &Path) -> anyhow::Result<Credentials> {
    let cause = || format!("reading {path:?} of `source.rtsp_credentials`");
    let file = File::open(path).with_context(cause)?;
    let about = file.metadata().with_context(cause)?;
    let mode = about.permissions().mode() & 0o777;
    ensure!(
        mode & 0o077 == 0,
        "others can read {path:?} of `source.rtsp_credentials` (its mode is {mode:03o}): chmod 600 it"
    );
    let mut text = String::new();
    file.take(MAX_CREDENTIALS).read_to_string(&mut text).with_context(cause)?;
    // Errors do not contain the credentials.
    let (username, password) =
        text.trim_end_matches(['\r', '\n']).split_once(':').with_context(|| {
            format!("{path:?} of `source.rtsp_credentials` has no line of the form user:password")
        })?;
    Ok(Credentials { username: username.to_owned(), password: password.to_owned() })
}
