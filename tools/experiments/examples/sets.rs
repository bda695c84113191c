//! Renders sets of frames: `cargo run --release -p experiments --example sets -- FOLDER [SET...]`.
#![allow(clippy::print_stdout, reason = "a program for people at a terminal")]

use std::path::PathBuf;
use std::time::Instant;

use experiments::frame_spec::FrameRenderer;
use experiments::set::{MARKERS, SIZE_M, Set};
use experiments::sets::Variant;
use experiments::store;

fn main() -> anyhow::Result<()> {
    let mut arguments = std::env::args().skip(1);
    let root = PathBuf::from(
        arguments.next().ok_or_else(|| anyhow::anyhow!("usage: sets FOLDER [SET...]"))?,
    );
    let mut sets = arguments
        .map(|name| name.parse().map_err(anyhow::Error::msg))
        .collect::<anyhow::Result<Vec<Set>>>()?;
    if sets.is_empty() {
        sets = Set::ALL.to_vec();
    }
    let mut renderer = FrameRenderer::default();
    for set in sets {
        let markers = if set.has_marker() { &MARKERS[..] } else { &MARKERS[..1] };
        for name in markers {
            let Ok(marker) = format!("{name}:{SIZE_M}").parse() else {
                println!("{} {name}: unknown", set.name());
                continue;
            };
            let start = Instant::now();
            let frames = store::make(&root, set, marker, Variant::default(), &mut renderer)?;
            println!(
                "{} {name}: {frames} frames, {:.1} s",
                set.name(),
                start.elapsed().as_secs_f64()
            );
        }
    }
    Ok(())
}
