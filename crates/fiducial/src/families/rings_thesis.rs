//! Implements the thesis' detector of the three-ring marker exactly (section 3.1, Algorithms 1 to 15): bilateral
//! filter, threshold, contours, valid ellipses, rings of equal orientation.
//!
//! Kept as a baseline. Its weakness is [`two_have_equal_orientation`]: seen head-on the ellipses are circles,
//! whose orientation is noise. Choices that the thesis leaves open are documented where they are made.

use std::f64::consts::PI;

use geometry::{Camera, CameraModel, Marker as MarkerFrame, Pixel, Point, Rotation, Transform};
use imaging::{
    BilateralRows, Contours, Ellipse, GrayImage, GrayView, Limits, bilateral_5x5, contour_area,
    fit_ellipse, threshold,
};
use markers::{Family, Marker, RingKind};
use nalgebra::{Matrix2, Matrix3, Matrix6};

use crate::candidates::evidence::Needs;
use crate::candidates::ring::Ring;
use crate::families::family::{FamilyDetector, FrameInput, Output};
use crate::families::rings::circle_pose::UNKNOWN_ANGLE_VARIANCE;
use crate::observation::{MarkerPose, Observation, StageObserver};
use crate::schedule::FallbackStep;
use crate::settings::Settings;
use crate::trace::{Reason, Trace};

/// Relative area tolerance of Algorithm 1.
pub const T_AREA: f64 = 0.05;
/// Maximum distance between concentric ellipses' centres, in pixels (Algorithm 2).
pub const T_CONCENTRIC_PX: f64 = 10.0;
/// Maximum difference of eccentricities (Algorithm 3).
pub const T_ECCENTRICITY: f64 = 0.2;
/// Maximum difference of orientations, in radians: 20 degrees (Algorithm 4).
pub const T_ORIENTATION: f64 = 20.0 * PI / 180.0;
/// Tolerance of the ratio of axes (Algorithm 5).
pub const T_TYPE: f64 = 0.1;
/// Minimum fraction of black pixels in a ring (Algorithm 6).
pub const T_BLACK: f64 = 0.8;

/// Bounds on the time for any image, which the thesis does not have; far above the needs of its frames.
const MAX_CONTOUR_POINTS: usize = 4_000_000;
const MAX_ELLIPSES: usize = 20_000;
const MAX_PAIRS: usize = 50_000;
const MAX_RINGS: usize = 60;

/// A valid ellipse (Algorithm 1) and the index of its contour.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct ContourEllipse {
    /// The ellipse fitted to the contour.
    pub ellipse: Ellipse,
    /// The contour's index (c in the thesis).
    pub contour: usize,
}

/// Detects the three-ring marker by the thesis' algorithms. Its buffers are reused from image to image.
#[derive(Debug)]
pub(crate) struct RingsThesis {
    marker: Marker,
    /// T of Equation 3.3, in grey levels.
    threshold: u8,
    rows: BilateralRows,
    filtered: GrayImage,
    binary: GrayImage,
    contours: Contours,
    ellipses: Vec<ContourEllipse>,
    pairs: Vec<(usize, usize)>,
    by_x: Vec<usize>,
    rings: Vec<Ring>,
}

impl FamilyDetector for RingsThesis {
    fn needs(&self) -> Needs {
        Needs::default()
    }

    fn fallback_steps(&self) -> &'static [FallbackStep] {
        &[]
    }

    fn searches_without_shadow(&self) -> bool {
        false
    }

    fn detect(&mut self, input: FrameInput<'_>, out: &mut Output<'_>) {
        self.detect_in(input.view, input.camera, out);
    }
}

impl RingsThesis {
    /// Detects this marker.
    pub(crate) fn new(marker: Marker, settings: Settings) -> Self {
        Self {
            marker,
            threshold: settings.thesis_threshold,
            rows: BilateralRows::default(),
            filtered: GrayImage::default(),
            binary: GrayImage::default(),
            contours: Contours::default(),
            ellipses: Vec::new(),
            pairs: Vec::new(),
            by_x: Vec::new(),
            rings: Vec::new(),
        }
    }

    fn detect_in(
        &mut self,
        view: GrayView<'_>,
        camera: Option<&CameraModel>,
        out: &mut Output<'_>,
    ) {
        self.find_ellipses(view, self.threshold, out.stages);
        out.trace.ellipses.extend(self.ellipses.iter().map(|e| e.ellipse));
        self.detect_rings(view, out.trace);
        out.trace.rings.extend(&self.rings);
        out.stages.ended("rings");
        let found = match_rings(&self.rings);
        out.found.extend(found.map(|rings| observe(&rings, &self.marker, camera)));
        out.stages.ended("matching");
    }

    /// Pre-processing and Algorithm 1.
    fn find_ellipses(&mut self, view: GrayView<'_>, level: u8, stages: &mut dyn StageObserver) {
        bilateral_5x5(view, &mut self.rows, &mut self.filtered);
        stages.ended("filter");
        if let Some(filtered) = self.filtered.view() {
            threshold(filtered, level, &mut self.binary);
        }
        stages.ended("threshold");
        if let Some(binary) = self.binary.view() {
            let limits = Limits { min_points: 5, max_points: MAX_CONTOUR_POINTS };
            self.contours.find(binary, limits);
        }
        stages.ended("contours");
        ellipse_filter(&self.contours, &mut self.ellipses);
        stages.ended("ellipses");
    }

    /// Algorithm 7: the rings among all pairs of ellipses.
    fn detect_rings(&mut self, view: GrayView<'_>, trace: &mut Trace) {
        self.rings.clear();
        self.concentric_pairs();
        let black = black_threshold(view);
        for (i, j) in &self.pairs {
            let (first, second) = (self.ellipses[*i], self.ellipses[*j]);
            match ring_of(view, black, &self.contours, first, second) {
                Ok(ring) => self.rings.push(ring),
                Err(reason) => trace.refuse(first.ellipse, second.ellipse, reason),
            }
            if self.rings.len() >= MAX_RINGS {
                break;
            }
        }
    }

    /// The pairs that pass Algorithm 2, in the order of all combinations; sorting by x avoids testing all of
    /// them.
    fn concentric_pairs(&mut self) {
        self.pairs.clear();
        self.by_x.clear();
        self.by_x.extend(0..self.ellipses.len());
        let x = |index: &usize| self.ellipses[*index].ellipse.centre[0];
        self.by_x.sort_unstable_by(|i, j| x(i).total_cmp(&x(j)));
        for (place, i) in self.by_x.iter().enumerate() {
            let near = self.by_x[place + 1..].iter().take_while(|j| x(j) - x(i) <= T_CONCENTRIC_PX);
            for j in near {
                let (a, b) = (self.ellipses[*i].ellipse, self.ellipses[*j].ellipse);
                if two_are_concentric(a.centre, b.centre) && self.pairs.len() < MAX_PAIRS {
                    self.pairs.push((*i.min(j), *i.max(j)));
                }
            }
        }
        self.pairs.sort_unstable();
    }
}

/// Algorithm 1: the contours that are ellipses. Its last condition tests the ellipse's area against the
/// ellipse's own limits, an obvious slip; its text means the contour's area, as here.
pub fn ellipse_filter(contours: &Contours, valid: &mut Vec<ContourEllipse>) {
    valid.clear();
    // The order of OpenCV: the first marker found is the result.
    for index in (0..contours.len()).rev() {
        let Some(contour) = contours.get(index).filter(|c| c.points.len() > 4) else {
            continue;
        };
        let points = contour.points.iter().map(|p| p.map(f64::from));
        let Some(ellipse) = fit_ellipse(points) else {
            continue;
        };
        let (min, max) = (ellipse.area() * (1.0 - T_AREA), ellipse.area() * (1.0 + T_AREA));
        if (min..=max).contains(&contour_area(contour.points)) {
            valid.push(ContourEllipse { ellipse, contour: index });
        }
        if valid.len() >= MAX_ELLIPSES {
            return;
        }
    }
}

/// Algorithm 2: whether two centres are within [`T_CONCENTRIC_PX`].
pub fn two_are_concentric(centre_1: [f64; 2], centre_2: [f64; 2]) -> bool {
    (centre_1[0] - centre_2[0]).hypot(centre_1[1] - centre_2[1]) <= T_CONCENTRIC_PX
}

/// Algorithm 3: whether two ellipses have similar eccentricities.
pub fn eccentricity_is_equal(first: &Ellipse, second: &Ellipse) -> bool {
    (first.eccentricity() - second.eccentricity()).abs() <= T_ECCENTRICITY
}

/// Equation 3.9 by `atan2`: the difference of two angles, from -pi to pi. An ellipse's angle is the same
/// after half a turn; the thesis assumes a result within a quarter turn, which `atan2` does not ensure.
pub fn orientation_difference(angle_1: f64, angle_2: f64) -> f64 {
    let difference = angle_1 - angle_2;
    difference.sin().atan2(difference.cos())
}

/// Algorithm 4: whether two ellipses have the same orientation.
pub fn two_have_equal_orientation(angle_1: f64, angle_2: f64) -> bool {
    orientation_difference(angle_1, angle_2).abs() <= T_ORIENTATION
}

/// Algorithm 5: the kind of ring whose ratio of radii matches both the minor and the major axes.
pub fn ring_type(first: &Ellipse, second: &Ellipse) -> Option<RingKind> {
    let ratio = |a: f64, b: f64| a.min(b) / a.max(b);
    let ratio_minor = ratio(first.minor, second.minor);
    let ratio_major = ratio(first.major, second.major);
    RingKind::ALL.into_iter().find(|kind| {
        (ratio_minor - kind.ratio()).abs() < T_TYPE && (ratio_major - kind.ratio()).abs() < T_TYPE
    })
}

/// Equation 3.12: the grey value 30 % of the way from the image's darkest pixel to its brightest.
pub fn black_threshold(view: GrayView<'_>) -> f64 {
    let (mut min, mut max) = (255, 0);
    for y in 0..view.height() {
        for pixel in view.row(y) {
            min = min.min(*pixel);
            max = max.max(*pixel);
        }
    }
    0.3 * (f64::from(max) - f64::from(min)) + f64::from(min)
}

/// Algorithm 6: whether more than [`T_BLACK`] of the ring's pixels are darker than `black`: those inside the
/// outer contour but not the inner one, in the unfiltered image.
pub fn is_black(view: GrayView<'_>, black: f64, outer: &[[i32; 2]], inner: &[[i32; 2]]) -> bool {
    let (outer, inner) = (Extents::from_contour(outer), Extents::from_contour(inner));
    let (mut points, mut black_points) = (0_u64, 0_u64);
    for (y, from, to) in outer.rows() {
        let Some(row) = usize::try_from(y).ok().filter(|y| *y < view.height()).map(|y| view.row(y))
        else {
            continue;
        };
        let (hole_from, hole_to) = inner.row(y).unwrap_or((to + 1, to));
        for span in [from..hole_from.min(to + 1), (hole_to + 1).max(from)..to + 1] {
            let (Ok(start), Ok(end)) = (usize::try_from(span.start), usize::try_from(span.end))
            else {
                continue;
            };
            let Some(pixels) = row.get(start..end.max(start)) else {
                continue;
            };
            points += pixels.len() as u64;
            black_points += pixels.iter().filter(|p| f64::from(**p) < black).count() as u64;
        }
    }
    points > 0 && black_points as f64 / points as f64 > T_BLACK
}

/// First and last column of a contour in each row: its interior, as a contour that passed Algorithm 1 is
/// nearly an ellipse.
struct Extents {
    top: i32,
    columns: Vec<(i32, i32)>,
}

impl Extents {
    fn from_contour(points: &[[i32; 2]]) -> Self {
        let top = points.iter().map(|p| p[1]).min().unwrap_or(0);
        let bottom = points.iter().map(|p| p[1]).max().unwrap_or(-1);
        let mut columns =
            vec![(i32::MAX, i32::MIN); usize::try_from(bottom - top + 1).unwrap_or(0)];
        let mut include = |x: i32, y: i32| {
            let row = usize::try_from(y - top).ok().and_then(|row| columns.get_mut(row));
            if let Some((from, to)) = row {
                (*from, *to) = ((*from).min(x), (*to).max(x));
            }
        };
        for (point, next) in points.iter().zip(points.iter().cycle().skip(1)) {
            // A run is horizontal, vertical or diagonal.
            let (dx, dy) = ((next[0] - point[0]).signum(), (next[1] - point[1]).signum());
            let steps = (next[0] - point[0]).abs().max((next[1] - point[1]).abs());
            for step in 0..=steps {
                include(point[0] + dx * step, point[1] + dy * step);
            }
        }
        Self { top, columns }
    }

    fn rows(&self) -> impl Iterator<Item = (i32, i32, i32)> {
        (self.top..).zip(&self.columns).map(|(y, (from, to))| (y, *from, *to))
    }

    fn row(&self, y: i32) -> Option<(i32, i32)> {
        self.columns.get(usize::try_from(y - self.top).ok()?).copied()
    }
}

/// The checks of Algorithm 7 on one pair of concentric ellipses.
fn ring_of(
    view: GrayView<'_>,
    black: f64,
    contours: &Contours,
    first: ContourEllipse,
    second: ContourEllipse,
) -> Result<Ring, Reason> {
    if !eccentricity_is_equal(&first.ellipse, &second.ellipse) {
        return Err(Reason::Eccentricity);
    }
    if !two_have_equal_orientation(first.ellipse.angle, second.ellipse.angle) {
        return Err(Reason::Orientation);
    }
    let kind = ring_type(&first.ellipse, &second.ellipse).ok_or(Reason::Type)?;
    let (inner, outer) =
        if first.ellipse.major < second.ellipse.major { (first, second) } else { (second, first) };
    let (Some(inner_contour), Some(outer_contour)) =
        (contours.get(inner.contour), contours.get(outer.contour))
    else {
        return Err(Reason::Blackness);
    };
    if !is_black(view, black, outer_contour.points, inner_contour.points) {
        return Err(Reason::Blackness);
    }
    Ok(Ring::new(kind, inner.ellipse, outer.ellipse))
}

/// Algorithm 8: whether all of three centres are within [`T_CONCENTRIC_PX`] of each other.
pub fn three_are_concentric(centres: [Pixel; 3]) -> bool {
    let [c1, c2, c3] = centres;
    let (d12, d13, d23) = (c1.distance(&c2), c1.distance(&c3), c2.distance(&c3));
    d12.max(d13).max(d23) <= T_CONCENTRIC_PX
}

/// Algorithm 9: whether three rings have the same orientation. Unlike Algorithm 4 it does not take absolute
/// values.
pub fn three_have_equal_orientation(angles: [f64; 3]) -> bool {
    let [a1, a2, a3] = angles;
    let differences = [(a1, a2), (a1, a3), (a2, a3)].map(|(a, b)| orientation_difference(a, b));
    differences.into_iter().fold(f64::NEG_INFINITY, f64::max) <= T_ORIENTATION
}

/// Algorithm 10: whether three rings are of different kinds.
pub fn three_are_of_different_types(kinds: [RingKind; 3]) -> bool {
    let [k1, k2, k3] = kinds;
    k1 != k2 && k1 != k3 && k2 != k3
}

/// The rings of the marker; the mean of their centres is c_m.
pub type Matched = Vec<Ring>;

/// Algorithm 11: one ring is the marker.
pub fn centre_one_ring(ring: &Ring) -> Option<Matched> {
    Some(vec![*ring])
}

/// Algorithm 12: two rings are the marker when their kinds differ, they are concentric and equally oriented,
/// and (according to the text) they are not the inner and the outer one.
pub fn centre_two_rings(rings: [&Ring; 2]) -> Option<Matched> {
    let [first, second] = rings;
    let valid = first.kind != second.kind
        && (first.kind == RingKind::Middle || second.kind == RingKind::Middle)
        && first.centre.distance(&second.centre) <= T_CONCENTRIC_PX
        && two_have_equal_orientation(first.angle, second.angle);
    valid.then(|| vec![*first, *second])
}

/// Algorithm 13: three rings are the marker when they are of three kinds, concentric and equally oriented.
pub fn centre_three_rings(rings: [&Ring; 3]) -> Option<Matched> {
    let valid = three_are_of_different_types(rings.map(|r| r.kind))
        && three_are_concentric(rings.map(|r| r.centre))
        && three_have_equal_orientation(rings.map(|r| r.angle));
    valid.then(|| rings.map(|r| *r).to_vec())
}

/// Algorithm 14: of four or more rings, the first pair that is a marker, else the first three that are.
pub fn centre_four_or_more_rings(rings: &[Ring]) -> Option<Matched> {
    let pairs =
        rings.iter().enumerate().flat_map(|(i, a)| rings[i + 1..].iter().map(move |b| [a, b]));
    let triples = rings.iter().enumerate().flat_map(|(i, a)| {
        let rest = &rings[i + 1..];
        rest.iter().enumerate().flat_map(move |(j, b)| rest[j + 1..].iter().map(move |c| [a, b, c]))
    });
    pairs
        .into_iter()
        .find_map(centre_two_rings)
        .or_else(|| triples.into_iter().find_map(centre_three_rings))
}

/// Algorithm 15: the marker among the rings of an image.
pub fn match_rings(rings: &[Ring]) -> Option<Matched> {
    match rings {
        [] => None,
        [one] => centre_one_ring(one),
        [a, b] => centre_two_rings([a, b]),
        [a, b, c] => centre_three_rings([a, b, c]),
        more => centre_four_or_more_rings(more),
    }
}

/// The marker with the thesis' centre, the mean of the rings' centres, and a pose from its size alone.
fn observe(rings: &[Ring], marker: &Marker, camera: Option<&CameraModel>) -> Observation {
    let count = rings.len() as f64;
    let mean = |of: fn(&Ring) -> f64| rings.iter().map(of).sum::<f64>() / count;
    let centre = Pixel::new(mean(|r| r.centre.x), mean(|r| r.centre.y));
    // The largest ring gives the most accurate size.
    let size_px = rings
        .iter()
        .max_by(|a, b| a.outer.major.total_cmp(&b.outer.major))
        .map_or(0.0, Ring::marker_size_px);
    let pose = marker.size_m.zip(camera).map(|(size_m, camera)| MarkerPose {
        camera_from_marker: facing(centre, size_m / size_px, camera),
        reprojection_rms_px: rms_px(rings, size_px),
        covariance: facing_covariance(centre, size_m, size_px, camera),
        alternative: None,
    });
    let centre_error_px = CENTRE_ERROR_PX + CENTRE_ERROR_RATIO * size_px;
    let confidence = count / RingKind::ALL.len() as f64;
    Observation {
        family: Family::RingsThesis,
        id: None,
        centre,
        centre_covariance_px2: Matrix2::identity() * (centre_error_px * centre_error_px),
        corners: None,
        wrong_bits: 0,
        size_px,
        confidence,
        pose,
        response: None,
    }
}

/// Standard deviation of the centre in pixels, and the part from the perspective of tilted rings, as a fraction
/// of their size. The thesis' method estimates neither; these are upper bounds of the errors measured in
/// renderings.
const CENTRE_ERROR_PX: f64 = 0.1;
const CENTRE_ERROR_RATIO: f64 = 0.02;
/// Standard deviation of the range, relative.
const RANGE_ERROR_RATIO: f64 = 0.03;
/// Standard deviation of the tilt, in radians, as every marker is assumed to face the camera.
const TILT_ERROR: f64 = 0.35;

/// Covariance of [`facing`]: translation (m), then rotation vector (rad), in the camera frame.
fn facing_covariance(
    centre: Pixel,
    size_m: f64,
    size_px: f64,
    camera: &CameraModel,
) -> Matrix6<f64> {
    let metres_per_px = size_m / size_px;
    let range_m = (camera.fx + camera.fy) / 2.0 * metres_per_px;
    let ray = camera.unproject_clamped(centre).coords;
    let lateral_m = CENTRE_ERROR_PX * metres_per_px + CENTRE_ERROR_RATIO * size_m;
    let along = ray * ray.transpose() * (range_m * RANGE_ERROR_RATIO).powi(2);
    let sight = ray.normalize();
    let turn = sight * sight.transpose() * (UNKNOWN_ANGLE_VARIANCE - TILT_ERROR * TILT_ERROR);
    let mut covariance = Matrix6::zeros();
    let place = along + Matrix3::identity() * (lateral_m * lateral_m);
    covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&place);
    let turned = turn + Matrix3::identity() * (TILT_ERROR * TILT_ERROR);
    covariance.fixed_view_mut::<3, 3>(3, 3).copy_from(&turned);
    covariance
}

/// A marker that faces the camera, at the range at which a pixel covers `metres_per_px`.
fn facing(
    centre: Pixel,
    metres_per_px: f64,
    camera: &CameraModel,
) -> Transform<Camera, MarkerFrame> {
    let range_m = (camera.fx + camera.fy) / 2.0 * metres_per_px;
    let ray = camera.unproject_clamped(centre) * range_m;
    let rotation = Rotation::from_euler(PI, 0.0, 0.0);
    Transform::new(rotation, Point::new(ray.x(), ray.y(), ray.z()))
}

/// Root mean square distance of the rings' radii from those that follow from the size, in pixels.
fn rms_px(rings: &[Ring], size_px: f64) -> f64 {
    let squares = rings.iter().flat_map(|ring| {
        let (inner, outer) = ring.kind.radii();
        [ring.inner.major / 2.0 - inner * size_px, ring.outer.major / 2.0 - outer * size_px]
    });
    (squares.map(|e| e * e).sum::<f64>() / (2 * rings.len()) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ellipse(x: f64, minor: f64, major: f64, degrees: f64) -> Ellipse {
        Ellipse { centre: [x, 50.0], minor, major, angle: degrees.to_radians() }
    }

    fn ring(kind: RingKind, x: f64, degrees: f64) -> Ring {
        let outer = ellipse(x, 40.0, 50.0, degrees);
        let ratio = kind.ratio();
        Ring::new(kind, Ellipse { minor: 40.0 * ratio, major: 50.0 * ratio, ..outer }, outer)
    }

    #[test]
    fn tolerances_match_the_thesis() {
        assert!(two_are_concentric([0.0, 0.0], [6.0, 8.0]));
        assert!(!two_are_concentric([0.0, 0.0], [6.0, 8.01]));
        assert!(eccentricity_is_equal(
            &ellipse(0.0, 10.0, 10.0, 0.0),
            &ellipse(0.0, 9.8, 10.0, 0.0)
        ));
        assert!(!eccentricity_is_equal(
            &ellipse(0.0, 10.0, 10.0, 0.0),
            &ellipse(0.0, 9.7, 10.0, 0.0)
        ));
        assert!(two_have_equal_orientation(0.0, 19.9_f64.to_radians()));
        assert!(!two_have_equal_orientation(0.0, 20.1_f64.to_radians()));
        // The same direction, as 1 and 179 degrees: refused, to the letter.
        assert!(!two_have_equal_orientation(1_f64.to_radians(), 179_f64.to_radians()));
    }

    #[test]
    fn ratios_name_the_ring() {
        let kind = |ratio: f64| {
            ring_type(
                &ellipse(0.0, 40.0, 50.0, 0.0),
                &ellipse(0.0, 40.0 * ratio, 50.0 * ratio, 0.0),
            )
        };
        assert_eq!(kind(0.8), Some(RingKind::Outer));
        assert_eq!(kind(0.6), Some(RingKind::Middle));
        assert_eq!(kind(0.34), Some(RingKind::Inner));
        assert_eq!((kind(0.95), kind(0.47), kind(0.2)), (None, None, None));
    }

    #[test]
    fn rings_are_matched_by_number() {
        use RingKind::{Inner, Middle, Outer};
        let count = |rings: &[Ring]| match_rings(rings).map(|found| found.len());
        assert_eq!(count(&[]), None);
        assert_eq!(count(&[ring(Inner, 0.0, 0.0)]), Some(1));
        assert_eq!(count(&[ring(Middle, 0.0, 0.0), ring(Outer, 9.0, 10.0)]), Some(2));
        assert_eq!(count(&[ring(Inner, 0.0, 0.0), ring(Outer, 0.0, 0.0)]), None);
        assert_eq!(count(&[ring(Middle, 0.0, 0.0), ring(Middle, 0.0, 0.0)]), None);
        let all = [ring(Middle, 0.0, 0.0), ring(Outer, 0.0, 0.0), ring(Inner, 0.0, 0.0)];
        assert_eq!(count(&all), Some(3));
        let turned = [ring(Middle, 0.0, 0.0), ring(Outer, 0.0, 150.0), ring(Inner, 0.0, 0.0)];
        assert_eq!(count(&turned), None);
        let with_a_stray = [ring(Outer, 500.0, 0.0), all[0], all[1], all[2]];
        assert_eq!(count(&with_a_stray), Some(2));
    }

    #[test]
    fn black_pixels_are_counted_between_the_contours() {
        // Black columns 2..8 of 10, white inside 4..6.
        let data: Vec<u8> = (0..100)
            .map(|i| {
                let (x, y) = (i % 10, i / 10);
                let within = |a: usize, b: usize| (a..b).contains(&x) && (a..b).contains(&y);
                if within(2, 8) && !within(4, 6) { 0 } else { 255 }
            })
            .collect();
        let view = GrayView::packed(&data, 10, 10).unwrap();
        let square = |a: i32, b: i32| [[a, a], [a, b], [b, b], [b, a]];
        assert!((black_threshold(view) - 76.5).abs() < 1e-9);
        assert!(is_black(view, 76.5, &square(2, 7), &square(4, 5)));
        // With the white rim of 28 pixels, 32 of 60 are black.
        assert!(!is_black(view, 76.5, &square(1, 8), &square(4, 5)));
        assert!(!is_black(view, 76.5, &[], &[]));
        assert!(!is_black(view, 76.5, &square(100, 200), &square(120, 130)));
    }
}
