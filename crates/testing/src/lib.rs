//! What the tests of several crates share: skips that are seen, recordings, peers in Python and free ports.
//!
//! It is a dev-dependency only, and knows no other crate of this workspace.

pub mod ports;
mod python;
mod recordings;
mod skip;

pub use python::{interpreter, python, python_passes};
pub use recordings::recording;
pub use skip::skip;
