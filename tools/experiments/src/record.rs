//! Reads and writes the results of a detector, one line of JSON per frame; the same format for this detector and for others.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use fiducial::tracker::{Tracker, TrackingSettings};
use fiducial::{Detector, Observation, Settings};
use image::GrayImage;
use imaging::GrayView;
use markers::{Family, Marker};
use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

use crate::set::Set;
use crate::store::{self, StoredFrame};

/// The name of this detector's results.
pub const OURS: &str = "alight";

/// The name of its results with all families of the experiment at once.
pub const ALL_AT_ONCE: &str = "alight-all";

/// The name of its results with tracking.
pub const FOLLOWING: &str = "alight-following";

/// All names of this detector's results; others are of other detectors.
pub const ALL_OURS: [&str; 3] = [OURS, ALL_AT_ONCE, FOLLOWING];

/// The result for one frame.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Record {
    /// The frame's file.
    pub image: String,
    /// Processor time in milliseconds.
    pub ms: f64,
    /// The detections.
    pub found: Vec<Found>,
}

/// A detection.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Found {
    /// Its family.
    pub family: String,
    /// Its id.
    pub id: Option<u32>,
    /// The pixel of its centre.
    pub centre_px: [f64; 2],
    /// Covariance of the centre: xx, xy, yy.
    #[serde(default)]
    pub centre_covariance_px2: Option<[f64; 3]>,
    /// Its corners: its own top left first, then clockwise.
    #[serde(default)]
    pub corners_px: Option<[[f64; 2]; 4]>,
    /// Its position in the camera frame.
    #[serde(default)]
    pub translation_m: Option<[f64; 3]>,
    /// Variance of the distance along the optical axis, in square metres.
    #[serde(default)]
    pub range_variance_m2: Option<f64>,
    /// The confidence, on the detector's own scale.
    #[serde(default)]
    pub confidence: Option<f64>,
}

#[cfg(test)]
impl Found {
    /// A detection of a family at the first pixel, without further values.
    pub fn sample(family: &str) -> Self {
        Self {
            family: family.to_owned(),
            id: None,
            centre_px: [0.0; 2],
            centre_covariance_px2: None,
            corners_px: None,
            translation_m: None,
            range_variance_m2: None,
            confidence: None,
        }
    }
}

impl From<&Observation> for Found {
    fn from(seen: &Observation) -> Self {
        let covariance = &seen.centre_covariance_px2;
        Self {
            family: seen.family.name().to_owned(),
            id: seen.id,
            centre_px: [seen.centre.x, seen.centre.y],
            centre_covariance_px2: Some([
                covariance[(0, 0)],
                covariance[(0, 1)],
                covariance[(1, 1)],
            ]),
            corners_px: seen.corners.map(|corners| corners.map(|c| [c.x, c.y])),
            translation_m: seen.pose.map(|pose| {
                let origin = pose.camera_from_marker.origin();
                [origin.x(), origin.y(), origin.z()]
            }),
            range_variance_m2: seen.pose.map(|pose| pose.covariance[(2, 2)]),
            confidence: Some(seen.confidence),
        }
    }
}

/// The file of a detector's answers to a set with one family.
pub fn file(results: &Path, detector: &str, set: Set, family: &str) -> PathBuf {
    results.join(detector).join(set.name()).join(format!("{family}.jsonl"))
}

/// Processor time of this thread, in milliseconds.
pub fn processor_ms() -> f64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as f64 * 1e3 + time.tv_nsec as f64 * 1e-6
}

/// An image on disk, as grey.
///
/// # Errors
/// When the file cannot be read or is no image.
pub fn read(path: &Path) -> anyhow::Result<GrayImage> {
    let image = image::ImageReader::open(path)
        .with_context(|| format!("reading {}", path.display()))?
        .with_guessed_format()?
        .decode()
        .with_context(|| format!("reading {}", path.display()))?;
    Ok(image.into_luma8())
}

/// Our detector's answer to an image: the shortest time of some `runs`.
///
/// # Errors
/// When the image is larger than any detector takes.
pub fn answer(
    detector: &mut Detector,
    image: &GrayImage,
    camera: Option<&geometry::CameraModel>,
    runs: usize,
) -> anyhow::Result<(f64, Vec<Found>)> {
    let (width, height) = (image.width() as usize, image.height() as usize);
    let view = GrayView::packed(image.as_raw(), width, height).context("an image")?;
    let mut shortest = f64::INFINITY;
    let mut found = Vec::new();
    for _ in 0..runs.max(1) {
        let start = processor_ms();
        let seen = detector.detect(view, camera, &mut ());
        shortest = shortest.min(processor_ms() - start);
        found = seen.iter().map(Found::from).collect();
    }
    Ok((shortest, found))
}

/// The ids that a detector looks for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ids {
    /// All of the family.
    Any,
    /// The one that a frame shows, as a landing on that marker does: distinguishing one id from no marker needs less evidence.
    Shown,
}

/// Runs the detector for `markers` over the frames of a folder.
///
/// # Errors
/// When a frame cannot be read or the markers are invalid.
pub fn run(
    folder: &Path,
    markers: &[Marker],
    ids: Ids,
    runs: usize,
) -> anyhow::Result<Vec<(StoredFrame, Record)>> {
    let mut detector = Detector::new(markers, Settings::default())?;
    let mut known = None;
    store::frames(folder)?
        .into_iter()
        .map(|frame| {
            let image = read(&folder.join(&frame.image))?;
            let shown = frame.marker.as_ref().and_then(|truth| truth.id);
            if ids == Ids::Shown && shown != known {
                let of_id = |marker: &Marker| Marker { id: shown, ..*marker };
                let markers: Vec<Marker> = markers.iter().map(of_id).collect();
                detector = Detector::new(&markers, Settings::default())?;
                known = shown;
            }
            let (ms, found) = answer(&mut detector, &image, Some(&frame.camera.model()), runs)?;
            let record = Record { image: frame.image.clone(), ms, found };
            Ok((frame, record))
        })
        .collect()
}

/// Tracks markers through the frames of a folder, several times; the shortest time of each frame counts.
///
/// # Errors
/// When a frame cannot be read or the markers are invalid.
pub fn follow(
    folder: &Path,
    markers: &[Marker],
    rate_hz: f64,
    runs: usize,
) -> anyhow::Result<Vec<Record>> {
    let frames = store::frames(folder)?;
    let images: Vec<GrayImage> =
        frames.iter().map(|frame| read(&folder.join(&frame.image))).collect::<Result<_, _>>()?;
    let mut records: Vec<Record> = Vec::new();
    for _ in 0..runs.max(1) {
        let mut detector = Detector::new(markers, Settings::default())?;
        // Without full searches, to time tracking only.
        let mut tracker = Tracker::new(TrackingSettings { full_search_period: u32::MAX });
        for (index, (frame, image)) in frames.iter().zip(&images).enumerate() {
            let (width, height) = (image.width() as usize, image.height() as usize);
            let view = GrayView::packed(image.as_raw(), width, height).context("an image")?;
            let (camera, time_s) = (frame.camera.model(), index as f64 / rate_hz);
            let start = processor_ms();
            let seen = tracker.detect(&mut detector, view, Some(&camera), time_s, &mut ());
            let ms = processor_ms() - start;
            match records.get_mut(index) {
                Some(record) => record.ms = record.ms.min(ms),
                None => {
                    let found = seen.iter().map(Found::from).collect();
                    records.push(Record { image: frame.image.clone(), ms, found });
                }
            }
        }
    }
    Ok(records)
}

/// Writes the results of a detector.
///
/// # Errors
/// When the file cannot be written.
pub fn write<'a>(path: &Path, records: impl IntoIterator<Item = &'a Record>) -> anyhow::Result<()> {
    let mut text = String::new();
    for record in records {
        text.push_str(&serde_json::to_string(record)?);
        text.push('\n');
    }
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    std::fs::write(path, text).with_context(|| format!("writing {}", path.display()))
}

/// The results in a file's text. An unknown field and an unknown family are refused: their values would be ignored
/// silently, or count as a false detection.
///
/// # Errors
/// When a line is no result, with the file and the line.
pub fn parse(path: &Path, text: &str) -> anyhow::Result<Vec<Record>> {
    let parsed = |(at, line): (usize, &str)| {
        let place = || format!("line {} of {}", at + 1, path.display());
        let record: Record = serde_json::from_str(line).with_context(place)?;
        let unknown = record.found.iter().find(|found| Family::named(&found.family).is_none());
        if let Some(Found { family, .. }) = unknown {
            let known = Family::ALL.map(Family::name).join(", ");
            bail!("{}: there is no family `{family}`; known are {known}", place());
        }
        Ok(record)
    };
    text.lines().enumerate().map(parsed).collect()
}

/// The results of a detector with the frames of a folder; `None` if there are none.
///
/// # Errors
/// When the results are damaged, or lack a frame.
pub fn join(path: &Path, folder: &Path) -> anyhow::Result<Option<Vec<(StoredFrame, Record)>>> {
    let Ok(text) = std::fs::read_to_string(path) else { return Ok(None) };
    let mut records = std::collections::HashMap::new();
    for record in parse(path, &text)? {
        records.insert(record.image.clone(), record);
    }
    let joined = store::frames(folder)?.into_iter().map(|frame| {
        let record = records.remove(&frame.image).with_context(|| {
            format!("{} has no line for the frame {}", path.display(), frame.image)
        })?;
        Ok((frame, record))
    });
    joined.collect::<anyhow::Result<_>>().map(Some)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_unknown_field_is_refused_with_its_name_and_line() {
        let line = |name: &str| {
            let found = format!(
                "{{\"family\":\"rings\",\"id\":null,\"centre_px\":[1,2],\"{name}\":[1,0,1]}}"
            );
            format!("{{\"image\":\"a.png\",\"ms\":1.0,\"found\":[{found}]}}")
        };
        let path = Path::new("mine.jsonl");
        let good = line("centre_covariance_px2");
        let records = parse(path, &good).unwrap();
        assert_eq!(records[0].found[0].centre_covariance_px2, Some([1.0, 0.0, 1.0]));
        let text = format!("{good}\n{}\n", line("covariance_px2"));
        let error = format!("{:#}", parse(path, &text).unwrap_err());
        assert!(error.contains("line 2 of mine.jsonl"), "{error}");
        assert!(error.contains("unknown field `covariance_px2`"), "{error}");
        assert!(parse(path, "{\"image\":\"a.png\",\"ms\":1,\"found\":[],\"time_ms\":1}").is_err());
    }

    #[test]
    fn an_unknown_family_is_refused_with_its_line() {
        let line = |family: &str| {
            format!(
                "{{\"image\":\"a.png\",\"ms\":1,\"found\":[{{\"family\":\"{family}\",\"id\":3,\"centre_px\":[1,2]}}]}}"
            )
        };
        let text = [line("aruco-4x4-50"), line("aruco_4x4_50")].join("\n");
        let error = parse(Path::new("mine.jsonl"), &text).unwrap_err().to_string();
        assert!(
            error.starts_with("line 2 of mine.jsonl: ") && error.contains("`aruco_4x4_50`"),
            "{error}"
        );
        assert!(error.contains("aruco-4x4-50, "), "{error}");
    }
}
