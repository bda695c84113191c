//! Names the sets of frames, and the markers of the experiment.

pub use rendering::views::{MARKERS, SIZE_M};

/// The families of [`MARKERS`], in their order.
pub fn families() -> impl Iterator<Item = &'static str> {
    MARKERS.iter().filter_map(|marker| marker.split(':').next())
}

/// A set of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Set {
    /// The thesis' 37 positions (Table 4.1) with both binnings, five frames each.
    Positions,
    /// Straight down from 10 to 40 m, five frames each.
    Far,
    /// Conditions of a landing: 51 frames.
    Landing,
    /// Shadows, glare, occlusion, low contrast, noise, defocus, inverted, cut off by the border.
    Adverse,
    /// Tilted by up to 60 degrees at four distances.
    Tilt,
    /// Blurred by the lens and by motion.
    Blur,
    /// Increasing noise.
    Noise,
    /// From underexposed to overexposed.
    Light,
    /// Motion with a rolling shutter.
    Rolling,
    /// Edges of hard shadows with contrasts from 2 to 10, also across small markers, dappled shade, leaves.
    Shade,
    /// Covered by grass, dirt, snow, a rope, a hand; wet, faded, of few dots, bent, behind glass, on cloth; by low sun, by
    /// night, through a dirty lens: 40 frames each.
    Ground,
    /// Cut off by the frame at 0.5 to 1.5 m, tilted as by wind: 200 frames.
    Cut,
    /// Textured grounds, for timing.
    Textured,
    /// A marker 48 px wide that drifts through the image.
    Tracking,
    /// Scenes without a marker.
    Negatives,
    /// Circles that people make, without a marker: manholes, washers, wheels, targets, other people's markers.
    Circles,
}

impl Set {
    /// Every set, in the order in which they are rendered.
    pub const ALL: [Self; 16] = [
        Self::Textured,
        Self::Adverse,
        Self::Landing,
        Self::Far,
        Self::Tilt,
        Self::Blur,
        Self::Noise,
        Self::Light,
        Self::Rolling,
        Self::Shade,
        Self::Ground,
        Self::Cut,
        Self::Tracking,
        Self::Negatives,
        Self::Circles,
        Self::Positions,
    ];

    /// The name of its folder.
    pub fn name(self) -> &'static str {
        match self {
            Self::Positions => "positions",
            Self::Far => "far",
            Self::Landing => "landing",
            Self::Adverse => "adverse",
            Self::Tilt => "tilt",
            Self::Blur => "blur",
            Self::Noise => "noise",
            Self::Light => "light",
            Self::Rolling => "rolling",
            Self::Shade => "shade",
            Self::Ground => "ground",
            Self::Cut => "cut",
            Self::Textured => "textured",
            Self::Tracking => "tracking",
            Self::Negatives => "negatives",
            Self::Circles => "circles",
        }
    }

    /// Whether its frames show the marker.
    pub fn has_marker(self) -> bool {
        !matches!(self, Self::Negatives | Self::Circles)
    }
}

impl std::str::FromStr for Set {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        Self::ALL.into_iter().find(|set| set.name() == text).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            format!("there is no set `{text}`; known are {known}")
        })
    }
}
