//! AprilTag 16h5: 30 words of 16 bits.
//! Generated from tag16h5.c of AprilTag 3.4.5-48-g1c21707 (github.com/AprilRobotics/apriltag).

/// Cell of each bit, the most significant first, from the top left cell of the border square.
#[rustfmt::skip]
pub(crate) static BITS: [[i8; 2]; 16] = [
    [1, 1], [2, 1], [3, 1], [2, 2], [4, 1], [4, 2], [4, 3], [3, 2], [4, 4], [3, 4],
    [2, 4], [3, 3], [1, 4], [1, 3], [1, 2], [2, 3],
];

/// Word of each id.
#[rustfmt::skip]
pub(crate) static WORDS: [u64; 30] = [
    0x27c8, 0x31b6, 0x3859, 0x569c, 0x6c76, 0x7ddb,
    0xaf09, 0xf5a1, 0xfb8b, 0x1cb9, 0x28ca, 0xe8dc,
    0x1426, 0x5770, 0x9253, 0xb702, 0x063a, 0x8f34,
    0xb4c0, 0x51ec, 0xe6f0, 0x5fa4, 0xdd43, 0x1aaa,
    0xe62f, 0x6dbc, 0xb6eb, 0xde10, 0x154d, 0xb57a,
];
