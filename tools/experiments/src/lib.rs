//! Runs the thesis' experiments, extended: markers in rendered frames (section 4.3), and hundreds of landings
//! (section 4.4).
//!
//! This crate is above the services: it calls their pure parts as functions, without a network or a clock.
//!
//! Modules in reading order: [`markers`] is the experiment with markers. [`frame_spec`] specifies and renders
//! one frame, whose marker may be a poor [`mod@print`]; [`set`] names the sets and [`sets`] has their frames; [`store`]
//! keeps them on disk; [`record`] has a detector's results, and [`score`] their errors; [`photographs`] has the results
//! on real images; [`report`] is the report, with errors in [`common`] frames, the [`tables`] and [`figures`] of the
//! [`thesis`]. [`landing`] is the experiment with landings, of which [`comparison`] compares two runs, [`faults`] the
//! campaign with killed processes, wrong values and lost messages; [`results`] is the folder of their results.

pub mod common;
pub mod comparison;
pub mod faults;
pub mod figures;
pub mod frame_spec;
pub mod landing;
pub mod markers;
pub mod photographs;
pub mod print;
pub mod record;
pub mod report;
pub mod results;
mod rows;
pub mod score;
pub mod set;
pub mod sets;
pub mod store;
pub mod tables;
pub mod thesis;

pub use rendering::Preset;
