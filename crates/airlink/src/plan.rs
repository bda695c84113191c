//! Which parts of a frame are sent, how finely and how strongly compressed, so that they fit a size.
//!
//! The sizes of JPEG files cannot be known before they are made; they are foretold from the last ones' bytes per
//! pixel, and from how the size of photographs goes with the quality.

use messages::{FrameHeader, FramePart};

use crate::config::{AirConfig, Mode};
use crate::expected::Region;

/// Qualities that are tried, the best first, between the two that are configured.
const QUALITIES: [u8; 9] = [95, 90, 85, 75, 65, 55, 45, 35, 25];
/// Pixels of the frame along the edge of one of a part's, coarser and coarser.
const SCALES: [u32; 7] = [1, 2, 3, 4, 6, 8, 12];
/// A region is made coarser only while its smallest marker keeps this size, in pixels: half of it is detected well.
const LEAST_MARKER_PX: f64 = 64.0;
/// The overview's part of the size.
const OVERVIEW_SHARE: f64 = 0.25;
/// Tiles of a frame that is looked through bit by bit: columns and rows, fewer and larger ones first.
const TILES: [(u32, u32); 6] = [(2, 1), (2, 2), (3, 2), (3, 3), (4, 3), (4, 4)];
/// Neighbouring tiles share so many pixels: a marker that is larger is seen in the overview.
const OVERLAP_PX: u32 = 96;
/// The overview is at most so wide, in its own pixels; more is of no use beside a region.
const OVERVIEW_PX: u32 = 330;
/// Edges of a region are multiples of this many pixels, as a JPEG's blocks are.
const BLOCK: u32 = 8;
/// Part of a new file in the mean of bytes per pixel.
const WEIGHT: f64 = 0.3;
/// Sizes of JPEG files of rendered ground by quality, relative to quality 75, as the example `jpeg` of the tool
/// `experiments` measures them.
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

/// What is made of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Plan {
    /// JPEG quality of the first part, or of the whole frame.
    pub quality: u8,
    /// JPEG quality of the others.
    pub overview_quality: u8,
    /// The parts, finest first, their bytes not known yet; empty: the whole frame as it is.
    pub parts: Vec<FramePart>,
}

/// Plans frames, and learns from how large they became.
#[derive(Clone, Debug)]
pub struct Planner {
    mode: Mode,
    best: u8,
    least: u8,
    /// Bytes per pixel at quality 75, of parts at full resolution and of coarser ones.
    bytes_per_pixel: [f64; 2],
    /// Counts the frames of which a tile was sent.
    tile: u32,
}

impl Planner {
    /// A planner that expects textured ground.
    pub fn new(config: &AirConfig) -> Self {
        Self {
            mode: config.mode,
            best: config.quality,
            least: config.quality_least,
            bytes_per_pixel: [0.12, 0.2],
            tile: 0,
        }
    }

    /// The best that fits `most_bytes` of a frame of this size (width, height).
    pub fn plan(&mut self, size: (u32, u32), region: Option<Region>, most_bytes: usize) -> Plan {
        let most_bytes = most_bytes as f64;
        if self.mode == Mode::Full {
            return self.whole(size, most_bytes);
        }
        match region.and_then(|region| Some((region, around(region, size, 1)?))) {
            Some((region, _)) => self.with_region(size, region, most_bytes),
            None => self.tile(size, most_bytes),
        }
    }

    /// The whole frame if it fits, else the next of its tiles, each at full resolution, and an overview: a marker that
    /// is far away is lost in a picture that is coarser or compressed more strongly.
    fn tile(&mut self, size: (u32, u32), most_bytes: f64) -> Plan {
        let whole = covering(size, 1);
        if whole.is_none_or(|whole| self.foretold(self.best, &whole) <= most_bytes) {
            return self.of_parts(self.best, Vec::new());
        }
        let overview = self.overview(size, most_bytes);
        let left = most_bytes - overview.map_or(0.0, |part| self.foretold(self.least, &part));
        self.tile = self.tile.wrapping_add(1);
        let mut last = None;
        for (columns, rows) in TILES {
            let number = self.tile % (columns * rows);
            let (column, row) = (number % columns, number / columns);
            let Some(part) = tile(size, (columns, rows), (column, row)) else { continue };
            last = Some(part);
            if self.foretold(self.best, &part) <= left {
                break;
            }
        }
        let Some(part) = last else { return self.whole(size, most_bytes) };
        let fits = |quality: &u8| self.foretold(*quality, &part) <= left;
        let quality = self.qualities().find(fits).unwrap_or(self.least);
        self.of_parts(quality, [Some(part), overview].into_iter().flatten().collect())
    }

    fn overview(&self, size: (u32, u32), most_bytes: f64) -> Option<FramePart> {
        let parts = SCALES.iter().filter_map(|scale| covering(size, *scale));
        parts
            .filter(|part| part.width <= OVERVIEW_PX)
            .find(|part| self.foretold(self.least, part) <= OVERVIEW_SHARE * most_bytes)
    }

    /// Learns from a frame that was made as planned: its header and its bytes.
    pub fn learn_all(&mut self, plan: &Plan, header: &FrameHeader, bytes: usize) {
        if header.parts.is_empty() {
            let (width, height) = (header.width, header.height);
            let bytes = bytes as u32;
            self.learn(plan.quality, &FramePart { x: 0, y: 0, width, height, scale: 1, bytes });
        }
        for (index, part) in header.parts.iter().enumerate() {
            let quality = if index == 0 { plan.quality } else { plan.overview_quality };
            self.learn(quality, part);
        }
    }

    fn learn(&mut self, quality: u8, part: &FramePart) {
        let pixels = f64::from(part.width) * f64::from(part.height);
        let found = f64::from(part.bytes) / (pixels * relative_size(quality)).max(1.0);
        let [fine, coarse] = &mut self.bytes_per_pixel;
        let mean = if part.scale == 1 { fine } else { coarse };
        *mean += WEIGHT * (found - *mean);
    }

    fn foretold(&self, quality: u8, part: &FramePart) -> f64 {
        let [fine, coarse] = self.bytes_per_pixel;
        let mean = if part.scale == 1 { fine } else { coarse };
        f64::from(part.width) * f64::from(part.height) * mean * relative_size(quality)
    }

    /// The qualities from the best to the least that may be used.
    fn qualities(&self) -> impl Iterator<Item = u8> {
        let between = move |q: &u8| (self.least..self.best).contains(q);
        [self.best].into_iter().chain(QUALITIES.into_iter().filter(between))
    }

    fn whole(&self, size: (u32, u32), most_bytes: f64) -> Plan {
        let parts = SCALES.iter().filter_map(|scale| covering(size, *scale));
        let mut last = (self.least, None);
        for part in parts {
            for quality in self.qualities() {
                last = (quality, Some(part));
                if self.foretold(quality, &part) <= most_bytes {
                    return self.covering(quality, part, size);
                }
            }
        }
        let (quality, part) = last;
        match part {
            Some(part) => self.covering(quality, part, size),
            None => self.of_parts(quality, Vec::new()),
        }
    }

    fn with_region(&self, size: (u32, u32), region: Region, most_bytes: f64) -> Plan {
        let overview = self.overview(size, most_bytes);
        let of_overview = overview.map_or(0.0, |part| self.foretold(self.least, &part));
        let is_fine_enough =
            |scale: &&u32| **scale == 1 || region.marker_px / f64::from(**scale) >= LEAST_MARKER_PX;
        let mut last = None;
        for scale in SCALES.iter().filter(is_fine_enough) {
            let Some(part) = around(region, size, *scale) else { continue };
            for quality in self.qualities() {
                last = Some((quality, part));
                if self.foretold(quality, &part) + of_overview <= most_bytes {
                    let parts = [Some(part), overview].into_iter().flatten().collect();
                    return self.of_parts(quality, parts);
                }
            }
        }
        // The least there is of the region, and nothing beside it.
        match last {
            Some((quality, part)) => self.of_parts(quality, vec![part]),
            None => self.whole(size, most_bytes),
        }
    }

    fn covering(&self, quality: u8, part: FramePart, size: (u32, u32)) -> Plan {
        let is_whole = part.scale == 1 && (part.width, part.height) == size;
        self.of_parts(quality, if is_whole { Vec::new() } else { vec![part] })
    }

    fn of_parts(&self, quality: u8, parts: Vec<FramePart>) -> Plan {
        Plan { quality, overview_quality: self.least, parts }
    }
}

/// The part that covers the frame in pixels of this scale; up to `scale` - 1 rows and columns are left over.
fn covering((width, height): (u32, u32), scale: u32) -> Option<FramePart> {
    let (width, height) = (width / scale, height / scale);
    (width > 0 && height > 0).then_some(FramePart { x: 0, y: 0, width, height, scale, bytes: 0 })
}

/// The part about a region, as far as it lies in the frame.
fn around(region: Region, (width, height): (u32, u32), scale: u32) -> Option<FramePart> {
    let step = BLOCK * scale;
    let span = |from: f64, to: f64, edge: u32| {
        // Casts of numbers out of range end at the nearest that fits.
        let from = (from.max(0.0) as u32).min(edge) / step * step;
        let pixels = (to.max(0.0) as u32).saturating_add(1).min(edge).saturating_sub(from);
        (from, (pixels.div_ceil(step) * BLOCK).min((edge - from) / scale))
    };
    let (x, wide) = span(region.from[0], region.to[0], width);
    let (y, high) = span(region.from[1], region.to[1], height);
    (wide > 0 && high > 0).then_some(FramePart { x, y, width: wide, height: high, scale, bytes: 0 })
}

/// A tile of a frame, with what it shares with its neighbours.
fn tile(
    size: (u32, u32),
    (columns, rows): (u32, u32),
    (column, row): (u32, u32),
) -> Option<FramePart> {
    let span = |edge: u32, number: u32, at: u32| {
        let from = (edge * at / number).saturating_sub(OVERLAP_PX / 2) / BLOCK * BLOCK;
        let to = (edge * (at + 1) / number + OVERLAP_PX / 2).min(edge);
        (from, to.saturating_sub(from))
    };
    let ((x, width), (y, height)) = (span(size.0, columns, column), span(size.1, rows, row));
    (width > 0 && height > 0).then_some(FramePart { x, y, width, height, scale: 1, bytes: 0 })
}

/// Size of a file of this quality relative to one of quality 75.
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

    const SIZE: (u32, u32) = (1296, 972);

    fn planner(mode: Mode) -> Planner {
        Planner { mode, best: 75, least: 35, bytes_per_pixel: [0.17, 0.25], tile: 0 }
    }

    fn region(centre: [f64; 2], half: f64, marker_px: f64) -> Region {
        Region { from: centre.map(|at| at - half), to: centre.map(|at| at + half), marker_px }
    }

    #[test]
    fn the_whole_frame_becomes_worse_and_then_coarser_as_the_size_shrinks() {
        let mut planner = planner(Mode::Full);
        let mut plan = |kb: usize| planner.plan(SIZE, None, kb * 1000);
        assert!(plan(300).quality == 75 && plan(300).parts.is_empty());
        let worse = plan(150);
        assert!(worse.quality < 75 && worse.parts.is_empty(), "{worse:?}");
        let coarser = plan(60);
        assert!(coarser.parts[0].scale == 2 && coarser.parts[0].width == 648, "{coarser:?}");
        assert!(plan(0).parts[0].scale == 12);
        let anyhow_whole = planner.plan(SIZE, Some(region([600.0, 500.0], 100.0, 80.0)), 300_000);
        assert!(anyhow_whole.parts.is_empty());
    }

    #[test]
    fn a_region_keeps_the_frames_resolution_while_a_small_marker_needs_it() {
        let mut planner = planner(Mode::Region);
        let small = planner.plan(SIZE, Some(region([600.0, 500.0], 60.0, 30.0)), 20_000);
        assert_eq!((small.quality, small.parts[0].scale, small.parts.len()), (75, 1, 2));
        let tight = planner.plan(SIZE, Some(region([600.0, 500.0], 60.0, 30.0)), 100);
        assert_eq!((tight.quality, tight.parts[0].scale, tight.parts.len()), (35, 1, 1));
        let large = planner.plan(SIZE, Some(region([600.0, 450.0], 380.0, 500.0)), 20_000);
        assert!(large.parts[0].scale > 1, "{large:?}");
    }

    #[test]
    fn without_a_marker_the_frame_is_looked_through_tile_by_tile() {
        let mut planner = planner(Mode::Region);
        let mut seen = vec![false; (SIZE.0 * SIZE.1) as usize];
        for _ in 0..16 {
            let plan = planner.plan(SIZE, None, 50_000);
            let part = plan.parts[0];
            assert!((plan.quality, part.scale, plan.parts.len()) == (75, 1, 2), "{plan:?}");
            for y in part.y..part.y + part.height {
                let from = (y * SIZE.0 + part.x) as usize;
                seen[from..from + part.width as usize].fill(true);
            }
        }
        assert!(seen.iter().all(|seen| *seen));
        assert!(planner.plan(SIZE, None, 300_000).parts.is_empty());
    }

    #[test]
    fn sizes_are_learnt_from_the_files() {
        let mut planner = planner(Mode::Full);
        let part = FramePart { x: 0, y: 0, width: 1000, height: 1000, scale: 1, bytes: 340_000 };
        for _ in 0..20 {
            planner.learn(75, &part);
        }
        assert!((planner.foretold(75, &part) / 340_000.0 - 1.0).abs() < 0.01);
    }

    proptest! {
        #[test]
        fn every_part_lies_in_the_frame(
            size in (1_u32..5000, 1_u32..5000),
            from in [-1e5..1e5, -1e5..1e5_f64],
            extent in [0.0..1e4, 0.0..1e4_f64],
            marker_px in 1.0..1e4_f64,
            most_bytes in 0_usize..500_000,
        ) {
            let to = [from[0] + extent[0], from[1] + extent[1]];
            let mut planner = planner(Mode::Region);
            let plan = planner.plan(size, Some(Region { from, to, marker_px }), most_bytes);
            for part in &plan.parts {
                prop_assert!(part.width > 0 && part.height > 0);
                prop_assert!(part.x + part.width * part.scale <= size.0, "{part:?}");
                prop_assert!(part.y + part.height * part.scale <= size.1, "{part:?}");
            }
        }
    }
}
