//! Square markers: [`code`] says which cells of which family carry which words.

pub mod code;
pub(crate) mod codebook;
mod tables;
