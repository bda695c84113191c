//! STag HD19: 38 words of 48 bits.
//! Generated from HD19.txt of the marker generator of STag at 53a3667 (github.com/bbenligiray/stag).

/// Word of each id.
#[rustfmt::skip]
pub(crate) static WORDS: [u64; 38] = [
    0xb7cbdc56f1a4, 0x9f07fa8378fa, 0xb7a41b86b31f, 0xc2293ae77d1b, 0x3b6094fe28fb, 0x41c5b8efd0fc,
    0xeb445d9f648e, 0x76e7ca667053, 0xdf21ff4e940a, 0x8ae7be2eec21, 0x8a84dd64b4ff, 0x8a36c796a9ca,
    0x8bc5630f83e3, 0x528c7337097e, 0x2aee69065db4, 0xb2a0a74bf0c7, 0x87654733584f, 0xa3c33f6244da,
    0xc5e6f3053c15, 0x67e1890b7ca9, 0xacc1cb55dc92, 0xeb607954f861, 0x6243f31cc0bf, 0xc9238a58b8df,
    0xa1ce115ca53a, 0xfd470c00ec6c, 0x16663454d4d6, 0x50e35d5f2068, 0x4e03756b6883, 0xe5232d3530a6,
    0x27826b590c67, 0xece0700994ee, 0x2347d6c93420, 0xb2269871442b, 0x9980361dd838, 0xa460ee6b2818,
    0x23e00e3cb44c, 0x81a2d538cc86,
];
