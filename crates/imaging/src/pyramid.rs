//! Builds the image pyramid: the image at half, a quarter, an eighth ... of its size.

use crate::kernels::halve_rows;
use crate::view::{GrayImage, GrayView};

/// Level 0 is the image itself, each further level has the means of 2 x 2 pixels of the level before. An odd
/// last row or column is dropped.
#[derive(Clone, Debug, Default)]
pub struct Pyramid {
    halved: Vec<GrayImage>,
    levels: usize,
}

impl Pyramid {
    /// Builds up to `levels` levels of an image, level 0 included. None has an edge shorter than
    /// `min_edge_px`. Level 0 is not copied.
    pub fn build(&mut self, view: GrayView<'_>, levels: usize, min_edge_px: usize) {
        self.levels = 1;
        let fits = |edge: usize| edge / 2 >= min_edge_px.max(1);
        let (mut width, mut height) = (view.width(), view.height());
        while self.levels < levels && fits(width) && fits(height) {
            (width, height) = (width / 2, height / 2);
            if self.halved.len() < self.levels {
                self.halved.push(GrayImage::default());
            }
            let (finer, coarser) = self.halved.split_at_mut(self.levels - 1);
            let finer = finer.last().map_or(Some(view), GrayImage::view);
            if let (Some(finer), Some(out)) = (finer, coarser.first_mut()) {
                halve(finer, out);
            }
            self.levels += 1;
        }
    }

    /// Number of levels, level 0 included.
    pub fn levels(&self) -> usize {
        self.levels
    }

    /// A level; `view` is the image of which the pyramid was built.
    pub fn level<'a>(&'a self, view: GrayView<'a>, level: usize) -> Option<GrayView<'a>> {
        match level {
            0 => Some(view),
            _ if level < self.levels => self.halved.get(level - 1)?.view(),
            _ => None,
        }
    }
}

/// From a level's coordinate to the image's, along one axis: the centre of a pixel on level l is that of 2^l
/// pixels.
#[inline]
pub fn to_level_0(place: f64, level: usize) -> f64 {
    let pixels = (1_u64 << level.min(32)) as f64;
    (place + 0.5) * pixels - 0.5
}

/// From the image's coordinate to a level's, along one axis.
#[inline]
pub fn from_level_0(place: f64, level: usize) -> f64 {
    let pixels = (1_u64 << level.min(32)) as f64;
    (place + 0.5) / pixels - 0.5
}

/// Rounded means of 2 x 2 pixels.
fn halve(view: GrayView<'_>, out: &mut GrayImage) {
    out.resize(view.width() / 2, view.height() / 2);
    for y in 0..view.height() / 2 {
        halve_rows(view.row(2 * y), view.row(2 * y + 1), out.row_mut(y));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_level_has_the_means_of_the_one_before() {
        let data: Vec<u8> = (0..150 * 90).map(|i| (i * 31 % 256) as u8).collect();
        let view = GrayView::packed(&data, 150, 90).unwrap();
        let mut pyramid = Pyramid::default();
        pyramid.build(view, 8, 10);
        let size = |l| pyramid.level(view, l).map(|v| (v.width(), v.height()));
        assert_eq!(
            (0..5).map(size).collect::<Vec<_>>(),
            [Some((150, 90)), Some((75, 45)), Some((37, 22)), Some((18, 11)), None]
        );
        let (fine, coarse) = (pyramid.level(view, 1).unwrap(), pyramid.level(view, 2).unwrap());
        let four = [(20, 8), (21, 8), (20, 9), (21, 9)].map(|(x, y)| u32::from(fine.at(x, y)));
        assert_eq!(u32::from(coarse.at(10, 4)), (four.iter().sum::<u32>() + 2) / 4);
        // A smaller image afterwards has fewer levels.
        pyramid.build(GrayView::packed(&data, 25, 25).unwrap(), 8, 10);
        assert_eq!(pyramid.levels(), 2);
    }

    #[test]
    fn coordinates_map_to_level_0_and_back() {
        assert_eq!(to_level_0(0.0, 1), 0.5);
        assert_eq!(to_level_0(1.0, 2), 5.5);
        assert_eq!(from_level_0(to_level_0(7.25, 3), 3), 7.25);
    }
}
