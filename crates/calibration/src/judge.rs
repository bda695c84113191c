//! Calibrates a camera from views of a board: checks the views, solves, and refuses sets that are mirrored, noisy,
//! hardly tilted, at one distance, or whose halves contradict each other.

use libm::{fmax, fmin};

use crate::board::Sheet;
use crate::calibration::{Calibration, Options};
use crate::evidence::{Coverage, Estimate, Evidence};
use crate::halves::{self, CrossValidation};
use crate::lens::Lens;
use crate::refusal::Refusal;
use crate::stages;
use crate::start::first_pose;
use crate::view::{ImageSize, View};

/// Points that a view must show to be used.
const MIN_POINTS: usize = 12;
/// Views that must be usable.
const MIN_VIEWS: usize = 8;
/// Views without which there is nothing to solve at all.
const MIN_UNJUDGED_VIEWS: usize = 4;
/// Points that are solved: hundreds of views of a large board.
const MAX_POINTS: usize = 300_000;

/// The camera that took these views, if they show it.
///
/// # Errors
/// Why they do not, in a sentence for users.
pub fn calibrate(views: &[View], lens: Lens, options: &Options) -> Result<Calibration, Refusal> {
    let task = Task::new(views, MIN_VIEWS)?;
    // Where too little was seen a solver may find nothing at all, which would not name the reason.
    let coverage = Coverage::new(&task.sheet.views, task.size);
    if coverage.covered < limit::MIN_COVERED {
        return Err(Refusal::PartOfImage {
            covered_percent: 100.0 * coverage.covered,
            min_percent: 100.0 * limit::MIN_COVERED,
            missing: coverage.emptiest,
        });
    }
    let calibration = task.solve(lens, options)?;
    judge(&calibration)?;
    Ok(calibration)
}

/// As [`calibrate`], for sets that may be worse than its limits: refused only where there is no result.
///
/// # Errors
/// Why there is none.
pub fn calibrate_unjudged(
    views: &[View],
    lens: Lens,
    options: &Options,
) -> Result<Calibration, Refusal> {
    Task::new(views, MIN_UNJUDGED_VIEWS)?.solve(lens, options)
}

/// Views that can be solved.
struct Task<'a> {
    size: ImageSize,
    views: Vec<&'a View>,
    sheet: Sheet,
}

impl<'a> Task<'a> {
    fn new(views: &'a [View], min_views: usize) -> Result<Self, Refusal> {
        let size = common_size(views, min_views)?;
        let views: Vec<&View> =
            views.iter().filter(|view| view.points.len() >= MIN_POINTS).collect();
        let sheet = Sheet::new(&views);
        refuse_mirrored(&sheet, size)?;
        Ok(Self { size, views, sheet })
    }

    fn solve(&self, lens: Lens, options: &Options) -> Result<Calibration, Refusal> {
        let max_px = MAX_MEDIAN_RESIDUAL * f64::from(self.size.width.max(self.size.height));
        let solved = stages::solve(&self.sheet, lens, self.size, options.solve_bend);
        let noise_px = solved.as_ref().map_or(f64::INFINITY, |solved| solved.noise_px);
        let solved = solved.filter(|_| noise_px < max_px);
        let solved = solved.ok_or(Refusal::Diverged { lens, noise_px, max_px })?;
        let undetermined = Refusal::Undetermined { lens, parameters: lens.parameters() };
        let middle_m = self.sheet.middle_m;
        let mut calibration =
            Calibration::new(&solved, &self.views, middle_m).ok_or(undetermined)?;
        calibration.cross_validation = worst(halves::cross_validations(&solved));
        Ok(calibration)
    }
}

/// Median residual, by the image's width, beyond which there is no solution.
const MAX_MEDIAN_RESIDUAL: f64 = 0.01;

/// The views' size, after all checks that are possible before a solution.
fn common_size(views: &[View], min_views: usize) -> Result<ImageSize, Refusal> {
    let points = views.iter().map(|view| view.points.len()).sum();
    if points > MAX_POINTS {
        return Err(Refusal::TooMany { views: views.len(), points, max_points: MAX_POINTS });
    }
    let usable = views.iter().filter(|view| view.points.len() >= MIN_POINTS).count();
    let too_few = Refusal::TooFewViews { views: usable, min_views, min_points: MIN_POINTS };
    let Some(first) = views.first() else { return Err(too_few) };
    if let Some(other) = views.iter().find(|view| view.size != first.size) {
        return Err(Refusal::MixedSizes {
            first_view: first.name.clone(),
            first: first.size,
            other_view: other.name.clone(),
            other: other.size,
        });
    }
    if let Some(view) = views.iter().find(|view| !is_valid(view)) {
        return Err(Refusal::InvalidPoint { view: view.name.clone(), size: view.size });
    }
    if usable < min_views { Err(too_few) } else { Ok(first.size) }
}

fn is_valid(view: &View) -> bool {
    const MAX_M: f64 = 100.0;
    let [width, height] = [view.size.width, view.size.height].map(f64::from);
    let is_image = (16.0..=65536.0).contains(&width) && (16.0..=65536.0).contains(&height);
    is_image
        && view.points.iter().all(|point| {
            (-width..2.0 * width).contains(&point.seen.x)
                && (-height..2.0 * height).contains(&point.seen.y)
                && point.place_m.iter().all(|place| place.abs() < MAX_M)
        })
}

/// Whether a board is mirrored does not depend on the camera, so any is taken.
fn refuse_mirrored(sheet: &Sheet, size: ImageSize) -> Result<(), Refusal> {
    let camera = geometry::CameraModel::pinhole(size.width, size.height, f64::from(size.width));
    let mirrored = sheet
        .views
        .iter()
        .filter(|points| first_pose(points, &camera).is_some_and(|first| first.is_mirrored))
        .count();
    let views = sheet.views.len();
    if 2 * mirrored > views { Err(Refusal::Mirrored { mirrored, views }) } else { Ok(()) }
}

/// The requirements for a set of views, chosen so that good synthetic sets pass and those of `tests/synthetic/bad.rs` do not.
mod limit {
    /// Tilt that one view of ten exceeds, in degrees.
    pub(super) const MIN_TILT_DEG: f64 = 15.0;
    /// Distance of the farthest tenth of the views by that of the nearest.
    pub(super) const MIN_DISTANCE_RATIO: f64 = 1.2;
    /// Part of the image with points; the circle of a fisheye inscribed in the image covers three quarters.
    pub(super) const MIN_COVERED: f64 = 0.55;
    /// Wrong size of the tags against their spacing, and standard deviations from which on a flaw of the print is accepted.
    pub(super) const MAX_TAG_SCALE: f64 = 0.003;
    pub(super) const MAX_DISTORTED: f64 = 0.004;
    pub(super) const BELIEVED: f64 = 10.0;
    /// Common residuals in pixels, and by the noise: less is harmless, or drowned.
    pub(super) const MAX_STRUCTURE_PX: f64 = 0.1;
    pub(super) const MAX_LENS_SHARE: f64 = 0.25;
    pub(super) const MAX_VIEW_SHARE: f64 = 0.3;
    /// Where the points are better than that, residuals that are mostly the lens's show already from here.
    pub(super) const MAX_CLEAR_STRUCTURE_PX: f64 = 0.05;
    pub(super) const MAX_CLEAR_LENS_SHARE: f64 = 0.5;
    /// The part explained by the position in the image over that explained by the view, from which on the lens is wrong, not
    /// motion.
    pub(super) const MIN_LENS_OF_VIEW: f64 = 0.3;
    /// Differences of two halves: in pixels, and in multiples of their stated uncertainty.
    pub(super) const MAX_DIFFERENCE_PX: f64 = 0.3;
    pub(super) const MAX_RATIO: f64 = 4.0;
    /// Noise and uncertainty in pixels, for images of up to 2000 pixels and by their width beyond.
    pub(super) const MAX_NOISE_PX: f64 = 0.6;
    pub(super) const MAX_UNCERTAINTY_PX: f64 = 0.6;
    pub(super) const LARGE_IMAGE: f64 = 2000.0;
}

/// The first reason not to accept a result: how the board was shown comes first, as it may cause the later ones.
fn judge(calibration: &Calibration) -> Result<(), Refusal> {
    let evidence = &calibration.evidence;
    shown_well(evidence)?;
    printed_well(evidence)?;
    explained_well(calibration)?;
    let camera = &calibration.camera;
    let large = fmax(f64::from(camera.width.max(camera.height)) / limit::LARGE_IMAGE, 1.0);
    let max_px = limit::MAX_NOISE_PX * large;
    if calibration.noise_px > max_px {
        return Err(Refusal::Noisy { noise_px: calibration.noise_px, max_px });
    }
    let (uncertainty_px, max_px) =
        (calibration.worst_formal_uncertainty_px(), limit::MAX_UNCERTAINTY_PX * large);
    if uncertainty_px > max_px {
        return Err(Refusal::Uncertain { uncertainty_px, max_px });
    }
    agreed_well(calibration)
}

fn shown_well(evidence: &Evidence) -> Result<(), Refusal> {
    let tilt_deg = evidence.tilt.to_degrees();
    if tilt_deg < limit::MIN_TILT_DEG {
        return Err(Refusal::NoTilt { tilt_deg, min_deg: limit::MIN_TILT_DEG });
    }
    let (ratio, min_ratio) = (evidence.distance_ratio, limit::MIN_DISTANCE_RATIO);
    if ratio < min_ratio {
        return Err(Refusal::OneDistance { ratio, min_ratio });
    }
    Ok(())
}

fn printed_well(evidence: &Evidence) -> Result<(), Refusal> {
    let beyond = |flaw: Option<Estimate>, limit: f64| {
        let flaw = flaw.filter(|flaw| flaw.value.abs() > limit::BELIEVED * flaw.sigma);
        flaw.map(|flaw| flaw.value).filter(|value| value.abs() > limit)
    };
    if let Some(scale) = beyond(evidence.tag_scale, limit::MAX_TAG_SCALE) {
        let max_percent = 100.0 * limit::MAX_TAG_SCALE;
        return Err(Refusal::TagSize { percent: 100.0 * scale, max_percent });
    }
    // Of a stretch each direction has half.
    let stretch = beyond(evidence.stretch, limit::MAX_DISTORTED / 2.0).map(|half| 2.0 * half);
    match stretch.or(beyond(evidence.shear, limit::MAX_DISTORTED)) {
        Some(flaw) => Err(Refusal::Distorted {
            percent: 100.0 * flaw.abs(),
            max_percent: 100.0 * limit::MAX_DISTORTED,
        }),
        None => Ok(()),
    }
}

fn explained_well(calibration: &Calibration) -> Result<(), Refusal> {
    let Evidence { lens_structure_px, view_structure_px, .. } = calibration.evidence;
    let of_noise = |share: f64| fmax(limit::MAX_STRUCTURE_PX, share * calibration.noise_px);
    let clear_px =
        fmax(limit::MAX_CLEAR_STRUCTURE_PX, limit::MAX_CLEAR_LENS_SHARE * calibration.noise_px);
    let max_px = fmin(of_noise(limit::MAX_LENS_SHARE), clear_px);
    let is_lens = lens_structure_px > limit::MIN_LENS_OF_VIEW * view_structure_px;
    if lens_structure_px > max_px && is_lens {
        let lens = calibration.lens;
        return Err(Refusal::WrongLens { lens, structure_px: lens_structure_px, max_px });
    }
    let max_px = of_noise(limit::MAX_VIEW_SHARE);
    if view_structure_px > max_px {
        return Err(Refusal::Moving { structure_px: view_structure_px, max_px });
    }
    Ok(())
}

fn agreed_well(calibration: &Calibration) -> Result<(), Refusal> {
    let Some(halves) = calibration.cross_validation else { return Ok(()) };
    let (difference_px, ratio) = (halves.difference_px, halves.ratio());
    let (max_px, max_ratio) = (limit::MAX_DIFFERENCE_PX, limit::MAX_RATIO);
    if excess(&halves) > 1.0 {
        return Err(Refusal::Inconsistent { difference_px, ratio, max_px, max_ratio });
    }
    Ok(())
}

/// The worst of several comparisons.
fn worst(comparisons: impl Iterator<Item = CrossValidation>) -> Option<CrossValidation> {
    comparisons.max_by(|a, b| excess(a).total_cmp(&excess(b)))
}

/// Above 1 where the difference of two halves and its ratio are both beyond their limits, or are not finite.
fn excess(halves: &CrossValidation) -> f64 {
    let [of_difference, of_ratio] =
        [halves.difference_px / limit::MAX_DIFFERENCE_PX, halves.ratio() / limit::MAX_RATIO];
    let excess = fmin(of_difference, of_ratio);
    if excess.is_nan() { f64::INFINITY } else { excess }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_comparison_decides() {
        let halves =
            |difference_px: f64, expected_px| CrossValidation { difference_px, expected_px };
        // A hundred times its uncertainty, but small; large, but uncertain; and five times its uncertainty of 0.2 px.
        let (small, uncertain, bad) = (halves(0.1, 0.001), halves(2.0, 1.0), halves(1.0, 0.2));
        for others in [[small, bad, uncertain], [uncertain, bad, small]] {
            assert_eq!(worst(others.into_iter()), Some(bad));
        }
        assert!(excess(&bad) > 1.0 && excess(&small) < 1.0 && excess(&uncertain) < 1.0);
        for nan in [f64::NAN, -f64::NAN] {
            let found = worst([halves(nan, 0.1), small].into_iter()).unwrap();
            assert!(found.difference_px.is_nan() && excess(&found) > 1.0);
        }
    }
}
