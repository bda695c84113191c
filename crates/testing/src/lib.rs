//! Helpers for the tests of several crates: visible skips, recordings, peers in Python and JavaScript, ffmpeg, pictures that Exif turns,
//! free ports, second tries and waiting.
//!
//! It is a dev-dependency only, and depends on no other crate of this workspace.

mod exif;
mod ffmpeg;
pub mod ports;
mod recordings;
mod scripts;
mod second_try;
mod skip;
mod waiting;

pub use exif::with_exif_orientation;
pub use ffmpeg::has_x264;
pub use recordings::recording;
pub use scripts::{interpreter, node, node_passes, python, python_passes};
pub use second_try::with_second_try;
pub use skip::skip;
pub use waiting::until;
