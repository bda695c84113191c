//! Futures that are compiled once.

use std::pin::Pin;

/// A future on the heap, compiled in the crate that boxes it. The body of an `async fn` is compiled in every crate that awaits it,
/// with all that it awaits in turn: for one that uses Zenoh that takes a quarter of a minute for each program and each test.
pub type BoxFuture<'a, T> = Pin<Box<dyn Future<Output = T> + Send + 'a>>;
