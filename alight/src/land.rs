//! `alight land`: all services as processes, watched until the vehicle has landed.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::{Context, bail};
use clap::{Args, ValueEnum};
use markers::{Marker, Pad};
use messages::topic;
use node::{Identity, Layers, Node, Shutdown};
use tempfile::TempDir;
use tokio::time::Instant;

use crate::children::{Children, News};
use crate::cli::{write_error, zenoh_source};
use crate::outcome::Flight;
use crate::progress::Progress;
use crate::services::{self, Service};

/// What a landing takes.
#[derive(Args, Clone)]
pub(crate) struct LandArgs {
    /// Seed of everything random: wind, noise, ground.
    #[arg(long, default_value_t = 1, value_name = "N")]
    seed: u64,
    /// One setting of a service: SERVICE.KEY=VALUE, for example simulator.wind.mean_m_s=5. May be repeated.
    #[arg(long, value_name = "SERVICE.KEY=VALUE")]
    set: Vec<String>,
    /// Marker to land on, on the simulated pad as well: FAMILY:ID:SIZE_M, or FAMILY:SIZE_M for a family without ids.
    #[arg(long, value_name = "MARKER")]
    marker: Option<Marker>,
    /// Pad of several markers to land on, in the simulator as well: `a4`, which comes with the program, or a TOML file.
    #[arg(long, value_name = "PAD", conflicts_with = "marker")]
    pad: Option<String>,
    /// What turns detections into velocity: `metric` (our own) or `thesis` (Algorithm 18).
    #[arg(long, value_name = "GUIDANCE")]
    guidance: Option<String>,
    /// Fly this autopilot instead of the simulated one: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or
    /// serial:DEVICE:BAUD. The simulated camera then follows the pose it reports.
    #[arg(long, value_name = "ADDRESS")]
    autopilot: Option<String>,
    /// Zenoh configuration (JSON5); the built-in `local.json5` otherwise.
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Give up after this many seconds, from 1 to 86400.
    #[arg(long, default_value_t = 300.0, value_name = "SECONDS", value_parser = patience_s)]
    timeout_s: f64,
    /// What is printed at the end: a table, or one JSON object on the last line.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// A number of seconds that can be waited for.
fn patience_s(text: &str) -> Result<f64, String> {
    let seconds = text.parse().map_err(|_| "it is not a number".to_owned())?;
    if (1.0..=86_400.0).contains(&seconds) {
        Ok(seconds)
    } else {
        Err("it must be from 1 to 86400".to_owned())
    }
}

/// Form of the result.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub(crate) enum Format {
    /// For people.
    #[default]
    Text,
    /// For programs.
    Json,
}

/// The services of a landing, in the order in which they are started.
const SERVICES: [Service; 4] =
    [Service::Simulator, Service::Detector, Service::Controller, Service::GcsBridge];

/// Where ground stations such as QGroundControl listen.
const GROUND_PORT: u16 = 14_550;

/// How much later than its services this process may hear of Ctrl-C.
const SIGNAL_GRACE: Duration = Duration::from_millis(200);

/// Time for the services to settle and tell their last words after the landing.
const AFTERMATH: Duration = Duration::from_millis(1200);

/// Lands, and prints the result.
pub(crate) fn run(args: &LandArgs) -> anyhow::Result<ExitCode> {
    node::start_logging("warn");
    let settings = Settings::new(args)?;
    let flight = services::runtime()?.block_on(fly(args, &settings))?;
    let outcome = flight.outcome();
    use std::io::Write;
    let text = match args.format {
        Format::Text => outcome.table(),
        Format::Json => serde_json::to_string(&outcome)?,
    };
    writeln!(std::io::stdout(), "{text}").context("printing the result")?;
    Ok(ExitCode::from(u8::from(!outcome.landed)))
}

/// The settings of each service.
struct Settings {
    by_service: Vec<(Service, Vec<String>)>,
}

impl Settings {
    /// Sorts the command line's settings by service, and checks them all before anything starts.
    fn new(args: &LandArgs) -> anyhow::Result<Self> {
        let autopilot = match &args.autopilot {
            Some(address) => address.clone(),
            None => format!("udpin:127.0.0.1:{}", free_port(std::net::UdpSocket::bind)?),
        };
        let mut simulator = vec![format!("seed={}", args.seed)];
        match &args.autopilot {
            Some(_) => simulator.push("vehicle=\"reported\"".to_owned()),
            None => simulator.push(format!(
                "autopilot.address=\"{}\"",
                autopilot.replacen("udpin", "udpout", 1)
            )),
        }
        let mut controller = vec![
            format!("autopilot.address=\"{autopilot}\""),
            "start=\"takeoff\"".to_owned(),
            format!("thesis.seed={}", args.seed),
        ];
        if let Some(guidance) = &args.guidance {
            controller.push(format!("guidance=\"{guidance}\""));
        }
        let mut detector = Vec::new();
        if let Some(marker) = &args.marker {
            simulator.push(format!("pad.marker=\"{marker}\""));
            detector.push(format!("markers=[\"{marker}\"]"));
            controller.push(format!("marker=\"{}\"", marker.name()));
        }
        if let Some(name) = &args.pad {
            let pad = Pad::named(name, |file| std::fs::read_to_string(file))?;
            // The services are started in the same folder.
            let name = toml::Value::from(name.as_str());
            simulator.push(format!("pad.markers={name}"));
            detector.push("markers=[]".to_owned());
            detector.push(format!("pads=[{name}]"));
            controller.push(format!("marker=\"{}\"", pad.name()));
        }
        let mut by_service = vec![
            (Service::Simulator, simulator),
            (Service::Detector, detector),
            (Service::Controller, controller),
            (Service::GcsBridge, ground_station(args.autopilot.as_deref())),
        ];
        for setting in &args.set {
            let named = by_service.iter_mut().find_map(|(service, settings)| {
                let key = setting.strip_prefix(service.name())?.strip_prefix('.')?;
                Some((settings, key))
            });
            let Some((settings, key)) = named else {
                return Err(node::ConfigError::UnknownKey {
                    source_name: format!("--set {setting}"),
                    key: setting.split('=').next().unwrap_or_default().to_owned(),
                    hint: "; a setting begins with its service: simulator., detector., controller. or gcs-bridge.".to_owned(),
                }
                .into());
            };
            settings.push(key.to_owned());
        }
        for (service, settings) in &by_service {
            service.effective_config(&Layers { file: None, set: settings.clone() })?;
        }
        Ok(Self { by_service })
    }

    fn of(&self, service: Service) -> &[String] {
        self.by_service.iter().find(|(s, _)| *s == service).map_or(&[], |(_, settings)| settings)
    }
}

/// Where the ground station is listened for, when its usual port is where the autopilot already talks to.
fn ground_station(autopilot: Option<&str>) -> Vec<String> {
    let taken = autopilot.is_some_and(|address| {
        address.starts_with("udpin:") && address.ends_with(&format!(":{GROUND_PORT}"))
    });
    if !taken {
        return Vec::new();
    }
    let port = GROUND_PORT + 1;
    write_error(&format!(
        "The autopilot talks to port {GROUND_PORT}; the ground station is served at UDP port {port} instead"
    ));
    vec![format!("ground=\"udpout:127.0.0.1:{port}\"")]
}

async fn fly(args: &LandArgs, settings: &Settings) -> anyhow::Result<Flight> {
    let shutdown = Shutdown::on_signals()?;
    let meeting = MeetingPoint::new(args.zenoh.as_deref())?;
    let identity = Identity { service: "alight", instance: format!("land-{}", std::process::id()) };
    let node = Node::open(identity, &zenoh_source(Some(meeting.file.clone()))).await?;
    let mut progress = Progress::new(args.format);
    progress.say(&format!(
        "Zenoh: {}. A detector beside the one that runs: alight detector --zenoh {} --set id=spare",
        meeting.description,
        meeting.file.display()
    ));
    let mut children = Children::new();
    for service in SERVICES {
        let started = children.start(service, &meeting.file, settings.of(service))?;
        progress.debug(&started);
    }
    let deadline = Instant::now() + Duration::from_secs_f64(args.timeout_s);
    let watched = watch(&node, settings, &mut children, &mut progress, shutdown, deadline).await;
    progress.finish();
    children.stop().await;
    node.close().await;
    watched
}

/// Follows the landing until it is over.
async fn watch(
    node: &Node,
    settings: &Settings,
    children: &mut Children<Service>,
    progress: &mut Progress,
    shutdown: Shutdown,
    deadline: Instant,
) -> anyhow::Result<Flight> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let truths = node.subscriber(topic::TRUTH, &[]).await?;
    let healths = node.subscriber(topic::HEALTH, &[]).await?;
    let mut flight = Flight::default();
    let mut over: Option<Instant> = None;
    let mut redraw = tokio::time::interval(Duration::from_millis(200));
    loop {
        let end = over.unwrap_or(deadline);
        tokio::select! {
            Some(status) = statuses.next() => {
                progress.status(&status);
                if flight.status(status) && over.is_none() {
                    over = Some(Instant::now() + AFTERMATH);
                }
            }
            Some(truth) = truths.next() => flight.truth(truth),
            Some(health) = healths.next() => flight.health(health),
            Some(news) = children.next() => match news {
                News::Said(service, line) => progress.say(&format!("{}: {line}", service.name())),
                News::Ended(service, end) => {
                    children.forget(&service);
                    // Ctrl-C in a terminal reaches the services as well, and they may be the quicker ones.
                    if tokio::time::timeout(SIGNAL_GRACE, shutdown.requested()).await.is_ok() {
                        flight.interrupted("interrupted");
                        return Ok(flight);
                    }
                    progress.say(&format!("{} ended: {end}{}", service.name(), remedy(service)));
                    // Nobody flies by the ground station, so its end is no reason to leave a vehicle that takes off.
                    let is_needed = flight.never_flew()
                        && match service {
                            Service::GcsBridge => false,
                            // One that was swapped away, or whose place another one has taken.
                            Service::Detector => {
                                !another_detector(node, settings).await.unwrap_or(false)
                            }
                            _ => true,
                        };
                    if service == Service::Simulator || is_needed {
                        bail!("{} ended before the landing: {end}; its last words are above", service.name());
                    }
                }
            },
            _ = redraw.tick() => progress.draw(&flight),
            () = shutdown.requested() => {
                flight.interrupted("interrupted");
                return Ok(flight);
            }
            () = tokio::time::sleep_until(end) => {
                if over.is_none() {
                    flight.interrupted("no landing in the time allowed (--timeout-s)");
                }
                return Ok(flight);
            }
        }
    }
}

/// True when there is a detector beside the one that was started here.
async fn another_detector(node: &Node, settings: &Settings) -> anyhow::Result<bool> {
    let own = Layers { file: None, set: settings.of(Service::Detector).to_vec() };
    let own = own.load::<detector::Config>()?.settings.id;
    Ok(node.alive("detector", "*").await?.iter().any(|other| *other != own))
}

/// What can be done about the end of a service.
fn remedy(service: Service) -> &'static str {
    match service {
        Service::Detector => "; another detector is used as soon as it is there",
        Service::Controller => {
            "; the autopilot stops the vehicle by itself, a controller started again takes the landing up"
        }
        Service::GcsBridge => "; the landing goes on without the ground station",
        Service::Simulator | Service::CameraPub => "",
    }
}

/// Where the processes meet.
struct MeetingPoint {
    file: PathBuf,
    description: String,
    /// Keeps the file until the landing is over.
    _directory: TempDir,
}

impl MeetingPoint {
    /// The user's file, or the built-in one on its own port, or on another when that is taken.
    fn new(user_file: Option<&Path>) -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("alight-")
            .tempdir()
            .context("making a temporary directory for the Zenoh configuration")?;
        if let Some(file) = user_file {
            let file = file.to_owned();
            let description = file.display().to_string();
            return Ok(Self { file, description, _directory: directory });
        }
        let usual = node::session::LOCAL_PORT;
        let usual_is_free = std::net::TcpListener::bind(("127.0.0.1", usual)).is_ok();
        let port = if usual_is_free { usual } else { free_port(std::net::TcpListener::bind)? };
        let file = directory.path().join("zenoh.json5");
        std::fs::write(&file, node::session::local_config(port))
            .with_context(|| format!("writing {file:?}"))?;
        let description = format!("local, meeting at port {port}");
        Ok(Self { file, description, _directory: directory })
    }
}

/// Ports that Linux gives to nobody who asks for just any (`ip_local_port_range` begins at 32768): what is free there still is
/// when its service listens.
const PORTS: std::ops::Range<u16> = 20_000..32_000;

/// A port that can be bound so. Programs begin to look at different ones, so that two that start at once do not meet.
fn free_port<T>(bind: impl Fn((&'static str, u16)) -> std::io::Result<T>) -> anyhow::Result<u16> {
    let first = std::process::id().wrapping_mul(97);
    let port = |further| PORTS.start + (first.wrapping_add(further) % PORTS.len() as u32) as u16;
    (0..100)
        .map(port)
        .find(|port| bind(("127.0.0.1", *port)).is_ok())
        .with_context(|| format!("finding a free port from {} to {}", PORTS.start, PORTS.end))
}
