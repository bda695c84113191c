//! Gives a second try to tests that take real time.

/// Runs a test, and once more if it fails: other work on a busy machine may delay the tested processes.
///
/// # Errors
/// Those of the second try.
#[expect(clippy::print_stdout, reason = "why a test is tried again is for people to read")]
pub async fn with_second_try(test: impl AsyncFn() -> anyhow::Result<()>) -> anyhow::Result<()> {
    match test().await {
        Ok(()) => Ok(()),
        Err(problem) => {
            println!("second try: {problem:#}");
            test().await
        }
    }
}
