//! Tests the complete system as processes: flights, recordings, dashboard, kills, faults and attacks. All are in one program, as
//! each program with Zenoh takes a quarter of a minute to build.
//!
//! `cargo test -p tests --test system swap::` runs the tests of one file.

#![expect(
    clippy::print_stdout,
    reason = "results of a test and reasons to skip it are for people to read"
)]

mod dashboard;
mod faulty_detector;
mod flight;
mod freezes;
mod frozen;
mod kills;
mod processes;
mod recording;
mod recovery;
mod security;
mod swap;
mod swaps;
mod up;

// Modules that `measure.rs` uses as well stand at the root of both.
#[path = "dashboard/film.rs"]
mod film;
#[path = "dashboard/many_clients.rs"]
mod many_clients;
#[path = "recording/recorders.rs"]
mod recorders;
#[allow(dead_code, reason = "the film is also sent over a link elsewhere")]
#[path = "link/site.rs"]
mod site;
