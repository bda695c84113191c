//! Writes files atomically: another program sees the old or the complete new contents.

use std::fs::{File, Metadata};
use std::io::{ErrorKind, Result, Write};
use std::os::unix::fs::{MetadataExt, fchown};
use std::path::Path;

/// The folder of a file, also of one that is named without it.
pub fn folder_of(file: &Path) -> &Path {
    let folder = file.parent().filter(|folder| !folder.as_os_str().is_empty());
    folder.unwrap_or(Path::new("."))
}

/// Writes a file under another name, and then renames it: the old contents stay until the new ones are complete. Where no file
/// can be made next to it or renamed to it, it is written directly.
///
/// # Errors
/// When it cannot be written. The old contents then remain, unless the file was written directly.
pub fn write_atomically(file: &Path, contents: &[u8]) -> Result<()> {
    // A device or a pipe is written directly.
    if file.exists() && !file.is_file() {
        return std::fs::write(file, contents);
    }
    // The target of a link is written, not the link.
    let file = file.canonicalize().unwrap_or_else(|_| file.to_owned());
    let mut name = file.file_name().unwrap_or_default().to_owned();
    name.push(format!(".{}.new", std::process::id()));
    let new = file.with_file_name(name);
    let written = write_new(&new, std::fs::metadata(&file).ok(), contents)
        .and_then(|()| std::fs::rename(&new, &file));
    let Err(problem) = written else { return Ok(()) };
    // It may not be there.
    let _ = std::fs::remove_file(&new);
    match problem.kind() {
        // The folder is another's or read-only, the file itself is a mount point, or the longer name is too long.
        ErrorKind::PermissionDenied
        | ErrorKind::ReadOnlyFilesystem
        | ErrorKind::ResourceBusy
        | ErrorKind::InvalidFilename => std::fs::write(&file, contents),
        _ => Err(problem),
    }
}

/// Writes a file onto the disk, with owner and mode of the one that it replaces.
fn write_new(new: &Path, old: Option<Metadata>, contents: &[u8]) -> Result<()> {
    let mut file = File::create(new)?;
    if let Some(old) = old {
        // Only root gives files away, and not every file system has owners and modes.
        let _ = fchown(&file, Some(old.uid()), Some(old.gid()));
        let _ = file.set_permissions(old.permissions());
    }
    file.write_all(contents)?;
    file.sync_all()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::Permissions;
    use std::os::unix::fs::PermissionsExt;

    #[test]
    fn the_target_of_a_link_is_replaced_and_no_other_file_is_left() {
        let folder = tempfile::tempdir().unwrap();
        let (file, link) = (folder.path().join("camera.yaml"), folder.path().join("link"));
        std::fs::write(&file, "old").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        write_atomically(&link, b"new").unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), b"new");
        assert!(link.is_symlink());
        assert!(write_atomically(&folder.path().join("missing/camera.yaml"), b"new").is_err());
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    #[test]
    fn the_mode_stays_and_another_file_is_there_instead() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("camera.yaml");
        std::fs::write(&file, "old").unwrap();
        std::fs::set_permissions(&file, Permissions::from_mode(0o604)).unwrap();
        let before = std::fs::metadata(&file).unwrap();
        write_atomically(&file, b"new").unwrap();
        let after = std::fs::metadata(&file).unwrap();
        assert_eq!((after.mode(), after.uid()), (before.mode(), before.uid()));
        assert_ne!(after.ino(), before.ino());
    }

    #[test]
    fn a_file_that_cannot_be_renamed_to_is_written_directly() {
        let folder = tempfile::tempdir().unwrap();
        let long = folder.path().join("c".repeat(255));
        write_atomically(&long, b"new").unwrap();
        assert_eq!(std::fs::read(&long).unwrap(), b"new");
        // Root may write into every folder, and replaces it.
        let file = folder.path().join("camera.yaml");
        std::fs::write(&file, "old").unwrap();
        std::fs::set_permissions(folder.path(), Permissions::from_mode(0o500)).unwrap();
        write_atomically(&file, b"new").unwrap();
        std::fs::set_permissions(folder.path(), Permissions::from_mode(0o700)).unwrap();
        assert_eq!(std::fs::read(&file).unwrap(), b"new");
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
