//! Defines a marker's family, id and size, written `family:id:size`.

use std::fmt;
use std::str::FromStr;

/// A marker family.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Family {
    /// AprilTag 16h5: 30 ids of 4x4 cells.
    AprilTag16h5,
    /// AprilTag 25h9: 35 ids of 5x5 cells.
    AprilTag25h9,
    /// AprilTag 36h10: 2320 ids of 6x6 cells.
    AprilTag36h10,
    /// AprilTag 36h11: 587 ids of 6x6 cells.
    AprilTag36h11,
    /// AprilTag Circle21h7: 38 ids, data inside and outside a white border, round outline.
    AprilTagCircle21h7,
    /// AprilTag Circle49h12: 65535 ids, data inside and outside a white border, round outline.
    AprilTagCircle49h12,
    /// AprilTag Custom48h12: 42211 ids, the middle left free for a smaller marker.
    AprilTagCustom48h12,
    /// AprilTag Standard41h12: 2115 ids, data inside and outside a white border.
    AprilTagStandard41h12,
    /// AprilTag Standard52h13: 48714 ids, data inside and outside a white border.
    AprilTagStandard52h13,
    /// ArUco 4x4, the first 50 ids.
    Aruco4x4_50,
    /// ArUco 4x4, the first 100 ids.
    Aruco4x4_100,
    /// ArUco 4x4, the first 250 ids.
    Aruco4x4_250,
    /// ArUco 4x4, all 1000 ids.
    Aruco4x4_1000,
    /// ArUco 5x5, the first 50 ids.
    Aruco5x5_50,
    /// ArUco 5x5, the first 100 ids.
    Aruco5x5_100,
    /// ArUco 5x5, the first 250 ids.
    Aruco5x5_250,
    /// ArUco 5x5, all 1000 ids.
    Aruco5x5_1000,
    /// ArUco 6x6, the first 50 ids.
    Aruco6x6_50,
    /// ArUco 6x6, the first 100 ids.
    Aruco6x6_100,
    /// ArUco 6x6, the first 250 ids.
    Aruco6x6_250,
    /// ArUco 6x6, all 1000 ids.
    Aruco6x6_1000,
    /// ArUco 7x7, the first 50 ids.
    Aruco7x7_50,
    /// ArUco 7x7, the first 100 ids.
    Aruco7x7_100,
    /// ArUco 7x7, the first 250 ids.
    Aruco7x7_250,
    /// ArUco 7x7, all 1000 ids.
    Aruco7x7_1000,
    /// The first ArUco dictionary: 1024 ids of 5x5 cells.
    ArucoOriginal,
    /// ArUco MIP_36h12: 250 ids of 6x6 cells.
    ArucoMip36h12,
    /// STag of Hamming distance 11: 22309 ids, a square with a white disc of 48 dots in it.
    StagHd11,
    /// STag of Hamming distance 13: 2884 ids, a square with a white disc of 48 dots in it.
    StagHd13,
    /// STag of Hamming distance 15: 766 ids, a square with a white disc of 48 dots in it.
    StagHd15,
    /// STag of Hamming distance 17: 157 ids, a square with a white disc of 48 dots in it.
    StagHd17,
    /// STag of Hamming distance 19: 38 ids, a square with a white disc of 48 dots in it.
    StagHd19,
    /// STag of Hamming distance 21: 12 ids, a square with a white disc of 48 dots in it.
    StagHd21,
    /// STag of Hamming distance 23: 6 ids, a square with a white disc of 48 dots in it.
    StagHd23,
    /// The three-ring marker of the thesis.
    Rings,
    /// The same marker, to be detected by the thesis' Algorithms 1-15 to the letter.
    RingsThesis,
}

impl Family {
    /// Each family in its order, with its name and the number of its ids.
    const TABLE: [(Self, &'static str, Option<u32>); 36] = [
        (Self::AprilTag16h5, "apriltag-16h5", Some(30)),
        (Self::AprilTag25h9, "apriltag-25h9", Some(35)),
        (Self::AprilTag36h10, "apriltag-36h10", Some(2320)),
        (Self::AprilTag36h11, "apriltag-36h11", Some(587)),
        (Self::AprilTagCircle21h7, "apriltag-circle21h7", Some(38)),
        (Self::AprilTagCircle49h12, "apriltag-circle49h12", Some(65535)),
        (Self::AprilTagCustom48h12, "apriltag-custom48h12", Some(42211)),
        (Self::AprilTagStandard41h12, "apriltag-standard41h12", Some(2115)),
        (Self::AprilTagStandard52h13, "apriltag-standard52h13", Some(48714)),
        (Self::Aruco4x4_50, "aruco-4x4-50", Some(50)),
        (Self::Aruco4x4_100, "aruco-4x4-100", Some(100)),
        (Self::Aruco4x4_250, "aruco-4x4-250", Some(250)),
        (Self::Aruco4x4_1000, "aruco-4x4-1000", Some(1000)),
        (Self::Aruco5x5_50, "aruco-5x5-50", Some(50)),
        (Self::Aruco5x5_100, "aruco-5x5-100", Some(100)),
        (Self::Aruco5x5_250, "aruco-5x5-250", Some(250)),
        (Self::Aruco5x5_1000, "aruco-5x5-1000", Some(1000)),
        (Self::Aruco6x6_50, "aruco-6x6-50", Some(50)),
        (Self::Aruco6x6_100, "aruco-6x6-100", Some(100)),
        (Self::Aruco6x6_250, "aruco-6x6-250", Some(250)),
        (Self::Aruco6x6_1000, "aruco-6x6-1000", Some(1000)),
        (Self::Aruco7x7_50, "aruco-7x7-50", Some(50)),
        (Self::Aruco7x7_100, "aruco-7x7-100", Some(100)),
        (Self::Aruco7x7_250, "aruco-7x7-250", Some(250)),
        (Self::Aruco7x7_1000, "aruco-7x7-1000", Some(1000)),
        (Self::ArucoOriginal, "aruco-original", Some(1024)),
        (Self::ArucoMip36h12, "aruco-mip-36h12", Some(250)),
        (Self::StagHd11, "stag-hd11", Some(22309)),
        (Self::StagHd13, "stag-hd13", Some(2884)),
        (Self::StagHd15, "stag-hd15", Some(766)),
        (Self::StagHd17, "stag-hd17", Some(157)),
        (Self::StagHd19, "stag-hd19", Some(38)),
        (Self::StagHd21, "stag-hd21", Some(12)),
        (Self::StagHd23, "stag-hd23", Some(6)),
        (Self::Rings, "rings", None),
        (Self::RingsThesis, "rings-thesis", None),
    ];

    /// Every family, in the order in which they are listed to people.
    pub const ALL: [Self; 36] = {
        let mut all = [Self::Rings; 36];
        let mut place = 0;
        while place < all.len() {
            all[place] = Self::TABLE[place].0;
            // A family finds its row by its place.
            assert!(all[place] as usize == place);
            place += 1;
        }
        all
    };

    /// The family of this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|family| family.name() == name)
    }

    /// The family's name as it is written in configuration, on the wire and on the command line.
    pub fn name(self) -> &'static str {
        Self::TABLE.get(self as usize).map_or("", |row| row.1)
    }

    /// Number of ids in the family; `None` for a family whose markers carry no id.
    pub fn id_count(self) -> Option<u32> {
        Self::TABLE.get(self as usize).and_then(|row| row.2)
    }
}

impl Family {
    /// A caution for users of this family, as a sentence; `None` for most.
    pub fn caution(self) -> Option<&'static str> {
        match self {
            Self::RingsThesis => Some(
                "`rings-thesis` is the thesis' own detection of the marker `rings`, kept for comparison: in pictures of ordinary cameras it \
                 finds few markers; land on `rings`",
            ),
            _ => None,
        }
    }
}

impl fmt::Display for Family {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One marker: its print and its size.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Marker {
    /// Its family.
    pub family: Family,
    /// Its id; `None` for a family without ids, and to stand for any id of a family.
    pub id: Option<u32>,
    /// Its size in metres (for rings the outer diameter of the outer ring); `None` when unknown, and then a
    /// detection has no pose.
    pub size_m: Option<f64>,
}

/// Why a marker's text was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MarkerError {
    /// No such family.
    #[error("marker `{text}`: there is no family `{family}`{suggestion}; known are {known}")]
    Family {
        /// The whole text.
        text: String,
        /// The family it names.
        family: String,
        /// The marker that may be meant, as a question in parentheses; empty if no name is similar.
        suggestion: String,
        /// The families there are.
        known: String,
    },
    /// An id that is not a number of the family, or text after the size.
    #[error("marker `{text}`: {problem}")]
    Id {
        /// The whole text.
        text: String,
        /// The error of the id.
        problem: String,
    },
    /// A size that is not a number within the limits.
    #[error("marker `{text}`: the size `{size}` is not a number of metres from {min} to {max}", min = Marker::SIZE_LIMITS_M.0, max = Marker::SIZE_LIMITS_M.1)]
    Size {
        /// The whole text.
        text: String,
        /// The size it states.
        size: String,
    },
}

impl Marker {
    /// The sizes a marker may have, in metres.
    pub const SIZE_LIMITS_M: (f64, f64) = (0.001, 100.0);

    /// The marker's name without its size: `family:id`, or `family` without an id.
    pub fn name(&self) -> String {
        match self.id {
            Some(id) => format!("{}:{id}", self.family),
            None => self.family.name().to_owned(),
        }
    }

    /// Whether a marker of this family and id is this marker or one of those that it stands for.
    pub fn includes(&self, family: Family, id: Option<u32>) -> bool {
        self.family == family && (self.id.is_none() || self.id == id)
    }
}

impl FromStr for Marker {
    type Err = MarkerError;

    /// Reads `FAMILY`, `FAMILY:ID` or `FAMILY:ID:SIZE_M`, where `*` is any id; for a family without ids `FAMILY` or
    /// `FAMILY:SIZE_M`.
    fn from_str(text: &str) -> Result<Self, MarkerError> {
        let mut parts = text.split(':');
        let name = parts.next().unwrap_or_default();
        let family = Family::named(name).ok_or_else(|| MarkerError::Family {
            text: text.to_owned(),
            family: name.to_owned(),
            suggestion: suggestion(text, name),
            known: Family::ALL.map(listed).join(", "),
        })?;
        let id = match family.id_count() {
            Some(count) => parts.next().map_or(Ok(None), |id| parse_id(text, id, count))?,
            None => None,
        };
        let size_m = parts.next().map(|size| parse_size(text, size)).transpose()?;
        match parts.next() {
            Some(rest) => Err(MarkerError::Id {
                text: text.to_owned(),
                problem: format!("`{rest}` follows the size, where nothing is expected"),
            }),
            None => Ok(Self { family, id, size_m }),
        }
    }
}

/// The question whether another marker is meant by `text`: one whose family differs in case and separators only, or has this name
/// in AprilTag's or OpenCV's library (`tag36h11`, `DICT_4X4_50`).
fn suggestion(text: &str, name: &str) -> String {
    let plain = |name: &str| -> String {
        let letters = name.chars().filter(char::is_ascii_alphanumeric);
        letters.map(|letter| letter.to_ascii_lowercase()).collect()
    };
    let given = plain(name);
    let given = given.strip_prefix("dict").unwrap_or(&given);
    let meant = ["", "april", "aruco"].map(|prefix| format!("{prefix}{given}"));
    let is_meant = |family: &Family| meant.contains(&plain(family.name()));
    let meant = Family::ALL.into_iter().find(is_meant);
    meant.map_or_else(String::new, |family| {
        let rest = text.get(name.len()..).unwrap_or_default();
        format!(" (did you mean `{family}{rest}`?)")
    })
}

/// A family's name in a list of all.
fn listed(family: Family) -> String {
    let use_of_it = if family.caution().is_some() { " (for comparison only)" } else { "" };
    format!("{family}{use_of_it}")
}

/// An id below `count`, or `None` for `*`.
fn parse_id(text: &str, id: &str, count: u32) -> Result<Option<u32>, MarkerError> {
    if id == "*" {
        return Ok(None);
    }
    id.parse().ok().filter(|id| *id < count).map(Some).ok_or_else(|| MarkerError::Id {
        text: text.to_owned(),
        problem: format!(
            "the id `{id}` is neither a number from 0 to {} nor `*` for any; a size follows the id",
            count - 1
        ),
    })
}

fn parse_size(text: &str, size: &str) -> Result<f64, MarkerError> {
    let (min, max) = Marker::SIZE_LIMITS_M;
    size.parse()
        .ok()
        .filter(|metres| (min..=max).contains(metres))
        .ok_or_else(|| MarkerError::Size { text: text.to_owned(), size: size.to_owned() })
}

impl fmt::Display for Marker {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.name())?;
        match self.size_m {
            Some(size_m) if self.id.is_none() && self.family.id_count().is_some() => {
                write!(f, ":*:{size_m}")
            }
            Some(size_m) => write!(f, ":{size_m}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_marker_parses_its_own_name() {
        for text in [
            "rings",
            "rings:0.15341",
            "rings-thesis:1",
            "apriltag-16h5",
            "apriltag-standard41h12:2114",
            "aruco-4x4-50:*:0.15341",
            "stag-hd23:5:2",
        ] {
            assert_eq!(text.parse::<Marker>().unwrap().to_string(), text);
        }
        assert_eq!("aruco-original:*".parse::<Marker>().unwrap().to_string(), "aruco-original");
    }

    #[test]
    fn every_family_is_found_by_its_name() {
        for family in Family::ALL {
            assert_eq!(family.name().parse::<Marker>().unwrap().family, family);
        }
    }

    #[test]
    fn only_the_family_for_comparison_has_a_caution() {
        let cautions = Family::ALL.map(Family::caution);
        assert_eq!(cautions.iter().flatten().count(), 1);
        let caution = Family::RingsThesis.caution().unwrap();
        assert!(caution.contains("kept for comparison") && caution.contains("finds few"));
        let listed = "ring".parse::<Marker>().unwrap_err().to_string();
        assert!(listed.ends_with("rings, rings-thesis (for comparison only)"), "{listed}");
    }

    #[test]
    fn a_family_that_is_written_in_another_way_is_suggested() {
        for (text, meant) in [
            ("tag36h11:7", "apriltag-36h11:7"),
            ("AprilTag-36h11:7", "apriltag-36h11:7"),
            ("tagStandard41h12:3:0.1", "apriltag-standard41h12:3:0.1"),
            ("DICT_4X4_50:1", "aruco-4x4-50:1"),
            ("DICT_APRILTAG_36h11:*:0.1", "apriltag-36h11:*:0.1"),
            ("DICT_ARUCO_MIP_36h12:1", "aruco-mip-36h12:1"),
            ("Rings", "rings"),
        ] {
            let error = text.parse::<Marker>().unwrap_err().to_string();
            assert!(error.contains(&format!("(did you mean `{meant}`?)")), "{error}");
        }
        let error = "chessboard".parse::<Marker>().unwrap_err().to_string();
        assert!(!error.contains("did you mean"), "{error}");
    }

    #[test]
    fn any_id_includes_each_and_an_id_only_itself() {
        let marker = |text: &str| text.parse::<Marker>().unwrap();
        let family = Family::AprilTag16h5;
        assert!(marker("apriltag-16h5:*:0.1").includes(family, Some(7)));
        assert!(marker("apriltag-16h5:7").includes(family, Some(7)));
        assert!(!marker("apriltag-16h5:6").includes(family, Some(7)));
        assert!(!marker("apriltag-25h9").includes(family, Some(7)));
        assert!(marker("rings").includes(Family::Rings, None));
    }

    #[test]
    fn invalid_markers_are_refused_with_the_reason() {
        let problem = |text: &str| text.parse::<Marker>().unwrap_err().to_string();
        assert!(problem("ring").contains("known are apriltag-16h5, "));
        assert!(problem("rings:zero").contains("`zero` is not a number of metres"));
        assert!(problem("rings:0").contains("from 0.001 to 100"));
        assert!(problem("rings:NaN").contains("NaN"));
        assert!(problem("rings:1:2").contains("`2` follows the size"));
        assert!(problem("apriltag-16h5:30").contains("from 0 to 29"));
        assert!(problem("apriltag-16h5:0.15").contains("a size follows the id"));
        assert!(problem("apriltag-16h5:1:0.15:2").contains("`2` follows the size"));
    }
}
