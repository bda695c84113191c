//! Reads the codewords of the families from `data/*.bin`.
//!
//! A file has one byte for the bits of a codeword, one byte for the number of cells that follow (as many as bits, or none
//! for STag), two bytes for each cell (column and row, signed, from the top left cell of the square that is detected; the
//! most significant bit's cell first), then the codewords in the order of their ids, little-endian, each in the fewest
//! bytes that hold its bits. `data/README.md` states the source of the numbers.

use std::sync::OnceLock;

use crate::marker::Family;

/// Bytes before the cells.
const HEADER: usize = 2;

/// One file. Smaller ArUco dictionaries are the first codewords of those of 1000.
struct Table {
    bytes: &'static [u8],
    decoded: OnceLock<Decoded>,
}

/// A file's content, decoded at its first use.
struct Decoded {
    cells: Vec<[i8; 2]>,
    codewords: Vec<u64>,
}

impl Table {
    /// A malformed file does not compile.
    const fn new(bytes: &'static [u8]) -> Self {
        assert!(bytes.len() > HEADER, "no header");
        let (bits, cells) = (bytes[0] as usize, bytes[1] as usize);
        assert!(0 < bits && bits <= 64, "codewords have 1 to 64 bits");
        assert!(cells == 0 || cells == bits, "one cell for each bit");
        let start = HEADER + 2 * cells;
        assert!(bytes.len() > start, "no codewords");
        assert!((bytes.len() - start).is_multiple_of(bits.div_ceil(8)), "the last codeword is cut");
        Self { bytes, decoded: OnceLock::new() }
    }

    fn decoded(&self) -> &Decoded {
        self.decoded.get_or_init(|| {
            let width = usize::from(self.bytes[0]).div_ceil(8);
            let (cells, codewords) = self.bytes[HEADER..].split_at(2 * usize::from(self.bytes[1]));
            let cell = |cell: &[u8]| [cell[0] as i8, cell[1] as i8];
            let codeword = |bytes: &[u8]| {
                bytes.iter().rev().fold(0, |word, byte| word << 8 | u64::from(*byte))
            };
            Decoded {
                cells: cells.chunks_exact(2).map(cell).collect(),
                codewords: codewords.chunks_exact(width).map(codeword).collect(),
            }
        })
    }
}

/// The codewords of a family, of id 0 first; empty for a family without ids.
pub(crate) fn codewords(family: Family) -> &'static [u64] {
    let all = table(family).map_or(&[][..], |table| &table.decoded().codewords);
    all.get(..family.id_count().unwrap_or(0) as usize).unwrap_or(all)
}

/// The cell of each bit of a family, of the most significant bit first; empty for a family without square cells.
pub(crate) fn cells(family: Family) -> &'static [[i8; 2]] {
    table(family).map_or(&[], |table| &table.decoded().cells)
}

fn table(family: Family) -> Option<&'static Table> {
    use Family as F;
    macro_rules! table {
        ($name:literal) => {{
            static TABLE: Table = Table::new(include_bytes!(concat!("../data/", $name, ".bin")));
            Some(&TABLE)
        }};
    }
    match family {
        F::AprilTag16h5 => table!("apriltag_16h5"),
        F::AprilTag25h9 => table!("apriltag_25h9"),
        F::AprilTag36h10 => table!("apriltag_36h10"),
        F::AprilTag36h11 => table!("apriltag_36h11"),
        F::AprilTagCircle21h7 => table!("apriltag_circle21h7"),
        F::AprilTagCircle49h12 => table!("apriltag_circle49h12"),
        F::AprilTagCustom48h12 => table!("apriltag_custom48h12"),
        F::AprilTagStandard41h12 => table!("apriltag_standard41h12"),
        F::AprilTagStandard52h13 => table!("apriltag_standard52h13"),
        F::Aruco4x4_50 | F::Aruco4x4_100 | F::Aruco4x4_250 | F::Aruco4x4_1000 => {
            table!("aruco_4x4")
        }
        F::Aruco5x5_50 | F::Aruco5x5_100 | F::Aruco5x5_250 | F::Aruco5x5_1000 => {
            table!("aruco_5x5")
        }
        F::Aruco6x6_50 | F::Aruco6x6_100 | F::Aruco6x6_250 | F::Aruco6x6_1000 => {
            table!("aruco_6x6")
        }
        F::Aruco7x7_50 | F::Aruco7x7_100 | F::Aruco7x7_250 | F::Aruco7x7_1000 => {
            table!("aruco_7x7")
        }
        F::ArucoOriginal => table!("aruco_original"),
        F::ArucoMip36h12 => table!("aruco_mip_36h12"),
        F::StagHd11 => table!("stag_hd11"),
        F::StagHd13 => table!("stag_hd13"),
        F::StagHd15 => table!("stag_hd15"),
        F::StagHd17 => table!("stag_hd17"),
        F::StagHd19 => table!("stag_hd19"),
        F::StagHd21 => table!("stag_hd21"),
        F::StagHd23 => table!("stag_hd23"),
        F::Rings | F::RingsThesis => None,
    }
}
