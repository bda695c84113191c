//! Reads image files (PNG and JPEG): found in folders in order, decoded to 8-bit grey or to a frame's samples as they are
//! stored, within a limit of pixels, and refused when damaged.

use std::io::Cursor;
use std::path::{Path, PathBuf};

use ::image::metadata::Orientation;
use ::image::{ColorType, DynamicImage, ImageDecoder, ImageReader, Limits};
use imaging::{BayerPattern, Converter, GrayImage, GrayView, SampleFormat};

use crate::contained::contained;
use crate::huffman::with_tables;
use crate::jpeg::{is_jpeg, jpeg_len};
use crate::scan::check_scan;

/// Default limit for the pixels of an image.
pub const DEFAULT_MAX_PIXELS: u64 = 100_000_000;

/// Maximum depth of nested folders.
const MAX_FOLDER_DEPTH: usize = 16;

/// Maximum bytes of a file beyond its pixels: thumbnails, colour profiles and comments.
const MAX_METADATA_BYTES: u64 = 64 << 20;

/// Why an image was not read, and the remedy.
#[derive(Debug, thiserror::Error)]
pub enum ImageError {
    /// The system does not open a file or folder.
    #[error("{path:?} cannot be read: {cause}; check the path and its permissions")]
    Unreadable {
        /// The file or folder.
        path: PathBuf,
        /// The system's reason.
        cause: std::io::Error,
    },
    /// A pipe, device or folder instead of a file.
    #[error("{path:?} is not a file")]
    NotAFile {
        /// Its path.
        path: PathBuf,
    },
    /// A folder without images.
    #[error("the folder {path:?} holds no images; their names end in {extensions}")]
    EmptyFolder {
        /// The folder.
        path: PathBuf,
        /// The file extensions of images.
        extensions: String,
    },
    /// A file without bytes.
    #[error("{path:?} is empty; was it still being written, or was the disk full?")]
    Empty {
        /// The file.
        path: PathBuf,
    },
    /// Bytes that are neither PNG nor JPEG.
    #[error("{path:?} is neither a PNG nor a JPEG image; convert it to one of them")]
    Format {
        /// The file.
        path: PathBuf,
    },
    /// An image larger than the limit.
    #[error(
        "{path:?} has {width} x {height} pixels; the limit is {max_pixels} pixels ({megapixels} megapixels), and {edge} for an edge; make it smaller",
        megapixels = *max_pixels as f64 / 1e6,
        edge = GrayView::MAX_EDGE_PX
    )]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its width in pixels.
        width: u32,
        /// Its height in pixels.
        height: u32,
        /// The limit.
        max_pixels: u64,
    },
    /// A file larger than an image of the allowed size can be.
    #[error("{path:?} has {len} bytes, more than an image of the allowed size can have")]
    TooLong {
        /// The file.
        path: PathBuf,
        /// Its length in bytes.
        len: u64,
    },
    /// A JPEG file without its end-of-image marker.
    #[error("{path:?} ends in the middle of the image; copy or record it again")]
    Cut {
        /// The file.
        path: PathBuf,
    },
    /// A colour image where raw samples behind a Bayer pattern were expected.
    #[error("{path:?} is a colour image, not raw samples; leave the Bayer pattern out")]
    NotRaw {
        /// The file.
        path: PathBuf,
    },
    /// Bytes that cannot be decoded.
    #[error("{path:?} is damaged or cut short: {cause}; copy or record it again")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// The decoder's reason.
        cause: String,
    },
}

/// File extensions of images.
pub const IMAGE_EXTENSIONS: &[&str] = &["png", "jpg", "jpeg"];

/// File extensions of images of other formats, which are not read.
pub const OTHER_IMAGE_EXTENSIONS: &[&str] = &[
    "arw", "avif", "bmp", "cr2", "cr3", "dng", "exr", "gif", "heic", "heif", "jp2", "jxl", "nef",
    "orf", "pbm", "pgm", "pnm", "ppm", "raf", "raw", "rw2", "tga", "tif", "tiff", "webp",
];

/// The images at a path: the file itself, or those in a folder and its subfolders, sorted by path. The files
/// are not opened.
///
/// # Errors
/// [`ImageError`] for a folder that cannot be listed or holds no images.
pub fn images_in(path: &Path) -> Result<Vec<PathBuf>, ImageError> {
    files_in(path, &[IMAGE_EXTENSIONS])
}

/// Like [`images_in`], for files with any of these extensions.
///
/// # Errors
/// As [`images_in`].
pub fn files_in(path: &Path, extensions: &[&[&str]]) -> Result<Vec<PathBuf>, ImageError> {
    if !path.is_dir() {
        return Ok(vec![path.to_owned()]);
    }
    let extensions = extensions.concat();
    let mut files = Vec::new();
    collect(path, MAX_FOLDER_DEPTH, &extensions, &mut files)?;
    if files.is_empty() {
        let extensions =
            extensions.iter().map(|end| format!(".{end}")).collect::<Vec<_>>().join(", ");
        return Err(ImageError::EmptyFolder { path: path.to_owned(), extensions });
    }
    files.sort_unstable();
    Ok(files)
}

fn collect(
    folder: &Path,
    depth: usize,
    extensions: &[&str],
    files: &mut Vec<PathBuf>,
) -> Result<(), ImageError> {
    let unreadable = |cause| ImageError::Unreadable { path: folder.to_owned(), cause };
    for entry in std::fs::read_dir(folder).map_err(unreadable)? {
        let entry = entry.map_err(unreadable)?;
        let path = entry.path();
        if entry.file_name().as_encoded_bytes().starts_with(b".") {
            continue;
        }
        // Links to folders are not followed: they may form a circle.
        if entry.file_type().map_err(unreadable)?.is_dir() {
            if depth > 0 {
                collect(&path, depth - 1, extensions, files)?;
            }
        } else if has_extension(&path, extensions) {
            files.push(path);
        }
    }
    Ok(())
}

/// True when a file has one of these extensions, in upper or lower case.
pub(crate) fn has_extension(path: &Path, extensions: &[&str]) -> bool {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    extensions.iter().any(|known| extension.eq_ignore_ascii_case(known))
}

/// An image file in grey.
#[derive(Clone, Debug)]
pub struct StillImage {
    /// The image as it is stored.
    pub grey: GrayImage,
    /// How its Exif data want it turned to be looked at, from 2 to 8; `None` where it is upright as it is stored.
    pub exif_orientation: Option<u8>,
}

impl From<GrayImage> for StillImage {
    fn from(grey: GrayImage) -> Self {
        Self { grey, exif_orientation: None }
    }
}

/// Reads an image file (PNG or JPEG) in grey, as it is stored. It is not turned by Exif's orientation, as a camera's
/// calibration is of the sensor's pixels. Colours are weighted by ITU-R BT.601, 16-bit grey is scaled to the range it uses,
/// transparent pixels are blended with white. With a `bayer` pattern, an image of one channel is a sensor's raw samples.
///
/// # Errors
/// [`ImageError`] when the file cannot be read, is not a complete image, or has more than `max_pixels`.
pub fn read_image(
    path: &Path,
    max_pixels: u64,
    bayer: Option<BayerPattern>,
) -> Result<StillImage, ImageError> {
    read_image_bytes(path, &file_bytes(path, max_pixels)?, max_pixels, bayer)
}

/// As [`read_image`], from the bytes of a file; errors name `path`.
///
/// # Errors
/// As [`read_image`].
pub fn read_image_bytes(
    path: &Path,
    bytes: &[u8],
    max_pixels: u64,
    bayer: Option<BayerPattern>,
) -> Result<StillImage, ImageError> {
    let decoded = DecodedImage::decode(path, bytes, max_pixels)?;
    if bayer.is_some() && decoded.raw_bits().is_none() {
        return Err(ImageError::NotRaw { path: path.to_owned() });
    }
    Ok(StillImage { grey: decoded.grey(bayer), exif_orientation: decoded.exif_orientation() })
}

/// The grey image of [`read_image`], from the bytes of a file; errors name `path`.
///
/// # Errors
/// As [`read_image`].
pub fn decode_image(path: &Path, bytes: &[u8], max_pixels: u64) -> Result<GrayImage, ImageError> {
    Ok(DecodedImage::decode(path, bytes, max_pixels)?.grey(None))
}

/// Bytes of the frame that an image file becomes, read from its header.
pub fn frame_bytes(path: &Path, max_pixels: u64) -> Result<usize, ImageError> {
    let bytes = file_bytes(path, max_pixels)?;
    let read = || {
        let decoder = decoder(path, &bytes, max_pixels)?;
        let (width, height) = decoder.dimensions();
        let per_pixel = if decoder.color_type() == ColorType::L16 { 2 } else { 1 };
        Ok((width as usize).saturating_mul(height as usize).saturating_mul(per_pixel))
    };
    contained(read, |cause| ImageError::Damaged { path: path.to_owned(), cause: cause.to_owned() })
}

/// A decoded image, in the pixel format of its file.
pub struct DecodedImage {
    image: DynamicImage,
    orientation: Orientation,
}

impl DecodedImage {
    /// Reads and decodes a file.
    ///
    /// # Errors
    /// As [`read_image`].
    pub fn read(path: &Path, max_pixels: u64) -> Result<Self, ImageError> {
        Self::decode(path, &file_bytes(path, max_pixels)?, max_pixels)
    }

    /// Decodes the bytes of a file; errors name `path`.
    ///
    /// # Errors
    /// As [`read_image`].
    pub fn decode(path: &Path, bytes: &[u8], max_pixels: u64) -> Result<Self, ImageError> {
        contained(
            || Self::decode_unchecked(path, bytes, max_pixels),
            |cause| ImageError::Damaged { path: path.to_owned(), cause: cause.to_owned() },
        )
    }

    /// As [`DecodedImage::decode`]; panics where the decoder does.
    fn decode_unchecked(path: &Path, bytes: &[u8], max_pixels: u64) -> Result<Self, ImageError> {
        // The decoder uses the standard tables only behind the segment that the files of an AVI video have.
        let bytes = &*with_tables(bytes);
        let mut decoder = decoder(path, bytes, max_pixels)?;
        // The decoder fills the missing part of a JPEG with grey.
        if is_jpeg(bytes) && jpeg_len(bytes).is_none() {
            return Err(ImageError::Cut { path: path.to_owned() });
        }
        let damaged = |cause: &dyn std::fmt::Display| ImageError::Damaged {
            path: path.to_owned(),
            cause: cause.to_string(),
        };
        // The decoder takes the blocks behind a hole for those within it.
        check_scan(bytes).map_err(|fault| damaged(&fault))?;
        let orientation = decoder.orientation().map_err(|cause| damaged(&cause))?;
        let image = DynamicImage::from_decoder(decoder).map_err(|cause| damaged(&cause))?;
        Ok(Self { image, orientation })
    }

    /// How its Exif data want it turned to be looked at, which is not done; `None` where it is upright.
    pub fn exif_orientation(&self) -> Option<u8> {
        let is_turned = self.orientation != Orientation::NoTransforms;
        is_turned.then(|| self.orientation.to_exif())
    }

    /// Width in pixels.
    pub fn width(&self) -> usize {
        self.image.width() as usize
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.image.height() as usize
    }

    /// Bits of a sample, of an image that can be raw: grey without alpha.
    pub fn raw_bits(&self) -> Option<u32> {
        match &self.image {
            DynamicImage::ImageLuma8(_) => Some(8),
            DynamicImage::ImageLuma16(_) => Some(16),
            _ => None,
        }
    }

    /// The image in 8-bit grey.
    pub fn grey(&self, bayer: Option<BayerPattern>) -> GrayImage {
        let (width, height) = (self.width(), self.height());
        let black = || GrayImage::filled(width, height, 0);
        match self.raw_bits() {
            Some(bits) if bits > 8 || bayer.is_some() => {
                let mut samples = vec![0; width * height * bits.div_ceil(8) as usize];
                self.write_samples(&mut samples);
                let format = SampleFormat { bits, bayer };
                // A decoded image has a valid size.
                samples_to_grey(&samples, width, height, format).unwrap_or_else(black)
            }
            _ => {
                let mut image = black();
                self.write_grey(image.pixels_mut());
                image
            }
        }
    }

    /// Writes the samples unchanged, row by row, into a buffer of width times height times bytes per sample;
    /// 16-bit samples little-endian. Images that are not raw are written in grey.
    pub fn write_samples(&self, out: &mut [u8]) {
        match &self.image {
            DynamicImage::ImageLuma16(image) => {
                let (pairs, _) = out.as_chunks_mut::<2>();
                for (pair, sample) in pairs.iter_mut().zip(image.iter()) {
                    *pair = sample.to_le_bytes();
                }
            }
            _ => self.write_grey(out),
        }
    }

    /// Writes the pixels in 8-bit grey, row by row, into a buffer of width times height bytes.
    pub fn write_grey(&self, out: &mut [u8]) {
        match &self.image {
            DynamicImage::ImageLuma8(image) => fill(out, image, |[v]| v),
            DynamicImage::ImageLumaA8(image) => fill(out, image, |[v, a]| blend_with_white(v, a)),
            DynamicImage::ImageRgb8(image) => fill(out, image, grey),
            DynamicImage::ImageRgba8(image) => {
                fill(out, image, |[r, g, b, a]| blend_with_white(grey([r, g, b]), a));
            }
            DynamicImage::ImageLuma16(image) => fill(out, image, |[v]| to_8_bits(v)),
            DynamicImage::ImageLumaA16(image) => {
                fill(out, image, |[v, a]| blend_with_white(to_8_bits(v), to_8_bits(a)));
            }
            DynamicImage::ImageRgb16(image) => fill(out, image, grey_of_16_bits),
            DynamicImage::ImageRgba16(image) => fill(out, image, |[r, g, b, a]| {
                blend_with_white(grey_of_16_bits([r, g, b]), to_8_bits(a))
            }),
            // PNG and JPEG have no other pixel formats.
            other => fill(out, &other.to_rgb8(), grey),
        }
    }
}

/// Raw samples in 8-bit grey; `None` when their number does not match the size.
pub fn samples_to_grey(
    samples: &[u8],
    width: usize,
    height: usize,
    format: SampleFormat,
) -> Option<GrayImage> {
    let mut image = GrayImage::filled(width, height, 0);
    let mut converter = Converter::default();
    let view = converter.convert(samples, width, height, format).ok()?;
    for y in 0..height {
        image.row_mut(y).copy_from_slice(view.row(y));
    }
    Some(image)
}

fn fill<T: Copy, const N: usize>(out: &mut [u8], samples: &[T], grey: impl Fn([T; N]) -> u8) {
    let (pixels, _) = samples.as_chunks::<N>();
    for (out, pixel) in out.iter_mut().zip(pixels) {
        *out = grey(*pixel);
    }
}

/// Luma of ITU-R BT.601.
fn luma(rgb: [u32; 3]) -> u32 {
    let [r, g, b] = rgb;
    (299 * r + 587 * g + 114 * b + 500) / 1000
}

fn grey(rgb: [u8; 3]) -> u8 {
    luma(rgb.map(u32::from)) as u8
}

fn grey_of_16_bits(rgb: [u16; 3]) -> u8 {
    to_8_bits(luma(rgb.map(u32::from)) as u16)
}

fn to_8_bits(value: u16) -> u8 {
    ((u32::from(value) * 255 + 32_767) / 65_535) as u8
}

fn blend_with_white(grey: u8, alpha: u8) -> u8 {
    let (grey, alpha) = (u32::from(grey), u32::from(alpha));
    ((grey * alpha + 255 * (255 - alpha) + 127) / 255) as u8
}

fn file_bytes(path: &Path, max_pixels: u64) -> Result<Vec<u8>, ImageError> {
    let unreadable = |cause| ImageError::Unreadable { path: path.to_owned(), cause };
    let metadata = std::fs::metadata(path).map_err(unreadable)?;
    // Opening a pipe would wait for its writer.
    if !metadata.is_file() {
        return Err(ImageError::NotAFile { path: path.to_owned() });
    }
    if metadata.len() > max_file_bytes(max_pixels) {
        return Err(ImageError::TooLong { path: path.to_owned(), len: metadata.len() });
    }
    std::fs::read(path).map_err(unreadable)
}

/// Maximum bytes of the file of an image of at most so many pixels.
pub fn max_file_bytes(max_pixels: u64) -> u64 {
    max_pixels.saturating_mul(8).saturating_add(MAX_METADATA_BYTES)
}

/// A decoder of an image whose size is within the limit.
fn decoder<'a>(
    path: &Path,
    bytes: &'a [u8],
    max_pixels: u64,
) -> Result<impl ImageDecoder + 'a, ImageError> {
    let damaged = |cause: &dyn std::fmt::Display| ImageError::Damaged {
        path: path.to_owned(),
        cause: cause.to_string(),
    };
    if bytes.is_empty() {
        return Err(ImageError::Empty { path: path.to_owned() });
    }
    let mut reader = ImageReader::new(Cursor::new(bytes))
        .with_guessed_format()
        .map_err(|cause| damaged(&cause))?;
    if reader.format().is_none() {
        return Err(ImageError::Format { path: path.to_owned() });
    }
    reader.no_limits();
    let mut decoder = reader.into_decoder().map_err(|cause| match cause {
        ::image::ImageError::Unsupported(_) => ImageError::Format { path: path.to_owned() },
        cause => damaged(&cause),
    })?;
    let (width, height) = decoder.dimensions();
    let edge = GrayView::MAX_EDGE_PX as u64;
    let pixels = u64::from(width) * u64::from(height);
    if pixels > max_pixels || u64::from(width.max(height)) > edge {
        return Err(ImageError::TooLarge { path: path.to_owned(), width, height, max_pixels });
    }
    if pixels == 0 {
        return Err(damaged(&format!("an image of {width} x {height} pixels")));
    }
    // The widest pixel format has 8 bytes, and a decoder may need twice that.
    let mut limits = Limits::no_limits();
    limits.max_alloc = Some(max_pixels.saturating_mul(16).saturating_add(MAX_METADATA_BYTES));
    decoder.set_limits(limits).map_err(|cause| damaged(&cause))?;
    Ok(decoder)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ::image::{ImageBuffer, ImageFormat, Luma, LumaA, Rgb, Rgba};

    fn bytes_of(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
        let mut bytes = Cursor::new(Vec::new());
        image.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    }

    fn read_bytes(bytes: &[u8], max_pixels: u64) -> Result<GrayImage, String> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), bytes).unwrap();
        read_image(file.path(), max_pixels, None).map(|it| it.grey).map_err(|e| e.to_string())
    }

    fn photo() -> DynamicImage {
        ImageBuffer::from_fn(64, 48, |x, y| Rgb([(x * 4) as u8, (y * 5) as u8, (x ^ y) as u8]))
            .into()
    }

    #[test]
    fn every_form_of_png_becomes_grey() {
        let check = |image: DynamicImage, expected: u8| {
            let read = read_bytes(&bytes_of(&image, ImageFormat::Png), 100).unwrap();
            assert_eq!((read.width(), read.height(), read.pixels()), (1, 1, &[expected][..]));
        };
        check(ImageBuffer::from_pixel(1, 1, Luma([77_u8])).into(), 77);
        check(ImageBuffer::from_pixel(1, 1, LumaA([77_u8, 255])).into(), 77);
        check(ImageBuffer::from_pixel(1, 1, LumaA([0_u8, 0])).into(), 255);
        // 0.299 * 200 + 0.587 * 100 + 0.114 * 50 = 124.2
        check(ImageBuffer::from_pixel(1, 1, Rgb([200_u8, 100, 50])).into(), 124);
        check(ImageBuffer::from_pixel(1, 1, Rgba([200_u8, 100, 50, 255])).into(), 124);
        check(ImageBuffer::from_pixel(1, 1, LumaA([77_u16 * 257, 65_535])).into(), 77);
        check(ImageBuffer::from_pixel(1, 1, Rgb([65_535_u16, 65_535, 65_535])).into(), 255);
        check(
            ImageBuffer::from_pixel(1, 1, Rgba([51_400_u16, 25_700, 12_850, 65_535])).into(),
            124,
        );
    }

    #[test]
    fn sixteen_bits_are_scaled_to_the_range_they_use() {
        // 12 bits in 16, as many cameras store them.
        let image: DynamicImage =
            ImageBuffer::from_fn(3, 1, |x, _| Luma([[100_u16, 2100, 4000][x as usize]])).into();
        let read = read_bytes(&bytes_of(&image, ImageFormat::Png), 100).unwrap();
        let far = read.pixels().iter().zip([0_u8, 131, 255]).map(|(a, b)| a.abs_diff(b)).max();
        assert!(far <= Some(2), "{:?}", read.pixels());
    }

    #[test]
    fn raw_samples_become_grey_and_a_colour_image_is_refused() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let read = |image: DynamicImage| {
            std::fs::write(file.path(), bytes_of(&image, ImageFormat::Png)).unwrap();
            let read = read_image(file.path(), 1000, Some(BayerPattern::Rggb));
            read.map(|it| it.grey).map_err(|e| e.to_string())
        };
        let samples = |x: u32, y: u32| [[60_u8, 120], [120, 40]][y as usize % 2][x as usize % 2];
        let grey = read(ImageBuffer::from_fn(8, 6, |x, y| Luma([samples(x, y)])).into()).unwrap();
        assert!(grey.pixels().iter().all(|pixel| *pixel == 120));
        let problem = read(ImageBuffer::from_pixel(8, 6, Rgb([1_u8, 2, 3])).into()).unwrap_err();
        assert!(problem.contains("is a colour image"), "{problem}");
    }

    #[test]
    fn a_jpeg_keeps_its_grey_levels() {
        let read = read_bytes(&bytes_of(&photo(), ImageFormat::Jpeg), DEFAULT_MAX_PIXELS).unwrap();
        let mut exact = vec![0; 64 * 48];
        DecodedImage { image: photo(), orientation: Orientation::NoTransforms }
            .write_grey(&mut exact);
        let error: u32 =
            read.pixels().iter().zip(&exact).map(|(a, b)| u32::from(a.abs_diff(*b))).sum();
        assert!(error / (64 * 48) < 6, "{error}");
    }

    #[test]
    fn an_image_is_as_the_sensor_saw_it_however_exif_would_turn_it() {
        let plain = bytes_of(&photo(), ImageFormat::Jpeg);
        let stored = read_bytes(&plain, DEFAULT_MAX_PIXELS).unwrap();
        let file = tempfile::NamedTempFile::new().unwrap();
        for orientation in 1..=8 {
            std::fs::write(file.path(), testing::with_exif_orientation(&plain, orientation))
                .unwrap();
            let read = read_image(file.path(), DEFAULT_MAX_PIXELS, None).unwrap();
            assert_eq!((read.grey.width(), read.grey.height()), (64, 48), "{orientation}");
            assert_eq!(read.grey.pixels(), stored.pixels(), "{orientation}");
            assert_eq!(read.exif_orientation, (orientation > 1).then_some(orientation));
        }
    }

    #[test]
    fn files_that_are_cut_anywhere_are_refused() {
        for format in [ImageFormat::Png, ImageFormat::Jpeg] {
            let whole = bytes_of(&photo(), format);
            assert!(read_bytes(&whole, DEFAULT_MAX_PIXELS).is_ok());
            // A PNG without its 12 last bytes has all its pixels.
            for len in (0..whole.len() - 12).step_by(7) {
                assert!(
                    read_bytes(&whole[..len], DEFAULT_MAX_PIXELS).is_err(),
                    "{format:?} cut at {len}"
                );
            }
        }
    }

    #[test]
    fn damaged_files_never_stop_the_reader() {
        for format in [ImageFormat::Png, ImageFormat::Jpeg] {
            let whole = bytes_of(&photo(), format);
            for at in (0..whole.len()).step_by(11) {
                let mut damaged = whole.clone();
                damaged[at] ^= 0x5a;
                // Some positions are unimportant: the test is that there is an answer.
                drop(read_bytes(&damaged, 100_000));
            }
        }
    }

    #[test]
    fn an_image_is_measured_before_it_is_decoded() {
        let problem = |width, height, max| {
            let image: DynamicImage = ImageBuffer::from_pixel(width, height, Luma([9_u8])).into();
            read_bytes(&bytes_of(&image, ImageFormat::Png), max).map(|i| i.width())
        };
        assert_eq!(problem(65_535, 1, DEFAULT_MAX_PIXELS), Ok(65_535));
        assert!(problem(65_536, 1, DEFAULT_MAX_PIXELS).unwrap_err().contains("65536 x 1 pixels"));
        assert!(problem(11, 10, 100).unwrap_err().contains("the limit is 100 pixels"));
        let large = ImageError::TooLarge {
            path: PathBuf::from("a.png"),
            width: 20_000,
            height: 10_000,
            max_pixels: DEFAULT_MAX_PIXELS,
        };
        assert!(large.to_string().contains("(100 megapixels)"), "{large}");
        // The header of a PNG of 65535 x 65535 pixels, without pixels.
        let small = bytes_of(&photo(), ImageFormat::Png);
        let header = png_of_size(&small, 65_535, 65_535);
        assert!(read_bytes(&header, DEFAULT_MAX_PIXELS).unwrap_err().contains("65535 x 65535"));
        let nothing = png_of_size(&small, 0, 0);
        assert!(read_bytes(&nothing, DEFAULT_MAX_PIXELS).is_err());
        // The same with a JPEG, whose size is in its frame header.
        let mut jpeg = bytes_of(&photo(), ImageFormat::Jpeg);
        let at = jpeg.windows(2).position(|w| w == [0xff, 0xc0]).unwrap();
        jpeg[at + 5..at + 9].copy_from_slice(&[0xff; 4]);
        assert!(read_bytes(&jpeg, DEFAULT_MAX_PIXELS).unwrap_err().contains("65535 x 65535"));
        jpeg[at + 5..at + 9].copy_from_slice(&[0; 4]);
        assert!(read_bytes(&jpeg, DEFAULT_MAX_PIXELS).is_err());
    }

    /// A PNG with another size in its header, and a correct checksum.
    fn png_of_size(png: &[u8], width: u32, height: u32) -> Vec<u8> {
        let mut png = png.to_vec();
        png[16..20].copy_from_slice(&width.to_be_bytes());
        png[20..24].copy_from_slice(&height.to_be_bytes());
        let mut crc = u32::MAX;
        for byte in &png[12..29] {
            crc ^= u32::from(*byte);
            for _ in 0..8 {
                crc = if crc & 1 == 1 { (crc >> 1) ^ 0xedb8_8320 } else { crc >> 1 };
            }
        }
        png[29..33].copy_from_slice(&(!crc).to_be_bytes());
        png
    }

    #[test]
    fn files_that_are_not_images_are_named() {
        let problem =
            |path: &Path| read_image(path, DEFAULT_MAX_PIXELS, None).unwrap_err().to_string();
        let folder = tempfile::tempdir().unwrap();
        assert!(problem(Path::new("no/such.png")).contains("no/such.png"));
        assert!(problem(folder.path()).contains("is not a file"));
        let text = folder.path().join("notes.png");
        std::fs::write(&text, "not an image").unwrap();
        assert!(problem(&text).contains("neither a PNG nor a JPEG"));
        std::fs::write(&text, "").unwrap();
        assert!(problem(&text).contains("is empty"), "{}", problem(&text));
        std::fs::write(&text, "GIF89a").unwrap();
        assert!(problem(&text).contains("neither a PNG nor a JPEG"), "{}", problem(&text));
    }

    #[test]
    fn folders_are_listed_recursively_and_sorted() {
        let folder = tempfile::tempdir().unwrap();
        let empty = images_in(folder.path()).unwrap_err().to_string();
        assert!(empty.contains("holds no images; their names end in .png, .jpg"), "{empty}");
        std::fs::create_dir(folder.path().join("b")).unwrap();
        for name in ["c.PNG", "a.jpeg", "b/2.jpg", "b/1.png", ".hidden.png", "notes.txt"] {
            std::fs::write(folder.path().join(name), []).unwrap();
        }
        let names: Vec<_> = images_in(folder.path())
            .unwrap()
            .iter()
            .map(|p| p.strip_prefix(folder.path()).unwrap().display().to_string())
            .collect();
        assert_eq!(names, ["a.jpeg", "b/1.png", "b/2.jpg", "c.PNG"]);
        assert_eq!(images_in(Path::new("any.bin")).unwrap(), [Path::new("any.bin")]);
    }
}
