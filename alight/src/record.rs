//! `alight record`: runs the recorder, or repairs a file whose recorder was killed.

use std::fs::Permissions;
use std::io::BufWriter;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, ensure};
use clap::Args;

use crate::args::{ServiceArgs, address};
use crate::ending::recording;
use crate::services::{self, Service};
use crate::terminal::print;

/// The priority of a recorder relative to the processes of the flight (nice value).
const NICENESS: i32 = 5;

/// The meaning of the exit status of a recorder.
const EXIT_STATUS: &str = "Exit status of a recorder: 1 also when messages that came are in no file, or a file lacks its end, although it continues \
                           recording then; frames that never came to it are counted and are no loss of its.";

/// The arguments of a recorder.
#[derive(Args, Clone)]
#[command(after_help = EXIT_STATUS)]
pub(crate) struct RecordArgs {
    /// The recording, an MCAP file: short for `--set file=FILE`. With `--repair`: the repaired copy [default:
    /// NAME-repaired.mcap in its folder].
    #[arg(short, long, value_name = "FILE.mcap", value_parser = recording)]
    output: Option<PathBuf>,
    /// Let Foxglove and Lichtblick follow the flight at this address, such as 127.0.0.1:8765 (`docs/recording.md`): short for
    /// `--set serve=IP:PORT`. Beyond this machine it needs `--insecure`: anyone in reach can then follow.
    #[arg(long, value_name = "IP:PORT", value_parser = address)]
    serve: Option<SocketAddr>,
    /// Only serve, and write no file: short for `--set file=`.
    #[arg(long, requires = "serve", conflicts_with = "output")]
    no_file: bool,
    /// End a recording properly whose recorder was killed, or save the readable part of a damaged one, as a copy, which states what is
    /// lost. Exit status 0 when it was complete, 1 when something is missing, also from before an earlier repair.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["config", "set", "serve"])]
    repair: Option<PathBuf>,
    #[command(flatten)]
    service: ServiceArgs,
}

/// Records, or repairs.
pub(crate) fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    if let Some(file) = &args.repair {
        return repair(file, args.output.as_deref());
    }
    // Behind the flight: a recorder may be late, the others may not.
    let _ = rustix::process::nice(NICENESS);
    let mut service = args.service.clone();
    service.set.extend(args.output.as_deref().map(file_setting));
    if args.no_file {
        service.set.push(file_setting(Path::new("")));
    }
    service.set.extend(args.serve.map(|address| format!("serve=\"{address}\"")));
    if service.network.network().insecure {
        service.set.push("insecure=true".to_owned());
    }
    services::run(Service::Recorder, &service)
}

/// The setting of a recorder's file.
pub(crate) fn file_setting(file: &Path) -> String {
    format!("file={}", toml::Value::from(&*file.to_string_lossy()))
}

fn repair(file: &Path, output: Option<&Path>) -> anyhow::Result<ExitCode> {
    let recording = std::fs::read(file).with_context(|| format!("reading {file:?}"))?;
    let found = flightlog::repair(&recording, std::io::sink())
        .with_context(|| format!("{file:?} is no recording (MCAP file) that could be repaired"))?;
    let name = file.display();
    for damage in &found.earlier {
        print(&format!("{name}: {damage}"))?;
    }
    if found.damage.is_empty() && !found.earlier.is_empty() {
        let messages = found.messages;
        print(&format!("{name} is a repaired copy, and no more is lost: {messages} messages"))?;
        return Ok(ExitCode::FAILURE);
    }
    if found.damage.is_empty() {
        print(&format!("{name} is whole: {} messages", found.messages))?;
        return Ok(ExitCode::SUCCESS);
    }
    let stem = file.file_stem().unwrap_or_default().to_string_lossy();
    let default = file.with_file_name(format!("{stem}-repaired.mcap"));
    let output = output.unwrap_or(&default);
    let doing = || format!("writing {output:?}; name another file with `-o`");
    ensure!(!output.exists(), "{output:?} is there already; name another file with `-o`");
    let found = write_repaired(&recording, output).with_context(doing)?;
    for damage in &found.damage {
        print(&format!("{name}: {damage}"))?;
    }
    print(&format!(
        "{}: {} messages in {} chunks",
        output.display(),
        found.messages,
        found.chunks
    ))?;
    Ok(ExitCode::FAILURE)
}

/// Writes the repaired copy, which is there once it is complete: a copy that a full disk cuts short is removed.
fn write_repaired(recording: &[u8], output: &Path) -> anyhow::Result<flightlog::Repaired> {
    let part = tempfile::Builder::new()
        .prefix(".")
        .suffix(".new")
        .permissions(Permissions::from_mode(0o666))
        .tempfile_in(media::folder_of(output))?;
    let mut buffered = BufWriter::new(part);
    let found = flightlog::repair(recording, &mut buffered)?;
    let part = buffered.into_inner().map_err(std::io::IntoInnerError::into_error)?;
    part.as_file().sync_all()?;
    part.persist_noclobber(output)?;
    Ok(found)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_repaired_copy_is_not_called_whole() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("flight.mcap");
        let mut recording = Vec::new();
        let about = flightlog::About::default();
        flightlog::Writer::new(&mut recording, &about).unwrap().finish().unwrap();
        std::fs::write(&file, &recording).unwrap();
        let status = |file: &Path| format!("{:?}", repair(file, None).unwrap());
        let [success, failure] = [ExitCode::SUCCESS, ExitCode::FAILURE].map(|it| format!("{it:?}"));
        assert_eq!(status(&file), success);
        std::fs::write(&file, &recording[..recording.len() / 3]).unwrap();
        assert_eq!(status(&file), failure);
        assert_eq!(status(&folder.path().join("flight-repaired.mcap")), failure);
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2, "a copy of the copy");
    }

    #[test]
    fn an_incomplete_copy_is_not_left() {
        let folder = tempfile::tempdir().unwrap();
        let copy = folder.path().join("flight-repaired.mcap");
        assert!(write_repaired(b"no recording", &copy).is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }
}
