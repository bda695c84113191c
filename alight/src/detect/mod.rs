//! `alight detect`: finds markers and pads in image files and videos, with poses where a calibration file or a focal length is
//! given, and warns where images and camera do not fit.

mod args;
mod picture;
mod queue;
mod report;
mod source;

use std::collections::BTreeSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Instant;

use fiducial::{Detector, Settings, Tracker};
use geometry::CameraModel;
use imaging::{BayerPattern, GrayView};
use markers::{Marker, Pad};
use media::{StillImage, read_calibration};
use node::read_text;

use crate::terminal::{Output, write_error};
pub(crate) use args::DetectArgs;
use picture::Gallery;
use queue::process_all;
use report::{Detection, Found, Line};
pub(crate) use source::{Item, Source, stem};

/// Prints the detections in each image, in the order given. Exit status 1 when an image could not be read or has no poses as the
/// calibration is for another size, or a drawing could not be written.
///
/// # Errors
/// When the calibration or the markers are invalid, or standard output cannot be written.
pub(crate) fn run(args: &DetectArgs) -> anyhow::Result<ExitCode> {
    let lens = match (&args.camera, args.focal_px) {
        (Some(file), _) => Lens::Calibrated(read_calibration(file)?),
        (None, Some(focal_px)) => Lens::Ideal { focal_px },
        (None, None) => Lens::Unknown,
    };
    let processors = || std::thread::available_parallelism().map_or(1, usize::from);
    let threads = if args.track { 1 } else { args.threads.map_or_else(processors, usize::from) };
    let examiner = Examiner::new(args, lens)?;
    if let Some(note) = Source::note_of_others(&args.images) {
        write_error(&note);
    }
    let source = Source::new(&args.images);
    let printed = examiner.examine_all(source, threads, args.format, Output)?;
    let lacks = [&examiner.lacks_drawing, &examiner.lacks_poses];
    let is_complete =
        printed.unreadable == 0 && !lacks.iter().any(|lacks| lacks.load(Ordering::Relaxed));
    Ok(if is_complete { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// The camera model for poses.
enum Lens {
    /// None: there are no poses.
    Unknown,
    /// An ideal lens, for images of any size.
    Ideal { focal_px: f64 },
    /// A calibration, for images of its size.
    Calibrated(CameraModel),
}

/// Which markers get no pose although the camera is known, and why; `None` where all have a size. A pad gets its pose all the same.
fn lack_of_sizes(markers: &[Marker], has_pad: bool, lens: &Lens) -> Option<String> {
    if matches!(lens, Lens::Unknown) {
        return None;
    }
    let without: Vec<_> = markers.iter().filter(|marker| marker.size_m.is_none()).collect();
    let form = |marker: &&Marker| match marker.family.id_count() {
        Some(_) => "FAMILY:ID:SIZE_M",
        None => "FAMILY:SIZE_M",
    };
    let forms: BTreeSet<&str> = without.iter().map(form).collect();
    let whose = match !has_pad && without.len() == markers.len() {
        true => String::new(),
        false => {
            let names: Vec<String> = without.iter().map(|marker| format!("`{marker}`")).collect();
            format!(" of {}", names.join(", "))
        }
    };
    let what = match without.len() {
        0 => return None,
        1 => "the marker has no size",
        _ => "the markers have no size",
    };
    let forms: Vec<&str> = forms.into_iter().collect();
    Some(format!("no poses{whose}: {what} ({})", forms.join(", ")))
}

/// Maximum number of images without a marker that are searched again without the camera.
const MAX_LOOKS_WITHOUT_CAMERA: usize = 20;

/// Finds markers in images.
struct Examiner {
    markers: Vec<Marker>,
    pads: Vec<Pad>,
    bayer: Option<BayerPattern>,
    lens: Lens,
    tracks: bool,
    gallery: Option<Gallery>,
    /// Whether a drawing could not be written.
    lacks_drawing: AtomicBool,
    /// Whether an image was of another size than the calibration.
    lacks_poses: AtomicBool,
    turn_was_reported: AtomicBool,
    /// How many more are searched without the camera, in doubt of it.
    looks_without_camera: AtomicUsize,
    was_doubted: AtomicBool,
    /// The option that gives the camera.
    camera_option: String,
}

/// The state of a thread.
struct Worker {
    detector: Detector,
    tracker: Option<Tracker>,
}

impl Examiner {
    fn new(args: &DetectArgs, lens: Lens) -> anyhow::Result<Self> {
        let read = |name: &String| Pad::named(name, |file| read_text(file));
        let pads: Vec<Pad> = args.pads.iter().map(read).collect::<Result<_, _>>()?;
        Pad::check_together(&pads)?;
        let mut markers = args.markers.clone();
        for pad in &pads {
            pad.add_markers(&mut markers)?;
        }
        if !pads.is_empty() && matches!(lens, Lens::Unknown) {
            write_error(
                "the pose of a pad needs a known camera: give --camera or --focal-px; now its markers are found one by one",
            );
        }
        if let Some(warning) = lack_of_sizes(&args.markers, !pads.is_empty(), &lens) {
            write_error(&warning);
        }
        Ok(Self {
            markers,
            pads,
            bayer: args.bayer,
            lens,
            tracks: args.track,
            gallery: args.draw.as_deref().map(Gallery::new).transpose()?,
            lacks_drawing: AtomicBool::new(false),
            lacks_poses: AtomicBool::new(false),
            turn_was_reported: AtomicBool::new(false),
            looks_without_camera: AtomicUsize::new(MAX_LOOKS_WITHOUT_CAMERA),
            was_doubted: AtomicBool::new(false),
            camera_option: match (&args.camera, args.focal_px) {
                (Some(file), _) => format!("--camera {}", file.display()),
                (None, focal_px) => format!("--focal-px {}", focal_px.unwrap_or_default()),
            },
        })
    }

    fn worker(&self) -> anyhow::Result<Worker> {
        let detector = Detector::new(&self.markers, Settings::default())?;
        Ok(Worker { detector, tracker: self.tracks.then(Tracker::default) })
    }

    fn examine_all<W: std::io::Write + Send>(
        &self,
        source: Source,
        threads: usize,
        format: args::LineFormat,
        out: W,
    ) -> anyhow::Result<queue::Totals> {
        let workers = (0..threads).map(|_| self.worker()).collect::<Result<Vec<_>, _>>()?;
        process_all(source, workers, |item, worker| self.examine(item, worker), format, out)
    }

    fn examine(&self, item: Item, worker: &mut Worker) -> Line {
        let (name, stem) = (item.name.clone(), item.stem.clone());
        let (time_s, is_frame) = (item.time_s, item.is_frame);
        let video = name.rsplit_once('#').map_or(name.as_str(), |(video, _)| video);
        if item.is_turned
            && let Some(note) = self.note_of_turn("rotation in the video's header", video)
        {
            write_error(&note);
        }
        let error = |error: String| Line::Error { image: name.clone(), error };
        // A panic in one image must not affect the others, which wait for its line.
        let examined = catch_unwind(AssertUnwindSafe(|| {
            let image = item.into_image(self.bayer)?;
            let found = self.detect(&image, [&name, &stem], time_s, worker)?;
            Ok(Line::Image { image: name.clone(), time_s: is_frame.then_some(time_s), found })
        }));
        match examined {
            Ok(Ok(line)) => line,
            Ok(Err(problem)) => error(problem),
            Err(_) => {
                if let Ok(fresh) = self.worker() {
                    *worker = fresh;
                }
                error("the detector failed on this image; please report it".to_owned())
            }
        }
    }

    fn detect(
        &self,
        still: &StillImage,
        [name, stem]: [&str; 2],
        time_s: f64,
        worker: &mut Worker,
    ) -> Result<Found, String> {
        let StillImage { grey: image, exif_orientation } = still;
        let Some(view) = image.view() else {
            return Err("the image has no pixels".to_owned());
        };
        if let Some(orientation) = exif_orientation
            && let Some(note) = self.note_of_turn(&format!("Exif orientation {orientation}"), name)
        {
            write_error(&note);
        }
        let (camera, no_poses) = match self.camera(still, name) {
            Ok(camera) => (camera, None),
            Err(reason) => (None, Some(reason)),
        };
        let Worker { detector, tracker } = worker;
        let began = Instant::now();
        let found = match tracker {
            Some(tracker) => tracker.detect(detector, view, camera.as_ref(), time_s, &mut ()),
            None => detector.detect(view, camera.as_ref(), &mut ()),
        };
        let detect_ms = began.elapsed().as_secs_f64() * 1e3;
        if camera.is_some()
            && found.is_empty()
            && let Some(warning) = self.doubt_of_camera(view, name)
        {
            write_error(&warning);
        }
        // The detections count even if their drawing cannot be written.
        if let Some(gallery) = &self.gallery
            && let Err(problem) = gallery.add(stem, image, found, camera.as_ref())
        {
            write_error(&format!("{problem:#}"));
            self.lacks_drawing.store(true, Ordering::Relaxed);
        }
        let pads = self.pads.iter().filter_map(|pad| {
            let seen = fiducial::observe_pad(pad, found, camera.as_ref()?)?;
            Some(Detection::from_pad(pad, &seen))
        });
        let detections = found.iter().map(Detection::from).chain(pads).collect();
        Ok(Found {
            width: image.width(),
            height: image.height(),
            exif_orientation: *exif_orientation,
            detect_ms,
            no_poses,
            detections,
        })
    }

    /// A warning if a marker is found only without the camera: a shape that the camera model does not map back to a circle or square in
    /// space is rejected. Other detected markers show little about the camera: seen head-on they fit any focal length.
    fn doubt_of_camera(&self, view: GrayView<'_>, name: &str) -> Option<String> {
        let looks = &self.looks_without_camera;
        let one_less = |left: usize| left.checked_sub(1);
        looks.fetch_update(Ordering::Relaxed, Ordering::Relaxed, one_less).ok()?;
        let mut detector = Detector::new(&self.markers, Settings::default()).ok()?;
        let found = detector.detect(view, None, &mut ()).first()?;
        looks.store(0, Ordering::Relaxed);
        if self.was_doubted.swap(true, Ordering::Relaxed) {
            return None;
        }
        let id = found.id.map_or_else(String::new, |id| format!(":{id}"));
        Some(format!(
            "warning: {name} shows what may be {}{id}, but not as a camera with `{}` would show it, so it is not counted: either it is no \
             marker, or the option is wrong, which must be {}; leave it out to find markers without their poses",
            found.family,
            self.camera_option,
            self.camera_needs(view)
        ))
    }

    /// The right value of the option that gives the camera, for an image.
    fn camera_needs(&self, view: GrayView<'_>) -> String {
        match self.lens {
            Lens::Calibrated(_) => {
                "the calibration of the camera that took it, with its zoom and focus".to_owned()
            }
            Lens::Unknown | Lens::Ideal { .. } => {
                format!("in pixels of images of {} x {}", view.width(), view.height())
            }
        }
    }

    /// The note on the first image that a viewer would turn, by the entry of its file that is `cause`: it is searched as it is stored.
    fn note_of_turn(&self, cause: &str, name: &str) -> Option<String> {
        if self.turn_was_reported.swap(true, Ordering::Relaxed) {
            return None;
        }
        Some(format!(
            "note: viewers turn {name} ({cause}); it is searched as it is stored, which is as the sensor saw it \
             and as the images of `alight calibrate board` are read: pixels, poses and drawings are of that, here and in others like it"
        ))
    }

    /// The camera for an image, if one is known.
    ///
    /// # Errors
    /// When the calibration is for images of another size.
    fn camera(&self, still: &StillImage, name: &str) -> Result<Option<CameraModel>, String> {
        let image = &still.grey;
        let (width, height) = (image.width() as u32, image.height() as u32);
        match self.lens {
            Lens::Unknown => Ok(None),
            Lens::Ideal { focal_px } => Ok(Some(CameraModel::pinhole(width, height, focal_px))),
            Lens::Calibrated(camera) if (camera.width, camera.height) == (width, height) => {
                Ok(Some(camera))
            }
            Lens::Calibrated(camera) => {
                if !self.lacks_poses.swap(true, Ordering::Relaxed) {
                    write_error(&warning_of_size(&camera, still, name));
                }
                Err(format!("the calibration is for {} x {} pixels", camera.width, camera.height))
            }
        }
    }
}

/// The warning for the first image of another size than the calibration's.
fn warning_of_size(camera: &CameraModel, still: &StillImage, name: &str) -> String {
    let (width, height) = (still.grey.width() as u32, still.grey.height() as u32);
    let mut warning = format!(
        "warning: {name} has {width} x {height} pixels, but the calibration is for {} x {}: no poses for images of this size",
        camera.width, camera.height
    );
    if still.exif_orientation.is_some() && (camera.width, camera.height) == (height, width) {
        warning.push_str(
            "; it may be of pictures that were turned by their Exif orientation, as OpenCV's `imread` does: calibrate from \
             the pictures as they are stored (`alight calibrate board`, or `IMREAD_IGNORE_ORIENTATION`)",
        );
    }
    warning
}

#[cfg(test)]
mod tests {
    use std::io::{ErrorKind, Write};

    use super::queue::Totals;
    use super::source::DRAWN_ENDING;
    use super::*;
    use clap::Parser;
    use serde_json::Value;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: DetectArgs,
    }

    fn args(text: &[&str]) -> Result<DetectArgs, String> {
        let text = std::iter::once(&"detect").chain(text);
        Program::try_parse_from(text).map(|p| p.args).map_err(|e| e.to_string())
    }

    /// The thesis' marker, head-on, `size_px` wide, at the centre of a grey image.
    fn picture_of_rings(size_px: f64) -> image::GrayImage {
        let drawing = markers::Drawing::new(&"rings".parse().unwrap(), size_px).unwrap();
        image::GrayImage::from_fn(320, 240, |x, y| {
            let sample = |i: u32| {
                let (dx, dy) = (f64::from(i % 4), f64::from(i / 4));
                let at = |px: u32, d: f64, middle: f64| f64::from(px) + (d - 1.5) / 4.0 - middle;
                let (right, up) = (at(x, dx, 159.5), -at(y, dy, 119.5));
                match drawing.ink_at(right, up) {
                    _ if right.abs().max(up.abs()) > drawing.half_extent_m => 120,
                    markers::Ink::Black => 20,
                    markers::Ink::White => 220,
                }
            };
            image::Luma([((0..16).map(sample).sum::<u32>() / 16) as u8])
        })
    }

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for i in 0..9 {
            picture_of_rings(150.0).save(folder.path().join(format!("{i}.png"))).unwrap();
        }
        std::fs::write(folder.path().join("4.png"), "not an image").unwrap();
        image::GrayImage::new(1, 1).save(folder.path().join("7.png")).unwrap();
        folder
    }

    fn examine(text: &[&str], out: impl Write + Send) -> anyhow::Result<Totals> {
        let args = args(text).map_err(anyhow::Error::msg)?;
        let lens = match args.focal_px {
            Some(focal_px) => Lens::Ideal { focal_px },
            None => Lens::Unknown,
        };
        let examiner = Examiner::new(&args, lens)?;
        let threads = usize::from(args.threads.unwrap_or(1));
        examiner.examine_all(Source::new(&args.images), threads, args.format, out)
    }

    #[test]
    fn lines_have_their_fields_and_order_with_any_number_of_threads() {
        let folder = folder();
        let path = folder.path().to_str().unwrap();
        for threads in ["1", "4"] {
            let mut out = Vec::new();
            let text = ["--marker", "rings:0.2", "--focal-px", "300", "--threads", threads];
            let text = [&text[..], &["--format", "jsonl", path, "no/such.png"]].concat();
            let totals = examine(&text, &mut out).unwrap();
            assert_eq!((totals.images, totals.unreadable), (10, 2));
            let lines: Vec<Value> =
                String::from_utf8(out).unwrap().lines().map(|l| l.parse().unwrap()).collect();
            assert_eq!(lines.len(), 10);
            for (i, line) in lines.iter().enumerate() {
                let name = if i == 9 { "no/such.png".into() } else { format!("{path}/{i}.png") };
                assert_eq!(line["image"], name);
                match i {
                    4 => assert!(line["error"].as_str().unwrap().contains("neither a PNG")),
                    7 => assert_eq!(
                        (&line["width"], &line["detections"]),
                        (&1.into(), &Value::Array(vec![]))
                    ),
                    9 => assert!(line["error"].as_str().unwrap().contains("no/such.png")),
                    _ => check_rings(line),
                }
            }
        }
    }

    fn check_rings(line: &Value) {
        assert_eq!((&line["width"], &line["height"]), (&320.into(), &240.into()));
        assert!(line["detect_ms"].as_f64().unwrap() > 0.0);
        let found = &line["detections"][0];
        assert_eq!(
            (&found["family"], &found["id"], &found["corners_px"]),
            (&"rings".into(), &Value::Null, &Value::Null)
        );
        let number = |value: &Value| value.as_f64().unwrap();
        assert!((number(&found["centre_px"][0]) - 159.5).abs() < 0.2, "{found}");
        assert!((number(&found["size_px"]) - 150.0).abs() < 1.5, "{found}");
        assert!((0.0..=1.0).contains(&number(&found["confidence"])));
        // 0.2 m at a focal length of 300 px and a size of 150 px are 0.4 m away.
        assert!((number(&found["pose"]["translation_m"][2]) - 0.4).abs() < 0.01, "{found}");
        assert_eq!(found["pose"]["rotation_wxyz"].as_array().unwrap().len(), 4);
        assert!(number(&found["pose"]["reprojection_rms_px"]) < 1.0);
    }

    /// The thesis' marker, 0.2 m wide and tilted by 50 degrees, as a camera with a focal length of 300 px shows it.
    fn picture_of_tilted_rings() -> image::GrayImage {
        let drawing = markers::Drawing::new(&"rings".parse().unwrap(), 0.2).unwrap();
        let (sin, cos) = 50_f64.to_radians().sin_cos();
        image::GrayImage::from_fn(320, 240, |x, y| {
            let sample = |i: u32| {
                let ray = |px: u32, d: u32, middle: f64| {
                    (f64::from(px) + (f64::from(d) - 1.5) / 4.0 - middle) / 300.0
                };
                let (across, down) = (ray(x, i % 4, 159.5), ray(y, i / 4, 119.5));
                let below = down * 0.3 / (cos - down * sin);
                let (right, up) = (across * (0.3 + below * sin), -below);
                match drawing.ink_at(right, up) {
                    _ if right.abs().max(up.abs()) > drawing.half_extent_m => 120,
                    markers::Ink::Black => 20,
                    markers::Ink::White => 220,
                }
            };
            image::Luma([((0..16).map(sample).sum::<u32>() / 16) as u8])
        })
    }

    #[test]
    fn a_camera_that_hides_a_marker_is_doubted_once() {
        let mut image = imaging::GrayImage::filled(320, 240, 0);
        image.pixels_mut().copy_from_slice(&picture_of_tilted_rings());
        let image = StillImage::from(image);
        let examiner = |focal: &str| {
            let args = args(&["--marker", "rings:0.2", "--focal-px", focal, "a.png"]).unwrap();
            Examiner::new(&args, Lens::Ideal { focal_px: args.focal_px.unwrap() }).unwrap()
        };
        let found = |examiner: &Examiner| {
            let mut worker = examiner.worker().unwrap();
            examiner.detect(&image, ["a.png"; 2], 0.0, &mut worker).unwrap().detections.len()
        };
        assert_eq!(found(&examiner("300")), 1);
        let wrong = examiner("30");
        let view = image.grey.view().unwrap();
        let warning = wrong.doubt_of_camera(view, "a.png").unwrap();
        for part in ["a.png", "rings", "`--focal-px 30`", "320 x 240"] {
            assert!(warning.contains(part), "`{part}` is not in: {warning}");
        }
        assert_eq!(wrong.doubt_of_camera(view, "a.png"), None);
        let args = args(&["--marker", "rings:0.2", "--camera", "wide.yaml", "a.png"]).unwrap();
        let camera = CameraModel::pinhole(320, 240, 30.0);
        let calibrated = Examiner::new(&args, Lens::Calibrated(camera)).unwrap();
        let warning = calibrated.doubt_of_camera(view, "a.png").unwrap();
        assert!(
            warning.contains("`--camera wide.yaml`") && warning.contains("calibration"),
            "{warning}"
        );
        assert!(!warning.contains("in pixels"), "{warning}");
        let other = examiner("30");
        assert_eq!(found(&other), 0);
        assert!(other.was_doubted.load(Ordering::Relaxed));
    }

    /// A JPEG file of the thesis' marker right of the centre, with an Exif orientation.
    fn jpeg_of_orientation(orientation: u8) -> Vec<u8> {
        let mut shifted = image::GrayImage::from_pixel(320, 240, image::Luma([120]));
        image::imageops::replace(&mut shifted, &picture_of_rings(100.0), 60, 10);
        let mut jpeg = std::io::Cursor::new(Vec::new());
        shifted.write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        testing::with_exif_orientation(jpeg.get_ref(), orientation)
    }

    #[test]
    fn a_picture_that_exif_would_turn_has_the_pose_that_the_sensor_saw() {
        let folder = tempfile::tempdir().unwrap();
        for orientation in [1, 3, 6] {
            let file = folder.path().join(format!("{orientation}.jpg"));
            std::fs::write(file, jpeg_of_orientation(orientation)).unwrap();
        }
        // The principal point is far from the image's centre.
        let camera = CameraModel { cx: 140.0, cy: 100.0, ..CameraModel::pinhole(320, 240, 300.0) };
        let path = folder.path().to_str().unwrap();
        let text = ["--marker", "rings:0.2", "--camera", "camera.yaml", "--format", "jsonl", path];
        let args = args(&text).unwrap();
        let examiner = Examiner::new(&args, Lens::Calibrated(camera)).unwrap();
        let mut out = Vec::new();
        examiner.examine_all(Source::new(&args.images), 1, args.format, &mut out).unwrap();
        let lines: Vec<Value> =
            String::from_utf8(out).unwrap().lines().map(|l| l.parse().unwrap()).collect();
        let place = |line: &Value| line["detections"][0]["pose"]["translation_m"].clone();
        assert!(place(&lines[0])[0].as_f64().unwrap() > 0.15, "{}", lines[0]);
        assert!(lines.iter().all(|line| place(line) == place(&lines[0])), "{lines:?}");
        let orientations: Vec<_> = lines.iter().map(|it| it["exif_orientation"].as_u64()).collect();
        assert_eq!(orientations, [None, Some(3), Some(6)]);
        assert!(examiner.turn_was_reported.load(Ordering::Relaxed));
    }

    #[test]
    fn a_picture_that_exif_would_turn_is_reported_once() {
        let examiner =
            Examiner::new(&args(&["--marker", "rings", "a.jpg"]).unwrap(), Lens::Unknown).unwrap();
        let still = |exif_orientation| {
            let grey = imaging::GrayImage::filled(320, 240, 0);
            StillImage { grey, exif_orientation }
        };
        let mut worker = examiner.worker().unwrap();
        examiner.detect(&still(None), ["a.jpg"; 2], 0.0, &mut worker).unwrap();
        assert!(!examiner.turn_was_reported.load(Ordering::Relaxed));
        let note = examiner.note_of_turn("Exif orientation 3", "b.jpg").unwrap();
        assert!(note.contains("b.jpg") && note.contains("Exif orientation 3"), "{note}");
        assert_eq!(examiner.note_of_turn("Exif orientation 3", "c.jpg"), None);
        let upright = CameraModel::pinhole(240, 320, 300.0);
        let warning = warning_of_size(&upright, &still(Some(6)), "a.jpg");
        assert!(warning.contains("320 x 240") && warning.contains("Exif"), "{warning}");
        assert!(!warning_of_size(&upright, &still(None), "a.jpg").contains("Exif"));
        let larger = CameraModel::pinhole(640, 480, 300.0);
        assert!(!warning_of_size(&larger, &still(Some(6)), "a.jpg").contains("Exif"));
    }

    #[test]
    fn a_video_that_viewers_would_turn_is_reported() {
        let examiner =
            Examiner::new(&args(&["--marker", "rings", "a.mp4"]).unwrap(), Lens::Unknown).unwrap();
        let folder = folder();
        let reported = |is_turned: bool| {
            let mut item = Source::new(&[folder.path().join("0.png")]).next().unwrap();
            (item.is_frame, item.is_turned) = (true, is_turned);
            examiner.examine(item, &mut examiner.worker().unwrap());
            examiner.turn_was_reported.load(Ordering::Relaxed)
        };
        assert!(!reported(false));
        assert!(reported(true));
    }

    #[test]
    fn images_of_another_size_than_the_calibration_lack_their_poses_with_the_reason() {
        let folder = folder();
        let photo = folder.path().join("0.png");
        let camera = folder.path().join("camera.yaml");
        let calibration = |width: u32| {
            let details = media::CalibrationDetails::default();
            let model = CameraModel::pinhole(width, 240, 300.0);
            let format = media::CalibrationFormat::Ros;
            media::write_calibration(&camera, &model, format, &details).unwrap();
            let text = ["--marker", "rings:0.2", "--camera", camera.to_str().unwrap()];
            args(&[&text[..], &["--format", "jsonl", photo.to_str().unwrap()]].concat()).unwrap()
        };
        assert_eq!(run(&calibration(320)).unwrap(), ExitCode::SUCCESS);
        let args = calibration(640);
        assert_eq!(run(&args).unwrap(), ExitCode::FAILURE);
        let model = read_calibration(&camera).unwrap();
        let examiner = Examiner::new(&args, Lens::Calibrated(model)).unwrap();
        let mut out = Vec::new();
        examiner.examine_all(Source::new(&args.images), 1, args.format, &mut out).unwrap();
        let line: Value = String::from_utf8(out).unwrap().parse().unwrap();
        assert_eq!(line["no_poses"], "the calibration is for 640 x 240 pixels", "{line}");
        assert_eq!(line["detections"][0]["pose"], Value::Null, "{line}");
    }

    #[test]
    fn a_marker_is_found_also_where_its_drawing_cannot_be_written() {
        let folder = tempfile::tempdir().unwrap();
        let picture = folder.path().join("photo.png");
        picture_of_rings(150.0).save(&picture).unwrap();
        // A folder is where the drawing is to be.
        let drawn = folder.path().join("drawn");
        let name = format!("{}{DRAWN_ENDING}", stem(picture.to_str().unwrap()));
        std::fs::create_dir_all(drawn.join(name)).unwrap();
        let text = ["--marker", "rings:0.2", "--draw", drawn.to_str().unwrap()];
        let args = args(&[&text[..], &[picture.to_str().unwrap()]].concat()).unwrap();
        let examiner = Examiner::new(&args, Lens::Unknown).unwrap();
        let source = Source::new(&args.images);
        let totals = examiner.examine_all(source, 1, args.format, Vec::new()).unwrap();
        assert_eq!(totals, Totals { images: 1, detections: 1, unreadable: 0 });
        assert!(examiner.lacks_drawing.load(Ordering::Relaxed));
        assert_eq!(run(&args).unwrap(), ExitCode::FAILURE);
    }

    #[test]
    fn markers_without_a_size_are_reported_where_a_camera_would_give_poses() {
        let warning_with = |has_pad: bool, markers: &[&str], lens: &Lens| {
            let markers: Vec<Marker> = markers.iter().map(|it| it.parse().unwrap()).collect();
            lack_of_sizes(&markers, has_pad, lens)
        };
        let warning = |markers: &[&str], lens: &Lens| warning_with(false, markers, lens);
        let ideal = Lens::Ideal { focal_px: 1818.0 };
        let any = warning(&["apriltag-36h11:*"], &ideal).unwrap();
        assert_eq!(any, "no poses: the marker has no size (FAMILY:ID:SIZE_M)");
        let rings = warning(&["aruco-4x4-50:7:0.2", "rings"], &ideal).unwrap();
        assert_eq!(rings, "no poses of `rings`: the marker has no size (FAMILY:SIZE_M)");
        let both = warning(&["aruco-4x4-50:7:0.2", "rings", "stag-hd23:4"], &ideal).unwrap();
        let forms = "(FAMILY:ID:SIZE_M, FAMILY:SIZE_M)";
        assert_eq!(
            both,
            format!("no poses of `rings`, `stag-hd23:4`: the markers have no size {forms}")
        );
        let all = warning(&["rings", "stag-hd23:4"], &ideal).unwrap();
        assert_eq!(all, format!("no poses: the markers have no size {forms}"));
        let with_pad = warning_with(true, &["rings"], &ideal).unwrap();
        assert_eq!(with_pad, "no poses of `rings`: the marker has no size (FAMILY:SIZE_M)");
        assert_eq!(warning_with(true, &[], &ideal), None);
        assert_eq!(warning(&["apriltag-36h11:*:0.1", "rings:0.1"], &ideal), None);
        assert_eq!(warning(&["apriltag-36h11:*"], &Lens::Unknown), None);
        assert_eq!(warning(&[], &ideal), None);
    }

    #[test]
    fn a_video_is_tracked_and_drawn() {
        let folder = tempfile::tempdir().unwrap();
        let video = folder.path().join("flight.mjpeg");
        let mut frame = std::io::Cursor::new(Vec::new());
        picture_of_rings(150.0).write_to(&mut frame, image::ImageFormat::Jpeg).unwrap();
        std::fs::write(&video, frame.into_inner().repeat(4)).unwrap();
        let drawn = folder.path().join("drawn");
        let mut out = Vec::new();
        let text = ["--marker", "rings:0.2", "--focal-px", "300", "--format", "jsonl", "--track"];
        let (video, drawn_text) = (video.to_str().unwrap(), drawn.to_str().unwrap());
        let totals = examine(&[&text[..], &["--draw", drawn_text, video]].concat(), &mut out);
        assert_eq!(totals.unwrap(), Totals { images: 4, detections: 4, unreadable: 0 });
        let lines: Vec<Value> =
            String::from_utf8(out).unwrap().lines().map(|l| l.parse().unwrap()).collect();
        assert_eq!(lines[3]["image"], format!("{video}#3"));
        assert!((lines[3]["time_s"].as_f64().unwrap() - 0.12).abs() < 1e-9);
        let found = &lines[3]["detections"][0];
        assert_eq!(found["pose"]["covariance"].as_array().unwrap().len(), 21);
        assert_eq!(found["centre_covariance_px2"].as_array().unwrap().len(), 3);
        assert_eq!(found["wrong_bits"], 0);
        let pictures: Vec<_> =
            std::fs::read_dir(&drawn).unwrap().map(|e| e.unwrap().path()).collect();
        assert_eq!(pictures.len(), 4);
        assert!(pictures[0].to_string_lossy().ends_with(".drawn.png"));
        let picture = image::open(&pictures[0]).unwrap().to_rgb8();
        assert_eq!(picture.dimensions(), (960, 720));
        assert!(picture.pixels().filter(|p| p.0[1] > 200 && p.0[0] < 60).count() > 100);
    }

    #[test]
    fn text_ends_with_the_totals() {
        let folder = folder();
        let mut out = Vec::new();
        examine(&["--marker", "rings", folder.path().to_str().unwrap()], &mut out).unwrap();
        let text = String::from_utf8(out).unwrap();
        assert!(text.contains("0.png  320 x 240 px"), "{text}");
        assert!(text.contains("\n  rings  centre (159."), "{text}");
        assert!(text.contains(" px  largest extent 1"), "{text}");
        assert!(text.contains("4.png  error: "), "{text}");
        assert!(text.ends_with("images: 9, markers found: 7, not readable: 1\n"), "{text}");
    }

    /// Accepts a few lines, then fails.
    struct ClosedPipe {
        lines_left: usize,
        kind: ErrorKind,
    }

    impl Write for ClosedPipe {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            if self.lines_left == 0 {
                return Err(self.kind.into());
            }
            self.lines_left -= 1;
            Ok(bytes.len())
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_closed_pipe_is_not_an_error_and_a_full_disk_is() {
        let folder = folder();
        let path = folder.path().to_str().unwrap();
        let result = |kind| {
            let pipe = ClosedPipe { lines_left: 2, kind };
            examine(&["--marker", "rings", "--threads", "3", path], pipe)
        };
        assert!(result(ErrorKind::BrokenPipe).is_ok());
        let problem = result(ErrorKind::StorageFull).unwrap_err();
        assert!(format!("{problem:#}").contains("writing the results"));
    }

    #[test]
    fn wrong_use_is_explained() {
        let check = |text: &[&str], part: &str| {
            let problem = args(text).unwrap_err();
            assert!(problem.contains(part), "`{part}` is not in: {problem}");
        };
        check(&["a.png"], "--marker");
        check(&["--marker", "ring", "a.png"], "known are");
        check(&["--marker", "rings"], "<IMAGE>");
        check(&["--marker", "rings", "--threads", "0", "a.png"], "1..=256");
        check(&["--marker", "rings", "--focal-px=-3", "a.png"], "above 0");
        check(&["--marker", "rings", "--focal-px=nan", "a.png"], "above 0");
        check(&["--marker", "rings", "--format", "xml", "a.png"], "jsonl");
        check(&["--marker", "rings", "--bayer", "RGB", "a.png"], "it must be RGGB");
        check(&["--marker", "rings", "--track", "--threads", "2", "a.png"], "cannot be used with");
        let twice = examine(&["--marker", "rings", "--marker", "rings:1", "a.png"], Vec::new());
        assert!(twice.unwrap_err().to_string().contains("listed twice"));
    }
}
