//! The camera against geometry, brute force and statistics.

use fiducial::{Drawing, Ink, Marker};
use geometry::{
    Body, Camera, CameraModel, Distortion, Marker as MarkerFrame, Ned, Pixel, Point, Rotation,
    Transform, Vector,
};
use simulator::ground::Surface;
use simulator::render::{CameraSettings, PadInScene, RenderError, Renderer, Scene};

const WIDTH: usize = 1296;
const HEIGHT: usize = 972;

/// Grey levels by which a pixel may differ from brute force: one, and half a one by rounding.
const WORST_LEVELS: f64 = 1.5;

fn marker() -> Marker {
    "rings:0.15341".parse().unwrap()
}

fn plain_scene() -> Scene {
    let pad = PadInScene::flat(marker(), 0.4, -0.3, 0.3);
    Scene { surface: Surface::Plain, pads: vec![pad], painted_marks: 0, light: 1.0 }
}

fn exact_settings() -> CameraSettings {
    CameraSettings { noise: false, vignetting: 0.0, ..CameraSettings::thesis() }
}

/// A vehicle whose camera looks at the pad's centre from a height, up to an offset in the image.
fn pose(height_m: f64, roll: f64, pitch: f64, yaw: f64, off_px: [f64; 2]) -> Transform<Ned, Body> {
    let rotation = Rotation::<Ned, Body>::from_euler(roll, pitch, yaw);
    let settings = exact_settings();
    let middle = Pixel::new(settings.model.cx + off_px[0], settings.model.cy + off_px[1]);
    let ray: Vector<Ned> =
        rotation * (settings.body_from_camera * settings.model.unproject(middle));
    let face = Point::<Ned>::new(0.4, -0.3, -0.01);
    Transform::new(rotation, face - ray * (height_m / ray.z()))
}

fn rendered(
    scene: &Scene,
    settings: &CameraSettings,
    poses: &[Transform<Ned, Body>],
    frame_index: u64,
) -> Vec<u8> {
    let mut out = vec![0; (settings.model.width * settings.model.height) as usize];
    let mut renderer = Renderer::new(scene, settings.clone(), 5).unwrap();
    renderer.render(poses, frame_index, &mut out).unwrap();
    out
}

/// Reflectance at a place on the image plane, ray by ray.
fn reflectance(
    pad: &PadInScene,
    drawing: &Drawing,
    marker_from_camera: &Transform<MarkerFrame, Camera>,
    ray: Vector<Camera>,
) -> f64 {
    let (eye, ray) = (marker_from_camera.origin(), *marker_from_camera * ray);
    let half = pad.paper_m / 2.0;
    // Where the ray is inside the box's three slabs.
    let slabs = [
        (eye.x(), ray.x(), -half, half),
        (eye.y(), ray.y(), -half, half),
        (eye.z(), ray.z(), -pad.thickness_m, 0.0),
    ];
    let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
    for (start, along, min, max) in slabs {
        let (a, b) = ((min - start) / along, (max - start) / along);
        (enter, leave) = (enter.max(a.min(b)), leave.min(a.max(b)));
    }
    if enter > leave {
        return 0.35;
    }
    let lid = -eye.z() / ray.z();
    let (x, y) = (eye.x() + ray.x() * lid, eye.y() + ray.y() * lid);
    if x.abs() > half || y.abs() > half {
        return 0.3;
    }
    match drawing.ink_at(x, y) {
        Ink::Black => 0.05,
        Ink::White => 0.88,
    }
}

/// Exact poses over an exposure.
fn instants(poses: &[Transform<Ned, Body>], count: usize) -> Vec<Transform<Ned, Body>> {
    if poses.len() < 2 {
        return poses.to_vec();
    }
    (0..count)
        .map(|k| {
            let place = (k as f64 + 0.5) / count as f64 * (poses.len() - 1) as f64;
            let (a, b) = (&poses[place as usize], &poses[place as usize + 1]);
            let part = place.fract();
            let origin = a.origin() + (b.origin() - a.origin()) * part;
            Transform::new(a.rotation().interpolate(&b.rotation(), part), origin)
        })
        .collect()
}

/// Grey levels of a square of the image about `centre`, from 32 x 32 rays a pixel and instant.
fn brute_force(
    scene: &Scene,
    settings: &CameraSettings,
    poses: &[Transform<Ned, Body>],
    centre: [usize; 2],
    half: usize,
) -> Vec<f64> {
    const RAYS: usize = 32;
    let pad = &scene.pads[0];
    let drawing = Drawing::new(&pad.marker, pad.marker.size_m.unwrap());
    let margin = (4.0 * settings.blur_px).ceil() as usize;
    let edge = (2 * half + 1 + 2 * margin) * RAYS;
    let mut fine = vec![0.0; edge * edge];
    let instants = instants(poses, 16);
    for instant in &instants {
        let ned_from_camera = *instant * settings.body_from_camera;
        let marker_from_camera = pad.ned_from_marker.inverse() * ned_from_camera;
        for (index, value) in fine.iter_mut().enumerate() {
            // Each row and column of rays is shifted, lest an edge runs along one.
            let place = |centre: usize, k: usize, other: usize| {
                let first = centre as f64 - (half + margin) as f64 - 0.5;
                first + (k as f64 + (other as f64 * 0.618_034).fract()) / RAYS as f64
            };
            let (x, y) = (index % edge, index / edge);
            let pixel = Pixel::new(place(centre[0], x, y), place(centre[1], y, x));
            let ray = settings.model.unproject(pixel);
            *value += reflectance(pad, &drawing, &marker_from_camera, ray) / instants.len() as f64;
        }
    }
    let weights = blur_weights(settings.blur_px * RAYS as f64, RAYS, margin * RAYS);
    let levels = settings.electrons_per_s * settings.exposure_s * scene.light
        / settings.full_well_e
        * settings.gain
        * 255.0;
    let size = 2 * half + 1;
    let mut across = vec![0.0; edge * size];
    for (row, fine) in across.chunks_mut(size).zip(fine.chunks(edge)) {
        for (x, value) in row.iter_mut().enumerate() {
            *value = weights.iter().zip(&fine[x * RAYS..]).map(|(w, f)| w * f).sum();
        }
    }
    let mut pixels = vec![0.0; size * size];
    for (index, value) in pixels.iter_mut().enumerate() {
        let (x, y) = (index % size, index / size);
        let column = (0..weights.len()).map(|k| across[(y * RAYS + k) * size + x] * weights[k]);
        *value = (column.sum::<f64>() * levels).min(255.0);
    }
    pixels
}

/// A pixel's width convolved with the lens's blur, in fine steps.
fn blur_weights(sigma: f64, pixel: usize, margin: usize) -> Vec<f64> {
    let mut weights = vec![0.0; pixel + 2 * margin];
    for start in 0..pixel {
        for k in 0..=2 * margin {
            let offset = k as f64 - margin as f64;
            let weight = if margin == 0 { 1.0 } else { (-0.5 * (offset / sigma).powi(2)).exp() };
            weights[start + k] += weight;
        }
    }
    let total: f64 = weights.iter().sum();
    weights.iter().map(|w| w / total).collect()
}

/// Renders, and compares a square of the picture about `centre` with brute force.
fn check(
    name: &str,
    settings: &CameraSettings,
    poses: &[Transform<Ned, Body>],
    centre: [usize; 2],
    half: usize,
) -> f64 {
    let scene = plain_scene();
    let out = rendered(&scene, settings, poses, 0);
    let expected = brute_force(&scene, settings, poses, centre, half);
    let size = 2 * half + 1;
    let (mut worst, mut squares) = (0.0f64, 0.0);
    let mut at = [0, 0];
    for (index, expected) in expected.iter().enumerate() {
        let (x, y) = (centre[0] + index % size - half, centre[1] + index / size - half);
        let error = f64::from(out[y * WIDTH + x]) - expected;
        squares += error * error;
        if error.abs() > worst {
            (worst, at) = (error.abs(), [x, y]);
        }
    }
    let rms = (squares / expected.len() as f64).sqrt();
    println!("{name:40} worst {worst:.2} at {at:?}, rms {rms:.3}");
    worst
}

#[test]
fn pixels_agree_with_brute_force() {
    let settings = exact_settings();
    let still = |h, roll, pitch, yaw, off| vec![pose(h, roll, pitch, yaw, off)];
    let moving = |h: f64, px: [f64; 2], turn: f64| {
        let at = |t: f64| pose(h, turn * t, 0.15, 0.4, [px[0] * t, px[1] * t]);
        vec![at(-0.5), at(0.0), at(0.5)]
    };
    let cases = [
        ("0.1 m", still(0.1, 0.0, 0.0, 0.0, [0.0; 2]), [648, 486], 30),
        ("0.3 m", still(0.3, 0.0, 0.0, 0.2, [0.3, 0.4]), [668, 500], 20),
        ("0.3 m, tilted, box edge", still(0.3, 0.3, -0.2, 0.0, [100.0, 50.0]), [368, 350], 25),
        ("0.5 m, outer rings", still(0.5, 0.1, 0.2, 0.0, [0.0; 2]), [778, 485], 25),
        ("1 m", still(1.0, 0.0, 0.0, 0.0, [0.0; 2]), [640, 480], 25),
        ("1 m, corner of the lid", still(1.0, -0.4, 0.3, 0.0, [0.0; 2]), [510, 590], 25),
        ("2 m, tilted", still(2.0, 0.5, 0.5, 1.0, [200.0, -100.0]), [840, 380], 25),
        ("5 m", still(5.0, 0.1, -0.1, 0.7, [-300.2, 100.7]), [348, 587], 30),
        ("10 m", still(10.0, 0.2, 0.1, 0.7, [100.4, 100.1]), [748, 586], 22),
        ("20 m", still(20.0, 0.2, 0.1, 0.1, [100.2, 100.3]), [748, 586], 15),
        ("30 m", still(30.0, 0.0, 0.1, 0.1, [100.2, 100.3]), [748, 586], 12),
        ("10 m, 60 degrees", still(10.0, 1.05, 0.0, 0.1, [0.2, 0.3]), [648, 486], 20),
        ("0.3 m, moving 0.9 px", moving(0.3, [0.9, 0.0], 0.0), [640, 470], 15),
        ("0.3 m, moving 6 px", moving(0.3, [5.0, 3.0], 0.0), [660, 480], 20),
        ("0.5 m, moving 8 px", moving(0.5, [-4.0, 7.0], 0.0), [780, 525], 15),
        ("1 m, moving 2 px", moving(1.0, [-1.0, 1.7], 0.0), [651, 480], 15),
        ("1 m, moving and turning", moving(1.0, [5.0, 7.0], 0.02), [570, 565], 15),
        ("1 m, moving 7 px, corner", moving(1.0, [5.0, 5.0], 0.0), [815, 630], 20),
        ("10 m, moving 4 px", moving(10.0, [4.0, 0.4], 0.0), [648, 486], 22),
        ("20 m, moving 12 px", moving(20.0, [-9.0, 9.0], 0.0), [648, 486], 20),
    ];
    let mut failures = Vec::new();
    for (name, poses, centre, half) in &cases {
        let worst = check(name, &settings, poses, *centre, *half);
        if worst > WORST_LEVELS {
            failures.push((*name, worst));
        }
    }
    assert!(failures.is_empty(), "{failures:?}");
}

#[test]
fn other_lenses_agree_with_brute_force() {
    let pinhole = exact_settings();
    let barrel = Distortion::BrownConrady([-0.28, 0.07, 2e-4, 2e-5, 0.0, 0.0, 0.0, 0.0]);
    let fisheye = CameraModel {
        fx: 620.0,
        fy: 620.0,
        distortion: Distortion::KannalaBrandt([-0.01, 0.03, -0.02, 0.004]),
        ..pinhole.model
    };
    let cases = [
        ("blur 1.5 px", CameraSettings { blur_px: 1.5, ..pinhole.clone() }, 1.0),
        ("blur 0.4 px", CameraSettings { blur_px: 0.4, ..pinhole.clone() }, 1.0),
        (
            "barrel",
            CameraSettings {
                model: CameraModel { distortion: barrel, ..pinhole.model },
                ..pinhole.clone()
            },
            1.0,
        ),
        ("fisheye", CameraSettings { model: fisheye, ..pinhole.clone() }, 0.5),
    ];
    for (name, settings, height_m) in cases {
        let poses = [pose(height_m, 0.1, -0.1, 0.3, [300.0, -200.0])];
        let ned_from_camera = poses[0] * settings.body_from_camera;
        let face = plain_scene().pads[0].ned_from_marker.origin();
        let centre = settings.model.project(ned_from_camera.inverse() * face).unwrap();
        let worst = check(name, &settings, &poses, [centre.x as usize, centre.y as usize], 25);
        assert!(worst <= WORST_LEVELS, "{name}: {worst}");
    }
}
