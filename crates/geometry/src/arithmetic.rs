//! Powers that are the same on every machine, to the bit.
//!
//! Decisions are compared to the bit when a flight is replayed, perhaps on another machine. What IEEE 754 defines to the
//! last bit (`+ - * /`, `sqrt`, `abs`, rounding) is the same everywhere. The standard library's sine, exponential or power
//! is not: it is the C library's, and which of two zeros `f64::max` returns is left open. In this crate and in those that
//! decide, the functions of the crate `libm` stand for them; `clippy.toml` forbids the others there.

/// The second power.
pub fn squared(value: f64) -> f64 {
    value * value
}

/// The third power.
pub fn cubed(value: f64) -> f64 {
    value * value * value
}
