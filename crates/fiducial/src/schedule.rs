//! Chooses the fallback passes for an image, and their order.
//!
//! Fallback passes find markers that are occluded, cut by the frame, or far away; each takes about as long as the rest of
//! a detection. They run in images in which nothing else was found. In a stream of images without markers they take turns,
//! one in each image, in the order of [`FallbackPass::ALL`]; in one image the one for a shadow's edge is the first, as the others
//! locate markers there less exactly, and they run in the order of `FallbackStep::ALL`.
//!
//! | pass | finds | families |
//! |---|---|---|
//! | [`FallbackPass::Arcs`] | rings that are cut or covered, and rings under noise, on coarser levels | rings |
//! | [`FallbackPass::Blobs`] | bright blobs that may be the paper of rings far away | rings |
//! | [`FallbackPass::Brightened`] | rings of a camera without a tone curve that lie partly in deep shade | rings |
//! | [`FallbackPass::ShadowEdge`] | markers that the straight edge of a shadow crosses, in the image without that shadow | rings, square, STag |
//! | [`FallbackPass::FineSegments`], [`FallbackPass::CoarseSegments`] | occluded square markers, by segments of edges on two levels | square, STag |
//! | [`FallbackPass::QuietZones`] | small square markers, by their paper, in a third of the image | square, STag |

use std::ops::Range;

/// A pass for markers that are hard to see.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum FallbackPass {
    /// Rings that are cut or covered, by arcs; and rings under noise, on coarser levels of the pyramid.
    Arcs,
    /// Rings far away, by bright blobs that may be their paper.
    Blobs,
    /// Rings that lie partly in deep shade, in the square root of an image that is linear in light.
    Brightened,
    /// Markers that the straight edge of a shadow crosses, in the image without that shadow.
    ShadowEdge,
    /// Occluded square markers, by segments of edges on the finer of two levels.
    FineSegments,
    /// The same on the coarser level.
    CoarseSegments,
    /// Small square markers, by their paper, whose first row is in a part of the image.
    QuietZones(ImageStrip),
}

/// A third of the image's rows.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum ImageStrip {
    /// The first rows.
    Upper,
    /// The rows in between.
    Middle,
    /// The last rows.
    Lower,
}

impl ImageStrip {
    /// All strips, from the top.
    pub const ALL: [Self; 3] = [Self::Upper, Self::Middle, Self::Lower];

    /// Its rows in an image of this height.
    pub(crate) fn rows(self, height: usize) -> Range<usize> {
        let from = self as usize * height / 3;
        from..(self as usize + 1) * height / 3
    }
}

impl FallbackPass {
    /// All passes, in the order in which they take turns in a stream.
    pub const ALL: [Self; 9] = [
        Self::Arcs,
        Self::QuietZones(ImageStrip::Upper),
        Self::FineSegments,
        Self::Blobs,
        Self::QuietZones(ImageStrip::Middle),
        Self::CoarseSegments,
        Self::ShadowEdge,
        Self::Brightened,
        Self::QuietZones(ImageStrip::Lower),
    ];

    /// The first step of an image that makes this pass; `None` of the one that searches another image as the frame is searched.
    pub(crate) fn step(self) -> Option<FallbackStep> {
        match self {
            Self::Arcs => Some(FallbackStep::Arcs),
            Self::Blobs => Some(FallbackStep::Blobs),
            Self::ShadowEdge => None,
            Self::Brightened => Some(FallbackStep::Brightened),
            Self::FineSegments | Self::CoarseSegments => Some(FallbackStep::Segments),
            Self::QuietZones(_) => Some(FallbackStep::QuietZones),
        }
    }

    fn bit(self) -> u16 {
        Self::ALL.iter().position(|pass| *pass == self).map_or(0, |index| 1 << index)
    }
}

/// A step of the fallbacks in one image: the allowed passes of one kind together.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) enum FallbackStep {
    Arcs,
    Blobs,
    Segments,
    QuietZones,
    /// Segments for families to which quiet zones are quicker.
    LateSegments,
    /// The last one: it overwrites the data of the image itself.
    Brightened,
}

impl FallbackStep {
    /// All steps, in the order in which they run in an image.
    pub(crate) const ALL: [Self; 6] = [
        Self::Arcs,
        Self::Blobs,
        Self::Segments,
        Self::QuietZones,
        Self::LateSegments,
        Self::Brightened,
    ];

    /// The name of its stage; `None` for steps whose families name their stages.
    pub(crate) fn stage(self) -> Option<&'static str> {
        match self {
            Self::Arcs | Self::Blobs | Self::Brightened => None,
            Self::Segments | Self::LateSegments => Some("occluded"),
            Self::QuietZones => Some("quiet zones"),
        }
    }
}

/// The fallback passes that may run in an image.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct PassSchedule(u16);

impl PassSchedule {
    /// Every pass.
    pub const ALL: Self = Self(0b1_1111_1111);
    /// No pass.
    pub const NONE: Self = Self(0);

    /// One pass.
    pub fn only(pass: FallbackPass) -> Self {
        Self(pass.bit())
    }

    /// These without one.
    pub fn without(self, pass: FallbackPass) -> Self {
        Self(self.0 & !pass.bit())
    }

    /// Whether a pass may run.
    pub fn allows(self, pass: FallbackPass) -> bool {
        self.0 & pass.bit() != 0
    }

    /// Whether a pass of a step may run.
    pub(crate) fn allows_step(self, step: FallbackStep) -> bool {
        let step = if step == FallbackStep::LateSegments { FallbackStep::Segments } else { step };
        FallbackPass::ALL.into_iter().any(|pass| pass.step() == Some(step) && self.allows(pass))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_schedule_allows_the_passes_it_was_made_of() {
        for pass in FallbackPass::ALL {
            let only = PassSchedule::only(pass);
            for other in FallbackPass::ALL {
                assert_eq!(only.allows(other), other == pass);
                assert_eq!(PassSchedule::ALL.without(pass).allows(other), other != pass);
            }
            if let Some(step) = pass.step() {
                assert!(only.allows_step(step) && !PassSchedule::NONE.allows_step(step));
            }
        }
    }

    #[test]
    fn strips_cover_every_row_once() {
        for height in [1, 2, 3, 100, 971] {
            let [upper, middle, lower] = ImageStrip::ALL.map(|strip| strip.rows(height));
            assert_eq!((upper.start, upper.end, middle.end), (0, middle.start, lower.start));
            assert_eq!(lower.end, height);
        }
    }
}
