//! Checks the centre of a marker, which distinguishes it from targets: rings of equal width, as targets are often drawn, are
//! nearly as far apart as the marker's, but have something else where the marker has its dot.

use imaging::bilinear;

use super::circle_pose::{CirclePose, project};
use super::edges::{EdgeSearch, SATURATED};

/// Diameters in pixels at which the dot decides: below it is too faint, above the rings' radii are exact enough.
const DIAMETERS_PX: std::ops::Range<f64> = 24.0..120.0;
/// Radii of the dot, in marker sizes.
const DOT: [f64; 2] = [0.01, 0.03];
/// Standard deviation of the blur of a lens in focus and the pixels, in pixels.
const BLUR_PX: f64 = 0.8;
/// Minimum depth of the dot as a fraction of a sharp image's. Out of focus it is a quarter; a white middle has none.
const MIN_DEPTH: f64 = 0.15;

impl EdgeSearch<'_> {
    /// Whether the middle is in the image. Rings without it are a target's as well as the marker's.
    pub(super) fn shows_middle(&self, pose: &CirclePose) -> bool {
        project(pose.centre, self.camera).is_some_and(|at| self.camera.contains(at))
    }

    /// Whether the middle is plain to see and not the marker's: white, or a disc much wider than the dot.
    pub(super) fn is_target(&self, pose: &CirclePose) -> bool {
        self.has_other_middle(pose).unwrap_or(false)
    }

    fn has_other_middle(&self, pose: &CirclePose) -> Option<bool> {
        let diameter_px = pose.projected(self.size_m / 2.0, self.camera)?.minor;
        if !DIAMETERS_PX.contains(&diameter_px) {
            return Some(false);
        }
        let [outer, gap, middle] = [0.45, 0.325, 0.2].map(|radius| self.on_circle(pose, radius));
        let black = 0.5 * (outer?.median + middle?.median);
        let contrast = gap?.median - black;
        let whiteness = |grey: f64| (grey - black) / contrast;
        let beside = self.on_circle(pose, 0.085)?.median;
        if beside.abs() >= SATURATED {
            return Some(false);
        }
        let [centre, ring] = [0.0, 0.02].map(|radius| self.on_circle(pose, radius));
        let depth = whiteness(beside) - whiteness(centre?.median.min(ring?.median));
        let fading = |radius: f64| (-0.5 * (radius * diameter_px / BLUR_PX).powi(2)).exp();
        let expected = (fading(DOT[0]) - fading(DOT[1])).max(0.3);
        let is_white = whiteness(beside) > 0.6 && depth < MIN_DEPTH * expected;
        // A leaf on the middle covers more on one side.
        let [within, around] = [0.07, 0.12].map(|radius| self.on_circle(pose, radius));
        let is_wide = whiteness(around?.quartile) > 0.45 && whiteness(within?.upper_quartile) < 0.4;
        Some(is_white || is_wide)
    }

    /// The grey values on a circle of this radius (in marker sizes), of a marker in white on black with the sign changed;
    /// `None` where half of it is outside the image.
    fn on_circle(&self, pose: &CirclePose, radius: f64) -> Option<CircleValues> {
        let (u, v) = pose.basis();
        let mut values = [0.0; PLACES];
        let mut count = 0;
        for i in 0..PLACES {
            let (sin, cos) = (i as f64 * std::f64::consts::TAU / PLACES as f64).sin_cos();
            let place = pose.centre + (u * cos + v * sin) * (radius * self.size_m);
            let at = project(place, self.camera)?;
            if let Some((value, grey)) = values.get_mut(count).zip(bilinear(self.view, at.x, at.y))
            {
                *value = if self.white_on_black { -grey } else { grey };
                count += 1;
            }
        }
        let seen = values.get_mut(..count).filter(|seen| 2 * seen.len() >= PLACES)?;
        seen.sort_unstable_by(f64::total_cmp);
        let at = |part: f64| seen[((count - 1) as f64 * part).round() as usize];
        Some(CircleValues { quartile: at(0.25), median: at(0.5), upper_quartile: at(0.75) })
    }
}

/// Number of places on a circle.
const PLACES: usize = 16;

/// Grey values on a circle.
#[derive(Copy, Clone)]
struct CircleValues {
    quartile: f64,
    median: f64,
    upper_quartile: f64,
}
