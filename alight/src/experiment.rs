//! `alight experiment`: the options of its landings (wind, latency, height, vision, faults) and of its rendered markers (sets, families,
//! processing), the run of either, the comparison of two runs of landings (`compare`), and the report printed.

use std::ops::ControlFlow;
use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::{Context, bail};
use clap::{Args, Subcommand, ValueEnum};
use experiments::Preset;
use experiments::comparison::pairs::{Comparison, Run};
use experiments::comparison::report;
use experiments::landing::fault::Fault;
use experiments::landing::plan::{self, Plan, Values, Vision};
use experiments::landing::{self, Watch};
use experiments::markers::{Request, Step, check_unused, compared, compared_name};
use experiments::record::Ids;
use experiments::results::Folder;
use experiments::set::{Set, families};
use experiments::sets::Variant;
use markers::Marker;

use crate::args::{Format, JOBS, WrongUse, flight_setting, sized_marker, whole_number};
use crate::children::this_command;
use crate::faults::{self, FaultsArgs};
use crate::interruption::{FLIGHTS_END, Interruption};
use crate::progress::Steps;
use crate::runtime::cores;
use crate::terminal::{print, write_error};

#[derive(Args)]
pub(crate) struct ExperimentArgs {
    #[command(subcommand)]
    experiment: Experiment,
}

#[derive(Subcommand)]
enum Experiment {
    /// Find markers in rendered frames with ground truth (section 4.3 of the thesis, extended), and write
    /// tables and figures. Ctrl-C ends it with those of the sets that were searched, exit status 130.
    Markers(MarkersArgs),
    /// Fly hundreds of landings in lock-step, faster than real time: every combination of the listed values,
    /// with several seeds each; write tables, plots, and the command that repeats each failure (section 4.4
    /// of the thesis, extended). Ctrl-C ends it with the results of the flights that were flown, exit status 130.
    Landing(LandingArgs),
    /// Fly landings in which a process dies or stops, a link fails, or a component reports false values; write a table of
    /// the worst touchdowns, and the command that repeats each. Exit status 1 when one was unsafe or did not end. Ctrl-C ends
    /// it with the results of the flights that were flown, exit status 130 also when one of those was unsafe, which is printed.
    Faults(FaultsArgs),
    /// Put two finished runs of `alight experiment landing` side by side, for example of two guidances or markers: landed, touchdown error,
    /// time and speeds of each, and the differences of the pairs of flights with the same circumstances and seed, with the interval of
    /// their median and a sign test.
    Compare(CompareArgs),
}

#[derive(Args)]
struct LandingArgs {
    /// Output folder: report, every flight as CSV and JSON lines, plots.
    #[arg(short, long, value_name = "DIR", default_value = "experiment-landing")]
    output: PathBuf,
    /// Replace the results of an experiment that are in the output folder, once there are new ones; without it they are refused.
    #[arg(long)]
    replace: bool,
    /// Number of flights of each combination.
    #[arg(long, value_name = "N", default_value_t = 20, value_parser = whole_number::<u64>(1..=1_000_000))]
    flights: u64,
    /// Vision: rendered frames with the real detector, or a model of the detector's errors.
    #[arg(long, value_enum, default_value_t = VisionArg::Modelled)]
    vision: VisionArg,
    /// Mean wind in m/s: a value, a list 0,5,8, or a range 0..8 with a random value for each seed.
    #[arg(long, allow_hyphen_values = true, value_name = "M/S", default_value = "0,2,5,8")]
    wind: Values,
    /// Strength of the turbulence: 1 is that of ArduPilot's simulator with "turbulence 1". A list or range as
    /// well.
    #[arg(long, allow_hyphen_values = true, value_name = "STRENGTH", default_value = "1")]
    turbulence: Values,
    /// Latency from exposure to the arrival of detections, in milliseconds, with 25 % random jitter. A list
    /// or range as well.
    #[arg(long, allow_hyphen_values = true, value_name = "MS", default_value = "80")]
    latency: Values,
    /// Height at the start, in metres, from 0.1 to 100. A list or range as well.
    #[arg(long, allow_hyphen_values = true, value_name = "M", default_value = "10", value_parser = plan::heights)]
    height: Values,
    /// Horizontal distance from the pad at the start, in metres. A list or range as well.
    #[arg(long, allow_hyphen_values = true, value_name = "M", default_value = "2.12")]
    offset: Values,
    /// Fault; `all` for each of them that has an effect with the vision. May be repeated. An unknown name lists all.
    #[arg(long = "fault", value_name = "NAME", default_value = "none", value_parser = faults_named)]
    faults: Vec<Faults>,
    /// Marker to land on, of pad, detector and controller together: FAMILY:ID:SIZE_M, or FAMILY:SIZE_M for a family without ids. A pad that
    /// moves or heaves has it half as large again. Modelled vision has the errors of `rings` whatever the marker, of which only the size
    /// counts, and a warning reports that: compare markers with `--vision rendered`.
    #[arg(long, value_name = "MARKER", value_parser = sized_marker)]
    marker: Option<Marker>,
    /// One further setting: simulator.KEY=VALUE or controller.KEY=VALUE. May be repeated.
    #[arg(long, value_name = "SERVICE.KEY=VALUE", value_parser = flight_setting)]
    set: Vec<String>,
    /// Number of flights in parallel [default: number of cores].
    #[arg(long, value_name = "N", value_parser = whole_number::<usize>(JOBS))]
    jobs: Option<usize>,
    /// Number of the worst flights of each combination that are written as recordings (MCAP), for `alight report` and
    /// `alight replay`; 0 for none.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = whole_number::<usize>(0..=1_000_000))]
    recordings: usize,
    /// Seed of the first flight of each combination; the others follow.
    #[arg(long, value_name = "S", default_value_t = 1, value_parser = whole_number::<u64>(0..=u64::MAX))]
    seed: u64,
}

#[derive(Args)]
struct CompareArgs {
    /// The folders of the two runs, A and B.
    #[arg(value_name = "DIR", num_args = 2, required = true)]
    runs: Vec<PathBuf>,
    /// Write the report, `comparison.json` and `comparison.svg` into this folder as well.
    #[arg(short, long, value_name = "DIR")]
    output: Option<PathBuf>,
    /// Replace the results of an experiment that are in the output folder; without it they are refused.
    #[arg(long, requires = "output")]
    replace: bool,
    /// Format of the output: tables in Markdown, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum VisionArg {
    /// Rendered frames.
    Rendered,
    /// A model fitted to the detector.
    Modelled,
}

#[derive(Args)]
struct MarkersArgs {
    /// Working folder: frames in `sets`; results, tables and figures in `results`, with `--seed`, `--every` or `--processing` in a
    /// folder of that name. Existing frames are not rendered again.
    #[arg(short, long, value_name = "DIR", default_value = "experiment-markers")]
    output: PathBuf,
    /// Replace this detector's results of an earlier run, once there are new ones; without it a folder that has some is refused. Frames and
    /// the results of other detectors stay.
    #[arg(long)]
    replace: bool,
    /// Only this set: positions, far, landing, adverse, tilt, blur, noise, light, rolling, shade, ground, cut, textured,
    /// tracking, negatives or circles. May be repeated.
    #[arg(long = "set", value_name = "NAME")]
    sets: Vec<Set>,
    /// Only this family; of `--photographs` only apriltag-36h11 has some with a marker. May be repeated.
    #[arg(long = "family", value_name = "FAMILY", value_parser = family_name)]
    families: Vec<String>,
    /// Folder of photographs with `labels.jsonl`, to test on as well.
    #[arg(long, value_name = "DIR")]
    photographs: Option<PathBuf>,
    /// The camera's processing of the light on its sensor: linear (none), usb, raspberry-pi, industrial,
    /// action-camera, phone or ip-camera. May be repeated; then a table compares them.
    #[arg(long = "processing", value_name = "NAME", default_value = "linear")]
    processings: Vec<Preset>,
    /// Bin frames by software, 2 x 2 and 4 x 4, from those of the thesis' sensor with all its pixels and its colours
    /// (2592 x 1944, RGGB), instead of in the sensor. Only with `--set positions`.
    #[arg(long)]
    binned: bool,
    /// Look for the id that a frame shows, as a landing on that marker does, instead of any of its family. Results are in
    /// `results-known-id`.
    #[arg(long)]
    known_id: bool,
    /// Seed of poses, ids, grounds and noise. With 0 they are those on which the detector was developed.
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = whole_number::<u64>(0..=u64::MAX))]
    seed: u64,
    /// Only every Nth frame of each set.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=1000))]
    every: u32,
}

/// Runs the experiment and prints its report.
pub(crate) fn run(args: ExperimentArgs) -> anyhow::Result<ExitCode> {
    match args.experiment {
        Experiment::Markers(args) => run_markers(args),
        Experiment::Landing(args) => run_landing(args),
        Experiment::Faults(args) => faults::run(args),
        Experiment::Compare(args) => run_compare(&args),
    }
}

/// One fault, or all.
#[derive(Clone, Copy, Debug)]
enum Faults {
    All,
    One(Fault),
}

fn faults_named(text: &str) -> Result<Faults, String> {
    match text {
        "all" => Ok(Faults::All),
        name => Ok(Faults::One(name.parse()?)),
    }
}

/// The faults that are meant, for flights with this vision.
///
/// # Errors
/// When a named fault has no effect with it: its flights would be reported as survived.
fn faults_meant(named: &[Faults], vision: Vision) -> Result<Vec<Fault>, String> {
    let mut meant = Vec::new();
    for faults in named {
        match *faults {
            Faults::All => meant.extend(Fault::all().filter(|fault| fault.works_in(vision))),
            Faults::One(fault) if fault.works_in(vision) => meant.push(fault),
            Faults::One(fault) => {
                return Err(format!(
                    "`--fault {}` has no effect with `--vision {}`; take the other vision",
                    fault.name(),
                    vision.name()
                ));
            }
        }
    }
    Ok(meant)
}

/// Prints the faults that `all` leaves out.
fn print_left_out(named: &[Faults], vision: Vision) {
    let left_out = Fault::all().filter(|fault| !fault.works_in(vision)).map(Fault::name);
    if named.iter().any(|faults| matches!(faults, Faults::All)) {
        write_error(&format!(
            "not flown, as they have no effect with `--vision {}`: {}",
            vision.name(),
            left_out.collect::<Vec<_>>().join(", ")
        ));
    }
}

/// A family that has frames.
fn family_name(text: &str) -> Result<String, String> {
    let names: Vec<&str> = families().collect();
    match names.contains(&text) {
        true => Ok(text.to_owned()),
        false => Err(format!("the families that are compared are {}", names.join(", "))),
    }
}

fn run_landing(args: LandingArgs) -> anyhow::Result<ExitCode> {
    plan::refuse_swept(&args.set, &plan::SWEPT).map_err(WrongUse)?;
    let vision = match args.vision {
        VisionArg::Rendered => Vision::Rendered,
        VisionArg::Modelled => Vision::Modelled,
    };
    let faults = faults_meant(&args.faults, vision).map_err(WrongUse)?;
    print_left_out(&args.faults, vision);
    let request = plan::Request {
        command: this_command(),
        plan: Plan {
            vision,
            flights: args.flights,
            seed: args.seed,
            wind: args.wind,
            turbulence: args.turbulence,
            latency: args.latency,
            height: args.height,
            offset: args.offset,
            faults,
            marker: args.marker,
            set: args.set,
        },
        jobs: args.jobs.unwrap_or_else(cores),
        recordings: args.recordings,
    };
    request.plan.check()?;
    request.plan.check_marker().map_err(WrongUse)?;
    let mut folder = Folder::claim(&args.output, args.replace)?;
    faults::warn_if_only_size_counts(
        vision,
        &plan::settings_text(request.plan.marker.as_ref(), &request.plan.set),
    );
    let interruption = Interruption::on_signals(FLIGHTS_END)?;
    let steps = Steps::of_flights();
    let watch = Watch {
        progress: &|done, of| steps.flown(done, of),
        is_interrupted: &|| interruption.is_requested(),
    };
    let landings = landing::run(&request, &mut folder, watch)
        .with_context(|| format!("working in {}", folder.path().display()))?;
    steps.finish();
    print(landings.report.trim_end())?;
    if landings.flown > 0 {
        write_error(&format!("flights, plots and this report: {}", folder.path().display()));
    }
    Ok(interruption.exit_code())
}

fn run_compare(args: &CompareArgs) -> anyhow::Result<ExitCode> {
    let [first, second] = args.runs.as_slice() else {
        return Err(WrongUse("name the folders of two runs".to_owned()).into());
    };
    let comparison = Comparison::new(&Run::read(first)?, &Run::read(second)?)?;
    let command = this_command();
    if let Some(output) = &args.output {
        // Replacing the folder's files would remove the flights that were read.
        let output_is = |run: &PathBuf| run.canonicalize().ok() == output.canonicalize().ok();
        if output.exists() && args.runs.iter().any(output_is) {
            let rule = "`-o` is the folder of one of the runs; name another one";
            return Err(WrongUse(rule.to_owned()).into());
        }
        let mut folder = Folder::claim(output, args.replace)?;
        report::write(&mut folder, &comparison, &command)?;
        write_error(&format!("this report, JSON and a plot: {}", folder.path().display()));
    }
    match args.format {
        Format::Text => print(report::text(&comparison, &command).trim_end())?,
        Format::Json => print(&serde_json::to_string(&comparison)?)?,
    }
    Ok(ExitCode::SUCCESS)
}

fn run_markers(args: MarkersArgs) -> anyhow::Result<ExitCode> {
    if args.binned && (args.processings != [Preset::Linear] || args.sets != [Set::Positions]) {
        let rule = "`--binned` is for `--set positions` and `--processing linear`: the thesis' frames, of a camera that gives out raw ones";
        return Err(WrongUse(rule.to_owned()).into());
    }
    let ids = if args.known_id { Ids::Shown } else { Ids::Any };
    let sets = if args.sets.is_empty() { Set::ALL.to_vec() } else { args.sets };
    let mut photographs = args.photographs;
    let requests: Vec<Request> = args
        .processings
        .iter()
        .map(|processing| {
            let variant = Variant {
                seed: args.seed,
                processing: *processing,
                every: args.every as usize,
                is_binned: args.binned,
            };
            Request {
                command: this_command(),
                sets: sets.clone(),
                families: args.families.clone(),
                // They have been through a camera already: once is enough.
                photographs: photographs.take(),
                replaces: args.replace,
                ..Request::within(&args.output, variant, ids)
            }
        })
        .collect();
    requests.iter().try_for_each(check_unused)?;
    if let [first, _, ..] = requests.as_slice() {
        let table = args.output.join(format!("{}.csv", compared_name(first)));
        if table.exists() && !args.replace {
            bail!(
                "{} is there already; name another folder with `-o`, or replace it with `--replace`",
                table.display()
            );
        }
    }
    let interruption = Interruption::on_signals("the set under way is still searched")?;
    let steps = Steps::of_names();
    let mut done = Vec::new();
    for request in requests {
        let mut begins = |step: Step<'_>| {
            if interruption.is_requested() {
                return ControlFlow::Break(());
            }
            steps.begins(&format!("{} {step}", request.variant.processing));
            ControlFlow::Continue(())
        };
        let findings = experiments::markers::run(&request, &mut begins)
            .with_context(|| format!("working in {}", args.output.display()))?;
        steps.suspended(|| print(&findings.report))?;
        write_error(&format!("tables and figures: {}", request.results_in.display()));
        done.push(request);
        if findings.is_interrupted {
            break;
        }
    }
    steps.finish();
    if done.len() > 1 {
        let table = compared(&done)?;
        for (ending, text) in [("md", table.markdown.trim_start()), ("csv", table.csv.as_str())] {
            let path = args.output.join(format!("{}.{ending}", table.name));
            std::fs::write(&path, text).with_context(|| format!("writing {}", path.display()))?;
        }
        print(&table.markdown)?;
        write_error(&format!("that table: {}.md and .csv", args.output.join(table.name).display()));
    }
    Ok(interruption.exit_code())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use clap::Parser;
    use experiments::faults::kind::Kind;
    use experiments::faults::plan as faults_plan;

    use super::*;

    #[derive(Parser)]
    struct Tool {
        #[command(subcommand)]
        command: ToolCommand,
    }

    #[derive(Subcommand)]
    enum ToolCommand {
        Experiment(ExperimentArgs),
    }

    /// A setting that a shell would take apart.
    const QUOTED: &str = "controller.detectors.preferred=\"it's main\"";

    /// The folder into which such a command writes.
    fn output(command: &str) -> PathBuf {
        let words = shlex::split(command).unwrap_or_default();
        let tool = Tool::try_parse_from(words).unwrap_or_else(|problem| {
            panic!("{command}: {problem}");
        });
        let ToolCommand::Experiment(args) = tool.command;
        match args.experiment {
            Experiment::Landing(args) => args.output,
            Experiment::Faults(args) => args.output,
            Experiment::Markers(args) => args.output,
            Experiment::Compare(args) => args.output.unwrap_or_default(),
        }
    }

    #[test]
    fn a_setting_that_results_are_sorted_by_and_a_family_without_frames_are_refused() {
        let refusal_text = |setting: &str| {
            let refusal = plan::refuse_swept(&[setting.to_owned()], &plan::SWEPT).err();
            refusal.unwrap_or_default()
        };
        assert!(refusal_text("simulator.wind.mean_m_s=7").contains("`--wind`"));
        assert!(refusal_text("simulator.camera.latency_ms=400").contains("`--latency`"));
        assert_eq!(refusal_text("simulator.camera.rate_hz=20"), "");
        assert_eq!(refusal_text(QUOTED), "");
        assert_eq!(family_name("aruco-4x4-50").as_deref(), Ok("aruco-4x4-50"));
        for other in ["aruco", "apriltag-36h11:7", "bogus"] {
            assert!(family_name(other).unwrap_err().contains("stag-hd23"), "{other}");
        }
    }

    #[test]
    fn a_range_that_begins_above_its_end_is_a_wrong_use() {
        for (option, range) in [("--wind", "8..2"), ("--height", "12..4"), ("--offset", "3..1")] {
            let problem = Tool::try_parse_from(["alight", "experiment", "landing", option, range]);
            let problem = problem.err().unwrap();
            assert_eq!(problem.exit_code(), 2, "{problem}");
            assert!(problem.to_string().contains("begins above its end"), "{problem}");
        }
    }

    #[test]
    fn a_marker_that_no_pad_can_have_is_refused() {
        assert!(sized_marker("apriltag-36h11:7:0.15").is_ok() && sized_marker("rings:0.3").is_ok());
        for wrong in
            ["apriltag-36h11", "apriltag-36h11:7", "apriltag-36h11:*:0.15", "rings", "x:1:1"]
        {
            assert!(sized_marker(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn faults_without_an_effect_are_refused_by_name_and_left_out_of_all() {
        let meant = |name: &str, vision| {
            let faults = faults_meant(&[faults_named(name).unwrap()], vision)?;
            Ok::<_, String>(faults.into_iter().map(Fault::name).collect::<Vec<_>>())
        };
        for (vision, works, does_not) in
            [(Vision::Modelled, "lie", "glare"), (Vision::Rendered, "glare", "lie")]
        {
            assert_eq!(meant(works, vision).unwrap(), [works]);
            assert!(meant(does_not, vision).unwrap_err().contains(does_not));
            let all = meant("all", vision).unwrap();
            assert!(all.contains(&"none") && all.contains(&works) && !all.contains(&does_not));
        }
    }

    #[test]
    fn the_command_that_repeats_a_flight_is_accepted_and_has_a_folder_of_its_own() {
        let landings = Plan {
            flights: 2,
            faults: Fault::all().collect(),
            set: vec!["simulator.camera.rate_hz=20".to_owned(), QUOTED.to_owned()],
            ..Plan::default()
        };
        let lockstep = faults_plan::Plan {
            flights: 60,
            durations_s: vec![f64::INFINITY],
            set: vec![QUOTED.to_owned()],
            ..faults_plan::Plan::default()
        };
        let real_time = faults_plan::Plan {
            flights: 30,
            kinds: Kind::in_real_time().collect(),
            second: faults_plan::Second::None,
            real_time: true,
            ..faults_plan::Plan::default()
        };
        let commands = |plan: &faults_plan::Plan| {
            plan.flights().iter().map(faults_plan::Planned::command).collect()
        };
        let commands: [(&str, Vec<String>); 3] = [
            ("experiment landing", landings.flights().iter().map(plan::Planned::command).collect()),
            ("experiment faults", commands(&lockstep)),
            ("experiment faults", commands(&real_time)),
        ];
        for (campaign, commands) in commands {
            let of_campaign = output(&format!("alight {campaign}"));
            let outputs: BTreeSet<PathBuf> = commands.iter().map(|it| output(it)).collect();
            assert!(!outputs.contains(&of_campaign), "{outputs:?}");
            assert_eq!(outputs.len(), commands.len(), "two have one folder");
        }
    }
}
