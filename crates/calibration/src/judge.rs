//! Which sets of views are believed.

use crate::board::Sheet;
use crate::calibration::{Calibration, Options};
use crate::halves;
use crate::lens::Lens;
use crate::refusal::Refusal;
use crate::stages::{self, Solved};
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
/// Why they do not, in a sentence for people.
pub fn calibrate(views: &[View], lens: Lens, options: &Options) -> Result<Calibration, Refusal> {
    let (solved, calibration) = solve(views, lens, options, MIN_VIEWS)?;
    judge(&solved, &calibration)?;
    Ok(calibration)
}

/// As [`calibrate`], for sets that may be worth less than it asks for: refused only where there is no result.
///
/// # Errors
/// Why there is none.
pub fn calibrate_unjudged(
    views: &[View],
    lens: Lens,
    options: &Options,
) -> Result<Calibration, Refusal> {
    solve(views, lens, options, MIN_UNJUDGED_VIEWS).map(|(_, calibration)| calibration)
}

fn solve(
    views: &[View],
    lens: Lens,
    options: &Options,
    min_views: usize,
) -> Result<(Solved, Calibration), Refusal> {
    let size = common_size(views, min_views)?;
    let used: Vec<&View> = views.iter().filter(|view| view.points.len() >= MIN_POINTS).collect();
    let sheet = Sheet::new(&used);
    refuse_mirrored(&sheet, size)?;
    let wide = f64::from(size.width.max(size.height));
    let diverged = |noise_px: f64| Refusal::Diverged { lens, noise_px, max_px: MAX_MISFIT * wide };
    let solved = stages::solve(&sheet, lens, size, options.solve_bend)
        .ok_or_else(|| diverged(f64::INFINITY))?;
    if solved.noise_px > MAX_MISFIT * wide {
        return Err(diverged(solved.noise_px));
    }
    let of = |solved: &Solved| Calibration::new(solved, &used, sheet.middle_m);
    let mut calibration = of(&solved).ok_or_else(|| diverged(solved.noise_px))?;
    let [even, odd] = [0, 1].map(|half| of(&solved.part(|i| i % 2 == half)));
    calibration.cross_validation =
        even.zip(odd).and_then(|(even, odd)| halves::compare(&even.half(), &odd.half()));
    Ok((solved, calibration))
}

/// Median misfit, by the image's width, beyond which nothing was found.
const MAX_MISFIT: f64 = 0.01;

/// The views' size, after all that can be said before anything is solved.
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

fn judge(_solved: &Solved, _calibration: &Calibration) -> Result<(), Refusal> {
    Ok(())
}
