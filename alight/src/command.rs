//! `alight command`: commands to a running controller or detector.

use std::process::ExitCode;

use clap::{Args, ValueEnum};
use messages::{ControllerCommand, DetectorCommand, Message, Topic, topic};
use node::ConfigError;

use crate::args::NetworkArgs;
use crate::runtime::with_node;
use crate::terminal::print;

#[derive(Args)]
pub(crate) struct CommandArgs {
    /// The command.
    #[arg(value_enum)]
    command: OperatorCommand,
    /// For `use-detector` the detector; for `set` the parameter and its value, KEY=VALUE.
    #[arg(required_if_eq_any([("command", "use-detector"), ("command", "set")]))]
    argument: Option<String>,
    /// For `set`: the detector.
    #[arg(long, value_name = "ID", required_if_eq("command", "set"))]
    detector: Option<String>,
    #[command(flatten)]
    network: NetworkArgs,
}

#[derive(Clone, Copy, ValueEnum)]
enum OperatorCommand {
    /// Start the landing.
    Start,
    /// Stop and hover; not while the autopilot lands in LAND, as after `land-here`.
    Hold,
    /// Continue after a hold.
    Resume,
    /// Abort the landing; in LAND only above `phases.no_return_height_m` (1 m).
    Abort,
    /// Land straight down where the vehicle is, without the marker; above 1 m `abort` stops it.
    LandHere,
    /// Use a detector from now on.
    UseDetector,
    /// Change a parameter of a running detector.
    Set,
}

/// Sends the command and prints the reply.
pub(crate) fn run(args: &CommandArgs) -> anyhow::Result<ExitCode> {
    let argument = args.argument.clone().unwrap_or_default();
    let command = match (args.command, &args.detector) {
        (OperatorCommand::Set, detector) => {
            let id = detector.as_deref().unwrap_or_default();
            let (key, value) = argument
                .split_once('=')
                .ok_or_else(|| ConfigError::Form { text: argument.clone() })?;
            let (key, value) = (key.trim().to_owned(), value.trim().to_owned());
            let command = DetectorCommand::SetParameter { key, value };
            return send(&args.network, "command", topic::DETECTOR_COMMAND, &[id], &command);
        }
        (_, Some(_)) => return Err(conflict("`--detector` is for `set` only")),
        (OperatorCommand::UseDetector, None) => ControllerCommand::UseDetector(argument),
        (_, None) if !argument.is_empty() => {
            return Err(conflict("only `use-detector` and `set` take an argument"));
        }
        (OperatorCommand::Start, None) => ControllerCommand::Start,
        (OperatorCommand::Hold, None) => ControllerCommand::Hold,
        (OperatorCommand::Resume, None) => ControllerCommand::Resume,
        (OperatorCommand::Abort, None) => ControllerCommand::Abort,
        (OperatorCommand::LandHere, None) => ControllerCommand::LandHere,
    };
    send_to_controller(&args.network, "command", &command)
}

fn conflict(problem: &str) -> anyhow::Error {
    clap::Error::raw(clap::error::ErrorKind::ArgumentConflict, problem).into()
}

/// Sends a command to the controller and prints the reply.
pub(crate) fn send_to_controller(
    network: &NetworkArgs,
    tool: &str,
    command: &ControllerCommand,
) -> anyhow::Result<ExitCode> {
    send(network, tool, topic::COMMAND, &[], command)
}

fn send<M: Message>(
    network: &NetworkArgs,
    tool: &str,
    topic: Topic<M>,
    names: &[&str],
    command: &M,
) -> anyhow::Result<ExitCode> {
    let reply = with_node(network, tool, async |node| node.command(topic, names, command).await)?;
    let verdict = if reply.accepted { "accepted" } else { "refused" };
    print(&format!("{verdict}: {}", reply.reason))?;
    Ok(ExitCode::from(u8::from(!reply.accepted)))
}
