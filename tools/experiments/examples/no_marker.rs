//! Measures the time of each stage for a single image without a marker: frames of each ground from four heights, searched for the four
//! families of the thesis, with the shortest of a few times of each stage.
//!
//! ```text
//! cargo run --release -p experiments --example no_marker -- [SEED]
//! ```
#![allow(clippy::print_stdout, reason = "this example prints a table for people")]

use anyhow::Context;
use detector::StageClock;
use experiments::frame_spec::{FrameRenderer, FrameSpec, Tilt, pose};
use experiments::set::{MARKERS, SIZE_M};
use fiducial::{Detector, Settings};
use geometry::Pixel;
use imaging::GrayView;
use markers::Marker;
use messages::StageTime;
use rendering::{CameraSettings, Surface};

const HEIGHTS_M: [f64; 4] = [2.0, 4.0, 6.0, 8.0];
const REPEATS: usize = 7;

fn main() -> anyhow::Result<()> {
    let seed = std::env::args().nth(1).map_or(Ok(0), |word| word.parse()).context("SEED")?;
    let markers = MARKERS.iter().filter(|name| !name.starts_with("apriltag-36h11"));
    let markers: Vec<Marker> =
        markers.map(|name| format!("{name}:{SIZE_M}").parse()).collect::<Result<_, _>>()?;
    let mut detector = Detector::new(&markers, Settings::default())?;
    let mut renderer = FrameRenderer::default();
    let settings = CameraSettings::thesis();
    let model = settings.model;
    let (mut all_ms, mut stages) = (Vec::new(), Vec::<StageTime>::new());
    for (number, surface) in (seed..).step_by(10).zip(Surface::ALL) {
        let mut of_ground = Vec::new();
        for (number, height_m) in (number..).zip(HEIGHTS_M) {
            let tilt = Tilt { angle: 0.1, about: 1.0 };
            let at = pose(&model, Pixel::new(model.cx, model.cy), height_m, tilt, 0.3);
            let spec = FrameSpec { surface, ..FrameSpec::negative(settings.clone(), at, number) };
            let pixels = renderer.render(&spec)?;
            let view = GrayView::packed(&pixels, model.width as usize, model.height as usize)?;
            let mut fastest: Option<(f64, Vec<StageTime>)> = None;
            for _ in 0..REPEATS {
                let mut clock = StageClock::start();
                let found = detector.detect(view, Some(&model), &mut clock);
                anyhow::ensure!(found.is_empty(), "found");
                let ms = clock.elapsed().as_secs_f64() * 1e3;
                if fastest.as_ref().is_none_or(|(min_ms, _)| ms < *min_ms) {
                    fastest = Some((ms, clock.into_stages()));
                }
            }
            let (ms, parts) = fastest.context("REPEATS is 0")?;
            of_ground.push(ms);
            for part in parts {
                match stages.iter_mut().find(|sum| sum.stage == part.stage) {
                    Some(sum) => sum.micros += part.micros,
                    None => stages.push(part),
                }
            }
        }
        let listed: Vec<String> = of_ground.iter().map(|ms| format!("{ms:.1}")).collect();
        println!("{:8} {} ms", surface.name(), listed.join(", "));
        all_ms.extend(of_ground);
    }
    all_ms.sort_by(f64::total_cmp);
    let count = all_ms.len();
    let median = all_ms.get(count / 2).context("no frame")?;
    println!("median of {count} frames {median:.2} ms; means of the stages:");
    for StageTime { stage, micros } in stages {
        println!("{stage:12} {:.2} ms", f64::from(micros) * 1e-3 / count as f64);
    }
    Ok(())
}
