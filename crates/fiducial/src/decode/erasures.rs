//! Reads a square marker with hidden parts: each sampled cell is black, white or an erasure by the light on border and quiet
//! zone, and the codeword is matched by the rest.
//!
//! Cells next to a border cell of the wrong colour are erasures as well. The codeword counts only with a low false-positive
//! rate.

use imaging::GrayView;
use markers::SquareCode;

use crate::candidates::quad::Quad;
use crate::decode::false_positive;
use crate::decode::illumination::{
    Agreement, BorderRatios, Colour, Illumination, MAX_CELLS, ReferenceCells, SATURATED,
    intact_fraction, log,
};
use crate::optics::homography::Homography;

/// The codeword of a partly hidden marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Reading {
    pub(crate) id: u32,
    /// The marker's own top left corner is this one of the quad's.
    pub(crate) rotation: u8,
    /// Known bits that differ from the codeword's.
    pub(crate) hamming: u8,
    /// Fraction of the border and the quiet zone that looks as it should.
    pub(crate) intact: f32,
    /// Fraction of the variance of the known bits' pixels that black and white explain.
    pub(crate) r_squared: f32,
    /// Whether there is a reflection: edges then seem to be displaced.
    pub(crate) is_washed_out: bool,
    /// Agreement in excess of that of a chance codeword, in bits.
    pub(crate) evidence: f32,
}

/// Smallest evidence, in bits, and the evidence from which on the lower bound on R² holds. In a thousand
/// images without markers, no reading with the smallest evidence had an R² above 0.6.
const MIN_EVIDENCE: f32 = 6.0;
const STRONG_EVIDENCE: f32 = 7.0;
/// Smallest R², with strong and with weak evidence.
const MIN_R_SQUARED: f32 = 0.7;
const MIN_R_SQUARED_WEAK: f32 = 0.85;

/// Largest number of cells across, those around the square included.
const MAX_ACROSS: usize = 15;
const _: () = assert!(MAX_ACROSS * MAX_ACROSS == MAX_CELLS);
/// Samples across a cell.
const SAMPLES: usize = 3;

/// The cells of a quad as they look, for all codes with the same cells.
pub(crate) struct CellImage {
    grid: Grid,
    colours: [Colour; MAX_CELLS],
    intact: f32,
    r_squared: f32,
    is_washed_out: bool,
}

impl CellImage {
    /// Reads the cells of a code in `quad`; `None` when there is no border in a quiet zone.
    pub(crate) fn read(view: GrayView<'_>, quad: &Quad, code: &SquareCode) -> Option<Self> {
        let source = Source::new(view, quad, code)?;
        let mut grid = Grid::new(code)?;
        // Most quads are refused by their border and quiet zone, before a bit is sampled.
        grid.sample(&source, |kind| matches!(kind, Kind::Border | Kind::QuietZone));
        let light = grid.illumination()?;
        let mut seen = [Colour::Unknown; MAX_CELLS];
        grid.classify(&light, &mut seen);
        let intact = grid.intact(&seen)?;
        grid.sample(&source, |kind| kind == Kind::Bit);
        grid.classify(&light, &mut seen);
        let has_glare = grid.erase_doubtful(&mut seen);
        let r_squared = grid.r_squared(&light, &seen);
        let is_washed_out = has_glare || light.is_reflected();
        let mut colours = seen;
        if is_washed_out {
            grid.fill_by_steps(&source, &light, &mut colours);
        }
        Some(Self { grid, colours, intact, r_squared, is_washed_out })
    }

    /// The marker of one family that it shows. `ids` are those looked for; `None` means all.
    pub(crate) fn decode(&self, code: &SquareCode, ids: Option<&[u32]>) -> Option<Reading> {
        let found = decode_with_erasures(self.grid.word(&self.colours, code), code, ids)?;
        let reading = Reading {
            intact: self.intact,
            r_squared: self.r_squared,
            is_washed_out: self.is_washed_out,
            ..found
        };
        let is_strong = reading.evidence >= STRONG_EVIDENCE;
        let min_r_squared = if is_strong { MIN_R_SQUARED } else { MIN_R_SQUARED_WEAK };
        (reading.r_squared >= min_r_squared).then_some(reading)
    }
}

/// Whether two codes have the same cells, in any order of their bits.
pub(crate) fn have_same_cells(a: &SquareCode, b: &SquareCode) -> bool {
    let has =
        |cells: &[[i8; 2]], others: &[[i8; 2]]| others.iter().all(|cell| cells.contains(cell));
    a.cells == b.cells && a.bits.len() == b.bits.len() && has(a.bits, b.bits)
}

/// Whether a quad has a border that is darker than the quiet zone by nearly the same ratio for most of its
/// cells.
pub(crate) fn has_border(view: GrayView<'_>, quad: &Quad, code: &SquareCode) -> bool {
    let Some(source) = Source::new(view, quad, code) else { return false };
    let places = 4 * usize::from(code.cells).min(MAX_ACROSS);
    let mut ratios = BorderRatios::<{ 4 * MAX_ACROSS }>::new(places);
    for index in 0..places {
        let along = (index / 4) as f64 + 0.5;
        let value = |depth: f64| {
            let place = match index % 4 {
                0 => [along, depth],
                1 => [source.cells - depth, along],
                2 => [along, source.cells - depth],
                _ => [depth, along],
            };
            source.grey(place).map(log)
        };
        if let (Some(border), Some(quiet_zone)) = (value(0.5), value(-0.35))
            && !ratios.add(quiet_zone - border)
        {
            return false;
        }
    }
    ratios.is_border(2 * usize::from(code.cells))
}

/// The kind of a marker's cell.
#[derive(Copy, Clone, Debug, PartialEq)]
enum Kind {
    /// Always black (for a reversed border: white).
    Border,
    /// Always white (for a reversed border: black).
    QuietZone,
    Bit,
    Nothing,
}

/// The image of a marker.
pub(crate) struct Source<'a> {
    view: GrayView<'a>,
    /// From the square's cells, whose corners are (0, 0) to (n, n), to pixels.
    homography: Homography,
    cells: f64,
    inverted: bool,
}

impl<'a> Source<'a> {
    pub(crate) fn new(view: GrayView<'a>, quad: &Quad, code: &SquareCode) -> Option<Self> {
        let cells = f64::from(code.cells);
        let corners = quad.corners.map(|c| [c.x, c.y]);
        let homography = Homography::from_square([0.0, cells], &corners)?;
        Some(Self { view, homography, cells, inverted: quad.inverted })
    }

    /// The grey value at a place in cells, of the negative where the marker is printed white on black.
    pub(crate) fn grey(&self, place: [f64; 2]) -> Option<f32> {
        let [x, y] = self.homography.project_visible(place)?;
        let value = imaging::bilinear(self.view, x, y)? as f32;
        Some(if self.inverted { 255.0 - value } else { value })
    }

    /// Mean grey values on either side of the edge between a cell and its neighbour in a direction.
    fn across_edge(&self, cell: [i8; 2], direction: [i8; 2]) -> Option<[f32; 2]> {
        const DISTANCE: f64 = 0.2;
        let middle = cell.map(|v| f64::from(v) + 0.5);
        let direction = direction.map(f64::from);
        let mut means = [0.0; 2];
        for along in [-0.25, 0.0, 0.25] {
            for (mean, across) in means.iter_mut().zip([0.5 - DISTANCE, 0.5 + DISTANCE]) {
                *mean += self.grey([
                    middle[0] + across * direction[0] - along * direction[1],
                    middle[1] + across * direction[1] + along * direction[0],
                ])? / 3.0;
            }
        }
        Some(means)
    }
}

/// The cells of a quad, sampled.
struct Grid {
    across: usize,
    margin: i8,
    kinds: [Kind; MAX_CELLS],
    samples: [[f32; SAMPLES * SAMPLES]; MAX_CELLS],
}

impl Grid {
    /// The cells of a code, not yet sampled; `None` for a code with more cells than any published one.
    fn new(code: &SquareCode) -> Option<Self> {
        let margin = code.margin();
        let across = usize::from(code.cells + 2 * margin);
        if across > MAX_ACROSS {
            return None;
        }
        let mut grid = Self {
            across,
            margin: margin as i8,
            kinds: [Kind::Nothing; MAX_CELLS],
            samples: [[f32::NAN; SAMPLES * SAMPLES]; MAX_CELLS],
        };
        grid.set_kinds(code);
        Some(grid)
    }

    fn set_kinds(&mut self, code: &SquareCode) {
        let last = code.cells as i8 - 1;
        for index in self.indices() {
            let [column, row] = self.cell(index);
            let outside = |v: i8| (-v).max(v - last);
            self.kinds[index] = match outside(column).max(outside(row)) {
                0 => Kind::Border,
                1 => Kind::QuietZone,
                _ => Kind::Nothing,
            };
        }
        for &[column, row] in code.bits {
            if let Some(index) = self.index([column, row]) {
                self.kinds[index] = Kind::Bit;
            }
        }
    }

    /// Samples the cells of some kinds.
    fn sample(&mut self, source: &Source<'_>, is_sampled: impl Fn(Kind) -> bool) {
        let last = source.cells - 1.0;
        for index in self.indices() {
            let kind = self.kinds[index];
            if !is_sampled(kind) {
                continue;
            }
            let [column, row] = self.cell(index);
            for sample in 0..SAMPLES * SAMPLES {
                let within = [sample % SAMPLES, sample / SAMPLES].map(|i| 0.22 + 0.28 * i as f64);
                // The quiet zone may be narrow, so it is sampled near the border.
                let near = |cell: i8, within: f64| {
                    let cell = f64::from(cell);
                    match kind {
                        Kind::QuietZone if cell < 0.0 => 0.3 * within - 0.42,
                        Kind::QuietZone if cell > last => last + 1.12 + 0.3 * within,
                        _ => cell + within,
                    }
                };
                let grey = source.grey([near(column, within[0]), near(row, within[1])]);
                self.samples[index][sample] = grey.unwrap_or(f32::NAN);
            }
        }
    }

    fn indices(&self) -> std::ops::Range<usize> {
        0..self.across * self.across
    }

    /// Column and row of a cell; the square's top left one is (0, 0).
    fn cell(&self, index: usize) -> [i8; 2] {
        [(index % self.across) as i8 - self.margin, (index / self.across) as i8 - self.margin]
    }

    fn index(&self, cell: [i8; 2]) -> Option<usize> {
        let [column, row] = cell.map(|v| usize::try_from(v + self.margin).unwrap_or(usize::MAX));
        (column < self.across && row < self.across).then(|| row * self.across + column)
    }

    /// The illumination by border and quiet zone.
    fn illumination(&self) -> Option<Illumination> {
        let mut known = ReferenceCells::default();
        for index in self.indices() {
            let is_white = match self.kinds[index] {
                Kind::Border => false,
                Kind::QuietZone => true,
                _ => continue,
            };
            let values = self.samples[index];
            let value = values.iter().sum::<f32>() / values.len() as f32;
            if value.is_finite() {
                known.push(self.cell(index).map(f32::from), value, is_white);
            }
        }
        known.illumination(f32::from(self.across as u8) * 0.5 - f32::from(self.margin) - 0.5)
    }

    /// The samples of a cell: place, grey value, and position between black and white.
    fn shares(
        &self,
        index: usize,
        light: &Illumination,
    ) -> impl Iterator<Item = (usize, [f32; 2], f32, f32)> {
        let [column, row] = self.cell(index).map(f32::from);
        self.samples[index].iter().enumerate().filter_map(move |(sample, value)| {
            let [dx, dy] = [sample % SAMPLES, sample / SAMPLES].map(|i| 0.28 * (i as f32 - 1.0));
            let place = [column + dx, row + dy];
            Some((sample, place, *value, light.white_share(place, *value)?))
        })
    }

    /// Sets the colour of each cell that was sampled.
    fn classify(&self, light: &Illumination, colours: &mut [Colour; MAX_CELLS]) {
        for index in self.indices().filter(|index| self.kinds[*index] != Kind::Nothing) {
            let (mut sum, mut weights, mut bright) = (0.0, 0.0_f32, 0);
            for (sample, place, value, share) in self.shares(index, light) {
                let weight = if sample == SAMPLES * SAMPLES / 2 { 2.0 } else { 1.0 };
                bright += usize::from(share > 1.2 && light.is_glare(place, value));
                sum += weight * share.clamp(-0.2, 1.2);
                weights += weight;
            }
            colours[index] = if weights < 4.0 {
                Colour::Unknown
            } else if bright > 2 {
                Colour::Glare
            } else {
                Colour::from_white_share(sum / weights)
            };
        }
    }

    /// As [`intact_fraction`], of border and quiet zone.
    fn intact(&self, colours: &[Colour; MAX_CELLS]) -> Option<f32> {
        let cells = self.kinds.iter().zip(colours).take(self.across * self.across);
        intact_fraction(cells.filter_map(|(kind, colour)| match kind {
            Kind::Border => Some((false, *colour)),
            Kind::QuietZone => Some((true, *colour)),
            _ => None,
        }))
    }

    /// Erases the neighbours of covered border cells, and white ones of glare; returns whether there is
    /// glare.
    fn erase_doubtful(&self, colours: &mut [Colour; MAX_CELLS]) -> bool {
        let seen = *colours;
        let mut has_glare = false;
        for index in self.indices() {
            let is_covered = self.kinds[index] == Kind::Border
                && matches!(seen[index], Colour::White | Colour::Grey);
            let is_glare = seen[index] == Colour::Glare;
            has_glare |= is_glare;
            if !is_covered && !is_glare {
                continue;
            }
            let [column, row] = self.cell(index);
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let Some(near) = self.index([column + dx, row + dy]) else { continue };
                    // Glare only adds light, so dark cells next to it are black.
                    if is_covered || colours[near] == Colour::White {
                        colours[near] = Colour::Unknown;
                    }
                }
            }
        }
        has_glare
    }

    /// Reads unknown bits by the steps at the edges to their neighbours: added light hardly changes across an
    /// edge, and black and white differ there until both are saturated.
    fn fill_by_steps(
        &self,
        source: &Source<'_>,
        light: &Illumination,
        colours: &mut [Colour; MAX_CELLS],
    ) {
        const SWEEPS: usize = 4;
        for _ in 0..SWEEPS {
            let mut has_changed = false;
            for index in self.indices() {
                if self.kinds[index] != Kind::Bit
                    || matches!(colours[index], Colour::Black | Colour::White)
                {
                    continue;
                }
                let [black, white] = self.votes(index, source, light, colours);
                colours[index] = match (black > 0, white > 0) {
                    (true, false) => Colour::Black,
                    (false, true) => Colour::White,
                    _ => continue,
                };
                has_changed = true;
            }
            if !has_changed {
                return;
            }
        }
    }

    /// How many steps from known neighbours make a cell black, and how many white.
    fn votes(
        &self,
        index: usize,
        source: &Source<'_>,
        light: &Illumination,
        colours: &[Colour; MAX_CELLS],
    ) -> [u32; 2] {
        let [column, row] = self.cell(index);
        let mut votes = [0; 2];
        for direction in [[1, 0], [0, 1], [-1, 0], [0, -1]] {
            let neighbour = self.index([column + direction[0], row + direction[1]]);
            let Some(near) = neighbour else { continue };
            let neighbour = match (self.kinds[near], colours[near]) {
                (Kind::Border, _) | (_, Colour::Black) => Colour::Black,
                (_, Colour::White) => Colour::White,
                _ => continue,
            };
            let Some([here, there]) = source.across_edge([column, row], direction) else {
                continue;
            };
            let [black, white] = light.without_reflection([f32::from(column), f32::from(row)]);
            let step = (here - there) / (white - black);
            let is_saturated = here.max(there) > SATURATED;
            let vote = match neighbour {
                Colour::Black if step > 0.5 => Some(1),
                Colour::White if step < -0.5 => Some(0),
                Colour::Black if step.abs() < 0.25 && !is_saturated => Some(0),
                Colour::White if step.abs() < 0.25 && !is_saturated => Some(1),
                _ => None,
            };
            if let Some(vote) = vote {
                votes[vote] += 1;
            }
        }
        votes
    }

    /// How well the known bits are uniformly black or white; texture and writing are not.
    fn r_squared(&self, light: &Illumination, colours: &[Colour; MAX_CELLS]) -> f32 {
        let mut agreement = Agreement::default();
        for index in self.indices().filter(|index| self.kinds[*index] == Kind::Bit) {
            let is_white = match colours[index] {
                Colour::Black => false,
                Colour::White => true,
                _ => continue,
            };
            let mut shares = [0.0; SAMPLES * SAMPLES];
            let mut seen = 0;
            for (_, _, _, share) in self.shares(index, light) {
                shares[seen] = share.clamp(-0.5, 1.5);
                seen += 1;
            }
            agreement.add(is_white, &shares[..seen]);
        }
        agreement.r_squared()
    }

    fn word(&self, colours: &[Colour; MAX_CELLS], code: &SquareCode) -> ErasedWord {
        code.bits.iter().fold(ErasedWord::default(), |word, cell| {
            let colour = self.index(*cell).map_or(Colour::Unknown, |index| colours[index]);
            let is_one = (colour == Colour::White) != code.reversed_border;
            word.appended(matches!(colour, Colour::Black | Colour::White).then_some(is_one))
        })
    }
}

/// Bits that were read, and which of them are known; the most significant is the first.
#[derive(Copy, Clone, Debug, Default, PartialEq)]
pub(crate) struct ErasedWord {
    pub(crate) bits: u64,
    pub(crate) known: u64,
}

/// The codeword that agrees best with the known bits of a word.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct BestCodeword {
    pub(crate) id: u32,
    pub(crate) rotation: u8,
    /// Known bits in which it differs, and in which the second best one differs.
    pub(crate) hamming: u32,
    pub(crate) second: u32,
    /// Number of codewords compared, rotations included.
    pub(crate) compared: u32,
}

impl ErasedWord {
    /// With one bit more; `None` means an erasure.
    pub(crate) fn appended(self, bit: Option<bool>) -> Self {
        Self {
            bits: self.bits << 1 | u64::from(bit == Some(true)),
            known: self.known << 1 | u64::from(bit.is_some()),
        }
    }

    /// Compares the codewords of these ids in all rotations.
    pub(crate) fn best_codeword(
        self,
        codewords: &[u64],
        ids: impl Iterator<Item = u32> + Clone,
        rotated: impl Fn(u64) -> u64,
    ) -> BestCodeword {
        let mut best =
            BestCodeword { id: 0, rotation: 0, hamming: u32::MAX, second: u32::MAX, compared: 0 };
        let mut word = self;
        for rotation in 0..4 {
            for id in ids.clone() {
                let Some(codeword) = codewords.get(id as usize) else { continue };
                let hamming = ((codeword ^ word.bits) & word.known).count_ones();
                best.compared += 1;
                // The same id in another rotation competes as well.
                if hamming < best.hamming {
                    best = BestCodeword { id, rotation, hamming, second: best.hamming, ..best };
                } else {
                    best.second = best.second.min(hamming);
                }
            }
            word = Self { bits: rotated(word.bits), known: rotated(word.known) };
        }
        best
    }
}

/// The codeword that agrees with the known bits, if chance does not explain that.
fn decode_with_erasures(
    word: ErasedWord,
    code: &SquareCode,
    ids: Option<&[u32]>,
) -> Option<Reading> {
    let known = word.known.count_ones();
    let count = ids.map_or(code.codewords.len(), <[u32]>::len);
    if (known as f32) < MIN_EVIDENCE + (4.0 * count as f32).log2() {
        return None;
    }
    let rotated = |word: u64| code.rotated(word);
    let of_all = || word.best_codeword(code.codewords, 0..code.codewords.len() as u32, rotated);
    let best = match ids {
        Some(ids) => word.best_codeword(code.codewords, ids.iter().copied(), rotated),
        None => of_all(),
    };
    let codeword = code.codewords.get(best.id as usize).copied()?;
    let erased = code.bits.len() as u32 - known;
    // The code's minimum distance bounds the errors that can be corrected besides the erasures.
    let correctable = u32::from(code.min_hamming).saturating_sub(erased + 1) / 2;
    let max_hamming = correctable.max(u32::from(erased == 0));
    if best.hamming > max_hamming || best.second <= best.hamming {
        return None;
    }
    // In some families two ids differ in one or two bits: a reading that equals another one exactly is that one, even if not
    // looked for, and where those bits are erased it may be either.
    let may_be_other = erased > 0 && code.min_hamming <= 2;
    if ids.is_some() && (best.hamming > 0 || may_be_other) {
        let all = of_all();
        if all.hamming < best.hamming || may_be_other && all.second <= best.hamming {
            return None;
        }
    }
    let evidence = false_positive::evidence(code, codeword, count, known, best.hamming) as f32;
    (evidence >= MIN_EVIDENCE).then_some(Reading {
        id: best.id,
        rotation: best.rotation,
        hamming: best.hamming as u8,
        intact: 0.0,
        r_squared: 0.0,
        is_washed_out: false,
        evidence,
    })
}

#[cfg(test)]
mod tests {
    use markers::Family;

    use super::*;

    #[test]
    fn two_bits_of_sixteen_may_be_erased_when_any_id_is_looked_for() {
        let code = SquareCode::for_family(Family::Aruco4x4_50).unwrap();
        for (hidden, is_read) in [(0, true), (2, true), (4, false)] {
            let known = 0xffff_u64 << hidden & 0xffff;
            let word = ErasedWord { bits: code.codewords[7] & known, known };
            let reading = decode_with_erasures(word, code, None);
            assert_eq!(reading.map(|reading| reading.id), is_read.then_some(7), "{hidden} bits");
        }
    }

    #[test]
    fn another_id_is_not_taken_for_one_from_which_it_differs_in_a_bit() {
        let code = SquareCode::for_family(Family::ArucoOriginal).unwrap();
        let known = (1 << code.bits.len()) - 1;
        let read = |bits: u64| {
            let reading = decode_with_erasures(ErasedWord { bits, known }, code, Some(&[255]));
            reading.map(|reading| reading.hamming)
        };
        let other = code.rotated(code.rotated(code.codewords[1022]));
        assert_eq!((other ^ code.codewords[255]).count_ones(), 1);
        assert_eq!(read(other), None);
        assert_eq!(read(code.codewords[255]), Some(0));
        // A wrong bit that makes no other id is corrected.
        let is_other = |word: u64| code.nearest(word, 0).is_some();
        let damaged = (0..25).map(|bit| code.codewords[255] ^ 1 << bit).find(|it| !is_other(*it));
        assert_eq!(read(damaged.unwrap()), Some(1));
        // A hidden bit does no harm, unless it is the one.
        let read_without = |hidden: u64| {
            let known = known & !hidden;
            let word = ErasedWord { bits: code.codewords[255] & known, known };
            decode_with_erasures(word, code, Some(&[255])).map(|reading| reading.hamming)
        };
        assert_eq!(read_without(other ^ code.codewords[255]), None);
        assert_eq!(read_without(damaged.unwrap() ^ code.codewords[255]), Some(0));
    }
}
