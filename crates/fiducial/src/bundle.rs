//! A pad: several markers in known places about one landing point, seen as one thing.
//!
//! A pad is described in TOML, places in metres from the landing point on the printed face (x right, y up):
//!
//! ```toml
//! id = 0                  # the pad is called `pad:0` wherever a marker is named
//! tolerance_m = 0.0005    # how exactly the markers lie where they should, one standard deviation
//!
//! [[markers]]
//! marker = "apriltag-36h11:3:0.15"
//! x_m = -0.1
//! y_m = 0.0
//! quarter_turns = 0       # counter-clockwise, as seen by who reads the sheet
//! ```
//!
//! All markers in view are solved together: their corners are points of one plane, so that far markers give the tilt
//! that near ones cannot, and nothing changes when one of them leaves the view but the covariance. Rings look the same
//! however they are turned: beside others their centre is a point of the plane, alone they are a pad only in its middle.

use std::str::FromStr;

use geometry::{CameraModel, Marker as MarkerFrame, Pixel, Point, Rotation, Transform, Vector};
use nalgebra::{Matrix2, Matrix2x3, Matrix3, Matrix6, SMatrix, Vector2};
use serde::Deserialize;

use crate::drawing::{Drawing, Ink, Layer, Shape};
use crate::marker::Marker;
use crate::observation::{MarkerPose, Observation, PoseSolution};
use crate::pose::{PlanePoint, planar_pose};

/// Markers in known places about one landing point, the origin of the pad's frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Pad {
    id: u32,
    tolerance_m: f64,
    markers: Vec<PlacedMarker>,
}

/// A marker of a pad.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct PlacedMarker {
    /// The marker, with its id where its family has ids.
    pub marker: Marker,
    /// Its size in metres, as [`Marker::size_m`].
    pub size_m: f64,
    /// Its centre in the pad's frame, in metres.
    pub place_m: [f64; 2],
    /// How far it is turned counter-clockwise, in quarters of a turn, from 0 to 3.
    pub quarter_turns: u8,
}

/// A pad found in an image.
#[derive(Clone, Debug, PartialEq)]
pub struct PadObservation {
    /// Where the pad is; its frame's origin is the landing point.
    pub pose: MarkerPose,
    /// The projection of the landing point.
    pub centre: Pixel,
    /// Covariance of `centre`, in square pixels.
    pub centre_covariance_px2: Matrix2<f64>,
    /// The largest extent of a marker that was used, in pixels.
    pub size_px: f64,
    /// That of the surest marker that was used, from 0 to 1.
    pub confidence: f64,
    /// How many markers were used.
    pub used: usize,
    /// How many markers of the pad were seen where they cannot be, and left out.
    pub left_out: usize,
}

/// Why a pad's description was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PadError {
    /// Neither a pad that comes with the program nor a file that can be read.
    #[error(
        "pad `{name}`: {problem}; it is neither a file nor a pad that comes with the program: {known}"
    )]
    Unreadable {
        /// The name.
        name: String,
        /// Why it cannot be read.
        problem: String,
        /// The pads that come with the program.
        known: String,
    },
    /// A file with a wrong description.
    #[error("pad `{name}`: {problem}")]
    Described {
        /// The file's name.
        name: String,
        /// What is wrong.
        problem: Box<PadError>,
    },
    /// It is not the TOML it should be.
    #[error("{0}")]
    Toml(String),
    /// A number outside its limits.
    #[error("`{key}` = {value}, but it must be from {min} to {max}")]
    Range {
        /// Which number.
        key: String,
        /// Its value.
        value: f64,
        /// The least it may be.
        min: f64,
        /// The most it may be.
        max: f64,
    },
    /// A marker that cannot be part of a pad.
    #[error("marker {number}, `{text}`: {problem}")]
    Marker {
        /// Its place in the list, from 1.
        number: usize,
        /// Its text.
        text: String,
        /// What is wrong with it.
        problem: String,
    },
}

/// The pads that come with the program: name and description.
const BUILT_IN: [(&str, &str); 1] = [("a4", include_str!("../pads/a4.toml"))];
/// How far a marker may lie from the landing point, in metres.
const FARTHEST_M: f64 = 10.0;
/// How inexact a pad may be, in metres.
const MOST_TOLERANCE_M: f64 = 0.05;
/// How many markers a pad may have.
const MOST_MARKERS: usize = 32;
/// Four corners err in eight ways, a pose in six: what a pose says of its corners is too good by that much.
const CORNERS_PER_POSE: f64 = 8.0 / 6.0;
/// Variance of a corner that no marker's pose is trusted beyond, in square pixels.
const LEAST_VARIANCE_PX2: f64 = 1e-6;
/// A marker whose corners are this far from where the others want them, as mean square in units of their variance, is
/// no part of this pad: five standard deviations.
const MOST_STRAY: f64 = 25.0;

impl Pad {
    /// The name of the family under which pads are reported beside markers.
    pub const FAMILY: &'static str = "pad";

    /// The pad of this name that comes with the program, or the one that the file of this name describes; `read` reads
    /// files.
    ///
    /// # Errors
    /// [`PadError`] with the name, when there is no such pad or its description is wrong.
    pub fn named<E: std::fmt::Display>(
        name: &str,
        read: impl FnOnce(&str) -> Result<String, E>,
    ) -> Result<Self, PadError> {
        let text = match BUILT_IN.iter().find(|(known, _)| *known == name) {
            Some((_, text)) => (*text).to_owned(),
            None => read(name).map_err(|problem| PadError::Unreadable {
                name: name.to_owned(),
                problem: problem.to_string(),
                known: BUILT_IN.map(|(known, _)| known).join(", "),
            })?,
        };
        text.parse().map_err(|problem: PadError| PadError::Described {
            name: name.to_owned(),
            problem: Box::new(problem),
        })
    }

    /// Its number; it is called `pad:` and this wherever a marker is named.
    pub fn id(&self) -> u32 {
        self.id
    }

    /// Its name beside those of markers: `pad:ID`.
    pub fn name(&self) -> String {
        format!("{}:{}", Self::FAMILY, self.id)
    }

    /// Its markers, in the order in which they are printed.
    pub fn markers(&self) -> &[PlacedMarker] {
        &self.markers
    }

    /// Adds those of its markers to a list of markers to look for that the list does not have yet.
    pub fn add_markers(&self, markers: &mut Vec<Marker>) {
        for PlacedMarker { marker, .. } in &self.markers {
            if !markers.iter().any(|m| m.family == marker.family && m.id == marker.id) {
                markers.push(*marker);
            }
        }
    }

    /// What it looks like: all its markers, each on white paper of its quiet zone, later ones over earlier ones; `None`
    /// for an id that cannot be drawn.
    pub fn drawing(&self) -> Option<Drawing> {
        let mut whole = Drawing { half_extent_m: 0.0, layers: Vec::new() };
        for placed in &self.markers {
            let drawing = Drawing::new(&placed.marker, placed.size_m)?;
            let half_m = drawing.half_extent_m;
            let paper = Shape::Rectangle { min_m: [-half_m; 2], max_m: [half_m; 2] };
            let paper = Layer { shape: paper, ink: Ink::White };
            let layers = std::iter::once(&paper).chain(&drawing.layers);
            whole.layers.extend(layers.map(|layer| placed.on_pad(layer)));
            let [x, y] = placed.place_m.map(f64::abs);
            whole.half_extent_m = whole.half_extent_m.max(x.max(y) + half_m);
        }
        Some(whole)
    }

    /// The pad among the markers found in one image; `None` when none of its markers is among them, or none that has
    /// a pose. Markers of its ids that are not where the others want them are left out; of two that contradict each
    /// other the larger one is believed.
    pub fn observe(&self, found: &[Observation], camera: &CameraModel) -> Option<PadObservation> {
        let mut seen: Vec<Member<'_>> =
            found.iter().filter_map(|it| self.member(it, camera)).collect();
        let all = seen.len();
        loop {
            let pose = match seen.as_slice() {
                [] => return None,
                [only] => only.pad_pose(self.tolerance_m)?,
                several => joint_pose(several, camera)?,
            };
            let stray = if seen.len() < 2 { None } else { stray(&seen, &pose, camera) };
            match stray {
                Some(index) => {
                    seen.remove(index);
                }
                None => return self.observation(&seen, pose, all - seen.len(), camera),
            }
        }
    }

    fn member<'a>(&self, found: &'a Observation, camera: &CameraModel) -> Option<Member<'a>> {
        let placed = self.markers.iter().find(|it| it.marker.includes(found.family, found.id))?;
        Member::new(placed, found, self.tolerance_m, camera)
    }

    fn observation(
        &self,
        used: &[Member<'_>],
        pose: MarkerPose,
        left_out: usize,
        camera: &CameraModel,
    ) -> Option<PadObservation> {
        let (centre, by_place) = camera.project_with_jacobian(pose.camera_from_marker.origin())?;
        let place = pose.covariance.fixed_view::<3, 3>(0, 0);
        let most =
            |of: fn(&Observation) -> f64| used.iter().map(|m| of(m.found)).fold(0.0, f64::max);
        Some(PadObservation {
            centre,
            centre_covariance_px2: by_place * place * by_place.transpose(),
            pose,
            size_px: most(|found| found.size_px),
            confidence: most(|found| found.confidence),
            used: used.len(),
            left_out,
        })
    }
}

impl PlacedMarker {
    /// The marker's frame in the pad's.
    fn pad_from_marker(&self) -> Transform<MarkerFrame, MarkerFrame> {
        let turn = f64::from(self.quarter_turns) * std::f64::consts::FRAC_PI_2;
        let [x, y] = self.place_m;
        let turn = Rotation::from_rotation_vector(Vector::new(0.0, 0.0, turn));
        Transform::new(turn, Point::new(x, y, 0.0))
    }

    /// A place on the marker as a place on the pad.
    fn place_on_pad(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [right, up] = match self.quarter_turns {
            0 => [x, y],
            1 => [-y, x],
            2 => [-x, -y],
            _ => [y, -x],
        };
        [self.place_m[0] + right, self.place_m[1] + up]
    }

    fn on_pad(&self, layer: &Layer) -> Layer {
        let shape = match layer.shape {
            Shape::Disc { centre_m, radius_m } => {
                Shape::Disc { centre_m: self.place_on_pad(centre_m), radius_m }
            }
            Shape::Rectangle { min_m, max_m } => {
                let (a, b) = (self.place_on_pad(min_m), self.place_on_pad(max_m));
                Shape::Rectangle {
                    min_m: [a[0].min(b[0]), a[1].min(b[1])],
                    max_m: [a[0].max(b[0]), a[1].max(b[1])],
                }
            }
        };
        Layer { shape, ink: layer.ink }
    }
}

/// A marker of the pad that was found.
struct Member<'a> {
    placed: PlacedMarker,
    found: &'a Observation,
    marker_pose: &'a MarkerPose,
    /// Its corners on the pad and in the image, or its centre where it has no corners.
    points: Vec<PlanePoint>,
}

impl<'a> Member<'a> {
    fn new(
        placed: &PlacedMarker,
        found: &'a Observation,
        tolerance_m: f64,
        camera: &CameraModel,
    ) -> Option<Self> {
        let marker_pose = found.pose.as_ref()?;
        let points = match found.corners {
            Some(corners) => corner_points(placed, corners, marker_pose, tolerance_m, camera)?,
            None => vec![centre_point(placed, found, marker_pose, tolerance_m, camera)?],
        };
        Some(Self { placed: *placed, found, marker_pose, points })
    }

    /// How much it says: its extent in the image; nothing without corners.
    fn weight(&self) -> f64 {
        self.found.corners.map_or(0.0, |_| self.found.size_px)
    }

    /// The pad's pose by this marker alone; `None` for one that does not tell how it is turned, unless it lies where the
    /// landing point is.
    fn pad_pose(&self, tolerance_m: f64) -> Option<MarkerPose> {
        if self.found.corners.is_none() && self.placed.place_m != [0.0; 2] {
            return None;
        }
        let marker_from_pad = self.placed.pad_from_marker().inverse();
        let pose = self.marker_pose;
        let camera_from_pad = pose.camera_from_marker * marker_from_pad;
        let arm = camera_from_pad.origin().coords - pose.camera_from_marker.origin().coords;
        let mut lever = Matrix6::identity();
        lever.fixed_view_mut::<3, 3>(0, 3).copy_from(&-arm.cross_matrix());
        let mut covariance = lever * pose.covariance * lever.transpose();
        let misplaced = Matrix3::identity() * (tolerance_m * tolerance_m);
        let mut place = covariance.fixed_view_mut::<3, 3>(0, 0);
        place += misplaced;
        covariance.iter().all(|c| c.is_finite()).then_some(MarkerPose {
            camera_from_marker: camera_from_pad,
            reprojection_rms_px: pose.reprojection_rms_px,
            covariance,
            alternative: pose.alternative.map(|other| PoseSolution {
                camera_from_marker: other.camera_from_marker * marker_from_pad,
                ..other
            }),
        })
    }

    /// Mean square distance of its corners from where a pad at `pose` has them, in units of their variance.
    fn stray(&self, pose: &MarkerPose, camera: &CameraModel) -> f64 {
        let squares = self.points.iter().map(|point| {
            let [x, y] = point.place_m;
            let place = pose.camera_from_marker * Point::<MarkerFrame>::new(x, y, 0.0);
            let pixel = camera.project(place)?;
            let residual = Vector2::new(point.seen.x - pixel.x, point.seen.y - pixel.y);
            Some(residual.dot(&(point.covariance_px2.cholesky()?.inverse() * residual)))
        });
        let values = 2.0 * self.points.len() as f64;
        squares.sum::<Option<f64>>().map_or(f64::INFINITY, |sum| sum / values)
    }
}

/// A marker's corners, on the pad and in the image.
fn corner_points(
    placed: &PlacedMarker,
    seen: [Pixel; 4],
    marker_pose: &MarkerPose,
    tolerance_m: f64,
    camera: &CameraModel,
) -> Option<Vec<PlanePoint>> {
    let half = placed.size_m / 2.0;
    let corners = [[-half, half], [half, half], [half, -half], [-half, -half]];
    let pose = &marker_pose.camera_from_marker;
    let points = corners.iter().zip(seen).map(|(corner, seen)| {
        let place = *pose * Point::<MarkerFrame>::new(corner[0], corner[1], 0.0);
        let (_, by_place) = camera.project_with_jacobian(place)?;
        let arm = (place.coords - pose.origin().coords).cross_matrix();
        let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
        by_pose.fixed_view_mut::<2, 3>(0, 0).copy_from(&by_place);
        by_pose.fixed_view_mut::<2, 3>(0, 3).copy_from(&(by_place * -arm));
        let spread = by_pose * marker_pose.covariance * by_pose.transpose() * CORNERS_PER_POSE;
        let place_m = placed.place_on_pad(*corner);
        Some(plane_point(place_m, seen, spread, &by_place, tolerance_m))
    });
    points.collect()
}

/// A marker's centre, on the pad and in the image.
fn centre_point(
    placed: &PlacedMarker,
    found: &Observation,
    marker_pose: &MarkerPose,
    tolerance_m: f64,
    camera: &CameraModel,
) -> Option<PlanePoint> {
    let (_, by_place) = camera.project_with_jacobian(marker_pose.camera_from_marker.origin())?;
    let spread = found.centre_covariance_px2;
    Some(plane_point(placed.place_m, found.centre, spread, &by_place, tolerance_m))
}

/// A point that errs by what its pixels do and by what the printer did.
fn plane_point(
    place_m: [f64; 2],
    seen: Pixel,
    spread_px2: Matrix2<f64>,
    by_place: &Matrix2x3<f64>,
    tolerance_m: f64,
) -> PlanePoint {
    let misplaced = by_place * by_place.transpose() * (tolerance_m * tolerance_m);
    let least = Matrix2::identity() * LEAST_VARIANCE_PX2;
    PlanePoint { place_m, seen, covariance_px2: spread_px2 + misplaced + least }
}

fn joint_pose(members: &[Member<'_>], camera: &CameraModel) -> Option<MarkerPose> {
    let points: Vec<PlanePoint> = members.iter().flat_map(|m| m.points.iter().copied()).collect();
    planar_pose(&points, camera)
}

/// The member that is least where the others want it, if it is too far from there. Which of two is wrong cannot be
/// told from them; the smaller one gives less.
fn stray(members: &[Member<'_>], pose: &MarkerPose, camera: &CameraModel) -> Option<usize> {
    let strays = members.iter().map(|member| member.stray(pose, camera));
    let (worst, most) = strays.enumerate().max_by(|(_, a), (_, b)| a.total_cmp(b))?;
    if most.is_finite() && most <= MOST_STRAY {
        return None;
    }
    match members {
        [first, second] => Some(usize::from(first.weight() >= second.weight())),
        _ => Some(without_which_the_rest_agrees(members, camera).unwrap_or(worst)),
    }
}

/// A marker far off pulls the pose away from the others, which then look worse than it: leaving each out in turn shows
/// which one it is.
fn without_which_the_rest_agrees(members: &[Member<'_>], camera: &CameraModel) -> Option<usize> {
    let cost = |without: usize| {
        let kept = members.iter().enumerate().filter(|(i, _)| *i != without).map(|(_, m)| m);
        let points: Vec<PlanePoint> = kept.clone().flat_map(|m| m.points.iter().copied()).collect();
        let pose = planar_pose(&points, camera)?;
        Some(kept.map(|member| member.stray(&pose, camera)).sum::<f64>())
    };
    let costs = (0..members.len()).filter_map(|without| Some((without, cost(without)?)));
    costs.min_by(|(_, a), (_, b)| a.total_cmp(b)).map(|(without, _)| without)
}

/// A pad as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    id: u32,
    tolerance_m: Option<f64>,
    markers: Vec<Placed>,
}

/// A marker of a pad as it is written.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Placed {
    marker: String,
    #[serde(default)]
    x_m: f64,
    #[serde(default)]
    y_m: f64,
    #[serde(default)]
    quarter_turns: u8,
}

/// Markers printed on one sheet lie where they should within this, in metres.
const PRINTED_TOLERANCE_M: f64 = 0.0005;

impl FromStr for Pad {
    type Err = PadError;

    /// Reads a description in TOML, as at the head of this module.
    fn from_str(text: &str) -> Result<Self, PadError> {
        let told: Description = toml::from_str(text).map_err(|e| PadError::Toml(e.to_string()))?;
        let tolerance_m = told.tolerance_m.unwrap_or(PRINTED_TOLERANCE_M);
        within("tolerance_m", tolerance_m, (0.0, MOST_TOLERANCE_M))?;
        within("number of markers", told.markers.len() as f64, (1.0, MOST_MARKERS as f64))?;
        let mut markers: Vec<PlacedMarker> = Vec::with_capacity(told.markers.len());
        for (i, placed) in told.markers.iter().enumerate() {
            let number = i + 1;
            within(&format!("x_m of marker {number}"), placed.x_m, (-FARTHEST_M, FARTHEST_M))?;
            within(&format!("y_m of marker {number}"), placed.y_m, (-FARTHEST_M, FARTHEST_M))?;
            let turns = f64::from(placed.quarter_turns);
            within(&format!("quarter_turns of marker {number}"), turns, (0.0, 3.0))?;
            let placed = placed.checked(&markers).map_err(|problem| PadError::Marker {
                number,
                text: placed.marker.clone(),
                problem,
            })?;
            markers.push(placed);
        }
        Ok(Self { id: told.id, tolerance_m, markers })
    }
}

impl Placed {
    fn checked(&self, before: &[PlacedMarker]) -> Result<PlacedMarker, String> {
        let marker: Marker = self.marker.parse().map_err(|e| format!("{e}"))?;
        if marker.id.is_none() && marker.family.id_count().is_some() {
            return Err("a marker of a pad needs an id, as in `apriltag-36h11:3:0.15`".to_owned());
        }
        let size_m =
            marker.size_m.ok_or("a marker of a pad needs a size in metres, as its last part")?;
        if before.iter().any(|it| it.marker.includes(marker.family, marker.id)) {
            return Err(
                "it is on the pad twice; which of the two is seen could not be told".to_owned()
            );
        }
        let place_m = [self.x_m, self.y_m];
        Ok(PlacedMarker { marker, size_m, place_m, quarter_turns: self.quarter_turns })
    }
}

fn within(key: &str, value: f64, (min, max): (f64, f64)) -> Result<(), PadError> {
    match (min..=max).contains(&value) {
        true => Ok(()),
        false => Err(PadError::Range { key: key.to_owned(), value, min, max }),
    }
}
