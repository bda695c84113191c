//! Finds JPEG files in a stream of bytes: where one starts (SOI) and where it ends (EOI), and its segments, after ISO/IEC
//! 10918-1, Annex B.

/// Start-of-image marker.
const SOI: [u8; 2] = [0xff, 0xd8];
/// End-of-image marker.
const EOI: [u8; 2] = [0xff, 0xd9];
/// Second byte of the marker of a frame header: baseline sequential, coded by Huffman's method.
pub(crate) const SOF_BASELINE: u8 = 0xc0;
/// The same for an extended sequential frame.
pub(crate) const SOF_EXTENDED: u8 = 0xc1;
/// Second byte of the marker of Huffman tables.
pub(crate) const DHT: u8 = 0xc4;
/// Second byte of the marker of a restart interval's length.
pub(crate) const DRI: u8 = 0xdd;
/// Second byte of the marker of a scan header, which coded data follow.
pub(crate) const SOS: u8 = 0xda;

/// True for bytes that begin as a JPEG file does.
pub(crate) fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&SOI)
}

/// Length of the JPEG file at the start of `bytes`, to its EOI marker; `None` when there is none.
pub(crate) fn jpeg_len(bytes: &[u8]) -> Option<usize> {
    match end_of_image(bytes, &mut SOI.len())? {
        End::Complete(len) => Some(len),
        End::Cut(_) => None,
    }
}

/// The next JPEG file in `bytes`, at or after `at`, which moves behind it. A file whose segments do not lead
/// to an EOI marker ends at the SOI marker of the next one, where EOI and SOI follow each other, or with the stream.
pub(crate) fn next_jpeg<'a>(bytes: &'a [u8], at: &mut usize) -> Option<&'a [u8]> {
    let rest = bytes.get(*at..)?;
    let start = rest.windows(3).position(|w| w == [SOI[0], SOI[1], 0xff])?;
    let file = rest.get(start..)?;
    let boundary = [EOI, SOI].concat();
    let len = end_of_image(file, &mut SOI.len())
        .map(|(End::Complete(len) | End::Cut(len))| len)
        .or_else(|| Some(file.windows(4).position(|w| w == boundary)? + EOI.len()))
        .unwrap_or(file.len());
    *at += start + len;
    file.get(..len)
}

/// Where a file ends.
enum End {
    /// Behind its EOI marker.
    Complete(usize),
    /// Before the SOI marker of the next file: the rest of this one is missing.
    Cut(usize),
}

/// Follows the segments from `at`, a place between segments or in coded data, to the end of the file.
/// Where bytes are missing, `at` is the position to continue from once there are more.
fn end_of_image(bytes: &[u8], at: &mut usize) -> Option<End> {
    loop {
        let ahead = bytes.get(*at..)?;
        let Some(next) = ahead.iter().position(|byte| *byte == 0xff) else {
            *at = bytes.len();
            return None;
        };
        *at += next;
        let code = *at + 1;
        match bytes.get(code)? {
            // A fill byte may be the first byte of a marker itself.
            0xff => *at = code,
            // No file has a second SOI marker here, except that some repeat their first one.
            0xd8 if *at > SOI.len() => return Some(End::Cut(*at)),
            // A stuffed byte, TEM, RST0 to RST7 and SOI have no length.
            0x00 | 0x01 | 0xd0..=0xd8 => *at = code + 1,
            0xd9 => return Some(End::Complete(code + 1)),
            _ => {
                let &[high, low] = bytes.get(code + 1..code + 3)? else { return None };
                *at = code + 1 + usize::from(u16::from_be_bytes([high, low])).max(2);
            }
        }
    }
}

/// A segment of a JPEG file.
pub(crate) struct Segment<'a> {
    /// Second byte of its marker.
    pub(crate) code: u8,
    /// Where its marker begins.
    pub(crate) at: usize,
    /// The bytes after its length.
    pub(crate) parameters: &'a [u8],
}

/// The segments of the JPEG file at the start of `bytes`, up to the header of its first scan.
pub(crate) fn segments(bytes: &[u8]) -> impl Iterator<Item = Segment<'_>> {
    let mut next = is_jpeg(bytes).then_some(SOI.len());
    std::iter::from_fn(move || {
        let (segment, end) = next_segment(bytes, next?)?;
        next = (segment.code != SOS).then_some(end);
        Some(segment)
    })
}

/// The first segment at or behind `at`, a place between segments, and where it ends.
fn next_segment(bytes: &[u8], mut at: usize) -> Option<(Segment<'_>, usize)> {
    loop {
        at += bytes.get(at..)?.iter().position(|byte| *byte == 0xff)?;
        let code = *bytes.get(at + 1)?;
        match code {
            // A fill byte may be the first byte of a marker itself.
            0xff => at += 1,
            0x00 | 0x01 | 0xd0..=0xd8 => at += 2,
            0xd9 => return None,
            _ => {
                let length = bytes.get(at + 2..)?.first_chunk()?;
                let end = at + 2 + usize::from(u16::from_be_bytes(*length));
                let parameters = bytes.get(at + 4..end)?;
                return Some((Segment { code, at, parameters }, end));
            }
        }
    }
}

/// Takes JPEG files out of a stream that comes in pieces of any size.
#[derive(Debug, Default)]
pub struct JpegScanner {
    /// The file so far; before its start only a byte that may be the first of an SOI marker.
    file: Vec<u8>,
    /// Where to look for the next marker.
    at: usize,
    is_complete: bool,
    /// Whether the first byte of the next file's SOI marker was taken.
    has_next_begun: bool,
}

impl JpegScanner {
    /// Takes bytes up to the next event, which is the end of an SOI marker or of a file, and returns
    /// how many it took. A file ends with its EOI marker or, where that is missing, before the SOI marker of the next file. After its
    /// end the scanner takes nothing until [`Self::take`].
    pub fn push(&mut self, bytes: &[u8]) -> usize {
        if self.is_complete {
            return 0;
        }
        if self.has_started() {
            let before = self.file.len();
            self.file.extend_from_slice(bytes);
            let end = match end_of_image(&self.file, &mut self.at) {
                Some(End::Complete(end)) => end,
                Some(End::Cut(end)) => {
                    self.has_next_begun = end < before;
                    end
                }
                None => return bytes.len(),
            };
            self.is_complete = true;
            self.file.truncate(end);
            return end.saturating_sub(before);
        }
        for (taken, byte) in bytes.iter().enumerate() {
            let follows_ff = self.file.pop() == Some(SOI[0]);
            if follows_ff && *byte == SOI[1] {
                self.file.extend(SOI);
                self.at = SOI.len();
                return taken + 1;
            }
            if *byte == SOI[0] {
                self.file.push(*byte);
            }
        }
        bytes.len()
    }

    /// True between an SOI marker and [`Self::take`].
    pub fn has_started(&self) -> bool {
        self.file.len() >= SOI.len()
    }

    /// True once the file has its EOI marker, or the next one has begun.
    pub fn is_complete(&self) -> bool {
        self.is_complete
    }

    /// Bytes of the file so far.
    pub fn file_len(&self) -> usize {
        self.file.len()
    }

    /// The file, as far as it has come; the scanner begins again.
    pub fn take(&mut self) -> Vec<u8> {
        let Self { file, has_next_begun, .. } = std::mem::take(self);
        if has_next_begun {
            self.file.push(SOI[0]);
        }
        file
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// SOI, a comment that holds EOI and SOI, a scan with a stuffed byte and a restart marker, EOI.
    const FILE: &[u8] = &[
        0xff, 0xd8, 0xff, 0xff, 0xfe, 0, 6, 0xff, 0xd9, 0xff, 0xd8, 0xff, 0xda, 0, 2, 7, 0xff, 0,
        8, 0xff, 0xd3, 9, 0xff, 0xd9,
    ];

    #[test]
    fn the_length_of_a_file_is_found() {
        assert_eq!(jpeg_len(FILE), Some(FILE.len()));
        assert_eq!(jpeg_len(&[FILE, b"more"].concat()), Some(FILE.len()));
        for len in 0..FILE.len() {
            assert_eq!(jpeg_len(&FILE[..len]), None, "{len}");
        }
    }

    #[test]
    fn the_segments_of_a_file_end_with_its_scan_header() {
        let found =
            |file| segments(file).map(|it| (it.code, it.at, it.parameters)).collect::<Vec<_>>();
        let comment = (0xfe, 3, &FILE[7..11]);
        assert_eq!(found(FILE), [comment, (SOS, 11, &[])]);
        assert_eq!(found(&FILE[..14]), [comment]);
        assert_eq!(found(&FILE[..10]), []);
        assert_eq!(found(&FILE[1..]), []);
    }

    #[test]
    fn files_are_found_in_pieces_of_any_size() {
        let stream = [b"text\xff", FILE, b"\r\n\xff\xff", FILE, FILE, b"\xff"].concat();
        for size in 1..stream.len() {
            let mut scanner = JpegScanner::default();
            let mut files = 0;
            for mut piece in stream.chunks(size) {
                while !piece.is_empty() {
                    let taken = scanner.push(piece);
                    piece = &piece[taken..];
                    if scanner.is_complete() {
                        assert_eq!(scanner.take(), FILE, "pieces of {size}");
                        files += 1;
                    }
                }
            }
            assert_eq!((files, scanner.has_started()), (3, false), "pieces of {size}");
        }
    }

    #[test]
    fn the_file_after_one_that_is_cut_in_its_coded_data_is_complete() {
        // In the coded data, behind the first byte of a marker, and within the scan.
        for len in [16, 17, FILE.len() - 3] {
            let cut = &FILE[..len];
            let stream = [cut, FILE, cut, FILE].concat();
            for size in 1..stream.len() {
                let mut scanner = JpegScanner::default();
                let mut files = Vec::new();
                for mut piece in stream.chunks(size) {
                    while !piece.is_empty() {
                        let taken = scanner.push(piece);
                        piece = &piece[taken..];
                        if scanner.is_complete() {
                            files.push(scanner.take());
                        }
                    }
                }
                assert_eq!(files, [cut, FILE, cut, FILE], "cut to {len} bytes, pieces of {size}");
            }
            let mut at = 0;
            assert_eq!(next_jpeg(&stream, &mut at), Some(cut));
            assert_eq!(next_jpeg(&stream, &mut at), Some(FILE));
            assert_eq!(jpeg_len(&stream), None, "cut to {len} bytes");
        }
        // A repeated SOI marker belongs to its file.
        let repeated = [&SOI, FILE].concat();
        assert_eq!(jpeg_len(&repeated), Some(repeated.len()));
    }

    #[test]
    fn a_cut_file_in_a_stream_does_not_take_the_next_one_with_it() {
        // The comment's length leads beyond the end.
        let mut cut = FILE.to_vec();
        cut[5] = 0xff;
        let (stream, mut at) = ([b"x", cut.as_slice(), FILE].concat(), 0);
        assert_eq!(next_jpeg(&stream, &mut at), Some(&cut[..9]));
        assert_eq!(next_jpeg(&stream, &mut at), Some(&cut[9..]));
        assert_eq!(next_jpeg(&stream, &mut at), Some(FILE));
        assert_eq!(next_jpeg(&stream, &mut at), None);
    }
}
