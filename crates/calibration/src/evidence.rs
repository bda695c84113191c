//! Measures how a board was shown (tilt, distances, cells of the image covered) and the fit's residuals: by tag and position,
//! flaws of the print, structures beyond noise.

use geometry::CameraModel;
use libm::{acos, fmax, fmin, hypot};
use nalgebra::{Isometry3, SMatrix, SVector};

use crate::board::{BoardPoint, FLAWS};
use crate::covariance::Information;
use crate::stages::Solved;
use crate::view::ImageSize;

/// The evidence for and against a set of views.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Evidence {
    /// The board's tilt against the image, in radians: one view of ten exceeds it.
    pub tilt: f64,
    /// Distance of the farthest tenth of the views by that of the nearest.
    pub distance_ratio: f64,
    /// Where in the image points were seen.
    pub coverage: Coverage,
    /// How much larger the tags are than stated, against their spacing; `None` where the views do not show it.
    pub tag_scale: Option<Estimate>,
    /// How much wider and lower the board is than stated.
    pub stretch: Option<Estimate>,
    /// How far the board is from square, in radians.
    pub shear: Option<Estimate>,
    /// The common part of the residuals at the same position in the image, in pixels (root mean square).
    pub lens_structure_px: f64,
    /// The further common part of the residuals within single views, in pixels.
    pub view_structure_px: f64,
}

/// Where in the image points were seen.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Coverage {
    /// The fraction of the image's parts ([`Coverage::PARTS`]) in which there are any.
    pub covered: f64,
    /// The quarter of the image with fewest, as text.
    pub emptiest: &'static str,
}

/// A value and its standard deviation.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Estimate {
    /// The value.
    pub value: f64,
    /// Its standard deviation.
    pub sigma: f64,
}

/// Columns and rows of the parts of the image for the residuals that depend on the place.
const CELLS: [usize; 2] = [10, 8];
/// Number of tags below which a part of the image has no information about the lens, and a view none about motion.
const MIN_CELL_TAGS: usize = 4;
const MIN_VIEW_TAGS: usize = 12;

impl Evidence {
    pub(crate) fn new(solved: &Solved, information: &Information) -> Self {
        let mut tilts: Vec<f64> = solved.place.poses.iter().map(tilt).collect();
        let mut distances: Vec<f64> =
            solved.place.poses.iter().map(|pose| pose.translation.vector.norm()).collect();
        let [lens_structure_px, view_structure_px] = structures(solved);
        let [tag_scale, stretch, shear] = flaws(solved, information);
        Self {
            tilt: percentile(&mut tilts, 90),
            distance_ratio: percentile(&mut distances, 90) / percentile(&mut distances, 10),
            coverage: Coverage::new(&solved.views, solved.size),
            tag_scale,
            stretch,
            shear,
            lens_structure_px,
            view_structure_px,
        }
    }
}

/// The angle between the board's normal and the camera's axis.
fn tilt(pose: &Isometry3<f64>) -> f64 {
    let normal = pose.rotation * nalgebra::Vector3::z();
    acos(fmin(normal.z.abs(), 1.0))
}

fn percentile(values: &mut [f64], percent: usize) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = (values.len() * percent).div_ceil(100).saturating_sub(1);
    values.get(at).copied().unwrap_or(0.0)
}

/// The part of the image, of so many columns and rows, where a point is.
fn cell(seen: [f64; 2], size: ImageSize, parts: [usize; 2]) -> usize {
    let [width, height] = [size.width, size.height].map(f64::from);
    let part = |at: f64, length: f64, parts: usize| {
        // The cast converts negative values to zero.
        (((at + 0.5) / length * parts as f64) as usize).min(parts - 1)
    };
    part(seen[1], height, parts[1]) * parts[0] + part(seen[0], width, parts[0])
}

impl Coverage {
    /// Columns and rows of the parts of the image of which those with points are counted.
    pub const PARTS: [usize; 2] = [8, 6];

    pub(crate) fn new(views: &[Vec<BoardPoint>], size: ImageSize) -> Self {
        const QUARTERS: [&str; 4] =
            ["at the upper left", "at the upper right", "at the lower left", "at the lower right"];
        let mut is_seen = [false; Self::PARTS[0] * Self::PARTS[1]];
        let mut quarters = [0_usize; 4];
        for point in views.iter().flatten() {
            if let Some(seen) = is_seen.get_mut(cell(point.seen, size, Self::PARTS)) {
                *seen = true;
            }
            if let Some(quarter) = quarters.get_mut(cell(point.seen, size, [2, 2])) {
                *quarter += 1;
            }
        }
        let fewest = quarters.into_iter().zip(QUARTERS).min_by_key(|(count, _)| *count);
        Self {
            covered: is_seen.iter().filter(|seen| **seen).count() as f64 / is_seen.len() as f64,
            emptiest: fewest.map_or("anywhere", |(_, name)| name),
        }
    }
}

/// The print's flaws, each as if it were the only other unknown: one step from where they are zero.
fn flaws(solved: &Solved, information: &Information) -> [Option<Estimate>; 3] {
    [0, 1, 2].map(|flaw| {
        let at = FLAWS + flaw;
        let certainty = information.certainty(&solved.free.with(at..at + 1))?;
        let sigma = fmax(certainty.covariance[(at, at)], 0.0).sqrt();
        (sigma > 0.0).then_some(Estimate { value: certainty.step[at], sigma })
    })
}

/// The mean residual of a tag in a view.
struct TagResidual {
    view: usize,
    cell: usize,
    /// Where the tag is in its view, about the middle and in units of the view's extent.
    place: [f64; 2],
    residual_px: [f64; 2],
}

/// The common part of residuals by position in the image, and the further one within views; both as root mean square over
/// all tags, less the part of random errors.
fn structures(solved: &Solved) -> [f64; 2] {
    let mut tags = tag_residuals(solved);
    let lens = by_cell(&mut tags);
    [lens, within_views(&tags)]
}

fn tag_residuals(solved: &Solved) -> Vec<TagResidual> {
    let bundle = solved.bundle();
    let camera = bundle.camera(&solved.place.shared);
    let mut tags = Vec::new();
    for (view, (points, pose)) in solved.views.iter().zip(&solved.place.poses).enumerate() {
        let residual = |point: &BoardPoint| residual(point, &camera, solved, pose);
        for tag in points.chunk_by(|a, b| a.tag == b.tag) {
            let mean = |of: &dyn Fn(&BoardPoint) -> [f64; 2]| {
                let sum = tag.iter().map(of).fold([0.0; 2], |s, v| [s[0] + v[0], s[1] + v[1]]);
                sum.map(|sum| sum / tag.len() as f64)
            };
            let seen = mean(&|point| point.seen);
            tags.push(TagResidual {
                view,
                cell: cell(seen, solved.size, CELLS),
                place: mean(&|point| point.share()),
                residual_px: mean(&residual),
            });
        }
    }
    tags
}

/// A point's residual, shortened to the scale of the loss: outliers are not structure.
fn residual(
    point: &BoardPoint,
    camera: &CameraModel,
    solved: &Solved,
    pose: &Isometry3<f64>,
) -> [f64; 2] {
    let Some([x, y]) = point.residual(camera, &solved.place.shared, pose) else { return [0.0; 2] };
    let shorter = fmin(1.0, solved.scale_px / fmax(hypot(x, y), 1e-12));
    [x * shorter, y * shorter]
}

/// The common part by place, which is taken from the residuals.
fn by_cell(tags: &mut [TagResidual]) -> f64 {
    let mut cells = vec![Cell::default(); CELLS[0] * CELLS[1]];
    for tag in &*tags {
        if let Some(cell) = cells.get_mut(tag.cell) {
            cell.add(tag.residual_px);
        }
    }
    cells.iter_mut().for_each(Cell::close);
    let used = || cells.iter().filter(|cell| cell.tags >= MIN_CELL_TAGS);
    let count: f64 = used().map(|cell| cell.tags as f64).sum();
    let between: f64 = used().map(|cell| cell.tags as f64 * cell.mean_square()).sum();
    let within: f64 = used().map(|cell| cell.scatter).sum();
    let variance = within / fmax(count - used().count() as f64, 1.0);
    let chance = variance * used().count() as f64;
    for tag in tags {
        if let Some(cell) = cells.get(tag.cell).filter(|cell| cell.tags >= MIN_CELL_TAGS) {
            tag.residual_px = [0, 1].map(|axis| tag.residual_px[axis] - cell.mean[axis]);
        }
    }
    (fmax(between - chance, 0.0) / fmax(count, 1.0)).sqrt()
}

/// The tags in a part of the image: first sums, closed the means.
#[derive(Copy, Clone, Default)]
struct Cell {
    tags: usize,
    mean: [f64; 2],
    /// Sum of the squared distances from the mean.
    scatter: f64,
}

impl Cell {
    fn add(&mut self, [x, y]: [f64; 2]) {
        self.tags += 1;
        self.mean = [self.mean[0] + x, self.mean[1] + y];
        self.scatter += x * x + y * y;
    }

    fn close(&mut self) {
        let count = fmax(self.tags as f64, 1.0);
        self.mean = self.mean.map(|sum| sum / count);
        self.scatter -= count * self.mean_square();
    }

    fn mean_square(&self) -> f64 {
        self.mean[0] * self.mean[0] + self.mean[1] * self.mean[1]
    }
}

/// The part of the residuals within views that a polynomial of the second degree over the board explains.
fn within_views(tags: &[TagResidual]) -> f64 {
    const TERMS: usize = 6;
    let (mut explained, mut left, mut freedom, mut terms, mut count) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for view in tags.chunk_by(|a, b| a.view == b.view).filter(|view| view.len() >= MIN_VIEW_TAGS) {
        let mut matrix = SMatrix::<f64, TERMS, TERMS>::identity() * 1e-9;
        let mut right = SMatrix::<f64, TERMS, 2>::zeros();
        let mut squares = 0.0;
        for tag in view {
            let [x, y] = tag.place;
            let row = SVector::<f64, TERMS>::from([1.0, x, y, x * x, x * y, y * y]);
            let residual = SVector::<f64, 2>::from(tag.residual_px);
            matrix += row * row.transpose();
            right += row * residual.transpose();
            squares += residual.norm_squared();
        }
        let Some(cholesky) = matrix.cholesky() else { continue };
        let part = cholesky.solve(&right).dot(&right);
        explained += part;
        left += squares - part;
        freedom += (view.len() - TERMS) as f64;
        terms += TERMS as f64;
        count += view.len() as f64;
    }
    let chance = left / fmax(freedom, 1.0) * terms;
    (fmax(explained - chance, 0.0) / fmax(count, 1.0)).sqrt()
}
