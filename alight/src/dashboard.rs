//! `alight dashboard`: runs the page's service, adds tokens for browsers elsewhere that may read or command, and makes the
//! page's self-signed certificate.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{SystemTime, UNIX_EPOCH};

use anyhow::{Context, ensure};
use clap::{Args, Subcommand, ValueEnum};
use dashboard::tokens::{Kind, Tokens, secret, usual_file, usual_folder};
use node::{Layers, host_name};

use crate::args::{ServiceArgs, WrongUse};
use crate::keys::self_signed;
use crate::services::{self, Service};
use crate::terminal::{print, write_error};

/// The priority of a page relative to the processes of the flight (nice value).
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
        /// The rights of its holder.
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
    /// Make a certificate for the page and its private key, with which it is encrypted. The certificate signs itself, so that
    /// a browser asks once whether to trust it: compare the fingerprint that this prints.
    Certificate {
        /// Output file; the key is written next to it with the ending `.key` [default: alight/dashboard.pem in the user's
        /// state folder].
        #[arg(short, long, value_name = "FILE.pem")]
        output: Option<PathBuf>,
        /// Address of the page, as browsers name it: an IP address or a host name. May be repeated. This machine's name and
        /// `localhost` are always in it.
        #[arg(long, value_name = "HOST")]
        address: Vec<String>,
        /// Days until it ends. Some browsers take none of more than 825.
        #[arg(long, value_name = "DAYS", default_value_t = 825, value_parser = clap::value_parser!(u32).range(1..=36_500))]
        days: u32,
    },
}

/// The rights of the holder of a token.
#[derive(Clone, Copy, Debug, Default, ValueEnum)]
enum TokenKind {
    /// Look.
    #[default]
    Monitor,
    /// Command as well, where the dashboard has `commands = "token"`: on its machine, and from elsewhere when the page has a
    /// certificate.
    Command,
}

/// Serves the page, or makes a token.
pub(crate) fn run(args: &DashboardArgs) -> anyhow::Result<ExitCode> {
    match &args.action {
        None => {
            // Behind the flight: a page may be late, the others may not.
            let _ = rustix::process::nice(NICENESS);
            services::run(Service::Dashboard, &args.service)
        }
        Some(Action::Token { kind, days, config, set }) => {
            let layers = Layers { file: config.clone(), set: set.clone() };
            add_token(*kind, *days, &layers)
        }
        Some(Action::Certificate { output, address, days }) => {
            make_certificate(output.as_deref(), address, *days)
        }
    }
}

fn make_certificate(
    output: Option<&Path>,
    addresses: &[String],
    days: u32,
) -> anyhow::Result<ExitCode> {
    let certificate = match output {
        Some(path) => path.to_owned(),
        None => usual_folder()
            .context("no folder for the certificate; name a file with `--output FILE.pem`")?
            .join("dashboard.pem"),
    };
    let key = certificate.with_extension("key");
    ensure!(
        key != certificate,
        WrongUse(format!("{certificate:?} has the ending of the key; name it `.pem`"))
    );
    let host = host_name();
    let own = ["localhost".to_owned(), "127.0.0.1".to_owned(), format!("{host}.local"), host];
    let names: BTreeSet<String> = addresses.iter().cloned().chain(own).collect();
    let names: Vec<String> = names.into_iter().collect();
    let fingerprint = self_signed([&certificate, &key], &names, days)?;
    write_error(&format!(
        "For {}, {days} days; the key: {}\nSHA-256: {fingerprint}\nTo serve it: alight dashboard --set 'certificate={:?}'",
        names.join(", "),
        key.display(),
        certificate.display().to_string(),
    ));
    print(&certificate.display().to_string())?;
    Ok(ExitCode::SUCCESS)
}

fn add_token(kind: TokenKind, days: u32, layers: &Layers) -> anyhow::Result<ExitCode> {
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
    tokens.add(&token, kind, now_s, now_s + DAY_S * u64::from(days));
    tokens.write(&file)?;
    write_error(&format!(
        "A token of the kind `{kind}` for {days} days; its hash is in {}",
        file.display()
    ));
    print(&token)?;
    Ok(ExitCode::SUCCESS)
}
