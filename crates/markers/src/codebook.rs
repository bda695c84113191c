//! Finds which codeword of a family was read.

/// Longer lists of codewords are searched by index, shorter ones from end to end.
const MAX_UNINDEXED: usize = 1500;
/// Parts into which the bits are divided for the index. With fewer wrong bits than parts one part has none.
const PARTS: u32 = 4;

/// The codewords of a family and the search among them, for square cells and for STag's dots alike.
#[derive(Debug)]
pub struct Codebook {
    codewords: &'static [u64],
    bits: u32,
    /// Where bit `k` is read from after a quarter turn, the most significant first.
    quarter_turn: [u8; 64],
    /// One for each part of the bits; none for a short list.
    indices: Vec<Index>,
}

/// The codeword nearest to the bits that were read.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Match {
    /// Its id.
    pub id: u32,
    /// The marker's own top left corner is this one of the corners by which the bits were read, clockwise from 0.
    pub rotation: u8,
    /// Number of bits that were read wrongly.
    pub hamming: u8,
}

impl Codebook {
    /// A book of codewords of `quarter_turn.len()` bits, at most 64. Bit `quarter_turn[k]` is where bit `k` is found when
    /// the corners are counted from the next one.
    pub(crate) fn new(codewords: &'static [u64], quarter_turn: &[u8]) -> Self {
        let bits = quarter_turn.len().min(64) as u32;
        let mut padded = [0; 64];
        padded.iter_mut().zip(quarter_turn).for_each(|(to, from)| *to = *from);
        let parts = if codewords.len() > MAX_UNINDEXED { PARTS } else { 0 };
        let indices = (0..parts).map(|part| Index::new(codewords, bits, part)).collect();
        Self { codewords, bits, quarter_turn: padded, indices }
    }

    /// The codeword nearest to `read` in any of its four rotations, with a Hamming distance of at most `max_hamming`;
    /// `None` when there is none, or when two ids are equally near.
    pub fn nearest(&self, read: u64, max_hamming: u8) -> Option<Match> {
        let mut best: Option<Match> = None;
        let mut is_tie = false;
        let mut rotated = read;
        for rotation in 0..4 {
            self.for_each_near(rotated, u32::from(max_hamming), |id, hamming| {
                let found = Match { id, rotation, hamming: hamming as u8 };
                match best {
                    Some(b) if b.hamming < found.hamming => {}
                    Some(b) if b.hamming == found.hamming => is_tie |= b.id != id,
                    _ => (best, is_tie) = (Some(found), false),
                }
            });
            rotated = self.rotated(rotated);
        }
        best.filter(|_| !is_tie)
    }

    /// The codewords, of id 0 first.
    pub fn codewords(&self) -> &'static [u64] {
        self.codewords
    }

    /// The same cells, read with the corners counted from the next one.
    pub fn rotated(&self, word: u64) -> u64 {
        (0..self.bits as usize).fold(0, |rotated, k| {
            rotated << 1 | word >> (self.bits - 1 - u32::from(self.quarter_turn[k])) & 1
        })
    }

    /// Calls `found` with every id whose codeword is within `max_hamming` of `read`, and the distance; with some twice.
    fn for_each_near(&self, read: u64, max_hamming: u32, mut found: impl FnMut(u32, u32)) {
        let mut compare = |id: u32, codeword: u64| {
            let hamming = (codeword ^ read).count_ones();
            if hamming <= max_hamming {
                found(id, hamming);
            }
        };
        if self.indices.is_empty() || max_hamming >= PARTS {
            self.codewords.iter().zip(0..).for_each(|(codeword, id)| compare(id, *codeword));
            return;
        }
        // Any match has a part without wrong bits among the first `max_hamming + 1`.
        for index in &self.indices[..=max_hamming as usize] {
            for &id in index.ids(read) {
                compare(u32::from(id), self.codewords[usize::from(id)]);
            }
        }
    }
}

/// The ids by the value of one part of their codewords.
#[derive(Debug)]
struct Index {
    shift: u32,
    mask: u64,
    /// Where the ids of each value begin in `ids`, and where the last ones end.
    starts: Vec<u32>,
    ids: Vec<u16>,
}

impl Index {
    fn new(codewords: &[u64], bits: u32, part: u32) -> Self {
        let (shift, end) = (bits * part / PARTS, bits * (part + 1) / PARTS);
        let mask = (1u64 << (end - shift)) - 1;
        let value = |codeword: u64| (codeword >> shift & mask) as usize;
        let mut starts = vec![0; mask as usize + 2];
        codewords.iter().for_each(|codeword| starts[value(*codeword) + 1] += 1);
        for i in 1..starts.len() {
            starts[i] += starts[i - 1];
        }
        let mut next = starts.clone();
        let mut ids = vec![0; codewords.len()];
        for (codeword, id) in codewords.iter().zip(0..=u16::MAX) {
            let place = &mut next[value(*codeword)];
            ids[*place as usize] = id;
            *place += 1;
        }
        Self { shift, mask, starts, ids }
    }

    fn ids(&self, read: u64) -> &[u16] {
        let value = (read >> self.shift & self.mask) as usize;
        &self.ids[self.starts[value] as usize..self.starts[value + 1] as usize]
    }
}
