//! Runs peers in Python and JavaScript for a test.

#![expect(clippy::print_stdout, reason = "the output of a script is for readers of a failed test")]

use std::path::Path;
use std::process::{Child, Command, Output, Stdio};

use anyhow::bail;

/// Exit status of a script that lacks a package.
const LACKS_PACKAGE: i32 = 77;

/// The Python interpreter: `ALIGHT_PYTHON`, or python3.
pub fn interpreter() -> String {
    std::env::var("ALIGHT_PYTHON").unwrap_or_else(|_| "python3".into())
}

/// Starts a script in Python, by its path from the root of the repository; `None`, and a skip, where there is no Python.
pub fn python(script: &str, args: &[&str]) -> Option<Child> {
    start("python", &interpreter(), script, args)
}

/// Starts a script in JavaScript, as [`python`] one in Python; `NODE_PATH` is where its packages are.
pub fn node(script: &str, args: &[&str]) -> Option<Child> {
    start("node", "node", script, args)
}

fn start(need: &str, interpreter: &str, script: &str, args: &[&str]) -> Option<Child> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").join(script);
    let child = Command::new(interpreter).arg(&script).args(args).stdout(Stdio::piped()).spawn();
    child
        .inspect_err(|problem| crate::skip(need, format_args!("it does not start: {problem}")))
        .ok()
}

/// Whether a script in Python ran to its end: false, and a skip, when it lacks a package.
///
/// # Errors
/// It failed, with all that it wrote.
pub fn python_passes(output: &Output) -> anyhow::Result<bool> {
    passes("python", output)
}

/// Whether a script in JavaScript ran to its end, as [`python_passes`].
///
/// # Errors
/// It failed, with all that it wrote.
pub fn node_passes(output: &Output) -> anyhow::Result<bool> {
    passes("node", output)
}

fn passes(need: &str, output: &Output) -> anyhow::Result<bool> {
    let text = [&output.stdout[..], &output.stderr].concat();
    let text = String::from_utf8_lossy(&text);
    println!("{text}");
    match output.status.code() {
        Some(0) => Ok(true),
        Some(LACKS_PACKAGE) => {
            crate::skip(need, text.trim());
            Ok(false)
        }
        _ => bail!("the script ended with {}: {text}", output.status),
    }
}
