//! Checks the boxes of an MP4 file (ISO/IEC 14496-12, 4.2) before a parser reads them that allocates the memory that they
//! state.

use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::ops::Range;

/// Boxes of boxes on the way to those whose sizes the parser uses unchecked.
const CONTAINERS: [&[u8; 4]; 4] = [b"moov", b"trak", b"udta", b"meta"];
/// Maximum number of boxes within each other, and of those that are within others.
const MAX_DEPTH: usize = 8;
const MAX_BOXES: usize = 100_000;

/// Refuses a file of `size` bytes with a box that reaches beyond the one it is in, or does not end with its last one, and leaves
/// `file` at its beginning. The last box of a file may be cut, as of a recording that was interrupted.
///
/// # Errors
/// When there is one, when there are too many boxes, or when the file cannot be read.
pub(crate) fn check(file: &mut (impl Read + Seek), size: u64) -> Result<()> {
    let mut left = MAX_BOXES;
    check_within(file, 0..size, 0, &mut left)?;
    file.rewind()
}

fn check_within(
    file: &mut (impl Read + Seek),
    within: Range<u64>,
    depth: usize,
    left: &mut usize,
) -> Result<()> {
    let damaged = |what: &str| Err(Error::new(ErrorKind::InvalidData, what));
    let mut at = within.start;
    // Fewer bytes than a header's are no box.
    while at + 8 <= within.end {
        if depth > 0 {
            let Some(fewer) = left.checked_sub(1).filter(|_| depth < MAX_DEPTH) else {
                return damaged("it has too many boxes");
            };
            *left = fewer;
        }
        file.seek(SeekFrom::Start(at))?;
        let [size, kind] = read_words(file)?;
        let (header, size) = match u32::from_be_bytes(size) {
            // Up to the end of the file.
            0 if depth == 0 => (8, within.end - at),
            1 => (
                16,
                read_words(file).map(|[high, low]| {
                    u64::from(u32::from_be_bytes(high)) << 32 | u64::from(u32::from_be_bytes(low))
                })?,
            ),
            size => (8, u64::from(size)),
        };
        let is_container = CONTAINERS.contains(&&kind);
        if size > within.end - at && depth == 0 && !is_container {
            return Ok(());
        }
        if size < header || size > within.end - at {
            return damaged("a box reaches beyond the one it is in");
        }
        if is_container {
            let mut content = at + header..at + size;
            // Most files have a version before the boxes of this one.
            if &kind == b"meta" && content.end - content.start >= 4 {
                let [version, _] = read_words(file).unwrap_or_default();
                content.start += if version == [0; 4] { 4 } else { 0 };
            }
            check_within(file, content, depth + 1, left)?;
        }
        at += size;
    }
    // The parser would read the remaining bytes as the beginning of a box.
    if depth > 0 && at != within.end {
        damaged("a box does not end with its last one")
    } else {
        Ok(())
    }
}

fn read_words(file: &mut impl Read) -> Result<[[u8; 4]; 2]> {
    let mut words = [[0; 4]; 2];
    file.read_exact(words.as_flattened_mut())?;
    Ok(words)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    fn boxed(kind: &[u8; 4], content: &[u8]) -> Vec<u8> {
        [&(content.len() as u32 + 8).to_be_bytes(), kind.as_slice(), content].concat()
    }

    fn is_sound(bytes: &[u8]) -> bool {
        check(&mut Cursor::new(bytes), bytes.len() as u64).is_ok()
    }

    #[test]
    fn boxes_end_within_each_other() {
        let inner = boxed(b"hdlr", &[1; 12]);
        let meta = boxed(b"meta", &[&[0; 4], inner.as_slice()].concat());
        let file = [boxed(b"ftyp", &[0; 4]), boxed(b"moov", &boxed(b"udta", &meta))].concat();
        assert!(is_sound(&file) && is_sound(&[]) && is_sound(&[0; 7]));
        // The size of `hdlr`, and one of 64 bits.
        let at = file.len() - inner.len();
        for size in [[0, 0, 0, 21], [0x7f, 0xff, 0xff, 0xff], [0, 0, 0, 3], [0, 0, 0, 1]] {
            let mut damaged = file.clone();
            damaged[at..at + 4].copy_from_slice(&size);
            assert!(!is_sound(&damaged), "{size:?}");
        }
        let deep = (0..MAX_DEPTH).fold(Vec::new(), |content, _| boxed(b"moov", &content));
        assert!(is_sound(&deep) && !is_sound(&boxed(b"moov", &boxed(b"moov", &deep))));
        let many = boxed(b"free", &[]).repeat(MAX_BOXES + 1);
        assert!(is_sound(&many) && !is_sound(&boxed(b"moov", &many)));
        // Surplus bytes, and a last box that is cut.
        let meta = boxed(b"meta", &[&[0; 4], inner.as_slice(), &[0, 0, 0, 1]].concat());
        let file = boxed(b"moov", &boxed(b"udta", &[meta, boxed(b"free", &[])].concat()));
        assert!(!is_sound(&file));
        assert!(is_sound(&boxed(b"mdat", &[1; 40])[..20]));
    }

    #[test]
    fn a_file_that_made_the_parser_allocate_exabytes_is_refused() {
        assert!(!is_sound(include_bytes!("../../../fuzz/corpus/mp4/meta_of_exabytes.mp4")));
    }
}
