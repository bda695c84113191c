//! Assigns the dots of an STag to bits and positions. Lengths are in units of the black square's edge, from the marker's
//! centre, x right, y up.
//!
//! The numbers are those of STag's marker generator at 53a3667 (github.com/bbenligiray/stag).

use std::sync::OnceLock;

use crate::codebook::Codebook;
use crate::marker::Family;
use crate::tables;

/// Width of the quiet zone around the black square.
pub const QUIET_ZONE: f64 = 0.125;
/// Radius of the white disc.
pub const DISC_RADIUS: f64 = 0.4;
/// Radius of the circle that the outermost dots touch from within.
const CODE_RADIUS: f64 = 0.35;
/// Radius of a dot.
pub const DOT_RADIUS: f64 = 2.0 * CODE_RADIUS * 0.062_482_177_287_080;
/// Number of dots.
pub const DOTS: usize = 48;

/// The dots of the first quadrant: distance in diameters of the circle of code, and angle.
const QUADRANT: [(f64, f64); 12] = {
    use std::f64::consts::{FRAC_PI_2, FRAC_PI_4};
    [
        (0.088_363_142_525_988, FRAC_PI_4),
        (0.206_935_928_182_607, 0.459_275_804_122_858),
        (0.206_935_928_182_607, FRAC_PI_2 - 0.459_275_804_122_858),
        (0.313_672_146_827_381, 0.200_579_720_495_241),
        (0.327_493_143_484_516, 0.591_687_617_505_840),
        (0.327_493_143_484_516, FRAC_PI_2 - 0.591_687_617_505_840),
        (0.313_672_146_827_381, FRAC_PI_2 - 0.200_579_720_495_241),
        (0.437_421_957_035_861, 0.145_724_938_287_167),
        (0.437_226_762_361_658, 0.433_363_129_825_345),
        (0.430_628_029_742_607, FRAC_PI_4),
        (0.437_226_762_361_658, FRAC_PI_2 - 0.433_363_129_825_345),
        (0.437_421_957_035_861, FRAC_PI_2 - 0.145_724_938_287_167),
    ]
};

/// The centre of each dot, that of the most significant bit first; a set bit is a black dot.
pub fn dots() -> [[f64; 2]; DOTS] {
    std::array::from_fn(|k| {
        let (distance, angle) = QUADRANT[k % QUADRANT.len()];
        let angle = angle + std::f64::consts::FRAC_PI_2 * (k / QUADRANT.len()) as f64;
        let (sin, cos) = angle.sin_cos();
        let radius = 2.0 * CODE_RADIUS * distance;
        [radius * cos, radius * sin]
    })
}

/// Whether dot `k` is black in a codeword.
pub fn is_black(codeword: u64, k: usize) -> bool {
    codeword >> (DOTS - 1 - k) & 1 == 1
}

/// The smallest Hamming distance between two markers of a family of STags, in any rotation; `None` for other families.
pub fn min_hamming(family: Family) -> Option<u8> {
    match family {
        Family::StagHd11 => Some(11),
        Family::StagHd13 => Some(13),
        Family::StagHd15 => Some(15),
        Family::StagHd17 => Some(17),
        Family::StagHd19 => Some(19),
        Family::StagHd21 => Some(21),
        Family::StagHd23 => Some(23),
        _ => None,
    }
}

/// The codebook of a family of STags; `None` for other families. Prepared at the first call.
pub fn codebook(family: Family) -> Option<&'static Codebook> {
    static BOOKS: [OnceLock<Codebook>; 7] = [const { OnceLock::new() }; 7];
    let slot = usize::from(min_hamming(family)? - 11) / 2;
    // Counted from the next corner, clockwise, a dot is where the one a quarter turn behind it was.
    let quarter_turn: [u8; DOTS] = std::array::from_fn(|k| ((k + 3 * DOTS / 4) % DOTS) as u8);
    Some(BOOKS.get(slot)?.get_or_init(|| Codebook::new(tables::codewords(family), &quarter_turn)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_codeword_of_every_family_is_read_in_every_rotation() {
        for family in Family::ALL {
            let Some(book) = codebook(family) else { continue };
            for (&word, id) in book.codewords().iter().zip(0u32..) {
                let mut read = word;
                for rotation in [0, 3, 2, 1] {
                    let found = book.nearest(read, 0).unwrap();
                    let all = (found.id, found.rotation, found.hamming);
                    assert_eq!(all, (id, rotation, 0), "{family} {id}");
                    read = book.rotated(read);
                }
                assert_eq!(read, word);
            }
        }
    }

    #[test]
    fn dots_touch_but_do_not_cover_each_other() {
        let dots = dots();
        for (i, a) in dots.iter().enumerate() {
            assert!(a[0].hypot(a[1]) + DOT_RADIUS <= CODE_RADIUS + 1e-9);
            for b in &dots[i + 1..] {
                assert!((a[0] - b[0]).hypot(a[1] - b[1]) >= 1.99 * DOT_RADIUS);
            }
        }
    }
}
