//! The recorder's configuration, `recorder.toml`: file and its size, the recorded part of frames, address and
//! origins of viewers.

use std::net::SocketAddr;
use std::path::PathBuf;

use serde::Deserialize;

use crate::name::check_placeholders;

/// Maximum number of origins.
const MAX_ORIGINS: usize = 16;

/// The keys of `recorder.toml`, which has their meanings, units and ranges.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this instance.
    pub id: String,
    /// The recording.
    pub file: PathBuf,
    /// The recorded part of frames, a [`Frames`].
    pub frames: String,
    /// Quality of pictures, 1 to 100.
    pub jpeg_quality: u8,
    /// Maximum rate of pictures of a camera, in Hz.
    pub max_picture_hz: f64,
    /// Messages that may wait for a slow disk, in MB.
    pub max_waiting_mb: u32,
    /// Size at which a new file is begun, in MB.
    pub max_file_mb: u32,
    /// Age at which a new file is begun, in minutes.
    pub max_file_minutes: f64,
    /// Address at which viewers follow the flight; empty for none.
    pub serve: String,
    /// Whether that may be beyond this machine.
    pub insecure: bool,
    /// Origins of web pages that may follow, in addition to those of this machine.
    pub origins: Vec<String>,
    /// Maximum number of viewers.
    pub max_clients: u32,
}

impl Config {
    /// Whether there is a file.
    pub fn has_file(&self) -> bool {
        !self.file.as_os_str().is_empty()
    }
}

/// The recorded part of frames.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Frames {
    /// Nothing.
    None,
    /// Pictures.
    Jpeg,
    /// Every pixel.
    Raw,
}

impl node::Settings for Config {
    const DEFAULTS: &'static str = include_str!("../recorder.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut node::Check<'_>) {
        check.name("id", &self.id);
        check.parses("frames", node::named::<Frames>(&self.frames));
        check.range("jpeg_quality", self.jpeg_quality, 1..=100);
        check.range("max_picture_hz", self.max_picture_hz, 0.1..=1000.0);
        check.range("max_waiting_mb", self.max_waiting_mb, 2..=60);
        check.range("max_file_mb", self.max_file_mb, 1..=1_000_000);
        check.range("max_file_minutes", self.max_file_minutes, 1.0..=100_000.0);
        check.parses("file", check_purpose(self.has_file(), &self.serve));
        check.parses("file", check_placeholders(&self.file));
        check.parses("serve", check_address(&self.serve, self.insecure));
        check.parses("origins", check_origins(&self.origins));
        check.range("max_clients", self.max_clients, 1..=16);
    }
}

fn check_purpose(has_file: bool, serve: &str) -> Result<(), &'static str> {
    if has_file || !serve.is_empty() {
        return Ok(());
    }
    Err("without a file there must be viewers: give `serve` an address, such as 127.0.0.1:8765")
}

fn check_address(serve: &str, insecure: bool) -> Result<(), &'static str> {
    if serve.is_empty() {
        return Ok(());
    }
    match serve.parse::<SocketAddr>() {
        Err(_) => Err("it must be IP:PORT, such as 127.0.0.1:8765"),
        Ok(address) if insecure || address.ip().is_loopback() => Ok(()),
        Ok(_) => Err(
            "beyond this machine every computer in the network can follow the flight, pictures included. `ssh -L 8765:127.0.0.1:8765 HOST` brings 127.0.0.1:8765 there; or allow it with `insecure = true` (`--insecure`)",
        ),
    }
}

fn check_origins(origins: &[String]) -> Result<(), String> {
    let is_origin = |text: &&String| {
        text.len() < 254 && text.contains("://") && text.chars().all(|c| c.is_ascii_graphic())
    };
    match origins.iter().find(|text| !is_origin(text)) {
        Some(text) => Err(format!("`{text}` is not an origin such as https://app.foxglove.dev")),
        None if origins.len() > MAX_ORIGINS => {
            Err(format!("there may be {MAX_ORIGINS} origins at most"))
        }
        None => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(set: &str) -> Result<Config, String> {
        load_all(&[set])
    }

    fn load_all(set: &[&str]) -> Result<Config, String> {
        let set = set.iter().map(|text| (*text).to_owned()).collect();
        let layers = node::Layers { file: None, set };
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
            ("file=", "give `serve` an address"),
            ("file=\"{foo}.mcap\"", "`{foo}` is not a placeholder"),
            ("serve=localhost:8765", "IP:PORT"),
            ("serve=0.0.0.0:8765", "`insecure = true`"),
            ("origins=[\"app.example\"]", "is not an origin"),
            ("max_clients=0", "from 1 to 16"),
        ] {
            let error = load(setting).unwrap_err();
            assert!(error.contains(part), "{setting}: {error}");
        }
        assert!(load("serve=[::1]:8765").is_ok());
    }

    #[test]
    fn other_machines_follow_a_flight_only_where_that_is_configured() {
        assert!(load_all(&["serve=0.0.0.0:8765", "insecure=true"]).is_ok());
        assert!(load_all(&["serve=127.0.0.1:8765", "file="]).is_ok_and(|it| !it.has_file()));
    }
}
