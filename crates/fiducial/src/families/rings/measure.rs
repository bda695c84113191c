//! Measures a candidate circle as the three-ring marker, or refuses it: its pose by edges or by grey values, the mirrored pose,
//! covariance, and how it differs from targets and clutter.

use markers::RingKind;
use nalgebra::Matrix6;

use super::edges::{Completeness, EdgeSearch, EdgeSupport, Reach, confidence};
use super::photometric::{
    MAX_DIAMETER_PX, MAX_EVENNESS_INTERPOLATED, PhotometricFit, PhotometricInput, PhotometricPoses,
    PixelSample, Radii,
};
use crate::candidates::ring_profile::{MIN_SCORE, MIN_STEP, RingCandidate, SMALL_PX};
use crate::families::rings::circle_pose::{CirclePose, EdgePoint, project};
use crate::optics::camera_response::CameraResponse;
use crate::response::ResponseEstimate;
use crate::trace::Reason;

/// Maximum photometric residual, as a fraction of the contrast. Something else in the image, such as a shadow's
/// edge, exceeds it.
const MAX_RESIDUAL: f64 = 0.074;
/// Minimum fraction of the variance that the model explains, by the marker's diameter. Inside a small marker's
/// rim it is higher; with a tiny one, light from beyond the paper counts.
const MIN_R_SQUARED: f64 = 0.95;
const MIN_R_SQUARED_SMALL: f64 = 0.99;
const MIN_R_SQUARED_TINY: f64 = 0.975;
const TINY_PX: f64 = 11.8;
/// The same for a faint small marker, whose residuals are below this many grey levels.
const MIN_R_SQUARED_FAINT: f64 = 0.85;
const MAX_FAINT_NOISE: f64 = 4.0;
/// The same where a camera's processing takes part, which explains more.
const MIN_R_SQUARED_PROCESSED: f64 = 0.985;
const MIN_R_SQUARED_PROCESSED_SMALL: f64 = 0.993;
/// Darkness of the middle ring in units of the outer one where a camera's processing takes part.
const BALANCE: std::ops::Range<f64> = 0.95..1.05;
/// Minimum fraction that is explained of a small marker whose pixels were interpolated from a colour mosaic, up to this
/// diameter in pixels and above it, ...
const MIN_R_SQUARED_INTERPOLATED: f64 = 0.88;
const INTERPOLATED_PX: f64 = 20.0;
const R_SQUARED_INTERPOLATED_PER_PX: f64 = 0.01;
/// ... where the lens' blur is no larger than this fraction of the diameter, as rings that are a tenth of it wide run into each
/// other (markers at the positions of the thesis have 0.058 at most, a target that passed 0.1)
const MAX_BLUR_INTERPOLATED: f64 = 0.06;
/// (or more than this is explained), ...
const MIN_R_SQUARED_BLURRED: f64 = 0.975;
/// ... ink is no blacker than this grey level, the tone curve no flatter than this, ...
const MIN_BLACK: f64 = 0.0;
const MIN_CURVE: f64 = -0.1;
/// ... the image lies below [`MAX_EVENNESS_INTERPOLATED`]
/// (or, where only smoothed residuals determine the radii well enough and the image is as sharp as that, below this at one
/// deviation: true markers of 10 to 13 px are at 0.0 ± 0.2, targets of evenly wide rings at 0.5 ± 0.2), ...
const MAX_EVENNESS_COMPRESSED: f64 = 0.28;
/// ... the radii are known to this fraction of the marker's radius, and differ from its own by no more than
/// [`MAX_RADII_OFF_CLEAR`] and two deviations.
const MAX_RADII_DEVIATION_INTERPOLATED: f64 = 0.05;
const RADII_SIGMAS: f64 = 2.0;
/// Maximum difference of the radii of other markers from their own, as a fraction of the radius, with this standard deviation,
/// ...
const MAX_RADII_OFF: f64 = 0.028;
const MAX_RADII_DEVIATION: f64 = 0.03;
/// ... or this one where the image is below [`MAX_EVENNESS`] at two deviations. A single radius is hardly seen through compression,
/// how all of them differ together is.
const MAX_RADII_OFF_CLEAR: f64 = 0.045;
/// Maximum place between the marker (0) and a target of evenly wide rings (1). True markers at the positions of the thesis have
/// 0.23 at most, in all kinds of cameras; drawn targets 0.39 at least where as much is explained.
const MAX_EVENNESS: f64 = 0.3;
/// The same, and on the other side of the marker, where rings are thinner and farther apart, where the place is known: of 550
/// markers of less than 48 px it was beyond two of its deviations 0.17 at most, and on the other side 0.39, where light saturates.
const MAX_EVENNESS_KNOWN: f64 = 0.2;
const MAX_THINNESS: f64 = 0.45;
/// Maximum standard deviation of a place that is known; markers of 8 to 12 px have more, and places of 0.3 and -1.
const KNOWN_DEVIATION: f64 = 0.05;
/// Minimum cost of a target of evenly wide rings over the marker's, where no camera's processing takes part. Of 740 markers at
/// the positions of the thesis the least was 1.89; far away, where blur leaves both alike, of 90 the least was 0.76. Of 72
/// rendered targets of 9 to 26 px that pass the other bounds 33 have less.
const MIN_TARGET_COST: f64 = 0.7;
/// Maximum blackness beyond black of the ink, as a fraction of the contrast. Halos of sharpening give 0.13.
const MAX_BLACKNESS: f64 = 0.15;
/// Minimum diameter in pixels of a marker that is recognised by one ring.
const MIN_SINGLE_RING_PX: f64 = 90.0;
/// Distance by which a camera's processing moves edges into the black, at least in pixels, and at most in pixels and in widths of
/// the outer ring: half of sRGB's range between black ink and white paper is a fifth of the light.
const MIN_SHIFT_PX: f64 = 0.1;
const MAX_SHIFT_PX: f64 = 1.0;
const MAX_SHIFT_RATIO: f64 = 0.2;
/// The same in standard deviations of the image's blur, within which an edge rises: where sRGB has half of its range is 0.8 of
/// them from the middle of the light. Of 360 processed markers the largest was 0.93; rings of other radii had 1.2 and more.
const MAX_SHIFT_BLURS: f64 = 1.0;
/// Width of the outer ring in marker sizes.
const OUTER_RING_WIDTH: f64 = 0.1;
/// Steps in which that distance is estimated.
const SHIFT_STEPS: usize = 2;
/// Factor of the covariance when something disturbs the marker's image.
const DISTURBED: f64 = 16.0;
/// Poses whose normals differ by less, in radians, are the same.
const DISTINCT_TILT: f64 = 0.01;

/// Working memory of a measurement.
#[derive(Debug, Default)]
pub(super) struct Buffers {
    pub(super) edges: Vec<EdgePoint>,
    pub(super) samples: Vec<PixelSample>,
}

/// The mirrored pose.
#[derive(Copy, Clone, Debug)]
pub(super) struct MirroredPose {
    pub(super) pose: CirclePose,
    pub(super) rms_px: f64,
}

/// A marker with its pose.
#[derive(Copy, Clone, Debug)]
pub(super) struct MeasuredMarker {
    pub(super) pose: CirclePose,
    /// Root mean square distance between the edges in the image and those of the pose, in pixels.
    pub(super) rms_px: f64,
    /// Covariance of centre (m) and rotation vector (rad), in the camera frame.
    pub(super) covariance: Matrix6<f64>,
    /// Where it is distinct.
    pub(super) alternative: Option<MirroredPose>,
    /// From 0 to 1.
    pub(super) confidence: f64,
    /// How the camera shows light, where that was fitted.
    pub(super) response: Option<ResponseEstimate>,
}

/// A pose fitted to edges.
struct EdgePose {
    pose: CirclePose,
    rms_px: f64,
    support: [EdgeSupport; 6],
}

impl EdgeSearch<'_> {
    /// The marker of which a candidate is one circle.
    pub(super) fn measure(
        &self,
        candidate: &RingCandidate,
        buffers: &mut Buffers,
    ) -> Result<MeasuredMarker, Reason> {
        buffers.edges.clear();
        let radius_m = candidate.radius * self.size_m;
        let both = CirclePose::from_ellipse(&candidate.border.ellipse, radius_m, self.camera)
            .ok_or(Reason::Pose)?;
        if candidate.diameter_px() < SMALL_PX {
            return self.measure_small(&both[0], candidate.diameter_px(), &mut buffers.samples);
        }
        let kind = ring_with_circle(candidate.radius);
        if candidate.score < MIN_SCORE {
            let single = self.measure_single_ring(&both[0], kind, &mut buffers.edges);
            return single.ok_or(Reason::Edges);
        }
        let rough = self.rough_pose(&both[0], &mut buffers.edges);
        if let Some(rough) = &rough
            && let Some(measured) = self.measure_photometric(rough, buffers)
        {
            return Ok(measured);
        }
        let found = self.edge_pose(rough, &both[1], &mut buffers.edges)?;
        let diameter_px = self.diameter_px(&found.pose).ok_or(Reason::Pose)?;
        let completeness = self.completeness(&found.pose, &found.support);
        if completeness != Completeness::Insufficient
            && !self.is_likely_target(&found.pose, &buffers.edges)
            && let Some(fit) =
                self.photometric_poses(&found.pose, diameter_px, &mut buffers.samples)
        {
            let measured =
                from_photometric(&fit, confidence(&found.support)).ok_or(Reason::Pose)?;
            return Ok(self.with_form(measured, &buffers.edges));
        }
        let edges = &mut buffers.edges;
        self.locate(&found.pose, Reach::Near, edges);
        if let Some(shift_px) = self.likely_shift_px(&found.pose, 0.0, edges) {
            if let Some(measured) = self.measure_shifted_edges(found.pose, shift_px, edges) {
                return Ok(measured);
            }
            self.locate(&found.pose, Reach::Near, edges);
        }
        if let Some(measured) = self.measure_edges(&found, edges)? {
            return Ok(measured);
        }
        if completeness == Completeness::Full && self.is_likely_target(&found.pose, edges) {
            return Err(Reason::Type);
        }
        self.measure_single_ring(&found.pose, kind, edges).ok_or(Reason::Edges)
    }

    /// The marker at a pose fitted to edges, when those that were located near it are where the marker has them: its grey
    /// values were not a marker's, as light or an occluder changes them.
    ///
    /// # Errors
    /// When the pose has no covariance.
    fn measure_edges(
        &self,
        found: &EdgePose,
        edges: &mut Vec<EdgePoint>,
    ) -> Result<Option<MeasuredMarker>, Reason> {
        let EdgePose { pose, rms_px, support } = found;
        let diameter_px = self.diameter_px(pose).ok_or(Reason::Pose)?;
        let bias_px = pose.max_bias_px(edges, self.camera);
        pose.remove_outliers(edges, self.camera);
        let large = diameter_px > MAX_DIAMETER_PX;
        // Curved paper and lens errors grow with the diameter.
        let bias_ratio = if large { 2e-3 } else { 6e-4 };
        let is_within = |max_rms_px: f64, max_bias_px: f64| {
            *rms_px < (max_rms_px + 3e-3 * diameter_px).min(0.9)
                && bias_px < max_bias_px * (diameter_px / 60.0).min(1.0) + bias_ratio * diameter_px
        };
        let fits = match self.completeness(pose, support) {
            Completeness::Insufficient | Completeness::Innermost => false,
            Completeness::Partial => is_within(0.1, 0.05),
            Completeness::Full => is_within(0.3, 0.12),
        };
        if !fits || self.is_shifted_too_far(pose) || self.has_other_widths(pose, edges) {
            return Ok(None);
        }
        let mut measured =
            self.at_edge_pose(*pose, *rms_px, edges, confidence(support)).ok_or(Reason::Pose)?;
        if !large {
            // Light or an occluder shifts the edges of one side together.
            measured.covariance *= DISTURBED;
        }
        Ok(Some(self.with_form(measured, edges)))
    }

    /// Whether edges lie further in the black than a camera's processing moves them in an image as sharp as this one.
    fn is_shifted_too_far(&self, pose: &CirclePose) -> bool {
        let is_too_far = |blur_px: f64| self.into_black_px > MAX_SHIFT_BLURS * blur_px;
        self.into_black_px > 0.0 && self.edge_blur_px(pose).is_some_and(is_too_far)
    }

    /// Whether edges are those of rings of other widths, evener or thinner. Of 913 markers that were recognised by their edges
    /// none was farther off than 0.17.
    fn has_other_widths(&self, pose: &CirclePose, edges: &[EdgePoint]) -> bool {
        pose.evenness(edges, self.size_m, self.camera)
            .is_some_and(|it| it.share.abs() > MAX_EVENNESS)
    }

    /// Whether edges next to a fit to grey values are nearer to those of a target of evenly wide rings than to the marker's, by
    /// more than their uncertainty explains. Of 757 such markers the largest was 0.14 beyond its deviation.
    fn is_likely_target(&self, pose: &CirclePose, edges: &[EdgePoint]) -> bool {
        pose.evenness(edges, self.size_m, self.camera)
            .is_some_and(|it| it.share > MAX_EVENNESS + it.deviation)
    }

    /// As [`Self::measure_edges`], where a camera's tone curve and sharpening have moved all edges into the black by the same
    /// number of pixels, of which a first estimate is given.
    fn measure_shifted_edges(
        &self,
        mut pose: CirclePose,
        mut shift_px: f64,
        edges: &mut Vec<EdgePoint>,
    ) -> Option<MeasuredMarker> {
        let shifted = |into_black_px| Self { into_black_px, ..*self };
        for _ in 1..SHIFT_STEPS {
            shifted(shift_px).locate(&pose, Reach::Near, edges);
            pose = pose.refined(edges, self.camera)?.0;
            shifted(shift_px).locate(&pose, Reach::Near, edges);
            shift_px = self.likely_shift_px(&pose, shift_px, edges)?;
        }
        let search = shifted(shift_px);
        search.locate(&pose, Reach::Near, edges);
        pose = pose.refined(edges, self.camera)?.0;
        let found = search.edge_pose(Some(pose), &pose.mirrored(), edges).ok()?;
        search.locate(&found.pose, Reach::Near, edges);
        search.measure_edges(&found, edges).ok().flatten()
    }

    /// How far edges lie in the black that were located with a distance known so far; `None` where no camera moves them so.
    fn likely_shift_px(
        &self,
        pose: &CirclePose,
        so_far_px: f64,
        edges: &[EdgePoint],
    ) -> Option<f64> {
        let width_px = self.diameter_px(pose)? * OUTER_RING_WIDTH;
        let shift_px = so_far_px + pose.shift_into_black_px(edges, self.camera)?;
        let max_px = MAX_SHIFT_PX.min(MAX_SHIFT_RATIO * width_px);
        (shift_px > MIN_SHIFT_PX && shift_px < max_px).then_some(shift_px)
    }

    /// The marker near a predicted pose, when it is neither too small nor too large nor disturbed.
    pub(super) fn measure_tracked(
        &self,
        predicted: &CirclePose,
        buffers: &mut Buffers,
    ) -> Option<MeasuredMarker> {
        let diameter_px = self.diameter_px(predicted)?;
        if diameter_px < SMALL_PX {
            return None;
        }
        if let Some(measured) = self.measure_at_prediction(predicted, diameter_px, buffers) {
            return Some(measured);
        }
        let rough = self.rough_pose(predicted, &mut buffers.edges)?;
        self.measure_photometric(&rough, buffers)
    }

    /// The marker right at the predicted pose, when its grey values and its edges are a marker's.
    fn measure_at_prediction(
        &self,
        predicted: &CirclePose,
        diameter_px: f64,
        buffers: &mut Buffers,
    ) -> Option<MeasuredMarker> {
        let fit = self.photometric().fit_tracked(predicted, &mut buffers.samples)?;
        let is_near = self.is_near(predicted, &fit.best.pose, 1.0 + 0.03 * diameter_px, 0.1);
        if !is_near || !is_undisturbed(&fit.best) {
            return None;
        }
        let support = self.locate(&fit.best.pose, Reach::Sparse, &mut buffers.edges);
        let measured = from_photometric(&fit, confidence(&support))?;
        (self.completeness(&fit.best.pose, &support) == Completeness::Full)
            .then(|| self.with_form(measured, &buffers.edges))
    }

    /// A marker too small for edges: its grey values decide.
    fn measure_small(
        &self,
        start: &CirclePose,
        candidate_px: f64,
        samples: &mut Vec<PixelSample>,
    ) -> Result<MeasuredMarker, Reason> {
        let poses = self.photometric().fit(start, samples).ok_or(Reason::Pose)?;
        let fit = &poses.best;
        let is_marker = (is_small_marker(fit, candidate_px)
            || is_interpolated_marker(fit, candidate_px)
            || self.shadow_removed && is_marker_under_edge(fit))
            && !has_other_widths(fit)
            && !is_blacker_than_ink(fit)
            && (self.is_followed(&fit.pose) || !is_explained_by_target(fit))
            && fit.contrast > 2.0 * MIN_STEP
            && fit.has_rings()
            && self.is_near(start, &fit.pose, 1.5, 0.3);
        if !is_marker {
            return Err(Reason::Edges);
        }
        from_photometric(&poses, fit.r_squared).ok_or(Reason::Pose)
    }

    /// Whether a pose has its centre within `max_px` of another's, at nearly its distance.
    fn is_near(&self, start: &CirclePose, found: &CirclePose, max_px: f64, ratio: f64) -> bool {
        let centres = project(start.centre, self.camera).zip(project(found.centre, self.camera));
        centres.is_some_and(|(a, b)| a.distance(&b) < max_px)
            && (found.centre.z / start.centre.z - 1.0).abs() < ratio
    }

    fn diameter_px(&self, pose: &CirclePose) -> Option<f64> {
        pose.outline(self.size_m / 2.0, self.camera).map(|outline| outline.major)
    }

    fn photometric(&self) -> PhotometricInput<'_> {
        let Self { view, camera, size_m, white_on_black, .. } = *self;
        PhotometricInput { view, camera, size_m, white_on_black }
    }

    /// The pose of the edges found far around a start; `None` when too few are.
    fn rough_pose(&self, start: &CirclePose, edges: &mut Vec<EdgePoint>) -> Option<CirclePose> {
        let support = self.locate(start, Reach::Far, edges);
        let is_found = |s: &&EdgeSupport| s.share().is_some_and(|share| share > 0.4);
        let inner_only = support[..4].iter().all(|s| s.share().is_none());
        if support.iter().filter(is_found).count() < if inner_only { 2 } else { 3 } {
            return None;
        }
        start.refined(edges, self.camera).map(|(rough, _)| rough)
    }

    /// The marker near a rough pose, when it is not too large and its grey values are a marker's.
    fn measure_photometric(
        &self,
        rough: &CirclePose,
        buffers: &mut Buffers,
    ) -> Option<MeasuredMarker> {
        let diameter_px = self.diameter_px(rough)?;
        let fit = self.photometric_poses(rough, diameter_px, &mut buffers.samples)?;
        let support = self.locate(&fit.best.pose, Reach::Near, &mut buffers.edges);
        let measured = from_photometric(&fit, confidence(&support))?;
        let completeness = self.completeness(&fit.best.pose, &support);
        let is_marker = completeness != Completeness::Insufficient
            && !self.is_likely_target(&fit.best.pose, &buffers.edges);
        is_marker.then(|| self.with_form(measured, &buffers.edges))
    }

    /// The same, less sure where its edges show that the print is not flat.
    fn with_form(&self, mut measured: MeasuredMarker, edges: &[EdgePoint]) -> MeasuredMarker {
        let MeasuredMarker { pose, covariance, .. } = measured;
        measured.covariance = pose.widened_by_form(covariance, edges, self.camera);
        measured
    }

    /// The pose of all edges, from a rough pose or from another start.
    fn edge_pose(
        &self,
        rough: Option<CirclePose>,
        start: &CirclePose,
        edges: &mut Vec<EdgePoint>,
    ) -> Result<EdgePose, Reason> {
        let mut best: Option<(CirclePose, f64)> = None;
        for is_first in [true, false] {
            let rough = if is_first { rough } else { self.rough_pose(start, edges) };
            let Some(rough) = rough else { continue };
            let near = self.locate(&rough, Reach::Near, edges);
            let Some((pose, rms)) = rough.refined(edges, self.camera) else { continue };
            // Per edge point found: a wrong pose finds few.
            let cost = (rms + 0.1) / edges.len() as f64;
            if best.is_none_or(|(_, min)| cost < min) {
                best = Some((pose, cost));
            }
            let visible: u32 = near.iter().map(|s| s.visible).sum();
            if rms < 0.3 && 10 * edges.len() > 9 * visible as usize {
                break;
            }
        }
        let (mut pose, _) = best.ok_or(Reason::Edges)?;
        let support = self.locate(&pose, Reach::Near, edges);
        pose.remove_outliers(edges, self.camera);
        let mut rms_px;
        (pose, rms_px) = pose.refined(edges, self.camera).ok_or(Reason::Edges)?;
        // The mirrored pose has nearly the same image.
        if let Some((other, other_rms)) = pose.mirrored().refined(edges, self.camera)
            && other_rms < rms_px
        {
            (pose, rms_px) = (other, other_rms);
        }
        Ok(EdgePose { pose, rms_px, support })
    }

    /// The poses from the grey values; `None` for a large marker, and when the grey values are not a marker's
    /// or disagree with its edges.
    fn photometric_poses(
        &self,
        pose: &CirclePose,
        diameter_px: f64,
        samples: &mut Vec<PixelSample>,
    ) -> Option<PhotometricPoses> {
        let fit = self.photometric().fit(pose, samples)?;
        let agrees = (is_undisturbed(&fit.best) || is_compressed_marker(&fit.best, diameter_px))
            && self.is_near(pose, &fit.best.pose, 0.3 + 0.01 * diameter_px, 0.1);
        agrees.then_some(fit)
    }

    /// The marker of which only one ring is visible, because its neighbour is covered: a marker only where one is followed, as
    /// in a single image a lamp or a wheel next to a dark object looks as much like one.
    fn measure_single_ring(
        &self,
        start: &CirclePose,
        kind: RingKind,
        edges: &mut Vec<EdgePoint>,
    ) -> Option<MeasuredMarker> {
        if kind == RingKind::Inner
            || self.white_on_black
            || !self.is_followed(start)
            || !self.is_neighbour_covered(start, kind)?
        {
            return None;
        }
        // A single middle ring has the dot in it.
        edges.clear();
        let dot = self.locate_edge(start, 4, Reach::Near, edges).share();
        if kind == RingKind::Middle && dot.is_none_or(|share| share < 0.9) {
            return None;
        }
        edges.clear();
        let own = kind as usize * 2;
        let mut support = [EdgeSupport::default(); 6];
        for (index, support) in support.iter_mut().enumerate().skip(own).take(2) {
            *support = self.locate_edge(start, index, Reach::Near, edges);
        }
        let is_complete =
            support.iter().skip(own).take(2).all(|s| s.share().is_some_and(|s| s >= 0.95));
        let (pose, rms_px) = start.refined(edges, self.camera)?;
        let diameter_px = self.diameter_px(&pose)?;
        // With two circles only, the radii must be right.
        let limit_px = 0.06 + 4e-4 * diameter_px;
        let fits = diameter_px > MIN_SINGLE_RING_PX
            && rms_px < 2.0 * limit_px
            && pose.max_bias_px(edges, self.camera) < limit_px;
        let is_marker = is_complete && fits && self.is_neighbour_covered(&pose, kind)?;
        is_marker
            .then(|| self.at_edge_pose(pose, rms_px, edges, 0.5 * confidence(&support)))
            .flatten()
            .map(|measured| self.with_form(measured, edges))
    }

    /// The marker at a pose fitted to edges.
    fn at_edge_pose(
        &self,
        pose: CirclePose,
        rms_px: f64,
        edges: &[EdgePoint],
        confidence: f64,
    ) -> Option<MeasuredMarker> {
        let covariance = pose.covariance(edges, self.camera)?;
        let alternative = pose
            .mirrored()
            .refined(edges, self.camera)
            .filter(|(other, _)| other.normal.angle(&pose.normal) > DISTINCT_TILT)
            .map(|(pose, rms_px)| MirroredPose { pose, rms_px });
        let response = None;
        Some(MeasuredMarker { pose, rms_px, covariance, alternative, confidence, response })
    }
}

/// The marker at a pose fitted to grey values.
fn from_photometric(fit: &PhotometricPoses, confidence: f64) -> Option<MeasuredMarker> {
    // An edge as high as the contrast rises within two and a half times the blur.
    let rms_px = |blur_px: f64, residual: f64| 2.5 * blur_px * residual;
    let PhotometricPoses { best, alternative } = fit;
    let covariance = best.pose.full_covariance(&best.covariance);
    Some(MeasuredMarker {
        pose: best.pose,
        rms_px: rms_px(best.blur_px, best.residual),
        covariance: covariance.iter().all(|c| c.is_finite()).then_some(covariance)?,
        alternative: alternative.map(|other| MirroredPose {
            pose: other.pose,
            rms_px: rms_px(other.blur_px, other.residual),
        }),
        confidence,
        response: best.estimated_response,
    })
}

/// Whether a fit is a marker's with nothing on it.
fn is_undisturbed(fit: &PhotometricFit) -> bool {
    fit.residual < MAX_RESIDUAL
        && !has_other_widths(fit)
        && fit.has_rings()
        && fit.r_squared > MIN_R_SQUARED
        && is_plain_or_close(fit, MIN_R_SQUARED_PROCESSED)
        && (fit.mosaic.is_none() || has_marker_radii(fit))
}

/// Whether a fit to a marker too small for edges is a marker's.
fn is_small_marker(fit: &PhotometricFit, candidate_px: f64) -> bool {
    // Noise may be a large part of a faint marker.
    let faint = fit.r_squared > MIN_R_SQUARED_FAINT
        && fit.residual * fit.contrast < MAX_FAINT_NOISE
        && fit.residual < 1.5 * MAX_RESIDUAL
        && fit.radii.is_none_or(|it| it.evenness < MAX_EVENNESS);
    let tiny = candidate_px < TINY_PX;
    let min_r_squared = if tiny { MIN_R_SQUARED_TINY } else { MIN_R_SQUARED_SMALL };
    let clear = fit.r_squared > min_r_squared && fit.residual < MAX_RESIDUAL;
    (clear || faint)
        // Other things blurred beyond recognition fit rings that are blacker than black, though less well
        // than sharpening makes a marker's.
        && (!tiny || fit.contrast < 260.0 || is_sharpened(fit))
        && is_plain_or_close(fit, MIN_R_SQUARED_PROCESSED_SMALL)
}

/// Whether a fit to pixels interpolated from a colour mosaic is a small marker's. Compression is a large part of its
/// residual, so that the radii that would fit best decide, and of these how far all together are from evenly wide rings.
fn is_interpolated_marker(fit: &PhotometricFit, diameter_px: f64) -> bool {
    let is_sharp = fit.blur_px < MAX_BLUR_INTERPOLATED * diameter_px;
    let are_radii_likely = |radii: Radii| {
        let is_far_from_even = radii.is_below_evenness(MAX_EVENNESS_INTERPOLATED)
            || is_sharp
                && radii.are_smoothed
                && radii.evenness + radii.evenness_deviation < MAX_EVENNESS_COMPRESSED;
        is_far_from_even
            && radii.deviation < MAX_RADII_DEVIATION_INTERPOLATED
            && radii.off < MAX_RADII_OFF_CLEAR + RADII_SIGMAS * radii.deviation
    };
    let min_r_squared = MIN_R_SQUARED_INTERPOLATED
        + R_SQUARED_INTERPOLATED_PER_PX * (diameter_px - INTERPOLATED_PX).max(0.0);
    fit.mosaic.is_some()
        && fit.r_squared > min_r_squared
        && fit.residual < MAX_RESIDUAL
        && (is_sharp || fit.r_squared > MIN_R_SQUARED_BLURRED)
        && fit.black > MIN_BLACK
        && fit.response.curve > MIN_CURVE
        && has_balance(fit)
        && fit.radii.is_some_and(are_radii_likely)
}

/// Whether a fit to a marker large enough for edges is a marker's in an image whose compression leaves a larger residual than
/// [`is_undisturbed`] allows: up to 48 px its radii decide, as those of smaller ones.
fn is_compressed_marker(fit: &PhotometricFit, diameter_px: f64) -> bool {
    is_interpolated_marker(fit, diameter_px) && !has_other_widths(fit) && fit.has_rings()
}

/// Whether a fit is a small marker's where the edge of a shadow was: its remainder disturbs the grey values, but not which
/// radii fit best. Of 40 markers of 19 to 25 px the radii were known to 0.011 at worst.
fn is_marker_under_edge(fit: &PhotometricFit) -> bool {
    const MAX_RESIDUAL: f64 = 0.11;
    const MIN_R_SQUARED: f64 = 0.93;
    const MAX_RADII_DEVIATION: f64 = 0.012;
    let are_known = |radii: Radii| {
        radii.deviation < MAX_RADII_DEVIATION && radii.is_below_evenness(MAX_EVENNESS)
    };
    fit.residual < MAX_RESIDUAL
        && fit.r_squared > MIN_R_SQUARED
        && fit.radii.is_some_and(are_known)
        && has_marker_radii(fit)
}

/// Whether the image is nearer to a target of rings of equal width, as targets are often drawn, than to the marker, or to one
/// of thin rings, by more than noise explains.
fn has_other_widths(fit: &PhotometricFit) -> bool {
    fit.radii.is_some_and(|it| {
        let (place, deviation) = (it.evenness, it.evenness_deviation);
        let is_known = deviation < KNOWN_DEVIATION;
        place > MAX_EVENNESS + deviation
            || is_known && place > MAX_EVENNESS_KNOWN + 2.0 * deviation
            || is_known && place < -MAX_THINNESS - deviation
    })
}

/// Whether a target of evenly wide rings explains a small marker's pixels better.
fn is_explained_by_target(fit: &PhotometricFit) -> bool {
    fit.target_cost.is_some_and(|cost| cost < MIN_TARGET_COST)
}

/// Whether a fit needs ink that reflects less than nothing, and not as a sharpened image does.
fn is_blacker_than_ink(fit: &PhotometricFit) -> bool {
    fit.black < -MAX_BLACKNESS * fit.contrast && !is_sharpened(fit)
}

/// Whether the radii that would fit best are the marker's, as far as they can be measured.
fn has_marker_radii(fit: &PhotometricFit) -> bool {
    has_balance(fit)
        && fit.radii.is_none_or(|radii| {
            let max_off = if radii.is_below_evenness(MAX_EVENNESS) {
                MAX_RADII_OFF_CLEAR
            } else {
                MAX_RADII_OFF
            };
            radii.off < max_off && radii.deviation < MAX_RADII_DEVIATION
        })
}

/// Whether the two dark rings are about as dark.
fn has_balance(fit: &PhotometricFit) -> bool {
    const BALANCE: std::ops::Range<f64> = 0.975..1.05;
    BALANCE.contains(&fit.ring_balance)
}

/// Whether a fit needs no camera's processing, or is so close with it that rings of other radii are not: a tone curve
/// makes all dark rings narrower. Of 222 processed markers at all positions of the
/// thesis the worst explained 0.995, with balances from 0.98 to 1.02.
fn is_plain_or_close(fit: &PhotometricFit, min_r_squared: f64) -> bool {
    fit.response == CameraResponse::LINEAR
        || fit.r_squared > min_r_squared && BALANCE.contains(&fit.ring_balance)
}

/// Whether a small fit is so good that a contrast beyond the grey values may be a sharpened marker's.
fn is_sharpened(fit: &PhotometricFit) -> bool {
    const MAX_CONTRAST: f64 = 600.0;
    const MAX_DISC_RATIO: f64 = 0.02;
    fit.contrast < MAX_CONTRAST
        && fit.r_squared > MIN_R_SQUARED_SMALL
        && fit.disc_ratio < MAX_DISC_RATIO
}

/// The ring to which a circle of this radius (in marker sizes) belongs.
pub(super) fn ring_with_circle(radius: f64) -> RingKind {
    let belongs = |kind: &RingKind| {
        let (inner, outer) = kind.radii();
        (inner - 1e-6..=outer + 1e-6).contains(&radius)
    };
    RingKind::ALL.into_iter().find(belongs).unwrap_or(RingKind::Inner)
}
