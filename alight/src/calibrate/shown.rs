//! Summarises how the calibration board has been shown so far (views, parts of the image, tilt, distances), and advises which view is
//! needed next.

use calibration::{Calibration, View};
use serde_json::{Value, json};

use super::found::{BLURRED_PX, FoundImages};

/// Columns and rows of the parts of the image in which points are counted for people: those that the solution counts.
pub(super) const COLUMNS: usize = calibration::Coverage::PARTS[0];
pub(super) const ROWS: usize = calibration::Coverage::PARTS[1];
/// A good set: how many views, how tilted, by how much the farthest are farther than the nearest, how much of the image.
const GOOD_VIEWS: usize = 20;
const GOOD_TILT_DEG: f64 = 30.0;
const GOOD_DISTANCES: f64 = 1.8;
const GOOD_COVERED: f64 = 0.95;
/// Minimum number of points in a part of the image; a part with fewer is reported.
const FEW_POINTS: usize = 8;

/// How the board was shown, and which views are still missing.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Shown {
    pub(super) views: usize,
    /// How many points lie in each part of the image, row by row.
    pub(super) point_counts: [[usize; COLUMNS]; ROWS],
    /// One view of ten is tilted more; `None` until a first camera is found.
    pub(super) tilt_deg: Option<f64>,
    /// The farthest tenth of the views by the nearest.
    pub(super) distance_ratio: Option<f64>,
    /// Images with wide outlines.
    pub(super) blurred: usize,
    /// Advice for the next views, the most useful first; empty when nothing is missing.
    pub(super) next: Vec<String>,
}

impl Shown {
    /// Of the images, and a first solution of them where there is one.
    pub(super) fn new(found: &FoundImages, first: Option<&Calibration>) -> Self {
        let mut shown = Self {
            views: found.views.len(),
            point_counts: point_counts(&found.views),
            tilt_deg: first.map(|it| it.evidence.tilt.to_degrees()),
            distance_ratio: first.map(|it| it.evidence.distance_ratio),
            blurred: found.edges.iter().filter(|edge| edge.width_px > BLURRED_PX).count(),
            next: Vec::new(),
        };
        shown.next = shown.advice();
        shown
    }

    /// The fraction of the image's parts in which there are points.
    pub(super) fn covered(&self) -> f64 {
        let parts = self.point_counts.iter().flatten();
        parts.filter(|count| **count > 0).count() as f64 / (COLUMNS * ROWS) as f64
    }

    /// A line for the person with the board.
    pub(super) fn line(&self) -> String {
        let mut line = format!(
            "{}, {:.0} % of the image",
            counted(self.views, "view"),
            100.0 * self.covered()
        );
        if let Some(tilt_deg) = self.tilt_deg {
            line.push_str(&format!(", tilt {tilt_deg:.0} degrees"));
        }
        if let Some(ratio) = self.distance_ratio {
            line.push_str(&format!(", distances 1 to {ratio:.1}"));
        }
        match self.next.first() {
            Some(next) => line.push_str(&format!("; next: {next}")),
            None => line.push_str("; enough"),
        }
        line
    }

    /// Advice for the next views, the most useful first.
    pub(super) fn advice(&self) -> Vec<String> {
        let mut next = Vec::new();
        if 2 * self.blurred > self.views {
            next.push(
                "hold the board still, use more light, and focus: most outlines are blurred"
                    .to_owned(),
            );
        }
        if self.covered() < GOOD_COVERED
            && let Some(place) = self.emptiest()
        {
            next.push(format!("show the board {place} of the image"));
        }
        if self.tilt_deg.is_some_and(|tilt_deg| tilt_deg < GOOD_TILT_DEG) {
            next.push("turn the board by 30 to 45 degrees, to all four sides".to_owned());
        }
        if self.distance_ratio.is_some_and(|ratio| ratio < GOOD_DISTANCES) {
            next.push(
                "take some so near that the board fills the image, and some from twice as far"
                    .to_owned(),
            );
        }
        if self.views < GOOD_VIEWS {
            next.push(format!("take {}", counted(GOOD_VIEWS - self.views, "more image")));
        }
        next
    }

    /// Where in the image most parts have few points: its corners and edges.
    fn emptiest(&self) -> Option<&'static str> {
        let lacks = |rows: std::ops::Range<usize>, columns: std::ops::Range<usize>| {
            let parts = rows.flat_map(|row| columns.clone().map(move |column| [row, column]));
            parts.filter(|[row, column]| self.point_counts[*row][*column] < FEW_POINTS).count()
        };
        let (left, right) = (0..COLUMNS / 4, COLUMNS - COLUMNS / 4..COLUMNS);
        let (top, bottom) = (0..ROWS / 3, ROWS - ROWS / 3..ROWS);
        let (across, down) = (COLUMNS / 4..COLUMNS - COLUMNS / 4, ROWS / 3..ROWS - ROWS / 3);
        // Where several lack as many the first is named.
        let mut worst = None;
        for (rows, columns, name) in [
            (top.clone(), left.clone(), "in the upper left corner"),
            (top.clone(), right.clone(), "in the upper right corner"),
            (bottom.clone(), left.clone(), "in the lower left corner"),
            (bottom.clone(), right.clone(), "in the lower right corner"),
            (down.clone(), left, "at the left edge"),
            (down.clone(), right, "at the right edge"),
            (top, across.clone(), "at the upper edge"),
            (bottom, across.clone(), "at the lower edge"),
            (down, across, "in the middle"),
        ] {
            let count = lacks(rows, columns);
            if count > worst.map_or(0, |(max_count, _)| max_count) {
                worst = Some((count, name));
            }
        }
        worst.map(|(_, name)| name)
    }

    /// For programs.
    pub(super) fn json(&self) -> Value {
        json!({
            "views": self.views,
            "covered": self.covered(),
            "point_counts": self.point_counts,
            "tilt_deg": self.tilt_deg,
            "distance_ratio": self.distance_ratio,
            "blurred": self.blurred,
            "next": self.next,
        })
    }
}

/// A number of things with their name, which is `noun` in the singular.
fn counted(count: usize, noun: &str) -> String {
    let plural = if count == 1 { "" } else { "s" };
    format!("{count} {noun}{plural}")
}

fn point_counts(views: &[View]) -> [[usize; COLUMNS]; ROWS] {
    let mut counts = [[0; COLUMNS]; ROWS];
    for view in views {
        let part = |at: f64, edge: u32, parts: usize| {
            // The cast maps negative values to zero.
            (((at + 0.5) / f64::from(edge) * parts as f64) as usize).min(parts - 1)
        };
        for point in &view.points {
            let row = part(point.seen.y, view.size.height, ROWS);
            counts[row][part(point.seen.x, view.size.width, COLUMNS)] += 1;
        }
    }
    counts
}

#[cfg(test)]
mod tests {
    use super::*;
    use calibration::{ImageSize, Sighting};
    use geometry::Pixel;

    /// Images with ten points in each part of the image that is asked for.
    fn seen_in(is_wanted: impl Fn(usize, usize) -> bool) -> FoundImages {
        let mut points = Vec::new();
        for (row, column) in (0..ROWS).flat_map(|row| (0..COLUMNS).map(move |column| (row, column)))
        {
            let seen = Pixel::new(100.0 * column as f64 + 50.0, 100.0 * row as f64 + 50.0);
            if is_wanted(row, column) {
                points.extend([Sighting { tag: 0, place_m: [0.0; 2], seen }; 10]);
            }
        }
        let size = ImageSize { width: 800, height: 600 };
        let mut found = FoundImages::default();
        found.views.push(View { name: String::new(), size, points });
        found
    }

    #[test]
    fn the_part_of_the_image_that_lacks_points_is_named() {
        let next = |found: &FoundImages| Shown::new(found, None).next.join("; ");
        let everywhere = next(&seen_in(|_, _| true));
        assert_eq!(everywhere, "take 19 more images");
        let no_right = next(&seen_in(|row, column| column < 6 || !(2..4).contains(&row)));
        assert!(no_right.contains("at the right edge of the image"), "{no_right}");
        let corner = next(&seen_in(|row, column| row < 4 || column > 1));
        assert!(corner.contains("in the lower left corner"), "{corner}");
    }

    #[test]
    fn one_view_is_named_in_the_singular() {
        let line = |found: &FoundImages| Shown::new(found, None).line();
        let mut found = seen_in(|_, _| true);
        assert!(line(&found).starts_with("1 view, "), "{}", line(&found));
        found.views.extend(found.views.clone());
        assert!(line(&found).starts_with("2 views, "), "{}", line(&found));
    }

    #[test]
    fn points_at_the_edges_of_the_image_are_counted_in_its_last_parts() {
        let mut found = seen_in(|_, _| false);
        for (x, y) in [(-0.5, -0.5), (799.5, 599.5), (-30.0, 900.0)] {
            let seen = Pixel::new(x, y);
            found.views[0].points.push(Sighting { tag: 0, place_m: [0.0; 2], seen });
        }
        let counts = Shown::new(&found, None).point_counts;
        assert_eq!((counts[0][0], counts[ROWS - 1][COLUMNS - 1], counts[ROWS - 1][0]), (1, 1, 1));
    }
}
