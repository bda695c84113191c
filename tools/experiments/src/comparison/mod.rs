//! Compares two finished runs of the landing experiment: flights of the same circumstances and seed are pairs, so that differences
//! are due to the controller, the marker or the program, and not to the wind.
//!
//! [`pairs`] reads runs and compares them; [`report`] writes the comparison as a table, as JSON and as a plot.

pub mod pairs;
pub mod report;
