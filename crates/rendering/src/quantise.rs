//! Rounds light to whole grey levels.

/// The nearest grey level.
pub(crate) fn quantise(level: f32) -> u8 {
    // Adding 2^23 leaves the rounded integer in the lowest bits; unlike a cast from float it needs no test
    // for NaN.
    (level.clamp(0.0, 255.0) + 8_388_608.0).to_bits() as u8
}
