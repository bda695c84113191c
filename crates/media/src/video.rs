//! Videos, frame by frame: Motion JPEG (AVI, or a bare stream of JPEG files) and H.264 (MP4, or a bare stream).

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use imaging::{Converter, GrayImage, SampleFormat};
use rust_h264::decoder::OrderedDecoder;
use rust_h264::nal::{NalUnit, NalUnitType, parse_annex_b, parse_avcc, parse_sps_info};

use crate::image::{ImageError, decode_image, has_extension};

/// Ends of the names of videos, those that cannot be read included, so that their owner hears what to do.
pub const VIDEO_EXTENSIONS: &[&str] = &[
    "avi", "mjpeg", "mjpg", "mp4", "m4v", "mov", "h264", "264", "mkv", "webm", "wmv", "mpg",
    "mpeg", "ts",
];

/// Bare streams are read as a whole up to this many bytes.
const LARGEST_STREAM: u64 = 1 << 30;
/// Bytes of one coded frame.
const LARGEST_FRAME: u64 = 256 << 20;

/// Why a video or one of its frames was not read, and what to do about it.
#[derive(Debug, thiserror::Error)]
pub enum VideoError {
    /// A file that the system does not open or read.
    #[error("{path:?} cannot be read: {cause}; check the path and its permissions")]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// A form of video that is not read here.
    #[error(
        "{path:?} is {what}; videos are read as Motion JPEG (.avi, .mjpeg) or H.264 of 8 bits (.mp4, .mov, .h264). \
         Convert it without loss that matters: ffmpeg -i {path:?} -c:v mjpeg -q:v 2 -an video.avi"
    )]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// What it is.
        what: String,
    },
    /// Bytes that make no video.
    #[error("{path:?} is damaged or cut short: {cause}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        cause: String,
    },
}

/// True for files whose names say that they are videos.
pub fn is_video(path: &Path) -> bool {
    has_extension(path, VIDEO_EXTENSIONS)
}

/// A frame of a video.
#[derive(Debug)]
pub struct VideoFrame {
    /// Counts the frames from 0.
    pub index: u64,
    /// Since the first frame, in seconds.
    pub time_s: f64,
    /// The picture.
    pub picture: Picture,
}

/// A picture, decoded or not yet.
#[derive(Debug)]
pub enum Picture {
    /// A JPEG file.
    Jpeg(Vec<u8>),
    /// Grey.
    Grey(GrayImage),
}

impl Picture {
    /// The picture in grey; `path` is what errors name.
    ///
    /// # Errors
    /// When a JPEG is damaged or too large.
    pub fn grey(self, path: &Path, most_pixels: u64) -> Result<GrayImage, ImageError> {
        match self {
            Self::Jpeg(bytes) => decode_image(path, &bytes, most_pixels),
            Self::Grey(image) => Ok(image),
        }
    }
}

/// An opened video.
pub struct Video {
    path: PathBuf,
    most_pixels: u64,
    stream: Stream,
    period_s: f64,
    next: u64,
}

enum Stream {
    Avi(AviReader),
    Jpegs { bytes: Vec<u8>, at: usize },
    H264(Box<H264>),
    Ended,
}

/// Frames a second of streams that do not say how many.
const USUAL_RATE_HZ: f64 = 25.0;

impl Video {
    /// Opens a video whose frames have up to `most_pixels`.
    ///
    /// # Errors
    /// [`VideoError`] when it cannot be read, or is none that is read here.
    pub fn open(path: &Path, most_pixels: u64) -> Result<Self, VideoError> {
        let problems = Problems { path };
        let mut file = BufReader::new(File::open(path).map_err(|e| problems.unreadable(e))?);
        let mut start = Vec::new();
        file.by_ref().take(12).read_to_end(&mut start).map_err(|e| problems.unreadable(e))?;
        file.rewind().map_err(|e| problems.unreadable(e))?;
        let (stream, period_s) = match start.as_slice() {
            [b'R', b'I', b'F', b'F', _, _, _, _, b'A', b'V', b'I', b' '] => {
                let (reader, period_s) = AviReader::open(file, &problems)?;
                (Stream::Avi(reader), period_s)
            }
            [0xff, 0xd8, ..] => {
                let bytes = whole(file, &problems)?;
                (Stream::Jpegs { bytes, at: 0 }, 1.0 / USUAL_RATE_HZ)
            }
            [_, _, _, _, b'f', b't', b'y', b'p', ..] => {
                let (decoder, period_s) = H264::from_mp4(file, &problems, most_pixels)?;
                (Stream::H264(Box::new(decoder)), period_s)
            }
            [0, 0, 1, ..] | [0, 0, 0, 1, ..] if has_extension(path, &["h264", "264"]) => {
                let decoder = H264::from_stream(whole(file, &problems)?);
                (Stream::H264(Box::new(decoder)), 1.0 / USUAL_RATE_HZ)
            }
            _ => return Err(problems.unsupported("of a kind that is not read")),
        };
        let path = path.to_owned();
        Ok(Self { path, most_pixels, stream, period_s, next: 0 })
    }

    /// The next frame; `None` after the last. After an error there are no more.
    pub fn next_frame(&mut self) -> Option<Result<VideoFrame, VideoError>> {
        let problems = Problems { path: &self.path };
        let picture = match &mut self.stream {
            Stream::Avi(reader) => reader.next(&problems),
            Stream::Jpegs { bytes, at } => next_jpeg(bytes, at).map(Ok),
            Stream::H264(decoder) => decoder.next(&problems, self.most_pixels),
            Stream::Ended => None,
        };
        if !matches!(picture, Some(Ok(_))) {
            self.stream = Stream::Ended;
        }
        let index = self.next;
        self.next += 1;
        let time_s = index as f64 * self.period_s;
        picture.map(|picture| Ok(VideoFrame { index, time_s, picture: picture? }))
    }
}

/// Errors that name the file.
struct Problems<'a> {
    path: &'a Path,
}

impl Problems<'_> {
    fn unreadable(&self, cause: std::io::Error) -> VideoError {
        match cause.kind() {
            ErrorKind::UnexpectedEof => self.damaged("it ends in the middle of something"),
            _ => VideoError::Unreadable { path: self.path.to_owned(), cause },
        }
    }

    fn unsupported(&self, what: &str) -> VideoError {
        VideoError::Unsupported { path: self.path.to_owned(), what: what.to_owned() }
    }

    fn damaged(&self, cause: impl std::fmt::Display) -> VideoError {
        VideoError::Damaged { path: self.path.to_owned(), cause: cause.to_string() }
    }
}

fn whole(file: BufReader<File>, problems: &Problems<'_>) -> Result<Vec<u8>, VideoError> {
    let mut bytes = Vec::new();
    file.take(LARGEST_STREAM).read_to_end(&mut bytes).map_err(|e| problems.unreadable(e))?;
    if bytes.len() as u64 == LARGEST_STREAM {
        return Err(problems.unsupported("a bare stream of more than 1 GiB"));
    }
    Ok(bytes)
}

/// The next file in a row of JPEG files: from one start to the byte before the next start after an end.
fn next_jpeg(bytes: &[u8], at: &mut usize) -> Option<Picture> {
    let rest = bytes.get(*at..)?;
    let start = rest.windows(3).position(|w| w == [0xff, 0xd8, 0xff])?;
    let body = rest.get(start..)?;
    let is_end = |w: &[u8]| w == [0xff, 0xd9, 0xff, 0xd8];
    let len = body.windows(4).position(is_end).map_or(body.len(), |end| end + 2);
    *at += start + len;
    body.get(..len).map(|jpeg| Picture::Jpeg(jpeg.to_vec()))
}

/// The chunks of an AVI file (RIFF) that are frames of its first video stream, in order.
struct AviReader {
    file: BufReader<File>,
    /// Ids of the stream's chunks: compressed and uncompressed.
    ids: [[u8; 4]; 2],
    /// Width and height of frames that are grey pixels; those of others are JPEG files.
    grey: Option<[usize; 2]>,
}

/// What the header says of a stream.
#[derive(Default)]
struct AviHeader {
    period_us: u32,
    streams: u32,
    /// The first video stream: its number, codec, width and height.
    video: Option<(u32, [u8; 4], [i32; 2])>,
    is_video: bool,
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
                    // Its parts are chunks like others.
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
        let Some((number, codec, [width, height])) = header.video else {
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
            0 => 1.0 / USUAL_RATE_HZ,
            micros => f64::from(micros) * 1e-6,
        };
        Ok((Self { file, ids, grey }, period_s))
    }

    fn next(&mut self, problems: &Problems<'_>) -> Option<Result<Picture, VideoError>> {
        loop {
            match self.next_chunk() {
                Ok(Some(Some(bytes))) => match self.grey {
                    None => return Some(Ok(Picture::Jpeg(bytes))),
                    Some([width, height]) => return grey_picture(&bytes, width, height).map(Ok),
                },
                Ok(Some(None)) => {}
                Ok(None) => return None,
                Err(cause) => return Some(Err(problems.unreadable(cause))),
            }
        }
    }

    /// The next chunk: `None` at the end, nothing in it when it is no frame.
    fn next_chunk(&mut self) -> std::io::Result<Option<Option<Vec<u8>>>> {
        let Some((id, len)) = chunk(&mut self.file)? else { return Ok(None) };
        if id == *b"LIST" || id == *b"RIFF" {
            // Groups of frames, and what follows in files of more than 1 GiB.
            let mut kind = [0; 4];
            self.file.read_exact(&mut kind)?;
            if !matches!(&kind, b"rec " | b"movi" | b"AVIX") {
                skip(&mut self.file, u64::from(len).saturating_sub(4), len)?;
            }
            return Ok(Some(None));
        }
        // A dropped frame is a chunk without bytes.
        if !self.ids.contains(&id) || len == 0 || u64::from(len) > LARGEST_FRAME {
            skip(&mut self.file, u64::from(len), len)?;
            return Ok(Some(None));
        }
        let mut bytes = Vec::new();
        self.file.by_ref().take(u64::from(len)).read_to_end(&mut bytes)?;
        if bytes.len() as u64 != u64::from(len) {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        skip(&mut self.file, 0, len)?;
        Ok(Some(Some(bytes)))
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
                    self.video = Some((self.streams - 1, codec, [width, height]));
                }
            }
            _ => {}
        }
    }
}

/// The head of the next chunk; `None` at the end of the file.
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

/// Goes on behind the rest of a chunk of `len` bytes; chunks begin at even places.
fn skip(file: &mut BufReader<File>, rest: u64, len: u32) -> std::io::Result<()> {
    file.seek_relative((rest + u64::from(len % 2)) as i64)
}

/// Rows of grey pixels, padded to four bytes.
fn grey_picture(bytes: &[u8], width: usize, height: usize) -> Option<Picture> {
    let stride = width.next_multiple_of(4);
    if bytes.len() < stride.checked_mul(height)? {
        return None;
    }
    let mut image = GrayImage::filled(width, height, 0);
    for (y, row) in bytes.chunks_exact(stride).take(height).enumerate() {
        image.row_mut(y).copy_from_slice(row.get(..width)?);
    }
    Some(Picture::Grey(image))
}

/// Decodes H.264, one coded picture after the other.
struct H264 {
    decoder: OrderedDecoder,
    source: Source,
    /// Pictures that are decoded and wait for their turn.
    ready: VecDeque<GrayImage>,
    is_over: bool,
}

enum Source {
    Mp4 { reader: Box<mp4::Mp4Reader<BufReader<File>>>, track: u32, next: u32, length_bytes: usize },
    Stream { bytes: Vec<u8>, at: usize },
}

impl H264 {
    fn from_mp4(
        file: BufReader<File>,
        problems: &Problems<'_>,
        most_pixels: u64,
    ) -> Result<(Self, f64), VideoError> {
        let size = file.get_ref().metadata().map_err(|e| problems.unreadable(e))?.len();
        let reader = mp4::Mp4Reader::read_header(file, size).map_err(|e| problems.damaged(e))?;
        let is_video = |track: &&mp4::Mp4Track| {
            track.track_type().is_ok_and(|kind| kind == mp4::TrackType::Video)
        };
        let Some(track) = reader.tracks().values().find(is_video) else {
            return Err(problems.unsupported("an MP4 file without video that is known here"));
        };
        let Some(avc1) = &track.trak.mdia.minf.stbl.stsd.avc1 else {
            return Err(problems.unsupported("an MP4 file whose video is not H.264"));
        };
        let mut decoder = OrderedDecoder::new();
        let parameters =
            avc1.avcc.sequence_parameter_sets.iter().chain(&avc1.avcc.picture_parameter_sets);
        for parameter in parameters {
            let bytes = [&[0, 0, 1], parameter.bytes.as_slice()].concat();
            for unit in parse_annex_b(&bytes) {
                check_size(&unit, problems, most_pixels)?;
                decoder.decode_nal(&unit).map_err(|e| problems.damaged(e))?;
            }
        }
        let seconds = track.duration().as_secs_f64() / f64::from(track.sample_count().max(1));
        let period_s = if seconds > 0.0 { seconds } else { 1.0 / USUAL_RATE_HZ };
        let length_bytes = usize::from(avc1.avcc.length_size_minus_one & 3) + 1;
        let track = track.track_id();
        let source = Source::Mp4 { reader: Box::new(reader), track, next: 1, length_bytes };
        Ok((Self { decoder, source, ready: VecDeque::new(), is_over: false }, period_s))
    }

    fn from_stream(bytes: Vec<u8>) -> Self {
        let source = Source::Stream { bytes, at: 0 };
        Self { decoder: OrderedDecoder::new(), source, ready: VecDeque::new(), is_over: false }
    }

    fn next(
        &mut self,
        problems: &Problems<'_>,
        most_pixels: u64,
    ) -> Option<Result<Picture, VideoError>> {
        while self.ready.is_empty() && !self.is_over {
            if let Err(problem) = self.decode_more(problems, most_pixels) {
                self.is_over = true;
                return Some(Err(problem));
            }
        }
        self.ready.pop_front().map(|image| Ok(Picture::Grey(image)))
    }

    fn decode_more(&mut self, problems: &Problems<'_>, most_pixels: u64) -> Result<(), VideoError> {
        let mut frames = Vec::new();
        let mut decode = |unit: &NalUnit<'_>| {
            check_size(unit, problems, most_pixels)?;
            frames.extend(self.decoder.decode_nal(unit).map_err(|e| problems.damaged(e))?);
            Ok(())
        };
        match &mut self.source {
            Source::Mp4 { reader, track, next, length_bytes } => {
                let sample = reader.read_sample(*track, *next).map_err(|e| problems.damaged(e))?;
                *next += 1;
                match sample {
                    Some(sample) => {
                        parse_avcc(&sample.bytes, *length_bytes)
                            .iter()
                            .try_for_each(&mut decode)?;
                    }
                    None => self.is_over = true,
                }
            }
            Source::Stream { bytes, at } => match next_unit(bytes, at) {
                Some(unit) => parse_annex_b(unit).iter().try_for_each(&mut decode)?,
                None => self.is_over = true,
            },
        }
        if self.is_over {
            frames.extend(self.decoder.flush());
        }
        for frame in frames {
            let bits = SampleFormat { bits: u32::from(frame.bit_depth), mosaic: None };
            let (width, height) = (frame.width as usize, frame.height as usize);
            let mut converter = Converter::default();
            let view = converter
                .convert(&frame.y, width, height, bits)
                .map_err(|e| problems.damaged(e))?;
            let mut image = GrayImage::filled(width, height, 0);
            (0..height).for_each(|y| image.row_mut(y).copy_from_slice(view.row(y)));
            self.ready.push_back(image);
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

/// Refuses pictures of more pixels than are allowed before they are decoded.
fn check_size(
    unit: &NalUnit<'_>,
    problems: &Problems<'_>,
    most_pixels: u64,
) -> Result<(), VideoError> {
    if unit.nal_unit_type != NalUnitType::Sps {
        return Ok(());
    }
    let info = parse_sps_info(unit).map_err(|e| problems.damaged(e))?;
    let pixels = u64::from(info.coded_width) * u64::from(info.coded_height);
    if pixels > most_pixels {
        return Err(problems.unsupported(&format!("a video of {pixels} pixels, too many,")));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{ImageFormat, Luma};
    use std::io::Cursor;

    const MOST: u64 = 1_000_000;

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
        let mut video = Video::open(&path, MOST).map_err(|e| e.to_string())?;
        let mut levels = Vec::new();
        while let Some(frame) = video.next_frame() {
            let frame = frame.map_err(|e| e.to_string())?;
            let image = frame.picture.grey(&path, MOST).map_err(|e| e.to_string())?;
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
        let found = levels("a.avi", &avi(b"MJPG", &frames)).unwrap();
        assert!(close(&found, 0.05), "{found:?}");
        let found = levels("a.mjpeg", &frames.concat()).unwrap();
        assert!(close(&found, 0.04), "{found:?}");
        let grey = [50_u8, 100, 150].map(|level| vec![level; 16 * 8]);
        let found = levels("a.avi", &avi(b"Y800", &grey)).unwrap();
        assert!(close(&found, 0.05), "{found:?}");
    }

    #[test]
    fn what_is_not_read_says_how_to_convert_it() {
        for (name, bytes) in [
            ("a.avi", avi(b"XVID", &[])),
            ("a.mkv", b"\x1a\x45\xdf\xa3 and more".to_vec()),
            ("a.mp4", vec![]),
        ] {
            let problem = levels(name, &bytes).unwrap_err();
            assert!(problem.contains("ffmpeg -i") && problem.contains(name), "{problem}");
        }
        assert!(levels("a.avi", &avi(b"XVID", &[])).unwrap_err().contains("\"XVID\""));
        assert!(Video::open(Path::new("no/such.avi"), MOST).is_err());
        assert!(is_video(Path::new("a.MP4")) && !is_video(Path::new("a.png")));
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
            if let Ok(mut video) = Video::open(&path, MOST) {
                while let Some(Ok(_)) = video.next_frame() {}
            }
        }
    }
}
