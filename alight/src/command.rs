//! `alight command`: commands to a running controller or detector.

use std::process::ExitCode;

use clap::{Args, ValueEnum};
use messages::{CommandReply, ControllerCommand, DetectorCommand, Message, Topic, topic};
use node::ConfigError;
use serde::Serialize;

use crate::args::{Format, NetworkArgs};
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
    /// Format of the reply: text, or one JSON object (`accepted`, `by`, `reason`; `accepted` is null without a reply).
    #[arg(long, value_enum, default_value_t)]
    format: Format,
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
            let sending = Sending { network: &args.network, tool: "command", format: args.format };
            return sending.send(topic::DETECTOR_COMMAND, &[id], &command);
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
    Sending { network: &args.network, tool: "command", format: args.format }
        .send_to_controller(&command)
}

fn conflict(problem: &str) -> anyhow::Error {
    clap::Error::raw(clap::error::ErrorKind::ArgumentConflict, problem).into()
}

/// How a tool sends a command and prints the reply.
pub(crate) struct Sending<'a> {
    pub(crate) network: &'a NetworkArgs,
    /// The tool's name.
    pub(crate) tool: &'static str,
    pub(crate) format: Format,
}

/// A reply for programs.
#[derive(Debug, PartialEq, Eq, Serialize)]
struct Reply {
    /// `None` without a reply: the command may have been carried out, unless the reason excludes that.
    accepted: Option<bool>,
    /// The service that replied, and its name where there may be several: `controller`, `detector/main`.
    by: Option<String>,
    reason: String,
}

impl Reply {
    fn new(by: &str, result: &anyhow::Result<CommandReply>) -> Self {
        match result {
            Ok(reply) => Self {
                accepted: Some(reply.accepted),
                by: Some(by.to_owned()),
                reason: reply.reason.clone(),
            },
            Err(problem) => Self { accepted: None, by: None, reason: format!("{problem:#}") },
        }
    }
}

impl Sending<'_> {
    /// Sends a command to the controller and prints the reply.
    pub(crate) fn send_to_controller(
        &self,
        command: &ControllerCommand,
    ) -> anyhow::Result<ExitCode> {
        self.send(topic::COMMAND, &[], command)
    }

    fn send<M: Message>(
        &self,
        topic: Topic<M>,
        names: &[&str],
        command: &M,
    ) -> anyhow::Result<ExitCode> {
        let work = async |node: &node::Node| Ok(node.command(topic, names, command).await);
        let result = with_node(self.network, self.tool, work)?;
        let is_accepted = result.as_ref().is_ok_and(|reply| reply.accepted);
        match self.format {
            Format::Text => {
                let reply = result?;
                let verdict = if reply.accepted { "accepted" } else { "refused" };
                print(&format!("{verdict}: {}", reply.reason))?;
            }
            Format::Json => {
                let by = topic.key(names);
                let by = by.strip_suffix("/command").unwrap_or(&by);
                print(&serde_json::to_string(&Reply::new(by, &result))?)?;
            }
        }
        Ok(ExitCode::from(u8::from(!is_accepted)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reply_for_programs_has_the_service_that_replied_or_the_reason_for_none() {
        let json = |result| serde_json::to_string(&Reply::new("controller", &result)).unwrap();
        let refused = CommandReply { accepted: false, reason: "no landing".to_owned() };
        assert_eq!(
            json(Ok(refused)),
            r#"{"accepted":false,"by":"controller","reason":"no landing"}"#
        );
        let none = json(Err(anyhow::anyhow!("no controller answered")));
        assert_eq!(none, r#"{"accepted":null,"by":null,"reason":"no controller answered"}"#);
    }
}
