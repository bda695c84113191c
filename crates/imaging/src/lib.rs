//! Grey images as borrowed views, and what detectors do to them.
//!
//! This crate knows no marker, no camera, no file and no thread.
//!
//! Modules in reading order: [`view`] is an image, [`convert`] makes one
//! of what other sensors give, [`mod@filter`] smooths it, [`mod@threshold`] makes it black and
//! white, [`contour`] follows the borders between the two, [`ellipse`] fits ellipses to borders, [`sample`] reads
//! grey values between the pixels. The fast way to regions of any size: [`pyramid`] halves an image again and again,
//! [`binary`] decides which pixels are dark or bright, [`outline`] follows the outlines of the regions they make.
//! [`segment`] takes straight pieces of edges where regions are broken.

pub mod binary;
pub mod contour;
pub mod convert;
pub mod ellipse;
pub mod filter;
mod kernels;
pub mod outline;
pub mod pyramid;
pub mod sample;
pub mod segment;
pub mod threshold;
pub mod view;

pub use binary::{Binarizer, BitImage, Contrast, Middle};
pub use contour::{Contour, Contours, Limits, contour_area, contour_length};
pub use convert::{Converter, Mosaic, SampleFormat};
pub use ellipse::{Axes, Ellipse, fit_ellipse};
pub use filter::{BilateralRows, bilateral_5x5};
pub use outline::{Outline, Outlines};
pub use pyramid::Pyramid;
pub use sample::bilinear;
pub use segment::{LeastEdge, Segment, Segments};
pub use threshold::{LeastContrast, LocalThreshold, threshold};
pub use view::{GrayImage, GrayView, ViewError};
