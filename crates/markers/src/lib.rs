//! Defines markers: family, code and print.
//!
//! This crate does not depend on images, cameras, files or a clock, nor on how a marker is found.
//!
//! Modules in reading order: [`marker`] names a marker by family, id and size; `tables` reads the codewords of the
//! families from `data/*.bin`, [`codebook`] finds the codeword nearest to one that was read; [`square_code`] has the
//! cells of square markers, [`stag_code`] the dots of STags, [`ring_design`] the radii of the three rings; [`drawing`]
//! draws the print, [`pad`] is several markers in known positions on one sheet, [`board`] rows of tags to calibrate with.

pub mod board;
pub mod codebook;
pub mod drawing;
pub mod marker;
pub mod pad;
pub mod ring_design;
pub mod square_code;
pub mod stag_code;
mod tables;

pub use board::{Board, BoardError};
pub use codebook::{Codebook, Match};
pub use drawing::{Drawing, Ink, Layer, Shape};
pub use marker::{Family, Marker, MarkerError};
pub use pad::{Pad, PadError, PlacedMarker};
pub use ring_design::{RING_RADII, RingKind};
pub use square_code::SquareCode;
