//! JPEG files as cameras send them, made by OpenCV (`jpeg/files.py` writes them) and by the crate `image`.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageFormat, RgbImage};
use imaging::GrayImage;
use media::{DEFAULT_MAX_PIXELS, decode_image, frame_bytes, images_in};

/// A name and the bytes of each file.
fn files() -> Vec<(String, Vec<u8>)> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/jpeg");
    let read = |path: PathBuf| {
        (path.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(&path).unwrap())
    };
    let mut files: Vec<_> = images_in(&folder).unwrap().into_iter().map(read).collect();
    let picture = RgbImage::from_fn(83, 59, |x, y| {
        image::Rgb([(x * 3) as u8, (y * 4) as u8, ((x * y) ^ (x << 3)) as u8])
    });
    let encoded = |image: DynamicImage| {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, ImageFormat::Jpeg).unwrap();
        bytes.into_inner()
    };
    let picture = DynamicImage::from(picture);
    files.push(("the encoder's grey".to_owned(), encoded(picture.to_luma8().into())));
    files.push(("the encoder's colours".to_owned(), encoded(picture)));
    files
}

fn decoded(bytes: &[u8]) -> Result<GrayImage, String> {
    decode_image(Path::new("a picture"), bytes, DEFAULT_MAX_PIXELS).map_err(|e| e.to_string())
}

/// The segments of a file up to its first scan, each with the code of its marker, and the rest.
fn split(jpeg: &[u8]) -> (Vec<(u8, &[u8])>, &[u8]) {
    let (mut segments, mut rest) = (Vec::new(), &jpeg[2..]);
    while rest[1] != 0xda {
        let (segment, behind) =
            rest.split_at(2 + usize::from(u16::from_be_bytes([rest[2], rest[3]])));
        segments.push((segment[1], segment));
        rest = behind;
    }
    (segments, rest)
}

/// The file without the segments of this code.
fn without(jpeg: &[u8], code: u8) -> Vec<u8> {
    let (segments, scan) = split(jpeg);
    let kept = segments.into_iter().filter(|segment| segment.0 != code).map(|segment| segment.1);
    [&jpeg[..2]].into_iter().chain(kept).chain([scan]).collect::<Vec<_>>().concat()
}

#[test]
fn a_file_without_huffman_tables_is_decoded_with_the_standard_ones() {
    let file = tempfile::NamedTempFile::new().unwrap();
    for (name, whole) in files() {
        let bare = without(&whole, 0xc4);
        assert!(bare.len() + 200 < whole.len(), "{name} has no tables");
        let expected = decoded(&whole).unwrap();
        let read = decoded(&bare).unwrap_or_else(|problem| panic!("{name}: {problem}"));
        assert!(read.pixels() == expected.pixels(), "{name}");
        std::fs::write(file.path(), &bare).unwrap();
        let bytes = frame_bytes(file.path(), DEFAULT_MAX_PIXELS).unwrap();
        assert_eq!(bytes, expected.width() * expected.height(), "{name}");
    }
}
