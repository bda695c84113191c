//! A second try for tests that take real time.

/// Runs a test, and once more if it fails: a machine that is busy with something else may disturb what takes its time.
///
/// # Errors
/// Those of the second try.
#[expect(clippy::print_stdout, reason = "why a test is tried again is for people to read")]
pub async fn with_second_try(test: impl AsyncFn() -> anyhow::Result<()>) -> anyhow::Result<()> {
    match test().await {
        Ok(()) => Ok(()),
        Err(problem) => {
            println!("once more: {problem:#}");
            test().await
        }
    }
}
