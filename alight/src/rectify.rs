//! `alight rectify`: images without the distortion of their lens.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context, ensure};
use clap::Args;
use imaging::{BayerPattern, GrayImage};
use media::{
    CalibrationDetails, CalibrationFormat, Rectifier, read_calibration, write_calibration,
};

use crate::detect::{Item, Source, file_name};
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
    /// Bayer pattern of grey images with a sensor's raw samples: RGGB, GRBG, GBRG or BGGR.
    #[arg(long, value_name = "PATTERN")]
    bayer: Option<BayerPattern>,
    /// Image files (PNG of 8 or 16 bits, JPEG), videos, and folders of them.
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
}

/// Writes each image as a camera with the same focal lengths and principal point, but without distortion, would have taken it.
/// Exit status 1 when an image could not be read or is of another size.
///
/// # Errors
/// When the calibration cannot be read, or a file not be written.
pub(crate) fn run(args: &RectifyArgs) -> anyhow::Result<ExitCode> {
    let rectifier = Rectifier::new(&read_calibration(&args.camera)?);
    std::fs::create_dir_all(&args.output)
        .with_context(|| format!("creating the folder {:?}", args.output))?;
    let [mut written, mut failed] = [0, 0];
    let mut source = Source::new(&args.images);
    while let Some(item) = source.next() {
        let name = item.name.clone();
        match rectified(&rectifier, item, args.bayer) {
            Ok(image) => {
                // A PNG keeps its name; others get that ending after their own, as `a.jpg` and `a.png` may both be there.
                let name = name.strip_suffix(".png").unwrap_or(&name);
                save(&image, &args.output.join(file_name(name)))?;
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
        let calibration = args.output.join("camera.yaml");
        let details = CalibrationDetails::default();
        let straight = rectifier.straight();
        write_calibration(&calibration, straight, CalibrationFormat::Ros, &details)?;
    }
    print(&format!("{}: {written} images written, {failed} not", args.output.display()))?;
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

fn rectified(
    rectifier: &Rectifier,
    item: Item,
    bayer: Option<BayerPattern>,
) -> anyhow::Result<GrayImage> {
    let name = item.name.clone();
    let image = item.into_image(bayer).map_err(anyhow::Error::msg)?;
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
