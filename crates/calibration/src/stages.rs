//! From points to the minimum: a guess, what matters most, then all, with a loss that narrows to the noise found.

use crate::board::{BEND, BoardPoint, SOLVED, Sheet};
use crate::covariance::{Certainty, certainty};
use crate::equations::{Bundle, Free, Place};
use crate::lens::Lens;
use crate::solve::{minimise, undistorted};
use crate::start::{focal_guesses, poses, with_better_poses};
use crate::view::ImageSize;

/// A bundle at its minimum.
#[derive(Clone, Debug)]
pub(crate) struct Solved {
    pub(crate) lens: Lens,
    pub(crate) size: ImageSize,
    /// The points of the views that were used.
    pub(crate) views: Vec<Vec<BoardPoint>>,
    /// Which of those given they are.
    pub(crate) used: Vec<usize>,
    pub(crate) place: Place,
    pub(crate) free: Free,
    pub(crate) scale_px: f64,
    pub(crate) bend_m: f64,
    pub(crate) noise_px: f64,
}

/// How far residuals may lie, in standard deviations of the noise, before they lose half of their influence.
const ROBUST: f64 = 4.0;
/// The median length of an error that is normal along two axes, in standard deviations of each.
const MEDIAN_LENGTH: f64 = 1.177_410_022_515_474_7;
/// Below this noise, in pixels, the loss is no longer narrowed.
const MIN_NOISE_PX: f64 = 0.005;
/// How far from flat a board is expected to be, by half of its size.
const BEND_SHARE: f64 = 0.05;
/// Guesses that are followed when the first leads nowhere.
const MAX_GUESSES: usize = 3;
/// Noise, by the image's width, at which a guess has led somewhere.
const GOOD_SHARE: f64 = 5e-4;
/// Views without which no guess is followed.
const MIN_VIEWS: usize = 3;

/// The minimum for these points; `None` where no guess leads to one.
pub(crate) fn solve(
    sheet: &Sheet,
    lens: Lens,
    size: ImageSize,
    solve_bend: bool,
) -> Option<Solved> {
    let mut best: Option<Solved> = None;
    for focal_px in focal_guesses(lens, size, &sheet.views).into_iter().take(MAX_GUESSES) {
        let Some(found) = followed(sheet, lens, size, focal_px, solve_bend) else { continue };
        let is_good = found.noise_px < GOOD_SHARE * f64::from(size.width.max(size.height));
        if best.as_ref().is_none_or(|best| found.noise_px < best.noise_px) {
            best = Some(found);
        }
        if is_good {
            break;
        }
    }
    best
}

fn followed(
    sheet: &Sheet,
    lens: Lens,
    size: ImageSize,
    focal_px: f64,
    solve_bend: bool,
) -> Option<Solved> {
    let wide = f64::from(size.width.max(size.height));
    let bend_m = BEND_SHARE * libm::fmax(sheet.half_m[0], sheet.half_m[1]);
    let shared = undistorted(focal_px, size);
    let whole = Bundle { lens, size, views: &sheet.views, scale_px: 0.02 * wide, bend_m };
    let (used, poses): (Vec<usize>, Vec<_>) = poses(&whole, &shared)
        .into_iter()
        .enumerate()
        .filter_map(|(i, pose)| Some((i, pose?)))
        .unzip();
    if used.len() < MIN_VIEWS {
        return None;
    }
    let views: Vec<Vec<BoardPoint>> = used.iter().map(|i| sheet.views[*i].clone()).collect();
    let rough = Bundle { views: &views, ..whole };
    let mut place = Place { shared, poses };
    place = minimise(&rough, place, &Free::none().with(0..2).with(4..5), 8).place;
    let intrinsics = Free::intrinsics(lens.parameters());
    place = minimise(&rough, place, &intrinsics, 15).place;
    if with_better_poses(&rough, &mut place) {
        place = minimise(&rough, place, &intrinsics, 15).place;
    }
    let free = if solve_bend { intrinsics.with(BEND..SOLVED) } else { intrinsics };
    let mut solved =
        Solved { lens, size, views, used, place, free, scale_px: 0.0, bend_m, noise_px: 0.0 };
    for _ in 0..3 {
        solved.settle();
    }
    Some(solved)
}

impl Solved {
    /// The bundle that this is the minimum of.
    pub(crate) fn bundle(&self) -> Bundle<'_> {
        let Self { lens, size, scale_px, bend_m, .. } = *self;
        Bundle { lens, size, views: &self.views, scale_px, bend_m }
    }

    /// To the minimum of a loss that suits the noise here.
    fn settle(&mut self) {
        self.scale_px = ROBUST * self.measured_noise_px();
        self.place = minimise(&self.bundle(), self.place.clone(), &self.free, 40).place;
        self.noise_px = self.measured_noise_px();
    }

    /// The same from some of the views only, from here on.
    pub(crate) fn part(&self, keep: impl Fn(usize) -> bool) -> Self {
        let kept: Vec<usize> = (0..self.views.len()).filter(|i| keep(*i)).collect();
        let mut part = Self {
            views: kept.iter().map(|i| self.views[*i].clone()).collect(),
            used: kept.iter().map(|i| self.used[*i]).collect(),
            place: Place {
                shared: self.place.shared,
                poses: kept.iter().map(|i| self.place.poses[*i]).collect(),
            },
            ..*self
        };
        part.settle();
        part
    }

    /// How sure it is, with other numbers free as well.
    pub(crate) fn certainty(&self, others: std::ops::Range<usize>) -> Option<Certainty> {
        certainty(&self.bundle(), &self.place, &self.free.with(others))
    }

    /// Standard deviation of the residuals along each axis, by their median length.
    fn measured_noise_px(&self) -> f64 {
        let camera = self.bundle().camera(&self.place.shared);
        let mut lengths: Vec<f64> = Vec::new();
        for (points, pose) in self.views.iter().zip(&self.place.poses) {
            lengths.extend(points.iter().map(|point| {
                let residual = point.residual(&camera, &self.place.shared, pose);
                residual.map_or(f64::INFINITY, |[x, y]| libm::hypot(x, y))
            }));
        }
        lengths.sort_by(f64::total_cmp);
        let median = lengths.get(lengths.len() / 2).copied().unwrap_or(0.0);
        libm::fmax(median / MEDIAN_LENGTH, MIN_NOISE_PX)
    }
}
