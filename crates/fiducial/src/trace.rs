//! Records the candidates of a detection and why they were refused, for debug images.

use geometry::{Pixel, Roi};
use imaging::Ellipse;

use crate::candidates::ring::Ring;
use crate::observation::Observation;

/// Candidates and markers of the last detection.
#[derive(Clone, Debug, Default)]
pub struct Trace {
    /// Contours that are ellipses.
    pub ellipses: Vec<Ellipse>,
    /// Pairs of ellipses that are rings.
    pub rings: Vec<Ring>,
    /// Corners, clockwise, of square candidates whose code was read; at most [`Trace::MAX_REFUSALS`].
    pub quads: Vec<[Pixel; 4]>,
    /// Refused candidates; at most [`Trace::MAX_REFUSALS`].
    pub refusals: Vec<Refusal>,
    /// The markers that were found.
    pub markers: Vec<TracedMarker>,
}

/// A candidate that was refused.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Refusal {
    /// The candidate.
    pub candidate: Candidate,
    /// The first check that failed.
    pub reason: Reason,
}

/// A candidate for a marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Candidate {
    /// The two edges of a ring.
    Ring([Ellipse; 2]),
    /// The corners of a square, clockwise.
    Quad([Pixel; 4]),
}

/// Why a candidate was refused.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Reason {
    /// Two ellipses whose shapes differ (Algorithm 3).
    Eccentricity,
    /// Two ellipses whose orientations differ (Algorithm 4).
    Orientation,
    /// The ratio of two ellipses' axes is not that of a ring (Algorithm 5).
    Type,
    /// The area between two ellipses is not black (Algorithm 6), or the area around them or
    /// within not white.
    Blackness,
    /// No circle or square in space has this projection.
    Pose,
    /// The edges are not where a marker of this size and pose has them.
    Edges,
    /// It lies in a marker that was already found.
    Repeated,
    /// A quad that is too small to be read.
    Small,
    /// A quad whose sides are not straight, or that is not the projection of a square.
    Shape,
    /// A quad that is not darker than its surroundings, or brighter for a marker printed white on black.
    Contrast,
    /// A quad whose border is not of one colour.
    Border,
    /// A quad whose cells are no codeword of the requested families.
    Code,
    /// The codeword of a marker that is not requested.
    Unwanted,
    /// The confidence is too low.
    Confidence,
}

/// A marker found.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct TracedMarker {
    /// The projection of its centre.
    pub centre: Pixel,
    /// Its diameter in pixels.
    pub size_px: f64,
    /// The corners of a square marker.
    pub corners: Option<[Pixel; 4]>,
}

impl Reason {
    /// One word for labels.
    pub fn name(self) -> &'static str {
        match self {
            Self::Eccentricity => "eccentricity",
            Self::Orientation => "orientation",
            Self::Type => "type",
            Self::Blackness => "blackness",
            Self::Pose => "pose",
            Self::Edges => "edges",
            Self::Repeated => "repeated",
            Self::Small => "small",
            Self::Shape => "shape",
            Self::Contrast => "contrast",
            Self::Border => "border",
            Self::Code => "code",
            Self::Unwanted => "unwanted",
            Self::Confidence => "confidence",
        }
    }
}

impl Trace {
    /// Reserves memory for textured images.
    pub(crate) fn make_room(&mut self) {
        const CAPACITY: usize = 1024;
        self.ellipses.reserve(CAPACITY);
        self.rings.reserve(CAPACITY);
        self.quads.reserve(Self::MAX_REFUSALS);
        self.refusals.reserve(Self::MAX_REFUSALS);
        self.markers.reserve(Self::MAX_REFUSALS);
    }

    /// Largest number of refusals, and of quads, that are stored.
    pub const MAX_REFUSALS: usize = 256;

    /// Forgets everything, and keeps the room.
    pub fn clear(&mut self) {
        self.ellipses.clear();
        self.rings.clear();
        self.quads.clear();
        self.refusals.clear();
        self.markers.clear();
    }

    /// Notes that two ellipses are not a ring, or that a ring is not a marker.
    pub(crate) fn refuse(&mut self, first: Ellipse, second: Ellipse, reason: Reason) {
        self.keep(Candidate::Ring([first, second]), reason);
    }

    /// Notes that a quad is not a marker.
    pub fn refuse_quad(&mut self, corners: [Pixel; 4], reason: Reason) {
        self.keep(Candidate::Quad(corners), reason);
    }

    /// Notes that the code in a quad was read.
    pub fn accept_quad(&mut self, corners: [Pixel; 4]) {
        if self.quads.len() < Self::MAX_REFUSALS {
            self.quads.push(corners);
        }
    }

    fn keep(&mut self, candidate: Candidate, reason: Reason) {
        if self.refusals.len() < Self::MAX_REFUSALS {
            self.refusals.push(Refusal { candidate, reason });
        }
    }

    /// Adds the trace of a region of interest, in pixels of the whole frame.
    pub fn add_roi(&mut self, part: &Self, roi: &Roi) {
        self.ellipses.extend(part.ellipses.iter().map(|ellipse| mapped(ellipse, roi)));
        self.rings.extend(
            part.rings.iter().map(|ring| {
                Ring::new(ring.kind, mapped(&ring.inner, roi), mapped(&ring.outer, roi))
            }),
        );
        self.quads.extend(part.quads.iter().map(|quad| quad.map(|c| roi.to_frame(c))));
        for refusal in &part.refusals {
            let candidate = match refusal.candidate {
                Candidate::Ring(pair) => Candidate::Ring(pair.map(|e| mapped(&e, roi))),
                Candidate::Quad(quad) => Candidate::Quad(quad.map(|c| roi.to_frame(c))),
            };
            self.keep(candidate, refusal.reason);
        }
        self.markers.extend(part.markers.iter().map(|marker| TracedMarker {
            centre: roi.to_frame(marker.centre),
            size_px: marker.size_px * roi.scale,
            corners: marker.corners.map(|corners| corners.map(|c| roi.to_frame(c))),
        }));
    }
}

fn mapped(ellipse: &Ellipse, roi: &Roi) -> Ellipse {
    let [x, y] = ellipse.centre;
    let Pixel { x, y } = roi.to_frame(Pixel::new(x, y));
    let (minor, major) = (ellipse.minor * roi.scale, ellipse.major * roi.scale);
    Ellipse { centre: [x, y], minor, major, angle: ellipse.angle }
}

impl From<&Observation> for TracedMarker {
    fn from(observation: &Observation) -> Self {
        Self {
            centre: observation.centre,
            size_px: observation.size_px,
            corners: observation.corners,
        }
    }
}
