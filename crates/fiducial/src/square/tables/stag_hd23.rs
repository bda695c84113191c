//! STag HD23: 6 words of 48 bits.
//! Generated from HD23.txt of the marker generator of STag at 53a3667 (github.com/bbenligiray/stag).

/// Word of each id.
#[rustfmt::skip]
pub(crate) static WORDS: [u64; 6] = [
    0x23ec2f2da259, 0x4acacd7b42b2, 0xdbc4422c2fa7, 0xb2e2a07acf4c, 0x134f965f7501, 0x7a69740995ea,
];
