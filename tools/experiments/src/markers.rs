//! Runs the experiment with markers: renders missing sets, runs the detector, scores all results, writes the
//! report.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use markers::{Family, Marker};

use crate::common;
use crate::figures::{self, FIGURES};
use crate::frame_spec::FrameRenderer;
use crate::photographs;
use crate::record::{self, ALL_AT_ONCE, ALL_OURS, FOLLOWING, Ids, OURS};
use crate::report::{self, OfProcessing, Run};
use crate::results;
use crate::rows::csv;
use crate::set::{MARKERS, SIZE_M, Set};
use crate::sets::Variant;
use crate::store;
use crate::tables;
use crate::thesis::TABLES;

/// The experiment to run.
#[derive(Clone, Debug)]
pub struct Request {
    /// The command that requested it, for the report.
    pub command: String,
    /// Folder of the sets; missing ones are rendered.
    pub sets_in: PathBuf,
    /// Folder of results, scores and figures.
    pub results_in: PathBuf,
    /// The sets.
    pub sets: Vec<Set>,
    /// The families; all of the experiment's if empty.
    pub families: Vec<String>,
    /// Folder of labelled photographs.
    pub photographs: Option<PathBuf>,
    /// Which frames of the sets.
    pub variant: Variant,
    /// The ids that are looked for in frames with a marker.
    pub ids: Ids,
    /// Whether results of an earlier run are replaced; otherwise they are refused.
    pub replaces: bool,
}

impl Request {
    /// All sets and families of the experiment in one working folder, which has a folder for each variant but
    /// the default.
    pub fn within(folder: &Path, variant: Variant, ids: Ids) -> Self {
        let folder = match variant.name() {
            Some(name) => folder.join(name),
            None => folder.to_owned(),
        };
        Self {
            command: String::new(),
            sets_in: folder.join("sets"),
            results_in: folder.join(match ids {
                Ids::Any => "results",
                Ids::Shown => "results-known-id",
            }),
            sets: Set::ALL.to_vec(),
            families: Vec::new(),
            photographs: None,
            variant,
            ids,
            replaces: false,
        }
    }
}

/// Number of runs of timed sets; the shortest time of each frame counts.
const TIMED_RUNS: usize = 5;

/// Where an experiment is, before each of its steps.
#[derive(Clone, Debug)]
pub struct Step<'a> {
    /// The set and the family.
    pub name: &'a str,
    /// Its number, from 1 on, and that of all.
    pub number: usize,
    /// See `number`.
    pub of: usize,
}

impl fmt::Display for Step<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { name, number, of } = self;
        write!(f, "{name} ({number} of {of})")
    }
}

/// The results of an experiment with markers.
#[derive(Clone, Debug)]
pub struct Findings {
    /// The report, in Markdown.
    pub report: String,
    /// Whether it was interrupted before its last step.
    pub is_interrupted: bool,
}

/// The file of the report.
pub const REPORT: &str = "report.md";
/// The scores as lines of JSON, and as comma-separated values.
const SCORES: [&str; 2] = ["scores.jsonl", "scores.csv"];

/// Refuses a folder that has results of an earlier run, unless they are to be replaced.
///
/// # Errors
/// When it has some, with the first of them.
pub fn check_unused(request: &Request) -> anyhow::Result<()> {
    let Request { results_in, replaces, .. } = request;
    match earlier(results_in)?.first() {
        Some(first) if !replaces => bail!(
            "{} has the results of an experiment already ({}); name another folder with `-o`, or replace them with `--replace`, \
             which keeps frames and the results of other detectors",
            results_in.display(),
            first.strip_prefix(results_in).unwrap_or(first).display()
        ),
        _ => Ok(()),
    }
}

/// The files that an earlier run has written into its folder of results; not those of other detectors.
fn earlier(results: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut earlier: Vec<PathBuf> = Vec::new();
    let tables = TABLES.iter().map(|table| format!("{}.csv", tables::name(table)));
    let figures = FIGURES.iter().map(|(name, _)| format!("{name}.svg"));
    let files = [REPORT, common::FILE].into_iter().chain(SCORES).map(str::to_owned);
    earlier.extend(files.chain(tables).chain(figures).map(|name| results.join(name)));
    for detector in ALL_OURS {
        for set in Set::ALL.map(Set::name).into_iter().chain([PHOTOGRAPHS]) {
            let Ok(entries) = std::fs::read_dir(results.join(detector).join(set)) else { continue };
            for entry in entries {
                let path = entry?.path();
                if path.extension().is_some_and(|ending| ending == "jsonl") {
                    earlier.push(path);
                }
            }
        }
    }
    earlier.retain(|path| path.exists());
    earlier.sort();
    Ok(earlier)
}

/// Runs the experiment; `begins` is called before each step, and may end the run there. The report is of the finished steps.
///
/// # Errors
/// When a file cannot be read or written, or there are results of an earlier run that are not to be replaced.
pub fn run(
    request: &Request,
    begins: &mut dyn FnMut(Step<'_>) -> ControlFlow<()>,
) -> anyhow::Result<Findings> {
    let Request { sets_in, results_in, .. } = request;
    check_unused(request)?;
    let mut old = earlier(results_in)?;
    std::fs::create_dir_all(results_in)
        .with_context(|| format!("making {}", results_in.display()))?;
    // Before the rendering, which takes minutes, and before results of an earlier run are removed.
    report::check_others(sets_in, results_in)?;
    if let Some(folder) = &request.photographs {
        photographs::check(folder)?;
        recalls(folder, results_in, &|detector| !ALL_OURS.contains(&detector))?;
    }
    let mut renderer = FrameRenderer::default();
    let mut extra = String::new();
    let mut steps = Vec::new();
    for set in &request.sets {
        steps.extend(markers(request, *set)?.into_iter().map(|marker| (*set, marker)));
    }
    let of = steps.len() + usize::from(request.photographs.is_some());
    let mut done = 0;
    for (set, marker) in steps {
        let name = marker.family.name();
        let step = format!("{} {name}", set.name());
        if begins(Step { name: &step, number: done + 1, of }).is_break() {
            break;
        }
        store::make(sets_in, set, marker, request.variant, &mut renderer)?;
        let written = search(request, set, marker)?;
        remove(std::mem::take(&mut old), &written)?;
        done += 1;
    }
    if let Some(folder) = &request.photographs
        && done + 1 == of
        && begins(Step { name: "photographs", number: of, of }).is_continue()
    {
        let written = search_photographs(folder, results_in, &request.families)?;
        remove(std::mem::take(&mut old), &written)?;
        extra = report_photographs(folder, results_in)?;
        done += 1;
    }
    let is_interrupted = done < of;
    if done == 0 {
        // Files of an earlier run are not changed.
        let report = format!("Interrupted before the first of {of} sets and families.\n");
        return Ok(Findings { report, is_interrupted });
    }
    let runs = report::runs(sets_in, results_in)?;
    let mut text = match is_interrupted {
        true => format!("Interrupted after {done} of {of} sets and families.\n\n"),
        false => String::new(),
    };
    text += &results::origin(&request.command);
    text += &of_others(&runs, sets_in);
    if request.ids == Ids::Shown {
        text += "The id that a frame shows is known, as in a landing.\n\n";
    }
    text += &(report::text(&runs) + &extra);
    let in_common = common::rows(&runs);
    text += &common::markdown(&in_common);
    if !in_common.is_empty() {
        std::fs::write(results_in.join(common::FILE), csv(&in_common)?)?;
    }
    for table in tables::all(&runs) {
        text.push_str(&format!("\n{}", table.markdown));
        std::fs::write(results_in.join(format!("{}.csv", table.name)), table.csv)?;
    }
    for (name, binning) in FIGURES {
        if let Some(svg) = figures::svg(&runs, binning)? {
            std::fs::write(results_in.join(format!("{name}.svg")), svg)?;
        }
    }
    std::fs::write(results_in.join(REPORT), &text)?;
    let [lines, table] = SCORES;
    std::fs::write(results_in.join(lines), report::json_lines(&runs)?)?;
    std::fs::write(results_in.join(table), report::csv(&runs)?)?;
    Ok(Findings { report: text, is_interrupted })
}

/// Removes files of an earlier run that this one has not replaced.
fn remove(mut old: Vec<PathBuf>, written: &[PathBuf]) -> anyhow::Result<()> {
    old.retain(|path| !written.contains(path));
    for path in old {
        std::fs::remove_file(&path)
            .with_context(|| format!("removing {} of an earlier run", path.display()))?;
    }
    Ok(())
}

/// The results to which the command and the version at the report's head do not apply: other detectors, and frames of another version.
fn of_others(runs: &[Run], sets_in: &Path) -> String {
    let others: BTreeSet<&str> = runs.iter().map(|run| run.detector.as_str()).collect();
    let others: Vec<&str> = others.into_iter().filter(|name| !ALL_OURS.contains(name)).collect();
    let mut text = String::new();
    if !others.is_empty() {
        text += &format!(
            "The results of {} are of files that were there already.\n\n",
            others.join(", ")
        );
    }
    let mut versions: BTreeMap<String, BTreeSet<&str>> = BTreeMap::new();
    for run in runs.iter().filter(|run| run.detector == OURS) {
        let folder = sets_in.join(run.set.name());
        let folder = if run.set.has_marker() { folder.join(&run.family) } else { folder };
        versions.entry(store::rendered_by(&folder)).or_default().insert(run.set.name());
    }
    versions.remove(node::version());
    for (version, sets) in versions {
        let sets: Vec<&str> = sets.into_iter().collect();
        text += &format!(
            "**Frames of {} were there already, rendered by alight {version}; without the folder `sets` they are rendered again.**\n\n",
            sets.join(", ")
        );
    }
    text
}

/// A table as Markdown and as comma-separated values.
#[derive(Clone, Debug)]
pub struct Compared {
    /// The name of its files, without their endings.
    pub name: String,
    /// For people.
    pub markdown: String,
    /// For programs.
    pub csv: String,
}

/// Our recall and accuracy in several requests that were run, by processing, family and set.
///
/// # Errors
/// When results are damaged.
pub fn compared(requests: &[Request]) -> anyhow::Result<Compared> {
    let mut all = Vec::new();
    for request in requests {
        all.push((request, report::runs(&request.sets_in, &request.results_in)?));
    }
    let rows: Vec<OfProcessing<'_>> = all
        .iter()
        .flat_map(|(request, runs)| {
            let wanted = |run: &&Run| {
                run.detector == OURS
                    && request.sets.contains(&run.set)
                    && (request.families.is_empty() || request.families.contains(&run.family))
            };
            runs.iter().filter(wanted).map(|run| report::of_processing(&request.variant, run))
        })
        .collect();
    let name = requests.first().map_or_else(String::new, compared_name);
    Ok(Compared { name, markdown: report::by_processing(&rows), csv: csv(&rows)? })
}

/// The name of the files with the table by processing of such a request: the common parts of all rows.
pub fn compared_name(request: &Request) -> String {
    let Variant { seed, every, .. } = request.variant;
    let ids = if request.ids == Ids::Shown { "-known-id" } else { "" };
    let part = if every > 1 { format!("-every{every}") } else { String::new() };
    format!("by-processing-seed{seed}{part}{ids}")
}

fn sized(families: &[Family]) -> Vec<Marker> {
    let sized = |family: &Family| Marker { family: *family, id: None, size_m: Some(SIZE_M) };
    families.iter().map(sized).collect()
}

/// The markers of a set.
fn markers(request: &Request, set: Set) -> anyhow::Result<Vec<Marker>> {
    let wanted = |name: &&&str| {
        let family = name.split(':').next().unwrap_or_default();
        request.families.is_empty() || request.families.iter().any(|wanted| wanted == family)
    };
    let count = if set.has_marker() { MARKERS.len() } else { 1 };
    MARKERS
        .iter()
        .take(count)
        .filter(|name| !set.has_marker() || wanted(name))
        .map(|name| format!("{name}:{SIZE_M}").parse().with_context(|| (*name).to_owned()))
        .collect()
}

/// Searches a set, whose frames are there; the files that it has written.
fn search(request: &Request, set: Set, marker: Marker) -> anyhow::Result<Vec<PathBuf>> {
    let Request { sets_in, results_in, ids, .. } = request;
    let folder = store::folder(sets_in, set, marker);
    let mut written = Vec::new();
    if set.has_marker() {
        let any = Marker { id: None, ..marker };
        written.push(detect(results_in, set, marker.family.name(), &folder, &[any], *ids)?);
        written.extend(time(results_in, set, any, &folder)?);
    } else {
        for (name, families) in photographs::families_for_negatives() {
            written.push(detect(results_in, set, name, &folder, &sized(&families), Ids::Any)?);
        }
    }
    Ok(written)
}

/// Runs the detector over a set and writes the results into the file that is returned.
fn detect(
    results: &Path,
    set: Set,
    name: &str,
    folder: &Path,
    markers: &[Marker],
    ids: Ids,
) -> anyhow::Result<PathBuf> {
    let is_timed = matches!(set, Set::Textured | Set::Tracking);
    let runs = if is_timed { TIMED_RUNS } else { 1 };
    let answers = record::run(folder, markers, ids, runs)?;
    let file = record::file(results, OURS, set, name);
    record::write(&file, answers.iter().map(|(_, record)| record))?;
    Ok(file)
}

/// The timed sets, with all families at once and with tracking; the file that it has written.
fn time(
    results: &Path,
    set: Set,
    marker: Marker,
    folder: &Path,
) -> anyhow::Result<Option<PathBuf>> {
    const RATE_HZ: f64 = 30.0;
    let name = marker.family.name();
    if set == Set::Textured {
        let [(_, families), _] = photographs::families_for_negatives();
        let answers = record::run(folder, &sized(&families), Ids::Any, TIMED_RUNS)?;
        let file = record::file(results, ALL_AT_ONCE, set, name);
        record::write(&file, answers.iter().map(|(_, record)| record))?;
        return Ok(Some(file));
    }
    if set == Set::Tracking {
        let records = record::follow(folder, &[marker], RATE_HZ, TIMED_RUNS)?;
        let file = record::file(results, FOLLOWING, set, name);
        record::write(&file, &records)?;
        return Ok(Some(file));
    }
    Ok(None)
}

/// The folder of a detector's results on photographs.
const PHOTOGRAPHS: &str = "photographs";

/// Searches labelled photographs for these families (for all when none is given); the files that it has written.
fn search_photographs(
    folder: &Path,
    results: &Path,
    wanted: &[String],
) -> anyhow::Result<Vec<PathBuf>> {
    let mut written = Vec::new();
    for (_, name) in photographs::FAMILIES {
        if !wanted.is_empty() && !wanted.iter().any(|wanted| wanted == name) {
            continue;
        }
        if let Some(family) = Family::named(name) {
            let records = photographs::run(folder, family)?;
            let file = photographs_file(results, OURS, name);
            record::write(&file, &records)?;
            written.push(file);
        }
    }
    Ok(written)
}

/// The detections of these detectors in the labelled photographs.
fn recalls(
    folder: &Path,
    results: &Path,
    is_meant: &dyn Fn(&str) -> bool,
) -> anyhow::Result<photographs::Recalls> {
    let mut recalls: photographs::Recalls = BTreeMap::new();
    let mut detectors = report::detectors(results)?;
    detectors.retain(|name| is_meant(name));
    for detector in detectors {
        for (_, name) in photographs::FAMILIES {
            let file = photographs_file(results, &detector, name);
            let Ok(text) = std::fs::read_to_string(&file) else { continue };
            let records = record::parse(&file, &text)?;
            let recall = photographs::recall(folder, name, &records)
                .with_context(|| format!("reading {}", file.display()))?;
            recalls.entry(name.to_owned()).or_default().insert(detector.clone(), recall);
        }
    }
    Ok(recalls)
}

/// The labelled photographs in the report, and those without a marker, which are searched for every family.
fn report_photographs(folder: &Path, results: &Path) -> anyhow::Result<String> {
    let recalls = recalls(folder, results, &|_| true)?;
    let mut text = photographs::text(&recalls);
    text.push_str(&photographs::unsearched(folder)?);
    for (name, families) in photographs::families_for_negatives() {
        let (images, wrong) = photographs::negatives(folder, &families)?;
        text.push_str(&format!(
            "\nPhotographs without a marker and their parts, families `{name}`: {images}, with false detections: {}\n",
            wrong.len()
        ));
        for (image, found) in wrong {
            let names: Vec<String> = found
                .iter()
                .map(|f| {
                    let confidence = f.confidence.unwrap_or(f64::NAN);
                    format!("{}:{:?} confidence {confidence:.2}", f.family, f.id)
                })
                .collect();
            text.push_str(&format!("- {image}: {}\n", names.join(", ")));
        }
    }
    Ok(text)
}

fn photographs_file(results: &Path, detector: &str, family: &str) -> PathBuf {
    results.join(detector).join(PHOTOGRAPHS).join(format!("{family}.jsonl"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(folder: &Path, name: &str) {
        let path = folder.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "").unwrap();
    }

    #[test]
    fn a_used_folder_is_refused_and_other_files_are_never_removed() {
        let folder = tempfile::tempdir().unwrap();
        let mut request = Request::within(folder.path(), Variant::default(), Ids::Any);
        let results = request.results_in.clone();
        let kept = ["mine/far/rings.jsonl", "notes.md", "alight/notes/rings.jsonl"];
        kept.iter().for_each(|name| write(&results, name));
        check_unused(&request).unwrap();
        let ours = ["alight/far/rings.jsonl", "alight-all/textured/rings.jsonl", "report.md"];
        for name in ours.into_iter().chain(["table-a1.csv", "scores.csv", "figure-4-7.svg"]) {
            write(&results, name);
            let error = check_unused(&request).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("`--replace`"), "{error}");
            // Nothing is begun, nor is anything of the earlier run touched.
            let begun = run(&request, &mut |_| panic!("a set is begun")).unwrap_err().to_string();
            assert_eq!(begun, error);
            request.replaces = true;
            check_unused(&request).unwrap();
            let findings = run(&request, &mut |_| ControlFlow::Break(())).unwrap();
            assert!(findings.is_interrupted && results.join(name).exists(), "{findings:?}");
            remove(earlier(&results).unwrap(), &[]).unwrap();
            request.replaces = false;
            check_unused(&request).unwrap();
        }
        assert!(kept.iter().all(|name| results.join(name).exists()));
    }

    #[test]
    fn results_of_an_earlier_run_stay_until_there_are_new_ones() {
        let folder = tempfile::tempdir().unwrap();
        let mut request = Request {
            sets: vec![Set::Far],
            families: vec!["aruco-4x4-50".to_owned()],
            replaces: true,
            ..Request::within(folder.path(), Variant { every: 40, ..Variant::default() }, Ids::Any)
        };
        let results = request.results_in.clone();
        let old = "alight/cut/rings.jsonl";
        write(&results, old);
        let mut go = |_: Step<'_>| ControlFlow::Continue(());
        // A damaged frame, so that there is nothing new.
        let marker = format!("aruco-4x4-50:0:{SIZE_M}").parse().unwrap();
        let frames = store::folder(&request.sets_in, Set::Far, marker);
        let renderer = &mut FrameRenderer::default();
        store::make(&request.sets_in, Set::Far, marker, request.variant, renderer).unwrap();
        let image = frames.join(&store::frames(&frames).unwrap()[0].image);
        let pixels = std::fs::read(&image).unwrap();
        std::fs::write(&image, "no picture").unwrap();
        assert!(run(&request, &mut go).is_err() && results.join(old).exists());
        std::fs::write(&image, pixels).unwrap();
        // Faults of other detectors: an invalid line, a frame that is missing, a photograph that is missing.
        let mine = results.join("mine/far/aruco-4x4-50.jsonl");
        let refused = |request: &Request| {
            let error =
                format!("{:#}", run(request, &mut |_| panic!("a set is begun")).unwrap_err());
            assert!(results.join(old).exists(), "{error}");
            error
        };
        std::fs::create_dir_all(mine.parent().unwrap()).unwrap();
        for (text, wanted) in [("no line", "line 1 of "), ("", "no line for the frame")] {
            std::fs::write(&mine, text).unwrap();
            let error = refused(&request);
            assert!(error.contains(wanted) && error.contains("mine"), "{error}");
        }
        std::fs::remove_file(&mine).unwrap();
        let line = "{\"image\":\"a.png\",\"markers\":[{\"family\":\"apriltag-36h11\",\"id\":3,\"corners\":[[0,0],[9,0],[9,9],[0,9]]}]}";
        std::fs::write(folder.path().join("labels.jsonl"), line).unwrap();
        std::fs::write(folder.path().join("a.png"), "").unwrap();
        request.photographs = Some(folder.path().to_owned());
        write(&results, "mine/photographs/apriltag-36h11.jsonl");
        let error = refused(&request);
        let place = Path::new("mine").join(PHOTOGRAPHS).join("apriltag-36h11.jsonl");
        assert!(error.contains("no result for a.png"), "{error}");
        assert!(error.contains(&place.display().to_string()), "{error}");
        request.photographs = None;
        assert!(!run(&request, &mut go).unwrap().is_interrupted);
        assert!(!results.join(old).exists());
        assert!(results.join("alight/far/aruco-4x4-50.jsonl").exists());
        // The same again removes none of its own files.
        run(&request, &mut go).unwrap();
        assert!(results.join("alight/far/aruco-4x4-50.jsonl").exists());
    }

    #[test]
    fn a_report_names_results_that_were_there_before() {
        let folder = tempfile::tempdir().unwrap();
        let run = |detector: &str, set| Run {
            set,
            family: "rings".to_owned(),
            detector: detector.to_owned(),
            answers: Vec::new(),
        };
        let runs = [run(OURS, Set::Far), run(OURS, Set::Cut), run("mine", Set::Far)];
        for (set, version) in [("far", node::version()), ("cut", "0.0.9")] {
            let folder = folder.path().join(set).join("rings");
            std::fs::create_dir_all(&folder).unwrap();
            std::fs::write(folder.join(store::RENDERED_BY), version).unwrap();
        }
        let text = of_others(&runs, folder.path());
        assert!(text.contains("results of mine are of files"), "{text}");
        assert!(text.contains("Frames of cut were") && text.contains("alight 0.0.9"), "{text}");
        assert_eq!(of_others(&runs[..1], folder.path()), "");
    }
}
