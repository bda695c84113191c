//! Manages the output folder of an experiment with landings or faults, or of a comparison: its report, tables, recordings and logs replace those of
//! an earlier run completely. It is claimed before the first flight: hours of flying are neither lost to a folder that cannot be written, nor
//! mixed with the results of another run. Results of an earlier run are kept until the first of the new results is written: there
//! may be none.

use std::collections::BTreeSet;
use std::fs::DirEntry;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail, ensure};

/// Every flight, as lines of JSON and as comma-separated values.
pub const FLIGHTS_AS_JSON: &str = "flights.jsonl";
/// See [`FLIGHTS_AS_JSON`].
pub const FLIGHTS_AS_CSV: &str = "flights.csv";
/// The report.
pub const REPORT: &str = "report.md";
/// The report's first lines, which distinguish it from a report of another origin.
pub const LANDINGS_HEADING: &str = "# Landings\n";
/// See [`LANDINGS_HEADING`].
pub const FAULTS_HEADING: &str = "# Faults\n";
/// See [`LANDINGS_HEADING`].
pub const COMPARISON_HEADING: &str = "# Two runs of landings\n";
/// A comparison of two runs for programs.
pub const COMPARISON_AS_JSON: &str = "comparison.json";
/// Its plot.
pub const COMPARISON_PLOT: &str = "comparison.svg";
/// The paragraph of a report with the command and version that made it; nothing for an experiment without a command.
pub fn origin(command: &str) -> String {
    match command {
        "" => String::new(),
        _ => format!("By `{command}`, alight {}.\n\n", node::version()),
    }
}

/// The names of the plots of landings.
pub const PLOTS: [&str; 5] = [
    "error-against-wind.svg",
    "time-against-wind.svg",
    "touchdowns.svg",
    "success.svg",
    "worst.svg",
];
/// The names of the thesis' figures of one landing.
pub const FIGURES: [&str; 7] = [
    "figure-4-10.svg",
    "figure-4-11.svg",
    "figure-4-12.svg",
    "figure-4-13.svg",
    "figure-4-14.svg",
    "figure-4-15.svg",
    "figure-4-16.svg",
];
/// The folder of the recordings in that of the results.
pub const RECORDINGS: &str = "recordings";
/// The begin of the name of the folder with the logs of one flight in real time; its seed follows.
const LOGS: &str = "logs-";
/// The end of that name while it is flown, and after an interruption: no result, which neither counts nor is refused.
const UNFINISHED: &str = "-unfinished";
/// The names of the logs, without their ending.
const PARTS: [&str; 5] = ["world", "camera", "detector", "controller", "bridge"];

/// The claimed folder.
#[derive(Debug)]
pub struct Folder {
    path: PathBuf,
    /// The files of an earlier run.
    old: Vec<PathBuf>,
}

impl Folder {
    /// Makes the folder. Files of an earlier run there are refused, or with `replaces` removed before the first new result.
    ///
    /// # Errors
    /// When there is such, or a report of another origin that would be overwritten, or the folder cannot be made or read.
    pub fn claim(path: &Path, replaces: bool) -> anyhow::Result<Self> {
        std::fs::create_dir_all(path).with_context(|| format!("making {}", path.display()))?;
        let report = path.join(REPORT);
        ensure!(
            !report.exists() || is_of_an_experiment(&report),
            "{} is not the report of landings, faults or a comparison, and would be overwritten; name another folder with `-o`",
            report.display()
        );
        let old = written(path)?;
        if let Some(first) = old.first()
            && !replaces
        {
            bail!(
                "{} has the results of an experiment already ({}); name another folder with `-o`, or replace them with `--replace`",
                path.display(),
                first.strip_prefix(path).unwrap_or(first).display()
            );
        }
        // Also those from which old files are removed.
        let folders: BTreeSet<_> =
            old.iter().filter_map(|old| old.parent()).chain([path]).collect();
        for folder in folders {
            let tried = folder.join(".writable");
            std::fs::write(&tried, "")
                .and_then(|()| std::fs::remove_file(&tried))
                .with_context(|| format!("writing into the folder {}", folder.display()))?;
        }
        Ok(Self { path: path.to_owned(), old })
    }

    /// Its path.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Writes a file into it, completely or not at all: the existing file is kept if a disk is full.
    ///
    /// # Errors
    /// When it cannot be written, or old files cannot be removed.
    pub fn put(&mut self, name: &str, text: &str) -> anyhow::Result<()> {
        let (path, new) = (self.path.join(name), self.path.join(format!(".{name}.new")));
        let written = std::fs::write(&new, text)
            .with_context(|| format!("writing {}", path.display()))
            .and_then(|()| remove(std::mem::take(&mut self.old)));
        if let Err(problem) = written {
            let _ = std::fs::remove_file(&new);
            return Err(problem);
        }
        std::fs::rename(&new, &path).with_context(|| format!("writing {}", path.display()))
    }

    /// The folder for the logs of the flight with this seed while it is flown, made and without those of one that was not finished.
    ///
    /// # Errors
    /// When it cannot be made or emptied.
    pub fn begin_logs(&self, seed: u64) -> anyhow::Result<PathBuf> {
        let logs = self.unfinished_logs(seed);
        let leftover = names(&logs)?.into_iter().filter(|name| is_of_a_process(name));
        remove(leftover.map(|name| logs.join(name)).collect())?;
        std::fs::create_dir_all(&logs).with_context(|| format!("making {}", logs.display()))?;
        Ok(logs)
    }

    /// Moves the logs of a flight that counts to their folder, instead of those of an earlier run. Files that are not of a process are
    /// not moved.
    ///
    /// # Errors
    /// When those cannot be removed, or these not be moved: they are left where they were written, and the flight counts.
    pub fn keep_logs(&mut self, seed: u64) -> anyhow::Result<()> {
        let (from, to) = (self.unfinished_logs(seed), self.path.join(format!("{LOGS}{seed}")));
        let (of_this_flight, others) =
            std::mem::take(&mut self.old).into_iter().partition(|old| old.starts_with(&to));
        self.old = others;
        remove(of_this_flight)
            .and_then(|()| move_logs(&from, &to))
            .with_context(|| format!("leaving logs of a flight in {}", from.display()))
    }

    fn unfinished_logs(&self, seed: u64) -> PathBuf {
        self.path.join(format!("{LOGS}{seed}{UNFINISHED}"))
    }
}

/// All that an experiment has written into a folder.
fn written(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut old = Vec::new();
    let mut add = |folder: PathBuf, is_ours: &dyn Fn(&str) -> bool| -> anyhow::Result<()> {
        let ours = names(&folder)?.into_iter().filter(|name| is_ours(name));
        old.extend(ours.map(|name| folder.join(name)));
        Ok(())
    };
    add(folder.to_owned(), &is_result)?;
    add(folder.join(RECORDINGS), &is_of_a_row)?;
    for logs in names(folder)?.iter().filter(|name| is_of_logs(name)) {
        let logs = folder.join(logs);
        // No process makes a folder there.
        add(logs.clone(), &|name| is_of_a_process(name) && !logs.join(name).is_dir())?;
    }
    Ok(old)
}

/// Moves the logs of a flight, one by one, since both folders may have files of the user: all of them, or none where one would
/// overwrite such a file.
fn move_logs(from: &Path, to: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(to).with_context(|| format!("making {}", to.display()))?;
    let mut logs = names(from)?;
    logs.retain(|name| is_of_a_process(name));
    if let Some(taken) = logs.iter().map(|name| to.join(name)).find(|path| is_there(path)) {
        bail!("{} is not of an experiment, and would be overwritten", taken.display());
    }
    for name in logs {
        std::fs::rename(from.join(&name), to.join(&name))
            .with_context(|| format!("moving {name} into {}", to.display()))?;
    }
    // One with files of the user stays.
    let _ = std::fs::remove_dir(from);
    Ok(())
}

/// Whether a file has this name, or a link without a target.
fn is_there(path: &Path) -> bool {
    path.symlink_metadata().is_ok()
}

fn remove(old: Vec<PathBuf>) -> anyhow::Result<()> {
    for path in old {
        match std::fs::remove_file(&path) {
            Err(problem) if problem.kind() != ErrorKind::NotFound => {
                return Err(problem)
                    .with_context(|| format!("removing {} of an earlier run", path.display()));
            }
            _ => {}
        }
        if let Some(logs) = path.parent()
            && logs.file_name().is_some_and(|name| is_of_logs(&name.to_string_lossy()))
        {
            // One with files of the user stays.
            let _ = std::fs::remove_dir(logs);
        }
    }
    Ok(())
}

fn is_of_an_experiment(report: &Path) -> bool {
    let text = std::fs::read_to_string(report).unwrap_or_default();
    [LANDINGS_HEADING, FAULTS_HEADING, COMPARISON_HEADING]
        .iter()
        .any(|heading| text.starts_with(heading))
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

/// Whether it is a file that an experiment writes into its folder.
fn is_result(name: &str) -> bool {
    [FLIGHTS_AS_JSON, FLIGHTS_AS_CSV, REPORT, COMPARISON_AS_JSON, COMPARISON_PLOT].contains(&name)
        || PLOTS.contains(&name)
        || FIGURES.contains(&name)
}

/// Whether it is the folder with the logs of a flight.
fn is_of_logs(name: &str) -> bool {
    name.strip_prefix(LOGS).is_some_and(|seed| seed.parse::<u64>().is_ok())
}

/// Whether a process of a flight in real time writes it: its log, or a controller's notes of the vehicle.
fn is_of_a_process(name: &str) -> bool {
    let is_note = || name.starts_with("controller-") && name.ends_with(".json");
    name.strip_suffix(".log").is_some_and(|part| PARTS.contains(&part)) || is_note()
}

fn is_recording(name: &str) -> bool {
    name.ends_with(".mcap")
}

/// Whether it is one of the recordings that landings write of their rows.
fn is_of_a_row(name: &str) -> bool {
    name.starts_with("row-") && name.contains("-seed-") && is_recording(name)
}

/// A sentence on the results of an interrupted experiment, with an empty line after it; nothing when all is there.
pub fn interrupted(done: usize, of: usize) -> String {
    match done {
        _ if done == of => String::new(),
        0 => format!("Interrupted before any of {of} flights was flown.\n\n"),
        _ => format!("Interrupted after {done} of {of} flights: all here is of those.\n\n"),
    }
}

/// A sentence on the results so far while more are to come, with an empty line after it; nothing when all is there.
pub fn so_far(done: usize, of: usize) -> String {
    match done {
        _ if done == of => String::new(),
        _ => format!("So far {done} of {of} flights: all here is of those.\n\n"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The files that an experiment writes.
    const OURS: [&str; 7] = [
        "flights.csv",
        "flights.jsonl",
        "success.svg",
        "figure-4-16.svg",
        "recordings/row-1-none-seed-1.mcap",
        "logs-7/world.log",
        "logs-7/controller-main.json",
    ];

    fn write(folder: &Path, name: &str, text: &str) {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    /// The names of the values in a row.
    fn names_of(row: &impl serde::Serialize) -> Vec<String> {
        crate::rows::names(row).unwrap()
    }

    #[test]
    fn each_name_in_a_row_is_explained_in_its_section() {
        let text = include_str!("../../../docs/experiments.md");
        let landings = crate::landing::plan::Plan::default().flights();
        let faults = crate::faults::plan::Plan { flights: 1, ..Default::default() }.flights();
        let found = crate::record::Found::sample("rings");
        let sections = [
            ("## Markers\n", names_of(&crate::score::Score::default().summary())),
            ("## Markers\n", names_of(&found)),
            ("## Landings\n", names_of(&crate::landing::outcome::Outcome::new(&landings[0]))),
            ("## Faults\n", names_of(&crate::faults::outcome::Outcome::new(&faults[0]))),
        ];
        for (heading, names) in sections {
            assert!(names.len() > 7, "{names:?}");
            let (_, section) = text.split_once(heading).unwrap();
            let section = section.split("\n## ").next().unwrap();
            for name in &names {
                assert!(section.contains(&format!("`{name}`")), "`{name}` is not in {heading}");
            }
            // Those of flights are columns, in the order of the documentation's table.
            if heading != "## Markers\n" {
                let (_, table) = section.split_once("|---|---|\n").unwrap();
                let at = names.iter().map(|name| table.find(&format!("`{name}`")));
                assert!(at.is_sorted(), "{heading}: {names:?}");
            }
        }
    }

    fn refusal(folder: &Path, replaces: bool) -> String {
        Folder::claim(folder, replaces).unwrap_err().to_string()
    }

    #[test]
    fn each_file_that_would_be_removed_is_refused_and_stays() {
        for name in OURS {
            let folder = tempfile::tempdir().unwrap();
            let folder = folder.path();
            Folder::claim(folder, false).unwrap();
            write(folder, name, "old");
            let problem = refusal(folder, false);
            for part in [folder.to_str().unwrap(), name, "`-o`", "`--replace`"] {
                assert!(problem.contains(part), "`{part}` is not in: {problem}");
            }
            assert!(folder.join(name).exists(), "{name}");
        }
    }

    #[test]
    fn a_report_is_an_experiments_or_kept() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        write(folder, REPORT, "# My notes\n");
        for replaces in [false, true] {
            assert!(
                refusal(folder, replaces)
                    .contains("not the report of landings, faults or a comparison")
            );
        }
        write(folder, REPORT, &format!("{FAULTS_HEADING}\n"));
        assert!(refusal(folder, false).contains("--replace"));
        Folder::claim(folder, true).unwrap();
    }

    #[test]
    fn a_folder_that_cannot_be_written_is_found_at_the_start_and_nothing_is_removed_later() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        write(folder, FLIGHTS_AS_CSV, "old");
        // Stands for a disk that is full.
        std::fs::create_dir(folder.join(".flights.csv.new")).unwrap();
        Folder::claim(folder, true).unwrap().put(FLIGHTS_AS_CSV, "new").unwrap_err();
        assert_eq!(std::fs::read_to_string(folder.join(FLIGHTS_AS_CSV)).unwrap(), "old");
        // And this for a folder that this user may not write.
        std::fs::create_dir(folder.join(".writable")).unwrap();
        assert!(refusal(folder, true).starts_with("writing into the folder"));
    }

    #[test]
    fn old_results_are_kept_until_the_first_new_one_and_files_of_the_user_for_ever() {
        let folder = tempfile::tempdir().unwrap();
        let kept = [
            "notes.md",
            "logo.svg",
            "figure-4-2.svg",
            "recordings/flight.mcap",
            "logs-old/world.log",
            "logs-8/mine.log",
        ];
        for name in OURS.iter().chain(&kept) {
            write(folder.path(), name, "old");
        }
        let is_there = |name: &&&str| folder.path().join(name).exists();
        let mut claimed = Folder::claim(folder.path(), true).unwrap();
        assert_eq!(OURS.iter().filter(is_there).count(), OURS.len());
        claimed.put(FLIGHTS_AS_CSV, "new").unwrap();
        claimed.put(REPORT, "new").unwrap();
        let left: Vec<&&str> = OURS.iter().filter(is_there).collect();
        assert_eq!(left, [&FLIGHTS_AS_CSV]);
        assert_eq!(kept.iter().filter(is_there).count(), kept.len());
        assert!(folder.path().join(REPORT).exists() && !folder.path().join("logs-7").exists());
    }

    #[test]
    fn the_logs_of_a_flight_are_its_own_and_outlast_the_first_result() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["logs-1/world.log", "logs-1/camera.log", "logs-1/mine", "logs-2/world.log"] {
            write(folder.path(), name, "old");
        }
        let mut claimed = Folder::claim(folder.path(), true).unwrap();
        let logs = claimed.begin_logs(1).unwrap();
        write(&logs, "world.log", "new");
        claimed.keep_logs(1).unwrap();
        claimed.put(FLIGHTS_AS_CSV, "new").unwrap();
        assert_eq!(names(folder.path()).unwrap(), [FLIGHTS_AS_CSV, "logs-1"]);
        let kept = folder.path().join("logs-1");
        assert_eq!(names(&kept).unwrap(), ["mine", "world.log"]);
        assert_eq!(std::fs::read_to_string(kept.join("world.log")).unwrap(), "new");
    }

    #[test]
    fn files_of_the_user_in_the_folders_of_logs_are_neither_moved_nor_overwritten() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["logs-1-unfinished/notes", "logs-1/notes", "logs-2/world.log/notes"] {
            write(folder.path(), name, "of the user");
        }
        let mut claimed = Folder::claim(folder.path(), false).unwrap();
        for seed in [1, 2, 3] {
            let logs = claimed.begin_logs(seed).unwrap();
            write(&logs, "camera.log", "new");
            write(&logs, "world.log", "new");
        }
        // It came after the folder was claimed.
        write(folder.path(), "logs-3/world.log", "of the user");
        claimed.keep_logs(1).unwrap();
        for (seed, taken) in [(2, "logs-2/world.log"), (3, "logs-3/world.log")] {
            let problem = format!("{:#}", claimed.keep_logs(seed).unwrap_err());
            for part in [taken, &format!("in {}", claimed.unfinished_logs(seed).display())] {
                assert!(problem.contains(part), "`{part}` is not in: {problem}");
            }
            assert_eq!(names(&claimed.unfinished_logs(seed)).unwrap(), ["camera.log", "world.log"]);
        }
        // Those flights count all the same.
        claimed.put(FLIGHTS_AS_CSV, "new").unwrap();
        let kept = [
            ("logs-1-unfinished/notes", "of the user"),
            ("logs-1/notes", "of the user"),
            ("logs-1/world.log", "new"),
            ("logs-2/world.log/notes", "of the user"),
            ("logs-3/world.log", "of the user"),
            (FLIGHTS_AS_CSV, "new"),
        ];
        for (name, text) in kept {
            assert_eq!(std::fs::read_to_string(folder.path().join(name)).unwrap(), text, "{name}");
        }
    }

    #[test]
    fn a_folder_of_the_user_among_old_logs_stays_and_costs_no_new_result() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["logs-1/camera.log", "logs-2/camera.log/notes", "logs-2/world.log"] {
            write(folder.path(), name, "old");
        }
        let mut claimed = Folder::claim(folder.path(), true).unwrap();
        write(&claimed.begin_logs(1).unwrap(), "world.log", "new");
        claimed.keep_logs(1).unwrap();
        claimed.put(FLIGHTS_AS_CSV, "new").unwrap();
        assert_eq!(names(&folder.path().join("logs-1")).unwrap(), ["world.log"]);
        assert_eq!(names(&folder.path().join("logs-2")).unwrap(), ["camera.log"]);
    }

    #[test]
    fn a_flight_that_was_not_finished_costs_no_old_logs_and_is_no_result() {
        let folder = tempfile::tempdir().unwrap();
        let interrupt = |replaces: bool| {
            let logs = Folder::claim(folder.path(), replaces).unwrap().begin_logs(1).unwrap();
            assert_eq!(names(&logs).unwrap(), [""; 0]);
            write(&logs, "world.log", "new");
            logs
        };
        // Where there is nothing else, the next run is not refused.
        let logs = interrupt(false);
        assert_eq!(interrupt(false), logs);
        for name in ["logs-1/world.log", FLIGHTS_AS_CSV] {
            write(folder.path(), name, "old");
        }
        interrupt(true);
        for name in ["logs-1/world.log", FLIGHTS_AS_CSV] {
            assert_eq!(std::fs::read_to_string(folder.path().join(name)).unwrap(), "old", "{name}");
        }
        assert!(refusal(folder.path(), false).contains("--replace"));
    }

    #[test]
    fn a_folder_with_recordings_takes_none_of_another_campaign() {
        let folder = tempfile::tempdir().unwrap();
        claim_for_recordings(folder.path()).unwrap();
        write(folder.path(), "bridge-killed-1.mcap", "");
        let problem = claim_for_recordings(folder.path()).unwrap_err().to_string();
        assert!(problem.contains("bridge-killed-1.mcap") && problem.contains("--record-tapes"));
    }

    #[test]
    fn only_missing_flights_are_reported() {
        assert_eq!(interrupted(3, 3), "");
        assert!(interrupted(2, 3).contains("after 2 of 3 flights"));
        assert!(interrupted(0, 3).contains("before any of 3 flights"));
        assert_eq!(so_far(3, 3), "");
        assert!(so_far(2, 3).starts_with("So far 2 of 3 flights"));
    }
}
