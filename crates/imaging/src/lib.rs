//! Defines grey images as borrowed views, and the image processing of the detectors.
//!
//! This crate does not depend on markers, cameras, files or threads.
//!
//! Modules in reading order: [`view`] is an image, [`convert`] makes one of raw sensor data, [`mod@bin`] a smaller one, [`mod@filter`]
//! smooths it, [`mod@threshold`] binarises it, [`contour`] follows the borders, [`ellipse`] fits ellipses to
//! them, [`sample`] interpolates grey values. The fast path to regions of any size: [`pyramid`] halves an
//! image again and again, [`binary`] binarises with a local threshold, [`outline`] follows the outlines of
//! the regions, all or where a marker may be by [`contrast_map`]. [`segment`] finds straight edge segments where regions are
//! broken. [`focus`] measures how sharp an image is.

pub mod bin;
pub mod binary;
pub mod contour;
pub mod contrast_map;
pub mod convert;
pub mod ellipse;
pub mod filter;
pub mod focus;
mod kernels;
pub mod outline;
pub mod pyramid;
pub mod sample;
pub mod segment;
pub mod threshold;
pub mod view;

pub use bin::bin;
pub use binary::{Binarizer, BitImage, Contrast, Middle};
pub use contour::{Contour, Contours, Limits, contour_area};
pub use contrast_map::{ContrastMap, Places};
pub use convert::{BayerPattern, Converter, SampleFormat};
pub use ellipse::{Axes, Ellipse, fit_ellipse};
pub use filter::{BilateralRows, bilateral_5x5};
pub use focus::edge_width_px;
pub use kernels::with_vectors;
pub use outline::{Outline, Outlines};
pub use pyramid::Pyramid;
pub use sample::bilinear;
pub use segment::{Segment, SegmentLimits, Segments};
pub use threshold::threshold;
pub use view::{GrayImage, GrayView, ViewError};
