//! `alight doctor`: checks this machine, its site with keys and devices, the services on the network with their clocks and links,
//! serial ports and ports it connects to; prints verdict, finding and remedy.
//!
//! Serial ports come after the network, as controllers that run hold them.

mod cameras;
mod focus;
mod keys;
mod landing;
mod ports;
mod running;
mod unusable;

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::io::{Error, ErrorKind};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use anyhow::bail;
use clap::Args;
use messages::{CameraInfo, ControllerStatus, Health, Phase, topic};
use node::version::release;
use node::{INSECURE, Node, RELAY, clock_name, stats};
use rustix::process::{Resource, getrlimit};
use serde::Serialize;
use tokio::time::timeout;

use self::focus::{Focus, ReceivedFrame};
use self::keys::Checked;
use self::unusable::{INFOS, Unusable};
use crate::args::{Format, NetworkArgs, OPERATOR, WrongUse, whole_number};
use crate::programs::{missing, missing_of_service, unusable_key};
use crate::runtime::{block_on, tool_identity};
use crate::services::Service;
use crate::site::{Job, Role, Site};
use crate::staleness::Limits;
use crate::terminal::print;

/// The arguments of `alight doctor`.
#[derive(Args, Clone)]
pub(crate) struct DoctorArgs {
    /// Role of this machine.
    #[arg(value_enum)]
    role: Option<Role>,
    /// The site (TOML), as for `alight up`.
    #[arg(long, value_name = "FILE", requires = "role")]
    config: Option<PathBuf>,
    /// Time for which to watch the network, in seconds, from 1 to 60.
    #[arg(long, value_name = "SECONDS", default_value_t = 3, value_parser = whole_number::<u64>(1..=60))]
    seconds: u64,
    /// Format of the result: text, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    network: NetworkArgs,
}

/// Minimum memlock limit of a reader of frames, in bytes: a camera of 1296 x 972 pixels takes 5 MB, and a
/// reader keeps the memory of every camera process it has seen.
const MIN_MEMLOCK: u64 = 64 << 20;
/// Number of round trips to each process.
const ROUND_TRIPS: u32 = 10;
const REPLY_TIMEOUT: Duration = Duration::from_millis(300);
/// The remedy for a network that is open to all.
const MAKE_KEYS: &str = "make keys (`alight keys`, docs/deploy.md), and remove `insecure`";
const OPEN_TIMEOUT: Duration = Duration::from_secs(5);

/// The severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
enum Verdict {
    Good,
    Doubtful,
    Wrong,
}

#[derive(Clone, Debug, Serialize)]
struct Finding {
    verdict: Verdict,
    /// The subject.
    about: &'static str,
    /// The observation.
    finding: String,
    /// The remedy.
    remedy: Option<String>,
}

/// All findings.
#[derive(Default, Serialize)]
struct Findings {
    findings: Vec<Finding>,
}

impl Findings {
    fn good(&mut self, about: &'static str, finding: String) {
        self.findings.push(Finding { verdict: Verdict::Good, about, finding, remedy: None });
    }

    fn doubtful(&mut self, about: &'static str, finding: String, remedy: &str) {
        let remedy = Some(remedy.to_owned());
        self.findings.push(Finding { verdict: Verdict::Doubtful, about, finding, remedy });
    }

    fn wrong(&mut self, about: &'static str, finding: String, remedy: &str) {
        let remedy = Some(remedy.to_owned());
        self.findings.push(Finding { verdict: Verdict::Wrong, about, finding, remedy });
    }

    fn text(&self) -> String {
        let mut text = String::new();
        for Finding { verdict, about, finding, remedy } in &self.findings {
            let mark = match verdict {
                Verdict::Good => "ok   ",
                Verdict::Doubtful => "?    ",
                Verdict::Wrong => "WRONG",
            };
            let _ = writeln!(text, "{mark}  {about:<12}  {finding}");
            if let Some(remedy) = remedy {
                let _ = writeln!(text, "{:22}{remedy}", "->");
            }
        }
        let wrong = self.count(Verdict::Wrong);
        let doubtful = self.count(Verdict::Doubtful);
        let _ = match (wrong, doubtful) {
            (0, 0) => write!(text, "Nothing is wrong."),
            _ => write!(text, "{wrong} wrong, {doubtful} doubtful."),
        };
        text
    }

    fn count(&self, verdict: Verdict) -> usize {
        self.findings.iter().filter(|finding| finding.verdict == verdict).count()
    }
}

/// Runs all checks; the exit status is 1 when something is wrong.
pub(crate) fn run(args: &DoctorArgs) -> anyhow::Result<ExitCode> {
    node::start_logging("off");
    let mut findings = Findings::default();
    check_machine(&mut findings);
    let mut network = args.network.network();
    let mut expected = Vec::new();
    let mut checked = Checked::default();
    // On the drone the requests stay on the machine, and need no key.
    let mut needs_key = true;
    if let (Some(role), None) = (args.role, &args.config) {
        bail!(WrongUse(without_site(role)));
    }
    let site = args.config.as_ref().map(|file| Site::read(file)).transpose()?;
    if let (Some(role), Some(file), Some(site)) = (args.role, &args.config, &site) {
        network = site.network(role);
        needs_key = matches!(role, Role::Ground | Role::Relay);
        match site.jobs(role) {
            Ok(jobs) => {
                check_site(&mut findings, &mut checked, role, &site.folder, &jobs);
                if let Some(problem) = site.marker_problem(role) {
                    findings.wrong("marker", problem, "`alight up ... --dry-run` reports the same");
                }
                expected = jobs;
            }
            Err(problem) => findings.wrong(
                "site",
                format!("{}: {problem:#}", file.display()),
                "fix the file; `alight up ... --dry-run` reports the same",
            ),
        }
    }
    let before = findings.count(Verdict::Wrong);
    if needs_key {
        checked.operator(&mut findings, &network);
    }
    let is_key_wrong = findings.count(Verdict::Wrong) > before;
    let before = findings.findings.len();
    let mut seen = Seen::default();
    match network.source(OPERATOR) {
        Ok(zenoh) => block_on(async {
            match timeout(OPEN_TIMEOUT, Node::open_tool(tool_identity("doctor"), &zenoh)).await {
                Ok(Ok(node)) => {
                    let watched = Watched {
                        role: args.role,
                        duration: Duration::from_secs(args.seconds),
                        // They do not fit an air link.
                        has_raw_frames: network.connect.is_none(),
                    };
                    seen = check_network(&mut findings, node, watched, &expected).await;
                }
                Ok(Err(problem)) => findings.wrong("network", format!("{problem:#}"), "see above"),
                Err(_) => findings.wrong(
                    "network",
                    format!("cannot join the network within {} s", OPEN_TIMEOUT.as_secs()),
                    "see above",
                ),
            }
        })?,
        Err(_) if is_key_wrong => findings.doubtful(
            "network",
            "not checked, as the operator's key cannot be used".to_owned(),
            "fix the key, then run this again",
        ),
        Err(problem) => findings.wrong(
            "network",
            format!("{problem:#}"),
            "`alight doctor` uses the operator's key",
        ),
    }
    check_serial_ports(&mut findings, &expected, seen.has_controller());
    let is_service = |f: &Finding| f.about == "services" && f.verdict == Verdict::Good;
    let sees_any = findings.findings[before..].iter().any(is_service);
    let sees_drone = seen.has_relay_of_drone();
    for target in ports::targets(args.role, site.as_ref(), &network, sees_any, sees_drone) {
        ports::check(&mut findings, &target, network.keys.is_some());
    }
    print(&match args.format {
        Format::Text => findings.text(),
        Format::Json => serde_json::to_string(&findings)?,
    })?;
    Ok(ExitCode::from(u8::from(findings.count(Verdict::Wrong) > 0)))
}

/// The error for a role without the site that lists its processes.
fn without_site(role: Role) -> String {
    let role = role.name();
    format!(
        "`alight doctor {role}` needs the site whose processes it compares: `alight doctor {role} --config site.toml`; without a role, \
         `alight doctor` checks this machine and what runs on it"
    )
}

fn check_machine(findings: &mut Findings) {
    let system = rustix::system::uname();
    let cores = std::thread::available_parallelism().map_or(0, std::num::NonZero::get);
    findings.good(
        "machine",
        format!(
            "alight {} on {} ({} {}, {cores} cores), clock {}",
            node::version(),
            system.nodename().to_string_lossy(),
            system.sysname().to_string_lossy(),
            system.machine().to_string_lossy(),
            clock_name()
        ),
    );
    match getrlimit(Resource::Memlock).current {
        Some(limit) if limit < MIN_MEMLOCK => findings.doubtful(
            "memory",
            format!(
                "memlock limit: {} MB; restarts of the camera exhaust it, and frames are then copied or dropped",
                limit >> 20
            ),
            "set LimitMEMLOCK=infinity in the systemd unit, or a `memlock` line in /etc/security/limits.conf",
        ),
        Some(limit) => findings.good("memory", format!("memlock limit: {} MB", limit >> 20)),
        None => findings.good("memory", "memlock limit: unlimited".to_owned()),
    }
    let shared = Path::new("/dev/shm");
    match tempfile::Builder::new().prefix("alight-doctor-").tempfile_in(shared) {
        Ok(_) => {}
        Err(cause) => findings.wrong(
            "memory",
            format!("/dev/shm is not writable ({cause}), so every frame is copied"),
            "mount a tmpfs there; in a container use --ipc=host or --shm-size=64m",
        ),
    }
}

fn check_site(
    findings: &mut Findings,
    checked: &mut Checked,
    role: Role,
    folder: &Path,
    jobs: &[Job],
) {
    let names: Vec<_> = jobs.iter().map(|job| job.name.as_str()).collect();
    findings.good("site", format!("{} runs {}", role.name(), names.join(", ")));
    let search = std::env::var_os("PATH").unwrap_or_default();
    for job in jobs {
        if job.network.is_open().unwrap_or(false) {
            findings.doubtful("security", format!("{}: {INSECURE}", job.name), MAKE_KEYS);
        }
        checked.process(findings, job);
        let missing = missing(job, folder, &search);
        if let Some(problem) = missing.or_else(|| missing_of_service(job, folder, &search)) {
            findings.wrong("programs", problem, "`alight up ... --dry-run` reports the same");
        }
        if let Some(service) = job.service {
            check_devices(findings, job, service, folder);
        }
    }
}

/// Checks the files and devices that a service needs.
fn check_devices(findings: &mut Findings, job: &Job, service: Service, folder: &Path) {
    let Ok(config) = service.effective_config(&job.layers) else { return };
    if let Some(problem) = unusable_key(job, folder) {
        findings.wrong(
            "signing",
            problem.to_string(),
            "`alight keys signing` makes a key, for the user that runs `alight`",
        );
    }
    if service == Service::CameraPub {
        let paths = config["source"]["paths"].as_array().into_iter().flatten();
        for path in paths.filter_map(toml::Value::as_str) {
            if let Err(cause) = std::fs::metadata(folder.join(path)) {
                findings.wrong("camera", format!("{path}: {cause}"), "correct `source.paths`");
            }
        }
    }
}

/// Checks that the autopilots' serial ports can be opened. `has_controller`: one is ready, which has exclusive use of its port.
fn check_serial_ports(findings: &mut Findings, jobs: &[Job], has_controller: bool) {
    for job in jobs.iter().filter(|job| job.service == Some(Service::Controller)) {
        let Ok(config) = job.layers.load::<controller::Config>() else { continue };
        if let Some(device) = config.settings.serial_device()
            && let Err(cause) = std::fs::OpenOptions::new().read(true).write(true).open(&device)
        {
            report_unopened(findings, &device, &cause, has_controller);
        }
    }
}

/// Reports that a serial port cannot be opened, with the cause and the remedy.
fn report_unopened(findings: &mut Findings, device: &str, cause: &Error, has_controller: bool) {
    match cause.kind() {
        ErrorKind::ResourceBusy if has_controller => findings.good(
            "autopilot",
            format!("{device} is in use by another program, as it is while a controller runs"),
        ),
        ErrorKind::ResourceBusy => findings.doubtful(
            "autopilot",
            format!("{device} is in use by another program, and no controller is ready"),
            &format!(
                "`sudo fuser -v {device}` names the program: end it, or where it is a controller see the output of `alight up`"
            ),
        ),
        _ => findings.wrong(
            "autopilot",
            format!("{device} cannot be opened: {cause}"),
            "connect the autopilot, and add the user to the group that owns the device (often `dialout`)",
        ),
    }
}

/// For how long and with which frames the network is watched.
#[derive(Clone, Copy)]
struct Watched {
    /// The role of this machine.
    role: Option<Role>,
    duration: Duration,
    has_raw_frames: bool,
}

/// The messages that were received from the network.
#[derive(Default)]
struct Seen {
    peers: Vec<(String, String)>,
    healths: Vec<Health>,
    cameras: Vec<CameraInfo>,
    status: Option<ControllerStatus>,
    /// The number of frames and detections of each detector, by its name; some detectors publish no health.
    detectors: BTreeMap<String, Searched>,
    /// The cameras whose frames they search.
    searched: BTreeSet<String>,
    /// The time at the end of the watch, in nanoseconds.
    ended_ns: i64,
    /// As JPEG.
    frames: Vec<ReceivedFrame>,
    raw_frames: Vec<ReceivedFrame>,
    /// The cameras' messages that no detector uses.
    unusable: Unusable,
    /// The controller's limits for detectors, if its configuration was received.
    limits: Option<Limits>,
}

impl Seen {
    /// Whether frames of a camera or detections of a detector were received.
    fn has_received(&self, service: &str, instance: &str) -> bool {
        match service {
            "detector" => self.detectors.contains_key(instance),
            "camera-pub" => {
                let mut frames = self.frames.iter().chain(&self.raw_frames);
                self.cameras.iter().any(|info| info.camera == instance)
                    || frames.any(|frame| frame.header.camera == instance)
            }
            _ => false,
        }
    }

    /// Whether a detector searches the frames of a camera.
    fn is_searched(&self, camera: &str) -> bool {
        self.searched.contains(camera)
    }

    /// Whether a controller is ready.
    fn has_controller(&self) -> bool {
        self.peers.iter().any(|(service, _)| service == "controller")
    }

    /// Whether a detector is alive: it is ready, or its detections or its information were received.
    fn has_detector(&self) -> bool {
        !self.detectors.is_empty() || self.peers.iter().any(|(service, _)| service == "detector")
    }

    /// Whether the drone is there, by its relay.
    fn has_relay_of_drone(&self) -> bool {
        self.peers.iter().any(|(service, instance)| service == RELAY && instance == "drone")
    }

    /// True while a landing is under way.
    fn lands(&self) -> bool {
        self.status.as_ref().is_some_and(|status| match status.phase {
            Phase::Search
            | Phase::Approach
            | Phase::Descend
            | Phase::Retry
            | Phase::Hold
            | Phase::Final => !status.finished,
            _ => false,
        })
    }
}

/// Whether a site has a camera run on this machine.
fn has_camera(expected: &[Job]) -> bool {
    expected.iter().any(|job| job.service == Some(Service::CameraPub))
}

/// Frames that a detector searched, and those in which it found a marker.
#[derive(Copy, Clone, Debug, Default)]
struct Searched {
    frames: u32,
    found: u32,
}

/// Checks the messages on the network, and returns them.
async fn check_network(
    findings: &mut Findings,
    node: Node,
    watched: Watched,
    expected: &[Job],
) -> Seen {
    let mut seen = Seen::default();
    match watch(&node, &mut seen, watched).await {
        Ok(()) => {
            check_presence(findings, &seen, expected, watched);
            check_replies(findings, &node, &seen).await;
            check_healths(findings, &seen);
            cameras::check(findings, &seen, watched, has_camera(expected));
            check_detectors(findings, &seen, watched);
            landing::check(findings, &seen);
        }
        Err(problem) => findings.wrong("network", format!("{problem:#}"), "start it again"),
    }
    node.close().await;
    seen
}

async fn watch(node: &Node, seen: &mut Seen, watched: Watched) -> anyhow::Result<()> {
    seen.peers = node.list_peers().await?;
    let (healths, cameras, statuses, infos, detections, configurations) = tokio::try_join!(
        node.subscriber(topic::HEALTH, &[]),
        node.subscriber(topic::CAMERA_INFO, &[]),
        node.subscriber(topic::STATUS, &[]),
        node.subscriber(topic::DETECTOR_INFO, &[]),
        node.subscriber(topic::DETECTIONS, &[]),
        node.subscriber(topic::CONFIGURATION, &["controller"]),
    )?;
    // JPEG frames fit every link; our cameras make them while there is a subscriber, others may not.
    let frames = node.frame_subscriber(topic::JPEG, &[]).await?;
    let raw = match watched.has_raw_frames {
        true => Some(node.frame_subscriber(topic::FRAME, &[]).await?),
        false => None,
    };
    let next_raw = async || match &raw {
        Some(raw) => raw.next().await,
        None => std::future::pending().await,
    };
    let mut focus = Focus::default();
    let watching = async {
        loop {
            tokio::select! {
                Some(health) = healths.next() => keep(&mut seen.healths, health, |a, b| {
                    (&a.service, &a.instance) == (&b.service, &b.instance)
                }),
                Some((key, info)) = cameras.next_with_key() => {
                    let key = topic::CAMERA_INFO.first_name(&key).unwrap_or_default();
                    if seen.unusable.names_its_key(INFOS, key, &info.camera) {
                        keep(&mut seen.cameras, info, |a, b| a.camera == b.camera);
                    }
                }
                Some(configuration) = configurations.next() => {
                    seen.limits = Limits::published(&configuration).or(seen.limits);
                }
                Some(status) = statuses.next() => seen.status = Some(status),
                Some(info) = infos.next() => {
                    seen.searched.insert(info.camera);
                    seen.detectors.entry(info.detector).or_default();
                }
                Some(found) = detections.next() => {
                    seen.searched.insert(found.header.camera);
                    let searched = seen.detectors.entry(found.detector).or_default();
                    searched.frames += 1;
                    searched.found += u32::from(!found.detections.is_empty());
                }
                Some(frame) = frames.next() => {
                    if seen.unusable.accepts(topic::JPEG, &frame) {
                        seen.frames.push(focus.received(frame));
                    }
                }
                Some(frame) = next_raw() => {
                    if seen.unusable.accepts(topic::FRAME, &frame) {
                        seen.raw_frames.push(focus.received(frame));
                    }
                }
            }
        }
    };
    let _: Result<(), _> = timeout(watched.duration, watching).await;
    seen.ended_ns = node::now_ns();
    seen.unusable.take_unreadable(node.health());
    // Peers that joined meanwhile.
    seen.peers.extend(node.list_peers().await?);
    seen.peers.sort();
    seen.peers.dedup();
    Ok(())
}

/// Replaces an older message of the same sender.
fn keep<T>(kept: &mut Vec<T>, new: T, same: impl Fn(&T, &T) -> bool) {
    match kept.iter_mut().find(|old| same(old, &new)) {
        Some(old) => *old = new,
        None => kept.push(new),
    }
}

/// Reports the services of this machine whose processes run without being ready; returns the other jobs.
fn check_silent<'a>(findings: &mut Findings, seen: &Seen, expected: &'a [Job]) -> Vec<&'a Job> {
    let silent_process = |job: &Job| {
        let names = (job.service?.name(), job.instance.as_deref()?);
        let mut ready = seen.peers.iter();
        let is_ready =
            ready.any(|(service, instance)| (service.as_str(), instance.as_str()) == names);
        if is_ready { None } else { running::process(job) }
    };
    let mut others = Vec::new();
    for job in expected {
        match silent_process(job) {
            Some(pid) => findings.wrong(
                "services",
                format!("the {} runs here as process {pid}, but does not answer", job.name),
                &format!(
                    "if it was not started just now, it hangs or is stopped (`ps -o stat= -p {pid}` shows T then): `kill -9 {pid}` ends it, and \
                     `alight up` restarts it"
                ),
            ),
            None => others.push(job),
        }
    }
    others
}

fn check_presence(findings: &mut Findings, seen: &Seen, expected: &[Job], watched: Watched) {
    let others = check_silent(findings, seen, expected);
    let is_any_here = !seen.peers.is_empty() || others.len() < expected.len();
    // Without a site, and on this machine, nothing need run yet.
    if !is_any_here && expected.is_empty() && watched.has_raw_frames {
        findings.doubtful(
            "services",
            "no service runs on this machine".to_owned(),
            "start them (`alight up`, `alight land`), or name a site (`alight doctor drone --config site.toml`)",
        );
        return;
    }
    if !is_any_here {
        findings.wrong(
            "services",
            "no service found".to_owned(),
            "start them (`alight up`), and compare the vehicle's name and the address on both sides",
        );
        return;
    }
    for job in others {
        let (Some(service), Some(instance)) = (job.service, &job.instance) else { continue };
        let ready = seen.peers.iter().filter(|(alive, _)| alive == service.name());
        let ready: Vec<&str> = ready.map(|(_, instance)| instance.as_str()).collect();
        if ready.is_empty() {
            findings.wrong(
                "services",
                format!("no {} is ready, but this machine should run one", service.name()),
                "see the output of `alight up`",
            );
        } else if !ready.contains(&instance.as_str()) {
            findings.doubtful(
                "services",
                format!(
                    "no {} `{instance}` is ready, but this machine should run one; ready: {}",
                    service.name(),
                    ready.join(", ")
                ),
                "see the output of `alight up`; a detector that `alight swap` replaced stays away while the other runs",
            );
        }
    }
    // One that this machine should run is reported above.
    let is_expected = expected.iter().any(|job| job.service == Some(Service::Controller));
    if !seen.has_controller() && !is_expected {
        let remedy = match watched.role {
            Some(Role::Local) => "list one in the site, and run `alight up local`",
            _ => "run `alight up drone` on the drone",
        };
        findings.doubtful(
            "services",
            "no controller is ready, so nothing can land".to_owned(),
            remedy,
        );
    }
}

async fn check_replies(findings: &mut Findings, node: &Node, seen: &Seen) {
    let mut queries = tokio::task::JoinSet::new();
    for (service, instance) in seen.peers.iter().filter(|(service, _)| service != "alight") {
        let (node, service, instance) = (node.clone(), service.clone(), instance.clone());
        queries.spawn(async move {
            let mut times_ms = Vec::new();
            for _ in 0..ROUND_TRIPS {
                let time = node.round_trip(&service, &instance, REPLY_TIMEOUT).await;
                times_ms.extend(time.map(|time| time.as_secs_f64() * 1e3));
            }
            (service, instance, times_ms)
        });
    }
    let mut replies = queries.join_all().await;
    replies.sort_by(|a, b| (&a.0, &a.1).cmp(&(&b.0, &b.1)));
    for (service, instance, times_ms) in replies {
        check_reply(findings, seen, &service, &instance, &times_ms);
    }
}

fn check_reply(
    findings: &mut Findings,
    seen: &Seen,
    service: &str,
    instance: &str,
    times_ms: &[f64],
) {
    let is_its = |health: &&Health| health.service == service && health.instance == instance;
    let health = seen.healths.iter().find(is_its);
    let process = match health {
        Some(health) => {
            format!("{service} `{instance}` on {} (alight {})", health.host, health.version)
        }
        None => format!("{service} `{instance}`"),
    };
    let lost = ROUND_TRIPS as usize - times_ms.len().min(ROUND_TRIPS as usize);
    let Some(median_ms) = stats::quantile(times_ms, 0.5) else {
        // Cameras and detectors of other programs need not publish it (docs/wire-format.md).
        if health.is_none() && seen.has_received(service, instance) {
            return findings
                .good("services", format!("{process} is present (publishes no health)"));
        }
        return findings.wrong(
            "services",
            format!("{process} does not answer"),
            "it has another version, or it or the link hangs; see its log",
        );
    };
    let took = format!("{process} answers in {median_ms:.1} ms");
    match lost {
        0 => findings.good("services", took),
        _ => findings.doubtful(
            "link",
            format!("{took}; {lost} of {ROUND_TRIPS} queries were lost"),
            "reduce the distance, or use a channel with less traffic",
        ),
    }
}

fn check_healths(findings: &mut Findings, seen: &Seen) {
    for health in &seen.healths {
        let process = format!("{} `{}`", health.service, health.instance);
        check_version(findings, &process, &health.version, node::version());
        if health.errors.iter().any(|error| error.reason == INSECURE) {
            findings.doubtful("security", format!("{process}: {INSECURE}"), MAKE_KEYS);
        }
        let others = health.errors.iter().filter(|error| error.reason != INSECURE);
        let errors: Vec<_> = others.map(|e| format!("{} ({} times)", e.reason, e.count)).collect();
        if !errors.is_empty() {
            findings.doubtful(
                "services",
                format!("{process} counted errors since its start: {}", errors.join(", ")),
                "its log has the first one of each reason",
            );
        }
    }
}

fn check_detectors(findings: &mut Findings, seen: &Seen, watched: Watched) {
    for (name, searched) in &seen.detectors {
        let Searched { frames, found } = *searched;
        let rate_hz = f64::from(frames) / watched.duration.as_secs_f64();
        match frames {
            0 => findings.doubtful(
                "detector",
                format!("`{name}`: no detections came that can be read and have its name"),
                &format!(
                    "it needs frames of its camera (`camera` in its configuration): see the lines of the cameras above, and its log; your own one \
                     publishes Detections on `detector/{name}/detections` for each frame, also without a marker (docs/wire-format.md)"
                ),
            ),
            _ => findings.good(
                "detector",
                format!("`{name}`: detections of {rate_hz:.1} frames/s came; a marker in {found} of {frames}"),
            ),
        }
    }
}

/// Compares the version of another process with that of this program.
fn check_version(findings: &mut Findings, process: &str, theirs: &str, ours: &str) {
    let text = format!("{process} is alight {theirs}, this is {ours}");
    match release(theirs) == release(ours) {
        true if theirs == ours => {}
        true => findings.doubtful(
            "versions",
            text,
            "install the same build on all machines, or know that they fit each other",
        ),
        false => findings.wrong("versions", text, "install the same version on all machines"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Tool {
        #[command(flatten)]
        doctor: DoctorArgs,
    }

    #[test]
    fn a_role_without_its_site_is_answered_with_the_command_that_is_right() {
        let args = |words: &[&str]| Tool::try_parse_from(words).unwrap().doctor;
        let problem = run(&args(&["alight", "local"])).unwrap_err();
        assert!(problem.is::<WrongUse>());
        let error = problem.to_string();
        assert!(error.contains("`alight doctor local --config site.toml`"), "{error}");
        assert!(error.contains("without a role, `alight doctor` checks this machine"), "{error}");
    }

    #[test]
    fn another_build_of_the_same_version_is_doubtful() {
        let counts = |theirs: &str| {
            let mut findings = Findings::default();
            check_version(
                &mut findings,
                "detector `main`",
                theirs,
                "0.1.0 (1a2b3c4d5, 2026-11-27)",
            );
            (findings.count(Verdict::Doubtful), findings.count(Verdict::Wrong))
        };
        assert_eq!(counts("0.1.0 (1a2b3c4d5, 2026-11-27)"), (0, 0));
        assert_eq!(counts("0.1.0 (1a2b3c4d5, 2026-11-27, changed)"), (1, 0));
        assert_eq!(counts("0.1.0"), (1, 0));
        assert_eq!(counts("0.2.0 (1a2b3c4d5, 2026-11-27)"), (0, 1));
    }

    #[test]
    fn a_detector_that_searches_nothing_is_doubtful() {
        let searched = Searched { frames: 30, found: 27 };
        let detectors = [("idle", Searched::default()), ("main", searched)];
        let detectors = detectors.map(|(name, searched)| (name.to_owned(), searched)).into();
        let watched =
            Watched { role: None, duration: Duration::from_secs(3), has_raw_frames: true };
        let mut findings = Findings::default();
        check_detectors(&mut findings, &Seen { detectors, ..Seen::default() }, watched);
        let text = findings.text();
        assert!(text.contains("`idle`: no detections came that can be read"), "{text}");
        assert!(text.contains("publishes Detections on `detector/idle/detections`"), "{text}");
        assert!(
            text.contains("`main`: detections of 10.0 frames/s came; a marker in 27 of 30"),
            "{text}"
        );
        assert!(text.ends_with("0 wrong, 1 doubtful."), "{text}");
    }

    #[test]
    fn a_service_of_the_site_is_missed_by_its_name() {
        let site: Site = toml::from_str(
            "address = '10.42.0.1'\ninsecure = true\nground = [{ run = 'detector', set = ['id=\"ground\"'] }]",
        )
        .unwrap();
        let expected = site.jobs(Role::Ground).unwrap();
        let findings_text = |ready: &[&str]| {
            let peers = ready.iter().map(|name| ("detector".to_owned(), (*name).to_owned()));
            let peers = [("controller".to_owned(), "main".to_owned())].into_iter().chain(peers);
            let seen = Seen { peers: peers.collect(), ..Seen::default() };
            let watched =
                Watched { role: None, duration: Duration::from_secs(3), has_raw_frames: false };
            let mut findings = Findings::default();
            check_presence(&mut findings, &seen, &expected, watched);
            findings.text()
        };
        assert!(findings_text(&["onboard", "ground"]).ends_with("Nothing is wrong."));
        let another = findings_text(&["onboard"]);
        assert!(another.contains("no detector `ground` is ready"), "{another}");
        assert!(another.ends_with("0 wrong, 1 doubtful."), "{another}");
        assert!(findings_text(&[]).ends_with("1 wrong, 0 doubtful."));
    }

    #[test]
    fn a_missing_controller_is_reported_once_with_the_remedy_for_the_role() {
        let site: Site = toml::from_str("local = [{ run = 'controller' }]").unwrap();
        let expected = site.jobs(Role::Local).unwrap();
        let findings_text = |role, expected: &[Job]| {
            let peers = vec![("detector".to_owned(), "main".to_owned())];
            let seen = Seen { peers, ..Seen::default() };
            let watched = Watched { role, duration: Duration::from_secs(3), has_raw_frames: true };
            let mut findings = Findings::default();
            check_presence(&mut findings, &seen, expected, watched);
            findings.text()
        };
        assert!(findings_text(None, &[]).contains("run `alight up drone` on the drone"));
        let local = findings_text(Some(Role::Local), &[]);
        assert!(local.contains("list one in the site") && !local.contains("drone"), "{local}");
        let listed = findings_text(Some(Role::Local), &expected);
        assert!(listed.contains("no controller is ready, but this machine should"), "{listed}");
        assert!(listed.ends_with("1 wrong, 0 doubtful."), "{listed}");
    }

    #[test]
    fn a_serial_port_that_is_in_use_is_well_while_a_controller_runs() {
        let findings_text = |kind: ErrorKind, has_controller| {
            let mut findings = Findings::default();
            report_unopened(&mut findings, "/dev/ttyAMA0", &kind.into(), has_controller);
            findings.text()
        };
        let held = findings_text(ErrorKind::ResourceBusy, true);
        assert!(held.contains("/dev/ttyAMA0 is in use by another program"), "{held}");
        assert!(held.ends_with("Nothing is wrong."), "{held}");
        let taken = findings_text(ErrorKind::ResourceBusy, false);
        assert!(taken.contains("no controller is ready") && taken.contains("fuser"), "{taken}");
        assert!(taken.ends_with("0 wrong, 1 doubtful."), "{taken}");
        for kind in [ErrorKind::NotFound, ErrorKind::PermissionDenied] {
            for has_controller in [true, false] {
                let text = findings_text(kind, has_controller);
                assert!(text.contains("cannot be opened") && text.contains("dialout"), "{text}");
                assert!(text.ends_with("1 wrong, 0 doubtful."), "{text}");
            }
        }
    }

    #[test]
    fn a_camera_or_detector_without_health_is_well_while_its_messages_come() {
        let model = geometry::CameraModel::pinhole(640, 480, 1800.0);
        let info = CameraInfo::new("down", &model, &geometry::Transform::identity());
        let seen = Seen {
            cameras: vec![info],
            detectors: BTreeMap::from([("mine".to_owned(), Searched::default())]),
            ..Seen::default()
        };
        let findings_text = |service, instance| {
            let mut findings = Findings::default();
            check_reply(&mut findings, &seen, service, instance, &[]);
            findings.text()
        };
        for (service, instance) in [("camera-pub", "down"), ("detector", "mine")] {
            let text = findings_text(service, instance);
            let well = format!("{service} `{instance}` is present (publishes no health)");
            assert!(text.contains(&well) && text.ends_with("Nothing is wrong."), "{text}");
        }
        for (service, instance) in
            [("camera-pub", "up"), ("detector", "no"), ("controller", "mine")]
        {
            let text = findings_text(service, instance);
            assert!(text.contains("does not answer") && text.contains("1 wrong"), "{text}");
        }
    }
}
