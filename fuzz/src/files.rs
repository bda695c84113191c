//! Reads files of a user: images, videos, calibrations, recordings.

use std::path::{Path, PathBuf};

use imaging::GrayImage;
use media::{JpegScanner, LiveH264, Video, VideoImage, decode_image, read_calibration};

/// Maximum size of an image in these targets, in pixels.
pub const MAX_PIXELS: u64 = 1 << 20;
/// Maximum number of frames that are read of one video.
const MAX_FRAMES: usize = 64;

/// An image file, alone and in a stream of pieces.
pub fn jpeg(input: &[u8]) {
    if let Ok(image) = decode_image(Path::new("fuzz.jpg"), input, MAX_PIXELS) {
        check(&image);
    }
    let mut scanner = JpegScanner::default();
    for piece in input.chunks(7) {
        let mut rest = piece;
        while !rest.is_empty() {
            let taken = scanner.push(rest);
            rest = rest.get(taken..).unwrap_or_default();
            if scanner.is_complete() {
                assert!(scanner.take().len() <= input.len());
            }
        }
    }
}

/// An AVI file, or a bare stream of JPEG files.
pub fn avi(input: &[u8]) {
    video(input, "avi");
}

/// An MP4 file.
pub fn mp4(input: &[u8]) {
    video(input, "mp4");
}

/// A bare stream of H.264, as a file and in pieces as a camera streams it.
pub fn h264(input: &[u8]) {
    video(input, "h264");
    let mut decoder = LiveH264::new(MAX_PIXELS);
    for piece in input.chunks(999).take(MAX_FRAMES) {
        if let Ok(Some(image)) = decoder.decode(piece) {
            check(&image);
        }
    }
}

/// A calibration file of another program.
pub fn calibration(input: &[u8]) {
    let path = written(input, "yaml");
    if let Ok(model) = read_calibration(&path) {
        let pixel = model.project(geometry::Point::new(0.1, -0.2, 1.0));
        assert!(pixel.is_none_or(|pixel| !pixel.x.is_nan() && !pixel.y.is_nan()));
    }
}

/// A recording to repair, to read and to replay; after the repair it is complete.
pub fn recording(input: &[u8]) {
    let mut reader = flightlog::TapeReader::default();
    if reader.read(input).is_ok() {
        for part in reader.tapes().iter().flat_map(|tape| &tape.parts) {
            let records = part.records().take_while(Result::is_ok).count();
            assert!(records <= part.records.len());
        }
    }
    let mut messages = 0;
    if let Ok(read) = flightlog::read(input, |entry| {
        messages += u64::from(matches!(entry, flightlog::Entry::Message(_)));
    }) {
        assert_eq!(read.messages, messages);
    }
    let mut mended = Vec::new();
    if let Ok(found) = flightlog::repair(input, &mut mended) {
        let again = flightlog::repair(&mended, std::io::sink());
        assert!(again.is_ok_and(|it| it.damage.is_empty() && it.messages == found.messages));
    }
}

fn video(input: &[u8], extension: &str) {
    let path = written(input, extension);
    let Ok(mut video) = Video::open(&path, MAX_PIXELS) else { return };
    for _ in 0..MAX_FRAMES {
        match video.next_frame() {
            None | Some(Err(_)) => return,
            Some(Ok(frame)) => {
                assert!(!frame.time_s.is_nan());
                match frame.image {
                    VideoImage::Grey(image) => check(&image),
                    // JPEG files are the target `jpeg`'s.
                    VideoImage::Jpeg(bytes) => assert!(bytes.len() <= input.len()),
                }
            }
        }
    }
}

fn check(image: &GrayImage) {
    assert_eq!(image.pixels().len(), image.width() * image.height());
    assert!((image.width() as u64).saturating_mul(image.height() as u64) <= MAX_PIXELS);
}

/// The input as a file; each thread has its own.
#[expect(
    clippy::panic,
    reason = "without the file nothing is tried, and a silent run would claim otherwise"
)]
pub(crate) fn written(input: &[u8], extension: &str) -> PathBuf {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { memory.to_owned() } else { std::env::temp_dir() };
    let thread = format!("{:?}", std::thread::current().id());
    let number: String = thread.chars().filter(char::is_ascii_digit).collect();
    let path = folder.join(format!("alight-fuzz-{}-{number}.{extension}", std::process::id()));
    match std::fs::write(&path, input) {
        Ok(()) => path,
        Err(problem) => panic!("{path:?} cannot be written: {problem}"),
    }
}
