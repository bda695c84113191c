//! A calibration from board images as text and JSON: images with the board, how it was shown, focal lengths,
//! distortion, maps of residuals and of uncertainty, or the refusal.

use std::fmt::Write as _;

use calibration::{Calibration, Lens, Refusal};
use geometry::{CameraModel, Distortion};
use markers::Board;
use serde_json::{Value, json};

use super::found::{BLURRED_PX, FoundImages};
use super::shown::Shown;

/// The distance for which errors are given, in metres.
const FAR_M: f64 = 5.0;
/// Columns and rows of the maps of residuals and of uncertainty.
const MAP: [usize; 2] = [6, 4];
/// Names that are listed.
const MAX_NAMES: usize = 5;

/// Why there is no calibration, with the values of the options `--tag`, `--gap` and `--lens` that may fit the images. Where no image
/// shows the board, the text says which board is meant, or that the images are mirrored.
pub(super) fn refusal_text(
    found: &FoundImages,
    refusal: &Refusal,
    board: &Board,
    lens: Lens,
) -> String {
    if let Some(name) = &found.mirrored {
        return format!(
            "no image shows the board, but the mirrored image of {name} does: the images are mirrored; switch the camera's mirroring \
             off, or print the board again, not from its back"
        );
    }
    if found.views.is_empty() {
        return "no image shows the board, which is the grid of AprilTags that `alight calibrate board --print` writes; a chessboard \
                or another board is not found: calibrate with OpenCV from those, and give its file wherever a calibration is taken"
            .to_owned();
    }
    match refusal {
        Refusal::TagSize { percent, .. } => {
            // Images show only the ratio of the tags' side to their spacing.
            let tag_m = board.tag_m() * (1.0 + percent / 100.0);
            let gap_m = board.tag_m() + board.gap_m() - tag_m;
            if Board::new(board.columns(), board.rows(), tag_m, gap_m).is_err() {
                return refusal.to_string();
            }
            format!(
                "{refusal}. If the stated spacing is right, the images show `--tag {tag_m:.5} --gap {gap_m:.5}`"
            )
        }
        Refusal::WrongLens { .. } | Refusal::Diverged { .. } | Refusal::Inconsistent { .. } => {
            match lens {
                Lens::BrownConrady4 | Lens::BrownConrady5 => format!(
                    "{refusal}. Other lenses: `--lens brown-conrady-8` for a wide-angle lens, `--lens kannala-brandt` for a fisheye"
                ),
                Lens::BrownConrady8 => {
                    format!("{refusal}. For a fisheye: `--lens kannala-brandt`")
                }
                Lens::KannalaBrandt => refusal.to_string(),
            }
        }
        _ => refusal.to_string(),
    }
}

/// Which images show the board, and where in the image it was.
pub(super) fn found_text(found: &FoundImages, shown: &Shown) -> String {
    let points: usize = found.views.iter().map(|view| view.points.len()).sum();
    let mut text = format!(
        "images: {}, with the board: {}, its points: {points}\n",
        found.images,
        found.views.len()
    );
    if found.unmoved > 0 {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "left out, as the board had not moved: {}", found.unmoved);
    }
    if found.shaken > 0 {
        let _ = writeln!(text, "left out, as the board was not held still: {}", found.shaken);
    }
    if found.is_full {
        text.push_str("further images were left out: these are enough\n");
    }
    let blurred: Vec<&str> = blurred(found).collect();
    for (what, names) in [
        ("without the board", found.empty.iter().map(String::as_str).collect()),
        ("not readable", found.unreadable.iter().map(String::as_str).collect()),
        ("blurred (hold still, more light, focus)", blurred),
    ] {
        let names: Vec<&str> = names;
        if !names.is_empty() {
            let _ = writeln!(text, "{what}: {}", listed(&names));
        }
    }
    if found.views.is_empty() {
        return text;
    }
    text.push_str("where in the image the points are (#: 20 or more, +: some, .: none, show the board there):\n");
    for row in shown.point_counts {
        let sign = |count: &usize| match count {
            0 => '.',
            1..20 => '+',
            _ => '#',
        };
        let _ = writeln!(text, "  {}", row.iter().map(sign).collect::<String>());
    }
    text
}

fn blurred(found: &FoundImages) -> impl Iterator<Item = &str> {
    found.edges.iter().filter(|edge| edge.width_px > BLURRED_PX).map(|edge| edge.name.as_str())
}

/// How the board was shown, and which views would help.
pub(super) fn shown_text(shown: &Shown) -> String {
    let mut text = String::new();
    if let (Some(tilt_deg), Some(ratio)) = (shown.tilt_deg, shown.distance_ratio) {
        // Writing to a string cannot fail.
        let _ = writeln!(
            text,
            "tilt: up to {tilt_deg:.0} degrees; the farthest views are {ratio:.1} times as far as the nearest; points in {:.0} % \
             of the image",
            100.0 * shown.covered()
        );
    }
    for next in &shown.next {
        let _ = writeln!(text, "would help: {next}");
    }
    text
}

/// The camera and its accuracy.
pub(super) fn worth_text(calibration: &Calibration) -> String {
    let CameraModel { width, height, fx, fy, cx, cy, .. } = calibration.camera;
    let sigma = |i: usize| calibration.covariance[(i, i)].max(0.0).sqrt();
    let mut text = turned_text(calibration).unwrap_or_default();
    // Writing to a string cannot fail.
    let _ = writeln!(text, "{}, {width} x {height} pixels", calibration.lens);
    let _ = writeln!(
        text,
        "  focal lengths  {fx:.2} +- {:.2}, {fy:.2} +- {:.2} px\n  principal point  {cx:.2} +- {:.2}, {cy:.2} +- {:.2} px",
        sigma(0),
        sigma(1),
        sigma(2),
        sigma(3)
    );
    let _ = writeln!(text, "  distortion  {:.5?}", numbers(calibration));
    let _ = writeln!(
        text,
        "the points are found to {:.3} px each way; the residuals are {:.3} px (root mean square)",
        calibration.noise_px, calibration.rms_px
    );
    let [across, down] = calibration.bend_m.map(|bend| bend * 1e3);
    let _ = writeln!(text, "the board bends by {across:+.2} mm across and {down:+.2} mm down");
    let _ = writeln!(
        text,
        "uncertainty of the projection: {:.3} px or less in 95 % of the image where it is known",
        calibration.worst_uncertainty_px()
    );
    let unknown = calibration.unknown_share();
    if unknown > 0.0 {
        let _ = writeln!(
            text,
            "not known: {:.0} % of the image, farther from its centre than the board was seen ({:.0} px): show it nearer to the edges, or use no marker there",
            (100.0 * unknown).ceil(),
            calibration.seen_radius_px
        );
    }
    match &calibration.cross_validation {
        Some(halves) => {
            let _ = writeln!(
                text,
                "two halves of the images give cameras that differ by {:.3} px ({:.3} px expected)",
                halves.difference_px, halves.expected_px
            );
        }
        None => text.push_str("half of the images alone shows no camera: take more\n"),
    }
    text.push_str(&maps_text(calibration));
    let error = calibration.error_at(FAR_M);
    let _ = writeln!(
        text,
        "error at {FAR_M:.0} m because of the calibration: {} cm sideways, {} cm in distance (one standard deviation)",
        two_digits(100.0 * error.lateral_m),
        two_digits(100.0 * error.range_m)
    );
    text
}

/// The warning of images that were turned after they were taken, so that their principal point is elsewhere; `None` if there are none.
fn turned_text(calibration: &Calibration) -> Option<String> {
    let turned: Vec<&str> = turned(calibration).collect();
    let count = match turned.len() {
        0 => return None,
        1 => "1 image fits".to_owned(),
        count => format!("{count} images fit"),
    };
    Some(format!(
        "warning: {count} better after a turn by 180 degrees: {}; if another program turned them, turn them back or leave them out, and \
         calibrate again\n",
        listed(&turned)
    ))
}

fn turned(calibration: &Calibration) -> impl Iterator<Item = &str> {
    calibration.views.iter().filter(|view| view.is_turned).map(|view| view.name.as_str())
}

/// The first names, and how many more there are.
fn listed(names: &[&str]) -> String {
    let rest = names.len().saturating_sub(MAX_NAMES);
    let more = if rest > 0 { format!(" and {rest} more") } else { String::new() };
    format!("{}{more}", names[..names.len().min(MAX_NAMES)].join(", "))
}

/// Maps of the residuals of the points and of the uncertainty of the projection.
fn maps_text(calibration: &Calibration) -> String {
    let [columns, rows] = MAP;
    let residuals = calibration.residual_map(columns, rows);
    let uncertainty = calibration.uncertainty_map(columns, rows);
    let cell = |value: Option<f64>| value.map_or("    -".to_owned(), |px| format!("{px:>6.3}"));
    let mut text = format!(
        "{:width$}uncertainty by position, px\n",
        "residuals by position, px",
        width = 7 * columns + 3
    );
    for (left, right) in residuals.chunks(columns).zip(uncertainty.chunks(columns)) {
        let left = left.iter().map(|it| cell((it.points > 0).then_some(it.rms_px)));
        let right = right.iter().map(|it| cell(it.sigma_px));
        let [left, right] =
            [left.collect::<Vec<_>>(), right.collect()].map(|cells| cells.join(" "));
        let _ = writeln!(text, "{left}   {right}");
    }
    text
}

/// A number with two significant digits.
fn two_digits(value: f64) -> String {
    let before_point = if value > 0.0 { value.log10().floor() as i32 } else { 0 };
    let decimals = usize::try_from(1 - before_point).unwrap_or(0).min(4);
    format!("{value:.decimals$}")
}

/// The lens's numbers, those that its model has.
fn numbers(calibration: &Calibration) -> &[f64] {
    let all: &[f64] = match &calibration.camera.distortion {
        Distortion::None => &[],
        Distortion::BrownConrady(k) => k,
        Distortion::KannalaBrandt(k) => k,
    };
    let own = calibration.lens.parameters().saturating_sub(4);
    &all[..own.min(all.len())]
}

/// All of it for programs.
pub(super) fn json(
    found: &FoundImages,
    shown: &Shown,
    calibration: Option<&Calibration>,
    refused: Option<&str>,
) -> Value {
    let edges: Vec<Value> = found
        .edges
        .iter()
        .map(|edge| json!({ "image": edge.name, "edge_width_px": edge.width_px }))
        .collect();
    json!({
        "images": found.images,
        "with_board": found.views.len(),
        "without_board": found.empty,
        "unreadable": found.unreadable,
        "unmoved": found.unmoved,
        "blurred": blurred(found).collect::<Vec<_>>(),
        "edges": edges,
        "shaken": found.shaken,
        "shown": shown.json(),
        "refused": refused,
        "calibration": calibration.map(calibration_json),
    })
}

fn calibration_json(calibration: &Calibration) -> Value {
    let CameraModel { width, height, fx, fy, cx, cy, .. } = calibration.camera;
    let error = calibration.error_at(FAR_M);
    let views: Vec<Value> = calibration
        .views
        .iter()
        .map(|view| json!({ "image": view.name, "points": view.residuals.len(), "rms_px": view.rms_px }))
        .collect();
    let [columns, rows] = MAP;
    let residuals = calibration.residual_map(columns, rows);
    let residuals: Vec<Value> = residuals
        .iter()
        .map(|it| json!({ "x": it.middle.x, "y": it.middle.y, "points": it.points, "mean_px": it.mean_px, "rms_px": it.rms_px }))
        .collect();
    let uncertainty = calibration.uncertainty_map(columns, rows);
    let uncertainty: Vec<Value> = uncertainty
        .iter()
        .map(|it| json!({ "x": it.pixel.x, "y": it.pixel.y, "sigma_px": it.sigma_px }))
        .collect();
    let sigma: Vec<f64> = (0..4).map(|i| calibration.covariance[(i, i)].max(0.0).sqrt()).collect();
    let evidence = &calibration.evidence;
    json!({
        "lens": calibration.lens.to_string(),
        "width": width,
        "height": height,
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
        "fx_fy_cx_cy_sigma": sigma,
        "distortion": numbers(calibration),
        "noise_px": calibration.noise_px,
        "rms_px": calibration.rms_px,
        "uncertainty_px": calibration.worst_uncertainty_px(),
        "seen_radius_px": calibration.seen_radius_px,
        "unknown_share": calibration.unknown_share(),
        "bend_m": calibration.bend_m,
        "tilt_deg": evidence.tilt.to_degrees(),
        "distance_ratio": evidence.distance_ratio,
        "covered": evidence.coverage.covered,
        "halves_differ_px": calibration.cross_validation.map(|halves| halves.difference_px),
        "halves_expected_px": calibration.cross_validation.map(|halves| halves.expected_px),
        "error_at_5_m": { "lateral_m": error.lateral_m, "range_m": error.range_m },
        "residuals_by_place": residuals,
        "uncertainty_by_place": uncertainty,
        "turned": turned(calibration).collect::<Vec<_>>(),
        "views": views,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::{ImageSize, View};

    #[test]
    fn images_without_the_board_are_reported_with_the_board_that_is_meant() {
        let refusal = Refusal::TooFewViews { views: 0, min_views: 3, min_points: 12 };
        let mut found = FoundImages::default();
        let reason =
            |found: &FoundImages| refusal_text(found, &refusal, &Board::A4, Lens::BrownConrady5);
        let text = reason(&found);
        assert!(text.contains("AprilTags") && text.contains("chessboard"), "{text}");
        assert!(text.contains("OpenCV") && !text.contains("more pictures"), "{text}");
        let size = ImageSize { width: 640, height: 480 };
        found.views.push(View { name: "a.png".to_owned(), size, points: Vec::new() });
        assert_eq!(reason(&found), refusal.to_string());
    }

    #[test]
    fn refusals_name_the_options_that_may_be_right() {
        let size = ImageSize { width: 640, height: 480 };
        let mut found = FoundImages::default();
        found.views.push(View { name: "a.png".to_owned(), size, points: Vec::new() });
        let board = Board::new(5, 7, 0.0281, 0.0083).unwrap();
        let reason = |refusal, lens| refusal_text(&found, &refusal, &board, lens);
        let size = Refusal::TagSize { percent: -0.35, max_percent: 0.3 };
        let text = reason(size, Lens::BrownConrady5);
        assert!(text.contains("the images show `--tag 0.02800 --gap 0.00840`"), "{text}");
        // A gap that no board has is not named.
        let size = Refusal::TagSize { percent: 20.0, max_percent: 0.3 };
        let text = reason(size.clone(), Lens::BrownConrady5);
        assert_eq!(text, size.to_string());
        let (max_px, max_ratio) = (0.3, 4.0);
        let halves = Refusal::Inconsistent { difference_px: 0.75, ratio: 5.7, max_px, max_ratio };
        for lens in [Lens::BrownConrady5, Lens::BrownConrady8] {
            let text = reason(halves.clone(), lens);
            assert!(text.contains("`--lens kannala-brandt`"), "{text}");
            assert_eq!(text.contains("`--lens brown-conrady-8`"), lens == Lens::BrownConrady5);
        }
        assert_eq!(reason(halves.clone(), Lens::KannalaBrandt), halves.to_string());
    }
}
