//! Applies the colour filters of a sensor, and computes grey from the filtered light.

use super::filters::{beside, three_rows};

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
    let [even, odd] = [0, 1].map(|x| FILTERS[colour(x, v)]);
    for pair in light.chunks_mut(2) {
        for (level, transmission) in pair.iter_mut().zip([even, odd]) {
            *level *= transmission;
        }
    }
}

/// Balances a mosaic, of which `padded` has one pixel more on each side, and interpolates its grey
/// bilinearly.
pub(super) fn interpolate(padded: &[f32], width: usize, grey: &mut [f32]) {
    // A colour's light behind its white balance, with its weight in grey.
    let part = |colour: usize| {
        let balance = 1.0 / FILTERS[colour];
        move |light: f32| GREY[colour] * (light * balance).min(255.0)
    };
    let green = part(1);
    for (v, row) in grey.chunks_exact_mut(width.max(1)).enumerate() {
        let Some(rows) = three_rows(padded, width, v) else { continue };
        let [[a, b, c], [d, e, f], [g, h, i]] = rows.map(beside);
        // Every other pixel of a row is red, or blue in odd rows; those between are green, with that colour next to them
        // and the third one above and below.
        let first = v % 2;
        let (own, other) = if first == 0 { (part(0), part(2)) } else { (part(2), part(0)) };
        let up = a.iter().zip(b).zip(c);
        let level = d.iter().zip(e).zip(f);
        let down = g.iter().zip(h).zip(i);
        for (x, (((grey, ((a, b), c)), ((d, e), f)), ((g, h), i))) in
            row.iter_mut().zip(up).zip(level).zip(down).enumerate()
        {
            let (sides, ends) = ((d + f) / 2.0, (b + h) / 2.0);
            let coloured = own(*e) + green((sides + ends) / 2.0) + other((a + c + g + i) / 4.0);
            let between = own(sides) + green(*e) + other(ends);
            *grey = if x % 2 == first { coloured } else { between };
        }
    }
}
