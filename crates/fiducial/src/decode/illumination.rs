//! Estimates the illumination of a marker: one light, two on the sides of a shadow's edge, or one with a reflection.
//!
//! The cells that are known to be black or white, of the border and the quiet zone, determine it. By it every
//! other grey value is judged.

use imaging::with_vectors;

/// Largest number of known cells.
pub(crate) const MAX_CELLS: usize = 225;
/// Smallest difference of white and black, in grey levels.
const MIN_CONTRAST: f32 = 8.0;
/// Smallest logarithm of the ratio of white to black, and largest multiple of it anywhere on the border.
const MIN_LOG_RATIO: f32 = 0.08;
const MAX_LOG_RATIO_VARIATION: f32 = 4.0;
/// Smallest fraction of the known cells of either colour that must look as they should, among those that are
/// seen, ...
const MIN_INTACT: f32 = 0.6;
/// ... and among all.
const MIN_SEEN: f32 = 0.35;

/// The observed colour of a cell.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) enum Colour {
    Black,
    White,
    /// Neither black nor white.
    Grey,
    /// Saturated where white paper is not.
    Glare,
    /// Outside of the image, or where black and white look the same.
    Unknown,
}

impl Colour {
    /// By its position between black and white.
    pub(crate) fn from_white_share(share: f32) -> Self {
        if share < 0.4 {
            Self::Black
        } else if share > 0.6 {
            Self::White
        } else {
            Self::Grey
        }
    }
}

/// The logarithms of white over black at up to `N` places along a border.
pub(crate) struct BorderRatios<const N: usize> {
    log_ratios: [f32; N],
    seen: usize,
    /// How many are too low for a border, and how many may be, if all places are seen.
    low: usize,
    max_low: usize,
}

impl<const N: usize> BorderRatios<N> {
    /// Of a border that is looked at in so many places.
    pub(crate) fn new(places: usize) -> Self {
        Self { log_ratios: [0.0; N], seen: 0, low: 0, max_low: quantile(2, places) }
    }

    /// Adds a position; false when it is not a border, independent of the others.
    pub(crate) fn add(&mut self, log_ratio: f32) -> bool {
        if let Some(slot) = self.log_ratios.get_mut(self.seen) {
            *slot = log_ratio;
            self.seen += 1;
            self.low += usize::from(log_ratio <= MIN_LOG_RATIO);
        }
        self.low <= self.max_low
    }

    /// Whether they are nearly the same for most of the border, since a shadow keeps the ratio, and so many are seen.
    pub(crate) fn is_border(&mut self, min_seen: usize) -> bool {
        let log_ratios = &mut self.log_ratios[..self.seen];
        log_ratios.sort_unstable_by(f32::total_cmp);
        let at = |numerator: usize| log_ratios.get(quantile(numerator, log_ratios.len())).copied();
        let (Some(low), Some(high)) = (at(2), at(4)) else { return false };
        self.seen >= min_seen && low > MIN_LOG_RATIO && high < MAX_LOG_RATIO_VARIATION * low
    }
}

/// The index of a quantile, in fifths, of so many sorted values.
fn quantile(fifths: usize, count: usize) -> usize {
    fifths * count / 5
}

/// The fraction of the seen cells that look as they should, the mean of black and white ones; `None` when it,
/// or the number of seen cells, is too small. Each cell is given by whether it should be white, and its observed colour.
pub(crate) fn intact_fraction(cells: impl Iterator<Item = (bool, Colour)>) -> Option<f32> {
    let mut counts = [[0.0_f32; 3]; 2];
    for (is_white, colour) in cells {
        let expected = if is_white { Colour::White } else { Colour::Black };
        let [all, good, unknown] = &mut counts[usize::from(is_white)];
        *all += 1.0;
        *good += f32::from(u8::from(colour == expected));
        *unknown += f32::from(u8::from(matches!(colour, Colour::Unknown | Colour::Glare)));
    }
    let fractions = counts.map(
        |[all, good, unknown]| {
            if good >= MIN_SEEN * all { good / (all - unknown) } else { 0.0 }
        },
    );
    let is_intact = fractions.iter().all(|fraction| *fraction >= MIN_INTACT);
    is_intact.then_some(0.5 * (fractions[0] + fractions[1]))
}

/// How well samples of cells, as positions between black and white, agree with the cells' colours.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Agreement {
    squares: f32,
    samples: f32,
    whites: f32,
}

impl Agreement {
    /// Adds the samples of one cell.
    pub(crate) fn add(&mut self, is_white: bool, samples: &[f32]) {
        let white = f32::from(u8::from(is_white));
        self.squares += samples.iter().map(|share| (share - white).powi(2)).sum::<f32>();
        self.samples += samples.len() as f32;
        self.whites += white * samples.len() as f32;
    }

    /// The fraction of the variance that the colours explain.
    pub(crate) fn r_squared(&self) -> f32 {
        let samples = self.samples.max(1.0);
        let white = self.whites / samples;
        // About half of the bits of a codeword are white; one with fewer must not be held to less.
        let variance = (white * (1.0 - white)).max(0.15);
        if self.samples > 0.0 {
            (1.0 - self.squares / samples / variance).clamp(0.0, 1.0)
        } else {
            0.0
        }
    }
}

/// The light over a marker. Places are in cells; the middle of the square's top left cell is at (0, 0).
#[derive(Copy, Clone, Debug)]
pub(crate) struct Illumination {
    /// The edge of a shadow; infinitely far away when there is none.
    normal: [f32; 2],
    offset: f32,
    /// Black and white before and beyond the edge.
    levels: [[f32; 2]; 2],
    /// The logarithm of the light that a reflection adds: constant, by x, by y and by the sum of both
    /// squares.
    reflection: Option<[f32; 4]>,
}

/// Number of cells that are processed together.
const LANES: usize = 8;
const MAX_KNOWN: usize = MAX_CELLS.next_multiple_of(LANES);

/// The cells that are known to be black or white, with their grey values. The list is padded to a whole
/// number of [`LANES`] with cells of neither colour, whose logarithm is 0.
pub(crate) struct ReferenceCells {
    count: usize,
    columns: [f32; MAX_KNOWN],
    rows: [f32; MAX_KNOWN],
    values: [f32; MAX_KNOWN],
    /// Logarithms of the values: a shadow keeps the ratio of black and white.
    logs: [f32; MAX_KNOWN],
    /// 1 for cells of the colour, 0 for others.
    black: [f32; MAX_KNOWN],
    white: [f32; MAX_KNOWN],
    /// Number of black and of white cells, and the sums of their logarithms.
    sums: [[f32; 2]; 2],
}

/// Positions of the cells along one direction, in cells.
struct Projection {
    angle: f32,
    normal: [f32; 2],
    positions: [f32; MAX_KNOWN],
}

impl Default for ReferenceCells {
    fn default() -> Self {
        let none = [0.0; MAX_KNOWN];
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

impl ReferenceCells {
    /// Adds a cell; its place is in cells from the middle of the square's upper left one.
    pub(crate) fn push(&mut self, [column, row]: [f32; 2], value: f32, white: bool) {
        if self.count < MAX_CELLS {
            let (at, log) = (self.count, log(value));
            (self.columns[at], self.rows[at]) = (column, row);
            (self.values[at], self.logs[at]) = (value, log);
            let colour = if white { &mut self.white } else { &mut self.black };
            colour[at] = 1.0;
            let [count, sum] = &mut self.sums[usize::from(white)];
            *count += 1.0;
            *sum += log;
            self.count += 1;
        }
    }

    fn is_white(&self, index: usize) -> bool {
        self.white[index] > 0.0
    }

    /// The illumination that explains the cells best; the square's middle is at `middle` on both axes.
    pub(crate) fn illumination(&self, middle: f32) -> Option<Illumination> {
        let (mut best, mut residual) = self.split(&self.project(0.0), f32::INFINITY)?;
        // A small residual needs no second light.
        if residual > 0.01 * self.count as f32 {
            let limit = 0.6 * residual;
            let others = [self.with_reflection(), with_vectors(|| self.with_shadow(middle))];
            for (light, here) in others.into_iter().flatten() {
                if here < limit && here < residual {
                    (best, residual) = (light, here);
                }
            }
        }
        let has_contrast = |[black, white]: [f32; 2]| white - black >= MIN_CONTRAST;
        best.levels.into_iter().all(has_contrast).then_some(best)
    }

    /// The cells' positions along a direction.
    #[inline(always)]
    fn project(&self, angle: f32) -> Projection {
        let normal = [angle.cos(), angle.sin()];
        let mut projection = Projection { angle, normal, positions: [0.0; MAX_KNOWN] };
        for ((position, x), y) in projection.positions.iter_mut().zip(&self.columns).zip(&self.rows)
        {
            *position = x * normal[0] + y * normal[1];
        }
        projection
    }

    /// Two lights on the sides of a shadow's edge, and their residual. Edges all over the grid are tried, then
    /// edges near the best one.
    #[inline(always)]
    fn with_shadow(&self, middle: f32) -> Option<(Illumination, f32)> {
        const DIRECTIONS: i32 = 12;
        let (mut turn, mut step) = (std::f32::consts::PI / DIRECTIONS as f32, (middle + 1.0) / 5.0);
        let split = |projection: &Projection, offset: f32| {
            let [a, b] = projection.normal;
            self.split(projection, middle * (a + b) + offset)
        };
        let mut best: Option<(Illumination, f32)> = None;
        let mut at = (0.0, 0.0);
        let mut try_edge = |projection: &Projection, offset: f32, at: &mut (f32, f32)| {
            let Some(found) = split(projection, offset) else { return };
            if best.is_none_or(|best| found.1 < best.1) {
                best = Some(found);
                *at = (projection.angle, offset);
            }
        };
        for direction in 0..DIRECTIONS {
            let projection = self.project(turn * direction as f32);
            for offset in -5..=5 {
                try_edge(&projection, step * offset as f32, &mut at);
            }
        }
        for _ in 0..4 {
            turn *= 0.5;
            step *= 0.5;
            let (angle, offset) = at;
            for (dt, ds) in [(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)] {
                try_edge(&self.project(angle + dt * turn), offset + ds * step, &mut at);
            }
        }
        best
    }

    /// The illumination with a shadow's edge at `offset` along a direction, and its residual.
    #[inline(always)]
    fn split(&self, projection: &Projection, offset: f32) -> Option<(Illumination, f32)> {
        let beyond = self.beyond(projection, offset);
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
        // A colour without cells on one side follows from the ratio on the other side.
        let ratios = means.map(|[black, white]| Some(white? - black?));
        if let [Some(here), Some(there)] = ratios {
            // Such a step is not a shadow: something covers the marker.
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
        let residual = self.residual(projection, offset, logs);
        let levels = logs.map(|side| side.map(|log| log.exp() - STRAY_LIGHT));
        Some((
            Illumination { normal: projection.normal, offset, levels, reflection: None },
            residual,
        ))
    }

    /// Number of black and of white cells beyond the edge, and the sums of their logarithms.
    #[inline(always)]
    fn beyond(&self, projection: &Projection, offset: f32) -> [[f32; 2]; 2] {
        let mut sums = [[[0.0_f32; LANES]; 2]; 2];
        for from in (0..self.count).step_by(LANES) {
            let [position, log, black, white] =
                [&projection.positions, &self.logs, &self.black, &self.white]
                    .map(|list| lanes(list, from));
            for lane in 0..LANES {
                let share = f32::from(u8::from(position[lane] > offset));
                for (sums, colour) in sums.iter_mut().zip([black, white]) {
                    sums[0][lane] += share * colour[lane];
                    sums[1][lane] += share * colour[lane] * log[lane];
                }
            }
        }
        sums.map(|sums| sums.map(|lanes| lanes.iter().sum()))
    }

    /// Sum of the bounded squared residuals, for these logarithms of black and white before and beyond the
    /// edge.
    #[inline(always)]
    fn residual(&self, projection: &Projection, offset: f32, levels: [[f32; 2]; 2]) -> f32 {
        let mut sums = [0.0_f32; LANES];
        for from in (0..self.count).step_by(LANES) {
            let [position, log, black, white] =
                [&projection.positions, &self.logs, &self.black, &self.white]
                    .map(|list| lanes(list, from));
            for lane in 0..LANES {
                let [dark, bright] = if position[lane] > offset { levels[1] } else { levels[0] };
                let expected = black[lane] * dark + white[lane] * bright;
                sums[lane] += bounded_square(log[lane] - expected);
            }
        }
        sums.iter().sum()
    }

    /// One light with a reflection, and its residual.
    fn with_reflection(&self) -> Option<(Illumination, f32)> {
        // The darker cells of each colour are outside of the reflection.
        let plain = [false, true].map(|white| self.first_quartile(white));
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
            // The error of a logarithm is the relative error of the level.
            let weight = (added / 20.0).powi(2).min(25.0);
            sums += weight * row * row.transpose();
            sides += weight * added.ln() * row;
        }
        let shape = sums.cholesky()?.solve(&sides);
        if shape[3] >= 0.0 {
            return None;
        }
        let reflection = Some([shape[0], shape[1], shape[2], shape[3]]);
        let light = Illumination { normal: [1.0, 0.0], offset: f32::INFINITY, levels, reflection };
        let residual = (0..self.count)
            .map(|i| {
                let [black, white] = light.at([self.columns[i], self.rows[i]], 0);
                let expected = if self.is_white(i) { white } else { black };
                bounded_square(self.logs[i] - log(expected))
            })
            .sum();
        Some((light, residual))
    }

    /// First quartile of the grey values of one colour.
    fn first_quartile(&self, white: bool) -> Option<f32> {
        let mut values = [0.0; MAX_CELLS];
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

/// One group of cells of a list.
#[inline]
fn lanes(list: &[f32; MAX_KNOWN], from: usize) -> &[f32; LANES] {
    const NONE: [f32; LANES] = [0.0; LANES];
    list.get(from..).and_then(|list| list.first_chunk()).unwrap_or(&NONE)
}

/// Stray light of the lens, in grey levels; it keeps the logarithm of the darkest cells from deciding alone.
const STRAY_LIGHT: f32 = 8.0;

/// Grey value from which on a pixel may be saturated.
pub(crate) const SATURATED: f32 = 245.0;

pub(crate) fn log(value: f32) -> f32 {
    (value.min(255.0) + STRAY_LIGHT).ln()
}

/// Squared difference of logarithms, bounded since some cells are covered.
#[inline]
fn bounded_square(difference: f32) -> f32 {
    const MAX: f32 = 0.5;
    difference.abs().min(MAX).powi(2)
}

impl Illumination {
    /// Black and white at a place, in the light of one side of the edge.
    fn at(&self, [x, y]: [f32; 2], side: usize) -> [f32; 2] {
        let added = self.reflection.map_or(0.0, |[constant, by_x, by_y, by_squares]| {
            (constant + by_x * x + by_y * y + by_squares * (x * x + y * y)).min(6.0).exp()
        });
        self.levels[side].map(|level| (level + added).min(255.0))
    }

    /// Black and white at a place without the reflection.
    pub(crate) fn without_reflection(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let beyond = x * self.normal[0] + y * self.normal[1] - self.offset;
        self.levels[usize::from(beyond > 0.0)]
    }

    /// Whether there is a reflection.
    pub(crate) fn is_reflected(&self) -> bool {
        self.reflection.is_some()
    }

    /// Whether a grey value is saturated where white is not.
    pub(crate) fn is_glare(&self, place: [f32; 2], value: f32) -> bool {
        let [_, white] = self.without_reflection(place);
        white < SATURATED - 10.0 && value > SATURATED
    }

    /// Position of a grey value between black (0) and white (1); `None` outside of the image, near the edge
    /// of a shadow where the two lights disagree, and where a reflection leaves no contrast.
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
