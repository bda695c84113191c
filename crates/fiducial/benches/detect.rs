//! Measures the time of detections in one frame of 1296 x 972 pixels with a textured ground, by family, and of an image without
//! a marker; and a marker that is followed: `cargo bench -p fiducial`.
#![allow(missing_docs, clippy::unwrap_used, reason = "a benchmark may stop anywhere")]

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use fiducial::{Detector, Settings, Tracker, TrackingSettings};
use geometry::{Body, Ned, Point, Rotation, Transform};
use imaging::GrayView;
use markers::Marker;
use rendering::views::MARKERS;
use rendering::{CameraSettings, PadInScene, Renderer, Scene, Surface};

/// A marker seen from this height.
fn frame(marker: Option<Marker>, settings: &CameraSettings, height_m: f64) -> Vec<u8> {
    let pads = marker.map(|marker| PadInScene::flat(marker, 0.2, -0.1, 0.4)).into_iter().collect();
    let scene = Scene { surface: Surface::Grass, pads, painted_marks: 20, light: 1.0 };
    let mut renderer = Renderer::new(&scene, settings.clone(), 3).unwrap();
    let place = Point::<Ned>::new(0.0, 0.0, -height_m);
    let pose: Transform<Ned, Body> = Transform::new(Rotation::from_euler(0.05, -0.1, 0.3), place);
    let mut pixels = vec![0; settings.model.width as usize * settings.model.height as usize];
    renderer.render(&[pose], 0, &mut pixels).unwrap();
    pixels
}

fn detect(criterion: &mut Criterion) {
    let settings = CameraSettings::thesis();
    let model = settings.model;
    let parse = |name: &str| format!("{name}:0.15341").parse::<Marker>().unwrap();
    let mut group = criterion.benchmark_group("detect");
    let mut measure = |name: &str, markers: &[Marker], shown: Option<Marker>| {
        let pixels = frame(shown, &settings, 5.0);
        let view = GrayView::packed(&pixels, model.width as usize, model.height as usize).unwrap();
        let mut detector = Detector::new(markers, Settings::default()).unwrap();
        group.bench_function(name, |bencher| {
            bencher.iter(|| detector.detect(black_box(view), Some(&model), &mut ()).len());
        });
    };
    for name in MARKERS {
        let marker = parse(name);
        measure(name, &[marker], Some(marker));
    }
    let all = MARKERS.map(parse);
    measure("all", &all, Some(all[0]));
    measure("all, no marker", &all, None);
    group.finish();
}

/// A marker of 48 px that is where it was expected.
fn follow(criterion: &mut Criterion) {
    let settings = CameraSettings::thesis();
    let model = settings.model;
    let mut group = criterion.benchmark_group("follow");
    for name in MARKERS {
        let marker: Marker = format!("{name}:0.15341").parse().unwrap();
        let pixels = frame(Some(marker), &settings, 5.8);
        let view = GrayView::packed(&pixels, model.width as usize, model.height as usize).unwrap();
        let mut detector = Detector::new(&[marker], Settings::default()).unwrap();
        let mut tracker = Tracker::new(TrackingSettings { full_search_period: u32::MAX });
        let mut time_s = 0.0;
        group.bench_function(name, |bencher| {
            bencher.iter(|| {
                time_s += 0.03;
                let view = black_box(view);
                tracker.detect(&mut detector, view, Some(&model), time_s, &mut ()).len()
            });
        });
    }
    group.finish();
}

criterion_group!(benches, detect, follow);
criterion_main!(benches);
