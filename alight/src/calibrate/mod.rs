//! `alight calibrate`: `board` prints the board, or solves for a camera's intrinsics from images of it and writes the
//! calibration file; the result or refusal is printed as text or JSON. `flight` is in `flight.rs`.

mod args;
mod corrected;
mod flight;
mod found;
mod live;
mod recorded;
mod report;
mod sharpness;
mod shown;

use std::fs::OpenOptions;
use std::path::Path;
use std::process::ExitCode;
use std::time::SystemTime;

use anyhow::{Context, ensure};
use calibration::{Calibration, calibrate, calibrate_unjudged};
use clap::{Args, Subcommand};
use media::{CalibrationDetails, CalibrationNote, write_calibration};

use crate::args::Format;
use crate::marker::Sheet;
use crate::terminal::print;
pub(crate) use args::BoardArgs;
use flight::FlightArgs;
use found::{Finder, FoundImages, find_boards};
use live::watch_camera;
use shown::Shown;

/// How often images are looked at again with the lens that was found before. Behind a fisheye of 120 degrees the first time leaves
/// errors of 0.77 px at the border, the second 0.38, the third 0.31.
const LOOKS: usize = 3;

/// The arguments of `alight calibrate`.
#[derive(Args)]
pub(crate) struct CalibrateArgs {
    #[command(subcommand)]
    what: What,
}

#[derive(Subcommand)]
enum What {
    /// A camera's intrinsics from images of a printed board: print it with --print (a grid of AprilTags; a chessboard or another board is
    /// not found: calibrate with OpenCV from those, whose file is read as well), take 20 to 60 pictures (tilted by up to 45 degrees to all
    /// sides, near and far, in every corner of the image), then calibrate.
    Board(BoardArgs),
    /// A camera's time offset, mount, focal length and first radial coefficient (k1) from the recording of a landing
    /// (`alight land --record`, `alight record`) on a pad of known size that does not move. A landing with turns of the heading
    /// and swift moves to all sides shows all of it; quantities that a flight does not show keep their values. Exit status 1 when it shows
    /// nothing.
    Flight(FlightArgs),
}

/// Prints the board, or calibrates. Exit status 1 when images or flight show no camera.
///
/// # Errors
/// When arguments contradict each other, a file cannot be read or written.
pub(crate) fn run(args: &CalibrateArgs) -> anyhow::Result<ExitCode> {
    match &args.what {
        What::Board(args) => board(args),
        What::Flight(args) => flight::run(args),
    }
}

/// Refuses a file that is there already and is not to be replaced, or that cannot be written, before anything is calibrated.
fn check_output(path: &Path, is_replaced: bool, may_be: &str) -> anyhow::Result<()> {
    ensure!(
        is_replaced || !path.exists(),
        "{path:?} is there already, {may_be}: name another with `--output`, or replace it with `--replace`"
    );
    // A device or a pipe is written as it is, as is a file in a folder where no other file can be created.
    if path.exists() && (!path.is_file() || OpenOptions::new().append(true).open(path).is_ok()) {
        return Ok(());
    }
    let file = path.canonicalize().unwrap_or_else(|_| path.to_owned());
    tempfile::tempfile_in(media::folder_of(&file)).with_context(|| {
        format!("trying whether {path:?} can be written; name another with `--output`, or make its folder")
    })?;
    Ok(())
}

fn board(args: &BoardArgs) -> anyhow::Result<ExitCode> {
    let board = args.board()?;
    if let Some(output) = &args.print {
        let sheet = Sheet::with_board(&board, args.paper)?;
        output.write(&sheet, args.dpi)?;
        print(&format!(
            "{}: {} x {} tags on {}. Print it at 100 %, check that the ruler measures 100 mm, glue it flat to something stiff, \
             and measure a tag's side and the gap between two.",
            output.path().display(),
            board.columns(),
            board.rows(),
            args.paper.name()
        ))?;
        return Ok(ExitCode::SUCCESS);
    }
    args.check()?;
    if let Some(path) = &args.output {
        check_output(path, args.replace, "and may be the calibration in use")?;
    }
    let mut finder = Finder::new(&board)?;
    let mut found = match &args.live {
        Some(camera) => watch_camera(&mut finder, camera, args)?,
        None => find_boards(&mut finder, args)?,
    };
    if let (Some(sensor), Some(view)) = (args.on_sensor(), found.views.first()) {
        sensor.check([view.size.width, view.size.height])?;
    }
    let (lens, options) = (args.lens.model(), args.options());
    found.look_mirrored(&mut finder);
    let mut first = calibrate_unjudged(&found.views, lens, &options).ok();
    for _ in 0..LOOKS {
        let Some(camera) = first.as_ref().map(|first| first.camera) else { break };
        found.look_again(&mut finder, &camera);
        first = calibrate_unjudged(&found.views, lens, &options).ok().or(first);
    }
    let shown = Shown::new(&found, first.as_ref());
    match calibrate(&found.views, lens, &options) {
        Ok(calibration) => accept(args, &found, &shown, &calibration),
        Err(refusal) => {
            refuse(args, &found, &shown, &report::refusal_text(&found, &refusal, &board, lens))
        }
    }
}

fn accept(
    args: &BoardArgs,
    found: &FoundImages,
    shown: &Shown,
    calibration: &Calibration,
) -> anyhow::Result<ExitCode> {
    let note = CalibrationNote {
        made: humantime::format_rfc3339_seconds(SystemTime::now()).to_string(),
        views: calibration.views.len(),
        noise_px: calibration.noise_px,
        rms_px: calibration.rms_px,
        uncertainty_px: calibration.worst_uncertainty_px(),
    };
    // The result is printed first, so it is not lost if the file cannot be written.
    match args.format {
        Format::Text => {
            print(report::found_text(found, shown).trim_end())?;
            print(report::shown_text(shown).trim_end())?;
            print(report::worth_text(calibration).trim_end())
        }
        Format::Json => print(&report::json(found, shown, Some(calibration), None).to_string()),
    }
    .context("writing the result")?;
    let said = match &args.output {
        Some(path) => {
            let details = CalibrationDetails { sensor: args.on_sensor(), note: Some(note) };
            write_calibration(path, &calibration.camera, args.file_format().format(), &details)?;
            format!(
                "{}: written; name it in camera-pub's configuration as `calibration.file`.",
                path.display()
            )
        }
        None => "Nothing was written: pass -o camera.yaml.".to_owned(),
    };
    if args.format == Format::Text {
        print(&said).context("writing the result")?;
    }
    Ok(ExitCode::SUCCESS)
}

fn refuse(
    args: &BoardArgs,
    found: &FoundImages,
    shown: &Shown,
    reason: &str,
) -> anyhow::Result<ExitCode> {
    match args.format {
        Format::Text => {
            print(report::found_text(found, shown).trim_end())?;
            print(report::shown_text(shown).trim_end())?;
            print(&format!("No calibration: {reason}."))
        }
        Format::Json => print(&report::json(found, shown, None, Some(reason)).to_string()),
    }
    .context("writing the result")?;
    Ok(ExitCode::FAILURE)
}

#[cfg(test)]
mod rendered;

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn a_file_that_cannot_be_written_is_refused_before_the_calibration() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("camera.yaml");
        check_output(&file, false, "").unwrap();
        assert!(!file.exists());
        let error =
            check_output(&folder.path().join("missing/camera.yaml"), false, "").unwrap_err();
        assert!(format!("{error:#}").contains("make its folder"), "{error:#}");
        std::fs::write(&file, "in use").unwrap();
        assert!(check_output(&file, false, "").is_err());
        check_output(&file, true, "").unwrap();
        // Root may write into every folder.
        std::fs::set_permissions(folder.path(), Permissions::from_mode(0o500)).unwrap();
        check_output(&file, true, "").unwrap();
        std::fs::set_permissions(folder.path(), Permissions::from_mode(0o700)).unwrap();
        assert_eq!(std::fs::read_to_string(&file).unwrap(), "in use");
    }
}
