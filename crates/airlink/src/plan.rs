//! Plans which parts of a frame are sent, at which scale and JPEG quality, so that they fit a size.
//!
//! The size of a JPEG file is predicted from the bytes per pixel of the last ones and a measured curve of
//! size over quality.

use messages::{FrameHeader, FramePart};

use crate::config::{AirConfig, Mode};
use crate::prediction::Roi;

/// Candidate qualities, best first; those between the two configured ones are used.
const QUALITIES: [u8; 9] = [95, 90, 85, 75, 65, 55, 45, 35, 25];
/// Candidate scales: pixels of the frame along the edge of one pixel of a part.
const SCALES: [u32; 7] = [1, 2, 3, 4, 6, 8, 12];
/// Minimum size of the smallest marker in an ROI of reduced resolution, in pixels: twice what is detected
/// well.
const MIN_MARKER_PX: f64 = 64.0;
/// Share of the overview in the bytes of a frame.
const OVERVIEW_SHARE: f64 = 0.25;
/// Candidate grids of tiles, columns and rows, coarsest first.
const GRIDS: [Grid; 6] = [
    Grid { columns: 2, rows: 1 },
    Grid { columns: 2, rows: 2 },
    Grid { columns: 3, rows: 2 },
    Grid { columns: 3, rows: 3 },
    Grid { columns: 4, rows: 3 },
    Grid { columns: 4, rows: 4 },
];
/// Overlap of neighbouring tiles, in pixels. Larger markers are detected in the overview.
const OVERLAP_PX: u32 = 96;
/// Maximum width of the overview, in its own pixels.
const MAX_OVERVIEW_PX: u32 = 330;
/// Edges of an ROI are multiples of this number of pixels, the size of a JPEG block.
const BLOCK: u32 = 8;
/// Bytes of a JPEG file before its pixels.
const HEADER_BYTES: f64 = 330.0;
/// Weight of a new file in the mean of bytes per pixel.
const WEIGHT: f64 = 0.3;
/// Size of JPEG files of rendered ground by quality, relative to quality 75, as measured by the example
/// `jpeg` of `tools/experiments`.
const SIZE_BY_QUALITY: [(u8, f64); 12] = [
    (1, 0.1),
    (20, 0.22),
    (30, 0.32),
    (35, 0.39),
    (45, 0.50),
    (55, 0.60),
    (65, 0.77),
    (75, 1.0),
    (85, 1.43),
    (90, 1.9),
    (95, 3.04),
    (100, 6.0),
];

/// How a frame is sent.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plan {
    /// JPEG quality of the first part, or of the whole frame.
    pub quality: u8,
    /// JPEG quality of the other parts.
    pub overview_quality: u8,
    /// The parts, finest first, with `bytes` not yet set. Empty: the whole frame at full resolution.
    pub parts: Vec<FramePart>,
}

/// The size of a frame, in pixels.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct FrameSize {
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
}

/// Tiles of a frame.
#[derive(Copy, Clone)]
struct Grid {
    columns: u32,
    rows: u32,
}

/// Plans frames, and learns from the size of their files.
#[derive(Clone, Debug)]
pub struct Planner {
    mode: Mode,
    max_quality: u8,
    min_quality: u8,
    /// Mean bytes per pixel at quality 75, of parts at full resolution and of reduced ones.
    bytes_per_pixel: [f64; 2],
    /// Number of frames of which a tile was sent.
    tile: u32,
}

impl Planner {
    /// A planner whose first predictions are for textured ground.
    pub fn new(config: &AirConfig) -> Self {
        Self {
            mode: config.mode,
            max_quality: config.quality,
            min_quality: config.min_quality,
            bytes_per_pixel: [0.12, 0.2],
            tile: 0,
        }
    }

    /// The best plan for a frame that fits `max_bytes`.
    pub fn plan(&mut self, size: FrameSize, roi: Option<Roi>, max_bytes: usize) -> Plan {
        let max_bytes = max_bytes as f64;
        if self.mode == Mode::Full {
            return self.whole(size, max_bytes);
        }
        match roi.filter(|roi| roi_part(*roi, size, 1).is_some()) {
            Some(roi) => self.with_roi(size, roi, max_bytes),
            None => self.tile(size, max_bytes),
        }
    }

    /// The whole frame if it fits, else its next tile at full resolution and an overview: reduced resolution
    /// or quality would hide a distant marker.
    fn tile(&mut self, size: FrameSize, max_bytes: f64) -> Plan {
        let whole = covering(size, 1);
        if whole.is_none_or(|whole| self.predicted_bytes(self.max_quality, &whole) <= max_bytes) {
            return self.with_parts(self.max_quality, Vec::new());
        }
        let overview = self.overview(size, max_bytes);
        let left =
            max_bytes - overview.map_or(0.0, |part| self.predicted_bytes(self.min_quality, &part));
        self.tile = self.tile.wrapping_add(1);
        let mut last = None;
        for grid in GRIDS {
            let Some(part) = tile(size, grid, self.tile) else { continue };
            last = Some(part);
            if self.predicted_bytes(self.max_quality, &part) <= left {
                break;
            }
        }
        let Some(part) = last else { return self.whole(size, max_bytes) };
        let fits = |quality: &u8| self.predicted_bytes(*quality, &part) <= left;
        let quality = self.qualities().find(fits).unwrap_or(self.min_quality);
        self.with_parts(quality, [Some(part), overview].into_iter().flatten().collect())
    }

    fn overview(&self, size: FrameSize, max_bytes: f64) -> Option<FramePart> {
        let parts = SCALES.iter().filter_map(|scale| covering(size, *scale));
        parts
            .filter(|part| part.width <= MAX_OVERVIEW_PX)
            .find(|part| self.predicted_bytes(self.min_quality, part) <= OVERVIEW_SHARE * max_bytes)
    }

    /// Learns from the files of a frame: its plan, header and bytes.
    pub fn learn(&mut self, plan: &Plan, header: &FrameHeader, bytes: usize) {
        if header.parts.is_empty() {
            let (width, height) = (header.width, header.height);
            let bytes = bytes as u32;
            self.learn_part(
                plan.quality,
                &FramePart { x: 0, y: 0, width, height, scale: 1, bytes },
            );
        }
        for (index, part) in header.parts.iter().enumerate() {
            let quality = if index == 0 { plan.quality } else { plan.overview_quality };
            self.learn_part(quality, part);
        }
    }

    fn learn_part(&mut self, quality: u8, part: &FramePart) {
        let pixels = f64::from(part.width) * f64::from(part.height);
        let of_pixels = (f64::from(part.bytes) - HEADER_BYTES).max(0.0);
        let found = of_pixels / (pixels * relative_size(quality)).max(1.0);
        let [fine, coarse] = &mut self.bytes_per_pixel;
        let mean = if part.scale == 1 { fine } else { coarse };
        *mean += WEIGHT * (found - *mean);
    }

    fn predicted_bytes(&self, quality: u8, part: &FramePart) -> f64 {
        let [fine, coarse] = self.bytes_per_pixel;
        let mean = if part.scale == 1 { fine } else { coarse };
        let pixels = f64::from(part.width) * f64::from(part.height);
        HEADER_BYTES + pixels * mean * relative_size(quality)
    }

    /// The allowed qualities, best first.
    fn qualities(&self) -> impl Iterator<Item = u8> {
        let between = move |q: &u8| (self.min_quality..self.max_quality).contains(q);
        [self.max_quality].into_iter().chain(QUALITIES.into_iter().filter(between))
    }

    fn whole(&self, size: FrameSize, max_bytes: f64) -> Plan {
        let parts = SCALES.iter().filter_map(|scale| covering(size, *scale));
        let mut last = (self.min_quality, None);
        for part in parts {
            for quality in self.qualities() {
                last = (quality, Some(part));
                if self.predicted_bytes(quality, &part) <= max_bytes {
                    return self.covering(quality, part, size);
                }
            }
        }
        let (quality, part) = last;
        match part {
            Some(part) => self.covering(quality, part, size),
            None => self.with_parts(quality, Vec::new()),
        }
    }

    fn with_roi(&self, size: FrameSize, roi: Roi, max_bytes: f64) -> Plan {
        let overview = self.overview(size, max_bytes);
        let overview_bytes =
            overview.map_or(0.0, |part| self.predicted_bytes(self.min_quality, &part));
        let is_fine_enough =
            |scale: &&u32| **scale == 1 || roi.marker_px / f64::from(**scale) >= MIN_MARKER_PX;
        let mut last = None;
        for scale in SCALES.iter().filter(is_fine_enough) {
            let Some(part) = roi_part(roi, size, *scale) else { continue };
            for quality in self.qualities() {
                last = Some((quality, part));
                if self.predicted_bytes(quality, &part) + overview_bytes <= max_bytes {
                    let parts = [Some(part), overview].into_iter().flatten().collect();
                    return self.with_parts(quality, parts);
                }
            }
        }
        // The smallest version of the ROI, without an overview.
        match last {
            Some((quality, part)) => self.with_parts(quality, vec![part]),
            None => self.whole(size, max_bytes),
        }
    }

    fn covering(&self, quality: u8, part: FramePart, size: FrameSize) -> Plan {
        let is_whole = part.scale == 1 && part.width == size.width && part.height == size.height;
        self.with_parts(quality, if is_whole { Vec::new() } else { vec![part] })
    }

    fn with_parts(&self, quality: u8, parts: Vec<FramePart>) -> Plan {
        Plan { quality, overview_quality: self.min_quality, parts }
    }
}

/// The part that covers the frame at this scale, without up to `scale` - 1 rows and columns at its end.
fn covering(size: FrameSize, scale: u32) -> Option<FramePart> {
    let (width, height) = (size.width / scale, size.height / scale);
    (width > 0 && height > 0).then_some(FramePart { x: 0, y: 0, width, height, scale, bytes: 0 })
}

/// The part that covers an ROI as far as it lies in the frame.
fn roi_part(roi: Roi, size: FrameSize, scale: u32) -> Option<FramePart> {
    if roi.to.iter().any(|edge| *edge < 0.0) {
        return None;
    }
    let step = BLOCK * scale;
    let span = |from: f64, to: f64, edge: u32| {
        // Casts saturate.
        let from = (from.max(0.0) as u32).min(edge) / step * step;
        let pixels = (to.max(0.0) as u32).saturating_add(1).min(edge).saturating_sub(from);
        (from, (pixels.div_ceil(step) * BLOCK).min((edge - from) / scale))
    };
    let (x, width) = span(roi.from[0], roi.to[0], size.width);
    let (y, height) = span(roi.from[1], roi.to[1], size.height);
    (width > 0 && height > 0).then_some(FramePart { x, y, width, height, scale, bytes: 0 })
}

/// The tile of a grid whose turn it is, with its overlap: by multiples of the golden ratio, of which every second or third comes to
/// all of them as well, where a detector searches no more (Knuth, The Art of Computer Programming 3, 6.4).
fn tile(size: FrameSize, Grid { columns, rows }: Grid, count: u32) -> Option<FramePart> {
    let share = u64::from(count.wrapping_mul(2_654_435_769));
    let number = ((share * u64::from(columns * rows)) >> 32) as u32;
    let (column, row) = (number % columns, number / columns);
    let span = |edge: u32, number: u32, at: u32| {
        let from = (edge * at / number).saturating_sub(OVERLAP_PX / 2) / BLOCK * BLOCK;
        let to = (edge * (at + 1) / number + OVERLAP_PX / 2).min(edge);
        (from, to.saturating_sub(from))
    };
    let (x, width) = span(size.width, columns, column);
    let (y, height) = span(size.height, rows, row);
    (width > 0 && height > 0).then_some(FramePart { x, y, width, height, scale: 1, bytes: 0 })
}

/// Size of a file of this quality, relative to quality 75.
fn relative_size(quality: u8) -> f64 {
    let mut before = SIZE_BY_QUALITY[0];
    for (at, size) in SIZE_BY_QUALITY {
        if quality <= at {
            let part =
                f64::from(quality.saturating_sub(before.0)) / f64::from((at - before.0).max(1));
            return before.1 + part * (size - before.1);
        }
        before = (at, size);
    }
    before.1
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const SIZE: FrameSize = FrameSize { width: 1296, height: 972 };

    fn planner(mode: Mode) -> Planner {
        Planner { mode, max_quality: 75, min_quality: 35, bytes_per_pixel: [0.17, 0.25], tile: 0 }
    }

    fn roi(centre: [f64; 2], half: f64, marker_px: f64) -> Roi {
        Roi { from: centre.map(|at| at - half), to: centre.map(|at| at + half), marker_px }
    }

    #[test]
    fn a_whole_frame_loses_quality_and_then_resolution_as_the_size_shrinks() {
        let mut planner = planner(Mode::Full);
        let mut plan = |kb: usize| planner.plan(SIZE, None, kb * 1000);
        assert!(plan(300).quality == 75 && plan(300).parts.is_empty());
        let worse = plan(150);
        assert!(worse.quality < 75 && worse.parts.is_empty(), "{worse:?}");
        let coarser = plan(60);
        assert!(coarser.parts[0].scale == 2 && coarser.parts[0].width == 648, "{coarser:?}");
        assert!(plan(0).parts[0].scale == 12);
        let with_roi = planner.plan(SIZE, Some(roi([600.0, 500.0], 100.0, 80.0)), 300_000);
        assert!(with_roi.parts.is_empty());
    }

    #[test]
    fn an_roi_keeps_full_resolution_while_a_small_marker_needs_it() {
        let mut planner = planner(Mode::Roi);
        let small = planner.plan(SIZE, Some(roi([600.0, 500.0], 60.0, 30.0)), 20_000);
        assert_eq!((small.quality, small.parts[0].scale, small.parts.len()), (75, 1, 2));
        let tight = planner.plan(SIZE, Some(roi([600.0, 500.0], 60.0, 30.0)), 100);
        assert_eq!((tight.quality, tight.parts[0].scale, tight.parts.len()), (35, 1, 1));
        let large = planner.plan(SIZE, Some(roi([600.0, 450.0], 380.0, 500.0)), 20_000);
        assert!(large.parts[0].scale > 1, "{large:?}");
    }

    #[test]
    fn without_a_marker_the_frame_is_sent_tile_by_tile() {
        let mut planner = planner(Mode::Roi);
        let mut is_sent = vec![false; (SIZE.width * SIZE.height) as usize];
        for _ in 0..32 {
            let plan = planner.plan(SIZE, None, 50_000);
            let part = plan.parts[0];
            assert!((plan.quality, part.scale, plan.parts.len()) == (75, 1, 2), "{plan:?}");
            for y in part.y..part.y + part.height {
                let from = (y * SIZE.width + part.x) as usize;
                is_sent[from..from + part.width as usize].fill(true);
            }
        }
        assert!(is_sent.iter().all(|is_sent| *is_sent));
        assert!(planner.plan(SIZE, None, 300_000).parts.is_empty());
    }

    #[test]
    fn a_detector_that_searches_every_few_frames_comes_to_all_tiles() {
        for grid in GRIDS {
            let all = grid.columns * grid.rows;
            for every in 1..=6 {
                let searched = (0..4 * all * every).step_by(every as usize);
                let tiles = searched.filter_map(|count| tile(SIZE, grid, count));
                let places: std::collections::BTreeSet<_> = tiles.map(|t| (t.x, t.y)).collect();
                assert_eq!(
                    places.len(),
                    all as usize,
                    "{} x {}, every {every}",
                    grid.columns,
                    grid.rows
                );
            }
        }
    }

    #[test]
    fn sizes_are_learnt_from_the_files() {
        let mut planner = planner(Mode::Full);
        let part = FramePart { x: 0, y: 0, width: 1000, height: 1000, scale: 1, bytes: 340_000 };
        for _ in 0..20 {
            planner.learn_part(75, &part);
        }
        assert!((planner.predicted_bytes(75, &part) / 340_000.0 - 1.0).abs() < 0.01);
    }

    proptest! {
        #[test]
        fn every_part_lies_in_the_frame(
            width in 1_u32..5000,
            height in 1_u32..5000,
            from in [-1e5..1e5, -1e5..1e5_f64],
            extent in [0.0..1e4, 0.0..1e4_f64],
            marker_px in 1.0..1e4_f64,
            max_bytes in 0_usize..500_000,
        ) {
            let to = [from[0] + extent[0], from[1] + extent[1]];
            let mut planner = planner(Mode::Roi);
            let plan = planner.plan(FrameSize { width, height }, Some(Roi { from, to, marker_px }), max_bytes);
            for part in &plan.parts {
                prop_assert!(part.width > 0 && part.height > 0);
                prop_assert!(part.x + part.width * part.scale <= width, "{part:?}");
                prop_assert!(part.y + part.height * part.scale <= height, "{part:?}");
            }
        }
    }
}
