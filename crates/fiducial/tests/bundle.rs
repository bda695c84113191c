//! Tests the pose of a pad of several markers in rendered pictures with truth, from 15 m to a hand's breadth, with markers
//! turned, missing or wrong.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]
#![allow(clippy::print_stdout, reason = "the tests print their figures")]

use fiducial::{Detector, Observation, PadObservation, Settings, observe_pad};
use geometry::{
    Body, Camera, CameraModel, Distortion, Marker as MarkerFrame, Ned, Pixel, Point, Rotation,
    Transform,
};
use markers::{Marker, Pad};
use rendering::{CameraSettings, PadInScene, Renderer, Scene, Surface};

/// Four markers about the landing point, two of them turned.
const FOUR: &str = r#"
id = 7
tolerance_m = 0.0001
[[markers]]
marker = "apriltag-36h11:1:0.16"
x_m = -0.2
y_m = 0.1
[[markers]]
marker = "aruco-4x4-50:2:0.08"
x_m = 0.15
y_m = 0.15
quarter_turns = 1
[[markers]]
marker = "apriltag-16h5:3:0.06"
x_m = 0.12
y_m = -0.08
quarter_turns = 2
[[markers]]
marker = "rings:0.1"
x_m = -0.1
y_m = -0.15
"#;

fn built_in() -> Pad {
    Pad::named("a4", |_| Err("it comes with the program")).unwrap()
}

struct Over {
    pad: Pad,
    camera: CameraModel,
    detector: Detector,
    renderer: Renderer,
    settings: CameraSettings,
    ned_from_pad: Transform<Ned, MarkerFrame>,
    pixels: Vec<u8>,
}

impl Over {
    fn new(pad: Pad) -> Self {
        let settings = CameraSettings::thesis().exposed_for(1.0, 200.0, 0.008);
        let printed = PadInScene::printed(pad.drawing().unwrap(), 0.0, 0.0, 0.3);
        let ned_from_pad = printed.ned_from_marker;
        let scene =
            Scene { surface: Surface::Asphalt, pads: vec![printed], painted_marks: 0, light: 1.0 };
        let renderer = Renderer::new(&scene, settings.clone(), 5).unwrap();
        let markers: Vec<Marker> = pad.markers().iter().map(|it| it.marker).collect();
        let detector = Detector::new(&markers, Settings::default()).unwrap();
        let camera = settings.model;
        let pixels = vec![0; camera.width as usize * camera.height as usize];
        Self { pad, camera, detector, renderer, settings, ned_from_pad, pixels }
    }

    /// The markers found from a position above the pad (metres north, east and up of its landing point), and the pad's pose in
    /// truth.
    fn look(
        &mut self,
        [north, east, up]: [f64; 3],
        tilt: f64,
    ) -> (Vec<Observation>, Transform<Camera, MarkerFrame>) {
        let lid = self.ned_from_pad.origin().z();
        let body: Transform<Ned, Body> = Transform::new(
            Rotation::from_euler(tilt, -0.5 * tilt, 0.7),
            Point::new(north, east, lid - up),
        );
        self.renderer.render(&[body], 1, &mut self.pixels).unwrap();
        let (width, height) = (self.camera.width as usize, self.camera.height as usize);
        let view = imaging::GrayView::new(&self.pixels, width, height, width).unwrap();
        let found = self.detector.detect(view, Some(&self.camera), &mut ()).to_vec();
        let ned_from_camera = body * self.settings.body_from_camera;
        (found, ned_from_camera.inverse() * self.ned_from_pad)
    }

    fn observe(&self, found: &[Observation]) -> Option<PadObservation> {
        observe_pad(&self.pad, found, &self.camera)
    }
}

/// Distance between two poses' origins, in metres.
fn apart(a: &Transform<Camera, MarkerFrame>, b: &Transform<Camera, MarkerFrame>) -> f64 {
    (a.origin().coords - b.origin().coords).norm()
}

/// The angle between two poses, in radians.
fn turned(a: &Transform<Camera, MarkerFrame>, b: &Transform<Camera, MarkerFrame>) -> f64 {
    (a.rotation().inverse() * b.rotation()).angle()
}

#[test]
fn the_sheet_of_a4_is_seen_from_15_m_to_a_hands_breadth() {
    let mut over = Over::new(built_in());
    for up in [15.0, 12.0, 8.0, 4.0, 2.0, 1.2, 0.8, 0.5, 0.3, 0.2, 0.12] {
        let (found, truth) = over.look([0.01 * up, 0.02 * up, up], 0.03);
        let pad = over.observe(&found).unwrap();
        let error_m = apart(&pad.pose.camera_from_marker, &truth);
        println!("{up} m: {} markers, {:.3} mm", pad.used, error_m * 1e3);
        assert!(error_m < 0.001 * up, "{up} m: {error_m} m");
        assert!(pad.centre.distance(&over.camera.project(truth.origin()).unwrap()) < 0.1);
    }
}

#[test]
fn all_markers_are_solved_together_however_they_are_turned() {
    let mut over = Over::new(FOUR.replace("0.0001", "0.0").parse().unwrap());
    let (found, truth) = over.look([0.1, -0.1, 4.0], 0.05);
    let pad = over.observe(&found).unwrap();
    assert_eq!((pad.used, pad.left_out), (4, 0));
    let pose = &pad.pose.camera_from_marker;
    assert!(apart(pose, &truth) < 0.001 && turned(pose, &truth) < 0.005, "{pad:?}");
    // Each square alone gives the same, with a larger covariance.
    for one in found.iter().filter(|it| it.corners.is_some()) {
        let alone = over.observe(std::slice::from_ref(one)).unwrap();
        let other = alone.pose.alternative.map(|other| turned(&other.camera_from_marker, &truth));
        let nearest = turned(&alone.pose.camera_from_marker, &truth).min(other.unwrap_or(9.0));
        assert!(nearest < 0.1, "{one:?}");
        for axis in 0..6 {
            let (all, alone) = (pad.pose.covariance, alone.pose.covariance);
            assert!(all[(axis, axis)] <= alone[(axis, axis)] * 1.01, "{one:?}");
        }
    }
}

#[test]
fn nothing_jumps_when_a_marker_leaves_the_view() {
    let mut over = Over::new(FOUR.parse().unwrap());
    for up in [1.0, 2.0, 6.0] {
        let (found, _) = over.look([0.0, 0.0, up], 0.04);
        let all = over.observe(&found).unwrap();
        assert!(all.used >= 3, "{up} m: {}", all.used);
        for without in 0..found.len() {
            let mut rest = found.clone();
            rest.remove(without);
            let rest = over.observe(&rest).unwrap();
            let step = all.pose.camera_from_marker.origin().coords
                - rest.pose.camera_from_marker.origin().coords;
            for (axis, step) in [step.x, step.y, step.z].into_iter().enumerate() {
                let deviation = rest.pose.covariance[(axis, axis)].sqrt();
                assert!(step.abs() < 4.0 * deviation, "{up} m, {step} m of {deviation} m");
            }
        }
    }
}

#[test]
fn a_marker_that_lies_elsewhere_is_left_out() {
    let mut over = Over::new(FOUR.parse().unwrap());
    let (found, truth) = over.look([0.0, 0.0, 3.0], 0.0);
    // The pad is described with one of its markers 3 cm from where it is printed.
    for (right, wrong) in [("x_m = 0.15", "x_m = 0.18"), ("x_m = -0.1\n", "x_m = -0.07\n")] {
        assert!(FOUR.contains(right));
        let pad: Pad = FOUR.replace(right, wrong).parse().unwrap();
        let seen = observe_pad(&pad, &found, &over.camera).unwrap();
        assert_eq!((seen.used, seen.left_out), (3, 1), "{right}");
        assert!(apart(&seen.pose.camera_from_marker, &truth) < 0.001, "{seen:?}");
    }
}

#[test]
fn a_false_marker_far_aside_does_not_hide_the_pad() {
    let mut over = Over::new(built_in());
    let (mut found, truth) = over.look([0.0, 0.0, 3.0], 0.0);
    assert_eq!(found.len(), 2);
    let inner = found.iter_mut().min_by(|a, b| a.size_px.total_cmp(&b.size_px)).unwrap();
    let camera = over.camera;
    let aside = |pixel: Pixel| Pixel::new(pixel.x + 300.0, pixel.y);
    let pose = inner.pose.as_mut().unwrap();
    let place = pose.camera_from_marker.origin();
    let [u, v] = [300.0 / camera.fx, 0.0].map(|tangent| tangent * place.z());
    let place = Point::new(place.x() + u, place.y() + v, place.z());
    pose.camera_from_marker = Transform::new(pose.camera_from_marker.rotation(), place);
    inner.centre = aside(inner.centre);
    inner.corners = inner.corners.map(|corners| corners.map(aside));
    let seen = over.observe(&found).unwrap();
    assert_eq!((seen.used, seen.left_out), (1, 1));
    assert!(apart(&seen.pose.camera_from_marker, &truth) < 0.005, "{seen:?}");
    // An unsure marker does not drive out a surer one, however large it is.
    for one in &mut found {
        one.confidence = if one.size_px > 50.0 { 0.1 } else { 1.0 };
    }
    let seen = over.observe(&found).unwrap();
    assert_eq!((seen.used, seen.left_out), (1, 1));
    assert!(apart(&seen.pose.camera_from_marker, &truth) > 0.1, "{seen:?}");
}

#[test]
fn a_false_marker_among_several_is_left_out_wherever_it_is() {
    let mut over = Over::new(FOUR.parse().unwrap());
    let (found, truth) = over.look([0.0, 0.0, 3.0], 0.0);
    // Each square is described turned, in one other quarter.
    for (marker, turns) in [
        ("apriltag-36h11:1", 2),
        ("apriltag-36h11:1", 1),
        ("aruco-4x4-50:2", 3),
        ("apriltag-16h5:3", 0),
    ] {
        let mut text = String::new();
        for part in FOUR.split("[[markers]]").filter(|part| !part.contains("rings")) {
            text.push_str(if text.is_empty() { "" } else { "[[markers]]" });
            match part.contains(marker) {
                true => {
                    let rest = part.split("quarter_turns").next().unwrap();
                    text.push_str(&format!("{rest}quarter_turns = {turns}\n"));
                }
                false => text.push_str(part),
            }
        }
        let pad: Pad = text.parse().unwrap();
        let seen = observe_pad(&pad, &found, &over.camera).unwrap();
        assert_eq!((seen.used, seen.left_out), (2, 1), "{marker} {turns}");
        assert!(apart(&seen.pose.camera_from_marker, &truth) < 0.003, "{seen:?}");
    }
}

#[test]
fn the_landing_point_may_be_beyond_the_range_of_the_lens_model() {
    let pad = "id = 1\nmarkers = [{ marker = \"aruco-4x4-50:2:0.08\", x_m = 0.6 }]";
    let mut over = Over::new(pad.parse().unwrap());
    let at = over.ned_from_pad * Point::new(0.6, 0.0, 0.0);
    let (found, truth) = over.look([at.x(), at.y(), 0.5], 0.0);
    let near = over.observe(&found).unwrap();
    let distortion = Distortion::BrownConrady([0.15, -0.35, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    over.camera = CameraModel { distortion, ..over.camera };
    assert_eq!(over.camera.project(truth.origin()), None);
    let seen = over.observe(&found).unwrap();
    assert_eq!(seen.pose.camera_from_marker, near.pose.camera_from_marker);
    // Its pixel is on the way to where it would be, as unsure as that is far.
    let middle = Pixel::new(over.camera.cx, over.camera.cy);
    let [short, long] = [seen.centre.distance(&middle), near.centre.distance(&middle)];
    assert!(short < long && seen.centre.distance(&near.centre) < 1.01 * (long - short));
    assert!(seen.centre_covariance_px2.trace().sqrt() > long - short);
}

#[test]
fn rings_alone_are_a_pad_only_in_its_middle() {
    let mut over = Over::new("id = 1\nmarkers = [{ marker = \"rings:0.15\" }]".parse().unwrap());
    let (found, truth) = over.look([0.0, 0.1, 3.0], 0.02);
    let seen = over.observe(&found).unwrap();
    assert!(apart(&seen.pose.camera_from_marker, &truth) < 0.003, "{seen:?}");
    let aside: Pad = "id = 1\nmarkers = [{ marker = \"rings:0.15\", x_m = 0.1 }]".parse().unwrap();
    assert_eq!(observe_pad(&aside, &found, &over.camera), None);
    assert_eq!(observe_pad(&aside, &[], &over.camera), None);
}
