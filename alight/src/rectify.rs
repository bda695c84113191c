//! `alight rectify`: reads images and videos with a camera's calibration file, and writes each image without the distortion of its
//! lens, over no other file unless it may be replaced.

use std::collections::BTreeSet;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, ensure};
use clap::Args;
use imaging::{BayerPattern, GrayImage};
use media::{
    CalibrationDetails, CalibrationFormat, Rectifier, is_video, read_calibration, write_calibration,
};

use crate::detect::{Item, Source, stem};
use crate::terminal::{print, write_error};

/// The arguments of `alight rectify`.
#[derive(Args, Clone, Debug)]
pub(crate) struct RectifyArgs {
    /// Calibration of the camera (ROS camera_info, Kalibr camchain or OpenCV FileStorage).
    #[arg(long, value_name = "FILE")]
    camera: PathBuf,
    /// Folder for the images, as PNG in grey, and for `camera.yaml`, the calibration that they have.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Replace files that are in the output folder already; without it they are refused. Input files are never replaced.
    #[arg(long)]
    replace: bool,
    /// Bayer pattern of grey images with a sensor's raw samples: RGGB, GRBG, GBRG or BGGR.
    #[arg(long, value_name = "PATTERN")]
    bayer: Option<BayerPattern>,
    /// Image files (PNG of 8 or 16 bits, JPEG), videos, and folders of them. Images are read as they are stored, not turned by their
    /// Exif orientation.
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
}

/// Writes each image as a camera with the same focal lengths and principal point, but without distortion, would have taken it.
/// Exit status 1 when an image could not be read or is of another size.
///
/// # Errors
/// When the calibration cannot be read, or a file not be written or is there already.
pub(crate) fn run(args: &RectifyArgs) -> anyhow::Result<ExitCode> {
    let rectifier = Rectifier::new(&read_calibration(&args.camera)?);
    if let Some(note) = Source::note_of_others(&args.images) {
        write_error(&note);
    }
    let mut source = Source::new(&args.images);
    let mut outputs = Outputs::new(args, &source);
    let calibration = outputs.claim("camera.yaml")?;
    // Those of a video's frames are known once it is read.
    let images = source.files().filter(|file| !is_video(file));
    let names: Vec<String> = images.map(|file| output_name(&file.display().to_string())).collect();
    for name in &names {
        outputs.claim(name)?;
    }
    std::fs::create_dir_all(&args.output)
        .with_context(|| format!("creating the folder {:?}", args.output))?;
    let [mut written, mut failed] = [0, 0];
    while let Some(item) = source.next() {
        let name = item.name.clone();
        let is_frame = item.is_frame;
        match rectified(&rectifier, item, args.bayer) {
            Ok(image) => {
                let name = output_name(&name);
                let path = if is_frame { outputs.claim(&name)? } else { args.output.join(&name) };
                save(&image, &path)?;
                written += 1;
            }
            Err(problem) => {
                write_error(&format!("{problem:#}"));
                failed += 1;
            }
        }
    }
    ensure!(written + failed > 0, "there are no images in {:?}", args.images);
    if written > 0 {
        let details = CalibrationDetails::default();
        let straight = rectifier.straight();
        write_calibration(&calibration, straight, CalibrationFormat::Ros, &details)?;
    }
    print(&format!("{}: {written} images written, {failed} not", args.output.display()))?;
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The name of an image's file. A PNG keeps its name; others get that ending after their own, as `a.jpg` and `a.png` may both be there.
fn output_name(image: &str) -> String {
    format!("{}.png", stem(image.strip_suffix(".png").unwrap_or(image)))
}

/// The files that are written, none of which may be lost.
struct Outputs<'a> {
    folder: &'a Path,
    replace: bool,
    /// Device and number of each file that is read.
    inputs: BTreeSet<[u64; 2]>,
    written: BTreeSet<PathBuf>,
}

impl<'a> Outputs<'a> {
    fn new(args: &'a RectifyArgs, source: &Source) -> Self {
        let read = source.files().chain([args.camera.as_path()]);
        Self {
            folder: &args.output,
            replace: args.replace,
            inputs: read.filter_map(identity).collect(),
            written: BTreeSet::new(),
        }
    }

    /// The path of a file that may be written, once.
    fn claim(&mut self, name: &str) -> anyhow::Result<PathBuf> {
        let path = self.folder.join(name);
        ensure!(
            !identity(&path).is_some_and(|file| self.inputs.contains(&file)),
            "{path:?} would be written over, and it is read: name another folder with `-o`"
        );
        ensure!(
            !self.written.contains(&path),
            "two images would become {path:?}: rectify them into different folders"
        );
        ensure!(
            self.replace || !path.exists(),
            "{path:?} is there already: name another folder with `-o`, or replace it with `--replace`"
        );
        self.written.insert(path.clone());
        Ok(path)
    }
}

/// Device and number of a file, however its path is written.
fn identity(path: &Path) -> Option<[u64; 2]> {
    let file = std::fs::metadata(path).ok()?;
    Some([file.dev(), file.ino()])
}

fn rectified(
    rectifier: &Rectifier,
    item: Item,
    bayer: Option<BayerPattern>,
) -> anyhow::Result<GrayImage> {
    let name = item.name.clone();
    let image = item.into_image(bayer).map_err(anyhow::Error::msg)?.grey;
    let mut straight = GrayImage::filled(image.width(), image.height(), 0);
    let view = image.view().with_context(|| format!("{name} has no pixels"))?;
    ensure!(
        rectifier.rectify(view, straight.pixels_mut()),
        "{name} has {} x {} pixels, and the calibration is for {} x {}: calibrate in the mode of the images",
        image.width(),
        image.height(),
        rectifier.camera().width,
        rectifier.camera().height
    );
    Ok(straight)
}

fn save(image: &GrayImage, path: &Path) -> anyhow::Result<()> {
    let [width, height] = [image.width() as u32, image.height() as u32];
    image::save_buffer(path, image.pixels(), width, height, image::ExtendedColorType::L8)
        .with_context(|| format!("writing {path:?}"))
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use geometry::{CameraModel, Distortion};

    use super::*;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: RectifyArgs,
    }

    fn rectify(text: &[&str]) -> Result<(), String> {
        let args =
            Program::try_parse_from([&["rectify"], text].concat()).map_err(|e| e.to_string())?;
        run(&args.args).map(drop).map_err(|e| format!("{e:#}"))
    }

    #[test]
    fn neither_the_calibration_nor_a_picture_is_written_over() {
        let home = tempfile::tempdir().unwrap();
        let path = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
        let [here, measured, photo] = ["", "camera.yaml", "a.png"].map(path);
        let distortion = Distortion::BrownConrady([-0.3, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let camera = CameraModel { distortion, ..CameraModel::pinhole(16, 12, 20.0) };
        let details = CalibrationDetails::default();
        write_calibration(Path::new(&measured), &camera, CalibrationFormat::Ros, &details).unwrap();
        save(&GrayImage::filled(16, 12, 90), Path::new(&photo)).unwrap();
        let before = [&measured, &photo].map(|file| std::fs::read(file).unwrap());
        let all = |more: &[&str]| rectify(&[&["--camera", &measured, &photo, "-o"], more].concat());
        for more in [&[here.as_str()][..], &[here.as_str(), "--replace"]] {
            let problem = all(more).unwrap_err();
            assert!(problem.contains("camera.yaml") && problem.contains("it is read"), "{problem}");
        }
        let out = path("out");
        let name = output_name(&photo);
        std::fs::create_dir(&out).unwrap();
        let written = path(&format!("out/{name}"));
        std::fs::hard_link(&photo, &written).unwrap();
        let problem = all(&[&out, "--replace"]).unwrap_err();
        assert!(problem.contains(&name) && problem.contains("it is read"), "{problem}");
        assert_eq!([&measured, &photo].map(|file| std::fs::read(file).unwrap()), before);
        std::fs::remove_dir_all(&out).unwrap();
        all(&[&out]).unwrap();
        std::fs::write(&written, "mine").unwrap();
        let problem = all(&[&out]).unwrap_err();
        assert!(problem.contains("--replace"), "{problem}");
        assert_eq!(std::fs::read(&written).unwrap(), b"mine");
        all(&[&out, "--replace"]).unwrap();
        assert_ne!(std::fs::read(&written).unwrap(), b"mine");
    }

    #[test]
    fn two_images_that_would_become_one_file_are_refused() {
        let home = tempfile::tempdir().unwrap();
        let path = |name: &str| home.path().join(name).to_str().unwrap().to_owned();
        let [measured, one, other, out] = ["camera.yaml", "a/b.png", "a_b.png", "out"].map(path);
        std::fs::create_dir(home.path().join("a")).unwrap();
        let (camera, details) = (CameraModel::pinhole(16, 12, 20.0), CalibrationDetails::default());
        write_calibration(Path::new(&measured), &camera, CalibrationFormat::Ros, &details).unwrap();
        for photo in [&one, &other] {
            save(&GrayImage::filled(16, 12, 90), Path::new(photo)).unwrap();
        }
        let problem = rectify(&["--camera", &measured, &one, &other, "-o", &out]).unwrap_err();
        assert!(problem.contains("two images") && !Path::new(&out).exists(), "{problem}");
    }
}
