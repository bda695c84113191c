//! Leads from points to the minimum: a guess, the most important numbers, then all, with a loss that narrows to the noise
//! found.

use geometry::Pixel;

use crate::board::{BEND, BoardPoint, SOLVED, Shared, Sheet};
use crate::covariance::Information;
use crate::equations::{Bundle, Free, Place};
use crate::lens::{INTRINSICS, Lens, brown_conrady_like};
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
/// The scale of the loss, by the image's width, as long as little is known.
const ROUGH_SHARE: f64 = 0.02;
/// Distance from the middle of an ideal image, in focal lengths, to which Brown-Conrady is made like a fisheye: 79 degrees.
const MAX_RADIUS: f64 = 5.0;
/// How firmly its numbers are then held near zero, one after the other.
const RIDGES: [f64; 4] = [1e-5, 1e-3, 1e-4, 1e-9];
/// Times that the loss is fitted to the noise; twice is usually enough.
const MAX_ROUNDS: usize = 4;
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
    let task = Task { sheet, lens, size, solve_bend };
    // A fraction of polynomials has many valleys; that of the fisheye that explains the points leads to the right one.
    if lens == Lens::BrownConrady8 {
        return task.by_fisheye();
    }
    let mut best: Option<Solved> = None;
    for focal_px in focal_guesses(lens, size, &sheet.views).into_iter().take(MAX_GUESSES) {
        let Some(found) = task.rough(focal_px).map(Solved::settled) else { continue };
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

/// The problem to be solved.
#[derive(Copy, Clone)]
struct Task<'a> {
    sheet: &'a Sheet,
    lens: Lens,
    size: ImageSize,
    solve_bend: bool,
}

impl Task<'_> {
    /// From an undistorted camera, the most important numbers first.
    fn rough(&self, focal_px: f64) -> Option<Solved> {
        let mut solved = self.posed(undistorted(focal_px, self.size))?;
        solved.minimise(&Free::none().with(0..2).with(4..5), 5);
        let intrinsics = Free::intrinsics(self.lens.parameters());
        solved.minimise(&intrinsics, 10);
        let Solved { lens, size, scale_px, bend_m, .. } = solved;
        let bundle = Bundle { lens, size, views: &solved.views, scale_px, bend_m };
        if with_better_poses(&bundle, &mut solved.place) {
            solved.minimise(&intrinsics, 15);
        }
        Some(solved)
    }

    /// From the fisheye that explains the points.
    fn by_fisheye(&self) -> Option<Solved> {
        let fisheye = solve(self.sheet, Lens::KannalaBrandt, self.size, self.solve_bend)?;
        let camera = fisheye.bundle().camera(&fisheye.place.shared);
        let points = fisheye.views.iter().flatten().map(|point| point.seen);
        let rays = points.filter_map(|[x, y]| camera.unproject(Pixel::new(x, y)));
        let radii = rays.map(|ray| libm::hypot(ray.x(), ray.y()));
        let max_radius = libm::fmin(radii.fold(0.1, libm::fmax), MAX_RADIUS);
        let starts =
            RIDGES.iter().filter_map(|ridge| brown_conrady_like(&camera, max_radius, *ridge));
        let mut found = starts.filter_map(|numbers| self.followed(numbers));
        let first = found.next()?;
        // A minimum that leaves numbers undetermined is one where the fraction's poles cancel, near the right one.
        if first.is_determined() {
            return Some(first);
        }
        found.find(Solved::is_determined).or(Some(first))
    }

    fn followed(&self, numbers: [f64; INTRINSICS]) -> Option<Solved> {
        let mut shared = Shared::zeros();
        for (value, number) in shared.iter_mut().zip(numbers) {
            *value = number;
        }
        let mut solved = self.posed(shared)?;
        solved.minimise(&Free::intrinsics(self.lens.parameters()), 15);
        Some(solved.settled())
    }

    /// The views' poses for a camera.
    fn posed(&self, shared: Shared) -> Option<Solved> {
        let Self { sheet, lens, size, solve_bend } = *self;
        let scale_px = ROUGH_SHARE * f64::from(size.width.max(size.height));
        let bend_m = BEND_SHARE * libm::fmax(sheet.half_m[0], sheet.half_m[1]);
        let whole = Bundle { lens, size, views: &sheet.views, scale_px, bend_m };
        let (used, poses): (Vec<usize>, Vec<_>) = poses(&whole, &shared)
            .into_iter()
            .enumerate()
            .filter_map(|(i, pose)| Some((i, pose?)))
            .unzip();
        if used.len() < MIN_VIEWS {
            return None;
        }
        let views = used.iter().map(|i| sheet.views[*i].clone()).collect();
        let intrinsics = Free::intrinsics(lens.parameters());
        let free = if solve_bend { intrinsics.with(BEND..SOLVED) } else { intrinsics };
        let place = Place { shared, poses };
        Some(Solved { lens, size, views, used, place, free, scale_px, bend_m, noise_px: 0.0 })
    }
}

impl Solved {
    /// The bundle that this is the minimum of.
    pub(crate) fn bundle(&self) -> Bundle<'_> {
        let Self { lens, size, scale_px, bend_m, .. } = *self;
        Bundle { lens, size, views: &self.views, scale_px, bend_m }
    }

    /// Steps with these numbers free.
    fn minimise(&mut self, free: &Free, max_steps: usize) {
        self.place = minimise(&self.bundle(), self.place.clone(), free, max_steps).place;
    }

    /// To the minimum of a loss that suits the noise here.
    fn settle(&mut self) {
        self.scale_px = ROBUST * self.measured_noise_px();
        let free = self.free;
        self.minimise(&free, 40);
        self.noise_px = self.measured_noise_px();
    }

    /// At the minimum of a loss that suits the noise there.
    fn settled(mut self) -> Self {
        for _ in 0..MAX_ROUNDS {
            self.settle();
            if (ROBUST * self.noise_px - self.scale_px).abs() < 0.02 * self.scale_px {
                break;
            }
        }
        self
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

    /// The information at the minimum.
    pub(crate) fn information(&self) -> Option<Information> {
        Information::new(&self.bundle(), &self.place)
    }

    fn is_determined(&self) -> bool {
        self.information().is_some_and(|information| information.certainty(&self.free).is_some())
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
