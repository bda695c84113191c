//! The recorder's configuration.

use std::path::PathBuf;
use std::str::FromStr;

use serde::Deserialize;

/// The keys of `recorder.toml`, which has their meanings, units and ranges.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this instance.
    pub id: String,
    /// The recording.
    pub file: PathBuf,
    /// What is kept of frames, a [`Frames`].
    pub frames: String,
    /// Quality of pictures, 1 to 100.
    pub jpeg_quality: u8,
    /// Maximum rate of pictures of a camera, in Hz.
    pub max_picture_hz: f64,
    /// What may wait for a slow disk, in MB.
    pub max_waiting_mb: u32,
    /// Size at which a new file is begun, in MB.
    pub max_file_mb: u32,
    /// Age at which a new file is begun, in minutes.
    pub max_file_minutes: f64,
}

/// What is kept of frames.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Frames {
    /// Nothing.
    None,
    /// Pictures.
    Jpeg,
    /// Every pixel.
    Raw,
}

impl FromStr for Frames {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "none" => Ok(Self::None),
            "jpeg" => Ok(Self::Jpeg),
            "raw" => Ok(Self::Raw),
            _ => Err(format!("`{text}` is none of `none`, `jpeg`, `raw`")),
        }
    }
}

impl node::Settings for Config {
    const DEFAULTS: &'static str = include_str!("../recorder.toml");

    fn check(&self, check: &mut node::Check<'_>) {
        check.name("id", &self.id);
        check.parses("frames", self.frames.parse::<Frames>());
        check.range("jpeg_quality", self.jpeg_quality, 1..=100);
        check.range("max_picture_hz", self.max_picture_hz, 0.1..=1000.0);
        check.range("max_waiting_mb", self.max_waiting_mb, 2..=60);
        check.range("max_file_mb", self.max_file_mb, 1..=1_000_000);
        check.range("max_file_minutes", self.max_file_minutes, 1.0..=100_000.0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(set: &str) -> Result<Config, String> {
        let layers = node::Layers { file: None, set: vec![set.to_owned()] };
        layers.load::<Config>().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (setting, part) in [
            ("frames=png", "`frames`"),
            ("jpeg_quality=0", "from 1 to 100"),
            ("max_picture_hz=0", "max_picture_hz"),
            ("max_waiting_mb=61", "from 2 to 60"),
            ("max_file_mb=0", "max_file_mb"),
            ("max_file_minutes=nan", "max_file_minutes"),
            ("id=a/b", "letters, digits"),
        ] {
            let problem = load(setting).unwrap_err();
            assert!(problem.contains(part), "{setting}: {problem}");
        }
    }
}
