//! Decoders of other projects, of which some panic on damaged files.

use std::panic::{AssertUnwindSafe, catch_unwind};

/// The cause of an error of a decoder that panicked.
const CAUSE: &str = "its decoder failed on it";

/// What `decode` returns; when it panics the error that `damaged` makes of the cause. What it worked on is not to be used
/// after that.
pub(crate) fn contained<T, E>(
    decode: impl FnOnce() -> Result<T, E>,
    damaged: impl FnOnce(&str) -> E,
) -> Result<T, E> {
    catch_unwind(AssertUnwindSafe(decode)).unwrap_or_else(|_| Err(damaged(CAUSE)))
}
