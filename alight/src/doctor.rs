//! `alight doctor`: what is wrong here, in plain sentences, within seconds.
//!
//! First what can be told alone (the machine, the site, its keys, its ports), then what can be seen of the network.

use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use messages::{CameraInfo, ControllerStatus, FrameHeader, Health, topic};
use node::{Identity, Node, clock_name, now_ns};
use rustix::process::{Resource, getrlimit};
use serde::Serialize;
use tokio::time::timeout;

use crate::cli::{NetworkArgs, OPERATOR};
use crate::keys;
use crate::land::Format;
use crate::services;
use crate::site::{Job, Role, Site};

/// What is looked at.
#[derive(Args, Clone)]
pub(crate) struct DoctorArgs {
    /// What this machine is for.
    #[arg(value_enum, requires = "config")]
    role: Option<Role>,
    /// The site (TOML), as for `alight up`.
    #[arg(long, value_name = "FILE", requires = "role")]
    config: Option<PathBuf>,
    /// How long the network is watched, in seconds, from 1 to 60.
    #[arg(long, value_name = "SECONDS", default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=60))]
    seconds: u64,
    /// For people, or one JSON object for programs.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
    #[command(flatten)]
    network: NetworkArgs,
}

/// Memory that a reader of frames must be able to lock, in bytes: a camera of 1296 x 972 takes 5 MB, and a reader
/// keeps that of each camera process it has seen.
const ENOUGH_LOCKED: u64 = 64 << 20;
/// A certificate that ends sooner is told of.
const ENDS_SOON_S: i64 = 30 * 86_400;
/// Questions to each process.
const QUESTIONS: u32 = 10;
const ANSWER_PATIENCE: Duration = Duration::from_millis(300);
const CONNECT_PATIENCE: Duration = Duration::from_millis(1000);
const OPEN_PATIENCE: Duration = Duration::from_secs(5);

/// How bad something is.
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
    /// What was looked at.
    about: &'static str,
    /// What was found.
    finding: String,
    /// What can be done about it.
    remedy: Option<String>,
}

/// Everything that was found.
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

/// Looks at everything, and says what is wrong.
pub(crate) fn run(args: &DoctorArgs) -> anyhow::Result<ExitCode> {
    node::start_logging("off");
    let mut findings = Findings::default();
    look_at_machine(&mut findings);
    let mut network = args.network.network();
    let mut expected = Vec::new();
    if let (Some(role), Some(file)) = (args.role, &args.config) {
        let site = Site::read(file)?;
        network = site.network(role);
        match site.jobs(role) {
            Ok(jobs) => {
                look_at_site(&mut findings, role, &jobs);
                expected = jobs;
            }
            Err(problem) => findings.wrong(
                "site",
                format!("{}: {problem:#}", file.display()),
                "mend the file; `alight up ... --dry-run` says the same",
            ),
        }
    } else if let Some(keys) = &network.keys {
        look_at_certificate(&mut findings, keys, OPERATOR);
    }
    let before = findings.findings.len();
    match network.source(OPERATOR) {
        Ok(zenoh) => services::runtime()?.block_on(async {
            let identity =
                Identity { service: "alight", instance: format!("doctor-{}", std::process::id()) };
            match timeout(OPEN_PATIENCE, Node::open(identity, &zenoh)).await {
                Ok(Ok(node)) => look_at_network(&mut findings, node, args.seconds, &expected).await,
                Ok(Err(problem)) => findings.wrong("network", format!("{problem:#}"), "see above"),
                Err(_) => findings.wrong(
                    "network",
                    format!("the network cannot be joined within {} s", OPEN_PATIENCE.as_secs()),
                    "see above",
                ),
            }
        }),
        Err(problem) => findings.wrong(
            "network",
            format!("{problem:#}"),
            "`alight doctor` looks at the network with the operator's key",
        ),
    }
    // Knocking at the doors would be counted as a stranger's attempt, so it is done only when nobody was met.
    let told = &findings.findings[before..];
    if !told.iter().any(|f| f.about == "services" && f.verdict == Verdict::Good) {
        look_at_way(&mut findings, &network);
    }
    use std::io::Write;
    let text = match args.format {
        Format::Text => findings.text(),
        Format::Json => serde_json::to_string(&findings)?,
    };
    writeln!(std::io::stdout(), "{text}")?;
    Ok(ExitCode::from(u8::from(findings.count(Verdict::Wrong) > 0)))
}

fn look_at_machine(findings: &mut Findings) {
    let system = rustix::system::uname();
    let cores = std::thread::available_parallelism().map_or(0, std::num::NonZero::get);
    findings.good(
        "machine",
        format!(
            "alight {} on {} ({} {}, {cores} cores), clock {}",
            env!("CARGO_PKG_VERSION"),
            system.nodename().to_string_lossy(),
            system.sysname().to_string_lossy(),
            system.machine().to_string_lossy(),
            clock_name()
        ),
    );
    match getrlimit(Resource::Memlock).current {
        Some(limit) if limit < ENOUGH_LOCKED => findings.doubtful(
            "memory",
            format!(
                "a process may lock {} MB of memory; a detector that sees its camera start again and again comes to the limit, and then receives copies or nothing",
                limit >> 20
            ),
            "LimitMEMLOCK=infinity in the systemd unit, or a `memlock` line in /etc/security/limits.conf",
        ),
        Some(limit) => findings.good("memory", format!("a process may lock {} MB", limit >> 20)),
        None => findings.good("memory", "a process may lock all it wants".to_owned()),
    }
    let shared = Path::new("/dev/shm");
    match tempfile::Builder::new().prefix("alight-doctor-").tempfile_in(shared) {
        Ok(_) => {}
        Err(cause) => findings.wrong(
            "memory",
            format!("/dev/shm cannot be written to ({cause}), so every frame is copied"),
            "mount a tmpfs there, in a container with --ipc=host or --shm-size=64m",
        ),
    }
}

fn look_at_site(findings: &mut Findings, role: Role, jobs: &[Job]) {
    let names: Vec<_> = jobs.iter().map(|job| job.name.as_str()).collect();
    findings.good("site", format!("{} runs {}", role.name(), names.join(", ")));
    let mut seen = Vec::new();
    for job in jobs {
        if let Some(keys) = job.network.keys.as_deref().filter(|_| job.needs_key())
            && !seen.contains(&job.key)
        {
            look_at_certificate(findings, keys, &job.key);
            seen.push(job.key.clone());
        }
        if let Some(service) = job.service {
            look_at_devices(findings, job, service);
        }
    }
}

/// Files and devices that a service needs.
fn look_at_devices(findings: &mut Findings, job: &Job, service: services::Service) {
    let Ok(config) = service.effective_config(&job.layers) else { return };
    if service == services::Service::Controller
        && let Some(address) = config["autopilot"]["address"].as_str()
        && let Some(device) =
            address.strip_prefix("serial:").and_then(|rest| rest.split(':').next())
        && let Err(cause) = std::fs::OpenOptions::new().read(true).write(true).open(device)
    {
        findings.wrong(
            "autopilot",
            format!("{device} cannot be opened: {cause}"),
            "is the autopilot connected, and is the user in the group that owns the device (often `dialout`)?",
        );
    }
    if service == services::Service::CameraPub {
        let paths = config["source"]["paths"].as_array().into_iter().flatten();
        for path in paths.filter_map(toml::Value::as_str) {
            if let Err(cause) = std::fs::metadata(path) {
                findings.wrong("camera", format!("{path}: {cause}"), "correct `source.paths`");
            }
        }
    }
}

fn look_at_certificate(findings: &mut Findings, keys: &Path, role: &str) {
    for name in [role, "authority"] {
        let path = keys.join(format!("{name}.pem"));
        let again = "make a new one with `alight keys`, in a new directory";
        match keys::certificate(&path) {
            Err(problem) => findings.wrong("keys", format!("{problem:#}"), again),
            Ok(read) if name == role && read.role != role => findings.wrong(
                "keys",
                format!("{path:?} is for the role `{}`", read.role),
                "keep the file names that `alight keys issue` gave",
            ),
            Ok(read) if read.ends_in_s < 0 => {
                findings.wrong("keys", format!("{path:?} has ended"), again);
            }
            Ok(read) if read.ends_in_s < ENDS_SOON_S => findings.doubtful(
                "keys",
                format!("{path:?} ends in {} days", read.ends_in_s / 86_400),
                again,
            ),
            Ok(read) => findings
                .good("keys", format!("{path:?} is good for {} days", read.ends_in_s / 86_400)),
        }
    }
    use std::os::unix::fs::PermissionsExt;
    let key = keys.join(format!("{role}.key"));
    if std::fs::metadata(&key).is_ok_and(|file| file.permissions().mode() & 0o077 != 0) {
        findings.wrong(
            "keys",
            format!("{key:?} can be read by others"),
            "chmod 600; if somebody may have read it, make a new authority",
        );
    }
}

/// Whether the other side's ports answer.
fn look_at_way(findings: &mut Findings, network: &node::Network) {
    use std::net::{TcpStream, ToSocketAddrs};
    let Some(address) = &network.connect else { return };
    let ports = match address.rsplit_once(':') {
        Some((host, port)) if !host.contains(':') => (host, port.parse().unwrap_or(0)),
        _ => (address.as_str(), node::network::AIR_PORT),
    };
    let over = if network.keys.is_some() { "TLS over TCP" } else { "TCP" };
    for (further, what) in (0_u16..).zip(["control", "frames", "frames, when one is held up"]) {
        let port = ports.1.saturating_add(further);
        let found = (ports.0, port).to_socket_addrs().ok().and_then(|mut all| all.next());
        let Some(found) = found else {
            findings.wrong(
                "way",
                format!("the address {} has no meaning here", ports.0),
                "write an IP address, or a name that this machine knows",
            );
            return;
        };
        match TcpStream::connect_timeout(&found, CONNECT_PATIENCE) {
            Ok(_) => findings.good("way", format!("{found} answers ({what}; {over})")),
            Err(cause) => findings.wrong(
                "way",
                format!("{found} ({what}) does not answer: {cause}"),
                "is `alight up drone` running there, is the address right, and does no firewall stand between?",
            ),
        }
    }
}

/// What was seen of the network.
#[derive(Default)]
struct Seen {
    everybody: Vec<(String, String)>,
    healths: Vec<Health>,
    cameras: Vec<CameraInfo>,
    status: Option<ControllerStatus>,
    frames: Vec<(FrameHeader, usize, i64)>,
}

async fn look_at_network(findings: &mut Findings, node: Node, seconds: u64, expected: &[Job]) {
    let mut seen = Seen::default();
    match watch(&node, &mut seen, Duration::from_secs(seconds)).await {
        Ok(()) => {
            tell_presence(findings, &seen, expected);
            tell_answers(findings, &node, &seen).await;
            tell_healths(findings, &seen);
            tell_cameras(findings, &seen, seconds);
            tell_landing(findings, &seen);
        }
        Err(problem) => findings.wrong("network", format!("{problem:#}"), "start it again"),
    }
    node.close().await;
}

async fn watch(node: &Node, seen: &mut Seen, duration: Duration) -> anyhow::Result<()> {
    seen.everybody = node.everybody().await?;
    let (healths, cameras, statuses) = tokio::try_join!(
        node.subscriber(topic::HEALTH, &[]),
        node.subscriber(topic::CAMERA_INFO, &[]),
        node.subscriber(topic::STATUS, &[]),
    )?;
    // As pictures, as they cross every link; the camera makes them while somebody looks.
    let frames = node.frame_subscriber(topic::JPEG, &[]).await?;
    let watching = async {
        loop {
            tokio::select! {
                Some(health) = healths.next() => keep(&mut seen.healths, health, |a, b| {
                    (&a.service, &a.instance) == (&b.service, &b.instance)
                }),
                Some(camera) = cameras.next() => {
                    keep(&mut seen.cameras, camera, |a, b| a.camera == b.camera);
                }
                Some(status) = statuses.next() => seen.status = Some(status),
                Some(frame) = frames.next() => {
                    let bytes = frame.bytes().len();
                    seen.frames.push((frame.header, bytes, now_ns()));
                }
            }
        }
    };
    let _: Result<(), _> = timeout(duration, watching).await;
    // Who was late to be met.
    seen.everybody.extend(node.everybody().await?);
    seen.everybody.sort();
    seen.everybody.dedup();
    Ok(())
}

/// Keeps the newest of its kind.
fn keep<T>(kept: &mut Vec<T>, new: T, same: impl Fn(&T, &T) -> bool) {
    match kept.iter_mut().find(|old| same(old, &new)) {
        Some(old) => *old = new,
        None => kept.push(new),
    }
}

fn tell_presence(findings: &mut Findings, seen: &Seen, expected: &[Job]) {
    if seen.everybody.is_empty() {
        findings.wrong(
            "services",
            "nobody is to be seen".to_owned(),
            "start them (`alight up`), and compare the vehicle's name and the address on both sides",
        );
        return;
    }
    for job in expected {
        let Some(service) = job.service else { continue };
        if !seen.everybody.iter().any(|(alive, _)| alive == service.name()) {
            findings.wrong(
                "services",
                format!("no {} is ready, and this machine should run one", service.name()),
                "look at what `alight up` says about it",
            );
        }
    }
    if !seen.everybody.iter().any(|(service, _)| service == "controller") {
        findings.doubtful(
            "services",
            "there is no controller, so nothing is going to land".to_owned(),
            "on the drone: `alight up drone`",
        );
    }
}

async fn tell_answers(findings: &mut Findings, node: &Node, seen: &Seen) {
    let mut questions = tokio::task::JoinSet::new();
    for (service, instance) in seen.everybody.iter().filter(|(service, _)| service != "alight") {
        let (node, service, instance) = (node.clone(), service.clone(), instance.clone());
        questions.spawn(async move {
            let mut times = Vec::new();
            for _ in 0..QUESTIONS {
                times.extend(node.round_trip(&service, &instance, ANSWER_PATIENCE).await);
            }
            times.sort_unstable();
            (service, instance, times)
        });
    }
    let mut answers = questions.join_all().await;
    answers.sort();
    for (service, instance, times) in &answers {
        let health = seen
            .healths
            .iter()
            .find(|health| (&health.service, &health.instance) == (service, instance));
        let who = match health {
            Some(health) => {
                format!("{service} `{instance}` on {} (alight {})", health.host, health.version)
            }
            None => format!("{service} `{instance}`"),
        };
        let lost = QUESTIONS as usize - times.len().min(QUESTIONS as usize);
        let Some(median) = times.get(times.len() / 2) else {
            findings.wrong(
                "services",
                format!("{who} is there and does not answer"),
                "it is of another version, it hangs, or the link does; look at its log",
            );
            continue;
        };
        let took = format!("{who} answers in {:.1} ms", median.as_secs_f64() * 1e3);
        match lost {
            0 => findings.good("services", took),
            _ => findings.doubtful(
                "link",
                format!("{took}; {lost} of {QUESTIONS} questions were lost"),
                "come nearer, or take a channel with less traffic",
            ),
        }
    }
}

fn tell_healths(findings: &mut Findings, seen: &Seen) {
    for health in &seen.healths {
        let who = format!("{} `{}`", health.service, health.instance);
        if health.version != env!("CARGO_PKG_VERSION") {
            findings.wrong(
                "versions",
                format!(
                    "{who} is alight {}, this is {}",
                    health.version,
                    env!("CARGO_PKG_VERSION")
                ),
                "install the same version on all machines",
            );
        }
        let troubles: Vec<_> =
            health.errors.iter().map(|e| format!("{} ({} times)", e.reason, e.count)).collect();
        if !troubles.is_empty() {
            findings.doubtful(
                "services",
                format!("{who} counted errors since its start: {}", troubles.join(", ")),
                "its log says more about the first of each kind",
            );
        }
    }
}

fn tell_cameras(findings: &mut Findings, seen: &Seen, seconds: u64) {
    for info in &seen.cameras {
        let camera = &info.camera;
        let Some([fx, fy]) = info.focal_px else {
            findings.doubtful(
                "calibration",
                format!(
                    "camera `{camera}` is not calibrated, so nothing can tell how far a marker is"
                ),
                "calibrate it, and set `calibration.file` of camera-pub",
            );
            continue;
        };
        let problem = implausible(info, [fx, fy]);
        match problem {
            Some(problem) => findings.wrong(
                "calibration",
                format!("camera `{camera}`: {problem}"),
                "is the calibration of this camera, at this resolution?",
            ),
            None => findings.good(
                "calibration",
                format!(
                    "camera `{camera}`: {} x {} pixels, f = {fx:.0} px",
                    info.width, info.height
                ),
            ),
        }
    }
    let clocks: Vec<_> = seen.healths.iter().filter(|h| h.service == "controller").collect();
    let mut names: Vec<&str> = seen.frames.iter().map(|(h, ..)| h.camera.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    for camera in names {
        let frames: Vec<_> = seen.frames.iter().filter(|(h, ..)| h.camera == camera).collect();
        findings.good("camera", frames_in_words(camera, &frames, seconds));
        if let Some((header, ..)) = frames.first()
            && let Some(controller) = clocks.iter().find(|health| health.clock != header.clock)
        {
            findings.wrong(
                "clock",
                format!(
                    "camera `{camera}` stamps with {}, the controller has {}, so it uses no frame",
                    header.clock, controller.clock
                ),
                "camera and controller belong on one machine",
            );
        }
    }
    if seen.frames.is_empty() && !seen.everybody.is_empty() {
        findings.doubtful(
            "camera",
            format!("no picture arrived within {seconds} s"),
            "is a camera-pub running, and does the link carry its pictures?",
        );
    }
}

fn implausible(info: &CameraInfo, focal_px: [f64; 2]) -> Option<String> {
    let (width, height) = (f64::from(info.width), f64::from(info.height));
    let [fx, fy] = focal_px;
    if !(0.2 * width..=20.0 * width).contains(&fx) || !(0.7..=1.4).contains(&(fy / fx)) {
        return Some(format!(
            "f = {fx:.0}, {fy:.0} px for {width} x {height} pixels is not plausible"
        ));
    }
    let [cx, cy] = info.principal_px;
    let off = ((cx - width / 2.0) / width).abs().max(((cy - height / 2.0) / height).abs());
    (off > 0.2).then(|| {
        format!("the principal point ({cx:.0}, {cy:.0}) is far from the middle of {width} x {height} pixels")
    })
}

fn frames_in_words(camera: &str, frames: &[&(FrameHeader, usize, i64)], seconds: u64) -> String {
    let rate_hz = frames.len() as f64 / seconds as f64;
    let bytes: usize = frames.iter().map(|(_, bytes, _)| bytes).sum();
    let megabits_s = bytes as f64 * 8e-6 / seconds as f64;
    let mut words =
        format!("camera `{camera}`: {rate_hz:.1} pictures a second, {megabits_s:.2} Mbit/s");
    let mut ages: Vec<i64> = frames
        .iter()
        .filter(|(header, ..)| header.clock == clock_name())
        .map(|(header, _, now_ns)| now_ns - header.stamp_ns)
        .collect();
    ages.sort_unstable();
    match ages.get(ages.len() / 2) {
        Some(median) => {
            let _ = write!(words, ", {:.0} ms old on arrival", *median as f64 * 1e-6);
        }
        None => words.push_str(", their age is told by the drone's clock only"),
    }
    words
}

fn tell_landing(findings: &mut Findings, seen: &Seen) {
    let Some(status) = &seen.status else { return };
    let words = format!("{} ({}); autopilot: {}", status.phase, status.why, status.autopilot);
    findings.good("controller", words);
    match &status.active_detector {
        Some(detector) => findings.good("detector", format!("`{detector}` is in use")),
        None => findings.doubtful(
            "detector",
            "the controller uses none".to_owned(),
            "is one running, and does it get frames?",
        ),
    }
}
