//! Whether detectors see the marker at one place, and turned the same way where the vehicle turns to it, judged on the frames that they
//! have all searched.
//!
//! Two poses in one frame need no vehicle state and no estimate. Whether a pair agrees does not depend on which of the two is
//! named first. Of two detectors that differ it cannot be decided which is right; of three or more the majority is believed: at least two
//! that agree with each other and differ from the third.

use std::collections::VecDeque;

use geometry::{Body, Frame, Marker, Rotation, Transform, Vector, squared};
use libm::{atan2, hypot};

/// Frames that two detectors must both have searched for a conclusion.
const MIN_COMMON: u32 = 8;
/// Latest frames with a marker from another detector in which one is looked for that sees nothing.
const MAX_SEEN: u32 = 12;
/// Detectors that outvote another one: one against one decides nothing.
const MIN_MAJORITY: usize = 2;
/// The difference up to which two headings agree, in radians: 15 degrees. Corners that are half a pixel off turn a marker of 12 pixels
/// by 3 degrees, and corners in another order by 90 or 180.
pub const HEADING_TOLERANCE_RAD: f64 = 15.0 * std::f64::consts::PI / 180.0;
/// One more than the cosine of the tilt, below which a marker that is seen from behind has no heading.
const MIN_UPRIGHT: f64 = 0.2;

/// The marker as a detector sees it.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Sight {
    /// Its position in the vehicle's body frame, in metres; `None` without a pose.
    pub position_m: Option<[f64; 3]>,
    /// Its heading about the body's down axis, in radians, from [`heading_rad`]; `None` without a pose. Of a marker without a heading it
    /// means nothing.
    pub heading_rad: Option<f64>,
    /// Whether the detector gave a pose. With one there is no position either where the camera's mount is not known.
    pub has_pose: bool,
}

impl Sight {
    /// The marker as a detector gave it, with a pose or without one, and where that is in the body frame, if it is known.
    pub fn new(has_pose: bool, body_from_marker: Option<Transform<Body, Marker>>) -> Self {
        Self {
            has_pose,
            position_m: body_from_marker.map(|pose| pose.origin().coords.into()),
            heading_rad: body_from_marker.and_then(|pose| heading_rad(pose.rotation())),
        }
    }
}

/// The markers that a detector saw in its latest frames, by stamp, newest last.
pub type Sights = VecDeque<(i64, Option<Sight>)>;

/// A detector that answers, with its markers.
#[derive(Copy, Clone, Debug)]
pub struct Voter<'a> {
    /// Its name.
    pub name: &'a str,
    /// Its markers.
    pub sights: &'a Sights,
}

/// The differences up to which two sights agree.
#[derive(Copy, Clone, Debug)]
pub struct Tolerance {
    /// At range 0, in metres.
    pub base_m: f64,
    /// Growth per metre of range.
    pub per_m: f64,
    /// Difference of two headings, in radians; `None` where they do not matter.
    pub heading_rad: Option<f64>,
}

impl Tolerance {
    /// The distance at a range in metres, in metres.
    pub fn at(&self, range_m: f64) -> f64 {
        self.base_m + self.per_m * range_m
    }
}

/// Why a detector is not believed although it answers.
#[derive(Clone, Debug, PartialEq)]
pub enum Fault {
    /// More detectors see the marker elsewhere or turned, and all of them the same.
    Outvoted {
        /// How many.
        by: usize,
        /// Its distance from one of them, in metres.
        apart_m: f64,
        /// The angle between its heading and that one's where these differ, in radians.
        turned_rad: Option<f64>,
    },
    /// It sees no marker in frames in which another one does.
    Blind {
        /// The other one.
        seeing: String,
    },
    /// It gives no pose of the marker, and the landing needs one.
    NoPose,
}

/// Another detector that sees the marker elsewhere or turned, while it is not decided which of the two is right.
#[derive(Clone, Debug, PartialEq)]
pub struct Dispute {
    /// The active detector.
    pub active: String,
    /// The other one.
    pub other: String,
    /// The distance between both positions in the latest frame in which they or the headings differ, in metres.
    pub apart_m: f64,
    /// The angle between both headings in the latest frame in which they differ, in radians; `None` where they agree or do not matter.
    pub turned_rad: Option<f64>,
}

/// The latest frames that two detectors have both searched.
#[derive(Copy, Clone, Debug, Default)]
struct Common {
    /// Latest frames with a position from both; at most `MIN_COMMON`.
    both: u32,
    /// Those in which the positions or the headings differ.
    apart: u32,
    /// The distance in the latest of them, in metres.
    apart_m: f64,
    /// Those in which the headings differ.
    turned: u32,
    /// The angle in the latest of these, in radians.
    turned_rad: f64,
    /// Latest frames in which the second saw a marker; at most `MAX_SEEN`.
    second_saw: u32,
    /// Those in which the first saw none.
    first_missed: u32,
}

impl Common {
    fn of(first: &Sights, second: &Sights, tolerance: Tolerance) -> Self {
        let mut common = Self::default();
        let mut theirs = second.iter().rev().peekable();
        for (stamp, ours) in first.iter().rev() {
            while theirs.next_if(|(other, _)| other > stamp).is_some() {}
            let Some((_, theirs)) = theirs.next_if(|(other, _)| other == stamp) else { continue };
            common.add(*ours, *theirs, tolerance);
            if common.both >= MIN_COMMON && common.second_saw >= MAX_SEEN {
                break;
            }
        }
        common
    }

    /// Counts a frame; the newest first.
    fn add(&mut self, first: Option<Sight>, second: Option<Sight>, tolerance: Tolerance) {
        if second.is_some() && self.second_saw < MAX_SEEN {
            self.second_saw += 1;
            self.first_missed += u32::from(first.is_none());
        }
        if let Some((first, second)) = first.zip(second)
            && let Some((first_m, second_m)) = first.position_m.zip(second.position_m)
            && self.both < MIN_COMMON
        {
            let apart_m = distance(first_m, second_m);
            let turned_rad = turned(tolerance, first, second);
            self.both += 1;
            if let Some(turned_rad) = turned_rad {
                if self.turned == 0 {
                    self.turned_rad = turned_rad;
                }
                self.turned += 1;
            }
            let is_within = within(tolerance, first_m, second_m);
            if !is_within || turned_rad.is_some() {
                if self.apart == 0 {
                    self.apart_m = apart_m;
                }
                self.apart += 1;
            }
        }
    }

    /// The angle between the headings where they differ in most frames, in radians.
    fn turned_rad(&self) -> Option<f64> {
        (self.turned * 2 > self.both).then_some(self.turned_rad)
    }

    fn differ(&self) -> bool {
        self.both >= MIN_COMMON && self.apart * 2 > self.both
    }

    fn agree(&self) -> bool {
        self.both >= MIN_COMMON && self.apart * 2 <= self.both
    }

    /// They agree in at least three of four frames: where they are about as far apart as the tolerance allows, a dispute does not end
    /// and begin again with every frame.
    fn agree_clearly(&self) -> bool {
        self.both >= MIN_COMMON && self.apart * 4 <= self.both
    }

    /// The first saw nothing in at least three of four frames in which the second saw the marker.
    fn first_is_blind(&self) -> bool {
        self.second_saw >= MIN_COMMON && self.first_missed * 4 >= self.second_saw * 3
    }
}

/// The fault of each of the detectors that answer.
pub fn faults(voters: &[Voter<'_>], tolerance: Tolerance) -> Vec<Option<Fault>> {
    // Most of very many see nothing, and nothing follows from that.
    let sees: Vec<bool> =
        voters.iter().map(|voter| voter.sights.iter().any(|(_, sight)| sight.is_some())).collect();
    let row = |(own, first): (usize, &Voter<'_>)| -> Vec<Common> {
        let pair = |(i, (second, sees)): (usize, (&Voter<'_>, &bool))| match i != own && *sees {
            true => Common::of(first.sights, second.sights, tolerance),
            false => Common::default(),
        };
        voters.iter().zip(&sees).enumerate().map(pair).collect()
    };
    let all: Vec<Vec<Common>> = voters.iter().enumerate().map(row).collect();
    let outvoted: Vec<_> = all.iter().map(|row| outvoted(row, &all)).collect();
    let seeing = |own: usize, row: &Vec<Common>| {
        let others = row.iter().zip(voters).zip(&outvoted).enumerate();
        let mut believed = others.filter(|(i, (_, fault))| *i != own && fault.is_none());
        let seeing = believed.find(|(_, ((common, _), _))| common.first_is_blind())?;
        let (_, ((_, voter), _)) = seeing;
        Some(Fault::Blind { seeing: voter.name.to_owned() })
    };
    all.iter()
        .zip(&outvoted)
        .enumerate()
        .map(|(own, (row, outvoted))| outvoted.clone().or_else(|| seeing(own, row)))
        .collect()
}

/// The majority against a detector, by its row of all pairs: the most of those that differ from it which agree with one of them. It
/// is never one of these itself, nor is one that agrees with it.
fn outvoted(row: &[Common], all: &[Vec<Common>]) -> Option<Fault> {
    // It agrees with itself.
    let ours = 1 + row.iter().filter(|common| common.agree()).count();
    let differing = row.iter().filter(|common| common.differ()).count();
    let groups =
        row.iter().zip(all).filter(|(common, _)| common.differ()).map(|(common, theirs)| {
            let others =
                theirs.iter().zip(row).filter(|(theirs, own)| theirs.agree() && own.differ());
            (common, 1 + others.count())
        });
    let is_majority = |by: usize| by >= MIN_MAJORITY && by > ours && by * 2 > ours + differing;
    let (common, by) = groups.filter(|(_, by)| is_majority(*by)).max_by_key(|(_, by)| *by)?;
    Some(Fault::Outvoted { by, apart_m: common.apart_m, turned_rad: common.turned_rad() })
}

/// True where a detector gives no pose of the marker in at least three of four of the latest frames in which it sees it.
pub fn gives_no_pose(sights: &Sights) -> bool {
    let latest = sights.iter().rev().filter_map(|(_, sight)| *sight).take(MAX_SEEN as usize);
    let (seen, without) = latest.fold((0_u32, 0_u32), |(seen, without), sight| {
        (seen + 1, without + u32::from(!sight.has_pose))
    });
    seen >= MIN_COMMON && without * 4 >= seen * 3
}

/// The detector that sees the marker farthest from where the active one does, of those that see it elsewhere or turned.
pub fn dispute(active: Voter<'_>, others: &[Voter<'_>], tolerance: Tolerance) -> Option<Dispute> {
    others
        .iter()
        .map(|other| (other.name, Common::of(active.sights, other.sights, tolerance)))
        .filter(|(_, common)| common.differ())
        .max_by(|(_, a), (_, b)| a.apart_m.total_cmp(&b.apart_m))
        .map(|(other, common)| Dispute {
            active: active.name.to_owned(),
            other: other.to_owned(),
            apart_m: common.apart_m,
            turned_rad: common.turned_rad(),
        })
}

/// True when two detectors have seen the marker at one place, and turned the same way where that matters, in enough frames.
pub fn agree(first: Voter<'_>, second: Voter<'_>, tolerance: Tolerance) -> bool {
    Common::of(first.sights, second.sights, tolerance).agree()
}

/// True when two detectors that disagreed do so no more: they agree in most of the latest frames.
pub fn agree_again(first: Voter<'_>, second: Voter<'_>, tolerance: Tolerance) -> bool {
    Common::of(first.sights, second.sights, tolerance).agree_clearly()
}

/// True when two positions agree, in whatever order. The farther one gives the range, as the error of a position grows with it.
pub fn within(tolerance: Tolerance, one_m: [f64; 3], other_m: [f64; 3]) -> bool {
    distance(one_m, other_m) <= tolerance.at(range(one_m, other_m))
}

/// The angle between the headings of two sights, in radians, where it is more than they may differ by; in whatever order.
pub fn turned(tolerance: Tolerance, one: Sight, other: Sight) -> Option<f64> {
    let max_rad = tolerance.heading_rad?;
    let (one_rad, other_rad) = one.heading_rad.zip(other.heading_rad)?;
    Some(angle_between(one_rad, other_rad)).filter(|rad| *rad > max_rad)
}

/// The angle between two headings in radians, from 0 to half a turn.
pub fn angle_between(one_rad: f64, other_rad: f64) -> f64 {
    let turn = std::f64::consts::TAU;
    let difference = one_rad - other_rad;
    (difference - turn * (difference / turn).round()).abs()
}

/// The heading of a marker's upper edge about the third axis of a frame that looks at it along that axis, in radians, clockwise seen against it.
/// `None` where it is seen from behind.
///
/// Only the turn about that axis counts, without the tilt: of the two poses that a distant marker's corners fit both have the same
/// heading, while their upper edges may point tens of degrees apart.
pub fn heading_rad<F: Frame>(rotation: Rotation<F, Marker>) -> Option<f64> {
    let right = rotation * Vector::<Marker>::new(1.0, 0.0, 0.0);
    let up = rotation * Vector::<Marker>::new(0.0, 1.0, 0.0);
    let (along, across) = (up.x() + right.y(), up.y() - right.x());
    let is_upright = hypot(along, across) > MIN_UPRIGHT;
    is_upright.then(|| atan2(across, along))
}

/// The range by which two positions are judged: the larger of theirs, in their unit.
pub fn range(one: [f64; 3], other: [f64; 3]) -> f64 {
    libm::fmax(distance(one, [0.0; 3]), distance(other, [0.0; 3]))
}

/// The distance of two points, in their unit.
pub fn distance(a: [f64; 3], b: [f64; 3]) -> f64 {
    a.iter().zip(b).map(|(a, b)| squared(a - b)).sum::<f64>().sqrt()
}
