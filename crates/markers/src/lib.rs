//! What a marker is: its family, its code and what is printed.
//!
//! This crate knows no image, no camera, no file and no clock; how a marker is found is not known here.
//!
//! Modules in reading order: [`marker`] names a marker by family, id and size; `tables` reads the codewords of the
//! families from `data/*.bin`, [`codebook`] finds the codeword nearest to one that was read; [`square_code`] has the
//! cells of square markers, [`stag_code`] the dots of STags, [`ring_design`] the radii of the three rings; [`drawing`]
//! is what is printed, [`pad`] several markers in known positions on one sheet, [`board`] rows of tags to calibrate with.

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
