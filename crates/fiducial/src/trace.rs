//! What a detection saw on its way: for people, and for the debug images.

use geometry::Pixel;
use imaging::Ellipse;

use crate::candidates::ring::Ring;
use crate::observation::Observation;

/// What the last detection saw.
#[derive(Clone, Debug, Default)]
pub struct Trace {
    /// The contours that are ellipses.
    pub ellipses: Vec<Ellipse>,
    /// The pairs of ellipses that are rings.
    pub rings: Vec<Ring>,
    /// The candidates for square markers whose code was read, clockwise; no more than [`Trace::MOST_REFUSALS`].
    pub quads: Vec<[Pixel; 4]>,
    /// The candidates that did not hold; no more than [`Trace::MOST_REFUSALS`].
    pub refusals: Vec<Refusal>,
    /// The markers found: centre and outer edge.
    pub markers: Vec<TracedMarker>,
}

/// A candidate that was refused.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Refusal {
    /// What was looked at.
    pub candidate: Candidate,
    /// The first check that failed.
    pub reason: Reason,
}

/// What could have been a marker.
#[derive(Copy, Clone, Debug, PartialEq)]
pub enum Candidate {
    /// The two edges of a ring.
    Ring([Ellipse; 2]),
    /// The corners of a square, clockwise.
    Quad([Pixel; 4]),
}

/// Why a candidate is no marker.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Reason {
    /// Two ellipses whose shapes differ (Algorithm 3).
    Eccentricity,
    /// Two ellipses whose orientations differ (Algorithm 4).
    Orientation,
    /// The ratio of two ellipses' axes is no ring's (Algorithm 5).
    Type,
    /// What lies between two ellipses is not black (Algorithm 6), or what lies around is not white.
    Blackness,
    /// No circle or square in space looks like this.
    Pose,
    /// The edges are not where a marker of this size and pose has them.
    Edges,
    /// It lies in a marker that was found already.
    Repeated,
    /// A quad that is too small to be read.
    Small,
    /// A quad whose sides are not straight, or that no square in space looks like.
    Shape,
    /// A quad that is not darker than what is around it (or brighter, for a marker printed white on black).
    Contrast,
    /// A quad whose border is not of one colour all round.
    Border,
    /// A quad whose cells make no word of the families looked for.
    Code,
    /// A word of a marker that is not looked for.
    Unwanted,
    /// The evidence is too weak to be believed.
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
    /// One word for people.
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
    /// Makes the lists as large as frames with texture need.
    pub(crate) fn make_room(&mut self) {
        const MOST: usize = 1024;
        self.ellipses.reserve(MOST);
        self.rings.reserve(MOST);
        self.quads.reserve(Self::MOST_REFUSALS);
        self.refusals.reserve(Self::MOST_REFUSALS);
        self.markers.reserve(Self::MOST_REFUSALS);
    }

    /// How many refusals are kept, and how many quads.
    pub const MOST_REFUSALS: usize = 256;

    pub(crate) fn clear(&mut self) {
        self.ellipses.clear();
        self.rings.clear();
        self.quads.clear();
        self.refusals.clear();
        self.markers.clear();
    }

    /// Two ellipses are no ring, or a ring is no marker.
    pub(crate) fn refuse(&mut self, first: Ellipse, second: Ellipse, reason: Reason) {
        self.keep(Candidate::Ring([first, second]), reason);
    }

    /// A quad is no marker.
    pub fn refuse_quad(&mut self, corners: [Pixel; 4], reason: Reason) {
        self.keep(Candidate::Quad(corners), reason);
    }

    /// The code in a quad was read.
    pub fn accept_quad(&mut self, corners: [Pixel; 4]) {
        if self.quads.len() < Self::MOST_REFUSALS {
            self.quads.push(corners);
        }
    }

    fn keep(&mut self, candidate: Candidate, reason: Reason) {
        if self.refusals.len() < Self::MOST_REFUSALS {
            self.refusals.push(Refusal { candidate, reason });
        }
    }

    /// Adds what was seen in a part of the image whose top-left pixel lies at `offset`.
    pub fn add_part(&mut self, part: &Self, offset: [f64; 2]) {
        self.ellipses.extend(part.ellipses.iter().map(|ellipse| moved(ellipse, offset)));
        self.rings.extend(part.rings.iter().map(|ring| {
            Ring::new(ring.kind, moved(&ring.inner, offset), moved(&ring.outer, offset))
        }));
        self.quads.extend(part.quads.iter().map(|quad| quad.map(|c| moved_pixel(c, offset))));
        for refusal in &part.refusals {
            let candidate = match refusal.candidate {
                Candidate::Ring(pair) => Candidate::Ring(pair.map(|e| moved(&e, offset))),
                Candidate::Quad(quad) => Candidate::Quad(quad.map(|c| moved_pixel(c, offset))),
            };
            self.keep(candidate, refusal.reason);
        }
        self.markers.extend(part.markers.iter().map(|marker| TracedMarker {
            centre: moved_pixel(marker.centre, offset),
            corners: marker.corners.map(|corners| corners.map(|c| moved_pixel(c, offset))),
            ..*marker
        }));
    }
}

fn moved(ellipse: &Ellipse, [dx, dy]: [f64; 2]) -> Ellipse {
    let [x, y] = ellipse.centre;
    Ellipse { centre: [x + dx, y + dy], ..*ellipse }
}

/// A pixel of a part of the image as a pixel of the whole.
pub(crate) fn moved_pixel(pixel: Pixel, [dx, dy]: [f64; 2]) -> Pixel {
    Pixel::new(pixel.x + dx, pixel.y + dy)
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
