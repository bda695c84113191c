//! Adapts the brightness locally.

use super::LocalTone;

/// Light below which nothing is brightened further, in grey levels.
const BLACK_LEVELS: f32 = 2.0;

/// Multiplies each pixel by a gain that grows where the neighbourhood is darker than the frame.
pub(super) fn adapt(local: &LocalTone, light: &mut [f32], width: usize) {
    let height = light.len() / width.max(1);
    let cell = ((local.neighbourhood * width as f32 / 2.0) as usize).max(1);
    let (columns, rows) = (width.div_ceil(cell), height.div_ceil(cell));
    if columns == 0 || rows == 0 {
        return;
    }
    let mut sums = vec![0.0f32; columns * rows];
    let mut counts = vec![0.0f32; columns * rows];
    for (v, row) in light.chunks(width).enumerate() {
        for (u, part) in row.chunks(cell).enumerate() {
            let index = v / cell * columns + u;
            sums[index] += part.iter().sum::<f32>();
            counts[index] += part.len() as f32;
        }
    }
    let logs: Vec<f32> =
        sums.iter().zip(&counts).map(|(sum, n)| (sum / n).max(BLACK_LEVELS).ln()).collect();
    let mean = logs.iter().sum::<f32>() / logs.len() as f32;
    let max_log = local.max_gain.ln();
    let gains: Vec<f32> =
        logs.iter().map(|log| (local.strength * (mean - log)).clamp(-max_log, max_log)).collect();
    // The gain's logarithm between the centres of cells is bilinear.
    let around = |place: usize, count: usize| {
        let at = ((place as f32 + 0.5) / cell as f32 - 0.5).clamp(0.0, (count - 1) as f32);
        let low = (at as usize).min(count - 1);
        (low, (low + 1).min(count - 1), at - low as f32)
    };
    let across: Vec<_> = (0..width).map(|x| around(x, columns)).collect();
    let mut line = vec![0.0f32; columns];
    for (v, row) in light.chunks_mut(width).enumerate() {
        let (top, bottom, part) = around(v, rows);
        for (u, gain) in line.iter_mut().enumerate() {
            let (above, below) = (gains[top * columns + u], gains[bottom * columns + u]);
            *gain = above + (below - above) * part;
        }
        for (level, (left, right, part)) in row.iter_mut().zip(&across) {
            *level *= (line[*left] + (line[*right] - line[*left]) * part).exp();
        }
    }
}
