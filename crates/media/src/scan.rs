//! Checks whether the coded data of a JPEG file are complete: it parses them block by block without decoding a pixel, after
//! ITU-T T.81, Annex F.2.2.
//!
//! Where bytes are missing, a decoder takes the blocks behind the hole for those within it: the rest of the picture is sharp, and
//! displaced. That there are fewer blocks than the picture has shows only in their number; or that there are more, where codes are
//! read out of step behind the hole. Holes of which neither is true leave all other blocks in their places, brighter or darker.
//! Judged is one scan of all components, coded sequentially by Huffman's method with 8 bits per sample, as cameras write it; all
//! else is left to the decoder.

use crate::jpeg::{DHT, DRI, SOF_BASELINE, SOF_EXTENDED, SOS, segments};

/// Coefficients of a block.
const BLOCK: u32 = 64;
/// Samples along an edge of a block.
const BLOCK_EDGE: u64 = 8;
/// Maximum number of components of a scan, and tables of a class.
const MAX_COMPONENTS: usize = 4;
/// Maximum number of bits of a code.
const MAX_CODE: usize = 16;
/// Bits that are looked up at once: longer codes are rare, and several short ones are skipped in one step.
const LOOKUP: usize = 11;
/// The step of a block's end: more than all coefficients.
const END_OF_BLOCK: u8 = 128;
/// First of the eight restart markers.
const RST0: u8 = 0xd0;

/// The error of the coded data.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub(crate) enum ScanFault {
    /// A marker, or the end of the file, comes before the last block.
    #[error("bytes are missing in it: its data end after {before} of {blocks} blocks")]
    Ended {
        /// Blocks that are there.
        before: u64,
        /// Blocks of the picture.
        blocks: u64,
    },
    /// Another restart marker than the next one.
    #[error("bytes are missing in it: restart marker {found} where {expected} was to come")]
    Restart {
        /// Its number.
        found: u8,
        /// The number of the next one.
        expected: u8,
    },
    /// A restart interval whose data continue behind its last block.
    #[error(
        "bytes are missing in it: restart marker {expected} was to come after {before} of {blocks} blocks"
    )]
    NoRestart {
        /// The number of the marker.
        expected: u8,
        /// Blocks before it.
        before: u64,
        /// Blocks of the picture.
        blocks: u64,
    },
    /// Further blocks behind the last one.
    #[error("bytes are missing in it: its data describe more than {blocks} blocks")]
    Beyond {
        /// Blocks of the picture.
        blocks: u64,
    },
    /// A block that no encoder writes.
    #[error(
        "bytes are missing or wrong in it: the codes of block {block} of {blocks} have no meaning"
    )]
    Code {
        /// Its number in the order of the data.
        block: u64,
        /// Blocks of the picture.
        blocks: u64,
    },
}

/// Walks the coded data of a JPEG file to the last block. Surplus bytes behind it that are no blocks are no fault: webcams send them.
///
/// # Errors
/// [`ScanFault`] where the data do not describe the picture's blocks.
pub(crate) fn check_scan(jpeg: &[u8]) -> Result<(), ScanFault> {
    Scan::of(jpeg).map_or(Ok(()), |scan| scan.walk())
}

/// Why the walk ends within a block.
enum Stop {
    /// The bits do.
    Ended,
    /// The codes are impossible.
    Code,
}

/// A component of the frame.
#[derive(Clone, Copy)]
struct Component {
    id: u8,
    /// Blocks of an MCU in a row, and rows of them.
    sampling: [u64; 2],
}

/// The contents of the frame header.
struct Frame {
    size: [u64; 2],
    components: [Option<Component>; MAX_COMPONENTS],
}

impl Frame {
    /// From a header's parameters; `None` for other than 8 bits per sample, and for a height that is given behind the scan.
    fn parse(parameters: &[u8]) -> Option<Self> {
        let (&[8, y0, y1, x0, x1, count], rest) = parameters.split_first_chunk()? else {
            return None;
        };
        let size = [[x0, x1], [y0, y1]].map(|edge| u64::from(u16::from_be_bytes(edge)));
        let (listed, surplus) = rest.as_chunks::<3>();
        if size.contains(&0) || listed.len() != usize::from(count) || !surplus.is_empty() {
            return None;
        }
        let mut components = [None; MAX_COMPONENTS];
        if listed.is_empty() || listed.len() > components.len() {
            return None;
        }
        for (component, [id, sampling, _]) in components.iter_mut().zip(listed) {
            let sampling = [sampling >> 4, sampling & 15].map(u64::from);
            if sampling.iter().any(|factor| !(1..=4).contains(factor)) {
                return None;
            }
            *component = Some(Component { id: *id, sampling });
        }
        Some(Self { size, components })
    }

    fn components(&self) -> impl Iterator<Item = &Component> {
        self.components.iter().flatten()
    }

    /// MCUs of a scan of all components. That of a single component is not interleaved: its MCU is one block for any sampling.
    fn mcus(&self) -> u64 {
        let [across, down] = self.mcus_by_axis();
        across * down
    }

    fn mcus_by_axis(&self) -> [u64; 2] {
        std::array::from_fn(|axis| self.size[axis].div_ceil(self.mcu_edge(axis)))
    }

    fn mcu_edge(&self, axis: usize) -> u64 {
        let of = |it: &Component| it.sampling.get(axis).copied();
        let max = self.components().filter_map(of).max().unwrap_or(1);
        if self.components().count() == 1 { BLOCK_EDGE } else { BLOCK_EDGE * max }
    }

    /// MCUs of a further row of 8 lines, where the picture's rows are odd: encoders in hardware may fill up 1080 lines to 1088.
    fn padding(&self) -> u64 {
        let [across, down] = self.mcus_by_axis();
        if self.mcu_edge(1) == BLOCK_EDGE && down % 2 == 1 { across } else { 0 }
    }

    /// Blocks of a component in an MCU of a scan of all components.
    fn blocks_of_mcu(&self, component: &Component) -> u64 {
        if self.components().count() == 1 { 1 } else { component.sampling.iter().product() }
    }
}

/// Tables of a class, by destination.
type Tables = [Option<Box<Table>>; MAX_COMPONENTS];

/// A Huffman table, for codes and the values behind them to be skipped.
struct Table {
    /// For each beginning of the data, without bits where its first code is longer or there is none.
    lookup: [Steps; 1 << LOOKUP],
    /// Bits of the first code of each beginning.
    lengths: [u8; 1 << LOOKUP],
    /// By length: the first code behind those of that length, filled up with zeros to the most bits.
    limits: [u32; MAX_CODE + 1],
    /// By length: the number that is added to a code for the index of its step, modulo 2^32.
    offsets: [u32; MAX_CODE + 1],
    /// Over each code, in their order.
    steps: [Step; 256],
}

/// The length of a code and the value behind it; no bits where there is no code.
#[derive(Clone, Copy, Default)]
struct Step {
    bits: u8,
    /// How far the place in the block moves on.
    moved: u8,
}

/// The step over the first code, and that over all that are known.
#[derive(Clone, Copy, Default)]
struct Steps {
    one: Step,
    all: Step,
}

impl Table {
    /// From the numbers of codes of each length and the steps of their symbols; `None` for more codes than there are.
    fn new(
        counts: &[u8; MAX_CODE],
        symbols: &[u8],
        step: impl Fn(u8) -> Option<Step>,
    ) -> Option<Box<Self>> {
        let mut table = Box::new(Self {
            lookup: [Steps::default(); 1 << LOOKUP],
            lengths: [0; 1 << LOOKUP],
            limits: [0; MAX_CODE + 1],
            offsets: [0; MAX_CODE + 1],
            steps: [Step::default(); 256],
        });
        let (mut code, mut place) = (0_u32, 0_u32);
        for (length, count) in (1..).zip(counts) {
            *table.offsets.get_mut(length)? = place.wrapping_sub(code);
            for _ in 0..*count {
                let Step { bits, moved } = step(*symbols.get(place as usize)?)?;
                let step = Step { bits: bits + length as u8, moved };
                *table.steps.get_mut(place as usize)? = step;
                if let Some(free) = LOOKUP.checked_sub(length) {
                    let begun = (code as usize) << free..((code as usize) + 1) << free;
                    table.lookup.get_mut(begun.clone())?.fill(Steps { one: step, all: step });
                    table.lengths.get_mut(begun)?.fill(length as u8);
                }
                (code, place) = (code + 1, place + 1);
            }
            if code > 1 << length {
                return None;
            }
            *table.limits.get_mut(length)? = code << (MAX_CODE - length);
            code <<= 1;
        }
        Some(table)
    }

    /// Joins the steps over the codes that each beginning has whole, up to a block's end.
    fn joined(mut self: Box<Self>) -> Box<Self> {
        for beginning in 0..self.lookup.len() {
            let mut all = self.lookup[beginning].one;
            while all.moved < END_OF_BLOCK && usize::from(all.bits) < LOOKUP {
                let next = (beginning << all.bits) % (1 << LOOKUP);
                let (step, length) = (self.lookup[next].one, self.lengths[next]);
                let moved = all.moved + step.moved;
                let is_whole = length > 0 && usize::from(all.bits + length) <= LOOKUP;
                if !is_whole || u32::from(moved % END_OF_BLOCK) >= BLOCK {
                    break;
                }
                all = Step { bits: all.bits + step.bits, moved };
            }
            self.lookup[beginning].all = all;
        }
        self
    }

    /// The step over a code that is longer than those in `lookup`, at the beginning of `bits`.
    fn of_long_code(&self, bits: u32) -> Option<Step> {
        let limits = self.limits.iter().enumerate().skip(LOOKUP + 1);
        let (length, _) = limits.into_iter().find(|(_, limit)| bits < **limit)?;
        let place = (bits >> (MAX_CODE - length)).wrapping_add(*self.offsets.get(length)?);
        self.steps.get(place as usize).copied()
    }
}

/// The step over a DC coefficient, but for its code.
fn dc_step(symbol: u8) -> Option<Step> {
    (symbol < 16).then_some(Step { bits: symbol, moved: 1 })
}

/// The step over an AC coefficient and the zeros before it, but for its code. A run without a value ends the block, but for that of 16
/// zeros.
fn ac_step(symbol: u8) -> Option<Step> {
    let (run, bits) = (symbol >> 4, symbol & 15);
    let moved = if bits > 0 || run == 15 { run + 1 } else { END_OF_BLOCK };
    Some(Step { bits, moved })
}

/// Adds the tables of a segment; `None` for one that is malformed.
fn add_tables(mut parameters: &[u8], dc: &mut Tables, ac: &mut Tables) -> Option<()> {
    while let Some((which, rest)) = parameters.split_first() {
        let (counts, rest) = rest.split_first_chunk()?;
        let total = counts.iter().map(|count| usize::from(*count)).sum();
        let (symbols, rest) = rest.split_at_checked(total)?;
        let (tables, table) = match which >> 4 {
            0 => (&mut *dc, Table::new(counts, symbols, dc_step)?),
            1 => (&mut *ac, Table::new(counts, symbols, ac_step)?.joined()),
            _ => return None,
        };
        *tables.get_mut(usize::from(which & 15))? = Some(table);
        parameters = rest;
    }
    Some(())
}

/// An MCU's part of a component.
#[derive(Clone, Copy)]
struct Part {
    blocks: u64,
    /// Destinations of its tables.
    dc: usize,
    ac: usize,
}

/// An MCU's part of each component, in the order of the data; `None` for a scan that lacks components of the frame.
fn parts(frame: &Frame, parameters: &[u8]) -> Option<[Option<Part>; MAX_COMPONENTS]> {
    let (count, rest) = parameters.split_first()?;
    let (listed, _) = rest.as_chunks::<2>();
    let listed = listed.get(..usize::from(*count))?;
    let mut parts = [None; MAX_COMPONENTS];
    let is_listed = |it: &Component| listed.iter().any(|[id, _]| *id == it.id);
    if listed.len() != frame.components().count() || !frame.components().all(is_listed) {
        return None;
    }
    for (part, [id, tables]) in parts.iter_mut().zip(listed) {
        let component = frame.components().find(|it| it.id == *id)?;
        let [dc, ac] = [tables >> 4, tables & 15].map(usize::from);
        *part = Some(Part { blocks: frame.blocks_of_mcu(component), dc, ac });
    }
    Some(parts)
}

/// A scan of all components, sequential and coded by Huffman's method.
struct Scan<'a> {
    dc: Tables,
    ac: Tables,
    parts: [Option<Part>; MAX_COMPONENTS],
    mcus: u64,
    /// MCUs of the row that an encoder adds which fills up the picture to 16 lines; 0 where there is none to be filled up.
    padding: u64,
    /// MCUs between restart markers; 0 without them.
    restart_interval: u64,
    coded: &'a [u8],
}

impl<'a> Scan<'a> {
    /// The first scan of a file; `None` when it is not judged.
    fn of(jpeg: &'a [u8]) -> Option<Self> {
        let (mut dc, mut ac): (Tables, Tables) = Default::default();
        let (mut frame, mut restart_interval) = (None, 0);
        for segment in segments(jpeg) {
            match segment.code {
                SOF_BASELINE | SOF_EXTENDED => frame = Some(Frame::parse(segment.parameters)?),
                DHT => add_tables(segment.parameters, &mut dc, &mut ac)?,
                DRI => {
                    let interval = u16::from_be_bytes(segment.parameters.try_into().ok()?);
                    restart_interval = u64::from(interval);
                }
                SOS => {
                    let frame: Frame = frame?;
                    let parts = parts(&frame, segment.parameters)?;
                    let coded = jpeg.get(segment.at + 4 + segment.parameters.len()..)?;
                    let (mcus, padding) = (frame.mcus(), frame.padding());
                    let scan = Self { dc, ac, parts, mcus, padding, restart_interval, coded };
                    let has_tables = |part: &Part| scan.tables(*part).is_some();
                    return scan.parts.iter().flatten().all(has_tables).then_some(scan);
                }
                _ => (),
            }
        }
        None
    }

    fn walk(&self) -> Result<(), ScanFault> {
        let blocks = self.mcus * self.parts.iter().flatten().map(|part| part.blocks).sum::<u64>();
        let mut bits = Bits { coded: self.coded, at: 0, window: 0, count: 0 };
        let mut before = 0;
        for mcu in 0..self.mcus {
            if mcu > 0 && mcu.checked_rem(self.restart_interval) == Some(0) {
                let expected = ((mcu / self.restart_interval - 1) % 8) as u8;
                match bits.marker().map(|code| code.wrapping_sub(RST0)) {
                    Some(found) if found == expected => (),
                    Some(found @ 0..8) => return Err(ScanFault::Restart { found, expected }),
                    Some(_) => return Err(ScanFault::Ended { before, blocks }),
                    None => return Err(ScanFault::NoRestart { expected, before, blocks }),
                }
            }
            self.skip_mcu(&mut bits, &mut before).map_err(|stop| match stop {
                Stop::Ended => ScanFault::Ended { before, blocks },
                Stop::Code => ScanFault::Code { block: before + 1, blocks },
            })?;
        }
        if self.has_more_blocks(bits) { Err(ScanFault::Beyond { blocks }) } else { Ok(()) }
    }

    /// Skips an MCU, and counts its blocks in `before`.
    #[inline(always)]
    fn skip_mcu(&self, bits: &mut Bits<'_>, before: &mut u64) -> Result<(), Stop> {
        for part in self.parts.iter().flatten() {
            let Some((dc, ac)) = self.tables(*part) else { return Err(Stop::Code) };
            for _ in 0..part.blocks {
                bits.skip_block(dc, ac)?;
                *before += 1;
            }
        }
        Ok(())
    }

    /// True when the last block is followed by further blocks, other than those that fill up the picture: these end with an MCU
    /// at the end of the data.
    fn has_more_blocks(&self, mut bits: Bits<'_>) -> bool {
        if bits.is_at_marker() {
            return false;
        }
        let mut surplus = 0;
        while self.skip_mcu(&mut bits, &mut 0).is_ok() {
            surplus += 1;
            if bits.is_at_marker() {
                return bits.is_filled() && surplus != self.padding;
            }
        }
        false
    }

    fn tables(&self, part: Part) -> Option<(&Table, &Table)> {
        Some((self.dc.get(part.dc)?.as_deref()?, self.ac.get(part.ac)?.as_deref()?))
    }
}

/// Coded data, bit by bit.
#[derive(Clone, Copy)]
struct Bits<'a> {
    coded: &'a [u8],
    /// Place of the first byte that is not in the window.
    at: usize,
    /// The next bits, the first of them on top; zeros behind them.
    window: u64,
    /// How many bits the window holds.
    count: u32,
}

impl Bits<'_> {
    /// Skips a block.
    #[inline(always)]
    fn skip_block(&mut self, dc: &Table, ac: &Table) -> Result<(), Stop> {
        self.fill();
        let mut place = self.skip_one(dc)?;
        while place < BLOCK {
            self.fill();
            let all = ac.lookup[(self.window >> (64 - LOOKUP)) as usize].all;
            // The codes may be those of two blocks where this one is nearly full.
            let reached = place + u32::from(all.moved);
            let is_within = reached % u32::from(END_OF_BLOCK) < BLOCK;
            if all.bits > 0 && is_within && u32::from(all.bits) <= self.count {
                self.count -= u32::from(all.bits);
                self.window <<= all.bits;
                place = reached;
            } else {
                place += self.skip_one(ac)?;
            }
        }
        let is_overrun = BLOCK < place && place < u32::from(END_OF_BLOCK);
        if is_overrun { Err(Stop::Code) } else { Ok(()) }
    }

    /// Skips a code and the value behind it, and returns how far the place in the block moves on.
    #[inline(always)]
    fn skip_one(&mut self, table: &Table) -> Result<u32, Stop> {
        let mut step = table.lookup[(self.window >> (64 - LOOKUP)) as usize].one;
        if step.bits == 0 {
            let has_code = self.count as usize >= MAX_CODE;
            let unknown = if has_code { Stop::Code } else { Stop::Ended };
            step = table.of_long_code((self.window >> (64 - MAX_CODE)) as u32).ok_or(unknown)?;
        }
        self.count = self.count.checked_sub(u32::from(step.bits)).ok_or(Stop::Ended)?;
        self.window <<= step.bits;
        Ok(u32::from(step.moved))
    }

    /// Fills a window of less than 32 bits to at least 32, unless a marker or the end comes before.
    #[inline(always)]
    fn fill(&mut self) {
        if self.count >= 32 {
            return;
        }
        let ahead = self.coded.get(self.at..).and_then(|ahead| ahead.first_chunk());
        if let Some(bytes) = ahead.map(|bytes| u32::from_be_bytes(*bytes))
            && (!bytes).wrapping_sub(0x0101_0101) & bytes & 0x8080_8080 == 0
        {
            // None of them is 0xff: an inverted byte of zero borrows from the one above.
            self.window |= u64::from(bytes) << (32 - self.count);
            (self.count, self.at) = (self.count + 32, self.at + 4);
        } else {
            *self = self.filled_by_bytes();
        }
    }

    /// By value, so that the bits stay in registers where it is not called.
    #[cold]
    #[inline(never)]
    fn filled_by_bytes(mut self) -> Self {
        while self.count <= 56 {
            let Some(byte) = self.coded.get(self.at) else { break };
            self.at += match (byte, self.coded.get(self.at + 1)) {
                (0xff, Some(0)) => 2,
                // A marker.
                (0xff, _) => break,
                _ => 1,
            };
            self.count += 8;
            self.window |= u64::from(*byte) << (64 - self.count);
        }
        self
    }

    /// True when the rest of a byte is filled up, as behind a last block: with ones (F.1.2.3), or with zeros.
    fn is_filled(&self) -> bool {
        let rest = self.count % 8;
        let fill = self.window.checked_shr(64 - rest).unwrap_or_default();
        fill == 0 || fill == (1 << rest) - 1
    }

    fn is_at_marker(mut self) -> bool {
        self.marker().is_some()
    }

    /// The second byte of the marker that comes next, behind the rest of a byte at most; the bits continue behind it.
    fn marker(&mut self) -> Option<u8> {
        if self.count >= 8 {
            return None;
        }
        let ahead = self.coded.get(self.at..)?.strip_prefix(&[0xff])?;
        // A marker may begin with any number of fill bytes.
        let fill = ahead.iter().position(|byte| *byte != 0xff)?;
        let code = *ahead.get(fill)?;
        (self.window, self.count, self.at) = (0, 0, self.at + 2 + fill);
        (code != 0).then_some(code)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Component 7 of 20 x 9 pixels: 3 x 2 blocks, as its sampling means nothing where it is alone.
    const GREY: &[u8] = &[8, 0, 9, 0, 20, 1, 7, 0x22, 0];
    const GREY_SCAN: &[u8] = &[1, 7, 0, 0, 63, 0];
    const BLOCKS: u64 = 6;
    /// A block without coefficients.
    const EMPTY: &str = "0 0";
    /// 64 coefficients: one of 3 bits, 3 x 16 zeros, 2 x 5 zeros and one of 2 bits, and 3 of 1 bit behind a long code.
    const FULL: &str =
        "10 101 110 110 110 10 01 10 10 111000000000 1 111000000000 0 111000000000 1";
    const EOI: &[u8] = &[0xff, 0xd9];

    fn segment(code: u8, parameters: &[u8]) -> Vec<u8> {
        let length = (parameters.len() as u16 + 2).to_be_bytes();
        [&[0xff, code], &length[..], parameters].concat()
    }

    /// DC codes are 0 (no bits follow) and 10 (3 bits); AC codes are 0 (the block's end), 10 (5 zeros and 2 bits), 110 (16 zeros) and
    /// 111000000000 (1 bit).
    fn tables() -> Vec<u8> {
        let (mut dc, mut ac) = ([0; 17], [0; 17]);
        dc[1..=2].fill(1);
        ac[0] = 0x10;
        ac[1..=3].fill(1);
        ac[12] = 1;
        segment(DHT, &[&dc[..], &[0, 3], &ac, &[0, 0x52, 0xf0, 1]].concat())
    }

    fn file(segments: &[Vec<u8>], coded: &[u8]) -> Vec<u8> {
        [&[0xff, 0xd8], &segments.concat()[..], coded].concat()
    }

    fn grey(coded: &[u8]) -> Vec<u8> {
        file(&[segment(SOF_BASELINE, GREY), tables(), segment(SOS, GREY_SCAN)], coded)
    }

    /// Blocks as bytes, filled up with ones, a zero behind each 0xff.
    fn coded(blocks: &[&str]) -> Vec<u8> {
        let mut bits: String = blocks.concat().replace(' ', "");
        bits.extend(std::iter::repeat_n('1', bits.len().next_multiple_of(8) - bits.len()));
        let bytes = bits.as_bytes().chunks(8);
        let byte = |bits| u8::from_str_radix(std::str::from_utf8(bits).unwrap(), 2).unwrap();
        bytes.map(byte).flat_map(|it| if it == 0xff { vec![0xff, 0] } else { vec![it] }).collect()
    }

    #[test]
    fn a_scan_is_walked_to_its_last_block() {
        let check = |blocks: &[&str]| check_scan(&grey(&[&coded(blocks), EOI].concat()));
        for all in [[EMPTY; 6], [FULL; 6], [FULL, EMPTY, EMPTY, FULL, EMPTY, FULL]] {
            assert_eq!(check(&all), Ok(()));
            let ended = ScanFault::Ended { before: 5, blocks: BLOCKS };
            // The padding of the last byte is not a code.
            assert_eq!(check(&[&all[..5], &["10"]].concat()), Err(ended));
        }
        let text = check(&[FULL; 3]).unwrap_err().to_string();
        assert_eq!(text, "bytes are missing in it: its data end after 3 of 6 blocks");
    }

    #[test]
    fn a_block_that_no_encoder_writes_is_a_fault() {
        let fault = |block: &str| check_scan(&grey(&[&coded(&[FULL, block, FULL]), EOI].concat()));
        let code = Err(ScanFault::Code { block: 2, blocks: BLOCKS });
        assert_eq!(fault("0 110 110 110 110"), code, "65 coefficients");
        assert_eq!(fault("0 111100000000"), code, "no AC code");
        assert_eq!(fault("11 0"), code, "no DC code");
    }

    #[test]
    fn restart_markers_come_in_turn() {
        let interval = segment(DRI, &[0, 2]);
        let headers = [segment(SOF_EXTENDED, GREY), tables(), interval, segment(SOS, GREY_SCAN)];
        let check = |coded: &[&[u8]]| check_scan(&file(&headers, &coded.concat()));
        let (two, three) = (&coded(&[FULL, EMPTY])[..], &coded(&[EMPTY, FULL, FULL])[..]);
        let [rst0, rst1, rst2] = [[0xff, 0xd0], [0xff, 0xd1], [0xff, 0xd2]];
        assert_eq!(check(&[two, &rst0, two, &rst1, two, EOI]), Ok(()));
        assert_eq!(check(&[two, &[0xff], &rst0, two, &rst1, two, &rst2, EOI]), Ok(()));
        let fault = check(&[two, &rst0, two, &rst2, two, EOI]).unwrap_err();
        assert_eq!(fault, ScanFault::Restart { found: 2, expected: 1 });
        let text = "bytes are missing in it: restart marker 2 where 1 was to come";
        assert_eq!(fault.to_string(), text);
        let fault = |coded: &[&[u8]]| check(coded).unwrap_err();
        let ended = |before| ScanFault::Ended { before, blocks: BLOCKS };
        assert_eq!(fault(&[two, &rst0, &coded(&[FULL]), &rst1, two, EOI]), ended(3));
        assert_eq!(fault(&[two, &rst0, two, EOI]), ended(4));
        let none = ScanFault::NoRestart { expected: 0, before: 2, blocks: BLOCKS };
        assert_eq!(fault(&[three, &rst0, two, &rst1, two, EOI]), none);
        assert_eq!(fault(&[two, two, EOI]), none);
    }

    #[test]
    fn surplus_bytes_are_accepted_unless_they_are_blocks() {
        let check = |coded: &[&[u8]]| check_scan(&grey(&coded.concat()));
        let (six, seven) = (&coded(&[FULL; 6])[..], &coded(&[FULL; 7])[..]);
        for surplus in [&[0xa5_u8; 5][..], &[0x5a; 3], &[0xff, 0, 0xff, 0], b"\r\n"] {
            assert_eq!(check(&[six, surplus, EOI]), Ok(()), "{surplus:x?}");
        }
        assert_eq!(check(&[six, EOI, seven, EOI]), Ok(()));
        // 16 x 24 pixels are filled up to 16 x 32: a row of two blocks.
        let frame = [8, 0, 24, 0, 16, 1, 7, 0x11, 0];
        let headers = [segment(SOF_BASELINE, &frame), tables(), segment(SOS, GREY_SCAN)];
        let check_odd = |blocks: usize| {
            check_scan(&file(&headers, &[&coded(&vec![FULL; blocks])[..], EOI].concat()))
        };
        assert_eq!([6, 8].map(check_odd), [Ok(()), Ok(())]);
        let beyond = || Err(ScanFault::Beyond { blocks: 6 });
        assert_eq!([7, 9].map(check_odd), [beyond(), beyond()]);
        assert_eq!(check(&[seven, EOI]), Err(ScanFault::Beyond { blocks: BLOCKS }));
        // Blocks of whole bytes leave no rest of one to be filled up.
        let even = ["10 101 10 01 10 01 10 10 110 110 10 01 111000000000 1 0 "; 7];
        assert_eq!(coded(&even[..1]).len(), 6);
        assert_eq!(check(&[&coded(&even[..6]), EOI]), Ok(()));
        let beyond = Err(ScanFault::Beyond { blocks: BLOCKS });
        assert_eq!(check(&[&coded(&even), EOI]), beyond);
    }

    #[test]
    fn components_have_as_many_blocks_as_their_sampling_requires() {
        // 33 x 17 pixels are 3 x 2 MCUs of 16 x 16, each of 4 + 1 + 1 blocks.
        let frame = [8, 0, 17, 0, 33, 3, 1, 0x22, 0, 2, 0x11, 0, 3, 0x11, 0];
        let scan = [3, 1, 0, 2, 0, 3, 0, 0, 63, 0];
        let headers = [segment(SOF_BASELINE, &frame), tables(), segment(SOS, &scan)];
        let check =
            |blocks| check_scan(&file(&headers, &[&coded(&vec![FULL; blocks]), EOI].concat()));
        assert_eq!(check(36), Ok(()));
        assert_eq!(check(35), Err(ScanFault::Ended { before: 35, blocks: 36 }));
        assert_eq!(check(42), Err(ScanFault::Beyond { blocks: 36 }));
    }

    #[test]
    fn files_that_cannot_be_checked_are_accepted() {
        let (frame, scan) = (segment(SOF_BASELINE, GREY), segment(SOS, GREY_SCAN));
        let judged = |segments: &[Vec<u8>]| check_scan(&file(segments, EOI)).is_err();
        assert!(judged(&[frame.clone(), tables(), scan.clone()]));
        assert!(!judged(&[segment(0xc2, GREY), tables(), scan.clone()]), "progressive");
        assert!(!judged(&[segment(0xc9, GREY), tables(), scan.clone()]), "arithmetic");
        assert!(!judged(&[frame.clone(), scan.clone()]), "no tables");
        assert!(!judged(&[tables(), scan.clone()]), "no frame");
        assert!(!judged(&[frame, tables()]), "no scan");
        let of_frame = |parameters: &[u8]| {
            let frame = segment(SOF_BASELINE, parameters);
            judged(&[frame, tables(), scan.clone()])
        };
        assert!(!of_frame(&[12, 0, 9, 0, 20, 1, 7, 0x11, 0]), "12 bits");
        assert!(!of_frame(&[8, 0, 0, 0, 20, 1, 7, 0x11, 0]), "a height behind the scan");
        assert!(!of_frame(&[8, 0, 9, 0, 20, 1, 7, 0x01, 0]), "no sampling");
        assert!(!of_frame(&[8, 0, 9, 0, 20, 1, 6, 0x11, 0]), "another component");
        assert!(!of_frame(&[8, 0, 9, 0, 20, 2, 7, 0x11, 0, 8, 0x11, 0]), "one of two components");
    }

    #[test]
    fn no_file_stops_the_walk() {
        let interval = segment(DRI, &[0, 2]);
        let headers = [segment(SOF_BASELINE, GREY), tables(), interval, segment(SOS, GREY_SCAN)];
        let whole = file(&headers, &[&coded(&[FULL, EMPTY, FULL]), EOI].concat());
        for at in 0..whole.len() {
            drop(check_scan(&whole[..at]));
            for byte in 0..=u8::MAX {
                let mut damaged = whole.clone();
                damaged[at] = byte;
                // Some positions are unimportant: the test is that there is an answer.
                drop(check_scan(&damaged));
            }
        }
    }
}
