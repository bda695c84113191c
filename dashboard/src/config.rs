//! The dashboard's configuration, `dashboard.toml`: address, names and certificate of the page, the permission to
//! command, source and rate of the pictures, their stream as H.264.

use std::net::SocketAddr;
use std::path::PathBuf;

use serde::Deserialize;

/// Maximum number of names of the page.
const MAX_NAMES: usize = 16;

/// The keys of `dashboard.toml`, which has their meanings, units and ranges.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this instance.
    pub id: String,
    /// Address of the page.
    pub listen: String,
    /// Further names of the page.
    pub names: Vec<String>,
    /// The clients that may command, a [`Commands`].
    pub commands: String,
    /// The file of the tokens' hashes; empty for the usual one.
    pub tokens: PathBuf,
    /// The certificate of the page (PEM); empty for no encryption.
    pub certificate: PathBuf,
    /// Its private key (PEM); empty for the certificate's name with `.key`, in the same folder.
    pub key: PathBuf,
    /// Maximum number of browsers.
    pub max_clients: u32,
    /// Pictures.
    pub video: VideoConfig,
}

/// The keys of pictures.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VideoConfig {
    /// Source of the pictures, an [`Input`].
    pub input: String,
    /// Maximum rate of pictures, in Hz.
    pub max_hz: f64,
    /// Quality of pictures made from frames.
    pub jpeg_quality: u8,
    /// How long a picture waits for its detections, in milliseconds.
    pub hold_ms: u32,
    /// Destination of the pictures as H.264 over RTP, an address; empty for no stream.
    pub rtp: String,
    /// Rate of that stream, in kbit/s.
    pub rtp_kbit_s: u32,
}

/// The clients that may command by the page.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Commands {
    /// No client.
    Never,
    /// Every browser on this machine.
    Here,
    /// Holders of a token for commands: on this machine, and on an encrypted page from elsewhere.
    Token,
}

impl Config {
    /// The files of the certificate and its private key; `None` without encryption.
    pub fn certificate(&self) -> Option<[PathBuf; 2]> {
        let certificate = Some(&self.certificate).filter(|path| !path.as_os_str().is_empty())?;
        let usual = certificate.with_extension("key");
        let key = if self.key.as_os_str().is_empty() { usual } else { self.key.clone() };
        Some([certificate.clone(), key])
    }
}

/// Source of the pictures.
#[derive(Copy, Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Input {
    /// The camera's frames.
    Frames,
    /// The JPEG frames of the air link.
    Jpeg,
    /// No pictures.
    None,
}

impl node::Settings for Config {
    const DEFAULTS: &'static str = include_str!("../dashboard.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut node::Check<'_>) {
        check.name("id", &self.id);
        let listen = self.listen.parse::<SocketAddr>();
        check.parses("listen", listen.map_err(|_| "it must be IP:PORT, such as 127.0.0.1:8080"));
        check.parses("names", check_names(&self.names));
        check.parses("commands", node::named::<Commands>(&self.commands));
        if self.certificate.as_os_str().is_empty() && !self.key.as_os_str().is_empty() {
            let it: Result<(), _> = Err("`certificate` is empty, and the key belongs to it");
            check.parses("key", it);
        }
        check.range("max_clients", self.max_clients, 1..=64);
        check.parses("video.input", node::named::<Input>(&self.video.input));
        check.range("video.max_hz", self.video.max_hz, 0.5..=120.0);
        check.range("video.jpeg_quality", self.video.jpeg_quality, 1..=100);
        check.range("video.hold_ms", self.video.hold_ms, 0..=1000);
        if !self.video.rtp.is_empty() {
            check.parses("video.rtp", check_rtp(&self.video.rtp));
        }
        check.range("video.rtp_kbit_s", self.video.rtp_kbit_s, 100..=50_000);
    }
}

fn check_rtp(address: &str) -> Result<SocketAddr, &'static str> {
    if cfg!(not(feature = "h264")) {
        return Err(
            "this program makes no H.264: build it with `--features h264`, which needs a C++ compiler",
        );
    }
    address.parse().map_err(|_| "it must be IP:PORT, such as 192.168.4.20:5600")
}

fn check_names(names: &[String]) -> Result<(), String> {
    let is_part = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '.';
    let is_host =
        |name: &&String| !name.is_empty() && name.len() < 254 && name.chars().all(is_part);
    match names.iter().find(|name| !is_host(name)) {
        Some(name) => Err(format!("`{name}` is not a host name")),
        None if names.len() > MAX_NAMES => Err(format!("there may be {MAX_NAMES} names at most")),
        None => Ok(()),
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
            ("listen=localhost:80", "IP:PORT"),
            ("names=[\"a b\"]", "is not a host name"),
            ("commands=always", "`never`"),
            ("key=page.key", "`certificate`"),
            ("max_clients=0", "from 1 to 64"),
            ("video.input=raw", "`frames`"),
            ("video.max_hz=0", "max_hz"),
            ("video.hold_ms=5000", "hold_ms"),
            ("video.rtp_kbit_s=1", "rtp_kbit_s"),
            ("id=a/b", "letters, digits"),
        ] {
            let error = load(setting).unwrap_err();
            assert!(error.contains(part), "{setting}: {error}");
        }
        assert!(load("listen=0.0.0.0:9000").is_ok());
    }

    #[test]
    fn a_stream_needs_an_encoder_and_an_address() {
        let address = load("video.rtp=127.0.0.1:5600");
        let name = load("video.rtp=ground").unwrap_err();
        if cfg!(feature = "h264") {
            assert!(address.is_ok());
            assert!(name.contains("IP:PORT"), "{name}");
        } else {
            assert!(address.is_err());
            assert!(name.contains("--features h264"), "{name}");
        }
    }
}
