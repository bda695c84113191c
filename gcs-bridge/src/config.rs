//! The bridge's configuration, `gcs-bridge.toml`: link to the ground stations, ids, accepted ground stations and their permission, signing
//! key, rate of landing targets, the camera's video.

use std::net::IpAddr;
use std::time::Duration;

use autopilot::{Address, KeyFileError, Peering, Permission, SigningConfig};
use node::state_directory;
use serde::Deserialize;

use crate::video::Video;

/// The keys of `gcs-bridge.toml`, which has their meanings, units and ranges.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Config {
    /// Name of this instance.
    pub id: String,
    /// Address of the ground station, as an [`Address`].
    pub ground: String,
    /// The vehicle's MAVLink system id; 0 takes it from the autopilot's heartbeat.
    pub system_id: u8,
    /// Time without a heartbeat after which the system id 1 is assumed, in seconds.
    pub assume_system_after_s: f64,
    /// MAVLink component id of this companion.
    pub component_id: u8,
    /// MAVLink component id of the camera, from 100 to 105; 0 shows no camera.
    pub camera_component_id: u8,
    /// Where the ground station finds the camera's video, which another program serves; nothing without one.
    pub video: String,
    /// IP addresses of the ground stations; any if there are none.
    pub ground_stations: Vec<String>,
    /// Silence after which another ground station is accepted, and one counts as silent, in seconds.
    pub ground_silence_s: f64,
    /// File with the key of signed packets, or nothing.
    pub signing_key: String,
    /// What the ground station may send to the autopilot, a [`Permission`].
    pub ground_may: String,
    /// Rate of the landing target, in Hz.
    pub target_rate_hz: f64,
    /// Maximum age of the landing target, in milliseconds.
    pub target_max_age_ms: f64,
}

impl node::Settings for Config {
    const DEFAULTS: &'static str = include_str!("../gcs-bridge.toml");

    fn from_table(table: node::config::Table) -> Result<Self, node::config::TableError> {
        table.try_into()
    }

    fn check(&self, check: &mut node::Check<'_>) {
        check.name("id", &self.id);
        check.parses("ground", self.ground.parse::<Address>());
        check.range("assume_system_after_s", self.assume_system_after_s, 0.0..=3600.0);
        check.range("component_id", self.component_id, 2..=255);
        if self.camera_component_id != 0 {
            check.range("camera_component_id", self.camera_component_id, 100..=105);
            let is_free = self.camera_component_id != self.component_id;
            check.parses(
                "camera_component_id",
                is_free.then_some(()).ok_or("it must differ from `component_id`"),
            );
        }
        if !self.video.is_empty() {
            check.parses("video", self.video.parse::<Video>());
        }
        for address in &self.ground_stations {
            check.parses("ground_stations", address.parse::<IpAddr>());
        }
        check.range("ground_silence_s", self.ground_silence_s, 1.0..=600.0);
        check.parses("ground_may", self.ground_may.parse::<Permission>());
        check.range("target_rate_hz", self.target_rate_hz, 0.1..=50.0);
        check.range("target_max_age_ms", self.target_max_age_ms, 1.0..=60_000.0);
    }
}

impl Config {
    /// Where the camera's video is, when another program serves one.
    pub(crate) fn video(&self) -> Option<Video> {
        self.video.parse().ok()
    }

    /// Whether it listens beyond this machine for any ground station, with the permission to change the vehicle's state.
    pub(crate) fn is_open(&self) -> bool {
        let host = match self.ground.parse() {
            Ok(Address::UdpIn(at) | Address::TcpIn(at)) => at.host,
            _ => return false,
        };
        let is_here = host == "localhost" || host.parse().is_ok_and(|it: IpAddr| it.is_loopback());
        let changes = self.ground_may.parse() != Ok(Permission::Monitor);
        !is_here && changes && self.ground_stations.is_empty() && self.signing_key.is_empty()
    }

    /// The key of the packets between bridge and ground station, if they are signed.
    ///
    /// # Errors
    /// When its file cannot be used.
    pub fn signing(&self) -> Result<Option<SigningConfig>, KeyFileError> {
        if self.signing_key.is_empty() {
            return Ok(None);
        }
        let (path, name) = (self.signing_key.as_ref(), format!("gcs-bridge-{}", self.id));
        SigningConfig::read(path, self.component_id, state_directory(), &name).map(Some)
    }

    /// The peers of the link to the ground station.
    pub(crate) fn peering(&self) -> Peering {
        Peering::GroundStation {
            known: self.ground_stations.iter().filter_map(|text| text.parse().ok()).collect(),
            silence: Duration::from_secs_f64(self.ground_silence_s),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn load(set: &[&str]) -> Result<Config, String> {
        let set = set.iter().map(|text| (*text).to_owned()).collect();
        let layers = node::Layers { file: None, set };
        layers.load::<Config>().map(|c| c.settings).map_err(|e| e.to_string())
    }

    #[test]
    fn the_defaults_match_qgroundcontrol() {
        let config = load(&[]).unwrap();
        assert_eq!(config.ground, "udpout:127.0.0.1:14550");
        assert_eq!((config.system_id, config.component_id), (0, 191));
    }

    #[test]
    fn a_bridge_that_listens_for_any_host_beyond_this_machine_is_open() {
        for (ground, further, is_open) in [
            ("udpin:0.0.0.0:14550", "ground_stations=[]", true),
            ("tcpin:10.0.0.2:5760", "ground_stations=[]", true),
            ("udpin:0.0.0.0:14550", "ground_may='no-arming'", true),
            ("udpin:0.0.0.0:14550", "ground_may='monitor'", false),
            ("udpin:0.0.0.0:14550", "ground_stations=['10.0.0.3']", false),
            ("udpin:0.0.0.0:14550", "signing_key='ground.key'", false),
            ("udpin:127.0.0.1:14550", "ground_stations=[]", false),
            ("tcpin:localhost:5760", "ground_stations=[]", false),
            ("udpout:10.0.0.2:14550", "ground_stations=[]", false),
        ] {
            let config = load(&[&format!("ground={ground}"), further]).unwrap();
            assert_eq!(config.is_open(), is_open, "{ground} {further}");
        }
    }

    #[test]
    fn values_out_of_range_are_refused_by_name() {
        for (setting, part) in [
            ("ground=127.0.0.1:14550", "`ground`"),
            ("ground=udpout:127.0.0.1", "`ground`"),
            ("component_id=1", "from 2 to 255"),
            ("component_id=256", "component_id"),
            ("system_id=-1", "system_id"),
            ("ground_stations=['10.0.0.x']", "`ground_stations`"),
            ("ground_silence_s=0", "from 1 to 600"),
            ("ground_may=all", "no-arming"),
            ("camera_component_id=99", "from 100 to 105"),
            ("component_id=100", "must differ from `component_id`"),
            ("video=http://10.0.0.2/", "rtsp://HOST:PORT/PATH"),
            ("target_rate_hz=0", "from 0.1 to 50"),
            ("target_max_age_ms=inf", "`target_max_age_ms`"),
            ("id=a/b", "letters, digits"),
            ("grund='x'", "did you mean `ground`"),
        ] {
            let problem = load(&[setting]).unwrap_err();
            assert!(problem.contains(part), "{setting}: {problem}");
        }
    }
}
