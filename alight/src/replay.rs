//! `alight replay`: verifies the controller's tapes in a recording, flies them again with other settings, or searches its frames again, and
//! prints the differences.

mod live;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use flightlog::{RecordedTape, TapeReader};
use messages::Phase;
use node::stats::quantile;
use replay::{Again, Begun, Change, End, Searched, change, of_unused_guidance, search, verify};

use crate::args::{NetworkArgs, WrongUse};
use crate::terminal::{aligned, print, write_error};

#[derive(Args)]
pub(crate) struct ReplayArgs {
    /// The recording, an MCAP file; of a recording in several files all, in any order.
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Compare the result of each event with the recorded one, to the bit. The first event that gives another result is named, with the
    /// value. Exit status 0 when there is none, 1 otherwise.
    #[arg(long)]
    verify: bool,
    /// The data with which it is flown again: the controller's events, whose phases are listed; from detections on, with estimator and
    /// guidance, to see the effect of `--set` (with `--set`, events are the same); or from frames on, which are searched again. The vehicle
    /// moves as it was recorded. `--verify` is from events.
    #[arg(long, value_enum, default_value_t)]
    from: From,
    /// One setting of the controller over the recorded configuration, as KEY=VALUE or controller.KEY=VALUE; with `--from frames` also
    /// detector.KEY=VALUE, one of the detector. May be repeated.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// With `--from frames`, the detector whose frames are searched again with its recorded configuration, where the
    /// recording has several.
    #[arg(long, value_name = "NAME")]
    detector: Option<String>,
    /// Publish the recorded messages on the network, at the recorded pace and with present stamps: to a dashboard, a
    /// gcs-bridge with its ground station, a viewer, or a detector to try. Nothing is sent to an autopilot. Exit status 1 when
    /// a part of the recording is damaged or a picture cannot be read, which is left out.
    #[arg(long, conflicts_with_all = ["verify", "from", "set", "detector"])]
    live: bool,
    /// With `--live`, a service whose messages are left out, as one that runs takes its place. May be repeated.
    #[arg(long, value_name = "SERVICE", requires = "live")]
    without: Vec<String>,
    #[command(flatten)]
    network: NetworkArgs,
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
enum From {
    /// All that the controller handled.
    #[default]
    Events,
    /// Detections.
    Detections,
    /// Frames, as far as their pictures were recorded.
    Frames,
}

/// Prefixes of the settings of a service.
const OF_CONTROLLER: &str = "controller.";
const OF_DETECTOR: &str = "detector.";

impl ReplayArgs {
    /// Whether its options go together.
    fn check(&self) -> Result<(), WrongUse> {
        let rule = if self.detector.is_some() && self.from != From::Frames {
            "`--detector` is for `--from frames`"
        } else if self.from != From::Frames && self.set.iter().any(|it| it.starts_with(OF_DETECTOR))
        {
            "`--set detector.KEY=VALUE` is for `--from frames`: nothing else searches"
        } else if self.verify && self.from != From::Events {
            "`--verify` compares the results of the recorded events: without `--from`, or with `--from events`"
        } else {
            return Ok(());
        };
        Err(WrongUse(rule.to_owned()))
    }

    /// The detector and the settings for the search. Settings of the controller may have its name before them, as in `alight land`, or not.
    fn again(&self) -> Again {
        let mut again = Again { detector: self.detector.clone(), ..Again::default() };
        for setting in &self.set {
            if let Some(setting) = setting.strip_prefix(OF_DETECTOR) {
                again.of_detector.push(setting.to_owned());
            } else {
                let setting = setting.strip_prefix(OF_CONTROLLER).unwrap_or(setting);
                again.of_controller.push(setting.to_owned());
            }
        }
        again
    }
}

/// Replays, and prints the result: a failure if a part of the recording could not be replayed or gives another result.
pub(crate) fn run(args: &ReplayArgs) -> anyhow::Result<ExitCode> {
    args.check()?;
    let mut reader = TapeReader::default();
    let mut recordings = Vec::new();
    let mut files_of = BTreeMap::<i64, Vec<String>>::new();
    for file in &args.files {
        let recording = std::fs::read(file).with_context(|| format!("reading {file:?}"))?;
        reader.read(&recording).with_context(|| format!("{file:?} is no recording (MCAP file)"))?;
        if args.files.len() > 1 {
            let mut only = TapeReader::default();
            only.read(&recording)?;
            for tape in only.tapes() {
                files_of.entry(tape.begun_ns).or_default().push(file.display().to_string());
            }
        }
        if args.live || args.from == From::Frames {
            recordings.push(recording);
        }
    }
    if args.live {
        return live::run(recordings, &args.without, &args.network);
    }
    let damage = reader.damage().to_vec();
    damage.iter().for_each(|damage| write_error(damage));
    let mut is_complete = damage.is_empty();
    let tapes = reader.tapes();
    let again = args.again();
    let unused: BTreeSet<String> =
        tapes.iter().filter_map(|tape| of_unused_guidance(tape, &again.of_controller)).collect();
    unused.iter().for_each(|setting| write_error(setting));
    if args.from == From::Frames {
        is_complete &= from_frames(&recordings, &tapes, &again)?;
        return Ok(if is_complete { ExitCode::SUCCESS } else { ExitCode::FAILURE });
    }
    ensure!(
        !tapes.is_empty() || damage.is_empty(),
        "no tape of a controller can be read in {:?}: {}",
        args.files,
        damage.join("; ")
    );
    ensure!(
        !tapes.is_empty(),
        "there is no tape of a controller in {:?}; `alight land --record` and `alight record` keep it",
        args.files
    );
    for (index, tape) in tapes.iter().enumerate() {
        if tapes.len() > 1 {
            print(&heading(index + 1, tapes.len(), files_of.get(&tape.begun_ns)))?;
        }
        is_complete &= one(tape, args, &again.of_controller)?;
    }
    Ok(if is_complete { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Searches the frames again, and prints the differences; true when all pictures could be read and all tapes replayed.
fn from_frames(
    recordings: &[Vec<u8>],
    tapes: &[RecordedTape],
    again: &Again,
) -> anyhow::Result<bool> {
    let searched = search(recordings, tapes, again)?;
    print(compared(&searched).trim_end())?;
    for change in &searched.changes {
        print(&change_text(change))?;
        if let Some(stop) = &change.end.stop {
            print(&stop.to_string())?;
        }
    }
    Ok(is_complete(&searched))
}

/// Whether every picture of a frame that was searched then could be read, and every tape be replayed to its end.
fn is_complete(searched: &Searched) -> bool {
    searched.unreadable == 0 && searched.changes.iter().all(|change| change.end.stop.is_none())
}

/// The difference between two searches of the same frames, for people.
fn compared(searched: &Searched) -> String {
    let Searched { then, now, .. } = searched;
    let lossy = if searched.is_lossy { ", as JPEG files" } else { "" };
    let mut text = format!(
        "{} of the {} frames of camera {} that detector {} searched were recorded{lossy}, and searched again\n",
        searched.searched, searched.searched_then, searched.camera, searched.detector
    );
    if searched.unreadable > 0 {
        text.push_str(&format!("{} pictures cannot be read\n", searched.unreadable));
    }
    let fraction = |part: usize, of: usize| match of {
        0 => "-".to_owned(),
        of => format!("{:.1} % ({part} of {of})", 100.0 * part as f64 / of as f64),
    };
    let at = |values: &[f64], part: f64, factor: f64, digits: usize, unit: &str| {
        let value = quantile(values, part).map(|it| it * factor);
        value.map_or("-".to_owned(), |it| format!("{it:.digits$} {unit}"))
    };
    let mut rows = vec![["".into(), "then".into(), "now".into()]];
    let looked_for = |markers: &[String]| match markers {
        [] => "-".to_owned(),
        markers => markers.join(", "),
    };
    let [looked_for_then, looked_for_now] =
        [&searched.looked_for_then, &searched.looked_for].map(|it| looked_for(it));
    rows.push(["markers that were searched".into(), looked_for_then, looked_for_now]);
    let mut row = |name: &str, of: &dyn Fn(&replay::frames::Found) -> String| {
        rows.push([name.into(), of(then), of(now)]);
    };
    row("marker of the landing", &|it| it.marker.clone());
    row("found", &|it| fraction(it.frames, searched.searched));
    if let Some(showing) = searched.showing_the_pad {
        row("found in flight, pad in the picture", &|it| fraction(it.visible, showing));
        row("error in space, median", &|it| at(&it.errors_m, 0.5, 1e3, 2, "mm"));
        row("error in space, 95 %", &|it| at(&it.errors_m, 0.95, 1e3, 2, "mm"));
    }
    row("time of a search, median", &|it| at(&it.times_ms, 0.5, 1.0, 2, "ms"));
    row("time of a search, 95 %", &|it| at(&it.times_ms, 0.95, 1.0, 2, "ms"));
    text.push_str(&aligned(&rows));
    text.push_str(&format!(
        "{} found then only, {} now only; the two are {} apart in the median, {} at most\n",
        searched.lost,
        searched.gained,
        at(&searched.apart_m, 0.5, 1e3, 2, "mm"),
        at(&searched.apart_m, 1.0, 1e3, 2, "mm")
    ));
    let compared = searched.apart_m.len();
    text.push_str(&match searched.showing_the_pad {
        Some(_) => format!(
            "errors (from the true pad, in all three directions) and distances are of the {compared} frames in flight, with the pad in the picture, in which both found the marker with its pose\n"
        ),
        None => format!("distances are of the {compared} frames in which both found the marker with its pose\n"),
    });
    let family = now.marker.split(':').next().unwrap_or_default();
    let looks_for_it = |marker: &String| marker.split(':').next() == Some(family);
    if now.frames == 0 && !searched.looked_for.iter().any(looks_for_it) {
        text.push_str(&format!(
            "the detector looks for {} (`--set detector.markers=...`), the controller wants {} (`--set marker=...`)\n",
            searched.looked_for.join(", "),
            now.marker
        ));
    }
    text
}

/// The heading of one of several tapes, with the files that have parts of it, if there are several files.
fn heading(number: usize, count: usize, files: Option<&Vec<String>>) -> String {
    let files = files.map_or_else(String::new, |files| format!(", in {}", files.join(" and ")));
    format!("Tape {number} of {count}{files}:")
}

/// Replays one controller's tape; true when nothing is wrong with it.
fn one(tape: &RecordedTape, args: &ReplayArgs, set: &[String]) -> anyhow::Result<bool> {
    let began = Instant::now();
    let mut other_state = None;
    let end = if args.verify {
        let verdict = verify(tape, set)?;
        other_state = verdict.other_state;
        verdict.end
    } else {
        let change = change(tape, set)?;
        for begun in &change.phases {
            print(&format!("{:9.3} s  {:<16}  {}", begun.time_s, begun.phase, begun.why))?;
        }
        if args.from != From::Events || !set.is_empty() {
            print(&change_text(&change))?;
            if change.other_phase > 0 && ends_with_pilot(&change.phases) {
                print(RECORDED_MODES)?;
            }
        }
        change.end
    };
    let took_s = began.elapsed().as_secs_f64().max(1e-9);
    let ours = (controller::tape::program(), controller::tape::build());
    if (&end.program, &end.build) != (&ours.0, &ours.1) && !end.program.is_empty() {
        let (program, build) = ours;
        let End { program: theirs, build: their_build, .. } = &end;
        print(&format!("recorded by {theirs} ({their_build}), replayed by {program} ({build})"))?;
    }
    let done = if args.verify { "verified" } else { "replayed" };
    print(&format!(
        "{done} {} events, {:.1} s of flight, {:.0} x real time",
        end.events,
        end.flight_s,
        end.flight_s / took_s
    ))?;
    if let Some(other_state) = &other_state {
        print(&other_state.to_string())?;
    }
    if let Some(stop) = &end.stop {
        print(&stop.to_string())?;
    } else if !end.is_ended {
        print("the tape has no end: the controller was killed, or the end was not recorded")?;
    }
    Ok(end.stop.is_none() && other_state.is_none())
}

/// Why a landing that is replayed with other settings may end in the phase of a pilot although no pilot flew.
const RECORDED_MODES: &str = "pilot-in-command may come from the recording: its autopilot changes modes when the recorded landing asked for them, and this landing did not ask then; fly it (`alight land --set ...`) to see its end";

fn ends_with_pilot(phases: &[Begun]) -> bool {
    phases.last().is_some_and(|begun| begun.phase == Phase::PilotInCommand)
}

fn change_text(change: &Change) -> String {
    let Some(first_s) = change.first_s else {
        return match change.other_outputs {
            0 => "no decision is another one".to_owned(),
            count => format!(
                "no decision is another one; packets for the autopilot or replies are, at {count} of {} events",
                change.end.events
            ),
        };
    };
    format!(
        "other decisions at {} of {} events, the first at {first_s:.3} s; another phase at {} events\n\
         velocity setpoints differ by {:.3} m/s at most, {:.3} m/s root mean square; the estimated landing point by {:.3} m at most",
        change.different,
        change.end.events,
        change.other_phase,
        change.max_velocity_m_s,
        change.rms_velocity_m_s,
        change.max_target_m
    )
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;
    use messages::{Message as _, Tape, TapeEvent, TapeOutput, TapeWriter, encode, topic};

    #[test]
    fn a_marker_that_the_detector_does_not_look_for_is_reported() {
        let searched = |marker: &str| Searched {
            looked_for: vec!["rings:0.15341".to_owned(), "stag-hd23:4:0.2".to_owned()],
            now: replay::frames::Found { marker: marker.to_owned(), ..Default::default() },
            ..Searched::default()
        };
        let text = compared(&searched("aruco-4x4-50:7"));
        assert!(text.contains("looks for rings:0.15341, stag-hd23:4:0.2"), "{text}");
        for marker in ["rings", "stag-hd23:4"] {
            assert!(!compared(&searched(marker)).contains("looks for"), "{marker}");
        }
    }

    #[test]
    fn the_markers_that_were_searched_are_shown_next_to_that_of_the_landing() {
        let found = || replay::frames::Found { marker: "rings".to_owned(), ..Default::default() };
        let text = compared(&Searched {
            looked_for_then: vec!["rings:0.15341".to_owned()],
            looked_for: vec!["apriltag-36h11:7:0.15".to_owned()],
            then: found(),
            now: found(),
            ..Searched::default()
        });
        let row = text.lines().find(|line| line.starts_with("markers that were searched"));
        let words: Vec<_> = row.unwrap_or_default().split_whitespace().skip(4).collect();
        assert_eq!(words, ["rings:0.15341", "apriltag-36h11:7:0.15"], "{text}");
    }

    #[test]
    fn other_decisions_are_counted_by_the_events_at_which_they_are() {
        let change =
            Change { different: 3, first_s: Some(1.5), other_phase: 2, ..Change::default() };
        let text = change_text(&change);
        assert!(text.contains("other decisions at 3 of 0 events"), "{text}");
        assert!(text.contains("another phase at 2 events"), "{text}");
    }

    #[test]
    fn each_of_several_tapes_has_a_heading_with_its_files() {
        let files = vec!["a.mcap".to_owned(), "a-2.mcap".to_owned()];
        assert_eq!(heading(1, 2, Some(&files)), "Tape 1 of 2, in a.mcap and a-2.mcap:");
        assert_eq!(heading(2, 2, None), "Tape 2 of 2:");
    }

    #[test]
    fn errors_are_reported_with_their_number_of_frames() {
        let side = |errors_m: &[f64]| replay::frames::Found {
            errors_m: errors_m.to_vec(),
            ..Default::default()
        };
        let searched = Searched {
            showing_the_pad: Some(5),
            apart_m: vec![0.001; 3],
            then: side(&[0.001, 0.0014, 0.002]),
            now: side(&[0.001, 0.0062, 0.009]),
            ..Searched::default()
        };
        let text = compared(&searched);
        assert!(text.contains("error in space, median") && text.contains("1.40 mm"), "{text}");
        assert!(text.contains("6.20 mm") && text.contains("of the 3 frames in flight"), "{text}");
        let without_truth = compared(&Searched { showing_the_pad: None, ..searched });
        assert!(!without_truth.contains("error"), "{without_truth}");
        assert!(without_truth.contains("of the 3 frames in which both"), "{without_truth}");
    }

    #[test]
    fn pictures_that_cannot_be_read_and_tapes_that_stop_are_losses() {
        assert!(is_complete(&Searched::default()));
        assert!(!is_complete(&Searched { unreadable: 1, ..Searched::default() }));
        let stopped = |stop| {
            let end = End { stop, ..End::default() };
            Searched { changes: vec![Change { end, ..Change::default() }], ..Searched::default() }
        };
        assert!(is_complete(&stopped(None)));
        assert!(!is_complete(&stopped(Some(replay::Stop::NoBeginning { first: 3 }))));
    }

    #[test]
    fn from_events_is_a_plain_replay_which_may_be_verified() {
        let parsed = |words: &[&str]| {
            let words = ["replay", "flight.mcap"].iter().chain(words);
            Program::try_parse_from(words).map(|program| program.args)
        };
        let plain = parsed(&[]).unwrap();
        assert_eq!(plain.from, From::Events);
        for words in [&["--from", "events"][..], &["--verify"], &["--verify", "--from", "events"]] {
            let args = parsed(words).unwrap();
            assert!(args.from == plain.from && args.check().is_ok(), "{words:?}");
        }
        assert!(parsed(&["--verify", "--from", "frames"]).unwrap().check().is_err());
        assert!(parsed(&["--live"]).is_ok() && parsed(&["--live", "--from", "events"]).is_err());
    }

    #[test]
    fn a_setting_may_have_its_services_name_before_it() {
        let parsed = |words: &[&str]| {
            let words = ["replay", "flight.mcap"].iter().chain(words);
            Program::try_parse_from(words).unwrap().args
        };
        let all = ["--set", "controller.marker=rings", "--set", "metric.lateral_gain=1.2"];
        let args = parsed(&all);
        assert!(args.check().is_ok());
        assert_eq!(args.again().of_controller, ["marker=rings", "metric.lateral_gain=1.2"]);
        // Of the controller's own `detectors` as well.
        let args = parsed(&["--set", "detectors.tolerance_m=0.2"]);
        assert!(args.check().is_ok() && args.again().of_detector.is_empty());
        let detector = ["--set", "detector.thorough=true"];
        let problem = parsed(&detector).check().unwrap_err();
        assert!(problem.to_string().contains("is for `--from frames`"), "{problem}");
        let args = parsed(&[&detector[..], &["--from", "frames"]].concat());
        assert!(args.check().is_ok());
        assert_eq!(args.again().of_detector, ["thorough=true"]);
    }

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: ReplayArgs,
    }

    #[test]
    fn a_tape_of_another_version_is_no_missing_one() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("flight.mcap");
        let refused = |payload: Option<&[u8]>| {
            let mut recording = Vec::new();
            let about = flightlog::About::default();
            let mut writer = flightlog::Writer::new(&mut recording, &about).unwrap();
            if let Some(payload) = payload {
                let key = topic::TAPE.key(&[]);
                let message =
                    flightlog::Received { key: &key, payload, attachment: b"", received_ns: 9 };
                writer.receive(message).unwrap();
            }
            writer.finish().unwrap();
            std::fs::write(&file, recording).unwrap();
            let text = ["replay".as_ref(), file.as_os_str(), "--verify".as_ref()];
            run(&Program::try_parse_from(text).unwrap().args).unwrap_err().to_string()
        };
        let mut tape = TapeWriter::new(3);
        tape.write(4, &TapeEvent::Tick, &TapeOutput::default());
        let mut payload = encode(&tape.take().unwrap());
        // After the mark of our messages and their type.
        payload[2] = Tape::VERSION - 1;
        let problem = refused(Some(&payload));
        let said = format!("({}; this program reads {})", Tape::VERSION - 1, Tape::VERSION);
        assert!(problem.contains(&said) && !problem.contains("there is no tape"), "{problem}");
        assert!(refused(None).contains("there is no tape"));
    }
}
