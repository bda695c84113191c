//! Compares the code tables with those of the reference implementations: counts, minimum Hamming distances and checksums.
#![allow(clippy::unwrap_used, reason = "a test may stop anywhere")]

use markers::{Codebook, Family, SquareCode, stag_code};

/// File, codewords, bits, CRC-32 (ISO 3309) of the file.
const FILES: [(&str, usize, u8, u32); 22] = [
    ("apriltag_16h5", 30, 16, 0x8610_c20e),
    ("apriltag_25h9", 35, 25, 0xa6c7_e84f),
    ("apriltag_36h10", 2320, 36, 0x2d07_0ecd),
    ("apriltag_36h11", 587, 36, 0xe6d6_a713),
    ("apriltag_circle21h7", 38, 21, 0xfb91_cefd),
    ("apriltag_circle49h12", 65535, 49, 0x37e0_8319),
    ("apriltag_custom48h12", 42211, 48, 0x6e10_1a0f),
    ("apriltag_standard41h12", 2115, 41, 0xfc9f_648d),
    ("apriltag_standard52h13", 48714, 52, 0x31d0_fd48),
    ("aruco_4x4", 1000, 16, 0x7ceb_c589),
    ("aruco_5x5", 1000, 25, 0x073a_8d67),
    ("aruco_6x6", 1000, 36, 0x9f10_408b),
    ("aruco_7x7", 1000, 49, 0x1b44_9ba1),
    ("aruco_mip_36h12", 250, 36, 0xd8eb_7185),
    ("aruco_original", 1024, 25, 0x79a6_06fd),
    ("stag_hd11", 22309, 48, 0xc42a_3fb8),
    ("stag_hd13", 2884, 48, 0x75b8_aac6),
    ("stag_hd15", 766, 48, 0x0875_25b9),
    ("stag_hd17", 157, 48, 0x8982_3c0d),
    ("stag_hd19", 38, 48, 0x048a_f9b3),
    ("stag_hd21", 12, 48, 0x3abd_0047),
    ("stag_hd23", 6, 48, 0xb027_0002),
];

fn read(name: &str) -> Vec<u8> {
    std::fs::read(format!("{}/data/{name}.bin", env!("CARGO_MANIFEST_DIR"))).unwrap()
}

#[test]
fn every_file_has_its_codewords_and_its_checksum() {
    for (name, codewords, bits, checksum) in FILES {
        let file = read(name);
        assert_eq!(file[0], bits, "{name}");
        let rest = file.len() - 2 - 2 * usize::from(file[1]);
        assert_eq!(rest, codewords * usize::from(bits).div_ceil(8), "{name}");
        assert_eq!(crc32fast::hash(&file), checksum, "{name}: {:#010x}", crc32fast::hash(&file));
    }
    let files = std::fs::read_dir(format!("{}/data", env!("CARGO_MANIFEST_DIR"))).unwrap();
    let tables = files.filter(|it| it.as_ref().unwrap().path().extension() == Some("bin".as_ref()));
    assert_eq!(tables.count(), FILES.len());
}

/// A codeword, turned by a quarter.
type Rotate = Box<dyn Fn(u64) -> u64>;

/// The codewords of a family, the minimum Hamming distance that it states, and how its codewords rotate.
fn stated(family: Family) -> Option<(&'static [u64], u32, Rotate)> {
    if let Some(code) = SquareCode::for_family(family) {
        let min_hamming = u32::from(code.min_hamming);
        return Some((code.codewords, min_hamming, Box::new(|word| code.rotated(word))));
    }
    let book: &'static Codebook = stag_code::codebook(family)?;
    let min_hamming = family.name().strip_prefix("stag-hd").unwrap().parse().unwrap();
    Some((book.codewords(), min_hamming, Box::new(|word| book.rotated(word))))
}

#[test]
fn every_family_has_as_many_codewords_as_ids() {
    for family in Family::ALL {
        let count = stated(family).map(|(codewords, ..)| codewords.len() as u32);
        assert_eq!(count, family.id_count(), "{family}");
    }
}

/// Comparisons that a family may take; of larger families an even sample of the codewords is compared with all.
const MAX_COMPARED: usize = 12_000_000;

#[test]
fn no_two_markers_of_a_family_are_nearer_than_stated() {
    let mut exact = 0;
    for family in Family::ALL {
        let Some((codewords, min_hamming, rotated)) = stated(family) else { continue };
        // The published lists of STag keep the distance of their names only between markers in the same rotation, where it
        // is one more, since all codewords have an even number of set bits.
        let (min_upright, min_rotated) = match family {
            Family::StagHd11 => (12, 4),
            Family::StagHd13 => (14, 8),
            Family::StagHd15 => (16, 6),
            Family::StagHd17 => (18, 10),
            Family::StagHd19 => (20, 10),
            Family::StagHd21 => (22, 14),
            Family::StagHd23 => (24, 14),
            _ => (min_hamming, min_hamming),
        };
        let step = (2 * codewords.len() * codewords.len()).div_ceil(MAX_COMPARED);
        let mut nearest = [u32::MAX; 4];
        for (id, &codeword) in codewords.iter().enumerate().step_by(step) {
            let is_symmetrical = family == Family::ArucoOriginal && id == 1023;
            let mut word = codeword;
            for (rotation, nearest) in nearest.iter_mut().enumerate() {
                for (other_id, other) in codewords.iter().enumerate() {
                    if other_id != id || rotation > 0 && !is_symmetrical {
                        *nearest = (word ^ other).count_ones().min(*nearest);
                    }
                }
                word = rotated(word);
            }
        }
        let rotated = nearest[1..].iter().fold(u32::MAX, |a, b| a.min(*b));
        assert!(nearest[0] >= min_upright && rotated >= min_rotated, "{family}: {nearest:?}");
        if step == 1 {
            exact += 1;
            assert_eq!(nearest[0].min(rotated), min_rotated, "{family}");
        }
    }
    assert_eq!(exact, 29);
}
