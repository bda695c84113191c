//! Iterates over the images of files, folders and videos, in order.

use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use imaging::BayerPattern;
use media::{
    DEFAULT_MAX_PIXELS, IMAGE_EXTENSIONS, OTHER_IMAGE_EXTENSIONS, StillImage, VIDEO_EXTENSIONS,
    Video, VideoImage, files_in, is_video, max_file_bytes, read_image, read_image_bytes,
};

/// Assumed interval between image files, in seconds.
const IMAGE_PERIOD_S: f64 = 0.1;

/// How many files that are left out are named.
const MAX_NAMES: usize = 5;

/// The ending of annotated images, which are none of a folder's images.
pub(crate) const DRAWN_ENDING: &str = ".drawn.png";

/// The paths of standard input, from which one image is read.
const STANDARD_INPUT: [&str; 2] = ["-", "/dev/stdin"];

/// Iterates over files, folders and videos.
pub(crate) struct Source {
    listed: std::vec::IntoIter<Result<PathBuf, (PathBuf, String)>>,
    video: Option<(PathBuf, Video)>,
    images: u32,
    /// How many names were given out, by the name that the file's path alone gives.
    stems: HashMap<String, u32>,
    /// The name of the video's frames.
    video_stem: String,
}

/// An image, decoded or not yet.
pub(crate) struct Item {
    /// Its name: a path, for a video frame with its number.
    pub(crate) name: String,
    /// The beginning of the names of files about it, its own among those of the same source.
    pub(crate) stem: String,
    /// Its time, in seconds after the first image.
    pub(crate) time_s: f64,
    /// Whether it is a frame of a video.
    pub(crate) is_frame: bool,
    /// Whether it is a frame that viewers turn, by the header of its video.
    pub(crate) is_turned: bool,
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
                Ok(files) => {
                    let is_given = |file: &PathBuf| file == path || !is_drawn(file);
                    listed.extend(files.into_iter().filter(is_given).map(Ok));
                }
                Err(problem) => listed.push(Err((path.clone(), problem.to_string()))),
            }
        }
        let (stems, video_stem) = (HashMap::new(), String::new());
        Self { listed: listed.into_iter(), video: None, images: 0, stems, video_stem }
    }

    /// The path as one name; where another file has it already, with a number.
    fn stem(&mut self, path: &Path) -> String {
        let plain = stem(&path.display().to_string());
        let mut stem = plain.clone();
        while let Some(before) = self.stems.get_mut(&stem) {
            *before += 1;
            stem = format!("{plain}~{before}");
        }
        self.stems.insert(stem.clone(), 1);
        stem
    }

    /// The note on the images in folders whose formats are not read; `None` if there are none.
    pub(crate) fn note_of_others(paths: &[PathBuf]) -> Option<String> {
        let folders = paths.iter().filter(|path| path.is_dir());
        // A folder that cannot be listed is reported where it is read.
        let others = folders.filter_map(|path| files_in(path, &[OTHER_IMAGE_EXTENSIONS]).ok());
        let others: Vec<PathBuf> = others.flatten().collect();
        let shown = others.iter().take(MAX_NAMES).map(|path| path.display().to_string());
        let mut names = shown.collect::<Vec<_>>().join(", ");
        let count = match others.len() {
            0 => return None,
            1 => "1 image is".to_owned(),
            count => format!("{count} images are"),
        };
        if let more @ 1.. = others.len().saturating_sub(MAX_NAMES) {
            names.push_str(&format!(" and {more} more"));
        }
        Some(format!("{count} left out, as neither PNG nor JPEG: {names}; convert them"))
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
                    // With leading zeros the order of the names is that of the frames.
                    let stem = format!("{}-{:06}", self.video_stem, frame.index);
                    let time_s = frame.time_s;
                    let is_turned = video.is_turned();
                    return Some(Item { name, stem, time_s, is_frame: true, is_turned, content });
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
                    self.video_stem = self.stem(&path);
                    self.video = Some((path, video));
                    return self.next();
                }
                Err(problem) => return Some(Item::unreadable(&path, problem.to_string())),
            }
        }
        let time_s = f64::from(self.images) * IMAGE_PERIOD_S;
        self.images = self.images.saturating_add(1);
        let name = path.display().to_string();
        let stem = self.stem(&path);
        let content = Content::File(path);
        Some(Item { name, stem, time_s, is_frame: false, is_turned: false, content })
    }
}

fn is_standard_input(path: &Path) -> bool {
    STANDARD_INPUT.iter().any(|name| path == Path::new(name))
}

fn is_drawn(file: &Path) -> bool {
    file.to_string_lossy().ends_with(DRAWN_ENDING)
}

/// A path as one name, of which folders become parts.
pub(crate) fn stem(path: &str) -> String {
    if is_standard_input(Path::new(path)) {
        return "stdin".to_owned();
    }
    let parts = path.split(['/', '\\']).filter(|part| !matches!(*part, "" | "." | ".."));
    parts.collect::<Vec<_>>().join("_").replace(['#', ':'], "-")
}

impl Item {
    fn unreadable(path: &Path, problem: String) -> Self {
        let name = path.display().to_string();
        let content = Content::Unreadable(problem);
        let stem = stem(&name);
        Self { stem, name, time_s: 0.0, is_frame: false, is_turned: false, content }
    }

    /// The grey image as it is stored, or the reason why there is none.
    pub(crate) fn into_image(self, bayer: Option<BayerPattern>) -> Result<StillImage, String> {
        let image = match self.content {
            Content::File(path) if is_standard_input(&path) => {
                return image_of(std::io::stdin().lock(), bayer);
            }
            Content::File(path) => read_image(&path, DEFAULT_MAX_PIXELS, bayer),
            Content::Frame(path, image) => {
                image.grey(&path, DEFAULT_MAX_PIXELS).map(StillImage::from)
            }
            Content::Unreadable(problem) => return Err(problem),
        };
        image.map_err(|problem| problem.to_string())
    }
}

/// The image that standard input contains, up to its end.
fn image_of(stream: impl Read, bayer: Option<BayerPattern>) -> Result<StillImage, String> {
    let max_bytes = max_file_bytes(DEFAULT_MAX_PIXELS);
    let mut bytes = Vec::new();
    let read = stream.take(max_bytes.saturating_add(1)).read_to_end(&mut bytes);
    read.map_err(|cause| format!("standard input cannot be read: {cause}"))?;
    if bytes.is_empty() {
        return Err("standard input is empty: no program wrote an image to it".to_owned());
    }
    if bytes.len() as u64 > max_bytes {
        return Err(format!(
            "standard input has more than the {max_bytes} bytes of the largest image"
        ));
    }
    let image = read_image_bytes(Path::new("standard input"), &bytes, DEFAULT_MAX_PIXELS, bayer);
    image.map_err(|problem| problem.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_is_read_from_a_stream() {
        let mut png = std::io::Cursor::new(Vec::new());
        let image = image::GrayImage::from_pixel(16, 8, image::Luma([77]));
        image.write_to(&mut png, image::ImageFormat::Png).unwrap();
        let read = image_of(png.get_ref().as_slice(), None).unwrap();
        assert_eq!((read.grey.width(), read.grey.height()), (16, 8));
        let error = image_of(&b""[..], None).unwrap_err();
        assert!(error.contains("standard input") && error.contains("empty"), "{error}");
        assert_eq!(stems(&[PathBuf::from("-")]), ["stdin"]);
    }

    #[test]
    fn the_names_of_a_videos_frames_are_sorted_like_the_frames() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("flight.mjpeg");
        let mut frame = std::io::Cursor::new(Vec::new());
        let image = image::GrayImage::new(16, 8);
        image.write_to(&mut frame, image::ImageFormat::Jpeg).unwrap();
        std::fs::write(&path, frame.into_inner().repeat(12)).unwrap();
        let names = stems(&[path]);
        assert!(names.is_sorted() && names[11].ends_with("flight.mjpeg-000011"), "{names:?}");
    }

    fn stems(paths: &[PathBuf]) -> Vec<String> {
        let mut source = Source::new(paths);
        std::iter::from_fn(|| source.next()).map(|item| item.stem).collect()
    }

    #[test]
    fn the_names_of_files_about_images_differ() {
        assert_eq!(stem("../a/b.c/1.jpg"), "a_b.c_1.jpg");
        assert_eq!(stem("/d/flight:2.avi"), "d_flight-2.avi");
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("a")).unwrap();
        let paths = ["a/b.jpg", "a_b.jpg", "a/b.jpg", "c.jpg"].map(|name| folder.path().join(name));
        paths.iter().for_each(|path| std::fs::write(path, "").unwrap());
        let stems = stems(&paths);
        let distinct: std::collections::BTreeSet<_> = stems.iter().collect();
        assert_eq!(distinct.len(), 4, "{stems:?}");
        assert!(stems[1].ends_with("a_b.jpg~2") && stems[2].ends_with("a_b.jpg~3"), "{stems:?}");
    }

    #[test]
    fn images_of_other_formats_in_a_folder_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let paths = [folder.path().to_owned(), folder.path().join("x.bmp")];
        let note = || Source::note_of_others(&paths);
        let write = |name: &str| std::fs::write(folder.path().join(name), "").unwrap();
        ["a.jpg", "notes.txt", "flight.mp4"].into_iter().for_each(write);
        assert_eq!(note(), None);
        write("b.HEIC");
        let text = note().unwrap();
        assert!(text.starts_with("1 image is left out") && text.contains("b.HEIC"), "{text}");
        ["c.bmp", "d.tiff", "e.webp", "f.gif", "g.dng"].into_iter().for_each(write);
        let text = note().unwrap();
        assert!(text.starts_with("6 images are left out, as neither PNG nor JPEG"), "{text}");
        assert!(text.contains("f.gif and 1 more") && !text.contains("g.dng"), "{text}");
    }

    #[test]
    fn annotated_images_of_a_folder_are_not_taken_for_its_images() {
        let folder = tempfile::tempdir().unwrap();
        let drawn = folder.path().join(format!("a.jpg{DRAWN_ENDING}"));
        for path in [&folder.path().join("a.jpg"), &drawn] {
            std::fs::write(path, "").unwrap();
        }
        assert_eq!(stems(&[folder.path().to_owned()]).len(), 1);
        assert_eq!(stems(&[drawn]).len(), 1);
    }
}
