//! Compares the renderer with ray casting, the projection of the camera model and the statistics of noise: pixels,
//! seams, lenses, rolling shutter, occluders, any pose and size.
#![allow(
    clippy::unwrap_used,
    clippy::print_stdout,
    reason = "helpers of tests fail like tests, and print their measurements"
)]

use geometry::{
    Body, Camera, CameraModel, Distortion, Marker as MarkerFrame, Ned, Pixel, Point, Rotation,
    Transform, Vector,
};
use markers::{Drawing, Ink, Layer, Marker, Shape};
use rendering::{CameraSettings, PadInScene, RenderError, Renderer, Scene, Surface};

const WIDTH: usize = 1296;
const HEIGHT: usize = 972;

/// Maximum difference of a pixel from brute force, in grey levels: one, and half a level of rounding.
const WORST_LEVELS: f64 = 1.5;

fn marker() -> Marker {
    "rings:0.15341".parse().unwrap()
}

fn plain_scene() -> Scene {
    let pad = PadInScene::flat(marker(), 0.4, -0.3, 0.3);
    Scene { surface: Surface::Plain, pads: vec![pad], painted_marks: 0, light: 1.0 }
}

/// Cells side by side on a black square, as a square marker has them, seven of them white.
fn scene_of_cells() -> Scene {
    const WHITE_CELLS: [(i32, i32); 7] = [(1, 1), (2, 1), (3, 1), (2, 2), (3, 2), (4, 3), (1, 4)];
    let cell_m = 0.15341 / 6.0;
    let rectangle = |min: [i32; 2], max: [i32; 2], ink| {
        let place = |cells: [i32; 2]| cells.map(|cell| f64::from(cell - 3) * cell_m);
        Layer { shape: Shape::Rectangle { min_m: place(min), max_m: place(max) }, ink }
    };
    let white = |(x, y): (i32, i32)| rectangle([x, y], [x + 1, y + 1], Ink::White);
    let layers = std::iter::once(rectangle([0, 0], [6, 6], Ink::Black))
        .chain(WHITE_CELLS.into_iter().map(white))
        .collect();
    let mut scene = plain_scene();
    scene.pads[0].drawing = Drawing { half_extent_m: 4.0 * cell_m, layers };
    scene
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
        rotation * (settings.body_from_camera * settings.model.unproject_clamped(middle));
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

/// Reflectance at a point of the image plane, by ray casting.
fn reflectance(
    pad: &PadInScene,
    drawing: &Drawing,
    marker_from_camera: &Transform<MarkerFrame, Camera>,
    ray: Vector<Camera>,
) -> f64 {
    let (eye, ray) = (marker_from_camera.origin(), *marker_from_camera * ray);
    let half = pad.paper_m / 2.0;
    // The part of the ray inside the box's three slabs.
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

/// Grey levels of a window of the image, from 32 x 32 rays per pixel and instant.
fn brute_force(
    scene: &Scene,
    settings: &CameraSettings,
    poses: &[Transform<Ned, Body>],
    Window { centre, half }: Window,
) -> Vec<f64> {
    const RAYS: usize = 32;
    let pad = &scene.pads[0];
    let drawing = &pad.drawing;
    let margin = (4.0 * settings.blur_px).ceil() as usize;
    let edge = (2 * half + 1 + 2 * margin) * RAYS;
    let mut fine = vec![0.0; edge * edge];
    let instants = instants(poses, 16);
    for instant in &instants {
        let ned_from_camera = *instant * settings.body_from_camera;
        let marker_from_camera = pad.ned_from_marker.inverse() * ned_from_camera;
        for (index, value) in fine.iter_mut().enumerate() {
            // Each row and column of rays is shifted, so that no edge runs along one.
            let place = |centre: usize, k: usize, other: usize| {
                let first = centre as f64 - (half + margin) as f64 - 0.5;
                first + (k as f64 + (other as f64 * 0.618_034).fract()) / RAYS as f64
            };
            let (x, y) = (index % edge, index / edge);
            let pixel = Pixel::new(place(centre[0], x, y), place(centre[1], y, x));
            let ray = settings.model.unproject_clamped(pixel);
            *value += reflectance(pad, drawing, &marker_from_camera, ray) / instants.len() as f64;
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

/// A pixel's box convolved with the lens blur, in fine steps.
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

/// A square of the image of `2 * half + 1` pixels.
#[derive(Copy, Clone)]
struct Window {
    centre: [usize; 2],
    half: usize,
}

/// Renders, and compares a window of the image with brute force.
fn check(
    name: &str,
    scene: &Scene,
    settings: &CameraSettings,
    poses: &[Transform<Ned, Body>],
    window: Window,
) -> f64 {
    let out = rendered(scene, settings, poses, 0);
    let expected = brute_force(scene, settings, poses, window);
    let Window { centre, half } = window;
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
        ("0.1 m", still(0.1, 0.0, 0.0, 0.0, [0.0; 2]), [668, 506], 16),
        ("0.3 m", still(0.3, 0.0, 0.0, 0.2, [0.3, 0.4]), [668, 500], 18),
        ("0.3 m, tilted, box edge", still(0.3, 0.3, -0.2, 0.0, [100.0, 50.0]), [368, 350], 18),
        ("0.5 m, outer rings", still(0.5, 0.1, 0.2, 0.0, [0.0; 2]), [778, 485], 18),
        ("1 m", still(1.0, 0.0, 0.0, 0.0, [0.0; 2]), [640, 480], 18),
        ("1 m, corner of the lid", still(1.0, -0.4, 0.3, 0.0, [0.0; 2]), [510, 590], 18),
        ("2 m, tilted", still(2.0, 0.5, 0.5, 1.0, [200.0, -100.0]), [840, 380], 18),
        ("5 m", still(5.0, 0.1, -0.1, 0.7, [-300.2, 100.7]), [348, 587], 18),
        ("10 m", still(10.0, 0.2, 0.1, 0.7, [100.4, 100.1]), [748, 586], 18),
        ("20 m", still(20.0, 0.2, 0.1, 0.1, [100.2, 100.3]), [748, 586], 15),
        ("30 m", still(30.0, 0.0, 0.1, 0.1, [100.2, 100.3]), [748, 586], 12),
        ("10 m, 60 degrees", still(10.0, 1.05, 0.0, 0.1, [0.2, 0.3]), [648, 486], 18),
        ("0.3 m, moving 0.9 px", moving(0.3, [0.9, 0.0], 0.0), [640, 470], 12),
        ("0.3 m, moving 6 px", moving(0.3, [5.0, 3.0], 0.0), [660, 480], 12),
        ("0.5 m, moving 8 px", moving(0.5, [-4.0, 7.0], 0.0), [780, 525], 12),
        ("1 m, moving 2 px", moving(1.0, [-1.0, 1.7], 0.0), [651, 480], 12),
        ("1 m, moving and turning", moving(1.0, [5.0, 7.0], 0.02), [570, 565], 12),
        ("1 m, moving 7 px, corner", moving(1.0, [5.0, 5.0], 0.0), [815, 630], 12),
        ("10 m, moving 4 px", moving(10.0, [4.0, 0.4], 0.0), [648, 486], 12),
        ("20 m, moving 12 px", moving(20.0, [-9.0, 9.0], 0.0), [648, 486], 12),
    ];
    let mut failures = Vec::new();
    for (name, poses, centre, half) in &cases {
        let worst =
            check(name, &plain_scene(), &settings, poses, Window { centre: *centre, half: *half });
        if worst > WORST_LEVELS {
            failures.push((*name, worst));
        }
    }
    assert!(failures.is_empty(), "{failures:?}");
}

#[test]
fn adjacent_cells_have_no_seams() {
    let settings = exact_settings();
    for (height_m, roll, half, centre) in [
        (0.5, 0.1, 16, [640, 480]),
        (2.0, 0.3, 20, [640, 480]),
        (10.0, 0.0, 20, [648, 486]),
        (36.0, 0.1, 9, [648, 486]),
    ] {
        let pose = pose(height_m, roll, 0.05, 0.7, [0.3, 0.4]);
        let scene = scene_of_cells();
        let worst = check(
            &format!("cells, {height_m} m"),
            &scene,
            &settings,
            &[pose],
            Window { centre, half },
        );
        assert!(worst <= WORST_LEVELS, "{worst} at {height_m} m");
    }
}

/// A black square in so many lines, as a bent print is drawn.
fn scene_of_lines(count: u32) -> Scene {
    let size_m = 0.15341;
    let place = |line: u32| (f64::from(line) / f64::from(count) - 0.5) * size_m;
    let rectangle = |line: u32| Shape::Rectangle {
        min_m: [-0.5 * size_m, place(line)],
        max_m: [0.5 * size_m, place(line + 1)],
    };
    let layer = |line: u32| Layer { shape: rectangle(line), ink: Ink::Black };
    let mut scene = plain_scene();
    scene.pads[0].drawing =
        Drawing { half_extent_m: 0.6 * size_m, layers: (0..count).map(layer).collect() };
    scene
}

#[test]
fn lines_thinner_than_a_subsample_cover_no_more_than_there_is_of_them() {
    let settings = exact_settings();
    let at = |height_m: f64, off_px: [f64; 2]| pose(height_m, 0.2, 0.05, 0.7, off_px);
    for (name, poses, half) in [
        ("5 m, 0.3 px", vec![at(5.0, [0.3, 0.4])], 34),
        ("10 m, 0.1 px", vec![at(10.0, [0.3, 0.4])], 20),
        ("25 m, 0.06 px", vec![at(25.0, [0.3, 0.4])], 9),
        ("10 m, 0.1 px, moving 4 px", vec![at(10.0, [-1.5, 1.0]), at(10.0, [1.5, -1.0])], 20),
    ] {
        let window = Window { centre: [648, 486], half };
        let worst = check(name, &scene_of_lines(200), &settings, &poses, window);
        assert!(worst <= WORST_LEVELS, "{name}: {worst}");
    }
}

#[test]
fn an_occluder_changes_the_light_before_the_sensor() {
    let settings = exact_settings();
    let pose = pose(2.0, 0.0, 0.0, 0.0, [0.0; 2]);
    let mut renderer = Renderer::new(&plain_scene(), settings.clone(), 5).unwrap();
    let mut out = vec![0; WIDTH * HEIGHT];
    let mut half = |v: usize, light: &mut [f32]| {
        assert_eq!(light.len(), WIDTH);
        if v < HEIGHT / 2 {
            light.iter_mut().for_each(|level| *level *= 0.5);
        }
    };
    renderer.render_through(&mut half, &[pose], 0, &mut out).unwrap();
    let bare = rendered(&plain_scene(), &settings, &[pose], 0);
    let (dark, bright) = out.split_at(WIDTH * HEIGHT / 2);
    let (whole, same) = bare.split_at(WIDTH * HEIGHT / 2);
    assert_eq!(bright, same);
    assert!(
        dark.iter().zip(whole).all(|(d, w)| (f64::from(*d) - f64::from(*w) / 2.0).abs() <= 1.0)
    );
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
        let centre = [centre.x as usize, centre.y as usize];
        let worst = check(name, &plain_scene(), &settings, &poses, Window { centre, half: 25 });
        assert!(worst <= WORST_LEVELS, "{name}: {worst}");
    }
}

/// Centroid of the pixels darker than paper within a radius of the marker's centre.
fn dark_centroid(out: &[u8], centre: Pixel, radius_px: f64, white: f64) -> Pixel {
    let (mut weight, mut x, mut y) = (0.0, 0.0, 0.0);
    for (index, level) in out.iter().enumerate() {
        let pixel = Pixel::new((index % WIDTH) as f64, (index / WIDTH) as f64);
        if pixel.distance(&centre) < radius_px {
            let dark = white - f64::from(*level);
            weight += dark;
            x += dark * pixel.x;
            y += dark * pixel.y;
        }
    }
    Pixel::new(x / weight, y / weight)
}

#[test]
fn the_rings_are_centred_where_the_camera_model_projects_the_marker() {
    let settings = exact_settings();
    let scene = plain_scene();
    let white = f64::from(
        rendered(&scene, &settings, &[pose(0.1, 0.0, 0.0, 0.0, [0.0; 2])], 0)[486 * WIDTH + 648],
    );
    for (height_m, yaw, off_px) in [
        (0.3, 0.0, [3.3, 7.7]),
        (1.0, 0.5, [-200.2, 100.9]),
        (3.0, 1.0, [400.4, -300.3]),
        (6.0, 2.0, [-500.5, 11.1]),
        (10.0, 0.1, [333.3, 222.2]),
    ] {
        let pose = pose(height_m, 0.0, 0.0, yaw, off_px);
        let out = rendered(&scene, &settings, &[pose], 0);
        let camera_from_ned = (pose * settings.body_from_camera).inverse();
        let face = scene.pads[0].ned_from_marker.origin();
        let expected = settings.model.project(camera_from_ned * face).unwrap();
        // Between the outer ring's radius and the lid's edge.
        let radius_px = 0.55 * 0.15341 / height_m * settings.model.fx;
        let found = dark_centroid(&out, expected, radius_px, white);
        let error = found.distance(&expected);
        println!("{height_m} m: {error:.4} px");
        assert!(error < 0.01, "{height_m} m: {found:?} for {expected:?}");
    }
}

#[test]
fn the_nose_is_at_the_top_of_the_image_and_the_right_side_on_its_right() {
    let scene = plain_scene();
    let settings = exact_settings();
    let camera = |north: f64, east: f64, yaw: f64| {
        let rotation = Rotation::from_euler(0.0, 0.0, yaw);
        let pose = Transform::<Ned, Body>::new(rotation, Point::new(north, east, -3.0));
        let out = rendered(&scene, &settings, &[pose], 0);
        let (mut best, mut at) = (0, [0, 0]);
        for (index, level) in out.iter().enumerate() {
            if *level > best {
                (best, at) = (*level, [index % WIDTH, index / WIDTH]);
            }
        }
        at
    };
    // The pad is ahead of a vehicle south of it, and to the right of one west of it.
    assert!(camera(0.0, -0.3, 0.0)[1] < 350);
    assert!(camera(0.4, -0.8, 0.0)[0] > 800);
    // One that looks east from the west has it ahead.
    assert!(camera(0.4, -0.8, std::f64::consts::FRAC_PI_2)[1] < 350);
}

#[test]
fn noise_has_the_variance_of_its_electrons_and_is_independent() {
    let settings = CameraSettings { vignetting: 0.0, ..CameraSettings::thesis() };
    let levels_per_electron = 255.0 / settings.full_well_e;
    for light in [0.1, 0.3, 1.0, 2.0] {
        let scene = Scene { pads: Vec::new(), light, ..plain_scene() };
        let pose = [pose(5.0, 0.0, 0.0, 0.0, [0.0; 2])];
        let frames = [0, 1].map(|index| rendered(&scene, &settings, &pose, index));
        let electrons = 0.35 * light * settings.electrons_per_s * settings.exposure_s;
        let level = electrons * levels_per_electron;
        let noise = electrons + settings.read_noise_e * settings.read_noise_e;
        let variance = noise * levels_per_electron * levels_per_electron + 1.0 / 12.0;
        let count = frames[0].len() as f64;
        let mean = frames[0].iter().map(|l| f64::from(*l)).sum::<f64>() / count;
        let product = |a: &[u8], b: &[u8]| {
            let pairs = a.iter().zip(b);
            pairs.map(|(a, b)| (f64::from(*a) - mean) * (f64::from(*b) - mean)).sum::<f64>() / count
        };
        let found = product(&frames[0], &frames[0]);
        println!("level {mean:.2} ({level:.2}), variance {found:.3} ({variance:.3})");
        assert!((mean - level).abs() < 0.05, "{mean} for {level}");
        assert!((found / variance - 1.0).abs() < 0.02, "{found} for {variance}");
        for (name, other) in [
            ("the next pixel", &frames[0][1..]),
            ("the pixel below", &frames[0][WIDTH..]),
            ("the next frame", &frames[1][..]),
        ] {
            let correlation = product(&frames[0], other) / found;
            assert!(correlation.abs() < 0.01, "with {name}: {correlation}");
        }
    }
}

#[test]
fn a_frame_depends_on_seed_index_and_poses_only() {
    let scene = Scene { surface: Surface::Grass, painted_marks: 5, ..plain_scene() };
    let settings = CameraSettings::thesis();
    let poses = [pose(2.0, 0.1, 0.1, 0.1, [0.0; 2]), pose(2.0, 0.1, 0.1, 0.1, [4.0, 0.0])];
    let elsewhere = [pose(0.5, -0.5, 0.0, 2.0, [50.0, 0.0])];
    let mut renderer = Renderer::new(&scene, settings.clone(), 5).unwrap();
    let mut frame = |poses: &[_], index| {
        let mut out = vec![0; WIDTH * HEIGHT];
        renderer.render(poses, index, &mut out).unwrap();
        out
    };
    let first = frame(&poses, 7);
    assert_ne!(frame(&elsewhere, 8), first);
    assert_ne!(frame(&poses, 9), first);
    assert_eq!(frame(&poses, 7), first);
    assert_eq!(rendered(&scene, &settings, &poses, 7), first);
    let mut other = Renderer::new(&scene, settings, 6).unwrap();
    let mut out = vec![0; WIDTH * HEIGHT];
    other.render(&poses, 7, &mut out).unwrap();
    assert_ne!(out, first);
}

#[test]
fn a_moved_pad_is_rendered_where_it_is() {
    let scene = plain_scene();
    let settings = exact_settings();
    let pose = [pose(2.0, 0.0, 0.0, 0.0, [0.0; 2])];
    let away = PadInScene::flat(marker(), 0.5, -0.2, 1.0);
    let mut renderer = Renderer::new(&scene, settings.clone(), 5).unwrap();
    let mut out = vec![0; WIDTH * HEIGHT];
    renderer.move_pad(0, away.ned_from_marker);
    renderer.move_pad(1, scene.pads[0].ned_from_marker);
    renderer.render(&pose, 0, &mut out).unwrap();
    let expected = Scene { pads: vec![away], ..scene };
    assert_eq!(out, rendered(&expected, &settings, &pose, 0));
}

#[test]
fn any_pose_gives_an_image_or_an_error() {
    use std::f64::consts::{FRAC_PI_2, PI};
    let settings = CameraSettings { noise: false, ..CameraSettings::thesis() };
    let scene = Scene { surface: Surface::Asphalt, painted_marks: 20, ..plain_scene() };
    let mut renderer = Renderer::new(&scene, settings, 1).unwrap();
    let mut out = vec![0; WIDTH * HEIGHT];
    let mut mean = |poses: &[Transform<Ned, Body>]| {
        renderer.render(poses, 0, &mut out)?;
        Ok(out.iter().map(|l| f64::from(*l)).sum::<f64>() / out.len() as f64)
    };
    let at = |roll: f64, pitch: f64, place: [f64; 3]| {
        let rotation = Rotation::<Ned, Body>::from_euler(roll, pitch, 0.3);
        Transform::new(rotation, Point::new(place[0], place[1], place[2]))
    };
    // Upside down there is sky, below the ground darkness, and at the horizon some of both.
    let sky = mean(&[at(PI, 0.0, [0.0, 0.0, -5.0])]).unwrap();
    assert!(sky > 200.0);
    assert!(mean(&[at(0.1, 0.0, [0.4, -0.3, 0.5])]).unwrap() < 10.0);
    let horizon = mean(&[at(0.0, FRAC_PI_2, [0.0, 0.0, -5.0])]).unwrap();
    assert!((0.3 * sky..0.8 * sky).contains(&horizon));
    for pose in [
        at(0.0, 0.0, [0.4, -0.3, 0.0]),
        at(0.0, 0.0, [0.4, -0.3, -0.005]),
        at(0.0, 0.0, [0.4, -0.3, -0.01]),
        at(0.0, 0.0, [0.4, -0.3, -0.0101]),
        at(0.0, 0.0, [0.4, -0.3, -0.02]),
        at(0.0, FRAC_PI_2, [0.2, -0.3, -0.02]),
        at(0.0, 1.5, [0.35, -0.3, -0.011]),
        at(1.3, 1.3, [0.0, 0.0, -0.05]),
        at(0.0, 0.0, [0.0, 0.0, -9e4]),
        at(0.3, 0.0, [9e4, 0.0, -1e-9]),
        at(0.3, 0.0, [0.0, 0.0, 9e4]),
    ] {
        assert!(mean(&[pose]).is_ok(), "{pose:?}");
        let tumbling = [pose, at(3.0, -1.0, [1.0, 1.0, -1.0]), at(-2.0, 1.0, [1.0, 1.0, 1.0])];
        assert!(mean(&tumbling).is_ok(), "{tumbling:?}");
    }
    let here = at(0.0, 0.0, [0.0, 0.0, -5.0]);
    for wrong in [f64::NAN, f64::INFINITY, -1e6] {
        let poses = [here, at(0.0, 0.0, [wrong, 0.0, -5.0])];
        assert_eq!(mean(&poses), Err(RenderError::Pose { index: 1 }));
    }
    let mut unturned = here;
    unturned.isometry.rotation.as_mut_unchecked().coords.fill(0.0);
    assert_eq!(mean(&[unturned]), Err(RenderError::Pose { index: 0 }));
    assert_eq!(mean(&[]), Err(RenderError::NoPose));
}

#[test]
fn images_of_any_size_are_filled_and_wrong_buffers_refused() {
    for (width, height) in [(1, 1), (17, 5), (33, 70), (3, 400)] {
        let model = CameraModel::pinhole(width, height, 20.0);
        let barrel = Distortion::BrownConrady([-0.9, 5.0, 0.1, 0.1, 9.0, 0.0, 0.0, 0.0]);
        for distortion in [Distortion::None, barrel, Distortion::KannalaBrandt([9.0; 4])] {
            let model = CameraModel { distortion, ..model };
            let settings = CameraSettings { model, ..CameraSettings::thesis() };
            let mut renderer = Renderer::new(&plain_scene(), settings, 1).unwrap();
            let needed = (width * height) as usize;
            let mut out = vec![0; needed + 1];
            let poses = [pose(0.2, 0.0, 0.0, 0.0, [0.0; 2]), pose(0.2, 0.1, 0.0, 0.0, [0.0; 2])];
            renderer.render(&poses, 0, &mut out[..needed]).unwrap();
            assert!(out[..needed].iter().any(|level| *level > 0));
            let refused = RenderError::Size { len: needed + 1, needed };
            assert_eq!(renderer.render(&poses, 0, &mut out), Err(refused));
        }
    }
}

#[test]
fn invalid_settings_are_refused() {
    let thesis = CameraSettings::thesis;
    let model = |change: fn(&mut CameraModel)| {
        let mut settings = thesis();
        change(&mut settings.model);
        settings
    };
    for settings in [
        model(|m| m.width = 0),
        model(|m| m.height = 70_000),
        model(|m| m.fx = 0.0),
        model(|m| m.cy = f64::NAN),
        CameraSettings { exposure_s: -1.0, ..thesis() },
        CameraSettings { gain: f64::INFINITY, ..thesis() },
        CameraSettings { full_well_e: 0.0, ..thesis() },
        CameraSettings { blur_px: 3.1, ..thesis() },
        CameraSettings { vignetting: f64::NAN, ..thesis() },
    ] {
        let refused = Renderer::new(&plain_scene(), settings, 1);
        assert!(matches!(refused, Err(RenderError::Setting(_))));
    }
    let unsized_marker = PadInScene::flat("rings".parse().unwrap(), 0.0, 0.0, 0.0);
    let scene = Scene { pads: vec![unsized_marker], ..plain_scene() };
    assert!(Renderer::new(&scene, thesis(), 1).is_err());
}

#[test]
fn low_light_raises_the_exposure_and_then_the_gain() {
    let white = |light: f64| {
        let settings = CameraSettings { noise: false, vignetting: 0.0, ..CameraSettings::thesis() };
        let settings = settings.exposed_for(light, 200.0, 0.004);
        let scene = Scene { light, ..plain_scene() };
        let level = rendered(&scene, &settings, &[pose(0.1, 0.0, 0.0, 0.0, [0.0; 2])], 0)
            [486 * WIDTH + 648];
        (level, settings.exposure_s, settings.gain)
    };
    let (bright, dusk, dark) = (white(1.0), white(0.5), white(0.05));
    assert_eq!([bright.0, dusk.0, dark.0], [200; 3]);
    assert!(bright.1 < dusk.1 && dusk.1 <= dark.1 && dark.1 == 0.004);
    assert!(bright.2 == 1.0 && dark.2 > 5.0);
}

#[test]
fn a_rolling_shutter_shows_each_row_at_its_own_time() {
    let still = exact_settings();
    let rolling = CameraSettings { exposure_s: 1e-4, readout_s: 0.02, gain: 20.0, ..still.clone() };
    let scene = plain_scene();
    let at = |right_px: f64| pose(1.0, 0.0, 0.0, 0.0, [right_px, 100.0]);
    // Standing still, all rows see the same.
    let global = CameraSettings { readout_s: 0.0, ..rolling.clone() };
    let stands = [at(7.3), at(7.3)];
    assert_eq!(rendered(&scene, &rolling, &stands, 0), rendered(&scene, &global, &stands, 0));
    let out = rendered(&scene, &rolling, &[at(-20.0), at(20.0)], 0);
    let row = rolling.model.cy + 100.0;
    let right_px = -20.0 + 40.0 * rolling.part_at_row(row, 0.5);
    let truth = Pixel::new(rolling.model.cx + right_px, row);
    assert!((right_px - 4.1).abs() < 0.1, "{right_px}");
    let white = f64::from(out[(row as usize - 170) * WIDTH + truth.x as usize]);
    let seen = dark_centroid(&out, truth, 0.55 * 0.15341 * 1818.0, white);
    assert!(seen.distance(&truth) < 0.05, "{seen:?} for {truth:?}");
}
