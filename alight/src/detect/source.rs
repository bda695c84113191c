//! The images of files, folders and videos, in order.

use std::path::{Path, PathBuf};

use imaging::{BayerPattern, GrayImage};
use media::{
    DEFAULT_MAX_PIXELS, IMAGE_EXTENSIONS, VIDEO_EXTENSIONS, Video, VideoImage, files_in, is_video,
    read_image,
};

/// Assumed interval between image files, in seconds.
const IMAGE_PERIOD_S: f64 = 0.1;

/// Iterates over files, folders and videos.
pub(crate) struct Source {
    listed: std::vec::IntoIter<Result<PathBuf, (PathBuf, String)>>,
    video: Option<(PathBuf, Video)>,
    images: u32,
}

/// An image, decoded or not yet.
pub(crate) struct Item {
    /// Its name: a path, for a video frame with its number.
    pub(crate) name: String,
    /// Its time, in seconds after the first image.
    pub(crate) time_s: f64,
    /// Whether it is a frame of a video.
    pub(crate) is_frame: bool,
    content: Content,
}

enum Content {
    File(PathBuf),
    Frame(PathBuf, VideoImage),
    /// The reason why it cannot be read.
    Unreadable(String),
}

impl Source {
    /// The images of some paths.
    pub(crate) fn new(paths: &[PathBuf]) -> Self {
        let mut listed = Vec::new();
        for path in paths {
            match files_in(path, &[IMAGE_EXTENSIONS, VIDEO_EXTENSIONS]) {
                Ok(files) => listed.extend(files.into_iter().map(Ok)),
                Err(problem) => listed.push(Err((path.clone(), problem.to_string()))),
            }
        }
        Self { listed: listed.into_iter(), video: None, images: 0 }
    }

    /// The files that are still to be read.
    pub(crate) fn files(&self) -> impl Iterator<Item = &Path> {
        self.listed
            .as_slice()
            .iter()
            .filter_map(|listed| listed.as_ref().ok().map(PathBuf::as_path))
    }

    /// The next image; frames of a video are decoded here as far as they depend on each other.
    pub(crate) fn next(&mut self) -> Option<Item> {
        if let Some((path, video)) = &mut self.video {
            match video.next_frame() {
                Some(Ok(frame)) => {
                    let name = format!("{}#{}", path.display(), frame.index);
                    let content = Content::Frame(path.clone(), frame.image);
                    return Some(Item { name, time_s: frame.time_s, is_frame: true, content });
                }
                Some(Err(problem)) => return Some(Item::unreadable(path, problem.to_string())),
                None => self.video = None,
            }
        }
        let path = match self.listed.next()? {
            Ok(path) => path,
            Err((path, problem)) => return Some(Item::unreadable(&path, problem)),
        };
        if is_video(&path) {
            match Video::open(&path, DEFAULT_MAX_PIXELS) {
                Ok(video) => {
                    self.video = Some((path, video));
                    return self.next();
                }
                Err(problem) => return Some(Item::unreadable(&path, problem.to_string())),
            }
        }
        let time_s = f64::from(self.images) * IMAGE_PERIOD_S;
        self.images = self.images.saturating_add(1);
        let name = path.display().to_string();
        Some(Item { name, time_s, is_frame: false, content: Content::File(path) })
    }
}

impl Item {
    fn unreadable(path: &Path, problem: String) -> Self {
        let name = path.display().to_string();
        Self { name, time_s: 0.0, is_frame: false, content: Content::Unreadable(problem) }
    }

    /// The grey image, or the reason why there is none.
    pub(crate) fn into_image(self, bayer: Option<BayerPattern>) -> Result<GrayImage, String> {
        let image = match self.content {
            Content::File(path) => read_image(&path, DEFAULT_MAX_PIXELS, bayer),
            Content::Frame(path, image) => image.grey(&path, DEFAULT_MAX_PIXELS),
            Content::Unreadable(problem) => return Err(problem),
        };
        image.map_err(|problem| problem.to_string())
    }
}
