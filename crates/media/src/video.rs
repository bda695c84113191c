//! Reads videos frame by frame: Motion JPEG (AVI, or a bare stream of JPEG files) and H.264 (MP4, or a bare
//! stream).

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use imaging::GrayImage;
use rust_h264::decoder::{Frame, OrderedDecoder};
use rust_h264::error::DecodeError;
use rust_h264::nal::{NalUnit, parse_annex_b, parse_avcc};

use crate::boxes;
use crate::budget::{Budget, BudgetReader};
use crate::contained::contained;
use crate::cut::cut_picture;
use crate::h264::{Limits, luma};
use crate::image::{ImageError, decode_image, has_extension};
use crate::jpeg::next_jpeg;

/// File extensions of videos, including formats that are refused with advice on how to convert them.
pub const VIDEO_EXTENSIONS: &[&str] = &[
    "avi", "mjpeg", "mjpg", "mp4", "m4v", "mov", "h264", "264", "mkv", "webm", "wmv", "mpg",
    "mpeg", "ts",
];

/// Maximum bytes of a bare stream, which is read into memory as a whole.
const MAX_STREAM_BYTES: u64 = 1 << 30;
/// Maximum bytes of one coded frame.
const MAX_FRAME_BYTES: u64 = 256 << 20;
/// Bytes of an MP4 file's tables that may be read beyond twice the file's size.
const TABLE_BYTES: u64 = 64 << 10;
/// Frame rate of streams that do not state theirs, in hertz.
const DEFAULT_RATE_HZ: f64 = 25.0;

/// Why a video or one of its frames was not read, and the remedy.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// The system does not open or read a file.
    #[error("{path:?} cannot be read: {cause}; check the path and its permissions")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// A container or codec that is not supported.
    #[error(
        "{path:?} is {kind}; supported are Motion JPEG (.avi, .mjpeg) and H.264 of 8 or 10 bits (.mp4, .mov, .h264). \
         Convert it with: ffmpeg -noautorotate -i {path:?} -c:v mjpeg -q:v 2 -an video.avi"
    )]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// Its kind.
        kind: String,
    },
    /// A file of no bytes.
    #[error("{path:?} is empty; copy or record it again")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Bytes that are not a valid video.
    #[error("{path:?} is damaged or cut short: {cause}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The error.
        cause: String,
    },
}

/// True for files with the extension of a video.
pub fn is_video(path: &Path) -> bool {
    has_extension(path, VIDEO_EXTENSIONS)
}

/// A frame of a video.
#[derive(Debug)]
pub struct VideoFrame {
    /// Number of the frame, from 0.
    pub index: u64,
    /// Time since the first frame, in seconds.
    pub time_s: f64,
    /// The image.
    pub image: VideoImage,
}

/// The image of a frame. JPEG files are decoded later, when the pixels are needed, on any thread.
#[derive(Debug)]
pub enum VideoImage {
    /// A JPEG file.
    Jpeg(Vec<u8>),
    /// Decoded to grey.
    Grey(GrayImage),
}

impl VideoImage {
    /// The image in grey; errors name `path`.
    ///
    /// # Errors
    /// When a JPEG is damaged or has more than `max_pixels`.
    pub fn grey(self, path: &Path, max_pixels: u64) -> Result<GrayImage, ImageError> {
        match self {
            Self::Jpeg(bytes) => decode_image(path, &bytes, max_pixels),
            Self::Grey(image) => Ok(image),
        }
    }
}

/// An opened video.
pub struct Video {
    path: PathBuf,
    stream: Stream,
    period_s: f64,
    next: u64,
    is_turned: bool,
}

enum Stream {
    Avi(AviReader),
    Jpegs { bytes: Vec<u8>, at: usize },
    H264(Box<H264>),
    Ended,
}

impl Video {
    /// Opens a video whose frames have at most `max_pixels`.
    ///
    /// # Errors
    /// [`VideoError`] when it cannot be read or is not supported.
    pub fn open(path: &Path, max_pixels: u64) -> Result<Self, VideoError> {
        let damaged = |cause: &str| Problems { path }.damaged(cause);
        contained(|| Self::open_unchecked(path, max_pixels), damaged)
    }

    /// As [`Video::open`]; panics where a decoder does.
    fn open_unchecked(path: &Path, max_pixels: u64) -> Result<Self, VideoError> {
        let problems = Problems { path };
        let mut file = BufReader::new(File::open(path).map_err(|e| problems.unreadable(e))?);
        let mut start = Vec::new();
        file.by_ref().take(12).read_to_end(&mut start).map_err(|e| problems.unreadable(e))?;
        file.rewind().map_err(|e| problems.unreadable(e))?;
        let mut is_turned = false;
        let (stream, period_s) = match start.as_slice() {
            [] => return Err(VideoError::Empty { path: path.to_owned() }),
            [b'R', b'I', b'F', b'F', _, _, _, _, b'A', b'V', b'I', b' '] => {
                let (reader, period_s) = AviReader::open(file, &problems)?;
                (Stream::Avi(reader), period_s)
            }
            [0xff, 0xd8, ..] => {
                let bytes = whole(file, &problems)?;
                (Stream::Jpegs { bytes, at: 0 }, 1.0 / DEFAULT_RATE_HZ)
            }
            [_, _, _, _, b'f', b't', b'y', b'p', ..] => {
                let (decoder, period_s) = H264::from_mp4(file, &problems, max_pixels)?;
                is_turned = decoder.is_turned();
                (Stream::H264(Box::new(decoder)), period_s)
            }
            [0, 0, 1, ..] | [0, 0, 0, 1, ..] if has_extension(path, &["h264", "264"]) => {
                let decoder = H264::from_stream(whole(file, &problems)?, max_pixels);
                (Stream::H264(Box::new(decoder)), 1.0 / DEFAULT_RATE_HZ)
            }
            _ => return Err(problems.unsupported("in an unknown container")),
        };
        let path = path.to_owned();
        Ok(Self { path, stream, period_s, next: 0, is_turned })
    }

    /// Whether the file asks viewers to turn or to mirror its frames, as the videos of telephones do. The frames are those of the
    /// sensor all the same.
    pub fn is_turned(&self) -> bool {
        self.is_turned
    }

    /// The next frame; `None` after the last. After an error there are no more.
    pub fn next_frame(&mut self) -> Option<Result<VideoFrame, VideoError>> {
        let problems = Problems { path: &self.path };
        let stream = &mut self.stream;
        let (index, period_s) = (self.next, self.period_s);
        self.next += 1;
        let decode = || {
            let frame = match stream {
                Stream::Avi(reader) => {
                    let image = reader.next(&problems);
                    let time_s = reader.dropped.saturating_add(index) as f64 * period_s;
                    image.map(|image| image.map(|image| (image, Some(time_s))))
                }
                Stream::Jpegs { bytes, at } => {
                    next_jpeg(bytes, at).map(|jpeg| Ok((VideoImage::Jpeg(jpeg.to_vec()), None)))
                }
                Stream::H264(decoder) => decoder.next(&problems),
                Stream::Ended => None,
            };
            frame.transpose()
        };
        let frame = contained(decode, |cause| problems.damaged(cause)).transpose();
        if !matches!(frame, Some(Ok(_))) {
            self.stream = Stream::Ended;
        }
        let timed = |(image, time_s): (VideoImage, Option<f64>)| {
            let time_s = time_s.unwrap_or(index as f64 * period_s);
            VideoFrame { index, time_s, image }
        };
        frame.map(|frame| frame.map(timed))
    }
}

/// Errors that name the file.
struct Problems<'a> {
    path: &'a Path,
}

impl Problems<'_> {
    fn unreadable(&self, cause: std::io::Error) -> VideoError {
        match cause.kind() {
            ErrorKind::UnexpectedEof => self.damaged("it ends in the middle of a chunk"),
            _ => VideoError::Unreadable { path: self.path.to_owned(), cause },
        }
    }

    fn unsupported(&self, kind: &str) -> VideoError {
        VideoError::Unsupported { path: self.path.to_owned(), kind: kind.to_owned() }
    }

    fn undecoded(&self, cause: &DecodeError) -> VideoError {
        match cause {
            DecodeError::Unsupported(kind) => self.unsupported(&format!("H.264 with {kind}")),
            _ => self.damaged(cause),
        }
    }

    fn damaged(&self, cause: impl std::fmt::Display) -> VideoError {
        VideoError::Damaged { path: self.path.to_owned(), cause: cause.to_string() }
    }
}

fn whole(file: BufReader<File>, problems: &Problems<'_>) -> Result<Vec<u8>, VideoError> {
    let mut bytes = Vec::new();
    file.take(MAX_STREAM_BYTES).read_to_end(&mut bytes).map_err(|e| problems.unreadable(e))?;
    if bytes.len() as u64 == MAX_STREAM_BYTES {
        return Err(problems.unsupported("a bare stream of more than 1 GiB"));
    }
    Ok(bytes)
}

/// Reads the frames of the first video stream of an AVI file (RIFF).
struct AviReader {
    file: BufReader<File>,
    /// Ids of the stream's chunks, compressed and uncompressed.
    ids: [[u8; 4]; 2],
    /// Width and height of raw grey frames; `None` for frames that are JPEG files.
    grey: Option<[usize; 2]>,
    /// Frames that were left out so far.
    dropped: u64,
}

/// A chunk among the frames.
enum AviChunk {
    Frame(Vec<u8>),
    Other,
    End,
}

/// The contents of the header.
#[derive(Default)]
struct AviHeader {
    period_us: u32,
    streams: u32,
    video: Option<AviStream>,
    /// Whether the last stream header was that of a video.
    is_video: bool,
}

/// The first video stream.
struct AviStream {
    number: u32,
    codec: [u8; 4],
    width: i32,
    /// Negative for rows from top to bottom.
    height: i32,
}

impl AviReader {
    fn open(mut file: BufReader<File>, problems: &Problems<'_>) -> Result<(Self, f64), VideoError> {
        let mut header = AviHeader::default();
        file.seek(SeekFrom::Start(12)).map_err(|e| problems.unreadable(e))?;
        loop {
            let Some((id, len)) = chunk(&mut file).map_err(|e| problems.unreadable(e))? else {
                return Err(problems.damaged("it has no frames"));
            };
            if id == *b"LIST" {
                let mut kind = [0; 4];
                file.read_exact(&mut kind).map_err(|e| problems.unreadable(e))?;
                match &kind {
                    b"movi" => break,
                    // These lists are entered: their parts are chunks.
                    b"hdrl" | b"strl" => {}
                    _ => skip(&mut file, u64::from(len).saturating_sub(4), len)
                        .map_err(|e| problems.unreadable(e))?,
                }
                continue;
            }
            let known = u64::from(len).min(64);
            let mut body = Vec::new();
            file.by_ref().take(known).read_to_end(&mut body).map_err(|e| problems.unreadable(e))?;
            skip(&mut file, u64::from(len) - known, len).map_err(|e| problems.unreadable(e))?;
            header.take(id, &body);
        }
        let Some(AviStream { number, codec, width, height }) = header.video else {
            return Err(problems.unsupported("an AVI file without video"));
        };
        let grey = match &codec.map(|c| c.to_ascii_uppercase()) {
            b"MJPG" | b"JPEG" | b"AVRN" | b"LJPG" => None,
            b"Y800" | b"GREY" | b"Y8  " if width > 0 => {
                Some([width as usize, height.unsigned_abs() as usize])
            }
            _ => {
                let codec = String::from_utf8_lossy(&codec).into_owned();
                return Err(problems.unsupported(&format!("an AVI file coded as {codec:?}")));
            }
        };
        let digits = [number / 10 % 10, number % 10].map(|digit| b'0' + digit as u8);
        let ids = [*b"dc", *b"db"].map(|kind| [digits[0], digits[1], kind[0], kind[1]]);
        let period_s = match header.period_us {
            0 => 1.0 / DEFAULT_RATE_HZ,
            micros => f64::from(micros) * 1e-6,
        };
        Ok((Self { file, ids, grey, dropped: 0 }, period_s))
    }

    fn next(&mut self, problems: &Problems<'_>) -> Option<Result<VideoImage, VideoError>> {
        loop {
            match self.next_chunk() {
                Ok(AviChunk::Frame(bytes)) => match self.grey {
                    None => return Some(Ok(VideoImage::Jpeg(bytes))),
                    Some([width, height]) => return grey_image(&bytes, width, height).map(Ok),
                },
                Ok(AviChunk::Other) => {}
                Ok(AviChunk::End) => return None,
                Err(cause) => return Some(Err(problems.unreadable(cause))),
            }
        }
    }

    fn next_chunk(&mut self) -> std::io::Result<AviChunk> {
        let Some((id, len)) = chunk(&mut self.file)? else { return Ok(AviChunk::End) };
        if id == *b"LIST" || id == *b"RIFF" {
            // Groups of frames, and the further parts of files of more than 1 GiB.
            let mut kind = [0; 4];
            self.file.read_exact(&mut kind)?;
            if !matches!(&kind, b"rec " | b"movi" | b"AVIX") {
                skip(&mut self.file, u64::from(len).saturating_sub(4), len)?;
            }
            return Ok(AviChunk::Other);
        }
        // A dropped frame is an empty chunk, which has its time.
        if self.ids.contains(&id) && len == 0 {
            self.dropped += 1;
        }
        if !self.ids.contains(&id) || len == 0 || u64::from(len) > MAX_FRAME_BYTES {
            skip(&mut self.file, u64::from(len), len)?;
            return Ok(AviChunk::Other);
        }
        let mut bytes = Vec::new();
        self.file.by_ref().take(u64::from(len)).read_to_end(&mut bytes)?;
        if bytes.len() as u64 != u64::from(len) {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        skip(&mut self.file, 0, len)?;
        Ok(AviChunk::Frame(bytes))
    }
}

impl AviHeader {
    fn take(&mut self, id: [u8; 4], body: &[u8]) {
        let four = |at: usize| body.get(at..at + 4)?.try_into().ok();
        let number = |at: usize| four(at).map(i32::from_le_bytes);
        match &id {
            b"avih" => self.period_us = number(0).unwrap_or(0).max(0).unsigned_abs(),
            b"strh" => {
                self.is_video = body.starts_with(b"vids");
                self.streams += 1;
            }
            b"strf" if self.is_video && self.video.is_none() => {
                if let (Some(width), Some(height), Some(codec)) = (number(4), number(8), four(16)) {
                    let number = self.streams - 1;
                    self.video = Some(AviStream { number, codec, width, height });
                }
            }
            _ => {}
        }
    }
}

/// Id and length of the next chunk; `None` at the end of the file.
fn chunk(file: &mut impl Read) -> std::io::Result<Option<([u8; 4], u32)>> {
    let mut head = [0; 8];
    match file.read_exact(&mut head) {
        Ok(()) => {
            let [a, b, c, d, len @ ..] = head;
            Ok(Some(([a, b, c, d], u32::from_le_bytes(len))))
        }
        Err(cause) if cause.kind() == ErrorKind::UnexpectedEof => Ok(None),
        Err(cause) => Err(cause),
    }
}

/// Skips the remaining `rest` bytes of a chunk of `len` bytes, and the padding to an even address.
fn skip(file: &mut BufReader<File>, rest: u64, len: u32) -> std::io::Result<()> {
    file.seek_relative((rest + u64::from(len % 2)) as i64)
}

/// Grey pixels in rows that are padded to a multiple of four bytes.
fn grey_image(bytes: &[u8], width: usize, height: usize) -> Option<VideoImage> {
    let stride = width.next_multiple_of(4);
    if bytes.len() < stride.checked_mul(height)? {
        return None;
    }
    let mut image = GrayImage::filled(width, height, 0);
    for (y, row) in bytes.chunks_exact(stride).take(height).enumerate() {
        image.row_mut(y).copy_from_slice(row.get(..width)?);
    }
    Some(VideoImage::Grey(image))
}

/// Decodes H.264, one access unit after the other.
struct H264 {
    decoder: OrderedDecoder,
    limits: Limits,
    source: Source,
    /// Decoded images, in order of presentation.
    ready: VecDeque<GrayImage>,
    times: Times,
    is_over: bool,
    /// Why the stream ended early, which is reported after its pictures.
    failure: Option<VideoError>,
}

/// When the pictures of an MP4 file are shown.
#[derive(Default)]
struct Times {
    /// Of those that are not out yet, in ticks.
    waiting: BinaryHeap<Reverse<i64>>,
    first: Option<i64>,
    ticks_per_s: f64,
}

impl Times {
    /// Notes the time of a picture that is decoded, in any order.
    fn add(&mut self, sample: &mp4::Mp4Sample) {
        let start = i64::try_from(sample.start_time).unwrap_or(i64::MAX);
        self.waiting.push(Reverse(start.saturating_add(i64::from(sample.rendering_offset))));
    }

    /// The time of the next picture in order of presentation, since that of the first.
    fn next_s(&mut self) -> Option<f64> {
        let Reverse(shown) = self.waiting.pop()?;
        let first = *self.first.get_or_insert(shown);
        Some(shown.saturating_sub(first) as f64 / self.ticks_per_s)
    }
}

enum Source {
    Mp4 {
        reader: Box<mp4::Mp4Reader<BudgetReader<BufReader<File>>>>,
        track: u32,
        next: u32,
        length_bytes: usize,
    },
    Stream {
        bytes: Vec<u8>,
        at: usize,
    },
}

impl H264 {
    fn from_mp4(
        mut file: BufReader<File>,
        problems: &Problems<'_>,
        max_pixels: u64,
    ) -> Result<(Self, f64), VideoError> {
        let size = file.get_ref().metadata().map_err(|e| problems.unreadable(e))?.len();
        boxes::check(&mut file, size).map_err(|e| problems.damaged(e))?;
        // The tables are read about once; in a damaged file they may refer to each other for ever.
        let budget = Budget::new(size.saturating_mul(2).saturating_add(TABLE_BYTES));
        let file = BudgetReader::new(file, budget.clone());
        let reader = mp4::Mp4Reader::read_header(file, size).map_err(|e| problems.damaged(e))?;
        budget.lift();
        let is_video = |track: &&mp4::Mp4Track| {
            track.track_type().is_ok_and(|kind| kind == mp4::TrackType::Video)
        };
        let container = match &reader.major_brand().value {
            b"qt  " => "a QuickTime file",
            _ => "an MP4 file",
        };
        let Some(track) = reader.tracks().values().find(is_video) else {
            return Err(problems.unsupported(&format!("{container} without a known video track")));
        };
        let entry = &track.trak.mdia.minf.stbl.stsd;
        let Some(avc1) = &entry.avc1 else {
            let coding = match (&entry.hev1, &entry.vp09) {
                (Some(_), _) => "is H.265",
                (_, Some(_)) => "is VP9",
                _ => "is not H.264",
            };
            return Err(problems.unsupported(&format!("{container} whose video {coding}")));
        };
        // The parser reads every picture of a fragment at the beginning of that.
        if !track.trafs.is_empty() {
            return Err(problems.unsupported(&format!("{container} in fragments")));
        }
        let (mut decoder, mut limits) = (OrderedDecoder::new(), Limits::new(max_pixels));
        let parameters =
            avc1.avcc.sequence_parameter_sets.iter().chain(&avc1.avcc.picture_parameter_sets);
        for parameter in parameters {
            let bytes = [&[0, 0, 1], parameter.bytes.as_slice()].concat();
            for unit in parse_annex_b(&bytes) {
                check(&mut limits, &unit, problems)?;
                decoder.decode_nal(&unit).map_err(|e| problems.undecoded(&e))?;
            }
        }
        let ticks_per_s = f64::from(track.timescale().max(1));
        let times = Times { ticks_per_s, ..Times::default() };
        let seconds = track.duration().as_secs_f64() / f64::from(track.sample_count().max(1));
        let period_s = if seconds > 0.0 { seconds } else { 1.0 / DEFAULT_RATE_HZ };
        let length_bytes = usize::from(avc1.avcc.length_size_minus_one & 3) + 1;
        let track = track.track_id();
        let source = Source::Mp4 { reader: Box::new(reader), track, next: 1, length_bytes };
        let ready = VecDeque::new();
        Ok((
            Self { decoder, limits, source, ready, times, is_over: false, failure: None },
            period_s,
        ))
    }

    fn from_stream(bytes: Vec<u8>, max_pixels: u64) -> Self {
        let source = Source::Stream { bytes, at: 0 };
        let (decoder, limits) = (OrderedDecoder::new(), Limits::new(max_pixels));
        let (ready, times) = (VecDeque::new(), Times::default());
        Self { decoder, limits, source, ready, times, is_over: false, failure: None }
    }

    /// Whether the track's header has a rotation for viewers (ISO/IEC 14496-12, 8.3.2): a matrix other than a scale.
    fn is_turned(&self) -> bool {
        let Source::Mp4 { reader, track, .. } = &self.source else { return false };
        reader.tracks().get(track).is_some_and(|track| {
            let matrix = &track.trak.tkhd.matrix;
            matrix.a < 0 || matrix.d < 0 || matrix.b != 0 || matrix.c != 0
        })
    }

    /// The next picture, and its time where the file gives it.
    fn next(
        &mut self,
        problems: &Problems<'_>,
    ) -> Option<Result<(VideoImage, Option<f64>), VideoError>> {
        while self.ready.is_empty() && !self.is_over {
            self.decode_more(problems);
        }
        match self.ready.pop_front() {
            Some(image) => Some(Ok((VideoImage::Grey(image), self.times.next_s()))),
            None => self.failure.take().map(Err),
        }
    }

    fn decode_more(&mut self, problems: &Problems<'_>) {
        let mut frames = Vec::new();
        if let Err(failure) = self.decode_sample(&mut frames, problems) {
            self.is_over = true;
            self.failure = Some(failure);
        }
        if self.is_over {
            let mut last = self.decoder.flush();
            if let (Source::Stream { bytes, .. }, None) = (&self.source, &self.failure)
                && let Some(cut) = cut_picture(bytes, &last, self.limits.max_pixels())
            {
                last.remove(cut);
                self.failure = Some(problems.damaged("bytes are missing in its last picture"));
            }
            frames.extend(last);
        }
        for frame in frames {
            match luma(&frame) {
                Ok(image) => self.ready.push_back(image),
                Err(failure) => {
                    self.is_over = true;
                    self.failure = Some(problems.damaged(failure));
                    break;
                }
            }
        }
    }

    /// Decodes the next picture's units; adds the pictures that are complete then to `frames`.
    fn decode_sample(
        &mut self,
        frames: &mut Vec<Frame>,
        problems: &Problems<'_>,
    ) -> Result<(), VideoError> {
        let decode = |unit: &NalUnit<'_>| {
            check(&mut self.limits, unit, problems)?;
            frames.extend(self.decoder.decode_nal(unit).map_err(|e| problems.undecoded(&e))?);
            Ok(())
        };
        match &mut self.source {
            Source::Mp4 { reader, track, next, length_bytes } => {
                let sample = reader.read_sample(*track, *next).map_err(|e| problems.damaged(e))?;
                *next += 1;
                match sample {
                    Some(sample) => {
                        parse_avcc(&sample.bytes, *length_bytes).iter().try_for_each(decode)?;
                        self.times.add(&sample);
                    }
                    None => self.is_over = true,
                }
            }
            Source::Stream { bytes, at } => match next_unit(bytes, at) {
                Some(unit) => parse_annex_b(unit).iter().try_for_each(decode)?,
                None => self.is_over = true,
            },
        }
        Ok(())
    }
}

/// The bytes from one start code to the next.
fn next_unit<'a>(bytes: &'a [u8], at: &mut usize) -> Option<&'a [u8]> {
    let rest = bytes.get(*at..).filter(|rest| !rest.is_empty())?;
    let is_start = |w: &[u8]| w == [0, 0, 1];
    let len = rest.get(3..)?.windows(3).position(is_start).map_or(rest.len(), |next| next + 3);
    *at += len;
    rest.get(..len)
}

/// Refuses videos for which the decoder would allocate too much memory.
fn check(
    limits: &mut Limits,
    unit: &NalUnit<'_>,
    problems: &Problems<'_>,
) -> Result<(), VideoError> {
    let excess = limits.excess(unit);
    excess.map_or(Ok(()), |it| Err(problems.unsupported(&format!("a video of {it}"))))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{ImageFormat, Luma};
    use std::io::Cursor;

    const MAX_PIXELS: u64 = 1_000_000;

    fn jpeg(level: u8) -> Vec<u8> {
        let image = ::image::GrayImage::from_pixel(16, 8, Luma([level]));
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, ImageFormat::Jpeg).unwrap();
        bytes.into_inner()
    }

    fn chunk_of(id: &[u8; 4], body: &[u8]) -> Vec<u8> {
        let mut bytes = [&id[..], &(body.len() as u32).to_le_bytes(), body].concat();
        if body.len() % 2 == 1 {
            bytes.push(0);
        }
        bytes
    }

    /// An AVI file of 20 frames a second, with sound, a dropped frame and an index.
    fn avi(codec: &[u8; 4], frames: &[Vec<u8>]) -> Vec<u8> {
        let format =
            [&[40, 0, 0, 0, 16, 0, 0, 0, 8, 0, 0, 0, 1, 0, 8, 0][..], codec, &[0; 20]].concat();
        let video = [chunk_of(b"strh", b"vids0123456789"), chunk_of(b"strf", &format)].concat();
        let sound = [chunk_of(b"strh", b"auds0123"), chunk_of(b"strf", &[0; 18])].concat();
        let list = |kind: &[u8; 4], body: &[u8]| chunk_of(b"LIST", &[&kind[..], body].concat());
        let header = [
            chunk_of(b"avih", &50_000_u32.to_le_bytes()),
            list(b"strl", &sound),
            list(b"strl", &video),
        ];
        let mut movie = chunk_of(b"00wb", &[1, 2, 3]);
        for frame in frames {
            movie.extend(list(b"rec ", &chunk_of(b"01dc", frame)));
            movie.extend(chunk_of(b"01dc", &[]));
        }
        let parts =
            [list(b"hdrl", &header.concat()), chunk_of(b"JUNK", &[7; 99]), list(b"movi", &movie)];
        let body = [&b"AVI "[..], &parts.concat(), &chunk_of(b"idx1", &[0; 16])].concat();
        chunk_of(b"RIFF", &body)
    }

    fn levels(name: &str, bytes: &[u8]) -> Result<Vec<(u8, f64)>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        let mut video = Video::open(&path, MAX_PIXELS).map_err(|e| e.to_string())?;
        let mut levels = Vec::new();
        while let Some(frame) = video.next_frame() {
            let frame = frame.map_err(|e| e.to_string())?;
            let image = frame.image.grey(&path, MAX_PIXELS).map_err(|e| e.to_string())?;
            assert_eq!((image.width(), image.height()), (16, 8));
            levels.push((image.pixels()[20], frame.time_s));
        }
        Ok(levels)
    }

    #[test]
    fn motion_jpeg_is_read_frame_by_frame() {
        let frames = [jpeg(50), jpeg(100), jpeg(150)];
        let close = |found: &[(u8, f64)], period_s: f64| {
            let expected = [50_u8, 100, 150].into_iter().zip(0..);
            found.len() == 3
                && found.iter().zip(expected).all(|((level, time_s), (wanted, i))| {
                    level.abs_diff(wanted) < 3 && (time_s - period_s * f64::from(i)).abs() < 1e-9
                })
        };
        // Each frame and the dropped one behind it have 50 ms.
        let found = levels("a.avi", &avi(b"MJPG", &frames)).unwrap();
        assert!(close(&found, 0.1), "{found:?}");
        let found = levels("a.mjpeg", &frames.concat()).unwrap();
        assert!(close(&found, 0.04), "{found:?}");
        let grey = [50_u8, 100, 150].map(|level| vec![level; 16 * 8]);
        let found = levels("a.avi", &avi(b"Y800", &grey)).unwrap();
        assert!(close(&found, 0.1), "{found:?}");
    }

    #[test]
    fn frames_of_mp4_have_the_times_at_which_they_are_shown() {
        if !testing::has_x264() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mp4");
        // Of 20 frames at 25 Hz every third and the ten in the middle are missing; B-frames are coded in another order.
        let kept = |n: &u32| !n.is_multiple_of(3) && !(5..15).contains(n);
        let made = std::process::Command::new("ffmpeg")
            .args(["-v", "error", "-f", "lavfi", "-i", "testsrc=size=64x48:rate=25:duration=0.8"])
            .args(["-vf", "select='mod(n,3)*not(between(n,5,14))'", "-fps_mode", "vfr"])
            .args(["-c:v", "libx264", "-pix_fmt", "yuv420p", "-bf", "2"])
            .arg(&path)
            .status();
        assert!(made.unwrap().success());
        let mut video = Video::open(&path, MAX_PIXELS).unwrap();
        let mut times = Vec::new();
        while let Some(frame) = video.next_frame() {
            times.push((frame.unwrap().time_s * 25.0).round() as u32);
        }
        let expected: Vec<u32> = (0..20).filter(kept).map(|n| n - 1).collect();
        assert_eq!(times, expected);
    }

    /// A video of ffmpeg's test pictures of 64 x 48 pixels, at 25 Hz.
    fn encode(seconds: &str, options: &[&str], path: &Path) {
        let source = format!("testsrc=size=64x48:rate=25:duration={seconds}");
        let made = std::process::Command::new("ffmpeg")
            .args(["-v", "error", "-f", "lavfi", "-i", &source])
            .args(["-c:v", "libx264", "-pix_fmt", "yuv420p"])
            .args(options)
            .arg(path)
            .status();
        assert!(made.unwrap().success());
    }

    fn frames(path: &Path) -> Vec<GrayImage> {
        let mut video = Video::open(path, MAX_PIXELS).unwrap();
        let frames = std::iter::from_fn(|| video.next_frame());
        frames.map(|frame| frame.unwrap().image.grey(path, MAX_PIXELS).unwrap()).collect()
    }

    #[test]
    fn frames_are_as_the_sensor_saw_them_also_after_the_conversion_that_is_advised() {
        if !testing::has_x264() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let upright = folder.path().join("upright.mp4");
        encode("0.2", &[], &upright);
        assert!(!Video::open(&upright, MAX_PIXELS).unwrap().is_turned());
        // A quarter of a turn, in the matrix of the track's header: 40 bytes behind the name of its box.
        let mut bytes = std::fs::read(&upright).unwrap();
        let at = 44 + bytes.windows(4).position(|name| name == b"tkhd").unwrap();
        let matrix = [0, 0x1_0000, 0, -0x1_0000, 0, 0, 0, 0, 0x4000_0000_i32];
        let matrix = matrix.map(i32::to_be_bytes);
        bytes[at..at + 36].copy_from_slice(matrix.as_flattened());
        let turned = folder.path().join("turned video.mp4");
        std::fs::write(&turned, bytes).unwrap();
        assert!(Video::open(&turned, MAX_PIXELS).unwrap().is_turned());
        let stored = frames(&turned);
        let advice = Problems { path: &turned }.unsupported("of a test").to_string();
        let (_, command) = advice.split_once("Convert it with: ").unwrap();
        let shell = std::process::Command::new("sh")
            .args(["-c", &command.replacen("ffmpeg", "ffmpeg -v error", 1)])
            .current_dir(folder.path())
            .status();
        assert!(shell.unwrap().success(), "{command}");
        let converted = frames(&folder.path().join("video.avi"));
        assert_eq!((stored.len(), converted.len()), (5, 5));
        for (stored, converted) in stored.iter().zip(&converted) {
            assert_eq!((converted.width(), converted.height()), (64, 48));
            let pixels = stored.pixels().iter().zip(converted.pixels());
            let off: u32 = pixels.map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
            // Video has a narrower range of luma than JPEG: 16 to 235.
            assert!(off < 20 * 64 * 48, "{off}");
        }
    }

    #[test]
    fn an_mp4_file_that_viewers_turn_is_recognised() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mp4");
        let opened = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            Video::open(&path, MAX_PIXELS).unwrap().is_turned()
        };
        let mut bytes = include_bytes!("../../../fuzz/corpus/mp4/baseline.mp4").to_vec();
        assert!(!opened(&bytes));
        // The matrix of the track's header begins 40 bytes behind the name of its box, which has four bytes.
        let at = 44 + bytes.windows(4).position(|name| name == b"tkhd").unwrap();
        let (one, right) = (0x1_0000_i32, 0x4000_0000_i32);
        for (matrix, is_turned) in [
            ([0, one, 0, -one, 0, 0, 0, 0, right], true),
            ([-one, 0, 0, 0, -one, 0, 0, 0, right], true),
            ([-one, 0, 0, 0, one, 0, 0, 0, right], true),
            ([2 * one, 0, 0, 0, one, 0, 0, 0, right], false),
        ] {
            bytes[at..at + 36].copy_from_slice(matrix.map(i32::to_be_bytes).as_flattened());
            assert_eq!(opened(&bytes), is_turned, "{matrix:?}");
        }
    }

    #[test]
    fn unsupported_videos_are_refused_with_advice() {
        for (name, bytes) in [
            ("a.avi", avi(b"XVID", &[])),
            ("a.mkv", b"\x1a\x45\xdf\xa3 and more".to_vec()),
            ("a.mp4", b"neither MP4 nor AVI".to_vec()),
        ] {
            let problem = levels(name, &bytes).unwrap_err();
            assert!(
                problem.contains("ffmpeg -noautorotate -i") && problem.contains(name),
                "{problem}"
            );
        }
        assert!(levels("a.avi", &avi(b"XVID", &[])).unwrap_err().contains("\"XVID\""));
        let empty = levels("a.mp4", &[]).unwrap_err();
        assert!(empty.contains("a.mp4") && empty.contains("is empty"), "{empty}");
        assert!(Video::open(Path::new("no/such.avi"), MAX_PIXELS).is_err());
        assert!(is_video(Path::new("a.MP4")) && !is_video(Path::new("a.png")));
    }

    #[test]
    fn intact_videos_that_are_not_decoded_are_refused_with_the_reason_and_advice() {
        if !testing::has_x264() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        let error = |name: &str, options: &[&str]| {
            let path = folder.path().join(name);
            let made = std::process::Command::new("ffmpeg")
                .args(["-v", "error", "-f", "lavfi", "-i", "testsrc=size=64x48:rate=25:duration=1"])
                .args(["-pix_fmt", "yuv420p", "-g", "5"])
                .args(options)
                .arg(&path)
                .status();
            assert!(made.unwrap().success(), "{options:?}");
            let opened = Video::open(&path, MAX_PIXELS);
            opened
                .and_then(|mut video| video.next_frame().unwrap())
                .map_err(|e| e.to_string())
                .err()
        };
        let x264 = ["-c:v", "libx264"];
        let ten_bits = [&x264[..], &["-pix_fmt", "yuv420p10le"]].concat();
        assert_eq!(error("ten.mp4", &ten_bits), None);
        let fragments =
            ["frag_keyframe+empty_moov", "frag_keyframe", "frag_keyframe+default_base_moof"];
        let fragments = fragments.map(|flags| [&x264[..], &["-movflags", flags]].concat());
        let [empty, first, default] = fragments;
        let yuv444 = [&x264[..], &["-pix_fmt", "yuv444p"]].concat();
        for (name, options, reason) in [
            ("empty.mp4", &*empty, "is an MP4 file in fragments;"),
            ("first.mp4", &*first, "is an MP4 file in fragments;"),
            ("default.mp4", &*default, "is an MP4 file in fragments;"),
            ("colours.mp4", &*yuv444, "is H.264 with 4:4:4 chroma;"),
            ("jpeg.mov", &["-c:v", "mjpeg"], "is a QuickTime file whose video is not H.264;"),
        ] {
            let error = error(name, options).unwrap();
            assert!(error.contains(reason) && error.contains("ffmpeg -noautorotate -i"), "{error}");
            assert!(error.contains("H.264 of 8 or 10 bits"), "{error}");
        }
    }

    #[test]
    fn a_bare_stream_that_is_cut_gives_its_complete_pictures_and_an_error() {
        if !testing::has_x264() {
            return;
        }
        let folder = tempfile::tempdir().unwrap();
        for options in [
            &["-bf", "2"][..],
            &["-profile:v", "baseline"],
            &["-g", "1"],
            &["-slices", "3"],
            &["-flags", "+ilme+ildct", "-x264opts", "tff=1"],
        ] {
            let path = folder.path().join("a.h264");
            encode(
                "0.4",
                &[&["-vf", "noise=alls=60:allf=t", "-qp", "20", "-y"], options].concat(),
                &path,
            );
            let whole = std::fs::read(&path).unwrap();
            let read = || {
                let mut video = Video::open(&path, MAX_PIXELS).unwrap();
                let frames: Vec<_> = std::iter::from_fn(|| video.next_frame()).collect();
                let errors: Vec<_> = frames.iter().filter_map(|it| it.as_ref().err()).collect();
                let reported = errors.first().map_or(String::new(), ToString::to_string);
                (frames.len() - errors.len(), reported)
            };
            assert_eq!(read(), (10, String::new()), "{options:?}");
            std::fs::write(&path, [&whole[..], &[0; 3]].concat()).unwrap();
            assert_eq!(read(), (10, String::new()), "{options:?}");
            for missing in [8, 60] {
                std::fs::write(&path, &whole[..whole.len() - missing]).unwrap();
                let (count, reported) = read();
                // With a slice that it refuses, the decoder drops the picture before it as well.
                let is_known = (8..=9).contains(&count);
                assert!(
                    is_known && reported.contains("cut short"),
                    "{options:?}: {count} {reported}"
                );
            }
        }
    }

    #[test]
    fn damaged_videos_never_stop_the_reader() {
        let whole = avi(b"MJPG", &[jpeg(50), jpeg(100)]);
        for len in (0..whole.len()).step_by(13) {
            drop(levels("a.avi", &whole[..len]));
        }
        for at in (0..whole.len()).step_by(17) {
            let mut damaged = whole.clone();
            damaged[at] ^= 0x5a;
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.avi");
            std::fs::write(&path, damaged).unwrap();
            if let Ok(mut video) = Video::open(&path, MAX_PIXELS) {
                while let Some(Ok(_)) = video.next_frame() {}
            }
        }
    }
}
