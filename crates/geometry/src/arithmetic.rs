//! Computes powers that are the same on every machine, to the bit.
//!
//! Decisions are compared to the bit when a flight is replayed, perhaps on another machine. Operations that IEEE 754
//! defines to the last bit (`+ - * /`, `sqrt`, `abs`, rounding) are the same everywhere. The standard library's sine,
//! exponential or power is not: it is the C library's, and `f64::max` may return either of two zeros. In this crate and in
//! those that decide, the functions of the crate `libm` replace them; `clippy.toml` forbids the others there.

/// The second power.
pub fn squared(value: f64) -> f64 {
    value * value
}

/// The third power.
pub fn cubed(value: f64) -> f64 {
    value * value * value
}
