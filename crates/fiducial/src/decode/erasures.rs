//! Reads markers of which a part is in shadow, washed out, covered or outside of the image.
//!
//! Border and paper say what black and white are where they lie. From there the light over the whole marker is
//! modelled: as the same everywhere, as two lights on the sides of a straight edge of a shadow, or with a reflection
//! that adds light in a round blob. Cells that are neither black nor white by this, or beside border cells that are not
//! what they should be, are unknown, and a word is matched by the others. It counts only when so many cells agree that
//! chance is out of the question.

use geometry::Pixel;
use imaging::GrayView;
use markers::SquareCode;

use crate::candidates::quad::Quad;
use crate::decode::false_positive as chance;

/// What a damaged marker says.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Reading {
    /// The id.
    pub(crate) id: u32,
    /// The marker's own top left corner is this one of the quad's.
    pub(crate) quarter_turns: u8,
    /// Known bits that differ from the word's.
    pub(crate) wrong_bits: u8,
    /// Bits that could be read.
    pub(crate) known_bits: u8,
    /// The share of the border and the paper around it that looks as it should.
    pub(crate) intact: f32,
    /// The share of the variance of the known cells' pixels that black and white explain.
    pub(crate) explained: f32,
    /// Whether a reflection adds light to it: its edges are then not where they seem.
    pub(crate) washed_out: bool,
    /// By how many bits the agreement exceeds what chance would give among the words looked for.
    pub(crate) evidence: f32,
}

/// Least evidence, in bits; and with how much of it a marker may be as badly explained as one ever may. In a thousand
/// pictures without markers none with the least evidence was explained to more than 0.6.
const LEAST_EVIDENCE: f32 = 6.0;
const EVIDENCE_OF_DOUBTFUL: f32 = 7.0;
/// Least share of the border's cells, and of those around it, that look as they should.
const LEAST_INTACT: f32 = 0.6;
/// Least share of the variance of the known cells' pixels that black and white must explain.
const LEAST_EXPLAINED: f32 = 0.7;
const LEAST_EXPLAINED_WITH_LITTLE: f32 = 0.85;
/// Least share of them that must be seen.
const LEAST_SEEN: f32 = 0.35;
/// Least logarithm of the ratio of white to black.
const LEAST_RATIO: f32 = 0.08;
/// Least difference of white and black, in grey levels.
const LEAST_CONTRAST: f32 = 8.0;

/// The most cells across, those around the square included.
const MOST_ACROSS: usize = 15;
const MOST_CELLS: usize = MOST_ACROSS * MOST_ACROSS;
/// Places across a cell at which it is sampled.
const SAMPLES: usize = 3;

/// What the cells of a quad look like, for all codes with the same cells.
pub(crate) struct Seen {
    grid: Grid,
    cells: [Cell; MOST_CELLS],
    intact: f32,
    explained: f32,
    washed_out: bool,
}

/// Looks at the cells of a code in `quad`; `None` when it has no border and paper.
pub(crate) fn look(view: GrayView<'_>, quad: &Quad, code: &SquareCode) -> Option<Seen> {
    let place = Projection::of(&quad.corners)?;
    let look = Look { view, place: &place, cells: f64::from(code.cells), inverted: quad.inverted };
    let mut grid = Grid::new(code)?;
    // Most quads are no marker, as their border and paper tell before a bit is looked at.
    grid.sample(&look, |kind| matches!(kind, Kind::Border | Kind::Paper));
    let light = grid.light()?;
    let mut read = [Cell::Unknown; MOST_CELLS];
    grid.judge(&light, &mut read);
    let intact = grid.intact(&read)?;
    grid.sample(&look, |kind| kind == Kind::Bit);
    grid.judge(&light, &mut read);
    let glares = grid.distrust(&mut read);
    let mut cells = read;
    let washed_out = glares || light.reflection.is_some();
    if washed_out {
        grid.step(&look, &light, &mut cells);
    }
    let explained = grid.explained(&light, &read);
    Some(Seen { grid, cells, intact, explained, washed_out })
}

impl Seen {
    /// The marker of one family that it is. `wanted` are the ids that are looked for; `None` stands for all.
    pub(crate) fn reading(&self, code: &SquareCode, wanted: Option<&[u32]>) -> Option<Reading> {
        let (word, known) = self.grid.word(&self.cells, code);
        let mut reading = best_word(word, known, code, wanted)?;
        reading.intact = self.intact;
        reading.washed_out = self.washed_out;
        reading.explained = self.explained;
        let least = match reading.evidence {
            EVIDENCE_OF_DOUBTFUL.. => LEAST_EXPLAINED,
            _ => LEAST_EXPLAINED_WITH_LITTLE,
        };
        (reading.explained >= least).then_some(reading)
    }
}

/// Whether two codes have the same cells, in whatever order their bits are.
pub(crate) fn have_same_cells(a: &SquareCode, b: &SquareCode) -> bool {
    let has =
        |cells: &[[i8; 2]], others: &[[i8; 2]]| others.iter().all(|cell| cells.contains(cell));
    a.cells == b.cells && a.bits.len() == b.bits.len() && has(a.bits, b.bits)
}

/// Whether the border is darker than what lies beside it, by nearly the same ratio for most of its cells: a shadow keeps
/// the ratio of ink and paper.
pub(crate) fn has_border(view: GrayView<'_>, quad: &Quad, code: &SquareCode) -> bool {
    let Some(place) = Projection::of(&quad.corners) else { return false };
    let cells = f64::from(code.cells);
    let mut ratios = [0.0_f32; 4 * MOST_ACROSS];
    let mut seen = 0;
    for index in 0..4 * usize::from(code.cells).min(MOST_ACROSS) {
        let along = ((index / 4) as f64 + 0.5) / cells;
        let value = |depth: f64| {
            let at = match index % 4 {
                0 => [along, depth],
                1 => [1.0 - depth, along],
                2 => [along, 1.0 - depth],
                _ => [depth, along],
            };
            let value = place.at(at).and_then(|p| bilinear(view, p))?;
            Some(log(if quad.inverted { 255.0 - value } else { value }))
        };
        if let (Some(border), Some(paper)) = (value(0.5 / cells), value(-0.35 / cells)) {
            ratios[seen] = paper - border;
            seen += 1;
        }
    }
    if seen < 2 * usize::from(code.cells) {
        return false;
    }
    let ratios = &mut ratios[..seen];
    ratios.sort_unstable_by(f32::total_cmp);
    // The ratio which most cells reach, and the one most stay below.
    let (low, high) = (ratios[2 * seen / 5], ratios[4 * seen / 5]);
    low > LEAST_RATIO && high < 4.0 * low
}

/// What a cell of a marker is.
#[derive(Copy, Clone, Debug, PartialEq)]
enum Kind {
    /// Always black (for a reversed border: white).
    Border,
    /// Always white (for a reversed border: black).
    Paper,
    Bit,
    Nothing,
}

/// What a cell looks like.
#[derive(Copy, Clone, Debug, PartialEq)]
enum Cell {
    Black,
    White,
    /// Outside of the image, or where black and white look the same.
    Unknown,
    /// Neither black nor white.
    Grey,
    /// Brighter than paper is here.
    Glare,
}

/// The cells of a quad, sampled.
struct Grid {
    across: usize,
    margin: i8,
    kinds: [Kind; MOST_CELLS],
    samples: [[f32; SAMPLES * SAMPLES]; MOST_CELLS],
}

/// The light over a marker. Places are in cells, the middle of the square's top left one at (0, 0).
#[derive(Copy, Clone, Debug)]
pub(crate) struct Light {
    /// The edge of a shadow; infinitely far away when there is none.
    normal: [f32; 2],
    offset: f32,
    /// Black and white before and beyond the edge.
    levels: [[f32; 2]; 2],
    /// The logarithm of the light that a reflection adds: constant, by x, by y and by both squares.
    reflection: Option<[f32; 4]>,
}

impl Grid {
    /// The cells of a code, not yet sampled; `None` for a code with more cells than any that is published.
    fn new(code: &SquareCode) -> Option<Self> {
        let margin = code.margin();
        let across = usize::from(code.cells + 2 * margin);
        if across > MOST_ACROSS {
            return None;
        }
        let mut grid = Self {
            across,
            margin: margin as i8,
            kinds: [Kind::Nothing; MOST_CELLS],
            samples: [[f32::NAN; SAMPLES * SAMPLES]; MOST_CELLS],
        };
        grid.name(code);
        Some(grid)
    }

    /// Samples the cells of some kinds.
    fn sample(&mut self, look: &Look<'_>, is_sampled: impl Fn(Kind) -> bool) {
        let last = look.cells - 1.0;
        for index in 0..self.across * self.across {
            let kind = self.kinds[index];
            if !is_sampled(kind) {
                continue;
            }
            let [column, row] = self.cell(index);
            for sample in 0..SAMPLES * SAMPLES {
                let within = [sample % SAMPLES, sample / SAMPLES].map(|i| 0.22 + 0.28 * i as f64);
                // Little paper may be around the border, so it is taken near the border.
                let near = |cell: i8, within: f64| {
                    let cell = f64::from(cell);
                    match kind {
                        Kind::Paper if cell < 0.0 => 0.3 * within - 0.42,
                        Kind::Paper if cell > last => last + 1.12 + 0.3 * within,
                        _ => cell + within,
                    }
                };
                let at = [near(column, within[0]), near(row, within[1])].map(|v| v / look.cells);
                let value = look.place.at(at).and_then(|p| bilinear(look.view, p));
                // A marker printed the other way round is read as its negative.
                self.samples[index][sample] = match value {
                    Some(value) if look.inverted => 255.0 - value,
                    Some(value) => value,
                    None => f32::NAN,
                };
            }
        }
    }

    /// Says what each cell is.
    fn name(&mut self, code: &SquareCode) {
        let last = code.cells as i8 - 1;
        for index in 0..self.across * self.across {
            let [column, row] = self.cell(index);
            let outside = |v: i8| (-v).max(v - last);
            self.kinds[index] = match outside(column).max(outside(row)) {
                0 => Kind::Border,
                1 => Kind::Paper,
                _ => Kind::Nothing,
            };
        }
        for &[column, row] in code.bits {
            if let Some(index) = self.index([column, row]) {
                self.kinds[index] = Kind::Bit;
            }
        }
    }

    fn cell(&self, index: usize) -> [i8; 2] {
        [(index % self.across) as i8 - self.margin, (index / self.across) as i8 - self.margin]
    }

    fn index(&self, cell: [i8; 2]) -> Option<usize> {
        let [column, row] = cell.map(|v| usize::try_from(v + self.margin).unwrap_or(usize::MAX));
        (column < self.across && row < self.across).then(|| row * self.across + column)
    }

    /// The light by which border and paper look as they do.
    fn light(&self) -> Option<Light> {
        let mut known = Known::default();
        for index in 0..self.across * self.across {
            let white = match self.kinds[index] {
                Kind::Border => false,
                Kind::Paper => true,
                _ => continue,
            };
            let values = self.samples[index];
            let value = values.iter().sum::<f32>() / values.len() as f32;
            if value.is_finite() {
                known.push(self.cell(index).map(f32::from), value, white);
            }
        }
        known.light(f32::from(self.across as u8) * 0.5 - f32::from(self.margin) - 0.5)
    }

    /// Says what each cell looks like.
    fn judge(&self, light: &Light, read: &mut [Cell; MOST_CELLS]) {
        for (index, cell) in read.iter_mut().enumerate().take(self.across * self.across) {
            if self.kinds[index] == Kind::Nothing {
                continue;
            }
            let [column, row] = self.cell(index).map(f32::from);
            let (mut sum, mut weights, mut bright) = (0.0, 0.0_f32, 0);
            for (sample, value) in self.samples[index].iter().enumerate() {
                let [dx, dy] = within(sample);
                let Some(share) = light.white_share([column + dx, row + dy], *value) else {
                    continue;
                };
                let weight = if sample == SAMPLES * SAMPLES / 2 { 2.0 } else { 1.0 };
                bright +=
                    usize::from(share > 1.2 && light.is_brighter([column + dx, row + dy], *value));
                sum += weight * share.clamp(-0.2, 1.2);
                weights += weight;
            }
            let share = sum / weights.max(1.0);
            *cell = if weights < 4.0 {
                Cell::Unknown
            } else if bright > 2 {
                Cell::Glare
            } else if share < 0.4 {
                Cell::Black
            } else if share > 0.6 {
                Cell::White
            } else {
                Cell::Grey
            };
        }
    }

    /// The share of the known border and of the paper around it that looks as it should; `None` when that or what is
    /// known is too little.
    fn intact(&self, read: &[Cell; MOST_CELLS]) -> Option<f32> {
        let mut counts = [[0.0_f32; 3]; 2];
        for (kind, cell) in self.kinds.iter().zip(read).take(self.across * self.across) {
            let (which, expected) = match kind {
                Kind::Border => (0, Cell::Black),
                Kind::Paper => (1, Cell::White),
                _ => continue,
            };
            counts[which][0] += 1.0;
            counts[which][1] += f32::from(u8::from(*cell == expected));
            counts[which][2] += f32::from(u8::from(matches!(cell, Cell::Unknown | Cell::Glare)));
        }
        let shares =
            counts.map(
                |[all, good, unknown]| {
                    if good >= LEAST_SEEN * all { good / (all - unknown) } else { 0.0 }
                },
            );
        let all_good = shares.iter().all(|share| *share >= LEAST_INTACT);
        all_good.then_some(0.5 * (shares[0] + shares[1]))
    }

    /// Makes cells unknown that are probably damaged as their neighbours are; says whether any is washed out.
    fn distrust(&self, read: &mut [Cell; MOST_CELLS]) -> bool {
        let seen = *read;
        for (index, cell) in seen.iter().enumerate().take(self.across * self.across) {
            let covered =
                self.kinds[index] == Kind::Border && matches!(cell, Cell::White | Cell::Grey);
            let glare = *cell == Cell::Glare;
            if !covered && !glare {
                continue;
            }
            let [column, row] = self.cell(index);
            for dy in -1..=1 {
                for dx in -1..=1 {
                    let Some(near) = self.index([column + dx, row + dy]) else { continue };
                    // Light is only added, so what is dark beside glare is black.
                    if covered || read[near] == Cell::White {
                        read[near] = Cell::Unknown;
                    }
                }
            }
        }
        seen.iter().take(self.across * self.across).any(|cell| *cell == Cell::Glare)
    }

    /// Reads bits that are unknown by the steps from their neighbours to them: added light hardly changes across the edge
    /// between two cells, and black and white still differ there until both are at the sensor's end.
    fn step(&self, look: &Look<'_>, light: &Light, read: &mut [Cell; MOST_CELLS]) {
        const SWEEPS: usize = 4;
        for _ in 0..SWEEPS {
            let mut changed = false;
            for index in 0..self.across * self.across {
                if self.kinds[index] != Kind::Bit
                    || matches!(read[index], Cell::Black | Cell::White)
                {
                    continue;
                }
                let [black, white] = self.votes(index, look, light, read);
                let cell = match (black > 0, white > 0) {
                    (true, false) => Cell::Black,
                    (false, true) => Cell::White,
                    _ => continue,
                };
                read[index] = cell;
                changed = true;
            }
            if !changed {
                return;
            }
        }
    }

    /// How many neighbours say by their steps that a cell is black, and how many that it is white.
    fn votes(
        &self,
        index: usize,
        look: &Look<'_>,
        light: &Light,
        read: &[Cell; MOST_CELLS],
    ) -> [u32; 2] {
        let [column, row] = self.cell(index);
        let mut votes = [0; 2];
        for way in [[1, 0], [0, 1], [-1, 0], [0, -1]] {
            let Some(near) = self.index([column + way[0], row + way[1]]) else { continue };
            let neighbour = match (self.kinds[near], read[near]) {
                (Kind::Border, _) | (_, Cell::Black) => Cell::Black,
                (_, Cell::White) => Cell::White,
                _ => continue,
            };
            let Some([here, there]) = look.beside([column, row], way) else { continue };
            let [black, white] = light.plain([f32::from(column), f32::from(row)]);
            let step = (here - there) / (white - black);
            let ends = here.max(there) > SATURATED;
            let vote = match neighbour {
                Cell::Black if step > 0.5 => Some(1),
                Cell::White if step < -0.5 => Some(0),
                Cell::Black if step.abs() < 0.25 && !ends => Some(0),
                Cell::White if step.abs() < 0.25 && !ends => Some(1),
                _ => None,
            };
            if let Some(vote) = vote {
                votes[vote] += 1;
            }
        }
        votes
    }

    /// How well the known bits' cells are one black or one white: texture and writing are not.
    fn explained(&self, light: &Light, read: &[Cell; MOST_CELLS]) -> f32 {
        let (mut off, mut count, mut whites) = (0.0, 0.0_f32, 0.0);
        for (index, cell) in read.iter().enumerate().take(self.across * self.across) {
            let white = match cell {
                Cell::Black => 0.0,
                Cell::White => 1.0,
                _ => continue,
            };
            if self.kinds[index] != Kind::Bit {
                continue;
            }
            let [column, row] = self.cell(index).map(f32::from);
            for (sample, value) in self.samples[index].iter().enumerate() {
                let [dx, dy] = within(sample);
                if let Some(share) = light.white_share([column + dx, row + dy], *value) {
                    off += (share.clamp(-0.5, 1.5) - white).powi(2);
                    count += 1.0;
                    whites += white;
                }
            }
        }
        let share = whites / count;
        // Words are about half white; one that is not must not be held to less.
        let variance = (share * (1.0 - share)).max(0.15);
        if count > 0.0 { (1.0 - off / count / variance).clamp(0.0, 1.0) } else { 0.0 }
    }

    /// The bits, and which of them are known.
    fn word(&self, read: &[Cell; MOST_CELLS], code: &SquareCode) -> (u64, u64) {
        let (mut word, mut known) = (0, 0);
        for cell in code.bits {
            let cell = self.index(*cell).map_or(Cell::Unknown, |index| read[index]);
            let white = (cell == Cell::White) != code.reversed_border;
            let is_known = matches!(cell, Cell::Black | Cell::White);
            word = word << 1 | u64::from(is_known && white);
            known = known << 1 | u64::from(is_known);
        }
        (word, known)
    }
}

/// A marker in an image, to look at more closely.
struct Look<'a> {
    view: GrayView<'a>,
    place: &'a Projection,
    cells: f64,
    inverted: bool,
}

impl Look<'_> {
    /// The mean grey values just on this side and just beyond of the edge between a cell and its neighbour.
    fn beside(&self, cell: [i8; 2], way: [i8; 2]) -> Option<[f32; 2]> {
        const OFF: f64 = 0.2;
        let middle = cell.map(|v| f64::from(v) + 0.5);
        let way = way.map(f64::from);
        let mut sums = [0.0; 2];
        for along in [-0.25, 0.0, 0.25] {
            for (sum, across) in sums.iter_mut().zip([0.5 - OFF, 0.5 + OFF]) {
                let at = [
                    middle[0] + across * way[0] - along * way[1],
                    middle[1] + across * way[1] + along * way[0],
                ];
                let value = bilinear(self.view, self.place.at(at.map(|v| v / self.cells))?)?;
                let value = if self.inverted { 255.0 - value } else { value };
                *sum += value / 3.0;
            }
        }
        Some(sums)
    }
}

/// Where a sample lies from the middle of its cell, in cells.
fn within(sample: usize) -> [f32; 2] {
    [sample % SAMPLES, sample / SAMPLES].map(|i| 0.28 * (i as f32 - 1.0))
}

/// The word that agrees best with the known bits.
fn best_word(word: u64, known: u64, code: &SquareCode, wanted: Option<&[u32]>) -> Option<Reading> {
    let bits = known.count_ones();
    let count = wanted.map_or(code.codewords.len(), <[u32]>::len);
    let chances = (4.0 * count as f32).log2();
    if (bits as f32) < LEAST_EVIDENCE + chances {
        return None;
    }
    let (mut best, mut second) = ((u32::MAX, 0, 0), u32::MAX);
    let mut look = |id: u32, turns: u8, wrong: u32| {
        if wrong < best.0 {
            // The same id at another turn is a rival as well.
            second = best.0;
            best = (wrong, id, turns);
        } else {
            second = second.min(wrong);
        }
    };
    let (mut word, mut known) = (word, known);
    for turns in 0..4 {
        match wanted {
            Some(ids) => {
                for id in ids {
                    if let Some(expected) = code.codewords.get(*id as usize) {
                        look(*id, turns, ((expected ^ word) & known).count_ones());
                    }
                }
            }
            None => {
                for (expected, id) in code.codewords.iter().zip(0..) {
                    look(id, turns, ((expected ^ word) & known).count_ones());
                }
            }
        }
        word = code.rotated(word);
        known = code.rotated(known);
    }
    let (wrong, id, quarter_turns) = best;
    let erased = code.bits.len() as u32 - bits;
    // As many as the words' distance allows for when so many bits are missing.
    let correctable = u32::from(code.min_hamming).saturating_sub(erased + 1) / 2;
    let expected = code.codewords.get(id as usize).copied()?;
    let evidence = chance::evidence(code, expected, count, bits, wrong) as f32;
    (wrong <= correctable.max(u32::from(erased == 0))
        && second > wrong
        && evidence >= LEAST_EVIDENCE)
        .then_some(Reading {
            id,
            quarter_turns,
            wrong_bits: wrong as u8,
            known_bits: bits as u8,
            intact: 0.0,
            explained: 0.0,
            washed_out: false,
            evidence,
        })
}

/// So many known cells are looked at at a time.
const LANES: usize = 8;
const MOST_KNOWN: usize = MOST_CELLS.next_multiple_of(LANES);

/// The cells whose ink is known, by their places and grey values. After the last one, up to a whole number of [`LANES`], are
/// cells of neither ink, whose logarithm is 0.
pub(crate) struct Known {
    count: usize,
    columns: [f32; MOST_KNOWN],
    rows: [f32; MOST_KNOWN],
    values: [f32; MOST_KNOWN],
    /// Logarithms: of a shadow, black and white keep their ratio.
    logs: [f32; MOST_KNOWN],
    /// 1 for cells of the ink, 0 for others.
    black: [f32; MOST_KNOWN],
    white: [f32; MOST_KNOWN],
    /// Of black and of white cells, how many there are and the sum of their logarithms.
    sums: [[f32; 2]; 2],
}

/// Where cells lie across the lines of a direction, in cells.
struct Across {
    angle: f32,
    normal: [f32; 2],
    places: [f32; MOST_KNOWN],
}

impl Default for Known {
    fn default() -> Self {
        let none = [0.0; MOST_KNOWN];
        Self {
            count: 0,
            columns: none,
            rows: none,
            values: none,
            logs: none,
            black: none,
            white: none,
            sums: [[0.0; 2]; 2],
        }
    }
}

impl Known {
    /// Adds a place, in cells from the middle of the square's upper left one.
    pub(crate) fn push(&mut self, [column, row]: [f32; 2], value: f32, white: bool) {
        if self.count < MOST_CELLS {
            let (at, log) = (self.count, log(value));
            (self.columns[at], self.rows[at]) = (column, row);
            (self.values[at], self.logs[at]) = (value, log);
            let ink = if white { &mut self.white } else { &mut self.black };
            ink[at] = 1.0;
            let [count, sum] = &mut self.sums[usize::from(white)];
            *count += 1.0;
            *sum += log;
            self.count += 1;
        }
    }

    fn is_white(&self, index: usize) -> bool {
        self.white[index] > 0.0
    }

    /// The light about a grid whose middle is at `middle` both ways.
    pub(crate) fn light(&self, middle: f32) -> Option<Light> {
        let (mut best, mut misfit) = self.split(&self.across(0.0), f32::INFINITY)?;
        // Little is left to explain: one light.
        if misfit > 0.01 * self.count as f32 {
            let most = 0.6 * misfit;
            let others = [self.reflected(), self.shaded(middle)];
            for (light, here) in others.into_iter().flatten() {
                if here < most && here < misfit {
                    (best, misfit) = (light, here);
                }
            }
        }
        let enough = |[black, white]: [f32; 2]| white - black >= LEAST_CONTRAST;
        best.levels.into_iter().all(enough).then_some(best)
    }

    /// Where the cells lie across lines of a direction.
    #[inline]
    fn across(&self, angle: f32) -> Across {
        let normal = [angle.cos(), angle.sin()];
        let mut across = Across { angle, normal, places: [0.0; MOST_KNOWN] };
        for ((place, x), y) in across.places.iter_mut().zip(&self.columns).zip(&self.rows) {
            *place = x * normal[0] + y * normal[1];
        }
        across
    }

    /// Two lights, and what they leave to explain: the best of lines all over the grid, then of lines near it.
    #[inline]
    fn shaded(&self, middle: f32) -> Option<(Light, f32)> {
        const DIRECTIONS: i32 = 12;
        let (mut turn, mut step) = (std::f32::consts::PI / DIRECTIONS as f32, (middle + 1.0) / 5.0);
        let line = |across: &Across, aside: f32| {
            let [a, b] = across.normal;
            self.split(across, middle * (a + b) + aside)
        };
        let mut best: Option<(Light, f32)> = None;
        let mut at = (0.0, 0.0);
        let mut look = |across: &Across, aside: f32, at: &mut (f32, f32)| {
            let Some(found) = line(across, aside) else { return };
            if best.is_none_or(|best| found.1 < best.1) {
                best = Some(found);
                *at = (across.angle, aside);
            }
        };
        for direction in 0..DIRECTIONS {
            let across = self.across(turn * direction as f32);
            for aside in -5..=5 {
                look(&across, step * aside as f32, &mut at);
            }
        }
        for _ in 0..4 {
            turn *= 0.5;
            step *= 0.5;
            let (angle, aside) = at;
            for (dt, ds) in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)] {
                look(&self.across(angle + dt * turn), aside + ds * step, &mut at);
            }
        }
        best
    }

    /// The light when a line separates two, and the squares that remain, each bounded.
    #[inline]
    fn split(&self, across: &Across, offset: f32) -> Option<(Light, f32)> {
        let beyond = self.beyond(across, offset);
        let [black, white] = self.sums;
        let before = [
            [black[0] - beyond[0][0], black[1] - beyond[0][1]],
            [white[0] - beyond[1][0], white[1] - beyond[1][1]],
        ];
        let sums = [before, beyond];
        let mut means = sums.map(|side| side.map(|[n, sum]| (n >= 2.0).then_some(sum / n)));
        if offset.is_infinite() {
            means[1] = means[0];
        }
        // What one side lacks follows from the ratio on the other one.
        let ratios = means.map(|[black, white]| Some(white? - black?));
        if let [Some(here), Some(there)] = ratios {
            // What covers the marker has no black and white in it.
            if here.max(there) > 2.5 * here.min(there) {
                return None;
            }
        }
        let mut logs = [[0.0; 2]; 2];
        for (s, log) in logs.iter_mut().enumerate() {
            let other = ratios[1 - s];
            *log = match means[s] {
                [Some(black), Some(white)] => [black, white],
                [Some(black), None] => [black, black + other?],
                [None, Some(white)] => [white - other?, white],
                [None, None] => return None,
            };
        }
        let misfit = self.misfit(across, offset, logs);
        let levels = logs.map(|side| side.map(|log| log.exp() - SCATTERED));
        Some((Light { normal: across.normal, offset, levels, reflection: None }, misfit))
    }

    /// Of black and of white cells beyond a line, how many there are and the sum of their logarithms.
    #[inline]
    fn beyond(&self, across: &Across, offset: f32) -> [[f32; 2]; 2] {
        let mut sums = [[[0.0_f32; LANES]; 2]; 2];
        for from in (0..self.count).step_by(LANES) {
            let [place, log, black, white] = [&across.places, &self.logs, &self.black, &self.white]
                .map(|list| lanes(list, from));
            for lane in 0..LANES {
                let share = f32::from(u8::from(place[lane] > offset));
                for (sums, ink) in sums.iter_mut().zip([black, white]) {
                    sums[0][lane] += share * ink[lane];
                    sums[1][lane] += share * ink[lane] * log[lane];
                }
            }
        }
        sums.map(|sums| sums.map(|lanes| lanes.iter().sum()))
    }

    /// The squares that remain, each bounded, when black and white have these logarithms before and beyond a line.
    #[inline]
    fn misfit(&self, across: &Across, offset: f32, levels: [[f32; 2]; 2]) -> f32 {
        let mut sums = [0.0_f32; LANES];
        for from in (0..self.count).step_by(LANES) {
            let [place, log, black, white] = [&across.places, &self.logs, &self.black, &self.white]
                .map(|list| lanes(list, from));
            for lane in 0..LANES {
                let [dark, bright] = if place[lane] > offset { levels[1] } else { levels[0] };
                let expected = black[lane] * dark + white[lane] * bright;
                sums[lane] += bounded(log[lane] - expected);
            }
        }
        sums.iter().sum()
    }

    /// One light and a reflection, and what they leave to explain.
    fn reflected(&self) -> Option<(Light, f32)> {
        // The darker ones of each ink are those outside of the reflection.
        let plain = [false, true].map(|white| self.quarter(white));
        let [black, white] = plain;
        let levels = [[black?, white?]; 2];
        let mut sums = nalgebra::Matrix4::<f32>::zeros();
        let mut sides = nalgebra::Vector4::<f32>::zeros();
        for i in 0..self.count {
            let added = self.values[i] - levels[0][usize::from(self.is_white(i))];
            if added < 5.0 || self.values[i] > SATURATED {
                continue;
            }
            let [x, y] = [self.columns[i], self.rows[i]];
            let row = nalgebra::Vector4::new(1.0, x, y, x * x + y * y);
            // The error of a logarithm is that of the level by the level.
            let weight = (added / 20.0).powi(2).min(25.0);
            sums += weight * row * row.transpose();
            sides += weight * added.ln() * row;
        }
        let shape = sums.cholesky()?.solve(&sides);
        if shape[3] >= 0.0 {
            return None;
        }
        let reflection = Some([shape[0], shape[1], shape[2], shape[3]]);
        let light = Light { normal: [1.0, 0.0], offset: f32::INFINITY, levels, reflection };
        let misfit = (0..self.count)
            .map(|i| {
                let [black, white] = light.at([self.columns[i], self.rows[i]], 0);
                let expected = if self.is_white(i) { white } else { black };
                bounded(self.logs[i] - log(expected))
            })
            .sum();
        Some((light, misfit))
    }

    /// A grey value that a quarter of the cells of one ink stay below.
    fn quarter(&self, white: bool) -> Option<f32> {
        let mut values = [0.0; MOST_CELLS];
        let mut count = 0;
        for i in 0..self.count {
            if self.is_white(i) == white {
                values[count] = self.values[i];
                count += 1;
            }
        }
        let values = &mut values[..count];
        values.sort_unstable_by(f32::total_cmp);
        values.get(count / 4).copied()
    }
}

/// Some cells of a list.
#[inline]
fn lanes(list: &[f32; MOST_KNOWN], from: usize) -> &[f32; LANES] {
    const NONE: [f32; LANES] = [0.0; LANES];
    list.get(from..).and_then(|list| list.first_chunk()).unwrap_or(&NONE)
}

/// What the lens scatters into the dark, in grey levels: it keeps the logarithm of the darkest from deciding alone.
const SCATTERED: f32 = 8.0;

/// From here on a pixel may be at its end.
const SATURATED: f32 = 245.0;

fn log(value: f32) -> f32 {
    (value.min(255.0) + SCATTERED).ln()
}

/// The square of a difference of logarithms; what is covered counts no more than so much.
#[inline]
fn bounded(difference: f32) -> f32 {
    const MOST: f32 = 0.5;
    difference.abs().min(MOST).powi(2)
}

impl Light {
    /// Black and white at a place, by the light of one side of the edge.
    fn at(&self, [x, y]: [f32; 2], side: usize) -> [f32; 2] {
        let added = self.reflection.map_or(0.0, |[constant, by_x, by_y, by_squares]| {
            (constant + by_x * x + by_y * y + by_squares * (x * x + y * y)).min(6.0).exp()
        });
        self.levels[side].map(|level| (level + added).min(255.0))
    }

    /// Black and white at a place without the reflection.
    fn plain(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let beyond = x * self.normal[0] + y * self.normal[1] - self.offset;
        self.levels[usize::from(beyond > 0.0)]
    }

    /// Whether a reflection adds to it.
    pub(crate) fn is_reflected(&self) -> bool {
        self.reflection.is_some()
    }

    /// Whether a grey value is at the sensor's end where white is not.
    pub(crate) fn is_brighter(&self, place: [f32; 2], value: f32) -> bool {
        let [_, white] = self.plain(place);
        white < SATURATED - 10.0 && value > SATURATED
    }

    /// Where a grey value lies between black (0) and white (1); `None` outside of the image, where the two lights
    /// disagree about it, and where a reflection leaves no difference.
    pub(crate) fn white_share(&self, place: [f32; 2], value: f32) -> Option<f32> {
        if !value.is_finite() {
            return None;
        }
        let [x, y] = place;
        let beyond = x * self.normal[0] + y * self.normal[1] - self.offset;
        let share = |side: usize| {
            let [black, white] = self.at(place, side);
            let left = (white - black) / (self.levels[side][1] - self.levels[side][0]);
            (left > 0.2).then(|| (value - black) / (white - black))
        };
        let here = share(usize::from(beyond > 0.0))?;
        const NEAR: f32 = 0.4;
        if beyond.abs() < NEAR {
            let there = share(usize::from(beyond <= 0.0))?;
            if (here > 0.5) != (there > 0.5) {
                return None;
            }
        }
        Some(here)
    }
}

/// From the marker's unit square to the image (projective, the corners clockwise from the top left one).
struct Projection([f64; 8]);

impl Projection {
    fn of(corners: &[Pixel; 4]) -> Option<Self> {
        let [a, b, c, d] = corners.map(|p| [p.x, p.y]);
        let sub = |p: [f64; 2], q: [f64; 2]| [p[0] - q[0], p[1] - q[1]];
        let (bc, dc) = (sub(b, c), sub(d, c));
        let sum = [a[0] - b[0] + c[0] - d[0], a[1] - b[1] + c[1] - d[1]];
        let det = bc[0] * dc[1] - dc[0] * bc[1];
        if det.is_nan() || det.abs() <= 1e-6 {
            return None;
        }
        let g = (sum[0] * dc[1] - dc[0] * sum[1]) / det;
        let h = (bc[0] * sum[1] - sum[0] * bc[1]) / det;
        let row = |i: usize| [b[i] - a[i] + g * b[i], d[i] - a[i] + h * d[i], a[i]];
        let ([p, q, r], [s, t, u]) = (row(0), row(1));
        Some(Self([p, q, r, s, t, u, g, h]))
    }

    fn at(&self, [x, y]: [f64; 2]) -> Option<[f64; 2]> {
        let [a, b, c, d, e, f, g, h] = self.0;
        let w = g * x + h * y + 1.0;
        (w > 1e-3).then(|| [(a * x + b * y + c) / w, (d * x + e * y + f) / w])
    }
}

fn bilinear(view: GrayView<'_>, [x, y]: [f64; 2]) -> Option<f32> {
    imaging::bilinear(view, x, y).map(|value| value as f32)
}

#[cfg(test)]
mod tests {
    use super::*;
    use markers::Family;

    #[test]
    fn two_bits_of_sixteen_may_be_washed_out_when_any_id_is_looked_for() {
        let code = SquareCode::for_family(Family::Aruco4x4_50).unwrap();
        for (hidden, is_read) in [(0, true), (2, true), (4, false)] {
            let known = 0xffff_u64 << hidden & 0xffff;
            let reading = best_word(code.codewords[7] & known, known, code, None);
            assert_eq!(reading.map(|reading| reading.id), is_read.then_some(7), "{hidden} bits");
        }
    }
}
