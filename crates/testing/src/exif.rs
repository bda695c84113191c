//! Makes pictures that viewers turn, by their Exif data.

/// The bytes of a JPEG file with Exif data of this orientation, from 1 (upright) to 8.
pub fn with_exif_orientation(jpeg: &[u8], orientation: u8) -> Vec<u8> {
    let exif = b"\xff\xe1\0\x22Exif\0\0MM\0\x2a\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0";
    // They stand after the mark of the file's beginning.
    let (start, rest) = jpeg.split_at(jpeg.len().min(2));
    [start, exif, &[orientation, 0, 0, 0, 0, 0, 0], rest].concat()
}
