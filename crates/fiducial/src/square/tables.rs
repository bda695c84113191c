//! Words of the families, one file each; every file names the reference from which its numbers were generated.
//!
//! Smaller ArUco dictionaries are the beginnings of those of 1000 words.

pub(crate) mod apriltag_16h5;
pub(crate) mod apriltag_25h9;
pub(crate) mod apriltag_36h10;
pub(crate) mod apriltag_36h11;
pub(crate) mod apriltag_circle21h7;
pub(crate) mod apriltag_circle49h12;
pub(crate) mod apriltag_custom48h12;
pub(crate) mod apriltag_standard41h12;
pub(crate) mod apriltag_standard52h13;
pub(crate) mod aruco_4x4;
pub(crate) mod aruco_5x5;
pub(crate) mod aruco_6x6;
pub(crate) mod aruco_7x7;
pub(crate) mod aruco_mip_36h12;
pub(crate) mod aruco_original;
pub(crate) mod stag_hd11;
pub(crate) mod stag_hd13;
pub(crate) mod stag_hd15;
pub(crate) mod stag_hd17;
pub(crate) mod stag_hd19;
pub(crate) mod stag_hd21;
pub(crate) mod stag_hd23;
