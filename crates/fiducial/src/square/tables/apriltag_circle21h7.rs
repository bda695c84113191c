//! AprilTag Circle21h7: 38 words of 21 bits.
//! Generated from tagCircle21h7.c of AprilTag 3.4.5-48-g1c21707 (github.com/AprilRobotics/apriltag).

/// Cell of each bit, the most significant first, from the top left cell of the border square.
#[rustfmt::skip]
pub(crate) static BITS: [[i8; 2]; 21] = [
    [1, -2], [2, -2], [3, -2], [1, 1], [2, 1], [6, 1], [6, 2], [6, 3], [3, 1], [3, 2],
    [3, 6], [2, 6], [1, 6], [3, 3], [2, 3], [-2, 3], [-2, 2], [-2, 1], [1, 3], [1, 2],
    [2, 2],
];

/// Word of each id.
#[rustfmt::skip]
pub(crate) static WORDS: [u64; 38] = [
    0x157863, 0x047e28, 0x1383ed, 0x00953c, 0x0da68b, 0x1cac50,
    0x0bb215, 0x16ceee, 0x05d4b3, 0x1ff751, 0x0efd16, 0x072b3e,
    0x163103, 0x106e56, 0x1996b9, 0x0c0234, 0x0624d2, 0x1fa985,
    0x0344a5, 0x0762fb, 0x19e92b, 0x043755, 0x01a4f4, 0x10fad8,
    0x001b52, 0x17e59f, 0x0e6f70, 0x0ed47a, 0x0c9931, 0x014df2,
    0x0a06f1, 0x0e5041, 0x12ec03, 0x16724e, 0x0af1a5, 0x08a8ac,
    0x015b39, 0x1ec1e3,
];
