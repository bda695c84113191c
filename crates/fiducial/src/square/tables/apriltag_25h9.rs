//! AprilTag 25h9: 35 words of 25 bits.
//! Generated from tag25h9.c of AprilTag 3.4.5-48-g1c21707 (github.com/AprilRobotics/apriltag).

/// Cell of each bit, the most significant first, from the top left cell of the border square.
#[rustfmt::skip]
pub(crate) static BITS: [[i8; 2]; 25] = [
    [1, 1], [2, 1], [3, 1], [4, 1], [2, 2], [3, 2], [5, 1], [5, 2], [5, 3], [5, 4],
    [4, 2], [4, 3], [5, 5], [4, 5], [3, 5], [2, 5], [4, 4], [3, 4], [1, 5], [1, 4],
    [1, 3], [1, 2], [2, 4], [2, 3], [3, 3],
];

/// Word of each id.
#[rustfmt::skip]
pub(crate) static WORDS: [u64; 35] = [
    0x156f1f4, 0x1f28cd5, 0x16ce32c, 0x1ea379c, 0x1390f89, 0x034fad0,
    0x07dcdb5, 0x119ba95, 0x1ae9daa, 0x0df02aa, 0x082fc15, 0x0465123,
    0x0ceee98, 0x1f17260, 0x14429cd, 0x17248a8, 0x16ad452, 0x09670ad,
    0x16f65b2, 0x0b8322b, 0x05d715b, 0x1a1c7e7, 0x0d7890d, 0x1813522,
    0x1c9c611, 0x099e4a4, 0x0855234, 0x17b81c0, 0x0c294bb, 0x089fae3,
    0x044df5f, 0x1360159, 0x0ec31e8, 0x1bcc0f6, 0x0a64f8d,
];
