//! Models the effect of interpolating a colour mosaic on grey: each of its four kinds of pixels is blurred by its own kernel.
//!
//! Behind a mosaic of colour filters a pixel measures red, green or blue; the other two are means of its neighbours'
//! (bilinear interpolation). A grey pixel whose own colour is green has more of its own light than one whose colour is
//! red or blue, so that every other pixel of a thin line is paler.

/// Weights of red, green and blue in grey (Rec. ITU-R BT.601).
const GREY: [f64; 3] = [0.299, 0.587, 0.114];

/// Kinds of pixels.
pub(crate) const PHASES: usize = 4;

/// Which of four neighbours is red: their [`phase`]; the blue one is diagonally opposite.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Mosaic {
    pub(crate) red: u8,
}

/// Which of four neighbours a pixel is.
pub(crate) fn phase(x: usize, y: usize) -> u8 {
    u8::from(x % 2 == 1) + 2 * u8::from(y % 2 == 1)
}

/// A pixel's weights of its neighbours: of both beside it, of those above and below, of the four diagonal ones.
#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct Kernel {
    beside: f64,
    above_and_below: f64,
    diagonal: f64,
}

impl Mosaic {
    pub(crate) const ALL: [Self; PHASES] =
        [Self { red: 0 }, Self { red: 1 }, Self { red: 2 }, Self { red: 3 }];

    /// The mean variance of the kernels, in square pixels.
    pub(crate) const MEAN_VARIANCE: f64 = (GREY[1] + 2.0 * (GREY[0] + GREY[2])) / 4.0;

    /// By [`phase`].
    pub(crate) fn kernels(self) -> [Kernel; PHASES] {
        let [red, green, blue] = GREY;
        let coloured = |other: f64| Kernel {
            beside: green / 2.0,
            above_and_below: green / 2.0,
            diagonal: other,
        };
        let of_green =
            |beside: f64, above_and_below: f64| Kernel { beside, above_and_below, diagonal: 0.0 };
        let from_red = [coloured(blue), of_green(red, blue), of_green(blue, red), coloured(red)];
        std::array::from_fn(|phase| from_red[phase ^ usize::from(self.red % PHASES as u8)])
    }
}

impl Kernel {
    /// Variances to the right and down, in square pixels.
    pub(crate) fn variances(&self) -> [f64; 2] {
        [self.beside, self.above_and_below].map(|pair| pair + self.diagonal)
    }

    /// Fourth cumulant along the unit vector `normal`, over 24 times the square of the whole variance.
    #[inline]
    pub(crate) fn kurtosis(&self, normal: [f64; 2], variance: f64) -> f64 {
        let [xx, yy] = normal.map(|n| n * n);
        let [of_x, of_y] = self.variances();
        let own = of_x * xx + of_y * yy;
        let fourth = of_x * xx * xx + of_y * yy * yy + 6.0 * self.diagonal * xx * yy;
        (fourth - 3.0 * own * own) / (24.0 * variance * variance)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_kernels_are_on_average_equally_wide_both_ways() {
        for mosaic in Mosaic::ALL {
            let sum = mosaic
                .kernels()
                .map(|kernel| kernel.variances())
                .into_iter()
                .fold([0.0; 2], |[x, y], [by_x, by_y]| {
                    [x + by_x / PHASES as f64, y + by_y / PHASES as f64]
                });
            for mean in sum {
                assert!((mean - Mosaic::MEAN_VARIANCE).abs() < 1e-12, "{mean}");
            }
            let own =
                |kernel: Kernel| 1.0 - kernel.beside - kernel.above_and_below - kernel.diagonal;
            let own_light = mosaic.kernels().map(own);
            assert!((own_light[usize::from(mosaic.red)] - GREY[0]).abs() < 1e-12);
            assert!((own_light[usize::from(mosaic.red ^ 3)] - GREY[2]).abs() < 1e-12);
        }
    }
}
