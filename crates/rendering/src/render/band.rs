//! Combines a row of tiles into pixels: how much paint covers the ground, and its light.

use super::painter::Channels;
use super::painting::Paint;

/// A row of tiles.
#[derive(Debug)]
pub(super) struct Band {
    pub(super) tiles: Vec<TileState>,
    pub(super) paint: Channels,
    pub(super) light: Vec<f32>,
}

#[derive(Copy, Clone, Debug, PartialEq)]
pub(super) enum TileState {
    /// No paint.
    Bare,
    /// Some paint.
    Mixed,
    /// Paint that hides the ground everywhere.
    Covered,
}

impl Band {
    /// Lays one paint over a tile.
    pub(super) fn lay_evenly(&mut self, column: usize, tile: usize, paint: Paint) {
        let Some(state) = self.tiles.get_mut(column) else { return };
        let range = column * tile * tile..(column + 1) * tile * tile;
        let (Some(cover), Some(light)) =
            (self.paint.cover.get_mut(range.clone()), self.paint.light.get_mut(range))
        else {
            return;
        };
        if paint.cover == 1.0 || *state == TileState::Bare {
            cover.fill(paint.cover);
            light.fill(paint.light);
        } else {
            cover.iter_mut().for_each(|c| *c = *c * (1.0 - paint.cover) + paint.cover);
            light.iter_mut().for_each(|l| *l = *l * (1.0 - paint.cover) + paint.light);
        }
        *state = if paint.cover == 1.0 { TileState::Covered } else { TileState::Mixed };
    }

    /// Lays a painted tile over the present light.
    pub(super) fn lay(&mut self, column: usize, tile: usize, paint: &Channels) {
        let Some(state) = self.tiles.get_mut(column) else { return };
        let range = column * tile * tile..(column + 1) * tile * tile;
        let (Some(cover), Some(light)) =
            (self.paint.cover.get_mut(range.clone()), self.paint.light.get_mut(range))
        else {
            return;
        };
        if *state == TileState::Bare {
            cover.copy_from_slice(&paint.cover);
            light.copy_from_slice(&paint.light);
        } else {
            let below = cover.iter_mut().zip(light.iter_mut());
            for ((c, l), (own_c, own_l)) in below.zip(paint.cover.iter().zip(&paint.light)) {
                *l = *l * (1.0 - own_c) + own_l;
                *c = *c * (1.0 - own_c) + own_c;
            }
        }
        if *state != TileState::Covered {
            *state = TileState::Mixed;
        }
    }
}
