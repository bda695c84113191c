//! `alight dashboard`: the page, and the tokens for those who open it from elsewhere.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::Context;
use clap::{Args, Subcommand, ValueEnum};
use dashboard::tokens::{Kind, Tokens, secret, usual_file};
use node::Layers;

use crate::args::ServiceArgs;
use crate::services::{self, Service};
use crate::terminal::{print, write_error};

/// How far a page stands back when the processor is short.
const NICENESS: i32 = 5;
const DAY_S: u64 = 86_400;

/// The arguments of a page.
#[derive(Args)]
#[command(args_conflicts_with_subcommands = true)]
pub(crate) struct DashboardArgs {
    #[command(subcommand)]
    action: Option<Action>,
    #[command(flatten)]
    service: ServiceArgs,
}

#[derive(Subcommand)]
enum Action {
    /// Print a token that opens the page from another machine. It is shown once, and kept as a hash.
    Token {
        /// What its holder may do.
        #[arg(long, value_enum, default_value_t)]
        kind: TokenKind,
        /// Days until it ends.
        #[arg(long, value_name = "DAYS", default_value_t = 30, value_parser = clap::value_parser!(u32).range(1..=3650))]
        days: u32,
        /// The configuration of the dashboard (TOML), where it names a file of tokens.
        #[arg(long, value_name = "FILE")]
        config: Option<PathBuf>,
        /// One setting over the file. May be repeated.
        #[arg(long, value_name = "KEY=VALUE")]
        set: Vec<String>,
    },
}

/// What the holder of a token may do.
#[derive(Clone, Copy, Debug, Default, ValueEnum)]
enum TokenKind {
    /// Look.
    #[default]
    Monitor,
    /// Command as well, on the machine of the dashboard where it says `commands = "token"`.
    Command,
}

/// Serves the page, or makes a token.
pub(crate) fn run(args: &DashboardArgs) -> anyhow::Result<ExitCode> {
    let Some(Action::Token { kind, days, config, set }) = &args.action else {
        // Behind the flight: a page may be late, the others may not.
        let _ = rustix::process::nice(NICENESS);
        return services::run(Service::Dashboard, &args.service);
    };
    let layers = Layers { file: config.clone(), set: set.clone() };
    let named = layers.load::<dashboard::Config>()?.settings.tokens;
    let file = if named.as_os_str().is_empty() { usual_file()? } else { named };
    let kind = match kind {
        TokenKind::Monitor => Kind::Monitor,
        TokenKind::Command => Kind::Command,
    };
    let now_s =
        SystemTime::now().duration_since(UNIX_EPOCH).context("the system's time")?.as_secs();
    let token = secret()?;
    let mut tokens = Tokens::read(&file)?;
    tokens.add(&token, kind, now_s, now_s + DAY_S * u64::from(*days));
    tokens.write(&file)?;
    write_error(&format!(
        "A token of the kind `{kind}` for {days} days; its hash is in {}",
        file.display()
    ));
    print(&token)?;
    Ok(ExitCode::SUCCESS)
}
