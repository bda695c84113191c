//! Reads the data for a calibration from a flight from its recording: the vehicle's poses, one detector's detections of a
//! marker, the camera's information and configuration.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context, ensure};
use calibration::{ConfiguredCamera, MarkerSample, VehicleSample};
use controller::wire::body_from_camera;
use geometry::{Point, Rotation, Vector};
use messages::{CameraInfo, Detections};
use report::{Flight, FlightReader, replay_tapes};

/// A flight as it is calibrated from.
pub(super) struct RecordedFlight {
    /// The camera's name.
    pub(super) camera: String,
    pub(super) configured: ConfiguredCamera,
    pub(super) vehicle: Vec<VehicleSample>,
    pub(super) markers: Vec<MarkerSample>,
    /// The marker that was landed on.
    pub(super) marker: String,
    /// Whether the camera itself stamps its frames, so that no delay is subtracted from the stamps.
    pub(super) is_stamped_by_camera: bool,
    /// The configuration of camera-pub, every key of it, where it was recorded.
    pub(super) configuration: Option<toml::Table>,
    /// Descriptions of the damaged parts of the recording.
    pub(super) damage: Vec<String>,
}

/// Which camera and marker are meant, where the recording has several.
pub(super) struct Wanted<'a> {
    pub(super) camera: Option<&'a str>,
    pub(super) detector: Option<&'a str>,
    pub(super) marker: Option<&'a str>,
}

/// Reads a flight.
///
/// # Errors
/// When a file cannot be read, or has no detections, telemetry or calibration.
pub(super) fn read(file: &Path, wanted: &Wanted<'_>) -> anyhow::Result<RecordedFlight> {
    let recording = std::fs::read(file).with_context(|| format!("reading {file:?}"))?;
    let mut reader = FlightReader::new(&file.to_string_lossy());
    reader.add(&recording).with_context(|| format!("{file:?} is no recording (MCAP file)"))?;
    let mut flight = reader.finish();
    if flight.vehicle.is_empty() {
        replay_tapes(&mut flight);
    }
    let found = detections(&flight, wanted)
        .with_context(|| format!("there are no detections to calibrate with in {file:?}"))?;
    let camera = found.first().map(|message| message.header.camera.clone()).unwrap_or_default();
    let info = flight.cameras.get(&camera).with_context(|| {
        format!("the calibration of the camera `{camera}` (camera/{camera}/info) is not in {file:?}: record all topics")
    })?;
    let configured = configured(info)?;
    let marker = marker(&flight, wanted, &found)?;
    ensure!(
        !flight.vehicle.is_empty(),
        "the vehicle's state (vehicle/state, or a controller's tape) is not in {file:?}: record with a controller that is connected to the autopilot"
    );
    let zero_ns = flight.vehicle.first().map_or(0, |state| state.stamp_ns);
    let at_s = |stamp_ns: i64| stamp_ns.saturating_sub(zero_ns) as f64 * 1e-9;
    let markers = found.iter().filter_map(|message| {
        let pose = messages_pose(message, &marker)?;
        let [x, y, z] = pose.camera_from_marker.translation_m;
        let covariance_m2 = pose.translation_covariance_m2();
        let stamp_s = at_s(message.header.stamp_ns);
        Some(MarkerSample { stamp_s, place: Point::new(x, y, z), covariance_m2 })
    });
    let markers: Vec<MarkerSample> = markers.collect();
    ensure!(
        !markers.is_empty(),
        "no detection of `{marker}` in {file:?} has a pose: the detector must know the marker's size (`markers`), and the camera \
         its focal length"
    );
    Ok(RecordedFlight {
        configured,
        markers,
        marker,
        vehicle: vehicle(&flight, at_s),
        is_stamped_by_camera: is_device(&flight, &camera) || {
            // Some frames of such a camera are stamped by their arrival all the same.
            let exact = found.iter().filter(|message| message.header.exposure_ns > 0).count();
            2 * exact > found.len()
        },
        configuration: configuration(&flight, &camera),
        damage: flight.damage,
        camera,
    })
}

fn messages_pose<'a>(message: &'a Detections, marker: &str) -> Option<&'a messages::MarkerPose> {
    message.first_of(marker)?.pose.as_ref()
}

/// The detections of the detector with the most, or of the wanted one, of one camera.
fn detections<'a>(flight: &'a Flight, wanted: &Wanted<'_>) -> anyhow::Result<Vec<&'a Detections>> {
    let mut by_detector: BTreeMap<(&str, &str), Vec<&Detections>> = BTreeMap::new();
    for found in &flight.found {
        let key = (found.detector.as_str(), found.message.header.camera.as_str());
        by_detector.entry(key).or_default().push(&found.message);
    }
    let names: Vec<String> = by_detector
        .keys()
        .map(|(detector, camera)| format!("{detector} (camera {camera})"))
        .collect();
    let is_wanted = |(detector, camera): &(&str, &str)| {
        wanted.detector.is_none_or(|it| it == *detector)
            && wanted.camera.is_none_or(|it| it == *camera)
    };
    let chosen = by_detector.into_iter().filter(|(key, _)| is_wanted(key));
    let seen = |messages: &[&Detections]| {
        messages.iter().filter(|message| !message.detections.is_empty()).count()
    };
    // Other detectors may have found other markers, also more of them.
    let named = named(flight, wanted);
    let seen_named = |messages: &[&Detections]| {
        let sees = |name: &String| messages.iter().filter(|it| it.first_of(name).is_some()).count();
        named.as_ref().map_or(0, sees)
    };
    let best = chosen.max_by_key(|(_, messages)| (seen_named(messages), seen(messages)));
    let (_, messages) = best.with_context(|| match names.as_slice() {
        [] => "no detector's messages were recorded".to_owned(),
        names => format!("the recording has those of {}", names.join(", ")),
    })?;
    ensure!(seen(&messages) > 0, "the detector saw no marker");
    let clock = messages.first().map(|message| message.header.clock.as_str());
    ensure!(
        messages.iter().all(|message| Some(message.header.clock.as_str()) == clock),
        "its frames are stamped by several clocks, of which the first is `{}`",
        clock.unwrap_or_default()
    );
    Ok(messages)
}

fn configured(info: &CameraInfo) -> anyhow::Result<ConfiguredCamera> {
    if let Some(problem) = info.problem() {
        anyhow::bail!("the camera `{}` says that it has {problem}", info.camera);
    }
    let model = info.model().with_context(|| {
        format!(
            "the camera `{}` was not calibrated: give its focal length in `calibration`, if only roughly",
            info.camera
        )
    })?;
    let body_from_camera = body_from_camera(info)
        .with_context(|| format!("the mount of the camera `{}` is no rotation", info.camera))?;
    Ok(ConfiguredCamera { model, body_from_camera })
}

/// The wanted marker, or the one that the controller landed on, where it is the name of one.
fn named(flight: &Flight, wanted: &Wanted<'_>) -> Option<String> {
    let name = wanted.marker.map(str::to_owned).or_else(|| flight.marker())?;
    messages::marker_name(&name).is_ok().then_some(name)
}

/// The wanted marker, or the one that the controller landed on, or, without a controller, the one that was seen most.
fn marker(flight: &Flight, wanted: &Wanted<'_>, found: &[&Detections]) -> anyhow::Result<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for detection in found.iter().flat_map(|message| &message.detections) {
        let name = match detection.id {
            Some(id) => format!("{}:{id}", detection.family),
            None => detection.family.clone(),
        };
        *counts.entry(name).or_default() += 1;
    }
    let named = named(flight, wanted);
    let is_seen = |name: &String| {
        messages::marker_name(name).is_ok()
            && found.iter().any(|message| message.first_of(name).is_some())
    };
    if let Some(name) = &wanted.marker {
        ensure!(
            is_seen(&(*name).to_owned()),
            "`--marker {name}` was not seen; the recording has {}",
            counts.keys().cloned().collect::<Vec<_>>().join(", ")
        );
    }
    if let Some(name) = named.as_ref().filter(|name| !is_seen(name)) {
        anyhow::bail!(
            "the controller landed on `{name}`, which this detector did not see; it saw {}: name one by `--marker`",
            counts.keys().cloned().collect::<Vec<_>>().join(", ")
        );
    }
    let commonest = || counts.iter().max_by_key(|(_, count)| **count).map(|(name, _)| name.clone());
    named.filter(is_seen).or_else(commonest).context("the detector saw no marker")
}

fn vehicle(flight: &Flight, at_s: impl Fn(i64) -> f64) -> Vec<VehicleSample> {
    let sample = |state: &messages::VehicleState| {
        let [north, east, down] = state.position_ned_m;
        let [v_north, v_east, v_down] = state.velocity_ned_m_s;
        Some(VehicleSample {
            stamp_s: at_s(state.stamp_ns),
            ned_from_body: Rotation::from_wxyz(state.ned_from_body_wxyz)?,
            position: Point::new(north, east, down),
            velocity: Vector::new(v_north, v_east, v_down),
        })
    };
    flight.vehicle.iter().filter_map(sample).collect()
}

/// The configuration of camera-pub, if it was recorded.
fn configuration(flight: &Flight, camera: &str) -> Option<toml::Table> {
    flight.configurations.get(&format!("camera-pub/{camera}"))?.parse().ok()
}

/// Whether camera-pub read a device, whose driver stamps.
fn is_device(flight: &Flight, camera: &str) -> bool {
    let device = |all: toml::Table| Some(!all.get("source")?.get("device")?.as_str()?.is_empty());
    configuration(flight, camera).and_then(device).unwrap_or(false)
}
