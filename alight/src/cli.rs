//! The command line of `alight`: the list of subcommands, the call of the one that is given, `alight config`, and the exit status of an
//! error.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use node::{ConfigError, Layers};

use crate::args::{NetworkArgs, ServiceArgs, WrongUse};
use crate::services::{self, Service};
use crate::terminal::{print, write_error};
use crate::{
    calibrate, command, dashboard, detect, detectors, doctor, experiment, keys, land, marker,
    record, rectify, relay, replay, report, swap, up,
};

/// Exit status for an invalid command line or configuration.
const WRONG_USE: u8 = 2;

/// The rule for the exit status of all subcommands.
const EXIT_STATUS: &str = "Exit status: 0 done; 1 not done, or done with losses (not landed, not verified, something lost, damaged or unreadable, as data that \
                           are not there, a recording, an image or results: what is printed says what); 2 wrong use: a command line, a setting or a \
                           configuration that cannot be, as a configuration file, calibration or pad that is not there. An experiment that a signal cuts \
                           short ends with that of the signal: 130 by Ctrl-C, 143 by SIGTERM, 129 by the end of its terminal.";

/// The version with the commit, of the build script.
pub(crate) const VERSION: &str = env!("ALIGHT_VERSION");

/// Lands a UAV on a printed marker. Without a subcommand: `alight land`.
#[derive(Parser)]
#[command(version = VERSION, args_conflicts_with_subcommands = true, after_help = EXIT_STATUS)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    land: land::LandArgs,
}

#[derive(Subcommand)]
#[expect(clippy::enum_variant_names, reason = "`command` is the name of the subcommand")]
enum Command {
    /// Land: start all services as processes, show the landing, print the result.
    Land(land::LandArgs),
    /// Start the processes of this machine, and restart them when they end, until Ctrl-C.
    Up(up::UpArgs),
    /// Publish frames of a camera: a device, a program, a stream or image files.
    CameraPub(ServiceArgs),
    /// Find markers in frames.
    Detector(ServiceArgs),
    /// Land the vehicle on the detected marker.
    Controller(ServiceArgs),
    /// Talk to the ground station.
    GcsBridge(ServiceArgs),
    /// Record all topics to a file, or end a file properly whose recorder was killed.
    #[command(alias = "recorder")]
    Record(record::RecordArgs),
    /// Fly a recorded flight again, from the events that the controller handled: verify it to the bit, or try other
    /// settings on it.
    Replay(replay::ReplayArgs),
    /// Explain a recorded flight on one page, or two side by side.
    Report(report::ReportArgs),
    /// Show the landing in a browser, or make a token for one.
    Dashboard(dashboard::DashboardArgs),
    /// Simulate a world with wind, a pad, a vehicle, an autopilot and a camera.
    Simulator(ServiceArgs),
    /// Relay messages between the processes on the drone and the ground.
    Relay(relay::RelayArgs),
    /// Make keys: only their holders can connect, each with the access rights of its role.
    Keys(keys::KeysArgs),
    /// Check this machine, its keys, cameras and links for problems.
    Doctor(doctor::DoctorArgs),
    /// List the cameras of this machine, or take a picture.
    Cameras(crate::cameras::CamerasArgs),
    /// Find markers in image files and videos: id, centre, largest extent in pixels (of a square its diagonal), confidence, pose.
    Detect(detect::DetectArgs),
    /// Calibrate a camera: print a board, and make a calibration file from images of it.
    Calibrate(Box<calibrate::CalibrateArgs>),
    /// Take the distortion of the lens out of images.
    Rectify(rectify::RectifyArgs),
    /// Make a marker to print.
    Marker(marker::MarkerArgs),
    /// Repeat the thesis' experiments.
    Experiment(experiment::ExperimentArgs),
    /// Print the effective configuration of a service, or of all; or that of a Zenoh session.
    Config(ConfigArgs),
    /// Send a command to a running controller, or change a parameter of a running detector.
    Command(command::CommandArgs),
    /// List the detectors, or choose one.
    Detectors(detectors::DetectorsArgs),
    /// Replace the detector in use in flight; on any failure the old one stays in use.
    Swap(swap::SwapArgs),
}

#[derive(Args)]
struct ConfigArgs {
    /// The service [default: all].
    #[arg(value_enum)]
    service: Option<Service>,
    /// Settings over the defaults (TOML).
    #[arg(long, value_name = "FILE", requires = "service")]
    config: Option<PathBuf>,
    /// One setting over the file. May be repeated.
    #[arg(long, value_name = "KEY=VALUE", requires = "service")]
    set: Vec<String>,
    /// Print, as JSON, the session configuration for a Zenoh program of your own in the network of the options below. ROLE (of a detector:
    /// `detector.NAME`) is the role whose key the program uses, if the network has keys.
    #[arg(long, value_name = "ROLE", conflicts_with = "service", value_parser = keys::key_name_of)]
    session: Option<String>,
    #[command(flatten)]
    network: NetworkArgs,
}

/// Runs the subcommand; errors go to standard error.
pub(crate) fn run() -> ExitCode {
    let mut command = with_negative_numbers(Cli::command());
    let cli = Cli::from_arg_matches(&command.get_matches_mut())
        .unwrap_or_else(|problem| problem.format(&mut command).exit());
    perform(cli).unwrap_or_else(|problem| {
        write_error(&format!("alight: {problem:#}"));
        ExitCode::from(if is_wrong_use(&problem) { WRONG_USE } else { 1 })
    })
}

fn perform(cli: Cli) -> anyhow::Result<ExitCode> {
    match cli.command.unwrap_or(Command::Land(cli.land)) {
        Command::Land(args) => land::run(&args),
        Command::Up(args) => up::run(&args),
        Command::CameraPub(args) => services::run(Service::CameraPub, &args),
        Command::Detector(args) => services::run(Service::Detector, &args),
        Command::Controller(args) => services::run(Service::Controller, &args),
        Command::GcsBridge(args) => services::run(Service::GcsBridge, &args),
        Command::Record(args) => record::run(&args),
        Command::Replay(args) => replay::run(&args),
        Command::Report(args) => report::run(&args),
        Command::Dashboard(args) => dashboard::run(&args),
        Command::Simulator(args) => services::run(Service::Simulator, &args),
        Command::Relay(args) => relay::run(&args),
        Command::Keys(args) => keys::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Cameras(args) => crate::cameras::run(&args),
        Command::Detect(args) => detect::run(&args),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Rectify(args) => rectify::run(&args),
        Command::Marker(args) => marker::run(&args),
        Command::Experiment(args) => experiment::run(args),
        Command::Config(args) => print_config(args),
        Command::Command(args) => command::run(&args),
        Command::Detectors(args) => detectors::run(args),
        Command::Swap(args) => swap::run(&args),
    }
}

/// A command whose options take a negative number as a value, and report the error of an invalid one. Otherwise it is reported as an
/// unknown option.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    let takes_one =
        |argument: &clap::Arg| !argument.is_positional() && argument.get_action().takes_values();
    command
        .mut_args(|argument| match takes_one(&argument) {
            true => argument.allow_negative_numbers(true),
            false => argument,
        })
        .mut_subcommands(with_negative_numbers)
}

/// Whether an error is due to the command line or the configuration.
fn is_wrong_use(problem: &anyhow::Error) -> bool {
    problem.is::<WrongUse>()
        || problem.is::<ConfigError>()
        || problem.is::<clap::Error>()
        || problem.is::<controller::KeyFileError>()
        || problem.is::<fiducial::DetectorError>()
        || problem.is::<markers::PadError>()
        || problem.is::<markers::BoardError>()
        || problem.is::<media::CalibrationError>()
        || problem.is::<media::CalibrationWriteError>()
        || problem.is::<marker::SheetError>()
        || problem.is::<::replay::WrongDetector>()
}

fn print_config(args: ConfigArgs) -> anyhow::Result<ExitCode> {
    if let Some(role) = &args.session {
        print(&format!("{:#}", args.network.session(role)?))?;
        return Ok(ExitCode::SUCCESS);
    }
    let layers = Layers { file: args.config, set: args.set };
    let is_chosen = |s: &Service| args.service.is_none_or(|service| service == *s);
    for service in Service::value_variants().iter().copied().filter(is_chosen) {
        let table = service.effective_config(&layers)?;
        print(&format!("# {}\n{table}", service.name()))?;
    }
    Ok(ExitCode::SUCCESS)
}

#[cfg(test)]
mod tests {
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;
    use std::path::Path;

    use super::*;

    #[test]
    fn a_negative_number_is_reported_with_its_option() {
        for (command, value) in [("landing", "-3"), ("landing", "-3,5"), ("faults", "-3,5")] {
            let arguments = ["alight", "experiment", command, "--wind", value];
            let problem = with_negative_numbers(Cli::command()).try_get_matches_from(arguments);
            let error = problem.unwrap_err().to_string();
            assert!(
                error.contains("invalid value '-3") && error.contains("for '--wind"),
                "{error}"
            );
        }
    }

    #[test]
    fn an_invalid_number_is_reported_with_its_range() {
        let seed = "write a whole number from 0 to 18446744073709551615";
        for (words, range) in [
            (&["land", "--seed", "-1"][..], seed),
            (&["experiment", "landing", "--seed", "1.5"], seed),
            (&["experiment", "markers", "--seed", "99999999999999999999"], seed),
            (&["experiment", "faults", "--seed", "x"], seed),
            (&["experiment", "landing", "--flights", "-1"], "from 1 to 1000000"),
            (&["experiment", "faults", "--flights", "0"], "from 1 to 1000000"),
            (&["experiment", "landing", "--recordings", "-2"], "from 0 to 1000000"),
            (&["experiment", "landing", "--jobs", "0"], "from 1 to 1024"),
            (&["experiment", "faults", "--jobs", "-1"], "from 1 to 1024"),
            (&["swap", "--to", "x", "--ready-s", "18446744073709551615"], "from 0 to 86400"),
            (&["doctor", "--seconds", "-1"], "from 1 to 60"),
            (&["report", "a.mcap", "--landing", "0"], "from 1 to 1000000"),
        ] {
            let arguments = ["alight"].iter().chain(words);
            let problem = with_negative_numbers(Cli::command()).try_get_matches_from(arguments);
            let problem = problem.unwrap_err().to_string();
            assert!(problem.contains(range), "{words:?}: {problem}");
        }
    }

    #[test]
    fn a_calibration_that_is_not_there_is_a_wrong_use_and_missing_data_are_none() {
        let folder = tempfile::tempdir().unwrap();
        let missing = folder.path().join("nosuch").display().to_string();
        let camera = ["detect", "--marker", "rings:0.2", "--camera", &missing, "a.png"];
        assert!(is_wrong_use(&performed(&camera).unwrap_err()));
        let compare = ["experiment", "compare", &missing, &missing];
        assert!(!is_wrong_use(&performed(&compare).unwrap_err()));
        assert_eq!(
            performed(&["detect", "--marker", "rings", &missing]).unwrap(),
            ExitCode::FAILURE
        );
    }

    /// Runs the command of a command line.
    fn performed(words: &[&str]) -> anyhow::Result<ExitCode> {
        perform(Cli::try_parse_from(["alight"].iter().chain(words)).unwrap())
    }

    #[test]
    fn an_impossible_request_is_a_wrong_use() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).display().to_string();
        for words in [
            &["land", "--vehicle", "a/b"][..],
            &["land", "--zenoh", "nosuch.json5"],
            &["detectors", "--vehicle", "a/b"],
            &["command", "hold", "--zenoh", "nosuch.json5"],
            &["calibrate", "board", "--live", "down", "--zenoh", "ground"],
            &["config", "--session", "operator", "--zenoh", "nosuch.json5"],
            &["relay", "--zenoh", "relay"],
            &["replay", "nosuch.mcap", "--detector", "main"],
            &["replay", "nosuch.mcap", "--verify", "--from", "frames"],
            &["replay", "nosuch.mcap", "--verify", "--from", "detections"],
            &["report", "nosuch.mcap", "--format", "pdf", "-o", "x.html"],
            &["keys", "issue", "--role", "drone", "-o", &path("keys")],
            &["keys", "issue", "--role", "operator", "--name", "a/b", "-o", &path("keys")],
            &["dashboard", "certificate", "-o", &path("x.key")],
            &["dashboard", "certificate", "-o", &path("x.pem"), "--address", "x:80"],
            &["experiment", "faults", "--kind", "bridge-killed"],
            &["experiment", "faults", "--with", "foo"],
            &["experiment", "faults", "--set", "simulator.seed=3"],
            &["experiment", "faults", "--height", "30"],
            &["experiment", "landing", "--wind", "0,25"],
            &["experiment", "landing", "--fault", "glare"],
            &["experiment", "landing", "--set", "simulator.seed=3"],
            &["experiment", "markers", "--binned"],
        ] {
            let problem = performed(words).unwrap_err();
            assert!(is_wrong_use(&problem), "{words:?}: {problem:#}");
        }
        // Before anything is done.
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn an_invalid_network_is_a_wrong_use_of_every_service() {
        for service in Service::value_variants() {
            for network in [["--zenoh", "nosuch.json5"], ["--vehicle", "a/b"]] {
                let problem = performed(&[&[service.name()][..], &network].concat()).unwrap_err();
                assert!(is_wrong_use(&problem), "{}, {network:?}: {problem:#}", service.name());
            }
        }
    }

    #[test]
    fn a_signing_key_that_cannot_be_used_is_a_wrong_use_of_a_service() {
        let folder = tempfile::tempdir().unwrap();
        let (missing, open) = (folder.path().join("missing"), folder.path().join("open"));
        std::fs::write(&open, "correct horse battery").unwrap();
        std::fs::set_permissions(&open, Permissions::from_mode(0o644)).unwrap();
        let udp = "udpin:127.0.0.1:0";
        for (service, address, key) in [
            ("gcs-bridge", "ground", "signing_key"),
            ("controller", "autopilot.address", "autopilot.signing_key"),
        ] {
            for (file, reason) in [(&missing, "No such file"), (&open, "is open to other users")] {
                let ([port], _, _) = testing::ports::free().unwrap();
                let port = port.to_string();
                let address = format!("{address}={udp}");
                let key = format!("{key}={}", file.display());
                let words = [service, "--meet", &port, "--set", &address, "--set", &key];
                let problem = performed(&words).unwrap_err();
                let text = format!("{problem:#}");
                assert!(is_wrong_use(&problem), "{text}");
                assert_eq!(text.matches(reason).count(), 1, "{text}");
            }
        }
    }

    #[test]
    fn an_invalid_site_is_a_wrong_use() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("site.toml");
        let detector = "{ run = 'detector' }";
        for (role, site) in [
            ("local", "vehicle = 'x'".to_owned()),
            ("local", "vehicle = 'a/b'\nlocal = [{ command = ['true'] }]".to_owned()),
            ("local", format!("local = [{detector}, {detector}]")),
            ("local", "local = [{ name = 'x' }]".to_owned()),
            ("local", "local = [{ command = ['true'], set = ['x=1'] }]".to_owned()),
            ("ground", format!("ground = [{detector}]")),
            ("drone", "address = '10.0.0.1:x'\ninsecure = true".to_owned()),
            ("drone", "address = 'fd00::1'\nkeys = 'keys'".to_owned()),
        ] {
            std::fs::write(&path, &site).unwrap();
            let words = ["up", role, "--dry-run", "--config", path.to_str().unwrap()];
            let problem = performed(&words).unwrap_err();
            assert!(is_wrong_use(&problem), "{site}: {problem:#}");
        }
    }

    #[test]
    fn an_error_of_a_recording_is_no_wrong_use() {
        for words in [&["replay", "nosuch.mcap", "--verify"][..], &["report", "nosuch.mcap"]] {
            let problem = performed(words).unwrap_err();
            assert!(!is_wrong_use(&problem), "{words:?}: {problem:#}");
        }
    }

    #[test]
    fn the_help_explains_the_exit_status_and_that_of_a_landing() {
        let mut command = Cli::command();
        let help = command.render_long_help().to_string();
        assert!(help.contains("Exit status: 0 done; 1 not done"), "{help}");
        let land = command.find_subcommand_mut("land").unwrap().render_long_help().to_string();
        assert!(land.contains("Exit status of a landing"), "{land}");
    }

    #[test]
    fn the_version_contains_the_commit_of_the_repository_in_which_it_is_built() {
        let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let arguments = ["show", "--no-patch", "--format=%h, %cs", "--abbrev=9", "HEAD"];
        let mut git = std::process::Command::new("git");
        git.args(["-c", "log.showSignature=false", "-C"]).arg(&root).args(arguments);
        let git = git.output();
        let commit = git.ok().filter(|it| root.join(".git").exists() && it.status.success());
        let release = env!("CARGO_PKG_VERSION");
        let Some(commit) = commit else {
            assert_eq!(VERSION, release);
            return;
        };
        let commit = String::from_utf8(commit.stdout).unwrap();
        let expected = format!("{release} ({}", commit.trim());
        let rest = VERSION.strip_prefix(expected.as_str());
        assert!(matches!(rest, Some(")" | ", changed)")), "{VERSION}, and not {expected})");
    }
}
