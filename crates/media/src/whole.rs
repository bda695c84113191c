//! Files that are written whole or not at all.

use std::path::Path;

/// Writes a file under another name first, so that what was there stays until all of the new one is.
///
/// # Errors
/// When it cannot be written; what was there is there still.
pub fn write_whole(file: &Path, contents: &[u8]) -> std::io::Result<()> {
    // A device or a pipe is written as it is.
    if file.exists() && !file.is_file() {
        return std::fs::write(file, contents);
    }
    // What a link leads to is written, not the link.
    let file = file.canonicalize().unwrap_or_else(|_| file.to_owned());
    let mut name = file.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.new", std::process::id()));
    let new = file.with_file_name(name);
    let written = std::fs::write(&new, contents).and_then(|()| std::fs::rename(&new, &file));
    if written.is_err() {
        // It may not be there.
        let _ = std::fs::remove_file(&new);
    }
    written
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_link_leads_to_is_replaced_and_nothing_else_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let (file, link) = (folder.path().join("camera.yaml"), folder.path().join("link"));
        std::fs::write(&file, "old").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        write_whole(&link, b"new").unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), b"new");
        assert!(link.is_symlink());
        assert!(write_whole(&folder.path().join("missing/camera.yaml"), b"new").is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
