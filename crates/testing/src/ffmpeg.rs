//! Checks whether ffmpeg can encode the video of a test.

use std::process::Command;

use crate::skip;

/// Whether ffmpeg is installed, with the encoder x264; where it is not, the test is skipped and returns.
pub fn has_x264() -> bool {
    let encoders = Command::new("ffmpeg").arg("-encoders").output();
    let has_x264 = encoders.is_ok_and(|o| String::from_utf8_lossy(&o.stdout).contains("libx264"));
    if !has_x264 {
        skip("ffmpeg", "it does not start, or has no libx264");
    }
    has_x264
}
