//! Two finished runs of the landing experiment side by side: flights of the same circumstances and seed are pairs, so that what differs
//! is the controller, the marker or the program, and not the wind.
//!
//! [`pairs`] reads runs and compares them; [`report`] writes the comparison as a table, as JSON and as a plot.

pub mod pairs;
pub mod report;
