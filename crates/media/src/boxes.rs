//! The boxes of an MP4 file (ISO/IEC 14496-12, 4.2), looked at before a parser reads them that asks for as much memory as they say.

use std::io::{Error, ErrorKind, Read, Result, Seek, SeekFrom};
use std::ops::Range;

/// Boxes of boxes on the way to those whose sizes the parser believes.
const CONTAINERS: [&[u8; 4]; 4] = [b"moov", b"trak", b"udta", b"meta"];
/// Maximum number of boxes within each other and in all.
const MAX_DEPTH: usize = 8;
const MAX_BOXES: usize = 100_000;

/// Refuses a file of `size` bytes with a box that reaches beyond the one it is in, and leaves `file` at its beginning.
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
        let Some(fewer) = left.checked_sub(1).filter(|_| depth < MAX_DEPTH) else {
            return damaged("it has too many boxes");
        };
        *left = fewer;
        file.seek(SeekFrom::Start(at))?;
        let [size, kind] = read_words(file)?;
        let (header, size) = match u32::from_be_bytes(size) {
            0 => (8, within.end - at),
            1 => (
                16,
                read_words(file).map(|[high, low]| {
                    u64::from(u32::from_be_bytes(high)) << 32 | u64::from(u32::from_be_bytes(low))
                })?,
            ),
            size => (8, u64::from(size)),
        };
        if size < header || size > within.end - at {
            return damaged("a box reaches beyond the one it is in");
        }
        if CONTAINERS.contains(&&kind) {
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
    Ok(())
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
        assert!(!is_sound(&boxed(b"free", &[]).repeat(MAX_BOXES + 1)));
    }

    #[test]
    fn what_made_the_parser_ask_for_exabytes_is_refused() {
        assert!(!is_sound(include_bytes!("../../../fuzz/corpus/mp4/meta_of_exabytes.mp4")));
    }
}
