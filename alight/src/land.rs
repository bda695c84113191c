//! `alight land`: checks all settings, starts simulator, detector, controller and the other services as processes, follows their
//! statuses until the vehicle has landed, and stops them.

use std::io::IsTerminal;
use std::net::{SocketAddr, TcpListener, UdpSocket};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use anyhow::{Context, bail, ensure};
use clap::Args;
use markers::{Marker, Pad};
use messages::{ControllerStatus, topic};
use node::network::variable;
use node::{Layers, Network, Node, Shutdown, read_text};
use rustix::io::Errno;
use rustix::process::{Pid, test_kill_process};
use tempfile::TempDir;
use tokio::time::{Instant, timeout_at};

use crate::args::{Format, OPERATOR, WrongUse, address, meet_port, source_of, whole_number};
use crate::children::{ChildEvent, Children, options_for_shell};
use crate::ending::recording;
use crate::interruption::IN_THE_AIR;
use crate::outcome::{LandingSummary, OurRecorder};
use crate::progress::Progress;
use crate::record::file_setting;
use crate::runtime::{block_on, tool_identity};
use crate::services::Service;
use crate::terminal::{print, write_error};

/// The arguments of a landing.
#[derive(Args, Clone)]
#[command(after_help = EXIT_STATUS)]
pub(crate) struct LandArgs {
    /// Seed of everything random: wind, noise, ground.
    #[arg(long, default_value_t = 1, value_name = "N", value_parser = whole_number::<u64>(0..=u64::MAX))]
    seed: u64,
    /// One setting of a service: SERVICE.KEY=VALUE, for example simulator.wind.mean_m_s=5. May be repeated.
    #[arg(long, value_name = "SERVICE.KEY=VALUE")]
    set: Vec<String>,
    /// Marker to land on, on the simulated pad as well: FAMILY:ID:SIZE_M, or FAMILY:SIZE_M for a family
    /// without ids (rings; the thesis' own detection of them, `rings-thesis`, is kept for comparison and finds few markers in pictures of
    /// ordinary cameras).
    #[arg(long, value_name = "MARKER")]
    marker: Option<Marker>,
    /// Pad of several markers to land on, in the simulator as well: the built-in `a4`, or a TOML file.
    #[arg(long, value_name = "PAD", conflicts_with = "marker")]
    pad: Option<String>,
    /// Guidance law: `metric`, or `thesis` (Algorithm 18 of the thesis).
    #[arg(long, value_name = "GUIDANCE")]
    guidance: Option<String>,
    /// Fly this autopilot instead of the simulated one: udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT,
    /// tcpin:HOST:PORT or serial:DEVICE[:BAUD]. The simulated camera then follows the pose it reports. Only a vehicle that reports itself
    /// as a simulation takes off.
    #[arg(long, value_name = "ADDRESS")]
    autopilot: Option<String>,
    /// Allow the take-off of a vehicle that does not report itself as a simulation. THE MOTORS START, and the pad
    /// is one that exists in the simulated camera only. Asks first.
    #[arg(long, requires = "autopilot")]
    real_vehicle: bool,
    /// Answer the question of `--real-vehicle` with yes, where there is no terminal.
    #[arg(long, requires = "real_vehicle")]
    yes: bool,
    /// Zenoh configuration (JSON5) [default: the built-in `local.json5`].
    #[arg(long, value_name = "FILE")]
    zenoh: Option<PathBuf>,
    /// Port at which the processes of this landing meet, if it is free; otherwise another one is chosen, and printed [default: 7447].
    #[arg(long, value_name = "PORT", env = variable::MEET, value_parser = meet_port)]
    meet: Option<u16>,
    /// The vehicle's name, the first part of all keys [default: drone, or that of `--zenoh`].
    #[arg(long, value_name = "NAME", env = variable::VEHICLE)]
    vehicle: Option<String>,
    /// Give up after this many seconds, from 1 to 86400.
    #[arg(long, default_value_t = 300.0, value_name = "SECONDS", value_parser = timeout_s)]
    timeout_s: f64,
    /// Record the landing to this file (MCAP, `docs/recording.md`); one that is there is kept, and the new one gets a
    /// number.
    #[arg(long, value_name = "FILE.mcap", value_parser = recording)]
    record: Option<PathBuf>,
    /// Show the landing on a page at this address, such as 127.0.0.1:8080, which also commands (`docs/dashboard.md`).
    #[arg(long, value_name = "IP:PORT", value_parser = address)]
    dashboard: Option<SocketAddr>,
    /// Format of the result: a table, or one JSON object on the last line.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

fn timeout_s(text: &str) -> Result<f64, String> {
    let seconds = text.parse().map_err(|_| "not a number".to_owned())?;
    if (1.0..=86_400.0).contains(&seconds) {
        Ok(seconds)
    } else {
        Err("must be from 1 to 86400".to_owned())
    }
}

const EXIT_STATUS: &str = "Exit status of a landing: 0 when it landed on the pad (led there by the marker, and at most 0.3 m from its centre), 1 when it did not, \
                           also when it came down otherwise (after an abort, by `land-here`, for an alarm, by the pilot: the result states the distance from the pad) or \
                           when it landed and the recording of `--record` failed or lost messages (the result contains `landed`, the recording's `problem` and the number `dropped`), \
                           and 2 for a wrong command line or setting.";

/// How a landing that ended in the air is continued: its detector and its simulated camera have ended with it.
const CONTINUE: &str = "To continue the landing of an ArduPilot that hovers in GUIDED, run this `alight land` again; land a PX4 in Land or Return, or by hand";

/// The loopback interface.
pub(crate) const LOOPBACK: &str = "127.0.0.1";

/// The UDP port at which ground stations such as QGroundControl listen.
const GROUND_PORT: u16 = 14_550;

/// Maximum delay of Ctrl-C in this process after its services.
const SIGNAL_GRACE: Duration = Duration::from_millis(200);

/// Time to wait for a detector's information, which it publishes every second.
const INFO_TIMEOUT: Duration = Duration::from_millis(1500);

/// Time after the landing for the last messages of the services.
const AFTER_LANDING: Duration = Duration::from_millis(1200);

/// Longest time between two statuses of a recorder that has ended, which are received after that.
const LAST_STATUS: Duration = Duration::from_millis(200);
/// Longest time for all of them.
const LAST_STATUSES: Duration = Duration::from_secs(1);

/// Lands, and prints the result.
pub(crate) fn run(args: &LandArgs) -> anyhow::Result<ExitCode> {
    node::start_logging("warn");
    let settings = ServiceSettings::new(args)?;
    confirm_real_vehicle(args, &settings)?;
    let outcome = block_on(fly(args, &settings))??.outcome();
    print(&match args.format {
        Format::Text => outcome.table(),
        Format::Json => serde_json::to_string(&outcome)?,
    })
    .context("printing the result")?;
    Ok(if outcome.is_done() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Asks before the motors of a vehicle may start that may be a real one.
fn confirm_real_vehicle(args: &LandArgs, settings: &ServiceSettings) -> anyhow::Result<()> {
    let layers = Layers { file: None, set: settings.of(Service::Controller).to_vec() };
    if !layers.load::<controller::Config>()?.settings.takeoff_real_vehicle || args.yes {
        return Ok(());
    }
    let warning = format!(
        "The vehicle at {} need not be a simulation: its motors start, it takes off, and it lands where the simulated \
         camera shows a pad that is not there. Propellers off, or no person near?",
        args.autopilot.as_deref().unwrap_or("the autopilot's address")
    );
    if !std::io::stdin().is_terminal() {
        let remedy = "There is no terminal to ask on; if so, say `--real-vehicle --yes`";
        bail!(WrongUse(format!("{warning} {remedy}")));
    }
    write_error(&format!("{warning} Type `yes` to start the motors:"));
    let mut answer = String::new();
    std::io::stdin().read_line(&mut answer).context("reading the answer")?;
    ensure!(answer.trim() == "yes", "not confirmed, nothing was started");
    Ok(())
}

/// The settings of each service, in starting order.
struct ServiceSettings {
    by_service: Vec<(Service, Vec<String>)>,
    /// The address at which the simulated autopilot of this landing alone is, if it has one.
    simulated_at: Option<String>,
}

impl ServiceSettings {
    /// Sorts the settings of the command line by service, and checks all of them before anything starts.
    fn new(args: &LandArgs) -> anyhow::Result<Self> {
        let simulated_at = match &args.autopilot {
            Some(_) => None,
            None => Some(format!("udpin:127.0.0.1:{}", free_port()?.0)),
        };
        let autopilot = args.autopilot.as_ref().or(simulated_at.as_ref());
        let autopilot = autopilot.cloned().unwrap_or_default();
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
        if args.real_vehicle {
            controller.push("takeoff_real_vehicle=true".to_owned());
        }
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
            let pad = Pad::named(name, |file| read_text(file))?;
            // The services run in the same working directory.
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
        if let Some(file) = &args.record {
            by_service.insert(0, (Service::Recorder, vec![file_setting(file)]));
        }
        if let Some(address) = args.dashboard {
            let settings = vec![format!("listen=\"{address}\""), "commands=here".to_owned()];
            by_service.insert(0, (Service::Dashboard, settings));
        }
        for setting in &args.set {
            let named = by_service.iter_mut().find_map(|(service, settings)| {
                let key = setting.strip_prefix(service.name())?.strip_prefix('.')?;
                Some((settings, key))
            });
            let Some((settings, key)) = named else {
                return Err(node::ConfigError::UnknownKey {
                    source_name: format!("--set {setting}"),
                    key: setting.split('=').next().unwrap_or_default().to_owned(),
                    hint: "; a setting begins with its service: simulator., detector., controller., gcs-bridge., or with `--record` recorder., with `--dashboard` dashboard.".to_owned(),
                }
                .into());
            };
            settings.push(key.to_owned());
        }
        for (service, settings) in &by_service {
            let checked = service.effective_config(&Layers { file: None, set: settings.clone() });
            checked.map_err(|problem| match problem.downcast::<node::ConfigError>() {
                Ok(problem) => problem.of_service(service.name()).into(),
                Err(problem) => problem,
            })?;
        }
        Ok(Self { by_service, simulated_at })
    }

    /// The recorder, if there is one.
    fn recorder(&self) -> anyhow::Result<Option<OurRecorder>> {
        let set = self.of(Service::Recorder).to_vec();
        if set.is_empty() {
            return Ok(None);
        }
        let recorder = Layers { file: None, set }.load::<recorder::Config>()?.settings;
        Ok(Some(OurRecorder { name: recorder.id, file: recorder.file }))
    }

    /// The name of the detector that is started here.
    fn detector(&self) -> anyhow::Result<String> {
        let own = Layers { file: None, set: self.of(Service::Detector).to_vec() };
        Ok(own.load::<detector::Config>()?.settings.id)
    }

    /// The page of the landing, if it is to have one.
    fn page(&self) -> anyhow::Result<Option<dashboard::Config>> {
        let set = self.of(Service::Dashboard).to_vec();
        if set.is_empty() {
            return Ok(None);
        }
        Ok(Some(Layers { file: None, set }.load::<dashboard::Config>()?.settings))
    }

    /// Whether the controller's vehicle is the simulated one of this landing, which does not exist after it.
    fn is_simulated(&self) -> bool {
        let layers = Layers { file: None, set: self.of(Service::Controller).to_vec() };
        let config = layers.load::<controller::Config>();
        let address = config.ok().map(|config| config.settings.autopilot.address);
        address.is_some() && address == self.simulated_at
    }

    fn of(&self, service: Service) -> &[String] {
        self.by_service.iter().find(|(s, _)| *s == service).map_or(&[], |(_, settings)| settings)
    }
}

/// Moves the ground station's port when the autopilot uses it.
fn ground_station(autopilot: Option<&str>) -> Vec<String> {
    let taken = autopilot.is_some_and(|address| {
        address.starts_with("udpin:") && address.ends_with(&format!(":{GROUND_PORT}"))
    });
    if !taken {
        return Vec::new();
    }
    let port = GROUND_PORT + 1;
    write_error(&format!(
        "The autopilot uses port {GROUND_PORT}; the ground station is served at UDP port {port} instead"
    ));
    vec![format!("ground=\"udpout:127.0.0.1:{port}\"")]
}

async fn fly(args: &LandArgs, settings: &ServiceSettings) -> anyhow::Result<LandingSummary> {
    let shutdown = Shutdown::on_signals()?;
    let page = settings.page()?;
    if let Some(page) = &page {
        // Before anything flies: later a landing continues without its page.
        TcpListener::bind(&page.listen).with_context(|| {
            format!(
                "showing the page at {}; choose another address with `--dashboard IP:PORT`",
                page.listen
            )
        })?;
    }
    let rendezvous = Rendezvous::new(args.zenoh.as_deref(), args.meet)?;
    // Its own file is checked as those of the services are: nothing listens beyond this machine by accident.
    let meet = args.zenoh.as_ref().and(args.meet);
    let network = Network {
        config: Some(rendezvous.file.clone()),
        meet,
        vehicle: args.vehicle.clone(),
        ..Network::default()
    };
    let zenoh = source_of(&network, OPERATOR)?;
    let node = Node::open_tool(tool_identity("land"), &zenoh).await?;
    let mut progress = Progress::new(args.format);
    progress.say(&format!(
        "Zenoh: {}. To add a second detector: alight detector {} --set id=spare",
        rendezvous.description,
        options_for_shell(&network)
    ));
    if let Some(port) = rendezvous.unusual_port {
        progress.say(&format!(
            "Port {wanted} is in use, by another landing, a detector that was left running or another program (`ss -ltnp 'sport = :{wanted}'` \
             names it): other commands find this landing with `export ALIGHT_MEET={port}`",
            wanted = args.meet.unwrap_or(node::session::LOCAL_PORT)
        ));
    }
    let port = args.meet.filter(|port| *port != node::session::LOCAL_PORT);
    let variables = [
        args.vehicle.as_ref().map(|vehicle| format!("{}={vehicle}", variable::VEHICLE)),
        port.filter(|_| rendezvous.unusual_port.is_none())
            .map(|port| format!("{}={port}", variable::MEET)),
    ];
    let variables: Vec<String> = variables.into_iter().flatten().collect();
    if !variables.is_empty() {
        progress.say(&format!(
            "Other commands find this vehicle with `export {}`",
            variables.join(" ")
        ));
    }
    if let Some(page) = &page {
        let scheme = if page.certificate().is_some() { "https" } else { "http" };
        progress.say(&format!("The page is at {scheme}://{}/", page.listen));
    }
    // A controller's notes of a simulated vehicle are of use to controllers that resume this landing, and not after it.
    let notes_in = settings.is_simulated().then(|| rendezvous.directory.path());
    let mut children = Children::new();
    let mut resume = String::new();
    for (service, settings) in &settings.by_service {
        let notes = notes_in.filter(|_| *service == Service::Controller);
        let started = children.start(*service, &network, settings, notes)?;
        progress.debug(&started.to_string());
        if *service == Service::Controller {
            resume = started.by_hand;
        }
    }
    let deadline = Instant::now() + Duration::from_secs_f64(args.timeout_s);
    let limits = Limits { shutdown, deadline };
    let mut watched = watch(&node, settings, &mut children, &resume, &mut progress, limits).await;
    progress.finish();
    let mut recorders_end = None;
    let mut recorders_word = None;
    let mut note_end = |event: &ChildEvent<Service>| match event {
        ChildEvent::Exited(Service::Recorder, exit) if exit.status != Some(0) => {
            recorders_end = Some(exit.clone());
        }
        ChildEvent::Line(Service::Recorder, line) => {
            recorders_word = error_in(line).map(str::to_owned).or(recorders_word.take());
        }
        ChildEvent::Exited(..) | ChildEvent::Line(..) => {}
    };
    // The controller stops while the autopilot and the recorder still take its last messages, and the recorder last.
    children.stop_one(&Service::Controller, &mut note_end).await;
    children.stop_all_but(&Service::Recorder, &mut note_end).await;
    let recorders = node.subscriber(topic::RECORDER_STATUS, &[]).await;
    children.stop(note_end).await;
    if let Ok(landing) = &mut watched
        && let Ok(recorders) = recorders
        && settings.recorder().is_ok_and(|it| it.is_some())
    {
        // The last one has the final numbers and the last file.
        let until = Instant::now() + LAST_STATUSES;
        while let Ok(Some(status)) =
            timeout_at(until.min(Instant::now() + LAST_STATUS), recorders.next()).await
        {
            landing.recorder(status);
        }
    }
    // In a user's own network, and in parallel to another landing, detectors may be meant to continue.
    if args.zenoh.is_none()
        && rendezvous.unusual_port.is_none()
        && let Ok(landing) = &watched
    {
        for left in node.alive("detector", "*").await.unwrap_or_default() {
            let Some(end) = end_of(&node, landing, &left).await else { continue };
            progress.say(&format!(
                "Detector {left} still runs, and will be in the network of the next landing; {end}"
            ));
        }
    }
    if let Ok(landing) = &watched
        && landing.may_be_in_the_air()
        && !settings.is_simulated()
    {
        progress.say(IN_THE_AIR);
        progress.say(CONTINUE);
    }
    node.close().await;
    let mut landing = watched?;
    if let Some(exit) = recorders_end {
        landing.recording_failed(&exit, recorders_word);
    }
    Ok(landing)
}

/// The error with which a service ended, where a line of its standard error is that.
fn error_in(line: &str) -> Option<&str> {
    line.strip_prefix("alight: ")
}

/// The limits that end the watch of a landing that is not over.
struct Limits {
    shutdown: Shutdown,
    deadline: Instant,
}

/// Follows the landing until it is over. `resume` is the command of a controller that resumes it.
async fn watch(
    node: &Node,
    settings: &ServiceSettings,
    children: &mut Children<Service>,
    resume: &str,
    progress: &mut Progress,
    Limits { shutdown, deadline }: Limits,
) -> anyhow::Result<LandingSummary> {
    let statuses = node.subscriber(topic::STATUS, &[]).await?;
    let truths = node.subscriber(topic::TRUTH, &[]).await?;
    let vehicles = node.subscriber(topic::VEHICLE_STATE, &[]).await?;
    let healths = node.subscriber(topic::HEALTH, &[]).await?;
    let recorders = node.subscriber(topic::RECORDER_STATUS, &[]).await?;
    let mut landing = match settings.recorder()? {
        Some(recorder) => LandingSummary::recorded_by(recorder),
        None => LandingSummary::default(),
    };
    let mut over: Option<Instant> = None;
    let mut controllers_exit = None;
    let mut redraw = tokio::time::interval(Duration::from_millis(200));
    loop {
        let end = over.unwrap_or(deadline);
        tokio::select! {
            Some(status) = statuses.next() => {
                progress.status(&status);
                if landing.status(status) && over.is_none() {
                    over = Some(Instant::now() + AFTER_LANDING);
                }
            }
            Some(truth) = truths.next() => landing.truth(truth),
            Some(vehicle) = vehicles.next() => landing.last_vehicle = Some(vehicle),
            Some(health) = healths.next() => landing.health(health),
            Some(recorder) = recorders.next() => landing.recorder(recorder),
            Some(event) = children.next() => match event {
                ChildEvent::Line(service, line) => {
                    progress.line(service, &line);
                }
                ChildEvent::Exited(service, exit) => {
                    children.remove(&service);
                    // A signal may reach the services as well, which may exit first.
                    if tokio::time::timeout(SIGNAL_GRACE, shutdown.requested()).await.is_ok() {
                        landing.interrupted("interrupted");
                        return Ok(landing);
                    }
                    // Messages that were published before it ended have arrived.
                    while let Some(truth) = truths.waiting() {
                        landing.truth(truth);
                    }
                    while let Some(vehicle) = vehicles.waiting() {
                        landing.last_vehicle = Some(vehicle);
                    }
                    while let Some(status) = statuses.waiting() {
                        if landing.status(status) && over.is_none() {
                            over = Some(Instant::now() + AFTER_LANDING);
                        }
                    }
                    let consequence = match service {
                        Service::Detector => without_detector(&settings.detector()?, landing.last_status.as_ref()),
                        _ => consequence(service).to_owned(),
                    };
                    progress.say(&format!("{} exited: {exit}{consequence}", service.name()));
                    if service == Service::Recorder {
                        while let Some(recorder) = recorders.waiting() {
                            landing.recorder(recorder);
                        }
                        landing.recording_ended_early(&exit);
                    }
                    if service == Service::Controller {
                        controllers_exit = Some(exit.to_string());
                        if !landing.never_flew() {
                            progress.say(&format!("To resume the landing of a vehicle whose mode no pilot has changed: {resume}"));
                            progress.say("A PX4 holds its place (COM_OBL_RC_ACT 5) and follows a resumed controller again; or land it in Land or Return, or by hand");
                        }
                    }
                    // The landing needs no ground station, recording or page, and a vehicle in the air needs its controller.
                    let is_needed = landing.never_flew()
                        && !landing.has_taken_off()
                        && match service {
                            Service::GcsBridge | Service::Recorder | Service::Dashboard => false,
                            // Not needed if it was swapped, or another one runs.
                            Service::Detector => {
                                !another_detector(node, settings).await.unwrap_or(false)
                            }
                            _ => true,
                        };
                    if is_needed {
                        bail!("{} exited before the landing: {exit}; see its stderr above", service.name());
                    }
                    if service == Service::Simulator {
                        // No camera is left, and mostly no vehicle.
                        if over.is_none() || landing.comes_down() {
                            landing.interrupted(&format!("the simulator exited: {exit}"));
                        }
                        return Ok(landing);
                    }
                }
            },
            _ = redraw.tick() => progress.draw(&landing),
            () = shutdown.requested() => {
                landing.interrupted("interrupted");
                return Ok(landing);
            }
            () = tokio::time::sleep_until(end) => {
                // If an abort or the pilot lands it, the result contains where it touches down.
                if over.is_some() && landing.comes_down() && Instant::now() < deadline {
                    over = Some(Instant::now() + AFTER_LANDING);
                    continue;
                }
                if over.is_none() {
                    let is_alone = node.alive("controller", "*").await.is_ok_and(|it| it.is_empty());
                    landing.timed_out(controllers_exit.as_deref().filter(|_| is_alone));
                }
                return Ok(landing);
            }
        }
    }
}

/// Whether a detector other than the one started here is ready.
async fn another_detector(node: &Node, settings: &ServiceSettings) -> anyhow::Result<bool> {
    let own = settings.detector()?;
    Ok(node.alive("detector", "*").await?.iter().any(|other| *other != own))
}

/// The consequence of the exit of the detector that was started here, by the controller's newest status.
fn without_detector(own: &str, status: Option<&ControllerStatus>) -> String {
    let candidates = status.map_or(&[][..], |status| &status.candidates);
    let mut others = candidates.iter().filter(|it| it.alive && it.detector != own);
    let used = status.and_then(|status| status.active_detector.as_deref());
    match others.clone().find(|it| Some(it.detector.as_str()) == used).or_else(|| others.next()) {
        Some(other) if Some(other.detector.as_str()) == used => {
            format!("; `{}` is used", other.detector)
        }
        Some(other) => format!("; `{}` is there, and takes its place", other.detector),
        None => "; another detector is used as soon as one is ready".to_owned(),
    }
}

/// How a detector is ended that was left running; `None` for one that has ended, as that of the landing itself: its presence in the
/// network may outlive its process.
async fn end_of(node: &Node, landing: &LandingSummary, detector: &str) -> Option<String> {
    let here = node::host_name();
    let kill = |host: &str, pid: u32| match host == here {
        true => format!("`kill {pid}` ends it"),
        false => format!("`kill {pid}` on {host} ends it"),
    };
    let healths = landing.healths_of("detector", detector);
    if let Some(left) = healths.iter().find(|it| it.host != here || is_running(it.pid)) {
        return Some(kill(&left.host, left.pid));
    }
    // A detector of another program publishes no health, but its information contains its process number.
    let infos = node.subscriber(topic::DETECTOR_INFO, &[detector]).await;
    let info = match &infos {
        Ok(infos) => tokio::time::timeout(INFO_TIMEOUT, infos.next()).await.ok().flatten(),
        Err(_) => None,
    };
    match info {
        Some(info) => Some(kill(&info.host, info.pid)),
        None => healths.is_empty().then(|| "end it where it was started".to_owned()),
    }
}

/// Whether this host has a process of this number, of any user.
fn is_running(pid: u32) -> bool {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw);
    pid.is_some_and(|pid| test_kill_process(pid) != Err(Errno::SRCH))
}

/// The consequence of the exit of another service for the landing.
fn consequence(service: Service) -> &'static str {
    match service {
        Service::Controller => {
            "; ArduPilot stops a vehicle that flies, PX4 does what its COM_OBL_RC_ACT specifies"
        }
        Service::GcsBridge => "; the landing continues without the ground station",
        Service::Recorder => "; the landing continues, and is recorded no more",
        Service::Dashboard => "; the landing continues without the page",
        Service::Simulator | Service::CameraPub | Service::Detector => "",
    }
}

/// The Zenoh configuration with which the processes find each other.
struct Rendezvous {
    file: PathBuf,
    description: String,
    /// The port, if it is not the one at which other commands look for it.
    unusual_port: Option<u16>,
    /// Is deleted at the end, with its contents.
    directory: TempDir,
    /// Keeps the port from other landings until the end.
    _claim: Option<UdpSocket>,
}

impl Rendezvous {
    /// The user's file, or the built-in configuration at the port that is wanted, the usual one if none is, or at a free one.
    fn new(user_file: Option<&Path>, wanted: Option<u16>) -> anyhow::Result<Self> {
        let directory = tempfile::Builder::new()
            .prefix("alight-")
            .tempdir()
            .context("making a temporary directory for the Zenoh configuration")?;
        if let Some(file) = user_file {
            let file = file.to_owned();
            let description = file.display().to_string();
            return Ok(Self { file, description, unusual_port: None, directory, _claim: None });
        }
        let wanted = wanted.unwrap_or(node::session::LOCAL_PORT);
        let (port, lock) = match claim(wanted) {
            Ok(lock) => (wanted, lock),
            Err(_) => free_port()?,
        };
        let file = directory.path().join("zenoh.json5");
        std::fs::write(&file, node::session::local_config(port))
            .with_context(|| format!("writing {file:?}"))?;
        let description = format!("local, rendezvous at port {port}");
        let unusual_port = (port != wanted).then_some(port);
        Ok(Self { file, description, unusual_port, directory, _claim: Some(lock) })
    }
}

/// Locks a free port for a rendezvous. Its TCP port is bound a moment later, by the first of the processes; another landing that
/// begins meanwhile would find it free, and the two would fly in one network. So the UDP port of the same number is held as a lock
/// until the end of the landing.
fn claim(port: u16) -> std::io::Result<UdpSocket> {
    let lock = UdpSocket::bind((LOOPBACK, port))?;
    TcpListener::bind((LOOPBACK, port)).map(|_| lock)
}

/// Ports outside of Linux' ephemeral range (`ip_local_port_range` begins at 32768) and of the ports that tests choose from. So a port that
/// is free now is still free when its service binds it.
const PORTS: std::ops::Range<u16> = 26_000..32_000;

/// A port that is free for TCP and UDP, and its lock. No number is returned twice by one process, so a port may be bound later than
/// this returns; and each process begins its search at another one, so that two that start at once do not collide.
pub(crate) fn free_port() -> anyhow::Result<(u16, UdpSocket)> {
    static TRIED: AtomicU32 = AtomicU32::new(0);
    let first = std::process::id().wrapping_mul(97);
    let port = |offset| PORTS.start + (first.wrapping_add(offset) % PORTS.len() as u32) as u16;
    (0..100)
        .map(|_| port(TRIED.fetch_add(1, Ordering::Relaxed)))
        .find_map(|port| Some((port, claim(port).ok()?)))
        .with_context(|| format!("finding a free port from {} to {}", PORTS.start, PORTS.end))
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use messages::{
        Candidate, DetectorInfo, LandedState, Phase, Place, Touchdown, Truth, VehicleState,
    };
    use node::ZenohSource;

    use super::*;
    use crate::children::Reach;
    use crate::outcome::Outcome;
    use crate::outcome::tests::reported;

    #[derive(Parser)]
    struct Tool {
        #[command(flatten)]
        land: LandArgs,
    }

    #[test]
    fn notes_of_a_real_vehicles_parameters_are_kept_after_the_landing() {
        let is_simulated = |options: &[&str]| {
            let args = [&["land"], options].concat();
            ServiceSettings::new(&Tool::parse_from(args).land).unwrap().is_simulated()
        };
        assert!(is_simulated(&[]));
        assert!(is_simulated(&["--set", "controller.phases.landing_timeout_s=300"]));
        assert!(!is_simulated(&["--autopilot", "udpin:127.0.0.1:14551"]));
        let address = "controller.autopilot.address=\"udpin:127.0.0.1:14551\"";
        assert!(!is_simulated(&["--set", address]));
    }

    #[test]
    fn a_pad_that_is_not_utf_8_is_reported_with_its_line() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("pad.toml");
        std::fs::write(&file, b"id = 1\nname = \"H\xf6he\"\n").unwrap();
        let args = Tool::parse_from(["land", "--pad", file.to_str().unwrap()]);
        let problem = ServiceSettings::new(&args.land).err().unwrap().to_string();
        assert!(problem.contains("is not UTF-8 in line 2: save it as UTF-8"), "{problem}");
    }

    #[test]
    fn landings_that_begin_at_once_meet_at_different_ports() -> anyhow::Result<()> {
        let [first, second] = [Rendezvous::new(None, None)?, Rendezvous::new(None, None)?];
        let [one, other] = [&first, &second].map(|it| std::fs::read_to_string(&it.file));
        assert_ne!(one?, other?, "{} and {}", first.description, second.description);
        Ok(())
    }

    #[test]
    fn a_landing_meets_at_the_requested_port_and_reports_another_one() -> anyhow::Result<()> {
        let (port, lock) = free_port()?;
        drop(lock);
        let args = Tool::parse_from(["land", "--meet", &port.to_string()]).land;
        let asked = Rendezvous::new(None, args.meet)?;
        let config = std::fs::read_to_string(&asked.file)?;
        assert!(config.contains(&format!("127.0.0.1:{port}")), "{config}");
        assert_eq!(asked.unusual_port, None);
        // The first one keeps it.
        let other = Rendezvous::new(None, args.meet)?;
        assert!(other.unusual_port.is_some_and(|it| it != port), "{}", other.description);
        assert!(Tool::try_parse_from(["land", "--meet", "0"]).is_err());
        Ok(())
    }

    #[test]
    fn the_environment_sets_the_port_of_a_landing() {
        use clap::CommandFactory as _;
        let tool = Tool::command();
        let meet = tool.get_arguments().find(|argument| argument.get_id() == "meet").unwrap();
        assert_eq!(meet.get_env(), Some(std::ffi::OsStr::new("ALIGHT_MEET")));
    }

    /// What is published of a landing.
    #[derive(Default)]
    struct Published {
        status: ControllerStatus,
        truth: Option<Truth>,
        vehicle: Option<VehicleState>,
        /// The status after the exit of a service.
        after: Option<ControllerStatus>,
    }

    /// The result of a landing whose simulator exits after these were published.
    async fn without_its_simulator(
        status: ControllerStatus,
        truth: Option<Truth>,
    ) -> anyhow::Result<Outcome> {
        let published = Published { status, truth, ..Published::default() };
        without(Service::Simulator, published).await
    }

    /// The result of a landing of which this service exits after these were published.
    async fn without(service: Service, published: Published) -> anyhow::Result<Outcome> {
        let Published { status, truth, vehicle, after } = published;
        let (port, _lock) = free_port()?;
        let zenoh = ZenohSource::Text(node::session::local_config(port));
        let node = Node::open(tool_identity("land"), &zenoh).await?;
        let statuses = node.publisher(topic::STATUS, &[]).await?;
        let truths = node.publisher(topic::TRUTH, &[]).await?;
        let vehicles = node.publisher(topic::VEHICLE_STATE, &[]).await?;
        let folder = tempfile::tempdir()?;
        let [published, exited] = ["published", "exited"].map(|it| folder.path().join(it));
        let publishing = async {
            while !(statuses.has_subscribers().await
                && truths.has_subscribers().await
                && vehicles.has_subscribers().await)
            {
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            statuses.publish(&status).await;
            if let Some(truth) = &truth {
                truths.publish(truth).await;
            }
            if let Some(vehicle) = &vehicle {
                vehicles.publish(vehicle).await;
            }
            std::fs::write(&published, "")?;
            if let Some(after) = &after {
                let has_exited = || std::fs::read_to_string(&exited).ok()?.trim().parse().ok();
                while has_exited().is_none_or(is_running) {
                    tokio::time::sleep(Duration::from_millis(20)).await;
                }
                tokio::time::sleep(SIGNAL_GRACE + Duration::from_secs(1)).await;
                statuses.publish(after).await;
            }
            std::future::pending::<anyhow::Result<()>>().await
        };
        let settings = ServiceSettings::new(&Tool::try_parse_from(["land"])?.land)?;
        let mut children = Children::new();
        let mut process = tokio::process::Command::new("sh");
        process
            .args(["-c", "while [ ! -e \"$0\" ]; do sleep 0.02; done; echo $$ > \"$1\"; exit 3"])
            .args([&published, &exited]);
        children.spawn(service, process, "sh", Reach::Leader)?;
        let mut progress = Progress::new(Format::Json);
        let deadline = Instant::now() + Duration::from_secs(60);
        let limits = Limits { shutdown: Shutdown::on_signals()?, deadline };
        let landing = tokio::select! {
            landing = watch(&node, &settings, &mut children, "", &mut progress, limits) => landing,
            end = publishing => bail!("publishing: {end:?}"),
        };
        node.close().await;
        Ok(landing?.outcome())
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn the_result_of_a_landing_outlives_its_simulator() -> anyhow::Result<()> {
        let status = |phase, started_ns| ControllerStatus {
            phase,
            why: "because".to_owned(),
            started_ns,
            ..ControllerStatus::default()
        };
        let before = without_its_simulator(status(Phase::Idle, None), None).await;
        let problem = before.err().context("it never flew")?.to_string();
        assert!(problem.contains("exited before the landing: exit status: 3"), "{problem}");

        let outcome = without_its_simulator(status(Phase::Descend, Some(1)), None).await?;
        let json = serde_json::to_string(&outcome)?;
        let outcome_text = "the simulator exited: exit status: 3; it was in descend: because";
        assert!(json.contains(outcome_text) && json.contains("\"landed\":false"), "{json}");
        assert!(!outcome.is_done());

        let landed = ControllerStatus {
            disarmed_ns: Some(3),
            finished: true,
            ..status(Phase::Landed, Some(1))
        };
        let touchdown = Touchdown {
            stamp_ns: 2,
            error_m: 0.02,
            vertical_speed_m_s: 0.5,
            lateral_speed_m_s: 0.0,
        };
        let truth = Truth {
            stamp_ns: 3,
            ned_from_body_wxyz: [1.0, 0.0, 0.0, 0.0],
            position_ned_m: [0.0; 3],
            velocity_ned_m_s: [0.0; 3],
            pad_ned_m: [0.0; 3],
            on_ground: true,
            touchdown: Some(touchdown),
            max_tilt_rad: 0.1,
            frames: 300,
        };
        let outcome = without_its_simulator(landed, Some(truth)).await?;
        let json = serde_json::to_string(&outcome)?;
        assert!(json.contains("\"outcome\":\"landed\""), "{json}");
        assert!(outcome.is_done());
        Ok(())
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_real_vehicle_in_the_air_is_watched_after_its_only_detector_has_exited()
    -> anyhow::Result<()> {
        let taking_off = ControllerStatus { phase: Phase::Takeoff, ..ControllerStatus::default() };
        let aborted = ControllerStatus {
            phase: Phase::Aborted,
            why: "no detector".to_owned(),
            finished: true,
            ..ControllerStatus::default()
        };
        let published = |armed: bool, landed| Published {
            status: taking_off.clone(),
            // It stands on a hill, and is in the air over a valley, by the autopilot's height.
            truth: Some(Truth { on_ground: armed, touchdown: None, ..Truth::sample() }),
            vehicle: Some(reported(armed, landed)),
            after: Some(aborted.clone()),
        };
        let outcome = without(Service::Detector, published(true, LandedState::InAir)).await?;
        let json = serde_json::to_string(&outcome)?;
        assert!(json.contains("\"outcome\":\"aborted: no detector\""), "{json}");
        let before = without(Service::Detector, published(false, LandedState::OnGround)).await;
        let problem = before.err().context("it never flew")?.to_string();
        assert!(problem.contains("detector exited before the landing"), "{problem}");
        Ok(())
    }

    #[test]
    fn the_text_on_an_exited_detector_follows_the_controllers_status() {
        let candidate = |name: &str, alive: bool| Candidate {
            detector: name.into(),
            alive,
            ..Candidate::sample()
        };
        let said = |active: Option<&str>, candidates: &[Candidate]| {
            let status = ControllerStatus {
                active_detector: active.map(Into::into),
                candidates: candidates.to_vec(),
                ..ControllerStatus::default()
            };
            without_detector("main", Some(&status))
        };
        let (main, spare) = (candidate("main", true), candidate("spare", true));
        let both = [main.clone(), spare.clone(), candidate("new", true)];
        assert_eq!(said(Some("new"), &both), "; `new` is used");
        assert_eq!(said(Some("main"), &both), "; `spare` is there, and takes its place");
        assert_eq!(said(None, &[spare]), "; `spare` is there, and takes its place");
        let none = "; another detector is used as soon as one is ready";
        assert_eq!(said(Some("main"), &[main, candidate("spare", false)]), none);
        assert_eq!(without_detector("main", None), none);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_detector_of_another_program_that_is_left_is_named_by_its_process()
    -> anyhow::Result<()> {
        let (port, _lock) = free_port()?;
        let zenoh = ZenohSource::Text(node::session::local_config(port));
        let node = Node::open(tool_identity("land"), &zenoh).await?;
        let infos = node.publisher(topic::DETECTOR_INFO, &["python"]).await?;
        let info = DetectorInfo {
            detector: "python".into(),
            host: node::host_name(),
            place: Place::Onboard,
            camera: "down".into(),
            markers: Vec::new(),
            version: "python".into(),
            pid: 4711,
        };
        infos.publish(&info).await;
        let landing = LandingSummary::default();
        let end = async |detector: &str| end_of(&node, &landing, detector).await;
        assert_eq!(end("python").await.as_deref(), Some("`kill 4711` ends it"));
        infos.publish(&DetectorInfo { host: "ground-station".into(), ..info }).await;
        let elsewhere = end("python").await;
        assert_eq!(elsewhere.as_deref(), Some("`kill 4711` on ground-station ends it"));
        assert_eq!(end("absent").await.as_deref(), Some("end it where it was started"));
        node.close().await;
        Ok(())
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_detector_whose_process_has_ended_is_not_reported_as_left() -> anyhow::Result<()> {
        let (port, _lock) = free_port()?;
        let zenoh = ZenohSource::Text(node::session::local_config(port));
        let node = Node::open(tool_identity("land"), &zenoh).await?;
        let mut ended = std::process::Command::new("true").spawn()?;
        let ended_pid = ended.id();
        ended.wait()?;
        let health = |pid, stamp_ns| messages::Health {
            service: "detector".into(),
            instance: "main".into(),
            host: node::host_name(),
            pid,
            stamp_ns,
            ..messages::Health::sample()
        };
        let mut landing = LandingSummary::default();
        landing.health(health(ended_pid, 2));
        assert_eq!(end_of(&node, &landing, "main").await, None);
        // Another one of its name was there before.
        let left = std::process::id();
        landing.health(health(left, 1));
        assert_eq!(end_of(&node, &landing, "main").await, Some(format!("`kill {left}` ends it")));
        node.close().await;
        Ok(())
    }

    #[test]
    fn no_port_is_found_twice_although_none_is_bound() -> anyhow::Result<()> {
        let found: Vec<u16> =
            (0..20).map(|_| free_port().map(|(port, _)| port)).collect::<anyhow::Result<_>>()?;
        let different: std::collections::BTreeSet<u16> = found.iter().copied().collect();
        assert_eq!(different.len(), found.len(), "{found:?}");
        Ok(())
    }
}
