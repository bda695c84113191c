//! What families share of an image: its outlines and quads, each made at most once.

use imaging::{GrayView, Outlines, outline};

use crate::candidates::outline_quads::OutlineQuads;
use crate::candidates::quad::Quad;
use crate::candidates::quiet_zone::{MAX_QUIET_ZONES, quiet_zone_quads};
use crate::candidates::segment_quads::{ImageQuads, Scale};
use crate::observation::StageObserver;
use crate::schedule::{FallbackPass, FallbackStep, ImageStrip, PassSchedule};
use crate::trace::Trace;

/// Outlines of the paper of square markers so small that their border cannot be told from what is in it.
const QUIET_ZONES: outline::Settings = outline::Settings {
    dark_from: None,
    bright_from: Some(0),
    whole_level: 2,
    min_size_px: 5,
    max_size_px: 40,
    min_contrast: 14,
    min_contrast_percent: 12,
    steep: true,
    min_fill: 0.3,
    max_raggedness: 1.2,
};

/// What a family needs of an image.
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
}

impl Evidence {
    /// Reserves what textured images need.
    pub(crate) fn make_room(&mut self, view: GrayView<'_>, needs: &Needs) {
        if needs.quads.is_some() {
            self.outline_quads.make_room();
            self.segment_quads.make_room(view);
            self.quiet_zones.clear();
            self.quiet_zones.reserve(MAX_QUIET_ZONES);
        }
    }

    /// Makes what the fast passes need of an image.
    pub(crate) fn find(
        &mut self,
        view: GrayView<'_>,
        needs: &Needs,
        trace: &mut Trace,
        stages: &mut dyn StageObserver,
    ) {
        self.has_outlines = needs.quads.is_some();
        if let Some(OutlineNeeds { bright_from, max_size_px }) = needs.quads {
            let mut settings = outline::Settings { bright_from, ..outline::Settings::default() };
            settings.max_size_px = settings.max_size_px.max(max_size_px);
            self.outlines.find(view, &settings);
            stages.ended("outlines");
            self.outline_quads.find(view, &self.outlines, trace);
            stages.ended("quads");
        } else if needs.pyramid {
            self.outlines.begin(view);
            stages.ended("outlines");
        }
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

    /// Makes what a step of the fallbacks needs, of the image that it searches.
    pub(crate) fn prepare(
        &mut self,
        view: GrayView<'_>,
        step: FallbackStep,
        schedule: PassSchedule,
        stages: &mut dyn StageObserver,
    ) {
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
                        self.outlines.add_rows(view, &QUIET_ZONES, rows);
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
    /// What both families need.
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
