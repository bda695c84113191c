//! Fits gain and offset with saturation: black and contrast of an image whose fractions of white are known.

/// Least-squares line from the fraction of white that a pixel should see to the grey value it has.
#[derive(Copy, Clone, Debug, Default)]
struct Exposure {
    n: f64,
    white: f64,
    white_white: f64,
    grey: f64,
    white_grey: f64,
}

impl Exposure {
    /// Adds a pixel: its fraction of white, from 0 to 1, and its grey value.
    fn add(&mut self, white: f64, grey: f64) {
        self.n += 1.0;
        self.white += white;
        self.white_white += white * white;
        self.grey += grey;
        self.white_grey += white * grey;
    }

    /// Black, and white minus black, in grey levels; not finite when all pixels have the same fraction.
    fn black_and_contrast(&self) -> [f64; 2] {
        let Self { n, white, white_white, grey, white_grey } = *self;
        let contrast = (n * white_grey - white * grey) / (n * white_white - white * white);
        [(grey - contrast * white) / n, contrast]
    }
}

/// The same for pixels that saturate: when white is brighter than the saturation level, only the darker
/// pixels count.
#[derive(Copy, Clone, Debug)]
pub(crate) struct ClippedExposure {
    saturation: f64,
    all: Exposure,
    darker: Exposure,
}

impl ClippedExposure {
    /// No pixels yet; the brightest have the grey value `saturation`.
    pub(crate) fn new(saturation: f64) -> Self {
        Self { saturation, all: Exposure::default(), darker: Exposure::default() }
    }

    /// As [`Exposure::add`].
    pub(crate) fn add(&mut self, white: f64, grey: f64) {
        self.all.add(white, grey);
        if grey < self.saturation {
            self.darker.add(white, grey);
        }
    }

    /// As [`Exposure::black_and_contrast`].
    pub(crate) fn black_and_contrast(&self) -> [f64; 2] {
        let is_saturated = |[black, contrast]: &[f64; 2]| black + contrast > self.saturation;
        let saturated = Some(self.darker.black_and_contrast()).filter(is_saturated);
        saturated.unwrap_or_else(|| self.all.black_and_contrast())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn black_and_contrast_are_those_of_the_pixels() {
        let mut exposure = Exposure::default();
        for (white, grey) in [(0.0, 20.0), (0.25, 60.0), (1.0, 180.0)] {
            exposure.add(white, grey);
        }
        let [black, contrast] = exposure.black_and_contrast();
        assert!((black - 20.0).abs() < 1e-9 && (contrast - 160.0).abs() < 1e-9);
        let mut alike = Exposure::default();
        alike.add(0.5, 90.0);
        alike.add(0.5, 91.0);
        assert!(!alike.black_and_contrast()[1].is_finite());
    }

    #[test]
    fn saturated_white_follows_from_the_darker_pixels() {
        for (white_grey, seen) in [(400.0_f64, 255.0_f64), (200.0, 200.0)] {
            let mut exposure = ClippedExposure::new(255.0);
            for white in [0.0, 0.25, 0.5, 1.0] {
                exposure.add(white, (20.0 + white * (white_grey - 20.0)).min(seen));
            }
            let [black, contrast] = exposure.black_and_contrast();
            assert!((black - 20.0).abs() < 1e-9 && (black + contrast - white_grey).abs() < 1e-9);
        }
    }
}
