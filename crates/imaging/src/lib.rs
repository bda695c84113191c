//! Grey images as borrowed views, and what detectors do to them.
//!
//! This crate knows no marker, no camera, no file and no thread.

pub mod view;

pub use view::{GrayImage, GrayView, ViewError};
