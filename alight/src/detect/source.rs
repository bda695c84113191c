//! The pictures of files, folders and videos, one after the other.

use std::path::{Path, PathBuf};

use imaging::{BayerPattern, GrayImage};
use media::{
    DEFAULT_MAX_PIXELS, IMAGE_EXTENSIONS, VIDEO_EXTENSIONS, Video, VideoImage, files_in, is_video,
    read_image,
};

/// Between the images of a folder, in seconds, for want of anything better.
const IMAGE_PERIOD_S: f64 = 0.1;

/// Goes through files, folders and videos.
pub(super) struct Source {
    listed: std::vec::IntoIter<Result<PathBuf, (PathBuf, String)>>,
    video: Option<(PathBuf, Video)>,
    images: u32,
}

/// Something to look at, decoded or not yet.
pub(super) struct Item {
    /// What it is called: a path, for a frame of a video with its number.
    pub(super) name: String,
    /// When it was taken, in seconds after the first.
    pub(super) time_s: f64,
    /// True for a frame of a video.
    pub(super) is_frame: bool,
    content: Content,
}

enum Content {
    File(PathBuf),
    Frame(PathBuf, VideoImage),
    /// Why there is nothing.
    Nothing(String),
}

impl Source {
    /// All that some paths name.
    pub(super) fn new(paths: &[PathBuf]) -> Self {
        let mut listed = Vec::new();
        for path in paths {
            match files_in(path, &[IMAGE_EXTENSIONS, VIDEO_EXTENSIONS]) {
                Ok(files) => listed.extend(files.into_iter().map(Ok)),
                Err(problem) => listed.push(Err((path.clone(), problem.to_string()))),
            }
        }
        Self { listed: listed.into_iter(), video: None, images: 0 }
    }

    /// The next picture; frames of a video are decoded here as far as one depends on another.
    pub(super) fn next(&mut self) -> Option<Item> {
        if let Some((path, video)) = &mut self.video {
            match video.next_frame() {
                Some(Ok(frame)) => {
                    let name = format!("{}#{}", path.display(), frame.index);
                    let content = Content::Frame(path.clone(), frame.image);
                    return Some(Item { name, time_s: frame.time_s, is_frame: true, content });
                }
                Some(Err(problem)) => return Some(Item::nothing(path, problem.to_string())),
                None => self.video = None,
            }
        }
        let path = match self.listed.next()? {
            Ok(path) => path,
            Err((path, problem)) => return Some(Item::nothing(&path, problem)),
        };
        if is_video(&path) {
            match Video::open(&path, DEFAULT_MAX_PIXELS) {
                Ok(video) => {
                    self.video = Some((path, video));
                    return self.next();
                }
                Err(problem) => return Some(Item::nothing(&path, problem.to_string())),
            }
        }
        let time_s = f64::from(self.images) * IMAGE_PERIOD_S;
        self.images = self.images.saturating_add(1);
        let name = path.display().to_string();
        Some(Item { name, time_s, is_frame: false, content: Content::File(path) })
    }
}

impl Item {
    fn nothing(path: &Path, problem: String) -> Self {
        let name = path.display().to_string();
        Self { name, time_s: 0.0, is_frame: false, content: Content::Nothing(problem) }
    }

    /// The picture in grey, or why there is none.
    pub(super) fn into_image(self, bayer: Option<BayerPattern>) -> Result<GrayImage, String> {
        let image = match self.content {
            Content::File(path) => read_image(&path, DEFAULT_MAX_PIXELS, bayer),
            Content::Frame(path, image) => image.grey(&path, DEFAULT_MAX_PIXELS),
            Content::Nothing(problem) => return Err(problem),
        };
        image.map_err(|problem| problem.to_string())
    }
}
