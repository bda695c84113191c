//! Holds a coded picture with a margin, and its half and quarter pixels for motion compensation (ITU-T H.264, 8.4.2.2.1).

/// Edge of a macroblock, in pixels.
pub(super) const MACROBLOCK: usize = 16;
/// Pixels around a picture that repeat its border, for motion that leads out of it.
const MARGIN: usize = 32;
/// The part of the margin that the filter between pixels needs.
const REACH: usize = 4;

/// Displacement to the place in the previous picture that predicts a block, in quarters of a pixel.
pub(super) type Motion = [i32; 2];

/// Grey levels of whole macroblocks with a margin.
#[derive(Clone, Debug, Default)]
pub(super) struct Plane {
    pixels: Vec<u8>,
    stride: usize,
    /// Without margins.
    pub(super) width: usize,
    pub(super) height: usize,
}

impl Plane {
    /// Takes a size, in pixels.
    pub(super) fn resize(&mut self, width: usize, height: usize) {
        let [width, height] = [width, height].map(|edge| edge.next_multiple_of(MACROBLOCK));
        (self.width, self.height, self.stride) = (width, height, width + 2 * MARGIN);
        self.pixels.resize(self.stride * (height + 2 * MARGIN), 0);
    }

    /// Index of a pixel, which may be in the margin.
    #[inline]
    fn at(&self, x: i32, y: i32) -> usize {
        (y + MARGIN as i32) as usize * self.stride + (x + MARGIN as i32) as usize
    }

    /// Some pixels of a row.
    #[inline]
    pub(super) fn row(&self, x: i32, y: i32, length: usize) -> &[u8] {
        &self.pixels[self.at(x, y)..][..length]
    }

    #[inline]
    pub(super) fn row_mut(&mut self, x: i32, y: i32, length: usize) -> &mut [u8] {
        let at = self.at(x, y);
        &mut self.pixels[at..][..length]
    }

    /// Index of a pixel and the distance of rows, for filters in both directions.
    pub(super) fn pixels_from(&mut self, x: usize, y: usize) -> (&mut [u8], usize, usize) {
        let at = self.at(x as i32, y as i32);
        (&mut self.pixels, at, self.stride)
    }

    /// Repeats the border of the first `width` x `height` pixels outwards.
    pub(super) fn extend(&mut self, width: usize, height: usize) {
        for y in 0..height {
            let start = self.at(0, y as i32);
            let (first, last) = (self.pixels[start], self.pixels[start + width - 1]);
            self.pixels[start - MARGIN..start].fill(first);
            let end = start + self.width + MARGIN;
            self.pixels[start + width..end].fill(last);
        }
        let line = |y: usize| y * self.stride..(y + 1) * self.stride;
        let (first, last) = (line(MARGIN), line(MARGIN + height - 1));
        for y in 0..MARGIN {
            self.pixels.copy_within(first.clone(), y * self.stride);
        }
        for y in MARGIN + height..self.height + 2 * MARGIN {
            self.pixels.copy_within(last.clone(), y * self.stride);
        }
    }
}

/// A picture that others are predicted from: its pixels and those half-way between, to the right, below, and both.
#[derive(Clone, Debug, Default)]
pub(super) struct Reference {
    planes: [Plane; 4],
    /// Sums down a row's columns before they are rounded.
    sums: Vec<i16>,
}

impl Reference {
    pub(super) fn resize(&mut self, width: usize, height: usize) {
        self.planes.iter_mut().for_each(|plane| plane.resize(width, height));
    }

    /// The pixels, to be written.
    pub(super) fn pixels(&mut self) -> &mut Plane {
        &mut self.planes[0]
    }

    /// Computes the samples between the pixels.
    pub(super) fn interpolate(&mut self) {
        let [whole, right, below, both] = &mut self.planes;
        let stride = whole.stride;
        self.sums.resize(stride, 0);
        let rows = whole.pixels.len() / stride;
        for y in 2..rows - 3 {
            let row = |y: usize| &whole.pixels[y * stride..][..stride];
            let here = row(y);
            let out = &mut right.pixels[y * stride..][..stride];
            six_across(&mut out[2..], here, 5);
            let lines = [row(y - 2), row(y - 1), here, row(y + 1), row(y + 2), row(y + 3)];
            let down = &mut below.pixels[y * stride..][..stride];
            six_down(&mut self.sums, down, lines);
            let out = &mut both.pixels[y * stride..][..stride];
            six_across(&mut out[2..], &self.sums, 10);
        }
    }

    /// The motion nearest to this one that a block at (x, y) may have.
    pub(super) fn clamped(&self, motion: Motion, x: usize, y: usize) -> Motion {
        let out = (MARGIN - REACH) as i32;
        let within = |by: i32, at: usize, edge: usize| {
            let (at, edge) = (at as i32, edge as i32);
            by.clamp(4 * (-out - at), 4 * (edge + out - MACROBLOCK as i32 - at))
        };
        let [width, height] = [self.planes[0].width, self.planes[0].height];
        [within(motion[0], x, width), within(motion[1], y, height)]
    }

    /// Where the two blocks begin whose mean predicts the one at (x, y) moved by `motion`.
    #[inline]
    fn sources(&self, x: usize, y: usize, motion: Motion) -> [&[u8]; 2] {
        let [first, second] = halves([motion[0] & 3, motion[1] & 3]);
        let (x, y) = (x as i32 + (motion[0] >> 2), y as i32 + (motion[1] >> 2));
        let source = |[across, down]: [i32; 2]| {
            let plane = &self.planes[(across & 1 | (down & 1) << 1) as usize];
            &plane.pixels[plane.at(x + (across >> 1), y + (down >> 1))..]
        };
        [source(first), source(second)]
    }

    /// The macroblock at (x, y) as this picture predicts it.
    pub(super) fn predict(&self, x: usize, y: usize, motion: Motion) -> [u8; 256] {
        let [first, second] = self.sources(x, y, motion);
        let stride = self.planes[0].stride;
        let mut out = [0; 256];
        for (row, line) in out.chunks_exact_mut(MACROBLOCK).enumerate() {
            let (a, b) = (&first[row * stride..], &second[row * stride..]);
            for (pixel, (a, b)) in line.iter_mut().zip(a.iter().zip(b)) {
                *pixel = mean(*a, *b);
            }
        }
        out
    }

    /// Sum of the absolute differences between a macroblock and this picture's prediction; where it is no less than `bound`,
    /// `bound` or more.
    pub(super) fn difference(
        &self,
        block: &[u8; 256],
        x: usize,
        y: usize,
        motion: Motion,
        bound: u32,
    ) -> u32 {
        let [first, second] = self.sources(x, y, motion);
        let stride = self.planes[0].stride;
        let is_between = (motion[0] | motion[1]) & 1 == 1;
        let mut sum = 0;
        for (row, line) in block.chunks_exact(MACROBLOCK).enumerate() {
            let (a, b) = (&first[row * stride..], &second[row * stride..]);
            let (a, b) = (&a[..MACROBLOCK], &b[..MACROBLOCK]);
            sum += if is_between {
                let off = |(pixel, (a, b)): (&u8, (&u8, &u8))| pixel.abs_diff(mean(*a, *b));
                line.iter().zip(a.iter().zip(b)).map(off).map(u32::from).sum::<u32>()
            } else {
                line.iter().zip(a).map(|(pixel, a)| u32::from(pixel.abs_diff(*a))).sum()
            };
            if sum >= bound {
                break;
            }
        }
        sum
    }
}

#[inline]
fn mean(a: u8, b: u8) -> u8 {
    ((u16::from(a) + u16::from(b) + 1) >> 1) as u8
}

/// The two places, in half pixels, whose mean is at this one, in quarters.
fn halves([across, down]: [i32; 2]) -> [[i32; 2]; 2] {
    match (across % 2, down % 2) {
        (0, 0) => [[across / 2, down / 2]; 2],
        (1, 0) => [[across / 2, down / 2], [across / 2 + 1, down / 2]],
        (0, _) => [[across / 2, down / 2], [across / 2, down / 2 + 1]],
        // Of the diagonals the one between half pixels.
        _ => [[1, 2 * (down / 2)], [2 * (across / 2), 1]],
    }
}

/// The filter of six pixels for the place in their middle.
#[inline]
fn taps([a, b, c, d, e, f]: [i32; 6]) -> i32 {
    a - 5 * b + 20 * c + 20 * d - 5 * e + f
}

#[inline]
fn rounded(sum: i32, bits: u32) -> u8 {
    ((sum + (1 << (bits - 1))) >> bits).clamp(0, 255) as u8
}

/// Filters along a row of grey levels, or of sums of them; `bits` is the logarithm of the weights' sum.
fn six_across<T: Copy + Into<i32>>(out: &mut [u8], row: &[T], bits: u32) {
    for (pixel, six) in out.iter_mut().zip(row.windows(6)) {
        let six = [six[0], six[1], six[2], six[3], six[4], six[5]].map(Into::into);
        *pixel = rounded(taps(six), bits);
    }
}

/// Filters down the columns of six rows.
fn six_down(sums: &mut [i16], out: &mut [u8], [a, b, c, d, e, f]: [&[u8]; 6]) {
    let pairs = a.iter().zip(f).zip(b.iter().zip(e)).zip(c.iter().zip(d));
    for ((sum, pixel), (((a, f), (b, e)), (c, d))) in sums.iter_mut().zip(out).zip(pairs) {
        let [a, b, c, d, e, f] = [a, b, c, d, e, f].map(|grey| i16::from(*grey));
        *sum = a + f - 5 * (b + e) + 20 * (c + d);
        *pixel = ((*sum + 16) >> 5).clamp(0, 255) as u8;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A picture that rises by 2 to the right and by 1 down.
    fn slope() -> Reference {
        let mut reference = Reference::default();
        reference.resize(48, 32);
        for y in 0..32 {
            for (x, pixel) in reference.pixels().row_mut(0, y, 48).iter_mut().enumerate() {
                *pixel = 20 + 2 * x as u8 + y as u8;
            }
        }
        reference.pixels().extend(48, 32);
        reference.interpolate();
        reference
    }

    #[test]
    fn a_slope_is_predicted_at_every_quarter_of_a_pixel() {
        let reference = slope();
        for quarter in 0..16 {
            let motion = [quarter % 4 - 8, quarter / 4 + 4];
            let block = reference.predict(16, 8, motion);
            for (at, pixel) in block.iter().enumerate() {
                let (x, y) = ((16 + at % 16) as f32, (8 + at / 16) as f32);
                let (x, y) = (x + motion[0] as f32 / 4.0, y + motion[1] as f32 / 4.0);
                assert!((f32::from(*pixel) - 20.0 - 2.0 * x - y).abs() <= 1.0, "{motion:?} {at}");
            }
            assert_eq!(reference.difference(&block, 16, 8, motion, u32::MAX), 0);
            assert!(
                reference.difference(&block, 16, 8, [motion[0] + 4, motion[1]], u32::MAX) >= 500
            );
        }
    }

    #[test]
    fn motion_ends_in_the_margin() {
        let reference = slope();
        for motion in [[-9999, 9999], [9999, -9999]] {
            let motion = reference.clamped(motion, 32, 16);
            reference.predict(32, 16, [motion[0] + 3, motion[1] + 3]);
        }
        assert_eq!(reference.clamped([5, -7], 16, 16), [5, -7]);
    }
}
