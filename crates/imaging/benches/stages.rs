//! Each stage on a frame of 1296 x 972 pixels full of texture: `cargo bench -p imaging`.
#![allow(missing_docs, clippy::unwrap_used, reason = "a benchmark may stop anywhere")]

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use imaging::{
    BilateralRows, Contours, GrayImage, GrayView, LeastContrast, Limits, LocalThreshold, Outlines,
    Pyramid, bilateral_5x5, outline,
};
use rendering::views::{Binning, Studio, View};

/// Painted asphalt with a marker from 5 m.
fn frame() -> (Vec<u8>, usize, usize) {
    let binning = Binning::TwoByTwo;
    let view = View { binning, height_m: 5, lateral_m: 0.0, tilt_deg: 5.0, repeat: 0 };
    let (pixels, _) = Studio::new(binning).unwrap().take(&view).unwrap();
    let camera = binning.camera();
    (pixels, camera.width as usize, camera.height as usize)
}

fn stages(criterion: &mut Criterion) {
    let (pixels, width, height) = frame();
    let view = GrayView::packed(&pixels, width, height).unwrap();
    let mut group = criterion.benchmark_group("imaging");
    let (mut rows, mut filtered) = (BilateralRows::default(), GrayImage::default());
    group.bench_function("bilateral filter", |bencher| {
        bencher.iter(|| bilateral_5x5(black_box(view), &mut rows, &mut filtered));
    });
    let (mut threshold, mut binary) = (LocalThreshold::default(), GrayImage::default());
    let least = LeastContrast { levels: 8, percent: 10 };
    group.bench_function("local threshold", |bencher| {
        bencher.iter(|| threshold.apply(black_box(view), least, &mut binary));
    });
    let mut contours = Contours::default();
    group.bench_function("contours", |bencher| {
        let limits = Limits { least_points: 5, most_points: 4_000_000 };
        bencher.iter(|| contours.find(black_box(binary.view().unwrap()), limits));
    });
    let mut pyramid = Pyramid::default();
    group.bench_function("pyramid", |bencher| {
        bencher.iter(|| pyramid.build(black_box(view), 4, 32));
    });
    let mut outlines = Outlines::default();
    group.bench_function("outlines", |bencher| {
        bencher.iter(|| outlines.find(black_box(view), &outline::Settings::default()));
    });
    group.finish();
}

criterion_group!(benches, stages);
criterion_main!(benches);
