//! Finds the recordings: photographs, flight logs, measurements of a real autopilot.

use std::path::{Path, PathBuf};

/// A file or folder of the recordings: photographs, flight logs, measurements of a real autopilot.
///
/// They are not part of the repository but lie next to it, in `../shared/data`; `None`, and a skip, where they do not.
pub fn recording(path: &str) -> Option<PathBuf> {
    let full = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data").join(path);
    if !full.exists() {
        crate::skip("recordings", format_args!("there is no ../shared/data/{path}"));
        return None;
    }
    Some(full)
}
