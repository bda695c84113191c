//! The pose of a small marker from the grey values themselves.
//!
//! Where rings are a few pixels wide, the blur of one edge reaches the next, and edges located one by one lie too far
//! apart. Here the pose, the blur and the light are fitted together, so that the picture they predict comes
//! closest to the picture there is; nothing in the image says more about the pose than that.

use geometry::{CameraModel, Pixel};
use imaging::GrayView;
use nalgebra::{SMatrix, SVector, Vector3};

use crate::circles::{Circles, project};
use crate::ring::RingKind;

/// Markers of more pixels across have edges far enough apart.
pub(crate) const MOST_DIAMETER_PX: f64 = 64.0;
const MOST_STEPS: usize = 12;
/// Pose (5), blur, black, white, and white's change across and down.
const UNKNOWNS: usize = 10;

/// Everything that is fitted.
#[derive(Copy, Clone, Debug)]
struct Picture {
    circles: Circles,
    /// Standard deviation of the blur in pixels: the lens', and the pixels' own extent.
    blur_px: f64,
    black: f64,
    white: f64,
    /// Change of white per pixel to the right and down.
    slope: [f64; 2],
}

/// A pixel that takes part.
#[derive(Copy, Clone, Debug)]
pub(crate) struct Spot {
    ray: Vector3<f64>,
    /// Offset from the marker's centre, in pixels.
    offset: [f64; 2],
    grey: f64,
}

/// The pose at which a marker of this size looks most like the image, from a pose that is nearly right, and the
/// root mean square of the differences left, in units of the marker's contrast. `spots` is working memory.
pub(crate) fn refined(
    view: GrayView<'_>,
    camera: &CameraModel,
    start: &Circles,
    size_m: f64,
    spots: &mut Vec<Spot>,
) -> Option<(Circles, f64)> {
    gather(view, camera, start, size_m, spots)?;
    let mut best =
        Picture { circles: *start, blur_px: 0.7, black: 0.0, white: 255.0, slope: [0.0; 2] };
    best.expose(spots, size_m, camera)?;
    // Differences beyond this pull no harder; about thrice what they are once the fit is good.
    let mut limit = 0.25 * (best.white - best.black);
    let (mut system, mut cost) = best.system(spots, size_m, camera, limit)?;
    let mut damping = 1e-3;
    for step in 0..MOST_STEPS {
        let candidate = best.stepped(&system, damping);
        match candidate.and_then(|c| Some((c, c.system(spots, size_m, camera, limit)?))) {
            Some((next, (next_system, next_cost))) if next_cost <= cost => {
                let settled = cost - next_cost < 1e-5 * cost;
                (best, system, cost) = (next, next_system, next_cost);
                damping = (damping * 0.1).max(1e-7);
                if step == 2 {
                    limit = limit.min(3.0 * (cost / spots.len() as f64).sqrt() + 1.0);
                    (system, cost) = best.system(spots, size_m, camera, limit)?;
                } else if settled && step > 2 {
                    break;
                }
            }
            _ => {
                damping *= 20.0;
                if damping > 1e4 {
                    break;
                }
            }
        }
    }
    let contrast = best.white - best.black;
    (contrast > 0.0).then(|| (best.circles, (cost / spots.len() as f64).sqrt() / contrast))
}

/// The pixels in and just around the marker, except about its innermost ring, which is a dot at this size.
fn gather(
    view: GrayView<'_>,
    camera: &CameraModel,
    circles: &Circles,
    size_m: f64,
    spots: &mut Vec<Spot>,
) -> Option<()> {
    spots.clear();
    let outline = circles.outline(size_m / 2.0, camera)?;
    let middle = project(circles.centre, camera)?;
    let diameter_px = outline.major;
    if !(4.0..=MOST_DIAMETER_PX).contains(&diameter_px) {
        return None;
    }
    // The paper is white for a ring's width around the marker; what the blur brings in from beyond is kept out.
    let reach = (0.6 - 1.3 / diameter_px).clamp(0.51, 0.55);
    let around = outline.grown(diameter_px * (2.0 * reach - 1.0));
    let dot = 0.09;
    let bound = |low: f64, high: f64, len: usize| {
        let from = low.floor().max(0.0) as usize;
        let to = (high.ceil() + 1.0).clamp(0.0, len as f64) as usize;
        from..to
    };
    let half = around.major / 2.0;
    for y in bound(outline.centre[1] - half, outline.centre[1] + half, view.height()) {
        let row = view.row(y);
        for x in bound(outline.centre[0] - half, outline.centre[0] + half, view.width()) {
            let place = [x as f64, y as f64];
            let offset = [place[0] - middle.x, place[1] - middle.y];
            if around.radius_of(place) > 1.0 || offset[0].hypot(offset[1]) < dot * diameter_px {
                continue;
            }
            let ray = camera.unproject(Pixel::new(place[0], place[1])).coords;
            spots.push(Spot { ray, offset, grey: f64::from(row[x]) });
        }
    }
    (spots.len() > 3 * UNKNOWNS).then_some(())
}

impl Picture {
    /// How white a pixel is, from 0 (black) to 1, and how that changes with the pose and with the blur.
    fn whiteness(
        &self,
        spot: &Spot,
        basis: &(Vector3<f64>, Vector3<f64>),
        size_m: f64,
        camera: &CameraModel,
    ) -> Option<(f64, SVector<f64, 5>, f64)> {
        let (rho, per_px, by_pose) = self.circles.radius_at(basis, &spot.ray, camera)?;
        let (mut white, mut by_distance, mut by_blur) = (1.0, 0.0, 0.0);
        for kind in [RingKind::Outer, RingKind::Middle] {
            let (inner, outer) = kind.radii();
            for (radius, sign) in [(inner, -1.0), (outer, 1.0)] {
                let radius = radius * size_m;
                // A blurred circle's edge appears further in, by the blur squared over the diameter.
                let bend_px = self.blur_px * self.blur_px * per_px / (2.0 * radius);
                let z = ((rho - radius) / per_px + bend_px) / self.blur_px;
                let (step, density) = blurred_step(z);
                white += sign * step;
                by_distance += sign * density / self.blur_px;
                by_blur -= sign * density * z / self.blur_px;
            }
        }
        let (hole, dot) = RingKind::Inner.radii();
        let dot_px2 = std::f64::consts::PI * (dot * dot - hole * hole) * (size_m / per_px).powi(2);
        let spread_px2 = self.blur_px * self.blur_px + (dot * size_m / per_px).powi(2) / 4.0;
        let distance_px2 = (rho / per_px).powi(2);
        white -= dot_px2 / (std::f64::consts::TAU * spread_px2)
            * (-distance_px2 / (2.0 * spread_px2)).exp();
        Some((white, by_pose * by_distance, by_blur))
    }

    /// Black and white that fit the image best with everything else as it is.
    fn expose(&mut self, spots: &[Spot], size_m: f64, camera: &CameraModel) -> Option<()> {
        let (mut n, mut sw, mut sww, mut sg, mut swg) = (0.0, 0.0, 0.0, 0.0, 0.0);
        let basis = self.circles.basis();
        for spot in spots {
            let (white, _, _) = self.whiteness(spot, &basis, size_m, camera)?;
            n += 1.0;
            sw += white;
            sww += white * white;
            sg += spot.grey;
            swg += white * spot.grey;
        }
        let contrast = (n * swg - sw * sg) / (n * sww - sw * sw);
        self.black = (sg - contrast * sw) / n;
        self.white = self.black + contrast;
        (contrast > 1.0).then_some(())
    }

    /// The normal equations of one step, and the cost here.
    fn system(
        &self,
        spots: &[Spot],
        size_m: f64,
        camera: &CameraModel,
        limit: f64,
    ) -> Option<(System, f64)> {
        let mut system = System { matrix: SMatrix::zeros(), right: SVector::zeros() };
        let mut cost = 0.0;
        let basis = self.circles.basis();
        for spot in spots {
            let (white, by_pose, by_blur) = self.whiteness(spot, &basis, size_m, camera)?;
            let [x, y] = spot.offset;
            let contrast = self.white + self.slope[0] * x + self.slope[1] * y - self.black;
            let difference = self.black + contrast * white - spot.grey;
            let size = difference.abs();
            let weight = if size > limit { limit / size } else { 1.0 };
            cost += if size > limit { limit * (2.0 * size - limit) } else { size * size };
            let mut slope = SVector::<f64, UNKNOWNS>::zeros();
            slope.fixed_rows_mut::<5>(0).copy_from(&(by_pose * contrast));
            slope[5] = contrast * by_blur;
            slope[6] = 1.0 - white;
            slope[7] = white;
            slope[8] = white * x;
            slope[9] = white * y;
            system.matrix.syger(weight, &slope, &slope, 1.0);
            system.right -= slope * (weight * difference);
        }
        system.matrix.fill_upper_triangle_with_lower_triangle();
        cost.is_finite().then_some((system, cost))
    }

    fn stepped(&self, system: &System, damping: f64) -> Option<Self> {
        let mut matrix = system.matrix;
        for i in 0..UNKNOWNS {
            matrix[(i, i)] += damping * system.matrix[(i, i)] + 1e-9;
        }
        let step = matrix.cholesky()?.solve(&system.right);
        Some(Self {
            circles: self.circles.moved(&step.fixed_rows::<5>(0).into_owned())?,
            blur_px: (self.blur_px + step[5].clamp(-0.3, 0.3)).clamp(0.25, 6.0),
            black: self.black + step[6],
            white: self.white + step[7],
            slope: [self.slope[0] + step[8], self.slope[1] + step[9]],
        })
    }
}

struct System {
    matrix: SMatrix<f64, UNKNOWNS, UNKNOWNS>,
    right: SVector<f64, UNKNOWNS>,
}

/// The normal distribution and its density at `z`: a step seen through a Gaussian blur.
fn blurred_step(z: f64) -> (f64, f64) {
    if z.abs() > 5.0 {
        return (if z > 0.0 { 1.0 } else { 0.0 }, 0.0);
    }
    let density = (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt();
    // Abramowitz and Stegun 26.2.17, good to 7.5e-8.
    let t = 1.0 / (1.0 + 0.231_641_9 * z.abs());
    let poly = t
        * (0.319_381_530
            + t * (-0.356_563_782
                + t * (1.781_477_937 + t * (-1.821_255_978 + t * 1.330_274_429))));
    let tail = density * poly;
    (if z > 0.0 { 1.0 - tail } else { tail }, density)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_normal_distribution() {
        for (z, expected) in
            [(0.0, 0.5), (1.0, 0.841_344_75), (-2.0, 0.022_750_13), (9.0, 1.0), (-9.0, 0.0)]
        {
            assert!((blurred_step(z).0 - expected).abs() < 1e-7, "{z}");
        }
    }

    /// A picture made by the model itself leads back to the pose it was made with.
    #[test]
    fn the_pose_comes_back_from_its_picture() {
        let camera = CameraModel::pinhole(100, 80, 909.0);
        let size_m = 0.15341;
        let truth = Circles {
            centre: Vector3::new(0.03, -0.05, 6.0),
            normal: Vector3::new(0.3, 0.2, -0.9).normalize(),
        };
        let picture =
            Picture { circles: truth, blur_px: 0.6, black: 30.0, white: 200.0, slope: [0.5, -0.3] };
        let middle = project(truth.centre, &camera).unwrap();
        let data: Vec<u8> = (0..8000)
            .map(|i| {
                let (x, y) = (f64::from(i % 100), f64::from(i / 100));
                let ray = camera.unproject(Pixel::new(x, y)).coords;
                let offset = [x - middle.x, y - middle.y];
                let (white, _, _) = picture
                    .whiteness(&Spot { ray, offset, grey: 0.0 }, &truth.basis(), size_m, &camera)
                    .unwrap();
                let paper = 200.0 + 0.5 * offset[0] - 0.3 * offset[1];
                (30.0 + (paper - 30.0) * white).round() as u8
            })
            .collect();
        let view = GrayView::packed(&data, 100, 80).unwrap();
        let start = Circles {
            centre: truth.centre * 1.01,
            normal: Vector3::new(0.1, 0.1, -0.9).normalize(),
        };
        let (found, rms) = refined(view, &camera, &start, size_m, &mut Vec::new()).unwrap();
        assert!(rms < 0.005, "{rms}");
        assert!((found.centre - truth.centre).norm() < 2e-4 * 6.0, "{found:?}");
        assert!(found.normal.angle(&truth.normal) < 0.02, "{found:?}");
    }
}
