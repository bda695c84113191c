//! Finds the folder for data of a service that survive a reboot.

use std::path::PathBuf;

/// The environment variable that names the directory for state.
pub const STATE_VARIABLE: &str = "STATE_DIRECTORY";

/// The directory for state: `$STATE_DIRECTORY` (systemd), `$XDG_STATE_HOME/alight` or `~/.local/state/alight`; `None` without
/// a home. It need not exist.
pub fn state_directory() -> Option<PathBuf> {
    let variable = |name| std::env::var_os(name).filter(|value| !value.is_empty());
    // Of several directories systemd separates by colons, the first is meant.
    if let Some(given) = variable(STATE_VARIABLE) {
        return std::env::split_paths(&given).next();
    }
    let state = variable("XDG_STATE_HOME").map(PathBuf::from);
    let home = || Some(PathBuf::from(variable("HOME")?).join(".local/state"));
    Some(state.or_else(home)?.join("alight"))
}
