//! `tools/experiments/references.py` on a folder in which not every set is rendered.

use std::path::Path;
use std::process::Command;

use experiments::frame_spec::FrameRenderer;
use experiments::set::{SIZE_M, Set};
use experiments::sets::Variant;
use experiments::store;

#[test]
fn reference_detectors_take_the_sets_that_are_there() {
    let folder = tempfile::tempdir().unwrap();
    let (sets, results) = (folder.path().join("sets"), folder.path().join("results"));
    let marker = format!("aruco-4x4-50:0:{SIZE_M}").parse().unwrap();
    let variant = Variant { every: 40, ..Variant::default() };
    let mut renderer = FrameRenderer::default();
    let frames = store::make(&sets, Set::Far, marker, variant, &mut renderer).unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("references.py");
    let run = |rest: &[&str]| {
        Command::new(testing::interpreter())
            .arg(&script)
            .args([&sets, &results])
            .args(rest)
            .output()
            .unwrap()
    };
    let output = run(&[]);
    let told = String::from_utf8_lossy(&output.stdout);
    let problem = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{told}{problem}");
    if told.contains("skipped: the reference detectors need") {
        testing::skip("python", told.trim());
        return;
    }
    assert!(told.contains(&format!("of {frames} frames")), "{told}");
    assert!(results.join("opencv/far/aruco-4x4-50.jsonl").is_file(), "{told}");
    let output = run(&["set=circles"]);
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && told.contains("--set circles"), "{told}");
}
