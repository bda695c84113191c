//! The detector's configuration.

use fiducial::Marker;
use node::{Check, Settings};
use serde::Deserialize;

/// The keys of `detector.toml`; meanings, units and ranges are told there.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this detector.
    pub id: String,
    /// Name of the camera.
    pub camera: String,
    /// Markers to look for.
    pub markers: Vec<String>,
    /// Threshold of `rings-thesis`, in grey levels.
    pub thesis_threshold: u8,
    /// Quality of the debug images.
    pub debug_jpeg_quality: u8,
}

impl Settings for Config {
    const DEFAULTS: &'static str = include_str!("../detector.toml");

    fn check(&self, check: &mut Check<'_>) {
        check.name("id", &self.id);
        check.name("camera", &self.camera);
        check.parses("markers", self.parsed_markers());
        check.range("thesis_threshold", self.thesis_threshold, 1..=255);
        check.range("debug_jpeg_quality", self.debug_jpeg_quality, 1..=100);
    }
}

impl Config {
    /// The markers to look for.
    ///
    /// # Errors
    /// Says which marker is wrong and why.
    pub fn parsed_markers(&self) -> Result<Vec<Marker>, String> {
        if self.markers.is_empty() {
            return Err("at least one marker is needed, for example \"rings:0.15341\"".to_owned());
        }
        self.markers.iter().map(|text| text.parse().map_err(|e| format!("{e}"))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use node::Layers;

    #[test]
    fn the_defaults_are_complete_and_wrong_markers_are_refused() {
        let load = |set: &str| {
            let set = if set.is_empty() { Vec::new() } else { vec![set.to_owned()] };
            Layers { file: None, set }.load::<Config>().map_err(|e| e.to_string())
        };
        assert_eq!(load("").unwrap().settings.markers, ["rings:0.15341"]);
        assert!(load("markers=[\"hexagons:1\"]").unwrap_err().contains("no family `hexagons`"));
        assert!(load("markers=[]").unwrap_err().contains("at least one marker"));
        assert!(load("thesis_threshold=0").unwrap_err().contains("from 1 to 255"));
        // A number that does not fit its type is refused too, whatever its range says.
        assert!(load("thesis_threshold=300").is_err());
    }
}
