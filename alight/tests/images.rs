//! The program `alight` with files: a marker drawn by `alight marker` is found by `alight detect`, and
//! `alight cameras` takes a picture of image files or of a program.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use anyhow::{Context, ensure};
use serde_json::Value;

fn alight(args: &[&str], folder: &Path) -> anyhow::Result<Output> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_alight"));
    command.args(args).current_dir(folder).output().context("running alight")
}

#[test]
fn a_marker_that_was_made_is_found_where_it_was_drawn() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let made = alight(
        &["marker", "rings", "--size", "0.1", "--dpi", "100", "-o", "a.png"],
        folder.path(),
    )?;
    ensure!(made.status.success(), "{made:?}");
    std::fs::write(folder.path().join("b.png"), "not an image")?;
    let args = ["detect", "--marker", "rings:0.1", "--focal-px", "1000", "--format", "jsonl", "."];
    let found = alight(&args, folder.path())?;
    ensure!(found.status.code() == Some(1), "{found:?}");
    let lines: Vec<Value> =
        found.stdout.lines().map(|line| Ok(line?.parse()?)).collect::<anyhow::Result<_>>()?;
    let [image, damaged] = lines.as_slice() else { anyhow::bail!("{lines:?}") };
    ensure!(damaged["error"].is_string() && damaged["image"] == "./b.png", "{damaged}");
    let marker = &image["detections"][0];
    let number = |value: &Value| value.as_f64().context("a number");
    // The middle of an A4 sheet of 827 x 1169 pixels, and 0.1 m at 100 pixels an inch.
    ensure!((number(&marker["centre_px"][0])? - 412.9).abs() < 0.5, "{marker}");
    ensure!((number(&marker["centre_px"][1])? - 584.1).abs() < 0.5, "{marker}");
    ensure!((number(&marker["size_px"])? - 393.7).abs() < 1.0, "{marker}");
    ensure!((number(&marker["pose"]["translation_m"][2])? - 0.254).abs() < 0.002, "{marker}");
    Ok(())
}

#[test]
fn markers_without_a_size_are_reported_once() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    for name in ["a.png", "b.png"] {
        let made = ["marker", "apriltag-36h11:3", "--size", "0.1", "--dpi", "60", "-o", name];
        ensure!(alight(&made, folder.path())?.status.success(), "{name}");
    }
    let args = ["detect", "--marker", "apriltag-36h11:*", "--focal-px", "1818", "."];
    let found = alight(&args, folder.path())?;
    let warnings = String::from_utf8(found.stderr)?;
    ensure!(
        found.status.success() && warnings.matches("the marker has no size").count() == 1,
        "{warnings}"
    );
    Ok(())
}

#[test]
fn an_image_is_read_from_standard_input() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let made = ["marker", "rings", "--size", "0.1", "--dpi", "60", "-o", "a.png"];
    ensure!(alight(&made, folder.path())?.status.success(), "no picture");
    let of = |file: &str| {
        let args = ["detect", "--marker", "rings", "--format", "jsonl", "--draw", "seen", "-"];
        let image = std::fs::File::open(folder.path().join(file))?;
        let mut command = Command::new(env!("CARGO_BIN_EXE_alight"));
        let output = command.args(args).current_dir(folder.path()).stdin(image).output()?;
        let line: Value = std::str::from_utf8(&output.stdout)?.trim().parse()?;
        anyhow::Ok((output, line))
    };
    let (output, line) = of("a.png")?;
    ensure!(output.status.success() && line["image"] == "-", "{output:?}");
    ensure!(line["detections"][0]["family"] == "rings", "{line}");
    ensure!(folder.path().join("seen/stdin.drawn.png").is_file(), "no drawing of standard input");
    std::fs::write(folder.path().join("video.avi"), "RIFF, and no image")?;
    let (output, line) = of("video.avi")?;
    let error = line["error"].as_str().context("an error")?;
    ensure!(output.status.code() == Some(1) && error.contains("standard input"), "{output:?}");
    Ok(())
}

/// A library that turns markers otherwise would turn a vehicle that follows their heading, and nothing else would show it.
#[test]
fn the_detector_in_python_begins_with_the_same_corner() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let detector = root.join("detector/examples/python/detector.py");
    let picture = folder.path().join("a.png");
    for marker in ["apriltag-36h11:3", "apriltag-16h5:5", "aruco-4x4-50:7"] {
        let args = ["marker", marker, "--size", "0.15", "--dpi", "100", "-o", "a.png"];
        let made = alight(&args, folder.path())?;
        ensure!(made.status.success(), "{made:?}");
        let found =
            alight(&["detect", "--marker", marker, "--format", "jsonl", "a.png"], folder.path())?;
        let line: Value = std::str::from_utf8(&found.stdout)?.trim().parse()?;
        let sized = format!("{marker}:0.15");
        let paths = [&detector, &picture].map(|path| path.to_str().context("a path"));
        let [detector, picture] = paths;
        let args = [detector?, &sized, picture?];
        let Some(python) = testing::python("alight/tests/opencv/corners.py", &args) else {
            return Ok(());
        };
        let output = python.wait_with_output()?;
        if !testing::python_passes(&output)? {
            return Ok(());
        }
        let theirs: Value = std::str::from_utf8(&output.stdout)?.trim().parse()?;
        let corner = |of: &Value, i: usize, axis: usize| of[i][axis].as_f64().context("a corner");
        for (i, axis) in (0..4).flat_map(|i| [(i, 0), (i, 1)]) {
            let ours = corner(&line["detections"][0]["corners_px"], i, axis)?;
            ensure!((corner(&theirs, i, axis)? - ours).abs() < 2.0, "{marker}: {theirs}, {line}");
        }
    }
    Ok(())
}

#[test]
fn a_reader_that_goes_away_is_no_error() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    for i in 0..300 {
        std::fs::write(folder.path().join(format!("{i:03}.png")), "not an image")?;
    }
    let mut child = Command::new(env!("CARGO_BIN_EXE_alight"))
        .args(["detect", "--marker", "rings"])
        .arg(folder.path())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()?;
    let mut first = String::new();
    BufReader::with_capacity(64, child.stdout.take().context("output")?).read_line(&mut first)?;
    ensure!(first.contains("000.png  error: "), "{first}");
    let ended = child.wait_with_output()?;
    ensure!(ended.stderr.is_empty(), "{}", String::from_utf8_lossy(&ended.stderr));
    Ok(())
}

/// Takes a picture with these settings of `camera-pub`; the output, and the picture where there is one.
fn picture(set: &[&str], folder: &Path) -> anyhow::Result<(Output, Option<image::GrayImage>)> {
    let mut args = vec!["cameras", "--picture", "seen.png"];
    let calibration = "calibration.focal_px=[50.0, 50.0]";
    args.extend(set.iter().chain([&calibration]).flat_map(|set| ["--set", set]));
    let output = alight(&args, folder)?;
    let picture = match output.status.success() {
        true => Some(image::open(folder.join("seen.png"))?.into_luma8()),
        false => None,
    };
    Ok((output, picture))
}

#[test]
fn a_picture_equals_the_frame_of_a_file_or_a_program_for_a_detector() -> anyhow::Result<()> {
    let folder = tempfile::tempdir()?;
    let pixels: Vec<u8> = (0..64 * 48).map(|i| (i % 251) as u8).collect();
    let path = folder.path().join("a.png");
    image::save_buffer(path, &pixels, 64, 48, image::ExtendedColorType::L8)?;
    let (output, taken) = picture(&["source.paths=[\"a.png\"]"], folder.path())?;
    let taken = taken.with_context(|| format!("{output:?}"))?;
    ensure!(taken.dimensions() == (64, 48) && *taken.as_raw() == pixels, "{output:?}");

    let of = |command: &str| {
        let command = format!("source.command={command}");
        let shape = ["source.pixels=\"gray8\"", "source.size_px=[32, 24]"];
        picture(&[&command, shape[0], shape[1]], folder.path())
    };
    // The second ends after three frames.
    for command in [r#"["cat", "/dev/urandom"]"#, r#"["head", "-c", "2304", "/dev/urandom"]"#] {
        let (output, taken) = of(command)?;
        let taken = taken.with_context(|| format!("{output:?}"))?;
        ensure!(taken.dimensions() == (32, 24), "{output:?}");
        let first = taken.as_raw().first();
        ensure!(taken.as_raw().iter().any(|pixel| Some(pixel) != first), "{output:?}");
    }
    let (output, taken) = of(r#"["no-such-program-of-a-camera"]"#)?;
    let said = String::from_utf8_lossy(&output.stderr);
    ensure!(taken.is_none() && said.contains("no-such-program-of-a-camera"), "{said}");
    let (output, taken) = of(r#"["true"]"#)?;
    ensure!(taken.is_none() && output.status.code() == Some(1), "{output:?}");
    Ok(())
}
