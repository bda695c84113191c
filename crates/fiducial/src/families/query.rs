//! Holds the ids of a family of square markers that are looked for and still missing, the image and the expected marker to
//! search, and converts a decoded quad to an observation.

use geometry::{CameraModel, Pixel};
use imaging::{GrayView, Pyramid};
use markers::{Family, Marker, SquareCode};
use nalgebra::Matrix2;

use crate::candidates::quad::diagonal_px;
use crate::candidates::segment_quads::coarsest_pixel;
use crate::families::family::{FrameInput, PredictedShape, Prediction};
use crate::observation::Observation;
use crate::pose::square_pose;
use crate::refine::fit::Refined;
use crate::response::ResponseEstimate;

/// Standard deviation of corners made of segments: in pixels, and as a fraction of the diagonal.
const MIN_SEGMENT_CORNER_PX: f64 = 0.5;
const SEGMENT_CORNER_RATIO: f64 = 0.015;

/// Corners are not a square in space when their mean squared reprojection error is this multiple of their mean variance: one of
/// thousands is so by chance.
const MIN_MISFIT: f64 = 4.0;

/// Largest reprojection error of a square, in pixels or as a fraction of its diagonal, whichever is larger: bent paper and
/// rolling shutters stay below.
const MAX_MISFIT_PX: f64 = 1.0;
const MAX_MISFIT_RATIO: f64 = 0.02;
/// Largest standard deviation of the centre, in pixels, of a marker that the frame cuts: where its edges do not agree on a
/// place, a corner is a guess that may be off by any distance.
const MAX_CUT_PX: f64 = 0.25;

/// An image in which markers are looked for.
#[derive(Copy, Clone, Debug)]
pub(crate) struct ImageInput<'a> {
    pub(crate) view: GrayView<'a>,
    /// Of `view`.
    pub(crate) pyramid: &'a Pyramid,
    /// Without a camera there are no poses.
    pub(crate) camera: Option<&'a CameraModel>,
    /// How the camera shows light, where that is known.
    pub(crate) response: Option<ResponseEstimate>,
}

impl<'a> ImageInput<'a> {
    /// The image of a frame.
    pub(crate) fn new(input: &'a FrameInput<'_>) -> Self {
        let FrameInput { view, camera, ref evidence, response, .. } = *input;
        Self { view, pyramid: evidence.outlines.pyramid(), camera, response }
    }
}

/// A square marker at its prediction.
#[derive(Copy, Clone, Debug)]
pub(crate) struct ExpectedMarker {
    pub(crate) family: Family,
    pub(crate) id: u32,
    /// Its own top left corner first.
    pub(crate) corners: [Pixel; 4],
}

impl ExpectedMarker {
    /// The square marker of a prediction; `None` of other markers.
    pub(crate) fn new(at: &Prediction) -> Option<Self> {
        match at.shape {
            PredictedShape::Corners(corners) => {
                Some(Self { family: at.family, id: at.id?, corners })
            }
            PredictedShape::Circles(_) => None,
        }
    }
}

/// The markers of one family that are looked for.
#[derive(Debug)]
pub(crate) struct FamilyQuery {
    pub(crate) family: Family,
    pub(crate) markers: Vec<Marker>,
}

impl FamilyQuery {
    pub(crate) fn new(marker: Marker) -> Self {
        Self { family: marker.family, markers: vec![marker] }
    }

    /// Whether every id is looked for.
    pub(crate) fn has_any_id(&self) -> bool {
        self.markers.iter().any(|marker| marker.id.is_none())
    }

    /// The ids that are looked for by number.
    pub(crate) fn ids(&self) -> impl Iterator<Item = u32> + Clone {
        self.markers.iter().filter_map(|marker| marker.id)
    }

    /// Whether an id is looked for. An id that looks like a window is looked for only by its number.
    pub(crate) fn includes(&self, id: u32) -> bool {
        let is_symmetrical =
            || SquareCode::for_family(self.family).is_some_and(|code| code.is_symmetrical(id));
        self.ids().any(|wanted| wanted == id) || (self.has_any_id() && !is_symmetrical())
    }

    /// Whether a fallback is to look for markers that were not found. With `all` that is any missing one;
    /// otherwise only those of any id where two were found, as on a board.
    pub(crate) fn is_missing(&self, all: bool, found: impl Iterator<Item = u32> + Clone) -> bool {
        if self.has_any_id() {
            return all || found.clone().nth(1).is_some();
        }
        all && self.ids().any(|id| found.clone().all(|known| known != id))
    }

    /// The observation of a marker of the family; `None` for corners that are not a square in space, or that the frame
    /// cuts so that its place is a guess.
    pub(crate) fn observation(
        &self,
        id: u32,
        hamming: u8,
        confidence: f64,
        refined: &Refined,
        input: ImageInput<'_>,
    ) -> Option<Observation> {
        let ImageInput { view, camera, .. } = input;
        let corners = refined.corners;
        let named = self.markers.iter().find(|marker| marker.id == Some(id));
        let marker = named.or_else(|| self.markers.iter().find(|marker| marker.id.is_none()));
        let size_m = marker.and_then(|marker| marker.size_m);
        let pose = camera.zip(size_m).and_then(|(camera, size_m)| {
            square_pose(&corners, &refined.covariance_px2, size_m, camera)
        });
        // Corners that are not a square in space, as where one was guessed beyond the frame: the centre is no better.
        let misfit_px2 = pose.map_or(0.0, |pose| pose.reprojection_rms_px.powi(2));
        let max_misfit_px = MAX_MISFIT_PX.max(MAX_MISFIT_RATIO * diagonal_px(&corners));
        if misfit_px2 > max_misfit_px * max_misfit_px {
            return None;
        }
        let is_misfit = misfit_px2 > MIN_MISFIT * refined.covariance_px2.trace() / 8.0;
        let added_px2 = if is_misfit { misfit_px2 } else { 0.0 };
        let centre_covariance_px2 = refined.centre_covariance_px2 + Matrix2::identity() * added_px2;
        if is_cut(&corners, view) && 0.5 * centre_covariance_px2.trace() > MAX_CUT_PX * MAX_CUT_PX {
            return None;
        }
        Some(Observation {
            family: self.family,
            id: Some(id),
            centre: refined.centre,
            centre_covariance_px2,
            corners: Some(corners),
            wrong_bits: hamming,
            size_px: diagonal_px(&corners),
            confidence,
            pose,
            response: refined.response,
        })
    }
}

/// Whether a corner is at the border of the image, where an outline that the frame cuts has one, or beyond it.
fn is_cut(corners: &[Pixel; 4], view: GrayView<'_>) -> bool {
    /// Distance from the border within which the sides of such an outline end, in pixels of the coarsest level on which they are found: a
    /// gradient is that of two rows.
    const BORDER_PX: f64 = 1.5;
    let border_px = BORDER_PX * coarsest_pixel(view);
    let inside = |at: f64, size: usize| at >= border_px && at <= size as f64 - 1.0 - border_px;
    !corners.iter().all(|c| inside(c.x, view.width()) && inside(c.y, view.height()))
}

/// Standard deviation of corners made of segments, in pixels.
pub(crate) fn segment_corner_px(corners: &[Pixel; 4]) -> f64 {
    (SEGMENT_CORNER_RATIO * corners[0].distance(&corners[2])).max(MIN_SEGMENT_CORNER_PX)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cut_outline_is_refused_as_far_from_the_border_as_a_coarse_level_has_its_first_row() {
        let is_seen = |width: usize, y: f64, corner_px: f64| {
            let image = imaging::GrayImage::filled(width, width * 3 / 4, 0);
            let pyramid = Pyramid::default();
            let input = ImageInput {
                view: image.view().unwrap(),
                pyramid: &pyramid,
                camera: None,
                response: None,
            };
            let corners = [[80.0, y], [290.0, y], [290.0, y + 190.0], [80.0, y + 190.0]]
                .map(|[x, y]| Pixel::new(x, y));
            let query = FamilyQuery::new("apriltag-16h5:20".parse().unwrap());
            let refined = Refined::unrefined(&corners, corner_px);
            query.observation(20, 0, 1.0, &refined, input).is_some()
        };
        // The level with a quarter of the rows is the coarsest one of the larger image, that with half of them of the smaller one.
        for (width, y, is_refused) in [
            (648, 2.5, true),
            (648, 3.5, false),
            (1296, 3.5, true),
            (1296, 5.5, true),
            (1296, 6.5, false),
        ] {
            assert_eq!(is_seen(width, y, 3.0), !is_refused, "{width}: {y}");
            // Corners that were measured are where they are.
            assert!(is_seen(width, y, 0.05), "{width}: {y}");
        }
    }

    #[test]
    fn a_window_is_looked_for_by_its_number_only() {
        let query = |text: &str| FamilyQuery::new(text.parse().unwrap());
        assert!(!query("aruco-original:*").includes(1023));
        assert!(query("aruco-original:*").includes(1022));
        assert!(query("aruco-original:1023").includes(1023));
        assert!(!query("aruco-original:1022").includes(1023));
    }
}
