//! Makes the sections of the report, from landing, phases and height to log, configuration and recording: the charts and tables
//! of each for one flight, and the messages that were not recorded.

use std::collections::{BTreeMap, BTreeSet};

use crate::chart::Chart;
use crate::flight::{Bridge, Flight};
use crate::frames::Fate;
use crate::html::{Block, Cell, count, details, missing, number, paragraph, table, text};
use crate::summary::counted;
use crate::view::View;
use crate::{journal, light, losses, plots};

/// Age of a bridge's last status at the end beyond which it does not hold for the end, in nanoseconds; one is published every 2 s.
const MAX_STATUS_AGE_NS: i64 = 5_000_000_000;

/// A part of the page, for one flight.
#[derive(Clone, Debug)]
pub struct Section {
    /// Its name in links.
    pub id: &'static str,
    /// Its title.
    pub title: &'static str,
    /// Its explanation, for a first reader; may be empty.
    pub lead: &'static str,
    /// Its charts.
    pub charts: Vec<Chart>,
    /// The blocks before the charts.
    pub before: Vec<Block>,
    /// The blocks after the charts.
    pub after: Vec<Block>,
}

/// The sections of a flight, in order: the same for each flight.
pub fn of(view: &View<'_>) -> Vec<Section> {
    vec![
        landing(view),
        phases(view),
        height(view),
        velocity(view),
        detections(view),
        latency(view),
        lost(view),
        detectors(view),
        wind(view),
        battery(view),
        log(view),
        thesis(view),
        configuration(view),
        recording(view),
    ]
}

fn section(id: &'static str, title: &'static str, lead: &'static str) -> Section {
    Section { id, title, lead, charts: Vec::new(), before: Vec::new(), after: Vec::new() }
}

fn landing(view: &View<'_>) -> Section {
    let mut section = section("landing", "The landing in one picture", "");
    section.charts = plots::landing(view);
    if view.truth.is_empty() {
        section.before.push(missing("truth, which only a simulation has"));
    }
    if view.estimated.is_empty() {
        section
            .before
            .push(missing("the estimate of the landing point; or the marker was never seen"));
    }
    section
}

fn phases(view: &View<'_>) -> Section {
    let mut section = section(
        "phases",
        "Phases and reasons",
        match view.summary.has_landing {
            true => {
                "The controller's phases, with their reasons. Times count from the begin of the landing."
            }
            false => {
                "The controller's phases, with their reasons. Times count from the begin of the recording."
            }
        },
    );
    let mut rows = Vec::new();
    for phase in &view.summary.phases {
        for (index, reason) in phase.reasons.iter().enumerate() {
            let name = if index == 0 { phase.name.as_str() } else { "" };
            let next = phase.reasons.get(index + 1).map_or(phase.to_s, |next| next.from_s);
            rows.push(vec![
                number(Some(reason.from_s), 1, "s"),
                number(Some(next - reason.from_s), 1, "s"),
                text(name),
                text(&reason.why),
            ]);
        }
    }
    if view.flight.is_rebuilt {
        section.before.push(missing(
            "the controller's status; the texts here and below are from a replay of its tape",
        ));
    }
    section.after.push(match rows.is_empty() {
        true => missing("the controller's status"),
        false => table(&["from", "for", "phase", "reason"], rows),
    });
    section
}

fn height(view: &View<'_>) -> Section {
    let mut section = section(
        "height",
        "Height, distance and the estimate's error",
        "The error is that of the vehicle's position relative to the pad: estimated less true, horizontally.",
    );
    section.charts = plots::height(view);
    let summary = &view.summary;
    if view.errors.is_empty() {
        section.before.push(missing("truth, so the estimate's error is not known"));
    } else {
        let rows = vec![vec![
            text(
                "horizontal error of the estimate, from the begin of the landing to the touchdown",
            ),
            number(summary.estimate_error_p50_m, 3, "m"),
            number(summary.estimate_error_p95_m, 3, "m"),
        ]];
        section.after.push(table(&["", "median", "95 %"], rows));
    }
    section
}

fn velocity(view: &View<'_>) -> Section {
    let mut section = section(
        "setpoints",
        "Setpoints and response",
        "The controller's setpoints, and the vehicle's response as its autopilot reports it.",
    );
    section.charts = plots::velocity(view);
    if view.flight.vehicle.is_empty() {
        section.before.push(missing("the vehicle's state"));
    }
    if view.setpoints.iter().all(|it| !it.velocity_ned_m_s.iter().all(|v| v.is_finite())) {
        section.before.push(missing("velocity setpoints; or none were sent"));
    } else if view.flight.tapes.is_empty() {
        section.before.push(paragraph(
            "Setpoints are those of the controller's status, five a second: the tape, which has each, was not recorded.",
        ));
    }
    section
}

fn detections(view: &View<'_>) -> Section {
    let mut section = section(
        "detections",
        "Detections and refusals",
        "Every frame that a detector searched, by its outcome.",
    );
    if view.frames.all.is_empty() {
        section.before.push(missing("detections"));
        return section;
    }
    section.charts = plots::detections(view);
    if !view.frames.is_from_tape {
        section.before.push(paragraph(
            "Without the controller's tape the outcomes are those that its estimates show: a frame that is not known may have been refused.",
        ));
    }
    let mut counts: BTreeMap<(&Fate, &str), u64> = BTreeMap::new();
    for frame in &view.frames.all {
        *counts.entry((&frame.fate, &frame.detector)).or_default() += 1;
    }
    let all = view.frames.all.len() as f64;
    let rows: Vec<Vec<Cell>> = counts
        .into_iter()
        .map(|((fate, detector), frames)| {
            vec![
                text(fate.name()),
                text(fate.meaning()),
                text(detector),
                count(frames),
                number(Some(100.0 * frames as f64 / all), 1, "%"),
            ]
        })
        .collect();
    section.after.push(table(&["", "meaning", "detector", "frames", "of all"], rows));
    let light = view.flight.light.iter();
    let rows: Vec<Vec<Cell>> = light
        .filter_map(|(camera, pictures)| {
            let usual = light::usual(pictures)?;
            Some(vec![
                text(camera),
                count(pictures.len() as u64),
                number(Some(100.0 * usual.mean), 1, "%"),
                number(Some(100.0 * usual.brightest), 1, "%"),
                number(Some(100.0 * usual.noise), 1, "%"),
                number(usual.exposure_ms, 1, "ms"),
            ])
        })
        .collect();
    if rows.is_empty() {
        section.before.push(missing("pictures, so the light is not known"));
    } else {
        let head = [
            "camera",
            "pictures measured",
            "mean brightness",
            "brightest hundredth",
            "noise",
            "exposure",
        ];
        section.after.push(table(&head, rows));
    }
    section
}

fn latency(view: &View<'_>) -> Section {
    let mut section = section(
        "latency",
        "Latency budget",
        "From mid-exposure of a frame to the setpoint that uses it, stage by stage. The table is of the frames of the landing.",
    );
    let stages = &view.summary.latency;
    if view.frames.all.is_empty() {
        section.before.push(missing("detections, so no latency is known"));
        return section;
    }
    section.charts = plots::latency(view);
    if stages.is_empty() {
        section.before.push(paragraph("No frame was searched during a landing."));
    }
    if !view.frames.is_from_tape {
        section.before.push(paragraph(
            "Without the controller's tape the times are those at which the recorder had the detections; setpoints cannot be distinguished.",
        ));
    }
    let rows: Vec<Vec<Cell>> = stages
        .iter()
        .map(|stage| {
            let name = if stage.is_part { format!("- {}", stage.name) } else { stage.name.clone() };
            let ms = |value: f64| number(Some(value), 1, "ms");
            vec![
                text(name),
                count(stage.frames as u64),
                ms(stage.p50_ms),
                ms(stage.p90_ms),
                ms(stage.p99_ms),
                ms(stage.max_ms),
            ]
        })
        .collect();
    section.after.push(table(&["stage", "frames", "median", "90 %", "99 %", "longest"], rows));
    section
}

fn lost(view: &View<'_>) -> Section {
    let flight = view.flight;
    let mut section = section(
        "losses",
        "Losses",
        "Missing messages, as the file itself counts them. Counts of a process are since its start.",
    );
    let rows = |losses: Vec<losses::Loss>| -> Vec<Vec<Cell>> {
        losses
            .into_iter()
            .map(|loss| {
                let of = loss.of.map_or("-".to_owned(), |of| of.to_string());
                vec![text(loss.place), text(loss.kind), count(loss.count), Cell::Number(of)]
            })
            .collect()
    };
    let mut counted = rows(losses::frames(flight));
    if counted.is_empty() {
        section.before.push(missing("frames and detections, so none can be counted as missing"));
    }
    let by_recorder = losses::recorder(flight);
    if by_recorder.is_empty() {
        section.before.push(paragraph("The recorder counted no message as lost."));
    } else {
        let all: u64 = by_recorder.iter().map(|loss| loss.count).fold(0, u64::saturating_add);
        section.after.push(details(
            &format!("{all} messages that the recorder lost, by key"),
            table(&["where", "kind", "missing", "of"], rows(by_recorder)),
        ));
    }
    counted.extend(rows(losses::tape(flight)));
    if flight.tapes.is_empty() {
        section.before.push(missing("the controller's tape: the flight cannot be replayed"));
    }
    let processes = rows(losses::processes(flight));
    if flight.processes.is_empty() {
        section.before.push(missing("the health of the processes, with their dropped messages"));
    }
    section.after.insert(0, table(&["where", "kind", "missing", "of"], counted));
    section.after.push(table(&["process", "dropped or failed", "times", "of"], processes));
    section
}

fn detectors(view: &View<'_>) -> Section {
    let flight = view.flight;
    let mut section = section("detectors", "Detectors", "");
    let Some(last) = flight.last_status() else {
        section.before.push(missing("the controller's status, which names the detector in use"));
        return section;
    };
    let mut changes = Vec::new();
    let mut before: Option<&str> = None;
    for status in &flight.statuses {
        let now = status.active_detector.as_deref();
        if now != before {
            changes.push(vec![
                number(Some(flight.at_s(status.stamp_ns)), 1, "s"),
                text(before.unwrap_or("none")),
                text(now.unwrap_or("none")),
                text(&status.detector_why),
            ]);
        }
        before = now;
    }
    section.before.push(paragraph(&format!(
        "{}; preferred at the end: {}.",
        counted(view.summary.detector_changes.unwrap_or(0), "change", "changes"),
        if last.preference.is_empty() { "nothing" } else { &last.preference }
    )));
    section.after.push(table(&["at", "from", "to", "why"], changes));
    // Each detector by the last status that contains it.
    let mut known = BTreeMap::new();
    for candidate in flight.statuses.iter().flat_map(|status| &status.candidates) {
        known.insert(candidate.detector.as_str(), candidate);
    }
    let rows: Vec<Vec<Cell>> =
        known
            .into_values()
            .map(|it| {
                let info = flight.detectors.get(&it.detector);
                vec![
                    text(&it.detector),
                    text(it.place.map_or("-", messages::Place::name)),
                    text(info.map_or("-".to_owned(), |info| info.markers.join(", "))),
                    number(Some(it.rate_hz), 1, "Hz"),
                    number(Some(it.latency_ms), 0, "ms"),
                    Cell::Number(format!("{} of {}", it.agreed, it.compared)),
                    text(info.map_or("-".to_owned(), |info| {
                        format!("{} on {}", info.version, info.host)
                    })),
                ]
            })
            .collect();
    let head = ["detector", "place", "markers", "rate", "latency", "agrees", "version"];
    section.after.push(table(&head, rows));
    section
}

fn wind(view: &View<'_>) -> Section {
    let mut section = section("wind", "Wind", "");
    let summary = &view.summary;
    let has_estimate = view.flight.targets.iter().any(|target| target.wind_ned_m_s.is_some());
    match (summary.wind_mean_m_s, summary.wind_max_m_s) {
        (Some(mean), Some(max)) => {
            section
                .before
                .push(paragraph(&format!("{mean:.1} m/s in the mean, {max:.1} m/s at most.")));
        }
        _ => section.before.push(missing("the true wind, which only a simulation has")),
    }
    if !has_estimate {
        section.before.push(missing("the controller's estimate of the wind from the tilt"));
    }
    if has_estimate || summary.wind_mean_m_s.is_some() {
        section.charts = plots::wind(view);
    }
    section
}

fn battery(view: &View<'_>) -> Section {
    let flight = view.flight;
    let mut section = section("battery", "Battery and link", "");
    let packets = &flight.packets.received;
    if packets.is_empty() {
        section.before.push(missing("the autopilot's packets"));
    } else {
        section.before.push(paragraph(&format!(
            "{} packets of the autopilot, {} bytes.",
            packets.len(),
            packets.iter().map(|it| it.bytes).sum::<usize>()
        )));
    }
    let charts = plots::battery(view).into_iter();
    let is_there = |chart: &Chart| !chart.is_empty();
    section.charts = charts.collect();
    if section.charts.first().is_none_or(|chart| !is_there(chart)) {
        section.before.push(missing("the charge of the battery: the autopilot did not report it"));
    }
    let timeouts = || flight.statuses.iter().filter_map(|status| status.setpoint_timeout_s);
    let mut rows = vec![
        vec![
            text("without setpoints the autopilot stops after, in the landing"),
            number(timeouts().reduce(f64::min), 2, "s"),
        ],
        vec![text("the same at the end"), number(timeouts().next_back(), 2, "s")],
    ];
    for (name, process) in &flight.processes {
        let is_controller = name.starts_with("controller/");
        for latency in process.last.latencies.iter().filter(|_| is_controller) {
            rows.push(vec![
                text(format!("{}, median and 99 % of the last seconds", latency.name)),
                Cell::Number(format!("{:.1}, {:.1} ms", latency.p50_ms, latency.p99_ms)),
            ]);
        }
    }
    section.after.push(table(&[], rows));
    ground(flight, &mut section);
    section
}

/// Adds the ground stations whose packets were received, and the refused packets, by the last status of each bridge.
fn ground(flight: &Flight, section: &mut Section) {
    if flight.bridges.is_empty() {
        let processes = flight.processes.values().map(|process| &process.last);
        let mut bridges = processes.filter(|health| health.service == "gcs-bridge");
        let why = match bridges.next() {
            Some(bridge) => format!(
                "the ground stations: gcs-bridge {} ran, and its status was not recorded",
                bridge.instance
            ),
            None => "the ground stations: no message of a gcs-bridge was recorded".to_owned(),
        };
        section.before.push(missing(&why));
        return;
    }
    let end_ns = flight.landing.as_ref().map_or(i64::MAX, |it| it.time_ns.end);
    let end_ns = end_ns.min(flight.vehicle_ns(flight.last_received_ns));
    let mut stations = Vec::new();
    let mut refused = Vec::new();
    for (name, Bridge { received_ns, status: bridge }) in &flight.bridges {
        let status_ns = flight.vehicle_ns(*received_ns);
        let is_old = end_ns.saturating_sub(status_ns) > MAX_STATUS_AGE_NS;
        let unknown =
            format!("unknown after {:.1} s: the bridge published no more", flight.at_s(status_ns));
        let further = match bridge.unlisted {
            0 => String::new(),
            more => format!("; {} of further stations", counted(more, "packet", "packets")),
        };
        section.before.push(paragraph(&format!(
            "gcs-bridge {name}, {}: {}; a ground station may send: {}{further}.",
            bridge.link, bridge.signing.state, bridge.ground_may
        )));
        stations.extend(bridge.stations.iter().map(|it| {
            let present = match it.silent {
                true => "silent at the end",
                false if is_old => unknown.as_str(),
                false => "yes",
            };
            vec![
                text(format!("{}/{} at {}", it.system, it.component, it.peer)),
                text(present),
                count(it.packets),
                count(it.refused),
            ]
        }));
        let of_bridge = bridge.refused.iter();
        refused.extend(of_bridge.map(|it| vec![text(&it.reason), count(it.count)]));
    }
    let head = ["ground station (system/component)", "present", "packets", "refused"];
    section.after.push(table(&head, stations));
    section.after.push(table(&["packets from the ground that were refused", "times"], refused));
}

fn log(view: &View<'_>) -> Section {
    let mut section = section("log", "Log", "");
    let (lines, left_out) = journal::of(view.flight);
    if lines.is_empty() {
        section.before.push(missing("status, packets and health, from which the log is made"));
        return section;
    }
    let rows: Vec<Vec<Cell>> = lines
        .into_iter()
        .map(|line| {
            let message = if line.is_warning { Cell::Warning(line.text) } else { text(line.text) };
            vec![number(Some(line.time_s), 2, "s"), text(line.source), message]
        })
        .collect();
    section.after.push(table(&["at", "source", "text"], rows));
    if left_out > 0 {
        section.after.push(paragraph(&format!(
            "{left_out} lines that are farther from the landing are left out."
        )));
    }
    section
}

fn thesis(view: &View<'_>) -> Section {
    let mut section = section(
        "thesis",
        "The thesis' figures of this flight",
        "Figures 4.10 to 4.16: trajectory; position and command velocity; wind and command velocity, along each axis.",
    );
    section.charts = plots::thesis(view);
    let source = if view.flight.truth.is_empty() {
        "Positions are the autopilot's and the estimate's: truth was not recorded."
    } else {
        "Positions are true ones."
    };
    section.before.push(paragraph(source));
    section
}

fn configuration(view: &View<'_>) -> Section {
    let flight = view.flight;
    let mut section = section("configuration", "Configuration and parameters", "");
    if flight.configurations.is_empty() {
        section.before.push(missing("the configuration of the services"));
    }
    let changed: BTreeSet<&str> = flight.changes.iter().map(|it| it.service.as_str()).collect();
    for service in changed {
        let note = format!(
            "The configuration of {service} was changed (the log states when); this is the last."
        );
        section.before.push(paragraph(&note));
    }
    for (service, toml) in &flight.configurations {
        section.after.push(details(service, Block::Lines(toml.clone())));
    }
    let parameters = &flight.packets.parameters;
    if parameters.is_empty() {
        section.before.push(missing(
            "parameters of the autopilot: none were requested (a ground station requests all)",
        ));
    } else {
        let rows: Vec<Vec<Cell>> = parameters
            .iter()
            .map(|(name, value)| vec![text(name), Cell::Number(value.to_string())])
            .collect();
        let title = format!("{} parameters of the autopilot, as far as requested", rows.len());
        section.after.push(details(&title, table(&["parameter", "value"], rows)));
    }
    for (camera, info) in &flight.cameras {
        let json = serde_json::to_string_pretty(info).unwrap_or_default();
        let title = format!("calibration of the camera {camera}");
        section.after.push(details(&title, Block::Lines(json)));
    }
    section
}

fn recording(view: &View<'_>) -> Section {
    let flight = view.flight;
    let mut section = section("recording", "The recording", "");
    for problem in &view.summary.problems {
        section.before.push(Block::Warning(problem.clone()));
    }
    if flight.damage.len() > losses::MAX_PARTS {
        let title = format!("The {} damaged parts", flight.damage.len());
        section.after.push(details(&title, Block::Lines(flight.damage.join("\n"))));
    }
    let mut rows = vec![vec![text("file"), text(&flight.name)]];
    rows.push(vec![text("messages"), text(flight.messages.to_string())]);
    let tape = match &flight.replayed {
        Some(replayed) => replayed.text.clone(),
        None if flight.tapes.is_empty() => "not recorded".to_owned(),
        None => "recorded, not replayed".to_owned(),
    };
    rows.push(vec![text("controller's tape"), text(tape)]);
    rows.extend(flight.facts.iter().map(|(name, value)| vec![text(name), text(value)]));
    for (name, process) in &flight.processes {
        let wall_s = process.last.uptime_s - process.first.uptime_s;
        let cpu = (wall_s > 0.0)
            .then(|| 100.0 * (process.last.cpu_s - process.first.cpu_s) / wall_s)
            .map_or(String::new(), |percent| format!(", {percent:.0} % of a core"));
        let health = &process.last;
        let program = format!("alight {} on {}{cpu}", health.version, health.host);
        rows.push(vec![text(name), text(program)]);
    }
    section.after.push(table(&[], rows));
    section
}
