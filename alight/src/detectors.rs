//! `alight detectors`: lists detectors with place, markers, frame rate and whether the controller uses them, from their
//! information and its status; or sends it the choice of one, or of a place.

use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use messages::{
    Candidate, Configuration, ControllerCommand, ControllerStatus, DetectorInfo, DetectorState,
    Place, looks_for_others, topic,
};
use node::Node;
use serde::Serialize;

use crate::args::{Format, NetworkArgs};
use crate::command::Sending;
use crate::runtime::with_node;
use crate::terminal::{aligned, print};

/// Duration of the subscription: every detector publishes its information once a second.
const LISTENING: Duration = Duration::from_millis(1500);
/// Further time for the controller's configuration, which is published every 3 s.
const CONFIGURATION_TIMEOUT: Duration = Duration::from_secs(2);

/// The meaning of the exit status.
const EXIT_STATUS: &str = "Exit status: 0 done; 1 when the list has neither a controller nor a detector, or the controller did not accept the \
                           choice; 2 wrong use.";

/// The arguments of `alight detectors`.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true, after_help = EXIT_STATUS)]
pub(crate) struct DetectorsArgs {
    #[command(subcommand)]
    action: Option<Action>,
    /// Format of the list: a table, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    network: NetworkArgs,
}

#[derive(Subcommand)]
enum Action {
    /// Use this detector while it is healthy.
    Use {
        /// Its name.
        id: String,
        /// Format of the reply: text, or one JSON object (`accepted`, `by`, `reason`; `accepted` is null without a reply).
        #[arg(long, value_enum, default_value_t)]
        format: Format,
        #[command(flatten)]
        network: NetworkArgs,
    },
    /// Prefer detectors that run at this place, while they are healthy, or none to another.
    Prefer {
        /// The place; `any` removes the preference.
        #[arg(value_enum)]
        place: Where,
        /// Format of the reply: text, or one JSON object (`accepted`, `by`, `reason`; `accepted` is null without a reply).
        #[arg(long, value_enum, default_value_t)]
        format: Format,
        #[command(flatten)]
        network: NetworkArgs,
    },
}

/// Where a detector runs.
#[derive(Clone, Copy, ValueEnum)]
enum Where {
    /// On the vehicle.
    Onboard,
    /// On the ground.
    Ground,
    /// Anywhere.
    Any,
}

/// Lists the detectors, or has the controller choose one.
pub(crate) fn run(args: DetectorsArgs) -> anyhow::Result<ExitCode> {
    let (network, format, command) = match args.action {
        None => return list(&args.network, args.format),
        Some(Action::Use { id, format, network }) => {
            (network, format, ControllerCommand::UseDetector(id))
        }
        Some(Action::Prefer { place, format, network }) => {
            let command = match place {
                Where::Onboard => ControllerCommand::PreferDetectors(Place::Onboard),
                Where::Ground => ControllerCommand::PreferDetectors(Place::Ground),
                Where::Any => ControllerCommand::PreferAnyDetector,
            };
            (network, format, command)
        }
    };
    Sending { network: &network, tool: "detectors", format }.send_to_controller(&command)
}

fn list(network: &NetworkArgs, format: Format) -> anyhow::Result<ExitCode> {
    let overview = with_node(network, "detectors", listen)?;
    print(&match format {
        Format::Text => overview.table(),
        Format::Json => serde_json::to_string(&overview)?,
    })?;
    Ok(ExitCode::from(u8::from(overview.is_empty())))
}

async fn listen(node: &Node) -> anyhow::Result<Overview> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let detections = node.subscriber(topic::DETECTIONS, &[]).await?;
    let configurations = node.subscriber(topic::CONFIGURATION, &["controller"]).await?;
    let (mut status, mut announced, mut marker) = (None, BTreeMap::new(), None);
    let mut published: BTreeMap<String, u32> = BTreeMap::new();
    let receive = async {
        loop {
            tokio::select! {
                Some(latest) = statuses.next() => status = Some(latest),
                Some((key, info)) = infos.next_with_key() => {
                    // A detector is identified by its key, not by the message.
                    let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                    announced.insert(name.to_owned(), info);
                }
                Some((key, _)) = detections.next_with_key() => {
                    let name = topic::DETECTIONS.first_name(&key).unwrap_or_default();
                    *published.entry(name.to_owned()).or_default() += 1;
                }
                Some(configuration) = configurations.next() => marker = marker_of(&configuration),
                else => return,
            }
        }
    };
    // Ends by the timeout.
    let _ = tokio::time::timeout(LISTENING, receive).await;
    if status.is_some() && marker.is_none() {
        let next = tokio::time::timeout(CONFIGURATION_TIMEOUT, configurations.next()).await;
        marker = next.ok().flatten().as_ref().and_then(marker_of);
    }
    let ready: BTreeSet<String> = node.alive("detector", "*").await?.into_iter().collect();
    let rate_hz = |count| f64::from(count) / LISTENING.as_secs_f64();
    let mut running: BTreeMap<String, f64> = ready.into_iter().map(|name| (name, 0.0)).collect();
    running.extend(published.into_iter().map(|(name, count)| (name, rate_hz(count))));
    let controller = match (status, &marker) {
        (Some(status), _) => Controller::Read(Box::new(status)),
        (None, None) if node.alive("controller", "*").await?.is_empty() => {
            Controller::Absent(node.explain_silence("controller", None).await)
        }
        (None, _) => Controller::Unread,
    };
    Ok(Overview::new(controller, marker, &announced, &running))
}

/// The marker of a controller's landing.
fn marker_of(controller: &Configuration) -> Option<String> {
    let table: toml::Table = controller.toml.parse().ok()?;
    table.get("marker")?.as_str().map(str::to_owned)
}

/// The state of the controller.
enum Controller {
    /// No controller answers, with the reason.
    Absent(String),
    /// One is running, and no status of it could be read.
    Unread,
    Read(Box<ControllerStatus>),
}

/// The detectors of a vehicle.
#[derive(Serialize)]
struct Overview {
    /// Whether one is running.
    controller: bool,
    /// Whether its status could be read: without it the detector in use is not known.
    status_read: bool,
    active: Option<String>,
    why: String,
    preference: String,
    changes: u64,
    /// The marker of the landing; `None` when the controller did not publish it.
    marker: Option<String>,
    detectors: Vec<Entry>,
    /// Warnings: refused detections, detectors that disagree, and detectors that look for another marker.
    warnings: Vec<String>,
}

/// A detector in the list.
#[derive(Serialize)]
struct Entry {
    id: String,
    /// `active`, `shadow`, `stale`, `blind`, `no-pose`, `outvoted`; `waiting` for one from which the controller has received nothing, and
    /// `other-marker` for one that answers and never reports the marker of the landing. Where no controller's status is read,
    /// `publishing`, or `silent` for one without messages.
    state: &'static str,
    place: Option<Place>,
    host: Option<String>,
    markers: Vec<String>,
    version: Option<String>,
    rate_hz: Option<f64>,
    latency_ms: Option<f64>,
    age_ms: Option<f64>,
    compared: Option<u32>,
    agreed: Option<u32>,
    disagreement_m: Option<f64>,
}

impl Overview {
    fn new(
        controller: Controller,
        marker: Option<String>,
        announced: &BTreeMap<String, DetectorInfo>,
        running: &BTreeMap<String, f64>,
    ) -> Self {
        let (controller, status_read, status) = match controller {
            Controller::Absent(detector_why) => {
                (false, false, ControllerStatus { detector_why, ..ControllerStatus::default() })
            }
            Controller::Unread => (true, false, ControllerStatus::default()),
            Controller::Read(status) => (true, true, *status),
        };
        let candidates: BTreeMap<&str, &Candidate> =
            status.candidates.iter().map(|c| (c.detector.as_str(), c)).collect();
        let mut names: BTreeSet<&str> = candidates.keys().copied().collect();
        names.extend(running.keys().map(String::as_str));
        let entry = |name: &str| {
            let (candidate, info) = (candidates.get(name).copied(), announced.get(name));
            let received_hz = running.get(name).copied().filter(|rate_hz| *rate_hz > 0.0);
            Entry::new(name, candidate, info, marker.as_deref(), status_read, received_hz)
        };
        let mut detectors: Vec<Entry> = names.into_iter().map(entry).collect();
        detectors.sort_by_key(|entry| entry.state != "active");
        let mut warnings = status.warnings;
        if let Some(marker) = &marker {
            let others = detectors.iter().filter(|it| looks_for_others(&it.markers, marker));
            warnings.extend(others.map(|it| {
                format!(
                    "detector `{}` looks for {}, and the landing is on {marker}; \
                     `alight command --detector {} set 'markers=[\"FAMILY:ID:SIZE_M\"]'` changes that",
                    it.id,
                    it.markers.join(" "),
                    it.id
                )
            }));
        }
        Self {
            controller,
            status_read,
            active: status.active_detector.clone(),
            why: status.detector_why.clone(),
            preference: status.preference.clone(),
            changes: status.detector_changes,
            marker,
            detectors,
            warnings,
        }
    }

    /// Whether neither a controller nor a detector was reached.
    fn is_empty(&self) -> bool {
        !self.controller && self.detectors.is_empty()
    }

    fn table(&self) -> String {
        let number = |value: Option<f64>, unit: &str, digits: usize| {
            value.map_or("-".to_owned(), |value| format!("{value:.digits$} {unit}"))
        };
        let mut rows = vec![
            [
                "ID", "STATE", "PLACE", "HOST", "RATE", "LATENCY", "AGE", "AGREES", "MARKERS",
                "VERSION",
            ]
            .map(str::to_owned),
        ];
        for entry in &self.detectors {
            let agrees = match (entry.agreed, entry.compared, entry.disagreement_m) {
                (Some(agreed), Some(compared @ 1..), apart_m) => {
                    let apart = apart_m.map_or_else(String::new, |m| format!(", {m:.3} m"));
                    format!("{agreed} of {compared}{apart}")
                }
                _ => "-".to_owned(),
            };
            let cell = |text: &Option<String>| text.clone().unwrap_or_else(|| "-".to_owned());
            rows.push([
                entry.id.clone(),
                entry.state.to_owned(),
                entry.place.map_or("-", Place::name).to_owned(),
                cell(&entry.host),
                number(entry.rate_hz, "Hz", 1),
                number(entry.latency_ms, "ms", 0),
                number(entry.age_ms, "ms", 0),
                agrees,
                if entry.markers.is_empty() { "-".to_owned() } else { entry.markers.join(" ") },
                cell(&entry.version),
            ]);
        }
        let mut text = match self.detectors.is_empty() {
            true => "No detector is there: none is alive, and none publishes detections. Start one: `alight detector`, `alight up`.\n".to_owned(),
            false => aligned(&rows),
        };
        let summary = match (self.controller, &self.active) {
            (false, _) => format!("No controller answers, so none is in use: {}", self.why),
            (true, _) if !self.status_read => {
                "A controller is running, and no status of it can be read: is it of another version, or is it stopped? \
                 Which detector is in use is not known."
                    .to_owned()
            }
            (true, None) => format!("None is in use: {}.", self.why),
            (true, Some(active)) => {
                let preference = match self.preference.as_str() {
                    "" => "no preference".to_owned(),
                    preference => format!("preferred: {preference}"),
                };
                let changes = self.changes;
                format!("Used: {active} ({}); {preference}; {changes} changes so far.", self.why)
            }
        };
        text.push_str(&summary);
        for warning in &self.warnings {
            text.push_str("\nWarning: ");
            text.push_str(warning);
        }
        text
    }
}

impl Entry {
    fn new(
        name: &str,
        candidate: Option<&Candidate>,
        info: Option<&DetectorInfo>,
        wanted: Option<&str>,
        status_read: bool,
        received_hz: Option<f64>,
    ) -> Self {
        let looks_for_others =
            wanted.zip(info).is_some_and(|(wanted, info)| looks_for_others(&info.markers, wanted));
        Self {
            id: name.to_owned(),
            state: match candidate.map(|c| c.state) {
                Some(DetectorState::Active) => "active",
                Some(DetectorState::Stale) => "stale",
                Some(_) if looks_for_others => "other-marker",
                Some(DetectorState::Shadow) => "shadow",
                Some(DetectorState::Blind) => "blind",
                Some(DetectorState::Outvoted) => "outvoted",
                Some(DetectorState::NoPose) => "no-pose",
                None if status_read => "waiting",
                None if received_hz.is_some() => "publishing",
                None => "silent",
            },
            place: candidate.and_then(|c| c.place).or(info.map(|info| info.place)),
            host: info.map(|info| info.host.clone()),
            markers: info.map(|info| info.markers.clone()).unwrap_or_default(),
            version: info.map(|info| info.version.clone()),
            rate_hz: candidate.map(|c| c.rate_hz).or(received_hz),
            latency_ms: candidate.map(|c| c.latency_ms),
            age_ms: candidate.map(|c| c.age_ms),
            compared: candidate.map(|c| c.compared),
            agreed: candidate.map(|c| c.agreed),
            disagreement_m: candidate.and_then(|c| c.disagreement_m),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_joins_candidates_and_announced_detectors() {
        let candidate = |name: &str, state| Candidate {
            detector: name.into(),
            state,
            place: Some(Place::Onboard),
            age_ms: 60.0,
            latency_ms: 41.4,
            disagreement_m: Some(0.0123),
            compared: if state == DetectorState::Shadow { 30 } else { 0 },
            agreed: 29,
            ..Candidate::sample()
        };
        let status = ControllerStatus {
            active_detector: Some("main".into()),
            detector_why: "it is the first".into(),
            preference: "ground".into(),
            detector_changes: 3,
            candidates: vec![
                candidate("first", DetectorState::Shadow),
                candidate("main", DetectorState::Active),
            ],
            warnings: vec!["detections of `late` are refused".into()],
            ..ControllerStatus::default()
        };
        let info = DetectorInfo {
            detector: "main".into(),
            host: "pi".into(),
            place: Place::Onboard,
            camera: "down".into(),
            markers: vec!["rings:0.15341".into()],
            version: "alight 0.1.0".into(),
            pid: 7,
        };
        let announced = [("main".to_owned(), info)].into();
        let running = [("main".to_owned(), 10.0), ("late".to_owned(), 0.0)].into();
        let controller = Controller::Read(Box::new(status));
        let table = Overview::new(controller, None, &announced, &running).table();
        let lines: Vec<&str> = table.lines().collect();
        assert!(lines[1].starts_with("main") && lines[1].contains("rings:0.15341"), "{table}");
        assert!(lines[2].contains("shadow") && lines[2].contains("29 of 30, 0.012 m"), "{table}");
        assert!(lines[3].starts_with("late") && lines[3].contains("waiting"), "{table}");
        assert!(lines[4].contains("preferred: ground; 3 changes"), "{table}");
        assert!(lines[5].starts_with("Warning: detections of `late`"), "{table}");
        let absent = Controller::Absent("no process listens at 10.0.0.1:7448".to_owned());
        let without_status = Overview::new(absent, None, &announced, &running).table();
        let lines: Vec<&str> = without_status.lines().collect();
        assert!(lines[1].starts_with("late") && lines[1].contains("silent"), "{without_status}");
        assert!(
            lines[2].contains("publishing") && lines[2].contains("10.0 Hz"),
            "{without_status}"
        );
        assert!(without_status.contains("No controller answers"), "{without_status}");
        assert!(without_status.contains("no process listens at 10.0.0.1:7448"), "{without_status}");
        // As its configuration is read, whose version is the same.
        let marker = Some("rings".to_owned());
        let unread = Overview::new(Controller::Unread, marker, &announced, &BTreeMap::new());
        assert!(unread.controller && !unread.status_read && !unread.is_empty());
        let nothing = Controller::Absent("no program listens".to_owned());
        let nothing = Overview::new(nothing, None, &BTreeMap::new(), &BTreeMap::new());
        assert!(nothing.is_empty());
        let unread = unread.table();
        assert!(unread.starts_with("No detector is there: none is alive"), "{unread}");
        assert!(!unread.contains("LATENCY") && !without_status.contains("No detector is there"));
        assert!(unread.contains("A controller is running") && !unread.contains("No controller"));
        assert!(unread.contains("is it of another version"), "{unread}");
    }

    #[test]
    fn one_that_looks_for_another_marker_is_not_called_stale() {
        let states = [
            ("main", DetectorState::Active, "rings:0.15341"),
            ("blind", DetectorState::Blind, "rings:0.15341"),
            ("late", DetectorState::Stale, "aruco-4x4-50:7:0.15"),
            ("outlier", DetectorState::Outvoted, "rings:0.15341"),
            ("tag", DetectorState::Blind, "aruco-4x4-50:7:0.15"),
            ("uncalibrated", DetectorState::NoPose, "rings:0.15341"),
        ];
        let candidates = states.map(|(name, state, _)| Candidate {
            detector: name.into(),
            state,
            ..Candidate::sample()
        });
        let status =
            ControllerStatus { candidates: candidates.into(), ..ControllerStatus::default() };
        let info = |markers: &str| DetectorInfo {
            detector: String::new(),
            host: "pi".into(),
            place: Place::Onboard,
            camera: "down".into(),
            markers: vec![markers.into()],
            version: "alight 0.1.0".into(),
            pid: 7,
        };
        let announced = states.map(|(name, _, markers)| (name.to_owned(), info(markers))).into();
        let marker = marker_of(&Configuration {
            service: "controller".into(),
            instance: "main".into(),
            host: "pi".into(),
            version: "0.1.0".into(),
            toml: "marker = \"rings\"".into(),
        });
        let controller = Controller::Read(Box::new(status));
        let overview = Overview::new(controller, marker, &announced, &BTreeMap::new());
        let states: Vec<_> =
            overview.detectors.iter().map(|it| (it.id.as_str(), it.state)).collect();
        let expected = [
            ("main", "active"),
            ("blind", "blind"),
            ("late", "stale"),
            ("outlier", "outvoted"),
            ("tag", "other-marker"),
            ("uncalibrated", "no-pose"),
        ];
        assert_eq!(states, expected);
        let table = overview.table();
        let said =
            "Warning: detector `tag` looks for aruco-4x4-50:7:0.15, and the landing is on rings;";
        assert!(table.contains(said), "{table}");
        assert!(!table.contains("detector `main` looks"), "{table}");
    }
}
