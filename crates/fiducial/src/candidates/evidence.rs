//! Computes the data of an image that families share: its outlines and quads, each at most once.

use imaging::{ContrastMap, GrayView, Outlines, Places, outline};

use crate::candidates::outline_quads::OutlineQuads;
use crate::candidates::quad::Quad;
use crate::candidates::quiet_zone::{MAX_QUIET_ZONES, quiet_zone_quads};
use crate::candidates::segment_quads::{ImageQuads, Scale};
use crate::observation::StageObserver;
use crate::schedule::{FallbackPass, FallbackStep, ImageStrip, PassSchedule};
use crate::trace::Trace;

/// Outlines of the paper of small square markers whose border has no separate outline, at two thresholds: a tone curve shows the ground
/// nearly as bright as the paper, and in linear light blur makes the paper of markers of 8 pixels no brighter than the lower one.
const QUIET_ZONES: [outline::Settings; 2] = [quiet_zones(160), quiet_zones(208)];

/// With a contrast of up to 50 % none of 178 markers of 7 pixels and more is lost, linear or through a tone curve; texture takes half
/// of the time from 30 % on.
const fn quiet_zones(threshold_256ths: u8) -> outline::Settings {
    outline::Settings {
        dark_from: None,
        bright_from: Some(0),
        whole_level: 2,
        min_size_px: 5,
        max_size_px: 40,
        min_contrast: 14,
        min_contrast_percent: 40,
        threshold_256ths,
        steep: true,
        min_fill: 0.3,
        max_raggedness: 1.2,
    }
}

/// Minimum contrast between places, in percent, where the fast passes follow outlines: noise in daylight has less. Of 1012 markers of 10
/// to 90 px behind haze that left them a contrast of 18 % none was lost with 4 %, and 17 were with 6 %.
const OUTLINED_PERCENT: u8 = 4;
/// Share of the image in which small paper is searched at most, unless more of it has this contrast between places, in percent.
/// Paper of markers of 8 to 12 px had 49 % at least on all grounds, texture of grass and asphalt 30 to 44 % in a tenth of its
/// places.
const PAPER_SHARE: f32 = 0.2;
const PAPER_PERCENT: u8 = 35;
/// Minimum contrast between places, in percent, where rings are searched that lie partly in deep shade. Of 37 that only this
/// search found all but one, of 9 px on bright ground, had 57 % at least.
const SHADED_PERCENT: u8 = 45;

/// Minimum contrast between places, in percent, where arcs of rings of medium size are searched. Of 560 rings outdoors, 40 to 160 px large
/// and partly covered, all that this search finds in the whole image are found with 100 %, and two less with 200 %.
const INK_PERCENT: u8 = 100;

/// The data of an image that a family needs.
#[derive(Copy, Clone, Debug, Default)]
pub(crate) struct Needs {
    /// The pyramid of the image.
    pub(crate) pyramid: bool,
    /// The quads of closed outlines.
    pub(crate) quads: Option<OutlineNeeds>,
}

/// Which outlines a family of square markers needs.
#[derive(Copy, Clone, Debug)]
pub(crate) struct OutlineNeeds {
    /// The level of the pyramid from which on bright outlines are followed.
    pub(crate) bright_from: Option<usize>,
    /// Largest size of outlines on the finest levels, in pixels of the level.
    pub(crate) max_size_px: u16,
}

/// Shared evidence of one image. It keeps its memory from image to image.
#[derive(Debug, Default)]
pub(crate) struct Evidence {
    /// Outlines of the image; empty when no family needs quads, but for its pyramid.
    pub(crate) outlines: Outlines,
    /// Whether `outlines` has the outlines that quads need.
    pub(crate) has_outlines: bool,
    /// Quads of closed outlines.
    pub(crate) outline_quads: OutlineQuads,
    /// Quads of the paper of small markers, after the step [`FallbackStep::QuietZones`] was prepared.
    pub(crate) quiet_zones: Vec<Quad>,
    segment_quads: ImageQuads,
    /// The contrast between places of the image.
    contrast: ContrastMap,
    /// Minimum contrast of the places that the rest of this search is limited to, in percent.
    min_percent: u8,
}

impl Evidence {
    /// Reserves memory for textured images.
    pub(crate) fn make_room(&mut self, view: GrayView<'_>, needs: &Needs) {
        self.contrast.make_room(view);
        if needs.quads.is_some() {
            self.outline_quads.make_room();
            self.segment_quads.make_room(view);
            self.quiet_zones.clear();
            self.quiet_zones.reserve(MAX_QUIET_ZONES);
        }
    }

    /// Computes the data of an image for the fast passes.
    pub(crate) fn find(
        &mut self,
        view: GrayView<'_>,
        needs: &Needs,
        trace: &mut Trace,
        stages: &mut dyn StageObserver,
    ) {
        self.has_outlines = needs.quads.is_some();
        self.min_percent = 0;
        if let Some(OutlineNeeds { bright_from, max_size_px }) = needs.quads {
            let mut settings = outline::Settings { bright_from, ..outline::Settings::default() };
            settings.max_size_px = settings.max_size_px.max(max_size_px);
            self.begin_outlines(view);
            let places = self.contrast.places(self.min_percent);
            self.outlines.add_at(places, view, &settings, 0..usize::MAX);
            stages.ended("outlines");
            self.outline_quads.find(view, &self.outlines, trace);
            stages.ended("quads");
        } else if needs.pyramid {
            self.begin_outlines(view);
            stages.ended("outlines");
        }
    }

    /// Begins the outlines of an image, and limits those of the fast passes to places with contrast.
    fn begin_outlines(&mut self, view: GrayView<'_>) {
        self.outlines.begin(view);
        self.contrast.measure(view, self.outlines.pyramid());
        self.min_percent = OUTLINED_PERCENT;
    }

    /// Begins the fallbacks of an image.
    pub(crate) fn begin_fallbacks(&mut self, schedule: PassSchedule) {
        let scales = [
            (Scale::Fine, FallbackPass::FineSegments),
            (Scale::Coarse, FallbackPass::CoarseSegments),
        ];
        self.segment_quads
            .begin(scales.map(|(scale, pass)| schedule.allows(pass).then_some(scale)));
    }

    /// Whether a step may find anything in an image that was searched by the fast passes and the steps before.
    pub(crate) fn may_help(&self, step: FallbackStep) -> bool {
        step != FallbackStep::Brightened || self.contrast.reaches(SHADED_PERCENT)
    }

    /// The outlines, and the places that this search is limited to.
    pub(crate) fn outlines_at(&mut self) -> (&mut Outlines, Places<'_>) {
        (&mut self.outlines, self.contrast.places(self.min_percent))
    }

    /// Whether there is any of these places.
    pub(crate) fn has_places(&self) -> bool {
        self.contrast.reaches(self.min_percent)
    }

    /// Computes the data for a step of the fallbacks, of the image that it searches.
    pub(crate) fn prepare(
        &mut self,
        view: GrayView<'_>,
        step: FallbackStep,
        schedule: PassSchedule,
        stages: &mut dyn StageObserver,
    ) {
        self.min_percent = match step {
            FallbackStep::Arcs => INK_PERCENT,
            FallbackStep::Blobs | FallbackStep::QuietZones => {
                self.contrast.reached_in(PAPER_SHARE).min(PAPER_PERCENT)
            }
            // Of the image itself.
            FallbackStep::Brightened => SHADED_PERCENT,
            FallbackStep::Segments | FallbackStep::LateSegments => 0,
        };
        match step {
            FallbackStep::Arcs | FallbackStep::Blobs => {}
            FallbackStep::Brightened => {
                self.has_outlines = false;
                self.outlines.begin(view);
                stages.ended("brightened");
            }
            FallbackStep::Segments | FallbackStep::LateSegments => {
                if self.segment_quads.make(view, self.outlines.pyramid()) {
                    stages.ended("segments");
                }
            }
            FallbackStep::QuietZones => {
                let first = self.outlines.len();
                for strip in ImageStrip::ALL {
                    if schedule.allows(FallbackPass::QuietZones(strip)) {
                        let rows = strip.rows(view.height());
                        let places = self.contrast.places(self.min_percent);
                        for settings in &QUIET_ZONES {
                            self.outlines.add_rows(places, view, settings, rows.clone());
                        }
                    }
                }
                self.quiet_zones.clear();
                self.quiet_zones.extend(quiet_zone_quads(view, &self.outlines, first));
            }
        }
    }

    /// Quads of segments, after the step [`FallbackStep::Segments`] or [`FallbackStep::LateSegments`] was prepared.
    pub(crate) fn segment_quads(&self) -> &[Quad] {
        self.segment_quads.quads()
    }
}

impl Needs {
    /// The needs of both families.
    pub(crate) fn and(self, other: Self) -> Self {
        let quads = match (self.quads, other.quads) {
            (Some(a), Some(b)) => Some(OutlineNeeds {
                bright_from: [a.bright_from, b.bright_from].into_iter().flatten().min(),
                max_size_px: a.max_size_px.max(b.max_size_px),
            }),
            (one, other) => one.or(other),
        };
        Self { pyramid: self.pyramid || other.pyramid, quads }
    }
}

#[cfg(test)]
mod tests {
    use imaging::GrayImage;

    use super::*;

    /// Noise on even ground, next to it blots, and a faint dark square of 24 pixels at (101..125, 99..123).
    #[test]
    fn a_faint_square_is_outlined_next_to_texture_and_noise_is_not() {
        let mut image = GrayImage::filled(640, 480, 0);
        let mut random = 1_u32;
        for y in 0..480 {
            for (x, pixel) in image.row_mut(y).iter_mut().enumerate() {
                random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                let is_square = (101..125).contains(&x) && (99..123).contains(&y);
                let is_blot = x > 250 && (x / 11 * 7 + y / 9 * 5).is_multiple_of(3);
                let ground = if is_square { 98 } else { 120 };
                *pixel = (if is_blot { 40 } else { ground }) + (random >> 16) as u8 % 18;
            }
        }
        let needs = OutlineNeeds { bright_from: None, max_size_px: 36 };
        let needs = Needs { pyramid: true, quads: Some(needs) };
        let (mut evidence, mut trace) = (Evidence::default(), Trace::default());
        evidence.find(image.view().unwrap(), &needs, &mut trace, &mut ());
        let bounds = |o: &imaging::Outline<'_>| o.bounds.map(|b| i32::from(b) << o.level);
        // Coarser levels have no noise.
        let on_ground = evidence.outlines.iter().filter(|o| o.level < 3).map(|o| bounds(&o));
        let on_ground: Vec<_> = on_ground.filter(|[_, _, right, _]| *right < 240).collect();
        let off = |seen: &[i32; 4]| {
            seen.iter().zip([101, 99, 125, 123]).map(|(seen, side)| (seen - side).abs()).max()
        };
        assert!(on_ground.iter().any(|seen| off(seen) <= Some(8)), "{on_ground:?}");
        // Noise directly next to the square has the square's contrast.
        assert!(on_ground.iter().all(|seen| off(seen) <= Some(40)), "{on_ground:?}");
    }
}
