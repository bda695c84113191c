//! Searches the frames of a recording again, and compares the new detections with the recorded ones.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::fmt;

use airlink::Unpacker;
use anyhow::{Context, bail, ensure};
use detector::{Search, StageClock};
use flightlog::{Entry, RecordedTape};
use geometry::Point;
use imaging::Converter;
use messages::{
    CameraInfo, Configuration, Detection, Detections, FrameHeader, PixelFormat, TapeEvent, Truth,
    decode, topic,
};

use crate::change::{Change, change_with};
use crate::run::{configuration, configured};
use crate::truth::{Truths, is_in_picture};

/// The detector and the settings of a second search.
#[derive(Clone, Debug, Default)]
pub struct Again {
    /// The detector whose frames and configuration are taken; `None` for the only one of the recording.
    pub detector: Option<String>,
    /// Settings `key=value` of the detector over the recorded configuration.
    pub of_detector: Vec<String>,
    /// Settings `key=value` of the controller over the recorded configuration.
    pub of_controller: Vec<String>,
}

/// A detector that cannot be meant: the recording has none of the name, or several of which none is named.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WrongDetector(String);

impl fmt::Display for WrongDetector {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl std::error::Error for WrongDetector {}

/// The detections of the marker that the controller lands on, in the frames of both searches.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Found {
    /// That marker, `FAMILY` or `FAMILY:ID`.
    pub marker: String,
    /// Frames in which it was found.
    pub frames: usize,
    /// Those of them that were taken in flight and show the pad, by truth.
    pub visible: usize,
    /// Distances between the marker as it was found and the true pad, in metres in space, in the order of the frames: of those that were
    /// taken in flight, show the pad, and in which both searches found it with its pose, so that both sides are of the same frames.
    pub errors_m: Vec<f64>,
    /// How long each search took, without decoding the picture, in milliseconds.
    pub times_ms: Vec<f64>,
}

/// The result of a second search of the frames.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Searched {
    /// The detector.
    pub detector: String,
    /// Its camera.
    pub camera: String,
    /// The markers and pads that were looked for then, by the recorded configuration.
    pub looked_for_then: Vec<String>,
    /// The markers and pads that are looked for now.
    pub looked_for: Vec<String>,
    /// Whether the pictures lost something when they were recorded (JPEG).
    pub is_lossy: bool,
    /// Frames that were searched in flight, as far as the recording has their detections.
    pub searched_then: usize,
    /// Frames that were searched now: those of them whose picture was recorded and can be read.
    pub searched: usize,
    /// Those of them that were taken in flight and show the pad; `None` where the truth is not known.
    pub showing_the_pad: Option<usize>,
    /// Frames whose picture cannot be read.
    pub unreadable: usize,
    /// The recorded detections.
    pub then: Found,
    /// The new detections.
    pub now: Found,
    /// Frames in which the marker was found then and not now.
    pub lost: usize,
    /// Frames in which it is found now and was not then.
    pub gained: usize,
    /// Distances between both, in metres in space; where the truth is known, of the frames whose errors are.
    pub apart_m: Vec<f64>,
    /// The controller's decisions on the new detections, for each tape.
    pub changes: Vec<Change>,
}

/// The messages of a recording about a detector's frames.
#[derive(Default)]
struct Facts {
    detectors: BTreeMap<String, String>,
    controllers: Vec<String>,
    cameras: BTreeMap<String, CameraInfo>,
    /// Detections by detector and the frame's stamp.
    found: BTreeMap<String, BTreeMap<i64, Detections>>,
    truths: Vec<Truth>,
}

impl Facts {
    fn take(&mut self, key: &str, payload: &[u8]) {
        if let Some(detector) = topic::DETECTIONS.first_name(key) {
            if let Ok(message) = decode::<Detections>(payload) {
                let found = self.found.entry(detector.to_owned()).or_default();
                found.insert(message.header.stamp_ns, message);
            }
        } else if let Some(camera) = topic::CAMERA_INFO.first_name(key) {
            if let Ok(info) = decode(payload) {
                self.cameras.insert(camera.to_owned(), info);
            }
        } else if topic::CONFIGURATION.first_name(key).is_some() {
            if let Ok(Configuration { service, instance, toml, .. }) = decode(payload) {
                match service.as_str() {
                    "detector" => drop(self.detectors.insert(instance, toml)),
                    "controller" => self.controllers.push(toml),
                    _ => {}
                }
            }
        } else if key == topic::TRUTH.key(&[]) {
            self.truths.extend(decode::<Truth>(payload).ok());
        }
    }

    /// The configuration of the detector to search with.
    fn detector(&self, again: &Again) -> anyhow::Result<detector::Config> {
        let names = || self.detectors.keys().cloned().collect::<Vec<_>>().join(", ");
        let toml = match &again.detector {
            Some(name) if !self.detectors.contains_key(name) && self.found.contains_key(name) => {
                bail!(WrongDetector(format!(
                    "only Alight's own detectors can search again: `{name}` is another one, as it published no configuration; the recording has: {}",
                    names()
                )))
            }
            Some(name) => self.detectors.get(name).ok_or_else(|| {
                WrongDetector(format!(
                    "the recording has no configuration of a detector `{name}`; it has: {}",
                    names()
                ))
            })?,
            None => {
                let several = || {
                    WrongDetector(format!(
                        "the recording has several detectors, name one with `--detector`: {}",
                        names()
                    ))
                };
                ensure!(self.detectors.len() < 2, several());
                let only = self.detectors.values().next();
                only.context("the recording has no configuration of a detector")?
            }
        };
        configured("the recorded configuration of the detector", toml, &again.of_detector)
    }

    /// The marker that the controller wants.
    fn marker(&self, tapes: &[RecordedTape], set: &[String]) -> anyhow::Result<String> {
        let of_tape = tapes.first().and_then(configuration);
        let toml = of_tape.or_else(|| self.controllers.last().cloned());
        let toml = toml.context("the recording has no configuration of a controller")?;
        let name = "the recorded configuration of the controller";
        Ok(configured::<controller::Config>(name, &toml, set)?.marker)
    }
}

/// Searches the frames of a recording, which may be several files in any order, again: those that the detector searched then, one
/// after the other. The tapes, of the same recording, are replayed with the new detections.
///
/// # Errors
/// When the recording lacks necessary messages, a setting is refused (a [`node::ConfigError`]), the detector cannot be meant (a
/// [`WrongDetector`]), or a file is not a recording.
pub fn search(
    files: &[Vec<u8>],
    tapes: &[RecordedTape],
    again: &Again,
) -> anyhow::Result<Searched> {
    let files = flightlog::in_order(files)?;
    let mut facts = Facts::default();
    for file in &files {
        flightlog::read(file, |entry| {
            if let Entry::Message(message) = entry {
                facts.take(message.key, message.payload);
            }
        })?;
    }
    let config = facts.detector(again)?;
    let name = again.detector.clone().or_else(|| facts.detectors.keys().next().cloned());
    let name = name.unwrap_or_default();
    let then = facts.found.remove(&name).unwrap_or_default();
    ensure!(!then.is_empty(), "the recording has no detections of the detector `{name}`");
    let info = facts.cameras.get(&config.camera).cloned();
    let looked_for = config.looked_for().map_err(anyhow::Error::msg)?;
    let recorded = Again { detector: again.detector.clone(), ..Again::default() };
    let looked_for_then = facts.detector(&recorded)?.looked_for().map_err(anyhow::Error::msg)?;
    let mut frames = Frames {
        camera: config.camera.clone(),
        search: Search::new(&config).map_err(anyhow::Error::msg)?,
        info,
        truths: Truths::new(std::mem::take(&mut facts.truths)),
        then,
        now: BTreeMap::new(),
        converter: Converter::default(),
        unpacker: Unpacker::default(),
        searched: Searched {
            detector: name.clone(),
            camera: config.camera,
            looked_for_then,
            looked_for,
            then: Found { marker: facts.marker(tapes, &[])?, ..Found::default() },
            now: Found { marker: facts.marker(tapes, &again.of_controller)?, ..Found::default() },
            ..Searched::default()
        },
    };
    if !frames.truths.is_empty() && frames.info.is_some() {
        frames.searched.showing_the_pad = Some(0);
    }
    for file in &files {
        flightlog::read(file, |entry| {
            if let Entry::Picture { header, bytes, .. } = entry {
                frames.picture(&header, bytes);
            }
        })?;
    }
    let Frames { mut searched, now, then, .. } = frames;
    searched.searched_then = then.len();
    if searched.searched == 0 {
        bail!(
            "the recording has no picture of the {} frames of camera `{}` that were searched ({} cannot be read); they are kept with `frames = \"jpeg\"` or \"raw\" of the recorder",
            then.len(),
            searched.camera,
            searched.unreadable
        );
    }
    for tape in tapes {
        searched.changes.push(change_with(tape, &again.of_controller, |event| match event {
            TapeEvent::Detections { publisher, message } if *publisher == name => {
                let message = now.get(&message.header.stamp_ns)?.clone();
                let publisher = Cow::Owned(name.clone());
                Some(TapeEvent::Detections { publisher, message: Cow::Owned(message) })
            }
            _ => None,
        })?);
    }
    Ok(searched)
}

/// The frames that are searched again.
struct Frames {
    camera: String,
    search: Search,
    info: Option<CameraInfo>,
    truths: Truths,
    /// The recorded and the new detections, by the frame's stamp.
    then: BTreeMap<i64, Detections>,
    now: BTreeMap<i64, Detections>,
    converter: Converter,
    unpacker: Unpacker,
    searched: Searched,
}

impl Frames {
    /// Takes a picture. Of one that is in two files, as the last of a file may be, the first counts.
    fn picture(&mut self, header: &FrameHeader, bytes: &[u8]) {
        let stamp_ns = header.stamp_ns;
        let is_new = !self.now.contains_key(&stamp_ns);
        if header.camera != self.camera || !self.then.contains_key(&stamp_ns) || !is_new {
            return;
        }
        let Some((found, clock)) = self.found(header, bytes) else {
            self.searched.unreadable += 1;
            return;
        };
        let took_ms = clock.elapsed().as_secs_f64() * 1e3;
        let Some(then) = self.then.get(&stamp_ns) else { return };
        let now = Detections {
            detector: then.detector.clone(),
            header: then.header.clone(),
            detections: found,
            stages: clock.into_stages(),
        };
        self.searched.is_lossy |= header.format == PixelFormat::Jpeg;
        self.searched.searched += 1;
        self.compare(took_ms, &now);
        self.now.insert(stamp_ns, now);
    }

    /// The detections in a picture, and the clock of its search; `None` when it cannot be read.
    fn found(
        &mut self,
        header: &FrameHeader,
        bytes: &[u8],
    ) -> Option<(Vec<Detection>, StageClock)> {
        let FrameHeader { width, height, format, .. } = *header;
        let model = self.info.as_ref().and_then(CameraInfo::model);
        let model = model.filter(|it| (it.width, it.height) == (width, height));
        if format == PixelFormat::Jpeg {
            let parts = self.unpacker.unpack(header, bytes).ok()?;
            let mut clock = StageClock::start();
            let found = self.search.parts(&parts, header, model.as_ref(), &mut clock);
            return Some((found, clock));
        }
        let mut clock = StageClock::start();
        let view =
            self.converter.convert(bytes, width as usize, height as usize, format.sample_format()?);
        let found = self.search.whole(view.ok()?, header, model.as_ref(), &mut clock);
        Some((found, clock))
    }

    fn compare(&mut self, took_ms: f64, now: &Detections) {
        let Self { then, searched, info, truths, .. } = self;
        let Some(then) = then.get(&now.header.stamp_ns) else { return };
        let pad = info.as_ref().and_then(|it| truths.pad_in_camera(now.header.stamp_ns, it));
        let model = info.as_ref().and_then(CameraInfo::model);
        // On the ground the picture shows a part of the marker at most.
        let is_visible = !truths.is_on_ground(now.header.stamp_ns)
            && pad.zip(model).is_some_and(|(pad, model)| is_in_picture(pad, &model));
        if let Some(showing) = &mut searched.showing_the_pad {
            *showing += usize::from(is_visible);
        }
        let then_ms = then.stages.iter().map(|it| f64::from(it.micros)).sum::<f64>() * 1e-3;
        let mut positions = [None, None];
        let sides = [(&mut searched.then, then, then_ms), (&mut searched.now, now, took_ms)];
        for ((side, message, ms), position) in sides.into_iter().zip(&mut positions) {
            side.times_ms.push(ms);
            let Some(seen) = message.first_of(&side.marker) else { continue };
            side.frames += 1;
            side.visible += usize::from(is_visible);
            let [x, y, z] = match &seen.pose {
                Some(pose) => pose.camera_from_marker.translation_m,
                None => [f64::NAN; 3],
            };
            *position = Some(Point::new(x, y, z));
        }
        match positions {
            [Some(_), None] => searched.lost += 1,
            [None, Some(_)] => searched.gained += 1,
            [Some(one), Some(other)] => {
                let apart_m = (other - one).norm();
                // A vehicle on the pad is a few centimetres from it and does not move: such frames would be most of the comparison.
                let is_compared = searched.showing_the_pad.is_none() || is_visible;
                if !is_compared || !apart_m.is_finite() {
                    return;
                }
                searched.apart_m.push(apart_m);
                if let Some(pad) = pad {
                    searched.then.errors_m.push((one - pad).norm());
                    searched.now.errors_m.push((other - pad).norm());
                }
            }
            [None, None] => {}
        }
    }
}
