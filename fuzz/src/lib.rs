//! Runs every reader of bytes or text from outside, as functions that take any input and must not panic, hang
//! or use more memory than [`MAX_MEMORY_MB`].
//!
//! `fuzz/run` mutates inputs with libFuzzer; the corpus it keeps is replayed by a plain `cargo test -p fuzz`.
//!
//! Modules in reading order: [`payloads`] reads messages of the network and bytes of the autopilot's link,
//! [`files`] reads files of a user, [`texts`] names and settings.

pub mod files;
pub mod payloads;
pub mod texts;

/// A target.
#[derive(Copy, Clone, Debug)]
pub struct Target {
    /// Its name, and that of its folder in `corpus`.
    pub name: &'static str,
    /// Reads an input.
    pub read: fn(&[u8]),
    /// The largest input that is tried, in bytes.
    pub max_len: usize,
}

/// The most memory that a process may use for one input, in MB: images are limited to [`files::MAX_PIXELS`].
pub const MAX_MEMORY_MB: u64 = 512;
/// The most time for one input, in seconds.
pub const MAX_TIME_S: u64 = 20;

/// All targets.
pub const TARGETS: [Target; 12] = [
    Target { name: "codec", read: |input| drop(payloads::codec(input)), max_len: 4096 },
    Target { name: "mavlink", read: payloads::mavlink, max_len: 4096 },
    Target { name: "airlink", read: payloads::airlink, max_len: 16_384 },
    Target { name: "jpeg", read: files::jpeg, max_len: 16_384 },
    Target { name: "avi", read: files::avi, max_len: 16_384 },
    Target { name: "mp4", read: files::mp4, max_len: 16_384 },
    Target { name: "h264", read: files::h264, max_len: 16_384 },
    Target { name: "calibration", read: files::calibration, max_len: 4096 },
    Target { name: "recording", read: files::recording, max_len: 16_384 },
    Target { name: "pad", read: texts::pad, max_len: 4096 },
    Target { name: "configuration", read: texts::configuration, max_len: 4096 },
    Target { name: "marker", read: texts::marker, max_len: 256 },
];

/// The target of this name.
pub fn target(name: &str) -> Option<Target> {
    TARGETS.into_iter().find(|target| target.name == name)
}

/// Whether a panic at this place, `FILE:LINE:COLUMN`, is one of this workspace, and not of a decoder that is contained:
/// the compiler names the workspace's own files relative to it.
pub fn is_of_this_workspace(place: &str) -> bool {
    !std::path::Path::new(place).is_absolute()
}
