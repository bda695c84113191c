//! `alight report`: reads the recordings of one flight or two, prints a summary, and writes the page as HTML or PDF and its charts as
//! SVG files.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use media::write_atomically;
use report::{
    Figure, Flight, FlightReader, comparison, document, figures, marks, page, replay_tapes, summary,
};

use crate::args::{WrongUse, whole_number};
use crate::ending::{Ending, format_of};
use crate::terminal::{print, write_error};

/// The meaning of the exit status of a report.
const EXIT_STATUS: &str = "Exit status 1 also when there is a page and something of a recording could not be read: a damaged part, its end, \
                           messages of another version; of a repaired copy also what was lost before the repair. The page lists it.";

#[derive(Args)]
#[command(after_help = EXIT_STATUS)]
pub(crate) struct ReportArgs {
    /// The recording of a flight (MCAP), or those of two to compare. Files of one run of the recorder are one flight, in any order of
    /// their names, as a recorder begins a new file when one is large; so are files that share a controller's tape and the recorder's
    /// clock.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Which landing of each recording, from 1 on, where it has several [default: the last].
    #[arg(long, value_name = "N", value_parser = whole_number::<usize>(1..=1_000_000))]
    landing: Option<usize>,
    /// The page [default: next to the first recording, with its name, `flight.html`; of two flights `one-and-other.html`, with
    /// `--landing 2` `flight-landing-2.html`]. Its name ends in .html, or in .pdf for a PDF document.
    #[arg(short, long, value_name = "FILE")]
    output: Option<Page>,
    /// A folder for the charts as SVG files, with title and legend, for papers and slides; of two flights in
    /// the folders `1` and `2` in it.
    #[arg(long, value_name = "FOLDER")]
    figures: Option<PathBuf>,
    /// Replace a page or figures that are there already, which may be another flight's; without it they are refused. The page of the same
    /// flights is written again in any case, as is that of one recording with its name and in its folder.
    #[arg(long)]
    replace: bool,
    /// Format of the output: a line for a bug report, or the flight in numbers as one JSON object; or the line, and the page is a
    /// PDF document.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum Format {
    /// A line of text.
    #[default]
    Text,
    /// One JSON object for each flight.
    Json,
    /// A line of text, and a PDF document.
    Pdf,
}

/// A file for the page, and whether it is a PDF document, from its ending.
#[derive(Clone, Debug)]
struct Page {
    path: PathBuf,
    is_pdf: bool,
}

impl std::str::FromStr for Page {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let path = PathBuf::from(text);
        let endings =
            [Ending::new("html", false), Ending::new("htm", false), Ending::new("pdf", true)];
        let is_pdf = format_of(&path, &endings)?;
        Ok(Self { path, is_pdf })
    }
}

/// Maximum number of flights on a page.
const MAX_FLIGHTS: usize = 2;

/// Prints the summary, and writes the page: a failure also where something of a recording could not be read.
pub(crate) fn run(args: &ReportArgs) -> anyhow::Result<ExitCode> {
    let is_pdf = args.is_pdf()?;
    let mut flights = flights(&args.files)?;
    for flight in &mut flights {
        let (name, number) = (flight.name.clone(), args.landing.unwrap_or(0));
        flight.keep_landing(args.landing).map_err(|of| {
            let of = summary::counted(of as u64, "landing", "landings");
            WrongUse(format!("`--landing {number}`: {name} has {of}, counted from 1"))
        })?;
    }
    ensure!(
        flights.len() <= MAX_FLIGHTS,
        WrongUse(format!(
            "{} flights in {:?}, a page has one, or {MAX_FLIGHTS} to compare",
            flights.len(),
            args.files
        ))
    );
    // Also if the page is refused.
    for flight in &flights {
        let summary = summary(flight);
        match args.format {
            Format::Text | Format::Pdf => print(&summary.line())?,
            Format::Json => print(&serde_json::to_string(&summary)?)?,
        }
    }
    let beside = args.beside(&flights, if is_pdf { "pdf" } else { "html" });
    let output = args.output.as_ref().map_or(&beside, |page| &page.path);
    ensure!(
        !args.files.iter().any(|file| is_same_file(file, output)),
        WrongUse(format!(
            "{output:?} is a recording; name another file for the page with `--output`"
        ))
    );
    let is_own = args.output.is_none() && flights.len() == 1;
    if !is_own && !has_marks(output, &marks(&flights.iter().collect::<Vec<_>>())) {
        args.check_is_free(output, "--output")?;
    }
    let written = match flights.as_slice() {
        [one] if is_pdf => document(one, None)?,
        [one, other] if is_pdf => document(one, Some(other))?,
        [one] => page(one)?.into_bytes(),
        [one, other] => comparison(one, other)?.into_bytes(),
        _ => anyhow::bail!("no flight in {:?}", args.files),
    };
    // All is checked before the first file is written.
    let mut drawn = Vec::new();
    if let Some(folder) = &args.figures {
        for (number, flight) in (1..).zip(&flights) {
            let of_several = folder.join(number.to_string());
            let folder = if flights.len() > 1 { of_several } else { folder.clone() };
            let figures = figures(flight)?;
            for figure in &figures {
                args.check_is_free(&folder.join(&figure.name), "--figures")?;
            }
            drawn.push((folder, figures));
        }
    }
    write_atomically(output, &written)
        .with_context(|| format!("writing {output:?}; name another file with `--output`"))?;
    for (folder, figures) in &drawn {
        write_figures(figures, folder)?;
    }
    write_error(&format!("the page: {}", output.display()));
    let are_whole = flights.iter().all(Flight::is_complete);
    Ok(if are_whole { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

impl ReportArgs {
    /// Refuses a file that is there already: it may be another flight's.
    fn check_is_free(&self, file: &Path, option: &str) -> anyhow::Result<()> {
        ensure!(
            self.replace || !file.exists(),
            "{file:?} is there already, and may be of another flight: name another with `{option}`, or replace it with `--replace`"
        );
        Ok(())
    }

    /// The page's path if none is named: next to the first recording, and not that of another flight or landing.
    fn beside(&self, flights: &[Flight], extension: &str) -> PathBuf {
        let Some(first) = self.files.first() else { return PathBuf::new() };
        let stem =
            |flight: &Flight| Path::new(&flight.name).file_stem().unwrap_or_default().to_owned();
        let stems = flights.iter().map(|it| stem(it).to_string_lossy().into_owned());
        let mut name = stems.collect::<Vec<_>>().join("-and-");
        if let Some(number) = self.landing {
            name.push_str(&format!("-landing-{number}"));
        }
        first.with_file_name(format!("{name}.{extension}"))
    }

    /// Whether the page is a PDF document.
    fn is_pdf(&self) -> anyhow::Result<bool> {
        let wants_pdf = self.format == Format::Pdf;
        let Some(Page { path, is_pdf }) = &self.output else { return Ok(wants_pdf) };
        ensure!(
            *is_pdf || !wants_pdf,
            WrongUse(format!(
                "`--format pdf` writes a PDF document, and {path:?} is the name of a page: let it end in .pdf"
            ))
        );
        Ok(*is_pdf)
    }
}

/// Whether a file is a page of just these flights.
fn has_marks(page: &Path, marks: &str) -> bool {
    let parts = [format!("\"{marks}\""), format!("({marks})")];
    std::fs::read(page).is_ok_and(|page| {
        // Of HTML, and of a PDF document.
        parts.iter().any(|part| page.windows(part.len()).any(|at| at == part.as_bytes()))
    })
}

fn write_figures(figures: &[Figure], folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("making the folder {folder:?} of `--figures`"))?;
    for figure in figures {
        let file = folder.join(&figure.name);
        std::fs::write(&file, &figure.svg).with_context(|| format!("writing {file:?}"))?;
    }
    write_error(&format!("{} figures: {}", figures.len(), folder.display()));
    Ok(())
}

/// Whether two paths lead to one file that is there.
fn is_same_file(one: &Path, other: &Path) -> bool {
    one == other
        || one.canonicalize().ok().zip(other.canonicalize().ok()).is_some_and(|(a, b)| a == b)
}

/// The flights in files, in the order in which they are named; files that are parts of one recording are of one flight, in whatever
/// order.
fn flights(files: &[PathBuf]) -> anyhow::Result<Vec<Flight>> {
    let mut parts = Vec::new();
    for (place, file) in files.iter().enumerate() {
        let mut reader = FlightReader::new(&name(file));
        add(&mut reader, file)?;
        ensure!(
            !(reader.is_empty() && reader.is_cut()),
            "{file:?} is cut off before the first message of a flight: copy it again (a recorder that was killed just after its start leaves such a \
             file, too)"
        );
        ensure!(
            !reader.is_empty(),
            "nothing of a flight is in {file:?}; `alight land --record` and `alight record` write recordings"
        );
        parts.push(Part { place, file, reader });
    }
    parts.sort_by_key(|part| part.reader.begin());
    let mut recordings: Vec<Part<'_>> = Vec::new();
    for part in parts {
        match recordings.iter_mut().find(|it| it.reader.goes_on_in(&part.reader)) {
            Some(recording) => {
                recording.place = recording.place.min(part.place);
                add(&mut recording.reader, part.file)?;
            }
            None => recordings.push(part),
        }
    }
    recordings.sort_by_key(|recording| recording.place);
    let flight = |recording: Part<'_>| {
        let mut flight = recording.reader.finish();
        replay_tapes(&mut flight);
        flight
    };
    Ok(recordings.into_iter().map(flight).collect())
}

/// A file that is read, and which of the named ones it is.
struct Part<'a> {
    place: usize,
    file: &'a Path,
    reader: FlightReader,
}

fn add(reader: &mut FlightReader, file: &Path) -> anyhow::Result<()> {
    let recording = std::fs::read(file).with_context(|| format!("reading {file:?}"))?;
    reader.add(&recording).with_context(|| format!("{file:?} is no recording (MCAP file)"))
}

fn name(file: &Path) -> String {
    file.file_name().unwrap_or(file.as_os_str()).to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use experiments::landing::flight::fly_recorded;
    use experiments::landing::plan::Plan;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: ReportArgs,
    }

    #[test]
    fn the_ending_chooses_between_page_and_document() {
        let is_pdf = |text: &[&str]| {
            let text = ["report", "flight.mcap"].iter().chain(text);
            let parsed = Program::try_parse_from(text).map_err(|problem| problem.to_string());
            parsed.and_then(|it| it.args.is_pdf().map_err(|problem| problem.to_string()))
        };
        assert_eq!(is_pdf(&[]), Ok(false));
        assert_eq!(is_pdf(&["--format", "pdf"]), Ok(true));
        assert_eq!(is_pdf(&["-o", "why.PDF"]), Ok(true));
        assert_eq!(is_pdf(&["-o", "why.html"]), Ok(false));
        assert!(is_pdf(&["-o", "why.txt"]).unwrap_err().contains(".html, .htm or .pdf"));
        assert!(is_pdf(&["-o", "why.html", "--format", "pdf"]).unwrap_err().contains("why.html"));
    }

    fn refusal(contents: Option<&[u8]>) -> String {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("flight.mcap");
        if let Some(contents) = contents {
            std::fs::write(&file, contents).unwrap();
        }
        format!("{:#}", flights(&[file]).unwrap_err())
    }

    #[test]
    fn a_file_that_is_no_recording_is_named_with_its_error() {
        assert!(refusal(None).contains("reading \"") && refusal(None).contains("flight.mcap"));
        assert!(refusal(Some(b"text")).contains("flight.mcap\" is no recording (MCAP file)"));
        let about = flightlog::About::default();
        let mut empty = Vec::new();
        flightlog::Writer::new(&mut empty, &about).unwrap().finish().unwrap();
        assert!(refusal(Some(&empty)).contains("nothing of a flight is in"));
        // Within the first record, the header.
        let cut = refusal(empty.get(..20));
        assert!(cut.contains("flight.mcap\" is cut off before the first message"), "{cut}");
    }

    /// Writes a recording of a part of a tape.
    fn write(file: &Path, clock: &str, received_ns: i64, begun_ns: i64, records: &[u8]) {
        let mut recording = Vec::new();
        let facts = [("clock".to_owned(), clock.to_owned())].into();
        let about = flightlog::About { facts, ..flightlog::About::default() };
        let mut writer = flightlog::Writer::new(&mut recording, &about).unwrap();
        let tape =
            messages::Tape { begun_ns, records: records.to_vec(), ..messages::Tape::default() };
        let (key, payload) = (messages::topic::TAPE.key(&[]), messages::encode(&tape));
        let message =
            flightlog::Received { key: &key, payload: &payload, attachment: b"", received_ns };
        writer.receive(message).unwrap();
        writer.finish().unwrap();
        std::fs::write(file, recording).unwrap();
    }

    #[test]
    fn files_that_share_tape_and_clock_are_one_flight_in_any_order() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let [one, second, two, other, ground] =
            ["one.mcap", "one-2.mcap", "two.mcap", "in-lock-step.mcap", "ground.mcap"].map(path);
        write(&one, "drone", 9, 3, b"one");
        write(&second, "drone", 12, 3, b"one");
        write(&two, "drone", 9, 4, b"one");
        write(&other, "drone", 9, 3, b"two");
        write(&ground, "ground", 5, 3, b"one");
        let names = |files: &[&PathBuf]| -> Vec<String> {
            let files: Vec<PathBuf> = files.iter().map(|it| (*it).clone()).collect();
            flights(&files).unwrap().into_iter().map(|it| it.name).collect()
        };
        let flights_of = names(&[&one, &second, &two, &other]);
        assert_eq!(flights_of, ["one.mcap", "two.mcap", "in-lock-step.mcap"]);
        // As a shell has them, and the other way round.
        assert_eq!(names(&[&second, &one, &two, &other]), flights_of);
        assert_eq!(names(&[&two, &other, &second, &one])[2], "one.mcap");
        // Of the same flight, by another recorder.
        assert_eq!(names(&[&second, &ground, &one]), ["one.mcap", "ground.mcap"]);
    }

    #[test]
    fn files_of_one_run_of_the_recorder_are_one_flight_also_without_a_tape() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, run: &str, key: &str, received_ns: i64| {
            let facts = [("clock", "drone"), ("run", run)];
            let facts = facts.map(|(name, value)| (name.to_owned(), value.to_owned())).into();
            let about = flightlog::About { facts, ..flightlog::About::default() };
            let tape = messages::Tape { begun_ns: 3, ..messages::Tape::default() };
            let mut recording = Vec::new();
            let mut writer = flightlog::Writer::new(&mut recording, &about).unwrap();
            let payload = messages::encode(&tape);
            let message =
                flightlog::Received { key, payload: &payload, attachment: b"", received_ns };
            writer.receive(message).unwrap();
            writer.finish().unwrap();
            let file = folder.path().join(name);
            std::fs::write(&file, recording).unwrap();
            file
        };
        let tape = messages::topic::TAPE.key(&[]);
        // The controller starts after the first file and ends before the third; then another recorder continues its tape.
        let before = write("s.mcap", "7-1", "wind", 1);
        let during = write("s-2.mcap", "7-1", &tape, 2);
        let after = write("s-3.mcap", "7-1", "wind", 3);
        let later = write("t.mcap", "8-1", &tape, 4);
        let later_after = write("t-2.mcap", "8-1", "wind", 5);
        let other = write("other.mcap", "9-1", "wind", 6);
        let names = |files: &[&PathBuf]| -> Vec<String> {
            let files: Vec<PathBuf> = files.iter().map(|it| (*it).clone()).collect();
            flights(&files).unwrap().into_iter().map(|it| it.name).collect()
        };
        assert_eq!(names(&[&after, &during, &before]), ["s.mcap"]);
        assert_eq!(names(&[&after, &before]), ["s.mcap"]);
        assert_eq!(names(&[&before, &during, &after, &later, &later_after]), ["s.mcap"]);
        assert_eq!(names(&[&before, &other]), ["s.mcap", "other.mcap"]);
    }

    /// A recorded landing of its own.
    fn fly(file: &Path, seed: u64) {
        let plan = Plan { flights: 1, seed, ..Plan::default() };
        fly_recorded(&plan.flights()[0], std::fs::File::create(file).unwrap()).unwrap();
    }

    /// Runs `alight report`; an error if it fails.
    fn reported(files: &[&Path], options: &[&str]) -> Result<ExitCode, String> {
        let files = files.iter().map(|file| file.as_os_str());
        let options = options.iter().map(|option| (*option).as_ref());
        let text = std::iter::once("report".as_ref()).chain(files).chain(options);
        run(&Program::try_parse_from(text).unwrap().args).map_err(|problem| problem.to_string())
    }

    #[test]
    fn the_page_of_another_flight_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let [one, other] = ["one.mcap", "other.mcap"].map(path);
        fly(&one, 1);
        fly(&other, 2);
        let text = |name: &str| std::fs::read_to_string(path(name)).unwrap();
        // Each flight has its own page, which is written again.
        reported(&[&one], &[]).unwrap();
        reported(&[&other], &[]).unwrap();
        reported(&[&one, &other], &[]).unwrap();
        reported(&[&one], &["--landing", "1"]).unwrap();
        for name in ["one.html", "other.html", "one-and-other.html", "one-landing-1.html"] {
            assert!(text(name).contains("<html"), "{name}");
        }
        std::fs::write(path("one.html"), "old").unwrap();
        reported(&[&one], &[]).unwrap();
        assert!(text("one.html") != "old");
        // A named path belongs to the flight that was written there first.
        let [page, charts] = ["page.html", "charts"].map(|name| path(name).display().to_string());
        let named = ["-o", &page, "--figures", &charts];
        reported(&[&one], &named).unwrap();
        let first = text("page.html");
        let problem = reported(&[&other], &named).unwrap_err();
        assert!(problem.contains("page.html") && problem.contains("`--replace`"), "{problem}");
        let problem = reported(&[&other], &["-o", "new.html", "--figures", &charts]).unwrap_err();
        assert!(problem.contains(".svg") && problem.contains("`--figures`"), "{problem}");
        assert!(!Path::new("new.html").exists(), "written before the figures were refused");
        assert_eq!(text("page.html"), first);
        reported(&[&other], &[&named[..], &["--replace"]].concat()).unwrap();
        assert_ne!(text("page.html"), first);
    }

    #[test]
    fn three_flights_and_a_landing_that_is_not_there_are_a_wrong_use() {
        let folder = tempfile::tempdir().unwrap();
        let files = ["one.mcap", "two.mcap", "three.mcap"].map(|name| folder.path().join(name));
        (1..).zip(&files).for_each(|(seed, file)| fly(file, seed));
        let refused = |files: &[PathBuf], options: &[&str]| {
            let options = options.iter().map(|option| (*option).as_ref());
            let files = files.iter().map(|file| file.as_os_str());
            let text = std::iter::once("report".as_ref()).chain(files).chain(options);
            let problem = run(&Program::try_parse_from(text).unwrap().args).unwrap_err();
            assert!(problem.is::<WrongUse>(), "{problem:#}");
        };
        refused(&files, &[]);
        refused(&files[..1], &["--landing", "9"]);
        refused(&files[..1], &["--format", "pdf", "-o", "x.html"]);
    }

    #[test]
    fn a_page_of_a_partly_unreadable_recording_is_no_success() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let [complete, cut, damaged] = ["complete.mcap", "cut.mcap", "damaged.mcap"].map(path);
        fly(&complete, 1);
        let recording = std::fs::read(&complete).unwrap();
        std::fs::write(&cut, &recording[..recording.len() * 3 / 4]).unwrap();
        let mut bytes = recording;
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        std::fs::write(&damaged, bytes).unwrap();
        let status = |files: &[&Path]| format!("{:?}", reported(files, &[]).unwrap());
        let [success, failure] = [ExitCode::SUCCESS, ExitCode::FAILURE].map(|it| format!("{it:?}"));
        assert_eq!(status(&[&complete]), success);
        assert_eq!(status(&[&cut]), failure);
        assert_eq!(status(&[&damaged]), failure);
        assert_eq!(status(&[&complete, &cut]), failure);
        for page in ["cut.html", "damaged.html"] {
            assert!(path(page).is_file(), "{page}");
        }
    }

    #[test]
    fn the_page_of_the_same_flight_is_written_again() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        let [one, other] = ["one.mcap", "other.mcap"].map(path);
        fly(&one, 1);
        fly(&other, 2);
        let reported =
            |files: &[&Path], page: &Path| reported(files, &["-o", page.to_str().unwrap()]).is_ok();
        for page in ["page.html", "page.pdf"].map(path) {
            assert!(reported(&[&one], &page) && reported(&[&one], &page), "{page:?}");
            let first = std::fs::read(&page).unwrap();
            for others in [&[&*other][..], &[&one, &other], &[&other, &one]] {
                assert!(!reported(others, &page), "{others:?} replaced {page:?}");
            }
            assert_eq!(std::fs::read(&page).unwrap(), first);
            std::fs::remove_file(&page).unwrap();
            assert!(reported(&[&one, &other], &page) && reported(&[&one, &other], &page));
            assert!(!reported(&[&one], &page) && !reported(&[&other, &one], &page));
        }
        // No other file is left next to the pages.
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 4);
    }
}
