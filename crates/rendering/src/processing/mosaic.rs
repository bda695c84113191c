//! The colour filters of a sensor, and grey from what they let through.

/// Transmission of white light by the red, green and blue filters, before white balance.
const FILTERS: [f32; 3] = [0.6, 1.0, 0.75];

/// Weights of red, green and blue in grey (Rec. ITU-R BT.601).
const GREY: [f32; 3] = [0.299, 0.587, 0.114];

/// The colour of a pixel of an RGGB mosaic: red, green or blue (0, 1, 2).
fn colour(x: usize, y: usize) -> usize {
    match (x % 2, y % 2) {
        (0, 0) => 0,
        (1, 1) => 2,
        _ => 1,
    }
}

/// The light of row `v` behind the filters.
pub(crate) fn filter(v: usize, light: &mut [f32]) {
    for (x, level) in light.iter_mut().enumerate() {
        *level *= FILTERS[colour(x, v)];
    }
}

/// Balances a mosaic, of which `padded` has one pixel more on each side, and interpolates its grey
/// bilinearly.
pub(super) fn interpolate(padded: &[f32], width: usize, grey: &mut [f32]) {
    let stride = width + 2;
    for (v, row) in grey.chunks_mut(width.max(1)).enumerate() {
        let rows = [0, 1, 2].map(|i| padded.get((v + i) * stride..).unwrap_or(&[]));
        let [above, own, below] = rows;
        let places = above.windows(3).zip(own.windows(3)).zip(below.windows(3));
        for ((x, level), ((a, o), b)) in row.iter_mut().enumerate().zip(places) {
            let at = colour(x, v);
            let (sides, ends) = ((o[0] + o[2]) / 2.0, (a[1] + b[1]) / 2.0);
            let cross = (sides + ends) / 2.0;
            let diagonal = (a[0] + a[2] + b[0] + b[2]) / 4.0;
            let colours = match at {
                0 => [o[1], cross, diagonal],
                2 => [diagonal, cross, o[1]],
                _ if v % 2 == 0 => [sides, o[1], ends],
                _ => [ends, o[1], sides],
            };
            *level = (0..3).map(|c| GREY[c] * (colours[c] / FILTERS[c]).min(255.0)).sum();
        }
    }
}
