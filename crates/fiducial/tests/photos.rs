//! Tests real photographs, none of which shows the three-ring marker: nothing may fail, and next to nothing may be found.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use fiducial::{Detector, Settings};
use imaging::GrayView;

/// Photographs per folder, and how many detections each family has in them.
#[derive(Default)]
struct Count {
    images: usize,
    found: [usize; 2],
}

const FAMILIES: [&str; 2] = ["rings", "rings-thesis"];

#[test]
fn photographs_without_the_marker_have_none() {
    let Some(root) = testing::recording("photos") else { return };
    let mut detectors = FAMILIES
        .map(|family| Detector::new(&[family.parse().unwrap()], Settings::default()).unwrap());
    let mut counts = BTreeMap::<String, Count>::new();
    for path in files_under(&root) {
        let Ok(image) = image::open(&path) else { continue };
        let image = image.into_luma8();
        let (width, height) = (image.width() as usize, image.height() as usize);
        let view = GrayView::packed(image.as_raw(), width, height).unwrap();
        let inside = path.strip_prefix(&root).unwrap();
        let folder = inside.iter().next().unwrap().to_string_lossy().into_owned();
        let count = counts.entry(folder).or_default();
        count.images += 1;
        for (index, detector) in detectors.iter_mut().enumerate() {
            for marker in detector.detect(view, None, &mut ()) {
                count.found[index] += 1;
                println!(
                    "{}: {} at {:.1}, {:.1}, size {:.1} px, confidence {:.2}",
                    inside.display(),
                    marker.family,
                    marker.centre.x,
                    marker.centre.y,
                    marker.size_px,
                    marker.confidence
                );
            }
        }
    }
    for (folder, count) in &counts {
        println!(
            "{folder:20} {:3} images, rings {:2}, rings-thesis {:2}",
            count.images, count.found[0], count.found[1]
        );
    }
    let rings: usize = counts.values().map(|c| c.found[0]).sum();
    let images: usize = counts.values().map(|c| c.images).sum();
    assert!(images > 100, "{images}");
    assert_eq!(rings, 0);
}

fn files_under(folder: &Path) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(files_under(&path));
        } else {
            files.push(path);
        }
    }
    files.sort();
    files
}
