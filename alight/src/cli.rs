//! The command line.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, Parser, Subcommand, ValueEnum};
use messages::{ControllerCommand, DetectorCommand, topic};
use node::{ConfigError, Identity, Layers, Network, Node, ZenohSource};

use crate::services::{self, Service};
use crate::{detect, detectors, doctor, experiment, keys, land, marker, relay, swap, up};

/// The role whose key a person at the command line holds.
pub(crate) const OPERATOR: &str = "operator";

/// Exit status for a command line or a configuration that asks for something impossible.
const WRONG_USE: u8 = 2;

/// Lands a UAV on a printed marker. Without a subcommand: `alight land`.
#[derive(Parser)]
#[command(version, args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    land: land::LandArgs,
}

#[derive(Subcommand)]
#[expect(clippy::enum_variant_names, reason = "`command` is what a person types")]
enum Command {
    /// Land: start all services as processes, show the landing, print the result.
    Land(land::LandArgs),
    /// Start what belongs on this machine, and start it again when it ends, until Ctrl-C.
    Up(up::UpArgs),
    /// Publish frames from image files.
    CameraPub(ServiceArgs),
    /// Find markers in frames.
    Detector(ServiceArgs),
    /// Land the vehicle by what a detector finds.
    Controller(ServiceArgs),
    /// Talk to the ground station.
    GcsBridge(ServiceArgs),
    /// Simulate a world with wind, a pad, a vehicle, an autopilot and a camera.
    Simulator(ServiceArgs),
    /// Pass messages on between the drone's own processes and the ground.
    Relay(relay::RelayArgs),
    /// Make keys, so that only those who have one take part, each by its role.
    Keys(keys::KeysArgs),
    /// Say what is wrong with this machine, its keys, its cameras and its links.
    Doctor(doctor::DoctorArgs),
    /// Find markers in image files.
    Detect(detect::DetectArgs),
    /// Make a marker to print.
    Marker(marker::MarkerArgs),
    /// Run the thesis' experiments again.
    Experiment(experiment::ExperimentArgs),
    /// Print the effective configuration of a service, or of all.
    Config(ConfigArgs),
    /// Tell a running controller what to do, or change a parameter of a running detector.
    Command(CommandArgs),
    /// List the detectors, or say which one to use.
    Detectors(detectors::DetectorsArgs),
    /// Replace the detector in use by another, in flight; on any trouble the old one stays.
    Swap(swap::SwapArgs),
}

/// What every service takes.
#[derive(Args, Clone, Default)]
pub(crate) struct ServiceArgs {
    /// Settings to lay over the defaults (TOML).
    #[arg(long, value_name = "FILE")]
    pub(crate) config: Option<PathBuf>,
    /// One setting to lay over the file: dotted key, TOML value. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    #[command(flatten)]
    pub(crate) network: NetworkArgs,
    /// Stop when the process of this number, which started this one, ends.
    #[arg(long, hide = true, value_name = "PID")]
    pub(crate) stop_with_parent: Option<u32>,
}

/// Which network is joined.
#[derive(Args, Clone, Default)]
#[command(next_help_heading = "Network")]
pub(crate) struct NetworkArgs {
    /// How the processes meet: `local` (one machine), `ground`, or for the relay `drone` or `relay`; or a JSON5 file.
    /// `local` if it is left out.
    #[arg(long, value_name = "ROLE|FILE", env = "ALIGHT_ZENOH")]
    pub(crate) zenoh: Option<PathBuf>,
    /// Where the drone, or the relay to it, is: HOST or HOST:PORT.
    #[arg(long, value_name = "ADDRESS", env = "ALIGHT_CONNECT")]
    pub(crate) connect: Option<String>,
    /// Where the relay is found by others: HOST or HOST:PORT; port 7448 (7449 and 7450 for frames) of all interfaces if it
    /// is left out.
    #[arg(long, value_name = "ADDRESS", env = "ALIGHT_LISTEN")]
    pub(crate) listen: Option<String>,
    /// Where the processes of this machine meet, by `local` and `drone`; 7447 if it is left out.
    #[arg(long, value_name = "PORT", env = "ALIGHT_MEET")]
    pub(crate) meet: Option<u16>,
    /// The vehicle's name, the beginning of all keys; `drone` if it is left out.
    #[arg(long, value_name = "NAME", env = "ALIGHT_VEHICLE")]
    pub(crate) vehicle: Option<String>,
    /// The directory with the keys (`alight keys`): connections are encrypted, and each may say what its role may.
    #[arg(long, value_name = "DIRECTORY", env = "ALIGHT_KEYS")]
    pub(crate) keys: Option<PathBuf>,
}

impl NetworkArgs {
    /// The session's configuration for a process that shows the certificate of `role`.
    pub(crate) fn source(&self, role: &str) -> anyhow::Result<ZenohSource> {
        self.network().source(role)
    }

    /// The same as variables of the environment, for programs that are started.
    pub(crate) fn environment(&self) -> Vec<(&'static str, std::ffi::OsString)> {
        let path = |path: &Option<PathBuf>| path.as_ref().map(|path| path.clone().into_os_string());
        let text = |text: &Option<String>| text.as_ref().map(Into::into);
        let all = [
            ("ALIGHT_ZENOH", path(&self.zenoh)),
            ("ALIGHT_CONNECT", text(&self.connect)),
            ("ALIGHT_LISTEN", text(&self.listen)),
            ("ALIGHT_MEET", self.meet.map(|port| port.to_string().into())),
            ("ALIGHT_VEHICLE", text(&self.vehicle)),
            ("ALIGHT_KEYS", path(&self.keys)),
        ];
        all.into_iter().filter_map(|(name, value)| Some((name, value?))).collect()
    }

    pub(crate) fn network(&self) -> Network {
        let Self { zenoh, connect, listen, meet, vehicle, keys } = self.clone();
        Network { config: zenoh, vehicle, connect, listen, meet, keys }
    }
}

#[derive(Args)]
struct ConfigArgs {
    /// The service; all of them otherwise.
    #[arg(value_enum)]
    service: Option<Service>,
    /// Settings to lay over the defaults (TOML).
    #[arg(long, value_name = "FILE", requires = "service")]
    config: Option<PathBuf>,
    /// One setting to lay over the file. May be repeated.
    #[arg(long, value_name = "KEY=VALUE", requires = "service")]
    set: Vec<String>,
}

#[derive(Args)]
struct CommandArgs {
    /// What to do.
    #[arg(value_enum)]
    command: OperatorCommand,
    /// The detector, for `use-detector`; the parameter and its value, for `set`: KEY=VALUE.
    #[arg(required_if_eq_any([("command", "use-detector"), ("command", "set")]))]
    argument: Option<String>,
    /// The detector that is told, for `set`; the controller otherwise.
    #[arg(long, value_name = "ID")]
    detector: Option<String>,
    #[command(flatten)]
    network: NetworkArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum OperatorCommand {
    /// Begin to land.
    Start,
    /// Stop where it is, and wait.
    Hold,
    /// Go on after a hold.
    Resume,
    /// Give the landing up.
    Abort,
    /// Use a certain detector from now on.
    UseDetector,
    /// Change a parameter while the service runs.
    Set,
}

/// What is sent, and to whom.
enum Order {
    Controller(ControllerCommand),
    Detector { id: String, command: DetectorCommand },
}

impl Order {
    fn new(args: &CommandArgs) -> anyhow::Result<Self> {
        let argument = args.argument.clone().unwrap_or_default();
        let command = match (args.command, &args.detector) {
            (OperatorCommand::Set, Some(id)) => {
                let (key, value) = key_and_value(&argument)?;
                let command = DetectorCommand::SetParameter { key, value };
                return Ok(Self::Detector { id: id.clone(), command });
            }
            (OperatorCommand::Set, None) => {
                let (key, value) = key_and_value(&argument)?;
                ControllerCommand::SetParameter { key, value }
            }
            (_, Some(_)) => {
                return Err(wrong_command("a detector is only told to `set` a parameter"));
            }
            (OperatorCommand::UseDetector, None) => ControllerCommand::UseDetector(argument),
            (_, None) if !argument.is_empty() => {
                return Err(wrong_command("only `use-detector` and `set` take an argument"));
            }
            (OperatorCommand::Start, None) => ControllerCommand::Start,
            (OperatorCommand::Hold, None) => ControllerCommand::Hold,
            (OperatorCommand::Resume, None) => ControllerCommand::Resume,
            (OperatorCommand::Abort, None) => ControllerCommand::Abort,
        };
        Ok(Self::Controller(command))
    }
}

fn key_and_value(setting: &str) -> anyhow::Result<(String, String)> {
    let (key, value) =
        setting.split_once('=').ok_or_else(|| ConfigError::Form { text: setting.to_owned() })?;
    Ok((key.trim().to_owned(), value.trim().to_owned()))
}

fn wrong_command(problem: &str) -> anyhow::Error {
    clap::Error::raw(clap::error::ErrorKind::ArgumentConflict, problem).into()
}

/// Does what the command line asks for; errors go to standard error.
pub(crate) fn run() -> ExitCode {
    let cli = Cli::parse();
    let result = match cli.command.unwrap_or(Command::Land(cli.land)) {
        Command::Land(args) => land::run(&args),
        Command::Up(args) => up::run(&args),
        Command::CameraPub(args) => services::run(Service::CameraPub, &args),
        Command::Detector(args) => services::run(Service::Detector, &args),
        Command::Controller(args) => services::run(Service::Controller, &args),
        Command::GcsBridge(args) => services::run(Service::GcsBridge, &args),
        Command::Simulator(args) => services::run(Service::Simulator, &args),
        Command::Relay(args) => relay::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Detect(args) => detect::run(&args),
        Command::Marker(args) => marker::run(&args),
        Command::Experiment(args) => experiment::run(args),
        Command::Config(args) => print_config(args),
        Command::Command(args) => send_command(args),
        Command::Detectors(args) => detectors::run(args),
        Command::Swap(args) => swap::run(&args),
    };
    result.unwrap_or_else(|problem| {
        write_error(&format!("alight: {problem:#}"));
        ExitCode::from(if is_wrong_use(&problem) { WRONG_USE } else { 1 })
    })
}

/// True for errors that another command line or configuration would avoid.
fn is_wrong_use(problem: &anyhow::Error) -> bool {
    problem.is::<ConfigError>()
        || problem.is::<clap::Error>()
        || problem.is::<fiducial::DetectorError>()
        || problem.is::<markers::PadError>()
        || problem.is::<media::CalibrationError>()
        || problem.is::<marker::SheetError>()
}

fn print_config(args: ConfigArgs) -> anyhow::Result<ExitCode> {
    use std::io::Write;
    let layers = Layers { file: args.config, set: args.set };
    let wanted = |s: &Service| args.service.is_none_or(|service| service == *s);
    let mut out = std::io::stdout().lock();
    for service in Service::value_variants().iter().copied().filter(wanted) {
        let table = service.effective_config(&layers)?;
        match writeln!(out, "# {}\n{table}", service.name()) {
            // The reader has seen enough, as `head` does.
            Err(problem) if problem.kind() == std::io::ErrorKind::BrokenPipe => break,
            result => result?,
        }
    }
    Ok(ExitCode::SUCCESS)
}

fn send_command(args: CommandArgs) -> anyhow::Result<ExitCode> {
    use std::io::Write;
    let order = Order::new(&args)?;
    node::start_logging("warn");
    let zenoh = args.network.source(OPERATOR)?;
    let reply = services::runtime()?.block_on(async {
        let instance = format!("command-{}", std::process::id());
        let identity = Identity { service: "alight", instance };
        let node = Node::open(identity, &zenoh).await?;
        let reply = match &order {
            Order::Controller(command) => node.command(topic::COMMAND, &[], command).await,
            Order::Detector { id, command } => {
                node.command(topic::DETECTOR_COMMAND, &[id], command).await
            }
        };
        node.close().await;
        reply
    })?;
    let verdict = if reply.accepted { "accepted" } else { "refused" };
    writeln!(std::io::stdout(), "{verdict}: {}", reply.reason)?;
    Ok(ExitCode::from(u8::from(!reply.accepted)))
}

/// The session's configuration that a command line names.
pub(crate) fn zenoh_source(file: Option<PathBuf>) -> ZenohSource {
    file.map_or(ZenohSource::Local, ZenohSource::File)
}

/// Writes a line to standard error; when that is closed there is nobody left to tell.
pub(crate) fn write_error(line: &str) {
    use std::io::Write;
    drop(writeln!(std::io::stderr(), "{line}"));
}
