//! The version of the program that runs.

use std::sync::OnceLock;

static VERSION: OnceLock<&str> = OnceLock::new();

/// The version of this program, with its commit where it was built from one, as `0.1.0 (1a2b3c4d5, 2026-11-27)`: what its services
/// report. All packages of the workspace have one version.
pub fn version() -> &'static str {
    VERSION.get().copied().unwrap_or(env!("CARGO_PKG_VERSION"))
}

/// Sets the result of [`version`]; only the first call counts. Only the program's crate is built with the commit, so a new commit
/// rebuilds no other crate.
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
    fn the_version_is_set_once() {
        assert_eq!(version(), env!("CARGO_PKG_VERSION"));
        let text = "0.1.0 (1a2b3c4d5, 2026-11-27)";
        set_version(text);
        set_version("9.9.9");
        assert_eq!((version(), release(version())), (text, "0.1.0"));
    }
}
