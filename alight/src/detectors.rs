//! `alight detectors`: which there are, which is used, and which should be.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write as _;
use std::io::Write as _;
use std::process::ExitCode;
use std::time::Duration;

use clap::{Args, Subcommand, ValueEnum};
use messages::{
    Candidate, ControllerCommand, ControllerStatus, DetectorInfo, DetectorState, Place, topic,
};
use node::{Identity, Node};
use serde::Serialize;

use crate::cli::{NetworkArgs, OPERATOR};
use crate::land::Format;
use crate::services;

/// Time for the network's answers: every detector tells about itself once a second.
const LISTENING: Duration = Duration::from_millis(1500);

/// What can be asked about detectors.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct DetectorsArgs {
    #[command(subcommand)]
    action: Option<Action>,
    /// A table for people, or one JSON object.
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
    /// Use detectors that run there rather than others, while they are healthy.
    Prefer {
        /// Where they run.
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

/// Lists the detectors, or tells the controller which to use.
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
    node::start_logging("warn");
    let zenoh = network.source(OPERATOR)?;
    let reply = services::runtime()?.block_on(async {
        let node = Node::open(operator("detectors"), &zenoh).await?;
        let reply = node.command(topic::COMMAND, &[], &command).await;
        node.close().await;
        reply
    })?;
    let verdict = if reply.accepted { "accepted" } else { "refused" };
    writeln!(std::io::stdout(), "{verdict}: {}", reply.reason)?;
    Ok(ExitCode::from(u8::from(!reply.accepted)))
}

/// The name under which a tool of this program joins.
pub(crate) fn operator(tool: &str) -> Identity {
    Identity { service: "alight", instance: format!("{tool}-{}", std::process::id()) }
}

fn list(network: &NetworkArgs, format: Format) -> anyhow::Result<ExitCode> {
    node::start_logging("warn");
    let zenoh = network.source(OPERATOR)?;
    let overview = services::runtime()?.block_on(async {
        let node = Node::open(operator("detectors"), &zenoh).await?;
        let overview = listen(&node).await;
        node.close().await;
        overview
    })?;
    let text = match format {
        Format::Text => overview.table(),
        Format::Json => serde_json::to_string(&overview)?,
    };
    writeln!(std::io::stdout(), "{text}")?;
    Ok(ExitCode::SUCCESS)
}

async fn listen(node: &Node) -> anyhow::Result<Overview> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let infos = node.subscriber(topic::DETECTOR_INFO, &[]).await?;
    let (mut status, mut told) = (None, BTreeMap::new());
    let hear = async {
        loop {
            tokio::select! {
                Some(news) = statuses.next() => status = Some(news),
                Some((key, info)) = infos.next_with_key() => {
                    // Its key says who it is, whatever it says.
                    let name = topic::DETECTOR_INFO.first_name(&key).unwrap_or_default();
                    told.insert(name.to_owned(), info);
                }
                else => return,
            }
        }
    };
    // Listening ends by the time that is allowed for it.
    let _ = tokio::time::timeout(LISTENING, hear).await;
    let ready = node.alive("detector", "*").await?.into_iter().collect();
    Ok(Overview::new(status, &told, ready))
}

/// Everything about the detectors of a vehicle.
#[derive(Serialize)]
struct Overview {
    controller: bool,
    active: Option<String>,
    why: String,
    preference: String,
    changes: u64,
    detectors: Vec<Entry>,
}

/// A detector as it is listed.
#[derive(Serialize)]
struct Entry {
    id: String,
    /// `active`, `shadow`, `stale`; `waiting` for one that the controller has not heard.
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
        told: &BTreeMap<String, DetectorInfo>,
        ready: BTreeSet<String>,
    ) -> Self {
        let controller = status.is_some();
        let status = status.unwrap_or_default();
        let heard: BTreeMap<&str, &Candidate> =
            status.candidates.iter().map(|heard| (heard.detector.as_str(), heard)).collect();
        let mut names: BTreeSet<&str> = heard.keys().copied().collect();
        names.extend(ready.iter().map(String::as_str));
        let entry = |name: &str| Entry::new(name, heard.get(name).copied(), told.get(name));
        let mut detectors: Vec<Entry> = names.into_iter().map(entry).collect();
        detectors.sort_by_key(|entry| entry.state != "active");
        Self {
            controller,
            active: status.active_detector.clone(),
            why: status.detector_why.clone(),
            preference: status.preference.clone(),
            changes: status.detector_changes,
            detectors,
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
            let word = |text: &Option<String>| text.clone().unwrap_or_else(|| "-".to_owned());
            rows.push([
                entry.id.clone(),
                entry.state.to_owned(),
                entry.place.map_or("-", Place::name).to_owned(),
                word(&entry.host),
                number(entry.rate_hz, "Hz", 1),
                number(entry.latency_ms, "ms", 0),
                number(entry.age_ms, "ms", 0),
                agrees,
                if entry.markers.is_empty() { "-".to_owned() } else { entry.markers.join(" ") },
                word(&entry.version),
            ]);
        }
        let mut text = aligned(&rows);
        let summary = match (self.controller, &self.active) {
            (false, _) => "No controller was heard: nobody uses them.".to_owned(),
            (true, None) => format!("None is used: {}.", self.why),
            (true, Some(active)) => {
                let preference = match self.preference.as_str() {
                    "" => "nothing is preferred".to_owned(),
                    preference => format!("preferred: {preference}"),
                };
                let changes = self.changes;
                format!("Used: {active} ({}); {preference}; {changes} changes so far.", self.why)
            }
        };
        text.push_str(&summary);
        text
    }
}

impl Entry {
    fn new(name: &str, heard: Option<&Candidate>, told: Option<&DetectorInfo>) -> Self {
        Self {
            id: name.to_owned(),
            state: match heard.map(|heard| heard.state) {
                Some(DetectorState::Active) => "active",
                Some(DetectorState::Shadow) => "shadow",
                Some(DetectorState::Stale) => "stale",
                None => "waiting",
            },
            place: heard.and_then(|heard| heard.place).or(told.map(|told| told.place)),
            host: told.map(|told| told.host.clone()),
            markers: told.map(|told| told.markers.clone()).unwrap_or_default(),
            version: told.map(|told| told.version.clone()),
            rate_hz: heard.map(|heard| heard.rate_hz),
            latency_ms: heard.map(|heard| heard.latency_ms),
            age_ms: heard.map(|heard| heard.age_ms),
            compared: heard.map(|heard| heard.compared),
            agreed: heard.map(|heard| heard.agreed),
            disagreement_m: heard.and_then(|heard| heard.disagreement_m),
        }
    }
}

/// Rows as lines whose columns stand below each other.
fn aligned<const N: usize>(rows: &[[String; N]]) -> String {
    let mut text = String::new();
    let width = |column: usize| {
        let cells = rows.iter().filter_map(|row| row.get(column));
        cells.map(|cell| cell.chars().count()).max().unwrap_or(0)
    };
    for row in rows {
        let mut line = String::new();
        for (column, cell) in row.iter().enumerate() {
            // Writing to a string cannot fail.
            let _ = write!(line, "{cell:<width$}  ", width = width(column));
        }
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_list_joins_what_the_controller_hears_with_what_the_detectors_tell() {
        let candidate = |name: &str, state| Candidate {
            detector: name.into(),
            state,
            place: Some(Place::Onboard),
            age_ms: 60.0,
            latency_ms: 41.4,
            rate_hz: 15.0,
            alive: true,
            disagreement_m: Some(0.0123),
            compared: if state == DetectorState::Shadow { 30 } else { 0 },
            agreed: 29,
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
        let told = [("main".to_owned(), info)].into();
        let ready = ["main".to_owned(), "late".to_owned()].into();
        let table = Overview::new(Some(status), &told, ready).table();
        let lines: Vec<&str> = table.lines().collect();
        assert!(lines[1].starts_with("main") && lines[1].contains("rings:0.15341"), "{table}");
        assert!(lines[2].contains("shadow") && lines[2].contains("29 of 30, 0.012 m"), "{table}");
        assert!(lines[3].starts_with("late") && lines[3].contains("waiting"), "{table}");
        assert!(lines[4].contains("preferred: ground; 3 changes"), "{table}");
        let nobody = Overview::new(None, &told, BTreeSet::new()).table();
        assert!(nobody.contains("No controller"), "{nobody}");
    }
}
