//! Finds the tags of the calibration board in images and in frames of a camera, leaves out those in which it has not moved or
//! is shaken, and looks again once the lens is known.

use std::collections::VecDeque;

use anyhow::{Context, ensure};
use calibration::{ImageSize, Sighting, View};
use fiducial::{Detector, Settings};
use geometry::{CameraModel, Pixel};
use imaging::GrayImage;
use indicatif::{ProgressBar, ProgressStyle};
use markers::Board;

use super::args::BoardArgs;
use super::sharpness::edge_width_px;
use crate::args::Format;
use crate::detect::{Item, Source};
use crate::terminal::write_error;

/// Pixels of all images that are kept to be looked at again: a gigabyte of memory.
const MAX_KEPT_PIXELS: usize = 1 << 30;
/// Images whose board is looked at; of a longer video the rest adds no information.
const MAX_VIEWS: usize = 400;
/// Motion of the board between two frames of a video that are taken, as a fraction of the image's width.
const MIN_MOVE: f64 = 0.03;
/// Maximum motion of the board between two frames of a running camera in which it is held still, as a fraction of the image's width.
const MAX_SHAKE: f64 = 0.005;
/// Corners whose standard deviation is larger are not used where the lens is known, in pixels: those at a fisheye's rim that
/// could not be refined are a pixel off, and not by chance. Refined ones are known to some hundredths.
const MAX_CORNER_PX: f64 = 0.15;
/// Maximum number of images that are searched again mirrored, if none shows the board, and the maximum of their pixels.
const MIRRORED_IMAGES: usize = 8;
const MAX_MIRRORED_PIXELS: usize = 1 << 27;
/// An image whose outlines are wider than this is blurred, in pixels.
pub(super) const BLURRED_PX: f64 = 5.0;

/// The images that were looked at.
#[derive(Debug, Default)]
pub(super) struct FoundImages {
    /// The views of the images that show the board.
    pub(super) views: Vec<View>,
    /// Those images, to be looked at again.
    kept: Vec<GrayImage>,
    /// The width of the tags' outlines in each of them, where it can be measured.
    pub(super) edges: Vec<EdgeWidth>,
    /// Number of images that were searched.
    pub(super) images: usize,
    /// Those without the board.
    pub(super) empty: Vec<String>,
    /// The last images, the newest first, as long as no image shows the board.
    last_empty: VecDeque<(String, GrayImage)>,
    /// An image that shows the board after it is mirrored, if no image shows it as it is.
    pub(super) mirrored: Option<String>,
    /// Those that could not be read, with the reason.
    pub(super) unreadable: Vec<String>,
    /// Frames in which the board had not moved.
    pub(super) unmoved: usize,
    /// Frames of a running camera in which the board was not held still.
    pub(super) shaken: usize,
    /// The view in the previous frame.
    last: Option<View>,
    /// Whether there were more than can be kept.
    pub(super) is_full: bool,
}

/// How wide an image's outlines are.
#[derive(Debug)]
pub(super) struct EdgeWidth {
    pub(super) name: String,
    pub(super) width_px: f64,
}

/// Looks for the board in images.
pub(super) struct Finder<'a> {
    board: &'a Board,
    detector: Detector,
}

/// An image.
pub(super) struct Picture {
    pub(super) name: String,
    pub(super) image: GrayImage,
    pub(super) origin: Origin,
}

/// Where an image comes from.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Origin {
    /// Taken on purpose: all of them are used.
    File,
    /// Of a video: those in which the board has moved are used.
    Video,
    /// Of a running camera: of those the ones in which the board is held still, as the user sees which views are missing.
    Live,
}

/// The tags of the board in an image.
struct Seen {
    view: View,
    edge_px: Option<f64>,
    /// Whether tags were left out, as their corners are not known well enough.
    has_unsure: bool,
}

impl<'a> Finder<'a> {
    pub(super) fn new(board: &'a Board) -> anyhow::Result<Self> {
        Ok(Self { board, detector: Detector::new(&board.markers(), Settings::default())? })
    }

    /// With the lens known, the tags' edges are followed where it bends them.
    fn look_at(
        &mut self,
        image: &GrayImage,
        name: &str,
        camera: Option<&CameraModel>,
    ) -> anyhow::Result<Seen> {
        let grey = image.view().context("the image has no pixels")?;
        let mut points = Vec::new();
        let mut widths = Vec::new();
        let mut has_unsure = false;
        for tag in self.detector.detect(grey, camera, &mut ()) {
            let (Some(id), Some(corners)) = (tag.id, tag.corners) else { continue };
            let Some(places_m) = self.board.corners_m(tag.family, id) else { continue };
            // A tag with wrong bits may be another one; the board has tags enough.
            if tag.wrong_bits > 1 {
                continue;
            }
            // Of four corners that are equally sure the centre has half of the deviation.
            let corner_px = (2.0 * tag.centre_covariance_px2.trace()).sqrt();
            if camera.is_some() && corner_px > MAX_CORNER_PX {
                has_unsure = true;
                continue;
            }
            widths.extend(edge_width_px(grey, &corners));
            let sighting = |(place_m, seen): ([f64; 2], Pixel)| Sighting { tag: id, place_m, seen };
            points.extend(places_m.into_iter().zip(corners).map(sighting));
        }
        widths.sort_by(f64::total_cmp);
        let size = ImageSize { width: image.width() as u32, height: image.height() as u32 };
        let edge_px = widths.get(widths.len() / 2).copied();
        Ok(Seen { view: View { name: name.to_owned(), size, points }, edge_px, has_unsure })
    }
}

impl FoundImages {
    /// Looks at an image, and takes it if it shows the board as it should.
    pub(super) fn add(&mut self, finder: &mut Finder<'_>, picture: Picture) {
        let Picture { name, image, origin } = picture;
        self.images += 1;
        let Seen { view, edge_px, .. } = match finder.look_at(&image, &name, None) {
            Ok(seen) => seen,
            Err(problem) => return self.unreadable.push(format!("{name}: {problem:#}")),
        };
        let before = self.last.replace(view.clone());
        if view.points.is_empty() {
            // A stream without the board would fill the list with every frame.
            if origin == Origin::File {
                self.empty.push(name.clone());
            }
            if self.views.is_empty() {
                self.last_empty.truncate(MIRRORED_IMAGES - 1);
                self.last_empty.push_front((name, image));
                let pixels = |(_, image): &(String, GrayImage)| image.width() * image.height();
                while self.last_empty.len() > 1
                    && self.last_empty.iter().map(pixels).sum::<usize>() > MAX_MIRRORED_PIXELS
                {
                    self.last_empty.pop_back();
                }
            }
        } else if origin == Origin::Live && !is_still(&view, before.as_ref(), edge_px) {
            self.shaken += 1;
        } else if origin != Origin::File && !has_moved(&view, &self.views) {
            self.unmoved += 1;
        } else {
            self.last_empty.clear();
            self.views.push(view);
            self.kept.push(image);
            self.edges.extend(edge_px.map(|width_px| EdgeWidth { name, width_px }));
        }
        let pixels: usize = self.kept.iter().map(|image| image.width() * image.height()).sum();
        self.is_full = self.views.len() >= MAX_VIEWS || pixels >= MAX_KEPT_PIXELS;
    }

    /// Looks for the board in mirrored images, if no image shows it as it is: the code of a mirrored tag is not valid.
    pub(super) fn look_mirrored(&mut self, finder: &mut Finder<'_>) {
        let mut shows_board = |name: &str, image: &GrayImage| {
            let seen = finder.look_at(&mirrored(image), name, None);
            seen.is_ok_and(|seen| !seen.view.points.is_empty())
        };
        let mut empty = self.last_empty.drain(..);
        self.mirrored = empty.find_map(|(name, image)| shows_board(&name, &image).then_some(name));
    }

    /// Looks at the same images again, with the lens as it was found from the first look: it bends the edges of near tags, and
    /// corners between edges taken to be straight lie too far out.
    pub(super) fn look_again(&mut self, finder: &mut Finder<'_>, camera: &CameraModel) {
        let mut looked_at = Vec::new();
        for (mut view, image) in self.views.drain(..).zip(self.kept.drain(..)) {
            let is_its_size = (view.size.width, view.size.height) == (camera.width, camera.height);
            if is_its_size && let Ok(seen) = finder.look_at(&image, &view.name, Some(camera)) {
                if !seen.view.points.is_empty() {
                    view = seen.view;
                } else if seen.has_unsure {
                    // The result of the first search is as uncertain.
                    continue;
                }
            }
            looked_at.push((view, image));
        }
        (self.views, self.kept) = looked_at.into_iter().unzip();
    }
}

/// Looks for the board in the files.
///
/// # Errors
/// When no file could be read.
pub(super) fn find_boards(
    finder: &mut Finder<'_>,
    args: &BoardArgs,
) -> anyhow::Result<FoundImages> {
    let mut found = FoundImages::default();
    let bar = match args.format {
        Format::Text => ProgressBar::no_length(),
        Format::Json => ProgressBar::hidden(),
    };
    bar.set_style(
        ProgressStyle::with_template("{spinner} {pos} images, {elapsed} {msg}")
            .unwrap_or_else(|_| ProgressStyle::default_spinner()),
    );
    if let Some(note) = Source::note_of_others(&args.images) {
        write_error(&note);
    }
    let mut source = Source::new(&args.images);
    while !found.is_full
        && let Some(item) = source.next()
    {
        add_item(&mut found, finder, item, args);
        bar.set_message(format!("{} with the board", found.views.len()));
        bar.inc(1);
    }
    bar.finish_and_clear();
    let first = found.unreadable.first().map_or("", String::as_str);
    ensure!(
        found.unreadable.len() < found.images || found.images == 0,
        "no image could be read: {first}"
    );
    ensure!(found.images > 0, "there are no images in {:?}", args.images);
    Ok(found)
}

fn add_item(found: &mut FoundImages, finder: &mut Finder<'_>, item: Item, args: &BoardArgs) {
    let (name, is_frame) = (item.name.clone(), item.is_frame);
    match item.into_image(args.bayer) {
        Ok(still) => {
            let image = still.grey;
            let origin = if is_frame { Origin::Video } else { Origin::File };
            found.add(finder, Picture { name, image, origin });
        }
        Err(problem) => {
            found.images += 1;
            found.unreadable.push(problem);
        }
    }
}

/// The image with left and right exchanged.
fn mirrored(image: &GrayImage) -> GrayImage {
    let mut mirrored = GrayImage::filled(image.width(), image.height(), 0);
    for (y, row) in image.pixels().chunks_exact(image.width().max(1)).enumerate() {
        let target = mirrored.row_mut(y);
        target.copy_from_slice(row);
        target.reverse();
    }
    mirrored
}

/// Whether the board lies elsewhere than in the views so far.
fn has_moved(view: &View, others: &[View]) -> bool {
    let min_px = MIN_MOVE * f64::from(view.size.width);
    others.iter().all(|other| motion_px(view, other).is_none_or(|motion| motion >= min_px))
}

/// Whether it lies where it lay in the frame before, and its outlines are sharp.
fn is_still(view: &View, before: Option<&View>, edge_px: Option<f64>) -> bool {
    let max_px = MAX_SHAKE * f64::from(view.size.width);
    let motion = before.and_then(|before| motion_px(view, before));
    motion.is_some_and(|motion| motion <= max_px) && edge_px.is_none_or(|px| px <= BLURRED_PX)
}

/// The mean distance of the corners that both show; `None` where they share none.
fn motion_px(view: &View, other: &View) -> Option<f64> {
    let [mut sum_px, mut count] = [0.0, 0.0];
    for point in &view.points {
        let is_same = |p: &&Sighting| p.tag == point.tag && p.place_m == point.place_m;
        if let Some(same) = other.points.iter().find(is_same) {
            sum_px += same.seen.distance(&point.seen);
            count += 1.0;
        }
    }
    (count > 0.0).then(|| sum_px / count)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(right_px: f64) -> View {
        let seen = Pixel::new(100.0 + right_px, 100.0);
        View {
            name: String::new(),
            size: ImageSize { width: 1000, height: 800 },
            points: vec![Sighting { tag: 1, place_m: [0.0; 2], seen }],
        }
    }

    #[test]
    fn images_without_the_board_that_are_kept_are_few_and_small() {
        let board = Board::A4;
        let mut finder = Finder::new(&board).unwrap();
        for (size, kept) in [([64, 48], MIRRORED_IMAGES), ([10_000, 6_000], 2)] {
            let mut found = FoundImages::default();
            for index in 0..MIRRORED_IMAGES + 2 {
                let image = GrayImage::filled(size[0], size[1], 200);
                let name = index.to_string();
                found.add(&mut finder, Picture { name, image, origin: Origin::File });
            }
            assert_eq!(found.last_empty.len(), kept, "{size:?}");
            assert_eq!(found.last_empty[0].0, (MIRRORED_IMAGES + 1).to_string());
        }
    }

    #[test]
    fn a_stationary_board_is_taken_once() {
        assert!(has_moved(&view(0.0), &[]));
        assert!(!has_moved(&view(10.0), &[view(0.0)]));
        assert!(has_moved(&view(40.0), &[view(0.0)]));
        assert!(!has_moved(&view(0.0), &[view(0.0), view(40.0)]));
    }

    #[test]
    fn a_board_is_held_still_when_it_is_where_it_was_and_sharp() {
        assert!(is_still(&view(3.0), Some(&view(0.0)), Some(2.0)));
        assert!(!is_still(&view(9.0), Some(&view(0.0)), Some(2.0)));
        assert!(!is_still(&view(0.0), None, Some(2.0)));
        assert!(!is_still(&view(0.0), Some(&view(0.0)), Some(2.0 * BLURRED_PX)));
    }
}
