//! Tests JPEG files as cameras send them, made by OpenCV (`jpeg/files.py` writes them) and by the crate `image`.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

use std::io::Cursor;
use std::path::{Path, PathBuf};

use image::{DynamicImage, ImageFormat, RgbImage, load_from_memory};
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

/// Where the coded data of a file begin.
fn coded_at(jpeg: &[u8]) -> usize {
    let scan = split(jpeg).1;
    jpeg.len() - scan.len() + 2 + usize::from(u16::from_be_bytes([scan[2], scan[3]]))
}

/// The decoder's result for a complete or damaged file.
fn shown(jpeg: &[u8]) -> RgbImage {
    load_from_memory(jpeg).unwrap().to_rgb8()
}

/// How many blocks of 8 x 8 pixels show something else in the second picture, not counting how bright they are; colours that cannot be
/// shown are not compared.
fn changed_blocks(pictures: [&RgbImage; 2]) -> usize {
    let (width, height) = pictures[0].dimensions();
    let columns = width / 8;
    let is_changed = |block: &u32| {
        let (left, top) = (block % columns * 8, block / columns * 8);
        let pixels = (0..64).map(|pixel| {
            let of = |it: &RgbImage| it.get_pixel(left + pixel % 8, top + pixel / 8).0;
            let [before, after] = pictures.map(of);
            let is_shown = before.iter().chain(&after).all(|value| (1..255).contains(value));
            let luma = |[r, g, b]: [u8; 3]| {
                0.299 * f64::from(r) + 0.587 * f64::from(g) + 0.114 * f64::from(b)
            };
            is_shown.then(|| luma(after) - luma(before))
        });
        let brighter: Option<Vec<_>> = pixels.collect();
        brighter.is_some_and(|values| {
            let mean = values.iter().sum::<f64>() / 64.0;
            values.iter().any(|value| (value - mean).abs() > 6.0)
        })
    };
    (0..columns * (height / 8)).filter(is_changed).count()
}

#[test]
fn whole_files_are_accepted_with_surplus_bytes_before_and_behind_their_end() {
    for (name, whole) in files() {
        let expected = decoded(&whole).unwrap_or_else(|problem| panic!("{name}: {problem}"));
        let data = &whole[..whole.len() - 2];
        for surplus in [[0; 5], [0xfe; 5], [0x80, 1, 2, 3, 4]] {
            let file = [data, &surplus, &[0xff, 0xd9], &surplus, data].concat();
            let read = decoded(&file).unwrap_or_else(|problem| panic!("{name}: {problem}"));
            assert!(read.pixels() == expected.pixels(), "{name}");
        }
    }
}

#[test]
fn a_file_with_a_hole_is_refused_or_shows_everything_in_its_place() {
    const PLACES: usize = 60;
    // Of each length, how many holes of a hundred may pass, and how many blocks of 252 may then show something else: those around the
    // hole, to where the codes are read in step again.
    for (hole, passing, around) in
        [(1, 72, 12), (2, 70, 12), (10, 40, 16), (100, 1, 4), (1000, 0, 0)]
    {
        let (mut holes, mut passed, mut max) = (0, 0, 0);
        for (_, whole) in files() {
            let (first, picture) = (coded_at(&whole), shown(&whole));
            let places = whole.len().saturating_sub(2 + hole + first);
            for at in (first..first + places).step_by((places / PLACES).max(1)) {
                holes += 1;
                let file = [&whole[..at], &whole[at + hole..]].concat();
                if decoded(&file).is_ok() {
                    passed += 1;
                    max = max.max(changed_blocks([&picture, &shown(&file)]));
                }
            }
        }
        println!("{passed} of {holes} holes of {hole} bytes pass; {max} blocks at most changed");
        assert!(100 * passed <= passing * holes, "{passed} of {holes} holes of {hole} bytes pass");
        assert!(max <= around, "a hole of {hole} bytes changed {max} blocks");
    }
}

#[test]
fn a_missing_restart_interval_is_detected_by_the_markers() {
    let whole = files().into_iter().find(|(name, _)| name == "grey-restarts.jpg").unwrap().1;
    let marker = |number: u8| whole.windows(2).position(|w| w == [0xff, 0xd0 + number]).unwrap();
    let file = [&whole[..marker(1)], &whole[marker(2)..]].concat();
    let problem = decoded(&file).err().unwrap();
    let cause = "bytes are missing in it: restart marker 2 where 1 was to come";
    assert!(problem.contains(cause), "{problem}");
}
