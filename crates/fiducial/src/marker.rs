//! What is looked for: a marker's family, id and size, written `family:id:size`.

use std::fmt;
use std::str::FromStr;

/// A marker family.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash)]
pub enum Family {
    /// The three-ring marker of the thesis, found by the detector of Algorithms 1-15 with its three faults mended.
    Rings,
    /// The same marker, found by Algorithms 1-15 to the letter.
    RingsThesis,
}

impl Family {
    /// Every family, in the order in which they are listed to people.
    pub const ALL: [Self; 2] = [Self::Rings, Self::RingsThesis];

    /// The family's name as it is written in configuration, on the wire and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rings => "rings",
            Self::RingsThesis => "rings-thesis",
        }
    }

    /// Number of ids in the family; `None` for a family whose markers carry no id.
    pub fn id_count(self) -> Option<u32> {
        match self {
            Self::Rings | Self::RingsThesis => None,
        }
    }
}

impl fmt::Display for Family {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// One marker: what is printed, and how large.
#[derive(Copy, Clone, Debug, PartialEq)]
pub struct Marker {
    /// Its family.
    pub family: Family,
    /// Its id; `None` for families without ids.
    pub id: Option<u32>,
    /// Its size in metres (for rings the outer diameter of the outer ring); `None` when unknown, and then a
    /// detection has no pose.
    pub size_m: Option<f64>,
}

/// Why a marker's text was refused.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum MarkerError {
    /// No such family.
    #[error("marker `{text}`: there is no family `{family}`; known are {known}")]
    Family {
        /// The whole text.
        text: String,
        /// The family it names.
        family: String,
        /// The families there are.
        known: String,
    },
    /// An id that is missing, superfluous, no number, or outside the family.
    #[error("marker `{text}`: {problem}")]
    Id {
        /// The whole text.
        text: String,
        /// What is wrong with the id.
        problem: String,
    },
    /// A size that is no number or outside the limits.
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

    /// The marker's name without its size: `family` or `family:id`.
    pub fn name(&self) -> String {
        match self.id {
            Some(id) => format!("{}:{id}", self.family),
            None => self.family.name().to_owned(),
        }
    }
}

impl FromStr for Marker {
    type Err = MarkerError;

    /// Reads `FAMILY:ID[:SIZE_M]`, and `FAMILY[:SIZE_M]` for a family without ids.
    fn from_str(text: &str) -> Result<Self, MarkerError> {
        let mut parts = text.split(':');
        let family_name = parts.next().unwrap_or_default();
        let family =
            Family::ALL.into_iter().find(|f| f.name() == family_name).ok_or_else(|| {
                MarkerError::Family {
                    text: text.to_owned(),
                    family: family_name.to_owned(),
                    known: Family::ALL.map(Family::name).join(", "),
                }
            })?;
        let id_error = |problem: String| MarkerError::Id { text: text.to_owned(), problem };
        let id = match family.id_count() {
            None => None,
            Some(count) => {
                let id = parts.next().ok_or_else(|| {
                    id_error(format!("{family} needs an id from 0 to {}", count - 1))
                })?;
                let id = id.parse().ok().filter(|id| *id < count).ok_or_else(|| {
                    id_error(format!("the id `{id}` is not a number from 0 to {}", count - 1))
                })?;
                Some(id)
            }
        };
        let size_m = parts.next().map(|size| parse_size(text, size)).transpose()?;
        match parts.next() {
            Some(rest) => {
                Err(id_error(format!("`{rest}` follows the size, where nothing is expected")))
            }
            None => Ok(Self { family, id, size_m }),
        }
    }
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
            Some(size_m) => write!(f, ":{size_m}"),
            None => Ok(()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_marker_reads_back_what_it_prints() {
        for text in ["rings", "rings:0.15341", "rings-thesis:1"] {
            assert_eq!(text.parse::<Marker>().unwrap().to_string(), text);
        }
    }

    #[test]
    fn wrong_markers_say_what_is_wrong() {
        let problem = |text: &str| text.parse::<Marker>().unwrap_err().to_string();
        assert!(problem("ring").contains("known are rings, rings-thesis"));
        assert!(problem("rings:nought").contains("`nought` is not a number of metres"));
        assert!(problem("rings:0").contains("from 0.001 to 100"));
        assert!(problem("rings:NaN").contains("NaN"));
        assert!(problem("rings:1:2").contains("`2` follows the size"));
    }
}
