//! The second search of a recording's frames, on pictures drawn here: the same detections for the same search, markers
//! that another detector does not find, compressed and missing pictures.

#![allow(clippy::unwrap_used, reason = "helpers of tests may fail like tests")]

use airlink::picture::jpeg;
use detector::{Search, StageClock};
use flightlog::{About, Picture, Received, TapeReader, Writer};
use geometry::{Body, Camera, CameraModel, Rotation, Transform};
use imaging::GrayImage;
use messages::{
    CameraInfo, Configuration, Detections, FrameHeader, Message, PixelFormat, TapeEvent,
    TapeOutput, TapeWriter, Topic, Truth, encode, topic,
};
use node::{Layers, to_toml};
use replay::{Again, Searched, search};

const WIDTH: u32 = 640;
const HEIGHT: u32 = 480;
const FOCAL_PX: f64 = 500.0;
const SIZE_M: f64 = 0.2;
const FRAMES: u64 = 12;
/// The last frames show no marker: the pad is beyond the picture.
const EMPTY: u64 = 3;

/// Where the pad is in the camera of a frame, in metres.
fn pad_m(sequence: u64) -> [f64; 3] {
    match sequence {
        it if it + EMPTY >= FRAMES => [3.0, 0.0, 1.2],
        it => [0.02 * it as f64 - 0.1, 0.1 - 0.01 * it as f64, 1.0 + 0.05 * it as f64],
    }
}

/// A marker that faces the camera, drawn with soft edges as any lens has them.
fn frame(sequence: u64) -> GrayImage {
    let [x, y, z] = pad_m(sequence);
    let size_px = FOCAL_PX * SIZE_M / z;
    let centre = [
        f64::from(WIDTH - 1) / 2.0 + FOCAL_PX * x / z,
        f64::from(HEIGHT - 1) / 2.0 + FOCAL_PX * y / z,
    ];
    let marker = "aruco-4x4-50:7".parse().unwrap();
    let drawing = markers::Drawing::new(&marker, size_px).unwrap();
    let mut image = GrayImage::filled(WIDTH as usize, HEIGHT as usize, 180);
    let steps: Vec<f64> = (0..8).map(|i| f64::from(i) * 0.25 - 0.875).collect();
    for row in 0..HEIGHT as usize {
        for (column, pixel) in image.row_mut(row).iter_mut().enumerate() {
            let (right, up) = (column as f64 - centre[0], centre[1] - row as f64);
            if right.abs().max(up.abs()) > drawing.half_extent_m {
                continue;
            }
            let white =
                |dx: f64, dy: f64| drawing.ink_at(right + dx, up + dy) == markers::Ink::White;
            let all = steps.iter().flat_map(|dx| steps.iter().map(move |dy| (*dx, *dy)));
            let count = all.filter(|(dx, dy)| white(*dx, *dy)).count();
            *pixel = (20 + 200 * count / (steps.len() * steps.len())) as u8;
        }
    }
    image
}

fn header(sequence: u64) -> FrameHeader {
    FrameHeader {
        sequence,
        stamp_ns: 1_000_000_000 + 66_000_000 * sequence as i64,
        width: WIDTH,
        height: HEIGHT,
        format: PixelFormat::Mono8,
        ..FrameHeader::sample()
    }
}

fn camera() -> CameraModel {
    CameraModel::pinhole(WIDTH, HEIGHT, FOCAL_PX)
}

/// The camera's x to the right of the vehicle, y backwards, z down.
fn mount() -> Transform<Body, Camera> {
    let rotation = Rotation::from_euler(0.0, 0.0, std::f64::consts::FRAC_PI_2);
    Transform::new(rotation, geometry::Point::new(0.1, 0.0, 0.05))
}

/// The vehicle so that the pad, at the origin, is where the frame shows it.
fn truth(sequence: u64, stamp_ns: i64) -> Truth {
    let [x, y, z] = pad_m(sequence);
    let pad = mount() * geometry::Point::new(x, y, z);
    Truth {
        stamp_ns,
        position_ned_m: [-pad.x(), -pad.y(), -pad.z()],
        // The first frame shows the pad as well, and is not counted: on the ground only a part of it may be seen.
        on_ground: sequence == 0,
        frames: sequence,
        ..Truth::sample()
    }
}

fn detector_config() -> detector::Config {
    let set = vec![format!("markers=[\"aruco-4x4-50:7:{SIZE_M}\"]")];
    Layers { file: None, set }.load::<detector::Config>().unwrap().settings
}

fn controller_config() -> String {
    let set = vec!["marker=\"aruco-4x4-50:7\"".to_owned()];
    to_toml(&Layers { file: None, set }.load::<controller::Config>().unwrap().settings)
}

/// A recording of the frames, with the detections in them, its tape, and truth.
fn recording(kept: impl Fn(&FrameHeader, &[u8]) -> Picture) -> Vec<u8> {
    let mut file = Vec::new();
    let mut writer = Writer::new(&mut file, &About::default()).unwrap();
    let info = CameraInfo::new("down", &camera(), &mount());
    put(&mut writer, topic::CAMERA_INFO, "down", 0, &info);
    let config = detector_config();
    for (service, toml) in [("detector", to_toml(&config)), ("controller", controller_config())] {
        let configuration = Configuration {
            service: service.to_owned(),
            instance: "main".to_owned(),
            host: "here".to_owned(),
            version: "0".to_owned(),
            toml,
        };
        put(&mut writer, topic::CONFIGURATION, service, 0, &configuration);
    }
    let mut tape = TapeWriter::new(0);
    let begin = TapeEvent::Begin {
        program: "test".into(),
        build: "test".into(),
        configuration: controller_config().into(),
    };
    tape.write(0, &begin, &TapeOutput::default());
    let mut first = Search::new(&config).unwrap();
    for sequence in 0..FRAMES {
        let (header, image) = (header(sequence), frame(sequence));
        let around = [header.stamp_ns - 10_000_000, header.stamp_ns + 10_000_000];
        for stamp_ns in around {
            put(&mut writer, topic::TRUTH, "", stamp_ns, &truth(sequence, stamp_ns));
        }
        let attachment = encode(&header);
        let message = Received {
            key: "camera/down/frame",
            payload: image.pixels(),
            attachment: &attachment,
            received_ns: header.stamp_ns,
        };
        writer.frame(message, &header, &kept(&header, image.pixels())).unwrap();
        let mut clock = StageClock::start();
        let view = image.view().unwrap();
        let detections = first.whole(view, &header, Some(&camera()), &mut clock);
        let found = Detections {
            detector: "main".to_owned(),
            header: header.clone(),
            detections,
            stages: clock.into_stages(),
        };
        put(&mut writer, topic::DETECTIONS, "main", header.stamp_ns, &found);
        let event = TapeEvent::Detections {
            publisher: "main".into(),
            message: std::borrow::Cow::Borrowed(&found),
        };
        tape.write(header.stamp_ns, &event, &TapeOutput::default());
    }
    put(&mut writer, topic::TAPE, "", 9, &tape.take().unwrap());
    writer.finish().unwrap();
    file
}

fn put<M: Message>(
    writer: &mut Writer<&mut Vec<u8>>,
    topic: Topic<M>,
    name: &str,
    received_ns: i64,
    message: &M,
) {
    let payload = encode(message);
    let key = topic.key(&[name, "main"]);
    writer
        .receive(Received { key: &key, payload: &payload, attachment: b"", received_ns })
        .unwrap();
}

fn again(recording: Vec<u8>, again: &Again) -> anyhow::Result<Searched> {
    let mut reader = TapeReader::default();
    reader.read(&recording).unwrap();
    search(&[recording], &reader.tapes(), again)
}

fn pixels(_header: &FrameHeader, _pixels: &[u8]) -> Picture {
    Picture::Pixels
}

#[test]
fn the_same_search_of_the_same_pixels_finds_the_same() {
    let searched = again(recording(pixels), &Again::default()).unwrap();
    assert_eq!((searched.searched_then, searched.searched), (12, 12));
    assert_eq!((searched.then.frames, searched.now.frames), (9, 9));
    assert_eq!(searched.showing_the_pad, Some(8));
    assert_eq!((searched.then.visible, searched.now.visible), (8, 8));
    assert_eq!(searched.looked_for, [format!("aruco-4x4-50:7:{SIZE_M}")]);
    assert_eq!((searched.lost, searched.gained, searched.is_lossy), (0, 0, false));
    // Those in flight.
    assert_eq!(searched.apart_m, [0.0; 8]);
    assert_eq!(searched.then.errors_m, searched.now.errors_m);
    // By truth: a centimetre at a metre.
    assert!(searched.now.errors_m.len() == 8 && searched.now.errors_m.iter().all(|it| *it < 0.01));
    assert!(searched.now.times_ms.iter().all(|it| *it > 0.0));
    assert_eq!(searched.changes.len(), 1);
    assert_eq!(searched.changes[0].end.events, 13);
}

#[test]
fn a_pad_that_is_looked_for_is_named_as_the_controller_names_it() {
    let set = ["markers=[\"rings:0.15341\"]", "pads=[\"a4\"]"].map(str::to_owned);
    let searched =
        again(recording(pixels), &Again { of_detector: set.to_vec(), ..Again::default() }).unwrap();
    assert_eq!(searched.looked_for, ["rings:0.15341", "pad:0"]);
    assert_eq!(searched.looked_for_then, [format!("aruco-4x4-50:7:{SIZE_M}")]);
}

#[test]
fn compressed_pictures_are_searched_as_well_and_marked_as_lossy() {
    let kept =
        |header: &FrameHeader, pixels: &[u8]| Picture::Jpeg(jpeg(header, pixels, 80).unwrap());
    let searched = again(recording(kept), &Again::default()).unwrap();
    assert!(searched.is_lossy);
    assert_eq!((searched.searched, searched.now.frames, searched.lost), (12, 9, 0));
    assert!(searched.apart_m.iter().all(|it| *it < 0.01), "{:?}", searched.apart_m);
    assert!(searched.apart_m.iter().any(|it| *it > 0.0), "they were not searched again");
}

#[test]
fn markers_that_another_detector_does_not_find_are_reported_and_change_the_detections_of_the_tape()
{
    let other = Again {
        of_detector: vec!["markers=[\"aruco-4x4-50:8:0.2\"]".to_owned()],
        ..Again::default()
    };
    let searched = again(recording(pixels), &other).unwrap();
    assert_eq!((searched.then.frames, searched.now.frames), (9, 0));
    assert_eq!((searched.lost, searched.gained), (9, 0));
    let larger = Again {
        of_detector: vec!["markers=[\"aruco-4x4-50:7:0.4\"]".to_owned()],
        of_controller: vec!["marker=\"aruco-4x4-50\"".to_owned()],
        ..Again::default()
    };
    let searched = again(recording(pixels), &larger).unwrap();
    assert_eq!((searched.now.frames, searched.now.marker.as_str()), (9, "aruco-4x4-50"));
    // Twice the size is twice as far away.
    assert!(searched.now.errors_m.iter().all(|it| *it > 0.9), "{:?}", searched.now.errors_m);
}

#[test]
fn errors_are_of_the_frames_in_which_both_found_the_marker() {
    // Of the frames in flight that show the pad, 1 to 8, the pictures of the last four show nothing.
    let kept = |header: &FrameHeader, pixels: &[u8]| {
        let nothing = vec![180; pixels.len()];
        let shown = if header.sequence < 5 { pixels } else { &nothing };
        Picture::Jpeg(jpeg(header, shown, 95).unwrap())
    };
    let searched = again(recording(kept), &Again::default()).unwrap();
    let (then, now) = (&searched.then, &searched.now);
    assert_eq!((then.visible, now.visible), (8, 4));
    assert_eq!([then.errors_m.len(), now.errors_m.len(), searched.apart_m.len()], [4; 3]);
}

#[test]
fn messages_that_a_recording_lacks_are_named() {
    let refusal = |recording: Vec<u8>, of: &Again| again(recording, of).unwrap_err().to_string();
    let without = refusal(recording(|_, _| Picture::None), &Again::default());
    assert!(without.contains("no picture of the 12 frames of camera `down`"), "{without}");
    let named = Again { detector: Some("other".to_owned()), ..Again::default() };
    let unknown = refusal(recording(pixels), &named);
    assert!(unknown.contains("`other`") && unknown.contains("it has: main"), "{unknown}");
    // A detector of another make publishes no configuration of Alight's.
    let mut file = Vec::new();
    let mut writer = Writer::new(&mut file, &About::default()).unwrap();
    let found = Detections {
        detector: "py".to_owned(),
        header: header(0),
        detections: Vec::new(),
        stages: Vec::new(),
    };
    put(&mut writer, topic::DETECTIONS, "py", 0, &found);
    writer.finish().unwrap();
    let named = Again { detector: Some("py".to_owned()), ..Again::default() };
    let other = search(&[recording(pixels), file], &[], &named).unwrap_err();
    assert!(other.is::<replay::WrongDetector>(), "{other}");
    let other = other.to_string();
    assert!(other.contains("only Alight's own detectors") && other.contains("main"), "{other}");
    let wrong = Again { of_detector: vec!["markers=[]".to_owned()], ..Again::default() };
    let wrong = refusal(recording(pixels), &wrong);
    assert!(wrong.contains("at least one marker"), "{wrong}");
}

#[test]
fn only_settings_of_the_replay_are_configuration_errors() {
    let refusal = |of: &Again| again(recording(pixels), of).unwrap_err();
    let named = Again { detector: Some("other".to_owned()), ..Again::default() };
    assert!(refusal(&named).is::<replay::WrongDetector>());
    let wrong = Again { of_controller: vec!["no_such_key=3".to_owned()], ..Again::default() };
    assert!(refusal(&wrong).is::<node::ConfigError>());
    let of_detector = vec!["no_such_key=3".to_owned()];
    assert!(refusal(&Again { of_detector, ..Again::default() }).is::<node::ConfigError>());
    // The recorded configuration of a detector of another version.
    let mut file = Vec::new();
    let mut writer = Writer::new(&mut file, &About::default()).unwrap();
    let configuration = Configuration {
        service: "detector".to_owned(),
        instance: "other".to_owned(),
        host: "here".to_owned(),
        version: "0".to_owned(),
        toml: "key_of_another_version = 3".to_owned(),
    };
    put(&mut writer, topic::CONFIGURATION, "detector", 0, &configuration);
    writer.finish().unwrap();
    let error = search(&[recording(pixels), file], &[], &named).unwrap_err();
    assert!(format!("{error:#}").contains("key_of_another_version"), "{error:#}");
    assert!(!error.is::<node::ConfigError>(), "{error:#}");
}
