//! The detector's configuration, `detector.toml`: markers, pads, input, tracking, thoroughness, the camera's response; its
//! checks, and changes of it while the service runs.

use fiducial::{Detector, ResponseSetting, TrackingSettings};
use markers::{Family, Marker, Pad};
use messages::Place;
use node::{Check, Settings, read_text};
use serde::{Deserialize, Serialize};

/// The keys of `detector.toml`; meanings, units and ranges are described there.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this detector.
    pub id: String,
    /// Where it runs.
    pub place: Place,
    /// Name of the camera.
    pub camera: String,
    /// Which of its frames are taken.
    pub input: Input,
    /// Markers to look for.
    pub markers: Vec<String>,
    /// Pads whose markers are solved together.
    pub pads: Vec<String>,
    /// Detections with a lower confidence are not published.
    pub min_confidence: f64,
    /// Whether markers printed white on black are looked for as well.
    pub inverted: bool,
    /// Whether damaged markers are looked for where others were found, too.
    pub thorough: bool,
    /// How the camera shows light.
    pub response: String,
    /// Threshold of `rings-thesis`, in grey levels.
    pub thesis_threshold: u8,
    /// Quality of the debug images.
    pub debug_jpeg_quality: u8,
    /// Whether and how markers are followed.
    pub tracking: TrackingConfig,
}

/// Which frames are taken.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Input {
    /// Pixels as they are.
    Raw,
    /// JPEG files.
    Jpeg,
}

/// Whether and how markers are followed from frame to frame.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[serde(deny_unknown_fields)]
pub struct TrackingConfig {
    /// Whether they are.
    pub enabled: bool,
    /// The whole frame is searched in every frame of this number.
    pub full_search_period: u32,
}

/// The default list of markers.
const DEFAULT_MARKERS: [&str; 1] = ["rings:0.15341"];

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../detector.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.name("camera", &self.camera);
        check.parses("pads", self.parsed_pads());
        check.parses("response", self.response());
        check.parses("markers", self.detector());
        check.range("min_confidence", self.min_confidence, 0.0..=1.0);
        check.range("thesis_threshold", self.thesis_threshold, 1..=255);
        check.range("debug_jpeg_quality", self.debug_jpeg_quality, 1..=100);
        check.range("tracking.full_search_period", self.tracking.full_search_period, 1..=1000);
    }
}

impl Config {
    /// A detector as configured.
    ///
    /// # Errors
    /// States which marker is wrong and why.
    pub fn detector(&self) -> Result<Detector, String> {
        let mut markers = self.listed_markers()?;
        for pad in self.parsed_pads()? {
            pad.add_markers(&mut markers).map_err(|error| error.to_string())?;
        }
        if markers.is_empty() {
            return Err(
                "at least one marker is needed, for example \"rings:0.15341\", or a pad".to_owned()
            );
        }
        let Self { thesis_threshold, inverted, thorough, .. } = *self;
        let response = self.response()?;
        let settings = fiducial::Settings { thesis_threshold, inverted, thorough, response };
        Detector::new(&markers, settings).map_err(|error| error.to_string())
    }

    /// How the camera shows light.
    ///
    /// # Errors
    /// States the form of a response.
    pub fn response(&self) -> Result<ResponseSetting, String> {
        self.response.parse()
    }

    /// How markers are tracked; when they are not, each frame is searched completely.
    pub fn tracking(&self) -> TrackingSettings {
        let TrackingConfig { enabled, full_search_period } = self.tracking;
        TrackingSettings { full_search_period: if enabled { full_search_period } else { 1 } }
    }

    /// This configuration with one setting changed while the service runs.
    ///
    /// # Errors
    /// States why the setting is refused.
    pub fn with(&self, key: &str, value: &str) -> Result<Self, String> {
        let changed = node::changed(self, &format!("{key}={value}"));
        let changed = changed.map_err(|error| error.to_string())?;
        // The keys by which other services identify this detector and its frames.
        for (name, before, after) in [
            ("id", self.id.as_str(), changed.id.as_str()),
            ("place", self.place.name(), changed.place.name()),
            ("camera", &self.camera, &changed.camera),
        ] {
            if before != after {
                return Err(format!(
                    "`{name}` holds from start to end; start the detector again with `--set {name}={after}`"
                ));
            }
        }
        if self.input != changed.input {
            return Err("`input` holds from start to end; start another detector".to_owned());
        }
        Ok(changed)
    }

    /// The pads, read from their files.
    ///
    /// # Errors
    /// States which pad is wrong and why, or which file cannot be read.
    pub fn parsed_pads(&self) -> Result<Vec<Pad>, String> {
        let read = |name: &String| Pad::named(name, |file| read_text(file));
        let pads: Vec<Pad> =
            self.pads.iter().map(read).collect::<Result<_, _>>().map_err(|e| e.to_string())?;
        Pad::check_together(&pads).map_err(|e| e.to_string())?;
        Ok(pads)
    }

    /// The markers of the list. Where that is the default one, it gives way to a pad with the same marker in the pad's size.
    ///
    /// # Errors
    /// States which marker or pad is wrong and why.
    pub fn listed_markers(&self) -> Result<Vec<Marker>, String> {
        let mut markers = self.parsed_markers()?;
        if self.markers == DEFAULT_MARKERS {
            let pads = self.parsed_pads()?;
            let is_on_pad = |marker: &Marker| {
                pads.iter().flat_map(Pad::markers).any(|it| it.marker.looks_like(marker))
            };
            markers.retain(|marker| !is_on_pad(marker));
        }
        Ok(markers)
    }

    /// The names of the searched markers: those of the list, then the pads.
    ///
    /// # Errors
    /// As [`Config::listed_markers`].
    pub fn looked_for(&self) -> Result<Vec<String>, String> {
        let mut names: Vec<String> = self.listed_markers()?.iter().map(Marker::to_string).collect();
        names.extend(self.parsed_pads()?.iter().map(Pad::name));
        Ok(names)
    }

    /// Warnings about the searched families, in sentences.
    ///
    /// # Errors
    /// As [`Config::listed_markers`].
    pub fn cautions(&self) -> Result<Vec<&'static str>, String> {
        let (listed, pads) = (self.listed_markers()?, self.parsed_pads()?);
        let on_pads = pads.iter().flat_map(Pad::markers).map(|placed| placed.marker.family);
        let families = listed.iter().map(|marker| marker.family).chain(on_pads);
        let mut cautions: Vec<_> = families.filter_map(Family::caution).collect();
        cautions.dedup();
        Ok(cautions)
    }

    fn parsed_markers(&self) -> Result<Vec<Marker>, String> {
        self.markers.iter().map(|text| text.parse().map_err(|e| format!("{e}"))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::Layers;

    fn load(set: &str) -> Result<Config, String> {
        let set = if set.is_empty() { Vec::new() } else { vec![set.to_owned()] };
        Layers { file: None, set }.load().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn the_defaults_are_complete_and_wrong_markers_are_refused() {
        assert_eq!(load("").unwrap().markers, DEFAULT_MARKERS);
        assert!(load("markers=[\"hexagons:1\"]").unwrap_err().contains("no family `hexagons`"));
        assert!(load("markers=[]").unwrap_err().contains("at least one marker"));
        let twice = "markers=[\"rings:0.1\", \"rings:0.2\"]";
        assert!(load(twice).unwrap_err().contains("listed twice"));
        assert!(load("response=bright").unwrap_err().contains("srgb"));
        assert!(load("thesis_threshold=0").unwrap_err().contains("from 1 to 255"));
        // A number that does not fit its type is refused too, independently of its range.
        assert!(load("thesis_threshold=300").is_err());
    }

    #[test]
    fn a_pads_marker_has_the_pads_size() {
        let folder = tempfile::tempdir().unwrap();
        let pad = |id: u32, marker: &str| {
            let file = folder.path().join(format!("{id}.toml"));
            let text = format!("id = {id}\nmarkers = [{{ marker = \"{marker}\" }}]");
            std::fs::write(&file, text).unwrap();
            format!("{file:?}")
        };
        let rings = pad(1, "rings:0.3");
        // The default list gives way to the pad, one of the user's own is refused.
        let config = load(&format!("pads=[{rings}]")).unwrap();
        assert_eq!(config.looked_for(), Ok(vec!["pad:1".to_owned()]));
        assert!(config.detector().is_ok());
        let refused = |key: &str, value: &str| config.with(key, value).unwrap_err();
        assert!(refused("markers", "[\"rings:0.2\"]").contains("listed as `rings:0.2`"));
        assert!(refused("markers", "[\"rings\"]").contains("listed as `rings`"));
        let both = config.with("markers", "[\"rings:0.3\"]").unwrap();
        assert_eq!(both.looked_for(), Ok(vec!["rings:0.3".to_owned(), "pad:1".to_owned()]));
        let two = [pad(2, "aruco-4x4-50:0:0.1"), pad(3, "aruco-4x4-50:0:0.1")].join(",");
        assert!(refused("pads", &format!("[{two}]")).contains("`aruco-4x4-50:0:0.1` of `pad:3`"));
    }

    #[test]
    fn several_families_are_looked_for_at_once() {
        let all = "markers=[\"rings:0.15341\", \"apriltag-36h11:*:0.1\", \"aruco-4x4-50:7:0.2\"]";
        let markers = load(all).unwrap().parsed_markers().unwrap();
        assert_eq!(markers.iter().map(|m| m.id).collect::<Vec<_>>(), [None, None, Some(7)]);
    }

    #[test]
    fn a_family_for_comparison_is_cautioned_of_once() {
        let cautions = |set: &str| load(set).unwrap().cautions().unwrap();
        assert!(cautions("").is_empty());
        let warnings = cautions("markers=[\"rings-thesis:0.15341\", \"rings:0.15341\"]");
        assert!(
            matches!(warnings[..], [text] if text.contains("kept for comparison")),
            "{warnings:?}"
        );
    }

    #[test]
    fn settings_change_while_it_runs_but_for_names() {
        let config = load("").unwrap();
        let changed = config.with("markers", "[\"aruco-4x4-50:7:0.2\"]").unwrap();
        assert_eq!(changed.markers, ["aruco-4x4-50:7:0.2"]);
        let changed = changed.with("tracking.enabled", "true").unwrap();
        assert!(changed.tracking().full_search_period > 1 && changed.markers.len() == 1);
        assert!(config.inverted && !config.thorough);
        let changed = changed.with("inverted", "false").unwrap().with("thorough", "true").unwrap();
        assert!(!changed.inverted && changed.thorough && changed.detector().is_ok());
        let changed = changed.with("response", "\"1.1,0.5\"").unwrap();
        assert!(matches!(changed.response(), Ok(ResponseSetting::Known(_))));
        let refused = |key, value| config.with(key, value).unwrap_err();
        assert!(refused("id", "other").contains("start the detector again"));
        assert!(refused("place", "ground").contains("--set place=ground"));
        assert!(refused("input", "jpeg").contains("start another detector"));
        assert!(refused("input", "video").contains("video"));
        assert!(refused("min_confidence", "2").contains("from 0 to 1"));
        assert!(refused("markers", "[]").contains("at least one marker"));
        assert!(refused("tracking", "7").contains("a table is needed"));
        assert!(refused("x=1\ny", "2").contains("x"));
    }
}
