//! `alight calibrate flight`: from a recorded landing the camera's time offset, mount angles, focal length and k1, printed
//! quantity by quantity with deviation, verdict and the key to change.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use calibration::{FlightCalibration, FlightEstimate, Quantity, calibrate_flight};
use clap::Args;
use media::write_atomically;
use serde_json::{Value, json};

use super::corrected::{self, Before, Changes};
use super::recorded::{self, RecordedFlight, Wanted};
use crate::args::Format;
use crate::ending::toml_file;
use crate::terminal::{print, write_error};

/// The arguments of `alight calibrate flight`.
#[derive(Args)]
pub(crate) struct FlightArgs {
    /// The recording of a landing (MCAP), from `alight land --record` or `alight record`.
    #[arg(value_name = "FLIGHT.mcap")]
    file: PathBuf,
    /// The camera, where there are several [default: the one that saw the marker most].
    #[arg(long, value_name = "CAMERA")]
    camera: Option<String>,
    /// The detector, where there are several [default: the one that saw the marker most].
    #[arg(long, value_name = "DETECTOR")]
    detector: Option<String>,
    /// The marker, FAMILY or FAMILY:ID [default: the one that was landed on].
    #[arg(long, value_name = "MARKER")]
    marker: Option<String>,
    /// Write the keys that change, as tables of camera-pub's configuration (TOML).
    #[arg(short, long, value_name = "FILE.toml", value_parser = toml_file)]
    output: Option<PathBuf>,
    /// Replace the file of `--output` where it is there already, as of another flight; without it that file is refused.
    #[arg(long)]
    replace: bool,
    /// Format of the output: a table, or one JSON object.
    #[arg(long, value_enum, default_value_t)]
    format: Format,
}

/// Calibrates, and prints the estimates and changes.
///
/// # Errors
/// When the recording cannot be read, has no detections, telemetry or calibration, or contradicts itself.
pub(super) fn run(args: &FlightArgs) -> anyhow::Result<ExitCode> {
    let FlightArgs { file, camera, detector, marker, output, replace, .. } = args;
    if let Some(path) = output {
        super::check_output(path, *replace, "and may be of another flight")?;
    }
    let wanted = Wanted {
        camera: camera.as_deref(),
        detector: detector.as_deref(),
        marker: marker.as_deref(),
    };
    let flight = recorded::read(file, &wanted)?;
    flight.damage.iter().for_each(|damage| write_error(damage));
    let result = calibrate_flight(&flight.configured, &flight.vehicle, &flight.markers)
        .with_context(|| format!("calibrating the camera `{}` from {file:?}", flight.camera))?;
    let changes = corrected::changes(&flight, &result);
    match args.format {
        Format::Text => print(text(&flight, &result, &changes).trim_end())?,
        Format::Json => print(&json(&flight, &result, &changes).to_string())?,
    }
    let count = changes.keys.len();
    write_error(&match output {
        Some(path) => {
            // Also where no key changes: a replaced file must not contain values of another flight.
            write_atomically(path, changes.toml(&flight.camera).as_bytes())
                .with_context(|| format!("writing {path:?}; name another file with `--output`"))?;
            match count {
                0 => format!("{}: no key changes", path.display()),
                _ => format!("{}: the {count} keys that change", path.display()),
            }
        }
        None if count > 0 => {
            "nothing is written; `--output FILE.toml` writes the keys that change".to_owned()
        }
        None => "no key changes".to_owned(),
    });
    let is_any = result.estimates.iter().any(FlightEstimate::is_observable);
    Ok(if is_any { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// A quantity for people: its name, unit, and how many of the unit are one of the estimate's.
fn name(quantity: Quantity) -> (&'static str, &'static str, f64) {
    let degrees = 1f64.to_degrees();
    match quantity {
        Quantity::TimeOffset => ("time offset", "ms", 1e3),
        Quantity::MountRoll => ("mount, roll", "deg", degrees),
        Quantity::MountPitch => ("mount, pitch", "deg", degrees),
        Quantity::MountYaw => ("mount, yaw", "deg", degrees),
        Quantity::FocalScale => ("focal length", "%", 100.0),
        Quantity::K1 => ("lens, k1", "", 1.0),
    }
}

/// The verdict on an estimate.
fn verdict(estimate: &FlightEstimate, changes: &Changes) -> String {
    let stays = match (estimate.is_observable(), estimate.deviation.is_finite()) {
        (true, _) if estimate.may_be_as_configured() => "stays: it may be as configured",
        (true, _) => {
            return match changes.key_of(estimate.quantity) {
                Some(key) => format!("corrected by `{key}`"),
                None => "stays, although it is off: see below".to_owned(),
            };
        }
        (false, true) => "not observable, stays: too uncertain",
        (false, false) => {
            "not observable, stays: the vehicle's motion does not show it, or its attitude error is too large"
        }
    };
    stays.to_owned()
}

fn text(flight: &RecordedFlight, result: &FlightCalibration, changes: &Changes) -> String {
    let excitation = &result.excitation;
    let mut lines = vec![
        format!(
            "camera {}, marker {}: {} of {} detections; tilt {:.1} deg (standard deviation), distance 1:{:.1}, headings over {:.0} deg",
            flight.camera,
            flight.marker,
            result.markers,
            flight.markers.len(),
            excitation.tilt_rad.to_degrees(),
            excitation.distance_ratio,
            excitation.turn_rad.to_degrees()
        ),
        format!(
            "{:<14}{:>12}{:>12}{:>12}  {:<4} verdict",
            "correction", "estimated", "+-3 sigma", "limit", "unit"
        ),
    ];
    for estimate in &result.estimates {
        let (name, unit, scale) = name(estimate.quantity);
        let limit = format!("{:.3}", 3.0 * scale * estimate.quantity.max_deviation());
        let [value, spread] = match estimate.deviation.is_finite() {
            true => [
                format!("{:+.3}", scale * estimate.value),
                format!("{:.3}", 3.0 * scale * estimate.deviation),
            ],
            false => ["-".to_owned(), "-".to_owned()],
        };
        let verdict = verdict(estimate, changes);
        lines.push(format!("{name:<14}{value:>12}{spread:>12}{limit:>12}  {unit:<4} {verdict}"));
    }
    lines.extend(changes.lines(&flight.camera));
    let [before, after] = [&flight.configured, &result.camera].map(|camera| {
        let (roll, pitch, yaw) = camera.body_from_camera.rotation().euler();
        let [roll, pitch, yaw] = [roll, pitch, yaw].map(f64::to_degrees);
        format!(
            "mount roll, pitch, yaw {roll:.3}, {pitch:.3}, {yaw:.3} deg; focal length {:.2} px",
            camera.model.fx
        )
    });
    lines.push(format!("before: {before}\nafter:  {after}"));
    lines.push(format!(
        "the mount is relative to the autopilot's level; its position erred by about {:.0} mm, its attitude by {:.2} deg",
        1e3 * result.drift.position_m,
        result.drift.lean_rad.to_degrees()
    ));
    lines.join("\n")
}

fn json(flight: &RecordedFlight, result: &FlightCalibration, changes: &Changes) -> Value {
    let key = |quantity| match quantity {
        Quantity::TimeOffset => "time_offset_s",
        Quantity::MountRoll => "mount_roll_rad",
        Quantity::MountPitch => "mount_pitch_rad",
        Quantity::MountYaw => "mount_yaw_rad",
        Quantity::FocalScale => "focal_scale",
        Quantity::K1 => "k1",
    };
    let estimates = result.estimates.iter().map(|estimate| {
        let shown = estimate.deviation.is_finite();
        json!({
            "quantity": key(estimate.quantity),
            "value": shown.then_some(estimate.value),
            "sigma": shown.then_some(estimate.deviation),
            "max_sigma": estimate.quantity.max_deviation(),
            "observable": estimate.is_observable(),
            "correction": estimate.correction(),
            "key": changes.key_of(estimate.quantity).filter(|_| estimate.correction() != 0.0),
            "verdict": verdict(estimate, changes),
        })
    });
    let keys = changes.keys.iter().map(|change| {
        let before = match &change.before {
            Before::Was(before) => Some(before),
            Before::Unknown | Before::Absent => None,
        };
        json!({ "key": change.name(), "before": before, "after": change.value })
    });
    let camera = |camera: &calibration::ConfiguredCamera| {
        json!({
            "focal_px": [camera.model.fx, camera.model.fy],
            "body_from_camera_wxyz": camera.body_from_camera.rotation().wxyz(),
        })
    };
    let covariance: Vec<Vec<f64>> =
        result.covariance.row_iter().map(|row| row.iter().copied().collect()).collect();
    json!({
        "camera": flight.camera,
        "marker": flight.marker,
        "detections": flight.markers.len(),
        "used": result.markers,
        "estimates": estimates.collect::<Vec<_>>(),
        "covariance": covariance,
        "is_changed": !changes.keys.is_empty(),
        "changes": keys.collect::<Vec<_>>(),
        "left": changes.advice,
        "before": camera(&flight.configured),
        "after": camera(&result.camera),
        "tilt_rad": result.excitation.tilt_rad,
        "distance_ratio": result.excitation.distance_ratio,
        "turn_rad": result.excitation.turn_rad,
        "position_drift_m": result.drift.position_m,
        "lean_drift_rad": result.drift.lean_rad,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::flight::QUANTITIES;
    use experiments::landing::flight::{fly, fly_recorded};
    use experiments::landing::plan::{Plan, Planned, Values};
    use geometry::{Body, Ned, Rotation, Vector};
    use nalgebra::Vector3;
    use report::FlightReader;

    /// How the camera of a landing differs from its configuration.
    #[derive(Copy, Clone, Debug, Default)]
    struct Wrong {
        mount: Rotated,
        early_ms: f64,
    }

    /// Roll, pitch and yaw in degrees.
    #[derive(Copy, Clone, Debug, Default)]
    struct Rotated([f64; 3]);

    const WRONG: Wrong = Wrong { mount: Rotated([0.0, 2.0, 0.0]), early_ms: 40.0 };

    /// An ordinary landing in wind, with further settings.
    fn planned(seed: u64, wrong: Wrong, set: &[&str]) -> Planned {
        let Rotated([roll, pitch, yaw]) = wrong.mount;
        let mut all = vec![
            format!("simulator.camera.mount_roll_deg={roll}"),
            format!("simulator.camera.mount_pitch_deg={pitch}"),
            format!("simulator.camera.mount_yaw_deg={yaw}"),
            format!("simulator.camera.stamp_early_ms={}", wrong.early_ms),
        ];
        all.extend(set.iter().map(|setting| (*setting).to_owned()));
        let wind = Values::List(vec![5.0]);
        let plan = Plan { flights: 1, seed, wind, set: all, ..Plan::default() };
        plan.flights().remove(0)
    }

    struct Landed {
        flight: RecordedFlight,
        result: FlightCalibration,
        /// Error of the autopilot's level, to which the mount refers.
        level: Rotation<Body, Body>,
    }

    fn landed(planned: &Planned) -> anyhow::Result<Landed> {
        let folder = tempfile::tempdir()?;
        let path = folder.path().join("flight.mcap");
        fly_recorded(planned, std::fs::File::create(&path)?)?;
        let wanted = Wanted { camera: None, detector: None, marker: None };
        let flight = recorded::read(&path, &wanted)?;
        let result = calibrate_flight(&flight.configured, &flight.vehicle, &flight.markers)?;
        let mut reader = FlightReader::new("flight");
        reader.add(&std::fs::read(&path)?)?;
        Ok(Landed { flight, result, level: level(&reader.finish()) })
    }

    /// The mean of the turn from the estimated to the true attitude, in the body, but for the heading's error: that is a turn
    /// about the vertical, of which a body that leans has a part in its roll and pitch.
    fn level(flight: &report::Flight) -> Rotation<Body, Body> {
        let attitude =
            |wxyz| Rotation::<Ned, Body>::from_wxyz(wxyz).unwrap_or(Rotation::identity());
        let pairs = flight.vehicle.iter().filter_map(|state| {
            let near =
                |truth: &&messages::Truth| truth.stamp_ns.abs_diff(state.stamp_ns) < 2_000_000;
            let truth = flight.truth.iter().find(near)?;
            Some((attitude(state.ned_from_body_wxyz), attitude(truth.ned_from_body_wxyz)))
        });
        let pairs: Vec<_> = pairs.collect();
        let turn = pairs.iter().map(|(estimated, truth)| {
            let turn: Rotation<Ned, Ned> = *truth * estimated.inverse();
            turn.quaternion.scaled_axis()
        });
        let turn = turn.sum::<Vector3<f64>>() / pairs.len() as f64;
        let heading = Rotation::<Ned, Ned>::from_rotation_vector(Vector::new(0.0, 0.0, turn.z));
        let tilt = pairs.iter().map(|(estimated, truth)| {
            let tilt: Rotation<Body, Body> = (heading * *estimated).inverse() * *truth;
            tilt.quaternion.scaled_axis()
        });
        let tilt = tilt.sum::<Vector3<f64>>() / pairs.len() as f64;
        Rotation::from_rotation_vector(Vector::new(tilt.x, tilt.y, 0.0))
    }

    /// Errors of the estimates, in the quantities' units.
    fn errors(landed: &Landed, wrong: Wrong) -> [f64; 6] {
        let [roll, pitch, yaw] = wrong.mount.0.map(f64::to_radians);
        let mount = landed.level * Rotation::<Body, Body>::from_euler(roll, pitch, yaw);
        let turn = mount.quaternion.scaled_axis();
        let truth = [1e-3 * wrong.early_ms, turn.x, turn.y, turn.z, 0.0, 0.0];
        std::array::from_fn(|i| landed.result.estimates[i].value - truth[i])
    }

    #[test]
    fn an_ordinary_landing_shows_how_the_camera_is_mounted_and_when_it_looks() {
        for seed in 0..3 {
            let landed = landed(&planned(6200 + seed, WRONG, &[])).unwrap();
            let errors = errors(&landed, WRONG);
            let row: Vec<String> = errors
                .iter()
                .zip(&landed.result.estimates)
                .map(|(error, estimate)| {
                    let (name, unit, scale) = name(estimate.quantity);
                    format!(
                        "{name} {:+.3} +- {:.3} {unit}",
                        scale * error,
                        scale * estimate.deviation
                    )
                })
                .collect();
            println!("seed {seed}: {}", row.join(", "));
            for (i, quantity) in QUANTITIES.into_iter().enumerate() {
                let estimate = landed.result.estimates[i];
                assert!(errors[i].abs() < 4.0 * estimate.deviation, "{seed}: {quantity:?} {row:?}");
            }
            assert!(landed.result.estimates[0].is_observable() && errors[0].abs() < 0.002);
            assert!(landed.result.estimates[2].is_observable());
            let changes = corrected::changes(&landed.flight, &landed.result);
            let text = text(&landed.flight, &landed.result, &changes);
            assert!(text.contains("corrected by `mount.rotation_wxyz`"), "{text}");
        }
    }

    #[test]
    fn each_key_named_as_a_correction_is_one_that_changes() {
        let Landed { mut flight, result, .. } = landed(&planned(6200, WRONG, &[])).unwrap();
        let described = |flight: &RecordedFlight| {
            let changes = corrected::changes(flight, &result);
            let toml: toml::Table = changes.toml(&flight.camera).parse().unwrap();
            let text = text(flight, &result, &changes);
            let named = text.split("corrected by `").skip(1).filter_map(|it| it.split('`').next());
            for (table, key) in named.filter_map(|name| name.split_once('.')) {
                assert!(toml[table].get(key).is_some(), "{table}.{key} is not in {toml}");
            }
            (text, toml)
        };
        let all = |text: &str, parts: &[&str]| {
            for part in parts {
                assert!(text.contains(part), "`{part}` is not in: {text}");
            }
        };
        // The simulator has no configuration of camera-pub, and stamps frames itself.
        let (text, toml) = described(&flight);
        all(&text, &["stays, although it is off: see below", "left: frames are exposed +"]);
        all(&text, &["no key corrects that", "set: `mount.rotation_wxyz` = ["]);
        assert!(toml.get("source").is_none(), "{toml}");
        flight.is_stamped_by_camera = false;
        all(&described(&flight).0, &["left: ", "the previous `source.delay_ms` is not known"]);
        let configuration = "source.delay_ms = 50.0\nmount.orientation = \"down\"";
        flight.configuration = Some(configuration.parse().unwrap());
        let (text, toml) = described(&flight);
        all(&text, &["corrected by `source.delay_ms`", "changed: `source.delay_ms` from 50.0 to "]);
        all(&text, &["changed: `mount.orientation` from \"down\" to \"quaternion\""]);
        all(&text, &["added: `mount.rotation_wxyz` = ["]);
        let delay_ms = toml["source"]["delay_ms"].as_float().unwrap();
        assert!((delay_ms - 10.0).abs() < 2.0 && !text.contains("left: "), "{text}");
        flight.configuration = Some("source.delay_ms = 5.0".parse().unwrap());
        all(&described(&flight).0, &["left: ", "`source.delay_ms` = 5.0 cannot be made smaller"]);
    }

    #[test]
    fn a_file_of_another_flight_is_refused_and_contains_none_of_it_once_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let [file, output] = ["flight.mcap", "changes.toml"].map(|name| folder.path().join(name));
        std::fs::write(&output, "[source]\ndelay_ms = 7.0\n").unwrap();
        let mut args = FlightArgs {
            file: file.clone(),
            camera: None,
            detector: None,
            marker: None,
            output: Some(output.clone()),
            replace: false,
            format: Format::Json,
        };
        // Before the recording, which is not there, is read.
        let problem = run(&args).unwrap_err().to_string();
        assert!(problem.contains("changes.toml") && problem.contains("`--replace`"), "{problem}");
        fly_recorded(&planned(6200, Wrong::default(), &[]), std::fs::File::create(&file).unwrap())
            .unwrap();
        args.replace = true;
        run(&args).unwrap();
        let text = std::fs::read_to_string(&output).unwrap();
        let table: toml::Table = text.parse().unwrap();
        assert!(table.get("source").is_none() && text.starts_with("# "), "{text}");
    }

    #[test]
    fn a_recording_without_detections_or_telemetry_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("empty.mcap");
        let wanted = Wanted { camera: None, detector: None, marker: None };
        let problem = |wanted: &Wanted<'_>| {
            recorded::read(&path, wanted)
                .err()
                .map(|problem| format!("{problem:#}"))
                .unwrap_or_default()
        };
        assert!(problem(&wanted).contains("reading"), "{}", problem(&wanted));
        std::fs::write(&path, b"no recording").unwrap();
        assert!(problem(&wanted).contains("is no recording"), "{}", problem(&wanted));
        let about = flightlog::About {
            program: "test".to_owned(),
            facts: std::collections::BTreeMap::new(),
            utc_offset_ns: 0,
        };
        let file = std::fs::File::create(&path).unwrap();
        flightlog::Writer::new(file, &about).unwrap().finish().unwrap();
        assert!(problem(&wanted).contains("no detections"), "{}", problem(&wanted));
        let file = std::fs::File::create(&path).unwrap();
        fly_recorded(&planned(6200, WRONG, &[]), file).unwrap();
        let other = Wanted { marker: Some("aruco-4x4-50:3"), ..wanted };
        assert!(
            problem(&other).contains("was not seen; the recording has rings"),
            "{}",
            problem(&other)
        );
    }

    /// The landing error in metres.
    fn landing_error_m(seed: u64, wrong: Wrong) -> f64 {
        let error_m =
            fly(&planned(seed, wrong, &[]), None).ok().and_then(|outcome| outcome.error_m);
        error_m.unwrap_or(f64::INFINITY)
    }

    /// The errors of the camera that remain after the correction.
    fn left(wrong: Wrong, result: &FlightCalibration) -> Wrong {
        let [offset_s, roll, pitch, yaw, ..] =
            result.estimates.map(|estimate| estimate.correction());
        let corrected = Rotation::<Body, Body>::from_rotation_vector(Vector::new(roll, pitch, yaw));
        let [roll, pitch, yaw] = wrong.mount.0.map(f64::to_radians);
        let (roll, pitch, yaw) =
            (corrected.inverse() * Rotation::<Body, Body>::from_euler(roll, pitch, yaw)).euler();
        Wrong {
            mount: Rotated([roll, pitch, yaw].map(f64::to_degrees)),
            early_ms: wrong.early_ms - 1e3 * offset_s,
        }
    }

    #[test]
    fn a_landing_with_the_corrected_camera_is_as_good_as_with_the_true_one() {
        let [mut before, mut after, mut truth] = [0.0; 3];
        let count = 4;
        for seed in 6300..6300 + count {
            let landed = landed(&planned(seed, WRONG, &[])).unwrap();
            before += landing_error_m(seed, WRONG) / count as f64;
            after += landing_error_m(seed, left(WRONG, &landed.result)) / count as f64;
            truth += landing_error_m(seed, Wrong::default()) / count as f64;
        }
        println!(
            "mean landing error: before {before:.4} m, after {after:.4} m, with the truth {truth:.4} m"
        );
        // Both are millimetres; a tenth of that is no difference.
        assert!(after <= 1.1 * truth + 0.001, "{before} {after} {truth}");
    }

    /// A number of the environment, for measurements.
    fn number(name: &str, usual: u64) -> u64 {
        std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(usual)
    }

    /// Settings with which a landing from 10 m takes a minute.
    const SLOW: [&str; 2] =
        ["controller.metric.max_descend_m_s=0.2", "controller.metric.touchdown_descend_m_s=0.15"];

    #[test]
    #[ignore = "a measurement of some minutes"]
    fn how_exact_many_landings_are() {
        let (count, first) = (number("ALIGHT_FLIGHTS", 24), number("ALIGHT_SEED", 8100));
        for (how, set, bars) in [
            ("as the default is", &[][..], None),
            ("of a minute", &SLOW[..], Some([1.0, 0.1, 0.1, 0.1, 0.1])),
        ] {
            let mut rows = Vec::new();
            let mut seconds = 0.0;
            for seed in first..first + count {
                let landed = landed(&planned(seed, WRONG, set)).unwrap();
                let times = landed.flight.markers.iter().map(|marker| marker.stamp_s);
                let (begin, end) = times.fold((f64::MAX, 0.0), |(a, b), t| (t.min(a), t.max(b)));
                seconds += (end - begin) / count as f64;
                rows.push((errors(&landed, WRONG), landed.result.estimates));
            }
            println!("{count} landings {how}, which see the pad for {seconds:.0} s on average:");
            for (i, quantity) in QUANTITIES.into_iter().enumerate() {
                let (name, unit, scale) = name(quantity);
                let of = |value: &dyn Fn(f64, f64) -> f64| {
                    let squares = rows.iter().map(|(errors, estimates)| {
                        let deviation = estimates[i].deviation;
                        value(errors[i], deviation).powi(2)
                    });
                    let squares: Vec<f64> = squares.collect();
                    let rms = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
                    (rms, squares.into_iter().fold(0.0, f64::max).sqrt())
                };
                let (rms, worst) = of(&|error, _| scale * error);
                let (deviation, _) = of(&|_, deviation| scale * deviation);
                let (normalised, farthest) = of(&|error, deviation| error / deviation);
                let bar = bars.and_then(|bars| bars.get(i).copied());
                let within = bar.map_or(String::new(), |bar| {
                    let is_within = |(errors, _): &&([f64; 6], _)| (scale * errors[i]).abs() <= bar;
                    let within = rows.iter().filter(is_within).count();
                    format!(", {within} of {count} within {bar} {unit}")
                });
                println!(
                    "  {name:<13} error {rms:.4} {unit} rms, {worst:.4} at most; deviation {deviation:.4}; error over \
                     deviation {normalised:.2} rms, {farthest:.2} at most{within}"
                );
            }
        }
    }

    #[test]
    #[ignore = "a measurement of some minutes"]
    fn how_well_many_landings_with_the_corrected_camera_end() {
        let (count, first) = (number("ALIGHT_FLIGHTS", 24), number("ALIGHT_SEED", 8300));
        let mut errors_m = [const { Vec::new() }; 3];
        for seed in first..first + count {
            let landed = landed(&planned(seed, WRONG, &[])).unwrap();
            let cameras = [WRONG, left(WRONG, &landed.result), Wrong::default()];
            for (errors_m, camera) in errors_m.iter_mut().zip(cameras) {
                errors_m.push(landing_error_m(seed + 1000, camera));
            }
        }
        for (how, mut errors_m) in ["before", "after", "with the truth"].into_iter().zip(errors_m) {
            errors_m.sort_by(f64::total_cmp);
            let mean_m = errors_m.iter().sum::<f64>() / errors_m.len() as f64;
            println!(
                "{how}: mean {:.1} mm, median {:.1} mm, worst {:.1} mm",
                1e3 * mean_m,
                1e3 * errors_m[errors_m.len() / 2],
                1e3 * errors_m[errors_m.len() - 1]
            );
        }
    }
}
