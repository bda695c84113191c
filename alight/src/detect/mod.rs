//! `alight detect`: markers in image files and videos, one line an image.

mod picture;
mod source;

use std::collections::VecDeque;
use std::fmt::Write as _;
use std::io::{ErrorKind, Write};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use clap::{Args, ValueEnum};
use fiducial::{
    Detector, MarkerPose, Observation, PadObservation, PoseSolution, Settings, Tracker,
};
use geometry::{CameraModel, Pixel};
use imaging::{BayerPattern, GrayImage};
use markers::{Marker, Pad};
use media::read_calibration;
use serde::Serialize;

use picture::Gallery;
use source::{Item, Source};

/// Images that may be done before the one whose turn it is to be printed, for each thread.
const AHEAD: usize = 4;

/// What `alight detect` is told.
#[derive(Args, Clone, Debug)]
pub(crate) struct DetectArgs {
    /// Marker to look for: `FAMILY:ID[:SIZE_M]`, or `FAMILY[:SIZE_M]` for a family without ids (rings). May be repeated.
    #[arg(long = "marker", required_unless_present = "pads", value_name = "MARKER")]
    markers: Vec<Marker>,
    /// Pad to look for, whose markers are solved together: `a4`, which comes with the program, or a TOML file. It needs
    /// a camera, and is reported as a marker `pad:ID`. May be repeated.
    #[arg(long = "pad", value_name = "PAD")]
    pads: Vec<String>,
    /// Calibration of the camera (ROS camera_info, Kalibr camchain or OpenCV FileStorage, as YAML); with it, markers
    /// of known size have a pose.
    #[arg(long, value_name = "FILE", conflicts_with = "focal_px")]
    camera: Option<PathBuf>,
    /// Focal length in pixels, in place of a calibration: an ideal lens, its axis in the middle of the image.
    #[arg(long, value_name = "PX", value_parser = focal_px)]
    focal_px: Option<f64>,
    /// Images looked at at the same time; as many as there are processors otherwise.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    threads: Option<u16>,
    /// What is printed: text for people, or one JSON object a line.
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
    /// The colours in front of the pixels of grey images that are a sensor's raw samples: RGGB, GRBG, GBRG or BGGR.
    #[arg(long, value_name = "PATTERN")]
    bayer: Option<BayerPattern>,
    /// Look first where the markers of the last images should be by now; one image after the other.
    #[arg(long, conflicts_with = "threads")]
    track: bool,
    /// Folder for annotated pictures: outlines, ids, confidence, and the axes of poses.
    #[arg(long, value_name = "DIR")]
    draw: Option<PathBuf>,
    /// Image files (PNG of 8 or 16 bits, JPEG), videos (Motion JPEG as AVI or stream, H.264 as MP4 or stream), and folders
    /// of them.
    #[arg(required = true, value_name = "IMAGE")]
    images: Vec<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Format {
    Text,
    Jsonl,
}

fn focal_px(text: &str) -> Result<f64, &'static str> {
    let number: Option<f64> = text.parse().ok();
    number
        .filter(|px| *px > 0.0 && *px <= 1e6)
        .ok_or("a focal length is a number of pixels above 0 and up to 1e6")
}

/// Prints what is found in each image, in the order given. Status 1 when an image could not be read.
///
/// # Errors
/// When the calibration cannot be read, the markers cannot be looked for, or standard output cannot be written.
pub(crate) fn run(args: &DetectArgs) -> anyhow::Result<ExitCode> {
    let lens = match (&args.camera, args.focal_px) {
        (Some(file), _) => Lens::Calibrated(read_calibration(file)?),
        (None, Some(focal_px)) => Lens::Ideal { focal_px },
        (None, None) => Lens::Unknown,
    };
    let processors = || std::thread::available_parallelism().map_or(1, usize::from);
    let threads = if args.track { 1 } else { args.threads.map_or_else(processors, usize::from) };
    let examiner = Examiner::new(args, lens)?;
    let source = Source::new(&args.images);
    let printed = examine_all(source, &examiner, threads, args.format, std::io::stdout())?;
    Ok(if printed.unreadable == 0 { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// How poses are found.
enum Lens {
    /// They are not.
    Unknown,
    /// By an ideal lens over images of any size.
    Ideal { focal_px: f64 },
    /// By a calibration, for images of its size.
    Calibrated(CameraModel),
}

/// Looks for markers in one image after the other.
struct Examiner {
    markers: Vec<Marker>,
    pads: Vec<Pad>,
    bayer: Option<BayerPattern>,
    lens: Lens,
    tracks: bool,
    gallery: Option<Gallery>,
    was_warned: AtomicBool,
}

/// What a thread needs to look for markers.
struct Worker {
    detector: Detector,
    tracker: Option<Tracker>,
}

impl Examiner {
    fn new(args: &DetectArgs, lens: Lens) -> anyhow::Result<Self> {
        let read = |name: &String| Pad::named(name, |file| std::fs::read_to_string(file));
        let pads: Vec<Pad> = args.pads.iter().map(read).collect::<Result<_, _>>()?;
        let mut markers = args.markers.clone();
        for pad in &pads {
            pad.add_markers(&mut markers);
        }
        Ok(Self {
            markers,
            pads,
            bayer: args.bayer,
            lens,
            tracks: args.track,
            gallery: args.draw.as_deref().map(Gallery::new).transpose()?,
            was_warned: AtomicBool::new(false),
        })
    }

    fn worker(&self) -> anyhow::Result<Worker> {
        let detector = Detector::new(&self.markers, Settings::default())?;
        Ok(Worker { detector, tracker: self.tracks.then(Tracker::default) })
    }

    fn examine(&self, item: Item, worker: &mut Worker) -> Line {
        let (name, time_s, is_frame) = (item.name.clone(), item.time_s, item.is_frame);
        let error = |error: String| Line::Error { image: name.clone(), error };
        // A fault in one image must neither cost the others nor leave them waiting for its line.
        let examined = catch_unwind(AssertUnwindSafe(|| {
            let image = item.into_image(self.bayer)?;
            let found = self.detect(&image, &name, time_s, worker)?;
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
        image: &GrayImage,
        name: &str,
        time_s: f64,
        worker: &mut Worker,
    ) -> Result<Found, String> {
        let Some(view) = image.view() else {
            return Err("an image without pixels".to_owned());
        };
        let camera = self.camera(image, name);
        let Worker { detector, tracker } = worker;
        let began = Instant::now();
        let found = match tracker {
            Some(tracker) => tracker.detect(detector, view, camera.as_ref(), time_s, &mut ()),
            None => detector.detect(view, camera.as_ref(), &mut ()),
        };
        let detect_ms = began.elapsed().as_secs_f64() * 1e3;
        if let Some(gallery) = &self.gallery {
            gallery
                .add(name, image, found, camera.as_ref())
                .map_err(|problem| format!("{problem:#}"))?;
        }
        let pads = self.pads.iter().filter_map(|pad| {
            let seen = fiducial::observe_pad(pad, found, camera.as_ref()?)?;
            Some(Detection::of_pad(pad, &seen))
        });
        let detections = found.iter().map(Detection::from).chain(pads).collect();
        Ok(Found { width: image.width(), height: image.height(), detect_ms, detections })
    }

    fn camera(&self, image: &GrayImage, name: &str) -> Option<CameraModel> {
        let (width, height) = (image.width() as u32, image.height() as u32);
        match self.lens {
            Lens::Unknown => None,
            Lens::Ideal { focal_px } => Some(CameraModel::pinhole(width, height, focal_px)),
            Lens::Calibrated(camera) if (camera.width, camera.height) == (width, height) => {
                Some(camera)
            }
            Lens::Calibrated(camera) => {
                if !self.was_warned.swap(true, Ordering::Relaxed) {
                    Self::warn_of_size(&camera, image, name);
                }
                None
            }
        }
    }

    fn warn_of_size(camera: &CameraModel, image: &GrayImage, name: &str) {
        // Nothing can be done about a standard error that is closed.
        let _ = writeln!(
            std::io::stderr(),
            "warning: {name} has {} x {} pixels, but the calibration is for {} x {}: no poses there, nor in other \
             images of another size",
            image.width(),
            image.height(),
            camera.width,
            camera.height
        );
    }
}

/// What is printed of an image.
#[derive(Debug, Serialize)]
#[serde(untagged)]
enum Line {
    Image {
        image: String,
        #[serde(skip_serializing_if = "Option::is_none")]
        time_s: Option<f64>,
        #[serde(flatten)]
        found: Found,
    },
    Error {
        image: String,
        error: String,
    },
}

#[derive(Debug, Serialize)]
struct Found {
    width: usize,
    height: usize,
    detect_ms: f64,
    detections: Vec<Detection>,
}

#[derive(Debug, Serialize)]
struct Detection {
    family: &'static str,
    id: Option<u32>,
    centre_px: [f64; 2],
    /// xx, xy, yy.
    centre_covariance_px2: [f64; 3],
    corners_px: Option<[[f64; 2]; 4]>,
    size_px: f64,
    wrong_bits: u8,
    confidence: f64,
    pose: Option<Pose>,
}

#[derive(Debug, Serialize)]
struct Pose {
    translation_m: [f64; 3],
    rotation_wxyz: [f64; 4],
    reprojection_rms_px: f64,
    /// The upper triangle row by row: translation, then rotation vector, in the camera frame.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    covariance: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    alternative: Option<Box<Pose>>,
}

impl From<&PoseSolution> for Pose {
    fn from(solution: &PoseSolution) -> Self {
        let origin = solution.camera_from_marker.origin();
        Self {
            translation_m: [origin.x(), origin.y(), origin.z()],
            rotation_wxyz: solution.camera_from_marker.rotation().wxyz(),
            reprojection_rms_px: solution.reprojection_rms_px,
            covariance: Vec::new(),
            alternative: None,
        }
    }
}

impl From<&MarkerPose> for Pose {
    fn from(pose: &MarkerPose) -> Self {
        let best = PoseSolution {
            camera_from_marker: pose.camera_from_marker,
            reprojection_rms_px: pose.reprojection_rms_px,
        };
        let cells = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
        Self {
            covariance: cells.map(|at| pose.covariance[at]).collect(),
            alternative: pose.alternative.as_ref().map(|other| Box::new(Self::from(other))),
            ..Self::from(&best)
        }
    }
}

impl From<&Observation> for Detection {
    fn from(found: &Observation) -> Self {
        let pixel = |p: Pixel| [p.x, p.y];
        let spread = &found.centre_covariance_px2;
        Self {
            family: found.family.name(),
            id: found.id,
            centre_px: pixel(found.centre),
            centre_covariance_px2: [spread.m11, spread.m12, spread.m22],
            corners_px: found.corners.map(|corners| corners.map(pixel)),
            size_px: found.size_px,
            wrong_bits: found.wrong_bits,
            confidence: found.confidence,
            pose: found.pose.as_ref().map(Pose::from),
        }
    }
}

impl Line {
    fn as_text(&self) -> String {
        match self {
            Self::Error { image, error } => format!("{image}  error: {error}\n"),
            Self::Image { image, found, .. } => {
                let Found { width, height, detect_ms, detections } = found;
                let count = detections.len();
                let markers = if count == 1 { "marker" } else { "markers" };
                let mut text = format!(
                    "{image}  {width} x {height} px  {detect_ms:.1} ms  {count} {markers}\n"
                );
                for detection in detections {
                    detection.append_text(&mut text);
                }
                text
            }
        }
    }

    fn as_json(&self) -> String {
        // Only maps with keys that are no texts cannot be written, and there are none.
        let mut json = serde_json::to_string(self).unwrap_or_default();
        json.push('\n');
        json
    }
}

impl Detection {
    fn of_pad(pad: &Pad, seen: &PadObservation) -> Self {
        let spread = &seen.centre_covariance_px2;
        Self {
            family: Pad::FAMILY,
            id: Some(pad.id()),
            centre_px: [seen.centre.x, seen.centre.y],
            centre_covariance_px2: [spread.m11, spread.m12, spread.m22],
            corners_px: None,
            size_px: seen.size_px,
            wrong_bits: 0,
            confidence: seen.confidence,
            pose: Some(Pose::from(&seen.pose)),
        }
    }

    fn append_text(&self, text: &mut String) {
        let id = self.id.map_or_else(String::new, |id| format!(":{id}"));
        let [x, y] = self.centre_px;
        // Writing to a text cannot fail.
        let _ = write!(
            text,
            "  {}{id}  centre ({x:.2}, {y:.2}) px  size {:.1} px  confidence {:.2}",
            self.family, self.size_px, self.confidence
        );
        if let Some(pose) = &self.pose {
            let [x, y, z] = pose.translation_m;
            let _ = write!(
                text,
                "  at ({x:.3}, {y:.3}, {z:.3}) m in the camera frame, rms {:.2} px",
                pose.reprojection_rms_px
            );
        }
        text.push('\n');
    }
}

/// What was printed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Totals {
    images: usize,
    detections: usize,
    unreadable: usize,
}

/// Looks at all images with several threads, and prints their lines in the order of the images. Whoever reads the
/// output may stop reading, which ends the work.
fn examine_all<W: Write + Send>(
    source: Source,
    examiner: &Examiner,
    threads: usize,
    format: Format,
    out: W,
) -> anyhow::Result<Totals> {
    let workers = (0..threads).map(|_| examiner.worker()).collect::<Result<Vec<_>, _>>()?;
    let queue = Queue::new(source, threads * AHEAD, format, out);
    std::thread::scope(|scope| {
        for mut worker in workers {
            let queue = &queue;
            scope.spawn(move || {
                while let Some((index, item)) = queue.take() {
                    queue.finish(index, examiner.examine(item, &mut worker));
                }
            });
        }
    });
    let printer = queue.printer.into_inner().unwrap_or_else(PoisonError::into_inner);
    printer.end()
}

/// Hands out the images with their numbers and takes their lines, so that only few lines ever wait for an earlier one.
struct Queue<W> {
    /// Locked before the printer, never after it.
    source: Mutex<Source>,
    window: usize,
    printer: Mutex<Printer<W>>,
    room: Condvar,
}

struct Printer<W> {
    out: W,
    format: Format,
    /// The next image that is handed out.
    next: usize,
    /// Lines that wait, beginning with the one whose turn it is.
    waiting: VecDeque<Option<Line>>,
    totals: Totals,
    stopped_by: Option<std::io::Error>,
}

impl<W: Write> Queue<W> {
    fn new(source: Source, window: usize, format: Format, out: W) -> Self {
        let printer = Printer {
            out,
            format,
            next: 0,
            waiting: VecDeque::with_capacity(window),
            totals: Totals::default(),
            stopped_by: None,
        };
        let source = Mutex::new(source);
        Self { source, window, printer: Mutex::new(printer), room: Condvar::new() }
    }

    /// The next image and its number; `None` when there is no more to do.
    fn take(&self) -> Option<(usize, Item)> {
        let mut source = self.source.lock().unwrap_or_else(PoisonError::into_inner);
        let has_to_wait = |printer: &mut Printer<W>| {
            printer.stopped_by.is_none() && printer.waiting.len() >= self.window
        };
        let printer =
            self.room.wait_while(self.lock(), has_to_wait).unwrap_or_else(PoisonError::into_inner);
        if printer.stopped_by.is_some() {
            return None;
        }
        drop(printer);
        // Decoding a video takes time, in which lines can be printed.
        let item = source.next()?;
        let mut printer = self.lock();
        printer.waiting.push_back(None);
        printer.next += 1;
        Some((printer.next - 1, item))
    }

    /// Takes the line of image `index`, and prints all whose turn has come.
    fn finish(&self, index: usize, line: Line) {
        let mut printer = self.lock();
        let first = printer.next - printer.waiting.len();
        if let Some(slot) = printer.waiting.get_mut(index - first) {
            *slot = Some(line);
        }
        while let Some(Some(_)) = printer.waiting.front() {
            if let Some(Some(line)) = printer.waiting.pop_front() {
                printer.print(&line);
            }
        }
        self.room.notify_all();
    }

    // A thread that panicked leaves lines that are still lines.
    fn lock(&self) -> MutexGuard<'_, Printer<W>> {
        self.printer.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<W: Write> Printer<W> {
    fn print(&mut self, line: &Line) {
        self.totals.images += 1;
        match line {
            Line::Image { found, .. } => self.totals.detections += found.detections.len(),
            Line::Error { .. } => self.totals.unreadable += 1,
        }
        let text = match self.format {
            Format::Text => line.as_text(),
            Format::Jsonl => line.as_json(),
        };
        self.write(&text);
    }

    fn write(&mut self, text: &str) {
        if self.stopped_by.is_none()
            && let Err(problem) =
                self.out.write_all(text.as_bytes()).and_then(|()| self.out.flush())
        {
            self.stopped_by = Some(problem);
        }
    }

    fn end(mut self) -> anyhow::Result<Totals> {
        if self.format == Format::Text {
            let Totals { images, detections, unreadable } = self.totals;
            self.write(&format!(
                "images: {images}, markers found: {detections}, not readable: {unreadable}\n"
            ));
        }
        match self.stopped_by {
            Some(problem) if problem.kind() != ErrorKind::BrokenPipe => {
                Err(anyhow::Error::new(problem).context("writing the results"))
            }
            _ => Ok(self.totals),
        }
    }
}

#[cfg(test)]
mod tests {
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

    /// The thesis' marker, seen head-on, `size_px` large, in the middle of a grey image.
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
        examine_all(Source::new(&args.images), &examiner, threads, args.format, out)
    }

    #[test]
    fn lines_are_as_agreed_and_in_order_with_any_number_of_threads() {
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
        // 0.2 m that look like 150 of 300 pixels are 0.4 m away.
        assert!((number(&found["pose"]["translation_m"][2]) - 0.4).abs() < 0.01, "{found}");
        assert_eq!(found["pose"]["rotation_wxyz"].as_array().unwrap().len(), 4);
        assert!(number(&found["pose"]["reprojection_rms_px"]) < 1.0);
    }

    #[test]
    fn a_video_is_followed_frame_by_frame_and_drawn() {
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
        assert!(text.contains("4.png  error: "), "{text}");
        assert!(text.ends_with("images: 9, markers found: 7, not readable: 1\n"), "{text}");
    }

    /// Takes a few lines, then is gone.
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
    fn a_closed_pipe_ends_the_work_quietly_and_a_full_disk_does_not() {
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
    fn a_slow_image_holds_back_only_a_window_of_lines() {
        let source = Source::new(&vec![PathBuf::from("a.png"); 100]);
        let queue = Queue::new(source, 3, Format::Jsonl, Vec::new());
        let line = |i: usize| Line::Error { image: i.to_string(), error: String::new() };
        let take = || queue.take().map(|(index, _)| index);
        assert_eq!([take(), take(), take()], [Some(0), Some(1), Some(2)]);
        queue.finish(2, line(2));
        queue.finish(1, line(1));
        assert_eq!(queue.lock().waiting.len(), 3);
        queue.finish(0, line(0));
        assert_eq!(queue.lock().waiting.len(), 0);
        assert_eq!(take(), Some(3));
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
