//! Says from which commit the program is built, as `ALIGHT_VERSION`: `0.1.0 (1a2b3c4d5, 2026-11-27)`, with `changed` where a file
//! differs from it, and the version alone outside of a repository and without git.

use std::path::{Path, PathBuf};
use std::process::Command;

/// What the program is made of, from the root of the repository. A change of it may be one since the commit, and builds this crate
/// again in any case.
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
    // A source archive that lies in another repository is not of its commit.
    let commit = root.join(".git").exists().then(|| commit(root)).flatten();
    let told = commit.map_or_else(|| version.clone(), |commit| format!("{version} ({commit})"));
    println!("cargo::rustc-env=ALIGHT_VERSION={told}");
}

/// The commit, its date, and whether the sources differ from it; cargo asks again once that may have changed.
fn commit(root: &Path) -> Option<String> {
    let folder = git(root, &["rev-parse", "--absolute-git-dir"])?;
    // Each commit, checkout and reset adds a line to the log, where there is one; else a branch changes.
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

/// What git says; `None` where there is none, or it refuses.
fn git(root: &Path, arguments: &[&str]) -> Option<String> {
    let mut command = Command::new("git");
    // A user may have git check signatures, and tell of it.
    command.args(["-c", "log.showSignature=false", "-C"]).arg(root);
    let output = command.args(arguments).output().ok()?;
    let text = String::from_utf8(output.stdout).ok().filter(|_| output.status.success())?;
    Some(text.trim().to_owned())
}
