//! Converts panics of other projects' decoders on damaged files into errors.

use std::panic::{AssertUnwindSafe, catch_unwind};

/// The cause of an error of a decoder that panicked.
const CAUSE: &str = "its decoder failed on it";

/// Returns the result of `decode`; after a panic the error that `damaged` makes of the cause. Values that `decode` changed must
/// not be used after a panic.
pub(crate) fn contained<T, E>(
    decode: impl FnOnce() -> Result<T, E>,
    damaged: impl FnOnce(&str) -> E,
) -> Result<T, E> {
    catch_unwind(AssertUnwindSafe(decode)).unwrap_or_else(|_| Err(damaged(CAUSE)))
}
