//! The whole system as processes that fly, record, show, die, lie and are attacked: one program, as each program that speaks
//! Zenoh takes a quarter of a minute to build.
//!
//! `cargo test -p tests --test system swap::` runs the tests of one file.

#![expect(
    clippy::print_stdout,
    reason = "what a test measured, or why it is skipped, is for people to read"
)]

mod dashboard;
mod flight;
mod freezes;
mod frozen;
mod kills;
mod liar;
mod processes;
mod recording;
mod recovery;
mod security;
mod swap;
mod swaps;
mod up;

// What `measure.rs` uses as well stands at the root of both.
#[path = "dashboard/crowd.rs"]
mod crowd;
#[path = "dashboard/film.rs"]
mod film;
#[path = "recording/recorders.rs"]
mod recorders;
#[allow(dead_code, reason = "the film is also sent over a link elsewhere")]
#[path = "link/site.rs"]
mod site;
