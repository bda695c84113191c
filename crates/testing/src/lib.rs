//! What the tests of several crates share: skips that are seen, recordings, peers in Python, free ports and second tries.
//!
//! It is a dev-dependency only, and knows no other crate of this workspace.

pub mod ports;
mod python;
mod recordings;
mod second_try;
mod skip;

pub use python::{interpreter, python, python_passes};
pub use recordings::recording;
pub use second_try::with_second_try;
pub use skip::skip;
