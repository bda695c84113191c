//! Tests `tools/experiments/references.py` on a folder in which not every set is rendered.

use std::path::Path;
use std::process::Command;

use experiments::frame_spec::FrameRenderer;
use experiments::record;
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
    let output_text = String::from_utf8_lossy(&output.stdout);
    let problem = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{output_text}{problem}");
    if output_text.contains("skipped: the reference detectors need") {
        testing::skip("python", output_text.trim());
        return;
    }
    assert!(output_text.contains(&format!("of {frames} frames")), "{output_text}");
    assert!(results.join("opencv/far/aruco-4x4-50.jsonl").is_file(), "{output_text}");
    let output = run(&["set=circles"]);
    let error_text = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && error_text.contains("--set circles"), "{error_text}");
    // Labels have our names or OpenCV's. A family without a photograph has no file.
    let far = store::folder(&sets, Set::Far, marker);
    let frame = store::frames(&far).unwrap().remove(0);
    let pixels = record::read(&far.join(&frame.image)).unwrap();
    std::fs::write(far.join("turned.jpg"), turned(&pixels).unwrap()).unwrap();
    let [x, y] = frame.marker.unwrap().centre_px;
    for family in ["aruco-4x4-1000", "aruco_4x4_1000"] {
        let label = format!(
            "{{\"image\":\"turned.jpg\",\"markers\":[{{\"family\":\"{family}\",\"id\":0,\"corners\":[]}}]}}\n"
        );
        std::fs::write(far.join("labels.jsonl"), label).unwrap();
        let output = run(&["detector=opencv", &format!("photographs={}", far.display())]);
        let output_text = String::from_utf8_lossy(&output.stdout);
        let folder = results.join("opencv/photographs");
        let file = folder.join("aruco-4x4-1000.jsonl");
        let text = std::fs::read_to_string(&file).unwrap();
        let records = record::parse(&file, &text).unwrap();
        let found = records.iter().flat_map(|record| &record.found);
        // At its position in the picture as it is stored, not as it is turned.
        let is_there = |[u, v]: [f64; 2]| (u - x).hypot(v - y) < 1.0;
        assert!(found.clone().any(|it| is_there(it.centre_px)), "{family}: {x}, {y}, {text}");
        assert!(!folder.join("apriltag-36h11.jsonl").exists(), "{output_text}");
        std::fs::remove_dir_all(folder).unwrap();
    }
}

/// A JPEG whose Exif data request a quarter turn.
fn turned(pixels: &image::GrayImage) -> image::ImageResult<Vec<u8>> {
    let mut file = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut file, 95).encode_image(pixels)?;
    Ok(testing::with_exif_orientation(&file, 6))
}
