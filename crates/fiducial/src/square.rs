//! Square markers: [`code`] says which cells of which family carry which words, [`pattern`] which cells of a marker are
//! black and white, [`refine`] where its corners are.

pub mod code;
pub(crate) mod codebook;
pub mod pattern;
mod picture;
mod profiles;
pub mod refine;
mod tables;
