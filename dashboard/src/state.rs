//! Stores the newest messages of controller, detectors, cameras, recorder, bridge and every service, and makes the JSON of the
//! page from them, with the age of each number.
//!
//! The caller gives the time, in nanoseconds of this process' clock. The name of a sender is the one in its key, not the one
//! in the message. All collections are bounded.

use std::collections::{BTreeMap, BTreeSet};

use messages::{
    CameraInfo, Configuration, ControllerStatus, Detections, DetectorInfo, GcsStatus,
    GroundStation, Health, Phase, RecorderStatus, TargetEstimate, VehicleState,
};
use serde_json::{Value, json};

use crate::checks::{Facts, checks, is_current};
use crate::found::in_words;
use crate::funnel::Funnel;
use crate::log::{Level, Log};
use crate::words;

/// Maximum number of detectors, cameras, recorders and bridges, each, and of services.
const MAX_NAMES: usize = 64;
/// Maximum number of faults of all services, each of which is logged once.
const MAX_FAULTS: usize = 512;
/// A service whose health is older is silent, in nanoseconds: it is published every second.
const SILENT_NS: i64 = 3_000_000_000;
/// A bridge or recorder whose status is older is silent, in nanoseconds: it is published every two seconds, and one
/// may be lost.
const SILENT_STATUS_NS: i64 = 6_000_000_000;
/// A service that is silent for this time is removed, in nanoseconds.
const REMOVAL_NS: i64 = 120_000_000_000;

/// A message and the time of its arrival.
#[derive(Clone, Debug)]
pub struct Seen<T> {
    /// The message.
    pub value: T,
    /// Time of arrival, in nanoseconds of this process' clock.
    pub received_ns: i64,
}

/// A message, with the name in its key.
#[derive(Clone, Debug)]
pub enum Input {
    /// The controller's status.
    Status(Box<ControllerStatus>),
    /// The estimate of the landing point.
    Target(Box<TargetEstimate>),
    /// The vehicle's state.
    Vehicle(Box<VehicleState>),
    /// A detector's detections.
    Detections(String, Box<Detections>),
    /// A detector's description.
    Detector(String, Box<DetectorInfo>),
    /// A camera's calibration.
    Camera(String, Box<CameraInfo>),
    /// A service's health, by its name and that of its instance.
    Health(String, String, Box<Health>),
    /// A recorder's status.
    Recorder(String, Box<RecorderStatus>),
    /// A bridge's ground stations.
    Ground(Box<GcsStatus>),
    /// The controller's configuration.
    Configuration(Box<Configuration>),
}

/// A service.
#[derive(Clone, Debug)]
pub struct Service {
    /// Its newest health.
    pub health: Health,
    received_ns: i64,
    /// Load of one core over the last period, in percent.
    cpu_percent: Option<f64>,
    /// The time of a query and its reply, in milliseconds; `None` without a reply.
    round_trip: Option<Seen<Option<f64>>>,
    is_silent: bool,
}

/// All data of the page except the pictures.
#[derive(Clone, Debug, Default)]
pub struct State {
    /// The name of this process' clock.
    clock: String,
    status: Option<Seen<ControllerStatus>>,
    target: Option<Seen<TargetEstimate>>,
    vehicle: Option<Seen<VehicleState>>,
    found: BTreeMap<String, Seen<Detections>>,
    detectors: BTreeMap<String, Seen<DetectorInfo>>,
    cameras: BTreeMap<String, Seen<CameraInfo>>,
    recorders: BTreeMap<String, Seen<RecorderStatus>>,
    bridges: BTreeMap<String, Seen<GcsStatus>>,
    funnel: Option<Funnel>,
    services: BTreeMap<(String, String), Service>,
    faults: BTreeSet<String>,
    warnings: Vec<String>,
    /// The events.
    pub log: Log,
}

/// Whether an entry may be stored under this name.
fn has_room<K: Ord, V>(map: &BTreeMap<K, V>, name: &K) -> bool {
    map.len() < MAX_NAMES || map.contains_key(name)
}

fn put<V>(map: &mut BTreeMap<String, Seen<V>>, name: String, value: V, received_ns: i64) {
    if has_room(map, &name) {
        map.insert(name, Seen { value, received_ns });
    }
}

fn ms(ns: i64) -> f64 {
    ns as f64 * 1e-6
}

/// An age in milliseconds.
fn age_ms(now_ns: i64, since_ns: i64) -> f64 {
    ms(now_ns.saturating_sub(since_ns).max(0))
}

impl State {
    /// A state without messages; `clock` is the name of this process' clock.
    pub fn new(clock: &str) -> Self {
        Self { clock: clock.to_owned(), ..Self::default() }
    }

    /// Takes a message.
    pub fn take(&mut self, now_ns: i64, input: Input) {
        match input {
            Input::Status(status) => self.take_status(now_ns, *status),
            Input::Target(target) => {
                self.target = Some(Seen { value: *target, received_ns: now_ns });
            }
            Input::Vehicle(vehicle) => {
                self.vehicle = Some(Seen { value: *vehicle, received_ns: now_ns });
            }
            Input::Detections(name, found) => put(&mut self.found, name, *found, now_ns),
            Input::Detector(name, info) => put(&mut self.detectors, name, *info, now_ns),
            Input::Camera(name, info) => put(&mut self.cameras, name, *info, now_ns),
            Input::Health(service, instance, health) => {
                self.take_health(now_ns, service, instance, *health);
            }
            Input::Recorder(name, status) => self.take_recorder(now_ns, name, *status),
            Input::Ground(status) => self.take_ground(now_ns, *status),
            Input::Configuration(configuration) => self.funnel = Funnel::of(&configuration),
        }
    }

    fn take_status(&mut self, now_ns: i64, status: ControllerStatus) {
        let before = self.status.as_ref().map(|seen| &seen.value);
        if before.map(|it| it.phase) != Some(status.phase) {
            let level = match status.phase {
                Phase::Failed | Phase::Aborted => Level::Bad,
                Phase::Hold | Phase::Retry | Phase::PilotInCommand => Level::Warn,
                _ => Level::Info,
            };
            self.log.add(now_ns, level, &status.sentence());
        }
        if before.and_then(|it| it.active_detector.as_ref()) != status.active_detector.as_ref() {
            let name = status.active_detector.as_deref().unwrap_or("none");
            let text = format!("detector in use: {name}: {}", status.detector_why);
            self.log.add(now_ns, Level::Info, &text);
        }
        let subjects: Vec<String> =
            status.warnings.iter().map(|text| messages::matter(text)).collect();
        for (text, subject) in status.warnings.iter().zip(&subjects) {
            if !self.warnings.contains(subject) {
                self.log.add(now_ns, Level::Warn, text);
            }
        }
        self.warnings = subjects;
        self.status = Some(Seen { value: status, received_ns: now_ns });
    }

    fn take_health(&mut self, now_ns: i64, service: String, instance: String, health: Health) {
        let key = (service, instance);
        if !has_room(&self.services, &key) {
            return;
        }
        let name = format!("{} {}", key.0, key.1);
        for fault in &health.errors {
            let text = format!("{name}: {}", fault.reason);
            if self.faults.len() < MAX_FAULTS && self.faults.insert(text.clone()) {
                self.log.add(now_ns, Level::Warn, &text);
            }
        }
        let before = self.services.get(&key);
        match before {
            None => self.log.add(now_ns, Level::Info, &format!("{name} is present")),
            Some(before) if before.health.pid != health.pid => {
                self.log.add(now_ns, Level::Warn, &format!("{name} has restarted"));
            }
            Some(before) if before.is_silent => {
                self.log.add(now_ns, Level::Info, &format!("{name} is present again"));
            }
            Some(_) => {}
        }
        let same = before.filter(|before| before.health.pid == health.pid);
        let cpu_percent = same.and_then(|before| {
            let period_s = health.uptime_s - before.health.uptime_s;
            let percent = 100.0 * (health.cpu_s - before.health.cpu_s) / period_s;
            (period_s > 0.1).then_some(percent)
        });
        let round_trip = before.and_then(|before| before.round_trip.clone());
        let service =
            Service { health, received_ns: now_ns, cpu_percent, round_trip, is_silent: false };
        self.services.insert(key, service);
    }

    fn take_recorder(&mut self, now_ns: i64, name: String, status: RecorderStatus) {
        if !has_room(&self.recorders, &name) {
            return;
        }
        let had_problem =
            self.recorders.get(&name).is_some_and(|before| before.value.problem.is_some());
        match &status.problem {
            Some(problem) if !had_problem => {
                self.log.add(now_ns, Level::Warn, &format!("recorder {name}: {problem}"));
            }
            None if had_problem => {
                self.log.add(now_ns, Level::Info, &format!("recorder {name} records again"));
            }
            Some(_) | None => {}
        }
        put(&mut self.recorders, name, status, now_ns);
    }

    fn take_ground(&mut self, now_ns: i64, status: GcsStatus) {
        if !has_room(&self.bridges, &status.bridge) {
            return;
        }
        let before = self.bridges.get(&status.bridge).map(|seen| &seen.value);
        let is_speaking = |stations: &[GroundStation], station: &GroundStation| {
            let id = |it: &GroundStation| (it.system, it.component);
            stations.iter().any(|it| id(it) == id(station) && !it.silent)
        };
        for station in &status.stations {
            let was_speaking = before.is_some_and(|it| is_speaking(&it.stations, station));
            let name = format!("ground station {}/{}", station.system, station.component);
            if !station.silent && !was_speaking {
                self.log.add(now_ns, Level::Info, &format!("{name} is present"));
            } else if station.silent && was_speaking {
                self.log.add(now_ns, Level::Warn, &format!("{name} is silent"));
            }
        }
        put(&mut self.bridges, status.bridge.clone(), status, now_ns);
    }

    /// Detects services and ground stations that have become silent; once a second.
    pub fn every_second(&mut self, now_ns: i64) {
        for ((service, instance), known) in &mut self.services {
            let is_silent = now_ns.saturating_sub(known.received_ns) > SILENT_NS;
            if is_silent && !known.is_silent {
                self.log.add(now_ns, Level::Bad, &format!("{service} {instance} is silent"));
            }
            known.is_silent = is_silent;
        }
        for (name, bridge) in &mut self.bridges {
            // A ground station is cut off when its bridge is gone.
            let is_silent = now_ns.saturating_sub(bridge.received_ns) > SILENT_STATUS_NS;
            for station in bridge.value.stations.iter_mut().filter(|it| is_silent && !it.silent) {
                station.silent = true;
                let GroundStation { system, component, .. } = station;
                let text = format!(
                    "ground station {system}/{component} is silent: no status of gcs-bridge {name}"
                );
                self.log.add(now_ns, Level::Warn, &text);
            }
        }
        let is_recent = |received_ns: i64| now_ns.saturating_sub(received_ns) < REMOVAL_NS;
        self.bridges.retain(|_, bridge| is_recent(bridge.received_ns));
        self.services.retain(|_, service| is_recent(service.received_ns));
        self.found.retain(|_, found| is_recent(found.received_ns));
        self.detectors.retain(|_, info| is_recent(info.received_ns));
        self.cameras.retain(|_, info| is_recent(info.received_ns));
        self.recorders.retain(|_, status| is_recent(status.received_ns));
    }

    /// Stores the time of a query to a service and its reply, in milliseconds; `None` without a reply.
    pub fn round_trip(&mut self, now_ns: i64, service: &str, instance: &str, took_ms: Option<f64>) {
        let key = (service.to_owned(), instance.to_owned());
        if let Some(known) = self.services.get_mut(&key) {
            known.round_trip = Some(Seen { value: took_ms, received_ns: now_ns });
        }
    }

    /// The services that are present: service and instance.
    pub fn present(&self) -> Vec<(String, String)> {
        let present = self.services.iter().filter(|(_, service)| !service.is_silent);
        present.map(|(key, _)| key.clone()).collect()
    }

    /// The detector in use.
    pub fn in_use(&self) -> Option<&str> {
        self.status.as_ref()?.value.active_detector.as_deref()
    }

    /// The camera of the detector in use.
    pub fn camera(&self) -> Option<&str> {
        self.detectors.get(self.in_use()?).map(|info| info.value.camera.as_str())
    }

    /// Age of a message of the controller, in milliseconds: since its stamp if its clock is this process', else since its
    /// arrival.
    fn age_of(&self, now_ns: i64, received_ns: i64, stamp_ns: i64) -> f64 {
        let mut controllers = self.services.iter().filter(|(key, _)| key.0 == "controller");
        let has_same_clock = controllers.any(|(_, it)| it.health.clock == self.clock);
        let since_ns = if has_same_clock { received_ns.min(stamp_ns) } else { received_ns };
        age_ms(now_ns, since_ns)
    }

    /// Age of the controller's status, in milliseconds.
    fn status_age_ms(&self, now_ns: i64) -> Option<f64> {
        let seen = self.status.as_ref()?;
        Some(self.age_of(now_ns, seen.received_ns, seen.value.stamp_ns))
    }

    /// The controller's status; `None` while the controller sends nothing.
    fn current_status(&self, now_ns: i64) -> Option<&ControllerStatus> {
        let status = self.status.as_ref().filter(|_| is_current(self.status_age_ms(now_ns)));
        status.map(|seen| &seen.value)
    }

    /// The data that change with each frame.
    pub fn now(&self, now_ns: i64) -> Value {
        let status = self.status.as_ref().map(|seen| {
            let age_ms = self.age_of(now_ns, seen.received_ns, seen.value.stamp_ns);
            status_json(&seen.value, age_ms)
        });
        let target = self.target.as_ref().map(|seen| {
            let target = &seen.value;
            json!({
                "age_ms": self.age_of(now_ns, seen.received_ns, target.stamp_ns) + target.age_ms.unwrap_or(0.0),
                "position_m": target.position_ned_m,
                "velocity_m_s": target.velocity_ned_m_s,
                "lateral_error_m": target.lateral_error_m,
                "height_m": target.height_m,
                "deviation_m": target.deviation_m,
                "heading_rad": target.heading_rad,
                "wind_m_s": target.wind_ned_m_s,
                "nis": target.nis,
                "decided": target.decided,
                "rejected": target.rejected,
            })
        });
        let vehicle = self.vehicle.as_ref().map(|seen| {
            let vehicle = &seen.value;
            let [roll_rad, pitch_rad, heading_rad] = euler(vehicle.ned_from_body_wxyz);
            json!({
                "age_ms": self.age_of(now_ns, seen.received_ns, vehicle.stamp_ns),
                "position_m": vehicle.position_ned_m,
                "velocity_m_s": vehicle.velocity_ned_m_s,
                "roll_rad": roll_rad,
                "pitch_rad": pitch_rad,
                "heading_rad": heading_rad,
                "mode": vehicle.mode,
                "armed": vehicle.armed,
                "landed": words::landed(vehicle.landed),
                "battery": vehicle.battery,
            })
        });
        json!({ "kind": "now", "now_ms": ms(now_ns), "status": status, "target": target, "vehicle": vehicle })
    }

    /// The data that change slowly: detectors, services, recorders, ground stations, and the checks before a flight.
    pub fn slow(&self, now_ns: i64) -> Value {
        let services: Vec<Value> = self.services.iter().map(|(key, it)| {
            let health = &it.health;
            let counts = |counts: &[messages::Count]| -> BTreeMap<String, u64> {
                counts.iter().map(|it| (it.reason.clone(), it.count)).collect()
            };
            let rates: BTreeMap<&str, f64> =
                health.rates.iter().map(|rate| (rate.name.as_str(), rate.hz)).collect();
            let latencies: BTreeMap<&str, [f64; 2]> =
                health.latencies.iter().map(|it| (it.name.as_str(), [it.p50_ms, it.p99_ms])).collect();
            json!({
                "service": key.0, "instance": key.1, "host": health.host, "pid": health.pid,
                "version": health.version, "age_ms": age_ms(now_ns, it.received_ns), "silent": it.is_silent,
                "cpu_percent": it.cpu_percent, "uptime_s": health.uptime_s,
                "round_trip_ms": it.round_trip.as_ref().and_then(|seen| seen.value),
                "round_trip_age_ms": it.round_trip.as_ref().map(|seen| age_ms(now_ns, seen.received_ns)),
                "rates": rates, "latencies": latencies,
                "drops": counts(&health.drops), "errors": counts(&health.errors),
            })
        }).collect();
        let recorders: Vec<Value> = self.recorders.iter().map(|(name, seen)| {
            let it = &seen.value;
            json!({
                "name": name, "age_ms": age_ms(now_ns, seen.received_ns), "file": it.file, "bytes": it.bytes,
                "kept": it.total_kept(), "lost": it.lost(), "free_bytes": it.free_bytes,
                "problem": it.problem,
            })
        }).collect();
        let bridges: Vec<Value> = self
            .bridges
            .iter()
            .map(|(name, seen)| {
                let it = &seen.value;
                let stations: Vec<String> = it
                    .stations
                    .iter()
                    .map(|station| {
                        let GroundStation { system, component, peer, silent, .. } = station;
                        format!(
                            "{system}/{component} at {peer}{}",
                            if *silent { " (silent)" } else { "" }
                        )
                    })
                    .collect();
                json!({
                    "name": name, "age_ms": age_ms(now_ns, seen.received_ns), "stations": stations,
                    "unlisted": it.unlisted,
                    "refused": it.refused.iter().map(|it| it.count).fold(0, u64::saturating_add),
                    "signing": it.signing.state.to_string(), "problem": it.problem,
                })
            })
            .collect();
        let checks = checks(&self.facts(now_ns));
        json!({
            "kind": "slow", "now_ms": ms(now_ns), "detectors": self.detectors_json(now_ns),
            "services": services, "recorders": recorders, "bridges": bridges, "checks": checks,
            "funnel": self.funnel,
        })
    }

    /// The events, for the page.
    pub fn log_json(&self, now_ns: i64) -> Value {
        let entries: Vec<_> = self.log.entries().collect();
        json!({ "kind": "log", "now_ms": ms(now_ns), "entries": entries })
    }

    fn detectors_json(&self, now_ns: i64) -> Vec<Value> {
        let status = self.current_status(now_ns);
        let candidates: BTreeMap<&str, _> = status
            .iter()
            .flat_map(|status| &status.candidates)
            .map(|candidate| (candidate.detector.as_str(), candidate))
            .collect();
        let unlisted = match status {
            Some(_) => "not received by the controller",
            None => words::WITHOUT_CONTROLLER,
        };
        let mut names: BTreeSet<&str> = candidates.keys().copied().collect();
        names.extend(self.detectors.keys().map(String::as_str));
        names.extend(self.found.keys().map(String::as_str));
        let row = |name: &str| {
            let candidate = candidates.get(name);
            let info = self.detectors.get(name).map(|seen| &seen.value);
            let found = self.found.get(name);
            json!({
                "name": name,
                "state": candidate.map_or(unlisted, |it| words::detector(it.state)),
                "in_use": status.is_some_and(|it| it.active_detector.as_deref() == Some(name)),
                "place": candidate.and_then(|it| it.place).or(info.map(|it| it.place)),
                "host": info.map(|it| &it.host), "camera": info.map(|it| &it.camera),
                "markers": info.map(|it| &it.markers), "version": info.map(|it| &it.version),
                "rate_hz": candidate.map(|it| it.rate_hz), "latency_ms": candidate.map(|it| it.latency_ms),
                "age_ms": found.map(|it| age_ms(now_ns, it.received_ns)),
                "frame_age_ms": candidate.map(|it| it.age_ms),
                "compared": candidate.map(|it| it.compared), "agreed": candidate.map(|it| it.agreed),
                "disagreement_m": candidate.and_then(|it| it.disagreement_m),
                "sees": found.and_then(|it| it.value.detections.first()).map(in_words),
                "seen": found.map(|it| it.value.detections.len()),
            })
        };
        names.into_iter().map(row).collect()
    }

    /// The rate of the frames of the camera in use, or of any camera while that one is not known. The instance of `camera-pub`
    /// has the camera's name; other services that publish frames need not.
    fn frames_hz(&self) -> Option<f64> {
        let camera = self.camera();
        let is_in_use = |instance: &str| camera == Some(instance);
        // A detector counts the frames that it searched.
        let makers = || self.services.iter().filter(|((service, _), _)| service != "detector");
        let is_known = makers().any(|((_, instance), _)| is_in_use(instance));
        let present = makers().filter(|(_, it)| !it.is_silent);
        let mut selected = present.filter(|((_, instance), _)| !is_known || is_in_use(instance));
        selected.find_map(|(_, it)| {
            it.health.rates.iter().find(|rate| rate.name == "frames").map(|rate| rate.hz)
        })
    }

    fn facts(&self, now_ns: i64) -> Facts<'_> {
        let vehicle = self.vehicle.as_ref();
        let vehicle_age_ms =
            vehicle.map(|it| self.age_of(now_ns, it.received_ns, it.value.stamp_ns));
        let in_use = self.in_use();
        let found = in_use.and_then(|name| self.found.get(name));
        let found_age_ms = found.map(|it| age_ms(now_ns, it.received_ns));
        let found = found.filter(|_| is_current(found_age_ms));
        let camera = found.map(|it| it.value.header.camera.as_str()).or(self.camera());
        let controller = self.services.iter().find(|(key, _)| key.0 == "controller");
        let has_fault = |name: &str| {
            self.services
                .values()
                .any(|it| it.health.errors.iter().any(|fault| fault.reason == name))
        };
        Facts {
            status: self.current_status(now_ns),
            status_age_ms: self.status_age_ms(now_ns),
            vehicle: vehicle.map(|seen| &seen.value).filter(|_| is_current(vehicle_age_ms)),
            vehicle_age_ms,
            found: found.map(|it| &it.value),
            found_age_ms,
            frames_hz: self.frames_hz(),
            calibration: camera.and_then(|name| self.cameras.get(name)).map(|seen| &seen.value),
            controller_clock: controller.map(|(_, it)| it.health.clock.as_str()),
            round_trip_ms: controller
                .and_then(|(_, it)| it.round_trip.as_ref())
                .map(|seen| seen.value),
            recorder: self
                .recorders
                .values()
                .find(|it| age_ms(now_ns, it.received_ns) < ms(SILENT_STATUS_NS))
                .map(|it| &it.value),
            is_insecure: self
                .services
                .values()
                .any(|it| !it.is_silent)
                .then(|| has_fault(node::INSECURE) || has_fault(node::OPEN)),
            silent: self
                .services
                .iter()
                .filter(|(_, it)| it.is_silent)
                .map(|((service, instance), _)| format!("{service} {instance}"))
                .collect(),
        }
    }
}

fn status_json(status: &ControllerStatus, age_ms: f64) -> Value {
    let words = words::phase(status);
    json!({
        "age_ms": age_ms,
        "phase": status.phase.name(), "title": words.title, "mood": words.mood, "next": words.next,
        "why": status.why, "guidance": status.guidance, "autopilot": status.autopilot,
        "detector": status.active_detector, "detector_why": status.detector_why,
        "preference": status.preference, "detector_changes": status.detector_changes,
        "detection_age_ms": status.detection_age_ms, "height_m": status.height_m,
        "lateral_error_m": status.lateral_error_m,
        "setpoint_m_s": status.setpoint.map(|it| it.velocity_ned_m_s),
        "finished": status.finished, "detections_used": status.detections_used,
        "latency_ms": status.latency_ms, "setpoint_timeout_s": status.setpoint_timeout_s,
        "since_start_s": status.started_ns.map(|start| {
            status.disarmed_ns.unwrap_or(status.stamp_ns).saturating_sub(start) as f64 * 1e-9
        }),
        "warnings": status.warnings,
    })
}

/// Roll, pitch and heading of an attitude, in radians.
fn euler([w, x, y, z]: [f64; 4]) -> [f64; 3] {
    let roll = (2.0 * (w * x + y * z)).atan2(1.0 - 2.0 * (x * x + y * y));
    let pitch = (2.0 * (w * y - z * x)).clamp(-1.0, 1.0).asin();
    let heading = (2.0 * (w * z + x * y)).atan2(1.0 - 2.0 * (y * y + z * z));
    [roll, pitch, heading]
}

#[cfg(test)]
mod tests {
    use super::*;
    use messages::{Candidate, Count, DetectorState, LandedState, Place};

    const SECOND: i64 = 1_000_000_000;

    fn status(phase: Phase, why: &str) -> Input {
        Input::Status(Box::new(ControllerStatus {
            phase,
            why: why.into(),
            active_detector: Some("main".into()),
            candidates: vec![Candidate {
                state: DetectorState::Active,
                place: Some(Place::Onboard),
                ..Candidate::sample()
            }],
            ..ControllerStatus::default()
        }))
    }

    fn health(service: &str, pid: u32, clock: &str, cpu_s: f64, uptime_s: f64) -> Input {
        let health = Health {
            service: service.into(),
            host: "pi".into(),
            version: "0.1.0".into(),
            clock: clock.into(),
            pid,
            cpu_s,
            uptime_s,
            errors: vec![Count { reason: "publish".into(), count: 1 }],
            ..Health::sample()
        };
        Input::Health(service.into(), "main".into(), Box::new(health))
    }

    fn texts(state: &State) -> Vec<&str> {
        state.log.entries().map(|entry| entry.text.as_str()).collect()
    }

    #[test]
    fn numbers_have_the_age_of_their_message() {
        let mut state = State::new("own");
        assert_eq!(state.now(0)["status"], Value::Null);
        state.take(SECOND, status(Phase::Descend, "descending over the marker"));
        let now = state.now(2 * SECOND);
        assert_eq!(now["status"]["age_ms"], 1000.0);
        assert_eq!(now["status"]["title"], "Descending");
        assert_eq!(now["status"]["why"], "descending over the marker");
        // The controller has the same clock: the message was old on arrival.
        state.take(SECOND, health("controller", 1, "own", 0.0, 1.0));
        assert_eq!(state.now(2 * SECOND)["status"]["age_ms"], 2000.0);
    }

    #[test]
    fn the_log_names_a_phase_once() {
        let mut state = State::new("own");
        state.take(SECOND, status(Phase::Aborted, "aborted by the operator"));
        assert!(texts(&state).contains(&"aborted by the operator"), "{:?}", texts(&state));
    }

    #[test]
    fn the_vehicles_attitude_is_given_in_angles() {
        let half = std::f64::consts::FRAC_PI_8;
        let vehicle = VehicleState {
            stamp_ns: 0,
            ned_from_body_wxyz: [half.cos(), 0.0, 0.0, half.sin()],
            position_ned_m: [1.0, 2.0, -3.0],
            velocity_ned_m_s: [0.0; 3],
            mode: "GUIDED".into(),
            armed: true,
            landed: LandedState::InAir,
            battery: Some(0.5),
        };
        let mut state = State::new("own");
        state.take(0, Input::Vehicle(Box::new(vehicle)));
        let vehicle = &state.now(0)["vehicle"];
        assert!((vehicle["heading_rad"].as_f64().unwrap() - 2.0 * half).abs() < 1e-12);
        assert_eq!(
            (&vehicle["mode"], &vehicle["landed"]),
            (&json!("GUIDED"), &json!("in the air"))
        );
    }

    #[test]
    fn phases_warnings_and_services_are_logged_once() {
        let mut state = State::new("own");
        for _ in 0..3 {
            state.take(0, status(Phase::Search, "looking"));
        }
        let mut warned = ControllerStatus { phase: Phase::Search, ..ControllerStatus::default() };
        for number in 1..4 {
            warned.warnings = vec![format!("the mount is off by {number} degrees")];
            state.take(0, Input::Status(Box::new(warned.clone())));
        }
        state.take(0, health("detector", 1, "a", 1.0, 10.0));
        state.take(SECOND, health("detector", 1, "a", 1.5, 11.0));
        assert_eq!(state.slow(SECOND)["services"][0]["cpu_percent"], 50.0);
        state.every_second(SECOND);
        state.every_second(6 * SECOND);
        state.every_second(7 * SECOND);
        assert_eq!(state.slow(SECOND)["services"][0]["silent"], true);
        assert!(state.present().is_empty());
        state.take(8 * SECOND, health("detector", 1, "a", 1.5, 18.0));
        state.take(9 * SECOND, health("detector", 2, "a", 0.0, 1.0));
        let logged = texts(&state);
        for (text, times) in [
            ("search: looking", 1),
            ("the mount is off by 1 degrees", 1),
            ("detector main: publish", 1),
            ("detector main is present", 1),
            ("detector main is silent", 1),
            ("detector main is present again", 1),
            ("detector main has restarted", 1),
        ] {
            assert_eq!(
                logged.iter().filter(|it| **it == text).count(),
                times,
                "{text}: {logged:?}"
            );
        }
        state.every_second(1000 * SECOND);
        assert_eq!(state.slow(0)["services"], json!([]));
    }

    fn ground(silent: bool) -> Input {
        let station = GroundStation { silent, ..GroundStation::sample() };
        Input::Ground(Box::new(GcsStatus {
            bridge: "main".into(),
            stations: vec![station],
            unlisted: 4,
            refused: vec![Count { reason: "wrong checksum".into(), count: 3 }],
            ..GcsStatus::default()
        }))
    }

    #[test]
    fn ground_stations_are_shown_and_their_silence_is_logged_once() {
        let mut state = State::new("own");
        for silent in [false, false, true, true] {
            state.take(0, ground(silent));
        }
        let logged = texts(&state);
        assert_eq!(
            logged,
            ["ground station 255/190 is present", "ground station 255/190 is silent"]
        );
        let bridge = &state.slow(SECOND)["bridges"][0];
        assert_eq!(bridge["stations"], json!(["255/190 at 10.0.0.2:14550 (silent)"]));
        assert_eq!((&bridge["refused"], &bridge["unlisted"]), (&json!(3), &json!(4)));
        assert_eq!(bridge["signing"], "packets are not signed");
    }

    #[test]
    fn the_stations_of_a_bridge_that_is_gone_are_silent_and_then_removed() {
        let mut state = State::new("own");
        state.take(0, ground(false));
        state.every_second(3 * SECOND);
        let stations = |state: &State| state.slow(SECOND)["bridges"][0]["stations"].clone();
        assert_eq!(stations(&state), json!(["255/190 at 10.0.0.2:14550"]));
        for second in 4..8 {
            state.every_second(second * SECOND);
        }
        assert_eq!(stations(&state), json!(["255/190 at 10.0.0.2:14550 (silent)"]));
        let gone = "ground station 255/190 is silent: no status of gcs-bridge main";
        assert_eq!(texts(&state), ["ground station 255/190 is present", gone]);
        // The bridge returns.
        state.take(8 * SECOND, ground(false));
        assert_eq!(stations(&state), json!(["255/190 at 10.0.0.2:14550"]));
        assert_eq!(texts(&state).last(), Some(&"ground station 255/190 is present"));
        state.every_second(127 * SECOND);
        assert_eq!(state.slow(0)["bridges"].as_array().unwrap().len(), 1);
        state.every_second(128 * SECOND);
        assert_eq!(state.slow(0)["bridges"], json!([]));
    }

    #[test]
    fn a_detectors_row_joins_all_its_messages() {
        let mut state = State::new("own");
        state.take(SECOND / 2, status(Phase::Search, "looking"));
        state.take(0, Input::Detections("main".into(), Box::new(Detections::sample())));
        state.take(0, Input::Detections("other".into(), Box::new(Detections::sample())));
        let detectors = &state.slow(SECOND)["detectors"];
        assert_eq!(detectors[0]["name"], "main");
        assert_eq!(
            (&detectors[0]["in_use"], &detectors[0]["state"]),
            (&json!(true), &json!("in use"))
        );
        assert_eq!(
            (&detectors[0]["place"], &detectors[0]["age_ms"]),
            (&json!("onboard"), &json!(1000.0))
        );
        assert!(
            detectors[0]["sees"].as_str().unwrap().starts_with("rings, 55 px, 5.0"),
            "{detectors}"
        );
        assert_eq!(detectors[1]["state"], "not received by the controller");
        // A controller that sends nothing states no rate and no state of a detector.
        let later = &state.slow(3 * SECOND)["detectors"];
        for row in [&later[0], &later[1]] {
            assert_eq!(
                (&row["state"], &row["rate_hz"]),
                (&json!(words::WITHOUT_CONTROLLER), &Value::Null)
            );
        }
    }

    #[test]
    fn the_rate_of_frames_is_that_of_the_camera_in_use() {
        let mut state = State::new("own");
        let make = |service: &str, name: &str, hz| {
            let Input::Health(service, _, health) = health(service, 1, "a", 0.0, 1.0) else {
                unreachable!()
            };
            let rates = vec![messages::Rate { name: "frames".into(), count: 9, hz }];
            Input::Health(service, name.into(), Box::new(Health { rates, ..*health }))
        };
        state.take(0, make("detector", "main", 7.0));
        assert_eq!(state.frames_hz(), None, "the rate of a detector is not that of a camera");
        state.take(0, make("camera-pub", "aft", 15.0));
        assert_eq!(state.frames_hz(), Some(15.0));
        state.take(0, make("camera-pub", "down", 0.0));
        state.take(0, status(Phase::Search, "looking"));
        let info = DetectorInfo {
            detector: "main".into(),
            host: "pi".into(),
            place: Place::Onboard,
            camera: "down".into(),
            markers: Vec::new(),
            version: "0.1.0".into(),
            pid: 1,
        };
        state.take(0, Input::Detector("main".into(), Box::new(info)));
        assert_eq!(state.frames_hz(), Some(0.0));
    }

    #[test]
    fn the_stored_messages_are_bounded() {
        let mut state = State::new("own");
        for number in 0..500 {
            let name = format!("n{number}");
            state.take(0, Input::Detections(name.clone(), Box::new(Detections::sample())));
            let bridge = GcsStatus { bridge: name.clone(), ..GcsStatus::default() };
            state.take(0, Input::Ground(Box::new(bridge)));
            state.take(0, Input::Recorder(name.clone(), Box::default()));
            state.take(0, Input::Camera(name, Box::new(CameraInfo::sample())));
            state.take(0, health(&format!("s{number}"), 1, "a", 0.0, 1.0));
        }
        assert_eq!((state.found.len(), state.recorders.len()), (MAX_NAMES, MAX_NAMES));
        assert_eq!(state.cameras.len(), MAX_NAMES);
        assert_eq!((state.services.len(), state.bridges.len()), (MAX_NAMES, MAX_NAMES));
        // Silent senders are removed, which makes room for new ones.
        state.every_second(1000 * SECOND);
        assert_eq!((state.found.len(), state.recorders.len(), state.cameras.len()), (0, 0, 0));
        state.take(1000 * SECOND, Input::Recorder("new".into(), Box::default()));
        assert!(state.recorders.contains_key("new"));
    }

    #[test]
    fn a_bridge_or_recorder_above_the_limit_is_not_logged_with_each_status() {
        let mut state = State::new("own");
        for number in 0..MAX_NAMES {
            let bridge = GcsStatus { bridge: format!("n{number}"), ..GcsStatus::default() };
            state.take(0, Input::Ground(Box::new(bridge)));
            state.take(0, Input::Recorder(format!("n{number}"), Box::default()));
        }
        let full =
            RecorderStatus { problem: Some("the disk is full".into()), ..Default::default() };
        for _ in 0..5 {
            state.take(0, ground(false));
            state.take(0, Input::Recorder("more".into(), Box::new(full.clone())));
        }
        assert_eq!(texts(&state), Vec::<String>::new());
    }
}
