//! What the tests of several crates share: skips that are seen, recordings, peers in Python and JavaScript, ffmpeg, free ports and second tries.
//!
//! It is a dev-dependency only, and knows no other crate of this workspace.

mod ffmpeg;
pub mod ports;
mod recordings;
mod scripts;
mod second_try;
mod skip;

pub use ffmpeg::has_x264;
pub use recordings::recording;
pub use scripts::{interpreter, node, node_passes, python, python_passes};
pub use second_try::with_second_try;
pub use skip::skip;
