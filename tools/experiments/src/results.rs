//! The folder with the results of landings or faults. It is claimed before the first flight: hours of flying are neither lost to
//! a folder that cannot be written, nor mixed with the results of another run.

use std::fs::DirEntry;
use std::path::Path;

use anyhow::{Context, bail};

/// The files by which results are told.
const TELLING: [&str; 3] = ["flights.jsonl", "flights.csv", "report.md"];
/// The folder of the recordings in that of the results.
pub const RECORDINGS: &str = "recordings";

/// Makes the folder. Results of an earlier run are refused, or with `replaces` removed, with what came with them.
///
/// # Errors
/// When there are such results, or the folder cannot be made or emptied.
pub fn claim(folder: &Path, replaces: bool) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    let names = names(folder)?;
    if let Some(name) = names.iter().find(|name| is_telling(name))
        && !replaces
    {
        bail!(
            "{} has the results of an experiment already ({name}); name another folder with `-o`, or replace them with `--replace`",
            folder.display()
        );
    }
    let recordings = folder.join(RECORDINGS);
    let is_old = |name: &&String| is_telling(name) || is_figure(name);
    let old = names.iter().filter(is_old).map(|name| folder.join(name));
    let of_rows = self::names(&recordings)?.into_iter().filter(|it| is_of_a_row(it));
    for path in old.chain(of_rows.map(|name| recordings.join(name))) {
        std::fs::remove_file(&path)
            .with_context(|| format!("removing {} of an earlier run", path.display()))?;
    }
    Ok(())
}

/// Makes the folder for recordings of every flight; one that has recordings is refused.
///
/// # Errors
/// When it has some, or cannot be made.
pub fn claim_for_recordings(folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder).with_context(|| format!("making {}", folder.display()))?;
    match names(folder)?.iter().find(|name| is_recording(name)) {
        None => Ok(()),
        Some(first) => bail!(
            "{} has recordings already, such as {first}; name another folder with `--record-tapes`, or remove them",
            folder.display()
        ),
    }
}

/// The names in a folder, in their order; none when it is not there.
fn names(folder: &Path) -> anyhow::Result<Vec<String>> {
    if !folder.exists() {
        return Ok(Vec::new());
    }
    let name = |entry: std::io::Result<DirEntry>| -> std::io::Result<String> {
        Ok(entry?.file_name().to_string_lossy().into_owned())
    };
    let names = std::fs::read_dir(folder).and_then(|entries| entries.map(name).collect());
    let mut names: Vec<String> =
        names.with_context(|| format!("reading the folder {}", folder.display()))?;
    names.sort();
    Ok(names)
}

fn is_telling(name: &str) -> bool {
    TELLING.contains(&name)
}

/// Whether it is one of the thesis' figures, which an interrupted run does not draw anew.
fn is_figure(name: &str) -> bool {
    name.starts_with("figure-4-") && name.ends_with(".svg")
}

fn is_recording(name: &str) -> bool {
    name.ends_with(".mcap")
}

/// Whether it is one of the recordings that landings write of their rows.
fn is_of_a_row(name: &str) -> bool {
    name.starts_with("row-") && is_recording(name)
}

/// A sentence of what an interruption left, with an empty line after it; nothing when all is there.
pub fn interrupted(done: usize, of: usize) -> String {
    match done {
        _ if done == of => String::new(),
        0 => format!("Interrupted before any of {of} flights was flown.\n\n"),
        _ => format!("Interrupted after {done} of {of} flights: all here is of those.\n\n"),
    }
}

/// Writes a file into the folder of the results.
///
/// # Errors
/// When it cannot be written.
pub fn put(folder: &Path, name: &str, text: &str) -> anyhow::Result<()> {
    let path = folder.join(name);
    std::fs::write(&path, text).with_context(|| format!("writing {}", path.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join(RECORDINGS)).unwrap();
        folder
    }

    #[test]
    fn results_of_another_run_are_refused_before_they_are_mixed_with_new_ones() {
        let folder = folder();
        let folder = folder.path();
        claim(folder, false).unwrap();
        put(folder, "flights.csv", "seed\n1\n").unwrap();
        let problem = claim(folder, false).unwrap_err().to_string();
        for part in [folder.to_str().unwrap(), "flights.csv", "`-o`", "`--replace`"] {
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        }
        assert!(folder.join("flights.csv").exists());
    }

    #[test]
    fn what_is_replaced_is_of_an_experiment_and_nothing_else() {
        let folder = folder();
        let old =
            ["flights.csv", "report.md", "figure-4-16.svg", "recordings/row-1-none-seed-1.mcap"];
        let kept = ["notes.md", "logo.svg", "recordings/flight.mcap"];
        for name in old.iter().chain(&kept) {
            put(folder.path(), name, "old").unwrap();
        }
        claim(folder.path(), true).unwrap();
        let is_there = |name: &&&str| folder.path().join(name).exists();
        assert_eq!(old.iter().filter(is_there).count(), 0);
        assert_eq!(kept.iter().filter(is_there).count(), kept.len());
    }

    #[test]
    fn a_folder_with_recordings_takes_none_of_another_campaign() {
        let folder = folder();
        claim_for_recordings(folder.path()).unwrap();
        put(folder.path(), "bridge-killed-1.mcap", "").unwrap();
        let problem = claim_for_recordings(folder.path()).unwrap_err().to_string();
        assert!(problem.contains("bridge-killed-1.mcap") && problem.contains("--record-tapes"));
    }

    #[test]
    fn an_interruption_is_told_and_only_that() {
        assert_eq!(interrupted(3, 3), "");
        assert!(interrupted(2, 3).contains("after 2 of 3 flights"));
        assert!(interrupted(0, 3).contains("before any of 3 flights"));
    }
}
