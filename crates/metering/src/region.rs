//! Measures the grey levels of the pad's white and black in a frame.

use imaging::GrayView;

use crate::pad::Pad;

/// Radius of the region relative to the pad's largest extent: that of a square is its diagonal, half of which is 0.35
/// sides, so that the region stays within it however it is turned.
const RADIUS_PER_SIZE: f64 = 0.35;
/// Maximum number of samples along the region's edge: more cost time and add no information.
const MAX_SAMPLES: usize = 64;
/// Minimum number of samples: of a smaller part of the pad too little is seen.
const MIN_SAMPLES: u32 = 24;
/// The part of the samples that may be darker than the darkest level, or brighter than the brightest: noise and edges.
const TAIL: f64 = 0.05;

/// Grey levels of the pad, from 0 to 1 for full scale.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Levels {
    /// The median of its bright half: its white where the light falls on it.
    pub white: f64,
    /// The darkest level, without noise: its black.
    pub black: f64,
}

/// Luma of black and of white where its range is limited (ITU-R BT.601).
const LIMITED_BLACK: f64 = 16.0;
const LIMITED_WHITE: f64 = 235.0;

impl Levels {
    /// The same of luma whose range is limited: full scale is at 235 of 255 there, and black at 16.
    #[must_use]
    pub fn of_limited_range(self) -> Self {
        let full = |level: f64| {
            let part = (level * 255.0 - LIMITED_BLACK) / (LIMITED_WHITE - LIMITED_BLACK);
            part.clamp(0.0, 1.0)
        };
        Self { white: full(self.white), black: full(self.black) }
    }
}

/// The levels of the pad in this frame; `None` when it does not show enough of it, or when the pad may be elsewhere, having
/// moved by more than its size since it was seen: the ground there may be in another light.
///
/// White is the median of the samples brighter than the mean of the darkest and the brightest level. A reflection that
/// covers less than half of the white does not change it, nor does a shadow on a part of the pad.
pub fn levels(frame: GrayView<'_>, pad: &Pad) -> Option<Levels> {
    if pad.drift_px > pad.size_px {
        return None;
    }
    let histogram = Histogram::of(frame, pad)?;
    let (dark, bright) = (histogram.quantile(TAIL, 0)?, histogram.quantile(1.0 - TAIL, 0)?);
    let middle = (dark + bright).div_ceil(2);
    let white = histogram.quantile(0.5, middle)?;
    let scale = |level: usize| level as f64 / 255.0;
    Some(Levels { white: scale(white), black: scale(dark) })
}

struct Histogram {
    counts: [u32; 256],
}

impl Histogram {
    /// The samples in the pad's circle.
    fn of(frame: GrayView<'_>, pad: &Pad) -> Option<Self> {
        let [x, y] = pad.centre_px;
        let radius = RADIUS_PER_SIZE * pad.size_px;
        if ![x, y, radius].iter().all(|n| n.is_finite()) {
            return None;
        }
        let step = (2.0 * radius / MAX_SAMPLES as f64).ceil().max(1.0) as usize;
        let along = |centre: f64, edge: usize| {
            let from = (centre - radius).ceil().max(0.0) as usize;
            let to = (centre + radius).floor().clamp(-1.0, edge as f64 - 1.0) + 1.0;
            (from..to as usize).step_by(step)
        };
        let mut counts = [0; 256];
        for row in along(y, frame.height()) {
            let pixels = frame.row(row);
            let dy = row as f64 - y;
            for column in along(x, frame.width()) {
                let dx = column as f64 - x;
                let Some(&level) = pixels.get(column) else { continue };
                if dx * dx + dy * dy <= radius * radius
                    && let Some(count) = counts.get_mut(usize::from(level))
                {
                    *count += 1;
                }
            }
        }
        let histogram = Self { counts };
        (histogram.count(0) >= MIN_SAMPLES).then_some(histogram)
    }

    /// Number of samples from this level on.
    fn count(&self, from: usize) -> u32 {
        self.counts.iter().skip(from).sum()
    }

    /// The level below which this part of the samples lies that are at least `from`.
    fn quantile(&self, part: f64, from: usize) -> Option<usize> {
        let needed = part * f64::from(self.count(from));
        let mut below = 0;
        self.counts.iter().enumerate().skip(from).find_map(|(level, count)| {
            below += count;
            (below > 0 && f64::from(below) >= needed).then_some(level)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use imaging::GrayImage;
    use proptest::prelude::*;

    const PAD: Pad =
        Pad { centre_px: [100.0, 80.0], size_px: 60.0, motion_px_s: 0.0, drift_px: 0.0 };

    /// A frame in which the pad has stripes of black and white, painted by a function of column and row.
    fn frame(paint: impl Fn(usize, usize) -> u8) -> GrayImage {
        let mut image = GrayImage::filled(200, 160, 0);
        for y in 0..160 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                *pixel = paint(x, y);
            }
        }
        image
    }

    fn stripes(x: usize) -> bool {
        x.is_multiple_of(8) || x % 8 < 4
    }

    fn seen(paint: impl Fn(usize, usize) -> u8) -> [u8; 2] {
        let image = frame(paint);
        let levels = levels(image.view().unwrap(), &PAD).unwrap();
        [levels.white, levels.black].map(|level| (level * 255.0).round() as u8)
    }

    #[test]
    fn white_and_black_are_measured_on_any_ground() {
        for ground in [0, 90, 255] {
            let is_pad = |x: usize, y: usize| x.abs_diff(100) < 25 && y.abs_diff(80) < 25;
            let paint = |x, y| match (is_pad(x, y), stripes(x)) {
                (false, _) => ground,
                (true, true) => 180,
                (true, false) => 12,
            };
            assert_eq!(seen(paint), [180, 12], "ground {ground}");
        }
    }

    #[test]
    fn white_of_a_limited_range_is_clipped_at_235() {
        let levels = |white: f64, black: f64| Levels { white: white / 255.0, black: black / 255.0 };
        assert_eq!(levels(235.0, 16.0).of_limited_range(), levels(255.0, 0.0));
        assert_eq!(levels(250.0, 4.0).of_limited_range(), levels(255.0, 0.0), "beyond it");
        let middle = levels(125.5, 125.5).of_limited_range();
        assert!((middle.white - 0.5).abs() < 1e-9, "{middle:?}");
    }

    #[test]
    fn a_reflection_and_a_shadow_on_a_part_of_the_pad_do_not_change_its_white() {
        let pad = |x, white| if stripes(x) { white } else { 10 };
        assert_eq!(
            seen(|x, y| if y < 85 { 255 } else { pad(x, 170) })[0],
            255,
            "most of the white"
        );
        assert_eq!(seen(|x, y| if y < 67 && stripes(x) { 255 } else { pad(x, 170) }), [170, 10]);
        assert_eq!(seen(|x, y| pad(x, if y < 80 { 50 } else { 170 })), [170, 10]);
    }

    #[test]
    fn a_pad_outside_the_frame_or_a_few_pixels_wide_has_no_levels() {
        let image = frame(|_, _| 100);
        let view = image.view().unwrap();
        for (centre_px, size_px) in
            [([-40.0, 80.0], 60.0), ([230.0, 80.0], 60.0), ([9.0, 9.0], 6.0)]
        {
            assert_eq!(levels(view, &Pad { centre_px, size_px, ..PAD }), None);
        }
        assert!(levels(view, &Pad { centre_px: [0.0, 0.0], ..PAD }).is_some(), "a quarter of it");
        assert!(levels(view, &Pad { drift_px: 59.0, ..PAD }).is_some());
        assert_eq!(levels(view, &Pad { drift_px: 61.0, ..PAD }), None, "it may be elsewhere");
    }

    proptest! {
        #[test]
        fn no_detection_makes_it_panic(x: f64, y: f64, size_px: f64) {
            let image = frame(|x, _| x as u8);
            let pad = Pad { centre_px: [x, y], size_px, ..PAD };
            if let Some(found) = levels(image.view().unwrap(), &pad) {
                prop_assert!(found.black <= found.white && (0.0..=1.0).contains(&found.white));
            }
        }

        #[test]
        fn black_is_not_above_white(
            x in -50.0..250.0f64, y in -50.0..210.0f64, size_px in 0.0..1e4f64,
            a: u8, b: u8,
        ) {
            let image = frame(|x, y| if (x ^ y) & 4 == 0 { a } else { b });
            let pad = Pad { centre_px: [x, y], size_px, ..PAD };
            if let Some(found) = levels(image.view().unwrap(), &pad) {
                prop_assert!(found.black <= found.white && (0.0..=1.0).contains(&found.white));
            }
        }
    }
}
