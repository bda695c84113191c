//! Sets `ALIGHT_VERSION` to the version and the commit from which the program is built: `0.1.0 (1a2b3c4d5, 2026-11-27)`. It contains
//! `changed` if a source file differs from the commit. It is the version alone outside a repository or without git.

use std::path::{Path, PathBuf};
use std::process::Command;

/// The sources of the program, relative to the root of the repository. A change of one of them may be later than the commit, and builds
/// this crate again in any case.
const SOURCES: [&str; 13] = [
    "Cargo.lock",
    "Cargo.toml",
    "alight",
    "camera-pub",
    "controller",
    "crates",
    "dashboard",
    "deploy",
    "detector",
    "gcs-bridge",
    "recorder",
    "tools",
    "zenoh-config",
];

fn main() {
    let version = std::env::var("CARGO_PKG_VERSION").unwrap_or_default();
    let package = PathBuf::from(std::env::var_os("CARGO_MANIFEST_DIR").unwrap_or_default());
    println!("cargo::rerun-if-changed=build.rs");
    let root = package.parent().unwrap_or(Path::new("."));
    // A source archive inside another repository does not belong to that repository's commit.
    let commit = root.join(".git").exists().then(|| commit(root)).flatten();
    let version = commit.map_or_else(|| version.clone(), |commit| format!("{version} ({commit})"));
    println!("cargo::rustc-env=ALIGHT_VERSION={version}");
}

/// The commit, its date, and whether the sources differ from it; cargo runs this script again once that may have changed.
fn commit(root: &Path) -> Option<String> {
    let folder = git(root, &["rev-parse", "--absolute-git-dir"])?;
    // Each commit, checkout and reset adds a line to the log, if there is a log; otherwise a branch changes.
    let branches = git(root, &["rev-parse", "--git-path", "refs/heads"]).unwrap_or_default();
    let own = ["HEAD", "logs/HEAD"].map(|file| Path::new(&folder).join(file));
    for file in own.into_iter().chain([root.join(branches)]) {
        if file.exists() {
            println!("cargo::rerun-if-changed={}", file.display());
        }
    }
    let sources = SOURCES.iter().filter(|source| root.join(source).exists());
    for source in sources {
        println!("cargo::rerun-if-changed={}", root.join(source).display());
    }
    let mut commit = git(root, &["show", "--no-patch", "--format=%h, %cs", "--abbrev=9", "HEAD"])?;
    let status = ["--no-optional-locks", "status", "--porcelain", "--untracked-files=no", "--"];
    if !git(root, &[&status[..], &SOURCES].concat())?.is_empty() {
        commit.push_str(", changed");
    }
    Some(commit)
}

/// The standard output of git; `None` if git is not installed or fails.
fn git(root: &Path, arguments: &[&str]) -> Option<String> {
    let mut command = Command::new("git");
    // A user's configuration may let git check signatures, and print the result.
    command.args(["-c", "log.showSignature=false", "-C"]).arg(root);
    let output = command.args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok().filter(|_| output.status.success())?;
    Some(text.trim().to_owned())
}
