//! Measures the time of each stage on a frame of 1296 x 972 pixels full of texture: `cargo bench -p imaging`.
#![allow(missing_docs, clippy::unwrap_used, reason = "a benchmark may stop anywhere")]

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use imaging::{
    BilateralRows, Contours, GrayImage, GrayView, Limits, Outlines, Pyramid, SegmentLimits,
    Segments, bilateral_5x5, outline, threshold,
};

const SIZE: [usize; 2] = [1296, 972];

/// Asphalt: noise with a grain of a few pixels, and dark rings on bright paper in the middle.
fn frame() -> Vec<u8> {
    let mut random = 1_u32;
    let mut noise = || {
        random = random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (random >> 24) as f32 - 128.0
    };
    let [width, height] = SIZE;
    let grains: Vec<f32> = (0..width * height).map(|_| noise()).collect();
    let pixel = |i: usize| {
        let (x, y) = (i % width, i / width);
        let radius = (x as f32 - 648.0).hypot(y as f32 - 486.0);
        let grain = [i, i + 1, i + width, i + width + 1];
        let grain: f32 = grain.iter().map(|at| grains.get(*at).copied().unwrap_or(0.0)).sum();
        let ink = ((radius / 6.0) as u32).is_multiple_of(2);
        let light = match (radius < 40.0, ink) {
            (true, true) => 30.0,
            (true, false) => 200.0,
            (false, _) => 110.0 + 0.15 * grain,
        };
        light as u8
    };
    (0..width * height).map(pixel).collect()
}

fn stages(criterion: &mut Criterion) {
    let pixels = frame();
    let view = GrayView::packed(&pixels, SIZE[0], SIZE[1]).unwrap();
    let mut group = criterion.benchmark_group("imaging");
    let (mut rows, mut filtered) = (BilateralRows::default(), GrayImage::default());
    group.bench_function("bilateral filter", |bencher| {
        bencher.iter(|| bilateral_5x5(black_box(view), &mut rows, &mut filtered));
    });
    let mut binary = GrayImage::default();
    group.bench_function("threshold", |bencher| {
        bencher.iter(|| threshold(black_box(view), 100, &mut binary));
    });
    let mut contours = Contours::default();
    group.bench_function("contours", |bencher| {
        let limits = Limits { min_points: 5, max_points: 4_000_000 };
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
    let mut segments = Segments::default();
    group.bench_function("segments", |bencher| {
        let limits = SegmentLimits { min_gradient: 6, min_length_px: 5.0 };
        bencher.iter(|| segments.find(black_box(view), limits).len());
    });
    group.finish();
}

criterion_group!(benches, stages);
criterion_main!(benches);
