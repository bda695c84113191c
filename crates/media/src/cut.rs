//! Recognises a bare stream of H.264 whose last picture is cut: such a stream does not state the sizes of its pictures.

use rust_h264::decoder::{Decoder, Frame};
use rust_h264::nal::{NalUnit, NalUnitType, parse_annex_b};

use crate::h264::Limits;

/// Bytes that are put behind the stream.
const APPENDED: [u8; 64] = [0xff; 64];

/// The number of the stream's last picture among `shown`, the last pictures that its decoder gave, if that picture is cut.
///
/// A decoder does not read beyond the end of a complete picture. It reads zeros where bytes are missing, without an error. The last picture is
/// therefore decoded again with other bytes behind it, from the last IDR picture, before which no later picture refers.
pub(crate) fn cut_picture(stream: &[u8], shown: &[Frame], max_pixels: u64) -> Option<usize> {
    let units = parse_annex_b(stream);
    let number_of =
        |frame: &Frame| shown.iter().rposition(|other| other.pic_order_cnt == frame.pic_order_cnt);
    let longer = last_picture(&units, &APPENDED, max_pixels);
    let same = longer.as_ref().and_then(|frame| Some((frame, shown.get(number_of(frame)?)?)));
    match same {
        Some((longer, shown)) if planes(longer) == planes(shown) => None,
        _ => number_of(&last_picture(&units, &[], max_pixels)?),
    }
}

/// Luma and chroma: the last bytes of a picture may be of its chroma only.
fn planes(frame: &Frame) -> [&[u8]; 3] {
    [&frame.y, &frame.u, &frame.v]
}

/// The last picture of a stream with `appended` behind its last unit; `None` if it is not decoded.
fn last_picture(units: &[NalUnit<'_>], appended: &[u8], max_pixels: u64) -> Option<Frame> {
    let is_slice = |unit: &NalUnit<'_>| {
        matches!(unit.nal_unit_type, NalUnitType::Slice | NalUnitType::SliceIdr)
    };
    let last = units.iter().rposition(is_slice)?;
    let begins = |unit: &NalUnit<'_>| {
        // The number of a picture's first block is 0, which is coded as one bit.
        let is_first = unit.rbsp.first().is_some_and(|byte| byte & 0x80 != 0);
        unit.nal_unit_type == NalUnitType::SliceIdr && is_first
    };
    let begin = units.iter().take(last + 1).rposition(begins).unwrap_or(0);
    let (mut decoder, mut limits) = (Decoder::new(), Limits::new(max_pixels));
    for (at, unit) in units.iter().enumerate().take(last + 1) {
        if at < begin && !matches!(unit.nal_unit_type, NalUnitType::Sps | NalUnitType::Pps) {
            continue;
        }
        let longer;
        let unit = if at == last {
            let mut rbsp = unit.rbsp.to_vec();
            // Zeros may pad a unit.
            rbsp.truncate(rbsp.iter().rposition(|byte| *byte != 0)? + 1);
            rbsp.extend(appended);
            longer = NalUnit { rbsp: rbsp.into(), ..*unit };
            &longer
        } else {
            unit
        };
        if limits.excess(unit).is_some() {
            return None;
        }
        decoder.decode_nal(unit).ok()?;
    }
    decoder.flush()
}
