//! Skips tests visibly.

use std::fmt::Display;
use std::fs::OpenOptions;
use std::io::Write;

/// Reports that a test is skipped because this machine lacks `need`, and why; then the test returns.
///
/// The report goes past the test harness, which shows no output of a test that passes. It is also a line in the file named
/// by `ALIGHT_SKIPS`. `ALIGHT_NO_SKIPS` makes it a failure: for every need when it is `1`, else for the needs that it
/// lists (`python,ffmpeg`).
#[expect(clippy::panic, reason = "a test fails by a panic")]
pub fn skip(need: &str, why: impl Display) {
    let thread = std::thread::current();
    let line = format!("SKIPPED {}: needs {need}: {why}\n", thread.name().unwrap_or("a test"));
    let forbidden = std::env::var("ALIGHT_NO_SKIPS").unwrap_or_default();
    if forbidden == "1" || forbidden.split(',').any(|listed| listed.trim() == need) {
        panic!("{line}ALIGHT_NO_SKIPS={forbidden} forbids it");
    }
    // The print macros would be captured by the harness; without a standard error nothing can be reported.
    let _ = std::io::stderr().lock().write_all(line.as_bytes());
    if let Some(path) = std::env::var_os("ALIGHT_SKIPS") {
        let file = OpenOptions::new().create(true).append(true).open(&path);
        if let Err(problem) = file.and_then(|mut file| file.write_all(line.as_bytes())) {
            panic!("ALIGHT_SKIPS names {path:?}, which cannot be written: {problem}");
        }
    }
}
