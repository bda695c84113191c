//! `alight detectors`: lists the detectors, and chooses the one to use.

use std::collections::{BTreeMap, BTreeSet};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use messages::{
    Candidate, ControllerCommand, ControllerStatus, DetectorInfo, DetectorState, Place, topic,
};
use node::Node;
use serde::Serialize;

use crate::args::{Format, NetworkArgs};
use crate::command::send_to_controller;
use crate::runtime::with_node;
use crate::terminal::{aligned, print};

/// Duration of listening: every detector publishes its information once a second.
const LISTENING: Duration = Duration::from_millis(1500);

/// The arguments of `alight detectors`.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true)]
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
        #[command(flatten)]
        network: NetworkArgs,
    },
    /// Prefer detectors that run at this place, while they are healthy.
    Prefer {
        /// The place.
        #[arg(value_enum)]
        place: Where,
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
}

/// Lists the detectors, or has the controller choose one.
pub(crate) fn run(args: DetectorsArgs) -> anyhow::Result<ExitCode> {
    let (network, command) = match args.action {
        None => return list(&args.network, args.format),
        Some(Action::Use { id, network }) => (network, ControllerCommand::UseDetector(id)),
        Some(Action::Prefer { place, network }) => {
            let place = match place {
                Where::Onboard => Place::Onboard,
                Where::Ground => Place::Ground,
            };
            (network, ControllerCommand::PreferDetectors(place))
        }
    };
    send_to_controller(&network, "detectors", &command)
}

fn list(network: &NetworkArgs, format: Format) -> anyhow::Result<ExitCode> {
    let overview = with_node(network, "detectors", listen)?;
    print(&match format {
        Format::Text => overview.table(),
        Format::Json => serde_json::to_string(&overview)?,
    })?;
    Ok(ExitCode::SUCCESS)
}

async fn listen(node: &Node) -> anyhow::Result<Overview> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let (mut status, mut announced) = (None, BTreeMap::new());
    let receive = async {
        loop {
            tokio::select! {
                Some(latest) = statuses.next() => status = Some(latest),
                Some((key, info)) = infos.next_with_key() => {
                    // A detector is identified by its key, not by the message.
                    let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                    announced.insert(name.to_owned(), info);
                }
                else => return,
            }
        }
    };
    // Ends by the timeout.
    let _ = tokio::time::timeout(LISTENING, receive).await;
    let ready = node.alive("detector", "*").await?.into_iter().collect();
    Ok(Overview::new(status, &announced, ready))
}

/// The detectors of a vehicle.
#[derive(Serialize)]
struct Overview {
    controller: bool,
    active: Option<String>,
    why: String,
    preference: String,
    changes: u64,
    detectors: Vec<Entry>,
    /// What the controller refuses, and which detectors disagree.
    warnings: Vec<String>,
}

/// A detector in the list.
#[derive(Serialize)]
struct Entry {
    id: String,
    /// `active`, `shadow`, `stale`; `waiting` for one from which the controller has received nothing.
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
        status: Option<ControllerStatus>,
        announced: &BTreeMap<String, DetectorInfo>,
        ready: BTreeSet<String>,
    ) -> Self {
        let controller = status.is_some();
        let status = status.unwrap_or_default();
        let candidates: BTreeMap<&str, &Candidate> =
            status.candidates.iter().map(|c| (c.detector.as_str(), c)).collect();
        let mut names: BTreeSet<&str> = candidates.keys().copied().collect();
        names.extend(ready.iter().map(String::as_str));
        let entry =
            |name: &str| Entry::new(name, candidates.get(name).copied(), announced.get(name));
        let mut detectors: Vec<Entry> = names.into_iter().map(entry).collect();
        detectors.sort_by_key(|entry| entry.state != "active");
        Self {
            controller,
            active: status.active_detector.clone(),
            why: status.detector_why.clone(),
            preference: status.preference.clone(),
            changes: status.detector_changes,
            detectors,
            warnings: status.warnings,
        }
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
        let mut text = aligned(&rows);
        let summary = match (self.controller, &self.active) {
            (false, _) => "No controller is running, so none is in use.".to_owned(),
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
    fn new(name: &str, candidate: Option<&Candidate>, info: Option<&DetectorInfo>) -> Self {
        Self {
            id: name.to_owned(),
            state: match candidate.map(|c| c.state) {
                Some(DetectorState::Active) => "active",
                Some(DetectorState::Shadow) => "shadow",
                Some(DetectorState::Stale) => "stale",
                None => "waiting",
            },
            place: candidate.and_then(|c| c.place).or(info.map(|info| info.place)),
            host: info.map(|info| info.host.clone()),
            markers: info.map(|info| info.markers.clone()).unwrap_or_default(),
            version: info.map(|info| info.version.clone()),
            rate_hz: candidate.map(|c| c.rate_hz),
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
        let ready = ["main".to_owned(), "late".to_owned()].into();
        let table = Overview::new(Some(status), &announced, ready).table();
        let lines: Vec<&str> = table.lines().collect();
        assert!(lines[1].starts_with("main") && lines[1].contains("rings:0.15341"), "{table}");
        assert!(lines[2].contains("shadow") && lines[2].contains("29 of 30, 0.012 m"), "{table}");
        assert!(lines[3].starts_with("late") && lines[3].contains("waiting"), "{table}");
        assert!(lines[4].contains("preferred: ground; 3 changes"), "{table}");
        assert!(lines[5].starts_with("Warning: detections of `late`"), "{table}");
        let nobody = Overview::new(None, &announced, BTreeSet::new()).table();
        assert!(nobody.contains("No controller"), "{nobody}");
    }
}
