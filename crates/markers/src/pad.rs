//! Defines a pad: several markers in known positions around one landing point.
//!
//! A pad is described in TOML, positions in metres from the landing point on the printed face (x right, y up):
//!
//! ```toml
//! id = 0                  # the pad is named `pad:0` wherever a marker is named
//! tolerance_m = 0.0005    # standard deviation of the markers' positions on the sheet
//!
//! [[markers]]
//! marker = "apriltag-36h11:3:0.15"
//! x_m = -0.1
//! y_m = 0.0
//! quarter_turns = 0       # counter-clockwise, as seen by a reader of the sheet
//! ```

use std::ops::RangeInclusive;
use std::str::FromStr;

use serde::Deserialize;

use crate::drawing::{Drawing, Ink, Layer, Shape};
use crate::marker::Marker;
use crate::square_code::SquareCode;

/// Markers in known positions around one landing point, the origin of the pad's frame.
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
    pub position_m: [f64; 2],
    /// Its rotation counter-clockwise, in quarters of a turn, from 0 to 3.
    pub quarter_turns: u8,
}

/// Why a pad's description was refused.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PadError {
    /// Neither the name of a built-in pad nor a file of text.
    #[error("pad `{name}`: {problem} (built in: {known})")]
    Unreadable {
        /// The name.
        name: String,
        /// Why it cannot be read.
        problem: String,
        /// The built-in pads.
        known: String,
    },
    /// A file with a wrong description.
    #[error("pad `{name}`: {problem}")]
    Described {
        /// The file's name.
        name: String,
        /// The error.
        problem: Box<PadError>,
    },
    /// Not TOML, or not a description of a pad.
    #[error("{0}")]
    Toml(String),
    /// A number outside its limits.
    #[error("`{key}` = {value}, but it must be from {min} to {max}")]
    Range {
        /// Which number.
        key: String,
        /// Its value.
        value: f64,
        /// Its minimum.
        min: f64,
        /// Its maximum.
        max: f64,
    },
    /// A marker that cannot be part of a pad.
    #[error("marker {number}, `{text}`: {problem}")]
    Marker {
        /// Its place in the list, from 1.
        number: usize,
        /// Its text.
        text: String,
        /// Its error.
        problem: String,
    },
    /// Two pads of one name.
    #[error("two pads are called `{name}`; give one another `id`")]
    SameName {
        /// Their name.
        name: String,
    },
    /// A marker of a pad that may be seen elsewhere. An image of it does not show where the pad is.
    #[error("the marker `{marker}` of `{pad}` is also {elsewhere}")]
    Shared {
        /// The pad's name.
        pad: String,
        /// Its marker.
        marker: Marker,
        /// The other pad or list, and the remedy.
        elsewhere: String,
    },
}

/// The built-in pads: name and description.
const BUILT_IN: [(&str, &str); 1] = [("a4", include_str!("../pads/a4.toml"))];
/// Largest distance of a marker from the landing point along each axis, in metres.
const MAX_OFFSET_M: f64 = 10.0;
/// Largest tolerance of the markers' positions, in metres.
const MAX_TOLERANCE_M: f64 = 0.05;
/// Tolerance of markers printed on one sheet, in metres; used where a description names none.
const PRINTED_TOLERANCE_M: f64 = 0.0005;
/// Overlaps up to this are rounding, in metres.
const ROUNDING_M: f64 = 1e-6;
/// Largest number of markers on a pad.
const MAX_MARKERS: usize = 32;

impl Pad {
    /// The name of the family under which pads are reported next to markers.
    pub const FAMILY: &'static str = "pad";

    /// The built-in pad of this name in upper or lower case, or the one that the file of this name describes; `read` reads files.
    ///
    /// # Errors
    /// [`PadError`] with the name, when there is no such pad or its description is wrong.
    pub fn named<E: std::fmt::Display>(
        name: &str,
        read: impl FnOnce(&str) -> Result<String, E>,
    ) -> Result<Self, PadError> {
        let text = match BUILT_IN.iter().find(|(known, _)| known.eq_ignore_ascii_case(name)) {
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

    /// Its number; its name is `pad:` and this.
    pub fn id(&self) -> u32 {
        self.id
    }

    /// Its name, used like that of a marker: `pad:ID`.
    pub fn name(&self) -> String {
        format!("{}:{}", Self::FAMILY, self.id)
    }

    /// Standard deviation of its markers' positions, in metres.
    pub fn tolerance_m(&self) -> f64 {
        self.tolerance_m
    }

    /// Its markers, in the order in which they are printed.
    pub fn markers(&self) -> &[PlacedMarker] {
        &self.markers
    }

    /// Checks that pads can be distinguished in an image.
    ///
    /// # Errors
    /// [`PadError`] when two have one name, or a marker that looks the same.
    pub fn check_together(pads: &[Self]) -> Result<(), PadError> {
        for (i, pad) in pads.iter().enumerate() {
            for other in &pads[..i] {
                if other.id == pad.id {
                    return Err(PadError::SameName { name: pad.name() });
                }
                for PlacedMarker { marker, .. } in &pad.markers {
                    if let Some(same) = other.markers.iter().find(|it| it.marker.looks_like(marker))
                    {
                        return Err(PadError::Shared {
                            pad: pad.name(),
                            marker: *marker,
                            elsewhere: format!(
                                "on `{}`, as `{}`, and one image of it does not show which pad it is; give one of them another marker",
                                other.name(),
                                same.marker
                            ),
                        });
                    }
                }
            }
        }
        Ok(())
    }

    /// Adds its markers to a list of markers to detect, without duplicates.
    ///
    /// # Errors
    /// [`PadError::Shared`] when one is listed with another size or without one: its distance, and so the pad's, would be wrong or
    /// unknown; or when its print is listed under another name, under which alone it would be found.
    pub fn add_markers(&self, markers: &mut Vec<Marker>) -> Result<(), PadError> {
        for PlacedMarker { marker, .. } in &self.markers {
            let mut is_listed = false;
            for listed in markers.iter() {
                if let Some(elsewhere) = marker.conflict(listed) {
                    return Err(PadError::Shared { pad: self.name(), marker: *marker, elsewhere });
                }
                is_listed |= listed.family == marker.family && listed.id == marker.id;
            }
            if !is_listed {
                markers.push(*marker);
            }
        }
        Ok(())
    }

    /// The minimum and maximum coordinates of its markers with their quiet zones, in metres from the landing point (right, up);
    /// `None` for an id that cannot be drawn.
    pub fn bounds_m(&self) -> Option<[[f64; 2]; 2]> {
        let mut bounds = [[f64::INFINITY; 2], [f64::NEG_INFINITY; 2]];
        for placed in &self.markers {
            let [_, quiet_m] = placed.reaches_m()?;
            for (axis, at_m) in placed.position_m.into_iter().enumerate() {
                bounds[0][axis] = bounds[0][axis].min(at_m - quiet_m);
                bounds[1][axis] = bounds[1][axis].max(at_m + quiet_m);
            }
        }
        Some(bounds)
    }

    /// All its markers, each on white paper of its quiet zone, later ones over earlier ones; `None` for an id that cannot
    /// be drawn.
    pub fn drawing(&self) -> Option<Drawing> {
        let mut whole = Drawing { half_extent_m: 0.0, layers: Vec::new() };
        for placed in &self.markers {
            let drawing = Drawing::new(&placed.marker, placed.size_m)?;
            let half_m = drawing.half_extent_m;
            let paper = Shape::Rectangle { min_m: [-half_m; 2], max_m: [half_m; 2] };
            let paper = Layer { shape: paper, ink: Ink::White };
            let layers = std::iter::once(&paper).chain(&drawing.layers);
            whole.layers.extend(layers.map(|layer| placed.on_pad(layer)));
            let [x, y] = placed.position_m.map(f64::abs);
            whole.half_extent_m = whole.half_extent_m.max(x.max(y) + half_m);
        }
        Some(whole)
    }
}

impl Marker {
    /// The other entry as which this marker of a pad is listed, and the remedy; `None` where the list may have both.
    fn conflict(&self, listed: &Self) -> Option<String> {
        let has_any_id = listed.id.is_none() && self.id.is_some();
        if self.family == listed.family {
            let is_other_size = self.id == listed.id && self.size_m != listed.size_m;
            return is_other_size.then(|| {
                format!("listed as `{listed}`, and its size must be one and the same; take it out of the list of markers")
            });
        }
        // Dictionaries that share prints number them alike.
        let same = Self { id: listed.id.or(self.id), ..*listed };
        self.looks_like(&same).then(|| match has_any_id {
            true => format!(
                "listed as `{listed}`, where its print is `{}`; list the ids that are needed instead of all, or give it that name in the pad",
                same.name()
            ),
            false => format!(
                "listed as `{listed}`, which is the same print by another name; take it out of the list of markers"
            ),
        })
    }
}

impl PlacedMarker {
    /// The position on the pad of a point of the marker.
    pub fn position_on_pad(&self, [x, y]: [f64; 2]) -> [f64; 2] {
        let [right, up] = match self.quarter_turns {
            0 => [x, y],
            1 => [-y, x],
            2 => [-x, -y],
            _ => [y, -x],
        };
        [self.position_m[0] + right, self.position_m[1] + up]
    }

    /// How far from its centre its print reaches along each axis, and how far its quiet zone, in metres.
    fn reaches_m(&self) -> Option<[f64; 2]> {
        let drawing = Drawing::new(&self.marker, self.size_m)?;
        let farthest = |m: f64, [x, y]: [f64; 2]| m.max(x.abs()).max(y.abs());
        let printed_m = drawing.layers.iter().fold(0.0, |m: f64, layer| match layer.shape {
            Shape::Disc { centre_m: [x, y], radius_m } => m.max(x.abs().max(y.abs()) + radius_m),
            Shape::Rectangle { min_m, max_m } => farthest(farthest(m, min_m), max_m),
        });
        Some([printed_m, drawing.half_extent_m])
    }

    /// How far from its centre the square reaches that its code leaves free, in metres.
    fn free_m(&self) -> f64 {
        SquareCode::for_family(self.marker.family).map_or(0.0, |code| {
            self.size_m * f64::from(code.free_cells()) / (2.0 * f64::from(code.cells))
        })
    }

    /// Why it cannot be printed after another one: the print of one covers the other or its quiet zone, and it does not lie in
    /// that one's free centre.
    fn overlap(&self, other: &Self) -> Option<String> {
        let [printed_m, quiet_m] = self.reaches_m()?;
        let [other_printed_m, other_quiet_m] = other.reaches_m()?;
        let [x, y] = [0, 1].map(|i| (self.position_m[i] - other.position_m[i]).abs());
        let away_m = x.max(y);
        let overlap_m = (printed_m + other_quiet_m).max(quiet_m + other_printed_m) - away_m;
        let outside_m = away_m + quiet_m - other.free_m();
        if overlap_m <= ROUNDING_M || outside_m <= ROUNDING_M {
            return None;
        }
        let other_name = other.marker;
        if away_m + other_quiet_m <= self.free_m() + ROUNDING_M {
            return Some(format!(
                "it would cover `{other_name}`, which is in its free centre; name that one after it"
            ));
        }
        let inside = match other.free_m() > 0.0 {
            true => format!(", and reaches out of its free centre by {outside_m:.4} m"),
            false => String::new(),
        };
        Some(format!(
            "it overlaps `{other_name}` by {overlap_m:.4} m, the quiet zone included{inside}; move one of them"
        ))
    }

    fn on_pad(&self, layer: &Layer) -> Layer {
        let shape = match layer.shape {
            Shape::Disc { centre_m, radius_m } => {
                Shape::Disc { centre_m: self.position_on_pad(centre_m), radius_m }
            }
            Shape::Rectangle { min_m, max_m } => {
                let (a, b) = (self.position_on_pad(min_m), self.position_on_pad(max_m));
                Shape::Rectangle {
                    min_m: [a[0].min(b[0]), a[1].min(b[1])],
                    max_m: [a[0].max(b[0]), a[1].max(b[1])],
                }
            }
        };
        Layer { shape, ink: layer.ink }
    }
}

/// A pad as described in TOML.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Description {
    id: u32,
    tolerance_m: Option<f64>,
    markers: Vec<Placed>,
}

/// A marker of a pad as described in TOML.
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

impl FromStr for Pad {
    type Err = PadError;

    /// Reads a description in TOML, as at the head of this module.
    fn from_str(text: &str) -> Result<Self, PadError> {
        let described: Description =
            toml::from_str(text).map_err(|e| PadError::Toml(e.to_string()))?;
        let tolerance_m = described.tolerance_m.unwrap_or(PRINTED_TOLERANCE_M);
        within("tolerance_m", tolerance_m, 0.0..=MAX_TOLERANCE_M)?;
        within("number of markers", described.markers.len() as f64, 1.0..=MAX_MARKERS as f64)?;
        let mut markers: Vec<PlacedMarker> = Vec::with_capacity(described.markers.len());
        for (i, placed) in described.markers.iter().enumerate() {
            let number = i + 1;
            within(&format!("x_m of marker {number}"), placed.x_m, -MAX_OFFSET_M..=MAX_OFFSET_M)?;
            within(&format!("y_m of marker {number}"), placed.y_m, -MAX_OFFSET_M..=MAX_OFFSET_M)?;
            let turns = f64::from(placed.quarter_turns);
            within(&format!("quarter_turns of marker {number}"), turns, 0.0..=3.0)?;
            let text = &placed.marker;
            let refused = |problem| PadError::Marker { number, text: text.clone(), problem };
            let placed = placed.checked(&markers).map_err(refused)?;
            if let Some(problem) = markers.iter().find_map(|before| placed.overlap(before)) {
                return Err(refused(problem));
            }
            markers.push(placed);
        }
        Ok(Self { id: described.id, tolerance_m, markers })
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
        if let Some(same) = before.iter().find(|it| it.marker.looks_like(&marker)) {
            return Err(format!(
                "it is on the pad twice, first as `{}`, and the two could not be distinguished in an image",
                same.marker
            ));
        }
        let position_m = [self.x_m, self.y_m];
        Ok(PlacedMarker { marker, size_m, position_m, quarter_turns: self.quarter_turns })
    }
}

fn within(key: &str, value: f64, bounds: RangeInclusive<f64>) -> Result<(), PadError> {
    let (min, max) = (*bounds.start(), *bounds.end());
    match bounds.contains(&value) {
        true => Ok(()),
        false => Err(PadError::Range { key: key.to_owned(), value, min, max }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wrong_descriptions_are_refused_with_the_reason() {
        let problem = |text: &str| text.parse::<Pad>().unwrap_err().to_string();
        let check = |text: &str, part: &str| {
            let problem = problem(text);
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check("id = 1\nmarkers = []", "from 1 to 32");
        check(
            "id = 1\nmarkers = [{ marker = \"rings\" }]",
            "marker 1, `rings`: a marker of a pad needs a size",
        );
        check("id = 1\nmarkers = [{ marker = \"apriltag-16h5:*:0.1\" }]", "needs an id");
        check(
            "id = 1\nmarkers = [{ marker = \"rings:0.1\" }, { marker = \"rings:0.2\" }]",
            "twice",
        );
        for (one, other) in
            [("aruco-4x4-50:1:0.06", "aruco-4x4-250:1:0.1"), ("rings:0.06", "rings-thesis:0.1")]
        {
            let text = format!("[{{ marker = \"{one}\" }}, {{ marker = \"{other}\", x_m = 0.3 }}]");
            check(&format!("id = 1\nmarkers = {text}"), &format!("twice, first as `{one}`"));
        }
        check("id = 1\nmarkers = [{ marker = \"rings:0.1\", x_m = 11 }]", "from -10 to 10");
        check("id = 1\nmarkers = [{ marker = \"rings:0.1\", x_m = nan }]", "x_m of marker 1");
        check("id = 1\nmarkers = [{ marker = \"rings:0.1\", quarter_turns = 4 }]", "from 0 to 3");
        check("id = 1\ntolerance_m = 1\nmarkers = [{ marker = \"rings:0.1\" }]", "tolerance_m");
        check("markers = [{ marker = \"rings:0.1\" }]", "missing field `id`");
        check("id = 1\nsize = 3\nmarkers = []", "unknown field `size`");
        let pair =
            |one: &str, other: &str| format!("id = 1\nmarkers = [{{ {one} }}, {{ {other} }}]");
        let large = "marker = \"apriltag-36h11:7:0.15\", y_m = 0.1";
        let small = "marker = \"aruco-4x4-50:1:0.06\"";
        // The tag's paper reaches down to 0.1 - 0.09375, the ArUco marker up to 0.03.
        let text = "marker 2, `aruco-4x4-50:1:0.06`: it overlaps `apriltag-36h11:7:0.15` by 0.023";
        check(&pair(large, small), text);
        check(&pair(small, "marker = \"rings:0.05\""), "overlaps `aruco-4x4-50:1:0.06`");
        let hollow = "marker = \"apriltag-custom48h12:0:0.099\"";
        let inside = |size: &str| format!("marker = \"aruco-4x4-50:0:{size}\"");
        check(&pair(hollow, &inside("0.026")), "out of its free centre by 0.0008 m");
        let aside = format!("{}, x_m = 0.002", inside("0.024"));
        check(&pair(hollow, &aside), "out of its free centre by 0.0015 m");
        check(&pair(&inside("0.024"), hollow), "name that one after it");
        let of_case = |name: &str| Pad::named(name, |_| Err("there is no such file")).unwrap();
        assert_eq!(of_case("A4").name(), of_case("a4").name());
        let missing = Pad::named("no/such.toml", |_| Err("there is no such file"));
        let missing = missing.unwrap_err().to_string();
        assert!(missing.contains("no/such.toml") && missing.contains("a4"), "{missing}");
    }

    #[test]
    fn a_marker_has_one_size_and_one_pad() {
        let pad = |id: u32, marker: &str| -> Pad {
            format!("id = {id}\nmarkers = [{{ marker = \"{marker}\" }}]").parse().unwrap()
        };
        let with = |listed: &str, on_pad: &str| {
            let mut markers: Vec<Marker> = vec![listed.parse().unwrap()];
            pad(1, on_pad).add_markers(&mut markers).map(|()| markers.len())
        };
        assert_eq!(with("rings:0.1", "rings:0.1"), Ok(1));
        assert_eq!(with("apriltag-36h11:*:0.2", "apriltag-36h11:7:0.15"), Ok(2));
        for listed in ["apriltag-36h11:7:0.2", "apriltag-36h11:7"] {
            let problem = with(listed, "apriltag-36h11:7:0.15").unwrap_err().to_string();
            assert!(problem.contains(&format!("listed as `{listed}`")), "{problem}");
        }
        // One print by another name is found by one of the names only.
        assert_eq!(with("aruco-4x4-50:*:0.1", "aruco-4x4-250:60:0.08"), Ok(2));
        assert_eq!(with("aruco-4x4-250:3:0.1", "aruco-4x4-50:2:0.08"), Ok(2));
        for (listed, on_pad, part) in [
            ("aruco-4x4-250:2:0.08", "aruco-4x4-50:2:0.08", "by another name; take it out"),
            ("aruco-4x4-250:2", "aruco-4x4-50:2:0.08", "by another name; take it out"),
            ("aruco-4x4-250:*:0.1", "aruco-4x4-50:2:0.08", "its print is `aruco-4x4-250:2`"),
            ("aruco-4x4-50", "aruco-4x4-250:2:0.08", "its print is `aruco-4x4-50:2`"),
            ("rings-thesis:0.1", "rings:0.1", "by another name; take it out"),
        ] {
            let problem = with(listed, on_pad).unwrap_err().to_string();
            assert!(problem.contains(&format!("listed as `{listed}")), "{problem}");
            assert!(problem.contains(part), "{problem}");
        }
        let together = |pads: [Pad; 2]| Pad::check_together(&pads).map_err(|e| e.to_string());
        assert!(together([pad(1, "rings:0.1"), pad(2, "aruco-4x4-50:0:0.1")]).is_ok());
        for other in ["aruco-4x4-50:0:0.1", "aruco-4x4-100:0:0.2"] {
            let problem = together([pad(1, other), pad(2, "aruco-4x4-50:0:0.1")]).unwrap_err();
            assert!(problem.contains(&format!("on `pad:1`, as `{other}`")), "{problem}");
        }
        let same_name = together([pad(1, "rings:0.1"), pad(1, "aruco-4x4-50:0:0.1")]);
        assert!(same_name.unwrap_err().contains("two pads are called `pad:1`"));
    }

    #[test]
    fn markers_may_share_their_quiet_zones_and_lie_in_a_free_centre() {
        let hollow = "apriltag-custom48h12:0:0.099";
        for (one, other, aside) in [
            (hollow, "aruco-4x4-50:0:0.024", ""),
            ("apriltag-36h11:7:0.15", "aruco-4x4-50:1:0.06", ", y_m = -0.12375"),
            ("apriltag-36h11:7:0.15", "aruco-4x4-50:1:0.06", ", x_m = 0.13, y_m = 0.05"),
            ("rings:0.1", "stag-hd21:5:0.05", ", x_m = 0.1"),
        ] {
            let markers = format!("{{ marker = \"{one}\" }}, {{ marker = \"{other}\"{aside} }}");
            let pad = format!("id = 1\nmarkers = [{markers}]").parse::<Pad>();
            assert!(pad.is_ok(), "{pad:?}");
        }
    }

    #[test]
    fn a_pad_is_as_large_as_its_markers_with_their_quiet_zones() {
        let markers = "[{ marker = \"apriltag-36h11:7:0.08\", x_m = 0.01, y_m = 0.05 }, { marker = \"rings:0.05\", y_m = -0.06 }]";
        let pad: Pad = format!("id = 1\nmarkers = {markers}").parse().unwrap();
        // A tag of 8 cells has a quiet zone of one cell, rings one of a tenth.
        let expected = [[-0.04, -0.09], [0.06, 0.1]];
        let bounds = pad.bounds_m().unwrap();
        let pairs = bounds.as_flattened().iter().zip(expected.as_flattened());
        assert!(pairs.into_iter().all(|(a, b)| (a - b).abs() < 1e-9), "{bounds:?}");
    }

    #[test]
    fn the_example_of_the_manual_is_valid() {
        let text = include_str!("../../../docs/pads.md");
        let example = text.split("```toml").nth(1).and_then(|rest| rest.split("```").next());
        let pad = example.unwrap().parse::<Pad>();
        assert!(pad.is_ok(), "{pad:?}");
    }
}
