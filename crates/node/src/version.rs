//! The version of the program that runs.

use std::sync::OnceLock;

static VERSION: OnceLock<&str> = OnceLock::new();

/// The version of this program, with its commit where it was built from one, as `0.1.0 (1a2b3c4d5, 2026-11-27)`: what its services tell
/// of themselves. All packages of the workspace have one version.
pub fn version() -> &'static str {
    VERSION.get().copied().unwrap_or(env!("CARGO_PKG_VERSION"))
}

/// Has [`version`] tell this from now on; the first time counts. Only the crate of the program knows the commit, so that a new one
/// builds no other again.
pub fn set_version(version: &'static str) {
    let _ = VERSION.set(version);
}

/// A version without its commit.
pub fn release(version: &str) -> &str {
    version.split(' ').next().unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_program_says_once_which_version_it_is() {
        assert_eq!(version(), env!("CARGO_PKG_VERSION"));
        let told = "0.1.0 (1a2b3c4d5, 2026-11-27)";
        set_version(told);
        set_version("9.9.9");
        assert_eq!((version(), release(version())), (told, "0.1.0"));
    }
}
