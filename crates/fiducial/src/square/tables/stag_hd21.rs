//! STag HD21: 12 words of 48 bits.
//! Generated from HD21.txt of the marker generator of STag at 53a3667 (github.com/bbenligiray/stag).

/// Word of each id.
#[rustfmt::skip]
pub(crate) static WORDS: [u64; 12] = [
    0x338cb75e16f1, 0x0a4cf2f96d5b, 0xb7aa3c04a1a3, 0x5940febc08e4, 0x50a699cef484, 0xe524172f884e,
    0xe8c62c6414d7, 0xc3a066307c3e, 0x47a7cb050c71, 0x85c0a85fccd8, 0xacc3b3516425, 0x6ee1700994ea,
];
