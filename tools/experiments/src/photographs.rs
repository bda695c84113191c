//! Scores real photographs: recall on labelled ones, false detections on those without a marker.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

use anyhow::Context;
use fiducial::{Detector, Settings};
use image::GrayImage;
use markers::{Family, Marker};
use serde::Deserialize;

use crate::record::{self, Found, Record};

/// The families of the labels, and their names here.
pub const FAMILIES: [(&str, &str); 5] = [
    ("tag36h11", "apriltag-36h11"),
    ("aruco_4x4_1000", "aruco-4x4-1000"),
    ("aruco_5x5_1000", "aruco-5x5-1000"),
    ("aruco_6x6_1000", "aruco-6x6-1000"),
    ("stag_hd21", "stag-hd21"),
];

/// A line of `labels.jsonl`.
#[derive(Debug, Deserialize)]
struct Photograph {
    image: String,
    markers: Vec<Label>,
    /// A label that may be found or not.
    #[serde(default)]
    uncertain: Vec<Label>,
    #[serde(default)]
    negative: bool,
    /// Whether all markers are labelled.
    #[serde(default)]
    complete: Option<bool>,
}

#[derive(Debug, Deserialize)]
struct Label {
    family: String,
    id: u32,
    corners: [[f64; 2]; 4],
}

impl Label {
    /// Whether it is of a family, by the labels' name or by ours. An ArUco dictionary of 50, 100 or 250 markers is the beginning of that of
    /// 1000 markers.
    fn is_of(&self, family: &str) -> bool {
        let label = FAMILIES.iter().find(|(_, ours)| *ours == family).map(|(label, _)| *label);
        let is_name = |name: &str| name == family || label == Some(name);
        let stem_of = |count: &str| {
            let stem = self.family.strip_suffix(count)?;
            (stem.starts_with("aruco") && stem.ends_with(['-', '_'])).then_some(stem)
        };
        let beginning = ["50", "100", "250"].into_iter().find_map(stem_of);
        is_name(&self.family) || beginning.is_some_and(|stem| is_name(&format!("{stem}1000")))
    }

    fn centre(&self) -> [f64; 2] {
        [0, 1].map(|i| self.corners.iter().map(|corner| corner[i]).sum::<f64>() / 4.0)
    }

    /// Half of the longest diagonal.
    fn reach_px(&self) -> f64 {
        let centre = self.centre();
        self.corners.iter().map(|c| away(*c, centre)).fold(0.0, f64::max)
    }

    /// Whether a detection is at this label.
    fn is_at(&self, found: &Found) -> bool {
        away(found.centre_px, self.centre()) < 0.35 * self.reach_px()
    }
}

fn away(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The results of a detector on the labelled photographs of one family.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Recall {
    /// Labelled markers.
    pub markers: usize,
    /// Detected markers.
    pub found: usize,
    /// Detections with another id.
    pub wrong_ids: usize,
    /// Detections without a label in photographs with complete labels.
    pub elsewhere: usize,
    /// Detections without a label in the other photographs.
    pub unlabelled: usize,
    /// Photographs with missed markers, and their number.
    pub missed: Vec<(String, usize)>,
    /// Photographs with detections of another id or without a label, and their number.
    pub others: Vec<(String, usize)>,
}

fn photographs(folder: &Path) -> anyhow::Result<Vec<Photograph>> {
    let path = folder.join("labels.jsonl");
    let text =
        std::fs::read_to_string(&path).with_context(|| format!("reading {}", path.display()))?;
    let parsed = |(at, line): (usize, &str)| {
        serde_json::from_str(line).with_context(|| {
            format!("line {} of {}; docs/experiments.md has its form", at + 1, path.display())
        })
    };
    text.lines().enumerate().map(parsed).collect()
}

/// Whether a folder has photographs with labels.
///
/// # Errors
/// When `labels.jsonl` cannot be read or is empty, or a photograph is not there.
pub fn check(folder: &Path) -> anyhow::Result<()> {
    let photographs = photographs(folder)?;
    let labels = folder.join("labels.jsonl");
    anyhow::ensure!(!photographs.is_empty(), "{} names no photograph", labels.display());
    for (at, Photograph { image, .. }) in photographs.iter().enumerate() {
        let file = folder.join(image);
        anyhow::ensure!(
            file.is_file(),
            "line {} of {} names the photograph {}, which is not there",
            at + 1,
            labels.display(),
            file.display()
        );
    }
    Ok(())
}

/// A note for the report on labels that are not searched, because their family is another one or its name is misspelt; empty if there are none.
///
/// # Errors
/// When the labels cannot be read.
pub fn unsearched(folder: &Path) -> anyhow::Result<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for label in photographs(folder)?.into_iter().flat_map(|photograph| photograph.markers) {
        if !FAMILIES.iter().any(|(_, ours)| label.is_of(ours)) {
            *counts.entry(label.family).or_default() += 1;
        }
    }
    if counts.is_empty() {
        return Ok(String::new());
    }
    let counts: Vec<String> =
        counts.iter().map(|(family, count)| format!("{count} of `{family}`")).collect();
    let searched = FAMILIES.map(|(_, ours)| ours).join(", ");
    Ok(format!(
        "\n**Labels that are not searched: {}.** Labels are supported for {searched} only.\n",
        counts.join(", ")
    ))
}

/// Any marker of a family, without a size.
pub fn any_of(family: Family) -> Marker {
    Marker { family, id: None, size_m: None }
}

/// Runs the detector for one family over the photographs with labels of it.
///
/// # Errors
/// When a photograph or the labels cannot be read.
pub fn run(folder: &Path, family: Family) -> anyhow::Result<Vec<Record>> {
    let mut detector = Detector::new(&[any_of(family)], Settings::default())?;
    let mut records = Vec::new();
    for photograph in photographs(folder)? {
        if photograph.markers.iter().any(|marker| marker.is_of(family.name())) {
            let image = record::read(&folder.join(&photograph.image))?;
            let (ms, found) = record::answer(&mut detector, &image, None, 1)?;
            records.push(Record { image: photograph.image, ms, found });
        }
    }
    Ok(records)
}

/// A photograph, and its labels of one family.
#[derive(Debug)]
pub struct LabelledImage {
    /// The photograph.
    pub image: GrayImage,
    labels: Vec<Label>,
}

impl LabelledImage {
    /// Number of labelled markers.
    pub fn shown(&self) -> usize {
        self.labels.len()
    }

    /// Number of labelled markers among detections.
    pub fn found(&self, found: &[Found]) -> usize {
        let is_found = |label: &&Label| {
            found.iter().any(|seen| label.is_at(seen) && seen.id == Some(label.id))
        };
        self.labels.iter().filter(is_found).count()
    }
}

/// The photographs with labels of a family.
///
/// # Errors
/// When a photograph or the labels cannot be read.
pub fn labelled(
    folder: &Path,
    family: Family,
) -> anyhow::Result<impl Iterator<Item = anyhow::Result<LabelledImage>>> {
    Ok(photographs(folder)?.into_iter().filter_map(move |photograph| {
        let mut labels = photograph.markers;
        labels.retain(|marker| marker.is_of(family.name()));
        (!labels.is_empty()).then(|| {
            Ok(LabelledImage { image: record::read(&folder.join(&photograph.image))?, labels })
        })
    }))
}

/// The families with labels.
pub fn labelled_families() -> impl Iterator<Item = Family> {
    FAMILIES.iter().filter_map(|(_, name)| Family::named(name))
}

/// The recall of the labelled markers of a family.
///
/// # Errors
/// When the labels cannot be read, or a result is missing.
pub fn recall(folder: &Path, family: &str, records: &[Record]) -> anyhow::Result<Recall> {
    let mut recall = Recall::default();
    for photograph in photographs(folder)? {
        let is_ours = |marker: &&Label| marker.is_of(family);
        let markers: Vec<&Label> = photograph.markers.iter().filter(is_ours).collect();
        if markers.is_empty() {
            continue;
        }
        let record = records.iter().find(|record| record.image == photograph.image);
        let record = record.with_context(|| format!("no result for {}", photograph.image))?;
        let has = |label: &&&Label| {
            record.found.iter().any(|found| label.is_at(found) && found.id == Some(label.id))
        };
        let found = markers.iter().filter(has).count();
        recall.markers += markers.len();
        recall.found += found;
        if found < markers.len() {
            recall.missed.push((photograph.image.clone(), markers.len() - found));
        }
        let before = recall.wrong_ids + recall.elsewhere + recall.unlabelled;
        for found in &record.found {
            let at = |label: &&Label| label.is_at(found);
            match photograph.markers.iter().find(at) {
                Some(label) if is_ours(&label) && found.id != Some(label.id) => {
                    recall.wrong_ids += 1;
                }
                Some(_) => {}
                None if photograph.uncertain.iter().any(|label| at(&label)) => {}
                None if photograph.complete == Some(true) => recall.elsewhere += 1,
                None => recall.unlabelled += 1,
            }
        }
        let others = recall.wrong_ids + recall.elsewhere + recall.unlabelled - before;
        if others > 0 {
            recall.others.push((photograph.image.clone(), others));
        }
    }
    Ok(recall)
}

/// The families to find in negatives: those of the experiment, and all.
pub fn families_for_negatives() -> [(&'static str, Vec<Family>); 2] {
    let thesis = crate::set::families().filter_map(Family::named);
    let all = Family::ALL.into_iter().filter(|family| *family != Family::RingsThesis);
    [("experiment", thesis.collect()), ("all", all.collect())]
}

/// The number of images, and the false detections by image.
pub type Negatives = (usize, Vec<(String, Vec<Found>)>);

/// False detections in the photographs without a marker: the complete image, its quarters and its ninths, each
/// at full resolution.
///
/// # Errors
/// When a photograph or the labels cannot be read.
pub fn negatives(folder: &Path, families: &[Family]) -> anyhow::Result<Negatives> {
    let markers: Vec<Marker> = families.iter().map(|family| any_of(*family)).collect();
    let mut detector = Detector::new(&markers, Settings::default())?;
    let (mut images, mut wrong) = (0, Vec::new());
    for photograph in photographs(folder)?.iter().filter(|photograph| photograph.negative) {
        let complete = record::read(&folder.join(&photograph.image))?;
        for (name, part) in parts(&complete) {
            let (_, found) = record::answer(&mut detector, &part, None, 1)?;
            images += 1;
            if !found.is_empty() {
                wrong.push((format!("{}{name}", photograph.image), found));
            }
        }
    }
    Ok((images, wrong))
}

/// The complete image, its quarters and its ninths, with suffixes for its name.
fn parts(complete: &GrayImage) -> Vec<(String, GrayImage)> {
    let mut parts = vec![(String::new(), complete.clone())];
    for count in [2, 3] {
        let (width, height) = (complete.width() / count, complete.height() / count);
        for (x, y) in (0..count).flat_map(|x| (0..count).map(move |y| (x, y))) {
            let part = image::imageops::crop_imm(complete, x * width, y * height, width, height);
            parts
                .push((format!(" {width}x{height}+{}+{}", x * width, y * height), part.to_image()));
        }
    }
    parts
}

/// Recalls by family and detector.
pub type Recalls = BTreeMap<String, BTreeMap<String, Recall>>;

/// The table of recall on photographs.
pub fn text(recalls: &Recalls) -> String {
    let rows = || {
        recalls.iter().flat_map(|(family, of_family)| {
            of_family.iter().map(move |(detector, recall)| (family, detector, recall))
        })
    };
    if recalls.is_empty() {
        return String::new();
    }
    let mut text = String::from(
        "\n## Labelled photographs\n\n| marker | detector | found | wrong ids | elsewhere | unlabelled |\n|---|---|---|---|---|---|\n",
    );
    // Writing to a string cannot fail.
    for (family, detector, r) in rows() {
        let _ = writeln!(
            text,
            "| {family} | {detector} | {}/{} | {} | {} | {} |",
            r.found, r.markers, r.wrong_ids, r.elsewhere, r.unlabelled
        );
    }
    for (family, _, r) in rows().filter(|(_, detector, _)| *detector == record::OURS) {
        for (heading, photographs) in
            [("Missed", &r.missed), ("Of another id or without a label", &r.others)]
        {
            if !photographs.is_empty() {
                let _ = writeln!(text, "\n{heading} by us, {family}:");
            }
            for (image, count) in photographs {
                let _ = writeln!(text, "- {image}: {count}");
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_of_a_user_need_only_the_known_fields() {
        let folder = tempfile::tempdir().unwrap();
        let label = |family: &str| {
            format!(
                "{{\"image\":\"a.jpg\",\"markers\":[{{\"family\":\"{family}\",\"id\":3,\"corners\":[[0,0],[10,0],[10,10],[0,10]]}}]}}"
            )
        };
        let found =
            |id, centre_px| Found { id: Some(id), centre_px, ..Found::sample("apriltag-36h11") };
        let seen = vec![found(3, [5.0, 5.0]), found(4, [50.0, 50.0])];
        let records = [Record { image: "a.jpg".to_owned(), ms: 1.0, found: seen }];
        let path = folder.path().join("labels.jsonl");
        std::fs::write(folder.path().join("a.jpg"), "").unwrap();
        for family in ["tag36h11", "apriltag-36h11"] {
            std::fs::write(&path, label(family)).unwrap();
            check(folder.path()).unwrap();
            let recall = recall(folder.path(), "apriltag-36h11", &records).unwrap();
            assert_eq!((recall.markers, recall.found, recall.unlabelled), (1, 1, 1), "{family}");
            let of_ours = BTreeMap::from([(record::OURS.to_owned(), recall)]);
            let report = text(&BTreeMap::from([("apriltag-36h11".to_owned(), of_ours)]));
            assert!(
                report.contains("without a label by us, apriltag-36h11:\n- a.jpg: 1"),
                "{report}"
            );
        }
        let wrong = label("tag36h11").replace("corners", "corner");
        std::fs::write(&path, format!("{}\n{wrong}\n", label("tag36h11"))).unwrap();
        let error = format!("{:#}", check(folder.path()).unwrap_err());
        assert!(error.contains("line 2 of") && error.contains("docs/experiments.md"), "{error}");
    }

    #[test]
    fn labels_that_are_not_searched_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("labels.jsonl");
        let label = |family: &str| {
            format!(
                "{{\"image\":\"a.jpg\",\"markers\":[{{\"family\":\"{family}\",\"id\":3,\"corners\":[[0,0],[10,0],[10,10],[0,10]]}}]}}"
            )
        };
        let lines = ["rings", "AprilTag 36h11", "aruco-mip-36h12", "rings", "stag_hd21"].map(label);
        std::fs::write(&path, lines.join("\n")).unwrap();
        let error = format!("{:#}", check(folder.path()).unwrap_err());
        assert!(error.contains("line 1 of") && error.contains("a.jpg, which is not"), "{error}");
        std::fs::write(folder.path().join("a.jpg"), "").unwrap();
        check(folder.path()).unwrap();
        let note = unsearched(folder.path()).unwrap();
        let counts = "1 of `AprilTag 36h11`, 1 of `aruco-mip-36h12`, 2 of `rings`.";
        assert!(note.contains(counts) && note.contains("stag-hd21 only"), "{note}");
        // The ids of a smaller dictionary are those of the largest one.
        for family in ["aruco-4x4-50", "aruco_4x4_250"] {
            std::fs::write(&path, label(family)).unwrap();
            assert_eq!(unsearched(folder.path()).unwrap(), "", "{family}");
            let seen =
                Found { id: Some(3), centre_px: [5.0, 5.0], ..Found::sample("aruco-4x4-1000") };
            let records = [Record { image: "a.jpg".to_owned(), ms: 1.0, found: vec![seen] }];
            let of = |name| recall(folder.path(), name, &records).unwrap();
            assert_eq!((of("aruco-4x4-1000").markers, of("aruco-4x4-1000").found), (1, 1));
            assert_eq!(of("aruco-5x5-1000").markers, 0, "{family}");
        }
    }
}
